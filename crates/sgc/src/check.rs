//! `sgc check`: lists all mistakes of a configuration, or describes the node that would run with it.
//!
//! It reads the configuration and its identity, and binds no socket.

use std::path::PathBuf;

use clap::Args;
use sgc_diagnosis::check::summary;
use sgc_node::config;

use crate::environment::environment;
use crate::error::CliError;
use crate::output;

/// List all mistakes of a configuration, or describe the node that would run with it. Binds no socket.
///
/// Mistakes go to standard error as FILE:LINE: MISTAKE, with exit code 2. The command also checks that the identity is
/// readable by its owner alone, belongs to this node, and is valid today.
#[derive(Debug, Args)]
pub(crate) struct CheckArgs {
    /// Configuration file
    #[arg(short, long, value_name = "FILE")]
    config: PathBuf,
}

/// Runs `sgc check`.
pub(crate) fn check(args: &CheckArgs) -> Result<(), CliError> {
    let what = args.config.display().to_string();
    let config = config::load(&args.config, &environment)
        .map_err(|errors| CliError::Config { what: what.clone(), errors })?;
    let identity = sgc_node::check_identity(&config)
        .map_err(|source| CliError::CheckIdentity { what: what.clone(), source })?;
    output::line(format!("{what}: no mistakes"))?;
    for line in output::columns(&summary(&config, &identity, &args.config, &environment)?) {
        output::line(line)?;
    }
    Ok(())
}
