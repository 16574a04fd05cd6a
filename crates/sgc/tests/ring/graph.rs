//! The ring as a graph, and the faults that follow from a seed. Pure, without processes and clocks: a plan says what
//! breaks or mends and when, and [`Graph`] says what is still connected.

use std::fmt;
use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use rand_core::{RngCore, SeedableRng};

/// A node, by its number: five routers, then the proxies.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Node(pub(crate) usize);

pub(crate) const NODES: [Node; 8] =
    [Node(0), Node(1), Node(2), Node(3), Node(4), Node::ROBOT, Node::DESK, Node::LAB];
const ROUTERS: usize = 5;

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
const EDGES: [(Node, Node); 12] = [
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
        }
    }

    /// Returns the links that the fault takes down.
    pub(crate) fn edges(&self) -> Vec<Edge> {
        match self {
            Self::Cut { edge, .. } => vec![*edge],
            Self::Isolate { proxy, cut: true } => Edge::touching(*proxy).collect(),
            Self::Kill { .. } | Self::Stop { .. } | Self::Isolate { .. } => Vec::new(),
        }
    }

    /// Returns the routers that the fault takes down.
    pub(crate) fn routers(&self) -> Vec<Node> {
        match self {
            Self::Kill { router, .. } | Self::Stop { router } => vec![*router],
            Self::Isolate { proxy, cut: false } => {
                Edge::touching(*proxy).map(|edge| edge.end(End::Listening)).collect()
            }
            Self::Cut { .. } | Self::Isolate { .. } => Vec::new(),
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

/// The next step of a plan.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum Act {
    Break(Fault),
    Mend(Fault),
}

/// The endless sequence of faults of a seed.
pub(crate) struct Chaos {
    rng: ChaCha8Rng,
    /// Links can be cut.
    cuts: bool,
    now: Duration,
    next_fault: Duration,
    active: Vec<(Duration, Fault)>,
    faults: u32,
}

/// Most faults at a time.
const ACTIVE_MAX: usize = 2;
/// One fault in this many is a partition. The first comes early enough for the shortest run.
const PARTITION_EVERY: u32 = 10;
const PARTITION_FIRST: u32 = 5;
/// Pause before and after a partition, so that its length is what the plan says.
const PARTITION_PAUSE: Duration = Duration::from_secs(4);
/// Most draws in search of a fault that leaves a path.
const DRAWS_MAX: u32 = 64;

impl Chaos {
    pub(crate) fn new(seed: u64, cuts: bool) -> Self {
        let rng = ChaCha8Rng::seed_from_u64(seed);
        Self { rng, cuts, now: Duration::ZERO, next_fault: Duration::ZERO, active: Vec::new(), faults: 0 }
    }

    /// Returns the next step and the time to wait before it.
    pub(crate) fn next(&mut self) -> (Duration, Act) {
        let before = self.now;
        loop {
            let mend = (0..self.active.len()).min_by_key(|i| self.active[*i].0);
            if let Some(i) = mend.filter(|i| self.active[*i].0 <= self.next_fault) {
                let (until, fault) = self.active.remove(i);
                self.now = until;
                return (self.now - before, Act::Mend(fault));
            }
            self.now = self.next_fault;
            if let Some(fault) = self.fault() {
                self.faults += 1;
                return (self.now - before, Act::Break(fault));
            }
        }
    }

    /// Draws a fault, and sets the times of its end and of the next fault.
    fn fault(&mut self) -> Option<Fault> {
        if self.faults % PARTITION_EVERY == PARTITION_FIRST {
            if let Some(until) = self.active.iter().map(|(until, _)| *until).max() {
                self.next_fault = until + PARTITION_PAUSE;
                return None;
            }
            let proxy = [Node::ROBOT, Node::DESK, Node::LAB][self.below(3)];
            let fault = Fault::Isolate { proxy, cut: self.cuts && self.below(2) == 0 };
            let until = self.now + self.between(1000, 5000);
            self.next_fault = until + PARTITION_PAUSE;
            self.active.push((until, fault.clone()));
            return Some(fault);
        }
        // One fault in four begins together with the previous one.
        let pause = if self.below(4) == 0 { Duration::ZERO } else { self.between(500, 5000) };
        self.next_fault = self.now + pause;
        if self.active.len() >= ACTIVE_MAX {
            self.next_fault = self.now + self.between(500, 2000);
            return None;
        }
        for _ in 0..DRAWS_MAX {
            let (fault, length) = self.draw();
            let apart = self.active.iter().all(|(_, other)| {
                fault.routers().iter().all(|r| !other.routers().contains(r))
                    && fault.edges().iter().all(|e| !other.edges().contains(e))
            });
            let graph = Graph::whole().without(self.active.iter().map(|(_, f)| f)).without([&fault]);
            if apart && graph.connects() {
                self.active.push((self.now + length, fault.clone()));
                return Some(fault);
            }
        }
        self.next_fault = self.now + Duration::from_secs(1);
        None
    }

    fn draw(&mut self) -> (Fault, Duration) {
        let router = Node(self.below(ROUTERS));
        match self.below(8) {
            0..=3 if self.cuts => {
                let edge = Edge(self.below(EDGES.len()));
                let ends = [&[End::Dialling][..], &[End::Listening], &[End::Dialling, End::Listening]];
                let ends = ends[self.below(ends.len())].to_vec();
                (Fault::Cut { edge, ends }, self.length())
            }
            0..=5 => {
                let forgets = self.below(2) == 0;
                (Fault::Kill { router, forgets }, self.between(100, 6000))
            }
            _ => (Fault::Stop { router }, self.length()),
        }
    }

    /// Draws a length. One in three is near to a link's idle limit of 10 s, or longer.
    fn length(&mut self) -> Duration {
        if self.below(3) == 0 { self.between(8000, 14_000) } else { self.between(500, 5000) }
    }

    fn below(&mut self, bound: usize) -> usize {
        usize::try_from(self.rng.next_u32()).unwrap() % bound
    }

    fn between(&mut self, from_ms: usize, to_ms: usize) -> Duration {
        Duration::from_millis(u64::try_from(from_ms + self.below(to_ms - from_ms)).unwrap())
    }
}

#[test]
fn plans_leave_a_way_but_for_brief_partitions() {
    let mut kinds = std::collections::BTreeMap::<&str, u32>::new();
    let (mut pairs, mut longest) = (0, Duration::ZERO);
    for seed in 0..200 {
        let mut chaos = Chaos::new(seed, seed % 4 != 0);
        let (mut now, mut active) = (Duration::ZERO, Vec::<Fault>::new());
        let mut parted_at = None;
        while now < Duration::from_secs(300) {
            let (after, act) = chaos.next();
            now += after;
            match act {
                Act::Break(fault) => {
                    *kinds.entry(fault.kind()).or_default() += 1;
                    active.push(fault);
                }
                Act::Mend(fault) => active.retain(|other| *other != fault),
            }
            let parted = active.iter().any(|fault| matches!(fault, Fault::Isolate { .. }));
            assert_eq!(Graph::whole().without(&active).connects(), !parted, "seed {seed}: {active:?}");
            assert!(active.len() <= if parted { 1 } else { ACTIVE_MAX }, "seed {seed}: {active:?}");
            pairs += u32::from(active.len() == 2);
            match (parted, parted_at) {
                (true, None) => parted_at = Some(now),
                (false, Some(since)) => {
                    longest = longest.max(now - since);
                    parted_at = None;
                }
                _ => {}
            }
        }
        assert!(chaos.faults >= 40, "seed {seed}: {} faults", chaos.faults);
    }
    assert_eq!(kinds.len(), 7, "{kinds:?}");
    assert!(kinds.values().all(|n| *n > 200) && pairs > 1000, "{kinds:?}, {pairs} pairs");
    assert!(longest <= Duration::from_secs(5), "{longest:?}");
}

#[test]
fn the_usual_seed_has_something_of_everything() {
    let mut chaos = Chaos::new(crate::SEED, true);
    let (mut now, mut kinds, mut together) = (Duration::ZERO, std::collections::BTreeSet::new(), false);
    while now < Duration::from_secs(crate::SECONDS) {
        let (after, act) = chaos.next();
        now += after;
        if let Act::Break(fault) = act {
            kinds.insert(fault.kind());
            together |= chaos.active.len() > 1;
        }
    }
    assert!(kinds.len() >= 6 && kinds.contains("partition") && together, "{kinds:?}");
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
