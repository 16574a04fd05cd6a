//! A robot's network, the cloud and a desk's network, each a namespace of its own, as in `peers.rs`, with the nodes'
//! configuration in the hands of the test. What is started here is ended here, by its process id.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

use crate::support::{self, Peer, eventually, ip, say};

/// One lab at a time: each fills both processors.
static TURN: Mutex<()> = Mutex::new(());
static LABS: AtomicU32 = AtomicU32::new(0);
/// Lines of each log that are shown when a test fails.
const LOG_LINES: usize = 30;

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

    /// Its ROS domain: the same in both networks if those are apart by themselves.
    fn domain(self, apart: bool) -> &'static str {
        match (apart, self) {
            (true, _) => "0",
            (false, Self::Robot) => "93",
            (false, _) => "94",
        }
    }
}

pub(crate) struct Lab {
    dir: TempDir,
    number: u32,
    /// False where the kernel or the user cannot make namespaces.
    apart: bool,
    nodes: [Option<Child>; 3],
    _turn: MutexGuard<'static, ()>,
}

impl Lab {
    /// A fleet, and a node at each site: the robot's and the desk's with these tables in their configuration.
    pub(crate) fn new(robot: &str, desk: &str) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let number = std::process::id() * 16 % 100_000 + LABS.fetch_add(1, Ordering::Relaxed);
        let dir = tempfile::tempdir().unwrap();
        let mut lab = Self { dir, number, apart: false, nodes: [None, None, None], _turn: turn };
        lab.apart = match lab.make_namespaces() {
            Ok(()) => true,
            Err(why) => {
                say(&format!("NO NETWORK NAMESPACES ({why}): using two ROS domains of this host instead"));
                lab.remove_namespaces();
                false
            }
        };
        for args in [
            &["fleet", "create", "lab"][..],
            &["fleet", "enroll", "robot"],
            &["fleet", "enroll", "cloud", "--router"],
            &["fleet", "enroll", "desk"],
        ] {
            let output = lab.sgc(None, args).output().unwrap();
            assert!(output.status.success(), "{output:?}");
        }
        for (site, tables) in [(Site::Robot, robot), (Site::Cloud, ""), (Site::Desk, desk)] {
            lab.configure(site, tables);
            lab.start(site);
        }
        lab
    }

    /// The tables that share topics with the desk, and those that use them there.
    pub(crate) fn topics(topics: &[&str]) -> (String, String) {
        let share = |t: &&str| format!("[[share]]\ntopic = \"{t}\"\nto = [\"desk\"]\n");
        let uses = |t: &&str| format!("[[use]]\nfrom = \"robot\"\ntopic = \"{t}\"\n");
        (topics.iter().map(share).collect(), topics.iter().map(uses).collect())
    }

    fn make_namespaces(&self) -> Result<(), String> {
        for site in SITES {
            ip(&["netns", "add", &self.namespace(site)])?;
            ip(&["-n", &self.namespace(site), "link", "set", "lo", "up"])?;
        }
        for (net, site) in [(1, Site::Robot), (2, Site::Desk)] {
            let (here, cloud) = (self.namespace(site), self.namespace(Site::Cloud));
            let (near, far) = (format!("sf{}n{net}", self.number), format!("sf{}f{net}", self.number));
            let peer = ["peer", "name", &far, "netns", &cloud];
            ip(&[&["link", "add", &near, "netns", &here, "type", "veth"][..], &peer].concat())?;
            ip(&["-n", &here, "address", "add", &format!("10.92.{net}.2/24"), "dev", &near])?;
            ip(&["-n", &cloud, "address", "add", &format!("10.92.{net}.1/24"), "dev", &far])?;
            ip(&["-n", &here, "link", "set", &near, "up"])?;
            ip(&["-n", &cloud, "link", "set", &far, "up"])?;
        }
        Ok(())
    }

    fn remove_namespaces(&self) {
        for site in SITES {
            let _ = ip(&["netns", "delete", &self.namespace(site)]);
        }
    }

    fn namespace(&self, site: Site) -> String {
        format!("sgcf-{}-{}", self.number, site.name())
    }

    fn cloud_address(&self, from: Site) -> String {
        let port = 20_000 + self.number % 20_000;
        match (self.apart, from) {
            (false, _) => format!("127.0.0.1:{port}"),
            (true, Site::Robot) => format!("10.92.1.1:{port}"),
            (true, Site::Desk) => format!("10.92.2.1:{port}"),
            (true, Site::Cloud) => format!("0.0.0.0:{port}"),
        }
    }

    /// Writes a node's configuration with these tables.
    pub(crate) fn configure(&self, site: Site, tables: &str) {
        let address = self.cloud_address(site);
        let mut text = format!("identity = \"{0}.identity\"\n[admin]\nsocket = \"{0}.sock\"\n", site.name());
        if site == Site::Cloud {
            text += &format!("[router]\nlisten = [\"quic://{address}\"]\n");
        } else {
            let domain = site.domain(self.apart);
            text += &format!("[node]\nrouters = [\"quic://{address}\"]\n");
            text +=
                &format!("[ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n");
        }
        fs::write(self.path(site, "toml"), text + tables).unwrap();
    }

    fn path(&self, site: Site, kind: &str) -> PathBuf {
        self.dir.path().join(format!("{}.{kind}", site.name()))
    }

    /// A command at a site, or on this host where none is given or there are no namespaces.
    fn command(&self, site: Option<Site>, program: &Path) -> Command {
        let namespace = site.filter(|_| self.apart).map(|site| self.namespace(site));
        support::command(namespace.as_deref(), self.dir.path(), program)
    }

    fn sgc(&self, site: Option<Site>, args: &[&str]) -> Command {
        let mut command = self.command(site, Path::new(env!("CARGO_BIN_EXE_sgc")));
        command.args(args);
        command
    }

    pub(crate) fn start(&mut self, site: Site) {
        let log = fs::File::options().create(true).append(true).open(self.path(site, "log")).unwrap();
        let config = self.path(site, "toml");
        let mut command = self.sgc(Some(site), &["run", "--print-ready", "-c", config.to_str().unwrap()]);
        let mut child = command.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        assert!(line.contains("ready"), "{}: {}", site.name(), self.log(site));
        self.nodes[site as usize] = Some(child);
    }

    /// SIGKILL or SIGTERM, and its end.
    pub(crate) fn end(&mut self, site: Site, signal: Signal) {
        let mut child = self.nodes[site as usize].take().unwrap();
        kill_process(Pid::from_child(&child), signal).unwrap();
        eventually("the node ends", || child.try_wait().unwrap().is_some());
    }

    /// A signal to a node that goes on living.
    pub(crate) fn signal(&self, site: Site, signal: Signal) {
        kill_process(Pid::from_child(self.nodes[site as usize].as_ref().unwrap()), signal).unwrap();
    }

    pub(crate) fn pid(&self, site: Site) -> u32 {
        self.nodes[site as usize].as_ref().unwrap().id()
    }

    pub(crate) fn log(&self, site: Site) -> String {
        fs::read_to_string(self.path(site, "log")).unwrap_or_default()
    }

    /// What a node says of itself; null while it does not answer.
    pub(crate) fn status(&self, site: Site) -> Value {
        let socket = self.path(site, "sock");
        let args = ["status", "--json", "--socket", socket.to_str().unwrap()];
        let output = self.sgc(None, &args).output().unwrap();
        serde_json::from_slice(&output.stdout).unwrap_or(Value::Null)
    }

    pub(crate) fn drops(&self, site: Site, kind: &str) -> u64 {
        self.status(site)["drops"][kind].as_u64().unwrap_or(0)
    }

    pub(crate) fn peer(&self, site: Site, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = self.command(Some(site), &Peer::program(vendor));
        command
            .args([role, "--localhost", "--domain", site.domain(self.apart), "--timeout", "3000"])
            .args(args);
        Peer::start(command)
    }

    /// A Python program of `tests/peers/py` at a site; its domain is the first argument.
    pub(crate) fn python(&self, site: Site, program: &str, args: &[&str]) -> Peer {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap();
        let mut command = self.command(Some(site), &root.join(".venv/bin/python"));
        command.arg("-B").arg(root.join("tests/peers/py").join(program));
        command.arg(site.domain(self.apart)).args(args);
        Peer::start(command)
    }

    /// All DDS endpoints of a network, as somebody sees them who takes part in it.
    pub(crate) fn observer(&self, site: Site) -> Observer {
        let mut peer = self.python(site, "observe.py", &[]);
        peer.wait("the observer", |e| e["event"] == "ready");
        Observer(peer)
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for site in SITES {
                let status = self.status(site);
                say(&format!("--- {} ---\n{} {}", site.name(), status["routes"], status["drops"]));
            }
        }
        for child in self.nodes.iter_mut().flatten() {
            let _ = child.kill();
            let _ = child.wait();
        }
        if std::thread::panicking() {
            for site in SITES {
                let log = self.log(site);
                let lines: Vec<_> = log.lines().collect();
                let end = lines[lines.len().saturating_sub(LOG_LINES)..].join("\n");
                say(&format!("--- {} ---\n{end}", site.name()));
            }
        }
        if self.apart {
            self.remove_namespaces();
        }
    }
}

/// Who looks at a network's DDS endpoints.
pub(crate) struct Observer(Peer);

impl Observer {
    /// Kind and topic of each, in order; what belongs to every DDS network left out.
    pub(crate) fn endpoints(&mut self) -> Vec<String> {
        let seen = self.look();
        let all = seen["endpoints"].as_array().unwrap();
        let text = |e: &Value| format!("{} {}", e["kind"].as_str().unwrap(), e["topic"].as_str().unwrap());
        let mut list: Vec<_> = all.iter().map(text).filter(|t| !t.contains("ros_discovery_info")).collect();
        list.sort();
        list
    }

    /// Everything that is known of each.
    pub(crate) fn look(&mut self) -> Value {
        self.0.go();
        self.0.wait("the endpoints", |e| e["event"] == "endpoints")
    }
}

/// What a process has of the system.
#[derive(Debug)]
pub(crate) struct Held {
    pub(crate) resident_kb: u64,
    pub(crate) fds: usize,
    pub(crate) threads: usize,
}

pub(crate) fn held(pid: u32) -> Held {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let number = |key: &str| {
        let line = status.lines().find(|l| l.starts_with(key)).unwrap();
        line.split_whitespace().nth(1).unwrap().parse().unwrap()
    };
    let fds = fs::read_dir(format!("/proc/{pid}/fd")).unwrap().count();
    Held { resident_kb: number("VmRSS:"), fds, threads: number("Threads:") as usize }
}

/// A number from the environment, for longer runs.
pub(crate) fn environment(key: &str, otherwise: u64) -> u64 {
    std::env::var(key).ok().and_then(|v| v.parse().ok()).unwrap_or(otherwise)
}
