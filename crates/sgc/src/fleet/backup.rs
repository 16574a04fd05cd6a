//! `sgc fleet backup` and `restore`: a copy of the fleet file that is whole, and the file from a copy.

use std::io::{IsTerminal as _, Read as _};
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use sgc_node::LockedFleet;
use sgc_process::{ProcessError, unix_now};
use sgc_trust::{FLEET_FILE_BYTES_MAX, Fleet, NodeName};
use sgc_wire::UnixMillis;
use zeroize::Zeroizing;

use super::WhichFleet;
use crate::error::CliError;
use crate::files::{self, Existing};
use crate::output;

/// Extension of copies. It is not that of fleet files, so that no command takes a copy for the file.
const BACKUP_EXTENSION: &str = "fleet-backup";
const STANDARD_STREAM: &str = "-";

/// Copy the fleet file: whole, also while other commands change it.
///
/// The copy is as secret as the file. To keep it elsewhere, encrypt it:  sgc fleet backup - | age -p > lab.age
#[derive(Debug, Args)]
pub(super) struct BackupArgs {
    /// File to write, or - for standard output [default: FLEET-DATE.fleet-backup]
    out: Option<PathBuf>,
    #[command(flatten)]
    which: WhichFleet,
    /// Replace an existing file
    #[arg(long)]
    force: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Make the fleet file from a copy, where there is none.
///
/// A copy that is encrypted comes by standard input:  age -d lab.age | sgc fleet restore -
#[derive(Debug, Args)]
pub(super) struct RestoreArgs {
    /// Copy that `sgc fleet backup` made, or - for standard input
    backup: PathBuf,
    /// Fleet file to make [default: FLEET.fleet]
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// A written copy, or the file that was made from one, as `--json` shows it.
#[derive(Serialize)]
struct CopyJson<'a> {
    file: String,
    fleet: &'a str,
    /// Number of nodes in the roster.
    nodes: usize,
    /// The time of the last change.
    changed: String,
    /// Nodes whose open invitations ended, because a copy does not know whether they were used.
    ended_invitations: Vec<&'a str>,
}

impl<'a> CopyJson<'a> {
    fn new(path: &Path, fleet: &'a Fleet, invited: &'a [NodeName]) -> Self {
        Self {
            file: path.display().to_string(),
            fleet: fleet.name().as_str(),
            nodes: fleet.nodes().len(),
            changed: changed(fleet).to_string(),
            ended_invitations: invited.iter().map(NodeName::as_str).collect(),
        }
    }
}

pub(super) fn backup(args: &BackupArgs) -> Result<(), CliError> {
    // The lock keeps other programs from writing meanwhile. It is not held while a program behind a pipe takes its time.
    let fleet = LockedFleet::open(&args.which.path()?)?.fleet;
    let text = fleet.to_text();
    if args.out.as_deref() == Some(Path::new(STANDARD_STREAM)) {
        if args.json {
            return Err(CliError::Cannot {
                reason: "the copy goes to standard output: leave --json out, or name a file".to_owned(),
            });
        }
        if std::io::stdout().is_terminal() {
            return Err(CliError::Cannot {
                reason: "the copy is a secret, and standard output is a terminal: name a file, or a program behind a |"
                    .to_owned(),
            });
        }
        return output::line(text.trim_end());
    }
    let today: String = unix_now().to_string().chars().take_while(|c| *c != 'T').collect();
    let default = || PathBuf::from(format!("{}-{today}.{BACKUP_EXTENSION}", fleet.name()));
    let out = args.out.clone().unwrap_or_else(default);
    let existing = if args.force { Existing::Replace } else { Existing::Keep("; --force replaces it") };
    files::write_secret(&out, &text, existing)?;
    let text = format!("{}: {}", out.display(), content_text(&fleet));
    output::result(args.json, &CopyJson::new(&out, &fleet, &[]), text)
}

pub(super) fn restore(args: &RestoreArgs) -> Result<(), CliError> {
    let text = match args.backup == Path::new(STANDARD_STREAM) {
        true => read_standard_input()?,
        false => files::read_secret(&args.backup, "a copy of a fleet file")?,
    };
    let failed = |source| CliError::Fleet { path: args.backup.clone(), source };
    let mut fleet = Fleet::parse(&text).map_err(failed)?;
    let invited = fleet.end_invitations(unix_now()).map_err(failed)?;
    let path = args.fleet.clone().unwrap_or_else(|| PathBuf::from(format!("{}.fleet", fleet.name())));
    let hint = "; what it lacks comes from a copy by `sgc fleet merge COPY`";
    files::write_secret(&path, &fleet.to_text(), Existing::Keep(hint))?;
    let text = format!(
        "{}: {}\nNodes that were enrolled after the copy was made are not in it: they run on, and cannot be renewed or \
         revoked until `sgc fleet adopt NODE --certificate NODE.identity` enters them. Later revocations stay in force: \
         `sgc fleet merge LIST.crl`, or the start of the authority, brings them here.{}",
        path.display(),
        content_text(&fleet),
        ended_text(&invited)
    );
    output::result(args.json, &CopyJson::new(&path, &fleet, &invited), text)
}

/// Tells which invitations ended. A copy does not know whether they were used.
fn ended_text(invited: &[NodeName]) -> String {
    if invited.is_empty() {
        return String::new();
    }
    let nodes: Vec<_> = invited.iter().map(NodeName::as_str).collect();
    format!("\nCodes for these nodes were open when the copy was made, and end now: {}", nodes.join(", "))
}

fn read_standard_input() -> Result<Zeroizing<String>, CliError> {
    let unreadable = |source| ProcessError::Read { path: PathBuf::from("standard input"), source };
    // Capacity up front: a growing text leaves copies of the secrets behind.
    let mut text = Zeroizing::new(String::with_capacity(FLEET_FILE_BYTES_MAX));
    std::io::stdin().take(FLEET_FILE_BYTES_MAX as u64).read_to_string(&mut text).map_err(unreadable)?;
    Ok(text)
}

/// Describes a fleet, and how old its roster is.
fn content_text(fleet: &Fleet) -> String {
    format!("fleet {}, {} nodes, last changed {}", fleet.name(), fleet.nodes().len(), changed(fleet))
}

/// Returns the time of the last change of a fleet.
fn changed(fleet: &Fleet) -> UnixMillis {
    let changes = fleet.nodes().flat_map(|node| [Some(node.changed), node.seen]).flatten();
    let made = fleet.generations().iter().map(|generation| generation.created);
    changes.chain(made).max().unwrap_or(UnixMillis(0))
}
