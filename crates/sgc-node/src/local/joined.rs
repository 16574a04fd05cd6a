//! [`Joined`]: up to two local ROS 2 networks as one, a DDS and a Zenoh network of the same robot.
//!
//! Each endpoint is created on both networks, and what either of them says counts. It moves nothing from one network to
//! the other: a topic of the DDS network is heard on the Zenoh network of another robot, not on that of this one.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_ros::{
    DiscoveryHandler, EndpointKind, EndpointSpec, GraphNode, Guid, HandleCalls, Reach, RequestHandler,
    RequestId, RosClient, RosError, RosNetwork, RosServer, RosWriter, SampleHandler, SampleHead, SentRequest,
    ServiceSpec, SharedSamples, ShownEndpoint, UnhandledCall,
};
use sgc_sync::lock;

/// Most requests of which the network is remembered. A reply to another request is tried on both.
const REQUESTS_MAX: usize = 8192;
/// Longest wait for matches on one network while those on the other are not counted.
const MATCH_SLICE: Duration = Duration::from_millis(50);

/// One or two networks. An endpoint is known by its GUID on the first one that has it.
pub(crate) struct Joined<A, B> {
    first: Option<Arc<A>>,
    second: Option<Arc<B>>,
    /// The GUIDs on the second network of endpoints that are on both, by those on the first.
    aliases: Arc<Aliases>,
    requests: Arc<Mutex<Requests>>,
}

type Aliases = Mutex<BTreeMap<Guid, Guid>>;

/// The place of an endpoint or a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Side {
    First,
    Second,
}

/// The networks from which requests came, the oldest first.
#[derive(Default)]
struct Requests {
    sides: BTreeMap<([u8; 16], i64), Side>,
    order: VecDeque<([u8; 16], i64)>,
}

impl Requests {
    fn note(&mut self, id: &RequestId, side: Side) {
        let key = (id.client, id.number);
        if self.sides.insert(key, side).is_none() {
            self.order.push_back(key);
        }
        while self.order.len() > REQUESTS_MAX {
            if let Some(oldest) = self.order.pop_front() {
                self.sides.remove(&oldest);
            }
        }
    }

    fn side_of(&self, id: &RequestId) -> Option<Side> {
        self.sides.get(&(id.client, id.number)).copied()
    }
}

/// The two forms of an endpoint, one for each network that has it.
struct Pair<X, Y> {
    first: Option<X>,
    second: Option<Y>,
    /// The GUID, and the alias that ends with the endpoint.
    guids: Vec<Guid>,
    aliases: Arc<Aliases>,
}

impl<X, Y> Drop for Pair<X, Y> {
    fn drop(&mut self) {
        let mut aliases = lock(&self.aliases);
        for guid in &self.guids {
            aliases.remove(guid);
        }
    }
}

/// A reader on one or two networks.
pub(crate) struct JoinedReader<X, Y>(Pair<X, Y>);
/// A writer on one or two networks.
pub(crate) struct JoinedWriter<X, Y>(Pair<X, Y>);
/// A client on one or two networks. It calls the servers of the first network, or of the second if the first has none.
pub(crate) struct JoinedClient<X, Y>(Pair<X, Y>);
/// A server on one or two networks.
pub(crate) struct JoinedServer<X, Y> {
    pair: Pair<X, Y>,
    requests: Arc<Mutex<Requests>>,
}

impl<A: RosNetwork, B: RosNetwork> Joined<A, B> {
    /// Joins networks.
    ///
    /// # Panics
    /// Without any network.
    pub(crate) fn new(first: Option<A>, second: Option<B>) -> Self {
        assert!(first.is_some() || second.is_some(), "a network to join");
        let (first, second) = (first.map(Arc::new), second.map(Arc::new));
        Self { first, second, aliases: Arc::default(), requests: Arc::default() }
    }

    /// Creates an endpoint on each network. If one network refuses it, the other one has it alone.
    fn pair<X, Y>(
        &self,
        first: impl FnOnce(&A) -> Result<X, RosError>,
        second: impl FnOnce(&B) -> Result<Y, RosError>,
        guids: impl FnOnce(Option<&X>, Option<&Y>) -> [Option<Vec<Guid>>; 2],
    ) -> Result<Pair<X, Y>, RosError> {
        let first = self.first.as_deref().map(first);
        let second = self.second.as_deref().map(second);
        let (first, second) = match (first, second) {
            (Some(Err(error)), None | Some(Err(_))) | (None, Some(Err(error))) => return Err(error),
            (first, second) => {
                for error in [
                    first.as_ref().and_then(|r| r.as_ref().err()),
                    second.as_ref().and_then(|r| r.as_ref().err()),
                ] {
                    error.into_iter().for_each(|error| tracing::warn!("{error}; the other network has it"));
                }
                (first.and_then(Result::ok), second.and_then(Result::ok))
            }
        };
        let [of_first, of_second] = guids(first.as_ref(), second.as_ref());
        if let (Some(of_first), Some(of_second)) = (&of_first, &of_second) {
            lock(&self.aliases).extend(of_first.iter().copied().zip(of_second.iter().copied()));
        }
        let guids = of_first.or(of_second).unwrap_or_default();
        Ok(Pair { first, second, guids, aliases: Arc::clone(&self.aliases) })
    }

    /// Returns the nodes with the GUIDs that their endpoints have on the second network.
    fn on_second(&self, nodes: &[GraphNode]) -> Vec<GraphNode> {
        let aliases = lock(&self.aliases);
        let moved = |guids: &[Guid]| guids.iter().map(|g| aliases.get(g).copied().unwrap_or(*g)).collect();
        let node = |node: &GraphNode| GraphNode {
            node: node.node.clone(),
            readers: moved(&node.readers),
            writers: moved(&node.writers),
        };
        nodes.iter().map(node).collect()
    }
}

/// A handler of calls on both networks, which notes from which of them a request came.
struct CallsOf {
    calls: Arc<Mutex<RequestHandler>>,
    noted: Option<(Arc<Mutex<Requests>>, Side)>,
}

impl CallsOf {
    fn pair(handler: RequestHandler, requests: Option<&Arc<Mutex<Requests>>>) -> [Box<Self>; 2] {
        let calls = Arc::new(Mutex::new(handler));
        [Side::First, Side::Second].map(|side| {
            let noted = requests.map(|requests| (Arc::clone(requests), side));
            Box::new(Self { calls: Arc::clone(&calls), noted })
        })
    }
}

impl HandleCalls for CallsOf {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        if let Some((requests, side)) = &self.noted {
            lock(requests).note(&id, *side);
        }
        lock(&self.calls).handle(id, payload);
    }

    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        lock(&self.calls).unhandled(why, messages);
    }

    fn network_closed(&mut self) {
        lock(&self.calls).network_closed();
    }
}

impl<A: RosNetwork, B: RosNetwork> RosNetwork for Joined<A, B> {
    type Reader = JoinedReader<A::Reader, B::Reader>;
    type Writer = JoinedWriter<A::Writer, B::Writer>;
    type Client = JoinedClient<A::Client, B::Client>;
    type Server = JoinedServer<A::Server, B::Server>;

    fn discover(&self, handler: DiscoveryHandler) -> Result<(), RosError> {
        let handler = Arc::new(Mutex::new(handler));
        let shared = || -> DiscoveryHandler {
            let handler = Arc::clone(&handler);
            Box::new(move |event| (lock(&handler))(event))
        };
        self.first.iter().try_for_each(|network| network.discover(shared()))?;
        self.second.iter().try_for_each(|network| network.discover(shared()))
    }

    fn create_reader(&self, spec: &EndpointSpec, handler: SampleHandler) -> Result<Self::Reader, RosError> {
        let for_first = SharedSamples::new(handler);
        let for_second = for_first.clone();
        let guid = |reader: Option<Guid>| reader.map(|guid| vec![guid]);
        self.pair(
            |network| network.create_reader(spec, Box::new(for_first)),
            |network| network.create_reader(spec, Box::new(for_second)),
            |first, second| {
                let first =
                    self.first.as_ref().zip(first).map(|(network, reader)| network.reader_guid(reader));
                let second =
                    self.second.as_ref().zip(second).map(|(network, reader)| network.reader_guid(reader));
                [guid(first), guid(second)]
            },
        )
        .map(JoinedReader)
    }

    fn create_writer(&self, spec: &EndpointSpec) -> Result<Self::Writer, RosError> {
        self.pair(
            |network| network.create_writer(spec),
            |network| network.create_writer(spec),
            |first, second| {
                [first.map(|writer| vec![writer.guid()]), second.map(|writer| vec![writer.guid()])]
            },
        )
        .map(JoinedWriter)
    }

    fn create_client(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Client, RosError> {
        let [for_first, for_second] = CallsOf::pair(handler, None);
        self.pair(
            |network| network.create_client(spec, for_first),
            |network| network.create_client(spec, for_second),
            |first, second| {
                [first.map(|client| client.guids().into()), second.map(|client| client.guids().into())]
            },
        )
        .map(JoinedClient)
    }

    fn create_server(&self, spec: &ServiceSpec, handler: RequestHandler) -> Result<Self::Server, RosError> {
        let [for_first, for_second] = CallsOf::pair(handler, Some(&self.requests));
        let pair = self.pair(
            |network| network.create_server(spec, for_first),
            |network| network.create_server(spec, for_second),
            |first, second| {
                [first.map(|server| server.guids().into()), second.map(|server| server.guids().into())]
            },
        )?;
        Ok(JoinedServer { pair, requests: Arc::clone(&self.requests) })
    }

    fn reader_guid(&self, reader: &Self::Reader) -> Guid {
        guid_of(&reader.0)
    }

    fn renewed_ago(&self, writer: &Guid) -> Option<Duration> {
        let first = self.first.as_ref().and_then(|network| network.renewed_ago(writer));
        first.or_else(|| self.second.as_ref()?.renewed_ago(writer))
    }

    fn has_graph(&self) -> bool {
        self.first.as_ref().is_some_and(|network| network.has_graph())
            || self.second.as_ref().is_some_and(|network| network.has_graph())
    }

    fn nodes_here(&self) -> BTreeSet<String> {
        let first = self.first.as_ref().map(|network| network.nodes_here());
        let second = self.second.as_ref().map(|network| network.nodes_here());
        first.into_iter().chain(second).flatten().collect()
    }

    fn missing_router(&self) -> Option<String> {
        let first = self.first.as_ref().and_then(|network| network.missing_router());
        first.or_else(|| self.second.as_ref()?.missing_router())
    }

    fn show(&self, kind: EndpointKind, spec: &EndpointSpec) -> Result<ShownEndpoint, RosError> {
        let guid = |shown: Option<&ShownEndpoint>| shown.map(|shown| vec![shown.guid]);
        let pair = self.pair(
            |network| network.show(kind, spec),
            |network| network.show(kind, spec),
            |first, second| [guid(first), guid(second)],
        )?;
        Ok(ShownEndpoint::new(guid_of(&pair), pair))
    }

    fn announce(&self, nodes: &[GraphNode]) -> Result<(), RosError> {
        let first = self.first.as_ref().map_or(Ok(()), |network| network.announce(nodes));
        let second = self.second.as_ref().map_or(Ok(()), |network| network.announce(&self.on_second(nodes)));
        first.and(second)
    }

    fn reach(&self) -> Reach {
        let first = self.first.as_ref().map_or(Reach::Whole, |network| network.reach());
        first.max(self.second.as_ref().map_or(Reach::Whole, |network| network.reach()))
    }

    fn gains_by_reopening(&self) -> Result<bool, RosError> {
        let gains = |reach, look: &dyn Fn() -> Result<bool, RosError>| {
            if reach == Reach::CutOff { look() } else { Ok(false) }
        };
        let first = self.first.as_ref();
        let first =
            first.map_or(Ok(false), |network| gains(network.reach(), &|| network.gains_by_reopening()))?;
        let second = self.second.as_ref();
        let second =
            second.map_or(Ok(false), |network| gains(network.reach(), &|| network.gains_by_reopening()))?;
        Ok(first || second)
    }

    fn close(self: Arc<Self>, max: Duration) -> bool {
        let until = Instant::now() + max;
        let (first, second) = (self.first.clone(), self.second.clone());
        drop(self);
        let first = first.is_none_or(|network| network.close(max));
        second.is_none_or(|network| network.close(until.saturating_duration_since(Instant::now()))) && first
    }
}

/// Returns the GUID of an endpoint with one.
fn guid_of<X, Y>(pair: &Pair<X, Y>) -> Guid {
    pair.guids.first().copied().unwrap_or(Guid([0; 16]))
}

/// Returns the GUIDs of an endpoint with two.
fn guids_of<X, Y>(pair: &Pair<X, Y>) -> [Guid; 2] {
    [0, 1].map(|place| pair.guids.get(place).copied().unwrap_or(Guid([0; 16])))
}

impl<X: RosWriter, Y: RosWriter> JoinedWriter<X, Y> {
    fn both(&self) -> impl Iterator<Item = &dyn RosWriter> {
        let first = self.0.first.as_ref().map(|writer| writer as &dyn RosWriter);
        first.into_iter().chain(self.0.second.as_ref().map(|writer| writer as &dyn RosWriter))
    }
}

impl<X: RosWriter, Y: RosWriter> RosWriter for JoinedWriter<X, Y> {
    fn write_ahead(&self, head: SampleHead, payload: Bytes) -> Result<(), RosError> {
        // One network that does not take a sample does not keep it from the other.
        self.both().map(|writer| writer.write_ahead(head, payload.clone())).fold(Ok(()), Result::and)
    }

    fn flush(&self) {
        self.both().for_each(RosWriter::flush);
    }

    fn assert_liveliness(&self) {
        self.both().for_each(RosWriter::assert_liveliness);
    }

    fn set_late_depth(&self, depth: u32) {
        self.both().for_each(|writer| writer.set_late_depth(depth));
    }

    fn kept(&self, bytes: usize) -> Option<u32> {
        self.both().filter_map(|writer| writer.kept(bytes)).min()
    }

    fn unacknowledged(&self) -> Option<u32> {
        self.both().filter_map(RosWriter::unacknowledged).reduce(u32::saturating_add)
    }

    fn wait_acknowledged(&self, max: Duration) -> bool {
        let until = Instant::now() + max;
        self.both().all(|writer| writer.wait_acknowledged(until.saturating_duration_since(Instant::now())))
    }

    fn matched_readers(&self) -> u32 {
        self.both().map(RosWriter::matched_readers).fold(0, u32::saturating_add)
    }

    fn wait_matched(&self, readers: u32, max: Duration) -> u32 {
        let (Some(first), Some(second)) = (&self.0.first, &self.0.second) else {
            return self.both().next().map_or(0, |writer| writer.wait_matched(readers, max));
        };
        let until = Instant::now() + max;
        loop {
            let elsewhere = second.matched_readers();
            let left = until.saturating_duration_since(Instant::now());
            let here = first.wait_matched(readers.saturating_sub(elsewhere), left.min(MATCH_SLICE));
            let now = here.saturating_add(second.matched_readers());
            if now >= readers || left.is_zero() {
                return now;
            }
        }
    }

    fn guid(&self) -> Guid {
        guid_of(&self.0)
    }
}

impl<X: RosClient, Y: RosClient> RosClient for JoinedClient<X, Y> {
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError> {
        match (&self.0.first, &self.0.second) {
            (Some(first), Some(second)) if first.matched_servers() == 0 && second.matched_servers() > 0 => {
                second.send(payload)
            }
            (Some(first), Some(second)) => match first.send(payload.clone()) {
                Err(RosError::NoPeer { .. }) if second.matched_servers() > 0 => second.send(payload),
                sent => sent,
            },
            (Some(first), None) => first.send(payload),
            (None, Some(second)) => second.send(payload),
            (None, None) => Err(RosError::NoPeer { waited_ms: 0 }),
        }
    }

    fn servers(&self) -> BTreeSet<Guid> {
        let first = self.0.first.as_ref().map(RosClient::servers);
        first.into_iter().chain(self.0.second.as_ref().map(RosClient::servers)).flatten().collect()
    }

    fn guids(&self) -> [Guid; 2] {
        guids_of(&self.0)
    }
}

impl<X: RosServer, Y: RosServer> RosServer for JoinedServer<X, Y> {
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError> {
        let side = lock(&self.requests).side_of(request);
        let first = self.pair.first.as_ref().filter(|_| side != Some(Side::Second));
        let second = self.pair.second.as_ref().filter(|_| side != Some(Side::First));
        match (first, second) {
            (Some(first), Some(second)) => match second.reply(request, payload.clone()) {
                Err(RosError::NoPeer { .. }) => first.reply(request, payload),
                replied => replied,
            },
            (Some(first), None) => first.reply(request, payload),
            (None, Some(second)) => second.reply(request, payload),
            (None, None) => Err(RosError::NoPeer { waited_ms: 0 }),
        }
    }

    fn guids(&self) -> [Guid; 2] {
        guids_of(&self.pair)
    }
}

#[cfg(test)]
mod tests {
    use sgc_ros::DiscoveryEvent;
    use sgc_testkit::conformance::Site;
    use sgc_testkit::conformance::rig::{PATIENCE, discover, next, read, spec, string_cdr, write};
    use sgc_testkit::{FakeDomain, FakeRos};
    use sgc_wire::RosNode;

    use super::*;

    /// Two domains in memory. Programs are in the first, whose GUIDs count, and proxies in both.
    struct Both([FakeDomain; 2]);

    impl Site for Both {
        type Network = Joined<FakeRos, FakeRos>;

        const PROXIES_MATCH: bool = false;

        fn new() -> Self {
            let second = FakeDomain::default();
            // GUIDs in memory are numbers, and those of two networks differ.
            (0..1000).for_each(|_| drop(second.join(false)));
            Self([FakeDomain::default(), second])
        }

        fn open(&self, tag: Option<&str>) -> Self::Network {
            let [first, second] = &self.0;
            match tag {
                Some(_) => Joined::new(Some(first.join(true)), Some(second.join(true))),
                None => Joined::new(Some(first.join(false)), None),
            }
        }
    }

    sgc_testkit::conformance_tests!(Both);

    #[test]
    fn programs_of_the_second_network_take_part() {
        let site = Both::new();
        let proxy = site.open(Some("arm-1"));
        let programs = site.0.each_ref().map(|domain| domain.join(false));
        let heard = programs.each_ref().map(|program| read(program, &spec("down")));
        let writer = proxy.create_writer(&spec("down")).expect("a writer");
        assert_eq!(writer.wait_matched(2, PATIENCE), 2);
        write(&writer, &string_cdr("down"));
        heard.iter().for_each(|(_, samples)| assert_eq!(next(samples).payload, string_cdr("down")));

        let (_reader, samples) = read(&proxy, &spec("up"));
        for program in &programs {
            let writer = program.create_writer(&spec("up")).expect("a writer");
            write(&writer, &string_cdr("up"));
            assert_eq!(next(&samples).writer, Some(writer.guid()));
        }

        let [_, second] = &programs;
        let events = discover(second);
        let mirrored = RosNode::new("/", "talker", None).expect("a name of a node");
        let node = GraphNode { node: mirrored.clone(), readers: vec![], writers: vec![writer.guid()] };
        proxy.announce(&[node]).expect("an announcement");
        let nodes = loop {
            if let DiscoveryEvent::Nodes { nodes, .. } = next(&events) {
                break nodes;
            }
        };
        assert_eq!((&nodes[0].node, nodes[0].writers.len()), (&mirrored, 1));
        assert_ne!(nodes[0].writers[0], writer.guid(), "the writer has another GUID there");
        assert_eq!(lock(&proxy.aliases).get(&writer.guid()), Some(&nodes[0].writers[0]));
        drop(writer);
        assert_eq!(lock(&proxy.aliases).len(), 1, "that of the reader is left");
    }
}
