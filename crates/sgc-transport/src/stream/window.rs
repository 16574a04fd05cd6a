//! The number of bytes in flight: enough to keep the path busy with a short queue. Pure.
//!
//! TCP takes any number of bytes, and its congestion control fills the queue of the narrowest hop, where urgent packets
//! then wait behind others. So the link gives TCP only the bytes that the path delivers within its shortest round trip
//! and [`QUEUE_TARGET`] more. It measures from within: pings stand between the bytes, and the answer to a ping shows
//! that everything before it has arrived. (The kernel knows more, but tells it by an ioctl only, for which this crate
//! would need unsafe code, and knows nothing of a proxy's queues.)

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Time on the path of bytes that are written together, and the least part of the window for them.
const TOGETHER: Duration = Duration::from_millis(2);
const TOGETHER_PART: u64 = 16;
/// Time that bytes may queue on the path.
const QUEUE_TARGET: Duration = Duration::from_millis(12);
/// Smallest window, bytes.
const WINDOW_BYTES_MIN: u64 = 12 << 10;
/// Window before any measurement, bytes.
const WINDOW_BYTES_START: u64 = 32 << 10;
/// Largest growth of the window in a round trip; the growth until the first queue.
const GROWTH_MAX: f64 = 1.5;
/// Time for which answers have to be late to show a queue, at least; a round trip if that is longer.
const STANDING_MIN: Duration = Duration::from_millis(25);
/// Time after which the shortest round trip is measured again, with a path that is almost empty.
const RTT_MIN_AGE_MAX: Duration = Duration::from_secs(10);
/// Most pings without answer: a peer that answers none costs no more.
const PINGS_MAX: usize = 64;
/// Bytes between two pings, at least and at most.
const PING_BYTES: (u64, u64) = (4 << 10, 256 << 10);

/// The sending window of one link.
#[derive(Debug)]
pub(crate) struct Window {
    bytes: u64,
    bytes_max: u64,
    written: u64,
    delivered: u64,
    next_ping: u64,
    pings: VecDeque<Ping>,
    /// Round trip of the handshake, until a better one is measured.
    handshake: Duration,
    rtt: Option<Duration>,
    rtt_min: Option<(Duration, Instant)>,
    /// Beginning of the present span, its shortest round trip, and that of the span before.
    shortest: Option<(Instant, Duration, Duration)>,
    /// The shortest round trip is being measured.
    is_probing: bool,
    /// No queue was seen yet.
    is_starting: bool,
}

#[derive(Debug)]
struct Ping {
    number: u64,
    at: Instant,
    /// Bytes written before it, in all.
    written: u64,
    /// Bytes in flight when it was written.
    in_flight: u64,
}

impl Window {
    /// Returns a window of at most `bytes_max`.
    pub(crate) fn new(bytes_max: u64) -> Self {
        let bytes_max = bytes_max.max(WINDOW_BYTES_MIN);
        Self {
            bytes: WINDOW_BYTES_START.min(bytes_max),
            bytes_max,
            written: 0,
            delivered: 0,
            next_ping: 1,
            pings: VecDeque::new(),
            handshake: Duration::ZERO,
            rtt: None,
            rtt_min: None,
            shortest: None,
            is_probing: false,
            is_starting: true,
        }
    }

    /// Notes written bytes.
    pub(crate) fn on_written(&mut self, bytes: u64) {
        self.written += bytes;
    }

    /// Returns the number of a ping to write now; nothing if too many have no answer.
    pub(crate) fn ping(&mut self, now: Instant) -> Option<u64> {
        if self.pings.len() >= PINGS_MAX {
            return None;
        }
        let number = self.next_ping;
        self.next_ping += 1;
        self.pings.push_back(Ping { number, at: now, written: self.written, in_flight: self.in_flight() });
        Some(number)
    }

    /// Returns `true` if enough was written since the last ping for another to tell something.
    pub(crate) fn is_ping_due(&self) -> bool {
        let (least, most) = PING_BYTES;
        let last = self.pings.back().map_or(self.delivered, |ping| ping.written);
        // Only an answer opens a full window, so one ping has to be in flight.
        let is_stuck = self.pings.is_empty() && !self.has_room(0);
        is_stuck || self.written - last >= (self.limit() / 8).clamp(least, most)
    }

    /// Notes that all pings up to this one have arrived. Returns `false` if no ping has that number.
    pub(crate) fn on_pong(&mut self, number: u64, now: Instant) -> bool {
        if number >= self.next_ping {
            return false;
        }
        let mut latest = None;
        while self.pings.front().is_some_and(|ping| ping.number <= number) {
            latest = self.pings.pop_front();
        }
        if let Some(ping) = latest {
            self.delivered = self.delivered.max(ping.written);
            self.measure(&ping, now);
        }
        true
    }

    /// Returns `true` if more may be written now: urgent data may use `more` bytes above the window.
    pub(crate) fn has_room(&self, more: u64) -> bool {
        self.in_flight() < self.limit() + more
    }

    fn limit(&self) -> u64 {
        if self.is_probing { WINDOW_BYTES_MIN } else { self.bytes }
    }

    /// Returns the bytes written, in all.
    pub(crate) fn written(&self) -> u64 {
        self.written
    }

    /// Returns the bytes that may be in flight.
    pub(crate) fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Returns the bytes to write together: those that the path delivers in [`TOGETHER`], and a part of the window at
    /// least.
    pub(crate) fn together(&self) -> u64 {
        let rtt = self.rtt.unwrap_or(self.handshake).max(TOGETHER);
        let delivered = self.bytes as f64 * TOGETHER.as_secs_f64() / rtt.as_secs_f64();
        (delivered as u64).max(self.bytes / TOGETHER_PART)
    }

    /// Returns the smoothed and the shortest round trip.
    pub(crate) fn rtt(&self) -> (Duration, Duration) {
        (self.rtt.unwrap_or(self.handshake), self.rtt_min.map_or(self.handshake, |(rtt, _)| rtt))
    }

    /// Returns the time of the oldest ping without an answer.
    pub(crate) fn waits_since(&self) -> Option<Instant> {
        self.pings.front().map(|ping| ping.at)
    }

    /// Notes the handshake's round trip.
    pub(crate) fn note_handshake(&mut self, rtt: Duration) {
        self.handshake = rtt;
    }

    /// Returns the recent shortest round trip. Radio and busy processors cause passing delay; a queue causes lasting
    /// delay.
    fn standing(&mut self, rtt: Duration, now: Instant) -> Duration {
        let half = self.rtt.map_or(STANDING_MIN, |rtt| rtt.max(STANDING_MIN));
        let (began, latest, before) = self.shortest.unwrap_or((now, rtt, rtt));
        let (began, latest, before) = if now.saturating_duration_since(began) > half {
            (now, rtt, latest)
        } else {
            (began, latest.min(rtt), before)
        };
        self.shortest = Some((began, latest, before));
        latest.min(before)
    }

    fn in_flight(&self) -> u64 {
        self.written - self.delivered
    }

    fn measure(&mut self, ping: &Ping, now: Instant) {
        let rtt = now.saturating_duration_since(ping.at).max(Duration::from_micros(1));
        self.rtt = Some(self.rtt.map_or(rtt, |smooth| (smooth * 7 + rtt) / 8));
        let is_unloaded = ping.in_flight <= WINDOW_BYTES_MIN;
        match self.rtt_min {
            Some((least, at)) if rtt > least => {
                if now.saturating_duration_since(at) > RTT_MIN_AGE_MAX {
                    self.is_probing = !is_unloaded;
                    if is_unloaded {
                        self.rtt_min = Some((rtt, now));
                    }
                }
            }
            _ => {
                self.rtt_min = Some((rtt, now));
                self.is_probing = false;
            }
        }
        let least = self.rtt_min.map_or(rtt, |(least, _)| least);
        // The bytes in flight arrived within this round trip, so this part arrives in the target time.
        let was_full = ping.in_flight >= self.bytes / 2;
        let (aim, standing) = (least + QUEUE_TARGET, self.standing(rtt, now));
        let portion = |rtt: Duration| aim.as_secs_f64() / rtt.as_secs_f64();
        self.is_starting &= rtt < least + QUEUE_TARGET / 2;
        let growth = if self.is_starting { GROWTH_MAX } else { portion(rtt).min(GROWTH_MAX) };
        let wanted = (ping.in_flight as f64 * growth) as u64;
        if wanted > self.bytes {
            self.bytes = wanted;
        } else if was_full && standing > aim && !self.is_probing {
            let wanted = (ping.in_flight as f64 * portion(standing)) as u64;
            self.bytes -= self.bytes.saturating_sub(wanted) / 4;
        }
        self.bytes = self.bytes.clamp(WINDOW_BYTES_MIN, self.bytes_max);
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_core::{RngCore as _, SeedableRng as _};

    use super::*;

    /// Runs a path of this rate and delay, as full as the window lets it be. Returns bytes per second delivered and the
    /// longest wait in its queue over the last of these seconds. Answers are late by up to `jitter`, and stay in order.
    fn run(rate: f64, rtt: Duration, jitter: Duration, seconds: u32) -> (f64, Duration) {
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        let start = Instant::now();
        let (mut window, mut now, mut free_at) = (Window::new(16 << 20), start, start);
        let mut answers: VecDeque<(Instant, u64)> = VecDeque::new();
        let end = start + Duration::from_secs(seconds.into());
        let late = end - Duration::from_secs(1);
        let (mut sent, mut worst) = (0u64, Duration::ZERO);
        while now < end {
            loop {
                if window.is_ping_due()
                    && let Some(number) = window.ping(now)
                {
                    let at = free_at.max(now) + rtt + jitter * (rng.next_u32() % 256) / 256;
                    let at = answers.back().map_or(at, |(before, _)| at.max(*before));
                    answers.push_back((at, number));
                }
                if !window.has_room(0) {
                    break;
                }
                window.on_written(1400);
                free_at = free_at.max(now) + Duration::from_secs_f64(1400.0 / rate);
                if now >= late {
                    sent += 1400;
                    worst = worst.max(free_at - now);
                }
            }
            let (at, number) = answers.pop_front().expect("an answer is always due");
            now = at;
            assert!(window.on_pong(number, now));
        }
        (sent as f64, worst)
    }

    #[test]
    fn a_short_path_is_given_much_at_once_and_a_thin_one_little() {
        let now = Instant::now();
        let measured = |rtt: Duration| {
            let mut window = Window::new(16 << 20);
            window.on_written(20_000);
            let ping = window.ping(now).unwrap();
            assert!(window.on_pong(ping, now + rtt));
            window
        };
        let short = measured(Duration::from_micros(200));
        assert_eq!(short.together(), short.bytes());
        let thin = measured(Duration::from_millis(100));
        assert_eq!(thin.together(), thin.bytes() / TOGETHER_PART);
        let between = measured(Duration::from_millis(8));
        assert_eq!(between.together(), between.bytes() / 4);
    }

    #[test]
    fn paths_are_filled_and_queues_stay_short() {
        for (megabits, millis) in [(5.0, 1), (5.0, 76), (50.0, 20), (1000.0, 1), (1000.0, 20)] {
            let rate = megabits * 125_000.0;
            let (sent, worst) = run(rate, Duration::from_millis(millis), Duration::ZERO, 25);
            let share = sent / rate;
            assert!(share > 0.85, "{megabits} Mbit/s, {millis} ms: {share:.2} of the rate");
            assert!(worst < Duration::from_millis(40), "{megabits} Mbit/s, {millis} ms: queue of {worst:?}");
        }
    }

    #[test]
    fn jitter_does_not_pass_for_a_queue() {
        for (megabits, millis) in [(5.0, 5), (50.0, 5), (50.0, 40)] {
            let rate = megabits * 125_000.0;
            let (sent, worst) = run(rate, Duration::from_millis(millis), Duration::from_millis(30), 25);
            let share = sent / rate;
            assert!(share > 0.5, "{megabits} Mbit/s, {millis} ms: {share:.2} of the rate");
            assert!(worst < Duration::from_millis(80), "{megabits} Mbit/s, {millis} ms: queue of {worst:?}");
        }
    }

    #[test]
    fn answers_to_nothing_are_refused_and_silence_is_bounded() {
        let now = Instant::now();
        let mut window = Window::new(1 << 20);
        assert!(!window.on_pong(1, now));
        assert_eq!((0..1000).filter_map(|_| window.ping(now)).count(), PINGS_MAX);
        assert!(window.on_pong(PINGS_MAX as u64, now));
        assert!(window.on_pong(3, now), "an old answer says nothing");
        assert!(window.ping(now).is_some());
    }
}
