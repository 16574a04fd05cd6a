//! [`GatewayNetwork`]: the gateway's part of the local network, which may be closed and opened again.
//!
//! The hub's readers, writers, clients and servers stay. Only the entities behind them end and are created again, and
//! the hub knows each by the GUID that it had first. `local/reopening.rs` decides when.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_gateway::{LocalReader, LocalRos};
use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointSpec, GraphNode, Guid, HandleCalls, Reach,
    RequestHandler, RequestId, RosClient, RosError, RosServer, RosWriter, SampleHandler, SampleHead,
    SentRequest, ServiceSpec, SharedSamples, UnhandledCall,
};
use sgc_sync::lock;
use sgc_wire::History;

use super::OpenLocalRos;
use crate::local::rediscovery::Rediscovery;

/// Longest wait for a closed network by work that needs it.
const OPEN_WAIT_MAX: Duration = Duration::from_secs(5);
/// Most messages and bytes of a transient-local writer that are written again on the new network. Cyclone keeps as many
/// messages of a keyed topic.
const KEPT_MAX: usize = 4096;
const KEPT_BYTES_MAX: usize = 64 << 20;

/// The gateway's part of the local network.
pub(crate) struct GatewayNetwork {
    open: OpenLocalRos,
    state: Mutex<State>,
    opened: Condvar,
    discovery: Arc<Mutex<Discovery>>,
}

struct State {
    network: Option<Arc<dyn LocalRos>>,
    /// `true` while the endpoints are opened again.
    is_opening: bool,
    /// The number of openings. An endpoint of an earlier network is not kept.
    generation: u64,
    endpoints: BTreeMap<u64, Weak<dyn Endpoint>>,
    next: u64,
    /// The nodes as the hub announces them, by the GUIDs that it knows.
    announced: Vec<GraphNode>,
}

/// The state of discovery, which the hub sees as one network.
#[derive(Default)]
struct Discovery {
    handler: Option<DiscoveryHandler>,
    generation: u64,
    is_closed: bool,
    endpoints: BTreeMap<Guid, DiscoveredEndpoint>,
    participants: BTreeSet<Guid>,
    rediscovery: Rediscovery,
}

impl Discovery {
    fn handle(&mut self, generation: u64, event: DiscoveryEvent) {
        if self.is_closed || generation != self.generation {
            return;
        }
        if let Some(event) = self.rediscovery.news(event) {
            self.tell(event);
        }
    }

    fn tell(&mut self, event: DiscoveryEvent) {
        match &event {
            DiscoveryEvent::Appeared(endpoint) => {
                self.endpoints.insert(endpoint.guid, endpoint.clone());
            }
            DiscoveryEvent::Vanished { guid } => drop(self.endpoints.remove(guid)),
            DiscoveryEvent::Nodes { participant, nodes } if nodes.is_empty() => {
                self.participants.remove(participant);
            }
            DiscoveryEvent::Nodes { participant, .. } => {
                self.participants.insert(*participant);
            }
            DiscoveryEvent::Liveliness { .. } | DiscoveryEvent::HistoryDepth { .. } => {}
        }
        if let Some(handler) = &mut self.handler {
            handler(event);
        }
    }
}

/// An endpoint of the hub, whose entities end with a network and are created on the next.
trait Endpoint: Send + Sync {
    /// Returns the entities, which end when they are dropped. That may block.
    fn close(&self) -> Box<dyn Any + Send>;
    /// Creates the entities. May block.
    fn open(&self, network: &dyn LocalRos) -> Result<(), RosError>;
    /// Returns the GUIDs that the hub knows, each with the present one.
    fn guids(&self) -> Vec<(Guid, Guid)>;
}

/// Keeps an endpoint among those that are opened again, until dropped.
struct Registered<E: Endpoint + 'static> {
    endpoint: Arc<E>,
    number: u64,
    network: Weak<GatewayNetwork>,
}

impl<E: Endpoint> Drop for Registered<E> {
    fn drop(&mut self) {
        if let Some(network) = self.network.upgrade() {
            network.lock().endpoints.remove(&self.number);
        }
    }
}

impl GatewayNetwork {
    /// Opens the network. May block.
    pub(crate) fn open(open: OpenLocalRos) -> Result<Arc<Self>, RosError> {
        let state = State {
            network: Some(open()?),
            is_opening: false,
            generation: 0,
            endpoints: BTreeMap::new(),
            next: 0,
            announced: Vec::new(),
        };
        Ok(Arc::new(Self {
            open,
            state: Mutex::new(state),
            opened: Condvar::new(),
            discovery: Arc::default(),
        }))
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Returns the open network and its generation. Waits for it.
    fn present(&self) -> Result<(Arc<dyn LocalRos>, u64), RosError> {
        let is_closed = |state: &mut State| state.network.is_none() || state.is_opening;
        let (state, _) = self
            .opened
            .wait_timeout_while(self.lock(), OPEN_WAIT_MAX, is_closed)
            .unwrap_or_else(PoisonError::into_inner);
        Ok((state.network.clone().ok_or(RosError::Closed)?, state.generation))
    }

    /// Creates an endpoint, on the network that is open in the end.
    fn register<E: Endpoint>(self: &Arc<Self>, endpoint: E) -> Result<Registered<E>, RosError> {
        let endpoint = Arc::new(endpoint);
        loop {
            let (network, generation) = self.present()?;
            endpoint.open(&*network)?;
            drop(network);
            let mut state = self.lock();
            if state.generation == generation && state.network.is_some() {
                state.next += 1;
                let number = state.next;
                let weak: Weak<E> = Arc::downgrade(&endpoint);
                state.endpoints.insert(number, weak);
                return Ok(Registered { endpoint, number, network: Arc::downgrade(self) });
            }
            drop(state);
            drop(endpoint.close());
        }
    }

    /// Closes the network, and waits at most for `max` until what was created on it has ended. May block.
    pub(crate) fn close_for_now(&self, max: Duration) {
        let mut state = self.lock();
        let Some(network) = state.network.take() else { return };
        state.is_opening = false;
        let endpoints: Vec<_> = state.endpoints.values().filter_map(Weak::upgrade).collect();
        drop(state);
        {
            let mut discovery = lock(&self.discovery);
            discovery.is_closed = true;
            let known = discovery.endpoints.values().cloned().collect::<Vec<_>>();
            discovery.rediscovery = Rediscovery::new(known, discovery.participants.clone());
        }
        let ending: Vec<_> = endpoints.iter().map(|endpoint| endpoint.close()).collect();
        drop(endpoints);
        // A reader ends after its handler, which may wait for a client. The network is opened again beside it.
        std::thread::spawn(move || drop(ending));
        if !network.close(max) {
            tracing::debug!("readers or writers of the gateway take long to end");
        }
    }

    /// Opens the network again, with the endpoints of the old one. May block.
    pub(crate) fn open_again(&self) -> Result<(), RosError> {
        let network = (self.open)()?;
        let (endpoints, generation) = {
            let mut state = self.lock();
            state.generation += 1;
            state.is_opening = true;
            state.network = Some(Arc::clone(&network));
            let endpoints: Vec<_> = state.endpoints.values().filter_map(Weak::upgrade).collect();
            (endpoints, state.generation)
        };
        {
            let mut discovery = lock(&self.discovery);
            discovery.generation = generation;
            discovery.is_closed = false;
            discovery.rediscovery.opened(Instant::now());
        }
        let fails = |endpoint: &Arc<dyn Endpoint>| endpoint.open(&*network).err();
        let failed: Vec<_> = endpoints.into_iter().filter(|endpoint| fails(endpoint).is_some()).collect();
        for endpoint in failed {
            // Once more, now that the others are open.
            if let Some(error) = fails(&endpoint) {
                tracing::warn!(%error, "an endpoint of the gateway could not be opened again");
            }
        }
        self.lock().is_opening = false;
        self.opened.notify_all();
        if lock(&self.discovery).handler.is_some() {
            self.discover_on(&*network, generation)?;
        }
        let nodes = self.lock().announced.clone();
        self.announce_on(&*network, &nodes)
    }

    /// Returns the time at which endpoints that the new network lacks count as gone.
    pub(crate) fn rediscovery_deadline(&self) -> Option<Instant> {
        lock(&self.discovery).rediscovery.deadline()
    }

    /// Reports endpoints that the new network lacks as gone.
    pub(crate) fn rediscovery_due(&self, now: Instant) {
        let mut discovery = lock(&self.discovery);
        for event in discovery.rediscovery.handle_timeout(now) {
            discovery.tell(event);
        }
    }

    fn discover_on(&self, network: &dyn LocalRos, generation: u64) -> Result<(), RosError> {
        let discovery = Arc::clone(&self.discovery);
        network.discover(Box::new(move |event| lock(&discovery).handle(generation, event)))
    }

    fn announce_on(&self, network: &dyn LocalRos, nodes: &[GraphNode]) -> Result<(), RosError> {
        let endpoints: Vec<_> = self.lock().endpoints.values().filter_map(Weak::upgrade).collect();
        let present: BTreeMap<_, _> = endpoints.iter().flat_map(|endpoint| endpoint.guids()).collect();
        let now = |guids: &[Guid]| guids.iter().map(|guid| *present.get(guid).unwrap_or(guid)).collect();
        let nodes: Vec<_> = nodes
            .iter()
            .map(|node| GraphNode {
                node: node.node.clone(),
                readers: now(&node.readers),
                writers: now(&node.writers),
            })
            .collect();
        network.announce(&nodes)
    }
}

/// The handle by which the hub holds the network.
pub(crate) struct HubNetwork(pub(crate) Arc<GatewayNetwork>);

impl LocalRos for HubNetwork {
    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        let (network, generation) = self.0.present()?;
        {
            let mut discovery = lock(&self.0.discovery);
            discovery.handler = Some(handler);
            discovery.generation = generation;
        }
        self.0.discover_on(&*network, generation)
    }

    fn reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<LocalReader, RosError> {
        let handler = SharedSamples::new(handler);
        let reader = Reader { spec: spec.clone(), handler, present: Mutex::default() };
        let registered = self.0.register(reader)?;
        let guid = registered.endpoint.first();
        Ok(LocalReader::new(guid, ReaderHandle(registered)))
    }

    fn writer(&self, spec: &EndpointSpec) -> Result<Box<dyn RosWriter>, RosError> {
        let kept_max = match &spec.qos.history {
            _ if !spec.qos.is_transient_local() => 0,
            History::KeepLast(depth) if spec.keyless => (*depth as usize).clamp(1, KEPT_MAX),
            _ => KEPT_MAX,
        };
        let present = Mutex::default();
        let writer = Writer { spec: spec.clone(), kept_max, kept: Mutex::default(), present };
        Ok(Box::new(WriterHandle(self.0.register(writer)?)))
    }

    fn client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosClient>, RosError> {
        let handler = Arc::new(Mutex::new(handler));
        let client = Client { spec: spec.clone(), handler, present: Mutex::default() };
        Ok(Box::new(ClientHandle(self.0.register(client)?)))
    }

    fn server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Box<dyn RosServer>, RosError> {
        let handler = Arc::new(Mutex::new(handler));
        let server = Server { spec: spec.clone(), handler, present: Mutex::default() };
        Ok(Box::new(ServerHandle(self.0.register(server)?)))
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        let network = {
            let mut state = self.0.lock();
            nodes.clone_into(&mut state.announced);
            state.network.clone()
        };
        network.map_or(Ok(()), |network| self.0.announce_on(&*network, nodes))
    }

    fn reach(&self) -> Reach {
        let network = self.0.lock().network.clone();
        network.map_or(Reach::Whole, |network| network.reach())
    }

    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        let network = self.0.lock().network.clone();
        network.map_or(Ok(false), |network| network.gains_by_reopening())
    }

    fn close(self: Arc<Self>, max: Duration) -> bool {
        self.0.close_for_now(max);
        true
    }
}

/// The entity of an endpoint, and the GUIDs that the hub knows.
struct Present<T, const N: usize> {
    entity: Option<T>,
    first: Option<[Guid; N]>,
    now: [Guid; N],
}

impl<T, const N: usize> Default for Present<T, N> {
    fn default() -> Self {
        Self { entity: None, first: None, now: [Guid([0; 16]); N] }
    }
}

impl<T, const N: usize> Present<T, N> {
    fn set(&mut self, entity: T, guids: [Guid; N]) {
        self.entity = Some(entity);
        self.first.get_or_insert(guids);
        self.now = guids;
    }

    /// Returns the GUIDs by which the hub knows the endpoint.
    fn first(&self) -> [Guid; N] {
        self.first.unwrap_or(self.now)
    }

    fn guids(&self) -> Vec<(Guid, Guid)> {
        self.first().into_iter().zip(self.now).collect()
    }
}

struct Reader {
    spec: EndpointSpec,
    /// The next reader has it as well.
    handler: SharedSamples,
    present: Mutex<Present<LocalReader, 1>>,
}

impl Reader {
    fn first(&self) -> Guid {
        let [guid] = lock(&self.present).first();
        guid
    }
}

impl Endpoint for Reader {
    fn close(&self) -> Box<dyn Any + Send> {
        Box::new(lock(&self.present).entity.take())
    }

    fn open(&self, network: &dyn LocalRos) -> Result<(), RosError> {
        let reader = network.reader(&self.spec, Box::new(self.handler.clone()))?;
        let guid = reader.guid();
        lock(&self.present).set(reader, [guid]);
        Ok(())
    }

    fn guids(&self) -> Vec<(Guid, Guid)> {
        lock(&self.present).guids()
    }
}

/// A reader of the hub. The entity ends with it, also if it is being opened again.
struct ReaderHandle(Registered<Reader>);

impl Drop for ReaderHandle {
    fn drop(&mut self) {
        drop(self.0.endpoint.close());
    }
}

/// The messages that a transient-local writer keeps for late joiners.
#[derive(Default)]
struct Kept {
    messages: VecDeque<(SampleHead, Bytes)>,
    bytes: usize,
}

struct Writer {
    spec: EndpointSpec,
    kept_max: usize,
    /// Locked while messages are written again, which keeps their order.
    kept: Mutex<Kept>,
    present: Mutex<Present<Arc<dyn RosWriter>, 1>>,
}

impl Writer {
    fn present(&self) -> Option<Arc<dyn RosWriter>> {
        lock(&self.present).entity.clone()
    }

    /// Keeps a message. Returns the writer that it has to be given to, unless it is written with all that is kept.
    fn keep(&self, head: SampleHead, payload: &Bytes) -> Option<Arc<dyn RosWriter>> {
        let mut kept = lock(&self.kept);
        kept.bytes += payload.len();
        kept.messages.push_back((head, payload.clone()));
        while kept.messages.len() > self.kept_max || kept.bytes > KEPT_BYTES_MAX && kept.messages.len() > 1 {
            kept.bytes -= kept.messages.pop_front().map_or(0, |(_, payload)| payload.len());
        }
        self.present()
    }

    /// Forgets a message that was not written, since its publisher is told so.
    fn forget(&self, payload: &Bytes) {
        let mut kept = lock(&self.kept);
        let is_it = |(_, kept): &(SampleHead, Bytes)| kept.as_ptr() == payload.as_ptr();
        if let Some(at) = kept.messages.iter().rposition(is_it) {
            kept.messages.remove(at);
            kept.bytes -= payload.len();
        }
    }
}

impl Endpoint for Writer {
    fn close(&self) -> Box<dyn Any + Send> {
        Box::new(lock(&self.present).entity.take())
    }

    fn open(&self, network: &dyn LocalRos) -> Result<(), RosError> {
        let writer: Arc<dyn RosWriter> = Arc::from(network.writer(&self.spec)?);
        let guid = writer.guid();
        // New messages wait for the lock, so they are written after the kept ones.
        let kept = lock(&self.kept);
        lock(&self.present).set(Arc::clone(&writer), [guid]);
        let written = kept.messages.iter().map(|(head, payload)| writer.write_ahead(*head, payload.clone()));
        if let Some(error) = written.filter_map(Result::err).last() {
            tracing::warn!(%error, topic = self.spec.topic, "messages for late subscribers were not written again");
        }
        writer.flush();
        Ok(())
    }

    fn guids(&self) -> Vec<(Guid, Guid)> {
        lock(&self.present).guids()
    }
}

struct WriterHandle(Registered<Writer>);

impl RosWriter for WriterHandle {
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError> {
        let writer = &self.0.endpoint;
        if writer.kept_max > 0 {
            let Some(present) = writer.keep(head, &payload) else { return Ok(()) };
            let written = present.write_ahead(head, payload.clone());
            if written.is_err() {
                writer.forget(&payload);
            }
            return written;
        }
        writer.present().ok_or(RosError::Closed)?.write_ahead(head, payload)
    }

    fn flush(&self) {
        if let Some(present) = self.0.endpoint.present() {
            present.flush();
        }
    }

    fn assert_liveliness(&self) {
        if let Some(present) = self.0.endpoint.present() {
            present.assert_liveliness();
        }
    }

    fn kept(&self, bytes: usize) -> Option<u32> {
        self.0.endpoint.present().and_then(|present| present.kept(bytes))
    }

    fn wait_acknowledged(&self, max: Duration) -> bool {
        self.0.endpoint.present().is_none_or(|present| present.wait_acknowledged(max))
    }

    fn matched_readers(&self) -> u32 {
        self.0.endpoint.present().map_or(0, |present| present.matched_readers())
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        match self.0.endpoint.present() {
            Some(present) => present.wait_matched(readers, max),
            None => {
                std::thread::sleep(max);
                0
            }
        }
    }

    fn guid(&self) -> Guid {
        let [guid] = lock(&self.0.endpoint.present).first();
        guid
    }
}

impl Drop for WriterHandle {
    fn drop(&mut self) {
        drop(self.0.endpoint.close());
    }
}

/// The handler of requests or replies, which the next server or client has as well.
struct SharedCalls(Arc<Mutex<RequestHandler>>);

impl HandleCalls for SharedCalls {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        lock(&self.0).handle(id, payload);
    }

    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        lock(&self.0).unhandled(why, messages);
    }
}

struct Client {
    spec: ServiceSpec,
    handler: Arc<Mutex<RequestHandler>>,
    present: Mutex<Present<Arc<dyn RosClient>, 2>>,
}

impl Endpoint for Client {
    fn close(&self) -> Box<dyn Any + Send> {
        let client = lock(&self.present).entity.take();
        lock(&self.handler).network_closed();
        Box::new(client)
    }

    fn open(&self, network: &dyn LocalRos) -> Result<(), RosError> {
        let handler = Box::new(SharedCalls(Arc::clone(&self.handler)));
        let client: Arc<dyn RosClient> = Arc::from(network.client(&self.spec, handler)?);
        let guids = client.guids();
        lock(&self.present).set(client, guids);
        Ok(())
    }

    fn guids(&self) -> Vec<(Guid, Guid)> {
        lock(&self.present).guids()
    }
}

struct ClientHandle(Registered<Client>);

impl RosClient for ClientHandle {
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError> {
        let present = || lock(&self.0.endpoint.present).entity.clone();
        if present().is_none()
            && let Some(network) = self.0.network.upgrade()
        {
            network.present()?;
        }
        let client = present().ok_or(RosError::Closed)?;
        let sent = client.send(payload)?;
        // The reply to a client that ended meanwhile reaches nobody.
        match present() {
            Some(now) if Arc::ptr_eq(&now, &client) => Ok(sent),
            _ => Err(RosError::Closed),
        }
    }

    fn servers(&self) -> BTreeSet<Guid> {
        lock(&self.0.endpoint.present).entity.clone().map_or_else(BTreeSet::new, |client| client.servers())
    }

    fn guids(&self) -> [Guid; 2] {
        lock(&self.0.endpoint.present).first()
    }
}

impl Drop for ClientHandle {
    fn drop(&mut self) {
        drop(self.0.endpoint.close());
    }
}

struct Server {
    spec: ServiceSpec,
    handler: Arc<Mutex<RequestHandler>>,
    present: Mutex<Present<Arc<dyn RosServer>, 2>>,
}

impl Endpoint for Server {
    fn close(&self) -> Box<dyn Any + Send> {
        Box::new(lock(&self.present).entity.take())
    }

    fn open(&self, network: &dyn LocalRos) -> Result<(), RosError> {
        let handler = Box::new(SharedCalls(Arc::clone(&self.handler)));
        let server: Arc<dyn RosServer> = Arc::from(network.server(&self.spec, handler)?);
        let guids = server.guids();
        lock(&self.present).set(server, guids);
        Ok(())
    }

    fn guids(&self) -> Vec<(Guid, Guid)> {
        lock(&self.present).guids()
    }
}

struct ServerHandle(Registered<Server>);

impl RosServer for ServerHandle {
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError> {
        let present = || lock(&self.0.endpoint.present).entity.clone();
        if present().is_none()
            && let Some(network) = self.0.network.upgrade()
        {
            network.present()?;
        }
        // The client knows the new server by the same service, and takes its reply.
        present().ok_or(RosError::Closed)?.reply(request, payload)
    }

    fn guids(&self) -> [Guid; 2] {
        lock(&self.0.endpoint.present).first()
    }
}

impl Drop for ServerHandle {
    fn drop(&mut self) {
        drop(self.0.endpoint.close());
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use std::sync::mpsc;

    use sgc_gateway::{
        Advertise, Client as HubClient, Content, Form, GatewayError, Hub, HubOptions, Session, SessionLimits,
        ShippedDefinitions, Subscribe, Types,
    };
    use sgc_ros::{REDISCOVERY_HOLD, RosNetwork, Sample, SampleKind, dds_topic, dds_type};
    use sgc_testkit::{FakeDomain, FakeRos};
    use sgc_wire::{Durability, Qos};

    use super::*;

    const CLOSE: Duration = Duration::from_secs(1);
    const PATIENCE: Duration = Duration::from_secs(10);
    const STRING: &str = "std_msgs/msg/String";

    fn spec(topic: &str, qos: Qos) -> EndpointSpec {
        EndpointSpec {
            topic: dds_topic(topic),
            type_name: dds_type(STRING),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos,
        }
    }

    fn string(text: &str) -> Bytes {
        let mut payload = vec![0, 1, 0, 0];
        payload.extend((text.len() as u32 + 1).to_le_bytes());
        payload.extend(text.as_bytes());
        payload.push(0);
        payload.into()
    }

    async fn eventually(mut is_so: impl FnMut() -> bool) {
        let looked = async {
            while !is_so() {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::time::timeout(PATIENCE, looked).await.expect("it should have become so by now");
    }

    /// A hub on a network that can be opened again, and another program.
    struct Site {
        network: Arc<GatewayNetwork>,
        hub: Hub,
        ros: FakeRos,
        domain: FakeDomain,
    }

    impl Site {
        async fn new() -> Self {
            let domain = FakeDomain::default();
            let joins = domain.clone();
            let open: OpenLocalRos = Arc::new(move || Ok(Arc::new(joins.join(false)) as Arc<dyn LocalRos>));
            let network = GatewayNetwork::open(open).unwrap();
            let ros = Arc::new(HubNetwork(Arc::clone(&network)));
            let hub = Hub::start(ros, Types::new(ShippedDefinitions), HubOptions::default()).await.unwrap();
            Self { network, hub, ros: domain.join(false), domain }
        }

        fn session(&self) -> Session {
            Session::new(&self.hub, HubClient::own("client"), SessionLimits::default())
        }

        async fn blocking<T: Send + 'static>(
            &self,
            work: impl FnOnce(&GatewayNetwork) -> T + Send + 'static,
        ) -> T {
            let network = Arc::clone(&self.network);
            tokio::task::spawn_blocking(move || work(&network)).await.unwrap()
        }

        async fn close(&self) {
            self.blocking(|network| network.close_for_now(CLOSE)).await;
        }

        async fn open_again(&self) {
            self.blocking(GatewayNetwork::open_again).await.unwrap();
        }

        fn publishers(&self, topic: &str) -> usize {
            self.hub.graph().topics.get(topic).map_or(0, |info| info.publishers.len())
        }
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn topics_of_clients_go_on_when_the_network_is_opened_again() {
        let site = Site::new().await;
        let session = site.session();
        let talker = site.ros.create_writer(&spec("/chatter", Qos::default())).unwrap();
        let gone = site.ros.create_writer(&spec("/gone", Qos::default())).unwrap();
        eventually(|| site.publishers("/chatter") == 1 && site.publishers("/gone") == 1).await;
        let wanted = Subscribe { topic: "/chatter".into(), depth: 10, ..Subscribe::default() };
        let mut heard = session.subscribe(wanted).await.unwrap();
        let advertise =
            |topic: &str, qos| Advertise { topic: topic.into(), type_name: Some(STRING.into()), qos };
        let command = session.advertise(advertise("/command", Qos::default())).await.unwrap();
        let latched = Qos { durability: Durability::TransientLocal, ..Qos::default() };
        let map = session.advertise(advertise("/map", latched.clone())).await.unwrap();
        map.publish(&Content::cdr(string("before"))).await.unwrap();
        let (send, commands) = mpsc::channel();
        let handler = Box::new(move |sample: Sample| drop(send.send(sample.payload)));
        let _reader = site.ros.create_reader(&spec("/command", Qos::default()), handler).unwrap();

        site.close().await;
        eventually(|| talker.matched_readers() == 0).await;
        // Nobody hears this, which is no error of the client.
        command.publish(&Content::cdr(string("into the dark"))).await.unwrap();
        map.publish(&Content::cdr(string("meanwhile"))).await.unwrap();
        drop(gone);
        site.open_again().await;

        talker.write(SampleKind::Write, 1, string("hello")).unwrap();
        assert_eq!(heard.next().await.unwrap().message.payload, string("hello"));
        command.publish(&Content::cdr(string("go on"))).await.unwrap();
        assert_eq!(commands.recv_timeout(PATIENCE).unwrap(), string("go on"));
        let (send, maps) = mpsc::channel();
        let handler = Box::new(move |sample: Sample| drop(send.send(sample.payload)));
        let _late = site.ros.create_reader(&spec("/map", latched), handler).unwrap();
        let kept = [maps.recv_timeout(PATIENCE).unwrap(), maps.recv_timeout(PATIENCE).unwrap()];
        assert_eq!(kept, [string("before"), string("meanwhile")]);

        // Endpoints that were found again were never gone; the others are gone after a while.
        assert_eq!((site.publishers("/chatter"), site.publishers("/gone")), (1, 1));
        site.network.rediscovery_due(Instant::now() + REDISCOVERY_HOLD);
        assert_eq!((site.publishers("/chatter"), site.publishers("/gone")), (1, 0));
        assert_eq!(site.domain.count("rt/command", sgc_ros::EndpointKind::Writer), 1);

        drop((heard, command, map));
        let left = |topic, kind| site.domain.count(topic, kind);
        eventually(|| left("rt/command", sgc_ros::EndpointKind::Writer) == 0).await;
        eventually(|| left("rt/chatter", sgc_ros::EndpointKind::Reader) == 0).await;
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn calls_in_flight_end_with_a_reason_and_later_ones_are_answered() {
        let site = Site::new().await;
        let (server, caller) = (site.session(), Arc::new(site.session()));
        let mut serving = server.serve("/switch", Some("std_srvs/srv/SetBool")).await.unwrap();
        let call = || {
            let caller = Arc::clone(&caller);
            tokio::spawn(async move {
                let request = Content::json(r#"{"data":true}"#);
                caller.call("/switch", None, &request, Form::Json, PATIENCE).await
            })
        };
        let reply = Content::json(r#"{"success":true,"message":"on"}"#);
        let in_flight = call();
        let asked = serving.next().await.unwrap();
        site.close().await;
        let ended = in_flight.await.unwrap();
        assert_eq!(ended, Err(GatewayError::CutOff { name: "/switch".into() }));
        // A call waits for the network.
        let waiting = call();
        tokio::time::sleep(Duration::from_millis(50)).await;
        site.open_again().await;
        let _ = serving.replier().reply(asked.id, &reply).await;
        let asked = serving.next().await.unwrap();
        serving.replier().reply(asked.id, &reply).await.unwrap();
        assert_eq!(waiting.await.unwrap().unwrap(), r#"{"success":true,"message":"on"}"#);
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 2)]
    async fn an_endpoint_that_is_created_while_the_network_is_closed_is_on_the_next_one() {
        let site = Site::new().await;
        site.close().await;
        let session = Arc::new(site.session());
        let opening = tokio::spawn(async move {
            let wanted =
                Advertise { topic: "/late".into(), type_name: Some(STRING.into()), qos: Qos::default() };
            session.advertise(wanted).await
        });
        tokio::time::sleep(Duration::from_millis(50)).await;
        assert!(!opening.is_finished());
        site.open_again().await;
        let _publication = opening.await.unwrap().unwrap();
        assert_eq!(site.domain.count("rt/late", sgc_ros::EndpointKind::Writer), 1);
    }
}
