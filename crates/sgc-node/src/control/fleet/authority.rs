//! The fleet's authority: looks members up in the fleet file and gives them certificates and the current secrets.
//!
//! Members ask at any time, and the file is slow: it is locked, read, signed and replaced as a whole. So the control
//! task queues requests ([`DeskQueue`], pure) and hands them in batches to one blocking job at a time ([`FleetDesk`]).
//! The job reads the file once per batch, and only for requests that it has not answered before.

use std::collections::{BTreeMap, VecDeque};
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use bytes::Bytes;
use rand_core::{OsRng, RngCore, TryRngCore};
use sgc_sync::lock;
use sgc_trust::{
    CertId, CrlReport, Fleet, FleetError, Grantees, ROSTER_NODES_MAX, TrustAnchors, VerifiedPeer,
    requested_key_hash, serial_of,
};
use sgc_wire::{Credentials, NodeId, Now, RefuseReason, RosterRow, SinkId, UnixMillis};
use tracing::{error, info, warn};

use crate::admin::report::ReportMember;
use crate::control::fleet::holders::HOLDERS_WAITING_MAX;
use crate::control::fleet::operators::{
    OPERATIONS_WAITING_MAX, OperationJob, OperationOutcome, Operators, RequestStep, roster_row,
};
use crate::drops::NodeDrop;
use crate::state::credentials::{is_due, lasts, renewal_interval};
use crate::state::fleet_file::{FleetFileError, LockedFleet, read_fleet};

/// Shortest validity of a new certificate.
const VALID_MIN: Duration = Duration::from_secs(60);
/// Most nodes whose requests wait for the fleet file; as many as may stay joined at the renewal name.
const RENEWALS_WAITING_MAX: usize = 4096;
/// Most requests that one job answers, to keep the lock on the file short.
const RENEWAL_BATCH_MAX: usize = 256;
/// Most nodes whose last answers are remembered.
const RENEWALS_ANSWERED_MAX: usize = 4096;

/// Recipient of an answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Asker {
    /// The authority itself, since no route leads from a node to itself.
    Own,
    /// A member, by the sink of its request.
    Member(SinkId),
}

/// A node's request for credentials.
#[derive(Debug)]
pub(crate) struct RenewalRequest {
    pub(crate) asker: Asker,
    pub(crate) peer: VerifiedPeer,
    pub(crate) csr: Bytes,
}

/// An answer to a [`RenewalRequest`].
pub(crate) struct RenewalAnswer {
    pub(crate) asker: Asker,
    pub(crate) node: NodeId,
    pub(crate) answer: Result<Credentials, RenewalRefusal>,
}

/// Reasons to refuse a request for credentials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub(crate) enum RenewalRefusal {
    /// Another request of the same node was answered a moment ago.
    #[error("the node asked for something else a moment ago")]
    TooSoon,
    /// Too many nodes wait.
    #[error("{RENEWALS_WAITING_MAX} nodes wait for the fleet's file already")]
    QueueFull,
    /// The fleet file could not be read or written.
    #[error("the fleet's file cannot be used")]
    File,
    /// The roster lacks the node.
    #[error("the fleet's roster lacks the node")]
    UnknownNode,
    /// The node is revoked in the roster.
    #[error("the node is revoked")]
    Revoked,
    /// The signing request is unusable, or no certificate can be made for it.
    #[error("no certificate can be made for the request")]
    Unusable,
}

impl RenewalRefusal {
    /// Returns the counter.
    pub(crate) fn counter(self) -> NodeDrop {
        match self {
            Self::TooSoon => NodeDrop::RenewalTooSoon,
            Self::QueueFull => NodeDrop::RenewalQueueFull,
            Self::File => NodeDrop::RenewalFleetFile,
            Self::UnknownNode => NodeDrop::RenewalUnknownNode,
            Self::Revoked => NodeDrop::RenewalRevoked,
            Self::Unusable => NodeDrop::RenewalUnusable,
        }
    }

    /// Returns the reason that the node is told.
    pub(crate) fn refuse_reason(self) -> RefuseReason {
        match self {
            Self::TooSoon | Self::QueueFull | Self::File => RefuseReason::Limit,
            Self::UnknownNode => RefuseReason::NotPermitted,
            Self::Revoked => RefuseReason::Revoked,
            Self::Unusable => RefuseReason::NotVerified,
        }
    }

    fn from_fleet(error: &FleetError) -> Self {
        match error {
            FleetError::NodeRevoked { .. } => Self::Revoked,
            FleetError::UnknownNode { .. } => Self::UnknownNode,
            _ => Self::Unusable,
        }
    }
}

/// Requests that wait for the fleet file: one for each node, in order of arrival, in batches; and operations, each by
/// itself.
#[derive(Debug, Default)]
struct DeskQueue {
    waiting: BTreeMap<NodeId, RenewalRequest>,
    order: VecDeque<NodeId>,
    operations: VecDeque<OperationJob>,
    is_busy: bool,
}

impl DeskQueue {
    /// Queues a request. It replaces an older one of the same node.
    fn push(&mut self, request: RenewalRequest) -> Result<(), RenewalRefusal> {
        let node = request.peer.node_id;
        if let Some(older) = self.waiting.get_mut(&node) {
            *older = request;
            return Ok(());
        }
        if self.waiting.len() >= RENEWALS_WAITING_MAX {
            return Err(RenewalRefusal::QueueFull);
        }
        self.waiting.insert(node, request);
        self.order.push_back(node);
        Ok(())
    }

    /// Queues an operation unless too many wait: then it is returned.
    fn push_or_return(&mut self, job: OperationJob) -> Option<OperationJob> {
        let holders = self.operations.iter().filter(|waiting| waiting.is_of_holder()).count();
        let is_full = match job.is_of_holder() {
            true => holders >= HOLDERS_WAITING_MAX,
            false => self.operations.len().saturating_sub(holders) >= OPERATIONS_WAITING_MAX,
        };
        if is_full {
            return Some(job);
        }
        self.operations.push_back(job);
        None
    }

    /// Returns the next work, unless a batch is under way.
    fn next_batch(&mut self) -> Option<DeskBatch> {
        if self.is_busy || (self.order.is_empty() && self.operations.is_empty()) {
            return None;
        }
        self.is_busy = true;
        let nodes: Vec<_> = self.order.drain(..self.order.len().min(RENEWAL_BATCH_MAX)).collect();
        let renewals = nodes.into_iter().filter_map(|node| self.waiting.remove(&node)).collect();
        Some(DeskBatch { renewals, operations: self.operations.drain(..).collect() })
    }

    /// Ends the batch under way.
    pub(crate) fn end_batch(&mut self) {
        self.is_busy = false;
    }
}

/// The work of one job.
#[derive(Debug)]
struct DeskBatch {
    renewals: Vec<RenewalRequest>,
    operations: Vec<OperationJob>,
}

/// The answers of a job.
pub(crate) struct DeskAnswers {
    pub(crate) renewals: Vec<RenewalAnswer>,
    pub(crate) operations: Vec<OperationOutcome>,
}

/// Role of this node as its fleet's authority.
pub(crate) struct Authority {
    queue: DeskQueue,
    operators: Operators,
    /// Times at which members last got an answer in this run; at most as many as a roster has.
    seen: BTreeMap<NodeId, UnixMillis>,
    own: NodeId,
    file: PathBuf,
    desk: Arc<Mutex<FleetDesk>>,
}

impl Authority {
    /// Creates the authority `own` with this fleet file and these operators.
    pub(crate) fn new(file: PathBuf, operators: Grantees, own: NodeId) -> Self {
        let (queue, operators) = (DeskQueue::default(), Operators::new(operators));
        let desk = Arc::new(Mutex::new(FleetDesk::new(file.clone())));
        Self { queue, operators, seen: BTreeMap::new(), own, file, desk }
    }

    /// Queues a request for credentials. It replaces an older one of the same node.
    pub(crate) fn push_renewal(&mut self, request: RenewalRequest) -> Result<(), RenewalRefusal> {
        self.queue.push(request)
    }

    /// Sets who may change the fleet. Operations under way go on.
    pub(crate) fn set_operators(&mut self, permitted: Grantees) {
        self.operators.set_permitted(permitted);
    }

    /// Judges an operator's request.
    pub(crate) fn ask_operation(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        sink: SinkId,
        request: &Bytes,
        rng: &mut impl RngCore,
    ) -> RequestStep {
        self.operators.ask(now, peer, sink, request, rng)
    }

    /// Queues an operation unless too many wait: then it is returned.
    pub(crate) fn push_or_return(&mut self, job: OperationJob) -> Option<OperationJob> {
        self.queue.push_or_return(job)
    }

    /// Notes the outcome of an operation. Returns the sink that waits for its answer.
    pub(crate) fn operation_done(&mut self, done: &OperationOutcome) -> Option<SinkId> {
        self.operators.done(done)
    }

    /// Ends the batch under way.
    pub(crate) fn end_batch(&mut self) {
        self.queue.end_batch();
    }

    /// Notes that members are present.
    pub(crate) fn note_seen(&mut self, nodes: impl IntoIterator<Item = NodeId>, now: UnixMillis) {
        for node in nodes {
            if self.seen.len() < ROSTER_NODES_MAX || self.seen.contains_key(&node) {
                self.seen.insert(node, now);
            }
        }
    }

    /// Returns a blocking job with the next work, unless one is under way or nothing waits.
    pub(crate) fn next_job(&mut self) -> Option<impl FnOnce(Now) -> DeskAnswers + Send + use<>> {
        let batch = self.queue.next_batch()?;
        let (desk, own) = (self.desk.clone(), self.own);
        let seen = if batch.operations.is_empty() { BTreeMap::new() } else { self.seen.clone() };
        Some(move |now: Now| {
            let mut desk = lock(&desk);
            let done = |job: OperationJob| job.carry_out(&desk.file, &own, &seen, now.unix);
            let operations = batch.operations.into_iter().map(done).collect();
            DeskAnswers { operations, renewals: desk.answer(batch.renewals, now) }
        })
    }

    /// Returns a blocking job that reads the members of the fleet, with the times at which they were last seen.
    pub(crate) fn members_job(
        &self,
    ) -> impl FnOnce() -> Result<Vec<ReportMember>, FleetFileError> + Send + use<> {
        let (file, seen) = (self.file.clone(), self.seen.clone());
        move || {
            let fleet = read_fleet(&file)?;
            let member = |node| {
                let row = roster_row(&fleet, node);
                let seen = row.seen.max(seen.get(&row.id).copied());
                ReportMember::new(RosterRow { seen, ..row })
            };
            Ok(fleet.nodes().map(member).collect())
        }
    }

    /// Returns a blocking job that records the revocations of these lists in the file.
    pub(crate) fn catch_up_job(&self, anchors: Arc<TrustAnchors>) -> impl FnOnce(Now) + Send + use<> {
        let desk = self.desk.clone();
        move |now| lock(&desk).catch_up(&anchors, now)
    }
}

/// Version of a file that other writers replace as a whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct FileStamp {
    inode: (u64, u64),
    bytes: u64,
    modified: SystemTime,
}

impl FileStamp {
    fn read(file: &Path) -> Option<Self> {
        let metadata = fs::metadata(file).ok()?;
        let modified = metadata.modified().ok()?;
        Some(Self { inode: (metadata.dev(), metadata.ino()), bytes: metadata.len(), modified })
    }
}

/// The last answer to a node.
struct LastAnswer {
    /// Certificate with which the node asked.
    cert: CertId,
    /// Key to be certified.
    key: [u8; 32],
    answer: Result<Credentials, RenewalRefusal>,
    /// Serial number of the certificate in the answer.
    made: Option<Arc<[u8]>>,
    at: Instant,
    /// Time for which the answer is remembered and the node gets no other.
    interval: Duration,
}

impl LastAnswer {
    /// Returns the answer, if the request repeats the answered one or comes with the certificate of the answer.
    fn answer_to(&self, peer: &VerifiedPeer, key: &[u8; 32]) -> Option<Result<Credentials, RenewalRefusal>> {
        if self.key != *key {
            return None;
        }
        if self.cert == peer.cert {
            return Some(self.answer.clone());
        }
        let made = self.made.as_ref().is_some_and(|serial| *serial == peer.cert.serial);
        // The node has adopted the certificate, so it keeps its chain.
        made.then(|| self.answer.clone().map(|c| Credentials { chain: Vec::new(), ..c }))
    }
}

/// Answers batches of requests from the fleet file, or from memory while the file is unchanged.
struct FleetDesk {
    file: PathBuf,
    /// Version of the file from which the remembered answers come.
    stamp: Option<FileStamp>,
    answered: BTreeMap<NodeId, LastAnswer>,
    /// Number of times that the file was read.
    reads: u64,
}

impl FleetDesk {
    fn new(file: PathBuf) -> Self {
        Self { file, stamp: None, answered: BTreeMap::new(), reads: 0 }
    }

    /// Answers a batch. Blocks on the file. A certificate with validity left is not replaced; the chain of the answer
    /// is empty then. A new certificate has the validity of the old one.
    fn answer(&mut self, batch: Vec<RenewalRequest>, now: Now) -> Vec<RenewalAnswer> {
        self.answered.retain(|_, a| now.instant < a.at + a.interval);
        let stamp = FileStamp::read(&self.file);
        if stamp.is_none() || stamp != self.stamp {
            self.answered.clear();
            self.stamp = stamp;
        }
        let mut answers = Vec::with_capacity(batch.len());
        let mut unanswered = Vec::new();
        for request in batch {
            let node = request.peer.node_id;
            let key = requested_key_hash(&request.csr);
            let known = self.answered.get(&node);
            let answer = match known.map(|a| a.answer_to(&request.peer, &key)) {
                Some(Some(same)) => same,
                Some(None) => Err(RenewalRefusal::TooSoon),
                None if self.answered.len() + unanswered.len() >= RENEWALS_ANSWERED_MAX => {
                    Err(RenewalRefusal::QueueFull)
                }
                None => {
                    unanswered.push((request, key));
                    continue;
                }
            };
            answers.push(RenewalAnswer { asker: request.asker, node, answer });
        }
        if !unanswered.is_empty() {
            answers.extend(self.look_up(unanswered, now));
        }
        answers
    }

    /// Answers from the file, and remembers the answers.
    fn look_up(&mut self, batch: Vec<(RenewalRequest, [u8; 32])>, now: Now) -> Vec<RenewalAnswer> {
        self.reads += 1;
        let mut found = match LockedFleet::open(&self.file) {
            Ok(mut locked) => {
                // The previous holder of the lock may have replaced the file.
                self.stamp = FileStamp::read(&self.file);
                let fleet = &mut locked.fleet;
                let has_learnt = batch.iter().fold(false, |any, (r, _)| recognize(fleet, r, now) || any);
                let found = batch.iter().map(|(r, _)| renew(fleet, r, now)).collect();
                self.save(&locked, has_learnt, found)
            }
            Err(why) => refuse_all(&why, batch.len()),
        };
        let mut answers = Vec::with_capacity(batch.len());
        for ((request, key), FleetAnswer { answer, made, .. }) in batch.into_iter().zip(found.drain(..)) {
            let RenewalRequest { asker, peer, .. } = request;
            let interval = renewal_interval(&peer);
            let remembered =
                LastAnswer { cert: peer.cert, key, answer: answer.clone(), made, at: now.instant, interval };
            self.answered.insert(peer.node_id, remembered);
            answers.push(RenewalAnswer { asker, node: peer.node_id, answer });
        }
        answers
    }

    /// Writes the file if the roster changed, so that the file has each certificate before the answer leaves.
    fn save(&mut self, locked: &LockedFleet, has_learnt: bool, found: Vec<FleetAnswer>) -> Vec<FleetAnswer> {
        if !has_learnt && found.iter().all(|found| !found.is_news) {
            return found;
        }
        let saved = locked.save();
        self.stamp = FileStamp::read(&self.file);
        match saved {
            Ok(()) => found,
            Err(why) => refuse_all(&why, found.len()),
        }
    }
}

impl FleetDesk {
    /// Records in the file the revocations of the lists in force that it lacks. Another copy of the file made them.
    fn catch_up(&self, anchors: &TrustAnchors, now: Now) {
        let absorb = || -> Result<CrlReport, FleetFileError> {
            let mut locked = LockedFleet::open(&self.file)?;
            let absorbed = locked.fleet.absorb(anchors, now.unix).map_err(|why| locked.error(why))?;
            if absorbed != CrlReport::default() {
                locked.save()?;
            }
            Ok(absorbed)
        };
        match absorb() {
            Ok(CrlReport { revoked, .. }) if !revoked.is_empty() => {
                warn!(
                    nodes = revoked.join(", "),
                    "another copy of the fleet's file revoked nodes; the file here knows it now. What else that copy did \
                     is unknown here: `sgc fleet merge` brings it in"
                );
            }
            Ok(_) => {}
            Err(why) => error!("cannot record revocations by other copies of the fleet file: {why}"),
        }
    }
}

/// Records the certificate of a request if another copy of the file made it. Returns `true` if so.
fn recognize(fleet: &mut Fleet, request: &RenewalRequest, now: Now) -> bool {
    let node = fleet.node_by_pseudonym(&request.peer.pseudonym);
    let peer = node.map_or_else(|| request.peer.node_id.short(), |node| node.name.to_string());
    match fleet.recognize(&request.peer, now.unix) {
        Ok(false) => false,
        Ok(true) => {
            warn!(%peer, "recorded a certificate that another copy of the fleet file made");
            true
        }
        Err(why) => {
            error!(%peer, %why, "cannot record a certificate in the fleet file");
            false
        }
    }
}

/// An answer from the file.
struct FleetAnswer {
    answer: Result<Credentials, RenewalRefusal>,
    /// Serial number of a certificate that was made for it.
    made: Option<Arc<[u8]>>,
    /// Whether the roster changed for this answer.
    is_news: bool,
}

impl FleetAnswer {
    fn refused(why: RenewalRefusal) -> Self {
        Self { answer: Err(why), made: None, is_news: false }
    }
}

fn refuse_all(why: &FleetFileError, requests: usize) -> Vec<FleetAnswer> {
    error!(requests, "cannot give credentials: {why}");
    std::iter::repeat_with(|| FleetAnswer::refused(RenewalRefusal::File)).take(requests).collect()
}

fn renew(fleet: &mut Fleet, request: &RenewalRequest, now: Now) -> FleetAnswer {
    match try_renew(fleet, request, now) {
        Ok(found) => found,
        Err(why) => {
            let node = fleet.node_by_pseudonym(&request.peer.pseudonym);
            let peer = node.map_or_else(|| request.peer.node_id.short(), |node| node.name.to_string());
            warn!(%peer, %why, "refused credentials");
            FleetAnswer::refused(RenewalRefusal::from_fleet(&why))
        }
    }
}

fn try_renew(fleet: &mut Fleet, request: &RenewalRequest, now: Now) -> Result<FleetAnswer, FleetError> {
    let RenewalRequest { peer, csr, .. } = request;
    let unknown = || FleetError::UnknownNode { node: peer.pseudonym.short() };
    let node = fleet.node_by_pseudonym(&peer.pseudonym).ok_or_else(unknown)?.name.clone();
    if !is_due(peer, now) {
        let credentials = fleet.credentials_for(&node, Vec::new())?;
        let is_news = fleet.note_handed(&node, now.unix)?;
        return Ok(FleetAnswer { answer: Ok(credentials), made: None, is_news });
    }
    let valid = Duration::from_millis(lasts(peer)).max(VALID_MIN);
    let mut rng = OsRng.unwrap_err();
    let credentials = fleet.renew_csr(csr, &peer.pseudonym, valid, now.unix, &mut rng)?;
    let made = credentials.chain.first().and_then(|leaf| serial_of(leaf)).map(Arc::from);
    info!(%node, "renewed a certificate");
    Ok(FleetAnswer { answer: Ok(credentials), made, is_news: true })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use sgc_trust::{EnrollRequest, Identity, KeyRequest, NodeName, pem_contents};
    use sgc_wire::{Encode as _, Operation, OperationAnswer, OperationRequest, UnixMillis};

    use super::*;
    use crate::state;

    const DAY: u64 = 86_400_000;

    fn now() -> Now {
        crate::clock::now()
    }

    /// A fleet file with members whose certificates are due.
    struct Bench {
        dir: tempfile::TempDir,
        desk: FleetDesk,
    }

    impl Bench {
        fn new() -> Self {
            let dir = tempfile::tempdir().unwrap();
            let file = dir.path().join("lab.fleet");
            let made = UnixMillis(now().unix.0 - 400 * DAY);
            let fleet = Fleet::create("lab".parse().unwrap(), made, &mut OsRng.unwrap_err()).unwrap();
            state::replace(&file, fleet.to_text().as_bytes()).unwrap();
            Self { desk: FleetDesk::new(file), dir }
        }

        fn file(&self) -> PathBuf {
            self.dir.path().join("lab.fleet")
        }

        fn enroll(&self, node: &str) -> Identity {
            let mut locked = LockedFleet::open(&self.file()).unwrap();
            let long_ago = UnixMillis(now().unix.0 - 80 * DAY);
            let request = EnrollRequest::new(node.parse().unwrap(), long_ago);
            let identity = locked.fleet.enroll(&request, &mut OsRng.unwrap_err()).unwrap();
            locked.save().unwrap();
            identity
        }

        fn certificates(&self, node: &str) -> usize {
            let fleet = crate::state::fleet_file::read_fleet(&self.file()).unwrap();
            fleet.node(&node.parse().unwrap()).unwrap().certificates.len()
        }

        fn ask(&mut self, node: &Identity, csr: &[u8], now: Now) -> Result<Credentials, RenewalRefusal> {
            let mut answers = self.desk.answer(vec![request(node, csr)], now);
            assert_eq!(answers.len(), 1);
            answers.remove(0).answer
        }
    }

    fn request(node: &Identity, csr: &[u8]) -> RenewalRequest {
        let (asker, peer) = (Asker::Member(SinkId([1; 16])), node.as_peer().clone());
        RenewalRequest { asker, peer, csr: Bytes::copy_from_slice(csr) }
    }

    /// Returns a request for another key.
    fn other_key() -> Vec<u8> {
        let made = KeyRequest::generate(None, &mut OsRng.unwrap_err()).unwrap();
        pem_contents(&made.csr_text(), &["CERTIFICATE REQUEST"]).unwrap().remove(0).to_vec()
    }

    #[test]
    fn a_flood_of_one_request_makes_one_certificate_and_reads_the_file_once() {
        let mut bench = Bench::new();
        let arm = bench.enroll("arm");
        let began = now();
        let first = bench.ask(&arm, &arm.csr(), began).unwrap();
        assert_eq!((bench.certificates("arm"), bench.desk.reads), (2, 1));
        for _ in 0..100 {
            // Each request is signed anew, so the key identifies it.
            assert_eq!(bench.ask(&arm, &arm.csr(), began).unwrap(), first);
        }
        assert_eq!((bench.certificates("arm"), bench.desk.reads), (2, 1));

        // The node asks again with the new certificate and keeps it.
        let renewed = arm.with_credentials(&first).unwrap();
        let kept = bench.ask(&renewed, &renewed.csr(), began).unwrap();
        assert!(kept.chain.is_empty());
        assert_eq!((kept.secrets, bench.desk.reads), (first.secrets, 1));
    }

    #[test]
    fn a_flood_of_keys_makes_one_certificate_in_each_interval() {
        let mut bench = Bench::new();
        let arm = bench.enroll("arm");
        let mut at = now();
        let interval = renewal_interval(arm.as_peer());
        for round in 1..=3 {
            assert!(bench.ask(&arm, &other_key(), at).is_ok());
            for _ in 0..20 {
                assert_eq!(bench.ask(&arm, &other_key(), at), Err(RenewalRefusal::TooSoon));
            }
            assert_eq!((bench.certificates("arm"), bench.desk.reads), (1 + round, round as u64));
            at.instant += interval;
        }
    }

    #[test]
    fn refusals_are_remembered_until_the_file_is_another() {
        let mut bench = Bench::new();
        let arm = bench.enroll("arm");
        let change = |bench: &Bench, change: &dyn Fn(&mut Fleet)| {
            let mut locked = LockedFleet::open(&bench.file()).unwrap();
            change(&mut locked.fleet);
            locked.save().unwrap();
        };
        let name: NodeName = "arm".parse().unwrap();
        change(&bench, &|fleet| fleet.revoke(std::slice::from_ref(&name), now().unix).unwrap());
        let began = now();
        for _ in 0..10 {
            assert_eq!(bench.ask(&arm, &arm.csr(), began), Err(RenewalRefusal::Revoked));
        }
        assert_eq!(bench.desk.reads, 1);
        let arm = bench.enroll_again("arm");
        assert!(bench.ask(&arm, &arm.csr(), began).is_ok());
        assert_eq!(bench.desk.reads, 2);
        std::fs::remove_file(bench.file()).unwrap();
        assert_eq!(bench.ask(&arm, &arm.csr(), began), Err(RenewalRefusal::File));
    }

    impl Bench {
        fn enroll_again(&self, node: &str) -> Identity {
            let mut locked = LockedFleet::open(&self.file()).unwrap();
            let long_ago = UnixMillis(now().unix.0 - 80 * DAY);
            let request =
                EnrollRequest { again: true, ..EnrollRequest::new(node.parse().unwrap(), long_ago) };
            let identity = locked.fleet.enroll(&request, &mut OsRng.unwrap_err()).unwrap();
            locked.save().unwrap();
            identity
        }
    }

    #[test]
    fn requests_of_holders_of_invitations_leave_the_queue_to_operators() {
        let bench = Bench::new();
        let desk = bench.enroll("desk");
        let mut locked = LockedFleet::open(&bench.file()).unwrap();
        locked.fleet.set_authority(Some("keeper".parse().unwrap()), now().unix).unwrap();
        let nodes = [desk.node_id()].into();
        let mut operators = Operators::new(Grantees { nodes, ..Grantees::default() });
        let mut rng = OsRng.unwrap_err();
        let mut queue = DeskQueue::default();
        let mut push = |peer: &VerifiedPeer, operation: Operation| {
            let (at, sink) = (Instant::now(), SinkId([1; 16]));
            let asked = operators.ask(at, peer, sink, &OperationRequest::Challenge.to_bytes(), &mut rng);
            let RequestStep::Answer(OperationAnswer::Challenge(challenge)) = asked else {
                panic!("{asked:?}")
            };
            let execute = OperationRequest::Execute { challenge, operation };
            let asked = operators.ask(at, peer, sink, &execute.to_bytes(), &mut rng);
            let RequestStep::Job(job) = asked else { panic!("{asked:?}") };
            match queue.push_or_return(job) {
                Some(job) => operators.done(&job.busy()).is_none(),
                None => true,
            }
        };
        let mut taken = 0;
        for n in 0..2 * HOLDERS_WAITING_MAX {
            let node = EnrollRequest::new(format!("arm-{n}").parse().unwrap(), now().unix);
            let (hour, routers) = (Duration::from_secs(3600), vec!["quic://hub:1".to_owned()]);
            let code = locked.fleet.invite(&node, hour, routers, &mut OsRng.unwrap_err()).unwrap();
            let holder = code.identity(&mut OsRng.unwrap_err()).unwrap();
            let redeem = Operation::Redeem { csr: Bytes::new(), reply_key: Bytes::new() };
            taken += usize::from(push(holder.as_peer(), redeem));
        }
        assert_eq!(taken, HOLDERS_WAITING_MAX);
        let mut list = || push(desk.as_peer(), Operation::List { after: None });
        assert!((0..OPERATIONS_WAITING_MAX).all(|_| list()) && !list());
    }

    #[test]
    fn a_batch_reads_and_writes_the_file_once() {
        let mut bench = Bench::new();
        let nodes: Vec<_> = (0..5).map(|n| bench.enroll(&format!("arm-{n}"))).collect();
        let batch = nodes.iter().map(|node| request(node, &node.csr())).collect();
        let answers = bench.desk.answer(batch, now());
        assert!(answers.iter().all(|a| a.answer.as_ref().is_ok_and(|c| !c.chain.is_empty())));
        assert_eq!((bench.desk.reads, bench.certificates("arm-4")), (1, 2));
    }

    #[test]
    fn requests_of_a_node_take_one_place_and_one_batch_is_under_way() {
        let bench = Bench::new();
        let (arm, desk) = (bench.enroll("arm"), bench.enroll("desk"));
        let mut queue = DeskQueue::default();
        for _ in 0..1000 {
            queue.push(request(&arm, &other_key()[..10])).unwrap();
        }
        queue.push(request(&arm, b"last")).unwrap();
        queue.push(request(&desk, b"desk")).unwrap();
        let batch = queue.next_batch().unwrap().renewals;
        assert_eq!(batch.iter().map(|r| &r.csr[..]).collect::<Vec<_>>(), [b"last", b"desk"]);
        queue.push(request(&arm, b"next")).unwrap();
        assert!(queue.next_batch().is_none(), "a second job would wait for the file's lock");
        queue.end_batch();
        assert_eq!(queue.next_batch().unwrap().renewals.len(), 1);
        queue.end_batch();
        assert!(queue.next_batch().is_none());
    }

    #[test]
    fn the_queue_is_bounded_and_goes_in_batches() {
        let arm = Bench::new().enroll("arm");
        let mut queue = DeskQueue::default();
        let numbered = |n: usize| {
            let mut request = request(&arm, b"csr");
            request.peer.node_id.0[..8].copy_from_slice(&n.to_be_bytes());
            request
        };
        for n in 0..RENEWALS_WAITING_MAX {
            queue.push(numbered(n)).unwrap();
        }
        assert_eq!(queue.push(numbered(RENEWALS_WAITING_MAX)), Err(RenewalRefusal::QueueFull));
        assert_eq!(queue.push(numbered(0)), Ok(()), "who has a place keeps it");
        assert_eq!(queue.next_batch().unwrap().renewals.len(), RENEWAL_BATCH_MAX);
    }
}
