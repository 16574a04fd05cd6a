//! The status of a node, and its tables as `sgc status` prints them.
//!
//! `sgc-node` makes the document. This file reads the fields that it needs and ignores unknown ones, so it understands
//! older and newer nodes.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::path::Path;

use serde::{Deserialize, Serialize};
use sgc_node::admin::AdminRequest;
use sgc_node::alerts::Alert;
use sgc_process::output;
use sgc_process::style::{self, Line, Tone, Toned};

use crate::ask::{ANSWER_MAX, ask};
use crate::error::DiagnosisError;
use crate::refusals;

/// A node's status.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Status {
    pub(crate) node: String,
    version: String,
    uptime_s: u64,
    /// Links to other nodes.
    pub links: Vec<Link>,
    /// Routers that the node dials or searches.
    pub routers: Vec<Router>,
    not_direct: Vec<NotDirect>,
    #[serde(default)]
    clocks: Vec<Clock>,
    pub(crate) port_mapping: PortMapping,
    /// Address of the host from which packets to the IPv6 internet leave.
    pub(crate) ipv6: Option<IpAddr>,
    /// Shares and uses.
    pub routes: Vec<Route>,
    /// States that need an operator.
    pub alerts: Vec<Alert>,
    problems: Vec<String>,
    names: Vec<NameTraffic>,
    /// Counts of dropped frames, packets and messages.
    pub drops: BTreeMap<String, u64>,
    /// Counts of refused links.
    pub refused: BTreeMap<String, u64>,
    local_network_reopened: u64,
    router: RouterSize,
    #[serde(default)]
    store: Option<Store>,
    gateway: Option<Gateway>,
    metrics: Option<String>,
    otlp: Option<Pushes>,
}

/// A peer with which a node exchanges data over routers.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct NotDirect {
    name: String,
    why: String,
    /// The remedy; empty if there is none to name.
    fix: String,
}

/// The clock of a node that messages come from.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Clock {
    name: String,
    ahead_us: i64,
    error_us: i64,
    measured_s: u64,
    steps: u32,
}

/// The port that a node's gateway maps for direct links. The state of an older node is empty.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[serde(default)]
pub(crate) struct PortMapping {
    pub(crate) state: String,
    pub(crate) why_off: Option<String>,
    pub(crate) gateway: Option<IpAddr>,
    pub(crate) protocol: Option<String>,
    pub(crate) external: Option<SocketAddr>,
    /// The external address is a private one.
    pub(crate) behind_nat: bool,
    pub(crate) lifetime_s: Option<u64>,
    /// Reasons by protocol.
    pub(crate) failures: BTreeMap<String, String>,
}

/// Pushes of metrics of a node. Its alerts have the present fault.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Pushes {
    to: String,
    accepted: u64,
    failed: BTreeMap<String, u64>,
    accepted_ago_s: Option<u64>,
}

/// A node's answer that reports an error.
#[derive(Debug, Deserialize)]
struct ErrorAnswer {
    error: String,
}

/// The gateway of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct Gateway {
    listen: Vec<String>,
    clients: Vec<GatewayClient>,
    refused: BTreeMap<String, u64>,
    readers: usize,
    certificate: Option<GatewayCertificate>,
}

/// The certificate that a gateway shows.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct GatewayCertificate {
    pin: String,
    names: Vec<String>,
    /// Its end, in milliseconds since the Unix epoch.
    until: u64,
}

/// A client of a gateway.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct GatewayClient {
    name: String,
    protocol: String,
    address: String,
    /// Time of the connection, in milliseconds since the Unix epoch.
    since: u64,
}

/// A link of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Link {
    /// Node id of the peer.
    pub peer: String,
    name: Option<String>,
    /// Address of the peer.
    pub remote: String,
    pub(crate) url: Option<String>,
    /// Address of the host from which packets to the peer leave.
    pub(crate) local: Option<IpAddr>,
    /// Address from which the node comes, as the peer sees it.
    pub(crate) observed: Option<SocketAddr>,
    /// The link was found without configuration.
    pub direct: bool,
    /// Round trip, in microseconds.
    pub rtt_us: u64,
    cost: u32,
    /// Nothing comes over the link although something should.
    pub silent: bool,
    sent_bytes: u64,
    received_bytes: u64,
    peer_slowed: u64,
    peer_dropped: u64,
}

/// A router that a node dials or searches.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Router {
    /// The router as configured.
    pub router: String,
    found_by: String,
    at: Option<String>,
    pub(crate) state: String,
    why_not_first: Option<String>,
    /// Failures since the last success.
    pub failures: u32,
    /// The last failure.
    pub last_failure: Option<String>,
    again_in_s: Option<u64>,
}

/// A share or use of a node.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct Route {
    /// `share` or `use`.
    pub direction: String,
    /// Name of the topic on the local network.
    pub topic: String,
    #[serde(rename = "type")]
    type_name: Option<String>,
    /// The 256-bit name.
    pub name: Option<String>,
    owner: String,
    /// The state in words.
    pub state: String,
    messages: u64,
    /// Bytes before and after compression.
    compressed: Option<(u64, u64)>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct NameTraffic {
    name: String,
    packets: u64,
    bytes: u64,
    dropped: u64,
}

#[derive(Debug, Default, Deserialize)]
#[serde(default)]
struct RouterSize {
    nodes: usize,
    names: u64,
    routed_names: u64,
    branches: u64,
}

/// The store of names of a router.
#[derive(Clone, Debug, Deserialize)]
struct Store {
    down_s: Option<u64>,
    found: u64,
    absent: u64,
    operations: u64,
    failures: u64,
}

impl Store {
    fn line(&self) -> Toned {
        let Self { down_s, found, absent, operations, failures } = self;
        let (tone, state) = match down_s {
            None => (Tone::Plain, "answers".to_owned()),
            Some(seconds) => (Tone::Attention, format!("has not answered for {seconds} s")),
        };
        let operations = output::several(*operations, "operation");
        Toned::new(
            tone,
            format!("Store: {state}; {found} names found, {absent} absent; {operations}, {failures} failed"),
        )
    }
}

impl Clock {
    fn row(&self) -> Vec<Toned> {
        let ahead = output::signed_millis(self.ahead_us, Some(self.error_us));
        let asked = format!("{} ago", duration(self.measured_s));
        let set = if self.steps > 0 { output::several(u64::from(self.steps), "time") } else { String::new() };
        [self.name.clone(), ahead, asked, set].map(Toned::from).into()
    }
}

/// Asks the node at a socket for its status, for programs that show it in another way.
pub fn query(socket: &Path) -> Result<Status, DiagnosisError> {
    parse(socket, &ask(socket, &AdminRequest::Status, ANSWER_MAX)?)
}

/// Parses the document that a node made.
pub fn parse(socket: &Path, text: &str) -> Result<Status, DiagnosisError> {
    if let Ok(ErrorAnswer { error }) = serde_json::from_str(text) {
        return Err(DiagnosisError::NotSeen { reason: error });
    }
    serde_json::from_str(text)
        .map_err(|e| DiagnosisError::NotAStatus { path: socket.to_owned(), reason: e.to_string() })
}

impl Status {
    /// Returns the lines of `sgc status`.
    pub fn lines(&self) -> Vec<Line> {
        let head = format!("{}: sgc {}, up for {}", self.node, self.version, duration(self.uptime_s));
        let mut lines = vec![Line::from(head)];
        let mut section = |title: &str, head: &[&str], rows: Vec<Vec<Toned>>| {
            lines.push(Line::default());
            if rows.is_empty() {
                lines.push(format!("{title}: none").into());
                return;
            }
            lines.push(format!("{title}:").into());
            let head = head.iter().map(|h| Toned::from(*h)).collect();
            let table: Vec<_> = std::iter::once(head).chain(rows).collect();
            lines.extend(style::columns(&table).into_iter().map(|line| line.indented("  ")));
        };
        if !self.alerts.is_empty() {
            let rows = self.alerts.iter().map(|alert| {
                let tone = if alert.stops_all() { Tone::Bad } else { Tone::Attention };
                vec![Toned::new(tone, alert.to_string()), alert.fix().into()]
            });
            section("Needs attention", &["what", "do"], rows.collect());
        }
        section(
            "Links",
            &["peer", "remote", "round trip", "cost", "sent", "received", "dialled"],
            self.links.iter().map(Link::row).collect(),
        );
        if !self.not_direct.is_empty() {
            let rows = self.not_direct.iter().map(|NotDirect { name, why, fix }| {
                vec![name.as_str().into(), why.as_str().into(), fix.as_str().into()]
            });
            section("Over routers", &["peer", "why not direct", "do"], rows.collect());
        }
        if !self.clocks.is_empty() {
            let rows = self.clocks.iter().map(Clock::row);
            section("Clocks", &["peer", "ahead by", "asked", "was set"], rows.collect());
        }
        let over: Vec<_> = self.links.iter().filter(|l| l.peer_slowed + l.peer_dropped > 0).collect();
        if !over.is_empty() {
            section(
                "Peers that send more than `peer_rate`",
                &["peer", "packets slowed", "dropped"],
                over.iter().map(|l| l.over_row()).collect(),
            );
        }
        section(
            "Routers",
            &["router", "found by", "at", "state", "last failure"],
            self.routers.iter().map(|router| router.row(&self.links)).collect(),
        );
        let second: Vec<_> = self.routers.iter().filter_map(Router::second_row).collect();
        if !second.is_empty() {
            section("Not by the first way", &["router", "at", "why"], second);
        }
        section(
            "Topics",
            &["", "topic", "type", "owner", "messages", "state"],
            self.routes.iter().map(Route::row).collect(),
        );
        if !self.problems.is_empty() {
            let rows = self.problems.iter().map(|problem| vec![Toned::new(Tone::Attention, problem)]);
            section("What is wrong", &["problem"], rows.collect());
        }
        section(
            "Names",
            &["name", "packets", "bytes", "dropped"],
            self.names.iter().map(NameTraffic::row).collect(),
        );
        let counts = |counts: &BTreeMap<String, u64>, meaning: fn(&str) -> String| {
            counts
                .iter()
                .map(|(key, n)| vec![key.into(), n.to_string().into(), meaning(key).into()])
                .collect()
        };
        let head = ["reason", "count", "meaning"];
        section("Drops", &head, counts(&self.drops, refusals::drop_meaning));
        section("Refused peers", &head, counts(&self.refused, refusals::door_meaning));
        if let Some(gateway) = &self.gateway {
            section(
                "Programs without ROS",
                &["client", "protocol", "address", "since"],
                gateway.clients.iter().map(GatewayClient::row).collect(),
            );
            if !gateway.refused.is_empty() {
                section("Refused there", &head, counts(&gateway.refused, refusals::gateway_meaning));
            }
            lines.push(format!("  at {}; {} topics read", gateway.listen.join(", "), gateway.readers).into());
            if let Some(GatewayCertificate { pin, names, until }) = &gateway.certificate {
                let until = sgc_wire::UnixMillis(*until);
                lines.push(format!("  certificate {pin} for {}, until {until}", names.join(", ")).into());
            }
        }
        let RouterSize { nodes, names, routed_names, branches } = self.router;
        lines.push(Line::default());
        if self.local_network_reopened > 0 {
            let times = self.local_network_reopened;
            lines.push(
                format!("Local network: opened again after this host's addresses changed, so often: {times}")
                    .into(),
            );
        }
        lines.extend(self.metrics.iter().map(|url| format!("Metrics: {url}").into()));
        lines.extend(self.otlp.iter().map(|pushes| pushes.line().into()));
        let (nodes, names) = (output::several(nodes as u64, "node"), output::several(names, "name"));
        let known =
            format!("Router: {nodes} and {names} known, {routed_names} with a route; branches: {branches}");
        lines.push(known.into());
        lines.extend(self.store.as_ref().map(|store| Line::new([store.line()])));
        lines
    }
}

impl Pushes {
    fn line(&self) -> String {
        let Self { to, accepted, failed, accepted_ago_s } = self;
        let last = accepted_ago_s.map(|ago_s| format!(", the last {ago_s} s ago")).unwrap_or_default();
        let failed: u64 = failed.values().sum();
        format!("Metrics pushed to {to}: {accepted} taken{last}; {failed} failed")
    }
}

impl GatewayClient {
    fn row(&self) -> Vec<Toned> {
        let since = sgc_wire::UnixMillis(self.since).to_string();
        vec![
            self.name.as_str().into(),
            self.protocol.as_str().into(),
            self.address.as_str().into(),
            since.into(),
        ]
    }
}

impl Link {
    fn row(&self) -> Vec<Toned> {
        // The cost that silence adds serves routing and means nothing to a reader.
        let cost = match self.silent {
            true => Toned::new(Tone::Bad, "silent"),
            false => output::millis(self.cost.into()).into(),
        };
        vec![
            self.short_peer(),
            self.remote.as_str().into(),
            output::millis(self.rtt_us).into(),
            cost,
            output::bytes(self.sent_bytes).into(),
            output::bytes(self.received_bytes).into(),
            match (self.direct, self.url.as_deref()) {
                (true, _) => Toned::new(Tone::Good, "direct"),
                (false, url) => url.unwrap_or_default().into(),
            },
        ]
    }

    fn over_row(&self) -> Vec<Toned> {
        vec![self.short_peer(), self.peer_slowed.to_string().into(), self.peer_dropped.to_string().into()]
    }

    /// Returns the peer's name, or the beginning of its id.
    fn short_peer(&self) -> Toned {
        self.name.clone().unwrap_or_else(|| self.peer.chars().take(8).collect()).into()
    }
}

impl Router {
    /// Returns the link to the router, if it is up.
    pub(crate) fn link<'a>(&self, links: &'a [Link]) -> Option<&'a Link> {
        links.iter().find(|link| link.url.is_some() && link.url == self.at)
    }

    fn row(&self, links: &[Link]) -> Vec<Toned> {
        let state = match (self.again_in_s, self.link(links)) {
            (Some(s), _) => Toned::new(Tone::Bad, format!("{} in {}", self.state, duration(s))),
            (None, Some(link)) if link.silent => Toned::new(Tone::Bad, format!("{}, silent", self.state)),
            (None, Some(_)) => Toned::new(Tone::Good, &self.state),
            (None, None) if self.failures > 0 => Toned::new(Tone::Bad, &self.state),
            (None, None) => self.state.as_str().into(),
        };
        vec![
            self.router.as_str().into(),
            self.found_by.as_str().into(),
            self.at.as_deref().unwrap_or_default().into(),
            state,
            self.last_failure.as_deref().unwrap_or_default().into(),
        ]
    }
}

impl Router {
    fn second_row(&self) -> Option<Vec<Toned>> {
        let why = self.why_not_first.as_deref()?;
        let at = self.at.as_deref().unwrap_or_default();
        Some(vec![self.router.as_str().into(), at.into(), Toned::new(Tone::Attention, why)])
    }
}

impl Route {
    fn row(&self) -> Vec<Toned> {
        let state = match self.compressed {
            Some((before, after)) if before > 0 => {
                format!("{}, compressed to {:.0} %", self.state, 100.0 * after as f64 / before as f64)
            }
            _ => self.state.clone(),
        };
        vec![
            self.direction.as_str().into(),
            self.topic.as_str().into(),
            self.type_name.as_deref().unwrap_or("?").into(),
            self.owner.as_str().into(),
            self.messages.to_string().into(),
            state.into(),
        ]
    }
}

impl NameTraffic {
    fn row(&self) -> Vec<Toned> {
        let (packets, dropped) = (self.packets.to_string(), self.dropped.to_string());
        vec![self.name.as_str().into(), packets.into(), output::bytes(self.bytes).into(), dropped.into()]
    }
}

/// Formats a time in the two largest units.
pub(crate) fn duration(seconds: u64) -> String {
    match (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60, seconds % 60) {
        (0, 0, 0, s) => format!("{s} s"),
        (0, 0, m, s) => format!("{m} min {s} s"),
        (0, h, m, _) => format!("{h} h {m} min"),
        (d, h, _, _) => format!("{d} d {h} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plain(text: &str) -> Vec<String> {
        parse(Path::new("x"), text).unwrap().lines().iter().map(ToString::to_string).collect()
    }

    #[test]
    fn status_is_shown_in_tables() {
        let text = r#"{"node":"arm-1","version":"0.1.0","uptime_s":75,"new":{},
            "links":[{"id":1,"peer":"0123456789abcdef","remote":"127.0.0.1:7447","url":"quic://localhost:7447",
                      "rtt_us":420,"cost":1420,"sent_bytes":1500,"received_bytes":7}],
            "routers":[{"router":"srv://lab.example","found_by":"srv","at":"quic://r1.lab.example:7447",
                        "state":"trying again","failures":2,"last_failure":"no answer","again_in_s":3}],
            "routes":[{"direction":"share","topic":"/chatter","type":null,"name":null,"owner":"arm-1",
                       "state":"waiting for a publisher"}],
            "names":[],"drops":{"hop_limit":3},"refused":{},"router":{"nodes":3,"names":1,"routed_names":0,"branches":2}}"#;
        let lines = plain(text);
        let expected = [
            "arm-1: sgc 0.1.0, up for 1 min 15 s",
            "",
            "Links:",
            "  peer      remote          round trip  cost     sent    received  dialled",
            "  01234567  127.0.0.1:7447  0.42 ms     1.42 ms  1.5 kB  7 B       quic://localhost:7447",
            "",
            "Routers:",
            "  router             found by  at                          state                last failure",
            "  srv://lab.example  srv       quic://r1.lab.example:7447  trying again in 3 s  no answer",
            "",
            "Topics:",
            "         topic     type  owner  messages  state",
            "  share  /chatter  ?     arm-1  0         waiting for a publisher",
            "",
            "Names: none",
            "",
            "Drops:",
            "  reason     count  meaning",
            "  hop_limit  3      it went in a circle, or over too many routers",
            "",
            "Refused peers: none",
            "",
            "Router: 3 nodes and 1 name known, 0 with a route; branches: 2",
        ];
        assert_eq!(lines, expected);
    }

    #[test]
    fn router_over_a_silent_link_is_shown_as_silent() {
        let text = r#"{"node":"arm-1","version":"0.1.0","uptime_s":75,
            "links":[{"id":1,"peer":"0123456789abcdef","remote":"127.0.0.1:7447","url":"quic://localhost:7447",
                      "rtt_us":420,"cost":1420,"silent":true},
                     {"id":2,"peer":"1123456789abcdef","remote":"127.0.0.1:7448","url":"quic://localhost:7448",
                      "rtt_us":420,"cost":1420}],
            "routers":[{"router":"quic://localhost:7447","found_by":"static","at":"quic://localhost:7447","state":"linked"},
                       {"router":"quic://localhost:7448","found_by":"static","at":"quic://localhost:7448","state":"linked"}],
            "routes":[],"names":[],"drops":{},"refused":{},"router":{"nodes":3,"names":1,"routed_names":0,"branches":2}}"#;
        let lines = plain(text);
        let state = |router: &str| lines.iter().find(|line| line.starts_with(router)).unwrap().trim_end();
        assert!(state("  quic://localhost:7447").ends_with("linked, silent"));
        assert!(state("  quic://localhost:7448").ends_with("linked"));
    }
}
