//! The documents of the page.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use sgc_diagnosis::fleet::{FaultOfNodes, FleetStatus};
use sgc_diagnosis::refusals::drop_meaning;
use sgc_diagnosis::rights::Recipients;
use sgc_diagnosis::{Step, Verdict};
use sgc_node::admin::AuditAnswer;
use sgc_node::admin::not_direct::NotDirectReason;
use sgc_node::admin::report::ReportEvent;
use sgc_node::audit::AUDIT_ID_CHARS;

/// The fleet as the page shows it.
#[derive(Debug, Serialize)]
pub(crate) struct FleetView<'a> {
    /// The number of the document; a later one is larger.
    pub(crate) seq: u64,
    /// The reason why the fleet cannot be seen. What is shown is then older.
    pub(crate) error: Option<String>,
    /// The numbers of nodes, as a sentence.
    summary: String,
    fleet: &'a FleetStatus,
    faults: Vec<FaultOfNodes>,
    /// Names of nodes by their ids, and whether they may route for others.
    known: &'a BTreeMap<String, (String, bool)>,
    /// The members that rules permit.
    recipients: Recipients,
    audit: &'a AuditView,
    /// The meaning of each counter.
    meanings: BTreeMap<&'a str, String>,
    /// The reasons why there is no direct link.
    not_direct: BTreeMap<NotDirectReason, NotDirectView>,
}

/// A reason why there is no direct link.
#[derive(Debug, Serialize)]
struct NotDirectView {
    why: String,
    /// The remedy; empty if there is none to name.
    fix: &'static str,
}

impl<'a> FleetView<'a> {
    pub(crate) fn new(seq: u64, error: Option<String>, fleet: &'a FleetStatus, audit: &'a AuditView) -> Self {
        let reports = fleet.nodes.iter().filter_map(|node| node.report.as_ref());
        let reasons = reports.flat_map(|report| report.drops.keys());
        let meanings = reasons.map(|reason| (reason.as_str(), drop_meaning(reason))).collect();
        let (faults, known, recipients) = (fleet.attention(), fleet.known(), fleet.recipients());
        let reasons = NotDirectReason::ALL.into_iter().chain([NotDirectReason::Other]);
        let not_direct = reasons
            .map(|reason| (reason, NotDirectView { why: reason.to_string(), fix: reason.fix() }))
            .collect();
        Self {
            seq,
            error,
            summary: fleet.summary(),
            fleet,
            faults,
            known,
            recipients,
            audit,
            meanings,
            not_direct,
        }
    }
}

/// The last events of audit logs.
#[derive(Debug, Default, Serialize)]
pub(crate) struct AuditView {
    /// The events of the node here and those of the authority, the newest first.
    events: Vec<EventView>,
    /// The reasons why events are not known.
    gaps: Vec<String>,
}

#[derive(Debug, Serialize)]
struct EventView {
    /// The name of the node whose log has the event.
    node: String,
    #[serde(flatten)]
    event: ReportEvent,
}

impl AuditView {
    /// Joins the log of the node here with what authorities report.
    pub(crate) fn new(own: &Result<AuditAnswer, String>, fleet: &FleetStatus) -> Self {
        let mut view = Self::default();
        match own {
            Ok(AuditAnswer { node, records: Some(records) }) => {
                let event = |record| EventView { node: node.clone(), event: ReportEvent::new(record) };
                view.events.extend(records.iter().map(event));
            }
            Ok(AuditAnswer { node, records: None }) => {
                view.gaps
                    .push(format!("{node} keeps no audit log: [audit] is off, or it has no state directory"));
            }
            Err(why) => view.gaps.push(format!("the log of the node here is not known: {why}")),
        }
        // The own log has these, and others.
        let own = own.as_ref().map(|own| own.node.as_str()).unwrap_or_default();
        for node in fleet.nodes.iter().filter(|node| node.name != own) {
            let Some(report) = &node.report else { continue };
            for event in report.events.iter().flatten() {
                view.events.push(EventView { node: node.name.clone(), event: event.clone() });
            }
            if report.members.is_some() && report.events.is_none() {
                view.gaps.push(format!("{} does not report its log", node.name));
            }
        }
        for EventView { event, .. } in &mut view.events {
            name_peer(event, fleet.known());
        }
        view.events.sort_by_key(|one| std::cmp::Reverse(one.event.time_ms));
        view
    }
}

/// Names a peer of which a log has only the beginning of its id, if it is a node of the fleet.
fn name_peer(event: &mut ReportEvent, known: &BTreeMap<String, (String, bool)>) {
    let Some(peer) = event.peer.as_mut().filter(|peer| peer.len() == AUDIT_ID_CHARS) else { return };
    let mut meant = known.range(peer.clone()..).take_while(|(id, _)| id.starts_with(peer.as_str()));
    if let (Some((_, (name, _))), None) = (meant.next(), meant.next()) {
        *peer = name.clone();
    }
}

/// Returns the document as the page gets it: with the time since the node here last answered, milliseconds, null for
/// either if there is none yet, and with whether the page may revoke nodes.
pub(crate) fn enclosed(age: Option<Duration>, may_operate: bool, view: &[u8]) -> String {
    let age = age.map_or_else(|| "null".to_owned(), |age| age.as_millis().to_string());
    let view = if view.is_empty() { "null".into() } else { String::from_utf8_lossy(view) };
    format!("{{\"age_ms\":{age},\"may_operate\":{may_operate},\"view\":{view}}}")
}

/// The steps on the way of an interface, or the reason why they are not known.
#[derive(Debug, Serialize)]
pub(crate) struct WhyView {
    error: Option<String>,
    steps: Vec<StepView>,
}

#[derive(Debug, Serialize)]
struct StepView {
    verdict: Verdict,
    found: String,
    fix: Option<String>,
}

impl WhyView {
    pub(crate) fn new(steps: Result<Vec<Step>, String>) -> Self {
        let view = |step: Step| StepView { verdict: step.verdict, found: step.found(), fix: step.fix() };
        match steps {
            Ok(steps) => Self { error: None, steps: steps.into_iter().map(view).collect() },
            Err(error) => Self { error: Some(error), steps: Vec::new() },
        }
    }
}

#[cfg(test)]
mod tests {
    use sgc_node::admin::ReportAnswer;
    use sgc_node::admin::report::NodeReport;
    use sgc_node::audit::{AuditEvent, AuditRecord};
    use sgc_wire::UnixMillis;

    use super::*;

    fn event(time_ms: u64, event: &str) -> ReportEvent {
        ReportEvent { time_ms, event: event.into(), ..ReportEvent::default() }
    }

    fn keeper(events: Option<Vec<ReportEvent>>) -> FleetStatus {
        let report = NodeReport { members: Some(Vec::new()), events, ..NodeReport::default() };
        let answer = ReportAnswer { node: "keeper".into(), report: Some(report), ..ReportAnswer::default() };
        FleetStatus::new(UnixMillis(0), Vec::new(), vec![answer], &[])
    }

    fn own(node: &str) -> Result<AuditAnswer, String> {
        let record = |ms| AuditRecord::at(AuditEvent::LinkUp, UnixMillis(ms));
        Ok(AuditAnswer { node: node.into(), records: Some([1, 5].map(record).into()) })
    }

    fn seen(view: &AuditView) -> Vec<(&str, &str, u64)> {
        let events = view.events.iter();
        events.map(|one| (one.node.as_str(), one.event.event.as_str(), one.event.time_ms)).collect()
    }

    #[test]
    fn events_of_the_node_here_and_of_the_authority_come_newest_first_and_once() {
        let fleet = keeper(Some(vec![event(3, "operation"), event(7, "crl")]));
        let view = AuditView::new(&own("desk"), &fleet);
        let all = [
            ("keeper", "crl", 7),
            ("desk", "link_up", 5),
            ("keeper", "operation", 3),
            ("desk", "link_up", 1),
        ];
        assert_eq!((&seen(&view)[..], view.gaps.len()), (&all[..], 0));
        // The page of the authority's own node.
        let view = AuditView::new(&own("keeper"), &fleet);
        assert_eq!(seen(&view), [("keeper", "link_up", 5), ("keeper", "link_up", 1)]);
    }

    #[test]
    fn peer_is_named_by_the_beginning_of_its_id_if_only_one_node_has_it() {
        let known =
            ["11aabbccdd", "22aabbcc00", "22aabbcc11"].map(|id| (id.to_owned(), (format!("n{id}"), false)));
        for (peer, named) in [
            ("11aabbcc", "n11aabbccdd"),
            ("22aabbcc", "22aabbcc"),
            ("33aabbcc", "33aabbcc"),
            ("desk", "desk"),
        ] {
            let mut event = ReportEvent { peer: Some(peer.into()), ..ReportEvent::default() };
            name_peer(&mut event, &known.clone().into());
            assert_eq!(event.peer.as_deref(), Some(named));
        }
    }

    #[test]
    fn logs_that_are_not_known_are_named() {
        let off = Ok(AuditAnswer { node: "desk".into(), records: None });
        let view = AuditView::new(&off, &keeper(None));
        let gaps = [
            "desk keeps no audit log: [audit] is off, or it has no state directory",
            "keeper does not report its log",
        ];
        assert_eq!(view.gaps, gaps);
        let view = AuditView::new(&Err("no node runs".into()), &FleetStatus::default());
        assert_eq!(view.gaps, ["the log of the node here is not known: no node runs"]);
    }
}
