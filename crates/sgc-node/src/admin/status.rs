//! How a node is doing, as its status socket tells it: one JSON document a connection.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Instant;

use serde::Serialize;
use sgc_gateway::GatewayStatus;
use sgc_ros::RouteStatus;
use sgc_router::StoreStats;
use sgc_wire::Name;

use super::not_direct::{NotDirectPeer, NotDirectReason};
use super::route_words::route_state;
use crate::control::faults::alerts::Alert;
use crate::data::stats::NameStats;
use crate::discovery::board::RouterStatus;
use crate::link::mapping_report::MappingReport;
use crate::metrics::push::PushStatus;

/// The status document.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The node's name.
    pub node: String,
    /// The version of the program.
    pub version: String,
    /// Seconds since the node started.
    pub uptime_s: u64,
    /// The links that are up.
    pub links: Vec<LinkStatus>,
    /// The routers that the node looks for, and the state of each search.
    pub routers: Vec<RouterStatus>,
    /// The peers with which data is exchanged over routers, at most 256.
    pub not_direct: Vec<NotDirect>,
    /// The clocks of the nodes that messages come from, at most 256.
    pub clocks: Vec<ClockLine>,
    /// The port that the gateway maps for direct links.
    pub port_mapping: PortMappingStatus,
    /// The address of this host from which packets to the IPv6 internet leave; null without a route there.
    pub ipv6: Option<String>,
    /// Shares and uses, and the state of each.
    pub routes: Vec<RouteLine>,
    /// Alerts for an operator.
    pub alerts: Vec<Alert>,
    /// Contradictions between local endpoints and the other side, with both values and the fix. An entry lasts as long
    /// as its contradiction.
    pub problems: Vec<String>,
    /// Names whose data passes this node.
    pub names: Vec<NameStatus>,
    /// Counts of drops and refusals, by reason, and by reason and culprit.
    pub drops: BTreeMap<String, u64>,
    /// Counts of refused links, by reason.
    pub refused: BTreeMap<String, u64>,
    /// The number of times that the node opened the local network again because this host's addresses changed.
    pub local_network_reopened: u64,
    /// The size of the routing state.
    pub router: RouterLine,
    /// The store of names of this router; null without one.
    pub store: Option<StoreLine>,
    /// The gateway for programs without ROS; null without `[gateway]`.
    pub gateway: Option<GatewayStatus>,
    /// The URL at which metrics are served; null if they are not.
    pub metrics: Option<String>,
    /// Pushes of metrics to an OpenTelemetry collector; null if there are none.
    pub otlp: Option<PushStatus>,
}

/// A peer without a direct link.
#[derive(Clone, Debug, Serialize)]
pub struct NotDirect {
    /// The node id of the peer.
    pub peer: String,
    /// The name of the peer, or the beginning of its node id if this node does not know the name.
    pub name: String,
    /// Why there is no direct link.
    pub reason: NotDirectReason,
    /// The same in words.
    pub why: String,
    /// The remedy; empty if there is none to name.
    pub fix: &'static str,
}

impl NotDirect {
    pub(crate) fn new(peer: NotDirectPeer) -> Self {
        let NotDirectPeer { peer, name, reason } = peer;
        Self { peer, name, reason, why: reason.to_string(), fix: reason.fix() }
    }
}

/// The clock of a node that messages come from.
#[derive(Clone, Debug, Serialize)]
pub struct ClockLine {
    /// The node id of the peer.
    pub peer: String,
    /// The name of the peer, or the beginning of its node id if this node does not know the name.
    pub name: String,
    /// The time by which its clock is ahead of this node's, microseconds; less than 0 if it is behind.
    pub ahead_us: i64,
    /// The greatest error of that, microseconds.
    pub error_us: i64,
    /// Seconds since it last told its time.
    pub measured_s: u64,
    /// The number of times that the clock was set since this node asks for it.
    pub steps: u32,
}

/// The port that the gateway maps for direct links.
#[derive(Clone, Debug, Serialize)]
pub struct PortMappingStatus {
    /// `"off"`, `"looking"`, `"mapped"` or `"failed"`.
    pub state: &'static str,
    /// Why the gateway is not asked, in words; null unless the state is `"off"`.
    pub why_off: Option<String>,
    /// The gateway that is asked.
    pub gateway: Option<String>,
    /// The protocol of the mapping: `"pcp"`, `"nat_pmp"` or `"upnp_igd"`; null unless the state is `"mapped"`.
    pub protocol: Option<&'static str>,
    /// The address and port to which peers send; null unless the state is `"mapped"`.
    pub external: Option<String>,
    /// `true` if that address is a private one, so another NAT stands behind the gateway.
    pub behind_nat: bool,
    /// Seconds until the mapping ends, unless it is renewed.
    pub lifetime_s: Option<u64>,
    /// The reasons for which the last attempt failed, by protocol: `"no_answer"`, `"unsupported"`, `"not_permitted"`,
    /// `"no_room"`, `"permanent_only"`, `"no_external_address"`, `"unstable"`, `"malformed"` or `"not_sent"`.
    pub failures: BTreeMap<&'static str, &'static str>,
}

impl PortMappingStatus {
    pub(crate) fn new(report: &MappingReport, now: Instant) -> Self {
        let mapping = report.mapping.map(|(mapping, _)| mapping);
        let state = match (&report.off, &mapping) {
            (Some(_), _) => "off",
            (None, Some(_)) => "mapped",
            (None, None) if report.is_looking => "looking",
            (None, None) => "failed",
        };
        Self {
            state,
            why_off: report.off.map(|why| why.to_string()),
            gateway: report.gateway.map(|gateway| gateway.to_string()),
            protocol: mapping.map(|mapping| mapping.protocol.key()),
            external: mapping.map(|mapping| mapping.external.to_string()),
            behind_nat: mapping.is_some_and(|mapping| is_private(*mapping.external.ip())),
            lifetime_s: report.mapping.map(|(_, end)| end.saturating_duration_since(now).as_secs()),
            failures: report.failures.iter().map(|(protocol, why)| (protocol.key(), why.key())).collect(),
        }
    }
}

/// Returns `true` for an address that only networks behind a NAT use (RFC 1918, RFC 6598).
fn is_private(ip: Ipv4Addr) -> bool {
    let [first, second, ..] = ip.octets();
    ip.is_private() || (first == 100 && second & 0xc0 == 64)
}

/// A link that is up.
#[derive(Clone, Debug, Serialize)]
pub struct LinkStatus {
    /// The number of the link, counted since the node started.
    pub id: u32,
    /// The node id of the peer.
    pub peer: String,
    /// The name of the peer; null if this node does not know it.
    pub name: Option<String>,
    /// The end of the certificate that the peer showed, RFC 3339.
    pub peer_until: String,
    /// The address of the peer.
    pub remote: String,
    /// The URL that this node dialled; null if the peer dialled.
    pub url: Option<String>,
    /// The address of this host from which its packets leave for the peer; null if the peer dialled, or there is no
    /// route.
    pub local: Option<String>,
    /// The address and port from which this node comes, as the peer sees it: another than `local` behind a NAT. Null if
    /// the peer dialled, or has not said it, as nodes of earlier versions do not.
    pub observed: Option<String>,
    /// `true` for a direct link to a node with which this one exchanges data, found without configuration.
    pub direct: bool,
    /// The key exchange, as TLS names it.
    pub kex: &'static str,
    /// The smoothed round-trip time, microseconds.
    pub rtt_us: u64,
    /// The cost of the link in routing, microseconds of round trip.
    pub cost: u32,
    /// `true` while the peer does not answer.
    pub silent: bool,
    /// The time without a sign of life after which the node asks the peer for one, milliseconds.
    pub keep_alive_ms: u64,
    /// Bytes sent over the link and its lanes.
    pub sent_bytes: u64,
    /// Bytes received over the link and its lanes.
    pub received_bytes: u64,
    /// The number of connections beside the link that carry one name each.
    pub lanes: usize,
    /// The number of these that are bulk lanes: TLS for a large topic.
    pub bulk_lanes: usize,
    /// The number of names for which this node sends labels.
    pub labels_sent: u32,
    /// The number of names for which the peer may send labels.
    pub labels_received: u32,
    /// Packets of the peer, over all its links, that waited because it exceeded `peer_rate`.
    pub peer_slowed: u64,
    /// Packets of the peer, over all its links, that were dropped because it exceeded `peer_rate`.
    pub peer_dropped: u64,
}

/// A share or a use.
#[derive(Clone, Debug, Serialize)]
pub struct RouteLine {
    /// `"share"` or `"use"`.
    pub direction: &'static str,
    /// The name on the local ROS 2 network.
    pub topic: String,
    /// The ROS type; null until it is known.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// The 256-bit name; null until it is known.
    pub name: Option<String>,
    /// The name of the owner's node.
    pub owner: String,
    /// The state, in words.
    pub state: String,
    /// The number of messages that were published or delivered.
    pub messages: u64,
    /// The number of signatures for messages of the present publishers. Under load it is smaller than `messages`,
    /// because one signature covers a batch. 0 in the `group` suites.
    pub signatures: u64,
    /// The time from the publication of the last message to its arrival, microseconds, of a topic that comes here.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_us: Option<i64>,
    /// The greatest error of that, microseconds; missing while the owner's clock is not known, so that the clocks of both
    /// hosts count as equal.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub age_error_us: Option<i64>,
    /// Bytes of payload before and after compression, of a topic that this node compresses.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compressed: Option<(u64, u64)>,
}

impl RouteLine {
    pub(crate) fn new(
        route: RouteStatus,
        calls: Option<String>,
        messages: Option<u64>,
        signatures: u64,
        compressed: Option<(u64, u64)>,
    ) -> Self {
        Self {
            compressed,
            age_us: None,
            age_error_us: None,
            state: route_state(&route) + &calls.unwrap_or_default(),
            direction: route.kind.key(),
            topic: route.topic,
            type_name: route.type_name,
            name: route.name.map(|n| n.to_string()),
            owner: route.owner,
            messages: messages.unwrap_or(0),
            signatures,
        }
    }
}

/// The traffic of a name at this node.
#[derive(Clone, Debug, Serialize)]
pub struct NameStatus {
    /// The 256-bit name.
    pub name: String,
    /// Packets that the node took in.
    pub packets: u64,
    /// Bytes of the payloads of these packets.
    pub bytes: u64,
    /// Packets that the node dropped.
    pub dropped: u64,
}

impl NameStatus {
    pub(crate) fn new(name: &Name, stats: &NameStats) -> Self {
        Self {
            name: name.to_string(),
            packets: stats.packets.load(Relaxed),
            bytes: stats.bytes.load(Relaxed),
            dropped: stats.dropped.load(Relaxed),
        }
    }
}

/// The size of the routing state.
#[derive(Clone, Debug, Serialize)]
pub struct RouterLine {
    /// Nodes whose link states are known.
    pub nodes: usize,
    /// All known names.
    pub names: usize,
    /// Names to whose owner a route leads.
    pub routed_names: usize,
    /// Branches of trees.
    pub branches: usize,
}

/// The store of names of a router.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct StoreLine {
    /// `true` while the store answers.
    pub answers: bool,
    /// Seconds since it does not; null while it does.
    pub down_s: Option<u64>,
    /// Look-ups that found a name.
    pub found: u64,
    /// Look-ups of names that the store does not have.
    pub absent: u64,
    /// Operations so far.
    pub operations: u64,
    /// Operations that failed.
    pub failures: u64,
    /// Operations, and steps of work, that are under way or wait.
    pub pending: usize,
    /// Values from the store that were not what their key says.
    pub refused: u64,
    /// Names that the store had lost, and that this router wrote again.
    pub healed: u64,
    /// Names without an owner's announcement that this router removed.
    pub orphans: u64,
    /// Values that this router keeps.
    pub cached: usize,
    /// Memory that they take, bytes.
    pub cached_bytes: usize,
}

impl StoreLine {
    pub(crate) fn new(now: Instant, stats: StoreStats) -> Self {
        let down = stats.down_since.map(|since| now.saturating_duration_since(since).as_secs());
        Self {
            answers: down.is_none(),
            down_s: down,
            found: stats.found,
            absent: stats.absent,
            operations: stats.operations,
            failures: stats.failures,
            pending: stats.pending,
            refused: stats.refused,
            healed: stats.healed,
            orphans: stats.orphans,
            cached: stats.cached,
            cached_bytes: stats.cached_bytes,
        }
    }
}
