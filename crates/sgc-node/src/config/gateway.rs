//! `[gateway]`: where programs without ROS connect, who they may be, and what waits for them at most.
//!
//! It says what is valid. Who a connection is from and what it may do is judged in `sgc-gateway`.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::PathBuf;
use std::str::FromStr;

use sgc_gateway::{Anonymous, PageOrigin, PageOriginError, Scope};

use super::Recipient;
use super::error::Mistake;

/// Origins of pages that one gateway admits.
pub const ORIGINS_MAX: usize = 64;
/// Directories with message packages that one gateway reads.
pub const MSG_DIRS_MAX: usize = 64;
/// `[[gateway.client]]` tables.
pub const GATEWAY_CLIENTS_MAX: usize = 256;

const WEBSOCKET_PORT: u16 = 9090;
const FOXGLOVE_PORT: u16 = 8765;
const GRPC_PORT: u16 = 50051;
const MIB: u64 = 1 << 20;
const SIZE_UNITS: [(u64, &str); 3] = [(1 << 30, "GiB"), (MIB, "MiB"), (1 << 10, "KiB")];

/// A gateway for programs without ROS.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayConfig {
    /// Where it listens; not empty, none twice.
    pub listen: Vec<GatewayUrl>,
    /// What it shows to those who connect over TLS; the node's own certificate if there is nothing.
    pub tls: Option<GatewayTls>,
    /// Who is admitted without a token or a certificate.
    pub anonymous: Anonymous,
    /// Whose pages may connect without a token, besides those of this host.
    pub origins: Vec<PageOrigin>,
    /// Whether it may be used unencrypted from other hosts.
    pub plain: bool,
    /// Directories with message packages.
    pub msg_dirs: Vec<PathBuf>,
    /// Clients that are connected at once; 1 to [`GatewayConfig::CLIENTS_MAX_MAX`].
    pub clients_max: usize,
    /// Bytes that wait for one client; [`GatewayConfig::CLIENT_BYTES_MIN`] to [`GatewayConfig::CLIENT_BYTES_MAX`].
    pub client_bytes_max: u64,
    /// What certificates permit.
    pub clients: Vec<GatewayClientConfig>,
}

/// Certificate and private key, PEM.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayTls {
    /// The certificates, leaf first.
    pub certificate: PathBuf,
    /// The key of the first.
    pub key: PathBuf,
}

/// What nodes may do whose certificates prove who they are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatewayClientConfig {
    /// Who; never empty.
    pub who: Vec<Recipient>,
    /// What; never empty, within its bounds.
    pub scope: Scope,
}

impl GatewayConfig {
    /// Each client has a socket.
    pub const CLIENTS_MAX_MAX: u64 = 65_536;
    /// One small message has to fit.
    pub const CLIENT_BYTES_MIN: u64 = 64 << 10;
    /// More than memory has.
    pub const CLIENT_BYTES_MAX: u64 = 16 << 30;

    /// Where a gateway listens that is not told: this host alone, where clients of each kind look first.
    pub fn default_listen() -> Vec<GatewayUrl> {
        let here = |scheme, port| GatewayUrl { scheme, address: (Ipv4Addr::LOCALHOST, port).into() };
        vec![
            here(GatewayScheme::Ws, WEBSOCKET_PORT),
            here(GatewayScheme::Ws, FOXGLOVE_PORT),
            here(GatewayScheme::Grpc, GRPC_PORT),
        ]
    }

    /// What an operator should know that is no mistake, one sentence each.
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
            anonymous: Anonymous::default(),
            origins: Vec::new(),
            plain: false,
            msg_dirs: Vec::new(),
            clients_max: 512,
            client_bytes_max: 64 * MIB,
            clients: Vec::new(),
        }
    }
}

/// Where a gateway listens, and what is spoken there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct GatewayUrl {
    /// What is spoken.
    pub scheme: GatewayScheme,
    /// Where; port 0 lets the system choose.
    pub address: SocketAddr,
}

impl GatewayUrl {
    /// True if others than this host may connect and nothing is encrypted.
    pub fn is_open(&self) -> bool {
        !self.scheme.is_encrypted() && !self.address.ip().to_canonical().is_loopback()
    }
}

/// What is spoken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum GatewayScheme {
    /// gRPC over HTTP/2.
    Grpc,
    /// The same over TLS.
    Grpcs,
    /// The rosbridge protocol and Foxglove's over WebSocket; which of them, a client's WebSocket subprotocol tells.
    Ws,
    /// The same over TLS.
    Wss,
}

impl GatewayScheme {
    /// What URLs begin with.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Grpc => "grpc",
            Self::Grpcs => "grpcs",
            Self::Ws => "ws",
            Self::Wss => "wss",
        }
    }

    /// Whether it is over TLS.
    pub fn is_encrypted(self) -> bool {
        matches!(self, Self::Grpcs | Self::Wss)
    }

    fn port(self) -> u16 {
        match self {
            Self::Grpc | Self::Grpcs => GRPC_PORT,
            Self::Ws | Self::Wss => WEBSOCKET_PORT,
        }
    }
}

/// Why a gateway cannot listen at a text.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GatewayUrlError {
    /// No scheme, or another.
    #[error("it takes ws://, wss://, grpc:// and grpcs://, such as \"ws://127.0.0.1:9090\"")]
    Scheme,
    /// A name where an address belongs.
    #[error("it listens at an IP address, not at a name: \"{0}\"")]
    Name(String),
    /// Neither.
    #[error(
        "behind the scheme comes an IP address with a port: \"{0}://127.0.0.1:{1}\" or \"{0}://[::1]:{1}\""
    )]
    Address(&'static str, u16),
    /// A path.
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

/// Checks where to listen.
pub(super) fn listen(key: &'static str, value: &str) -> Result<GatewayUrl, Mistake> {
    value.parse().map_err(|fault| Mistake::GatewayUrl { key, value: value.to_owned(), fault })
}

/// Checks whose pages may connect.
pub(super) fn origin(key: &'static str, value: &str) -> Result<PageOrigin, Mistake> {
    value.parse().map_err(|fault: PageOriginError| Mistake::PageOrigin {
        key,
        value: value.to_owned(),
        fault,
    })
}

/// Checks a number of bytes, `64MiB`.
pub(super) fn size(key: &'static str, value: &str, (min, max): (u64, u64)) -> Result<u64, Mistake> {
    let bytes = parse_size(value).filter(|bytes| (min..=max).contains(bytes));
    bytes.ok_or_else(|| Mistake::Size { key, value: value.to_owned(), min, max })
}

/// A number of bytes as the configuration has it: `512KiB`, `64MiB`, `1GiB`.
fn parse_size(text: &str) -> Option<u64> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = SIZE_UNITS.into_iter().find(|(_, name)| *name == unit.trim_start())?.0;
    number.parse::<u64>().ok()?.checked_mul(unit)
}

/// A number of bytes in the largest unit that divides it.
pub(super) fn size_text(bytes: u64) -> String {
    let unit = SIZE_UNITS.into_iter().find(|(unit, _)| bytes.is_multiple_of(*unit) && bytes > 0);
    unit.map_or_else(|| format!("{bytes} bytes"), |(unit, name)| format!("{}{name}", bytes / unit))
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

    #[test]
    fn sizes_have_a_unit() {
        for (text, bytes) in [("64MiB", 64 << 20), ("1 GiB", 1 << 30), ("512KiB", 512 << 10)] {
            assert_eq!(parse_size(text), Some(bytes), "{text}");
        }
        for text in ["", "64", "64MB", "-1MiB", "MiB", "99999999999GiB", "1.5MiB"] {
            assert_eq!(parse_size(text), None, "{text}");
        }
        assert_eq!((size_text(64 << 20), size_text(1000)), ("64MiB".to_owned(), "1000 bytes".to_owned()));
    }
}
