//! Rate limit of each peer: one bucket per node id, whatever number of links it has.
//!
//! Packets that can wait are delayed, so that the transport slows the peer; others are dropped. The packet path takes
//! no lock, and does nothing without a limit. The router machine limits control frames.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use sgc_sync::lock;
use sgc_wire::NodeId;
use tracing::warn;

use crate::drops::NodeDrop;
use crate::state::audit::PeerNames;

/// Time's worth of rate that a peer may save up, at least [`BURST_BYTES_MIN`].
const BURST: Duration = Duration::from_millis(250);
/// Room for several of the longest packets.
const BURST_BYTES_MIN: u64 = 256 << 10;
/// Most peers without a link that are remembered until they have paid for their traffic. Beyond it, one is forgotten.
const PEERS_MAX: usize = 4096;

/// The buckets of all peers.
#[derive(Debug)]
pub(crate) struct PeerRates {
    limit: Arc<Limit>,
    names: PeerNames,
    /// Buckets by peer. They are looked up when a link begins and for the status.
    peers: Mutex<BTreeMap<NodeId, Arc<PeerRate>>>,
    /// Packets dropped of forgotten peers.
    gone: AtomicU64,
}

/// The limit of all peers, which a reload changes.
#[derive(Debug)]
struct Limit {
    /// Bits a second; 0 if there is no limit.
    bits_per_second: AtomicU64,
    /// Origin of the nanosecond clock.
    origin: Instant,
}

impl Default for PeerRates {
    fn default() -> Self {
        Self::new(None, PeerNames::default())
    }
}

impl PeerRates {
    /// Creates buckets with the same limit for every peer, in bits a second.
    pub(crate) fn new(limit: Option<u64>, names: PeerNames) -> Self {
        let bits_per_second = AtomicU64::new(limit.unwrap_or(0));
        let limit = Arc::new(Limit { bits_per_second, origin: Instant::now() });
        Self { limit, names, peers: Mutex::default(), gone: AtomicU64::new(0) }
    }

    /// Sets the limit, in bits a second, for the links that are up, too.
    pub(crate) fn set_limit(&self, limit: Option<u64>) {
        self.limit.bits_per_second.store(limit.unwrap_or(0), Relaxed);
    }

    /// Returns the bucket of a peer with a link. It outlives the link until the traffic is paid for, so that
    /// reconnecting gains nothing.
    pub(crate) fn for_peer(&self, peer: NodeId) -> Arc<PeerRate> {
        self.for_peer_at(self.limit.now(), peer)
    }

    fn for_peer_at(&self, now: u64, peer: NodeId) -> Arc<PeerRate> {
        let mut peers = lock(&self.peers);
        peers.retain(|id, rate| {
            let stays = *id == peer || Arc::strong_count(rate) > 1 || !rate.is_paid(now);
            self.gone.fetch_add(if stays { 0 } else { rate.over().dropped }, Relaxed);
            stays
        });
        let idle = |rate: &Arc<PeerRate>| Arc::strong_count(rate) == 1;
        if peers.len() >= PEERS_MAX
            && let Some(one) = peers.iter().find(|(id, rate)| **id != peer && idle(rate)).map(|(id, _)| *id)
            && let Some(rate) = peers.remove(&one)
        {
            self.gone.fetch_add(rate.over().dropped, Relaxed);
        }
        let new = || Arc::new(PeerRate::new(peer, self.names.clone(), self.limit.clone()));
        peers.entry(peer).or_insert_with(new).clone()
    }

    /// Returns the counts of delayed and dropped packets of a peer.
    pub(crate) fn over(&self, peer: &NodeId) -> Over {
        let peers = lock(&self.peers);
        peers.get(peer).map(|rate| rate.over()).unwrap_or_default()
    }

    /// Returns the drops of all peers, and of each peer with a link.
    pub(crate) fn drops(&self) -> BTreeMap<String, u64> {
        let peers = lock(&self.peers);
        let key = NodeDrop::OverRate.key();
        let (mut drops, mut all) = (BTreeMap::new(), self.gone.load(Relaxed));
        for (peer, rate) in peers.iter() {
            let dropped = rate.over().dropped;
            all += dropped;
            if dropped > 0 && Arc::strong_count(rate) > 1 {
                drops.insert(format!("{key} from {}", self.names.called(peer)), dropped);
            }
        }
        drops.extend((all > 0).then(|| (key.to_owned(), all)));
        drops
    }
}

impl Limit {
    fn now(&self) -> u64 {
        nanos(self.origin.elapsed())
    }

    /// Returns the present limit; `None` if there is none.
    fn rate(&self) -> Option<Rate> {
        Some(Rate { bits_per_second: self.bits_per_second.load(Relaxed) })
            .filter(|rate| rate.bits_per_second > 0)
    }
}

/// A limit at one moment.
#[derive(Clone, Copy)]
struct Rate {
    bits_per_second: u64,
}

impl Rate {
    /// Returns the time in which a peer earns this many bytes.
    fn cost_ns(self, bytes: u64) -> u64 {
        let ns = u128::from(bytes) * 8_000_000_000 / u128::from(self.bits_per_second.max(1));
        ns.try_into().unwrap_or(u64::MAX)
    }

    /// Returns the time that a peer may have earned in advance.
    fn burst_ns(self) -> u64 {
        nanos(BURST).max(self.cost_ns(BURST_BYTES_MIN))
    }
}

fn nanos(time: Duration) -> u64 {
    time.as_nanos().try_into().unwrap_or(u64::MAX)
}

/// Packets of a peer beyond its rate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Over {
    /// Delayed packets.
    pub slowed: u64,
    /// Dropped packets.
    pub dropped: u64,
}

/// The bucket of one peer: the time at which all received traffic is paid for (generic cell rate algorithm).
#[derive(Debug)]
pub(crate) struct PeerRate {
    peer: NodeId,
    names: PeerNames,
    limit: Arc<Limit>,
    /// Time at which all packets are paid for.
    all_ns: AtomicU64,
    /// Time at which the packets that cannot wait are paid for. They precede the others within the same rate.
    hasty_ns: AtomicU64,
    slowed: AtomicU64,
    dropped: AtomicU64,
    is_named: AtomicBool,
}

impl PeerRate {
    fn new(peer: NodeId, names: PeerNames, limit: Arc<Limit>) -> Self {
        Self {
            peer,
            names,
            limit,
            all_ns: AtomicU64::new(0),
            hasty_ns: AtomicU64::new(0),
            slowed: AtomicU64::new(0),
            dropped: AtomicU64::new(0),
            is_named: AtomicBool::new(false),
        }
    }

    /// Takes bytes that cannot wait. Returns `false` if they must be dropped, which is counted.
    pub(crate) fn take_now(&self, bytes: usize) -> bool {
        self.limit.rate().is_none_or(|rate| self.take_now_at(rate, self.limit.now(), bytes))
    }

    /// Takes bytes that can wait. Returns the delay.
    pub(crate) fn take_later(&self, bytes: usize) -> Duration {
        self.limit.rate().map_or(Duration::ZERO, |rate| self.take_later_at(rate, self.limit.now(), bytes))
    }

    fn take_now_at(&self, rate: Rate, now: u64, bytes: usize) -> bool {
        let cost = rate.cost_ns(bytes as u64);
        let most = now.saturating_add(rate.burst_ns());
        let after = |paid: u64| Some(paid.max(now).saturating_add(cost)).filter(|after| *after <= most);
        if self.hasty_ns.fetch_update(Relaxed, Relaxed, after).is_err() {
            self.dropped.fetch_add(1, Relaxed);
            self.name_it("what cannot wait is dropped");
            return false;
        }
        self.charge(now, cost);
        true
    }

    fn take_later_at(&self, rate: Rate, now: u64, bytes: usize) -> Duration {
        let paid = self.charge(now, rate.cost_ns(bytes as u64));
        let wait = Duration::from_nanos(paid.saturating_sub(now.saturating_add(rate.burst_ns())));
        if !wait.is_zero() {
            self.slowed.fetch_add(1, Relaxed);
            self.name_it("what can wait is slowed");
        }
        wait
    }

    /// Charges a cost. Returns the time at which everything is paid for, this included.
    fn charge(&self, now: u64, cost: u64) -> u64 {
        let after = |paid: u64| paid.max(now).saturating_add(cost);
        // This cannot fail, since the closure always returns a value.
        let before = self.all_ns.fetch_update(Relaxed, Relaxed, |paid| Some(after(paid)));
        after(before.unwrap_or_else(|paid| paid))
    }

    fn is_paid(&self, now: u64) -> bool {
        self.all_ns.load(Relaxed) <= now
    }

    fn over(&self) -> Over {
        Over { slowed: self.slowed.load(Relaxed), dropped: self.dropped.load(Relaxed) }
    }

    fn name_it(&self, what: &str) {
        if !self.is_named.swap(true, Relaxed) {
            warn!(
                peer = self.names.called(&self.peer),
                "a peer sends more than `peer_rate` lets it: {what}, and counted from here on"
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PACKET: usize = 1000;
    const SECOND: u64 = 1_000_000_000;

    /// 8 Mbit/s: one packet a millisecond, and 262 144 bytes at once.
    const RATE: Rate = Rate { bits_per_second: 8_000_000 };

    fn rate() -> Arc<PeerRate> {
        PeerRates::default().for_peer(NodeId([1; 32]))
    }

    #[test]
    fn packets_that_cannot_wait_pass_at_most_at_the_peer_rate() {
        let rate = rate();
        let passed = |now| (0..2000).filter(|_| rate.take_now_at(RATE, now, PACKET)).count();
        assert_eq!(passed(0), 262);
        assert_eq!(passed(SECOND / 10), 100);
        // Savings are bounded.
        assert_eq!(passed(100 * SECOND), 262);
        assert_eq!(rate.over(), Over { slowed: 0, dropped: 3 * 2000 - 262 - 100 - 262 });
    }

    #[test]
    fn packets_that_can_wait_use_the_remaining_rate() {
        let rate = rate();
        let mut now = 0;
        let mut hasty = 0;
        for _ in 0..4000 {
            now += nanos(rate.take_later_at(RATE, now, PACKET));
            // These use half of the rate.
            while hasty < now / 2_000_000 {
                assert!(rate.take_now_at(RATE, now, PACKET));
                hasty += 1;
            }
        }
        let seconds = now as f64 / SECOND as f64;
        let all = (4000 + hasty) as f64;
        assert!((all - 262.0 - seconds * 1000.0).abs() < 10.0, "{all} in {seconds} s");
        assert!(rate.over().slowed > 3000 && rate.over().dropped == 0);
        // The delayed packets do not keep the others from passing.
        for _ in 0..10_000 {
            rate.take_later_at(RATE, now, PACKET);
        }
        assert!(rate.take_later_at(RATE, now, PACKET) > Duration::from_secs(9));
        assert!(rate.take_now_at(RATE, now, PACKET));
    }

    #[test]
    fn linking_again_gains_nothing() {
        let rates = PeerRates::default();
        let of = |now, id| rates.for_peer_at(now, NodeId([id; 32]));
        let first = of(0, 1);
        assert!(Arc::ptr_eq(&first, &of(0, 1)));
        while first.take_now_at(RATE, 0, PACKET) {}
        drop(first);
        assert!(of(SECOND / 10, 2).take_now_at(RATE, SECOND / 10, 200 * PACKET));
        assert!(!of(SECOND / 10, 1).take_now_at(RATE, SECOND / 10, 200 * PACKET));
        assert_eq!((rates.drops()["over_rate"], rates.over(&NodeId([1; 32])).dropped), (2, 2));
        // A peer that has paid is forgotten.
        assert!(of(SECOND, 3).take_now_at(RATE, SECOND, PACKET));
        assert_eq!(
            rates.drops(),
            BTreeMap::from([("over_rate".to_owned(), 2)]),
            "and its drops are in the total"
        );
    }

    #[test]
    fn another_limit_holds_for_links_that_are_up() {
        let rates = PeerRates::new(None, PeerNames::default());
        let rate = rates.for_peer(NodeId([1; 32]));
        let passed = || (0..2000).filter(|_| rate.take_now(PACKET)).count();
        assert_eq!(passed(), 2000);
        assert!((0..2000).all(|_| rate.take_later(PACKET).is_zero()));
        // A day a packet, after the first 262 144 bytes.
        rates.set_limit(Some(1));
        assert_eq!(passed(), 262);
        assert!(rate.take_later(PACKET) > Duration::from_secs(1000));
        rates.set_limit(None);
        assert_eq!(passed(), 2000);
        assert_eq!(rate.over(), Over { slowed: 1, dropped: 2000 - 262 });
    }
}
