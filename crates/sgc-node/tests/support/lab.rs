//! A fleet on the disk, whose nodes keep identities, state and sockets over restarts, and streams of numbered messages
//! through them.

#![allow(clippy::unwrap_used, dead_code, unreachable_pub)]

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_core::{OsRng, TryRngCore as _};
use sgc_node::LockedFleet;
use sgc_node::audit::{self, AuditRecord};
use sgc_node::config::{Config, QosOverride, Recipient, Shaping, ShareConfig, ShareMetadata, UseConfig};
use sgc_testkit::FakeDomain;
use sgc_transport::{ListenAddr, Scheme};
use sgc_trust::{EnrollRequest, Fleet, Identity, Suite};
use sgc_wire::{Class, History, NodeId, Qos, UnixMillis};

use crate::support::{Listener, Node, PATIENCE, Talker, begin, unix_now, wait};

/// A fleet, its nodes and their networks. Every node dials the router `cloud`.
pub struct Lab {
    pub dir: tempfile::TempDir,
    fleet: PathBuf,
    port: u16,
    nets: Mutex<BTreeMap<String, FakeDomain>>,
}

impl Lab {
    /// Creates a fleet with these nodes and the router `cloud`.
    pub fn new(nodes: &[&str]) -> Self {
        let lab = Self::empty("lab", begin());
        lab.enroll("cloud", |request| request.router = true);
        nodes.iter().for_each(|node| lab.enroll(node, |_| {}));
        lab
    }

    /// Creates a fleet without nodes. Its router listens on this port of the loopback interface.
    pub fn empty(name: &str, port: u16) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let fleet = dir.path().join("lab.fleet");
        // The fleet is a day old, so that its certificates can be, too.
        let made = UnixMillis(unix_now().0 - 86_400_000);
        let new = Fleet::create(name.parse().unwrap(), made, &mut OsRng.unwrap_err()).unwrap();
        write_secret(&fleet, &new.to_text());
        Self { dir, fleet, port, nets: Mutex::default() }
    }

    /// Creates another fleet, whose nodes use the router of this one.
    pub fn beside(&self, name: &str) -> Self {
        Self::empty(name, self.port)
    }

    pub fn path(&self, file: &str) -> PathBuf {
        self.dir.path().join(file)
    }

    pub fn fleet_file(&self) -> PathBuf {
        self.fleet.clone()
    }

    /// Writes the CA certificate to a PEM file. Returns its path and the CA's fingerprint.
    pub fn ca(&self) -> (PathBuf, String) {
        let path = self.path("ca.pem");
        let fleet = sgc_node::read_fleet(&self.fleet).unwrap();
        let base64 = STANDARD.encode(fleet.ca_certificate());
        let text = format!("-----BEGIN CERTIFICATE-----\n{base64}\n-----END CERTIFICATE-----\n");
        fs::write(&path, text).unwrap();
        (path, fleet.anchors().fingerprints().next().unwrap().to_string())
    }

    /// Changes the fleet file, as `sgc fleet` does.
    pub fn with_fleet<T>(&self, change: impl FnOnce(&mut Fleet) -> T) -> T {
        let mut locked = LockedFleet::open(&self.fleet).unwrap();
        let done = change(&mut locked.fleet);
        locked.save().unwrap();
        done
    }

    /// Enrols a node. Its identity file has the path of its configuration.
    pub fn enroll(&self, node: &str, change: impl FnOnce(&mut EnrollRequest)) {
        let mut request = EnrollRequest::new(node.parse().unwrap(), unix_now());
        change(&mut request);
        let identity = self.with_fleet(|fleet| fleet.enroll(&request, &mut OsRng.unwrap_err()).unwrap());
        write_secret(&self.path(&format!("{node}.identity")), &identity.to_text());
    }

    /// Returns the identity in the node's file.
    pub fn identity(&self, node: &str) -> Arc<Identity> {
        Arc::new(sgc_node::load_identity(&self.path(&format!("{node}.identity"))).unwrap())
    }

    pub fn id(&self, node: &str) -> NodeId {
        self.identity(node).node_id()
    }

    /// Revokes a node. Returns the new revocation list.
    pub fn revoke(&self, node: &str) -> Vec<u8> {
        self.with_fleet(|fleet| {
            fleet.revoke(&[node.parse().unwrap()], unix_now()).unwrap();
            fleet.revocation_list(unix_now()).unwrap()
        })
    }

    /// Returns the local network of a node.
    pub fn net(&self, node: &str) -> FakeDomain {
        self.nets.lock().unwrap().entry(node.to_owned()).or_default().clone()
    }

    pub fn state(&self, node: &str) -> PathBuf {
        self.path(&format!("{node}.state"))
    }

    pub fn url(&self) -> String {
        format!("quic://127.0.0.1:{}", self.port)
    }

    pub fn config(&self, node: &str) -> Config {
        Config {
            identity: self.path(&format!("{node}.identity")),
            routers: vec![self.url().parse().unwrap()],
            admin_socket: Some(self.path(&format!("{node}.sock"))),
            state: Some(self.state(node)),
            ..Config::default()
        }
    }

    pub fn start(&self, node: &str, change: impl FnOnce(&mut Config)) -> Node {
        let mut config = self.config(node);
        change(&mut config);
        Node::start(config, self.identity(node), Some(&self.net(node)))
    }

    pub fn cloud(&self) -> Node {
        self.cloud_with(|_| {})
    }

    pub fn cloud_with(&self, change: impl FnOnce(&mut Config)) -> Node {
        let addr = ListenAddr::new(Scheme::Quic, ([127, 0, 0, 1], self.port).into());
        let mut config = Config { routers: vec![], listen: vec![addr], ..self.config("cloud") };
        change(&mut config);
        Node::start(config, self.identity("cloud"), None)
    }

    pub fn talker(&self, node: &str, topic: &str) -> Talker {
        Talker::new(&self.net(node), topic, all())
    }

    pub fn listener(&self, node: &str, topic: &str) -> Listener {
        Listener::new(&self.net(node), topic, all())
    }

    /// Returns the records of a node's audit log.
    pub fn audit(&self, node: &str) -> Vec<AuditRecord> {
        let mut records = Vec::new();
        match audit::read(&self.state(node).join("audit.jsonl"), |record| records.push(record)) {
            Ok(unread) => assert_eq!(unread, audit::Unread::default()),
            Err(error) => assert_eq!(error.kind(), std::io::ErrorKind::NotFound),
        }
        records
    }

    /// Returns the number of the newest epoch that a node has begun.
    pub fn epoch(&self, node: &str) -> u32 {
        self.audit(node).iter().filter(|r| r.event == "epoch").filter_map(|r| r.epoch).max().unwrap_or(1)
    }
}

pub fn write_secret(path: &Path, text: &str) {
    let mut options = fs::OpenOptions::new();
    let mut file = options.write(true).create(true).truncate(true).mode(0o600).open(path).unwrap();
    file.write_all(text.as_bytes()).unwrap();
}

/// Returns a reliable QoS that keeps all messages.
pub fn all() -> Qos {
    Qos { history: History::KeepAll, ..Qos::default() }
}

pub fn nodes(names: &[&str]) -> Vec<Recipient> {
    let recipient = |name: &&str| match *name {
        "*" => Recipient::Everyone,
        name => Recipient::Node(name.parse().unwrap()),
    };
    names.iter().map(recipient).collect()
}

pub fn share(topic: &str, to: &[&str]) -> ShareConfig {
    ShareConfig {
        dead_man: None,
        interface: Default::default(),
        topic: topic.into(),
        naming: Default::default(),
        type_name: None,
        to: nodes(to),
        publish: vec![],
        priority: Class::Default,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
        suite: Suite::DEFAULT,
        metadata: ShareMetadata::default(),
    }
}

pub fn uses(topic: &str) -> UseConfig {
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

/// Publishes 1, 2, 3, … about a thousand times a second until it is ended.
pub struct Stream {
    said: Arc<AtomicU64>,
    end: Sender<()>,
    thread: JoinHandle<Talker>,
}

impl Stream {
    pub fn start(talker: Talker) -> Self {
        Self::start_from(talker, 1)
    }

    pub fn start_from(talker: Talker, first: u64) -> Self {
        let said = Arc::new(AtomicU64::new(first - 1));
        let (end, ended) = channel();
        let count = said.clone();
        let thread = std::thread::spawn(move || {
            for n in first.. {
                talker.say(n.to_string());
                count.store(n, SeqCst);
                if ended.recv_timeout(Duration::from_millis(1)).is_ok() {
                    break;
                }
            }
            talker
        });
        Self { said, end, thread }
    }

    /// Returns the last number.
    pub fn said(&self) -> u64 {
        self.said.load(SeqCst)
    }

    /// Waits until it has published `n` more.
    pub fn more(&self, n: u64) {
        let until = self.said() + n;
        wait("the stream goes on", || self.said() >= until);
    }

    /// Ends the stream. Returns the talker and its last number.
    pub fn end(self) -> (Talker, u64) {
        self.end.send(()).unwrap();
        let talker = self.thread.join().unwrap();
        (talker, self.said.load(SeqCst))
    }
}

/// Publishes 0 until each listener has received it, so that the path exists.
pub fn warm_up(talker: &Talker, listeners: &[&Listener]) {
    for listener in listeners {
        listener.hears_at_last(|_| talker.say("0"));
    }
}

fn number(payload: &[u8]) -> u64 {
    std::str::from_utf8(payload).unwrap().parse().unwrap()
}

/// Returns the numbers that a listener has received so far.
pub fn heard(listener: &Listener) -> Vec<u64> {
    listener.drain().iter().map(|b| number(b)).filter(|n| *n > 0).collect()
}

/// Waits for the rest of a stream up to `last`, and checks that no number is repeated or out of order. Returns the
/// number of missing ones.
pub fn hears_some(listener: &Listener, first: u64, last: u64) -> u64 {
    let (mut next, mut lost) = (first, 0);
    while next <= last {
        let n = number(&listener.samples.recv_timeout(PATIENCE).expect("the last one"));
        if n > 0 {
            assert!(n >= next, "{n} comes after {}", next - 1);
            lost += n - next;
            next = n + 1;
        }
    }
    lost
}

/// Waits for every number from `first` to `last`, each once and in order.
pub fn hears_each(listener: &Listener, first: u64, last: u64) {
    let deadline = Instant::now() + PATIENCE;
    let mut next = first;
    while next <= last {
        let left = deadline.saturating_duration_since(Instant::now());
        let payload = listener.samples.recv_timeout(left);
        let n = number(&payload.unwrap_or_else(|_| panic!("{next} of {last} never comes")));
        if n > 0 {
            assert_eq!(n, next, "one is lost, comes twice or out of order");
            next += 1;
        }
    }
}
