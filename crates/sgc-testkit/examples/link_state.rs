//! Measures one router among up to 10 000 others: `make bench-link-state`.
//!
//! The first table has the searches for paths alone, after a change and in full, on networks like those of `scale`. The
//! second has a whole router that gets all link states, signed, from its neighbours. `--sizes 100,1000` selects sizes.
#![allow(clippy::print_stdout, reason = "the tables are what it is for")]

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use sgc_router::{Limits, LinkId, MappingKind, Neighbour, Output, Router, RouterConfig, ShortestPaths};
use sgc_testkit::{Clock, CountingAllocator, Dice, Member, identity, live_bytes};
use sgc_trust::Identity;
use sgc_wire::{
    Adjacency, Control, Encode, Hello, LinkStateBody, MINOR_VERSION, Now, SignedBody, UnixMillis,
};

/// Least number of timed changes of a kind.
const CHANGES: usize = 400;
/// Time between two changes, longer than between two searches.
const PAUSE: Duration = Duration::from_millis(200);
const LEASE_MS: u32 = 300_000;
const COST: u32 = 10_000;

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

/// Returns the processor time of this thread.
fn cpu() -> Duration {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    Duration::new(time.tv_sec as u64, time.tv_nsec as u32)
}

/// Times of one kind of work.
#[derive(Default)]
struct Times(Vec<Duration>);

impl Times {
    fn time<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let began = cpu();
        let result = work();
        self.0.push(cpu() - began);
        result
    }

    /// Returns the median and the greatest of a hundred, in microseconds.
    fn cells(&mut self) -> [String; 2] {
        self.0.sort();
        let at = |part: usize| self.0.get(self.0.len() * part / 100).copied().unwrap_or_default();
        [50, 99].map(|part| format!("{:.1}", at(part).as_secs_f64() * 1e6))
    }

    fn mean(&self) -> f64 {
        self.0.iter().sum::<Duration>().as_secs_f64() * 1e6 / self.0.len().max(1) as f64
    }
}

/// A network: each router is linked to two earlier ones, preferably to well-linked ones (Barabási and Albert).
struct Network {
    dice: Dice,
    /// The neighbours of each router, with the cost from there.
    links: Vec<BTreeMap<usize, u32>>,
}

impl Network {
    fn new(routers: usize) -> Self {
        let mut network = Self { dice: Dice::new(routers as u64), links: vec![BTreeMap::new(); routers] };
        let mut ends = vec![0];
        for router in 1..routers {
            let mut chosen = BTreeSet::new();
            while chosen.len() < 2.min(router) {
                chosen.extend(network.dice.pick(&ends));
            }
            for other in chosen {
                let cost = network.cost();
                network.set(router, other, Some(cost));
                ends.extend([router, other]);
            }
        }
        network
    }

    /// Returns a cost of 3 to 83 ms, as between cities.
    fn cost(&mut self) -> u32 {
        3000 + self.dice.below(80_000) as u32
    }

    fn set(&mut self, a: usize, b: usize, cost: Option<u32>) {
        for (from, to) in [(a, b), (b, a)] {
            match cost {
                Some(cost) => self.links[from].insert(to, cost),
                None => self.links[from].remove(&to),
            };
        }
    }

    /// Picks a link by one of its ends; router 0 keeps its links.
    fn link(&mut self) -> (usize, usize, u32) {
        loop {
            let from = 1 + self.dice.below(self.links.len() - 1);
            let links: Vec<_> = self.links[from].iter().filter(|(to, _)| **to != 0).collect();
            if let Some((to, cost)) = self.dice.pick(&links) {
                return (from, *to, *cost);
            }
        }
    }
}

/// Times the searches alone.
fn searches(routers: usize) {
    let mut network = Network::new(routers);
    let ids: Vec<_> = (0..routers).map(|n| node(n).node_id()).collect();
    let mut paths = [ShortestPaths::new(ids[0]), ShortestPaths::new(ids[0])];
    let set = |paths: &mut [ShortestPaths; 2], a: usize, b: usize, cost: Option<u32>| {
        for paths in paths {
            paths.set_edge(&ids[a], &ids[b], cost.map(|cost| [cost; 2]));
        }
    };
    let before = live_bytes();
    for (from, links) in network.links.iter().enumerate() {
        for (to, cost) in links.range(from..) {
            set(&mut paths, from, *to, Some(*cost));
        }
    }
    let held = (live_bytes() - before) / 2;
    paths[0].search_in_full();
    paths[1].search_in_full();
    let changes = CHANGES.min(10 * routers);
    let row = |what: &str, times: &mut [Times; 2], moved: usize| {
        let [changed, in_full] = times.each_mut().map(Times::cells);
        println!(
            "| {routers} | {what} | {:.1} | {} | {} | {} | {} | {} |",
            moved as f64 / times[0].0.len() as f64,
            changed[0],
            changed[1],
            in_full[0],
            in_full[1],
            held / routers as i64,
        );
    };
    let search = |paths: &mut [ShortestPaths; 2], times: &mut [Times; 2]| {
        let [changed, in_full] = paths;
        let mut moved = times[0].time(|| changed.search_changed());
        let mut same = times[1].time(|| in_full.search_in_full());
        moved.sort();
        same.sort();
        assert_eq!(moved, same, "both searches find the same");
        moved.len()
    };
    let mut times = <[Times; 2]>::default();
    let mut moved = 0;
    for _ in 0..changes {
        let ((from, to, _), cost) = (network.link(), network.cost());
        network.set(from, to, Some(cost));
        set(&mut paths, from, to, Some(cost));
        moved += search(&mut paths, &mut times);
    }
    row("a link changes its cost", &mut times, moved);
    let (mut gone, mut back) = (<[Times; 2]>::default(), <[Times; 2]>::default());
    let (mut moved, mut moved_back) = (0, 0);
    for _ in 0..changes {
        let (from, to, cost) = network.link();
        set(&mut paths, from, to, None);
        moved += search(&mut paths, &mut gone);
        set(&mut paths, from, to, Some(cost));
        moved_back += search(&mut paths, &mut back);
    }
    row("a link goes", &mut gone, moved);
    row("it comes back", &mut back, moved_back);
    let mut times = <[Times; 2]>::default();
    let mut moved = 0;
    for _ in 0..changes {
        let router = 1 + network.dice.below(routers - 1);
        let links = network.links[router].clone();
        links.keys().for_each(|to| set(&mut paths, router, *to, None));
        moved += search(&mut paths, &mut times);
        links.iter().for_each(|(to, cost)| set(&mut paths, router, *to, Some(*cost)));
        search(&mut paths, &mut Default::default());
    }
    row("a router goes", &mut times, moved);
    // Many links at once, to see from which part on a full search is quicker.
    for part in [100, 20, 8, 4, 2] {
        let mut times = <[Times; 2]>::default();
        let mut moved = 0;
        for _ in 0..20 {
            for _ in 0..(routers / part / 2).max(1) {
                let ((from, to, _), cost) = (network.link(), network.cost());
                network.set(from, to, Some(cost));
                set(&mut paths, from, to, Some(cost));
            }
            moved += search(&mut paths, &mut times);
        }
        row(&format!("links at one router in {part} change"), &mut times, moved);
    }
}

fn node(n: usize) -> Arc<Identity> {
    identity(&Member { router: true, ..Member::new(&format!("router-{n}")) })
}

/// A router with its neighbours, which bring all link states.
struct Lone {
    router: Router,
    network: Network,
    clock: Clock,
    links: BTreeMap<usize, LinkId>,
    seq: u64,
}

impl Lone {
    fn new(routers: usize) -> Self {
        let (clock, identity) = (Clock::default(), node(0));
        let config = RouterConfig {
            node: identity.node_id(),
            identity: identity.clone(),
            transit: true,
            incarnation: 1,
            started: clock.now().unix,
            mapping: MappingKind::Query,
            anchors: Arc::new(identity.anchors().clone()),
            limits: Limits::default(),
        };
        let router = Router::new(config, clock.now());
        let mut lone = Self { router, network: Network::new(routers), clock, links: BTreeMap::new(), seq: 0 };
        for (n, to) in lone.network.links[0].keys().copied().collect::<Vec<_>>().into_iter().enumerate() {
            let link = LinkId(n as u32 + 1);
            let neighbour = Neighbour { cost: Some(COST), ..Neighbour::from(node(to).as_peer()) };
            lone.router.handle_link_up(lone.clock.now(), link, neighbour);
            lone.drain();
            let hello = Hello {
                minor: MINOR_VERSION,
                incarnation: 1,
                transit: true,
                yields: false,
                started: UnixMillis(1),
            };
            lone.router.handle_frame(lone.clock.now(), link, Control::Hello(hello));
            lone.drain();
            lone.links.insert(to, link);
        }
        lone
    }

    /// Lets the router finish.
    fn drain(&mut self) {
        let now = self.clock.now();
        loop {
            match self.router.poll_output() {
                Output::Timeout(_) => return,
                Output::Flush { link } => self.router.handle_flushed(now, link),
                Output::Dropped(dropped) => panic!("refused: {}", dropped.reason),
                _ => {}
            }
        }
    }

    fn pass(&mut self, time: Duration) {
        self.clock.advance_to(self.clock.instant() + time);
        self.router.handle_timeout(self.clock.now());
        self.drain();
    }

    /// Signs the link state of a router.
    fn sign(&mut self, router: usize) -> SignedBody {
        let Now { unix, .. } = self.clock.now();
        self.seq += 1;
        let identity = node(router);
        let mut routers: Vec<_> = self.network.links[router]
            .iter()
            .map(|(to, cost)| Adjacency { node: node(*to).node_id(), cost: *cost })
            .collect();
        routers.sort_by_key(|a| a.node);
        identity.sign_link_state(&LinkStateBody {
            chain: identity.chain_bytes(),
            seq: self.seq,
            issued_at: unix,
            lease_ms: LEASE_MS,
            floor: 1,
            transit: true,
            routers,
            attached: Vec::new(),
        })
    }

    /// Lets a neighbour bring a link state.
    fn bring(&mut self, signed: SignedBody) {
        let link = *self.links.values().next().expect("it has neighbours");
        self.router.handle_frame(self.clock.now(), link, Control::LinkState { signed });
        self.drain();
    }
}

/// Measures a whole router.
fn whole(routers: usize) {
    let mut lone = Lone::new(routers);
    let before = live_bytes();
    lone.pass(PAUSE);
    let mut first = Times::default();
    let mut frame = 0;
    for n in 1..routers {
        let signed = lone.sign(n);
        // Bytes of its own, as from a link.
        let own = |bytes: &bytes::Bytes| bytes::Bytes::copy_from_slice(bytes);
        let signed = SignedBody { body: own(&signed.body), signature: own(&signed.signature) };
        frame += Control::LinkState { signed: signed.clone() }.to_bytes().len();
        first.time(|| lone.bring(signed));
    }
    lone.pass(PAUSE);
    let held = live_bytes() - before;
    assert_eq!(lone.router.route_stats().routers, routers, "it reaches all");
    let changes = CHANGES.min(routers - 1);
    let mut renewals = Times::default();
    for _ in 0..changes {
        let n = 1 + lone.network.dice.below(routers - 1);
        lone.clock.advance_to(lone.clock.instant() + Duration::from_millis(20));
        let signed = lone.sign(n);
        renewals.time(|| lone.bring(signed));
    }
    let searches = lone.router.route_stats().searches;
    let mut events = Times::default();
    for _ in 0..changes {
        let ((from, to, _), cost) = (lone.network.link(), lone.network.cost());
        lone.network.set(from, to, Some(cost));
        lone.pass(PAUSE);
        let signed = [from, to].map(|n| lone.sign(n));
        events.time(|| {
            signed.into_iter().for_each(|signed| lone.bring(signed));
            lone.pass(PAUSE);
        });
    }
    let searches = (lone.router.route_stats().searches - searches) as f64 / changes as f64;
    let [renewal, renewal_most] = renewals.cells();
    let [event, event_most] = events.cells();
    println!(
        "| {routers} | {:.2} | {} | {:.0} | {:.0} | {renewal} | {renewal_most} | {event} | {event_most} | {searches:.1} |",
        first.0.iter().sum::<Duration>().as_secs_f64(),
        held / routers as i64,
        frame as f64 / (routers - 1) as f64,
        first.mean(),
    );
}

fn main() {
    let mut sizes = vec![100, 1000, 10_000];
    let mut args = std::env::args().skip(1);
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--sizes" => {
                let list = args.next().unwrap_or_default();
                sizes = list.split(',').map(|n| n.parse().expect("--sizes takes numbers")).collect();
            }
            _ => panic!("--sizes 100,1000, not {arg}"),
        }
    }
    println!(
        "| routers | event | paths that move | after the change, µs: median | 99 % | in full, µs: median | 99 % | bytes a router |"
    );
    println!("|{}", "---|".repeat(8));
    sizes.iter().for_each(|routers| searches(*routers));
    println!(
        "\n| routers | all link states, s | bytes held a router | bytes of a link state | µs each | renewal, µs: median | 99 % | a link changes, µs: median | 99 % | searches |"
    );
    println!("|{}", "---|".repeat(10));
    sizes.iter().for_each(|routers| whole(*routers));
}
