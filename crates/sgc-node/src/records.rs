//! [`Records`]: what a node keeps of what it gave away, a JSON file with a version in its state directory.
//!
//! It reads and replaces such files; what stands in them, and what follows from it, those know who keep them.

use std::io;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::state::{self, StateLock};

/// A kind of records; without a file there are those of `default`.
pub(crate) trait Records: Default + Serialize + DeserializeOwned {
    /// What goes wrong with them.
    type Error;
    /// Name of the file.
    const FILE: &str;
    /// Its largest size, bytes.
    const BYTES_MAX: u64;
    /// The only version that is known here.
    const VERSION: u32;

    /// The version that they say they have.
    fn version(&self) -> u32;

    /// The file cannot be read or replaced.
    fn failed(path: PathBuf, source: io::Error) -> Self::Error;
}

/// Reads them; one that cannot be read is an error, since nobody knows then what was given or taken back.
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

/// Changes them on the disk, as nobody else does at the same time.
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
