//! [`CycloneNetwork`]: one participant in one DDS domain.
//!
//! It creates the domain and the participant, and hands them to readers, writers and discovery, which keep them
//! alive. It moves no sample itself.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicU32, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use cyclors::{
    DDS_RETCODE_PRECONDITION_NOT_MET, dds_create_domain, dds_create_participant, dds_create_publisher,
    dds_create_subscriber, dds_domain_set_deafmute, dds_get_children, dds_get_entity_sertype, dds_set_qos,
};
use sgc_ros::graph::graph_writer;
use sgc_ros::{
    DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid, Reach, RequestHandler,
    RosError, RosNetwork, SampleHandler, ServiceSpec, ShownEndpoint,
};
use sgc_sync::lock;

use crate::announced;
use crate::config::{
    DdsConfig, DiscoveryRange, HOST_ADDRESSES_MAX, Instance, PEERS_MAX, chooses_interfaces, cyclone_config,
    far_hosts, local_addresses, reaches_out,
};
use crate::discovery::{self, Running};
use crate::entity::{Entity, c_string, check, reason};
use crate::first_messages;
use crate::fragments;
use crate::graph::{Announcer, SharedHandler};
use crate::host_addresses::{self, Changes};
use crate::intake::Pace;
use crate::log;
use crate::manual_leases::Leases;
use crate::plugin_domain;
use crate::qos::NativeQos;
use crate::reader::CycloneReader;
use crate::same_host::{SameHost, Silence};
use crate::sample;
use crate::security::{Security, SecurityError};
use crate::service::{CycloneClient, CycloneServer};
use crate::shown;
use crate::user_data;
use crate::writer::CycloneWriter;

/// First of Cyclone's domain ids for networks that share a ROS domain with another of this process; far
/// above every ROS domain id.
const ALIAS_FIRST: u32 = 0x5347_0000;

/// A port for route lookups, for which any would do: the first that a participant of domain 0 listens on (RTPS 2.5,
/// 9.6.2.3).
const DISCOVERY_PORT: u16 = 7410;

/// Time for which this host's addresses must be stable before they count. DHCP and a change of the interface take
/// several steps.
const SETTLED: Duration = Duration::from_secs(3);

/// Most bytes that are read of a file.
const FILE_BYTES_MAX: u64 = 1 << 20;

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

/// The participant and its domain. Fields drop in this order.
#[derive(Debug)]
pub(crate) struct Participant {
    entity: Entity,
    /// Ends before the domain. `None` if the participant loses programs on this host when its addresses change.
    same_host: Option<SameHost>,
    domain: Entity,
    /// The watch of writers' leases, if there is one. Ends after the domain.
    leases: Option<Leases>,
    guid: Guid,
    domain_id: u32,
    tag: Option<String>,
    security: Option<Security>,
    pace: Pace,
    holds: Pace,
    writers: AtomicUsize,
    late_writers: AtomicUsize,
    /// The handler of discovery events while discovery runs.
    watcher: Mutex<Weak<Mutex<DiscoveryHandler>>>,
    /// Dropped last.
    _alive: Sender<()>,
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
        let domain = create_domain(config)?;
        let qos = NativeQos::new().map_err(refused)?;
        let security = config.security.as_ref();
        let unsecured = |security: &Security, e| refused(format!("enclave {}: {e}", security.enclave));
        if let Some(security) = security {
            if domain.is_alias()
                && let Err(reason) = plugin_domain::install(&domain.entity, domain.id, config.domain)
            {
                tracing::debug!(reason, "the plugins of DDS Security cannot be told the ROS domain");
                return Err(unsecured(security, SecurityError::NotFirst));
            }
            security.apply(&qos).map_err(|e| unsecured(security, e))?;
        }
        let named = security.map_or(user_data::DEFAULT_ENCLAVE, |security| &security.enclave);
        let enclave = config.graph.then_some(named);
        let data = user_data::for_participant(config.tag.as_deref(), enclave);
        qos.set_user_data(&user_data::while_opening(&data));
        let silence = Silence::begin(&domain.entity);
        // SAFETY: the QoS object outlives the call, which copies it; null means no listener.
        let (handle, said) =
            log::listen(|| unsafe { dds_create_participant(domain.id, qos.as_ptr(), std::ptr::null()) });
        let entity = Entity::new(handle).map_err(|reason| match security {
            Some(security) if said.is_empty() => unsecured(security, security.refused(reason)),
            Some(security) => unsecured(security, security.refused(said)),
            None if said.is_empty() => refused(reason),
            None => refused(format!("{reason}: {said}")),
        })?;
        let same_host = silence.as_ref().map_err(String::clone).and_then(|_| SameHost::install(&entity));
        if let Err(reason) = &same_host {
            tracing::warn!(reason, "programs of this host may be lost when its addresses change");
        }
        let guid = entity.guid().map_err(refused)?;
        let inside = first_messages::install(&domain.entity, &entity).inspect_err(|reason| {
            tracing::warn!(
                reason,
                "this Cyclone DDS is another one: first messages of Fast DDS writers may be lost"
            );
        });
        let participant = Participant {
            entity,
            same_host: same_host.ok(),
            domain: domain.entity,
            leases: inside.ok().map(Leases),
            guid,
            domain_id: config.domain,
            tag: config.tag.clone(),
            security: config.security.clone(),
            pace: Pace::new(),
            holds: Pace::new(),
            writers: AtomicUsize::new(0),
            late_writers: AtomicUsize::new(0),
            watcher: Mutex::default(),
            _alive: alive,
        };
        // No endpoint has been announced yet.
        let completed = participant.complete_announcements().or_else(|reason| {
            // Without a graph an enclave need not have the topic that this needs.
            if config.graph {
                Err(refused(participant.explain(&graph_writer().topic, reason)))
            } else {
                Ok(false)
            }
        })?;
        if !completed {
            tracing::warn!(
                "readers and writers are announced as Cyclone does: Fast DDS 3 shows no node for them"
            );
        }
        drop(silence);
        // The change makes Cyclone announce the participant at once. Without it Cyclone would repeat the announcement
        // to peers after 30 s.
        qos.set_user_data(&data);
        // SAFETY: the QoS object outlives the call, which copies it; the handle is checked by Cyclone.
        check(unsafe { dds_set_qos(participant.entity.handle(), qos.as_ptr()) }).map_err(refused)?;
        let participant = Arc::new(participant);
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
        let domain = create_domain(&self.config)?;
        let _silence = Silence::begin(&domain.entity).map_err(refused)?;
        // SAFETY: null means the default QoS and no listener.
        let (handle, _) =
            log::listen(|| unsafe { dds_create_participant(domain.id, std::ptr::null(), std::ptr::null()) });
        let same_host = Entity::new(handle).and_then(|participant| SameHost::install(&participant));
        Ok(same_host.map_err(refused)?.outward().to_vec())
    }

    /// Returns the GUID of the participant. Readers and writers created here share its first 12 bytes.
    pub fn guid(&self) -> Guid {
        self.participant.guid
    }

    /// Makes the network neither send nor receive for a while, as when its cable is pulled. For tests.
    #[doc(hidden)]
    pub fn set_deaf_mute(&self, duration: Duration) {
        let ns = i64::try_from(duration.as_nanos()).unwrap_or(crate::entity::INFINITE);
        // SAFETY: takes numbers only; the handle is checked by Cyclone.
        unsafe { dds_domain_set_deafmute(self.participant.domain.handle(), true, true, ns) };
    }

    /// Returns the number of DDS entities directly below the participant: topics, publishers, subscribers and
    /// conditions. For tests and metrics; it is constant unless something leaks.
    pub fn entity_count(&self) -> usize {
        // SAFETY: with no room for handles the call only counts.
        let count = unsafe { dds_get_children(self.participant.entity.handle(), std::ptr::null_mut(), 0) };
        usize::try_from(count).unwrap_or(0)
    }
}

impl RosNetwork for CycloneNetwork {
    type Reader = CycloneReader;
    type Writer = CycloneWriter;
    type Client = CycloneClient;
    type Server = CycloneServer;

    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        let refused = |reason| RosError::Domain { domain: self.participant.domain_id, reason };
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
        self.participant.leases.as_ref()?.renewed_ago(writer)
    }

    fn has_graph(&self) -> bool {
        self.announcer.is_some()
    }

    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError> {
        let word = match kind {
            EndpointKind::Reader => "reader",
            EndpointKind::Writer => "writer",
        };
        shown::create(&self.participant, kind, spec).map_err(|reason| {
            let forbidden = self.participant.security.as_ref().filter(|_| Security::forbids(&reason));
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
        let Some(same_host) = self.participant.same_host.as_ref().filter(|_| reaches_out(&self.config))
        else {
            return Reach::Whole;
        };
        let (Some(last), true) = (changes.last, changes.number != self.changes_seen.load(Ordering::Relaxed))
        else {
            return Reach::Whole;
        };
        if last.elapsed() < SETTLED || !host_addresses::has_any() {
            return Reach::Doubtful;
        }
        let outward = same_host.outward();
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
        let here = self.participant.same_host.as_ref().map_or(&[][..], SameHost::outward);
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

impl Participant {
    pub(crate) fn entity(&self) -> &Entity {
        &self.entity
    }

    pub(crate) fn guid(&self) -> Guid {
        self.guid
    }

    /// Returns `true` if the endpoint belongs to this participant.
    pub(crate) fn owns(&self, endpoint: &Guid) -> bool {
        self.guid.0[..12] == endpoint.0[..12]
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

    /// Returns the limiter of waits for readers' threads.
    pub(crate) fn holds(&self) -> &Pace {
        &self.holds
    }

    /// Returns `true` if DDS Security protects the participant.
    pub(crate) fn is_secured(&self) -> bool {
        self.security.is_some()
    }

    /// Explains the failure to create an endpoint if DDS Security forbids it.
    fn explain(&self, topic: &str, reason: String) -> String {
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
    fn complete_announcements(&self) -> Result<bool, String> {
        let topic = self.topic(&graph_writer())?;
        let mut sertype = std::ptr::null();
        // SAFETY: the handle is checked by Cyclone, and `sertype` is a valid place for the result.
        check(unsafe { dds_get_entity_sertype(topic.handle(), &mut sertype) })?;
        // SAFETY: the topic keeps its type registered, and no other thread makes topics in its domain yet.
        Ok(unsafe { announced::complete(sertype) })
    }

    /// Creates the topic of a spec. Each endpoint has a topic entity of its own, deleted with it.
    pub(crate) fn topic(&self, spec: &EndpointSpec) -> Result<Entity, String> {
        sample::topic(self, spec)
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

impl CycloneNetwork {
    fn refuse_endpoint(&self, kind: &'static str, spec: &EndpointSpec, reason: String) -> RosError {
        let reason = self.participant.explain(&spec.topic, reason);
        RosError::Create { kind, topic: spec.topic.clone(), type_name: spec.type_name.clone(), reason }
    }
}

struct Domain {
    entity: Entity,
    /// Cyclone's id of the domain.
    id: u32,
}

impl Domain {
    /// Returns `true` if the id is not that of a ROS domain.
    fn is_alias(&self) -> bool {
        self.id >= ALIAS_FIRST
    }
}

/// Creates the Cyclone domain under the ROS domain's own id, so that `<Domain Id="…">` in the user's configuration
/// applies. Uses another id if this process has that one already.
fn create_domain(config: &DdsConfig) -> Result<Domain, RosError> {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, Ordering::Relaxed);
    let interfaces_chosen =
        config.cyclonedds_uri.as_deref().is_some_and(|uri| chooses_interfaces(uri, read_file));
    let host_addresses =
        local_addresses(&read_file("/proc/net/fib_trie").unwrap_or_default(), HOST_ADDRESSES_MAX);
    // With a single address there is no choice.
    let towards_peers =
        if host_addresses.len() > 1 { addresses_towards(&config.static_peers) } else { Vec::new() };
    let process = std::process::id();
    let mut instance =
        Instance { process, number, aliased: false, interfaces_chosen, host_addresses, towards_peers };
    let refused = |reason| RosError::Domain { domain: config.domain, reason };

    for (id, aliased) in [(config.domain, false), (ALIAS_FIRST.wrapping_add(number & 0x00ff_ffff), true)] {
        instance.aliased = aliased;
        let create = |instance: &Instance| {
            let xml = c_string(&cyclone_config(config, instance)?).map_err(refused)?;
            // SAFETY: the configuration is a NUL-terminated string, copied by the call.
            Ok::<_, RosError>(log::listen(|| unsafe { dds_create_domain(id, xml.as_ptr()) }))
        };
        let (mut handle, errors) = create(&instance)?;
        if handle == DDS_RETCODE_PRECONDITION_NOT_MET && !aliased {
            continue;
        }
        if handle < 0 && config.discovery == DiscoveryRange::Subnet && !instance.interfaces_chosen {
            // The interface may be down, for instance. Cyclone's own choice is better than none.
            instance.interfaces_chosen = true;
            (handle, _) = create(&instance)?;
        }
        if handle < 0 && !errors.is_empty() {
            return Err(refused(format!("{}: {errors}", reason(handle))));
        }
        let entity = Entity::new(handle).map_err(refused)?;
        return Ok(Domain { entity, id });
    }
    Err(refused("the domain could not be created".into()))
}

/// Returns the addresses from which this host would reach the peers, by looking up routes without sending a packet.
fn addresses_towards(peers: &[String]) -> Vec<Ipv4Addr> {
    let mut found = Vec::new();
    for host in far_hosts(peers).take(PEERS_MAX) {
        let route = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
            .and_then(|socket| socket.connect((host, DISCOVERY_PORT)).and_then(|()| socket.local_addr()));
        if let Ok(SocketAddr::V4(address)) = route
            && !found.contains(address.ip())
        {
            found.push(*address.ip());
        }
    }
    found.retain(|address| !address.is_loopback());
    found
}

pub(crate) fn read_file(name: &str) -> Option<String> {
    use std::io::Read as _;
    let mut text = String::new();
    let file = std::fs::File::open(name).ok()?;
    file.take(FILE_BYTES_MAX).read_to_string(&mut text).ok()?;
    Some(text)
}
