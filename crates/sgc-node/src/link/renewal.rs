//! Carries out the decisions of a [`LinkSupervisor`]: dials, reports, moves and closes the links to one router.
//!
//! It decides nothing about when a link is replaced.

use std::future::Future;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng as _, TryRngCore as _};
use sgc_session::{DialCause, Event, LinkFacts, LinkKey, LinkSupervisor, Output};
use sgc_transport::{AnyLink, CloseReason, Link, LinkError, LinkUrl};
use sgc_wire::NodeId;
use tokio::runtime::Handle;
use tokio::sync::{mpsc, watch};
use tracing::{debug, info, warn};

use crate::clock::time_now;
use crate::control::event::CoreEvent;
use crate::discovery::{
    Claim, DialTarget, DialledLink, Failure, LinkKeeper, LinkRequest, SkippedUrl, StatusRow, is_over_udp,
};
use crate::link::lanes::LaneAdmission;
use crate::link::links::ReportedLink;
use crate::link::roaming::{Network, source_towards};

/// A dial under way. It yields the link with the target that was dialled.
type Dialling = Pin<Box<dyn Future<Output = Result<(DialledLink, DialTarget), Failure>> + Send>>;
/// Waiting for the peer's own link, which has precedence.
type PeerLinked = Pin<Box<dyn Future<Output = ()> + Send>>;
/// Waiting for a successor to settle or to end.
type Settling = Pin<Box<dyn Future<Output = SettleResult> + Send>>;

/// End of the wait for a successor.
enum SettleResult {
    Settled(LinkKey),
    Ended(LinkKey, LinkError),
}

/// Wishes that reach a link while it is up.
pub(crate) struct Signals {
    /// Target of the link. A change asks for another link.
    pub(crate) target: watch::Receiver<DialTarget>,
    /// Changes with the credentials.
    pub(crate) redial: watch::Receiver<()>,
    /// Changes of the network since the first dial began.
    pub(crate) network: Network,
}

/// A link of the supervisor.
struct Held {
    reported: Arc<ReportedLink>,
    url: LinkUrl,
}

/// A successor that has not settled, and what is shown once it is adopted.
struct Successor {
    key: LinkKey,
    held: Held,
    target: DialTarget,
    passed: Vec<SkippedUrl>,
    /// Claim on the peer, if it is another node.
    claim: Option<Claim>,
    settling: Settling,
}

/// The links to one router.
struct Renewal<'a> {
    supervisor: LinkSupervisor,
    keeper: &'a LinkKeeper,
    row: &'a StatusRow,
    /// Conditions that each link has to meet.
    request: &'a LinkRequest,
    signals: Signals,
    claim: Claim,
    current: Held,
    dialling: Option<Dialling>,
    /// Reason of the last dial.
    cause: DialCause,
    /// Source address of packets to the peer of the link in use when the last dial began.
    source_before: Option<IpAddr>,
    successor: Option<Successor>,
    /// `None` after the peer of the link in use made a link of its own that has precedence.
    peer_linked: Option<PeerLinked>,
    last_key: LinkKey,
    /// Reason given to peers whose links the supervisor closes.
    close_reason: CloseReason,
    /// Whether the last link has ended.
    has_ended: bool,
}

/// Serves a link and its replacements, and returns when the last of them has ended. [`LinkSupervisor`] decides when a
/// link is replaced.
pub(crate) async fn keep_renewed(
    link: AnyLink,
    url: LinkUrl,
    signals: Signals,
    request: &LinkRequest,
    keeper: &LinkKeeper,
    claim: Claim,
    row: &StatusRow,
) -> LinkError {
    // The generator serves jitter only.
    let rng = ChaCha20Rng::seed_from_u64(OsRng.try_next_u64().unwrap_or(0));
    let rank = signals.target.borrow().better_than(&url).len();
    let current = serve(keeper, link, url).await;
    let key = LinkKey(0);
    let renewal = Renewal {
        supervisor: LinkSupervisor::new(time_now(), current.facts(key, rank), rng),
        keeper,
        row,
        request,
        signals,
        peer_linked: Some(peer_linked(keeper, request, claim.node())),
        claim,
        current,
        dialling: None,
        cause: DialCause::Renewal,
        source_before: None,
        successor: None,
        last_key: key,
        close_reason: CloseReason::Goodbye,
        has_ended: false,
    };
    renewal.run().await
}

/// Ends the links when the search for the router is ended.
impl Drop for Renewal<'_> {
    fn drop(&mut self) {
        if self.has_ended || self.keeper.core.is_closed() {
            return;
        }
        let Ok(runtime) = Handle::try_current() else { return };
        let successor = self.successor.take().map(|successor| successor.held.reported);
        for reported in [self.current.reported.clone()].into_iter().chain(successor) {
            let core = self.keeper.core.clone();
            runtime.spawn(async move { reported.leave(&core).await });
        }
    }
}

/// Waits until this node has a link of its own that has precedence.
fn peer_linked(keeper: &LinkKeeper, request: &LinkRequest, node: NodeId) -> PeerLinked {
    let (claims, gives_way) = (keeper.claims.clone(), keeper.gives_way(request, &node));
    Box::pin(async move {
        match gives_way {
            true => claims.arrived(&node).await,
            false => std::future::pending().await,
        }
    })
}

/// Reports a link and starts to receive.
async fn serve(keeper: &LinkKeeper, link: AnyLink, url: LinkUrl) -> Held {
    let dial = (keeper.lane_dialer.clone(), url.clone());
    let reported = ReportedLink::start(link, Some(dial), LaneAdmission::default(), &keeper.core).await;
    Held { reported: Arc::new(reported), url }
}

impl Held {
    fn facts(&self, key: LinkKey, rank: usize) -> LinkFacts {
        LinkFacts { key, rank, over_udp: is_over_udp(self.url.scheme), source: self.source() }
    }

    /// Returns the source address of packets to the peer.
    fn source(&self) -> Option<IpAddr> {
        source_towards(self.reported.link.remote())
    }

    fn received_bytes(&self) -> u64 {
        self.reported.link.stats().received_bytes
    }
}

impl Renewal<'_> {
    async fn run(mut self) -> LinkError {
        let keeper = self.keeper;
        let mut is_over = false;
        loop {
            let deadline = loop {
                match self.supervisor.poll_output() {
                    Output::Timeout(at) => break at,
                    Output::Ended => {
                        self.has_ended = true;
                        return self.current.reported.link.closed().await;
                    }
                    output => self.carry_out(output),
                }
            };
            let settling = self.successor.as_mut().map(|successor| &mut successor.settling);
            let event = tokio::select! {
                end = self.current.reported.end(&keeper.core) => {
                    if self.successor.is_some() {
                        debug!(url = %self.current.url, "the link ended: {end}");
                    }
                    Event::Closed(self.supervisor.link())
                }
                dialled = done(self.dialling.as_mut()) => {
                    self.dialling = None;
                    self.dialled(dialled).await
                }
                result = done(settling) => self.settled(result),
                () = self.signals.network.changed() => Event::NetworkChanged,
                () = changed(&mut self.signals.redial) => Event::CredentialsRenewed,
                () = changed(&mut self.signals.target) => Event::TargetChanged,
                () = is_due(deadline) => Event::Timeout { received_bytes: self.current.received_bytes() },
                () = done(self.peer_linked.as_mut()) => {
                    self.peer_linked = None;
                    self.close_reason = CloseReason::Replaced;
                    Event::PeerLinked
                }
                () = keeper.core.closed(), if !is_over => {
                    is_over = true;
                    Event::Shutdown
                }
            };
            self.supervisor.handle(time_now(), event);
        }
    }

    fn carry_out(&mut self, output: Output) {
        match output {
            Output::Dial(cause) => self.dial(cause),
            Output::AbortDial => self.dialling = None,
            Output::LookUpSource => {
                let (source, received_bytes) = (self.current.source(), self.current.received_bytes());
                self.supervisor.handle(time_now(), Event::Source { source, received_bytes });
            }
            Output::Rebind => {
                info!(remote = %self.current.reported.link.remote(), "the network changed; the link goes on from here");
                self.keeper.rebind();
                self.current.reported.end_bulk_lanes();
            }
            Output::Retire(_) => {
                let (old, core) = (self.current.reported.clone(), self.keeper.core.clone());
                tokio::spawn(async move { old.retire(&core).await });
            }
            Output::Adopt(key) => {
                if let Some(successor) = self.successor.take_if(|successor| successor.key == key) {
                    self.adopt(successor);
                }
            }
            Output::Close(key) => match self.successor.take_if(|successor| successor.key == key) {
                Some(successor) => {
                    let (reported, core) = (successor.held.reported, self.keeper.core.clone());
                    reported.link.close(self.close_reason.clone());
                    tokio::spawn(async move { reported.end(&core).await });
                }
                None => self.current.reported.link.close(self.close_reason.clone()),
            },
            Output::Ended | Output::Timeout(_) => {}
        }
    }

    fn dial(&mut self, cause: DialCause) {
        let (keeper, url) = (self.keeper.clone(), self.current.url.clone());
        self.cause = cause;
        match cause {
            DialCause::Network => {
                info!(remote = %self.current.reported.link.remote(), "the network changed; reconnecting from here");
            }
            DialCause::Silence => {
                info!(%url, "nothing arrives since the network changed; connecting again in parallel");
            }
            DialCause::Failback | DialCause::Renewal | DialCause::Retry => {}
        }
        self.source_before = self.current.source();
        self.dialling = Some(if cause == DialCause::Failback {
            let target = self.signals.target.borrow().clone();
            Box::pin(async move {
                let dialled = keeper.dial_first(target.better_than(&url)).await?;
                Ok((dialled, target))
            })
        } else {
            self.signals.redial.mark_unchanged();
            let target = self.signals.target.borrow_and_update().clone();
            Box::pin(async move {
                let dialled = keeper.dial(&target).await?;
                Ok((dialled, target))
            })
        });
    }

    /// Returns the source address of packets to a successor's peer when the dial began. The network may have changed
    /// during the dial; then it is that towards the peer of the link in use.
    fn source_of(&self, successor: &Held) -> Option<IpAddr> {
        let before = self.source_before;
        if before == self.current.source() { successor.source() } else { before }
    }

    /// Serves a dialled link as successor, or shows why there is none.
    async fn dialled(&mut self, result: Result<(DialledLink, DialTarget), Failure>) -> Event {
        let claimed = result.and_then(|(dialled, target)| {
            let claim = self.keeper.enter_again(&dialled.link, self.request, &self.claim)?;
            Ok((dialled, target, claim))
        });
        match claimed {
            Ok((DialledLink { link, url, passed }, target, claim)) => {
                let key = LinkKey(self.last_key.0 + 1);
                self.last_key = key;
                let rank = target.better_than(&url).len();
                let held = serve(self.keeper, link, url).await;
                let facts = LinkFacts { source: self.source_of(&held), ..held.facts(key, rank) };
                let settling = Box::pin(settle(key, held.reported.clone(), self.keeper.core.clone()));
                self.successor = Some(Successor { key, held, target, passed, claim, settling });
                Event::Dialled(facts)
            }
            Err(why) if self.cause == DialCause::Failback => {
                debug!("no better URL works yet: {why}");
                Event::DialFailed
            }
            Err(why) => {
                if !self.supervisor.is_retrying() {
                    warn!("cannot reconnect: {why}; the old link stays until the next attempt");
                }
                self.row.noted(&why.to_string());
                Event::DialFailed
            }
        }
    }

    fn settled(&mut self, result: SettleResult) -> Event {
        match result {
            SettleResult::Settled(key) => {
                if let Some(successor) = &mut self.successor {
                    successor.settling = Box::pin(std::future::pending());
                }
                Event::Settled(key)
            }
            SettleResult::Ended(key, end) => {
                warn!("the replacement link ended: {end}; the old link stays until the next attempt");
                self.successor = None;
                Event::Closed(key)
            }
        }
    }

    fn adopt(&mut self, successor: Successor) {
        let Successor { held, target, passed, claim, .. } = successor;
        let node = held.reported.link.peer().node_id;
        if node != self.claim.node() {
            self.peer_linked = Some(peer_linked(self.keeper, self.request, node));
        }
        self.keeper.linked(&target, &held.url, &passed, &node, self.row);
        self.current = held;
        if let Some(claim) = claim {
            self.claim = claim;
        }
    }
}

/// Waits until a successor settles or ends.
async fn settle(key: LinkKey, reported: Arc<ReportedLink>, core: mpsc::Sender<CoreEvent>) -> SettleResult {
    tokio::select! {
        () = reported.settled() => SettleResult::Settled(key),
        end = reported.end(&core) => SettleResult::Ended(key, end),
    }
}

/// Waits for a future. Waits for ever if there is none.
async fn done<F: Future + Unpin>(future: Option<&mut F>) -> F::Output {
    match future {
        Some(future) => future.await,
        None => std::future::pending().await,
    }
}

/// Waits for a change. Waits for ever if the sender is gone.
async fn changed<T>(watched: &mut watch::Receiver<T>) {
    if watched.changed().await.is_err() {
        std::future::pending().await
    }
}

/// Waits until a time. Waits for ever if there is none.
async fn is_due(at: Option<Instant>) {
    match at {
        Some(at) => tokio::time::sleep_until(at.into()).await,
        None => std::future::pending().await,
    }
}
