//! QoS of several local writers as one offer, and the reader that matches them all.

use std::collections::BTreeSet;
use std::fmt;
use std::time::Duration;

use sgc_wire::{Durability, History, Liveliness, Qos, Reliability, Representations};

/// Fewest samples that a reliable reader of SGC keeps, so that a moment without the processor loses nothing.
pub const RELIABLE_READER_DEPTH_MIN: u32 = 32;

/// Fewest unacknowledged samples that a reliable `KEEP_LAST` writer of SGC keeps, unless late joiners would get them all.
/// Fast DDS acknowledges some 7 ms after the heartbeat, and a publisher's own depth, ten by default, is meant for a
/// reader on its own network.
pub const UNACKNOWLEDGED_MIN: u32 = 16;

/// Number of instances whose history is kept of a keyed topic. SGC does not know the keys: a writer keeps its last
/// samples of each instance, SGC as many of all instances together.
pub const KEYED_INSTANCES_KEPT: u32 = 256;

/// Most samples that are kept for a keyed topic.
pub const KEYED_SAMPLES_MAX: u32 = 4096;

/// Returns the history that holds all instances of a keyed topic's writer, unless it has too many.
pub fn for_all_instances(history: History) -> History {
    match history {
        History::KeepLast(n) => {
            History::KeepLast(n.saturating_mul(KEYED_INSTANCES_KEPT).min(KEYED_SAMPLES_MAX.max(n)))
        }
        History::KeepAll => History::KeepAll,
    }
}

/// Depth of SGC's request and reply endpoints, for slow readers.
pub const SERVICE_DEPTH: u32 = 1000;

/// Returns the QoS of both topics of a service: that of ROS 2 (`rmw_qos_profile_services_default`) with more depth,
/// so that simultaneous calls are not lost.
pub fn service_qos() -> Qos {
    Qos { history: History::KeepLast(SERVICE_DEPTH), ..Qos::default() }
}

/// Policies that the user sets in place of the publishers'.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct QosOverride {
    /// Whether samples are acknowledged.
    pub reliability: Option<Reliability>,
    /// Whether late joiners get earlier samples.
    pub durability: Option<Durability>,
    /// The number of samples for late joiners.
    pub history: Option<History>,
    /// Longest time between samples, in nanoseconds.
    pub deadline_ns: Option<u64>,
    /// Time for which a sample is valid, in nanoseconds.
    pub lifespan_ns: Option<u64>,
}

impl QosOverride {
    /// Returns the offer with these policies replaced.
    #[must_use]
    pub fn apply(&self, qos: &Qos) -> Qos {
        Qos {
            reliability: self.reliability.unwrap_or(qos.reliability),
            durability: self.durability.unwrap_or(qos.durability),
            history: self.history.unwrap_or(qos.history),
            deadline_ns: self.deadline_ns.or(qos.deadline_ns),
            lifespan_ns: self.lifespan_ns.or(qos.lifespan_ns),
            ..qos.clone()
        }
    }
}

/// Returns the combined offer of several writers: the weakest of each policy, so that a reader that matches the
/// result matches each of them. Depth and lifespan are the longest; partitions and data representations are united.
pub fn weakest<'a>(offers: impl IntoIterator<Item = &'a Qos>) -> Option<Qos> {
    let mut offers = offers.into_iter();
    let mut all = offers.next()?.clone();
    let mut partitions: BTreeSet<String> = all.partitions.drain(..).collect();
    for q in offers {
        all.reliability = all.reliability.min(q.reliability);
        all.durability = all.durability.min(q.durability);
        all.history = match (all.history, q.history) {
            (History::KeepLast(a), History::KeepLast(b)) => History::KeepLast(a.max(b)),
            _ => History::KeepAll,
        };
        all.deadline_ns = longest(all.deadline_ns, q.deadline_ns);
        all.lifespan_ns = longest(all.lifespan_ns, q.lifespan_ns);
        all.lease_ns = longest(all.lease_ns, q.lease_ns);
        all.liveliness = match (all.liveliness, q.liveliness) {
            (Liveliness::Automatic, _) | (_, Liveliness::Automatic) => Liveliness::Automatic,
            (Liveliness::ManualByTopic, other) | (other, Liveliness::ManualByTopic) => other,
            (same, _) => same,
        };
        all.representations = all.representations.or(q.representations);
        partitions.extend(q.partitions.iter().cloned());
    }
    all.partitions = partitions.into_iter().take(Qos::PARTITIONS_MAX).collect();
    Some(all)
}

/// Returns the QoS with which a reader matches all writers behind `offer` and loses nothing that they keep. `writers`
/// is their number, because each one's history must fit.
pub fn reader_for(offer: &Qos, writers: usize) -> Qos {
    let several = if offer.is_transient_local() { writers.clamp(1, 1000) as u32 } else { 1 };
    let history = match offer.history {
        History::KeepAll => History::KeepAll,
        History::KeepLast(n) if offer.reliability == Reliability::Reliable => {
            History::KeepLast(n.saturating_mul(several).max(RELIABLE_READER_DEPTH_MIN))
        }
        History::KeepLast(n) => History::KeepLast(n.saturating_mul(several)),
    };
    Qos {
        reliability: offer.reliability,
        durability: offer.durability,
        history,
        partitions: offer.partitions.clone(),
        representations: Representations::BOTH,
        ..Qos::default()
    }
}

/// A policy that a subscriber requests and a publisher offers (DDS 1.4, 2.2.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum QosPolicy {
    /// Whether samples are acknowledged.
    Reliability,
    /// Whether late joiners get earlier samples.
    Durability,
    /// Longest time between samples.
    Deadline,
    /// The way in which a publisher shows that it is alive.
    Liveliness,
    /// Longest time between signs of life.
    Lease,
    /// The partitions of both.
    Partition,
    /// The serialisation of samples.
    Representation,
}

/// A policy in which a subscriber requests more than a publisher offers, so that DDS does not match them.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct QosMismatch {
    /// The policy.
    pub policy: QosPolicy,
    /// The offered value.
    pub offered: String,
    /// The requested value.
    pub requested: String,
}

impl QosMismatch {
    /// Returns the fix in words. `owner` is the node of the publisher.
    pub fn fix(&self, owner: &str) -> String {
        let (subscriber, publisher) = match self.policy {
            QosPolicy::Reliability => ("best effort", "reliable"),
            QosPolicy::Durability => ("volatile", "transient local"),
            QosPolicy::Deadline => ("a longer deadline, or none,", "a shorter deadline"),
            QosPolicy::Liveliness => ("automatic liveliness", "the liveliness that is asked for"),
            QosPolicy::Lease => ("a longer lease, or none,", "a shorter lease"),
            QosPolicy::Partition => ("the publisher's partition", "the subscriber's partition"),
            QosPolicy::Representation => {
                ("the publisher's data representation", "the subscriber's data representation")
            }
        };
        format!("Give the subscriber {subscriber} or the publisher at {owner} {publisher}")
    }
}

impl fmt::Display for QosMismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let policy = match self.policy {
            QosPolicy::Reliability => "reliability",
            QosPolicy::Durability => "durability",
            QosPolicy::Deadline => "deadline",
            QosPolicy::Liveliness => "liveliness",
            QosPolicy::Lease => "liveliness lease",
            QosPolicy::Partition => "partition",
            QosPolicy::Representation => "data representation",
        };
        let Self { offered, requested, .. } = self;
        write!(f, "{policy} {offered}, but a local subscriber asks for {requested}")
    }
}

/// Returns all policies in which a request exceeds an offer.
pub fn mismatches(offer: &Qos, request: &Qos) -> Vec<QosMismatch> {
    let mut found = Vec::new();
    let mut differ = |policy, offered: String, requested: String| {
        found.push(QosMismatch { policy, offered, requested });
    };
    if offer.reliability < request.reliability {
        let name = |r| if r == Reliability::Reliable { "reliable" } else { "best effort" };
        differ(QosPolicy::Reliability, name(offer.reliability).into(), name(request.reliability).into());
    }
    if offer.durability < request.durability {
        let name = |d| match d {
            Durability::Volatile => "volatile",
            Durability::TransientLocal => "transient local",
            Durability::Transient => "transient",
            Durability::Persistent => "persistent",
        };
        differ(QosPolicy::Durability, name(offer.durability).into(), name(request.durability).into());
    }
    let time = |ns: Option<u64>| ns.map_or("none".into(), |ns| format!("{:?}", Duration::from_nanos(ns)));
    let is_longer = |a: Option<u64>, b: Option<u64>| a.unwrap_or(u64::MAX) > b.unwrap_or(u64::MAX);
    if is_longer(offer.deadline_ns, request.deadline_ns) {
        differ(QosPolicy::Deadline, time(offer.deadline_ns), time(request.deadline_ns));
    }
    let rank = |kind| match kind {
        Liveliness::Automatic => (0, "automatic"),
        Liveliness::ManualByParticipant => (1, "manual by participant"),
        Liveliness::ManualByTopic => (2, "manual by topic"),
    };
    let (offered, requested) = (rank(offer.liveliness), rank(request.liveliness));
    if offered.0 < requested.0 {
        differ(QosPolicy::Liveliness, offered.1.into(), requested.1.into());
    }
    if is_longer(offer.lease_ns, request.lease_ns) {
        differ(QosPolicy::Lease, time(offer.lease_ns), time(request.lease_ns));
    }
    if !partitions_meet(&offer.partitions, &request.partitions) {
        let list = |p: &[String]| if p.is_empty() { "\"\"".into() } else { format!("{p:?}") };
        differ(QosPolicy::Partition, list(&offer.partitions), list(&request.partitions));
    }
    // The local writer uses one representation, whatever the remote publishers offer together.
    let (written, taken) = (offer.representations.written(), request.representations);
    if !written.meets(taken) {
        differ(QosPolicy::Representation, format!("{written:?}"), format!("{taken:?}"));
    }
    found
}

/// Returns `true` if two lists of partitions match: they share a name, or a pattern of one matches a name of the
/// other. An empty list stands for the default partition, whose name is empty.
fn partitions_meet(a: &[String], b: &[String]) -> bool {
    let or_default = |list: &[String]| if list.is_empty() { vec![String::new()] } else { list.to_vec() };
    let (a, b) = (or_default(a), or_default(b));
    let is_pattern = |p: &str| p.contains(['*', '?', '[']);
    let meet = |a: &str, b: &str| match (is_pattern(a), is_pattern(b)) {
        (false, false) => a == b,
        (true, false) => fits(a.as_bytes(), b.as_bytes()),
        (false, true) => fits(b.as_bytes(), a.as_bytes()),
        (true, true) => false,
    };
    a.iter().any(|a| b.iter().any(|b| meet(a, b)))
}

/// Returns `true` if a name matches a pattern of `*` and `?`. Only the last `*` needs to be retried.
fn fits(pattern: &[u8], name: &[u8]) -> bool {
    let (mut p, mut n) = (0, 0);
    let mut star: Option<(usize, usize)> = None;
    while n < name.len() {
        match pattern.get(p) {
            Some(b'*') => {
                star = Some((p, n));
                p += 1;
            }
            Some(c) if *c == b'?' || *c == name[n] => (p, n) = (p + 1, n + 1),
            _ => match star {
                Some((at, from)) => {
                    star = Some((at, from + 1));
                    (p, n) = (at + 1, from + 1);
                }
                None => return false,
            },
        }
    }
    pattern[p..].iter().all(|c| *c == b'*')
}

fn longest(a: Option<u64>, b: Option<u64>) -> Option<u64> {
    a.zip(b).map(|(a, b)| a.max(b))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_of_the_weakest_offer_matches_every_writer() {
        let strong = Qos {
            durability: Durability::TransientLocal,
            history: History::KeepLast(1),
            deadline_ns: Some(5),
            lifespan_ns: Some(9),
            liveliness: Liveliness::ManualByTopic,
            partitions: vec!["b".into()],
            ..Qos::default()
        };
        let weak = Qos {
            reliability: Reliability::BestEffort,
            history: History::KeepLast(7),
            partitions: vec!["a".into()],
            representations: Representations::XCDR2,
            ..Qos::default()
        };
        assert_eq!(weakest([&strong]), Some(strong.clone()));
        let both = weakest([&strong, &weak]).unwrap();
        let representations = Representations::BOTH;
        assert_eq!(both, Qos { partitions: vec!["a".into(), "b".into()], representations, ..weak });
        assert_eq!(weakest([]), None);
    }

    #[test]
    fn readers_have_room_for_every_writers_history() {
        let latched =
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(40), ..Qos::default() };
        assert_eq!(reader_for(&latched, 5).history, History::KeepLast(200));
        assert_eq!(reader_for(&Qos::default(), 5).history, History::KeepLast(RELIABLE_READER_DEPTH_MIN));
        let sensor = Qos {
            reliability: Reliability::BestEffort,
            history: History::KeepLast(5),
            deadline_ns: Some(1),
            ..Qos::default()
        };
        let reader = reader_for(&sensor, 1);
        assert_eq!((reader.history, reader.deadline_ns), (History::KeepLast(5), None));
    }

    #[test]
    fn every_policy_that_keeps_two_apart_is_named_with_both_values() {
        let offer = Qos {
            reliability: Reliability::BestEffort,
            deadline_ns: Some(200_000_000),
            lease_ns: None,
            partitions: vec!["robot".into()],
            ..Qos::default()
        };
        let request = Qos {
            durability: Durability::TransientLocal,
            deadline_ns: Some(100_000_000),
            liveliness: Liveliness::ManualByTopic,
            lease_ns: Some(1_500_000_000),
            ..Qos::default()
        };
        let found = mismatches(&offer, &request);
        let said: Vec<_> = found.iter().map(ToString::to_string).collect();
        let expected = [
            "reliability best effort, but a local subscriber asks for reliable",
            "durability volatile, but a local subscriber asks for transient local",
            "deadline 200ms, but a local subscriber asks for 100ms",
            "liveliness automatic, but a local subscriber asks for manual by topic",
            "liveliness lease none, but a local subscriber asks for 1.5s",
            "partition [\"robot\"], but a local subscriber asks for \"\"",
        ];
        assert_eq!(said, expected);
        assert!(found.iter().all(|m| m.fix("arm-1").contains("arm-1")));
        assert_eq!(mismatches(&request, &request), []);
        assert_eq!(mismatches(&request, &Qos { reliability: Reliability::BestEffort, ..Qos::default() }), []);
    }

    #[test]
    fn partitions_meet_as_in_dds() {
        let meet = |a: &[&str], b: &[&str]| {
            let own = |list: &[&str]| list.iter().map(|p| (*p).to_owned()).collect::<Vec<_>>();
            let (a, b) = (own(a), own(b));
            assert_eq!(partitions_meet(&a, &b), partitions_meet(&b, &a));
            partitions_meet(&a, &b)
        };
        assert!(meet(&[], &[]) && meet(&[], &["*"]) && meet(&["a", "b"], &["b", "c"]));
        assert!(meet(&["r*"], &["robot"]) && meet(&["r?b*t"], &["robot"]) && meet(&["*o*o*"], &["robot"]));
        assert!(!meet(&[], &["a"]) && !meet(&["a"], &["b"]) && !meet(&["a*"], &["a*b"]));
        assert!(!meet(&["r?b"], &["robot"]) && !meet(&["*x*"], &["robot"]));
    }
}
