//! Lock that allows one process per identity on a machine.
//!
//! A process holds two advisory locks: on the identity file, which every user and container with that file sees, and on
//! a file in the state directory, which copies of the identity share. The kernel releases both when the process ends
//! for any reason. Routers detect two processes that share neither file.

use std::fs;
use std::io;
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rustix::fs::{FlockOperation, OFlags, flock, major, minor};
use rustix::io::Errno;
use sgc_sync::lock;
use sgc_wire::NodeId;
use tokio::time::{Instant, sleep};
use tracing::{info, warn};

/// Longest wait for the previous process to end.
const WAIT_MAX: Duration = Duration::from_secs(6);
/// Interval of attempts.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// Another process of this machine uses the identity.
#[derive(Debug, thiserror::Error)]
#[error("{} is locked by {}", path.display(), Holder(*pid, path))]
pub struct IdentityInUse {
    /// The locked file.
    pub path: PathBuf,
    /// The other process, if it is visible.
    pub pid: Option<u32>,
}

struct Holder<'a>(Option<u32>, &'a Path);

impl std::fmt::Display for Holder<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            Some(pid) => write!(f, "process {pid}, see `ps -fp {pid}`"),
            None => write!(f, "another process, see `fuser -v {}`", self.1.display()),
        }
    }
}

/// Locks that a process holds while it uses an identity. Clones share them.
#[derive(Clone, Debug)]
pub(crate) struct RunLock {
    identity: PathBuf,
    held: Arc<Mutex<LockHandle>>,
}

#[derive(Debug)]
struct LockHandle {
    identity: Option<fs::File>,
    _state: Option<fs::File>,
}

impl RunLock {
    /// Locks an identity and its state directory. Waits a while for another process to end.
    pub(crate) async fn take(
        identity: &Path,
        state: Option<&Path>,
        node: NodeId,
    ) -> Result<Self, IdentityInUse> {
        let state = state.map(|dir| dir.join(format!("run-{}.lock", node.short())));
        let deadline = Instant::now() + WAIT_MAX;
        let mut is_told = false;
        loop {
            let taken = lock_file(identity, false).and_then(|identity| {
                let state = state.as_deref().map_or(Ok(None), |state| lock_file(state, true))?;
                Ok(LockHandle { identity, _state: state })
            });
            match taken {
                Ok(held) => {
                    return Ok(Self { identity: identity.to_owned(), held: Arc::new(Mutex::new(held)) });
                }
                Err(in_use) if Instant::now() >= deadline => return Err(in_use),
                Err(in_use) if !is_told => {
                    is_told = true;
                    info!("the identity is in use: {in_use}; waiting {} s for its end", WAIT_MAX.as_secs());
                }
                Err(_) => {}
            }
            sleep(LOOK_EVERY).await;
        }
    }

    /// Locks the identity file that replaced the previous one.
    pub(crate) fn follow(&self) {
        match lock_file(&self.identity, false) {
            Ok(file) => lock(&self.held).identity = file,
            Err(in_use) => warn!("the renewed identity is in use: {in_use}"),
        }
    }
}

/// Locks a file and creates it if `makes`. Returns `None` if the file or file system does not allow it; then the other
/// lock or the routers have to suffice.
fn lock_file(path: &Path, makes: bool) -> Result<Option<fs::File>, IdentityInUse> {
    let mut options = fs::OpenOptions::new();
    options.read(true);
    if makes {
        let flags = OFlags::NOFOLLOW.bits() as i32;
        options.write(true).create(true).truncate(false).mode(0o600).custom_flags(flags);
    }
    let not_locked = |error: io::Error| {
        warn!(path = %path.display(), %error, "cannot be locked; a second process with this identity would not be noticed by it");
        Ok(None)
    };
    let file = match options.open(path) {
        Ok(file) => file,
        Err(error) => return not_locked(error),
    };
    match flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(Some(file)),
        Err(Errno::WOULDBLOCK) => Err(IdentityInUse { path: path.to_owned(), pid: holder(&file) }),
        Err(error) => not_locked(error.into()),
    }
}

/// Returns the process that locks a file, if the kernel shows it.
fn holder(file: &fs::File) -> Option<u32> {
    let metadata = file.metadata().ok()?;
    let device = metadata.dev();
    holder_in(&fs::read_to_string("/proc/locks").ok()?, (major(device), minor(device)), metadata.ino())
}

/// Finds the holder in the text of `/proc/locks` (proc_locks(5)): `1: FLOCK ADVISORY WRITE PID MAJOR:MINOR:INODE 0
/// EOF`, the device in hexadecimal. A process of another PID namespace has the number 0.
fn holder_in(locks: &str, (major, minor): (u32, u32), inode: u64) -> Option<u32> {
    let place = format!("{major:02x}:{minor:02x}:{inode}");
    let of = |line: &str| match line.split_whitespace().collect::<Vec<_>>()[..] {
        [_, "FLOCK", _, _, pid, at, ..] if at == place => pid.parse().ok().filter(|pid| *pid > 0),
        _ => None,
    };
    locks.lines().find_map(of)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn node() -> NodeId {
        NodeId([7; 32])
    }

    #[tokio::test(start_paused = true)]
    async fn a_second_process_waits_and_is_refused_with_the_number_of_the_first() {
        let dir = tempfile::tempdir().unwrap();
        let (identity, copy) = (dir.path().join("robot.identity"), dir.path().join("copy.identity"));
        fs::write(&identity, "").unwrap();
        fs::write(&copy, "").unwrap();
        let first = RunLock::take(&identity, Some(dir.path()), node()).await.unwrap();
        let own = Some(std::process::id());
        let refused = RunLock::take(&identity, None, node()).await.unwrap_err();
        assert_eq!((&refused.path, refused.pid), (&identity, own));
        // A copy of the identity uses the same state directory.
        let refused = RunLock::take(&copy, Some(dir.path()), node()).await.unwrap_err();
        assert_eq!(
            (refused.path.file_name().unwrap().to_str().unwrap(), refused.pid),
            ("run-07070707.lock", own)
        );
        // Another identity is not locked.
        RunLock::take(&copy, Some(dir.path()), NodeId([8; 32])).await.unwrap();
        // A renewed identity is another file.
        fs::write(dir.path().join("new"), "").unwrap();
        fs::rename(dir.path().join("new"), &identity).unwrap();
        first.follow();
        assert!(RunLock::take(&identity, None, node()).await.is_err());
        // A process waits for another that is about to end.
        let (waits, ends) = (RunLock::take(&identity, Some(dir.path()), node()), async {
            sleep(2 * LOOK_EVERY).await;
            drop(first);
        });
        assert!(tokio::join!(waits, ends).0.is_ok());
    }

    #[tokio::test]
    async fn node_starts_if_its_identity_cannot_be_locked() {
        let dir = tempfile::tempdir().unwrap();
        let (identity, state) = (dir.path().join("gone"), dir.path().join("gone too"));
        RunLock::take(&identity, Some(&state), node()).await.unwrap();
    }

    #[test]
    fn the_holder_is_who_has_the_lock() {
        let locks = "1: POSIX  ADVISORY  WRITE 11 fd:01:77 0 EOF\n2: FLOCK  ADVISORY  WRITE 12 fd:01:77 0 EOF\n\
                     2: -> FLOCK  ADVISORY  WRITE 13 fd:01:77 0 EOF\n3: FLOCK  ADVISORY  WRITE 0 fd:01:78 0 EOF\n";
        assert_eq!(holder_in(locks, (0xfd, 1), 77), Some(12));
        assert_eq!((holder_in(locks, (0xfd, 1), 78), holder_in(locks, (0xfd, 2), 77)), (None, None));
    }
}
