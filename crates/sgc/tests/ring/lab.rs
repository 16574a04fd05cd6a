//! The ring as processes: a namespace for each node, a cable for each link, a store of names if wanted, and functions
//! that break them. The lab ends its processes by their process ids and removes its namespaces, also when a test panics.

use std::collections::BTreeSet;
use std::fs;
use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::time::Duration;

use rustix::process::Signal;
use serde_json::Value;
use sgc_testkit::netsim::{Namespace, NetsimError};
use tempfile::TempDir;

use crate::graph::{Edge, End, Fault, Graph, NODES, Node};
use crate::store::Store;
use crate::support::{self, Peer, Running, say_log};

const PORT: u16 = 7447;
/// Namespaces are `PREFIX-PID-NODE`, so that those of a run that was killed can be told and removed.
const PREFIX: &str = "sgcring";
/// Longest time a node may take to answer.
const STATUS_MAX: Duration = Duration::from_secs(2);

pub(crate) struct Lab {
    dir: PathBuf,
    /// Longest life of a peer in seconds, should no test end it.
    peer_life: String,
    _temporary: Option<TempDir>,
    nodes: [Option<Running>; NODES.len()],
    store: Option<Store>,
    /// `None` where the kernel or the user cannot make namespaces.
    namespaces: Option<[Namespace; NODES.len()]>,
}

impl Lab {
    /// A fleet, and all nodes running; the robot shares `topics`. Files go to a directory of their own in `keep`, if
    /// given, and stay there. A store needs namespaces ([`Self::can_be_apart`]).
    pub(crate) fn new(topics: &[&str], keep: Option<PathBuf>, peer_life: Duration, has_store: bool) -> Self {
        let temporary = keep.is_none().then(|| tempfile::tempdir().unwrap());
        let dir = match keep {
            Some(keep) => {
                keep.join(format!("{}{}", std::process::id(), if has_store { "-store" } else { "" }))
            }
            None => temporary.as_ref().unwrap().path().to_owned(),
        };
        fs::create_dir_all(&dir).unwrap();
        support::remove_abandoned(PREFIX);
        let mut lab = Self {
            dir: dir.canonicalize().unwrap(),
            peer_life: peer_life.as_secs().to_string(),
            _temporary: temporary,
            nodes: [const { None }; NODES.len()],
            store: None,
            namespaces: support::namespaces(make_namespaces(), "one host, and no link is cut"),
        };
        if has_store {
            let routers = Node::routers().map(|router| (router, lab.namespace(router).unwrap()));
            lab.store = Some(Store::start(namespace_name("store"), &lab.dir.join("store"), routers));
        }
        let members = NODES
            .map(|node| format!("{}{}", node.name(), if node.is_router() { " --role router" } else { "" }));
        support::enroll(&lab.dir, members.iter().map(String::as_str));
        NODES.into_iter().for_each(|node| lab.write_config(node, topics));
        NODES.into_iter().for_each(|node| lab.start(node));
        lab
    }

    /// Returns `false` where namespaces cannot be made, and says what is not tested then.
    pub(crate) fn can_be_apart() -> bool {
        let made = Namespace::create(namespace_name("try"));
        support::namespaces(made, "a ring with a store is not tested").is_some()
    }

    /// Returns `false` where networks are not separate for lack of namespaces.
    pub(crate) fn is_apart(&self) -> bool {
        self.namespaces.is_some()
    }

    fn namespace(&self, node: Node) -> Option<&Namespace> {
        self.namespaces.as_ref().map(|namespaces| &namespaces[node.0])
    }

    fn write_config(&self, node: Node, topics: &[&str]) {
        let name = node.name();
        let urls: Vec<_> = Edge::touching(node)
            .filter(|edge| edge.end(End::Dialling) == node)
            .map(|edge| format!("\"{}\"", self.url(edge)))
            .collect();
        let mut text = format!(
            "identity = \"{name}.identity\"\n[admin]\nsocket = \"{name}.sock\"\n\
             [node]\nstate = \"{name}.state\"\nrouters = [{}]\n",
            urls.join(", ")
        );
        if node.is_router() {
            text += &format!("[router]\nlisten = [\"quic://{}\"]\n", self.listens_at(node));
            text += &self.store.as_ref().map(Store::config).unwrap_or_default();
        } else {
            let domain = self.domain(node);
            text +=
                &format!("[ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n");
            for topic in topics {
                text += &if node == Node::ROBOT {
                    format!("[[share]]\ntopic = \"{topic}\"\nto = [\"desk\", \"lab\"]\n")
                } else {
                    format!("[[use]]\nfrom = \"robot\"\ntopic = \"{topic}\"\n")
                };
            }
        }
        fs::write(self.path(node, "toml"), text).unwrap();
    }

    fn listens_at(&self, router: Node) -> String {
        if self.is_apart() {
            format!("0.0.0.0:{PORT}")
        } else {
            let base = 20_000 + std::process::id() % 2000 * 8;
            format!("127.0.0.1:{}", base + u32::try_from(router.0).unwrap())
        }
    }

    fn url(&self, edge: Edge) -> String {
        if self.is_apart() {
            format!("quic://{}:{PORT}", address(edge, End::Listening))
        } else {
            format!("quic://{}", self.listens_at(edge.end(End::Listening)))
        }
    }

    /// The ROS domain at a proxy: the same everywhere if networks are apart by themselves.
    fn domain(&self, proxy: Node) -> String {
        if self.is_apart() { "0".to_owned() } else { (85 + proxy.0).to_string() }
    }

    pub(crate) fn path(&self, node: Node, kind: &str) -> PathBuf {
        self.dir.join(format!("{}.{kind}", node.name()))
    }

    fn start(&mut self, node: Node) {
        let mut command = support::sgc(self.namespace(node), &self.dir);
        command.args(["run", "-c"]).arg(self.path(node, "toml"));
        self.nodes[node.0] = Some(Running::start(command, &self.path(node, "log")));
    }

    /// A peer in a proxy's network.
    pub(crate) fn peer(&self, proxy: Node, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = support::command(self.namespace(proxy), &self.dir, &Peer::program(vendor));
        command.args([role, "--localhost", "--domain", &self.domain(proxy), "--timeout", &self.peer_life]);
        command.args(args);
        Peer::start(command)
    }

    pub(crate) fn inflict(&mut self, fault: &Fault) {
        match fault {
            Fault::Cut { edge, ends } => {
                ends.iter().for_each(|end| self.set_interface(*edge, *end, "down"));
            }
            Fault::Kill { router, .. } => {
                self.nodes[router.0].take().unwrap().end(Signal::KILL);
            }
            Fault::Stop { .. } | Fault::Isolate { cut: false, .. } => {
                fault.routers().into_iter().for_each(|router| self.signal(router, Signal::STOP));
            }
            Fault::Isolate { cut: true, .. } => {
                fault.edges().into_iter().for_each(|edge| self.set_interface(edge, End::Dialling, "down"));
            }
            Fault::Store(fault) => {
                self.store.as_mut().unwrap().inflict(fault, self.namespaces.as_ref().unwrap());
            }
        }
    }

    pub(crate) fn mend(&mut self, fault: &Fault) {
        match fault {
            Fault::Cut { edge, ends } => {
                ends.iter().for_each(|end| self.set_interface(*edge, *end, "up"));
            }
            Fault::Kill { router, forgets } => {
                if *forgets {
                    fs::remove_dir_all(self.path(*router, "state")).unwrap();
                }
                self.start(*router);
            }
            Fault::Stop { .. } | Fault::Isolate { cut: false, .. } => {
                fault.routers().into_iter().for_each(|router| self.signal(router, Signal::CONT));
            }
            Fault::Isolate { cut: true, .. } => {
                fault.edges().into_iter().for_each(|edge| self.set_interface(edge, End::Dialling, "up"));
            }
            Fault::Store(fault) => {
                self.store.as_mut().unwrap().mend(fault, self.namespaces.as_ref().unwrap());
            }
        }
    }

    fn set_interface(&self, edge: Edge, end: End, state: &str) {
        let namespace = self.namespace(edge.end(end)).unwrap();
        namespace.ip(&["link", "set", &interface(edge), state]).unwrap();
    }

    fn signal(&self, node: Node, signal: Signal) {
        self.nodes[node.0].as_ref().unwrap().signal(signal);
    }

    /// Returns the nodes that ended by themselves since the last call.
    pub(crate) fn fallen(&mut self) -> Vec<Node> {
        let fallen = |node: &mut Option<Running>| node.as_mut().is_some_and(|n| n.try_end().is_some());
        NODES.into_iter().filter(|node| fallen(&mut self.nodes[node.0])).collect()
    }

    /// Returns a node's status, or null if the node is not running or does not answer.
    pub(crate) fn status(&self, node: Node) -> Value {
        let ask = || -> std::io::Result<Value> {
            let mut stream = UnixStream::connect(self.path(node, "sock"))?;
            stream.set_read_timeout(Some(STATUS_MAX))?;
            stream.write_all(b"status\n")?;
            let mut text = Vec::new();
            stream.read_to_end(&mut text)?;
            Ok(serde_json::from_slice(&text)?)
        };
        ask().unwrap_or(Value::Null)
    }

    /// Returns the part of the ring that is up: no fault takes it down, and **both** ends of each link report it.
    pub(crate) fn told(&self, active: &[Fault]) -> Graph {
        let mut graph = Graph::whole().without(active);
        let runs = |node: Node| !node.is_router() || graph.routers[node.0];
        let statuses = NODES.map(|node| if runs(node) { self.status(node) } else { Value::Null });
        for edge in Edge::all() {
            let (dialling, listening) = (edge.end(End::Dialling), edge.end(End::Listening));
            let links = |node: Node| statuses[node.0]["links"].as_array().cloned().unwrap_or_default();
            let url = self.url(edge);
            let dialled = links(dialling).iter().any(|link| link["url"] == url.as_str());
            // Without namespaces, an accepted link does not tell its origin.
            let remote = format!("{}:", address(edge, End::Dialling));
            let accepted = !self.is_apart()
                || links(listening)
                    .iter()
                    .any(|link| link["remote"].as_str().is_some_and(|r| r.starts_with(&remote)));
            graph.edges[edge.0] &= dialled && accepted;
        }
        graph
    }

    /// Returns the names that the store has, while none of its servers is stopped.
    pub(crate) fn stored_names(&self) -> BTreeSet<String> {
        self.store.as_ref().map(Store::names).unwrap_or_default()
    }

    /// Returns the resident memory of a node in kB, or `None` if it is not running.
    pub(crate) fn resident(&self, node: Node) -> Option<u64> {
        let pid = self.nodes[node.0].as_ref()?.pid();
        let status = fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
        let line = status.lines().find(|line| line.starts_with("VmRSS"))?;
        line.split_whitespace().nth(1)?.parse().ok()
    }

    pub(crate) fn log(&self, node: Node) -> String {
        fs::read_to_string(self.path(node, "log")).unwrap_or_default()
    }

    /// Keeps a text beside the logs.
    pub(crate) fn keep(&self, file: &str, text: &str) {
        fs::write(self.dir.join(file), text).unwrap();
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        self.nodes = [const { None }; NODES.len()];
        if std::thread::panicking() {
            NODES.into_iter().for_each(|node| say_log(node.name(), &self.log(node)));
        }
    }
}

fn make_namespaces() -> Result<[Namespace; NODES.len()], NetsimError> {
    let mut made = Vec::new();
    for node in NODES {
        made.push(Namespace::create(namespace_name(node.name()))?);
    }
    for edge in Edge::all() {
        let interface = interface(edge);
        let [dialling, listening] =
            [End::Dialling, End::Listening].map(|end| format!("{}/24", address(edge, end)));
        let [near, far] = [End::Dialling, End::Listening].map(|end| &made[edge.end(end).0]);
        near.veth((&interface, &[&dialling]), far, (&interface, &[&listening]))?;
    }
    Ok(made.try_into().unwrap())
}

fn namespace_name(place: &str) -> String {
    format!("{PREFIX}-{}-{place}", std::process::id())
}

/// The same at both ends, which are not in one namespace.
fn interface(edge: Edge) -> String {
    format!("edge{}", edge.0)
}

fn address(edge: Edge, end: End) -> String {
    format!("10.92.{}.{}", edge.0, if end == End::Dialling { 2 } else { 1 })
}
