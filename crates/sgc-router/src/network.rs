//! [`Network`]: the links of this node and the topology behind them, to find next hops in.

use sgc_wire::NodeId;

use crate::link_id::LinkId;
use crate::links::Links;
use crate::topology::Topology;

/// The links of this node, and the topology behind them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Network<'a> {
    pub(crate) links: &'a Links,
    pub(crate) topology: &'a Topology,
}

impl Network<'_> {
    /// Returns the link towards a node, and the cost of the route, from the topology or from a link of this node
    /// itself.
    pub(crate) fn next_hop_to(&self, node: &NodeId) -> Option<(LinkId, u32)> {
        let direct = self.links.best_to(node);
        match (self.topology.next_hop(node), direct) {
            (Some((cost, first)), _) if first == *node => Some((direct?.0, cost)),
            (Some((cost, first)), direct) => match (self.links.best_to(&first), direct) {
                (Some((link, _)), Some((straight, own))) => {
                    Some(if own <= cost { (straight, own) } else { (link, cost) })
                }
                (Some((link, _)), None) => Some((link, cost)),
                (None, direct) => direct,
            },
            (None, direct) => direct,
        }
    }
}
