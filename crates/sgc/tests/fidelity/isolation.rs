//! Nothing that is not shared crosses in either direction, discovery included, whatever the other side asks for.

use crate::PLAN;
use crate::lab::{self, Lab, Site};
use crate::observer::Observer;
use crate::support::{Peer, eventually};

fn talker(lab: &Lab, site: Site, topic: &str) -> Peer {
    let args = ["--type", "string", "--topic", topic, "--rate", "20", "--wait-matched", "0"];
    lab.peer(site, "cyclone", "pub", &args)
}

#[test]
fn a_network_shows_what_is_used_and_nothing_else() {
    // Shares with this desk, with another node and with none; the desk uses all but one of its own.
    let share = |topic: &str, to: &str| lab::share("topic", topic, to);
    let robot = share("/used", "desk") + &share("/unused", "desk") + &share("/others", "somebody");
    // The desk asks for all of them, and to publish on a topic to which it may only subscribe.
    let uses = |topic: &str| lab::uses("topic", topic, "robot");
    let publish = |topic: &str| uses(topic) + "publish = true\n";
    let desk =
        uses("/used") + &uses("/others") + &uses("/secret") + &publish("/unused") + &publish("/command");
    let lab = Lab::new(PLAN, [robot, desk]);
    let mut observers = [Site::Robot, Site::Desk].map(|site| Observer::start(&lab, site));
    let _robots = ["/used", "/unused", "/others", "/secret"].map(|topic| talker(&lab, Site::Robot, topic));
    let _desks = ["/unused", "/command", "/private"].map(|topic| talker(&lab, Site::Desk, topic));
    let heard = ["--type", "string", "--topic", "/used", "--verbose"];
    let mut listener = lab.peer(Site::Desk, "fastdds", "sub", &heard);
    for _ in 0..20 {
        listener.wait("what is shared and used", |e| e["event"] == "received");
    }
    let refused = "does not";
    eventually("the desk is told of the rest", || {
        let routes = lab.status(Site::Desk)["routes"].as_array().cloned().unwrap_or_default();
        let told = |topic: &str| {
            let of_topic = |r: &&serde_json::Value| r["topic"] == topic;
            routes.iter().find(of_topic).is_some_and(|r| r["state"].as_str().unwrap().contains(refused))
        };
        ["/others", "/secret", "/unused", "/command"].into_iter().all(told)
    });
    // The robot's network has its own publishers, and one reader of sgc for the topic in use.
    let expected =
        ["reader rt/used", "writer rt/others", "writer rt/secret", "writer rt/unused", "writer rt/used"];
    assert_eq!(observers[0].endpoints(), expected);
    // The desk's network has its own programs, and one writer of sgc.
    let expected =
        ["reader rt/used", "writer rt/command", "writer rt/private", "writer rt/unused", "writer rt/used"];
    assert_eq!(observers[1].endpoints(), expected);
    // No other name leaves the robot's node, apart from answers to questions.
    eventually("the topic's name, and the robot's catalogue", || {
        lab.status(Site::Cloud)["names"].as_array().unwrap().len() <= 2
    });
    let robot = lab.status(Site::Robot);
    let messages = |topic: &str| {
        let routes = robot["routes"].as_array().unwrap();
        routes.iter().find(|r| r["topic"] == topic).unwrap()["messages"].as_u64().unwrap()
    };
    assert!(messages("/used") > 0, "{robot}");
    assert_eq!([messages("/unused"), messages("/others")], [0, 0], "not even read");
}
