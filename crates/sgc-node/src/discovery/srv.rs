//! Keeps one link to one router of a domain, in the order of its SRV records (RFC 2782).

use std::collections::BTreeMap;
use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;
use sgc_config::{RouterUrl, SrvDomain};
use sgc_session::{BACKOFF_MAX, Backoff};
use sgc_transport::LinkUrl;
use tokio::sync::watch;
use tokio::time::sleep_until;
use tracing::{info, warn};

use super::srv_answer::{SrvAnswer, SrvTarget, TTL_MIN};
use super::{
    DialTarget, Failure, KeepLink, LinkRequest, Names, Outcome, StatusRow, another_network, pause, take_note,
};
use crate::clock::time_now;

/// Returns the targets in the order of attempts: by priority, and within a priority at random, in proportion to their
/// weights (RFC 2782).
pub(crate) fn in_order(targets: &[SrvTarget], rng: &mut impl RngCore) -> Vec<SrvTarget> {
    let mut rest = targets.to_vec();
    // Weight 0 comes first, so that such targets keep a small chance.
    rest.sort_by_key(|target| (target.priority, target.weight != 0));
    let mut ordered = Vec::with_capacity(rest.len());
    while let Some(first) = rest.first() {
        let priority = first.priority;
        let peers = || rest.iter().take_while(|target| target.priority == priority);
        let total: u64 = peers().map(|target| u64::from(target.weight)).sum();
        // At most 16 weights of 16 bits are summed, so the modulo bias of 64 random bits is negligible.
        let drawn = rng.next_u64() % (total + 1);
        let mut sum = 0;
        let chosen = peers().position(|target| {
            sum += u64::from(target.weight);
            sum >= drawn
        });
        ordered.push(rest.remove(chosen.unwrap_or(0)));
    }
    ordered
}

/// Knowledge about a domain.
struct SrvState {
    /// The last good answer. An old one is better than none.
    answer: Option<SrvAnswer>,
    /// Time of the next question.
    expires: Instant,
    asked: Option<Instant>,
    asking: Backoff,
}

impl SrvState {
    /// Asks DNS and stores the answer.
    async fn ask<N: Names>(
        &mut self,
        domain: &SrvDomain,
        names: &N,
        row: &StatusRow,
        rng: &mut ChaCha20Rng,
    ) -> bool {
        let asked = names.routers(domain).await;
        let now = time_now();
        self.asked = Some(now);
        match asked {
            Ok(answer) => {
                self.asking = Backoff::new(BACKOFF_MAX);
                self.expires = now + answer.ttl;
                self.answer = Some(answer);
                true
            }
            Err(why) => {
                if self.asking.failures() == 0 {
                    warn!("cannot find a router: {why}; asking again until it works");
                }
                row.noted(&why.to_string());
                if why.is_final() {
                    self.answer = None;
                }
                self.asking.failed(now, rng);
                self.expires = self.asking.due().unwrap_or(now);
                false
            }
        }
    }
}

/// Keeps one link to the best reachable router of a domain, and searches again when it ends.
pub(crate) async fn keep_one_of<N: Names, H: KeepLink>(
    domain: SrvDomain,
    names: N,
    keeper: H,
    row: StatusRow,
    mut rng: ChaCha20Rng,
) {
    let mut known =
        SrvState { answer: None, expires: time_now(), asked: None, asking: Backoff::new(BACKOFF_MAX) };
    let mut tried: BTreeMap<LinkUrl, Backoff> = BTreeMap::new();
    let mut network = keeper.network();
    loop {
        if known.expires <= time_now() {
            row.looking_up();
            known.ask(&domain, &names, &row, &mut rng).await;
        }
        let targets = known.answer.as_ref().map(|answer| in_order(&answer.targets, &mut rng));
        let targets = targets.unwrap_or_default();
        tried.retain(|url, _| targets.iter().any(|target| target.url() == *url));
        let mut has_failed = false;
        for target in targets {
            let backoff = tried.entry(target.url()).or_insert_with(|| Backoff::new(BACKOFF_MAX));
            if !backoff.is_due(time_now()) {
                continue;
            }
            let outcome = match dial_target(&target, &names).await {
                Ok(target) => keep_link(&domain, &mut known, target, &names, &keeper, &row, &mut rng).await,
                Err(failure) => Outcome::Failed(failure),
            };
            if keeper.is_over() {
                return;
            }
            take_note(&outcome, backoff, &row, &mut rng);
            match &outcome {
                Outcome::Ended { .. } => break,
                // Another search has a link to a router of the domain.
                Outcome::Failed(Failure::Reached(_)) => {
                    pause(&keeper, &outcome, backoff.due(), &mut network).await;
                    *backoff = Backoff::new(BACKOFF_MAX);
                    break;
                }
                Outcome::Failed(_) => has_failed = true,
            }
        }
        if keeper.is_over() {
            return;
        }
        // DNS may no longer list the failed targets.
        if has_failed && let Some(asked) = known.asked {
            known.expires = known.expires.min(asked + TTL_MIN);
        }
        let next = tried.values().map(|backoff| backoff.due().unwrap_or_else(time_now)).min();
        let next = next.map_or(known.expires, |next| next.min(known.expires));
        row.waits(Some(next), false);
        tokio::select! {
            () = sleep_until(next.into()) => {}
            () = another_network(&mut network) => {
                tried.clear();
                // A good answer stays valid. A missing one says nothing about the new network.
                if known.answer.is_none() {
                    known.expires = time_now();
                }
            }
        }
    }
}

/// Resolves a target.
async fn dial_target<N: Names>(target: &SrvTarget, names: &N) -> Result<DialTarget, Failure> {
    let addresses = names.addresses(&target.host, target.port).await?;
    Ok(DialTarget { addresses, ..DialTarget::from(target.url()) })
}

/// Keeps a link to a target and meanwhile asks DNS whether the target is still listed. If not, the link moves to a
/// listed target. While none can be reached, the link stays.
async fn keep_link<N: Names, H: KeepLink>(
    domain: &SrvDomain,
    known: &mut SrvState,
    first: DialTarget,
    names: &N,
    keeper: &H,
    row: &StatusRow,
    rng: &mut ChaCha20Rng,
) -> Outcome {
    let (move_to, at) = watch::channel(first);
    let refresh = async {
        loop {
            sleep_until(known.expires.into()).await;
            if !known.ask(domain, names, row, rng).await {
                continue;
            }
            let targets =
                known.answer.as_ref().map(|answer| in_order(&answer.targets, rng)).unwrap_or_default();
            let now = move_to.borrow().url.clone();
            if targets.iter().any(|target| target.url() == now) {
                continue;
            }
            for target in targets {
                if let Ok(target) = dial_target(&target, names).await {
                    info!(
                        "{} no longer names {now}; moving to {}",
                        RouterUrl::Srv(domain.clone()),
                        target.url
                    );
                    move_to.send_replace(target);
                    break;
                }
            }
        }
    };
    let request = LinkRequest::default();
    tokio::select! {
        outcome = keeper.keep_link(at, &request, row) => outcome,
        never = refresh => never,
    }
}

#[cfg(test)]
mod tests {
    use rand_core::SeedableRng as _;

    use super::*;

    fn target(priority: u16, weight: u16, host: &str) -> SrvTarget {
        SrvTarget { priority, weight, host: host.into(), port: 7447 }
    }

    fn hosts(targets: &[SrvTarget]) -> String {
        targets.iter().map(|target| target.host.as_str()).collect()
    }

    #[test]
    fn lower_priorities_always_come_first() {
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        let targets = [target(20, 9, "c"), target(10, 0, "a"), target(30, 65535, "d"), target(10, 60, "b")];
        for _ in 0..200 {
            let order = hosts(&in_order(&targets, &mut rng));
            assert!(["abcd", "bacd"].contains(&order.as_str()), "{order}");
        }
        assert_eq!(in_order(&[], &mut rng), []);
    }

    #[test]
    fn weights_are_shares_of_being_first_and_second() {
        let mut rng = ChaCha20Rng::seed_from_u64(2);
        let targets = [target(1, 10, "a"), target(1, 30, "b"), target(1, 60, "c"), target(1, 0, "z")];
        const ROUNDS: u32 = 20_000;
        let mut first: BTreeMap<String, u32> = BTreeMap::new();
        let mut second_after_c: BTreeMap<String, u32> = BTreeMap::new();
        for _ in 0..ROUNDS {
            let order = in_order(&targets, &mut rng);
            assert_eq!(order.len(), 4);
            *first.entry(order[0].host.clone()).or_default() += 1;
            if order[0].host == "c" {
                *second_after_c.entry(order[1].host.clone()).or_default() += 1;
            }
        }
        let share = |counts: &BTreeMap<String, u32>, host: &str| {
            f64::from(counts.get(host).copied().unwrap_or(0)) / f64::from(counts.values().sum::<u32>())
        };
        for (host, expected) in [("a", 0.1), ("b", 0.3), ("c", 0.6)] {
            let found = share(&first, host);
            assert!((found - expected).abs() < 0.02, "{host} is first in {found} of all");
        }
        // The share is small but not zero, as the RFC demands.
        assert!((0.001..0.03).contains(&share(&first, "z")), "{first:?}");
        assert!((share(&second_after_c, "b") - 0.75).abs() < 0.03, "{second_after_c:?}");
    }

    #[test]
    fn same_seed_gives_same_srv_order() {
        let targets: Vec<_> = ["a", "b", "c", "d"].iter().map(|host| target(1, 10, host)).collect();
        let order = |seed| hosts(&in_order(&targets, &mut ChaCha20Rng::seed_from_u64(seed)));
        assert_eq!(order(7), order(7));
        assert!((0..20).any(|seed| order(seed) != order(7)));
    }

    #[test]
    fn greatest_weights_do_not_overflow() {
        let targets: Vec<_> = (0..16).map(|n| target(1, u16::MAX, &format!("h{n}"))).collect();
        assert_eq!(in_order(&targets, &mut ChaCha20Rng::seed_from_u64(3)).len(), 16);
    }

    #[test]
    fn undiallable_srv_record_is_no_target() {
        assert!(target(0, 0, "router.lab.example").is_usable());
        assert!(!SrvTarget { port: 0, ..target(0, 0, "a") }.is_usable());
        for host in ["", "a b", "a\\046b", "a/b", &"a".repeat(254)] {
            assert!(!target(0, 0, host).is_usable(), "{host}");
        }
    }
}
