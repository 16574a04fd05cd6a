//! Shortest paths through the network of routers, from one of them to all, kept up to date edge by edge.
//!
//! A change of some edges costs in proportion to the routers whose paths it changes, and to their edges: the algorithm
//! is that of Ramalingam and Reps for batches of changes ("An incremental algorithm for a generalization of the
//! shortest-path problem", 1996). It does not decide which edges count.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, BinaryHeap};
use std::mem;

use sgc_wire::NodeId;

use crate::limits::HOPS_MAX;

/// Index of a router.
type VertexId = usize;

/// Routers whose routes may change, the cheapest first.
type Heap = BinaryHeap<Reverse<(u64, VertexId)>>;

/// The router whose paths these are.
const ROOT: VertexId = 0;
/// All paths are computed anew if the edges of more than one router in this many changed.
const CHANGED_PART_MAX: usize = 2;

/// The path to a router, as the rest of the machine sees it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Path {
    /// Sum of the costs of its links, microseconds of round trip.
    pub cost: u32,
    /// Number of its links.
    pub hops: u8,
    /// The first node on it; the node itself for the root.
    pub first: NodeId,
}

/// A path by indices. Its cost cannot overflow, so a path always costs more than each of its beginnings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Route {
    cost: u64,
    hops: u8,
    first: VertexId,
}

/// One end's view of an edge.
#[derive(Clone, Copy, Debug)]
struct Edge {
    to: VertexId,
    /// Cost towards the other end.
    out: u32,
    /// Cost from there.
    back: u32,
}

/// A router.
#[derive(Debug)]
struct Vertex {
    id: NodeId,
    /// By other end, ascending.
    edges: Vec<Edge>,
    /// The route as the last search left it.
    before: Option<Route>,
    route: Option<Route>,
    /// The best route by those of the neighbours; equal to `route` between searches.
    found: Option<Route>,
    /// The neighbour before the end of `found`.
    parent: VertexId,
}

impl Vertex {
    fn new(id: NodeId) -> Self {
        Self { id, edges: Vec::new(), before: None, route: None, found: None, parent: ROOT }
    }

    /// Returns the least cost at which the route may still change; `None` if it is final.
    fn key(&self) -> Option<u64> {
        if self.route == self.found {
            return None;
        }
        self.route.into_iter().chain(self.found).map(|route| route.cost).min()
    }
}

/// The routers that are linked to each other, and the shortest paths from one to all. Public for measurements only.
#[derive(Debug)]
pub struct ShortestPaths {
    vertices: Vec<Vertex>,
    index: BTreeMap<NodeId, VertexId>,
    /// Vertices without a router.
    free: Vec<VertexId>,
    /// Vertices that an edge leads to otherwise than at the last search.
    changed: BTreeSet<VertexId>,
    /// Number of routers in reach.
    reached: usize,
}

impl ShortestPaths {
    /// Returns the paths from a router without links.
    pub fn new(root: NodeId) -> Self {
        let route = Some(Route { cost: 0, hops: 0, first: ROOT });
        let vertex = Vertex { before: route, route, found: route, ..Vertex::new(root) };
        Self {
            vertices: vec![vertex],
            index: BTreeMap::from([(root, ROOT)]),
            free: Vec::new(),
            changed: BTreeSet::new(),
            reached: 1,
        }
    }

    /// Returns the path to a router, of the last search.
    pub fn get(&self, node: &NodeId) -> Option<Path> {
        let Route { cost, hops, first } = self.vertices[*self.index.get(node)?].route?;
        let cost = u32::try_from(cost).unwrap_or(u32::MAX);
        Some(Path { cost, hops, first: self.vertices[first].id })
    }

    /// Returns the number of routers in reach, the root among them.
    pub fn reached(&self) -> usize {
        self.reached
    }

    /// Returns the routers whose paths begin with this one.
    pub(super) fn behind(&self, first: &NodeId) -> Vec<NodeId> {
        let Some(first) = self.index.get(first).copied().filter(|v| *v != ROOT) else { return Vec::new() };
        let is_behind = |vertex: &&Vertex| vertex.route.is_some_and(|route| route.first == first);
        // Every path that begins with a router begins like the path to that router.
        if !is_behind(&&self.vertices[first]) {
            return Vec::new();
        }
        self.vertices.iter().filter(is_behind).map(|vertex| vertex.id).collect()
    }

    // ---- Changes.

    /// Sets the costs of an edge from the first router to the second and back; `None` removes it. Paths follow at the
    /// next search.
    pub fn set_edge(&mut self, from: &NodeId, to: &NodeId, costs: Option<[u32; 2]>) {
        // A cost of zero would make ties that lead back.
        let Some([out, back]) = costs.map(|costs| costs.map(|cost| cost.max(1))) else {
            if let (Some(from), Some(to)) = (self.index.get(from).copied(), self.index.get(to).copied()) {
                self.remove_edge(from, to);
                self.remove_edge(to, from);
            }
            return;
        };
        let (from, to) = (self.vertex(from), self.vertex(to));
        self.put_edge(from, Edge { to, out, back });
        self.put_edge(to, Edge { to: from, out: back, back: out });
    }

    fn vertex(&mut self, node: &NodeId) -> VertexId {
        if let Some(known) = self.index.get(node) {
            return *known;
        }
        let vertex = Vertex::new(*node);
        let at = if let Some(at) = self.free.pop() {
            self.vertices[at] = vertex;
            at
        } else {
            self.vertices.push(vertex);
            self.vertices.len() - 1
        };
        self.index.insert(*node, at);
        at
    }

    fn put_edge(&mut self, at: VertexId, edge: Edge) {
        let edges = &mut self.vertices[at].edges;
        match edges.binary_search_by_key(&edge.to, |e| e.to) {
            Ok(known) => {
                let before = mem::replace(&mut edges[known], edge);
                if before.back == edge.back {
                    return;
                }
            }
            Err(place) => edges.insert(place, edge),
        }
        self.changed.insert(at);
    }

    fn remove_edge(&mut self, at: VertexId, to: VertexId) {
        let edges = &mut self.vertices[at].edges;
        if let Ok(known) = edges.binary_search_by_key(&to, |e| e.to) {
            edges.remove(known);
            self.changed.insert(at);
        }
    }

    // ---- Searches.

    /// Searches for the paths after the changes since the last search. Returns the routers to which the path is another
    /// one, or is gone.
    pub fn search(&mut self) -> Vec<NodeId> {
        if self.changed.len() * CHANGED_PART_MAX > self.index.len() {
            self.search_in_full()
        } else {
            self.search_changed()
        }
    }

    /// Searches for all paths (Dijkstra). Returns the same as [`Self::search`].
    pub fn search_in_full(&mut self) -> Vec<NodeId> {
        for vertex in &mut self.vertices[ROOT + 1..] {
            (vertex.route, vertex.found) = (None, None);
        }
        let mut heap = Heap::new();
        self.relax(ROOT, &mut heap);
        while let Some(Reverse((cost, at))) = heap.pop() {
            let vertex = &mut self.vertices[at];
            if vertex.route.is_some() || vertex.found.is_none_or(|found| found.cost != cost) {
                continue;
            }
            vertex.route = vertex.found;
            self.relax(at, &mut heap);
        }
        self.finish(0..self.vertices.len())
    }

    /// Searches only for the paths that the changes concern. Returns the same as [`Self::search`].
    pub fn search_changed(&mut self) -> Vec<NodeId> {
        let mut heap = Heap::new();
        for at in self.changed.iter().copied().filter(|at| *at != ROOT).collect::<Vec<_>>() {
            self.assess(at, &mut heap);
        }
        let mut touched = Vec::new();
        // Routes that cost less than the entry at hand are final, because each depends on cheaper ones alone.
        while let Some(Reverse((cost, at))) = heap.pop() {
            let vertex = &mut self.vertices[at];
            if vertex.key() != Some(cost) {
                continue;
            }
            touched.push(at);
            if vertex.found.is_some_and(|found| found.cost == cost) {
                vertex.route = vertex.found;
            } else {
                // The old route is gone. Its neighbours look for others before this one takes a costlier one.
                vertex.route = None;
                heap.extend(vertex.found.map(|found| Reverse((found.cost, at))));
            }
            self.relax(at, &mut heap);
        }
        self.finish(touched)
    }

    /// Lets the neighbours of a router follow its route.
    fn relax(&mut self, at: VertexId, heap: &mut Heap) {
        let edges = mem::take(&mut self.vertices[at].edges);
        for edge in edges.iter().filter(|edge| edge.to != ROOT) {
            let next = &self.vertices[edge.to];
            if next.found.is_some() && next.parent == at {
                self.assess(edge.to, heap);
            } else if let Some(route) = self.continued(at, edge.to, edge.out)
                && next.found.is_none_or(|known| self.rank(edge.to, route) < self.rank(edge.to, known))
            {
                self.set_found(edge.to, Some((route, at)), heap);
            }
        }
        self.vertices[at].edges = edges;
    }

    /// Finds the best route to a router by those of its neighbours.
    fn assess(&mut self, at: VertexId, heap: &mut Heap) {
        let vertex = &self.vertices[at];
        let over = |edge: &Edge| Some((self.continued(edge.to, at, edge.back)?, edge.to));
        let best = vertex.edges.iter().filter_map(over).min_by_key(|(route, _)| self.rank(at, *route));
        self.set_found(at, best, heap);
    }

    fn set_found(&mut self, at: VertexId, found: Option<(Route, VertexId)>, heap: &mut Heap) {
        let vertex = &mut self.vertices[at];
        vertex.found = found.map(|(route, _)| route);
        vertex.parent = found.map_or(ROOT, |(_, parent)| parent);
        heap.extend(vertex.key().map(|key| Reverse((key, at))));
    }

    /// Returns the route to a router over a neighbour.
    fn continued(&self, over: VertexId, to: VertexId, cost: u32) -> Option<Route> {
        let route = self.vertices[over].route.filter(|route| route.hops < HOPS_MAX)?;
        let first = if over == ROOT { to } else { route.first };
        Some(Route { cost: route.cost + u64::from(cost), hops: route.hops + 1, first })
    }

    /// Orders the routes to a router, the best one first.
    fn rank(&self, to: VertexId, route: Route) -> (u64, bool, u8, &NodeId) {
        let kept = self.vertices[to].before.is_some_and(|before| before.first == route.first);
        (route.cost, !kept, route.hops, &self.vertices[route.first].id)
    }

    /// Ends a search that set these routes.
    fn finish(&mut self, set: impl IntoIterator<Item = VertexId>) -> Vec<NodeId> {
        let mut moved = Vec::new();
        for at in set {
            let vertex = &mut self.vertices[at];
            let before = mem::replace(&mut vertex.before, vertex.route);
            if before != vertex.route {
                moved.push(vertex.id);
                self.reached -= usize::from(before.is_some());
                self.reached += usize::from(vertex.route.is_some());
            }
        }
        for at in mem::take(&mut self.changed) {
            let vertex = &self.vertices[at];
            if at != ROOT && vertex.edges.is_empty() {
                self.index.remove(&vertex.id);
                self.free.push(at);
            }
        }
        moved
    }
}

#[cfg(test)]
mod tests;
