//! Names, patterns and frame prefixes across whole nodes, and their changes at run time.

#![allow(clippy::unwrap_used)]

mod support;

use bytes::Bytes;
use sgc_node::config::{Config, Rename, ShareConfig};
use sgc_ros::{EndpointKind, EndpointSpec, RosNetwork, RosWriter, SampleKind, TF_MESSAGE};
use sgc_testkit::FakeDomain;
use sgc_trust::Suite;
use sgc_wire::Qos;
use support::*;

/// Starts a second robot of the fleet, which owns the same topics as the first.
fn robot2(trio: &Trio, net: &FakeDomain, topic: &str) -> Node {
    let mut config = trio.config();
    config.shares = vec![share_of(topic)];
    Node::start(config, identity("robot2", false), Some(net))
}

fn share_of(topic: &str) -> ShareConfig {
    let text = format!(
        "identity = 'x'\n[node]\nrouters = ['quic://a']\n[[share]]\ntopic = '{topic}'\nto = ['desk']\nsuite = 'group'"
    );
    sgc_node::config::parse(&text, "t", std::path::Path::new(""), &|_| None).unwrap().shares.remove(0)
}

/// Starts a desk that uses the topics of both, each under its own namespace.
fn desk(trio: &Trio) -> Node {
    let of = |robot: &str| {
        format!(
            "[[use]]\nfrom = '{robot}'\ntopic = '/**'\nnamespace = '/{robot}'\nframe_prefix = '{robot}/'\n"
        )
    };
    let text = format!("identity = 'x'\n[node]\nrouters = ['quic://a']\n{}{}", of("robot"), of("robot2"));
    let read = sgc_node::config::parse(&text, "t", std::path::Path::new(""), &|_| None).unwrap();
    Node::start(Config { uses: read.uses, ..trio.config() }, identity("desk", false), Some(&trio.desk_net))
}

/// Returns a tf message of one transform in little-endian plain CDR.
fn transform(frame: &str, child: &str) -> Bytes {
    let mut out = vec![1, 0, 0, 0, 7, 0, 0, 0, 8, 0, 0, 0];
    for name in [frame, child] {
        out.resize(out.len().next_multiple_of(4), 0);
        out.extend((name.len() as u32 + 1).to_le_bytes());
        out.extend(name.as_bytes());
        out.push(0);
    }
    out.resize(out.len().next_multiple_of(8), 0);
    out.extend((1..=7).flat_map(|n| f64::from(n).to_le_bytes()));
    [&[0, 1, 0, 0][..], &out].concat().into()
}

#[test]
fn two_robots_have_names_of_their_own_and_one_tree_of_frames() {
    let trio = Trio::new();
    let net2 = FakeDomain::default();
    let _nodes = (trio.cloud(), trio.robot(&["/**"], "desk"), robot2(&trio, &net2, "/**"));
    let desk = desk(&trio);
    let scans: Vec<_> = [&trio.robot_net, &net2].map(|net| Talker::new(net, "/scan", latched())).into();
    let tf_spec = EndpointSpec { type_name: TF_MESSAGE.into(), ..spec("/tf_static", latched()) };
    let writers_of_tf: Vec<_> = [&trio.robot_net, &net2]
        .map(|net| {
            let net = net.join(false);
            (net.create_writer(&tf_spec).unwrap(), net)
        })
        .into();
    for (writer, _) in &writers_of_tf {
        writer.write(SampleKind::Write, 1, transform("map", "base_link")).unwrap();
        writer.write(SampleKind::Write, 2, transform("map", "laser")).unwrap();
    }
    for (n, scan) in scans.iter().enumerate() {
        scan.say(format!("scan {n}"));
    }
    for (n, topic) in ["/robot/scan", "/robot2/scan"].into_iter().enumerate() {
        Listener::new(&trio.desk_net, topic, latched()).hears(format!("scan {n}"));
    }
    wait("both robots' frames", || writers(&trio.desk_net, "/tf_static") == 2);
    // A late joiner gets the last message of each robot under the common name.
    let net = trio.desk_net.join(false);
    let (sender, heard) = std::sync::mpsc::channel();
    let handler = Box::new(move |s: sgc_ros::Sample| drop(sender.send(s.payload)));
    let _reader = net.create_reader(&tf_spec, handler).unwrap();
    let mut frames: Vec<_> = (0..2).map(|_| heard.recv_timeout(PATIENCE).unwrap()).collect();
    let mut expected = [transform("robot/map", "robot/laser"), transform("robot2/map", "robot2/laser")];
    frames.sort();
    expected.sort();
    assert_eq!(frames, expected);
    // A payload that is no tf message is dropped and counted.
    writers_of_tf[0]
        .0
        .write(SampleKind::Write, 3, Bytes::from_static(b"\0\x01\0\0\xff\xff\xff\xff"))
        .unwrap();
    wait("the count", || desk.status()["drops"]["frames"] == 1);
    for topic in ["/scan", "/robot/tf_static"] {
        assert_eq!(writers(&trio.desk_net, topic), 0, "{topic}");
    }
}

/// There are more topics than a router takes advertisements of one node at a time.
#[test]
fn hundreds_of_topics_that_come_one_by_one_are_all_there() {
    const TOPICS: usize = 400;
    let trio = Trio::new();
    let (cloud, _robot, desk) = (trio.cloud(), trio.robot(&["/**"], "desk"), trio.desk(&["/**"]));
    let net = trio.robot_net.join(false);
    let talker = |n| net.create_writer(&spec(&format!("/t{n}"), Qos::default())).unwrap();
    let _talkers: Vec<_> = (0..TOPICS).map(talker).collect();
    let granted = || {
        let status = desk.status();
        let routes = status["routes"].as_array().unwrap();
        routes.iter().filter(|route| route["state"].as_str().unwrap().starts_with("granted")).count()
    };
    wait("all topics", || granted() == TOPICS);
    assert!(cloud.status()["drops"]["limit"].is_null(), "{}", cloud.status()["drops"]);
}

#[test]
fn topics_that_match_come_and_go_and_others_notice_nothing() {
    let trio = Trio::new();
    let (_cloud, robot, desk) = (trio.cloud(), trio.robot(&["/a/**"], "desk"), trio.desk(&["/a/*"]));
    let kept = Talker::new(&trio.robot_net, "/a/kept", Qos::default());
    let listener = Listener::new(&trio.desk_net, "/a/kept", Qos::default());
    wait("the way", || writers(&trio.desk_net, "/a/kept") == 1);
    listener.hears_at_last(|n| kept.say(format!("warm {n}")));
    kept.say("begin");
    wait("the last", || listener.drain().last().is_some_and(|last| last == "begin"));
    let name = |node: &Node, topic: &str| {
        let status = node.status();
        let routes = status["routes"].as_array().unwrap().clone();
        routes.into_iter().find(|r| r["topic"] == topic).map(|r| r["name"].clone())
    };
    let before = name(&robot, "/a/kept");
    let made = || {
        let reader = trio.robot_net.guids("rt/a/kept", EndpointKind::Reader);
        (reader, trio.desk_net.guids("rt/a/kept", EndpointKind::Writer))
    };
    let ends = made();
    assert_eq!((ends.0.len(), ends.1.len()), (1, 1));
    // Another topic appears, is excluded by a reload, and returns by a rule of its own.
    let other = Talker::new(&trio.robot_net, "/a/other", Qos::default());
    wait("the other", || writers(&trio.desk_net, "/a/other") == 1);
    let (mut said, mut heard) = (0, Vec::new());
    let mut talk = || {
        (0..20).for_each(|_| {
            kept.say(format!("{said}"));
            said += 1;
        });
    };
    talk();
    robot.reload(|config| config.shares[0].naming.except = vec!["/a/other".into()]);
    wait("the other gone", || writers(&trio.desk_net, "/a/other") == 0);
    talk();
    robot.reload(|config| config.shares.push(ShareConfig { suite: Suite::Group, ..share_of("/a/other") }));
    wait("the other again", || writers(&trio.desk_net, "/a/other") == 1);
    talk();
    desk.reload(|config| config.uses[0].topic = "/a/**".into());
    talk();
    let expected: Vec<_> = (0..said).map(|n| Bytes::from(n.to_string())).collect();
    while heard.len() < expected.len() {
        heard.push(listener.samples.recv_timeout(PATIENCE).expect("no gap"));
    }
    assert_eq!(heard, expected);
    assert_eq!((name(&robot, "/a/kept"), made()), (before, ends), "neither name nor endpoint is another");
    drop(other);
    wait("the other gone", || writers(&trio.desk_net, "/a/other") == 0);
    // Under another name it is another topic, and exists only there.
    desk.reload(|config| config.uses[0].naming.rename = Rename::Namespace("/r".into()));
    wait("the new name", || {
        (writers(&trio.desk_net, "/r/a/kept"), writers(&trio.desk_net, "/a/kept")) == (1, 0)
    });
}
