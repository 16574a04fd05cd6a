//! `sgc topic list`: topics of the local network and of the nodes that this one follows.

use std::collections::BTreeMap;
use std::process::ExitCode;

use clap::Args;
use serde::Serialize;
use sgc_node::graph::{Graph, Interface};
use sgc_ros::is_pattern;

use crate::error::CliError;
use crate::node::NodeArgs;
use crate::output;

/// List topics of the local network and topics that other nodes share with this one
#[derive(Debug, Args)]
pub(crate) struct ListArgs {
    #[command(flatten)]
    node: NodeArgs,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// A topic at one place: here or at an owner.
#[derive(Debug, Serialize)]
struct Line {
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    /// `"here"`, or the owner's name.
    whose: String,
    publishers: usize,
    subscribers: usize,
    /// How the topic is shared or used.
    state: String,
}

pub(super) fn list(args: &ListArgs) -> Result<ExitCode, CliError> {
    let graph = args.node.graph(None)?;
    let lines = lines(&graph);
    if args.json {
        output::line(serde_json::to_string(&lines).unwrap_or_default())?;
        return Ok(ExitCode::SUCCESS);
    }
    let head = ["topic", "type", "whose", "pub", "sub", "state"].map(str::to_owned).to_vec();
    let row = |line: &Line| {
        vec![
            line.topic.clone(),
            line.type_name.clone(),
            line.whose.clone(),
            line.publishers.to_string(),
            line.subscribers.to_string(),
            line.state.clone(),
        ]
    };
    let rows: Vec<_> = std::iter::once(head).chain(lines.iter().map(row)).collect();
    for line in output::columns(&rows) {
        output::line(output::clean(&line))?;
    }
    if graph.endpoints_left_out > 0 {
        output::diagnostic(&format!("sgc: {} endpoints more are not listed", graph.endpoints_left_out));
    }
    Ok(ExitCode::SUCCESS)
}

fn lines(graph: &Graph) -> Vec<Line> {
    let mut local: BTreeMap<(&str, &str), (usize, usize)> = BTreeMap::new();
    for endpoint in graph.endpoints.iter().filter(|e| e.is_ros_topic) {
        let counts = local.entry((&endpoint.topic, &endpoint.type_name)).or_default();
        if endpoint.writes {
            counts.0 += 1;
        } else {
            counts.1 += 1;
        }
    }
    let mut all: Vec<_> = local
        .iter()
        .map(|((topic, type_name), (publishers, subscribers))| Line {
            topic: (*topic).to_owned(),
            type_name: (*type_name).to_owned(),
            whose: "here".to_owned(),
            publishers: *publishers,
            subscribers: *subscribers,
            state: local_state(graph, topic, type_name, *publishers),
        })
        .collect();
    for share in graph
        .shares
        .iter()
        .filter(|s| s.kind == Interface::Topic && s.routes.is_empty() && !is_pattern(&s.topic))
    {
        if !all.iter().any(|line| line.topic == share.topic) {
            all.push(Line {
                topic: share.topic.clone(),
                type_name: share.wanted_type.clone().unwrap_or_else(|| "?".to_owned()),
                whose: "here".to_owned(),
                publishers: 0,
                subscribers: 0,
                state: "shared, but nobody publishes it here".to_owned(),
            });
        }
    }
    for offer in graph.offers.iter().filter(|o| o.kind == Interface::Topic) {
        let routes = graph.uses.iter().flat_map(|used| used.routes.iter().map(move |route| (used, route)));
        let route = routes.into_iter().find(|(_, route)| route.name == offer.name);
        let state = match route {
            Some((used, route)) if used.publishes && route.is_granted => {
                format!("published on from here: {} local publishers", route.publishers)
            }
            Some((_, route)) if route.is_granted => match (route.topic == offer.topic, route.matched) {
                (true, n) => format!("used: {n} local readers"),
                (false, n) => format!("used as {}: {n} local readers", route.topic),
            },
            Some((_, route)) => match &route.refused {
                Some(why) => format!("used, but refused: {why}"),
                None => "used, waits for its owner's grant".to_owned(),
            },
            None if offer.is_used => "used".to_owned(),
            None if offer.subscribe => "not used: no [[use]] asks for it".to_owned(),
            None => "not used: this node may publish on it".to_owned(),
        };
        let local = local.get(&(offer.topic.as_str(), offer.type_name.as_str()));
        all.push(Line {
            topic: offer.topic.clone(),
            type_name: offer.type_name.clone(),
            whose: offer.owner.clone().unwrap_or_else(|| offer.owner_id.chars().take(8).collect()),
            publishers: 0,
            subscribers: local.map_or(0, |(_, subscribers)| *subscribers),
            state,
        });
    }
    all.sort_by(|a, b| (&a.topic, &a.whose, &a.type_name).cmp(&(&b.topic, &b.whose, &b.type_name)));
    all
}

fn local_state(graph: &Graph, topic: &str, type_name: &str, publishers: usize) -> String {
    let shares = graph.shares.iter().filter(|s| s.kind == Interface::Topic);
    let mut routes = shares.flat_map(|s| &s.routes).filter(|route| route.topic == topic);
    if let Some(route) = routes.find(|route| route.type_name == type_name) {
        return match route.granted.len() {
            0 if route.refused.is_empty() => "shared: nobody asked for it".to_owned(),
            0 => "shared: who asked was refused".to_owned(),
            1 => "shared: 1 node has it".to_owned(),
            n => format!("shared: {n} nodes have it"),
        };
    }
    let is_shared = graph.endpoints.iter().any(|e| e.topic == topic && e.shared_by.is_some());
    let used = graph.uses.iter().flat_map(|u| &u.routes).find(|route| route.topic == topic);
    match used {
        Some(route) if route.type_name != type_name => {
            format!("the far side has another type: {}", route.type_name)
        }
        Some(_) if publishers == 0 => "used".to_owned(),
        Some(_) => "used, and published here besides".to_owned(),
        None if is_shared && publishers == 0 => "shared, but nobody publishes it here".to_owned(),
        None if is_shared => "shared with another type".to_owned(),
        None if publishers == 0 => "not used".to_owned(),
        None => "not shared".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use sgc_node::graph::{Endpoint, Offer, Share, ShareRoute, Use, UseRoute};

    use super::*;

    fn endpoint(topic: &str, writes: bool, is_shared: bool) -> Endpoint {
        Endpoint {
            topic: topic.into(),
            type_name: "T".into(),
            is_ros_topic: true,
            writes,
            shared_by: is_shared.then_some(0),
            ..Endpoint::default()
        }
    }

    #[test]
    fn list_shows_state_of_every_topic() {
        let offer = |topic: &str, is_used| Offer {
            topic: topic.into(),
            type_name: "T".into(),
            owner: Some("arm".into()),
            name: topic.into(),
            subscribe: true,
            is_used,
            ..Offer::default()
        };
        let used = UseRoute {
            topic: "/far".into(),
            name: "/far".into(),
            type_name: "T".into(),
            is_granted: true,
            matched: 2,
            ..UseRoute::default()
        };
        let route = ShareRoute {
            topic: "/a".into(),
            type_name: "T".into(),
            granted: vec!["x".into()],
            ..ShareRoute::default()
        };
        let graph = Graph {
            endpoints: vec![
                endpoint("/a", true, true),
                endpoint("/b", true, false),
                endpoint("/far", false, false),
                Endpoint { is_ros_topic: false, ..endpoint("rq/x", true, false) },
            ],
            shares: vec![
                Share { topic: "/a".into(), routes: vec![route], ..Share::default() },
                Share { topic: "/absent".into(), ..Share::default() },
            ],
            uses: vec![Use { routes: vec![used], ..Use::default() }],
            offers: vec![offer("/far", true), offer("/other", false)],
            ..Graph::default()
        };
        let shown: Vec<_> =
            lines(&graph).into_iter().map(|l| format!("{} {}: {}", l.topic, l.whose, l.state)).collect();
        let expected = [
            "/a here: shared: 1 node has it",
            "/absent here: shared, but nobody publishes it here",
            "/b here: not shared",
            "/far arm: used: 2 local readers",
            "/far here: used",
            "/other arm: not used: no [[use]] asks for it",
        ];
        assert_eq!(shown, expected);
    }
}
