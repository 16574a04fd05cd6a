//! Lanes: connections beside a link, each for the packets of one name, so that a camera has its own congestion
//! controller and queue (`link = "dedicated"`; `docs/spec/wire.md`, lanes).
//!
//! The node that dialled the link dials its lanes, since the other node may be unable to. Everything else treats a lane
//! as part of its link: packets of a lane came over the link, and without the lane the link carries its name as well.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, Weak};
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng as _, TryRngCore as _};
use sgc_session::{BACKOFF_MAX, doubled, wait};
use sgc_sync::lock;
use sgc_transport::{AnyLink, CloseReason, DialError, Dialer, Link, LinkError, LinkUrl};
use sgc_wire::{Control, LaneToken, Name, NodeId};
use tokio::sync::oneshot;
use tokio::task::AbortHandle;
use tokio::time::{sleep, timeout};
use tracing::{debug, info, warn};

use crate::control::peers::control_queue::ControlQueue;

/// Most lanes of one link.
pub(crate) const LANES_MAX: usize = 8;
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
}

/// A lane that was agreed on.
struct ExpectedLane {
    node: NodeId,
    name: Name,
    lanes: Weak<Lanes>,
    until: Instant,
}

impl LaneAdmission {
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
                warn!(remote = %lane.remote(), peer = %lane.peer().node_id.short(), "closed an unexpected lane");
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
}

#[derive(Default)]
struct Lane {
    up: Option<(u64, AnyLink)>,
    wanted_here: bool,
    /// Task that dials the lane, if this node dials.
    keeper: Option<AbortHandle>,
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

    /// Returns the number of lanes that are up.
    pub(crate) fn count(&self) -> usize {
        self.table().lanes.values().filter(|lane| lane.up.is_some()).count()
    }

    /// Starts or stops to want a lane for a name.
    pub(crate) fn set_wanted(self: &Arc<Self>, name: Name, wanted: bool) {
        if !wanted && !self.has_any.load(Ordering::Relaxed) {
            return;
        }
        let mut table = self.table();
        if !wanted {
            if table.lanes.get(&name).is_some_and(|lane| lane.wanted_here)
                && let Some(lane) = table.lanes.remove(&name)
            {
                end(lane);
            }
            return;
        }
        let is_known = table.lanes.get(&name).is_some_and(|lane| lane.wanted_here);
        if is_known {
            return;
        }
        if !self.admit(&mut table, name) {
            warn!(remote = %self.link.remote(), "a topic gets no lane, because {LANES_MAX} others have one; it shares the link");
            return;
        }
        if let Some(lane) = table.lanes.get_mut(&name) {
            lane.wanted_here = true;
        }
        drop(table);
        if self.dial.is_none() && !self.frames.push(Control::LaneWanted { name }) {
            debug!(name = %name.short(), "the peer takes no control frames; no lane is requested");
        }
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
            (frame, Some(_)) => Err(format!("a lane is not the dialled node's to offer: {frame:?}")),
            (frame, None) => Err(format!("a lane is not this node's to dial: {frame:?}")),
        }
    }

    /// Ends all lanes together with the link.
    pub(crate) fn close(&self) {
        let lanes = std::mem::take(&mut self.table().lanes);
        self.has_any.store(false, Ordering::Relaxed);
        lanes.into_values().for_each(end);
    }

    /// Adds a lane to the table, and dials it if this node does. Returns `false` if there is no room.
    fn admit(self: &Arc<Self>, table: &mut Table, name: Name) -> bool {
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
                    let goodbye = matches!(&end, LinkError::Closed { reason: CloseReason::Goodbye, .. });
                    let mut table = self.table();
                    if goodbye && table.lanes.get(&name).is_some_and(|lane| !lane.wanted_here) {
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

    /// Agrees on a lane with the peer and dials it.
    async fn open(&self, name: Name, (dialer, url): &Dial) -> Result<AnyLink, LaneFailure> {
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
            Ok(Some(true)) => {}
            Ok(Some(false)) => return Err(LaneFailure::Refused),
            Ok(None) | Err(_) => return Err(LaneFailure::NoAnswer),
        }
        let lane = dialer.dial_lane(url, self.link.remote(), token).await?;
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
        let old = entry.up.replace((number, lane.clone()));
        drop(table);
        if let Some((_, old)) = old {
            old.close(CloseReason::Replaced);
        }
        debug!(remote = %lane.remote(), name = %name.short(), "a lane is up");
        receive(lane.clone(), name);
        let lanes = Arc::downgrade(self);
        tokio::spawn(async move {
            lane.closed().await;
            if let Some(lanes) = lanes.upgrade() {
                lanes.detach(&name, number);
            }
        });
    }

    fn detach(&self, name: &Name, number: u64) {
        let mut table = self.table();
        let Some(lane) = table.lanes.get_mut(name).filter(|l| l.up.as_ref().is_some_and(|up| up.0 == number))
        else {
            return;
        };
        lane.up = None;
        // The accepting side forgets a lane that ends, since the dialling side offers it again.
        if self.dial.is_none() && !lane.wanted_here {
            table.lanes.remove(name);
        }
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        lock(&self.table)
    }
}

fn end(lane: Lane) {
    if let Some(keeper) = lane.keeper {
        keeper.abort();
    }
    if let Some((_, up)) = lane.up {
        up.close(CloseReason::Goodbye);
    }
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
