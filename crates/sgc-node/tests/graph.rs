//! The ROS graph over whole nodes: local networks in memory with ROS 2 nodes, and the far nodes that are shown there.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use lab::{Lab, share, uses};
use sgc_ros::{EndpointKind, GraphNode, Guid, RosNetwork, RosWriter};
use sgc_testkit::{FakeDomain, FakeReader, FakeRos, FakeWriter};
use sgc_wire::{CONSUMERS_PER_INTERFACE_MAX, Qos, Reliability, RosNode};
use support::*;

/// A participant with one ROS 2 node of this name, which has a reader of a topic.
struct ListeningProcess {
    net: FakeRos,
    reader: FakeReader,
}

impl ListeningProcess {
    fn new(domain: &FakeDomain, node: &str, topic: &str) -> Self {
        let net = domain.join(false);
        let reader =
            net.create_reader(&spec(topic, Qos::default()), Box::new(|_: sgc_ros::Sample| {})).unwrap();
        let process = Self { net, reader };
        process.is_called(node);
        process
    }

    fn is_called(&self, node: &str) {
        let node = RosNode::new("/desk", node, None).unwrap();
        self.net.announce(&[GraphNode { node, readers: vec![self.reader.guid()], writers: vec![] }]).unwrap();
    }
}

/// Waits until the proxies on a network announce exactly these nodes, with these numbers of readers and writers.
fn shows_ends(net: &FakeDomain, expected: &[(&str, usize, usize)]) {
    let expected: Vec<_> =
        expected.iter().map(|(node, readers, writers)| ((*node).to_owned(), *readers, *writers)).collect();
    let deadline = std::time::Instant::now() + PATIENCE;
    while net.mirrored() != expected {
        assert!(std::time::Instant::now() < deadline, "{:?} instead of {expected:?}", net.mirrored());
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

/// A participant with one ROS 2 node of this name, which has a writer on each topic.
struct RosProcess {
    net: FakeRos,
    writers: Vec<FakeWriter>,
}

impl RosProcess {
    fn new(domain: &FakeDomain, node: &str, topics: &[&str]) -> Self {
        let net = domain.join(false);
        let create = |topic: &&str| net.create_writer(&spec(topic, Qos::default())).unwrap();
        let process = Self { writers: topics.iter().map(create).collect(), net };
        process.is_called(node);
        process
    }

    fn is_called(&self, node: &str) {
        let writers: Vec<Guid> = self.writers.iter().map(|w| w.guid()).collect();
        let node = RosNode::new("/robot", node, None).unwrap();
        self.net.announce(&[GraphNode { node, readers: vec![], writers }]).unwrap();
    }
}

/// Waits until the proxies on a network announce exactly these nodes, with these numbers of writers.
fn shows(net: &FakeDomain, expected: &[(&str, usize)]) {
    let shown = || net.mirrored().into_iter().map(|(node, _, writers)| (node, writers)).collect::<Vec<_>>();
    let expected: Vec<_> = expected.iter().map(|(node, writers)| ((*node).to_owned(), *writers)).collect();
    let deadline = std::time::Instant::now() + PATIENCE;
    while shown() != expected {
        assert!(std::time::Instant::now() < deadline, "{:?} instead of {expected:?}", shown());
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

#[test]
fn far_nodes_appear_with_what_is_shared_of_them_and_vanish() {
    let trio = Trio::new();
    let (_cloud, _robot) = (trio.cloud(), trio.robot(&["/a", "/b"], "desk"));
    let _desk = trio.desk(&["/a", "/b"]);
    let net = &trio.desk_net;
    shows(net, &[("/sgc_desk", 0)]);
    let talker = RosProcess::new(&trio.robot_net, "talker", &["/a", "/b", "/private"]);
    let _hidden = RosProcess::new(&trio.robot_net, "hidden", &["/other"]);
    shows(net, &[("/robot/talker", 2), ("/sgc_desk", 0)]);
    let second = RosProcess::new(&trio.robot_net, "second", &["/b"]);
    shows(net, &[("/robot/second", 1), ("/robot/talker", 2), ("/sgc_desk", 0)]);
    // Under another name, it is another node with the same writers.
    second.is_called("renamed");
    shows(net, &[("/robot/renamed", 1), ("/robot/talker", 2), ("/sgc_desk", 0)]);
    assert_eq!((writers(net, "/a"), writers(net, "/b"), writers(net, "/other")), (1, 2, 0));
    // The robot's own proxy stands for no far node, and has its readers.
    shows(&trio.robot_net, &[("/sgc_robot", 0)]);
    drop(talker);
    shows(net, &[("/robot/renamed", 1), ("/sgc_desk", 0)]);
    drop(second);
    shows(net, &[("/sgc_desk", 0)]);
    wait("no writers", || writers(net, "/a") + writers(net, "/b") == 0);
}

#[test]
fn a_restarted_publisher_keeps_its_writer_and_is_heard_once() {
    let trio = Trio::new();
    let (_cloud, _robot, _desk) = (trio.cloud(), trio.robot(&["/a"], "desk"), trio.desk(&["/a"]));
    let listener = Listener::new(&trio.desk_net, "/a", Qos::default());
    let first = RosProcess::new(&trio.robot_net, "talker", &["/a"]);
    let writer = &first.writers[0];
    let say = |writer: &FakeWriter, text: String| {
        writer.write(sgc_ros::SampleKind::Write, 1, text.into()).unwrap();
    };
    wait("the robot reads", || writer.matched_readers() == 1);
    listener.hears_at_last(|n| say(writer, format!("warm {n}")));
    say(writer, "end".into());
    wait("the end", || listener.drain().last().is_some_and(|b| b == "end"));
    drop(first);
    // The talker returns at once, and its first message arrives, since its writer at the desk still has its readers.
    for round in 0..5 {
        let again = RosProcess::new(&trio.robot_net, "talker", &["/a"]);
        say(&again.writers[0], format!("round {round}"));
        listener.hears(format!("round {round}"));
        assert_eq!(writers(&trio.desk_net, "/a"), 1);
    }
    shows(&trio.desk_net, &[("/sgc_desk", 0)]);
    listener.hears_nothing();
}

#[test]
fn no_restart_leaves_a_ghost() {
    let trio = Trio::new();
    let (mut cloud, mut robot) = (trio.cloud(), trio.robot(&["/a"], "desk"));
    let mut desk = trio.desk(&["/a"]);
    let _talkers = ["one", "two"].map(|node| RosProcess::new(&trio.robot_net, node, &["/a"]));
    let both = [("/robot/one", 1), ("/robot/two", 1), ("/sgc_desk", 0)];
    shows(&trio.desk_net, &both);
    cloud.kill();
    cloud = trio.cloud();
    shows(&trio.desk_net, &both);
    desk.stop();
    shows(&trio.desk_net, &[]);
    desk = trio.desk(&["/a"]);
    shows(&trio.desk_net, &both);
    robot.kill();
    robot = trio.robot(&["/a"], "desk");
    // The sources have changed.
    shows(&trio.desk_net, &both);
    wait("two writers", || writers(&trio.desk_net, "/a") == 2);
    robot.stop();
    shows(&trio.desk_net, &[("/sgc_desk", 0)]);
    wait("no writer", || writers(&trio.desk_net, "/a") == 0);
    drop((cloud, desk));
}

#[test]
fn every_publisher_has_its_own_qos_and_others_may_publish_beside() {
    let lab = Lab::new(&["robot", "desk", "watch"]);
    let _cloud = lab.cloud();
    let _robot = lab.start("robot", |config| {
        let mut cmd = share("/cmd", &["watch"]);
        cmd.publish = lab::nodes(&["desk"]);
        cmd.type_name = Some("std_msgs/msg/String".into());
        config.shares = vec![cmd, share("/a", &["watch"])];
    });
    let _watch = lab.start("watch", |config| config.uses = vec![uses("/cmd"), uses("/a")]);
    let _desk = lab.start("desk", |config| {
        config.uses = vec![uses("/cmd")];
        config.uses[0].publish = true;
    });
    let (robot, desk, watch) = (lab.net("robot"), lab.net("desk"), lab.net("watch"));
    let own = Talker::new(&robot, "/cmd", Qos::default());
    let theirs = Talker::new(&desk, "/cmd", Qos::default());
    let listener = Listener::new(&watch, "/cmd", Qos::default());
    for talker in [&own, &theirs] {
        wait("a reader", || talker.writer.matched_readers() > 0);
        listener.hears_at_last(|n| talker.say(format!("warm {n}")));
    }
    wait("a writer for each", || writers(&watch, "/cmd") == 2);
    // A publisher that offers less than a subscriber requests does not match; its neighbour does.
    let strict = Qos { deadline_ns: Some(1_000_000_000), ..Qos::default() };
    let (_strict, _lax) = (Talker::new(&robot, "/a", strict), Talker::new(&robot, "/a", Qos::default()));
    wait("two writers", || writers(&watch, "/a") == 2);
    let offered = watch.offers("rt/a");
    assert!(offered.iter().any(|qos| qos.deadline_ns == Some(1_000_000_000)), "{offered:?}");
    assert!(offered.iter().any(|qos| qos.deadline_ns.is_none()), "{offered:?}");
    assert!(offered.iter().all(|qos| qos.reliability == Reliability::Reliable), "{offered:?}");
    assert_eq!(watch.count("rt/a", EndpointKind::Reader), 0);
}

#[test]
fn subscribers_of_a_shared_topic_appear_at_its_owner_and_vanish() {
    let trio = Trio::new();
    let (_cloud, _robot) = (trio.cloud(), trio.robot(&["/a", "/b"], "desk"));
    let mut desk = trio.desk(&["/a"]);
    let _talker = RosProcess::new(&trio.robot_net, "talker", &["/a", "/b"]);
    let net = &trio.robot_net;
    let view = ListeningProcess::new(&trio.desk_net, "view", "/a");
    let _private = ListeningProcess::new(&trio.desk_net, "private", "/other");
    let _unused = ListeningProcess::new(&trio.desk_net, "unused", "/b");
    shows_ends(net, &[("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    let recorder = ListeningProcess::new(&trio.desk_net, "recorder", "/a");
    shows_ends(net, &[("/desk/recorder", 1, 0), ("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    // One reader takes the messages, and an endpoint stays when its node is renamed.
    assert_eq!(net.count("rt/a", EndpointKind::Reader), 1);
    let shown = net.guids("shown:rt/a", EndpointKind::Reader);
    recorder.is_called("renamed");
    shows_ends(net, &[("/desk/renamed", 1, 0), ("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    assert_eq!(net.guids("shown:rt/a", EndpointKind::Reader), shown);
    let gone = std::time::Instant::now();
    drop(recorder);
    shows_ends(net, &[("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    assert!(gone.elapsed() < std::time::Duration::from_secs(1), "{:?}", gone.elapsed());
    // A node that stops orderly takes its subscribers with it, and shows them again when it returns.
    desk.stop();
    shows_ends(net, &[("/sgc_robot", 1, 0)]);
    desk = trio.desk(&["/a"]);
    shows_ends(net, &[("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    // Consumers of a removed use are no longer announced.
    desk.reload(|config| config.uses.clear());
    shows_ends(net, &[("/sgc_robot", 1, 0)]);
    drop(view);
}

#[test]
fn publishers_of_others_on_a_shared_topic_appear_at_its_owner_as_many_as_they_are() {
    let lab = Lab::new(&["robot", "desk"]);
    let _cloud = lab.cloud();
    let _robot = lab.start("robot", |config| {
        let mut cmd = share("/cmd", &["desk"]);
        cmd.publish = lab::nodes(&["desk"]);
        cmd.type_name = Some("std_msgs/msg/String".into());
        config.shares = vec![cmd];
    });
    let _desk = lab.start("desk", |config| {
        config.uses = vec![uses("/cmd")];
        config.uses[0].publish = true;
    });
    let (robot, desk) = (lab.net("robot"), lab.net("desk"));
    let counts = || (writers(&robot, "/cmd"), robot.count("shown:rt/cmd", EndpointKind::Writer));
    wait("a writer for what others publish", || counts() == (1, 0));
    shows(&robot, &[("/sgc_robot", 1)]);
    let teleop = RosProcess::new(&desk, "teleop", &["/cmd", "/private"]);
    shows(&robot, &[("/robot/teleop", 1), ("/sgc_robot", 0)]);
    assert_eq!(counts(), (1, 0));
    let second = RosProcess::new(&desk, "second", &["/cmd"]);
    shows(&robot, &[("/robot/second", 1), ("/robot/teleop", 1), ("/sgc_robot", 0)]);
    assert_eq!(counts(), (1, 1), "one writer has the messages of both");
    drop(teleop);
    shows(&robot, &[("/robot/second", 1), ("/sgc_robot", 0)]);
    wait("the writer that is left is the real one", || counts() == (1, 0));
    drop(second);
    shows(&robot, &[("/sgc_robot", 1)]);
}

#[test]
fn subscribers_of_a_node_that_is_lost_go_after_a_while_and_a_restarted_router_changes_nothing() {
    let trio = Trio::new();
    let (mut cloud, _robot, desk) = (trio.cloud(), trio.robot(&["/a"], "desk"), trio.desk(&["/a"]));
    let _talker = RosProcess::new(&trio.robot_net, "talker", &["/a"]);
    let _view = ListeningProcess::new(&trio.desk_net, "view", "/a");
    let net = &trio.robot_net;
    let both = [("/desk/view", 1, 0), ("/sgc_robot", 1, 0)];
    shows_ends(net, &both);
    let shown = net.guids("shown:rt/a", EndpointKind::Reader);
    cloud.kill();
    cloud = trio.cloud();
    let again = ListeningProcess::new(&trio.desk_net, "again", "/a");
    shows_ends(net, &[("/desk/again", 1, 0), ("/desk/view", 1, 0), ("/sgc_robot", 1, 0)]);
    assert!(net.guids("shown:rt/a", EndpointKind::Reader).contains(&shown[0]));
    drop(again);
    shows_ends(net, &both);
    desk.kill();
    wait("no subscriber is shown", || net.count("shown:rt/a", EndpointKind::Reader) == 0);
    drop(cloud);
}

#[test]
fn subscribers_beyond_the_bound_are_counted_and_not_shown() {
    let trio = Trio::new();
    let (_cloud, _robot, desk) = (trio.cloud(), trio.robot(&["/a"], "desk"), trio.desk(&["/a"]));
    let _talker = RosProcess::new(&trio.robot_net, "talker", &["/a"]);
    let nodes: Vec<_> = (0..CONSUMERS_PER_INTERFACE_MAX + 2).map(|n| format!("n{n}")).collect();
    let _views: Vec<_> = nodes.iter().map(|node| ListeningProcess::new(&trio.desk_net, node, "/a")).collect();
    let shown = || trio.robot_net.count("shown:rt/a", EndpointKind::Reader);
    wait("as many as are shown", || shown() == CONSUMERS_PER_INTERFACE_MAX);
    wait("those beyond are counted", || desk.drops("consumers_untold") == 2);
    assert_eq!(shown(), CONSUMERS_PER_INTERFACE_MAX);
}
