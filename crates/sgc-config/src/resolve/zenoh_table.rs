//! Resolves `middleware`, the draft of `[ros.zenoh]` and the variables of rmw_zenoh.
//!
//! The variables have their meaning in rmw_zenoh (`zenoh_config.cpp`), with one difference: a value that rmw_zenoh skips
//! with a warning is an error here.

use std::path::{Path, PathBuf};
use std::time::Duration;

use super::Resolver;
use crate::draft::{RosDraft, WithOrigin};
use crate::error::{Mistake, Origin, ZenohOverrideFault};
use crate::names;
use crate::ros_env::{self, Environment, variable};
use crate::zenoh::{
    Middleware, RouterCheck, ZENOH_OVERRIDE_KEY_BYTES_MAX, ZENOH_OVERRIDE_VALUE_BYTES_MAX,
    ZENOH_OVERRIDES_MAX, ZenohConfig,
};

const SESSION_CONFIG_URI: &str = "ZENOH_SESSION_CONFIG_URI";
const CONFIG_OVERRIDE: &str = "ZENOH_CONFIG_OVERRIDE";
const ROUTER_CHECK_ATTEMPTS: &str = "ZENOH_ROUTER_CHECK_ATTEMPTS";

impl Resolver<'_> {
    /// Returns the middleware, or `None` if the file has one that is not understood, which is then an error.
    pub(super) fn middleware(&mut self, written: &RosDraft, is_attempted: bool) -> Option<Middleware> {
        match &written.middleware {
            Some(word) => self.keep(word, names::middleware),
            None => (!is_attempted).then(Middleware::default),
        }
    }

    /// Returns the session of the network of rmw_zenoh. Without such a network it is the default, and no variable is
    /// read.
    pub(super) fn zenoh(
        &mut self,
        written: &RosDraft,
        middleware: Option<Middleware>,
        env: Environment<'_>,
    ) -> ZenohConfig {
        let table = written.zenoh.as_ref();
        match (middleware, table) {
            (Some(Middleware::Dds), Some(table)) => self.record(&table.origin, Mistake::ZenohUnused),
            (Some(Middleware::Zenoh), _) => self.refuse_dds_keys(written),
            _ => {}
        }
        if !middleware.is_some_and(Middleware::has_zenoh) {
            return ZenohConfig::default();
        }
        let router = table.and_then(|table| table.router.as_ref());
        let router = router.and_then(|router| self.keep(router, names::zenoh_router));
        let file = table.and_then(|table| table.config.as_ref());
        let config = match file {
            Some(file) => self.session_config(file),
            None => self.session_config_of_environment(env),
        };
        let is_protected = file.is_some() || variable(env, SESSION_CONFIG_URI).is_some();
        if !is_protected && written.security().next().is_none() && enforces_security(env) {
            self.record(&Origin::Environment, Mistake::ZenohUnprotected);
        }
        ZenohConfig {
            router,
            config,
            overrides: self.keep_variable(overrides(env)).unwrap_or_default(),
            router_check: self.keep_variable(router_check(env)).unwrap_or_default(),
        }
    }

    fn refuse_dds_keys(&mut self, written: &RosDraft) {
        for (key, origin) in written.discovery() {
            self.record(origin, Mistake::DdsKey { key });
        }
        for (key, origin) in written.security() {
            self.record(origin, Mistake::DdsSecurityKey { key });
        }
    }

    fn session_config(&mut self, written: &WithOrigin<PathBuf>) -> Option<PathBuf> {
        let path = self.path(written, "\"session.json5\"")?;
        self.checked_session_config(written.key, &written.value, path, &written.origin)
    }

    fn session_config_of_environment(&mut self, env: Environment<'_>) -> Option<PathBuf> {
        let value = variable(env, SESSION_CONFIG_URI)?;
        let path = match value.split_once("://") {
            Some(("file", path)) if path.starts_with('/') => PathBuf::from(path),
            Some(_) => {
                let mistake = Mistake::ZenohConfigUri { key: SESSION_CONFIG_URI, value };
                self.record(&Origin::Environment, mistake);
                return None;
            }
            None => PathBuf::from(&value),
        };
        self.checked_session_config(SESSION_CONFIG_URI, Path::new(&value), path, &Origin::Environment)
    }

    fn checked_session_config(
        &mut self,
        key: &'static str,
        written: &Path,
        path: PathBuf,
        origin: &Origin,
    ) -> Option<PathBuf> {
        let ending = path.extension().and_then(|ending| ending.to_str());
        if !matches!(ending, Some("json5" | "json" | "yaml" | "yml")) {
            let value = written.to_string_lossy().into_owned();
            self.record(origin, Mistake::ZenohConfigEnding { key, value });
            return None;
        }
        if let Some(Err(mistake)) = self.checks.map(|checks| (checks.zenoh)(key, &path)) {
            self.record(origin, mistake);
        }
        Some(path)
    }

    fn keep_variable<T>(&mut self, result: Result<T, Mistake>) -> Option<T> {
        result.map_err(|mistake| self.record(&Origin::Environment, mistake)).ok()
    }
}

/// Returns `true` if a program of ROS 2 may not run without security.
fn enforces_security(env: Environment<'_>) -> bool {
    variable(env, ros_env::SECURITY_ENABLE).as_deref() == Some("true")
        && variable(env, ros_env::SECURITY_STRATEGY).as_deref() == Some("Enforce")
}

/// Parses `KEY=VALUE;KEY=VALUE`. Like rmw_zenoh, it separates at each `;`, and skips empty settings.
fn overrides(env: Environment<'_>) -> Result<Vec<(String, String)>, Mistake> {
    let key = CONFIG_OVERRIDE;
    let Some(written) = variable(env, key) else { return Ok(Vec::new()) };
    let settings = || written.split(';').filter(|setting| !setting.trim().is_empty());
    let (count, max) = (settings().count(), ZENOH_OVERRIDES_MAX);
    if count > max {
        return Err(Mistake::TooManyEntries { key, count, max });
    }
    let numbered = settings().zip(1..);
    numbered
        .map(|(text, number)| setting(text).map_err(|fault| Mistake::ZenohOverride { key, number, fault }))
        .collect()
}

fn setting(text: &str) -> Result<(String, String), ZenohOverrideFault> {
    let (key, value) = text.split_once('=').ok_or(ZenohOverrideFault::NoEquals)?;
    if key.len() > ZENOH_OVERRIDE_KEY_BYTES_MAX {
        return Err(ZenohOverrideFault::KeyLength(key.len()));
    }
    // Zenoh knows no key with a space, so a setting behind "; " would have no effect on the programs of the network.
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.' | '/');
    let key = key.to_owned();
    if key.is_empty() || !key.chars().all(is_allowed) {
        return Err(ZenohOverrideFault::Key(key));
    }
    let bytes = value.len();
    if bytes > ZENOH_OVERRIDE_VALUE_BYTES_MAX {
        return Err(ZenohOverrideFault::ValueLength { key, bytes });
    }
    if value.trim().is_empty() {
        return Err(ZenohOverrideFault::NoValue(key));
    }
    if !is_closed(value) {
        return Err(ZenohOverrideFault::Unclosed(key));
    }
    Ok((key, value.to_owned()))
}

/// Returns `true` if JSON5 has as many closing brackets as opening ones, and no string without an end.
fn is_closed(json5: &str) -> bool {
    let mut depth = 0_usize;
    let mut chars = json5.chars();
    while let Some(c) = chars.next() {
        match c {
            '[' | '{' => depth += 1,
            ']' | '}' => match depth.checked_sub(1) {
                Some(less) => depth = less,
                None => return false,
            },
            '"' | '\'' => loop {
                match chars.next() {
                    Some('\\') => drop(chars.next()),
                    Some(end) if end == c => break,
                    Some(_) => {}
                    None => return false,
                }
            },
            _ => {}
        }
    }
    depth == 0
}

/// Parses the number of attempts. Unlike rmw_zenoh's, it refuses text behind the number.
fn router_check(env: Environment<'_>) -> Result<RouterCheck, Mistake> {
    let key = ROUTER_CHECK_ATTEMPTS;
    let Some(value) = variable(env, key) else { return Ok(RouterCheck::default()) };
    match value.trim().parse::<i64>() {
        Ok(0) => Ok(RouterCheck::Repeated),
        Ok(attempts) => Ok(u64::try_from(attempts).map_or(RouterCheck::Off, |attempts| {
            RouterCheck::After(Duration::from_secs(attempts).min(RouterCheck::AFTER_MAX))
        })),
        Err(_) => Err(Mistake::RouterCheck { key, value }),
    }
}
