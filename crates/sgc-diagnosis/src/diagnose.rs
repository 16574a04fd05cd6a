//! The walk: follows a path from the local end to the link, or from the link to the local end, up to the first fault.
//!
//! Pure: takes a document and returns steps.

use std::collections::{BTreeMap, BTreeSet};

use sgc_node::alerts::Alert;
use sgc_node::graph::{
    Endpoint, Graph, Interface, LostCalls, NameLine, Offer, Qos, ServiceCalls, Share, ShareRoute, Use,
    UseRoute,
};
use sgc_ros::{Naming, Rename, is_for_wildcards, is_pattern, matches};

use sgc_process::output;

use crate::links::{link_of, millis};
use crate::near::{hint, near};
use crate::refusals;
use crate::step::{Step, Verdict};

/// The steps of a walk. A fault is the last of them.
type Walk = Vec<Step>;

/// Time in seconds for which lost calls count as a fault, unless calls are answered before.
const LOST_CALLS_FRESH_S: u64 = 600;
/// `Qos::liveliness` of a publisher that is manual by topic.
const MANUAL_BY_TOPIC: u8 = 2;
/// Shortest lease whose assertions without a message travel (`sgc-node`, `ASSERTED_LEASE_MIN`).
const ASSERTED_LEASE_MIN_NS: u64 = 100_000_000;

/// Begins a walk with the node itself and the alerts that need an operator. Returns `true` if one of them stops all traffic.
fn begin(graph: &Graph) -> (Walk, bool) {
    let mut steps = vec![Step::fine(format!("{} runs, sgc {}", graph.node, graph.version))];
    let is_clock = |alert: &&Alert| matches!(alert, Alert::ClocksDiffer { .. });
    let believed = graph.links.len().saturating_sub(graph.alerts.iter().filter(is_clock).count());
    let stops = |alert: &Alert| (alert.stops_all() || is_clock(&alert)) && believed == 0;
    let (stopping, others): (Vec<_>, Vec<_>) = graph.alerts.iter().partition(|alert| stops(alert));
    steps.extend(others.into_iter().map(|alert| Step::unknown(alert.to_string()).with_fix(alert.fix())));
    steps.extend(refusals::steps(graph));
    steps.extend(stopping.first().map(|alert| Step::wrong(alert.to_string(), alert.fix())));
    (steps, !stopping.is_empty())
}

/// Explains why an interface of the local network does not flow.
pub fn interface(graph: &Graph, topic: &str) -> Walk {
    let (mut steps, is_over) = begin(graph);
    if is_over {
        return steps;
    }
    if !topic.starts_with('/') {
        let fix = format!("ask for /{topic}");
        steps.push(Step::wrong(format!("{topic} is not a full ROS 2 name: it begins with no /"), fix));
        return steps;
    }
    if !graph.has_ros {
        steps.push(Step::wrong(
            "this node is a router alone: it touches no ROS 2 network and knows topics by their 256-bit names only",
            "ask the nodes at both ends, or here `sgc why --name HEX`, with the name that `sgc status` shows there",
        ));
        return steps;
    }
    let mut walks = walks(graph, topic);
    if walks.is_empty() && !walk_parts(graph, topic, &mut steps) {
        walks.extend(pattern_walk(graph, topic));
        if walks.is_empty() {
            steps.push(uncovered(graph, topic));
        }
    }
    steps.extend(merged(walks));
    lost_calls(graph, topic, &mut steps);
    steps
}

/// Reports unanswered calls of a service, or of the parts of an action or of parameters. They are a fault if there is no other,
/// until calls are answered again. Ahead of another fault they are its consequence.
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
    let (means, fix) = refusals::call_loss(&lost.reason).unwrap_or(("for another reason", ""));
    let side = if calls.is_served { "calls of others to the server here" } else { "calls of clients here" };
    let by: Vec<_> = lost.by.iter().map(|(caller, count)| format!("{count} of {caller}")).collect();
    let by = if by.is_empty() { String::new() } else { format!(", among them {}", by.join(", ")) };
    let found = format!(
        "{}: {} {side} got no answer{by}, the last {} s ago: {} ({means})",
        calls.topic, lost.count, lost.last_s, lost.reason
    );
    // A client that ends before its reply is no fault.
    let is_fault =
        lost.since_answer > 0 && lost.last_s <= LOST_CALLS_FRESH_S && lost.reason != "call_client_gone";
    let step = if is_fault { Step::wrong(found, fix) } else { Step::unknown(found) };
    if fix.is_empty() { Step { fix: None, ..step } } else { step.with_fix(fix) }
}

/// The walk of one rule.
struct RuleWalk {
    steps: Walk,
    /// The rule may be wrong for this interface while the interface flows by another rule: its wildcard covers more than its
    /// owner offers, or no program here takes part in this direction.
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

/// Merges the walks of several rules. If the interface flows by one of them, faults of optional rules do not count. If it
/// flows by none, the first fault is enough.
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

/// Returns the walk of a rule whose wildcard covers an idle interface. Prefers the rule whose owner offers it to a rule that
/// programs here wait for.
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

/// Returns the name at the owner of an interface that a use calls `topic` here.
fn name_at_owner(used: &Use, topic: &str) -> String {
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

/// Walks the parts of an action or of a node's parameters, up to the first fault. Returns `false` if no rule covers any part.
fn walk_parts(graph: &Graph, topic: &str, steps: &mut Walk) -> bool {
    let kinds = [sgc_ros::Interface::Action, sgc_ros::Interface::Parameters];
    let mut is_any = false;
    for part in kinds.into_iter().flat_map(|kind| kind.parts()) {
        let for_part = merged(walks(graph, &part.name(topic)));
        is_any |= !for_part.is_empty();
        // The parts share most of their steps.
        let known: BTreeSet<String> = steps.iter().map(|step| step.found.clone()).collect();
        steps.extend(for_part.into_iter().filter(|step| !known.contains(&step.found)));
        if steps.iter().any(|step| step.verdict == Verdict::Wrong) {
            break;
        }
    }
    is_any
}

/// Explains why a name does not flow, at a router.
pub fn name(graph: &Graph, name: &str) -> Walk {
    let (mut steps, is_over) = begin(graph);
    if is_over {
        return steps;
    }
    let line = graph.names.get(name).cloned().unwrap_or_default();
    match line.way {
        Some((0, _)) => steps.push(Step::fine("its owner is this node")),
        Some((link, cost)) => {
            let way =
                format!("the way to its owner is {}, {} round trip", link_of(graph, link), millis(cost));
            match graph.links.iter().find(|l| l.id == link) {
                Some(l) if l.silent => {
                    steps.push(silent(graph, link));
                    return steps;
                }
                _ => steps.push(Step::fine(way)),
            }
        }
        None => {
            steps.push(Step::wrong(
                "nobody in reach advertises it: its owner is not linked to these routers, shares it no more, or nobody \
                 publishes it there; with `mapping = \"query\"` it is known only while it is asked for",
                "see `sgc why /topic` at its owner; compare the name with `sgc name`",
            ));
            return steps;
        }
    }
    if !line.has_branch {
        steps.push(Step::wrong(
            "nobody asked for it over this router: no branch leads through it",
            "see `sgc why /topic` at the node that uses it: it may go over another router, or be refused",
        ));
        return steps;
    }
    let out: Vec<_> = line.out.iter().map(|link| link_of(graph, *link)).collect();
    steps.push(Step::fine(format!("a branch leads through this node, to {}", out.join(", "))));
    for link in &line.out {
        if graph.links.iter().any(|l| l.id == *link && l.silent) {
            steps.push(silent(graph, *link));
            return steps;
        }
    }
    traffic(&line, "passed through this node", &mut steps);
    steps
}

/// Returns `true` if a share names this topic, or one of its routes is called so here.
fn covers(graph: &Graph, at: usize, share: &Share, topic: &str) -> bool {
    let is_named = share.topic == topic || share.routes.iter().any(|route| route.topic == topic);
    is_named || graph.endpoints.iter().any(|e| e.topic == topic && e.shared_by == Some(at))
}

/// Returns `true` if a use names this topic, or one of its routes carries it. A wildcard alone does not count, because its
/// owner may not offer the interface.
fn concerns(used: &Use, topic: &str) -> bool {
    let runs = used.routes.iter().any(|route| route.topic == topic);
    runs || used.routes.is_empty() && used.local_topic == topic
}

/// Returns the local endpoints that provide an interface, and those that want it.
fn ends<'a>(graph: &'a Graph, kind: Interface, topic: &str) -> (Vec<&'a Endpoint>, Vec<&'a Endpoint>) {
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

/// Returns the type of an interface by the type of its endpoint.
fn type_of(kind: Interface, end: &Endpoint) -> &str {
    let suffix = match kind {
        Interface::Topic => "",
        Interface::Service => "_Request",
        Interface::Action => "_SendGoal_Request",
    };
    end.type_name.strip_suffix(suffix).unwrap_or(&end.type_name)
}

fn provider(kind: Interface) -> &'static str {
    if kind == Interface::Topic { "publisher" } else { "server" }
}

fn consumer(kind: Interface) -> &'static str {
    if kind == Interface::Topic { "subscriber" } else { "client" }
}

/// Explains an interface that no rule names.
fn uncovered(graph: &Graph, topic: &str) -> Step {
    let node = &graph.node;
    if let Some(offer) = graph.offers.iter().find(|offer| offer.topic == topic && !offer.is_used) {
        let owner = offer.owner.as_deref().unwrap_or("another node");
        let line = if offer.subscribe || offer.kind != Interface::Topic { "" } else { ", publish = true" };
        return Step::wrong(
            format!("{owner} shares {topic} with this node, but no [[use]] asks for it"),
            format!(
                "add [[use]] from = \"{owner}\", {} = \"{topic}\"{line} to the file of {node}, then `sgc reload`",
                offer.kind
            ),
        );
    }
    let kinds = [Interface::Topic, Interface::Service, Interface::Action];
    for kind in kinds {
        let (providers, consumers) = ends(graph, kind, topic);
        let rules: Vec<_> = graph.shares.iter().map(|share| share.topic.as_str()).collect();
        let used: Vec<_> = graph.uses.iter().map(|used| used.topic.as_str()).collect();
        if !providers.is_empty() {
            let meant = hint(&near(topic, rules.iter().copied()));
            return Step::wrong(
                format!("{} local {}s have it, but no rule names it{meant}", providers.len(), provider(kind)),
                format!(
                    "to share it, add [[share]] {kind} = \"{topic}\", to = [\"NODE\"] to the file of {node}, then `sgc reload`"
                ),
            );
        }
        if !consumers.is_empty() {
            let offers = graph.offers.iter().map(|offer| offer.topic.as_str());
            let meant = hint(&near(topic, offers.chain(used.iter().copied())));
            return Step::wrong(
                format!(
                    "{} local {}s want it, but no rule brings it here{meant}",
                    consumers.len(),
                    consumer(kind)
                ),
                format!(
                    "add [[use]] from = \"OWNER\", {kind} = \"{topic}\" to the file of {node}; the owner has to share it with \
                     {node}"
                ),
            );
        }
    }
    let here = graph.endpoints.iter().filter(|e| e.is_ros_topic).map(|e| e.topic.as_str());
    let offered = graph.offers.iter().map(|offer| offer.topic.as_str());
    let ruled =
        graph.shares.iter().map(|s| s.topic.as_str()).chain(graph.uses.iter().map(|u| u.topic.as_str()));
    let meant = hint(&near(topic, here.chain(offered).chain(ruled)));
    let pattern = graph.shares.iter().map(|share| share.topic.as_str()).find(|rule| matches(rule, topic));
    let found = match pattern {
        Some(pattern) => {
            format!(
                "nobody on the local network has {topic}, which the [[share]] of {pattern} would cover{meant}"
            )
        }
        None => format!(
            "nobody on the local network has {topic}, no rule names it, and no followed node lists it{meant}"
        ),
    };
    Step::wrong(
        found,
        "start what publishes it; if it runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
         ROS_AUTOMATIC_DISCOVERY_RANGE; `sgc topic list` shows what there is",
    )
}

/// Walks a share from the local publishers to the far side.
fn walk_share(graph: &Graph, share: &Share, topic: &str, steps: &mut Walk) {
    let kind = share.kind;
    let (providers, _) = ends(graph, kind, topic);
    let routes: Vec<_> = share.routes.iter().filter(|route| route.topic == topic).collect();
    let takes_in = share.publish.iter().any(|n| *n > 0);
    if providers.is_empty() && !takes_in {
        steps.push(no_provider(graph, kind, topic));
        return;
    }
    if !providers.is_empty() {
        let types: BTreeSet<_> = providers.iter().map(|end| type_of(kind, end)).collect();
        let types: Vec<_> = types.into_iter().collect();
        let found =
            format!("{} local {}s of {topic} [{}]", providers.len(), provider(kind), types.join(", "));
        steps.push(Step::fine(found));
        if let Some(wanted) = share.wanted_type.as_deref().filter(|wanted| !types.contains(wanted)) {
            steps.push(Step::wrong(
                format!(
                    "the [[share]] of {topic} says type {wanted}, and the {}s have {}",
                    provider(kind),
                    types.join(", ")
                ),
                "change `type` in the [[share]], or leave it out",
            ));
            return;
        }
        let hashes: BTreeSet<_> = providers.iter().filter_map(|end| end.type_hash.as_deref()).collect();
        if types.len() == 1 && hashes.len() > 1 {
            let hashes: Vec<_> = hashes.into_iter().map(short_hash).collect();
            steps.push(Step::wrong(
                format!(
                    "local {}s have different definitions of {}: {}",
                    provider(kind),
                    types[0],
                    hashes.join(" and ")
                ),
                "build them from one version of the interface package",
            ));
            return;
        }
    }
    steps.push(Step::fine(format!("a [[share]] covers it, for {}", whom(share.to))));
    steps.extend(unasserted(&providers, ASSERTED_LEASE_MIN_NS, "with a lease of 100 ms or more"));
    let is_granted = routes.iter().any(|route| !route.granted.is_empty());
    for step in unheard(graph, share) {
        // A misspelt name explains that no node has the topic.
        let is_misspelt = step.fix.is_some();
        if is_misspelt && !is_granted {
            steps.push(Step { verdict: Verdict::Wrong, ..step });
            return;
        }
        steps.push(step);
    }
    if routes.is_empty() {
        steps.push(Step::wrong(
            format!(
                "{topic} is covered by a rule, but not shared: {}",
                told(graph, topic, "nothing of it runs")
            ),
            "look into the node's log, and at `sgc status`",
        ));
        return;
    }
    if !linked(graph, steps) {
        return;
    }
    for route in &routes {
        walk_share_route(graph, share, route, !providers.is_empty(), steps);
    }
}

/// Reports a type whose definition differs between subscribers of another node and the publishers here.
fn definitions_differ(graph: &Graph, route: &ShareRoute) -> Option<Step> {
    let (publishers, _) = ends(graph, Interface::Topic, &route.topic);
    let ours = publishers.iter().find_map(|end| end.type_hash.as_deref())?;
    let mut theirs =
        route.consumer_hashes.iter().flat_map(|(node, hashes)| hashes.iter().map(move |hash| (node, hash)));
    let (node, other) = theirs.find(|(_, hash)| *hash != ours)?;
    Some(Step::wrong(
        format!(
            "the definitions of {} differ: {} here, {} at {node}",
            route.type_name,
            short_hash(ours),
            short_hash(other)
        ),
        "build both sides from one version of the interface package",
    ))
}

/// Returns a step for publishers that are manual by topic and whose `assert_liveliness()` alone is not seen at other
/// nodes: those with a lease below `lease_min_ns`, or all if that is 0.
fn unasserted(providers: &[&Endpoint], lease_min_ns: u64, seen: &str) -> Option<Step> {
    let is_unseen = |qos: &Qos| {
        let is_short = qos.lease_ns.is_some_and(|lease| lease_min_ns == 0 || lease < lease_min_ns);
        qos.reliable && qos.liveliness == MANUAL_BY_TOPIC && is_short
    };
    let unseen = providers.iter().filter(|end| end.writes && is_unseen(&end.qos)).count();
    let text = format!(
        "{unseen} local publishers assert their liveliness by hand (MANUAL_BY_TOPIC): other nodes see their messages, and \
         `assert_liveliness()` only {seen}"
    );
    (unseen > 0).then(|| {
        Step::unknown(text)
            .with_fix("publish a message within each lease, or choose a liveliness that is automatic")
    })
}

/// Returns a step for each member that a share names and this node has never heard of, misspelt ones first.
fn unheard(graph: &Graph, share: &Share) -> Vec<Step> {
    let misspelt = share.unheard.iter().filter_map(|member| Some((&member.name, member.meant.as_ref()?)));
    let misspelt = misspelt.map(|(name, meant)| {
        Step::unknown(format!(
            "the [[share]] names \"{name}\", which nobody here is called; \"{meant}\" is here"
        ))
        .with_fix(format!(
            "if \"{meant}\" is meant, correct it in the file of {}, then `sgc reload`",
            graph.node
        ))
    });
    let mut steps: Vec<_> = misspelt.collect();
    let others = share.unheard.iter().filter(|member| member.meant.is_none());
    let others: Vec<_> = others.map(|member| format!("\"{}\"", member.name)).collect();
    if !others.is_empty() {
        steps.push(Step::unknown(format!(
            "the [[share]] names {}, and no member of that name has been heard of since {} started; `sgc fleet list` shows how \
             names are spelt",
            others.join(", "),
            graph.node
        )));
    }
    steps
}

fn walk_share_route(graph: &Graph, share: &Share, route: &ShareRoute, provides: bool, steps: &mut Walk) {
    let (node, topic, kind) = (&graph.node, &route.topic, share.kind);
    if route.granted.is_empty() {
        if let Some((who, why)) = route.refused.iter().next() {
            steps.push(Step::wrong(
                format!("{who} asked for it and was refused: {why}"),
                refusals::fix_at_owner(why).map_or_else(
                    || {
                        format!(
                            "if {who} may have it, add it to `to` of this [[share]] (`publish`, if it is to publish), then \
                             `sgc reload`; `sgc policy test` says who may"
                        )
                    },
                    str::to_owned,
                ),
            ));
        } else {
            steps.push(Step::wrong(
                "nobody asked for it",
                format!(
                    "on the other node: [[use]] from = \"{node}\", {kind} = \"{topic}\"; if it is there, run `sgc why {topic}` \
                     there"
                ),
            ));
        }
        return;
    }
    let refused = match route.refused.iter().next() {
        Some((who, why)) => format!("; {who} was refused: {why}"),
        None => String::new(),
    };
    steps.push(Step::fine(format!("granted to {}{refused}", route.granted.join(", "))));
    if route.lacks_definition {
        steps.push(no_definition(&route.type_name));
        return;
    }
    let line = graph.names.get(&route.name).cloned().unwrap_or_default();
    if !line.has_branch {
        steps.push(Step::wrong(
            "granted, but no branch leads away from this node: the way broke and is being looked for",
            "wait a few seconds and ask again; if it stays, see `sgc status` for links that are silent",
        ));
        return;
    }
    let out: Vec<_> = line.out.iter().filter(|link| **link != 0).collect();
    for link in &out {
        if graph.links.iter().any(|l| l.id == **link && l.silent) {
            steps.push(silent(graph, **link));
            return;
        }
    }
    let ways: Vec<_> = out.iter().map(|link| link_of(graph, **link)).collect();
    if !ways.is_empty() {
        steps.push(Step::fine(format!("it leaves over {}", ways.join(", "))));
    }
    if kind != Interface::Topic {
        if !route.is_written {
            steps.push(Step::wrong(
                "granted, but nothing on the local network calls the server for others: DDS refused it, or it is being made",
                "wait a few seconds and ask again; then look into the node's log for what DDS said",
            ));
            return;
        }
        steps.push(Step::fine("calls of others are put to the local server"));
        far_half(&route.granted.join(", "), topic, steps);
        return;
    }
    if let Some(step) = definitions_differ(graph, route) {
        steps.push(step);
        return;
    }
    if provides && !route.is_read {
        steps.push(Step::wrong(
            "the local publishers are not read, though somebody has it: the local network refused a reader",
            "look into the node's log for what DDS said",
        ));
        return;
    }
    if provides && route.messages == 0 {
        steps.push(
            Step::unknown("no message has come from the local publishers since somebody asked for it")
                .with_fix(format!("`sgc topic hz {topic}` shows whether they publish")),
        );
    } else if provides {
        steps.push(Step::fine(format!("{} messages were published to the far side", route.messages)));
    }
    traffic(&line, "went through here", steps);
    if steps.iter().any(|step| step.verdict == Verdict::Wrong) {
        return;
    }
    if route.is_written {
        if !readers(graph, kind, topic, &route.type_name, None, route.matched, steps) {
            // Messages of local publishers flow anyway; the permitted members need not publish here.
            if let Some(last) = steps.last_mut().filter(|_| provides && ends(graph, kind, topic).1.is_empty())
            {
                last.verdict = Verdict::Unknown;
                far_half(&route.granted.join(", "), topic, steps);
            }
            return;
        }
        steps.push(Step::fine(format!(
            "{} messages of others were given to the local network",
            route.written
        )));
    }
    far_half(&route.granted.join(", "), topic, steps);
}

/// Walks a use from the owner to the local subscribers, or from the local publishers to the owner.
fn walk_use(graph: &Graph, used: &Use, topic: &str, steps: &mut Walk) {
    let (node, owner, kind) = (&graph.node, &used.owner, used.kind);
    let wish = if used.publishes { "publishes on" } else { "brings" };
    steps.push(Step::fine(format!("a [[use]] {wish} {} of {owner}", used.topic)));
    if used.publishes {
        let (providers, _) = ends(graph, kind, topic);
        if providers.is_empty() {
            steps.push(no_provider(graph, kind, topic));
            return;
        }
        steps.push(Step::fine(format!("{} local {}s of {topic}", providers.len(), provider(kind))));
        steps.extend(unasserted(&providers, 0, "at the node that shares the topic"));
    }
    if !linked(graph, steps) {
        return;
    }
    if !used.is_token && !used.has_catalogue {
        let state = used.owner_state.as_deref().unwrap_or("has not said yet what it shares");
        let is_linked = graph.links.iter().any(|link| link.name.as_ref() == Some(owner));
        let why = match used.follow.as_deref() {
            Some("refused") => {
                "it is in reach and refuses this node: are both of one fleet, and is neither revoked?"
            }
            Some("asked") => "it is in reach and was asked; it has not answered",
            _ if is_linked => "it is linked to this node, and announces nothing that it shares",
            _ => {
                "nobody in reach knows it: is its node running, and linked to the same routers? Is its name spelt right?"
            }
        };
        let refused = state.strip_prefix("refuses its catalogue: ").and_then(refusals::fix_at_asker);
        let look = || match is_linked && used.follow.as_deref() != Some("asked") {
            true => format!(
                "if {owner} is a router, which shares nothing of its own: name in `from` the node beside the publishers"
            ),
            false => {
                format!("run `sgc status` on {owner}; its name in `from` has to be that of its identity")
            }
        };
        let fix = refused.map_or_else(look, str::to_owned);
        let meant =
            used.owner_meant.as_ref().filter(|_| !is_linked && used.follow.as_deref() != Some("refused"));
        let meant = meant.map_or_else(String::new, |meant| format!(" \"{meant}\" is here"));
        steps.push(Step::wrong(format!("{owner} {state}: {why}{meant}"), fix));
        return;
    }
    let routes: Vec<_> = used.routes.iter().filter(|route| route.topic == topic).collect();
    if routes.is_empty() {
        steps.push(unlisted(graph, used, &name_at_owner(used, topic)));
        return;
    }
    if !used.is_token {
        steps.push(Step::fine(format!("{owner} lists it for {node}")));
    }
    for route in routes {
        walk_use_route(graph, used, route, steps);
    }
}

/// Explains why a rule carries nothing although its owner is known.
fn unlisted(graph: &Graph, used: &Use, topic: &str) -> Step {
    let (node, owner) = (&graph.node, &used.owner);
    if used.is_token {
        return match &used.refused {
            Some(why) => Step::wrong(
                format!("{owner} refuses the token: {why}"),
                refusals::fix_at_asker(why).map_or_else(
                    || format!("ask {owner} for a new token (`sgc share-token`)"),
                    str::to_owned,
                ),
            ),
            None => Step::wrong(
                format!(
                    "{owner} has not granted what the token is for: nobody in reach knows the name, or it was not answered"
                ),
                format!("is {owner} running, and linked to a router that this node is linked to?"),
            ),
        };
    }
    let of_owner: Vec<_> = graph.offers.iter().filter(|offer| offer.owner_id == used.owner_id).collect();
    let same: Vec<_> =
        of_owner.iter().filter(|offer| offer.topic == topic && offer.kind == used.kind).collect();
    if let (Some(wanted), Some(offer)) =
        (&used.wanted_type, same.iter().find(|o| Some(&o.type_name) != used.wanted_type.as_ref()))
    {
        return Step::wrong(
            format!("{owner} shares {topic} as {}, and the [[use]] asks for {wanted}", offer.type_name),
            "change `type` in the [[use]], or leave it out",
        );
    }
    if let Some(offer) = same.first() {
        return if used.publishes && !offer.publish {
            Step::wrong(
                format!("{owner} shares {topic} with {node}, but does not let it publish"),
                format!("on {owner}: add \"{node}\" to `publish` of its [[share]], then `sgc reload`"),
            )
        } else if !used.publishes && !offer.subscribe {
            Step::wrong(
                format!("{owner} lets {node} publish on {topic}, but not subscribe"),
                format!(
                    "on {owner}: add \"{node}\" to `to` of its [[share]]; or set publish = true in the [[use]]"
                ),
            )
        } else {
            Step::wrong(
                format!(
                    "{owner} lists {topic}, but nothing of it runs here: {}",
                    told(graph, topic, "see the log")
                ),
                "look into the node's log, and at `sgc status`",
            )
        };
    }
    let other = of_owner.iter().find(|offer| offer.topic == topic);
    if let Some(offer) = other {
        return Step::wrong(
            format!("{owner} shares {topic} as a {}, and the [[use]] asks for a {}", offer.kind, used.kind),
            format!("write {} = \"{topic}\" in the [[use]]", offer.kind),
        );
    }
    if used.kind != Interface::Action && !is_for_wildcards(topic) {
        let (key, name) = match topic.split_once("/_action/") {
            Some((action, _)) => ("action", action),
            None if used.kind == Interface::Service => ("service", topic),
            None => ("topic", topic),
        };
        return Step::wrong(
            format!("{owner} is in reach and does not share {topic} with {node}"),
            format!("on {owner}: no wildcard shares it; name it, [[share]] {key} = \"{name}\""),
        );
    }
    let meant = hint(&near(topic, of_owner.iter().map(|offer| offer.topic.as_str())));
    Step::wrong(
        format!("{owner} is in reach and does not share {topic} with {node}{meant}"),
        format!(
            "on {owner}: is it in a [[share]] whose `to` has \"{node}\" or a group of it, and is it published there? `sgc why \
             {topic}` there says more"
        ),
    )
}

fn walk_use_route(graph: &Graph, used: &Use, route: &UseRoute, steps: &mut Walk) {
    let (owner, topic, kind) = (&used.owner, &route.topic, used.kind);
    if !route.is_granted {
        steps.push(match (&route.refused, route.join.as_deref()) {
            (Some(why), _) => Step::wrong(
                format!("{owner} refuses it: {why}"),
                refusals::fix_at_asker(why).map_or_else(
                    || {
                        let topic = &used.topic;
                        format!("on {owner}: `sgc why {topic}` names the entry that is missing; it is asked again by itself")
                    },
                    str::to_owned,
                ),
            ),
            (None, Some("waiting")) => Step::wrong(
                format!("{owner} listed it, but no way leads to it now"),
                format!("is {owner} running and linked? `sgc status` there"),
            ),
            (None, _) => Step::wrong(
                format!("asked {owner} for it; the answer is not here yet"),
                "wait a few seconds and ask again",
            ),
        });
        return;
    }
    steps.push(Step::fine(format!("{owner} granted it [{}]", route.type_name)));
    if route.lacks_definition {
        steps.push(no_definition(&route.type_name));
        return;
    }
    let line = graph.names.get(&route.name).cloned().unwrap_or_default();
    if let Some((link, cost)) = line.way {
        if graph.links.iter().any(|l| l.id == link && l.silent) {
            steps.push(silent(graph, link));
            return;
        }
        steps.push(Step::fine(format!(
            "the way to {owner}: {}, {} round trip",
            link_of(graph, link),
            millis(cost)
        )));
    }
    if !line.has_branch {
        steps.push(Step::wrong(
            "granted, but no branch leads here: the way broke and is being looked for",
            "wait a few seconds and ask again; if it stays, see `sgc status` for links that are silent",
        ));
        return;
    }
    if used.publishes {
        return walk_publishing(graph, used, route, &line, steps);
    }
    if kind != Interface::Topic {
        if route.writers == 0 {
            steps.push(Step::wrong(
                "granted, but nothing on the local network answers for it: DDS refused a server, or it is being made",
                "wait a few seconds and ask again; then look into the node's log for what DDS said",
            ));
            return;
        }
        steps.push(Step::fine(format!("local clients are answered for {owner}")));
        far_half(owner, &used.topic, steps);
        return;
    }
    if !readers(graph, kind, topic, &route.type_name, Some(route), route.matched, steps) {
        return;
    }
    if route.messages == 0 {
        steps.push(
            Step::unknown(format!("nothing has come from {owner} yet"))
                .with_fix(format!("run `sgc why {}` on {owner}: its publishers may be silent", used.topic)),
        );
    } else {
        steps.push(Step::fine(format!("{} messages were given to the local network", route.messages)));
    }
    traffic(&line, "came here", steps);
}

fn walk_publishing(graph: &Graph, used: &Use, route: &UseRoute, line: &NameLine, steps: &mut Walk) {
    let (owner, topic) = (&used.owner, &route.topic);
    let (providers, _) = ends(graph, used.kind, topic);
    if route.publishers == 0 {
        let types: BTreeSet<_> = providers.iter().map(|end| type_of(used.kind, end)).collect();
        let types: Vec<_> = types.into_iter().collect();
        steps.push(Step::wrong(
            format!(
                "{owner} takes it as {}, and the local publishers have {}",
                route.type_name,
                types.join(", ")
            ),
            "publish the type that the owner shares, or have the owner change its `type`",
        ));
        return;
    }
    if !route.is_read {
        steps.push(Step::wrong(
            "the local publishers are not read: the local network refused a reader",
            "look into the node's log for what DDS said",
        ));
        return;
    }
    if route.messages == 0 {
        steps.push(
            Step::unknown("no message has come from the local publishers yet")
                .with_fix(format!("`sgc topic hz --side local {topic}` shows whether they publish")),
        );
    } else {
        steps.push(Step::fine(format!("{} messages were published to {owner}", route.messages)));
    }
    traffic(line, "left here", steps);
    far_half(owner, &used.topic, steps);
}

/// Checks that local readers get the messages that are written for them. Returns `false` if there is a fault.
fn readers(
    graph: &Graph,
    kind: Interface,
    topic: &str,
    type_name: &str,
    route: Option<&UseRoute>,
    matched: u32,
    steps: &mut Walk,
) -> bool {
    let (_, all) = ends(graph, kind, topic);
    if all.is_empty() {
        let others = graph.endpoints.iter().filter(|e| e.is_ros_topic && !e.writes).map(|e| e.topic.as_str());
        let meant = hint(&near(topic, others));
        steps.push(Step::wrong(
            format!("nobody on this local network subscribes to {topic}{meant}"),
            "start a subscriber; if one runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
             ROS_AUTOMATIC_DISCOVERY_RANGE",
        ));
        return false;
    }
    let same: Vec<_> = all.iter().filter(|end| end.type_name == type_name).collect();
    if same.is_empty() {
        steps.push(Step::wrong(
            format!("the far side has {type_name}, and the local subscribers have {}", all[0].type_name),
            "the two never talk: use one type on both sides",
        ));
        return false;
    }
    if let Some(ours) = route.and_then(|route| route.type_hash.as_deref())
        && let Some(other) = same.iter().filter_map(|end| end.type_hash.as_deref()).find(|hash| *hash != ours)
    {
        steps.push(Step::wrong(
            format!(
                "the definitions of {type_name} differ: {} on the far side, {} here",
                short_hash(ours),
                short_hash(other)
            ),
            "build both sides from one version of the interface package",
        ));
        return false;
    }
    if let Some(route) = route {
        let mismatches: Vec<_> = same.iter().filter_map(|end| end.qos.mismatch(&route.qos)).collect();
        let say = |(policy, offered, asked): &(&str, String, String)| {
            format!("{policy}: {offered} is offered by the far side, {asked} is asked for")
        };
        match mismatches.first() {
            Some(first) if mismatches.len() == same.len() => {
                steps.push(Step::wrong(
                    format!("QoS does not match, by {}", say(first)),
                    format!("ask for no more in the subscriber, or offer more in the publisher: {}", first.0),
                ));
                return false;
            }
            Some(first) => steps.push(Step::unknown(format!(
                "{} of {} local subscribers get nothing: QoS does not match, by {}",
                mismatches.len(),
                same.len(),
                say(first)
            ))),
            None => {}
        }
        if route.writers == 0 {
            steps.push(Step::wrong(
                "no writer for it is on the local network: DDS refused one, or it is being made",
                "look into the node's log for what DDS said",
            ));
            return false;
        }
    }
    if matched == 0 {
        steps.push(Step::wrong(
            format!("{} local subscribers are there, and DDS matches none of them with this node", same.len()),
            "do they run in another security enclave (SROS2), with another partition, or behind a firewall for UDP?",
        ));
        return false;
    }
    steps.push(Step::fine(format!("{matched} local subscribers are matched")));
    true
}

/// Reports whether this node has a working link.
fn linked(graph: &Graph, steps: &mut Walk) -> bool {
    if let Some(link) = graph.links.iter().find(|link| !link.silent) {
        steps.push(Step::fine(format!("linked: {}", link_of(graph, link.id))));
        return true;
    }
    if let Some(link) = graph.links.first() {
        steps.push(silent(graph, link.id));
        return false;
    }
    let step = match graph.routers.first() {
        None => Step::wrong(
            "no link is up, and no router is configured",
            "name one: `routers` in [node], or `sgc run --router URL`",
        ),
        Some(search) => {
            let why = search.last_failure.as_deref().map(|why| format!(": {why}")).unwrap_or_default();
            let fix = search.last_failure.as_deref().and_then(refusals::fix_of_link).unwrap_or(
                "is the router running and in reach? Where UDP is blocked, a URL with tls:// or wss:// passes \
                 (docs/explanation/transports.md)",
            );
            Step::wrong(format!("no link is up; {} is {}{why}", search.router, search.state), fix)
        }
    };
    steps.push(step);
    false
}

fn no_provider(graph: &Graph, kind: Interface, topic: &str) -> Step {
    let (_, consumers) = ends(graph, kind, topic);
    let others = graph.endpoints.iter().filter(|e| e.is_ros_topic && e.writes).map(|e| e.topic.as_str());
    let meant = hint(&near(topic, others));
    let besides = match consumers.len() {
        0 => String::new(),
        n => format!(" ({n} {}s are there)", consumer(kind)),
    };
    Step::wrong(
        format!("no {} of {topic} is on the local network{besides}{meant}", provider(kind)),
        "start it; if it runs, compare `domain_id` and `discovery_range` in [ros] with its ROS_DOMAIN_ID and \
         ROS_AUTOMATIC_DISCOVERY_RANGE; `sgc topic list` shows what was discovered",
    )
}

fn silent(graph: &Graph, link: u32) -> Step {
    Step::wrong(
        format!("{} is silent: something should come over it and does not", link_of(graph, link)),
        "is the peer still there, and does the network between carry UDP? Another way is taken as soon as there is one",
    )
}

/// Reports the traffic of a name and its drops with their reasons.
fn traffic(line: &NameLine, what: &str, steps: &mut Walk) {
    if line.packets > 0 {
        let bytes = output::bytes(line.bytes);
        steps.push(Step::fine(format!("{} packets ({bytes}) {what}", line.packets)));
    }
    // Packets without a subscriber are no loss to anybody.
    let lost: BTreeMap<_, _> = line.dropped.iter().filter(|(reason, _)| *reason != "no_subscriber").collect();
    let Some((worst, _)) = lost.iter().max_by_key(|(_, count)| **count) else { return };
    let all: Vec<_> = lost.iter().map(|(reason, count)| format!("{reason} {count}")).collect();
    let (means, fix) = refusals::packet_drop(worst)
        .map_or(("for another reason", ""), |refusal| (refusal.means, refusal.fix));
    let fix = if fix.is_empty() { "`sgc status` shows all drops" } else { fix };
    let found = format!("dropped here: {} ({means})", all.join(", "));
    let total: u64 = lost.values().copied().sum();
    steps.push(if total > line.packets {
        Step::wrong(found, fix)
    } else {
        Step::unknown(found).with_fix(fix)
    });
}

fn no_definition(type_name: &str) -> Step {
    Step::wrong(
        format!(
            "its messages travel as JSON, and no definition of {type_name} is known here: none get through"
        ),
        "name a directory with packages that define it with `definitions` in [ros], or start the node where ROS 2 is sourced; \
         or take `encoding = \"json\"` out of the [[share]]",
    )
}

fn far_half(who: &str, topic: &str, steps: &mut Walk) {
    steps.push(
        Step::unknown(format!("all is well up to here; the other half of the way is known to {who}"))
            .with_fix(format!("run `sgc why {topic}` there")),
    );
}

/// Returns the problem that the node reports about a topic, or `otherwise`.
fn told(graph: &Graph, topic: &str, otherwise: &str) -> String {
    let begin = format!("{topic}: ");
    graph.problems.iter().find_map(|p| p.strip_prefix(&begin)).unwrap_or(otherwise).to_owned()
}

fn whom([nodes, groups, fleets]: [usize; 3]) -> String {
    let count = |n: usize, noun: &str| (n > 0).then(|| output::several(n as u64, noun));
    let all: Vec<_> = [count(nodes, "node"), count(groups, "group"), count(fleets, "whole fleet")]
        .into_iter()
        .flatten()
        .collect();
    if all.is_empty() { "nobody".to_owned() } else { all.join(", ") }
}

/// Shortens a hash to a length that still identifies it.
fn short_hash(hash: &str) -> String {
    hash.chars().take("RIHS01_".len() + 12).collect()
}
