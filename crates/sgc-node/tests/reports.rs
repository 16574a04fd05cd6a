//! Observers ask nodes of their fleet how they are doing, over a router that learns nothing of it.

#![allow(clippy::unwrap_used)]

#[path = "support/lab.rs"]
mod lab;
mod support;

use lab::*;
use sgc_node::admin::report::NodeReport;
use sgc_node::admin::{AdminRequest, AuditAnswer, ReportAnswer, ReportRequest};
use sgc_node::audit::AuditRecord;
use sgc_node::config::{AuthorityConfig, Recipient};
use sgc_node::graph::Graph;
use sgc_wire::Operation;
use support::*;

/// Returns a fleet with an authority `keeper`, an observer `desk`, and these nodes.
fn observed(nodes: &[&str]) -> Lab {
    let lab = Lab::new(&[]);
    lab.with_fleet(|fleet| fleet.set_authority(Some("keeper".parse().unwrap()), unix_now()).unwrap());
    lab.enroll("keeper", |_| {});
    lab.enroll("desk", |request| request.groups.push("observers".parse().unwrap()));
    nodes.iter().for_each(|node| lab.enroll(node, |_| {}));
    lab
}

fn keeper(lab: &Lab) -> Node {
    lab.start("keeper", |c| c.authority = Some(AuthorityConfig::new(lab.fleet_file())))
}

fn ask(node: &Node, nodes: &[&str], interface: Option<&str>) -> Vec<ReportAnswer> {
    let nodes = nodes.iter().map(|node| (*node).to_owned()).collect();
    let request = ReportRequest { nodes, interface: interface.map(str::to_owned), ping: false };
    let mut answer = node.ask(&AdminRequest::Report(request));
    serde_json::from_value(answer["ok"].take()).unwrap()
}

/// Asks one node until it gives a report; without a name, the authority.
fn report_of(asker: &Node, node: &str) -> NodeReport {
    let nodes: Vec<_> = [node].into_iter().filter(|node| !node.is_empty()).collect();
    let found = std::cell::RefCell::default();
    wait(&format!("a report of {node:?}"), || {
        found.replace(ask(asker, &nodes, None).remove(0).report);
        found.borrow().is_some()
    });
    found.take().unwrap()
}

fn graph_of(asker: &Node, node: &str, interface: &str) -> Graph {
    let text = ask(asker, &[node], Some(interface)).remove(0).graph.unwrap();
    serde_json::from_str(&text).unwrap()
}

fn ping(asker: &Node, node: &str) -> ReportAnswer {
    let request = ReportRequest { nodes: vec![node.to_owned()], ping: true, ..ReportRequest::default() };
    let mut answer = asker.ask(&AdminRequest::Report(request));
    serde_json::from_value::<Vec<_>>(answer["ok"].take()).unwrap().remove(0)
}

fn error_of(asker: &Node, node: &str) -> String {
    ask(asker, &[node], None).remove(0).error.unwrap_or_default()
}

#[test]
fn observer_learns_from_the_authority_who_is_there_and_from_each_node_how_it_is_doing() {
    let lab = observed(&["robot", "absent"]);
    let (_cloud, _keeper) = (lab.cloud(), keeper(&lab));
    let robot = lab.start("robot", |c| c.shares = vec![share("/chatter", &["desk"])]);
    let desk = lab.start("desk", |c| c.uses = vec![uses("/chatter")]);
    let (talker, listener) = (lab.talker("robot", "/chatter"), lab.listener("desk", "/chatter"));
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);

    // Without a name, the authority of the own identity is asked.
    let of_authority = report_of(&desk, "");
    assert_eq!(of_authority.node, "keeper");
    let members = of_authority.members.unwrap();
    let names: Vec<_> = members.iter().map(|member| member.name.as_str()).collect();
    assert_eq!(names, ["absent", "cloud", "desk", "keeper", "robot"]);
    let member = members.iter().find(|member| member.name == "robot").unwrap();
    assert_eq!((&member.id, member.router), (&lab.id("robot").to_string(), false));
    wait("the authority has seen the robot", || {
        let members = ask(&desk, &[], None).remove(0).report.and_then(|report| report.members);
        members.is_some_and(|all| all.iter().any(|member| member.name == "robot" && member.seen_ms.is_some()))
    });

    let report = report_of(&desk, "robot");
    assert_eq!((report.node.as_str(), report.has_ros, report.is_router), ("robot", true, false));
    assert_eq!(report.version, env!("CARGO_PKG_VERSION"));
    assert_eq!(report.secret_generation, Some(1));
    assert!(report.clock_ms.abs_diff(unix_now().0) < 60_000 && report.certificate_until_ms > unix_now().0);
    assert_eq!(report.links[0].peer, lab.id("cloud").to_string());
    let topic = &report.topics[0];
    assert_eq!((topic.direction.as_str(), topic.topic.as_str()), ("share", "/chatter"));
    assert!(topic.messages > 0 && report.members.is_none());
    // Others are asked beside one that is absent, and the own report is given, too.
    report_of(&desk, "cloud");
    let all = ask(&desk, &["robot", "absent", "absent", "desk", "cloud"], None);
    let seen: Vec<_> = all.iter().map(|answer| answer.report.as_ref().map(|r| r.is_router)).collect();
    assert_eq!(seen, [None, Some(true), Some(false), Some(false)], "by name: {all:?}");
    assert!(all[0].error.as_ref().is_some_and(|error| error.starts_with("it is not in reach")), "{all:?}");

    let of_topic = graph_of(&desk, "robot", "/chatter");
    assert_eq!((of_topic.node.as_str(), of_topic.shares[0].routes.len()), ("robot", 1));
    assert!(of_topic.endpoints.iter().any(|endpoint| endpoint.topic == "/chatter" && endpoint.writes));
    let other = graph_of(&desk, "robot", "/other");
    assert!(other.endpoints.is_empty() && other.shares[0].routes.is_empty() && other.names.is_empty());

    // A node that dies gives no more reports, and gives them again after its start.
    robot.kill();
    wait("it is gone", || ask(&desk, &["robot"], None).remove(0).error.is_some());
    let _robot = lab.start("robot", |_| {});
    assert_eq!(report_of(&desk, "robot").topics.len(), 0);
}

/// Returns the recipients of a report's first rule, the observers and the operators.
fn rights_of(asker: &Node, node: &str) -> [Vec<String>; 3] {
    let rights = report_of(asker, node).rights.unwrap();
    let to = rights.rules.first().map(|rule| rule.to.clone()).unwrap_or_default();
    [to, rights.observers, rights.operators]
}

#[test]
fn observer_learns_the_rights_that_a_configuration_gives_and_a_reload_changes_them() {
    let lab = observed(&["robot"]);
    let _cloud = lab.cloud();
    let mut authority = AuthorityConfig::new(lab.fleet_file());
    authority.operators = nodes(&["desk"]);
    let _keeper = lab.start("keeper", |c| c.authority = Some(authority));
    let robot = lab.start("robot", |c| {
        let mut wanted = share("/chatter", &["desk", "ghost"]);
        wanted.publish = vec![Recipient::Group("arms".parse().unwrap())];
        c.shares = vec![wanted];
    });
    let desk = lab.start("desk", |_| {});
    let words = |words: &[&str]| words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let observers = || words(&["group:observers"]);
    assert_eq!(rights_of(&desk, "robot"), [words(&["desk", "ghost"]), observers(), words(&[])]);
    let rule = report_of(&desk, "robot").rights.unwrap().rules.remove(0);
    assert_eq!((rule.kind.as_str(), rule.interface.as_str()), ("topic", "/chatter"));
    assert_eq!((rule.publish, rule.tokens, rule.omitted), (words(&["group:arms"]), vec![], 0));
    assert_eq!(rights_of(&desk, "keeper"), [words(&[]), observers(), words(&["desk"])]);
    robot.reload(|c| {
        c.shares = vec![share("/chatter", &["keeper"])];
        c.observers = Some(nodes(&["desk", "keeper"]));
    });
    // A report is given again for half a second.
    let changed = [words(&["keeper"]), words(&["desk", "keeper"]), words(&[])];
    wait("the new rights are reported", || rights_of(&desk, "robot") == changed);
}

#[test]
fn authority_reports_who_changed_the_fleet_and_other_nodes_report_no_events() {
    let lab = observed(&["robot", "guest"]);
    let _cloud = lab.cloud();
    let mut authority = AuthorityConfig::new(lab.fleet_file());
    authority.operators = nodes(&["desk"]);
    let keeper = lab.start("keeper", |c| c.authority = Some(authority));
    let (_robot, desk, guest) =
        (lab.start("robot", |_| {}), lab.start("desk", |_| {}), lab.start("guest", |_| {}));
    let revoke = |by: &Node| {
        let operation = Operation::Revoke { nodes: vec!["robot".to_owned()] };
        by.ask(&AdminRequest::Operate { at: "keeper".parse().unwrap(), operation })
    };
    wait("the guest is refused", || {
        let answer = revoke(&guest);
        answer["error"]
            .as_str()
            .is_some_and(|error| error.contains("does not take this node for an operator"))
    });
    assert!(revoke(&desk)["ok"].is_object());
    let events = report_of(&desk, "").events.unwrap();
    let find = |event: &str, peer: &str, detail: &str| {
        let peer = Some(peer.to_owned());
        events.iter().find(|one| one.event == event && one.peer == peer && one.detail == detail)
    };
    let done = find("operation", "desk", "revoke robot: done");
    assert!(done.is_some_and(|one| one.time_ms.abs_diff(unix_now().0) < 60_000), "{events:?}");
    assert!(find("refused", "guest", "an operation: it is no operator").is_some(), "{events:?}");
    assert!(events.iter().all(|one| !one.event.starts_with("link")), "{events:?}");
    assert_eq!(report_of(&desk, "cloud").events, None);
    assert_eq!(report_of(&desk, "desk").events, None);
    // The user of a node gets all of its events.
    let answer = keeper.ask(&AdminRequest::Audit)["ok"].take();
    let AuditAnswer { node, records } = serde_json::from_value(answer).unwrap();
    let records = records.unwrap();
    assert_eq!((node.as_str(), records[0].event.as_str()), ("keeper", "started"));
    assert!(records.iter().any(|record| record.event == "link_up"), "{records:?}");
    assert!(
        records.iter().any(|record| record.reason.as_deref() == Some("revoke robot: done")),
        "{records:?}"
    );
}

#[test]
fn node_that_is_no_observer_learns_nothing_and_a_reload_decides_anew() {
    let lab = observed(&["robot", "guest"]);
    let cloud = lab.cloud();
    let _keeper = keeper(&lab);
    let robot = lab.start("robot", |_| {});
    let (desk, guest) = (lab.start("desk", |_| {}), lab.start("guest", |_| {}));
    report_of(&desk, "robot");
    let refused = "it does not take the node here for an observer";
    wait("the guest is refused", || error_of(&guest, "robot").starts_with(refused));
    assert!(robot.drops("report_not_permitted") > 0);
    let is_refusal =
        |r: &AuditRecord| r.event == "refused" && r.reason.as_deref() == Some("a report: it is no observer");
    wait("the audit log has it", || lab.audit("robot").iter().any(is_refusal));
    // A router has no secret of the fleet, so it finds no node by its name, but it knows observers.
    assert!(error_of(&cloud, "robot").starts_with("this node is a router"));
    wait("the router refuses the guest", || error_of(&guest, "cloud").starts_with(refused));
    assert!(report_of(&desk, "cloud").is_router);
    cloud.reload(|c| c.observers = Some(vec![Recipient::Everyone]));
    report_of(&guest, "cloud");
    let report = cloud.reload(|c| c.observers = Some(nodes(&["guest"])));
    let warning = report["warnings"][0].as_str().unwrap();
    assert!(
        warning.starts_with("`observers` names \"guest\", which this node cannot recognise"),
        "{warning}"
    );
    wait("nobody is left", || error_of(&guest, "cloud").starts_with("it is not in reach"));

    let report = robot.reload(|c| c.observers = Some(nodes(&["guest"])));
    assert_eq!(report["changed"][0], "who may ask this node how it is doing changed");
    assert_eq!(report_of(&guest, "robot").node, "robot");
    assert!(error_of(&desk, "robot").starts_with(refused));
    robot.reload(|c| c.observers = Some(Vec::new()));
    wait("nobody is answered", || error_of(&guest, "robot").starts_with("it is not in reach"));
    robot.reload(|c| c.observers = None);
    report_of(&desk, "robot");
    // The authority decides for itself.
    wait("the authority refuses", || {
        let error = ask(&guest, &[], None).remove(0).error;
        error.is_some_and(|error| error.starts_with(refused))
    });
}

#[test]
fn observer_pings_nodes_and_learns_the_path() {
    let lab = observed(&["robot"]);
    let (_cloud, _keeper) = (lab.cloud(), keeper(&lab));
    let robot = lab.start("robot", |_| {});
    let desk = lab.start("desk", |_| {});
    wait("an answer", || ping(&desk, "robot").pong.is_some());
    let answer = ping(&desk, "robot");
    assert_eq!(answer.pong.map(|pong| pong.version).as_deref(), Some(env!("CARGO_PKG_VERSION")));
    assert!((1..10_000_000).contains(&answer.answered_us) && answer.error.is_none());
    let path = answer.path.unwrap();
    assert!(!path.direct && path.via == lab.url(), "{path:?}");
    let router = ping(&desk, "cloud").path.unwrap();
    assert!(router.direct && router.via == lab.url(), "{router:?}");
    let own = ping(&desk, "desk");
    assert!(own.pong.is_some() && own.path.is_none());
    // A node that is no observer gets no answer, and neither does one that asks a node that is off.
    let refused = |error: String| error.contains("observer");
    wait("a refusal", || ping(&robot, "desk").error.is_some_and(refused));
    robot.kill();
    wait("it is gone", || ping(&desk, "robot").error.is_some());
}
