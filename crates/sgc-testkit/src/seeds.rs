//! [`run_seeds`]: runs tests of random histories over seeds.

use std::panic::{AssertUnwindSafe, catch_unwind};

/// Makes a run of each seed and executes it; a run panics where it finds a fault. Returns the results.
///
/// The seeds are `committed`, or those of the variable `SGC_SEEDS`: one, or a range like `100..2000`.
///
/// # Panics
/// If a seed fails, after all were executed. Each failing seed is shown once, with its trace.
#[allow(clippy::print_stderr, reason = "a seed that fails is of no use without its trace")]
pub fn run_seeds<R, T>(
    committed: &[u64],
    start: impl Fn(u64) -> R,
    execute: impl Fn(&mut R) -> T,
    trace: impl Fn(&R) -> String,
) -> Vec<T> {
    // The trace replaces the stack trace.
    std::panic::set_hook(Box::new(|_| {}));
    let (mut results, mut failed) = (Vec::new(), Vec::new());
    for seed in seeds(committed) {
        let mut run = start(seed);
        match catch_unwind(AssertUnwindSafe(|| execute(&mut run))) {
            Ok(result) => results.push(result),
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or_default();
                eprintln!("{}\nseed {seed}: {text}\n", trace(&run));
                failed.push(seed);
            }
        }
    }
    let _ = std::panic::take_hook();
    assert!(failed.is_empty(), "{} seeds fail: {failed:?}", failed.len());
    results
}

fn seeds(committed: &[u64]) -> Vec<u64> {
    let Ok(text) = std::env::var("SGC_SEEDS") else { return committed.to_vec() };
    let range = text.split_once("..").and_then(|(a, b)| Some(a.parse().ok()?..b.parse().ok()?));
    match (range, text.parse()) {
        (Some(range), _) => range.collect(),
        (None, Ok(one)) => vec![one],
        (None, Err(_)) => panic!("SGC_SEEDS is {text:?}, not one seed or a range like 100..200"),
    }
}
