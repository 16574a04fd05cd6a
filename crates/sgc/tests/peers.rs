//! Tests between independent programs, Cyclone DDS in Python and Fast DDS in C++, in networks that only an `sgc` router
//! joins (`tests/peers/README.md`).
//!
//! Three network namespaces stand for a robot's network, the cloud and an operator's desk (`support/lab.rs`).

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::fs;
use std::time::{Duration, Instant};

use lab::{Lab, Plan, Site, robot_to_desk};
use rustix::process::Signal;
use serde_json::Value;
use support::turn::TurnKind;
use support::{Peer, eventually, say};

const PLAN: Plan = Plan { name: "sgct", domains: ["91", "92"], peer_life: "120", turn: TurnKind::Shared };
/// The settings of labs in which a test measures.
const EXCLUSIVE: Plan = Plan { turn: TurnKind::Exclusive, ..PLAN };

/// Longest wait of a client for its calls, of which there are some tens.
const CALLS_WAIT: Duration = Duration::from_secs(20);

fn service(kind: &str, server: &str, client: &str) -> String {
    format!("/srv/{kind}_{server}_{client}")
}

impl Lab {
    /// A server or a client, in rmw_cyclonedds' mapping (`tests/peers/README.md`).
    fn service_peer(&self, site: Site, role: &str, args: &[&str]) -> Peer {
        let common = [role, "--localhost", "--domain", self.domain(site), "--timeout", "170"];
        self.python(site, "services.py", &[&common, args].concat())
    }

    /// A server at the robot and a client at the desk: so many calls, each answered rightly. A client that calls as
    /// soon as it is matched may be so alone, and what it sends then is lost (`tests/peers/README.md`): so another may
    /// try.
    fn calls(&self, server: &str, client: &str, kind: &str, extra: &[&str], calls: u64) {
        let what = format!("{kind} at {server} from {client}");
        let name = service(kind, server, client);
        let mut served = match server {
            "cyclone" => self.service_peer(Site::Robot, "server", &["--name", &name]),
            // Cyclone's client calls all at once: a history of ten, as ROS 2 has it, would be overwritten at the
            // server.
            _ => self.peer(
                Site::Robot,
                server,
                "server",
                &["--type", kind, "--topic", &name, "--depth", "100"],
            ),
        };
        served.wait("ready", |e| e["event"] == "ready");
        for _ in 0..2 {
            match self.try_to_call(client, kind, &name, extra, calls) {
                Ok(()) => return,
                Err(summary) => say(&format!("{what}: A CALL WAS LOST, once more: {summary}")),
            }
        }
        self.try_to_call(client, kind, &name, extra, calls).unwrap();
    }

    fn try_to_call(
        &self,
        client: &str,
        kind: &str,
        name: &str,
        extra: &[&str],
        calls: u64,
    ) -> Result<(), Value> {
        let count = calls.to_string();
        if client == "cyclone" {
            let asks = self.service_peer(Site::Desk, "client", &["--name", name, "--count", &count]);
            let mut answered = 0;
            while answered < calls {
                let Ok((_, event)) = asks.events.recv_timeout(CALLS_WAIT) else {
                    return Err(answered.into());
                };
                if event["event"] == "answer" {
                    assert_eq!(event["right"], true, "{event}");
                    answered += 1;
                }
            }
            return Ok(());
        }
        let wait = CALLS_WAIT.as_secs().to_string();
        let ask = ["--type", kind, "--topic", name, "--count", &count, "--rate", "0", "--timeout", &wait];
        let summary = self.peer(Site::Desk, client, "client", &[&ask[..], extra].concat()).summary();
        assert_eq!(summary["wrong"], 0, "{summary}");
        if summary["answered"] == calls { Ok(()) } else { Err(summary) }
    }

    /// A publisher at the robot and a subscriber at the desk, both matched: then `sent` messages, of which all from the
    /// first one heard on must arrive. A reader may be matched a moment before it knows, so that the first few may
    /// be lost without anyone's fault; `wanted` must come.
    fn carries(&self, from: &str, to: &str, kind: &str, extra: &[&str], sent: u32, wanted: u32) {
        let what = format!("{kind} from {from} to {to}");
        let topic = format!("/{kind}");
        let common = ["--type", kind, "--topic", &topic, "--large"];
        let wanted_text = wanted.to_string();
        let listen = [&common[..], &["--count", &wanted_text, "--linger", "0.7"], extra].concat();
        let mut listener = self.peer(Site::Desk, to, "sub", &listen);
        let sent_text = sent.to_string();
        let mut talk = [&common[..], &["--count", &sent_text, "--rate", "20", "--wait-go"], extra].concat();
        if kind == "image" {
            talk.extend(["--size", if extra.contains(&"--timeout") { "13000000" } else { "1000000" }]);
        }
        let mut talker = self.peer(Site::Robot, from, "pub", &talk);
        talker.wait_matched("a match at the robot");
        listener.wait_matched("a match at the desk");
        talker.go();
        let summary = listener.summary();
        let count = |key: &str| summary[key].as_u64().unwrap();
        assert!(count("received") >= wanted.into(), "{what}: {summary}");
        assert_eq!((count("duplicated"), count("altered")), (0, 0), "{what}: {summary}");
        if !extra.contains(&"--best-effort") {
            assert_eq!(count("lost"), 0, "{what}: {summary}");
        }
        talker.summary();
    }
}

#[test]
fn every_vendor_reaches_every_vendor_through_a_router() {
    let lab = Lab::with_topics(PLAN, ["/string", "/image", "/custom"]);
    for from in ["cyclone", "fastdds"] {
        for to in ["cyclone", "fastdds"] {
            lab.carries(from, to, "string", &[], 30, 20);
            lab.carries(from, to, "custom", &[], 30, 20);
            lab.carries(from, to, "image", &[], 15, 8);
        }
    }
    lab.carries("fastdds", "cyclone", "string", &["--best-effort"], 40, 20);
    lab.carries("cyclone", "fastdds", "image", &["--timeout", "90"], 5, 2);
    // The router carried all messages and knows none of them.
    let cloud = lab.status(Site::Cloud);
    assert_eq!(cloud["routes"], Value::Array(vec![]));
    assert!(
        cloud["names"].as_array().unwrap().iter().any(|n| n["bytes"].as_u64() > Some(1_000_000)),
        "{cloud}"
    );
}

/// Fast DDS does not announce how deep its history is. With the specification's single sample the writer on the far
/// side would overwrite each image that its reader has not whole yet.
#[test]
fn a_subscriber_that_stands_still_for_a_moment_gets_what_its_publisher_keeps() {
    const SENT: u64 = 9;
    let lab = Lab::with_topics(PLAN, ["/image"]);
    let common = ["--type", "image", "--topic", "/image", "--verbose"];
    let mut listener = lab.peer(Site::Desk, "fastdds", "sub", &common);
    let sent = SENT.to_string();
    let talk = ["--count", &sent, "--rate", "20", "--size", "1000000", "--wait-go"];
    let mut talker = lab.peer(Site::Robot, "fastdds", "pub", &[&common[..], &talk].concat());
    talker.wait_matched("a match at the robot");
    listener.wait_matched("a match at the desk");
    talker.go();
    listener.wait("the first image", |e| e["event"] == "received");
    listener.signal(Signal::STOP);
    eventually("all images at the desk", || lab.status(Site::Desk)["routes"][0]["messages"] == SENT);
    listener.signal(Signal::CONT);
    listener.wait("the last image", |e| e["event"] == "received" && e["seq"] == SENT - 1);
    listener.end();
    let summary = listener.summary();
    let others = ["lost", "duplicated", "altered", "reordered"].map(|key| summary[key].as_u64());
    assert_eq!(others, [Some(0); 4], "{summary}");
    talker.summary();
}

/// A client and a server of different vendors do not understand each other where Cyclone is one of them, on one
/// network.
#[test]
fn every_vendor_calls_services_of_every_vendor_through_a_router() {
    const VENDORS: [&str; 3] = ["cyclone", "fastdds", "rustdds"];
    let pairs = || VENDORS.into_iter().flat_map(|server| VENDORS.map(|client| (server, client)));
    // A service of its own for each, so that no client meets a server that is on its way out.
    let mut names: Vec<_> = pairs().map(|(server, client)| service("add", server, client)).collect();
    names.push(service("blob", "fastdds", "fastdds"));
    let lab = Lab::new(PLAN, robot_to_desk("service", &names));
    pairs().for_each(|(server, client)| lab.calls(server, client, "add", &[], 30));
    lab.calls("fastdds", "fastdds", "blob", &["--size", "50001"], 10);
}

#[test]
fn late_subscribers_and_a_late_node_get_the_latched_message_once() {
    let mut lab = Lab::with_topics(PLAN, ["/string"]);
    lab.kill(Site::Desk);
    let latched = ["--type", "string", "--topic", "/string", "--transient-local", "--depth", "1"];
    for vendor in ["cyclone", "fastdds"] {
        let publish =
            [&latched[..], &["--count", "4", "--rate", "0", "--wait-matched", "0", "--hold", "100"]].concat();
        let mut talker = lab.peer(Site::Robot, vendor, "pub", &publish);
        talker.wait("all sent", |e| e["event"] == "all_sent");
        lab.start(Site::Desk);
        for listener in ["fastdds", "cyclone"] {
            let listen = [&latched[..], &["--count", "1", "--linger", "1"]].concat();
            let summary = lab.peer(Site::Desk, listener, "sub", &listen).summary();
            let got = ["received", "last", "duplicated", "altered"].map(|key| summary[key].as_u64());
            assert_eq!(got, [Some(1), Some(3), Some(0), Some(0)], "{vendor} to {listener}: {summary}");
        }
        talker.end();
        talker.summary();
        lab.kill(Site::Desk);
        // Until the robot's node knows that this talker is gone, its message is still to be had, and rightly.
        eventually("no publisher at the robot", || {
            lab.status(Site::Robot)["routes"][0]["state"] == "waits for a local publisher"
        });
    }
}

#[test]
fn the_flow_resumes_after_every_kill_and_restart_without_a_duplicate() {
    let mut lab = Lab::with_topics(PLAN, ["/string"]);
    let common = ["--type", "string", "--topic", "/string"];
    let mut listener = lab.peer(Site::Desk, "cyclone", "sub", &[&common[..], &["--verbose"]].concat());
    listener.wait("ready", |e| e["event"] == "ready");
    let publish = [&common[..], &["--rate", "20", "--verbose"]].concat();
    let mut talker = lab.peer(Site::Robot, "fastdds", "pub", &publish);
    listener.wait("the first message", |e| e["event"] == "received");
    let orders: [&[Site]; 5] = [
        &[Site::Robot],
        &[Site::Cloud],
        &[Site::Desk],
        &[Site::Robot, Site::Cloud],
        &[Site::Desk, Site::Cloud, Site::Robot],
    ];
    for order in orders {
        order.iter().for_each(|site| lab.kill(*site));
        order.iter().for_each(|site| lab.start(*site));
        // Only messages sent from now on show that the flow resumed.
        while talker.events.try_recv().is_ok() {}
        let sent = talker.wait("news", |e| e["event"] == "sent")["seq"].as_u64().unwrap();
        listener.wait(&format!("what was sent after {order:?}"), |e| {
            e["event"] == "received" && e["seq"].as_u64() > Some(sent)
        });
    }
    talker.end();
    talker.summary();
    listener.end();
    let summary = listener.summary();
    let count = |key: &str| summary[key].as_u64().unwrap();
    assert_eq!((count("duplicated"), count("altered"), count("reordered")), (0, 0, 0), "{summary}");
}

#[test]
fn a_restarted_program_is_heard_at_its_own_rate_and_a_stopped_node_is_gone_at_once() {
    let mut lab = Lab::with_topics(EXCLUSIVE, ["/string"]);
    let common = ["--type", "string", "--topic", "/string"];
    // Cyclone, because Fast DDS notices the end of a Cyclone writer only when its lease is over, also without us.
    let mut listener = lab.peer(Site::Desk, "cyclone", "sub", &[&common[..], &["--verbose"]].concat());
    listener.wait("ready", |e| e["event"] == "ready");
    for start in ["0", "1000", "2000"] {
        let publish = [&common[..], &["--rate", "50", "--start", start]].concat();
        let mut talker = lab.peer(Site::Robot, "cyclone", "pub", &publish);
        let first: u64 = start.parse().unwrap();
        for n in 1..=20 {
            listener
                .wait("its messages", |e| e["event"] == "received" && e["seq"].as_u64() >= Some(first + n));
        }
        talker.end();
        talker.summary();
    }
    // A talker that is there when the node stops.
    let mut talker = lab.peer(
        Site::Robot,
        "cyclone",
        "pub",
        &[&common[..], &["--rate", "50", "--start", "3000"]].concat(),
    );
    listener.wait("its messages", |e| e["event"] == "received" && e["seq"].as_u64() >= Some(3010));
    let begun = Instant::now();
    let status = lab.end(Site::Robot, Signal::TERM);
    assert!(status.success(), "{status}: {}", lab.log(Site::Robot));
    listener.wait("the end", |e| e["event"] == "matched" && e["count"] == 0);
    assert!(begun.elapsed() < Duration::from_secs(9), "not withdrawn, but lost and held for ten seconds");
    listener.end();
    let summary = listener.summary();
    assert_eq!((&summary["duplicated"], &summary["altered"]), (&0.into(), &0.into()), "{summary}");
    talker.end();
    talker.summary();
}

#[test]
fn another_fleet_and_garbage_are_refused_counted_and_harm_nobody() {
    let lab = Lab::with_topics(PLAN, ["/string"]);
    let resident = || lab.node(Site::Cloud).held().resident_kb;
    lab.carries("cyclone", "fastdds", "string", &[], 20, 10);
    let before = resident();
    for args in [&["fleet", "create", "evil"][..], &["fleet", "enroll", "mallory", "--fleet", "evil.fleet"]] {
        assert!(lab.sgc(None, args).output().unwrap().status.success());
    }
    let url = format!("quic://{}", lab.cloud_address(Site::Desk));
    let args = ["run", "--identity", "mallory.identity", "--router", &url, "--use", "robot:/string"];
    let mut command = lab.sgc(Some(Site::Desk), &args);
    command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF");
    let log = fs::File::create(lab.dir().join("mallory.log")).unwrap();
    let mut mallory = command.stderr(log).spawn().unwrap();
    let refused = |kind: &str| lab.status(Site::Cloud)["refused"][kind].as_u64().unwrap_or(0);
    eventually("the other fleet is counted", || refused("other_ca") > 0);
    assert!(lab.log(Site::Cloud).contains("is refused"), "{}", lab.log(Site::Cloud));
    let told = || fs::read_to_string(lab.dir().join("mallory.log")).unwrap();
    eventually("the other fleet is told", || {
        told().contains("of another fleet") || told().contains("different fleets")
    });
    mallory.kill().unwrap();
    mallory.wait().unwrap();
    // Random datagrams, some of which look like the beginning of a connection.
    let address = lab.cloud_address(Site::Robot);
    let (host, port) = address.split_once(':').unwrap();
    let script = format!(
        "import os,random,socket\nrandom.seed(7)\ns=socket.socket(socket.AF_INET,socket.SOCK_DGRAM)\n\
         for n in range(20000):\n b=random.randbytes(random.choice([1,20,60,1200,1400]))\n\
         \x20if n%3==0: b=bytes([0xc3,0,0,0,1,8])+b\n s.sendto(b,({host:?},{port}))\n"
    );
    let python = support::repository(".venv/bin/python");
    let mut python = support::command(lab.namespace(Site::Robot), lab.dir(), &python);
    assert!(python.args(["-c", &script]).status().unwrap().success());
    lab.carries("fastdds", "cyclone", "string", &[], 20, 10);
    let after = resident();
    assert!(after < before + 30_000, "{before} kB before, {after} kB after");
}

#[test]
fn types_that_do_not_agree_and_topics_that_never_appear_are_named() {
    let [robot, desk] = robot_to_desk("topic", ["/string", "/never"]);
    let desk = desk.replace("[[use]]\n", "[[use]]\ntype = \"sensor_msgs/msg/Image\"\n");
    let lab = Lab::new(PLAN, [robot, desk]);
    let _talker = lab.peer(Site::Robot, "cyclone", "pub", &["--type", "string", "--topic", "/string"]);
    eventually("the mismatch is said", || {
        let log = lab.log(Site::Desk);
        log.contains("sensor_msgs/msg/Image") && log.contains("std_msgs/msg/String")
    });
    let states = |site| -> Vec<String> {
        let status = lab.status(site);
        let routes = status["routes"].as_array().cloned().unwrap_or_default();
        routes
            .iter()
            .map(|r| format!("{} {}", r["topic"].as_str().unwrap(), r["state"].as_str().unwrap()))
            .collect()
    };
    eventually("what is waited for", || {
        states(Site::Robot).contains(&"/never waits for a local publisher".to_owned())
    });
    assert!(!lab.log(Site::Robot).contains("panicked") && !lab.log(Site::Desk).contains("panicked"));
}

#[test]
fn two_nodes_on_one_network_make_no_loop() {
    let mut lab = Lab::with_topics(PLAN, ["/string"]);
    // The desk's node moves into the robot's network.
    lab.kill(Site::Desk);
    lab.reconfigure(Site::Desk, &lab.cloud_address(Site::Desk), &lab.cloud_address(Site::Robot));
    let domain = |site| format!("domain_id = {}", lab.domain(site));
    lab.reconfigure(Site::Desk, &domain(Site::Desk), &domain(Site::Robot));
    lab.start_at(Site::Desk, Site::Robot);
    let common = ["--type", "string", "--topic", "/string"];
    let mut listener = lab.peer(
        Site::Robot,
        "fastdds",
        "sub",
        &[&common[..], &["--count", "100", "--linger", "2"]].concat(),
    );
    listener.wait("ready", |e| e["event"] == "ready");
    let mut talker = lab.peer(
        Site::Robot,
        "cyclone",
        "pub",
        &[&common[..], &["--count", "120", "--rate", "50", "--wait-go"]].concat(),
    );
    // The talker itself, and the desk's writer. The talker may know of its readers a second later than they of it, and
    // what it says before is for nobody.
    listener.wait("both writers", |e| e["event"] == "matched" && e["count"] == 2);
    talker.wait("both readers", |e| e["event"] == "matched" && e["count"] == 2);
    talker.go();
    let summary = listener.summary();
    let (received, duplicated) =
        (summary["received"].as_u64().unwrap(), summary["duplicated"].as_u64().unwrap());
    // Each message comes directly and once more through the router, never a third time.
    assert!(received >= 100 && duplicated > 0 && duplicated <= received, "{summary}");
    assert_eq!(summary["altered"], 0, "{summary}");
    talker.summary();
}

#[test]
fn services_of_a_far_network_are_called_as_if_they_were_near() {
    let mut lab = Lab::new(PLAN, robot_to_desk("service", ["/add_two_ints"]));
    let answered = |client: &mut Peer, n: u64| {
        let answer = client.wait(&format!("answer {n}"), |e| e["event"] == "answer" && e["n"] == n);
        assert_eq!(answer["right"], true, "{answer}");
    };
    let gone = |client: &mut Peer| client.wait("its end", |e| e["event"] == "service" && e["there"] == false);
    let there =
        |client: &mut Peer| client.wait("it is there", |e| e["event"] == "service" && e["there"] == true);
    let mut clients = ["1000", "2000"]
        .map(|base| lab.service_peer(Site::Desk, "client", &["--count", "20", "--base", base]));
    let mut server = lab.service_peer(Site::Robot, "server", &[]);
    for client in &mut clients {
        there(client);
        (1..=20).for_each(|n| answered(client, n));
    }
    // A killed server says no goodbye, and DDS notices after its lease, as it would without sgc.
    drop(server);
    clients.iter_mut().for_each(|client| drop(gone(client)));
    server = lab.service_peer(Site::Robot, "server", &["--hold"]);
    clients.iter_mut().for_each(|client| drop(there(client)));
    // Calls that are open while the router restarts are carried out once and answered once.
    clients[0].go();
    server.wait("the request", |e| e["event"] == "request" && e["b"] == 21);
    lab.kill(Site::Cloud);
    eventually("the router is missed", || lab.status(Site::Robot)["links"] == Value::Array(vec![]));
    server.go();
    server.wait("its answer", |e| e["event"] == "released" && e["count"] == 1);
    lab.start(Site::Cloud);
    answered(&mut clients[0], 21);
    clients[1].go();
    let next = server.wait("the next request", |e| e["event"] == "request");
    assert_eq!((&next["a"], &next["b"]), (&2000.into(), &21.into()), "something was asked twice");
    server.go();
    answered(&mut clients[1], 21);
    let state = lab.status(Site::Desk)["routes"][0]["state"].as_str().unwrap().to_owned();
    // The counts of both servers together.
    assert!(state.contains("42 calls, 0 in progress, 42 answered, 0 refused, 0 lost"), "{state}");
    for client in &mut clients {
        client.end();
        let summary = client.summary();
        assert_eq!((&summary["called"], &summary["open"]), (&21.into(), &0.into()), "{summary}");
    }
}

#[test]
fn an_action_of_a_far_network_reports_and_ends_and_can_be_cancelled() {
    let lab = Lab::new(PLAN, robot_to_desk("action", ["/fibonacci"]));
    let name = ["--name", "/fibonacci"];
    let mut server =
        lab.service_peer(Site::Robot, "action-server", &[&name[..], &["--step", "0.1"]].concat());
    server.wait("ready", |e| e["event"] == "ready");
    for cancel in [false, true] {
        let order = ["--order", if cancel { "200" } else { "12" }];
        let extra: &[&str] = if cancel { &["--cancel"] } else { &[] };
        let args = [&name[..], &order[..], extra].concat();
        let mut client = lab.service_peer(Site::Desk, "action-client", &args);
        client.wait("the goal is accepted", |e| e["event"] == "accepted" && e["accepted"] == true);
        let result = client.wait("a result", |e| e["event"] == "result");
        let (status, right) = if cancel { (5, false) } else { (4, true) };
        assert_eq!((&result["status"], &result["right"]), (&status.into(), &right.into()), "{result}");
        let summary = client.summary();
        assert_eq!((&summary["last_status"], &summary["grows"]), (&status.into(), &true.into()), "{summary}");
        let feedback = summary["feedback"].as_u64().unwrap();
        assert_eq!(summary["cancelling"], u64::from(cancel), "{summary}");
        assert!(if cancel { (2..200).contains(&feedback) } else { feedback == 13 }, "{summary}");
    }
}

#[test]
fn the_router_never_holds_what_it_carries() {
    let lab = Lab::with_topics(PLAN, ["/string"]);
    let common = ["--type", "string", "--topic", "/string"];
    let mut listener = lab.peer(Site::Desk, "cyclone", "sub", &[&common[..], &["--verbose"]].concat());
    let publish = [&common[..], &["--rate", "50", "--size", "4000"]].concat();
    let mut talker = lab.peer(Site::Robot, "cyclone", "pub", &publish);
    for _ in 0..50 {
        listener.wait("messages", |e| e["event"] == "received");
    }
    // The listener holds the talker's words in plain text. Finding them there shows that the search works, so that
    // finding nothing in the router means something.
    let words: [&[u8]; 4] = [b" fill=", b"std_msgs", b"rt/string", b"dds_::String_"];
    for word in words {
        assert!(
            holds(lab.node(Site::Robot).pid(), word),
            "{:?} not even in the robot's node",
            String::from_utf8_lossy(word)
        );
    }
    for word in words.into_iter().chain([&b"robot.identity"[..], b"\"desk\""]) {
        assert!(
            !holds(lab.node(Site::Cloud).pid(), word),
            "the router holds {:?}",
            String::from_utf8_lossy(word)
        );
    }
    talker.end();
    listener.end();
}

/// Returns `true` if the writable memory of a process holds these bytes.
fn holds(pid: u32, word: &[u8]) -> bool {
    use std::os::unix::fs::FileExt;
    let memory = fs::File::open(format!("/proc/{pid}/mem")).expect("root may read its processes' memory");
    let maps = fs::read_to_string(format!("/proc/{pid}/maps")).unwrap();
    maps.lines().filter(|l| l.split_whitespace().nth(1).is_some_and(|p| p.starts_with("rw"))).any(|line| {
        let (start, end) = line.split_whitespace().next().unwrap().split_once('-').unwrap();
        let (start, end) = (u64::from_str_radix(start, 16).unwrap(), u64::from_str_radix(end, 16).unwrap());
        let mut bytes = vec![0; (end - start) as usize];
        let read = memory.read_at(&mut bytes, start).unwrap_or(0);
        bytes.truncate(read);
        bytes.windows(word.len()).any(|w| w == word)
    })
}
