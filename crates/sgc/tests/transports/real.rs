//! The program and the applications of others, rather than nodes and networks in this process.

use std::net::SocketAddr;
use std::thread::sleep;

use rustix::process::Signal;
use serde_json::{Value, json};
use sgc_testkit::netsim::Namespace;

use crate::lab::{Lab, Lan, Nat, RANGES, schemes};
use crate::support::{self, Peer, Running, eventually};
use crate::{CALM, can_run, is_long, shared_turn};

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
    let _turn = shared_turn();
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

/// Two routers tell the robot from which address it comes, and again after its NAT forgot it.
#[test]
fn a_robot_learns_its_nat_from_its_routers() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let second = "10.10.0.2";
    let nats = [(Nat::FullCone, "endpoint_independent"), (Nat::RandomPort(RANGES[0]), "endpoint_dependent")];
    for (nat, mapping) in nats {
        let lab = Lab::new(Lan::Cable, nat);
        lab.cloud.ip(&["address", "add", &format!("{second}/32"), "dev", "lo"]).unwrap();
        let urls = [lab.url("quic"), format!("quic://{second}:7447")];
        for (router, url) in ["cloud", "cloud-2"].into_iter().zip(&urls) {
            lab.enroll(router, true);
            lab.write_config(router, &[], &format!("[router]\nlisten = [\"{url}\"]\n"));
        }
        lab.enroll("robot", false);
        lab.write_config("robot", &urls.each_ref().map(String::as_str), "[ros]\nstatic_peers = []\n");
        let _routers = ["cloud", "cloud-2"].map(|router| run(&lab, &lab.cloud, router));
        let _robot = run(&lab, &lab.robot, "robot");
        let netcheck = |args: &[&str]| {
            let mut command = support::sgc(Some(&lab.robot), lab.dir());
            let output =
                command.args(["netcheck", "-c"]).arg(lab.path("robot.toml")).args(args).output().unwrap();
            assert!(output.status.success(), "{output:?}");
            String::from_utf8(output.stdout).unwrap()
        };
        let found = || serde_json::from_str::<Value>(&netcheck(&["--json"])).unwrap();
        let seen = || {
            let links = found()["links"].as_array().cloned().unwrap();
            let observed = links.iter().filter_map(|link| link["observed"].as_str());
            observed.map(|address| address.parse().unwrap()).collect::<Vec<SocketAddr>>()
        };
        eventually("both routers have told", || seen().len() == 2);
        let found = found();
        assert_eq!((&found["udp"], &found["nat"]), (&json!("passes"), &json!("present")), "{found}");
        assert_eq!(found["mapping"], mapping, "{found}");
        let said = netcheck(&[]);
        assert!(said.contains("NAT: 10.1.0.2 is seen as 10.10.1.2."), "{said}");
        if let Nat::RandomPort(_) = nat {
            assert!(seen().iter().all(|address| (20_000..30_000).contains(&address.port())), "{found}");
            lab.rebind(RANGES[1]);
            eventually("the new ports are told", || {
                seen().iter().all(|address| (30_000..40_000).contains(&address.port()))
            });
        }
    }
}

/// The other node still has the link to the run that was killed. It must not keep the next run from having one.
#[test]
fn node_that_was_killed_has_its_direct_link_again_at_once() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(Lan::Cable, Nat::PortRestricted);
    for (node, router) in [("cloud", true), ("robot", false), ("desk", false)] {
        lab.enroll(node, router);
    }
    let ros = "[ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n";
    let topic = "topic = \"/chatter\"\n";
    let url = lab.url("quic");
    lab.router_config();
    lab.write_config("robot", &[&url], &format!("{ros}[[share]]\n{topic}to = [\"desk\"]\n"));
    lab.write_config("desk", &[&url], &format!("{ros}[[use]]\n{topic}from = \"robot\"\n"));
    let _cloud = run(&lab, &lab.cloud, "cloud");
    let mut nodes = [Some(run(&lab, &lab.robot, "robot")), Some(run(&lab, &lab.desk, "desk"))];
    let _talker = peer(&lab, &lab.robot, "pub", "cyclone", &["--rate", "50", "--verbose"]);
    let mut listener = peer(&lab, &lab.desk, "sub", "fastdds", &["--verbose"]);
    let made = |node: &str| {
        let log = std::fs::read_to_string(lab.path(&format!("{node}.log"))).unwrap();
        log.matches("direct link is up").count()
    };
    eventually("a direct link", || made("robot") == 1 && made("desk") == 1);
    for (n, (node, namespace)) in [("robot", &lab.robot), ("desk", &lab.desk)].into_iter().enumerate() {
        nodes[n].take().unwrap().end(Signal::KILL);
        nodes[n] = Some(run(&lab, namespace, node));
        eventually("a direct link to the next run", || made("robot") == n + 2 && made("desk") == n + 2);
        listener.events.try_iter().for_each(drop);
        listener.wait("a message", |event| event["event"] == "received");
        // Links that end at once would be made again and again.
        sleep(3 * CALM);
        assert_eq!((made("robot"), made("desk")), (n + 2, n + 2), "after the restart of {node}");
    }
}

/// A topic of another company by token. Both companies name each other for direct links, and then one does no more.
#[test]
fn partners_have_a_direct_link_if_both_name_each_other() {
    if !can_run() {
        return;
    }
    let _turn = shared_turn();
    let lab = Lab::new(Lan::Cable, Nat::PortRestricted);
    lab.enroll("cloud", true);
    lab.enroll("robot", false);
    lab.enroll_partner("acme", "desk");
    let url = lab.url("quic");
    let ros = "[ros]\ndomain_id = 0\ndiscovery_range = \"localhost\"\nstatic_peers = []\n";
    let partner = |name: &str| {
        format!(
            "direct = [\"partner:{name}\"]\n{ros}[[partner]]\nname = \"{name}\"\nca = \"{name}-ca.pem\"\n"
        )
    };
    lab.write_config(
        "cloud",
        &[],
        "trust = [\"acme-ca.pem\"]\n[router]\nlisten = [\"quic://0.0.0.0:7447\"]\n",
    );
    lab.write_config(
        "robot",
        &[&url],
        &format!("{}[[share]]\ntopic = \"/chatter\"\nto = [\"partner:acme\"]\n", partner("acme")),
    );
    lab.write_config("desk", &[&url], &partner("lab"));
    let _cloud = run(&lab, &lab.cloud, "cloud");
    let _robot = run(&lab, &lab.robot, "robot");
    let _desk = run(&lab, &lab.desk, "desk");
    let command = |namespace: &Namespace, args: &[&str]| {
        let output = support::sgc(Some(namespace), lab.dir()).args(args).output().unwrap();
        assert!(output.status.success(), "{args:?}: {output:?}");
        String::from_utf8(output.stdout).unwrap()
    };
    let type_name = ["--type", "std_msgs/msg/String"];
    let create =
        ["token", "share", "create", "-c", "robot.toml", "--topic", "/chatter", "--to", "acme-ca.pem"];
    let token = command(&lab.robot, &[&create[..], &type_name, &["--valid", "1d", "--via", &url]].concat());
    std::fs::write(lab.path("chatter.token"), token).unwrap();
    command(&lab.desk, &["token", "use", "chatter.token", "-c", "desk.toml"]);
    let _talker = peer(&lab, &lab.robot, "pub", "cyclone", &["--rate", "50", "--verbose"]);
    let mut listener = peer(&lab, &lab.desk, "sub", "fastdds", &["--verbose"]);
    listener.wait("a message", |event| event["event"] == "received");
    let direct = |node: &str, namespace: &Namespace| {
        let status = command(namespace, &["status", "--json", "-c", &format!("{node}.toml")]);
        let status: Value = serde_json::from_str(&status).unwrap();
        status["links"].as_array().unwrap().iter().filter(|link| link["direct"] == true).count()
    };
    eventually("a direct link", || direct("robot", &lab.robot) > 0 && direct("desk", &lab.desk) > 0);
    let file = lab.path("desk.toml");
    let config = std::fs::read_to_string(&file).unwrap();
    std::fs::write(&file, config.replace("direct = [\"partner:lab\"]\n", "")).unwrap();
    command(&lab.desk, &["reload", "-c", "desk.toml"]);
    eventually("it ends", || direct("robot", &lab.robot) == 0 && direct("desk", &lab.desk) == 0);
    listener.events.try_iter().for_each(drop);
    listener.wait("a message over the router", |event| event["event"] == "received");
}
