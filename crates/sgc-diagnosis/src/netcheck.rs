//! The network of a node as its routers see it: whether UDP passes, whether a NAT stands in between and how it maps
//! ports (RFC 4787), whether the gateway maps a port for the node, and IPv6.
//!
//! A router tells each node that dials it from which address the node comes. All QUIC links of a node leave from one
//! socket for each address family, so two routers that see different ports reveal how the NAT maps. How it filters is
//! not known, because no packet comes from an address that the node has not sent to.

use std::net::{IpAddr, SocketAddr};

use serde::Serialize;
use sgc_process::output;
use sgc_process::style::{self, Line, Tone, Toned};

use crate::status::{Link, PortMapping, Router, Status};

/// Schemes of the transports over UDP.
const UDP_SCHEMES: [&str; 3] = ["quic", "dtls", "udp"];

/// The network of a node.
#[derive(Debug, PartialEq, Eq, Serialize)]
pub struct Netcheck {
    node: String,
    /// Ways to routers that are up, the nearest first.
    links: Vec<RouterView>,
    /// Routers without a link.
    not_linked: Vec<NotLinked>,
    udp: Udp,
    nat: Nat,
    mapping: Mapping,
    port_mapping: PortMapping,
    ipv6: Ipv6,
}

/// A way to a router that this node dialled, with the address that the router sees.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
struct RouterView {
    url: String,
    remote: Option<SocketAddr>,
    silent: bool,
    round_trip_us: u64,
    /// Address of the host from which packets to the router leave.
    local: Option<IpAddr>,
    /// Address from which they come.
    observed: Option<SocketAddr>,
}

/// A router that is not linked.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct NotLinked {
    router: String,
    state: String,
    last_failure: Option<String>,
}

/// Whether UDP passes.
#[derive(Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Udp {
    /// A link over UDP is up.
    Passes,
    /// Only links over TCP are up, although routers have ways over UDP.
    SeemsBlocked,
    /// No link is up that would tell.
    Unknown,
}

/// Whether a NAT stands between the node and its routers.
#[derive(Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Nat {
    /// Routers see the host's own address.
    None,
    /// A router sees another address.
    Present,
    /// No router has said what it sees.
    Unknown,
}

/// How a NAT maps addresses and ports of this host (RFC 4787, 4.1).
#[derive(Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
enum Mapping {
    /// There is no NAT.
    None,
    /// All destinations see the same port.
    EndpointIndependent,
    /// Destinations see different ports: address-dependent, or address- and port-dependent.
    EndpointDependent,
    /// Too few routers see this node over UDP.
    Unknown,
}

/// The use of IPv6, and the host's route to it.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Ipv6 {
    /// Whether a link uses it.
    linked: bool,
    /// Address of the host from which packets to the IPv6 internet leave.
    address: Option<IpAddr>,
}

impl Netcheck {
    /// Returns what the status of a node reveals of its network.
    pub fn of(status: &Status) -> Self {
        let mut links: Vec<_> = status.links.iter().filter_map(RouterView::of).collect();
        links.sort_by_key(|link| (link.silent, link.round_trip_us));
        let not_linked = status.routers.iter().filter(|router| router.link(&status.links).is_none());
        let not_linked = not_linked.map(|router| NotLinked {
            router: router.router.clone(),
            state: router.state.clone(),
            last_failure: router.last_failure.clone(),
        });
        let has_udp_way = |router: &Router| router.router.split(',').any(is_udp);
        let udp = if links.iter().any(|link| is_udp(&link.url)) {
            Udp::Passes
        } else if !links.is_empty() && status.routers.iter().any(has_udp_way) {
            Udp::SeemsBlocked
        } else {
            Udp::Unknown
        };
        let nat = match links.iter().filter_map(RouterView::is_translated).max() {
            Some(true) => Nat::Present,
            Some(false) => Nat::None,
            None => Nat::Unknown,
        };
        let mapping = if nat == Nat::None { Mapping::None } else { Mapping::of(&links) };
        let is_v6 = |link: &RouterView| link.remote.is_some_and(|remote| remote.is_ipv6());
        let ipv6 = Ipv6 { linked: links.iter().any(is_v6), address: status.ipv6 };
        let (node, not_linked) = (status.node.clone(), not_linked.collect());
        let port_mapping = status.port_mapping.clone();
        Self { node, not_linked, udp, nat, mapping, port_mapping, ipv6, links }
    }

    /// Returns the lines of `sgc netcheck`.
    pub fn lines(&self) -> Vec<Line> {
        let mut lines = vec![Line::from(format!("{}: the network as its routers see it", self.node))];
        if !self.links.is_empty() || !self.not_linked.is_empty() {
            let head = ["router", "link", "round trip", "from", "seen as"].map(Toned::from).to_vec();
            let links = self.links.iter().map(RouterView::row);
            let rows = std::iter::once(head).chain(links).chain(self.not_linked.iter().map(NotLinked::row));
            lines.push(Line::default());
            lines.extend(
                style::columns(&rows.collect::<Vec<_>>()).into_iter().map(|line| line.indented("  ")),
            );
        }
        lines.push(Line::default());
        let port_mapping = port_mapping_line(&self.port_mapping);
        let said = [
            self.nearest_line(),
            Some(self.udp_line()),
            self.nat_line(),
            self.mapping_line(),
            port_mapping,
            Some(self.ipv6_line()),
        ];
        lines.extend(said.into_iter().flatten().map(|part| Line::new([part])));
        lines
    }

    /// Returns the nearest of several routers.
    fn nearest_line(&self) -> Option<Toned> {
        let near = self.links.first().filter(|near| self.links.len() > 1 && !near.silent)?;
        Some(format!("Nearest router: {}, {}.", near.url, output::millis(near.round_trip_us)).into())
    }

    fn udp_line(&self) -> Toned {
        match self.udp {
            Udp::Passes => Toned::new(Tone::Good, "UDP passes."),
            Udp::SeemsBlocked => Toned::new(
                Tone::Attention,
                "UDP seems to be blocked: the node took another way than the ones over UDP that its routers have.",
            ),
            Udp::Unknown => "UDP: not known, because no link is up that would tell.".into(),
        }
    }

    fn nat_line(&self) -> Option<Toned> {
        Some(match self.nat {
            Nat::None => Toned::new(Tone::Good, "No NAT: the routers see the address of this host."),
            Nat::Present => {
                let seen = self.links.iter().find(|link| link.is_translated() == Some(true))?;
                let (local, observed) = (seen.local?, seen.observed?);
                format!("NAT: {local} is seen as {}.", observed.ip()).into()
            }
            Nat::Unknown if self.links.is_empty() => "NAT: not known, because no router is linked.".into(),
            Nat::Unknown => "NAT: not known, because the routers are of a version that does not tell.".into(),
        })
    }

    fn mapping_line(&self) -> Option<Toned> {
        if self.nat != Nat::Present {
            return None;
        }
        Some(match self.mapping {
            Mapping::None => return None,
            Mapping::EndpointIndependent => Toned::new(
                Tone::Good,
                "Its mapping is endpoint-independent (RFC 4787): all routers see the same port.",
            ),
            Mapping::EndpointDependent => Toned::new(
                Tone::Attention,
                "Its mapping depends on the destination (RFC 4787, \"symmetric\"): each router sees another port.",
            ),
            Mapping::Unknown => {
                "Its mapping is not known: that takes links over UDP to two routers with different \
                                 addresses."
                    .into()
            }
        })
    }

    fn ipv6_line(&self) -> Toned {
        match self.ipv6 {
            Ipv6 { linked: true, .. } => Toned::new(Tone::Good, "IPv6: a link uses it."),
            Ipv6 { address: Some(address), .. } => {
                format!("IPv6: this host would use {address}; no link uses it.").into()
            }
            Ipv6 { address: None, .. } => "IPv6: this host has no route to it.".into(),
        }
    }
}

impl Mapping {
    /// Compares what routers at different addresses see of one socket.
    fn of(links: &[RouterView]) -> Self {
        let seen: Vec<_> = links
            .iter()
            .filter(|link| is_udp(&link.url) && link.is_translated() == Some(true))
            .filter_map(|link| Some((scheme(&link.url), link.remote?, link.observed?)))
            .collect();
        let mut is_independent = false;
        for (n, (scheme, remote, observed)) in seen.iter().enumerate() {
            // Each transport has a socket for each address family.
            let same_socket = seen.iter().skip(n + 1).filter(|(other, from, _)| {
                other == scheme && from.is_ipv4() == remote.is_ipv4() && from != remote
            });
            for (_, other_remote, other_observed) in same_socket {
                if observed != other_observed {
                    return Self::EndpointDependent;
                }
                is_independent |= remote.ip() != other_remote.ip();
            }
        }
        if is_independent { Self::EndpointIndependent } else { Self::Unknown }
    }
}

impl RouterView {
    /// Returns the view of a router; `None` for other peers.
    fn of(link: &Link) -> Option<Self> {
        if link.direct {
            return None;
        }
        Some(Self {
            url: link.url.clone()?,
            remote: link.remote.parse().ok(),
            silent: link.silent,
            round_trip_us: link.rtt_us,
            local: link.local,
            observed: link.observed,
        })
    }

    /// Returns `true` if a NAT changes the address on the way to the router, `None` if that is not known.
    fn is_translated(&self) -> Option<bool> {
        Some(self.observed?.ip() != self.local?)
    }

    fn row(&self) -> Vec<Toned> {
        let state = if self.silent { Toned::new(Tone::Bad, "silent") } else { Toned::new(Tone::Good, "up") };
        let shown = |address: Option<String>| Toned::from(address.unwrap_or_else(|| "?".into()));
        vec![
            self.url.as_str().into(),
            state,
            output::millis(self.round_trip_us).into(),
            shown(self.local.map(|local| local.to_string())),
            shown(self.observed.map(|observed| observed.to_string())),
        ]
    }
}

impl NotLinked {
    fn row(&self) -> Vec<Toned> {
        let why = self.last_failure.as_ref().map(|why| format!(": {why}")).unwrap_or_default();
        let state = Toned::new(Tone::Bad, format!("{}{why}", self.state));
        vec![self.router.as_str().into(), state, Toned::default(), Toned::default(), Toned::default()]
    }
}

/// Says whether the gateway maps a port; `None` for a node of an older version.
fn port_mapping_line(mapping: &PortMapping) -> Option<Toned> {
    let gateway = mapping.gateway.map_or_else(|| "?".to_owned(), |gateway| gateway.to_string());
    Some(match mapping.state.as_str() {
        "off" => {
            let why = mapping.why_off.as_deref().unwrap_or("the node does not say why");
            format!("Port mapping: off, because {why}.").into()
        }
        "looking" => format!("Port mapping: the gateway {gateway} is being asked.").into(),
        "mapped" => {
            let external = mapping.external.map_or_else(|| "?".to_owned(), |external| external.to_string());
            let protocol = protocol_name(mapping.protocol.as_deref().unwrap_or("?"));
            let said = format!("Port mapping: the gateway {gateway} maps {external} by {protocol}");
            if mapping.behind_nat {
                let why = "a private address, so another NAT stands behind the gateway";
                Toned::new(Tone::Attention, format!("{said}: {why}."))
            } else {
                Toned::new(Tone::Good, format!("{said}."))
            }
        }
        "failed" => {
            let failures = mapping.failures.iter();
            let why: Vec<_> = failures
                .map(|(protocol, why)| format!("{}: {}", protocol_name(protocol), why.replace('_', " ")))
                .collect();
            format!("Port mapping: the gateway {gateway} offers none ({}).", why.join("; ")).into()
        }
        _ => return None,
    })
}

/// Returns the name of a protocol as its specification writes it.
fn protocol_name(key: &str) -> String {
    match key {
        "nat_pmp" => "NAT-PMP".to_owned(),
        "upnp_igd" => "UPnP-IGD".to_owned(),
        other => other.to_uppercase(),
    }
}

/// Returns the transport of a URL.
fn scheme(url: &str) -> &str {
    url.split_once("://").map_or(url, |(scheme, _)| scheme)
}

fn is_udp(url: &str) -> bool {
    UDP_SCHEMES.contains(&scheme(url))
}

#[cfg(test)]
mod tests {
    use serde_json::{Value, json};

    use super::*;

    fn link(url: &str, remote: &str, observed: Option<&str>) -> Value {
        json!({ "url": url, "remote": remote, "rtt_us": 23_100, "local": "10.0.0.5", "observed": observed })
    }

    fn netcheck(links: &[Value]) -> Netcheck {
        let routers = json!([{
            "router": "quic://r.example,tls://r.example", "at": "tls://r.example", "state": "trying again",
            "last_failure": "no answer",
        }]);
        let document = json!({ "node": "robot", "links": links, "routers": routers });
        Netcheck::of(&serde_json::from_value(document).unwrap())
    }

    #[test]
    fn peer_of_a_direct_link_is_no_router() {
        let mut direct = link("quic://203.0.113.9:4000", "203.0.113.9:4000", Some("192.0.2.77:1"));
        direct["direct"] = json!(true);
        let router = link("quic://r.example:7447", "198.51.100.1:7447", Some("10.0.0.5:7000"));
        let netcheck = netcheck(&[router, direct]);
        assert_eq!((netcheck.links.len(), netcheck.nat), (1, Nat::None));
    }

    #[test]
    fn nat_and_its_mapping_follow_from_what_routers_see() {
        use self::{Mapping as M, Nat as N};
        let seen = |n: u8, port: u16, observed: &str| {
            link(&format!("quic://r{n}.example:{port}"), &format!("192.0.2.{n}:{port}"), Some(observed))
        };
        let tls = link("tls://r2.example", "192.0.2.2:7447", Some("203.0.113.7:999"));
        let old = link("quic://r1.example", "192.0.2.1:7447", None);
        let first = seen(1, 7447, "203.0.113.7:4000");
        for (links, nat, mapping) in [
            (vec![], N::Unknown, M::Unknown),
            (vec![old.clone()], N::Unknown, M::Unknown),
            (vec![seen(1, 7447, "10.0.0.5:4000")], N::None, M::None),
            (vec![first.clone()], N::Present, M::Unknown),
            (vec![old, first.clone()], N::Present, M::Unknown),
            // Another transport has another socket, and another port of one address reveals nothing of other addresses.
            (vec![first.clone(), tls], N::Present, M::Unknown),
            (vec![first.clone(), seen(1, 7448, "203.0.113.7:4000")], N::Present, M::Unknown),
            (vec![first.clone(), seen(1, 7448, "203.0.113.7:4001")], N::Present, M::EndpointDependent),
            (vec![first.clone(), seen(2, 7447, "203.0.113.7:4000")], N::Present, M::EndpointIndependent),
            (vec![first.clone(), seen(2, 7447, "203.0.113.7:4001")], N::Present, M::EndpointDependent),
            // A router in the same network sees the host itself.
            (vec![first, seen(3, 7447, "10.0.0.5:4000")], N::Present, M::Unknown),
        ] {
            let found = netcheck(&links);
            assert_eq!((&found.nat, &found.mapping), (&nat, &mapping), "{links:?}");
        }
    }

    #[test]
    fn udp_seems_blocked_if_only_other_ways_are_up() {
        let tls = link("tls://r.example", "192.0.2.1:7447", None);
        assert_eq!(netcheck(&[]).udp, Udp::Unknown);
        assert_eq!(netcheck(std::slice::from_ref(&tls)).udp, Udp::SeemsBlocked);
        assert_eq!(netcheck(&[tls, link("quic://r2.example", "192.0.2.2:7447", None)]).udp, Udp::Passes);
    }

    #[test]
    fn gateway_is_said_to_map_a_port_or_why_it_does_not() {
        let said = |mapping: Value| {
            let document = json!({ "node": "robot", "port_mapping": mapping });
            let netcheck = Netcheck::of(&serde_json::from_value(document).unwrap());
            let lines = netcheck.lines().into_iter().map(|line| line.to_string());
            lines.into_iter().find(|line| line.starts_with("Port mapping"))
        };
        let mapped = |protocol: &str, behind_nat: bool| {
            said(json!({
                "state": "mapped", "gateway": "192.168.1.1", "protocol": protocol,
                "external": "203.0.113.7:5000", "behind_nat": behind_nat, "lifetime_s": 7000,
            }))
        };
        assert_eq!(
            mapped("pcp", false).unwrap(),
            "Port mapping: the gateway 192.168.1.1 maps 203.0.113.7:5000 by PCP."
        );
        assert_eq!(
            mapped("upnp_igd", true).unwrap(),
            "Port mapping: the gateway 192.168.1.1 maps 203.0.113.7:5000 by UPnP-IGD: a private address, so another NAT \
             stands behind the gateway."
        );
        let failures = json!({ "pcp": "unsupported", "nat_pmp": "no_answer" });
        assert_eq!(
            said(json!({ "state": "failed", "gateway": "192.168.1.1", "failures": failures })).unwrap(),
            "Port mapping: the gateway 192.168.1.1 offers none (NAT-PMP: no answer; PCP: unsupported)."
        );
        assert_eq!(
            said(json!({ "state": "looking", "gateway": "192.168.1.1" })).unwrap(),
            "Port mapping: the gateway 192.168.1.1 is being asked."
        );
        assert_eq!(
            said(json!({ "state": "off", "why_off": "no router over QUIC or DTLS sees a NAT" })).unwrap(),
            "Port mapping: off, because no router over QUIC or DTLS sees a NAT."
        );
        assert_eq!(said(json!({})), None);
    }

    #[test]
    fn nearest_router_comes_first_and_a_silent_one_last() {
        let at = |n: u8, rtt_us: u64, silent: bool| {
            let mut link = link(&format!("quic://r{n}.example"), &format!("192.0.2.{n}:7447"), None);
            (link["rtt_us"], link["silent"]) = (rtt_us.into(), silent.into());
            link
        };
        let nearest = |links: &[Value]| {
            let netcheck = netcheck(links);
            (netcheck.links[0].url.clone(), netcheck.nearest_line().map(|line| line.to_string()))
        };
        let said = "Nearest router: quic://r2.example, 9.00 ms.".to_owned();
        let near = "quic://r2.example".to_owned();
        let links = [at(1, 40_000, false), at(2, 9_000, false), at(3, 1_000, true)];
        assert_eq!(nearest(&links), (near.clone(), Some(said)));
        assert_eq!(nearest(&links[1..2]), (near.clone(), None), "there is nothing to compare");
        let silent = [at(1, 40_000, true), at(2, 9_000, true)];
        assert_eq!(nearest(&silent), (near, None));
    }

    #[test]
    fn lines_say_what_is_known() {
        let found = netcheck(&[link("quic://r1.example:7447", "192.0.2.1:7447", Some("203.0.113.7:4000"))]);
        let lines: Vec<_> = found.lines().iter().map(|line| line.to_string().trim_end().to_owned()).collect();
        assert_eq!(
            lines,
            [
                "robot: the network as its routers see it",
                "",
                "  router                            link                     round trip  from      seen as",
                "  quic://r1.example:7447            up                       23 ms       10.0.0.5  203.0.113.7:4000",
                "  quic://r.example,tls://r.example  trying again: no answer",
                "",
                "UDP passes.",
                "NAT: 10.0.0.5 is seen as 203.0.113.7.",
                "Its mapping is not known: that takes links over UDP to two routers with different addresses.",
                "IPv6: this host has no route to it.",
            ]
        );
    }
}
