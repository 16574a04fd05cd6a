//! Output of the command line: `sgc-process` prints, and a failure ends the command.

use std::fmt::Display;

pub(crate) use sgc_process::output::{bytes, clean, columns, diagnostic, raw};

use crate::error::CliError;

/// Writes a line of the result.
pub(crate) fn line(text: impl Display) -> Result<(), CliError> {
    Ok(sgc_process::output::line(text)?)
}
