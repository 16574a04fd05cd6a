//! Topics that nobody has used before, one after the other: routers look each name up, whatever is broken then.

use std::sync::mpsc::TryRecvError;
use std::time::{Duration, Instant};

use crate::graph::Node;
use crate::lab::Lab;
use crate::support::Peer;

/// The pattern of their names.
pub(crate) const PATTERN: &str = "/new/**";
/// Pause between the end of one and the beginning of the next.
const PAUSE: Duration = Duration::from_secs(1);
/// Arguments of publishers and of subscribers, with the depths of `/state`: a source keeps what is lost on the way. A
/// subscriber ends by itself.
const PUBLISHER: [&str; 8] = ["--type", "string", "--rate", "20", "--count", "0", "--depth", "1000"];
const SUBSCRIBER: [&str; 6] = ["--type", "string", "--count", "3", "--depth", "0"];
/// Counters of a subscriber that stay 0.
const FAULTLESS: [&str; 4] = ["lost", "duplicated", "altered", "reordered"];

/// A topic that was used first a while ago.
pub(crate) struct Begun {
    pub(crate) topic: String,
    pub(crate) at: Node,
    pub(crate) since: Instant,
    talker: Peer,
    listener: Peer,
}

/// A topic whose messages came.
pub(crate) struct Heard {
    pub(crate) topic: String,
    pub(crate) at: Node,
    pub(crate) since: Instant,
    /// From the start of publisher and subscriber to the message after which the subscriber ended.
    pub(crate) took: Duration,
}

pub(crate) struct NewTopics {
    pub(crate) begun: Option<Begun>,
    pub(crate) heard: Vec<Heard>,
    /// Peers that have ended, or are told to.
    leaving: Vec<Peer>,
    number: usize,
    next_at: Instant,
}

impl NewTopics {
    pub(crate) fn new() -> Self {
        Self { begun: None, heard: Vec::new(), leaving: Vec::new(), number: 0, next_at: Instant::now() }
    }

    /// Begins a topic if it is time for one, and handles what has come of the last. Returns a description of messages
    /// that were lost, repeated or altered.
    pub(crate) fn update(&mut self, lab: &Lab) -> Option<String> {
        self.leaving.retain(|peer| {
            peer.events.try_iter().for_each(drop);
            !matches!(peer.events.try_recv(), Err(TryRecvError::Disconnected))
        });
        let Some(begun) = &self.begun else {
            if Instant::now() >= self.next_at {
                self.begin(lab);
            }
            return None;
        };
        let summary = begun.listener.events.try_iter().find(|(_, event)| event["event"] == "summary");
        let (at, summary) = summary?;
        let (topic, node, took) = (begun.topic.clone(), begun.at, at - begun.since);
        self.heard.push(Heard { topic, at: node, since: begun.since, took });
        self.end();
        let is_faultless = FAULTLESS.iter().all(|key| summary[key] == 0);
        (!is_faultless).then(|| format!("{} at {node:?}: {summary}", self.heard.last().unwrap().topic))
    }

    fn begin(&mut self, lab: &Lab) {
        let topic = format!("/new/n{}", self.number);
        let at = [Node::LAB, Node::DESK][self.number % 2];
        self.number += 1;
        let peer = |node, role, args: &[&str]| {
            lab.peer(node, "fastdds", role, &[&["--topic", topic.as_str()], args].concat())
        };
        let since = Instant::now();
        let listener = peer(at, "sub", &SUBSCRIBER);
        let talker = peer(Node::ROBOT, "pub", &PUBLISHER);
        self.begun = Some(Begun { topic, at, since, talker, listener });
    }

    /// Ends the topic that was begun, whatever came of it.
    pub(crate) fn end(&mut self) {
        let Some(Begun { mut talker, mut listener, .. }) = self.begun.take() else { return };
        talker.end();
        listener.end();
        self.leaving.extend([talker, listener]);
        self.next_at = Instant::now() + PAUSE;
    }
}
