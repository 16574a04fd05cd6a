//! The service manager that started this process, if one did: systemd, or another that has its protocol (sd_notify(3)).
//!
//! Without such a manager nothing here does anything.

use sd_notify::NotifyState;
use sgc_node::Watchdog;

/// A part of the watchdog's time after which it is fed, as sd_watchdog_enabled(3) recommends.
const FEED_PART: u32 = 2;

/// Reports that the node is up.
pub(crate) fn ready() {
    tell(&[NotifyState::Ready]);
}

/// Reports that the node ends.
pub(crate) fn stopping() {
    tell(&[NotifyState::Stopping]);
}

/// Returns the watchdog of the service manager, if it has one for this process.
pub(crate) fn watchdog() -> Option<Watchdog> {
    let every = sd_notify::watchdog_enabled()? / FEED_PART;
    // An interval of zero would feed without pause.
    (!every.is_zero()).then(|| Watchdog { every, feed: Box::new(|| tell(&[NotifyState::Watchdog])) })
}

fn tell(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "the service manager cannot be told the state of this node");
    }
}
