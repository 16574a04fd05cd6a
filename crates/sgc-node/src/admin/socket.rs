//! Place of the status socket, and mutual verification of both ends.
//!
//! The node binds the socket in a directory of its own user and holds a lock beside it for its lifetime, so that one
//! node has the socket and a successor waits. Both ends ask the system for the other's user (`SO_PEERCRED`), since file
//! modes alone would trust whoever made the directory first. `admin` has the protocol.

use std::fs;
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};

use rustix::fs::{FlockOperation, OFlags, flock};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, socket_with};
use sgc_trust::NodeName;
use tokio::net::UnixListener;

use crate::state::{ROOT, own_uid};

/// Permission bits of others than the owner.
const OTHERS_BITS: u32 = 0o077;
/// Permission bits of everyone but the owner and the group.
const WORLD_BITS: u32 = 0o007;
/// Permission bits with which the group may enter and list a directory.
const GROUP_ENTERS_BITS: u32 = 0o050;
/// Permission bits of a socket that the group of its directory may use.
const SHARED_SOCKET_MODE: u32 = 0o660;
const OWN_SOCKET_MODE: u32 = 0o600;
/// Permission bit that lets everyone create and remove files.
const WORLD_WRITE_BIT: u32 = 0o002;
/// Permission bit that lets the group create and remove files.
const GROUP_WRITE_BIT: u32 = 0o020;
/// Permission bit that restricts removal to owners.
const STICKY_BIT: u32 = 0o1000;
/// Directory in which systemd creates the runtime directory of each node of `sgc@.service`.
const SERVICES_DIR: &str = "/run/sgc";
const SOCKET_EXTENSION: &str = "sock";
/// Most sockets of one directory that are considered.
const SOCKETS_MAX: usize = 64;

/// Reasons why a status socket cannot be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum SocketError {
    /// The system's error for the socket.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Another node has the socket.
    #[error("another node has it; it is taken over when that one ends")]
    Taken,
    /// The directory cannot be created or examined.
    #[error("directory {}: {source}", dir.display())]
    Directory {
        /// The directory.
        dir: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// The directory is a file or a symbolic link.
    #[error("{} is not a directory but a file or a symbolic link: remove it, or set XDG_RUNTIME_DIR or `socket` in [admin]", dir.display())]
    NoDirectory {
        /// The path that should be a directory.
        dir: PathBuf,
    },
    /// The directory belongs to another user.
    #[error(
        "directory {} belongs to uid {uid}, who could replace the socket: remove it, or set XDG_RUNTIME_DIR or `socket` in [admin]",
        dir.display()
    )]
    NotOurs {
        /// The directory.
        dir: PathBuf,
        /// Its owner.
        uid: u32,
    },
    /// Others may change the directory.
    #[error("directory {}: its mode {mode:04o} lets others in; chmod 700 it", dir.display())]
    Exposed {
        /// The directory.
        dir: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
    /// A process of another user has the socket.
    #[error(
        "a process of uid {uid} answers there, and neither root nor uid {expected}: it is not trusted; nothing was asked"
    )]
    Stranger {
        /// The user who has the socket.
        uid: u32,
        /// The user who should have it.
        expected: u32,
    },
}

/// Returns the path of the status socket of a node with this name, unless its configuration names another.
pub fn default_socket_path(node: &str) -> PathBuf {
    usual_dir(&|name| std::env::var_os(name).map(PathBuf::from)).join(format!("{node}.sock"))
}

/// Returns the path of the status socket of the node with this name that runs here: that of this user's node or, if
/// none answers, that of a service. Without either, it is [`default_socket_path`].
pub fn find_socket(node: &str) -> PathBuf {
    let own = default_socket_path(node);
    if is_safe(directory(&own)) && answers(&own) {
        return own;
    }
    let is_it = |path: &PathBuf| path.file_stem().is_some_and(|name| name == node);
    service_sockets(Path::new(SERVICES_DIR)).into_iter().find(is_it).unwrap_or(own)
}

/// Returns the status sockets of the nodes of this user and of those services whose directories the user may read. A
/// socket at which no node answers is among them only if there is no other.
pub fn usual_sockets() -> Vec<PathBuf> {
    let own = usual_dir(&|name| std::env::var_os(name).map(PathBuf::from));
    let mut sockets = if is_safe(&own) { sockets_in(&own) } else { Vec::new() };
    sockets
        .extend(service_sockets(Path::new(SERVICES_DIR)).into_iter().filter(|path| !path.starts_with(&own)));
    if sockets.len() < 2 {
        return sockets;
    }
    let live: Vec<_> = sockets.iter().filter(|path| answers(path)).cloned().collect();
    if live.is_empty() { sockets } else { live }
}

/// Returns `true` unless the directory is below `/tmp`, where anybody may have made it, and is not this user's alone.
fn is_safe(dir: &Path) -> bool {
    dir != temporary_dir() || check_dir(dir, true).is_ok()
}

/// Returns `true` if a process has this socket, without a request to it.
fn answers(path: &Path) -> bool {
    match open(path) {
        Ok(_) => true,
        Err(error) => error.kind() == io::ErrorKind::WouldBlock,
    }
}

/// Connects to a socket without waiting for room in its queue.
fn open(path: &Path) -> io::Result<UnixStream> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    rustix::net::connect(&socket, &SocketAddrUnix::new(path)?)?;
    let stream = UnixStream::from(socket);
    stream.set_nonblocking(false)?;
    Ok(stream)
}

/// Returns `true` if a service has a directory for its socket that this user may not read.
pub fn has_hidden_services() -> bool {
    directories_in(Path::new(SERVICES_DIR))
        .iter()
        .any(|dir| fs::read_dir(dir).is_err_and(|error| error.kind() == io::ErrorKind::PermissionDenied))
}

/// Returns the sockets of services, whose directories are in `services`.
fn service_sockets(services: &Path) -> Vec<PathBuf> {
    directories_in(services).iter().flat_map(|dir| sockets_in(dir)).collect()
}

fn directories_in(dir: &Path) -> Vec<PathBuf> {
    entries_of(dir, |path| path.is_dir())
}

/// Returns the sockets with names of nodes, at most [`SOCKETS_MAX`]: the user of a service chooses them.
fn sockets_in(dir: &Path) -> Vec<PathBuf> {
    let is_socket = |path: &Path| {
        path.extension().is_some_and(|extension| extension == SOCKET_EXTENSION)
            && path
                .file_stem()
                .and_then(|name| name.to_str())
                .is_some_and(|name| name.parse::<NodeName>().is_ok())
    };
    let mut sockets = entries_of(dir, is_socket);
    sockets.truncate(SOCKETS_MAX);
    sockets
}

/// Returns the entries that are wanted, in the order of their names; none if the directory cannot be read.
fn entries_of(dir: &Path, is_wanted: impl Fn(&Path) -> bool) -> Vec<PathBuf> {
    let entries = fs::read_dir(dir).into_iter().flatten().flatten().map(|entry| entry.path());
    let mut wanted: Vec<_> = entries.filter(|path| is_wanted(path)).collect();
    wanted.sort();
    wanted
}

/// Returns `true` if root made this directory in `services` for a service, and lets the service's group enter, but
/// nobody else.
fn is_of_service(dir: &Path, services: &Path) -> bool {
    let is_in_services = dir.parent() == Some(services);
    let is_root_s = |metadata: &fs::Metadata| {
        metadata.is_dir()
            && metadata.uid() == ROOT
            && metadata.permissions().mode() & (WORLD_WRITE_BIT | GROUP_WRITE_BIT) == 0
    };
    let is_for_group = |metadata: &fs::Metadata| {
        let mode = metadata.permissions().mode();
        metadata.is_dir() && mode & WORLD_BITS == 0 && mode & GROUP_ENTERS_BITS == GROUP_ENTERS_BITS
    };
    is_in_services
        && fs::symlink_metadata(services).is_ok_and(|metadata| is_root_s(&metadata))
        && fs::symlink_metadata(dir).is_ok_and(|metadata| is_for_group(&metadata))
}

/// Returns the directory of status sockets: the user's runtime directory, that of a systemd service, or one below
/// `/tmp`.
fn usual_dir(variable: &dyn Fn(&str) -> Option<PathBuf>) -> PathBuf {
    let absolute = |name| variable(name).filter(|dir| dir.is_absolute());
    // Several directories of a service are separated by colons.
    let service = || {
        let dirs = variable("RUNTIME_DIRECTORY")?;
        let first = PathBuf::from(dirs.to_str()?.split(':').next()?);
        first.is_absolute().then_some(first)
    };
    absolute("XDG_RUNTIME_DIR").map(|dir| dir.join("sgc")).or_else(service).unwrap_or_else(temporary_dir)
}

/// Returns the directory below `/tmp`, which anybody may have created before.
fn temporary_dir() -> PathBuf {
    std::env::temp_dir().join(format!("sgc-{}", own_uid()))
}

/// Checks the directory of a status socket and creates nothing. A directory that anybody may have created, such as the
/// one below `/tmp`, must be this user's alone. A configured directory must be this user's or root's, and nobody else
/// may replace files in it.
fn check_dir(dir: &Path, anybody_makes: bool) -> Result<(), SocketError> {
    let failed = |source| SocketError::Directory { dir: dir.to_owned(), source };
    let metadata =
        if anybody_makes { fs::symlink_metadata(dir) } else { fs::metadata(dir) }.map_err(failed)?;
    if !metadata.is_dir() {
        return Err(SocketError::NoDirectory { dir: dir.to_owned() });
    }
    let (uid, mode) = (metadata.uid(), metadata.permissions().mode() & 0o7777);
    if uid != own_uid() && (anybody_makes || uid != ROOT) {
        return Err(SocketError::NotOurs { dir: dir.to_owned(), uid });
    }
    let is_exposed = match anybody_makes {
        true => mode & OTHERS_BITS != 0,
        false => mode & WORLD_WRITE_BIT != 0 && mode & STICKY_BIT == 0,
    };
    if is_exposed { Err(SocketError::Exposed { dir: dir.to_owned(), mode }) } else { Ok(()) }
}

/// Connects to a status socket, if its process belongs to this user or to root. Root and, for a service, members of its
/// group may also connect to the process of the user who owns the socket's directory.
pub fn connect(path: &Path) -> Result<UnixStream, SocketError> {
    let dir = directory(path);
    if dir == temporary_dir() && fs::symlink_metadata(dir).is_ok() {
        check_dir(dir, true)?;
    }
    let stream = open(path)?;
    let uid = rustix::net::sockopt::socket_peercred(&stream).map_err(io::Error::from)?.uid.as_raw();
    let expected = expected_uid(dir, Path::new(SERVICES_DIR));
    if uid == expected || uid == ROOT { Ok(stream) } else { Err(SocketError::Stranger { uid, expected }) }
}

/// Returns the user whose node should have a socket in this directory.
fn expected_uid(dir: &Path, services: &Path) -> u32 {
    match fs::metadata(dir) {
        // Root made the directory of a service for its user, so nobody else can have the socket.
        Ok(metadata) if own_uid() == ROOT || is_of_service(dir, services) => metadata.uid(),
        _ => own_uid(),
    }
}

/// A status socket of this node. Dropping it removes the socket, if the path still leads to it, and releases the lock.
#[derive(Debug)]
pub(super) struct StatusSocket {
    path: PathBuf,
    listener: UnixListener,
    /// Device and inode of the socket.
    identity: (u64, u64),
    /// Members of the group of the socket's directory may send requests.
    is_shared: bool,
    /// Lock, held while this lives. The kernel releases it when the process ends for any reason.
    _lock: fs::File,
}

impl StatusSocket {
    /// Binds the socket for this user alone or, in the directory of a service, for the members of its group, too. It
    /// replaces the socket of a dead node, but not of a live one.
    pub(super) fn bind(path: &Path) -> Result<Self, SocketError> {
        Self::bind_in(path, Path::new(SERVICES_DIR))
    }

    fn bind_in(path: &Path, services: &Path) -> Result<Self, SocketError> {
        let dir = directory(path);
        let failed = |source| SocketError::Directory { dir: dir.to_owned(), source };
        fs::DirBuilder::new().recursive(true).mode(0o700).create(dir).map_err(failed)?;
        check_dir(dir, dir == temporary_dir())?;
        let lock = lock(path)?;
        // Nodes of earlier versions hold no lock.
        if UnixStream::connect(path).is_ok() {
            return Err(SocketError::Taken);
        }
        match fs::remove_file(path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
            _ => {}
        }
        let listener = UnixListener::bind(path)?;
        let is_shared = is_of_service(dir, services);
        let mode = if is_shared { SHARED_SOCKET_MODE } else { OWN_SOCKET_MODE };
        fs::set_permissions(path, fs::Permissions::from_mode(mode))?;
        let identity = identity(path)?;
        Ok(Self { path: path.to_owned(), listener, identity, is_shared, _lock: lock })
    }

    /// Returns `true` if a process of this user may send requests. Only members of the group can connect to a shared
    /// socket, because of its mode.
    pub(super) fn may_ask(&self, uid: u32) -> bool {
        self.is_shared || uid == own_uid() || uid == ROOT
    }

    /// Returns the listener.
    pub(super) fn listener(&self) -> &UnixListener {
        &self.listener
    }

    /// Returns `true` while the path leads to this socket.
    pub(super) fn is_in_place(&self) -> bool {
        identity(&self.path).is_ok_and(|there| there == self.identity)
    }
}

impl Drop for StatusSocket {
    fn drop(&mut self) {
        if self.is_in_place() {
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Takes the lock `SOCKET.lock`. The file stays when the node ends, since removing it could remove a successor's.
fn lock(path: &Path) -> Result<fs::File, SocketError> {
    let mut name = path.as_os_str().to_owned();
    name.push(".lock");
    let mut options = fs::OpenOptions::new();
    let flags = OFlags::NOFOLLOW.bits() as i32;
    let options = options.write(true).create(true).truncate(false).mode(0o600).custom_flags(flags);
    let file = options.open(name)?;
    match flock(&file, FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => Ok(file),
        Err(rustix::io::Errno::WOULDBLOCK) => Err(SocketError::Taken),
        Err(error) => Err(io::Error::from(error).into()),
    }
}

fn identity(path: &Path) -> io::Result<(u64, u64)> {
    fs::symlink_metadata(path).map(|metadata| (metadata.dev(), metadata.ino()))
}

fn directory(path: &Path) -> &Path {
    path.parent().filter(|dir| !dir.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_usual_place_is_the_users_runtime_directory_then_that_of_the_service() {
        let dir = |variables: &[(&str, &str)]| {
            usual_dir(&|name| {
                variables.iter().find(|(n, _)| *n == name).map(|(_, value)| PathBuf::from(value))
            })
        };
        let (user, service) =
            (("XDG_RUNTIME_DIR", "/run/user/7"), ("RUNTIME_DIRECTORY", "/run/sgc:/run/more"));
        assert_eq!(dir(&[user, service]), Path::new("/run/user/7/sgc"));
        assert_eq!(dir(&[service]), Path::new("/run/sgc"));
        for wrong in ["", "relative"] {
            assert_eq!(dir(&[("XDG_RUNTIME_DIR", wrong), ("RUNTIME_DIRECTORY", wrong)]), temporary_dir());
        }
    }

    #[tokio::test]
    async fn node_removes_only_its_own_status_socket() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("sub/arm-1.sock");
        let first = StatusSocket::bind(&path).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(fs::metadata(path.parent().unwrap()).unwrap().permissions().mode() & 0o777, 0o700);
        assert!(matches!(StatusSocket::bind(&path), Err(SocketError::Taken)));
        drop(first);
        assert!(!path.exists());
        // The socket of a killed node is replaced; that of a node without a lock is not.
        drop(std::os::unix::net::UnixListener::bind(&path).unwrap());
        let second = StatusSocket::bind(&path).unwrap();
        assert!(second.is_in_place());
        fs::remove_file(&path).unwrap();
        let other = std::os::unix::net::UnixListener::bind(&path).unwrap();
        assert!(!second.is_in_place());
        drop(second);
        assert!(path.exists(), "it is not its own any more");
        assert!(matches!(StatusSocket::bind(&path), Err(SocketError::Taken)));
        drop(other);
        StatusSocket::bind(&path).unwrap();
    }

    #[test]
    fn a_directory_that_others_can_change_holds_no_socket() {
        let dir = tempfile::tempdir().unwrap();
        let check = |mode, anybody_makes| {
            fs::set_permissions(dir.path(), fs::Permissions::from_mode(mode)).unwrap();
            check_dir(dir.path(), anybody_makes).is_ok()
        };
        for (mode, in_tmp, chosen) in [
            (0o700, true, true),
            (0o755, false, true),
            (0o770, false, true),
            (0o1777, false, true),
            (0o777, false, false),
        ] {
            assert_eq!((check(mode, true), check(mode, false)), (in_tmp, chosen), "{mode:o}");
        }
        check(0o700, true);
        let link = dir.path().join("link");
        std::os::unix::fs::symlink(dir.path(), &link).unwrap();
        assert!(matches!(check_dir(&link, true), Err(SocketError::NoDirectory { .. })));
        check_dir(&link, false).unwrap();
        if own_uid() == ROOT {
            std::os::unix::fs::chown(dir.path(), Some(NOBODY), None).unwrap();
            for anybody_makes in [true, false] {
                let checked = check_dir(dir.path(), anybody_makes);
                assert!(matches!(checked, Err(SocketError::NotOurs { uid: NOBODY, .. })), "{checked:?}");
            }
        }
    }

    #[tokio::test]
    async fn group_of_a_service_may_use_its_socket() {
        let services = tempfile::tempdir().unwrap();
        let (dir, group) = (services.path().join("robot"), 0o750);
        let mode_of = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
        let set = |path: &Path, mode| fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
        fs::create_dir(&dir).unwrap();
        let path = dir.join("arm-1.sock");
        let is_root = own_uid() == ROOT;
        for (services_mode, mode, is_shared) in [
            (0o755, group, is_root),
            // Not for the group.
            (0o755, 0o700, false),
            // For everybody.
            (0o755, 0o755, false),
            // Others than root could have made the directory.
            (0o775, group, false),
            (0o777, group, false),
        ] {
            set(services.path(), services_mode);
            set(&dir, mode);
            let socket = StatusSocket::bind_in(&path, services.path()).unwrap();
            let expected = if is_shared { SHARED_SOCKET_MODE } else { OWN_SOCKET_MODE };
            assert_eq!(mode_of(&path), expected, "{services_mode:o} {mode:o}");
            assert_eq!(socket.may_ask(NOBODY), is_shared, "{services_mode:o} {mode:o}");
            assert!(socket.may_ask(own_uid()) && socket.may_ask(ROOT));
            // The same directory elsewhere is nobody's service.
            drop(socket);
            let socket = StatusSocket::bind_in(&path, dir.as_path()).unwrap();
            assert_eq!(mode_of(&path), OWN_SOCKET_MODE);
            assert_eq!(service_sockets(services.path()), std::slice::from_ref(&path));
            drop(socket);
        }
        assert!(service_sockets(services.path()).is_empty());
        assert!(service_sockets(Path::new("/nowhere")).is_empty());
    }

    const NOBODY: u32 = 65534;
    const SOCKET_VARIABLE: &str = "SGC_TEST_SOCKET";

    /// Runs in the process of another user: binds a socket until the test has seen it.
    #[test]
    fn another_users_socket() {
        let Some(path) = std::env::var_os(SOCKET_VARIABLE) else { return };
        let listener = std::os::unix::net::UnixListener::bind(path).unwrap();
        let _ = std::io::Read::read(&mut listener.accept().unwrap().0, &mut [0]);
    }

    #[test]
    fn a_socket_of_another_user_is_asked_nothing() {
        use std::os::unix::process::CommandExt;
        if own_uid() != ROOT {
            eprintln!("only root can be another user");
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        fs::set_permissions(dir.path(), fs::Permissions::from_mode(0o1777)).unwrap();
        let path = dir.path().join("arm-1.sock");
        // The user `nobody` may be unable to reach this program by its path.
        let mut command = std::process::Command::new("/proc/self/exe");
        command.args(["--exact", "admin::socket::tests::another_users_socket"]).env(SOCKET_VARIABLE, &path);
        let mut child = command.uid(NOBODY).gid(NOBODY).spawn().unwrap();
        let end = std::time::Instant::now() + std::time::Duration::from_secs(20);
        // The socket is there a moment before it accepts connections.
        let is_early = |error: &std::io::Error| {
            matches!(error.kind(), std::io::ErrorKind::NotFound | std::io::ErrorKind::ConnectionRefused)
        };
        let connected = loop {
            match connect(&path) {
                Err(SocketError::Io(error)) if is_early(&error) => {}
                connected => break connected,
            }
            assert!(std::time::Instant::now() < end && child.try_wait().unwrap().is_none());
            std::thread::yield_now();
        };
        assert!(
            matches!(connected, Err(SocketError::Stranger { uid: NOBODY, expected: ROOT })),
            "{connected:?}"
        );
        assert!(child.wait().unwrap().success());
    }
}
