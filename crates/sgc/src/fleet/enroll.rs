//! `sgc fleet enroll` and `renew`: make identities, with keys made here or by the node.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use clap::Args;
use serde::Serialize;
use sgc_node::LockedFleet;
use sgc_process::{ProcessError, system_rng, unix_now};
use sgc_trust::{
    EnrollRequest, GroupName, Identity, KeyRequest, LEAF_VALIDITY_DEFAULT, Membership, NodeName, pem_contents,
};
use sgc_wire::{Operation, UnixMillis};
use zeroize::Zeroizing;

use super::copies;
use super::remote::{FleetPlace, Remote};
use super::role::AdmitArgs;
use crate::error::CliError;
use crate::files::{self, Existing};
use crate::moved::moved;
use crate::output;
use crate::span::{millis, parse_span};

/// Make the identity of a node, in one file.
///
/// The file holds the node's private key. Bring it to the node's machine and keep it there with mode 0600. If the node
/// made its key itself (`sgc fleet request`), answer its request with --csr: the answer holds no key.
#[derive(Debug, Args)]
pub(super) struct EnrollArgs {
    #[command(flatten)]
    admit: AdmitArgs,
    /// Enrol a revoked node again
    #[arg(long)]
    again: bool,
    /// Answer this request, which the node made with `sgc fleet request`
    #[arg(long, value_name = "FILE")]
    csr: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

/// Renew a node's certificate, with the same groups and role.
///
/// An existing identity file keeps its key. Without such a file and without a request (--csr), the node gets a new key.
#[derive(Debug, Args)]
pub(super) struct RenewArgs {
    /// Name of the node
    node: String,
    #[command(flatten)]
    place: FleetPlace,
    /// Answer this request, which the node made with `sgc fleet request`
    #[arg(long, value_name = "FILE")]
    csr: Option<PathBuf>,
    #[command(flatten)]
    output: OutputArgs,
}

#[derive(Debug, Args)]
struct OutputArgs {
    /// How long the certificate is valid, such as 90d or 12h [default: 90d]
    #[arg(long, value_name = "TIME", value_parser = parse_span)]
    valid: Option<Duration>,
    #[arg(long, value_name = "N", hide = true)]
    days: Option<String>,
    /// File to write [default: NODE.identity, or NODE.answer with --csr]
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// A written identity, or the answer to a request, as `--json` shows it.
#[derive(Serialize)]
struct CertifiedJson<'a> {
    file: String,
    node: &'a str,
    fleet: &'a str,
    /// The end of the certificate; `None` for the answer to a request.
    expires: Option<String>,
    /// Whether the file has the private key; the answer to a request has none.
    has_key: bool,
}

impl<'a> CertifiedJson<'a> {
    fn identity(path: &Path, identity: &'a Identity) -> Self {
        Self {
            file: path.display().to_string(),
            node: identity.node_name().as_str(),
            fleet: identity.fleet_name().as_str(),
            expires: Some(identity.not_after().to_string()),
            has_key: true,
        }
    }

    fn answer(path: &Path, member: &'a Membership) -> Self {
        Self {
            file: path.display().to_string(),
            node: member.node_name().as_str(),
            fleet: member.fleet_name().as_str(),
            expires: None,
            has_key: false,
        }
    }
}

impl OutputArgs {
    fn valid(&self) -> Result<Duration, CliError> {
        match &self.days {
            Some(days) => Err(moved(format!("--days {days}"), format!("--valid {days}d"))),
            None => Ok(self.valid.unwrap_or(LEAF_VALIDITY_DEFAULT)),
        }
    }

    fn path(&self, node: &NodeName, extension: &str) -> PathBuf {
        self.out.clone().unwrap_or_else(|| PathBuf::from(format!("{node}.{extension}")))
    }

    fn existing(&self) -> Existing {
        match self.force {
            true => Existing::Replace,
            false => {
                Existing::Keep("; --force replaces it (peers take the new one at once: same node, new key)")
            }
        }
    }

    /// Fails if the file exists and may not be replaced. Runs before the roster records a certificate that would then
    /// be lost.
    fn check_free(&self, path: &Path) -> Result<(), CliError> {
        match self.existing() {
            Existing::Keep(hint) if files::exists(path) => {
                Err(ProcessError::Exists { path: path.to_owned(), hint }.into())
            }
            _ => Ok(()),
        }
    }
}

/// The issuer of certificates: a fleet file here, or the authority.
enum Keeper {
    File(LockedFleet),
    Authority(Remote),
}

impl Keeper {
    fn open(place: &FleetPlace) -> Result<Self, CliError> {
        match place.remote()? {
            Some(remote) => Ok(Self::Authority(remote)),
            None => Ok(Self::File(place.which.open()?)),
        }
    }

    /// Enrols a node. The roster records it first, because only recorded certificates can be revoked.
    fn enroll(&mut self, csr: &[u8], request: &EnrollRequest) -> Result<Membership, CliError> {
        match self {
            Self::File(file) => {
                let member = file.fleet.enroll_csr(csr, request, &mut system_rng()?);
                let member = member.map_err(|e| file.error(e))?;
                file.save()?;
                Ok(member)
            }
            Self::Authority(remote) => remote.certify(Operation::Enroll {
                node: request.node.to_string(),
                groups: request.groups.iter().map(ToString::to_string).collect(),
                router: request.router,
                may_route: request.may_route,
                again: request.again,
                valid_ms: millis(request.valid),
                csr: Bytes::copy_from_slice(csr),
            }),
        }
    }

    /// Makes another certificate for a node, in its groups and with its role.
    fn renew(&mut self, csr: &[u8], node: &NodeName, valid: Duration) -> Result<Membership, CliError> {
        match self {
            Self::File(file) => {
                let member = file.fleet.renew_member(csr, node, valid, unix_now(), &mut system_rng()?);
                let member = member.map_err(|e| file.error(e))?;
                file.save()?;
                Ok(member)
            }
            Self::Authority(remote) => remote.certify(Operation::Renew {
                node: node.to_string(),
                valid_ms: millis(valid),
                csr: Bytes::copy_from_slice(csr),
            }),
        }
    }
}

pub(super) fn enroll(args: &EnrollArgs) -> Result<(), CliError> {
    let request = args.admit.request(args.again, args.output.valid()?)?;
    let mut keeper = Keeper::open(&args.admit.place)?;
    if let Some(csr) = &args.csr {
        let path = args.output.path(&request.node, "answer");
        args.output.check_free(&path)?;
        let member = keeper.enroll(&read_csr(csr)?, &request)?;
        files::write_secret(&path, &member.to_text(), args.output.existing())?;
        let text = answered_text(&request.node, &path);
        return output::result(args.output.json, &CertifiedJson::answer(&path, &member), text);
    }
    let path = args.output.path(&request.node, "identity");
    args.output.check_free(&path)?;
    let key = new_key()?;
    let member = keeper.enroll(key.csr(), &request)?;
    let identity = with_key(member, &key, &path)?;
    files::write_secret(&path, &identity.to_text(), args.output.existing())?;
    let text = enrolled_text(&identity, &request, &path);
    output::result(args.output.json, &CertifiedJson::identity(&path, &identity), text)
}

pub(super) fn renew(args: &RenewArgs) -> Result<(), CliError> {
    let node: NodeName = args.node.parse()?;
    let mut keeper = Keeper::open(&args.place)?;
    let valid = args.output.valid()?;
    if let Some(csr) = &args.csr {
        let path = args.output.path(&node, "answer");
        args.output.check_free(&path)?;
        let member = keeper.renew(&read_csr(csr)?, &node, valid)?;
        files::write_secret(&path, &member.to_text(), args.output.existing())?;
        let text = answered_text(&node, &path);
        return output::result(args.output.json, &CertifiedJson::answer(&path, &member), text);
    }
    let path = args.output.path(&node, "identity");
    let old = if files::exists(&path) { Some(sgc_node::load_identity(&path)?) } else { None };
    let is_of_node = |old: &Identity| match &keeper {
        Keeper::File(file) => old.node_id() == file.fleet.node_id_of(&node),
        Keeper::Authority(_) => *old.node_name() == node,
    };
    let new = match old.filter(|old| !args.output.force && is_of_node(old)) {
        Some(old) => {
            if let Keeper::File(file) = &mut keeper {
                let done = file.fleet.recognize(old.as_peer(), unix_now());
                if done.map_err(|e| file.error(e))? {
                    copies::say_unknown(file.path(), &path);
                }
            }
            let member = keeper.renew(&old.csr(), &node, valid)?;
            old.with_membership(member).map_err(|source| CliError::Identity { path: path.clone(), source })?
        }
        None => {
            args.output.check_free(&path)?;
            let key = new_key()?;
            with_key(keeper.renew(key.csr(), &node, valid)?, &key, &path)?
        }
    };
    files::write_secret(&path, &new.to_text(), Existing::Replace)?;
    let text = renewed_text(&path, &node, new.not_after());
    output::result(args.output.json, &CertifiedJson::identity(&path, &new), text)
}

/// Makes a key for a node here, so that no authority ever has it.
fn new_key() -> Result<KeyRequest, CliError> {
    KeyRequest::generate(None, &mut system_rng()?).map_err(CliError::Making)
}

fn with_key(member: Membership, key: &KeyRequest, path: &Path) -> Result<Identity, CliError> {
    Identity::join(member, key.key(), &mut system_rng()?)
        .map_err(|source| CliError::Identity { path: path.to_owned(), source })
}

fn read_csr(path: &Path) -> Result<Zeroizing<Vec<u8>>, CliError> {
    let text = files::read_public(path)?;
    let labels = ["CERTIFICATE REQUEST", "NEW CERTIFICATE REQUEST"];
    let found =
        pem_contents(&text, &labels).map_err(|source| CliError::Pem { path: path.to_owned(), source })?;
    found.into_iter().next().ok_or_else(|| CliError::NotInFile {
        path: path.to_owned(),
        what: "request for a certificate",
        hint: "on the node's machine, `sgc fleet request NODE` makes one",
    })
}

fn answered_text(node: &NodeName, path: &Path) -> String {
    let file = path.display();
    format!(
        "{file}: answer for {node}, without a private key\n\
         It holds secrets of the fleet: bring it to the node's machine on a safe way. Then, there:\n  \
         sgc fleet accept {file}"
    )
}

fn renewed_text(path: &Path, node: &NodeName, not_after: UnixMillis) -> String {
    let file = path.display();
    format!(
        "{file}: node {node}, holds until {not_after}\nBring it to that node's machine, in place of the file there: a \
         running node takes it at once, or by `sgc reload`."
    )
}

fn enrolled_text(identity: &Identity, request: &EnrollRequest, path: &Path) -> String {
    let file = path.display();
    let mut text = format!("{file}: ");
    let _ = write!(text, "{} {}", if request.router { "router" } else { "node" }, request.node);
    let _ = write!(text, " of fleet {}", identity.fleet_name());
    if !request.groups.is_empty() {
        let groups: Vec<_> = request.groups.iter().map(GroupName::as_str).collect();
        let _ = write!(text, ", in {}", groups.join(", "));
    }
    let _ = writeln!(text, ", holds until {}", identity.not_after());
    let _ = writeln!(text, "Bring it to that node's machine and keep it there, with mode 0600. Then, there:");
    let command = if request.router {
        format!("sgc router --identity {file} --listen quic://0.0.0.0:7447")
    } else {
        format!("sgc run --identity {file} --router quic://ROUTER --share /TOPIC --to NODE --use NODE:/TOPIC")
    };
    let _ = write!(text, "  {command}");
    text
}
