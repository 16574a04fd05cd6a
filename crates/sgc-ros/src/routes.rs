//! The route machine: decides which local topics are shared, which remote topics are brought here, and which
//! endpoints the local network needs for that.
//!
//! The machine is pure. Discovery, the endpoint's events and the time go in. [`Command`]s come out, which the driver
//! carries out on its endpoint and its local network.
//!
//! A *share route* is one shared topic with one type. It exists from the first local writer of that type until the
//! last one has been gone for a while. A *use route* is one entry of a followed owner's catalogue that a rule asks
//! for. It exists while the catalogue lists the entry. A *token route* is a use route whose entry comes with the
//! grant, from an owner of another fleet whose catalogue this node cannot read.

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

/// Time for which a share outlives its last local writer, so that a restarted program finds its subscribers.
pub const WRITERLESS_HOLD: Duration = Duration::from_secs(2);
/// Time for which a local reader outlives its last remote sink, so that a router restart costs no sample.
pub const SINKLESS_HOLD: Duration = Duration::from_secs(10);
/// Time for which a local writer outlives the path to its owner, so that the far network stays in the local graph
/// when a router restarts.
pub const UNREACHABLE_HOLD: Duration = Duration::from_secs(10);
/// Most interfaces of an owner that match one rule: types and metadata of one topic.
const ENTRIES_PER_RULE_MAX: usize = 8;
/// Most local endpoints that are tracked.
const LOCAL_ENDPOINTS_MAX: usize = 65_536;

/// A `[[share]]` rule.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareRule {
    /// The metadata, with the local name or pattern. An empty type stands for any type of local writers.
    pub metadata: Metadata,
    /// The exceptions, and the name for others.
    pub naming: Naming,
    /// The policy that decides who may join.
    pub policy: Policy,
    /// The cipher suite of payloads.
    pub suite: Suite,
    /// The class of the packets.
    pub class: Class,
    /// The limits of the traffic.
    pub shaping: Shaping,
    /// Policies that replace those of the publishers.
    pub qos: QosOverride,
    /// `true` if the traffic has a lane of its own.
    pub dedicated: bool,
}

/// The shaping of a topic, without limits by default.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Shaping {
    /// Shortest time between two messages. Only the newest message is sent; others are dropped.
    pub interval: Option<Duration>,
    /// Most bits per second. Best-effort messages give way to newer ones, reliable ones wait.
    pub bits_per_s: Option<u64>,
    /// Most age of a best-effort message when it leaves.
    pub max_age: Option<Duration>,
    /// The compression of outgoing messages, used if it shortens them.
    pub compression: PayloadEncoding,
    /// The form of outgoing messages.
    pub form: PayloadForm,
}

/// The direction of messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Direction {
    /// From the owner's network to this one.
    #[default]
    Bring,
    /// From this network to the owner's.
    Publish,
}

/// A `[[use]]` rule.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UseRule {
    /// The direction of messages.
    pub direction: Direction,
    /// The owner of the interface.
    pub owner: NodeId,
    /// The owner's name, for people.
    pub owner_name: String,
    /// The kind of interface.
    pub kind: Kind,
    /// The absolute ROS topic or pattern by the owner's names.
    pub topic: String,
    /// The exceptions, and the name here.
    pub naming: Naming,
    /// A prefix for the names of frames in tf messages.
    pub frame_prefix: Option<String>,
    /// The ROS type; `None` for any type that the owner shares.
    pub type_name: Option<String>,
    /// The name and metadata from a token, which replace the catalogue.
    pub token: Option<(Name, Metadata)>,
    /// The class of messages that this node publishes; `None` for that of the share.
    pub class: Option<Class>,
    /// The limits of the traffic in either direction.
    pub shaping: Shaping,
    /// Policies of the writers here that replace those of the far publishers.
    pub qos: QosOverride,
    /// `true` if the traffic has a lane of its own.
    pub dedicated: bool,
}

impl ShareRule {
    /// Returns `true` for a service, whose callers are the nodes that may publish.
    fn is_service(&self) -> bool {
        self.metadata.kind == Kind::Service
    }

    /// Returns `true` if the share exists for messages of others, even without a local publisher.
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

    /// Returns `true` if both rules ask for the same interface, whatever its type.
    fn is_same_place(&self, other: &Self) -> bool {
        let name = |rule: &Self| rule.token.as_ref().map(|(name, _)| *name);
        self.direction == other.direction
            && self.owner == other.owner
            && self.kind == other.kind
            && self.topic == other.topic
            && name(self) == name(other)
    }
}

/// The state of a route, for status.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteStatus {
    /// `"share"`, `"use"`, `"publish"`, `"serve"` or `"call"`.
    pub direction: &'static str,
    /// The ROS name of the topic or service.
    pub topic: String,
    /// The ROS type, once it is known.
    pub type_name: Option<String>,
    /// The name, once it is known.
    pub name: Option<Name>,
    /// The owner's node name.
    pub owner: String,
    /// The activity of the route, or the reason why it waits.
    pub state: String,
}

#[derive(Debug)]
struct ShareRoute {
    name: Name,
    rule: usize,
    /// The name on the local network.
    local_name: String,
    type_name: String,
    keyless: bool,
    writers: BTreeMap<Guid, DiscoveredEndpoint>,
    own: BTreeMap<Guid, OwnSource>,
    sinks: BTreeSet<SinkId>,
    reader: Option<EndpointSpec>,
    /// The writer for messages that others publish on the share.
    writer: Option<EndpointSpec>,
    /// The client that calls local servers, if it is a service. The servers are the route's writers.
    client: Option<ServiceSpec>,
    writerless_until: Option<Instant>,
    sinkless_until: Option<Instant>,
}

/// The source that publishes for a local writer.
#[derive(Clone, Debug)]
struct OwnSource {
    source: SourceId,
    /// The writer's offer, as far as it is carried.
    qos: Qos,
    /// The time at which the writer vanished. The source of a volatile writer is kept for a while: for its last
    /// messages, and so that subscribers of a restarted program notice nothing.
    gone: Option<Instant>,
    /// `true` if the writer's liveliness lease has expired.
    is_lapsed: bool,
}

#[derive(Debug)]
struct UseRoute {
    rule: usize,
    /// The name on the local network.
    local_name: String,
    entry: CatalogueEntry,
    granted: bool,
    /// `false` while the owner, whose node restarted, does not list the entry yet.
    is_listed: bool,
    refused: Option<RefusedBy>,
    /// Open writers and their specs.
    writers: BTreeMap<Option<SourceId>, EndpointSpec>,
    /// The nodes that the writers were announced as.
    nodes: BTreeMap<Option<SourceId>, RosNode>,
    /// The local writers and the reader of their messages, if the route publishes.
    local: BTreeMap<Guid, DiscoveredEndpoint>,
    reader: Option<EndpointSpec>,
    /// The server that local clients call, if it is a service.
    server: Option<ServiceSpec>,
    unreachable_until: Option<Instant>,
}

impl ShareRoute {
    /// Returns `true` if writers of this topic and DDS type belong to the route.
    fn fits(&self, local_name: &str, type_name: &str) -> bool {
        self.local_name == local_name && self.type_name == type_name
    }

    /// Returns a problem if two local publishers have different definitions of the type.
    fn hashes_differ(&self) -> Option<Problem> {
        let mut hashes = self.writers.values().filter_map(|writer| writer.type_hash.as_ref());
        let one = hashes.next()?;
        let other = hashes.find(|hash| *hash != one)?;
        let (mut first, mut second) = (one.clone(), other.clone());
        // The order does not depend on which publisher came first.
        if first > second {
            std::mem::swap(&mut first, &mut second);
        }
        let (topic, type_name) = (self.local_name.clone(), ros_type(&self.type_name));
        Some(Problem::ShareHash { topic, type_name, first, second })
    }

    /// Creates a share with a first writer, or without one.
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

/// A joined name from a token.
#[derive(Debug)]
struct TokenJoin {
    rule: usize,
    transient_local: bool,
    refused: Option<RefusedBy>,
}

/// The route machine.
pub struct Routes<R> {
    secret: FleetSecret,
    node: NodeId,
    rng: R,
    share_rules: Vec<ShareRule>,
    use_rules: Vec<UseRule>,
    endpoints: BTreeMap<Guid, DiscoveredEndpoint>,
    /// The endpoints of each local participant that belong to a ROS 2 node, with that node.
    nodes: BTreeMap<Guid, BTreeMap<Guid, RosNode>>,
    shares: BTreeMap<Name, ShareRoute>,
    uses: BTreeMap<Name, UseRoute>,
    /// The joined names of tokens. From the first grant on a use route exists, too.
    tokens: BTreeMap<Name, TokenJoin>,
    /// The last catalogues of followed owners, kept for later rules.
    catalogues: BTreeMap<NodeId, Catalogue>,
    /// Owners that are unreachable or refuse, for status.
    owners: BTreeMap<NodeId, String>,
    /// Owners that were unreachable, or have just returned.
    settling: BTreeMap<NodeId, Settling>,
    problems: Problems,
    /// `true` if an interface is not shared or brought because of a running route.
    waits: bool,
    /// `true` if a route has ended since the last check for waiting interfaces.
    freed: bool,
    /// `true` if local consumers or the interfaces that they use may have changed.
    consumers_changed: bool,
    commands: VecDeque<Command>,
}

impl<R: RngCore> Routes<R> {
    /// Creates the machine. `node` is this node, `rng` provides source ids.
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

    /// Sets the secret from which names of later shares are derived. Running shares keep their names.
    pub fn set_secret(&mut self, secret: FleetSecret) {
        self.secret = secret;
    }

    /// Handles a change of the local graph.
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

    /// Handles the passing of time.
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

    /// Returns the next command.
    pub fn poll_command(&mut self) -> Option<Command> {
        if self.commands.is_empty() {
            self.check_stale();
        }
        self.commands.pop_front()
    }

    /// Returns the time of the next timeout.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let shares = self.shares.values().flat_map(|s| [s.writerless_until, s.sinkless_until]);
        let gone = self.shares.values().flat_map(|s| s.own.values()).filter_map(|own| own.gone);
        let uses = self.uses.values().map(|u| u.unreachable_until);
        let owners = self.settling.keys().map(|owner| self.settles_at(owner));
        let gone = gone.map(|at| Some(at + WRITERLESS_HOLD));
        shares.chain(uses).chain(owners).chain(gone).flatten().min()
    }

    /// Returns the ROS topic of a name that is shared or used here.
    pub fn topic_of(&self, name: &Name) -> Option<&str> {
        let share = self.shares.get(name).map(|s| s.local_name.as_str());
        share.or_else(|| {
            let token = || Some(self.use_rules[self.tokens.get(name)?.rule].topic.as_str());
            self.uses.get(name).map(|u| u.local_name.as_str()).or_else(token)
        })
    }

    /// Returns `true` if the traffic of a name that is shared or used here has a lane of its own.
    pub fn is_dedicated(&self, name: &Name) -> bool {
        let share = self.shares.get(name).map(|share| self.share_rules[share.rule].dedicated);
        let used = self.uses.get(name).map(|route| self.use_rules[route.rule].dedicated);
        share.or(used).unwrap_or(false)
    }

    /// Returns the state of every rule.
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

/// Returns words about the name elsewhere if it differs.
fn also_called(here: &str, verb: &str, there: &str) -> String {
    if here == there { String::new() } else { format!("{verb} {there}, ") }
}

/// Returns `true` if the reader of a topic asks writers for key hashes. It must not if a writer would then not match.
fn asks_key_hash<'a>(keyless: bool, mut writers: impl Iterator<Item = &'a Guid>) -> bool {
    !keyless && !writers.any(Guid::is_of_cyclone)
}

/// Returns `true` if two readers differ at most in depth, for which a reader is not recreated.
fn same_reader(a: Option<&EndpointSpec>, b: Option<&EndpointSpec>) -> bool {
    let key = |s: &EndpointSpec| {
        (
            (s.qos.reliability, s.qos.durability, s.qos.partitions.clone()),
            (s.keyless, s.asks_key_hash, s.type_name.clone()),
        )
    };
    a.map(key) == b.map(key)
}

/// Returns a new source id for a local writer, by which receivers recognise the writer's earlier sources.
fn source_of(secret: &FleetSecret, writer: &Guid, rng: &mut impl RngCore) -> SourceId {
    let mut random = [0; 8];
    rng.fill_bytes(&mut random);
    SourceId::from_publisher(secret.publisher_tag(&writer.0), random)
}

fn describe(qos: &Qos) -> String {
    format!("{:?}, {:?}, {:?}", qos.reliability, qos.durability, qos.representations)
}
