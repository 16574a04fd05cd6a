//! A topic that is shared with another fleet by token: whole nodes over real QUIC, with local networks in memory.

#![allow(clippy::unwrap_used)]

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_core::{OsRng, TryRngCore as _};
use sgc_node::config::{
    Config, QosOverride, Recipient, Shaping, ShareConfig, ShareMetadata, TokenConfig, TokenSource,
};
use sgc_node::graph::Graph;
use sgc_node::partners::{TokenRecord, TokenRecords};
use sgc_node::{RunOptions, create_state_dir, run_on};
use sgc_ros::{EndpointSpec, RosNetwork, RosWriter, Sample, SampleKind, dds_topic, dds_type};
use sgc_testkit::{FakeDomain, FakeRos};
use sgc_transport::{ListenAddr, Scheme};
use sgc_trust::{EnrollRequest, Fleet, Identity, ShareToken, Suite, TopicSecret};
use sgc_wire::{Class, Metadata, Qos, RefuseReason, UnixMillis};
use tokio::sync::oneshot;

const PATIENCE: Duration = Duration::from_secs(40);
const TOPIC: &str = "/handoff/pose";
const TYPE: &str = "std_msgs/msg/String";

fn unix_now() -> UnixMillis {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap();
    UnixMillis(now.as_millis() as u64)
}

fn fleet(name: &str) -> Fleet {
    Fleet::create(name.parse().unwrap(), unix_now(), &mut OsRng.unwrap_err()).unwrap()
}

fn identity(fleet: &mut Fleet, name: &str, router: bool) -> Arc<Identity> {
    let mut request = EnrollRequest::new(name.parse().unwrap(), unix_now());
    request.router = router;
    Arc::new(fleet.enroll(&request, &mut OsRng.unwrap_err()).unwrap())
}

fn pem(fleet: &Fleet) -> String {
    let base64 = STANDARD.encode(fleet.ca_certificate());
    format!("-----BEGIN CERTIFICATE-----\n{base64}\n-----END CERTIFICATE-----\n")
}

struct Node {
    runtime: Option<tokio::runtime::Runtime>,
    _stop: oneshot::Sender<()>,
    listens: Vec<ListenAddr>,
}

impl Node {
    fn start(config: Config, identity: Arc<Identity>, domain: Option<&FakeDomain>) -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let (stop, stopped) = oneshot::channel::<()>();
        let (ready, is_ready) = oneshot::channel();
        let network = domain.map(|d| Arc::new(d.join(true)));
        let again = config.clone();
        runtime.spawn(async move {
            let source: sgc_node::ConfigSource = Arc::new(move || Ok(again.clone()));
            let options = RunOptions { ready: Some(ready), source: Some(source), ..RunOptions::default() };
            let stopped = async {
                let _ = stopped.await;
            };
            run_on::<FakeRos>(config, identity, network, options, stopped).await.unwrap();
        });
        let listens = runtime.block_on(is_ready).unwrap();
        Self { runtime: Some(runtime), _stop: stop, listens }
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_background();
        }
    }
}

fn spec() -> EndpointSpec {
    let (topic, type_name) = (dds_topic(TOPIC), dds_type(TYPE));
    EndpointSpec {
        topic,
        type_name,
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos: Qos::default(),
    }
}

fn ask(socket: &Path, request: &str) -> String {
    use std::io::{Read, Write};
    let mut stream = UnixStream::connect(socket).unwrap();
    stream.write_all(format!("sgc/1 {request}\n").as_bytes()).unwrap();
    let mut text = String::new();
    stream.read_to_string(&mut text).unwrap();
    text
}

/// Publishes until something arrives, or until nothing has for long enough that `ends` says so.
fn wait(what: &str, mut until: impl FnMut() -> bool) {
    let deadline = Instant::now() + PATIENCE;
    while !until() {
        assert!(Instant::now() < deadline, "never: {what}");
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn audit_of(state: &Path) -> String {
    std::fs::read_to_string(state.join("audit.jsonl")).unwrap_or_default()
}

#[test]
fn a_partner_gets_the_topic_of_its_token_until_it_is_withdrawn() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| -> PathBuf { dir.path().join(name) };
    let (mut lab, mut acme) = (fleet("lab"), fleet("acme"));
    let robot = identity(&mut lab, "robot", false);
    let cart = identity(&mut acme, "cart", false);
    std::fs::write(at("acme.pem"), pem(&acme)).unwrap();
    let base = |name: &str| Config {
        identity: "unused".into(),
        state: Some(at(&format!("{name}-state"))),
        admin_socket: Some(at(&format!("{name}.sock"))),
        ..Config::default()
    };
    // The router of the owner's fleet accepts nodes of the partner.
    let addr = ListenAddr::new(Scheme::Quic, ([127, 0, 0, 1], 0).into());
    let config = Config { listen: vec![addr], trust: vec![at("acme.pem")], ..base("cloud") };
    let cloud = Node::start(config, identity(&mut lab, "cloud", true), None);
    let url = format!("quic://{}", cloud.listens[0].addr);

    let share = ShareConfig {
        dead_man: None,
        interface: Default::default(),
        topic: TOPIC.into(),
        naming: Default::default(),
        type_name: Some(TYPE.into()),
        to: vec![Recipient::Node("desk".parse().unwrap())],
        publish: vec![],
        priority: Class::Default,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
        suite: Suite::DEFAULT,
        metadata: ShareMetadata::default(),
    };
    let robot_net = FakeDomain::default();
    let config = Config { routers: vec![url.parse().unwrap()], shares: vec![share], ..base("robot") };
    let _robot = Node::start(config, robot.clone(), Some(&robot_net));

    let metadata = Metadata::topic("robot", TOPIC, TYPE);
    let token = ShareToken {
        owner: robot.node_id(),
        owner_name: "robot".parse().unwrap(),
        ca: lab.ca_certificate().clone(),
        secret: TopicSecret::derive(robot.fleet_secret().unwrap(), &metadata),
        metadata,
        // The partner knows only the router that the token names.
        routers: vec![url],
        expires: UnixMillis(unix_now().0 + 3_600_000),
    };
    let talkers = robot_net.join(false);
    let talker = talkers.create_writer(&spec()).unwrap();
    // The owner is running and has not heard of the partner.
    let state = at("robot-state");
    create_state_dir(&state).unwrap();
    let record = TokenRecord {
        id: 0,
        topic: TOPIC.into(),
        type_name: TYPE.into(),
        name: token.name().to_string(),
        ca: String::new(),
        ca_pem: pem(&acme),
        node: None,
        created: unix_now().0,
        expires: token.expires.0,
    };
    let id = TokenRecords::change(&state, |records| records.add(record, unix_now())).unwrap();
    let said = ask(&at("robot.sock"), "reload");
    assert!(said.contains("who may subscribe changed") && said.contains("another CA may link"), "{said}");
    let cart_net = FakeDomain::default();
    let nowhere = "quic://127.0.0.1:9".parse().unwrap();
    let tokens = vec![TokenConfig {
        source: TokenSource::Text(Box::new(token.clone())),
        naming: Default::default(),
        frame_prefix: None,
        dead_man: None,
        qos: Default::default(),
        dedicated: false,
    }];
    let config = Config { routers: vec![nowhere], tokens, ..base("cart") };
    let _cart = Node::start(config, cart.clone(), Some(&cart_net));

    let listeners = cart_net.join(false);
    let (heard, samples): (_, Receiver<_>) = channel();
    let handler = Box::new(move |sample: Sample| drop(heard.send(sample.payload)));
    let _reader = listeners.create_reader(&spec(), handler).unwrap();

    wait("a message", || {
        talker.write(SampleKind::Write, 1, "x".into()).unwrap();
        samples.try_recv().is_ok()
    });

    TokenRecords::change(&state, |records| records.withdraw(id)).unwrap();
    assert!(ask(&at("robot.sock"), "reload").contains("who may subscribe changed"));
    wait("the end of it", || audit_of(&state).contains("\"cut\""));
    let log = audit_of(&state);
    assert!(log.contains("\"granted\"") && log.contains(&cart.node_id().to_string()), "{log}");
    assert!(!log.contains("sgc-token") && !log.contains(&STANDARD.encode(token.secret.expose())), "{log}");
    // Whoever asks the owner why learns of the cut.
    let mut answer: serde_json::Value = serde_json::from_str(&ask(&at("robot.sock"), "graph")).unwrap();
    let graph: Graph = serde_json::from_value(answer["ok"].take()).unwrap();
    let refused = graph.shares[0].routes[0].refused.get(&cart.node_id().short());
    assert_eq!(refused, Some(&RefuseReason::NotPermitted.to_string()));
    // The partner's writer ends once its node learns that the owner no longer shares, and no message arrives.
    while samples.try_recv().is_ok() {}
    wait("a new epoch", || audit_of(&state).contains("\"epoch\""));
    let came = (0..50).filter(|_| {
        talker.write(SampleKind::Write, 1, "y".into()).unwrap();
        samples.recv_timeout(Duration::from_millis(5)).is_ok_and(|payload| payload == "y")
    });
    assert_eq!(came.count(), 0);
}
