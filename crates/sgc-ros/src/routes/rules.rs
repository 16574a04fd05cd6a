//! The rules of a configuration, validated: which interfaces are shared, and which are used.

use std::marker::PhantomData;
use std::ops::Index;
use std::sync::Arc;
use std::time::Duration;

use sgc_trust::{Policy, Suite};
use sgc_wire::{CatalogueEntry, Class, Kind, Metadata, Name, NodeId, PayloadEncoding, PayloadForm, RosNode};

use super::naming::{Naming, Rename, is_pattern};
use crate::qos::QosOverride;

/// Most interfaces that one wildcard rule shares or brings.
pub const ROUTES_PER_WILDCARD_MAX: usize = 512;
/// Most interfaces of an owner that match one rule: types and metadata of one topic.
pub(super) const ENTRIES_PER_RULE_MAX: usize = 8;

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
    /// The dead-man switch of what others publish.
    pub dead_man: Option<DeadManRule>,
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

/// The dead-man switch of a topic of commands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadManRule {
    /// The longest time without a command in time, and the most by which a command may be late.
    pub after: Duration,
    /// The stop message.
    pub stop: StopMessage,
    /// The time after which the stop message is published again; `None` for once.
    pub repeat: Option<Duration>,
    /// The end of a stop.
    pub resume: Resume,
}

/// The stop message of a dead-man switch.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StopMessage {
    /// The message with every field zero or empty, except for the time in its `header`, which is the present.
    Zero,
    /// The last command that passed, again.
    Last,
    /// This message as JSON (docs/spec/json.md).
    Json(Arc<str>),
}

/// The end of a stop.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Resume {
    /// By itself, when the publisher let go and begins again.
    #[default]
    Auto,
    /// When somebody says so.
    Manual,
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
    /// The dead-man switch, of a topic that comes here.
    pub dead_man: Option<DeadManRule>,
    /// `true` if the traffic has a lane of its own.
    pub dedicated: bool,
}

impl ShareRule {
    /// Returns `true` for a service, whose callers are the nodes that may publish.
    pub(super) fn is_service(&self) -> bool {
        self.metadata.kind == Kind::Service
    }

    /// Returns `true` if the share exists for messages of others, even without a local publisher.
    pub(super) fn is_inbound(&self) -> bool {
        !self.is_service() && !self.policy.publish.is_empty()
    }
}

impl UseRule {
    pub(super) fn is_service(&self) -> bool {
        self.kind == Kind::Service
    }

    pub(super) fn is_of_catalogue(&self, owner: &NodeId) -> bool {
        self.owner == *owner && self.token.is_none()
    }

    /// Returns `true` if both rules ask for the same interface, whatever its type.
    pub(super) fn is_same_place(&self, other: &Self) -> bool {
        let name = |rule: &Self| rule.token.as_ref().map(|(name, _)| *name);
        self.direction == other.direction
            && self.owner == other.owner
            && self.kind == other.kind
            && self.topic == other.topic
            && name(self) == name(other)
    }
}

/// The place of a `[[share]]` rule in the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ShareRuleId(usize);

/// The place of a `[[use]]` rule in the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct UseRuleId(usize);

impl From<usize> for ShareRuleId {
    fn from(place: usize) -> Self {
        Self(place)
    }
}

impl From<ShareRuleId> for usize {
    fn from(rule: ShareRuleId) -> Self {
        rule.0
    }
}

impl From<usize> for UseRuleId {
    fn from(place: usize) -> Self {
        Self(place)
    }
}

impl From<UseRuleId> for usize {
    fn from(rule: UseRuleId) -> Self {
        rule.0
    }
}

/// The rules of one kind, in the order of the configuration.
#[derive(Debug)]
pub(super) struct Rules<I, T> {
    rules: Vec<T>,
    ids: PhantomData<I>,
}

/// The `[[share]]` rules.
pub(super) type ShareRules = Rules<ShareRuleId, ShareRule>;
/// The `[[use]]` rules.
pub(super) type UseRules = Rules<UseRuleId, UseRule>;

impl<I: From<usize>, T> Rules<I, T> {
    pub(super) fn new(rules: Vec<T>) -> Self {
        Self { rules, ids: PhantomData }
    }

    /// Iterates over the rules.
    pub(super) fn iter(&self) -> impl Iterator<Item = &T> {
        self.rules.iter()
    }

    /// Iterates over the rules, with their places.
    pub(super) fn with_ids(&self) -> impl Iterator<Item = (I, &T)> {
        self.rules.iter().enumerate().map(|(place, rule)| (I::from(place), rule))
    }

    /// Returns the first rule that is wanted.
    pub(super) fn position(&self, is_wanted: impl Fn(&T) -> bool) -> Option<I> {
        self.rules.iter().position(is_wanted).map(I::from)
    }
}

impl<I: Into<usize>, T> Index<I> for Rules<I, T> {
    type Output = T;

    fn index(&self, rule: I) -> &T {
        &self.rules[rule.into()]
    }
}

impl ShareRule {
    /// Returns `true` if the rule covers the local interface with this name.
    pub(super) fn covers(&self, kind: Kind, local_name: &str) -> bool {
        self.metadata.kind == kind && self.naming.shares(&self.metadata.ros_name, local_name)
    }

    /// Returns the metadata under which an interface is shared.
    pub fn metadata_of(&self, local_name: &str, type_name: &str) -> Metadata {
        let ros_name = self.naming.renamed(&self.metadata.ros_name, local_name);
        Metadata { ros_name, type_name: type_name.to_owned(), ..self.metadata.clone() }
    }

    /// Returns `true` if the rule may share several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.metadata.ros_name)
    }
}

impl UseRule {
    /// Returns `true` if the rule asks for this entry of the owner's catalogue.
    pub(super) fn covers(&self, owner: &NodeId, entry: &CatalogueEntry) -> bool {
        let may = match self.direction {
            Direction::Bring => entry.subscribe,
            Direction::Publish => entry.publish,
        };
        let Metadata { kind, ros_name, type_name, .. } = &entry.metadata;
        let is_of_type = || self.type_name.as_ref().is_none_or(|wanted| wanted == type_name);
        may && self.is_of_catalogue(owner)
            && self.kind == *kind
            && self.naming.covers(&self.topic, ros_name)
            && (!self.is_pattern() || is_of_type())
    }

    /// Returns the name on the local network.
    pub fn local_name(&self, metadata: &Metadata) -> String {
        self.naming.renamed(&self.topic, &metadata.ros_name)
    }

    /// Returns `true` if the rule may use several interfaces.
    pub fn is_pattern(&self) -> bool {
        is_pattern(&self.topic)
    }

    /// Returns `true` if the rule reserves exactly this local name, whatever the owner lists.
    pub(super) fn claims(&self, kind: Kind, local_name: &str) -> bool {
        self.kind == kind && !self.is_pattern() && self.naming.renamed(&self.topic, &self.topic) == local_name
    }
}

impl UseRule {
    /// Returns the local name of a node whose interfaces this rule brings.
    pub(super) fn local_node(&self, node: &RosNode) -> RosNode {
        let Rename::Namespace(namespace) = &self.naming.rename else { return node.clone() };
        let below = node.namespace().trim_end_matches('/');
        // A name that becomes too long stays as it is.
        let named = RosNode::new(&format!("{namespace}{below}"), node.name(), node.enclave());
        named.unwrap_or_else(|| node.clone())
    }
}
