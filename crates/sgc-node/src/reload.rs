//! Another configuration for a running node: read whole, judged whole, and only then what differs is carried out.
//!
//! It works out what changed; the route machine changes it.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use sgc_ros::{ShareRule, UseRule};
use sgc_trust::Identity;
use sgc_wire::UnixMillis;
use tokio::sync::{Mutex, Notify, mpsc, oneshot};
use tracing::{info, warn};

use crate::audit::{Audit, AuditEvent, AuditRecord};
use crate::config::{Config, ConfigErrors};
use crate::core::{CoreEvent, now};
use crate::rules::Rules;

/// Reads the configuration again as it was read at start.
pub type ConfigSource = Arc<dyn Fn() -> Result<Config, ConfigErrors> + Send + Sync>;

/// Longest wait before policies are looked at again: a wall clock that is set must not keep a token in force.
const EXPIRY_CHECK_MAX: Duration = Duration::from_secs(60);

/// What a reload did.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct ReloadReport {
    /// What changed, one line each; empty if nothing did.
    pub changed: Vec<String>,
    /// What the file says that holds only after a restart.
    pub needs_restart: Vec<String>,
    /// What is wrong and stops nothing.
    pub warnings: Vec<String>,
}

/// The configuration that runs, and how to come to another.
pub(crate) struct Reloader {
    pub(crate) source: Option<ConfigSource>,
    pub(crate) identity: Arc<Identity>,
    pub(crate) state: Option<PathBuf>,
    pub(crate) audit: Audit,
    pub(crate) events: mpsc::Sender<CoreEvent>,
    /// True if there is a local network to share with.
    pub(crate) has_ros: bool,
    pub(crate) running: Mutex<Running>,
    /// Told when there is another time to wait for.
    pub(crate) changed: Notify,
}

/// What runs now.
pub(crate) struct Running {
    /// What restart-only settings were at start, and the others are now.
    pub(crate) config: Config,
    pub(crate) rules: Rules,
}

impl Reloader {
    /// Reads the configuration again. An error means that nothing was touched.
    pub(crate) async fn reload(&self, by: &str) -> Result<ReloadReport, String> {
        let result = self.try_reload().await;
        let record = AuditRecord::new(AuditEvent::Reload).by(by);
        match &result {
            Ok(report) => {
                let changes = [&report.changed[..], &report.needs_restart[..]].concat();
                self.audit.write(record.reason(match changes.is_empty() {
                    true => "nothing changed".to_owned(),
                    false => changes.join("; "),
                }));
                report.changed.iter().for_each(|line| info!("reload: {line}"));
                report.needs_restart.iter().for_each(|line| warn!("reload: {line}"));
                report.warnings.iter().for_each(|line| warn!("reload: {line}"));
            }
            Err(error) => {
                warn!("reload refused, everything is as it was: {error}");
                self.audit.write(record.reason(format!("refused: {error}")));
            }
        }
        result
    }

    async fn try_reload(&self) -> Result<ReloadReport, String> {
        let source = self.source.clone().ok_or("this node cannot read its configuration again")?;
        // One at a time: what was read first is not carried out last.
        let mut running = self.running.lock().await;
        let read = tokio::task::spawn_blocking(move || source());
        let config =
            read.await.map_err(|_| "reading ended in a panic")?.map_err(|errors| errors.to_string())?;
        let certified = self.identity.node_name();
        if let Some(own) = config.uses.iter().find(|one| one.from == *certified) {
            return Err(format!("[[use]] from {:?}: that is this node itself", own.from.as_str()));
        }
        let wants_ros = !(config.shares.is_empty() && config.uses.is_empty() && config.tokens.is_empty());
        if wants_ros && !self.has_ros {
            let why = "this node joined no ROS network when it started, so it can neither share nor use";
            return Err(format!("{why}: restart it"));
        }
        self.apply(&mut running, config).await
    }

    /// Carries out `config`.
    async fn apply(&self, running: &mut Running, config: Config) -> Result<ReloadReport, String> {
        let (identity, state) = (self.identity.clone(), self.state.clone());
        let wanted = config.clone();
        let load = tokio::task::spawn_blocking(move || {
            Rules::load(&wanted, &identity, state.as_deref(), now().unix)
        });
        let rules = load.await.map_err(|_| "reading ended in a panic")?.map_err(|error| error.to_string())?;
        let mut report = ReloadReport {
            changed: changes(&running.rules, &rules),
            needs_restart: needs_restart(running, &config, &rules),
            warnings: rules.warnings.clone(),
        };
        let (reply, done) = oneshot::channel();
        let trusted = &running.rules.partners.certificates;
        let certificates = &rules.partners.certificates;
        let more: Vec<_> = certificates.iter().filter(|c| !trusted.contains(c)).cloned().collect();
        if !more.is_empty() {
            let cas = if more.len() == 1 { "CA is" } else { "CAs are" };
            report.changed.push(format!("{} more {cas} trusted", more.len()));
        }
        let (shares, uses) = (rules.shares.clone(), rules.uses.clone());
        let event = CoreEvent::Reload { shares, uses, certificates: more.clone(), reply };
        let stopping = || "the node is stopping".to_owned();
        self.events.send(event).await.map_err(|_| stopping())?;
        done.await.map_err(|_| stopping())?.map_err(|error| format!("trusted CAs: {error}"))?;
        self.audit.set_names(rules.names.clone());
        // Restart-only settings stay as they run, so that the next reload says again what waits for a restart.
        let Config { shares, uses, tokens, partners, trust, .. } = config;
        running.config = Config { shares, uses, tokens, partners, trust, ..running.config.clone() };
        // A CA that was trusted once stays so until the node ends.
        let mut trusted = running.rules.partners.certificates.clone();
        trusted.extend(more);
        running.rules = rules;
        running.rules.partners.certificates = trusted;
        report.changed.dedup();
        self.changed.notify_one();
        Ok(report)
    }

    /// Takes tokens out of the policies when they end; never returns.
    pub(crate) async fn watch_expiry(&self) {
        loop {
            let next = self.running.lock().await.rules.partners.next_expiry;
            let wait = next.map(|UnixMillis(at)| Duration::from_millis(at.saturating_sub(now().unix.0)));
            let timer = async {
                match wait {
                    Some(wait) => tokio::time::sleep(wait.min(EXPIRY_CHECK_MAX)).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = timer => {}
                () = self.changed.notified() => continue,
            }
            if next.is_none_or(|at| at > now().unix) {
                continue;
            }
            let mut running = self.running.lock().await;
            let config = running.config.clone();
            match self.apply(&mut running, config).await {
                Ok(report) => {
                    let record = AuditRecord::new(AuditEvent::Reload).by("a token ended");
                    self.audit.write(record.reason(report.changed.join("; ")));
                }
                Err(error) => {
                    warn!("a token ended, but its holder stays: {error}");
                    drop(running);
                    tokio::time::sleep(EXPIRY_CHECK_MAX).await;
                }
            }
        }
    }
}

/// What differs, one line for each topic.
fn changes(old: &Rules, new: &Rules) -> Vec<String> {
    let mut lines = Vec::new();
    let shares = |rules: &Rules| -> BTreeMap<String, ShareRule> {
        rules.shares.iter().map(|s| (s.metadata.ros_name.clone(), s.clone())).collect()
    };
    let (before, after) = (shares(old), shares(new));
    for topic in before.keys().filter(|topic| !after.contains_key(*topic)) {
        lines.push(format!("{topic} is no longer shared"));
    }
    for (topic, rule) in &after {
        match before.get(topic) {
            None => lines.push(format!("{topic} is shared")),
            Some(known) if known == rule => {}
            Some(known) => lines.push(share_change(topic, known, rule)),
        }
    }
    let place =
        |rule: &UseRule| (rule.owner_name.clone(), rule.topic.clone(), rule.token.clone().map(|t| t.0));
    let uses = |rules: &Rules| -> BTreeMap<_, _> {
        rules.uses.iter().map(|rule| (place(rule), rule.clone())).collect()
    };
    let (before, after) = (uses(old), uses(new));
    let by = |rule: &UseRule| if rule.token.is_some() { " (by token)" } else { "" };
    for (key, rule) in before.iter().filter(|(key, _)| !after.contains_key(*key)) {
        lines.push(format!("{} of {} is no longer used{}", key.1, key.0, by(rule)));
    }
    for (key, rule) in &after {
        match before.get(key) {
            None => lines.push(format!("{} of {} is used{}", key.1, key.0, by(rule))),
            Some(known) if known == rule => {}
            Some(_) => lines.push(format!("{} of {} is used with another type", key.1, key.0)),
        }
    }
    lines
}

fn share_change(topic: &str, known: &ShareRule, rule: &ShareRule) -> String {
    let mut what = Vec::new();
    if known.policy.subscribe != rule.policy.subscribe {
        what.push("who may subscribe");
    }
    if known.policy.publish != rule.policy.publish {
        what.push("who may publish");
    }
    let changes_share =
        (known.suite, known.class, &known.metadata) != (rule.suite, rule.class, &rule.metadata);
    let end = if changes_share { "; it begins anew" } else { "" };
    for (is_changed, word) in [
        (known.suite != rule.suite, "its suite"),
        (known.class != rule.class, "its priority"),
        (known.metadata != rule.metadata, "its type or metadata"),
    ] {
        if is_changed {
            what.push(word);
        }
    }
    format!("{topic}: {} changed{end}", what.join(", "))
}

fn needs_restart(running: &Running, config: &Config, rules: &Rules) -> Vec<String> {
    let now = &running.config;
    let mut lines: Vec<String> = [
        (now.node_name != config.node_name, "`name`"),
        (now.identity != config.identity, "`identity`"),
        (now.routers != config.routers, "`routers`"),
        (now.listen != config.listen, "`listen` in [router]"),
        // Shares and uses join the default network where the file says nothing of it.
        (now.ros != config.ros, "[ros]"),
        (now.state != config.state, "`state`"),
        (now.authority != config.authority, "[authority]"),
        (now.rotation != config.rotation, "[rotation]"),
        (now.audit != config.audit, "[audit]"),
        (now.admin_socket != config.admin_socket, "`socket` in [admin]"),
    ]
    .into_iter()
    .filter(|(is_changed, _)| *is_changed)
    .map(|(_, what)| format!("{what} changed, which needs a restart"))
    .collect();
    let wanted = &rules.partners.certificates;
    if running.rules.partners.certificates.iter().any(|trusted| !wanted.contains(trusted)) {
        lines.push("a CA is no longer to be trusted, which needs a restart".to_owned());
    }
    if running.rules.routers != rules.routers {
        lines.push("tokens name other routers, which needs a restart".to_owned());
    }
    lines
}
