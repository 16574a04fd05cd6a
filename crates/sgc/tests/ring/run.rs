//! The run of a plan: the peers, the faults, and the bounds within which all heals.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::graph::{Edge, Fault, NODES, Node};
use crate::lab::Lab;
use crate::ledger::{Listener, Row, Talker, Topic};
use crate::new_topics::{self, NewTopics};
use crate::plan::{Act, plan};
use crate::support::eventually;

/// Period of polling.
const TICK: Duration = Duration::from_millis(50);
/// Before the first fault, and after the last one is mended.
pub(crate) const CALM: Duration = Duration::from_secs(4);
/// No further fault while a receiver of `/state` has waited for longer than this: what heals is to be disturbed, but
/// not without end, since sources do not keep their messages for ever.
const STILL_MAX: Duration = Duration::from_secs(5);
/// How long the ring may take until a way that is there carries data again, and until all links are up again.
const HEAL_MAX: Duration = Duration::from_secs(30);
/// How long it may take, once nothing of the store is broken, until it answers all routers and has all names.
const STORE_HEAL_MAX: Duration = Duration::from_secs(30);
/// How long what was sent last may take.
const LAST_MAX: Duration = Duration::from_secs(60);
/// Longest wait for a best-effort message that may be lost, and for something doubled that should not come.
const LINGER: Duration = Duration::from_secs(2);
/// How much longer than the faults all the rest may take.
const OVERTIME_MAX: Duration = Duration::from_secs(300);
/// How many seconds publishers stay when they have sent all, so that what was lost can be asked for.
const HOLD: &str = "120";

static TOPICS: [Topic; 3] = [
    Topic {
        name: "/state",
        reliable: true,
        both: &["--type", "string"],
        talker: &["--rate", "50", "--size", "64", "--depth", "1000"],
        listener: &["--depth", "0"],
    },
    Topic {
        name: "/map",
        reliable: true,
        both: &["--type", "image", "--transient-local", "--large"],
        talker: &["--rate", "1", "--size", "300000", "--depth", "30"],
        listener: &["--depth", "0"],
    },
    Topic {
        name: "/video",
        reliable: false,
        both: &["--type", "image", "--best-effort", "--large"],
        talker: &["--rate", "20", "--size", "30000", "--depth", "5"],
        listener: &["--depth", "100"],
    },
];

/// The only router of the lab.
const LAB_ROUTER: Node = Node(4);

/// The beginning or the end of a fault.
pub(crate) struct Event {
    pub(crate) at: Instant,
    pub(crate) kind: String,
    pub(crate) what: String,
    /// For the beginning of a fault: the time of its end.
    pub(crate) mended: Option<Instant>,
    /// The fault takes a link or a router down, so best effort may lose messages.
    pub(crate) loses: bool,
}

pub(crate) struct Run {
    pub(crate) talkers: Vec<Talker>,
    pub(crate) listeners: Vec<Listener>,
    pub(crate) begun: Instant,
    active: Vec<Fault>,
    pub(crate) events: Vec<Event>,
    /// All failures, reported together at the end.
    pub(crate) problems: Vec<String>,
    /// The largest counts of drops that were seen, by node and key: a kill takes the counters along.
    pub(crate) drops: BTreeMap<(Node, String), u64>,
    /// At a ring with a store: topics whose names routers look up while it is broken.
    pub(crate) new_topics: Option<NewTopics>,
    /// The names that the store had before the first fault.
    stored: BTreeSet<String>,
    /// Dropped last.
    pub(crate) lab: Lab,
}

impl Run {
    /// Starts everything, and waits until all that is sent comes.
    pub(crate) fn new(time: Duration, has_store: bool) -> Self {
        let mut names: Vec<_> = TOPICS.iter().map(|topic| topic.name).collect();
        names.extend(has_store.then_some(new_topics::PATTERN));
        let keep = std::env::var_os("SGC_RING_DIR").map(PathBuf::from);
        let lab = Lab::new(&names, keep, time + OVERTIME_MAX, has_store);
        let mut run = Self {
            talkers: Vec::new(),
            listeners: Vec::new(),
            begun: Instant::now(),
            active: Vec::new(),
            events: Vec::new(),
            problems: Vec::new(),
            drops: BTreeMap::new(),
            new_topics: None,
            stored: BTreeSet::new(),
            lab,
        };
        run.wait_for_links();
        run.start_peers();
        run
    }

    fn start_peers(&mut self) {
        for topic in &TOPICS {
            let both = [&["--topic", topic.name, "--verbose"][..], topic.both].concat();
            // Both vendors listen, each alone in its network.
            for (at, vendor) in [(Node::DESK, "cyclone"), (Node::LAB, "fastdds")] {
                let peer = self.lab.peer(at, vendor, "sub", &[&both[..], topic.listener].concat());
                self.listeners.push(Listener::new(topic, at, peer));
            }
            let control = ["--wait-go", "--wait-stop", "--hold", HOLD];
            let peer =
                self.lab.peer(Node::ROBOT, "cyclone", "pub", &[&both[..], topic.talker, &control].concat());
            self.talkers.push(Talker::new(topic, peer));
        }
        for talker in &mut self.talkers {
            talker.peer.wait_matched(&format!("a reader of {}", talker.topic.name));
        }
        for listener in &mut self.listeners {
            let what = format!("a writer of {}", listener.name());
            listener.peer.wait_matched(&what);
        }
        self.talkers.iter_mut().for_each(|talker| talker.peer.go());
        eventually("all that is sent comes", || {
            self.update();
            self.listeners.iter().all(|listener| !listener.got.is_empty())
        });
    }

    fn update(&mut self) {
        self.talkers.iter_mut().for_each(Talker::update);
        self.listeners.iter_mut().for_each(Listener::update);
        let wrong = self.new_topics.as_mut().and_then(|topics| topics.update(&self.lab));
        wrong.into_iter().for_each(|wrong| self.trouble(wrong));
    }

    /// Lets a time go by in which nothing is done, and looks what has ended meanwhile.
    pub(crate) fn pass(&mut self, time: Duration) {
        sleep(time);
        self.update();
        let fallen = self.lab.fallen();
        assert!(fallen.is_empty(), "ended by themselves: {fallen:?}");
        assert!(self.talkers.iter().all(|t| !t.done), "a talker ended by itself");
        assert!(self.listeners.iter().all(|l| !l.ended), "a listener ended by itself");
    }

    /// Whether this came to be so within a time.
    fn comes(&mut self, within: Duration, mut is_so: impl FnMut(&mut Self) -> bool) -> bool {
        let deadline = Instant::now() + within;
        while !is_so(self) {
            if Instant::now() >= deadline {
                return false;
            }
            self.pass(TICK);
        }
        true
    }

    pub(crate) fn trouble(&mut self, text: String) {
        let at = self.begun.elapsed().as_secs_f64();
        self.problems.push(format!("{at:.1} s: {text}"));
    }

    pub(crate) fn wait_for_links(&mut self) {
        let all = |run: &mut Self| run.lab.told(&run.active).edges.iter().all(|up| *up);
        if !self.comes(HEAL_MAX, all) {
            let told = self.lab.told(&self.active).edges;
            let down: Vec<_> = Edge::all().filter(|edge| !told[edge.0]).collect();
            self.trouble(format!("not up within {HEAL_MAX:?}: {down:?}"));
        }
    }

    pub(crate) fn chaos(&mut self, seed: u64, time: Duration) {
        let mut before = Duration::ZERO;
        self.begun = Instant::now();
        for (at, act) in plan(seed, self.lab.is_apart(), self.new_topics.is_some()) {
            let after = at - before;
            before = at;
            if self.begun.elapsed() + after >= time {
                self.pass(time.saturating_sub(self.begun.elapsed()));
                break;
            }
            self.pass(after);
            match act {
                Act::Break(fault) => {
                    if self.may_break(&fault) {
                        self.inflict(fault);
                    }
                }
                Act::Mend(fault) => self.mend(&fault),
            }
        }
        for fault in self.active.clone() {
            self.mend(&fault);
        }
    }

    /// Waits until a fault may begin. One of the store takes no way. If nothing else of the store is broken, the store
    /// has to heal first, except while a proxy is cut off, which is not to last longer than planned.
    fn may_break(&mut self, fault: &Fault) -> bool {
        if !matches!(fault, Fault::Store(_)) {
            return self.has_way_beside(fault);
        }
        let hinders = |fault: &Fault| matches!(fault, Fault::Store(_) | Fault::Isolate { .. });
        self.active.iter().any(hinders) || self.wait_for_store()
    }

    /// Waits until there is a way without what is to be broken, and data on it, also of a topic that is new.
    fn has_way_beside(&mut self, fault: &Fault) -> bool {
        let parts = matches!(fault, Fault::Isolate { .. });
        let has_way = |run: &mut Self| {
            let told = run.lab.told(&run.active);
            if parts { told.connects() } else { told.without([fault]).connects() }
        };
        let flows = |run: &mut Self| {
            run.update();
            run.listeners.iter().all(|l| l.topic.name != "/state" || l.still() < STILL_MAX)
        };
        if !self.comes(HEAL_MAX, has_way) {
            let told = self.lab.told(&self.active).edges;
            let down: Vec<_> = Edge::all().filter(|edge| !told[edge.0]).collect();
            self.trouble(format!("no way within {HEAL_MAX:?} beside {fault:?}: {down:?} are down"));
            return false;
        }
        if !self.comes(HEAL_MAX, flows) {
            let active = self.active.clone();
            self.trouble(format!("there is a way, and no /state on it within {HEAL_MAX:?}, with {active:?}"));
            return false;
        }
        self.wait_for_new_topic(STILL_MAX)
    }

    /// Waits until no new topic has been silent for longer than a time.
    fn wait_for_new_topic(&mut self, longest: Duration) -> bool {
        let waits = |run: &Self| {
            let begun = run.new_topics.as_ref().and_then(|topics| topics.begun.as_ref());
            begun.is_some_and(|begun| begun.since.elapsed() > longest)
        };
        let has_come = self.comes(HEAL_MAX, |run| !waits(run));
        if !has_come {
            self.give_up_new_topic();
        }
        has_come
    }

    fn give_up_new_topic(&mut self) {
        let begun = self.new_topics.as_ref().and_then(|topics| topics.begun.as_ref());
        let whose = begun.map_or("no new topic begins".to_owned(), |begun| {
            format!("{} is new at {:?}, and silent for {:?}", begun.topic, begun.at, begun.since.elapsed())
        });
        self.trouble(format!("{whose}, with {:?}", self.active));
        self.keep_statuses("new-topic");
        self.new_topics.iter_mut().for_each(NewTopics::end);
    }

    /// Waits until the store answers all routers and has the names again that it had at first.
    pub(crate) fn wait_for_store(&mut self) -> bool {
        let mut lacking = Vec::new();
        let is_whole = |run: &mut Self| {
            lacking = run.lacking_of_store();
            lacking.is_empty()
        };
        if self.comes(STORE_HEAL_MAX, is_whole) {
            return true;
        }
        self.trouble(format!("the store has not healed within {STORE_HEAL_MAX:?}: {}", lacking.join("; ")));
        self.keep_statuses("store");
        false
    }

    /// Returns what the store lacks.
    fn lacking_of_store(&self) -> Vec<String> {
        let down: BTreeSet<_> = self.active.iter().flat_map(Fault::routers).collect();
        let mut lacking = Vec::new();
        for router in Node::routers().filter(|router| !down.contains(router)) {
            let status = self.lab.status(router);
            let alerts = status["alerts"].as_array().map(Vec::as_slice).unwrap_or_default();
            if status["store"]["answers"] != true || alerts.iter().any(|alert| alert["kind"] == "store_down")
            {
                lacking.push(format!("{router:?} has no store: {}", status["store"]));
            }
        }
        let names = self.lab.stored_names();
        let lost: Vec<_> = self.stored.difference(&names).collect();
        if !lost.is_empty() {
            lacking.push(format!("names lost, {} of {}: {lost:?}", lost.len(), self.stored.len()));
        }
        lacking
    }

    /// Keeps the statuses of all nodes beside the logs.
    fn keep_statuses(&self, why: &str) {
        let statuses: BTreeMap<_, _> =
            NODES.iter().map(|node| (node.name(), self.lab.status(*node))).collect();
        let file = format!("{}-{why}.json", self.problems.len());
        self.lab.keep(&file, &serde_json::to_string_pretty(&statuses).unwrap());
    }

    /// Notes the names that the store has, and has new topics used from now on.
    pub(crate) fn use_store(&mut self) {
        eventually("the store has all names", || self.lab.stored_names().len() > TOPICS.len());
        self.stored = self.lab.stored_names();
        self.new_topics = Some(NewTopics::new());
    }

    /// Requires that the store is used again: by new topics at both sides, and by a router without memory.
    pub(crate) fn require_store(&mut self) {
        self.wait_for_store();
        let heard = |run: &Self| run.new_topics.as_ref().map_or(0, |topics| topics.heard.len());
        // The first may have begun before.
        let wanted = heard(self) + 3;
        if !self.comes(HEAL_MAX, |run| heard(run) >= wanted) {
            self.give_up_new_topic();
        }
        self.new_topics.iter_mut().for_each(NewTopics::end);
        let restart = Fault::Kill { router: LAB_ROUTER, forgets: true };
        self.inflict(restart.clone());
        self.mend(&restart);
        let found = |run: &Self| run.lab.status(LAB_ROUTER)["store"]["found"].as_u64().unwrap_or(0);
        if !self.comes(HEAL_MAX, |run| found(run) >= TOPICS.len() as u64) {
            let status = self.lab.status(LAB_ROUTER)["store"].clone();
            self.trouble(format!("{LAB_ROUTER:?} does not find names in the store: {status}"));
            self.keep_statuses("found");
        }
        self.wait_for_links();
    }

    fn inflict(&mut self, fault: Fault) {
        let loses = !matches!(fault, Fault::Store(_));
        // Its counters would go with it.
        for router in fault.routers() {
            self.count_drops(router);
        }
        self.lab.inflict(&fault);
        let (kind, what) = (fault.kind().to_owned(), format!("{fault:?}"));
        self.events.push(Event { at: Instant::now(), kind, what, mended: None, loses });
        self.active.push(fault);
    }

    fn mend(&mut self, fault: &Fault) {
        let Some(place) = self.active.iter().position(|other| other == fault) else { return };
        self.active.remove(place);
        self.lab.mend(fault);
        let at = Instant::now();
        let what = format!("{fault:?}");
        let broken = self.events.iter_mut().rev().find(|event| event.what == what).unwrap();
        broken.mended = Some(at);
        let loses = broken.loses;
        let (kind, what) = (format!("mended: {}", fault.kind()), format!("mended: {what}"));
        self.events.push(Event { at, kind, what, mended: Some(at), loses });
    }

    pub(crate) fn count_drops(&mut self, node: Node) {
        let status = self.lab.status(node);
        for (key, count) in status["drops"].as_object().into_iter().flatten() {
            let most = self.drops.entry((node, key.clone())).or_default();
            *most = (*most).max(count.as_u64().unwrap_or(0));
        }
    }

    /// Ends the sending, waits for what is under way, ends the peers.
    pub(crate) fn finish(&mut self) {
        self.talkers.iter_mut().for_each(|talker| talker.peer.go());
        eventually("the talkers stop", || {
            self.update();
            self.talkers.iter().all(|talker| talker.done)
        });
        let lasts: BTreeMap<_, _> = self.talkers.iter().map(|t| (t.topic.name, t.last().unwrap())).collect();
        let wait = |run: &mut Self, within: Duration, reliable: bool| {
            let deadline = Instant::now() + within;
            let lacks = |l: &Listener| l.topic.reliable == reliable && !l.has(lasts[l.topic.name]);
            while run.listeners.iter().any(lacks) && Instant::now() < deadline {
                sleep(TICK);
                run.update();
            }
            run.listeners.iter().filter(|l| lacks(l)).map(Listener::name).collect::<Vec<_>>()
        };
        let lacking = wait(self, LAST_MAX, true);
        if !lacking.is_empty() {
            self.trouble(format!("the last message did not come within {LAST_MAX:?}: {lacking:?}"));
            for node in [Node::ROBOT, Node::DESK, Node::LAB] {
                self.trouble(format!("{node:?} says {}", self.lab.status(node)["routes"]));
            }
        }
        wait(self, LINGER, false);
        sleep(LINGER);
        self.update();
        for listener in &mut self.listeners {
            listener.peer.end();
            let summary = listener.peer.summary();
            // The peer counts for itself; that both counts agree speaks for ours.
            let doubled = Row::from_numbers(listener.got.iter().map(|(_, seq)| *seq)).doubled.len() as u64;
            assert_eq!(summary["duplicated"].as_u64(), Some(doubled), "{}: {summary}", listener.name());
        }
        for talker in &mut self.talkers {
            talker.peer.end();
            talker.peer.summary();
        }
    }
}
