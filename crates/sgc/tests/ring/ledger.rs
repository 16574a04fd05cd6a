//! Records sent and received messages with their times, and judges them.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use crate::graph::Node;
use crate::support::Peer;

/// A topic of the robot.
pub(crate) struct Topic {
    pub(crate) name: &'static str,
    pub(crate) reliable: bool,
    /// Arguments of both its publisher and its subscribers.
    pub(crate) both: &'static [&'static str],
    /// Further arguments of the publisher: rate, size, depth.
    pub(crate) talker: &'static [&'static str],
    pub(crate) listener: &'static [&'static str],
}

/// The publisher of a topic.
pub(crate) struct Talker {
    pub(crate) topic: &'static Topic,
    pub(crate) peer: Peer,
    pub(crate) sent: Vec<(Instant, u64)>,
    /// The talker has sent its last message.
    pub(crate) done: bool,
}

impl Talker {
    pub(crate) fn new(topic: &'static Topic, peer: Peer) -> Self {
        Self { topic, peer, sent: Vec::new(), done: false }
    }

    /// Handles new reports of the peer.
    pub(crate) fn update(&mut self) {
        while let Ok((at, event)) = self.peer.events.try_recv() {
            match event["event"].as_str() {
                Some("sent") => self.sent.push((at, event["seq"].as_u64().unwrap())),
                Some("all_sent" | "summary") => self.done = true,
                _ => {}
            }
        }
    }

    pub(crate) fn last(&self) -> Option<u64> {
        self.sent.last().map(|(_, seq)| *seq)
    }
}

/// A subscriber.
pub(crate) struct Listener {
    pub(crate) topic: &'static Topic,
    pub(crate) at: Node,
    pub(crate) peer: Peer,
    pub(crate) got: Vec<(Instant, u64)>,
    /// Number of altered messages.
    pub(crate) altered: u32,
    /// Numbers of matched writers, with the times of their changes.
    pub(crate) matched: Vec<(Instant, u64)>,
    /// The listener has ended, which is a failure while the test runs.
    pub(crate) ended: bool,
}

impl Listener {
    pub(crate) fn new(topic: &'static Topic, at: Node, peer: Peer) -> Self {
        Self { topic, at, peer, got: Vec::new(), altered: 0, matched: Vec::new(), ended: false }
    }

    /// Handles new reports of the peer.
    pub(crate) fn update(&mut self) {
        while let Ok((at, event)) = self.peer.events.try_recv() {
            match event["event"].as_str() {
                Some("received") if event["ok"] == true => {
                    self.got.push((at, event["seq"].as_u64().unwrap()));
                }
                Some("received" | "unreadable") => self.altered += 1,
                Some("matched") => self.matched.push((at, event["count"].as_u64().unwrap())),
                Some("summary") => self.ended = true,
                _ => {}
            }
        }
    }

    pub(crate) fn has(&self, seq: u64) -> bool {
        self.got.iter().rev().any(|(_, got)| *got == seq)
    }

    /// Returns the time since the last message.
    pub(crate) fn still(&self) -> Duration {
        self.got.last().map_or(Duration::MAX, |(at, _)| at.elapsed())
    }

    /// Returns the longest time without a message that began between two moments.
    pub(crate) fn outage(&self, from: Instant, to: Instant) -> Option<Duration> {
        let begin = self.got.partition_point(|(at, _)| *at < from);
        let pauses = self.got[begin..].windows(2).take_while(|pair| pair[0].0 < to);
        pauses.map(|pair| pair[1].0 - pair[0].0).max()
    }

    pub(crate) fn name(&self) -> String {
        format!("{} at {:?}", self.topic.name, self.at)
    }
}

/// The differences between received numbers and a sequence without gaps.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Row {
    pub(crate) first: u64,
    pub(crate) last: u64,
    /// Number of distinct messages.
    pub(crate) received: u64,
    /// The gaps between the first and the last number, each as first and last missing number.
    pub(crate) gaps: Vec<(u64, u64)>,
    /// Numbers that came again.
    pub(crate) doubled: Vec<u64>,
    /// Numbers that came first after a greater one.
    pub(crate) late: Vec<u64>,
}

impl Row {
    pub(crate) fn from_numbers(numbers: impl IntoIterator<Item = u64>) -> Self {
        let mut row = Self::default();
        let mut seen = BTreeSet::new();
        for number in numbers {
            let greatest = seen.last().copied();
            if !seen.insert(number) {
                row.doubled.push(number);
            } else if greatest.is_some_and(|greatest| greatest > number) {
                row.late.push(number);
            }
        }
        row.received = seen.len() as u64;
        row.first = seen.first().copied().unwrap_or(0);
        row.last = seen.last().copied().unwrap_or(0);
        let pairs = seen.iter().zip(seen.iter().skip(1));
        row.gaps = pairs.filter(|(a, b)| **b > *a + 1).map(|(a, b)| (a + 1, b - 1)).collect();
        row
    }

    pub(crate) fn lost(&self) -> u64 {
        self.gaps.iter().map(|(from, to)| to - from + 1).sum()
    }
}

#[test]
fn rows_are_judged() {
    assert_eq!(Row::from_numbers([]), Row::default());
    let whole = Row::from_numbers(3..9);
    assert_eq!((whole.first, whole.last, whole.received, whole.lost()), (3, 8, 6, 0));
    assert!(whole.doubled.is_empty() && whole.late.is_empty());
    let row = Row::from_numbers([2, 3, 7, 5, 7, 3, 11]);
    assert_eq!((row.gaps, row.doubled, row.late), (vec![(4, 4), (6, 6), (8, 10)], vec![7, 3], vec![5]));
}
