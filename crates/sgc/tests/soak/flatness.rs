//! Judges whether the figures of processes stay flat. Pure: samples in, table out.

use std::fmt::Write as _;

/// A figure of a process that must not grow.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Figure {
    /// Resident memory in kB.
    Resident,
    /// The part of it that belongs to no file, in kB.
    Anonymous,
    /// Open file descriptors.
    Descriptors,
    Threads,
    /// Lines of `/metrics`.
    Series,
    /// Bytes that were logged since the sample before.
    LogBytes,
}

pub(crate) const FIGURES: [Figure; 6] = [
    Figure::Resident,
    Figure::Anonymous,
    Figure::Descriptors,
    Figure::Threads,
    Figure::Series,
    Figure::LogBytes,
];

/// A kind of node.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum Kind {
    Proxy,
    /// Its memory follows the number of topics that pass it, which changes as proxies change routers.
    Router,
}

impl Figure {
    pub(crate) fn name(self) -> &'static str {
        ["resident_kb", "anonymous_kb", "descriptors", "threads", "series", "log_bytes"][self as usize]
    }

    /// Returns the largest value that counts as no growth from this one: so much more, and this fraction of it.
    fn limit(self, kind: Kind, before: u64) -> u64 {
        let (more, percent) = match self {
            Self::Resident | Self::Anonymous if kind == Kind::Router => (8 * 1024, 30),
            Self::Resident => (8 * 1024, 10),
            Self::Anonymous => (4 * 1024, 10),
            Self::Descriptors => (8, 0),
            // Idle threads for blocking work stay for 10 s. How many there are follows how much came together, such as
            // the endpoints that a node creates after its start.
            Self::Threads => (8, 0),
            // A reason of drops gets its line when it happens first.
            Self::Series => (12, 5),
            // Follows the faults, which are random.
            Self::LogBytes => (1024, 100),
        };
        before + more + before * percent / 100
    }
}

/// A node at a moment.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    /// Number of the sampling.
    pub(crate) round: usize,
    /// Number of earlier samples of the same process.
    pub(crate) age: usize,
    pub(crate) figures: [u64; FIGURES.len()],
}

/// A line of the table.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Comparison {
    pub(crate) whose: String,
    pub(crate) figure: Figure,
    /// Medians of the second and the last quarter.
    pub(crate) before: u64,
    pub(crate) after: u64,
    pub(crate) limit: u64,
}

impl Comparison {
    fn new(whose: &str, kind: Kind, figure: Figure, before: u64, after: u64) -> Self {
        Self { whose: whose.to_owned(), figure, before, after, limit: figure.limit(kind, before) }
    }

    pub(crate) fn is_flat(&self) -> bool {
        self.after <= self.limit
    }
}

/// Fewest samples of an age in either quarter from which a median says something.
const SAMPLES_MIN: usize = 5;

/// Compares the quarters of a process that lived all the time.
pub(crate) fn compare_by_time(whose: &str, kind: Kind, samples: &[Sample], rounds: usize) -> Vec<Comparison> {
    let mut rows = Vec::new();
    for figure in FIGURES.into_iter().filter(|figure| *figure != Figure::LogBytes) {
        if let Some((before, after)) = medians(samples.iter(), figure, rounds) {
            rows.push(Comparison::new(whose, kind, figure, before, after));
        }
    }
    rows
}

/// Compares the quarters of processes that were restarted now and then, age by age: memory and descriptors follow the
/// age of a process, and a later process may hold more only if state grows from one to the next.
pub(crate) fn compare_by_age(whose: &str, kind: Kind, samples: &[Sample], rounds: usize) -> Vec<Comparison> {
    let mut rows = Vec::new();
    let oldest = samples.iter().map(|sample| sample.age).max().unwrap_or(0);
    // The first sample is of a process that still starts.
    let mut from = 1;
    while from <= oldest {
        let ages = from..2 * from;
        for figure in FIGURES.into_iter().filter(|figure| *figure != Figure::LogBytes) {
            let of_age = samples.iter().filter(|sample| ages.contains(&sample.age));
            if let Some((before, after)) = medians(of_age, figure, rounds) {
                let whose = format!("{whose}, ages {}–{}", ages.start, ages.end - 1);
                rows.push(Comparison::new(&whose, kind, figure, before, after));
            }
        }
        from *= 2;
    }
    rows
}

/// Compares the sums of all nodes' logs per round.
pub(crate) fn compare_logs<'a>(samples: impl Iterator<Item = &'a Sample>, rounds: usize) -> Comparison {
    let mut sums = vec![0; rounds];
    for sample in samples {
        sums[sample.round] += sample.figures[Figure::LogBytes as usize];
    }
    let mean = |rounds: std::ops::Range<usize>| {
        let part = &sums[rounds];
        part.iter().sum::<u64>() / part.len().max(1) as u64
    };
    let (second, last) = quarters(rounds);
    Comparison::new("all nodes, a round", Kind::Proxy, Figure::LogBytes, mean(second), mean(last))
}

/// Returns the rounds of the second and of the last quarter.
fn quarters(rounds: usize) -> (std::ops::Range<usize>, std::ops::Range<usize>) {
    (rounds / 4..rounds / 2, rounds * 3 / 4..rounds)
}

/// Returns the medians of a figure in the second and in the last quarter, or `None` for too few samples.
fn medians<'a>(
    samples: impl Iterator<Item = &'a Sample> + Clone,
    figure: Figure,
    rounds: usize,
) -> Option<(u64, u64)> {
    let (second, last) = quarters(rounds);
    let median = |rounds: std::ops::Range<usize>| {
        let part = samples.clone().filter(|sample| rounds.contains(&sample.round));
        let mut values: Vec<_> = part.map(|sample| sample.figures[figure as usize]).collect();
        values.sort_unstable();
        (values.len() >= SAMPLES_MIN).then(|| values[values.len() / 2])
    };
    Some((median(second)?, median(last)?))
}

/// Returns the comparisons as a table.
pub(crate) fn table<'a>(rows: impl IntoIterator<Item = &'a Comparison>) -> String {
    let mut text = format!(
        "{:<34} {:<13} {:>14} {:>13} {:>9}\n",
        "process", "figure", "second quarter", "last quarter", "at most"
    );
    for row in rows {
        let mark = if row.is_flat() { "" } else { "  GROWS" };
        let (name, before, after, limit) = (row.figure.name(), row.before, row.after, row.limit);
        let _ = writeln!(text, "{:<34} {name:<13} {before:>14} {after:>13} {limit:>9}{mark}", row.whose);
    }
    text
}

/// Samples of a process at all rounds, whose figures all have a value that follows from round and age.
#[cfg(test)]
fn process(rounds: std::ops::Range<usize>, value: impl Fn(usize, usize) -> u64) -> Vec<Sample> {
    let first = rounds.start;
    rounds
        .map(|round| {
            let age = round - first;
            Sample { round, age, figures: [value(round, age); FIGURES.len()] }
        })
        .collect()
}

#[test]
fn process_that_grows_late_is_told_from_one_that_only_warms_up() {
    let warms_up = process(0..80, |round, _| if round < 10 { 0 } else { 50_000 });
    let rows = compare_by_time("p", Kind::Proxy, &warms_up, 80);
    assert_eq!(rows.len(), FIGURES.len() - 1);
    assert!(rows.iter().all(Comparison::is_flat), "{}", table(&rows));
    let grows = process(0..80, |round, _| 50_000 + 400 * round as u64);
    let rows = compare_by_time("p", Kind::Proxy, &grows, 80);
    assert!(rows.iter().all(|row| !row.is_flat()), "{}", table(&rows));
}

#[test]
fn restarted_processes_are_compared_at_equal_age() {
    // Each life warms up for itself, and a process of the last quarter is older: that is no growth.
    let of_lives = |lives: Vec<std::ops::Range<usize>>| -> Vec<Sample> {
        lives.into_iter().flat_map(|life| process(life, |_, age| 10_000 * age.min(16) as u64)).collect()
    };
    let old = of_lives(vec![0..20, 20..40, 40..80]);
    assert!(compare_by_time("p", Kind::Proxy, &old, 80).iter().all(|row| !row.is_flat()));
    let rows =
        compare_by_age("p", Kind::Proxy, &[old, of_lives(vec![0..20, 20..40, 40..60, 60..80])].concat(), 80);
    assert!(!rows.is_empty() && rows.iter().all(Comparison::is_flat), "{}", table(&rows));
    // A later life begins with more.
    let lives: Vec<_> = [0..20, 20..40, 40..60, 60..80]
        .map(|life| process(life, |round, age| 20_000 * (round / 20) as u64 + age as u64))
        .concat();
    let rows = compare_by_age("p", Kind::Proxy, &lives, 80);
    assert!(!rows.is_empty() && rows.iter().all(|row| !row.is_flat()), "{}", table(&rows));
}

#[test]
fn log_that_swells_is_found_in_the_sum_of_all_nodes() {
    let quiet = process(0..80, |_, _| 2_000);
    assert!(compare_logs(quiet.iter().chain(&quiet), 80).is_flat());
    let loud = process(0..80, |round, _| if round < 60 { 0 } else { 10_000 });
    assert!(!compare_logs(quiet.iter().chain(&loud), 80).is_flat());
}
