//! The walk of an interface of another node, from the owner to the local subscribers or from the local publishers to
//! the owner.

use sgc_node::graph::{Graph, Interface, JoinState, NameLine, Use, UseRoute};
use sgc_ros::is_for_wildcards;

use super::local::{
    Written, dead_man, ends, far_half, line_of, linked, meant, name_at_owner, no_provider, problem_of,
    readers, silent, traffic, types_of, unasserted,
};
use crate::finding::{Direction, Finding, Hop, LocalFinding, Reach, UseFinding};
use crate::step::{Step, Walk};

fn fine(finding: UseFinding) -> Step {
    Step::fine(Finding::Use(finding))
}

fn wrong(finding: UseFinding) -> Step {
    Step::wrong(Finding::Use(finding))
}

/// Walks a use from the owner to the local subscribers, or from the local publishers to the owner.
pub(super) fn walk_use(graph: &Graph, used: &Use, topic: &str, steps: &mut Walk) {
    let (owner, kind) = (&used.owner, used.kind);
    steps.push(fine(UseFinding::Rule {
        publishes: used.publishes,
        topic: used.topic.clone(),
        owner: owner.clone(),
    }));
    if used.publishes {
        let (providers, _) = ends(graph, kind, topic);
        if providers.is_empty() {
            steps.push(no_provider(graph, kind, topic));
            return;
        }
        steps.push(Step::fine(Finding::Local(LocalFinding::Providers {
            count: providers.len(),
            kind,
            topic: topic.to_owned(),
            types: None,
        })));
        steps.extend(unasserted(&providers));
    }
    if !linked(graph, steps) {
        return;
    }
    if used.is_owner_revoked {
        steps.push(wrong(UseFinding::OwnerRevoked { owner: owner.clone() }));
        return;
    }
    if !used.is_token && !used.has_catalogue {
        steps.push(wrong(no_catalogue(graph, used)));
        return;
    }
    let routes: Vec<_> = used.routes.iter().filter(|route| route.topic == topic).collect();
    if routes.is_empty() {
        steps.push(wrong(unlisted(graph, used, name_at_owner(used, topic))));
        return;
    }
    if !used.is_token {
        steps.push(fine(UseFinding::Listed { owner: owner.clone(), node: graph.node.clone() }));
    }
    for route in routes {
        walk_route(graph, used, route, steps);
    }
}

/// Explains why an owner's catalogue has not arrived.
fn no_catalogue(graph: &Graph, used: &Use) -> UseFinding {
    let is_linked = graph.links.iter().any(|link| link.name.as_ref() == Some(&used.owner));
    let reach = match used.follow {
        Some(JoinState::Refused) => Reach::Refused { is_linked },
        Some(JoinState::Asked) => Reach::Asked { is_linked },
        _ if is_linked => Reach::Linked,
        _ => Reach::Unknown,
    };
    let may_be_misspelt = matches!(reach, Reach::Unknown | Reach::Asked { is_linked: false });
    UseFinding::NoCatalogue {
        owner: used.owner.clone(),
        state: used.owner_state.clone(),
        refusal: used.owner_refusal.clone(),
        reach,
        meant: used.owner_meant.clone().filter(|_| may_be_misspelt),
    }
}

/// Explains why a rule carries nothing although its owner is known.
fn unlisted(graph: &Graph, used: &Use, topic: String) -> UseFinding {
    let (node, owner) = (graph.node.clone(), used.owner.clone());
    if used.is_token {
        return match &used.refused {
            Some(reason) => UseFinding::TokenRefused { owner, reason: reason.clone() },
            None => UseFinding::TokenUnanswered { owner },
        };
    }
    let of_owner: Vec<_> = graph.offers.iter().filter(|offer| offer.owner_id == used.owner_id).collect();
    let same: Vec<_> =
        of_owner.iter().filter(|offer| offer.topic == topic && offer.kind == used.kind).collect();
    if let Some(wanted) = used.wanted_type.clone()
        && let Some(offer) = same.iter().find(|offer| offer.type_name != wanted)
    {
        return UseFinding::TypeDiffers { owner, topic, shared: offer.type_name.clone(), wanted };
    }
    if let Some(offer) = same.first() {
        return if used.publishes && !offer.publish {
            UseFinding::MayNotPublish { owner, topic, node }
        } else if !used.publishes && !offer.subscribe {
            UseFinding::MayNotSubscribe { owner, topic, node }
        } else {
            let problem = problem_of(graph, &topic);
            UseFinding::Idle { owner, topic, problem }
        };
    }
    if let Some(offer) = of_owner.iter().find(|offer| offer.topic == topic) {
        return UseFinding::KindDiffers { owner, topic, shared: offer.kind, wanted: used.kind };
    }
    if used.kind != Interface::Action && !is_for_wildcards(&topic) {
        let (kind, rule) = match topic.split_once("/_action/") {
            Some((action, _)) => (Interface::Action, action.to_owned()),
            None => (used.kind, topic.clone()),
        };
        return UseFinding::NotForWildcards { owner, topic, node, kind, rule };
    }
    let meant = meant(&topic, of_owner.iter().map(|offer| offer.topic.as_str()));
    UseFinding::NotShared { owner, topic, node, meant }
}

fn walk_route(graph: &Graph, used: &Use, route: &UseRoute, steps: &mut Walk) {
    let (topic, kind) = (&route.topic, used.kind);
    let owner = || used.owner.clone();
    let far_topic = || name_at_owner(used, topic);
    if !route.is_granted {
        steps.push(wrong(match (&route.refused, route.join) {
            // The owner's side knows no entry of it any more.
            (Some(reason), _) if used.is_token => {
                UseFinding::TokenRefused { owner: owner(), reason: reason.clone() }
            }
            (Some(reason), _) => {
                UseFinding::Refused { owner: owner(), reason: reason.clone(), topic: far_topic() }
            }
            (None, Some(JoinState::Waiting)) => UseFinding::NoRoute { owner: owner() },
            (None, _) => UseFinding::Unanswered { owner: owner() },
        }));
        return;
    }
    steps.push(fine(UseFinding::Granted { owner: owner(), type_name: route.type_name.clone() }));
    if route.lacks_definition {
        let type_name = route.type_name.clone();
        steps.push(Step::wrong(Finding::Local(LocalFinding::NoDefinition { type_name })));
        return;
    }
    let line = line_of(graph, &route.name);
    if let Some((link, rtt_us)) = line.way {
        if let Some(step) = silent(graph, link) {
            steps.push(step);
            return;
        }
        steps.push(fine(UseFinding::Route { owner: owner(), next: Hop::over(graph, link), rtt_us }));
        steps.extend(directness(graph, used, link).map(fine));
    }
    if !line.has_branch {
        steps.push(wrong(UseFinding::NoBranch));
        return;
    }
    if used.publishes {
        return walk_publishing(graph, used, route, &line, steps);
    }
    if kind != Interface::Topic {
        if route.writers == 0 {
            steps.push(wrong(UseFinding::NoServer));
            return;
        }
        steps.extend([fine(UseFinding::Answered { owner: owner() }), far_half(owner(), &far_topic())]);
        return;
    }
    let written =
        Written { kind, topic, type_name: &route.type_name, route: Some(route), matched: route.matched };
    if !readers(graph, &written, steps) {
        return;
    }
    steps.push(if route.messages == 0 {
        Step::unknown(Finding::Use(UseFinding::NoMessage { owner: owner(), topic: far_topic() }))
    } else {
        fine(UseFinding::Received {
            messages: route.messages,
            last_s: route.last_s,
            age: route.age_us.zip(route.age_error_us),
        })
    });
    traffic(&line, Direction::In, steps);
    steps.extend(route.dead_man.as_ref().map(|switch| dead_man(switch, topic)));
}

/// Returns whether the path to an owner over a link is direct, and why not. An earlier version does not tell the reason.
fn directness(graph: &Graph, used: &Use, link: u32) -> Option<UseFinding> {
    let owner = used.owner.clone();
    let mut links = graph.links.iter().filter(|link| link.peer == used.owner_id);
    if links.clone().any(|to_owner| to_owner.id == link) {
        return Some(UseFinding::Direct { owner });
    }
    if links.any(|to_owner| to_owner.is_direct && !to_owner.silent) {
        return Some(UseFinding::NotOverDirect { owner });
    }
    let peer = graph.not_direct.iter().find(|peer| peer.peer == used.owner_id)?;
    Some(UseFinding::Relayed { owner, reason: peer.reason })
}

fn walk_publishing(graph: &Graph, used: &Use, route: &UseRoute, line: &NameLine, steps: &mut Walk) {
    let owner = used.owner.clone();
    let (providers, _) = ends(graph, used.kind, &route.topic);
    if route.publishers == 0 {
        let (taken, types) = (route.type_name.clone(), types_of(used.kind, &providers));
        steps.push(wrong(UseFinding::TakesOther { owner, taken, types }));
        return;
    }
    if !route.is_read {
        steps.push(wrong(UseFinding::NotRead));
        return;
    }
    steps.push(if route.messages == 0 {
        Step::unknown(Finding::Use(UseFinding::NotPublished { topic: route.topic.clone() }))
    } else {
        fine(UseFinding::Published { messages: route.messages, owner: owner.clone() })
    });
    traffic(line, Direction::Out, steps);
    steps.push(far_half(owner, &name_at_owner(used, &route.topic)));
}
