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

use std::net::SocketAddr;
use std::sync::Arc;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_transport::LinkUrl;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep_until};
use tracing::{debug, info, warn};

pub(crate) use backoff::{BACKOFF_MAX, Backoff, wait};
pub use board::RouterStatus;
pub(crate) use board::{Board, Line};
pub(crate) use claims::{Claim, Claims};
pub(crate) use dns::{Dns, Names};
pub(crate) use hold::{Failure, Hold, Holder, Outcome, Wish};
pub(crate) use local::LocalNetwork;
pub(crate) use mdns::Wanted;

use crate::config::RouterUrl;

/// Somewhere to dial.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Aim {
    /// How it is called.
    pub(crate) url: LinkUrl,
    /// Its addresses, where they are known; if there are none the host is looked up.
    pub(crate) addresses: Vec<SocketAddr>,
}

impl From<LinkUrl> for Aim {
    fn from(url: LinkUrl) -> Self {
        Self { url, addresses: Vec::new() }
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
    let configured = configured.iter().map(|url| (url, "static"));
    for (url, by) in configured.chain(of_tokens.iter().map(|url| (url, "token"))) {
        let (holder, rng) = (holder.clone(), ChaCha20Rng::from_rng(rng));
        match url {
            RouterUrl::At(url) => {
                let line = board.line(url, by);
                tasks.push(tokio::spawn(keep_at(url.clone(), holder, line, rng)));
            }
            RouterUrl::Srv(domain) => {
                let line = board.line(url, "srv");
                let dns = holder.dns.clone();
                tasks.push(tokio::spawn(srv::keep_one_of(domain.clone(), dns, holder, line, rng)));
            }
            // Together, below.
            RouterUrl::Mdns(_) => {}
        }
    }
    if let Some((local, wanted)) = local {
        let (holder, rng) = (holder.clone(), ChaCha20Rng::from_rng(rng));
        tasks.push(tokio::spawn(mdns::keep_some(local, wanted, holder, board.clone(), rng)));
    }
    tasks
}

/// Keeps a link to one router: dials, and dials again with patience and jitter whenever the link ends.
pub(crate) async fn keep_at<H: Hold>(url: LinkUrl, holder: H, line: Line, mut rng: ChaCha20Rng) {
    let (_fixed, aim) = watch::channel(Aim::from(url));
    let mut backoff = Backoff::new(BACKOFF_MAX);
    loop {
        let outcome = holder.hold(aim.clone(), &Wish::default(), &line).await;
        if holder.is_over() {
            return;
        }
        take_note(&outcome, &mut backoff, &line, &mut rng);
        pause(&holder, &outcome, backoff.due()).await;
    }
}

/// What an attempt comes to for the next one.
fn take_note(outcome: &Outcome, backoff: &mut Backoff, line: &Line, rng: &mut ChaCha20Rng) {
    let now = Instant::now();
    match outcome {
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
    let stands_back = matches!(outcome, Outcome::Failed(why) if why.stands_back());
    line.waits(backoff.due(), stands_back);
}

/// Waits until `due`, or until nobody else has the router that another way led to.
async fn pause<H: Hold>(holder: &H, outcome: &Outcome, due: Option<Instant>) {
    let due = due.unwrap_or_else(Instant::now);
    match outcome {
        Outcome::Failed(Failure::Reached(node)) => tokio::select! {
            () = sleep_until(due) => {}
            () = holder.released(node) => {}
        },
        _ => sleep_until(due).await,
    }
}

#[cfg(test)]
mod tests;
