//! `sgc check`: lists all mistakes of a configuration, or describes the node that would run with it.
//!
//! It reads the configuration and its identity, and binds no socket.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use sgc_diagnosis::check::{WARNING, summary};
use sgc_node::config::{self, ConfigErrors, Origin};
use sgc_process::ProcessError;
use sgc_process::style::{self, Line, Tone, Toned};

use crate::environment::environment;
use crate::error::{CliError, chain, one_line};
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
    /// Print the description as JSON: a list of texts for each heading. `mistakes` has the mistakes, and is alone if
    /// there are any
    #[arg(long)]
    json: bool,
}

/// A mistake as `--json` shows it.
#[derive(Serialize)]
struct MistakeJson {
    /// `None` if the mistake is in a variable of the environment.
    file: Option<String>,
    /// Counted from 1; `None` if something is missing from the whole file.
    line: Option<usize>,
    mistake: String,
}

#[derive(Serialize)]
struct MistakesJson {
    mistakes: Vec<MistakeJson>,
}

/// Runs `sgc check`.
pub(crate) fn check(args: &CheckArgs) -> Result<(), CliError> {
    let path = files::config_here(args.config.as_deref())?;
    let what = path.display().to_string();
    let config = match config::load(&path, &environment) {
        Ok(config) => config,
        Err(errors) => {
            if args.json {
                output::json(&MistakesJson { mistakes: mistakes(&errors) })?;
            }
            return Err(CliError::Config { what, errors });
        }
    };
    let identity = match sgc_node::check_identity(&config) {
        Ok(identity) => identity,
        Err(source) => {
            if args.json {
                let mistake = one_line(&chain(&source));
                let mistake = MistakeJson { file: Some(what.clone()), line: None, mistake };
                output::json(&MistakesJson { mistakes: vec![mistake] })?;
            }
            return Err(CliError::CheckIdentity { what, source });
        }
    };
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

fn mistakes(errors: &ConfigErrors) -> Vec<MistakeJson> {
    let json = |error: &config::ConfigError| {
        let (file, line) = match &error.origin {
            Origin::File { file, line } => (Some(file.to_string()), *line),
            Origin::Arguments | Origin::Environment => (None, None),
        };
        MistakeJson { file, line, mistake: error.mistake.to_string() }
    };
    errors.iter().map(json).collect()
}

/// Returns the description as an object with a list of texts for each heading, and an empty list of mistakes.
fn json(rows: &[Vec<String>]) -> Result<String, CliError> {
    let mut all: BTreeMap<&str, Vec<&str>> = [("mistakes", Vec::new())].into();
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
