//! Thousands of bare routers on a virtual clock, to measure how the control protocol scales.
//!
//! It has no endpoints, payloads or recovery ([`crate::World`] has those): a proxy here is a router machine that
//! carries no names of others, with a few lines in place of its endpoint. Frames go from machine to machine as values,
//! so that signed bytes exist once. Everything is signed and verified as in production. The caller passes in a clock of
//! processor time.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_router::{
    Limits, LinkId, MappingKind, Neighbour, Output, RouteStats, Router, RouterConfig, StoreEvent, StoreOp,
};
use sgc_trust::{Identity, name_of};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Blind, Control, Decode, Encode, Hello, JoinBody, Name, NodeId, Request,
    SignedBody, SinkId, UnixMillis,
};

use crate::cast::{Member, identity};
use crate::ids::NodeKey;
use crate::store::{STORE_LATENCY, SimStore, StoreCounts};
use crate::{Clock, Dice};

/// Names in one advertisement.
pub const BATCH_NAMES: usize = 250;
/// Lease of advertisements.
const LEASE: Duration = Duration::from_secs(600);
/// Time without an event after which a mesh has settled. It is longer than a router's pause between link states or
/// searches, and shorter than its pause before it repeats a question or an advertisement.
const SETTLED_AFTER: Duration = Duration::from_secs(1);
/// Longest time to settle after an event. More is a defect.
const SETTLE_MAX: Duration = Duration::from_secs(60);
/// Bytes of a signed body beyond body and signature: a length before each.
const SIGNED_OVERHEAD_BYTES: usize = 9;

/// The cost of an event, over all nodes.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Frames by kind, and their bytes.
    pub frames: BTreeMap<&'static str, (u64, u64)>,
    /// Processor time in all machines.
    pub cpu: Duration,
    /// Searches for paths.
    pub searches: u64,
    /// Time until the last frame arrived.
    pub last_frame: Duration,
    /// Time until the last router changed its paths to routers.
    pub ways: Duration,
    /// Time until the first proxy heard of a name that it had asked for.
    pub heard: Option<Duration>,
    /// Time until the first proxy got a grant.
    pub granted: Option<Duration>,
    /// Refused frames, by reason.
    pub drops: BTreeMap<&'static str, u64>,
}

impl Tally {
    /// Returns the number of all frames.
    pub fn frames(&self) -> u64 {
        self.frames.values().map(|(frames, _)| frames).sum()
    }

    /// Returns the number of frames of one kind.
    pub fn frames_of_kind(&self, kind: &str) -> u64 {
        self.frames.get(kind).map_or(0, |(frames, _)| *frames)
    }

    /// Returns the bytes of all frames.
    pub fn bytes(&self) -> u64 {
        self.frames.values().map(|(_, bytes)| bytes).sum()
    }
}

/// An input of one machine, with frames as they are on the wire; see [`Mesh::record`].
#[derive(Clone, Debug)]
enum Input {
    Up(LinkId, Neighbour),
    Down(LinkId),
    Frame(LinkId, Bytes),
    Store(StoreEvent),
    Timeout,
}

/// All inputs of one machine, for a replay on another.
#[derive(Debug)]
pub struct Recording {
    config: RouterConfig,
    began: sgc_wire::Now,
    inputs: Vec<(sgc_wire::Now, Input)>,
}

impl Recording {
    /// Returns a machine with the same inputs. It shares no byte with any other.
    pub fn replay(&self) -> Router {
        let mut router = Router::new(self.config.clone(), self.began);
        let drain = |router: &mut Router, now| {
            loop {
                match router.poll_output() {
                    Output::Timeout(_) => break,
                    Output::Flush { link } => router.handle_flushed(now, link),
                    _ => {}
                }
            }
        };
        drain(&mut router, self.began);
        for (now, input) in &self.inputs {
            match input {
                Input::Up(link, neighbour) => router.handle_link_up(*now, *link, neighbour.clone()),
                Input::Down(link) => router.handle_link_down(*now, *link),
                Input::Frame(link, bytes) => {
                    let frame = Control::from_slice(bytes).expect("as it was encoded");
                    router.handle_frame(*now, *link, frame);
                }
                Input::Store(event) => router.handle_store(*now, event.clone()),
                Input::Timeout => router.handle_timeout(*now),
            }
            drain(&mut router, *now);
        }
        router
    }
}

struct Station {
    router: Option<Router>,
    identity: Arc<Identity>,
    transit: bool,
    incarnation: u64,
    links: BTreeMap<LinkId, (usize, usize)>,
    links_made: u32,
    wake: Option<Instant>,
    seq: u64,
    /// The name to join once the proxy hears of it.
    joins: Option<(Name, SinkId)>,
}

struct Cable {
    ends: [usize; 2],
    latency: Duration,
    links: Option<[LinkId; 2]>,
}

/// Something on its way.
enum UnderWay {
    Frame(usize, LinkId, Control),
    Operation(usize, StoreOp),
    News(usize, StoreEvent),
}

/// Many routers, their proxies, and frames in flight between them.
pub struct Mesh {
    clock: Clock,
    cpu: fn() -> Duration,
    mapping: MappingKind,
    dice: Dice,
    stations: Vec<Station>,
    places: Vec<(f64, f64)>,
    cables: Vec<Cable>,
    under_way: BTreeMap<(Instant, u64), UnderWay>,
    /// The store, with [`MappingKind::Store`].
    store: SimStore,
    frames_sent: u64,
    wakes: BTreeSet<(Instant, usize)>,
    recording: Option<(usize, Recording)>,
    tally: Tally,
    since: Instant,
}

impl Mesh {
    /// Returns an empty mesh. `cpu` returns the processor time of this thread; a constant serves callers that do not
    /// measure it.
    pub fn new(seed: u64, mapping: MappingKind, cpu: fn() -> Duration) -> Self {
        let clock = Clock::default();
        Self {
            clock,
            cpu,
            mapping,
            dice: Dice::new(seed),
            stations: Vec::new(),
            places: Vec::new(),
            cables: Vec::new(),
            under_way: BTreeMap::new(),
            store: SimStore::default(),
            frames_sent: 0,
            wakes: BTreeSet::new(),
            recording: None,
            tally: Tally::default(),
            since: clock.instant(),
        }
    }

    /// Adds routers, scattered over a continent. Each new one gets cables to two existing ones with a probability
    /// proportional to their degree (Barabási and Albert), so the mean degree is 4. A link's latency is 1 ms and up to
    /// 40 ms more by distance. The cables are not plugged in.
    pub fn add_routers(&mut self, routers: usize) {
        for n in 0..routers {
            let router = self.add_station(format!("router-{n}"), true);
            self.place_router(router);
        }
    }

    /// Lays the cables of a new router to two others.
    fn place_router(&mut self, router: usize) {
        let others: Vec<_> = (0..router).filter(|n| self.stations[*n].transit && self.is_up(*n)).collect();
        let mut ends: Vec<usize> = self.cables.iter().flat_map(|c| c.ends).collect();
        ends.retain(|n| self.stations[*n].transit && self.is_up(*n));
        let mut chosen = BTreeSet::new();
        while chosen.len() < 2.min(others.len()) {
            let among = if ends.is_empty() { &others } else { &ends };
            chosen.extend(self.dice.pick(among));
        }
        for other in chosen {
            self.add_cable(router, other);
        }
    }

    fn add_station(&mut self, name: String, transit: bool) -> usize {
        let identity = identity(&Member { router: transit, ..Member::new(&name) });
        let place = (self.dice.below(1000) as f64 / 1000.0, self.dice.below(1000) as f64 / 1000.0);
        self.stations.push(Station {
            router: None,
            identity,
            transit,
            incarnation: self.dice.number(),
            links: BTreeMap::new(),
            links_made: 0,
            wake: None,
            seq: 0,
            joins: None,
        });
        self.places.push(place);
        let station = self.stations.len() - 1;
        let config = self.config(station);
        self.stations[station].router = Some(Router::new(config, self.clock.now()));
        station
    }

    fn config(&self, station: usize) -> RouterConfig {
        let Station { identity, transit, incarnation, .. } = &self.stations[station];
        RouterConfig {
            node: identity.node_id(),
            identity: identity.clone(),
            transit: *transit,
            incarnation: *incarnation,
            started: UnixMillis(self.clock.now().unix.0),
            mapping: self.mapping,
            anchors: Arc::new(identity.anchors().clone()),
            limits: Limits::default(),
        }
    }

    /// Lays a cable between two nodes without plugging it in.
    pub fn add_cable(&mut self, a: usize, b: usize) -> usize {
        let (from, to) = (self.places[a], self.places[b]);
        let distance = ((from.0 - to.0).powi(2) + (from.1 - to.1).powi(2)).sqrt() / 2f64.sqrt();
        let proxy = !(self.stations[a].transit && self.stations[b].transit);
        // Proxies are near to their router.
        let micros = if proxy { 2000 } else { 1000 + (distance * 40_000.0) as u64 };
        self.cables.push(Cable { ends: [a, b], latency: Duration::from_micros(micros), links: None });
        self.cables.len() - 1
    }

    /// Adds a proxy with a cable to a router, not plugged in.
    pub fn add_proxy(&mut self, name: &str, router: usize) -> usize {
        let proxy = self.add_station(name.to_owned(), false);
        self.add_cable(proxy, router);
        proxy
    }

    /// Adds a router with cables to two others and plugs it in.
    pub fn join_router(&mut self) -> usize {
        let router = self.add_station(format!("late-{}", self.stations.len()), true);
        self.place_router(router);
        let cables = self.cables_of(router);
        cables.into_iter().for_each(|cable| self.plug(cable));
        router
    }

    /// Plugs everything in at once.
    pub fn plug_all(&mut self) {
        for cable in 0..self.cables.len() {
            if self.cables[cable].links.is_none() {
                self.plug(cable);
            }
        }
    }

    /// Links both ends of a cable.
    pub fn plug(&mut self, cable: usize) {
        let ends = self.cables[cable].ends;
        let links = ends.map(|end| {
            self.stations[end].links_made += 1;
            LinkId(self.stations[end].links_made)
        });
        self.cables[cable].links = Some(links);
        let cost = 2 * self.cables[cable].latency.as_micros() as u32 + 1000;
        for side in 0..2 {
            let (station, other) = (ends[side], ends[1 - side]);
            self.stations[station].links.insert(links[side], (cable, side));
            let neighbour =
                Neighbour { cost: Some(cost), ..Neighbour::from(self.stations[other].identity.as_peer()) };
            self.input(station, Input::Up(links[side], neighbour), None);
        }
    }

    /// Takes the link of a cable down at both ends.
    pub fn unplug(&mut self, cable: usize) {
        let Some(links) = self.cables[cable].links.take() else { return };
        for (station, link) in self.cables[cable].ends.into_iter().zip(links) {
            self.stations[station].links.remove(&link);
            self.input(station, Input::Down(link), None);
        }
    }

    /// Removes a node. Its neighbours see its links go down.
    pub fn kill(&mut self, station: usize) {
        self.stations[station].router = None;
        if let Some(at) = self.stations[station].wake.take() {
            self.wakes.remove(&(at, station));
        }
        self.cables_of(station).into_iter().for_each(|cable| self.unplug(cable));
    }

    /// Moves a proxy to another router. The new link is up before the old one is gone.
    pub fn roam(&mut self, proxy: usize, router: usize) {
        let old = self.cables_of(proxy);
        let new = self.add_cable(proxy, router);
        self.plug(new);
        old.into_iter().for_each(|cable| self.unplug(cable));
    }

    /// Returns the cables of a node.
    pub fn cables_of(&self, station: usize) -> Vec<usize> {
        (0..self.cables.len()).filter(|c| self.cables[*c].ends.contains(&station)).collect()
    }

    /// Returns a plugged cable between routers and a router, without either of which the mesh stays connected.
    pub fn spare(&mut self) -> (usize, usize) {
        let routers = self.routers();
        loop {
            let cable = self.dice.below(self.cables.len());
            let ends = self.cables[cable].ends;
            let plugged =
                self.cables[cable].links.is_some() && ends.iter().all(|e| self.stations[*e].transit);
            let router = self.dice.pick(&routers).expect("a mesh has routers");
            let proxies = self.cables_of(router).iter().any(|c| {
                let ends = self.cables[*c].ends;
                self.cables[*c].links.is_some() && ends.iter().any(|e| !self.stations[*e].transit)
            });
            if plugged
                && !proxies
                && self.reference(routers[0], Some(cable), None).len() == routers.len()
                && self
                    .reference(
                        *routers.iter().find(|r| **r != router).expect("more than one"),
                        None,
                        Some(router),
                    )
                    .len()
                    == routers.len() - 1
            {
                return (cable, router);
            }
        }
    }

    /// Returns the running routers.
    pub fn routers(&self) -> Vec<usize> {
        (0..self.stations.len()).filter(|n| self.stations[*n].transit && self.is_up(*n)).collect()
    }

    /// Returns the number of links between routers.
    pub fn edges(&self) -> usize {
        let plugged = self.cables.iter().filter(|c| c.links.is_some());
        plugged.filter(|c| c.ends.iter().all(|e| self.stations[*e].transit)).count()
    }

    fn is_up(&self, station: usize) -> bool {
        self.stations[station].router.is_some()
    }

    /// Returns a machine for inspection.
    pub fn router(&self, station: usize) -> &Router {
        self.stations[station].router.as_ref().expect("it runs")
    }

    /// Takes a machine out of the mesh, for experiments on it.
    pub fn take_router(&mut self, station: usize) -> Router {
        self.stations[station].router.take().expect("it runs")
    }

    /// Returns the present.
    pub fn now(&self) -> sgc_wire::Now {
        self.clock.now()
    }

    /// Returns the seeded generator.
    pub fn dice(&mut self) -> &mut Dice {
        &mut self.dice
    }

    // ---- Actions of proxies.

    /// Returns the names of an owner's batch.
    pub fn names(&self, owner: usize, batch: usize) -> Vec<Name> {
        let node = self.stations[owner].identity.node_id();
        blinds(batch).map(|blind| name_of(&node, &blind)).collect()
    }

    /// Lets an owner advertise a batch.
    pub fn advertise(&mut self, owner: usize, batch: usize) {
        let now = self.clock.now();
        let station = &mut self.stations[owner];
        station.seq = (station.seq + 1).max(now.unix.0);
        let body = AdvertBody {
            chain: station.identity.chain_bytes(),
            seq: station.seq,
            issued_at: now.unix,
            lease_ms: LEASE.as_millis() as u32,
            withdraw: false,
            blinds: blinds(batch).collect(),
        };
        let signed = station.identity.sign_advert(&body);
        self.local(owner, Control::Advert { cost: 0, signed });
    }

    /// Lets a proxy ask where a name is.
    pub fn ask(&mut self, proxy: usize, name: Name) {
        self.local(proxy, Control::Interest { names: vec![name] });
    }

    /// Ends a proxy's interest in a name.
    pub fn forget(&mut self, proxy: usize, name: Name) {
        self.local(proxy, Control::Uninterest { names: vec![name] });
    }

    /// Lets a proxy subscribe: it asks, and joins once it gets an answer.
    pub fn subscribe(&mut self, proxy: usize, name: Name) {
        let mut sink = [0; 16];
        sink[..8].copy_from_slice(&self.dice.number().to_be_bytes());
        self.stations[proxy].joins = Some((name, SinkId(sink)));
        self.ask(proxy, name);
    }

    fn local(&mut self, station: usize, frame: Control) {
        self.input(station, Input::Frame(LinkId::LOCAL, Bytes::new()), Some(frame));
    }

    /// Answers a frame in place of a proxy's endpoint.
    fn endpoint(&mut self, station: usize, frame: Control) -> Option<Control> {
        let now = self.clock.now();
        let Station { identity, joins, .. } = &mut self.stations[station];
        let after = now.instant.saturating_duration_since(self.since);
        match frame {
            Control::Advert { .. } => {
                self.tally.heard.get_or_insert(after);
                let (name, sink) = joins.take()?;
                let signed = identity.sign_join(&JoinBody {
                    name,
                    sink,
                    request: Request::Subscribe { describe: false },
                    issued_at: now.unix,
                    chain: identity.chain_bytes(),
                    reply_key: Bytes::from_static(&[1; 32]),
                });
                Some(Control::Join { signed })
            }
            Control::Join { signed } => {
                let JoinBody { name, sink, .. } = JoinBody::from_slice(&signed.body).ok()?;
                // About the size of a topic's grant.
                let answer = Answer::Grant {
                    enc: Bytes::from_static(&[1; 32]),
                    sealed: Bytes::from_static(&[1; 160]),
                };
                let signed = identity.sign_answer(&AnswerBody { name, sink, serial: 1, answer });
                Some(Control::Answer { signed })
            }
            Control::Answer { .. } => {
                self.tally.granted.get_or_insert(after);
                None
            }
            _ => None,
        }
    }

    // ---- Time.

    /// Runs until the mesh has settled. Returns the cost since the last call.
    pub fn settle(&mut self) -> Tally {
        let end = self.clock.instant() + SETTLE_MAX;
        while let Some(at) = self.next() {
            if self.under_way.is_empty() && at > self.clock.instant() + SETTLED_AFTER {
                break;
            }
            assert!(at < end, "does not settle: {:?}", self.tally);
            self.step(at);
        }
        let ways = self.routers().into_iter().filter_map(|n| self.router(n).route_stats().changed).max();
        self.tally.ways = ways.unwrap_or(self.since).saturating_duration_since(self.since);
        self.clock.advance_to(self.clock.instant() + SETTLED_AFTER);
        self.restart()
    }

    /// Runs for a time. Returns the cost.
    pub fn pass(&mut self, time: Duration) -> Tally {
        let end = self.clock.instant() + time;
        while let Some(at) = self.next().filter(|at| *at <= end) {
            self.step(at);
        }
        self.clock.advance_to(end);
        self.restart()
    }

    fn restart(&mut self) -> Tally {
        self.since = self.clock.instant();
        std::mem::take(&mut self.tally)
    }

    fn next(&self) -> Option<Instant> {
        let frame = self.under_way.first_key_value().map(|((at, _), _)| *at);
        frame.into_iter().chain(self.wakes.first().map(|(at, _)| *at)).min()
    }

    fn step(&mut self, at: Instant) {
        self.clock.advance_to(at);
        if let Some((_, station)) = self.wakes.first().copied().filter(|(wake, _)| *wake <= at) {
            return self.input(station, Input::Timeout, None);
        }
        match self.under_way.pop_first() {
            Some((_, UnderWay::Frame(station, link, frame))) => {
                self.tally.last_frame = at.saturating_duration_since(self.since);
                self.input(station, Input::Frame(link, Bytes::new()), Some(frame));
            }
            Some((_, UnderWay::Operation(station, op))) => self.serve_store(station, &op),
            Some((_, UnderWay::News(station, event))) => self.input(station, Input::Store(event), None),
            None => {}
        }
    }

    // ---- The store.

    /// Tells all routers that the store answers.
    pub fn start_store(&mut self) {
        for station in self.routers() {
            self.send(STORE_LATENCY, UnderWay::News(station, StoreEvent::Up));
        }
    }

    /// Returns the operations of the store so far.
    pub fn store_counts(&self) -> StoreCounts {
        self.store.counts
    }

    fn serve_store(&mut self, station: usize, op: &StoreOp) {
        let (result, told) = self.store.apply(self.clock.instant(), (NodeKey(station), 0), op);
        self.send(STORE_LATENCY, UnderWay::News(station, StoreEvent::Reply { id: op.id, result }));
        for (NodeKey(reader), _) in told {
            self.send(STORE_LATENCY, UnderWay::News(reader, StoreEvent::Changed(op.key)));
        }
    }

    fn send(&mut self, after: Duration, what: UnderWay) {
        self.frames_sent += 1;
        self.under_way.insert((self.clock.instant() + after, self.frames_sent), what);
    }

    /// Passes an input to a machine. A frame comes as a value.
    fn input(&mut self, station: usize, input: Input, frame: Option<Control>) {
        let now = self.clock.now();
        if let Some((of, recording)) = &mut self.recording
            && *of == station
        {
            let input = match (&input, &frame) {
                (Input::Frame(link, _), Some(frame)) => Input::Frame(*link, frame.to_bytes()),
                _ => input.clone(),
            };
            recording.inputs.push((now, input));
        }
        let Some(router) = &mut self.stations[station].router else { return };
        let began = (self.cpu)();
        let searches = router.route_stats().searches;
        match (input, frame) {
            (Input::Up(link, neighbour), _) => router.handle_link_up(now, link, neighbour),
            (Input::Down(link), _) => router.handle_link_down(now, link),
            (Input::Frame(link, _), Some(frame)) => router.handle_frame(now, link, frame),
            (Input::Store(event), _) => router.handle_store(now, event),
            (Input::Frame(..), None) | (Input::Timeout, _) => router.handle_timeout(now),
        }
        let mut outputs = Vec::new();
        let wake = loop {
            match router.poll_output() {
                Output::Timeout(at) => break at,
                Output::Flush { link } => router.handle_flushed(now, link),
                output => outputs.push(output),
            }
        };
        self.tally.searches += router.route_stats().searches - searches;
        self.tally.cpu += (self.cpu)().saturating_sub(began);
        self.wake(station, wake);
        let mut local = VecDeque::new();
        for output in outputs {
            match output {
                Output::Send { link: LinkId::LOCAL, frame } => local.push_back(frame),
                Output::Send { link, frame } => self.carry(station, link, frame),
                Output::Dropped(dropped) => *self.tally.drops.entry(dropped.reason.key()).or_default() += 1,
                Output::Close { reason, .. } => panic!("honest nodes close a link: {reason}"),
                Output::Store(op) => self.send(STORE_LATENCY, UnderWay::Operation(station, op)),
                Output::Forward { .. } | Output::Trust(_) | Output::Timeout(_) | Output::Flush { .. } => {}
            }
        }
        for frame in local {
            if let Some(frame) = self.endpoint(station, frame) {
                self.local(station, frame);
            }
        }
    }

    fn wake(&mut self, station: usize, at: Option<Instant>) {
        // A deadline that is due now comes after frames in flight, or time would stand still.
        let at = at.map(|at| at.max(self.clock.instant() + Duration::from_nanos(1)));
        let old = std::mem::replace(&mut self.stations[station].wake, at);
        if old != at {
            old.map(|old| self.wakes.remove(&(old, station)));
            self.wakes.extend(at.map(|at| (at, station)));
        }
    }

    fn carry(&mut self, from: usize, link: LinkId, frame: Control) {
        let Some((cable, side)) = self.stations[from].links.get(&link).copied() else { return };
        let Cable { ends, latency, links: Some(links) } = &self.cables[cable] else { return };
        let (to, link, latency) = (ends[1 - side], links[1 - side], *latency);
        let (kind, bytes) = weigh(&frame);
        let tally = self.tally.frames.entry(kind).or_default();
        (tally.0, tally.1) = (tally.0 + 1, tally.1 + bytes as u64);
        self.send(latency, UnderWay::Frame(to, link, frame));
    }

    // ---- The reference model.

    /// Computes the costs of the cheapest paths from a router to all others, without this cable or that router, by
    /// another algorithm than the routers' (Bellman and Ford).
    fn reference(&self, from: usize, cable: Option<usize>, router: Option<usize>) -> BTreeMap<usize, u32> {
        let usable = |(n, c): &(usize, &Cable)| {
            c.links.is_some()
                && Some(*n) != cable
                && c.ends.iter().all(|e| self.stations[*e].transit && Some(*e) != router)
        };
        let cables: Vec<_> = self.cables.iter().enumerate().filter(usable).map(|(_, c)| c).collect();
        let mut costs = BTreeMap::from([(from, 0)]);
        let mut changed = true;
        while changed {
            changed = false;
            for cable in &cables {
                let edge = 2 * cable.latency.as_micros() as u32 + 1000;
                for side in 0..2 {
                    let Some(cost) = costs.get(&cable.ends[side]).map(|cost| cost + edge) else { continue };
                    let known = costs.entry(cable.ends[1 - side]).or_insert(u32::MAX);
                    changed |= cost < *known;
                    *known = cost.min(*known);
                }
            }
        }
        costs
    }

    /// Panics unless an even sample of routers know the cheapest paths to exactly the running routers, and all routers
    /// know the same number of routers.
    pub fn check(&self, sample: usize) {
        let routers = self.routers();
        for at in &routers {
            let RouteStats { routers: known, .. } = self.router(*at).route_stats();
            assert_eq!(known, routers.len(), "router {at} does not reach all");
        }
        for at in routers.iter().step_by(routers.len().div_ceil(sample)) {
            for (to, cost) in self.reference(*at, None, None) {
                let found = self.router(*at).cost_to(&self.node(to));
                assert_eq!(found, Some(cost), "the way from {at} to {to} is not the cheapest");
            }
        }
    }

    /// Returns the fewest links from a router to each other one, by the cables.
    pub fn hops(&self, from: usize) -> BTreeMap<usize, usize> {
        let mut hops = BTreeMap::from([(from, 0)]);
        let mut next = VecDeque::from([from]);
        while let Some(at) = next.pop_front() {
            for (cable, side) in self.stations[at].links.values() {
                let to = self.cables[*cable].ends[1 - side];
                if self.stations[to].transit && !hops.contains_key(&to) {
                    hops.insert(to, hops[&at] + 1);
                    next.push_back(to);
                }
            }
        }
        hops
    }

    /// Returns a node's id.
    pub fn node(&self, station: usize) -> NodeId {
        self.stations[station].identity.node_id()
    }

    /// Starts to record the inputs of a machine. Must be called before any cable is plugged in.
    pub fn record(&mut self, station: usize) {
        let recording =
            Recording { config: self.config(station), began: self.clock.now(), inputs: Vec::new() };
        self.recording = Some((station, recording));
    }

    /// Returns the recording so far.
    pub fn recording(&self) -> &Recording {
        &self.recording.as_ref().expect("something is written down").1
    }
}

fn blinds(batch: usize) -> impl Iterator<Item = Blind> {
    (batch * BATCH_NAMES..(batch + 1) * BATCH_NAMES).map(|n| {
        let mut blind = [0; 32];
        // Blinds are uniform, like hashes.
        let mut dice = Dice::new(n as u64);
        for part in blind.chunks_mut(8) {
            part.copy_from_slice(&dice.number().to_be_bytes());
        }
        Blind(blind)
    })
}

/// Returns the kind and the length of a frame.
fn weigh(frame: &Control) -> (&'static str, usize) {
    let signed = |s: &SignedBody| SIGNED_OVERHEAD_BYTES + s.body.len() + s.signature.len();
    match frame {
        Control::LinkState { signed: s } => ("link state", signed(s)),
        Control::Advert { signed: s, .. } => ("advert", 4 + signed(s)),
        Control::Join { signed: s } => ("join", signed(s)),
        Control::Answer { signed: s } => ("answer", signed(s)),
        Control::Hello(Hello { .. }) => ("hello", 21),
        Control::Query { names, .. } => ("query", 14 + 32 * names.len()),
        Control::Interest { names } => ("interest", 5 + 32 * names.len()),
        other => ("other", other.to_bytes().len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weight_of_frame_is_its_encoded_length() {
        let signed =
            SignedBody { body: Bytes::from_static(&[1; 700]), signature: Bytes::from_static(&[2; 71]) };
        let names = vec![Name([3; 32]); 3];
        for frame in [
            Control::LinkState { signed: signed.clone() },
            Control::Advert { cost: 3, signed: signed.clone() },
            Control::Join { signed: signed.clone() },
            Control::Answer { signed },
            Control::Hello(Hello {
                minor: 0,
                incarnation: 7,
                transit: true,
                yields: false,
                started: UnixMillis(8),
            }),
            Control::Query { id: 1, hops: 2, names: names.clone() },
            Control::Interest { names },
        ] {
            assert_eq!(weigh(&frame).1, frame.to_bytes().len(), "{frame:?}");
        }
    }
}
