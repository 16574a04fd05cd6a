//! The documents of the page.

use std::collections::BTreeMap;
use std::time::Duration;

use serde::Serialize;
use sgc_diagnosis::fleet::{FaultOfNodes, FleetStatus};
use sgc_diagnosis::refusals::drop_meaning;
use sgc_diagnosis::rights::Recipients;
use sgc_diagnosis::{Step, Verdict};

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
    /// The meaning of each counter.
    meanings: BTreeMap<&'a str, String>,
}

impl<'a> FleetView<'a> {
    pub(crate) fn new(seq: u64, error: Option<String>, fleet: &'a FleetStatus) -> Self {
        let reports = fleet.nodes.iter().filter_map(|node| node.report.as_ref());
        let reasons = reports.flat_map(|report| report.drops.keys());
        let meanings = reasons.map(|reason| (reason.as_str(), drop_meaning(reason))).collect();
        let (faults, known, recipients) = (fleet.attention(), fleet.known(), fleet.recipients());
        Self { seq, error, summary: fleet.summary(), fleet, faults, known, recipients, meanings }
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
