//! Diagnosis: asks nodes for their documents, finds what is wrong and names the remedy.
//!
//! [`diagnose`] follows the path of a topic in a node's graph up to the first fault, and finds facts without words,
//! which `words` renders. [`refusals`] explains counters, [`status`] a node's status, [`fleet`] those of all
//! nodes, [`rights`] the members that rules permit, [`netcheck`] the network of a node, and [`check`] a configuration. Of these, only [`ask`] talks to nodes. The crate parses no arguments, prints nothing and knows no exit codes; `sgc`
//! does.

pub mod ask;
pub mod check;
pub mod diagnose;
mod error;
mod finding;
pub mod fleet;
pub mod names;
mod near;
pub mod netcheck;
pub mod refusals;
pub mod rights;
pub mod status;
mod step;
#[cfg(test)]
mod tests;
mod words;

use std::path::Path;

pub use error::DiagnosisError;
pub use refusals::{COUNTERS, CounterTable, Refusal};
use sgc_process::output;
pub use step::{Step, Verdict};

/// Returns the first fault on the path of a topic of the node at this socket, and its fix, as one line each.
pub fn first_wrong(socket: &Path, topic: &str) -> Option<Vec<String>> {
    let graph = ask::graph(socket, None).ok()?;
    let step = diagnose::interface(&graph, topic).into_iter().find(|step| step.verdict == Verdict::Wrong)?;
    Some([Some(step.found()), step.fix()].into_iter().flatten().map(|line| output::clean(&line)).collect())
}
