//! The fleet as an observer sees it: what its nodes report, and the tables of `sgc fleet status`.
//!
//! Reports come from other machines. Callers remove control characters from the lines (`Line::cleaned`) before they print
//! them.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::time::Duration;

use serde::Serialize;
use sgc_node::admin::report::{NodeReport, ReportLink, ReportMember, ReportTopic};
use sgc_node::admin::{AdminRequest, REPORT_NODES_MAX, ReportAnswer, ReportRequest};
use sgc_process::output;
use sgc_process::style::{self, Line, Tone, Toned};
use sgc_wire::UnixMillis;

use crate::ask::{answer, ask};
use crate::error::DiagnosisError;
use crate::refusals;
use crate::rights::Recipients;
use crate::status::duration;

/// Longest time for the node here to ask others. It gives up earlier.
const ANSWER_MAX: Duration = Duration::from_secs(15);
/// Part of a certificate's validity that is left when its end is shown as a fault. It is renewed when a third is left.
const CERTIFICATE_PART: u64 = 5;
/// Difference of clocks from which on it is shown. Reports take some seconds at most.
const CLOCKS_DIFFER: Duration = Duration::from_secs(30);
/// The arguments to use where the authority does not tell the members.
const OTHERWISE: &str = "nodes (`sgc fleet status robot`) or the fleet file (`--fleet lab.fleet`)";
/// Nodes with the same fault that are named.
const NODES_NAMED: usize = 4;
/// Stuck topics of a node that are named.
const STUCK_NAMED: usize = 3;
/// Links that the overview names for each node.
const LINKS_NAMED: usize = 2;
/// State of a search that failed, and goes on.
const TRYING_AGAIN: &str = "trying again";

/// The fleet as an observer sees it at one moment.
#[derive(Clone, Debug, Default, Serialize)]
pub struct FleetStatus {
    /// The time, milliseconds since 1970, by the observer's clock.
    pub time_ms: u64,
    /// The nodes, by name.
    pub nodes: Vec<FleetNode>,
    /// The number of members that the authority's report has no room for.
    pub members_omitted: usize,
    /// All known nodes by their ids: the name, and whether the node routes for others.
    #[serde(skip)]
    known: BTreeMap<String, (String, bool)>,
    /// All known nodes by name, also those that are not shown, as the fleet's authority or file knows them.
    #[serde(skip)]
    members: BTreeMap<String, Option<ReportMember>>,
    /// The newest generation of the fleet's secret that a member was given.
    #[serde(skip)]
    generation: Option<u32>,
    /// The ids of all nodes that a reporting node has a link to.
    #[serde(skip)]
    linked: BTreeSet<String>,
}

/// A node of the fleet.
#[derive(Clone, Debug, Default, Serialize)]
pub struct FleetNode {
    /// The node's name.
    pub name: String,
    /// The node as the fleet's authority or file knows it; null if that was not asked or does not know it.
    pub member: Option<ReportMember>,
    /// How the node is doing; null if it gave no report.
    pub report: Option<NodeReport>,
    /// The time of the answer by the observer's clock, milliseconds since 1970.
    pub at_ms: u64,
    /// The reason why there is no report; null if there is one, or if the node was not asked because it is revoked.
    pub error: Option<String>,
    /// The remedy for that; empty if there is none to name.
    pub fix: String,
}

/// Asks nodes of the fleet by the node at this socket; without names, the fleet's authority.
pub fn ask_nodes(
    socket: &Path,
    nodes: &[String],
    interface: Option<&str>,
) -> Result<Vec<ReportAnswer>, DiagnosisError> {
    let mut answers = Vec::new();
    let mut parts: Vec<_> = nodes.chunks(REPORT_NODES_MAX).collect();
    if parts.is_empty() {
        parts.push(&[]);
    }
    for nodes in parts {
        let interface = interface.map(str::to_owned);
        let request = ReportRequest { nodes: nodes.to_vec(), interface, ping: false };
        let text = ask(socket, &AdminRequest::Report(request), ANSWER_MAX)?;
        answers.extend(answer::<Vec<ReportAnswer>>(socket, &text)?);
    }
    Ok(answers)
}

/// Asks a node of the fleet for nothing but an answer, by the node at this socket.
pub fn ping(socket: &Path, node: &str) -> Result<ReportAnswer, DiagnosisError> {
    let request = ReportRequest { nodes: vec![node.to_owned()], ping: true, ..ReportRequest::default() };
    let text = ask(socket, &AdminRequest::Report(request), ANSWER_MAX)?;
    Ok(answer::<Vec<ReportAnswer>>(socket, &text)?.pop().unwrap_or_default())
}

/// The members of a fleet.
#[derive(Clone, Debug, Default)]
pub struct Members {
    /// The members, by name.
    pub members: Vec<ReportMember>,
    /// The number of further ones.
    pub omitted: usize,
    /// The report of the authority, if it was asked for them.
    pub authority: Option<ReportAnswer>,
}

impl Members {
    /// Asks the authority that the identity of the node at this socket names.
    pub fn of_authority(socket: &Path) -> Result<Self, DiagnosisError> {
        let mut answer = ask_nodes(socket, &[], None)?.pop().unwrap_or_default();
        let members = answer.report.as_mut().and_then(|report| report.members.take());
        if let (Some(members), Some(report)) = (members, &answer.report) {
            answer.node = report.node.clone();
            return Ok(Self { members, omitted: report.members_omitted, authority: Some(answer) });
        }
        let reason = match (&answer.report, &answer.error) {
            (Some(report), _) => format!("{} has no fleet file", report.node),
            (None, Some(error)) if answer.fix.is_empty() => error.clone(),
            (None, error) => format!("{} ({})", error.as_deref().unwrap_or_default(), answer.fix),
        };
        let reason = format!(
            "the members of the fleet are not known here. Its authority: {reason}. Or name {OTHERWISE}"
        );
        Err(DiagnosisError::NotSeen { reason })
    }
}

impl FleetStatus {
    /// Joins the members of a fleet with the answers of nodes. With `named`, only these nodes are shown.
    pub fn new(
        now: UnixMillis,
        members: Vec<ReportMember>,
        answers: Vec<ReportAnswer>,
        named: &[String],
    ) -> Self {
        let mut nodes: BTreeMap<String, FleetNode> = BTreeMap::new();
        for member in members {
            let node = FleetNode { name: member.name.clone(), member: Some(member), ..FleetNode::default() };
            nodes.insert(node.name.clone(), node);
        }
        for ReportAnswer { node: name, at_ms, report, error, fix, .. } in answers {
            let node = nodes.entry(name.clone()).or_default();
            (node.name, node.at_ms, node.report, node.error, node.fix) = (name, at_ms, report, error, fix);
        }
        let known = nodes.values().filter_map(|node| {
            let member = node.member.as_ref()?;
            let may_route = member.router || member.may_route;
            let is_router = may_route || node.report.as_ref().is_some_and(|report| report.is_router);
            Some((member.id.clone(), (node.name.clone(), is_router)))
        });
        let known = known.collect();
        let links = nodes.values().filter_map(|node| node.report.as_ref()).flat_map(|report| &report.links);
        let linked = links.filter(|link| !link.silent).map(|link| link.peer.clone()).collect();
        let generation = nodes.values().filter_map(|node| Some(node.member.as_ref()?.generation)).max();
        let members = nodes.values().map(|node| (node.name.clone(), node.member.clone())).collect();
        let is_shown = |node: &FleetNode| named.is_empty() || named.contains(&node.name);
        let nodes = nodes.into_values().filter(is_shown).collect();
        Self { time_ms: now.0, nodes, members_omitted: 0, known, members, generation, linked }
    }

    /// Returns the overview: a row for each node, then what needs attention. `before` is an earlier look, from which
    /// rates are computed.
    pub fn overview(&self, before: Option<&Self>) -> Vec<Line> {
        let rate = if before.is_some() { "messages/s" } else { "messages" };
        let head = ["node", "state", "up for", "version", "certificate", "secret", "links", "topics", rate];
        let rows = self.nodes.iter().map(|node| self.row(node, before));
        let table: Vec<_> = std::iter::once(head.map(Toned::from).to_vec()).chain(rows).collect();
        let mut lines = vec![Line::from(self.summary()), Line::default()];
        lines.extend(style::columns(&table));
        if self.members_omitted > 0 {
            let omitted = output::several(self.members_omitted as u64, "node");
            lines.push(format!("{omitted} more are not shown: name them").into());
        }
        lines.extend(self.attention_lines());
        lines
    }

    /// Returns what needs attention, each fault with all nodes that have it.
    pub fn attention(&self) -> Vec<FaultOfNodes> {
        let mut faults: Vec<FaultOfNodes> = Vec::new();
        for node in &self.nodes {
            for Fault { what, fix } in self.faults(node) {
                match faults.iter_mut().find(|known| (&known.what, &known.fix) == (&what, &fix)) {
                    Some(known) => known.nodes.push(node.name.clone()),
                    None => faults.push(FaultOfNodes { nodes: vec![node.name.clone()], what, fix }),
                }
            }
        }
        faults
    }

    /// Returns all known nodes by their ids: the name, and whether the node may route for others.
    pub fn known(&self) -> &BTreeMap<String, (String, bool)> {
        &self.known
    }

    /// Returns the members that the rules of all nodes permit.
    pub fn recipients(&self) -> Recipients {
        let nodes = self.members.iter().map(|(name, member)| (name.as_str(), member.as_ref()));
        let is_complete = self.members_omitted == 0 && self.members.values().any(Option::is_some);
        let reports = self.nodes.iter().filter_map(|node| node.report.as_ref());
        Recipients::new(nodes, is_complete, reports.filter_map(|report| report.rights.as_ref()))
    }

    fn attention_lines(&self) -> Vec<Line> {
        let mut lines = Vec::new();
        for FaultOfNodes { nodes, what, fix } in self.attention() {
            let nodes = format!("  {}: ", listed(&nodes));
            lines.push(Line::new([nodes.into(), Toned::new(Tone::Attention, what)]));
            if !fix.is_empty() {
                lines.push(format!("    {fix}").into());
            }
        }
        if !lines.is_empty() {
            lines.splice(0..0, [Line::default(), "Needs attention:".into()]);
        }
        lines
    }

    /// Returns everything that a node reports, under its name; nothing without a report.
    pub fn details(&self, node: &FleetNode) -> Vec<Line> {
        let Some(report) = &node.report else { return Vec::new() };
        let mut lines = vec![Line::default(), format!("{}:", node.name).into()];
        let mut section = |title: &str, head: &[&str], rows: Vec<Vec<String>>, omitted: usize| {
            if rows.is_empty() {
                lines.push(format!("  {title}: none").into());
                return;
            }
            let head = head.iter().map(|h| (*h).to_owned()).collect();
            let table: Vec<_> = std::iter::once(head).chain(rows).collect();
            lines.push(format!("  {title}:").into());
            lines.extend(output::columns(&table).into_iter().map(|line| Line::from(line).indented("    ")));
            if omitted > 0 {
                lines.push(format!("    and {omitted} more").into());
            }
        };
        let links = report.links.iter().map(|link| self.link_row(report, link)).collect();
        section("Links", &["to", "by", "round trip", "lost", "dialled by"], links, report.links_omitted);
        if !report.not_direct.is_empty() {
            let rows = report.not_direct.iter().map(|peer| vec![peer.name.clone(), peer.reason.to_string()]);
            let omitted = report.not_direct_omitted;
            section("Over routers", &["peer", "why not direct"], rows.collect(), omitted);
        }
        if !report.routers.is_empty() {
            let rows = report.routers.iter().map(|router| {
                let failure = router.last_failure.clone().unwrap_or_default();
                vec![router.router.clone(), router.state.clone(), failure]
            });
            section("Routers", &["router", "state", "last failure"], rows.collect(), 0);
        }
        let topics = report.topics.iter().map(|topic| self.topic_row(topic)).collect();
        let head = ["", "topic", "type", "owner", "path", "messages", "age", "dropped", "state"];
        section("Topics", &head, topics, report.topics_omitted);
        if let Some(rights) = &report.rights {
            let recipients = self.recipients();
            let rows = rights.rules.iter().map(|rule| recipients.row(rule)).collect();
            section(
                "Rights",
                &["shared", "may subscribe or call", "may publish"],
                rows,
                rights.rules_omitted,
            );
        }
        let counts = |counts: &BTreeMap<String, u64>, meaning: fn(&str) -> String| {
            counts.iter().map(|(key, n)| vec![key.clone(), n.to_string(), meaning(key)]).collect()
        };
        let head = ["reason", "count", "meaning"];
        section("Drops", &head, counts(&report.drops, refusals::drop_meaning), 0);
        section("Refused peers", &head, counts(&report.refused, refusals::door_meaning), 0);
        lines
    }

    /// Returns the numbers of nodes that are here, absent, revoked and faulty, as a sentence.
    pub fn summary(&self) -> String {
        let count = |is_it: fn(&FleetNode) -> bool| self.nodes.iter().filter(|node| is_it(node)).count();
        let here = count(|node| node.report.is_some());
        let revoked = count(|node| node.is_revoked() && node.report.is_none());
        let mut text = output::several(self.nodes.len() as u64, "node");
        for (n, what) in
            [(here, "here"), (self.nodes.len() - here - revoked, "without a report"), (revoked, "revoked")]
        {
            if n > 0 {
                text.push_str(&format!(", {n} {what}"));
            }
        }
        let faulty = self.nodes.iter().filter(|node| !self.faults(node).is_empty()).count();
        match faulty {
            0 => text + "; nothing needs attention",
            n => text + &format!("; {n} of them need{} attention", if n == 1 { "s" } else { "" }),
        }
    }

    fn row(&self, node: &FleetNode, before: Option<&Self>) -> Vec<Toned> {
        let member = node.member.as_ref();
        let dash = || Toned::from("–");
        let until = node.report.as_ref().map(|report| report.certificate_until_ms);
        let until = until.or(member.and_then(|member| member.expires_ms));
        let generation = match (&node.report, member) {
            (Some(report), _) => report.secret_generation,
            (None, Some(member)) => Some(member.generation).filter(|generation| *generation > 0),
            (None, None) => None,
        };
        let tone = match node.report {
            Some(_) => Tone::Good,
            None if node.is_revoked() => Tone::Plain,
            None => Tone::Bad,
        };
        let mut row = vec![
            node.name.as_str().into(),
            Toned::new(tone, self.state(node)),
            node.report.as_ref().map_or_else(dash, |report| duration(report.uptime_s).into()),
            node.report.as_ref().map_or_else(dash, |report| report.version.as_str().into()),
            until.map_or_else(dash, |until| self.ends(until)),
            generation.map_or_else(dash, |generation| generation.to_string().into()),
        ];
        let Some(report) = &node.report else {
            row.extend([dash(), dash(), dash()]);
            return row;
        };
        row.push(self.links(report).into());
        row.push((report.topics.len() + report.topics_omitted).to_string().into());
        row.push(match before {
            None => messages(report).to_string().into(),
            Some(before) => self.rate(node, before).map_or_else(dash, |rate| format!("{rate:.1}").into()),
        });
        row
    }

    fn state(&self, node: &FleetNode) -> String {
        if node.report.is_some() {
            return "here".to_owned();
        }
        if node.is_revoked() {
            return "revoked".to_owned();
        }
        match node.member.as_ref().and_then(|member| member.seen_ms) {
            _ if self.is_linked(node) => "no report, but linked".to_owned(),
            Some(seen) => {
                format!("no report, seen {} ago", duration(self.time_ms.saturating_sub(seen) / 1000))
            }
            None => "no report".to_owned(),
        }
    }

    fn ends(&self, until_ms: u64) -> Toned {
        match until_ms.checked_sub(self.time_ms) {
            None | Some(0) => Toned::new(Tone::Bad, "ended"),
            Some(left) => format!("{} left", duration(left / 1000)).into(),
        }
    }

    fn links(&self, report: &NodeReport) -> String {
        let named = report.links.iter().take(LINKS_NAMED).map(|link| {
            let round_trip = if link.silent { "silent".to_owned() } else { output::millis(link.rtt_us) };
            let direct = if self.is_direct(report, link) { " direct" } else { "" };
            format!("{} {round_trip}{direct}", self.name_of(link))
        });
        let mut named: Vec<_> = named.collect();
        let more = report.links.len().saturating_sub(LINKS_NAMED) + report.links_omitted;
        if more > 0 {
            named.push(format!("{more} more"));
        }
        if named.is_empty() { "none".to_owned() } else { named.join(", ") }
    }

    fn link_row(&self, report: &NodeReport, link: &ReportLink) -> Vec<String> {
        vec![
            self.name_of(link),
            if self.is_direct(report, link) { "itself" } else { "a router" }.to_owned(),
            if link.silent { "silent".to_owned() } else { output::millis(link.rtt_us) },
            lost(link),
            if link.dialled { "this node" } else { "the other" }.to_owned(),
        ]
    }

    fn topic_row(&self, topic: &ReportTopic) -> Vec<String> {
        vec![
            topic.direction.clone(),
            topic.topic.clone(),
            topic.type_name.clone().unwrap_or_else(|| "?".into()),
            topic.owner.clone(),
            match &topic.via {
                None => "–".to_owned(),
                Some(_) if topic.direct => "direct".to_owned(),
                Some(via) => format!("over {}", self.known_name(via).unwrap_or_else(|| beginning(via))),
            },
            topic.messages.to_string(),
            age(topic),
            dropped(topic),
            topic.state.clone(),
        ]
    }

    /// Returns the name of the node at the other end of a link, or the beginning of its id.
    fn name_of(&self, link: &ReportLink) -> String {
        self.known_name(&link.peer).or_else(|| link.name.clone()).unwrap_or_else(|| beginning(&link.peer))
    }

    fn known_name(&self, id: &str) -> Option<String> {
        self.known.get(id).map(|(name, _)| name.clone())
    }

    /// Returns `true` if a link of a node leads to the peer itself and not to a router. Only routers listen, so all but the
    /// direct links of another node lead to them.
    fn is_direct(&self, report: &NodeReport, link: &ReportLink) -> bool {
        link.direct || report.is_router && !self.is_router(&link.peer)
    }

    /// Returns `true` if a node is known to route for others.
    fn is_router(&self, id: &str) -> bool {
        self.known.get(id).is_some_and(|(_, is_router)| *is_router)
    }

    /// Returns `true` if a node that reports has a link to this one.
    fn is_linked(&self, node: &FleetNode) -> bool {
        node.member.as_ref().is_some_and(|member| self.linked.contains(&member.id))
    }

    /// Returns the messages a second since an earlier look, unless the node was restarted meanwhile.
    fn rate(&self, node: &FleetNode, before: &Self) -> Option<f64> {
        let earlier = before.nodes.iter().find(|other| other.name == node.name)?.report.as_ref()?;
        let report = node.report.as_ref()?;
        let seconds = report.clock_ms.checked_sub(earlier.clock_ms).filter(|ms| *ms > 0)? as f64 / 1000.0;
        let more = messages(report).checked_sub(messages(earlier))?;
        (report.uptime_s >= earlier.uptime_s).then_some(more as f64 / seconds)
    }

    /// Returns `true` if the report of a stuck topic's owner, or its absence, says why: it is absent itself, or its
    /// publisher does not run.
    fn is_explained(&self, topic: &ReportTopic) -> bool {
        let Some(owner) = self.nodes.iter().find(|node| node.name == topic.owner) else { return false };
        match &owner.report {
            Some(report) => report.topics.iter().any(|share| share.waiting && share.topic == topic.topic),
            None => !self.is_linked(owner),
        }
    }

    /// Returns what needs attention at a node.
    fn faults(&self, node: &FleetNode) -> Vec<Fault> {
        let mut faults = Vec::new();
        let mut add = |what: String, fix: &str| faults.push(Fault { what, fix: fix.to_owned() });
        let Some(report) = &node.report else {
            // A router whose identity was made before there were observers gives no reports.
            let is_expected = node.is_revoked()
                || node.member.as_ref().is_some_and(|member| member.router) && self.is_linked(node);
            if let Some(error) = node.error.as_ref().filter(|_| !is_expected) {
                add(error.clone(), &node.fix);
            }
            return faults;
        };
        for alert in &report.alerts {
            // Its "here" is that node.
            add(format!("it says: {alert}"), alert.fix());
        }
        if report.clock_ms.abs_diff(node.at_ms) > CLOCKS_DIFFER.as_millis() as u64 {
            let by = duration(report.clock_ms.abs_diff(node.at_ms) / 1000);
            let side = if report.clock_ms > node.at_ms { "ahead of" } else { "behind" };
            add(format!("its clock is {by} {side} the observer's"), "set the wrong one, for instance by NTP");
        }
        let left = report.certificate_until_ms.saturating_sub(self.time_ms);
        if left <= report.certificate_lasts_ms / CERTIFICATE_PART {
            let what = format!("its certificate: {}", self.ends(report.certificate_until_ms));
            add(what, "`sgc fleet renew` it, or see why the authority does not");
        }
        let newest = report.secret_generation.zip(self.generation);
        if let Some((own, newest)) = newest.filter(|(own, newest)| own < newest) {
            let what = format!("it has generation {own} of the fleet's secret, others were given {newest}");
            add(what, "renew it, before `sgc fleet retire-secret`");
        }
        for link in report.links.iter().filter(|link| link.silent) {
            add(format!("{} does not answer it", self.name_of(link)), "see the network between them");
        }
        // Other searches stand back for a link that is there, or have just begun.
        for router in report.routers.iter().filter(|router| router.state == TRYING_AGAIN) {
            let why = router.last_failure.as_ref().map(|why| format!(" ({why})")).unwrap_or_default();
            add(format!("its search for {}: {}{why}", router.router, router.state), "see that router");
        }
        let mut stuck = report.topics.iter().filter(|topic| topic.stuck && !self.is_explained(topic));
        for ReportTopic { topic, state, .. } in stuck.by_ref().take(STUCK_NAMED) {
            add(format!("{topic}: {state}"), "`sgc fleet why NODE:/TOPIC` follows its way");
        }
        match stuck.count() {
            0 => {}
            more => add(
                format!("{more} more of its topics are stuck"),
                "`sgc fleet status` with its name lists them",
            ),
        }
        for problem in &report.problems {
            add(problem.clone(), "");
        }
        faults
    }
}

/// Something that needs attention at some nodes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct FaultOfNodes {
    /// The names of the nodes.
    pub nodes: Vec<String>,
    /// The fault.
    pub what: String,
    /// The remedy; empty if there is none to name.
    pub fix: String,
}

/// Something that needs attention.
#[derive(Debug)]
struct Fault {
    what: String,
    /// The remedy; empty if there is none to name.
    fix: String,
}

impl FleetNode {
    fn is_revoked(&self) -> bool {
        self.member.as_ref().is_some_and(|member| member.revoked_ms.is_some())
    }
}

/// Returns the messages of all topics of a node.
fn messages(report: &NodeReport) -> u64 {
    report.topics.iter().fold(0, |sum, topic| sum.saturating_add(topic.messages))
}

/// Lists names, the first ones of many.
fn listed(names: &[String]) -> String {
    match names.len().saturating_sub(NODES_NAMED) {
        0 => names.join(", "),
        more => format!("{} and {more} more", names[..NODES_NAMED].join(", ")),
    }
}

/// Returns the beginning of a node id, by which nodes without a name are called.
fn beginning(id: &str) -> String {
    id.chars().take(8).collect()
}

/// Returns the part of a link's packets that was lost.
fn lost(link: &ReportLink) -> String {
    match (link.lost_packets, link.sent_packets) {
        (0, _) | (_, 0) => "–".to_owned(),
        (lost, sent) => format!("{:.1} %", 100.0 * lost as f64 / sent as f64),
    }
}

/// Returns the time from the publication of a topic's last message to its arrival. Clocks that differ make it negative,
/// unless the node knows by how much.
fn age(topic: &ReportTopic) -> String {
    topic.age_us.map_or_else(|| "–".to_owned(), |age_us| output::signed_millis(age_us, topic.age_error_us))
}

/// Returns the drops of a topic with their reasons, the most first.
fn dropped(topic: &ReportTopic) -> String {
    let mut drops: Vec<_> = topic.drops.iter().collect();
    drops.sort_by_key(|(_, n)| Reverse(**n));
    let mut drops = drops.into_iter().map(|(reason, n)| format!("{n} {reason}"));
    drops.next().map_or_else(
        || "–".to_owned(),
        |most| match drops.count() {
            0 => most,
            more => format!("{most} and {more} more"),
        },
    )
}

#[cfg(test)]
mod tests {
    use sgc_node::admin::not_direct::{NotDirectPeer, NotDirectReason};
    use sgc_node::admin::report::{ReportRights, ReportRouter, ReportRule};
    use sgc_node::alerts::Alert;

    use super::*;

    fn plain(lines: &[Line]) -> Vec<String> {
        lines.iter().map(ToString::to_string).collect()
    }

    /// Returns the words of a line, one space apart.
    fn words(line: &str) -> String {
        line.split_whitespace().collect::<Vec<_>>().join(" ")
    }

    const NOW: u64 = 1_795_000_000_000;
    const HOUR: u64 = 3_600_000;

    fn member(name: &str, id: &str, router: bool) -> ReportMember {
        ReportMember {
            name: name.into(),
            id: id.into(),
            router,
            generation: 2,
            expires_ms: Some(NOW + 90 * 24 * HOUR),
            seen_ms: (name != "lost").then_some(NOW - 3 * HOUR),
            ..ReportMember::default()
        }
    }

    fn report(name: &str, links: &[(&str, u64)]) -> NodeReport {
        let link = |(peer, rtt_us): &(&str, u64)| ReportLink {
            peer: (*peer).into(),
            rtt_us: *rtt_us,
            direct: *peer != "11",
            ..ReportLink::default()
        };
        let topic = ReportTopic {
            direction: "share".into(),
            topic: "/odom".into(),
            messages: 500,
            state: "granted".into(),
            ..ReportTopic::default()
        };
        NodeReport {
            node: name.into(),
            version: "0.1.0".into(),
            uptime_s: 7200,
            clock_ms: NOW - 800,
            certificate_until_ms: NOW + 80 * 24 * HOUR,
            certificate_lasts_ms: 90 * 24 * HOUR,
            secret_generation: Some(2),
            links: links.iter().map(link).collect(),
            topics: vec![topic],
            ..NodeReport::default()
        }
    }

    fn answer_of(report: NodeReport) -> ReportAnswer {
        let (node, at_ms) = (report.node.clone(), NOW);
        ReportAnswer { node, at_ms, report: Some(report), ..ReportAnswer::default() }
    }

    fn error_of(node: &str, error: &str) -> ReportAnswer {
        let (node, error) = (node.into(), Some(error.into()));
        ReportAnswer { node, error, fix: "see that it runs".into(), ..ReportAnswer::default() }
    }

    fn fleet(answers: Vec<ReportAnswer>) -> FleetStatus {
        let mut stolen = member("stolen", "55", false);
        stolen.revoked_ms = Some(NOW);
        let members = vec![
            member("cloud", "11", true),
            member("arm", "22", false),
            member("desk", "33", false),
            member("lost", "44", false),
            stolen,
        ];
        FleetStatus::new(UnixMillis(NOW), members, answers, &[])
    }

    #[test]
    fn overview_names_links_and_says_what_is_absent() {
        let fleet = fleet(vec![
            answer_of(report("arm", &[("11", 23_000), ("33", 500)])),
            answer_of(report("desk", &[("22", 500), ("99aabbccdd", 70), ("11", 1000)])),
            error_of("cloud", "not in reach"),
            error_of("lost", "not in reach"),
        ]);
        let lines = plain(&fleet.overview(None));
        let summary = "5 nodes, 2 here, 2 without a report, 1 revoked; 1 of them needs attention";
        assert_eq!(lines[0], summary);
        let row = |name: &str| lines.iter().find(|line| line.starts_with(name)).cloned().unwrap_or_default();
        for (name, parts) in [
            (
                "arm",
                &["here", "2 h 0 min", "0.1.0", "80 d 0 h left", "cloud 23 ms, desk 0.50 ms direct", "500"][..],
            ),
            ("desk", &["arm 0.50 ms direct, 99aabbcc 0.07 ms direct, 1 more"]),
            ("cloud", &["no report, but linked", "90 d 0 h left"]),
            ("lost", &["no report  "]),
            ("stolen", &["revoked"]),
        ] {
            for part in parts {
                assert!(row(name).contains(part), "{part:?} is not in {:?}", row(name));
            }
        }
        let end = ["", "Needs attention:", "  lost: not in reach", "    see that it runs"];
        assert_eq!(lines[lines.len() - 4..], end);
    }

    #[test]
    fn nodes_with_the_same_fault_share_a_line_and_many_stuck_topics_are_counted() {
        let members = (0..6).map(|n| member(&format!("arm-{n}"), &n.to_string(), false)).collect();
        let answers = (0..6).map(|n| error_of(&format!("arm-{n}"), "not in reach")).collect();
        let absent = plain(&FleetStatus::new(UnixMillis(NOW), members, answers, &[]).overview(None));
        let expected = "  arm-0, arm-1, arm-2, arm-3 and 2 more: not in reach";
        assert!(absent.iter().any(|line| line == expected), "{absent:#?}");
        let mut stuck = report("desk", &[]);
        let topic = |n: usize| ReportTopic {
            topic: format!("/t{n}"),
            state: "robot has gone".into(),
            stuck: n != 0,
            ..ReportTopic::default()
        };
        stuck.topics = (0..6).map(topic).collect();
        let lines = plain(&fleet(vec![answer_of(stuck)]).overview(None)).join("\n");
        assert!(lines.contains("desk: /t1: robot has gone\n    `sgc fleet why NODE:/TOPIC`"), "{lines}");
        assert!(lines.contains("desk: 2 more of its topics are stuck") && !lines.contains("/t0"), "{lines}");
        // The owner says that its publisher does not run, or is absent and has a fault of its own.
        let mut stuck = report("desk", &[]);
        let of = |owner: &str, topic: &str| ReportTopic {
            topic: topic.into(),
            owner: owner.into(),
            state: "not now".into(),
            stuck: true,
            ..ReportTopic::default()
        };
        stuck.topics = vec![of("arm", "/a"), of("arm", "/b"), of("lost", "/c"), of("elsewhere", "/d")];
        let mut arm = report("arm", &[]);
        arm.topics = vec![ReportTopic { topic: "/a".into(), waiting: true, ..ReportTopic::default() }];
        let fleet = fleet(vec![answer_of(stuck), answer_of(arm), error_of("lost", "not in reach")]);
        let faults: Vec<_> = fleet.attention().into_iter().map(|fault| fault.what).collect();
        assert_eq!(faults, ["/b: not now", "/d: not now", "not in reach"]);
    }

    #[test]
    fn each_fault_of_a_report_needs_attention() {
        let sound = report("arm", &[("11", 23_000)]);
        let alert = Alert::RestartPending { changes: vec!["`listen` changed".into()] };
        let router = |state: &str| ReportRouter {
            router: "quic://cloud:7447".into(),
            state: state.into(),
            last_failure: Some("no answer".into()),
        };
        let silent = ReportLink { peer: "11".into(), silent: true, ..ReportLink::default() };
        for (faulty, what) in [
            (NodeReport { alerts: vec![alert], ..sound.clone() }, "`listen` changed"),
            (
                NodeReport { clock_ms: NOW - HOUR, ..sound.clone() },
                "its clock is 1 h 0 min behind the observer's",
            ),
            (NodeReport { clock_ms: NOW + HOUR, ..sound.clone() }, "ahead of the observer's"),
            (
                NodeReport { certificate_until_ms: NOW + HOUR, ..sound.clone() },
                "its certificate: 1 h 0 min left",
            ),
            (NodeReport { certificate_until_ms: 0, ..sound.clone() }, "its certificate: ended"),
            (NodeReport { secret_generation: Some(1), ..sound.clone() }, "it has generation 1"),
            (NodeReport { links: vec![silent], ..sound.clone() }, "cloud does not answer it"),
            (
                NodeReport { routers: vec![router("trying again")], ..sound.clone() },
                "its search for quic://cloud:7447: trying again (no answer)",
            ),
            (NodeReport { problems: vec!["/a: types differ".into()], ..sound.clone() }, "/a: types differ"),
        ] {
            let lines = plain(&fleet(vec![answer_of(faulty), answer_of(report("desk", &[]))]).overview(None));
            assert!(lines.iter().any(|line| line.contains(what)), "{what:?} is not in {lines:#?}");
        }
        // A router that has dialled this node is no fault, nor is what was counted since the start.
        let well = NodeReport {
            routers: vec![router("standing back"), router("looking")],
            drops: [("hop_limit".to_owned(), 3)].into(),
            certificate_until_ms: NOW + 20 * 24 * HOUR,
            ..sound
        };
        let lines = plain(&fleet(vec![answer_of(well)]).overview(None));
        assert!(lines[0].ends_with("nothing needs attention"), "{lines:#?}");
    }

    #[test]
    fn rates_are_of_the_time_between_two_looks() {
        let before = fleet(vec![answer_of(report("arm", &[])), answer_of(report("desk", &[]))]);
        let later = |name: &str, messages: u64, uptime_s: u64| {
            let mut report = report(name, &[]);
            (report.clock_ms, report.uptime_s) = (report.clock_ms + 2000, uptime_s);
            report.topics.iter_mut().for_each(|topic| topic.messages = messages);
            answer_of(report)
        };
        let now = fleet(vec![later("arm", 520, 7202), later("desk", 3, 1)]);
        let lines = plain(&now.overview(Some(&before)));
        let last = |name: &str| {
            let line = lines.iter().find(|line| line.starts_with(name)).cloned().unwrap_or_default();
            line.rsplit("  ").next().unwrap_or_default().to_owned()
        };
        assert!(lines.iter().any(|line| line.ends_with("messages/s")), "{lines:#?}");
        assert_eq!((last("arm"), last("desk")), ("10.0".into(), "–".into()));
    }

    #[test]
    fn details_of_one_node_mark_recipients_by_all_members() {
        let mut arm = report("arm", &[]);
        let rule = ReportRule {
            kind: "topic".into(),
            interface: "/odom".into(),
            to: ["desk", "stolen", "ghost"].map(str::to_owned).into(),
            ..ReportRule::default()
        };
        arm.rights = Some(ReportRights { rules: vec![rule], rules_omitted: 7, ..ReportRights::default() });
        let members = ["arm", "desk"].map(|name| member(name, name, false)).into();
        let named = ["arm".to_owned()];
        let mut fleet = FleetStatus::new(UnixMillis(NOW), members, vec![answer_of(arm)], &named);
        let lines = plain(&fleet.details(&fleet.nodes[0])).join("\n");
        assert!(
            lines.contains("/odom   desk, stolen (no member has this name), ghost (no member"),
            "{lines}"
        );
        assert!(lines.contains("and 7 more"), "{lines}");
        fleet.members_omitted = 1;
        let lines = plain(&fleet.details(&fleet.nodes[0])).join("\n");
        assert!(lines.contains("ghost (it is not among the members that are known here)"), "{lines}");
    }

    #[test]
    fn details_have_the_path_age_and_drops_of_topics_and_the_losses_of_links() {
        let mut arm = report("arm", &[("11", 23_000), ("22", 500)]);
        (arm.links[0].sent_packets, arm.links[0].lost_packets) = (2000, 31);
        let brought = |topic: &str| ReportTopic {
            direction: "use".into(),
            topic: topic.into(),
            type_name: Some("x_msgs/msg/Y".into()),
            owner: "desk".into(),
            messages: 7,
            via: Some("11".into()),
            age_us: Some(12_345),
            state: "granted".into(),
            ..ReportTopic::default()
        };
        arm.topics.push(ReportTopic {
            drops: [("stale".to_owned(), 3), ("no_writer".to_owned(), 40)].into(),
            ..brought("/a")
        });
        arm.topics.push(ReportTopic { direct: true, age_us: Some(-2000), ..brought("/b") });
        arm.topics.push(ReportTopic { via: Some("0123456789".into()), age_us: None, ..brought("/c") });
        let fleet = fleet(vec![answer_of(arm)]);
        let node = fleet.nodes.iter().find(|node| node.name == "arm").unwrap();
        let lines = plain(&fleet.details(node)).into_iter().map(|line| words(&line)).collect::<Vec<_>>();
        for line in [
            "cloud a router 23 ms 1.6 % the other",
            "use /a x_msgs/msg/Y desk over cloud 7 12 ms 40 no_writer and 1 more granted",
            "use /b x_msgs/msg/Y desk direct 7 -2.00 ms – granted",
            "use /c x_msgs/msg/Y desk over 01234567 7 – – granted",
            "share /odom ? – 500 – – granted",
        ] {
            assert!(lines.iter().any(|found| found == line), "{line:?} is not in {lines:#?}");
        }
    }

    #[test]
    fn details_have_every_topic_and_the_meaning_of_each_drop() {
        let mut report = report("arm", &[("11", 23_000), ("33", 500)]);
        report.drops = [("no_subscriber".to_owned(), 7)].into();
        report.topics_omitted = 4;
        let peer =
            NotDirectPeer { name: "desk".into(), reason: NotDirectReason::Blocked, ..Default::default() };
        (report.not_direct, report.not_direct_omitted) = (vec![peer], 3);
        let fleet = fleet(vec![answer_of(report), error_of("desk", "not in reach")]);
        let of = |name: &str| {
            let node = fleet.nodes.iter().find(|node| node.name == name);
            node.map(|node| plain(&fleet.details(node)).join("\n")).unwrap_or_default()
        };
        let arm = of("arm");
        for part in [
            "cloud  a router  23 ms",
            "desk   itself    0.50 ms",
            "share  /odom  ?",
            "and 4 more",
            "desk  no packet passes between the two networks",
            "and 3 more",
            "no_subscriber  7",
        ] {
            assert!(arm.contains(part), "{part:?} is not in {arm}");
        }
        assert!(of("desk").is_empty() && of("stolen").is_empty());
    }
}
