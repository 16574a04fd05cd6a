//! Figures of several rounds, of which the middle one counts.

use std::collections::BTreeMap;

use anyhow::Result;

use super::lab::PathKind;
use super::{Compare, Figures};
use crate::report::median;

/// Figures by where they belong, in each round.
#[derive(Debug)]
pub(crate) struct Tally {
    table: &'static str,
    /// Figures by system, path, at and metric. `at` is a whole number in every table and is ordered as such.
    rounds: BTreeMap<(String, &'static str, u64, &'static str), Vec<f64>>,
}

impl Tally {
    /// Returns an empty tally of a table.
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

/// A round of a table over the bare path.
pub(crate) struct Round<'a> {
    compare: &'a Compare,
    figures: &'a mut Figures,
    tally: Tally,
    /// Its number, from 0.
    pub(crate) number: usize,
}

impl Round<'_> {
    /// Measures a table over the bare path in so many rounds, if that is asked for.
    pub(crate) fn all(
        compare: &Compare,
        figures: &mut Figures,
        table: &'static str,
        rounds: usize,
        mut run: impl FnMut(&mut Round<'_>),
    ) {
        if compare.wants_path(&PathKind::Bare) {
            let mut round = Round { compare, figures, tally: Tally::new(table), number: 0 };
            for number in 0..rounds {
                round.number = number;
                run(&mut round);
            }
            round.tally.write(round.figures);
        }
    }

    /// Measures one thing of it; what fails is left out.
    pub(crate) fn measure(&mut self, what: &str, measure: impl FnOnce(&mut Tally) -> Result<()>) {
        let table = self.tally.table;
        self.compare.note(&format!("{table}, round {}: {what}", self.number));
        if let Err(error) = measure(&mut self.tally) {
            self.figures.leave_out(&format!("{table} {what}"), format!("{error:#}"));
        }
    }
}
