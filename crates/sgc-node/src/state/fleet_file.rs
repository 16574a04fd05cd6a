//! The fleet file: read and changed under a lock, so that two programs do not undo each other's revocations.

use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, flock};
use sgc_trust::{FLEET_FILE_BYTES_MAX, Fleet, FleetError};
use zeroize::Zeroizing;

use crate::state;

/// Reasons why a fleet file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FleetFileError {
    /// The file cannot be read or locked.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// Others can read the file.
    #[error("{}: its mode {mode:04o} lets others at the CA's private key: chmod 600 {}", path.display(), path.display())]
    Exposed {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The file holds no fleet.
    #[error("{}: {source}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: FleetError,
    },
    /// The file cannot be replaced. Nothing changed.
    #[error("{}: it could not be written, and is as it was: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
}

/// A fleet with its file, which stays locked against other programs while this lives.
#[derive(Debug)]
pub struct LockedFleet {
    /// The fleet.
    pub fleet: Fleet,
    path: PathBuf,
    _lock: fs::File,
}

impl LockedFleet {
    /// Waits for the lock and reads the file.
    pub fn open(path: &Path) -> Result<Self, FleetFileError> {
        let lock = lock(path).map_err(|source| FleetFileError::Read { path: path.to_owned(), source })?;
        Ok(Self { fleet: read_fleet(path)?, path: path.to_owned(), _lock: lock })
    }

    /// Returns the path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Adds the path to an error of the fleet.
    pub fn error(&self, source: FleetError) -> FleetFileError {
        FleetFileError::Content { path: self.path.clone(), source }
    }

    /// Replaces the file by the current fleet, whole or not at all.
    pub fn save(&self) -> Result<(), FleetFileError> {
        state::replace(&self.path, self.fleet.to_text().as_bytes())
            .map_err(|source| FleetFileError::Write { path: self.path.clone(), source })
    }
}

/// Opens and locks a file until it is closed.
fn lock(path: &Path) -> io::Result<fs::File> {
    loop {
        let file = fs::File::open(path)?;
        flock(&file, FlockOperation::LockExclusive)?;
        // The previous holder of the lock may have replaced the file.
        let (locked, named) = (file.metadata()?, fs::metadata(path)?);
        if (locked.dev(), locked.ino()) == (named.dev(), named.ino()) {
            return Ok(file);
        }
    }
}

/// Reads a fleet file, which only its owner may read.
pub fn read_fleet(path: &Path) -> Result<Fleet, FleetFileError> {
    let failed = |source| FleetFileError::Read { path: path.to_owned(), source };
    if let Some(mode) = state::exposed(&fs::metadata(path).map_err(failed)?) {
        return Err(FleetFileError::Exposed { path: path.to_owned(), mode });
    }
    let bytes = state::read(path, FLEET_FILE_BYTES_MAX as u64).map_err(failed)?;
    let bytes = Zeroizing::new(bytes.ok_or_else(|| failed(io::ErrorKind::NotFound.into()))?);
    let text = std::str::from_utf8(&bytes).map_err(|e| failed(io::Error::other(e)))?;
    Fleet::parse(text).map_err(|source| FleetFileError::Content { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn waiting_locker_reads_the_file_as_it_is_after_the_wait() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a");
        state::replace(&path, b"1").unwrap();
        let first = lock(&path).unwrap();
        let waiting = std::thread::spawn({
            let path = path.clone();
            move || lock(&path).unwrap().metadata().unwrap().ino()
        });
        // `/proc/locks` marks waiters with an arrow. The inode is the last of three numbers.
        let inode = format!(":{} ", first.metadata().unwrap().ino());
        let waits = |line: &str| line.contains("->") && line.contains(&inode);
        while !fs::read_to_string("/proc/locks").unwrap().lines().any(waits) {
            std::thread::yield_now();
        }
        state::replace(&path, b"2").unwrap();
        drop(first);
        assert_eq!(waiting.join().unwrap(), fs::metadata(&path).unwrap().ino());
    }
}
