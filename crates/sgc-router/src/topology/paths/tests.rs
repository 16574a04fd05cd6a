//! Tests of [`ShortestPaths`] against another computation of the same rules.

use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore, SeedableRng};

use super::*;

type Edges = BTreeMap<(NodeId, NodeId), u32>;
type Paths = BTreeMap<NodeId, (u64, u8, NodeId)>;

fn node(n: u16) -> NodeId {
    // Ids have another order than numbers.
    let mut id = [0; 32];
    id[..2].copy_from_slice(&n.wrapping_mul(40_503).to_be_bytes());
    NodeId(id)
}

/// Finds the paths by the rules of the specification alone: from the edges, and the paths before.
fn reference(root: NodeId, edges: &Edges, before: &Paths) -> Paths {
    let rank = |node: &NodeId, (cost, hops, first): (u64, u8, NodeId)| {
        (cost, before.get(node).is_none_or(|b| b.2 != first), hops, first)
    };
    let mut of: BTreeMap<NodeId, Vec<(NodeId, u32)>> = BTreeMap::new();
    for ((from, to), cost) in edges.iter().filter(|((from, to), _)| edges.contains_key(&(*to, *from))) {
        of.entry(*from).or_default().push((*to, *cost));
    }
    let mut best = BTreeMap::from([(root, (0, 0, root))]);
    let mut done = Paths::new();
    let mut waiting = BTreeSet::from([(0, root)]);
    while let Some((_, node)) = waiting.pop_first() {
        if done.contains_key(&node) {
            continue;
        }
        let path @ (cost, hops, first) = best[&node];
        done.insert(node, path);
        for (next, edge) in of.get(&node).into_iter().flatten().filter(|_| hops < HOPS_MAX) {
            let first = if node == root { *next } else { first };
            let found = (cost + u64::from((*edge).max(1)), hops + 1, first);
            if !done.contains_key(next) && best.get(next).is_none_or(|b| rank(next, found) < rank(next, *b)) {
                best.insert(*next, found);
                waiting.insert((found.0, *next));
            }
        }
    }
    done
}

/// A network that changes, the paths through it, and the same by the reference.
struct Trial {
    dice: ChaCha20Rng,
    routers: u16,
    claims: Edges,
    reference: Paths,
    changed: ShortestPaths,
    either: ShortestPaths,
    in_full: ShortestPaths,
    costs: u32,
    /// New links lead to one of so many next routers.
    span: u32,
    /// Number of times that a path moved.
    moves: usize,
    /// Number of paths that were as long as they may be.
    longest: usize,
}

impl Trial {
    fn new(seed: u64, routers: u16, costs: u32) -> Self {
        let paths = || ShortestPaths::new(node(0));
        Self {
            dice: ChaCha20Rng::seed_from_u64(seed),
            routers,
            claims: Edges::new(),
            reference: Paths::from([(node(0), (0, 0, node(0)))]),
            changed: paths(),
            either: paths(),
            in_full: paths(),
            costs,
            span: u32::from(routers) - 1,
            moves: 0,
            longest: 0,
        }
    }

    fn below(&mut self, n: u32) -> u32 {
        self.dice.next_u32() % n
    }

    fn cost(&mut self) -> u32 {
        // Some links claim as much as they can, which must neither overflow nor tie.
        if self.below(50) == 0 { u32::MAX } else { self.below(self.costs) }
    }

    /// Lets one end claim a cost, or nothing.
    fn claim(&mut self, from: u16, to: u16, cost: Option<u32>) {
        let (from, to) = (node(from), node(to));
        match cost {
            Some(cost) => self.claims.insert((from, to), cost),
            None => self.claims.remove(&(from, to)),
        };
        let costs = self.claims.get(&(from, to)).zip(self.claims.get(&(to, from))).map(|(a, b)| [*a, *b]);
        for paths in [&mut self.changed, &mut self.either, &mut self.in_full] {
            paths.set_edge(&from, &to, costs);
        }
    }

    fn link(&mut self, from: u16, to: u16) {
        for (from, to) in [(from, to), (to, from)] {
            let cost = self.cost();
            self.claim(from, to, Some(cost));
        }
    }

    /// Lets something happen to a link or a router.
    fn change(&mut self) {
        let links: Vec<_> = self.claims.keys().copied().collect();
        let numbers: BTreeMap<_, _> = (0..self.routers).map(|n| (node(n), n)).collect();
        let at = self.below(links.len().max(1) as u32) as usize;
        let picked = links.get(at).map(|(a, b)| (numbers[a], numbers[b]));
        let routers = u32::from(self.routers);
        let any = self.below(routers);
        let other = (any + 1 + self.below(self.span)) % routers;
        match (self.below(20), picked) {
            // A cost changes at one end.
            (0..=7, Some((from, to))) => {
                let cost = self.cost();
                self.claim(from, to, Some(cost));
            }
            // One end drops the link, or both do.
            (8..=9, Some((from, to))) => self.claim(from, to, None),
            (10, Some((from, to))) => {
                self.claim(from, to, None);
                self.claim(to, from, None);
            }
            // A router goes, or its word ends.
            (11, Some((gone, _))) => {
                for (from, to) in links.iter().map(|(a, b)| (numbers[a], numbers[b])) {
                    if from == gone || to == gone && any.is_multiple_of(2) {
                        self.claim(from, to, None);
                    }
                }
            }
            // A link comes.
            _ => self.link(any as u16, other as u16),
        }
    }

    fn check(&mut self, what: &str) {
        let before = std::mem::take(&mut self.reference);
        self.reference = reference(node(0), &self.claims, &before);
        let mut moved: Vec<_> =
            (0..self.routers).map(node).filter(|node| self.reference.get(node) != before.get(node)).collect();
        moved.sort();
        self.longest += self.reference.values().filter(|(_, hops, _)| *hops == HOPS_MAX).count();
        self.moves += moved.len();
        let found = [self.changed.search_changed(), self.either.search(), self.in_full.search_in_full()];
        for (paths, mut said) in [&self.changed, &self.either, &self.in_full].into_iter().zip(found) {
            said.sort();
            assert_eq!(said, moved, "{what}: moved");
            assert_eq!(paths.reached(), self.reference.len(), "{what}: reached");
            for n in 0..self.routers {
                let path = self.reference.get(&node(n)).map(|(cost, hops, first)| Path {
                    cost: u32::try_from(*cost).unwrap_or(u32::MAX),
                    hops: *hops,
                    first: *first,
                });
                assert_eq!(paths.get(&node(n)), path, "{what}: path to {n}");
            }
            let linked = self.claims.keys().filter(|(a, b)| self.claims.contains_key(&(*b, *a)));
            let linked: BTreeSet<_> = linked.map(|(a, _)| *a).chain([node(0)]).collect();
            assert_eq!(paths.index.keys().copied().collect::<BTreeSet<_>>(), linked, "{what}: kept");
        }
    }

    /// Changes the network that many times, some at once now and then.
    fn run(&mut self, name: &str, changes: usize) {
        self.check(name);
        for n in 0..changes {
            let at_once = if self.below(4) == 0 { 1 + self.below(12) } else { 1 };
            (0..at_once).for_each(|_| self.change());
            self.check(&format!("{name}, change {n}"));
        }
        assert!(self.moves > changes, "{name}: too little happened: {}", self.moves);
    }
}

#[test]
fn paths_after_random_changes_are_those_of_a_full_computation() {
    for seed in 0..2 {
        // Few different costs make many equal paths.
        for costs in [2, 4, 1000] {
            let mut grid = Trial::new(seed, 49, costs);
            for n in 0..49 {
                if n % 7 < 6 {
                    grid.link(n, n + 1);
                }
                if n < 42 {
                    grid.link(n, n + 7);
                }
            }
            grid.run("grid", 250);
            let mut sparse = Trial::new(seed, 40, costs);
            for n in 1..40 {
                let to = sparse.below(u32::from(n)) as u16;
                sparse.link(n, to);
            }
            sparse.run("tree with more links", 250);
            let mut hub = Trial::new(seed, 40, costs);
            for n in 2..40 {
                hub.link(n, n % 2);
                hub.link(n, 1 + n / 2);
            }
            hub.run("two hubs", 250);
        }
        let mut ring = Trial { span: 2, ..Trial::new(seed, 200, 3) };
        for n in 0..200 {
            ring.link(n, (n + 1) % 200);
            ring.link(n, (n + 2) % 200);
        }
        ring.run("ring longer than paths may be", 200);
        assert!(ring.longest > 20, "too few paths end at the limit: {}", ring.longest);
    }
}

fn link_all(paths: &mut ShortestPaths, edges: &[(u16, u16, u32)]) {
    edges.iter().for_each(|(a, b, cost)| paths.set_edge(&node(*a), &node(*b), Some([*cost; 2])));
    paths.search_changed();
}

fn first(paths: &ShortestPaths, to: u16) -> Option<(NodeId, u32)> {
    paths.get(&node(to)).map(|path| (path.first, path.cost))
}

#[test]
fn the_cheapest_path_wins_and_equal_ones_stay() {
    let mut paths = ShortestPaths::new(node(0));
    link_all(&mut paths, &[(0, 2, 10), (2, 3, 10)]);
    assert_eq!(first(&paths, 3), Some((node(2), 20)));
    link_all(&mut paths, &[(0, 1, 10), (1, 3, 10)]);
    assert_eq!(first(&paths, 3), Some((node(2), 20)), "an equal path takes over");
    link_all(&mut paths, &[(1, 3, 9)]);
    assert_eq!(first(&paths, 3), Some((node(1), 19)));
    link_all(&mut paths, &[(1, 3, 10)]);
    assert_eq!(first(&paths, 3), Some((node(1), 20)), "it goes back to an equal path");
    assert_eq!(paths.behind(&node(1)).len(), 2);
    assert!(paths.behind(&node(3)).is_empty() && paths.behind(&node(0)).is_empty());
}

#[test]
fn paths_are_no_longer_than_data_can_go() {
    let mut paths = ShortestPaths::new(node(0));
    link_all(&mut paths, &(0..200).map(|n| (n, n + 1, 1)).collect::<Vec<_>>());
    assert_eq!(paths.reached(), usize::from(HOPS_MAX) + 1);
    assert_eq!(paths.get(&node(HOPS_MAX.into())).map(|path| path.hops), Some(HOPS_MAX));
}
