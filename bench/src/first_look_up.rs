//! Measures how long a node waits until its router tells it of a name that nobody there asked for before, by each
//! mapping in turn: `flood`, where each router has all names, `query`, where routers ask each other, and `store`, a
//! cluster of `redis-server`.
//!
//! Each mapping has two routers, processes that are linked to each other. Owners are linked to the one and advertise
//! batches of 256 names; a node at the other wants one name of each batch, one after another. The time is that from
//! `Interest` to `Advert`, with both ways of the node's link. Everything is in one network namespace.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use serde::Serialize;
use sgc_router::{StoreAction, StoreEvent, StoreKey, StoreOp, StoreOpId, StoreReply};
use sgc_store::{StoreConfig, StorePrefix};
use sgc_testkit::netsim::Namespace;
use sgc_testkit::redis::{Redis, RedisOptions};
use sgc_transport::{AnyLink, Dialer, Link, LinkOptions};
use sgc_trust::{Identity, name_of};
use sgc_wire::{
    Adjacency, AdvertBody, Control, Decode, Encode, Hello, LinkStateBody, Name, NodeId, UnixMillis,
};
use tokio::sync::mpsc;
use tokio::time::timeout;

use crate::RunArgs;
use crate::fleet::{BenchFleet, now};
use crate::process::{PATIENCE, SgcRouter};
use crate::report::{Report, Spread, Table, digits};
use crate::rib::{BATCH, Member};

const MAPPINGS: [&str; 3] = ["flood", "query", "store"];
/// Addresses of the servers: three primaries with a replica each.
const SERVERS: [&str; 6] = ["127.0.0.2", "127.0.0.3", "127.0.0.4", "127.0.0.5", "127.0.0.6", "127.0.0.7"];
/// Batches of an owner.
const OWNER_BATCHES: usize = 4;
/// Lease of link states, longer than a run.
const LEASE_MS: u32 = 600_000;

/// The figures of one mapping.
#[derive(Serialize)]
struct Figures {
    mapping: &'static str,
    names: usize,
    look_ups: usize,
    /// From `Interest` to `Advert`, microseconds.
    look_up_us: Spread,
    /// Memory of the router that was asked, bytes, before the look-ups.
    resident_bytes: u64,
}

/// Measures the mappings in turn.
pub(crate) fn run(args: &RunArgs) -> Result<Report> {
    let batches = if args.quick { 40 } else { 1000 };
    let home = Arc::new(Namespace::create(format!("sgcbl-{}", std::process::id()))?);
    let inside = Arc::clone(&home);
    let (figures, read_us) = home.within(|| measure(args, inside, batches))??;
    let row = |f: &Figures| {
        vec![
            f.mapping.to_owned(),
            f.names.to_string(),
            f.look_ups.to_string(),
            format!("{} / {}", digits(f.look_up_us.p50), digits(f.look_up_us.p99)),
            format!("{:.0}", f.resident_bytes as f64 / f64::from(1 << 20)),
        ]
    };
    let mut rows: Vec<_> = figures.iter().map(row).collect();
    let goal = |read: f64| digits(2.0 * read + 1000.0);
    let read = format!("{} / {}", digits(read_us.p50), digits(read_us.p99));
    let goal = format!("{} / {}", goal(read_us.p50), goal(read_us.p99));
    rows.push(vec!["a read of the store".into(), String::new(), String::new(), read, String::new()]);
    rows.push(vec!["goal: 2 reads + 1 ms".into(), String::new(), String::new(), goal, String::new()]);
    let table = Table {
        title: "The first look-up of a name at a router, µs".into(),
        columns: vec!["mapping", "names", "look-ups", "p50 / p99", "memory of the router before, MiB"],
        rows,
    };
    Report::new(&serde_json::json!({ "mappings": figures, "read_us": read_us }), vec![table])
}

/// Two routers with one mapping, the node at the far one, and a name of each batch.
struct Side {
    mapping: &'static str,
    near: SgcRouter,
    far: SgcRouter,
    _owners: Vec<Member<End>>,
    asker: End,
    wanted: Vec<(NodeId, Name)>,
    times: Vec<f64>,
    resident_bytes: u64,
    _dir: tempfile::TempDir,
}

fn measure(args: &RunArgs, home: Arc<Namespace>, batches: usize) -> Result<(Vec<Figures>, Spread)> {
    let dir = tempfile::tempdir()?;
    let redis = Redis::cluster(Arc::clone(&home), dir.path(), &SERVERS, RedisOptions::default());
    let fleet = BenchFleet::new()?;
    let runtime = crate::node::runtime_in(&home)?;
    let mut sides = Vec::new();
    for mapping in MAPPINGS {
        sides.push(runtime.block_on(Side::start(&args.sgc, &fleet, mapping, &redis.urls(), batches))?);
    }
    let read_us = runtime.block_on(async {
        let mut store = Store::connect(&redis.urls()).await?;
        let mut reads = Vec::new();
        for batch in 0..batches {
            for turn in 0..sides.len() {
                let turn = (turn + batch) % MAPPINGS.len();
                sides[turn].look_up(batch).await?;
            }
            let stored =
                sides.iter().find(|side| side.mapping == "store").context("a side with the store")?;
            reads.push(store.read(stored.wanted[batch].1).await?);
        }
        anyhow::Ok(Spread::from_samples(reads))
    })?;
    let figures = sides.into_iter().map(|side| Figures {
        mapping: side.mapping,
        names: batches * BATCH,
        look_ups: side.times.len(),
        look_up_us: Spread::from_samples(side.times),
        resident_bytes: side.resident_bytes,
    });
    Ok((figures.collect(), read_us))
}

impl Side {
    async fn start(
        sgc: &Path,
        fleet: &BenchFleet,
        mapping: &'static str,
        servers: &[String],
        batches: usize,
    ) -> Result<Self> {
        let dir = tempfile::tempdir()?;
        let mut keys = format!("mapping = \"{mapping}\"\n");
        if mapping == "store" {
            keys += &format!("store = {servers:?}\n");
        }
        let (near_dir, far_dir) = (dir.path().join("near"), dir.path().join("far"));
        for dir in [&near_dir, &far_dir] {
            std::fs::create_dir(dir)?;
        }
        let near_id = fleet.write_router_of(&near_dir, "near")?;
        fleet.write_router_of(&far_dir, "far")?;
        let near = SgcRouter::start_as("quic", sgc, &near_dir, "", &keys)?;
        let far =
            SgcRouter::start_as("quic", sgc, &far_dir, &format!("routers = [{:?}]\n", near.url), &keys)?;

        let mut rng = ChaCha20Rng::seed_from_u64(5);
        let (mut owners, mut wanted) = (Vec::new(), Vec::new());
        for n in 0..batches.div_ceil(OWNER_BATCHES) {
            let identity = fleet.issue(&format!("owner-{n}"), false)?;
            let end = End::connect(&near.url, Arc::clone(&identity), Some(near_id)).await?;
            let mut owner = Member::new(identity, end);
            for _ in 0..OWNER_BATCHES.min(batches - wanted.len()) {
                let advert = owner.advert(BATCH, now().unix, &mut rng);
                owner.link.link.send_control(advert.bytes).await?;
                wanted.push((owner.identity.node_id(), advert.names[0]));
            }
            owners.push(owner);
        }
        let asker = End::connect(&far.url, fleet.issue("asker", false)?, None).await?;
        let side = Self {
            mapping,
            near,
            far,
            _owners: owners,
            asker,
            wanted,
            times: Vec::new(),
            resident_bytes: 0,
            _dir: dir,
        };
        tokio::task::block_in_place(|| side.until_settled(batches * BATCH))
    }

    /// Waits until the names are where the mapping keeps them.
    fn until_settled(mut self, names: usize) -> Result<Self> {
        let knower = if self.mapping == "flood" { &self.far } else { &self.near };
        let begun = Instant::now();
        // Routers have names of their own.
        while knower.routed_names()? < names as u64 {
            ensure!(begun.elapsed() < PATIENCE, "{}: not all names arrive", self.mapping);
            std::thread::sleep(Duration::from_millis(100));
        }
        if self.mapping == "store" {
            while self.near.status()?["store"]["pending"].as_u64() != Some(0) {
                ensure!(begun.elapsed() < PATIENCE, "the router does not fill the store");
                std::thread::sleep(Duration::from_millis(100));
            }
        }
        self.resident_bytes = self.far.process.resident_bytes();
        Ok(self)
    }

    async fn look_up(&mut self, batch: usize) -> Result<()> {
        let (owner, name) = self.wanted[batch];
        let begun = Instant::now();
        self.asker.link.send_control(Control::Interest { names: vec![name] }.to_bytes()).await?;
        let heard = timeout(PATIENCE, self.asker.adverts.recv()).await;
        let (at, advert) = heard.ok().flatten().with_context(|| format!("{}: no answer", self.mapping))?;
        let is_told = advert.blinds.iter().any(|blind| name_of(&owner, blind) == name);
        ensure!(is_told, "{}: another name is told", self.mapping);
        self.times.push((at - begun).as_secs_f64() * 1e6);
        Ok(())
    }
}

/// A node's end of a link to a router.
struct End {
    link: AnyLink,
    /// Advertisements that come, with their times.
    adverts: mpsc::UnboundedReceiver<(Instant, AdvertBody)>,
}

impl End {
    /// Connects and greets. With a router's id, says also that it is attached there.
    async fn connect(url: &str, identity: Arc<Identity>, attached: Option<NodeId>) -> Result<Self> {
        let dialer = Dialer::new(Arc::clone(&identity), LinkOptions::default(), Arc::default());
        let link = dialer.dial(&url.parse()?).await?;
        let hello = Hello { minor: 0, incarnation: 1, transit: false, yields: false, started: UnixMillis(1) };
        link.send_control(Control::Hello(hello).to_bytes()).await?;
        if let Some(router) = attached {
            let body = LinkStateBody {
                chain: identity.chain_bytes(),
                seq: now().unix.0,
                issued_at: now().unix,
                lease_ms: LEASE_MS,
                floor: 0,
                transit: false,
                routers: vec![Adjacency { node: router, cost: 1000 }],
                attached: vec![],
            };
            let signed = identity.sign_link_state(&body);
            link.send_control(Control::LinkState { signed }.to_bytes()).await?;
        }
        let (heard, adverts) = mpsc::unbounded_channel();
        let reader = link.clone();
        tokio::spawn(async move {
            // The sockets of a dialer end with it.
            let _dialer = dialer;
            while let Ok(frame) = reader.recv_control().await {
                let at = Instant::now();
                if let Ok(Control::Advert { signed, .. }) = Control::from_slice(&frame) {
                    let Ok(advert) = AdvertBody::from_slice(&signed.body) else { continue };
                    if heard.send((at, advert)).is_err() {
                        return;
                    }
                }
            }
        });
        Ok(Self { link, adverts })
    }
}

/// A client of the store beside the routers.
struct Store {
    operations: mpsc::Sender<StoreOp>,
    events: mpsc::Receiver<StoreEvent>,
    next: u64,
}

impl Store {
    async fn connect(urls: &[String]) -> Result<Self> {
        let servers = urls.iter().map(|url| url.parse()).collect::<Result<_, _>>()?;
        let config = StoreConfig::new(servers, StorePrefix::default(), None, None)?;
        let (operations, receiver) = mpsc::channel(16);
        let (sender, events) = mpsc::channel(16);
        tokio::spawn(sgc_store::run(config, receiver, sender));
        let mut store = Self { operations, events, next: 0 };
        while store.event().await? != StoreEvent::Up {}
        Ok(store)
    }

    async fn event(&mut self) -> Result<StoreEvent> {
        timeout(PATIENCE, self.events.recv()).await?.context("the driver ends")
    }

    /// Reads a name. Returns the time that it took, microseconds.
    async fn read(&mut self, name: Name) -> Result<f64> {
        let begun = Instant::now();
        self.next += 1;
        let id = StoreOpId(self.next);
        let read = StoreOp { id, key: StoreKey::Name(name), action: StoreAction::Read };
        self.operations.send(read).await?;
        loop {
            match self.event().await? {
                StoreEvent::Reply { result: Ok(StoreReply::Value(Some(_))), .. } => {
                    return Ok(begun.elapsed().as_secs_f64() * 1e6);
                }
                StoreEvent::Reply { result, .. } => bail!("a name is not in the store: {result:?}"),
                _ => {}
            }
        }
    }
}
