//! Whole nodes over real QUIC on the loopback interface, with local networks in memory: topology in, samples out.

#![allow(clippy::unwrap_used)]

mod support;

use std::cell::RefCell;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_node::Status;
use sgc_node::admin::AdminRequest;
use sgc_node::config::{Recipient, RosConfig};
use sgc_ros::{EndpointKind, Shaping};
use sgc_trust::Suite;
use sgc_wire::{History, Qos};
use support::*;

#[test]
fn a_topic_crosses_a_router_and_leaves_no_loop() {
    let trio = Trio::new();
    let _nodes = (trio.cloud(), trio.robot(&["/chatter"], "desk"), trio.desk(&["/chatter"]));
    let talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/chatter", Qos::default());
    talker.wait_for_readers(1);
    wait("a writer at the desk", || writers(&trio.desk_net, "/chatter") == 1);
    listener.hears_at_last(|n| talker.say(format!("warm {n}")));
    talker.say("last");
    wait("the last message", || listener.drain().last().is_some_and(|b| b == "last"));
    listener.hears_nothing();
    // The desk's own writer is not shared back, and has no reader.
    assert_eq!((writers(&trio.robot_net, "/chatter"), writers(&trio.desk_net, "/chatter")), (1, 1));
    assert_eq!(trio.desk_net.count("rt/chatter", EndpointKind::Reader), 1);
}

#[test]
fn a_topic_goes_on_as_often_as_both_ends_let_it() {
    let slow = |ms| Shaping { interval: Some(Duration::from_millis(ms)), ..Shaping::default() };
    let trio = Trio::new();
    let (_cloud, robot, desk) = (trio.cloud(), trio.robot(&["/a", "/b"], "desk"), trio.desk(&["/a", "/b"]));
    robot.reload(|config| config.shares[0].shaping = slow(100));
    desk.reload(|config| config.uses[1].shaping = slow(100));
    for topic in ["/a", "/b"] {
        let talker = Talker::new(&trio.robot_net, topic, Qos::default());
        let listener = Listener::new(&trio.desk_net, topic, Qos::default());
        talker.wait_for_readers(1);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
        let begin = Instant::now();
        (0..300).for_each(|n| talker.say(format!("{n}")));
        let heard = RefCell::new(Vec::new());
        wait("the last", || {
            heard.borrow_mut().extend(listener.drain());
            heard.borrow().last().is_some_and(|last| last == "299")
        });
        let most = begin.elapsed().as_millis() as usize / 100 + 3;
        let heard = heard.borrow();
        let heard = heard.iter().filter(|message| !message.starts_with(b"warm")).count();
        assert!(heard <= most, "{topic}: {heard} of {most}");
    }
    // The robot leaves out most of both, since nobody wants more.
    assert!(robot.drops("thinned") > 400, "{}", robot.status()["drops"]);
    drop(desk);
}

#[test]
fn names_get_labels_on_every_link_that_they_cross() {
    let trio = Trio::new();
    let (cloud, robot) = (trio.cloud(), trio.robot(&["/a", "/b"], "desk"));
    let desk = trio.desk(&["/a", "/b"]);
    let labels = |node: &Node, which: &str| {
        let links = node.status()["links"].as_array().unwrap().clone();
        links.iter().map(|l| l[which].as_u64().unwrap()).sum::<u64>()
    };
    for (index, topic) in ["/a", "/b"].into_iter().enumerate() {
        let talker = Talker::new(&trio.robot_net, topic, Qos::default());
        let listener = Listener::new(&trio.desk_net, topic, Qos::default());
        talker.wait_for_readers(1);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
        // The catalogue and the robot's clock have one for the life of a link, too.
        let n = index as u64 + 3;
        wait("labels", || labels(&robot, "labels_sent") == n && labels(&cloud, "labels_sent") == n);
        assert_eq!((labels(&desk, "labels_received"), labels(&desk, "labels_sent")), (n, 0));
        talker.say("under a label");
        wait("the message", || listener.drain().last().is_some_and(|b| b == "under a label"));
    }
    let drops = cloud.status()["drops"].clone();
    assert!(drops.get("unknown_label").is_none() && drops.get("malformed").is_none(), "{drops}");
}

#[test]
fn large_messages_cross_whole() {
    let trio = Trio::new();
    let _nodes = (trio.cloud(), trio.robot(&["/image"], "desk"), trio.desk(&["/image"]));
    let talker = Talker::new(&trio.robot_net, "/image", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/image", Qos::default());
    talker.wait_for_readers(1);
    listener.hears_at_last(|n| talker.say(format!("warm {n}")));
    talker.say("mark");
    wait("the mark", || listener.drain().last().is_some_and(|b| b == "mark"));
    for bytes in [1_000_000usize, 13_000_001] {
        let payload: Bytes =
            (0..bytes).map(|i| ((i as u64 * 0x9e37_79b9) >> 13) as u8).collect::<Vec<_>>().into();
        talker.say(payload.clone());
        listener.hears(payload);
    }
}

#[test]
fn flow_resumes_without_duplicates_after_any_node_restarts() {
    let trio = Trio::new();
    let mut cloud = trio.cloud();
    let mut robot = trio.robot(&["/chatter"], "desk");
    let mut desk = trio.desk(&["/chatter"]);
    let talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/chatter", Qos::default());
    let mut said = 0u32;
    let mut heard = Vec::new();
    for round in 0..6 {
        match round {
            0 => {}
            1 | 4 => {
                cloud.kill();
                cloud = trio.cloud();
            }
            2 => {
                robot.kill();
                robot = trio.robot(&["/chatter"], "desk");
            }
            3 => {
                desk.kill();
                desk = trio.desk(&["/chatter"]);
            }
            _ => {
                robot.kill();
                cloud.kill();
                cloud = trio.cloud();
                robot = trio.robot(&["/chatter"], "desk");
            }
        }
        let before = said;
        let deadline = Instant::now() + PATIENCE;
        // Messages are skipped until one of after the restart arrives.
        while heard.last().is_none_or(|last| *last <= before) {
            assert!(Instant::now() < deadline, "round {round}: the flow does not resume");
            said += 1;
            talker.say(said.to_string());
            if let Ok(b) = listener.samples.recv_timeout(Duration::from_millis(20)) {
                heard.push(std::str::from_utf8(&b).unwrap().parse::<u32>().unwrap());
            }
        }
    }
    heard.extend(listener.drain().iter().map(|b| std::str::from_utf8(b).unwrap().parse::<u32>().unwrap()));
    assert!(heard.windows(2).all(|w| w[0] < w[1]), "twice or out of order: {heard:?}");
    drop((cloud, robot, desk));
}

#[test]
fn a_router_that_is_killed_costs_a_reliable_topic_nothing() {
    let trio = Trio::new();
    let mut cloud = trio.cloud();
    let _nodes = (trio.robot(&["/chatter"], "desk"), trio.desk(&["/chatter"]));
    let qos = Qos { history: History::KeepAll, ..Qos::default() };
    let talker = Talker::new(&trio.robot_net, "/chatter", qos.clone());
    let listener = Listener::new(&trio.desk_net, "/chatter", qos);
    talker.wait_for_readers(1);
    listener.hears_at_last(|_| talker.say("0"));
    let mut said = 0u32;
    let mut say = |talker: &Talker, n: usize| {
        for _ in 0..n {
            said += 1;
            talker.say(said.to_string());
            std::thread::sleep(Duration::from_millis(2));
        }
        said
    };
    for _ in 0..3 {
        say(&talker, 200);
        // Only the robot has the history and the messages published until the router is back.
        cloud.kill();
        say(&talker, 200);
        cloud = trio.cloud();
        say(&talker, 200);
    }
    // The last message precedes a silence.
    let last = say(&talker, 1);
    let mut heard = Vec::new();
    while heard.last() != Some(&last) {
        let sample = listener.samples.recv_timeout(PATIENCE).expect("all that was said");
        heard.push(std::str::from_utf8(&sample).unwrap().parse::<u32>().unwrap());
    }
    heard.retain(|n| *n > 0);
    assert_eq!(heard, (1..=last).collect::<Vec<_>>(), "each once, in order");
    drop(cloud);
}

#[test]
fn late_joiners_get_each_latched_publisher_once() {
    let trio = Trio::new();
    let cloud = trio.cloud();
    let _robot = trio.robot(&["/tf_static"], "desk");
    let talkers: Vec<_> = (0..5).map(|_| Talker::new(&trio.robot_net, "/tf_static", latched())).collect();
    for (n, talker) in talkers.iter().enumerate() {
        talker.say(format!("old {n}"));
        talker.say(format!("frame {n}"));
    }
    let _desk = trio.desk(&["/tf_static"]);
    wait("five writers", || writers(&trio.desk_net, "/tf_static") == 5);
    let expected: Vec<_> = (0..5).map(|n| format!("frame {n}")).collect();
    let hears_all = |listener: &Listener| {
        let mut heard: Vec<_> = (0..5)
            .map(|_| listener.samples.recv_timeout(PATIENCE).expect("all five"))
            .map(|b| String::from_utf8(b.to_vec()).unwrap())
            .collect();
        heard.sort();
        assert_eq!(heard, expected);
    };
    let early = Listener::new(&trio.desk_net, "/tf_static", latched());
    hears_all(&early);
    let late = Listener::new(&trio.desk_net, "/tf_static", latched());
    hears_all(&late);
    // After the router's return, no message is repeated, and new ones arrive once.
    cloud.kill();
    let _cloud = trio.cloud();
    talkers[0].say("news");
    early.hears("news");
    late.hears("news");
    early.hears_nothing();
}

#[test]
fn a_clean_stop_withdraws_at_once_and_a_new_share_appears() {
    let trio = Trio::new();
    let cloud = trio.cloud();
    let robot = trio.robot(&["/a", "/b"], "desk");
    let desk = trio.desk(&["/a", "/b"]);
    let _a = Talker::new(&trio.robot_net, "/a", Qos::default());
    wait("/a at the desk", || writers(&trio.desk_net, "/a") == 1);
    assert_eq!(writers(&trio.desk_net, "/b"), 0);
    let b = Talker::new(&trio.robot_net, "/b", Qos::default());
    wait("/b at the desk", || writers(&trio.desk_net, "/b") == 1);
    drop(b);
    wait("/b gone", || writers(&trio.desk_net, "/b") == 0);
    let begun = Instant::now();
    robot.stop();
    wait("/a gone", || writers(&trio.desk_net, "/a") == 0);
    // Without a withdrawal it would take ten seconds after the loss of the link.
    assert!(begun.elapsed() < sgc_ros::UNREACHABLE_HOLD, "it was not withdrawn, it expired");
    wait("nothing left in the router", || {
        let router = &cloud.status()["router"];
        // Desk and router each have a name for reports, and the desk one for questions about types and one for its clock.
        router["branches"] == 0 && router["routed_names"] == 4
    });
    desk.stop();
    wait("only its own name left in the router", || cloud.status()["router"]["names"] == 1);
}

#[test]
fn unauthorised_node_gets_nothing_and_learns_why() {
    let trio = Trio::new();
    let _nodes = (trio.cloud(), trio.robot(&["/chatter"], "somebody-else"));
    let desk = trio.desk(&["/chatter"]);
    let _talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    let state = || desk.status()["routes"][0]["state"].as_str().unwrap_or_default().to_owned();
    wait("the reason in the status", || state().contains("does not share it with this node"));
    assert_eq!(writers(&trio.desk_net, "/chatter"), 0);
}

#[test]
fn two_proxies_on_one_network_make_no_loop() {
    let trio = Trio::new();
    // Robot and desk share a local network, so the desk's own messages must not be shared again.
    let net = &trio.robot_net;
    let _nodes = (trio.cloud(), trio.robot(&["/chatter"], "desk"), trio.desk_on(&["/chatter"], net));
    let talker = Talker::new(net, "/chatter", Qos::default());
    wait("the desk's writer", || writers(net, "/chatter") == 2);
    let listener = Listener::new(net, "/chatter", Qos::default());
    for n in 0..50 {
        talker.say(format!("{n}"));
    }
    // Each message comes once from the talker and at most once through the router.
    let mut count = 0;
    while listener.samples.recv_timeout(Duration::from_millis(500)).is_ok() {
        count += 1;
    }
    assert!((50..=100).contains(&count), "{count} samples of 50");
}

#[test]
fn status_names_links_and_routes() {
    let trio = Trio::new();
    let cloud = trio.cloud();
    let robot = trio.robot(&["/chatter", "/never"], "desk");
    let _talker = Talker::new(&trio.robot_net, "/chatter", Qos::default());
    wait("the link", || robot.status()["links"].as_array().is_some_and(|l| l.len() == 1));
    let status = robot.status();
    assert_eq!(status["node"], "robot");
    let never = status["routes"].as_array().unwrap().iter().find(|r| r["topic"] == "/never").unwrap();
    assert_eq!(never["state"], "waits for a local publisher");
    // The names include the catalogue, the robot's names for questions about types and for its clock, and those of both for
    // reports.
    wait("chatter is routed", || cloud.status()["router"]["routed_names"] == 6);
    // The document has the form of `Status`.
    let _: fn(Status) -> serde_json::Value = |s| serde_json::to_value(s).unwrap();
}

#[test]
fn signed_messages_pass_one_by_one_and_in_batches() {
    for suite in [Suite::Standard, Suite::StandardChacha, Suite::Paper] {
        let trio = Trio::new();
        let (_cloud, _robot) = (trio.cloud(), trio.robot_in(suite, &["/signed"], "desk"));
        let _desk = trio.desk(&["/signed"]);
        let qos = Qos { history: History::KeepAll, ..Qos::default() };
        let talker = Talker::new(&trio.robot_net, "/signed", qos.clone());
        let listener = Listener::new(&trio.desk_net, "/signed", qos);
        talker.wait_for_readers(1);
        let message = |n: usize| Bytes::from(vec![n as u8; 10 + n * 300]);
        listener.hears_at_last(|_| talker.say(message(255)));
        talker.writer.write_burst((0..150).map(message));
        for n in 0..150 {
            loop {
                let heard = listener.samples.recv_timeout(PATIENCE).expect("a sample arrives");
                if heard == message(n) {
                    break;
                }
                assert!(n == 0 && heard == message(255), "{} bytes in {suite}", heard.len());
            }
        }
    }
}

/// A measurement, not a test: messages of 1 KB a second from a local network over a robot, a cloud router and a desk to
/// another local network, in one process. `benchmarks/throughput.md` says how to run it.
#[test]
#[ignore = "measures"]
fn throughput_of_the_suites() {
    const MESSAGES: usize = 300_000;
    let rate = |suite, burst: usize| {
        let trio = Trio::new();
        let (_cloud, _robot) = (trio.cloud(), trio.robot_in(suite, &["/load"], "desk"));
        let _desk = trio.desk(&["/load"]);
        let qos = Qos { history: History::KeepAll, ..Qos::default() };
        let talker = Talker::new(&trio.robot_net, "/load", qos.clone());
        let listener = Listener::new(&trio.desk_net, "/load", qos);
        talker.wait_for_readers(1);
        let payload = Bytes::from(vec![7; 1000]);
        listener.hears_at_last(|_| talker.say(payload.clone()));
        while listener.samples.recv_timeout(Duration::from_millis(500)).is_ok() {}
        let start = Instant::now();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                for _ in 0..MESSAGES / burst {
                    talker.writer.write_burst((0..burst).map(|_| payload.clone()));
                }
            });
            for _ in 0..MESSAGES / burst * burst {
                listener.samples.recv_timeout(PATIENCE).expect("reliable");
            }
        });
        MESSAGES as f64 / start.elapsed().as_secs_f64()
    };
    for burst in [1, 8, 32, 64] {
        let mut rates = [Suite::Group, Suite::Standard].map(|suite| (suite, Vec::new()));
        for _ in 0..5 {
            rates.iter_mut().for_each(|(suite, all)| all.push(rate(*suite, burst)));
        }
        let medians = rates.map(|(_, mut all)| {
            all.sort_unstable_by(f64::total_cmp);
            all[all.len() / 2]
        });
        let [group, standard] = medians;
        eprintln!("{burst} at a time: group {group:.0}/s, standard {standard:.0}/s, {:.2}", standard / group);
    }
}

/// Relays datagrams between one node and the router, and records them.
struct Tap {
    port: u16,
    seen: std::sync::Arc<std::sync::Mutex<Vec<Vec<u8>>>>,
}

impl Tap {
    fn before(router: u16) -> Self {
        let near = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        let port = near.local_addr().unwrap().port();
        let far = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
        far.connect(("127.0.0.1", router)).unwrap();
        let seen = std::sync::Arc::<std::sync::Mutex<Vec<Vec<u8>>>>::default();
        let client = std::sync::Arc::new(std::sync::OnceLock::new());
        let (near_too, far_too) = (near.try_clone().unwrap(), far.try_clone().unwrap());
        let (seen_too, client_too) = (seen.clone(), client.clone());
        std::thread::spawn(move || {
            let mut buffer = [0; 65_536];
            while let Ok((n, from)) = near.recv_from(&mut buffer) {
                let _ = client.set(from);
                seen.lock().unwrap().push(buffer[..n].to_vec());
                let _ = far.send(&buffer[..n]);
            }
        });
        let kept = seen_too.clone();
        std::thread::spawn(move || {
            let mut buffer = [0; 65_536];
            while let Ok(n) = far_too.recv(&mut buffer) {
                kept.lock().unwrap().push(buffer[..n].to_vec());
                let _ = near_too.send_to(&buffer[..n], client_too.get().unwrap());
            }
        });
        Self { port, seen: seen_too }
    }
}

#[test]
fn nothing_that_crosses_the_wire_tells_payload_topic_type_or_node() {
    const SECRET: &str = "the quick brown payload that nobody on the way may read";
    let mut trio = Trio::new();
    let cloud = trio.cloud();
    let past = trio.port;
    let tap = Tap::before(past);
    trio.port = tap.port;
    let _robot = trio.robot(&["/wire/tapped"], "desk");
    let talker = Talker::new(&trio.robot_net, "/wire/tapped", latched());
    talker.say(SECRET);
    // The desk reaches the router without the tap.
    trio.port = past;
    let _desk = trio.desk(&["/wire/tapped"]);
    Listener::new(&trio.desk_net, "/wire/tapped", latched()).hears(SECRET);
    let seen = tap.seen.lock().unwrap();
    assert!(seen.len() > 10, "the tap carried {} datagrams", seen.len());
    // The needles are long, since noise contains any three letters now and then.
    for needle in [SECRET, "/wire/tapped", "tapped", "std_msgs", "String", "robot", "nobody"] {
        let found = seen.iter().any(|d| d.windows(needle.len()).any(|w| w == needle.as_bytes()));
        assert!(!found, "{needle:?} is readable on the wire");
    }
    drop(cloud);
}

#[test]
fn node_without_rules_joins_the_local_network_at_the_first_that_comes() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let robot = Node::start_apart(trio.config(), identity("robot", false), &trio.robot_net);
    let desk = Node::start_apart(trio.config(), identity("desk", false), &trio.desk_net);
    let talker = Talker::new(&trio.robot_net, "/chatter", latched());
    let listener = Listener::new(&trio.desk_net, "/chatter", latched());
    talker.say("1");
    let graph = |node: &Node| node.ask(&AdminRequest::Graph(None))["ok"].clone();
    assert_eq!((&graph(&robot)["has_ros"], &graph(&desk)["has_ros"]), (&false.into(), &false.into()));
    let ros = || Some(RosConfig::default());
    robot.reload(|config| (config.ros, config.shares) = (ros(), vec![shared_topic("/chatter")]));
    let report = desk.reload(|config| (config.ros, config.uses) = (ros(), vec![used_topic("/chatter")]));
    assert_eq!(report["needs_restart"], serde_json::json!([]));
    listener.hears("1");
    assert_eq!(graph(&desk)["has_ros"], true);
    // Rules come and go as in any node.
    desk.reload(|config| config.uses.clear());
    desk.reload(|config| config.uses = vec![used_topic("/chatter")]);
    talker.say("2");
    listener.hears("2");
    [robot, desk].into_iter().for_each(Node::stop);
}

#[test]
fn owner_says_which_name_of_a_member_is_misspelt() {
    let trio = Trio::new();
    let _cloud = trio.cloud();
    let robot = trio.robot(&["/chatter"], "deks");
    let _talker = Talker::new(&trio.robot_net, "/chatter", latched());
    let unheard = || robot.ask(&AdminRequest::Graph(None))["ok"]["shares"][0]["unheard"].clone();
    assert_eq!(unheard(), serde_json::json!([{"name": "deks", "meant": null}]));
    let _desk = trio.desk(&["/chatter"]);
    wait("the desk is heard of", || unheard() == serde_json::json!([{"name": "deks", "meant": "desk"}]));
    assert!(robot.status()["problems"].to_string().contains("\\\"desk\\\" is here and may be meant"));
    robot.reload(|config| config.shares[0].to = vec![Recipient::Node("desk".parse().unwrap())]);
    assert_eq!(unheard(), serde_json::json!([]));
}
