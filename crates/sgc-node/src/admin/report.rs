//! How a node is doing, in short: the document that it gives observers over the mesh, and that `sgc fleet status` shows.
//!
//! It comes from another machine, perhaps of another version: a reader takes a missing field for empty and ignores
//! unknown ones.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};
use sgc_wire::{REPORT_BYTES_MAX, RosterRow};

use crate::admin::graph::Graph;
use crate::control::faults::alerts::Alert;

/// Most links in a report.
pub const REPORT_LINKS_MAX: usize = 64;
/// Most searches for routers in a report.
pub const REPORT_ROUTERS_MAX: usize = 16;
/// Most shares and uses in a report.
pub const REPORT_TOPICS_MAX: usize = 512;
/// Most members of the fleet in a report.
pub const REPORT_MEMBERS_MAX: usize = 2048;
/// Most alerts, and most problems, in a report.
pub const REPORT_FAULTS_MAX: usize = 32;

/// How a node is doing.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct NodeReport {
    /// The node's name.
    pub node: String,
    /// The version of the program.
    pub version: String,
    /// Seconds since the node started.
    pub uptime_s: u64,
    /// The node's clock, milliseconds since 1970.
    pub clock_ms: u64,
    /// `true` if the node has a local ROS 2 network.
    pub has_ros: bool,
    /// `true` if the node forwards packets of others.
    pub is_router: bool,
    /// The end of the node's certificate, milliseconds since 1970.
    pub certificate_until_ms: u64,
    /// The newest generation of the fleet's secret that the node has; null if it has none.
    pub secret_generation: Option<u32>,
    /// Links that are up, at most 64.
    pub links: Vec<ReportLink>,
    /// The number of further links.
    pub links_omitted: usize,
    /// Routers that the node looks for, at most 16.
    pub routers: Vec<ReportRouter>,
    /// Shares and uses, at most 512.
    pub topics: Vec<ReportTopic>,
    /// The number of further shares and uses.
    pub topics_omitted: usize,
    /// Counts of drops and refusals since the node started, by reason.
    pub drops: BTreeMap<String, u64>,
    /// Counts of refused links since the node started, by reason.
    pub refused: BTreeMap<String, u64>,
    /// Alerts for an operator, at most 32.
    pub alerts: Vec<Alert>,
    /// Contradictions between local endpoints and the other side, at most 32.
    pub problems: Vec<String>,
    /// The members of the fleet, at most 2048; null unless the node is the fleet's authority.
    pub members: Option<Vec<ReportMember>>,
    /// The number of further members.
    pub members_omitted: usize,
}

/// A link of a reporting node.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportLink {
    /// The node id of the peer.
    pub peer: String,
    /// The name of the peer; null if the node does not know it.
    pub name: Option<String>,
    /// The smoothed round-trip time, microseconds.
    pub rtt_us: u64,
    /// `true` while the peer does not answer.
    pub silent: bool,
    /// `true` if the reporting node dialled.
    pub dialled: bool,
}

/// A search for a router of a reporting node.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportRouter {
    /// The router as configured.
    pub router: String,
    /// The state of the search: `"linked"`, or another word of [the status](status.md#routers).
    pub state: String,
    /// The last failure; null if there is none.
    pub last_failure: Option<String>,
}

/// A share or a use of a reporting node.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportTopic {
    /// `"share"` or `"use"`.
    pub direction: String,
    /// The name on the node's ROS 2 network.
    pub topic: String,
    /// The ROS type; null until it is known.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// The name of the owner's node.
    pub owner: String,
    /// The state, in words.
    pub state: String,
    /// The number of messages that were published or delivered.
    pub messages: u64,
}

/// A member of the fleet, as its authority knows it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportMember {
    /// The node's name.
    pub name: String,
    /// The node id.
    pub id: String,
    /// `true` if the node only routes.
    pub router: bool,
    /// The groups of the node.
    pub groups: Vec<String>,
    /// The end of its last certificate, milliseconds since 1970; null if all have ended.
    pub expires_ms: Option<u64>,
    /// The time of its revocation, milliseconds since 1970; null if it is not revoked.
    pub revoked_ms: Option<u64>,
    /// The newest generation of the fleet's secret that the node was given, 0 if that is unknown.
    pub generation: u32,
    /// The time at which the authority last heard of it, milliseconds since 1970; null if that is unknown.
    pub seen_ms: Option<u64>,
}

impl ReportMember {
    /// Returns the row of a roster as a report shows it.
    pub fn new(row: RosterRow) -> Self {
        Self {
            name: row.name,
            id: row.id.to_string(),
            router: row.router,
            groups: row.groups,
            expires_ms: row.expires.map(|at| at.0),
            revoked_ms: row.revoked.map(|at| at.0),
            generation: row.generation,
            seen_ms: row.seen.map(|at| at.0),
        }
    }
}

impl NodeReport {
    /// Adds the members of the fleet.
    pub(crate) fn set_members(&mut self, mut members: Vec<ReportMember>) {
        self.members_omitted = members.len().saturating_sub(REPORT_MEMBERS_MAX);
        members.truncate(REPORT_MEMBERS_MAX);
        self.members = Some(members);
    }

    /// Returns the document. Topics and members that make it too long are left out, and counted.
    pub(crate) fn to_json(mut self) -> String {
        loop {
            let json = serde_json::to_string(&self).unwrap_or_default();
            let members = self.members.as_mut().filter(|members| !members.is_empty());
            if json.len() <= REPORT_BYTES_MAX || (self.topics.is_empty() && members.is_none()) {
                return json;
            }
            self.topics_omitted += halve(&mut self.topics);
            self.members_omitted += members.map_or(0, halve);
        }
    }
}

/// Drops the second half of a list. Returns the number of dropped ones.
fn halve<T>(list: &mut Vec<T>) -> usize {
    let kept = list.len() / 2;
    list.drain(kept..).count()
}

/// Reduces a graph to one interface, for an observer who asks about it: other programs of the local network are not the
/// observer's business.
pub(crate) fn keep_interface(graph: &mut Graph, interface: &str) {
    graph.endpoints.retain(|endpoint| is_part(&endpoint.topic, interface));
    graph.calls.retain(|calls| is_part(&calls.topic, interface));
    graph.offers.retain(|offer| is_part(&offer.topic, interface));
    for share in &mut graph.shares {
        share.routes.retain(|route| is_part(&route.topic, interface));
    }
    for used in &mut graph.uses {
        used.routes.retain(|route| is_part(&route.topic, interface));
    }
    let of_shares = graph.shares.iter().flat_map(|share| &share.routes).map(|route| &route.name);
    let of_uses = graph.uses.iter().flat_map(|used| &used.routes).map(|route| &route.name);
    let of_tokens = graph.uses.iter().filter_map(|used| used.name.as_ref());
    let of_offers = graph.offers.iter().map(|offer| &offer.name);
    let kept: Vec<_> = of_shares.chain(of_uses).chain(of_tokens).chain(of_offers).cloned().collect();
    graph.names.retain(|name, _| kept.contains(name));
}

/// Returns `true` if a name of ROS 2 or DDS is that of the interface or of a part of it: the topics and services of an
/// action, the services of parameters, the two topics of a service.
fn is_part(name: &str, interface: &str) -> bool {
    // `rq/addRequest` and `rr/addReply` are the topics of the service `/add`.
    let of_service = |prefix: &str, suffix: &str| name.strip_prefix(prefix)?.strip_suffix(suffix);
    let name = of_service("rq", "Request").or_else(|| of_service("rr", "Reply")).unwrap_or(name);
    name.strip_prefix(interface).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::admin::graph::{Endpoint, Offer, Share, ShareRoute};

    #[test]
    fn long_report_leaves_topics_out_and_says_how_many() {
        let topic = ReportTopic { topic: "/t".repeat(5000), ..ReportTopic::default() };
        let report = NodeReport { topics: vec![topic; 300], topics_omitted: 2, ..NodeReport::default() };
        let json = report.to_json();
        assert!(json.len() <= REPORT_BYTES_MAX, "{}", json.len());
        let read: NodeReport = serde_json::from_str(&json).expect("as written");
        assert_eq!((read.topics.len(), read.topics_omitted), (75, 227));
    }

    #[test]
    fn report_of_another_version_is_read() {
        let text = r#"{"node": "arm", "later": [1], "alerts": [{"kind": "of_a_later_version", "n": 1}]}"#;
        let read: NodeReport = serde_json::from_str(text).expect("unknown fields are skipped");
        assert_eq!(
            (read.node.as_str(), &read.alerts[..], read.topics.len()),
            ("arm", &[Alert::Other][..], 0)
        );
    }

    #[test]
    fn observer_sees_the_endpoints_of_the_interface_that_it_asks_about() {
        for (name, interface, is_it) in [
            ("/camera", "/camera", true),
            ("/camera/info", "/camera", true),
            ("/camera2", "/camera", false),
            ("/cam", "/camera", false),
            ("rq/addRequest", "/add", true),
            ("rr/addReply", "/add", true),
            ("rq/fib/_action/send_goalRequest", "/fib", true),
            ("rq/adderRequest", "/add", false),
        ] {
            assert_eq!(is_part(name, interface), is_it, "{name} {interface}");
        }
        let endpoint = |topic: &str| Endpoint { topic: topic.into(), ..Endpoint::default() };
        let route = |topic: &str, name: &str| ShareRoute {
            topic: topic.into(),
            name: name.into(),
            ..ShareRoute::default()
        };
        let rule = Share { routes: vec![route("/a", "1"), route("/b", "2")], ..Share::default() };
        let mut graph = Graph {
            endpoints: vec![endpoint("/a"), endpoint("/b")],
            shares: vec![rule],
            offers: vec![Offer { topic: "/b".into(), name: "3".into(), ..Offer::default() }],
            names: ["1", "2", "3"].map(|name| (name.to_owned(), Default::default())).into(),
            ..Graph::default()
        };
        keep_interface(&mut graph, "/a");
        let endpoints: Vec<_> = graph.endpoints.iter().map(|e| e.topic.as_str()).collect();
        let routes: Vec<_> = graph.shares[0].routes.iter().map(|r| r.topic.as_str()).collect();
        assert_eq!((&endpoints[..], &routes[..], graph.offers.len()), (&["/a"][..], &["/a"][..], 0));
        assert_eq!(graph.names.keys().collect::<Vec<_>>(), ["1"]);
    }
}
