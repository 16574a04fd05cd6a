//! One neighbour: who it is, what it said of itself, and what depends on it.

use std::collections::BTreeSet;

use sgc_wire::{Hello, Name, NodeId};

/// State of a link that is up.
#[derive(Debug)]
pub(crate) struct LinkState {
    /// The authenticated node at the other end.
    pub(crate) node: NodeId,
    /// Its greeting; nothing else is accepted before it.
    pub(crate) hello: Option<Hello>,
    /// Names with a route or a branch over this link.
    pub(crate) names: BTreeSet<Name>,
    /// Names that it wants to hear of.
    pub(crate) interests: BTreeSet<Name>,
    /// Number of routes learned over it.
    pub(crate) routes: usize,
    /// Number of branches over it.
    pub(crate) branches: usize,
}

impl LinkState {
    pub(crate) fn new(node: NodeId) -> Self {
        Self { node, hello: None, names: BTreeSet::new(), interests: BTreeSet::new(), routes: 0, branches: 0 }
    }

    /// True once it said that it carries others' names.
    pub(crate) fn is_transit(&self) -> bool {
        self.hello.is_some_and(|h| h.transit)
    }
}
