//! The walk: follows a path from the local end to the link, or from the link to the local end, up to the first fault.
//!
//! Pure: takes a document and returns steps. Each has a typed finding; `words` renders it.

mod counters;
mod local;
mod share;
mod uncovered;
mod uses;

use std::collections::BTreeSet;

use sgc_endpoint::CallLoss;
use sgc_node::alerts::Alert;
use sgc_node::graph::{Graph, Interface, LostCalls, Offer, ServiceCalls, Share, Use};
use sgc_ros::{is_pattern, matches};

use self::counters::refused;
use self::local::{ends, line_of, name_at_owner, silent, traffic};
use self::share::walk_share;
use self::uncovered::uncovered;
use self::uses::walk_use;
use crate::finding::{Direction, Finding, Hop, LocalFinding, NameFinding, NodeFinding, UnansweredCalls};
use crate::step::{Step, Verdict, Walk};

/// Time in seconds for which lost calls count as a fault, unless calls are answered before.
const LOST_CALLS_FRESH_S: u64 = 600;

/// Begins a walk with the node itself and the alerts that need an operator. Returns `true` if one of them stops all
/// traffic.
fn begin(graph: &Graph) -> (Walk, bool) {
    let node = |finding| Finding::Node(finding);
    let (name, version) = (graph.node.clone(), graph.version.clone());
    let mut steps = vec![Step::fine(node(NodeFinding::Runs { node: name, version }))];
    let is_clock = |alert: &&Alert| matches!(alert, Alert::ClocksDiffer { .. });
    let believed = graph.links.len().saturating_sub(graph.alerts.iter().filter(is_clock).count());
    let stops = |alert: &Alert| (alert.stops_all() || is_clock(&alert)) && believed == 0;
    let (stopping, others): (Vec<_>, Vec<_>) = graph.alerts.iter().cloned().partition(stops);
    steps.extend(others.into_iter().map(|alert| Step::unknown(node(NodeFinding::Alert(alert)))));
    let stopping = stopping.into_iter().next();
    let is_over = stopping.is_some();
    if !is_over {
        steps.extend(refused(graph).into_iter().map(|refused| Step::unknown(Finding::Refused(refused))));
    }
    steps.extend(stopping.map(|alert| Step::wrong(node(NodeFinding::Alert(alert)))));
    (steps, is_over)
}

/// Explains why an interface of the local network does not flow.
pub fn interface(graph: &Graph, topic: &str) -> Vec<Step> {
    let (mut steps, is_over) = begin(graph);
    if is_over {
        return steps;
    }
    let wrong = |finding| Step::wrong(Finding::Node(finding));
    if !topic.starts_with('/') {
        steps.push(wrong(NodeFinding::RelativeName { topic: topic.to_owned() }));
        return steps;
    }
    if !graph.has_ros {
        steps.push(wrong(NodeFinding::RouterAlone));
        return steps;
    }
    let mut walks = walks(graph, topic);
    if walks.is_empty() && !walk_parts(graph, topic, &mut steps) {
        walks.extend(pattern_walk(graph, topic));
        if walks.is_empty() {
            steps.push(Step::wrong(Finding::Rule(uncovered(graph, topic))));
        }
    }
    steps.extend(merged(walks));
    lost_calls(graph, topic, &mut steps);
    steps
}

/// Explains why a name does not flow, at a router.
pub fn name(graph: &Graph, name: &str) -> Vec<Step> {
    let (mut steps, is_over) = begin(graph);
    if is_over {
        return steps;
    }
    let fine = |finding| Step::fine(Finding::Name(finding));
    let wrong = |finding| Step::wrong(Finding::Name(finding));
    let line = line_of(graph, name);
    match line.way {
        Some((0, _)) => steps.push(fine(NameFinding::OwnerHere)),
        Some((link, rtt_us)) => {
            if let Some(step) = silent(graph, link) {
                steps.push(step);
                return steps;
            }
            steps.push(fine(NameFinding::Route { next: Hop::over(graph, link), rtt_us }));
        }
        None => {
            steps.push(wrong(NameFinding::Unadvertised));
            return steps;
        }
    }
    if !line.has_branch {
        steps.push(wrong(NameFinding::NoBranch));
        return steps;
    }
    let to = line.out.iter().map(|link| Hop::over(graph, *link)).collect();
    steps.push(fine(NameFinding::Branch { to }));
    if let Some(step) = line.out.iter().find_map(|link| silent(graph, *link)) {
        steps.push(step);
        return steps;
    }
    traffic(&line, Direction::Through, &mut steps);
    steps
}

/// The walk of one rule.
struct RuleWalk {
    steps: Walk,
    /// The rule may be wrong for this interface while the interface flows by another rule: its wildcard covers more
    /// than its owner offers, or no program here takes part in this direction.
    is_optional: bool,
}

impl RuleWalk {
    fn is_wrong(&self) -> bool {
        self.steps.iter().any(|step| step.verdict == Verdict::Wrong)
    }
}

/// Returns the walks of all rules that name an interface or carry it.
fn walks(graph: &Graph, topic: &str) -> Vec<RuleWalk> {
    let shares = graph.shares.iter().enumerate().filter(|(at, share)| covers(graph, *at, share, topic));
    let shares = shares.map(|(_, share)| {
        let mut steps = Walk::new();
        walk_share(graph, share, topic, &mut steps);
        RuleWalk { steps, is_optional: is_pattern(&share.topic) }
    });
    let uses = graph.uses.iter().filter(|used| concerns(used, topic)).map(|used| {
        let mut steps = Walk::new();
        walk_use(graph, used, topic, &mut steps);
        let (providers, consumers) = ends(graph, used.kind, topic);
        let here = if used.publishes { providers } else { consumers };
        RuleWalk { steps, is_optional: is_pattern(&used.topic) || here.is_empty() }
    });
    shares.chain(uses).collect()
}

/// Merges the walks of several rules. If the interface flows by one of them, faults of optional rules do not count. If
/// it flows by none, the first fault is enough.
fn merged(walks: Vec<RuleWalk>) -> Walk {
    let (wrong, mut sound): (Vec<_>, Vec<_>) = walks.into_iter().partition(RuleWalk::is_wrong);
    let (optional, required): (Vec<_>, Vec<_>) =
        wrong.into_iter().partition(|walk| walk.is_optional && !sound.is_empty());
    sound.extend(optional.into_iter().map(|walk| {
        let doubted = walk.steps.into_iter().map(|step| match step.verdict {
            Verdict::Wrong => Step { verdict: Verdict::Unknown, ..step },
            _ => step,
        });
        RuleWalk { steps: doubted.collect(), ..walk }
    }));
    sound.extend(required.into_iter().next());
    let mut steps = Walk::new();
    for step in sound.into_iter().flat_map(|walk| walk.steps) {
        // Rules share most of their steps.
        if step.verdict == Verdict::Wrong || !steps.contains(&step) {
            steps.push(step);
        }
    }
    steps
}

/// Returns the walk of a rule whose wildcard covers an idle interface. Prefers the rule whose owner offers it to a rule
/// that programs here wait for.
fn pattern_walk(graph: &Graph, topic: &str) -> Option<RuleWalk> {
    let covering =
        graph.uses.iter().filter(|used| is_pattern(&used.topic) && matches(&used.local_topic, topic));
    let is_offered = |used: &Use| {
        let theirs = name_at_owner(used, topic);
        let is_same = |offer: &Offer| offer.owner_id == used.owner_id && offer.topic == theirs;
        graph.offers.iter().any(|offer| is_same(offer) && offer.kind == used.kind)
    };
    let is_here = |used: &Use| {
        let (providers, consumers) = ends(graph, used.kind, topic);
        !(if used.publishes { providers } else { consumers }).is_empty()
    };
    let used = covering.min_by_key(|used| (!is_offered(used), !is_here(used)))?;
    let kinds = [Interface::Topic, Interface::Service, Interface::Action];
    let has_ends = kinds.into_iter().any(|kind| {
        let (providers, consumers) = ends(graph, kind, topic);
        !providers.is_empty() || !consumers.is_empty()
    });
    // The local programs do not match the rule, so the missing offer is not the fault.
    if has_ends && !is_offered(used) && !is_here(used) {
        return None;
    }
    let mut steps = Walk::new();
    walk_use(graph, used, topic, &mut steps);
    Some(RuleWalk { steps, is_optional: true })
}

/// Walks the parts of an action or of a node's parameters, up to the first fault. Returns `false` if no rule covers any
/// part.
fn walk_parts(graph: &Graph, topic: &str, steps: &mut Walk) -> bool {
    let kinds = [sgc_ros::Interface::Action, sgc_ros::Interface::Parameters];
    let mut is_any = false;
    for part in kinds.into_iter().flat_map(|kind| kind.parts()) {
        let mut for_part = merged(walks(graph, &part.name(topic)));
        // A client subscribes to the topics of an action only while it runs.
        for step in &mut for_part {
            if matches!(&step.finding, Finding::Local(LocalFinding::NoSubscriber { .. })) {
                let action = topic.to_owned();
                *step = Step::unknown(Finding::Local(LocalFinding::NoActionClient { action }));
            }
        }
        is_any |= !for_part.is_empty();
        // The parts share most of their steps.
        let is_known = |step: &Step| steps.iter().any(|known| known.finding.is_same_of_part(&step.finding));
        let new: Vec<_> = for_part.into_iter().filter(|step| !is_known(step)).collect();
        steps.extend(new);
        if steps.iter().any(|step| step.verdict == Verdict::Wrong) {
            break;
        }
    }
    is_any
}

/// Returns `true` if a share names this topic, or one of its routes is called so here.
fn covers(graph: &Graph, at: usize, share: &Share, topic: &str) -> bool {
    let is_named = share.topic == topic || share.routes.iter().any(|route| route.topic == topic);
    is_named || graph.endpoints.iter().any(|e| e.topic == topic && e.shared_by == Some(at))
}

/// Returns `true` if a use names this topic, or one of its routes carries it. A wildcard alone does not count, because
/// its owner may not offer the interface.
fn concerns(used: &Use, topic: &str) -> bool {
    let runs = used.routes.iter().any(|route| route.topic == topic);
    runs || used.routes.is_empty() && used.local_topic == topic
}

/// Reports unanswered calls of a service, or of the parts of an action or of parameters. They are a fault if there is
/// no other, until calls are answered again. Ahead of another fault they are its consequence.
fn lost_calls(graph: &Graph, topic: &str, steps: &mut Walk) {
    let kinds = [sgc_ros::Interface::Action, sgc_ros::Interface::Parameters];
    let parts = kinds.into_iter().flat_map(|kind| kind.parts()).map(|part| part.name(topic));
    let names: BTreeSet<String> = parts.chain([topic.to_owned()]).collect();
    let of_topic = graph.calls.iter().filter(|calls| names.contains(&calls.topic));
    let lost = of_topic.flat_map(|calls| calls.lost.iter().map(move |lost| lost_step(calls, lost)));
    let (faults, past): (Vec<_>, Vec<_>) = lost.partition(|step| step.verdict == Verdict::Wrong);
    let is_wrong = steps.iter().any(|step| step.verdict == Verdict::Wrong);
    let before = if is_wrong { steps.len() - 1 } else { steps.len() };
    let faults_are = if is_wrong { Verdict::Unknown } else { Verdict::Wrong };
    let faults = faults.into_iter().map(|step| Step { verdict: faults_are, ..step });
    steps.splice(before..before, past.into_iter().chain(faults));
}

fn lost_step(calls: &ServiceCalls, lost: &LostCalls) -> Step {
    // A client that ends before its reply is no fault.
    let is_fault = lost.since_answer > 0
        && lost.last_s <= LOST_CALLS_FRESH_S
        && lost.reason != CallLoss::ClientGone.key();
    let finding = Finding::Unanswered(UnansweredCalls {
        service: calls.topic.clone(),
        is_served: calls.is_served,
        reason: lost.reason.clone(),
        count: lost.count,
        by: lost.by.clone(),
        last_s: lost.last_s,
    });
    if is_fault { Step::wrong(finding) } else { Step::unknown(finding) }
}
