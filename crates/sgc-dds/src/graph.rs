//! The ROS graph on DDS: a writer and a reader of `ros_discovery_info`, as every rmw has them.
//!
//! This module moves messages; [`sgc_ros::graph`] interprets them.

use std::sync::{Arc, Mutex};
use std::time::{SystemTime, UNIX_EPOCH};

use sgc_ros::graph::{GidBytes, GraphView, encode_nodes, graph_reader, graph_writer};
use sgc_ros::{DiscoveryEvent, GraphNode, Guid, RosError, RosWriter, Sample, SampleKind};
use sgc_sync::lock;

use crate::participant::{Participant, SharedHandler};
use crate::reader::CycloneReader;
use crate::writer::CycloneWriter;

/// The writer that announces this participant's nodes.
#[derive(Debug)]
pub(crate) struct Announcer {
    writer: CycloneWriter,
    participant: Guid,
    said: Mutex<AnnouncedNodes>,
}

#[derive(Debug, Default)]
struct AnnouncedNodes {
    /// The announced nodes; `None` until the first announcement.
    nodes: Option<Vec<GraphNode>>,
    gid_bytes: GidBytes,
}

impl Announcer {
    pub(crate) fn new(participant: &Arc<Participant>) -> Result<Self, String> {
        let writer = CycloneWriter::new(participant, &graph_writer())?;
        Ok(Self { writer, participant: participant.guid(), said: Mutex::default() })
    }

    /// Announces these nodes, and no others, from now on.
    pub(crate) fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        let mut said = lock(&self.said);
        if said.nodes.as_deref() == Some(nodes) {
            return Ok(());
        }
        said.nodes = Some(nodes.to_vec());
        self.write(&said)
    }

    /// Sets the length of ids in the network, and repeats the announcement if the length changed.
    fn set_gid_bytes(&self, gid_bytes: GidBytes) {
        let mut said = lock(&self.said);
        if std::mem::replace(&mut said.gid_bytes, gid_bytes) != gid_bytes
            && let Err(error) = self.write(&said)
        {
            tracing::debug!(%error, "the graph could not be told of this participant's nodes");
        }
    }

    fn write(&self, said: &AnnouncedNodes) -> Result<(), RosError> {
        let Some(nodes) = &said.nodes else { return Ok(()) };
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let stamp = unix.as_nanos().try_into().unwrap_or(0);
        let message = encode_nodes(&self.participant, nodes, said.gid_bytes);
        self.writer.write(SampleKind::Write, stamp, message)
    }
}

/// The listener to other participants' announcements, which forwards them to a handler.
pub(crate) struct Listener {
    view: Mutex<GraphView>,
    handler: SharedHandler,
    announcer: Arc<Announcer>,
}

impl Listener {
    pub(crate) fn new(handler: SharedHandler, announcer: Arc<Announcer>) -> Arc<Self> {
        Arc::new(Self { view: Mutex::default(), handler, announcer })
    }

    /// Starts to listen. Dropping the result ends it.
    pub(crate) fn listen(self: &Arc<Self>, participant: &Arc<Participant>) -> Result<CycloneReader, String> {
        let listener = Arc::clone(self);
        CycloneReader::new(
            participant,
            &graph_reader(),
            Box::new(move |sample: Sample| {
                listener.change(|view| match view.handle_message(sample.writer, &sample.payload) {
                    Ok(event) => event,
                    Err(error) => {
                        tracing::debug!(%error, writer = ?sample.writer, "a message about the graph is dropped");
                        None
                    }
                });
            }),
        )
    }

    /// Applies a change and reports the event that follows from it.
    pub(crate) fn change(&self, change: impl FnOnce(&mut GraphView) -> Option<DiscoveryEvent>) {
        let mut view = lock(&self.view);
        if let Some(event) = change(&mut view) {
            lock(&self.handler)(event);
        }
        let gid_bytes = view.gid_bytes();
        drop(view);
        self.announcer.set_gid_bytes(gid_bytes);
    }
}
