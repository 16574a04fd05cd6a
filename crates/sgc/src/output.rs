//! Output of the command line: `sgc-process` prints, and a failure ends the command.

use std::fmt::Display;

pub(crate) use sgc_process::output::{bytes, clean, columns, diagnostic, millis, raw};

use serde::Serialize;
use sgc_process::ProcessError;

use crate::error::CliError;

/// Writes a line of the result.
pub(crate) fn line(text: impl Display) -> Result<(), CliError> {
    Ok(sgc_process::output::line(text)?)
}

/// Writes a result: as JSON on one line if the user asks for it, else as text.
pub(crate) fn result(is_json: bool, value: &impl Serialize, text: impl Display) -> Result<(), CliError> {
    if is_json { json(value) } else { line(text) }
}

/// Writes a line that accompanies a result. With JSON, standard output has the result alone.
pub(crate) fn remark(is_json: bool, text: &str) -> Result<(), CliError> {
    if is_json {
        diagnostic(text);
        return Ok(());
    }
    line(text)
}

/// Writes a result as JSON on one line.
pub(crate) fn json(value: &impl Serialize) -> Result<(), CliError> {
    line(serde_json::to_string(value).map_err(|error| ProcessError::Output(error.into()))?)
}
