//! The virtual clock. It moves when the world says so.

use std::sync::OnceLock;
use std::time::{Duration, Instant};

use sgc_wire::{Now, UnixMillis};

/// Wall-clock time at which every world begins. The identities of [`crate::identity`] are made for it.
pub(crate) const GENESIS: UnixMillis = UnixMillis(1_795_000_000_000);

/// Both clocks of a world, which move together.
#[derive(Clone, Copy, Debug)]
pub struct Clock {
    base: Instant,
    elapsed: Duration,
}

impl Default for Clock {
    fn default() -> Self {
        static BASE: OnceLock<Instant> = OnceLock::new();
        // Only differences of instants matter, so any base gives the same run.
        Self { base: *BASE.get_or_init(Instant::now), elapsed: Duration::ZERO }
    }
}

impl Clock {
    /// Moves the clock forward, never back.
    pub fn advance_to(&mut self, instant: Instant) {
        self.elapsed = self.elapsed.max(instant.saturating_duration_since(self.base));
    }

    /// Returns the present.
    pub fn now(&self) -> Now {
        Now { instant: self.instant(), unix: UnixMillis(GENESIS.0 + self.elapsed.as_millis() as u64) }
    }

    /// Returns the present of the monotonic clock.
    pub fn instant(&self) -> Instant {
        self.base + self.elapsed
    }

    /// Returns the time since the world began.
    pub fn elapsed(&self) -> Duration {
        self.elapsed
    }
}
