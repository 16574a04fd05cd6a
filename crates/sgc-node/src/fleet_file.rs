//! A fleet's file: read and changed under a lock, so that two programs do not undo each other's revocations.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};
use sgc_trust::{FLEET_FILE_BYTES_MAX, Fleet, FleetError};
use zeroize::Zeroizing;

use crate::state;

/// Why a fleet file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FleetFileError {
    /// It cannot be read or locked.
    #[error("fleet {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// Others can read it.
    #[error("fleet {}: others can read it (mode {mode:o}); it holds the key of the CA: chmod 600 it", path.display())]
    Exposed {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// It holds no fleet.
    #[error("fleet {}: {source}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: FleetError,
    },
    /// It cannot be replaced; nothing changed.
    #[error("fleet {}: it could not be written, and is as it was: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

/// A fleet, and its file locked against other programs for as long as this lives.
#[derive(Debug)]
pub struct LockedFleet {
    /// The fleet.
    pub fleet: Fleet,
    path: PathBuf,
    _lock: fs::File,
}

impl LockedFleet {
    /// Waits for the lock, then reads the file.
    pub fn open(path: &Path) -> Result<Self, FleetFileError> {
        let failed = |source| FleetFileError::Read { path: path.to_owned(), source };
        let lock = loop {
            let file = fs::File::open(path).map_err(failed)?;
            flock(&file, FlockOperation::LockExclusive).map_err(|e| failed(e.into()))?;
            // Whoever had the lock may have put another file in the place of this one meanwhile.
            let locked = file.metadata().map_err(failed)?;
            let named = fs::metadata(path).map_err(failed)?;
            if (locked.dev(), locked.ino()) == (named.dev(), named.ino()) {
                break file;
            }
        };
        Ok(Self { fleet: read_fleet(path)?, path: path.to_owned(), _lock: lock })
    }

    /// Replaces the file with the fleet as it is now, whole or not at all.
    pub fn save(&self) -> Result<(), FleetFileError> {
        state::replace(&self.path, self.fleet.to_text().as_bytes())
            .map_err(|source| FleetFileError::Write { path: self.path.clone(), source })
    }
}

/// Reads a fleet's file, which must be its owner's alone.
pub fn read_fleet(path: &Path) -> Result<Fleet, FleetFileError> {
    let failed = |source| FleetFileError::Read { path: path.to_owned(), source };
    let mode = fs::metadata(path).map_err(failed)?.permissions().mode() & 0o7777;
    if mode & 0o077 != 0 {
        return Err(FleetFileError::Exposed { path: path.to_owned(), mode });
    }
    let bytes = state::read(path, FLEET_FILE_BYTES_MAX as u64).map_err(failed)?;
    let bytes = Zeroizing::new(bytes.ok_or_else(|| failed(io::ErrorKind::NotFound.into()))?);
    let text = std::str::from_utf8(&bytes).map_err(|e| failed(io::Error::other(e)))?;
    Fleet::parse(text).map_err(|source| FleetFileError::Content { path: path.to_owned(), source })
}
