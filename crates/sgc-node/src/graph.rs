//! What is there and where it goes, as the status socket tells it: local endpoints, what is shared and used and how that
//! goes, links and names. One document, from which `sgc topic` and `sgc why` make what they show.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;

use serde::{Deserialize, Serialize};
use sgc_wire::{Durability, History, Kind, Liveliness, Reliability, Representations};

use crate::alerts::Alert;

/// Local endpoints in one document.
pub const GRAPH_ENDPOINTS_MAX: usize = 16_384;

/// Everything.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Graph {
    /// The node's name.
    pub node: String,
    /// Version of the program.
    pub version: String,
    /// Whether it touches a local ROS 2 network.
    pub has_ros: bool,
    /// What is on it, without what this and other nodes made there.
    pub endpoints: Vec<Endpoint>,
    /// How many are not listed.
    pub endpoints_left_out: usize,
    /// Rules of what is shared.
    pub shares: Vec<Share>,
    /// Rules of what is used.
    pub uses: Vec<Use>,
    /// What the owners that are followed list for this node.
    pub offers: Vec<Offer>,
    /// Links that are up.
    pub links: Vec<Link>,
    /// Routers that are looked for.
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
    /// What the user was told once.
    pub problems: Vec<String>,
    /// Alerts for an operator.
    pub alerts: Vec<Alert>,
}

/// The calls of a service that got no answer, since the node started.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ServiceCalls {
    /// As it is called on the local network.
    pub topic: String,
    /// Whether its servers are here, and not its clients.
    pub is_served: bool,
    /// By reason.
    pub lost: Vec<LostCalls>,
}

/// The calls that got no answer for one reason.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct LostCalls {
    /// The counter of the reason.
    pub reason: String,
    /// All of them.
    pub count: u64,
    /// Those since a call was answered last.
    pub since_answer: u64,
    /// Those of ROS 2 nodes here, or of nodes elsewhere, that are still there, by their names.
    pub by: BTreeMap<String, u64>,
    /// Seconds since the last one.
    pub last_s: u64,
}

/// What an interface is.
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

/// Which messages of a topic are meant.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// What is published on the local network.
    Local,
    /// What comes from the far side and is given to the local network.
    Far,
    /// What goes from here to the far side, after what the user limits.
    Sent,
}

impl Side {
    /// As the command line and the status socket spell it.
    pub fn label(self) -> &'static str {
        match self {
            Self::Local => "local",
            Self::Far => "far",
            Self::Sent => "sent",
        }
    }

    /// The side that is spelt so.
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

    /// Reliability as ROS 2 spells it.
    pub fn reliability(&self) -> &'static str {
        if self.reliable { "RELIABLE" } else { "BEST_EFFORT" }
    }

    /// Durability, likewise.
    pub fn durability(&self) -> &'static str {
        ["VOLATILE", "TRANSIENT_LOCAL", "TRANSIENT", "PERSISTENT"]
            .get(usize::from(self.durability))
            .unwrap_or(&"?")
    }

    /// Liveliness, likewise.
    pub fn liveliness(&self) -> &'static str {
        ["AUTOMATIC", "MANUAL_BY_PARTICIPANT", "MANUAL_BY_TOPIC"]
            .get(usize::from(self.liveliness))
            .unwrap_or(&"?")
    }

    /// The first policy by which a reader that asks for this does not match a writer that offers `offered` (DDS 1.4,
    /// 2.2.3), with what is offered and what is asked for.
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
        // Patterns may match anything; they are left to DDS.
        let is_pattern = |p: &String| p.contains(['*', '?', '[']);
        let all =
            |qos: &Self| if qos.partitions.is_empty() { vec![String::new()] } else { qos.partitions.clone() };
        let (asked, offers) = (all(self), all(offered));
        let meets = asked.iter().any(|p| offers.contains(p));
        if !meets && !asked.iter().chain(&offers).any(is_pattern) {
            return Some(("partition", format!("{offers:?}"), format!("{asked:?}")));
        }
        // What is written here is of one representation: plain CDR, if it is among those that are offered.
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
    /// ROS topic; the DDS topic where it is none.
    pub topic: String,
    /// Whether it is a topic of ROS 2 that is no part of a service.
    pub is_ros_topic: bool,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if it says so.
    pub type_hash: Option<String>,
    /// Whether it writes.
    pub writes: bool,
    /// Its node with its namespace, if it is known.
    pub node: Option<String>,
    /// Its GUID, hexadecimal.
    pub guid: String,
    /// What it offers or asks for.
    pub qos: Qos,
    /// The rule that shares its topic, by its place in [`Graph::shares`].
    pub shared_by: Option<usize>,
}

/// A rule of what is shared.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Share {
    /// What kind of interface.
    pub kind: Interface,
    /// As the rule names it.
    pub topic: String,
    /// The type that the rule names.
    pub wanted_type: Option<String>,
    /// Who may subscribe, and who may publish: how many nodes, groups and fleets are named.
    pub to: [usize; 3],
    /// Likewise.
    pub publish: [usize; 3],
    /// Nodes and groups among them of which no member was heard since the node started.
    pub unheard: Vec<UnheardMember>,
    /// What runs of it.
    pub routes: Vec<ShareRoute>,
}

/// A node or a group that a rule names and of which no member was heard.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct UnheardMember {
    /// Its name as the rule has it, behind `group:` if it is a group.
    pub name: String,
    /// The name of a member that was heard of, if that is nearly the same.
    pub meant: Option<String>,
}

/// A shared interface.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ShareRoute {
    /// As it is called on the local network.
    pub topic: String,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Its name, hexadecimal.
    pub name: String,
    /// Local publishers.
    pub writers: usize,
    /// Whether they are read.
    pub is_read: bool,
    /// Whether what others publish is written here; whether others can call it, if it is a service.
    pub is_written: bool,
    /// What the local publishers offer together.
    pub qos: Option<Qos>,
    /// Granted nodes.
    pub granted: Vec<String>,
    /// The type hashes that subscribers, or clients, of other nodes announce, as far as those tell it.
    pub consumer_hashes: BTreeMap<String, BTreeSet<String>>,
    /// Refused nodes, and why.
    pub refused: BTreeMap<String, String>,
    /// Messages published.
    pub messages: u64,
    /// Messages of others given to the local network, and the local readers that get them.
    pub written: u64,
    /// Likewise.
    pub matched: u32,
    /// Whether what is published here travels as JSON.
    pub is_json: bool,
    /// Whether messages travel as JSON, and what they look like is not known here.
    pub lacks_definition: bool,
}

/// A rule of what is used.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Use {
    /// What kind of interface.
    pub kind: Interface,
    /// Whether this node publishes on it.
    pub publishes: bool,
    /// As the rule names it: what the owner calls it.
    pub topic: String,
    /// What that is called on the local network.
    pub local_topic: String,
    /// The type that the rule asks for.
    pub wanted_type: Option<String>,
    /// Owner's node id.
    pub owner_id: String,
    /// Owner's name.
    pub owner: String,
    /// What is wrong with the owner, if anything.
    pub owner_state: Option<String>,
    /// Where following the owner stands: `"waiting"`, `"asked"`, `"refused"`, `"granted"`.
    pub follow: Option<String>,
    /// Whether the owner's catalogue is here.
    pub has_catalogue: bool,
    /// Whether a token leads to it.
    pub is_token: bool,
    /// Its name, if a token leads to it.
    pub name: Option<String>,
    /// Why the token was refused.
    pub refused: Option<String>,
    /// What runs of it.
    pub routes: Vec<UseRoute>,
}

/// An interface of another node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct UseRoute {
    /// As it is called on the local network.
    pub topic: String,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if the owner knows it.
    pub type_hash: Option<String>,
    /// Its name, hexadecimal.
    pub name: String,
    /// What the owner offers.
    pub qos: Qos,
    /// Whether the owner granted it.
    pub is_granted: bool,
    /// Who refused it, and why.
    pub refused: Option<String>,
    /// Where asking for it stands, as in [`Use::follow`].
    pub join: Option<String>,
    /// Writers for it on the local network; a server, if it is a service.
    pub writers: usize,
    /// Local readers that they are matched with.
    pub matched: u32,
    /// Local publishers, if this node publishes on it.
    pub publishers: usize,
    /// Whether they are read.
    pub is_read: bool,
    /// Messages given to the local network, or published.
    pub messages: u64,
    /// Whether messages travel as JSON, and what they look like is not known here.
    pub lacks_definition: bool,
}

/// What an owner lists for this node.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Offer {
    /// Owner's node id.
    pub owner_id: String,
    /// Owner's name, if a rule names it.
    pub owner: Option<String>,
    /// What kind of interface.
    pub kind: Interface,
    /// As the owner calls it.
    pub topic: String,
    /// ROS type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// `RIHS01_…`, if the owner knows it.
    pub type_hash: Option<String>,
    /// What the owner offers.
    pub qos: Qos,
    /// Its name, hexadecimal.
    pub name: String,
    /// Whether this node may subscribe.
    pub subscribe: bool,
    /// Whether this node may publish.
    pub publish: bool,
    /// Whether a rule asks for it.
    pub is_used: bool,
}

/// A link.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Link {
    /// Its number.
    pub id: u32,
    /// Node id of the peer.
    pub peer: String,
    /// The peer's name, if it is known.
    pub name: Option<String>,
    /// Its address.
    pub remote: String,
    /// Round trip, microseconds.
    pub rtt_us: u64,
    /// True while nothing comes over it although something should.
    pub silent: bool,
}

/// A router that is looked for.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Search {
    /// As the configuration names it.
    pub router: String,
    /// How that goes.
    pub state: String,
    /// Why it failed last.
    pub last_failure: Option<String>,
}

/// What this node knows of a name.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct NameLine {
    /// The way to its owner: number of a link, 0 for this node, and microseconds of round trip.
    pub way: Option<(u32, u32)>,
    /// Links that packets leave on; 0 for this node.
    pub out: Vec<u32>,
    /// Links that they come from.
    pub up: Vec<u32>,
    /// Whether packets are forwarded at all: there is a branch.
    pub has_branch: bool,
    /// Packets taken in.
    pub packets: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// What was dropped, by reason.
    pub dropped: BTreeMap<String, u64>,
}
