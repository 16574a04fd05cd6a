//! A robot's network, the cloud and a desk's network, each a network namespace with a node in it; both networks reach
//! the cloud and nothing routes between them. DDS stays on the loopback interface of each. Where namespaces cannot be
//! made the lab says so and uses two ROS domains of this host instead. All of it goes with the lab.

#![allow(dead_code, reason = "each test program uses a part")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};
use std::sync::atomic::{AtomicU32, Ordering};

use rustix::process::Signal;
use serde_json::Value;
use sgc_testkit::netsim::{Namespace, NetsimError};
use tempfile::TempDir;

use crate::support::turn::{Turn, TurnKind};
use crate::support::{self, Peer, Running, say, say_log};

static LABS: AtomicU32 = AtomicU32::new(0);

/// The settings of a test program's labs.
#[derive(Clone, Copy)]
pub(crate) struct Plan {
    /// Namespaces are `NAME-PID-LAB-SITE`.
    pub(crate) name: &'static str,
    /// ROS domains of the robot and of the desk where their networks are not apart.
    pub(crate) domains: [&'static str; 2],
    /// Longest life of a peer in seconds, should no test end it.
    pub(crate) peer_life: &'static str,
    /// Whether labs of other tests may run at the same time.
    pub(crate) turn: TurnKind,
}

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
pub(crate) enum Site {
    Robot,
    Cloud,
    Desk,
}

pub(crate) const SITES: [Site; 3] = [Site::Robot, Site::Cloud, Site::Desk];

impl Site {
    pub(crate) fn name(self) -> &'static str {
        ["robot", "cloud", "desk"][self as usize]
    }
}

/// The table that shares a `"topic"`, `"service"` or `"action"` with a node.
pub(crate) fn share(kind: &str, name: &str, to: &str) -> String {
    format!("[[share]]\n{kind} = \"{name}\"\nto = [\"{to}\"]\n")
}

/// The table that uses what a node shares.
pub(crate) fn uses(kind: &str, name: &str, from: &str) -> String {
    format!("[[use]]\nfrom = \"{from}\"\n{kind} = \"{name}\"\n")
}

/// Tables of the robot and of the desk by which the robot shares all these with the desk.
pub(crate) fn robot_to_desk(kind: &str, names: impl IntoIterator<Item: AsRef<str>>) -> [String; 2] {
    let mut tables = [String::new(), String::new()];
    for name in names {
        tables[0] += &share(kind, name.as_ref(), "desk");
        tables[1] += &uses(kind, name.as_ref(), "robot");
    }
    tables
}

pub(crate) struct Lab {
    plan: Plan,
    number: u32,
    dir: TempDir,
    nodes: [Option<Running>; 3],
    /// `None` where the kernel or the user cannot make namespaces.
    namespaces: Option<[Namespace; 3]>,
    _turn: Turn,
}

impl Lab {
    /// A fleet, and a node at each site; the robot shares these topics with the desk.
    pub(crate) fn with_topics(plan: Plan, topics: impl IntoIterator<Item: AsRef<str>>) -> Self {
        Self::new(plan, robot_to_desk("topic", topics))
    }

    /// A fleet, and a node at each site; the robot's and the desk's with these tables in their configuration.
    pub(crate) fn new(plan: Plan, tables: [String; 2]) -> Self {
        let mut lab = Self::silent(plan, tables);
        lab.start_all();
        lab
    }

    /// The same for real ROS 2: the nodes discover as ROS does by default.
    pub(crate) fn real(plan: Plan, tables: [String; 2]) -> Self {
        let mut lab = Self::silent_real(plan, tables);
        lab.start_all();
        lab
    }

    /// The same before the nodes are started.
    pub(crate) fn silent_real(plan: Plan, tables: [String; 2]) -> Self {
        let lab = Self::silent(plan, tables);
        for site in [Site::Robot, Site::Desk] {
            lab.reconfigure(site, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
        }
        lab
    }

    /// A fleet with the configurations of its nodes, before they are started.
    pub(crate) fn silent(plan: Plan, [robot, desk]: [String; 2]) -> Self {
        let number = LABS.fetch_add(1, Ordering::Relaxed);
        let made = make_namespaces(&format!("{}-{}-{number}", plan.name, std::process::id()));
        let namespaces = support::namespaces(made, "using two ROS domains of this host instead");
        // Labs on one host would meet.
        let turn = Turn::take(if namespaces.is_some() { plan.turn } else { TurnKind::Exclusive });
        let dir = tempfile::tempdir().unwrap();
        support::enroll(dir.path(), ["robot", "cloud --role router", "desk"]);
        let lab = Self { plan, number, dir, nodes: [const { None }; 3], namespaces, _turn: turn };
        lab.configure(Site::Robot, &robot);
        lab.configure(Site::Cloud, "");
        lab.configure(Site::Desk, &desk);
        lab
    }

    pub(crate) fn start_all(&mut self) {
        SITES.into_iter().for_each(|site| self.start(site));
    }

    pub(crate) fn start(&mut self, site: Site) {
        self.start_at(site, site);
    }

    /// Starts a node in the network of another.
    pub(crate) fn start_at(&mut self, node: Site, site: Site) {
        self.start_with(node, self.sgc(Some(site), &[]));
    }

    /// Starts a node with variables in its environment.
    pub(crate) fn start_within(&mut self, site: Site, environment: &[(&str, &str)]) {
        let mut command = self.sgc(Some(site), &[]);
        command.envs(environment.iter().copied());
        self.start_with(site, command);
    }

    fn start_with(&mut self, node: Site, mut command: Command) {
        command.args(["run", "-c"]).arg(self.path(node, "toml"));
        self.nodes[node as usize] = Some(Running::start(command, &self.path(node, "log")));
    }

    /// SIGKILL or SIGTERM, and what the node ended with.
    pub(crate) fn end(&mut self, site: Site, signal: Signal) -> ExitStatus {
        self.nodes[site as usize].take().unwrap().end(signal)
    }

    /// SIGKILL, and its end.
    pub(crate) fn kill(&mut self, site: Site) {
        self.end(site, Signal::KILL);
    }

    /// Returns the process of a node.
    pub(crate) fn node(&self, site: Site) -> &Running {
        self.nodes[site as usize].as_ref().unwrap()
    }

    /// Where a site is; none if networks are not apart.
    pub(crate) fn namespace(&self, site: Site) -> Option<&Namespace> {
        self.namespaces.as_ref().map(|namespaces| &namespaces[site as usize])
    }

    /// The ROS domain at a site: the same in both networks if those are apart by themselves.
    pub(crate) fn domain(&self, site: Site) -> &'static str {
        match (&self.namespaces, site) {
            (Some(_), _) => "0",
            (None, Site::Robot) => self.plan.domains[0],
            (None, _) => self.plan.domains[1],
        }
    }

    /// Where the cloud's node is, as seen from a site, and where it listens.
    pub(crate) fn cloud_address(&self, from: Site) -> String {
        let host = match (&self.namespaces, from) {
            (None, _) => "127.0.0.1",
            (Some(_), Site::Robot) => "10.92.1.1",
            (Some(_), Site::Desk) => "10.92.2.1",
            (Some(_), Site::Cloud) => "0.0.0.0",
        };
        format!("{host}:{}", 20_000 + (std::process::id() * 16 + self.number) % 10_000)
    }

    /// Writes a node's configuration with these tables.
    pub(crate) fn configure(&self, site: Site, tables: &str) {
        let (name, address) = (site.name(), self.cloud_address(site));
        let head = format!("identity = \"{name}.identity\"\n[admin]\nsocket = \"{name}.sock\"\n");
        let place = match site {
            Site::Cloud => format!("[router]\nlisten = [\"quic://{address}\"]\n"),
            _ => format!(
                "[node]\nrouters = [\"quic://{address}\"]\n\
                 [ros]\ndomain_id = {}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n",
                self.domain(site)
            ),
        };
        fs::write(self.path(site, "toml"), head + &place + tables).unwrap();
    }

    /// Writes a node's configuration with one text in place of another, which must be in it.
    pub(crate) fn reconfigure(&self, site: Site, from: &str, to: &str) {
        let text = fs::read_to_string(self.path(site, "toml")).unwrap();
        assert!(text.contains(from), "no {from} in {text}");
        fs::write(self.path(site, "toml"), text.replace(from, to)).unwrap();
    }

    pub(crate) fn dir(&self) -> &Path {
        self.dir.path()
    }

    fn path(&self, site: Site, kind: &str) -> PathBuf {
        self.dir().join(format!("{}.{kind}", site.name()))
    }

    /// `sgc` at a site, or on this host where none is given.
    pub(crate) fn sgc(&self, site: Option<Site>, args: &[&str]) -> Command {
        let mut command = support::sgc(site.and_then(|site| self.namespace(site)), self.dir());
        command.args(args);
        command
    }

    pub(crate) fn log(&self, site: Site) -> String {
        fs::read_to_string(self.path(site, "log")).unwrap_or_default()
    }

    /// Returns a node's status, or null while it does not answer.
    pub(crate) fn status(&self, site: Site) -> Value {
        let mut command = self.sgc(None, &["status", "--json", "--socket"]);
        let output = command.arg(self.path(site, "sock")).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or_default()
    }

    /// The text of `sgc why` about a topic at a site.
    pub(crate) fn why(&self, site: Site, topic: &str) -> String {
        self.asked(site, &["why", topic])
    }

    /// The text with which the command line answers from a node.
    pub(crate) fn asked(&self, site: Site, args: &[&str]) -> String {
        let mut command = self.sgc(Some(site), args);
        let output = command.arg("--socket").arg(self.path(site, "sock")).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    }

    /// A peer that keeps to its own network, by loopback alone.
    pub(crate) fn peer(&self, site: Site, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let common = ["--localhost", "--timeout", self.plan.peer_life];
        self.stock_peer(site, vendor, role, &[&common, args].concat())
    }

    /// A peer as its vendor ships it.
    pub(crate) fn stock_peer(&self, site: Site, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = support::command(self.namespace(site), self.dir(), &Peer::program(vendor));
        command.args([role, "--domain", self.domain(site)]).args(args);
        Peer::start(command)
    }

    /// The load generator on a distribution's client library, `"jazzy"` or `"kilted"`, with its arguments.
    pub(crate) fn load(&self, site: Site, distribution: &str, args: &[&str]) -> Peer {
        self.load_within(site, distribution, &[], args)
    }

    /// The same with variables in its environment.
    pub(crate) fn load_within(
        &self,
        site: Site,
        distribution: &str,
        environment: &[(&str, &str)],
        args: &[&str],
    ) -> Peer {
        let library = Peer::program(distribution).join("load.so");
        let mut command = self.ros(site, distribution, "run.py");
        command.arg(library).args(args).envs(environment.iter().copied());
        Peer::start(command)
    }

    /// A program of `tests/peers/ros2` on the `rclpy` of a distribution, with its arguments.
    pub(crate) fn rclpy(&self, site: Site, distribution: &str, program: &str, args: &[&str]) -> Peer {
        let mut command = self.ros(site, distribution, program);
        command.args(args);
        Peer::start(command)
    }

    /// A Python program of `tests/peers/ros2` in the environment of a distribution; its arguments follow.
    pub(crate) fn ros(&self, site: Site, distribution: &str, program: &str) -> Command {
        let python = Peer::program(distribution).join("bin/python");
        let mut command = support::command(self.namespace(site), self.dir(), &python);
        command.arg("-B").arg(support::repository("tests/peers/ros2").join(program));
        // Its logs go there, and nowhere else.
        command.env("HOME", self.dir()).env("ROS_DOMAIN_ID", self.domain(site));
        command
    }

    /// A Python program of `tests/peers/py` at a site.
    pub(crate) fn python(&self, site: Site, program: &str, args: &[&str]) -> Peer {
        let mut command = support::python(self.namespace(site), self.dir(), program);
        command.args(args);
        Peer::start(command)
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        let failed = std::thread::panicking();
        for site in SITES.into_iter().filter(|_| failed) {
            let status = self.status(site);
            say(&format!("--- {}: {} {}", site.name(), status["routes"], status["drops"]));
        }
        self.nodes = [const { None }; 3];
        SITES.into_iter().filter(|_| failed).for_each(|site| say_log(site.name(), &self.log(site)));
    }
}

fn make_namespaces(name: &str) -> Result<[Namespace; 3], NetsimError> {
    let [robot, cloud, desk] = SITES.map(|site| Namespace::create(format!("{name}-{}", site.name())));
    let (robot, cloud, desk) = (robot?, cloud?, desk?);
    robot.veth(("cloud", &["10.92.1.2/24"]), &cloud, ("robot", &["10.92.1.1/24"]))?;
    desk.veth(("cloud", &["10.92.2.2/24"]), &cloud, ("desk", &["10.92.2.1/24"]))?;
    Ok([robot, cloud, desk])
}
