//! [`PeerClocks`]: what the clocks of other nodes show, with bounds.
//!
//! A node asks a peer for its time. The peer read its clock between the question and the answer, so that one answer bounds
//! how far the clock is from this node's (F. Cristian, "Probabilistic clock synchronization", 1989). The bounds of several
//! answers are intersected (RFC 5905, 11.2.1), since the true difference lies within each. They widen with time, because
//! clocks drift. A peer whose clock was set has bounds that do not meet; then only the newest answer counts.
//!
//! Differences are kept against the monotonic clock of this node, so setting its clock changes nothing.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_wire::{NodeId, UnixMillis};

/// Most peers whose clocks are asked for.
pub const PEER_CLOCKS_MAX: usize = 256;
/// Rate at which bounds widen, as a divisor: 200 ppm, twice what the clocks of computers differ.
pub(crate) const DRIFT_DIVISOR: i64 = 5_000;
/// Number of answers after which questions become rare.
const FIRST_ANSWERS: u32 = 4;
/// Time from one of the first answers to the next question.
const FIRST_WAIT: Duration = Duration::from_secs(1);
/// Time from a later answer to the next question. Bounds widen by 6 ms meanwhile.
const WAIT: Duration = Duration::from_secs(30);
/// Resolution of the time in an answer.
const RESOLUTION_NS: i64 = 1_000_000;

/// Work for the driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClockOutput {
    /// Ask the peer for its time, in place of an earlier question.
    Ask(NodeId),
    /// Ask the peer no more.
    Leave(NodeId),
}

/// The clocks of the peers that this node gets messages from.
#[derive(Debug)]
pub struct PeerClocks {
    /// The zero of the times of this node, below.
    origin: Instant,
    peers: BTreeMap<NodeId, Peer>,
    /// Peers that are wanted no more.
    left: Vec<NodeId>,
}

#[derive(Debug)]
struct Peer {
    bounds: Option<ClockBounds>,
    answers: u32,
    /// Time of the next question; `None` while there is no answer to the last one.
    due: Option<Instant>,
}

/// Bounds of what a clock shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ClockBounds {
    origin: Instant,
    /// The least and the greatest time that the clock may show at the origin, in ns since 1970.
    at_origin: (i64, i64),
    /// The time of the answer that the bounds are of.
    measured: Instant,
    /// Number of times that the clock was set.
    steps: u32,
}

impl PeerClocks {
    /// Knows no peer.
    pub fn new(now: Instant) -> Self {
        Self { origin: now, peers: BTreeMap::new(), left: Vec::new() }
    }

    /// Sets the peers whose clocks matter. Those beyond [`PEER_CLOCKS_MAX`] are not asked.
    pub fn want(&mut self, now: Instant, peers: impl IntoIterator<Item = NodeId>) {
        let mut before = std::mem::take(&mut self.peers);
        for id in peers {
            if self.peers.len() < PEER_CLOCKS_MAX {
                let known = before.remove(&id);
                let peer = known.unwrap_or(Peer { bounds: None, answers: 0, due: Some(now) });
                self.peers.entry(id).or_insert(peer);
            }
        }
        self.left.extend(before.into_keys());
    }

    /// Returns the next output that is due.
    pub fn poll(&mut self, now: Instant) -> Option<ClockOutput> {
        if let Some(peer) = self.left.pop() {
            return Some(ClockOutput::Leave(peer));
        }
        let due = |peer: &&mut Peer| peer.due.is_some_and(|due| due <= now);
        let (id, peer) = self.peers.iter_mut().find(|(_, peer)| due(peer))?;
        peer.due = None;
        Some(ClockOutput::Ask(*id))
    }

    /// Returns when [`Self::poll`] has something to do.
    pub fn deadline(&self) -> Option<Instant> {
        self.peers.values().filter_map(|peer| peer.due).min()
    }

    /// Takes an answer of a peer, which showed `time` some time between `asked` and `now`.
    pub fn told(&mut self, peer: NodeId, asked: Instant, now: Instant, time: UnixMillis) {
        let Some(peer) = self.peers.get_mut(&peer) else { return };
        let shown = i64::try_from(time.0).unwrap_or(i64::MAX).saturating_mul(RESOLUTION_NS);
        let (asked_ns, now_ns) = (nanos_since(asked, self.origin), nanos_since(now, self.origin));
        let new =
            (shown.saturating_sub(now_ns), shown.saturating_add(RESOLUTION_NS).saturating_sub(asked_ns));
        let steps = peer.bounds.map_or(0, |before| before.steps);
        let (at_origin, steps) = match peer.bounds.map(|before| before.widened(now)) {
            Some(before) if before.0 <= new.1 && new.0 <= before.1 => {
                ((before.0.max(new.0), before.1.min(new.1)), steps)
            }
            Some(_) => (new, steps.saturating_add(1)),
            None => (new, steps),
        };
        peer.bounds = Some(ClockBounds { origin: self.origin, at_origin, measured: now, steps });
        peer.answers = peer.answers.saturating_add(1);
        let wait = if peer.answers < FIRST_ANSWERS { FIRST_WAIT } else { WAIT };
        peer.due = Some(now + wait);
    }

    /// Returns what is known of a peer's clock.
    pub fn bounds(&self, peer: &NodeId) -> Option<ClockBounds> {
        self.peers.get(peer)?.bounds
    }

    /// Iterates over the peers whose clocks are known, in the order of their ids.
    pub fn known(&self) -> impl Iterator<Item = (NodeId, ClockBounds)> {
        self.peers.iter().filter_map(|(id, peer)| Some((*id, peer.bounds?)))
    }
}

impl ClockBounds {
    /// Returns the least and the greatest time that the clock may show, in ns since 1970.
    pub fn shown(&self, now: Instant) -> (i64, i64) {
        let (least, most) = self.widened(now);
        let since = nanos_since(now, self.origin);
        (least.saturating_add(since), most.saturating_add(since))
    }

    /// Returns how far the clock is ahead of one that shows `own_ns`, and the greatest error of that, both in ns.
    pub fn offset(&self, now: Instant, own_ns: i64) -> (i64, i64) {
        let (least, most) = self.shown(now);
        let error = most.saturating_sub(least) / 2;
        (least.saturating_add(error).saturating_sub(own_ns), error)
    }

    /// Returns the least age of a message with a time stamp of that clock, in ns; less than 0 for one from the future.
    pub fn least_age(&self, now: Instant, stamp_ns: i64) -> i64 {
        self.shown(now).0.saturating_sub(stamp_ns)
    }

    /// Returns the time of the last answer.
    pub fn measured(&self) -> Instant {
        self.measured
    }

    /// Returns how often the clock was set since the first answer.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    fn widened(&self, now: Instant) -> (i64, i64) {
        let drift = nanos_since(now, self.measured).max(0) / DRIFT_DIVISOR;
        let (least, most) = self.at_origin;
        (least.saturating_sub(drift), most.saturating_add(drift))
    }
}

/// Returns the nanoseconds from one time to another, less than 0 if it is earlier.
fn nanos_since(at: Instant, origin: Instant) -> i64 {
    let nanos = |time: Duration| i64::try_from(time.as_nanos()).unwrap_or(i64::MAX);
    match at.checked_duration_since(origin) {
        Some(after) => nanos(after),
        None => -nanos(origin.saturating_duration_since(at)),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_chacha::ChaCha8Rng;
    use rand_core::{RngCore, SeedableRng};

    use super::*;

    const PEER: NodeId = NodeId([7; 32]);
    /// The time that the clock of this node shows at the beginning, in ms since 1970.
    const OWN_MS: u64 = 1_700_000_000_000;
    const MS: i64 = 1_000_000;

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    /// A peer whose clock is ahead by `ahead_ms`, asked at `asked` and answering after `there` and `back`.
    fn ask(
        clocks: &mut PeerClocks,
        begin: Instant,
        ahead_ms: i64,
        asked: u64,
        there: u64,
        back: u64,
    ) -> Instant {
        let time = UnixMillis((OWN_MS + asked + there).checked_add_signed(ahead_ms).unwrap());
        let now = begin + ms(asked + there + back);
        clocks.told(PEER, begin + ms(asked), now, time);
        now
    }

    fn offset(clocks: &PeerClocks, begin: Instant, now: Instant) -> (i64, i64) {
        let own = OWN_MS as i64 * MS + nanos_since(now, begin);
        clocks.bounds(&PEER).unwrap().offset(now, own)
    }

    #[test]
    fn one_answer_bounds_the_difference_by_half_the_round_trip() {
        let begin = Instant::now();
        for (ahead, there, back) in [(0, 20, 20), (3_600_000, 40, 0), (-5_000, 0, 40)] {
            let mut clocks = PeerClocks::new(begin);
            clocks.want(begin, [PEER]);
            let now = ask(&mut clocks, begin, ahead, 100, there, back);
            let (found, error) = offset(&clocks, begin, now);
            assert_eq!(error, 20 * MS + MS / 2);
            assert!((found - ahead * MS).abs() <= error, "{ahead}: {found} ± {error}");
        }
    }

    #[test]
    fn answers_narrow_the_bounds_and_time_widens_them() {
        let begin = Instant::now();
        let mut clocks = PeerClocks::new(begin);
        clocks.want(begin, [PEER]);
        ask(&mut clocks, begin, 50, 0, 40, 0);
        // The way there was quick and the way back was not: together they leave little room.
        let now = ask(&mut clocks, begin, 50, 1_000, 0, 40);
        let (found, error) = offset(&clocks, begin, now);
        assert!(error <= MS && (found - 50 * MS).abs() <= error, "{found} ± {error}");
        let later = now + Duration::from_secs(30);
        assert_eq!(offset(&clocks, begin, later).1 - error, 6 * MS);
        // A slow answer later changes nothing.
        let now = ask(&mut clocks, begin, 50, 31_000, 2_000, 2_000);
        assert!(offset(&clocks, begin, now).1 <= 8 * MS);
        assert_eq!(clocks.bounds(&PEER).unwrap().steps(), 0);
    }

    #[test]
    fn a_clock_that_was_set_is_measured_anew() {
        let begin = Instant::now();
        let mut clocks = PeerClocks::new(begin);
        clocks.want(begin, [PEER]);
        ask(&mut clocks, begin, 0, 0, 10, 10);
        let now = ask(&mut clocks, begin, 60_000, 1_000, 10, 10);
        let (found, error) = offset(&clocks, begin, now);
        assert!((found - 60_000 * MS).abs() <= error);
        assert_eq!(clocks.bounds(&PEER).unwrap().steps(), 1);
    }

    #[test]
    fn ages_are_at_least_what_the_bounds_permit() {
        let begin = Instant::now();
        let mut clocks = PeerClocks::new(begin);
        clocks.want(begin, [PEER]);
        let now = ask(&mut clocks, begin, 10_000, 0, 30, 10);
        let bounds = clocks.bounds(&PEER).unwrap();
        // Published now, by the peer's clock.
        let stamp = (OWN_MS as i64 + 10_000 + 40) * MS;
        assert_eq!(bounds.least_age(now, stamp), -10 * MS);
        assert_eq!(bounds.least_age(now, stamp - 500 * MS), 490 * MS);
    }

    #[test]
    fn peers_are_asked_often_at_first_and_only_while_they_are_wanted() {
        let begin = Instant::now();
        let mut clocks = PeerClocks::new(begin);
        clocks.want(begin, [PEER]);
        let mut at = begin;
        let mut waits = Vec::new();
        for _ in 0..6 {
            assert_eq!(clocks.poll(at), Some(ClockOutput::Ask(PEER)));
            assert_eq!(
                (clocks.poll(at), clocks.deadline()),
                (None, None),
                "the endpoint asks until there is an answer"
            );
            clocks.told(PEER, at, at, UnixMillis(OWN_MS));
            let due = clocks.deadline().unwrap();
            waits.push((due - at).as_secs());
            at = due;
        }
        assert_eq!(waits, [1, 1, 1, 30, 30, 30]);
        clocks.want(at, [PEER]);
        assert!(clocks.bounds(&PEER).is_some());
        clocks.want(at, []);
        assert_eq!(clocks.poll(at), Some(ClockOutput::Leave(PEER)));
        assert_eq!((clocks.poll(at), clocks.bounds(&PEER)), (None, None));
        clocks.told(PEER, at, at, UnixMillis(1));
        assert_eq!(clocks.known().count(), 0, "an answer that is not wanted any more");
        let many = (0..=u8::MAX)
            .chain(0..10)
            .map(|n| NodeId([n; 32]))
            .chain([NodeId([1; 32]), [[0; 16], [1; 16]].concat().try_into().map(NodeId).unwrap()]);
        clocks.want(at, many);
        assert_eq!(clocks.peers.len(), PEER_CLOCKS_MAX);
    }

    /// The true difference is within the bounds whatever the delays are, as long as clocks drift by less than 200 ppm.
    #[test]
    fn the_truth_is_within_the_bounds_of_random_histories() {
        for seed in 0..500 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut below = |n: u64| rng.next_u64() % n;
            let begin = Instant::now();
            let mut clocks = PeerClocks::new(begin);
            clocks.want(begin, [PEER]);
            // The peer's clock runs at another rate, and is set at times.
            let ppm = below(380) as i64 - 190;
            let mut ahead_ns = below(20_000_000_000) as i64 - 10_000_000_000;
            let shown = |ahead: i64, at: i64| OWN_MS as i64 * MS + at + ahead + at / 1_000_000 * ppm;
            let mut at = 0_i64;
            for _ in 0..60 {
                at += below(60_000_000_000) as i64;
                let set = below(20) == 0;
                if set {
                    ahead_ns += 20_000_000_000;
                }
                let (there, back) = (below(300_000_000) as i64, below(300_000_000) as i64);
                let time = UnixMillis((shown(ahead_ns, at + there) / MS) as u64);
                let asked = begin + Duration::from_nanos(at as u64);
                at += there + back;
                let now = begin + Duration::from_nanos(at as u64);
                clocks.told(PEER, asked, now, time);
                for later in [0, 10_000_000_000] {
                    let bounds = clocks.bounds(&PEER).unwrap();
                    let (least, most) = bounds.shown(now + Duration::from_nanos(later));
                    let truth = shown(ahead_ns, at + later as i64);
                    assert!((least..=most).contains(&truth), "seed {seed}: {least} {truth} {most}");
                }
            }
        }
    }
}
