//! The log on standard error.

use std::io::IsTerminal;

use clap::ValueEnum;

use crate::error::CliError;
use crate::log_filter::log_filter;

const LOG_VARIABLE: &str = "SGC_LOG";
const FORMAT_VARIABLE: &str = "SGC_LOG_FORMAT";
const LOG_DEFAULT: &str = "info";
const JOURNAL_VARIABLE: &str = "JOURNAL_STREAM";

/// The form of the log.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum LogFormat {
    /// A line of text for each event
    Text,
    /// A JSON object for each event, in a line of its own
    Json,
}

/// Starts logging to standard error, with the values of `--log` and `--log-format`, if they are given.
pub(crate) fn start_log(argument: Option<&str>, format: Option<LogFormat>) -> Result<(), CliError> {
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
    match log_format(format)? {
        LogFormat::Json => log.json().flatten_event(true).with_span_list(false).init(),
        LogFormat::Text if is_journal() => log.without_time().init(),
        LogFormat::Text => log.init(),
    }
    Ok(())
}

/// Returns the form of the log: that of the argument, or else of the variable.
fn log_format(argument: Option<LogFormat>) -> Result<LogFormat, CliError> {
    let variable = std::env::var(FORMAT_VARIABLE).ok().filter(|value| !value.is_empty());
    match (argument, variable) {
        (Some(format), _) => Ok(format),
        (None, None) => Ok(LogFormat::Text),
        (None, Some(value)) => LogFormat::from_str(&value, false).map_err(|_| CliError::LogFormat { value }),
    }
}

/// Returns `true` if standard error is the journal of systemd (`JOURNAL_STREAM`, systemd.exec(5)), which has the time of
/// each line.
fn is_journal() -> bool {
    let Ok(journal) = std::env::var(JOURNAL_VARIABLE) else { return false };
    rustix::fs::fstat(std::io::stderr())
        .is_ok_and(|file| journal == format!("{}:{}", file.st_dev, file.st_ino))
}
