//! Table `footprint`: what a node costs while nothing happens, by topics, links and names, beside the bridges that were
//! asked for.
//!
//! A figure is of one process that has come to rest. Applications, owners of names and the far ends of links are in
//! this process, which is not measured.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use sgc_dds::{CycloneNetwork, CycloneReader, CycloneWriter, DdsConfig, DiscoveryRange};
use sgc_ros::{DiscoveryEvent, EndpointKind, EndpointSpec, RosNetwork as _, dds_topic, dds_type};
use sgc_testkit::netsim::Namespace;
use sgc_wire::Qos;

use super::lab::{Lab, PathKind};
use super::program::Program;
use super::system::System;
use super::turns::abreast;
use super::{Compare, Figures};
use crate::fleet::BenchFleet;
use crate::process::{PATIENCE, SgcRouter, resident_bytes_of, status, status_field_of, thread_seconds_of};
use crate::rib::LinkedOwners;

const TABLE: &str = "footprint";
const TOPICS: [usize; 6] = [0, 1, 10, 100, 200, 1000];
const NAMES: [usize; 4] = [0, 10_000, 100_000, 1_000_000];
const LINKS: [usize; 4] = [1, 10, 100, 1000];
/// Most topics, links or names in a quick run, which only shows that all works.
const QUICK_MAX: usize = 100;
const QUICK_NAMES_MAX: usize = 10_000;
/// Prefix of the topics' names.
const TOPIC: &str = "/footprint/t";
/// ROS domains of the two ends.
const DOMAINS: [u32; 2] = [41, 42];
/// How long a process at rest is watched: one with nothing to do, and one that has more to keep.
pub(crate) const IDLE: Duration = Duration::from_secs(20);
const IDLE_WITH_MORE: Duration = Duration::from_secs(5);
pub(crate) const IDLE_QUICK: Duration = Duration::from_secs(2);
/// A process is at rest when it took less of a core than this for so long, or after as long as that takes at most.
const REST_PART: f64 = 0.02;
const REST_LOOK: Duration = Duration::from_secs(1);
const REST_MAX: Duration = Duration::from_secs(40);

/// Measures it.
pub(crate) fn run(compare: &Compare, figures: &mut Figures) -> Result<()> {
    let program =
        compare.sgc().canonicalize().with_context(|| format!("{}: is it built?", compare.sgc().display()))?;
    match stripped_bytes(&program) {
        Ok(bytes) => figures.push(TABLE, "sgc", "program", 0.0, "program_bytes", bytes as f64),
        Err(error) => figures.leave_out("footprint, size of the program", format!("{error:#}")),
    }
    let stage = Stage { program, is_quick: compare.is_quick() };
    let fits = |count: &&usize| !compare.is_quick() || **count <= QUICK_MAX;
    let sizes = |all: &[usize]| all.iter().filter(fits).copied().collect::<Vec<_>>();
    if let Err(error) = stage.topics(&sizes(&TOPICS), compare, figures) {
        figures.leave_out("footprint, topics", format!("{error:#}"));
    }
    if let Err(error) = stage.links(&sizes(&LINKS), compare, figures) {
        figures.leave_out("footprint, links", format!("{error:#}"));
    }
    for names in NAMES.into_iter().filter(|names| !compare.is_quick() || *names <= QUICK_NAMES_MAX) {
        compare.note(&format!("footprint, {names} names"));
        if let Err(error) = stage.names(names, figures) {
            figures.leave_out(&format!("footprint, {names} names"), format!("{error:#}"));
        }
    }
    compare.note("footprint, others");
    bridges(compare, if compare.is_quick() { IDLE_QUICK } else { IDLE }, figures);
    Ok(())
}

/// The parts that all measurements share.
struct Stage {
    program: PathBuf,
    is_quick: bool,
}

/// A place of its own: a loopback interface and nothing else.
struct Place {
    home: Arc<Namespace>,
    dir: tempfile::TempDir,
    fleet: BenchFleet,
}

/// A node's process.
struct Node {
    process: Program,
    socket: PathBuf,
    url: Option<String>,
}

impl Place {
    fn new(what: &str) -> Result<Self> {
        let home = Arc::new(Namespace::create(format!("sgcfoot-{}-{what}", std::process::id()))?);
        home.ip(&["link", "set", "lo", "multicast", "on"])?;
        Ok(Self { home, dir: tempfile::tempdir()?, fleet: BenchFleet::new()? })
    }

    /// Starts a node with this configuration; up when this returns.
    fn node(&self, program: &Path, node: &str, is_router: bool, text: &str) -> Result<Node> {
        let dir = self.dir.path();
        self.fleet.write(dir, node, is_router)?;
        let (config, socket) = (dir.join(format!("{node}.toml")), dir.join(format!("{node}.sock")));
        let text = format!(
            "identity = \"{node}.identity\"\n[admin]\nsocket = \"{node}.sock\"\n[node]\nstate = \"{node}.state\"\n{text}"
        );
        fs::write(&config, text)?;
        let mut command = self.home.command(program);
        command
            .args(["run", "--print-ready", "--until-stdin-closes", "--log", "warn", "--config"])
            .arg(&config);
        for variable in ["CYCLONEDDS_URI", "ROS_LOCALHOST_ONLY", "ROS_STATIC_PEERS", "SGC_LOG"] {
            command.env_remove(variable);
        }
        let mut process = Program::start(node, command, dir)?;
        let ready = process.soon("ready")?;
        let url = ready[0].as_str().map(str::to_owned);
        Ok(Node { process, socket, url })
    }

    /// A router.
    fn router(&self, program: &Path) -> Result<Node> {
        self.node(program, "router", true, "[router]\nlisten = [\"quic://127.0.0.1:0\"]\n")
    }

    /// An application's participant.
    fn application(&self, domain: u32) -> Result<CycloneNetwork> {
        let config = DdsConfig { domain, discovery: DiscoveryRange::LocalHost, ..DdsConfig::default() };
        Ok(self.home.within(|| CycloneNetwork::open(&config))??)
    }
}

impl Node {
    /// How many links it has.
    fn links(&self) -> Result<usize> {
        Ok(status(&self.socket)?["links"].as_array().context("a status without `links`")?.len())
    }

    fn url(&self) -> Result<&str> {
        self.url.as_deref().context("it listens nowhere")
    }
}

impl Stage {
    /// A proxy that shares topics and one that brings them, with an application at each.
    fn topics(&self, sizes: &[usize], compare: &Compare, figures: &mut Figures) -> Result<()> {
        let mut none = [0.0; 2];
        for &topics in sizes {
            compare.note(&format!("footprint, {topics} topics"));
            let place = Place::new("topics")?;
            let router = place.router(&self.program)?;
            let node = |name: &str, domain: u32, rule: &str| {
                let text = format!(
                    "routers = [{:?}]\n[ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\n{rule}",
                    router.url()?
                );
                place.node(&self.program, name, false, &text)
            };
            let (share, usage) = match topics {
                0 => Default::default(),
                _ => (
                    "[[share]]\ntopic = \"/footprint/**\"\nto = [\"desk\"]\n",
                    "[[use]]\nfrom = \"robot\"\ntopic = \"/footprint/**\"\n",
                ),
            };
            let robot = node("robot", DOMAINS[0], share)?;
            let desk = node("desk", DOMAINS[1], usage)?;
            until("both proxies are connected", || Ok(router.links()? == 2))?;
            let applications = match topics {
                0 => None,
                _ => Some(Applications::start(&place, topics)?),
            };
            if let Some(applications) = &applications {
                until("every topic is at the other end", || Ok(applications.found.load(Relaxed) == topics))?;
            }
            let pids = [("sgc-proxy", robot.process.pid()), ("sgc-proxy-use", desk.process.pid())];
            let both = abreast(pids, |(system, pid)| {
                let mut figures = Figures::default();
                let rss = self.measure(system, "topics", topics, pid, &mut figures)?;
                Ok::<_, anyhow::Error>((system, figures, rss))
            });
            for (outcome, none) in both.into_iter().zip(&mut none) {
                let (system, its, rss) = outcome?;
                figures.append(its);
                match topics {
                    0 => *none = rss,
                    n => {
                        let each = (rss - *none) / n as f64;
                        figures.push(TABLE, system, "topics", n as f64, "each_bytes", each);
                    }
                }
            }
        }
        Ok(())
    }

    /// A router with links over which nothing goes, from this process.
    fn links(&self, sizes: &[usize], compare: &Compare, figures: &mut Figures) -> Result<()> {
        let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
        fleet.write_router(dir.path())?;
        let router = SgcRouter::start(&self.program, dir.path())?;
        let none = self.measure("sgc-router", "links", 0, router.process.pid(), figures)?;
        let mut all = Vec::new();
        let mut there = 0;
        for &links in sizes {
            compare.note(&format!("footprint, {links} links"));
            all.push(LinkedOwners::connect(&router.url, &fleet, there..links)?);
            there = links;
            until("every link is up", || Ok(router.links()? == links))?;
            let rss = self.measure("sgc-router", "links", links, router.process.pid(), figures)?;
            let each = (rss - none) / links as f64;
            figures.push(TABLE, "sgc-router", "links", links as f64, "each_bytes", each);
        }
        drop(all);
        Ok(())
    }

    /// A router that knows names.
    fn names(&self, names: usize, figures: &mut Figures) -> Result<()> {
        let (fleet, dir) = (BenchFleet::new()?, tempfile::tempdir()?);
        fleet.write_router(dir.path())?;
        let router = SgcRouter::start(&self.program, dir.path())?;
        let mut owners = LinkedOwners::prepare(&router.url, &fleet, names)?;
        until("every link is up", || Ok(router.links()? == owners.links()))?;
        let before = router.process.resident_bytes() as f64;
        let known = router.routed_names()?;
        owners.advertise_all()?;
        router.until_routed(known + names as u64)?;
        let rss = self.measure("sgc-router", "names", names, router.process.pid(), figures)?;
        if names > 0 {
            let each = (rss - before) / names as f64;
            figures.push(TABLE, "sgc-router", "names", names as f64, "each_bytes", each);
        }
        Ok(())
    }

    /// Waits until it is at rest and measures; its resident memory, bytes.
    fn measure(&self, system: &str, path: &str, at: usize, pid: u32, figures: &mut Figures) -> Result<f64> {
        // A router without names has been watched when it had no links.
        let idle = if at == 0 && path != "names" { IDLE } else { IDLE_WITH_MORE };
        measure((TABLE, system, path, at), pid, if self.is_quick { IDLE_QUICK } else { idle }, figures)
    }
}

/// Pushes what a process costs at rest under this table, system, path and count; its resident memory, bytes.
fn measure(
    (table, system, path, at): (&str, &str, &str, usize),
    pid: u32,
    idle: Duration,
    figures: &mut Figures,
) -> Result<f64> {
    let begun = Instant::now();
    while part_taken(pid, REST_LOOK) > REST_PART {
        if begun.elapsed() > REST_MAX {
            figures.leave_out(&format!("{table}, {system}, {at} {path}"), "it does not come to rest");
            break;
        }
    }
    let part = part_taken(pid, idle);
    let rss = resident_bytes_of(pid).0 as f64;
    let anonymous = status_field_of(pid, "RssAnon")? as f64 * 1024.0;
    let threads = status_field_of(pid, "Threads")? as f64;
    let mut push = |metric, value| figures.push(table, system, path, at as f64, metric, value);
    push("rss_bytes", rss);
    push("anonymous_bytes", anonymous);
    push("threads", threads);
    push("idle_cpu_percent", part * 100.0);
    Ok(rss)
}

/// The part of a core that a process takes for so long, but for threads that end meanwhile.
fn part_taken(pid: u32, time: Duration) -> f64 {
    let (begun, before) = (Instant::now(), thread_seconds_of(pid));
    std::thread::sleep(time);
    let took = begun.elapsed().as_secs_f64();
    let more = |(thread, seconds): (_, f64)| seconds - before.get(&thread).copied().unwrap_or(0.0);
    thread_seconds_of(pid).into_iter().map(more).sum::<f64>() / took
}

/// Publishers at one end and subscribers at the other, which say nothing.
struct Applications {
    /// Publishers that have come the whole way.
    found: Arc<AtomicUsize>,
    _writers: Vec<CycloneWriter>,
    _readers: Vec<CycloneReader>,
    _networks: [CycloneNetwork; 2],
}

impl Applications {
    fn start(place: &Place, topics: usize) -> Result<Self> {
        let networks = [place.application(DOMAINS[0])?, place.application(DOMAINS[1])?];
        let found = Arc::<AtomicUsize>::default();
        let count = found.clone();
        networks[1].discover(Box::new(move |event| match event {
            DiscoveryEvent::Appeared(endpoint)
                if endpoint.kind == EndpointKind::Writer && endpoint.topic.starts_with(&dds_topic(TOPIC)) =>
            {
                count.fetch_add(1, Relaxed);
            }
            _ => {}
        }))?;
        let spec = |n: usize| EndpointSpec {
            topic: dds_topic(&format!("{TOPIC}{n}")),
            type_name: dds_type("std_msgs/msg/ByteMultiArray"),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos::default(),
        };
        let readers = (0..topics).map(|n| networks[1].create_reader(&spec(n), Box::new(|_| ())));
        let readers = readers.collect::<Result<_, _>>()?;
        let writers = (0..topics).map(|n| networks[0].create_writer(&spec(n)));
        let writers = writers.collect::<Result<_, _>>()?;
        Ok(Self { found, _writers: writers, _readers: readers, _networks: networks })
    }
}

/// Others that do the same, if they are here: their process at the robot.
fn bridges(compare: &Compare, idle: Duration, figures: &mut Figures) {
    let systems = compare.systems().iter().filter(|system| system.name().starts_with("zenoh"));
    let measured = abreast(systems, |system| {
        let (name, mut figures) = (system.name(), Figures::default());
        if let Err(error) = without_topics(compare, TABLE, &**system, idle, &mut figures) {
            figures.leave_out(&format!("footprint, {name}"), format!("{error:#}"));
        }
        figures
    });
    measured.into_iter().for_each(|its| figures.append(its));
}

/// Measures the process of a system that was started last, without topics.
pub(crate) fn without_topics(
    compare: &Compare,
    table: &str,
    system: &dyn System,
    idle: Duration,
    figures: &mut Figures,
) -> Result<()> {
    let lab = Lab::new(PathKind::Bare, compare.load())?;
    let running = system.start(&lab, &[])?;
    let (_, process) = running.processes.last().context("a system without a process")?;
    measure((table, &system.name(), "topics", 0), process.pid(), idle, figures)?;
    Ok(())
}

/// Size of a program without what only debuggers read, bytes.
pub(crate) fn stripped_bytes(program: &Path) -> Result<u64> {
    let dir = tempfile::tempdir()?;
    let stripped = dir.path().join("program");
    let status =
        Command::new("strip").arg("-o").arg(&stripped).arg(program).status().context("strip, of binutils")?;
    ensure!(status.success(), "strip: {status}");
    Ok(fs::metadata(&stripped)?.len())
}

/// Waits until it is so, looking rarely enough to be no load.
fn until(what: &str, mut is_so: impl FnMut() -> Result<bool>) -> Result<()> {
    let begun = Instant::now();
    while !is_so()? {
        ensure!(begun.elapsed() < PATIENCE, "never: {what}");
        std::thread::sleep(Duration::from_millis(100));
    }
    Ok(())
}
