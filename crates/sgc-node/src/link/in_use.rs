//! Links that end because another process uses this node's identity.

use sgc_transport::{CloseReason, LinkError};

/// Returns the place of another process with this node's identity, if the peer closed the link for it.
pub(crate) fn place_in_use(end: &LinkError) -> Option<&str> {
    match end {
        LinkError::Closed { by_peer: true, reason: CloseReason::InUse(place) } => Some(place),
        _ => None,
    }
}
