//! Policies act on the far side as if the publisher were there: deadline, liveliness that is renewed by writing, and
//! partition.

use crate::lab::{Lab, Site};
use crate::{EXCLUSIVE, python};

#[test]
fn a_publisher_that_falls_silent_is_missed_on_the_far_side() {
    let lab = Lab::with_topics(EXCLUSIVE, ["/pulse"]);
    let policies = ["/pulse", "1500", "2500", "left"];
    let mut sub = python(&lab, Site::Desk, "policies.py", &[&["sub"][..], &policies].concat());
    // Another partition, another deadline: it must not be heard, and it is said why.
    let mut elsewhere = python(&lab, Site::Desk, "policies.py", &["sub", "/pulse", "1000", "2500", "right"]);
    for peer in [&mut sub, &mut elsewhere] {
        peer.wait("ready", |e| e["event"] == "ready");
    }
    let mut talker = python(&lab, Site::Robot, "policies.py", &[&["pub"][..], &policies].concat());
    for _ in 0..2 {
        sub.wait("a publisher that lives", |e| e["event"] == "liveliness" && e["alive"] == 1);
        for _ in 0..10 {
            sub.wait("its messages", |e| e["event"] == "received");
        }
        talker.go();
        sub.wait("the deadline", |e| e["event"] == "deadline_missed");
        sub.wait("the end of its lease", |e| e["event"] == "liveliness" && e["alive"] == 0);
        talker.go();
    }
    let told: Vec<_> = elsewhere.events.try_iter().map(|(_, e)| e["event"].to_string()).collect();
    assert!(!told.iter().any(|e| e.contains("received") || e.contains("liveliness")), "{told:?}");
    let problems = lab.status(Site::Desk)["problems"].to_string();
    assert!(problems.contains("deadline 1.5s") && problems.contains("asks for 1s"), "{problems}");
    assert!(problems.contains("left") && problems.contains("right"), "{problems}");
    assert!(lab.log(Site::Desk).contains("asks for 1s"), "{}", lab.log(Site::Desk));
}
