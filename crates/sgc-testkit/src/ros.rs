//! A local ROS 2 network in memory: [`FakeRos`] implements [`sgc_ros::RosNetwork`].
//!
//! Domains are values that networks are opened on; networks on one domain see each other. Samples are delivered on
//! the thread of whoever writes. Matching honours topic, type, keylessness, reliability and durability; what it does
//! not do: depth of volatile history, loss, partitions, or anything that takes time.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use bytes::Bytes;
use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, DiscoveryHandler, EndpointKind, EndpointSpec, Guid, RosError,
    RosNetwork, RosWriter, Sample, SampleHandler, SampleKind,
};
use sgc_wire::History;

/// A domain: clone it to let several networks meet.
#[derive(Clone, Default)]
pub struct FakeDomain(Arc<Mutex<DomainState>>);

#[derive(Default)]
struct DomainState {
    next: u32,
    endpoints: BTreeMap<Guid, Endpoint>,
    watchers: Vec<Watcher>,
}

struct Endpoint {
    discovered: DiscoveredEndpoint,
    /// True if a proxy made it: invisible to proxies.
    tagged: bool,
    network: u32,
    reader: Option<Arc<Mutex<SampleHandler>>>,
    history: VecDeque<Sample>,
}

impl Endpoint {
    /// True if a reader of that network hears this writer: not its own, and no proxy another proxy.
    fn reaches(&self, network: u32, tagged: bool) -> bool {
        self.network != network && !(self.tagged && tagged)
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

/// A reader; ends when dropped.
pub struct FakeReader {
    domain: FakeDomain,
    guid: Guid,
}

/// A writer; ends when dropped.
pub struct FakeWriter {
    domain: FakeDomain,
    guid: Guid,
}

impl FakeDomain {
    /// Joins; a tagged participant is a proxy, whose endpoints other proxies do not see.
    pub fn join(&self, tagged: bool) -> FakeRos {
        let mut state = self.lock();
        state.next += 1;
        FakeRos { domain: self.clone(), network: state.next, tagged }
    }

    /// How many endpoints there are on a topic, by kind.
    pub fn count(&self, topic: &str, kind: EndpointKind) -> usize {
        self.lock()
            .endpoints
            .values()
            .filter(|e| e.discovered.topic == topic && e.discovered.kind == kind)
            .count()
    }

    fn lock(&self) -> MutexGuard<'_, DomainState> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn add(&self, network: &FakeRos, spec: &EndpointSpec, reader: Option<SampleHandler>) -> Guid {
        let (guid, watchers, reader, missed) = {
            let mut state = self.lock();
            state.next += 1;
            let kind = if reader.is_some() { EndpointKind::Reader } else { EndpointKind::Writer };
            let mut guid = [0; 16];
            guid[..4].copy_from_slice(&state.next.to_be_bytes());
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
            let reader = reader.map(|r| Arc::new(Mutex::new(r)));
            let missed: Vec<_> = state
                .endpoints
                .values()
                .filter(|w| reader.is_some() && w.reaches(network.network, network.tagged))
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
            (Guid(guid), state.watchers_of(network.network, network.tagged), reader, missed)
        };
        for watcher in watchers {
            let state = self.lock();
            let Some(endpoint) = state.endpoints.get(&guid).map(|e| e.discovered.clone()) else { break };
            drop(state);
            (watcher.lock().unwrap_or_else(PoisonError::into_inner))(DiscoveryEvent::Appeared(endpoint));
        }
        if let Some(reader) = reader {
            let mut handler = reader.lock().unwrap_or_else(PoisonError::into_inner);
            let last = missed.len().saturating_sub(1);
            for (n, sample) in missed.into_iter().enumerate() {
                handler(Sample { more: n < last, ..sample });
            }
        }
        guid
    }

    fn remove(&self, guid: Guid) {
        let watchers = {
            let mut state = self.lock();
            let Some(endpoint) = state.endpoints.remove(&guid) else { return };
            state.watchers_of(endpoint.network, endpoint.tagged)
        };
        for watcher in watchers {
            (watcher.lock().unwrap_or_else(PoisonError::into_inner))(DiscoveryEvent::Vanished { guid });
        }
    }
}

impl DomainState {
    /// Who hears of an endpoint of `network`.
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

    fn discover(&self, mut handler: DiscoveryHandler) -> Result<(), RosError> {
        let mut state = self.domain.lock();
        for endpoint in state.endpoints.values() {
            if endpoint.network != self.network && !(endpoint.tagged && self.tagged) {
                handler(DiscoveryEvent::Appeared(endpoint.discovered.clone()));
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
}

impl Drop for FakeRos {
    fn drop(&mut self) {
        self.domain.lock().watchers.retain(|w| w.network != self.network);
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
    /// Writes several at once: readers find them at hand together, as those of a real network do under load.
    pub fn write_burst(&self, payloads: impl IntoIterator<Item = Bytes>) {
        let mut payloads = payloads.into_iter().peekable();
        while let Some(payload) = payloads.next() {
            self.give(SampleKind::Write, 1, payload, payloads.peek().is_some());
        }
    }

    fn give(&self, kind: SampleKind, source_timestamp_ns: i64, payload: Bytes, more: bool) {
        let sample = Sample { kind, writer: Some(self.guid), source_timestamp_ns, payload, more };
        let readers: Vec<_> = {
            let mut state = self.domain.lock();
            let Some(writer) = state.endpoints.get_mut(&self.guid) else { return };
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
                .filter(|r| writer.reaches(r.network, r.tagged) && matches(&writer.discovered, &r.discovered))
                .filter_map(|r| r.reader.clone())
                .collect()
        };
        for reader in readers {
            (reader.lock().unwrap_or_else(PoisonError::into_inner))(sample.clone());
        }
    }
}

impl RosWriter for FakeWriter {
    fn write(&self, kind: SampleKind, source_timestamp_ns: i64, payload: Bytes) -> Result<(), RosError> {
        self.give(kind, source_timestamp_ns, payload, false);
        Ok(())
    }

    fn matched_readers(&self) -> u32 {
        let state = self.domain.lock();
        let Some(writer) = state.endpoints.get(&self.guid) else { return 0 };
        let matched = state
            .endpoints
            .values()
            .filter(|r| r.network != writer.network)
            .filter(|r| r.reader.is_some() && matches(&writer.discovered, &r.discovered));
        matched.count() as u32
    }
}

fn matches(writer: &DiscoveredEndpoint, reader: &DiscoveredEndpoint) -> bool {
    (writer.kind, reader.kind) == (EndpointKind::Writer, EndpointKind::Reader)
        && (&writer.topic, &writer.type_name, writer.keyless)
            == (&reader.topic, &reader.type_name, reader.keyless)
        && writer.qos.reliability >= reader.qos.reliability
        && writer.qos.durability >= reader.qos.durability
}
