//! [`Spacing`]: the pace at which messages that arrive in a burst are written.
//!
//! Batching, and every pause of a process or a link, causes bursts. A ROS 2 subscriber keeps the last ten messages by
//! default and takes time to wake up, so it loses the rest of a burst, although the publisher spread the messages over
//! time. A burst is therefore written twice as fast as it was published: a few messages at once, then a pause. A
//! message with its publisher's distance from the one before is never delayed.

use std::time::{Duration, Instant};

use sgc_wire::SourceId;

/// Factor by which a burst is written faster than it was published.
const CATCH_UP: u64 = 2;

/// Intervals by which a message is written ahead of its time: half of the depth of ROS 2's default for sensor data
/// (`rmw_qos_profile_sensor_data`, depth 5), and the message that is due.
const AHEAD: u32 = 2;

/// Upper bound of an interval. Messages of a slow topic that gathered while a link was down are written within
/// moments, and a subscriber in Python, which takes up to a millisecond for each, keeps up with them.
const INTERVAL_MAX: Duration = Duration::from_millis(2);

/// Delay of a written message that later messages make up for: about the overrun of a sleep.
const LATE_MAX: Duration = Duration::from_micros(100);

/// Shortest wait that is worth a sleep.
const WAIT_MIN: Duration = Duration::from_micros(20);

/// Times of one writer's last message.
#[derive(Debug, Default)]
pub(crate) struct Spacing {
    last: Option<Last>,
}

#[derive(Debug)]
struct Last {
    source: SourceId,
    /// Time of publishing, ns since the epoch by the publisher's clock.
    published_ns: i64,
    /// Scheduled time of writing.
    scheduled: Instant,
}

impl Spacing {
    /// Returns the time that a message waits before it is written; `None` if it does not.
    pub(crate) fn wait(&self, now: Instant, source: SourceId, published_ns: i64) -> Option<Duration> {
        let (scheduled, interval) = self.schedule(now, source, published_ns);
        let ahead = scheduled.checked_sub(interval * AHEAD)?;
        if ahead.saturating_duration_since(now) < WAIT_MIN {
            return None;
        }
        // Later messages that are due by then need no wait of their own.
        Some(scheduled.saturating_duration_since(now))
    }

    /// Notes that a message is written now.
    pub(crate) fn note(&mut self, now: Instant, source: SourceId, published_ns: i64) {
        let (scheduled, _) = self.schedule(now, source, published_ns);
        self.last = Some(Last { source, published_ns, scheduled });
    }

    /// Returns the time for which the last message was scheduled.
    pub(crate) fn last_written(&self) -> Option<Instant> {
        self.last.as_ref().map(|last| last.scheduled)
    }

    /// Returns the scheduled time of a message, and its interval after the one before.
    fn schedule(&self, now: Instant, source: SourceId, published_ns: i64) -> (Instant, Duration) {
        // Clocks of two publishers are not comparable.
        let last = self.last.as_ref().filter(|last| last.source == source);
        let Some(last) = last else { return (now, Duration::ZERO) };
        let apart_ns = published_ns.checked_sub(last.published_ns).and_then(|ns| u64::try_from(ns).ok());
        let interval = Duration::from_nanos(apart_ns.unwrap_or(0) / CATCH_UP).min(INTERVAL_MAX);
        let earliest = now.checked_sub(LATE_MAX).unwrap_or(now);
        (earliest.max(last.scheduled + interval), interval)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS_NS: i64 = 1_000_000;
    const A: SourceId = SourceId([1; 16]);
    const B: SourceId = SourceId([2; 16]);

    /// Writes messages that arrive together and returns the time of each. Writing one lasts `takes`.
    fn burst(published_ns: impl IntoIterator<Item = i64>, takes: Duration) -> Vec<Duration> {
        let (mut spacing, begun) = (Spacing::default(), Instant::now());
        let mut now = begun;
        let mut written = Vec::new();
        for published_ns in published_ns {
            now += spacing.wait(now, A, published_ns).unwrap_or_default();
            spacing.note(now, A, published_ns);
            written.push(now - begun);
            now += takes;
        }
        written
    }

    #[test]
    fn a_burst_is_written_in_half_the_time_in_which_it_was_published() {
        let written = burst((0..100).map(|n| n * MS_NS / 5), Duration::ZERO);
        let most_at_once = written.iter().map(|at| written.iter().filter(|other| *other == at).count()).max();
        assert_eq!(most_at_once, Some(AHEAD as usize + 1));
        let (last, half) = (*written.last().unwrap(), Duration::from_micros(99 * 100));
        assert!(last <= half && last + Duration::from_micros(300) >= half, "{last:?}");
    }

    #[test]
    fn backlog_of_a_slow_topic_leaves_a_subscriber_time_for_each_message() {
        // Three seconds of 20 Hz, after a router failed.
        let written = burst((0..60).map(|n| n * 50 * MS_NS), Duration::ZERO);
        // It takes a millisecond for each, and keeps the last five.
        let mut idle_at = Duration::ZERO;
        for at in &written {
            idle_at = idle_at.max(*at) + Duration::from_millis(1);
            assert!(idle_at - *at <= Duration::from_millis(5), "{written:?}");
        }
        assert!(written.last().unwrap() <= &Duration::from_millis(200), "{written:?}");
    }

    #[test]
    fn messages_in_their_time_and_those_published_at_once_do_not_wait() {
        let (mut spacing, begun) = (Spacing::default(), Instant::now());
        for n in 0..100 {
            // Each message is half an interval early or late.
            let now = begun + Duration::from_micros(1000 * n + 500 * (n % 2));
            assert_eq!(spacing.wait(now, A, n as i64 * MS_NS), None);
            spacing.note(now, A, n as i64 * MS_NS);
        }
        const TAKES: Duration = Duration::from_micros(5);
        for apart_ns in [0, 1_000, 10_000] {
            let written = burst((0..100).map(|n| n * apart_ns), TAKES);
            assert_eq!(written.last(), Some(&(99 * TAKES)), "{apart_ns} ns apart");
        }
    }

    #[test]
    fn a_message_after_silence_holds_up_none_behind_it() {
        let (mut spacing, begun) = (Spacing::default(), Instant::now());
        spacing.note(begun, A, 0);
        let now = begun + Duration::from_secs(2);
        for n in 0..3 {
            let published_ns = 2_000 * MS_NS + n * 50_000;
            assert_eq!(spacing.wait(now, A, published_ns), None);
            spacing.note(now, A, published_ns);
        }
    }

    #[test]
    fn messages_of_two_publishers_do_not_wait_for_the_difference_of_their_clocks() {
        let (mut spacing, now) = (Spacing::default(), Instant::now());
        for n in 0..100 {
            for (source, published_ns) in [(A, n), (B, 1_000 * MS_NS + n)] {
                assert_eq!(spacing.wait(now, source, published_ns), None);
                spacing.note(now, source, published_ns);
            }
        }
    }

    #[test]
    fn times_that_no_clock_gives_hold_up_nothing_for_long() {
        let written = burst([0, i64::MAX, i64::MIN, i64::MAX, 0, -1, 7], Duration::ZERO);
        assert!(written.last().unwrap() <= &(INTERVAL_MAX * 7), "{written:?}");
    }
}
