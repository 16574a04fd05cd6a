//! The errors of a process and its files.

use std::io;
use std::path::PathBuf;

/// An error of a process or of its files.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// A file cannot be read.
    #[error("cannot read {}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file cannot be written.
    #[error("cannot write {}: {source}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file that would be overwritten.
    #[error("{} exists already{hint}", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
        /// The remedy, with its separator.
        hint: &'static str,
    },
    /// A file of secrets that others may read.
    #[error("{}: its mode {mode:04o} lets others at {what}: chmod 600 {}", path.display(), path.display())]
    Exposed {
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
        /// The content of the file.
        what: &'static str,
    },
    /// The system refused something that the program needs.
    #[error("{what}: {source}")]
    System {
        /// The failed action.
        what: &'static str,
        /// The system's error.
        source: io::Error,
    },
    /// Standard output cannot be written.
    #[error("cannot write to standard output: {0}")]
    Output(io::Error),
}
