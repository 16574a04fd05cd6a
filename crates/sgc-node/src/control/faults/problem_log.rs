//! Log of problems between the two sides. It is rate-limited, so that local programs with ever changing types and QoS
//! cannot fill it.
//!
//! `status` and `why` show current problems, whether they were logged or not.

use std::fmt::Display;
use std::time::{Duration, Instant};

use tracing::{debug, warn};

/// Most problems logged at once.
const LINES_MAX: u32 = 64;
/// Time after which one more may be logged.
const LINE_EVERY: Duration = Duration::from_secs(1);

/// Rate limiter of log lines about problems.
#[derive(Debug, Default)]
pub(crate) struct ProblemLog {
    /// Time at which all [`LINES_MAX`] lines are available again.
    full_at: Option<Instant>,
    left_out: u64,
}

impl ProblemLog {
    /// Logs a problem, or only counts it if there were too many recently.
    pub(crate) fn note(&mut self, now: Instant, problem: &impl Display) {
        match self.line(now, problem) {
            Some(line) => warn!("{line}"),
            None => debug!("{}", single_line(problem)),
        }
    }

    fn line(&mut self, now: Instant, problem: &impl Display) -> Option<String> {
        let full_at = self.full_at.unwrap_or(now).max(now) + LINE_EVERY;
        if full_at > now + LINE_EVERY * LINES_MAX {
            self.left_out += 1;
            return None;
        }
        self.full_at = Some(full_at);
        let line = single_line(problem);
        Some(match std::mem::take(&mut self.left_out) {
            0 => line,
            more => format!("{line} (and {more} more since the last such line: see `sgc why`)"),
        })
    }
}

/// Removes line breaks and control characters, since anybody can choose the names of types.
fn single_line(problem: &impl Display) -> String {
    problem
        .to_string()
        .chars()
        .map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn flood_of_problems_does_not_fill_the_log() {
        let (mut log, start) = (ProblemLog::default(), Instant::now());
        let minute = 60_000;
        let logged = |log: &mut ProblemLog, range: std::ops::Range<u64>| -> Vec<_> {
            range
                .filter_map(|ms| log.line(start + Duration::from_millis(ms), &format!("type {ms}")))
                .collect()
        };
        assert_eq!(logged(&mut log, 0..minute).len(), LINES_MAX as usize + 59);
        let quiet = u64::from(LINES_MAX) * 1000;
        let later = logged(&mut log, minute + quiet..minute + quiet + 10);
        assert!(later.len() == 10 && later[0].contains("more since the last such line"), "{later:?}");
        assert!(!later[1].contains("more"));
    }

    #[test]
    fn hostile_names_stay_on_their_line() {
        let line = ProblemLog::default().line(Instant::now(), &"x\n2026-01-01 ERROR all is lost\u{1b}[2J");
        assert_eq!(line.as_deref(), Some("x\u{fffd}2026-01-01 ERROR all is lost\u{fffd}[2J"));
    }
}
