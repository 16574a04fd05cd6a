//! Measures the cost of names over real links to a router's process: owners publish, a subscriber joins and is
//! answered.

use std::collections::HashMap;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Instant;

use anyhow::{Context, Result, bail, ensure};
use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use serde::Serialize;
use sgc_transport::{AnyLink, Dialer, Link, LinkOptions, LinkUrl};
use sgc_trust::Identity;
use sgc_wire::{AdvertBody, AnswerBody, Control, Decode, Encode, Hello, JoinBody, Name, SinkId, UnixMillis};
use tokio::sync::mpsc;

use super::frames::{BATCH, Member, NAMES_PER_OWNER};
use crate::fleet::{BenchFleet, now};
use crate::process::SgcRouter;
use crate::report::{Spread, Table, digits};

/// Subscriptions that are timed one by one, and as many again that are sent all at once: together fewer than a router
/// takes from one link without pause.
const SUBSCRIPTIONS: usize = 500;

/// The figures of one size.
#[derive(Serialize)]
pub(super) struct OverSockets {
    names: usize,
    /// Links over which they are published, all at once.
    owners: usize,
    /// From the first frame until the router says that it has all, a name, microseconds.
    publish_us_per_name: f64,
    /// CPU time of the router for a name, microseconds; its links' encryption is in it.
    publish_cpu_us_per_name: f64,
    bytes_per_name: f64,
    /// From a request to join to the owner's answer, over the router and back, microseconds.
    subscribe_us: Spread,
    /// CPU time of the router for each of many, microseconds.
    subscribe_cpu_us: f64,
}

/// Answers by the sink that they are for, made before they are needed.
type Answers = Arc<Mutex<HashMap<SinkId, Bytes>>>;

/// A node's end of a link to the router.
#[derive(Clone)]
struct End {
    link: AnyLink,
}

impl End {
    /// Connects and greets. Joins that come are answered with what is in `answers`; answers go to `heard`.
    async fn connect(
        url: &LinkUrl,
        identity: Arc<Identity>,
        answers: Answers,
        heard: mpsc::Sender<SinkId>,
    ) -> Result<Self> {
        let dialer = Dialer::new(identity, LinkOptions::default(), Arc::default());
        let link = dialer.dial(url).await?;
        let hello = Hello { minor: 0, incarnation: 1, transit: false, yields: false, started: UnixMillis(1) };
        link.send_control(Control::Hello(hello).to_bytes()).await?;
        let reader = link.clone();
        tokio::spawn(async move {
            // The sockets of a dialer end with it.
            let _dialer = dialer;
            while let Ok(frame) = reader.recv_control().await {
                let answered = match Control::from_slice(&frame) {
                    Ok(Control::Join { signed }) => answer(&reader, &signed.body, &answers).await,
                    Ok(Control::Answer { signed }) => hear(&signed.body, &heard).await,
                    Ok(Control::Reject { reason, .. }) => Err(anyhow::anyhow!("rejected: {reason}")),
                    _ => Ok(()),
                };
                if let Err(error) = answered {
                    eprintln!("rib over sockets: {error}");
                }
            }
        });
        Ok(Self { link })
    }

    async fn send(&self, frame: Bytes) -> Result<()> {
        Ok(self.link.send_control(frame).await?)
    }
}

async fn answer(link: &AnyLink, join: &[u8], answers: &Answers) -> Result<()> {
    let sink = JoinBody::from_slice(join)?.sink;
    let answer = answers.lock().unwrap_or_else(PoisonError::into_inner).remove(&sink);
    Ok(link.send_control(answer.context("a request that nobody made")?).await?)
}

async fn hear(answer: &[u8], heard: &mpsc::Sender<SinkId>) -> Result<()> {
    Ok(heard.send(AnswerBody::from_slice(answer)?.sink).await?)
}

/// Owners that are connected, each with the advertisements that it has not sent yet.
type Owners = Vec<(Member<End>, Vec<Bytes>)>;

/// Connects owners of so many names and signs what they will say; the names, each with its owner.
async fn sign(
    url: &LinkUrl,
    fleet: &BenchFleet,
    names: usize,
    answers: &Answers,
    heard: &mpsc::Sender<SinkId>,
    rng: &mut ChaCha20Rng,
) -> Result<(Owners, Vec<(usize, Name)>)> {
    let count = names.div_ceil(NAMES_PER_OWNER);
    let per_owner = names.div_ceil(count.max(1));
    let (mut owners, mut targets, mut left) = (Vec::new(), Vec::new(), names);
    for n in 0..count {
        let identity = fleet.issue(&format!("owner-{n}"), false)?;
        let end = End::connect(url, identity.clone(), answers.clone(), heard.clone()).await?;
        let mut owner = Member::new(identity, end);
        let mut own = per_owner.min(left);
        left -= own;
        let mut frames = Vec::new();
        while own > 0 {
            let advert = owner.advert(own.min(BATCH), now().unix, rng);
            own -= advert.names.len();
            targets.extend(advert.names.iter().map(|name| (n, *name)));
            frames.push(advert.bytes);
        }
        owners.push((owner, frames));
    }
    Ok((owners, targets))
}

/// Sends what they have to say, all of them at once.
async fn tell_all(owners: &mut Owners) -> Result<()> {
    let mut sending = tokio::task::JoinSet::new();
    for (owner, frames) in owners {
        let (end, frames) = (owner.link.clone(), std::mem::take(frames));
        sending.spawn(async move {
            for frame in frames {
                end.send(frame).await?;
            }
            anyhow::Ok(())
        });
    }
    while let Some(sent) = sending.join_next().await {
        sent??;
    }
    Ok(())
}

/// Nodes that stay linked to a router while this lives, and the names that they own.
pub(crate) struct LinkedOwners {
    owners: Owners,
    rng: ChaCha20Rng,
    runtime: tokio::runtime::Runtime,
}

impl LinkedOwners {
    /// Connects owners of so many names, whose advertisements are signed and not sent yet.
    pub(crate) fn prepare(url: &str, fleet: &BenchFleet, names: usize) -> Result<Self> {
        let (runtime, mut rng) = (runtime()?, ChaCha20Rng::seed_from_u64(3));
        let ((heard, _), answers) = (mpsc::channel(1), Answers::default());
        let url = url.parse()?;
        let signed = sign(&url, fleet, names, &answers, &heard, &mut rng);
        let (owners, _) = runtime.block_on(signed)?;
        Ok(Self { owners, rng, runtime })
    }

    /// Connects nodes without names, by their numbers.
    pub(crate) fn connect(url: &str, fleet: &BenchFleet, nodes: std::ops::Range<usize>) -> Result<Self> {
        let (runtime, rng) = (runtime()?, ChaCha20Rng::seed_from_u64(4));
        let (heard, _) = mpsc::channel(1);
        let url = url.parse()?;
        let mut owners = Vec::new();
        for n in nodes {
            let identity = fleet.issue(&format!("node-{n}"), false)?;
            let end = End::connect(&url, identity.clone(), Answers::default(), heard.clone());
            owners.push((Member::new(identity, runtime.block_on(end)?), Vec::new()));
        }
        Ok(Self { owners, rng, runtime })
    }

    /// Returns the number of their links, one each.
    pub(crate) fn links(&self) -> usize {
        self.owners.len()
    }

    /// Advertises all names to the router.
    pub(crate) fn advertise_all(&mut self) -> Result<()> {
        self.runtime.block_on(tell_all(&mut self.owners))
    }

    /// Advertises one more name.
    pub(crate) fn advertise_one(&mut self) -> Result<()> {
        let (owner, _) = self.owners.first_mut().context("nobody owns a name")?;
        let advert = owner.advert(1, now().unix, &mut self.rng);
        self.runtime.block_on(owner.link.send(advert.bytes))
    }
}

/// Another router, which hears of every name and advertises none.
pub(crate) struct Neighbour {
    told: mpsc::Receiver<usize>,
    _link: AnyLink,
    _dialer: Dialer,
    runtime: tokio::runtime::Runtime,
}

impl Neighbour {
    /// Links it to a router and greets.
    pub(crate) fn connect(url: &str, fleet: &BenchFleet) -> Result<Self> {
        let runtime = runtime()?;
        let dialer = Dialer::new(fleet.issue("neighbour", true)?, LinkOptions::default(), Arc::default());
        let link = runtime.block_on(dialer.dial(&url.parse()?))?;
        let (tell, told) = mpsc::channel(1024);
        let reader = link.clone();
        runtime.spawn(async move {
            while let Ok(frame) = reader.recv_control().await {
                let Ok(Control::Advert { signed, .. }) = Control::from_slice(&frame) else { continue };
                let names = AdvertBody::from_slice(&signed.body).map_or(0, |body| body.blinds.len());
                if tell.send(names).await.is_err() {
                    return;
                }
            }
        });
        let hello = Hello { minor: 0, incarnation: 1, transit: true, yields: false, started: UnixMillis(1) };
        runtime.block_on(link.send_control(Control::Hello(hello).to_bytes()))?;
        Ok(Self { told, _link: link, _dialer: dialer, runtime })
    }

    /// Waits until it has heard of so many names.
    pub(crate) fn hears(&mut self, names: usize) -> Result<()> {
        let told = &mut self.told;
        self.runtime.block_on(async {
            let mut heard = 0;
            while heard < names {
                match tokio::time::timeout(crate::process::PATIENCE, told.recv()).await {
                    Ok(Some(more)) => heard += more,
                    _ => bail!("a neighbour hears of {heard} names instead of {names}"),
                }
            }
            Ok(())
        })
    }
}

fn runtime() -> Result<tokio::runtime::Runtime> {
    Ok(tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?)
}

/// Measures one size.
pub(super) fn run(sgc: &Path, names: usize) -> Result<OverSockets> {
    runtime()?.block_on(measure(sgc, names))
}

async fn measure(sgc: &Path, names: usize) -> Result<OverSockets> {
    let mut rng = ChaCha20Rng::seed_from_u64(2);
    let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
    fleet.write_router(dir.path())?;
    let router = SgcRouter::start(sgc, dir.path())?;
    let url: LinkUrl = router.url.parse()?;
    let answers = Answers::default();
    let (heard, mut hears) = mpsc::channel(2 * SUBSCRIPTIONS);

    // Everything is signed before the clock runs.
    let (mut owners, targets) = sign(&url, &fleet, names, &answers, &heard, &mut rng).await?;
    let count = owners.len();
    let before = router.routed_names()?;
    let (cpu, bytes) = (router.process.cpu_seconds(), router.process.resident_bytes());
    let begun = Instant::now();
    tell_all(&mut owners).await?;
    tokio::task::block_in_place(|| router.until_routed(before + names as u64))?;
    let publish_us_per_name = begun.elapsed().as_secs_f64() * 1e6 / names as f64;
    let publish_cpu_us_per_name = (router.process.cpu_seconds() - cpu) * 1e6 / names as f64;
    let bytes_per_name = router.process.resident_bytes().saturating_sub(bytes) as f64 / names as f64;

    let identity = fleet.issue("joiner", false)?;
    let end = End::connect(&url, identity.clone(), Answers::default(), heard).await?;
    let joiner = Member::new(identity, end);
    let mut joins = Vec::new();
    for n in 0..2 * SUBSCRIPTIONS {
        let (owner, name) = targets[n * 7919 % targets.len()];
        let (sink, join) = joiner.join(name, now().unix, &mut rng);
        let answer = owners[owner].0.answer(name, sink, &mut rng);
        answers.lock().unwrap_or_else(PoisonError::into_inner).insert(sink, answer);
        joins.push((sink, join));
    }
    let at_once = joins.split_off(SUBSCRIPTIONS);
    let mut times = Vec::new();
    for (sink, join) in joins {
        let begun = Instant::now();
        joiner.link.send(join).await?;
        ensure!(next(&mut hears).await? == sink, "another subscription is answered");
        times.push(begun.elapsed().as_secs_f64() * 1e6);
    }
    let cpu = router.process.cpu_seconds();
    for (_, join) in at_once {
        joiner.link.send(join).await?;
    }
    for _ in 0..SUBSCRIPTIONS {
        next(&mut hears).await?;
    }
    let subscribe_cpu_us = (router.process.cpu_seconds() - cpu) * 1e6 / SUBSCRIPTIONS as f64;
    Ok(OverSockets {
        names,
        owners: count,
        publish_us_per_name,
        publish_cpu_us_per_name,
        bytes_per_name,
        subscribe_us: Spread::from_samples(times),
        subscribe_cpu_us,
    })
}

async fn next(hears: &mut mpsc::Receiver<SinkId>) -> Result<SinkId> {
    match tokio::time::timeout(crate::process::PATIENCE, hears.recv()).await {
        Ok(Some(sink)) => Ok(sink),
        _ => bail!("a subscription is not answered"),
    }
}

pub(super) fn table(all: &[OverSockets]) -> Table {
    let row = |f: &OverSockets| {
        vec![
            f.names.to_string(),
            f.owners.to_string(),
            digits(f.bytes_per_name),
            digits(f.publish_us_per_name),
            digits(f.publish_cpu_us_per_name),
            format!("{} / {}", digits(f.subscribe_us.p50), digits(f.subscribe_us.p99)),
            digits(f.subscribe_cpu_us),
        ]
    };
    Table {
        title: "Over real links into a router's process, µs".into(),
        columns: vec![
            "names",
            "owners' links",
            "bytes a name",
            "publish, 256 at once: a name",
            "router CPU a name",
            "subscribe, there and back: p50 / p99",
            "router CPU a subscription",
        ],
        rows: all.iter().map(row).collect(),
    }
}
