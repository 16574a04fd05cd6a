//! Steps of a walk along the path of a topic.

use serde::Serialize;

use crate::finding::{Finding, NodeFinding};

/// The result of a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// The step is in order.
    Fine,
    /// The step has a fault.
    Wrong,
    /// This node cannot know, or the finding need not be a fault.
    Unknown,
}

/// One step of the path. `words` has its methods that render it.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// The result.
    pub verdict: Verdict,
    pub(crate) finding: Finding,
}

/// The steps of a walk. A fault is the last of them.
pub(crate) type Walk = Vec<Step>;

impl Step {
    /// Returns the fault that no node answers.
    pub fn no_node(error: String) -> Self {
        Self::wrong(Finding::Node(NodeFinding::Absent { error }))
    }

    /// Returns a step that is in order.
    pub(crate) fn fine(finding: Finding) -> Self {
        Self { verdict: Verdict::Fine, finding }
    }

    /// Returns a fault.
    pub(crate) fn wrong(finding: Finding) -> Self {
        Self { verdict: Verdict::Wrong, finding }
    }

    /// Returns a finding that need not be a fault.
    pub(crate) fn unknown(finding: Finding) -> Self {
        Self { verdict: Verdict::Unknown, finding }
    }
}
