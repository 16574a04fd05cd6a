//! Who may join a share: closed unless it says otherwise.

use std::collections::BTreeSet;

use sgc_wire::{GroupTag, NodeId, Role};

use crate::{CaFingerprint, VerifiedPeer};

/// Who may join one share, and as what.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Policy {
    /// Every member of the fleet with this CA.
    pub fleet: Option<CaFingerprint>,
    /// These nodes.
    pub nodes: BTreeSet<NodeId>,
    /// The members of these groups, each of the fleet with that CA: another CA may certify the same tag.
    pub groups: BTreeSet<(CaFingerprint, GroupTag)>,
}

/// Why a peer is not permitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Denied {
    /// Neither it nor a group of it is named.
    NotListed,
    /// The share does not offer that role.
    Role,
}

impl Policy {
    /// Whether `peer` may join as `role`.
    pub fn permits(&self, peer: &VerifiedPeer, role: Role) -> Result<(), Denied> {
        if role != Role::Subscribe {
            return Err(Denied::Role);
        }
        let listed = self.fleet == Some(peer.ca)
            || self.nodes.contains(&peer.node_id)
            || peer.groups.iter().any(|g| self.groups.contains(&(peer.ca, *g)));
        if listed { Ok(()) } else { Err(Denied::NotListed) }
    }
}
