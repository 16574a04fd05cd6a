//! Topics with lanes.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[path = "support/lab.rs"]
mod lab;
mod support;

use std::cell::Cell;

use lab::*;
use sgc_node::config::ShareConfig;
use support::{Listener, Node, Talker, wait};

fn lanes(node: &Node) -> u64 {
    let status = node.status();
    status["links"].as_array().unwrap().iter().map(|link| link["lanes"].as_u64().unwrap()).sum()
}

fn bulk_lanes(node: &Node) -> u64 {
    let status = node.status();
    status["links"].as_array().unwrap().iter().map(|link| link["bulk_lanes"].as_u64().unwrap()).sum()
}

fn sent_bytes(node: &Node) -> u64 {
    let status = node.status();
    status["links"].as_array().unwrap().iter().map(|link| link["sent_bytes"].as_u64().unwrap()).sum()
}

fn port_of(url: &str) -> u16 {
    url.rsplit(':').next().unwrap().parse().unwrap()
}

/// Length of a large message.
const LARGE_BYTES: usize = 512 << 10;

/// A topic of large messages, the numbers from 1 on.
struct Camera {
    talker: Talker,
    listener: Listener,
    next: Cell<u64>,
}

impl Camera {
    /// Waits until the path from the robot to the desk exists.
    fn start(lab: &Lab) -> Self {
        let (talker, listener) = (lab.talker("robot", "/camera"), lab.listener("desk", "/camera"));
        warm_up(&talker, &[&listener]);
        Self { talker, listener, next: Cell::new(1) }
    }

    /// Publishes messages at once, and checks that each arrives once and in order.
    fn exchange(&self, messages: u64) {
        let (first, end) = (self.next.get(), self.next.get() + messages);
        for n in first..end {
            self.talker.say(format!("{}{n:09}", "0".repeat(LARGE_BYTES - 9)));
        }
        hears_each(&self.listener, first, end - 1);
        self.next.set(end);
    }
}

fn dedicated(topic: &str) -> ShareConfig {
    ShareConfig { dedicated: true, ..share(topic, &["desk"]) }
}

/// Starts a stream once the path exists.
fn begin_stream(lab: &Lab, topic: &str, listener: &Listener) -> Stream {
    let talker = lab.talker("robot", topic);
    warm_up(&talker, &[listener]);
    Stream::start(talker)
}

#[test]
fn a_dedicated_topic_is_carried_by_a_lane_and_the_others_are_not() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![dedicated("/video"), share("/state", &["desk"])]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/video"), uses("/state")]);
    let (video, state) = (lab.listener("desk", "/video"), lab.listener("desk", "/state"));
    let video_stream = begin_stream(&lab, "/video", &video);
    let state_stream = begin_stream(&lab, "/state", &state);
    wait("a lane is up at both ends", || lanes(&robot) == 1 && lanes(&cloud) == 1);
    video_stream.more(200);
    assert_eq!(lanes(&desk), 0, "it did not ask for one");
    for (stream, listener) in [(video_stream, video), (state_stream, state)] {
        hears_each(&listener, 1, stream.end().1);
    }
}

#[test]
fn a_subscriber_has_its_own_lane_and_both_ends_may_want_one() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![dedicated("/video")]);
    let mut wish = uses("/video");
    wish.dedicated = true;
    let desk = lab.start("desk", |c| c.uses = vec![wish]);
    let listener = lab.listener("desk", "/video");
    let stream = begin_stream(&lab, "/video", &listener);
    wait("lanes are up", || lanes(&robot) == 1 && lanes(&desk) == 1 && lanes(&cloud) == 2);
    stream.more(200);
    hears_each(&listener, 1, stream.end().1);
}

#[test]
fn a_router_that_restarts_gets_its_lane_again_and_nothing_is_lost() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![dedicated("/video")]);
    let _desk = lab.start("desk", |c| c.uses = vec![uses("/video")]);
    let listener = lab.listener("desk", "/video");
    let stream = begin_stream(&lab, "/video", &listener);
    wait("a lane is up", || lanes(&robot) == 1);
    stream.more(100);
    cloud.stop();
    wait("the lane is gone with its link", || lanes(&robot) == 0);
    let cloud = lab.cloud();
    wait("a lane is up again", || lanes(&robot) == 1 && lanes(&cloud) == 1);
    stream.more(100);
    hears_each(&listener, 1, stream.end().1);
}

#[test]
fn a_topic_that_ends_takes_its_lane_along() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![dedicated("/video")]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/video")]);
    let listener = lab.listener("desk", "/video");
    let talker = lab.talker("robot", "/video");
    wait("a lane is up", || lanes(&robot) == 1 && lanes(&cloud) == 1);
    desk.stop();
    drop(listener);
    wait("nobody wants the topic", || lanes(&robot) == 0 && lanes(&cloud) == 0);
    drop(talker);
}

#[test]
fn no_more_lanes_than_there_may_be() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let topics: Vec<_> = (0..10).map(|n| format!("/camera{n}")).collect();
    let robot = lab.start("robot", |c| c.shares = topics.iter().map(|topic| dedicated(topic)).collect());
    let _desk = lab.start("desk", |c| c.uses = topics.iter().map(|topic| uses(topic)).collect());
    let listeners: Vec<_> = topics.iter().map(|topic| lab.listener("desk", topic)).collect();
    let talkers: Vec<_> = topics.iter().map(|topic| lab.talker("robot", topic)).collect();
    wait("as many lanes as there may be", || lanes(&robot) == 8 && lanes(&cloud) == 8);
    for (talker, listener) in talkers.iter().zip(&listeners) {
        warm_up(talker, &[listener]);
    }
    assert_eq!((lanes(&robot), lanes(&cloud)), (8, 8));
}

#[test]
fn large_topic_takes_a_bulk_lane_on_each_link_and_a_short_one_does_not() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let shares = vec![share("/camera", &["desk"]), share("/state", &["desk"])];
    let robot = lab.start("robot", |c| c.shares = shares);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/camera"), uses("/state")]);
    let state = lab.listener("desk", "/state");
    let state_stream = begin_stream(&lab, "/state", &state);
    let camera = Camera::start(&lab);
    wait("bulk lanes are up", || {
        camera.exchange(10);
        (bulk_lanes(&robot), bulk_lanes(&desk), bulk_lanes(&cloud)) == (1, 1, 2)
    });
    assert_eq!((lanes(&robot), lanes(&desk)), (1, 1), "the short topic has none");
    let before = sent_bytes(&robot);
    camera.exchange(20);
    let sent = sent_bytes(&robot) - before;
    assert!(sent > 20 * LARGE_BYTES as u64, "bytes of a lane count as bytes of its link");
    hears_each(&state, 1, state_stream.end().1);
}

#[test]
fn large_topic_outlives_its_bulk_lane_and_its_router() {
    let lab = Lab::new(&["robot", "desk"]);
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![share("/camera", &["desk"])]);
    let _desk = lab.start("desk", |c| c.uses = vec![uses("/camera")]);
    let camera = Camera::start(&lab);
    wait("a bulk lane is up", || {
        camera.exchange(10);
        bulk_lanes(&robot) == 1
    });
    cloud.kill();
    let cloud = lab.cloud();
    wait("bulk lanes are up again", || {
        camera.exchange(10);
        bulk_lanes(&robot) == 1 && bulk_lanes(&cloud) == 2
    });
}

#[test]
fn large_topic_stays_on_its_link_where_bulk_lanes_are_off_or_their_port_is_taken() {
    let lab = Lab::new(&["robot", "desk"]);
    // Another program has the TCP port of the router's number.
    let _taken = std::net::TcpListener::bind(("127.0.0.1", port_of(&lab.url()))).unwrap();
    let cloud = lab.cloud();
    let robot = lab.start("robot", |c| c.shares = vec![share("/camera", &["desk"])]);
    let _desk = lab.start("desk", |c| {
        c.uses = vec![uses("/camera")];
        c.transport.bulk_lanes = false;
    });
    let camera = Camera::start(&lab);
    for _ in 0..6 {
        camera.exchange(10);
    }
    assert_eq!((lanes(&robot), lanes(&cloud)), (0, 0));
}
