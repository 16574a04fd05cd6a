//! The matrix of vendors: Cyclone DDS, Fast DDS and RustDDS, each to each through a router, every type with every
//! quality of service. Each message must arrive whole and once. The suite runs a part in which each pair of vendors has
//! each type, and each quality has each pair and type; `make vendors` runs all. It prints a table at the end.
//!
//! `SGC_VENDORS=full` runs all cases. `SGC_VENDORS=direct` runs all without `sgc`, as the reference. `SGC_VENDORS_ONLY`
//! selects cases whose name contains it.

#![allow(clippy::unwrap_used)]

#[path = "../support/lab.rs"]
mod lab;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::fmt;

use lab::{Lab, Plan, Site, robot_to_desk};
use sgc_testkit::netsim::Namespace;
use support::turn::TurnKind;
use support::{Peer, eventually, say};

const PLAN: Plan = Plan { name: "sgcv", domains: ["93", "94"], peer_life: "60", turn: TurnKind::Exclusive };

const VENDORS: [&str; 3] = ["cyclone", "fastdds", "rustdds"];
/// The types, small ones first. The cases of a pair of vendors run at the same time.
const KINDS: [&str; 6] = ["string", "wstring", "custom", "keyed", "image", "pointcloud"];
const SMALL: usize = 4;

#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Case {
    from: &'static str,
    to: &'static str,
    /// Index into [`KINDS`].
    kind: usize,
    reliable: bool,
    latched: bool,
}

impl fmt::Display for Case {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (reliability, durability) = (
            ["best_effort", "reliable"][self.quality() >> 1 & 1],
            ["volatile", "latched"][self.quality() & 1],
        );
        write!(f, "{}_{}_{}_{reliability}_{durability}", self.from, self.to, KINDS[self.kind])
    }
}

/// The outcome of a case.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Outcome {
    /// All messages arrived once.
    Whole,
    /// Not all messages arrived, but each intact and once. Permitted where the vendors lose some without sgc as well.
    Part,
    /// No message arrived. Permitted where lost fragments are not sent again.
    Nothing,
    Failed,
}

impl Case {
    fn all() -> Vec<Self> {
        let mut cases = Vec::new();
        for from in VENDORS {
            for to in VENDORS {
                for (kind, name) in KINDS.into_iter().enumerate() {
                    // ros2-client has no keyed topics.
                    if name == "keyed" && (from == "rustdds" || to == "rustdds") {
                        continue;
                    }
                    for (reliable, latched) in [(false, false), (false, true), (true, false), (true, true)] {
                        cases.push(Self { from, to, kind, reliable, latched });
                    }
                }
            }
        }
        cases
    }

    /// Returns the quality as a number from 0 to 3.
    fn quality(&self) -> usize {
        2 * usize::from(self.reliable) + usize::from(self.latched)
    }

    fn pair(&self) -> usize {
        let at = |vendor| VENDORS.iter().position(|v| *v == vendor).unwrap();
        at(self.from) * VENDORS.len() + at(self.to)
    }

    /// Returns `true` for one quality of each pair and type, chosen so that each quality meets each pair and each type.
    fn is_in_the_short_run(&self) -> bool {
        (self.pair() + self.kind) % 4 == self.quality()
    }

    fn topic(&self) -> String {
        format!("/v/{self}")
    }

    /// Returns `true` where the vendors lose messages without sgc, over stock socket buffers (`tests/peers/README.md`,
    /// `WEAK` in `check.py`). Some messages must come, each intact and once.
    fn is_weak(&self) -> bool {
        self.from != "cyclone" && KINDS[self.kind] == "pointcloud"
    }

    /// Returns `true` where a lost fragment is a lost message, so that a burst of several hundred fragments may lose
    /// everything, as it may without sgc.
    fn is_chance(&self) -> bool {
        !self.reliable && self.kind >= SMALL
    }

    fn run(&self, lab: &Lab, far: Site) -> Result<Outcome, String> {
        if self.latched && self.reliable { self.late(lab, far) } else { self.live(lab, far) }
    }

    fn options(&self) -> Vec<String> {
        let mut options = vec![
            "--type".to_owned(),
            KINDS[self.kind].into(),
            "--topic".into(),
            self.topic(),
            "--large".into(),
        ];
        options.push(if self.reliable { "--reliable" } else { "--best-effort" }.into());
        options.extend(self.latched.then(|| "--transient-local".into()));
        options
    }

    /// Returns the publisher's arguments for the size.
    fn size(&self) -> Vec<String> {
        match KINDS[self.kind] {
            "image" => vec!["--size".to_owned(), "1000000".into()],
            _ => Vec::new(),
        }
    }

    /// Runs a case in which both ends exist before the first message. A reader may be matched a moment before it knows,
    /// so all messages from the first received one on must come.
    fn live(&self, lab: &Lab, far: Site) -> Result<Outcome, String> {
        let (sent, wanted, rate) = if self.kind < SMALL { ("40", 20, "50") } else { ("15", 8, "10") };
        let wanted = if self.is_weak() { 1 } else { wanted };
        let count = if self.is_chance() { "0".to_owned() } else { wanted.to_string() };
        let (options, size) = (self.options(), self.size());
        let mut listen = vec!["--count", &count, "--linger", "0.7"];
        listen.extend(options.iter().map(String::as_str));
        let mut talk = vec!["--count", sent, "--rate", rate, "--wait-go"];
        talk.extend(options.iter().chain(&size).map(String::as_str));
        let mut listener = lab.peer(far, self.to, "sub", &listen);
        let mut talker = lab.peer(Site::Robot, self.from, "pub", &talk);
        talker.wait_matched("a match of the talker");
        listener.wait_matched("a match of the listener");
        talker.go();
        if self.is_chance() {
            talker.wait("all is sent", |event| event["event"] == "all_sent");
            listener.end();
        }
        let heard = listener.summary();
        talker.end();
        talker.summary();
        let count = |key: &str| heard[key].as_u64().unwrap();
        if count("duplicated") + count("altered") > 0 {
            return Err(heard.to_string());
        }
        match (count("received"), count("lost")) {
            (0, _) if self.is_chance() => Ok(Outcome::Nothing),
            (received, lost) if self.is_chance() || self.is_weak() && received >= wanted => {
                Ok(if lost == 0 { Outcome::Whole } else { Outcome::Part })
            }
            (received, 0) if received >= wanted => Ok(Outcome::Whole),
            (received, _) if received >= wanted && !self.reliable => Ok(Outcome::Part),
            _ => Err(heard.to_string()),
        }
    }

    /// Runs a case in which a late subscriber gets the publisher's history once.
    ///
    /// Only Cyclone announces how many it keeps; of others the last one is kept on the way
    /// (`docs/reference/compatibility.md`).
    fn late(&self, lab: &Lab, far: Site) -> Result<Outcome, String> {
        let (kept, depth) = match (KINDS[self.kind], self.from) {
            // One of each of the five instances.
            ("keyed", _) => (5, "1"),
            (_, "cyclone") => (3, "3"),
            _ => (1, "1"),
        };
        let options = self.options();
        let options: Vec<&str> = options.iter().map(String::as_str).collect();
        let size = self.size();
        let mut talk =
            vec!["--count", "5", "--depth", depth, "--rate", "10", "--wait-matched", "0", "--hold", "50"];
        talk.extend(options.iter().copied().chain(size.iter().map(String::as_str)));
        let mut talker = lab.peer(Site::Robot, self.from, "pub", &talk);
        let mut early =
            lab.peer(far, self.to, "sub", &[&["--depth", depth, "--verbose"], &options[..]].concat());
        early.wait("the last message", |event| event["event"] == "received" && event["seq"] == 4);
        early.end();
        let heard = early.summary();
        if heard["duplicated"] != 0 || heard["altered"] != 0 {
            return Err(heard.to_string());
        }
        let count = kept.to_string();
        let late = ["--count", &count, "--depth", depth, "--linger", "0.7"];
        let heard = lab.peer(far, self.to, "sub", &[&late, &options[..]].concat()).summary();
        talker.end();
        talker.summary();
        let got = ["received", "first", "last", "duplicated", "altered"].map(|key| heard[key].as_u64());
        if got == [Some(kept), Some(5 - kept), Some(4), Some(0), Some(0)] {
            Ok(Outcome::Whole)
        } else {
            Err(heard.to_string())
        }
    }
}

#[test]
fn every_vendor_reaches_every_vendor_with_every_type_and_quality() {
    let asked = std::env::var("SGC_VENDORS").unwrap_or_default();
    let only = std::env::var("SGC_VENDORS_ONLY").unwrap_or_default();
    let all = ["full", "direct"].contains(&asked.as_str());
    let mut cases = Case::all();
    cases.retain(|case| (all || case.is_in_the_short_run()) && case.to_string().contains(&only));
    let far = if asked == "direct" { Site::Robot } else { Site::Desk };
    let shared: Vec<String> = cases.iter().filter(|_| asked != "direct").map(Case::topic).collect();
    let lab = Lab::with_topics(PLAN, &shared);

    let mut outcomes = BTreeMap::new();
    let mut failures = Vec::new();
    for pair in 0..VENDORS.len() * VENDORS.len() {
        let (small, large): (Vec<Case>, Vec<Case>) =
            cases.iter().filter(|case| case.pair() == pair).partition(|case| case.kind < SMALL);
        let mut batches: Vec<Vec<Case>> = small.chunks(8).map(<[Case]>::to_vec).collect();
        batches.extend(large.into_iter().map(|case| vec![case]));
        for batch in batches {
            std::thread::scope(|scope| {
                let lab = &lab;
                let running: Vec<_> =
                    batch.into_iter().map(|case| (case, scope.spawn(move || case.run(lab, far)))).collect();
                for (case, thread) in running {
                    let outcome = thread.join().unwrap_or_else(|_| Err("see above".into()));
                    if let Err(why) = &outcome {
                        say(&format!("FAILED {case}: {why}"));
                        failures.push(format!("{case}: {why}"));
                    }
                    outcomes.insert(case, outcome.unwrap_or(Outcome::Failed));
                }
            });
        }
    }
    say(&table(&outcomes));
    assert!(failures.is_empty(), "{} of {} failed:\n{}", failures.len(), outcomes.len(), failures.join("\n"));
}

/// Formats a line for each pair of vendors with four signs for each type: best effort and reliable, each volatile and
/// latched.
fn table(outcomes: &BTreeMap<Case, Outcome>) -> String {
    let mut text = format!("{:20}", "");
    KINDS.iter().for_each(|kind| text += &format!("{kind:>11}"));
    for from in VENDORS {
        for to in VENDORS {
            text += &format!("\n{:20}", format!("{from} to {to}"));
            for kind in 0..KINDS.len() {
                let signs: String = [(false, false), (false, true), (true, false), (true, true)]
                    .map(|(reliable, latched)| {
                        match outcomes.get(&Case { from, to, kind, reliable, latched }) {
                            Some(Outcome::Whole) => '+',
                            Some(Outcome::Part) => '~',
                            Some(Outcome::Nothing) => '-',
                            Some(Outcome::Failed) => '!',
                            None => '.',
                        }
                    })
                    .iter()
                    .collect();
                text += &format!("{signs:>11}");
            }
        }
    }
    text + "\nbest effort volatile, latched; reliable volatile, latched: + all, ~ a part, - nothing (both as with no sgc between), ! failed, . not run"
}

#[test]
fn xcdr2_stays_xcdr2_and_a_reader_that_cannot_take_it_is_named() {
    let lab = Lab::with_topics(PLAN, ["/two"]);
    let same = ["--type", "custom", "--topic", "/two"];
    let listen = [&same[..], &["--xcdr2", "--count", "20", "--linger", "0.7"]].concat();
    let mut listener = lab.peer(Site::Desk, "cyclone", "sub", &listen);
    let talk = [&same[..], &["--xcdr2", "--rate", "20", "--wait-go"]].concat();
    let mut talker = lab.peer(Site::Robot, "cyclone", "pub", &talk);
    talker.wait_matched("a match of the talker");
    listener.wait_matched("a match of the listener");
    talker.go();
    let heard = listener.summary();
    let got = ["lost", "duplicated", "altered"].map(|key| heard[key].as_u64());
    assert_eq!(got, [Some(0); 3], "{heard}");
    assert!(heard["received"].as_u64() >= Some(20), "{heard}");
    let mut plain = lab.peer(Site::Desk, "cyclone", "sub", &same);
    plain.wait("ready", |event| event["event"] == "ready");
    eventually("the mismatch is said", || {
        let log = lab.log(Site::Desk);
        log.contains("data representation XCDR2, but a local subscriber asks for XCDR1")
    });
    plain.end();
    assert_eq!(plain.summary()["received"], 0);
    talker.end();
    talker.summary();
}

/// Adds another host to the robot's network, on a wire without multicast.
fn hall_beside(robot: &Namespace) -> Namespace {
    let hall = Namespace::create(format!("{}-hall", robot.name())).unwrap();
    hall.veth(("robot", &["10.92.3.2/24"]), robot, ("hall", &["10.92.3.1/24"])).unwrap();
    hall.ip(&["link", "set", "robot", "multicast", "off"]).unwrap();
    robot.ip(&["link", "set", "hall", "multicast", "off"]).unwrap();
    hall
}

/// Starts a peer in the hall with the defaults of its DDS except shared memory, and with the configuration of a Cyclone
/// there.
fn peer_in_the_hall(lab: &Lab, hall: &Namespace, vendor: &str, args: &[&str]) -> Peer {
    let mut command = support::command(Some(hall), lab.dir(), &Peer::program(vendor));
    // As rmw_cyclonedds makes of ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, ROS_STATIC_PEERS=10.92.3.1.
    command.env(
        "CYCLONEDDS_URI",
        "<CycloneDDS><Domain Id=\"any\"><General><AllowMulticast>false</AllowMulticast></General><Discovery>\
         <ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>\
         <Peers><Peer address=\"10.92.3.1\"/><Peer address=\"localhost\"/></Peers></Discovery></Domain></CycloneDDS>",
    );
    command.args(["pub", "--udp-only", "--domain", lab.domain(Site::Robot)]).args(args);
    Peer::start(command)
}

#[test]
fn nodes_on_another_host_are_found_by_static_peers_where_no_multicast_passes() {
    let topics: Vec<String> = VENDORS.iter().map(|vendor| format!("/{vendor}")).collect();
    let mut lab = Lab::silent(PLAN, robot_to_desk("topic", &topics));
    let Some(robot) = lab.namespace(Site::Robot) else {
        say("left out: it needs network namespaces");
        return;
    };
    let hall = hall_beside(robot);
    lab.reconfigure(Site::Robot, "static_peers = []", "static_peers = [\"10.92.3.2\"]");
    // They are there first: the node asks its peers when it starts, and then every 30 s.
    let mut talkers: Vec<_> = VENDORS
        .into_iter()
        .zip(&topics)
        .map(|(vendor, topic)| {
            let mut talker = peer_in_the_hall(&lab, &hall, vendor, &["--topic", topic, "--rate", "20"]);
            talker.wait("ready", |event| event["event"] == "ready");
            talker
        })
        .collect();
    lab.start_all();
    let listen = |topic| {
        lab.peer(Site::Desk, "cyclone", "sub", &["--topic", topic, "--count", "20", "--linger", "0.5"])
    };
    let listeners: Vec<_> = topics.iter().map(|topic| listen(topic)).collect();
    for (mut listener, vendor) in listeners.into_iter().zip(VENDORS) {
        let heard = listener.summary();
        let got = ["lost", "duplicated", "altered"].map(|key| heard[key].as_u64());
        assert_eq!(got, [Some(0); 3], "{vendor}: {heard}");
        assert!(heard["received"].as_u64() >= Some(20), "{vendor}: {heard}");
    }
    talkers.iter_mut().for_each(Peer::end);
}

#[test]
fn fast_dds_as_shipped_reaches_its_own_host_by_shared_memory_and_the_desk_through_us() {
    let lab = Lab::with_topics(PLAN, ["/shared"]);
    let same = ["--type", "image", "--topic", "/shared"];
    let count = [&same[..], &["--count", "10", "--linger", "0.7"]].concat();
    let talk = [&same[..], &["--size", "1000000", "--rate", "10", "--wait-matched", "2"]].concat();
    let mut talker = lab.stock_peer(Site::Robot, "fastdds", "pub", &talk);
    let mut beside = lab.stock_peer(Site::Robot, "fastdds", "sub", &count);
    let mut away = lab.peer(Site::Desk, "cyclone", "sub", &count);
    for (listener, place) in [(&mut beside, "beside it"), (&mut away, "at the desk")] {
        let heard = listener.summary();
        let got = ["lost", "duplicated", "altered"].map(|key| heard[key].as_u64());
        assert_eq!(got, [Some(0); 3], "{place}: {heard}");
        assert!(heard["received"].as_u64() >= Some(10), "{place}: {heard}");
    }
    talker.end();
    talker.summary();
}
