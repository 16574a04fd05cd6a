//! Network namespaces, as `ip netns` makes them, for processes and threads. Dropping the value removes the namespace.

use std::ffi::OsStr;
use std::fs::{self, File};
use std::io;
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::thread::{LinkNameSpaceType, move_into_link_name_space};

/// The directory in which `ip netns` keeps namespaces.
const NAMESPACES: &str = "/run/netns";

/// The directory of shared memory. Each namespace has its own, because DDS implementations take programs that share one
/// for programs of the same host.
const SHARED_MEMORY: &str = "/dev/shm";

/// The reason why a network could not be made.
#[derive(Debug, thiserror::Error)]
pub enum NetsimError {
    /// A command of iproute2 or nftables failed.
    #[error("{command}: {why}")]
    Command {
        /// The command.
        command: String,
        /// Its error message.
        why: String,
    },
    /// The directory for shared memory could not be made.
    #[error("cannot make the folder {0:?}: {1}")]
    SharedMemory(PathBuf, io::Error),
    /// There is no such namespace.
    #[error("no network namespace {0:?}: make it with `ip netns add {0}`")]
    NoNamespace(String),
    /// The namespace exists, and this user may not enter it.
    #[error("cannot enter the network namespace {0:?}: {1} (it takes root)")]
    Enter(String, io::Error),
    /// No TUN device could be made.
    #[error("cannot make the TUN device {0:?}: {1} (it takes root, and /dev/net/tun)")]
    Tun(String, io::Error),
    /// No socket could be bound or reached.
    #[error("{0}: {1}")]
    Socket(String, io::Error),
    /// No thread could be started.
    #[error("no thread: {0}")]
    Thread(io::Error),
}

/// A namespace. Dropping it removes the namespace and everything in it.
#[derive(Debug)]
pub struct Namespace {
    name: String,
}

impl Namespace {
    /// Makes a namespace with its loopback interface up. Fails if one of that name exists.
    pub fn create(name: impl Into<String>) -> Result<Self, NetsimError> {
        let namespace = Self { name: name.into() };
        ip(&["netns", "add", &namespace.name])?;
        let memory = namespace.shared_memory();
        fs::create_dir(&memory).map_err(|e| NetsimError::SharedMemory(memory, e))?;
        namespace.ip(&["link", "set", "lo", "up"])?;
        Ok(namespace)
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Runs `ip` in the namespace.
    pub fn ip(&self, args: &[&str]) -> Result<String, NetsimError> {
        ip(&[&["-n", &self.name], args].concat())
    }

    /// Runs a program in the namespace to its end. Returns its output.
    pub fn run(&self, program: &str, args: &[&str]) -> Result<String, NetsimError> {
        finish(self.command(program).args(args))
    }

    /// Returns a command for a program in the namespace. The process is the program's own, because `ip` and the shell
    /// replace themselves by it.
    pub fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new("ip");
        // `ip` gives the process a mount namespace of its own.
        let script = format!("mount --bind \"$0\" {SHARED_MEMORY} && exec \"$@\"");
        command.args(["netns", "exec", &self.name, "sh", "-c", &script]);
        command.arg(self.shared_memory()).arg(program);
        command
    }

    /// Returns the directory that its programs see as [`SHARED_MEMORY`].
    fn shared_memory(&self) -> PathBuf {
        Path::new(SHARED_MEMORY).join(format!("netns-{}", self.name))
    }

    /// Makes a pair of interfaces that are up: one here with this name and these addresses, one there. Addresses have
    /// their prefix, as in `10.1.0.1/24`.
    pub fn veth(
        &self,
        ours: (&str, &[&str]),
        peer: &Self,
        theirs: (&str, &[&str]),
    ) -> Result<(), NetsimError> {
        ip(&[
            "link", "add", ours.0, "netns", &self.name, "type", "veth", "peer", "name", theirs.0, "netns",
            &peer.name,
        ])?;
        for (namespace, (interface, addresses)) in [(self, ours), (peer, theirs)] {
            namespace.bring_up(interface, addresses)?;
        }
        Ok(())
    }

    /// Gives an interface its addresses and brings it up.
    pub fn bring_up(&self, interface: &str, addresses: &[&str]) -> Result<(), NetsimError> {
        configure(Some(&self.name), interface, addresses, &[""; 0])
    }

    /// Moves the calling thread into the namespace for the rest of its life. Sockets that it opens belong to the
    /// namespace.
    pub fn enter(&self) -> Result<(), NetsimError> {
        enter(&self.name)
    }

    /// Runs a function in a thread in the namespace.
    pub fn within<T: Send>(&self, function: impl FnOnce() -> T + Send) -> Result<T, NetsimError> {
        within(Some(&self.name), function)
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        let _ = ip(&["netns", "delete", &self.name]);
        let _ = fs::remove_dir_all(self.shared_memory());
    }
}

/// Runs `ip` of iproute2. Returns its output.
pub fn ip(args: &[&str]) -> Result<String, NetsimError> {
    finish(Command::new("ip").args(args))
}

fn finish(command: &mut Command) -> Result<String, NetsimError> {
    let line = || {
        let words = std::iter::once(command.get_program()).chain(command.get_args());
        words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ")
    };
    let text = line();
    let output = command
        .output()
        .map_err(|error| NetsimError::Command { command: text.clone(), why: error.to_string() })?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    let why = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    Err(NetsimError::Command { command: text, why })
}

/// Moves the calling thread into a namespace: a name, or a path such as `/proc/PID/ns/net`.
fn enter(namespace: &str) -> Result<(), NetsimError> {
    let path = if namespace.contains('/') {
        PathBuf::from(namespace)
    } else {
        Path::new(NAMESPACES).join(namespace)
    };
    let file = File::open(&path).map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => NetsimError::NoNamespace(namespace.to_owned()),
        _ => NetsimError::Enter(namespace.to_owned(), error),
    })?;
    move_into_link_name_space(file.as_fd(), Some(LinkNameSpaceType::Network))
        .map_err(|error| NetsimError::Enter(namespace.to_owned(), error.into()))
}

/// Runs a function in a thread in a namespace, or in this one.
pub(super) fn within<T: Send>(
    namespace: Option<&str>,
    function: impl FnOnce() -> T + Send,
) -> Result<T, NetsimError> {
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new()
            .spawn_scoped(scope, || {
                namespace.map_or(Ok(()), enter)?;
                Ok(function())
            })
            .map_err(NetsimError::Thread)?;
        thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}

/// Gives an interface addresses and routes, and brings it up.
pub(super) fn configure(
    namespace: Option<&str>,
    interface: &str,
    addresses: &[impl AsRef<str> + Sync],
    routes: &[impl AsRef<str> + Sync],
) -> Result<(), NetsimError> {
    within(namespace, || {
        for address in addresses.iter().map(AsRef::as_ref) {
            // Without `nodad`, an IPv6 address is unusable for its first second.
            let unchecked: &[&str] = if address.contains(':') { &["nodad"] } else { &[] };
            ip(&[&["address", "add", address, "dev", interface], unchecked].concat())?;
        }
        ip(&["link", "set", interface, "up"])?;
        for route in routes.iter().map(AsRef::as_ref) {
            let family: &[&str] = if route.contains(':') { &["-6"] } else { &[] };
            ip(&[family, &["route", "add", route, "dev", interface]].concat())?;
        }
        Ok(())
    })?
}
