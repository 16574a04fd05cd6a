//! Images go to a subscriber that stalls, and to a node that stalls. Memory stays bounded everywhere, other topics flow
//! on, and a subscriber that resumes gets new images.
//!
//! `SGC_STALL_SECONDS` is how long the subscriber stands still (`make stall`: ten minutes). A node stands still for
//! less than the leases of DDS: after ten minutes all was with its writers at once, but the Fast DDS program beside it
//! had not found them again a minute later.

use std::time::{Duration, Instant};

use rustix::process::Signal;

use crate::EXCLUSIVE;
use crate::lab::{Lab, SITES, Site};
use crate::support::{PATIENCE, Peer, environment, say};

const SECONDS: u64 = 6;
const NODE_SECONDS_MAX: u64 = 8;
/// Bound of a node's additional memory: a topic passes three queues or histories per node, each of at most 64 MiB.
const RESIDENT_MORE_KB_MAX: u64 = 200_000;
const IMAGE_BYTES: &str = "1000000";
const IMAGES_PER_S: &str = "30";

/// Returns the last number that a program reported.
fn last(peer: &Peer, before: u64) -> u64 {
    peer.events.try_iter().filter_map(|(_, e)| e["seq"].as_u64()).max().unwrap_or(0).max(before)
}

struct Stall {
    lab: Lab,
    camera: Peer,
    state: Peer,
    images: Peer,
    states: Peer,
    before: [u64; 3],
}

impl Stall {
    fn new() -> Self {
        let lab = Lab::with_topics(EXCLUSIVE, ["/image", "/string"]);
        let of = |kind: &'static str, topic: &'static str| {
            ["--type", kind, "--topic", topic, "--verbose", "--large"]
        };
        let rate = |rate: &'static str| ["--wait-matched", "0", "--rate", rate];
        let image = [&of("image", "/image")[..], &rate(IMAGES_PER_S), &["--size", IMAGE_BYTES]].concat();
        let mut images = lab.peer(Site::Desk, "cyclone", "sub", &of("image", "/image"));
        // Deeper than what is said while a node stands still: else a reader that is slow to acknowledge, on a busy
        // machine, may see some of it overwritten, as it may without us.
        let deep = ["--depth", "400"];
        let states = [&of("string", "/string")[..], &deep].concat();
        let mut states = lab.peer(Site::Desk, "fastdds", "sub", &states);
        let camera = lab.peer(Site::Robot, "cyclone", "pub", &image);
        let text = [&of("string", "/string")[..], &rate("20"), &deep].concat();
        let state = lab.peer(Site::Robot, "cyclone", "pub", &text);
        for peer in [&mut images, &mut states] {
            for _ in 0..30 {
                peer.wait("what flows", |e| e["event"] == "received");
            }
        }
        let before = SITES.map(|site| lab.node(site).held().resident_kb);
        Self { lab, camera, state, images, states, before }
    }

    /// Samples the memory of all nodes during the stall. Returns the largest increase of each.
    fn endures(&self, seconds: u64) -> [u64; 3] {
        let end = Instant::now() + Duration::from_secs(seconds);
        let mut most = [0; 3];
        while Instant::now() < end {
            for (n, site) in SITES.into_iter().enumerate() {
                let more = self.lab.node(site).held().resident_kb.saturating_sub(self.before[n]);
                assert!(more < RESIDENT_MORE_KB_MAX, "{} holds {more} kB more than before", site.name());
                most[n] = most[n].max(more);
            }
            std::thread::sleep(Duration::from_millis(100));
        }
        most
    }

    /// Waits until messages sent from now on are received.
    fn is_fresh(&mut self) {
        for (talker, listener) in [(&self.camera, &mut self.images), (&self.state, &mut self.states)] {
            let said = last(talker, 0);
            let deadline = Instant::now() + PATIENCE;
            let mut heard = 0;
            while heard <= said {
                assert!(Instant::now() < deadline, "{said} was said, {heard} is the last that was heard");
                heard = last(listener, heard);
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }

    /// Ends the test. The small topic may miss nothing; neither topic may have repeated or altered messages.
    fn ends(mut self) {
        for (listener, loses) in [(&mut self.images, true), (&mut self.states, false)] {
            listener.end();
            let summary = listener.summary();
            let count = |key: &str| summary[key].as_u64().unwrap();
            assert_eq!((count("duplicated"), count("altered")), (0, 0), "{summary}");
            assert!(loses || count("lost") == 0, "{summary}");
        }
    }
}

#[test]
fn a_subscriber_of_images_that_stands_still_harms_nobody_and_goes_on_with_what_is_new() {
    let mut stall = Stall::new();
    stall.images.signal(Signal::STOP);
    let begun = last(&stall.states, 0);
    let most = stall.endures(environment("SGC_STALL_SECONDS", SECONDS));
    // Meanwhile the other topic flowed: what is there was heard before the subscriber goes on.
    assert!(last(&stall.states, 0) > begun, "the other topic stood still, too");
    stall.images.signal(Signal::CONT);
    stall.is_fresh();
    say(&format!("stall of a subscriber: robot, cloud and desk held {most:?} kB more at most"));
    stall.ends();
}

#[test]
fn a_node_that_stands_still_harms_nobody_and_goes_on_with_what_is_new() {
    let mut stall = Stall::new();
    stall.lab.node(Site::Desk).signal(Signal::STOP);
    let most = stall.endures(environment("SGC_STALL_SECONDS", SECONDS).min(NODE_SECONDS_MAX));
    stall.lab.node(Site::Desk).signal(Signal::CONT);
    stall.is_fresh();
    let after = SITES.map(|site| stall.lab.node(site).held().resident_kb);
    say(&format!(
        "stall of a node: robot, cloud and desk held {most:?} kB more at most, {after:?} kB at the end"
    ));
    stall.ends();
}
