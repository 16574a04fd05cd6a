//! The ROS graph on DDS: a writer and a reader of `ros_discovery_info`, as every rmw has them.
//!
//! Moves messages; what they say is read and kept in [`sgc_ros::graph`].

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{SystemTime, UNIX_EPOCH};

use sgc_ros::graph::{GidBytes, GraphView, encode_nodes, graph_reader, graph_writer};
use sgc_ros::{DiscoveryEvent, DiscoveryHandler, GraphNode, Guid, RosError, RosWriter, Sample, SampleKind};

use crate::network::Participant;
use crate::reader::CycloneReader;
use crate::writer::CycloneWriter;

/// A handler that several threads tell, one at a time.
pub(crate) type SharedHandler = Arc<Mutex<DiscoveryHandler>>;

/// Says what nodes this participant has.
#[derive(Debug)]
pub(crate) struct Announcer {
    writer: CycloneWriter,
    participant: Guid,
    said: Mutex<Said>,
}

#[derive(Debug, Default)]
struct Said {
    /// Nothing is said before there is something to say.
    nodes: Option<Vec<GraphNode>>,
    gid_bytes: GidBytes,
}

impl Announcer {
    pub(crate) fn new(participant: &Arc<Participant>) -> Result<Self, String> {
        let writer = CycloneWriter::new(participant, &graph_writer())?;
        Ok(Self { writer, participant: participant.guid(), said: Mutex::default() })
    }

    /// These nodes from now on.
    pub(crate) fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        let mut said = lock(&self.said);
        if said.nodes.as_deref() == Some(nodes) {
            return Ok(());
        }
        said.nodes = Some(nodes.to_vec());
        self.write(&said)
    }

    /// The network's ids are that long from now on: what was said is said again if it was said otherwise.
    fn set_gid_bytes(&self, gid_bytes: GidBytes) {
        let mut said = lock(&self.said);
        if std::mem::replace(&mut said.gid_bytes, gid_bytes) != gid_bytes
            && let Err(error) = self.write(&said)
        {
            tracing::debug!(%error, "the graph could not be told of this participant's nodes");
        }
    }

    fn write(&self, said: &Said) -> Result<(), RosError> {
        let Some(nodes) = &said.nodes else { return Ok(()) };
        let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let stamp = unix.as_nanos().try_into().unwrap_or(0);
        let message = encode_nodes(&self.participant, nodes, said.gid_bytes);
        self.writer.write(SampleKind::Write, stamp, message)
    }
}

/// What the other participants say of theirs, and whom to tell.
pub(crate) struct Listener {
    view: Mutex<GraphView>,
    handler: SharedHandler,
    announcer: Arc<Announcer>,
}

impl Listener {
    pub(crate) fn new(handler: SharedHandler, announcer: Arc<Announcer>) -> Arc<Self> {
        Arc::new(Self { view: Mutex::default(), handler, announcer })
    }

    /// Starts listening; ends when what it returns is dropped.
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

    /// Takes in what changed, and tells what follows from it.
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

pub(crate) fn lock<T>(value: &Mutex<T>) -> MutexGuard<'_, T> {
    value.lock().unwrap_or_else(PoisonError::into_inner)
}
