//! Searches for routers: by DNS from a test server, by mDNS on the loopback interface, and one link per router.

#![allow(clippy::unwrap_used)]

#[path = "support/dns.rs"]
mod dns;
#[path = "support/lab.rs"]
mod lab;
mod support;

use std::collections::BTreeSet;

use dns::{DnsServer, Record};
use lab::*;
use serde_json::Value;
use sgc_node::config::{Config, RouterUrl, TokenConfig, TokenSource};
use sgc_transport::{ListenAddr, Scheme};
use sgc_trust::{ShareToken, TopicSecret};
use sgc_wire::UnixMillis;
use support::*;

fn urls(urls: &[&str]) -> Vec<RouterUrl> {
    urls.iter().map(|url| url.parse().unwrap()).collect()
}

/// Starts a router of the lab.
fn router(lab: &Lab, node: &str, port: u16, mdns: Option<u16>, change: impl FnOnce(&mut Config)) -> Node {
    let ip = if mdns.is_some() { [0, 0, 0, 0] } else { [127, 0, 0, 1] };
    let listen = vec![ListenAddr::new(Scheme::Quic, (ip, port).into())];
    let mut config = Config { routers: vec![], listen, announce: mdns.is_some(), ..lab.config(node) };
    change(&mut config);
    Node::start_near(config, lab.identity(node), None, mdns)
}

/// Starts a node that only searches for these routers.
fn seeker(lab: &Lab, node: &str, routers: &[&str], resolver: Option<&DnsServer>, mdns: Option<u16>) -> Node {
    let resolver = resolver.map(|dns| dns.addr);
    let config = Config { routers: urls(routers), resolver, ..lab.config(node) };
    Node::start_near(config, lab.identity(node), None, mdns)
}

/// Creates a lab with a second router, and a node that only searches.
fn lab_of_two_routers() -> Lab {
    let lab = Lab::new(&["seeker"]);
    lab.enroll("cloud2", |request| request.router = true);
    lab
}

fn links(node: &Node) -> usize {
    node.status()["links"].as_array().unwrap().len()
}

/// Returns the status rows of searches of this kind.
fn found_by(node: &Node, by: &str) -> Vec<Value> {
    let status = node.status();
    status["routers"].as_array().unwrap().iter().filter(|line| line["found_by"] == by).cloned().collect()
}

fn is_linked_to(node: &Node, lab: &Lab, router: &str) -> bool {
    node.peers() == BTreeSet::from([lab.id(router).to_string()])
}

#[test]
fn the_router_that_dns_names_is_found_and_the_next_when_it_goes() {
    let lab = lab_of_two_routers();
    let (first, second) = (router(&lab, "cloud", 0, None, |_| {}), router(&lab, "cloud2", 0, None, |_| {}));
    let ports = [&first, &second].map(|node| node.addr.unwrap().port());
    let dns = DnsServer::start();
    dns.set_host("r1.lab.example.", [127, 0, 0, 1]);
    dns.set_host("r2.lab.example.", [127, 0, 0, 1]);
    let srv = |priority, port, host: &str| Record::srv(priority, 0, port, host);
    dns.set(
        "_sgc._udp.lab.example.",
        vec![srv(20, ports[1], "r2.lab.example."), srv(10, ports[0], "r1.lab.example.")],
    );
    let node = seeker(&lab, "seeker", &["srv://lab.example"], Some(&dns), None);
    wait("a link to the best", || is_linked_to(&node, &lab, "cloud"));
    let line = &found_by(&node, "srv")[0];
    assert_eq!(line["router"], "srv://lab.example");
    assert_eq!(line["at"], format!("quic://r1.lab.example:{}", ports[0]));
    assert_eq!((line["state"].as_str(), line["failures"].as_u64()), (Some("linked"), Some(0)));
    assert_eq!(line["peer"], lab.id("cloud").to_string());

    first.stop();
    wait("a link to the next", || is_linked_to(&node, &lab, "cloud2"));
    // The second one ends too, and the best is back.
    let first = router(&lab, "cloud", ports[0], None, |_| {});
    second.stop();
    wait("a link to the best again", || is_linked_to(&node, &lab, "cloud"));
    drop(first);
}

#[test]
fn dns_faults_are_reported() {
    let lab = Lab::new(&["seeker"]);
    let dns = DnsServer::start();
    let node = seeker(&lab, "seeker", &["srv://lab.example"], Some(&dns), None);
    let says =
        |what: &str| found_by(&node, "srv")[0]["last_failure"].as_str().is_some_and(|s| s.contains(what));
    wait("no record", || says("DNS has no record _sgc._udp.lab.example"));
    dns.set("_sgc._udp.lab.example.", vec![Record::srv(0, 0, 0, ".")]);
    wait("not offered", || says("this domain offers no routers"));
    dns.set("_sgc._udp.lab.example.", vec![Record::srv(0, 0, 0, "r1.lab.example.")]);
    wait("useless", || says("name no host and port that can be dialled"));
    dns.set("_sgc._udp.lab.example.", vec![Record::srv(0, 0, 7447, "nowhere.lab.example.")]);
    wait("no address", || says("nowhere.lab.example has no address in DNS"));
    // DNS lists more targets than are kept, and only one of the best works.
    let cloud = router(&lab, "cloud", 0, None, |_| {});
    dns.set_host("r1.lab.example.", [127, 0, 0, 1]);
    let wrong = |n: u16| Record::srv(100 + n, 0, 7447, &format!("n{n}.lab.example."));
    let right = Record::srv(1, 0, cloud.addr.unwrap().port(), "r1.lab.example.");
    dns.set("_sgc._udp.lab.example.", (0..20).map(wrong).chain([right]).collect());
    wait("the right one", || is_linked_to(&node, &lab, "cloud"));
}

#[test]
fn a_host_is_looked_up_where_the_configuration_says() {
    let lab = Lab::new(&["seeker"]);
    let cloud = router(&lab, "cloud", 0, None, |_| {});
    let dns = DnsServer::start();
    dns.set_host("router.nowhere.", [127, 0, 0, 1]);
    let url = format!("quic://router.nowhere:{}", cloud.addr.unwrap().port());
    let node = seeker(&lab, "seeker", &[&url], Some(&dns), None);
    wait("a link", || is_linked_to(&node, &lab, "cloud"));
}

#[test]
fn two_ways_to_one_router_make_one_link_and_the_other_takes_over() {
    let lab = Lab::new(&["seeker"]);
    let cloud = router(&lab, "cloud", 0, None, |_| {});
    let port = cloud.addr.unwrap().port();
    let (one, two) = (format!("quic://127.0.0.1:{port}"), format!("quic://localhost:{port}"));
    let node = seeker(&lab, "seeker", &[&one, &two], None, None);
    let states = || -> BTreeSet<String> {
        found_by(&node, "static").iter().map(|line| line["state"].as_str().unwrap().to_owned()).collect()
    };
    let both = BTreeSet::from(["linked".to_owned(), "standing back".to_owned()]);
    wait("one is linked, the other stands back", || states() == both);
    assert_eq!((links(&node), links(&cloud)), (1, 1));
    let standing =
        found_by(&node, "static").into_iter().find(|line| line["state"] == "standing back").unwrap();
    assert!(standing["last_failure"].as_str().unwrap().contains("to which there is a link already"));
    assert!(standing["again_in_s"].as_u64().unwrap() > 60);
    cloud.stop();
    wait("neither", || links(&node) == 0);
    let cloud = router(&lab, "cloud", port, None, |_| {});
    // Whichever link ended, the search that stood back did not wait for its full time.
    wait("one is linked again", || states() == both);
    assert_eq!((links(&node), links(&cloud)), (1, 1));
}

#[test]
fn a_router_on_the_local_network_is_found_lost_and_found_again() {
    let lab = lab_of_two_routers();
    let mdns = Some(begin());
    let node = seeker(&lab, "seeker", &["mdns://"], None, mdns);
    let cloud = router(&lab, "cloud", 0, mdns, |_| {});
    wait("a link", || is_linked_to(&node, &lab, "cloud"));
    let line = found_by(&node, "mdns").into_iter().find(|line| line["state"] == "linked").unwrap();
    assert_eq!(line["peer"], lab.id("cloud").to_string());
    cloud.stop();
    wait("it is gone", || links(&node) == 0 && found_by(&node, "mdns").len() == 1);
    // The router returns at another port, as after a restart.
    let cloud = router(&lab, "cloud", 0, mdns, |_| {});
    wait("it is found again", || is_linked_to(&node, &lab, "cloud"));
    // The router is killed, and another one appears.
    cloud.kill();
    let cloud2 = router(&lab, "cloud2", 0, mdns, |_| {});
    wait("the other is found", || is_linked_to(&node, &lab, "cloud2"));
    drop(cloud2);
}

#[test]
fn strangers_and_proxies_on_the_local_network_are_not_linked() {
    let lab = lab_of_two_routers();
    lab.enroll("liar", |_| {});
    let other = Lab::new(&[]);
    let mdns = Some(begin());
    // One is a router of another fleet, the other a member that is no router.
    let stranger = router(&other, "cloud", 0, mdns, |_| {});
    let liar = router(&lab, "liar", 0, mdns, |_| {});
    let node = seeker(&lab, "seeker", &["mdns://"], None, mdns);
    wait("the stranger is refused", || stranger.refused("other_ca") > 0);
    wait("the liar is let go", || {
        liar.status()["router"].is_object() && {
            let audit = lab.audit("liar");
            audit.iter().any(|r| r.event == "link_closed")
        }
    });
    let cloud = router(&lab, "cloud", 0, mdns, |_| {});
    wait("the router is found", || is_linked_to(&node, &lab, "cloud"));
    // Each address is tried once.
    assert!(links(&stranger) == 0 && stranger.refused("other_ca") <= 8);
    drop(cloud);
}

#[test]
fn the_router_that_is_named_is_taken_and_no_other() {
    let lab = lab_of_two_routers();
    let mdns = Some(begin());
    let other = router(&lab, "cloud2", 0, mdns, |_| {});
    let node = seeker(&lab, "seeker", &["mdns://cloud"], None, mdns);
    wait("the other is seen", || {
        let said = |line: &Value| line["last_failure"].as_str().is_some_and(|s| s.contains("is not the one"));
        found_by(&node, "mdns").iter().any(said)
    });
    let cloud = router(&lab, "cloud", 0, mdns, |_| {});
    wait("the right one", || is_linked_to(&node, &lab, "cloud"));
    drop((cloud, other));
}

#[test]
fn a_router_in_the_list_is_not_linked_once_more_by_mdns() {
    let lab = Lab::new(&["seeker"]);
    let mdns = Some(begin());
    let cloud = router(&lab, "cloud", 0, mdns, |_| {});
    let fixed = format!("quic://127.0.0.1:{}", cloud.addr.unwrap().port());
    let node = seeker(&lab, "seeker", &[&fixed, "mdns://"], None, mdns);
    let all = || [found_by(&node, "static"), found_by(&node, "mdns")].concat();
    wait("the second way stands back", || {
        let said = |line: &Value| line["last_failure"].as_str().is_some_and(|s| s.contains("a link already"));
        all().iter().any(said)
    });
    wait("one link", || links(&node) == 1 && links(&cloud) == 1);
}

#[test]
fn routers_that_find_each_other_make_one_link_and_none_finds_itself() {
    let lab = lab_of_two_routers();
    let mdns = Some(begin());
    let near = |config: &mut Config| config.routers = urls(&["mdns://"]);
    let (one, two) = (router(&lab, "cloud", 0, mdns, near), router(&lab, "cloud2", 0, mdns, near));
    wait("they are linked", || is_linked_to(&one, &lab, "cloud2") && is_linked_to(&two, &lab, "cloud"));
    let dialled =
        |node: &Node| found_by(node, "mdns").iter().filter(|line| line["state"] == "linked").count();
    let (less, more) = if lab.id("cloud") < lab.id("cloud2") { (&one, &two) } else { (&two, &one) };
    // The order of the links does not matter.
    wait("by one link of the lesser", || {
        (dialled(less), dialled(more), links(less), links(more)) == (1, 0, 1, 1)
    });
}

#[test]
fn a_shared_router_serves_the_fleets_that_it_accepts_and_keeps_them_apart() {
    let a = Lab::new(&["robot", "desk"]);
    let (b, c) = (a.beside("b"), a.beside("c"));
    for lab in [&b, &c] {
        lab.enroll("robot", |_| {});
        lab.enroll("desk", |_| {});
    }
    let ca_of = |lab: &Lab| lab.ca().0;
    // The router is enrolled with `a`, serves `a` and `b`, and trusts `c`, whose nodes it does not accept.
    let (accept, trust) = (vec![ca_of(&a), ca_of(&b)], vec![ca_of(&c)]);
    let cloud = a.cloud_with(|config| (config.accept, config.trust) = (accept, trust));
    let trusting = |config: &mut Config| config.trust = vec![ca_of(&a)];
    let share_all = |config: &mut Config| config.shares = vec![share("/chatter", &["*"])];
    let use_it = |config: &mut Config| config.uses = vec![uses("/chatter")];
    let _robots = [
        a.start("robot", share_all),
        b.start("robot", |config| {
            trusting(config);
            share_all(config);
        }),
    ];
    let _desks = [
        a.start("desk", use_it),
        b.start("desk", |config| {
            trusting(config);
            use_it(config);
        }),
    ];
    let talkers = [&a, &b].map(|lab| lab.talker("robot", "/chatter"));
    let listeners = [&a, &b].map(|lab| lab.listener("desk", "/chatter"));
    talkers.iter().for_each(|talker| talker.wait_for_readers(1));
    for (talker, listener) in talkers.iter().zip(&listeners) {
        warm_up(talker, &[listener]);
    }
    // Owner name, topic and type are equal, and each desk gets its own fleet's message.
    talkers[0].say("of a");
    talkers[1].say("of b");
    for (listener, expected) in listeners.iter().zip(["of a", "of b"]) {
        wait(expected, || listener.drain().iter().any(|heard| heard == expected));
        listener.hears_nothing();
    }

    // The third fleet is not accepted.
    let stranger = c.start("robot", |config| {
        trusting(config);
        share_all(config);
    });
    wait("it is refused", || cloud.refused("not_admitted") > 1);
    wait("it is told", || {
        let line = &found_by(&stranger, "static")[0];
        line["last_failure"].as_str().is_some_and(|why| why.contains("serves other fleets only"))
    });
    assert_eq!(links(&stranger), 0);
    let refusal = |r: &sgc_node::audit::AuditRecord| {
        r.event == "link_refused" && r.reason.as_ref().is_some_and(|why| why.contains("`accept`"))
    };
    wait("the log says what to do", || a.audit("cloud").iter().any(refusal));

    // The third fleet is accepted, and then refused again.
    let wider = vec![ca_of(&a), ca_of(&b), ca_of(&c)];
    let report = cloud.reload(|config| config.accept = wider);
    assert!(report["changed"].as_array().unwrap().iter().any(|c| c == "whose nodes may attach changed"));
    wait("it is let in", || links(&stranger) == 1);
    let narrow = vec![ca_of(&a), ca_of(&b)];
    cloud.reload(|config| config.accept = narrow);
    wait("it is out", || links(&stranger) == 0);
    assert_eq!(cloud.peers().len(), 4);
}

#[test]
fn routers_change_at_a_reload_and_no_message_is_lost() {
    let lab = Lab::new(&["robot", "desk"]);
    lab.enroll("cloud2", |request| request.router = true);
    let (first, _cloud) = (lab.url(), lab.cloud());
    let cloud2 = router(&lab, "cloud2", 0, None, |config| config.routers = urls(&[&first]));
    let second = format!("quic://{}", cloud2.addr.unwrap());
    let robot = lab.start("robot", |config| config.shares = vec![share("/chatter", &["desk"])]);
    let desk = lab.start("desk", |config| config.uses = vec![uses("/chatter")]);
    let (talker, listener) = (lab.talker("robot", "/chatter"), lab.listener("desk", "/chatter"));
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);
    let stream = Stream::start(talker);
    stream.more(200);

    let report = robot.reload(|config| config.routers = urls(&[&second]));
    let changed = serde_json::json!([
        format!("{second} is searched for"),
        format!("{first} is no longer searched for")
    ]);
    assert_eq!((&report["changed"], &report["needs_restart"]), (&changed, &serde_json::json!([])));
    wait("it is linked with the second", || robot.peers().contains(&lab.id("cloud2").to_string()));
    wait("and with no other", || is_linked_to(&robot, &lab, "cloud2"));
    let rows = found_by(&robot, "static");
    assert_eq!((rows.len(), &rows[0]["router"]), (1, &Value::from(second.clone())));
    stream.more(300);
    // One that is added, and then the other removed.
    robot.reload(|config| config.routers = urls(&[&second, &first]));
    wait("it is linked with both", || robot.peers().len() == 2);
    robot.reload(|config| config.routers = urls(&[&first]));
    wait("it is linked with the first", || is_linked_to(&robot, &lab, "cloud"));
    stream.more(300);
    // The same router by another URL: one node has one link to it.
    let by_name = format!("quic://localhost:{}", first.rsplit_once(':').unwrap().1);
    desk.reload(|config| config.routers = urls(&[&by_name]));
    wait("it is linked by that URL", || {
        let rows = found_by(&desk, "static");
        rows.len() == 1 && rows[0]["router"] == by_name && rows[0]["state"] == "linked"
    });
    stream.more(300);
    let (_talker, last) = stream.end();
    hears_each(&listener, 1, last);
    listener.hears_nothing();
}

#[test]
fn a_node_of_one_fleet_behind_a_shared_router_cannot_join_a_name_of_the_other() {
    let (ops, b) = shared_router();
    let a = ops.beside("a");
    a.enroll("spy", |_| {});
    // The owner does not even trust the spy's CA.
    spy_gets_nothing(&ops, &a, &b, |robot, _| {
        let status = robot.status();
        status["drops"].as_object().unwrap().iter().any(|(key, n)| key.contains("not_verified") && n != 0)
    });
}

#[test]
fn a_node_of_the_routers_own_fleet_cannot_join_a_name_of_another() {
    let (ops, b) = shared_router();
    ops.enroll("spy", |_| {});
    // The owner trusts that CA, since it is the router's. `*` covers the owner's fleet alone.
    spy_gets_nothing(&ops, &ops, &b, |_, spy| {
        spy.route_state() == "refused: the owner does not share it with this node"
    });
}

/// Creates the fleet of a router, and a fleet with a robot and a desk.
fn shared_router() -> (Lab, Lab) {
    let ops = Lab::new(&[]);
    let b = ops.beside("b");
    b.enroll("robot", |_| {});
    b.enroll("desk", |_| {});
    (ops, b)
}

/// A spy of fleet `a` asks, over the router of `ops`, for a topic that a robot shares with all of fleet `b`.
fn spy_gets_nothing(ops: &Lab, a: &Lab, b: &Lab, is_refused: impl Fn(&Node, &Node) -> bool) {
    let accept = vec![a.ca().0, b.ca().0];
    let cloud = ops.cloud_with(|config| config.accept = accept);
    let trusting = |config: &mut Config| config.trust = vec![ops.ca().0];
    let mut shared = share("/chatter", &["*"]);
    shared.type_name = Some("std_msgs/msg/String".into());
    let robot = b.start("robot", |config| {
        trusting(config);
        config.shares = vec![shared.clone()];
    });
    let _desk = b.start("desk", |config| {
        trusting(config);
        config.uses = vec![uses("/chatter")];
    });
    let talker = b.talker("robot", "/chatter");
    let listener = b.listener("desk", "/chatter");
    talker.wait_for_readers(1);
    warm_up(&talker, &[&listener]);

    // The spy even knows the topic's secret, which only the fleet should know. The owner's policy has nobody of the
    // spy's CA, since no token was given.
    let owner = b.identity("robot");
    let metadata = sgc_node::policy::metadata(&shared, "robot");
    let token = ShareToken {
        owner: owner.node_id(),
        owner_name: owner.node_name().clone(),
        ca: owner.anchors().certificates().next().unwrap().clone(),
        routers: vec![],
        expires: UnixMillis(unix_now().0 + 3_600_000),
        secret: TopicSecret::derive(&owner.naming_secrets()[0].secret, &metadata),
        metadata,
    };
    let name = token.name().to_string();
    assert_eq!(robot.status()["routes"][0]["name"], name.as_str());
    let branches = || cloud.status()["router"]["branches"].as_u64();
    let before = branches();
    let spy = a.start("spy", |config| {
        trusting(config);
        config.tokens = vec![TokenConfig {
            source: TokenSource::Text(Box::new(token)),
            naming: Default::default(),
            frame_prefix: None,
            dead_man: None,
            qos: Default::default(),
            dedicated: false,
        }];
    });
    let stolen = a.listener("spy", "/chatter");
    wait("its request passes the router and not the owner", || is_refused(&robot, &spy));
    talker.say("not for spies");
    wait("the desk hears it", || listener.drain().iter().any(|heard| heard == "not for spies"));
    stolen.hears_nothing();
    assert_eq!(writers(&a.net("spy"), "/chatter"), 0);
    assert!(links(&spy) == 1 && cloud.peers().len() == 3);
    // No packet reached the spy, and no branch towards it is left.
    let status = spy.status();
    assert!(
        status["names"].as_array().unwrap().iter().all(|n| n["name"] != name.as_str() || n["packets"] == 0)
    );
    wait("no branch leads to it", || branches() == before);
}
