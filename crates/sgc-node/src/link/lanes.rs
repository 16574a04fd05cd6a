//! Lanes: connections beside a link, each for the packets of one name (`docs/spec/wire.md`, lanes). A dedicated lane
//! gives a camera its own congestion controller and queue (`link = "dedicated"`). A bulk lane carries a large topic of a
//! QUIC link by TLS, which takes less processor time; [`sgc_session::BulkPath`] decides when.
//!
//! The node that dialled the link dials its lanes, since the other node may be unable to. Everything else treats a lane
//! as part of its link: packets of a lane came over the link, and without the lane the link carries its name as well.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, Weak};
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng as _, TryRngCore as _};
use sgc_session::{
    BACKOFF_MAX, BulkLaneObservation, BulkLaneUse, BulkPath, BulkPathObservation, doubled, wait,
};
use sgc_sync::lock;
use sgc_transport::{AnyLink, CloseReason, DialError, Dialer, Link, LinkError, LinkStats, LinkUrl};
use sgc_wire::{Control, LaneToken, Name, NodeId};
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};
use tracing::{debug, info, warn};

use crate::control::peers::control_queue::ControlQueue;
use crate::state::audit::PeerNames;

/// Most lanes of one link.
pub(crate) const LANES_MAX: usize = 8;
/// Most bulk lanes of one link that this node asks for.
const BULK_LANES_MAX: usize = 4;
/// Most agreed lanes of all links that have not arrived.
const EXPECTED_MAX: usize = 1024;
/// Time for the answer to an offer.
const ANSWER_MAX: Duration = Duration::from_secs(5);
/// Time for an agreed lane to arrive.
const ARRIVAL_MAX: Duration = Duration::from_secs(15);
/// The first wait, before jitter, after the peer refused a lane for lack of places. It is doubled each time.
const REFUSED_MIN: Duration = Duration::from_secs(30);
/// The longest such wait, before jitter.
const REFUSED_MAX: Duration = Duration::from_secs(600);

/// Agreed lanes that have not arrived. Clones share the state.
#[derive(Clone, Default)]
pub(crate) struct LaneAdmission {
    expected: Arc<Mutex<BTreeMap<LaneToken, ExpectedLane>>>,
    names: PeerNames,
}

/// A lane that was agreed on.
struct ExpectedLane {
    node: NodeId,
    name: Name,
    lanes: Weak<Lanes>,
    until: Instant,
}

impl LaneAdmission {
    /// Creates an admission that expects no lane.
    pub(crate) fn new(names: PeerNames) -> Self {
        Self { expected: Arc::default(), names }
    }

    /// Expects a lane. Returns `false` if too many are expected.
    fn expect(&self, token: LaneToken, name: Name, lanes: &Arc<Lanes>) -> bool {
        let now = Instant::now();
        let mut expected = lock(&self.expected);
        expected.retain(|_, lane| lane.until > now);
        if expected.len() >= EXPECTED_MAX || expected.contains_key(&token) {
            return false;
        }
        // The bound per link leaves room for lanes of other links.
        let of_link = expected.values().filter(|lane| std::ptr::eq(lane.lanes.as_ptr(), Arc::as_ptr(lanes)));
        if of_link.count() >= LANES_MAX {
            return false;
        }
        let node = lanes.link.peer().node_id;
        expected.insert(
            token,
            ExpectedLane { node, name, lanes: Arc::downgrade(lanes), until: now + ARRIVAL_MAX },
        );
        true
    }

    /// Passes an incoming lane to its link. Closes a lane that is not expected, or that comes from another node.
    pub(crate) fn enter(&self, token: LaneToken, lane: AnyLink) {
        let found = lock(&self.expected).remove(&token);
        let found = found.filter(|e| e.node == lane.peer().node_id && e.until > Instant::now());
        match found.and_then(|e| Some((e.lanes.upgrade()?, e.name))) {
            Some((lanes, name)) => lanes.attach(name, lane),
            None => {
                let peer = self.names.called(&lane.peer().node_id);
                warn!(remote = %lane.remote(), peer, "closed an unexpected lane");
                lane.close(CloseReason::Denied("no such lane was agreed on".into()));
            }
        }
    }
}

/// Dialer and URL for the lanes of a link.
pub(crate) type Dial = (Arc<Dialer>, LinkUrl);

/// Starts the tasks that receive the packets of a name over its lane.
type ReceiveLane = Box<dyn Fn(AnyLink, Name) + Send + Sync>;

/// The lanes of one link.
pub(crate) struct Lanes {
    link: AnyLink,
    frames: ControlQueue,
    /// Dialer; `None` if the peer dialled the link.
    dial: Option<Dial>,
    admission: LaneAdmission,
    /// Receives the packets of lanes. It is set once the link has its number.
    receive: OnceLock<ReceiveLane>,
    table: Mutex<Table>,
    /// Whether the table holds any lane, so that links without lanes take no lock for a packet.
    has_any: AtomicBool,
    /// Number of the last lane that came up.
    number: AtomicU64,
}

#[derive(Default)]
struct Table {
    lanes: BTreeMap<Name, Lane>,
    answers: BTreeMap<LaneToken, oneshot::Sender<bool>>,
    /// Whether bulk lanes suit the path.
    path: BulkPath,
    /// Bytes that were sent and received over lanes that have ended.
    ended_bytes: (u64, u64),
}

#[derive(Default)]
struct Lane {
    kind: Kind,
    up: Option<(u64, AnyLink)>,
    /// Task that dials the lane, if this node dials.
    keeper: Option<AbortHandle>,
}

/// The reason for which a lane exists.
enum Kind {
    /// One of the nodes is configured to have it.
    Dedicated {
        /// Whether this node is.
        wanted_here: bool,
    },
    /// The topic is large and the path is fast.
    Bulk(BulkLaneUse),
}

impl Default for Kind {
    fn default() -> Self {
        Self::Dedicated { wanted_here: false }
    }
}

impl Lane {
    fn is_bulk(&self) -> bool {
        matches!(self.kind, Kind::Bulk(_))
    }

    fn is_wanted_here(&self) -> bool {
        matches!(self.kind, Kind::Dedicated { wanted_here: true })
    }
}

impl Table {
    /// Ends a lane and takes it out of the table.
    fn remove(&mut self, name: &Name) {
        if let Some(lane) = self.lanes.remove(name) {
            self.end(lane);
        }
    }

    /// Ends a lane that was taken out of the table.
    fn end(&mut self, lane: Lane) {
        if let Some(keeper) = lane.keeper {
            keeper.abort();
        }
        if let Some((_, up)) = lane.up {
            self.put_away(&up);
            up.close(CloseReason::Goodbye);
        }
    }

    /// Keeps the counters of a connection that carries no more packets.
    fn put_away(&mut self, up: &AnyLink) {
        self.ended_bytes = up.stats().added_to(self.ended_bytes);
    }
}

/// Reasons why a lane is missing.
#[derive(Debug, thiserror::Error)]
enum LaneFailure {
    #[error("the peer takes no more lanes")]
    Refused,
    #[error("the peer does not answer the offer")]
    NoAnswer,
    #[error("another node answers where the link leads")]
    OtherNode,
    #[error(transparent)]
    Dial(#[from] DialError),
}

impl Lanes {
    /// Creates the table of a link without lanes. `dial` is set if this node dialled the link.
    pub(crate) fn new(
        link: AnyLink,
        frames: ControlQueue,
        dial: Option<Dial>,
        admission: LaneAdmission,
    ) -> Arc<Self> {
        Arc::new(Self {
            link,
            frames,
            dial,
            admission,
            receive: OnceLock::new(),
            table: Mutex::default(),
            has_any: AtomicBool::new(false),
            number: AtomicU64::new(0),
        })
    }

    /// Accepts packets of lanes from here on.
    pub(crate) fn start(&self, receive: impl Fn(AnyLink, Name) + Send + Sync + 'static) {
        // The function is called once, so this cannot fail.
        let _ = self.receive.set(Box::new(receive));
    }

    /// Returns the lane of a name, if one is up, and its number, which is unique within the link.
    pub(crate) fn for_name(&self, name: &Name) -> Option<(u64, AnyLink)> {
        if !self.has_any.load(Ordering::Relaxed) {
            return None;
        }
        self.table().lanes.get(name)?.up.clone()
    }

    /// Returns the numbers of lanes that are up: all, and bulk lanes of these.
    pub(crate) fn count(&self) -> (usize, usize) {
        let table = self.table();
        let up = table.lanes.values().filter(|lane| lane.up.is_some());
        up.fold((0, 0), |(all, bulk), lane| (all + 1, bulk + usize::from(lane.is_bulk())))
    }

    /// Returns the bytes sent and received over lanes since the link began.
    pub(crate) fn bytes(&self) -> (u64, u64) {
        let table = self.table();
        let up = table.lanes.values().filter_map(|lane| lane.up.as_ref());
        up.fold(table.ended_bytes, |total, (_, lane)| lane.stats().added_to(total))
    }

    /// Starts or stops to want a dedicated lane for a name.
    pub(crate) fn set_wanted(self: &Arc<Self>, name: Name, wanted: bool) {
        if !wanted && !self.has_any.load(Ordering::Relaxed) {
            return;
        }
        let mut table = self.table();
        if !wanted {
            if table.lanes.get(&name).is_some_and(Lane::is_wanted_here) {
                table.remove(&name);
            }
            return;
        }
        if table.lanes.get(&name).is_some_and(Lane::is_wanted_here) {
            return;
        }
        if !self.admit(&mut table, name) {
            warn!(remote = %self.link.remote(), "a topic gets no lane, because {LANES_MAX} others have one; it shares the link");
            return;
        }
        if let Some(lane) = table.lanes.get_mut(&name) {
            lane.kind = Kind::Dedicated { wanted_here: true };
        }
        drop(table);
        if self.dial.is_none() && !self.frames.push(Control::LaneWanted { name }) {
            debug!(name = %name.short(), "the peer takes no control frames; no lane is requested");
        }
    }

    /// Asks for a bulk lane for a name with much data in long messages, unless the name has a lane or the path does not
    /// suit one.
    pub(crate) fn ask_for_bulk(self: &Arc<Self>, name: Name) {
        if !self.link.has_bulk_lanes() {
            return;
        }
        let now = Instant::now();
        let mut table = self.table();
        let bulk = table.lanes.values().filter(|lane| lane.is_bulk()).count();
        let may_ask = table.path.is_open(now) && bulk < BULK_LANES_MAX;
        if !may_ask || !self.admit_bulk(&mut table, name, now) {
            return;
        }
        drop(table);
        if self.dial.is_none() && !self.frames.push(Control::BulkLaneWanted { name }) {
            debug!(name = %name.short(), "the peer takes no control frames; no lane is requested");
        }
    }

    /// Looks at the path and at bulk lanes, and ends those that do not suit it any more.
    pub(crate) fn look(&self, now: Instant, link: &LinkStats) {
        if !self.link.has_bulk_lanes() {
            return;
        }
        let remote = self.link.remote();
        let seen = BulkPathObservation {
            rtt_min: link.rtt_min,
            sent_packets: link.sent_packets,
            lost_packets: link.lost_packets,
        };
        let mut table = self.table();
        let Table { lanes, path, .. } = &mut *table;
        let all = path.observe(now, &seen);
        let mut ended = Vec::new();
        for (name, lane) in lanes {
            let Kind::Bulk(usage) = &mut lane.kind else { continue };
            let seen = lane.up.as_ref().map(|(_, up)| up.stats()).map(|stats| BulkLaneObservation {
                remote: remote.ip(),
                rtt: stats.rtt,
                waits_since: stats.waits_since,
                bytes: stats.sent_bytes.saturating_add(stats.received_bytes),
            });
            let end = all.or_else(|| path.observe_lane(now, usage, seen.as_ref()));
            ended.extend(end.map(|end| (*name, end)));
        }
        for (name, end) in ended {
            debug!(%remote, name = %name.short(), ?end, "a bulk lane ends");
            table.remove(&name);
        }
    }

    /// Ends all bulk lanes.
    pub(crate) fn end_bulk(&self) {
        let mut table = self.table();
        let bulk = table.lanes.iter().filter(|(_, lane)| lane.is_bulk());
        let names: Vec<_> = bulk.map(|(name, _)| *name).collect();
        names.iter().for_each(|name| table.remove(name));
    }

    /// Handles a frame about lanes. The error is a mistake of the peer.
    pub(crate) fn handle(self: &Arc<Self>, frame: &Control) -> Result<(), String> {
        match (frame, &self.dial) {
            (Control::LaneOffer { token, name }, None) => {
                let mut table = self.table();
                let has_room = table.lanes.contains_key(name) || table.lanes.len() < LANES_MAX;
                let accepted = has_room && self.admission.expect(*token, *name, self);
                if accepted {
                    table.lanes.entry(*name).or_default();
                    self.has_any.store(true, Ordering::Relaxed);
                }
                drop(table);
                let answer = Control::LaneAnswer { token: *token, accepted };
                match self.frames.push(answer) {
                    true => Ok(()),
                    false => Err("it does not take control frames".to_owned()),
                }
            }
            (Control::LaneAnswer { token, accepted }, Some(_)) => {
                // A late answer has no waiter any more.
                if let Some(waiting) = self.table().answers.remove(token) {
                    let _ = waiting.send(*accepted);
                }
                Ok(())
            }
            (Control::LaneWanted { name }, Some(_)) => {
                let mut table = self.table();
                if !self.admit(&mut table, *name) {
                    debug!(name = %name.short(), "the peer requests too many lanes");
                }
                Ok(())
            }
            (Control::BulkLaneWanted { name }, Some(_)) => {
                let now = Instant::now();
                let mut table = self.table();
                if table.path.is_paused(now) || !self.admit_bulk(&mut table, *name, now) {
                    debug!(name = %name.short(), "the peer requests a bulk lane that it does not get");
                }
                Ok(())
            }
            (frame, Some(_)) => Err(format!("a lane is not the dialled node's to offer: {frame:?}")),
            (frame, None) => Err(format!("a lane is not this node's to dial: {frame:?}")),
        }
    }

    /// Ends all lanes together with the link.
    pub(crate) fn close(&self) {
        let mut table = self.table();
        let lanes = std::mem::take(&mut table.lanes);
        self.has_any.store(false, Ordering::Relaxed);
        lanes.into_values().for_each(|lane| table.end(lane));
    }

    /// Adds a dedicated lane to the table, and dials it if this node does. It replaces a bulk lane. Returns `false` if
    /// there is no room.
    fn admit(self: &Arc<Self>, table: &mut Table, name: Name) -> bool {
        if table.lanes.get(&name).is_some_and(Lane::is_bulk) {
            table.remove(&name);
        }
        if !table.lanes.contains_key(&name) && table.lanes.len() >= LANES_MAX {
            return false;
        }
        let lane = table.lanes.entry(name).or_default();
        self.has_any.store(true, Ordering::Relaxed);
        if let Some(dial) = &self.dial
            && lane.keeper.is_none()
        {
            let keep = self.clone().keep(name, dial.clone());
            lane.keeper = Some(tokio::spawn(keep).abort_handle());
        }
        true
    }

    /// Adds a bulk lane for a name to the table, and dials it if this node does. Returns `false` if the name has a lane,
    /// or there is no room.
    fn admit_bulk(self: &Arc<Self>, table: &mut Table, name: Name, now: Instant) -> bool {
        if table.lanes.contains_key(&name) || table.lanes.len() >= LANES_MAX || !self.link.has_bulk_lanes() {
            return false;
        }
        let keeper = self.dial.as_ref().map(|(dialer, _)| {
            let keep = self.clone().keep_bulk(name, dialer.clone());
            tokio::spawn(keep).abort_handle()
        });
        table.lanes.insert(
            name,
            Lane { kind: Kind::Bulk(BulkLaneUse::new(now, self.link.remote().ip())), up: None, keeper },
        );
        self.has_any.store(true, Ordering::Relaxed);
        true
    }

    /// Dials a lane, and dials again whenever it ends, until it is no longer wanted.
    async fn keep(self: Arc<Self>, name: Name, dial: Dial) {
        // The generator serves jitter only.
        let mut rng = ChaCha20Rng::seed_from_u64(OsRng.try_next_u64().unwrap_or(0));
        let (mut failures, mut refusals) = (0, 0u32);
        loop {
            match self.open(name, &dial).await {
                Ok(lane) => {
                    (failures, refusals) = (0, 0);
                    self.attach(name, lane.clone());
                    let end = lane.closed().await;
                    let mut table = self.table();
                    if is_goodbye(&end) && table.lanes.get(&name).is_some_and(|lane| !lane.is_wanted_here()) {
                        table.lanes.remove(&name);
                        return;
                    }
                    drop(table);
                    debug!(name = %name.short(), "a lane ended: {end}");
                }
                Err(LaneFailure::Refused) => {
                    if refusals == 0 {
                        info!(remote = %self.link.remote(), "{}; the topic shares the link, and a lane is requested again later", LaneFailure::Refused);
                    }
                    refusals = refusals.saturating_add(1);
                    sleep(doubled(REFUSED_MIN, refusals, REFUSED_MAX, &mut rng)).await;
                    continue;
                }
                Err(why) if failures == 0 => {
                    warn!(remote = %self.link.remote(), "no lane for a topic: {why}; the topic shares the link until the next attempt");
                }
                Err(why) => debug!("no lane: {why}"),
            }
            sleep(wait(failures, BACKOFF_MAX, &mut rng)).await;
            failures = failures.saturating_add(1);
        }
    }

    /// Dials a bulk lane once. A topic that stays large asks for another, as soon as the path is open for one.
    async fn keep_bulk(self: Arc<Self>, name: Name, dialer: Arc<Dialer>) {
        let made = async {
            let token = self.agree(name).await?;
            self.check(dialer.dial_bulk_lane(self.link.remote(), token).await?)
        };
        match made.await {
            // When the lane ends, the task of `attach` forgets it.
            Ok(lane) => self.attach(name, lane),
            Err(why) => {
                debug!(remote = %self.link.remote(), name = %name.short(), "no bulk lane: {why}; the topic stays on the link");
                let mut table = self.table();
                // A dedicated lane may have taken its place.
                if table.lanes.get(&name).is_some_and(|lane| lane.is_bulk() && lane.up.is_none()) {
                    table.lanes.remove(&name);
                }
                table.path.fail(Instant::now());
            }
        }
    }

    /// Agrees on a lane with the peer and dials it.
    async fn open(&self, name: Name, (dialer, url): &Dial) -> Result<AnyLink, LaneFailure> {
        let token = self.agree(name).await?;
        self.check(dialer.dial_lane(url, self.link.remote(), token).await?)
    }

    /// Agrees on a lane with the peer. Returns the token that the lane has to show.
    async fn agree(&self, name: Name) -> Result<LaneToken, LaneFailure> {
        let mut token = [0; 16];
        OsRng.try_fill_bytes(&mut token).map_err(|_| LaneFailure::NoAnswer)?;
        let token = LaneToken(token);
        let (answer, answered) = oneshot::channel();
        self.table().answers.insert(token, answer);
        let asked = async {
            self.frames.push_later(Control::LaneOffer { token, name }).await.then_some(())?;
            answered.await.ok()
        };
        let accepted = timeout(ANSWER_MAX, asked).await;
        self.table().answers.remove(&token);
        match accepted {
            Ok(Some(true)) => Ok(token),
            Ok(Some(false)) => Err(LaneFailure::Refused),
            Ok(None) | Err(_) => Err(LaneFailure::NoAnswer),
        }
    }

    /// Returns a dialled lane if it leads to the link's peer, and closes it otherwise.
    fn check(&self, lane: AnyLink) -> Result<AnyLink, LaneFailure> {
        if lane.peer().node_id != self.link.peer().node_id {
            lane.close(CloseReason::Denied("this is not the node that the lane was agreed on with".into()));
            return Err(LaneFailure::OtherNode);
        }
        Ok(lane)
    }

    /// Takes a lane into use.
    fn attach(self: &Arc<Self>, name: Name, lane: AnyLink) {
        let Some(receive) = self.receive.get() else { return lane.close(CloseReason::Goodbye) };
        let number = self.number.fetch_add(1, Ordering::Relaxed) + 1;
        let mut table = self.table();
        let Some(entry) = table.lanes.get_mut(&name) else {
            drop(table);
            return lane.close(CloseReason::Goodbye);
        };
        // An offer does not tell the kind of a lane; its transport does.
        let is_bulk = matches!((&self.link, &lane), (AnyLink::Quic(_), AnyLink::Stream(_)));
        if is_bulk && !entry.is_bulk() && !entry.is_wanted_here() {
            entry.kind = Kind::Bulk(BulkLaneUse::new(Instant::now(), self.link.remote().ip()));
        }
        let old = entry.up.replace((number, lane.clone()));
        if let Some((_, old)) = old {
            table.put_away(&old);
            drop(table);
            old.close(CloseReason::Replaced);
        } else {
            drop(table);
        }
        debug!(remote = %lane.remote(), name = %name.short(), is_bulk, "a lane is up");
        receive(lane.clone(), name);
        let lanes = Arc::downgrade(self);
        tokio::spawn(async move {
            let end = lane.closed().await;
            if let Some(lanes) = lanes.upgrade() {
                lanes.detach(&name, number, &end);
            }
        });
    }

    /// Takes a lane that ended out of use.
    fn detach(&self, name: &Name, number: u64, end: &LinkError) {
        let mut table = self.table();
        let Some(lane) = table.lanes.get_mut(name).filter(|l| l.up.as_ref().is_some_and(|up| up.0 == number))
        else {
            return;
        };
        let up = lane.up.take();
        // The accepting side forgets a dedicated lane that ends, since the dialling side offers it again. Both sides
        // forget a bulk lane.
        let now = Instant::now();
        let is_lost = match &lane.kind {
            Kind::Bulk(usage) => Some(!is_goodbye(end) || usage.is_recent(now)),
            Kind::Dedicated { .. } => None,
        };
        if is_lost.is_some() || (self.dial.is_none() && !lane.is_wanted_here()) {
            table.lanes.remove(name);
        }
        if is_lost == Some(true) {
            debug!(remote = %self.link.remote(), name = %name.short(), "a bulk lane broke: {end}");
            table.path.fail(now);
        }
        if let Some((_, up)) = up {
            table.put_away(&up);
        }
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        lock(&self.table)
    }
}

fn is_goodbye(end: &LinkError) -> bool {
    matches!(end, LinkError::Closed { reason: CloseReason::Goodbye, .. })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use sgc_transport::{CredentialStore, LinkOptions, Listener};
    use sgc_trust::{EnrollRequest, Fleet};
    use tokio::sync::mpsc;

    use super::*;
    use crate::clock::now;
    use crate::control::peers::control_queue::Outgoing;

    /// A router, with nodes of its fleet that dial it.
    struct Bench {
        fleet: Fleet,
        listener: Listener,
        admission: LaneAdmission,
    }

    /// Lanes at one end of a link, and the frames that this end sends.
    type End = (Arc<Lanes>, mpsc::Receiver<Outgoing>);

    impl Bench {
        fn new() -> Self {
            let fleet = Fleet::create("lab".parse().unwrap(), now().unix, &mut OsRng.unwrap_err()).unwrap();
            let router = Self::credentials(&fleet, "router");
            let addr = "quic://127.0.0.1:0".parse().unwrap();
            let listener = Listener::bind(&addr, router, LinkOptions::default(), Arc::default()).unwrap();
            Self { fleet, listener, admission: LaneAdmission::default() }
        }

        fn credentials(fleet: &Fleet, node: &str) -> CredentialStore {
            let request = EnrollRequest::new(node.parse().unwrap(), now().unix);
            CredentialStore::new(Arc::new(fleet.issue(&request, &mut OsRng.unwrap_err()).unwrap()))
        }

        /// Links a node to the router. Returns the node's end and the router's end.
        async fn link(&mut self, node: &str) -> (End, End) {
            let store = Self::credentials(&self.fleet, node);
            let dialer = Arc::new(Dialer::new(store, LinkOptions::default(), Arc::default()));
            let url: LinkUrl = self.listener.local().to_string().parse().unwrap();
            let (near, far) = tokio::join!(dialer.dial(&url), self.listener.accept());
            let end = |link, dial, admission| {
                let (frames, sent) = ControlQueue::new();
                (Lanes::new(link, frames, dial, admission), sent)
            };
            let near = end(near.unwrap(), Some((dialer, url)), LaneAdmission::default());
            (near, end(far.unwrap().unwrap(), None, self.admission.clone()))
        }
    }

    fn offer(lanes: &Arc<Lanes>, sent: &mut mpsc::Receiver<Outgoing>, n: u16, name: Name) -> bool {
        let mut token = [0; 16];
        token[..2].copy_from_slice(&n.to_be_bytes());
        lanes.handle(&Control::LaneOffer { token: LaneToken(token), name }).unwrap();
        let Outgoing::Frame(Control::LaneAnswer { accepted, .. }) = sent.try_recv().unwrap() else {
            panic!("an answer")
        };
        accepted
    }

    #[tokio::test]
    async fn link_with_repeated_offers_leaves_room_for_lanes_of_others() {
        let mut bench = Bench::new();
        let (_, (greedy, mut to_greedy)) = bench.link("greedy").await;
        let (_, (other, mut to_other)) = bench.link("other").await;
        // Each offer has its own token, and none of the lanes arrives.
        let offers = 0..u16::try_from(2 * EXPECTED_MAX).unwrap();
        let accepted = offers.filter(|n| offer(&greedy, &mut to_greedy, *n, Name([1; 32]))).count();
        assert_eq!(accepted, LANES_MAX);
        assert!(offer(&other, &mut to_other, u16::MAX, Name([2; 32])));
    }

    #[tokio::test]
    async fn a_lane_that_was_refused_is_offered_again_seldom() {
        let mut bench = Bench::new();
        let ((lanes, mut sent), _far) = bench.link("robot").await;
        tokio::time::pause();
        lanes.set_wanted(Name([1; 32]), true);
        let mut last = tokio::time::Instant::now();
        for refusals in 0..8 {
            let frame = timeout(2 * REFUSED_MAX, sent.recv()).await.expect("it is offered again");
            let Some(Outgoing::Frame(Control::LaneOffer { token, .. })) = frame else { panic!("an offer") };
            let most = REFUSED_MIN.saturating_mul(2u32.pow(refusals) / 2).min(REFUSED_MAX);
            let waited = last.elapsed();
            assert!(most / 2 <= waited && waited <= most + ANSWER_MAX, "{refusals}: {waited:?} of {most:?}");
            lanes.handle(&Control::LaneAnswer { token, accepted: false }).unwrap();
            last = tokio::time::Instant::now();
        }
    }
}
