//! The ring as a graph, and what can break in it. Pure, without processes and clocks: [`Graph`] says what is still
//! connected.

use std::fmt;

use crate::store_faults::StoreFault;

/// A node, by its number: five routers, then the proxies.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Node(pub(crate) usize);

pub(crate) const NODES: [Node; 8] =
    [Node(0), Node(1), Node(2), Node(3), Node(4), Node::ROBOT, Node::DESK, Node::LAB];
pub(crate) const ROUTERS: usize = 5;

impl Node {
    /// The proxy that publishes.
    pub(crate) const ROBOT: Self = Self(5);
    /// A proxy that receives, attached to two routers.
    pub(crate) const DESK: Self = Self(6);
    /// A proxy that receives, attached to one router.
    pub(crate) const LAB: Self = Self(7);

    pub(crate) fn name(self) -> &'static str {
        ["r0", "r1", "r2", "r3", "r4", "robot", "desk", "lab"][self.0]
    }

    pub(crate) fn routers() -> impl Iterator<Item = Self> {
        (0..ROUTERS).map(Self)
    }

    pub(crate) fn is_router(self) -> bool {
        self.0 < ROUTERS
    }
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A link, by its number in [`EDGES`].
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) struct Edge(pub(crate) usize);

/// The links as (dialling, listening) pairs: the ring, two chords, and the links of the proxies.
pub(crate) const EDGES: [(Node, Node); 12] = [
    (Node(0), Node(1)),
    (Node(1), Node(2)),
    (Node(2), Node(3)),
    (Node(3), Node(4)),
    (Node(4), Node(0)),
    (Node(0), Node(2)),
    (Node(3), Node(1)),
    (Node::ROBOT, Node(0)),
    (Node::ROBOT, Node(1)),
    (Node::DESK, Node(2)),
    (Node::DESK, Node(3)),
    (Node::LAB, Node(4)),
];

impl Edge {
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        (0..EDGES.len()).map(Self)
    }

    pub(crate) fn touching(node: Node) -> impl Iterator<Item = Self> {
        Self::all().filter(move |edge| edge.end(End::Dialling) == node || edge.end(End::Listening) == node)
    }

    pub(crate) fn end(self, end: End) -> Node {
        match end {
            End::Dialling => EDGES[self.0].0,
            End::Listening => EDGES[self.0].1,
        }
    }
}

impl fmt::Debug for Edge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}-{:?}", self.end(End::Dialling), self.end(End::Listening))
    }
}

/// One end of a link.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum End {
    Dialling,
    Listening,
}

/// A fault.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum Fault {
    /// Interfaces of a link are down. An end that is still up has no carrier.
    Cut { edge: Edge, ends: Vec<End> },
    /// SIGKILL. The router is started again at the end of the fault, with its state or without.
    Kill { router: Node, forgets: bool },
    /// SIGSTOP.
    Stop { router: Node },
    /// No path leads to a proxy: its links are cut at its end, or its routers are stopped.
    Isolate { proxy: Node, cut: bool },
    /// A fault of the store of names. It takes no link down and no router.
    Store(StoreFault),
}

impl Fault {
    /// Returns the label by which outages are grouped.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Cut { ends, .. } if ends.len() == 2 => "cut, both ends",
            Self::Cut { ends, .. } if ends[0] == End::Dialling => "cut, dialling end",
            Self::Cut { .. } => "cut, listening end",
            Self::Kill { forgets: true, .. } => "kill, memory lost",
            Self::Kill { .. } => "kill, memory kept",
            Self::Stop { .. } => "stop",
            Self::Isolate { .. } => "partition",
            Self::Store(fault) => fault.kind(),
        }
    }

    /// Returns the links that the fault takes down.
    pub(crate) fn edges(&self) -> Vec<Edge> {
        match self {
            Self::Cut { edge, .. } => vec![*edge],
            Self::Isolate { proxy, cut: true } => Edge::touching(*proxy).collect(),
            Self::Kill { .. } | Self::Stop { .. } | Self::Isolate { .. } | Self::Store(_) => Vec::new(),
        }
    }

    /// Returns the routers that the fault takes down.
    pub(crate) fn routers(&self) -> Vec<Node> {
        match self {
            Self::Kill { router, .. } | Self::Stop { router } => vec![*router],
            Self::Isolate { proxy, cut: false } => {
                Edge::touching(*proxy).map(|edge| edge.end(End::Listening)).collect()
            }
            Self::Cut { .. } | Self::Isolate { .. } | Self::Store(_) => Vec::new(),
        }
    }
}

/// The working links and routers.
#[derive(Clone)]
pub(crate) struct Graph {
    pub(crate) edges: [bool; EDGES.len()],
    pub(crate) routers: [bool; ROUTERS],
}

impl Graph {
    pub(crate) fn whole() -> Self {
        Self { edges: [true; EDGES.len()], routers: [true; ROUTERS] }
    }

    /// Removes the links and routers that faults take down.
    pub(crate) fn without<'a>(mut self, faults: impl IntoIterator<Item = &'a Fault>) -> Self {
        for fault in faults {
            fault.edges().into_iter().for_each(|edge| self.edges[edge.0] = false);
            fault.routers().into_iter().for_each(|router| self.routers[router.0] = false);
        }
        self
    }

    /// Returns `true` if the robot reaches both other proxies over routers.
    pub(crate) fn connects(&self) -> bool {
        let reached = self.reached_from(Node::ROBOT);
        reached[Node::DESK.0] && reached[Node::LAB.0]
    }

    fn reached_from(&self, start: Node) -> [bool; NODES.len()] {
        let mut reached = [false; NODES.len()];
        let mut open = vec![start];
        while let Some(node) = open.pop() {
            if std::mem::replace(&mut reached[node.0], true) || (node != start && !node.is_router()) {
                continue;
            }
            for edge in Edge::touching(node).filter(|edge| self.edges[edge.0]) {
                let (a, b) = (edge.end(End::Dialling), edge.end(End::Listening));
                let other = if a == node { b } else { a };
                if !other.is_router() || self.routers[other.0] {
                    open.push(other);
                }
            }
        }
        reached
    }
}

#[test]
fn the_graph_knows_its_bridges() {
    let cut = |edge| Fault::Cut { edge: Edge(edge), ends: vec![End::Dialling] };
    let kill = |router| Fault::Kill { router: Node(router), forgets: false };
    let connects = |faults: &[Fault]| Graph::whole().without(faults).connects();
    assert!(connects(&[]) && connects(&[cut(7)]) && connects(&[kill(2), cut(0)]));
    assert!(!connects(&[kill(4)]) && !connects(&[cut(11)]), "lab has one way in");
    assert!(!connects(&[cut(7), cut(8)]) && !connects(&[kill(0), cut(8)]));
    assert!(!connects(&[kill(3), cut(4)]), "r4 has two neighbours");
    // A proxy carries nothing: over desk there would be a way from r2 to r3.
    assert!(!connects(&[cut(2), cut(6), cut(4)]));
}
