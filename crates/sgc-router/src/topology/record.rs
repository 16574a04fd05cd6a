//! One node's verified link state.

use std::sync::Arc;
use std::time::Instant;

use sgc_trust::CertId;
use sgc_wire::{Adjacency, NodeId, NodeTag, SignedBody, UnixMillis};

/// A node's verified link state.
#[derive(Debug)]
pub(crate) struct NodeRecord {
    pub(super) seq: u64,
    /// Advertisements of it with lower numbers are void.
    pub(super) floor: u64,
    pub(super) transit: bool,
    pub(super) routers: Vec<Adjacency>,
    pub(super) attached: Vec<NodeTag>,
    pub(super) certs: Arc<[CertId]>,
    pub(super) signed: SignedBody,
    pub(super) issued_at: UnixMillis,
    pub(super) digest: [u8; 32],
    pub(super) expires: Instant,
}

impl NodeRecord {
    /// Returns `true` for a router.
    pub(crate) fn is_transit(&self) -> bool {
        self.transit
    }

    /// Returns its signed body.
    pub(crate) fn signed(&self) -> &SignedBody {
        &self.signed
    }

    /// Returns the end of its lease.
    pub(crate) fn expires(&self) -> Instant {
        self.expires
    }

    /// Returns the time of its signing.
    pub(crate) fn issued_at(&self) -> UnixMillis {
        self.issued_at
    }

    /// Returns the cost of the link to another router; `None` if one of both is no router, or if there is no link.
    pub(super) fn cost_to_router(&self, node: &NodeId) -> Option<u32> {
        let at = self.routers.binary_search_by(|a| a.node.cmp(node)).ok()?;
        self.transit.then(|| self.routers[at].cost)
    }

    /// Returns `true` if it lists a node, a router or another one.
    pub(super) fn says(&self, node: &NodeId, transit: bool) -> bool {
        if transit {
            self.routers.binary_search_by(|a| a.node.cmp(node)).is_ok()
        } else {
            self.attached.binary_search(&node.tag()).is_ok()
        }
    }
}
