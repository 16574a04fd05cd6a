//! The program and the applications of others, rather than nodes and networks in this process.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::process::{Child, Stdio};
use std::sync::Arc;
use std::thread::sleep;

use serde_json::Value;
use sgc_testkit::netsim::Namespace;

use crate::lab::{Lab, Lan, Nat, RANGES, schemes};
use crate::support::{self, Peer, eventually};
use crate::{CALM, can_run, is_long, turn};

/// How many seconds a peer lives at most.
const PEER_LIFE: &str = "180";
/// How many seconds the publisher stays, so that what was lost can be asked for.
const HOLD: &str = "60";

/// `sgc run` until it is dropped.
struct Program {
    child: Child,
}

impl Program {
    fn start(lab: &Lab, namespace: &Arc<Namespace>, node: &str) -> Self {
        let program = std::path::Path::new(env!("CARGO_BIN_EXE_sgc"));
        let mut command = support::command(Some(namespace.name()), lab.dir(), program);
        command.args(["run", "--print-ready", "--until-stdin-closes", "-c"]);
        command.arg(lab.path(&format!("{node}.toml")));
        let log = File::create(lab.path(&format!("{node}.log"))).unwrap();
        let child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log).spawn().unwrap();
        let mut program = Self { child };
        let mut line = String::new();
        BufReader::new(program.child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let log = std::fs::read_to_string(lab.path(&format!("{node}.log"))).unwrap();
        assert!(line.contains("ready"), "{node}: {log}");
        program
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn peer(lab: &Lab, namespace: &Arc<Namespace>, role: &str, vendor: &str, args: &[&str]) -> Peer {
    let mut command = support::command(Some(namespace.name()), lab.dir(), &Peer::program(vendor));
    command.args([role, "--localhost", "--domain", "0", "--timeout", PEER_LIFE, "--depth", "0"]);
    Peer::start({
        command.args(args);
        command
    })
}

/// Both ends behind NATs, one of which forgets; in the short run over the first transport alone.
#[test]
fn programs_of_others_lose_nothing_when_a_nat_forgets() {
    if !can_run() {
        return;
    }
    let _turn = turn();
    let schemes = schemes();
    let schemes = if is_long() { &schemes[..] } else { &schemes[..1] };
    for scheme in schemes {
        let lab = Lab::new(Lan::Cable, Nat::RandomPort(RANGES[0]));
        for (node, router) in [("cloud", true), ("robot", false), ("desk", false)] {
            lab.enroll(node, router);
        }
        let ros = "[ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n";
        let topic = "topic = \"/chatter\"\n";
        let url = lab.url(scheme);
        lab.router_config();
        lab.write_config("robot", &[&url], &format!("{ros}[[share]]\n{topic}to = [\"desk\"]\n"));
        lab.write_config("desk", &[&url], &format!("{ros}[[use]]\n{topic}from = \"robot\"\n"));
        let _cloud = Program::start(&lab, &lab.cloud, "cloud");
        let _robot = Program::start(&lab, &lab.robot, "robot");
        let _desk = Program::start(&lab, &lab.desk, "desk");

        let mut listener = peer(&lab, &lab.desk, "sub", "fastdds", &["--verbose"]);
        let control = ["--wait-go", "--wait-stop", "--hold", HOLD, "--rate", "50", "--verbose"];
        let mut talker = peer(&lab, &lab.robot, "pub", "cyclone", &control);
        let is_match = |event: &Value| event["event"] == "matched" && event["count"].as_u64() >= Some(1);
        talker.wait("a reader", is_match);
        listener.wait("a writer", is_match);
        talker.go();
        let said = |talker: &Peer| {
            let events = talker.events.try_iter().filter(|(_, event)| event["event"] == "sent");
            events.filter_map(|(_, event)| event["seq"].as_u64()).max()
        };
        let first = listener.wait("the first", |event| event["event"] == "received")["seq"].as_u64().unwrap();
        sleep(CALM);
        lab.rebind(RANGES[1]);
        let mut before = said(&talker).unwrap();
        eventually("more is said", || {
            before = said(&talker).unwrap_or(before).max(before);
            before > first + 50
        });
        let heard = listener.wait("what came after", |event| event["seq"].as_u64() > Some(before));
        sleep(CALM);
        // Stops the sending; the talker stays for what is still asked for.
        talker.go();
        let sent = talker.wait("its end", |event| event["event"] == "all_sent")["sent"].as_u64().unwrap();
        let last = sent - 1;
        assert!(heard["seq"].as_u64() < Some(last), "{sent} are sent");
        listener.wait("the last", |event| event["seq"].as_u64() == Some(last));
        listener.end();
        let summary = listener.summary();
        for what in ["lost", "duplicated", "altered", "reordered"] {
            assert_eq!(summary[what], 0, "{scheme}: {summary}");
        }
        assert_eq!(summary["received"].as_u64(), Some(last - first + 1), "{scheme}: {summary}");
    }
}
