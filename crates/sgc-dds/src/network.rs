//! [`CycloneNetwork`]: one participant in one DDS domain.
//!
//! It opens the [`Participant`] and hands it to readers, writers and discovery, which keep it alive. It moves no sample
//! itself.

use std::collections::BTreeSet;
use std::net::Ipv4Addr;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use cyclors::{dds_create_participant, dds_domain_set_deafmute, dds_get_children};
use sgc_ros::graph::graph_writer;
use sgc_ros::{
    DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid, Reach, RequestHandler, RosError,
    RosNetwork, SampleHandler, ServiceSpec, ShownEndpoint,
};
use sgc_sync::lock;

use crate::config::{DdsConfig, reaches_out};
use crate::discovery::{self, Running};
use crate::domain::Domain;
use crate::entity::{Entity, INFINITE};
use crate::fragments;
use crate::graph::Announcer;
use crate::host_addresses::{self, Changes};
use crate::log;
use crate::participant::Participant;
use crate::reader::CycloneReader;
use crate::same_host::{SameHost, Silence};
use crate::security::Security;
use crate::service::{CycloneClient, CycloneServer};
use crate::shown;
use crate::writer::CycloneWriter;

/// Time for which this host's addresses must be stable before they count. DHCP and a change of the interface take
/// several steps.
const SETTLED: Duration = Duration::from_secs(3);

/// A local ROS 2 network, joined with Cyclone DDS.
///
/// Each network has its own participant in its own Cyclone domain. Several domains in one process work, and so do
/// several networks on one domain, which then talk over the loopback interface like strangers. Readers, writers and
/// discovery keep the participant alive; dropping the network ends discovery only.
#[derive(Debug)]
pub struct CycloneNetwork {
    discovery: Mutex<Option<Running>>,
    /// The announcer of nodes, if the ROS graph is reported and announced.
    announcer: Option<Arc<Announcer>>,
    participant: Arc<Participant>,
    config: DdsConfig,
    /// The address changes before the network was opened.
    opened_after: Changes,
    /// The number of address changes that do not affect the network.
    changes_seen: AtomicU64,
    /// Disconnected when everything created on the network is dropped.
    all_dropped: Mutex<Option<Receiver<()>>>,
}

impl CycloneNetwork {
    /// Joins the domain.
    ///
    /// # Errors
    /// [`RosError::Domain`] if the configuration is invalid or Cyclone refuses it. The reason is Cyclone's log line:
    /// a missing interface, no free participant index, or a peer that is not a host name.
    pub fn open(config: &DdsConfig) -> Result<Self, RosError> {
        log::install();
        host_addresses::follow();
        // Cyclone's own settings may choose IPv6.
        if reaches_out(config) && config.cyclonedds_uri.as_deref().is_none_or(|uri| uri.trim().is_empty()) {
            host_addresses::note_reaching_out();
        }
        let opened_after = host_addresses::changes();
        let (alive, all_dropped) = channel();
        let refused = |reason| RosError::Domain { domain: config.domain, reason };
        if let Err(reason) = fragments::guard_discovery() {
            tracing::warn!(
                reason,
                "this Cyclone DDS is another one: a program of the local network may write beyond this node's memory"
            );
        }
        let _opening = log::Opening::begin();
        let participant = Arc::new(Participant::open(config, alive)?);
        let explained = |reason| refused(participant.explain(&graph_writer().topic, reason));
        let announcer = config.graph.then(|| Announcer::new(&participant)).transpose().map_err(explained)?;
        Ok(Self {
            discovery: Mutex::new(None),
            announcer: announcer.map(Arc::new),
            participant,
            config: config.clone(),
            opened_after,
            changes_seen: AtomicU64::new(opened_after.number),
            all_dropped: Mutex::new(Some(all_dropped)),
        })
    }

    /// Returns the addresses from which a network opened now would speak to other hosts, without sending anything.
    fn outward_now(&self) -> Result<Vec<Ipv4Addr>, RosError> {
        let refused = |reason| RosError::Domain { domain: self.config.domain, reason };
        let domain = Domain::create(&self.config)?;
        let _silence = Silence::begin(&domain.entity).map_err(refused)?;
        // SAFETY: null means the default QoS and no listener.
        let (handle, _) =
            log::listen(|| unsafe { dds_create_participant(domain.id, std::ptr::null(), std::ptr::null()) });
        let same_host = Entity::new(handle).and_then(|participant| SameHost::install(&participant));
        Ok(same_host.map_err(refused)?.outward().to_vec())
    }

    fn refuse_endpoint(&self, kind: &'static str, spec: &EndpointSpec, reason: String) -> RosError {
        let reason = self.participant.explain(&spec.topic, reason);
        RosError::Create { kind, topic: spec.topic.clone(), type_name: spec.type_name.clone(), reason }
    }

    /// Returns the GUID of the participant. Readers and writers created here share its first 12 bytes.
    pub fn guid(&self) -> Guid {
        self.participant.guid()
    }

    /// Makes the network neither send nor receive for a while, as when its cable is pulled. For tests.
    #[doc(hidden)]
    pub fn set_deaf_mute(&self, duration: Duration) {
        let ns = i64::try_from(duration.as_nanos()).unwrap_or(INFINITE);
        // SAFETY: takes numbers only; the handle is checked by Cyclone.
        unsafe { dds_domain_set_deafmute(self.participant.domain().handle(), true, true, ns) };
    }

    /// Returns the number of DDS entities directly below the participant: topics, publishers, subscribers and
    /// conditions. For tests and metrics; it is constant unless something leaks.
    pub fn entity_count(&self) -> usize {
        // SAFETY: with no room for handles the call only counts.
        let count = unsafe { dds_get_children(self.participant.entity().handle(), std::ptr::null_mut(), 0) };
        usize::try_from(count).unwrap_or(0)
    }
}

impl RosNetwork for CycloneNetwork {
    type Reader = CycloneReader;
    type Writer = CycloneWriter;
    type Client = CycloneClient;
    type Server = CycloneServer;

    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        let refused = |reason| RosError::Domain { domain: self.config.domain, reason };
        let mut running = lock(&self.discovery);
        if running.is_some() {
            return Err(refused("discovery has been started already".into()));
        }
        let (participant, announcer) = (Arc::clone(&self.participant), self.announcer.clone());
        *running = Some(discovery::start(participant, handler, announcer).map_err(refused)?);
        Ok(())
    }

    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<CycloneReader, RosError> {
        CycloneReader::new(&self.participant, spec, handler)
            .map_err(|reason| self.refuse_endpoint("reader", spec, reason))
    }

    fn create_writer(&self, spec: &EndpointSpec) -> Result<CycloneWriter, RosError> {
        CycloneWriter::new(&self.participant, spec)
            .map_err(|reason| self.refuse_endpoint("writer", spec, reason))
    }

    fn create_client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<CycloneClient, RosError> {
        CycloneClient::new(&self.participant, spec, handler)
            .map_err(|reason| self.refuse_endpoint("client", &spec.request, reason))
    }

    fn create_server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<CycloneServer, RosError> {
        CycloneServer::new(&self.participant, spec, handler)
            .map_err(|reason| self.refuse_endpoint("server", &spec.request, reason))
    }

    fn reader_guid(&self, reader: &CycloneReader) -> Guid {
        reader.guid()
    }

    fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        self.participant.renewed_ago(writer)
    }

    fn has_graph(&self) -> bool {
        self.announcer.is_some()
    }

    fn nodes_here(&self) -> BTreeSet<String> {
        self.participant.local_nodes().tags()
    }

    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError> {
        let word = match kind {
            EndpointKind::Reader => "reader",
            EndpointKind::Writer => "writer",
        };
        shown::create(&self.participant, kind, spec).map_err(|reason| {
            let forbidden = self.participant.security().filter(|_| Security::forbids(&reason));
            match forbidden {
                Some(security) => RosError::ForbiddenPartition {
                    file: security.permissions().display().to_string(),
                    enclave: security.enclave.clone(),
                    partition: shown::PARTITION,
                    topic: spec.topic.clone(),
                },
                None => self.refuse_endpoint(word, spec, reason),
            }
        })
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        self.announcer.as_ref().map_or(Ok(()), |announcer| announcer.announce(nodes))
    }

    fn reach(&self) -> Reach {
        let changes = host_addresses::changes();
        let Some(outward) = self.participant.outward().filter(|_| reaches_out(&self.config)) else {
            return Reach::Whole;
        };
        let (Some(last), true) = (changes.last, changes.number != self.changes_seen.load(Ordering::Relaxed))
        else {
            return Reach::Whole;
        };
        if last.elapsed() < SETTLED || !host_addresses::has_any() {
            return Reach::Doubtful;
        }
        let is_whole = !outward.is_empty() && outward.iter().all(|address| host_addresses::is_here(*address));
        // A network that was opened after a change or found no address moves to where there are more.
        if outward.is_empty() || self.opened_after.number > 0 {
            return Reach::CutOff;
        }
        match is_whole {
            true => Reach::Whole,
            false if log::is_cut_off_since(last) => Reach::CutOff,
            false => Reach::Doubtful,
        }
    }

    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        let changes = host_addresses::changes();
        let outward = self.outward_now()?;
        let here = self.participant.outward().unwrap_or_default();
        let gains = !outward.is_empty() && outward != here;
        if !gains {
            self.changes_seen.store(changes.number, Ordering::Relaxed);
        }
        Ok(gains)
    }

    fn close(self: Arc<Self>, max: Duration) -> bool {
        drop(lock(&self.discovery).take());
        let all_dropped = lock(&self.all_dropped).take();
        drop(self);
        // Nothing is sent on the channel; only its end matters.
        all_dropped.is_none_or(|dropped| dropped.recv_timeout(max) == Err(RecvTimeoutError::Disconnected))
    }
}

impl Drop for CycloneNetwork {
    fn drop(&mut self) {
        // Discovery ends with its threads before the participant.
        drop(self.discovery.get_mut().unwrap_or_else(PoisonError::into_inner).take());
    }
}
