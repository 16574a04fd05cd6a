//! The committed instruction counts of the hot functions, and the comparison with new ones.
//!
//! Rust code is always compared. Cryptography and the C library choose their code by the processor, so these are
//! compared only where valgrind shows the same processor as in the committed counts, and has the same version.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context as _, Result};
use serde::{Deserialize, Serialize};

use crate::profile::Parts;

/// Fraction by which a count may grow, and by which it may shrink before the table reports it.
const TOLERANCE: f64 = 0.05;
/// Number of instructions by which any count may differ, because five per cent of a small count are a handful.
const TOLERANCE_INSTRUCTIONS: u64 = 8;

/// Instructions of each case, for one repetition of its work.
pub(crate) type Counts = BTreeMap<String, Parts>;

/// The tools on which the counts depend besides the code.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Tools {
    /// The compiler.
    pub(crate) rustc: String,
    /// Valgrind.
    pub(crate) valgrind: String,
    /// The processor that valgrind shows to programs.
    pub(crate) cpu: String,
}

/// The committed file.
#[derive(Debug, Default, Serialize, Deserialize)]
pub(crate) struct Baseline {
    tools: Option<Tools>,
    counts: Counts,
}

/// The result of a comparison.
#[derive(Debug)]
pub(crate) struct Verdict {
    /// For people.
    pub(crate) table: String,
    /// No count grew, and none is missing.
    pub(crate) is_good: bool,
}

impl Baseline {
    /// Reads the file. Returns an empty baseline if there is none.
    pub(crate) fn read(file: &Path) -> Result<Self> {
        match std::fs::read(file) {
            Ok(text) => serde_json::from_slice(&text).with_context(|| format!("{}", file.display())),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error).with_context(|| format!("{}", file.display())),
        }
    }

    /// Writes the file.
    pub(crate) fn write(&self, file: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self)? + "\n";
        std::fs::write(file, text).with_context(|| format!("{}", file.display()))
    }

    /// Accepts these counts as the baseline. Removes all others if these are all cases.
    pub(crate) fn accept(&mut self, tools: Tools, counts: Counts, are_all: bool) {
        if are_all {
            self.counts.clear();
        }
        self.tools = Some(tools);
        self.counts.extend(counts);
    }

    /// Compares counts with the baseline. If these are all cases, one that only the baseline has is a mistake.
    pub(crate) fn compare(&self, tools: &Tools, counts: &Counts, are_all: bool) -> Verdict {
        let before = self.tools.as_ref();
        let is_same_cpu = before.is_some_and(|b| (&b.cpu, &b.valgrind) == (&tools.cpu, &tools.valgrind));
        let mut table = format!(
            "{:34} {:>9} {:>9} {:>8}   {:>12} {:>9} {:>10}\n",
            "instructions for one", "Rust", "before", "change", "AWS-LC, libc", "before", "change"
        );
        let (mut wrong, mut shrunk) = (Vec::new(), Vec::new());
        for (case, now) in counts {
            let Some(then) = self.counts.get(case) else {
                wrong.push(format!("{case} was never counted before"));
                let _ = writeln!(table, "{case:34} {:9} {:>9}", now.rust, "none");
                continue;
            };
            let (below, below_then) = (now.sum() - now.rust, then.sum() - then.rust);
            let mut changes = vec![("in Rust", then.rust, now.rust)];
            if is_same_cpu {
                changes.push(("below Rust", below_then, below));
            }
            for (whose, then, now) in changes {
                let allowed = ((then as f64 * TOLERANCE) as u64).max(TOLERANCE_INSTRUCTIONS);
                if now > then + allowed {
                    wrong.push(format!("{case}: {then} → {now} instructions {whose}"));
                } else if now + allowed < then {
                    shrunk.push(case.as_str());
                }
            }
            let change_below = if is_same_cpu { change(below_then, below) } else { "other CPU".into() };
            let _ = writeln!(
                table,
                "{case:34} {:9} {:9} {:>8}   {below:12} {below_then:9} {change_below:>10}",
                now.rust,
                then.rust,
                change(then.rust, now.rust),
            );
        }
        for case in self.counts.keys().filter(|case| are_all && !counts.contains_key(*case)) {
            wrong.push(format!("{case} is in the file and not counted any more"));
        }
        if let Some(before) = before.filter(|before| *before != tools) {
            let _ = writeln!(table, "\nbefore: {}\nnow:    {}", told(before), told(tools));
        }
        if !shrunk.is_empty() {
            let _ = writeln!(table, "\nless than before, so accept it: {}", shrunk.join(", "));
        }
        for line in &wrong {
            let _ = write!(table, "\n✗ {line}");
        }
        if wrong.is_empty() {
            let _ = write!(table, "\nnothing grew by more than {:.0} %", TOLERANCE * 100.0);
        } else {
            let _ = write!(
                table,
                "\nIf that is the price of something that is worth it, say so in the commit that brings\n\
                 bench/instructions.json up to date: make bench-instructions ARGS=--accept"
            );
        }
        Verdict { table, is_good: wrong.is_empty() }
    }
}

fn told(tools: &Tools) -> String {
    format!("{}, {}, {}", tools.rustc, tools.valgrind, tools.cpu)
}

fn change(then: u64, now: u64) -> String {
    if then == 0 {
        return if now == 0 { "=".into() } else { "new".into() };
    }
    format!("{:+.1} %", (now as f64 / then as f64 - 1.0) * 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tools(cpu: &str) -> Tools {
        Tools { rustc: "rustc 1".into(), valgrind: "valgrind 3".into(), cpu: cpu.into() }
    }

    fn counts(rust: u64, cryptography: u64) -> Counts {
        [("case".to_owned(), Parts { rust, cryptography, libc: 0 })].into()
    }

    fn baseline() -> Baseline {
        let mut baseline = Baseline::default();
        baseline.accept(tools("aes"), counts(1000, 1000), true);
        baseline
    }

    #[test]
    fn only_growth_beyond_tolerance_is_found() {
        let is_good = |now: Counts| baseline().compare(&tools("aes"), &now, true).is_good;
        assert!(is_good(counts(1050, 1050)));
        assert!(is_good(counts(10, 10)));
        assert!(!is_good(counts(1051, 1000)));
        assert!(!is_good(counts(1000, 1051)));
    }

    #[test]
    fn other_processor_limits_comparison_to_rust_code() {
        let verdict = baseline().compare(&tools("none"), &counts(1000, 9000), true);
        assert!(verdict.is_good && verdict.table.contains("other CPU"), "{}", verdict.table);
        assert!(!baseline().compare(&tools("none"), &counts(1100, 1000), true).is_good);
    }

    #[test]
    fn new_and_missing_cases_are_reported() {
        let mut now = counts(1000, 1000);
        now.insert("other".into(), Parts::default());
        let verdict = baseline().compare(&tools("aes"), &now, true);
        assert!(verdict.table.contains("other was never counted"), "{}", verdict.table);
        assert!(!verdict.is_good);
        assert!(!baseline().compare(&tools("aes"), &Counts::new(), true).is_good);
        assert!(baseline().compare(&tools("aes"), &Counts::new(), false).is_good);
    }

    #[test]
    fn accepted_counts_become_baseline() {
        let mut baseline = baseline();
        baseline.accept(tools("aes"), counts(5000, 5000), true);
        assert!(baseline.compare(&tools("aes"), &counts(5000, 5000), true).is_good);
    }
}
