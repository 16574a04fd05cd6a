//! Commands and options under the names that they had before: refused with the new one.

use clap::Args;

use crate::error::CliError;

/// Arguments of a command that has another name now.
#[derive(Debug, Args)]
pub(crate) struct MovedArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, hide = true)]
    _rest: Vec<String>,
}

/// Returns the error that names the new command or option.
pub(crate) fn moved(old: impl Into<String>, new: impl Into<String>) -> CliError {
    CliError::Moved { old: old.into(), new: new.into() }
}
