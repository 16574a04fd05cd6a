//! The `[gateway]` table: listen addresses, access of programs without ROS, and bounds.
//!
//! This module validates values. `sgc-gateway` authenticates and authorises connections.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use sgc_gateway::{Anonymous, PageOrigin, Protocol, ProtocolNotBuilt, Scope};
use sgc_trust::CertificateName;

use crate::recipient::Recipient;

/// Most origins of web pages that one gateway admits.
pub const ORIGINS_MAX: usize = 64;
/// Most names of the gateway's own certificate that one configuration lists.
pub const GATEWAY_NAMES_MAX: usize = 32;
/// Most `[[gateway.client]]` tables.
pub const GATEWAY_CLIENTS_MAX: usize = 256;

const WEBSOCKET_PORT: u16 = 9090;
const FOXGLOVE_PORT: u16 = 8765;
const GRPC_PORT: u16 = 50051;
const MIB: u64 = 1 << 20;

/// A gateway for programs without ROS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayConfig {
    /// Listen addresses; not empty, without duplicates.
    pub listen: Vec<GatewayUrl>,
    /// Certificate and key for TLS; `None` uses one that the gateway makes itself.
    pub tls: Option<GatewayTls>,
    /// Names in the certificate that the gateway makes itself, besides those that it knows by itself. Empty with `tls`.
    pub names: Vec<CertificateName>,
    /// Rights of clients without a token or a certificate.
    pub anonymous: Anonymous,
    /// Origins whose pages may connect without a token, besides those of this host.
    pub origins: Vec<PageOrigin>,
    /// Whether other hosts may connect unencrypted.
    pub plain: bool,
    /// Most clients at once; 1 to [`GatewayConfig::CLIENTS_MAX_MAX`].
    pub clients_max: usize,
    /// Most bytes that wait for one client; [`GatewayConfig::CLIENT_BYTES_MIN`] to [`GatewayConfig::CLIENT_BYTES_MAX`].
    pub client_bytes_max: u64,
    /// Rights of clients with a certificate.
    pub clients: Vec<GatewayClientConfig>,
}

/// Certificate and private key, PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayTls {
    /// The certificates, leaf first.
    pub certificate: PathBuf,
    /// Private key of the leaf.
    pub key: PathBuf,
}

/// Rights of nodes that authenticate by certificate.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayClientConfig {
    /// The nodes; not empty.
    pub who: Vec<Recipient>,
    /// Their rights; not empty, within bounds.
    pub scope: Scope,
}

impl GatewayConfig {
    /// Bound of `clients_max`, since each client has a socket.
    pub const CLIENTS_MAX_MAX: u64 = 65_536;
    /// Lower bound of `client_bytes_max`, so that a small message fits.
    pub const CLIENT_BYTES_MIN: u64 = 64 << 10;
    /// Upper bound of `client_bytes_max`: more than memory has.
    pub const CLIENT_BYTES_MAX: u64 = 16 << 30;

    /// Returns the default listen addresses: this host only, at the ports that clients try first. The list is empty in
    /// a build without protocols.
    pub fn default_listen() -> Vec<GatewayUrl> {
        let here = |scheme, port| GatewayUrl { scheme, address: (Ipv4Addr::LOCALHOST, port).into() };
        let usual = [
            here(GatewayScheme::Ws, WEBSOCKET_PORT),
            here(GatewayScheme::Ws, FOXGLOVE_PORT),
            here(GatewayScheme::Grpc, GRPC_PORT),
        ];
        usual.into_iter().filter(|url| url.scheme.protocol().check_built().is_ok()).collect()
    }

    /// Returns warnings for the operator, one sentence each.
    pub fn warnings(&self) -> Vec<String> {
        let others = self.listen.iter().find(|url| !url.address.ip().is_loopback());
        let mut warnings = Vec::new();
        if self.anonymous == Anonymous::All {
            let whoever = match others {
                Some(url) => format!("whoever reaches {url}"),
                None => "whoever reaches it, through whatever forwards to this host,".to_owned(),
            };
            warnings.push(format!(
                "gateway: anonymous = \"all\": {whoever} may receive, publish, call and serve everything, without a token or \
                 a certificate"
            ));
        }
        if let Some(url) = self.listen.iter().find(|url| url.is_open()) {
            warnings.push(format!(
                "gateway: plain = true: {url} is not encrypted, so others on the network can read everything, tokens too, and \
                 use those"
            ));
        }
        warnings
    }
}

impl Default for GatewayConfig {
    fn default() -> Self {
        Self {
            listen: Self::default_listen(),
            tls: None,
            names: Vec::new(),
            anonymous: Anonymous::default(),
            origins: Vec::new(),
            plain: false,
            clients_max: 512,
            client_bytes_max: 64 * MIB,
            clients: Vec::new(),
        }
    }
}

/// A listen address of a gateway with its protocol.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct GatewayUrl {
    /// The protocol.
    pub scheme: GatewayScheme,
    /// The address; port 0 lets the system choose.
    pub address: SocketAddr,
}

impl GatewayUrl {
    /// Returns `true` if other hosts may connect and nothing is encrypted.
    pub fn is_open(&self) -> bool {
        !self.scheme.is_encrypted() && !self.address.ip().to_canonical().is_loopback()
    }
}

/// Protocol of a gateway address.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum GatewayScheme {
    /// gRPC over HTTP/2.
    Grpc,
    /// gRPC over HTTP/2 over TLS.
    Grpcs,
    /// rosbridge or Foxglove over WebSocket. The client's WebSocket subprotocol selects one.
    Ws,
    /// rosbridge or Foxglove over WebSocket over TLS.
    Wss,
}

impl GatewayScheme {
    /// Returns the scheme of URLs.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Grpcs => "grpcs",
            Self::Ws => "ws",
            Self::Wss => "wss",
        }
    }

    /// Returns `true` for protocols over TLS.
    pub fn is_encrypted(self) -> bool {
        matches!(self, Self::Grpcs | Self::Wss)
    }

    /// Returns the protocol as `sgc-gateway` names it.
    pub fn protocol(self) -> Protocol {
        match self {
            Self::Ws | Self::Wss => Protocol::WebSocket,
            Self::Grpc | Self::Grpcs => Protocol::Grpc,
        }
    }

    fn port(self) -> u16 {
        match self {
            Self::Grpc | Self::Grpcs => GRPC_PORT,
            Self::Ws | Self::Wss => WEBSOCKET_PORT,
        }
    }
}

/// Reasons why a text is no listen address of a gateway.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GatewayUrlError {
    /// The scheme is missing or unknown.
    #[error("it takes ws://, wss://, grpc:// and grpcs://, such as \"ws://127.0.0.1:9090\"")]
    Scheme,
    /// The host is a name, not an IP address.
    #[error("it listens at an IP address, not at a name: \"{0}\"")]
    Name(String),
    /// The text is no IP address with a port.
    #[error(
        "behind the scheme comes an IP address with a port: \"{0}://127.0.0.1:{1}\" or \"{0}://[::1]:{1}\""
    )]
    Address(&'static str, u16),
    /// This build lacks the protocol.
    #[error(transparent)]
    NotBuilt(#[from] ProtocolNotBuilt),
    /// The URL has a path.
    #[error("there is no path behind the port: clients may ask for any")]
    Path,
}

impl FromStr for GatewayUrl {
    type Err = GatewayUrlError;

    fn from_str(text: &str) -> Result<Self, GatewayUrlError> {
        let schemes = [GatewayScheme::Grpc, GatewayScheme::Grpcs, GatewayScheme::Ws, GatewayScheme::Wss];
        let (written, rest) = text.split_once("://").ok_or(GatewayUrlError::Scheme)?;
        let scheme = schemes.into_iter().find(|s| s.as_str() == written).ok_or(GatewayUrlError::Scheme)?;
        let rest = rest.strip_suffix('/').unwrap_or(rest);
        if rest.contains('/') {
            return Err(GatewayUrlError::Path);
        }
        let bare = rest.strip_prefix('[').and_then(|r| r.strip_suffix(']')).unwrap_or(rest);
        let alone = bare.parse().ok().filter(|ip: &IpAddr| ip.is_ipv4() || bare.len() < rest.len());
        let address = rest.parse().ok().or(alone.map(|ip| SocketAddr::new(ip, scheme.port())));
        address.map(|address| Self { scheme, address }).ok_or_else(|| {
            let (host, port) = rest.split_once(':').unwrap_or((rest, ""));
            let is_name = host.starts_with(|c: char| c.is_ascii_alphabetic());
            let port = port.parse().unwrap_or(scheme.port());
            match is_name {
                true => {
                    let address = if host == "localhost" { "127.0.0.1" } else { "0.0.0.0" };
                    GatewayUrlError::Name(format!("{written}://{address}:{port}"))
                }
                false => GatewayUrlError::Address(scheme.as_str(), scheme.port()),
            }
        })
    }
}

impl fmt::Display for GatewayUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}", self.scheme.as_str(), self.address)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_round_trip_and_ports_may_be_left_out() {
        for (text, shown) in [
            ("ws://127.0.0.1", "ws://127.0.0.1:9090"),
            ("wss://0.0.0.0:443/", "wss://0.0.0.0:443"),
            ("grpc://[::1]", "grpc://[::1]:50051"),
            ("grpcs://[::]:1", "grpcs://[::]:1"),
            ("ws://127.0.0.1:0", "ws://127.0.0.1:0"),
        ] {
            assert_eq!(text.parse::<GatewayUrl>().unwrap().to_string(), shown);
        }
        let refused = |text: &str| text.parse::<GatewayUrl>().unwrap_err();
        for text in ["", "127.0.0.1:9090", "http://127.0.0.1", "quic://127.0.0.1", "WS://127.0.0.1"] {
            assert_eq!(refused(text), GatewayUrlError::Scheme, "{text}");
        }
        assert_eq!(refused("ws://localhost:1"), GatewayUrlError::Name("ws://127.0.0.1:1".into()));
        assert_eq!(refused("grpc://robot.local"), GatewayUrlError::Name("grpc://0.0.0.0:50051".into()));
        for text in
            ["ws://", "ws://127.0.0.1:x", "ws://::1", "ws://127.0.0.1:70000", "ws://1.2.3", "ws://[::1"]
        {
            assert_eq!(refused(text), GatewayUrlError::Address("ws", 9090), "{text}");
        }
        assert_eq!(refused("ws://127.0.0.1:9090/ros"), GatewayUrlError::Path);
    }
}
