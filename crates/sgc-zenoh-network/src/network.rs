//! [`ZenohNetwork`]: one session in one ROS domain.

use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_ros::{
    DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid, Reach, RequestHandler, RosError,
    RosNetwork, SampleHandler, ServiceSpec, ServiceTopic, ShownEndpoint,
};
use sgc_sync::lock;
use sgc_zenoh::EntityKind;

use crate::config::ZenohConfig;
use crate::discovery::{self, Running};
use crate::late::Late;
use crate::participant::{Participant, off_runtime};
use crate::reader::ZenohReader;
use crate::service::{ZenohClient, ZenohServer};
use crate::writer::ZenohWriter;

/// A local ROS 2 network whose programs use rmw_zenoh.
///
/// Each network has its own session. Readers, writers and discovery keep the session open; dropping the network ends
/// discovery only.
#[derive(Debug)]
pub struct ZenohNetwork {
    /// Ends before the session.
    discovery: Mutex<Option<Running>>,
    participant: Arc<Participant>,
    graph: bool,
    /// Disconnected when everything created on the network is dropped and the session is closed.
    all_dropped: Mutex<Option<Receiver<()>>>,
}

impl ZenohNetwork {
    /// Opens a session. It does not wait for the router, which is found whenever it is there, unless the user's settings
    /// make the session a client.
    ///
    /// # Errors
    /// [`RosError::Domain`] if Zenoh refuses the configuration, or does not find the router of a client.
    pub fn open(config: &ZenohConfig) -> Result<Self, RosError> {
        let (alive, all_dropped) = channel();
        let participant = Participant::open(config, alive)?;
        Ok(Self {
            discovery: Mutex::new(None),
            participant,
            graph: config.graph,
            all_dropped: Mutex::new(Some(all_dropped)),
        })
    }

    fn refuse_endpoint(kind: &'static str, spec: &EndpointSpec, reason: String) -> RosError {
        RosError::Create { kind, topic: spec.topic.clone(), type_name: spec.type_name.clone(), reason }
    }
}

impl RosNetwork for ZenohNetwork {
    type Reader = ZenohReader;
    type Writer = ZenohWriter;
    type Client = ZenohClient;
    type Server = ZenohServer;

    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        let refused = |reason| RosError::Domain { domain: self.participant.domain(), reason };
        let mut running = lock(&self.discovery);
        if running.is_some() {
            return Err(refused("discovery has been started already".into()));
        }
        *running = Some(discovery::start(&self.participant, handler, self.graph).map_err(refused)?);
        Ok(())
    }

    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<ZenohReader, RosError> {
        ZenohReader::new(&self.participant, spec, handler)
            .map_err(|reason| Self::refuse_endpoint("reader", spec, reason))
    }

    fn create_writer(&self, spec: &EndpointSpec) -> Result<ZenohWriter, RosError> {
        ZenohWriter::new(&self.participant, spec)
            .map_err(|reason| Self::refuse_endpoint("writer", spec, reason))
    }

    fn create_client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<ZenohClient, RosError> {
        ZenohClient::new(&self.participant, spec, handler)
            .map_err(|reason| Self::refuse_endpoint("client", &spec.request, reason))
    }

    fn create_server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<ZenohServer, RosError> {
        ZenohServer::new(&self.participant, spec, handler)
            .map_err(|reason| Self::refuse_endpoint("server", &spec.request, reason))
    }

    fn reader_guid(&self, reader: &ZenohReader) -> Guid {
        reader.guid()
    }

    fn has_graph(&self) -> bool {
        self.graph
    }

    fn missing_router(&self) -> Option<String> {
        self.participant.missing_routers()
    }

    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError> {
        let word = match kind {
            EndpointKind::Reader => "reader",
            EndpointKind::Writer => "writer",
        };
        let refused = |reason| Self::refuse_endpoint(word, spec, reason);
        // A client has one token for both of its topics, so that of its requests stands for it. Others must not take a
        // server that is only shown for one that answers.
        let entity = match (ServiceTopic::parse(&spec.topic, &spec.type_name), kind) {
            (None, EndpointKind::Reader) => EntityKind::Subscription,
            (None, EndpointKind::Writer) => EntityKind::Publisher,
            (Some((ServiceTopic::Request, ..)), EndpointKind::Writer) => EntityKind::Client,
            (Some(_), _) => return Ok(ShownEndpoint::new(self.participant.reserve().guid(kind), ())),
        };
        let key = match entity {
            EntityKind::Client => self.participant.service_of(spec),
            _ => self.participant.topic_of(spec),
        };
        let (at, qos) = (self.participant.reserve(), spec.qos.clone());
        let shown = Late::new(&self.participant, key.map_err(refused)?, move |participant, topic| {
            participant.enter(at, entity, topic, &qos, None)
        });
        Ok(ShownEndpoint::new(at.guid(kind), shown.map_err(refused)?))
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        if !self.graph {
            return Ok(());
        }
        self.participant.announce(nodes).map_err(|reason| RosError::Write { reason })
    }

    fn reach(&self) -> Reach {
        // Zenoh connects again by itself. A session that ended does not.
        if self.participant.session().is_closed() { Reach::CutOff } else { Reach::Whole }
    }

    fn close(self: Arc<Self>, max: Duration) -> bool {
        drop(lock(&self.discovery).take());
        let all_dropped = lock(&self.all_dropped).take();
        // The thread that closes the session may be done with it before this one, which is then its last owner.
        off_runtime(|| drop(self));
        // Nothing is sent on the channel; only its end matters.
        all_dropped.is_none_or(|dropped| dropped.recv_timeout(max) == Err(RecvTimeoutError::Disconnected))
    }
}
