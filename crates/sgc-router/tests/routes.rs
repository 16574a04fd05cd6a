//! One router among scripted neighbours: what it takes for a way, and what it tells of it.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_router::{Limits, LinkId, Neighbour, Output, Router, RouterConfig};
use sgc_testkit::{Clock, Member, identity};
use sgc_trust::{Identity, name_of};
use sgc_wire::{
    AdvertBody, Answer, AnswerBody, Blind, Control, Decode, HOP_LIMIT, Hello, Name, NodeId, SinkId,
};

const A: Blind = Blind([0xa; 32]);
const B: Blind = Blind([0xb; 32]);
const LEASE: Duration = Duration::from_secs(60);

/// A router with scripted routers on links 1, 2 and 3, and an owner that is none of them.
struct Bench {
    router: Router,
    clock: Clock,
    owner: Arc<Identity>,
    timeout: Option<std::time::Instant>,
    sent: Vec<(LinkId, Control)>,
    dropped: Vec<&'static str>,
}

impl Bench {
    fn new(limits: Limits) -> Self {
        let own = identity(&Member { router: true, ..Member::new("cloud") });
        let router = Router::new(RouterConfig {
            node: own.node_id(),
            transit: true,
            incarnation: 1,
            anchors: Arc::new(own.anchors().clone()),
            limits,
        });
        let owner = identity(&Member::new("arm-1"));
        let (sent, dropped) = (Vec::new(), Vec::new());
        let mut bench = Self { router, clock: Clock::default(), owner, timeout: None, sent, dropped };
        for n in 1..=3 {
            bench.up(n, NodeId([n as u8; 32]));
            let hello = Hello { minor: 0, incarnation: n.into(), transit: true };
            bench.frame(n, Control::Hello(hello));
        }
        bench
    }

    /// A link to a node whose certificate lets it route.
    fn up(&mut self, link: u32, node: NodeId) {
        let own = self.owner.as_peer();
        let neighbour = Neighbour { node, may_route: true, ..Neighbour::from(own) };
        self.router.handle_link_up(self.clock.now(), LinkId(link), neighbour);
    }

    fn drain(&mut self) {
        loop {
            match self.router.poll_output() {
                Output::Send { link, frame } => self.sent.push((link, frame)),
                Output::Dropped(dropped) => self.dropped.push(dropped.reason.key()),
                Output::Timeout(at) => {
                    self.timeout = at;
                    return;
                }
                Output::Forward { .. } | Output::Close { .. } | Output::Trust(_) => {}
            }
        }
    }

    fn frame(&mut self, link: u32, frame: Control) {
        self.sent.clear();
        self.router.handle_frame(self.clock.now(), LinkId(link), frame);
        self.drain();
    }

    fn advert(&mut self, link: u32, hops: u8, seq: u64, blinds: &[Blind]) {
        let body = AdvertBody {
            chain: self.owner.chain_bytes(),
            seq,
            issued_at: self.clock.now().unix,
            lease_ms: LEASE.as_millis() as u32,
            withdraw: false,
            blinds: blinds.to_vec(),
        };
        let signed = self.owner.sign_advert(&body);
        self.frame(link, Control::Advert { hops, signed });
    }

    fn link_down(&mut self, link: u32) {
        self.sent.clear();
        self.router.handle_link_down(LinkId(link));
        self.drain();
    }

    fn pass(&mut self, time: Duration) {
        let end = self.clock.instant() + time;
        while let Some(at) = self.timeout.filter(|at| *at <= end) {
            self.clock.advance_to(at);
            self.router.handle_timeout(self.clock.now());
            self.drain();
        }
        self.clock.advance_to(end);
    }

    fn name(&self, blind: &Blind) -> Name {
        name_of(&self.owner.node_id(), blind)
    }

    /// Link in use and distance.
    fn route(&self, blind: &Blind) -> Option<(u32, u8)> {
        self.router.route(&self.name(blind)).map(|(link, distance)| (link.0, distance))
    }

    /// What links were told since the last frame: distance and sequence number.
    fn told(&self) -> Vec<(u32, u8, u64)> {
        let mut told: Vec<_> = self
            .sent
            .iter()
            .filter_map(|(link, frame)| match frame {
                Control::Advert { hops, signed } => {
                    Some((link.0, *hops, AdvertBody::from_slice(&signed.body).expect("as it was signed").seq))
                }
                _ => None,
            })
            .collect();
        told.sort_unstable();
        told
    }

    /// Links that were told that a name is out of reach since the last frame.
    fn told_unreach(&self, blind: &Blind) -> Vec<u32> {
        let is = |frame: &Control| matches!(frame, Control::Unreach { names } if names.contains(&self.name(blind)));
        self.sent.iter().filter(|(_, frame)| is(frame)).map(|(link, _)| link.0).collect()
    }
}

fn bench() -> Bench {
    Bench::new(Limits::default())
}

#[test]
fn the_nearest_neighbour_is_used_and_all_others_are_told() {
    let mut bench = bench();
    bench.advert(1, 4, 10, &[A]);
    assert_eq!((bench.route(&A), bench.told()), (Some((1, 5)), vec![(2, 5, 10), (3, 5, 10)]));
    bench.advert(2, 2, 10, &[A]);
    assert_eq!((bench.route(&A), bench.told()), (Some((2, 3)), vec![(1, 3, 10), (3, 3, 10)]));
    bench.advert(3, 2, 10, &[A]);
    assert_eq!((bench.route(&A), bench.told()), (Some((2, 3)), vec![]), "no better");
}

#[test]
fn an_echo_of_ones_own_word_is_not_a_way_until_the_owner_speaks_again() {
    let mut bench = bench();
    bench.advert(1, 1, 10, &[A]);
    bench.link_down(1);
    assert_eq!((bench.route(&A), bench.told_unreach(&A)), (None, vec![2, 3]));
    // It was under way while the link broke: the neighbour's way may be the one that is gone.
    bench.advert(2, 3, 10, &[A]);
    assert_eq!((bench.route(&A), bench.told()), (None, vec![]));
    bench.advert(2, 3, 11, &[A]);
    assert_eq!((bench.route(&A), bench.told()), (Some((2, 4)), vec![(3, 4, 11)]));
}

#[test]
fn a_nearer_way_of_the_same_word_needs_no_new_one() {
    let mut bench = bench();
    bench.advert(1, 3, 10, &[A]);
    bench.advert(2, 3, 10, &[A]);
    bench.link_down(1);
    assert_eq!((bench.route(&A), bench.told()), (Some((2, 4)), vec![(3, 4, 10)]));
}

#[test]
fn what_was_told_of_a_lost_name_is_forgotten_with_its_lease() {
    let mut bench = bench();
    bench.advert(1, 1, 10, &[A]);
    bench.link_down(1);
    assert_eq!(bench.router.stats().names, 1);
    bench.pass(LEASE + Duration::from_millis(1));
    assert_eq!(bench.router.stats().names, 0);
    assert!(
        bench.timeout > Some(bench.clock.instant() + LEASE),
        "all that is left is the end of certificates"
    );
}

#[test]
fn lost_names_are_remembered_up_to_a_limit() {
    let mut bench = Bench::new(Limits { tombstones_max: 3, ..Limits::default() });
    let blinds: Vec<_> = (0..10).map(|n| Blind([n; 32])).collect();
    bench.advert(1, 1, 10, &blinds);
    bench.link_down(1);
    assert_eq!(bench.router.stats().names, 3);
    for blind in &blinds {
        assert_eq!(bench.told_unreach(blind), [2, 3], "remembered or not, neighbours are told");
    }
}

#[test]
fn a_way_that_grew_longer_gives_way_to_the_other_as_that_one_is() {
    let mut bench = bench();
    bench.advert(1, 2, 10, &[A]);
    bench.advert(2, 2, 10, &[A]);
    assert_eq!(bench.route(&A), Some((1, 3)));
    bench.advert(1, 9, 10, &[A]);
    // Not the nine links of the frame that caused it, and not back to where it leads.
    assert_eq!((bench.route(&A), bench.told()), (Some((2, 3)), vec![(1, 3, 10), (3, 3, 10)]));
}

#[test]
fn names_advertised_together_are_told_together_only_as_they_are() {
    let mut bench = bench();
    bench.advert(1, 0, 10, &[A]);
    // B is new, and neighbours hear of it in an advertisement that speaks for A too, with a newer number and a
    // longer way. Link 1 may now come to this router for A: so A must not be sent there any more.
    bench.advert(2, 4, 11, &[A, B]);
    assert_eq!(bench.told(), [(1, 5, 11), (3, 5, 11)]);
    assert_eq!((bench.route(&A), bench.route(&B)), (Some((2, 5)), Some((2, 5))));
    bench.advert(1, 0, 11, &[A, B]);
    assert_eq!((bench.route(&A), bench.route(&B)), (Some((1, 1)), Some((1, 1))));
}

#[test]
fn a_name_that_is_gone_is_not_told_with_those_advertised_along_with_it() {
    let mut bench = bench();
    bench.advert(1, 1, 10, &[A, B]);
    let names = vec![bench.name(&B)];
    bench.frame(1, Control::Unreach { names });
    bench.sent.clear();
    bench.up(4, NodeId([4; 32]));
    bench.frame(4, Control::Hello(Hello { minor: 0, incarnation: 4, transit: true }));
    assert_eq!(
        (bench.told(), bench.told_unreach(&B), bench.told_unreach(&A)),
        (vec![(4, 2, 10)], vec![4], vec![])
    );
}

#[test]
fn a_grant_for_a_sink_that_left_is_given_back() {
    let mut bench = bench();
    bench.advert(1, 1, 10, &[A]);
    let (name, sink) = (bench.name(&A), SinkId([1; 16]));
    let answer = Answer::Grant { enc: Bytes::new(), sealed: Bytes::new() };
    let signed = bench.owner.sign_answer(&AnswerBody { name, sink, serial: 1, answer });
    bench.frame(1, Control::Answer { signed });
    assert_eq!(bench.sent, [(LinkId(1), Control::Leave { name, sink })]);
    assert_eq!(bench.dropped, ["unknown"]);
}

#[test]
fn an_advertisement_that_came_too_far_is_dropped() {
    for hops in [HOP_LIMIT - 1, HOP_LIMIT, u8::MAX] {
        let mut bench = bench();
        bench.advert(1, hops, 10, &[A]);
        assert_eq!((bench.route(&A), bench.dropped.as_slice()), (None, ["hop_limit"].as_slice()));
    }
    let mut bench = bench();
    bench.advert(1, HOP_LIMIT - 2, 10, &[A]);
    assert_eq!(bench.route(&A), Some((1, HOP_LIMIT - 1)));
}

#[test]
fn a_route_ends_with_its_lease_and_no_lease_is_longer_than_the_limit() {
    let mut bench = Bench::new(Limits { lease_max: Duration::from_secs(30), ..Limits::default() });
    bench.advert(1, 1, 10, &[A]);
    bench.pass(Duration::from_secs(29));
    assert_eq!(bench.route(&A), Some((1, 2)));
    bench.sent.clear();
    bench.pass(Duration::from_secs(2));
    assert_eq!((bench.route(&A), bench.told_unreach(&A)), (None, vec![1, 2, 3]));
    bench.advert(2, 1, 11, &[A]);
    assert_eq!(bench.route(&A), Some((2, 2)));
}

#[test]
fn a_newer_run_supersedes_and_an_older_one_that_greets_late_does_not() {
    let mut bench = bench();
    let node = NodeId([9; 32]);
    for link in [10, 11] {
        bench.up(link, node);
    }
    let hello = |incarnation| Control::Hello(Hello { minor: 0, incarnation, transit: true });
    bench.frame(11, hello(2));
    bench.frame(10, hello(1));
    bench.advert(11, 1, 10, &[A]);
    assert_eq!(bench.route(&A), Some((11, 2)), "the newer link lives");
    bench.advert(10, 1, 10, &[B]);
    assert_eq!((bench.route(&B), bench.dropped.as_slice()), (None, ["no_link"].as_slice()));
    bench.up(12, node);
    bench.frame(12, hello(3));
    assert_eq!(bench.route(&A), None, "what the old run said is void");
}

fn numbered(n: usize) -> Blind {
    let mut blind = [0; 32];
    blind[..8].copy_from_slice(&(n as u64).to_be_bytes());
    Blind(blind)
}

impl Bench {
    fn advert_many(&mut self, link: u32, blinds: &[Blind]) {
        blinds.chunks(256).for_each(|some| self.advert(link, 1, 1, some));
    }
}

#[test]
fn a_chain_of_names_that_push_each_other_to_other_ways_needs_no_stack() {
    const LENGTH: usize = 1500;
    let run = || {
        let mut b = Bench::new(Limits::default());
        b.advert_many(1, &(0..=LENGTH).map(numbered).collect::<Vec<_>>());
        for n in 0..LENGTH {
            let link = 2 + (n as u32 % 2);
            b.advert(link, 10, 2 + n as u64, &[numbered(n), numbered(n + 1)]);
            let next = name_of(&b.owner.node_id(), &numbered(n + 1));
            b.frame(link, Control::Unreach { names: vec![next] });
        }
        let first = name_of(&b.owner.node_id(), &numbered(0));
        b.frame(1, Control::Unreach { names: vec![first] });
    };
    let small = std::thread::Builder::new().stack_size(256 << 10);
    small.spawn(run).unwrap().join().unwrap();
}

#[test]
fn the_loss_of_a_link_with_many_names_is_told_in_few_frames() {
    let mut b = Bench::new(Limits::default());
    b.advert_many(1, &(0..5000).map(numbered).collect::<Vec<_>>());
    b.link_down(1);
    let told = |link| {
        let names = b.sent.iter().filter(|(l, _)| *l == LinkId(link)).map(|(_, frame)| match frame {
            Control::Unreach { names } => names.len(),
            other => panic!("{other:?}"),
        });
        names.collect::<Vec<_>>()
    };
    assert_eq!((told(2), told(3)), (vec![4096, 904], vec![4096, 904]));
}

#[test]
fn one_advertisement_answers_an_interest_in_all_its_names() {
    let mut b = Bench::new(Limits::default());
    let blinds: Vec<_> = (0..256).map(numbered).collect();
    b.advert_many(1, &blinds);
    b.up(4, NodeId([4; 32]));
    b.frame(4, Control::Hello(Hello { minor: 0, incarnation: 4, transit: false }));
    let names = blinds.iter().map(|blind| name_of(&b.owner.node_id(), blind)).collect();
    b.frame(4, Control::Interest { names });
    assert!(matches!(&b.sent[..], [(LinkId(4), Control::Advert { .. })]), "{} frames", b.sent.len());
}
