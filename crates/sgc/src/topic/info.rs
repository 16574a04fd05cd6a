//! `sgc topic info`: shows publishers and subscribers of a topic, here and on the far side.

use std::process::ExitCode;

use clap::Args;
use serde::Serialize;
use sgc_node::graph::{Endpoint, Graph, Offer, Qos, ShareRoute, UseRoute};
use sgc_process::ProcessError;

use crate::error::{CliError, EXIT_FAILURE};
use crate::node::NodeArgs;
use crate::output;

/// Show a topic's publishers and subscribers, here and on the far side
#[derive(Debug, Args)]
pub(crate) struct InfoArgs {
    /// Name of the topic
    topic: String,
    /// Show the GUID, QoS and type hash of each endpoint
    #[arg(short, long)]
    verbose: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    node: NodeArgs,
}

/// The topic as `--json` shows it.
#[derive(Serialize)]
struct InfoJson<'a> {
    topic: &'a str,
    /// Endpoints on the local network.
    endpoints: Vec<&'a Endpoint>,
    /// Entries that other nodes list for this one.
    offers: Vec<&'a Offer>,
    /// Routes of the rules that share it.
    shares: Vec<&'a ShareRoute>,
    /// Rules that use it, with their routes of this topic.
    uses: Vec<UseJson<'a>>,
}

#[derive(Serialize)]
struct UseJson<'a> {
    owner: &'a str,
    publishes: bool,
    route: &'a UseRoute,
}

pub(super) fn info(args: &InfoArgs) -> Result<ExitCode, CliError> {
    let graph = args.node.graph(None)?;
    let lines = lines(&graph, &args.topic, args.verbose);
    if lines.is_empty() {
        output::diagnostic(&format!(
            "sgc: {}: nobody has it on the local network, and no node that this one follows lists it",
            args.topic
        ));
        return Ok(ExitCode::from(EXIT_FAILURE));
    }
    if args.json {
        let text = serde_json::to_string_pretty(&json(&graph, &args.topic));
        output::line(text.map_err(|error| CliError::from(ProcessError::Output(error.into())))?)?;
        return Ok(ExitCode::SUCCESS);
    }
    for line in lines {
        output::line(output::clean(&line))?;
    }
    Ok(ExitCode::SUCCESS)
}

fn json<'a>(graph: &'a Graph, topic: &'a str) -> InfoJson<'a> {
    let shares = graph.shares.iter().flat_map(|share| &share.routes);
    let uses = graph.uses.iter().flat_map(|used| used.routes.iter().map(move |route| (used, route)));
    InfoJson {
        topic,
        endpoints: graph.endpoints.iter().filter(|e| e.is_ros_topic && e.topic == topic).collect(),
        offers: graph.offers.iter().filter(|offer| offer.topic == topic).collect(),
        shares: shares.filter(|route| route.topic == topic).collect(),
        uses: uses
            .filter(|(_, route)| route.topic == topic)
            .map(|(used, route)| UseJson { owner: &used.owner, publishes: used.publishes, route })
            .collect(),
    }
}

fn lines(graph: &Graph, topic: &str, verbose: bool) -> Vec<String> {
    let here: Vec<_> = graph.endpoints.iter().filter(|e| e.is_ros_topic && e.topic == topic).collect();
    let routes = graph.uses.iter().flat_map(|used| used.routes.iter().map(move |route| (used, route)));
    let used: Vec<_> = routes.filter(|(_, route)| route.topic == topic).collect();
    let offers: Vec<_> = graph.offers.iter().filter(|offer| offer.topic == topic).collect();
    let mut types: Vec<_> = here.iter().map(|e| e.type_name.as_str()).collect();
    types.extend(used.iter().map(|(_, route)| route.type_name.as_str()));
    types.extend(offers.iter().map(|offer| offer.type_name.as_str()));
    types.sort_unstable();
    types.dedup();
    let mut lines: Vec<_> = types.iter().map(|t| format!("Type: {t}")).collect();
    if lines.is_empty() {
        return lines;
    }
    if types.len() > 1 {
        lines.push("  Those of one type do not talk to those of another.".to_owned());
    }
    for (title, writes) in [("Publishers", true), ("Subscribers", false)] {
        let of_kind: Vec<_> = here.iter().filter(|e| e.writes == writes).collect();
        lines.push(format!("{title} on the local network: {}", of_kind.len()));
        if verbose {
            of_kind.iter().for_each(|e| lines.extend(endpoint(e)));
        }
    }
    for offer in offers {
        let whose = offer.owner.clone().unwrap_or_else(|| offer.owner_id.chars().take(8).collect());
        let may = match (offer.subscribe, offer.publish) {
            (true, true) => "this node may subscribe and publish",
            (true, false) => "this node may subscribe",
            (false, _) => "this node may publish",
        };
        lines.push(format!("Shared by {whose}: {may}; {}", if offer.is_used { "used" } else { "not used" }));
        if verbose {
            lines.push(format!("  Type: {}", offer.type_name));
            lines.extend(offer.type_hash.iter().map(|hash| format!("  Type hash: {hash}")));
            lines.push(format!("  Name: {}", offer.name));
            lines.extend(qos(&offer.qos));
        }
    }
    for (used, route) in used {
        let state = match (&route.refused, route.is_granted) {
            (Some(why), false) => format!("refused: {why}"),
            (None, false) => "waits for its owner's grant".to_owned(),
            (_, true) if used.publishes => {
                format!("{} local publishers, {} messages", route.publishers, route.messages)
            }
            (_, true) => format!("{} local readers matched, {} messages", route.matched, route.messages),
        };
        let way = if used.publishes { "Published on for" } else { "Brought from" };
        lines.push(format!("{way} {}: {state}", used.owner));
    }
    for route in graph.shares.iter().flat_map(|share| &share.routes).filter(|route| route.topic == topic) {
        let whom = if route.granted.is_empty() { "nobody".to_owned() } else { route.granted.join(", ") };
        lines.push(format!("Shared from here: granted to {whom}; {} messages", route.messages));
        if verbose {
            lines.push(format!("  Name: {}", route.name));
        }
    }
    lines
}

fn endpoint(endpoint: &Endpoint) -> Vec<String> {
    let node = endpoint.node.as_deref().unwrap_or("unknown, or none of ROS 2");
    let mut lines = vec![
        format!("  Node: {node}"),
        format!("  Type: {}", endpoint.type_name),
        format!("  GUID: {}", endpoint.guid),
    ];
    lines.extend(endpoint.type_hash.iter().map(|hash| format!("  Type hash: {hash}")));
    lines.extend(qos(&endpoint.qos));
    lines.push(String::new());
    lines
}

/// Formats QoS as `ros2 topic info -v` does.
fn qos(qos: &Qos) -> Vec<String> {
    let time = |ns: Option<u64>| ns.map_or("Infinite".to_owned(), |ns| format!("{} s", ns as f64 / 1e9));
    let mut lines = vec![
        "  QoS profile:".to_owned(),
        format!("    Reliability: {}", qos.reliability()),
        match qos.depth {
            depth if depth == Qos::UNSAID_DEPTH => "    History (Depth): UNKNOWN".to_owned(),
            Some(depth) => format!("    History (Depth): KEEP_LAST ({depth})"),
            None => "    History (Depth): KEEP_ALL".to_owned(),
        },
        format!("    Durability: {}", qos.durability()),
        format!("    Lifespan: {}", time(qos.lifespan_ns)),
        format!("    Deadline: {}", time(qos.deadline_ns)),
        format!("    Liveliness: {}", qos.liveliness()),
        format!("    Liveliness lease duration: {}", time(qos.lease_ns)),
    ];
    if !qos.partitions.is_empty() {
        lines.push(format!("    Partitions: {}", qos.partitions.join(", ")));
    }
    lines
}
