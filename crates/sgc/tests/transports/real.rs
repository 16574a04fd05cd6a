//! The program and the applications of others, rather than nodes and networks in this process.

use std::thread::sleep;

use sgc_testkit::netsim::Namespace;

use crate::lab::{Lab, Lan, Nat, RANGES, schemes};
use crate::support::{self, Peer, Running, eventually};
use crate::{CALM, can_run, is_long, turn};

/// How many seconds a peer lives at most.
const PEER_LIFE: &str = "180";
/// How many seconds the publisher stays, so that what was lost can be asked for.
const HOLD: &str = "60";

fn run(lab: &Lab, namespace: &Namespace, node: &str) -> Running {
    let mut command = support::sgc(Some(namespace), lab.dir());
    command.args(["run", "-c"]).arg(lab.path(&format!("{node}.toml")));
    Running::start(command, &lab.path(&format!("{node}.log")))
}

fn peer(lab: &Lab, namespace: &Namespace, role: &str, vendor: &str, args: &[&str]) -> Peer {
    let mut command = support::command(Some(namespace), lab.dir(), &Peer::program(vendor));
    command.args([role, "--localhost", "--domain", "0", "--timeout", PEER_LIFE, "--depth", "0"]);
    command.args(args);
    Peer::start(command)
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
        let _cloud = run(&lab, &lab.cloud, "cloud");
        let _robot = run(&lab, &lab.robot, "robot");
        let _desk = run(&lab, &lab.desk, "desk");

        let mut listener = peer(&lab, &lab.desk, "sub", "fastdds", &["--verbose"]);
        let control = ["--wait-go", "--wait-stop", "--hold", HOLD, "--rate", "50", "--verbose"];
        let mut talker = peer(&lab, &lab.robot, "pub", "cyclone", &control);
        talker.wait_matched("a reader");
        listener.wait_matched("a writer");
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
