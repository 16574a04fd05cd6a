//! Who may join a share, and as what: closed unless it says otherwise.

use std::collections::BTreeSet;

use sgc_wire::{GroupTag, NodeId, Role};

use crate::{CaFingerprint, VerifiedPeer};

/// A set of peers, by what their certificates prove.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Grantees {
    /// Every node of the fleets with these CAs.
    pub fleets: BTreeSet<CaFingerprint>,
    /// These nodes.
    pub nodes: BTreeSet<NodeId>,
    /// The members of these groups, each of the fleet with that CA: another CA may certify the same tag.
    pub groups: BTreeSet<(CaFingerprint, GroupTag)>,
}

/// Why a peer is in a set of grantees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum GrantReason {
    /// It is named itself.
    Node,
    /// A group of it is named.
    Group(GroupTag),
    /// Its whole fleet is named.
    Fleet,
}

impl Grantees {
    /// How `peer` is among them, if it is.
    pub fn find(&self, peer: &VerifiedPeer) -> Option<GrantReason> {
        self.find_parts(&peer.node_id, &peer.ca, &peer.groups)
    }

    /// How a node whose certificate proves this is among them, if it is. For those who ask about a node that is
    /// not there; what decides about one that is, is [`Grantees::find`].
    pub fn find_parts(&self, node: &NodeId, ca: &CaFingerprint, groups: &[GroupTag]) -> Option<GrantReason> {
        if self.nodes.contains(node) {
            return Some(GrantReason::Node);
        }
        let group = groups.iter().find(|g| self.groups.contains(&(*ca, **g)));
        group.map(|g| GrantReason::Group(*g)).or(self.fleets.contains(ca).then_some(GrantReason::Fleet))
    }

    /// Returns `true` if nobody is.
    pub fn is_empty(&self) -> bool {
        self.fleets.is_empty() && self.nodes.is_empty() && self.groups.is_empty()
    }
}

/// Who may join one share.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Policy {
    /// Who may receive what is published.
    pub subscribe: Grantees,
    /// Who may publish, besides the owner.
    pub publish: Grantees,
}

/// Why a peer is not permitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum DenialReason {
    /// Neither it, nor a group of it, nor its fleet is named.
    #[error("neither the node, nor a group that its certificate puts it into, nor its fleet is named")]
    NotListed,
    /// The share offers that role to nobody.
    #[error("nobody is named for that role")]
    Role,
}

impl Policy {
    /// Whether `peer` may join as `role`, and because of what.
    pub fn permits(&self, peer: &VerifiedPeer, role: Role) -> Result<GrantReason, DenialReason> {
        let grantees = match role {
            Role::Subscribe => &self.subscribe,
            Role::Publish if self.publish.is_empty() => return Err(DenialReason::Role),
            Role::Publish => &self.publish,
        };
        grantees.find(peer).ok_or(DenialReason::NotListed)
    }
}
