//! `sgc token share`: makes, lists and revokes tokens that share one topic with a partner of another fleet.
//!
//! It writes to the state directory and asks a running node to read that again.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use clap::{Args, Subcommand};
use serde::Serialize;
use sgc_diagnosis::DiagnosisError;
use sgc_node::config::{self, Config, Interface, RouterUrl, ShareConfig};
use sgc_node::partners::{TokenRecord, TokenRecords, read_ca_file};
use sgc_node::policy::metadata;
use sgc_process::unix_now;
use sgc_transport::LinkUrl;
use sgc_trust::{FleetSecret, Identity, ShareToken, TOKEN_ROUTERS_MAX, TopicSecret, TrustAnchors, pem_text};
use sgc_wire::{NodeId, UnixMillis};

use super::open;
use crate::error::CliError;
use crate::span::parse_span_within;
use crate::{output, reload};

const VALID_MAX: Duration = Duration::from_secs(3650 * 86_400);

/// Share one topic with a partner of another fleet by a token, list such tokens, and revoke them.
#[derive(Debug, Args)]
pub(super) struct ShareArgs {
    #[command(subcommand)]
    command: ShareCommand,
}

#[derive(Debug, Subcommand)]
enum ShareCommand {
    Create(CreateArgs),
    List(ListArgs),
    Revoke(RevokeArgs),
}

/// Make a token that shares one topic with a partner of another fleet.
///
/// The command prints the token once and does not keep it. Send it to the partner over a private channel; there,
/// `sgc token use FILE` takes it. It works for nodes of the CA that it was made for, until it expires or is revoked.
#[derive(Debug, Args)]
struct CreateArgs {
    /// The owner's configuration; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Topic; the configuration has to share it
    #[arg(long, value_name = "/TOPIC")]
    topic: String,
    /// Type of the topic, if neither the configuration nor a running node knows it
    #[arg(long = "type", value_name = "TYPE")]
    type_name: Option<String>,
    /// Receiver of the token: the CA certificate of the partner, PEM, for all its nodes, or CA.pem:NODE-ID for one
    #[arg(long, value_name = "WHO")]
    to: String,
    /// How long the token is valid, at most 3650d
    #[arg(long, value_name = "TIME", default_value = "90d", value_parser = valid)]
    valid: Duration,
    /// Router through which the partner reaches this node; may be repeated [default: those of the configuration]
    #[arg(long, value_name = "URL")]
    via: Vec<String>,
    /// Print the token, its number, its end and its receiver as JSON
    #[arg(long)]
    json: bool,
}

/// List the tokens in force.
#[derive(Debug, Args)]
struct ListArgs {
    /// The owner's configuration; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Revoke a token: the partner's nodes are cut off.
#[derive(Debug, Args)]
struct RevokeArgs {
    /// Number of the token
    id: u64,
    /// The owner's configuration; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc token share`.
pub(super) fn share_token(args: &ShareArgs) -> Result<(), CliError> {
    match &args.command {
        ShareCommand::Create(args) => {
            let (config, identity, state) = open_owned(args.config.as_deref())?;
            give(args, &args.topic, &config, &identity, &state)
        }
        ShareCommand::List(args) => list(&open_owned(args.config.as_deref())?.2, args.json),
        ShareCommand::Revoke(args) => {
            let (config, identity, state) = open_owned(args.config.as_deref())?;
            let record = TokenRecords::change(&state, |records| records.withdraw(args.id))?;
            let text = format!("token {} for {} [{}] is revoked", args.id, record.topic, record.type_name);
            output::result(args.json, &RecordJson::new(&record), text)?;
            reload_node(&config, identity.node_name().as_str(), |line| output::remark(args.json, &line))
        }
    }
}

/// As [`open`], with the state directory made if it is missing, and this user's alone.
fn open_owned(config: Option<&Path>) -> Result<(Config, Identity, PathBuf), CliError> {
    let opened = open(config)?;
    sgc_node::create_state_dir(&opened.2)?;
    Ok(opened)
}

fn give(
    args: &CreateArgs,
    topic: &str,
    config: &Config,
    identity: &Identity,
    state: &Path,
) -> Result<(), CliError> {
    let cannot = |reason: String| CliError::Cannot { reason };
    let seen = seen_types(config, identity.node_name().as_str(), topic);
    let share = share(args, topic, config, seen.as_ref())?;
    let Some(secret) = naming_secret(identity) else {
        return Err(DiagnosisError::RouterCannotName { path: config.identity.clone() }.into());
    };
    let (ca, fingerprint, node) = recipient(&args.to)?;
    if fingerprint == identity.as_peer().ca.to_string() {
        let why = "that is the CA of this fleet: its nodes need no token, name them in `to` of the [[share]]";
        return Err(cannot(why.to_owned()));
    }
    let anchors = identity.anchors();
    let own = anchors.certificates().zip(anchors.fingerprints()).find(|(_, ca)| *ca == identity.as_peer().ca);
    let Some((own, _)) = own else { return Err(cannot("the identity has no CA".to_owned())) };
    let now = unix_now();
    let valid = u64::try_from(args.valid.as_millis()).unwrap_or(u64::MAX);
    let metadata = metadata(&share, identity.node_name().as_str());
    let token = ShareToken {
        owner: identity.node_id(),
        owner_name: identity.node_name().clone(),
        ca: own.clone(),
        secret: TopicSecret::derive(secret, &metadata),
        metadata,
        routers: routers(args, config)?,
        expires: UnixMillis(now.0.saturating_add(valid)),
    };
    token.check()?;
    let type_name = share.type_name.clone().unwrap_or_default();
    if seen.is_some_and(|seen| !seen.is_empty() && !seen.contains(&type_name)) {
        output::diagnostic(&format!("Programs here have {topic} as another type than {type_name}."));
    }
    let mut record = TokenRecord {
        id: 0,
        topic: share.topic.clone(),
        type_name: share.type_name.unwrap_or_default(),
        name: token.name().to_string(),
        ca: fingerprint,
        ca_pem: pem_text("CERTIFICATE", &ca),
        node: node.map(|node| node.to_string()),
        created: now.0,
        expires: token.expires.0,
    };
    // The record is on disk before the token is printed: the owner refuses a token that it does not know.
    let id = TokenRecords::change(state, |records| records.add(record.clone(), now))?;
    record.id = id;
    output::diagnostic(&format!(
        "Token {id} for {topic} [{type_name}], until {}. Whoever has it and a certificate of that CA may subscribe: keep it secret.\n\
         There: sgc token use -, which reads it from standard input. To take it back: sgc token share revoke {id}",
        token.expires
    ));
    let node = identity.node_name().as_str();
    let told = reload_node(config, node, |line: String| {
        output::diagnostic(&line);
        Ok(())
    });
    let text = token.to_text();
    let json = TokenJson { record: RecordJson::new(&record), token: text.as_str() };
    output::result(args.json, &json, text.as_str())?;
    told
}

/// A token in force, as `--json` shows it.
#[derive(Serialize)]
struct RecordJson<'a> {
    id: u64,
    topic: &'a str,
    #[serde(rename = "type")]
    type_name: &'a str,
    ca: &'a str,
    node: Option<&'a str>,
    created: String,
    expires: String,
}

/// A new token as `--json` shows it.
#[derive(Serialize)]
struct TokenJson<'a> {
    #[serde(flatten)]
    record: RecordJson<'a>,
    token: &'a str,
}

impl<'a> RecordJson<'a> {
    fn new(record: &'a TokenRecord) -> Self {
        Self {
            id: record.id,
            topic: &record.topic,
            type_name: &record.type_name,
            ca: &record.ca,
            node: record.node.as_deref(),
            created: UnixMillis(record.created).to_string(),
            expires: UnixMillis(record.expires).to_string(),
        }
    }
}

/// Returns the types that programs on the local network use for a topic, as the running node sees them. Returns `None`
/// if no node runs.
pub(super) fn seen_types(config: &Config, node: &str, topic: &str) -> Option<BTreeSet<String>> {
    let socket = crate::node::socket_of(config, node);
    // Without an answer of the node, the user has to give the type.
    let graph = sgc_diagnosis::ask::graph(&socket, None).ok()?;
    let shared = graph.shares.iter().flat_map(|share| &share.routes).filter(|route| route.topic == topic);
    let seen = graph.endpoints.iter().filter(|end| end.is_ros_topic && end.topic == topic);
    Some(shared.map(|route| &route.type_name).chain(seen.map(|end| &end.type_name)).cloned().collect())
}

/// Returns the share of the topic, with the type that the token is for.
fn share(
    args: &CreateArgs,
    topic: &str,
    config: &Config,
    seen: Option<&BTreeSet<String>>,
) -> Result<ShareConfig, CliError> {
    let cannot = |reason: String| CliError::Cannot { reason };
    let named = |share: &&ShareConfig| share.topic == topic;
    let Some(share) = config.shares.iter().filter(named).min_by_key(|share| share.interface) else {
        return Err(cannot(format!("the configuration does not share {topic}: add a [[share]] for it")));
    };
    if share.interface != Interface::Topic {
        let reason =
            format!("{topic} is no topic, and tokens are for topics: nodes of another fleet cannot use it");
        return Err(cannot(reason));
    }
    let mut share = share.clone();
    let asked = match &args.type_name {
        Some(name) => Some(config::message_type(name).map_err(|mistake| cannot(mistake.to_string()))?),
        None => None,
    };
    match (&share.type_name, asked) {
        (Some(known), Some(asked)) if *known != asked => {
            let reason = format!(
                "{topic} is shared as {known}, not as {asked}: leave --type out or change the [[share]]"
            );
            return Err(cannot(reason));
        }
        (None, None) => {
            let why = match seen.map(|seen| seen.iter().collect::<Vec<_>>()) {
                Some(types) if types.len() == 1 => {
                    share.type_name = types.first().map(ToString::to_string);
                    return Ok(share);
                }
                Some(types) if types.is_empty() => {
                    "no program on the network of the node that runs has it".to_owned()
                }
                Some(types) => {
                    let all = types.iter().map(|one| one.as_str()).collect::<Vec<_>>().join(" and ");
                    format!("programs here have it as {all}")
                }
                None => "no node runs that could know it".to_owned(),
            };
            let reason = format!(
                "the type of {topic} is part of its name, and {why}: add --type PACKAGE/msg/NAME, or `type` to the [[share]]"
            );
            return Err(cannot(reason));
        }
        (None, asked) => share.type_name = asked,
        _ => {}
    }
    Ok(share)
}

/// Returns the newest naming secret, from which names of new shares follow.
fn naming_secret(identity: &Identity) -> Option<&FleetSecret> {
    identity.naming_secrets().first().map(|newest| &newest.secret)
}

fn recipient(to: &str) -> Result<(Vec<u8>, String, Option<NodeId>), CliError> {
    let cannot = |reason: String| CliError::Cannot { reason };
    let (file, node) = match to.rsplit_once(':') {
        Some((file, id)) if !Path::new(to).exists() => {
            let id = id.parse::<NodeId>().map_err(|_| {
                cannot(format!(
                    "--to: {id:?} is no node id: 64 hexadecimal digits, as `sgc status` there shows it"
                ))
            })?;
            (file, Some(id))
        }
        _ => (to, None),
    };
    let path = Path::new(file);
    let found = read_ca_file(path).map_err(|error| cannot(format!("--to: {}: {error}", path.display())))?;
    let [ca] = &found[..] else {
        return Err(cannot(format!(
            "--to: {} holds {} certificates; name one CA",
            path.display(),
            found.len()
        )));
    };
    let anchors = TrustAnchors::new([ca.clone()]).map_err(|error| cannot(format!("--to: {error}")))?;
    let fingerprint = anchors.fingerprints().next().map(|ca| ca.to_string()).unwrap_or_default();
    Ok((ca.to_vec(), fingerprint, node))
}

fn routers(args: &CreateArgs, config: &Config) -> Result<Vec<String>, CliError> {
    if args.via.is_empty() {
        // A partner on another local network cannot find a router by mDNS.
        let routers = config.routers.iter().filter(|url| !matches!(url, RouterUrl::Mdns(_)));
        return Ok(routers.take(TOKEN_ROUTERS_MAX).map(ToString::to_string).collect());
    }
    let valid = |url: &String| match url.parse::<LinkUrl>() {
        Ok(url) => Ok(url.to_string()),
        Err(fault) => Err(CliError::Cannot { reason: format!("--via {url}: {fault}") }),
    };
    args.via.iter().map(valid).collect()
}

fn list(state: &Path, json: bool) -> Result<(), CliError> {
    let now = unix_now();
    let records = TokenRecords::load(state)?;
    let in_force: Vec<_> = records.tokens.iter().filter(|record| record.expires > now.0).collect();
    if json {
        let rows: Vec<_> = in_force.iter().map(|record| RecordJson::new(record)).collect();
        return output::json(&rows);
    }
    if in_force.is_empty() {
        return output::line("no token is in force");
    }
    let head = ["id", "topic", "type", "for", "made", "until"].map(str::to_owned).to_vec();
    let row = |record: &&TokenRecord| {
        let ca: String = record.ca.chars().take(8).collect();
        let whom = match &record.node {
            Some(node) => format!("node {} of CA {ca}", node.chars().take(8).collect::<String>()),
            None => format!("all of CA {ca}"),
        };
        let (made, until) = (UnixMillis(record.created), UnixMillis(record.expires));
        let (topic, kind) = (record.topic.clone(), record.type_name.clone());
        vec![record.id.to_string(), topic, kind, whom, made.to_string(), until.to_string()]
    };
    let rows: Vec<_> = std::iter::once(head).chain(in_force.iter().map(row)).collect();
    output::columns(&rows).into_iter().try_for_each(output::line)
}

fn reload_node(
    config: &Config,
    node: &str,
    mut say: impl FnMut(String) -> Result<(), CliError>,
) -> Result<(), CliError> {
    let socket = crate::node::socket_of(config, node);
    reload::after_change(&socket)?.into_iter().try_for_each(&mut say)
}

fn valid(text: &str) -> Result<Duration, String> {
    parse_span_within(text, VALID_MAX)
}
