//! QoS events: the far side hears of liveliness, deadlines, lifespans and incompatible offers as a subscriber beside
//! the publisher does.

use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::Value;

use crate::lab::{Lab, Plan, Site, robot_to_desk, share, uses};
use crate::support::Peer;
use crate::{EXCLUSIVE, PAIRS, PLAN};

/// Longest additional delay of news through `sgc`, compared with a publisher nearby.
const LATER_MAX: Duration = Duration::from_secs(1);

/// Longest wait for an event that a test expects.
const PATIENCE: Duration = Duration::from_secs(60);

/// Starts `events.py`.
fn start(lab: &Lab, site: Site, distribution: &str, args: &[&str]) -> Peer {
    let mut command = lab.ros(site, distribution, "events.py");
    command.args(args);
    Peer::start(command)
}

/// A publisher and a subscriber of two distributions.
struct Pair {
    name: String,
    talker: Peer,
    listener: Peer,
}

impl Pair {
    /// Starts both programs at these sites.
    fn start(
        lab: &Lab,
        topic: &str,
        sites: [Site; 2],
        [talks, listens]: [&str; 2],
        qos: [&[&str]; 2],
    ) -> Self {
        let listener = start(lab, sites[1], listens, &[&["sub", "--topic", topic][..], qos[1]].concat());
        let talker = start(lab, sites[0], talks, &[&["pub", "--topic", topic][..], qos[0]].concat());
        Self { name: format!("{talks} to {listens} on {topic}"), talker, listener }
    }

    /// Starts four: of each two distributions a pair beside each other at the desk, and one through `sgc`, in this
    /// order.
    fn start_all(lab: &Lab, way: Way, qos: [&[&str]; 2]) -> [[Self; 2]; 2] {
        PAIRS.map(|pair| {
            let near = Self::start(lab, &format!("/native_{}", pair[0]), [Site::Desk; 2], pair, qos);
            [near, Self::start(lab, &format!("/carried_{}", pair[0]), way.sites(), pair, qos)]
        })
    }

    /// Returns the next matching event of the subscriber, and its time.
    fn hears(&self, what: &str, is_it: impl Fn(&Value) -> bool) -> (Instant, Value) {
        let end = Instant::now() + PATIENCE;
        loop {
            let left = end.saturating_duration_since(Instant::now());
            match self.listener.events.recv_timeout(left) {
                Ok((at, event)) if is_it(&event) => return (at, event),
                Ok(_) => {}
                Err(error) => panic!("{}: {what}: {error}", self.name),
            }
        }
    }

    fn hears_alive(&self, alive: u64) -> Instant {
        let what = format!("{alive} living publishers");
        self.hears(&what, |e| e["event"] == "liveliness" && e["alive"] == alive).0
    }

    fn hears_message(&self) -> Instant {
        self.hears("a message", |e| e["event"] == "received").0
    }

    /// Returns all unread reports of the subscriber.
    fn reported(&self) -> Vec<Value> {
        self.listener.events.try_iter().map(|(_, event)| event).collect()
    }
}

/// Asserts that news of the second pair comes no more than [`LATER_MAX`] later than that of the first.
fn assert_as_soon(what: &str, pairs: &[Pair; 2], since: [Instant; 2], at: [Instant; 2]) {
    let [native, carried] = [0, 1].map(|i| at[i].saturating_duration_since(since[i]));
    assert!(
        carried <= native + LATER_MAX,
        "{}: {what} after {carried:?}, {native:?} natively",
        pairs[1].name
    );
}

/// Way of a carried topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    /// From the robot, which shares it.
    FromOwner,
    /// To the robot, which shares it with `publish`.
    ToOwner,
}

impl Way {
    /// The sites of publisher and subscriber.
    fn sites(self) -> [Site; 2] {
        match self {
            Self::FromOwner => [Site::Robot, Site::Desk],
            Self::ToOwner => [Site::Desk, Site::Robot],
        }
    }

    /// A robot and a desk with the topics of [`Pair::start_all`].
    fn lab(self, plan: Plan) -> Lab {
        let topics = PAIRS.map(|[talks, _]| format!("/carried_{talks}"));
        let tables = match self {
            Self::FromOwner => robot_to_desk("topic", topics),
            Self::ToOwner => {
                let rights = "type = \"std_msgs/msg/String\"\npublish = [\"desk\"]\n";
                let shares = topics.each_ref().map(|topic| share("topic", topic, "desk") + rights);
                let uses = topics.each_ref().map(|topic| uses("topic", topic, "robot") + "publish = true\n");
                [shares.concat(), uses.concat()]
            }
        };
        Lab::real(plan, tables)
    }
}

#[test]
fn far_subscriber_hears_of_a_publisher_that_hangs_or_is_killed_as_soon_as_a_near_one() {
    publisher_hangs_or_is_killed(Way::FromOwner);
}

#[test]
fn owner_s_subscriber_hears_of_a_far_publisher_that_hangs_or_is_killed_as_soon_as_a_near_one() {
    publisher_hangs_or_is_killed(Way::ToOwner);
}

fn publisher_hangs_or_is_killed(way: Way) {
    let lab = way.lab(EXCLUSIVE);
    let qos: [&[&str]; 2] = [&["--lease", "2"]; 2];
    let all = Pair::start_all(&lab, way, qos);
    let each = |act: &dyn Fn(&Pair) -> Instant| [0, 1].map(|n| [0, 1].map(|i| act(&all[n][i])));
    each(&|pair| pair.hears_alive(1));
    each(&Pair::hears_message);
    for signal in [Signal::STOP, Signal::KILL] {
        let since = each(&|pair| {
            pair.talker.signal(signal);
            Instant::now()
        });
        let heard = each(&|pair| pair.hears_alive(0));
        for n in [0, 1] {
            assert_as_soon(&format!("a loss of liveliness by {signal:?}"), &all[n], since[n], heard[n]);
        }
        if signal == Signal::STOP {
            let since = each(&|pair| {
                pair.talker.signal(Signal::CONT);
                Instant::now()
            });
            let heard = each(&|pair| pair.hears_alive(1));
            for n in [0, 1] {
                assert_as_soon("its return", &all[n], since[n], heard[n]);
            }
            each(&Pair::hears_message);
        }
    }
    // The next publisher is heard, though the one before is not forgotten yet.
    for ([_, pair], [talks, _]) in all.iter().zip(PAIRS) {
        let topic = pair.name.rsplit(' ').next().unwrap();
        let args = ["pub", "--topic", topic, "--lease", "2", "--start", "1000"];
        let next = start(&lab, way.sites()[0], talks, &args);
        pair.hears("the next publisher", |e| e["event"] == "received" && e["seq"].as_u64() >= Some(1000));
        drop(next);
    }
}

#[test]
fn far_subscriber_hears_of_a_manual_publisher_and_of_a_missed_deadline_as_soon_as_a_near_one() {
    publisher_pauses(Way::FromOwner);
}

#[test]
fn owner_s_subscriber_hears_of_a_manual_far_publisher_and_of_a_missed_deadline_as_soon_as_a_near_one() {
    publisher_pauses(Way::ToOwner);
}

fn publisher_pauses(way: Way) {
    let lab = way.lab(EXCLUSIVE);
    let qos: [&[&str]; 2] = [&["--lease", "2", "--kind", "manual", "--deadline", "1"]; 2];
    let mut all = Pair::start_all(&lab, way, qos);
    // Silence ends liveliness and misses the deadline. The next message brings the publisher back.
    for _ in 0..2 {
        for pair in all.iter().flatten() {
            pair.hears_alive(1);
            pair.hears_message();
        }
        let since = all.each_mut().map(|pairs| {
            pairs.each_mut().map(|pair| {
                pair.talker.go();
                Instant::now()
            })
        });
        for (pairs, since) in all.iter().zip(since) {
            let missed = |pair: &Pair| pair.hears("a missed deadline", |e| e["event"] == "deadline_missed").0;
            assert_as_soon("a missed deadline", pairs, since, pairs.each_ref().map(missed));
            assert_as_soon(
                "a loss of liveliness",
                pairs,
                since,
                pairs.each_ref().map(|pair| pair.hears_alive(0)),
            );
        }
        all.iter_mut().flatten().for_each(|pair| pair.talker.go());
    }
}

#[test]
fn far_subscriber_hears_of_a_publisher_that_only_asserts_its_liveliness_as_a_near_one_does() {
    publisher_only_asserts(Way::FromOwner);
}

#[test]
fn owner_s_subscriber_hears_of_a_far_publisher_that_only_asserts_its_liveliness_as_a_near_one_does() {
    publisher_only_asserts(Way::ToOwner);
}

fn publisher_only_asserts(way: Way) {
    const LEASE: Duration = Duration::from_secs(2);
    let lab = way.lab(EXCLUSIVE);
    let manual = ["--lease", "2", "--kind", "manual"];
    let asserts = [&manual[..], &["--asserts", "--rate", "2"]].concat();
    let mut all = Pair::start_all(&lab, way, [&asserts, &manual]);
    for pair in all.iter().flatten() {
        pair.hears_alive(1);
    }
    for _ in 0..2 {
        std::thread::sleep(2 * LEASE);
        for pair in all.iter().flatten() {
            let lost = pair.reported().into_iter().find(|e| e["event"] == "liveliness" && e["alive"] == 0);
            assert_eq!(lost, None, "{}", pair.name);
        }
        for (alive, what) in [(0, "a loss of liveliness"), (1, "its return")] {
            let since = all.each_mut().map(|pairs| {
                pairs.each_mut().map(|pair| {
                    pair.talker.go();
                    Instant::now()
                })
            });
            for (pairs, since) in all.iter().zip(since) {
                assert_as_soon(what, pairs, since, pairs.each_ref().map(|pair| pair.hears_alive(alive)));
            }
        }
    }
}

#[test]
fn far_subscriber_that_asks_for_too_much_and_its_publisher_are_told_as_near_ones_are() {
    let lab = Way::FromOwner.lab(PLAN);
    let qos: [&[&str]; 2] =
        [&["--lease", "2", "--best-effort"], &["--lease", "1", "--kind", "manual", "--deadline", "1"]];
    let mut all = Pair::start_all(&lab, Way::FromOwner, qos);
    for pairs in &mut all {
        let is_told = |event: &Value| event["event"] == "incompatible";
        let offered = pairs
            .each_mut()
            .map(|pair| pair.talker.wait("an incompatible subscriber", is_told)["policy"].clone());
        assert_eq!(offered[1], offered[0], "{}", pairs[1].name);
        let told = |pair: &Pair| pair.hears("an incompatible publisher", is_told).1;
        let [native, carried] = pairs.each_ref().map(told);
        assert_eq!(carried["policy"], native["policy"], "{}", pairs[1].name);
        assert!(!pairs[1].reported().iter().any(|e| e["event"] == "received"), "{}", pairs[1].name);
    }
}

/// A message that is older than its lifespan reaches nobody who joins late, on either side.
#[test]
fn far_late_joiner_hears_nothing_that_is_older_than_its_lifespan() {
    const LIFESPAN: Duration = Duration::from_secs(1);
    let lab = Way::FromOwner.lab(PLAN);
    let qos: [&[&str]; 2] =
        [&["--transient-local", "--lifespan", "1", "--depth", "100"], &["--transient-local"]];
    let mut all = Pair::start_all(&lab, Way::FromOwner, qos);
    for pairs in &mut all {
        for pair in pairs {
            let mut last = 0;
            while last < 5 {
                let event = pair.listener.wait("a message", |e| e["event"] == "received");
                last = event["seq"].as_u64().unwrap();
            }
            pair.talker.go();
        }
    }
    std::thread::sleep(2 * LIFESPAN);
    for pair in all.iter_mut().flatten() {
        let last = pair.reported().iter().filter_map(|e| e["seq"].as_u64()).max();
        let (topic, listens) = (pair.name.rsplit(' ').next().unwrap(), pair.name.split(' ').nth(2).unwrap());
        let args = ["sub", "--topic", topic, "--transient-local", "--depth", "100"];
        let mut late = start(&lab, Site::Desk, listens, &args);
        late.wait_matched("a match of the late joiner");
        pair.talker.go();
        let first = late.wait("a message", |e| e["event"] == "received");
        assert!(first["seq"].as_u64() > last.or(Some(5)), "{}: {first} after {last:?}", pair.name);
    }
}
