//! Twenty nodes as processes: two routers and eighteen proxies, each in a namespace of its own with a cable to each
//! router. Programs on plain DDS publish and hear two hundred topics.

use std::collections::BTreeMap;
use std::fs;
use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::process::Signal;
use sgc_testkit::netsim::{Namespace, NetsimError};
use tempfile::TempDir;

use crate::flatness::{FIGURES, Sample};
use crate::support::{self, Peer, Running, say_log};

pub(crate) const ROUTERS: usize = 2;
pub(crate) const PROXIES: usize = 18;
pub(crate) const NODES: usize = ROUTERS + PROXIES;
const TOPICS: usize = 200;
/// Every so many topics one has a second subscriber.
const SECOND_EVERY: usize = 5;
/// Proxies from this one on are restarted, and the second router.
const RESTARTED_FROM: usize = 6;
const PORT: u16 = 7447;
/// Address of each node's metrics in its own network.
const METRICS: &str = "127.0.0.1:9464";
/// Namespaces are `PREFIX-PID-NODE`.
const PREFIX: &str = "sgcsoak20";
/// Longest time that a node may take for its metrics.
const METRICS_MAX: Duration = Duration::from_secs(10);

/// A node, by its number: the routers, then the proxies.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) struct Node(pub(crate) usize);

impl Node {
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        (0..NODES).map(Self)
    }

    pub(crate) fn proxy(number: usize) -> Self {
        Self(ROUTERS + number)
    }

    pub(crate) fn is_router(self) -> bool {
        self.0 < ROUTERS
    }

    /// Returns `true` if the node lives from the beginning to the end.
    pub(crate) fn is_steady(self) -> bool {
        if self.is_router() { self.0 == 0 } else { self.0 - ROUTERS < RESTARTED_FROM }
    }

    pub(crate) fn name(self) -> String {
        if self.is_router() { format!("r{}", self.0) } else { format!("p{}", self.0 - ROUTERS) }
    }
}

/// A topic, by its number.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
struct Topic(usize);

impl Topic {
    fn all() -> impl Iterator<Item = Self> {
        (0..TOPICS).map(Self)
    }

    fn name(self) -> String {
        format!("/soak/t{}", self.0)
    }

    fn owner(self) -> Node {
        Node::proxy(self.0 % PROXIES)
    }

    fn users(self) -> Vec<Node> {
        let (owner, round) = (self.0 % PROXIES, self.0 / PROXIES);
        let user = |step: usize| Node::proxy((owner + 1 + step % (PROXIES - 1)) % PROXIES);
        let mut users = vec![user(round)];
        if self.0.is_multiple_of(SECOND_EVERY) {
            users.push(user(round + 7));
        }
        users
    }
}

/// The messages of a topic that a program has heard, as it reports them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Heard {
    pub(crate) received: u64,
    pub(crate) lost: u64,
    pub(crate) doubled: u64,
    pub(crate) late: u64,
    pub(crate) altered: u64,
}

/// A topic at one of its subscribers.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Flow {
    topic: Topic,
    user: Node,
}

impl Flow {
    /// Returns `true` if neither end is restarted.
    pub(crate) fn is_steady(&self) -> bool {
        self.topic.owner().is_steady() && self.user.is_steady()
    }

    pub(crate) fn name(&self) -> String {
        format!("{} from {} at {}", self.topic.name(), self.topic.owner().name(), self.user.name())
    }
}

/// A process of a node, and how far its log was read.
struct Process {
    running: Running,
    age: usize,
    logged: u64,
    /// Processor time at the last sample, in seconds.
    cpu: f64,
}

pub(crate) struct Lab {
    dir: PathBuf,
    _temporary: Option<TempDir>,
    processes: Vec<Option<Process>>,
    /// The routers that each proxy dials, in order.
    dials: Vec<Vec<usize>>,
    peers: Vec<Peer>,
    /// Processor time of processes that have ended, in seconds.
    cpu_of_ended: f64,
    /// Dropped last.
    namespaces: Vec<Namespace>,
}

impl Lab {
    /// A fleet, all nodes running, and a program beside each proxy. Returns `None` where namespaces cannot be made.
    /// Files go to `keep` and stay there, if given.
    pub(crate) fn new(keep: Option<PathBuf>, period: Duration, fill: u32, life: Duration) -> Option<Self> {
        support::remove_abandoned(PREFIX);
        let namespaces = support::namespaces(make_namespaces(), "there is no soak")?;
        let temporary = keep.is_none().then(|| tempfile::tempdir().unwrap());
        let dir = keep.unwrap_or_else(|| temporary.as_ref().unwrap().path().to_owned());
        fs::create_dir_all(&dir).unwrap();
        let mut lab = Self {
            dir: dir.canonicalize().unwrap(),
            _temporary: temporary,
            processes: Node::all().map(|_| None).collect(),
            dials: (0..PROXIES).map(|proxy| vec![proxy % ROUTERS, (proxy + 1) % ROUTERS]).collect(),
            peers: Vec::new(),
            cpu_of_ended: 0.0,
            namespaces,
        };
        let role = |node: Node| if node.is_router() { " --role router" } else { "" };
        let members: Vec<_> = Node::all().map(|node| node.name() + role(node)).collect();
        support::enroll(&lab.dir, members.iter().map(String::as_str));
        for node in Node::all() {
            lab.write_config(node);
            lab.start(node);
        }
        lab.peers = (0..PROXIES).map(|proxy| lab.peer(Node::proxy(proxy), period, fill, life)).collect();
        for peer in &mut lab.peers {
            peer.wait("the program is ready", |event| event["event"] == "ready");
        }
        Some(lab)
    }

    fn peer(&self, proxy: Node, period: Duration, fill: u32, life: Duration) -> Peer {
        let names = |is_of: &dyn Fn(Topic) -> bool| {
            Topic::all().filter(|topic| is_of(*topic)).map(Topic::name).collect::<Vec<_>>().join(",")
        };
        let mut command = support::python(Some(self.namespace(proxy)), &self.dir, "soak.py");
        command.args(["--publish", &names(&|topic| topic.owner() == proxy)]);
        command.args(["--hear", &names(&|topic| topic.users().contains(&proxy))]);
        command.args(["--period", &period.as_secs_f64().to_string()]);
        command.args(["--fill", &fill.to_string()]);
        command.args(["--timeout", &life.as_secs().to_string()]);
        Peer::start(command)
    }

    fn namespace(&self, node: Node) -> &Namespace {
        &self.namespaces[node.0]
    }

    pub(crate) fn path(&self, node: Node, kind: &str) -> PathBuf {
        self.dir.join(format!("{}.{kind}", node.name()))
    }

    pub(crate) fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes the configuration of a node as a whole file in place of the old one, so that a running node never reads half.
    fn write_config(&self, node: Node) {
        let name = node.name();
        let dials: &[usize] = match node {
            Node(0) => &[],
            node if node.is_router() => &[0],
            proxy => &self.dials[proxy.0 - ROUTERS],
        };
        let urls: Vec<_> =
            dials.iter().map(|router| format!("\"quic://{}:{PORT}\"", address(*router, node))).collect();
        let mut text = format!(
            "identity = \"{name}.identity\"\n[admin]\nsocket = \"{name}.sock\"\n[metrics]\nlisten = \"{METRICS}\"\n\
             [node]\nstate = \"{name}.state\"\nrouters = [{}]\n",
            urls.join(", ")
        );
        if node.is_router() {
            text += &format!("[router]\nlisten = [\"quic://0.0.0.0:{PORT}\"]\n");
        } else {
            text += "[ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n";
        }
        for topic in Topic::all() {
            let (users, name) = (topic.users(), topic.name());
            if topic.owner() == node {
                let to: Vec<_> = users.iter().map(|user| format!("\"{}\"", user.name())).collect();
                text += &format!("[[share]]\ntopic = \"{name}\"\nto = [{}]\n", to.join(", "));
            } else if users.contains(&node) {
                text += &format!("[[use]]\nfrom = \"{}\"\ntopic = \"{name}\"\n", topic.owner().name());
            }
        }
        let new = self.path(node, "toml.new");
        fs::write(&new, text).unwrap();
        fs::rename(new, self.path(node, "toml")).unwrap();
    }

    fn start(&mut self, node: Node) {
        let mut command = match std::env::var_os("SGC_SOAK_PROGRAM") {
            Some(program) => support::command(Some(self.namespace(node)), &self.dir, Path::new(&program)),
            None => support::sgc(Some(self.namespace(node)), &self.dir),
        };
        command.env("SGC_ALLOW_CORE_DUMPS", "1").args(["run", "-c"]).arg(self.path(node, "toml"));
        let logged = fs::metadata(self.path(node, "log")).map_or(0, |log| log.len());
        let running = Running::start(command, &self.path(node, "log"));
        self.processes[node.0] = Some(Process { running, age: 0, logged, cpu: 0.0 });
    }

    /// Kills a node, and starts it again.
    pub(crate) fn restart(&mut self, node: Node) {
        let process = self.processes[node.0].take().unwrap();
        self.cpu_of_ended += process.cpu;
        process.running.end(Signal::KILL);
        self.start(node);
    }

    /// Gives a proxy other routers, which the running node reads by itself.
    pub(crate) fn set_routers(&mut self, proxy: Node, dials: Vec<usize>) {
        self.dials[proxy.0 - ROUTERS] = dials;
        self.write_config(proxy);
    }

    /// Samples a node, which must run.
    pub(crate) fn sample(&mut self, node: Node, round: usize) -> Sample {
        let log = fs::metadata(self.path(node, "log")).unwrap().len();
        let series = self.metrics(node).lines().filter(|line| !line.starts_with('#')).count();
        let name = node.name();
        let process = self.processes[node.0].as_mut().unwrap();
        if let Some(ended) = process.running.try_end() {
            say_log(&name, &fs::read_to_string(self.dir.join(format!("{name}.log"))).unwrap());
            panic!("{name} ended by itself: {ended}");
        }
        let pid = process.running.pid();
        process.cpu = processor_seconds(pid);
        let held = process.running.held();
        let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        let anonymous = status.lines().find_map(|line| line.strip_prefix("RssAnon:")).unwrap();
        let anonymous = anonymous.split_whitespace().next().unwrap().parse().unwrap();
        let figures: [u64; FIGURES.len()] = [
            held.resident_kb,
            anonymous,
            held.fds as u64,
            held.threads as u64,
            series as u64,
            log - process.logged,
        ];
        let sample = Sample { round, age: process.age, figures };
        process.logged = log;
        process.age += 1;
        sample
    }

    /// Returns the processor time that all nodes have used, in seconds.
    pub(crate) fn processor_seconds(&self) -> f64 {
        self.cpu_of_ended + self.processes.iter().flatten().map(|process| process.cpu).sum::<f64>()
    }

    fn metrics(&self, node: Node) -> String {
        let ask = || -> std::io::Result<String> {
            let mut stream = TcpStream::connect(METRICS)?;
            stream.set_read_timeout(Some(METRICS_MAX))?;
            write!(stream, "GET /metrics HTTP/1.1\r\nHost: {METRICS}\r\nConnection: close\r\n\r\n")?;
            let mut text = String::new();
            stream.read_to_string(&mut text)?;
            Ok(text)
        };
        let text = self.namespace(node).within(ask).unwrap();
        let text = text.unwrap_or_else(|error| panic!("metrics of {}: {error}", node.name()));
        let (head, body) = text.split_once("\r\n\r\n").unwrap();
        assert!(head.starts_with("HTTP/1.1 200"), "{}: {head}", node.name());
        body.to_owned()
    }

    /// Asks all programs for their counts so far.
    pub(crate) fn heard(&mut self) -> BTreeMap<Flow, Heard> {
        self.peers.iter_mut().for_each(|peer| peer.tell("report"));
        let mut flows = BTreeMap::new();
        for (proxy, peer) in self.peers.iter_mut().enumerate() {
            let user = Node::proxy(proxy);
            let said = peer.wait("a report", |event| event["event"] == "flows");
            for topic in Topic::all().filter(|topic| topic.users().contains(&user)) {
                let of_topic = &said["heard"][topic.name()];
                let count = |key: &str| of_topic[key].as_u64().unwrap_or_else(|| panic!("{key}: {said}"));
                let heard = Heard {
                    received: count("received"),
                    lost: count("lost"),
                    doubled: count("doubled"),
                    late: count("late"),
                    altered: count("altered"),
                };
                flows.insert(Flow { topic, user }, heard);
            }
        }
        flows
    }

    pub(crate) fn log(&self, node: Node) -> String {
        fs::read_to_string(self.path(node, "log")).unwrap_or_default()
    }
}

/// Returns the processor time of a process, in seconds.
fn processor_seconds(pid: u32) -> f64 {
    let stat = fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    // The name of the program, in parentheses, may have spaces.
    let fields: Vec<_> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    let ticks = |index: usize| fields[index].parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / rustix::param::clock_ticks_per_second() as f64
}

fn make_namespaces() -> Result<Vec<Namespace>, NetsimError> {
    let made = Node::all()
        .map(|node| Namespace::create(format!("{PREFIX}-{}-{}", std::process::id(), node.name())))
        .collect::<Result<Vec<_>, _>>()?;
    for router in 0..ROUTERS {
        for node in Node::all().skip(router + 1) {
            let (near, far) = (format!("to-r{router}"), format!("to-{}", node.name()));
            let [ours, theirs] =
                [format!("{}/24", dialling(router, node)), format!("{}/24", address(router, node))];
            made[node.0].veth((&near, &[&ours]), &made[router], (&far, &[&theirs]))?;
        }
    }
    Ok(made)
}

/// The address of a router on its cable to a node.
fn address(router: usize, node: Node) -> String {
    format!("10.{}.{}.1", 92 + router, node.0)
}

/// The address of a node on its cable to a router.
fn dialling(router: usize, node: Node) -> String {
    format!("10.{}.{}.2", 92 + router, node.0)
}

#[test]
fn every_topic_has_other_users_than_its_owner() {
    for topic in Topic::all() {
        let users = topic.users();
        assert!(!users.contains(&topic.owner()) && users.iter().all(|user| !user.is_router()));
        assert!(users.len() == 1 || users[0] != users[1]);
    }
    let steady =
        Topic::all().flat_map(|topic| topic.users().into_iter().map(move |user| Flow { topic, user }));
    assert!(steady.filter(Flow::is_steady).count() >= 10);
}
