//! [`Backlog`]: interfaces that were left out because of a running route.

/// Whether left-out interfaces have to be reconsidered.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Backlog {
    /// `true` if an interface is not shared or brought because of a running route.
    waits: bool,
    /// `true` if a route has ended since the last check.
    freed: bool,
}

impl Backlog {
    /// Notes that an interface was left out.
    pub(super) fn wait(&mut self) {
        self.waits = true;
    }

    /// Notes that a route has ended.
    pub(super) fn free(&mut self) {
        self.freed = true;
    }

    /// Returns `true` if interfaces were left out and a route has ended since.
    pub(super) fn take_due(&mut self) -> bool {
        std::mem::take(&mut self.freed) && std::mem::take(&mut self.waits)
    }
}
