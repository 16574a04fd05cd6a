//! [`Records`]: records that a node keeps in its state directory, as a JSON file with a version.
//!
//! This module reads and replaces such files. The implementors know their content and its consequences.

use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::state::{self, StateLock};

/// A kind of records. Without a file, they are those of `default`.
pub(crate) trait Records: Default + Serialize + DeserializeOwned {
    /// Error of this kind of records.
    type Error;
    /// Name of the file.
    const FILE: &str;
    /// Largest size of the file, bytes.
    const BYTES_MAX: u64;
    /// The supported version.
    const VERSION: u32;

    /// Returns the version of these records.
    fn version(&self) -> u32;

    /// Returns the error for a file that cannot be read or replaced.
    fn failed(path: PathBuf, source: io::Error) -> Self::Error;
}

/// Loads the records. An unreadable file is an error, since grants and revocations are unknown then.
pub(crate) fn load<R: Records>(state: &Path) -> Result<R, R::Error> {
    let path = state.join(R::FILE);
    let read = || {
        let Some(text) = state::read(&path, R::BYTES_MAX)? else { return Ok(R::default()) };
        let records: R = serde_json::from_slice(&text)?;
        if records.version() != R::VERSION {
            return Err(io::Error::other(format!("version {} is not known here", records.version())));
        }
        Ok(records)
    };
    read().map_err(|source| R::failed(path.clone(), source))
}

/// Changes the file under its lock.
pub(crate) fn change<R: Records, T>(
    state: &Path,
    change: impl FnOnce(&mut R) -> Result<T, R::Error>,
) -> Result<T, R::Error> {
    let path = state.join(R::FILE);
    let failed = |source| R::failed(path.clone(), source);
    let _lock = StateLock::take(state).map_err(failed)?;
    let mut records = load(state)?;
    let done = change(&mut records)?;
    let text = serde_json::to_vec_pretty(&records).map_err(|error| failed(error.into()))?;
    state::replace(&path, &text).map_err(failed)?;
    Ok(done)
}
