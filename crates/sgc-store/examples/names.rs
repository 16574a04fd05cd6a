//! Measures names in a real store: `make bench-store`.
//!
//! It starts a cluster of three primaries with a replica each in a network namespace, fills it through the driver with
//! the keys that a router writes, and looks names up through a router's machine and the driver. `--names 1000000` sets
//! the number of names. Needs root and `redis-server`; `SGC_REDIS_SERVER` can name another program.
#![allow(clippy::print_stdout, reason = "the table is what it is for")]

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_router::{
    BATCH_TAG_LEN, BatchTag, Limits, LinkId, MappingKind, Neighbour, Output, Router, RouterConfig,
    StoreAction, StoreEvent, StoreKey, StoreOp, StoreOpId, StoreReply, WriteIf,
};
use sgc_store::{StoreConfig, StorePrefix, StoreServer, run};
use sgc_testkit::netsim::Namespace;
use sgc_testkit::redis::{Redis, RedisOptions};
use sgc_testkit::{Clock, Member, identity};
use sgc_trust::{Identity, name_of, names_digest, verify_advert};
use sgc_wire::{
    Adjacency, AdvertBody, Blind, Control, Encode, Hello, LinkStateBody, Name, NodeId, Now, SignedBody,
    UnixMillis,
};
use tokio::sync::mpsc;

const HOSTS: [&str; 6] = ["10.78.0.1", "10.78.0.2", "10.78.0.3", "10.78.0.4", "10.78.0.5", "10.78.0.6"];
const PRIMARIES: usize = HOSTS.len() / 2;
/// Names of a batch.
const BATCH_NAMES: usize = 256;
/// Batches of an owner.
const OWNER_BATCHES: usize = 4;
/// Batches with advertisements of their own; further ones have the bytes of these.
const SIGNED_BATCHES: usize = 1000;
/// Lease of advertisements and link states.
const LEASE: Duration = Duration::from_secs(300);
/// Lifetime of batches in the store, longer than a run.
const LIFETIME: Duration = Duration::from_secs(3600);
/// Operations under way at one time, as many as a router has.
const OPS_MAX: usize = 1024;
/// Look-ups one after another.
const SINGLE: usize = 1000;
/// Renewed batches.
const RENEWALS: usize = 20_000;
/// Look-ups by the driver alone.
const DRIVER_LOOK_UPS: usize = 100_000;
/// Published batches.
const PUBLISHED: usize = 500;
/// Names that are read while servers fail.
const WATCHED: usize = 256;
/// Pause before reads that failed are repeated.
const REPEAT_AFTER: Duration = Duration::from_millis(20);
/// Failures of operations at which a run ends.
const FAILURES_MAX: usize = 100_000;
/// Time after which servers take another for failed: the default of Redis while the store is filled, so that load is no
/// failure, and a shorter one when servers are killed.
const LOADED_TIMEOUT_MS: &str = "15000";
const KILLED_TIMEOUT_MS: &str = "1000";
/// Longest wait for an event.
const WAIT_MAX: Duration = Duration::from_secs(30);
/// The link of the node that asks or publishes.
const LINK: LinkId = LinkId(1);
/// First number of operations that are not the router's.
const OWN_OPS: u64 = 1 << 62;

/// Fills bytes as if they were a digest of the numbers.
fn scatter<const N: usize>(kind: u64, number: usize) -> [u8; N] {
    let mut state = kind << 56 ^ number as u64;
    let mut bytes = [0; N];
    // SplitMix64, whose steps differ by more than the numbers do.
    state = state.wrapping_mul(0xd129_0c47_e1a8_2d53);
    for chunk in bytes.chunks_mut(8) {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut word = state;
        word = (word ^ word >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        word = (word ^ word >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        word ^= word >> 31;
        chunk.copy_from_slice(&word.to_be_bytes()[..chunk.len()]);
    }
    bytes
}

fn tag_of(names: &[Name]) -> BatchTag {
    let mut names = names.to_vec();
    names.sort_unstable();
    let mut tag = [0; BATCH_TAG_LEN];
    tag.copy_from_slice(&names_digest(&names)[..BATCH_TAG_LEN]);
    BatchTag(tag)
}

/// A batch that is signed.
struct Batch {
    owner: Arc<Identity>,
    names: Vec<Name>,
    tag: BatchTag,
    signed: SignedBody,
    value: Bytes,
}

/// The names of the run, and what the store has about them.
struct Fleet {
    signed: Vec<Batch>,
    link_states: Vec<Bytes>,
    batches: usize,
}

impl Fleet {
    fn new(names: usize, began: UnixMillis) -> Self {
        let batches = names.div_ceil(BATCH_NAMES);
        let owners = SIGNED_BATCHES.min(batches).div_ceil(OWNER_BATCHES);
        let router = identity(&Member { router: true, ..Member::new("home") }).node_id();
        let mut signed = Vec::new();
        let mut link_states = Vec::new();
        for owner in 0..owners {
            let owner_identity = identity(&Member::new(&format!("owner-{owner}")));
            for part in 0..OWNER_BATCHES {
                let number = owner * OWNER_BATCHES + part;
                if number < batches {
                    signed.push(sign(&owner_identity, number, part, began));
                }
            }
            let body = LinkStateBody {
                chain: owner_identity.chain_bytes(),
                seq: began.0,
                issued_at: began,
                lease_ms: LEASE.as_millis() as u32,
                floor: 0,
                transit: false,
                routers: vec![Adjacency { node: router, cost: 1000 }],
                attached: vec![],
            };
            link_states.push(owner_identity.sign_link_state(&body).to_bytes());
        }
        Self { signed, link_states, batches }
    }

    fn owner(&self, batch: usize) -> NodeId {
        let signed = self.signed.get(batch).map(|batch| batch.owner.node_id());
        signed.unwrap_or_else(|| NodeId(scatter(1, batch / OWNER_BATCHES)))
    }

    fn tag(&self, batch: usize) -> BatchTag {
        self.signed.get(batch).map_or_else(|| BatchTag(scatter(2, batch)), |batch| batch.tag)
    }

    fn name(&self, batch: usize, number: usize) -> Name {
        let signed = self.signed.get(batch).map(|batch| batch.names[number]);
        signed.unwrap_or_else(|| Name(scatter(3, batch * BATCH_NAMES + number)))
    }

    fn entry(&self, batch: usize) -> Bytes {
        [self.owner(batch).0.as_slice(), &self.tag(batch).0].concat().into()
    }

    fn batch_key(&self, batch: usize) -> StoreKey {
        StoreKey::Batch { owner: self.owner(batch), tag: self.tag(batch) }
    }

    /// Returns the write of a batch, as at its publication and at each renewal.
    fn batch_write(&self, batch: usize) -> (StoreKey, StoreAction) {
        let value = self.signed[batch % self.signed.len()].value.clone();
        (self.batch_key(batch), write(value, Some(LIFETIME)))
    }
}

fn write(value: Bytes, lifetime: Option<Duration>) -> StoreAction {
    StoreAction::Write { value, lifetime, condition: WriteIf::Always }
}

fn sign(owner: &Arc<Identity>, number: usize, part: usize, began: UnixMillis) -> Batch {
    let blinds: Vec<_> = (0..BATCH_NAMES).map(|n| Blind(scatter(4, number * BATCH_NAMES + n))).collect();
    let names: Vec<_> = blinds.iter().map(|blind| name_of(&owner.node_id(), blind)).collect();
    let body = AdvertBody {
        chain: owner.chain_bytes(),
        seq: began.0 + part as u64,
        issued_at: began,
        lease_ms: LEASE.as_millis() as u32,
        withdraw: false,
        blinds,
    };
    let signed = owner.sign_advert(&body);
    Batch { owner: owner.clone(), tag: tag_of(&names), names, value: signed.to_bytes(), signed }
}

/// The driver.
struct Client {
    ops: mpsc::Sender<StoreOp>,
    events: mpsc::Receiver<StoreEvent>,
    next: u64,
}

impl Client {
    async fn start(config: StoreConfig) -> Self {
        let (ops, ops_receiver) = mpsc::channel(OPS_MAX);
        let (events_sender, events) = mpsc::channel(OPS_MAX);
        tokio::spawn(run(config, ops_receiver, events_sender));
        let mut client = Self { ops, events, next: OWN_OPS };
        while client.event().await != StoreEvent::Up {}
        client
    }

    async fn event(&mut self) -> StoreEvent {
        let event = tokio::time::timeout(WAIT_MAX, self.events.recv()).await;
        event.expect("the driver reports something in time").expect("the driver runs")
    }

    /// Begins an operation. At most [`OPS_MAX`] may be under way, so there is room for it.
    fn begin(&mut self, key: StoreKey, action: StoreAction) -> StoreOpId {
        let id = StoreOpId(self.next);
        self.next += 1;
        self.ops.try_send(StoreOp { id, key, action }).expect("the driver has room");
        id
    }

    async fn reply(&mut self) -> (StoreOpId, Option<StoreReply>) {
        loop {
            if let StoreEvent::Reply { id, result } = self.event().await {
                return (id, result.ok());
            }
        }
    }

    /// Reads a key. Returns the time that it took.
    async fn read(&mut self, key: StoreKey) -> Duration {
        let began = Instant::now();
        self.begin(key, StoreAction::Read);
        let (_, reply) = self.reply().await;
        assert!(matches!(reply, Some(StoreReply::Value(Some(_)))), "{key} is not in the store");
        began.elapsed()
    }

    /// Carries operations out, at most `most` at a time, as `next` gives them, and those that fail again, as routers do;
    /// `then` takes each result. Returns the numbers of operations and of failures.
    async fn all<T>(
        &mut self,
        most: usize,
        mut next: impl FnMut() -> Option<(StoreKey, StoreAction, T)>,
        mut then: impl FnMut(T, StoreReply),
    ) -> (usize, usize) {
        let mut under_way = BTreeMap::new();
        let (mut done, mut failures) = (0, 0);
        loop {
            while under_way.len() < most
                && let Some((key, action, about)) = next()
            {
                under_way.insert(self.begin(key, action.clone()), (key, action, about));
            }
            if under_way.is_empty() {
                return (done, failures);
            }
            let (id, reply) = self.reply().await;
            let (key, action, about) = under_way.remove(&id).expect("an operation that is under way");
            if let Some(reply) = reply {
                then(about, reply);
                done += 1;
            } else {
                failures += 1;
                assert!(failures < FAILURES_MAX, "the store fails all the time");
                under_way.insert(self.begin(key, action.clone()), (key, action, about));
            }
        }
    }
}

/// A step of the filling.
#[derive(Clone, Copy)]
enum Step {
    Batch(usize),
    Other,
}

/// Writes all names: a batch, its names once the store says that it did not have the batch, and owners' link states.
async fn fill(client: &mut Client, fleet: &Fleet) -> (usize, usize) {
    let named = std::cell::RefCell::new(VecDeque::new());
    let mut batch = 0;
    let mut owners = 0;
    let next = || {
        let mut named = named.borrow_mut();
        if let Some((of, number)) = named.front_mut() {
            let write =
                (StoreKey::Name(fleet.name(*of, *number)), write(fleet.entry(*of), None), Step::Other);
            *number += 1;
            if *number == BATCH_NAMES {
                named.pop_front();
            }
            return Some(write);
        }
        if owners * OWNER_BATCHES < batch {
            let value = fleet.link_states[owners % fleet.link_states.len()].clone();
            let key = StoreKey::Node(fleet.owner(owners * OWNER_BATCHES));
            owners += 1;
            return Some((key, write(value, Some(LIFETIME)), Step::Other));
        }
        if batch == fleet.batches {
            return None;
        }
        let (key, action) = fleet.batch_write(batch);
        batch += 1;
        Some((key, action, Step::Batch(batch - 1)))
    };
    client
        .all(OPS_MAX, next, |step, _| {
            if let Step::Batch(batch) = step {
                named.borrow_mut().push_back((batch, 0));
            }
        })
        .await
}

/// A router's machine with one node linked to it.
struct Machine {
    router: Router,
    began: Instant,
    unix: UnixMillis,
    /// Time of the next timeout.
    wake: Option<Instant>,
}

impl Machine {
    fn new(neighbour: &Identity, unix: UnixMillis) -> Self {
        let identity = identity(&Member { router: true, ..Member::new("cloud") });
        let began = Instant::now();
        let now = Now { instant: began, unix };
        let config = RouterConfig {
            node: identity.node_id(),
            transit: true,
            incarnation: 1,
            started: unix,
            mapping: MappingKind::Store,
            anchors: Arc::new(identity.anchors().clone()),
            limits: Limits::default(),
            identity,
        };
        let mut machine = Self { router: Router::new(config, now), began, unix, wake: None };
        machine.router.handle_link_up(now, LINK, Neighbour::from(neighbour.as_peer()));
        let hello = Hello { minor: 0, incarnation: 2, transit: false, yields: false, started: unix };
        machine.router.handle_frame(now, LINK, Control::Hello(hello));
        machine.router.handle_store(now, StoreEvent::Up);
        machine.drain();
        machine
    }

    fn now(&self) -> Now {
        let instant = Instant::now();
        Now { instant, unix: UnixMillis(self.unix.0 + (instant - self.began).as_millis() as u64) }
    }

    /// Returns the operations that the machine begins.
    fn drain(&mut self) -> Vec<StoreOp> {
        let mut ops = Vec::new();
        loop {
            match self.router.poll_output() {
                Output::Timeout(at) => {
                    self.wake = at;
                    return ops;
                }
                Output::Store(op) => ops.push(op),
                Output::Dropped(dropped) => panic!("the router refuses a frame: {}", dropped.reason.key()),
                Output::Close { reason, .. } => panic!("the router closes the link: {reason}"),
                _ => {}
            }
        }
    }

    fn frame(&mut self, frame: Control) -> Vec<StoreOp> {
        let now = self.now();
        self.router.handle_frame(now, LINK, frame);
        self.drain()
    }

    fn store(&mut self, event: StoreEvent) -> Vec<StoreOp> {
        let now = self.now();
        self.router.handle_store(now, event);
        self.drain()
    }

    fn found(&self) -> usize {
        let stats = self.router.store_stats().expect("a router with a store");
        assert_eq!((stats.absent, stats.refused, stats.failures), (0, 0, 0), "each name is found");
        stats.found as usize
    }

    /// Looks names up together. Returns the time after which each was found, with owner and link state verified.
    async fn look_up(&mut self, client: &mut Client, names: Vec<Name>) -> Vec<Duration> {
        let began = Instant::now();
        let wanted = names.len();
        let before = self.found();
        let mut ops = self.frame(Control::Interest { names });
        let mut times = Vec::with_capacity(wanted);
        while times.len() < wanted {
            for op in ops.drain(..) {
                client.ops.send(op).await.expect("the driver runs");
            }
            let wake = self.wake.unwrap_or_else(|| Instant::now() + WAIT_MAX);
            tokio::select! {
                event = client.event() => ops = self.store(event),
                () = tokio::time::sleep_until(wake.into()) => {
                    let now = self.now();
                    self.router.handle_timeout(now);
                    ops = self.drain();
                }
            }
            times.resize(self.found() - before, began.elapsed());
            assert!(began.elapsed() < WAIT_MAX, "{} of {wanted} names were found", times.len());
        }
        times
    }
}

/// Returns the 50th and 99th of 100 times.
fn middle_and_slow(times: &mut [Duration]) -> (Duration, Duration) {
    times.sort_unstable();
    (times[times.len() / 2], times[(times.len() * 99 / 100).min(times.len() - 1)])
}

fn micros(time: Duration) -> String {
    format!("{:.0} µs", time.as_secs_f64() * 1e6)
}

fn millis(time: Duration) -> String {
    format!("{:.0} ms", time.as_secs_f64() * 1e3)
}

fn rate(number: usize, time: Duration) -> String {
    format!("{:.0}", number as f64 / time.as_secs_f64())
}

fn row(what: &str, figure: impl std::fmt::Display) {
    println!("| {what} | {figure} |");
}

/// Returns the memory of all primaries, bytes.
fn memory(redis: &Redis) -> u64 {
    let used = |index| {
        let info = redis.cli(index, &["INFO", "memory"]);
        let line = info.lines().find_map(|line| line.strip_prefix("used_memory:"));
        line.and_then(|value| value.trim().parse::<u64>().ok()).expect("the server tells its memory")
    };
    (0..PRIMARIES).map(used).sum()
}

/// Measures publications and renewals of batches at a router, which verifies them, beside their verification alone.
fn publish(fleet: &Fleet, unix: UnixMillis) {
    let (mut verified, mut first, mut named, mut renewed) = (vec![], vec![], vec![], vec![]);
    for (number, batch) in fleet.signed.iter().take(PUBLISHED).enumerate() {
        let mut machine = Machine::new(&batch.owner, unix);
        let began = Instant::now();
        verify_advert(machine.router_anchors(), &batch.signed, unix).expect("as it was signed");
        verified.push(began.elapsed());

        let key = StoreKey::Batch { owner: batch.owner.node_id(), tag: batch.tag };
        let mut publish = |signed: SignedBody, existed: bool| {
            let frame = Control::Advert { cost: 0, signed };
            let began = Instant::now();
            let ops = machine.frame(frame);
            let to_batch = began.elapsed();
            let [op] = ops.as_slice() else { panic!("the batch is written first, alone: {ops:?}") };
            assert_eq!(op.key, key);
            let reply = StoreEvent::Reply { id: op.id, result: Ok(StoreReply::Written { existed }) };
            let began = Instant::now();
            let ops = machine.store(reply);
            assert_eq!(ops.len(), if existed { 0 } else { BATCH_NAMES });
            (to_batch, began.elapsed())
        };
        let (to_batch, to_names) = publish(batch.signed.clone(), false);
        first.push(to_batch);
        named.push(to_names);
        let renewal = sign(&batch.owner, number, OWNER_BATCHES + number % OWNER_BATCHES, unix);
        renewed.push(publish(renewal.signed, true).0);
    }
    let [verified, first, named, renewed] =
        [verified, first, named, renewed].map(|mut times| middle_and_slow(&mut times).0);
    let ratio = |time: Duration| format!("{:.2}", time.as_secs_f64() / verified.as_secs_f64());
    row("a batch of 256: verification alone, p50", micros(verified));
    row("the router, until it hands the first write of the batch over, verification included", micros(first));
    row("the router, the writes of 256 new names besides", micros(named));
    row("the router, until it hands the write of a renewal over, verification included", micros(renewed));
    row("renewal / verification alone (goal: 1.5)", ratio(renewed));
    row("first publication / verification alone (goal: 1.5)", ratio(first + named));
}

impl Machine {
    fn router_anchors(&self) -> &'static sgc_trust::TrustAnchors {
        static ANCHORS: std::sync::OnceLock<Arc<Identity>> = std::sync::OnceLock::new();
        ANCHORS.get_or_init(|| identity(&Member { router: true, ..Member::new("cloud") })).anchors()
    }
}

/// Looks up names of different batches, one at a time and 1000 at once.
async fn look_ups(config: &StoreConfig, fleet: &Fleet, unix: UnixMillis) {
    let asker = identity(&Member::new("asker"));
    let most = fleet.signed.len();
    let mut client = Client::start(config.clone()).await;
    let mut machine = Machine::new(&asker, unix);
    let (mut found, mut read) = (vec![], vec![]);
    for batch in 0..SINGLE.min(most) {
        // In turns, so that other work on the machine is in both.
        found.extend(machine.look_up(&mut client, vec![fleet.name(batch, 0)]).await);
        read.push(client.read(StoreKey::Name(fleet.name(batch, 1))).await);
    }
    let all: Duration = found.iter().sum();
    row("look-ups a second, one at a time", rate(found.len(), all));
    let (middle, slow) = middle_and_slow(&mut found);
    let (read_middle, read_slow) = middle_and_slow(&mut read);
    row("a look-up, p50 / p99", format!("{} / {}", micros(middle), micros(slow)));
    row("a read of the store, p50 / p99", format!("{} / {}", micros(read_middle), micros(read_slow)));
    let goal = |read: Duration| 2 * read + Duration::from_millis(1);
    row(
        "goal: 2 reads + 1 ms, p50 / p99",
        format!("{} / {}", micros(goal(read_middle)), micros(goal(read_slow))),
    );

    // Another router, which knows nothing yet.
    let mut client = Client::start(config.clone()).await;
    let mut machine = Machine::new(&asker, unix);
    let names: Vec<_> = (0..most).map(|batch| fleet.name(batch, 2)).collect();
    let mut times = machine.look_up(&mut client, names).await;
    let all = times.last().copied().expect("some names");
    row(&format!("look-ups a second, {most} at once"), rate(most, all));
    let (middle, slow) = middle_and_slow(&mut times);
    row("a look-up of them, p50 / p99", format!("{} / {}", millis(middle), millis(slow)));

    let began = Instant::now();
    let mut left = 0..most;
    let mut times = vec![];
    let next = || left.next().map(|batch| (StoreKey::Name(fleet.name(batch, 3)), StoreAction::Read, ()));
    client.all(OPS_MAX, next, |(), _| times.push(began.elapsed())).await;
    let (middle, slow) = middle_and_slow(&mut times);
    row(&format!("{most} reads at once, p50 / p99"), format!("{} / {}", millis(middle), millis(slow)));
}

/// Looks names of the whole store up by the driver alone, without a router that verifies.
async fn driver_look_ups(client: &mut Client, fleet: &Fleet) {
    let batch_of: BTreeMap<NodeId, usize> =
        (0..fleet.batches).step_by(OWNER_BATCHES).map(|batch| (fleet.owner(batch), batch)).collect();
    let second = std::cell::RefCell::new(VecDeque::new());
    let mut begun = 0;
    let next = || {
        if let Some(key) = second.borrow_mut().pop_front() {
            return Some((key, StoreAction::Read, false));
        }
        if begun == DRIVER_LOOK_UPS {
            return None;
        }
        begun += 1;
        let at = u64::from_be_bytes(scatter(5, begun)) as usize % (fleet.batches * BATCH_NAMES);
        let name = fleet.name(at / BATCH_NAMES, at % BATCH_NAMES);
        Some((StoreKey::Name(name), StoreAction::Read, true))
    };
    let began = Instant::now();
    let then = |is_name, reply| {
        let StoreReply::Value(Some(value)) = reply else { panic!("a value is missing: {reply:?}") };
        if is_name {
            let (owner, tag) = value.split_at(32);
            let owner = NodeId(owner.try_into().expect("an owner"));
            assert!(batch_of.contains_key(&owner));
            let tag = BatchTag(tag.try_into().expect("a tag"));
            second.borrow_mut().extend([StoreKey::Batch { owner, tag }, StoreKey::Node(owner)]);
        }
    };
    client.all(1000, next, then).await;
    row("look-ups a second by the driver alone, 1000 reads at once", rate(DRIVER_LOOK_UPS, began.elapsed()));
}

/// Reads names until each has been read once more, those that fail again after a pause. Returns the time until the last
/// one, and the reads that failed.
async fn until_all_are_read(client: &mut Client, fleet: &Fleet, began: Instant) -> (Duration, usize) {
    let key = |number: usize| StoreKey::Name(fleet.name(number % fleet.batches, number / fleet.batches));
    let mut left: Vec<usize> = (0..WATCHED).collect();
    let mut failures = 0;
    loop {
        let mut under_way: BTreeMap<_, _> =
            left.drain(..).map(|number| (client.begin(key(number), StoreAction::Read), number)).collect();
        while !under_way.is_empty() {
            let (id, reply) = client.reply().await;
            let number = under_way.remove(&id).expect("an operation that is under way");
            match reply {
                Some(StoreReply::Value(Some(_))) => {}
                Some(other) => panic!("name {number} is lost: {other:?}"),
                None => left.push(number),
            }
        }
        if left.is_empty() {
            return (began.elapsed(), failures);
        }
        failures += left.len();
        assert!(began.elapsed() < WAIT_MAX, "{} names cannot be read", left.len());
        tokio::time::sleep(REPEAT_AFTER).await;
    }
}

async fn recover(client: &mut Client, redis: &mut Redis, fleet: &Fleet) {
    for index in 0..HOSTS.len() {
        redis.cli(index, &["CONFIG", "SET", "cluster-node-timeout", KILLED_TIMEOUT_MS]);
    }
    let (undisturbed, _) = until_all_are_read(client, fleet, Instant::now()).await;
    row(&format!("{WATCHED} reads at once before"), millis(undisturbed));
    let began = Instant::now();
    redis.kill(0);
    let (time, failures) = until_all_are_read(client, fleet, began).await;
    row("a primary is killed: all names are read again after", millis(time));
    row("reads that failed meanwhile, each repeated after 20 ms", failures);

    (1..HOSTS.len()).for_each(|index| redis.kill(index));
    while client.event().await != StoreEvent::Down {}
    let began = Instant::now();
    (0..HOSTS.len()).for_each(|index| redis.restart(index));
    let answers = began.elapsed();
    while client.event().await != StoreEvent::Up {}
    row("all servers are started again: all answer after", millis(answers));
    row("the driver reports the store as up after", millis(began.elapsed()));
}

async fn measure(config: StoreConfig, redis: &mut Redis, fleet: &Fleet, unix: UnixMillis) {
    let mut client = Client::start(config.clone()).await;
    let before = memory(redis);
    let began = Instant::now();
    let (writes, failures) = fill(&mut client, fleet).await;
    let filled = began.elapsed();
    let names = fleet.batches * BATCH_NAMES;
    row("names", names);
    row("batches of 256, their bytes each", format!("{}, {}", fleet.batches, fleet.signed[0].value.len()));
    row("filled in", format!("{:.1} s", filled.as_secs_f64()));
    row("writes a second", rate(writes, filled));
    row("writes that failed and were repeated", failures);
    row("names a second", rate(names, filled));
    row("bytes of the primaries a name", format!("{:.0}", (memory(redis) - before) as f64 / names as f64));

    let began = Instant::now();
    let mut left = 0..RENEWALS;
    let next = || {
        left.next().map(|number| {
            let (key, action) = fleet.batch_write(number % fleet.batches);
            (key, action, ())
        })
    };
    let then = |(), reply| assert_eq!(reply, StoreReply::Written { existed: true });
    let (renewed, _) = client.all(512, next, then).await;
    row("renewals a second (goal: 10⁷ names take at most 500)", rate(renewed, began.elapsed()));
    let each_s = LEASE.as_secs_f64() / 3.0;
    row("renewals a second that 10⁷ names need", format!("{:.0}", 1e7 / BATCH_NAMES as f64 / each_s));

    look_ups(&config, fleet, unix).await;
    driver_look_ups(&mut client, fleet).await;
    publish(fleet, unix);
    recover(&mut client, redis, fleet).await;
}

fn main() {
    let mut args = std::env::args().skip(1);
    let mut names = 1_000_000;
    while let Some(arg) = args.next() {
        match arg.as_str() {
            "--names" => names = args.next().and_then(|n| n.parse().ok()).expect("--names takes a number"),
            _ => panic!("--names 1000000, not {arg}"),
        }
    }
    let unix = Clock::default().now().unix;
    let fleet = Fleet::new(names.max(WATCHED), unix);
    let name = |place| format!("sgcbs-{}-{place}", std::process::id());
    let store = Arc::new(Namespace::create(name("store")).expect("root may create namespaces"));
    let place = Arc::new(Namespace::create(name("router")).expect("root may create namespaces"));
    let addresses: Vec<String> = HOSTS.iter().map(|host| format!("{host}/24")).collect();
    let addresses: Vec<&str> = addresses.iter().map(String::as_str).collect();
    store.veth(("eth0", &addresses), &place, ("eth0", &["10.78.0.100/24"])).expect("a pair of interfaces");
    let folder = tempfile::tempdir().expect("a folder");
    let options = RedisOptions {
        program: std::env::var("SGC_REDIS_SERVER").unwrap_or_else(|_| "redis-server".into()),
        settings: ["--cluster-node-timeout", LOADED_TIMEOUT_MS].map(str::to_owned).to_vec(),
        ..RedisOptions::default()
    };
    let mut redis = Redis::cluster(store, folder.path(), &HOSTS, options);
    let servers = redis.urls()[..1].iter().map(|url| StoreServer::parse(url).expect("a URL")).collect();
    let prefix = StorePrefix::new("fleet-a").expect("a prefix");
    let config = StoreConfig::new(servers, prefix, None, None).expect("a configuration");
    println!("| | |\n|---|---|");
    let inside = place.clone();
    place
        .within(|| {
            let runtime = tokio::runtime::Builder::new_multi_thread()
                .worker_threads(1)
                .on_thread_start(move || inside.enter().expect("the namespace exists"))
                .enable_all()
                .build()
                .expect("a runtime");
            runtime.block_on(measure(config, &mut redis, &fleet, unix));
        })
        .expect("the namespace exists");
}
