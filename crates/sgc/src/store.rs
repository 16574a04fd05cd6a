//! `sgc router store check`: says whether the store of names of a router fits.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Subcommand};
use serde::Serialize;
use sgc_node::config;
use sgc_process::ProcessError;
use sgc_process::style::{Line, Tone, Toned};
use sgc_store::{Severity, StoreFinding, check};

use crate::environment::environment;
use crate::error::CliError;
use crate::{files, output};

/// The store of names of a router
#[derive(Debug, Args)]
pub(crate) struct StoreArgs {
    #[command(subcommand)]
    command: StoreCommand,
}

#[derive(Debug, Subcommand)]
enum StoreCommand {
    Check(StoreCheckArgs),
}

/// Say whether the store of a router's configuration fits: version, cluster, memory, rights, latency
///
/// It uses the store as a router does, with two keys that it removes again. Exit code 1 means that something has to be
/// mended.
#[derive(Debug, Args)]
struct StoreCheckArgs {
    /// Configuration file of the router; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The findings as `--json` shows them.
#[derive(Serialize)]
struct ReportJson {
    /// Whether nothing has to be mended.
    fits: bool,
    findings: Vec<FindingJson>,
}

#[derive(Serialize)]
struct FindingJson {
    /// `"ok"`, `"warning"` or `"error"`.
    severity: &'static str,
    finding: String,
    fix: Option<String>,
}

/// Runs `sgc router store`.
pub(crate) fn store(args: &StoreArgs) -> Result<ExitCode, CliError> {
    let StoreCommand::Check(args) = &args.command;
    let path = files::config_here(args.config.as_deref())?;
    let what = path.display().to_string();
    let config = config::load(&path, &environment)
        .map_err(|errors| CliError::Config { what: what.clone(), errors })?;
    let settings = config.store.ok_or(CliError::NoStore { what })?;
    let store = sgc_node::load_store(&settings)?;
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|source| ProcessError::System { what: "cannot start threads", source })?;
    let report = runtime.block_on(check(store));
    let fits = report.severity() < Severity::Error;
    if args.json {
        let findings = report.findings.iter().map(json).collect();
        output::json(&ReportJson { fits, findings })?;
    } else {
        for finding in &report.findings {
            print(finding)?;
        }
    }
    Ok(if fits { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn json(finding: &StoreFinding) -> FindingJson {
    let severity = match finding.severity() {
        Severity::Fits => "ok",
        Severity::Warning => "warning",
        Severity::Error => "error",
    };
    FindingJson { severity, finding: finding.to_string(), fix: finding.fix() }
}

fn print(finding: &StoreFinding) -> Result<(), CliError> {
    let (tone, heading) = match finding.severity() {
        Severity::Fits => (Tone::Good, "ok       "),
        Severity::Warning => (Tone::Attention, "warning  "),
        Severity::Error => (Tone::Bad, "error    "),
    };
    Line::new([Toned::new(tone, heading), output::clean(&finding.to_string()).as_str().into()]).print()?;
    if let Some(fix) = finding.fix() {
        Line::new([Toned::from("  fix: "), output::clean(&fix).as_str().into()]).print()?;
    }
    Ok(())
}
