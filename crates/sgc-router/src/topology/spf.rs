//! Shortest routes through the network of routers (Dijkstra), from one of them to all.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

use sgc_wire::NodeId;

use crate::limits::HOPS_MAX;

/// The route to a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Path {
    /// Sum of the costs of its links, microseconds of round trip.
    pub(crate) cost: u32,
    /// Number of its links.
    pub(crate) hops: u8,
    /// The first node on it; the node itself for the root.
    pub(crate) first: NodeId,
}

/// Returns the routes from `root` to all reachable routers. `edges` are those from a node that both ends confirm, with
/// costs above zero. Of equal routes the one whose first node is that of `before` wins, then the one with fewer links,
/// then the lower first node: so a route stays until there is a better one.
pub(crate) fn shortest_paths<I: Iterator<Item = (NodeId, u32)>>(
    root: NodeId,
    before: &BTreeMap<NodeId, Path>,
    mut edges: impl FnMut(&NodeId) -> I,
) -> BTreeMap<NodeId, Path> {
    let rank = |node: &NodeId, path: &Path| {
        let kept = before.get(node).is_some_and(|b| b.first == path.first);
        (path.cost, !kept, path.hops, path.first)
    };
    let mut best = BTreeMap::from([(root, Path { cost: 0, hops: 0, first: root })]);
    let mut done = BTreeMap::new();
    let mut heap = BinaryHeap::from([Reverse((0u32, root))]);
    while let Some(Reverse((cost, node))) = heap.pop() {
        let path = best[&node];
        if path.cost != cost || done.contains_key(&node) {
            continue;
        }
        done.insert(node, path);
        if path.hops == HOPS_MAX {
            continue;
        }
        for (next, edge) in edges(&node) {
            let first = if node == root { next } else { path.first };
            // A cost of zero would make ties that lead back.
            let found = Path { cost: path.cost.saturating_add(edge.max(1)), hops: path.hops + 1, first };
            if done.contains_key(&next) {
                continue;
            }
            let better = best.get(&next).is_none_or(|known| rank(&next, &found) < rank(&next, known));
            if better {
                best.insert(next, found);
                heap.push(Reverse((found.cost, next)));
            }
        }
    }
    done
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(n: u8) -> NodeId {
        NodeId([n; 32])
    }

    fn paths(edges: &[(u8, u8, u32)], before: &BTreeMap<NodeId, Path>) -> BTreeMap<NodeId, Path> {
        shortest_paths(node(0), before, |from| {
            let from = *from;
            let both = edges.iter().flat_map(|(a, b, cost)| [(*a, *b, *cost), (*b, *a, *cost)]);
            both.filter(move |(a, ..)| node(*a) == from)
                .map(|(_, b, cost)| (node(b), cost))
                .collect::<Vec<_>>()
                .into_iter()
        })
    }

    fn first(edges: &[(u8, u8, u32)], before: &BTreeMap<NodeId, Path>, to: u8) -> Option<(NodeId, u32)> {
        paths(edges, before).get(&node(to)).map(|p| (p.first, p.cost))
    }

    #[test]
    fn the_cheapest_way_wins_and_equal_ones_stay() {
        let none = BTreeMap::new();
        let square = [(0, 1, 10), (0, 2, 10), (1, 3, 10), (2, 3, 10)];
        assert_eq!(first(&square, &none, 3), Some((node(1), 20)));
        let with_2 = paths(&[(0, 2, 10), (2, 3, 10)], &none);
        assert_eq!(first(&square, &with_2, 3), Some((node(2), 20)), "an equal way takes over");
        let cheaper = [(0, 1, 10), (0, 2, 10), (1, 3, 9), (2, 3, 10)];
        assert_eq!(first(&cheaper, &with_2, 3), Some((node(1), 19)));
        assert_eq!(first(&square[..2], &none, 3), None);
        assert_eq!(paths(&square, &none)[&node(0)], Path { cost: 0, hops: 0, first: node(0) });
    }

    #[test]
    fn ways_are_no_longer_than_data_can_go() {
        let line: Vec<_> = (0..200).map(|n| (n, n + 1, 1)).collect();
        let reached = paths(&line, &BTreeMap::new());
        assert_eq!(reached.len(), usize::from(HOPS_MAX) + 1);
        assert_eq!(reached[&node(HOPS_MAX)].hops, HOPS_MAX);
    }
}
