//! `sgc token access`: makes, lists and revokes access tokens for programs that connect to this node's gateway.
//!
//! It signs a token with the node's identity, writes the records of tokens to the state directory, and asks a running
//! node to read them again.

use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use rand_core::RngCore as _;
use serde::Serialize;
use sgc_gateway::{ACCESS_VALID_MS_MAX, AccessGrant, Scope, TokenId};
use sgc_node::audit::{self, AuditEvent, AuditRecord};
use sgc_node::config::Config;
use sgc_node::{AccessRecord, AccessRecords};
use sgc_process::{ProcessError, system_rng, unix_now};
use sgc_wire::UnixMillis;

use super::open;
use crate::error::CliError;
use crate::gateway::{self, Reach};
use crate::span::parse_span_within;
use crate::{files, output, reload};

/// Number of digits of an id that a list shows.
const ID_DIGITS: usize = 12;

/// Make, list and revoke access tokens for programs that connect to a node's gateway.
#[derive(Debug, Args)]
#[command(after_help = "A dashboard in a browser, for twelve hours:
  sgc token access create -c arm-1.toml --for dashboard --subscribe /odom --subscribe '/camera/**' --valid 12h
A program that drives:
  sgc token access create -c arm-1.toml --for teleop --subscribe /odom --publish /cmd_vel --out teleop.token
Revoke a token:
  sgc token access revoke -c arm-1.toml 3f9c01aa52d4")]
pub(super) struct AccessArgs {
    #[command(subcommand)]
    command: AccessCommand,
}

#[derive(Debug, Subcommand)]
enum AccessCommand {
    Create(CreateArgs),
    List(ListArgs),
    Revoke(RevokeArgs),
}

/// Make a token that permits only the named topics and services.
///
/// The command prints the token once and does not keep it. Bring it to the program over a private channel. Anybody who
/// has the token may use it at this node's gateway until it expires or is revoked. Names may be patterns in quotes:
/// '/arm/*', '/**'.
#[derive(Debug, Args)]
struct CreateArgs {
    /// Configuration of the node; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Label of the token, such as its holder, for lists and the log
    #[arg(long = "for", value_name = "LABEL")]
    label: String,
    /// Topic that the holder may receive; may be repeated
    #[arg(long, value_name = "/TOPIC")]
    subscribe: Vec<String>,
    /// Topic that the holder may publish on; may be repeated
    #[arg(long, value_name = "/TOPIC")]
    publish: Vec<String>,
    /// Service or action that the holder may call; may be repeated
    #[arg(long, value_name = "/NAME")]
    call: Vec<String>,
    /// Service or action that the holder may serve; may be repeated
    #[arg(long, value_name = "/NAME")]
    serve: Vec<String>,
    /// How long the token is valid, at most 3650d
    #[arg(long, value_name = "TIME", default_value = "30d", value_parser = valid)]
    valid: Duration,
    /// Write the token into this file, mode 0600, instead of printing it
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print the token, its id and its end as JSON
    #[arg(long, conflicts_with = "out")]
    json: bool,
}

/// List the tokens that have not expired.
#[derive(Debug, Args)]
struct ListArgs {
    /// Configuration of the node; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Revoke a token and disconnect the programs that connected with it.
#[derive(Debug, Args)]
struct RevokeArgs {
    /// Id of the token, or its first digits
    id: String,
    /// Configuration of the node; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// A token as `list --json` shows it.
#[derive(Serialize)]
struct TokenJson<'a> {
    id: &'a str,
    #[serde(rename = "for")]
    label: &'a str,
    subscribe: &'a [String],
    publish: &'a [String],
    call: &'a [String],
    serve: &'a [String],
    created: String,
    expires: String,
    /// `None` if it is not revoked.
    revoked: Option<String>,
}

impl<'a> TokenJson<'a> {
    fn new(record: &'a AccessRecord) -> Self {
        let AccessRecord { id, label, subscribe, publish, call, serve, created, expires, revoked } = record;
        let time = |ms| UnixMillis(ms).to_string();
        let (created, expires, revoked) = (time(*created), time(*expires), revoked.map(time));
        Self { id, label, subscribe, publish, call, serve, created, expires, revoked }
    }
}

/// A revoked token as `--json` shows it.
#[derive(Serialize)]
struct RevokedJson<'a> {
    id: &'a str,
    /// `None` if the token is not listed here.
    #[serde(rename = "for")]
    label: Option<&'a str>,
}

/// Runs `sgc token access`.
pub(super) fn access(args: &AccessArgs) -> Result<(), CliError> {
    match &args.command {
        AccessCommand::Create(args) => create(args),
        AccessCommand::List(args) => list(args),
        AccessCommand::Revoke(args) => revoke(args),
    }
}

fn create(args: &CreateArgs) -> Result<(), CliError> {
    let (config, identity, state) = open(args.config.as_deref())?;
    if let Some(path) = args.out.as_deref().filter(|path| files::exists(path)) {
        let hint = ": a token may be in it; name another file, or remove it";
        return Err(ProcessError::Exists { path: path.to_owned(), hint }.into());
    }
    let now = unix_now();
    let mut id = [0; 16];
    system_rng()?.fill_bytes(&mut id);
    let valid = u64::try_from(args.valid.as_millis()).unwrap_or(u64::MAX);
    let grant = AccessGrant {
        id: TokenId(id),
        gateway: identity.node_id(),
        label: args.label.clone(),
        scope: Scope {
            subscribe: args.subscribe.clone(),
            publish: args.publish.clone(),
            call: args.call.clone(),
            serve: args.serve.clone(),
        },
        issued: now,
        expires: UnixMillis(now.0.saturating_add(valid)),
    };
    let token = grant.clone().sign(&identity)?;
    sgc_node::create_state_dir(&state)?;
    // The record is on disk before the token is printed: a token that is in no list would be overlooked.
    AccessRecords::change(&state, |records| records.add(AccessRecord::from(&grant), now))?;
    let short = short(&grant.id.to_string());
    let (label, expires, scope) = (&grant.label, grant.expires, &grant.scope);
    note(&config, &state, AuditEvent::TokenMade, &format!("{short} for {label}, until {expires}: {scope}"));
    output::diagnostic(&format!(
        "Token {short} for {}, until {}: {}. Whoever has it may do that at the gateway of {}: keep it secret.\nTo take it \
         back: sgc token access revoke {short}",
        grant.label,
        grant.expires,
        grant.scope,
        identity.node_name()
    ));
    // The token holds without it, so a broken certificate only costs the hint.
    match gateway::reach(&config, &identity) {
        Ok(None) => {
            output::diagnostic("This configuration has no [gateway] yet, so there is nothing to connect to.")
        }
        Ok(Some((reach, _))) => output::diagnostic(&way_to(&reach)),
        Err(error) => output::diagnostic(&format!("sgc: {error}")),
    }
    match &args.out {
        Some(path) => {
            let text = zeroize::Zeroizing::new(format!("{}\n", token.to_text().as_str()));
            Ok(files::write_secret(path, &text, files::Existing::Keep(""))?)
        }
        None if args.json => output::json(&serde_json::json!({
            "id": grant.id.to_string(), "for": grant.label, "expires": grant.expires.to_string(),
            "token": token.to_text().as_str(),
        })),
        None => output::line(token.to_text().as_str()),
    }
}

/// Says where programs connect, and how they verify the gateway.
fn way_to(reach: &Reach) -> String {
    let at = format!("To connect: {}", reach.urls.join(" or "));
    match &reach.shown {
        Some(shown) => format!(
            "{at}\nThe gateway's pin: {} (`sgc gateway certificate --pem` prints the certificate to trust)",
            shown.pin
        ),
        None => at,
    }
}

fn list(args: &ListArgs) -> Result<(), CliError> {
    let (_, _, state) = open(args.config.as_deref())?;
    let now = unix_now();
    let mut records = AccessRecords::load(&state)?;
    records.tokens.retain(|record| record.expires >= now.0);
    if args.json {
        return output::json(&records.tokens.iter().map(TokenJson::new).collect::<Vec<_>>());
    }
    if records.tokens.is_empty() {
        return output::line("no access token was made here that has not ended");
    }
    let head = ["id", "for", "made", "until", "may"].map(str::to_owned).to_vec();
    let row = |record: &AccessRecord| {
        let until = match record.revoked {
            Some(at) => format!("revoked {}", UnixMillis(at)),
            None => UnixMillis(record.expires).to_string(),
        };
        let made = UnixMillis(record.created).to_string();
        vec![short(&record.id), record.label.clone(), made, until, record.scope().to_string()]
    };
    let rows: Vec<_> = std::iter::once(head).chain(records.tokens.iter().map(row)).collect();
    output::columns(&rows).into_iter().try_for_each(output::line)
}

fn revoke(args: &RevokeArgs) -> Result<(), CliError> {
    let (config, identity, state) = open(args.config.as_deref())?;
    sgc_node::create_state_dir(&state)?;
    let record = AccessRecords::change(&state, |records| records.revoke(&args.id, unix_now()))?;
    let whose = if record.label.is_empty() { "which is not listed here" } else { &record.label };
    note(&config, &state, AuditEvent::TokenRevoked, &format!("{} for {whose}", short(&record.id)));
    let label = Some(record.label.as_str()).filter(|label| !label.is_empty());
    let text = format!("token {} for {whose} is revoked", short(&record.id));
    output::result(args.json, &RevokedJson { id: &record.id, label }, text)?;
    let socket = crate::node::socket_of(&config, identity.node_name().as_str());
    reload::after_change(&socket)?.iter().try_for_each(|line| output::remark(args.json, line))
}

/// Writes a record into the audit log of the node. A failure is only reported, because the change itself is already
/// made.
fn note(config: &Config, state: &Path, event: AuditEvent, what: &str) {
    let path = audit::audit_path(config.audit.file.as_deref(), Some(state));
    let Some(path) = path.filter(|_| !config.audit.off) else { return };
    let by = format!("uid {}", rustix::process::getuid().as_raw());
    if let Err(error) = audit::append(&path, &AuditRecord::new(event).reason(what).by(by)) {
        output::diagnostic(&format!("sgc: the audit log {} cannot be written: {error}", path.display()));
    }
}

fn short(id: &str) -> String {
    id.chars().take(ID_DIGITS).collect()
}

fn valid(text: &str) -> Result<Duration, String> {
    parse_span_within(text, Duration::from_millis(ACCESS_VALID_MS_MAX))
}
