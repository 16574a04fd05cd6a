//! Reports that this node gives observers: who may ask, and the last documents.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{Report, ReportQuestion, SinkId};

/// Time for which a report is given again, so that a document is made at most twice a second for each question.
pub(crate) const REPORT_KEPT: Duration = Duration::from_millis(500);
/// Most reports that are kept.
const REPORTS_KEPT_MAX: usize = 8;

/// Most questions that wait for a document under way.
const REPORTS_WAITING_MAX: usize = 256;

/// Next step for a question.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum ReportStep {
    /// Send this report.
    Answer(Report),
    /// Make a document. [`Reports::made`] has those who wait for it.
    Make,
    /// A document for this question is being made.
    UnderWay,
    /// Too many wait.
    Full,
}

/// The observers of this node, and the reports that they got last.
#[derive(Debug, Default)]
pub(crate) struct Reports {
    observers: Grantees,
    kept: BTreeMap<ReportQuestion, (Instant, Report)>,
    /// The sinks that wait, by their question.
    waiting: BTreeMap<ReportQuestion, Vec<SinkId>>,
}

impl Reports {
    /// Sets the observers. Returns whether there are any.
    pub(crate) fn set_observers(&mut self, observers: Grantees) -> bool {
        self.observers = observers;
        !self.observers.is_empty()
    }

    /// Returns `true` if a peer is an observer.
    pub(crate) fn may_ask(&self, peer: &VerifiedPeer) -> bool {
        self.observers.find(peer).is_some()
    }

    /// Takes a question of an observer.
    pub(crate) fn ask(&mut self, now: Instant, question: &ReportQuestion, sink: SinkId) -> ReportStep {
        self.kept.retain(|_, (made, _)| now.saturating_duration_since(*made) < REPORT_KEPT);
        if let Some((_, report)) = self.kept.get(question) {
            return ReportStep::Answer(report.clone());
        }
        if self.waiting.values().map(Vec::len).sum::<usize>() >= REPORTS_WAITING_MAX {
            return ReportStep::Full;
        }
        match self.waiting.get_mut(question) {
            Some(waiting) => {
                waiting.push(sink);
                ReportStep::UnderWay
            }
            None => {
                self.waiting.insert(question.clone(), vec![sink]);
                ReportStep::Make
            }
        }
    }

    /// Takes a report that was made; `None` if the document is too long for one. Returns the sinks that wait for it.
    pub(crate) fn made(
        &mut self,
        now: Instant,
        question: ReportQuestion,
        report: Option<&Report>,
    ) -> Vec<SinkId> {
        let waiting = self.waiting.remove(&question).unwrap_or_default();
        if let Some(report) = report {
            let oldest = self.kept.iter().min_by_key(|(_, (made, _))| *made).map(|(q, _)| q.clone());
            if let Some(oldest) = oldest.filter(|_| self.kept.len() >= REPORTS_KEPT_MAX) {
                self.kept.remove(&oldest);
            }
            self.kept.insert(question, (now, report.clone()));
        }
        waiting
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_wire::PayloadEncoding;

    use super::*;

    const A: SinkId = SinkId([1; 16]);
    const B: SinkId = SinkId([2; 16]);

    fn report(text: &'static str) -> Report {
        Report { encoding: PayloadEncoding::Plain, document: Bytes::from_static(text.as_bytes()) }
    }

    fn interface(n: usize) -> ReportQuestion {
        ReportQuestion::Interface(format!("/{n}"))
    }

    #[test]
    fn one_document_answers_all_who_ask_for_half_a_second() {
        let (begin, mut reports) = (Instant::now(), Reports::default());
        let question = ReportQuestion::Condition;
        assert_eq!(reports.ask(begin, &question, A), ReportStep::Make);
        assert_eq!(reports.ask(begin, &question, B), ReportStep::UnderWay);
        assert_eq!(reports.ask(begin, &interface(0), B), ReportStep::Make);
        assert_eq!(reports.made(begin, question.clone(), Some(&report("a"))), [A, B]);
        let soon = begin + REPORT_KEPT / 2;
        assert_eq!(reports.ask(soon, &question, B), ReportStep::Answer(report("a")));
        assert_eq!(reports.ask(begin + REPORT_KEPT, &question, B), ReportStep::Make);
        assert_eq!(reports.made(begin, interface(0), None), [B], "it was too long");
        assert_eq!(reports.ask(begin, &interface(0), A), ReportStep::Make);
    }

    #[test]
    fn questions_that_wait_and_reports_that_are_kept_are_bounded() {
        let (now, mut reports) = (Instant::now(), Reports::default());
        let asked: Vec<_> =
            (0..=REPORTS_WAITING_MAX).map(|n| reports.ask(now, &interface(n / 2), A)).collect();
        assert_eq!(
            (&asked[..2], asked.last()),
            (&[ReportStep::Make, ReportStep::UnderWay][..], Some(&ReportStep::Full))
        );
        for n in 0..2 * REPORTS_KEPT_MAX {
            assert_eq!(reports.made(now, interface(n), Some(&report("b"))), [A, A]);
        }
        assert_eq!(reports.kept.len(), REPORTS_KEPT_MAX);
    }
}
