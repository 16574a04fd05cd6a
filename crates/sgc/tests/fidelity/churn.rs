//! Programs and nodes come and go at random under traffic. Afterwards no route or endpoint is left over, and no message
//! comes twice.
//!
//! `SGC_CHURN_SEED` and `SGC_CHURN_STEPS` make it another run, or a longer one (`make churn`); each step ends one
//! program or node, with SIGKILL or SIGTERM, and starts it again.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use rustix::process::Signal;
use serde_json::Value;

use crate::PLAN;
use crate::lab::{Lab, SITES, Site, robot_to_desk, share, uses};
use crate::observer::Observer;
use crate::support::{PATIENCE, Peer, environment, eventually, say};

const SEED: u64 = 6;
const STEPS: u64 = 20;
/// Bound of the memory that a node may hold beyond that after its start.
const RESIDENT_MORE_KB_MAX: u64 = 40_000;
const FDS_MORE_MAX: usize = 12;
const THREADS_MORE_MAX: usize = 12;
/// Number of messages from which the rate of a topic is computed.
const COUNTED: u64 = 40;
/// A publisher's numbers begin at its run times this.
const RUN_NUMBERS: u64 = 1_000_000;

/// SplitMix64.
struct Rng(u64);

impl Rng {
    fn below(&mut self, n: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) % n
    }
}

/// An independent program that is ended and started again.
struct App {
    site: Site,
    vendor: &'static str,
    role: &'static str,
    topic: &'static str,
    latched: bool,
    runs: u64,
    peer: Option<Peer>,
    /// The numbers that the present run received or sent.
    seen: BTreeSet<u64>,
    twice: u64,
}

impl App {
    fn new(site: Site, vendor: &'static str, role: &'static str, topic: &'static str, latched: bool) -> Self {
        Self { site, vendor, role, topic, latched, runs: 0, peer: None, seen: BTreeSet::new(), twice: 0 }
    }

    fn name(&self) -> String {
        format!("{} {} {} at {}", self.vendor, self.role, self.topic, self.site.name())
    }

    fn start(&mut self, lab: &Lab) {
        self.runs += 1;
        let first = (self.runs * RUN_NUMBERS).to_string();
        let mut args = vec!["--type", "string", "--topic", self.topic, "--verbose"];
        if self.latched {
            args.extend(["--transient-local", "--depth", "1"]);
        }
        if self.role == "pub" {
            args.extend([
                "--rate",
                if self.latched { "2" } else { "20" },
                "--wait-matched",
                "0",
                "--start",
                &first,
            ]);
        }
        (self.seen, self.twice) = (BTreeSet::new(), 0);
        let mut peer = lab.peer(self.site, self.vendor, self.role, &args);
        peer.wait("ready", |e| e["event"] == "ready");
        self.peer = Some(peer);
    }

    fn end(&mut self, signal: Signal) {
        let mut peer = self.peer.take().unwrap();
        if signal == Signal::TERM {
            peer.end();
            peer.summary();
        }
        // Dropping kills the process if it still runs.
        drop(peer);
    }

    /// Reads what it reports.
    fn look(&mut self) {
        while let Ok((_, event)) = self.peer.as_ref().unwrap().events.try_recv() {
            if matches!(event["event"].as_str(), Some("received" | "sent")) {
                assert_ne!(event["ok"], false, "{}: {event}", self.name());
                let is_news = self.seen.insert(event["seq"].as_u64().unwrap());
                self.twice += u64::from(!is_news);
            }
        }
    }

    fn last(&self) -> u64 {
        self.seen.last().copied().unwrap_or(0)
    }
}

/// Returns the routes and names of each node, without counters.
fn routes(lab: &Lab) -> Vec<Vec<String>> {
    let of_site = |site| {
        let status = lab.status(site);
        let list = |key: &str| status[key].as_array().cloned().unwrap_or_default();
        let route = |r: &Value| format!("{} {} {}", r["direction"], r["topic"], r["state"]);
        let mut all: Vec<_> = list("routes").iter().map(route).collect();
        all.extend(list("names").iter().map(|n| n["name"].to_string()));
        all.extend(list("problems").iter().map(ToString::to_string));
        all.push(format!("{} links, router {}", list("links").len(), status["router"]));
        all.sort();
        all
    };
    SITES.into_iter().map(of_site).collect()
}

/// Checks that each listener receives each message of the present publishers of its topic once.
fn assert_flows(apps: &mut [App]) {
    let topics: BTreeMap<&str, bool> = apps.iter().map(|a| (a.topic, a.latched)).collect();
    for (topic, latched) in topics {
        let counted = if latched { COUNTED / 10 } else { COUNTED };
        let mut of_topic: Vec<_> = apps.iter_mut().filter(|a| a.topic == topic).collect();
        let (talkers, listeners): (Vec<usize>, Vec<usize>) =
            (0..of_topic.len()).partition(|n| of_topic[*n].role == "pub");
        for talker in talkers {
            of_topic[talker].look();
            let begin = of_topic[talker].last();
            let run = begin / RUN_NUMBERS;
            let deadline = Instant::now() + PATIENCE;
            // Checks from the first message that all listeners have.
            let mut from = None;
            loop {
                of_topic.iter_mut().for_each(|app| app.look());
                let heard_by_all =
                    |seq: &u64| *seq > begin && listeners.iter().all(|l| of_topic[*l].seen.contains(seq));
                let talked = of_topic[talker].seen.range(run * RUN_NUMBERS..);
                from = from.or_else(|| talked.clone().copied().find(heard_by_all));
                if let Some(from) = from
                    && listeners.iter().all(|l| of_topic[*l].seen.contains(&(from + counted)))
                {
                    for listener in &listeners {
                        let heard = of_topic[*listener].seen.range(from..=from + counted).count() as u64;
                        assert_eq!(heard, counted + 1, "{}: of {}", of_topic[*listener].name(), counted + 1);
                    }
                    break;
                }
                let heard: Vec<_> = of_topic.iter().map(|a| (a.name(), a.last())).collect();
                assert!(Instant::now() < deadline, "{topic} does not flow: {heard:?}");
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

#[test]
fn nothing_is_left_of_what_came_and_went() {
    let seed = environment("SGC_CHURN_SEED", SEED);
    let steps = environment("SGC_CHURN_STEPS", STEPS);
    let mut rng = Rng(seed);
    let [mut robot, mut desk] = robot_to_desk("topic", ["/string", "/latched"]);
    robot += &uses("topic", "/command", "desk");
    desk += &share("topic", "/command", "robot");
    let mut lab = Lab::new(PLAN, [robot, desk]);
    let mut apps = vec![
        App::new(Site::Robot, "cyclone", "pub", "/string", false),
        App::new(Site::Robot, "fastdds", "pub", "/latched", true),
        App::new(Site::Robot, "cyclone", "sub", "/command", false),
        App::new(Site::Desk, "fastdds", "sub", "/string", false),
        App::new(Site::Desk, "cyclone", "sub", "/latched", true),
        App::new(Site::Desk, "fastdds", "pub", "/command", false),
    ];
    let mut observers = [Site::Robot, Site::Desk].map(|site| Observer::start(&lab, site));
    apps.iter_mut().for_each(|app| app.start(&lab));
    assert_flows(&mut apps);
    let look = |observers: &mut [Observer; 2]| observers.each_mut().map(|o| o.endpoints());
    let (endpoints, known) = (look(&mut observers), routes(&lab));
    say(&format!("churn: seed {seed}, {steps} steps, endpoints {endpoints:?}"));
    let begun = SITES.map(|site| lab.node(site).held());
    for step in 0..steps {
        let signal = if rng.below(2) == 0 { Signal::KILL } else { Signal::TERM };
        // Programs restart more often than nodes, so that each node outlives many of them.
        let index = rng.below(apps.len() as u64 * 2 + 3) as usize;
        let pause = Duration::from_millis(rng.below(400));
        if let Some(site) = SITES.get(index) {
            lab.end(*site, signal);
            std::thread::sleep(pause);
            lab.start(*site);
        } else {
            let app = &mut apps[(index - 3) / 2];
            app.end(signal);
            std::thread::sleep(pause);
            app.start(&lab);
        }
        apps.iter_mut().for_each(App::look);
        if step % 10 == 9 {
            // The present programs still receive each message once.
            assert_flows(&mut apps);
        }
    }
    assert_flows(&mut apps);
    // Killed programs vanish when their lease is over.
    eventually("the endpoints are those of the beginning", || {
        let now = look(&mut observers);
        let same = now == endpoints;
        if !same {
            std::thread::sleep(Duration::from_millis(500));
        }
        same
    });
    eventually("routes and names are those of the beginning", || {
        let now = routes(&lab);
        std::thread::sleep(Duration::from_millis(if now == known { 0 } else { 500 }));
        now == known
    });
    let twice: Vec<u64> = apps.iter_mut().map(|app| app.twice).collect();
    assert_flows(&mut apps);
    for (app, before) in apps.iter().zip(twice) {
        // A restarted node delivers latched messages once more, as a restarted publisher does.
        assert!(
            app.twice == before && (app.latched || app.twice == 0),
            "{}: {} twice",
            app.name(),
            app.twice
        );
    }
    for (site, before) in SITES.into_iter().zip(&begun) {
        let after = lab.node(site).held();
        say(&format!("churn: {} held {before:?}, then {after:?}", site.name()));
        assert!(
            after.resident_kb < before.resident_kb + RESIDENT_MORE_KB_MAX,
            "{site:?}: {before:?}, {after:?}"
        );
        assert!(after.fds < before.fds + FDS_MORE_MAX, "{site:?}: {before:?}, {after:?}");
        assert!(after.threads < before.threads + THREADS_MORE_MAX, "{site:?}: {before:?}, {after:?}");
    }
    SITES.into_iter().for_each(|site| assert!(!lab.log(site).contains("panicked"), "{}", lab.log(site)));
}
