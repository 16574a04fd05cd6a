//! Finding routers and keeping links to them: each named one, one of each set that DNS names, some of those that the
//! local network tells of.
//!
//! Each way of finding is a loop that says where to dial (`fixed`, `srv`, `mdns`); [`hold::Holder`] dials and keeps the
//! link. Loops are generic over that, so their timing is tested on a clock that stands still.

mod backoff;
mod board;
mod candidates;
mod claims;
mod dns;
mod hold;
mod local;
mod mdns;
mod srv;
mod ways;

use std::net::SocketAddr;
use std::sync::Arc;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_transport::LinkUrl;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info, warn};

use backoff::BACKOFF_MIN;
pub(crate) use backoff::{BACKOFF_MAX, Backoff, doubled, wait};
pub use board::RouterStatus;
pub(crate) use board::{Board, Line};
pub(crate) use claims::{Claim, Claims};
pub(crate) use dns::{Dns, Names};
pub(crate) use hold::{Dialled, Failure, Hold, Holder, Outcome, Wish};
pub(crate) use local::LocalNetwork;
pub(crate) use mdns::Wanted;
pub(crate) use ways::{Climb, Passed, WayBook, is_over_udp};

use crate::config::RouterUrl;
use crate::links::place_in_use;
use crate::roaming::Network;

/// Somewhere to dial.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Aim {
    /// How it is called.
    pub(crate) url: LinkUrl,
    /// Its addresses, where they are known; if there are none the host is looked up.
    pub(crate) addresses: Vec<SocketAddr>,
    /// Where there are several ways to the router, all of them, the best first; `url` is that one.
    pub(crate) ways: Vec<LinkUrl>,
}

impl Aim {
    /// A router with these ways, the best first; nothing if there are none.
    pub(crate) fn by(ways: Vec<LinkUrl>) -> Option<Self> {
        let url = ways.first()?.clone();
        Some(Self { ways, ..Self::from(url) })
    }

    /// Every way, the best first.
    pub(crate) fn ways(&self) -> &[LinkUrl] {
        if self.ways.is_empty() { std::slice::from_ref(&self.url) } else { &self.ways }
    }

    /// The ways that are better than this one; none if it is not one of them.
    pub(crate) fn better_than(&self, way: &LinkUrl) -> &[LinkUrl] {
        let rank = self.ways().iter().position(|other| other == way);
        &self.ways()[..rank.unwrap_or(0)]
    }
}

impl From<LinkUrl> for Aim {
    fn from(url: LinkUrl) -> Self {
        Self { url, addresses: Vec::new(), ways: Vec::new() }
    }
}

/// Starts to look for these routers: those of the configuration, and those that tokens name. `local` is where the local
/// network is heard, and whom of it this node wants.
pub(crate) fn start(
    configured: &[RouterUrl],
    of_tokens: &[RouterUrl],
    holder: &Holder,
    board: &Board,
    local: Option<(Arc<LocalNetwork>, Wanted)>,
    rng: &mut ChaCha20Rng,
) -> Vec<JoinHandle<()>> {
    let mut tasks = Vec::new();
    for (urls, by) in [(configured, "static"), (of_tokens, "token")] {
        for ways in ways::routers(urls) {
            let (holder, rng) = (holder.clone(), ChaCha20Rng::from_rng(rng));
            let Some(aim) = Aim::by(ways) else { continue };
            let written = RouterUrl::by(aim.ways());
            tasks.push(tokio::spawn(keep_at(aim, holder, board.line(written, by), rng)));
        }
    }
    for url in configured.iter().chain(of_tokens) {
        // Those of the local network together, below.
        let RouterUrl::Srv(domain) = url else { continue };
        let (holder, rng) = (holder.clone(), ChaCha20Rng::from_rng(rng));
        let (line, dns) = (board.line(url, "srv"), holder.dns.clone());
        tasks.push(tokio::spawn(srv::keep_one_of(domain.clone(), dns, holder, line, rng)));
    }
    if let Some((local, wanted)) = local {
        let (holder, rng) = (holder.clone(), ChaCha20Rng::from_rng(rng));
        tasks.push(tokio::spawn(mdns::keep_some(local, wanted, holder, board.clone(), rng)));
    }
    tasks
}

/// Keeps a link to one router: dials, and dials again with patience and jitter whenever the link ends.
pub(crate) async fn keep_at<H: Hold>(aim: impl Into<Aim>, holder: H, line: Line, mut rng: ChaCha20Rng) {
    let (_fixed, aim) = watch::channel(aim.into());
    let mut backoff = Backoff::new(BACKOFF_MAX);
    let mut network = holder.network();
    loop {
        let outcome = holder.hold(aim.clone(), &Wish::default(), &line).await;
        if holder.is_over() {
            return;
        }
        take_note(&outcome, &mut backoff, &line, &mut rng);
        if pause(&holder, &outcome, backoff.due(), &mut network).await == Pause::Cut {
            backoff = Backoff::new(BACKOFF_MAX);
        }
    }
}

/// What an attempt comes to for the next one.
fn take_note(outcome: &Outcome, backoff: &mut Backoff, line: &Line, rng: &mut ChaCha20Rng) {
    let now = Instant::now();
    match outcome {
        Outcome::Ended { remote, end } if place_in_use(end).is_some() => {
            // The control task says so once, in words for the operator.
            info!(%remote, "link ended: {end}");
            line.ended(&end.to_string());
            backoff.displaced(now, rng);
        }
        Outcome::Ended { remote, end } => {
            info!(%remote, "link ended: {end}");
            line.ended(&end.to_string());
            backoff.ended(now, rng);
        }
        Outcome::Failed(why) if why.stands_back() => {
            // In its place there is a link, or there can be none.
            info!("{why}; trying again in some minutes");
            line.noted(&why.to_string());
            backoff.stand_back(now, rng);
        }
        Outcome::Failed(why) => {
            // The first failure is news, the tenth is not.
            if backoff.failures() == 0 {
                warn!("cannot connect: {why}; trying again until it works");
            } else {
                debug!("cannot connect: {why}");
            }
            line.failed(&why.to_string());
            backoff.failed(now, rng);
        }
    }
    let stands_back = match outcome {
        Outcome::Failed(why) => why.stands_back(),
        Outcome::Ended { end, .. } => place_in_use(end).is_some(),
    };
    line.waits(backoff.due(), stands_back);
}

/// How a pause ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pause {
    /// As it was to.
    Over,
    /// By a change of the network, after which what failed before may work.
    Cut,
}

/// Waits until `due`, until nobody else has the router that another way led to, or until the network is another.
async fn pause<H: Hold>(holder: &H, outcome: &Outcome, due: Option<Instant>, network: &mut Network) -> Pause {
    let due = due.unwrap_or_else(Instant::now);
    let released = async {
        match outcome {
            Outcome::Failed(Failure::Reached(node)) => holder.released(node).await,
            _ => std::future::pending().await,
        }
    };
    tokio::select! {
        () = sleep_until(due) => Pause::Over,
        () = released => Pause::Over,
        () = another_network(network) => Pause::Cut,
    }
}

/// Waits until the network is another. A network that never rests cannot have attempts follow at once on each other.
async fn another_network(network: &mut Network) {
    let least = Instant::now() + BACKOFF_MIN;
    network.changed().await;
    sleep_until(least).await;
}

#[cfg(test)]
mod tests;
