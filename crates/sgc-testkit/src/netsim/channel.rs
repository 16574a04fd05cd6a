//! One direction of a path: a queue that drops at its tail, a wire of a certain rate, and impairments behind the wire.
//!
//! Pure: time is an argument, a [`Duration`] since an origin that the caller chooses, and must not go back. A packet
//! waits in the queue, takes its time on the wire, and only then is lost or delayed: as over radio, a lost packet has
//! used the wire as well.

use std::cmp::{Ordering, Reverse};
use std::collections::{BinaryHeap, VecDeque};
use std::time::Duration;

use crate::rng::Dice;

/// Most bytes in flight behind the wire. More are dropped as by a full queue.
pub const FLYING_BYTES_MAX: u64 = 256 << 20;

/// The properties of a direction. The default is a perfect wire.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Profile {
    /// Bits per second. Without a rate no packet ever waits.
    pub rate: Option<u64>,
    /// Bound of the queue before the wire, which matters only with a rate.
    pub queue: QueueLimit,
    /// Delay of a packet beyond its time on the wire.
    pub delay: Duration,
    /// Uniform variation of the delay, either way. Packets keep their order.
    pub jitter: Duration,
    /// Loss of packets.
    pub loss: Loss,
    /// Reordering of packets.
    pub reorder: Reorder,
    /// Fraction of packets that arrive twice.
    pub duplicate: f64,
    /// Bytes that each packet takes on the wire beyond its own.
    pub overhead_bytes: u32,
}

/// The bound of a queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum QueueLimit {
    /// A number of bytes.
    Bytes(u64),
    /// The bytes that the rate carries in this time.
    Time(Duration),
}

impl Default for QueueLimit {
    fn default() -> Self {
        Self::Time(Duration::from_millis(200))
    }
}

/// A model of loss. Probabilities are between 0 and 1.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Loss {
    /// All packets arrive.
    #[default]
    None,
    /// Each packet is lost with this probability, independently of others.
    Random(f64),
    /// Packets are lost in bursts (Gilbert and Elliott): in one state all arrive, in the other the fraction `in_burst`
    /// is lost. `begin` and `end` are the probabilities, per packet, of a change to the second state and back.
    Bursts {
        /// Probability that a burst begins with a packet.
        begin: f64,
        /// Probability that it ends with a packet.
        end: f64,
        /// Fraction of packets lost in a burst.
        in_burst: f64,
    },
}

/// A model of reordering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Reorder {
    /// Fraction of packets that are held back.
    pub share: f64,
    /// Time for which they are held back, beyond the delay.
    pub by: Duration,
}

/// Counters of packets so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Packets that came in.
    pub packets: u64,
    /// Bytes that came in.
    pub bytes: u64,
    /// Packets that were delivered, copies included.
    pub passed: u64,
    /// Bytes of delivered packets.
    pub passed_bytes: u64,
    /// Packets lost on the way.
    pub lost: u64,
    /// Packets that the full queue dropped.
    pub overflowed: u64,
    /// Packets dropped because the path is cut.
    pub cut: u64,
    /// Packets that arrived twice.
    pub duplicated: u64,
    /// Packets that were held back.
    pub reordered: u64,
    /// Largest number of bytes in the queue.
    pub queue_bytes_max: u64,
    /// Longest time that a packet waited for the wire.
    pub queue_time_max: Duration,
}

struct Waiting<P> {
    packet: P,
    bytes: u64,
    came: Duration,
}

struct Flying<P> {
    at: Duration,
    /// Breaks ties, so that packets of the same time keep their order.
    number: u64,
    bytes: u64,
    packet: P,
}

impl<P> PartialEq for Flying<P> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<P> Eq for Flying<P> {}

impl<P> PartialOrd for Flying<P> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<P> Ord for Flying<P> {
    fn cmp(&self, other: &Self) -> Ordering {
        (self.at, self.number).cmp(&(other.at, other.number))
    }
}

/// One direction of a path; see the module.
pub struct Channel<P> {
    profile: Profile,
    dice: Dice,
    is_cut: bool,
    in_burst: bool,
    waiting: VecDeque<Waiting<P>>,
    waiting_bytes: u64,
    /// Time at which the wire is free.
    wire_free: Duration,
    flying: BinaryHeap<Reverse<Flying<P>>>,
    flying_bytes: u64,
    /// Arrival of the last packet that keeps its order.
    last_at: Duration,
    number: u64,
    counters: Counters,
}

impl<P: Clone> Channel<P> {
    /// Returns a channel. The same seed and the same packets at the same times give the same result.
    pub fn new(profile: Profile, seed: u64) -> Self {
        Self {
            profile,
            dice: Dice::new(seed),
            is_cut: false,
            in_burst: false,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            wire_free: Duration::ZERO,
            flying: BinaryHeap::new(),
            flying_bytes: 0,
            last_at: Duration::ZERO,
            number: 0,
            counters: Counters::default(),
        }
    }

    /// Changes the profile, for packets that are not on the wire yet.
    pub fn set(&mut self, profile: Profile) {
        self.profile = profile;
    }

    /// Drops packets in flight, and all that come until [`Channel::restore`].
    pub fn cut(&mut self) {
        self.is_cut = true;
        self.counters.cut += (self.waiting.len() + self.flying.len()) as u64;
        self.waiting.clear();
        self.flying.clear();
        (self.waiting_bytes, self.flying_bytes) = (0, 0);
    }

    /// Ends [`Channel::cut`].
    pub fn restore(&mut self) {
        self.is_cut = false;
    }

    /// Takes in a packet of so many bytes. Returns `false` if it is dropped at once.
    pub fn push(&mut self, now: Duration, bytes: usize, packet: P) -> bool {
        self.advance(now);
        self.counters.packets += 1;
        self.counters.bytes += bytes as u64;
        if self.is_cut {
            self.counters.cut += 1;
            return false;
        }
        if !self.has_room(bytes) {
            self.counters.overflowed += 1;
            return false;
        }
        self.waiting_bytes += bytes as u64;
        self.waiting.push_back(Waiting { packet, bytes: bytes as u64, came: now });
        self.advance(now);
        self.counters.queue_bytes_max = self.counters.queue_bytes_max.max(self.waiting_bytes);
        true
    }

    /// Returns the next packet that has arrived, if any.
    pub fn pop(&mut self, now: Duration) -> Option<P> {
        self.advance(now);
        if self.flying.peek()?.0.at > now {
            return None;
        }
        let Reverse(flying) = self.flying.pop()?;
        self.flying_bytes -= flying.bytes;
        self.counters.passed += 1;
        self.counters.passed_bytes += flying.bytes;
        Some(flying.packet)
    }

    /// Moves packets from the queue to the wire as far as the wire is free by then.
    fn advance(&mut self, now: Duration) {
        while let Some(front) = self.waiting.front() {
            let starts = self.wire_free.max(front.came);
            if starts > now {
                break;
            }
            let Some(Waiting { packet, bytes, came }) = self.waiting.pop_front() else { break };
            self.waiting_bytes -= bytes;
            self.counters.queue_time_max = self.counters.queue_time_max.max(starts - came);
            let ends = starts + self.wire_time(bytes);
            self.wire_free = ends;
            self.send(ends, bytes, packet);
        }
    }

    /// Applies loss, delay, reordering and duplication to a packet behind the wire.
    fn send(&mut self, sent: Duration, bytes: u64, packet: P) {
        if self.is_lost() {
            self.counters.lost += 1;
            return;
        }
        let mut at = sent + self.profile.delay;
        if !self.profile.jitter.is_zero() {
            at = (at + self.profile.jitter.mul_f64(2.0 * self.dice.fraction()))
                .saturating_sub(self.profile.jitter)
                .max(sent);
        }
        if self.dice.likely(self.profile.reorder.share) {
            at += self.profile.reorder.by;
            self.counters.reordered += 1;
        } else {
            at = at.max(self.last_at);
            self.last_at = at;
        }
        if self.dice.likely(self.profile.duplicate) {
            self.counters.duplicated += 1;
            self.fly(at, bytes, packet.clone());
        }
        self.fly(at, bytes, packet);
    }

    fn fly(&mut self, at: Duration, bytes: u64, packet: P) {
        self.number += 1;
        self.flying_bytes += bytes;
        self.flying.push(Reverse(Flying { at, number: self.number, bytes, packet }));
    }

    fn is_lost(&mut self) -> bool {
        match self.profile.loss {
            Loss::None => false,
            Loss::Random(share) => self.dice.likely(share),
            Loss::Bursts { begin, end, in_burst } => {
                let flips = if self.in_burst { end } else { begin };
                if self.dice.likely(flips) {
                    self.in_burst = !self.in_burst;
                }
                self.in_burst && self.dice.likely(in_burst)
            }
        }
    }

    fn wire_time(&self, bytes: u64) -> Duration {
        let Some(rate) = self.profile.rate else { return Duration::ZERO };
        let bits = (bytes + u64::from(self.profile.overhead_bytes)) * 8;
        Duration::from_nanos(
            (u128::from(bits) * 1_000_000_000 / u128::from(rate.max(1))).try_into().unwrap_or(u64::MAX),
        )
    }

    /// Returns `true` if a packet of so many bytes would be taken in now. An empty queue takes any packet.
    pub fn has_room(&self, bytes: usize) -> bool {
        if self.flying_bytes + self.waiting_bytes + bytes as u64 > FLYING_BYTES_MAX {
            return false;
        }
        self.waiting.is_empty() || self.waiting_bytes + bytes as u64 <= self.queue_bytes()
    }

    /// Returns the bound of the queue in bytes.
    pub fn queue_bytes(&self) -> u64 {
        match (self.profile.queue, self.profile.rate) {
            (QueueLimit::Bytes(bytes), _) => bytes,
            (QueueLimit::Time(time), Some(rate)) => (rate as f64 / 8.0 * time.as_secs_f64()) as u64,
            (QueueLimit::Time(_), None) => FLYING_BYTES_MAX,
        }
    }

    /// Returns the time of the next call of [`Channel::pop`], or `None` while no packet is in flight.
    pub fn next_deadline(&self) -> Option<Duration> {
        let starts = self.waiting.front().map(|front| self.wire_free.max(front.came));
        let arrives = self.flying.peek().map(|flying| flying.0.at);
        starts.into_iter().chain(arrives).min()
    }

    /// Returns the profile.
    pub fn profile(&self) -> Profile {
        self.profile
    }

    /// Returns the counters.
    pub fn counters(&self) -> Counters {
        self.counters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: Duration = Duration::from_millis(1);

    /// Drains a channel on a virtual clock. Returns the packets with their times.
    fn drain(channel: &mut Channel<u32>) -> Vec<(Duration, u32)> {
        let mut arrived = Vec::new();
        while let Some(now) = channel.next_deadline() {
            while let Some(packet) = channel.pop(now) {
                arrived.push((now, packet));
            }
        }
        arrived
    }

    fn fill(profile: Profile, packets: u32) -> (Channel<u32>, Vec<(Duration, u32)>) {
        let mut channel = Channel::new(profile, 7);
        for n in 0..packets {
            channel.push(Duration::ZERO, 1000, n);
        }
        let arrived = drain(&mut channel);
        (channel, arrived)
    }

    fn unbounded() -> Profile {
        Profile { queue: QueueLimit::Bytes(u64::MAX / 2), ..Profile::default() }
    }

    #[test]
    fn a_perfect_wire_passes_all_at_once_and_in_order() {
        let (channel, arrived) = fill(Profile::default(), 100);
        assert_eq!(arrived, (0..100).map(|n| (Duration::ZERO, n)).collect::<Vec<_>>());
        let counters = channel.counters();
        assert_eq!((counters.packets, counters.passed, counters.passed_bytes), (100, 100, 100_000));
        assert_eq!(channel.next_deadline(), None);
    }

    #[test]
    fn the_rate_spaces_packets_and_the_delay_comes_after_it() {
        // 1000 bytes at 8 Mbit/s are a millisecond.
        let profile = Profile { rate: Some(8_000_000), delay: 40 * MS, ..Profile::default() };
        let (channel, arrived) = fill(profile, 3);
        assert_eq!(arrived, [(41 * MS, 0), (42 * MS, 1), (43 * MS, 2)]);
        assert_eq!(channel.counters().queue_time_max, 2 * MS);
        assert_eq!(channel.counters().queue_bytes_max, 2000);
    }

    #[test]
    fn overhead_takes_its_time_on_the_wire() {
        let profile = Profile { rate: Some(8_000_000), overhead_bytes: 1000, ..Profile::default() };
        assert_eq!(fill(profile, 1).1, [(2 * MS, 0)]);
    }

    #[test]
    fn a_full_queue_drops_what_comes_last() {
        for queue in [QueueLimit::Bytes(5000), QueueLimit::Time(5 * MS)] {
            let profile = Profile { rate: Some(8_000_000), queue, ..Profile::default() };
            let (channel, arrived) = fill(profile, 10);
            // One packet is on the wire, five wait.
            assert_eq!(arrived.iter().map(|(_, n)| *n).collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
            assert_eq!(channel.counters().overflowed, 4);
        }
    }

    #[test]
    fn a_packet_larger_than_the_queue_passes_when_none_waits() {
        let profile = Profile { rate: Some(8000), queue: QueueLimit::Bytes(10), ..Profile::default() };
        assert_eq!(fill(profile, 1).1.len(), 1);
    }

    #[test]
    fn idle_wire_accumulates_no_credit() {
        let mut channel = Channel::new(Profile { rate: Some(8_000_000), ..Profile::default() }, 1);
        channel.push(1000 * MS, 1000, 0);
        channel.push(1000 * MS, 1000, 1);
        assert_eq!(drain(&mut channel), [(1001 * MS, 0), (1002 * MS, 1)]);
    }

    #[test]
    fn new_rate_applies_to_waiting_packets() {
        let mut channel = Channel::new(Profile { rate: Some(8_000_000), ..Profile::default() }, 1);
        for n in 0..3 {
            channel.push(Duration::ZERO, 1000, n);
        }
        channel.set(Profile { rate: Some(800_000), ..Profile::default() });
        assert_eq!(drain(&mut channel), [(MS, 0), (11 * MS, 1), (21 * MS, 2)]);
    }

    #[test]
    fn losses_are_as_frequent_as_asked_and_take_the_wire() {
        let profile = Profile { rate: Some(8_000_000), loss: Loss::Random(0.1), ..unbounded() };
        let (channel, arrived) = fill(profile, 20_000);
        let lost = channel.counters().lost;
        assert!((1800..2200).contains(&lost), "{lost}");
        assert_eq!(arrived.len() as u64 + lost, 20_000);
        assert!(arrived.last().unwrap().0 > 19_990 * MS);
    }

    #[test]
    fn bursts_lose_neighbours() {
        // A hundredth of the packets begins a burst of ten on average: about 9 % are lost, in one run of ten each.
        let loss = Loss::Bursts { begin: 0.01, end: 0.1, in_burst: 1.0 };
        let (channel, arrived) = fill(Profile { loss, ..unbounded() }, 50_000);
        let lost = channel.counters().lost;
        assert!((3500..5600).contains(&lost), "{lost}");
        let runs = arrived.windows(2).filter(|pair| pair[1].1 != pair[0].1 + 1).count() as u64;
        assert!((7..14).contains(&(lost / runs)), "{lost} in {runs} runs");
    }

    #[test]
    fn jitter_stays_in_its_bounds_and_keeps_the_order() {
        let profile = Profile { delay: 20 * MS, jitter: 5 * MS, ..unbounded() };
        let mut channel = Channel::new(profile, 3);
        let mut delays = Vec::new();
        for n in 0..1000 {
            let sent = 100 * MS * n;
            channel.push(sent, 100, n);
            let [(at, packet)] = drain(&mut channel)[..] else { panic!("one packet") };
            assert_eq!(packet, n);
            delays.push(at - sent);
        }
        assert!(delays.iter().all(|delay| (15 * MS..=25 * MS).contains(delay)));
        assert!(delays.iter().any(|d| *d < 16 * MS) && delays.iter().any(|d| *d > 24 * MS));

        let (_, arrived) = fill(profile, 1000);
        assert!(arrived.is_sorted(), "packets overtake each other");
    }

    #[test]
    fn delayed_packet_is_overtaken_and_delays_no_other() {
        let reorder = Reorder { share: 0.2, by: 10 * MS };
        let mut channel = Channel::new(Profile { reorder, ..unbounded() }, 5);
        for n in 0..1000 {
            channel.push(MS * n, 100, n);
            while let Some(at) = channel.pop(MS * n) {
                assert!(at == n || n - at == 10, "{at} comes at {n}");
            }
        }
        let reordered = channel.counters().reordered;
        assert!((150..250).contains(&reordered), "{reordered}");
    }

    #[test]
    fn duplicates_arrive_twice() {
        let (channel, arrived) = fill(Profile { duplicate: 1.0, ..Profile::default() }, 3);
        assert_eq!(arrived.iter().map(|(_, n)| *n).collect::<Vec<_>>(), [0, 0, 1, 1, 2, 2]);
        assert_eq!(channel.counters().duplicated, 3);
    }

    #[test]
    fn cut_path_drops_packets_in_flight_and_later_ones() {
        let profile = Profile { rate: Some(8_000_000), delay: 10 * MS, ..Profile::default() };
        let mut channel = Channel::new(profile, 1);
        for n in 0..3 {
            channel.push(Duration::ZERO, 1000, n);
        }
        channel.cut();
        assert!(!channel.push(MS, 1000, 3));
        assert_eq!(drain(&mut channel), []);
        channel.restore();
        assert!(channel.push(5 * MS, 1000, 4));
        assert_eq!(drain(&mut channel), [(16 * MS, 4)]);
        assert_eq!(channel.counters().cut, 4);
    }

    #[test]
    fn bytes_in_flight_are_bounded() {
        let profile = Profile { delay: Duration::from_secs(3600), ..Profile::default() };
        let mut channel = Channel::new(profile, 1);
        let size = 1 << 20;
        let taken = (0..1000).filter(|n| channel.push(Duration::ZERO, size, *n)).count() as u64;
        assert_eq!(taken, FLYING_BYTES_MAX / size as u64);
    }

    #[test]
    fn same_seed_gives_same_result() {
        let profile = Profile { loss: Loss::Random(0.3), jitter: 5 * MS, delay: 9 * MS, ..unbounded() };
        assert_eq!(fill(profile, 500).1, fill(profile, 500).1);
    }
}
