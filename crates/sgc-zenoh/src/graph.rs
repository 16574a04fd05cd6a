//! [`Graph`]: the liveliness tokens of a ROS domain, as endpoints and nodes that appear and vanish.
//!
//! A pure machine. The caller hands in the keys of tokens that were declared and undeclared, then takes the events. It
//! also answers which endpoints a message or a match concerns. It opens no session, and decides nothing about data.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use sgc_ros::{DiscoveredEndpoint, DiscoveryEvent, EndpointKind, GraphNode, Guid, ServiceTopic};
use sgc_wire::RosNode;
use twox_hash::XxHash3_128;

use crate::error::CodecError;
use crate::gid::Gid;
use crate::id::ZenohId;
use crate::token::{EntityKind, Token, TokenEndpoint};
use crate::topic::TopicInfo;

/// Most tokens of a domain that are known at once.
pub const TOKENS_MAX: usize = 65_536;
/// Most tokens of one session that are known at once, so that one program cannot use up [`TOKENS_MAX`].
pub const SESSION_TOKENS_MAX: usize = 16_384;
/// Most tokens with the number of one endpoint. A program that moves an endpoint to another node has two for a moment.
pub const ENDPOINT_TOKENS_MAX: usize = 4;
/// The greatest number of an endpoint, which has three bytes in a [`Guid`].
pub const ENDPOINT_ID_MAX: u64 = 0xff_ffff;

/// The first two bytes of the GUID of an endpoint on Zenoh. DDS vendors have other ids there (RTPS 2.5, 9.3.1.1).
const VENDOR: [u8; 2] = [0x01, 0xfe];
/// The last bytes of the GUID of a participant (RTPS 2.5, table 9.2).
const PARTICIPANT: [u8; 4] = [0, 0, 1, 0xc1];

/// The node to which SGC's endpoints belong that have no node of their own. It is not reported, and its underscore hides
/// it from `ros2 node list`.
const UNASSIGNED: &str = "_sgc_unassigned";

/// The reason why a token is not taken in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GraphError {
    /// The key is no token of rmw_zenoh.
    #[error(transparent)]
    Codec(#[from] CodecError),
    /// The token is of another domain.
    #[error("a token of ROS domain {0}")]
    Domain(u32),
    /// The number of an endpoint does not fit in a GUID.
    #[error("an endpoint with the number {0}, more than {ENDPOINT_ID_MAX}")]
    EndpointId(u64),
    /// There are [`TOKENS_MAX`] tokens already.
    #[error("more than {TOKENS_MAX} tokens in the domain")]
    Full,
    /// The session has [`SESSION_TOKENS_MAX`] tokens already.
    #[error("more than {SESSION_TOKENS_MAX} tokens of one session")]
    SessionFull,
    /// The endpoint has [`ENDPOINT_TOKENS_MAX`] tokens already.
    #[error("more than {ENDPOINT_TOKENS_MAX} tokens of one endpoint")]
    EndpointFull,
}

/// An endpoint that a message or a match names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct EndpointRef {
    /// The session of its program.
    pub session: ZenohId,
    /// Its number in its session.
    pub id: u64,
}

impl EndpointRef {
    /// Returns the GUID of the endpoint's reader or writer. A publisher has a writer and a subscription a reader; clients
    /// and servers have both.
    pub fn guid(self, kind: EndpointKind) -> Guid {
        let mut guid = participant(self.session).0;
        guid[12..15].copy_from_slice(&(self.id as u32).to_be_bytes()[1..]);
        // The kinds of endpoints whose type has no key (RTPS 2.5, table 9.1).
        guid[15] = match kind {
            EndpointKind::Writer => 3,
            EndpointKind::Reader => 4,
        };
        Guid(guid)
    }
}

/// Returns the GUID that stands for a session, whose endpoints share its prefix.
pub fn participant(session: ZenohId) -> Guid {
    let mut guid = [0; 16];
    let hash = XxHash3_128::oneshot(session.to_string().as_bytes()).to_be_bytes();
    guid[..2].copy_from_slice(&VENDOR);
    guid[2..12].copy_from_slice(&hash[..10]);
    guid[12..].copy_from_slice(&PARTICIPANT);
    Guid(guid)
}

/// Returns the node of SGC's endpoints that have none of their own.
pub fn unassigned_node() -> RosNode {
    RosNode::new("/", UNASSIGNED, None).expect("a name that ROS accepts")
}

/// The tokens of a domain.
#[derive(Debug)]
pub struct Graph {
    domain: u32,
    own: ZenohId,
    ignores_proxies: bool,
    tokens: usize,
    sessions: BTreeMap<ZenohId, Session>,
    topics: BTreeMap<TopicInfo, BTreeSet<(EntityKind, EndpointRef)>>,
    gids: BTreeMap<Gid, EndpointRef>,
    /// Endpoints and sessions of which the caller may not know the last state.
    changed_endpoints: BTreeSet<EndpointRef>,
    changed_sessions: BTreeSet<ZenohId>,
    /// The endpoints and nodes that were reported.
    told: BTreeMap<EndpointRef, Vec<DiscoveredEndpoint>>,
    told_nodes: BTreeMap<ZenohId, Vec<GraphNode>>,
    is_watched: bool,
}

/// The tokens of one session.
#[derive(Debug, Default)]
struct Session {
    tokens: usize,
    /// The tokens of nodes, by the number of the node.
    nodes: BTreeMap<u64, BTreeSet<RosNode>>,
    /// The tokens of each endpoint, the latest last. The latest is the one that counts.
    endpoints: BTreeMap<u64, Vec<Declared>>,
}

/// A token of an endpoint.
#[derive(Debug)]
struct Declared {
    text: Arc<str>,
    node_id: u64,
    node: Option<RosNode>,
    endpoint: TokenEndpoint,
}

impl Graph {
    /// Creates the graph of a ROS domain as the session `own` sees it. With `ignores_proxies`, endpoints of other sessions
    /// of SGC are neither reported nor matched. Endpoints of the own session are never reported.
    pub fn new(domain: u32, own: ZenohId, ignores_proxies: bool) -> Self {
        Self {
            domain,
            own,
            ignores_proxies,
            tokens: 0,
            sessions: BTreeMap::new(),
            topics: BTreeMap::new(),
            gids: BTreeMap::new(),
            changed_endpoints: BTreeSet::new(),
            changed_sessions: BTreeSet::new(),
            told: BTreeMap::new(),
            told_nodes: BTreeMap::new(),
            is_watched: false,
        }
    }

    /// Takes in a token that was declared. A token that is known already changes nothing.
    ///
    /// # Errors
    /// [`GraphError`]: the token is skipped.
    pub fn declare(&mut self, text: &str) -> Result<(), GraphError> {
        let token = Token::decode(text)?;
        if token.domain != self.domain {
            return Err(GraphError::Domain(token.domain));
        }
        let Token { session: id, node_id, node, endpoint, .. } = token;
        let has_room = self.tokens < TOKENS_MAX;
        let known = self.sessions.get(&id);
        if known.is_some_and(|session| session.tokens >= SESSION_TOKENS_MAX) {
            return Err(GraphError::SessionFull);
        }
        let Some(endpoint) = endpoint else {
            // A token of a node has a node.
            let Some(node) = node else { return Ok(()) };
            if !has_room {
                return Err(GraphError::Full);
            }
            let session = self.sessions.entry(id).or_default();
            if session.nodes.entry(node_id).or_default().insert(node) {
                session.tokens += 1;
                self.tokens += 1;
                self.note_session(id);
            }
            return Ok(());
        };
        if endpoint.id > ENDPOINT_ID_MAX {
            return Err(GraphError::EndpointId(endpoint.id));
        }
        let declared = known.and_then(|session| session.endpoints.get(&endpoint.id));
        if declared.is_some_and(|all| all.iter().any(|one| *one.text == *text)) {
            return Ok(());
        }
        if !has_room {
            return Err(GraphError::Full);
        }
        if declared.is_some_and(|all| all.len() >= ENDPOINT_TOKENS_MAX) {
            return Err(GraphError::EndpointFull);
        }
        let at = EndpointRef { session: id, id: endpoint.id };
        self.unlink(at);
        self.gids.insert(Gid::of_token(text), at);
        let session = self.sessions.entry(id).or_default();
        let declared = Declared { text: text.into(), node_id, node, endpoint };
        session.endpoints.entry(at.id).or_default().push(declared);
        session.tokens += 1;
        self.tokens += 1;
        self.link(at);
        Ok(())
    }

    /// Takes out a token that was undeclared, or whose session ended. A token that is not known changes nothing. Returns
    /// the endpoint if it has no other token.
    pub fn undeclare(&mut self, text: &str) -> Option<EndpointRef> {
        let Token { session: id, node_id, node, endpoint, .. } = Token::decode(text).ok()?;
        let session = self.sessions.get_mut(&id)?;
        let Some(endpoint) = endpoint else {
            let (node, nodes) = (node?, session.nodes.get_mut(&node_id)?);
            if nodes.remove(&node) {
                if nodes.is_empty() {
                    session.nodes.remove(&node_id);
                }
                self.note_session(id);
                self.forget_token(id);
            }
            return None;
        };
        let is_known = |all: &Vec<Declared>| all.iter().any(|one| *one.text == *text);
        if !session.endpoints.get(&endpoint.id).is_some_and(is_known) {
            return None;
        }
        let at = EndpointRef { session: id, id: endpoint.id };
        self.unlink(at);
        self.gids.remove(&Gid::of_token(text));
        if let Some(session) = self.sessions.get_mut(&id)
            && let Some(all) = session.endpoints.get_mut(&at.id)
        {
            all.retain(|one| *one.text != *text);
            if all.is_empty() {
                session.endpoints.remove(&at.id);
            }
        }
        self.link(at);
        self.forget_token(id);
        (!self.is_there(at)).then_some(at)
    }

    fn forget_token(&mut self, id: ZenohId) {
        self.tokens -= 1;
        if let Some(session) = self.sessions.get_mut(&id) {
            session.tokens -= 1;
            if session.tokens == 0 {
                self.sessions.remove(&id);
            }
        }
    }

    /// Removes an endpoint from the index of topics, before its tokens change.
    fn unlink(&mut self, at: EndpointRef) {
        let Some(TokenEndpoint { kind, topic, .. }) = self.current(at).map(|one| &one.endpoint) else {
            return;
        };
        let (kind, topic) = (*kind, topic.clone());
        if let Some(all) = self.topics.get_mut(&topic) {
            all.remove(&(kind, at));
            if all.is_empty() {
                self.topics.remove(&topic);
            }
        }
    }

    /// Adds an endpoint to the index of topics, after its tokens changed.
    fn link(&mut self, at: EndpointRef) {
        if let Some(TokenEndpoint { kind, topic, .. }) = self.current(at).map(|one| &one.endpoint) {
            let (kind, topic) = (*kind, topic.clone());
            self.topics.entry(topic).or_default().insert((kind, at));
        }
        if self.is_watched {
            self.changed_endpoints.insert(at);
        }
        self.note_session(at.session);
    }

    /// Notes that nodes of a session may have changed.
    fn note_session(&mut self, id: ZenohId) {
        if self.is_watched {
            self.changed_sessions.insert(id);
        }
    }

    fn current(&self, at: EndpointRef) -> Option<&Declared> {
        self.sessions.get(&at.session)?.endpoints.get(&at.id)?.last()
    }

    /// Returns `true` if endpoints of a session are neither reported nor matched, apart from the own session's.
    fn is_ignored(&self, session: ZenohId) -> bool {
        self.ignores_proxies && (session == self.own || session.is_of_sgc())
    }

    /// Starts to report. All endpoints and nodes that are known are changes.
    pub fn watch(&mut self) {
        self.is_watched = true;
        let endpoints = self.sessions.iter().flat_map(|(session, known)| {
            known.endpoints.keys().map(|id| EndpointRef { session: *session, id: *id })
        });
        self.changed_endpoints = endpoints.collect();
        self.changed_sessions = self.sessions.keys().copied().collect();
    }

    /// Ends the reports. What was reported is forgotten.
    pub fn unwatch(&mut self) {
        self.is_watched = false;
        self.changed_endpoints.clear();
        self.changed_sessions.clear();
        self.told.clear();
        self.told_nodes.clear();
    }

    /// Returns the endpoints that appeared or vanished since the last call. An endpoint whose token says something else
    /// than before vanishes and appears.
    pub fn endpoint_events(&mut self) -> Vec<DiscoveryEvent> {
        let changed = std::mem::take(&mut self.changed_endpoints);
        let mut events = Vec::new();
        if !self.is_watched {
            return events;
        }
        for at in changed {
            if at.session == self.own || self.is_ignored(at.session) {
                continue;
            }
            let now = self.current(at).map(|one| discovered(at, &one.endpoint)).unwrap_or_default();
            let before = self.told.get(&at).map_or(&[][..], Vec::as_slice);
            let is_new = |one: &&DiscoveredEndpoint| !before.contains(one);
            let is_gone = |one: &&DiscoveredEndpoint| !now.contains(one);
            events
                .extend(before.iter().filter(is_gone).map(|one| DiscoveryEvent::Vanished { guid: one.guid }));
            events.extend(now.iter().filter(is_new).cloned().map(DiscoveryEvent::Appeared));
            match now.is_empty() {
                true => self.told.remove(&at),
                false => self.told.insert(at, now),
            };
        }
        events
    }

    /// Returns the sessions whose nodes changed since the last call.
    pub fn node_events(&mut self) -> Vec<DiscoveryEvent> {
        let changed = std::mem::take(&mut self.changed_sessions);
        let mut events = Vec::new();
        if !self.is_watched {
            return events;
        }
        for id in changed {
            if id == self.own || self.is_ignored(id) {
                continue;
            }
            let nodes = self.sessions.get(&id).map(|session| session.graph(id)).unwrap_or_default();
            let before = self.told_nodes.get(&id).map_or(&[][..], Vec::as_slice);
            if before == nodes {
                continue;
            }
            match nodes.is_empty() {
                true => self.told_nodes.remove(&id),
                false => self.told_nodes.insert(id, nodes.clone()),
            };
            events.push(DiscoveryEvent::Nodes { participant: participant(id), nodes });
        }
        events
    }

    /// Returns `true` if endpoints changed since their events were taken.
    pub fn has_changed_endpoints(&self) -> bool {
        self.is_watched && !self.changed_endpoints.is_empty()
    }

    /// Returns `true` if nodes may have changed since their events were taken.
    pub fn has_changed_nodes(&self) -> bool {
        self.is_watched && !self.changed_sessions.is_empty()
    }

    /// Returns the endpoints of a kind on a topic or service that count as matches for endpoints of the own session.
    pub fn matches(&self, topic: &TopicInfo, kind: EntityKind) -> impl Iterator<Item = EndpointRef> {
        let all = self.topics.get(topic).into_iter().flatten();
        let of_kind = all.filter(move |(found, _)| *found == kind).map(|(_, at)| *at);
        of_kind.filter(|at| !self.is_ignored(at.session))
    }

    /// Returns the endpoint with this id.
    pub fn endpoint_with(&self, gid: &Gid) -> Option<EndpointRef> {
        self.gids.get(gid).copied()
    }

    /// Returns the publisher of a session on a topic if it has just one.
    pub fn only_publisher(&self, topic: &TopicInfo, session: ZenohId) -> Option<EndpointRef> {
        let all = self.topics.get(topic).into_iter().flatten();
        let mut of_session = all
            .filter(|(kind, at)| *kind == EntityKind::Publisher && at.session == session)
            .map(|(_, at)| *at);
        of_session.next().filter(|_| of_session.next().is_none())
    }

    /// Returns the hash of a type as the first endpoint says it that has this name and type. Endpoints of proxies count
    /// as well, because their hashes come from programs.
    pub fn hash_of<'a>(&'a self, name: &'a str, type_name: &'a str) -> Option<&'a str> {
        self.named(name, type_name).next().map(|(topic, _)| topic.type_hash())
    }

    /// Returns a topic as programs have it that are not SGC: with the same hash if one has that, else with that of another.
    /// Returns `None` if no program has its name and type.
    pub fn as_programs_have<'a>(&'a self, topic: &'a TopicInfo) -> Option<&'a TopicInfo> {
        let is_program =
            |(_, at): &(EntityKind, EndpointRef)| at.session != self.own && !at.session.is_of_sgc();
        let of_programs = self.named(topic.name(), topic.type_name());
        let mut of_programs =
            of_programs.filter(|(_, all)| all.iter().any(is_program)).map(|(found, _)| found);
        let first = of_programs.next()?;
        Some(if first == topic { first } else { of_programs.find(|found| *found == topic).unwrap_or(first) })
    }

    /// Returns the topics with this name and type, and their endpoints.
    fn named<'a>(
        &'a self,
        name: &'a str,
        type_name: &'a str,
    ) -> impl Iterator<Item = (&'a TopicInfo, &'a BTreeSet<(EntityKind, EndpointRef)>)> {
        let from = self.topics.range(TopicInfo::least(name, type_name)..);
        from.take_while(move |(topic, _)| topic.name() == name && topic.type_name() == type_name)
    }

    /// Returns `true` if an endpoint has a token.
    pub fn is_there(&self, at: EndpointRef) -> bool {
        self.current(at).is_some()
    }

    /// Returns the number of tokens that are known.
    pub fn tokens(&self) -> usize {
        self.tokens
    }
}

impl Session {
    /// Returns the nodes of a session: those with a token, and those that tokens of endpoints name.
    fn graph(&self, id: ZenohId) -> Vec<GraphNode> {
        let unassigned = unassigned_node();
        let mut nodes = BTreeMap::<(u64, &RosNode), (Vec<Guid>, Vec<Guid>)>::new();
        for (node_id, of_id) in &self.nodes {
            nodes.extend(of_id.iter().map(|node| ((*node_id, node), Default::default())));
        }
        for (endpoint, all) in &self.endpoints {
            let Some(Declared { node_id, node: Some(node), endpoint: told, .. }) = all.last() else {
                continue;
            };
            if *node == unassigned {
                continue;
            }
            let of_node = nodes.entry((*node_id, node)).or_default();
            let at = EndpointRef { session: id, id: *endpoint };
            for kind in kinds(told.kind) {
                match kind {
                    EndpointKind::Reader => of_node.0.push(at.guid(*kind)),
                    EndpointKind::Writer => of_node.1.push(at.guid(*kind)),
                }
            }
        }
        let graph = nodes.into_iter().map(|((_, node), (readers, writers))| GraphNode {
            node: node.clone(),
            readers,
            writers,
        });
        graph.collect()
    }
}

/// Returns the kinds of the DDS endpoints that an endpoint of Zenoh stands for.
fn kinds(kind: EntityKind) -> &'static [EndpointKind] {
    match kind {
        EntityKind::Publisher => &[EndpointKind::Writer],
        EntityKind::Subscription => &[EndpointKind::Reader],
        EntityKind::Server | EntityKind::Client => &[EndpointKind::Reader, EndpointKind::Writer],
    }
}

/// Returns the DDS endpoints that an endpoint of Zenoh stands for.
fn discovered(at: EndpointRef, endpoint: &TokenEndpoint) -> Vec<DiscoveredEndpoint> {
    let TokenEndpoint { kind, topic, qos, .. } = endpoint;
    let one = |kind: &EndpointKind| {
        let half = match (endpoint.kind, kind) {
            (EntityKind::Publisher | EntityKind::Subscription, _) => None,
            (EntityKind::Server, EndpointKind::Reader) | (EntityKind::Client, EndpointKind::Writer) => {
                Some(ServiceTopic::Request)
            }
            (EntityKind::Server, EndpointKind::Writer) | (EntityKind::Client, EndpointKind::Reader) => {
                Some(ServiceTopic::Reply)
            }
        };
        let (name, type_name) = half.map_or_else(|| topic.dds_topic(), |half| topic.dds_service(half));
        DiscoveredEndpoint {
            kind: *kind,
            guid: at.guid(*kind),
            topic: name,
            type_name,
            keyless: true,
            type_hash: Some(topic.type_hash().to_owned()),
            qos: qos.clone(),
        }
    };
    kinds(*kind).iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use sgc_testkit::Dice;
    use sgc_wire::Qos;

    use super::*;

    const HASH: &str = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18";
    const OWN: &str = "0a";

    fn id(text: &str) -> ZenohId {
        text.trim_start_matches('0').parse().unwrap()
    }

    fn proxy(n: u8) -> ZenohId {
        ZenohId::of_sgc([n; 10])
    }

    fn node(name: &str) -> RosNode {
        RosNode::new("/", name, None).unwrap()
    }

    fn node_token(session: ZenohId, node_id: u64, name: &str) -> String {
        let token = Token { domain: 0, session, node_id, node: Some(node(name)), endpoint: None };
        token.encode().unwrap()
    }

    fn token(session: ZenohId, node_name: &str, kind: EntityKind, id: u64, topic: &TopicInfo) -> String {
        let qos = Qos { history: sgc_wire::History::KeepLast(10), ..Qos::default() };
        let endpoint = Some(TokenEndpoint { kind, id, topic: topic.clone(), qos, backends: None });
        let node_id = node_name.len() as u64;
        Token { domain: 0, session, node_id, node: Some(node(node_name)), endpoint }.encode().unwrap()
    }

    fn topic(name: &str) -> TopicInfo {
        TopicInfo::new(name, "std_msgs::msg::dds_::String_", HASH).unwrap()
    }

    fn watched(ignores_proxies: bool) -> Graph {
        let mut graph = Graph::new(0, id(OWN), ignores_proxies);
        graph.watch();
        graph
    }

    /// Returns the topics that appeared and the GUIDs that vanished.
    fn endpoints(graph: &mut Graph) -> (Vec<String>, Vec<Guid>) {
        let (mut appeared, mut vanished) = (Vec::new(), Vec::new());
        for event in graph.endpoint_events() {
            match event {
                DiscoveryEvent::Appeared(endpoint) => appeared.push(endpoint.topic),
                DiscoveryEvent::Vanished { guid } => vanished.push(guid),
                other => panic!("{other:?}"),
            }
        }
        (appeared, vanished)
    }

    fn nodes(graph: &mut Graph) -> Vec<(Guid, Vec<GraphNode>)> {
        let of = |event| match event {
            DiscoveryEvent::Nodes { participant, nodes } => (participant, nodes),
            other => panic!("{other:?}"),
        };
        graph.node_events().into_iter().map(of).collect()
    }

    #[test]
    fn endpoints_appear_once_and_vanish_with_their_token() {
        let mut graph = watched(true);
        let publisher = token(id("b1"), "talker", EntityKind::Publisher, 10, &topic("/chatter"));
        let server = token(id("b1"), "talker", EntityKind::Server, 11, &topic("/add"));
        for _ in 0..2 {
            graph.declare(&publisher).unwrap();
        }
        graph.declare(&server).unwrap();
        let (appeared, vanished) = endpoints(&mut graph);
        assert_eq!(
            (appeared, vanished),
            (vec!["rt/chatter".into(), "rq/addRequest".into(), "rr/addReply".into()], vec![])
        );
        assert_eq!(endpoints(&mut graph), (vec![], vec![]));
        let at = |id_of: u64| EndpointRef { session: id("b1"), id: id_of };
        let guid = at(10).guid(EndpointKind::Writer);
        let talker = GraphNode {
            node: node("talker"),
            readers: vec![at(11).guid(EndpointKind::Reader)],
            writers: vec![guid, at(11).guid(EndpointKind::Writer)],
        };
        assert_eq!(nodes(&mut graph), [(participant(id("b1")), vec![talker])]);
        assert_eq!(guid.prefix(), participant(id("b1")).prefix());
        assert_eq!(graph.endpoint_with(&Gid::of_token(&publisher)), Some(at(10)));
        graph.undeclare(&publisher);
        graph.undeclare(&publisher);
        assert_eq!(endpoints(&mut graph), (vec![], vec![guid]));
        assert_eq!(graph.endpoint_with(&Gid::of_token(&publisher)), None);
        graph.undeclare(&server);
        assert_eq!(nodes(&mut graph), [(participant(id("b1")), vec![])]);
        assert_eq!(
            (graph.tokens(), graph.sessions.len(), graph.topics.len(), graph.gids.len()),
            (0, 0, 0, 0)
        );
    }

    #[test]
    fn an_endpoint_that_appears_and_vanishes_between_two_looks_is_no_event() {
        let mut graph = watched(true);
        let publisher = token(id("b1"), "talker", EntityKind::Publisher, 10, &topic("/chatter"));
        graph.declare(&publisher).unwrap();
        graph.undeclare(&publisher);
        assert_eq!((endpoints(&mut graph), nodes(&mut graph)), ((vec![], vec![]), vec![]));
    }

    #[test]
    fn an_endpoint_that_moves_to_another_node_stays() {
        let mut graph = watched(true);
        let before = token(id("b1"), "a", EntityKind::Publisher, 10, &topic("/chatter"));
        let after = token(id("b1"), "other", EntityKind::Publisher, 10, &topic("/chatter"));
        graph.declare(&before).unwrap();
        endpoints(&mut graph);
        nodes(&mut graph);
        graph.declare(&after).unwrap();
        graph.undeclare(&before);
        assert_eq!(endpoints(&mut graph), (vec![], vec![]));
        let told = nodes(&mut graph);
        assert_eq!(told[0].1.iter().map(|node| node.node.name()).collect::<Vec<_>>(), ["other"]);
        assert_eq!(graph.endpoint_with(&Gid::of_token(&before)), None);
        assert!(graph.endpoint_with(&Gid::of_token(&after)).is_some());
    }

    #[test]
    fn proxies_ignore_each_other_and_programs_do_not() {
        for ignores in [true, false] {
            let mut graph = watched(ignores);
            for session in [proxy(1), id("b1"), id(OWN)] {
                graph.declare(&token(session, "n", EntityKind::Subscription, 3, &topic("/a"))).unwrap();
            }
            let (appeared, _) = endpoints(&mut graph);
            // The own endpoint is never reported.
            assert_eq!(appeared.len(), if ignores { 1 } else { 2 });
            let matches = graph.matches(&topic("/a"), EntityKind::Subscription).count();
            assert_eq!(matches, if ignores { 1 } else { 3 });
            assert_eq!(graph.matches(&topic("/a"), EntityKind::Publisher).count(), 0);
            assert_eq!(graph.matches(&topic("/b"), EntityKind::Subscription).count(), 0);
        }
    }

    #[test]
    fn endpoints_without_a_node_are_reported_without_one() {
        let mut graph = watched(false);
        graph.declare(&token(proxy(1), UNASSIGNED, EntityKind::Publisher, 3, &topic("/a"))).unwrap();
        assert_eq!(endpoints(&mut graph).0, ["rt/a"]);
        assert_eq!(nodes(&mut graph), []);
    }

    #[test]
    fn hashes_are_those_of_programs_first() {
        let mut graph = watched(true);
        let with = |hash: &str| TopicInfo::new("/a", "t", hash).unwrap();
        assert_eq!((graph.hash_of("/a", "t"), graph.as_programs_have(&with("h1"))), (None, None));
        graph.declare(&token(proxy(1), "n", EntityKind::Server, 3, &with("h1"))).unwrap();
        assert_eq!((graph.hash_of("/a", "t"), graph.as_programs_have(&with("h1"))), (Some("h1"), None));
        graph.declare(&token(id("b1"), "n", EntityKind::Client, 3, &with("h2"))).unwrap();
        graph.declare(&token(id("b1"), "n", EntityKind::Client, 4, &with("h3"))).unwrap();
        graph
            .declare(&token(id("b1"), "n", EntityKind::Client, 5, &TopicInfo::new("/ab", "t", "h1").unwrap()))
            .unwrap();
        let own = |hash: &str| graph.as_programs_have(&with(hash)).map(|topic| topic.type_hash().to_owned());
        assert_eq!(own("h1").as_deref(), Some("h2"));
        assert_eq!(own("h3").as_deref(), Some("h3"), "the own one, if a program has it");
    }

    #[test]
    fn the_only_publisher_of_a_session_is_found_without_its_id() {
        let mut graph = watched(true);
        graph.declare(&token(id("b1"), "n", EntityKind::Publisher, 3, &topic("/a"))).unwrap();
        let only = Some(EndpointRef { session: id("b1"), id: 3 });
        assert_eq!(graph.only_publisher(&topic("/a"), id("b1")), only);
        assert_eq!(graph.only_publisher(&topic("/a"), id("b2")), None);
        graph.declare(&token(id("b1"), "n", EntityKind::Publisher, 4, &topic("/a"))).unwrap();
        assert_eq!(graph.only_publisher(&topic("/a"), id("b1")), None);
    }

    #[test]
    fn tokens_are_bounded() {
        let mut graph = watched(true);
        let session = |n: usize| ZenohId::of_sgc([n as u8; 10]).without_mark();
        let declare = |graph: &mut Graph, n: usize, id: u64| {
            graph.declare(&token(session(n), "n", EntityKind::Publisher, id, &topic("/a")))
        };
        for id in 0..SESSION_TOKENS_MAX as u64 {
            declare(&mut graph, 1, id).unwrap();
        }
        assert_eq!(declare(&mut graph, 1, u64::from(u16::MAX)), Err(GraphError::SessionFull));
        assert_eq!(graph.declare(&node_token(session(1), 0, "n")), Err(GraphError::SessionFull));
        for n in 2..=TOKENS_MAX / SESSION_TOKENS_MAX {
            (0..SESSION_TOKENS_MAX as u64).for_each(|id| declare(&mut graph, n, id).unwrap());
        }
        assert_eq!(declare(&mut graph, 9, 0), Err(GraphError::Full));
        assert_eq!(graph.declare(&node_token(session(9), 0, "n")), Err(GraphError::Full));
        graph.undeclare(&token(session(1), "n", EntityKind::Publisher, 0, &topic("/a")));
        declare(&mut graph, 9, 0).unwrap();

        let mut graph = watched(true);
        for n in 0..ENDPOINT_TOKENS_MAX {
            let node = "n".repeat(n + 1);
            graph.declare(&token(session(1), &node, EntityKind::Publisher, 0, &topic("/a"))).unwrap();
        }
        let one_more = token(session(1), "another", EntityKind::Publisher, 0, &topic("/a"));
        assert_eq!(graph.declare(&one_more), Err(GraphError::EndpointFull));
        let far = token(session(1), "n", EntityKind::Publisher, ENDPOINT_ID_MAX + 1, &topic("/a"));
        assert_eq!(graph.declare(&far), Err(GraphError::EndpointId(ENDPOINT_ID_MAX + 1)));
        let elsewhere = Token { domain: 1, ..Token::decode(&one_more).unwrap() }.encode().unwrap();
        assert_eq!(graph.declare(&elsewhere), Err(GraphError::Domain(1)));
    }

    /// A watcher that only sees events knows the same as one that looks at everything.
    #[test]
    fn events_add_up_to_the_graph() {
        for seed in 0..50 {
            let mut dice = Dice::new(seed);
            let mut graph = watched(dice.below(2) == 0);
            let (mut known, mut known_nodes) = (BTreeMap::new(), BTreeMap::new());
            let mut declared = BTreeSet::new();
            let sessions = [proxy(1), id("b1"), id("b2"), id(OWN)];
            for _ in 0..300 {
                let session = *dice.pick(&sessions).as_ref().unwrap();
                let name = dice.pick(&["a", "bb", UNASSIGNED]).unwrap();
                let text = match dice.below(3) {
                    0 => node_token(session, name.len() as u64, name),
                    _ => {
                        let kind = dice.pick(&EntityKind::ALL).unwrap();
                        token(
                            session,
                            name,
                            kind,
                            dice.below(4) as u64,
                            &topic(dice.pick(&["/a", "/b"]).unwrap()),
                        )
                    }
                };
                if dice.below(2) == 0 {
                    if graph.declare(&text).is_ok() {
                        declared.insert(text);
                    }
                } else {
                    graph.undeclare(&text);
                    declared.remove(&text);
                }
                assert_eq!(graph.tokens(), declared.len());
                if dice.below(3) > 0 {
                    continue;
                }
                for event in graph.endpoint_events().into_iter().chain(graph.node_events()) {
                    match event {
                        DiscoveryEvent::Appeared(endpoint) => {
                            assert!(known.insert(endpoint.guid, endpoint).is_none(), "it appears once");
                        }
                        DiscoveryEvent::Vanished { guid } => assert!(known.remove(&guid).is_some()),
                        DiscoveryEvent::Nodes { participant, nodes } => {
                            drop(known_nodes.insert(participant, nodes))
                        }
                        other => panic!("{other:?}"),
                    }
                }
                known_nodes.retain(|_, nodes| !nodes.is_empty());
                let mut fresh = graph_of(&graph);
                assert_eq!(known, fresh.0);
                fresh.1.retain(|_, nodes| !nodes.is_empty());
                assert_eq!(known_nodes, fresh.1);
            }
            declared.iter().for_each(|text| _ = graph.undeclare(text));
            assert_eq!((graph.sessions.len(), graph.topics.len(), graph.gids.len()), (0, 0, 0));
        }
    }

    /// Returns the endpoints and nodes that a graph would report to a new watcher.
    fn graph_of(graph: &Graph) -> (BTreeMap<Guid, DiscoveredEndpoint>, BTreeMap<Guid, Vec<GraphNode>>) {
        let (mut endpoints, mut nodes) = (BTreeMap::new(), BTreeMap::new());
        for (session, known) in &graph.sessions {
            if *session == graph.own || graph.is_ignored(*session) {
                continue;
            }
            nodes.insert(participant(*session), known.graph(*session));
            for (id, all) in &known.endpoints {
                let at = EndpointRef { session: *session, id: *id };
                endpoints.extend(
                    discovered(at, &all.last().unwrap().endpoint).into_iter().map(|one| (one.guid, one)),
                );
            }
        }
        (endpoints, nodes)
    }
}
