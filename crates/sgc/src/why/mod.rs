//! `sgc why`: the first thing that is wrong on the way of a topic, service or action.
//!
//! The node says what it knows ([`sgc_node::graph::Graph`]); [`diagnose`] walks the way in it, without asking anybody
//! anything more.

mod diagnose;
mod near;
pub(crate) mod refusals;
#[cfg(test)]
mod tests;

use std::path::Path;
use std::process::ExitCode;

use clap::Args;
use serde::Serialize;
use sgc_node::discovery_server;
use sgc_node::graph::Graph;
use sgc_wire::Name;

use crate::error::{CliError, EXIT_FAILURE};
use crate::topic::NodeArgs;
use crate::{output, run};

/// Say why a topic, service or action does not flow: walk its way and name the first thing that is wrong
///
/// Each node knows its own half of the way: run it on the other side as well if all is well on this one. Exit code 0: nothing
/// is wrong here; 1: something is, or no node runs.
#[derive(Debug, Args)]
pub(crate) struct WhyArgs {
    /// Topic, service or action, as it is called on this node's local network
    #[arg(required_unless_present = "name", conflicts_with = "name")]
    topic: Option<String>,
    /// A 256-bit name instead, for routers, which know no other: what `sgc name` and `sgc status` show
    #[arg(long, value_name = "HEX")]
    name: Option<String>,
    #[command(flatten)]
    node: NodeArgs,
    /// Print the steps as JSON
    #[arg(long)]
    json: bool,
}

/// What a step came to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Verdict {
    /// It is as it should be.
    Fine,
    /// It is not.
    Wrong,
    /// It cannot be known here, or need not be wrong.
    Unknown,
}

/// A step of the way.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(crate) struct Step {
    verdict: Verdict,
    /// What was found.
    found: String,
    /// What to do about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    fix: Option<String>,
}

impl Step {
    fn fine(found: impl Into<String>) -> Self {
        Self { verdict: Verdict::Fine, found: found.into(), fix: None }
    }

    fn wrong(found: impl Into<String>, fix: impl Into<String>) -> Self {
        Self { verdict: Verdict::Wrong, found: found.into(), fix: Some(fix.into()) }
    }

    fn unknown(found: impl Into<String>) -> Self {
        Self { verdict: Verdict::Unknown, found: found.into(), fix: None }
    }

    fn with_fix(self, fix: impl Into<String>) -> Self {
        Self { fix: Some(fix.into()), ..self }
    }
}

/// Runs `sgc why`.
pub(crate) fn why(args: &WhyArgs) -> Result<ExitCode, CliError> {
    let steps = match (&args.topic, &args.name) {
        (_, Some(hex)) => {
            let name = name_of(hex).ok_or_else(|| CliError::NotSeen {
                reason: format!("{hex:?} is not a name: it has 64 hexadecimal digits"),
            })?;
            graph(args, Some(name), |graph| diagnose::name(graph, &name.to_string()))?
        }
        (Some(topic), None) => graph(args, None, |graph| diagnose::interface(graph, topic))?,
        (None, None) => Vec::new(),
    };
    let is_wrong = steps.iter().any(|step| step.verdict == Verdict::Wrong);
    if args.json {
        output::line(serde_json::to_string(&steps).unwrap_or_default())?;
    } else {
        for step in &steps {
            let mark = match step.verdict {
                Verdict::Fine => '✓',
                Verdict::Wrong => '✗',
                Verdict::Unknown => '?',
            };
            output::line(output::clean(&format!("{mark} {}", step.found)))?;
            if let Some(fix) = &step.fix {
                output::line(output::clean(&format!("    {fix}")))?;
            }
        }
    }
    Ok(if is_wrong { ExitCode::from(EXIT_FAILURE) } else { ExitCode::SUCCESS })
}

/// The first thing that is wrong on the way of a topic of the node at this socket, with the fix, as one line each.
pub(crate) fn first_wrong(socket: &Path, topic: &str) -> Option<Vec<String>> {
    let graph = NodeArgs::at(socket).graph(None).ok()?;
    let step = diagnose::interface(&graph, topic).into_iter().find(|step| step.verdict == Verdict::Wrong)?;
    Some([Some(step.found), step.fix].into_iter().flatten().map(|line| output::clean(&line)).collect())
}

/// The steps that the node's answer leads to; where none answers, that is the step.
fn graph(
    args: &WhyArgs,
    name: Option<Name>,
    walk: impl FnOnce(&Graph) -> Vec<Step>,
) -> Result<Vec<Step>, CliError> {
    match args.node.graph(name) {
        Ok(mut graph) => {
            if graph.has_ros {
                graph.alerts.extend(discovery_server::alerts(&run::environment));
            }
            Ok(walk(&graph))
        }
        Err(error @ (CliError::NoNode { .. } | CliError::NoNodeHere { .. })) => Ok(vec![Step::wrong(
            error.to_string(),
            "start it with `sgc run -c FILE`; if it runs elsewhere, ask there, or as the user that runs it",
        )]),
        Err(error) => Err(error),
    }
}

fn name_of(hex: &str) -> Option<Name> {
    let is_name = hex.len() == 64 && hex.bytes().all(|b| b.is_ascii_hexdigit());
    let digits = is_name.then(|| hex.as_bytes().chunks_exact(2))?;
    let bytes: Option<Vec<u8>> =
        digits.map(|two| u8::from_str_radix(std::str::from_utf8(two).ok()?, 16).ok()).collect();
    Some(Name(bytes?.try_into().ok()?))
}
