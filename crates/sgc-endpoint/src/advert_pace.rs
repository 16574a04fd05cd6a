//! [`AdvertPace`]: the rate of a node's advertisements. Names that come one by one are collected, because routers take
//! a bounded number of announcements of a node (docs/spec/routing.md) and drop the rest.

use std::time::{Duration, Instant};

/// Advertisements and withdrawals that a node sends at once: a quarter of a router's bound, because a restarted node
/// has the same allowance there.
pub const ADVERTS_BURST: u32 = 64;
/// Interval of later ones: a third of a router's bound, because link states count there, too.
pub const ADVERT_INTERVAL: Duration = Duration::from_millis(100);

/// Time until which the sent advertisements count.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct AdvertPace(Option<Instant>);

impl AdvertPace {
    /// Returns the time from which the next may be sent; `None` if none was.
    pub(crate) fn opens_at(self) -> Option<Instant> {
        self.0?.checked_sub(ADVERT_INTERVAL * (ADVERTS_BURST - 1))
    }

    /// Notes a sent advertisement.
    pub(crate) fn sent(&mut self, now: Instant) {
        self.0 = Some(self.0.map_or(now, |until| until.max(now)) + ADVERT_INTERVAL);
    }
}
