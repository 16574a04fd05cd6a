//! The state directory: files that a node keeps from one run to the next, for its user alone.
//!
//! This module finds the directory and replaces files in it. Their writers know their content.

pub mod audit;
pub(crate) mod credentials;
pub(crate) mod fleet_file;
pub(crate) mod peer_names;
pub(crate) mod records;
pub(crate) mod run_lock;
pub(crate) mod storage;

use std::ffi::OsString;
use std::fs;
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};
use sgc_config::Config;

const LOCK_FILE: &str = "lock";
/// Name of the file that is written to see whether the directory can be written.
const PROBE_FILE: &str = ".probe";
const PERMISSION_BITS: u32 = 0o7777;
const OTHERS_BITS: u32 = 0o077;

/// Directory in which systemd keeps the state of `sgc@.service`.
const SERVICE_DIR: &str = "/var/lib/sgc";
/// The user id of root.
pub(crate) const ROOT: u32 = 0;

/// Returns the state directory of a node with this name: as configured, or in the state directory of the service or of
/// the user. A service's node is found from outside of it, too, by root and by its own user. `None` if the user has
/// none.
pub fn state_dir(config: &Config, node: &str) -> Option<PathBuf> {
    config
        .state
        .clone()
        .or_else(|| usual_state_dir(&|name| std::env::var_os(name), SERVICE_DIR.as_ref(), node, own_uid()))
}

/// Returns the directories with the state directories of this user's nodes and of services.
pub fn state_bases() -> Vec<PathBuf> {
    let own = own_base(&|name| std::env::var_os(name)).map(|base| base.join("sgc"));
    own.into_iter().chain([PathBuf::from(SERVICE_DIR)]).collect()
}

/// Returns the directory of the user's state.
fn own_base(variable: &dyn Fn(&str) -> Option<OsString>) -> Option<PathBuf> {
    let named = |name| variable(name).filter(|value| !value.is_empty()).map(PathBuf::from);
    let base = named("XDG_STATE_HOME").filter(|dir| dir.is_absolute());
    base.or_else(|| Some(named("HOME")?.join(".local/state")))
}

/// Returns the effective user id of this process.
pub(crate) fn own_uid() -> u32 {
    rustix::process::geteuid().as_raw()
}

fn usual_state_dir(
    variable: &dyn Fn(&str) -> Option<OsString>,
    service: &Path,
    node: &str,
    uid: u32,
) -> Option<PathBuf> {
    // Several directories of a service are separated by colons.
    let first = |dirs: OsString| Some(PathBuf::from(dirs.to_str()?.split(':').next()?));
    if let Some(dir) = variable("STATE_DIRECTORY").and_then(first).filter(|dir| dir.is_absolute()) {
        return Some(dir.join(node));
    }
    let is_a_directory = |dir: &Path, is_whose: &dyn Fn(u32) -> bool| {
        fs::symlink_metadata(dir).is_ok_and(|m| m.is_dir() && is_whose(m.uid()))
    };
    // This user is that of services, perhaps before the first start of the node.
    if uid != ROOT && is_a_directory(service, &|owner| owner == uid) {
        return Some(service.join(node));
    }
    let own = own_base(variable).map(|base| base.join("sgc").join(node));
    if own.as_ref().is_some_and(|own| own.is_dir()) {
        return own;
    }
    let is_ours = |dir: &PathBuf| is_a_directory(dir, &|owner| uid == ROOT || owner == uid);
    Some(service.join(node)).filter(is_ours).or(own)
}

/// Creates the directory if it is missing, 0700, and checks that it is this user's alone.
pub fn create_state_dir(dir: &Path) -> Result<(), StateError> {
    let failed = |source| StateError::Directory { path: dir.to_owned(), source };
    fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)?;
    check_owner(dir, &fs::metadata(dir).map_err(failed)?)
}

/// Checks that an existing directory is this user's alone. Root may look at that of a service. Creates nothing.
pub fn check_state_dir(dir: &Path) -> Result<(), StateError> {
    match fs::metadata(dir) {
        Ok(metadata) if own_uid() == ROOT && dir.starts_with(SERVICE_DIR) => match exposed(&metadata) {
            Some(mode) => Err(StateError::Exposed { path: dir.to_owned(), mode }),
            None => Ok(()),
        },
        Ok(metadata) => check_owner(dir, &metadata),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(source) => Err(StateError::Directory { path: dir.to_owned(), source }),
    }
}

fn check_owner(dir: &Path, metadata: &fs::Metadata) -> Result<(), StateError> {
    if let Some(mode) = exposed(metadata) {
        return Err(StateError::Exposed { path: dir.to_owned(), mode });
    }
    if metadata.uid() != rustix::process::geteuid().as_raw() {
        return Err(StateError::NotOurs { path: dir.to_owned() });
    }
    Ok(())
}

/// Returns the mode of a file or directory that others than its owner may read, change or enter.
pub(crate) fn exposed(metadata: &fs::Metadata) -> Option<u32> {
    let mode = metadata.permissions().mode() & PERMISSION_BITS;
    (mode & OTHERS_BITS != 0).then_some(mode)
}

/// Returns the remedy for an identity file that this user may not read, as the end of a message; empty for other errors.
pub(crate) fn owner_hint(path: &Path, error: &io::Error) -> String {
    if error.kind() != io::ErrorKind::PermissionDenied {
        return String::new();
    }
    match fs::metadata(path).map(|metadata| metadata.uid()) {
        Ok(ROOT) => format!(
            "; it belongs to root: give it to the user that the node runs as, for a service by `sudo chown sgc {}`",
            path.display()
        ),
        Ok(uid) if uid != own_uid() => {
            format!("; it belongs to uid {uid}: run this as that user")
        }
        _ => String::new(),
    }
}

/// Replaces a file whole or not at all. The new file has mode 0600 and is on the disk before it gets its name.
pub(crate) fn replace(path: &Path, content: &[u8]) -> io::Result<()> {
    let dir = path.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let temporary = dir.join(format!(".{name}.{}", std::process::id()));
    let _ = fs::remove_file(&temporary);
    let mut options = fs::OpenOptions::new();
    let mut file = options.write(true).create_new(true).mode(0o600).open(&temporary)?;
    let written = file
        .write_all(content)
        .and_then(|()| file.sync_all())
        .and_then(|()| fs::rename(&temporary, path))
        .and_then(|()| fs::File::open(dir)?.sync_all());
    if written.is_err() {
        let _ = fs::remove_file(&temporary);
    }
    written
}

/// Returns `true` if the disk is full or read-only.
pub(crate) fn is_storage_fault(error: &io::Error) -> bool {
    use io::ErrorKind::{QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    matches!(error.kind(), StorageFull | ReadOnlyFilesystem | QuotaExceeded)
}

/// Writes a file into the directory and removes it. Returns the error if the disk is full or read-only.
pub fn storage_fault(dir: &Path) -> Option<StateError> {
    let probe = dir.join(PROBE_FILE);
    let written = replace(&probe, b"probe");
    let _ = fs::remove_file(&probe);
    let source = written.err().filter(is_storage_fault)?;
    Some(StateError::Directory { path: dir.to_owned(), source })
}

/// Reads a file of at most `max` bytes that is no symbolic link; `None` if it is missing.
pub(crate) fn read(path: &Path, max: u64) -> io::Result<Option<Vec<u8>>> {
    let flags = OFlags::NOFOLLOW.bits() as i32;
    let file = match fs::OpenOptions::new().read(true).custom_flags(flags).open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        file => file?,
    };
    let mut content = Vec::new();
    file.take(max + 1).read_to_end(&mut content)?;
    if content.len() as u64 > max {
        return Err(io::Error::other(format!("it has more than {max} bytes")));
    }
    Ok(Some(content))
}

/// Lock for reading and replacing files of the directory, so that two programs do not undo each other's work.
#[derive(Debug)]
pub(crate) struct StateLock {
    _file: fs::File,
}

impl StateLock {
    /// Waits for the lock.
    pub(crate) fn take(dir: &Path) -> io::Result<Self> {
        let mut options = fs::OpenOptions::new();
        let flags = OFlags::NOFOLLOW.bits() as i32;
        let options = options.write(true).create(true).truncate(false).mode(0o600).custom_flags(flags);
        let file = options.open(dir.join(LOCK_FILE))?;
        flock(&file, FlockOperation::LockExclusive)?;
        Ok(Self { _file: file })
    }
}

/// Reasons why a state directory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum StateError {
    /// The user has no state directory.
    #[error(
        "there is no place for this node's state: neither XDG_STATE_HOME nor HOME is set; set `state` in [node]"
    )]
    Nowhere,
    /// The directory cannot be created or read.
    #[error("state directory {}: {source}", path.display())]
    Directory {
        /// The directory.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// Others may enter the directory.
    #[error("state directory {}: its mode {mode:04o} lets others in; chmod 700 it", path.display())]
    Exposed {
        /// The directory.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// The directory belongs to another user.
    #[error(
        "state directory {}: it belongs to another user: become that user, as `sudo -u sgc` does for a service, or name \
         another with `state` in [node]",
        path.display()
    )]
    NotOurs {
        /// The directory.
        path: PathBuf,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn state_is_with_the_service_then_with_the_user_then_with_a_service_of_this_user() {
        let place = tempfile::tempdir().unwrap();
        let (home, service) = (place.path().join("home"), place.path().join("service"));
        let dir = |variables: &[(&str, &str)]| {
            let value = |name: &str| {
                variables.iter().find(|(known, _)| *known == name).map(|(_, value)| OsString::from(value))
            };
            usual_state_dir(&value, &service, "arm-1", ROOT)
        };
        let home_variable = ("HOME", home.to_str().unwrap());
        let own = home.join(".local/state/sgc/arm-1");
        assert_eq!(dir(&[]), None);
        assert_eq!(dir(&[home_variable]), Some(own.clone()));
        assert_eq!(dir(&[("XDG_STATE_HOME", "relative"), home_variable]), Some(own.clone()));
        assert_eq!(
            dir(&[("XDG_STATE_HOME", "/state"), home_variable]).unwrap(),
            Path::new("/state/sgc/arm-1")
        );
        let in_service = dir(&[("STATE_DIRECTORY", "/var/lib/some:/var/lib/more"), home_variable]);
        assert_eq!(in_service.unwrap(), Path::new("/var/lib/some/arm-1"));
        assert_eq!(dir(&[("STATE_DIRECTORY", "relative"), home_variable]), Some(own.clone()));
        // A service of this user.
        fs::create_dir_all(service.join("arm-1")).unwrap();
        assert_eq!(dir(&[]), Some(service.join("arm-1")));
        assert_eq!(dir(&[home_variable]), Some(service.join("arm-1")));
        fs::create_dir_all(&own).unwrap();
        assert_eq!(dir(&[home_variable]), Some(own.clone()));
        // The user of services has the state of all of them there, also before a node was started.
        let owner = fs::metadata(&service).unwrap().uid();
        let of_uid = |uid, node| {
            usual_state_dir(&|name| (name == "HOME").then(|| home.clone().into()), &service, node, uid)
        };
        assert_eq!(of_uid(owner + 1, "arm-1"), Some(own));
        if owner != ROOT {
            assert_eq!(of_uid(owner, "new"), Some(service.join("new")));
        } else {
            std::os::unix::fs::chown(&service, Some(7), None).unwrap();
            assert_eq!(of_uid(7, "new"), Some(service.join("new")));
        }
    }
}
