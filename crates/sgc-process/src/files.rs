//! Files that hold secrets: written atomically, readable by their owner alone, and never over another by accident.
//!
//! `sgc-trust` defines their content.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::os::unix::fs::{MetadataExt as _, PermissionsExt, fchown};
use std::path::{Path, PathBuf};

use sgc_trust::FLEET_FILE_BYTES_MAX;
use tempfile::NamedTempFile;
use zeroize::Zeroizing;

use crate::error::ProcessError;

/// Largest file that is read.
const SECRET_FILE_BYTES_MAX: u64 = FLEET_FILE_BYTES_MAX as u64;
/// Mode of files that hold secrets.
pub const SECRET_MODE: u32 = 0o600;
/// Mode of files that hold none.
pub const PUBLIC_MODE: u32 = 0o644;
const PERMISSION_BITS: u32 = 0o7777;
const OTHERS_BITS: u32 = 0o077;

/// The rule for an existing file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Existing {
    /// The file stays, and writing fails with this hint.
    Keep(&'static str),
    /// The file is replaced.
    Replace,
}

/// Writes a file of mode 0600 atomically.
pub fn write_secret(path: &Path, text: &str, existing: Existing) -> Result<(), ProcessError> {
    PendingFile::begin(path)?.commit(text.as_bytes(), SECRET_MODE, existing)
}

/// Writes a file that is no secret atomically. Replaces an existing file.
pub fn write_public(path: &Path, content: &[u8]) -> Result<(), ProcessError> {
    PendingFile::begin(path)?.commit(content, PUBLIC_MODE, Existing::Replace)
}

/// A file that is begun beside its place, so that a directory that cannot be written is noticed before there is
/// something to write. Dropped, it is removed.
#[derive(Debug)]
pub struct PendingFile {
    file: NamedTempFile,
    path: PathBuf,
}

impl PendingFile {
    /// Begins the file.
    pub fn begin(path: &Path) -> Result<Self, ProcessError> {
        // `tempfile` creates files with mode 0600, so a secret is never readable by others.
        let file = tempfile::Builder::new().prefix(".sgc-").tempfile_in(directory_of(path));
        let file = file.map_err(|source| ProcessError::Write { path: path.to_owned(), source })?;
        Ok(Self { file, path: path.to_owned() })
    }

    /// Gives the file to the user and the group that its directory has.
    pub fn give_to_owner_of_directory(&self) -> Result<(), ProcessError> {
        // By the descriptor: in a directory of another user, a path may lead elsewhere by now.
        let owner = fs::metadata(directory_of(&self.path)).map_err(|source| self.failed(source))?;
        fchown(self.file.as_file(), Some(owner.uid()), Some(owner.gid()))
            .map_err(|source| self.failed(source))
    }

    /// Puts the file with this content and mode into its place.
    pub fn commit(mut self, content: &[u8], mode: u32, existing: Existing) -> Result<(), ProcessError> {
        let path = self.path.clone();
        let failed = |source| ProcessError::Write { path: path.clone(), source };
        self.file.write_all(content).map_err(failed)?;
        self.file.as_file().set_permissions(fs::Permissions::from_mode(mode)).map_err(failed)?;
        self.file.as_file().sync_all().map_err(failed)?;
        match existing {
            Existing::Replace => self.file.persist(&path).map_err(|e| failed(e.error))?,
            Existing::Keep(hint) => self.file.persist_noclobber(&path).map_err(|e| match e.error.kind() {
                io::ErrorKind::AlreadyExists => ProcessError::Exists { path: path.clone(), hint },
                _ => failed(e.error),
            })?,
        };
        // Without this sync, a power cut may lose the directory entry of a complete file.
        let dir = directory_of(&path);
        File::open(dir).and_then(|dir| dir.sync_all()).map_err(failed)
    }

    fn failed(&self, source: io::Error) -> ProcessError {
        ProcessError::Write { path: self.path.clone(), source }
    }
}

fn directory_of(path: &Path) -> &Path {
    path.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Reads a text that is no secret.
pub fn read_public(path: &Path) -> Result<String, ProcessError> {
    let failed = |source| ProcessError::Read { path: path.to_owned(), source };
    if fs::metadata(path).map_err(failed)?.len() > SECRET_FILE_BYTES_MAX {
        return Err(failed(io::Error::other("it is far too large")));
    }
    fs::read_to_string(path).map_err(failed)
}

/// Returns `true` if the path exists.
pub fn exists(path: &Path) -> bool {
    fs::symlink_metadata(path).is_ok()
}

/// Reads a file of secrets. Fails if others than its owner may read it. `what` names its content in the error.
pub fn read_secret(path: &Path, what: &'static str) -> Result<Zeroizing<String>, ProcessError> {
    let failed = |source| ProcessError::Read { path: path.to_owned(), source };
    let metadata = fs::metadata(path).map_err(failed)?;
    let mode = metadata.permissions().mode() & PERMISSION_BITS;
    if mode & OTHERS_BITS != 0 {
        return Err(ProcessError::Exposed { path: path.to_owned(), mode, what });
    }
    if metadata.len() > SECRET_FILE_BYTES_MAX {
        return Err(failed(io::Error::other("it is far too large")));
    }
    fs::read_to_string(path).map(Zeroizing::new).map_err(failed)
}

/// Reads a file of at most `max` bytes.
pub fn read_limited(path: &Path, max: u64) -> Result<Vec<u8>, ProcessError> {
    let failed = |source| ProcessError::Read { path: path.to_owned(), source };
    let mut content = Vec::new();
    fs::File::open(path).and_then(|file| file.take(max + 1).read_to_end(&mut content)).map_err(failed)?;
    if content.len() as u64 > max {
        return Err(failed(io::Error::other(format!("it has more than {max} bytes"))));
    }
    Ok(content)
}

/// Returns the files of a directory with this extension, sorted.
pub fn with_extension(dir: &Path, extension: &str) -> io::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir)? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == extension) {
            found.push(path);
        }
    }
    found.sort();
    Ok(found)
}
