//! A robot's network, the cloud and a desk's network, each with a node: as in `peers.rs`, with what vendors need.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tempfile::TempDir;

use crate::support::{self, Peer, ip, say};

/// One lab at a time: each fills both processors.
static TURN: Mutex<()> = Mutex::new(());

#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Site {
    Robot,
    Cloud,
    Desk,
}

const SITES: [Site; 3] = [Site::Robot, Site::Cloud, Site::Desk];

impl Site {
    fn name(self) -> &'static str {
        ["robot", "cloud", "desk"][self as usize]
    }

    /// Its ROS domain: the same in both networks if those are apart by themselves.
    pub(crate) fn domain(self, apart: bool) -> &'static str {
        match (apart, self) {
            (true, _) => "0",
            (false, Self::Robot) => "93",
            (false, _) => "94",
        }
    }
}

pub(crate) struct Lab {
    pub(crate) dir: TempDir,
    number: u32,
    /// False where the kernel or the user cannot make namespaces.
    pub(crate) apart: bool,
    nodes: Vec<Child>,
    _turn: MutexGuard<'static, ()>,
}

impl Lab {
    /// A fleet, and a node at each site; the robot shares `topics` with the desk.
    pub(crate) fn new(topics: &[String]) -> Self {
        let mut lab = Self::silent(topics, "");
        lab.start_all();
        lab
    }

    /// The same before the nodes are started. `peer` is a static peer of the robot's node.
    pub(crate) fn silent(topics: &[String], peer: &str) -> Self {
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let dir = tempfile::tempdir().unwrap();
        let number = std::process::id() % 100_000;
        let mut lab = Self { dir, number, apart: false, nodes: Vec::new(), _turn: turn };
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
        for site in SITES {
            let mut config = lab.config(site, topics);
            if site == Site::Robot && !peer.is_empty() {
                config = config.replace("static_peers = []", &format!("static_peers = [\"{peer}\"]"));
            }
            fs::write(lab.path(site, "toml"), config).unwrap();
        }
        lab
    }

    pub(crate) fn start_all(&mut self) {
        SITES.into_iter().for_each(|site| self.start(site));
    }

    fn make_namespaces(&self) -> Result<(), String> {
        for site in SITES {
            ip(&["netns", "add", &self.namespace(site)])?;
            ip(&["-n", &self.namespace(site), "link", "set", "lo", "up"])?;
        }
        self.make_hall()?;
        for (net, site) in [(1, Site::Robot), (2, Site::Desk)] {
            let (here, cloud) = (self.namespace(site), self.namespace(Site::Cloud));
            let (near, far) = (format!("sv{}n{net}", self.number), format!("sv{}f{net}", self.number));
            ip(&[
                "link", "add", &near, "netns", &here, "type", "veth", "peer", "name", &far, "netns", &cloud,
            ])?;
            ip(&["-n", &here, "address", "add", &format!("10.92.{net}.2/24"), "dev", &near])?;
            ip(&["-n", &cloud, "address", "add", &format!("10.92.{net}.1/24"), "dev", &far])?;
            ip(&["-n", &here, "link", "set", &near, "up"])?;
            ip(&["-n", &cloud, "link", "set", &far, "up"])?;
        }
        Ok(())
    }

    /// Another host of the robot's network, on a wire that carries no multicast.
    fn make_hall(&self) -> Result<(), String> {
        let (hall, robot) = (self.hall(), self.namespace(Site::Robot));
        ip(&["netns", "add", &hall])?;
        ip(&["-n", &hall, "link", "set", "lo", "up"])?;
        let (near, far) = (format!("sv{}h", self.number), format!("sv{}r", self.number));
        ip(&["link", "add", &near, "netns", &hall, "type", "veth", "peer", "name", &far, "netns", &robot])?;
        for (at, link, address) in [(&hall, &near, "10.92.3.2/24"), (&robot, &far, "10.92.3.1/24")] {
            ip(&["-n", at, "address", "add", address, "dev", link])?;
            ip(&["-n", at, "link", "set", link, "multicast", "off", "up"])?;
        }
        Ok(())
    }

    fn hall(&self) -> String {
        format!("sgcv-{}-hall", self.number)
    }

    /// A peer as its vendor ships it, shared memory on.
    pub(crate) fn stock_peer(&self, site: Site, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = self.command(Some(site), &Peer::program(vendor));
        command.args([role, "--domain", site.domain(self.apart)]).args(args);
        Peer::start(command)
    }

    /// A peer in the hall, with all that its DDS does by default but shared memory, and what a Cyclone there is configured to.
    pub(crate) fn peer_in_the_hall(&self, vendor: &str, args: &[&str]) -> Peer {
        let mut command = support::command(Some(&self.hall()), self.dir.path(), &Peer::program(vendor));
        // As rmw_cyclonedds makes of ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, ROS_STATIC_PEERS=10.92.3.1.
        command.env(
            "CYCLONEDDS_URI",
            "<CycloneDDS><Domain Id=\"any\"><General><AllowMulticast>false</AllowMulticast></General><Discovery>\
             <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>\
             <Peers><Peer address=\"10.92.3.1\"/><Peer address=\"localhost\"/></Peers></Discovery></Domain></CycloneDDS>",
        );
        command.args(["pub", "--udp-only", "--domain", Site::Robot.domain(true)]).args(args);
        Peer::start(command)
    }

    fn remove_namespaces(&self) {
        let _ = ip(&["netns", "delete", &self.hall()]);
        for site in SITES {
            let _ = ip(&["netns", "delete", &self.namespace(site)]);
        }
    }

    fn namespace(&self, site: Site) -> String {
        format!("sgcv-{}-{}", self.number, site.name())
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

    fn config(&self, site: Site, topics: &[String]) -> String {
        let address = self.cloud_address(site);
        let mut text = format!("identity = \"{0}.identity\"\n[admin]\nsocket = \"{0}.sock\"\n", site.name());
        if site == Site::Cloud {
            return text + &format!("[router]\nlisten = [\"quic://{address}\"]\n");
        }
        let domain = site.domain(self.apart);
        text += &format!("[node]\nrouters = [\"quic://{address}\"]\n");
        text += &format!("[ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n");
        for topic in topics {
            text += &match site {
                Site::Robot => format!("[[share]]\ntopic = \"{topic}\"\nto = [\"desk\"]\n"),
                _ => format!("[[use]]\nfrom = \"robot\"\ntopic = \"{topic}\"\n"),
            };
        }
        text
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

    fn start(&mut self, site: Site) {
        let log = fs::File::create(self.path(site, "log")).unwrap();
        let config = self.path(site, "toml");
        let mut command = self.sgc(Some(site), &["run", "--print-ready", "-c", config.to_str().unwrap()]);
        let mut child = command.stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        self.nodes.push(child);
        assert!(line.contains("ready"), "{}: {}", site.name(), self.log(site));
    }

    pub(crate) fn log(&self, site: Site) -> String {
        fs::read_to_string(self.path(site, "log")).unwrap_or_default()
    }

    pub(crate) fn peer(&self, site: Site, vendor: &str, role: &str, args: &[&str]) -> Peer {
        let mut command = self.command(Some(site), &Peer::program(vendor));
        command.args([role, "--localhost", "--domain", site.domain(self.apart)]).args(args);
        Peer::start(command)
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        for child in &mut self.nodes {
            let _ = child.kill();
            let _ = child.wait();
        }
        if std::thread::panicking() {
            SITES.into_iter().for_each(|s| say(&format!("--- {} ---\n{}", s.name(), self.log(s))));
        }
        if self.apart {
            self.remove_namespaces();
        }
    }
}
