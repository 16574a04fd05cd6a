//! The walk of an interface that this node shares, from the local publishers to the far side.

use std::collections::{BTreeMap, BTreeSet};

use sgc_node::graph::{Graph, Interface, Share, ShareRoute};

use super::local::{
    Written, dead_man, ends, far_half, line_of, linked, no_provider, problem_of, readers, silent, traffic,
    types_of, unasserted,
};
use crate::finding::{Direction, Finding, Hop, LocalFinding, ShareFinding};
use crate::step::{Step, Verdict, Walk};

fn fine(finding: ShareFinding) -> Step {
    Step::fine(Finding::Share(finding))
}

fn wrong(finding: ShareFinding) -> Step {
    Step::wrong(Finding::Share(finding))
}

/// Walks a share from the local publishers to the far side.
pub(super) fn walk_share(graph: &Graph, share: &Share, topic: &str, steps: &mut Walk) {
    let kind = share.kind;
    let (providers, _) = ends(graph, kind, topic);
    let routes: Vec<_> = share.routes.iter().filter(|route| route.topic == topic).collect();
    let takes_in = share.publish.iter().any(|n| *n > 0);
    if providers.is_empty() && !takes_in {
        steps.push(no_provider(graph, kind, topic));
        return;
    }
    if !providers.is_empty() {
        let types = types_of(kind, &providers);
        steps.push(Step::fine(Finding::Local(LocalFinding::Providers {
            count: providers.len(),
            kind,
            topic: topic.to_owned(),
            types: Some(types.clone()),
        })));
        if let Some(wanted) = share.wanted_type.as_ref().filter(|wanted| !types.contains(wanted)) {
            let (topic, wanted) = (topic.to_owned(), wanted.clone());
            steps.push(wrong(ShareFinding::TypeDiffers { kind, topic, wanted, types }));
            return;
        }
        let hashes: BTreeSet<_> = providers.iter().filter_map(|end| end.type_hash.clone()).collect();
        if let [type_name] = &types[..]
            && hashes.len() > 1
        {
            let (type_name, hashes) = (type_name.clone(), hashes.into_iter().collect());
            steps.push(Step::wrong(Finding::Local(LocalFinding::DefinitionsDiffer {
                kind,
                type_name,
                hashes,
            })));
            return;
        }
    }
    steps.push(fine(ShareFinding::Covered { to: share.to }));
    steps.extend(unasserted(&providers));
    let is_granted = routes.iter().any(|route| !route.granted.is_empty());
    for finding in unheard(graph, share) {
        // A misspelt name explains that no node has the topic.
        if matches!(finding, ShareFinding::Misspelt { .. }) && !is_granted {
            steps.push(wrong(finding));
            return;
        }
        steps.push(Step::unknown(Finding::Share(finding)));
    }
    if routes.is_empty() {
        let problem = problem_of(graph, topic);
        steps.push(wrong(ShareFinding::Idle { topic: topic.to_owned(), problem }));
        return;
    }
    if !linked(graph, steps) {
        return;
    }
    for route in &routes {
        walk_route(graph, share, route, !providers.is_empty(), steps);
    }
}

/// Returns the nodes that get a share directly, and those that do not with the reason.
fn directness(graph: &Graph, route: &ShareRoute, out: &[u32]) -> Vec<ShareFinding> {
    let is_granted = |name: &String| route.granted.contains(name);
    let direct = graph.links.iter().filter(|link| out.contains(&link.id));
    let direct: Vec<_> =
        direct.filter_map(|link| link.name.clone()).filter(|name| is_granted(name)).collect();
    let mut relayed: BTreeMap<_, Vec<String>> = BTreeMap::new();
    for peer in graph.not_direct.iter().filter(|peer| is_granted(&peer.name)) {
        relayed.entry(peer.reason).or_default().push(peer.name.clone());
    }
    let mut findings = Vec::new();
    if !direct.is_empty() {
        findings.push(ShareFinding::Direct { to: direct });
    }
    findings.extend(relayed.into_iter().map(|(reason, to)| ShareFinding::Relayed { to, reason }));
    findings
}

/// Returns the members that a share names and this node has never heard of, misspelt ones first.
fn unheard(graph: &Graph, share: &Share) -> Vec<ShareFinding> {
    let node = &graph.node;
    let misspelt = share.unheard.iter().filter_map(|member| {
        let meant = member.meant.clone()?;
        Some(ShareFinding::Misspelt { name: member.name.clone(), meant, node: node.clone() })
    });
    let mut findings: Vec<_> = misspelt.collect();
    let others = share.unheard.iter().filter(|member| member.meant.is_none());
    let names: Vec<_> = others.map(|member| member.name.clone()).collect();
    if !names.is_empty() {
        findings.push(ShareFinding::Unheard { names, node: node.clone() });
    }
    findings
}

fn walk_route(graph: &Graph, share: &Share, route: &ShareRoute, provides: bool, steps: &mut Walk) {
    let (topic, kind) = (&route.topic, share.kind);
    let far_topic = route.shared_as.as_ref().unwrap_or(topic);
    let refused = route.refused.iter().next().map(|(node, reason)| (node.clone(), reason.clone()));
    if route.granted.is_empty() {
        steps.push(wrong(match refused {
            Some((node, reason)) => ShareFinding::Refused { node, reason },
            None => ShareFinding::Unasked { kind, topic: far_topic.clone(), node: graph.node.clone() },
        }));
        return;
    }
    steps.push(fine(ShareFinding::Granted { to: route.granted.clone(), refused }));
    if route.lacks_definition {
        let type_name = route.type_name.clone();
        steps.push(Step::wrong(Finding::Local(LocalFinding::NoDefinition { type_name })));
        return;
    }
    let line = line_of(graph, &route.name);
    if !line.has_branch {
        steps.push(wrong(ShareFinding::NoBranch));
        return;
    }
    let out: Vec<_> = line.out.iter().copied().filter(|link| *link != 0).collect();
    if let Some(step) = out.iter().find_map(|link| silent(graph, *link)) {
        steps.push(step);
        return;
    }
    if !out.is_empty() {
        let over = out.iter().map(|link| Hop::over(graph, *link)).collect();
        steps.push(fine(ShareFinding::Leaves { over }));
        steps.extend(directness(graph, route, &out).into_iter().map(fine));
    }
    let far = || far_half(route.granted.join(", "), far_topic);
    if kind != Interface::Topic {
        if !route.is_written {
            steps.push(wrong(ShareFinding::NoCaller));
            return;
        }
        steps.extend([fine(ShareFinding::Called), far()]);
        return;
    }
    if let Some(finding) = definitions_differ(graph, route) {
        steps.push(wrong(finding));
        return;
    }
    if provides && !route.is_read {
        steps.push(wrong(ShareFinding::NotRead));
        return;
    }
    if provides && route.messages == 0 {
        steps.push(Step::unknown(Finding::Share(ShareFinding::NoMessage { topic: topic.clone() })));
    } else if provides {
        steps.push(fine(ShareFinding::Published { messages: route.messages }));
    }
    let (interval_us, bits_per_s) = (route.wished_interval_us, route.wished_bits_per_s);
    if interval_us.is_some() || bits_per_s.is_some() {
        steps.push(fine(ShareFinding::Wished { interval_us, bits_per_s }));
    }
    traffic(&line, Direction::Shared, steps);
    if steps.iter().any(|step| step.verdict == Verdict::Wrong) {
        return;
    }
    if let Some(switch) = &route.dead_man {
        steps.push(dead_man(switch, topic));
        if steps.iter().any(|step| step.verdict == Verdict::Wrong) {
            return;
        }
    }
    if route.is_written {
        let written =
            Written { kind, topic, type_name: &route.type_name, route: None, matched: route.matched };
        if !readers(graph, &written, steps) {
            // Messages of local publishers flow anyway; the permitted members need not publish here.
            if let Some(last) = steps.last_mut().filter(|_| provides && ends(graph, kind, topic).1.is_empty())
            {
                last.verdict = Verdict::Unknown;
                steps.push(far());
            }
            return;
        }
        steps.push(fine(ShareFinding::Written { messages: route.written }));
    }
    steps.push(far());
}

/// Returns a type whose definition differs between subscribers of another node and the publishers here.
fn definitions_differ(graph: &Graph, route: &ShareRoute) -> Option<ShareFinding> {
    let (publishers, _) = ends(graph, Interface::Topic, &route.topic);
    let here = publishers.iter().find_map(|end| end.type_hash.as_ref())?;
    let mut theirs =
        route.consumer_hashes.iter().flat_map(|(node, hashes)| hashes.iter().map(move |hash| (node, hash)));
    let (node, there) = theirs.find(|(_, hash)| *hash != here)?;
    Some(ShareFinding::DefinitionsDiffer {
        type_name: route.type_name.clone(),
        here: here.clone(),
        there: there.clone(),
        node: node.clone(),
    })
}
