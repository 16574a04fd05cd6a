//! The document behind `sgc topic` and `sgc why`: local endpoints, shares and uses with their state, links and names.
//! The status socket sends it.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};
use sgc_endpoint::JoinStatus;
use sgc_wire::{Durability, History, Kind, Liveliness, Reliability, Representations};

use super::not_direct::NotDirectPeer;
use crate::control::faults::alerts::Alert;

/// Local endpoints in one document.
pub const GRAPH_ENDPOINTS_MAX: usize = 16_384;

/// The whole document.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Graph {
    /// The node's name.
    pub node: String,
    /// Version of the program.
    pub version: String,
    /// Whether the node touches a local ROS 2 network.
    pub has_ros: bool,
    /// Endpoints of the local network, except those that nodes made there.
    pub endpoints: Vec<Endpoint>,
    /// Number of endpoints that are not listed.
    pub endpoints_left_out: usize,
    /// Rules that share interfaces.
    pub shares: Vec<Share>,
    /// Rules that use interfaces.
    pub uses: Vec<Use>,
    /// Entries that followed owners list for this node.
    pub offers: Vec<Offer>,
    /// Links that are up.
    pub links: Vec<Link>,
    /// Peers with which data is exchanged over routers.
    pub not_direct: Vec<NotDirectPeer>,
    /// Searches for routers.
    pub routers: Vec<Search>,
    /// Names that are shared, used, carried or asked for here.
    pub names: BTreeMap<String, NameLine>,
    /// Drops by kind, and by kind and culprit.
    pub drops: BTreeMap<String, u64>,
    /// Peers refused a link, by kind.
    pub refused: BTreeMap<String, u64>,
    /// Services of which calls got no answer.
    pub calls: Vec<ServiceCalls>,
    /// Programs refused at the gateway, by kind.
    pub gateway_refused: BTreeMap<String, u64>,
    /// Problems that the log reported once.
    pub problems: Vec<String>,
    /// Alerts for an operator.
    pub alerts: Vec<Alert>,
}

/// The calls of a service that got no answer, since the node started.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ServiceCalls {
    /// Name on the local network.
    pub topic: String,
    /// Whether its servers, and not its clients, are on this network.
    pub is_served: bool,
    /// Lost calls by reason.
    pub lost: Vec<LostCalls>,
}

/// The calls that got no answer for one reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LostCalls {
    /// Counter of the reason.
    pub reason: String,
    /// Number of lost calls since the start.
    pub count: u64,
    /// Number of lost calls since a call was last answered.
    pub since_answer: u64,
    /// Lost calls by caller: names of local ROS 2 nodes, or of other nodes, that still exist.
    pub by: BTreeMap<String, u64>,
    /// Seconds since the last one.
    pub last_s: u64,
}

/// Kind of an interface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Interface {
    /// A topic.
    #[default]
    Topic,
    /// A service.
    Service,
    /// An action.
    Action,
}

impl From<Kind> for Interface {
    fn from(kind: Kind) -> Self {
        match kind {
            Kind::Service => Self::Service,
            Kind::Action => Self::Action,
            Kind::Topic | Kind::Catalogue => Self::Topic,
        }
    }
}

impl fmt::Display for Interface {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Topic => "topic",
            Self::Service => "service",
            Self::Action => "action",
        })
    }
}

/// Selects which messages of a topic are counted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// Messages published on the local network.
    Local,
    /// Messages that come from the far side and are written to the local network.
    Far,
    /// Messages that leave for the far side, after shaping.
    Sent,
}

impl Side {
    /// Returns the spelling of the command line and the status socket.
    pub fn label(self) -> &'static str {
        match self {
            Self::Local => "local",
            Self::Far => "far",
            Self::Sent => "sent",
        }
    }

    /// Returns the side with this spelling.
    pub fn from_label(label: &str) -> Option<Self> {
        [Self::Local, Self::Far, Self::Sent].into_iter().find(|side| side.label() == label)
    }
}

/// Quality of service; durations in nanoseconds, infinite if there is none.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Qos {
    /// Reliable, or best effort.
    pub reliable: bool,
    /// Volatile 0, transient local 1, transient 2, persistent 3.
    pub durability: u8,
    /// History depth; none keeps all, [`Self::UNSAID_DEPTH`] is not known.
    pub depth: Option<u32>,
    /// Deadline.
    pub deadline_ns: Option<u64>,
    /// Lifespan.
    pub lifespan_ns: Option<u64>,
    /// Automatic 0, manual by participant 1, manual by topic 2.
    pub liveliness: u8,
    /// Lease of liveliness.
    pub lease_ns: Option<u64>,
    /// Partitions.
    pub partitions: Vec<String>,
    /// Data representations that a reader takes, or a writer offers: `"XCDR1"`, `"XCDR2"`; the first if none is named.
    pub representations: Vec<String>,
}

impl From<&sgc_wire::Qos> for Qos {
    fn from(qos: &sgc_wire::Qos) -> Self {
        Self {
            reliable: qos.reliability == Reliability::Reliable,
            durability: match qos.durability {
                Durability::Volatile => 0,
                Durability::TransientLocal => 1,
                Durability::Transient => 2,
                Durability::Persistent => 3,
            },
            depth: match qos.history {
                History::KeepLast(depth) => Some(depth),
                History::KeepAll => None,
            },
            deadline_ns: qos.deadline_ns,
            lifespan_ns: qos.lifespan_ns,
            liveliness: match qos.liveliness {
                Liveliness::Automatic => 0,
                Liveliness::ManualByParticipant => 1,
                Liveliness::ManualByTopic => 2,
            },
            lease_ns: qos.lease_ns,
            partitions: qos.partitions.clone(),
            representations: [Representations::XCDR1, Representations::XCDR2]
                .into_iter()
                .filter(|one| one.meets(qos.representations))
                .map(|one| format!("{one:?}"))
                .collect(),
        }
    }
}

impl Qos {
    /// The depth of a transient-local publisher that has not announced it, until it is known.
    pub const UNSAID_DEPTH: Option<u32> = match History::UNSAID {
        History::KeepLast(depth) => Some(depth),
        History::KeepAll => None,
    };

    /// Returns the reliability as ROS 2 spells it.
    pub fn reliability(&self) -> &'static str {
        if self.reliable { "RELIABLE" } else { "BEST_EFFORT" }
    }

    /// Returns the durability as ROS 2 spells it.
    pub fn durability(&self) -> &'static str {
        ["VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"]
            .get(usize::from(self.durability))
            .unwrap_or(&"?")
    }

    /// Returns the liveliness as ROS 2 spells it.
    pub fn liveliness(&self) -> &'static str {
        ["AUTOMATIC", "MANUAL_BY_PARTICIPANT", "MANUAL_BY_TOPIC"]
            .get(usize::from(self.liveliness))
            .unwrap_or(&"?")
    }

    /// Returns the first policy by which a reader that requests `self` does not match a writer that offers `offered`
    /// (DDS 1.4, 2.2.3), with the offered and the requested value.
    pub fn mismatch(&self, offered: &Self) -> Option<(&'static str, String, String)> {
        let time = |ns: Option<u64>| ns.map_or("infinite".to_owned(), |ns| format!("{} s", ns as f64 / 1e9));
        let longer = |asked: Option<u64>, offered: Option<u64>| {
            asked.is_some_and(|asked| offered.is_none_or(|offered| offered > asked))
        };
        if self.reliable && !offered.reliable {
            return Some(("reliability", offered.reliability().into(), self.reliability().into()));
        }
        if self.durability > offered.durability {
            return Some(("durability", offered.durability().into(), self.durability().into()));
        }
        if longer(self.deadline_ns, offered.deadline_ns) {
            return Some(("deadline", time(offered.deadline_ns), time(self.deadline_ns)));
        }
        if self.liveliness > offered.liveliness {
            return Some(("liveliness", offered.liveliness().into(), self.liveliness().into()));
        }
        if longer(self.lease_ns, offered.lease_ns) {
            return Some(("liveliness lease", time(offered.lease_ns), time(self.lease_ns)));
        }
        // DDS alone decides on partition patterns, since they may match anything.
        let is_pattern = |p: &String| p.contains(['*', '?', '[']);
        let all =
            |qos: &Self| if qos.partitions.is_empty() { vec![String::new()] } else { qos.partitions.clone() };
        let (asked, offers) = (all(self), all(offered));
        let meets = asked.iter().any(|p| offers.contains(p));
        if !meets && !asked.iter().chain(&offers).any(is_pattern) {
            return Some(("partition", format!("{offers:?}"), format!("{asked:?}")));
        }
        // This node writes one representation: plain CDR, if it is offered.
        let taken = self.representations();
        let written = offered.representations().into_iter().min().unwrap_or_default();
        if !taken.contains(&written) {
            return Some(("data representation", written.to_owned(), taken.join(" or ")));
        }
        None
    }

    fn representations(&self) -> Vec<&str> {
        match self.representations[..] {
            [] => vec!["XCDR1"],
            ref named => named.iter().map(String::as_str).collect(),
        }
    }
}

/// An endpoint of the local network.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Endpoint {
    /// ROS topic, or DDS topic if it is no ROS topic.
    pub topic: String,
    /// Whether it is a ROS 2 topic that is no part of a service.
    pub is_ros_topic: bool,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if the endpoint announces it.
    pub type_hash: Option<String>,
    /// Whether it is a writer.
    pub writes: bool,
    /// Its ROS 2 node with its namespace, if known.
    pub node: Option<String>,
    /// GUID, hexadecimal.
    pub guid: String,
    /// Its offered or requested QoS.
    pub qos: Qos,
    /// Index in [`Graph::shares`] of the rule that shares its topic.
    pub shared_by: Option<usize>,
}

/// A rule that shares interfaces.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Share {
    /// Kind of the interface.
    pub kind: Interface,
    /// Topic or pattern of the rule.
    pub topic: String,
    /// Type that the rule names.
    pub wanted_type: Option<String>,
    /// Numbers of nodes, groups and fleets that may subscribe.
    pub to: [usize; 3],
    /// Numbers of nodes, groups and fleets that may publish.
    pub publish: [usize; 3],
    /// Recipients of which no member was heard since the node started.
    pub unheard: Vec<UnheardMember>,
    /// Interfaces that the rule shares now.
    pub routes: Vec<ShareRoute>,
}

/// A node or a group of a rule of which no member was heard.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct UnheardMember {
    /// Its name in the rule, after `group:` if it is a group.
    pub name: String,
    /// A similar name of a member that was heard.
    pub meant: Option<String>,
}

/// A shared interface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ShareRoute {
    /// Name on the local network.
    pub topic: String,
    /// Name under which other nodes find it. Nodes of earlier versions do not say it.
    pub shared_as: Option<String>,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Name on the wire, hexadecimal.
    pub name: String,
    /// Local publishers.
    pub writers: usize,
    /// Whether this node reads the local publishers.
    pub is_read: bool,
    /// Whether messages of far publishers are written here. For a service: whether others can call it.
    pub is_written: bool,
    /// Common QoS of the local publishers.
    pub qos: Option<Qos>,
    /// Granted nodes.
    pub granted: Vec<String>,
    /// Type hashes that far subscribers or clients announce.
    pub consumer_hashes: BTreeMap<String, BTreeSet<String>>,
    /// Refused nodes with the reason.
    pub refused: BTreeMap<String, String>,
    /// Number of published messages.
    pub messages: u64,
    /// Number of far messages that were written to the local network.
    pub written: u64,
    /// Number of local readers that get far messages.
    pub matched: u32,
    /// Least time between two messages that its subscribers wish, microseconds; null without a limit.
    pub wished_interval_us: Option<u64>,
    /// Most bits of payload a second that its subscribers wish; null without a limit.
    pub wished_bits_per_s: Option<u64>,
    /// Dead-man switch of far messages, if there is one.
    pub dead_man: Option<DeadMan>,
    /// Whether messages published here travel as JSON.
    pub is_json: bool,
    /// Whether messages travel as JSON although their type is unknown here.
    pub lacks_definition: bool,
}

/// A rule that uses interfaces.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Use {
    /// Kind of the interface.
    pub kind: Interface,
    /// Whether this node publishes on the topic.
    pub publishes: bool,
    /// Topic in the rule, as the owner names it.
    pub topic: String,
    /// Its name on the local network.
    pub local_topic: String,
    /// Type that the rule names.
    pub wanted_type: Option<String>,
    /// Owner's node id.
    pub owner_id: String,
    /// Owner's name.
    pub owner: String,
    /// Name of a node in reach that differs from the owner's by one letter, if nobody has the owner's name.
    pub owner_meant: Option<String>,
    /// Fault of the owner, if there is one.
    pub owner_state: Option<String>,
    /// Reason of the owner or of a router, if it refuses its catalogue.
    pub owner_refusal: Option<String>,
    /// Whether the owner's CA has revoked the owner, and nothing is granted.
    pub is_owner_revoked: bool,
    /// State of following the owner.
    pub follow: Option<JoinState>,
    /// Whether the owner's catalogue has arrived.
    pub has_catalogue: bool,
    /// Whether the rule is a token.
    pub is_token: bool,
    /// Name on the wire, for a token.
    pub name: Option<String>,
    /// Reason why the token was refused.
    pub refused: Option<String>,
    /// Interfaces that the rule uses now.
    pub routes: Vec<UseRoute>,
}

/// State of a request to an owner.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum JoinState {
    /// No route leads to the owner.
    Waiting,
    /// It is not answered yet.
    Asked,
    /// The owner or a router refused it.
    Refused,
    /// The owner granted it.
    Granted,
    /// A state that this version does not know.
    #[serde(other)]
    Other,
}

impl From<&JoinStatus> for JoinState {
    fn from(status: &JoinStatus) -> Self {
        match status {
            JoinStatus::Waiting => Self::Waiting,
            JoinStatus::Asked => Self::Asked,
            JoinStatus::Refused(_) => Self::Refused,
            JoinStatus::Granted => Self::Granted,
        }
    }
}

/// An interface of another node that is used here.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct UseRoute {
    /// Name on the local network.
    pub topic: String,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if the owner knows it.
    pub type_hash: Option<String>,
    /// Name on the wire, hexadecimal.
    pub name: String,
    /// QoS that the owner offers.
    pub qos: Qos,
    /// Whether the owner granted it.
    pub is_granted: bool,
    /// Refusing node and reason, if it was refused.
    pub refused: Option<String>,
    /// State of the join.
    pub join: Option<JoinState>,
    /// Writers on the local network, or a server for a service.
    pub writers: usize,
    /// Local readers that match those writers.
    pub matched: u32,
    /// Local publishers, if this node publishes on it.
    pub publishers: usize,
    /// Whether this node reads the local publishers.
    pub is_read: bool,
    /// Number of messages that were written to the local network, or published.
    pub messages: u64,
    /// Time in seconds since the last message was written to the local network.
    pub last_s: Option<u64>,
    /// Time from the publication of the last message to its arrival, microseconds.
    pub age_us: Option<i64>,
    /// Greatest error of that; null while the owner's clock is not known, so that the clocks of both hosts count as equal.
    pub age_error_us: Option<i64>,
    /// Dead-man switch, if it has one.
    pub dead_man: Option<DeadMan>,
    /// Whether messages travel as JSON although their type is unknown here.
    pub lacks_definition: bool,
}

/// The dead-man switch of a topic that comes here.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct DeadMan {
    /// Why the robot is stopped: `start`, `silence`, `late` or `closed`; null while commands pass.
    pub stopped: Option<String>,
    /// Time in seconds since it was stopped.
    pub stopped_s: u64,
    /// Why the stop message cannot be published; no command passes until it can.
    pub no_stop_message: Option<String>,
    /// Whether only `sgc topic resume` lets commands pass again.
    pub is_manual: bool,
    /// Number of stop messages that were published.
    pub stops: u64,
    /// Number of commands that came late.
    pub late: u64,
    /// Number of commands whose lateness could not be known.
    pub unjudged: u64,
    /// Number of commands that came in time, after a stop and before somebody let go and began again.
    pub not_resumed: u64,
}

/// An entry of an owner's catalogue for this node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Offer {
    /// Owner's node id.
    pub owner_id: String,
    /// Owner's name, if a rule names it.
    pub owner: Option<String>,
    /// Kind of the interface.
    pub kind: Interface,
    /// Name at the owner.
    pub topic: String,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if the owner knows it.
    pub type_hash: Option<String>,
    /// QoS that the owner offers.
    pub qos: Qos,
    /// Name on the wire, hexadecimal.
    pub name: String,
    /// Whether this node may subscribe.
    pub subscribe: bool,
    /// Whether this node may publish.
    pub publish: bool,
    /// Whether a rule uses it.
    pub is_used: bool,
}

/// A link to another node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Link {
    /// Number of the link.
    pub id: u32,
    /// Node id of the peer.
    pub peer: String,
    /// The peer's name, if it is known.
    pub name: Option<String>,
    /// Its address.
    pub remote: String,
    /// Round trip, microseconds.
    pub rtt_us: u64,
    /// Whether the peer is overdue with an answer.
    pub silent: bool,
    /// Whether it is a direct link, found without configuration.
    pub is_direct: bool,
}

/// A search for a router.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Search {
    /// Entry of the configuration.
    pub router: String,
    /// State of the search.
    pub state: String,
    /// The last failure.
    pub last_failure: Option<String>,
}

/// State of a name at this node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct NameLine {
    /// Next hop towards the owner: number of a link, or 0 for this node; and microseconds of round trip.
    pub way: Option<(u32, u32)>,
    /// Links on which packets leave; 0 is this node.
    pub out: Vec<u32>,
    /// Links from which packets come.
    pub up: Vec<u32>,
    /// Whether the name has a branch here, so that packets are forwarded.
    pub has_branch: bool,
    /// Number of received packets.
    pub packets: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Drops by reason.
    pub dropped: BTreeMap<String, u64>,
}
