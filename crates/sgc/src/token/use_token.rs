//! `sgc token use`: takes a token of another fleet's topic and adds a `[[use]]` for it to the configuration.
//!
//! The token goes into a file of its own that only this user can read. The configuration gets three lines that name it.

use std::fs;
use std::io::{IsTerminal, Read, Write};
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use sgc_node::config::{self, Config, Interface, TokenSource};
use sgc_process::{ProcessError, unix_now};
use sgc_trust::{ShareToken, TOKEN_PREFIX, TOKEN_TEXT_BYTES_MAX};
use zeroize::Zeroizing;

use super::share;
use crate::environment::environment;
use crate::error::CliError;
use crate::{files, output, policy, reload};

const TOKENS_DIR: &str = "tokens";

/// Use a topic of another fleet, by the token that its owner gave.
///
/// The command writes the token into the node's state directory and adds a `[[use]]` that names it to the
/// configuration. The other lines of the configuration stay as they are.
#[derive(Debug, Args)]
pub(super) struct UseArgs {
    /// File that holds the token, or - for standard input
    #[arg(value_name = "FILE", required_unless_present = "token_file")]
    token: Option<String>,
    /// The same as FILE
    #[arg(long, value_name = "FILE", conflicts_with = "token")]
    token_file: Option<String>,
    /// The configuration; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the changes without making them
    #[arg(long)]
    dry_run: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// The used topic and the changes for it, as `--json` shows them.
#[derive(Serialize)]
struct UsedJson<'a> {
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'a str,
    owner: &'a str,
    expires: String,
    /// Fingerprint of the owner's CA.
    ca: &'a str,
    token_file: String,
    config_file: String,
    /// Text that is added to the configuration.
    added: &'a str,
    /// Nothing was changed.
    dry_run: bool,
}

/// Runs `sgc token use`.
pub(super) fn use_token(args: &UseArgs) -> Result<(), CliError> {
    let path = files::config_here(args.config.as_deref())?;
    let (config, identity, _) = policy::load(&path)?;
    let given = args.token.as_deref().or(args.token_file.as_deref()).unwrap_or("-");
    let text = token_text(given)?;
    let token = ShareToken::parse(&text)?;
    check(&token, &config)?;
    let node = identity.node_name().as_str();
    let state = sgc_node::state_dir(&config, node).ok_or(sgc_node::StateError::Nowhere)?;
    let file = std::path::absolute(state.join(TOKENS_DIR).join(file_name(&token)))
        .map_err(|source| ProcessError::Read { path: state.clone(), source })?;
    let block = block(&token, &file);
    let before = files::read_limited(&path, config::CONFIG_BYTES_MAX)?;
    let mut after = String::from_utf8_lossy(&before).into_owned();
    if !after.is_empty() && !after.ends_with('\n') {
        after.push('\n');
    }
    after.push_str(&block);
    let base = path.parent().unwrap_or(Path::new(""));
    if config::parse(&after, &path.display().to_string(), base, &environment).is_err() {
        let reason =
            format!("{} cannot be added to; add these lines yourself:\n{}", path.display(), block.trim());
        return Err(CliError::Cannot { reason });
    }
    let ca = token.ca_fingerprint()?;
    let json = UsedJson {
        topic: &token.metadata.ros_name,
        type_name: &token.metadata.type_name,
        owner: token.owner_name.as_str(),
        expires: token.expires.to_string(),
        ca: &ca.to_string(),
        token_file: file.display().to_string(),
        config_file: path.display().to_string(),
        added: block.trim(),
        dry_run: args.dry_run,
    };
    if args.dry_run && args.json {
        return output::json(&json);
    }
    if !args.json {
        output::line(format!(
            "{} [{}] of {}, until {}; its CA is {ca}",
            token.metadata.ros_name, token.metadata.type_name, token.owner_name, token.expires
        ))?;
    }
    if args.dry_run {
        output::line(format!("would write {} and add to {}:", file.display(), path.display()))?;
        return output::line(block.trim());
    }
    let (topic, type_name) = (&token.metadata.ros_name, &token.metadata.type_name);
    let seen = share::seen_types(&config, node, topic).unwrap_or_default();
    if let Some(other) = seen.iter().find(|seen| *seen != type_name) {
        output::diagnostic(&format!(
            "Programs here have {topic} as {other}: those get nothing of {type_name}."
        ));
    }
    sgc_node::create_state_dir(&state)?;
    sgc_node::create_state_dir(&state.join(TOKENS_DIR))?;
    files::write_secret(&file, &token.to_text(), files::Existing::Replace)?;
    replace(&path, &after)?;
    let text = format!("added to {}; the token is in {}", path.display(), file.display());
    output::result(args.json, &json, text)?;
    let socket = crate::node::socket_of(&config, node);
    reload::after_change(&socket)?.iter().try_for_each(|line| output::remark(args.json, line))
}

fn token_text(given: &str) -> Result<Zeroizing<String>, CliError> {
    let limit = TOKEN_TEXT_BYTES_MAX as u64 + 2;
    let mut text = Zeroizing::new(String::with_capacity(TOKEN_TEXT_BYTES_MAX + 2));
    if given.trim_start().starts_with(TOKEN_PREFIX) {
        return Err(CliError::TokenShown);
    }
    if given == "-" {
        if std::io::stdin().is_terminal() {
            output::diagnostic("Paste the token, then end with Ctrl-D:");
        }
        let failed = |source| ProcessError::System { what: "cannot read standard input", source };
        std::io::stdin().take(limit).read_to_string(&mut text).map_err(failed)?;
    } else {
        let path = PathBuf::from(given);
        let read = fs::File::open(&path).and_then(|file| file.take(limit).read_to_string(&mut text));
        read.map_err(|source| ProcessError::Read { path, source })?;
    }
    Ok(text)
}

fn check(token: &ShareToken, config: &Config) -> Result<(), CliError> {
    let cannot = |reason: String| Err(CliError::Cannot { reason });
    let topic = &token.metadata.ros_name;
    if token.expires < unix_now() {
        return cannot(format!(
            "the token ended at {}: ask {} for a new one",
            token.expires, token.owner_name
        ));
    }
    if config.shares.iter().any(|s| (s.interface, &s.topic) == (Interface::Topic, topic)) {
        return cannot(format!("{topic} is shared by this node: it would be shared again, in a loop"));
    }
    for source in config.tokens.iter().map(|token| &token.source) {
        let known = match source {
            TokenSource::File(path) => sgc_node::read_token(path)?,
            TokenSource::Text(token) => ShareToken::clone(token),
        };
        if known.name() == token.name() && known == *token {
            return cannot(format!("{topic} of {} is used with this very token already", token.owner_name));
        }
        if known.name() == token.name() {
            let TokenSource::File(path) = source else {
                return cannot(format!(
                    "{topic} is used with another token already: take its [[use]] out first"
                ));
            };
            return cannot(format!(
                "{topic} is used with another token already, {}: to replace it, write the new one into that file",
                path.display()
            ));
        }
    }
    Ok(())
}

fn file_name(token: &ShareToken) -> String {
    let topic = token.metadata.ros_name.trim_matches('/').replace('/', "-");
    let plain: String =
        topic.chars().filter(|c| c.is_ascii_alphanumeric() || "-_".contains(*c)).take(80).collect();
    format!("{plain}-{}.token", token.name().short())
}

fn block(token: &ShareToken, file: &Path) -> String {
    let plain = |text: &str| text.chars().filter(|c| !c.is_control()).collect::<String>();
    format!(
        "\n[[use]]  # {} [{}] of {}, until {}\ntoken = {}\n",
        plain(&token.metadata.ros_name),
        plain(&token.metadata.type_name),
        token.owner_name,
        token.expires,
        crate::name::toml_string(&file.display().to_string()),
    )
}

/// Replaces the configuration atomically. Its mode stays, and a symbolic link stays a link.
fn replace(path: &Path, text: &str) -> Result<(), CliError> {
    let failed = |source| ProcessError::Write { path: path.to_owned(), source };
    let target = fs::canonicalize(path).map_err(failed)?;
    let permissions = fs::metadata(&target).map_err(failed)?.permissions();
    let dir = target.parent().unwrap_or(Path::new("/"));
    let mut file = tempfile::Builder::new().prefix(".sgc-").tempfile_in(dir).map_err(failed)?;
    file.write_all(text.as_bytes()).map_err(failed)?;
    file.as_file().set_permissions(permissions).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    file.persist(&target).map_err(|error| failed(error.error))?;
    Ok(())
}
