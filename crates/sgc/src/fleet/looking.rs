//! `sgc fleet status` and `sgc fleet why`: what the nodes of the fleet report. A node of this user asks them over the
//! mesh as an observer.

use std::io::IsTerminal as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use sgc_diagnosis::fleet::{FleetStatus, Members, ask_nodes};
use sgc_diagnosis::{DiagnosisError, diagnose};
use sgc_node::admin::report::ReportMember;
use sgc_node::graph::Graph;
use sgc_node::roster_row;
use sgc_process::style::Line;
use sgc_process::{ProcessError, unix_now};
use sgc_trust::NodeName;

use super::WhichFleet;
use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;
use crate::span::parse_span;
use crate::why::print_steps;

/// Shortest time between two looks. Nodes give the same report for half a second.
const WATCH_MIN: Duration = Duration::from_secs(1);
/// Clears the terminal.
const CLEAR: &str = "\x1b[2J\x1b[H";

/// Show how the nodes of the fleet are doing.
///
/// Your node that runs here asks the others over the mesh. They answer observers: enroll your node with `--group
/// observers`. Without names, the fleet's authority is asked for the members, and each of them for its report. With
/// names, everything that these nodes report is shown.
#[derive(Debug, Args)]
pub(super) struct StatusArgs {
    /// Names of nodes, for their details
    #[arg(value_name = "NODE")]
    nodes: Vec<String>,
    /// Fleet file with the members; without it, the fleet's authority is asked
    #[arg(long, value_name = "FILE")]
    fleet: Option<PathBuf>,
    /// Look again every TIME, and show rates, as with --watch=2s; --watch alone looks every 5s
    #[arg(long, value_name = "TIME", num_args = 0..=1, require_equals = true, default_missing_value = "5s",
          value_parser = parse_span)]
    watch: Option<Duration>,
    #[command(flatten)]
    node: NodeArgs,
    /// Print a JSON document; with --watch, one in each line
    #[arg(long)]
    json: bool,
}

/// Explain why a topic, service or action of another node does not flow.
///
/// The command follows the path at that node, as `sgc why` does there. Your node that runs here asks for it over the
/// mesh, as an observer. Exit code 0 means that nothing is wrong there; 1 means that something is, or that the node did
/// not answer.
#[derive(Debug, Args)]
pub(super) struct WhyArgs {
    /// Node, and topic, service or action by its name there, such as robot:/camera
    #[arg(value_name = "NODE:/TOPIC")]
    at: String,
    #[command(flatten)]
    node: NodeArgs,
    /// Print the steps as JSON
    #[arg(long)]
    json: bool,
}

/// Runs `sgc fleet status`.
pub(super) fn status(args: &StatusArgs) -> Result<(), CliError> {
    for name in &args.nodes {
        name.parse::<NodeName>()?;
        if args.watch.is_some() && parse_span(name).is_ok() {
            return Err(CliError::Cannot {
                reason: format!("a time follows --watch after an equals sign: --watch={name}"),
            });
        }
    }
    let socket = args.node.socket()?;
    let mut before = None;
    loop {
        match (look(args, &socket), args.watch) {
            (Ok(look), watch) => {
                show(args, &look, before.as_ref())?;
                before = Some(look);
                if watch.is_none() {
                    return Ok(());
                }
            }
            // The node here may be restarted, or the authority out of reach for a while.
            (Err(error), Some(_)) => drop(error.report()),
            (Err(error), None) => return Err(error),
        }
        std::thread::sleep(args.watch.unwrap_or_default().max(WATCH_MIN));
    }
}

fn look(args: &StatusArgs, socket: &Path) -> Result<FleetStatus, CliError> {
    let found = match &args.fleet {
        Some(file) => members_of_file(file),
        None => Members::of_authority(socket).map_err(CliError::from),
    };
    let Members { members, omitted, authority } = match found {
        // Their details need no members, which only add names to their links.
        Err(_) if !args.nodes.is_empty() && args.fleet.is_none() => Members::default(),
        found => found?,
    };
    let is_answered = |name: &String| authority.as_ref().is_some_and(|answer| answer.node == *name);
    let is_asked = |member: &&ReportMember| member.revoked_ms.is_none();
    let mut nodes: Vec<String> = match args.nodes.is_empty() {
        true => members.iter().filter(is_asked).map(|member| member.name.clone()).collect(),
        false => args.nodes.clone(),
    };
    nodes.retain(|name| !is_answered(name));
    let mut answers = if nodes.is_empty() { Vec::new() } else { ask_nodes(socket, &nodes, None)? };
    answers.extend(authority);
    let mut status = FleetStatus::new(unix_now(), members, answers, &args.nodes);
    status.members_omitted = omitted;
    Ok(status)
}

fn show(args: &StatusArgs, look: &FleetStatus, before: Option<&FleetStatus>) -> Result<(), CliError> {
    if args.json {
        let json = match args.watch {
            Some(_) => serde_json::to_string(look),
            None => serde_json::to_string_pretty(look),
        };
        let json =
            json.map_err(|e| ProcessError::System { what: "JSON", source: std::io::Error::other(e) })?;
        return output::line(json);
    }
    if args.watch.is_some() && std::io::stdout().is_terminal() {
        output::raw(CLEAR)?;
    }
    let mut lines = look.overview(before);
    for node in look.nodes.iter().filter(|node| args.nodes.contains(&node.name)) {
        lines.extend(look.details(node));
    }
    if args.watch.is_some() {
        lines.push(Line::default());
    }
    lines.into_iter().try_for_each(|line| Ok(line.cleaned().print()?))
}

/// Returns the members in a fleet file.
pub(crate) fn members_of_file(file: &Path) -> Result<Members, CliError> {
    let (_, fleet) = WhichFleet { fleet: Some(file.to_owned()) }.read()?;
    let members = fleet.nodes().map(|node| ReportMember::new(roster_row(&fleet, node))).collect();
    Ok(Members { members, ..Members::default() })
}

/// Runs `sgc fleet why`.
pub(super) fn why(args: &WhyArgs) -> Result<ExitCode, CliError> {
    let not_seen = |reason| CliError::from(DiagnosisError::NotSeen { reason });
    let Some((node, interface)) = args.at.split_once(':') else {
        let reason =
            format!("{:?} names no node and topic: write them with a colon, such as robot:/camera", args.at);
        return Err(not_seen(reason));
    };
    node.parse::<NodeName>()?;
    let socket = args.node.socket()?;
    let answer = ask_nodes(&socket, &[node.to_owned()], Some(interface))?.pop().unwrap_or_default();
    let Some(graph) = answer.graph else {
        let mut reason = format!("{node}: {}", answer.error.unwrap_or_default());
        if !answer.fix.is_empty() {
            reason.push_str(&format!("; {}", answer.fix));
        }
        return Err(not_seen(reason));
    };
    let graph: Graph = serde_json::from_str(&graph)
        .map_err(|_| not_seen(format!("{node}: its report cannot be read; compare the versions of sgc")))?;
    if !args.json {
        output::line(format!("At {node}:"))?;
    }
    print_steps(&diagnose::interface(&graph, interface), args.json)
}
