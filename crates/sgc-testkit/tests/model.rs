//! Random networks and random histories against the reference model.
//!
//! A seed decides topology and transitions. After each burst of them the network is left alone until it matches
//! [`Model`], within a bound. Then messages are published and must reach exactly the granted nodes.
//! In the second test, proxies are behind NATs. Pairs that exchange data have a direct link at rest if and only if theory
//! allows one, and no source sends a message over a direct link through its uplink beside another copy.
//! In the third test, routers share a store that stops, forgets and lies. Once it answers and lies no more, all must be as
//! without one.
//! `SGC_SEEDS=100..2000` runs those seeds instead of the committed ones and lists failures.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use sgc_endpoint::SinkDrop;
use sgc_router::{DropReason, LinkId, MappingKind};
use sgc_testkit::{
    DataDrop, Dice, Member, MessageId, Model, NatKey, NatKind, NodeKey, Sharing, What, World, WorldConfig,
    revocation_list, run_seeds,
};
use sgc_trust::{CertError, OpenError, SignedError};

/// Seeds that every run of the tests replays: small ones, and those that once showed a bug.
const COMMITTED: &[u64] = &[
    5, 24, 28, 34, 42, 43, 46, 64, 71, 85, 99, 188, 258, 342, 2048, // showed bugs
    1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 25, 26, 27, 29, 30, 31,
    32, 33, 35, 36, 37, 38, 39, 40,
];
/// The same for networks with NATs.
const COMMITTED_NATS: &[u64] = &[
    306, 436, 533, 572, 593, 652, 2049, 2277, 2529, 2909, 10350, // showed bugs
    1497, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20,
];
/// The same for routers that share a store.
const COMMITTED_STORE: &[u64] = &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20];
/// Longest time from the last transition until all is as it should be: a lease, for what was not believed while a clock
/// was wrong or not heard of during a partition. All else takes seconds.
const QUIET_MAX: Duration = Duration::from_secs(330);
const IDLE_MAX: Duration = Duration::from_secs(10);
/// Longest time until the farthest router knows that a right has ended.
const LAPSE_MAX: Duration = Duration::from_secs(2);
const TOPICS: [&str; 3] = ["/a", "/b", "/c"];

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// Everything that can happen to a network of honest nodes.
#[derive(Clone, Debug)]
enum Transition {
    /// A wall clock is off by so many seconds until the network is at rest.
    Clock(NodeKey, i64),
    Crash(NodeKey),
    CrashUnseen(NodeKey, Duration),
    Cut(NodeKey, NodeKey),
    /// Packets between two hosts pass only over routers, or directly again.
    CutPath(NodeKey, NodeKey, bool),
    CutUnseen(NodeKey, NodeKey, Duration, Duration),
    /// A NAT loses its table.
    Forget(NatKey),
    /// A proxy gets an address behind another NAT, or in the internet.
    Move(NodeKey, Option<NatKey>),
    Publish(NodeKey, &'static str),
    Rejoin(NodeKey, NodeKey),
    Reshare(NodeKey, &'static str, Sharing),
    Restart(NodeKey),
    /// A start without its state on disk.
    RestartWiped(NodeKey),
    Revoke(NodeKey, NodeKey),
    /// A proxy leaves one router for another.
    Roam(NodeKey, NodeKey, NodeKey),
    Rotate(NodeKey, &'static str),
    Share(NodeKey, &'static str, Sharing),
    ShutDown(NodeKey),
    Start(NodeKey),
    /// The store loses, replays, swaps or invents values.
    StoreLies,
    /// The store returns, with its values or without.
    StoreStarts(bool),
    StoreStops,
    StopUsing(NodeKey, NodeKey, &'static str),
    Unshare(NodeKey, &'static str),
    Use(NodeKey, NodeKey, &'static str),
    Wait(Duration),
}

fn sharing(dice: &mut Dice, other: NodeKey) -> Sharing {
    match dice.below(4) {
        0 => Sharing::to(&[other]),
        1 => Sharing::to_groups(&["odd"]),
        _ => Sharing::to_fleet(),
    }
}

/// A network under test, and the test's knowledge of it.
struct Run {
    world: World,
    dice: Dice,
    members: Vec<NodeKey>,
    cables: Vec<(NodeKey, NodeKey)>,
    cut: BTreeSet<(NodeKey, NodeKey)>,
    shared: BTreeMap<(NodeKey, &'static str), Sharing>,
    /// The nodes that may get each message: permitted when it was published, shortly before, or while it was history.
    permitted: BTreeMap<MessageId, BTreeSet<NodeKey>>,
    /// The nodes that just lost a right, and the time until which routers may not know it: messages to other nodes may
    /// overtake the news.
    lapsing: Vec<(NodeKey, &'static str, BTreeSet<NodeKey>, Duration)>,
    revoked: Vec<NodeKey>,
    routers: Vec<NodeKey>,
    /// Nodes whose clocks are wrong.
    wrong_clocks: BTreeSet<NodeKey>,
    /// Set once any clock was changed.
    clocks: bool,
    slowest: Duration,
    /// Networks with NATs: what is drawn for them, so that the others keep their histories.
    hosts: Option<Hosts>,
    /// Networks with a store: the draws for it.
    store: Option<Dice>,
}

/// The hosts and NATs of a run.
struct Hosts {
    dice: Dice,
    hosts: Vec<NodeKey>,
    nats: Vec<NatKey>,
    /// Pairs of hosts whose direct path is cut.
    cut: BTreeSet<(NodeKey, NodeKey)>,
    /// Pairs that had no path over routers for a moment.
    apart: BTreeSet<(NodeKey, NodeKey)>,
    /// Number of times that a pair was seen with a direct link at rest.
    met: usize,
}

impl Hosts {
    fn draw_nat(&mut self, world: &mut World) -> NatKey {
        let behind = if self.dice.chance(30) { self.dice.pick(&self.nats) } else { None };
        let kind = match self.dice.below(12) {
            0..2 => NatKind::FULL_CONE,
            2..4 => NatKind::ADDRESS_RESTRICTED,
            4..7 => NatKind::PORT_RESTRICTED,
            7..9 => NatKind::SYMMETRIC,
            9..11 => NatKind::FIREWALL,
            _ => NatKind::UDP_BLOCKED,
        };
        // Addresses behind a firewall are of the internet.
        let behind = behind.filter(|_| kind.mapping.is_some());
        let nat = world.nat(if self.dice.chance(30) { kind.hairpinning() } else { kind }, behind);
        self.nats.push(nat);
        nat
    }

    fn draw_place(&mut self, world: &mut World) -> Option<NatKey> {
        match self.dice.below(10) {
            0..2 => None,
            2..5 => self.dice.pick(&self.nats),
            _ => Some(self.draw_nat(world)),
        }
    }

    /// Draws a transition. Returns `None` if it is not possible now.
    fn draw(&mut self, world: &mut World, shared: &[(NodeKey, &'static str)]) -> Option<Transition> {
        let (one, other) = (self.dice.pick(&self.hosts)?, self.dice.pick(&self.hosts)?);
        let cut: Vec<_> = self.cut.iter().copied().collect();
        Some(match self.dice.below(16) {
            10..14 => {
                let (owner, topic) = self.dice.pick(shared).filter(|(owner, _)| *owner != one)?;
                Transition::Use(one, owner, topic)
            }
            14.. => {
                let (owner, topic) = self.dice.pick(shared).filter(|(owner, _)| world.is_running(*owner))?;
                Transition::Publish(owner, topic)
            }
            0..4 => Transition::Forget(self.dice.pick(&self.nats)?),
            4..6 => Transition::Move(one, self.draw_place(world)),
            6..8 if one < other => Transition::CutPath(one, other, true),
            8..10 => self.dice.pick(&cut).map(|(a, b)| Transition::CutPath(a, b, false))?,
            _ => return None,
        })
    }
}

impl Run {
    /// Returns a run in which proxies are behind NATs.
    fn with_nats(seed: u64) -> Self {
        let mut run = Self::new(seed);
        let (world, dice) = (&mut run.world, Dice::new(seed ^ 0x4a75_a2d1));
        let mut all = Hosts {
            dice,
            hosts: Vec::new(),
            nats: Vec::new(),
            cut: BTreeSet::new(),
            apart: BTreeSet::new(),
            met: 0,
        };
        for node in &run.members {
            if all.dice.chance(90) {
                let behind = all.draw_place(world);
                world.place(*node, behind);
                all.hosts.push(*node);
            }
        }
        world.lose_checks([0, 0, 20][all.dice.below(3)]);
        for _ in 0..all.dice.within(1..=3) {
            let (owner, topic) = (all.dice.pick(&run.members), TOPICS[all.dice.below(TOPICS.len())]);
            let Some(owner) = owner.filter(|owner| !run.shared.contains_key(&(*owner, topic))) else {
                continue;
            };
            run.apply(Transition::Share(
                owner,
                topic,
                Sharing::to_fleet().transient_local(all.dice.below(2)),
            ));
            for _ in 0..all.dice.within(1..=3) {
                if let Some(user) = all.dice.pick(&run.members).filter(|user| *user != owner) {
                    run.apply(Transition::Use(user, owner, topic));
                }
            }
        }
        run.hosts = Some(all);
        run
    }

    /// Returns a run in which all routers, or some, share a store.
    fn with_store(seed: u64) -> Self {
        let mut dice = Dice::new(seed ^ 0x570e_570e);
        let (flood, query, store) = (MappingKind::Flood, MappingKind::Query, MappingKind::Store);
        let mappings = [vec![store], vec![store, query], vec![store, flood], vec![store, flood, query]];
        let mut run = Self::with_mappings(seed, Some(mappings[dice.below(4)].clone()));
        run.store = Some(dice);
        run
    }

    fn new(seed: u64) -> Self {
        Self::with_mappings(seed, None)
    }

    /// Returns a run whose routers draw one of these mappings, or of others.
    fn with_mappings(seed: u64, mappings: Option<Vec<MappingKind>>) -> Self {
        let mut dice = Dice::new(seed);
        let mut config = WorldConfig::new(dice.number());
        config.seed = seed;
        config.jitter = Duration::ZERO..=ms([0, 3, 50][dice.below(3)]);
        let (flood, query) = (MappingKind::Flood, MappingKind::Query);
        config.mappings = [vec![flood], vec![query], vec![flood, query]][dice.below(3)].clone();
        config.mappings = mappings.unwrap_or(config.mappings);
        config.repeat_percent = [0, 10][dice.below(2)];
        let mut world = World::with(config);
        let mut members = Vec::new();
        let mut routers = Vec::new();
        let many = match dice.below(40) {
            0 => 21..=50,
            1..4 => 7..=20,
            _ => 1..=6,
        };
        for n in 0..dice.within(many) {
            routers.push(if dice.chance(20) {
                let both = world.node(Member::new(&format!("both-{n}")), true);
                members.push(both);
                both
            } else {
                world.router(&format!("router-{n}"))
            });
        }
        let mut cables = BTreeSet::new();
        for (n, router) in routers.iter().enumerate().skip(1) {
            cables.insert((routers[dice.below(n)], *router));
        }
        for _ in 0..dice.below(routers.len() + 1) {
            let (a, b) = (dice.below(routers.len()), dice.below(routers.len()));
            if a != b {
                cables.insert((routers[a.min(b)], routers[a.max(b)]));
            }
        }
        for n in 0..dice.within(2..=6) {
            let groups = ["odd", "even"][n % 2].to_owned();
            let proxy =
                world.node(Member { groups: vec![groups], ..Member::new(&format!("proxy-{n}")) }, false);
            for _ in 0..dice.within(1..=2) {
                cables.insert((routers[dice.below(routers.len())], proxy));
            }
            if dice.chance(10) {
                cables.extend(dice.pick(&members).map(|other| (other, proxy)));
            }
            members.push(proxy);
        }
        cables.retain(|(a, b)| a != b);
        for (a, b) in &cables {
            world.link(*a, *b);
        }
        Self {
            world,
            dice,
            members,
            cables: cables.into_iter().collect(),
            cut: BTreeSet::new(),
            shared: BTreeMap::new(),
            permitted: BTreeMap::new(),
            lapsing: Vec::new(),
            revoked: Vec::new(),
            routers,
            wrong_clocks: BTreeSet::new(),
            clocks: false,
            slowest: Duration::ZERO,
            hosts: None,
            store: None,
        }
    }

    /// Draws a transition. Returns `None` if it is not possible now.
    fn draw(&mut self) -> Option<Transition> {
        if let Some(hosts) = &mut self.hosts
            && hosts.dice.chance(40)
        {
            let shared: Vec<_> = self.shared.keys().copied().collect();
            return hosts.draw(&mut self.world, &shared);
        }
        if let Some(dice) = &mut self.store
            && dice.chance(20)
        {
            let is_down = self.world.is_store_down();
            return Some(match dice.below(4) {
                0 | 1 if is_down => Transition::StoreStarts(dice.chance(50)),
                0 => Transition::StoreStops,
                _ if is_down => return None,
                _ => Transition::StoreLies,
            });
        }
        let dice = &mut self.dice;
        let world = &self.world;
        let nodes: Vec<_> = world.nodes().collect();
        let up: Vec<_> = nodes.iter().copied().filter(|n| world.is_running(*n)).collect();
        let down: Vec<_> = nodes.iter().copied().filter(|n| !world.is_running(*n)).collect();
        let whole: Vec<_> = self.cables.iter().copied().filter(|c| !self.cut.contains(c)).collect();
        let broken: Vec<_> = self.cut.iter().copied().collect();
        let member = dice.pick(&self.members)?;
        let other = dice.pick(&self.members).filter(|o| *o != member)?;
        let topic = TOPICS[dice.below(TOPICS.len())];
        let idle = Duration::ZERO..=IDLE_MAX;
        let mine: Vec<_> = self.shared.keys().copied().collect();
        Some(match dice.below(124) {
            112..116 => {
                let (router, proxy) = dice.pick(&whole).filter(|(r, p)| {
                    self.routers.contains(r) && !self.routers.contains(p) && self.members.contains(p)
                })?;
                let linked = |r: &NodeKey| self.cables.contains(&(*r, proxy));
                let free: Vec<_> = self.routers.iter().copied().filter(|r| !linked(r)).collect();
                Transition::Roam(proxy, router, dice.pick(&free)?)
            }
            116..120 => {
                let off = [5, 300, 590, 700, 5000][dice.below(5)] as i64;
                Transition::Clock(dice.pick(&nodes)?, if dice.chance(50) { off } else { -off })
            }
            120..124 => Transition::RestartWiped(dice.pick(&up)?),
            100..104 => dice.pick(&mine).map(|(n, t)| Transition::Rotate(n, t))?,
            104..110 => {
                let (n, t) = dice.pick(&mine)?;
                let depth = self.shared[&(n, t)].depth;
                Transition::Reshare(n, t, sharing(dice, other).transient_local(depth))
            }
            110..112 if dice.chance(60) => {
                let fresh = |n: &NodeKey| !self.revoked.contains(n);
                let thief = dice.pick(&nodes.iter().copied().filter(fresh).collect::<Vec<_>>())?;
                let right: Vec<_> = up.iter().copied().filter(|n| !self.wrong_clocks.contains(n)).collect();
                Transition::Revoke(thief, dice.pick(&right)?)
            }
            0..5 => dice.pick(&whole).map(|(a, b)| Transition::Cut(a, b))?,
            5..9 => {
                let (a, b) = dice.pick(&whole)?;
                Transition::CutUnseen(a, b, dice.time(&idle), dice.time(&idle))
            }
            9..17 => dice.pick(&broken).map(|(a, b)| Transition::Rejoin(a, b))?,
            17..21 => Transition::Crash(dice.pick(&up)?),
            21..25 => Transition::CrashUnseen(dice.pick(&up)?, dice.time(&idle)),
            25..29 => Transition::Restart(dice.pick(&up)?),
            29..32 => Transition::ShutDown(dice.pick(&up)?),
            32..42 => Transition::Start(dice.pick(&down)?),
            42..54 if !self.shared.contains_key(&(member, topic)) => {
                let sharing = sharing(dice, other);
                Transition::Share(member, topic, sharing.transient_local([0, 0, 1, 5][dice.below(4)]))
            }
            54..57 => dice
                .pick(&self.shared.keys().copied().collect::<Vec<_>>())
                .map(|(n, t)| Transition::Unshare(n, t))?,
            57..77 => Transition::Use(other, member, topic),
            77..80 => Transition::StopUsing(other, member, topic),
            80..90 => {
                let shared: Vec<_> = self.shared.keys().copied().filter(|(n, _)| up.contains(n)).collect();
                dice.pick(&shared).map(|(n, t)| Transition::Publish(n, t))?
            }
            _ => {
                let longest = ms([20, 300, 5000, 25_000][dice.below(4)]);
                Transition::Wait(dice.time(&(Duration::ZERO..=longest)))
            }
        })
    }

    fn apply(&mut self, transition: Transition) {
        let world = &mut self.world;
        match transition {
            Transition::Clock(n, seconds) => {
                self.clocks = true;
                self.wrong_clocks.insert(n);
                let by = Duration::from_secs(seconds.unsigned_abs());
                world.note(format!("clock of {n:?} is off by {seconds} s"));
                if seconds > 0 { world.set_ahead(n, by) } else { world.set_behind(n, by) }
            }
            Transition::RestartWiped(n) => {
                world.crash(n);
                world.wipe(n);
                world.run(ms(50));
                world.start(n);
            }
            Transition::Roam(proxy, from, to) => {
                world.cut(from, proxy);
                self.cut.insert((from, proxy));
                world.link(to, proxy);
                self.cables.push((to, proxy));
            }
            Transition::Crash(n) => world.crash(n),
            Transition::CrashUnseen(n, idle) => world.crash_unseen(n, idle),
            Transition::Cut(a, b) => {
                self.cut.insert((a, b));
                world.cut(a, b);
            }
            Transition::CutPath(a, b, is_cut) => {
                if let Some(hosts) = &mut self.hosts {
                    if is_cut {
                        hosts.cut.insert((a, b))
                    } else {
                        hosts.cut.remove(&(a, b))
                    };
                }
                world.cut_direct(a, b, is_cut);
            }
            Transition::Forget(nat) => world.forget_mappings(nat),
            Transition::Move(n, behind) => world.place(n, behind),
            Transition::CutUnseen(a, b, a_idle, b_idle) => {
                self.cut.insert((a, b));
                world.cut_unseen(a, b, a_idle, b_idle);
            }
            Transition::Publish(n, topic) => self.publish(n, topic),
            Transition::Rejoin(a, b) => {
                self.cut.remove(&(a, b));
                world.rejoin(a, b);
            }
            Transition::Reshare(n, topic, sharing) => self.reshare(n, topic, sharing),
            Transition::Restart(n) => world.restart(n),
            Transition::Revoke(thief, at) => self.revoke(thief, at),
            Transition::Rotate(n, topic) => world.rotate(n, topic),
            Transition::Share(n, topic, sharing) => {
                world.share(n, topic, sharing.clone());
                self.shared.insert((n, topic), sharing);
            }
            Transition::ShutDown(n) => world.shut_down(n),
            Transition::Start(n) => world.start(n),
            Transition::StoreLies => {
                if let Some(dice) = &mut self.store {
                    world.corrupt_store(dice);
                }
            }
            Transition::StoreStarts(keeps_values) => world.start_store(keeps_values),
            Transition::StoreStops => world.stop_store(),
            Transition::StopUsing(n, owner, topic) => world.stop_using(n, owner, topic),
            Transition::Unshare(n, topic) => {
                self.shared.remove(&(n, topic));
                world.unshare(n, topic);
            }
            Transition::Use(n, owner, topic) => world.use_topic(n, owner, topic),
            Transition::Wait(time) => self.pass(time),
        }
        self.assert_no_circle();
        self.note_relays();
    }

    fn publish(&mut self, node: NodeKey, topic: &'static str) {
        let id = self.world.publish(node, topic);
        let mut permitted = Model::permitted(&self.world, node, topic);
        let now = self.world.elapsed();
        let lapsing =
            self.lapsing.iter().filter(|(n, t, _, until)| (*n, *t) == (node, topic) && now < *until);
        permitted.extend(lapsing.flat_map(|(_, _, nodes, _)| nodes.iter().copied()));
        self.permitted.insert(id, permitted);
    }

    /// Records the present rights before a node loses some.
    fn note_lapsing(&mut self) {
        let until = self.world.elapsed() + LAPSE_MAX;
        for (node, topic) in self.shared.keys().copied().collect::<Vec<_>>() {
            let nodes = Model::permitted(&self.world, node, topic);
            self.lapsing.push((node, topic, nodes, until));
        }
    }

    fn reshare(&mut self, node: NodeKey, topic: &'static str, sharing: Sharing) {
        self.note_lapsing();
        self.world.reshare(node, topic, sharing.clone());
        self.shared.insert((node, topic), sharing);
        // A node that may have the topic may have its history.
        let permitted = Model::permitted(&self.world, node, topic);
        let published = self.world.all_published().iter();
        for p in published.filter(|p| p.owner == node && p.topic == topic) {
            self.permitted.entry(p.id).or_default().extend(permitted.iter().copied());
        }
    }

    fn revoke(&mut self, thief: NodeKey, at: NodeKey) {
        self.note_lapsing();
        self.revoked.push(thief);
        // Two copies of the fleet file revoke in turns without knowing of each other.
        let last = self.revoked.len() - 1;
        let of_copy = self.revoked.iter().enumerate().filter(|(n, _)| n % 2 == last % 2);
        let members: Vec<_> = of_copy.map(|(_, node)| self.world.member(*node).clone()).collect();
        let list = revocation_list("acme", &members, self.revoked.len() as u64);
        self.world.note(format!("revoke {thief:?}"));
        self.world.hand_crl(at, &list);
    }

    /// Lets time pass and checks for circles now and then.
    fn pass(&mut self, time: Duration) {
        let end = self.world.elapsed() + time;
        while self.world.elapsed() < end {
            self.world.run(ms(100).min(end - self.world.elapsed()));
            self.assert_no_circle();
            self.note_relays();
        }
    }

    fn assert_no_circle(&self) {
        for owner in &self.members {
            let catalogue = self.world.catalogue_name(*owner);
            let topics = TOPICS.iter().map(|t| self.world.name(*owner, t));
            for name in topics.chain([catalogue]) {
                if let Some(circle) = self.world.circle(&name) {
                    panic!("data under a name of {owner:?} goes in a circle: {circle:?}");
                }
            }
        }
    }

    /// Waits until the network matches the model, then checks that messages reach the right nodes.
    fn quiet(&mut self) {
        for node in std::mem::take(&mut self.wrong_clocks) {
            self.world.set_ahead(node, Duration::ZERO);
        }
        let begin = self.world.elapsed();
        // A change that no node has noticed yet must not pass for a settled state.
        self.pass(IDLE_MAX + ms(500));
        let mut model = Model::from_world(&self.world);
        while let Err(why) = model.check(&self.world).and_then(|()| self.check_direct(&model)) {
            let waited = self.world.elapsed() - begin;
            assert!(waited < QUIET_MAX, "after {waited:?} of quiet: {why}");
            self.pass(ms(500));
            model = Model::from_world(&self.world);
        }
        let took = self.world.elapsed() - begin;
        self.slowest = self.slowest.max(took);
        self.world.note(format!("quiet after {took:?}"));
        // A sink has its grant a moment before its data path and history.
        self.pass(ms(2500));
        let mut expected = BTreeMap::new();
        self.world.count_copies();
        for (owner, topic) in self.shared.keys().copied().collect::<Vec<_>>() {
            if !self.world.is_running(owner) {
                continue;
            }
            for _ in 0..2 {
                self.publish(owner, topic);
                let id = self.world.all_published().last().expect("just published").id;
                let users = model.granted.get(&(owner, topic.to_owned()));
                expected.insert(id, users.cloned().unwrap_or_default());
            }
        }
        self.pass(ms(1500));
        self.check_uplinks();
        let copied = self.world.copied();
        assert!(copied.is_empty(), "more than one copy over a link: {copied:?}");
        for (id, nodes) in expected {
            let received: Vec<_> =
                self.world.all_received().iter().filter(|r| r.id == id).map(|r| r.node).collect();
            let set: BTreeSet<_> = received.iter().copied().collect();
            let published = &self.world.all_published()[id.0 as usize];
            assert!(
                set == nodes && received.len() == nodes.len(),
                "{published:?}: {received:?}, not {nodes:?}"
            );
        }
        self.check_histories(&model);
        self.check_deliveries();
        self.check_order();
        self.check_log();
    }

    /// Checks that pairs that exchange data have a direct link if theory allows it, and that no pair has one that it
    /// forbids.
    fn check_direct(&mut self, model: &Model) -> Result<(), String> {
        let Some(hosts) = &mut self.hosts else { return Ok(()) };
        let world = &self.world;
        let is_configured = |a, b| {
            let mut cables = self.cables.iter().filter(|cable| !self.cut.contains(cable));
            cables.any(|cable| [(a, b), (b, a)].contains(cable))
        };
        // A rule for the whole fleet, like `direct = "auto"`, permits no node that may route.
        let may_route = |node: &NodeKey| self.routers.contains(node);
        let forbids = |a, b| may_route(a) || may_route(b) || !world.lets_meet(*a, *b, true);
        let mut met = 0;
        for ((owner, topic), users) in &model.granted {
            for user in users.iter().filter(|user| hosts.hosts.contains(user) && hosts.hosts.contains(owner))
            {
                let meet = world.lets_meet(*owner, *user, false) && !forbids(owner, user);
                let is_due = meet && !is_configured(*owner, *user);
                if is_due && !world.is_direct(*owner, *user) {
                    let why = world.why_not_direct(*user, *owner);
                    return Err(format!("{user:?} uses {owner:?}:{topic} without a direct link: {why:?}"));
                }
                met += usize::from(is_due);
            }
        }
        for (n, one) in hosts.hosts.iter().enumerate() {
            for other in &hosts.hosts[..n] {
                if world.has_direct(*one, *other) && forbids(one, other) {
                    return Err(format!("{one:?} and {other:?} have a direct link that they must not have"));
                }
            }
        }
        hosts.met += met;
        Ok(())
    }

    /// Notes the pairs that had no path over routers for a moment.
    fn note_relays(&mut self) {
        let Some(hosts) = &mut self.hosts else { return };
        for (n, one) in hosts.hosts.iter().enumerate() {
            for other in &hosts.hosts[..n] {
                if !Model::reaches_over_routers(&self.world, *one, *other) {
                    hosts.apart.extend([(*one, *other), (*other, *one)]);
                }
            }
        }
    }

    /// Checks that no source sends a message over a direct link through its uplink beside another copy through it, unless
    /// the node there did not find a path over routers once.
    fn check_uplinks(&self) {
        let Some(hosts) = self.hosts.as_ref().filter(|_| !self.clocks) else { return };
        for node in &self.members {
            for copies in self.world.packet_copies(*node) {
                let is_due = |there: &&NodeKey| !hosts.apart.contains(&(*node, **there));
                let is_alone = (copies.configured, copies.far.len()) == (0, 1);
                assert!(is_alone || copies.far.iter().find(is_due).is_none(), "{node:?} sends {copies:?}");
            }
        }
    }

    /// Checks that each subscriber of a transient-local topic has the last messages of its source.
    fn check_histories(&self, model: &Model) {
        let world = &self.world;
        for ((owner, topic), sharing) in &self.shared {
            let of_topic = |p: &&sgc_testkit::PublishedMessage| p.owner == *owner && p.topic == *topic;
            let Some(last) = world.all_published().iter().rev().find(of_topic) else { continue };
            let current = world.all_published().iter().filter(of_topic).filter(|p| p.source == last.source);
            let mut history: Vec<_> = current.map(|p| p.id).collect();
            history.drain(..history.len().saturating_sub(sharing.depth));
            let users = model.granted.get(&(*owner, (*topic).to_owned()));
            for user in users.into_iter().flatten() {
                let of_use = world.all_received().iter().filter(|r| {
                    r.node == *user && r.owner == *owner && r.topic == *topic && r.run == world.runs(*user)
                });
                let use_number = of_use.clone().map(|r| r.use_number).max();
                let received: BTreeSet<_> =
                    of_use.filter(|r| Some(r.use_number) == use_number).map(|r| r.id).collect();
                let missing: Vec<_> = history.iter().filter(|id| !received.contains(id)).collect();
                assert!(missing.is_empty(), "{user:?} lacks {missing:?} of {owner:?}:{topic}, {sharing:?}");
            }
        }
    }

    /// Checks that no message is delivered twice or to a node without permission.
    fn check_deliveries(&self) {
        let mut seen = BTreeSet::new();
        for r in self.world.all_received() {
            assert!(seen.insert((r.node, r.run, r.use_number, r.id)), "delivered twice: {r:?}");
            assert!(self.permitted[&r.id].contains(&r.node), "delivered to one not permitted: {r:?}");
        }
    }

    /// Checks that a use gets the messages of each source in order and without gaps from the first one on.
    fn check_order(&self) {
        let published = self.world.all_published();
        let mut numbers = BTreeMap::new();
        let mut of_source: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for p in published {
            let all = of_source.entry(p.source).or_default();
            numbers.insert(p.id, all.len());
            all.push(p.id);
        }
        let mut last = BTreeMap::new();
        for r in self.world.all_received().iter().filter(|r| self.world.lost(r.node) == 0) {
            let source = published[r.id.0 as usize].source;
            let before = last.insert((r.node, r.run, r.use_number, source), numbers[&r.id]);
            let due = before.map_or(numbers[&r.id], |n| n + 1);
            let expected = of_source[&source][due];
            assert_eq!(r.id, expected, "{r:?} of {source:?} is not the one whose turn it is");
        }
    }

    /// Checks that honest nodes do not suspect each other, unless their clocks are wrong.
    fn check_log(&self) {
        let clock = |why: &SignedError| self.clocks && matches!(why, SignedError::Clock { .. });
        for logged in self.world.log() {
            let fine = match &logged.what {
                What::RouterDrop(dropped) => {
                    matches!(
                        dropped.reason,
                        DropReason::Unknown { .. }
                        | DropReason::WrongWay { .. }
                        | DropReason::Stale { .. }
                        // Nodes that do not know of it yet pass it on.
                        | DropReason::NotVerified { why: SignedError::Cert(CertError::Revoked { .. }), .. }
                    ) || match &dropped.reason {
                        DropReason::Clock { .. } => self.clocks || dropped.link == LinkId::STORE,
                        DropReason::NotVerified { .. } => dropped.link == LinkId::STORE,
                        _ => false,
                    }
                }
                What::EndpointDrop(dropped) => match dropped {
                    sgc_endpoint::EndpointDrop::Unexpected { .. } => true,
                    sgc_endpoint::EndpointDrop::NotVerified { why, .. } => {
                        matches!(why, SignedError::Cert(CertError::Revoked { .. })) || clock(why)
                    }
                    _ => false,
                },
                What::DataDrop { why, .. } => match why {
                    DataDrop::HopLimit | DataDrop::Sink(SinkDrop::Head | SinkDrop::Inconsistent) => false,
                    // Packets of an earlier run of the owner, or sealed after this node lost its right.
                    DataDrop::Sink(SinkDrop::Open(why)) => {
                        matches!(why, OpenError::Forged | OpenError::Epoch { .. } | OpenError::NoMac)
                    }
                    _ => true,
                },
                What::Closed { .. } | What::Event(_) | What::SinkLost { .. } => true,
            };
            assert!(fine, "{logged:?}");
        }
    }

    /// Checks that no router keeps state of owners and users once all are gone.
    fn end(&mut self) {
        for node in self.members.clone() {
            match self.dice.below(3) {
                0 => self.world.crash(node),
                1 => self.world.crash_unseen(node, IDLE_MAX),
                _ => self.world.shut_down(node),
            }
            self.pass(ms(self.dice.clone().below(200) as u64));
        }
        self.pass(Duration::from_secs(420));
        for node in self.world.nodes().collect::<Vec<_>>() {
            let stats = self.world.stats(node);
            let left = (stats.names, stats.branches, self.world.forwarding(node).len());
            assert_eq!(left, (0, 0, 0), "names, branches and entries left behind in {node:?}");
        }
        self.check_deliveries();
        self.check_order();
        self.check_log();
    }

    fn all(&mut self) {
        for _ in 0..self.dice.within(1..=3) {
            for _ in 0..self.dice.within(3..=25) {
                if let Some(transition) = self.draw() {
                    self.apply(transition);
                }
            }
            self.quiet();
        }
        self.end();
    }
}

#[test]
fn random_networks_become_what_the_model_says() {
    let took = run_seeds(
        COMMITTED,
        Run::new,
        |run| {
            run.all();
            run.slowest
        },
        |run| run.world.trace(),
    );
    eprintln!("slowest to become quiet: {:?}", took.into_iter().max().unwrap_or_default());
}

#[test]
fn random_networks_with_a_store_become_what_the_model_says() {
    let slowest = run_seeds(
        COMMITTED_STORE,
        Run::with_store,
        |run| {
            run.all();
            run.slowest
        },
        |run| run.world.trace(),
    );
    eprintln!("slowest to become quiet: {:?}", slowest.into_iter().max().unwrap_or_default());
}

#[test]
fn random_networks_with_nats_become_what_the_model_and_theory_say() {
    let results = run_seeds(
        COMMITTED_NATS,
        Run::with_nats,
        |run| {
            run.all();
            (run.slowest, run.hosts.as_ref().map_or(0, |hosts| hosts.met))
        },
        |run| run.world.trace(),
    );
    let slowest = results.iter().map(|(slowest, _)| *slowest).max().unwrap_or_default();
    let met: usize = results.iter().map(|(_, met)| met).sum();
    eprintln!("slowest to become quiet: {slowest:?}; {met} direct links at rest");
    assert!(met > 0, "no pair met");
}
