//! Turns of several participants at the same time, each in a lab of its own, where the path and not the machine decides
//! how long things take. This module does not know what is measured.

use anyhow::Result;

/// The result of one participant.
#[derive(Debug)]
pub(crate) struct Turn<R> {
    /// The results of its finished stages.
    pub(crate) stages: Vec<R>,
    /// Why there are no more.
    pub(crate) error: Option<anyhow::Error>,
}

/// Does something for all at the same time; the outcomes are in the order of who they belong to.
pub(crate) fn abreast<W: Send, R: Send>(
    who: impl IntoIterator<Item = W>,
    act: impl Fn(W) -> R + Sync,
) -> Vec<R> {
    let act = &act;
    std::thread::scope(|scope| {
        let threads: Vec<_> = who.into_iter().map(|one| scope.spawn(move || act(one))).collect();
        let outcomes = threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        outcomes.collect()
    })
}

/// Starts all participants and lets them go through stages. Each stage begins when all have finished the one before, so
/// that no start or end disturbs a measurement. A participant is out if it fails, or if a stage leaves it unable to go
/// on (`None`).
pub(crate) fn by_stages<W: Copy + Send, T: Send, R: Send, S: Copy + Sync>(
    who: &[W],
    stages: &[S],
    start: impl Fn(W) -> Result<T> + Sync,
    measure: impl Fn(T, S) -> Result<(R, Option<T>)> + Sync,
) -> Vec<Turn<R>> {
    let started = abreast(who.iter().copied(), start);
    let mut states = Vec::new();
    let mut turns = Vec::new();
    for outcome in started {
        let (state, error) = match outcome {
            Ok(state) => (Some(state), None),
            Err(error) => (None, Some(error)),
        };
        states.push(state);
        turns.push(Turn { stages: Vec::new(), error });
    }
    for stage in stages {
        let measured = abreast(states, |state| state.map(|state| measure(state, *stage)));
        states = Vec::new();
        for (turn, outcome) in turns.iter_mut().zip(measured) {
            let (outcome, error) =
                outcome.transpose().map_or_else(|error| (None, Some(error)), |o| (o, None));
            turn.error = turn.error.take().or(error);
            let (of_stage, state) = outcome.unzip();
            turn.stages.extend(of_stage);
            states.push(state.flatten());
        }
    }
    abreast(states, drop);
    turns
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::bail;
    use std::sync::atomic::{AtomicUsize, Ordering::SeqCst};

    #[test]
    fn failed_participant_is_out_and_others_go_on() {
        let turns = by_stages(
            &["well", "never", "once"],
            &[1, 2],
            |who| if who == "never" { bail!("no start") } else { Ok(who) },
            |who, stage| match (who, stage) {
                ("once", 1) => Ok((stage, None)),
                _ => Ok((stage, Some(who))),
            },
        );
        let stages: Vec<_> = turns.iter().map(|turn| &*turn.stages).collect();
        assert_eq!(stages, [&[1, 2][..], &[], &[1]]);
        let is_failed: Vec<_> = turns.iter().map(|turn| turn.error.is_some()).collect();
        assert_eq!(is_failed, [false, true, false]);
    }

    #[test]
    fn a_stage_begins_when_all_are_through_the_one_before() {
        let through = AtomicUsize::new(0);
        let turns = by_stages(&[0, 1, 2], &[0, 1], Ok, |who, stage| {
            assert!(through.load(SeqCst) >= stage * 3);
            std::thread::sleep(std::time::Duration::from_millis(who));
            through.fetch_add(1, SeqCst);
            Ok(((), Some(who)))
        });
        assert!(turns.iter().all(|turn| turn.stages.len() == 2));
    }
}
