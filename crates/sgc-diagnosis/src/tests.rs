//! Tests of every fault that a node can see, each in an otherwise sound document.

mod golden;
pub(crate) mod scenarios;

use sgc_node::admin::report::keep_interface;
use sgc_node::alerts::Alert;
use sgc_node::graph::{
    Endpoint, Graph, Interface, LostCalls, NameLine, Qos, ServiceCalls, Share, ShareRoute, UnheardMember, Use,
};
use sgc_transport::PeerRefusal;
use sgc_trust::CertError;
use sgc_wire::{RefuseReason, RejectReason};

use self::scenarios::{
    NAME, action_part, end, link, owner, owner_faults, pattern, publisher, publisher_faults, qos, sound,
    user, user_faults,
};
use crate::diagnose;
use crate::refusals::{CONTROL, DOOR, GATEWAY};
use crate::step::Verdict;

/// Returns the step with the fault, and its remedy.
fn wrong(graph: &Graph, topic: &str) -> String {
    let steps = diagnose::interface(graph, topic);
    let wrong: Vec<_> = steps.iter().filter(|step| step.verdict == Verdict::Wrong).collect();
    match wrong[..] {
        [] => String::new(),
        [step] => {
            assert_eq!(Some(step), steps.last(), "what is wrong comes last: {steps:?}");
            assert!(step.fix().as_ref().is_some_and(|fix| !fix.is_empty()));
            step.found()
        }
        _ => panic!("one thing is wrong at a time: {steps:?}"),
    }
}

fn named(graph: &Graph) -> Vec<(Verdict, String)> {
    diagnose::name(graph, NAME).into_iter().map(|step| (step.verdict, step.found())).collect()
}

#[test]
fn sound_node_has_no_fault() {
    for graph in [owner(), user(), publisher()] {
        let steps = diagnose::interface(&graph, "/a");
        assert!(steps.iter().all(|step| step.verdict != Verdict::Wrong), "{steps:?}");
        assert!(steps.len() > 4);
    }
    assert!(named(&owner()).iter().all(|(verdict, _)| *verdict == Verdict::Fine));
}

#[test]
fn each_fault_of_owner_is_named() {
    for (found, fault) in owner_faults() {
        let mut graph = owner();
        fault(&mut graph);
        let wrong = wrong(&graph, "/a");
        assert!(wrong.contains(found), "{wrong:?} is not {found:?}");
    }
}

/// The assertions of such publishers do not travel without a message.
#[test]
fn publishers_whose_assertions_are_not_seen_elsewhere_are_pointed_out() {
    let said = |graph: &Graph| {
        let steps = diagnose::interface(graph, "/a");
        steps.iter().any(|step| step.verdict == Verdict::Unknown && step.found().contains("MANUAL_BY_TOPIC"))
    };
    let with = |mut graph: Graph, liveliness, lease_ms: u64| {
        graph.endpoints[0].qos = Qos { liveliness, lease_ns: Some(lease_ms * 1_000_000), ..qos() };
        graph
    };
    assert!(said(&with(owner(), 2, 99)) && !said(&with(owner(), 2, 100)) && !said(&with(owner(), 0, 99)));
    assert!(said(&with(publisher(), 2, 99)) && !said(&with(publisher(), 2, 100)) && !said(&publisher()));
    assert_eq!(wrong(&with(publisher(), 2, 99), "/a"), "", "it is no fault of the topic");
}

/// Another node's report of an interface has the same faults as the whole document there.
#[test]
fn graph_that_was_reduced_to_an_interface_has_the_same_fault() {
    let sides =
        [(owner as fn() -> Graph, owner_faults()), (user, user_faults()), (publisher, publisher_faults())];
    for (make, faults) in sides {
        for (found, fault) in faults {
            let mut graph = make();
            fault(&mut graph);
            let whole = wrong(&graph, "/a");
            keep_interface(&mut graph, "/a");
            let reduced = wrong(&graph, "/a");
            // The names of other interfaces, one of which may be meant, are not there.
            assert!(!reduced.is_empty() && whole.starts_with(&reduced), "{found}: {reduced:?}, {whole:?}");
        }
    }
}

#[test]
fn each_fault_of_user_is_named() {
    for (found, fault) in user_faults() {
        let mut graph = user();
        fault(&mut graph);
        let wrong = wrong(&graph, "/a");
        assert!(wrong.contains(found), "{wrong:?} is not {found:?}");
    }
}

/// Returns the remedy of the step with the fault.
fn fix(graph: &Graph) -> String {
    let steps = diagnose::interface(graph, "/a");
    let step = steps.into_iter().find(|step| step.verdict == Verdict::Wrong);
    step.and_then(|step| step.fix()).unwrap_or_default()
}

#[test]
fn refused_link_has_the_remedy_of_its_reason() {
    let failed = |why: &str| {
        let mut graph = user();
        graph.links.clear();
        graph.routers[0].last_failure = Some(format!("quic://r: 10.0.0.1:7447: {why}"));
        fix(&graph)
    };
    let foreign = format!("refused: {}", CertError::UnknownIssuer);
    assert!(failed(&foreign).contains("of which fleet this node's identity is"), "{}", failed(&foreign));
    let over = format!("the peer refused this node: {}", PeerRefusal::Expired);
    assert!(failed(&over).contains("`sgc fleet renew`"), "{}", failed(&over));
    assert!(failed("no answer").contains("is the router running"), "{}", failed("no answer"));
}

#[test]
fn router_in_from_is_distinguished_from_unreachable_node() {
    let mut graph = user();
    graph.uses[0].has_catalogue = false;
    graph.links[0].name = Some("arm".into());
    assert!(wrong(&graph, "/a").contains("it is linked to this node, and announces nothing"));
    assert!(fix(&graph).contains("name in `from` the node beside the publishers"));
}

#[test]
fn pattern_that_would_cover_missing_topic_is_named() {
    let mut graph = owner();
    graph.endpoints.clear();
    graph.shares[0].topic = "/**".into();
    graph.shares[0].routes.clear();
    let said = wrong(&graph, "/a");
    assert!(
        said.contains("nobody on the local network has /a, which the [[share]] of /** would cover"),
        "{said}"
    );
}

#[test]
fn refused_topic_has_remedy_of_its_reason_at_both_ends() {
    for (why, at_owner, at_asker) in [
        (RefuseReason::NotPermitted.to_string(), "add it to `to`", "names the entry that is missing"),
        (RefuseReason::Revoked.to_string(), "`sgc fleet enroll` it again", "`sgc fleet enroll` it again"),
        (RefuseReason::Limit.to_string(), "has room for 4096", "no place for another subscriber"),
        (RefuseReason::Clock.to_string(), "compare `date -u`", "compare `date -u`"),
    ] {
        let mut graph = owner();
        graph.shares[0].routes[0].granted.clear();
        graph.shares[0].routes[0].refused = [("desk".to_owned(), why.clone())].into();
        assert!(fix(&graph).contains(at_owner), "{why}: {}", fix(&graph));
        let mut graph = user();
        graph.uses[0].routes[0].is_granted = false;
        graph.uses[0].routes[0].refused = Some(why.clone());
        assert!(fix(&graph).contains(at_asker), "{why}: {}", fix(&graph));
    }
    let mut graph = user();
    graph.uses[0].has_catalogue = false;
    graph.uses[0].owner_state = Some(format!("refuses its catalogue: {}", RejectReason::Limit));
    graph.uses[0].owner_refusal = Some(RejectReason::Limit.to_string());
    assert!(fix(&graph).contains("no place for more branches or requests"), "{}", fix(&graph));
}

#[test]
fn refusals_and_their_peers_precede_walk() {
    let mut graph = user();
    graph.drops = [
        ("crl_flood".to_owned(), 9),
        ("crl_flood from link 1".to_owned(), 7),
        ("crl_flood from link 2".to_owned(), 2),
        ("unknown".to_owned(), 30),
    ]
    .into();
    graph.refused = [("too_many_from_address".to_owned(), 400), ("revoked".to_owned(), 3)].into();
    graph.gateway_refused = [("too many clients of one credential".to_owned(), 5)].into();
    let steps = diagnose::interface(&graph, "/a");
    let said = steps.iter().filter(|step| step.verdict == Verdict::Unknown && step.fix().is_some());
    let said: Vec<_> = said.map(|step| step.found()).take(4).collect();
    assert!(
        said[0].starts_with("peers refused a link: too_many_from_address 400 (too many were"),
        "{said:?}"
    );
    assert!(said[1].starts_with("refused here: crl_flood 9, of these 7 over link 1 to cloudclo"), "{said:?}");
    assert!(
        said[2].starts_with("programs refused at the gateway: too many clients of one credential 5"),
        "{said:?}"
    );
    assert!(said[3].starts_with("peers refused a link: revoked 3"), "{said:?}");
    // Refusals that a sound network causes are not reported.
    assert!(!steps.iter().any(|step| step.found().contains("unknown 30")));
    // A router, which knows only names, reports the same.
    assert!(named(&graph).iter().any(|(_, found)| found.contains("crl_flood 9")));
    // Only the most frequent refusals are reported.
    let all = CONTROL.iter().filter(|refusal| refusal.is_named);
    graph.drops.extend(all.map(|refusal| (refusal.key.to_owned(), 1)));
    let steps = diagnose::interface(&graph, "/a");
    assert_eq!(steps.iter().filter(|step| step.found().starts_with("refused here: ")).count(), 8 - 3);
}

#[test]
fn refusals_are_reported_with_remedy_unless_sound_network_causes_them() {
    for (place, table) in [CONTROL, DOOR, GATEWAY].into_iter().enumerate() {
        for refusal in table {
            let mut graph = sound();
            let counts = match place {
                0 => &mut graph.drops,
                1 => &mut graph.refused,
                _ => &mut graph.gateway_refused,
            };
            counts.insert(refusal.key.to_owned(), 3);
            let said = format!("{} 3 ({})", refusal.key, refusal.means);
            let steps = diagnose::name(&graph, NAME);
            let step = steps.iter().find(|step| step.found().contains(&said));
            assert_eq!(step.is_some(), refusal.is_named, "{refusal:?}");
            assert!(step.is_none_or(|step| step.verdict == Verdict::Unknown));
            assert!(step.is_none_or(|step| step.fix().unwrap_or_default() == refusal.fix), "{refusal:?}");
        }
    }
}

#[test]
fn each_fault_of_remote_publisher_is_named() {
    for (found, fault) in publisher_faults() {
        let mut graph = publisher();
        fault(&mut graph);
        let wrong = wrong(&graph, "/a");
        assert!(wrong.contains(found), "{wrong:?} is not {found:?}");
    }
}

#[test]
fn services_and_actions_have_clients_and_servers() {
    for (kind, topic, type_name, shared) in [
        (Interface::Service, "rq/aRequest", "x/srv/S_Request", "x/srv/S"),
        (Interface::Action, "rq/a/_action/send_goalRequest", "x/action/A_SendGoal_Request", "x/action/A"),
    ] {
        let mut graph = owner();
        graph.shares[0].kind = kind;
        let server = Endpoint {
            topic: topic.into(),
            type_name: type_name.into(),
            is_ros_topic: false,
            writes: false,
            ..Endpoint::default()
        };
        graph.endpoints = vec![server];
        graph.shares[0].routes[0].is_written = true;
        assert_eq!(wrong(&graph, "/a"), "");
        graph.shares[0].wanted_type = Some(shared.into());
        assert_eq!(wrong(&graph, "/a"), "");
        graph.endpoints[0].writes = true;
        assert!(
            wrong(&graph, "/a").contains("no server of /a is on the local network (1 clients are there)")
        );
    }
}

#[test]
fn age_of_the_last_message_is_shown() {
    let shown = |last_s| {
        let mut graph = user();
        graph.uses[0].routes[0].last_s = last_s;
        let steps = crate::diagnose::interface(&graph, "/a");
        steps.iter().map(|step| step.finding.to_string()).find(|text| text.contains("were given")).unwrap()
    };
    assert_eq!(
        shown(Some(0)),
        "3 messages were given to the local network, the last one less than a second ago"
    );
    assert_eq!(shown(Some(7)), "3 messages were given to the local network, the last one 7 s ago");
    assert_eq!(shown(None), "3 messages were given to the local network", "an older node does not say");
}

#[test]
fn action_is_walked_by_its_parts() {
    let mut graph = action_part("send_goal");
    graph.uses.extend(action_part("get_result").uses);
    assert_eq!(wrong(&graph, "/fib"), "");
    assert_eq!(wrong(&graph, "/fib/_action/get_result"), "");
    let mut feedback = action_part("feedback").uses;
    feedback[0].kind = Interface::Topic;
    graph.uses.extend(feedback);
    assert_eq!(wrong(&graph, "/fib"), "", "nobody here has to use the action");
    assert!(wrong(&graph, "/fib/_action/feedback").contains("nobody on this local network subscribes"));
    graph.uses[1].routes[0].writers = 0;
    assert!(wrong(&graph, "/fib").contains("nothing on the local network answers for it"));
    assert_eq!(wrong(&graph, "/fib/_action/send_goal"), "");
    assert!(wrong(&graph, "/other").contains("nobody on the local network has /other"));
}

#[test]
fn wildcards_and_renames_are_followed() {
    let mut graph = owner();
    graph.shares[0].topic = "/**".into();
    assert_eq!(wrong(&graph, "/a"), "");
    graph.shares[0].routes.clear();
    assert!(wrong(&graph, "/a").contains("covered by a rule, but not shared"));
    let mut graph = user();
    graph.uses[0].topic = "/x".into();
    graph.uses[0].routes.clear();
    assert!(wrong(&graph, "/a").contains("arm is in reach and does not share /x with here"));
    graph.uses[0].topic = "/**".into();
    graph.uses[0].local_topic = "/**".into();
    graph.offers[0].topic = "/robot/a".into();
    assert!(
        wrong(&graph, "/a")
            .contains("arm is in reach and does not share /a with here; did you mean /robot/a?")
    );
}

#[test]
fn other_patterns_are_no_fault_of_healthy_topic() {
    let mut graph = user();
    graph.uses[0].topic = "/**".into();
    graph.uses[0].local_topic = "/**".into();
    graph.uses.insert(0, pattern(Interface::Service, "arm"));
    graph.uses.push(pattern(Interface::Topic, "leg"));
    graph.uses.push(Use { publishes: true, ..pattern(Interface::Topic, "arm") });
    // The arm also permits this node to publish, and no program here does.
    let mut there = graph.uses[1].routes[0].clone();
    (there.publishers, there.is_granted) = (0, true);
    graph.uses[3].routes.push(there);
    assert_eq!(wrong(&graph, "/a"), "");
    // A fault of the topic itself still counts.
    graph.uses[1].routes[0].writers = 0;
    assert!(wrong(&graph, "/a").contains("no writer for it is on the local network"));

    let mut graph = owner();
    graph.shares[0].topic = "/**".into();
    let unasked = ShareRoute { granted: vec![], is_read: false, ..graph.shares[0].routes[0].clone() };
    graph.shares.push(Share {
        kind: Interface::Service,
        topic: "/**".into(),
        routes: vec![unasked],
        ..Share::default()
    });
    assert_eq!(wrong(&graph, "/a"), "");
}

#[test]
fn broken_named_rule_is_fault_beside_healthy_one() {
    let mut graph = user();
    let literal =
        |owner| Use { topic: "/a".into(), local_topic: "/a".into(), ..pattern(Interface::Topic, owner) };
    graph.uses.push(literal("leg"));
    assert!(wrong(&graph, "/a").contains("leg is in reach and does not share /a with here"));
    // It is no fault if no program here takes part in that direction.
    let mut both_ways = user();
    both_ways.uses.push(Use { publishes: true, ..literal("arm") });
    assert_eq!(wrong(&both_ways, "/a"), "");
    both_ways.uses.remove(0);
    assert!(wrong(&both_ways, "/a").contains("no publisher of /a is on the local network"));
    let mut shared = owner();
    shared.shares[0].publish = [1, 0, 0];
    shared.shares[0].routes[0].is_written = true;
    assert_eq!(wrong(&shared, "/a"), "");
}

#[test]
fn covering_patterns_are_chosen_by_kind() {
    let patterns = |graph: &mut Graph| {
        graph.uses = vec![pattern(Interface::Service, "arm"), pattern(Interface::Topic, "arm")];
        graph.uses[1].topic = "/robot/**".into();
        graph.uses[1].local_topic = "/**".into();
    };
    let mut graph = user();
    patterns(&mut graph);
    graph.offers[0].topic = "/robot/b".into();
    let said = wrong(&graph, "/a");
    assert!(
        said.contains("arm is in reach and does not share /robot/a with here; did you mean /robot/b?"),
        "{said}"
    );
    // The local programs match no pattern.
    graph.endpoints = vec![end("/a", true)];
    assert!(wrong(&graph, "/a").contains("1 local publishers have it, but no rule names it"));
    graph.endpoints = vec![end("/rosout", false)];
    let steps = diagnose::interface(&graph, "/rosout");
    assert!(steps.last().unwrap().found().contains("does not share /robot/rosout"), "{steps:?}");
    graph.uses[1].topic = "/**".into();
    let steps = diagnose::interface(&graph, "/rosout");
    let fix = steps.last().unwrap().fix().unwrap_or_default();
    assert!(fix.contains("no wildcard shares it; name it, [[share]] topic = \"/rosout\""), "{steps:?}");
}

#[test]
fn incompatible_subscribers_beside_matched_ones_are_no_fault() {
    let mut graph = user();
    graph.endpoints.push(end("/a", false));
    graph.endpoints[1].qos.durability = 1;
    assert_eq!(wrong(&graph, "/a"), "");
    let steps = diagnose::interface(&graph, "/a");
    assert!(
        steps
            .iter()
            .any(|s| s.verdict == Verdict::Unknown && s.found().starts_with("1 of 2 local subscribers"))
    );
}

#[test]
fn routers_know_names() {
    let last = |graph: &Graph| named(graph).pop().unwrap();
    let mut graph = sound();
    graph.names.clear();
    assert!(last(&graph).1.starts_with("nobody in reach advertises it"));
    graph.names = [(NAME.to_owned(), NameLine { way: Some((1, 1)), ..NameLine::default() })].into();
    assert!(last(&graph).1.starts_with("nobody asked for it over this router"));
    let mut graph = sound();
    graph.links[0].silent = true;
    assert!(last(&graph).1.contains("is silent"));
}

/// Returns the first finding of a walk with this verdict.
fn found(graph: &Graph, verdict: Verdict) -> Option<String> {
    let steps = diagnose::interface(graph, "/a");
    steps.into_iter().find(|step| step.verdict == verdict).map(|step| step.found())
}

#[test]
fn operator_mistakes_come_first() {
    let place = || "203.0.113.5:7447".to_owned();
    let displaced = Alert::Displaced { node: "here".into(), place: place(), ago_s: 3 };
    let kept_out = Alert::IdentityInUse { node: "here".into(), place: place(), ago_s: 3 };
    let early = Alert::ClockBeforeCertificate { not_before: "2026".into(), now: "1970".into() };
    let clock = Alert::ClocksDiffer { peer: "cloud".into(), remote: place(), ahead_ms: 7_200_000 };
    let over = Alert::CertificateOver { not_after: "2026".into(), now: "2031".into() };
    for alert in [displaced, early, over] {
        let unlinked = Graph { alerts: vec![alert.clone()], links: vec![], ..owner() };
        assert_eq!(found(&unlinked, Verdict::Wrong), Some(alert.to_string()));
        // With links up, the alert is over or about to end.
        let linked = Graph { alerts: vec![alert.clone()], ..owner() };
        assert_eq!(found(&linked, Verdict::Unknown), Some(alert.to_string()));
        assert_eq!(found(&linked, Verdict::Wrong), None);
    }
    let graph = Graph { alerts: vec![kept_out.clone()], ..owner() };
    assert_eq!(
        (found(&graph, Verdict::Unknown), found(&graph, Verdict::Wrong)),
        (Some(kept_out.to_string()), None)
    );
    // The clock of the only peer, or of one of two.
    let graph = Graph { alerts: vec![clock.clone()], ..user() };
    assert_eq!(found(&graph, Verdict::Wrong), Some(clock.to_string()));
    let mut graph = Graph { alerts: vec![clock.clone()], ..user() };
    graph.links.push(link(2, "routerrouter"));
    assert_eq!(
        (found(&graph, Verdict::Unknown), found(&graph, Verdict::Wrong)),
        (Some(clock.to_string()), None)
    );
    let at_router = diagnose::name(&Graph { alerts: vec![clock.clone()], ..sound() }, NAME);
    assert_eq!(
        at_router.last().map(|step| (step.verdict, step.found())),
        Some((Verdict::Wrong, clock.to_string()))
    );
}

#[test]
fn unknown_member_names_are_reported() {
    let named =
        |name: &str, meant: Option<&str>| UnheardMember { name: name.into(), meant: meant.map(Into::into) };
    let mut graph = owner();
    graph.shares[0].unheard = vec![named("lamp", None), named("deks", Some("desk"))];
    assert_eq!(wrong(&graph, "/a"), "", "others have it");
    let hints: Vec<_> = diagnose::interface(&graph, "/a")
        .into_iter()
        .filter(|step| step.verdict == Verdict::Unknown)
        .map(|step| step.found())
        .collect();
    assert_eq!(hints[0], "the [[share]] names \"deks\", which nobody here is called; \"desk\" is here");
    assert!(
        hints[1].starts_with("the [[share]] names \"lamp\", and no member of that name has been heard of")
    );
    // If no node has the topic, the unknown name is the reason.
    graph.shares[0].routes[0].granted.clear();
    assert!(wrong(&graph, "/a").contains("names \"deks\", which nobody here is called"));
    assert!(fix(&graph).contains("if \"desk\" is meant, correct it in the file of here"));
    graph.shares[0].unheard.pop();
    assert_eq!(wrong(&graph, "/a"), "nobody asked for it");
}

#[test]
fn advice_for_other_side_has_the_name_of_that_side() {
    let advice = |graph: &Graph| diagnose::interface(graph, "/a").last().and_then(|step| step.fix()).unwrap();
    let mut graph = owner();
    graph.shares[0].routes[0].shared_as = Some("/arm/a".into());
    assert_eq!(advice(&graph), "run `sgc why /arm/a` there");
    graph.shares[0].routes[0].granted.clear();
    assert!(advice(&graph).contains("topic = \"/arm/a\"; if it is there, run `sgc why /arm/a`"));
    // A pattern has no path of its own at its owner.
    let mut graph = publisher();
    (graph.uses[0].topic, graph.uses[0].local_topic) = ("/**".into(), "/**".into());
    assert_eq!(advice(&graph), "run `sgc why /a` there");
    graph.uses[0].routes[0].is_granted = false;
    graph.uses[0].routes[0].refused = Some("not listed".into());
    assert!(advice(&graph).contains("`sgc why /a` names the entry"));
}

#[test]
fn lost_calls_are_fault_until_calls_are_answered() {
    let lost = |reason: &str, since_answer, last_s| {
        let mut graph = owner();
        let by = [("/caller".to_owned(), 2)].into();
        let lost = LostCalls { reason: reason.into(), count: 3, since_answer, by, last_s };
        graph.calls = vec![ServiceCalls { topic: "/a".into(), is_served: false, lost: vec![lost] }];
        graph
    };
    let wrong = |graph: &Graph| {
        let steps = diagnose::interface(graph, "/a");
        steps.into_iter().filter(|step| step.verdict == Verdict::Wrong).collect::<Vec<_>>()
    };
    let fault = wrong(&lost("call_server_gone", 3, 5));
    let said = "/a: 3 calls of clients here got no answer, among them 2 of /caller, the last 5 s ago: call_server_gone";
    assert!(fault.len() == 1 && fault[0].found().starts_with(said), "{fault:?}");
    assert!(fault[0].fix().as_ref().unwrap().contains("start the server again"));
    for graph in
        [lost("call_server_gone", 0, 5), lost("call_server_gone", 3, 601), lost("call_client_gone", 3, 5)]
    {
        assert_eq!(wrong(&graph), []);
        let steps = diagnose::interface(&graph, "/a");
        assert!(steps.iter().any(|step| step.found().contains("3 calls of clients here got no answer")));
    }
    // Another fault comes last, as the only one.
    let mut graph = lost("call_withdrawn", 3, 5);
    graph.links.clear();
    let fault = wrong(&graph);
    assert!(fault.len() == 1 && fault[0].found().contains("no link is up"), "{fault:?}");
}
