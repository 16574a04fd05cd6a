//! Reads configuration files from the disk, and checks the files that they name.
//!
//! `sgc-config` turns their text into a [`Config`]. The node checks the content of the identity file when it opens it.

pub(crate) mod files;

use std::fs;
use std::io::{self, Read};
use std::path::Path;
use std::sync::Arc;

pub use sgc_config::*;

/// The largest file that is read as a configuration: 1024 shares with all their metadata fit.
pub const CONFIG_BYTES_MAX: u64 = 4 * 1024 * 1024;

/// Reads and resolves a file, and checks that the identity file exists, is readable, and is its owner's alone.
///
/// Relative paths are resolved against the file's directory.
pub fn load(path: &Path, env: Environment<'_>) -> Result<Config, ConfigErrors> {
    let file_name = path.display().to_string();
    let text = read_limited(path).map_err(|mistake| {
        let origin = Origin::File { file: Arc::from(file_name.as_str()), line: None };
        ConfigErrors::from(ConfigError::new(origin, mistake))
    })?;
    let base_dir = path.parent().unwrap_or(Path::new(""));
    parse_checked(&text, &file_name, base_dir, env, Some(&files::FILES))
}

/// Resolves the command line as [`Config::from_args`] does, and checks the identity file as [`load`] does.
pub fn load_args(args: &ArgsConfig, env: Environment<'_>) -> Result<Config, ConfigErrors> {
    Config::from_args_checked(args, env, Some(&files::FILES))
}

fn read_limited(path: &Path) -> Result<String, Mistake> {
    let unreadable = |error: io::Error| Mistake::Unreadable { reason: error.to_string() };
    let file = fs::File::open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    file.take(CONFIG_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > CONFIG_BYTES_MAX {
        let bytes = fs::metadata(path).map_or(CONFIG_BYTES_MAX + 1, |metadata| metadata.len());
        return Err(Mistake::TooLarge { bytes, max: CONFIG_BYTES_MAX });
    }
    String::from_utf8(bytes).map_err(|error| {
        let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + valid.iter().filter(|byte| **byte == b'\n').count();
        Mistake::Unreadable { reason: format!("line {line} is not UTF-8 text") }
    })
}
