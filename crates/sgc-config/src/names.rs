//! Rules for single values: topics, message types, nodes, recipients, peers, addresses.
//!
//! Each function takes a text and returns the valid value or the mistake. `resolve` knows where the text comes from and
//! how it relates to other settings.

use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::Duration;

use sgc_gateway::{PageOrigin, PageOriginError};
use sgc_ros::{Interface, TOPIC_BYTES_MAX};
use sgc_store::{StorePrefix, StoreServer, StoreUser};
use sgc_transport::{ListenAddr, UrlError};
use sgc_trust::{CertificateName, FleetName, LABEL_BYTES_MAX, NodeName};
use sgc_wire::NodeId;

use crate::config::{DEAD_MAN_MAX, DEAD_MAN_MIN, PEER_RATE_MAX, PEER_RATE_MIN};
use crate::error::{Mistake, TopicRule};
use crate::gateway::GatewayUrl;
use crate::metrics::{OtlpUrl, OtlpUrlError};
use crate::recipient::Recipient;
use crate::router_url::{RouterUrl, RouterUrlError};
use crate::schema::nearest;
use crate::units::{parse_duration, parse_rate, parse_size};
use crate::zenoh::{Middleware, ZENOH_ROUTER_BYTES_MAX};

/// The longest frame prefix.
pub const FRAME_PREFIX_BYTES_MAX: usize = 64;
/// The longest message type: 256 bytes of DDS less a terminator and what `::dds_::` and `_` add.
pub const TYPE_BYTES_MAX: usize = 240;
/// The longest peer address in `rmw`.
pub const PEER_BYTES_MAX: usize = 255;

const HOST_BYTES_MAX: usize = 253;
const DNS_PORT: u16 = 53;

/// Checks a topic, or a pattern with `*` and `**` in place of words.
pub(crate) fn pattern(key: &'static str, value: &str) -> Result<String, Mistake> {
    if !value.contains('*') {
        return topic(key, value);
    }
    let is_wildcard = |word: &&str| matches!(*word, "*" | "**");
    if value.split('/').any(|word| word.contains('*') && !is_wildcard(&word)) {
        let whole = |word: &str| if word.contains('*') { "*".to_owned() } else { word.to_owned() };
        let right = value.split('/').map(whole).collect::<Vec<_>>().join("/");
        return Err(Mistake::Wildcard { key, value: value.to_owned(), right });
    }
    // A wildcard may stand wherever a word may.
    let words: Vec<_> = value.split('/').map(|word| if is_wildcard(&word) { "w" } else { word }).collect();
    let name = words.join("/");
    match broken_topic_rule(&name) {
        None => Ok(value.to_owned()),
        Some(rule) => Err(Mistake::TopicName { key, value: value.to_owned(), rule, right: None }),
    }
}

/// Checks a frame prefix.
pub(crate) fn frame_prefix(key: &'static str, value: &str) -> Result<String, Mistake> {
    let allowed = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-' | b'.' | b'/');
    let fits = (1..=FRAME_PREFIX_BYTES_MAX).contains(&value.len());
    if fits && value.bytes().all(allowed) && !value.starts_with('/') {
        return Ok(value.to_owned());
    }
    Err(Mistake::FramePrefix { key, value: value.to_owned(), max: FRAME_PREFIX_BYTES_MAX })
}

/// Returns the check of an interface's name. Interfaces of several topics take no wildcard.
pub(crate) fn interface_name(interface: Interface) -> fn(&'static str, &str) -> Result<String, Mistake> {
    match interface {
        Interface::Topic | Interface::Service => pattern,
        Interface::Action | Interface::Parameters => topic,
    }
}

/// Checks a fully qualified topic name like rmw, which permits repeated underscores.
pub(crate) fn topic(key: &'static str, value: &str) -> Result<String, Mistake> {
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

/// Returns the valid topic that is nearest to `value`, if one can be guessed.
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

/// Checks the type of an interface.
pub(crate) fn interface_type(
    key: &'static str,
    value: &str,
    interface: Interface,
) -> Result<String, Mistake> {
    let (kind, example) = match interface {
        Interface::Topic => return message_type(key, value),
        Interface::Service => ("srv", "std_srvs/srv/Trigger"),
        Interface::Action => ("action", "nav2_msgs/action/NavigateToPose"),
        Interface::Parameters => return Err(Mistake::TopicsOnly { key, interface: interface.key() }),
    };
    if value.len() > TYPE_BYTES_MAX {
        return Err(Mistake::TooLong { key, bytes: value.len(), max: TYPE_BYTES_MAX });
    }
    let ros = sgc_ros::ros_type(value);
    match ros.split('/').collect::<Vec<_>>()[..] {
        [package, found, name] if found == kind && is_identifier(package) && is_identifier(name) => Ok(ros),
        _ => {
            let (value, interface) = (value.to_owned(), interface.key());
            Err(Mistake::InterfaceType { key, value, interface, example })
        }
    }
}

/// Checks a message type and returns it as `pkg/msg/Name`, also from DDS's `pkg::msg::dds_::Name_`.
pub(crate) fn message_type(key: &'static str, value: &str) -> Result<String, Mistake> {
    let other = || Mistake::InterfaceType {
        key,
        value: value.to_owned(),
        interface: Interface::Topic.key(),
        example: "std_msgs/msg/String",
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
        [_, "srv" | "action", _] => Err(other()),
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
pub(crate) fn node(key: &'static str, value: &str) -> Result<NodeName, Mistake> {
    value.parse().map_err(|_| {
        let right = repaired_label(value);
        Mistake::NodeName { key, value: value.to_owned(), max: LABEL_BYTES_MAX, right }
    })
}

/// Checks the name of a partner.
pub(crate) fn partner(key: &'static str, value: &str) -> Result<FleetName, Mistake> {
    value.parse().map_err(|_| {
        let right = repaired_label(value);
        Mistake::PartnerName { key, value: value.to_owned(), max: LABEL_BYTES_MAX, right }
    })
}

/// Checks a node id.
pub(crate) fn node_id(key: &'static str, value: &str) -> Result<NodeId, Mistake> {
    value.parse().map_err(|_| Mistake::NodeId { key, value: value.to_owned() })
}

/// Checks a duration, `NUMBER` and `s`, `min`, `h` or `d`, and its bounds.
pub(crate) fn duration(
    key: &'static str,
    value: &str,
    (min, max): (Duration, Duration),
) -> Result<Duration, Mistake> {
    let duration = parse_duration(value).filter(|d| (min..=max).contains(d));
    duration.ok_or_else(|| Mistake::Duration { key, value: value.to_owned(), min, max })
}

/// Checks the rate limit of a peer.
pub(crate) fn rate(key: &'static str, value: &str) -> Result<u64, Mistake> {
    let rate = parse_rate(value).filter(|rate| (PEER_RATE_MIN..=PEER_RATE_MAX).contains(rate));
    rate.ok_or_else(|| Mistake::Rate { key, value: value.to_owned() })
}

/// Checks a DSCP mark: a class of differentiated services (RFC 2474, 2597, 3246), or its number.
pub(crate) fn dscp(key: &'static str, value: &str) -> Result<u8, Mistake> {
    const WHAT: &str = "a class of differentiated services: \"CS0\" to \"CS7\", \"AF11\" to \"AF43\", \"EF\", or \"0\" to \"63\"";
    let digit = |byte: u8, max: u8| Some(byte.checked_sub(b'0')?).filter(|digit| *digit <= max);
    let mark = match value.as_bytes() {
        b"EF" => Some(46),
        [b'C', b'S', class] => digit(*class, 7).map(|class| class << 3),
        [b'A', b'F', class, drop] => digit(*class, 4)
            .zip(digit(*drop, 3))
            .filter(|(class, drop)| *class > 0 && *drop > 0)
            .map(|(class, drop)| (class << 3) | (drop << 1)),
        [b'0'..=b'9'] | [b'1'..=b'9', b'0'..=b'9'] => value.parse().ok().filter(|mark| *mark < 64),
        _ => None,
    };
    mark.ok_or_else(|| shaping_mistake(key, value, WHAT))
}

/// Checks a message rate. Returns the time between two messages.
pub(crate) fn interval(key: &'static str, value: &str) -> Result<Duration, Mistake> {
    const WHAT: &str = "messages a second, 0.001 to 10000: \"10Hz\", \"0.5Hz\"";
    let number = |text: &str| {
        let text = text.trim_end();
        let is_plain = text.bytes().all(|b| b.is_ascii_digit() || b == b'.') && text.len() <= 16;
        text.parse::<f64>().ok().filter(|hz| is_plain && (0.001..=10_000.0).contains(hz))
    };
    let hz = value.strip_suffix("Hz").and_then(number);
    hz.map(|hz| Duration::from_secs_f64(1.0 / hz)).ok_or_else(|| shaping_mistake(key, value, WHAT))
}

/// Checks a bandwidth in bits a second.
pub(crate) fn bandwidth(key: &'static str, value: &str) -> Result<u64, Mistake> {
    const WHAT: &str = "bits a second, \"1kbps\" to \"1000Gbps\": \"500kbps\", \"2Mbps\"";
    let rate = parse_rate(value).filter(|rate| (1000..=PEER_RATE_MAX).contains(rate));
    rate.ok_or_else(|| shaping_mistake(key, value, WHAT))
}

/// Checks the greatest age of messages.
pub(crate) fn age(key: &'static str, value: &str) -> Result<Duration, Mistake> {
    const WHAT: &str = "a length of time, \"1ms\" to \"1h\": \"500ms\", \"2s\"";
    let bounds = Duration::from_millis(1)..=Duration::from_secs(3600);
    millis_within(value, bounds).ok_or_else(|| shaping_mistake(key, value, WHAT))
}

/// Checks a time of a dead-man switch.
pub(crate) fn dead_man_time(key: &'static str, value: &str) -> Result<Duration, Mistake> {
    const WHAT: &str = "a length of time, \"20ms\" to \"60s\": \"300ms\", \"1s\"";
    millis_within(value, DEAD_MAN_MIN..=DEAD_MAN_MAX).ok_or_else(|| shaping_mistake(key, value, WHAT))
}

/// Parses a length of time in milliseconds or longer units.
fn millis_within(value: &str, bounds: RangeInclusive<Duration>) -> Option<Duration> {
    let millis = |text: &str| {
        let digits = Some(text.trim_end()).filter(|t| t.bytes().all(|b| b.is_ascii_digit()));
        digits?.parse().ok().map(Duration::from_millis)
    };
    let time = value.strip_suffix("ms").map_or_else(|| parse_duration(value), millis);
    time.filter(|time| bounds.contains(time))
}

fn shaping_mistake(key: &'static str, value: &str, what: &'static str) -> Mistake {
    Mistake::Shaping { key, value: value.to_owned(), what }
}

/// Checks one entry of `to` or `publish`.
pub(crate) fn recipient(key: &'static str, value: &str) -> Result<Recipient, Mistake> {
    let recipient = match value.split_once(':') {
        None if value == "*" => Some(Recipient::Everyone),
        None => value.parse().ok().map(Recipient::Node),
        Some(("group", group)) => group.parse().ok().map(Recipient::Group),
        Some(("partner", partner)) => partner.parse().ok().map(Recipient::Partner),
        Some(_) => None,
    };
    recipient.ok_or_else(|| Mistake::Recipient { key, value: value.to_owned(), max: LABEL_BYTES_MAX })
}

/// Returns the valid name that is nearest to `value`, if one can be guessed.
fn repaired_label(value: &str) -> Option<String> {
    let repaired = value.trim().trim_start_matches('/').to_lowercase().replace([' ', '/'], "-");
    repaired.parse::<NodeName>().is_ok().then_some(repaired)
}

/// Checks a static peer: a host name or an IP address, without a port.
pub(crate) fn peer(key: &'static str, value: &str) -> Result<String, Mistake> {
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
    // No top-level domain is numeric, so a numeric last label means a mistyped address.
    let numeric = value.rsplit('.').next().is_some_and(|last| last.chars().all(|c| c.is_ascii_digit()));
    value.parse::<IpAddr>().is_ok()
        || (!numeric && value.len() <= HOST_BYTES_MAX && value.split('.').all(is_label))
}

/// Checks an entry of `routers`: `quic://HOST[:PORT]`, `srv://DOMAIN`, `mdns://[NODE]`.
pub(crate) fn router(key: &'static str, value: &str) -> Result<RouterUrl, Mistake> {
    let router: RouterUrl = match value.parse() {
        Ok(router) => router,
        Err(RouterUrlError::Link(fault)) => return Err(url_mistake(key, value, fault)),
        Err(fault) => return Err(Mistake::Router { key, value: value.to_owned(), fault }),
    };
    for url in router.urls() {
        url.scheme.check_built().map_err(|fault| url_mistake(key, value, fault))?;
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
pub(crate) fn resolver(key: &'static str, value: &str) -> Result<SocketAddr, Mistake> {
    let bare = || value.parse().ok().map(|address| SocketAddr::new(address, DNS_PORT));
    let server = value.parse().ok().or_else(bare);
    server
        .filter(|server: &SocketAddr| server.port() != 0 && !server.ip().is_unspecified())
        .ok_or_else(|| Mistake::Resolver { key, value: value.to_owned() })
}

/// Checks the listening address of metrics, `ADDRESS:PORT`.
pub(crate) fn metrics_listen(key: &'static str, value: &str) -> Result<SocketAddr, Mistake> {
    value.parse().map_err(|_| Mistake::MetricsListen { key, value: value.to_owned() })
}

/// Parses the URL of a collector of metrics.
pub(crate) fn otlp(key: &'static str, value: &str) -> Result<OtlpUrl, Mistake> {
    if cfg!(not(feature = "otlp")) {
        return Err(Mistake::OtlpNotBuilt { key });
    }
    value.parse().map_err(|fault| match fault {
        OtlpUrlError::Credentials => Mistake::OtlpCredentials { key },
        fault => Mistake::OtlpUrl { key, value: value.to_owned(), fault },
    })
}

/// Parses the middleware of the local network.
pub(crate) fn middleware(key: &'static str, value: &str) -> Result<Middleware, Mistake> {
    const WORDS: [&str; 3] = ["dds", "zenoh", "both"];
    let middleware = match value {
        "dds" => Middleware::Dds,
        "zenoh" => Middleware::Zenoh,
        "both" => Middleware::Both,
        _ => {
            let (value, nearest) = (value.to_owned(), nearest(value, &WORDS));
            return Err(Mistake::UnknownWord { key, value, nearest, known: &WORDS });
        }
    };
    if cfg!(not(feature = "zenoh")) && middleware.has_zenoh() {
        return Err(Mistake::ZenohNotBuilt { key, value: value.to_owned() });
    }
    Ok(middleware)
}

/// Checks the endpoint of a router of Zenoh, `PROTOCOL/ADDRESS[?METADATA][#CONFIG]`.
pub(crate) fn zenoh_router(key: &'static str, value: &str) -> Result<String, Mistake> {
    let (bytes, max) = (value.len(), ZENOH_ROUTER_BYTES_MAX);
    if bytes > max {
        return Err(Mistake::TooLong { key, bytes, max });
    }
    if is_zenoh_endpoint(value) {
        return Ok(value.to_owned());
    }
    // The text behind `#` may be a private key.
    let (shown, secret) = split_off(value, '#');
    let value = if secret.is_some() { format!("{shown}#...") } else { shown.to_owned() };
    Err(Mistake::ZenohRouter { key, value })
}

fn is_zenoh_endpoint(text: &str) -> bool {
    let (text, config) = split_off(text, '#');
    let (text, metadata) = split_off(text, '?');
    let Some((protocol, address)) = text.split_once('/') else { return false };
    let is_address = match protocol {
        "tcp" | "tls" => is_host_and_port(address),
        "unixsock-stream" => !address.is_empty() && !address.contains(char::is_control),
        _ => false,
    };
    is_address && [metadata, config].into_iter().flatten().all(is_list_of_settings)
}

/// Splits off the text behind the first `mark`, if there is one.
fn split_off(text: &str, mark: char) -> (&str, Option<&str>) {
    text.split_once(mark).map_or((text, None), |(text, rest)| (text, Some(rest)))
}

/// Returns `true` for `KEY=VALUE;KEY=VALUE`, where values may be missing.
fn is_list_of_settings(text: &str) -> bool {
    !text.contains('?') && text.split(';').all(|setting| !setting.is_empty() && !setting.starts_with('='))
}

fn is_host_and_port(address: &str) -> bool {
    let Some((host, port)) = address.rsplit_once(':') else { return false };
    let is_host = match host.strip_prefix('[').and_then(|host| host.strip_suffix(']')) {
        Some(bare) => bare.parse::<Ipv6Addr>().is_ok(),
        None => !host.contains(':') && is_host(host),
    };
    is_host && port.parse::<u16>().is_ok_and(|port| port != 0)
}

/// Parses the URL of a server of a store.
pub(crate) fn store_server(key: &'static str, value: &str) -> Result<StoreServer, Mistake> {
    value.parse().map_err(|fault| Mistake::StoreServer { key, fault })
}

/// Checks the prefix of the keys in a store.
pub(crate) fn store_prefix(key: &'static str, value: &str) -> Result<StorePrefix, Mistake> {
    value.parse().map_err(|fault| Mistake::StorePrefix { key, fault })
}

/// Checks the name of a store's user.
pub(crate) fn store_user(key: &'static str, value: &str) -> Result<String, Mistake> {
    StoreUser::check_name(value).map(|()| value.to_owned()).map_err(|fault| Mistake::StoreUser { key, fault })
}

/// Checks a listen address, `SCHEME://ADDRESS[:PORT]`.
pub(crate) fn listen(key: &'static str, value: &str) -> Result<ListenAddr, Mistake> {
    if matches!(value.split_once("://"), Some(("srv" | "mdns", _))) {
        return Err(Mistake::ListenFinds { key, value: value.to_owned() });
    }
    let mistake = |fault| url_mistake(key, value, fault);
    let listen: ListenAddr = value.parse().map_err(mistake)?;
    listen.scheme.check_built().map_err(mistake)?;
    Ok(listen)
}

fn url_mistake(key: &'static str, value: &str, fault: UrlError) -> Mistake {
    Mistake::Url { key, value: value.to_owned(), fault }
}

/// Parses a listen address of the gateway.
pub(crate) fn gateway_listen(key: &'static str, value: &str) -> Result<GatewayUrl, Mistake> {
    let mistake = |fault| Mistake::GatewayUrl { key, value: value.to_owned(), fault };
    let url: GatewayUrl = value.parse().map_err(mistake)?;
    url.scheme.protocol().check_built().map_err(|absent| mistake(absent.into()))?;
    Ok(url)
}

/// Parses a name of the gateway's certificate.
pub(crate) fn certificate_name(key: &'static str, value: &str) -> Result<CertificateName, Mistake> {
    value.parse().map_err(|fault| Mistake::CertificateName { key, value: value.to_owned(), fault })
}

/// Parses an origin of web pages.
pub(crate) fn page_origin(key: &'static str, value: &str) -> Result<PageOrigin, Mistake> {
    value.parse().map_err(|fault: PageOriginError| Mistake::PageOrigin {
        key,
        value: value.to_owned(),
        fault,
    })
}

/// Parses a size such as `64MiB` and checks its bounds.
pub(crate) fn size(key: &'static str, value: &str, (min, max): (u64, u64)) -> Result<u64, Mistake> {
    let bytes = parse_size(value).filter(|bytes| (min..=max).contains(bytes));
    bytes.ok_or_else(|| Mistake::Size { key, value: value.to_owned(), min, max })
}
