//! Helpers for tests of whole nodes: nodes in this process, each with its own runtime, real QUIC on the loopback
//! interface, and local networks in memory with applications on them.

#![allow(clippy::unwrap_used, dead_code, unreachable_pub)]

use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};

use bytes::Bytes;
use rand_core::{OsRng, TryRngCore as _};
use sgc_node::admin::AdminRequest;
use sgc_node::config::{Config, QosOverride, Recipient, Shaping, ShareConfig, ShareMetadata, UseConfig};
use sgc_node::{ConfigSource, NodeError, OpenNetwork, RunOptions, run_on, run_opening};
use sgc_ros::{EndpointKind, EndpointSpec, RosNetwork, RosWriter, SampleKind, dds_topic, dds_type};
use sgc_testkit::{FakeDomain, FakeReader, FakeRos, FakeWriter};
use sgc_transport::{ListenAddr, Scheme};
use sgc_trust::{EnrollRequest, Fleet, FleetName, Identity, NodeName, Suite};
use sgc_types::TypeStore;
use sgc_wire::{Class, Durability, History, Qos, UnixMillis};
use tokio::sync::oneshot;

/// Bound of all waits, longer than any working case takes.
pub const PATIENCE: Duration = Duration::from_secs(40);

pub fn fleet() -> &'static Fleet {
    static FLEET: OnceLock<Fleet> = OnceLock::new();
    FLEET.get_or_init(|| {
        let name: FleetName = "lab".parse().unwrap();
        Fleet::create(name, unix_now(), &mut OsRng.unwrap_err()).unwrap()
    })
}

pub fn unix_now() -> UnixMillis {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    UnixMillis(now.as_millis() as u64)
}

pub fn identity(name: &str, router: bool) -> Arc<Identity> {
    let mut request = EnrollRequest::new(name.parse::<NodeName>().unwrap(), unix_now());
    request.router = router;
    Arc::new(fleet().issue(&request, &mut OsRng.unwrap_err()).unwrap())
}

/// Future that stops a node.
type StopFuture = std::pin::Pin<Box<dyn Future<Output = ()> + Send>>;

/// A node with its own runtime.
pub struct Node {
    runtime: Option<tokio::runtime::Runtime>,
    stop: Option<oneshot::Sender<()>>,
    ended: Receiver<()>,
    pub addr: Option<SocketAddr>,
    socket: std::path::PathBuf,
    /// Types that the node knows.
    pub types: Arc<TypeStore>,
    /// Configuration that a reload reads.
    config: Arc<Mutex<Config>>,
}

impl Node {
    pub fn start(config: Config, identity: Arc<Identity>, domain: Option<&FakeDomain>) -> Self {
        Self::start_near(config, identity, domain, None)
    }

    /// Starts a node with mDNS on a port of its own.
    pub fn start_near(
        config: Config,
        identity: Arc<Identity>,
        domain: Option<&FakeDomain>,
        mdns_port: Option<u16>,
    ) -> Self {
        let file = Arc::new(Mutex::new(config.clone()));
        let read = file.clone();
        let source: ConfigSource = Arc::new(move || Ok(read.lock().unwrap().clone()));
        let options = RunOptions { source: Some(source), mdns_port, ..RunOptions::default() };
        Self::start_with(config, identity, domain, options, file)
    }

    /// Starts a node with a configuration that `source` reads from the watched `file`.
    pub fn start_watched(
        source: ConfigSource,
        file: &std::path::Path,
        identity: Arc<Identity>,
        domain: &FakeDomain,
    ) -> Self {
        let config = source().unwrap();
        let unused = Arc::new(Mutex::new(config.clone()));
        let options =
            RunOptions { source: Some(source), file: Some(file.to_owned()), ..RunOptions::default() };
        Self::start_with(config, identity, Some(domain), options, unused)
    }

    /// Starts a node without a local network. It joins one at a reload.
    pub fn start_apart(config: Config, identity: Arc<Identity>, domain: &FakeDomain) -> Self {
        let file = Arc::new(Mutex::new(config.clone()));
        let read = file.clone();
        let source: ConfigSource = Arc::new(move || Ok(read.lock().unwrap().clone()));
        let options = RunOptions { source: Some(source), ..RunOptions::default() };
        let domain = domain.clone();
        let open: OpenNetwork<FakeRos> = Arc::new(move |_| Ok((Arc::new(domain.join(true)), None)));
        Self::start_by(config, options, file, |config, options, stopped| {
            run_opening(config, identity, open, options, stopped)
        })
    }

    fn start_with(
        config: Config,
        identity: Arc<Identity>,
        domain: Option<&FakeDomain>,
        options: RunOptions,
        file: Arc<Mutex<Config>>,
    ) -> Self {
        let network = domain.map(|d| Arc::new(d.join(true)));
        Self::start_by(config, options, file, |config, options, stopped| {
            run_on::<FakeRos>(config, identity, network, options, stopped)
        })
    }

    fn start_by<F>(
        config: Config,
        options: RunOptions,
        file: Arc<Mutex<Config>>,
        run: impl FnOnce(Config, RunOptions, StopFuture) -> F,
    ) -> Self
    where
        F: Future<Output = Result<(), NodeError>> + Send + 'static,
    {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (ready, is_ready) = oneshot::channel();
        let (done, ended) = channel();
        let socket = config.admin_socket.clone().unwrap();
        let types = Arc::new(TypeStore::default());
        let options = RunOptions { ready: Some(ready), types: Some(types.clone()), ..options };
        let stopped: StopFuture = Box::pin(async move {
            let _ = stopped.await;
        });
        let running = run(config, options, stopped);
        runtime.spawn(async move {
            running.await.unwrap();
            let _ = done.send(());
        });
        let listening = runtime.block_on(is_ready).unwrap();
        let addr = listening.first().map(|l| l.addr);
        Self { runtime: Some(runtime), stop: Some(stop), ended, addr, socket, types, config: file }
    }

    /// Stops the node like SIGTERM.
    pub fn stop(mut self) {
        let _ = self.stop.take().unwrap().send(());
        self.ended.recv_timeout(PATIENCE).expect("the node stops");
    }

    /// Kills the node like SIGKILL, as far as other nodes can tell.
    pub fn kill(mut self) {
        // The sockets must be closed, as the system does for a killed process.
        self.runtime.take().unwrap().shutdown_timeout(PATIENCE);
    }

    pub fn status(&self) -> serde_json::Value {
        self.ask(&AdminRequest::Status)
    }

    /// Sends a request to the status socket and returns the answer.
    pub fn ask(&self, request: &AdminRequest) -> serde_json::Value {
        use std::io::{Read, Write};
        let mut text = String::new();
        let mut stream = std::os::unix::net::UnixStream::connect(&self.socket).unwrap();
        stream.write_all(request.to_line().as_bytes()).unwrap();
        stream.read_to_string(&mut text).unwrap();
        serde_json::from_str(&text).unwrap()
    }

    /// Sends a request with a lasting answer to the status socket. Returns its first line.
    pub fn begin(&self, request: &AdminRequest) -> serde_json::Value {
        use std::io::{BufRead, BufReader, Write};
        let mut stream = std::os::unix::net::UnixStream::connect(&self.socket).unwrap();
        stream.write_all(request.to_line().as_bytes()).unwrap();
        let mut line = String::new();
        BufReader::new(stream).read_line(&mut line).unwrap();
        serde_json::from_str(&line).unwrap()
    }

    /// Returns the number of drops for this reason.
    pub fn drops(&self, reason: &str) -> u64 {
        self.status()["drops"][reason].as_u64().unwrap_or(0)
    }

    /// Changes the configuration and reloads it. Returns the reported changes.
    pub fn reload(&self, change: impl FnOnce(&mut Config)) -> serde_json::Value {
        change(&mut self.config.lock().unwrap());
        let answer = self.ask(&AdminRequest::Reload);
        assert!(answer["ok"].is_object(), "{answer}");
        answer["ok"].clone()
    }

    /// Returns the ids of linked nodes.
    pub fn peers(&self) -> BTreeSet<String> {
        let status = self.status();
        status["links"].as_array().unwrap().iter().map(|l| l["peer"].as_str().unwrap().to_owned()).collect()
    }

    /// Returns the number of connections that were refused for this reason, in either direction.
    pub fn refused(&self, kind: &str) -> u64 {
        self.status()["refused"][kind].as_u64().unwrap_or(0)
    }

    /// Returns the state of the node's only route.
    pub fn route_state(&self) -> String {
        self.status()["routes"][0]["state"].as_str().unwrap_or_default().to_owned()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

/// Starts logging (`SGC_LOG=debug cargo test …` shows it) and returns a free port for a router.
pub fn begin() -> u16 {
    let filter = tracing_subscriber::EnvFilter::from_env("SGC_LOG");
    let _ = tracing_subscriber::fmt().with_env_filter(filter).with_test_writer().try_init();
    sgc_testkit::unused_port()
}

/// The three nodes of the demo: a robot, a cloud router and an operator's desk, each with its own network.
pub struct Trio {
    pub robot_net: FakeDomain,
    pub desk_net: FakeDomain,
    dir: tempfile::TempDir,
    pub port: u16,
    starts: std::cell::Cell<u32>,
}

impl Trio {
    pub fn new() -> Self {
        let port = begin();
        Self {
            robot_net: FakeDomain::default(),
            desk_net: FakeDomain::default(),
            dir: tempfile::tempdir().unwrap(),
            port,
            starts: std::cell::Cell::new(0),
        }
    }

    pub fn config(&self) -> Config {
        self.starts.set(self.starts.get() + 1);
        Config {
            node_name: None,
            identity: "unused".into(),
            routers: vec![format!("quic://127.0.0.1:{}", self.port).parse().unwrap()],
            listen: vec![],
            ros: None,
            shares: vec![],
            uses: vec![],
            admin_socket: Some(self.dir.path().join(format!("{}.sock", self.starts.get()))),
            state: Some(self.dir.path().join(format!("{}.state", self.starts.get()))),
            ..Config::default()
        }
    }

    pub fn cloud(&self) -> Node {
        self.cloud_with(|_| {})
    }

    pub fn cloud_with(&self, change: impl FnOnce(&mut Config)) -> Node {
        let addr = ListenAddr::new(Scheme::Quic, ([127, 0, 0, 1], self.port).into());
        let mut config = Config { routers: vec![], listen: vec![addr], ..self.config() };
        change(&mut config);
        let node = Node::start(config, identity("cloud", true), None);
        assert_eq!(node.addr.unwrap().port(), self.port);
        node
    }

    pub fn robot(&self, topics: &[&str], to: &str) -> Node {
        self.robot_in(Suite::Group, topics, to)
    }

    pub fn robot_in(&self, suite: Suite, topics: &[&str], to: &str) -> Node {
        let shares = topics
            .iter()
            .map(|topic| {
                let to = vec![Recipient::Node(to.parse().unwrap())];
                ShareConfig { to, suite, ..shared_topic(topic) }
            })
            .collect();
        let config = Config { shares, ..self.config() };
        Node::start(config, identity("robot", false), Some(&self.robot_net))
    }

    pub fn desk(&self, topics: &[&str]) -> Node {
        self.desk_on(topics, &self.desk_net)
    }

    pub fn desk_on(&self, topics: &[&str], net: &FakeDomain) -> Node {
        let uses = topics.iter().map(|topic| used_topic(topic)).collect();
        let config = Config { uses, ..self.config() };
        Node::start(config, identity("desk", false), Some(net))
    }
}

/// Returns a share of a topic with the desk.
pub fn shared_topic(topic: &str) -> ShareConfig {
    ShareConfig {
        dead_man: None,
        interface: Default::default(),
        topic: topic.into(),
        naming: Default::default(),
        type_name: None,
        to: vec![Recipient::Node("desk".parse().unwrap())],
        publish: vec![],
        priority: Class::Default,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
        suite: Suite::Group,
        metadata: ShareMetadata::default(),
    }
}

/// Returns a use of the robot's topic.
pub fn used_topic(topic: &str) -> UseConfig {
    UseConfig {
        interface: Default::default(),
        publish: false,
        from: "robot".parse().unwrap(),
        topic: topic.into(),
        naming: Default::default(),
        frame_prefix: None,
        dead_man: None,
        type_name: None,
        priority: None,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
    }
}

pub fn spec(topic: &str, qos: Qos) -> EndpointSpec {
    EndpointSpec {
        topic: dds_topic(topic),
        type_name: dds_type("std_msgs/msg/String"),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos,
    }
}

pub fn latched() -> Qos {
    Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() }
}

/// A publishing application.
pub struct Talker {
    pub writer: FakeWriter,
    _net: FakeRos,
}

impl Talker {
    pub fn new(domain: &FakeDomain, topic: &str, qos: Qos) -> Self {
        Self::with_spec(domain, &spec(topic, qos))
    }

    pub fn with_spec(domain: &FakeDomain, spec: &EndpointSpec) -> Self {
        let net = domain.join(false);
        Self { writer: net.create_writer(spec).unwrap(), _net: net }
    }

    pub fn say(&self, payload: impl Into<Bytes>) {
        let dated = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
        self.writer.write(SampleKind::Write, dated.as_nanos() as i64, payload.into()).unwrap();
    }

    pub fn wait_for_readers(&self, n: u32) {
        wait(&format!("{n} readers"), || self.writer.matched_readers() == n);
    }
}

/// A subscribing application.
pub struct Listener {
    pub samples: Receiver<Bytes>,
    _reader: FakeReader,
    _net: FakeRos,
}

impl Listener {
    pub fn new(domain: &FakeDomain, topic: &str, qos: Qos) -> Self {
        Self::with_spec(domain, &spec(topic, qos))
    }

    pub fn with_spec(domain: &FakeDomain, spec: &EndpointSpec) -> Self {
        let net = domain.join(false);
        let (sender, samples) = channel();
        let handler = Box::new(move |s: sgc_ros::Sample| drop(sender.send(s.payload)));
        let reader = net.create_reader(spec, handler).unwrap();
        Self { samples, _reader: reader, _net: net }
    }

    pub fn hears(&self, payload: impl Into<Bytes>) {
        let payload = payload.into();
        let heard = self.samples.recv_timeout(PATIENCE).expect("a sample arrives");
        assert!(heard == payload, "{} bytes instead of {}", heard.len(), payload.len());
    }

    /// Checks that nothing has arrived. The caller first waits for a later event.
    pub fn hears_nothing(&self) {
        match self.samples.try_recv() {
            Err(std::sync::mpsc::TryRecvError::Empty) => {}
            other => panic!("heard {other:?}"),
        }
    }

    /// Publishes with `say` until a message arrives.
    pub fn hears_at_last(&self, say: impl Fn(u32)) {
        let deadline = Instant::now() + PATIENCE;
        for n in 0.. {
            say(n);
            match self.samples.recv_timeout(Duration::from_millis(20)) {
                Ok(_) => return,
                Err(RecvTimeoutError::Timeout) => assert!(Instant::now() < deadline, "nothing arrives"),
                Err(error) => panic!("{error}"),
            }
        }
    }

    pub fn drain(&self) -> Vec<Bytes> {
        self.samples.try_iter().collect()
    }
}

pub fn wait(what: &str, until: impl Fn() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !until() {
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

pub fn writers(net: &FakeDomain, topic: &str) -> usize {
    net.count(&dds_topic(topic), EndpointKind::Writer)
}
