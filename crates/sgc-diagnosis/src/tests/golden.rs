//! The words of `sgc why`: the output for many documents, compared with a committed file.

use std::fmt::Write as _;
use std::path::Path;

use sgc_node::admin::not_direct::{NotDirectPeer, NotDirectReason};
use sgc_node::alerts::Alert;
use sgc_node::graph::{
    Endpoint, Graph, Interface, JoinState, Link, LostCalls, NameLine, Qos, ServiceCalls, Share, ShareRoute,
    UnheardMember, Use,
};
use sgc_transport::PeerRefusal;
use sgc_trust::CertError;
use sgc_wire::RefuseReason;

use super::scenarios::{
    Case, NAME, REFUSED_WITH_REMEDY, REJECTED, action_part, end, link, owner, owner_faults, pattern,
    publisher, publisher_faults, qos, sound, user, user_faults,
};
use crate::diagnose;

const COMMITTED: &str = "src/tests/golden.txt";
/// The variable that has the file written anew.
const GENERATE: &str = "SGC_GENERATE";

/// A document, and the steps of its walk as `sgc why` prints them.
struct Scenario {
    title: String,
    lines: Vec<String>,
}

#[test]
fn words_of_findings_are_the_committed_ones() {
    let mut text = String::new();
    for Scenario { title, lines } in scenarios() {
        let _ = writeln!(text, "# {title}\n{}\n", lines.join("\n"));
    }
    let json =
        serde_json::to_string(&diagnose::interface(&Graph { links: vec![], ..owner() }, "/a")).unwrap();
    let _ = writeln!(text, "# JSON\n{json}");
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(COMMITTED);
    if std::env::var_os(GENERATE).is_some() {
        std::fs::write(&file, &text).unwrap();
        return;
    }
    let committed = std::fs::read_to_string(&file).unwrap();
    let same = committed.split('\n').zip(text.split('\n')).take_while(|(old, new)| old == new).count();
    // A text that ends here has no such line.
    let [old, new] = [&committed, &text].map(|text| text.split('\n').nth(same));
    let line = same + 1;
    assert!(
        committed == text,
        "`sgc why` says something else than {COMMITTED}. If that is meant, `{GENERATE}=1 cargo test -p sgc-diagnosis` writes \
         the file anew. First difference, in line {line}: {old:?} became {new:?}"
    );
}

fn scenarios() -> Vec<Scenario> {
    let mut all = Vec::new();
    for (side, make, faults) in [
        ("owner", owner as fn() -> Graph, owner_faults()),
        ("user", user, user_faults()),
        ("publisher", publisher, publisher_faults()),
    ] {
        all.push(topic(side, &make()));
        for (found, fault) in faults.into_iter().chain(more_faults(side)) {
            let mut graph = make();
            fault(&mut graph);
            all.push(topic(&format!("{side}: {found}"), &graph));
        }
    }
    all.extend(alerts());
    all.extend(lost_calls());
    all.extend(services_and_actions());
    all.extend(reasons());
    all.extend(patterns());
    all.extend(counters());
    all.extend(names());
    all
}

fn lines(step: &crate::Step) -> Vec<String> {
    step.lines().iter().map(ToString::to_string).collect()
}

fn topic(title: &str, graph: &Graph) -> Scenario {
    asked(title, graph, "/a")
}

fn asked(title: &str, graph: &Graph, topic: &str) -> Scenario {
    let steps = diagnose::interface(graph, topic);
    Scenario { title: title.to_owned(), lines: steps.iter().flat_map(lines).collect() }
}

/// Returns faults and findings beside those of the tables that other tests have.
fn more_faults(side: &str) -> Vec<Case> {
    match side {
        "owner" => vec![
            ("granted to some, refused to others", |g| {
                g.shares[0].routes[0].refused = [("lamp".to_owned(), "not listed".to_owned())].into();
            }),
            ("has not sent a message", |g| g.shares[0].routes[0].messages = 0),
            ("a link on the way is silent", |g| {
                g.links.push(Link { name: Some("r2".into()), silent: true, ..link(2, "routerrouter") });
                g.names.get_mut(NAME).unwrap().out = vec![1, 2, 7];
            }),
            ("leaves over unlisted links", |g| g.names.get_mut(NAME).unwrap().out = vec![0, 1, 7]),
            ("takes in from others", |g| {
                g.shares[0].publish = [1, 2, 1];
                g.shares[0].to = [0, 0, 0];
                g.shares[0].routes[0].is_written = true;
                g.shares[0].routes[0].matched = 2;
                g.shares[0].routes[0].written = 4;
                g.endpoints.push(end("/a", false));
            }),
            ("takes in, and nobody here subscribes", |g| {
                g.shares[0].publish = [1, 0, 0];
                g.shares[0].routes[0].is_written = true;
            }),
            ("only takes in, and nobody here subscribes", |g| {
                g.shares[0].publish = [1, 0, 0];
                g.shares[0].routes[0].is_written = true;
                g.endpoints.clear();
            }),
            ("only takes in, and the type differs", |g| {
                g.shares[0].publish = [1, 0, 0];
                g.shares[0].routes[0].is_written = true;
                g.endpoints = vec![Endpoint { type_name: "x/msg/Y".into(), ..end("/a", false) }];
            }),
            ("only takes in, and DDS matches nobody", |g| {
                g.shares[0].publish = [1, 0, 0];
                g.shares[0].routes[0].is_written = true;
                g.endpoints = vec![end("/a", false)];
            }),
            ("some drops, and the worst has no remedy", |g| {
                g.names.get_mut(NAME).unwrap().dropped =
                    [("link_closed".to_owned(), 1), ("no_such_sink".to_owned(), 2)].into();
            }),
            ("drops for an unknown reason", |g| {
                g.names.get_mut(NAME).unwrap().dropped = [("from_the_future".to_owned(), 2)].into();
            }),
            ("covered for groups and fleets", |g| g.shares[0].to = [2, 1, 1]),
            ("covered by a rule, nothing runs", |g| g.shares[0].routes.clear()),
            ("short leases by hand", |g| {
                g.endpoints[0].qos = Qos { liveliness: 2, lease_ns: Some(1), ..qos() };
            }),
            ("names of members", |g| {
                let named = |name: &str, meant: Option<&str>| UnheardMember {
                    name: name.into(),
                    meant: meant.map(Into::into),
                };
                g.shares[0].unheard = vec![named("lamp", None), named("deks", Some("desk"))];
            }),
            ("a misspelt name is the reason", |g| {
                g.shares[0].unheard = vec![UnheardMember { name: "deks".into(), meant: Some("desk".into()) }];
                g.shares[0].routes[0].granted.clear();
            }),
            ("a direct link to one of two subscribers, and a third one at a router", |g| {
                g.shares[0].routes[0].granted = ["desk", "hut", "lamp"].map(str::to_owned).into();
                g.links.push(Link { name: Some("desk".into()), is_direct: true, ..link(2, "deskdesk") });
                g.names.get_mut(NAME).unwrap().out.push(2);
                g.not_direct = not_direct(&[
                    ("hut", NotDirectReason::Blocked),
                    ("lamp", NotDirectReason::NotWanted),
                    ("of_another_topic", NotDirectReason::Blocked),
                ]);
            }),
            ("no interface of the local network, and a pattern", |g| {
                g.endpoints.clear();
                g.shares[0].topic = "/**".into();
                g.shares[0].routes.clear();
            }),
            ("another rule of the same topic is refused", |g| {
                let unasked = ShareRoute { granted: vec![], ..g.shares[0].routes[0].clone() };
                g.shares.push(Share { topic: "/**".into(), routes: vec![unasked], ..Share::default() });
            }),
        ],
        "user" => vec![
            ("nothing came yet", |g| g.uses[0].routes[0].messages = 0),
            ("a direct link to the owner", |g| {
                g.links.push(Link { name: Some("arm".into()), is_direct: true, ..link(2, "1d") });
                g.names.get_mut(NAME).unwrap().way = Some((2, 900));
            }),
            ("a direct link to the owner that is not taken", |g| {
                g.links.push(Link { name: Some("arm".into()), is_direct: true, ..link(2, "1d") });
            }),
            ("no packet passes to the owner directly", |g| {
                g.not_direct = not_direct(&[("1d", NotDirectReason::Blocked)]);
            }),
            ("the owner permits no direct link", |g| {
                g.not_direct = not_direct(&[("1d", NotDirectReason::Refused)]);
            }),
            ("a direct path to the owner is being looked for", |g| {
                g.not_direct = not_direct(&[("1d", NotDirectReason::First)]);
            }),
            ("linked to an owner that announces nothing", |g| {
                g.uses[0].has_catalogue = false;
                g.links[0].name = Some("arm".into());
            }),
            ("the token of a running use was withdrawn", |g| {
                g.uses[0].is_token = true;
                g.uses[0].routes[0].is_granted = false;
                g.uses[0].routes[0].refused = Some("the owner does not share it with this node".into());
            }),
            ("the owner was revoked", |g| {
                g.uses[0].routes[0].is_granted = false;
                g.uses[0].is_owner_revoked = true;
            }),
            ("asked an owner that is linked", |g| {
                g.uses[0].has_catalogue = false;
                g.uses[0].follow = Some(JoinState::Asked);
                g.links[0].name = Some("arm".into());
            }),
            ("an owner without name shares it", |g| {
                g.uses.clear();
                g.offers[0].is_used = false;
                g.offers[0].owner = None;
            }),
            ("an owner lets this node publish", |g| {
                g.uses.clear();
                g.offers[0].is_used = false;
                g.offers[0].subscribe = false;
            }),
            ("an owner shares a service", |g| {
                g.uses.clear();
                g.offers[0].is_used = false;
                g.offers[0].kind = Interface::Service;
            }),
            ("listed, and nothing runs", |g| g.uses[0].routes.clear()),
            ("listed, and a problem is known", |g| {
                g.uses[0].routes.clear();
                g.problems = vec!["/b: no".into(), "/a: too many".into()];
            }),
            ("a token that is not answered", |g| {
                g.uses[0].is_token = true;
                g.uses[0].routes.clear();
            }),
            ("a token that is refused for a known reason", |g| {
                g.uses[0].is_token = true;
                g.uses[0].routes.clear();
                g.uses[0].refused = Some(RefuseReason::Limit.to_string());
            }),
            ("a token that works", |g| g.uses[0].is_token = true),
            ("hashes are short", |g| {
                g.endpoints[0].type_hash = Some(format!("RIHS01_{}", "b".repeat(64)));
                g.uses[0].routes[0].type_hash = Some(format!("RIHS01_{}", "a".repeat(64)));
            }),
            ("one of two subscribers does not match", |g| {
                g.endpoints.push(end("/a", false));
                g.endpoints[1].qos.durability = 1;
            }),
            ("subscribers of another name", |g| g.endpoints[0].topic = "/A".into()),
            ("an alias", |g| {
                g.uses[0].topic = "/far/a".into();
                g.uses[0].routes[0].messages = 0;
            }),
            ("an alias that is not shared", |g| {
                g.uses[0].topic = "/far/a".into();
                g.uses[0].routes.clear();
            }),
            ("linked again and again", |g| {
                g.links.clear();
                g.routers[0].last_failure = Some(format!("quic://r: {}", CertError::UnknownIssuer));
            }),
        ],
        _ => vec![
            ("has not published", |g| g.uses[0].routes[0].messages = 0),
            ("asserts liveliness by hand", |g| {
                g.endpoints[0].qos = Qos { liveliness: 2, lease_ns: Some(1), ..qos() };
            }),
        ],
    }
}

/// Returns peers without a direct link, whose names are their ids.
fn not_direct(peers: &[(&str, NotDirectReason)]) -> Vec<NotDirectPeer> {
    let peer = |(name, reason): &(&str, NotDirectReason)| NotDirectPeer {
        peer: (*name).to_owned(),
        name: (*name).to_owned(),
        reason: *reason,
    };
    peers.iter().map(peer).collect()
}

fn alerts() -> Vec<Scenario> {
    let place = || "203.0.113.5:7447".to_owned();
    let displaced = Alert::Displaced { node: "here".into(), place: place(), ago_s: 3 };
    let kept_out = Alert::IdentityInUse { node: "here".into(), place: place(), ago_s: 3 };
    let clock = Alert::ClocksDiffer { peer: "cloud".into(), remote: place(), ahead_ms: 7_200_000 };
    let mut two = owner();
    two.links.push(link(2, "routerrouter"));
    let with = |alerts: &[&Alert], graph: Graph| Graph {
        alerts: alerts.iter().map(|alert| (*alert).clone()).collect(),
        ..graph
    };
    vec![
        topic("alert without links", &with(&[&displaced, &kept_out], Graph { links: vec![], ..owner() })),
        topic("alert with links", &with(&[&displaced, &kept_out], owner())),
        topic("the clock of the only peer", &with(&[&clock], owner())),
        topic("the clock of one peer of two", &with(&[&clock], two)),
        name("the clock of the only peer, at a router", &with(&[&clock], sound())),
    ]
}

fn lost_calls() -> Vec<Scenario> {
    let lost = |reason: &str, since_answer, last_s, is_served| {
        let mut graph = owner();
        let by = [("/caller".to_owned(), 2), ("/other".to_owned(), 1)].into();
        let lost = LostCalls { reason: reason.into(), count: 3, since_answer, by, last_s };
        graph.calls = vec![ServiceCalls { topic: "/a".into(), is_served, lost: vec![lost] }];
        graph
    };
    let mut nobody = lost("call_forgotten", 1, 5, false);
    nobody.calls[0].lost[0].by.clear();
    let unlinked = Graph { links: vec![], ..lost("call_withdrawn", 3, 5, false) };
    vec![
        topic("calls lost to a server that is gone", &lost("call_server_gone", 3, 5, false)),
        topic("calls lost before others were answered", &lost("call_server_gone", 0, 5, true)),
        topic("calls lost long ago", &lost("call_server_gone", 3, 601, true)),
        topic("calls of clients that ended", &lost("call_client_gone", 3, 5, true)),
        topic("calls overrun", &lost("overrun", 3, 5, true)),
        topic("calls lost for an unknown reason", &lost("from_the_future", 3, 5, true)),
        topic("calls of nobody that is left", &nobody),
        topic("calls lost for want of a link", &unlinked),
    ]
}

fn services_and_actions() -> Vec<Scenario> {
    let mut all = Vec::new();
    for (kind, dds, type_name) in [
        (Interface::Service, "rq/aRequest", "x/srv/S_Request"),
        (Interface::Action, "rq/a/_action/send_goalRequest", "x/action/A_SendGoal_Request"),
    ] {
        let server = |writes| Endpoint {
            topic: dds.into(),
            type_name: type_name.into(),
            is_ros_topic: false,
            writes,
            ..Endpoint::default()
        };
        let mut graph = owner();
        graph.shares[0].kind = kind;
        graph.endpoints = vec![server(false)];
        all.push(topic(&format!("{kind} that is not called yet"), &graph));
        graph.shares[0].routes[0].is_written = true;
        all.push(topic(&format!("{kind} of this node"), &graph));
        graph.shares.clear();
        all.push(topic(&format!("{kind} that no rule shares"), &graph));
        graph.endpoints[0].writes = true;
        all.push(topic(&format!("{kind} that no rule brings"), &graph));
        let mut graph = owner();
        graph.shares[0].kind = kind;
        graph.endpoints = vec![server(true)];
        all.push(topic(&format!("{kind} without a server"), &graph));
        let mut graph = user();
        graph.uses[0].kind = kind;
        graph.endpoints = vec![server(true)];
        all.push(topic(&format!("{kind} of another node"), &graph));
        graph.uses[0].routes.clear();
        graph.offers.clear();
        all.push(topic(&format!("{kind} that is not shared"), &graph));
        graph.endpoints.clear();
        graph.uses[0].topic = "/a/_action/send_goal".into();
        all.push(topic(&format!("{kind} that is a part"), &graph));
    }
    let mut graph = user();
    graph.uses[0] = pattern(Interface::Service, "arm");
    graph.offers.clear();
    graph.endpoints =
        vec![Endpoint { topic: "rq/n/_hiddenRequest".into(), writes: true, ..Endpoint::default() }];
    all.push(asked("service that wildcards leave out", &graph, "/n/_hidden"));
    let mut graph = user();
    graph.uses[0] = pattern(Interface::Topic, "arm");
    graph.offers.clear();
    graph.endpoints = vec![end("/rosout", false)];
    all.push(asked("topic that wildcards leave out", &graph, "/rosout"));
    let mut graph = action_part("send_goal");
    graph.uses.extend(action_part("get_result").uses);
    all.push(asked("parts of an action", &graph, "/fib"));
    let mut idle = graph.clone();
    for topic in ["feedback", "status"] {
        let mut part = action_part(topic).uses;
        part[0].kind = Interface::Topic;
        idle.uses.extend(part);
    }
    all.push(asked("action without a client here", &idle, "/fib"));
    graph.uses[1].routes[0].writers = 0;
    all.push(asked("parts of an action of which one fails", &graph, "/fib"));
    all.push(asked("no action", &graph, "/other"));
    all.push(asked("a name without slash", &graph, "other"));
    all
}

/// Refusals of joins and links.
fn reasons() -> Vec<Scenario> {
    let walked = [RefuseReason::NotPermitted, RefuseReason::NotShared];
    let refused = walked.iter().chain(&REFUSED_WITH_REMEDY).map(|reason| reason.to_string());
    let rejected = REJECTED.iter().map(|reason| reason.to_string());
    let mut all = Vec::new();
    for why in refused.chain(rejected) {
        let mut graph = owner();
        graph.shares[0].routes[0].granted.clear();
        graph.shares[0].routes[0].refused = [("desk".to_owned(), why.clone())].into();
        all.push(last(&format!("owner refused: {why}"), &graph));
        let mut graph = user();
        graph.uses[0].routes[0].is_granted = false;
        graph.uses[0].routes[0].refused = Some(why.clone());
        all.push(last(&format!("user is refused: {why}"), &graph));
        let mut graph = user();
        graph.uses[0].has_catalogue = false;
        graph.uses[0].follow = Some(JoinState::Refused);
        graph.uses[0].owner_state = Some(format!("refuses its catalogue: {why}"));
        graph.uses[0].owner_refusal = Some(why.clone());
        all.push(last(&format!("the catalogue is refused: {why}"), &graph));
    }
    let peers = [
        PeerRefusal::OtherCa,
        PeerRefusal::NotAdmitted,
        PeerRefusal::Expired,
        PeerRefusal::Revoked,
        PeerRefusal::NoCertificate,
    ];
    let peers = peers.map(|why| format!("the peer refused this node: {why}"));
    for why in peers.into_iter().chain([format!("refused: {}", CertError::UnknownIssuer), "no answer".into()])
    {
        let mut graph = user();
        graph.links.clear();
        graph.routers[0].last_failure = Some(why.clone());
        all.push(last(&format!("no link: {why}"), &graph));
    }
    all
}

/// Keeps the last step.
fn last(title: &str, graph: &Graph) -> Scenario {
    let steps = diagnose::interface(graph, "/a");
    Scenario { title: title.to_owned(), lines: steps.last().map(lines).unwrap_or_default() }
}

fn patterns() -> Vec<Scenario> {
    let mut others = user();
    others.uses[0].topic = "/**".into();
    others.uses[0].local_topic = "/**".into();
    others.uses.insert(0, pattern(Interface::Service, "arm"));
    others.uses.push(pattern(Interface::Topic, "leg"));
    others.uses.push(Use { publishes: true, ..pattern(Interface::Topic, "arm") });
    let mut there = others.uses[1].routes[0].clone();
    (there.publishers, there.is_granted) = (0, true);
    others.uses[3].routes.push(there);
    let mut covered = user();
    covered.uses = vec![pattern(Interface::Service, "arm"), pattern(Interface::Topic, "arm")];
    covered.uses[1].topic = "/robot/**".into();
    covered.offers[0].topic = "/robot/b".into();
    let mut named = user();
    let literal = Use {
        topic: "/a".into(),
        local_topic: "/a".into(),
        publishes: true,
        ..pattern(Interface::Topic, "leg")
    };
    named.uses.push(literal);
    vec![
        topic("patterns beside a healthy rule", &others),
        topic("a pattern that covers an idle topic", &covered),
        topic("a named rule beside a healthy one", &named),
    ]
}

/// Counters on which an operator has to act.
fn counters() -> Vec<Scenario> {
    let mut graph = user();
    graph.links.push(Link { name: Some("cloud".into()), rtt_us: 12_345, ..link(3, "cloudcloud") });
    graph.drops = [
        ("crl_flood".to_owned(), 9),
        ("crl_flood from link 1".to_owned(), 7),
        ("crl_flood from link 3".to_owned(), 2),
        ("replays_full".to_owned(), 1),
        ("unknown".to_owned(), 30),
    ]
    .into();
    graph.refused = [("too_many_from_address".to_owned(), 400), ("revoked".to_owned(), 3)].into();
    graph.gateway_refused = [("too many clients of one credential".to_owned(), 5)].into();
    vec![topic("counters", &graph), name("counters at a router", &Graph { uses: vec![], ..graph })]
}

fn names() -> Vec<Scenario> {
    let with = |line: NameLine| Graph { names: [(NAME.to_owned(), line)].into(), ..sound() };
    let branch =
        NameLine { has_branch: true, out: vec![0, 1, 4], packets: 2, bytes: 2000, ..NameLine::default() };
    let mut silent = with(NameLine { way: Some((0, 0)), ..branch.clone() });
    silent.links[0].silent = true;
    let mut silent_way = sound();
    silent_way.links[0].silent = true;
    let dropped = [("stale".to_owned(), 9), ("wrong_way".to_owned(), 1)].into();
    vec![
        name("name", &sound()),
        name("name that nobody advertises", &Graph { names: [].into(), ..sound() }),
        name("name that nobody asked for", &with(NameLine { way: Some((1, 1)), ..NameLine::default() })),
        name("name of this node", &with(NameLine { way: Some((0, 0)), ..branch.clone() })),
        name("name with a silent branch", &silent),
        name("name with a silent way", &silent_way),
        name("name with drops", &with(NameLine { way: Some((9, 1500)), dropped, ..branch })),
    ]
}

fn name(title: &str, graph: &Graph) -> Scenario {
    let steps = diagnose::name(graph, NAME);
    Scenario { title: title.to_owned(), lines: steps.iter().flat_map(lines).collect() }
}
