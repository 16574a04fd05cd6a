//! Files of the command line: those of secrets, and the configuration of this directory.

use std::path::{Path, PathBuf};

use sgc_process::ProcessError;
pub(crate) use sgc_process::files::*;

use crate::error::CliError;

/// Returns the named configuration, or the only one of this directory.
pub(crate) fn config_here(named: Option<&Path>) -> Result<PathBuf, CliError> {
    let dir = Path::new(".");
    let found = match named {
        Some(path) => return Ok(path.to_owned()),
        None => with_extension(dir, "toml")
            .map_err(|source| ProcessError::Read { path: dir.to_owned(), source })?,
    };
    let name = |path: &PathBuf| path.strip_prefix(dir).unwrap_or(path).to_owned();
    match &found[..] {
        [] => Err(CliError::NoConfigHere),
        [only] => Ok(name(only)),
        several => Err(CliError::SeveralConfigs {
            files: several.iter().map(|p| name(p).display().to_string()).collect(),
        }),
    }
}
