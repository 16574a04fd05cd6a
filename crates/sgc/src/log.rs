//! The log on standard error.

use std::io::IsTerminal;

use crate::error::CliError;
use crate::log_filter::log_filter;

const LOG_VARIABLE: &str = "SGC_LOG";
const LOG_DEFAULT: &str = "info";
const JOURNAL_VARIABLE: &str = "JOURNAL_STREAM";

/// Starts logging to standard error.
pub(crate) fn start_log(argument: Option<&str>) -> Result<(), CliError> {
    let variable = std::env::var(LOG_VARIABLE).ok().filter(|v| !v.is_empty());
    let (from, value) = match (argument, variable) {
        (Some(value), _) => ("--log", value.to_owned()),
        (None, Some(value)) => (LOG_VARIABLE, value),
        (None, None) => ("--log", LOG_DEFAULT.to_owned()),
    };
    let filter = log_filter(&value).map_err(|reason| CliError::LogFilter { from, value, reason })?;
    let log = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal());
    if is_journal() {
        log.without_time().init()
    } else {
        log.init()
    }
    Ok(())
}

/// Returns `true` if standard error is the journal of systemd (`JOURNAL_STREAM`, systemd.exec(5)), which has the time of
/// each line.
fn is_journal() -> bool {
    let Ok(journal) = std::env::var(JOURNAL_VARIABLE) else { return false };
    rustix::fs::fstat(std::io::stderr())
        .is_ok_and(|file| journal == format!("{}:{}", file.st_dev, file.st_ino))
}
