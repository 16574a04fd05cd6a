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

mod publish;
mod reconfigure;
mod tokens;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_endpoint::{LostReason, RefusedBy, ShareSpec};
use sgc_trust::{FleetSecret, Policy, Suite, derive_name, name_of};
use sgc_wire::{
    Catalogue, CatalogueEntry, CatalogueSource, Class, ENTRY_SOURCES_MAX, Kind, Metadata, Name, NodeId, Qos,
    SinkId, SourceId,
};

use crate::names::{dds_topic, dds_type, ros_topic, ros_type};
use crate::network::{DiscoveredEndpoint, DiscoveryEvent, EndpointKind, EndpointSpec, Guid};
use crate::qos::{reader_for, weakest};

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

/// What the driver has to do.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Command {
    /// Share it with the endpoint.
    Share(ShareSpec),
    /// Tell the endpoint what the share offers now.
    UpdateShare {
        /// The share.
        name: Name,
        /// Offer of all its writers.
        qos: Qos,
        /// Its transient-local writers.
        sources: Vec<CatalogueSource>,
    },
    /// Tell the endpoint who may join the share now; who may no longer is to be cut off.
    UpdatePolicy {
        /// The share.
        name: Name,
        /// Who may join.
        policy: Policy,
    },
    /// End the share.
    Unshare {
        /// Which.
        name: Name,
    },
    /// Read a local topic and publish it under `name`.
    OpenReader {
        /// The share.
        name: Name,
        /// What to create.
        spec: EndpointSpec,
    },
    /// Which source publishes for which local writer; writers that are not listed share one.
    MapSources {
        /// The share.
        name: Name,
        /// What all writers together offer.
        qos: Qos,
        /// Class of their packets.
        class: Class,
        /// Transient-local writers, each with its own source and history.
        own: Vec<(Guid, SourceId, Qos)>,
    },
    /// Read it no longer.
    CloseReader {
        /// The share.
        name: Name,
    },
    /// Follow an owner's catalogue.
    Follow {
        /// Its name in the fleet.
        owner_name: String,
    },
    /// Follow it no longer.
    Unfollow {
        /// Whose.
        owner: NodeId,
    },
    /// Join a name.
    Join {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
        /// True if histories are to be asked for.
        transient_local: bool,
        /// True if the grant has to say what the name stands for.
        describe: bool,
    },
    /// Join a name to publish under it what is read locally.
    Publish {
        /// Which.
        name: Name,
        /// Whose it must be.
        owner: NodeId,
        /// Cipher suite id.
        suite: u8,
        /// Class of its packets.
        class: Class,
        /// Whether they push back.
        reliable: bool,
    },
    /// Leave a name.
    Leave {
        /// Which.
        name: Name,
    },
    /// Write what comes under `name` to the local network.
    OpenWriter {
        /// The joined name.
        name: Name,
        /// The one source that it is for; `None` for all that have no writer of their own.
        source: Option<SourceId>,
        /// What to create.
        spec: EndpointSpec,
    },
    /// Write it no longer.
    CloseWriter {
        /// The joined name.
        name: Name,
        /// As it was opened.
        source: Option<SourceId>,
    },
    /// Something that the user should know, told once.
    Report(Problem),
}

/// What is wrong between two sides, with both values and the fix.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, thiserror::Error)]
pub enum Problem {
    /// A local writer's type is not the one that the share names.
    #[error(
        "{topic}: shared as {expected}, but a local publisher has {found}; it is not shared. Change `type` in the [[share]] or the publisher"
    )]
    ShareType {
        /// Topic.
        topic: String,
        /// Type in the rule.
        expected: String,
        /// Type of the writer.
        found: String,
    },
    /// The owner shares another type than the rule asks for.
    #[error(
        "{topic}: {owner} shares it as {found}, but this node asks for {expected}. Change `type` in the [[use]] or at {owner}"
    )]
    UseType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type in the rule.
        expected: String,
        /// Type in the catalogue.
        found: String,
    },
    /// A local endpoint on a used topic has another type than the owner shares.
    #[error("{topic}: {owner} shares it as {remote}, but a local {end} has {local}; the two will not talk")]
    LocalType {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// Type shared.
        remote: String,
        /// `"subscriber"` or `"publisher"`.
        end: &'static str,
        /// Type of the local endpoint.
        local: String,
    },
    /// A local subscriber asks for more than the far publisher offers.
    #[error(
        "{topic}: {owner} offers {offered}, but a local subscriber asks for {requested}; it will receive nothing"
    )]
    LocalQos {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
        /// What is offered.
        offered: String,
        /// What is asked for.
        requested: String,
    },
    /// Local writers of one topic offer different QoS.
    #[error("{topic}: local publishers offer different QoS; it is shared with the weakest, {offered}")]
    MixedQos {
        /// Topic.
        topic: String,
        /// What is offered.
        offered: String,
    },
    /// An owner shares one topic in more forms than are brought here.
    #[error(
        "{topic}: {owner} shares it in more than {ENTRIES_PER_RULE_MAX} forms; the rest is not brought here"
    )]
    TooManyEntries {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// What came for a token is not what the token says.
    #[error(
        "{topic}: {owner} gives something else for the token than it says; it is not brought here. Ask for a new token"
    )]
    TokenEntry {
        /// Topic.
        topic: String,
        /// Owner.
        owner: String,
    },
    /// More local endpoints than are looked at.
    #[error(
        "the local network has more than {LOCAL_ENDPOINTS_MAX} endpoints; those beyond are not looked at"
    )]
    TooManyEndpoints,
    /// More transient-local writers than can be told apart.
    #[error("{topic}: more than {ENTRY_SOURCES_MAX} transient-local publishers; the rest share one history")]
    TooManySources {
        /// Topic.
        topic: String,
    },
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

    /// A sink was granted one of our shares.
    pub fn handle_sink_joined(&mut self, name: &Name, sink: SinkId) {
        if let Some(share) = self.shares.get_mut(name) {
            share.sinks.insert(sink);
            self.refresh_share(*name);
        }
    }

    /// A sink of one of our shares is gone.
    pub fn handle_sink_left(&mut self, now: Instant, name: &Name, sink: &SinkId) {
        if let Some(share) = self.shares.get_mut(name)
            && share.sinks.remove(sink)
            && share.sinks.is_empty()
        {
            share.sinkless_until = Some(now + SINKLESS_HOLD);
        }
    }

    /// An owner's catalogue arrived or changed.
    pub fn handle_catalogue(&mut self, owner: NodeId, catalogue: Catalogue) {
        self.owners.remove(&owner);
        let mut listed = BTreeSet::new();
        self.catalogues.insert(owner, catalogue.clone());
        for entry in catalogue.entries {
            let Some(rule) = self.rule_for(owner, &entry) else { continue };
            let name = name_of(&owner, &entry.blind);
            let here = self.uses.iter().filter(|(n, u)| u.rule == rule && **n != name).count();
            if here >= ENTRIES_PER_RULE_MAX {
                let topic = self.use_rules[rule].topic.clone();
                let owner = self.use_rules[rule].owner_name.clone();
                self.report(Problem::TooManyEntries { topic, owner });
                continue;
            }
            listed.insert(name);
            self.entry_there(name, rule, entry);
        }
        let gone: Vec<_> = self
            .uses
            .iter()
            .filter(|(n, u)| self.use_rules[u.rule].is_of_catalogue(&owner) && !listed.contains(n))
            .map(|(n, _)| *n)
            .collect();
        for name in gone {
            self.drop_use(name);
        }
    }

    /// An owner is out of reach, or has gone in good order.
    pub fn handle_owner_lost(&mut self, now: Instant, owner: NodeId, reason: LostReason) {
        let names: Vec<_> = self
            .uses
            .iter()
            .filter(|(_, u)| self.use_rules[u.rule].is_of_catalogue(&owner))
            .map(|(n, _)| *n)
            .collect();
        let gone = matches!(reason, LostReason::Withdrawn | LostReason::Refused(_));
        if gone {
            self.catalogues.remove(&owner);
        }
        self.owners.insert(owner, if gone { "has gone".into() } else { "is out of reach".into() });
        for name in names {
            if gone {
                self.drop_use(name);
            } else {
                self.hold_use(now, name);
            }
        }
    }

    /// An owner does not let this node follow it.
    pub fn handle_owner_refused(&mut self, owner: NodeId, by: RefusedBy) {
        self.owners.insert(owner, format!("refuses its catalogue: {by}"));
    }

    /// A join was granted. `entry` is what the name stands for, where that was asked for.
    pub fn handle_granted(&mut self, name: &Name, entry: Option<CatalogueEntry>) {
        if let (Some(entry), true) = (entry, self.tokens.contains_key(name)) {
            self.handle_described(*name, entry);
        }
        if let Some(route) = self.uses.get_mut(name) {
            route.granted = true;
            route.refused = None;
            route.unreachable_until = None;
            let rule = route.rule;
            if self.publishes(rule) {
                self.refresh_publisher(*name);
            } else {
                self.refresh_use(*name);
            }
        }
    }

    /// A join was refused.
    pub fn handle_refused(&mut self, name: &Name, by: RefusedBy) {
        if let Some(route) = self.uses.get_mut(name) {
            route.refused = Some(by);
        }
        if let Some(token) = self.tokens.get_mut(name) {
            token.refused = Some(by);
        }
    }

    /// A grant is void for now.
    pub fn handle_lost(&mut self, now: Instant, name: &Name) {
        self.hold_use(now, *name);
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

    fn writer_there(&mut self, writer: DiscoveredEndpoint) {
        self.check_local(&writer);
        self.publisher_there(&writer);
        let Some(topic) = ros_topic(&writer.topic) else { return };
        let found = ros_type(&writer.type_name);
        let Some((rule, share)) =
            self.share_rules.iter().enumerate().find(|(_, s)| s.metadata.ros_name == topic)
        else {
            return;
        };
        let expected = &share.metadata.type_name;
        if !expected.is_empty() && *expected != found {
            let problem = Problem::ShareType { topic: topic.to_owned(), expected: expected.clone(), found };
            return self.report(problem);
        }
        // One that runs keeps its name, also after the secret that names come from was replaced.
        if let Some(route) =
            self.shares.values_mut().find(|s| s.rule == rule && s.type_name == writer.type_name)
        {
            route.writers.insert(writer.guid, writer);
            route.writerless_until = None;
            let name = route.name;
            return self.refresh_share(name);
        }
        let metadata = Metadata { type_name: found, ..share.metadata.clone() };
        let name = derive_name(&self.secret, &self.node, &metadata);
        let (type_name, keyless) = (writer.type_name.clone(), writer.keyless);
        let (spec, route) = ShareRoute::begin(name, rule, share, &type_name, keyless, Some(writer));
        self.shares.insert(name, route);
        self.commands.push_back(Command::Share(spec));
        self.refresh_share(name);
    }

    fn writer_gone(&mut self, now: Instant, endpoint: &DiscoveredEndpoint) {
        if endpoint.kind != EndpointKind::Writer {
            return;
        }
        self.publisher_gone(endpoint);
        let names: Vec<_> =
            self.shares.values().filter(|s| s.writers.contains_key(&endpoint.guid)).map(|s| s.name).collect();
        for name in names {
            let Some(share) = self.shares.get_mut(&name) else { continue };
            share.writers.remove(&endpoint.guid);
            if share.writers.is_empty() {
                // What was offered stands until the hold ends: a restarted program finds it as it was.
                share.own.clear();
                // One that others publish on is there without.
                if self.share_rules[share.rule].policy.publish.is_empty() {
                    share.writerless_until = Some(now + WRITERLESS_HOLD);
                    continue;
                }
            }
            self.refresh_share(name);
        }
    }

    /// Brings catalogue, sources and reader of a share in line with its writers and sinks.
    fn refresh_share(&mut self, name: Name) {
        let Some(share) = self.shares.get_mut(&name) else { return };
        let offer = match weakest(share.writers.values().map(|w| &w.qos)) {
            Some(offer) => offer,
            None if self.share_rules[share.rule].policy.publish.is_empty() => return,
            // What the publishers elsewhere offer is not known here; ROS 2's default serves commands well.
            None => Qos::default(),
        };
        share.own.retain(|guid, _| share.writers.contains_key(guid));
        let mut problem = None;
        if offer.is_transient_local() {
            let mut known: BTreeSet<_> = share.own.values().copied().collect();
            for guid in
                share.writers.keys().filter(|guid| !share.own.contains_key(guid)).copied().collect::<Vec<_>>()
            {
                let source = match known.last() {
                    Some(last) if known.len() >= ENTRY_SOURCES_MAX => {
                        let topic = self.share_rules[share.rule].metadata.ros_name.clone();
                        problem = Some(Problem::TooManySources { topic });
                        *last
                    }
                    _ => random_source(&mut self.rng),
                };
                known.insert(source);
                share.own.insert(guid, source);
            }
        } else {
            share.own.clear();
        }
        if share
            .writers
            .values()
            .any(|w| (w.qos.reliability, w.qos.durability) != (offer.reliability, offer.durability))
        {
            let topic = self.share_rules[share.rule].metadata.ros_name.clone();
            problem = Some(Problem::MixedQos { topic, offered: describe(&offer) });
        }
        let own: Vec<_> = share.own.iter().map(|(g, s)| (*g, *s, share.writers[g].qos.clone())).collect();
        let listed: BTreeMap<_, _> = own.iter().map(|(_, source, qos)| (*source, qos)).collect();
        let sources =
            listed.into_iter().map(|(source, qos)| CatalogueSource { source, qos: qos.clone() }).collect();
        self.commands.push_back(Command::UpdateShare { name, qos: offer.clone(), sources });
        let class = self.share_rules[share.rule].class;
        self.commands.push_back(Command::MapSources { name, qos: offer.clone(), class, own });
        // A transient-local topic is read from the start: late joiners are promised its history.
        let wanted = offer.is_transient_local() || !share.sinks.is_empty() || share.sinkless_until.is_some();
        let wanted = wanted && !share.writers.is_empty();
        if !share.sinks.is_empty() {
            share.sinkless_until = None;
        }
        let spec = wanted.then(|| EndpointSpec {
            topic: dds_topic(&self.share_rules[share.rule].metadata.ros_name),
            type_name: share.type_name.clone(),
            keyless: share.keyless,
            type_hash: share.writers.values().find_map(|w| w.type_hash.clone()),
            qos: reader_for(&offer, share.writers.len()),
        });
        if !same_reader(share.reader.as_ref(), spec.as_ref()) {
            if share.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if let Some(spec) = &spec {
                self.commands.push_back(Command::OpenReader { name, spec: spec.clone() });
            }
            share.reader = spec;
        }
        if let Some(problem) = problem {
            self.report(problem);
        }
    }

    fn drop_share(&mut self, name: Name) {
        if let Some(share) = self.shares.remove(&name) {
            if share.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
            if share.writer.is_some() {
                self.commands.push_back(Command::CloseWriter { name, source: None });
            }
            self.commands.push_back(Command::Unshare { name });
        }
    }

    /// The rule that asks for a catalogue entry.
    fn rule_for(&mut self, owner: NodeId, entry: &CatalogueEntry) -> Option<usize> {
        let metadata = &entry.metadata;
        let (index, rule) = self.use_rules.iter().enumerate().find(|(_, r)| {
            let may = match r.direction {
                Direction::Bring => entry.subscribe,
                Direction::Publish => entry.publish,
            };
            may && r.is_of_catalogue(&owner) && r.topic == metadata.ros_name && metadata.kind == Kind::Topic
        })?;
        match &rule.type_name {
            Some(expected) if *expected != metadata.type_name => {
                let problem = Problem::UseType {
                    topic: rule.topic.clone(),
                    owner: rule.owner_name.clone(),
                    expected: expected.clone(),
                    found: metadata.type_name.clone(),
                };
                self.report(problem);
                None
            }
            _ => Some(index),
        }
    }

    fn entry_there(&mut self, name: Name, rule: usize, entry: CatalogueEntry) {
        let transient_local = entry.qos.is_transient_local();
        match self.uses.get_mut(&name) {
            Some(route) if self.use_rules[route.rule].direction == Direction::Publish => route.entry = entry,
            Some(route) if route.entry.qos.is_transient_local() == transient_local => {
                route.entry = entry;
                self.refresh_use(name);
            }
            // Another durability is another kind of sink: start over.
            Some(_) => {
                self.drop_use(name);
                self.entry_there(name, rule, entry);
            }
            None => {
                let owner = self.use_rules[rule].owner;
                let (suite, class, reliable) = (entry.suite, entry.class, entry.qos.is_reliable());
                self.uses.insert(name, UseRoute::new(rule, entry));
                if self.publishes(rule) {
                    self.commands.push_back(Command::Publish { name, owner, suite, class, reliable });
                    return self.find_publishers();
                }
                self.commands.push_back(Command::Join { name, owner, transient_local, describe: false });
                for endpoint in self.endpoints.values().cloned().collect::<Vec<_>>() {
                    self.check_local(&endpoint);
                }
            }
        }
    }

    fn hold_use(&mut self, now: Instant, name: Name) {
        if let Some(route) = self.uses.get_mut(&name) {
            route.granted = false;
            if !route.writers.is_empty() || route.reader.is_some() {
                route.unreachable_until.get_or_insert(now + UNREACHABLE_HOLD);
            }
        }
    }

    fn drop_use(&mut self, name: Name) {
        let is_token = self.tokens.remove(&name).is_some();
        let joined = is_token || self.uses.contains_key(&name);
        self.close_use(name);
        if joined {
            self.commands.push_back(Command::Leave { name });
        }
    }

    /// Ends what a use has on the local network; its name stays joined.
    fn close_use(&mut self, name: Name) {
        if let Some(route) = self.uses.remove(&name) {
            for source in route.writers.into_keys() {
                self.commands.push_back(Command::CloseWriter { name, source });
            }
            if route.reader.is_some() {
                self.commands.push_back(Command::CloseReader { name });
            }
        }
    }

    /// Brings the local writers of a granted route in line with its catalogue entry: one for each transient-local
    /// source, so that each keeps its own history, and one for all others.
    fn refresh_use(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name).filter(|u| u.granted) else { return };
        let entry = &route.entry;
        let spec = |qos: &Qos| EndpointSpec {
            topic: dds_topic(&entry.metadata.ros_name),
            type_name: dds_type(&entry.metadata.type_name),
            keyless: entry.keyless,
            type_hash: entry.type_hash.clone(),
            qos: qos.clone(),
        };
        let mut wanted: BTreeMap<Option<SourceId>, EndpointSpec> =
            entry.sources.iter().map(|s| (Some(s.source), spec(&s.qos))).collect();
        if wanted.is_empty() {
            wanted.insert(None, spec(&entry.qos));
        }
        for (source, old) in &route.writers {
            if wanted.get(source) != Some(old) {
                self.commands.push_back(Command::CloseWriter { name, source: *source });
            }
        }
        for (source, spec) in &wanted {
            if route.writers.get(source) != Some(spec) {
                let spec = spec.clone();
                self.commands.push_back(Command::OpenWriter { name, source: *source, spec });
            }
        }
        route.writers = wanted;
    }

    /// Says so if a local endpoint cannot talk to a used topic.
    fn check_local(&mut self, endpoint: &DiscoveredEndpoint) {
        let Some(topic) = ros_topic(&endpoint.topic) else { return };
        let mut problems = Vec::new();
        let brought = |u: &&UseRoute| !self.publishes(u.rule) && u.entry.metadata.ros_name == topic;
        for route in self.uses.values().filter(brought) {
            let (topic, owner) = (topic.to_owned(), self.use_rules[route.rule].owner_name.clone());
            let (remote, local) = (route.entry.metadata.type_name.clone(), ros_type(&endpoint.type_name));
            let reader = endpoint.kind == EndpointKind::Reader;
            if remote != local {
                let end = if reader { "subscriber" } else { "publisher" };
                problems.push(Problem::LocalType { topic, owner, remote, end, local });
            } else if reader
                && (endpoint.qos.reliability > route.entry.qos.reliability
                    || endpoint.qos.durability > route.entry.qos.durability)
            {
                let (offered, requested) = (describe(&route.entry.qos), describe(&endpoint.qos));
                problems.push(Problem::LocalQos { topic, owner, offered, requested });
            }
        }
        for problem in problems {
            self.report(problem);
        }
    }

    fn report(&mut self, problem: Problem) {
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
