//! The findings of `sgc why`: the facts of each step, without words. `words` renders them.

use std::collections::BTreeMap;

use sgc_node::admin::not_direct::NotDirectReason;
use sgc_node::alerts::Alert;
use sgc_node::graph::{DeadMan, Graph, Interface};

use crate::refusals::Refusal;

/// A fact about the path of an interface.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Finding {
    Node(NodeFinding),
    /// Refusals on which an operator has to act.
    Refused(Refused),
    /// Calls that got no answer.
    Unanswered(UnansweredCalls),
    Link(LinkFinding),
    Rule(RuleFinding),
    Share(ShareFinding),
    Use(UseFinding),
    Local(LocalFinding),
    Name(NameFinding),
    Traffic(TrafficFinding),
    /// Nothing is wrong here, and the other half of the path is known elsewhere.
    FarHalf {
        node: String,
        topic: String,
    },
}

/// A fact about the node that was asked.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum NodeFinding {
    /// No node answers.
    Absent {
        error: String,
    },
    Runs {
        node: String,
        version: String,
    },
    Alert(Alert),
    /// The name of the interface does not begin with a slash.
    RelativeName {
        topic: String,
    },
    /// The node knows 256-bit names only.
    RouterAlone,
}

/// The side that was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RefusedSide {
    /// Frames and messages.
    Frames,
    /// Peers that requested a link.
    Peers,
    /// Programs at the gateway.
    Programs,
}

/// Refusals of one kind.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Refused {
    pub(crate) side: RefusedSide,
    pub(crate) counter: &'static Refusal,
    pub(crate) count: u64,
    /// Shares of current links.
    pub(crate) by: Vec<(u64, Hop)>,
}

/// Calls of a service that got no answer for one reason.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct UnansweredCalls {
    pub(crate) service: String,
    /// The server, and not the clients, is on the local network.
    pub(crate) is_served: bool,
    /// Counter of the reason.
    pub(crate) reason: String,
    pub(crate) count: u64,
    /// Calls of callers that still exist.
    pub(crate) by: BTreeMap<String, u64>,
    pub(crate) last_s: u64,
}

/// A fact about links.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum LinkFinding {
    Linked(Hop),
    /// Nothing comes over a link although something should.
    Silent(Hop),
    /// No link is up, and no router is configured.
    NoRouter,
    /// No link is up, and a router is searched.
    Unlinked {
        router: String,
        state: String,
        failure: Option<String>,
    },
}

/// A fact about an interface that no rule names.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum RuleFinding {
    /// Another node shares it with this one.
    Unused { owner: Option<String>, kind: Interface, topic: String, node: String, needs_publish: bool },
    /// Local programs provide it.
    Unshared { count: usize, kind: Interface, topic: String, node: String, meant: Vec<String> },
    /// Local programs want it.
    Unbrought { count: usize, kind: Interface, topic: String, node: String, meant: Vec<String> },
    /// Nobody has it.
    Absent { topic: String, pattern: Option<String>, meant: Vec<String> },
}

/// A fact about an interface that this node shares.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum ShareFinding {
    /// Its subscribers want no more than this.
    Wished {
        interval_us: Option<u64>,
        bits_per_s: Option<u64>,
    },
    /// The type of the rule is not that of the local programs.
    TypeDiffers {
        kind: Interface,
        topic: String,
        wanted: String,
        types: Vec<String>,
    },
    /// A rule covers it, for these numbers of nodes, groups and fleets.
    Covered {
        to: [usize; 3],
    },
    /// The rule names a member that is similar to a known one.
    Misspelt {
        name: String,
        meant: String,
        node: String,
    },
    /// The rule names members that have not been heard of.
    Unheard {
        names: Vec<String>,
        node: String,
    },
    /// A rule covers it, and nothing is shared.
    Idle {
        topic: String,
        problem: Option<String>,
    },
    /// A node asked for it and was refused.
    Refused {
        node: String,
        reason: String,
    },
    Unasked {
        kind: Interface,
        topic: String,
        node: String,
    },
    /// These nodes have it; the first refused one with the reason.
    Granted {
        to: Vec<String>,
        refused: Option<(String, String)>,
    },
    NoBranch,
    Leaves {
        over: Vec<Hop>,
    },
    /// These nodes have it over no router.
    Direct {
        to: Vec<String>,
    },
    /// There is no direct link to these nodes.
    Relayed {
        to: Vec<String>,
        reason: NotDirectReason,
    },
    /// A node's subscribers have another definition of the type.
    DefinitionsDiffer {
        type_name: String,
        here: String,
        there: String,
        node: String,
    },
    /// Nothing here calls the server for others.
    NoCaller,
    Called,
    NotRead,
    NoMessage {
        topic: String,
    },
    Published {
        messages: u64,
    },
    /// Messages of others reached the local network.
    Written {
        messages: u64,
    },
}

/// A fact about an interface of another node.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum UseFinding {
    Rule {
        publishes: bool,
        topic: String,
        owner: String,
    },
    /// The owner's catalogue has not arrived.
    NoCatalogue {
        owner: String,
        state: Option<String>,
        /// Reason of the owner or of a router, if the catalogue is refused.
        refusal: Option<String>,
        reach: Reach,
        meant: Option<String>,
    },
    OwnerRevoked {
        owner: String,
    },
    TokenRefused {
        owner: String,
        reason: String,
    },
    TokenUnanswered {
        owner: String,
    },
    TypeDiffers {
        owner: String,
        topic: String,
        shared: String,
        wanted: String,
    },
    KindDiffers {
        owner: String,
        topic: String,
        shared: Interface,
        wanted: Interface,
    },
    MayNotPublish {
        owner: String,
        topic: String,
        node: String,
    },
    MayNotSubscribe {
        owner: String,
        topic: String,
        node: String,
    },
    /// The owner lists it, and nothing of it runs here.
    Idle {
        owner: String,
        topic: String,
        problem: Option<String>,
    },
    /// No wildcard shares such a name.
    NotForWildcards {
        owner: String,
        topic: String,
        node: String,
        kind: Interface,
        rule: String,
    },
    NotShared {
        owner: String,
        topic: String,
        node: String,
        meant: Vec<String>,
    },
    Listed {
        owner: String,
        node: String,
    },
    Refused {
        owner: String,
        reason: String,
        topic: String,
    },
    NoRoute {
        owner: String,
    },
    Unanswered {
        owner: String,
    },
    Granted {
        owner: String,
        type_name: String,
    },
    Route {
        owner: String,
        next: Hop,
        rtt_us: u32,
    },
    /// No router is on the path.
    Direct {
        owner: String,
    },
    /// A direct link to the owner is up, and routing takes another path.
    NotOverDirect {
        owner: String,
    },
    /// There is no direct link to the owner.
    Relayed {
        owner: String,
        reason: NotDirectReason,
    },
    NoBranch,
    /// Nothing on the local network answers for the owner.
    NoServer,
    Answered {
        owner: String,
    },
    NoMessage {
        owner: String,
        topic: String,
    },
    Received {
        messages: u64,
        /// Time since the last one, seconds.
        last_s: Option<u64>,
        /// Age of the last one that came, and the greatest error of that, microseconds.
        age: Option<(i64, i64)>,
    },
    /// The local publishers have other types than the owner takes.
    TakesOther {
        owner: String,
        taken: String,
        types: Vec<String>,
    },
    NotRead,
    NotPublished {
        topic: String,
    },
    Published {
        messages: u64,
        owner: String,
    },
}

/// The relation to an owner whose catalogue has not arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reach {
    /// The owner refuses this node.
    Refused {
        is_linked: bool,
    },
    /// The owner has not answered.
    Asked {
        is_linked: bool,
    },
    /// A link leads to the owner, and it announces nothing.
    Linked,
    Unknown,
}

/// A fact about the local network.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum LocalFinding {
    /// The dead-man switch has stopped the robot.
    Stopped {
        dead_man: DeadMan,
        topic: String,
    },
    /// Commands pass the dead-man switch.
    CommandsPass {
        stops: u64,
    },
    NoProvider {
        kind: Interface,
        topic: String,
        consumers: usize,
        meant: Vec<String>,
    },
    /// Providers, with their types at the node that shares the interface.
    Providers {
        count: usize,
        kind: Interface,
        topic: String,
        types: Option<Vec<String>>,
    },
    /// Local providers have several definitions of a type.
    DefinitionsDiffer {
        kind: Interface,
        type_name: String,
        hashes: Vec<String>,
    },
    /// Publishers assert their liveliness by hand, which other nodes see only with messages.
    Unasserted {
        count: usize,
    },
    NoSubscriber {
        topic: String,
        meant: Vec<String>,
    },
    /// No program here uses the action, so nobody subscribes to its topics.
    NoActionClient {
        action: String,
    },
    SubscribedTypeDiffers {
        far: String,
        here: String,
    },
    SubscribedDefinitionDiffers {
        type_name: String,
        far: String,
        here: String,
    },
    QosDiffers(QosMismatch),
    /// Some subscribers do not match.
    SomeQosDiffers {
        count: usize,
        of: usize,
        first: QosMismatch,
    },
    NoWriter,
    Unmatched {
        count: usize,
    },
    Matched {
        count: u32,
    },
    /// Messages travel as JSON, and no definition of the type is known.
    NoDefinition {
        type_name: String,
    },
}

/// A QoS policy by which a subscriber does not match.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct QosMismatch {
    pub(crate) policy: &'static str,
    pub(crate) offered: String,
    pub(crate) asked: String,
}

/// A fact about a name at a router.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum NameFinding {
    OwnerHere,
    Route { next: Hop, rtt_us: u32 },
    Unadvertised,
    NoBranch,
    Branch { to: Vec<Hop> },
}

/// A fact about the packets of a name.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum TrafficFinding {
    Passed {
        packets: u64,
        bytes: u64,
        direction: Direction,
    },
    /// Drops by counter, except those that are no loss.
    Dropped {
        counts: BTreeMap<String, u64>,
        worst: String,
    },
}

/// The direction of packets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Direction {
    /// To this node's subscribers.
    In,
    /// From this node's publishers to an owner.
    Out,
    /// From this node, which shares the topic.
    Shared,
    /// Through a router.
    Through,
}

/// One hop of a path.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Hop {
    ThisNode,
    Link {
        id: u32,
        /// Name, or the beginning of the id.
        peer: String,
        remote: String,
        rtt_us: u64,
    },
    /// A link that the document does not list.
    UnlistedLink {
        id: u32,
    },
}

impl Hop {
    /// Returns the hop over a link of a document.
    pub(crate) fn over(graph: &Graph, link: u32) -> Self {
        match graph.links.iter().find(|l| l.id == link) {
            _ if link == 0 => Self::ThisNode,
            Some(l) => Self::Link {
                id: link,
                peer: l.name.clone().unwrap_or_else(|| l.peer.chars().take(8).collect()),
                remote: l.remote.clone(),
                rtt_us: l.rtt_us,
            },
            None => Self::UnlistedLink { id: link },
        }
    }
}

impl Finding {
    /// Returns `true` if `other` says the same about another part of one interface. Only the part that the advice names
    /// may differ.
    pub(crate) fn is_same_of_part(&self, other: &Self) -> bool {
        self.clone().without_part() == other.clone().without_part()
    }

    /// Removes the part that only the advice names.
    fn without_part(mut self) -> Self {
        match &mut self {
            Self::Share(ShareFinding::Unasked { topic, .. } | ShareFinding::NoMessage { topic })
            | Self::FarHalf { topic, .. }
            | Self::Use(
                UseFinding::Refused { topic, .. }
                | UseFinding::NoMessage { topic, .. }
                | UseFinding::NotPublished { topic },
            ) => topic.clear(),
            _ => {}
        }
        self
    }
}
