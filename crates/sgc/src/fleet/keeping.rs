//! `sgc fleet list`, `revoke`, `adopt`, `rotate-secret`, `retire-secret`: what a fleet's keeper does over the years.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use clap::Args;
use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_node::LockedFleet;
use sgc_transport::LinkUrl;
use sgc_trust::{EnrollRequest, Fleet, GroupName, NodeName, RosterNode, pem_contents, pem_text};
use sgc_wire::UnixMillis;

use super::{WhichFleet, copies, system_rng, unix_now};
use crate::error::CliError;
use crate::files;
use crate::{output, status};

pub(super) const LIST_EXTENSION: &str = "crl";
/// What the keeper of a fleet calls itself when it tells a router something.
const KEEPER_NAME: &str = "fleet-keeper";
/// For how long that certificate holds.
const KEEPER_VALID: Duration = Duration::from_secs(600);

/// Show the nodes of a fleet: groups, role, until when their certificates hold, and who is revoked.
#[derive(Debug, Args)]
pub(super) struct ListArgs {
    #[command(flatten)]
    which: WhichFleet,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// Print the certificate of a fleet's CA, PEM: no secret, and what partners and their routers trust.
#[derive(Debug, Args)]
pub(super) struct CaArgs {
    #[command(flatten)]
    which: WhichFleet,
}

/// Revoke nodes: all of their certificates, for good.
///
/// Writes the revocation list of the fleet next to its file. Nodes that have it refuse the revoked ones at once and
/// tell it to their neighbours. Without a node the list is written again.
#[derive(Debug, Args)]
pub(super) struct RevokeArgs {
    /// Names of the nodes
    nodes: Vec<String>,
    /// Tell this router, too; repeat for more. Nodes of this user on this machine are told anyway
    #[arg(long = "router", value_name = "URL")]
    routers: Vec<LinkUrl>,
    #[command(flatten)]
    which: WhichFleet,
}

/// Enter a certificate in the roster that was made before the fleet had one, so that it can be revoked.
#[derive(Debug, Args)]
pub(super) struct AdoptArgs {
    /// Name of the node
    node: String,
    /// Its certificate, PEM
    #[arg(long, value_name = "FILE")]
    certificate: PathBuf,
    #[command(flatten)]
    which: WhichFleet,
}

/// Make a new generation of the secret that names are derived from.
///
/// Who has left the fleet can recognise names of shares that were made before, and none that are made later by nodes
/// that have the new secret. Nodes get it when they are renewed.
#[derive(Debug, Args)]
pub(super) struct RotateArgs {
    #[command(flatten)]
    which: WhichFleet,
}

/// Take old generations of the naming secret out of use, once every node has a newer one.
#[derive(Debug, Args)]
pub(super) struct RetireArgs {
    /// Generations before this one
    #[arg(value_name = "GENERATION")]
    before: u32,
    #[command(flatten)]
    which: WhichFleet,
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
    groups: Vec<&'a str>,
    role: &'static str,
    incarnation: u32,
    expires: Option<String>,
    revoked: Option<String>,
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
    let (_, fleet) = args.which.read()?;
    if args.json {
        let json = serde_json::to_string_pretty(&json(&fleet));
        let json = json.map_err(|e| CliError::System { what: "JSON", source: std::io::Error::other(e) })?;
        return output::line(json);
    }
    output::line(table(&fleet, unix_now()))
}

pub(super) fn ca(args: &CaArgs) -> Result<(), CliError> {
    let (_, fleet) = args.which.read()?;
    let text = pem_text("CERTIFICATE", fleet.ca_certificate());
    output::line(text.trim_end())
}

pub(super) fn revoke(args: &RevokeArgs) -> Result<(), CliError> {
    let nodes = args.nodes.iter().map(|n| n.parse()).collect::<Result<Vec<NodeName>, _>>()?;
    let mut file = args.which.open()?;
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
    let told = tell(&mut file, &list, &args.routers)?;
    match told.names.is_empty() {
        true => text.push_str(
            "Nobody was told yet. Tell one node, and all will know:\n  sgc fleet revoke --router quic://…   \
             or, where a node runs:  sgc fleet revoke",
        ),
        false => text.push_str(&format!("Told {}: nodes tell it to each other.", told.names.join(", "))),
    }
    output::line(text)?;
    told.failed.map_or(Ok(()), Err)
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
    output::line(format!("{}: knows this certificate of {node} now", file.path().display()))
}

pub(super) fn rotate(args: &RotateArgs) -> Result<(), CliError> {
    let mut file = args.which.open()?;
    let generation = file.fleet.rotate_secret(unix_now(), &mut system_rng()?);
    let generation = generation.map_err(|e| file.error(e))?;
    file.save()?;
    // An authority that runs here looks into the file again when it is told a list.
    let (_, list) = write_list(&file, unix_now())?;
    tell(&mut file, &list, &[])?;
    output::line(format!(
        "{}: generation {generation} of the naming secret\n\
         Nodes get it when they are renewed (`sgc fleet renew NODE`, or by the authority). Once all have it:\n  \
         sgc fleet retire-secret {generation}",
        file.path().display()
    ))
}

pub(super) fn retire(args: &RetireArgs) -> Result<(), CliError> {
    let mut file = args.which.open()?;
    let done = file.fleet.retire_secrets(args.before);
    done.map_err(|e| file.error(e))?;
    file.save()?;
    let left: Vec<_> = file.fleet.generations().iter().map(|g| g.number.to_string()).collect();
    output::line(format!("{}: generations in use: {}", file.path().display(), left.join(", ")))
}

/// Whom a list was told.
pub(super) struct Told {
    pub(super) names: Vec<String>,
    /// The last router that could not be.
    pub(super) failed: Option<CliError>,
}

/// Tells a list to the nodes that this user runs here and to these routers. What they know besides is taken over: then
/// the list is written once more, and those who were told know it anyway.
pub(super) fn tell(file: &mut LockedFleet, list: &[u8], routers: &[LinkUrl]) -> Result<Told, CliError> {
    let (mut names, mut heard) = status::tell_local(list);
    let mut failed = None;
    if !routers.is_empty() {
        // A certificate for this errand alone; the roster does not know it.
        let keeper = KEEPER_NAME.parse().map_err(CliError::Label)?;
        let request =
            EnrollRequest { router: true, valid: KEEPER_VALID, ..EnrollRequest::new(keeper, unix_now()) };
        let identity = file.fleet.issue(&request, &mut system_rng()?);
        let identity = Arc::new(identity.map_err(CliError::Making)?);
        let runtime = tokio::runtime::Runtime::new();
        let runtime =
            runtime.map_err(|source| CliError::System { what: "the runtime does not start", source })?;
        for url in routers {
            let list = bytes::Bytes::copy_from_slice(list);
            match runtime.block_on(sgc_node::tell_router(url, identity.clone(), list)) {
                Ok(lists) => {
                    names.push(url.to_string());
                    heard.extend(lists);
                }
                Err(source) => failed = Some(CliError::Tell(source)),
            }
        }
    }
    let now = unix_now();
    if copies::take_heard(file, &heard, now)? {
        file.save()?;
        write_list(file, now)?;
    }
    Ok(Told { names, failed })
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

fn role(node: &RosterNode) -> &'static str {
    match (node.router, node.may_route) {
        (true, _) => "router",
        (false, true) => "member, may route",
        (false, false) => "member",
    }
}

fn state(fleet: &Fleet, node: &RosterNode, now: UnixMillis) -> String {
    match (fleet.revoked_at(node), node.expires(fleet.revocation_of(&node.name))) {
        (Some(at), _) => format!("revoked {at}"),
        (None, Some(until)) if until < now => format!("expired {until}"),
        (None, Some(until)) => format!("until {until}"),
        (None, None) => "expired".to_owned(),
    }
}

fn table(fleet: &Fleet, now: UnixMillis) -> String {
    let heading = ["NODE", "ROLE", "CERTIFICATE", "GROUPS"].map(str::to_owned).to_vec();
    let row = |node: &RosterNode| {
        let groups: Vec<_> = node.groups.iter().map(GroupName::as_str).collect();
        vec![node.name.to_string(), role(node).to_owned(), state(fleet, node, now), groups.join(", ")]
    };
    let rows: Vec<_> = std::iter::once(heading).chain(fleet.nodes().map(row)).collect();
    let mut text = format!("fleet {}, its CA holds until {}", fleet.name(), fleet.not_after());
    if let Some(authority) = fleet.authority() {
        text.push_str(&format!(", renewed by {authority}"));
    }
    if fleet.post_quantum() {
        text.push_str(", post-quantum");
    }
    text.push('\n');
    if !fleet.has_roster() {
        text.push_str(
            "This file is from before fleets kept a roster: nodes enrolled with it are not known here. Enroll them \
             again, or `sgc fleet adopt` their certificates.",
        );
        return text;
    }
    match fleet.nodes().len() {
        0 => text.push_str("No nodes yet: sgc fleet enroll NODE"),
        _ => text.push_str(&output::columns(&rows).join("\n")),
    }
    text
}

fn json(fleet: &Fleet) -> FleetJson<'_> {
    let time = |t: UnixMillis| t.to_string();
    let node = |node: &'_ RosterNode| {
        let revocation = fleet.revocation_of(&node.name);
        let certificates = node.certificates.iter().map(|c| CertificateJson {
            serial: c.serial.iter().map(|b| format!("{b:02x}")).collect(),
            expires: time(c.not_after),
            incarnation: c.incarnation,
            revoked: c.revoked_at(revocation).map(time),
        });
        (fleet.node_id_of(&node.name).to_string(), certificates.collect::<Vec<_>>())
    };
    let nodes = fleet.nodes().map(|n| {
        let (id, certificates) = node(n);
        NodeJson {
            name: n.name.as_str(),
            id,
            groups: n.groups.iter().map(GroupName::as_str).collect(),
            role: role(n),
            incarnation: n.incarnation,
            expires: n.expires(fleet.revocation_of(&n.name)).map(time),
            revoked: fleet.revoked_at(n).map(time),
            certificates,
        }
    });
    let generation =
        |g: &sgc_trust::Generation| GenerationJson { number: g.number, created: time(g.created) };
    FleetJson {
        fleet: fleet.name().as_str(),
        expires: time(fleet.not_after()),
        authority: fleet.authority().map(NodeName::as_str),
        post_quantum: fleet.post_quantum(),
        has_roster: fleet.has_roster(),
        revocation_list: fleet.crl_number(),
        secret_generations: fleet.generations().iter().map(generation).collect(),
        nodes: nodes.collect(),
    }
}
