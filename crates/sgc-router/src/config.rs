//! The parameters of a router.

use std::sync::Arc;

use sgc_trust::{Identity, TrustAnchors};
use sgc_wire::{NodeId, UnixMillis};

use crate::limits::Limits;
use crate::mapping::MappingKind;

/// Parameters of a router.
#[derive(Clone, Debug)]
pub struct RouterConfig {
    /// This node's identity, for signing.
    pub identity: Arc<Identity>,
    /// This node's id.
    pub node: NodeId,
    /// Whether it carries others' names.
    pub transit: bool,
    /// Random number of this run.
    pub incarnation: u64,
    /// Beginning of this run: earlier advertisements of the node are void.
    pub started: UnixMillis,
    /// Mapping of names to owners; unused unless `transit`.
    pub mapping: MappingKind,
    /// The trust anchors.
    pub anchors: Arc<TrustAnchors>,
    /// Bounds.
    pub limits: Limits,
}

#[cfg(test)]
impl RouterConfig {
    /// Returns the parameters of a router `cloud` that starts now, for tests of its parts.
    pub(crate) fn for_tests(now: sgc_wire::Now) -> Self {
        use sgc_testkit::{Member, identity};

        let own = identity(&Member { router: true, ..Member::new("cloud") });
        Self {
            node: own.node_id(),
            transit: true,
            incarnation: 1,
            started: now.unix,
            mapping: MappingKind::Flood,
            anchors: Arc::new(own.anchors().clone()),
            limits: Limits::default(),
            identity: own,
        }
    }
}
