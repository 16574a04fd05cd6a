//! [`Participant`]: a DDS participant and its domain, which readers, writers and discovery keep alive.
//!
//! It creates the topics and groups of endpoints, and holds the state that all endpoints of a network share.

use std::net::Ipv4Addr;
use std::sync::atomic::AtomicUsize;
use std::sync::mpsc::Sender;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use cyclors::{
    dds_create_participant, dds_create_publisher, dds_create_subscriber, dds_get_entity_sertype, dds_set_qos,
};
use sgc_ros::graph::graph_writer;
use sgc_ros::{DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, Guid, RosError};
use sgc_sync::{Pace, Workers, lock};

use crate::announced;
use crate::backpressure::RemoteWriters;
use crate::config::DdsConfig;
use crate::domain::Domain;
use crate::entity::{Entity, check};
use crate::first_messages::{self, EndpointWatch};
use crate::local_nodes::LocalNodes;
use crate::log;
use crate::plugin_domain;
use crate::qos::NativeQos;
use crate::same_host::{SameHost, Silence};
use crate::sample;
use crate::security::{Security, SecurityError};
use crate::user_data;

/// A handler that several threads call, one at a time.
pub(crate) type SharedHandler = Arc<Mutex<DiscoveryHandler>>;

/// The participant and its domain. Fields drop in this order.
#[derive(Debug)]
pub(crate) struct Participant {
    entity: Entity,
    /// Ends before the domain. `None` if the participant loses programs on this host when its addresses change.
    same_host: Option<SameHost>,
    domain: Entity,
    /// The watch of discovered endpoints, unless this Cyclone is another one. Ends after the domain.
    endpoint_watch: Option<EndpointWatch>,
    guid: Guid,
    tag: Option<String>,
    security: Option<Security>,
    /// Threads that hand over readers' samples.
    workers: Workers,
    pace: Pace,
    holds: Pace,
    writers: AtomicUsize,
    late_writers: AtomicUsize,
    local_nodes: LocalNodes,
    /// The handler of discovery events while discovery runs.
    watcher: Mutex<Weak<Mutex<DiscoveryHandler>>>,
    /// Dropped last.
    _alive: Sender<()>,
}

impl Participant {
    /// Creates a participant in a domain of its own. `alive` is dropped with it.
    ///
    /// # Errors
    /// As of [`crate::CycloneNetwork::open`].
    pub(crate) fn open(config: &DdsConfig, alive: Sender<()>) -> Result<Self, RosError> {
        let refused = |reason| RosError::Domain { domain: config.domain, reason };
        let workers = Workers::start("sgc-dds-read", || ()).map_err(|error| refused(error.to_string()))?;
        let domain = Domain::create(config)?;
        let qos = NativeQos::new().map_err(refused)?;
        let security = config.security.as_ref();
        if let Some(security) = security {
            secure(security, &domain, config, &qos)?;
        }
        let named = security.map_or(user_data::DEFAULT_ENCLAVE, |security| &security.enclave);
        let enclave = config.graph.then_some(named);
        let data = user_data::for_participant(config.tag.as_deref(), enclave);
        qos.set_user_data(&user_data::while_opening(&data));
        let silence = Silence::begin(&domain.entity);
        let entity = create_entity(&domain, config, &qos)?;
        let same_host = silence.as_ref().map_err(String::clone).and_then(|_| SameHost::install(&entity));
        if let Err(reason) = &same_host {
            tracing::warn!(reason, "programs of this host may be lost when its addresses change");
        }
        let guid = entity.guid().map_err(refused)?;
        let endpoint_watch = first_messages::install(&domain.entity, &entity).inspect_err(|reason| {
            tracing::warn!(
                reason,
                "this Cyclone DDS is another one: first messages of Fast DDS writers may be lost"
            );
        });
        let participant = Self {
            entity,
            same_host: same_host.ok(),
            domain: domain.entity,
            endpoint_watch: endpoint_watch.ok(),
            guid,
            tag: config.tag.clone(),
            security: config.security.clone(),
            workers,
            pace: Pace::new(),
            holds: Pace::new(),
            writers: AtomicUsize::new(0),
            late_writers: AtomicUsize::new(0),
            local_nodes: LocalNodes::default(),
            watcher: Mutex::default(),
            _alive: alive,
        };
        // No endpoint has been announced yet.
        participant.complete_announcements(config)?;
        drop(silence);
        // The change makes Cyclone announce the participant at once. Without it Cyclone would repeat the announcement
        // to peers after 30 s.
        qos.set_user_data(&data);
        // SAFETY: the QoS object outlives the call, which copies it; the handle is checked by Cyclone.
        check(unsafe { dds_set_qos(participant.entity.handle(), qos.as_ptr()) }).map_err(refused)?;
        Ok(participant)
    }

    /// Makes announcements of endpoints contain the parameters that Cyclone omits, or warns that they do not.
    fn complete_announcements(&self, config: &DdsConfig) -> Result<(), RosError> {
        let completed = self.try_complete_announcements().or_else(|reason| {
            // Without a graph an enclave need not have the topic that this needs.
            if config.graph {
                let reason = self.explain(&graph_writer().topic, reason);
                Err(RosError::Domain { domain: config.domain, reason })
            } else {
                Ok(false)
            }
        })?;
        if !completed {
            tracing::warn!(
                "readers and writers are announced as Cyclone does: Fast DDS 3 shows no node for them"
            );
        }
        Ok(())
    }

    pub(crate) fn entity(&self) -> &Entity {
        &self.entity
    }

    pub(crate) fn guid(&self) -> Guid {
        self.guid
    }

    /// Returns the other SGC nodes on the network.
    pub(crate) fn local_nodes(&self) -> &LocalNodes {
        &self.local_nodes
    }

    /// Returns the participant's domain.
    pub(crate) fn domain(&self) -> &Entity {
        &self.domain
    }

    /// Returns the protection of the participant, if it has one.
    pub(crate) fn security(&self) -> Option<&Security> {
        self.security.as_ref()
    }

    /// Returns the addresses besides loopback from which the participant speaks to other hosts. Returns `None` if
    /// the participant loses programs on this host when its addresses change.
    pub(crate) fn outward(&self) -> Option<&[Ipv4Addr]> {
        self.same_host.as_ref().map(SameHost::outward)
    }

    /// Returns the time since a writer renewed its lease, if leases are watched.
    pub(crate) fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        self.endpoint_watch.as_ref()?.leases.renewed_ago(writer)
    }

    /// Returns the writers whose samples a reader can refuse, unless this Cyclone is another one.
    pub(crate) fn remote_writers(&self) -> Option<&RemoteWriters> {
        Some(&self.endpoint_watch.as_ref()?.writers)
    }

    /// Returns `true` if the endpoint belongs to this participant.
    pub(crate) fn owns(&self, endpoint: &Guid) -> bool {
        self.guid.0[..12] == endpoint.0[..12]
    }

    /// Returns the threads that hand over readers' samples.
    pub(crate) fn workers(&self) -> &Workers {
        &self.workers
    }

    /// Returns the limiter of the work that receiving threads do themselves.
    pub(crate) fn pace(&self) -> &Pace {
        &self.pace
    }

    /// Returns the number of open writers.
    pub(crate) fn writers(&self) -> &AtomicUsize {
        &self.writers
    }

    /// Returns the number of open writers whose publisher did not announce its depth.
    pub(crate) fn late_writers(&self) -> &AtomicUsize {
        &self.late_writers
    }

    /// Sets the handler that readers inform of writers' liveliness, for as long as discovery keeps it.
    pub(crate) fn watch(&self, handler: &SharedHandler) {
        *lock(&self.watcher) = Arc::downgrade(handler);
    }

    /// Informs the handler of discovery events. May block.
    pub(crate) fn tell(&self, event: DiscoveryEvent) {
        let watcher = lock(&self.watcher).upgrade();
        if let Some(watcher) = watcher {
            lock(&watcher)(event);
        }
    }

    /// Returns the limiter of waits for workers.
    pub(crate) fn holds(&self) -> &Pace {
        &self.holds
    }

    /// Returns `true` if DDS Security protects the participant.
    pub(crate) fn is_secured(&self) -> bool {
        self.security.is_some()
    }

    /// Explains the failure to create an endpoint if DDS Security forbids it.
    pub(crate) fn explain(&self, topic: &str, reason: String) -> String {
        match &self.security {
            Some(security) => security.explain(topic, reason),
            None => reason,
        }
    }

    /// Returns `true` if endpoints of SGC nodes are ignored.
    pub(crate) fn ignores_tagged(&self) -> bool {
        self.tag.is_some()
    }

    /// Makes announcements of endpoints contain the parameters that Cyclone omits. Returns `false` if this Cyclone
    /// differs from the expected one. Called by the thread that creates the participant, before any other knows it.
    fn try_complete_announcements(&self) -> Result<bool, String> {
        let topic = self.topic(&graph_writer())?;
        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
        check(unsafe { dds_get_entity_sertype(topic.handle(), &mut sertype) })?;
        // SAFETY: the topic keeps its type registered, and no other thread makes topics in its domain yet.
        Ok(unsafe { announced::complete(sertype) })
    }

    /// Creates the topic of a spec. Each endpoint has a topic entity of its own, deleted with it.
    pub(crate) fn topic(&self, spec: &EndpointSpec) -> Result<Entity, String> {
        sample::topic(&self.entity, spec)
    }

    /// Creates the publisher or subscriber of a spec, if its partitions need one.
    pub(crate) fn group(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<Option<Entity>, String> {
        if spec.qos.partitions.is_empty() {
            return Ok(None);
        }
        let qos = NativeQos::group(&spec.qos.partitions)?;
        let (parent, listener) = (self.entity.handle(), std::ptr::null());
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        Entity::new(unsafe {
            match kind {
                EndpointKind::Reader => dds_create_subscriber(parent, qos.as_ptr(), listener),
                EndpointKind::Writer => dds_create_publisher(parent, qos.as_ptr(), listener),
            }
        })
        .map(Some)
    }

    /// Returns the QoS of an endpoint with its USER_DATA, to which `more` elements are added.
    pub(crate) fn endpoint_qos(
        &self,
        kind: EndpointKind,
        spec: &EndpointSpec,
        more: &str,
    ) -> Result<NativeQos, String> {
        if let Some(hash) = spec.type_hash.as_deref().filter(|h| !user_data::is_value(h)) {
            return Err(format!("type hash {hash:?} cannot stand in USER_DATA"));
        }
        let mut data = user_data::build(self.tag.as_deref(), spec.type_hash.as_deref());
        data.extend_from_slice(more.as_bytes());
        let qos = NativeQos::endpoint(kind, &spec.qos, spec.keyless, &data)?;
        if self.tag.is_some() {
            // A proxy's samples must never return to it through its own readers. The parts of other networks belong
            // to several programs, which receive from each other.
            qos.set_ignores_own();
        }
        Ok(qos)
    }
}

/// Adds the protection to the QoS of a participant that is to be created in the domain.
fn secure(security: &Security, domain: &Domain, config: &DdsConfig, qos: &NativeQos) -> Result<(), RosError> {
    let refused = |e| unsecured(config, security, e);
    if domain.is_alias()
        && let Err(reason) = plugin_domain::install(&domain.entity, domain.id, config.domain)
    {
        tracing::debug!(reason, "the plugins of DDS Security cannot be told the ROS domain");
        return Err(refused(SecurityError::NotFirst));
    }
    security.apply(qos).map_err(refused)
}

/// Creates the entity, or returns Cyclone's log line.
fn create_entity(domain: &Domain, config: &DdsConfig, qos: &NativeQos) -> Result<Entity, RosError> {
    let refused = |reason| RosError::Domain { domain: config.domain, reason };
    // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
    let (handle, said) =
        log::listen(|| unsafe { dds_create_participant(domain.id, qos.as_ptr(), std::ptr::null()) });
    Entity::new(handle).map_err(|reason| match &config.security {
        Some(security) if said.is_empty() => unsecured(config, security, security.refused(reason)),
        Some(security) => unsecured(config, security, security.refused(said)),
        None if said.is_empty() => refused(reason),
        None => refused(format!("{reason}: {said}")),
    })
}

fn unsecured(config: &DdsConfig, security: &Security, error: SecurityError) -> RosError {
    let reason = format!("enclave {}: {error}", security.enclave);
    RosError::Domain { domain: config.domain, reason }
}
