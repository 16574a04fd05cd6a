//! URLs to dial and addresses to listen on: `quic://router.example:7447`, `wss://router.example/sgc`,
//! `quic://[::]:7447`.
//!
//! This module parses and prints. Host names are resolved when a link is dialled.

use std::fmt;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::str::FromStr;

/// Default port, except for WebSocket.
pub const DEFAULT_PORT: u16 = 7447;

/// Default path of WebSocket.
pub const DEFAULT_PATH: &str = "/sgc";

/// The greatest cost that can be set, milliseconds of round trip.
pub const COST_MS_MAX: u32 = 100_000;

const HOST_BYTES_MAX: usize = 253;
const PATH_BYTES_MAX: usize = 200;

/// A transport, by the scheme of its URLs.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Scheme {
    /// QUIC (RFC 9000) over UDP.
    Quic,
    /// QUIC inside of DTLS 1.2 or 1.3 (RFC 6347, RFC 9147) over UDP.
    Dtls,
    /// QUIC over UDP with authenticated packets that everyone can read.
    Udp,
    /// TLS 1.3 (RFC 8446) over TCP.
    Tls,
    /// TCP with authenticated records that everyone can read, after both ends have proven their identity.
    Tcp,
    /// WebSocket (RFC 6455) over TCP, with TLS inside.
    Ws,
    /// WebSocket over TLS, with TLS inside.
    Wss,
}

impl Scheme {
    fn parse(text: &str) -> Result<Self, UrlError> {
        match text {
            "quic" => Ok(Self::Quic),
            "dtls" => Ok(Self::Dtls),
            "udp" => Ok(Self::Udp),
            "tls" => Ok(Self::Tls),
            "tcp" => Ok(Self::Tcp),
            "ws" => Ok(Self::Ws),
            "wss" => Ok(Self::Wss),
            _ => Err(UrlError::SchemeUnknown(text.chars().take(40).collect())),
        }
    }

    /// Returns the default port.
    pub fn default_port(self) -> u16 {
        match self {
            Self::Ws => 80,
            Self::Wss => 443,
            _ => DEFAULT_PORT,
        }
    }

    /// Returns `true` if everyone on the way can read the link's traffic; payloads of topics are sealed all the same.
    pub fn is_readable(self) -> bool {
        matches!(self, Self::Udp | Self::Tcp)
    }

    /// Checks that this build has the transport.
    ///
    /// # Errors
    /// [`UrlError::NotBuilt`].
    pub fn check_built(self) -> Result<(), UrlError> {
        match self {
            Self::Dtls if cfg!(not(feature = "dtls")) => {
                Err(UrlError::NotBuilt { scheme: self, feature: "dtls" })
            }
            _ => Ok(()),
        }
    }

    fn has_path(self) -> bool {
        matches!(self, Self::Ws | Self::Wss)
    }
}

impl fmt::Display for Scheme {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Quic => "quic",
            Self::Dtls => "dtls",
            Self::Udp => "udp",
            Self::Tls => "tls",
            Self::Tcp => "tcp",
            Self::Ws => "ws",
            Self::Wss => "wss",
        })
    }
}

/// The URL of a node to dial.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkUrl {
    /// The transport.
    pub scheme: Scheme,
    /// Host name or IP address, an IPv6 address without brackets.
    pub host: String,
    /// Port.
    pub port: u16,
    /// Path of WebSocket, unless it is [`DEFAULT_PATH`].
    pub path: Option<String>,
    /// Cost of the link in routing, milliseconds of round trip; measured if absent.
    pub cost_ms: Option<u32>,
}

impl FromStr for LinkUrl {
    type Err = UrlError;

    fn from_str(text: &str) -> Result<Self, UrlError> {
        let (text, cost_ms) = match text.split_once("?cost=") {
            Some((text, cost)) => (text, Some(cost_ms(cost)?)),
            None => (text, None),
        };
        let (scheme, host, port, path) = split(text)?;
        if port == 0 {
            return Err(UrlError::Port("0".into()));
        }
        let is_name = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '.' | '_');
        let is_host = host.parse::<IpAddr>().is_ok() || (!host.is_empty() && host.chars().all(is_name));
        if !is_host || host.len() > HOST_BYTES_MAX {
            return Err(UrlError::Host(host.chars().take(80).collect()));
        }
        Ok(Self { scheme, host: host.to_owned(), port, path, cost_ms })
    }
}

impl LinkUrl {
    /// Returns the path that WebSocket requests.
    pub fn path(&self) -> &str {
        self.path.as_deref().unwrap_or(DEFAULT_PATH)
    }

    /// Returns host and port as a URL has them.
    pub(crate) fn authority(&self) -> String {
        if self.host.contains(':') {
            format!("[{}]:{}", self.host, self.port)
        } else {
            format!("{}:{}", self.host, self.port)
        }
    }
}

impl fmt::Display for LinkUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}{}", self.scheme, self.authority(), self.path.as_deref().unwrap_or_default())?;
        self.cost_ms.map_or(Ok(()), |cost| write!(f, "?cost={cost}ms"))
    }
}

/// The address to listen on.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ListenAddr {
    /// The transport.
    pub scheme: Scheme,
    /// The address to bind: `[::]` for every interface, IPv4 and IPv6 alike. Port 0 lets the system choose.
    pub addr: SocketAddr,
    /// Path of WebSocket, unless it is [`DEFAULT_PATH`].
    pub path: Option<String>,
}

impl ListenAddr {
    /// Returns the address for this transport, with defaults for the rest.
    pub fn new(scheme: Scheme, addr: SocketAddr) -> Self {
        Self { scheme, addr, path: None }
    }

    /// Returns the path that WebSocket requests have to name.
    pub fn path(&self) -> &str {
        self.path.as_deref().unwrap_or(DEFAULT_PATH)
    }
}

impl FromStr for ListenAddr {
    type Err = UrlError;

    fn from_str(text: &str) -> Result<Self, UrlError> {
        let (scheme, host, port, path) = split(text)?;
        let ip = match host {
            "*" => IpAddr::V6(Ipv6Addr::UNSPECIFIED),
            host => host.parse().map_err(|_| UrlError::NotAnAddress(host.chars().take(80).collect()))?,
        };
        Ok(Self { scheme, addr: SocketAddr::new(ip, port), path })
    }
}

impl fmt::Display for ListenAddr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}://{}{}", self.scheme, self.addr, self.path.as_deref().unwrap_or_default())
    }
}

/// The reason why a text is no URL of a link.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UrlError {
    /// There is no scheme.
    #[error("{0:?} has no transport in front: write quic://HOST or quic://HOST:PORT")]
    SchemeMissing(String),
    /// No transport of that name is known.
    #[error("{0}:// is not known: quic, dtls, udp, tls, tcp, ws and wss are")]
    SchemeUnknown(String),
    /// This build lacks the transport.
    #[error(
        "this sgc is built without {scheme}://: build it with `cargo build --release -p sgc --features {feature}`, or \
         use another transport"
    )]
    NotBuilt {
        /// The transport.
        scheme: Scheme,
        /// The cargo feature that has it.
        feature: &'static str,
    },
    /// Invalid host.
    #[error("{0:?} is neither a host name nor an IP address (IPv6 is written in brackets)")]
    Host(String),
    /// Only addresses can be listened on.
    #[error("{0:?} is no IP address to listen on: [::] and 0.0.0.0 stand for every interface")]
    NotAnAddress(String),
    /// Invalid port.
    #[error("{0:?} is not a port number")]
    Port(String),
    /// Invalid cost.
    #[error("{0:?} is no cost of a link: write ?cost=20ms, 1 to {COST_MS_MAX} ms")]
    Cost(String),
    /// Invalid path.
    #[error("{0:?} is no path: write wss://HOST/PATH, at most {PATH_BYTES_MAX} letters, digits and /._~-")]
    Path(String),
    /// Text after the end.
    #[error("{0:?} does not belong into the address of a link")]
    Trailing(String),
}

/// Parses milliseconds, as in `20ms`.
fn cost_ms(text: &str) -> Result<u32, UrlError> {
    let number = text.strip_suffix("ms").and_then(|number| number.parse().ok());
    number
        .filter(|cost| (1..=COST_MS_MAX).contains(cost))
        .ok_or_else(|| UrlError::Cost(text.chars().take(80).collect()))
}

fn split(text: &str) -> Result<(Scheme, &str, u16, Option<String>), UrlError> {
    let short = |s: &str| s.chars().take(80).collect::<String>();
    let (scheme, rest) = text.split_once("://").ok_or_else(|| UrlError::SchemeMissing(short(text)))?;
    let scheme = Scheme::parse(scheme)?;
    let (rest, path) = match rest.find('/').filter(|_| scheme.has_path()).map(|at| rest.split_at(at)) {
        Some((authority, path)) => (authority, path_of(path)?),
        None => (rest, None),
    };
    let authority = match rest.split_once(['/', '?', '#', '@']) {
        None => rest,
        Some((authority, "")) if rest.ends_with('/') => authority,
        Some((authority, _)) => return Err(UrlError::Trailing(short(&rest[authority.len()..]))),
    };
    let (host, port) = match authority.strip_prefix('[') {
        Some(bracketed) => {
            let (host, port) = bracketed.split_once(']').ok_or_else(|| UrlError::Host(short(authority)))?;
            if host.parse::<Ipv6Addr>().is_err() {
                return Err(UrlError::Host(short(authority)));
            }
            match port {
                "" => (host, None),
                port => (host, Some(port.strip_prefix(':').ok_or_else(|| UrlError::Trailing(short(port)))?)),
            }
        }
        None => match authority.split_once(':') {
            None => (authority, None),
            Some((_, port)) if port.contains(':') => return Err(UrlError::Host(short(authority))),
            Some((host, port)) => (host, Some(port)),
        },
    };
    let digits = |p: &&str| p.bytes().all(|b| b.is_ascii_digit());
    let port = match port {
        None => scheme.default_port(),
        Some(p) => {
            Some(p).filter(digits).and_then(|p| p.parse().ok()).ok_or_else(|| UrlError::Port(short(p)))?
        }
    };
    Ok((scheme, host, port, path))
}

/// Returns a path unless it is the default.
fn path_of(path: &str) -> Result<Option<String>, UrlError> {
    let is_in_paths = |b: u8| b.is_ascii_alphanumeric() || b"/._~-".contains(&b);
    if path.len() > PATH_BYTES_MAX || !path.bytes().all(is_in_paths) {
        return Err(UrlError::Path(path.chars().take(80).collect()));
    }
    Ok(Some(path).filter(|path| !matches!(*path, "/" | DEFAULT_PATH)).map(str::to_owned))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_round_trip() {
        for (text, shown) in [
            ("quic://router.lab.example:7000", "quic://router.lab.example:7000"),
            ("quic://router", "quic://router:7447"),
            ("quic://10.0.0.1/", "quic://10.0.0.1:7447"),
            ("quic://[fe80::1]:9", "quic://[fe80::1]:9"),
            ("quic://[::1]", "quic://[::1]:7447"),
            ("dtls://router", "dtls://router:7447"),
            ("udp://10.0.0.1:9", "udp://10.0.0.1:9"),
            ("quic://lte.example?cost=120ms", "quic://lte.example:7447?cost=120ms"),
            ("tls://router", "tls://router:7447"),
            ("tcp://router:1", "tcp://router:1"),
            ("ws://router", "ws://router:80"),
            ("wss://router/", "wss://router:443"),
            ("wss://router/sgc?cost=5ms", "wss://router:443?cost=5ms"),
            ("wss://[::1]/robots/a-1?cost=5ms", "wss://[::1]:443/robots/a-1?cost=5ms"),
        ] {
            let url: LinkUrl = text.parse().unwrap();
            assert_eq!(url.to_string(), shown);
            assert_eq!(shown.parse(), Ok(url));
        }
        for (text, shown) in [
            ("quic://[::]:0", "quic://[::]:0"),
            ("quic://0.0.0.0", "quic://0.0.0.0:7447"),
            ("quic://*", "quic://[::]:7447"),
            ("wss://*/x", "wss://[::]:443/x"),
            ("ws://[::]:8080/sgc", "ws://[::]:8080"),
        ] {
            assert_eq!(text.parse::<ListenAddr>().unwrap().to_string(), shown);
        }
    }

    #[test]
    fn mistakes_are_named() {
        let refused = |text: &str| text.parse::<LinkUrl>().unwrap_err();
        assert!(matches!(refused("router:7447"), UrlError::SchemeMissing(_)));
        assert!(matches!(refused("http://router"), UrlError::SchemeUnknown(_)));
        for cost in ["", "20", "0ms", "100001ms", "-1ms", "1sms"] {
            assert_eq!(refused(&format!("quic://router?cost={cost}")), UrlError::Cost(cost.into()));
        }
        for text in
            ["quic://", "quic://a b", "quic://fe80::1", "quic://[fe80::1", "quic://[router]", "quic://:1"]
        {
            assert!(matches!(refused(text), UrlError::Host(_)), "{text}: {:?}", refused(text));
        }
        for text in ["quic://a:", "quic://a:0", "quic://a:65536", "quic://a:x", "quic://a:+1"] {
            assert!(matches!(refused(text), UrlError::Port(_)), "{text}");
        }
        for text in [
            "ws://a/b c",
            "ws://a/b\r\nHost:",
            "wss://a/%20",
            "wss://a/b?c",
            &format!("ws://a/{}", "x".repeat(200)),
        ] {
            assert!(matches!(refused(text), UrlError::Path(_)), "{text}");
        }
        for text in ["quic://a/path", "tls://a/path", "quic://user@a", "ws://user@a/b", "quic://[::1]x"] {
            assert!(matches!(refused(text), UrlError::Trailing(_)), "{text}");
        }
        assert!(matches!("quic://router".parse::<ListenAddr>(), Err(UrlError::NotAnAddress(_))));
    }
}
