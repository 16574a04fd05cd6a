//! Routers and nodes as processes that find each other: in a mesh from the command line, and by mDNS between two
//! network namespaces.

#![allow(clippy::unwrap_used)]

mod support;

use std::path::PathBuf;
use std::process::{Command, Stdio};

use rustix::process::Signal;
use serde_json::Value;
use sgc_testkit::netsim::{Namespace, NetsimError};
use support::{Running, eventually, say_log};
use tempfile::TempDir;

/// Two network namespaces joined by a cable.
fn lay_cable() -> Result<[Namespace; 2], NetsimError> {
    let [a, b] = ["a", "b"].map(|end| Namespace::create(format!("sgcf-{}-{end}", std::process::id())));
    let (a, b) = (a?, b?);
    a.veth(("cable", &["10.92.1.1/24"]), &b, ("cable", &["10.92.1.2/24"]))?;
    Ok([a, b])
}

/// A fleet's files, and where its nodes run.
struct Place {
    dir: TempDir,
    cable: Option<[Namespace; 2]>,
}

impl Place {
    fn new(members: &[&str], cable: Option<[Namespace; 2]>) -> Self {
        let dir = tempfile::tempdir().unwrap();
        support::enroll(dir.path(), members.iter().copied());
        Self { dir, cable }
    }

    fn sgc(&self, end: usize, args: &[&str]) -> Command {
        let mut command = support::sgc(self.cable.as_ref().map(|ends| &ends[end]), self.dir.path());
        command.args(args);
        command
    }

    /// Starts a node, and waits until it is up; it ends with this test.
    fn start(&self, end: usize, node: &str, args: &[&str]) -> Running {
        Running::start(self.sgc(end, args), &self.log_file(node))
    }

    fn log_file(&self, node: &str) -> PathBuf {
        self.dir.path().join(format!("{node}.log"))
    }

    fn log(&self, node: &str) -> String {
        std::fs::read_to_string(self.log_file(node)).unwrap_or_default()
    }

    fn status(&self, node: &str) -> Value {
        let socket = self.dir.path().join(format!("sgc/{node}.sock"));
        let mut command = self.sgc(0, &["status", "--json", "--socket", socket.to_str().unwrap()]);
        serde_json::from_slice(&command.output().unwrap().stdout).unwrap_or(Value::Null)
    }

    fn links(&self, node: &str) -> usize {
        self.status(node)["links"].as_array().map_or(0, Vec::len)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        if std::thread::panicking() {
            for entry in std::fs::read_dir(self.dir.path()).unwrap().flatten() {
                let name = entry.file_name().to_string_lossy().into_owned();
                if let Some(node) = name.strip_suffix(".log") {
                    say_log(node, &self.log(node));
                }
            }
        }
    }
}

#[test]
fn routers_join_a_mesh_from_the_command_line() {
    let place = Place::new(&["cloud1 --role router", "cloud2 --role router", "cloud3 --role router"], None);
    let listen = ["--listen", "quic://127.0.0.1:0"];
    let router = |node: &'static str, peers: &[&str]| {
        let identity = format!("{node}.identity");
        let args = [&["router", "--identity", &identity][..], &listen, peers].concat();
        place.start(0, node, &args)
    };
    let first = router("cloud1", &[]);
    let second = router("cloud2", &["--peer", &first.addresses[0]]);
    let _third = router("cloud3", &["--peer", &first.addresses[0], "--peer", &second.addresses[0]]);
    eventually("each is linked to both others", || {
        ["cloud1", "cloud2", "cloud3"].iter().all(|node| place.links(node) == 2)
    });
    let output = place.sgc(0, &["status", "--socket", "sgc/cloud3.sock"]).output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    let shown = text.lines().filter(|line| line.contains("  static  ") && line.contains("  linked"));
    assert_eq!(shown.count(), 2, "{text}");

    let output =
        place.sgc(0, &["router", "--identity", "cloud1.identity", listen[0], listen[1], "--peer", "cloud2"]);
    let output = { output }.stderr(Stdio::piped()).output().unwrap();
    let said = String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() == Some(2) && said.contains("`--peer` is \"cloud2\""), "{said}");
}

#[test]
fn a_router_on_another_machine_is_found_by_mdns_lost_and_found_again() {
    let instead = "mDNS is tested on this host's own interfaces instead";
    let cable = support::namespaces(lay_cable(), instead);
    let (here, there) = if cable.is_some() { (0, 1) } else { (0, 0) };
    let place = Place::new(&["robot", "cloud --role router"], cable);
    let listen = |port: &str| format!("quic://0.0.0.0:{port}");
    let start_cloud = |listen: &str| {
        let args = ["router", "--identity", "cloud.identity", "--announce", "--listen", listen];
        place.start(there, "cloud", &args)
    };
    let cloud = start_cloud(&listen("0"));
    let _robot = place.start(here, "robot", &["run", "--identity", "robot.identity", "--router", "mdns://"]);
    let linked = || place.links("robot") == 1 && place.links("cloud") == 1;
    eventually("it is found", linked);
    if place.cable.is_some() {
        let remote = place.status("robot")["links"][0]["remote"].as_str().unwrap().to_owned();
        assert!(remote.starts_with("10.92.1.2:") || remote.starts_with("[fe80::"), "{remote}");
    }
    // It says goodbye, and comes back at another port.
    cloud.end(Signal::TERM);
    eventually("it is lost", || place.links("robot") == 0);
    let cloud = start_cloud(&listen("0"));
    eventually("it is found again", linked);
    // It dies without a word, and comes back where it was.
    let address = cloud.addresses[0].clone();
    let port = address.rsplit(':').next().unwrap().to_owned();
    cloud.end(Signal::KILL);
    eventually("it is lost again", || place.links("robot") == 0);
    let _cloud = start_cloud(&listen(&port));
    eventually("it is found once more", linked);
    let said = place.log("robot") + &place.log("cloud");
    assert!(!said.contains(" ERROR ") && place.log_file("cloud").exists(), "{said}");
}
