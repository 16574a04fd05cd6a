//! `sgc fleet`: makes fleets and enrols nodes.
//!
//! The files stay where they are written; bringing an identity to its machine is the user's.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use clap::{Args, Subcommand};
use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng, TryRngCore};
use sgc_trust::{EnrollRequest, Fleet, FleetName, GroupName, Identity, LEAF_VALIDITY_DEFAULT, NodeName};
use sgc_wire::UnixMillis;
use zeroize::Zeroize;

use crate::error::CliError;
use crate::files::{self, Existing};
use crate::output;

const FLEET_EXTENSION: &str = "fleet";
const DAY: Duration = Duration::from_secs(86_400);

/// Make a fleet, and identities for its nodes.
#[derive(Debug, Args)]
pub(crate) struct FleetArgs {
    #[command(subcommand)]
    command: FleetCommand,
}

#[derive(Debug, Subcommand)]
enum FleetCommand {
    Create(CreateArgs),
    Enroll(EnrollArgs),
}

/// Make a fleet: a certificate authority and a secret, in the file NAME.fleet.
///
/// Whoever holds the file can make nodes of the fleet. It is needed to enrol nodes, not to run them: keep it off them,
/// and keep a copy.
#[derive(Debug, Args)]
struct CreateArgs {
    /// Name of the fleet: a-z, 0-9, '-', '_' and '.'
    name: String,
    /// Where to write the file
    #[arg(long, value_name = "DIR", default_value = ".")]
    dir: PathBuf,
}

/// Make the identity of a node, in one file for that node.
///
/// The file holds the node's private key. Bring it to the node's machine and keep it there with mode 0600.
#[derive(Debug, Args)]
struct EnrollArgs {
    /// Name of the node: a-z, 0-9, '-', '_' and '.'
    node: String,
    /// The fleet; without it, the one *.fleet file of this directory
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    /// A group for the node to be in; may be repeated
    #[arg(long = "group", value_name = "GROUP")]
    groups: Vec<String>,
    /// For a node that only routes: its identity lacks the fleet secret, so that it can read no payload
    #[arg(long)]
    router: bool,
    /// How long the identity is to hold
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..),
          default_value_t = (LEAF_VALIDITY_DEFAULT.as_secs() / DAY.as_secs()) as u32)]
    days: u32,
    /// Where to write the identity [default: NODE.identity]
    #[arg(long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an identity that is there
    #[arg(long)]
    force: bool,
}

/// Runs `sgc fleet`.
pub(crate) fn fleet(args: FleetArgs) -> Result<(), CliError> {
    match args.command {
        FleetCommand::Create(args) => create(&args),
        FleetCommand::Enroll(args) => enroll(&args),
    }
}

/// A generator seeded by the system.
pub(crate) fn system_rng() -> Result<ChaCha20Rng, CliError> {
    let mut seed = [0; 32];
    OsRng.try_fill_bytes(&mut seed).map_err(|e| CliError::System {
        what: "the system gives no randomness",
        source: std::io::Error::other(e.to_string()),
    })?;
    let rng = ChaCha20Rng::from_seed(seed);
    seed.zeroize();
    Ok(rng)
}

/// The time, for certificates.
pub(crate) fn unix_now() -> UnixMillis {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    UnixMillis(u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

fn create(args: &CreateArgs) -> Result<(), CliError> {
    const KEPT: &str = "; a fleet is never overwritten: its nodes would no longer be known";
    let name: FleetName = args.name.parse()?;
    let file = format!("{name}.{FLEET_EXTENSION}");
    let path = if args.dir == Path::new(".") { file.into() } else { args.dir.join(file) };
    let fleet = Fleet::create(name, unix_now(), &mut system_rng()?)
        .map_err(|source| CliError::Fleet { path: path.clone(), source })?;
    files::write_secret(&path, &fleet.to_text(), Existing::Keep(KEPT))?;
    output::line(created_text(&fleet, &path))
}

fn created_text(fleet: &Fleet, path: &Path) -> String {
    let file = path.display();
    let option =
        if path.parent() == Some(Path::new("")) { String::new() } else { format!(" --fleet {file}") };
    format!(
        "{file}: fleet {}, its CA holds until {}\n\
         Keep this file secret and keep a copy of it: whoever holds it can make nodes of the fleet.\n\n\
         Next, an identity for each node, and one for the router:\n  \
         sgc fleet enroll arm-1{option}\n  \
         sgc fleet enroll desk --group operators{option}\n  \
         sgc fleet enroll cloud --router{option}",
        fleet.name(),
        fleet.not_after(),
    )
}

fn enroll(args: &EnrollArgs) -> Result<(), CliError> {
    let node: NodeName = args.node.parse()?;
    let groups = args.groups.iter().map(|g| g.parse()).collect::<Result<Vec<GroupName>, _>>()?;
    let fleet_path = match &args.fleet {
        Some(path) => path.clone(),
        None => fleet_here()?,
    };
    let failed = |source| CliError::Fleet { path: fleet_path.clone(), source };
    let fleet = Fleet::parse(&files::read_fleet(&fleet_path)?).map_err(failed)?;
    let request = EnrollRequest {
        groups,
        router: args.router,
        valid: DAY * args.days,
        ..EnrollRequest::new(node, unix_now())
    };
    let identity = fleet.enroll(&request, &mut system_rng()?).map_err(failed)?;
    let path = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("{}.identity", request.node)));
    let existing = match args.force {
        true => Existing::Replace,
        false => Existing::Keep("; --force replaces it (peers take the new one at once: same node, new key)"),
    };
    files::write_secret(&path, &identity.to_text(), existing)?;
    output::line(enrolled_text(&identity, &request, &path))
}

fn fleet_here() -> Result<PathBuf, CliError> {
    let dir = Path::new(".");
    let found = files::with_extension(dir, FLEET_EXTENSION)
        .map_err(|source| CliError::Read { path: dir.to_owned(), source })?;
    let name = |path: &PathBuf| path.strip_prefix(dir).unwrap_or(path).to_owned();
    match &found[..] {
        [] => Err(CliError::NoFleetHere),
        [only] => Ok(name(only)),
        several => {
            let files = several.iter().map(|p| name(p).display().to_string()).collect();
            Err(CliError::SeveralFleets { files })
        }
    }
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
