//! [`DeadMan`]: the dead-man switch of a topic of commands, at the node beside the robot.
//!
//! It decides which commands pass and when the stop message is due. Commands pass while each comes in time. If none did
//! for `after`, the stop message is due, and from then on no command passes until its publisher has shown that somebody
//! let go and began again.
//!
//! A command is late by the time that it took longer than the fastest command of its source. Clocks of hosts differ, so
//! the delay itself is unknown. The arrival is read from a monotonic clock; a publisher's clock that is set back makes its
//! commands late, and one that is set forward does not. The first commands of a source may be those that waited during an
//! outage, each faster than the one before, so a source is only believed once it has been heard for `after` without a gap.
//! If the clock of the publisher's node is known ([`crate::PeerClocks`]), a command is also late if it is older than that by
//! its time stamp. Without that clock, nothing shows that commands are late if all commands of a publisher were, from its
//! first on.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_ros::{DeadManRule, Resume};
use sgc_wire::SourceId;

use crate::clocks::DRIFT_DIVISOR;

/// Most sources that are remembered.
const SOURCES_MAX: usize = 128;

/// The facts of a command by which the switch judges it.
#[derive(Clone, Copy, Debug)]
pub struct Command {
    /// The source.
    pub source: SourceId,
    /// The number at its source, from 1.
    pub seq: u64,
    /// The publisher's time stamp in ns since 1970; 0 if there is none.
    pub stamp_ns: i64,
    /// Its age in ns at least, by the clock of the publisher's node; `None` while that clock is not known.
    pub least_age: Option<i64>,
    /// Whether it is the stop message.
    pub is_stop: bool,
}

/// Why a command does not pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CommandRefusal {
    /// It came late.
    Late,
    /// Whether it is late cannot be known: it has no time stamp, or its source is too new.
    Unjudged,
    /// The robot was stopped, and nobody let go and began again.
    NotResumed,
}

/// Why the stop message was published.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StopCause {
    /// The switch is new: what the robot was told before is unknown.
    Start,
    /// No command came.
    Silence,
    /// Commands came late.
    Late,
    /// The last local writer of the topic closes.
    Closed,
}

/// The dead-man switch of one topic.
#[derive(Debug)]
pub struct DeadMan {
    after: Duration,
    repeat: Option<Duration>,
    resume: Resume,
    /// The beginning of the time in which arrivals are counted.
    origin: Instant,
    sources: BTreeMap<SourceId, Stream>,
    state: State,
}

#[derive(Clone, Copy, Debug)]
enum State {
    /// Commands pass. The last one came then; `late` says whether another came too late since.
    Moving { last: Instant, late: bool },
    /// The stop message is due then, for the first time or again. `is_told` says whether it was published.
    Stopped { cause: StopCause, since: Instant, due: Option<Instant>, is_told: bool, is_resumed: bool },
}

impl State {
    fn stopped(cause: StopCause, since: Instant) -> Self {
        Self::Stopped { cause, since, due: Some(since), is_told: false, is_resumed: false }
    }
}

/// The last command of a source, and its fastest.
#[derive(Clone, Copy, Debug)]
struct Stream {
    /// Number and time stamp of the last command.
    seq: u64,
    stamp_ns: i64,
    /// Least time from stamp to arrival, by the clocks of both hosts, and when it was measured.
    least_ns: i64,
    measured: Instant,
    /// When it began to be heard without a gap, and when it was heard last.
    begun: Instant,
    heard: Instant,
    /// Whether it was heard for long enough to know how long commands take.
    is_believed: bool,
    /// Whether the publisher let go and began again since the robot was stopped.
    has_let_go: bool,
}

/// How late a command is.
enum Lateness {
    InTime,
    Late,
    Unknown,
}

impl DeadMan {
    /// Creates a switch that stops the robot at once.
    pub fn new(rule: &DeadManRule, now: Instant) -> Self {
        let state = State::stopped(StopCause::Start, now);
        let DeadManRule { after, repeat, resume, .. } = *rule;
        Self { after, repeat, resume, origin: now, sources: BTreeMap::new(), state }
    }

    /// Continues under another rule. A stopped robot stays so.
    pub fn set(&mut self, rule: &DeadManRule) {
        (self.after, self.repeat, self.resume) = (rule.after, rule.repeat, rule.resume);
    }

    /// Judges a command that came.
    ///
    /// # Errors
    /// The command must not reach the robot.
    pub fn judge(&mut self, now: Instant, command: Command) -> Result<(), CommandRefusal> {
        self.tick_state(now);
        let (lateness, has_let_go) = self.note(now, &command);
        match (lateness, &mut self.state) {
            (Lateness::Late, State::Moving { late, .. }) => {
                *late = true;
                return Err(CommandRefusal::Late);
            }
            (Lateness::Late, State::Stopped { .. }) => return Err(CommandRefusal::Late),
            (Lateness::Unknown, _) => return Err(CommandRefusal::Unjudged),
            // A robot that cannot be stopped must not begin to move.
            (Lateness::InTime, State::Stopped { is_told, is_resumed, .. })
                if !*is_told || !(*is_resumed || self.resume == Resume::Auto && has_let_go) =>
            {
                return Err(CommandRefusal::NotResumed);
            }
            (Lateness::InTime, _) => {}
        }
        self.state = State::Moving { last: now, late: false };
        Ok(())
    }

    /// Returns whether the stop message is to be published now. It then counts as published.
    pub fn tick(&mut self, now: Instant) -> bool {
        self.tick_state(now);
        match &mut self.state {
            State::Stopped { due, is_told, .. } if due.is_some_and(|due| due <= now) => {
                (*due, *is_told) = (self.repeat.map(|repeat| now + repeat), true);
                true
            }
            _ => false,
        }
    }

    /// Stops the robot at once, because its last writer closes. Returns whether the stop message is to be published.
    pub fn close(&mut self, now: Instant) -> bool {
        let is_moving = matches!(self.state, State::Moving { .. });
        if is_moving {
            self.stop(now, StopCause::Closed);
        }
        self.tick(now) && is_moving
    }

    /// Notes that the stop message could not be published. It is due again then, and no command passes before.
    pub fn not_published(&mut self, again: Instant) {
        if let State::Stopped { due, is_told, .. } = &mut self.state {
            (*due, *is_told) = (Some(again), false);
        }
    }

    /// Has a stop message that waits published at once, because what it lacked may be there now.
    pub fn try_again(&mut self, now: Instant) {
        if let State::Stopped { due: Some(due), .. } = &mut self.state {
            *due = (*due).min(now);
        }
    }

    /// Lets the next command in time pass, because the operator said so. Delays are measured anew, since a clock may have
    /// been set. Returns `false` if the robot is not stopped.
    pub fn resume(&mut self) -> bool {
        let State::Stopped { is_resumed, .. } = &mut self.state else { return false };
        *is_resumed = true;
        self.sources.clear();
        true
    }

    /// Returns when [`Self::tick`] has something to do.
    pub fn due(&self) -> Option<Instant> {
        match self.state {
            State::Moving { last, .. } => Some(last + self.after),
            State::Stopped { due, .. } => due,
        }
    }

    /// Returns why and since when the robot is stopped, or `None`.
    pub fn stopped(&self) -> Option<(StopCause, Instant)> {
        match self.state {
            State::Moving { .. } => None,
            State::Stopped { cause, since, .. } => Some((cause, since)),
        }
    }

    fn tick_state(&mut self, now: Instant) {
        if let State::Moving { last, late } = self.state
            && now >= last + self.after
        {
            self.stop(now, if late { StopCause::Late } else { StopCause::Silence });
        }
    }

    fn stop(&mut self, now: Instant, cause: StopCause) {
        self.state = State::stopped(cause, now);
        self.sources.values_mut().for_each(|stream| stream.has_let_go = false);
    }

    /// Notes a command of a source. Returns how late it is, and whether its publisher let go since the stop.
    fn note(&mut self, now: Instant, command: &Command) -> (Lateness, bool) {
        if command.stamp_ns <= 0 {
            return (Lateness::Unknown, false);
        }
        let since_origin = nanos(now.saturating_duration_since(self.origin));
        let took = since_origin.saturating_sub(command.stamp_ns);
        let after = self.after;
        let before = self.sources.get(&command.source).copied();
        if before.is_none() {
            self.make_room();
        }
        let stream = self.sources.entry(command.source).or_insert(Stream {
            seq: 0,
            stamp_ns: command.stamp_ns,
            least_ns: took,
            measured: now,
            begun: now,
            heard: now,
            is_believed: false,
            has_let_go: false,
        });
        if !stream.is_believed && now >= stream.heard + after {
            // Those before may have waited, all of them.
            (stream.begun, stream.measured, stream.least_ns) = (now, now, took);
        }
        stream.is_believed |= now >= stream.begun + after;
        let drift = nanos(now.saturating_duration_since(stream.measured)) / DRIFT_DIVISOR;
        let least = stream.least_ns.saturating_add(drift);
        if took <= least {
            (stream.least_ns, stream.measured) = (took, now);
        }
        let late_ns = took.saturating_sub(least).max(0);
        let is_old = command.least_age.is_some_and(|age| age > nanos(after));
        let is_late = is_old || late_ns > nanos(after);
        // Lost commands are no pause, so the command before this one must have come. A publisher's clock that is set
        // forward is none either, so the pause must show in the arrivals as well.
        let pause_ns = command.stamp_ns.saturating_sub(stream.stamp_ns);
        let paused = command.seq == stream.seq + 1 && pause_ns >= nanos(after) && now >= stream.heard + after;
        let begins = match before {
            None => command.seq == 1,
            Some(_) => paused,
        };
        stream.has_let_go |= !is_late && (begins || command.is_stop);
        if command.seq > stream.seq {
            (stream.seq, stream.stamp_ns) = (command.seq, command.stamp_ns);
        }
        stream.heard = now;
        let lateness = match (is_late, stream.is_believed) {
            (true, _) => Lateness::Late,
            (false, false) => Lateness::Unknown,
            (false, true) => Lateness::InTime,
        };
        (lateness, stream.has_let_go)
    }

    /// Forgets the source that was silent for longest, if there are too many.
    fn make_room(&mut self) {
        if self.sources.len() >= SOURCES_MAX
            && let Some(oldest) =
                self.sources.iter().min_by_key(|(_, stream)| stream.heard).map(|(id, _)| *id)
        {
            self.sources.remove(&oldest);
        }
    }
}

fn nanos(time: Duration) -> i64 {
    i64::try_from(time.as_nanos()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_chacha::ChaCha8Rng;
    use rand_core::{RngCore, SeedableRng};
    use sgc_ros::StopMessage;

    use super::*;

    const AFTER: Duration = Duration::from_millis(300);
    const PUBLISHER: SourceId = SourceId([1; 16]);

    fn rule(resume: Resume, repeat: Option<Duration>) -> DeadManRule {
        DeadManRule { after: AFTER, stop: StopMessage::Zero, repeat, resume }
    }

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    /// A switch with a publisher that publishes each 20 ms from `at` on, and whose clock is far ahead.
    struct Bench {
        switch: DeadMan,
        begin: Instant,
        seq: u64,
    }

    impl Bench {
        fn new(resume: Resume, repeat: Option<Duration>) -> Self {
            let begin = Instant::now();
            Self { switch: DeadMan::new(&rule(resume, repeat), begin), begin, seq: 0 }
        }

        fn at(&self, ms: u64) -> Instant {
            self.begin + Duration::from_millis(ms)
        }

        /// Judges a command that was published and came at these times.
        fn command(&mut self, published: u64, came: u64, is_stop: bool) -> Result<(), CommandRefusal> {
            self.switch.tick(self.at(came));
            self.seq += 1;
            let stamp_ns = 1_000_000_000_000_000_000 + published as i64 * 1_000_000;
            let command = Command { source: PUBLISHER, seq: self.seq, stamp_ns, least_age: None, is_stop };
            self.switch.judge(self.at(came), command)
        }

        /// Judges commands of each 20 ms that come after 10 ms, and returns how many passed.
        fn commands(&mut self, times: std::ops::Range<u64>) -> usize {
            times.step_by(20).filter(|at| self.command(*at, at + 10, false).is_ok()).count()
        }

        /// Returns whether the stop message is due at this time.
        fn tick(&mut self, at: u64) -> bool {
            self.switch.tick(self.at(at))
        }

        fn cause(&self) -> Option<StopCause> {
            self.switch.stopped().map(|(cause, _)| cause)
        }
    }

    #[test]
    fn a_new_switch_stops_the_robot_once() {
        let mut bench = Bench::new(Resume::Auto, None);
        assert_eq!((bench.tick(0), bench.tick(0), bench.tick(10_000)), (true, false, false));
        assert_eq!((bench.cause(), bench.switch.due()), (Some(StopCause::Start), None));
        bench.switch.not_published(bench.at(11_000));
        assert_eq!((bench.tick(10_999), bench.tick(11_000), bench.tick(12_000)), (false, true, false));
    }

    #[test]
    fn no_command_passes_until_the_stop_message_could_be_published() {
        let mut bench = Bench::new(Resume::Auto, None);
        assert!(bench.tick(0));
        bench.switch.not_published(bench.at(1000));
        assert_eq!(bench.commands(0..980), 0);
        assert_eq!(bench.command(980, 990, false), Err(CommandRefusal::NotResumed));
        assert!(bench.switch.resume());
        bench.switch.try_again(bench.at(995));
        assert!(bench.tick(995));
        // Delays are measured anew.
        assert_eq!(bench.commands(1000..1400), 5);
    }

    #[test]
    fn a_new_publisher_is_believed_after_a_while() {
        let mut bench = Bench::new(Resume::Auto, None);
        assert!(bench.tick(0));
        assert_eq!(bench.command(0, 10, false), Err(CommandRefusal::Unjudged));
        assert_eq!(bench.commands(20..300), 0);
        assert_eq!(bench.commands(300..1000), 35);
        assert_eq!(bench.cause(), None);
    }

    #[test]
    fn a_publisher_that_was_there_before_the_switch_has_to_let_go() {
        let mut bench = Bench::new(Resume::Auto, None);
        bench.seq = 70;
        assert_eq!(bench.commands(0..2000), 0);
        assert_eq!(bench.command(2000, 2010, false), Err(CommandRefusal::NotResumed));
        assert_eq!(bench.commands(2301..3000), 35);
    }

    #[test]
    fn silence_stops_the_robot_and_the_stop_message_is_repeated() {
        let mut bench = Bench::new(Resume::Auto, Some(ms(100)));
        bench.commands(0..1000);
        // The last command came at 990.
        assert_eq!((bench.tick(1289), bench.switch.due()), (false, Some(bench.at(1290))));
        assert_eq!([1290, 1291, 1390, 1490].map(|at| bench.tick(at)), [true, false, true, true]);
        assert_eq!(bench.cause(), Some(StopCause::Silence));
        // Commands of a publisher that paused pass again, and the stop message is repeated no more.
        assert_eq!(bench.commands(1500..1600), 5);
        assert!(!bench.tick(1601));
    }

    #[test]
    fn late_commands_do_not_move_the_robot() {
        let mut bench = Bench::new(Resume::Auto, None);
        bench.commands(0..1000);
        // The path stands still for two seconds, and then all come at once.
        assert!(bench.tick(1300));
        let refused = (1000..3000).step_by(20).filter(|at| bench.command(*at, 3010, false).is_err()).count();
        assert_eq!(refused, 100);
        // The publisher was never quiet, so its commands pass only after it let go.
        assert_eq!(bench.commands(3000..4000), 0);
        assert_eq!(bench.command(4000, 4010, false), Err(CommandRefusal::NotResumed));
        assert_eq!(bench.commands(4320..4400), 4);
        // Commands that come later and later stop it, too.
        let passed = (0..45).filter(|n| bench.command(4400 + 20 * n, 4410 + 30 * n, false).is_ok()).count();
        assert_eq!((passed, bench.cause()), (31, Some(StopCause::Late)));
    }

    #[test]
    fn lost_commands_are_no_pause() {
        let mut bench = Bench::new(Resume::Auto, None);
        bench.commands(0..1000);
        assert!(bench.tick(1300));
        bench.seq += 50;
        assert_eq!(bench.commands(2000..3000), 0);
    }

    #[test]
    fn the_stop_message_of_the_publisher_shows_that_it_let_go() {
        let mut bench = Bench::new(Resume::Auto, None);
        bench.commands(0..1000);
        bench.seq += 50;
        assert!(bench.tick(1300));
        assert_eq!(bench.command(2000, 2010, false), Err(CommandRefusal::NotResumed));
        assert_eq!(bench.command(2020, 2030, true), Ok(()));
        assert_eq!(bench.commands(2040..2100), 3);
    }

    #[test]
    fn a_stop_ends_by_hand_alone_if_the_rule_says_so() {
        let mut bench = Bench::new(Resume::Manual, None);
        assert_eq!(bench.commands(0..1000), 0);
        assert!(bench.switch.resume());
        // Delays are measured anew.
        assert_eq!(bench.commands(1000..1300), 0);
        assert_eq!(bench.commands(1300..1400), 5);
        assert!(!bench.switch.resume(), "it is not stopped");
        assert!(bench.tick(1800));
        assert_eq!(bench.commands(3000..4000), 0, "each stop needs it again");
    }

    #[test]
    fn a_publisher_s_clock_may_be_set_forward_and_drift() {
        let mut bench = Bench::new(Resume::Auto, None);
        bench.commands(0..1000);
        // Its clock runs slow by 100 ppm for a day, which adds up to more than eight seconds.
        let mut passed = 0;
        for at in (1000..86_400_000).step_by(200) {
            passed += usize::from(bench.command(at - at / 10_000, at + 10, false).is_ok());
        }
        assert_eq!(passed, 431_995);
        // It is set forward by an hour.
        let at = 86_400_000;
        assert_eq!(bench.command(at + 3_600_000, at + 10, false), Ok(()));
        assert_eq!(bench.command(at + 3_600_020, at + 30, false), Ok(()));
    }

    #[test]
    fn commands_without_a_time_do_not_pass() {
        let mut switch = DeadMan::new(&rule(Resume::Auto, None), Instant::now());
        let command = Command { source: PUBLISHER, seq: 1, stamp_ns: 0, least_age: None, is_stop: true };
        assert_eq!(switch.judge(Instant::now(), command), Err(CommandRefusal::Unjudged));
    }

    #[test]
    fn commands_that_are_old_by_a_known_clock_never_pass() {
        let mut bench = Bench::new(Resume::Auto, None);
        assert!(bench.tick(0));
        let mut command = |at: u64, least_age_ms: i64| {
            bench.switch.tick(bench.begin + ms(at));
            bench.seq += 1;
            let (seq, stamp_ns) = (bench.seq, 1_000_000_000_000_000_000 + at as i64 * 1_000_000);
            let least_age = Some(least_age_ms * 1_000_000);
            let command = Command { source: PUBLISHER, seq, stamp_ns, least_age, is_stop: false };
            bench.switch.judge(bench.begin + ms(at), command)
        };
        // All took equally long from the first on.
        for at in (0..1000).step_by(20) {
            assert_eq!(command(at, 301), Err(CommandRefusal::Late));
        }
        // So did these, and not too long. Somebody let go before.
        assert_eq!(command(1400, 300), Ok(()));
        assert_eq!(command(1420, -5), Ok(()));
        assert_eq!(command(1440, 301), Err(CommandRefusal::Late));
    }

    #[test]
    fn the_end_of_the_last_writer_stops_a_moving_robot() {
        let mut bench = Bench::new(Resume::Auto, None);
        assert!(bench.tick(0));
        assert!(!bench.switch.close(bench.at(1)), "it is stopped");
        bench.commands(0..1000);
        assert!(bench.switch.close(bench.at(1000)));
        assert_eq!(bench.cause(), Some(StopCause::Closed));
    }

    #[test]
    fn sources_are_bounded() {
        let begin = Instant::now();
        let mut switch = DeadMan::new(&rule(Resume::Auto, None), begin);
        for n in 0..10_000_u128 {
            let source = SourceId(n.to_be_bytes());
            let command = Command { source, seq: 1, stamp_ns: 1, least_age: None, is_stop: false };
            assert!(switch.judge(begin + ms(n as u64), command).is_err());
        }
        assert_eq!(switch.sources.len(), SOURCES_MAX);
    }

    /// A random history: an operator who holds, lets go and begins again, and a path with delay, loss and outages.
    struct History {
        rng: ChaCha8Rng,
        /// Commands under way: arrival, publication, number, stop message or not, hold.
        way: Vec<Sent>,
    }

    #[derive(Clone, Copy)]
    struct Sent {
        arrives: u64,
        published: u64,
        command: Command,
        hold: u64,
    }

    impl History {
        fn below(&mut self, bound: u64) -> u64 {
            self.rng.next_u64() % bound
        }

        fn is_one_in(&mut self, n: u64) -> bool {
            self.below(n) == 0
        }
    }

    /// Runs a history of 30 s. Whenever no command passed for `AFTER`, the stop message was published; no command passes
    /// that is older than the path's usual delay and `AFTER`; and after a stop none passes of a hold that began before it.
    /// If the publisher's clock is known, none passes that is older than `AFTER` and the error of that.
    fn run(seed: u64, knows_clock: bool) -> (usize, usize) {
        const DELAY: u64 = 20;
        const JITTER: u64 = 30;
        const ERROR: u64 = 10;
        let age_max = AFTER.as_millis() as u64 + if knows_clock { ERROR } else { DELAY + JITTER };
        let mut history = History { rng: ChaCha8Rng::seed_from_u64(seed), way: Vec::new() };
        let begin = Instant::now();
        let at = |ms: u64| begin + Duration::from_millis(ms);
        let mut switch = DeadMan::new(&rule(Resume::Auto, None), begin);
        let is_reliable = history.is_one_in(2);
        // An operator's program publishes nothing, or stop messages, while nobody holds.
        let streams_stops = history.is_one_in(2);
        let mut skew = history.below(1 << 40) as i64;
        let (mut source, mut seq, mut hold) = (SourceId([0; 16]), 0, 0);
        let (mut is_held, mut changes, mut outage_until, mut calm_until) = (false, 0, 0, 0);
        let (mut last_passed, mut last_hold, mut heard_hold, mut is_stopped) = (0, None, None, false);
        let (mut passed, mut stops) = (0, 0);
        for now in 0..30_000 {
            if now == changes {
                is_held = !is_held;
                hold += u64::from(is_held);
                // A pause is longer than what the switch takes for one, or the operator did not let go.
                changes = now + 350 + history.below(3000);
            }
            // How long commands take is not known of a publisher of which each one waited.
            if (now >= calm_until || knows_clock) && history.is_one_in(4000) {
                outage_until = now + history.below(3000);
                calm_until = outage_until + 500;
            }
            // A clock that is set while no command arrives hides how long the next ones took.
            let is_heard = (is_held || streams_stops) && now >= outage_until + 100 && changes > now + 200;
            if is_heard && !knows_clock && history.is_one_in(8000) {
                skew += history.below(5000) as i64 - 2500;
                calm_until = calm_until.max(now + 200);
            }
            if history.is_one_in(10_000) {
                // The program is started anew, which ends a hold.
                (source, seq, hold) = (SourceId(u128::from(now).to_be_bytes()), 0, hold + 1);
            }
            if history.is_one_in(15_000) {
                // So is the node beside the robot.
                switch = DeadMan::new(&rule(Resume::Auto, None), at(now));
                (last_hold, is_stopped) = (heard_hold, true);
            }
            if now % 20 == 0 && (is_held || streams_stops) {
                seq += 1;
                let stamp_ns = (1 << 60) + (now as i64 + skew) * 1_000_000;
                let command = Command { source, seq, stamp_ns, least_age: None, is_stop: !is_held };
                let delay = DELAY + history.below(JITTER);
                let arrives = if now < outage_until { outage_until + DELAY } else { now + delay };
                let is_lost = history.is_one_in(50) || now < outage_until;
                if is_reliable || !is_lost {
                    history.way.push(Sent { arrives, published: now, command, hold });
                }
            }
            let (come, way): (Vec<Sent>, _) = history.way.drain(..).partition(|sent| sent.arrives <= now);
            history.way = way;
            for sent in come {
                heard_hold = Some(sent.hold);
                let age = now - sent.published;
                let least_age = knows_clock.then_some((age as i64 - ERROR as i64) * 1_000_000);
                if switch.judge(at(now), Command { least_age, ..sent.command }).is_err() {
                    continue;
                }
                (passed, last_passed) = (passed + 1, now);
                assert!(age <= age_max, "at {now}: {age} ms old");
                if sent.command.is_stop {
                    is_stopped = false;
                } else {
                    assert!(
                        !is_stopped || last_hold != Some(sent.hold),
                        "at {now}: of the hold before the stop"
                    );
                    (is_stopped, last_hold) = (false, Some(sent.hold));
                }
            }
            if switch.tick(at(now)) {
                (stops, is_stopped) = (stops + 1, true);
            }
            assert!(switch.stopped().is_some() || now < last_passed + AFTER.as_millis() as u64, "at {now}");
        }
        (passed, stops)
    }

    #[test]
    fn in_random_histories_a_stop_is_never_late_and_no_stale_command_passes() {
        let (mut passed, mut stops) = (0, 0);
        for seed in 0..500 {
            let one = std::panic::catch_unwind(|| run(seed, seed % 2 == 1));
            let (p, s) = one.unwrap_or_else(|_| panic!("seed {seed}"));
            (passed, stops) = (passed + p, stops + s);
        }
        assert!(passed > 100_000 && stops > 1000, "{passed} passed, {stops} stops");
    }
}
