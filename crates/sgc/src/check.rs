//! `sgc check`: lists all mistakes of a configuration, or describes the node that would run with it.
//!
//! It reads the configuration and its identity, and binds no socket.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use sgc_diagnosis::check::{WARNING, summary};
use sgc_node::config;
use sgc_process::ProcessError;
use sgc_process::style::{self, Line, Tone, Toned};

use crate::environment::environment;
use crate::error::CliError;
use crate::{files, output};

/// List all mistakes of a configuration, or describe the node that would run with it. Binds no socket.
///
/// Mistakes go to standard error as FILE:LINE: MISTAKE, with exit code 2. The command also checks that the identity is
/// readable by its owner alone, belongs to this node, and is valid today.
#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// Configuration file; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Fleet file that names the fleet's nodes and groups; without it, the one of the fleet that is in this directory,
    /// or beside the configuration or the identity
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    /// Print the description as JSON: a list of texts for each heading
    #[arg(long)]
    json: bool,
}

/// Runs `sgc check`.
pub(crate) fn check(args: &CheckArgs) -> Result<(), CliError> {
    let path = files::config_here(args.config.as_deref())?;
    let what = path.display().to_string();
    let config = config::load(&path, &environment)
        .map_err(|errors| CliError::Config { what: what.clone(), errors })?;
    let identity = sgc_node::check_identity(&config)
        .map_err(|source| CliError::CheckIdentity { what: what.clone(), source })?;
    let summary = summary(&config, &identity, &path, args.fleet.as_deref(), &environment)?;
    if args.json {
        return output::line(json(&summary)?);
    }
    Line::new([format!("{what}: ").into(), Toned::new(Tone::Good, "no mistakes")]).print()?;
    let toned = |row: &Vec<String>| {
        let tone =
            if row.first().is_some_and(|heading| heading == WARNING) { Tone::Attention } else { Tone::Plain };
        row.iter().map(|cell| Toned::new(tone, cell)).collect()
    };
    for line in style::columns(&summary.iter().map(toned).collect::<Vec<_>>()) {
        line.print()?;
    }
    Ok(())
}

/// Returns the description as an object with a list of texts for each heading.
fn json(rows: &[Vec<String>]) -> Result<String, CliError> {
    let mut all: BTreeMap<&str, Vec<&str>> = BTreeMap::new();
    let mut heading = "";
    for row in rows {
        let [kind, text] = &row[..] else { continue };
        // A row without a heading belongs to the one above.
        if !kind.is_empty() {
            heading = kind;
        }
        all.entry(heading).or_default().push(text);
    }
    serde_json::to_string_pretty(&all).map_err(|error| ProcessError::Output(error.into()).into())
}
