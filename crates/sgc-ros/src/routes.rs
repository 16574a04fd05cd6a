//! The route machine: which local topics are shared, which remote ones are brought here, and what has to
//! exist on the local network for that.
//!
//! Pure. Discovery, the endpoint's events and the time go in; [`Command`]s come out, for the driver to carry out on
//! its endpoint and its local network. It never touches either.
//!
//! A *share route* is one shared topic with one type: it exists from the first local writer of that type
//! until the last one has been gone for a while. A *use route* is one entry of a followed owner's catalogue
//! that a rule asks for: it exists from the catalogue that lists it until one that does not. A *token route* is a use
//! route whose one entry comes with the grant, from an owner of another fleet whose catalogue this node cannot read.

mod command;
mod consumers;
mod graph;
mod naming;
mod problems;
mod publish;
mod reconfigure;
mod services;
mod settling;
mod shares;
mod tokens;
mod uses;
mod view;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_endpoint::{RefusedBy, ShareSpec};
use sgc_trust::{FleetSecret, Policy, Suite};
use sgc_wire::{
    Catalogue, CatalogueEntry, Class, Kind, Metadata, Name, NodeId, PayloadEncoding, PayloadForm, Qos,
    RosNode, SinkId, SourceId,
};

use crate::names::ros_type;
use crate::network::{DiscoveredEndpoint, DiscoveryEvent, EndpointKind, EndpointSpec, Guid, ServiceSpec};
use crate::qos::QosOverride;

use problems::{Cause, Problems};
use settling::Settling;

pub use command::{Command, Problem};
pub use consumers::Consumers;
pub use naming::{
    GLOBAL_TOPICS, LITERAL_TOPICS, Naming, ROUTES_PER_WILDCARD_MAX, Rename, is_for_wildcards, is_pattern,
    matches,
};
pub use settling::REDISCOVERY_HOLD;
pub use view::{OfferView, ShareRouteView, ShareView, UseRouteView, UseView};

/// How long a share outlives its last local writer, so that a restarted program finds its subscribers.
pub const WRITERLESS_HOLD: Duration = Duration::from_secs(2);
/// How long a local reader outlives its last remote sink, so that a restarted router costs no sample.
pub const SINKLESS_HOLD: Duration = Duration::from_secs(10);
/// How long a local writer outlives the way to its owner, so that a restarted router does not make the far
/// network vanish from the local graph.
pub const UNREACHABLE_HOLD: Duration = Duration::from_secs(10);
/// Interfaces of an owner that may answer to one rule: types and metadata of one topic.
const ENTRIES_PER_RULE_MAX: usize = 8;
/// Local endpoints remembered.
const LOCAL_ENDPOINTS_MAX: usize = 65_536;

/// What the user shares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareRule {
    /// Metadata, with the name or pattern of what it shares as that is called here; an empty type means whatever type
    /// local writers have.
    pub metadata: Metadata,
    /// What is left out, and what the rest is called for others.
    pub naming: Naming,
    /// Who may join.
    pub policy: Policy,
    /// How payloads are protected.
    pub suite: Suite,
    /// Class of its traffic.
    pub class: Class,
    /// How much of it goes out.
    pub shaping: Shaping,
    /// Policies in place of its publishers'.
    pub qos: QosOverride,
    /// Whether it has a connection of its own to the next node.
    pub dedicated: bool,
}

/// How much of a topic goes on. Nothing is set by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shaping {
    /// The least time between two messages: the newest goes, the others are left out.
    pub interval: Option<Duration>,
    /// Most bits a second. What is best effort gives way to what is newer, what is reliable waits.
    pub bits_per_s: Option<u64>,
    /// How old a best-effort message may be when it leaves.
    pub max_age: Option<Duration>,
    /// How messages are compressed when they leave, if that makes them shorter.
    pub compression: PayloadEncoding,
    /// What messages are written in when they leave.
    pub form: PayloadForm,
}

/// Which way messages go.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Direction {
    /// From the owner's network to this one.
    #[default]
    Bring,
    /// From this network to the owner's.
    Publish,
}

/// What the user brings here, or publishes on elsewhere.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UseRule {
    /// Which way.
    pub direction: Direction,
    /// Whose it is.
    pub owner: NodeId,
    /// The owner's name, for people.
    pub owner_name: String,
    /// What kind of interface it asks for.
    pub kind: Kind,
    /// Absolute ROS topic or pattern, as its owner calls it.
    pub topic: String,
    /// What is left out, and what the rest is called here.
    pub naming: Naming,
    /// What the names of frames in tf messages get in front.
    pub frame_prefix: Option<String>,
    /// ROS type; `None` for whatever the owner shares.
    pub type_name: Option<String>,
    /// The name that a token leads to, and what it says of it; the catalogue is not looked at then.
    pub token: Option<(Name, Metadata)>,
    /// Class of what this node publishes on it; `None` for that of the share.
    pub class: Option<Class>,
    /// How much of it goes on, whichever way.
    pub shaping: Shaping,
    /// Policies of the writers here in place of the far publishers'.
    pub qos: QosOverride,
    /// Whether it has a connection of its own to the next node.
    pub dedicated: bool,
}

impl ShareRule {
    /// Whether those who may publish on it call it.
    fn is_service(&self) -> bool {
        self.metadata.kind == Kind::Service
    }

    /// Whether it is there for what others publish, without anybody here.
    fn is_inbound(&self) -> bool {
        !self.is_service() && !self.policy.publish.is_empty()
    }
}

impl UseRule {
    fn is_service(&self) -> bool {
        self.kind == Kind::Service
    }

    fn is_of_catalogue(&self, owner: &NodeId) -> bool {
        self.owner == *owner && self.token.is_none()
    }

    /// Whether it asks for the same as another, whatever the type.
    fn is_same_place(&self, other: &Self) -> bool {
        let name = |rule: &Self| rule.token.as_ref().map(|(name, _)| *name);
        self.direction == other.direction
            && self.owner == other.owner
            && self.kind == other.kind
            && self.topic == other.topic
            && name(self) == name(other)
    }
}

/// Where a route stands, for status.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteStatus {
    /// `"share"`, `"use"`, `"publish"`, `"serve"` or `"call"`.
    pub direction: &'static str,
    /// ROS name of the topic or the service.
    pub topic: String,
    /// ROS type, once it is known.
    pub type_name: Option<String>,
    /// Name, once it is known.
    pub name: Option<Name>,
    /// Owner's node name.
    pub owner: String,
    /// What it is doing, or waiting for.
    pub state: String,
}

#[derive(Debug)]
struct ShareRoute {
    name: Name,
    rule: usize,
    /// What it is called on the local network.
    local_name: String,
    type_name: String,
    keyless: bool,
    writers: BTreeMap<Guid, DiscoveredEndpoint>,
    own: BTreeMap<Guid, OwnSource>,
    sinks: BTreeSet<SinkId>,
    reader: Option<EndpointSpec>,
    /// For what others publish on it.
    writer: Option<EndpointSpec>,
    /// If it is a service: what others call its servers with, which are its writers here.
    client: Option<ServiceSpec>,
    writerless_until: Option<Instant>,
    sinkless_until: Option<Instant>,
}

/// What publishes for a local writer.
#[derive(Clone, Debug)]
struct OwnSource {
    source: SourceId,
    /// What the writer offers, as far as it is carried.
    qos: Qos,
    /// Since when the writer is gone. A volatile one's source is kept a while: for what it wrote last, and for the
    /// program that is restarted, whose subscribers then notice nothing.
    gone: Option<Instant>,
    /// Whether the writer's liveliness lease ran out.
    is_lapsed: bool,
}

#[derive(Debug)]
struct UseRoute {
    rule: usize,
    /// What it is called on the local network.
    local_name: String,
    entry: CatalogueEntry,
    granted: bool,
    /// False while its owner, which started anew, does not list it (yet).
    is_listed: bool,
    refused: Option<RefusedBy>,
    /// Open writers, and what they offer.
    writers: BTreeMap<Option<SourceId>, EndpointSpec>,
    /// Whose nodes they were said to be.
    nodes: BTreeMap<Option<SourceId>, RosNode>,
    /// If it publishes: the local writers, and the reader of what they write.
    local: BTreeMap<Guid, DiscoveredEndpoint>,
    reader: Option<EndpointSpec>,
    /// If it is a service: what local clients call.
    server: Option<ServiceSpec>,
    unreachable_until: Option<Instant>,
}

impl ShareRoute {
    /// Whether writers of this topic and DDS type belong to it.
    fn fits(&self, local_name: &str, type_name: &str) -> bool {
        self.local_name == local_name && self.type_name == type_name
    }

    /// Two local publishers that have different definitions of its type.
    fn hashes_differ(&self) -> Option<Problem> {
        let mut hashes = self.writers.values().filter_map(|writer| writer.type_hash.as_ref());
        let one = hashes.next()?;
        let other = hashes.find(|hash| *hash != one)?;
        let (mut first, mut second) = (one.clone(), other.clone());
        // In one order, whichever publisher came first.
        if first > second {
            std::mem::swap(&mut first, &mut second);
        }
        let (topic, type_name) = (self.local_name.clone(), ros_type(&self.type_name));
        Some(Problem::ShareHash { topic, type_name, first, second })
    }

    /// A share with this first writer, or with none.
    fn begin(
        name: Name,
        rule: usize,
        share: &ShareRule,
        local_name: &str,
        type_name: &str,
        keyless: bool,
        writer: Option<DiscoveredEndpoint>,
    ) -> (ShareSpec, Self) {
        let spec = ShareSpec {
            metadata: share.metadata_of(local_name, &ros_type(type_name)),
            policy: share.policy.clone(),
            suite: share.suite,
            class: share.class,
            keyless,
            type_hash: writer.as_ref().and_then(|w| w.type_hash.clone()),
            qos: writer.as_ref().map(|w| share.qos.apply(&w.qos)).unwrap_or_default(),
            sources: Vec::new(),
        };
        let route = Self {
            name,
            rule,
            local_name: local_name.to_owned(),
            type_name: type_name.to_owned(),
            keyless,
            own: BTreeMap::new(),
            writers: writer.into_iter().map(|w| (w.guid, w)).collect(),
            sinks: BTreeSet::new(),
            reader: None,
            writer: None,
            client: None,
            writerless_until: None,
            sinkless_until: None,
        };
        (spec, route)
    }
}

impl UseRoute {
    fn new(rule: usize, local_name: String, entry: CatalogueEntry) -> Self {
        Self {
            rule,
            local_name,
            entry,
            granted: false,
            is_listed: true,
            refused: None,
            writers: BTreeMap::new(),
            nodes: BTreeMap::new(),
            local: BTreeMap::new(),
            reader: None,
            server: None,
            unreachable_until: None,
        }
    }
}

/// A name that a token leads to, joined.
#[derive(Debug)]
struct TokenJoin {
    rule: usize,
    transient_local: bool,
    refused: Option<RefusedBy>,
}

/// The machine.
pub struct Routes<R> {
    secret: FleetSecret,
    node: NodeId,
    rng: R,
    share_rules: Vec<ShareRule>,
    use_rules: Vec<UseRule>,
    endpoints: BTreeMap<Guid, DiscoveredEndpoint>,
    /// The endpoints of each local participant that belong to a node, and which.
    nodes: BTreeMap<Guid, BTreeMap<Guid, RosNode>>,
    shares: BTreeMap<Name, ShareRoute>,
    uses: BTreeMap<Name, UseRoute>,
    /// Names of tokens; there is a route besides from the first grant on.
    tokens: BTreeMap<Name, TokenJoin>,
    /// What followed owners said last, for rules that come later.
    catalogues: BTreeMap<NodeId, Catalogue>,
    /// Owners that are out of reach or refuse, for status.
    owners: BTreeMap<NodeId, String>,
    /// Owners that were out of reach, or have just come back.
    settling: BTreeMap<NodeId, Settling>,
    problems: Problems,
    /// Something is not shared or brought for the sake of a route that runs.
    waits: bool,
    /// A route has ended since that was looked at.
    freed: bool,
    /// Local consumers, or what they use, may be others than before.
    consumers_changed: bool,
    commands: VecDeque<Command>,
}

impl<R: RngCore> Routes<R> {
    /// Routes for these rules; `node` is this node, `rng` gives source ids.
    pub fn new(
        secret: FleetSecret,
        node: NodeId,
        share_rules: Vec<ShareRule>,
        use_rules: Vec<UseRule>,
        rng: R,
    ) -> Self {
        let mut routes = Self {
            secret,
            node,
            rng,
            share_rules,
            use_rules,
            endpoints: BTreeMap::new(),
            nodes: BTreeMap::new(),
            shares: BTreeMap::new(),
            uses: BTreeMap::new(),
            tokens: BTreeMap::new(),
            catalogues: BTreeMap::new(),
            owners: BTreeMap::new(),
            settling: BTreeMap::new(),
            problems: Problems::default(),
            waits: false,
            freed: false,
            consumers_changed: false,
            commands: VecDeque::new(),
        };
        routes.join_tokens();
        routes.begin_inbound();
        routes
    }

    /// Names of shares that begin later come from this secret; running ones keep theirs.
    pub fn set_secret(&mut self, secret: FleetSecret) {
        self.secret = secret;
    }

    /// The local graph changed.
    pub fn handle_discovery(&mut self, now: Instant, event: DiscoveryEvent) {
        self.consumers_changed = true;
        match event {
            DiscoveryEvent::Appeared(endpoint) => {
                if self.endpoints.len() >= LOCAL_ENDPOINTS_MAX {
                    return self.report(Cause::Network, Problem::TooManyEndpoints);
                }
                let guid = endpoint.guid;
                if let Some(old) = self.endpoints.insert(guid, endpoint.clone()) {
                    self.writer_gone(now, &old);
                }
                if self.service_end_there(&endpoint) {
                    return;
                }
                match endpoint.kind {
                    EndpointKind::Writer => self.writer_there(endpoint),
                    EndpointKind::Reader => self.check_local(&endpoint),
                }
            }
            DiscoveryEvent::Vanished { guid } => {
                if let Some(endpoint) = self.endpoints.remove(&guid) {
                    self.service_end_gone(now, &endpoint);
                    self.settle(Cause::Network, BTreeSet::new());
                    self.settle(Cause::Endpoint(guid), BTreeSet::new());
                    self.settle(Cause::Unshared(guid), BTreeSet::new());
                    self.writer_gone(now, &endpoint);
                }
            }
            DiscoveryEvent::Liveliness { guid, is_alive } => self.handle_liveliness(guid, is_alive),
            DiscoveryEvent::HistoryDepth { guid, depth } => self.handle_depth(&guid, depth),
            DiscoveryEvent::Nodes { participant, nodes } => self.handle_nodes(participant, nodes),
        }
    }

    /// Time passed.
    pub fn handle_timeout(&mut self, now: Instant) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        for name in self.shares.keys().copied().collect::<Vec<_>>() {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            if due(share.writerless_until) {
                self.drop_share(name);
            } else {
                let gone = |own: &OwnSource| due(own.gone.map(|at| at + WRITERLESS_HOLD));
                let sinkless = share.sinkless_until.take_if(|at| *at <= now).is_some();
                let sources = share.own.len();
                share.own.retain(|_, own| !gone(own));
                if sinkless || share.own.len() < sources {
                    self.refresh_share(name);
                }
            }
        }
        self.owners_have_settled(now);
        for (name, route) in &mut self.uses {
            if due(route.unreachable_until) {
                route.unreachable_until = None;
                route.nodes.clear();
                for source in std::mem::take(&mut route.writers).into_keys() {
                    self.commands.push_back(Command::CloseWriter { name: *name, source });
                }
                if route.reader.take().is_some() {
                    self.commands.push_back(Command::CloseReader { name: *name });
                }
                if route.server.take().is_some() {
                    self.commands.push_back(Command::CloseServer { name: *name });
                }
            }
        }
        self.reconsider();
    }

    /// The next thing to do.
    pub fn poll_command(&mut self) -> Option<Command> {
        if self.commands.is_empty() {
            self.check_stale();
        }
        self.commands.pop_front()
    }

    /// When time matters next.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let shares = self.shares.values().flat_map(|s| [s.writerless_until, s.sinkless_until]);
        let gone = self.shares.values().flat_map(|s| s.own.values()).filter_map(|own| own.gone);
        let uses = self.uses.values().map(|u| u.unreachable_until);
        let owners = self.settling.keys().map(|owner| self.settles_at(owner));
        let gone = gone.map(|at| Some(at + WRITERLESS_HOLD));
        shares.chain(uses).chain(owners).chain(gone).flatten().min()
    }

    /// The ROS topic behind a name that is shared or used here.
    pub fn topic_of(&self, name: &Name) -> Option<&str> {
        let share = self.shares.get(name).map(|s| s.local_name.as_str());
        share.or_else(|| {
            let token = || Some(self.use_rules[self.tokens.get(name)?.rule].topic.as_str());
            self.uses.get(name).map(|u| u.local_name.as_str()).or_else(token)
        })
    }

    /// Whether the user wants a connection of its own for a name that is shared or used here.
    pub fn is_dedicated(&self, name: &Name) -> bool {
        let share = self.shares.get(name).map(|share| self.share_rules[share.rule].dedicated);
        let used = self.uses.get(name).map(|route| self.use_rules[route.rule].dedicated);
        share.or(used).unwrap_or(false)
    }

    /// Where every rule stands.
    pub fn status(&self) -> Vec<RouteStatus> {
        let mut all = Vec::new();
        for (index, rule) in self.share_rules.iter().enumerate() {
            let routes: Vec<_> = self.shares.values().filter(|s| s.rule == index).collect();
            let status = |topic: &str, type_name, name, state| RouteStatus {
                direction: if rule.is_service() { "serve" } else { "share" },
                topic: topic.to_owned(),
                type_name,
                name,
                owner: rule.metadata.owner.clone(),
                state,
            };
            if routes.is_empty() {
                let wanted = (!rule.metadata.type_name.is_empty()).then(|| rule.metadata.type_name.clone());
                let awaited = if rule.is_service() { "server" } else { "publisher" };
                all.push(status(
                    &rule.metadata.ros_name,
                    wanted,
                    None,
                    format!("waits for a local {awaited}"),
                ));
            }
            for route in routes {
                if rule.is_service() {
                    let (servers, callers) = (route.writers.len(), route.sinks.len());
                    let state = format!("{servers} local servers, {callers} remote nodes may call");
                    let type_name = Some(ros_type(&route.type_name));
                    all.push(status(&route.local_name, type_name, Some(route.name), state));
                    continue;
                }
                let state = format!(
                    "{} local publishers, {} remote subscribers, {}",
                    route.writers.len(),
                    route.sinks.len(),
                    if route.reader.is_some() { "reading" } else { "not reading: nobody subscribes" }
                );
                let (local_name, type_name) = (&route.local_name, ros_type(&route.type_name));
                let called = rule.naming.renamed(&rule.metadata.ros_name, local_name);
                let state = also_called(local_name, "shared as", &called) + &state;
                all.push(status(local_name, Some(type_name), Some(route.name), state));
            }
        }
        for (index, rule) in self.use_rules.iter().enumerate() {
            let routes: Vec<_> = self.uses.iter().filter(|(_, u)| u.rule == index).collect();
            let status = |topic: &str, type_name, name, state| RouteStatus {
                direction: match rule.direction {
                    _ if rule.is_service() => "call",
                    Direction::Publish => "publish",
                    Direction::Bring => "use",
                },
                topic: topic.to_owned(),
                type_name,
                name,
                owner: rule.owner_name.clone(),
                state,
            };
            if let Some((name, metadata)) = rule.token.as_ref().filter(|_| routes.is_empty()) {
                let refused = self.tokens.get(name).and_then(|token| token.refused);
                let state = match refused {
                    Some(by) => format!("refused: {by}"),
                    None => "waits for the owner's grant".into(),
                };
                all.push(status(&rule.topic, Some(metadata.type_name.clone()), Some(*name), state));
            } else if routes.is_empty() {
                let state = match self.owners.get(&rule.owner) {
                    Some(state) => format!("{} {state}", rule.owner_name),
                    None if rule.is_pattern() => {
                        format!("{} lists nothing that matches (yet)", rule.owner_name)
                    }
                    None if rule.is_service() => {
                        format!("{} has no such service for this node (yet)", rule.owner_name)
                    }
                    None if rule.direction == Direction::Publish => {
                        format!("{} does not let this node publish on it (yet)", rule.owner_name)
                    }
                    None => format!("{} does not share it with this node (yet)", rule.owner_name),
                };
                all.push(status(&rule.topic, rule.type_name.clone(), None, state));
            }
            for (name, route) in routes {
                let state = match (route.granted, route.refused) {
                    (true, _) if rule.is_service() => "granted".into(),
                    (true, _) if rule.direction == Direction::Publish => {
                        format!("granted, {} local publishers", route.local.len())
                    }
                    (true, _) => format!("granted, {} local writers", route.writers.len()),
                    (false, Some(by)) => format!("refused: {by}"),
                    (false, None) => "waits for the owner's grant".into(),
                };
                let Metadata { ros_name, type_name, .. } = &route.entry.metadata;
                let there = format!("{} calls it", rule.owner_name);
                let state = also_called(&route.local_name, &there, ros_name) + &state;
                all.push(status(&route.local_name, Some(type_name.clone()), Some(*name), state));
            }
        }
        all
    }
}

/// What to say if it has another name elsewhere.
fn also_called(here: &str, verb: &str, there: &str) -> String {
    if here == there { String::new() } else { format!("{verb} {there}, ") }
}

/// Returns `true` if the reader of a topic is to ask these writers for the hashes of keys: if all of them match it then.
fn asks_key_hash<'a>(keyless: bool, mut writers: impl Iterator<Item = &'a Guid>) -> bool {
    !keyless && !writers.any(Guid::is_of_cyclone)
}

/// A reader need not be made anew for a little more or less depth.
fn same_reader(a: Option<&EndpointSpec>, b: Option<&EndpointSpec>) -> bool {
    let key = |s: &EndpointSpec| {
        (
            (s.qos.reliability, s.qos.durability, s.qos.partitions.clone()),
            (s.keyless, s.asks_key_hash, s.type_name.clone()),
        )
    };
    a.map(key) == b.map(key)
}

/// A fresh source for a local writer, known as its by who knows earlier ones.
fn source_of(secret: &FleetSecret, writer: &Guid, rng: &mut impl RngCore) -> SourceId {
    let mut random = [0; 8];
    rng.fill_bytes(&mut random);
    SourceId::from_publisher(secret.publisher_tag(&writer.0), random)
}

fn describe(qos: &Qos) -> String {
    format!("{:?}, {:?}, {:?}", qos.reliability, qos.durability, qos.representations)
}
