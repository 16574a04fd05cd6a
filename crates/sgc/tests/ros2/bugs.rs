//! Faults that users of other bridges suffer from, with programs of ROS 2: each scenario is that of a public report.

use std::collections::BTreeSet;

use std::time::Duration;

use rustix::process::Signal;
use sgc_testkit::netsim::{Direction, Loss, Namespace, Profile, Reorder, TunEnd, TunLink, TunOptions};

use crate::lab::{Lab, Site, robot_to_desk};
use crate::support::{Peer, eventually, say};
use crate::{PAIRS, PLAN, count};

/// Starts a Python program of `tests/peers/ros2`.
fn start(lab: &Lab, site: Site, distribution: &str, program: &str, args: &[&str]) -> Peer {
    let mut command = lab.ros(site, distribution, program);
    command.args(args);
    Peer::start(command)
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #700 and #570: after each restart of a publisher or a bridge, every message is
/// repeated once more.
#[test]
fn subscriber_hears_each_message_once_however_often_publisher_and_nodes_restart() {
    /// Each publisher's numbers begin at its run times this.
    const RUN_NUMBERS: u64 = 100_000;
    let mut lab = Lab::real(PLAN, robot_to_desk("topic", ["/restarts"]));
    for [talks, listens] in PAIRS {
        let topic = ["--topic", "/restarts"];
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &[&["sub"], &topic[..]].concat());
        let mut heard = Vec::new();
        for (run, restarted) in (0..).zip([None, Some(Site::Robot), None, Some(Site::Desk)]) {
            if let Some(site) = restarted {
                lab.kill(site);
                lab.start(site);
            }
            let first = run * RUN_NUMBERS;
            let start_at = first.to_string();
            let args = [&["pub", "--rate", "20", "--start", &start_at], &topic[..]].concat();
            let talker = start(&lab, Site::Robot, talks, "events.py", &args);
            let mut of_run = 0;
            while of_run < 20 {
                let event = listener.wait("a message", |e| e["event"] == "received");
                heard.push(count(&event, "seq"));
                of_run += u64::from(heard.last() >= Some(&first));
            }
            talker.signal(Signal::KILL);
        }
        let follows = |pair: &[u64]| pair[1] == pair[0] + 1 || pair[1] / RUN_NUMBERS > pair[0] / RUN_NUMBERS;
        assert!(heard.windows(2).all(follows), "{talks} to {listens}: {heard:?}");
    }
}

/// A subscriber that is killed acknowledges nothing more, and Fast DDS asks a writer for all that it still keeps.
#[test]
fn late_subscriber_hears_nothing_from_before_it_joined_after_another_was_killed() {
    const EARLY: u64 = 30;
    const LATER: u64 = 10;
    let lab = Lab::real(PLAN, robot_to_desk("topic", PAIRS.map(|[talks, _]| format!("/late_{talks}"))));
    for [talks, listens] in PAIRS {
        let topic = format!("/late_{talks}");
        let of = ["--topic", &topic];
        let hear =
            || start(&lab, Site::Desk, listens, "events.py", &[&["sub", "--depth", "100"], &of[..]].concat());
        let subscribers = |number: u32| {
            let text = format!("Subscribers on the local network: {number}");
            eventually(&text, || lab.asked(Site::Desk, &["topic", "info", &topic]).contains(&text));
        };
        let early = hear();
        subscribers(1);
        early.signal(Signal::KILL);
        // The first one finds the subscriber that `sgc` stands for.
        let args = ["pub", "--rate", "50", "--count", "1"];
        let mut talker = start(&lab, Site::Robot, talks, "events.py", &[&args, &of[..]].concat());
        talker.wait("a subscriber", |e| e["event"] == "matched");
        talker.tell(&(EARLY - 1).to_string());
        eventually("the early messages are written", || {
            let routes = lab.status(Site::Desk)["routes"].take();
            routes
                .as_array()
                .unwrap()
                .iter()
                .any(|r| r["topic"] == *topic && count(r, "messages") >= EARLY - 1)
        });
        let mut late = hear();
        // The killed one counts until its lease ends.
        subscribers(2);
        talker.tell(&LATER.to_string());
        let first = late.wait("a message", |e| e["event"] == "received");
        assert_eq!(count(&first, "seq"), EARLY, "{talks} to {listens}");
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #712: a program that makes and destroys subscriptions costs the bridge gigabytes.
#[test]
fn subscriptions_that_come_and_go_leave_no_memory_behind() {
    const SUBSCRIPTIONS: &str = "300";
    const ROUNDS: usize = 12;
    /// Memory of the process rises by up to 5 MB within the first rounds, and then no more. The leak was 16 bytes for each
    /// subscription of each message about the graph: 1.4 MB for one round, and more than a hundred times that for all.
    const MORE_KB_MAX: u64 = 8_000;
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/churn"]));
    let _talker = start(&lab, Site::Robot, "jazzy", "events.py", &["pub", "--topic", "/churn"]);
    for distribution in ["jazzy", "kilted"] {
        let args = ["subscriptions", "--topic", "/churn", "--count", SUBSCRIPTIONS];
        let mut churn = start(&lab, Site::Desk, distribution, "churn.py", &args);
        let mut resident = Vec::new();
        for _ in 0..ROUNDS {
            churn.wait("all subscriptions", |e| e["event"] == "done");
            resident.push(lab.node(Site::Desk).held().resident_kb);
            churn.go();
        }
        // The first subscriptions fill memory that later ones reuse.
        assert!(resident[ROUNDS - 1] <= resident[1] + MORE_KB_MAX, "{distribution}: {resident:?} KB");
    }
}

/// eclipse-zenoh/zenoh-plugin-ros2dds #690: 13 participants that join at once end `/tf` for good.
#[test]
fn topic_survives_thirteen_participants_that_join_at_once() {
    const PARTICIPANTS: usize = 13;
    let lab = Lab::real(PLAN, robot_to_desk("topic", ["/tf"]));
    for [talks, listens] in PAIRS {
        let _talker =
            start(&lab, Site::Robot, talks, "events.py", &["pub", "--topic", "/tf", "--rate", "50"]);
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &["sub", "--topic", "/tf"]);
        listener.wait("a message", |e| e["event"] == "received");
        let mut crowd = start(&lab, Site::Desk, listens, "churn.py", &["participants", "--topic", "/tf"]);
        let mut hear = BTreeSet::new();
        while hear.len() < PARTICIPANTS {
            let event = crowd.wait("a message for another", |e| e["event"] == "hears");
            hear.insert(count(&event, "number"));
        }
        // The first subscriber still receives new messages.
        let before = listener.events.try_iter().filter_map(|(_, e)| e["seq"].as_u64()).max();
        listener.wait("a later message", |e| e["seq"].as_u64() > before);
    }
}

/// ros2/rmw_zenoh #425: where two distributions have different definitions of a type, topics are silent without a
/// message. Here they flow, as they do natively, and the difference is reported.
#[test]
fn different_definitions_of_a_type_are_named_where_they_meet() {
    let lab = Lab::real(PLAN, robot_to_desk("topic", PAIRS.map(|[talks, _]| format!("/differs_{talks}"))));
    for [talks, listens] in PAIRS {
        let topic = format!("/differs_{talks}");
        let of = ["--topic", &topic];
        let says = |site, text: &str| eventually(text, || lab.why(site, &topic).contains(text));
        let _other = start(&lab, Site::Robot, talks, "features.py", &[&["other"], &of[..]].concat());
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &[&["sub"], &of[..]].concat());
        listener.wait("a message", |e| e["event"] == "received");
        for site in [Site::Desk, Site::Robot] {
            says(site, "✗ the definitions of std_msgs/msg/String differ: ");
        }
        let told = lab.status(Site::Desk)["problems"].to_string();
        assert!(told.contains(&topic) && told.contains("RIHS01_"), "{talks} to {listens}: {told}");
        let _talker = start(&lab, Site::Robot, talks, "events.py", &[&["pub"], &of[..]].concat());
        says(Site::Robot, "✗ local publishers have different definitions of std_msgs/msg/String: ");
    }
}

/// Joins two namespaces by a bad path.
fn bad_way(robot: &Namespace, cloud: &Namespace) -> TunLink {
    let profile = Profile {
        delay: Duration::from_millis(20),
        jitter: Duration::from_millis(5),
        loss: Loss::Random(0.05),
        reorder: Reorder { share: 0.05, by: Duration::from_millis(10) },
        duplicate: 0.02,
        ..Profile::default()
    };
    let end = |namespace: &Namespace, address: &str| TunEnd {
        namespace: Some(namespace.name().to_owned()),
        interface: "radio".into(),
        addresses: vec![address.into()],
        routes: Vec::new(),
    };
    let ends = [end(robot, "10.94.1.2/24"), end(cloud, "10.94.1.1/24")];
    TunLink::start(ends, &TunOptions { profiles: [profile; 2], ..TunOptions::default() }).unwrap()
}

/// eProsima/DDS-Router #397: over a bad network reliable messages are lost. The path loses, delays, repeats and
/// reorders packets, and is cut for some seconds.
#[test]
fn reliable_messages_arrive_once_and_in_order_over_a_bad_network() {
    const CUT: Duration = Duration::from_secs(3);
    let mut lab =
        Lab::silent(PLAN, robot_to_desk("topic", PAIRS.map(|[talks, _]| format!("/radio_{talks}"))));
    let (Some(robot), Some(cloud)) = (lab.namespace(Site::Robot), lab.namespace(Site::Cloud)) else {
        return say("no namespaces, no bad network between them: nothing is shown");
    };
    let way = bad_way(robot, cloud);
    lab.reconfigure(Site::Robot, "quic://10.92.1.1", "quic://10.94.1.1");
    for site in [Site::Robot, Site::Desk] {
        lab.reconfigure(site, "discovery_range = \"localhost\"", "discovery_range = \"subnet\"");
    }
    lab.start_all();
    for [talks, listens] in PAIRS {
        let topic = format!("/radio_{talks}");
        let of = ["--topic", &topic, "--depth", "1000"];
        let mut listener = start(&lab, Site::Desk, listens, "events.py", &[&["sub"], &of[..]].concat());
        let args = [&["pub", "--rate", "100"], &of[..]].concat();
        let _talker = start(&lab, Site::Robot, talks, "events.py", &args);
        let mut heard = Vec::new();
        let mut hear = |messages: usize| {
            for _ in 0..messages {
                let event = listener.wait("a message", |e| e["event"] == "received");
                heard.push(count(&event, "seq"));
            }
            heard.len()
        };
        hear(200);
        way.cut();
        std::thread::sleep(CUT);
        way.restore();
        hear(500);
        assert!(heard.windows(2).all(|pair| pair[1] == pair[0] + 1), "{talks} to {listens}: {heard:?}");
    }
    for direction in Direction::BOTH {
        let counters = way.counters(direction);
        assert!(
            [counters.lost, counters.duplicated, counters.reordered, counters.cut].iter().all(|n| *n > 0),
            "{counters:?}"
        );
    }
}
