//! [`Connections`]: publishers, subscribers and servers as the client knows them, and the changes since.

use std::collections::{BTreeMap, BTreeSet};

use crate::graph::Graph;

use super::protocol::{Providers, Publishers, ServerMessage, Subscribers};

type Ends = BTreeMap<String, BTreeSet<String>>;

/// The connection graph that was sent to a client.
#[derive(Debug, Default)]
pub(super) struct Connections {
    publishers: Ends,
    subscribers: Ends,
    servers: Ends,
}

impl Connections {
    /// Stores the current state and returns the changes as a message, if there are any. Names for which `is_shown` is
    /// false are left out.
    pub(super) fn update(&mut self, graph: &Graph, is_shown: impl Fn(&str) -> bool) -> Option<String> {
        let now = Self::from_graph(graph, is_shown);
        let published = changes(&self.publishers, &now.publishers);
        let subscribed = changes(&self.subscribers, &now.subscribers);
        let served = changes(&self.servers, &now.servers);
        let has = |name: &String| now.publishers.contains_key(name) || now.subscribers.contains_key(name);
        let known: BTreeSet<_> = self.publishers.keys().chain(self.subscribers.keys()).collect();
        let removed_topics: Vec<_> = known.into_iter().filter(|name| !has(name)).cloned().collect();
        let gone = self.servers.keys().filter(|name| !now.servers.contains_key(*name));
        let removed_services: Vec<_> = gone.cloned().collect();
        *self = now;
        // A removed topic is listed as removed, not as one without endpoints.
        let stays = |(name, _): &(String, Vec<String>)| removed_topics.binary_search(name).is_err();
        let published = published.into_iter().filter(stays);
        let subscribed = subscribed.into_iter().filter(stays);
        let served = served.into_iter().filter(|(name, _)| removed_services.binary_search(name).is_err());
        let published: Vec<_> =
            published.map(|(name, publisher_ids)| Publishers { name, publisher_ids }).collect();
        let subscribed: Vec<_> =
            subscribed.map(|(name, subscriber_ids)| Subscribers { name, subscriber_ids }).collect();
        let served: Vec<_> = served.map(|(name, provider_ids)| Providers { name, provider_ids }).collect();
        let nothing = published.is_empty() && subscribed.is_empty() && served.is_empty();
        if nothing && removed_topics.is_empty() && removed_services.is_empty() {
            return None;
        }
        let told = ServerMessage::ConnectionGraphUpdate {
            published_topics: &published,
            subscribed_topics: &subscribed,
            advertised_services: &served,
            removed_topics: &removed_topics,
            removed_services: &removed_services,
        };
        Some(told.to_json())
    }

    fn from_graph(graph: &Graph, is_shown: impl Fn(&str) -> bool) -> Self {
        let mut all = Self::default();
        for (name, info) in graph.topics.iter().filter(|(name, _)| is_shown(name)) {
            // An endpoint whose node is unknown is identified by its GUID.
            let ends = |ends: &[crate::graph::EndpointInfo]| {
                ends.iter().map(|end| end.node.clone().unwrap_or_else(|| guid_text(&end.guid.0))).collect()
            };
            if !info.publishers.is_empty() {
                all.publishers.insert(name.clone(), ends(&info.publishers));
            }
            if !info.subscribers.is_empty() {
                all.subscribers.insert(name.clone(), ends(&info.subscribers));
            }
        }
        for (name, info) in graph.services.iter().filter(|(name, _)| is_shown(name)) {
            if !info.servers.is_empty() {
                let servers = info.servers.iter().map(|node| node.clone().unwrap_or_else(|| "?".to_owned()));
                all.servers.insert(name.clone(), servers.collect());
            }
        }
        all
    }
}

/// Returns the new and changed entries, and the removed entries with an empty list.
fn changes(before: &Ends, now: &Ends) -> Vec<(String, Vec<String>)> {
    let changed = now.iter().filter(|(name, ends)| before.get(*name) != Some(ends));
    let left = before.keys().filter(|name| !now.contains_key(*name)).map(|name| (name.clone(), Vec::new()));
    changed.map(|(name, ends)| (name.clone(), ends.iter().cloned().collect())).chain(left).collect()
}

fn guid_text(guid: &[u8; 16]) -> String {
    guid.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use sgc_ros::Guid;
    use sgc_wire::Qos;

    use super::*;
    use crate::graph::{EndpointInfo, ServiceInfo, TopicInfo};

    fn end(node: Option<&str>) -> EndpointInfo {
        EndpointInfo {
            guid: Guid([7; 16]),
            node: node.map(str::to_owned),
            type_name: "T".into(),
            type_hash: None,
            qos: Qos::default(),
            keyless: true,
            is_own: false,
        }
    }

    #[test]
    fn only_changes_are_told() {
        let mut connections = Connections::default();
        let mut graph = Graph::default();
        assert_eq!(connections.update(&graph, |_| true), None);
        let topic = TopicInfo { publishers: vec![end(Some("/a"))], subscribers: vec![end(None)] };
        graph.topics.insert("/t".into(), topic);
        graph
            .topics
            .insert("/hidden".into(), TopicInfo { publishers: vec![end(None)], subscribers: Vec::new() });
        let service = ServiceInfo { servers: vec![Some("/a".into())], ..ServiceInfo::default() };
        graph.services.insert("/s".into(), service);
        let shown = |name: &str| name != "/hidden";
        let first = connections.update(&graph, shown).unwrap();
        assert_eq!(
            first,
            r#"{"op":"connectionGraphUpdate","publishedTopics":[{"name":"/t","publisherIds":["/a"]}],"#
                .to_owned()
                + r#""subscribedTopics":[{"name":"/t","subscriberIds":["07070707070707070707070707070707"]}],"#
                + r#""advertisedServices":[{"name":"/s","providerIds":["/a"]}],"removedTopics":[],"removedServices":[]}"#
        );
        assert_eq!(connections.update(&graph, shown), None);
        graph.topics.get_mut("/t").unwrap().publishers.clear();
        graph.services.clear();
        let second = connections.update(&graph, shown).unwrap();
        assert!(second.contains(r#""publishedTopics":[{"name":"/t","publisherIds":[]}]"#), "{second}");
        assert!(second.contains(r#""subscribedTopics":[],"advertisedServices":[]"#), "{second}");
        assert!(second.contains(r#""removedServices":["/s"]"#), "{second}");
        graph.topics.clear();
        let third = connections.update(&graph, shown).unwrap();
        assert!(third.contains(r#""removedTopics":["/t"]"#) && third.contains(r#""publishedTopics":[]"#));
    }
}
