//! `sgc fleet`: makes fleets, enrols, renews and revokes their nodes, and shows how they are doing.
//!
//! The files stay where they are written; the user brings them to their machines. `sgc-trust` defines their content.

mod backup;
mod copies;
mod create;
mod enroll;
mod heard_lists;
mod invite;
mod join;
mod keeping;
mod looking;
mod own_key;
mod remote;
mod role;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, Subcommand};
use sgc_diagnosis::check::FLEET_EXTENSION;
use sgc_node::LockedFleet;
use sgc_process::ProcessError;
use sgc_trust::Fleet;

pub(crate) use self::join::{JoinArgs, join};
pub(crate) use self::looking::members_of_file;
pub(crate) use self::remote::revoke_by_authority;
use crate::error::CliError;
use crate::files;

/// Make a fleet, enrol, renew and revoke its nodes, and show how they are doing.
#[derive(Debug, Args)]
pub(crate) struct FleetArgs {
    #[command(subcommand)]
    command: FleetCommand,
}

#[derive(Debug, Subcommand)]
enum FleetCommand {
    Create(create::CreateArgs),
    Import(create::ImportArgs),
    Enroll(enroll::EnrollArgs),
    Invite(invite::InviteArgs),
    Request(own_key::RequestArgs),
    Extensions(own_key::ExtensionsArgs),
    Accept(own_key::AcceptArgs),
    List(keeping::ListArgs),
    Status(looking::StatusArgs),
    Why(looking::WhyArgs),
    Ca(keeping::CaArgs),
    Renew(enroll::RenewArgs),
    Revoke(keeping::RevokeArgs),
    Merge(copies::MergeArgs),
    Backup(backup::BackupArgs),
    Restore(backup::RestoreArgs),
    Adopt(keeping::AdoptArgs),
    RotateSecret(keeping::RotateArgs),
    RetireSecret(keeping::RetireArgs),
    Set(create::SetArgs),
}

/// Runs `sgc fleet`.
pub(crate) fn fleet(args: FleetArgs) -> Result<ExitCode, CliError> {
    let done = match args.command {
        FleetCommand::Why(args) => return looking::why(&args),
        FleetCommand::Status(args) => looking::status(&args),
        FleetCommand::Create(args) => create::create(&args),
        FleetCommand::Import(args) => create::import(&args),
        FleetCommand::Enroll(args) => enroll::enroll(&args),
        FleetCommand::Invite(args) => invite::invite(&args),
        FleetCommand::Request(args) => own_key::request(&args),
        FleetCommand::Extensions(args) => own_key::extensions(&args),
        FleetCommand::Accept(args) => own_key::accept(&args),
        FleetCommand::List(args) => keeping::list(&args),
        FleetCommand::Ca(args) => keeping::ca(&args),
        FleetCommand::Renew(args) => enroll::renew(&args),
        FleetCommand::Revoke(args) => keeping::revoke(&args),
        FleetCommand::Merge(args) => copies::merge(&args),
        FleetCommand::Backup(args) => backup::backup(&args),
        FleetCommand::Restore(args) => backup::restore(&args),
        FleetCommand::Adopt(args) => keeping::adopt(&args),
        FleetCommand::RotateSecret(args) => keeping::rotate(&args),
        FleetCommand::RetireSecret(args) => keeping::retire(&args),
        FleetCommand::Set(args) => create::set(&args),
    };
    done.map(|()| ExitCode::SUCCESS)
}

/// The fleet of a command.
#[derive(Debug, Args)]
struct WhichFleet {
    /// Fleet file; without it, the only *.fleet file of this directory
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
}

impl WhichFleet {
    fn path(&self) -> Result<PathBuf, CliError> {
        match &self.fleet {
            Some(path) => Ok(path.clone()),
            None => fleet_here(None),
        }
    }

    /// Reads the fleet file without a lock.
    fn read(&self) -> Result<(PathBuf, Fleet), CliError> {
        let path = self.path()?;
        let mut fleet = sgc_node::read_fleet(&path)?;
        copies::catch_up(&mut fleet, &path)?;
        Ok((path, fleet))
    }

    /// Opens the fleet file for changes. Takes over the revocations of the list beside it.
    fn open(&self) -> Result<LockedFleet, CliError> {
        let mut file = LockedFleet::open(&self.path()?)?;
        let path = file.path().to_owned();
        if copies::catch_up(&mut file.fleet, &path)? {
            file.save()?;
        }
        Ok(file)
    }
}

/// Returns the only fleet file of this directory, apart from `other`.
fn fleet_here(other: Option<&Path>) -> Result<PathBuf, CliError> {
    let dir = Path::new(".");
    let mut found = files::with_extension(dir, FLEET_EXTENSION)
        .map_err(|source| ProcessError::Read { path: dir.to_owned(), source })?;
    found.retain(|path| {
        other.is_none_or(|other| path.file_name() != other.file_name() || is_elsewhere(other))
    });
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

/// Returns `true` if the path names another directory than this one.
fn is_elsewhere(path: &Path) -> bool {
    path.parent().is_some_and(|parent| parent != Path::new("") && parent != Path::new("."))
}

/// Returns the `--fleet FILE` that a hint has to repeat, or nothing if the fleet is found without it.
fn fleet_option(path: &Path) -> String {
    match path.parent() == Some(Path::new("")) {
        true => String::new(),
        false => format!(" --fleet {}", path.display()),
    }
}
