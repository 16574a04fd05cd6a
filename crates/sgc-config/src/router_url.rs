//! [`RouterUrl`]: an entry of `routers`, such as `quic://HOST:PORT`, `srv://DOMAIN` or `mdns://`.
//!
//! This module parses and prints. `crate::discovery` resolves and dials.

use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;

use sgc_transport::{LinkUrl, UrlError};
use sgc_trust::NodeName;

/// Most URLs of one router: one for each transport.
pub const WAYS_MAX: usize = 7;
/// The longest name in DNS, in text.
const NAME_BYTES_MAX: usize = 253;
/// Service and protocol of routers in SRV records (RFC 2782).
pub const SRV_SERVICE: &str = "_sgc._udp";

/// A way to find a router.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RouterUrl {
    /// `quic://HOST:PORT`: the router's address.
    At(LinkUrl),
    /// `quic://HOST:PORT,tls://HOST:PORT`: URLs of one router, the best first; 2 to [`WAYS_MAX`], without duplicates.
    Ways(Vec<LinkUrl>),
    /// `srv://DOMAIN`: one of the routers that DNS names for the domain.
    Srv(SrvDomain),
    /// `mdns://`: any trusted router on the local network; `mdns://NODE`: the one with that name.
    Mdns(Option<NodeName>),
}

impl RouterUrl {
    /// Returns the entry of a router with these URLs, at least one.
    pub fn by(urls: &[LinkUrl]) -> Self {
        match urls {
            [only] => Self::At(only.clone()),
            urls => Self::Ways(urls.to_vec()),
        }
    }

    /// Returns the router's URLs; empty if they have to be found.
    pub fn urls(&self) -> &[LinkUrl] {
        match self {
            Self::At(url) => std::slice::from_ref(url),
            Self::Ways(urls) => urls,
            Self::Srv(_) | Self::Mdns(_) => &[],
        }
    }
}

/// A domain whose SRV records name routers. Lower case, without its final dot.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct SrvDomain(Box<str>);

impl SrvDomain {
    /// Returns the name of the SRV query: `_sgc._udp.DOMAIN.`. It is absolute, so that no search list applies.
    pub fn query(&self) -> String {
        format!("{SRV_SERVICE}.{}.", self.0)
    }
}

impl fmt::Display for SrvDomain {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Reasons why a text is no entry of `routers`.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RouterUrlError {
    /// It is no URL of a link.
    #[error(transparent)]
    Link(#[from] UrlError),
    /// The scheme is unknown.
    #[error("{0}:// is not known: it takes quic://HOST:PORT, srv://DOMAIN and mdns://")]
    Scheme(String),
    /// There are too many URLs of one router.
    #[error("{0} ways to one router; it takes at most {WAYS_MAX}")]
    Ways(usize),
    /// A URL occurs twice.
    #[error("{0} stands there twice")]
    WayTwice(String),
    /// A search stands among the URLs of one router.
    #[error(
        "{0} finds a router by itself: only addresses, such as \"quic://HOST:PORT,tls://HOST:443\", can stand together"
    )]
    WayFinds(String),
    /// It is no domain.
    #[error("after srv:// comes the domain whose {SRV_SERVICE} records name routers: \"srv://lab.example\"")]
    Domain,
    /// It is an address, which has no SRV records.
    #[error("{0} is an address, which DNS has no SRV records of: write \"quic://{0}\"")]
    DomainIsAddress(IpAddr),
    /// It already has the labels of the query.
    #[error("{SRV_SERVICE} is put in front by itself: write \"srv://{0}\"")]
    DomainIsQuery(String),
    /// It has a port, which the SRV record defines.
    #[error("the SRV records say the port: write \"srv://{0}\"")]
    DomainPort(String),
    /// It is no node name.
    #[error(
        "after mdns:// comes nothing, for any router that this node trusts, or a router's name: \"mdns://cloud\""
    )]
    Node,
}

impl FromStr for RouterUrl {
    type Err = RouterUrlError;

    fn from_str(text: &str) -> Result<Self, RouterUrlError> {
        if text.contains(',') {
            return urls(text).map(Self::Ways);
        }
        match text.split_once("://") {
            Some(("srv", rest)) => domain(rest.strip_suffix('/').unwrap_or(rest)).map(Self::Srv),
            Some(("mdns", rest)) => match rest.strip_suffix('/').unwrap_or(rest) {
                "" => Ok(Self::Mdns(None)),
                name => name.parse().map(|name| Self::Mdns(Some(name))).map_err(|_| RouterUrlError::Node),
            },
            _ => match text.parse() {
                Ok(url) => Ok(Self::At(url)),
                Err(UrlError::SchemeUnknown(scheme)) => Err(RouterUrlError::Scheme(scheme)),
                Err(fault) => Err(fault.into()),
            },
        }
    }
}

fn urls(text: &str) -> Result<Vec<LinkUrl>, RouterUrlError> {
    let count = text.split(',').count();
    if count > WAYS_MAX {
        return Err(RouterUrlError::Ways(count));
    }
    let mut urls = Vec::with_capacity(count);
    for one in text.split(',') {
        match one.trim().parse()? {
            RouterUrl::At(url) if urls.contains(&url) => {
                return Err(RouterUrlError::WayTwice(url.to_string()));
            }
            RouterUrl::At(url) => urls.push(url),
            other => return Err(RouterUrlError::WayFinds(other.to_string())),
        }
    }
    Ok(urls)
}

fn domain(text: &str) -> Result<SrvDomain, RouterUrlError> {
    let bare = text.strip_prefix('[').and_then(|t| t.strip_suffix(']')).unwrap_or(text);
    if let Ok(address) = bare.parse() {
        return Err(RouterUrlError::DomainIsAddress(address));
    }
    let text = text.strip_suffix('.').unwrap_or(text).to_ascii_lowercase();
    if let Some((host, port)) = text.rsplit_once(':')
        && is_domain(host)
        && port.bytes().all(|b| b.is_ascii_digit())
    {
        return Err(RouterUrlError::DomainPort(host.to_owned()));
    }
    if let Some(rest) = text.strip_prefix(SRV_SERVICE).and_then(|rest| rest.strip_prefix('.'))
        && is_domain(rest)
    {
        return Err(RouterUrlError::DomainIsQuery(rest.to_owned()));
    }
    // The length includes the labels of the query.
    let fits = text.len() + SRV_SERVICE.len() < NAME_BYTES_MAX;
    if fits && is_domain(&text) { Ok(SrvDomain(text.into())) } else { Err(RouterUrlError::Domain) }
}

fn is_domain(text: &str) -> bool {
    text.split('.').all(|label| {
        (1..=63).contains(&label.len())
            && label.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'-' | b'_'))
            && !label.starts_with('-')
            && !label.ends_with('-')
    })
}

impl From<LinkUrl> for RouterUrl {
    fn from(url: LinkUrl) -> Self {
        Self::At(url)
    }
}

impl fmt::Display for RouterUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::At(url) => write!(f, "{url}"),
            Self::Ways(urls) => {
                for (index, way) in urls.iter().enumerate() {
                    write!(f, "{}{way}", if index > 0 { "," } else { "" })?;
                }
                Ok(())
            }
            Self::Srv(domain) => write!(f, "srv://{domain}"),
            Self::Mdns(None) => f.write_str("mdns://"),
            Self::Mdns(Some(node)) => write!(f, "mdns://{node}"),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn each_way_round_trips() {
        for (text, shown) in [
            ("quic://router", "quic://router:7447"),
            ("srv://lab.example", "srv://lab.example"),
            ("srv://Lab.Example./", "srv://lab.example"),
            ("mdns://", "mdns://"),
            ("mdns:///", "mdns://"),
            ("mdns://cloud", "mdns://cloud"),
            ("quic://a, quic://b:443", "quic://a:7447,quic://b:443"),
        ] {
            let url: RouterUrl = text.parse().unwrap();
            assert_eq!(url.to_string(), shown);
            assert_eq!(shown.parse(), Ok(url));
        }
        let RouterUrl::Srv(domain) = "srv://lab.example".parse().unwrap() else { panic!() };
        assert_eq!(domain.query(), "_sgc._udp.lab.example.");
    }

    #[test]
    fn mistakes_are_named() {
        let refused = |text: &str| text.parse::<RouterUrl>().unwrap_err();
        assert!(matches!(refused("router:7447"), RouterUrlError::Link(UrlError::SchemeMissing(_))));
        assert_eq!(refused("http://router"), RouterUrlError::Scheme("http".into()));
        for text in ["srv://", "srv://a..b", "srv://-a", "srv://a b", "srv://a/b", "srv://.", "srv://a:b"] {
            assert_eq!(refused(text), RouterUrlError::Domain, "{text}");
        }
        assert_eq!(refused(&format!("srv://{}a", "abcdefg.".repeat(31))), RouterUrlError::Domain);
        for text in ["srv://10.0.0.1", "srv://[::1]", "srv://::1"] {
            assert!(matches!(refused(text), RouterUrlError::DomainIsAddress(_)), "{text}");
        }
        assert_eq!(refused("srv://lab.example:53"), RouterUrlError::DomainPort("lab.example".into()));
        assert_eq!(refused("srv://_sgc._udp.lab"), RouterUrlError::DomainIsQuery("lab".into()));
        assert_eq!(refused(&["quic://a"; 8].join(",")), RouterUrlError::Ways(8));
        assert_eq!(refused("quic://a,quic://a:7447"), RouterUrlError::WayTwice("quic://a:7447".into()));
        assert_eq!(refused("quic://a,srv://b"), RouterUrlError::WayFinds("srv://b".into()));
        assert!(matches!(refused("quic://a,"), RouterUrlError::Link(UrlError::SchemeMissing(_))));
        for text in ["mdns://A", "mdns://a:1", "mdns://a b"] {
            assert_eq!(refused(text), RouterUrlError::Node, "{text}");
        }
    }
}
