//! The plan of faults that follows from a seed: what breaks or mends, and when. Pure.

use std::time::Duration;

use rand_chacha::ChaCha8Rng;
use rand_core::{RngCore, SeedableRng};

use crate::graph::{EDGES, Edge, End, Fault, Graph, Node, ROUTERS};
use crate::store_faults::StoreChaos;

/// The next step of a plan.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum Act {
    Break(Fault),
    Mend(Fault),
}

/// Faults with the times of their ends, and the time of the next fault.
#[derive(Default)]
pub(crate) struct Schedule {
    pub(crate) now: Duration,
    pub(crate) next_fault: Duration,
    pub(crate) active: Vec<(Duration, Fault)>,
}

impl Schedule {
    /// Goes on to the next end of a fault, or to the time of the next fault. Returns the fault that ends.
    pub(crate) fn advance(&mut self) -> Option<Fault> {
        let first = (0..self.active.len()).min_by_key(|i| self.active[*i].0);
        if let Some(i) = first.filter(|i| self.active[*i].0 <= self.next_fault) {
            let (until, fault) = self.active.remove(i);
            self.now = until;
            return Some(fault);
        }
        self.now = self.next_fault;
        None
    }

    /// Returns a fault that begins now and has this length.
    pub(crate) fn begin(&mut self, fault: Fault, length: Duration) -> Fault {
        self.active.push((self.now + length, fault.clone()));
        fault
    }
}

/// Returns the endless steps of a seed with their times since the beginning. Faults of the store are a stream of their
/// own beside those of the ring, which are the same with a store and without.
pub(crate) fn plan(seed: u64, cuts: bool, has_store: bool) -> impl Iterator<Item = (Duration, Act)> {
    let mut ring = Chaos::new(seed, cuts).peekable();
    let mut store = has_store.then(|| StoreChaos::new(seed)).into_iter().flatten().peekable();
    std::iter::from_fn(move || {
        let is_store_first = store.peek().zip(ring.peek()).is_some_and(|(store, ring)| store.0 < ring.0);
        if is_store_first { store.next() } else { ring.next() }
    })
}

/// The endless sequence of faults of the ring.
pub(crate) struct Chaos {
    rng: ChaCha8Rng,
    /// Links can be cut.
    cuts: bool,
    schedule: Schedule,
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
        Self { rng, cuts, schedule: Schedule::default(), faults: 0 }
    }

    /// Draws a fault, and sets the times of its end and of the next fault.
    fn fault(&mut self) -> Option<Fault> {
        let now = self.schedule.now;
        if self.faults % PARTITION_EVERY == PARTITION_FIRST {
            if let Some(until) = self.schedule.active.iter().map(|(until, _)| *until).max() {
                self.schedule.next_fault = until + PARTITION_PAUSE;
                return None;
            }
            let proxy = [Node::ROBOT, Node::DESK, Node::LAB][self.below(3)];
            let fault = Fault::Isolate { proxy, cut: self.cuts && self.below(2) == 0 };
            let length = self.between(1000, 5000);
            self.schedule.next_fault = now + length + PARTITION_PAUSE;
            return Some(self.schedule.begin(fault, length));
        }
        // One fault in four begins together with the previous one.
        let pause = if self.below(4) == 0 { Duration::ZERO } else { self.between(500, 5000) };
        self.schedule.next_fault = now + pause;
        if self.schedule.active.len() >= ACTIVE_MAX {
            self.schedule.next_fault = now + self.between(500, 2000);
            return None;
        }
        for _ in 0..DRAWS_MAX {
            let (fault, length) = self.draw();
            let active = || self.schedule.active.iter().map(|(_, fault)| fault);
            let apart = active().all(|other| {
                fault.routers().iter().all(|r| !other.routers().contains(r))
                    && fault.edges().iter().all(|e| !other.edges().contains(e))
            });
            let graph = Graph::whole().without(active()).without([&fault]);
            if apart && graph.connects() {
                return Some(self.schedule.begin(fault, length));
            }
        }
        self.schedule.next_fault = now + Duration::from_secs(1);
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

impl Iterator for Chaos {
    type Item = (Duration, Act);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(fault) = self.schedule.advance() {
                return Some((self.schedule.now, Act::Mend(fault)));
            }
            if let Some(fault) = self.fault() {
                self.faults += 1;
                return Some((self.schedule.now, Act::Break(fault)));
            }
        }
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
            let (at, act) = chaos.next().unwrap();
            now = at;
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
    let steps = Chaos::new(crate::SEED, true);
    let (mut kinds, mut active) = (std::collections::BTreeSet::new(), 0);
    let mut together = false;
    for (_, act) in steps.take_while(|(at, _)| *at < Duration::from_secs(crate::SECONDS)) {
        match act {
            Act::Break(fault) => {
                kinds.insert(fault.kind());
                active += 1;
            }
            Act::Mend(_) => active -= 1,
        }
        together |= active > 1;
    }
    assert!(kinds.len() >= 6 && kinds.contains("partition") && together, "{kinds:?}");
}

#[test]
fn faults_of_the_store_come_between_those_of_the_ring() {
    for seed in 0..20 {
        let steps: Vec<_> = plan(seed, true, true).take(500).collect();
        assert!(steps.is_sorted_by_key(|(at, _)| *at), "seed {seed}");
        let is_of_ring = |act: &Act| match act {
            Act::Break(fault) | Act::Mend(fault) => !matches!(fault, Fault::Store(_)),
        };
        let of_ring: Vec<_> = steps.iter().filter(|(_, act)| is_of_ring(act)).cloned().collect();
        assert!((100..400).contains(&of_ring.len()), "seed {seed}: {} of 500", of_ring.len());
        let alone: Vec<_> = plan(seed, true, false).take(of_ring.len()).collect();
        assert_eq!(of_ring, alone, "seed {seed}");
    }
}
