//! Compressed topics across whole nodes, for present subscribers and late joiners.

#![allow(clippy::unwrap_used)]

mod support;

use sgc_ros::Shaping;
use sgc_trust::Suite;
use sgc_wire::{PayloadEncoding, Qos};
use support::*;

fn text(n: usize, bytes: usize) -> Vec<u8> {
    format!("message {n}, ").into_bytes().into_iter().cycle().take(bytes).collect()
}

fn compressed(node: &Node, topic: &str) -> Option<(u64, u64)> {
    let routes = node.status()["routes"].as_array().unwrap().clone();
    let route = routes.into_iter().find(|route| route["topic"] == topic)?;
    Some((route["compressed"][0].as_u64()?, route["compressed"][1].as_u64()?))
}

#[test]
fn compressed_messages_arrive_unchanged_also_for_late_joiners() {
    for (encoding, suite) in [(PayloadEncoding::Zstd, Suite::Group), (PayloadEncoding::Lz4, Suite::Standard)]
    {
        let trio = Trio::new();
        let (_cloud, robot) = (trio.cloud(), trio.robot_in(suite, &["/map", "/text"], "desk"));
        let compress = |encoding| Shaping { compression: encoding, ..Shaping::default() };
        robot.reload(|config| config.shares.iter_mut().for_each(|share| share.shaping = compress(encoding)));
        let desk = trio.desk(&["/map", "/text"]);
        let map = Talker::new(&trio.robot_net, "/map", latched());
        let text_talker = Talker::new(&trio.robot_net, "/text", Qos::default());
        // This is published before any far subscriber exists.
        map.wait_for_readers(1);
        map.say(text(0, 500_000));
        let listener = Listener::new(&trio.desk_net, "/text", Qos::default());
        text_talker.wait_for_readers(1);
        listener.hears_at_last(|_| text_talker.say("short"));
        let sizes = [3, 255, 256, 20_000, 1_000_000, 40];
        for (n, bytes) in sizes.into_iter().enumerate() {
            text_talker.say(text(n, bytes));
        }
        for (n, bytes) in sizes.into_iter().enumerate() {
            let expected = text(n, bytes);
            let heard = loop {
                let heard = listener.samples.recv_timeout(PATIENCE).unwrap();
                if heard != "short" {
                    break heard;
                }
            };
            assert!(heard == expected, "{n}: {} bytes", heard.len());
        }
        for _ in 0..2 {
            Listener::new(&trio.desk_net, "/map", latched()).hears(text(0, 500_000));
        }
        let (before, after) = compressed(&robot, "/map").unwrap();
        assert!(before == 500_000 && after < before / 10, "{before} {after}");
        let (before, after) = compressed(&robot, "/text").unwrap();
        assert!(before >= 1_020_000 && after < before / 10, "{before} {after}");
        // Compression stops at once, and kept compressed messages still arrive.
        robot.reload(|config| config.shares.iter_mut().for_each(|share| share.shaping = Shaping::default()));
        text_talker.say(text(9, 5000));
        listener.hears(text(9, 5000));
        assert_eq!(compressed(&robot, "/text"), Some((before, after)));
        Listener::new(&trio.desk_net, "/map", latched()).hears(text(0, 500_000));
        assert_eq!(desk.status()["drops"]["decompress"], serde_json::Value::Null);
    }
}

#[test]
fn far_publisher_compresses_too() {
    let trio = Trio::new();
    let robot = trio.robot(&["/cmd"], "desk");
    robot.reload(|config| {
        config.shares[0].publish = vec!["desk".parse().map(sgc_node::config::Recipient::Node).unwrap()];
        config.shares[0].type_name = Some("std_msgs/msg/String".into());
    });
    let (_cloud, desk) = (trio.cloud(), trio.desk(&["/cmd"]));
    desk.reload(|config| {
        config.uses[0].publish = true;
        config.uses[0].shaping.compression = PayloadEncoding::Zstd;
    });
    let talker = Talker::new(&trio.desk_net, "/cmd", Qos::default());
    let listener = Listener::new(&trio.robot_net, "/cmd", Qos::default());
    listener.hears_at_last(|_| talker.say(text(1, 10_000)));
    wait("the count", || compressed(&desk, "/cmd").is_some_and(|(before, after)| after < before / 10));
}
