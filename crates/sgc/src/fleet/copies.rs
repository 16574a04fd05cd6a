//! `sgc fleet merge`, and the notice of any command that its copy of a fleet file is not the newest.
//!
//! This module detects a second copy and reports it. `sgc-trust` decides which parts of two copies count.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use sgc_node::LockedFleet;
use sgc_process::{ProcessError, unix_now};
use sgc_transport::LinkUrl;
use sgc_trust::{CrlReport, Fleet, MergeReport, NodeName};
use sgc_wire::{CRL_BYTES_MAX, UnixMillis};

use super::heard_lists::say_behind;
use super::keeping::{LIST_EXTENSION, list_path, push_crl, write_list};
use super::{WhichFleet, fleet_here};
use crate::error::CliError;
use crate::{files, output};

/// Merge another copy of the fleet file, or a revocation list, into this one.
///
/// No revocation, enrolment or renewal of either copy is lost. Use only one copy from then on.
#[derive(Debug, Args)]
pub(super) struct MergeArgs {
    /// Other copy of the fleet file, or a revocation list that was made with it (.crl)
    other: PathBuf,
    /// Push the revocation list to this router as well; may be repeated. Nodes of this user on this machine always get
    /// it
    #[arg(long, value_name = "URL")]
    push: Vec<LinkUrl>,
    #[command(flatten)]
    which: WhichFleet,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// The result of `sgc fleet merge` as `--json` shows it.
#[derive(Serialize)]
struct MergeJson<'a> {
    file: String,
    /// Nodes that were not revoked here before.
    revoked: &'a [String],
    enrolled: Vec<&'a str>,
    changed: Vec<&'a str>,
    /// Generations of the secret that are new here.
    secret_generations: &'a [u32],
    /// Generations whose secret here was replaced by that of the other copy.
    replaced_generations: &'a [u32],
    /// The settings of the fleet changed.
    settings: bool,
    /// The other copy lacks something that this one has.
    other_is_behind: bool,
    revocation_list: u64,
    revocation_list_file: String,
    /// Nodes and routers to which the list was pushed.
    pushed_to: &'a [String],
}

pub(super) fn merge(args: &MergeArgs) -> Result<(), CliError> {
    let path = match &args.which.fleet {
        Some(path) => path.clone(),
        None => fleet_here(Some(&args.other))?,
    };
    let mut file = LockedFleet::open(&path)?;
    catch_up(&mut file.fleet, &path)?;
    let now = unix_now();
    let (mine, theirs) = (path.display(), args.other.display());
    let mut text = String::new();
    let (mut gained, mut other_is_behind) = (MergeReport::default(), false);
    if args.other.extension().is_some_and(|e| e == LIST_EXTENSION) {
        let absorbed = take_list(&mut file.fleet, &args.other, now)?;
        text.push_str(&match absorbed.revoked.is_empty() {
            true => format!("{mine}: knows everything that {theirs} does\n"),
            false => format!("{mine}: took over from {theirs}\n  revoked: {}\n", absorbed.revoked.join(", ")),
        });
        gained.revoked = absorbed.revoked;
    } else {
        let mut other = sgc_node::read_fleet(&args.other)?;
        let done = file.fleet.merge(&other, now);
        gained = done.map_err(|source| CliError::Fleet { path: args.other.clone(), source })?;
        text.push_str(&match gained == MergeReport::default() {
            true => format!("{mine}: knows everything that {theirs} does\n"),
            false => format!("{mine}: took over from {theirs}\n{}", gained_text(&gained)),
        });
        let lacked = other.merge(&file.fleet, now).map_err(|source| file.error(source))?;
        other_is_behind = lacked != MergeReport::default();
        if other_is_behind {
            text.push_str(&format!(
                "{theirs} is older or went its own way: put a copy of {mine} in its place.\n"
            ));
        }
    }
    file.save()?;
    let (list_path, list) = write_list(&file, now)?;
    text.push_str(&format!("{}: revocation list {}\n", list_path.display(), file.fleet.crl_number()));
    let pushed = push_crl(&mut file, &list, &args.push)?;
    if !pushed.names.is_empty() {
        text.push_str(&format!("Pushed to {}: nodes pass it on to each other.\n", pushed.names.join(", ")));
    }
    let json = MergeJson {
        file: path.display().to_string(),
        revoked: &gained.revoked,
        enrolled: gained.enrolled.iter().map(NodeName::as_str).collect(),
        changed: gained.changed.iter().map(NodeName::as_str).collect(),
        secret_generations: &gained.generations,
        replaced_generations: &gained.replaced,
        settings: gained.settings,
        other_is_behind,
        revocation_list: file.fleet.crl_number(),
        revocation_list_file: list_path.display().to_string(),
        pushed_to: &pushed.names,
    };
    output::result(args.json, &json, text.trim_end())?;
    pushed.failed.map_or(Ok(()), Err)
}

fn gained_text(gained: &MergeReport) -> String {
    let names = |nodes: &[NodeName]| nodes.iter().map(ToString::to_string).collect::<Vec<_>>();
    let numbers = |numbers: &[u32]| numbers.iter().map(ToString::to_string).collect::<Vec<_>>();
    let mut text = String::new();
    for (what, which) in [
        ("revoked", gained.revoked.clone()),
        ("enrolled", names(&gained.enrolled)),
        ("changed or renewed", names(&gained.changed)),
        ("secret generations", numbers(&gained.generations)),
    ] {
        if !which.is_empty() {
            text.push_str(&format!("  {what}: {}\n", which.join(", ")));
        }
    }
    if gained.settings {
        text.push_str("  authority and post-quantum: as they were set last\n");
    }
    if !gained.replaced.is_empty() {
        text.push_str(&format!(
            "Both copies had made generation {} of the secret, and the later one counts: nodes with the other one find \
             the rest of the fleet when they are renewed.\n",
            numbers(&gained.replaced).join(", ")
        ));
    }
    text
}

/// Takes over the revocations of the list beside a fleet file. Another copy of the file may have made that list; if so,
/// the user is told. Returns `true` if the fleet changed.
pub(super) fn catch_up(fleet: &mut Fleet, file: &Path) -> Result<bool, CliError> {
    let path = list_path(file);
    if !files::exists(&path) {
        return Ok(false);
    }
    match take_list(fleet, &path, unix_now()) {
        Ok(absorbed) => {
            say_behind(file, &path.display().to_string(), &absorbed);
            Ok(absorbed != CrlReport::default())
        }
        // A file that is no list of this fleet must not prevent a revocation. The next list replaces it.
        Err(error @ (CliError::List { .. } | CliError::Process(ProcessError::Read { .. }))) => {
            output::diagnostic(&format!("Note: {error}; it is left out"));
            Ok(false)
        }
        Err(other) => Err(other),
    }
}

/// Takes over the revocations of a list.
fn take_list(fleet: &mut Fleet, path: &Path, now: UnixMillis) -> Result<CrlReport, CliError> {
    let list = files::read_limited(path, CRL_BYTES_MAX as u64)?;
    let anchors = fleet.anchors().with_crl(&list, now);
    let anchors = anchors.map_err(|source| CliError::List { path: path.to_owned(), source })?;
    let absorbed = anchors.map_or(Ok(CrlReport::default()), |anchors| fleet.absorb(&anchors, now));
    absorbed.map_err(|source| CliError::Fleet { path: path.to_owned(), source })
}

/// Tells the user that another copy of the fleet file made a certificate.
pub(super) fn say_unknown(fleet: &Path, identity: &Path) {
    let (fleet, identity) = (fleet.display(), identity.display());
    output::diagnostic(&format!(
        "Note: another copy of {fleet} made the certificate in {identity}, so this copy is not the newest. It knows the \
         certificate now. For what else was done with the other copy, bring it here and run: sgc fleet merge OTHER.fleet"
    ));
}
