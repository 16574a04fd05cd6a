//! The audit log: who was granted, refused and cut off, who linked, and what was changed, one JSON line each.
//!
//! Writing never delays the control task: records go through a bounded channel to a thread of their own, and what
//! does not fit is counted and said in the log itself. Lines are handed to the system at once, so that a killed
//! process loses none that were written; they are forced to the disk when a file is put aside and when the node
//! stops, so that a loss of power may cost the last seconds. No key, token or message comes here.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;

use arc_swap::ArcSwap;
use rustix::fs::OFlags;
use serde::{Deserialize, Serialize};
use sgc_wire::{Name, NodeId, UnixMillis};
use tracing::warn;

use crate::core::now;

/// Records that may wait to be written.
const WAITING_MAX: usize = 1024;
/// Lines written at once.
const BATCH_MAX: usize = 64;
/// Longest text of one field, bytes.
const FIELD_BYTES_MAX: usize = 512;
/// Longest line that is read, bytes; those written are shorter.
const LINE_BYTES_MAX: u64 = 16 * 1024;
const FILE_NAME: &str = "audit.jsonl";
/// Refusals of one kind kept in a minute: whoever is refused for ever must not push out what is older.
const REFUSALS_PER_MINUTE_MAX: u32 = 120;
const MINUTE_MS: u64 = 60_000;
/// The kinds of them.
const REFUSALS: [AuditEvent; 3] = [AuditEvent::Refused, AuditEvent::LinkRefused, AuditEvent::TokenRefused];

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AuditEvent {
    /// The node started.
    Started,
    /// The node stopped in good order.
    Stopped,
    /// Somebody was granted a share.
    Granted,
    /// Somebody was refused a share.
    Refused,
    /// Somebody left a share.
    Left,
    /// Somebody's certificate was revoked.
    Revoked,
    /// Somebody lost a share that was granted.
    Cut,
    /// A share has a new key.
    Epoch,
    /// A link was made.
    LinkUp,
    /// A peer was refused at the door.
    LinkRefused,
    /// A link ended.
    LinkClosed,
    /// A revocation list came into force.
    Crl,
    /// This node's certificate was renewed, or it renewed another's.
    Renewed,
    /// The configuration was read again.
    Reload,
    /// An access token was made for the gateway.
    TokenMade,
    /// One was taken back.
    TokenRevoked,
    /// One was shown at the gateway that does not hold.
    TokenRefused,
    /// Records were lost.
    Lost,
}

impl AuditEvent {
    /// All of them.
    pub const ALL: [Self; 18] = [
        Self::Started,
        Self::Stopped,
        Self::Granted,
        Self::Refused,
        Self::Left,
        Self::Revoked,
        Self::Cut,
        Self::Epoch,
        Self::LinkUp,
        Self::LinkRefused,
        Self::LinkClosed,
        Self::Crl,
        Self::Renewed,
        Self::Reload,
        Self::TokenMade,
        Self::TokenRevoked,
        Self::TokenRefused,
        Self::Lost,
    ];

    /// As it stands in the log.
    pub fn label(self) -> &'static str {
        match self {
            Self::Started => "started",
            Self::Stopped => "stopped",
            Self::Granted => "granted",
            Self::Refused => "refused",
            Self::Left => "left",
            Self::Revoked => "revoked",
            Self::Cut => "cut",
            Self::Epoch => "epoch",
            Self::LinkUp => "link_up",
            Self::LinkRefused => "link_refused",
            Self::LinkClosed => "link_closed",
            Self::Crl => "crl",
            Self::Renewed => "renewed",
            Self::Reload => "reload",
            Self::TokenMade => "token_made",
            Self::TokenRevoked => "token_revoked",
            Self::TokenRefused => "token_refused",
            Self::Lost => "audit_lost",
        }
    }
}

/// One line. What does not concern an event is absent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct AuditRecord {
    /// When, RFC 3339, UTC.
    pub time: String,
    /// When, milliseconds since 1970.
    pub unix_ms: u64,
    /// What: [`AuditEvent::label`], or what a later version knows.
    pub event: String,
    /// The ROS topic.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub topic: Option<String>,
    /// Its name, hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// The peer's node id, hexadecimal digits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peer: Option<String>,
    /// What the configuration calls the peer.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub peer_name: Option<String>,
    /// The peer's address.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub remote: Option<String>,
    /// Why.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What caused it: an entry of the policy, a user, a CA.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// The epoch.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub epoch: Option<u32>,
    /// Records that were lost.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lost: Option<u64>,
}

impl AuditRecord {
    /// Something that happens now.
    pub fn new(event: AuditEvent) -> Self {
        Self::at(event, now().unix)
    }

    /// Something that happened at `unix`.
    pub fn at(event: AuditEvent, unix: UnixMillis) -> Self {
        let event = event.label().to_owned();
        Self { time: unix.to_string(), unix_ms: unix.0, event, ..Self::default() }
    }

    /// On this topic.
    #[must_use]
    pub fn topic(mut self, topic: Option<&str>) -> Self {
        self.topic = topic.map(bounded);
        self
    }

    /// Under this name.
    #[must_use]
    pub fn name(mut self, name: &Name) -> Self {
        self.name = Some(name.to_string());
        self
    }

    /// By, or with, this peer.
    #[must_use]
    pub fn peer(mut self, peer: &NodeId) -> Self {
        self.peer = Some(peer.to_string());
        self
    }

    /// At this address.
    #[must_use]
    pub fn remote(mut self, remote: impl ToString) -> Self {
        self.remote = Some(bounded(&remote.to_string()));
        self
    }

    /// For this reason.
    #[must_use]
    pub fn reason(mut self, reason: impl ToString) -> Self {
        self.reason = Some(bounded(&reason.to_string()));
        self
    }

    /// Because of this.
    #[must_use]
    pub fn by(mut self, by: impl ToString) -> Self {
        self.by = Some(bounded(&by.to_string()));
        self
    }

    /// Of this epoch.
    #[must_use]
    pub fn epoch(mut self, epoch: u32) -> Self {
        self.epoch = Some(epoch);
        self
    }
}

/// What peers are called.
pub type PeerNames = BTreeMap<NodeId, String>;

/// Where records go; cheap to clone. One that is off takes them, too.
#[derive(Clone, Debug, Default)]
pub struct Audit {
    shared: Option<Arc<Shared>>,
}

#[derive(Debug)]
struct Shared {
    records: SyncSender<Option<AuditRecord>>,
    lost: Arc<AtomicU64>,
    names: ArcSwap<PeerNames>,
    refusals: [Mutex<Window>; REFUSALS.len()],
    lost_total: AtomicU64,
}

impl Shared {
    fn lose(&self) {
        self.lost.fetch_add(1, Relaxed);
        self.lost_total.fetch_add(1, Relaxed);
    }
}

/// How many there were in a minute.
#[derive(Debug, Default)]
struct Window {
    minute: u64,
    count: u32,
}

impl Window {
    /// Whether one more fits into the minute of `unix_ms`.
    fn takes(&mut self, unix_ms: u64) -> bool {
        let minute = unix_ms / MINUTE_MS;
        if self.minute != minute {
            *self = Self { minute, count: 0 };
        }
        self.count = self.count.saturating_add(1);
        self.count <= REFUSALS_PER_MINUTE_MAX
    }
}

/// The thread that writes.
#[derive(Debug)]
pub struct AuditWriter {
    shared: Arc<Shared>,
    thread: JoinHandle<()>,
}

impl Audit {
    /// Opens the log at `path`; a line that an earlier run left unfinished is ended.
    pub fn open(path: &Path, max_bytes: u64, names: PeerNames) -> io::Result<(Self, AuditWriter)> {
        let file = LogFile::open(path, max_bytes)?;
        let (records, waiting) = sync_channel(WAITING_MAX);
        // The thread holds no sender: it ends when nobody can write any more.
        let lost = Arc::<AtomicU64>::default();
        let shared = Arc::new(Shared {
            records,
            lost: lost.clone(),
            names: ArcSwap::from_pointee(names),
            refusals: Default::default(),
            lost_total: AtomicU64::new(0),
        });
        let thread = std::thread::Builder::new()
            .name("sgc-audit".to_owned())
            .spawn(move || write_all(file, &waiting, &lost))?;
        let audit = Self { shared: Some(shared.clone()) };
        Ok((audit, AuditWriter { shared, thread }))
    }

    /// Hands a record over; never waits.
    pub fn write(&self, mut record: AuditRecord) {
        let Some(shared) = &self.shared else { return };
        let refusal = REFUSALS.iter().position(|event| event.label() == record.event);
        if let Some(Ok(mut window)) = refusal.and_then(|at| shared.refusals.get(at)).map(Mutex::lock)
            && !window.takes(record.unix_ms)
        {
            shared.lose();
            return;
        }
        if let Some(peer) = record.peer.as_deref().and_then(|peer| peer.parse::<NodeId>().ok()) {
            record.peer_name = shared.names.load().get(&peer).cloned();
        }
        match shared.records.try_send(Some(record)) {
            Ok(()) => {}
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                shared.lose();
            }
        }
    }

    /// Peers are called otherwise from now on.
    pub fn set_names(&self, names: PeerNames) {
        if let Some(shared) = &self.shared {
            shared.names.store(Arc::new(names));
        }
    }

    /// What a peer is called, if it is known by a name.
    pub fn name_of(&self, peer: &NodeId) -> Option<String> {
        self.shared.as_ref()?.names.load().get(peer).cloned()
    }

    /// Records that did not fit, since the node started.
    pub fn lost_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.lost_total.load(Relaxed))
    }

    /// Records that were lost and not yet said to be.
    pub fn lost(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.lost.load(Relaxed))
    }
}

impl AuditWriter {
    /// Waits until everything is written and on the disk. What comes later is lost.
    pub fn finish(self) {
        let _ = self.shared.records.send(None);
        let _ = self.thread.join();
    }
}

/// Adds a record to the log at `path` from beside the node that writes it, which may run or not. It is on the disk then.
pub fn append(path: &Path, record: &AuditRecord) -> io::Result<()> {
    // How long the log may be is for the node to say, which puts it aside.
    let mut file = LogFile::open(path, u64::MAX)?;
    let mut line = String::new();
    push_line(&mut line, record);
    file.append(&line)?;
    file.file.sync_data()
}

/// Where a node with this state directory keeps its log.
pub fn audit_path(configured: Option<&Path>, state: Option<&Path>) -> Option<PathBuf> {
    configured.map(Path::to_owned).or_else(|| Some(state?.join(FILE_NAME)))
}

/// Where the log that was put aside is.
pub fn old_path(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(".1");
    PathBuf::from(name)
}

/// Reads what was put aside and what is written now, in order; gives each record to `take`, and how many lines were
/// none.
pub fn read(path: &Path, mut take: impl FnMut(AuditRecord)) -> io::Result<u64> {
    let mut malformed = 0;
    let mut any = false;
    for path in [old_path(path), path.to_owned()] {
        let file = match fs::File::open(&path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => continue,
            file => file?,
        };
        any = true;
        let mut reader = BufReader::new(file);
        let mut line = Vec::new();
        let mut is_tail = false;
        loop {
            line.clear();
            let n = (&mut reader).take(LINE_BYTES_MAX).read_until(b'\n', &mut line)?;
            if n == 0 {
                break;
            }
            let ends = line.last() == Some(&b'\n');
            // The rest of a line that was too long belongs to it.
            if !std::mem::replace(&mut is_tail, !ends) {
                match serde_json::from_slice::<AuditRecord>(&line) {
                    Ok(record) if !record.event.is_empty() => take(record),
                    _ if line.trim_ascii().is_empty() => {}
                    _ => malformed += 1,
                }
            }
        }
    }
    if any { Ok(malformed) } else { Err(io::ErrorKind::NotFound.into()) }
}

/// A log that is written to.
struct LogFile {
    path: PathBuf,
    max_bytes: u64,
    file: fs::File,
    bytes: u64,
    /// A line was begun and not ended.
    is_torn: bool,
}

impl LogFile {
    fn open(path: &Path, max_bytes: u64) -> io::Result<Self> {
        // A link could lead the log elsewhere; what is no file could hold up whoever opens it.
        let flags = (OFlags::NOFOLLOW | OFlags::NONBLOCK).bits() as i32;
        let mut options = fs::OpenOptions::new();
        let options = options.read(true).append(true).create(true).mode(0o600).custom_flags(flags);
        let mut file = options.open(path)?;
        let metadata = file.metadata()?;
        if !metadata.is_file() {
            return Err(io::Error::other("it is not a file"));
        }
        file.set_permissions(fs::Permissions::from_mode(0o600))?;
        let mut is_torn = false;
        if metadata.len() > 0 {
            file.seek(SeekFrom::End(-1))?;
            let mut last = [0];
            file.read_exact(&mut last)?;
            is_torn = last != *b"\n";
        }
        Ok(Self { path: path.to_owned(), max_bytes, file, bytes: metadata.len(), is_torn })
    }

    fn append(&mut self, lines: &str) -> io::Result<()> {
        if self.bytes > 0 && self.bytes + lines.len() as u64 > self.max_bytes {
            self.file.sync_data()?;
            fs::rename(&self.path, old_path(&self.path))?;
            *self = Self::open(&self.path, self.max_bytes)?;
        }
        if self.is_torn {
            self.write(b"\n")?;
        }
        self.write(lines.as_bytes())
    }

    /// A write that fails may have written a part.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.is_torn = true;
        self.file.write_all(bytes)?;
        self.bytes += bytes.len() as u64;
        self.is_torn = false;
        Ok(())
    }
}

fn write_all(mut file: LogFile, waiting: &Receiver<Option<AuditRecord>>, lost: &AtomicU64) {
    let mut is_failing = false;
    let mut ends = false;
    while !ends {
        let mut lines = String::new();
        let mut count = 0;
        let Ok(first) = waiting.recv() else { break };
        let mut next = Some(first);
        while let Some(record) = next {
            let Some(record) = record else {
                ends = true;
                break;
            };
            push_line(&mut lines, &record);
            count += 1;
            next = (count < BATCH_MAX).then(|| waiting.try_recv().ok()).flatten();
        }
        let missing = lost.swap(0, Relaxed);
        if missing > 0 {
            let record = AuditRecord { lost: Some(missing), ..AuditRecord::new(AuditEvent::Lost) };
            push_line(&mut lines, &record);
        }
        match file.append(&lines) {
            Ok(()) => is_failing = false,
            Err(error) => {
                lost.fetch_add(missing + count as u64, Relaxed);
                if !std::mem::replace(&mut is_failing, true) {
                    warn!(path = %file.path.display(), %error, "the audit log cannot be written; losses are counted");
                }
            }
        }
    }
    let _ = file.file.sync_data();
}

fn push_line(lines: &mut String, record: &AuditRecord) {
    if let Ok(line) = serde_json::to_string(record) {
        lines.push_str(&line);
        lines.push('\n');
    }
}

fn bounded(text: &str) -> String {
    let end = (0..=FIELD_BYTES_MAX).rev().find(|at| text.is_char_boundary(*at)).unwrap_or(0);
    text.get(..end).unwrap_or(text).to_owned()
}
