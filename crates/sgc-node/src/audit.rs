//! The audit log: who was granted, refused and cut off, who linked, and what was changed, one JSON line each.
//!
//! Writing never delays the control task: records go through a bounded channel to a thread of their own, and what
//! does not fit is counted and said in the log itself. Lines are handed to the system at once, so that a killed
//! process loses none that were written; they are forced to the disk when a file is put aside and when the node
//! stops, so that a loss of power may cost the last seconds. No key, token or message comes here.
//!
//! Each peer has quotas for the records that it can cause (`quota`): nobody pushes older records out of the files by
//! joining and leaving. Files are the business of `file`.

mod file;
mod quota;

use std::collections::BTreeMap;
use std::io;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use arc_swap::ArcSwap;
use serde::{Deserialize, Serialize};
use sgc_wire::{Name, NodeId, UnixMillis};
use tracing::warn;

use self::file::LogFile;
pub use self::file::{AuditRoom, Unread, read, rotated_path};
use self::quota::{Cause, Quotas};
use crate::core::now;

/// Records that may wait to be written.
const WAITING_MAX: usize = 1024;
/// Lines written at once.
const BATCH_MAX: usize = 64;
/// Longest text of one field, bytes.
const FIELD_BYTES_MAX: usize = 512;
/// Longest delay of a summary after its hour.
const SUMMARY_DELAY: Duration = Duration::from_secs(60);
const FILE_NAME: &str = "audit.jsonl";

/// What happened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
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
    /// An operator had this authority carry an operation out, or was refused.
    Operation,
    /// The configuration was read again.
    Reload,
    /// An access token was made for the gateway.
    TokenMade,
    /// One was taken back.
    TokenRevoked,
    /// One was shown at the gateway that does not hold.
    TokenRefused,
    /// One peer caused more records of one event than are written in an hour: the last of those, and their number.
    Summary,
    /// Records were lost.
    Lost,
}

impl AuditEvent {
    /// All of them.
    pub const ALL: [Self; 20] = [
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
        Self::Operation,
        Self::Reload,
        Self::TokenMade,
        Self::TokenRevoked,
        Self::TokenRefused,
        Self::Summary,
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
            Self::Operation => "operation",
            Self::Reload => "reload",
            Self::TokenMade => "token_made",
            Self::TokenRevoked => "token_revoked",
            Self::TokenRefused => "token_refused",
            Self::Summary => "summary",
            Self::Lost => "audit_lost",
        }
    }

    /// Returns who causes it where a record names no peer.
    fn cause(self) -> Cause {
        match self {
            Self::Crl | Self::Epoch | Self::Renewed => Cause::Fleet,
            _ => Cause::Local,
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
    /// Of a summary: the event of the records that it stands for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub of: Option<String>,
    /// Of a summary: how many records it stands for.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub count: Option<u64>,
    /// Of a summary: the time of the first of them. `time` is that of the last.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub from: Option<String>,
    #[serde(skip)]
    kind: Option<AuditEvent>,
    #[serde(skip)]
    cause: Cause,
    #[serde(skip)]
    about: Option<Name>,
}

impl AuditRecord {
    /// Something that happens now.
    pub fn new(event: AuditEvent) -> Self {
        Self::at(event, now().unix)
    }

    /// Something that happened at `unix`.
    pub fn at(event: AuditEvent, unix: UnixMillis) -> Self {
        let (label, cause) = (event.label().to_owned(), event.cause());
        let (time, kind) = (unix.to_string(), Some(event));
        Self { time, unix_ms: unix.0, event: label, kind, cause, ..Self::default() }
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
        self.about = Some(*name);
        self
    }

    /// By, or with, this peer.
    #[must_use]
    pub fn peer(mut self, peer: &NodeId) -> Self {
        self.peer = Some(peer.to_string());
        self.cause = Cause::Peer(*peer);
        self
    }

    /// At this address.
    #[must_use]
    pub fn remote(mut self, remote: SocketAddr) -> Self {
        self.remote = Some(remote.to_string());
        if !matches!(self.cause, Cause::Peer(_)) {
            self.cause = Cause::Address(remote.ip());
        }
        self
    }

    /// Because of a user of this machine: no quota counts it.
    #[must_use]
    pub fn by_user(mut self) -> Self {
        self.cause = Cause::Local;
        self.by("a user")
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
    shared: Option<Arc<AuditInner>>,
}

#[derive(Debug)]
struct AuditInner {
    records: SyncSender<Option<AuditRecord>>,
    lost: Arc<AtomicU64>,
    names: ArcSwap<PeerNames>,
    quotas: Arc<Mutex<Quotas>>,
    lost_total: AtomicU64,
}

impl AuditInner {
    fn send(&self, record: AuditRecord) {
        match self.records.try_send(Some(record)) {
            Ok(()) => {}
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                self.lost.fetch_add(1, Relaxed);
                self.lost_total.fetch_add(1, Relaxed);
            }
        }
    }
}

fn lock(quotas: &Mutex<Quotas>) -> MutexGuard<'_, Quotas> {
    quotas.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The thread that writes.
#[derive(Debug)]
pub struct AuditWriter {
    shared: Arc<AuditInner>,
    thread: JoinHandle<()>,
}

impl Audit {
    /// Opens the log at `path`; a line that an earlier run left unfinished is ended.
    pub fn open(path: &Path, room: AuditRoom, names: PeerNames) -> io::Result<(Self, AuditWriter)> {
        let file = LogFile::open(path, room)?;
        let (records, waiting) = sync_channel(WAITING_MAX);
        // The thread holds no sender: it ends when nobody can write any more.
        let (lost, quotas) = (Arc::<AtomicU64>::default(), Arc::<Mutex<Quotas>>::default());
        let shared = Arc::new(AuditInner {
            records,
            lost: lost.clone(),
            names: ArcSwap::from_pointee(names),
            quotas: quotas.clone(),
            lost_total: AtomicU64::new(0),
        });
        let thread = std::thread::Builder::new()
            .name("sgc-audit".to_owned())
            .spawn(move || write_all(file, &waiting, &lost, &quotas))?;
        let audit = Self { shared: Some(shared.clone()) };
        Ok((audit, AuditWriter { shared, thread }))
    }

    /// Hands a record over; never waits.
    pub fn write(&self, mut record: AuditRecord) {
        let Some(shared) = &self.shared else { return };
        if let Cause::Peer(peer) = &record.cause {
            record.peer_name = shared.names.load().get(peer).cloned();
        }
        let mut records = Vec::with_capacity(1);
        lock(&shared.quotas).handle(record, &mut records);
        records.into_iter().for_each(|record| shared.send(record));
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

    /// Records that stand in summaries only, since the node started.
    pub fn summed_up_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| lock(&shared.quotas).left_out())
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
    // The node alone puts its log aside.
    let mut file = LogFile::open(path, AuditRoom { max_bytes: u64::MAX, files: 1 })?;
    let mut line = String::new();
    push_line(&mut line, record);
    file.append(&line)?;
    file.sync()
}

/// Where a node with this state directory keeps its log.
pub fn audit_path(configured: Option<&Path>, state: Option<&Path>) -> Option<PathBuf> {
    configured.map(Path::to_owned).or_else(|| Some(state?.join(FILE_NAME)))
}

fn write_all(
    mut file: LogFile,
    waiting: &Receiver<Option<AuditRecord>>,
    lost: &AtomicU64,
    quotas: &Mutex<Quotas>,
) {
    let mut is_failing = false;
    let mut ends = false;
    while !ends {
        let mut records = Vec::new();
        match waiting.recv_timeout(SUMMARY_DELAY) {
            Ok(Some(record)) => records.push(record),
            Err(RecvTimeoutError::Timeout) => lock(quotas).sweep(now().unix.0, &mut records),
            Ok(None) | Err(RecvTimeoutError::Disconnected) => ends = true,
        }
        while !ends && records.len() < BATCH_MAX {
            match waiting.try_recv() {
                Ok(Some(record)) => records.push(record),
                Ok(None) => ends = true,
                Err(_) => break,
            }
        }
        if ends {
            lock(quotas).finish(&mut records);
        }
        let missing = lost.swap(0, Relaxed);
        if records.is_empty() && missing == 0 {
            continue;
        }
        let mut lines = String::new();
        records.iter().for_each(|record| push_line(&mut lines, record));
        if missing > 0 {
            let record = AuditRecord { lost: Some(missing), ..AuditRecord::new(AuditEvent::Lost) };
            push_line(&mut lines, &record);
        }
        match file.append(&lines) {
            Ok(()) => is_failing = false,
            Err(error) => {
                lost.fetch_add(missing + records.len() as u64, Relaxed);
                if !std::mem::replace(&mut is_failing, true) {
                    warn!(path = %file.path().display(), %error, "the audit log cannot be written; losses are counted");
                }
            }
        }
    }
    let _ = file.sync();
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
