//! The round trips of one size: how they are measured, and the result.

use std::time::Duration;

use super::lab::PathKind;

/// From where on a message is large: few are measured, and one is enough where the path is thin.
pub(crate) const LARGE_BYTES: usize = 1 << 20;
/// And from where on it is huge: there one says it all where the path is thin.
const HUGE_BYTES: usize = 8 << 20;

/// The round trips of one size.
#[derive(Debug, Default)]
pub(crate) struct Sample {
    /// Each round trip, µs.
    pub(crate) round_trips_us: Vec<f64>,
    /// Messages that did not come back in time.
    pub(crate) lost: u64,
    /// That time.
    pub(crate) patience: Duration,
}

/// How one size is measured.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Plan {
    /// At most so many that count.
    pub(crate) count: usize,
    /// None begins after so long.
    pub(crate) seconds: f64,
    /// How many come first and do not count.
    pub(crate) warm_up: usize,
    /// How long each is waited for.
    pub(crate) patience: Duration,
}

impl Plan {
    /// Returns the plan of a size on a path.
    pub(crate) fn for_path(kind: &PathKind, size: usize, quick: bool) -> Self {
        let is_large = size >= LARGE_BYTES;
        let is_huge = size >= HUGE_BYTES;
        let (count, seconds, warm_up, patience): (usize, f64, usize, u64) = match kind {
            PathKind::Bare if is_huge => (12, 2.5, 1, 15),
            PathKind::Bare if is_large => (60, 1.5, 2, 10),
            PathKind::Bare => (3000, 1.0, 50, 5),
            // 13 MB take 44 s there and back at 5 Mbit/s.
            _ if is_huge => (1, 1.0, 0, 100),
            _ if is_large => (3, 1.0, 0, 40),
            _ => (200, 4.0, 2, 10),
        };
        let (count, seconds) = if quick { (count.min(100), seconds.min(0.5)) } else { (count, seconds) };
        Self { count, seconds, warm_up, patience: Duration::from_secs(patience) }
    }
}
