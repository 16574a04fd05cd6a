//! `sgc completions` and the man pages: texts that are made of the definition of the command line.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;
use sgc_process::ProcessError;

use crate::error::CliError;
use crate::{command_line, output};

/// Print the completions of a shell, so that Tab completes commands and options.
///
/// Packages install them. Otherwise, `source <(sgc completions bash)` in ~/.bashrc loads them.
#[derive(Debug, Args)]
pub(crate) struct CompletionsArgs {
    /// The shell
    #[arg(value_name = "SHELL")]
    shell: Shell,
}

/// Write the man pages of all commands into a directory.
#[derive(Debug, Args)]
pub(crate) struct ManArgs {
    /// The directory
    #[arg(value_name = "DIR")]
    dir: PathBuf,
}

/// Runs `sgc completions`.
pub(crate) fn completions(args: &CompletionsArgs) -> Result<(), CliError> {
    let mut text = Vec::new();
    let mut command = shown(command_line());
    let name = command.get_name().to_owned();
    clap_complete::generate(args.shell, &mut command, name, &mut text);
    Ok(output::raw(&String::from_utf8_lossy(&text))?)
}

/// Returns a command without the hidden ones below it, which completions would offer.
fn shown(command: Command) -> Command {
    let below: Vec<_> =
        command.get_subcommands().filter(|below| !below.is_hide_set()).cloned().map(shown).collect();
    // Subcommands cannot be removed, so a command of the same arguments gets the shown ones.
    let mut only = Command::new(command.get_name().to_owned()).args(command.get_arguments().cloned());
    only = only.groups(command.get_groups().cloned()).subcommands(below);
    if let Some(version) = command.get_version() {
        only = only.version(version.to_owned());
    }
    match command.get_about() {
        Some(about) => only.about(about.clone()),
        None => only,
    }
}

/// Runs `sgc man`.
pub(crate) fn man(args: &ManArgs) -> Result<(), CliError> {
    let written = clap_mangen::generate_to(command_line(), &args.dir);
    Ok(written.map_err(|source| ProcessError::Write { path: args.dir.clone(), source })?)
}
