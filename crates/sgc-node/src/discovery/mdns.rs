//! Links to routers that announce themselves on the local network: a few at once, each to another router.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use sgc_session::{AttemptResult, BACKOFF_MAX, CANDIDATES_MAX, Candidates, wait};
use sgc_transport::{LinkUrl, Scheme};
use sgc_wire::NodeId;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{sleep, sleep_until};
use tracing::{debug, warn};

use super::local::Sighting;
use crate::drops::NodeDrop;
use crate::link::in_use::place_in_use;

use super::{Board, DialTarget, Failure, KeepLink, LinkRequest, LocalNetwork, Outcome, StatusRow};
use crate::clock::time_now;

/// Most links to announced routers.
pub(crate) const LINKS_MAX: usize = 2;
/// Most announced routers that are dialled at once.
pub(crate) const DIALS_MAX: usize = 4;
/// Least time between two resets of all back-offs after network changes, which neighbours can provoke.
const FORGIVE_EVERY: Duration = Duration::from_secs(10);
/// Announcements that may wait to be judged.
const HEARD_MAX: usize = 64;

/// Listens for announcements and keeps links to some of the routers.
pub(crate) async fn keep_some<H: KeepLink>(
    local: Arc<LocalNetwork>,
    wanted: RouterFilter,
    keeper: H,
    board: Board,
    mut rng: ChaCha20Rng,
) {
    let (tell, heard) = mpsc::channel(HEARD_MAX);
    let mut link_rng = rng.clone();
    // The two generators must not yield the same numbers.
    link_rng.set_stream(1);
    let row = board.row(&wanted.written, "mdns");
    let keep = keep_links(heard, wanted, keeper, &board, &row, link_rng);
    let listen = async {
        let mut failures = 0;
        loop {
            match local.browse() {
                Ok(events) => {
                    failures = 0;
                    while let Ok(event) = events.recv_async().await {
                        if let Some(heard) = local.heard(event)
                            && tell.send(heard).await.is_err()
                        {
                            return;
                        }
                    }
                    // The queue overflowed. Routers repeat their announcements, so none is lost for good.
                    board.drops().count(NodeDrop::MdnsOverrun);
                }
                Err(why) => {
                    if failures == 0 {
                        warn!("cannot look for routers on the local network: {why}; trying again");
                    }
                    row.failed(&why.to_string());
                    failures += 1;
                }
            }
            sleep(wait(failures.max(3), BACKOFF_MAX, &mut rng)).await;
        }
    };
    tokio::select! {
        () = keep => {}
        () = listen => {}
    }
}

/// The routers on the local network that are wanted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RouterFilter {
    /// As the user wrote it.
    pub(crate) written: String,
    /// The only nodes that are wanted; `None` means all trusted ones.
    pub(crate) nodes: Option<Arc<BTreeSet<NodeId>>>,
}

/// Result of an attempt at an announced router.
struct Attempt {
    addresses: Vec<SocketAddr>,
    outcome: Outcome,
}

/// Dials announced routers, [`DIALS_MAX`] at once, until [`LINKS_MAX`] links are up.
pub(crate) async fn keep_links<H: KeepLink>(
    mut heard: mpsc::Receiver<Sighting>,
    wanted: RouterFilter,
    keeper: H,
    board: &Board,
    row: &StatusRow,
    mut rng: ChaCha20Rng,
) {
    let places = Arc::new(Semaphore::new(LINKS_MAX));
    let request = LinkRequest { hearsay: true, nodes: wanted.nodes, places: Some(places.clone()) };
    let mut found = Candidates::default();
    let mut attempts: JoinSet<Attempt> = JoinSet::new();
    // Routers with another link, until that link ends.
    let mut elsewhere: JoinSet<Vec<SocketAddr>> = JoinSet::new();
    // At most one task waits per router, however often it is tried.
    let mut waiting = BTreeSet::new();
    let (mut network, mut forgiven) = (keeper.network(), None::<Instant>);
    loop {
        let now = time_now();
        let mut is_full = true;
        while places.available_permits() > 0 {
            let linked = LINKS_MAX - places.available_permits();
            if attempts.len().saturating_sub(linked) >= DIALS_MAX {
                break;
            }
            let Some(addresses) = found.next(now) else {
                is_full = false;
                break;
            };
            attempts.spawn(attempt(addresses, request.clone(), keeper.clone(), board.clone()));
        }
        // Due candidates without a place wait for one.
        let next = found.next_due(now).filter(|_| !is_full);
        let timer = async {
            match next {
                Some(at) => sleep_until(at.into()).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            event = heard.recv() => match event {
                Some(Sighting::Announced { instance, addresses }) => {
                    debug!(%instance, ?addresses, "a router is announced on the local network");
                    if !found.announced(&instance, addresses) {
                        board.drops().count(NodeDrop::MdnsCrowded);
                    }
                }
                Some(Sighting::Vanished { instance }) => found.vanished(&instance),
                Some(Sighting::Unknown) => {
                    board.drops().count(NodeDrop::MdnsUnknown);
                }
                None => return,
            },
            Some(done) = attempts.join_next() => {
                let Ok(Attempt { addresses, outcome }) = done else { continue };
                if keeper.is_over() {
                    return;
                }
                if let (Outcome::Failed(why), Some(first)) = (&outcome, addresses.first()) {
                    row.noted(&format!("{first}: {why}"));
                }
                let verdict = judge(&outcome);
                if let Outcome::Failed(Failure::Reached(node)) = outcome
                    && waiting.len() < CANDIDATES_MAX
                    && waiting.insert(addresses.clone())
                {
                    let (keeper, addresses) = (keeper.clone(), addresses.clone());
                    elsewhere.spawn(async move {
                        keeper.released(&node).await;
                        addresses
                    });
                }
                found.done(&addresses, verdict, time_now(), &mut rng);
            }
            Some(released) = elsewhere.join_next() => {
                let released = released.unwrap_or_default();
                waiting.remove(&released);
                found.forgive(&released);
            }
            () = timer => {}
            () = network.changed() => {
                let now = time_now();
                if forgiven.is_none_or(|at| now - at >= FORGIVE_EVERY) {
                    forgiven = Some(now);
                    found.forgive_all();
                }
            }
        }
    }
}

/// Dials an announced router and keeps the link.
async fn attempt<H: KeepLink>(
    addresses: Vec<SocketAddr>,
    request: LinkRequest,
    keeper: H,
    board: Board,
) -> Attempt {
    let url = LinkUrl {
        scheme: Scheme::Quic,
        host: addresses.first().map(|first| first.ip().to_string()).unwrap_or_default(),
        port: addresses.first().map_or(0, SocketAddr::port),
        path: None,
        cost_ms: None,
    };
    let row = board.row(&url, "mdns");
    let (_fixed, target) =
        watch::channel(DialTarget { addresses: addresses.clone(), ..DialTarget::from(url.clone()) });
    let outcome = keeper.keep_link(target, &request, &row).await;
    match &outcome {
        Outcome::Ended { remote, end } => debug!(%remote, "the link ended: {end}"),
        Outcome::Failed(why) => debug!(%url, "a router on the local network: {why}"),
    }
    Attempt { addresses, outcome }
}

fn judge(outcome: &Outcome) -> AttemptResult {
    match outcome {
        Outcome::Ended { end, .. } if place_in_use(end).is_some() => AttemptResult::StandBack,
        Outcome::Ended { .. } => AttemptResult::Ended,
        // A router of another fleet stays one.
        Outcome::Failed(Failure::Dial(why)) if why.is_refusal() => AttemptResult::StandBack,
        // A place becomes free only when a link ends.
        Outcome::Failed(Failure::Enough) => AttemptResult::Failed,
        Outcome::Failed(why) if why.stands_back() => AttemptResult::StandBack,
        Outcome::Failed(_) => AttemptResult::Failed,
    }
}
