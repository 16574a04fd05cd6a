//! Candidates: decides which announcements on the local network are worth dialling, and when.
//!
//! Anybody on the local network can announce anything. So all tables are bounded, back-off is kept per address whatever
//! name announces it, and an announcement never ends a link. This module dials nothing.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;

use crate::Backoff;

/// Most announcements that are remembered at once.
pub const CANDIDATES_MAX: usize = 32;
/// Most addresses of one announcement.
pub const ADDRESSES_MAX: usize = 8;
/// Most addresses whose failures are remembered.
const TRIED_MAX: usize = 256;
/// The longest wait for an announced address.
const BACKOFF_MAX: Duration = Duration::from_secs(60);

/// The routers that are announced now.
#[derive(Debug, Default)]
pub struct Candidates {
    known: BTreeMap<String, Vec<SocketAddr>>,
    /// Back-off of each address. It outlives the announcement, since each new announcement would otherwise reset it.
    tried: BTreeMap<SocketAddr, Backoff>,
    /// Addresses that are being dialled or linked.
    busy: BTreeSet<SocketAddr>,
}

/// Result of an attempt at a candidate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AttemptResult {
    /// A link was up, and ended.
    Ended,
    /// The attempt failed.
    Failed,
    /// An early attempt cannot succeed.
    StandBack,
}

/// Returns `true` for an address and port that one host can have.
pub fn is_of_host(address: &SocketAddr) -> bool {
    let ip = address.ip();
    let broadcast = matches!(ip, IpAddr::V4(v4) if v4.is_broadcast());
    address.port() != 0 && !ip.is_unspecified() && !ip.is_multicast() && !broadcast
}

impl Candidates {
    /// Adds an announced router or its new addresses. Returns `false` if there is no room.
    pub fn announced(&mut self, instance: &str, addresses: impl IntoIterator<Item = SocketAddr>) -> bool {
        let addresses: BTreeSet<_> = addresses.into_iter().filter(is_of_host).collect();
        let addresses: Vec<_> = addresses.into_iter().take(ADDRESSES_MAX).collect();
        if addresses.is_empty() {
            self.known.remove(instance);
            return true;
        }
        if !self.known.contains_key(instance) && self.known.len() >= CANDIDATES_MAX && !self.make_room() {
            return false;
        }
        self.known.insert(instance.to_owned(), addresses);
        true
    }

    /// Removes an announcement. A link to the router stays as long as it works.
    pub fn vanished(&mut self, instance: &str) {
        self.known.remove(instance);
    }

    /// Drops the announcement with the most failures, if any has failed.
    fn make_room(&mut self) -> bool {
        let worst = self.known.iter().filter(|(_, addresses)| !self.is_busy(addresses));
        let worst = worst.map(|(instance, addresses)| (self.failures(addresses), instance)).max();
        match worst {
            Some((failures, instance)) if failures > 0 => {
                let instance = instance.clone();
                self.known.remove(&instance).is_some()
            }
            _ => false,
        }
    }

    /// Returns the due candidate with the fewest failures. It is busy until [`Candidates::done`].
    pub fn next(&mut self, now: Instant) -> Option<Vec<SocketAddr>> {
        let due = |addresses: &&Vec<SocketAddr>| !self.is_busy(addresses) && self.due(addresses) <= Some(now);
        let best = self.known.values().filter(due).min_by_key(|addresses| self.failures(addresses))?;
        let is_due = |address: &&SocketAddr| self.tried.get(*address).is_none_or(|tried| tried.is_due(now));
        let addresses: Vec<_> = best.iter().filter(is_due).copied().collect();
        self.busy.extend(&addresses);
        Some(addresses)
    }

    /// Returns the time at which the next candidate becomes due.
    pub fn next_due(&self, now: Instant) -> Option<Instant> {
        let idle = self.known.values().filter(|addresses| !self.is_busy(addresses));
        idle.map(|addresses| self.due(addresses).unwrap_or(now)).min()
    }

    /// Records the result of an attempt and schedules the next.
    pub fn done(
        &mut self,
        addresses: &[SocketAddr],
        verdict: AttemptResult,
        now: Instant,
        rng: &mut ChaCha20Rng,
    ) {
        for address in addresses {
            self.busy.remove(address);
            if !self.tried.contains_key(address) && self.tried.len() >= TRIED_MAX {
                // The entry that is due soonest loses the least.
                let soonest = self.tried.iter().min_by_key(|(_, tried)| tried.due()).map(|(a, _)| *a);
                soonest.map(|soonest| self.tried.remove(&soonest));
            }
            let tried = self.tried.entry(*address).or_insert_with(|| Backoff::new(BACKOFF_MAX));
            match verdict {
                AttemptResult::Ended => tried.ended(now, rng),
                AttemptResult::Failed => tried.failed(now, rng),
                AttemptResult::StandBack => tried.stand_back(now, rng),
            }
        }
    }

    /// Makes addresses due again, because the reason to stand back is gone.
    pub fn forgive(&mut self, addresses: &[SocketAddr]) {
        for address in addresses {
            self.tried.remove(address);
        }
    }

    /// Makes all addresses due again, because the network changed.
    pub fn forgive_all(&mut self) {
        self.tried.clear();
    }

    /// Returns the number of announcements.
    #[cfg(test)]
    fn len(&self) -> usize {
        self.known.len()
    }

    fn is_busy(&self, addresses: &[SocketAddr]) -> bool {
        addresses.iter().any(|address| self.busy.contains(address))
    }

    /// Returns when the first of these addresses is due; `None` means at once.
    fn due(&self, addresses: &[SocketAddr]) -> Option<Instant> {
        addresses.iter().map(|address| self.tried.get(address).and_then(Backoff::due)).min().flatten()
    }

    fn failures(&self, addresses: &[SocketAddr]) -> u32 {
        let of = |address| self.tried.get(address).map_or(0, Backoff::failures);
        addresses.iter().map(of).min().unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    fn at(n: u8) -> SocketAddr {
        SocketAddr::from(([10, 0, 0, n], 7447))
    }

    fn start() -> (Candidates, ChaCha20Rng, Instant) {
        (Candidates::default(), ChaCha20Rng::seed_from_u64(1), Instant::now())
    }

    #[test]
    fn announced_router_is_dialled_once_and_forgotten_when_it_vanishes() {
        let (mut found, mut rng, now) = start();
        assert!(found.announced("a", [at(1)]));
        assert_eq!(found.next(now), Some(vec![at(1)]));
        assert_eq!(found.next(now), None);
        // A repeated announcement, even under another name, does not make a busy address due.
        assert!(found.announced("a", [at(1)]) && found.announced("b", [at(1)]));
        assert_eq!((found.next(now), found.next_due(now)), (None, None));
        found.vanished("b");
        found.done(&[at(1)], AttemptResult::Ended, now, &mut rng);
        assert_eq!(found.next(now), None);
        let soon = now + Duration::from_millis(250);
        assert!(found.next_due(now).unwrap() <= soon);
        assert_eq!(found.next(soon), Some(vec![at(1)]));
        found.done(&[at(1)], AttemptResult::Ended, soon, &mut rng);
        found.vanished("a");
        assert_eq!((found.next(now + BACKOFF_MAX), found.len()), (None, 0));
    }

    #[test]
    fn patience_with_an_address_outlives_its_announcements() {
        let (mut found, mut rng, mut now) = start();
        let mut attempts = 0;
        let end = now + Duration::from_secs(600);
        while now < end {
            // An attacker announces one address under ever new names and withdraws the old ones.
            let name = format!("liar {attempts}");
            found.announced(&name, [at(1)]);
            if let Some(addresses) = found.next(now) {
                attempts += 1;
                found.done(&addresses, AttemptResult::Failed, now, &mut rng);
            }
            found.vanished(&name);
            now += Duration::from_millis(100);
        }
        // Ten doubling waits, then one every 30 to 60 seconds.
        assert!((15..35).contains(&attempts), "{attempts}");
    }

    #[test]
    fn a_flood_leaves_room_for_those_that_did_not_fail() {
        let (mut found, mut rng, now) = start();
        for n in 0..=255 {
            assert_eq!(found.announced(&format!("liar {n}"), [at(n)]), usize::from(n) < CANDIDATES_MAX);
        }
        assert_eq!(found.len(), CANDIDATES_MAX);
        assert!(!found.announced("router", [SocketAddr::from(([10, 0, 1, 1], 7447))]));
        let failed = found.next(now).unwrap();
        found.done(&failed, AttemptResult::Failed, now, &mut rng);
        assert!(found.announced("router", [SocketAddr::from(([10, 0, 1, 1], 7447))]));
        assert_eq!(found.len(), CANDIDATES_MAX);
    }

    #[test]
    fn memory_of_failures_is_bounded() {
        let (mut found, mut rng, now) = start();
        for n in 0..1000u16 {
            let address = SocketAddr::from(([10, 0, 0, 1], n + 1));
            found.done(&[address], AttemptResult::Failed, now, &mut rng);
        }
        assert_eq!(found.tried.len(), TRIED_MAX);
    }

    #[test]
    fn only_what_can_be_dialled_counts() {
        let (mut found, _, now) = start();
        let addresses =
            ["0.0.0.0:1", "224.0.0.251:1", "255.255.255.255:1", "10.0.0.1:0", "[::]:1", "[ff02::fb]:1"];
        assert!(found.announced("a", addresses.map(|a| a.parse().unwrap())));
        assert_eq!((found.len(), found.next(now)), (0, None));
        assert!(found.announced("a", (0..=255).map(at)));
        assert_eq!(found.next(now).unwrap().len(), ADDRESSES_MAX);
    }

    #[test]
    fn candidate_that_stood_back_returns_after_forgiveness() {
        let (mut found, mut rng, now) = start();
        found.announced("a", [at(1), at(2)]);
        let addresses = found.next(now).unwrap();
        found.done(&addresses, AttemptResult::StandBack, now, &mut rng);
        assert_eq!(found.next(now + Duration::from_secs(60)), None);
        found.forgive(&addresses);
        assert_eq!(found.next(now), Some(addresses));
    }
}
