//! Tests of [`Topology`] alone: without router, links and signatures.

use bytes::Bytes;
use sgc_testkit::{Clock, Member, identity};

use super::*;

const FLOOR: u64 = 3;

fn router(name: &str) -> Arc<Identity> {
    identity(&Member { router: true, ..Member::new(name) })
}

fn topology(now: Now) -> Topology {
    Topology::new(now.instant, &RouterConfig::for_tests(now))
}

/// Lets `edge` say that it is linked to these routers; the digest is its number.
fn admit(topology: &mut Topology, now: Now, seq: u8, routers: &[(NodeId, u32)]) -> Admission {
    admit_of(topology, now, &router("edge"), seq, routers, &[])
}

/// Lets a node say that it is linked to these routers, and these other nodes to it; the digest is made of its number.
fn admit_of(
    topology: &mut Topology,
    now: Now,
    node: &Identity,
    seq: u8,
    routers: &[(NodeId, u32)],
    attached: &[NodeId],
) -> Admission {
    let node = node.as_peer().clone();
    let mut routers: Vec<_> =
        routers.iter().map(|(node, cost)| Adjacency { node: *node, cost: *cost }).collect();
    routers.sort_by_key(|a| a.node);
    let mut attached: Vec<_> = attached.iter().map(NodeId::tag).collect();
    attached.sort();
    let body = LinkStateBody {
        chain: Vec::new(),
        seq: seq.into(),
        issued_at: now.unix,
        lease_ms: 1000,
        floor: FLOOR,
        transit: node.may_route,
        routers,
        attached,
    };
    let from = Peer { node: node.node_id, is_router: node.may_route };
    let signed = SignedBody { body: Bytes::new(), signature: Bytes::new() };
    let digest = if seq == 0 { node.node_id.0 } else { [seq; 32] };
    topology.admit(now, from, signed, digest, VerifiedLinkState { node, body })
}

#[test]
fn edge_counts_once_both_ends_list_it() {
    let (own, edge) = (router("cloud"), router("edge").node_id());
    let now = Clock::default().now();
    let mut topology = topology(now);
    admit(&mut topology, now, 1, &[(own.node_id(), 10)]);
    topology.search(now.instant);
    assert_eq!(topology.next_hop(&edge), None, "only one end lists it");
    let later = Now { instant: now.instant + ORIGINATE_EVERY, ..now };
    let neighbours = || (BTreeMap::from([(edge, 20)]), BTreeSet::new());
    assert!(!topology.originate_due(now, &own, neighbours), "a router waits a moment");
    assert!(topology.originate_due(later, &own, neighbours));
    assert!(!topology.originate_due(later, &own, neighbours), "once");
    assert!(topology.is_search_due(later.instant + SEARCH_EVERY));
    assert_eq!(topology.search(later.instant), BTreeSet::from([own.node_id(), edge]));
    assert_eq!(topology.next_hop(&edge), Some((20, edge)));
}

#[test]
fn ended_link_state_is_no_news_and_its_floor_remains() {
    let now = Clock::default().now();
    let node = router("edge").node_id();
    let mut topology = topology(now);
    assert_eq!(admit(&mut topology, now, 5, &[]), Admission::Admitted { node, floor: FLOOR });
    assert_eq!(topology.recognise(&[5; 32]), Recognised::InForce);
    assert_eq!(admit(&mut topology, now, 4, &[]), Admission::Stale { node, seq: 4 });
    assert_eq!(topology.expire(now.instant), []);
    let over = now.instant + Duration::from_secs(1);
    assert_eq!(topology.expire(over), [EndedRun { node, floor: FLOOR }]);
    assert_eq!((topology.len(), topology.recognise(&[5; 32])), (0, Recognised::Ended { node, seq: 5 }));
    assert_eq!(admit(&mut topology, now, 5, &[]), Admission::Stale { node, seq: 5 });
}

#[test]
fn search_names_the_moved_routers_and_the_nodes_attached_to_them() {
    let own = router("cloud");
    let [near, far, other] = ["near", "far", "other"].map(router);
    let [at_far, at_other] = ["at-far", "at-other"].map(|name| identity(&Member::new(name)));
    let id = |node: &Arc<Identity>| node.node_id();
    let now = Clock::default().now();
    let mut topology = topology(now);
    let later = Now { instant: now.instant + ORIGINATE_EVERY, ..now };
    let neighbours = BTreeMap::from([(id(&near), 10), (id(&other), 10)]);
    assert!(topology.originate_due(later, &own, || (neighbours, BTreeSet::new())));
    for (node, routers, attached) in [
        (&near, vec![(id(&own), 10), (id(&far), 10)], vec![]),
        (&far, vec![(id(&near), 10)], vec![id(&at_far)]),
        (&other, vec![(id(&own), 10)], vec![id(&at_other)]),
        (&at_far, vec![(id(&far), 1)], vec![]),
        (&at_other, vec![(id(&other), 1)], vec![]),
    ] {
        let admitted = Admission::Admitted { node: id(node), floor: FLOOR };
        assert_eq!(admit_of(&mut topology, later, node, 0, &routers, &attached), admitted);
    }
    let all = [&own, &near, &far, &other, &at_far, &at_other].map(id);
    assert_eq!(topology.search(later.instant), BTreeSet::from(all));
    assert_eq!(topology.next_hop(&id(&at_far)), Some((21, id(&near))));
    assert_eq!(topology.search(later.instant), BTreeSet::new(), "nothing changed");
    admit_of(&mut topology, later, &near, 1, &[(id(&own), 10), (id(&far), 12)], &[]);
    assert_eq!(topology.search(later.instant), BTreeSet::from([id(&far), id(&at_far)]));
    assert_eq!(topology.next_hop(&id(&at_far)), Some((23, id(&near))));
    // The link to a neighbour may be another one, for everything behind it.
    topology.links_changed(later.instant, &id(&near));
    assert_eq!(topology.search(later.instant), BTreeSet::from([&near, &far, &at_far].map(id)));
}
