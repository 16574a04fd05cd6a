//! Reloads the configuration when its file, or a file that it names, changes.
//!
//! A message of the kernel is only a trigger. The files themselves show the change, whether an editor wrote them,
//! replaced them, or changed a symbolic link to them. [`Reloader`] judges and applies the configuration.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use sgc_config::{Config, TokenSource};
use tokio::net::unix::pipe::Receiver;
use tracing::{debug, warn};

use crate::control::settings::reload::Reloader;

/// Quiet time before the files are read, since editors take several steps.
const QUIET: Duration = Duration::from_millis(200);
/// Longest wait for quiet, in a directory with constant changes.
const UNQUIET_MAX: Duration = Duration::from_secs(2);
/// Events after which a file may have changed. Writing is not among them, since closing follows it.
const CHANGES: WatchFlags = WatchFlags::CLOSE_WRITE
    .union(WatchFlags::CREATE)
    .union(WatchFlags::DELETE)
    .union(WatchFlags::MOVED_FROM)
    .union(WatchFlags::MOVED_TO);

/// The files of a configuration, with their state when they were read.
pub(crate) struct FileWatch {
    file: PathBuf,
    /// The identity. Without it, a node goes on.
    identity: PathBuf,
    files: Vec<PathBuf>,
    seen: Look,
}

impl FileWatch {
    /// Starts to watch the files of `config`, which was read from `file`.
    pub(crate) fn begin(file: PathBuf, config: &Config) -> Self {
        let files = files_of(&file, config);
        let seen = look(&files);
        Self { file, identity: config.identity.clone(), files, seen }
    }

    /// Reloads after each change, for as long as the node runs.
    pub(crate) async fn run(self, reloader: Arc<Reloader>) {
        let file = self.file.display().to_string();
        if let Err(error) = self.try_run(&reloader).await {
            warn!(%file, %error, "the configuration cannot be watched; `sgc reload` and SIGHUP have it read again");
        }
    }

    async fn try_run(self, reloader: &Reloader) -> io::Result<()> {
        let Self { file, identity, mut files, mut seen } = self;
        let mut bell = Bell::new(seen.directories.clone())?;
        loop {
            let found = look_blocking(&files).await?;
            if found.directories != bell.directories {
                bell = Bell::new(found.directories.clone())?;
                // A change may have preceded the watch.
                continue;
            }
            // While a file is being replaced, it may be missing.
            let is_whole =
                || files.iter().zip(&found.prints).all(|(file, print)| print.is_some() || *file == identity);
            if found.prints != seen.prints && is_whole() {
                debug!(file = %file.display(), "changed");
                seen = found;
                // The log has the error; nobody waits for the result.
                let _ = reloader.reload("the file's change").await;
                let named = files_of(&file, &reloader.config().await);
                if named != files {
                    files = named;
                    // A newly named file may have changed since it was read, so the files are compared again.
                    seen.prints.clear();
                }
                continue;
            }
            bell.rings().await?;
            let begin = Instant::now();
            while begin.elapsed() < UNQUIET_MAX
                && let Ok(rings) = tokio::time::timeout(QUIET, bell.rings()).await
            {
                rings?;
            }
        }
    }
}

/// Returns the files that a running node's configuration depends on.
fn files_of(file: &Path, config: &Config) -> Vec<PathBuf> {
    let tokens = config.tokens.iter().filter_map(|token| match &token.source {
        TokenSource::File(path) => Some(path),
        TokenSource::Text(_) => None,
    });
    let cas = config.partners.iter().map(|partner| &partner.ca).chain(&config.trust).chain(&config.accept);
    let shown = config.gateway.iter().filter_map(|gateway| gateway.tls.as_ref());
    let shown = shown.flat_map(|tls| [&tls.certificate, &tls.key]);
    let otlp = config.metrics.iter().filter_map(|metrics| metrics.otlp.as_ref());
    let otlp = otlp.flat_map(|otlp| otlp.headers_file.iter().chain(&otlp.ca));
    let own = std::iter::once(&config.identity);
    let named: BTreeSet<PathBuf> = own.chain(tokens).chain(cas).chain(shown).chain(otlp).cloned().collect();
    std::iter::once(file.to_owned()).chain(named).collect()
}

/// State of the files at one moment.
struct Look {
    /// Fingerprint of each file; `None` if it is missing.
    prints: Vec<Option<Print>>,
    /// Directories of the files, and of the targets of symbolic links.
    directories: BTreeSet<PathBuf>,
}

/// Device, inode, length, and time of modification in seconds and nanoseconds.
type Print = (u64, u64, u64, i64, i64);

fn look(files: &[PathBuf]) -> Look {
    let print = |path: &PathBuf| {
        let m = fs::metadata(path).ok()?;
        Some((m.dev(), m.ino(), m.len(), m.mtime(), m.mtime_nsec()))
    };
    let parent = |path: &Path| match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => Some(parent.to_owned()),
        _ => Some(PathBuf::from(".")),
    };
    let target = |path: &PathBuf| parent(&fs::canonicalize(path).ok()?);
    let directories = files.iter().filter_map(|path| parent(path)).chain(files.iter().filter_map(target));
    Look { prints: files.iter().map(print).collect(), directories: directories.collect() }
}

/// Looks at the files on a blocking thread.
async fn look_blocking(files: &[PathBuf]) -> io::Result<Look> {
    let files = files.to_vec();
    tokio::task::spawn_blocking(move || look(&files)).await.map_err(io::Error::other)
}

/// Notifies of events in the watched directories.
struct Bell {
    /// The inotify descriptor, read like a pipe.
    inotify: Receiver,
    directories: BTreeSet<PathBuf>,
}

impl Bell {
    fn new(directories: BTreeSet<PathBuf>) -> io::Result<Self> {
        let inotify = inotify::init(CreateFlags::CLOEXEC | CreateFlags::NONBLOCK)?;
        for directory in &directories {
            // A missing directory cannot be watched. Its return is noticed at the next other event.
            match inotify::add_watch(&inotify, directory, CHANGES) {
                Ok(_) | Err(Errno::NOENT | Errno::NOTDIR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(Self { inotify: Receiver::from_owned_fd_unchecked(inotify)?, directories })
    }

    /// Waits for the next event. Simultaneous events count as one.
    async fn rings(&self) -> io::Result<()> {
        // File names have up to 255 bytes.
        let mut buffer = [0; 4096];
        let mut rang = false;
        while !rang {
            self.inotify.readable().await?;
            loop {
                match self.inotify.try_read(&mut buffer) {
                    Ok(_) => rang = true,
                    Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                    Err(error) if error.kind() == io::ErrorKind::WouldBlock => break,
                    Err(error) => return Err(error),
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(feature = "otlp")]
    fn files_for_a_collector_are_watched_like_other_files() {
        let text = "identity = 'x'\n[node]\nrouters = ['quic://r']\n[metrics]\notlp = 'https://a'\n\
                    otlp_headers_file = 'a.headers'\notlp_ca = 'a.pem'\n";
        let config = sgc_config::parse(text, "node.toml", Path::new("/etc/sgc"), &|_| None).unwrap();
        let files = files_of(Path::new("/etc/sgc/node.toml"), &config);
        let wanted =
            ["/etc/sgc/node.toml", "/etc/sgc/a.headers", "/etc/sgc/a.pem", "/etc/sgc/x"].map(PathBuf::from);
        assert_eq!(files, wanted);
    }

    #[test]
    fn gateway_certificate_files_are_watched_like_other_files() {
        let text = "identity = 'x'\n[node]\nrouters = ['quic://r']\n[gateway]\nlisten = ['wss://0.0.0.0']\n\
                    certificate = 'a.pem'\nkey = 'a.key'\n";
        let config = sgc_config::parse(text, "node.toml", Path::new("/etc/sgc"), &|_| None).unwrap();
        let files = files_of(Path::new("/etc/sgc/node.toml"), &config);
        let wanted =
            ["/etc/sgc/node.toml", "/etc/sgc/a.key", "/etc/sgc/a.pem", "/etc/sgc/x"].map(PathBuf::from);
        assert_eq!(files, wanted);
    }
}
