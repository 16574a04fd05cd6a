//! The forwarding entry of one name for the data path. Immutable: a change makes a new entry.

use sgc_wire::SinkId;
use smallvec::SmallVec;

use crate::link_id::LinkId;

/// The compiled trees of one name at this node: one, and for a while a second one after a route change.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FibEntry {
    /// The trees, ascending by their link towards the owner.
    pub trees: SmallVec<[Tree; 1]>,
    /// The link towards each sink, ascending by sink, for packets to one sink.
    pub sinks: Vec<(SinkId, LinkId)>,
}

/// Branches that share the link towards the owner.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tree {
    /// The link towards the owner; data may come from it.
    pub up: LinkId,
    /// Links with at least one subscriber behind them, each once, ascending.
    pub down: SmallVec<[LinkId; 4]>,
    /// Links with at least one publisher behind them; data may come from them too.
    pub publishers: SmallVec<[LinkId; 1]>,
}

impl FibEntry {
    /// Returns `true` if data of this name may come in over `link`.
    pub fn accepts_from(&self, link: LinkId) -> bool {
        self.trees.iter().any(|t| t.up == link || t.publishers.contains(&link))
    }

    /// Iterates over the links for a packet to all that came in over `ingress`: down the trees whose root is there, or
    /// in both directions in those with a publisher behind `ingress`.
    pub fn egress(&self, ingress: LinkId) -> impl Iterator<Item = LinkId> + '_ {
        let fed = self.trees.iter().filter(move |t| t.up == ingress || t.publishers.contains(&ingress));
        let links = fed.flat_map(move |t| {
            let up = (t.up != ingress).then_some(t.up);
            t.down.iter().copied().filter(move |l| *l != ingress && Some(*l) != up).chain(up)
        });
        // Two trees exist only for a moment, so the links are few; each gets one copy.
        let single = self.trees.len() == 1;
        let mut seen = SmallVec::<[LinkId; 4]>::new();
        links.filter(move |link| {
            let new = single || !seen.contains(link);
            if new && !single {
                seen.push(*link);
            }
            new
        })
    }

    /// Returns the link for a packet to one sink that came in over `ingress`: such packets come only from the owner's
    /// side.
    pub fn egress_to(&self, ingress: LinkId, sink: &SinkId) -> Option<LinkId> {
        if self.trees.iter().all(|t| t.up != ingress) {
            return None;
        }
        self.sinks.binary_search_by(|(s, _)| s.cmp(sink)).ok().map(|i| self.sinks[i].1)
    }

    /// Returns all links that data can leave on, each once, ascending.
    pub fn links(&self) -> SmallVec<[LinkId; 4]> {
        let trees = self.trees.iter();
        let mut links: SmallVec<[LinkId; 4]> = trees
            .flat_map(|t| t.down.iter().copied().chain((!t.publishers.is_empty()).then_some(t.up)))
            .chain(self.sinks.iter().map(|(_, link)| *link))
            .collect();
        links.sort_unstable();
        links.dedup();
        links
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tree(up: u32, down: &[u32], publishers: &[u32]) -> Tree {
        let links = |n: &[u32]| n.iter().map(|l| LinkId(*l)).collect::<Vec<_>>();
        Tree { up: LinkId(up), down: links(down).into(), publishers: links(publishers).into() }
    }

    fn egress(trees: &[Tree], ingress: u32) -> Vec<u32> {
        let entry = FibEntry { trees: trees.into(), sinks: vec![] };
        entry.egress(LinkId(ingress)).map(|l| l.0).collect()
    }

    #[test]
    fn data_goes_down_the_tree_that_it_came_from_the_root_of() {
        let trees = [tree(1, &[2, 3], &[]), tree(4, &[3, 5], &[])];
        assert_eq!(egress(&trees, 1), [2, 3]);
        assert_eq!(egress(&trees, 4), [3, 5]);
        assert_eq!(egress(&trees, 2), [0; 0]);
    }

    #[test]
    fn packets_for_one_sink_come_from_the_owners_side() {
        let sink = SinkId([7; 16]);
        let entry = FibEntry { trees: [tree(1, &[], &[2, 3])].into(), sinks: vec![(sink, LinkId(2))] };
        assert_eq!(entry.egress_to(LinkId(1), &sink), Some(LinkId(2)));
        assert_eq!(entry.egress_to(LinkId(3), &sink), None);
        assert_eq!(entry.egress_to(LinkId(1), &SinkId([8; 16])), None);
        assert_eq!(entry.links()[..], [LinkId(1), LinkId(2)]);
    }

    #[test]
    fn a_publishers_data_goes_both_ways_and_once_over_each_link() {
        let trees = [tree(1, &[2, 3], &[2]), tree(4, &[3], &[2])];
        assert_eq!(egress(&trees[..1], 2), [3, 1]);
        assert_eq!(egress(&trees, 2), [3, 1, 4]);
    }
}
