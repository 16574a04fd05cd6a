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
    let node = router("edge").as_peer().clone();
    let body = LinkStateBody {
        chain: Vec::new(),
        seq: seq.into(),
        issued_at: now.unix,
        lease_ms: 1000,
        floor: FLOOR,
        transit: true,
        routers: routers.iter().map(|(node, cost)| Adjacency { node: *node, cost: *cost }).collect(),
        attached: Vec::new(),
    };
    let from = Peer { node: node.node_id, is_router: true };
    let signed = SignedBody { body: Bytes::new(), signature: Bytes::new() };
    topology.admit(now, from, signed, [seq; 32], VerifiedLinkState { node, body })
}

#[test]
fn edge_counts_once_both_ends_list_it() {
    let (own, edge) = (router("cloud"), router("edge").node_id());
    let now = Clock::default().now();
    let mut topology = topology(now);
    admit(&mut topology, now, 1, &[(own.node_id(), 10)]);
    let owners = [edge];
    topology.search(now.instant, owners.iter());
    assert_eq!(topology.next_hop(&edge), None, "only one end lists it");
    let later = Now { instant: now.instant + ORIGINATE_EVERY, ..now };
    let neighbours = || (BTreeMap::from([(edge, 20)]), BTreeSet::new());
    assert!(!topology.originate_due(now, &own, neighbours), "a router waits a moment");
    assert!(topology.originate_due(later, &own, neighbours));
    assert!(!topology.originate_due(later, &own, neighbours), "once");
    assert!(topology.is_search_due(later.instant + SEARCH_EVERY));
    assert_eq!(topology.search(later.instant, owners.iter()), [edge]);
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
