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

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use arc_swap::ArcSwap;
pub use sgc_config::AuditRoom;
use sgc_sync::lock;
use sgc_wire::NodeId;
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

/// Records that may wait to be written.
const WAITING_MAX: usize = 1024;
/// Lines written at once.
const BATCH_MAX: usize = 64;
/// Longest delay of a summary after its hour.
const SUMMARY_DELAY: Duration = Duration::from_secs(60);
const FILE_NAME: &str = "audit.jsonl";

/// Names of peers.
pub type PeerNames = BTreeMap<NodeId, String>;

/// Handle of the log, cheap to clone. A log that is switched off accepts records and drops them.
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
    recent: Mutex<Recent>,
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

/// The writing thread.
#[derive(Debug)]
pub struct AuditWriter {
    shared: Arc<AuditInner>,
    thread: JoinHandle<()>,
}

impl Audit {
    /// Opens the log at `path` and completes a line that an earlier run left unfinished.
    pub fn open(path: &Path, room: AuditRoom, names: PeerNames) -> io::Result<(Self, AuditWriter)> {
        let file = LogFile::open(path, room)?;
        let (records, waiting) = sync_channel(WAITING_MAX);
        // The thread holds no sender, so it ends with the last handle.
        let (lost, quotas) = (Arc::<AtomicU64>::default(), Arc::<Mutex<Quotas>>::default());
        let shared = Arc::new(AuditInner {
            records,
            lost: lost.clone(),
            names: ArcSwap::from_pointee(names),
            quotas: quotas.clone(),
            recent: Mutex::default(),
            lost_total: AtomicU64::new(0),
        });
        let thread = std::thread::Builder::new()
            .name("sgc-audit".to_owned())
            .spawn(move || write_all(file, &waiting, &lost, &quotas))?;
        let audit = Self { shared: Some(shared.clone()) };
        Ok((audit, AuditWriter { shared, thread }))
    }

    /// Queues a record. Never waits.
    pub fn write(&self, mut record: AuditRecord) {
        let Some(shared) = &self.shared else { return };
        if let Cause::Peer(peer) = &record.cause {
            record.peer_name = shared.names.load().get(peer).cloned();
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
        Some(lock(&self.shared.as_ref()?.recent).all())
    }

    /// Returns the last ones about the keeping of the fleet, at most [`RECENT_OF_FLEET_MAX`].
    pub(crate) fn recent_of_fleet(&self) -> Option<Vec<AuditRecord>> {
        Some(lock(&self.shared.as_ref()?.recent).of_fleet())
    }

    /// Replaces the names of peers.
    pub fn set_names(&self, names: PeerNames) {
        if let Some(shared) = &self.shared {
            shared.names.store(Arc::new(names));
        }
    }

    /// Returns the name of a peer, if it has one.
    pub fn name_of(&self, peer: &NodeId) -> Option<String> {
        self.shared.as_ref()?.names.load().get(peer).cloned()
    }

    /// Returns the number of records lost since the node started.
    pub fn lost_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.lost_total.load(Relaxed))
    }

    /// Returns the number of records that only summaries hold, since the node started.
    pub fn summed_up_total(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| lock(&shared.quotas).left_out())
    }

    /// Returns the number of lost records that the log has not reported yet.
    pub fn lost(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| shared.lost.load(Relaxed))
    }
}

impl AuditWriter {
    /// Waits until all records are on the disk. Later records are lost.
    pub fn finish(self) {
        let _ = self.shared.records.send(None);
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
