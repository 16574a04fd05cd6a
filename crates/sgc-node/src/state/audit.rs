//! The audit log: grants, refusals, revocations, links and changes of configuration, one JSON line each.
//!
//! Writing never delays the control task. Records go through a bounded channel to a thread; records that do not fit are
//! counted, and the log itself reports them. Lines are passed to the system at once, so a killed process loses none
//! that were written. They are synced to the disk when a file is rotated and when the node stops, so a loss of power
//! may cost the last seconds. The log holds no key, token or message.
//!
//! Each peer has quotas for the records that it causes (`quota`), so nobody displaces older records by joining and
//! leaving. `file` handles the files.

mod file;
mod quota;
mod recent;
mod record;

use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

pub use sgc_config::AuditRoom;
use sgc_sync::lock;
use tracing::warn;

use self::file::LogFile;
pub use self::file::{Unread, read, rotated_path};
use self::quota::Quotas;
pub use self::recent::RECENT_MAX;
pub(crate) use self::recent::RECENT_OF_FLEET_MAX;
use self::recent::Recent;
use self::record::Cause;
pub use self::record::{AUDIT_ID_CHARS, AuditEvent, AuditRecord};
use crate::clock::now;
use crate::control::faults::alerts::Alert;
use crate::state::is_storage_fault;
pub use crate::state::peer_names::PeerNames;

/// Records that may wait to be written.
const WAITING_MAX: usize = 1024;
/// Lines written at once.
const BATCH_MAX: usize = 64;
/// Interval of attempts to write while the log cannot be written.
const RETRY_EVERY: Duration = Duration::from_secs(5);
/// Longest delay of a summary after its hour.
const SUMMARY_DELAY: Duration = Duration::from_secs(60);
const FILE_NAME: &str = "audit.jsonl";

/// Handle of the log, cheap to clone. A log that is switched off accepts records and drops them.
#[derive(Clone, Debug, Default)]
pub struct Audit {
    shared: Option<Arc<AuditInner>>,
}

/// The place of a log: its file, and the room for it.
pub(crate) type AuditPlace = (PathBuf, AuditRoom);

#[derive(Debug)]
struct AuditInner {
    entries: SyncSender<Entry>,
    /// `false` while the log is switched off.
    is_on: AtomicBool,
    losses: Arc<Losses>,
    names: PeerNames,
    quotas: Arc<Mutex<Quotas>>,
    recent: Mutex<Recent>,
}

/// Something for the writing thread.
enum Entry {
    Record(Box<AuditRecord>),
    /// Later records go to this file, or nowhere.
    Move(Option<LateFile>),
    End,
}

/// Records that are not in the log.
#[derive(Debug, Default)]
struct Losses {
    /// Those that the log has not reported yet.
    unreported: AtomicU64,
    /// Those since the node started.
    total: AtomicU64,
    /// The file and the error of the last attempt to write, if it failed.
    failure: Mutex<Option<(PathBuf, String)>>,
}

impl Losses {
    fn add(&self, records: u64) {
        self.unreported.fetch_add(records, Relaxed);
        self.total.fetch_add(records, Relaxed);
    }

    fn is_failing(&self) -> bool {
        lock(&self.failure).is_some()
    }

    /// Notes a failed attempt to write. The log of the node names the first of several.
    fn failed(&self, path: &Path, error: &io::Error) {
        let failure = (path.to_owned(), error.to_string());
        if lock(&self.failure).replace(failure).is_none() {
            warn!(path = %path.display(), %error, "the audit log cannot be written; losses are counted");
        }
    }

    fn written(&self) {
        *lock(&self.failure) = None;
    }
}

impl AuditInner {
    fn send(&self, record: AuditRecord) {
        match self.entries.try_send(Entry::Record(Box::new(record))) {
            Ok(()) => {}
            Err(TrySendError::Full(_) | TrySendError::Disconnected(_)) => {
                self.losses.add(1);
            }
        }
    }
}

/// The writing thread.
#[derive(Debug)]
pub struct AuditWriter {
    shared: Arc<AuditInner>,
    thread: JoinHandle<()>,
}

impl Audit {
    /// Opens the log at `path` and completes a line that an earlier run left unfinished. If the disk is full or
    /// read-only, the thread opens the log later.
    pub fn open(path: &Path, room: AuditRoom, names: PeerNames) -> io::Result<(Self, AuditWriter)> {
        Self::start(Some((path.to_owned(), room)), names)
    }

    /// Does the same as [`Self::open`], or starts with a log that is switched off.
    pub(crate) fn start(place: Option<AuditPlace>, names: PeerNames) -> io::Result<(Self, AuditWriter)> {
        let losses = Arc::<Losses>::default();
        let file = place.map(|place| LateFile::open(place, &losses)).transpose()?;
        let (entries, waiting) = sync_channel(WAITING_MAX);
        // The thread holds no sender, so it ends with the last handle.
        let quotas = Arc::<Mutex<Quotas>>::default();
        let shared = Arc::new(AuditInner {
            entries,
            is_on: AtomicBool::new(file.is_some()),
            losses: losses.clone(),
            names,
            quotas: quotas.clone(),
            recent: Mutex::default(),
        });
        let thread = std::thread::Builder::new()
            .name("sgc-audit".to_owned())
            .spawn(move || write_all(file, &waiting, &losses, &quotas))?;
        let audit = Self { shared: Some(shared.clone()) };
        Ok((audit, AuditWriter { shared, thread }))
    }

    /// Writes later records to another place, or nowhere. After an error nothing has changed. Blocks.
    pub(crate) fn move_to(&self, place: Option<AuditPlace>) -> io::Result<()> {
        let Some(shared) = &self.shared else { return Ok(()) };
        let file = place.map(|place| LateFile::open(place, &shared.losses)).transpose()?;
        let is_on = file.is_some();
        shared.entries.send(Entry::Move(file)).map_err(|_| io::Error::other("the node is stopping"))?;
        shared.is_on.store(is_on, Relaxed);
        Ok(())
    }

    /// Returns the shared part of a log that is switched on.
    fn on(&self) -> Option<&AuditInner> {
        self.shared.as_deref().filter(|shared| shared.is_on.load(Relaxed))
    }

    /// Queues a record. Never waits.
    pub fn write(&self, mut record: AuditRecord) {
        let Some(shared) = self.on() else { return };
        if let Cause::Peer(peer) = &record.cause {
            record.peer_name = shared.names.get(peer);
        }
        let mut records = Vec::with_capacity(1);
        lock(&shared.quotas).handle(record, &mut records);
        for record in records {
            lock(&shared.recent).push(&record);
            shared.send(record);
        }
    }

    /// Returns the last records since the node started, at most [`RECENT_MAX`], oldest first; `None` if the log is
    /// switched off.
    pub fn recent(&self) -> Option<Vec<AuditRecord>> {
        Some(lock(&self.on()?.recent).all())
    }

    /// Returns the last ones about the keeping of the fleet, at most [`RECENT_OF_FLEET_MAX`].
    pub(crate) fn recent_of_fleet(&self) -> Option<Vec<AuditRecord>> {
        Some(lock(&self.on()?.recent).of_fleet())
    }

    /// Returns the number of records lost since the node started.
    pub fn lost_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.losses.total.load(Relaxed))
    }

    /// Returns an alert if the last attempt to write the log failed.
    pub(crate) fn alert(&self) -> Option<Alert> {
        let (path, reason) = lock(&self.on()?.losses.failure).clone()?;
        Some(Alert::AuditNotWritten { path: path.display().to_string(), reason })
    }

    /// Returns the number of records that only summaries hold, since the node started.
    pub fn summed_up_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| lock(&shared.quotas).left_out())
    }

    /// Returns the number of lost records that the log has not reported yet.
    pub fn lost(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.losses.unreported.load(Relaxed))
    }
}

impl AuditWriter {
    /// Waits until all records are on the disk. Later records are lost.
    pub fn finish(self) {
        let _ = self.shared.entries.send(Entry::End);
        let _ = self.thread.join();
    }
}

/// Appends a record to the log at `path` from another process than the node's, and syncs it to the disk. The node may
/// be running.
pub fn append(path: &Path, record: &AuditRecord) -> io::Result<()> {
    // Only the node rotates its log.
    let mut file = LogFile::open(path, AuditRoom { max_bytes: u64::MAX, files: 1 })?;
    let mut line = String::new();
    push_line(&mut line, record);
    file.append(&line)?;
    file.sync()
}

/// Returns the path of the log of a node with this state directory.
pub fn audit_path(configured: Option<&Path>, state: Option<&Path>) -> Option<PathBuf> {
    configured.map(Path::to_owned).or_else(|| Some(state?.join(FILE_NAME)))
}

/// The file of the log, which is opened later if it could not be opened at first.
struct LateFile {
    path: PathBuf,
    room: AuditRoom,
    file: Option<LogFile>,
}

impl LateFile {
    /// Opens the file, or leaves that for later if the disk is full or read-only.
    fn open((path, room): AuditPlace, losses: &Losses) -> io::Result<Self> {
        let file = match LogFile::open(&path, room) {
            Ok(file) => Some(file),
            Err(error) if is_storage_fault(&error) => {
                losses.failed(&path, &error);
                None
            }
            Err(error) => return Err(error),
        };
        Ok(Self { path, room, file })
    }

    fn append(&mut self, lines: &str) -> io::Result<()> {
        let file = match self.file.take() {
            Some(file) => file,
            None => LogFile::open(&self.path, self.room)?,
        };
        self.file.insert(file).append(lines)
    }

    /// Syncs the file, after which nothing is written.
    fn end(self) {
        if let Some(file) = self.file {
            let _ = file.sync();
        }
    }
}

fn write_all(mut file: Option<LateFile>, waiting: &Receiver<Entry>, losses: &Losses, quotas: &Mutex<Quotas>) {
    loop {
        let mut records = Vec::new();
        let patience = if losses.is_failing() { RETRY_EVERY } else { SUMMARY_DELAY };
        let mut entry = match waiting.recv_timeout(patience) {
            Ok(entry) => Some(entry),
            Err(RecvTimeoutError::Timeout) => {
                lock(quotas).sweep(now().unix.0, &mut records);
                None
            }
            Err(RecvTimeoutError::Disconnected) => Some(Entry::End),
        };
        while let Some(Entry::Record(record)) = entry {
            records.push(*record);
            entry = if records.len() < BATCH_MAX { waiting.try_recv().ok() } else { None };
        }
        if entry.is_some() {
            lock(quotas).finish(&mut records);
        }
        if let Some(file) = &mut file {
            append_all(file, &records, losses);
        }
        match entry {
            Some(Entry::End) => break,
            Some(Entry::Move(next)) => {
                if next.as_ref().is_none_or(|next| next.file.is_some()) {
                    losses.written();
                }
                std::mem::replace(&mut file, next).into_iter().for_each(LateFile::end);
            }
            Some(Entry::Record(_)) | None => {}
        }
    }
    file.into_iter().for_each(LateFile::end);
}

/// Writes records, and the number of those that were lost since the last write.
fn append_all(file: &mut LateFile, records: &[AuditRecord], losses: &Losses) {
    let missing = losses.unreported.swap(0, Relaxed);
    if records.is_empty() && missing == 0 && !losses.is_failing() {
        return;
    }
    let mut lines = String::new();
    records.iter().for_each(|record| push_line(&mut lines, record));
    if missing > 0 {
        let record = AuditRecord { lost: Some(missing), ..AuditRecord::new(AuditEvent::Lost) };
        push_line(&mut lines, &record);
    }
    match file.append(&lines) {
        Ok(()) => losses.written(),
        Err(error) => {
            losses.unreported.fetch_add(missing, Relaxed);
            losses.add(records.len() as u64);
            losses.failed(&file.path, &error);
        }
    }
}

fn push_line(lines: &mut String, record: &AuditRecord) {
    if let Ok(line) = serde_json::to_string(record) {
        lines.push_str(&line);
        lines.push('\n');
    }
}
