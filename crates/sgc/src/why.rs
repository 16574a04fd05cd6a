//! `sgc why`: finds the first fault on the path of a topic, service or action.
//!
//! The node answers with its whole state ([`sgc_node::graph::Graph`]). [`diagnose`] follows the path in it and asks
//! nothing else. This file asks and prints.

use std::process::ExitCode;

use clap::Args;
use sgc_diagnosis::{DiagnosisError, Step, Verdict, diagnose};
use sgc_node::discovery_server;
use sgc_node::graph::Graph;
use sgc_wire::Name;

use crate::environment::environment;
use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::output;

/// Explain why a topic, service or action does not flow: follow its path and name the first fault
///
/// Each node knows its own half of the path. If this side is fine, run the command on the other side as well. Exit code
/// 0 means that nothing is wrong here; 1 means that something is, or that no node runs.
#[derive(Debug, Args)]
pub(crate) struct WhyArgs {
    /// Topic, service or action, by its name on this node's local network
    #[arg(required_unless_present = "name", conflicts_with = "name")]
    topic: Option<String>,
    /// 256-bit name in place of a topic, as `sgc name` and `sgc status` show it; routers know no other
    #[arg(long, value_name = "HEX")]
    name: Option<String>,
    #[command(flatten)]
    node: NodeArgs,
    /// Print the steps as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc why`.
pub(crate) fn why(args: &WhyArgs) -> Result<ExitCode, CliError> {
    let steps = match (&args.topic, &args.name) {
        (_, Some(hex)) => {
            let name = name_of(hex).ok_or_else(|| DiagnosisError::NotSeen {
                reason: format!("{hex:?} is not a name: it has 64 hexadecimal digits"),
            })?;
            graph(args, Some(name), |graph| diagnose::name(graph, &name.to_string()))?
        }
        (Some(topic), None) => graph(args, None, |graph| diagnose::interface(graph, topic))?,
        (None, None) => Vec::new(),
    };
    print_steps(&steps, args.json)
}

/// Prints the steps. Returns the exit code: whether one of them is wrong.
pub(crate) fn print_steps(steps: &[Step], json: bool) -> Result<ExitCode, CliError> {
    let is_wrong = steps.iter().any(|step| step.verdict == Verdict::Wrong);
    if json {
        output::line(serde_json::to_string(&steps).unwrap_or_default())?;
    } else {
        for line in steps.iter().flat_map(Step::lines) {
            line.print()?;
        }
    }
    Ok(if is_wrong { ExitCode::from(EXIT_FAILURE) } else { ExitCode::SUCCESS })
}

/// Returns the steps that follow from the node's answer. If no node answers, that is the only step.
fn graph(
    args: &WhyArgs,
    name: Option<Name>,
    walk: impl FnOnce(&Graph) -> Vec<Step>,
) -> Result<Vec<Step>, CliError> {
    match args.node.graph(name) {
        Ok(mut graph) => {
            if graph.has_ros {
                graph.alerts.extend(discovery_server::alerts(&environment));
            }
            Ok(walk(&graph))
        }
        Err(error @ (CliError::Diagnosis(DiagnosisError::NoNode { .. }) | CliError::NoNodeHere { .. })) => {
            Ok(vec![Step::no_node(error.to_string())])
        }
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
