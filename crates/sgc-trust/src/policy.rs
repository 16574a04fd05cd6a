//! Permissions to join a share as subscriber or publisher: nobody may unless the policy says so.

use std::collections::BTreeSet;

use sgc_wire::{GroupTag, NodeId, Role};

use crate::{CaFingerprint, VerifiedPeer};

/// A set of peers, by the facts that their certificates prove.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Grantees {
    /// Every node of the fleets with these CAs, except those whose certificates let them route.
    pub fleets: BTreeSet<CaFingerprint>,
    /// These nodes.
    pub nodes: BTreeSet<NodeId>,
    /// The members of these groups, each of the fleet with that CA: another CA may certify the same tag.
    pub groups: BTreeSet<(CaFingerprint, GroupTag)>,
}

/// The reason why a peer is in a set of grantees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum GrantReason {
    /// The node itself is named.
    Node,
    /// A group of the node is named.
    Group(GroupTag),
    /// The node's whole fleet is named.
    Fleet,
}

impl Grantees {
    /// Returns the reason why `peer` is in the set, if it is. The holder of an invitation is in none, since it is no
    /// member yet.
    ///
    /// A node that may route is in the set only by its name or group: routers see names and must not get their keys,
    /// and a certificate does not tell whether its node holds the fleet's secret as well.
    pub fn find(&self, peer: &VerifiedPeer) -> Option<GrantReason> {
        if peer.invitation.is_some() {
            return None;
        }
        self.find_parts(&peer.node_id, &peer.ca, &peer.groups, peer.may_route)
    }

    /// Returns the reason why a node with these facts is in the set, if it is. For questions about an absent node;
    /// [`Grantees::find`] decides about a present one.
    pub fn find_parts(
        &self,
        node: &NodeId,
        ca: &CaFingerprint,
        groups: &[GroupTag],
        may_route: bool,
    ) -> Option<GrantReason> {
        if self.nodes.contains(node) {
            return Some(GrantReason::Node);
        }
        let group = groups.iter().find(|g| self.groups.contains(&(*ca, **g)));
        let is_of_fleet = self.fleets.contains(ca) && !may_route;
        group.map(|g| GrantReason::Group(*g)).or(is_of_fleet.then_some(GrantReason::Fleet))
    }

    /// Returns `true` if the set is empty.
    pub fn is_empty(&self) -> bool {
        self.fleets.is_empty() && self.nodes.is_empty() && self.groups.is_empty()
    }
}

/// The peers that may join one share.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Policy {
    /// Peers that may subscribe.
    pub subscribe: Grantees,
    /// Peers that may publish, besides the owner.
    pub publish: Grantees,
}

/// The reason why a peer is not permitted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum DenialReason {
    /// Neither the node, nor a group of it, nor its fleet is named.
    #[error("neither the node, nor a group that its certificate puts it into, nor its fleet is named")]
    NotListed,
    /// The share offers that role to nobody.
    #[error("nobody is named for that role")]
    Role,
}

impl Policy {
    /// Returns the reason why `peer` may join as `role`, or why not.
    pub fn permits(&self, peer: &VerifiedPeer, role: Role) -> Result<GrantReason, DenialReason> {
        let grantees = match role {
            Role::Subscribe => &self.subscribe,
            Role::Publish if self.publish.is_empty() => return Err(DenialReason::Role),
            Role::Publish => &self.publish,
        };
        grantees.find(peer).ok_or(DenialReason::NotListed)
    }
}
