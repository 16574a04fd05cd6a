//! A local ROS 2 network in memory: [`FakeRos`] implements [`sgc_ros::RosNetwork`].
//!
//! A domain is a value on which networks are opened. Networks of one domain see each other. Samples are delivered on
//! the writer's thread. Matching honours topic, type, keylessness, reliability and durability. It has no depth of
//! volatile history, no loss, no partitions and no delays.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use bytes::{BufMut, Bytes, BytesMut};
use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid, Reach,
    RequestHandler, RequestId, RosClient, RosError, RosNetwork, RosServer, RosWriter, Sample, SampleHandler,
    SampleHead, SampleKind, SentRequest, ServiceSpec, ShownEndpoint,
};
use sgc_sync::lock;
use sgc_wire::{History, Qos};

/// Number of times that a request looks for its server before it fails.
const PEER_LOOKS: u64 = 100;
const PEER_LOOK_MS: u64 = 10;
/// Bytes of the encapsulation header, which client, number and body follow.
const HEADER_BYTES: usize = 4;
const ID_BYTES: usize = 24;

/// A domain. Clones let several networks meet.
#[derive(Clone, Default)]
pub struct FakeDomain(Arc<Mutex<DomainState>>);

#[derive(Default)]
struct DomainState {
    next: u32,
    endpoints: BTreeMap<Guid, Endpoint>,
    /// The nodes that each network announces, and whether it is a proxy.
    nodes: BTreeMap<u32, (bool, Vec<GraphNode>)>,
    watchers: Vec<Watcher>,
    /// Topics and payloads whose next write fails.
    refused: Vec<(String, Bytes)>,
    /// Networks up to this number do not reach other hosts.
    cut_off: u32,
}

struct Endpoint {
    discovered: DiscoveredEndpoint,
    /// A proxy made it, so it is invisible to proxies.
    tagged: bool,
    network: u32,
    reader: Option<Arc<Mutex<SampleHandler>>>,
    history: VecDeque<Sample>,
}

impl Endpoint {
    /// Returns `true` if a reader of such a network hears this writer. No proxy hears a proxy, itself included.
    fn reaches(&self, tagged: bool) -> bool {
        !(self.tagged && tagged)
    }
}

struct Watcher {
    network: u32,
    tagged: bool,
    handler: Arc<Mutex<DiscoveryHandler>>,
}

/// One participant of a domain.
pub struct FakeRos {
    domain: FakeDomain,
    network: u32,
    tagged: bool,
}

/// A reader, which ends when it is dropped.
pub struct FakeReader {
    domain: FakeDomain,
    guid: Guid,
}

impl FakeReader {
    /// Returns its GUID.
    pub fn guid(&self) -> Guid {
        self.guid
    }
}

/// A writer, which ends when it is dropped.
pub struct FakeWriter {
    domain: FakeDomain,
    guid: Guid,
}

/// A client, which ends when it is dropped.
pub struct FakeClient {
    requests: FakeWriter,
    answers: FakeReader,
    client: [u8; 16],
    next: AtomicI64,
}

/// A server, which ends when it is dropped.
pub struct FakeServer {
    replies: FakeWriter,
    asked: FakeReader,
}

impl FakeDomain {
    /// Joins the domain. A tagged participant is a proxy, whose endpoints other proxies do not see.
    pub fn join(&self, tagged: bool) -> FakeRos {
        let mut state = self.lock();
        state.next += 1;
        FakeRos { domain: self.clone(), network: state.next, tagged }
    }

    /// Returns the number of endpoints of a kind on a topic.
    pub fn count(&self, topic: &str, kind: EndpointKind) -> usize {
        self.lock()
            .endpoints
            .values()
            .filter(|e| e.discovered.topic == topic && e.discovered.kind == kind)
            .count()
    }

    /// Returns the GUIDs of endpoints of a kind on a topic, which tell old from new ones.
    pub fn guids(&self, topic: &str, kind: EndpointKind) -> Vec<Guid> {
        let state = self.lock();
        let wanted = |e: &&Endpoint| e.discovered.topic == topic && e.discovered.kind == kind;
        state.endpoints.values().filter(wanted).map(|e| e.discovered.guid).collect()
    }

    /// Lets the next write of a payload on a topic fail, as if a reader did not acknowledge earlier samples.
    pub fn refuse_write(&self, topic: &str, payload: Bytes) {
        self.lock().refused.push((topic.to_owned(), payload));
    }

    /// Reports to the networks that have joined so far that they do not reach other hosts.
    pub fn cut_off(&self) {
        let mut state = self.lock();
        state.cut_off = state.next;
    }

    /// Returns the QoS that the writers on a topic offer.
    pub fn offers(&self, topic: &str) -> Vec<Qos> {
        let state = self.lock();
        let all = state.endpoints.values().map(|e| &e.discovered);
        let writers = all.filter(|e| e.topic == topic && e.kind == EndpointKind::Writer);
        writers.map(|e| e.qos.clone()).collect()
    }

    /// Returns the nodes that proxies announce, by full name, with their numbers of readers and writers.
    pub fn mirrored(&self) -> Vec<(String, usize, usize)> {
        let state = self.lock();
        let here = |all: &[Guid]| all.iter().filter(|guid| state.endpoints.contains_key(guid)).count();
        let nodes = state.nodes.values().filter(|(tagged, _)| *tagged).flat_map(|(_, nodes)| nodes);
        let mut all: Vec<_> =
            nodes.map(|n| (n.node.to_string(), here(&n.readers), here(&n.writers))).collect();
        all.sort();
        all
    }

    fn lock(&self) -> MutexGuard<'_, DomainState> {
        lock(&self.0)
    }

    fn add(&self, network: &FakeRos, spec: &EndpointSpec, reader: Option<SampleHandler>) -> Guid {
        let reader = reader.map(|r| Arc::new(Mutex::new(r)));
        // Locked until the reader has the history, so that samples written meanwhile follow it and keep their order.
        let handler = reader.as_ref().map(|r| lock(r));
        let (guid, watchers, missed) = {
            let mut state = self.lock();
            state.next += 1;
            let kind = if reader.is_some() { EndpointKind::Reader } else { EndpointKind::Writer };
            let mut guid = [0; 16];
            // The prefix identifies the participant.
            guid[..4].copy_from_slice(&network.network.to_be_bytes());
            guid[11..15].copy_from_slice(&state.next.to_be_bytes());
            guid[11] = 0;
            guid[15] = if kind == EndpointKind::Reader { 4 } else { 3 };
            let discovered = DiscoveredEndpoint {
                kind,
                guid: Guid(guid),
                topic: spec.topic.clone(),
                type_name: spec.type_name.clone(),
                keyless: spec.keyless,
                type_hash: spec.type_hash.clone(),
                qos: spec.qos.clone(),
            };
            let missed: Vec<_> = state
                .endpoints
                .values()
                .filter(|w| {
                    reader.is_some() && discovered.qos.is_transient_local() && w.reaches(network.tagged)
                })
                .filter(|w| matches(&w.discovered, &discovered))
                .flat_map(|w| w.history.iter().cloned())
                .collect();
            let endpoint = Endpoint {
                discovered: discovered.clone(),
                tagged: network.tagged,
                network: network.network,
                reader: reader.clone(),
                history: VecDeque::new(),
            };
            state.endpoints.insert(Guid(guid), endpoint);
            (Guid(guid), state.watchers_of(network.network, network.tagged), missed)
        };
        if let Some(mut handler) = handler {
            let last = missed.len().saturating_sub(1);
            for (n, sample) in missed.into_iter().enumerate() {
                handler.handle(Sample { more: n < last, ..sample });
            }
        }
        for watcher in watchers {
            let state = self.lock();
            let Some(endpoint) = state.endpoints.get(&guid).map(|e| e.discovered.clone()) else { break };
            drop(state);
            (lock(&watcher))(DiscoveryEvent::Appeared(endpoint));
        }
        guid
    }

    fn announce(&self, network: u32, tagged: bool, nodes: Vec<GraphNode>) {
        let watchers = {
            let mut state = self.lock();
            let gone = nodes.is_empty() && state.nodes.remove(&network).is_none();
            if gone {
                return;
            }
            if !nodes.is_empty() {
                state.nodes.insert(network, (tagged, nodes.clone()));
            }
            state.watchers_of(network, tagged)
        };
        for watcher in watchers {
            let (participant, nodes) = (participant(network), nodes.clone());
            let event = DiscoveryEvent::Nodes { participant, nodes };
            (lock(&watcher))(event);
        }
    }

    fn remove(&self, guid: Guid) {
        let watchers = {
            let mut state = self.lock();
            let Some(endpoint) = state.endpoints.remove(&guid) else { return };
            state.watchers_of(endpoint.network, endpoint.tagged)
        };
        for watcher in watchers {
            (lock(&watcher))(DiscoveryEvent::Vanished { guid });
        }
    }
}

impl DomainState {
    /// Returns the discovery handlers that see an endpoint of `network`.
    fn watchers_of(&self, network: u32, tagged: bool) -> Vec<Arc<Mutex<DiscoveryHandler>>> {
        self.watchers
            .iter()
            .filter(|w| w.network != network && !(w.tagged && tagged))
            .map(|w| w.handler.clone())
            .collect()
    }
}

impl RosNetwork for FakeRos {
    type Reader = FakeReader;
    type Writer = FakeWriter;
    type Client = FakeClient;
    type Server = FakeServer;

    fn discover(&self, mut handler: DiscoveryHandler) -> Result<(), RosError> {
        let mut state = self.domain.lock();
        for endpoint in state.endpoints.values() {
            if endpoint.network != self.network && !(endpoint.tagged && self.tagged) {
                handler(DiscoveryEvent::Appeared(endpoint.discovered.clone()));
            }
        }
        for (network, (tagged, nodes)) in &state.nodes {
            if *network != self.network && !(*tagged && self.tagged) {
                handler(DiscoveryEvent::Nodes { participant: participant(*network), nodes: nodes.clone() });
            }
        }
        let handler = Arc::new(Mutex::new(handler));
        state.watchers.push(Watcher { network: self.network, tagged: self.tagged, handler });
        Ok(())
    }

    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<FakeReader, RosError> {
        let guid = self.domain.add(self, spec, Some(handler));
        Ok(FakeReader { domain: self.domain.clone(), guid })
    }

    fn create_writer(&self, spec: &EndpointSpec) -> Result<FakeWriter, RosError> {
        let guid = self.domain.add(self, spec, None);
        Ok(FakeWriter { domain: self.domain.clone(), guid })
    }

    fn create_client(&self, spec: &ServiceSpec, mut handler: RequestHandler) -> Result<FakeClient, RosError> {
        let requests = self.create_writer(&spec.request)?;
        let client = requests.guid.0;
        let replies = self.create_reader(
            &spec.reply,
            Box::new(move |sample: Sample| {
                if let Some((id, payload)) = split(&sample.payload, None)
                    && id.client == client
                {
                    handler.handle(id, payload);
                }
            }),
        )?;
        Ok(FakeClient { requests, answers: replies, client, next: AtomicI64::new(1) })
    }

    fn create_server(&self, spec: &ServiceSpec, mut handler: RequestHandler) -> Result<FakeServer, RosError> {
        let replies = self.create_writer(&spec.reply)?;
        let requests = self.create_reader(
            &spec.request,
            Box::new(move |sample: Sample| {
                if let Some((id, payload)) = split(&sample.payload, sample.writer) {
                    handler.handle(id, payload);
                }
            }),
        )?;
        Ok(FakeServer { replies, asked: requests })
    }

    fn reader_guid(&self, reader: &FakeReader) -> Guid {
        reader.guid
    }

    fn has_graph(&self) -> bool {
        true
    }

    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError> {
        // A topic that no other endpoint has.
        let spec = EndpointSpec { topic: format!("shown:{}", spec.topic), ..spec.clone() };
        Ok(match kind {
            EndpointKind::Reader => {
                let reader = self.create_reader(&spec, Box::new(|_: Sample| {}))?;
                ShownEndpoint::new(reader.guid, reader)
            }
            EndpointKind::Writer => {
                let writer = self.create_writer(&spec)?;
                ShownEndpoint::new(writer.guid, writer)
            }
        })
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        self.domain.announce(self.network, self.tagged, nodes.to_vec());
        Ok(())
    }

    fn reach(&self) -> Reach {
        if self.network <= self.domain.lock().cut_off { Reach::CutOff } else { Reach::Whole }
    }
}

impl RosClient for FakeClient {
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError> {
        let id = RequestId { client: self.client, number: self.next.fetch_add(1, Relaxed), asker: None };
        let servers = self.requests.write_with(&id, &payload)?;
        Ok(SentRequest { id, servers })
    }

    fn servers(&self) -> BTreeSet<Guid> {
        self.requests.readers()
    }

    fn guids(&self) -> [Guid; 2] {
        [self.answers.guid, self.requests.guid]
    }
}

impl RosServer for FakeServer {
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError> {
        self.replies.write_with(request, &payload).map(drop)
    }

    fn guids(&self) -> [Guid; 2] {
        [self.asked.guid, self.replies.guid]
    }
}

/// Returns the GUID of a network's participant.
fn participant(network: u32) -> Guid {
    let mut guid = [0; 16];
    guid[..4].copy_from_slice(&network.to_be_bytes());
    guid[12..].copy_from_slice(&[0, 0, 1, 0xc1]);
    Guid(guid)
}

/// Splits a request or a reply into id and payload.
fn split(sample: &Bytes, asker: Option<Guid>) -> Option<(RequestId, Bytes)> {
    let id = sample.get(HEADER_BYTES..HEADER_BYTES + ID_BYTES)?;
    let (client, number) = (id[..16].try_into().ok()?, i64::from_be_bytes(id[16..].try_into().ok()?));
    let mut payload = BytesMut::from(&sample[..HEADER_BYTES]);
    payload.put_slice(&sample[HEADER_BYTES + ID_BYTES..]);
    Some((RequestId { client, number, asker }, payload.freeze()))
}

impl Drop for FakeRos {
    fn drop(&mut self) {
        self.domain.lock().watchers.retain(|w| w.network != self.network);
        self.domain.announce(self.network, self.tagged, Vec::new());
    }
}

impl Drop for FakeReader {
    fn drop(&mut self) {
        self.domain.remove(self.guid);
    }
}

impl Drop for FakeWriter {
    fn drop(&mut self) {
        self.domain.remove(self.guid);
    }
}

impl FakeWriter {
    /// Writes several samples at once, so that readers find them together, as on a real network under load.
    pub fn write_burst(&self, payloads: impl IntoIterator<Item = Bytes>) {
        let mut payloads = payloads.into_iter().peekable();
        while let Some(payload) = payloads.next() {
            self.give(SampleHead::new(SampleKind::Write, 1), payload, payloads.peek().is_some());
        }
    }

    fn readers(&self) -> BTreeSet<Guid> {
        let state = self.domain.lock();
        let Some(writer) = state.endpoints.get(&self.guid) else { return BTreeSet::new() };
        let matched = state
            .endpoints
            .values()
            .filter(|r| writer.reaches(r.tagged))
            .filter(|r| r.reader.is_some() && matches(&writer.discovered, &r.discovered));
        matched.map(|r| r.discovered.guid).collect()
    }

    /// Writes a request or a reply once a reader is there. Returns the readers that got it.
    fn write_with(&self, id: &RequestId, payload: &Bytes) -> Result<BTreeSet<Guid>, RosError> {
        let Some((header, body)) = payload.split_first_chunk::<HEADER_BYTES>() else {
            return Err(RosError::Payload { bytes: payload.len() });
        };
        let mut sample = BytesMut::from(&header[..]);
        sample.put_slice(&id.client);
        sample.put_i64(id.number);
        sample.put_slice(body);
        for _ in 0..PEER_LOOKS {
            if self.matched_readers() > 0 {
                return Ok(self.give(SampleHead::new(SampleKind::Write, 1), sample.freeze(), false));
            }
            std::thread::sleep(Duration::from_millis(PEER_LOOK_MS));
        }
        Err(RosError::NoPeer { waited_ms: PEER_LOOKS * PEER_LOOK_MS })
    }

    /// Gives a sample to the readers that match now, and returns them.
    fn give(&self, head: SampleHead, payload: Bytes, more: bool) -> BTreeSet<Guid> {
        let SampleHead { kind, source_timestamp_ns, key_hash } = head;
        let sample = Sample { kind, writer: Some(self.guid), source_timestamp_ns, key_hash, payload, more };
        let readers: Vec<_> = {
            let mut state = self.domain.lock();
            let Some(writer) = state.endpoints.get_mut(&self.guid) else { return BTreeSet::new() };
            if writer.discovered.qos.is_transient_local() {
                writer.history.push_back(sample.clone());
                if let History::KeepLast(depth) = writer.discovered.qos.history
                    && writer.history.len() > depth as usize
                {
                    writer.history.pop_front();
                }
            }
            let writer = &state.endpoints[&self.guid];
            state
                .endpoints
                .values()
                .filter(|r| writer.reaches(r.tagged) && matches(&writer.discovered, &r.discovered))
                .filter_map(|r| Some((r.discovered.guid, r.reader.clone()?)))
                .collect()
        };
        for (_, reader) in &readers {
            let mut reader = lock(reader);
            if let Some(sample) = reader.handle_at_once(sample.clone()) {
                reader.handle(sample);
            }
        }
        readers.into_iter().map(|(guid, _)| guid).collect()
    }
}

impl RosWriter for FakeWriter {
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError> {
        {
            let mut state = self.domain.lock();
            let topic = state.endpoints.get(&self.guid).map(|writer| writer.discovered.topic.clone());
            let is_it =
                |(refused, what): &(String, Bytes)| topic.as_ref() == Some(refused) && *what == payload;
            if let Some(index) = state.refused.iter().position(is_it) {
                state.refused.remove(index);
                return Err(RosError::WriteTimeout { waited_ms: 0 });
            }
        }
        self.give(head, payload, false);
        Ok(())
    }

    fn matched_readers(&self) -> u32 {
        self.readers().len() as u32
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        let until = Instant::now() + max;
        while self.matched_readers() < readers && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(1));
        }
        self.matched_readers()
    }

    fn guid(&self) -> Guid {
        self.guid
    }
}

fn matches(writer: &DiscoveredEndpoint, reader: &DiscoveredEndpoint) -> bool {
    (writer.kind, reader.kind) == (EndpointKind::Writer, EndpointKind::Reader)
        && (&writer.topic, &writer.type_name, writer.keyless)
            == (&reader.topic, &reader.type_name, reader.keyless)
        && writer.qos.reliability >= reader.qos.reliability
        && writer.qos.durability >= reader.qos.durability
}
