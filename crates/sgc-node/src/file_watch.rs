//! Reads the configuration again when its file changes, or one of those that it names.
//!
//! The kernel's messages are a bell: what changed is seen by looking at the files, whatever an editor did to them: wrote
//! them, put others in their place, or turned a link that leads to them. It decides nothing: [`Reloader`] judges and
//! carries out.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rustix::fs::inotify::{self, CreateFlags, WatchFlags};
use rustix::io::Errno;
use tokio::net::unix::pipe::Receiver;
use tracing::{debug, warn};

use crate::config::{Config, TokenSource};
use crate::reload::Reloader;

/// How long nothing may happen before files are looked at: editors take several steps.
const QUIET: Duration = Duration::from_millis(200);
/// How long is waited for quiet, in a directory where something always happens.
const UNQUIET_MAX: Duration = Duration::from_secs(2);
/// What is done to a file that may be another then. Not that something is written to it: it is when it is closed.
const CHANGES: WatchFlags = WatchFlags::CLOSE_WRITE
    .union(WatchFlags::CREATE)
    .union(WatchFlags::DELETE)
    .union(WatchFlags::MOVED_FROM)
    .union(WatchFlags::MOVED_TO);

/// A configuration's file and what it names, as they were when it was read.
pub(crate) struct FileWatch {
    file: PathBuf,
    files: Vec<PathBuf>,
    seen: Look,
}

impl FileWatch {
    /// `file` holds `config`, as of now.
    pub(crate) fn begin(file: PathBuf, config: &Config) -> Self {
        let files = files_of(&file, config);
        let seen = look(&files);
        Self { file, files, seen }
    }

    /// Has it read again when something changes, for as long as the node runs.
    pub(crate) async fn run(self, reloader: Arc<Reloader>) {
        let file = self.file.display().to_string();
        if let Err(error) = self.try_run(&reloader).await {
            warn!(%file, %error, "the configuration cannot be watched; `sgc reload` and SIGHUP have it read again");
        }
    }

    async fn try_run(self, reloader: &Reloader) -> io::Result<()> {
        let Self { file, mut files, mut seen } = self;
        let mut bell = Bell::new(seen.directories.clone())?;
        loop {
            let found = look_aside(&files).await?;
            if found.directories != bell.directories {
                bell = Bell::new(found.directories.clone())?;
                // Something may have happened there before.
                continue;
            }
            // While a file is being replaced there may be none.
            if found.prints != seen.prints && found.prints.iter().all(Option::is_some) {
                debug!(file = %file.display(), "changed");
                seen = found;
                // What is wrong is in the log; nobody waits for an answer.
                let _ = reloader.reload("the file's change").await;
                let named = files_of(&file, &reloader.config().await);
                if named != files {
                    files = named;
                    // What is new may have changed since it was read: once more.
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

/// The configuration's file and those that it names and that count while the node runs.
fn files_of(file: &Path, config: &Config) -> Vec<PathBuf> {
    let tokens = config.tokens.iter().filter_map(|token| match &token.source {
        TokenSource::File(path) => Some(path),
        TokenSource::Text(_) => None,
    });
    let cas = config.partners.iter().map(|partner| &partner.ca).chain(&config.trust).chain(&config.accept);
    let shown = config.gateway.iter().filter_map(|gateway| gateway.tls.as_ref());
    let shown = shown.flat_map(|tls| [&tls.certificate, &tls.key]);
    let named: BTreeSet<PathBuf> = tokens.chain(cas).chain(shown).cloned().collect();
    std::iter::once(file.to_owned()).chain(named).collect()
}

/// Files as they are at one moment.
struct Look {
    /// What tells whether a file is another; nothing if it is not there.
    prints: Vec<Option<Print>>,
    /// Where something may happen to them: where they are, and where links lead.
    directories: BTreeSet<PathBuf>,
}

/// Device, number, length, and when it was written in seconds and nanoseconds.
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

/// The same where it may take a while.
async fn look_aside(files: &[PathBuf]) -> io::Result<Look> {
    let files = files.to_vec();
    tokio::task::spawn_blocking(move || look(&files)).await.map_err(io::Error::other)
}

/// Rings when something happens in one of the directories.
struct Bell {
    /// It is read as a pipe is, and as little as of one is asked of it.
    inotify: Receiver,
    directories: BTreeSet<PathBuf>,
}

impl Bell {
    fn new(directories: BTreeSet<PathBuf>) -> io::Result<Self> {
        let inotify = inotify::init(CreateFlags::CLOEXEC | CreateFlags::NONBLOCK)?;
        for directory in &directories {
            // One that is gone says nothing; that it comes back is not noticed before something else happens.
            match inotify::add_watch(&inotify, directory, CHANGES) {
                Ok(_) | Err(Errno::NOENT | Errno::NOTDIR) => {}
                Err(error) => return Err(error.into()),
            }
        }
        Ok(Self { inotify: Receiver::from_owned_fd_unchecked(inotify)?, directories })
    }

    /// Waits for the next ring; those that came together are one.
    async fn rings(&self) -> io::Result<()> {
        // Names of files are up to 255 bytes.
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
    fn gateway_certificate_files_are_watched_like_other_files() {
        let text = "identity = 'x'\n[node]\nrouters = ['quic://r']\n[gateway]\nlisten = ['wss://0.0.0.0']\n\
                    certificate = 'a.pem'\nkey = 'a.key'\n";
        let config = crate::config::parse(text, "node.toml", Path::new("/etc/sgc"), &|_| None).unwrap();
        let files = files_of(Path::new("/etc/sgc/node.toml"), &config);
        let wanted = ["/etc/sgc/node.toml", "/etc/sgc/a.key", "/etc/sgc/a.pem"].map(PathBuf::from);
        assert_eq!(files, wanted);
    }
}
