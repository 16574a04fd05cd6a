//! Facts about the local network and the links that the walks of shares and uses have in common.

use std::collections::{BTreeMap, BTreeSet};

use sgc_node::DataDrop;
use sgc_node::graph::{DeadMan, Endpoint, Graph, Interface, NameLine, Qos, Use, UseRoute};
use sgc_ros::{Naming, Rename, is_pattern};

use crate::finding::{Direction, Finding, Hop, LinkFinding, LocalFinding, QosMismatch, TrafficFinding};
use crate::near::near;
use crate::step::{Step, Walk};

/// `Qos::liveliness` of a publisher that is manual by topic.
const MANUAL_BY_TOPIC: u8 = 2;
/// Shortest lease whose assertions without a message travel (`sgc-node`, `ASSERTED_LEASE_MIN`).
const ASSERTED_LEASE_MIN_NS: u64 = 100_000_000;

/// Returns the local endpoints that provide an interface, and those that want it.
pub(super) fn ends<'a>(
    graph: &'a Graph,
    kind: Interface,
    topic: &str,
) -> (Vec<&'a Endpoint>, Vec<&'a Endpoint>) {
    let dds = match kind {
        Interface::Topic => topic.to_owned(),
        Interface::Service => format!("rq{topic}Request"),
        Interface::Action => format!("rq{topic}/_action/send_goalRequest"),
    };
    let is_topic = kind == Interface::Topic;
    let all = graph.endpoints.iter().filter(|e| e.topic == dds && e.is_ros_topic == is_topic);
    // A server of a service reads its requests.
    all.partition(|e| e.writes == is_topic)
}

/// Returns the types of an interface by the types of its endpoints, sorted.
pub(super) fn types_of(kind: Interface, ends: &[&Endpoint]) -> Vec<String> {
    let suffix = match kind {
        Interface::Topic => "",
        Interface::Service => "_Request",
        Interface::Action => "_SendGoal_Request",
    };
    let types: BTreeSet<_> =
        ends.iter().map(|end| end.type_name.strip_suffix(suffix).unwrap_or(&end.type_name)).collect();
    types.into_iter().map(str::to_owned).collect()
}

/// Returns the name at the owner of an interface that a use calls `topic` here.
pub(super) fn name_at_owner(used: &Use, topic: &str) -> String {
    if !is_pattern(&used.topic) {
        return used.topic.clone();
    }
    match used.local_topic.strip_suffix(&used.topic) {
        Some(namespace) => topic.strip_prefix(namespace).unwrap_or(topic).to_owned(),
        None => {
            let back = Naming { rename: Rename::As(used.topic.clone()), ..Naming::default() };
            back.renamed(&used.local_topic, topic)
        }
    }
}

/// Returns the names close to `topic`, which its user may have meant.
pub(super) fn meant<'a>(topic: &str, candidates: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    near(topic, candidates).into_iter().map(str::to_owned).collect()
}

/// Returns the problem that the node reports about a topic.
pub(super) fn problem_of(graph: &Graph, topic: &str) -> Option<String> {
    let begin = format!("{topic}: ");
    graph.problems.iter().find_map(|problem| problem.strip_prefix(&begin)).map(str::to_owned)
}

/// Returns the state of a name; an unknown name has none.
pub(super) fn line_of(graph: &Graph, name: &str) -> NameLine {
    graph.names.get(name).cloned().unwrap_or_default()
}

/// Returns a fault if something should come over a link and does not.
pub(super) fn silent(graph: &Graph, link: u32) -> Option<Step> {
    let is_silent = graph.links.iter().any(|l| l.id == link && l.silent);
    is_silent.then(|| Step::wrong(Finding::Link(LinkFinding::Silent(Hop::over(graph, link)))))
}

/// Reports whether this node has a working link.
pub(super) fn linked(graph: &Graph, steps: &mut Walk) -> bool {
    if let Some(link) = graph.links.iter().find(|link| !link.silent) {
        steps.push(Step::fine(Finding::Link(LinkFinding::Linked(Hop::over(graph, link.id)))));
        return true;
    }
    steps.push(Step::wrong(Finding::Link(match (graph.links.first(), graph.routers.first()) {
        (Some(link), _) => LinkFinding::Silent(Hop::over(graph, link.id)),
        (None, None) => LinkFinding::NoRouter,
        (None, Some(search)) => LinkFinding::Unlinked {
            router: search.router.clone(),
            state: search.state.clone(),
            failure: search.last_failure.clone(),
        },
    })));
    false
}

/// Returns the fault that nothing on the local network provides an interface.
pub(super) fn no_provider(graph: &Graph, kind: Interface, topic: &str) -> Step {
    let (_, consumers) = ends(graph, kind, topic);
    let others = graph.endpoints.iter().filter(|e| e.is_ros_topic && e.writes).map(|e| e.topic.as_str());
    Step::wrong(Finding::Local(LocalFinding::NoProvider {
        kind,
        topic: topic.to_owned(),
        consumers: consumers.len(),
        meant: meant(topic, others),
    }))
}

/// Returns a step for publishers that are manual by topic and whose `assert_liveliness()` alone is not seen at other
/// nodes.
pub(super) fn unasserted(providers: &[&Endpoint]) -> Option<Step> {
    let is_unseen = |qos: &Qos| {
        let is_short = qos.lease_ns.is_some_and(|lease| lease < ASSERTED_LEASE_MIN_NS);
        qos.reliable && qos.liveliness == MANUAL_BY_TOPIC && is_short
    };
    let count = providers.iter().filter(|end| end.writes && is_unseen(&end.qos)).count();
    (count > 0).then(|| Step::unknown(Finding::Local(LocalFinding::Unasserted { count })))
}

/// The messages that are written for local readers.
pub(super) struct Written<'a> {
    pub(super) kind: Interface,
    pub(super) topic: &'a str,
    pub(super) type_name: &'a str,
    /// The use that brings them; none if this node shares the topic.
    pub(super) route: Option<&'a UseRoute>,
    /// Number of matched readers.
    pub(super) matched: u32,
}

/// Checks that local readers get the messages that are written for them. Returns `false` if there is a fault.
pub(super) fn readers(graph: &Graph, written: &Written<'_>, steps: &mut Walk) -> bool {
    let fault = fault_of_readers(graph, written, steps);
    let is_read = fault.is_none();
    steps.push(match fault {
        Some(fault) => Step::wrong(Finding::Local(fault)),
        None => Step::fine(Finding::Local(LocalFinding::Matched { count: written.matched })),
    });
    is_read
}

/// Returns the first fault of the local readers. Reports readers that get nothing beside others that do.
fn fault_of_readers(graph: &Graph, written: &Written<'_>, steps: &mut Walk) -> Option<LocalFinding> {
    let (topic, type_name) = (written.topic, written.type_name.to_owned());
    let (_, all) = ends(graph, written.kind, topic);
    let Some(first) = all.first() else {
        let others = graph.endpoints.iter().filter(|e| e.is_ros_topic && !e.writes).map(|e| e.topic.as_str());
        return Some(LocalFinding::NoSubscriber { topic: topic.to_owned(), meant: meant(topic, others) });
    };
    let same: Vec<_> = all.iter().filter(|end| end.type_name == type_name).collect();
    if same.is_empty() {
        return Some(LocalFinding::SubscribedTypeDiffers { far: type_name, here: first.type_name.clone() });
    }
    if let Some(route) = written.route {
        if let Some(far) = route.type_hash.as_ref()
            && let Some(here) = same.iter().filter_map(|end| end.type_hash.as_ref()).find(|hash| *hash != far)
        {
            let (far, here) = (far.clone(), here.clone());
            return Some(LocalFinding::SubscribedDefinitionDiffers { type_name, far, here });
        }
        let mut mismatches: Vec<_> = same
            .iter()
            .filter_map(|end| end.qos.mismatch(&route.qos))
            .map(|(policy, offered, asked)| QosMismatch { policy, offered, asked })
            .collect();
        let count = mismatches.len();
        if count > 0 {
            let first = mismatches.swap_remove(0);
            if count == same.len() {
                return Some(LocalFinding::QosDiffers(first));
            }
            let some = LocalFinding::SomeQosDiffers { count, of: same.len(), first };
            steps.push(Step::unknown(Finding::Local(some)));
        }
        if route.writers == 0 {
            return Some(LocalFinding::NoWriter);
        }
    }
    (written.matched == 0).then_some(LocalFinding::Unmatched { count: same.len() })
}

/// Reports the traffic of a name and its drops. The drops are a fault if they exceed the traffic.
pub(super) fn traffic(line: &NameLine, direction: Direction, steps: &mut Walk) {
    if line.packets > 0 {
        let passed = TrafficFinding::Passed { packets: line.packets, bytes: line.bytes, direction };
        steps.push(Step::fine(Finding::Traffic(passed)));
    }
    // Packets without a subscriber are no loss to anybody.
    let lost = line.dropped.iter().filter(|(counter, _)| *counter != DataDrop::NoTree.key());
    let counts: BTreeMap<_, _> = lost.map(|(counter, count)| (counter.clone(), *count)).collect();
    let Some((worst, _)) = counts.iter().max_by_key(|(_, count)| **count) else { return };
    let (worst, total) = (worst.clone(), counts.values().sum::<u64>());
    let found = Finding::Traffic(TrafficFinding::Dropped { counts, worst });
    steps.push(if total > line.packets { Step::wrong(found) } else { Step::unknown(found) });
}

/// Describes the dead-man switch of a topic.
pub(super) fn dead_man(switch: &DeadMan, topic: &str) -> Step {
    let (dead_man, topic) = (switch.clone(), topic.to_owned());
    // If nothing that came was held back, silence is no fault.
    let held_back = dead_man.late + dead_man.unjudged + dead_man.not_resumed;
    let is_idle = held_back == 0 && dead_man.no_stop_message.is_none();
    match &dead_man.stopped {
        None => Step::fine(Finding::Local(LocalFinding::CommandsPass { stops: dead_man.stops })),
        Some(_) if is_idle => Step::fine(Finding::Local(LocalFinding::Stopped { dead_man, topic })),
        Some(_) => Step::wrong(Finding::Local(LocalFinding::Stopped { dead_man, topic })),
    }
}

/// Returns the step that sends the user to the other side.
pub(super) fn far_half(node: impl Into<String>, topic: &str) -> Step {
    Step::unknown(Finding::FarHalf { node: node.into(), topic: topic.to_owned() })
}
