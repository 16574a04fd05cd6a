//! `sgc reload`: asks a running node to read its configuration again.
//!
//! The node checks and applies the configuration; this module asks for it and prints the answer.

use std::path::Path;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde::Deserialize;
use sgc_diagnosis::{DiagnosisError, ask};
use sgc_node::admin::AdminRequest;

use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::output;

/// Longest time a node may take to read files and to change its shares.
const ANSWER_MAX: Duration = Duration::from_secs(30);

/// Let a running node read its configuration again, without a restart.
///
/// The node checks the whole file first. If the file has a mistake, nothing changes; otherwise the node applies the
/// differences. Exit code 1 means that it refused the file, or that a change needs a restart. SIGHUP does the same and
/// logs the result.
#[derive(Debug, Args)]
pub(crate) struct ReloadArgs {
    #[command(flatten)]
    node: NodeArgs,
    /// Print the answer as JSON
    #[arg(long)]
    json: bool,
}

/// A node's answer.
#[derive(Debug, Deserialize)]
enum Answer {
    #[serde(rename = "ok")]
    Done(serde_json::Value),
    #[serde(rename = "error")]
    Refused(String),
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Report {
    changed: Vec<String>,
    needs_restart: Vec<String>,
    warnings: Vec<String>,
}

/// Runs `sgc reload`.
pub(crate) fn reload(args: &ReloadArgs) -> Result<ExitCode, CliError> {
    let socket = args.node.socket()?;
    let report = ask(&socket)?;
    let is_pending =
        report.get("needs_restart").and_then(|lines| lines.as_array()).is_some_and(|lines| !lines.is_empty());
    if args.json {
        output::line(report)?;
    } else {
        lines(report, "nothing changed").into_iter().try_for_each(output::line)?;
    }
    Ok(if is_pending { EXIT_FAILURE.into() } else { ExitCode::SUCCESS })
}

/// Asks the node at this socket to read its configuration again, if one runs there. Returns the lines that report the
/// result.
pub(crate) fn after_change(socket: &Path) -> Result<Vec<String>, CliError> {
    match ask(socket) {
        Ok(report) => Ok(lines(report, "The node that runs knows it.")),
        Err(CliError::Diagnosis(DiagnosisError::NoNode { .. })) => {
            Ok(vec!["The node does not run; it counts from its next start.".to_owned()])
        }
        Err(error) => Err(error),
    }
}

fn ask(socket: &Path) -> Result<serde_json::Value, CliError> {
    let text = ask::ask(socket, &AdminRequest::Reload, ANSWER_MAX)?;
    match serde_json::from_str(&text) {
        Ok(Answer::Done(report)) => Ok(report),
        Ok(Answer::Refused(reason)) => Err(CliError::NodeRefused { path: socket.to_owned(), reason }),
        Err(_) => Err(DiagnosisError::NotAStatus {
            path: socket.to_owned(),
            reason: "it does not know `reload`: it is of an earlier version; restart it".to_owned(),
        }
        .into()),
    }
}

/// Returns the lines of a report, or `unchanged` if the configuration has not changed.
fn lines(report: serde_json::Value, unchanged: &str) -> Vec<String> {
    let Report { changed, needs_restart, warnings } = serde_json::from_value(report).unwrap_or_default();
    let mut lines = changed;
    if lines.is_empty() && needs_restart.is_empty() {
        lines.push(unchanged.to_owned());
    }
    lines.extend(needs_restart);
    lines.extend(warnings);
    lines
}
