//! Keep-alive of one link: decides when to probe the peer, when its silence counts, and how rarely an idle link may be
//! probed without a NAT on the path forgetting it.
//!
//! The caller passes in the time and its observations and carries out the verdict. This module sends nothing.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// Longest silence on an active or suspect link before the peer is probed.
const ASK_MIN: Duration = Duration::from_secs(1);
/// Longest silence on a link that has been idle for long. Mobile carriers forget UDP mappings after 20 to 30 s.
pub const ASK_MAX: Duration = Duration::from_secs(15);
/// Lower bound of the interval when a NAT forgets sooner than that.
const ASK_FLOOR: Duration = Duration::from_secs(5);
/// Time after the last packet during which a link counts as active.
const ACTIVE_FOR: Duration = Duration::from_secs(30);
/// Time for an answer before the link counts as silent: lower bound, upper bound, and multiple of the round-trip time.
const ANSWER_MIN: Duration = Duration::from_millis(1500);
/// The same lower bound for a direct link, beside which there is the path over routers.
const DIRECT_ANSWER_MIN: Duration = Duration::from_secs(1);
const ANSWER_MAX: Duration = Duration::from_secs(5);
const ANSWER_RTTS: u32 = 4;
/// Time for an answer before the link counts as dead.
const DEAD_AFTER: Duration = Duration::from_millis(8500);
/// A gap this long between two looks means that this node was suspended and has missed packets.
const ASLEEP_AFTER: Duration = Duration::from_secs(3);

/// Longest interval between probes on an idle link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeepAlivePolicy {
    /// Upper bound of the silence before a probe.
    pub max: Duration,
    /// Whether the bound shrinks when a NAT turns out to forget sooner.
    pub adapts: bool,
}

impl Default for KeepAlivePolicy {
    fn default() -> Self {
        Self { max: ASK_MAX, adapts: true }
    }
}

impl KeepAlivePolicy {
    /// Returns the policy for an interval that the user configured.
    pub fn fixed(every: Duration) -> Self {
        Self { max: every.max(ASK_MIN), adapts: false }
    }
}

/// Flag that packets crossed a link since the last look. Every task that moves packets sets it.
#[derive(Debug, Default)]
pub struct Activity(AtomicBool);

impl Activity {
    /// Notes that a packet crosses the link.
    pub fn note(&self) {
        // The flag is usually set already. Reading first avoids invalidating the cache line of other cores.
        if !self.0.load(Relaxed) {
            self.0.store(true, Relaxed);
        }
    }

    fn take(&self) -> bool {
        self.0.swap(false, Relaxed)
    }
}

/// State of a link at one moment.
#[derive(Clone, Copy, Debug)]
pub struct LinkObservation<'a> {
    /// Bytes received so far, of any kind.
    pub received_bytes: u64,
    /// Flag of packets that crossed the link.
    pub activity: &'a Activity,
    /// Current address of the peer.
    pub remote: SocketAddr,
    /// Smoothed round-trip time.
    pub rtt: Duration,
}

/// Decision after one look at a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Verdict {
    /// The peer is to be probed now.
    pub asks: bool,
    /// The meaning of its silence.
    pub peer: PeerState,
}

impl Verdict {
    /// Returns `true` if an answer is overdue.
    pub fn is_silent(&self) -> bool {
        self.peer >= PeerState::Silent
    }

    /// Returns `true` if the link ends.
    pub fn is_dead(&self) -> bool {
        self.peer == PeerState::Dead
    }
}

/// State of the peer by its silence.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum PeerState {
    /// No answer is overdue.
    #[default]
    Alive,
    /// An answer is overdue.
    Silent,
    /// The answer is overdue for so long that the link ends.
    Dead,
}

/// The event for which the link waits.
#[derive(Clone, Copy, Debug)]
enum Waiting {
    /// For the time of the next probe.
    ToAsk,
    /// For an answer.
    ForAnswer {
        /// Times of the first and the last probe since something was last received.
        first: Instant,
        last: Instant,
        /// Silence before the first.
        gap: Duration,
    },
}

/// Keep-alive state of one link.
#[derive(Debug)]
pub struct KeepAlive {
    policy: KeepAlivePolicy,
    /// Shortest time for an answer.
    answer_min: Duration,
    /// Silence before the next probe, at most `policy.max`.
    step: Duration,
    received_bytes: u64,
    remote: SocketAddr,
    heard: Instant,
    active: Instant,
    looked: Instant,
    waiting: Waiting,
}

impl KeepAlive {
    /// Starts the keep-alive of a link that is up.
    pub fn new(now: Instant, policy: KeepAlivePolicy, received_bytes: u64, remote: SocketAddr) -> Self {
        Self {
            policy,
            answer_min: ANSWER_MIN,
            step: ASK_MIN,
            received_bytes,
            remote,
            heard: now,
            active: now,
            looked: now,
            waiting: Waiting::ToAsk,
        }
    }

    /// Notes that this is a direct link: while it is in doubt, routers have another path.
    pub fn set_direct(&mut self) {
        self.answer_min = DIRECT_ANSWER_MIN;
    }

    /// Returns the silence after which the peer is probed.
    pub fn step(&self) -> Duration {
        self.step
    }

    /// Returns the policy, with the bound that the path has shown to bear.
    pub fn policy(&self) -> KeepAlivePolicy {
        self.policy
    }

    /// Shortens the interval, because a frame is sent that expects an answer or a live peer.
    pub fn stir(&mut self) {
        self.step = ASK_MIN;
    }

    /// Observes the link. The caller calls this a few times a second.
    pub fn look(&mut self, now: Instant, seen: LinkObservation<'_>) -> Verdict {
        if now.saturating_duration_since(self.looked) >= ASLEEP_AFTER {
            // This node was suspended, so its own silence counts for nothing.
            (self.waiting, self.heard) = (Waiting::ToAsk, now);
        }
        self.looked = now;
        if seen.activity.take() {
            self.active = now;
        }
        let is_active = now.saturating_duration_since(self.active) < ACTIVE_FOR;
        if is_active {
            self.step = ASK_MIN;
        }
        let quiet = now.saturating_duration_since(self.heard);
        if seen.received_bytes != self.received_bytes {
            self.received_bytes = seen.received_bytes;
            self.hear(now, quiet, seen.remote, is_active);
            return Verdict::default();
        }
        match &mut self.waiting {
            Waiting::ToAsk => {
                let asks = quiet >= self.step;
                if asks {
                    self.waiting = Waiting::ForAnswer { first: now, last: now, gap: quiet };
                }
                Verdict { asks, peer: PeerState::Alive }
            }
            Waiting::ForAnswer { first, last, .. } => {
                let asks = now.saturating_duration_since(*last) >= ASK_MIN;
                if asks {
                    *last = now;
                }
                let answer_max = (ANSWER_RTTS * seen.rtt).clamp(self.answer_min, ANSWER_MAX);
                let peer = match now.saturating_duration_since(*first) {
                    waited if waited >= DEAD_AFTER => PeerState::Dead,
                    waited if waited >= answer_max => PeerState::Silent,
                    _ => PeerState::Alive,
                };
                Verdict { asks, peer }
            }
        }
    }

    /// Handles a receipt after `quiet` of silence.
    fn hear(&mut self, now: Instant, quiet: Duration, remote: SocketAddr, is_active: bool) {
        let has_moved = std::mem::replace(&mut self.remote, remote) != remote;
        let (was_asked, was_lost, gap) = match std::mem::replace(&mut self.waiting, Waiting::ToAsk) {
            Waiting::ToAsk => (false, false, quiet),
            // A path that needed several probes lost the first one, because a NAT on it had forgotten the mapping.
            Waiting::ForAnswer { first, last, gap } => (true, last > first, gap),
        };
        if self.policy.adapts && gap >= ASK_FLOOR && (has_moved || was_lost) {
            self.policy.max = self.policy.max.min(gap / 2).max(ASK_FLOOR);
        }
        // The peer answers, so the next probe may come later.
        if was_asked && !was_lost && !is_active {
            self.step = (self.step * 2).min(self.policy.max);
        }
        self.step = self.step.min(self.policy.max);
        self.heard = now;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use super::*;

    const LOOK: Duration = Duration::from_millis(500);

    /// Simulates a link, its peer and the path between them, in steps of one look.
    struct Bench {
        now: Instant,
        keep_alive: KeepAlive,
        activity: Activity,
        received: u64,
        remote: SocketAddr,
        /// Whether the peer answers.
        answers: bool,
        /// Idle time after which the NAT forgets the mapping. It then loses packets of the peer, and packets to the
        /// peer leave from another port.
        forgets: Option<Duration>,
        passed: Instant,
        asked: Vec<Instant>,
        verdict: Verdict,
    }

    impl Bench {
        fn new(policy: KeepAlivePolicy) -> Self {
            let (now, remote) = (Instant::now(), SocketAddr::from(([10, 0, 0, 1], 1000)));
            let keep_alive = KeepAlive::new(now, policy, 0, remote);
            Self {
                now,
                keep_alive,
                activity: Activity::default(),
                received: 0,
                remote,
                answers: true,
                forgets: None,
                passed: now,
                asked: vec![],
                verdict: Verdict::default(),
            }
        }

        fn look(&mut self) {
            self.now += LOOK;
            let seen = LinkObservation {
                received_bytes: self.received,
                activity: &self.activity,
                remote: self.remote,
                rtt: Duration::from_millis(40),
            };
            self.verdict = self.keep_alive.look(self.now, seen);
            if !self.verdict.asks {
                return;
            }
            self.asked.push(self.now);
            if self.forgets.is_some_and(|after| self.now - self.passed >= after) {
                self.remote.set_port(self.remote.port() + 1);
            }
            self.passed = self.now;
            self.received += u64::from(self.answers);
        }

        fn run(&mut self, seconds: u64) {
            (0..2 * seconds).for_each(|_| self.look());
        }

        /// Seconds between the last two questions.
        fn last_wait(&self) -> f64 {
            let [.., before, last] = self.asked[..] else { panic!("{:?}", self.asked) };
            (last - before).as_secs_f64()
        }

        /// Looks until the verdict satisfies `is_so`, and returns the seconds that took.
        fn until(&mut self, is_so: impl Fn(Verdict) -> bool) -> f64 {
            let start = self.now;
            while !is_so(self.verdict) {
                self.look();
                assert!(self.now - start < Duration::from_secs(60), "never");
            }
            (self.now - start).as_secs_f64()
        }
    }

    #[test]
    fn direct_link_is_in_doubt_sooner_than_one_without_an_alternative() {
        let silent_after = |is_direct: bool| {
            let mut bench = Bench::new(KeepAlivePolicy::default());
            if is_direct {
                bench.keep_alive.set_direct();
            }
            bench.run(10);
            bench.answers = false;
            bench.activity.note();
            let begun = bench.now;
            while !bench.verdict.is_silent() {
                bench.look();
            }
            bench.now - begun
        };
        assert_eq!((silent_after(true), silent_after(false)), (5 * LOOK, 6 * LOOK));
    }

    #[test]
    fn questions_become_rare_when_nothing_flows_and_frequent_when_something_does() {
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.run(30);
        assert!(bench.last_wait() <= 2.0 && bench.asked.len() >= 15, "{}", bench.asked.len());
        bench.run(120);
        assert!((15.0..=16.0).contains(&bench.last_wait()), "{}", bench.last_wait());
        bench.activity.note();
        let before = bench.asked.len();
        bench.run(10);
        assert!(bench.asked.len() >= before + 5, "{before} {}", bench.asked.len());
        // A peer that sends need not be probed.
        let before = bench.asked.len();
        for _ in 0..100 {
            bench.received += 1;
            bench.activity.note();
            bench.look();
        }
        assert_eq!(bench.asked.len(), before);
    }

    #[test]
    fn a_dead_peer_is_noticed_in_three_seconds_while_something_flows() {
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.run(10);
        bench.answers = false;
        assert!((2.0..=3.5).contains(&bench.until(|v| v.is_silent())));
        assert!((6.0..=8.0).contains(&bench.until(|v| v.is_dead())));
        // A link that was idle for long notices it as soon as a packet is to cross it.
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.run(200);
        bench.answers = false;
        bench.activity.note();
        assert!(bench.until(|v| v.is_silent()) <= 3.5);
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.run(200);
        bench.answers = false;
        bench.keep_alive.stir();
        // An answer under way may extend the interval once more.
        assert!(bench.until(|v| v.is_silent()) <= 4.5);
        // An idle link notices it at its next probe.
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.run(200);
        bench.answers = false;
        assert!(bench.until(|v| v.is_silent()) <= 18.0);
        bench.answers = true;
        bench.run(2);
        assert_eq!(bench.verdict, Verdict::default());
    }

    #[test]
    fn a_nat_that_forgets_is_learnt_of_once() {
        for (forgets, most) in [(12, 7.5), (10, 7.5), (6, 5.0), (60, 15.0)] {
            let mut bench = Bench::new(KeepAlivePolicy::default());
            bench.forgets = Some(Duration::from_secs(forgets));
            bench.run(300);
            let port = bench.remote.port();
            assert!(
                bench.keep_alive.policy().max.as_secs_f64() <= most,
                "{forgets}: {:?}",
                bench.keep_alive.policy()
            );
            assert!(port <= 1002, "{forgets}: {port}");
            bench.run(300);
            assert_eq!(bench.remote.port(), port, "{forgets}");
            assert!(bench.last_wait() <= most + 1.0 && bench.last_wait() >= 5.0, "{}", bench.last_wait());
        }
    }

    #[test]
    fn configured_interval_does_not_adapt() {
        let mut bench = Bench::new(KeepAlivePolicy::fixed(Duration::from_secs(10)));
        bench.forgets = Some(Duration::from_secs(8));
        bench.run(300);
        assert!((10.0..=11.0).contains(&bench.last_wait()), "{}", bench.last_wait());
        assert_eq!(KeepAlivePolicy::fixed(Duration::ZERO).max, ASK_MIN);
    }

    #[test]
    fn suspended_node_takes_no_peer_for_dead() {
        let mut bench = Bench::new(KeepAlivePolicy::default());
        bench.answers = false;
        bench.until(|v| v.is_silent());
        bench.now += Duration::from_secs(60);
        bench.look();
        assert_eq!(bench.verdict, Verdict::default());
        bench.until(|v| v.is_dead());
    }

    #[test]
    fn a_long_way_is_given_time() {
        let mut bench = Bench::new(KeepAlivePolicy::default());
        let seen = |rtt| LinkObservation {
            received_bytes: 0,
            activity: &bench.activity,
            remote: bench.remote,
            rtt: Duration::from_millis(rtt),
        };
        let silent = |rtt| {
            let mut keep_alive = KeepAlive::new(bench.now, KeepAlivePolicy::default(), 0, bench.remote);
            (1..).find(|n| keep_alive.look(bench.now + LOOK * *n, seen(rtt)).is_silent())
        };
        assert_eq!((silent(1), silent(700), silent(60_000)), (Some(5), Some(8), Some(12)));
        bench.run(1);
    }
}
