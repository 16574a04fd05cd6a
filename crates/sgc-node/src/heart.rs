//! Whether the other end of a link is there: when to ask, when its silence counts, and how rarely a link that carries
//! nothing may be asked without a NAT on the way forgetting it.
//!
//! It is told the time and what was seen, and says what follows; it sends nothing.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

/// How long nothing may come over a link that carries something, or seems dead, before the peer is asked.
const ASK_MIN: Duration = Duration::from_secs(1);
/// The same for one that has long carried nothing: mobile carriers forget UDP after 20 to 30 s.
pub(crate) const ASK_MAX: Duration = Duration::from_secs(15);
/// To where that is shortened if a NAT forgets sooner.
const ASK_FLOOR: Duration = Duration::from_secs(5);
/// A link carries something for so long after the last packet.
const ACTIVE_FOR: Duration = Duration::from_secs(30);
/// How long an answer may take until the link seems dead, at least, at most, and in round trips.
const ANSWER_MIN: Duration = Duration::from_millis(1500);
const ANSWER_MAX: Duration = Duration::from_secs(5);
const ANSWER_RTTS: u32 = 4;
/// How long until it is.
const DEAD_AFTER: Duration = Duration::from_millis(8500);
/// Who did not look for so long was not running, and has missed what came.
const ASLEEP_AFTER: Duration = Duration::from_secs(3);

/// How often a link that carries nothing is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Patience {
    /// At most so long after the last that came.
    pub(crate) max: Duration,
    /// Whether that is shortened where it is too long.
    pub(crate) adapts: bool,
}

impl Default for Patience {
    fn default() -> Self {
        Self { max: ASK_MAX, adapts: true }
    }
}

impl Patience {
    /// What the user set.
    pub(crate) fn fixed(every: Duration) -> Self {
        Self { max: every.max(ASK_MIN), adapts: false }
    }
}

/// Whether packets went over a link since it was looked at last. Written by every task that moves some.
#[derive(Debug, Default)]
pub(crate) struct Activity(AtomicBool);

impl Activity {
    /// One goes.
    pub(crate) fn note(&self) {
        // Mostly it is known already: then nobody else's cache has to hear of it.
        if !self.0.load(Relaxed) {
            self.0.store(true, Relaxed);
        }
    }

    fn take(&self) -> bool {
        self.0.swap(false, Relaxed)
    }
}

/// What is seen of a link at one moment.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen<'a> {
    /// Bytes that have come, whatever they are.
    pub(crate) received_bytes: u64,
    /// Whether packets went.
    pub(crate) activity: &'a Activity,
    /// Where the peer is.
    pub(crate) remote: SocketAddr,
    /// Smoothed round-trip time.
    pub(crate) rtt: Duration,
}

/// What follows.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Verdict {
    /// The peer is to be asked now.
    pub(crate) asks: bool,
    /// Something should have come and did not.
    pub(crate) is_silent: bool,
    /// So long that the link is to end.
    pub(crate) is_dead: bool,
}

/// The pulse of one link.
#[derive(Debug)]
pub(crate) struct Heart {
    patience: Patience,
    /// How long nothing may come before the peer is asked; at most `patience.max`.
    step: Duration,
    received_bytes: u64,
    remote: SocketAddr,
    heard: Instant,
    active: Instant,
    looked: Instant,
    /// The first question since the last that came, and the last one.
    asked: Option<(Instant, Instant)>,
    /// How long it was quiet before the present question or the last one.
    gap: Duration,
}

impl Heart {
    /// A link is up.
    pub(crate) fn new(now: Instant, patience: Patience, received_bytes: u64, remote: SocketAddr) -> Self {
        Self {
            patience,
            step: ASK_MIN,
            received_bytes,
            remote,
            heard: now,
            active: now,
            looked: now,
            asked: None,
            gap: Duration::ZERO,
        }
    }

    /// How long nothing may come before the peer is asked.
    pub(crate) fn step(&self) -> Duration {
        self.step
    }

    /// How long that may grow to be, as far as is known of the way.
    pub(crate) fn patience(&self) -> Patience {
        self.patience
    }

    /// Something is sent that calls for an answer, or for the peer to be there: it is looked at closely.
    pub(crate) fn stir(&mut self) {
        self.step = ASK_MIN;
    }

    /// Looks at it; to be called a few times a second.
    pub(crate) fn look(&mut self, now: Instant, seen: Seen<'_>) -> Verdict {
        if now.saturating_duration_since(self.looked) >= ASLEEP_AFTER {
            // It was this node that was silent.
            (self.asked, self.heard) = (None, now);
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
        let Some((first, last)) = self.asked else {
            if quiet < self.step {
                return Verdict::default();
            }
            (self.asked, self.gap) = (Some((now, now)), quiet);
            return Verdict { asks: true, ..Verdict::default() };
        };
        let waited = now.saturating_duration_since(first);
        let asks = now.saturating_duration_since(last) >= ASK_MIN;
        if asks {
            self.asked = Some((first, now));
        }
        let is_silent = waited >= (ANSWER_RTTS * seen.rtt).clamp(ANSWER_MIN, ANSWER_MAX);
        Verdict { asks, is_silent, is_dead: waited >= DEAD_AFTER }
    }

    /// Something came after it was quiet for so long.
    fn hear(&mut self, now: Instant, quiet: Duration, remote: SocketAddr, is_active: bool) {
        let has_moved = std::mem::replace(&mut self.remote, remote) != remote;
        let asked = self.asked.take();
        // A way that had to be asked more than once lost what came first: something on it had forgotten it.
        let was_lost = asked.is_some_and(|(first, last)| last > first);
        let gap = if asked.is_some() { self.gap } else { quiet };
        if self.patience.adapts && gap >= ASK_FLOOR && (has_moved || was_lost) {
            self.patience.max = self.patience.max.min(gap / 2).max(ASK_FLOOR);
        }
        // It answers: so the next question may come later.
        if asked.is_some() && !was_lost && !is_active {
            self.step = (self.step * 2).min(self.patience.max);
        }
        self.step = self.step.min(self.patience.max);
        self.heard = now;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOOK: Duration = Duration::from_millis(500);

    /// A link, its peer and what lies between, in steps of a look.
    struct Bench {
        now: Instant,
        heart: Heart,
        activity: Activity,
        received: u64,
        remote: SocketAddr,
        /// Whether the peer answers.
        answers: bool,
        /// After how long without a packet the NAT forgets: what the peer sends is lost then, and what leaves gets
        /// another port.
        forgets: Option<Duration>,
        passed: Instant,
        asked: Vec<Instant>,
        verdict: Verdict,
    }

    impl Bench {
        fn new(patience: Patience) -> Self {
            let (now, remote) = (Instant::now(), SocketAddr::from(([10, 0, 0, 1], 1000)));
            let heart = Heart::new(now, patience, 0, remote);
            Self {
                now,
                heart,
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
            let seen = Seen {
                received_bytes: self.received,
                activity: &self.activity,
                remote: self.remote,
                rtt: Duration::from_millis(40),
            };
            self.verdict = self.heart.look(self.now, seen);
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

        /// Looks until it is so, and how many seconds that took.
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
    fn questions_become_rare_when_nothing_flows_and_frequent_when_something_does() {
        let mut bench = Bench::new(Patience::default());
        bench.run(30);
        assert!(bench.last_wait() <= 2.0 && bench.asked.len() >= 15, "{}", bench.asked.len());
        bench.run(120);
        assert!((15.0..=16.0).contains(&bench.last_wait()), "{}", bench.last_wait());
        bench.activity.note();
        let before = bench.asked.len();
        bench.run(10);
        assert!(bench.asked.len() >= before + 5, "{before} {}", bench.asked.len());
        // Whoever hears something need not ask.
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
        let mut bench = Bench::new(Patience::default());
        bench.run(10);
        bench.answers = false;
        assert!((2.0..=3.5).contains(&bench.until(|v| v.is_silent)));
        assert!((6.0..=8.0).contains(&bench.until(|v| v.is_dead)));
        // And one that has carried nothing for long, as soon as something is to go over it.
        let mut bench = Bench::new(Patience::default());
        bench.run(200);
        bench.answers = false;
        bench.activity.note();
        assert!(bench.until(|v| v.is_silent) <= 3.5);
        let mut bench = Bench::new(Patience::default());
        bench.run(200);
        bench.answers = false;
        bench.heart.stir();
        // An answer under way may still make it patient once.
        assert!(bench.until(|v| v.is_silent) <= 4.5);
        // Otherwise when it is asked again.
        let mut bench = Bench::new(Patience::default());
        bench.run(200);
        bench.answers = false;
        assert!(bench.until(|v| v.is_silent) <= 18.0);
        bench.answers = true;
        bench.run(2);
        assert_eq!(bench.verdict, Verdict::default());
    }

    #[test]
    fn a_nat_that_forgets_is_learnt_of_once() {
        for (forgets, most) in [(12, 7.5), (10, 7.5), (6, 5.0), (60, 15.0)] {
            let mut bench = Bench::new(Patience::default());
            bench.forgets = Some(Duration::from_secs(forgets));
            bench.run(300);
            let port = bench.remote.port();
            assert!(
                bench.heart.patience().max.as_secs_f64() <= most,
                "{forgets}: {:?}",
                bench.heart.patience()
            );
            assert!(port <= 1002, "{forgets}: {port}");
            bench.run(300);
            assert_eq!(bench.remote.port(), port, "{forgets}");
            assert!(bench.last_wait() <= most + 1.0 && bench.last_wait() >= 5.0, "{}", bench.last_wait());
        }
    }

    #[test]
    fn what_the_user_set_stays() {
        let mut bench = Bench::new(Patience::fixed(Duration::from_secs(10)));
        bench.forgets = Some(Duration::from_secs(8));
        bench.run(300);
        assert!((10.0..=11.0).contains(&bench.last_wait()), "{}", bench.last_wait());
        assert_eq!(Patience::fixed(Duration::ZERO).max, ASK_MIN);
    }

    #[test]
    fn who_was_stopped_itself_takes_nobody_for_dead() {
        let mut bench = Bench::new(Patience::default());
        bench.answers = false;
        bench.until(|v| v.is_silent);
        bench.now += Duration::from_secs(60);
        bench.look();
        assert_eq!(bench.verdict, Verdict::default());
        bench.until(|v| v.is_dead);
    }

    #[test]
    fn a_long_way_is_given_time() {
        let mut bench = Bench::new(Patience::default());
        let seen = |rtt| Seen {
            received_bytes: 0,
            activity: &bench.activity,
            remote: bench.remote,
            rtt: Duration::from_millis(rtt),
        };
        let silent = |rtt| {
            let mut heart = Heart::new(bench.now, Patience::default(), 0, bench.remote);
            (1..).find(|n| heart.look(bench.now + LOOK * *n, seen(rtt)).is_silent)
        };
        assert_eq!((silent(1), silent(700), silent(60_000)), (Some(5), Some(8), Some(12)));
        bench.run(1);
    }
}
