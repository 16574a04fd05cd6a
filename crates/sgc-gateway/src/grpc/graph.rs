//! `GetGraph` and `WatchGraph`: the graph and its changes, within the scope of a client.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use futures_util::stream;
use tokio::sync::watch;
use tonic::Status;

use super::guest::{Guest, Place};
use super::proto::watch_graph_response::Gone;
use super::proto::{self, GetGraphResponse, WatchGraphResponse};
use super::qos;
use super::slot::Responses;
use crate::graph::{ActionInfo, EndpointInfo, Graph, NodeInfo, ServiceInfo, TopicInfo, is_hidden};

/// Shortest time between two updates.
const CHANGES_INTERVAL_MIN: Duration = Duration::from_millis(100);

/// Returns the graph that a client sees. Nodes without an interface in its scope are left out, except the gateway's
/// own.
fn seen(guest: &Guest, with_hidden: bool) -> Graph {
    let mut graph = guest.session.graph();
    let own = guest.session.hub().node_name();
    graph.nodes.retain(|name, NodeInfo { publishes, subscribes, serves, calls }| {
        name == own || [publishes, subscribes, serves, calls].iter().any(|names| !names.is_empty())
    });
    if with_hidden {
        return graph;
    }
    let is_shown = |name: &str| !is_hidden(name);
    graph.filtered(is_shown, is_shown)
}

/// Returns the whole graph.
pub(super) fn graph(guest: &Guest, with_hidden: bool) -> GetGraphResponse {
    let graph = changed(&Graph::default(), &seen(guest, with_hidden));
    let gateway_node = guest.session.hub().node_name().to_owned();
    GetGraphResponse { graph: Some(graph), gateway_node }
}

/// A client that watches the graph.
struct GraphWatch {
    place: Place,
    with_hidden: bool,
    changes: watch::Receiver<u64>,
    told: Option<Graph>,
}

/// Streams the whole graph and then its changes.
pub(super) fn watch(place: Place, with_hidden: bool) -> Responses<WatchGraphResponse> {
    let changes = place.guest.session.hub().graph_changes();
    let watching = GraphWatch { place, with_hidden, changes, told: None };
    Box::pin(stream::unfold(Some(watching), |watching| async {
        let mut watching = watching?;
        let guest = Arc::clone(&watching.place.guest);
        tokio::select! {
            biased;
            why = guest.ended() => Some((Err(Status::from(why)), None)),
            change = watching.next() => Some((Ok(change?), Some(watching))),
        }
    }))
}

impl GraphWatch {
    async fn next(&mut self) -> Option<WatchGraphResponse> {
        loop {
            if self.told.is_some() {
                self.changes.changed().await.ok()?;
                tokio::time::sleep(CHANGES_INTERVAL_MIN).await;
            }
            self.changes.mark_unchanged();
            let now = seen(&self.place.guest, self.with_hidden);
            let (is_first, before) = (self.told.is_none(), self.told.take().unwrap_or_default());
            let change =
                WatchGraphResponse { changed: Some(changed(&before, &now)), gone: Some(gone(&before, &now)) };
            self.told = Some(now);
            let says = |lists: [bool; 4]| lists.contains(&false);
            let is_new = change.changed.as_ref().is_some_and(|c| {
                says([c.topics.is_empty(), c.services.is_empty(), c.actions.is_empty(), c.nodes.is_empty()])
            });
            let is_gone = change.gone.as_ref().is_some_and(|c| {
                says([c.topics.is_empty(), c.services.is_empty(), c.actions.is_empty(), c.nodes.is_empty()])
            });
            if is_first || is_new || is_gone {
                return Some(change);
            }
        }
    }
}

/// Returns the new and changed entries.
fn changed(before: &Graph, now: &Graph) -> proto::Graph {
    proto::Graph {
        topics: differing(&before.topics, &now.topics, topic),
        services: differing(&before.services, &now.services, service),
        actions: differing(&before.actions, &now.actions, action),
        nodes: differing(&before.nodes, &now.nodes, node),
    }
}

/// Returns the removed entries.
fn gone(before: &Graph, now: &Graph) -> Gone {
    Gone {
        topics: missing(&before.topics, &now.topics),
        services: missing(&before.services, &now.services),
        actions: missing(&before.actions, &now.actions),
        nodes: missing(&before.nodes, &now.nodes),
    }
}

fn differing<T: PartialEq, P>(
    before: &BTreeMap<String, T>,
    now: &BTreeMap<String, T>,
    write: impl Fn(&str, &T) -> P,
) -> Vec<P> {
    let differs = now.iter().filter(|(name, info)| before.get(*name) != Some(*info));
    differs.map(|(name, info)| write(name, info)).collect()
}

fn missing<T>(before: &BTreeMap<String, T>, now: &BTreeMap<String, T>) -> Vec<String> {
    before.keys().filter(|name| !now.contains_key(*name)).cloned().collect()
}

fn topic(name: &str, info: &TopicInfo) -> proto::Topic {
    proto::Topic {
        name: name.to_owned(),
        r#type: info.type_name().unwrap_or_default().to_owned(),
        publishers: info.publishers.iter().map(endpoint).collect(),
        subscribers: info.subscribers.iter().map(endpoint).collect(),
    }
}

fn endpoint(info: &EndpointInfo) -> proto::Endpoint {
    proto::Endpoint {
        node: info.node.clone().unwrap_or_default(),
        r#type: info.type_name.clone(),
        type_hash: info.type_hash.clone().unwrap_or_default(),
        qos: Some(qos::to_proto(&info.qos)),
        is_gateway: info.is_own,
    }
}

fn names(nodes: &[Option<String>]) -> Vec<String> {
    nodes.iter().map(|node| node.clone().unwrap_or_default()).collect()
}

fn service(name: &str, info: &ServiceInfo) -> proto::Service {
    proto::Service {
        name: name.to_owned(),
        r#type: info.type_name.clone(),
        servers: names(&info.servers),
        clients: names(&info.clients),
    }
}

fn action(name: &str, info: &ActionInfo) -> proto::Service {
    proto::Service {
        name: name.to_owned(),
        r#type: info.type_name.clone(),
        servers: names(&info.servers),
        clients: names(&info.clients),
    }
}

fn node(name: &str, info: &NodeInfo) -> proto::Node {
    proto::Node {
        name: name.to_owned(),
        publishes: info.publishes.iter().cloned().collect(),
        subscribes: info.subscribes.iter().cloned().collect(),
        serves: info.serves.iter().cloned().collect(),
        calls: info.calls.iter().cloned().collect(),
    }
}
