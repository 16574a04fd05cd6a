//! Finding routers and keeping links to them: one link for each named router, one for each domain of DNS, and a few on
//! the local network.
//!
//! Each kind of search is a loop that yields dial targets (`keep_at`, `srv`, `mdns`). [`link_keeper::LinkKeeper`]
//! dials, and `kept_link` keeps the link. The loops are generic over [`KeepLink`], so tests run their timing on a
//! virtual clock.

pub(crate) mod board;
mod claims;
mod dns;
mod kept_link;
mod link_keeper;
mod local;
mod mdns;
mod searches;
mod srv;
mod srv_answer;
mod target;
mod urls;

use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use sgc_session::{BACKOFF_MAX, BACKOFF_MIN, Backoff};
use tokio::sync::watch;
use tokio::time::sleep_until;
use tracing::{debug, info, warn};

pub use board::RouterStatus;
pub(crate) use board::{Board, StatusRow};
pub(crate) use claims::{Claim, Claims};
pub(crate) use dns::{Dns, Names};
pub(crate) use link_keeper::{DialledLink, Failure, KeepLink, LinkKeeper, LinkRequest, Outcome};
pub(crate) use local::LocalNetwork;
pub(crate) use mdns::RouterFilter;
pub(crate) use searches::{Searches, WantedRouters};
pub(crate) use target::DialTarget;
pub(crate) use urls::{SkippedUrl, WorkingUrls, is_over_udp};

use crate::clock::time_now;
use crate::link::in_use::place_in_use;
use crate::link::roaming::Network;

/// Keeps a link to one router: dials, and dials again with jittered back-off whenever the link ends.
pub(crate) async fn keep_at<H: KeepLink>(
    target: impl Into<DialTarget>,
    keeper: H,
    row: StatusRow,
    mut rng: ChaCha20Rng,
) {
    let (_fixed, target) = watch::channel(target.into());
    let mut backoff = Backoff::new(BACKOFF_MAX);
    let mut network = keeper.network();
    loop {
        let outcome = keeper.keep_link(target.clone(), &LinkRequest::default(), &row).await;
        if keeper.is_over() {
            return;
        }
        take_note(&outcome, &mut backoff, &row, &mut rng);
        if pause(&keeper, &outcome, backoff.due(), &mut network).await == Pause::Cut {
            backoff = Backoff::new(BACKOFF_MAX);
        }
    }
}

/// Applies the result of an attempt to the back-off and to the status row.
fn take_note(outcome: &Outcome, backoff: &mut Backoff, row: &StatusRow, rng: &mut ChaCha20Rng) {
    let now = time_now();
    match outcome {
        Outcome::Ended { remote, end } if place_in_use(end).is_some() => {
            // The control task logs this once, in words for the operator.
            debug!(%remote, "the link ended: {end}");
            row.ended(&end.to_string());
            backoff.displaced(now, rng);
        }
        Outcome::Ended { remote, end } => {
            debug!(%remote, "the link ended: {end}");
            row.ended(&end.to_string());
            backoff.ended(now, rng);
        }
        Outcome::Failed(why) if why.stands_back() => {
            // Another link exists in its place, or no link can be made.
            info!("{why}; trying again in some minutes");
            row.noted(&why.to_string());
            backoff.stand_back(now, rng);
        }
        Outcome::Failed(why) => {
            // Only the first failure in a row is news.
            if backoff.failures() == 0 {
                warn!("cannot connect: {why}; trying again until it works");
            } else {
                debug!("cannot connect: {why}");
            }
            row.failed(&why.to_string());
            backoff.failed(now, rng);
        }
    }
    let stands_back = match outcome {
        Outcome::Failed(why) => why.stands_back(),
        Outcome::Ended { end, .. } => place_in_use(end).is_some(),
    };
    row.waits(backoff.due(), stands_back);
}

/// How a pause ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pause {
    /// The time is over.
    Over,
    /// The network changed, so a failed attempt may succeed now.
    Cut,
}

/// Waits until `due`, until the link that displaced this attempt ends, or until the network changes.
async fn pause<H: KeepLink>(
    keeper: &H,
    outcome: &Outcome,
    due: Option<Instant>,
    network: &mut Network,
) -> Pause {
    let due = due.unwrap_or_else(time_now);
    let released = async {
        match outcome {
            Outcome::Failed(Failure::Reached(node)) => keeper.released(node).await,
            _ => std::future::pending().await,
        }
    };
    tokio::select! {
        () = sleep_until(due.into()) => Pause::Over,
        () = released => Pause::Over,
        () = another_network(network) => Pause::Cut,
    }
}

/// Waits until the network changes. It takes at least [`BACKOFF_MIN`], so that a flapping network causes no burst of
/// attempts.
async fn another_network(network: &mut Network) {
    let least = time_now() + BACKOFF_MIN;
    network.changed().await;
    sleep_until(least.into()).await;
}

#[cfg(test)]
mod tests;
