//! Faults of the store, and their plan. Pure, as the plan of the ring.

use std::time::Duration;

use sgc_testkit::Dice;

use crate::graph::{End, Fault, Node, ROUTERS};
use crate::plan::{Act, Schedule};

/// Servers of the store. At first, the first half are primaries, and the others their replicas in the same order.
pub(crate) const SERVERS: usize = 6;
/// Most faults at a time.
const ACTIVE_MAX: usize = 2;

/// A fault of the store.
#[derive(Clone, PartialEq, Eq, Debug)]
pub(crate) enum StoreFault {
    /// SIGKILL. The servers are started again at the end of the fault, with their places in the cluster and no keys.
    Kill { servers: Vec<usize> },
    /// SIGSTOP.
    Stop { server: usize },
    /// The cables between routers and the store are down at one end: the router's, which dials, or the store's.
    Cut { routers: Vec<Node>, end: End },
}

impl StoreFault {
    /// Returns the label by which outages are grouped.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Kill { servers } if servers.len() == SERVERS => "store: kill, all servers",
            Self::Kill { .. } => "store: kill",
            Self::Stop { .. } => "store: stop",
            Self::Cut { routers, .. } if routers.len() == ROUTERS => "store: cut, all routers",
            Self::Cut { .. } => "store: cut",
        }
    }

    /// Returns `true` if a server or a cable would have both faults.
    fn overlaps(&self, other: &Self) -> bool {
        let common = self.servers().iter().any(|server| other.servers().contains(server));
        common || self.routers().iter().any(|router| other.routers().contains(router))
    }

    fn servers(&self) -> &[usize] {
        match self {
            Self::Kill { servers } => servers,
            Self::Stop { server } => std::slice::from_ref(server),
            Self::Cut { .. } => &[],
        }
    }

    fn routers(&self) -> &[Node] {
        match self {
            Self::Cut { routers, .. } => routers,
            Self::Kill { .. } | Self::Stop { .. } => &[],
        }
    }
}

/// The endless sequence of faults of the store.
pub(crate) struct StoreChaos {
    dice: Dice,
    schedule: Schedule,
}

impl StoreChaos {
    pub(crate) fn new(seed: u64) -> Self {
        // Not the numbers of the ring's faults.
        Self { dice: Dice::new(!seed), schedule: Schedule::default() }
    }

    /// Draws a fault, and sets the times of its end and of the next fault.
    fn fault(&mut self) -> Option<Fault> {
        self.schedule.next_fault = self.schedule.now + self.between(500, 3000);
        if self.schedule.active.len() >= ACTIVE_MAX {
            return None;
        }
        let fault = Fault::Store(self.draw());
        let length = self.length();
        let overlaps = |(_, other): &(Duration, Fault)| match (other, &fault) {
            (Fault::Store(other), Fault::Store(fault)) => other.overlaps(fault),
            _ => false,
        };
        let is_apart = !self.schedule.active.iter().any(overlaps);
        is_apart.then(|| self.schedule.begin(fault, length))
    }

    fn draw(&mut self) -> StoreFault {
        match self.dice.below(10) {
            0..3 => StoreFault::Kill { servers: vec![self.dice.below(SERVERS)] },
            3..5 => StoreFault::Stop { server: self.dice.below(SERVERS) },
            5 => StoreFault::Kill { servers: (0..SERVERS).collect() },
            6..9 => StoreFault::Cut { routers: vec![Node(self.dice.below(ROUTERS))], end: self.end() },
            _ => StoreFault::Cut { routers: Node::routers().collect(), end: self.end() },
        }
    }

    fn end(&mut self) -> End {
        if self.dice.chance(50) { End::Dialling } else { End::Listening }
    }

    fn length(&mut self) -> Duration {
        match self.dice.below(4) {
            // A primary returns, without keys, before a replica takes its place.
            0 => self.between(50, 800),
            // Routers tell that the store is down.
            1 => self.between(6000, 10_000),
            _ => self.between(1000, 5000),
        }
    }

    fn between(&mut self, from_ms: usize, to_ms: usize) -> Duration {
        Duration::from_millis(self.dice.within(from_ms..=to_ms) as u64)
    }
}

impl Iterator for StoreChaos {
    type Item = (Duration, Act);

    fn next(&mut self) -> Option<Self::Item> {
        loop {
            if let Some(fault) = self.schedule.advance() {
                return Some((self.schedule.now, Act::Mend(fault)));
            }
            if let Some(fault) = self.fault() {
                return Some((self.schedule.now, Act::Break(fault)));
            }
        }
    }
}

#[test]
fn the_usual_seed_breaks_the_store_in_every_way() {
    // The run waits for the store between faults, so it has no time for the whole plan.
    let time = Duration::from_secs(crate::STORE_SECONDS) * 2 / 3;
    let (mut kinds, mut killed) = (std::collections::BTreeSet::new(), Vec::new());
    for (_, act) in StoreChaos::new(crate::STORE_SEED).take_while(|(at, _)| *at < time) {
        if let Act::Break(Fault::Store(fault)) = act {
            kinds.insert(fault.kind());
            killed.extend(fault.servers().iter().filter(|_| fault.kind() == "store: kill").copied());
        }
    }
    assert_eq!(kinds.len(), 5, "{kinds:?}");
    let is_primary = |server: &usize| *server < SERVERS / 2;
    assert!(killed.iter().any(is_primary) && !killed.iter().all(is_primary), "{killed:?}");
}

#[test]
fn nothing_of_the_store_breaks_twice_at_a_time() {
    let (mut kinds, mut whole) = (std::collections::BTreeMap::<&str, u32>::new(), 0);
    for seed in 0..200 {
        let mut active = Vec::<StoreFault>::new();
        for (at, act) in StoreChaos::new(seed).take(200) {
            match act {
                Act::Break(Fault::Store(fault)) => {
                    *kinds.entry(fault.kind()).or_default() += 1;
                    assert!(active.iter().all(|other| !other.overlaps(&fault)), "seed {seed}: {active:?}");
                    whole += u32::from(active.is_empty());
                    active.push(fault);
                }
                Act::Mend(Fault::Store(fault)) => active.retain(|other| *other != fault),
                other => panic!("{at:?}: {other:?}"),
            }
            assert!(active.len() <= ACTIVE_MAX, "seed {seed}: {active:?}");
        }
    }
    assert!(kinds.len() == 5 && kinds.values().all(|n| *n > 500), "{kinds:?}");
    assert!(whole > 1000, "the store is whole {whole} times");
}
