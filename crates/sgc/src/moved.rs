//! Commands and options under the names that they had before: refused with the new one.

use clap::Args;
use clap::error::{ContextKind, ContextValue, ErrorKind};

use crate::error::CliError;

/// Arguments of a command that has another name now.
#[derive(Debug, Args)]
pub(crate) struct MovedArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _rest: Vec<String>,
}

/// Options that have another name now: the command, the earlier spelling, and the present one.
const MOVED_OPTIONS: [(&str, &str, &str); 9] = [
    ("sgc bench run", "--to", "--connect"),
    ("sgc fleet accept", "--node", "--node-name"),
    ("sgc fleet merge", "--router", "--push"),
    ("sgc fleet revoke", "--router", "--push"),
    ("sgc join", "--wait", "--timeout"),
    ("sgc name", "--node", "--ros-node"),
    ("sgc token share create", "--router", "--via"),
    ("sgc topic pub", "--wait", "--wait-subscribers"),
    ("sgc topic pub", "-w", "--wait-subscribers"),
];

/// Returns the error that names the present option, if clap refused an earlier one of this command.
pub(crate) fn moved_option(error: &clap::Error, called: &str) -> Option<CliError> {
    if error.kind() != ErrorKind::UnknownArgument {
        return None;
    }
    let Some(ContextValue::String(said)) = error.get(ContextKind::InvalidArg) else { return None };
    let (_, old, new) = MOVED_OPTIONS.iter().find(|(command, old, _)| *command == called && old == said)?;
    Some(moved(*old, *new))
}

/// Returns the error that names the new command or option.
pub(crate) fn moved(old: impl Into<String>, new: impl Into<String>) -> CliError {
    CliError::Moved { old: old.into(), new: new.into() }
}
