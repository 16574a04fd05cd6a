//! Steps of a walk along the path of a topic: the findings of `sgc why`.

use serde::Serialize;
use sgc_process::output;

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

/// One step of the path.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Step {
    /// The result.
    pub verdict: Verdict,
    /// The finding.
    pub found: String,
    /// The advice how to mend it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fix: Option<String>,
}

impl Step {
    /// Returns a step that is in order.
    pub fn fine(found: impl Into<String>) -> Self {
        Self { verdict: Verdict::Fine, found: found.into(), fix: None }
    }

    /// Returns a fault and its remedy.
    pub fn wrong(found: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { verdict: Verdict::Wrong, found: found.into(), fix: Some(fix.into()) }
    }

    /// Returns a finding that need not be a fault.
    pub fn unknown(found: impl Into<String>) -> Self {
        Self { verdict: Verdict::Unknown, found: found.into(), fix: None }
    }

    /// Adds a remedy.
    #[must_use]
    pub fn with_fix(self, fix: impl Into<String>) -> Self {
        Self { fix: Some(fix.into()), ..self }
    }

    /// Returns the lines of `sgc why`: the finding behind a mark, and the advice.
    pub fn lines(&self) -> Vec<String> {
        let mark = match self.verdict {
            Verdict::Fine => '✓',
            Verdict::Wrong => '✗',
            Verdict::Unknown => '?',
        };
        let fix = self.fix.as_ref().map(|fix| format!("    {fix}"));
        [Some(format!("{mark} {}", self.found)), fix]
            .into_iter()
            .flatten()
            .map(|line| output::clean(&line))
            .collect()
    }
}
