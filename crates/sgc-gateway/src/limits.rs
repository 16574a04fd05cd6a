//! [`SessionLimits`]: the bounds of one session.

/// Divisor: a subscription that holds up writers gets one part in this many of the client's bytes.
pub(crate) const WAITING_PARTS: usize = 16;

/// The limits of one session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionLimits {
    /// Most bytes queued in all subscriptions together; one message of each topic is always allowed. The same bound
    /// applies separately to messages kept by transient-local writers, to arguments of calls and goals, and to
    /// messages that are kept for later subscribers and charged to the session.
    pub waiting_bytes_max: usize,
    /// Most subscriptions.
    pub subscriptions_max: usize,
    /// Most published topics.
    pub publications_max: usize,
    /// Most served services and actions.
    pub servings_max: usize,
    /// Most concurrent calls.
    pub calls_max: usize,
    /// Most subscriptions that hold up writers. Each has its own reader and its own part of the bytes.
    pub waits_max: usize,
}

impl Default for SessionLimits {
    fn default() -> Self {
        Self {
            waiting_bytes_max: 64 << 20,
            subscriptions_max: 1024,
            publications_max: 256,
            servings_max: 256,
            calls_max: 256,
            waits_max: WAITING_PARTS,
        }
    }
}
