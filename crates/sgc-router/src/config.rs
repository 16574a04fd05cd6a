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
