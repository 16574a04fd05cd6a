//! Faults that a rule finds, with the places where they stand.

/// The result of one rule over all documents.
#[derive(Debug, Default)]
pub(crate) struct Report {
    faults: Vec<String>,
    checked: usize,
}

impl Report {
    /// Counts a citation, and notes a fault if it is one.
    pub(crate) fn check(&mut self, document: &str, line: usize, outcome: Result<(), String>) {
        self.checked += 1;
        if let Err(fault) = outcome {
            self.faults.push(format!("{document}:{line}: {fault}"));
        }
    }

    /// Fails the test if there are faults, or if so few citations were recognised that the rule looks past them.
    #[track_caller]
    pub(crate) fn finish(self, least: usize, advice: &str) {
        assert!(self.faults.is_empty(), "{advice}\n  {}", self.faults.join("\n  "));
        assert!(
            self.checked >= least,
            "only {} citations were recognised, of {least} at least",
            self.checked
        );
    }

    /// Returns the faults, for tests of the rules themselves.
    pub(crate) fn faults(&self) -> String {
        self.faults.join("; ")
    }

    /// Returns the faults that a rule finds.
    pub(crate) fn faults_of(rule: impl FnOnce(&mut Self)) -> String {
        let mut report = Self::default();
        rule(&mut report);
        report.faults()
    }
}
