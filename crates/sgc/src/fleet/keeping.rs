//! `sgc fleet list`, `ca`, `revoke`, `adopt`, `rotate-secret` and `retire-secret`: the upkeep of a fleet.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_node::{LockedFleet, roster_head, roster_row};
use sgc_process::{ProcessError, system_rng, unix_now};
use sgc_transport::LinkUrl;
use sgc_trust::{EnrollRequest, Fleet, NodeName, is_invitation, pem_contents, pem_text};
use sgc_wire::{RosterPage, RosterRow, RowCertificate, UnixMillis};

use super::remote::{FleetPlace, Remote};
use super::{WhichFleet, heard_lists};
use crate::error::CliError;
use crate::files;
use crate::{output, status};

pub(super) const LIST_EXTENSION: &str = "crl";
/// The node name in the certificate with which the keeper of a fleet pushes a list to a router.
const KEEPER_NAME: &str = "fleet-keeper";
/// How long that certificate is valid.
const KEEPER_VALID: Duration = Duration::from_secs(600);

/// List the nodes of a fleet with their groups, role, end of certificates, and revocation.
#[derive(Debug, Args)]
pub(super) struct ListArgs {
    #[command(flatten)]
    place: FleetPlace,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Print the certificate of a fleet's CA, PEM. It is no secret; partners and their routers trust it.
#[derive(Debug, Args)]
pub(super) struct CaArgs {
    #[command(flatten)]
    which: WhichFleet,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Revoke all certificates of nodes, for good.
///
/// The command writes the fleet's revocation list next to its file. Nodes that have the list refuse the revoked nodes
/// at once and pass the list on to their neighbours. Without a node, the command writes the list again.
#[derive(Debug, Args)]
pub(super) struct RevokeArgs {
    /// Names of the nodes
    nodes: Vec<String>,
    /// Push the list to this router as well; may be repeated. Nodes of this user on this machine always get it
    #[arg(long, value_name = "URL")]
    push: Vec<LinkUrl>,
    #[command(flatten)]
    place: FleetPlace,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Enter a certificate that is older than the fleet's roster into the roster, so that it can be revoked.
#[derive(Debug, Args)]
pub(super) struct AdoptArgs {
    /// Name of the node
    node: String,
    /// Certificate of the node, PEM
    #[arg(long, value_name = "FILE")]
    certificate: PathBuf,
    #[command(flatten)]
    which: WhichFleet,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Make a new generation of the secret from which names are derived.
///
/// A node that has left the fleet can recognise the names of older shares, but no names that nodes derive from the new
/// secret. Nodes get the new secret when they are renewed.
#[derive(Debug, Args)]
pub(super) struct RotateArgs {
    #[command(flatten)]
    which: WhichFleet,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Take old generations of the naming secret out of use, once every node has a newer one.
#[derive(Debug, Args)]
pub(super) struct RetireArgs {
    /// First generation to keep; older ones are retired
    #[arg(value_name = "GENERATION")]
    before: u32,
    /// Retire even if members with a valid certificate lack that generation and were seen in the last 30 days
    #[arg(long)]
    force: bool,
    #[command(flatten)]
    which: WhichFleet,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// The result of `sgc fleet revoke` as `--json` shows it.
#[derive(Serialize)]
struct RevokedJson<'a> {
    /// The revoked nodes; none if the list was only written again.
    nodes: Vec<&'a str>,
    /// Number of the list.
    revocation_list: u64,
    /// The written list; `None` if the authority keeps it.
    revocation_list_file: Option<String>,
    /// The authority that revoked; `None` with a fleet file.
    authority: Option<&'a str>,
    /// Nodes and routers to which the list was pushed from here.
    pushed_to: &'a [String],
}

#[derive(Serialize)]
struct AdoptedJson<'a> {
    file: String,
    node: &'a str,
}

/// Generations of a fleet's secret after a change, as `--json` shows them.
#[derive(Serialize)]
struct GenerationsJson {
    file: String,
    secret_generations: Vec<u32>,
}

impl GenerationsJson {
    fn new(file: &LockedFleet) -> Self {
        let secret_generations = file.fleet.generations().iter().map(|g| g.number).collect();
        Self { file: file.path().display().to_string(), secret_generations }
    }
}

#[derive(Serialize)]
struct FleetJson<'a> {
    fleet: &'a str,
    expires: String,
    authority: Option<&'a str>,
    post_quantum: bool,
    has_roster: bool,
    revocation_list: u64,
    secret_generations: Vec<GenerationJson>,
    nodes: Vec<NodeJson<'a>>,
}

#[derive(Serialize)]
struct GenerationJson {
    number: u32,
    created: String,
}

#[derive(Serialize)]
struct NodeJson<'a> {
    name: &'a str,
    id: String,
    groups: &'a [String],
    role: &'static str,
    incarnation: u32,
    expires: Option<String>,
    revoked: Option<String>,
    secret_generation: Option<u32>,
    seen: Option<String>,
    certificates: Vec<CertificateJson>,
}

#[derive(Serialize)]
struct CertificateJson {
    serial: String,
    incarnation: u32,
    expires: String,
    revoked: Option<String>,
}

pub(super) fn list(args: &ListArgs) -> Result<(), CliError> {
    let roster = match args.place.remote()? {
        Some(remote) => remote.list()?,
        None => {
            let (_, fleet) = args.place.which.read()?;
            let nodes = fleet.nodes().map(|node| roster_row(&fleet, node)).collect();
            RosterPage { nodes, ..roster_head(&fleet) }
        }
    };
    if args.json {
        let json = serde_json::to_string_pretty(&json(&roster));
        let json =
            json.map_err(|e| ProcessError::System { what: "JSON", source: std::io::Error::other(e) })?;
        return output::line(json);
    }
    output::line(table(&roster, unix_now()))
}

pub(super) fn ca(args: &CaArgs) -> Result<(), CliError> {
    let (_, fleet) = args.which.read()?;
    let text = pem_text("CERTIFICATE", fleet.ca_certificate());
    if args.json {
        return output::json(
            &serde_json::json!({ "fleet": fleet.name().as_str(), "certificate": text.trim_end() }),
        );
    }
    output::line(text.trim_end())
}

pub(super) fn revoke(args: &RevokeArgs) -> Result<(), CliError> {
    let nodes = args.nodes.iter().map(|n| n.parse()).collect::<Result<Vec<NodeName>, _>>()?;
    if let Some(remote) = args.place.remote()? {
        return revoke_at(&remote, &nodes, args.json);
    }
    let mut file = args.place.which.open()?;
    let now = unix_now();
    if !nodes.is_empty() {
        let done = file.fleet.revoke(&nodes, now);
        done.map_err(|e| file.error(e))?;
        file.save()?;
    }
    let (path, list) = write_list(&file, now)?;
    let mut text = String::new();
    for node in &nodes {
        text.push_str(&format!("{node}: revoked\n"));
    }
    text.push_str(&format!("{}: revocation list {}\n", path.display(), file.fleet.crl_number()));
    let pushed = push_crl(&mut file, &list, &args.push)?;
    match pushed.names.is_empty() {
        true => text.push_str(
            "No node has the list yet. Push it to one, and it passes the list on:\n  sgc fleet revoke --push quic://…   \
             or, where a node runs:  sgc fleet revoke",
        ),
        false => {
            text.push_str(&format!("Pushed to {}: nodes pass it on to each other.", pushed.names.join(", ")))
        }
    }
    let json = RevokedJson {
        nodes: nodes.iter().map(NodeName::as_str).collect(),
        revocation_list: file.fleet.crl_number(),
        revocation_list_file: Some(path.display().to_string()),
        authority: None,
        pushed_to: &pushed.names,
    };
    output::result(args.json, &json, text)?;
    pushed.failed.map_or(Ok(()), Err)
}

fn revoke_at(remote: &Remote, nodes: &[NodeName], is_json: bool) -> Result<(), CliError> {
    let list = remote.revoke(nodes)?;
    let mut text = String::new();
    for node in nodes {
        text.push_str(&format!("{node}: revoked\n"));
    }
    text.push_str(&format!("Revocation list {list} of {}: nodes pass it on to each other.", remote.at()));
    let json = RevokedJson {
        nodes: nodes.iter().map(NodeName::as_str).collect(),
        revocation_list: list,
        revocation_list_file: None,
        authority: Some(remote.at().as_str()),
        pushed_to: &[],
    };
    output::result(is_json, &json, text)
}

pub(super) fn adopt(args: &AdoptArgs) -> Result<(), CliError> {
    let node: NodeName = args.node.parse()?;
    let path = &args.certificate;
    let found = pem_contents(&files::read_public(path)?, &["CERTIFICATE"])
        .map_err(|source| CliError::Pem { path: path.clone(), source })?;
    let chain: Vec<_> = found.iter().map(|c| CertificateDer::from(c.to_vec())).collect();
    let mut file = args.which.open()?;
    let done = file.fleet.adopt(node.clone(), &chain, unix_now());
    done.map_err(|source| CliError::Fleet { path: path.clone(), source })?;
    file.save()?;
    let path = file.path().display();
    let json = AdoptedJson { file: path.to_string(), node: node.as_str() };
    output::result(args.json, &json, format!("{path}: knows this certificate of {node} now"))
}

pub(super) fn rotate(args: &RotateArgs) -> Result<(), CliError> {
    let mut file = args.which.open()?;
    let generation = file.fleet.rotate_secret(unix_now(), &mut system_rng()?);
    let generation = generation.map_err(|e| file.error(e))?;
    file.save()?;
    // An authority that runs here reads the fleet file again when it gets a list.
    let (_, list) = write_list(&file, unix_now())?;
    push_crl(&mut file, &list, &[])?;
    let text = format!(
        "{}: generation {generation} of the naming secret\n\
         Nodes get it when they are renewed (`sgc fleet renew NODE`, or by the authority). Once all have it:\n  \
         sgc fleet retire-secret {generation}",
        file.path().display()
    );
    output::result(args.json, &GenerationsJson::new(&file), text)
}

pub(super) fn retire(args: &RetireArgs) -> Result<(), CliError> {
    let mut file = args.which.open()?;
    let lacking: Vec<_> = file.fleet.lacking(args.before, unix_now()).map(|n| n.name.to_string()).collect();
    if !lacking.is_empty() && !args.force && args.before <= newest_of(&file.fleet) {
        let (path, generation) = (file.path().to_owned(), args.before);
        return Err(CliError::SecretLacking { path, generation, nodes: lacking });
    }
    let done = file.fleet.retire_secrets(args.before);
    done.map_err(|e| file.error(e))?;
    file.save()?;
    let left: Vec<_> = file.fleet.generations().iter().map(|g| g.number.to_string()).collect();
    let text = format!("{}: generations in use: {}", file.path().display(), left.join(", "));
    output::result(args.json, &GenerationsJson::new(&file), text)
}

/// Returns the newest generation of a fleet's secret.
fn newest_of(fleet: &Fleet) -> u32 {
    fleet.generations().last().map_or(1, |newest| newest.number)
}

/// The result of pushing a revocation list.
pub(super) struct PushReport {
    pub(super) names: Vec<String>,
    /// The error of the last router that did not take the list.
    pub(super) failed: Option<CliError>,
}

/// Pushes a list to the nodes that this user runs here and to these routers, and takes over revocations that only they
/// know. In that case the list is written once more; the receivers need no second push, because they know its content.
pub(super) fn push_crl(
    file: &mut LockedFleet,
    list: &[u8],
    routers: &[LinkUrl],
) -> Result<PushReport, CliError> {
    let (mut names, mut heard) = status::push_crl_local(list);
    let mut failed = None;
    if !routers.is_empty() {
        // The certificate serves this push alone; the roster does not list it.
        let keeper = KEEPER_NAME.parse().map_err(CliError::Label)?;
        let request =
            EnrollRequest { router: true, valid: KEEPER_VALID, ..EnrollRequest::new(keeper, unix_now()) };
        let identity = file.fleet.issue(&request, &mut system_rng()?);
        let identity = Arc::new(identity.map_err(CliError::Making)?);
        let runtime = tokio::runtime::Runtime::new();
        let runtime =
            runtime.map_err(|source| ProcessError::System { what: "the runtime does not start", source })?;
        for url in routers {
            let list = bytes::Bytes::copy_from_slice(list);
            match runtime.block_on(sgc_node::push_crl(url, identity.clone(), list)) {
                Ok(lists) => {
                    names.push(url.to_string());
                    heard.extend(lists);
                }
                Err(source) => failed = Some(CliError::Tell(source)),
            }
        }
    }
    let now = unix_now();
    if heard_lists::take_heard(file, &heard, now)? {
        file.save()?;
        write_list(file, now)?;
    }
    Ok(PushReport { names, failed })
}

pub(super) fn write_list(file: &LockedFleet, now: UnixMillis) -> Result<(PathBuf, Vec<u8>), CliError> {
    let list = file.fleet.revocation_list(now).map_err(|e| file.error(e))?;
    let path = list_path(file.path());
    files::write_public(&path, &list)?;
    Ok((path, list))
}

pub(super) fn list_path(fleet: &Path) -> PathBuf {
    fleet.with_extension(LIST_EXTENSION)
}

fn role(node: &RosterRow) -> &'static str {
    match (node.router, node.may_route) {
        (true, _) => "router",
        (false, true) => "member, may route",
        (false, false) => "member",
    }
}

fn state(node: &RosterRow, now: UnixMillis) -> String {
    let open = |c: &&RowCertificate| is_invitation(&c.serial) && c.revoked.is_none() && c.expires >= now;
    let invited = node.certificates.iter().filter(open).map(|c| c.expires).max();
    match (node.revoked, node.expires, invited) {
        (Some(at), _, _) => format!("revoked {at}"),
        (None, Some(until), _) if until >= now => format!("until {until}"),
        (None, _, Some(until)) => format!("invited until {until}"),
        (None, Some(until), None) => format!("expired {until}"),
        (None, None, None) => "expired".to_owned(),
    }
}

/// Returns the newest generation of the secret that a member got; unknown for nodes of earlier versions.
fn generation(node: &RosterRow) -> Option<u32> {
    (!node.router && node.generation > 0).then_some(node.generation)
}

fn table(roster: &RosterPage, now: UnixMillis) -> String {
    let heading =
        ["NODE", "ROLE", "CERTIFICATE", "SECRET", "LAST SEEN", "GROUPS"].map(str::to_owned).to_vec();
    let row = |node: &RosterRow| {
        let secret = match (node.router, generation(node)) {
            (true, _) => "none".to_owned(),
            (false, None) => "?".to_owned(),
            (false, Some(generation)) => generation.to_string(),
        };
        let seen = node.seen.map_or_else(|| "?".to_owned(), |at| at.to_string());
        vec![node.name.clone(), role(node).to_owned(), state(node, now), secret, seen, node.groups.join(", ")]
    };
    let rows: Vec<_> = std::iter::once(heading).chain(roster.nodes.iter().map(row)).collect();
    let mut text = format!("fleet {}, its CA holds until {}", roster.fleet, roster.expires);
    if let Some(authority) = &roster.authority {
        text.push_str(&format!(", renewed by {authority}"));
    }
    if roster.post_quantum {
        text.push_str(", post-quantum");
    }
    if let [_, .., (newest, _)] = &roster.generations[..] {
        text.push_str(&format!(", generation {newest} of the secret is the newest"));
    }
    text.push('\n');
    if !roster.has_roster {
        text.push_str(
            "This file is from before fleets kept a roster: nodes enrolled with it are not known here. Enroll them \
             again, or `sgc fleet adopt` their certificates.",
        );
        return text;
    }
    match roster.nodes.len() {
        0 => text.push_str("No nodes yet: sgc fleet enroll NODE"),
        _ => text.push_str(&output::columns(&rows).join("\n")),
    }
    text
}

fn json(roster: &RosterPage) -> FleetJson<'_> {
    let time = |t: UnixMillis| t.to_string();
    let nodes = roster.nodes.iter().map(|node| NodeJson {
        name: &node.name,
        id: node.id.to_string(),
        groups: &node.groups,
        role: role(node),
        incarnation: node.incarnation,
        expires: node.expires.map(time),
        revoked: node.revoked.map(time),
        secret_generation: generation(node),
        seen: node.seen.map(time),
        certificates: node
            .certificates
            .iter()
            .map(|c| CertificateJson {
                serial: c.serial.iter().map(|b| format!("{b:02x}")).collect(),
                expires: time(c.expires),
                incarnation: c.incarnation,
                revoked: c.revoked.map(time),
            })
            .collect(),
    });
    let generation =
        |(number, made): &(u32, UnixMillis)| GenerationJson { number: *number, created: time(*made) };
    FleetJson {
        fleet: &roster.fleet,
        expires: time(roster.expires),
        authority: roster.authority.as_deref(),
        post_quantum: roster.post_quantum,
        has_roster: roster.has_roster,
        revocation_list: roster.revocation_list,
        secret_generations: roster.generations.iter().map(generation).collect(),
        nodes: nodes.collect(),
    }
}
