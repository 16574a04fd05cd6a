//! A measurement, not a test: messages between two ROS 2 networks over a robot, a cloud router and a desk, with DDS at
//! both ends and QUIC between. `benchmarks/throughput.md` says how to run it and has results.
//!
//! All nodes run in one process, and the suites take turns, so that disturbances of the machine affect both.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::sync::mpsc::{Receiver, channel};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};

use rand_core::{OsRng, TryRngCore as _};
use sgc_dds::{CycloneNetwork, CycloneReader, CycloneWriter, DdsConfig, DiscoveryRange};
use sgc_node::config::{Config, QosOverride, Recipient, Shaping, ShareConfig, ShareMetadata, UseConfig};
use sgc_node::{RunOptions, run_on};
use sgc_ros::{EndpointSpec, RosNetwork, RosWriter, SampleKind, dds_topic, dds_type};
use sgc_testkit::unused_port;
use sgc_transport::{ListenAddr, Scheme};
use sgc_trust::{EnrollRequest, Fleet, FleetName, Identity, NodeName, Suite};
use sgc_wire::{Class, History, Qos, UnixMillis};
use tokio::sync::oneshot;

/// Bound of all waits, longer than any working case takes.
const PATIENCE: Duration = Duration::from_secs(40);

/// ROS domains of robot and desk.
const DOMAINS: [u32; 2] = [191, 192];

const TOPIC: &str = "/load";
const MESSAGE_BYTES: usize = 1000;

/// Messages that the application may be ahead of those that arrived: fewer than a reader keeps, so that none is lost,
/// and more than the nodes take at once, so that they never idle.
const AHEAD_MAX: u64 = 3000;

/// Rounds of each suite, and the duration of a round.
const ROUNDS: usize = 7;
const ROUND: Duration = Duration::from_secs(4);

/// Messages of a round at low rate, and their interval.
const PINGS: usize = 150;
const PING_EVERY: Duration = Duration::from_millis(10);

fn unix_now() -> UnixMillis {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    UnixMillis(now.as_millis() as u64)
}

fn identity(name: &str, router: bool) -> Arc<Identity> {
    static FLEET: OnceLock<Fleet> = OnceLock::new();
    let fleet = FLEET.get_or_init(|| {
        let name: FleetName = "lab".parse().unwrap();
        Fleet::create(name, unix_now(), &mut OsRng.unwrap_err()).unwrap()
    });
    let mut request = EnrollRequest::new(name.parse::<NodeName>().unwrap(), unix_now());
    request.router = router;
    Arc::new(fleet.issue(&request, &mut OsRng.unwrap_err()).unwrap())
}

fn network(domain: u32, tag: Option<&str>) -> Arc<CycloneNetwork> {
    let tag = tag.map(str::to_owned);
    let config = DdsConfig { domain, discovery: DiscoveryRange::LocalHost, tag, ..DdsConfig::default() };
    Arc::new(CycloneNetwork::open(&config).unwrap())
}

/// A node with its own runtime, as in a process.
struct Node {
    _runtime: tokio::runtime::Runtime,
    stop: Option<oneshot::Sender<()>>,
    ended: Receiver<()>,
    socket: PathBuf,
}

impl Node {
    fn start(config: Config, identity: Arc<Identity>, network: Option<Arc<CycloneNetwork>>) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .thread_name(identity.node_name().to_string())
            .enable_all()
            .build()
            .unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (ready, is_ready) = oneshot::channel();
        let (done, ended) = channel();
        let socket = config.admin_socket.clone().unwrap();
        runtime.spawn(async move {
            let options = RunOptions { ready: Some(ready), ..RunOptions::default() };
            let stopped = async {
                let _ = stopped.await;
            };
            run_on(config, identity, network, options, stopped).await.unwrap();
            let _ = done.send(());
        });
        runtime.block_on(is_ready).unwrap();
        Self { _runtime: runtime, stop: Some(stop), ended, socket }
    }

    fn status(&self) -> serde_json::Value {
        use std::io::Read;
        let mut text = String::new();
        std::os::unix::net::UnixStream::connect(&self.socket).unwrap().read_to_string(&mut text).unwrap();
        serde_json::from_str(&text).unwrap()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.stop.take().unwrap().send(());
        let _ = self.ended.recv_timeout(PATIENCE);
    }
}

/// The path: applications and nodes. Fields drop in this order.
struct Way {
    writer: CycloneWriter,
    arrived: Arc<AtomicU64>,
    times: Receiver<Instant>,
    timing: Arc<AtomicBool>,
    _reader: CycloneReader,
    robot: Node,
    desk: Node,
    _cloud: Node,
}

impl Way {
    fn new(suite: Suite, dir: &Path) -> Self {
        let port = unused_port();
        let config = |name: &str| Config {
            node_name: None,
            identity: "unused".into(),
            routers: vec![format!("quic://127.0.0.1:{port}").parse().unwrap()],
            admin_socket: Some(dir.join(format!("{name}.sock"))),
            state: Some(dir.join(format!("{name}.state"))),
            ..Config::default()
        };
        let addr = ListenAddr::new(Scheme::Quic, ([127, 0, 0, 1], port).into());
        let cloud = Config { routers: vec![], listen: vec![addr], ..config("cloud") };
        let cloud = Node::start(cloud, identity("cloud", true), None);
        let share = ShareConfig {
            dead_man: None,
            interface: Default::default(),
            topic: TOPIC.into(),
            naming: Default::default(),
            type_name: None,
            to: vec![Recipient::Node("desk".parse().unwrap())],
            publish: vec![],
            priority: Class::Default,
            shaping: Shaping::default(),
            qos: QosOverride::default(),
            dedicated: false,
            suite,
            metadata: ShareMetadata::default(),
        };
        let robot = Config { shares: vec![share], ..config("robot") };
        let robot = Node::start(robot, identity("robot", false), Some(network(DOMAINS[0], Some("robot"))));
        let from = UseConfig {
            interface: Default::default(),
            publish: false,
            from: "robot".parse().unwrap(),
            topic: TOPIC.into(),
            naming: Default::default(),
            frame_prefix: None,
            dead_man: None,
            type_name: None,
            priority: None,
            shaping: Shaping::default(),
            qos: QosOverride::default(),
            dedicated: false,
        };
        let desk = Config { uses: vec![from], ..config("desk") };
        let desk = Node::start(desk, identity("desk", false), Some(network(DOMAINS[1], Some("desk"))));

        let spec = EndpointSpec {
            topic: dds_topic(TOPIC),
            type_name: dds_type("std_msgs/msg/ByteMultiArray"),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos { history: History::KeepAll, ..Qos::default() },
        };
        let (arrived, timing) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        let (sender, times) = channel();
        let handler = {
            let (arrived, timing) = (arrived.clone(), timing.clone());
            Box::new(move |sample: sgc_ros::Sample| {
                assert_eq!(sample.payload.len(), MESSAGE_BYTES);
                if timing.load(SeqCst) {
                    let _ = sender.send(Instant::now());
                }
                arrived.fetch_add(1, SeqCst);
            })
        };
        let reader = network(DOMAINS[1], None).create_reader(&spec, handler).unwrap();
        let writer = network(DOMAINS[0], None).create_writer(&spec).unwrap();
        let way = Self { writer, arrived, times, timing, _reader: reader, robot, desk, _cloud: cloud };
        let deadline = Instant::now() + PATIENCE;
        while way.arrived.load(SeqCst) == 0 {
            assert!(Instant::now() < deadline, "nothing arrives");
            way.write();
            std::thread::sleep(Duration::from_millis(50));
        }
        way.settle();
        way
    }

    fn write(&self) {
        let mut payload = vec![7; MESSAGE_BYTES];
        payload[..4].copy_from_slice(&[0, 1, 0, 0]);
        self.writer.write(SampleKind::Write, 1, payload.into()).unwrap();
    }

    /// Waits until no more messages arrive.
    fn settle(&self) {
        let mut before = u64::MAX;
        while before != self.arrived.load(SeqCst) {
            before = self.arrived.load(SeqCst);
            std::thread::sleep(Duration::from_millis(300));
        }
    }

    /// Returns the numbers of messages and signatures so far, at the robot.
    fn published(&self) -> (u64, u64) {
        let status = self.robot.status();
        let route = status["routes"].as_array().unwrap().iter().find(|r| r["topic"] == TOPIC).unwrap();
        (route["messages"].as_u64().unwrap(), route["signatures"].as_u64().unwrap())
    }

    /// Sends at full speed. Returns messages a second.
    fn rate(&self) -> f64 {
        let start = self.arrived.load(SeqCst);
        let (begun, mut said) = (Instant::now(), 0u64);
        let mut moved = begun;
        while begun.elapsed() < ROUND {
            let arrived = self.arrived.load(SeqCst) - start;
            if said < arrived + AHEAD_MAX {
                self.write();
                said += 1;
                moved = Instant::now();
            } else {
                assert!(
                    moved.elapsed() < PATIENCE,
                    "{arrived} of {said} arrive\n{}\n{}",
                    self.robot.status(),
                    self.desk.status()
                );
                // The sleep is short compared to the time of the messages under way.
                std::thread::sleep(Duration::from_micros(500));
            }
        }
        let (arrived, took) = (self.arrived.load(SeqCst) - start, begun.elapsed());
        let deadline = Instant::now() + PATIENCE;
        while self.arrived.load(SeqCst) - start < said {
            assert!(
                Instant::now() < deadline,
                "some are lost\n{}\n{}",
                self.robot.status(),
                self.desk.status()
            );
            std::thread::sleep(Duration::from_millis(1));
        }
        arrived as f64 / took.as_secs_f64()
    }

    /// Sends one message at a time. Returns the microseconds from application to application of each.
    fn delays(&self) -> Vec<f64> {
        self.timing.store(true, SeqCst);
        let delays = (0..PINGS)
            .map(|_| {
                let said = Instant::now();
                self.write();
                let heard = self.times.recv_timeout(PATIENCE).expect("it arrives");
                std::thread::sleep(PING_EVERY);
                heard.duration_since(said).as_secs_f64() * 1e6
            })
            .collect();
        self.timing.store(false, SeqCst);
        delays
    }
}

/// Returns the CPU time of this process's threads so far, by thread and name, microseconds.
fn cpu_times() -> BTreeMap<(u32, String), f64> {
    let mut times = BTreeMap::new();
    for task in std::fs::read_dir("/proc/self/task").unwrap().flatten() {
        let Ok(stat) = std::fs::read_to_string(task.path().join("schedstat")) else { continue };
        let Ok(name) = std::fs::read_to_string(task.path().join("comm")) else { continue };
        let ns: f64 = stat.split(' ').next().and_then(|n| n.parse().ok()).unwrap_or(0.0);
        let id = task.file_name().to_string_lossy().parse().unwrap_or(0);
        times.insert((id, name.trim().to_owned()), ns / 1000.0);
    }
    times
}

/// Returns the busiest threads since `before`, in microseconds a message, and the total of all threads.
fn busiest(before: &BTreeMap<(u32, String), f64>, messages: f64) -> (String, f64) {
    let after = cpu_times();
    let spent = |(thread, t): (&(u32, String), &f64)| {
        ((t - before.get(thread).unwrap_or(&0.0)) / messages, thread.1.clone())
    };
    let mut all: Vec<_> = after.iter().map(spent).collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    let named: Vec<_> = all.iter().take(14).map(|(t, name)| format!("{name} {t:.1}")).collect();
    (named.join(", "), all.iter().map(|(t, _)| t).sum())
}

fn median(all: &mut [f64]) -> f64 {
    all.sort_unstable_by(f64::total_cmp);
    all[all.len() / 2]
}

#[test]
#[ignore = "measures"]
fn with_dds_at_both_ends() {
    let suites = [Suite::Group, Suite::Standard];
    let (mut rates, mut delays, mut costs) = ([vec![], vec![]], [vec![], vec![]], [vec![], vec![]]);
    let mut batches = vec![];
    let mut ratios = vec![];
    let dir = tempfile::tempdir().unwrap();
    for round in 0..ROUNDS {
        // The machine's state may change between the two of a pair, so they swap places.
        for turn in 0..2 {
            let at = (round + turn) % 2;
            let way = Way::new(suites[at], dir.path());
            delays[at].extend(way.delays());
            let (before, cpu) = (way.published(), cpu_times());
            rates[at].push(way.rate());
            let after = way.published();
            let (threads, all) = busiest(&cpu, (after.0 - before.0) as f64);
            costs[at].push(all);
            eprintln!("  {} takes {all:.1} µs of CPU a message: {threads}", suites[at]);
            if after.1 > before.1 {
                batches.push((after.0 - before.0) as f64 / (after.1 - before.1) as f64);
            }
        }
        let (group, standard) = (rates[0][round], rates[1][round]);
        ratios.push(standard / group);
        eprintln!("group {group:.0}/s, standard {standard:.0}/s in batches of {:.1}", batches[round]);
    }
    let [group, standard] = rates.map(|mut all| median(&mut all));
    let [near, far] = delays.map(|mut all| median(&mut all));
    eprintln!(
        "medians: group {group:.0}/s, standard {standard:.0}/s, ratio {:.2} ({:.2} of the rounds), batches of {:.1}",
        standard / group,
        median(&mut ratios),
        median(&mut batches)
    );
    let [group, standard] = costs.map(|mut all| median(&mut all));
    eprintln!("CPU a message: group {group:.1} µs, standard {standard:.1} µs, ratio {:.2}", group / standard);
    eprintln!("one at a time, {MESSAGE_BYTES} bytes: group {near:.0} µs, standard {far:.0} µs");
}
