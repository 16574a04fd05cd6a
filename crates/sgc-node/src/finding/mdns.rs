//! Links to routers that the local network tells of: a few at once, each to another router.

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use sgc_transport::{LinkUrl, Scheme};
use sgc_wire::NodeId;
use tokio::sync::{Semaphore, mpsc, watch};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, sleep_until};
use tracing::{debug, info, warn};

use super::candidates::{CANDIDATES_MAX, Candidates, Verdict};
use super::local::Heard;
use crate::links::place_in_use;

use super::{Aim, BACKOFF_MAX, Board, Failure, Hold, Line, LocalNetwork, Outcome, Wish, wait};

/// Most links to routers that were found so.
pub(crate) const LINKS_MAX: usize = 2;
/// Most that are dialled at once.
pub(crate) const DIALS_MAX: usize = 4;
/// How often failures may be forgotten because the network changed, which neighbours can bring about.
const FORGIVE_EVERY: Duration = Duration::from_secs(10);
/// What was heard and not looked at yet.
const HEARD_MAX: usize = 64;

/// Hears of routers, and keeps links to some of them.
pub(crate) async fn keep_some<H: Hold>(
    local: Arc<LocalNetwork>,
    wanted: Wanted,
    holder: H,
    board: Board,
    mut rng: ChaCha20Rng,
) {
    let (tell, heard) = mpsc::channel(HEARD_MAX);
    let mut keeper = rng.clone();
    // Another stream than the one above.
    keeper.set_stream(1);
    let line = board.line(&wanted.written, "mdns");
    let keep = keep_links(heard, wanted, holder, &board, &line, keeper);
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
                    // Too much was announced for this node to keep up with; what counts is announced again.
                    board.drops().count("mdns_overrun");
                }
                Err(why) => {
                    if failures == 0 {
                        warn!("cannot look for routers on the local network: {why}; trying again");
                    }
                    line.failed(&why.to_string());
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

/// Which of the routers on the local network are wanted.
#[derive(Clone, Debug)]
pub(crate) struct Wanted {
    /// As the user wrote it.
    pub(crate) written: String,
    /// Only these; all that are trusted if there is nothing.
    pub(crate) nodes: Option<Arc<BTreeSet<NodeId>>>,
}

/// What an attempt came to.
struct Done {
    addresses: Vec<SocketAddr>,
    outcome: Outcome,
}

/// Dials what is heard of, [`DIALS_MAX`] at once, until [`LINKS_MAX`] links are up.
pub(crate) async fn keep_links<H: Hold>(
    mut heard: mpsc::Receiver<Heard>,
    wanted: Wanted,
    holder: H,
    board: &Board,
    line: &Line,
    mut rng: ChaCha20Rng,
) {
    let places = Arc::new(Semaphore::new(LINKS_MAX));
    let wish = Wish { hearsay: true, nodes: wanted.nodes, places: Some(places.clone()) };
    let mut found = Candidates::default();
    let mut attempts: JoinSet<Done> = JoinSet::new();
    // Routers that were reached in another way, until they are not.
    let mut elsewhere: JoinSet<Vec<SocketAddr>> = JoinSet::new();
    // Of each one waits at most, however often it is tried meanwhile.
    let mut waiting = BTreeSet::new();
    let (mut network, mut forgiven) = (holder.network(), None::<Instant>);
    loop {
        let now = Instant::now();
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
            attempts.spawn(attempt(addresses, wish.clone(), holder.clone(), board.clone()));
        }
        // What is due and has no place waits for one.
        let next = found.next_due(now).filter(|_| !is_full);
        let timer = async {
            match next {
                Some(at) => sleep_until(at).await,
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            event = heard.recv() => match event {
                Some(Heard::Announced { instance, addresses }) => {
                    debug!(%instance, ?addresses, "a router is announced on the local network");
                    if !found.announced(&instance, addresses) {
                        board.drops().count("mdns_crowded");
                    }
                }
                Some(Heard::Vanished { instance }) => found.vanished(&instance),
                Some(Heard::Unknown) => {
                    board.drops().count("mdns_unknown");
                }
                None => return,
            },
            Some(done) = attempts.join_next() => {
                let Ok(Done { addresses, outcome }) = done else { continue };
                if holder.is_over() {
                    return;
                }
                if let (Outcome::Failed(why), Some(first)) = (&outcome, addresses.first()) {
                    line.noted(&format!("{first}: {why}"));
                }
                let verdict = judge(&outcome);
                if let Outcome::Failed(Failure::Reached(node)) = outcome
                    && waiting.len() < CANDIDATES_MAX
                    && waiting.insert(addresses.clone())
                {
                    let (holder, addresses) = (holder.clone(), addresses.clone());
                    elsewhere.spawn(async move {
                        holder.released(&node).await;
                        addresses
                    });
                }
                found.done(&addresses, verdict, Instant::now(), &mut rng);
            }
            Some(released) = elsewhere.join_next() => {
                let released = released.unwrap_or_default();
                waiting.remove(&released);
                found.forgive(&released);
            }
            () = timer => {}
            () = network.changed() => {
                let now = Instant::now();
                if forgiven.is_none_or(|at| now - at >= FORGIVE_EVERY) {
                    forgiven = Some(now);
                    found.forgive_all();
                }
            }
        }
    }
}

/// Dials what was announced, and keeps the link.
async fn attempt<H: Hold>(addresses: Vec<SocketAddr>, wish: Wish, holder: H, board: Board) -> Done {
    let url = LinkUrl {
        scheme: Scheme::Quic,
        host: addresses.first().map(|first| first.ip().to_string()).unwrap_or_default(),
        port: addresses.first().map_or(0, SocketAddr::port),
        path: None,
        cost_ms: None,
    };
    let line = board.line(&url, "mdns");
    let (_fixed, aim) = watch::channel(Aim { addresses: addresses.clone(), ..Aim::from(url.clone()) });
    let outcome = holder.hold(aim, &wish, &line).await;
    match &outcome {
        Outcome::Ended { remote, end } => info!(%remote, "link ended: {end}"),
        Outcome::Failed(why) => debug!(%url, "a router on the local network: {why}"),
    }
    Done { addresses, outcome }
}

fn judge(outcome: &Outcome) -> Verdict {
    match outcome {
        Outcome::Ended { end, .. } if place_in_use(end).is_some() => Verdict::StandBack,
        Outcome::Ended { .. } => Verdict::Ended,
        // One of another fleet stays one.
        Outcome::Failed(Failure::Dial(why)) if why.is_refusal() => Verdict::StandBack,
        // There will be a place when a link ends, not before.
        Outcome::Failed(Failure::Enough) => Verdict::Failed,
        Outcome::Failed(why) if why.stands_back() => Verdict::StandBack,
        Outcome::Failed(_) => Verdict::Failed,
    }
}
