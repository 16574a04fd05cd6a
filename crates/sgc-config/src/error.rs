//! [`ConfigErrors`]: mistakes in a configuration, one variant for each, with the place, the value and the fix.
//!
//! The other files of this module find the mistakes.

use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use sgc_gateway::{PageOriginError, ScopeError};
use sgc_store::{StorePrefixError, StoreServerError, StoreUserError};
use sgc_transport::UrlError;
use sgc_trust::{CertificateNameError, TokenError};

use crate::config::{PEER_RATE_MAX, PEER_RATE_MIN};
use crate::gateway::{GatewayUrl, GatewayUrlError};
use crate::metrics::OtlpUrlError;
use crate::router_url::RouterUrlError;
use crate::units::{duration_text, rate_text, size_text};
use crate::zenoh::{ZENOH_OVERRIDE_KEY_BYTES_MAX, ZENOH_OVERRIDE_VALUE_BYTES_MAX};

/// All mistakes, in the order of the file; never empty.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigErrors {
    errors: Vec<ConfigError>,
}

impl ConfigErrors {
    /// Sorts by place and keeps the order of discovery within a line.
    pub(crate) fn new(mut errors: Vec<ConfigError>) -> Self {
        debug_assert!(!errors.is_empty());
        errors.sort_by_key(|error| error.origin.rank());
        Self { errors }
    }

    /// Iterates over the mistakes.
    pub fn iter(&self) -> std::slice::Iter<'_, ConfigError> {
        self.errors.iter()
    }
}

impl<'e> IntoIterator for &'e ConfigErrors {
    type Item = &'e ConfigError;
    type IntoIter = std::slice::Iter<'e, ConfigError>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

impl From<ConfigError> for ConfigErrors {
    fn from(error: ConfigError) -> Self {
        Self::new(vec![error])
    }
}

impl fmt::Display for ConfigErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, error) in self.errors.iter().enumerate() {
            if i > 0 {
                f.write_str("\n")?;
            }
            write!(f, "{error}")?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigErrors {}

/// One mistake with its place.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{origin}: {mistake}")]
pub struct ConfigError {
    /// The place of the mistake.
    pub origin: Origin,
    /// The mistake.
    pub mistake: Box<Mistake>,
}

impl ConfigError {
    /// Creates an error.
    pub fn new(origin: Origin, mistake: Mistake) -> Self {
        Self { origin, mistake: Box::new(mistake) }
    }
}

/// The source of a value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// A file. There is no line if something is missing from the whole file.
    File {
        /// The path as the user wrote it.
        file: Arc<str>,
        /// Counted from 1.
        line: Option<usize>,
    },
    /// The command line.
    Arguments,
    /// The environment.
    Environment,
}

impl Origin {
    fn rank(&self) -> (u8, usize) {
        match self {
            Self::File { line, .. } => (0, line.unwrap_or(usize::MAX)),
            Self::Arguments => (1, 0),
            Self::Environment => (2, 0),
        }
    }
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { file, line: Some(line) } => write!(f, "{file}:{line}"),
            Self::File { file, line: None } => f.write_str(file),
            Self::Arguments => f.write_str("command line"),
            Self::Environment => f.write_str("environment"),
        }
    }
}

/// A mistake. `key` names the value in the user's words: a key, an argument or a variable.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Mistake {
    // The file.
    /// The file could not be read.
    #[error("cannot read the configuration: {reason}")]
    Unreadable {
        /// The error of the operating system.
        reason: String,
    },
    /// The file exceeds the size limit.
    #[error("the file has {bytes} bytes; a configuration has at most {max}")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The limit.
        max: u64,
    },
    /// The file is not TOML.
    #[error("not TOML: {message}")]
    Syntax {
        /// The error of the parser.
        message: String,
    },

    // Keys.
    /// A key that no version knows.
    #[error("{table} has no key `{key}`; {}", suggest_key(*nearest, known))]
    UnknownKey {
        /// The table, brackets included.
        table: &'static str,
        /// The key.
        key: String,
        /// The nearest valid word.
        nearest: Option<&'static str>,
        /// The keys of the table.
        known: &'static [&'static str],
    },
    /// A key of another table.
    #[error("{table} has no key `{key}`; it belongs in {}", homes.join(" or "))]
    MisplacedKey {
        /// The table in which it stands.
        table: &'static str,
        /// The key.
        key: String,
        /// The tables that have it.
        homes: Vec<&'static str>,
    },
    /// A key of the design that is not implemented yet.
    #[error("`{key}` is planned but not in this version; take it out")]
    PlannedKey {
        /// The key.
        key: String,
    },
    /// A table that names two interfaces.
    #[error("`{key}` stands beside `{other}`: a table is about one of them; make it two tables")]
    TwoInterfaces {
        /// The key.
        key: &'static str,
        /// The key that came first.
        other: &'static str,
    },
    /// A key that only topics have, in a table of another interface.
    #[error("`{key}` is for topics, and this is about `{interface}`: take it out")]
    TopicsOnly {
        /// The key.
        key: &'static str,
        /// The kind of interface that the table describes.
        interface: &'static str,
    },
    /// A type of another kind of interface.
    #[error("`{key}` is {value:?}; the type of `{interface}` is spelt like {example:?}")]
    InterfaceType {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The kind of interface that the table describes.
        interface: &'static str,
        /// A valid value.
        example: &'static str,
    },
    /// A required key is missing.
    #[error("{table} has no `{key}`; add one, such as {key} = {example}")]
    MissingKey {
        /// The table, brackets included.
        table: &'static str,
        /// The key.
        key: &'static str,
        /// A valid value.
        example: &'static str,
    },
    /// `[share]` for `[[share]]`.
    #[error("`{key}` is one table but may occur many times; write [[{key}]]")]
    NotRepeated {
        /// The table's name.
        key: &'static str,
    },
    /// `[[node]]` for `[node]`.
    #[error("`{key}` is {found} but may occur only once; write [{key}]")]
    NotSingle {
        /// The table's name.
        key: &'static str,
        /// The value that was found.
        found: String,
    },

    // Values.
    /// A value of the wrong type.
    #[error("`{key}` is {found}; it takes {expected}")]
    WrongType {
        /// The key.
        key: &'static str,
        /// The value that was found.
        found: String,
        /// The expected value, with an example.
        expected: &'static str,
    },
    /// A text that may not be empty.
    #[error("`{key}` is empty; give it a value, such as {example}")]
    Empty {
        /// The key.
        key: &'static str,
        /// A valid value.
        example: &'static str,
    },
    /// A text over its limit.
    #[error("`{key}` has {bytes} bytes; it has at most {max}")]
    TooLong {
        /// The key.
        key: &'static str,
        /// Its length.
        bytes: usize,
        /// The limit.
        max: usize,
    },
    /// More tables or arguments of a kind than the limit.
    #[error("{what} occurs {count} times; it may occur at most {max} times")]
    TooMany {
        /// A table with its brackets, or an argument.
        what: &'static str,
        /// The number of entries.
        count: usize,
        /// The limit.
        max: usize,
    },
    /// A list over its limit.
    #[error("`{key}` has {count} entries; it may have at most {max}")]
    TooManyEntries {
        /// The key.
        key: &'static str,
        /// The number of entries.
        count: usize,
        /// The limit.
        max: usize,
    },
    /// The same entry twice in one list.
    #[error("`{key}` names {value:?} twice; once is enough")]
    Repeated {
        /// The key.
        key: &'static str,
        /// The entry.
        value: String,
    },
    /// A word that is not in the list of valid words.
    #[error("`{key}` is {value:?}; {}", suggest_word(*nearest, known))]
    UnknownWord {
        /// The key.
        key: &'static str,
        /// The word.
        value: String,
        /// The nearest valid word.
        nearest: Option<&'static str>,
        /// The valid words.
        known: &'static [&'static str],
    },
    /// A value that is no SROS2 enclave.
    #[error("`{key}` is {value:?}; an enclave is \"/\", or like \"/arm/sgc\": letters, digits and `_`")]
    Enclave {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// An enclave without a keystore.
    #[error(
        "DDS Security is asked for without a keystore: set `security_root` in [ros], or ROS_SECURITY_KEYSTORE, to the directory that \
         `ros2 security create_keystore` made"
    )]
    NoKeystore,
    /// A value that is no ROS 2 topic name.
    #[error("`{key}` is {value:?}; {rule}{}", suggest_value(right.as_deref()))]
    TopicName {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The rule that it breaks.
        rule: TopicRule,
        /// The value that was probably meant.
        right: Option<String>,
    },
    /// A value that is no ROS 2 message type.
    #[error(
        "`{key}` is {value:?}; a message type is PACKAGE/msg/NAME: {}",
        right.as_ref().map_or_else(|| "\"std_msgs/msg/String\", for example".to_owned(), |r| format!("{r:?}"))
    )]
    TypeName {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The value that was probably meant.
        right: Option<String>,
    },
    /// A value that is no node name.
    #[error(
        "`{key}` is {value:?}; a node's name is 1 to {max} of a-z, 0-9, '-', '_' and '.', the first a letter or \
         digit: {:?}",
        right.as_deref().unwrap_or("arm-1")
    )]
    NodeName {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The longest name, in bytes.
        max: usize,
        /// The value that was probably meant.
        right: Option<String>,
    },
    /// A value that is no partner name.
    #[error(
        "`{key}` is {value:?}; a partner's name is 1 to {max} of a-z, 0-9, '-', '_' and '.', the first a letter or \
         digit: {:?}",
        right.as_deref().unwrap_or("acme")
    )]
    PartnerName {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The longest name, in bytes.
        max: usize,
        /// The value that was probably meant.
        right: Option<String>,
    },
    /// A recipient that is no node, group, partner or `*`.
    #[error(
        "`{key}` names {value:?}; name nodes (\"desk\"), groups (\"group:operators\"), partners (\"partner:acme\") or \
         \"*\", names of 1 to {max} of a-z, 0-9, '-', '_' and '.'"
    )]
    Recipient {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The longest name, in bytes.
        max: usize,
    },
    /// An operator that is no node or group of this fleet.
    #[error(
        "`{key}` names {value:?}: operators change the fleet itself, so each is a node (\"desk\") or a group \
         (\"group:operators\") of it"
    )]
    Operator {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// An observer of another fleet.
    #[error(
        "`{key}` names {value:?}: observers are nodes (\"desk\"), groups (\"group:observers\") or all nodes (\"*\") of the \
         own fleet"
    )]
    Observer {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A value that is no node id.
    #[error("`{key}` names {value:?}; a node id is 64 hexadecimal digits: `sgc status` there shows it")]
    NodeId {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A value that is no duration, or out of bounds.
    #[error(
        "`{key}` is {value:?}; it takes a number with s, min, h or d, from \"{}\" to \"{}\"",
        duration_text(*min),
        duration_text(*max)
    )]
    Duration {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The shortest.
        min: Duration,
        /// The longest.
        max: Duration,
    },
    /// A value that is no rate, or out of bounds.
    #[error(
        "`{key}` is {value:?}; it takes a number with kbps, Mbps or Gbps (bits a second), from \"{}\" to \"{}\"",
        rate_text(PEER_RATE_MIN),
        rate_text(PEER_RATE_MAX)
    )]
    Rate {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A number out of bounds.
    #[error("`{key}` is {value}; it takes {what} from {min} to {max}")]
    Number {
        /// The key.
        key: &'static str,
        /// The value.
        value: i64,
        /// The counted thing, such as `"a number of bytes"`.
        what: &'static str,
        /// The least.
        min: u64,
        /// The greatest.
        max: u64,
    },
    /// A value that is no token. Its text is not repeated, since it may be secret.
    #[error(
        "`{key}` is no token: {fault}; ask the topic's owner for a new one, or name the file that holds it"
    )]
    Token {
        /// The key.
        key: &'static str,
        /// The fault.
        fault: TokenError,
    },
    /// Networks of rmw_zenoh in a build without them.
    #[error(
        "`{key}` is {value:?}, and this sgc is built without Zenoh: build it with `cargo build --release -p sgc --features \
         zenoh`, or leave it out"
    )]
    ZenohNotBuilt {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A value that is no endpoint of a router of Zenoh.
    #[error(
        "`{key}` is {value:?}; a router of Zenoh is tcp/HOST:PORT, tls/HOST:PORT or unixsock-stream/PATH: \
         \"tcp/localhost:7447\", for example"
    )]
    ZenohRouter {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A session configuration in a format that Zenoh does not read.
    #[error("`{key}` is {value:?}; Zenoh knows the format by the ending: .json5, .json, .yaml or .yml")]
    ZenohConfigEnding {
        /// The key or variable.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A URI that is no path of a file.
    #[error("`{key}` is {value:?}; it takes a path, or file:// and an absolute path")]
    ZenohConfigUri {
        /// The variable.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A malformed setting in a list of them. Values are not repeated, since they may be passwords.
    #[error("`{key}`: setting {number} {fault}")]
    ZenohOverride {
        /// The variable.
        key: &'static str,
        /// The place of the setting in the list, counted from 1.
        number: usize,
        /// The fault.
        fault: ZenohOverrideFault,
    },
    /// A value that is no number of attempts.
    #[error("`{key}` is {value:?}; it takes a number: 0, a positive or a negative one")]
    RouterCheck {
        /// The variable.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A value that is no ROS domain id.
    #[error("`{key}` is {value}; a ROS domain id is a number from 0 to {max}")]
    DomainId {
        /// The key or variable.
        key: &'static str,
        /// The value as written.
        value: String,
        /// The greatest.
        max: u32,
    },
    /// A value that is no static peer.
    #[error("`{key}` names {value:?}; a peer is a host name or an IP address: \"10.0.0.2\", for example")]
    StaticPeer {
        /// The key or variable.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// A value that is no URL of a node.
    #[error("`{key}` is {value:?}; {fault}")]
    Url {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: UrlError,
    },
    /// A value that locates no router.
    #[error("`{key}` is {value:?}; {fault}")]
    Router {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: RouterUrlError,
    },
    /// A value that is no DNS server.
    #[error(
        "`{key}` is {value:?}; it takes the IP address of a DNS server, with its port unless that is 53: \
         \"10.0.0.53\", \"127.0.0.1:5353\" or \"[::1]:5353\""
    )]
    Resolver {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// The listening address of metrics is not an IP address and a port.
    #[error(
        "`{key}` in [metrics] is {value:?}: it takes an IP address and a port, such as \"127.0.0.1:9464\" or \"[::1]:9464\", \
         without http://"
    )]
    MetricsListen {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// The URL of a collector is invalid.
    #[error("`{key}` is {value:?}: {fault}")]
    OtlpUrl {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: OtlpUrlError,
    },
    /// The URL of a collector has a user or a password. They are not repeated, since logs have mistakes.
    #[error(
        "`{key}` has a user or a password before its host, which logs would show: put them into `otlp_headers_file`"
    )]
    OtlpCredentials {
        /// The key.
        key: &'static str,
    },
    /// Pushes of metrics in a build without them.
    #[error(
        "`{key}` is given, and this sgc is built without pushes of metrics: build it with `cargo build --release -p sgc \
         --features otlp`, or leave it out"
    )]
    OtlpNotBuilt {
        /// The key.
        key: &'static str,
    },
    /// A setting of pushes without a collector.
    #[error(
        "`{key}` is for pushes of metrics, and `otlp` does not say where they go: add it, or take `{key}` out"
    )]
    OtlpMissing {
        /// The key.
        key: &'static str,
    },
    /// CAs for a connection without TLS.
    #[error("`{key}` is for https://, and `otlp` begins with http://: correct one of them")]
    OtlpCaUnused {
        /// The key.
        key: &'static str,
    },
    /// The URL of a server of a store is wrong.
    #[error("`{key}`: {fault}")]
    StoreServer {
        /// The key.
        key: &'static str,
        /// The fault.
        fault: StoreServerError,
    },
    /// The prefix of the keys in a store is wrong.
    #[error("`{key}`: {fault}")]
    StorePrefix {
        /// The key.
        key: &'static str,
        /// The fault.
        fault: StorePrefixError,
    },
    /// The name of the store's user is wrong.
    #[error("`{key}`: {fault}")]
    StoreUser {
        /// The key.
        key: &'static str,
        /// The fault.
        fault: StoreUserError,
    },
    /// The mapping `store` without a store.
    #[error(
        "`mapping` is \"store\", and `store` does not say where: add it, such as store = [\"valkey://store.example:6379\"]"
    )]
    StoreMissing,
    /// A setting of a store at a router that uses none.
    #[error("`{key}` is for a store of names: add mapping = \"store\", or take `{key}` out")]
    StoreUnused {
        /// The key.
        key: &'static str,
    },
    /// Servers with and without TLS.
    #[error(
        "`{key}` has servers with TLS (valkeys://) and without (valkey://): the password would go unencrypted"
    )]
    StoreMixed {
        /// The key.
        key: &'static str,
    },
    /// Files for TLS at a store without it.
    #[error("`{key}` is for valkeys://, and `store` begins with valkey://: correct one of them")]
    StoreTlsUnused {
        /// The key.
        key: &'static str,
    },
    /// One of two settings that belong together.
    #[error("`{key}` needs `{missing}` beside it: add that, or take `{key}` out")]
    StoreHalf {
        /// The key.
        key: &'static str,
        /// The other key.
        missing: &'static str,
    },
    /// A file with headers is invalid.
    #[error("`{key}` names {}: {reason}", path.display())]
    OtlpHeaders {
        /// The key.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// The fault, with the line.
        reason: String,
    },
    /// A listen address that is a search for routers.
    #[error(
        "`{key}` is {value:?}, which finds routers: listen at an address (\"quic://0.0.0.0:7447\"), and be found on \
         the local network with `announce`"
    )]
    ListenFinds {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// An announcement by a node that does not listen.
    #[error(
        "`{key}` is on, but {listen} is not given, so nobody could connect: add an address, such as \
         \"quic://0.0.0.0:7447\""
    )]
    AnnouncesNothing {
        /// The key.
        key: &'static str,
        /// The key that enables listening.
        listen: &'static str,
    },
    /// `accept` in a node that does not listen.
    #[error(
        "`{key}` says whose nodes may attach, but {listen} is not given, so nobody can: take it out, or listen"
    )]
    AcceptsNobody {
        /// The key.
        key: &'static str,
        /// The key that enables listening.
        listen: &'static str,
    },
    /// A router at an unspecified address, such as `0.0.0.0`.
    #[error("`{key}` is {value:?}; {host} can be listened at but not dialled: name the router's host")]
    UrlUnspecified {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The address.
        host: String,
    },
    /// A value that is no gateway address.
    #[error("`{key}` is {value:?}; {fault}")]
    GatewayUrl {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: GatewayUrlError,
    },
    /// A gateway in a build without its protocols.
    #[error(
        "`gateway` is given, and this sgc is built without its protocols: build it with `cargo build --release -p sgc \
         --features rosbridge,foxglove,grpc`, or leave it out"
    )]
    GatewayNotBuilt,
    /// An unencrypted gateway that other hosts can reach.
    #[error(
        "`{key}` is {value:?}: other hosts may connect, and nothing is encrypted, so that anybody on the way can read and \
         change everything, tokens too: write \"{}s://{}\", listen at 127.0.0.1, or say `plain = true` if the network is \
         one that you trust",
        url.scheme.as_str(),
        url.address
    )]
    GatewayOpen {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The parsed URL.
        url: GatewayUrl,
    },
    /// A value that is no name of a certificate.
    #[error("`{key}` names {value:?}; {fault}")]
    CertificateName {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: CertificateNameError,
    },
    /// Names for the gateway's own certificate, and another certificate.
    #[error(
        "`{key}` is for the gateway's own certificate, and `certificate` is another one, with names of its own: take one of \
         the two out"
    )]
    NamesUnused {
        /// The key.
        key: &'static str,
    },
    /// A value that is no origin of web pages.
    #[error("`{key}` names {value:?}; {fault}")]
    PageOrigin {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The fault.
        fault: PageOriginError,
    },
    /// A value that is no size, or out of bounds.
    #[error(
        "`{key}` is {value:?}; it takes a number with KiB, MiB or GiB, from \"{}\" to \"{}\"",
        size_text(*min),
        size_text(*max)
    )]
    Size {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The least, bytes.
        min: u64,
        /// The greatest, bytes.
        max: u64,
    },
    /// A malformed right.
    #[error("[[gateway.client]]: {fault}")]
    Scope {
        /// The fault.
        fault: ScopeError,
    },
    /// One of two keys that need each other.
    #[error(
        "`{key}` needs `{other}` beside it: give both, or neither for a certificate that the gateway makes itself"
    )]
    Alone {
        /// The key that is present.
        key: &'static str,
        /// The key that is missing.
        other: &'static str,
    },
    /// A gateway certificate without an encrypted address.
    #[error("`{key}` is for wss:// and grpcs://, and `listen` has neither: take it out, or listen there")]
    CertificateUnused {
        /// The key.
        key: &'static str,
    },
    /// A switch that ROS 2 reads differently than it looks (only `1` is on).
    #[error(
        "`{key}` is {value:?}; ROS 2 reads \"1\" as on and anything else as off: set \"1\" or \"0\", or unset it"
    )]
    Switch {
        /// The variable.
        key: &'static str,
        /// The value.
        value: String,
    },
    /// An argument `--use` without its colon.
    #[error(
        "`--use` is {value:?}; write NODE:/TOPIC: \"arm-1:/camera/image\" or \"arm-1:service:/add_two_ints\", for example"
    )]
    UseArgument {
        /// The value.
        value: String,
    },

    // Combinations of values.
    /// Nobody is allowed to subscribe, so the share has no purpose.
    #[error(
        "`{key}` is empty, so nobody may subscribe: name nodes (\"desk\"), groups (\"group:operators\") or \"*\""
    )]
    NobodyMay {
        /// The key.
        key: &'static str,
    },
    /// `--to` without a `--share` before it.
    #[error("`--to` is given, but no `--share` takes it: add --share /TOPIC")]
    ToWithoutShare,
    /// `*` beside named recipients.
    #[error(
        "`{key}` names \"*\", which is every member of the fleet, and {other:?} beside it: keep one of them"
    )]
    EveryoneAndMore {
        /// The key.
        key: &'static str,
        /// A recipient named beside it.
        other: String,
    },
    /// A share whose only recipient is this node.
    #[error("`{key}` names only {name:?}, which is this node: name those who may subscribe from elsewhere")]
    OnlyItself {
        /// The key.
        key: &'static str,
        /// This node.
        name: String,
    },
    /// A share that others publish on, without a type.
    #[error(
        "`{key}` lets others publish, so the share needs a `type`: no local publisher has to be there to show it; add one, such as type = \"geometry_msgs/msg/Twist\""
    )]
    PublishWithoutType {
        /// The key.
        key: &'static str,
    },
    /// The same topic shared twice.
    #[error("`{key}` is {topic:?}, which {other} shares already: make it one share and join the recipients")]
    SharedTwice {
        /// The key.
        key: &'static str,
        /// The topic.
        topic: String,
        /// The first share.
        other: String,
    },
    /// The same topic used twice from the same node.
    #[error("`{key}` is {topic:?} from {from:?}, which {other} uses already: take one of them out")]
    UsedTwice {
        /// The key.
        key: &'static str,
        /// The topic.
        topic: String,
        /// The owner.
        from: String,
        /// The first use.
        other: String,
    },
    /// A wildcard that is not a whole word.
    #[error(
        "`{key}` is {value:?}; a wildcard is a whole word of a name: '*' for one word, '**' for any number: {right:?}"
    )]
    Wildcard {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The value that was probably meant.
        right: String,
    },
    /// `except` in a rule for a single topic.
    #[error("`{key}` is for a `topic` with wildcards, and {topic:?} has none: take it out")]
    ExceptOfOne {
        /// The key.
        key: &'static str,
        /// The topic.
        topic: String,
    },
    /// An exception that matches nothing of the pattern.
    #[error("`{key}` names {value:?}, which {topic:?} does not cover anyway: take it out, or correct it")]
    ExceptsNothing {
        /// The key.
        key: &'static str,
        /// The exception.
        value: String,
        /// The topic.
        topic: String,
    },
    /// A new name without the wildcard of the topic.
    #[error(
        "`{key}` is {value:?}, but the topic is {topic:?}: {}",
        right.as_ref().map_or_else(
            || "another name needs a topic whose only wildcard is its last word; use `namespace`".to_owned(),
            |right| format!("both end in the same wildcard, or neither has one: {right:?}")
        )
    )]
    AsWildcard {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The topic.
        topic: String,
        /// The value that was probably meant, if any is valid.
        right: Option<String>,
    },
    /// A full name beside a namespace.
    #[error("`{key}` stands beside `as`, which gives the whole name: take one of them out")]
    AsAndNamespace {
        /// The key beside it.
        key: &'static str,
    },
    /// Two shares with the same name for others.
    #[error("`{key}`: for others it would be {topic:?}, as which {other} is shared already: change one name")]
    SharedAsOne {
        /// The key.
        key: &'static str,
        /// The name that both would get.
        topic: String,
        /// The first share.
        other: String,
    },
    /// A pattern that others may publish on. Publishing needs a single topic.
    #[error(
        "`{key}` lets others publish, which needs the name of one topic, not {topic:?}: add a [[share]] for it"
    )]
    PublishOnPattern {
        /// The key.
        key: &'static str,
        /// The topic.
        topic: String,
    },
    /// A value that is no frame prefix.
    #[error(
        "`{key}` is {value:?}; it takes 1 to {max} letters, digits, '_', '-', '.' and '/', and no '/' at the beginning: \"robot1/\""
    )]
    FramePrefix {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// The longest, in bytes.
        max: usize,
    },
    /// QoS policies for a topic that leaves this network.
    #[error("`{key}` is for what comes here: take it out, or `publish`; the owner sets it in its [[share]]")]
    QosElsewhere {
        /// The key.
        key: &'static str,
    },
    /// `keep_last` history without a depth.
    #[error("`{key}` is keep_last, and there is no `depth`: say how many messages, such as depth = 10")]
    HistoryWithoutDepth {
        /// The key.
        key: &'static str,
    },
    /// A dead-man switch of several topics.
    #[error("`{key}` is for one topic, and {topic:?} may match several: name the topic of commands")]
    DeadManOfMany {
        /// The key.
        key: &'static str,
        /// The pattern.
        topic: String,
    },
    /// A dead-man switch of a share on which nobody else publishes.
    #[error(
        "`{key}` is for commands that others publish: add them with `publish = [\"desk\"]`, or take it out"
    )]
    DeadManOfOwn {
        /// The key.
        key: &'static str,
    },
    /// A setting of what comes here, such as a frame prefix, for a topic that leaves this network.
    #[error("`{key}` is for what comes here: take it out, or `publish`")]
    OnlyForWhatComes {
        /// The key.
        key: &'static str,
    },
    /// A topic that would return to its origin in a loop.
    #[error(
        "`{key}` is {topic:?}, which {other} shares: what is used here would be shared again, in a loop; keep one"
    )]
    SharedAndUsed {
        /// The key.
        key: &'static str,
        /// The topic.
        topic: String,
        /// The share.
        other: String,
    },
    /// A use of this node's own topic.
    #[error("`{key}` is {name:?}, which is this node: name the node that shares the topic")]
    UseFromItself {
        /// The key.
        key: &'static str,
        /// This node.
        name: String,
    },
    /// A partner that no table describes.
    #[error(
        "`{key}` names partner {partner:?}, which no [[partner]] describes{}: add [[partner]] with name = {partner:?} \
         and ca = \"FILE\"",
        nearest.as_ref().map(|nearest| format!(" (did you mean {nearest:?}?)")).unwrap_or_default()
    )]
    UnknownPartner {
        /// The key.
        key: &'static str,
        /// The partner.
        partner: String,
        /// The nearest valid word.
        nearest: Option<String>,
    },
    /// The same partner twice.
    #[error(
        "`{key}` is {name:?}, which {other} describes already: make it one [[partner]] and join the nodes"
    )]
    PartnerTwice {
        /// The key.
        key: &'static str,
        /// The partner.
        name: String,
        /// The first.
        other: String,
    },
    /// A token beside a key whose value it determines.
    #[error("`{key}` stands beside `token`, which says it already: take `{key}` out")]
    TokenAndMore {
        /// The key beside it.
        key: &'static str,
    },
    /// Shaping of a token's topic.
    #[error("`{key}` cannot stand beside `token` in this version: ask the owner to set it for the share")]
    TokenUnshaped {
        /// The key beside it.
        key: &'static str,
    },
    /// A priority for a topic that is not published here.
    #[error(
        "`{key}` is for what this node publishes there: what comes here has the priority of the owner's share; set `publish = true`, or take it out"
    )]
    PriorityOfOther {
        /// The key.
        key: &'static str,
    },
    /// Compression of a topic that is received.
    #[error(
        "`{key}` is for what this node publishes there: what comes here is compressed as the owner's share says; set `publish = true`, or take it out"
    )]
    CompressionOfOther {
        /// The key.
        key: &'static str,
    },
    /// A key of publishers for a topic that is received.
    #[error(
        "`{key}` is for what this node publishes there: what comes here is written as the owner's share says, and every node reads both; set `publish = true`, or take it out"
    )]
    EncodingOfOther {
        /// The key.
        key: &'static str,
    },
    /// An invalid shaping setting.
    #[error("`{key}` is {value:?}; it takes {what}")]
    Shaping {
        /// The key.
        key: &'static str,
        /// The value.
        value: String,
        /// A description of valid values.
        what: &'static str,
    },
    /// The same token twice.
    #[error("`{key}` is the one that {other} has already: take one of them out")]
    TokenTwice {
        /// The key.
        key: &'static str,
        /// The first use.
        other: String,
    },
    /// A node that neither dials nor listens.
    #[error(
        "neither {dial} nor {listen} is given, so this node connects to nobody: name a router \
         (\"quic://router.lab.example:7447\") or listen as one (\"quic://0.0.0.0:7447\")"
    )]
    ConnectsToNobody {
        /// The key that names a router.
        dial: &'static str,
        /// The key that enables listening.
        listen: &'static str,
    },
    /// The table `[ros.zenoh]` without a network of rmw_zenoh.
    #[error(
        "[ros.zenoh] is for a network of rmw_zenoh, and the node joins none: set middleware = \"zenoh\" or \"both\" in \
         [ros], or take the table out"
    )]
    ZenohUnused,
    /// A key of DDS without a DDS network.
    #[error(
        "`{key}` is for DDS, and `middleware` is \"zenoh\": take it out; `router` in [ros.zenoh] names the router that \
         the node connects to"
    )]
    DdsKey {
        /// The key.
        key: &'static str,
    },
    /// A key of DDS Security without a DDS network.
    #[error(
        "`{key}` is for DDS Security, and `middleware` is \"zenoh\", so nothing would be protected: take it out; a session \
         configuration, `config` in [ros.zenoh], protects a network of rmw_zenoh"
    )]
    DdsSecurityKey {
        /// The key.
        key: &'static str,
    },
    /// The environment asks for security, and nothing protects the network of rmw_zenoh.
    #[error(
        "ROS_SECURITY_STRATEGY is \"Enforce\", and nothing protects the network of rmw_zenoh: name its session \
         configuration in `config` of [ros.zenoh], or in ZENOH_SESSION_CONFIG_URI, or unset ROS_SECURITY_ENABLE"
    )]
    ZenohUnprotected,
    /// Two settings that exclude each other.
    #[error("`{key}` is {value}, but `{other}` is {other_value}: {right}")]
    Contradiction {
        /// The first key.
        key: &'static str,
        /// Its value.
        value: &'static str,
        /// The second key.
        other: &'static str,
        /// Its value.
        other_value: String,
        /// The fix.
        right: &'static str,
    },

    // Other files.
    /// A file whose content does not fit its key.
    #[error("`{key}` is {}: {reason}; it must be {expected}", path.display())]
    File {
        /// The key that names it.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// The fault.
        reason: String,
        /// The expected content.
        expected: &'static str,
    },
    /// A file of secrets that others than its owner may read.
    #[error("`{key}` is {}: its mode {mode:04o} lets others at {what}; `chmod 600 {}`", path.display(), path.display())]
    FileExposed {
        /// The key that names it.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
        /// The secret in it.
        what: &'static str,
    },

    // The identity.
    /// The identity is missing.
    #[error("{missing} is given: every link is authenticated, so a node needs an identity file")]
    NoIdentity {
        /// The missing keys, as the beginning of a sentence.
        missing: &'static str,
    },
    /// The identity is given at the top and in `[node]`.
    #[error("`identity` is given on line {first} already; keep one")]
    IdentityTwice {
        /// The line of the other.
        first: usize,
    },
    /// The identity file does not exist.
    #[error(
        "`{key}` is {}{}: no such file; `sgc fleet enroll {node} --out {}` makes one",
        path.display(),
        if *implied { " (after the node's name)" } else { "" },
        path.display()
    )]
    IdentityMissing {
        /// The key that names it.
        key: &'static str,
        /// Whether the path follows from the name instead of being written down.
        implied: bool,
        /// The file.
        path: PathBuf,
        /// The node, or `NODE` if the name is unknown.
        node: String,
    },
    /// The identity file cannot be read.
    #[error("`{key}` is {}: {reason}; it must be a file that this user may read", path.display())]
    IdentityUnreadable {
        /// The key that names it.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        reason: String,
    },
    /// Others than the owner may read or write the identity file.
    #[error(
        "`{key}` is {}: its mode {mode:04o} lets others at the private key; `chmod 600 {}` and, if others had access, \
         enrol again",
        path.display(),
        path.display()
    )]
    IdentityExposed {
        /// The key that names it.
        key: &'static str,
        /// The file.
        path: PathBuf,
        /// Its permission bits.
        mode: u32,
    },
}

/// The faults of a setting `KEY=VALUE` for Zenoh.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ZenohOverrideFault {
    /// There is no `=`.
    #[error("is not KEY=VALUE; `;` separates settings: mode=\"client\";scouting/multicast/enabled=false")]
    NoEquals,
    /// The key is empty, or has a space or another character that no key has.
    #[error("has the key {0:?}; a key is like connect/endpoints, without spaces")]
    Key(String),
    /// The key is too long.
    #[error("has a key of {0} bytes; a key has at most {ZENOH_OVERRIDE_KEY_BYTES_MAX}")]
    KeyLength(usize),
    /// There is no value.
    #[error("gives {0} no value; values are JSON5, such as true, or [\"tcp/localhost:7447\"]")]
    NoValue(String),
    /// The value is too long.
    #[error("gives {key} a value of {bytes} bytes; a value has at most {ZENOH_OVERRIDE_VALUE_BYTES_MAX}")]
    ValueLength {
        /// The key.
        key: String,
        /// The length of the value.
        bytes: usize,
    },
    /// A string, an array or an object has no end.
    #[error(
        "gives {0} a value that ends in the middle of a string, an array or an object; each `;` ends a setting, also in quotes"
    )]
    Unclosed(String),
}

/// The rules of a fully qualified ROS 2 topic name (`rmw_validate_full_topic_name`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TopicRule {
    /// The name has at least one token.
    #[error("a topic name has at least one word after a '/'")]
    NotEmpty,
    /// `~` depends on the ROS node.
    #[error("'~' stands for the name of a ROS node, which is not known here: write the name in full")]
    NotPrivate,
    /// The name starts with a slash.
    #[error("a topic name starts with '/'")]
    Absolute,
    /// The name does not end with a slash.
    #[error("a topic name does not end with '/'")]
    NoTrailingSlash,
    /// No empty token.
    #[error("a topic name has no '//'")]
    NoRepeatedSlash,
    /// Letters, digits and underscores.
    #[error("a topic name has letters, digits, '_' and '/', not {0:?}")]
    Characters(char),
    /// No token starts with a digit.
    #[error("no word of a topic name starts with a digit")]
    NoLeadingDigit,
    /// DDS leaves this much room.
    #[error("a topic name has at most {0} bytes")]
    Length(usize),
}

fn suggest_key(nearest: Option<&str>, known: &[&str]) -> String {
    match nearest {
        Some(nearest) => format!("did you mean `{nearest}`?"),
        None => format!("it has `{}`", known.join("`, `")),
    }
}

fn suggest_word(nearest: Option<&str>, known: &[&str]) -> String {
    let known = format!("\"{}\"", known.join("\", \""));
    match nearest {
        Some(nearest) => format!("did you mean {nearest:?}? It takes {known}"),
        None => format!("it takes {known}"),
    }
}

fn suggest_value(right: Option<&str>) -> String {
    right.map(|right| format!(": {right:?}")).unwrap_or_default()
}
