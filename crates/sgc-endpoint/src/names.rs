//! The names at which a node is asked, apart from those of its shares.

use sgc_trust::{
    Identity, TopicSecret, clock_blind, consumers_blind, name_of, operations_blind, paths_blind,
    renewal_blind, reports_blind, types_blind, wishes_blind,
};
use sgc_wire::{Blind, Metadata, Name, NodeId};

/// A name, with the blind that its owner advertises.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct BlindName {
    pub(crate) name: Name,
    pub(crate) blind: Blind,
}

impl BlindName {
    fn new(owner: &NodeId, blind: Blind) -> Self {
        Self { name: name_of(owner, &blind), blind }
    }

    /// Returns the name at which an owner is asked for its types.
    pub(crate) fn types(owner: &NodeId) -> Self {
        Self::new(owner, types_blind(owner))
    }

    /// Returns the name at which `node` is asked for its consumers.
    pub(crate) fn consumers(node: &NodeId) -> Self {
        Self::new(node, consumers_blind(node))
    }

    /// Returns the name at which `node` is asked for reports.
    pub(crate) fn reports(node: &NodeId) -> Self {
        Self::new(node, reports_blind(node))
    }

    /// Returns the name at which `node` is asked for its addresses.
    pub(crate) fn paths(node: &NodeId) -> Self {
        Self::new(node, paths_blind(node))
    }

    /// Returns the name at which `node` is asked for its wishes.
    pub(crate) fn wishes(node: &NodeId) -> Self {
        Self::new(node, wishes_blind(node))
    }

    /// Returns the name at which `node` is asked for the time by its clock.
    pub(crate) fn clock(node: &NodeId) -> Self {
        Self::new(node, clock_blind(node))
    }

    /// Returns the name at which members of `identity`'s fleet ask `authority` for credentials.
    pub(crate) fn renewal(authority: &NodeId, identity: &Identity) -> Self {
        Self::new(authority, renewal_blind(&identity.as_peer().ca))
    }

    /// Returns the name at which operators of `identity`'s fleet ask `authority` for operations.
    pub(crate) fn operations(authority: &NodeId, identity: &Identity) -> Self {
        Self::new(authority, operations_blind(&identity.as_peer().ca))
    }

    /// Returns the names of an owner's catalogue: one for each secret of `identity`, the newest first.
    pub(crate) fn catalogues(identity: &Identity, owner: &NodeId, owner_name: &str) -> Vec<Self> {
        let metadata = Metadata::catalogue(owner_name);
        let secrets = identity.naming_secrets().iter();
        let blinds = secrets.map(|s| TopicSecret::derive(&s.secret, &metadata).blind());
        blinds.map(|blind| Self::new(owner, blind)).collect()
    }
}
