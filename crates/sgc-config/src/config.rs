//! The resolved configuration: types and bounds of its values.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use sgc_ros::{Interface, Naming, QosOverride, Resume, Shaping};
use sgc_router::MappingKind;
use sgc_store::{StorePrefix, StoreServer};
use sgc_transport::{Congestion, ListenAddr};
use sgc_trust::{FleetName, NodeName, OBSERVERS_GROUP, ShareToken, Suite};
use sgc_wire::{Class, NodeId};

use crate::gateway::GatewayConfig;
use crate::metrics::MetricsConfig;
use crate::recipient::Recipient;
use crate::router_url::RouterUrl;
use crate::zenoh::{Middleware, ZenohConfig};

/// The shortest configurable time between probes of a link.
pub const KEEP_ALIVE_MIN: Duration = Duration::from_secs(1);
/// The longest configurable time between probes of a link.
pub const KEEP_ALIVE_MAX: Duration = Duration::from_secs(60);

/// The shortest configurable time of a dead-man switch.
pub const DEAD_MAN_MIN: Duration = Duration::from_millis(20);
/// The longest configurable time of a dead-man switch.
pub const DEAD_MAN_MAX: Duration = Duration::from_secs(60);

/// The lowest rate of a peer, in bits a second. Below it, a large message takes minutes.
pub const PEER_RATE_MIN: u64 = 64_000;
/// The highest rate of a peer, in bits a second: more than any network carries.
pub const PEER_RATE_MAX: u64 = 1_000_000_000_000;

/// The store in which a router keeps names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoreSettings {
    /// Servers of the store; those of a cluster name the others.
    pub servers: Vec<StoreServer>,
    /// Beginning of all keys.
    pub prefix: StorePrefix,
    /// User of the store's ACL, and the file of its password.
    pub user: Option<(String, PathBuf)>,
    /// File with the CAs that vouch for servers with TLS; `None` means the system's.
    pub ca: Option<PathBuf>,
    /// Files with the certificate chain that is shown to servers with TLS, and its key.
    pub certificate: Option<(PathBuf, PathBuf)>,
}

/// A node's configuration, valid in itself.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Config {
    /// The required name in the identity, if the user gave one.
    pub node_name: Option<NodeName>,
    /// The identity file. Where only a name is given, it is `NAME.identity` beside the configuration.
    pub identity: PathBuf,
    /// Routers to connect to, and how each is found.
    pub routers: Vec<RouterUrl>,
    /// DNS server for routers' host names and SRV records; `None` means the system's.
    pub resolver: Option<SocketAddr>,
    /// Longest silence of a peer before it is probed, [`KEEP_ALIVE_MIN`] to [`KEEP_ALIVE_MAX`]; `None` adapts to the
    /// path.
    pub keep_alive: Option<Duration>,
    /// Listen addresses; port 0 lets the system choose. If there are any, this node is a router.
    pub listen: Vec<ListenAddr>,
    /// Limit of one peer's traffic into this node, bits a second; [`PEER_RATE_MIN`] to [`PEER_RATE_MAX`].
    pub peer_rate: Option<u64>,
    /// Mapping by which this router learns owners of names.
    pub mapping: MappingKind,
    /// The store of this router, with [`MappingKind::Store`].
    pub store: Option<StoreSettings>,
    /// Whether the router announces itself on the local network.
    pub announce: bool,
    /// Files with the CAs whose nodes may attach; if empty, all trusted CAs.
    pub accept: Vec<PathBuf>,
    /// The local ROS 2 network; `None` for a node that is only a router.
    pub ros: Option<RosConfig>,
    /// Shares of this node, each topic once.
    pub shares: Vec<ShareConfig>,
    /// Uses of this node, each topic of an owner once, none of them shared.
    pub uses: Vec<UseConfig>,
    /// Tokens from partners.
    pub tokens: Vec<TokenConfig>,
    /// Other fleets, or some of their nodes, that shares may name.
    pub partners: Vec<PartnerConfig>,
    /// Files with further CAs whose nodes may link to this one.
    pub trust: Vec<PathBuf>,
    /// Whether the configuration is reloaded when its file changes.
    pub watch: bool,
    /// Set if this node is its fleet's authority.
    pub authority: Option<AuthorityConfig>,
    /// State directory, if not the usual one.
    pub state: Option<PathBuf>,
    /// Bounds after which topics get new keys.
    pub rotation: RotationConfig,
    /// Audit log of grants and refusals.
    pub audit: AuditConfig,
    /// Settings of links.
    pub transport: TransportConfig,
    /// Gateway for programs without ROS; `None` without `[gateway]`. With it, `ros` is set as well.
    pub gateway: Option<GatewayConfig>,
    /// Server and pushes of metrics; `None` without `[metrics]`.
    pub metrics: Option<MetricsConfig>,
    /// Nodes and groups of the fleet with which this node has direct links.
    pub direct: Vec<Recipient>,
    /// Whether this node asks its gateway to map a port for direct links.
    pub port_mapping: bool,
    /// Path of the status socket, if not the usual one.
    pub admin_socket: Option<PathBuf>,
    /// Nodes and groups of the fleet that may ask this node how it is doing; [`Config::observers`] has the usual ones
    /// for `None`.
    pub observers: Option<Vec<Recipient>>,
}

impl Config {
    /// Returns the nodes and groups of the fleet that may ask this node how it is doing.
    pub fn observers(&self) -> Vec<Recipient> {
        let usual = || OBSERVERS_GROUP.parse().map(Recipient::Group).into_iter().collect();
        self.observers.clone().unwrap_or_else(usual)
    }
}

/// A fleet's authority.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuthorityConfig {
    /// The fleet file.
    pub fleet: PathBuf,
    /// Nodes and groups that may carry out operations on the fleet.
    pub operators: Vec<Recipient>,
}

impl AuthorityConfig {
    /// Creates an authority without operators.
    pub fn new(fleet: PathBuf) -> Self {
        Self { fleet, operators: Vec::new() }
    }
}

/// Settings of links. Each transport applies those that it supports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransportConfig {
    /// Congestion controller.
    pub congestion: Congestion,
    /// Whether the system may segment and coalesce datagrams.
    pub offload: bool,
    /// Whether links search for the longest packet that the path carries.
    pub mtu_discovery: bool,
    /// Whether large topics of QUIC links may take bulk lanes, TLS connections at the TCP port of the link's number.
    pub bulk_lanes: bool,
    /// Whether this node dials listeners that speak only DTLS 1.2, which see certificates in the clear.
    pub dtls12: bool,
    /// DSCP mark of packets, 0 to 63.
    pub dscp: Option<u8>,
    /// DSCP mark of lanes that this node dials.
    pub lane_dscp: Option<u8>,
}

impl Default for TransportConfig {
    fn default() -> Self {
        let congestion = Congestion::default();
        Self {
            congestion,
            offload: true,
            mtu_discovery: true,
            bulk_lanes: true,
            dtls12: false,
            dscp: None,
            lane_dscp: None,
        }
    }
}

/// The local ROS 2 network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosConfig {
    /// Middleware of the network's programs.
    pub middleware: Middleware,
    /// ROS domain id, 0 to [`DOMAIN_ID_MAX`](crate::DOMAIN_ID_MAX) for DDS, else any.
    pub domain_id: u32,
    /// Range of discovery of DDS.
    pub discovery: DiscoveryRange,
    /// Further host names and IP addresses to discover. Empty if the range is `Off` or `SystemDefault`.
    pub static_peers: Vec<String>,
    /// Whether far nodes appear in the local ROS graph, and local ones in far ones.
    pub graph: bool,
    /// Directories of packages that define types, searched before `AMENT_PREFIX_PATH` and the built-in definitions.
    pub definitions: Vec<PathBuf>,
    /// `CYCLONEDDS_URI` unchanged, so that a network's Cyclone DDS settings apply here too.
    pub cyclonedds_uri: Option<String>,
    /// The enclave of a network that DDS Security protects.
    pub security: Option<SecurityConfig>,
    /// Session of the network of rmw_zenoh; the default with [`Middleware::Dds`].
    pub zenoh: ZenohConfig,
}

/// The enclave with which the local ROS 2 network is joined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SecurityConfig {
    /// The directory that `ROS_SECURITY_KEYSTORE` names.
    pub keystore: PathBuf,
    /// The enclave's name, such as `/sgc`: see [`sgc_ros::is_enclave`].
    pub enclave: String,
    /// Whether a missing enclave is an error. `false` if `ROS_SECURITY_STRATEGY` is not `Enforce`: ROS 2 then goes on
    /// without security.
    pub enforced: bool,
}

impl Default for RosConfig {
    fn default() -> Self {
        Self {
            middleware: Middleware::default(),
            domain_id: 0,
            discovery: DiscoveryRange::default(),
            static_peers: Vec::new(),
            graph: true,
            definitions: Vec::new(),
            cyclonedds_uri: None,
            security: None,
            zenoh: ZenohConfig::default(),
        }
    }
}

/// Range of ROS 2 discovery (`ROS_AUTOMATIC_DISCOVERY_RANGE`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// No discovery.
    Off,
    /// This host only.
    Localhost,
    /// The reach of multicast.
    #[default]
    Subnet,
    /// The middleware's own configuration.
    SystemDefault,
}

/// An interface that this node owns and lets others use.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareConfig {
    /// Kind of the interface.
    pub interface: Interface,
    /// Fully qualified ROS 2 name, or a pattern.
    pub topic: String,
    /// Exceptions, and the name for others.
    pub naming: Naming,
    /// `pkg/msg/Name`, or `srv` or `action` in the middle; `None` takes it from DDS discovery.
    pub type_name: Option<String>,
    /// Recipients that may subscribe or call; not empty, without duplicates.
    pub to: Vec<Recipient>,
    /// Nodes that may publish besides this one, without duplicates.
    pub publish: Vec<Recipient>,
    /// Class of its packets.
    pub priority: Class,
    /// Dead-man switch of what the others publish.
    pub dead_man: Option<DeadManConfig>,
    /// Limits of rate, bandwidth and age.
    pub shaping: Shaping,
    /// QoS policies that replace those of its publishers.
    pub qos: QosOverride,
    /// Whether the topic has a lane to the next node.
    pub dedicated: bool,
    /// Suite that seals its payloads.
    pub suite: Suite,
    /// Further metadata of its name.
    pub metadata: ShareMetadata,
}

/// Metadata fields of a share. Missing fields are empty. Each has at most [`sgc_wire::METADATA_FIELD_BYTES_MAX`] bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ShareMetadata {
    /// Free text.
    pub description: String,
    /// Author.
    pub author: String,
    /// Maintainer.
    pub maintainer: String,
    /// Interface description.
    pub interface: String,
    /// Text that distinguishes otherwise equal metadata.
    pub unique: String,
    /// The ROS node that provides it.
    pub node: String,
}

/// An interface of another node that this node receives, or publishes on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UseConfig {
    /// The owner.
    pub from: NodeName,
    /// Kind of the interface.
    pub interface: Interface,
    /// Fully qualified ROS 2 name at the owner, or a pattern.
    pub topic: String,
    /// Exceptions, and the local name.
    pub naming: Naming,
    /// Prefix of frame names in tf messages.
    pub frame_prefix: Option<String>,
    /// Dead-man switch of a topic that comes here.
    pub dead_man: Option<DeadManConfig>,
    /// `pkg/msg/Name`, if the user insists on a type; otherwise the owner's catalogue decides.
    pub type_name: Option<String>,
    /// Whether this node publishes on the topic instead of receiving it.
    pub publish: bool,
    /// Class of published packets; `None` follows the owner.
    pub priority: Option<Class>,
    /// Limits of rate, bandwidth and age, in either direction.
    pub shaping: Shaping,
    /// Local QoS policies that replace those of the far publishers.
    pub qos: QosOverride,
    /// Whether the topic has a lane to the next node.
    pub dedicated: bool,
}

/// A topic that is used through a share token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TokenConfig {
    /// Source of the token.
    pub source: TokenSource,
    /// Local name of the topic.
    pub naming: Naming,
    /// Prefix of frame names in tf messages.
    pub frame_prefix: Option<String>,
    /// Dead-man switch.
    pub dead_man: Option<DeadManConfig>,
    /// Local QoS policies that replace those of the far publishers.
    pub qos: QosOverride,
    /// Whether the topic has a lane to the next node.
    pub dedicated: bool,
}

/// The dead-man switch of a topic of commands.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DeadManConfig {
    /// Longest time without a command, and most by which one may be late: [`DEAD_MAN_MIN`] to [`DEAD_MAN_MAX`].
    pub after: Duration,
    /// The stop message.
    pub stop: StopSource,
    /// Time after which the stop message is published again, within the same bounds; `None` for once.
    pub repeat: Option<Duration>,
    /// The end of a stop.
    pub resume: Resume,
}

/// Source of a stop message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum StopSource {
    /// The message with every field zero or empty.
    Zero,
    /// The last command that passed.
    Last,
    /// A JSON file.
    File(PathBuf),
}

/// Source of a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenSource {
    /// A file that only its owner may read.
    File(PathBuf),
    /// The configuration itself.
    Text(Box<ShareToken>),
}

/// Another fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PartnerConfig {
    /// Name of the partner in shares.
    pub name: FleetName,
    /// PEM file with its CA certificate.
    pub ca: PathBuf,
    /// The partner's nodes; all nodes of the CA if empty.
    pub nodes: Vec<NodeId>,
}

/// Bounds after which a topic gets a new key. Revoking a right starts a new epoch regardless.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RotationConfig {
    /// Age of the key; [`RotationConfig::EVERY_MIN`] to [`RotationConfig::EVERY_MAX`].
    pub every: Duration,
    /// Messages of one source under one key; [`RotationConfig::MESSAGES_MIN`] to [`RotationConfig::MESSAGES_MAX`].
    pub messages: u64,
}

impl RotationConfig {
    /// Lower bound of the age, since each rotation costs one grant per sink.
    pub const EVERY_MIN: Duration = Duration::from_secs(10);
    /// Upper bound of the age.
    pub const EVERY_MAX: Duration = Duration::from_secs(30 * 86_400);
    /// Lower bound of the count, since each rotation costs one grant per sink.
    pub const MESSAGES_MIN: u64 = 1024;
    /// Upper bound of the count. It is within the limit of AES-GCM under one key (NIST SP 800-38D, 8.3).
    pub const MESSAGES_MAX: u64 = 1 << 32;
}

impl Default for RotationConfig {
    fn default() -> Self {
        Self { every: Duration::from_secs(3600), messages: 1 << 24 }
    }
}

/// Limits of the audit log's size on the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AuditRoom {
    /// Most bytes of one file. It is rotated at this size.
    pub max_bytes: u64,
    /// Number of rotated files that are kept.
    pub files: u32,
}

/// The audit log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuditConfig {
    /// Path of the log; `None` is `audit.jsonl` in the state directory.
    pub file: Option<PathBuf>,
    /// Limits of its size.
    pub room: AuditRoom,
    /// Whether the log is switched off.
    pub off: bool,
}

impl AuditConfig {
    /// Smallest size of one file: some hundred records.
    pub const MAX_BYTES_MIN: u64 = 64 << 10;
    /// Largest size of one file.
    pub const MAX_BYTES_MAX: u64 = 1 << 40;
    /// Fewest rotated files. One remains, so that no record is lost as soon as a file is full.
    pub const FILES_MIN: u32 = 1;
    /// Most rotated files, since all of them are read at once.
    pub const FILES_MAX: u32 = 99;
}

impl Default for AuditConfig {
    fn default() -> Self {
        Self { file: None, room: AuditRoom { max_bytes: 16 << 20, files: 8 }, off: false }
    }
}

impl DiscoveryRange {
    /// Returns `true` if static peers have an effect.
    pub(crate) fn asks_peers(self) -> bool {
        matches!(self, Self::Localhost | Self::Subnet)
    }
}

impl Config {
    /// Returns warnings about unencrypted links, one line for each address.
    pub fn warnings(&self) -> Vec<String> {
        let listens = self.listen.iter().filter(|addr| addr.scheme.is_readable()).map(ToString::to_string);
        let urls = self.routers.iter().flat_map(RouterUrl::urls);
        let dials = urls.filter(|url| url.scheme.is_readable()).map(ToString::to_string);
        let line = |address| {
            format!(
                "{address} can be read by everybody on its way: who talks to whom, how much and when, and the hashes that stand \
                 for topics. Nobody can alter it, and payloads are sealed; quic:// and tls:// hide the rest, too"
            )
        };
        listens.chain(dials).map(line).collect()
    }

    /// Returns `true` if the node only forwards and takes no part in ROS 2.
    pub fn is_pure_router(&self) -> bool {
        self.ros.is_none()
    }

    /// Returns the share of a local topic: the one that names it, else the first whose pattern matches.
    pub fn share_of(&self, topic: &str) -> Option<&ShareConfig> {
        let named = self.shares.iter().find(|share| share.topic == topic);
        named.or_else(|| self.shares.iter().find(|share| share.naming.shares(&share.topic, topic)))
    }
}
