//! The rules for what a user may call things: topics, message types, nodes, recipients, peers, addresses.
//!
//! Each function takes a text and gives the valid thing or the mistake; where the text comes from and what it
//! has to do with other settings is the business of `resolve`.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use sgc_transport::{ListenAddr, UrlError};
use sgc_trust::{FleetName, GroupName, LABEL_BYTES_MAX, NodeName};
use sgc_wire::NodeId;

use super::error::{Mistake, TopicRule};
use super::router_url::{RouterUrl, RouterUrlError};
use super::{PEER_RATE_MAX, PEER_RATE_MIN};

/// The longest topic: 256 bytes of DDS less a terminator and 8 for the prefix that rmw adds.
pub const TOPIC_BYTES_MAX: usize = 247;
/// The longest message type: 256 bytes of DDS less a terminator and what `::dds_::` and `_` add.
pub const TYPE_BYTES_MAX: usize = 240;
/// The longest peer address, as `rmw` has it.
pub const PEER_BYTES_MAX: usize = 255;

const HOST_BYTES_MAX: usize = 253;
const DNS_PORT: u16 = 53;

/// Who may subscribe to a share, or publish on it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Recipient {
    /// `"*"`: every member of the fleet.
    Everyone,
    /// `"group:operators"`: the members of a group, without the prefix.
    Group(GroupName),
    /// `"desk"`: one node.
    Node(NodeName),
    /// `"partner:acme"`: the nodes that the `[[partner]]` of that name stands for.
    Partner(FleetName),
}

impl std::fmt::Display for Recipient {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Everyone => f.write_str("*"),
            Self::Group(group) => write!(f, "group:{group}"),
            Self::Node(node) => write!(f, "{node}"),
            Self::Partner(partner) => write!(f, "partner:{partner}"),
        }
    }
}

/// Checks a fully qualified topic name as rmw does; repeated underscores are allowed as it allows them.
pub(super) fn topic(key: &'static str, value: &str) -> Result<String, Mistake> {
    if value.contains(['*', '?']) {
        return Err(Mistake::PlannedValue {
            key,
            value: value.to_owned(),
            what: "wildcards are",
            instead: "name one topic",
        });
    }
    match broken_topic_rule(value) {
        None => Ok(value.to_owned()),
        Some(rule) => {
            Err(Mistake::TopicName { key, value: value.to_owned(), rule, right: repaired_topic(value) })
        }
    }
}

fn broken_topic_rule(value: &str) -> Option<TopicRule> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '/';
    let words = || value.split('/').skip(1);
    if value.trim_matches('/').is_empty() {
        Some(TopicRule::NotEmpty)
    } else if value.starts_with('~') {
        Some(TopicRule::NotPrivate)
    } else if !value.starts_with('/') {
        Some(TopicRule::Absolute)
    } else if value.ends_with('/') {
        Some(TopicRule::NoTrailingSlash)
    } else if let Some(c) = value.chars().find(|c| !allowed(*c)) {
        Some(TopicRule::Characters(c))
    } else if words().any(str::is_empty) {
        Some(TopicRule::NoRepeatedSlash)
    } else if words().any(|word| word.starts_with(|c: char| c.is_ascii_digit())) {
        Some(TopicRule::NoLeadingDigit)
    } else if value.len() > TOPIC_BYTES_MAX {
        Some(TopicRule::Length(TOPIC_BYTES_MAX))
    } else {
        None
    }
}

/// The valid topic that is nearest to `value`, if there is one to be guessed.
fn repaired_topic(value: &str) -> Option<String> {
    let value = value.trim();
    let words = value.strip_prefix("rt/").unwrap_or(value).split('/').filter(|word| !word.is_empty());
    let repaired: String = words
        .flat_map(|word| {
            std::iter::once('/')
                .chain(word.chars().map(|c| if matches!(c, '-' | ' ' | '.') { '_' } else { c }))
        })
        .collect();
    broken_topic_rule(&repaired).is_none().then_some(repaired)
}

/// Checks a message type and gives it as `pkg/msg/Name`, also from DDS's `pkg::msg::dds_::Name_`.
pub(super) fn message_type(key: &'static str, value: &str) -> Result<String, Mistake> {
    let planned = |what| Mistake::PlannedValue {
        key,
        value: value.to_owned(),
        what,
        instead: "name a message type, such as \"std_msgs/msg/String\"",
    };
    let wrong = |right| Mistake::TypeName { key, value: value.to_owned(), right };
    if value.len() > TYPE_BYTES_MAX {
        return Err(Mistake::TooLong { key, bytes: value.len(), max: TYPE_BYTES_MAX });
    }
    let dds: Vec<&str> = value.split("::").collect();
    if let [package, "msg", "dds_", name] = dds[..]
        && let Some(name) = name.strip_suffix('_')
        && is_identifier(package)
        && is_identifier(name)
    {
        return Ok(format!("{package}/msg/{name}"));
    }
    let words: Vec<&str> = value.split('/').collect();
    match words[..] {
        [package, "msg", name] if is_identifier(package) && is_identifier(name) => Ok(value.to_owned()),
        [_, "srv", _] => Err(planned("services are")),
        [_, "action", _] => Err(planned("actions are")),
        _ => {
            let slashed = value.trim().replace("::", "/").replace('.', "/");
            let words: Vec<&str> = slashed.split('/').collect();
            let right = match words[..] {
                [package, name] | [package, "msg", name] if is_identifier(package) && is_identifier(name) => {
                    Some(format!("{package}/msg/{name}"))
                }
                _ => None,
            };
            Err(wrong(right))
        }
    }
}

fn is_identifier(word: &str) -> bool {
    word.starts_with(|c: char| c.is_ascii_alphabetic())
        && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

/// Checks the name of a node.
pub(super) fn node(key: &'static str, value: &str) -> Result<NodeName, Mistake> {
    value.parse().map_err(|_| {
        let right = repaired_label(value);
        Mistake::NodeName { key, value: value.to_owned(), max: LABEL_BYTES_MAX, right }
    })
}

/// Checks the name of a partner.
pub(super) fn partner(key: &'static str, value: &str) -> Result<FleetName, Mistake> {
    value.parse().map_err(|_| {
        let right = repaired_label(value);
        Mistake::PartnerName { key, value: value.to_owned(), max: LABEL_BYTES_MAX, right }
    })
}

/// Checks a node id.
pub(super) fn node_id(key: &'static str, value: &str) -> Result<NodeId, Mistake> {
    value.parse().map_err(|_| Mistake::NodeId { key, value: value.to_owned() })
}

/// Checks a length of time, `NUMBER` and `s`, `min`, `h` or `d`, within bounds.
pub(super) fn duration(
    key: &'static str,
    value: &str,
    (min, max): (Duration, Duration),
) -> Result<Duration, Mistake> {
    let duration = parse_duration(value).filter(|d| (min..=max).contains(d));
    duration.ok_or_else(|| Mistake::Duration { key, value: value.to_owned(), min, max })
}

/// A length of time as the configuration has it: `90s`, `15min`, `1h`, `30d`.
pub fn parse_duration(text: &str) -> Option<Duration> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = match unit.trim_start() {
        "s" => 1,
        "m" | "min" => 60,
        "h" => 3600,
        "d" => 86_400,
        _ => return None,
    };
    number.parse::<u64>().ok()?.checked_mul(unit).map(Duration::from_secs)
}

/// A length of time in the largest unit that divides it.
pub(super) fn duration_text(duration: Duration) -> String {
    let seconds = duration.as_secs();
    let units = [(86_400, "d"), (3600, "h"), (60, "min")];
    let unit = units.into_iter().find(|(unit, _)| seconds.is_multiple_of(*unit) && seconds > 0);
    unit.map_or_else(|| format!("{seconds}s"), |(unit, text)| format!("{}{text}", seconds / unit))
}

/// Checks what a peer may send.
pub(super) fn rate(key: &'static str, value: &str) -> Result<u64, Mistake> {
    let rate = parse_rate(value).filter(|rate| (PEER_RATE_MIN..=PEER_RATE_MAX).contains(rate));
    rate.ok_or_else(|| Mistake::Rate { key, value: value.to_owned() })
}

/// A rate as the configuration has it: `500kbps`, `50Mbps`, `1Gbps`; in bits a second.
pub fn parse_rate(text: &str) -> Option<u64> {
    let (number, unit) = text.split_at(text.find(|c: char| !c.is_ascii_digit())?);
    let unit = RATE_UNITS.into_iter().find(|(_, name)| *name == unit.trim_start())?.0;
    number.parse::<u64>().ok()?.checked_mul(unit)
}

/// A rate in the largest unit that divides it.
pub(super) fn rate_text(rate: u64) -> String {
    let unit = RATE_UNITS.into_iter().find(|(unit, _)| rate.is_multiple_of(*unit));
    unit.map_or_else(|| format!("{rate}bps"), |(unit, name)| format!("{}{name}", rate / unit))
}

const RATE_UNITS: [(u64, &str); 3] = [(1_000_000_000, "Gbps"), (1_000_000, "Mbps"), (1000, "kbps")];

/// Checks one entry of `to` or `publish`.
pub(super) fn recipient(key: &'static str, value: &str) -> Result<Recipient, Mistake> {
    let recipient = match value.split_once(':') {
        None if value == "*" => Some(Recipient::Everyone),
        None => value.parse().ok().map(Recipient::Node),
        Some(("group", group)) => group.parse().ok().map(Recipient::Group),
        Some(("partner", partner)) => partner.parse().ok().map(Recipient::Partner),
        Some(_) => None,
    };
    recipient.ok_or_else(|| Mistake::Recipient { key, value: value.to_owned(), max: LABEL_BYTES_MAX })
}

/// The valid name that is nearest to `value`, if there is one to be guessed.
fn repaired_label(value: &str) -> Option<String> {
    let repaired = value.trim().trim_start_matches('/').to_lowercase().replace([' ', '/'], "-");
    repaired.parse::<NodeName>().is_ok().then_some(repaired)
}

/// Checks a static peer: a host name or an IP address, without a port.
pub(super) fn peer(key: &'static str, value: &str) -> Result<String, Mistake> {
    if value.len() <= PEER_BYTES_MAX && is_host(value) {
        Ok(value.to_owned())
    } else {
        Err(Mistake::StaticPeer { key, value: value.to_owned() })
    }
}

fn is_host(value: &str) -> bool {
    let is_label = |label: &str| {
        (1..=63).contains(&label.len())
            && label.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '_'))
            && !label.starts_with('-')
            && !label.ends_with('-')
    };
    // Four numbers that are no address are a mistyped address, not a name: no top-level domain is a number.
    let numeric = value.rsplit('.').next().is_some_and(|last| last.chars().all(|c| c.is_ascii_digit()));
    value.parse::<IpAddr>().is_ok()
        || (!numeric && value.len() <= HOST_BYTES_MAX && value.split('.').all(is_label))
}

/// Checks where a router is to be found: `quic://HOST[:PORT]`, `srv://DOMAIN`, `mdns://[NODE]`.
pub(super) fn router(key: &'static str, value: &str) -> Result<RouterUrl, Mistake> {
    let router = match value.parse() {
        Ok(router) => router,
        Err(RouterUrlError::Link(fault)) => return Err(url_mistake(key, value, fault)),
        Err(fault) => return Err(Mistake::Router { key, value: value.to_owned(), fault }),
    };
    if let RouterUrl::At(url) = &router {
        let host = url.host.clone();
        if !is_host(&host) {
            return Err(url_mistake(key, value, UrlError::Host(host)));
        }
        if host.parse::<IpAddr>().is_ok_and(|address| address.is_unspecified()) {
            return Err(Mistake::UrlUnspecified { key, value: value.to_owned(), host });
        }
    }
    Ok(router)
}

/// Checks a DNS server, `ADDRESS[:PORT]`.
pub(super) fn resolver(key: &'static str, value: &str) -> Result<SocketAddr, Mistake> {
    let bare = || value.parse().ok().map(|address| SocketAddr::new(address, DNS_PORT));
    let server = value.parse().ok().or_else(bare);
    server
        .filter(|server: &SocketAddr| server.port() != 0 && !server.ip().is_unspecified())
        .ok_or_else(|| Mistake::Resolver { key, value: value.to_owned() })
}

/// Checks where to listen, `quic://ADDRESS[:PORT]`.
pub(super) fn listen(key: &'static str, value: &str) -> Result<ListenAddr, Mistake> {
    if matches!(value.split_once("://"), Some(("srv" | "mdns", _))) {
        return Err(Mistake::ListenFinds { key, value: value.to_owned() });
    }
    value.parse().map_err(|fault| url_mistake(key, value, fault))
}

fn url_mistake(key: &'static str, value: &str, fault: UrlError) -> Mistake {
    let value = value.to_owned();
    match fault {
        UrlError::SchemePlanned(_) => {
            Mistake::PlannedValue { key, value, what: "this transport is", instead: "use quic://" }
        }
        fault => Mistake::Url { key, value, fault },
    }
}
