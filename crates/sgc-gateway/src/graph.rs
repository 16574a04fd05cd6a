//! [`Graph`]: the local network as clients see it. [`GraphState`] follows discovery and builds the graph.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, EndpointKind, GraphNode, Guid, ServiceTopic, ros_topic, ros_type,
};
use sgc_wire::Qos;

/// Suffixes of the topics and services of an action.
const ACTION_FEEDBACK: &str = "/_action/feedback";
const ACTION_GOAL: &str = "/_action/send_goal";
const FEEDBACK_TYPE: &str = "_FeedbackMessage";
const GOAL_TYPE: &str = "_SendGoal";

/// An endpoint of a topic.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EndpointInfo {
    /// The GUID.
    pub guid: Guid,
    /// The full name of its ROS 2 node, if the network announces it.
    pub node: Option<String>,
    /// The ROS type.
    pub type_name: String,
    /// The type hash (`RIHS01_…`), if the endpoint announces one.
    pub type_hash: Option<String>,
    /// The offered or requested QoS.
    pub qos: Qos,
    /// `true` if the type has no key.
    pub keyless: bool,
    /// `true` if the endpoint belongs to this gateway.
    pub is_own: bool,
}

/// A topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct TopicInfo {
    /// The publishers.
    pub publishers: Vec<EndpointInfo>,
    /// The subscribers.
    pub subscribers: Vec<EndpointInfo>,
}

impl TopicInfo {
    /// Returns the type that most endpoints have; in a tie the first by name.
    pub fn type_name(&self) -> Option<&str> {
        let mut counts: BTreeMap<&str, usize> = BTreeMap::new();
        for end in self.publishers.iter().chain(&self.subscribers) {
            *counts.entry(&end.type_name).or_default() += 1;
        }
        let most = counts.values().copied().max()?;
        counts.into_iter().find(|(_, count)| *count == most).map(|(name, _)| name)
    }

    /// Returns the hash that endpoints announce for a type.
    pub fn type_hash(&self, type_name: &str) -> Option<&str> {
        let ends = self.publishers.iter().chain(&self.subscribers);
        ends.filter(|end| end.type_name == type_name).find_map(|end| end.type_hash.as_deref())
    }
}

/// A service.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ServiceInfo {
    /// The ROS type.
    pub type_name: String,
    /// The servers, by the full names of their ROS 2 nodes, if the network announces these.
    pub servers: Vec<Option<String>>,
    /// The clients, by the full names of their ROS 2 nodes.
    pub clients: Vec<Option<String>>,
}

/// An action.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ActionInfo {
    /// The ROS type.
    pub type_name: String,
    /// The servers, by the full names of their ROS 2 nodes.
    pub servers: Vec<Option<String>>,
    /// The clients, by the full names of their ROS 2 nodes.
    pub clients: Vec<Option<String>>,
}

/// A ROS 2 node and the names of its interfaces.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct NodeInfo {
    /// Published topics.
    pub publishes: BTreeSet<String>,
    /// Subscribed topics.
    pub subscribes: BTreeSet<String>,
    /// Served services.
    pub serves: BTreeSet<String>,
    /// Called services.
    pub calls: BTreeSet<String>,
}

/// The graph of the local network.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Graph {
    /// Topics by name, including those of actions.
    pub topics: BTreeMap<String, TopicInfo>,
    /// Services by name, including those of actions.
    pub services: BTreeMap<String, ServiceInfo>,
    /// Actions by name.
    pub actions: BTreeMap<String, ActionInfo>,
    /// Nodes by full name.
    pub nodes: BTreeMap<String, NodeInfo>,
}

impl Graph {
    /// Returns the graph without topics, services and actions that the filters refuse.
    #[must_use]
    pub fn filtered(&self, topic: impl Fn(&str) -> bool, service: impl Fn(&str) -> bool) -> Self {
        let mut graph = self.clone();
        graph.topics.retain(|name, _| topic(name));
        graph.services.retain(|name, _| service(name));
        graph.actions.retain(|name, _| service(name));
        for node in graph.nodes.values_mut() {
            node.publishes.retain(|name| topic(name));
            node.subscribes.retain(|name| topic(name));
            node.serves.retain(|name| service(name));
            node.calls.retain(|name| service(name));
        }
        graph
    }
}

/// Returns `true` for a hidden topic or service, such as those of an action.
pub fn is_hidden(name: &str) -> bool {
    name.contains("/_")
}

/// The endpoints and nodes that discovery reported, and the gateway's own.
#[derive(Debug, Default)]
pub(crate) struct GraphState {
    endpoints: BTreeMap<Guid, (DiscoveredEndpoint, bool)>,
    nodes: BTreeMap<Guid, Vec<GraphNode>>,
    /// The graph of the current state, built on demand.
    made: Option<Arc<Graph>>,
}

impl GraphState {
    pub(crate) fn handle(&mut self, event: DiscoveryEvent) {
        self.made = None;
        match event {
            DiscoveryEvent::Appeared(endpoint) => {
                self.endpoints.insert(endpoint.guid, (endpoint, false));
            }
            DiscoveryEvent::Vanished { guid } => {
                self.endpoints.remove(&guid);
            }
            // The graph shows endpoints as long as they exist, as in ROS 2.
            DiscoveryEvent::Liveliness { .. } | DiscoveryEvent::HistoryDepth { .. } => {}
            DiscoveryEvent::Nodes { participant, nodes } if nodes.is_empty() => {
                self.nodes.remove(&participant);
            }
            DiscoveryEvent::Nodes { participant, nodes } => {
                self.nodes.insert(participant, nodes);
            }
        }
    }

    pub(crate) fn add_own(&mut self, endpoint: DiscoveredEndpoint) {
        self.made = None;
        self.endpoints.insert(endpoint.guid, (endpoint, true));
    }

    pub(crate) fn remove_own(&mut self, guid: &Guid) {
        self.made = None;
        self.endpoints.remove(guid);
    }

    /// Returns the gateway's own readers and writers.
    pub(crate) fn own(&self) -> (Vec<Guid>, Vec<Guid>) {
        let own = |kind| {
            let all = self.endpoints.values().filter(move |(end, is_own)| *is_own && end.kind == kind);
            all.map(|(end, _)| end.guid).collect()
        };
        (own(EndpointKind::Reader), own(EndpointKind::Writer))
    }

    /// Returns `true` if the endpoint still exists.
    pub(crate) fn is_there(&self, guid: &Guid) -> bool {
        self.endpoints.contains_key(guid)
    }

    /// Returns the graph. `own_node` is the name of the gateway's node.
    pub(crate) fn graph(&mut self, own_node: &str) -> Arc<Graph> {
        if let Some(made) = &self.made {
            return Arc::clone(made);
        }
        let made = Arc::new(self.make(own_node));
        self.made = Some(Arc::clone(&made));
        made
    }

    fn make(&self, own_node: &str) -> Graph {
        let mut graph = Graph::default();
        let mut node_of: BTreeMap<Guid, String> = BTreeMap::new();
        for node in self.nodes.values().flatten() {
            let name = node.node.to_string();
            for guid in node.readers.iter().chain(&node.writers) {
                node_of.insert(*guid, name.clone());
            }
            graph.nodes.entry(name).or_default();
        }
        graph.nodes.entry(own_node.to_owned()).or_default();
        for (endpoint, is_own) in self.endpoints.values() {
            let node = if *is_own { Some(own_node.to_owned()) } else { node_of.get(&endpoint.guid).cloned() };
            add(&mut graph, endpoint, *is_own, node);
        }
        graph
    }
}

fn add(graph: &mut Graph, endpoint: &DiscoveredEndpoint, is_own: bool, node: Option<String>) {
    let is_writer = endpoint.kind == EndpointKind::Writer;
    let mut tell = |pick: fn(&mut NodeInfo) -> &mut BTreeSet<String>, what: &str| {
        if let Some(node) = &node {
            pick(graph.nodes.entry(node.clone()).or_default()).insert(what.to_owned());
        }
    };
    if let Some(topic) = ros_topic(&endpoint.topic) {
        let type_name = ros_type(&endpoint.type_name);
        if is_writer {
            tell(|node| &mut node.publishes, topic);
        } else {
            tell(|node| &mut node.subscribes, topic);
        }
        if let (Some(action), Some(of)) =
            (topic.strip_suffix(ACTION_FEEDBACK), type_name.strip_suffix(FEEDBACK_TYPE))
        {
            let action = graph.actions.entry(action.to_owned()).or_default();
            action.type_name = of.to_owned();
            if !is_writer {
                action.clients.push(node.clone());
            }
        }
        let info = EndpointInfo {
            guid: endpoint.guid,
            node,
            type_name,
            type_hash: endpoint.type_hash.clone(),
            qos: endpoint.qos.clone(),
            keyless: endpoint.keyless,
            is_own,
        };
        let topic = graph.topics.entry(topic.to_owned()).or_default();
        if is_writer {
            topic.publishers.push(info)
        } else {
            topic.subscribers.push(info)
        }
        return;
    }
    let Some((half, service, type_name)) = ServiceTopic::parse(&endpoint.topic, &endpoint.type_name) else {
        return;
    };
    // A server reads requests and a client writes them, so the replies add no information.
    if half == ServiceTopic::Reply {
        return;
    }
    if is_writer {
        tell(|node| &mut node.calls, service);
    } else {
        tell(|node| &mut node.serves, service);
    }
    if let (Some(action), Some(of), false) =
        (service.strip_suffix(ACTION_GOAL), type_name.strip_suffix(GOAL_TYPE), is_writer)
    {
        let action = graph.actions.entry(action.to_owned()).or_default();
        action.type_name = of.to_owned();
        action.servers.push(node.clone());
    }
    let info = graph.services.entry(service.to_owned()).or_default();
    info.type_name = type_name;
    if is_writer { info.clients.push(node) } else { info.servers.push(node) }
}

#[cfg(test)]
mod tests {
    use sgc_wire::RosNode;

    use super::*;

    fn endpoint(kind: EndpointKind, number: u8, topic: &str, type_name: &str) -> DiscoveryEvent {
        DiscoveryEvent::Appeared(DiscoveredEndpoint {
            kind,
            guid: Guid([number; 16]),
            topic: topic.into(),
            type_name: type_name.into(),
            keyless: true,
            type_hash: None,
            qos: Qos::default(),
        })
    }

    #[test]
    fn endpoints_become_topics_services_actions_and_nodes() {
        use EndpointKind::{Reader, Writer};
        let mut state = GraphState::default();
        let string = "std_msgs::msg::dds_::String_";
        state.handle(endpoint(Writer, 1, "rt/chatter", string));
        state.handle(endpoint(Reader, 2, "rt/chatter", string));
        state.handle(endpoint(Reader, 3, "rq/addRequest", "a::srv::dds_::Add_Request_"));
        state.handle(endpoint(Writer, 4, "rr/addReply", "a::srv::dds_::Add_Response_"));
        let goal = ("rq/go/_action/send_goalRequest", "a::action::dds_::Go_SendGoal_Request_");
        state.handle(endpoint(Reader, 5, goal.0, goal.1));
        state.handle(endpoint(Writer, 6, "plain", "Plain"));
        let nodes = vec![GraphNode {
            node: RosNode::new("/arm", "talker", None).unwrap(),
            readers: vec![Guid([3; 16])],
            writers: vec![Guid([1; 16])],
        }];
        state.handle(DiscoveryEvent::Nodes { participant: Guid([9; 16]), nodes });
        let graph = state.graph("/gateway");
        let chatter = &graph.topics["/chatter"];
        assert_eq!((chatter.type_name(), chatter.subscribers.len()), (Some("std_msgs/msg/String"), 1));
        assert_eq!(chatter.publishers[0].node.as_deref(), Some("/arm/talker"));
        assert_eq!(graph.services["/add"].type_name, "a/srv/Add");
        assert_eq!(graph.services["/add"].servers, [Some("/arm/talker".to_owned())]);
        assert_eq!(graph.actions["/go"].type_name, "a/action/Go");
        assert_eq!((graph.topics.len(), graph.services.len(), graph.actions.len()), (1, 2, 1));
        assert_eq!(graph.nodes["/arm/talker"].serves, BTreeSet::from(["/add".to_owned()]));
        assert!(graph.nodes.contains_key("/gateway"));

        let seen = graph.filtered(|topic| topic != "/chatter", |_| true);
        assert!(seen.topics.is_empty() && seen.nodes["/arm/talker"].publishes.is_empty());

        state.handle(DiscoveryEvent::Vanished { guid: Guid([1; 16]) });
        assert!(state.graph("/gateway").topics["/chatter"].publishers.is_empty());
    }
}
