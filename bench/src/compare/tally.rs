//! Figures of several rounds, of which the middle one counts.

use std::collections::BTreeMap;

use super::Figures;
use crate::report::median;

/// Figures by where they belong, in each round.
#[derive(Debug)]
pub(crate) struct Tally {
    table: &'static str,
    /// By system, path, at and metric. What it is at is a whole number in every table, and has an order as such.
    rounds: BTreeMap<(String, &'static str, u64, &'static str), Vec<f64>>,
}

impl Tally {
    /// Of one table.
    pub(crate) fn new(table: &'static str) -> Self {
        Self { table, rounds: BTreeMap::new() }
    }

    /// Adds what a round had.
    pub(crate) fn add(
        &mut self,
        system: &str,
        path: &'static str,
        at: u64,
        metric: &'static str,
        value: f64,
    ) {
        self.rounds.entry((system.to_owned(), path, at, metric)).or_default().push(value);
    }

    /// Writes the middle of each down.
    pub(crate) fn write(self, figures: &mut Figures) {
        for ((system, path, at, metric), values) in self.rounds {
            figures.push(self.table, &system, path, at as f64, metric, median(values));
        }
    }
}
