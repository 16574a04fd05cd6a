//! [`Context`]: the means of a connection that all its parts use.

use std::sync::Arc;

use crate::rosbridge::options::RosbridgeOptions;
use crate::rosbridge::outbox::Outbox;
use crate::session::Session;

/// The means of a connection that all its parts use.
pub(super) struct Context {
    /// The session of the client's latest credential.
    pub(super) session: Arc<Session>,
    pub(super) options: Arc<RosbridgeOptions>,
    pub(super) outbox: Outbox,
}
