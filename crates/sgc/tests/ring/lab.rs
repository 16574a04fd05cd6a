//! The ring as processes: a namespace for each node, a cable for each link, and ways to break them. What is started
//! here is ended here, by its process id, and namespaces go with the lab, also when a test panics.

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use crate::graph::{Edge, End, Fault, Graph, NODES, Node};
use crate::support::{self, Peer, ip, say};

const PORT: u16 = 7447;
/// Namespaces are `PREFIX-PID-NODE`, so that those of a run that was killed can be told and removed.
const PREFIX: &str = "sgcring";
/// How long a node may take to answer what it is asked.
const STATUS_MAX: Duration = Duration::from_secs(2);
/// Lines of each log that are shown when a test fails.
const LOG_LINES: usize = 40;

pub(crate) struct Lab {
    dir: PathBuf,
    /// How many seconds a peer lives at most, should nobody end it.
    peer_life: String,
    _temporary: Option<TempDir>,
    /// False where the kernel or the user cannot make namespaces.
    pub(crate) apart: bool,
    nodes: [Option<Child>; NODES.len()],
}

impl Lab {
    /// A fleet, and all nodes running; the robot shares `topics`. Files go to a directory of their own in `keep`, if
    /// given, and stay there.
    pub(crate) fn new(topics: &[&str], keep: Option<PathBuf>, peer_life: Duration) -> Self {
        let temporary = keep.is_none().then(|| tempfile::tempdir().unwrap());
        let dir = match keep {
            Some(keep) => keep.join(std::process::id().to_string()),
            None => temporary.as_ref().unwrap().path().to_owned(),
        };
        fs::create_dir_all(&dir).unwrap();
        let mut lab = Self {
            dir: dir.canonicalize().unwrap(),
            peer_life: peer_life.as_secs().to_string(),
            _temporary: temporary,
            apart: false,
            nodes: [const { None }; NODES.len()],
        };
        remove_abandoned();
        lab.apart = match lab.make_namespaces() {
            Ok(()) => true,
            Err(why) => {
                say(&format!("NO NETWORK NAMESPACES ({why}): one host, and no link is cut"));
                lab.remove_namespaces();
                false
            }
        };
        lab.good(&["fleet", "create", "lab"]);
        for node in NODES {
            let enroll = ["fleet", "enroll", node.name(), "--router"];
            lab.good(&enroll[..if node.is_router() { 4 } else { 3 }]);
            lab.write_config(node, topics);
        }
        NODES.into_iter().for_each(|node| lab.start(node));
        lab
    }

    fn make_namespaces(&self) -> Result<(), String> {
        for node in NODES {
            ip(&["netns", "add", &namespace(node)])?;
            ip(&["-n", &namespace(node), "link", "set", "lo", "up"])?;
        }
        for edge in Edge::all() {
            let [dialling, listening] =
                [End::Dialling, End::Listening].map(|end| (namespace(edge.end(end)), interface(edge, end)));
            ip(&[
                "link",
                "add",
                &dialling.1,
                "netns",
                &dialling.0,
                "type",
                "veth",
                "peer",
                "name",
                &listening.1,
                "netns",
                &listening.0,
            ])?;
            for (end, (namespace, interface)) in [(End::Dialling, dialling), (End::Listening, listening)] {
                let address = format!("{}/24", address(edge, end));
                ip(&["-n", &namespace, "address", "add", &address, "dev", &interface])?;
                ip(&["-n", &namespace, "link", "set", &interface, "up"])?;
            }
        }
        Ok(())
    }

    fn remove_namespaces(&self) {
        for node in NODES {
            let _ = ip(&["netns", "delete", &namespace(node)]);
        }
    }

    fn write_config(&self, node: Node, topics: &[&str]) {
        let name = node.name();
        let urls: Vec<_> = Edge::of(node)
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
        if self.apart {
            format!("0.0.0.0:{PORT}")
        } else {
            let base = 20_000 + std::process::id() % 2000 * 8;
            format!("127.0.0.1:{}", base + u32::try_from(router.0).unwrap())
        }
    }

    fn url(&self, edge: Edge) -> String {
        if self.apart {
            format!("quic://{}:{PORT}", address(edge, End::Listening))
        } else {
            format!("quic://{}", self.listens_at(edge.end(End::Listening)))
        }
    }

    /// The ROS domain at a proxy: the same everywhere if networks are apart by themselves.
    fn domain(&self, proxy: Node) -> String {
        if self.apart { "0".to_owned() } else { (85 + proxy.0).to_string() }
    }

    pub(crate) fn path(&self, node: Node, kind: &str) -> PathBuf {
        self.dir.join(format!("{}.{kind}", node.name()))
    }

    fn command(&self, node: Option<Node>, program: &Path) -> Command {
        let namespace = node.filter(|_| self.apart).map(namespace);
        support::command(namespace.as_deref(), &self.dir, program)
    }

    fn good(&self, args: &[&str]) {
        let output = self.command(None, sgc()).args(args).output().unwrap();
        assert!(output.status.success(), "{output:?}");
    }

    fn start(&mut self, node: Node) {
        let log = fs::File::options().create(true).append(true).open(self.path(node, "log")).unwrap();
        let mut command = self.command(Some(node), sgc());
        command.args(["run", "--print-ready", "--until-stdin-closes", "-c"]).arg(self.path(node, "toml"));
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let stdout = child.stdout.take().unwrap();
        // Kept before anything can fail, so that it is ended.
        self.nodes[node.0] = Some(child);
        let mut line = String::new();
        BufReader::new(stdout).read_line(&mut line).unwrap();
        assert!(line.contains("ready"), "{node:?}: {}", self.log(node));
    }

    /// A peer in a proxy's network.
    pub(crate) fn peer(&self, proxy: Node, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = self.command(Some(proxy), &Peer::program(vendor));
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
                let mut child = self.nodes[router.0].take().unwrap();
                child.kill().unwrap();
                child.wait().unwrap();
            }
            Fault::Stop { .. } | Fault::Isolate { cut: false, .. } => {
                fault.routers().into_iter().for_each(|router| self.signal(router, Signal::STOP));
            }
            Fault::Isolate { cut: true, .. } => {
                fault.edges().into_iter().for_each(|edge| self.set_interface(edge, End::Dialling, "down"));
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
        }
    }

    fn set_interface(&self, edge: Edge, end: End, state: &str) {
        ip(&["-n", &namespace(edge.end(end)), "link", "set", &interface(edge, end), state]).unwrap();
    }

    fn signal(&self, node: Node, signal: Signal) {
        kill_process(Pid::from_child(self.nodes[node.0].as_ref().unwrap()), signal).unwrap();
    }

    /// Nodes that ended by themselves since they were asked last.
    pub(crate) fn fallen(&mut self) -> Vec<Node> {
        let fallen =
            |child: &mut Option<Child>| child.as_mut().is_some_and(|c| c.try_wait().unwrap().is_some());
        NODES.into_iter().filter(|node| fallen(&mut self.nodes[node.0])).collect()
    }

    /// What a node tells of itself; nothing if it is not running or does not answer.
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

    /// What of the ring is up, as far as no fault takes it and **both** ends of a link say so.
    pub(crate) fn told(&self, active: &[Fault]) -> Graph {
        let mut graph = Graph::whole().without(active);
        let runs = |node: Node| !node.is_router() || graph.routers[node.0];
        let statuses = NODES.map(|node| if runs(node) { self.status(node) } else { Value::Null });
        for edge in Edge::all() {
            let (dialling, listening) = (edge.end(End::Dialling), edge.end(End::Listening));
            let links = |node: Node| statuses[node.0]["links"].as_array().cloned().unwrap_or_default();
            let url = self.url(edge);
            let dialled = links(dialling).iter().any(|link| link["url"] == url.as_str());
            // Without namespaces nothing tells who a link that was accepted is from.
            let remote = format!("{}:", address(edge, End::Dialling));
            let accepted = !self.apart
                || links(listening)
                    .iter()
                    .any(|link| link["remote"].as_str().is_some_and(|r| r.starts_with(&remote)));
            graph.edges[edge.0] &= dialled && accepted;
        }
        graph
    }

    /// Resident memory of a node in kB; nothing if it is not running.
    pub(crate) fn resident(&self, node: Node) -> Option<u64> {
        let pid = self.nodes[node.0].as_ref()?.id();
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
        for child in self.nodes.iter_mut().flatten() {
            let _ = child.kill();
            let _ = child.wait();
        }
        if std::thread::panicking() {
            for node in NODES {
                let log = self.log(node);
                let lines: Vec<_> = log.lines().collect();
                let tail = &lines[lines.len().saturating_sub(LOG_LINES)..];
                say(&format!("--- {node:?}, last of {} lines ---\n{}", lines.len(), tail.join("\n")));
            }
        }
        if self.apart {
            self.remove_namespaces();
        }
    }
}

fn sgc() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_sgc"))
}

fn namespace(node: Node) -> String {
    format!("{PREFIX}-{}-{}", std::process::id(), node.name())
}

/// At most 15 characters, and no other's while it is being moved to its namespace.
fn interface(edge: Edge, end: End) -> String {
    format!("sg{}e{}{}", std::process::id() % 1_000_000, edge.0, if end == End::Dialling { "d" } else { "l" })
}

fn address(edge: Edge, end: End) -> String {
    format!("10.92.{}.{}", edge.0, if end == End::Dialling { 2 } else { 1 })
}

/// Namespaces of runs whose process is gone without having removed them: killed, or ended from the terminal.
fn remove_abandoned() {
    let Ok(output) = Command::new("ip").args(["netns", "list"]).output() else { return };
    for line in String::from_utf8_lossy(&output.stdout).lines() {
        let name = line.split_whitespace().next().unwrap_or_default();
        let pid = name.strip_prefix(PREFIX).and_then(|rest| rest.split('-').nth(1));
        if pid.is_some_and(|pid| pid.parse::<u32>().is_ok() && !Path::new("/proc").join(pid).exists()) {
            let _ = ip(&["netns", "delete", name]);
        }
    }
}
