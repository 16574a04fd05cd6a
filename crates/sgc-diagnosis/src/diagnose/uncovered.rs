//! Interfaces that no rule names.

use sgc_node::graph::{Graph, Interface};
use sgc_ros::matches;

use super::local::{ends, meant};
use crate::finding::RuleFinding;

/// Explains an interface that no rule names.
pub(super) fn uncovered(graph: &Graph, topic: &str) -> RuleFinding {
    let node = graph.node.clone();
    let shares = || graph.shares.iter().map(|share| share.topic.as_str());
    let uses = || graph.uses.iter().map(|used| used.topic.as_str());
    let offers = || graph.offers.iter().map(|offer| offer.topic.as_str());
    if let Some(offer) = graph.offers.iter().find(|offer| offer.topic == topic && !offer.is_used) {
        return RuleFinding::Unused {
            owner: offer.owner.clone(),
            kind: offer.kind,
            topic: topic.to_owned(),
            node,
            needs_publish: !offer.subscribe && offer.kind == Interface::Topic,
        };
    }
    for kind in [Interface::Topic, Interface::Service, Interface::Action] {
        let (providers, consumers) = ends(graph, kind, topic);
        let topic = topic.to_owned();
        if !providers.is_empty() {
            let meant = meant(&topic, shares());
            return RuleFinding::Unshared { count: providers.len(), kind, topic, node, meant };
        }
        if !consumers.is_empty() {
            let meant = meant(&topic, offers().chain(uses()));
            return RuleFinding::Unbrought { count: consumers.len(), kind, topic, node, meant };
        }
    }
    let here = graph.endpoints.iter().filter(|e| e.is_ros_topic).map(|e| e.topic.as_str());
    RuleFinding::Absent {
        topic: topic.to_owned(),
        pattern: shares().find(|rule| matches(rule, topic)).map(str::to_owned),
        meant: meant(topic, here.chain(offers()).chain(shares()).chain(uses())),
    }
}
