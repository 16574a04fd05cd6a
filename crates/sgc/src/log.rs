//! The log on standard error.

use std::io::IsTerminal;

use crate::error::CliError;
use crate::log_filter::log_filter;

const LOG_VARIABLE: &str = "SGC_LOG";
const LOG_DEFAULT: &str = "info";

/// Starts logging to standard error.
pub(crate) fn start_log(argument: Option<&str>) -> Result<(), CliError> {
    let variable = std::env::var(LOG_VARIABLE).ok().filter(|v| !v.is_empty());
    let (from, value) = match (argument, variable) {
        (Some(value), _) => ("--log", value.to_owned()),
        (None, Some(value)) => (LOG_VARIABLE, value),
        (None, None) => ("--log", LOG_DEFAULT.to_owned()),
    };
    let filter = log_filter(&value).map_err(|reason| CliError::LogFilter { from, value, reason })?;
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .init();
    Ok(())
}
