//! Documents of sound nodes, and the faults that the tests put into them.

use std::collections::BTreeMap;

use sgc_node::graph::{
    DeadMan, Endpoint, Graph, Interface, JoinState, Link, NameLine, Offer, Qos, Search, Share, ShareRoute,
    Use, UseRoute,
};
use sgc_wire::{RefuseReason, RejectReason};

/// Reasons to refuse a join whose remedy does not depend on the document.
pub(crate) const REFUSED_WITH_REMEDY: [RefuseReason; 6] = [
    RefuseReason::NotVerified,
    RefuseReason::RoleNotOffered,
    RefuseReason::Limit,
    RefuseReason::Clock,
    RefuseReason::Expired,
    RefuseReason::Revoked,
];

/// All reasons to reject a join on its way.
pub(crate) const REJECTED: [RejectReason; 8] = [
    RejectReason::NoRoute,
    RejectReason::NotVerified,
    RejectReason::Limit,
    RejectReason::TimedOut,
    RejectReason::RouteLost,
    RejectReason::Clock,
    RejectReason::Expired,
    RejectReason::Revoked,
];

pub(super) const STRING: &str = "std_msgs/msg/String";
pub(super) const NAME: &str = "aa";

/// The expected finding, and the fault to inject.
pub(super) type Case = (&'static str, fn(&mut Graph));

pub(super) fn end(topic: &str, writes: bool) -> Endpoint {
    Endpoint {
        topic: topic.into(),
        is_ros_topic: true,
        type_name: STRING.into(),
        writes,
        shared_by: (topic == "/a").then_some(0),
        qos: qos(),
        ..Endpoint::default()
    }
}

pub(super) fn qos() -> Qos {
    Qos { reliable: true, depth: Some(10), ..Qos::default() }
}

pub(super) fn sound() -> Graph {
    let name =
        NameLine { way: Some((1, 900)), out: vec![1], has_branch: true, packets: 5, ..NameLine::default() };
    Graph {
        node: "here".into(),
        version: "0.1.0".into(),
        has_ros: true,
        links: vec![link(1, "cloudcloud")],
        routers: vec![Search { router: "quic://r".into(), state: "linked".into(), ..Search::default() }],
        names: [(NAME.to_owned(), name)].into(),
        ..Graph::default()
    }
}

/// Returns a link to a peer.
pub(super) fn link(id: u32, peer: &str) -> Link {
    let remote = format!("192.0.2.{id}:7447");
    Link { id, peer: peer.into(), remote, rtt_us: 500, ..Link::default() }
}

/// Returns the graph of a sound node that shares `/a`.
pub(super) fn owner() -> Graph {
    let route = ShareRoute {
        topic: "/a".into(),
        type_name: STRING.into(),
        name: NAME.into(),
        writers: 1,
        is_read: true,
        granted: vec!["desk".into()],
        messages: 3,
        ..ShareRoute::default()
    };
    Graph {
        endpoints: vec![end("/a", true)],
        shares: vec![Share { topic: "/a".into(), to: [1, 0, 0], routes: vec![route], ..Share::default() }],
        ..sound()
    }
}

/// A sound document of a user of a part of the action `/fib`.
pub(super) fn action_part(suffix: &str) -> Graph {
    let mut graph = user();
    let name = format!("/fib/_action/{suffix}");
    graph.uses[0].topic.clone_from(&name);
    graph.uses[0].local_topic.clone_from(&name);
    graph.uses[0].routes[0].topic = name;
    graph.uses[0].kind = Interface::Service;
    graph
}

/// Returns the graph of a sound node that uses `/a`.
pub(super) fn user() -> Graph {
    let route = UseRoute {
        topic: "/a".into(),
        type_name: STRING.into(),
        name: NAME.into(),
        qos: qos(),
        is_granted: true,
        writers: 1,
        matched: 1,
        messages: 3,
        last_s: Some(7),
        ..UseRoute::default()
    };
    let used = Use {
        topic: "/a".into(),
        local_topic: "/a".into(),
        owner: "arm".into(),
        owner_id: "1d".into(),
        has_catalogue: true,
        routes: vec![route],
        ..Use::default()
    };
    let offer = Offer {
        owner: Some("arm".into()),
        owner_id: "1d".into(),
        topic: "/a".into(),
        type_name: STRING.into(),
        name: NAME.into(),
        subscribe: true,
        is_used: true,
        ..Offer::default()
    };
    Graph { endpoints: vec![end("/a", false)], uses: vec![used], offers: vec![offer], ..sound() }
}

/// Returns the graph of a sound node that publishes on `/a`.
pub(super) fn publisher() -> Graph {
    let mut graph = user();
    graph.endpoints = vec![end("/a", true)];
    graph.uses[0].publishes = true;
    graph.uses[0].routes[0].publishers = 1;
    graph.uses[0].routes[0].is_read = true;
    graph.offers[0].publish = true;
    graph
}

/// Returns a use of all interfaces of a kind that an owner shares.
pub(super) fn pattern(kind: Interface, owner: &str) -> Use {
    Use {
        kind,
        topic: "/**".into(),
        local_topic: "/**".into(),
        owner: owner.into(),
        owner_id: if owner == "arm" { "1d".into() } else { "2d".into() },
        has_catalogue: true,
        ..Use::default()
    }
}

/// Returns the faults of [`owner`] on the path of `/a`.
pub(super) fn owner_faults() -> Vec<Case> {
    vec![
        ("touches no ROS 2 network", |g| g.has_ros = false),
        ("no publisher of /a is on the local network (1 subscribers are there)", |g| {
            g.endpoints[0].writes = false
        }),
        ("no publisher of /a is on the local network; did you mean /robot/a?", |g| {
            g.endpoints[0].topic = "/robot/a".into();
        }),
        ("says type x/msg/Y, and the publishers have std_msgs/msg/String", |g| {
            g.shares[0].wanted_type = Some("x/msg/Y".into());
        }),
        ("travel as JSON, and no definition of std_msgs/msg/String is known here", |g| {
            g.shares[0].routes[0].lacks_definition = true;
        }),
        ("have different definitions of std_msgs/msg/String: RIHS01_a and RIHS01_b", |g| {
            g.endpoints.push(g.endpoints[0].clone());
            g.endpoints[0].type_hash = Some("RIHS01_a".into());
            g.endpoints[1].type_hash = Some("RIHS01_b".into());
        }),
        ("covered by a rule, but not shared: too many", |g| {
            g.shares[0].routes.clear();
            g.problems = vec!["/a: too many".into()];
        }),
        ("no link is up; quic://r is trying again: no answer", |g| {
            g.links.clear();
            g.routers[0].state = "trying again".into();
            g.routers[0].last_failure = Some("no answer".into());
        }),
        ("no link is up, and no router is configured", |g| {
            g.links.clear();
            g.routers.clear();
        }),
        ("link 1 to cloudclo at 192.0.2.1:7447 (0.50 ms) is silent", |g| g.links[0].silent = true),
        ("nobody asked for it", |g| g.shares[0].routes[0].granted.clear()),
        ("desk asked for it and was refused: not listed", |g| {
            g.shares[0].routes[0].granted.clear();
            g.shares[0].routes[0].refused = [("desk".to_owned(), "not listed".to_owned())].into();
        }),
        ("no branch leads away", |g| g.names = BTreeMap::new()),
        ("the definitions of std_msgs/msg/String differ: RIHS01_a here, RIHS01_b at desk", |g| {
            g.endpoints[0].type_hash = Some("RIHS01_a".into());
            let hashes = ["RIHS01_a".to_owned(), "RIHS01_b".to_owned()].into();
            g.shares[0].routes[0].consumer_hashes = [("desk".to_owned(), hashes)].into();
        }),
        ("the local publishers are not read", |g| g.shares[0].routes[0].is_read = false),
        ("dropped here: stale 9, too_old 1", |g| {
            let dropped =
                [("stale".to_owned(), 9), ("too_old".to_owned(), 1), ("no_subscriber".to_owned(), 99)];
            g.names.get_mut(NAME).unwrap().dropped = dropped.into();
        }),
        ("1 local publishers have it, but no rule names it", |g| {
            g.shares.clear();
            g.endpoints[0].shared_by = None;
        }),
        ("1 local publishers have it, but no rule names it; did you mean /A?", |g| {
            g.shares[0].topic = "/A".into();
            g.shares[0].routes.clear();
            g.endpoints[0].shared_by = None;
        }),
    ]
}

/// Returns the faults of [`user`] on the path of `/a`.
pub(super) fn user_faults() -> Vec<Case> {
    vec![
        ("no link is up", |g| g.links.clear()),
        ("arm has not said yet what it shares: nobody in reach knows it", |g| {
            g.uses[0].has_catalogue = false
        }),
        ("Is its name spelt right? \"ram\" is here", |g| {
            g.uses[0].has_catalogue = false;
            g.uses[0].owner_meant = Some("ram".into());
        }),
        ("arm refuses its catalogue: x: it is in reach and refuses this node", |g| {
            g.uses[0].has_catalogue = false;
            g.uses[0].follow = Some(JoinState::Refused);
            g.uses[0].owner_state = Some("refuses its catalogue: x".into());
            g.uses[0].owner_refusal = Some("x".into());
        }),
        ("arm is in reach and does not share /a with here; did you mean /robot/a?", |g| {
            g.uses[0].routes.clear();
            g.offers[0].topic = "/robot/a".into();
        }),
        ("arm shares /a as std_msgs/msg/String, and the [[use]] asks for x/msg/Y", |g| {
            g.uses[0].routes.clear();
            g.uses[0].wanted_type = Some("x/msg/Y".into());
        }),
        ("arm shares /a as a service, and the [[use]] asks for a topic", |g| {
            g.uses[0].routes.clear();
            g.offers[0].kind = Interface::Service;
        }),
        ("arm lets here publish on /a, but not subscribe", |g| {
            g.uses[0].routes.clear();
            g.offers[0].subscribe = false;
        }),
        ("arm refuses it: revoked", |g| {
            g.uses[0].routes[0].is_granted = false;
            g.uses[0].routes[0].refused = Some("revoked".into());
        }),
        ("travel as JSON, and no definition of std_msgs/msg/String is known here", |g| {
            g.uses[0].routes[0].lacks_definition = true;
        }),
        ("because commands came late; 2 commands were late; 7 commands were of a publisher", |g| {
            let stopped = Some("late".to_owned());
            let dead_man = DeadMan { stopped, stopped_s: 4, late: 2, not_resumed: 7, ..DeadMan::default() };
            g.uses[0].routes[0].dead_man = Some(dead_man);
        }),
        ("no command passes, because it has no stop message: the type is unknown", |g| {
            let (stopped, no_stop_message) =
                (Some("start".to_owned()), Some("the type is unknown".to_owned()));
            g.uses[0].routes[0].dead_man = Some(DeadMan { stopped, no_stop_message, ..DeadMan::default() });
        }),
        ("no way leads to it now", |g| {
            g.uses[0].routes[0].is_granted = false;
            g.uses[0].routes[0].join = Some(JoinState::Waiting);
        }),
        ("the answer is not here yet", |g| g.uses[0].routes[0].is_granted = false),
        ("is silent", |g| g.links[0].silent = true),
        ("no branch leads here", |g| g.names.get_mut(NAME).unwrap().has_branch = false),
        ("nobody on this local network subscribes to /a", |g| g.endpoints.clear()),
        ("the far side has std_msgs/msg/String, and the local subscribers have x/msg/Y", |g| {
            g.endpoints[0].type_name = "x/msg/Y".into();
        }),
        ("the definitions of std_msgs/msg/String differ: RIHS01_a on the far side, RIHS01_b here", |g| {
            g.endpoints[0].type_hash = Some("RIHS01_b".into());
            g.uses[0].routes[0].type_hash = Some("RIHS01_a".into());
        }),
        ("by reliability: BEST_EFFORT is offered by the far side, RELIABLE is asked for", |g| {
            g.uses[0].routes[0].qos.reliable = false;
        }),
        ("by durability: VOLATILE is offered by the far side, TRANSIENT_LOCAL is asked for", |g| {
            g.endpoints[0].qos.durability = 1;
        }),
        ("by deadline: infinite is offered by the far side, 0.5 s is asked for", |g| {
            g.endpoints[0].qos.deadline_ns = Some(500_000_000);
        }),
        ("by liveliness: AUTOMATIC is offered by the far side, MANUAL_BY_TOPIC is asked for", |g| {
            g.endpoints[0].qos.liveliness = 2;
        }),
        ("by liveliness lease: 3 s is offered by the far side, 2 s is asked for", |g| {
            g.endpoints[0].qos.lease_ns = Some(2_000_000_000);
            g.uses[0].routes[0].qos.lease_ns = Some(3_000_000_000);
        }),
        ("by partition: [\"\"] is offered by the far side, [\"p\"] is asked for", |g| {
            g.endpoints[0].qos.partitions = vec!["p".into()];
        }),
        ("by data representation: XCDR1 is offered by the far side, XCDR2 is asked for", |g| {
            g.endpoints[0].qos.representations = vec!["XCDR2".into()];
            g.uses[0].routes[0].qos.representations = vec!["XCDR2".into(), "XCDR1".into()];
        }),
        ("no writer for it is on the local network", |g| g.uses[0].routes[0].writers = 0),
        ("DDS matches none of them with this node", |g| g.uses[0].routes[0].matched = 0),
        ("dropped here: sink 6", |g| {
            g.names.get_mut(NAME).unwrap().dropped = [("sink".to_owned(), 6)].into();
        }),
        ("arm shares /a with this node, but no [[use]] asks for it", |g| {
            g.uses.clear();
            g.offers[0].is_used = false;
        }),
        ("1 local subscribers want it, but no rule brings it here; did you mean /arm/a?", |g| {
            g.uses.clear();
            g.offers[0].topic = "/arm/a".into();
        }),
        ("arm refuses the token: expired", |g| {
            g.uses[0].is_token = true;
            g.uses[0].routes.clear();
            g.uses[0].refused = Some("expired".into());
        }),
        ("nobody on the local network has /a, no rule names it", |g| {
            g.uses.clear();
            g.endpoints.clear();
            g.offers.clear();
        }),
    ]
}

/// Returns the faults of [`publisher`] on the path of `/a`.
pub(super) fn publisher_faults() -> Vec<Case> {
    vec![
        ("no publisher of /a is on the local network", |g| g.endpoints.clear()),
        ("arm shares /a with here, but does not let it publish", |g| {
            g.uses[0].routes.clear();
            g.offers[0].publish = false;
        }),
        ("arm takes it as std_msgs/msg/String, and the local publishers have x/msg/Y", |g| {
            g.uses[0].routes[0].publishers = 0;
            g.endpoints[0].type_name = "x/msg/Y".into();
        }),
        ("are not read", |g| g.uses[0].routes[0].is_read = false),
    ]
}
