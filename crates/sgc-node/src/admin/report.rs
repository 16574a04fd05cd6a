//! How a node is doing, in short: the document that it gives observers over the mesh, and that `sgc fleet status`
//! shows.
//!
//! It comes from another machine, perhaps of another version: a reader takes a missing field for empty and ignores
//! unknown ones.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::marker::PhantomData;

use serde::de::{IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use sgc_ros::Interface;
use sgc_wire::{Kind, REPORT_BYTES_MAX, RosterRow};

use crate::admin::graph::Graph;
use crate::admin::not_direct::NotDirectPeer;
use crate::control::faults::alerts::Alert;
use crate::state::audit::{AuditRecord, RECENT_OF_FLEET_MAX};

/// Most links in a report.
pub const REPORT_LINKS_MAX: usize = 64;
/// Most peers without a direct link in a report.
pub const REPORT_NOT_DIRECT_MAX: usize = 64;
/// Most searches for routers in a report.
pub const REPORT_ROUTERS_MAX: usize = 16;
/// Most shares and uses in a report.
pub const REPORT_TOPICS_MAX: usize = 512;
/// Most members of the fleet in a report.
pub const REPORT_MEMBERS_MAX: usize = 2048;
/// Most rules of shares in a report.
pub const REPORT_RULES_MAX: usize = 512;
/// Most recipients, exceptions and tokens of a rule in a report, and most observers and operators.
pub const REPORT_RECIPIENTS_MAX: usize = 64;
/// Most audit events of an authority in a report.
pub const REPORT_EVENTS_MAX: usize = RECENT_OF_FLEET_MAX;
/// Most alerts, and most problems, in a report.
pub const REPORT_FAULTS_MAX: usize = 32;
/// Most reasons of drops, and of refused links, that are read.
const REPORT_REASONS_MAX: usize = 512;
/// Longest name of such a reason that is read, bytes.
const REPORT_REASON_BYTES_MAX: usize = 64;
/// Longest alert that is read, bytes of JSON. The mistakes of a configuration have at most 1000 characters.
const REPORT_ALERT_BYTES_MAX: usize = 8192;
/// Most characters of a text that is read. Names of topics have at most 255, and problems some hundred.
const REPORT_TEXT_CHARS_MAX: usize = 1024;

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
    /// The validity of the node's certificate from its beginning on, milliseconds. It is renewed when a third is left.
    pub certificate_lasts_ms: u64,
    /// The newest generation of the fleet's secret that the node has; null if it has none.
    pub secret_generation: Option<u32>,
    /// Links that are up, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_LINKS_MAX, _, _>")]
    pub links: Vec<ReportLink>,
    /// The number of further links.
    pub links_omitted: usize,
    /// Peers with which the node exchanges data over routers, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_NOT_DIRECT_MAX, _, _>")]
    pub not_direct: Vec<NotDirectPeer>,
    /// The number of further ones.
    pub not_direct_omitted: usize,
    /// Routers that the node looks for, at most 16.
    #[serde(deserialize_with = "at_most::<REPORT_ROUTERS_MAX, _, _>")]
    pub routers: Vec<ReportRouter>,
    /// Shares and uses, at most 512.
    #[serde(deserialize_with = "at_most::<REPORT_TOPICS_MAX, _, _>")]
    pub topics: Vec<ReportTopic>,
    /// The number of further shares and uses.
    pub topics_omitted: usize,
    /// The rights that the node's configuration gives; null if it is of a version that does not tell them.
    pub rights: Option<ReportRights>,
    /// Counts of drops and refusals since the node started, by reason.
    #[serde(deserialize_with = "counts")]
    pub drops: BTreeMap<String, u64>,
    /// Counts of refused links since the node started, by reason.
    #[serde(deserialize_with = "counts")]
    pub refused: BTreeMap<String, u64>,
    /// Alerts for an operator, at most 32.
    #[serde(deserialize_with = "alerts")]
    pub alerts: Vec<Alert>,
    /// Contradictions between local endpoints and the other side, at most 32.
    #[serde(deserialize_with = "at_most::<REPORT_FAULTS_MAX, _, _>")]
    pub problems: Vec<String>,
    /// The members of the fleet, at most 2048; null unless the node is the fleet's authority.
    #[serde(deserialize_with = "at_most_if_any::<REPORT_MEMBERS_MAX, _, _>")]
    pub members: Option<Vec<ReportMember>>,
    /// The number of further members.
    pub members_omitted: usize,
    /// The last events of the audit log about the keeping of the fleet, oldest first, at most 64; null unless the node is
    /// the fleet's authority and keeps a log.
    #[serde(deserialize_with = "at_most_if_any::<REPORT_EVENTS_MAX, _, _>")]
    pub events: Option<Vec<ReportEvent>>,
}

/// An event of a node's audit log.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportEvent {
    /// The time by the node's clock, milliseconds since 1970.
    pub time_ms: u64,
    /// The event, as `sgc audit` names it.
    pub event: String,
    /// The topic, or the beginning of its name on the wire; null if it is about none.
    pub topic: Option<String>,
    /// The peer's name, or the beginning of its node id; null if there is none.
    pub peer: Option<String>,
    /// Everything else, in words.
    pub detail: String,
}

impl ReportEvent {
    /// Returns a record of the audit log as a report shows it.
    pub fn new(record: &AuditRecord) -> Self {
        Self {
            time_ms: record.unix_ms,
            event: record.event.clone(),
            topic: record.subject(),
            peer: record.peer_word(),
            detail: record.detail(),
        }
    }
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
    /// `true` for a direct link, found without configuration.
    pub direct: bool,
    /// The number of packets of the transport that were sent.
    pub sent_packets: u64,
    /// The number of these that were lost. Except for datagrams, their content was sent again.
    pub lost_packets: u64,
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
    /// `"share"` or `"use"`; `"serve"` and `"call"` for services, `"publish"` for a use that publishes.
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
    /// `true` if the owner is out of reach, does not share it with the node now, or refuses it.
    pub stuck: bool,
    /// `true` if it is shared, and waits for a local publisher or server.
    pub waiting: bool,
    /// The number of messages that were published or delivered.
    pub messages: u64,
    /// The time from the publication of the last message until it arrived here, microseconds; null if the topic is the
    /// node's own, or nothing came.
    pub age_us: Option<i64>,
    /// The greatest error of that, microseconds; null while the owner's clock is not known, so that the clocks of both
    /// hosts count as equal.
    pub age_error_us: Option<i64>,
    /// The node id of the next node on the path to the owner; null if the topic is the node's own, or there is no path.
    pub via: Option<String>,
    /// `true` if that is the owner itself.
    pub direct: bool,
    /// The round-trip time of that path, microseconds, as routing adds it up; null without one.
    pub path_us: Option<u64>,
    /// Counts of its packets and messages that the node dropped, by reason.
    pub drops: BTreeMap<String, u64>,
}

/// The rights that a node's configuration gives. A recipient is a node (`"desk"`), a group (`"group:operators"`), every
/// member of the fleet (`"*"`) or a partner (`"partner:acme"`).
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportRights {
    /// The rules of shares, at most 512.
    #[serde(deserialize_with = "at_most::<REPORT_RULES_MAX, _, _>")]
    pub rules: Vec<ReportRule>,
    /// The number of further rules.
    pub rules_omitted: usize,
    /// The recipients that may ask the node how it is doing, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub observers: Vec<String>,
    /// The recipients that may change the fleet at its authority, at most 64; empty at other nodes.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub operators: Vec<String>,
}

/// A rule of a share, and the recipients that it permits.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportRule {
    /// `"topic"`, `"service"`, `"action"` or `"parameters"`.
    pub kind: String,
    /// The name on the node's ROS 2 network, or a pattern.
    pub interface: String,
    /// Names and patterns that the rule does not cover, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub except: Vec<String>,
    /// The only ROS type that is shared; null if the rule names none.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// The recipients that may subscribe or, unless it is a topic, call; at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub to: Vec<String>,
    /// The recipients that may publish besides the node, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub publish: Vec<String>,
    /// The numbers of valid tokens whose holders may subscribe, at most 64.
    #[serde(deserialize_with = "at_most::<REPORT_RECIPIENTS_MAX, _, _>")]
    pub tokens: Vec<u64>,
    /// The number of further exceptions, recipients and tokens.
    pub omitted: usize,
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
    /// `true` if the node may route for others.
    pub may_route: bool,
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
            may_route: row.may_route,
            groups: row.groups,
            expires_ms: row.expires.map(|at| at.0),
            revoked_ms: row.revoked.map(|at| at.0),
            generation: row.generation,
            seen_ms: row.seen.map(|at| at.0),
        }
    }
}

/// The path over which a node answered.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportPath {
    /// The next node: its name if that is known here, else the URL at which it was dialled, else its id.
    pub via: String,
    /// `true` if that is the node itself.
    pub direct: bool,
    /// The round-trip time of the path, microseconds, as routing adds up that of its links.
    pub path_us: u64,
}

/// The answer to a ping.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct Pong {
    /// The version of the program.
    pub version: String,
}

impl Pong {
    /// Reads the document of another node. Its text is cut to its bound.
    pub(crate) fn from_json(document: &[u8]) -> Result<Self, serde_json::Error> {
        let mut pong: Self = serde_json::from_slice(document)?;
        cut(&mut pong.version);
        Ok(pong)
    }
}

impl NodeReport {
    /// Reads the document of another node. Its texts and lists are cut to their bounds.
    pub(crate) fn from_json(document: &[u8]) -> Result<Self, serde_json::Error> {
        let mut report: Self = serde_json::from_slice(document)?;
        report.not_direct.iter_mut().flat_map(|peer| [&mut peer.peer, &mut peer.name]).for_each(cut);
        let Self { node, version, links, routers, topics, problems, members, rights, events, .. } =
            &mut report;
        let of_links = links.iter_mut().flat_map(|link| [Some(&mut link.peer), link.name.as_mut()]);
        let of_routers = routers.iter_mut().flat_map(|router| {
            [Some(&mut router.router), Some(&mut router.state), router.last_failure.as_mut()]
        });
        let of_topics = topics.iter_mut().flat_map(|topic| {
            let ReportTopic { direction, topic, type_name, owner, state, .. } = topic;
            [Some(direction), Some(topic), type_name.as_mut(), Some(owner), Some(state)]
        });
        let of_members = members.iter_mut().flatten().flat_map(|member| {
            member.groups.truncate(REPORT_FAULTS_MAX);
            [&mut member.name, &mut member.id].into_iter().chain(&mut member.groups)
        });
        let of_rights = rights.iter_mut().flat_map(|rights| {
            let ReportRights { rules, observers, operators, .. } = rights;
            let of_rules = rules.iter_mut().flat_map(|rule| {
                let ReportRule { kind, interface, except, type_name, to, publish, .. } = rule;
                [kind, interface].into_iter().chain(type_name).chain(except).chain(to).chain(publish)
            });
            of_rules.chain(observers).chain(operators)
        });
        let of_events = events.iter_mut().flatten().flat_map(|one| {
            let ReportEvent { event, topic, peer, detail, .. } = one;
            [event, detail].into_iter().chain(topic).chain(peer)
        });
        let texts =
            [node, version].into_iter().chain(problems).chain(of_members).chain(of_rights).chain(of_events);
        texts.chain(of_links.chain(of_routers).chain(of_topics).flatten()).for_each(cut);
        Ok(report)
    }

    /// Adds the members of the fleet.
    pub(crate) fn set_members(&mut self, mut members: Vec<ReportMember>) {
        self.members_omitted = members.len().saturating_sub(REPORT_MEMBERS_MAX);
        members.truncate(REPORT_MEMBERS_MAX);
        self.members = Some(members);
    }

    /// Returns the document. Topics, rules and members that make it too long are left out, and counted.
    pub(crate) fn into_json(mut self) -> String {
        loop {
            let json = serde_json::to_string(&self).unwrap_or_default();
            let members = self.members.as_mut().filter(|members| !members.is_empty());
            let rights = self.rights.as_mut().filter(|rights| !rights.rules.is_empty());
            let is_bare = self.topics.is_empty() && members.is_none() && rights.is_none();
            if json.len() <= REPORT_BYTES_MAX || is_bare {
                return json;
            }
            self.topics_omitted += halve(&mut self.topics);
            if let Some(rights) = rights {
                rights.rules_omitted += halve(&mut rights.rules);
            }
            self.members_omitted += members.map_or(0, halve);
        }
    }
}

/// Cuts a text to its bound.
fn cut(text: &mut String) {
    if let Some((at, _)) = text.char_indices().nth(REPORT_TEXT_CHARS_MAX) {
        text.truncate(at);
    }
}

/// Drops the second half of a list. Returns the number of dropped ones.
fn halve<T>(list: &mut Vec<T>) -> usize {
    let kept = list.len() / 2;
    list.drain(kept..).count()
}

/// Reduces a graph to one interface, for an observer who asks about it: other programs of the local network are not the
/// observer's business. What other owners offer to this node stays, since they have names of their own for it.
pub fn keep_interface(graph: &mut Graph, interface: &str) {
    let names = names_of(interface);
    graph.endpoints.retain(|endpoint| names.contains(&endpoint.topic));
    graph.calls.retain(|calls| names.contains(&calls.topic));
    graph.problems.retain(|problem| words(problem).any(|word| names.contains(word)));
    graph.drops.retain(|reason, _| !reason.contains(' '));
    for share in &mut graph.shares {
        share.routes.retain(|route| names.contains(&route.topic));
    }
    for used in &mut graph.uses {
        used.routes.retain(|route| names.contains(&route.topic));
    }
    let of_shares = graph.shares.iter().flat_map(|share| &share.routes).map(|route| &route.name);
    let of_uses = graph.uses.iter().flat_map(|used| &used.routes).map(|route| &route.name);
    let of_tokens = graph.uses.iter().filter_map(|used| used.name.as_ref());
    let of_offers = graph.offers.iter().map(|offer| &offer.name);
    let kept: BTreeSet<_> = of_shares.chain(of_uses).chain(of_tokens).chain(of_offers).cloned().collect();
    graph.names.retain(|name, _| kept.contains(name));
}

/// Returns the names of an interface and its parts, as ROS 2 and DDS have them, whichever kind of interface it is.
fn names_of(interface: &str) -> BTreeSet<String> {
    let kinds = [Interface::Topic, Interface::Service, Interface::Action, Interface::Parameters];
    let names = kinds.iter().flat_map(|kind| kind.parts()).flat_map(|part| {
        let name = part.name(interface);
        let of_service = [format!("rq{name}Request"), format!("rr{name}Reply")];
        let of_service = (part.kind == Kind::Service).then_some(of_service);
        std::iter::once(name).chain(of_service.into_iter().flatten())
    });
    names.collect()
}

/// Splits a text into words, of which each may be a name of ROS 2.
fn words(text: &str) -> impl Iterator<Item = &str> {
    text.split(|c: char| !c.is_alphanumeric() && !matches!(c, '_' | '/'))
}

/// Reads at most `MAX` elements of a list, and skips the others: it comes from another machine.
fn at_most<'de, const MAX: usize, T, D>(deserializer: D) -> Result<Vec<T>, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    deserializer.deserialize_seq(AtMost::<MAX, T>(PhantomData))
}

/// As [`at_most`], for a list that may be absent.
fn at_most_if_any<'de, const MAX: usize, T, D>(deserializer: D) -> Result<Option<Vec<T>>, D::Error>
where
    T: Deserialize<'de>,
    D: Deserializer<'de>,
{
    struct IfAny<const MAX: usize, T>(PhantomData<T>);
    impl<'de, const MAX: usize, T: Deserialize<'de>> Visitor<'de> for IfAny<MAX, T> {
        type Value = Option<Vec<T>>;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("a list or null")
        }
        fn visit_unit<E>(self) -> Result<Self::Value, E> {
            Ok(None)
        }
        fn visit_none<E>(self) -> Result<Self::Value, E> {
            Ok(None)
        }
        fn visit_some<D: Deserializer<'de>>(self, deserializer: D) -> Result<Self::Value, D::Error> {
            at_most::<MAX, T, D>(deserializer).map(Some)
        }
    }
    deserializer.deserialize_option(IfAny::<MAX, T>(PhantomData))
}

struct AtMost<const MAX: usize, T>(PhantomData<T>);

impl<'de, const MAX: usize, T: Deserialize<'de>> Visitor<'de> for AtMost<MAX, T> {
    type Value = Vec<T>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut list: A) -> Result<Vec<T>, A::Error> {
        let mut read = Vec::new();
        while read.len() < MAX {
            match list.next_element()? {
                Some(element) => read.push(element),
                None => return Ok(read),
            }
        }
        while list.next_element::<IgnoredAny>()?.is_some() {}
        Ok(read)
    }
}

/// Reads alerts. One of another version, whose fields may differ, becomes [`Alert::Other`], as does one that is too
/// long.
fn alerts<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<Alert>, D::Error> {
    let read: Vec<serde_json::Value> = at_most::<REPORT_FAULTS_MAX, _, _>(deserializer)?;
    let alert = |alert: serde_json::Value| match alert.to_string().len() <= REPORT_ALERT_BYTES_MAX {
        true => serde_json::from_value(alert).unwrap_or(Alert::Other),
        false => Alert::Other,
    };
    Ok(read.into_iter().map(alert).collect())
}

/// Reads counts of reasons, as many as there are reasons in any version, and skips the others.
fn counts<'de, D: Deserializer<'de>>(deserializer: D) -> Result<BTreeMap<String, u64>, D::Error> {
    struct Counts;
    impl<'de> Visitor<'de> for Counts {
        type Value = BTreeMap<String, u64>;
        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str("counts by reason")
        }
        fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
            let mut read = BTreeMap::new();
            while let Some((reason, count)) = map.next_entry::<String, u64>()? {
                if read.len() < REPORT_REASONS_MAX && reason.len() <= REPORT_REASON_BYTES_MAX {
                    read.insert(reason, count);
                }
            }
            Ok(read)
        }
    }
    deserializer.deserialize_map(Counts)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;
    use crate::admin::graph::{Endpoint, NameLine, Offer, Share, ShareRoute};
    use crate::admin::not_direct::NotDirectReason;

    #[test]
    fn long_report_leaves_topics_out_and_says_how_many() {
        let topic = ReportTopic { topic: "/t".repeat(5000), ..ReportTopic::default() };
        let report = NodeReport { topics: vec![topic; 300], topics_omitted: 2, ..NodeReport::default() };
        let json = report.into_json();
        assert!(json.len() <= REPORT_BYTES_MAX, "{}", json.len());
        let read = NodeReport::from_json(json.as_bytes()).unwrap();
        assert_eq!((read.topics.len(), read.topics_omitted), (75, 227));
        let rule = ReportRule { interface: "/t".repeat(5000), ..ReportRule::default() };
        let rights = ReportRights { rules: vec![rule; 300], rules_omitted: 2, ..ReportRights::default() };
        let json = NodeReport { rights: Some(rights), ..NodeReport::default() }.into_json();
        assert!(json.len() <= REPORT_BYTES_MAX, "{}", json.len());
        let rights = NodeReport::from_json(json.as_bytes()).unwrap().rights.unwrap();
        assert_eq!((rights.rules.len(), rights.rules_omitted), (75, 227));
    }

    #[test]
    fn report_of_another_version_is_read() {
        let text = br#"{"node": "arm", "later": [1], "members": null, "alerts": [
            {"kind": "of_a_later_version", "n": 1}, {"kind": "restart_pending", "changes": 5}, {"kind": "local_network_alone"}]}"#;
        let read = NodeReport::from_json(text).unwrap();
        assert_eq!(read.alerts, [Alert::Other, Alert::Other, Alert::LocalNetworkAlone]);
        assert_eq!((read.node.as_str(), read.topics.len(), read.members), ("arm", 0, None));
        assert_eq!(read.rights, None, "a version without rights is not one that gives none");
    }

    #[test]
    fn report_of_a_lying_node_takes_no_more_than_its_bounds() {
        let many = |what: &str, n: usize| vec![what; n].join(",");
        let long = "\u{e4}".repeat(5000);
        let text = format!(
            r#"{{"version": "{long}", "links": [{}], "not_direct": [{}], "routers": [{}], "topics": [{}], "problems": [{}], "alerts": [{}],
                "members": [{}], "rights": {{"rules": [{}], "observers": [{}]}},
                "events": [{}], "drops": {{{}}}}}"#,
            many("{}", 5000),
            many(&format!(r#"{{"name": "{long}", "reason": "{long}"}}"#), 100),
            many("{}", 5000),
            many(&format!(r#"{{"state": "{long}"}}"#), 1),
            many("\"p\"", 5000),
            many(&format!(r#"{{"kind": "restart_pending", "changes": ["{long}"]}}"#), 50),
            many("{}", 5000),
            many(&format!(r#"{{"to": ["{long}", {}]}}"#, many("\"a\"", 100)), 600),
            many("\"a\"", 100),
            many(&format!(r#"{{"detail": "{long}"}}"#), 100),
            (0..5000).map(|n| format!("\"r{n}\": 1")).collect::<Vec<_>>().join(",")
                + &format!(",\"{long}\": 1"),
        );
        let read = NodeReport::from_json(text.as_bytes()).unwrap();
        let lengths = [
            read.links.len(),
            read.not_direct.len(),
            read.routers.len(),
            read.problems.len(),
            read.alerts.len(),
            read.members.unwrap().len(),
            read.drops.len(),
        ];
        let bounds = [64, 64, 16, 32, 32, 2048, 512];
        assert_eq!((lengths, read.version.chars().count()), (bounds, REPORT_TEXT_CHARS_MAX));
        let peer = &read.not_direct[0];
        let cut = (peer.name.chars().count(), peer.reason);
        assert_eq!(cut, (REPORT_TEXT_CHARS_MAX, NotDirectReason::Other));
        assert!(read.alerts.iter().all(|alert| *alert == Alert::Other), "they are too long");
        assert_eq!(read.topics[0].state.chars().count(), REPORT_TEXT_CHARS_MAX);
        let rights = read.rights.unwrap();
        let to = &rights.rules[0].to;
        assert_eq!((rights.rules.len(), to.len(), rights.observers.len()), (512, 64, 64));
        assert_eq!(to[0].chars().count(), REPORT_TEXT_CHARS_MAX);
        let events = read.events.unwrap();
        assert_eq!((events.len(), events[0].detail.chars().count()), (64, REPORT_TEXT_CHARS_MAX));
    }

    #[test]
    fn observer_sees_the_local_programs_of_the_interface_that_it_asks_about_and_no_others() {
        for (name, interface, is_it) in [
            ("/camera", "/camera", true),
            ("/camera/info", "/camera", false),
            ("/camera2", "/camera", false),
            ("rq/addRequest", "/add", true),
            ("rr/addReply", "/add", true),
            ("rq/fib/_action/send_goalRequest", "/fib", true),
            ("/fib/_action/status", "/fib", true),
            ("rq/arm/get_parametersRequest", "/arm", true),
            ("rq/adderRequest", "/add", false),
            ("/camera", "", false),
            ("/camera", "/", false),
        ] {
            assert_eq!(names_of(interface).contains(name), is_it, "{name} {interface}");
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
            names: ["1", "2", "3"].map(|name| (name.to_owned(), NameLine::default())).into(),
            problems: vec!["/a: types differ".into(), "/ab: types differ".into()],
            drops: [("stale".to_owned(), 1), ("stale from link 3".to_owned(), 1)].into(),
            ..Graph::default()
        };
        keep_interface(&mut graph, "/a");
        let endpoints: Vec<_> = graph.endpoints.iter().map(|e| e.topic.as_str()).collect();
        let routes: Vec<_> = graph.shares[0].routes.iter().map(|r| r.topic.as_str()).collect();
        assert_eq!((&endpoints[..], &routes[..], graph.offers.len()), (&["/a"][..], &["/a"][..], 1));
        assert_eq!(graph.names.keys().collect::<Vec<_>>(), ["1", "3"]);
        assert_eq!((graph.problems.len(), graph.drops.len()), (1, 1));
    }
}
