//! ROS 2 nodes that this proxy shows in the local ROS graph: far nodes for the endpoints that stand for them, and one
//! node of its own for the rest.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use sgc_ros::{EndpointKind, GraphNode, Guid, RosNetwork};
use sgc_sync::lock;
use sgc_wire::{Name, NodeId, RosNode, SourceId};
use tokio::sync::mpsc;
use tracing::debug;

use crate::control::event::ConsumerKey;
use crate::data::stats::Drops;
use crate::drops::NodeDrop;

/// Key of a local writer: the joined name and the source.
type WriterKey = (Name, Option<SourceId>);

/// The endpoints that stand for one consumer, with its node.
struct ConsumerEnds {
    node: (NodeId, RosNode),
    readers: Vec<Guid>,
    writers: Vec<Guid>,
}

/// Endpoints of this proxy, by node.
pub(crate) struct LocalGraph {
    own: Option<RosNode>,
    writers: BTreeMap<WriterKey, Guid>,
    /// Node of each writer. The SGC node is included, since nodes of two robots may have the same name.
    nodes: BTreeMap<WriterKey, (NodeId, RosNode)>,
    readers: BTreeMap<Name, Guid>,
    /// Node of the writer that writes a share's far messages, if known.
    publishers: BTreeMap<Name, (NodeId, RosNode)>,
    /// Endpoints that stand for far consumers.
    consumers: BTreeMap<ConsumerKey, ConsumerEnds>,
    has_changed: bool,
    /// The next graph for the thread that shows it; `None` once the thread has taken it.
    wanted: Arc<Mutex<Option<Vec<GraphNode>>>>,
    /// Held while the graph is shown, so that the newest is shown last.
    showing: Arc<Mutex<()>>,
}

impl LocalGraph {
    /// Creates the graph of the SGC node with this name, without endpoints.
    pub(crate) fn new(node: &str) -> Self {
        Self {
            own: own_node(node),
            writers: BTreeMap::new(),
            nodes: BTreeMap::new(),
            readers: BTreeMap::new(),
            publishers: BTreeMap::new(),
            consumers: BTreeMap::new(),
            has_changed: true,
            wanted: Arc::default(),
            showing: Arc::default(),
        }
    }

    pub(crate) fn writer_there(&mut self, key: WriterKey, guid: Guid) {
        self.has_changed |= self.writers.insert(key, guid) != Some(guid);
    }

    /// Removes a writer.
    pub(crate) fn writer_gone(&mut self, key: &WriterKey) {
        self.nodes.remove(key);
        self.has_changed |= self.writers.remove(key).is_some();
    }

    /// Moves a writer to another source. Its node is unknown until it is set.
    pub(crate) fn writer_moved(&mut self, name: Name, from: SourceId, to: SourceId) {
        let guid = self.writers.get(&(name, Some(from))).copied();
        self.writer_gone(&(name, Some(from)));
        if let Some(guid) = guid {
            self.writer_there((name, Some(to)), guid);
        }
    }

    pub(crate) fn reader_there(&mut self, name: Name, guid: Guid) {
        self.has_changed |= self.readers.insert(name, guid) != Some(guid);
    }

    pub(crate) fn reader_gone(&mut self, name: &Name) {
        self.has_changed |= self.readers.remove(name).is_some();
    }

    /// Adds the reader and the writer of a service.
    pub(crate) fn service_there(&mut self, name: Name, [reader, writer]: [Guid; 2]) {
        self.reader_there(name, reader);
        self.writer_there((name, None), writer);
    }

    pub(crate) fn service_gone(&mut self, name: &Name) {
        self.reader_gone(name);
        self.writer_gone(&(*name, None));
    }

    /// Removes all endpoints and keeps the nodes that they stand for.
    pub(crate) fn endpoints_gone(&mut self) {
        self.readers.clear();
        self.writers.clear();
        self.consumers.clear();
        self.has_changed = true;
    }

    /// Sets the node of a present or future writer. The name's reader gets the same node if the writer serves all
    /// sources.
    pub(crate) fn set_node(&mut self, key: WriterKey, owner: NodeId, node: Option<RosNode>) {
        self.has_changed |= match node {
            Some(node) => {
                let node = (owner, node);
                self.nodes.insert(key, node.clone()) != Some(node)
            }
            None => self.nodes.remove(&key).is_some(),
        };
    }

    /// Replaces the nodes of the writers of far messages.
    pub(crate) fn set_publishers(&mut self, publishers: BTreeMap<Name, (NodeId, RosNode)>) {
        self.has_changed |= std::mem::replace(&mut self.publishers, publishers.clone()) != publishers;
    }

    /// Adds the endpoints of a consumer of this node.
    pub(crate) fn consumer_there(&mut self, key: ConsumerKey, node: RosNode, ends: &[(EndpointKind, Guid)]) {
        let of = |kind| ends.iter().filter(move |(of, _)| *of == kind).map(|(_, guid)| *guid).collect();
        let node = (key.peer, node);
        let ends =
            ConsumerEnds { node, readers: of(EndpointKind::Reader), writers: of(EndpointKind::Writer) };
        self.consumers.insert(key, ends);
        self.has_changed = true;
    }

    pub(crate) fn consumer_gone(&mut self, key: &ConsumerKey) {
        self.has_changed |= self.consumers.remove(key).is_some();
    }

    /// Returns all nodes, each of one owner once, if they changed since the last call.
    fn changed(&mut self) -> Option<Vec<GraphNode>> {
        if !std::mem::take(&mut self.has_changed) {
            return None;
        }
        let mut own = (Vec::new(), Vec::new());
        let mut far = BTreeMap::<_, (Vec<Guid>, Vec<Guid>)>::new();
        for (name, guid) in &self.readers {
            match self.nodes.get(&(*name, None)) {
                Some(node) => far.entry(node).or_default().0.push(*guid),
                None => own.0.push(*guid),
            }
        }
        for (key, guid) in &self.writers {
            let publisher = || self.publishers.get(&key.0).filter(|_| key.1.is_none());
            match self.nodes.get(key).or_else(publisher) {
                Some(node) => far.entry(node).or_default().1.push(*guid),
                None => own.1.push(*guid),
            }
        }
        for ends in self.consumers.values() {
            let of_node = far.entry(&ends.node).or_default();
            of_node.0.extend(&ends.readers);
            of_node.1.extend(&ends.writers);
        }
        let own = self.own.clone().map(|node| GraphNode { node, readers: own.0, writers: own.1 });
        let far = far.into_iter().map(|((_, node), (readers, writers))| GraphNode {
            node: node.clone(),
            readers,
            writers,
        });
        Some(own.into_iter().chain(far).collect())
    }
}

/// Returns the ROS 2 node that stands for the SGC node with this name.
fn own_node(node: &str) -> Option<RosNode> {
    let word: String = node.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    let word = &word[..word.len().min(RosNode::NAME_BYTES_MAX - 4)];
    RosNode::new("/", &format!("sgc_{word}"), None)
}

/// Showing on the local network.
impl LocalGraph {
    /// Shows changes in the local graph on a blocking thread.
    pub(crate) fn show<N: RosNetwork>(
        &mut self,
        network: Arc<N>,
        alive: &mpsc::Sender<()>,
        failures: &Arc<Drops>,
    ) {
        let Some(nodes) = self.changed() else { return };
        let (wanted, showing) = (self.wanted.clone(), self.showing.clone());
        let is_under_way = lock(&wanted).replace(nodes).is_some();
        if is_under_way {
            return;
        }
        let (alive, failures) = (alive.clone(), failures.clone());
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let _turn = lock(&showing);
            let Some(nodes) = lock(&wanted).take() else { return };
            if let Err(error) = network.announce(&nodes) {
                failures.count(NodeDrop::AnnounceNodes);
                debug!(%error, "the local graph does not show the far nodes");
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn endpoints_are_those_of_far_nodes_or_of_this_proxy() {
        let (name, source) = (Name([1; 32]), |n| Some(SourceId([n; 16])));
        let guid = |n| Guid([n; 16]);
        let talker = || RosNode::new("/", "talker", None);
        let mut graph = LocalGraph::new("arm-1.lab");
        let shown = |graph: &mut LocalGraph| {
            let nodes = graph.changed()?.into_iter();
            let shown = nodes.map(|n| (n.node.to_string(), n.readers.len(), n.writers.len()));
            Some(shown.collect::<Vec<_>>())
        };
        let of = |name: &str, readers, writers| (name.to_owned(), readers, writers);
        assert_eq!(shown(&mut graph).unwrap(), [of("/sgc_arm_1_lab", 0, 0)]);
        assert_eq!(shown(&mut graph), None);
        graph.reader_there(name, guid(1));
        graph.writer_there((name, None), guid(2));
        // The node may be known before the writer exists, and two robots may have nodes of one name.
        graph.set_node((name, source(1)), NodeId([1; 32]), talker());
        graph.set_node((name, source(2)), NodeId([2; 32]), talker());
        assert_eq!(shown(&mut graph).unwrap(), [of("/sgc_arm_1_lab", 1, 1)]);
        graph.writer_there((name, source(1)), guid(3));
        graph.writer_there((name, source(2)), guid(4));
        let talkers = [of("/talker", 0, 1), of("/talker", 0, 1)];
        assert_eq!(shown(&mut graph).unwrap()[1..], talkers);
        // One node may have several endpoints.
        graph.writer_there((name, source(3)), guid(5));
        graph.set_node((name, source(3)), NodeId([2; 32]), talker());
        assert_eq!(shown(&mut graph).unwrap()[1..], [of("/talker", 0, 1), of("/talker", 0, 2)]);
        graph.writer_gone(&(name, source(1)));
        graph.set_node((name, source(3)), NodeId([2; 32]), None);
        assert_eq!(shown(&mut graph).unwrap(), [of("/sgc_arm_1_lab", 1, 2), of("/talker", 0, 1)]);
        // A node that publishes and subscribes counts once.
        let of_two = ConsumerKey { interface: name, peer: NodeId([2; 32]), id: [1; 8] };
        graph.writer_there((name, source(2)), guid(4));
        graph.consumer_there(of_two, talker().unwrap(), &[(EndpointKind::Reader, guid(6))]);
        assert_eq!(shown(&mut graph).unwrap()[1..], [of("/talker", 1, 1)]);
        graph.consumer_gone(&of_two);
        assert_eq!(shown(&mut graph).unwrap()[1..], [of("/talker", 0, 1)]);
        // One writer writes all far messages of a share and stands for one of their publishers. Its reader belongs to
        // this proxy.
        graph.set_publishers([(name, (NodeId([2; 32]), talker().unwrap()))].into());
        assert_eq!(shown(&mut graph).unwrap(), [of("/sgc_arm_1_lab", 1, 1), of("/talker", 0, 2)]);
        graph.set_publishers(BTreeMap::new());
        graph.reader_gone(&name);
        [None, source(2), source(3)].iter().for_each(|s| graph.writer_gone(&(name, *s)));
        assert_eq!(shown(&mut graph).unwrap(), [of("/sgc_arm_1_lab", 0, 0)]);
    }
}
