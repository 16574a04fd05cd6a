//! Tests features of ROS 2 nodes between sites: every message type, lifecycles, simulated time, service introspection,
//! transforms, images, high rates, partners.

use std::collections::BTreeSet;
use std::time::Duration;

use serde_json::{Value, json};

use crate::lab::{Lab, Site, robot_to_desk, share, uses};
use crate::support::{Peer, eventually};
use crate::{EXCLUSIVE, PAIRS, PLAN, count};

/// Starts `features.py`.
fn start(lab: &Lab, site: Site, distribution: &str, args: &[&str]) -> Peer {
    lab.rclpy(site, distribution, "features.py", args)
}

/// Ends the peers cleanly, so that they leave the network.
fn end<const N: usize>(mut peers: [Peer; N]) {
    peers.iter_mut().for_each(Peer::end);
    for peer in &mut peers {
        peer.summary();
    }
}

/// Runs the publisher and the subscriber of all types. Returns the subscriber's summary.
fn all_types(lab: &Lab, [talks, listens]: [&str; 2], talks_at: Site, [published, heard]: [&str; 2]) -> Value {
    let run = |site, distribution, role, namespace| {
        let args = [role, "--namespace", namespace, "--timeout", "30"];
        lab.rclpy(site, distribution, "values.py", &args)
    };
    let mut listener = run(Site::Desk, listens, "sub", heard);
    let mut talker = run(talks_at, talks, "pub", published);
    talker.wait_matched("a match of each publisher");
    listener.wait_matched("a match of each subscriber");
    talker.go();
    listener.summary()
}

/// Patterns, a name for others and a namespace carry the topics of all types.
/// Networks in which the robot shares a service and a topic, or patterns of them, with the desk.
fn with_service_and_topic(service: &str, topic: &str) -> Lab {
    let [mut robot, mut desk] = robot_to_desk("service", [service]);
    let [shared, used] = robot_to_desk("topic", [topic]);
    robot += &shared;
    desk += &used;
    Lab::real(PLAN, [robot, desk])
}

#[test]
fn every_message_type_arrives_by_value() {
    let robot = share("topic", "/types/**", "desk") + "as = \"/arm/types/**\"\n";
    let desk = uses("topic", "/arm/types/**", "robot") + "namespace = \"/robot1\"\n";
    let lab = Lab::real(PLAN, [robot, desk]);
    let assert_whole = |summary: &Value, what: &str| {
        assert!(count(summary, "types") > 130, "{summary}");
        let faults = ["missing", "altered", "wrong"].map(|key| summary[key].clone());
        assert_eq!(faults, [json!([]), json!([]), json!({})], "{what}");
    };
    let native = all_types(&lab, PAIRS[0], Site::Desk, ["/native"; 2]);
    assert_whole(&native, "with nothing in between");
    for pair in PAIRS {
        let carried = all_types(&lab, pair, Site::Robot, ["/types", "/robot1/arm/types"]);
        assert_whole(&carried, &format!("{pair:?}"));
    }
}

#[test]
fn lifecycle_of_a_far_node_is_led_as_that_of_a_near_one() {
    let lab = with_service_and_topic("/robot/camera/*", "/robot/camera/*");
    for [serves, manages] in PAIRS {
        let [native, carried] = [(Site::Desk, "/near"), (Site::Robot, "/robot")].map(|(site, namespace)| {
            let mut camera = start(&lab, site, serves, &["camera", "--namespace", namespace]);
            let mut manager = start(&lab, Site::Desk, manages, &["manage", "--namespace", namespace]);
            camera.wait_matched("a subscriber to the camera's events");
            manager.go();
            let managed = manager.wait("the end of its life", |e| e["event"] == "managed");
            end([camera, manager]);
            managed
        });
        assert_eq!(native["events"].as_array().unwrap().len(), 11, "{native}");
        assert_eq!(carried, native, "{serves} to {manages}");
    }
}

/// Returns the simulated seconds of the next ticks of a node with `use_sim_time`.
fn ticks(simulated: &mut Peer, times: usize) -> Vec<f64> {
    let is_tick = |e: &Value| e["event"] == "tick" && e["seconds"].as_f64() > Some(1_000.0);
    (0..times)
        .map(|_| simulated.wait("a tick of simulated time", is_tick)["seconds"].as_f64().unwrap())
        .collect()
}

/// Returns the median time between ticks.
fn step(ticks: &[f64]) -> f64 {
    let mut steps: Vec<_> = ticks.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    steps[steps.len() / 2]
}

#[test]
fn clocks_with_use_sim_time_follow_a_far_simulator_back_to_its_beginning_too() {
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/clock"]));
    for [talks, listens] in PAIRS {
        let mut both = [Site::Robot, Site::Desk].map(|site| start(&lab, site, listens, &["simulated"]));
        let mut simulator = start(&lab, Site::Robot, talks, &["simulator"]);
        let what = format!("{talks} to {listens}");
        // The timer ticks once a second of simulated time, which is ten times a second.
        let [near, far] = both.each_mut().map(|simulated| ticks(simulated, 20));
        for heard in [&near, &far] {
            assert!(heard.is_sorted() && heard[19] < 100_000.0, "{what}: {heard:?}");
        }
        assert!((step(&far) - step(&near)).abs() < 0.25, "{what}: {far:?} beside {near:?}");
        simulator.go();
        for (simulated, last) in both.iter_mut().zip([near[19], far[19]]) {
            let jump = simulated.wait("a jump back", |e| e["event"] == "jumped");
            let back = jump["seconds"].as_f64().unwrap();
            assert!(back < 0.0 && 1_001.0 - back >= last, "{what}: {last} {jump}");
            simulated.wait("a tick", |e| e["event"] == "tick" && e["seconds"].as_f64() < Some(last));
        }
        let [near, far] = both;
        end([near, far, simulator]);
    }
}

/// Returns the events that come within a second of each other, without the id of the caller.
fn events_of_a_call(watcher: &Peer) -> Vec<Value> {
    let mut heard = Vec::new();
    while let Ok((_, mut event)) = watcher.events.recv_timeout(Duration::from_secs(1)) {
        if event["event"] == "service_event" {
            event["client"].take();
            event["number"].take();
            heard.push(event);
        }
    }
    heard
}

/// The events of client and server agree on a call except for the caller: the server's events name the client of `sgc`.
#[test]
fn events_of_far_services_are_heard_with_their_contents() {
    let lab = with_service_and_topic("/add", "/add/_service_event");
    for [serves, calls] in PAIRS {
        let [native, carried] = [(Site::Desk, "/near"), (Site::Robot, "/add")].map(|(site, name)| {
            let of = ["--topic", name];
            let watcher = start(&lab, Site::Desk, calls, &[&["watch"], &of[..]].concat());
            let server = start(&lab, site, serves, &[&["serve"], &of[..]].concat());
            let mut client = start(&lab, Site::Desk, calls, &[&["call"], &of[..]].concat());
            // The events of the first calls may come before their publishers and the watcher know each other.
            let mut heard = Vec::new();
            eventually(&format!("all events of a call, {serves} to {calls} of {name}"), || {
                client.go();
                client.wait("an answer", |e| e["event"] == "answer" && e["success"] == false);
                heard = events_of_a_call(&watcher);
                let kinds: BTreeSet<_> = heard.iter().map(|event| event["kind"].to_string()).collect();
                (heard.len(), kinds.len()) == (4, 4)
            });
            end([watcher, server, client]);
            heard.sort_by_key(|event| event["kind"].to_string());
            heard
        });
        assert_eq!(native.len(), 4, "{native:?}");
        for site in [Site::Robot, Site::Desk] {
            let drops = &lab.status(site)["drops"];
            assert!(drops["type_differs"].is_null(), "the definition of the service is not told: {drops}");
        }
        assert_eq!(carried, native, "{serves} to {calls}");
    }
}

/// Returns a frame with `frame_prefix`: a leading slash is dropped, and an empty frame stays empty.
fn prefixed(frame: &Value) -> Value {
    match frame.as_str().unwrap().trim_start_matches('/') {
        "" => json!(""),
        frame => json!(format!("robot1/{frame}")),
    }
}

#[test]
fn far_transforms_have_the_prefix_of_their_frames() {
    let [robot, desk] = robot_to_desk("topic", ["/tf"]);
    let lab = Lab::real(PLAN, [robot, desk + "frame_prefix = \"robot1/\"\n"]);
    for [talks, listens] in PAIRS {
        let talker = start(&lab, Site::Robot, talks, &["broadcast", "--topic", "/tf"]);
        let mut listeners =
            [Site::Robot, Site::Desk].map(|site| start(&lab, site, listens, &["frames", "--topic", "/tf"]));
        let [near, far] = listeners.each_mut().map(|listener| {
            let mut heard = listener.wait("transforms", |e| e["event"] == "frames");
            heard["frames"].take()
        });
        let expected = json!([["map", "odom", 1.0], ["/odom", "base_link", 0.5], ["base_link", "", -2.0]]);
        assert_eq!(near, expected, "{talks} to {listens}, natively");
        let renamed = near.as_array().unwrap().iter().map(|transform| {
            let [parent, child] = [&transform[0], &transform[1]].map(prefixed);
            json!([parent, child, transform[2]])
        });
        assert_eq!(far, renamed.collect::<Value>(), "{talks} to {listens}");
        let [near, far] = listeners;
        end([talker, near, far]);
    }
}

#[test]
fn images_of_one_six_and_thirteen_megabytes_arrive_whole() {
    const SIZES: [&str; 3] = ["1000000", "6000000", "13000000"];
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/image"]));
    for [talks, listens] in PAIRS {
        let mut viewers = [Site::Robot, Site::Desk]
            .map(|site| start(&lab, site, listens, &["image-sub", "--topic", "/image"]));
        let args = [&["image-pub", "--topic", "/image", "--sizes"], &SIZES[..]].concat();
        let mut talker = start(&lab, Site::Robot, talks, &args);
        viewers.iter_mut().for_each(|viewer| viewer.wait_matched("a match of each viewer"));
        // The viewer beside it, and the reader of the node.
        talker.wait("two matches at the robot", |e| e["event"] == "matched" && e["count"] == 2);
        let mut next = || {
            talker.go();
            let mut sent = talker.wait("an image sent", |e| e["event"] == "sent");
            sent["event"] = json!("received");
            sent["whole"] = json!(true);
            sent
        };
        let is_image = |e: &Value| e["event"] == "received";
        // The first message may be lost during discovery.
        let first = next();
        let second = next();
        for (viewer, place) in viewers.iter_mut().zip(["natively", "afar"]) {
            let mut heard = viewer.wait("an image", is_image);
            if heard == first {
                heard = viewer.wait("another", is_image);
            }
            assert_eq!(heard, second, "{talks} to {listens}, {place}");
        }
        for _ in 0..2 {
            let sent = next();
            for (viewer, place) in viewers.iter_mut().zip(["natively", "afar"]) {
                assert_eq!(viewer.wait("another", is_image), sent, "{talks} to {listens}, {place}");
            }
        }
    }
}

#[test]
fn topic_of_a_thousand_messages_a_second_arrives_whole_and_in_time() {
    const LATER_P50_US: f64 = 5_000.0;
    let lab = Lab::real(EXCLUSIVE, robot_to_desk("topic", ["/imu"]));
    for [talks, listens] in PAIRS {
        // A subscriber that keeps ten loses some when it has no processor for 10 ms, natively as well.
        let common = ["--topic", "/imu", "--size", "300", "--depth", "0", "--timeout", PLAN.peer_life];
        let listen = [&["sub", "--last", "3000", "--linger", "0.2"], &common[..]].concat();
        let mut listeners = [Site::Robot, Site::Desk].map(|site| lab.load(site, listens, &listen));
        // The listener beside it, and the reader of the node.
        let pace = ["pub", "--rate", "1000", "--count", "3000", "--wait-matched", "2"];
        let talk = [&pace[..], &["--wait-go", "--begin", "0.5", "--hold", "1"], &common[..]].concat();
        let mut talker = lab.load(Site::Robot, talks, &talk);
        talker.wait_matched("a match at the publisher");
        listeners.iter_mut().for_each(|listener| listener.wait_matched("a match of each subscriber"));
        talker.go();
        let [near, far] = listeners.each_mut().map(|listener| {
            let summary = listener.summary();
            let counts =
                ["last", "lost", "duplicated", "altered", "reordered"].map(|key| count(&summary, key));
            assert_eq!(counts, [2999, 0, 0, 0, 0], "{talks} to {listens}: {summary}");
            summary["latency_us"]["p50"].as_f64().unwrap()
        });
        assert!(far <= near + LATER_P50_US, "{talks} to {listens}: {far} µs, {near} natively");
    }
}

#[test]
fn nodes_with_two_hundred_topics_have_few_threads() {
    const TOPICS_EACH_WAY: &str = "100";
    const THREADS_MAX: usize = 32;
    let [robot, desk] = robot_to_desk("topic", ["/sensed/**"]);
    let robot = robot + &uses("topic", "/commanded/**", "desk");
    let desk = desk + &share("topic", "/commanded/**", "robot");
    let lab = Lab::real(PLAN, [robot, desk]);
    let run = |site, distribution, publish, hear| {
        let args = ["--publish", publish, "--hear", hear, "--count", TOPICS_EACH_WAY];
        lab.rclpy(site, distribution, "many.py", &args)
    };
    let mut peers = [
        run(Site::Robot, "jazzy", "/sensed", "/commanded"),
        run(Site::Desk, "kilted", "/commanded", "/sensed"),
    ];
    let heard_all = |e: &Value| e["event"] == "heard_all";
    for peer in &mut peers {
        peer.wait("a message of each topic", heard_all);
    }
    for site in [Site::Robot, Site::Desk] {
        // While the topics begin, more threads are at work.
        eventually("threads end", || lab.node(site).held().threads <= THREADS_MAX);
    }
    for peer in &mut peers {
        peer.go();
        peer.wait("a later message of each topic", heard_all);
    }
}
