//! The nodes for which a share is meant.

use sgc_trust::{FleetName, GroupName, NodeName};

/// A recipient that may subscribe to a share, or publish on it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Recipient {
    /// `"*"`: every member of the fleet.
    Everyone,
    /// `"group:operators"`: the members of a group, without the prefix.
    Group(GroupName),
    /// `"desk"`: one node.
    Node(NodeName),
    /// `"partner:acme"`: the nodes of the `[[partner]]` with that name.
    Partner(FleetName),
}

impl std::fmt::Display for Recipient {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Everyone => f.write_str("*"),
            Self::Group(group) => write!(f, "group:{group}"),
            Self::Node(node) => write!(f, "{node}"),
            Self::Partner(partner) => write!(f, "partner:{partner}"),
        }
    }
}
