//! How a node is doing, as its status socket tells it: one JSON document a connection.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering::Relaxed;

use serde::Serialize;
use sgc_gateway::GatewayStatus;
use sgc_ros::RouteStatus;
use sgc_wire::Name;

use crate::alerts::Alert;
use crate::discovery::RouterStatus;
use crate::stats::NameStats;

/// Everything.
#[derive(Clone, Debug, Serialize)]
pub struct Status {
    /// The node's name.
    pub node: String,
    /// Version of the program.
    pub version: String,
    /// Seconds since it started.
    pub uptime_s: u64,
    /// Links that are up.
    pub links: Vec<LinkStatus>,
    /// Routers that are looked for, how, and how that goes.
    pub routers: Vec<RouterStatus>,
    /// Shares and uses, and where each stands.
    pub routes: Vec<RouteLine>,
    /// Alerts for an operator.
    pub alerts: Vec<Alert>,
    /// What is wrong between local endpoints and the other side, with both values and the fix; gone when it is.
    pub problems: Vec<String>,
    /// Names that carry data through this node.
    pub names: Vec<NameStatus>,
    /// What was dropped or refused, by kind.
    pub drops: BTreeMap<String, u64>,
    /// Peers refused at the door, by kind.
    pub refused: BTreeMap<String, u64>,
    /// Times that the local network was opened again since this host's addresses changed.
    pub local_network_reopened: u64,
    /// How much the router knows.
    pub router: RouterLine,
    /// Programs without ROS, if they may connect.
    pub gateway: Option<GatewayStatus>,
}

/// A link.
#[derive(Clone, Debug, Serialize)]
pub struct LinkStatus {
    /// Its number.
    pub id: u32,
    /// Node id of the peer.
    pub peer: String,
    /// Until when the certificate that it showed holds, RFC 3339.
    pub peer_until: String,
    /// Its address.
    pub remote: String,
    /// The URL dialled, if this node dialled.
    pub url: Option<String>,
    /// How its keys were agreed on, as TLS names it.
    pub kex: &'static str,
    /// Smoothed round-trip time, microseconds.
    pub rtt_us: u64,
    /// What the link costs where ways are weighed, microseconds of round trip.
    pub cost: u32,
    /// True while nothing comes over it although something should.
    pub silent: bool,
    /// After how long without anything from the peer it is asked whether it is there, milliseconds.
    pub keep_alive_ms: u64,
    /// Bytes sent.
    pub sent_bytes: u64,
    /// Bytes received.
    pub received_bytes: u64,
    /// Connections beside it that carry one name each.
    pub lanes: usize,
    /// Names that this node sends packets of under labels.
    pub labels_sent: u32,
    /// Names that the peer may send packets of under labels.
    pub labels_received: u32,
    /// Packets of the peer, over whichever link, that waited since it sends more than `peer_rate`.
    pub peer_slowed: u64,
    /// Those that were dropped for it.
    pub peer_dropped: u64,
}

/// A share or a use.
#[derive(Clone, Debug, Serialize)]
pub struct RouteLine {
    /// `"share"` or `"use"`.
    pub direction: &'static str,
    /// ROS topic.
    pub topic: String,
    /// ROS type, once known.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// Name, once known.
    pub name: Option<String>,
    /// Owner's node name.
    pub owner: String,
    /// What it is doing, or waiting for.
    pub state: String,
    /// Messages published or delivered.
    pub messages: u64,
    /// Signatures made for what its present publishers published; less than messages under load, since one covers a
    /// batch. 0 in the `group` suites.
    pub signatures: u64,
    /// Of a topic that is compressed here: bytes of payload before, and after.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub compressed: Option<(u64, u64)>,
}

impl RouteLine {
    pub(crate) fn new(
        route: RouteStatus,
        messages: Option<u64>,
        signatures: u64,
        compressed: Option<(u64, u64)>,
    ) -> Self {
        Self {
            compressed,
            direction: route.direction,
            topic: route.topic,
            type_name: route.type_name,
            name: route.name.map(|n| n.to_string()),
            owner: route.owner,
            state: route.state,
            messages: messages.unwrap_or(0),
            signatures,
        }
    }
}

/// Traffic of a name.
#[derive(Clone, Debug, Serialize)]
pub struct NameStatus {
    /// The name.
    pub name: String,
    /// Packets taken in.
    pub packets: u64,
    /// Bytes of their payloads.
    pub bytes: u64,
    /// Packets dropped.
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

/// How much the router knows.
#[derive(Clone, Debug, Serialize)]
pub struct RouterLine {
    /// Nodes that described their links.
    pub nodes: usize,
    /// Names in any state.
    pub names: usize,
    /// Names with a route.
    pub routed_names: usize,
    /// Branches.
    pub branches: usize,
}
