//! [`AdvertPace`]: how often a node advertises. Names that come one by one are gathered, so that routers, which take so many
//! announcements of a node and no more (docs/spec/routing.md), leave none out.

use std::time::{Duration, Instant};

/// Advertisements and withdrawals that a node sends at once: a quarter of what a router takes, since a node that starts anew has
/// the same allowance there.
pub const ADVERTS_BURST: u32 = 64;
/// Between two of them, from then on: a third of what a router takes, since link states count there, too.
pub const ADVERT_INTERVAL: Duration = Duration::from_millis(100);

/// Until when what was sent counts.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct AdvertPace(Option<Instant>);

impl AdvertPace {
    /// From when the next may be sent; `None` if none was.
    pub(crate) fn opens_at(self) -> Option<Instant> {
        self.0?.checked_sub(ADVERT_INTERVAL * (ADVERTS_BURST - 1))
    }

    /// One is sent.
    pub(crate) fn sent(&mut self, now: Instant) {
        self.0 = Some(self.0.map_or(now, |until| until.max(now)) + ADVERT_INTERVAL);
    }
}
