//! What the user wrote → a resolved, valid configuration, before any socket is bound.
//!
//! Two sources, a TOML file and the command line, become a draft (`file`, `args`); one set of rules
//! (`resolve`, `names`, `ros_env`) makes a [`Config`] of it or says everything that is wrong with it
//! ([`ConfigErrors`]). The reference for users is `docs/reference/configuration.md`.
//!
//! Nothing here reads the environment or opens a socket: variables come through [`Environment`], and of files only
//! [`load`] and [`load_args`] read any. Whether the identity file holds what it should, its owner's name
//! included, is checked by the node when it opens it.

mod args;
mod draft;
mod error;
mod file;
mod files;
mod gateway;
mod names;
mod resolve;
mod ros_env;
mod router_url;
mod schema;

use std::fs;
use std::io::{self, Read};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use crate::audit::AuditRoom;
use sgc_dds::Security;
pub use sgc_ros::{Interface, Naming, QosOverride, Rename, Shaping};
use sgc_router::MappingKind;
use sgc_transport::{Congestion, ListenAddr};
use sgc_trust::{FleetName, NodeName, ShareToken, Suite};
use sgc_wire::{Class, NodeId};

pub use args::ArgsConfig;
pub use error::{ConfigError, ConfigErrors, Mistake, Origin, TopicRule};
pub use gateway::{
    GATEWAY_CLIENTS_MAX, GatewayClientConfig, GatewayConfig, GatewayScheme, GatewayTls, GatewayUrl,
    GatewayUrlError, ORIGINS_MAX,
};
pub use names::{
    FRAME_PREFIX_BYTES_MAX, PEER_BYTES_MAX, Recipient, TYPE_BYTES_MAX, parse_duration, parse_rate,
};
pub use resolve::{
    ACCEPT_MAX, DEFINITIONS_MAX, EXCEPT_MAX, LISTEN_MAX, PARTNERS_MAX, RECIPIENTS_MAX, ROUTERS_MAX,
    SHARES_MAX, SOCKET_PATH_BYTES_MAX, SUITES, TRUST_MAX, USES_MAX,
};
pub use ros_env::{DOMAIN_ID_MAX, STATIC_PEERS_MAX};
pub use router_url::{RouterUrl, RouterUrlError, SRV_SERVICE, SrvDomain, WAYS_MAX};
pub use schema::Table;
pub(crate) use schema::nearest;
pub use sgc_ros::TOPIC_BYTES_MAX;

/// The largest file that is read as a configuration: 1024 shares with all their metadata fit.
pub const CONFIG_BYTES_MAX: u64 = 4 * 1024 * 1024;

/// The shortest time between pulses of a link.
pub const KEEP_ALIVE_MIN: Duration = Duration::from_secs(1);
/// The longest.
pub const KEEP_ALIVE_MAX: Duration = Duration::from_secs(60);

/// The least that a peer may be held to: below it a large message takes minutes.
pub const PEER_RATE_MIN: u64 = 64_000;
/// More than any network carries.
pub const PEER_RATE_MAX: u64 = 1_000_000_000_000;

/// Looks up an environment variable; `&|name| std::env::var(name).ok()` outside of tests.
pub type Environment<'e> = &'e dyn Fn(&str) -> Option<String>;

/// A node's configuration, valid in itself.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Config {
    /// The name that the identity must have, if the user said one.
    pub node_name: Option<NodeName>,
    /// The identity file. Where only a name is given, it is `NAME.identity` beside the configuration.
    pub identity: PathBuf,
    /// Routers to connect to, and how each is found.
    pub routers: Vec<RouterUrl>,
    /// The DNS server that host names and SRV records of routers are looked up at; none is the system's way.
    pub resolver: Option<SocketAddr>,
    /// How long nothing may come from a peer before it is asked whether it is there, at most; none finds out by itself.
    /// [`KEEP_ALIVE_MIN`] to [`KEEP_ALIVE_MAX`].
    pub keep_alive: Option<Duration>,
    /// Where to listen; port 0 lets the system choose. Not empty: this node is a router.
    pub listen: Vec<ListenAddr>,
    /// What one peer may send into this node, bits a second; [`PEER_RATE_MIN`] to [`PEER_RATE_MAX`].
    pub peer_rate: Option<u64>,
    /// How this router comes to know where names are.
    pub mapping: MappingKind,
    /// Tells the local network that a router is here.
    pub announce: bool,
    /// Files with the CAs whose nodes may attach; with none of them, every CA that is trusted here.
    pub accept: Vec<PathBuf>,
    /// The local ROS 2 network; none for a node that is only a router.
    pub ros: Option<RosConfig>,
    /// What this node offers, each topic once.
    pub shares: Vec<ShareConfig>,
    /// What this node wants, each topic of an owner once, none of them shared.
    pub uses: Vec<UseConfig>,
    /// What partners of other fleets handed to this node.
    pub tokens: Vec<TokenConfig>,
    /// Other fleets, or some of their nodes, that shares may name.
    pub partners: Vec<PartnerConfig>,
    /// Files with more CAs whose nodes may link to this one.
    pub trust: Vec<PathBuf>,
    /// Whether the file is read again when it changes.
    pub watch: bool,
    /// Set if this node is its fleet's authority.
    pub authority: Option<AuthorityConfig>,
    /// Where this node keeps what it has to remember, if not in its usual place.
    pub state: Option<PathBuf>,
    /// When topics get new keys.
    pub rotation: RotationConfig,
    /// Who was granted and refused what, as it is kept.
    pub audit: AuditConfig,
    /// How links are made.
    pub transport: TransportConfig,
    /// Programs without ROS on this node's network; none without `[gateway]`. Where it is there, so is `ros`.
    pub gateway: Option<GatewayConfig>,
    /// Where the status socket goes, if not in its usual place.
    pub admin_socket: Option<PathBuf>,
}

/// A fleet's authority.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuthorityConfig {
    /// The fleet file.
    pub fleet: PathBuf,
    /// Nodes and groups that may have operations on the fleet carried out.
    pub operators: Vec<Recipient>,
}

impl AuthorityConfig {
    /// An authority without operators.
    pub fn new(fleet: PathBuf) -> Self {
        Self { fleet, operators: Vec::new() }
    }
}

/// How links are made, whatever their transport can do of it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TransportConfig {
    /// What decides how much may be under way.
    pub congestion: Congestion,
    /// Whether the system may segment and gather datagrams.
    pub offload: bool,
    /// Whether the longest packet that a path carries is looked for.
    pub mtu_discovery: bool,
    /// `true` to dial listeners that speak DTLS 1.2 only, to which certificates go in the clear.
    pub dtls12: bool,
    /// What packets are marked with, 0 to 63.
    pub dscp: Option<u8>,
    /// The same for connections of single topics that this node dials.
    pub lane_dscp: Option<u8>,
}

impl Default for TransportConfig {
    fn default() -> Self {
        let congestion = Congestion::default();
        Self { congestion, offload: true, mtu_discovery: true, dtls12: false, dscp: None, lane_dscp: None }
    }
}

/// The local ROS 2 network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosConfig {
    /// 0 to [`DOMAIN_ID_MAX`].
    pub domain_id: u32,
    /// How far to look for others.
    pub discovery: DiscoveryRange,
    /// Host names and IP addresses to look at besides. Empty where the range is `Off` or `SystemDefault`.
    pub static_peers: Vec<String>,
    /// Whether far nodes appear in the local ROS graph, and local ones in far ones.
    pub graph: bool,
    /// Directories with packages that define types, looked into before `AMENT_PREFIX_PATH` and what ships inside.
    pub definitions: Vec<PathBuf>,
    /// `CYCLONEDDS_URI` as it is: what users of that middleware have set for their network holds here too.
    pub cyclonedds_uri: Option<String>,
    /// The enclave of a network that DDS Security protects.
    pub security: Option<SecurityConfig>,
}

/// The enclave with which the local ROS 2 network is joined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SecurityConfig {
    /// The enclave and its keystore.
    pub enclave: Security,
    /// `false` if the node goes without security where the keystore has no such enclave, as `ROS_SECURITY_STRATEGY` other than
    /// `Enforce` means to ROS 2.
    pub enforced: bool,
}

impl Default for RosConfig {
    fn default() -> Self {
        let (discovery, static_peers) = (DiscoveryRange::default(), Vec::new());
        let (definitions, cyclonedds_uri, security) = (Vec::new(), None, None);
        Self { domain_id: 0, discovery, static_peers, graph: true, definitions, cyclonedds_uri, security }
    }
}

/// How far ROS 2 discovery reaches (`ROS_AUTOMATIC_DISCOVERY_RANGE`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// Nobody is discovered.
    Off,
    /// This host.
    Localhost,
    /// As far as multicast reaches.
    #[default]
    Subnet,
    /// Whatever the middleware's own configuration says.
    SystemDefault,
}

/// A topic that this node owns and lets others subscribe to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ShareConfig {
    /// What it is.
    pub interface: Interface,
    /// A fully qualified ROS 2 name, or a pattern of such.
    pub topic: String,
    /// What is left out, and what the rest is called for others.
    pub naming: Naming,
    /// `pkg/msg/Name`, or `srv` or `action` in the middle; taken from discovery where it is not given.
    pub type_name: Option<String>,
    /// Who may subscribe, or call; never empty, no one twice.
    pub to: Vec<Recipient>,
    /// Who may publish besides this node; no one twice.
    pub publish: Vec<Recipient>,
    /// What overtakes it.
    pub priority: Class,
    /// How much of it goes out.
    pub shaping: Shaping,
    /// Policies in place of its publishers'.
    pub qos: QosOverride,
    /// Whether it has a connection of its own to the next node.
    pub dedicated: bool,
    /// How its payloads are sealed.
    pub suite: Suite,
    /// What else goes into its name.
    pub metadata: ShareMetadata,
}

/// The metadata fields of a share; those not given are empty. Each is at most
/// [`sgc_wire::METADATA_FIELD_BYTES_MAX`] bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ShareMetadata {
    /// Free text.
    pub description: String,
    /// Who wrote it.
    pub author: String,
    /// Who looks after it.
    pub maintainer: String,
    /// Interface description.
    pub interface: String,
    /// Tells apart what is otherwise alike.
    pub unique: String,
    /// The ROS node that provides it.
    pub node: String,
}

/// A topic of another node that is to appear here, or that this node publishes on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct UseConfig {
    /// The node that shares it.
    pub from: NodeName,
    /// What it is.
    pub interface: Interface,
    /// A fully qualified ROS 2 name there, or a pattern of such.
    pub topic: String,
    /// What is left out, and what the rest is called here.
    pub naming: Naming,
    /// What the names of frames in tf messages get in front.
    pub frame_prefix: Option<String>,
    /// `pkg/msg/Name`, if the user insists on one; otherwise the owner's catalogue says.
    pub type_name: Option<String>,
    /// True if local messages go there, false if it appears here.
    pub publish: bool,
    /// What overtakes that which is published there; as the owner says if not given.
    pub priority: Option<Class>,
    /// How much of it goes on, whichever way.
    pub shaping: Shaping,
    /// Policies here in place of the far publishers'.
    pub qos: QosOverride,
    /// Whether it has a connection of its own to the next node.
    pub dedicated: bool,
}

/// A topic that is used by a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TokenConfig {
    /// Where the token is.
    pub source: TokenSource,
    /// What its topic is called here.
    pub naming: Naming,
    /// What the names of frames in tf messages get in front.
    pub frame_prefix: Option<String>,
    /// Policies here in place of the far publishers'.
    pub qos: QosOverride,
    /// Whether it has a connection of its own to the next node.
    pub dedicated: bool,
}

/// Where a token is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum TokenSource {
    /// In a file of its own, for its owner alone.
    File(PathBuf),
    /// In the configuration.
    Text(Box<ShareToken>),
}

/// Another fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PartnerConfig {
    /// What shares call it.
    pub name: FleetName,
    /// The file with its CA certificate, PEM.
    pub ca: PathBuf,
    /// The nodes that are meant; all of that CA if there are none.
    pub nodes: Vec<NodeId>,
}

/// When a topic gets a new key besides when somebody loses the right to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RotationConfig {
    /// After this time; [`RotationConfig::EVERY_MIN`] to [`RotationConfig::EVERY_MAX`].
    pub every: Duration,
    /// After this many messages of one source; [`RotationConfig::MESSAGES_MIN`] to
    /// [`RotationConfig::MESSAGES_MAX`].
    pub messages: u64,
}

impl RotationConfig {
    /// Each rotation costs a grant for each sink.
    pub const EVERY_MIN: Duration = Duration::from_secs(10);
    /// A key that is older is none that rotates.
    pub const EVERY_MAX: Duration = Duration::from_secs(30 * 86_400);
    /// Each rotation costs a grant for each sink.
    pub const MESSAGES_MIN: u64 = 1024;
    /// Within what AES-GCM may seal under one key (NIST SP 800-38D, 8.3).
    pub const MESSAGES_MAX: u64 = 1 << 32;
}

impl Default for RotationConfig {
    fn default() -> Self {
        Self { every: Duration::from_secs(3600), messages: 1 << 24 }
    }
}

/// The audit log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AuditConfig {
    /// The file; none is `audit.jsonl` in the state directory.
    pub file: Option<PathBuf>,
    /// The room that it may take.
    pub room: AuditRoom,
    /// Nothing is written.
    pub off: bool,
}

impl AuditConfig {
    /// Some hundred records.
    pub const MAX_BYTES_MIN: u64 = 64 << 10;
    /// As much as any disk has.
    pub const MAX_BYTES_MAX: u64 = 1 << 40;
    /// One file that was put aside, so that no record is gone as soon as a file is full.
    pub const FILES_MIN: u32 = 1;
    /// A number of files that is read at once.
    pub const FILES_MAX: u32 = 99;
}

impl Default for AuditConfig {
    fn default() -> Self {
        Self { file: None, room: AuditRoom { max_bytes: 16 << 20, files: 8 }, off: false }
    }
}

impl DiscoveryRange {
    /// Whether static peers count for anything.
    fn asks_peers(self) -> bool {
        matches!(self, Self::Localhost | Self::Subnet)
    }
}

impl Config {
    /// Returns what to tell the user about links that can be read on their way, one line for each address.
    pub fn warnings(&self) -> Vec<String> {
        let listens = self.listen.iter().filter(|addr| addr.scheme.is_readable()).map(ToString::to_string);
        let ways = self.routers.iter().flat_map(RouterUrl::ways);
        let dials = ways.filter(|url| url.scheme.is_readable()).map(ToString::to_string);
        let line = |address| {
            format!(
                "{address} can be read by everybody on its way: who talks to whom, how much and when, and the hashes that stand \
                 for topics. Nobody can alter it, and payloads are sealed; quic:// and tls:// hide the rest, too"
            )
        };
        listens.chain(dials).map(line).collect()
    }

    /// Takes part in ROS 2 not at all and only passes packets on.
    pub fn is_pure_router(&self) -> bool {
        self.ros.is_none()
    }

    /// The share of a local topic: the one that names it, else the first whose pattern covers it.
    pub fn share_of(&self, topic: &str) -> Option<&ShareConfig> {
        let named = self.shares.iter().find(|share| share.topic == topic);
        named.or_else(|| self.shares.iter().find(|share| share.naming.shares(&share.topic, topic)))
    }

    /// Resolves the command line without looking at any file. The ROS environment counts as it does with a file.
    pub fn from_args(args: &ArgsConfig, env: Environment<'_>) -> Result<Self, ConfigErrors> {
        let (draft, errors) = args::read(args);
        resolve::resolve(&draft, errors, Path::new(""), env, None).map_err(ConfigErrors::new)
    }
}

/// Checks a message type that stands outside of a configuration, and gives it as `pkg/msg/Name`.
pub fn message_type(value: &str) -> Result<String, Mistake> {
    names::message_type("--type", value)
}

/// Reads and resolves a file, and checks that the identity file is there, readable, and its owner's alone.
///
/// Relative paths in it are taken from its directory.
pub fn load(path: &Path, env: Environment<'_>) -> Result<Config, ConfigErrors> {
    let file_name = path.display().to_string();
    let text = read_limited(path).map_err(|mistake| {
        let origin = Origin::File { file: Arc::from(file_name.as_str()), line: None };
        ConfigErrors::from(ConfigError::new(origin, mistake))
    })?;
    let base_dir = path.parent().unwrap_or(Path::new(""));
    resolve_text(&text, &file_name, base_dir, env, Some(&files::FILES))
}

/// Resolves the command line as [`Config::from_args`] does, and checks the identity file as [`load`] does.
pub fn load_args(args: &ArgsConfig, env: Environment<'_>) -> Result<Config, ConfigErrors> {
    let (draft, errors) = args::read(args);
    resolve::resolve(&draft, errors, Path::new(""), env, Some(&files::FILES)).map_err(ConfigErrors::new)
}

/// Resolves the text of a file that errors call `file_name`, without looking at any file.
pub fn parse(
    text: &str,
    file_name: &str,
    base_dir: &Path,
    env: Environment<'_>,
) -> Result<Config, ConfigErrors> {
    resolve_text(text, file_name, base_dir, env, None)
}

fn resolve_text(
    text: &str,
    file_name: &str,
    base_dir: &Path,
    env: Environment<'_>,
    checks: Option<&resolve::FileChecks>,
) -> Result<Config, ConfigErrors> {
    match file::read(text, file_name) {
        (Some(draft), errors) => {
            resolve::resolve(&draft, errors, base_dir, env, checks).map_err(ConfigErrors::new)
        }
        (None, errors) => Err(ConfigErrors::new(errors)),
    }
}

fn read_limited(path: &Path) -> Result<String, Mistake> {
    let unreadable = |error: io::Error| Mistake::Unreadable { reason: error.to_string() };
    let file = fs::File::open(path).map_err(unreadable)?;
    let mut bytes = Vec::new();
    file.take(CONFIG_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(unreadable)?;
    if bytes.len() as u64 > CONFIG_BYTES_MAX {
        let bytes = fs::metadata(path).map_or(CONFIG_BYTES_MAX + 1, |metadata| metadata.len());
        return Err(Mistake::TooLarge { bytes, max: CONFIG_BYTES_MAX });
    }
    String::from_utf8(bytes).map_err(|error| {
        let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = 1 + valid.iter().filter(|byte| **byte == b'\n').count();
        Mistake::Unreadable { reason: format!("line {line} is not UTF-8 text") }
    })
}
