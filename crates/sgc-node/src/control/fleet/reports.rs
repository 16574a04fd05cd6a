//! Reports that this node gives observers: who may ask, the questions that wait, and the last documents.
//!
//! A document is a copy of the node's state. One is made at a time, and the next a while later, so that observers who
//! ask much wait for each other and the control task for none.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{NodeId, Report, ReportQuestion, SinkId};

/// Time for which a report is given again.
const REPORT_KEPT: Duration = Duration::from_millis(500);
/// Most reports that are kept.
const REPORTS_KEPT_MAX: usize = 8;
/// Time between the beginnings of two documents.
const REPORT_INTERVAL: Duration = Duration::from_millis(50);

/// The last question of an observer that waits.
#[derive(Debug)]
struct Waiting {
    peer: VerifiedPeer,
    sink: SinkId,
    question: ReportQuestion,
    /// The turn of the node. Another question of it takes the place with its turn.
    turn: u64,
}

/// The observers of this node, and the reports that they got last.
#[derive(Debug, Default)]
pub(crate) struct Reports {
    observers: Grantees,
    kept: BTreeMap<ReportQuestion, (Instant, Report)>,
    /// At most one question of each node; the endpoint has places for few nodes.
    waiting: BTreeMap<NodeId, Waiting>,
    /// The turn of the next node that begins to wait.
    next_turn: u64,
    /// Whether a document is being made.
    is_making: bool,
    /// Time from which the next document may be made.
    next_at: Option<Instant>,
}

impl Reports {
    /// Sets the observers. Returns whether there are any, and the sinks of nodes that wait and are none any more.
    pub(crate) fn set_observers(&mut self, observers: Grantees) -> (bool, Vec<SinkId>) {
        let gone = self.take_waiting(|waiting| observers.find(&waiting.peer).is_none());
        self.observers = observers;
        (!self.observers.is_empty(), gone)
    }

    /// Returns `true` if a peer is an observer.
    pub(crate) fn may_ask(&self, peer: &VerifiedPeer) -> bool {
        self.observers.find(peer).is_some()
    }

    /// Takes a question of an observer, in place of an earlier one. Returns the report that it got a moment ago.
    pub(crate) fn ask(
        &mut self,
        now: Instant,
        peer: &VerifiedPeer,
        sink: SinkId,
        question: ReportQuestion,
    ) -> Option<Report> {
        self.kept.retain(|_, (made, _)| now.saturating_duration_since(*made) < REPORT_KEPT);
        if let Some((_, report)) = self.kept.get(&question) {
            return Some(report.clone());
        }
        let turn = self.waiting.get(&peer.node_id).map_or(self.next_turn, |waiting| waiting.turn);
        self.next_turn += 1;
        self.waiting.insert(peer.node_id, Waiting { peer: peer.clone(), sink, question, turn });
        None
    }

    /// Returns the question for which a document is to be made now.
    pub(crate) fn next(&mut self, now: Instant) -> Option<ReportQuestion> {
        if self.is_making || self.next_at.is_some_and(|at| at > now) {
            return None;
        }
        let question = self.waiting.values().min_by_key(|waiting| waiting.turn)?.question.clone();
        (self.is_making, self.next_at) = (true, Some(now + REPORT_INTERVAL));
        Some(question)
    }

    /// Returns the time at which to call [`Reports::next`].
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.next_at.filter(|_| !self.is_making && !self.waiting.is_empty())
    }

    /// Takes the report that was made; `None` if the document is too long for one. Returns the sinks that wait for it.
    pub(crate) fn made(
        &mut self,
        now: Instant,
        question: ReportQuestion,
        report: Option<&Report>,
    ) -> Vec<SinkId> {
        self.is_making = false;
        let answered = self.take_waiting(|waiting| waiting.question == question);
        if let Some(report) = report {
            let oldest = self.kept.iter().min_by_key(|(_, (made, _))| *made).map(|(q, _)| q.clone());
            if let Some(oldest) = oldest.filter(|_| self.kept.len() >= REPORTS_KEPT_MAX) {
                self.kept.remove(&oldest);
            }
            self.kept.insert(question, (now, report.clone()));
        }
        answered
    }

    /// Removes the questions that are wanted. Returns their sinks.
    fn take_waiting(&mut self, is_wanted: impl Fn(&Waiting) -> bool) -> Vec<SinkId> {
        let mut taken = Vec::new();
        self.waiting.retain(|_, waiting| {
            let is_taken = is_wanted(waiting);
            if is_taken {
                taken.push(waiting.sink);
            }
            !is_taken
        });
        taken
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use bytes::Bytes;
    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;
    use sgc_trust::{EnrollRequest, Fleet};
    use sgc_wire::{PayloadEncoding, UnixMillis};

    use super::*;

    const A: SinkId = SinkId([1; 16]);
    const B: SinkId = SinkId([2; 16]);

    fn report(text: &'static str) -> Report {
        Report { encoding: PayloadEncoding::Plain, document: Bytes::from_static(text.as_bytes()) }
    }

    fn interface(n: usize) -> ReportQuestion {
        ReportQuestion::Interface(format!("/{n}"))
    }

    /// Returns two nodes of a fleet.
    fn peers() -> [VerifiedPeer; 2] {
        let (now, mut rng) = (UnixMillis(1_795_000_000_000), ChaCha20Rng::seed_from_u64(1));
        let mut fleet = Fleet::create("lab".parse().unwrap(), now, &mut rng).unwrap();
        ["arm", "desk"].map(|name| {
            let request = EnrollRequest::new(name.parse().unwrap(), now);
            fleet.enroll(&request, &mut rng).unwrap().as_peer().clone()
        })
    }

    #[test]
    fn one_document_answers_all_who_ask_for_half_a_second() {
        let (begin, mut reports, [arm, desk]) = (Instant::now(), Reports::default(), peers());
        let question = || ReportQuestion::Node;
        assert_eq!(reports.ask(begin, &arm, A, question()), None);
        assert_eq!(reports.next(begin), Some(question()));
        assert_eq!(reports.ask(begin, &desk, B, question()), None);
        assert_eq!((reports.next(begin), reports.deadline()), (None, None), "one is being made");
        let mut answered = reports.made(begin, question(), Some(&report("a")));
        answered.sort();
        assert_eq!(answered, [A, B]);
        let soon = begin + REPORT_KEPT / 2;
        assert_eq!(reports.ask(soon, &arm, A, question()), Some(report("a")));
        assert_eq!(reports.ask(begin + REPORT_KEPT, &arm, A, question()), None);
        assert_eq!(reports.next(begin + REPORT_KEPT), Some(question()));
        assert_eq!(reports.made(begin, question(), None), [A], "it was too long");
        assert!(reports.kept.is_empty());
    }

    #[test]
    fn observer_that_asks_much_waits_and_keeps_one_place() {
        let (begin, mut reports, [arm, desk]) = (Instant::now(), Reports::default(), peers());
        assert_eq!(reports.ask(begin, &arm, A, interface(0)), None);
        assert_eq!(reports.next(begin), Some(interface(0)));
        for n in 1..100 {
            assert_eq!(reports.ask(begin, &arm, A, interface(n)), None);
        }
        assert_eq!(reports.waiting.len(), 1);
        assert!(reports.made(begin, interface(0), Some(&report("a"))).is_empty(), "nobody wants it any more");
        assert_eq!((reports.next(begin), reports.deadline()), (None, Some(begin + REPORT_INTERVAL)));
        assert_eq!(reports.next(begin + REPORT_INTERVAL), Some(interface(99)));
        assert_eq!(reports.made(begin, interface(99), None), [A]);
        for n in 0..2 * REPORTS_KEPT_MAX {
            reports.ask(begin, &desk, B, interface(200 + n));
            assert_eq!(reports.made(begin, interface(200 + n), Some(&report("b"))), [B]);
        }
        assert_eq!(reports.kept.len(), REPORTS_KEPT_MAX);
    }

    #[test]
    fn observer_that_asks_much_does_not_keep_another_waiting() {
        for [flooding, patient] in [[0, 1], [1, 0]] {
            let (mut now, mut reports, peers) = (Instant::now(), Reports::default(), peers());
            let (mut asked, mut served) = (0, Vec::new());
            let mut flood = |reports: &mut Reports, now| {
                asked += 1;
                reports.ask(now, &peers[flooding], A, interface(asked));
            };
            flood(&mut reports, now);
            reports.ask(now, &peers[patient], B, ReportQuestion::Node);
            for _ in 0..3 {
                let question = reports.next(now).unwrap();
                served.extend(reports.made(now, question, None));
                flood(&mut reports, now);
                now += REPORT_INTERVAL;
            }
            assert_eq!(served[..2], [A, B], "each in its turn");
        }
    }

    #[test]
    fn node_that_waits_is_refused_when_it_is_no_observer_any_more() {
        let (now, mut reports, [arm, desk]) = (Instant::now(), Reports::default(), peers());
        let only = |peer: &VerifiedPeer| Grantees { nodes: [peer.node_id].into(), ..Grantees::default() };
        for (peer, sink) in [(&arm, A), (&desk, B)] {
            reports.ask(now, peer, sink, ReportQuestion::Node);
        }
        assert_eq!(reports.set_observers(only(&arm)), (true, vec![B]));
        assert!(reports.may_ask(&arm) && !reports.may_ask(&desk));
        assert_eq!(reports.made(now, ReportQuestion::Node, Some(&report("a"))), [A]);
        assert_eq!(reports.set_observers(Grantees::default()), (false, vec![]));
    }
}
