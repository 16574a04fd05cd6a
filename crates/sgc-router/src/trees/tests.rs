//! Tests of [`Trees`] alone: without router, links and signatures.

use sgc_testkit::{Member, identity};
use sgc_wire::Role;

use super::*;

const NAME: Name = Name([7; 32]);
const OWNER: LinkId = LinkId(1);
const READER: LinkId = LinkId(2);
const NODE: NodeId = NodeId([2; 32]);

fn sink(n: u8) -> SinkId {
    SinkId([n; 16])
}

/// Returns trees with branches of these sinks that expect an answer, and the time of the requests.
fn trees(sinks: &[u8]) -> (Trees, Instant) {
    #[allow(clippy::disallowed_methods)]
    let now = Instant::now();
    let owner = Arc::new(identity(&Member::new("arm-1")).as_peer().clone());
    let mut trees = Trees::new(&Limits { branches_per_peer_max: 3, ..Limits::default() });
    for n in sinks {
        let owner = owner.clone();
        let (certs, role) = (Arc::new([]), Role::Subscribe);
        let branch = NewBranch { link: READER, neighbour: NODE, up: OWNER, owner, peer: NODE, certs, role };
        trees.add(now, NAME, sink(*n), branch);
    }
    (trees, now)
}

/// An end of the branch of sink 1.
type End = fn(&mut Trees) -> Effects;

/// Returns the effects as short text.
fn text(effects: &Effects) -> Vec<String> {
    let text = |effect: &Effect| match effect {
        Effect::Send { link, frame: Control::Reject { reason, .. } } => format!("{link}: {reason:?}"),
        Effect::Send { link, frame: Control::Leave { .. } } => format!("{link}: Leave"),
        Effect::Send { link, frame: Control::Reroute { .. } } => format!("{link}: Reroute"),
        Effect::Send { link, .. } => format!("{link}: other"),
        Effect::Forward { entry, .. } => format!("sinks: {}", entry.as_ref().map_or(0, |e| e.sinks.len())),
    };
    effects.iter().map(text).collect()
}

fn assert_empty(trees: &Trees) {
    assert!(trees.trees.is_empty() && trees.deadlines.is_empty(), "{trees:?}");
    assert!(trees.of_link.is_empty() && trees.of_node.is_empty(), "{trees:?}");
}

#[test]
fn branch_leaves_nothing_behind_however_it_ends() {
    let ends: [(&str, End); 6] = [
        ("leave", |trees| trees.leave(READER, NAME, sink(1)).unwrap()),
        ("refuse", |trees| trees.refuse(NAME, sink(1))),
        ("reject", |trees| trees.reject(NAME, sink(1), RejectReason::NoRoute)),
        ("link to the sink down", |trees| trees.link_down(READER)),
        ("link to the owner down", |trees| trees.link_down(OWNER)),
        ("revoked", |trees| trees.distrust(|_| true)),
    ];
    for is_granted in [false, true] {
        for (how, end) in ends {
            let (mut trees, _) = trees(&[1]);
            if is_granted {
                assert_eq!(text(&trees.grant(NAME, sink(1))), ["sinks: 1"]);
            }
            let effects = text(&end(&mut trees));
            assert_eq!(effects.contains(&"sinks: 0".to_owned()), is_granted, "{how}: {effects:?}");
            assert_empty(&trees);
        }
    }
}

#[test]
fn unanswered_request_is_given_up_at_its_deadline() {
    let (mut trees, now) = trees(&[1]);
    let at = trees.next_deadline().unwrap();
    assert_eq!(at, now + Limits::default().answer_wait);
    assert!(trees.handle_timeout(now).is_empty());
    assert_eq!(text(&trees.handle_timeout(at)), ["link 2: TimedOut", "link 1: Leave"]);
    assert_empty(&trees);
}

#[test]
fn granted_branch_drains_when_the_route_moves() {
    let (mut trees, now) = trees(&[1, 2]);
    trees.grant(NAME, sink(1));
    assert!(trees.follow(now, &NAME, true, Some(OWNER)).is_empty());
    assert!(trees.follow(now, &NAME, true, None).is_empty(), "the owner is only out of reach");
    let moved = trees.follow(now, &NAME, true, Some(LinkId(3)));
    assert_eq!(text(&moved), ["link 2: Reroute", "link 2: RouteLost", "link 1: Leave"]);
    assert!(trees.follow(now, &NAME, true, Some(LinkId(3))).is_empty(), "once");
    let over = trees.handle_timeout(trees.next_deadline().unwrap());
    assert_eq!(text(&over), ["sinks: 0", "link 2: RouteLost", "link 1: Leave"]);
    assert_empty(&trees);
}

#[test]
fn neighbour_has_a_bounded_number_of_branches() {
    let (mut trees, _) = trees(&[1, 2, 3]);
    assert!(trees.is_full(&NAME, &NODE) && !trees.is_full(&NAME, &NodeId([3; 32])));
    assert!(trees.leave(OWNER, NAME, sink(1)).is_err(), "not over its link");
    assert!(trees.leave(READER, NAME, sink(1)).is_ok() && !trees.is_full(&NAME, &NODE));
}

#[test]
fn sink_has_one_place() {
    let (mut trees, _) = trees(&[1]);
    let identity = identity(&Member::new("desk"));
    let mut peer = identity.as_peer().clone();
    peer.node_id = NODE;
    let place = |trees: &mut Trees, link, peer| trees.place(link, &NAME, &sink(1), peer, None);
    assert_eq!(place(&mut trees, READER, &peer), Place::Kept { up: OWNER });
    assert_eq!(place(&mut trees, LinkId(3), &peer), Place::Taken, "a replay over another link");
    assert_eq!(place(&mut trees, READER, identity.as_peer()), Place::Taken, "another node");
    assert_eq!(trees.place(READER, &NAME, &sink(2), &peer, None), Place::New);
}
