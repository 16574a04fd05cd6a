//! When a large topic leaves its QUIC link for a bulk lane, which is TLS over TCP to the same node
//! (`docs/spec/wire.md`, lanes).
//!
//! The kernel moves 64 KB of TCP a step where QUIC takes each packet alone, so a lane saves a third to a half of the
//! processor time of long messages. TCP loses that advantage where packets are lost or round trips are long, so
//! [`BulkPath`] allows lanes on short paths without loss only, and stops them as soon as the path is none.
//! [`BulkMeter`] measures whether a topic is worth one. The driver makes and ends the lanes.

use std::net::IpAddr;
use std::time::{Duration, Instant};

/// Shortest message for which a lane pays, bytes.
pub const BULK_MESSAGE_BYTES_MIN: u64 = 256 << 10;
/// Bytes in messages of that length that make a topic worth a lane, if they come within [`BULK_SPAN`].
const BULK_BYTES_MIN: u64 = 4 << 20;
/// Time in which these bytes have to come.
const BULK_SPAN: Duration = Duration::from_secs(2);

/// Longest of the shortest round trips of a path for lanes.
const RTT_MIN_MAX: Duration = Duration::from_millis(5);
/// Packets after which loss is judged.
const JUDGED_PACKETS: u64 = 1000;
/// One lost packet in this many is too much for TCP.
const LOSS_DIVISOR: u64 = 200;
/// Longest time that a lane's peer may owe an answer.
const STALLED_AFTER: Duration = Duration::from_secs(1);
/// Longest smoothed round trip of a lane in use, and the time for which it may be longer: a lane begins with its
/// handshake's, and busy processors delay answers in passing.
const LANE_RTT_MAX: Duration = Duration::from_millis(100);
const SLOW_MAX: Duration = Duration::from_secs(5);
/// Time without bytes of data after which a lane ends.
const UNUSED_MAX: Duration = Duration::from_secs(30);
/// Time in which a lane has to be up.
const MADE_WITHIN: Duration = Duration::from_secs(10);
/// Bytes between two looks that are no data: pings and frames of keep-alive.
const IDLE_BYTES_MAX: u64 = 16 << 10;
/// Time without lanes after the first failure in a row; it doubles with each.
const PENALTY_MIN: Duration = Duration::from_secs(10);
/// Longest time without lanes after a failure.
const PENALTY_MAX: Duration = Duration::from_secs(600);
/// Time of use after which a lane counts as a success: earlier failures are forgotten.
const PROVEN_AFTER: Duration = Duration::from_secs(600);

/// Measures whether the long messages of a topic on a link are worth a bulk lane.
#[derive(Debug, Default)]
pub struct BulkMeter {
    /// Beginning of the present span and the bytes in it.
    span: Option<(Instant, u64)>,
}

impl BulkMeter {
    /// Counts a message of this many bytes. Returns `true` each time that enough have come together.
    pub fn note(&mut self, now: Instant, bytes: u64) -> bool {
        if bytes < BULK_MESSAGE_BYTES_MIN {
            return false;
        }
        let (since, counted) = self.span.filter(|(since, _)| now < *since + BULK_SPAN).unwrap_or((now, 0));
        let counted = counted.saturating_add(bytes);
        let is_enough = counted >= BULK_BYTES_MIN;
        self.span = (!is_enough).then_some((since, counted));
        is_enough
    }
}

/// Measurements of a QUIC link.
#[derive(Clone, Copy, Debug)]
pub struct BulkPathObservation {
    /// Shortest round trip of the path.
    pub rtt_min: Duration,
    /// Packets sent since the link began.
    pub sent_packets: u64,
    /// Packets lost of these.
    pub lost_packets: u64,
}

/// Measurements of a bulk lane.
#[derive(Clone, Copy, Debug)]
pub struct BulkLaneObservation {
    /// The peer's address on the link.
    pub remote: IpAddr,
    /// Smoothed round trip.
    pub rtt: Duration,
    /// Since when the peer owes an answer to a ping behind data.
    pub waits_since: Option<Instant>,
    /// Bytes sent and received since the lane began.
    pub bytes: u64,
}

/// The reason why bulk lanes end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BulkEnd {
    /// The peer has another address, so the lane leads over a path that may be gone.
    PathChanged,
    /// The round trips of the path are too long for lanes.
    Slow,
    /// The path loses packets.
    Lossy,
    /// The peer owes an answer for too long, or the lane's round trips have become long.
    Stalled,
    /// The lane did not come up in time.
    NotMade,
    /// No data came for a while.
    Unused,
}

impl BulkEnd {
    /// Returns `true` if the path is to blame, so that no lane is tried for a while.
    fn is_failure(self) -> bool {
        match self {
            Self::Stalled | Self::NotMade => true,
            Self::PathChanged | Self::Slow | Self::Lossy | Self::Unused => false,
        }
    }
}

/// Whether the path of one QUIC link suits bulk lanes.
#[derive(Debug, Default)]
pub struct BulkPath {
    is_short: bool,
    /// Whether the last packets that were judged got lost too often.
    is_lossy: bool,
    /// Counters of packets, sent and lost, at the beginning of the present judgement of loss.
    judged_from: (u64, u64),
    /// Failures in a row, and the time before which no lane is tried.
    failures: u32,
    closed_until: Option<Instant>,
}

impl BulkPath {
    /// Returns `true` if a lane may be tried now.
    pub fn is_open(&self, now: Instant) -> bool {
        self.is_short && !self.is_lossy && !self.is_paused(now)
    }

    /// Returns `true` if no lane may be tried because one failed lately, whatever the path is like. The peer that asks
    /// for a lane has judged the path, and knows it from the data that it sends.
    pub fn is_paused(&self, now: Instant) -> bool {
        self.closed_until.is_some_and(|until| until > now)
    }

    /// Takes measurements of the link. Returns the reason if lanes that are up have to end.
    pub fn observe(&mut self, now: Instant, seen: &BulkPathObservation) -> Option<BulkEnd> {
        // A busy host measures 0 now and then. Before the first measurement it is QUIC's assumption, which is long.
        self.is_short = seen.rtt_min <= RTT_MIN_MAX;
        self.judge_loss(seen);
        let end = if self.is_short { self.is_lossy.then_some(BulkEnd::Lossy) } else { Some(BulkEnd::Slow) };
        self.note_end(now, end)
    }

    /// Takes measurements of a lane; `None` as long as it is not up. Returns the reason if it has to end.
    pub fn observe_lane(
        &mut self,
        now: Instant,
        lane: &mut BulkLaneUse,
        seen: Option<&BulkLaneObservation>,
    ) -> Option<BulkEnd> {
        let Some(seen) = seen else {
            let end = (now.saturating_duration_since(lane.since) > MADE_WITHIN).then_some(BulkEnd::NotMade);
            return self.note_end(now, end);
        };
        let is_in_use = seen.bytes.saturating_sub(lane.bytes) > IDLE_BYTES_MAX;
        if is_in_use {
            lane.used = now;
        }
        lane.bytes = seen.bytes;
        if seen.rtt <= LANE_RTT_MAX {
            lane.slow_since = None;
        } else if is_in_use {
            lane.slow_since.get_or_insert(now);
        }
        let is_slow = lane.slow_since.is_some_and(|since| now.saturating_duration_since(since) > SLOW_MAX);
        let owes = seen.waits_since.is_some_and(|since| now.saturating_duration_since(since) > STALLED_AFTER);
        let end = if seen.remote != lane.remote {
            Some(BulkEnd::PathChanged)
        } else if owes || is_slow {
            Some(BulkEnd::Stalled)
        } else {
            (now.saturating_duration_since(lane.used) > UNUSED_MAX).then_some(BulkEnd::Unused)
        };
        if end.is_none() && now.saturating_duration_since(lane.since) > PROVEN_AFTER {
            self.failures = 0;
        }
        self.note_end(now, end)
    }

    /// Notes that a lane could not be made, or broke.
    pub fn fail(&mut self, now: Instant) {
        self.failures = self.failures.saturating_add(1);
        let doubled = PENALTY_MIN.saturating_mul(2u32.saturating_pow((self.failures - 1).min(16)));
        self.closed_until = Some(now + doubled.min(PENALTY_MAX));
    }

    /// Judges how many of the packets since the last judgement the link lost.
    fn judge_loss(&mut self, seen: &BulkPathObservation) {
        let (sent, lost) = self.judged_from;
        let (sent, lost) = (seen.sent_packets.saturating_sub(sent), seen.lost_packets.saturating_sub(lost));
        let is_lossy = lost > sent.max(JUDGED_PACKETS) / LOSS_DIVISOR;
        if is_lossy || sent >= JUDGED_PACKETS {
            self.judged_from = (seen.sent_packets, seen.lost_packets);
            self.is_lossy = is_lossy;
        }
    }

    fn note_end(&mut self, now: Instant, end: Option<BulkEnd>) -> Option<BulkEnd> {
        if end.is_some_and(BulkEnd::is_failure) && self.closed_until.is_none_or(|until| until <= now) {
            self.fail(now);
        }
        end
    }
}

/// The use of one bulk lane.
#[derive(Debug)]
pub struct BulkLaneUse {
    /// The peer's address on the link when the lane began.
    remote: IpAddr,
    since: Instant,
    used: Instant,
    /// Since when round trips of the lane in use are long.
    slow_since: Option<Instant>,
    bytes: u64,
}

impl BulkLaneUse {
    /// Returns the use of a lane that begins now, beside a link whose peer has this address.
    pub fn new(now: Instant, remote: IpAddr) -> Self {
        Self { remote, since: now, used: now, slow_since: None, bytes: 0 }
    }

    /// Returns `true` if data came lately, so that an end of the lane is none for lack of use.
    pub fn is_recent(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.used) < UNUSED_MAX / 2
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::disallowed_methods)]

    use super::*;

    const LOOK: Duration = Duration::from_millis(500);
    const SHORT: Duration = Duration::from_micros(300);

    fn host(last: u8) -> IpAddr {
        IpAddr::from([192, 0, 2, last])
    }

    fn quiet(sent_packets: u64) -> BulkPathObservation {
        BulkPathObservation { rtt_min: SHORT, sent_packets, lost_packets: 0 }
    }

    fn busy(bytes: u64) -> BulkLaneObservation {
        BulkLaneObservation { remote: host(1), rtt: SHORT, waits_since: None, bytes }
    }

    #[test]
    fn only_much_data_in_long_messages_is_worth_a_lane() {
        let (mut meter, start) = (BulkMeter::default(), Instant::now());
        let mut at_rate =
            |bytes: u64, every: Duration| (0..100).filter(|n| meter.note(start + every * *n, bytes)).count();
        assert!(at_rate(1 << 20, Duration::from_millis(100)) > 10, "a camera of 10 Hz");
        meter = BulkMeter::default();
        let mut at_rate =
            |bytes: u64, every: Duration| (0..100).filter(|n| meter.note(start + every * *n, bytes)).count();
        assert_eq!(at_rate(1 << 20, Duration::from_secs(1)), 0, "one of 1 Hz");
        assert_eq!(at_rate(BULK_MESSAGE_BYTES_MIN - 1, Duration::from_millis(1)), 0, "short messages");
    }

    #[test]
    fn lanes_need_a_short_path_that_loses_nothing() {
        let (mut path, now) = (BulkPath::default(), Instant::now());
        assert!(!path.is_open(now), "nothing is known yet");
        assert_eq!(path.observe(now, &quiet(0)), None);
        assert!(path.is_open(now));
        let slow = BulkPathObservation { rtt_min: Duration::from_millis(20), ..quiet(10) };
        assert_eq!(path.observe(now, &slow), Some(BulkEnd::Slow));
        assert!(!path.is_open(now));
        assert_eq!(path.observe(now, &quiet(20)), None);
        assert!(path.is_open(now), "a long path is no failure");
        let lossy = BulkPathObservation { lost_packets: 8, ..quiet(1500) };
        assert_eq!(path.observe(now, &lossy), Some(BulkEnd::Lossy));
        assert!(!path.is_open(now + PENALTY_MAX), "until packets arrive again");
        path.observe(now, &BulkPathObservation { lost_packets: 8, ..quiet(2000) });
        assert!(!path.is_open(now), "too few to tell");
        assert_eq!(path.observe(now, &BulkPathObservation { lost_packets: 8, ..quiet(2500) }), None);
        assert!(path.is_open(now));
    }

    #[test]
    fn loss_is_judged_by_its_part_of_the_packets() {
        let (mut path, mut now) = (BulkPath::default(), Instant::now());
        for n in 1..1000 {
            now += LOOK;
            let seen = BulkPathObservation { lost_packets: 4 * n, ..quiet(n * 1000) };
            assert_eq!(path.observe(now, &seen), None, "one packet of 250");
        }
        let seen = BulkPathObservation { lost_packets: 4 * 999 + 6, ..quiet(1_000_000) };
        assert_eq!(path.observe(now, &seen), Some(BulkEnd::Lossy));
    }

    #[test]
    fn lane_ends_with_the_address_of_its_peer() {
        let (mut path, now) = (BulkPath::default(), Instant::now());
        assert_eq!(path.observe(now, &quiet(0)), None);
        let (mut old, mut new) = (BulkLaneUse::new(now, host(1)), BulkLaneUse::new(now, host(2)));
        let moved = BulkLaneObservation { remote: host(2), ..busy(1 << 20) };
        assert_eq!(path.observe_lane(now, &mut old, Some(&moved)), Some(BulkEnd::PathChanged));
        assert_eq!(path.observe_lane(now, &mut new, Some(&moved)), None);
        assert!(path.is_open(now), "the new path may have lanes at once");
    }

    #[test]
    fn lane_that_owes_an_answer_ends_and_later_ones_wait_longer_and_longer() {
        let (mut path, mut now) = (BulkPath::default(), Instant::now());
        let mut waits = Vec::new();
        for _ in 0..8 {
            path.observe(now, &quiet(0));
            assert!(path.is_open(now));
            let mut lane = BulkLaneUse::new(now, host(1));
            assert_eq!(path.observe_lane(now, &mut lane, Some(&busy(1 << 20))), None);
            let stalled = BulkLaneObservation { waits_since: Some(now), ..busy(2 << 20) };
            assert_eq!(path.observe_lane(now + STALLED_AFTER, &mut lane, Some(&stalled)), None);
            now += STALLED_AFTER + LOOK;
            assert_eq!(path.observe_lane(now, &mut lane, Some(&stalled)), Some(BulkEnd::Stalled));
            let since = now;
            while !path.is_open(now) {
                now += LOOK;
            }
            waits.push(now - since);
        }
        assert_eq!(waits[..3], [PENALTY_MIN, PENALTY_MIN * 2, PENALTY_MIN * 4]);
        assert_eq!(waits[7], PENALTY_MAX);
    }

    #[test]
    fn long_round_trips_end_a_lane_only_if_they_last() {
        let (mut path, start) = (BulkPath::default(), Instant::now());
        let mut lane = BulkLaneUse::new(start, host(1));
        let slow = |n: u32| BulkLaneObservation { rtt: 2 * LANE_RTT_MAX, ..busy(u64::from(n) << 20) };
        // The first is the handshake's.
        assert_eq!(path.observe_lane(start, &mut lane, Some(&slow(1))), None);
        assert_eq!(path.observe_lane(start + LOOK, &mut lane, Some(&busy(2 << 20))), None);
        let ended =
            (3..100).find(|n| path.observe_lane(start + LOOK * *n, &mut lane, Some(&slow(*n))).is_some());
        assert_eq!(ended.map(|n| LOOK * (n - 3)), Some(SLOW_MAX + LOOK));
        assert!(!path.is_open(start));
    }

    #[test]
    fn lane_ends_for_lack_of_use_but_not_because_it_is_young() {
        let (mut path, start) = (BulkPath::default(), Instant::now());
        let mut lane = BulkLaneUse::new(start, host(1));
        let mut now = start;
        for n in 0..100 {
            now += LOOK;
            assert_eq!(path.observe_lane(now, &mut lane, Some(&busy(n << 20))), None);
        }
        assert!(lane.is_recent(now));
        let used = now;
        let end = loop {
            now += LOOK;
            // Keep-alive is no use.
            let bytes = (99 << 20) + 100 * (now - used).as_secs();
            if let Some(end) = path.observe_lane(now, &mut lane, Some(&busy(bytes))) {
                break end;
            }
        };
        assert_eq!(end, BulkEnd::Unused);
        assert!(now - used > UNUSED_MAX && now - used < UNUSED_MAX + 2 * LOOK && !lane.is_recent(now));
        path.observe(now, &quiet(0));
        assert!(path.is_open(now), "the path is not to blame");
    }

    #[test]
    fn lane_that_is_not_made_in_time_counts_as_a_failure() {
        let (mut path, now) = (BulkPath::default(), Instant::now());
        path.observe(now, &quiet(0));
        let mut lane = BulkLaneUse::new(now, host(1));
        assert_eq!(path.observe_lane(now + MADE_WITHIN, &mut lane, None), None);
        let late = now + MADE_WITHIN + LOOK;
        assert_eq!(path.observe_lane(late, &mut lane, None), Some(BulkEnd::NotMade));
        assert!(!path.is_open(late));
    }
}
