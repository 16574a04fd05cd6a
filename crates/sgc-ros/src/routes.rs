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
mod publish;
mod reconfigure;
mod shares;
mod tokens;
mod uses;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_endpoint::{RefusedBy, ShareSpec};
use sgc_trust::{FleetSecret, Policy, Suite};
use sgc_wire::{Catalogue, CatalogueEntry, Class, Metadata, Name, NodeId, Qos, SinkId, SourceId};

use crate::names::ros_type;
use crate::network::{DiscoveredEndpoint, DiscoveryEvent, EndpointKind, EndpointSpec, Guid};

pub use command::{Command, Problem};

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
/// Problems remembered so that each is told once.
const PROBLEMS_MAX: usize = 4096;

/// What the user shares.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareRule {
    /// Metadata; an empty type means whatever type local writers have.
    pub metadata: Metadata,
    /// Who may join.
    pub policy: Policy,
    /// How payloads are protected.
    pub suite: Suite,
    /// Class of its traffic.
    pub class: Class,
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
    /// Absolute ROS topic.
    pub topic: String,
    /// ROS type; `None` for whatever the owner shares.
    pub type_name: Option<String>,
    /// The name that a token leads to, and what it says of it; the catalogue is not looked at then.
    pub token: Option<(Name, Metadata)>,
}

impl UseRule {
    fn is_of_catalogue(&self, owner: &NodeId) -> bool {
        self.owner == *owner && self.token.is_none()
    }

    /// Whether it asks for the same as another, whatever the type.
    fn is_same_place(&self, other: &Self) -> bool {
        let name = |rule: &Self| rule.token.as_ref().map(|(name, _)| *name);
        self.direction == other.direction
            && self.owner == other.owner
            && self.topic == other.topic
            && name(self) == name(other)
    }
}

/// Where a route stands, for status.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RouteStatus {
    /// `"share"`, `"use"` or `"publish"`.
    pub direction: &'static str,
    /// ROS topic.
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
    type_name: String,
    keyless: bool,
    writers: BTreeMap<Guid, DiscoveredEndpoint>,
    own: BTreeMap<Guid, SourceId>,
    sinks: BTreeSet<SinkId>,
    reader: Option<EndpointSpec>,
    /// For what others publish on it.
    writer: Option<EndpointSpec>,
    writerless_until: Option<Instant>,
    sinkless_until: Option<Instant>,
}

#[derive(Debug)]
struct UseRoute {
    rule: usize,
    entry: CatalogueEntry,
    granted: bool,
    refused: Option<RefusedBy>,
    /// Open writers, and what they offer.
    writers: BTreeMap<Option<SourceId>, EndpointSpec>,
    /// If it publishes: the local writers, and the reader of what they write.
    local: BTreeMap<Guid, DiscoveredEndpoint>,
    reader: Option<EndpointSpec>,
    unreachable_until: Option<Instant>,
}

impl ShareRoute {
    /// A share with this first writer, or with none.
    fn begin(
        name: Name,
        rule: usize,
        share: &ShareRule,
        type_name: &str,
        keyless: bool,
        writer: Option<DiscoveredEndpoint>,
    ) -> (ShareSpec, Self) {
        let spec = ShareSpec {
            metadata: Metadata { type_name: ros_type(type_name), ..share.metadata.clone() },
            policy: share.policy.clone(),
            suite: share.suite,
            class: share.class,
            keyless,
            type_hash: writer.as_ref().and_then(|w| w.type_hash.clone()),
            qos: writer.as_ref().map(|w| w.qos.clone()).unwrap_or_default(),
            sources: Vec::new(),
        };
        let route = Self {
            name,
            rule,
            type_name: type_name.to_owned(),
            keyless,
            own: BTreeMap::new(),
            writers: writer.into_iter().map(|w| (w.guid, w)).collect(),
            sinks: BTreeSet::new(),
            reader: None,
            writer: None,
            writerless_until: None,
            sinkless_until: None,
        };
        (spec, route)
    }
}

impl UseRoute {
    fn new(rule: usize, entry: CatalogueEntry) -> Self {
        Self {
            rule,
            entry,
            granted: false,
            refused: None,
            writers: BTreeMap::new(),
            local: BTreeMap::new(),
            reader: None,
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
    shares: BTreeMap<Name, ShareRoute>,
    uses: BTreeMap<Name, UseRoute>,
    /// Names of tokens; there is a route besides from the first grant on.
    tokens: BTreeMap<Name, TokenJoin>,
    /// What followed owners said last, for rules that come later.
    catalogues: BTreeMap<NodeId, Catalogue>,
    /// Owners that are out of reach or refuse, for status.
    owners: BTreeMap<NodeId, String>,
    told: BTreeSet<Problem>,
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
            shares: BTreeMap::new(),
            uses: BTreeMap::new(),
            tokens: BTreeMap::new(),
            catalogues: BTreeMap::new(),
            owners: BTreeMap::new(),
            told: BTreeSet::new(),
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
        match event {
            DiscoveryEvent::Appeared(endpoint) => {
                if self.endpoints.len() >= LOCAL_ENDPOINTS_MAX {
                    return self.report(Problem::TooManyEndpoints);
                }
                let guid = endpoint.guid;
                if let Some(old) = self.endpoints.insert(guid, endpoint.clone()) {
                    self.writer_gone(now, &old);
                }
                match endpoint.kind {
                    EndpointKind::Writer => self.writer_there(endpoint),
                    EndpointKind::Reader => self.check_local(&endpoint),
                }
            }
            DiscoveryEvent::Vanished { guid } => {
                if let Some(endpoint) = self.endpoints.remove(&guid) {
                    self.writer_gone(now, &endpoint);
                }
            }
        }
    }

    /// Time passed.
    pub fn handle_timeout(&mut self, now: Instant) {
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        for name in self.shares.keys().copied().collect::<Vec<_>>() {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            if due(share.writerless_until) {
                self.drop_share(name);
            } else if due(share.sinkless_until) {
                share.sinkless_until = None;
                self.refresh_share(name);
            }
        }
        for (name, route) in &mut self.uses {
            if due(route.unreachable_until) {
                route.unreachable_until = None;
                for source in std::mem::take(&mut route.writers).into_keys() {
                    self.commands.push_back(Command::CloseWriter { name: *name, source });
                }
                if route.reader.take().is_some() {
                    self.commands.push_back(Command::CloseReader { name: *name });
                }
            }
        }
    }

    /// The next thing to do.
    pub fn poll_command(&mut self) -> Option<Command> {
        self.commands.pop_front()
    }

    /// When time matters next.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let shares = self.shares.values().flat_map(|s| [s.writerless_until, s.sinkless_until]);
        let uses = self.uses.values().map(|u| u.unreachable_until);
        shares.chain(uses).flatten().min()
    }

    /// The ROS topic behind a name that is shared or used here.
    pub fn topic_of(&self, name: &Name) -> Option<&str> {
        let share = self.shares.get(name).map(|s| self.share_rules[s.rule].metadata.ros_name.as_str());
        share.or_else(|| Some(self.use_rules[self.uses.get(name)?.rule].topic.as_str()))
    }

    /// Where every rule stands.
    pub fn status(&self) -> Vec<RouteStatus> {
        let mut all = Vec::new();
        for (index, rule) in self.share_rules.iter().enumerate() {
            let routes: Vec<_> = self.shares.values().filter(|s| s.rule == index).collect();
            let status = |type_name, name, state| RouteStatus {
                direction: "share",
                topic: rule.metadata.ros_name.clone(),
                type_name,
                name,
                owner: rule.metadata.owner.clone(),
                state,
            };
            if routes.is_empty() {
                let wanted = (!rule.metadata.type_name.is_empty()).then(|| rule.metadata.type_name.clone());
                all.push(status(wanted, None, "waits for a local publisher".into()));
            }
            for route in routes {
                let state = format!(
                    "{} local publishers, {} remote subscribers, {}",
                    route.writers.len(),
                    route.sinks.len(),
                    if route.reader.is_some() { "reading" } else { "not reading: nobody subscribes" }
                );
                all.push(status(Some(ros_type(&route.type_name)), Some(route.name), state));
            }
        }
        for (index, rule) in self.use_rules.iter().enumerate() {
            let routes: Vec<_> = self.uses.iter().filter(|(_, u)| u.rule == index).collect();
            let status = |type_name, name, state| RouteStatus {
                direction: if rule.direction == Direction::Publish { "publish" } else { "use" },
                topic: rule.topic.clone(),
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
                all.push(status(Some(metadata.type_name.clone()), Some(*name), state));
            } else if routes.is_empty() {
                let state = match self.owners.get(&rule.owner) {
                    Some(state) => format!("{} {state}", rule.owner_name),
                    None if rule.direction == Direction::Publish => {
                        format!("{} does not let this node publish on it (yet)", rule.owner_name)
                    }
                    None => format!("{} does not share it with this node (yet)", rule.owner_name),
                };
                all.push(status(rule.type_name.clone(), None, state));
            }
            for (name, route) in routes {
                let state = match (route.granted, route.refused) {
                    (true, _) if rule.direction == Direction::Publish => {
                        format!("granted, {} local publishers", route.local.len())
                    }
                    (true, _) => format!("granted, {} local writers", route.writers.len()),
                    (false, Some(by)) => format!("refused: {by}"),
                    (false, None) => "waits for the owner's grant".into(),
                };
                all.push(status(Some(route.entry.metadata.type_name.clone()), Some(*name), state));
            }
        }
        all
    }

    pub(super) fn report(&mut self, problem: Problem) {
        if self.told.len() < PROBLEMS_MAX && self.told.insert(problem.clone()) {
            self.commands.push_back(Command::Report(problem));
        }
    }
}

/// A reader need not be made anew for a little more or less depth.
fn same_reader(a: Option<&EndpointSpec>, b: Option<&EndpointSpec>) -> bool {
    let key = |s: &EndpointSpec| {
        (s.qos.reliability, s.qos.durability, s.qos.partitions.clone(), s.keyless, s.type_name.clone())
    };
    a.map(key) == b.map(key)
}

fn random_source(rng: &mut impl RngCore) -> SourceId {
    let mut id = [0; 16];
    rng.fill_bytes(&mut id);
    SourceId(id)
}

fn describe(qos: &Qos) -> String {
    format!("{:?}, {:?}", qos.reliability, qos.durability)
}
