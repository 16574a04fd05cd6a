//! One router among scripted neighbours: the routes that it takes, and the neighbours that it tells.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_router::{
    DirectReach, FibEntry, Limits, LinkId, LinkQuality, MappingKind, Neighbour, Output, PathKind, Router,
    RouterConfig,
};
use sgc_testkit::{Clock, Member, identity, invited};
use sgc_trust::{Identity, name_of, operations_blind};
use sgc_wire::{
    Adjacency, AdvertBody, Answer, AnswerBody, Blind, Control, Decode, Hello, JoinBody, LinkStateBody, Name,
    NodeId, RejectReason, Request, SinkId, UnixMillis,
};

const A: Blind = Blind([0xa; 32]);
const B: Blind = Blind([0xb; 32]);
const LEASE: Duration = Duration::from_secs(60);

/// The greeting of a run with this number.
fn hello(incarnation: u64, transit: bool) -> Control {
    let started = UnixMillis(incarnation);
    Control::Hello(Hello { minor: 0, incarnation, transit, yields: false, started })
}

fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// The router `cloud`, linked to the scripted routers 1, 2 and 3 by links of those numbers. Their links among each
/// other and to the owner are what they say.
struct Bench {
    router: Router,
    clock: Clock,
    own: Arc<Identity>,
    routers: Vec<Arc<Identity>>,
    owner: Arc<Identity>,
    user: Arc<Identity>,
    timeout: Option<std::time::Instant>,
    sent: Vec<(u32, Control)>,
    dropped: Vec<&'static str>,
    entry: Option<FibEntry>,
    seq: u64,
    /// Links that the router closed.
    closed: Vec<u32>,
    /// Links whose queues the router waits for.
    flushes: Vec<LinkId>,
    /// True while no link takes anything.
    stuck: bool,
}

impl Bench {
    fn with(mapping: MappingKind, limits: Limits) -> Self {
        Self::with_kind(mapping, limits, true)
    }

    /// A router, or a proxy that is linked to the same routers.
    fn with_kind(mapping: MappingKind, limits: Limits, transit: bool) -> Self {
        let router_identity = |name: &str| identity(&Member { router: true, ..Member::new(name) });
        let own = router_identity("cloud");
        let clock = Clock::default();
        let config = RouterConfig {
            node: own.node_id(),
            identity: own.clone(),
            transit,
            incarnation: 1,
            started: clock.now().unix,
            mapping,
            anchors: Arc::new(own.anchors().clone()),
            limits,
        };
        let mut bench = Self {
            router: Router::new(config, clock.now()),
            clock,
            own,
            routers: (1..=5).map(|n| router_identity(&format!("router-{n}"))).collect(),
            owner: identity(&Member::new("arm-1")),
            user: identity(&Member::new("desk")),
            timeout: None,
            sent: Vec::new(),
            dropped: Vec::new(),
            entry: None,
            seq: 0,
            closed: Vec::new(),
            flushes: Vec::new(),
            stuck: false,
        };
        for n in 1..=3 {
            bench.up(n, &bench.routers[n as usize - 1].clone(), true, 1000);
        }
        bench
    }

    fn new() -> Self {
        Self::with(MappingKind::Flood, Limits::default())
    }

    fn up(&mut self, link: u32, node: &Identity, transit: bool, cost: u32) {
        let neighbour = Neighbour { cost: Some(cost), ..Neighbour::from(node.as_peer()) };
        self.router.handle_link_up(self.clock.now(), LinkId(link), neighbour);
        self.frame(link, hello(link.into(), transit));
    }

    fn drain(&mut self) {
        loop {
            match self.router.poll_output() {
                Output::Send { link, frame } => self.sent.push((link.0, frame)),
                Output::Dropped(dropped) => self.dropped.push(dropped.reason.key()),
                Output::Forward { entry, .. } => self.entry = entry,
                Output::Timeout(at) => {
                    self.timeout = at;
                    return;
                }
                Output::Flush { link } if self.stuck => self.flushes.push(link),
                Output::Flush { link } => self.router.handle_flushed(self.clock.now(), link),
                Output::Close { link, .. } => self.closed.push(link.0),
                Output::Trust(_) | Output::Store(_) => {}
            }
        }
    }

    fn frame(&mut self, link: u32, frame: Control) {
        self.sent.clear();
        self.router.handle_frame(self.clock.now(), LinkId(link), frame);
        self.drain();
    }

    /// Returns the router with a number; 0 is the one under test.
    fn node(&self, router: usize) -> NodeId {
        if router == 0 { self.own.node_id() } else { self.routers[router - 1].node_id() }
    }

    /// Returns a router's link state without other nodes, for the test to change.
    fn link_state(&self, node: &Identity, seq: u64, links: &[(usize, u32)]) -> LinkStateBody {
        let mut routers: Vec<_> =
            links.iter().map(|(n, cost)| Adjacency { node: self.node(*n), cost: *cost }).collect();
        routers.sort_by_key(|a| a.node);
        LinkStateBody {
            chain: node.chain_bytes(),
            seq,
            issued_at: self.clock.now().unix,
            lease_ms: LEASE.as_millis() as u32,
            floor: 0,
            transit: true,
            routers,
            attached: vec![],
        }
    }

    /// Sends a router's link state over a link: the routers that it is linked to, and whether the owner is.
    fn says(&mut self, link: u32, router: usize, links: &[(usize, u32)], owner: bool) {
        self.seq += 1;
        let attached = owner.then(|| self.owner.node_id().tag()).into_iter().collect();
        let node = self.routers[router - 1].clone();
        let body = LinkStateBody { attached, ..self.link_state(&node, self.seq, links) };
        let signed = node.sign_link_state(&body);
        self.frame(link, Control::LinkState { signed });
        self.pass(ms(100));
    }

    /// Sends the owner's link state: the routers that it is attached to.
    fn owner_says(&mut self, link: u32, floor: u64, routers: &[(usize, u32)]) {
        self.seq += 1;
        let body = LinkStateBody { floor, transit: false, ..self.link_state(&self.owner, self.seq, routers) };
        let signed = self.owner.sign_link_state(&body);
        self.frame(link, Control::LinkState { signed });
        self.pass(ms(100));
    }

    fn advert_frame(&self, seq: u64, withdraw: bool, blinds: &[Blind]) -> Control {
        self.advert_of(&self.owner, seq, withdraw, blinds)
    }

    fn advert_of(&self, owner: &Identity, seq: u64, withdraw: bool, blinds: &[Blind]) -> Control {
        let body = AdvertBody {
            chain: owner.chain_bytes(),
            seq,
            issued_at: self.clock.now().unix,
            lease_ms: LEASE.as_millis() as u32,
            withdraw,
            blinds: blinds.to_vec(),
        };
        Control::Advert { cost: 0, signed: owner.sign_advert(&body) }
    }

    fn advert(&mut self, link: u32, seq: u64, blinds: &[Blind]) {
        self.frame(link, self.advert_frame(seq, false, blinds));
    }

    /// All three neighbours are linked to this router; the owner is at router 4, which 1 and 2 reach at these costs.
    fn with_owner_behind(&mut self, over_1: u32, over_2: u32) {
        self.says(1, 1, &[(0, 1000), (4, over_1)], false);
        self.says(2, 2, &[(0, 1000), (4, over_2)], false);
        self.says(1, 4, &[(1, over_1), (2, over_2)], true);
        self.owner_says(1, 0, &[(4, 500)]);
        self.advert(1, 10, &[A]);
    }

    /// A proxy behind link 4 has a granted branch over router 1.
    fn with_branch() -> Self {
        let mut bench = Self::new();
        bench.with_proxies();
        bench.with_owner_behind(5000, 9000);
        bench.join(4, 1, &A);
        bench.grant(1, 1, &A);
        bench
    }

    fn link_down(&mut self, link: u32) {
        self.sent.clear();
        self.router.handle_link_down(self.clock.now(), LinkId(link));
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

    /// Returns the link in use, and the cost.
    fn route(&self, blind: &Blind) -> Option<(u32, u32)> {
        self.router.route(&self.name(blind)).map(|(link, cost)| (link.0, cost))
    }

    /// A proxy asks to subscribe.
    fn join(&mut self, link: u32, sink: u8, blind: &Blind) {
        let body = JoinBody {
            name: self.name(blind),
            sink: SinkId([sink; 16]),
            request: Request::Subscribe { describe: false },
            issued_at: self.clock.now().unix,
            chain: self.user.chain_bytes(),
            reply_key: Bytes::from_static(&[1; 32]),
        };
        let signed = self.user.sign_join(&body);
        self.frame(link, Control::Join { signed });
    }

    fn grant(&mut self, link: u32, sink: u8, blind: &Blind) {
        self.grant_by(&self.owner.clone(), link, sink, blind);
    }

    /// Returns a grant signed by a node, in the owner's place or as the owner under another certificate.
    fn grant_by(&mut self, signer: &Identity, link: u32, sink: u8, blind: &Blind) {
        let answer = Answer::Grant { enc: Bytes::new(), sealed: Bytes::new() };
        let (name, sink) = (self.name(blind), SinkId([sink; 16]));
        let signed = signer.sign_answer(&AnswerBody { name, sink, serial: 1, answer });
        self.frame(link, Control::Answer { signed });
    }

    /// Returns the kinds of the frames sent since the last call, with their links.
    fn told(&self) -> Vec<(u32, &'static str)> {
        let kind = |frame: &Control| match frame {
            Control::Advert { signed, .. } => {
                let body = AdvertBody::from_slice(&signed.body).expect("as it was signed");
                if body.withdraw { "withdrawal" } else { "advert" }
            }
            Control::LinkState { .. } => "link state",
            Control::Query { .. } => "query",
            Control::Unreach { .. } => "unreach",
            Control::Join { .. } => "join",
            Control::Answer { .. } => "answer",
            Control::Leave { .. } => "leave",
            Control::Reject { reason: RejectReason::RouteLost, .. } => "route lost",
            Control::Reject { reason: RejectReason::NoRoute, .. } => "no route",
            Control::Reject { .. } => "reject",
            Control::Reroute { .. } => "reroute",
            _ => "other",
        };
        let mut told: Vec<_> = self.sent.iter().map(|(link, frame)| (*link, kind(frame))).collect();
        told.sort_unstable();
        told
    }

    /// Returns the links for a packet to all that came in over a link.
    fn egress(&self, ingress: u32) -> Vec<u32> {
        self.entry.iter().flat_map(|e| e.egress(LinkId(ingress))).map(|l| l.0).collect()
    }

    /// A proxy on link 4 and one on link 5.
    fn with_proxies(&mut self) {
        for (link, name) in [(4, "desk"), (5, "wall")] {
            self.up(link, &identity(&Member::new(name)).clone(), false, 1000);
        }
    }
}

#[test]
fn the_cheapest_way_is_taken_and_a_change_of_cost_moves_it() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    assert_eq!(bench.route(&A), Some((1, 1000 + 5000 + 500)));
    bench.says(2, 2, &[(0, 1000), (4, 2000)], false);
    assert_eq!(bench.route(&A), Some((2, 1000 + 2000 + 500)));
}

#[test]
fn a_router_that_begins_speaks_once_of_all_links_that_come_up_with_it() {
    let mut bench = Bench::new();
    assert_eq!(bench.router.stats().nodes, 0);
    bench.sent.clear();
    bench.pass(ms(500));
    assert_eq!(bench.told(), [(1, "link state"), (2, "link state"), (3, "link state")]);
    let Control::LinkState { signed } = &bench.sent[0].1 else { unreachable!() };
    let body = LinkStateBody::from_slice(&signed.body).unwrap();
    assert_eq!(body.routers.len(), 3);
}

#[test]
fn an_edge_counts_only_if_both_its_ends_say_it() {
    let mut bench = Bench::new();
    bench.says(1, 1, &[(0, 1000), (4, 10)], true);
    // Router 1 claims links to 4 and to the owner; neither of them lists the link.
    bench.says(1, 4, &[(2, 10)], true);
    bench.owner_says(1, 0, &[(4, 500)]);
    bench.advert(1, 10, &[A]);
    assert_eq!(bench.route(&A), None);
    bench.says(1, 4, &[(1, 10), (2, 10)], true);
    assert_eq!(bench.route(&A), Some((1, 1510)));
    bench.says(1, 4, &[(1, 10), (2, 10)], false);
    assert_eq!(bench.route(&A), None, "the router does not see the owner any more");
}

#[test]
fn a_link_state_goes_to_all_others_once_and_an_old_one_nowhere() {
    let mut bench = Bench::new();
    bench.pass(ms(200));
    bench.seq = 10;
    bench.says(1, 4, &[(1, 10)], false);
    assert_eq!(bench.told(), [(2, "link state"), (3, "link state")]);
    bench.seq = 4;
    bench.says(2, 4, &[(1, 10)], false);
    assert_eq!((bench.told(), bench.dropped.as_slice()), (vec![], ["stale"].as_slice()));
    bench.says(1, 1, &[(0, 1000)], false);
    assert_eq!(bench.told(), [(2, "link state"), (3, "link state")]);
    bench.seq = 0;
    bench.says(1, 1, &[], false);
    assert_eq!(bench.told(), [(1, "link state")], "who is behind its own word hears it");
}

#[test]
fn a_node_that_may_not_route_cannot_say_that_it_does() {
    let mut bench = Bench::new();
    let body = bench.link_state(&bench.owner, 1, &[]);
    let signed = bench.owner.sign_link_state(&body);
    bench.frame(1, Control::LinkState { signed });
    assert_eq!((bench.dropped.as_slice(), bench.router.stats().nodes), (["not_router"].as_slice(), 0));
}

#[test]
fn the_holder_of_an_invitation_reaches_the_authority_and_nobody_else() {
    let mut bench = Bench::new();
    bench.user = invited("acme", 1);
    let operations = operations_blind(&bench.owner.as_peer().ca);
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    bench.advert(1, 11, &[A, operations]);
    bench.join(4, 1, &A);
    let rejected = |(link, frame): &(u32, Control)| {
        *link == 4 && matches!(frame, Control::Reject { reason: RejectReason::NotVerified, .. })
    };
    assert!(bench.sent.len() == 1 && bench.sent.iter().all(rejected), "{:?}", bench.sent);
    assert_eq!(bench.dropped, ["invited"]);
    bench.join(4, 2, &operations);
    assert!(matches!(bench.sent[..], [(1, Control::Join { .. })]), "{:?}", bench.sent);
    // It has no names of its own, and no place in the mesh.
    bench.dropped.clear();
    let own = bench.advert_of(&bench.user, 1, false, &[B]);
    bench.frame(4, own);
    let signed = bench.user.sign_link_state(&bench.link_state(&bench.user, 1, &[]));
    bench.frame(4, Control::LinkState { signed: signed.clone() });
    assert_eq!((bench.sent.len(), bench.dropped.as_slice()), (0, ["not_verified"; 2].as_slice()));
    // A router of an earlier version passes its word on, however often, and keeps its link; its own link ends.
    for (link, is_closed) in [(1, false), (4, true)] {
        for _ in 0..100 {
            bench.frame(link, Control::LinkState { signed: signed.clone() });
        }
        assert_eq!(bench.closed.contains(&link), is_closed, "link {link}");
    }
}

#[test]
fn a_proxy_says_only_where_it_is_itself() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.says(4, 4, &[(1, 10)], true);
    bench.owner_says(4, 0, &[(1, 10)]);
    assert_eq!(bench.dropped, ["not_owner", "not_owner"]);
}

#[test]
fn only_the_required_kind_of_path_counts_for_a_name() {
    let mut bench = Bench::with_kind(MappingKind::Flood, Limits::default(), false);
    let neighbour = Neighbour { direct: Some(DirectReach::Far), ..Neighbour::from(bench.owner.as_peer()) };
    bench.router.handle_link_up(bench.clock.now(), LinkId(4), neighbour);
    bench.frame(4, hello(4, false));
    let names = vec![bench.name(&A), bench.name(&B)];
    bench.frame(0, Control::Interest { names });
    let over = |bench: &Bench, blind| bench.route(blind).map(|(link, _)| link);
    bench.router.require_path(bench.name(&A), Some(PathKind::Relayed));
    let advert = bench.advert_frame(1, false, &[A, B]);
    bench.frame(4, advert.clone());
    assert_eq!((over(&bench, &A), over(&bench, &B)), (None, Some(4)), "it waits for a router");
    bench.frame(1, advert);
    assert_eq!(over(&bench, &A), Some(1));
    bench.join(0, 1, &A);
    assert_eq!(bench.told(), [(1, "join")]);
    bench.router.require_path(bench.name(&A), Some(PathKind::Direct));
    assert_eq!(over(&bench, &A), Some(4));
    bench.link_down(4);
    assert_eq!((over(&bench, &A), over(&bench, &B)), (None, Some(1)));
    bench.router.require_path(bench.name(&A), None);
    assert_eq!(over(&bench, &A), Some(1));
}

#[test]
fn this_nodes_word_of_a_run_with_a_wrong_clock_is_overtaken() {
    let mut bench = Bench::new();
    let ahead = bench.clock.now().unix.0 + 1_000_000;
    let body = bench.link_state(&bench.own, ahead, &[]);
    let signed = bench.own.sign_link_state(&body);
    bench.frame(1, Control::LinkState { signed });
    bench.pass(ms(200));
    let newest = bench.sent.iter().filter_map(|(_, frame)| match frame {
        Control::LinkState { signed } => Some(LinkStateBody::from_slice(&signed.body).expect("ours").seq),
        _ => None,
    });
    assert_eq!(newest.max(), Some(ahead + 1));
}

#[test]
fn a_link_that_fell_silent_is_left_where_there_is_another_way() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    let silent = LinkQuality { round_trip: ms(1), is_silent: true, ..LinkQuality::default() };
    bench.router.handle_link_quality(bench.clock.now(), LinkId(1), silent);
    bench.drain();
    bench.pass(ms(200));
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(2));
    bench.link_down(2);
    bench.pass(ms(200));
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(1), "it is better than none");
}

#[test]
fn owner_adds_the_loss_of_a_direct_link_to_the_cost_that_it_tells_there() {
    let mut bench = Bench::with_kind(MappingKind::Flood, Limits::default(), false);
    let name = name_of(&bench.own.node_id(), &A);
    bench.frame(0, bench.advert_of(&bench.own.clone(), 1, false, &[A]));
    let desk = identity(&Member::new("desk"));
    let far = Neighbour { direct: Some(DirectReach::Far), ..Neighbour::from(desk.as_peer()) };
    bench.router.handle_link_up(bench.clock.now(), LinkId(5), far);
    bench.frame(5, hello(5, false));
    bench.frame(5, Control::Interest { names: vec![name] });
    let told = |bench: &Bench| {
        let costs = bench.sent.iter().filter_map(|(link, frame)| match frame {
            Control::Advert { cost, .. } => Some((*link, *cost)),
            _ => None,
        });
        costs.collect::<Vec<_>>()
    };
    assert_eq!(told(&bench), [(5, 0)]);
    bench.sent.clear();
    let mut sent_packets = 0;
    let mut measure = |bench: &mut Bench, lost_packets| {
        bench.clock.advance_to(bench.clock.instant() + Duration::from_secs(5));
        sent_packets += 500;
        let quality = LinkQuality { round_trip: ms(20), sent_packets, lost_packets, is_silent: false };
        bench.router.handle_link_quality(bench.clock.now(), LinkId(5), quality);
        bench.drain();
        told(bench)
    };
    assert_eq!(measure(&mut bench, 0), []);
    let lossy = measure(&mut bench, 100);
    assert!(matches!(lossy[..], [(5, 30_000..)]), "{lossy:?}");
    bench.sent.clear();
    // It is not told again as long as it is about the same, and once it is over.
    assert_eq!(measure(&mut bench, 150), []);
    for _ in 0..5 {
        measure(&mut bench, 150);
    }
    assert_eq!(told(&bench).last(), Some(&(5, 0)));
}

#[test]
fn names_are_told_to_all_routers_or_to_those_who_ask() {
    for (mapping, told) in
        [(MappingKind::Flood, vec![(2, "advert"), (3, "advert")]), (MappingKind::Query, vec![])]
    {
        let mut bench = Bench::with(mapping, Limits::default());
        bench.up(4, &bench.owner.clone(), false, 1000);
        bench.owner_says(4, 0, &[(0, 1000)]);
        bench.advert(4, 10, &[A, B]);
        let from_proxy: Vec<_> = bench.told().into_iter().filter(|(link, _)| *link != 1).collect();
        assert_eq!(from_proxy, told, "{mapping:?}");
        let names = vec![bench.name(&A)];
        bench.frame(1, Control::Query { id: 0, hops: 0, names });
        assert_eq!(bench.told(), [(1, "advert"), (1, "link state")], "{mapping:?}: an answer");
        // The asker is told of changes.
        bench.frame(4, bench.advert_frame(11, true, &[A]));
        assert!(bench.told().contains(&(1, "withdrawal")), "{mapping:?}");
    }
}

#[test]
fn an_unknown_name_is_asked_for_once_and_all_who_asked_are_answered() {
    let mut bench = Bench::with(MappingKind::Query, Limits::default());
    let names = vec![bench.name(&A)];
    bench.frame(1, Control::Query { id: 1, hops: 0, names: names.clone() });
    assert_eq!(bench.told(), [(2, "query"), (3, "query")]);
    bench.frame(3, Control::Query { id: 1, hops: 1, names: names.clone() });
    assert_eq!(bench.told(), [], "the same question by another way");
    bench.frame(2, Control::Query { id: 2, hops: 63, names: names.clone() });
    assert_eq!((bench.told(), bench.dropped.as_slice()), (vec![], ["hop_limit"].as_slice()));
    bench.frame(2, Control::Query { id: 3, hops: 1, names: names.clone() });
    assert_eq!(bench.told(), [], "one for the same name is under way");
    bench.up(4, &bench.owner.clone(), false, 1000);
    bench.owner_says(4, 0, &[(0, 1000)]);
    bench.advert(4, 10, &[A]);
    let adverts: Vec<_> = bench.told().into_iter().filter(|(_, what)| *what == "advert").collect();
    assert_eq!(adverts, [(1, "advert"), (2, "advert")], "3 did not ask of its own");
    bench.frame(3, Control::Query { id: 1, hops: 1, names: names.clone() });
    assert_eq!(bench.told(), [], "a late copy");
    bench.frame(3, Control::Query { id: 4, hops: 0, names });
    assert!(bench.told().contains(&(3, "advert")));
}

#[test]
fn a_waiting_sink_makes_the_router_ask_again_and_again() {
    for mapping in [MappingKind::Flood, MappingKind::Query] {
        let mut bench = Bench::with(mapping, Limits::default());
        bench.with_proxies();
        let names = vec![bench.name(&A)];
        bench.pass(ms(200));
        bench.frame(4, Control::Interest { names: names.clone() });
        let asked = [(1, "query"), (2, "query"), (3, "query")];
        assert_eq!(bench.told(), asked);
        bench.sent.clear();
        bench.pass(Duration::from_secs(21));
        assert_eq!(bench.told(), asked);
        bench.frame(4, Control::Uninterest { names });
        bench.sent.clear();
        bench.pass(Duration::from_secs(50));
        assert_eq!(bench.told(), []);
        bench.pass(Duration::from_secs(200));
        assert_eq!(bench.router.stats().names, 0, "nothing is left");
    }
}

#[test]
fn an_answer_that_is_not_renewed_in_time_is_asked_of_everyone() {
    let mut bench = Bench::with(MappingKind::Query, Limits::default());
    bench.with_proxies();
    let names = vec![bench.name(&A)];
    bench.frame(4, Control::Interest { names });
    bench.with_owner_behind(5000, 9000);
    assert!(bench.route(&A).is_some());
    bench.sent.clear();
    bench.pass(Duration::from_secs(21));
    assert_eq!(bench.told(), [(1, "query")], "who answered goes on telling");
    bench.sent.clear();
    bench.pass(Duration::from_secs(20));
    assert_eq!(bench.told(), [(1, "query"), (2, "query"), (3, "query")], "half of the lease is over");
    bench.advert(2, 11, &[A]);
    bench.sent.clear();
    bench.pass(Duration::from_secs(20));
    let asked: Vec<_> = bench.told().into_iter().filter(|(_, what)| *what == "query").collect();
    assert_eq!(asked, [(2, "query")]);
}

#[test]
fn an_advertisement_told_before_anybody_wanted_it_is_asked_for_if_it_is_not_renewed_in_time() {
    for mapping in [MappingKind::Flood, MappingKind::Query] {
        let mut bench = Bench::with(mapping, Limits::default());
        bench.with_proxies();
        // An attacker may replay it and withhold the later ones.
        bench.with_owner_behind(5000, 9000);
        bench.frame(4, Control::Interest { names: vec![bench.name(&A)] });
        assert_eq!(asked_of(&bench, 1), [], "it is known");
        bench.sent.clear();
        bench.pass(LEASE / 2);
        assert_eq!([1, 2, 3].map(|link| asked_of(&bench, link).len()), [1; 3], "half of the lease is over");
        bench.frame(5, Control::Interest { names: vec![bench.name(&A)] });
        bench.advert(2, 11, &[A]);
        bench.sent.clear();
        bench.pass(Duration::from_secs(20));
        assert_eq!(
            [1, 2, 3].map(|link| asked_of(&bench, link).len()),
            [0, 1, 0],
            "who answered goes on telling"
        );
    }
}

#[test]
fn an_advertisement_that_came_too_late_to_be_believed_by_others_is_not_told() {
    let mut bench = Bench::new();
    let lease_ms = 600_000;
    let body = AdvertBody {
        chain: bench.owner.chain_bytes(),
        seq: 10,
        issued_at: bench.clock.now().unix,
        lease_ms,
        withdraw: false,
        blinds: vec![A],
    };
    let advert = Control::Advert { cost: 0, signed: bench.owner.sign_advert(&body) };
    let body = LinkStateBody { lease_ms, ..bench.link_state(&bench.routers[3], 1, &[]) };
    let link_state = Control::LinkState { signed: bench.routers[3].sign_link_state(&body) };
    let late = bench.routers[4].clone();
    // The link states of router 4, which is not linked, and of the owner.
    let told = |bench: &Bench| {
        let all = bench.sent.iter().filter(|(link, _)| *link >= 6);
        all.filter(|(_, frame)| *frame == advert || *frame == link_state).count()
    };
    bench.pass(Duration::from_secs(300));
    bench.frame(1, advert.clone());
    bench.frame(1, link_state.clone());
    bench.up(6, &late, true, 1000);
    assert_eq!(told(&bench), 2);
    bench.pass(Duration::from_secs(295));
    assert_eq!(bench.router.stats().names, 1, "its lease is not over");
    bench.link_down(6);
    bench.up(7, &late, true, 1000);
    assert_eq!(told(&bench), 0);
}

#[test]
fn questions_are_bounded() {
    // A router may ask for sixteen times as many.
    let limits = Limits { queries_burst: 1, interests_per_peer_max: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Query, limits);
    let names: Vec<_> = (0..12).map(|n| bench.name(&numbered(n))).collect();
    bench.frame(1, Control::Query { id: 0, hops: 0, names });
    let asked = |bench: &Bench| match &bench.sent[..] {
        [(2, Control::Query { names, .. }), (3, _)] => names.len(),
        other => panic!("{other:?}"),
    };
    assert_eq!((asked(&bench), bench.dropped.as_slice()), (8, ["limit"].as_slice()));
    let names: Vec<_> = (20..28).map(|n| bench.name(&numbered(n))).collect();
    bench.frame(1, Control::Query { id: 0, hops: 0, names });
    assert_eq!((bench.sent.len(), bench.dropped.len()), (0, 2), "too fast");
}

#[test]
fn flooded_announcements_and_interests_of_a_node_are_bounded() {
    let limits = Limits { announcements_burst: 8, queries_burst: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    bench.with_proxies();
    let mut passed_on = 0;
    for seq in 10..30 {
        bench.advert(1, seq, &[A]);
        passed_on += bench.sent.iter().filter(|(link, _)| *link == 2).count();
    }
    assert_eq!((passed_on, bench.dropped.len()), (8, 0), "it is known here, and goes no further for now");
    bench.sent.clear();
    bench.pass(Duration::from_secs(10));
    let told: Vec<_> =
        bench.sent.iter().filter(|(link, frame)| *link == 2 && advert_seq(frame).is_some()).collect();
    assert_eq!(told.len(), 1, "the newest alone goes on when there is room");
    assert_eq!(advert_seq(&told[0].1), Some(29));
    let names: Vec<_> = (0..9).map(|n| bench.name(&numbered(n))).collect();
    bench.frame(4, Control::Interest { names });
    assert_eq!((bench.dropped.as_slice(), bench.told()), (["limit"].as_slice(), vec![]));
}

#[test]
fn link_states_beyond_what_a_node_may_sign_are_passed_on_later() {
    let mut bench = Bench::with(MappingKind::Flood, Limits { announcements_burst: 8, ..Limits::default() });
    bench.pass(ms(200));
    let mut passed_on = 0;
    for _ in 0..20 {
        bench.seq += 1;
        let signed = bench.routers[3].sign_link_state(&bench.link_state(&bench.routers[3], bench.seq, &[]));
        bench.frame(1, Control::LinkState { signed });
        passed_on += bench.sent.iter().filter(|(link, _)| *link == 2).count();
    }
    assert_eq!((passed_on, bench.dropped.len()), (8, 0));
    bench.sent.clear();
    bench.pass(Duration::from_secs(3));
    let newest = bench.sent.iter().filter_map(|(link, frame)| match frame {
        Control::LinkState { signed } if *link == 2 => LinkStateBody::from_slice(&signed.body).ok(),
        _ => None,
    });
    assert_eq!(newest.map(|body| body.seq).collect::<Vec<_>>(), [bench.seq]);
}

fn advert_seq(frame: &Control) -> Option<u64> {
    let Control::Advert { signed, .. } = frame else { return None };
    AdvertBody::from_slice(&signed.body).ok().map(|body| body.seq)
}

/// Asserts that fresh advertisements and link states of the owner reach link 3, in their order.
fn assert_news_passes(bench: &mut Bench, from: u64) {
    for seq in from..from + 12 {
        bench.advert(1, seq, &[A]);
        let passed: Vec<_> =
            bench.sent.iter().filter(|(link, _)| *link == 3).filter_map(|(_, f)| advert_seq(f)).collect();
        assert_eq!(passed, [seq], "{:?}", bench.dropped);
        bench.sent.clear();
        bench.owner_says(1, 0, &[(4, 500)]);
        assert!(bench.told().contains(&(3, "link state")), "{:?}", bench.dropped);
        bench.pass(Duration::from_secs(1));
    }
}

#[test]
fn replays_of_a_nodes_announcements_leave_it_its_allowance_and_cost_who_brings_them() {
    let limits = Limits { announcements_burst: 32, stale_burst: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    bench.with_owner_behind(5000, 9000);
    let (mut adverts, mut states) = (vec![], vec![]);
    for seq in 11..41 {
        adverts.push(bench.advert_frame(seq, false, &[A]));
        bench.frame(1, adverts[adverts.len() - 1].clone());
        bench.seq += 1;
        let body = LinkStateBody { transit: false, ..bench.link_state(&bench.owner, bench.seq, &[(4, 500)]) };
        states.push(Control::LinkState { signed: bench.owner.sign_link_state(&body) });
        bench.frame(1, states[states.len() - 1].clone());
        bench.pass(Duration::from_secs(1));
    }
    bench.dropped.clear();
    let mut fresh = 41;
    for _ in 0..3 {
        for n in 0..1000 {
            for old in [&adverts[n % 30], &states[n % 30]] {
                bench.frame(2, old.clone());
                assert_eq!(bench.told(), [], "no replay goes on");
            }
        }
        assert_news_passes(&mut bench, fresh);
        fresh += 12;
    }
    let of = |key| bench.dropped.iter().filter(|d| **d == key).count();
    assert_eq!(of("limit"), 0);
    // Remembered ones are recognised by their digest at once; others cost a verification, which is charged.
    assert!(of("stale_flood") > 2000, "{}", of("stale_flood"));
    // Others bring news as before: the neighbour pays for itself.
    bench.dropped.clear();
    bench.says(3, 3, &[(0, 1000)], false);
    assert_eq!(bench.dropped, [""; 0]);
}

#[test]
fn an_announcement_whose_lease_is_over_is_not_news_again() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    let older = bench.advert_frame(11, false, &[B]);
    let last = bench.advert_frame(12, false, &[A, B]);
    bench.frame(1, last.clone());
    let where_it_is = LinkStateBody { transit: false, ..bench.link_state(&bench.owner, 90, &[(4, 500)]) };
    let where_it_is = Control::LinkState { signed: bench.owner.sign_link_state(&where_it_is) };
    bench.frame(1, where_it_is.clone());
    bench.pass(LEASE + ms(1000));
    assert_eq!((bench.route(&A), bench.router.stats().names), (None, 0));
    let nodes = bench.router.stats().nodes;
    // They verify for nine more minutes.
    for old in [&older, &last, &where_it_is] {
        bench.frame(2, old.clone());
        assert_eq!(bench.told(), []);
    }
    assert_eq!((bench.router.stats().names, bench.router.stats().nodes), (0, nodes));
    assert_eq!(bench.dropped, ["stale"; 3]);
    bench.seq = 100;
    bench.with_owner_behind(5000, 9000);
    assert_eq!(bench.route(&A), None, "what comes with an old number does not count");
    bench.advert(1, 13, &[A]);
    assert!(bench.route(&A).is_some());
}

#[test]
fn an_owner_hears_which_number_it_has_to_exceed_after_its_lease() {
    let mut bench = Bench::new();
    bench.up(6, &bench.owner.clone(), false, 1000);
    bench.advert(6, 50, &[A]);
    bench.seq = 5;
    bench.owner_says(6, 0, &[(0, 1000)]);
    bench.pass(LEASE + ms(1000));
    bench.advert(6, 20, &[B]);
    let told: Vec<_> =
        bench.sent.iter().filter_map(|(link, frame)| Some((*link, advert_seq(frame)?))).collect();
    assert_eq!(told, [(6, 50)]);
    bench.seq = 0;
    bench.owner_says(6, 0, &[(0, 1000)]);
    assert_eq!(bench.told(), [(6, "link state")]);
}

#[test]
fn a_withdrawal_displaces_no_record_of_another_owner() {
    let limits = Limits { tombstones_max: 64, adverts_per_owner_max: 40, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    bench.with_owner_behind(5000, 9000);
    let old = bench.advert_frame(11, false, &[B]);
    bench.frame(1, old.clone());
    bench.frame(1, bench.advert_frame(12, true, &[B]));
    let mallory = identity(&Member::new("mallory"));
    let first = bench.advert_of(&mallory, 19, false, &[numbered(20)]);
    for n in 20..400 {
        let blinds = [numbered(n as usize)];
        bench.frame(1, bench.advert_of(&mallory, 2 * n, false, &blinds));
        bench.frame(1, bench.advert_of(&mallory, 2 * n + 1, true, &blinds));
        bench.pass(ms(100));
    }
    assert!(bench.router.stats().tombstones <= 64);
    bench.dropped.clear();
    bench.frame(2, old);
    assert_eq!((bench.route(&B), bench.dropped.as_slice()), (None, ["stale"].as_slice()));
    // Its earlier advertisement, which it displaced, is void all the same.
    bench.frame(2, first);
    assert_eq!((bench.told(), bench.dropped.len()), (vec![], 2));
}

#[test]
fn advertisements_of_an_owner_are_bounded_in_records_and_bytes() {
    // A record of 256 names of which only one is left, repeatedly.
    let all: Vec<_> = (0..255).map(numbered).collect();
    let of_records = Limits { adverts_per_owner_max: 20, ..Limits::default() };
    let of_bytes = Limits { advert_bytes_per_owner_max: 20 * 50_000, ..Limits::default() };
    for limits in [of_records, of_bytes] {
        let mut bench = Bench::with(MappingKind::Flood, limits);
        let honest = bench.advert_of(&bench.user, 10, false, &[A]);
        bench.frame(1, honest);
        for n in 0..200 {
            let blinds: Vec<_> = all.iter().copied().chain([numbered(1000 + n)]).collect();
            bench.advert(1, 10 + n as u64, &blinds);
            bench.pass(ms(40));
        }
        let names = bench.router.stats().names;
        assert!((256..256 + 1 + 24).contains(&names), "{names}");
        assert!(bench.router.route(&name_of(&bench.user.node_id(), &A)).is_none() && names > 256);
        // The oldest are gone, the newest are there, and a replay does not bring the old ones back.
        bench.dropped.clear();
        let blinds: Vec<_> = all.iter().copied().chain([numbered(1000)]).collect();
        bench.advert(2, 10, &blinds);
        assert_eq!((bench.dropped.as_slice(), bench.router.stats().names), (["stale"].as_slice(), names));
    }
}

#[test]
fn a_name_that_is_said_many_times_at_once_is_one_name() {
    let limits = Limits { adverts_per_owner_max: 4, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    let mallory = identity(&Member::new("mallory"));
    // Names withdrawn 256 times take the room of one withdrawal, so others' names find room.
    bench.frame(1, bench.advert_of(&mallory, 10, true, &[numbered(0); 256]));
    assert_eq!(bench.router.stats().tombstones, 1);
    let honest = bench.advert_of(&bench.user, 10, false, &[A]);
    bench.frame(1, honest);
    assert!(!bench.dropped.contains(&"limit"), "{:?}", bench.dropped);
    // Records of such names give way like others: without that, making room never ends.
    for n in 1..=10 {
        bench.frame(1, bench.advert_of(&mallory, 10 + n, false, &[numbered(n as usize); 256]));
        assert!(bench.router.stats().names <= 1 + 4, "{:?}", bench.router.stats());
    }
    // And they end with their lease.
    bench.pass(2 * LEASE);
    assert_eq!(bench.router.stats().names, 0);
}

#[test]
fn a_sequence_number_without_a_greater_one_is_not_believed() {
    let mut bench = Bench::new();
    for seq in [u64::MAX, u64::MAX - 1, bench.clock.now().unix.0 + (11 * 365 * 86_400_000)] {
        bench.advert(1, seq, &[A]);
        let body = bench.link_state(&bench.routers[3], seq, &[]);
        let signed = bench.routers[3].sign_link_state(&body);
        bench.frame(1, Control::LinkState { signed });
    }
    assert_eq!(bench.dropped, ["not_verified"; 6]);
    assert_eq!(bench.router.stats().names, 0);
}

#[test]
fn a_router_that_greets_is_told_in_parts_as_its_link_takes_them() {
    let mut bench =
        Bench::with(MappingKind::Flood, Limits { adverts_per_owner_max: 10_000, ..Limits::default() });
    bench.with_owner_behind(5000, 9000);
    for n in 0..9000 {
        bench.advert(1, 11 + n as u64, &[numbered(n)]);
        bench.pass(ms(40));
    }
    // The last announcements of the others are a minute old.
    let names = bench.router.stats().names;
    assert!(names > 1400, "{names}");
    bench.stuck = true;
    let late = bench.routers[4].clone();
    bench.up(6, &late, true, 1000);
    let (mut adverts, mut parts) = (std::collections::BTreeSet::new(), 0);
    loop {
        let to_late: Vec<_> = bench.sent.iter().filter(|(link, _)| *link == 6).collect();
        assert!(to_late.len() <= 260, "{} frames in one turn", to_late.len());
        adverts.extend(to_late.iter().filter_map(|(_, frame)| advert_seq(frame)));
        parts += 1;
        let Some(link) = bench.flushes.pop() else { break };
        assert_eq!((link, bench.flushes.len()), (LinkId(6), 0));
        bench.sent.clear();
        if parts == 3 {
            // News do not wait for the rest of the state.
            bench.advert(1, 20_000, &[B]);
            assert!(bench.told().contains(&(6, "advert")));
            bench.sent.clear();
        }
        bench.router.handle_flushed(bench.clock.now(), link);
        bench.drain();
    }
    assert_eq!((adverts.len(), parts), (names, names.div_ceil(256)));
    // A link that ends meanwhile is told nothing more.
    bench.up(7, &late, true, 1000);
    let link = bench.flushes.pop().expect("there is more than a part");
    bench.link_down(7);
    bench.router.handle_flushed(bench.clock.now(), link);
    bench.drain();
    assert!(bench.sent.iter().all(|(link, _)| *link != 7));
}

#[test]
fn advertisements_from_before_an_owners_restart_are_void() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    bench.owner_says(1, 11, &[(4, 500)]);
    assert_eq!((bench.route(&A), bench.router.stats().routed_names), (None, 0));
    bench.advert(2, 10, &[B]);
    assert_eq!((bench.route(&B), bench.dropped.as_slice()), (None, ["stale"].as_slice()));
    bench.advert(2, 11, &[A]);
    assert!(bench.route(&A).is_some());
}

#[test]
fn a_router_that_comes_later_hears_what_was_withdrawn() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    bench.advert(1, 11, &[A, B]);
    bench.frame(1, bench.advert_frame(12, true, &[B]));
    bench.sent.clear();
    let late = bench.routers[4].clone();
    bench.up(6, &late, true, 1000);
    let to_late: Vec<_> =
        bench.told().into_iter().filter(|(l, what)| *l == 6 && *what != "link state").collect();
    assert!(to_late.contains(&(6, "advert")) && to_late.contains(&(6, "withdrawal")), "{to_late:?}");
    bench.advert(3, 11, &[A, B]);
    assert_eq!(bench.route(&B), None, "a replay does not bring it back");
}

#[test]
fn a_name_ends_with_its_lease_and_no_lease_is_longer_than_the_limit() {
    let limits = Limits { lease_max: Duration::from_secs(30), ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    bench.with_proxies();
    bench.up(6, &bench.owner.clone(), false, 1000);
    bench.advert(6, 10, &[A]);
    let names = vec![bench.name(&A)];
    bench.frame(4, Control::Interest { names });
    assert_eq!(bench.told(), [(4, "advert")]);
    bench.pass(Duration::from_secs(29));
    assert!(bench.route(&A).is_some());
    bench.sent.clear();
    bench.pass(Duration::from_secs(2));
    assert_eq!(bench.route(&A), None);
    assert!(bench.told().contains(&(4, "unreach")));
}

#[test]
fn a_branch_stays_on_its_way_until_its_sink_has_found_the_better_one() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    bench.join(4, 1, &A);
    assert_eq!(bench.told(), [(1, "join")]);
    bench.grant(1, 1, &A);
    assert_eq!(bench.egress(1), [4]);
    bench.sent.clear();
    bench.says(2, 2, &[(0, 1000), (4, 100)], false);
    assert!(bench.told().contains(&(4, "reroute")));
    assert_eq!(bench.egress(1), [4], "what flows goes on");
    bench.join(4, 2, &A);
    assert_eq!(bench.told(), [(2, "join")]);
    bench.grant(2, 2, &A);
    assert_eq!((bench.egress(2), bench.egress(1)), (vec![4], vec![]), "one copy");
    assert!(
        bench.entry.as_ref().is_some_and(|e| e.accepts_from(LinkId(1))),
        "what is under way is no attack"
    );
    let (name, sink) = (bench.name(&A), SinkId([1; 16]));
    bench.frame(4, Control::Leave { name, sink });
    assert_eq!((bench.told(), bench.egress(2)), (vec![(1, "leave")], vec![4]));
    assert!(bench.entry.as_ref().is_some_and(|e| !e.accepts_from(LinkId(1))));
}

#[test]
fn a_link_is_never_fed_from_an_older_way_again() {
    let mut bench = Bench::with_branch();
    bench.says(2, 2, &[(0, 1000), (4, 100)], false);
    bench.join(4, 2, &A);
    bench.grant(2, 2, &A);
    let (name, sink) = (bench.name(&A), SinkId([2; 16]));
    bench.frame(4, Control::Leave { name, sink });
    assert_eq!((bench.egress(1), bench.egress(2)), (vec![], vec![4]));
}

#[test]
fn a_sink_that_does_not_find_the_better_way_is_cut_in_the_end() {
    let mut bench = Bench::with_branch();
    bench.says(2, 2, &[(0, 1000), (4, 100)], false);
    bench.sent.clear();
    bench.pass(Duration::from_secs(11));
    let told = bench.told();
    assert!(told.contains(&(4, "route lost")) && told.contains(&(1, "leave")), "{told:?}");
    assert_eq!(bench.entry, None);
}

#[test]
fn a_branch_is_cut_with_its_link_and_one_that_waits_when_the_way_changes() {
    let mut bench = Bench::with_branch();
    bench.link_down(1);
    assert!(bench.told().contains(&(4, "route lost")));
    assert_eq!(bench.entry, None);
    bench.pass(ms(200));
    bench.join(5, 2, &A);
    assert_eq!(bench.told(), [(2, "join")]);
    bench.sent.clear();
    bench.says(3, 3, &[(0, 1000), (4, 10)], false);
    bench.says(3, 4, &[(2, 9000), (3, 10)], true);
    let told = bench.told();
    assert!(told.contains(&(5, "route lost")) && told.contains(&(2, "leave")), "{told:?}");
    assert_eq!(bench.router.stats().branches, 0);
}

#[test]
fn a_request_that_comes_back_is_refused() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    bench.join(3, 1, &A);
    bench.join(2, 1, &A);
    assert_eq!(bench.told(), [(2, "no route")]);
    bench.join(1, 2, &A);
    assert_eq!(bench.told(), [(1, "no route")], "not back where it came from");
}

#[test]
fn a_grant_for_a_sink_that_left_is_given_back() {
    let mut bench = Bench::new();
    bench.with_owner_behind(5000, 9000);
    bench.grant(1, 1, &A);
    assert_eq!((bench.told(), bench.dropped.as_slice()), (vec![(1, "leave")], ["unknown"].as_slice()));
    // The same for a sink whose request is known here over another link.
    bench.join(3, 2, &A);
    bench.grant(2, 2, &A);
    assert_eq!((bench.told(), bench.dropped.last()), (vec![(2, "leave")], Some(&"wrong_way")));
    bench.grant(1, 2, &A);
    assert_eq!(bench.told(), [(3, "answer")]);
}

/// The owner of the bench with its next certificate, which has another key.
fn renewed_owner() -> Arc<Identity> {
    identity(&Member { renewal: 1, ..Member::new("arm-1") })
}

#[test]
fn an_answer_with_a_key_that_is_not_known_yet_goes_no_further_and_its_bringer_is_asked() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    let renewed = renewed_owner();
    for sink in 1..200 {
        bench.join(4, sink, &A);
        assert_eq!(bench.told(), [(1, "join")]);
        bench.grant_by(&renewed, 1, sink, &A);
        assert_eq!(bench.told(), [(1, "leave"), (1, "query"), (4, "route lost")]);
        assert_eq!(bench.entry, None);
        bench.pass(ms(10));
    }
    // Its neighbour may be honest.
    assert_eq!((bench.closed.as_slice(), bench.dropped.last()), ([0; 0].as_slice(), Some(&"owner_key")));
    bench.frame(1, bench.advert_of(&renewed, 11, false, &[A]));
    bench.join(4, 200, &A);
    bench.grant_by(&renewed, 1, 200, &A);
    assert_eq!(bench.told(), [(4, "answer")]);
}

#[test]
fn an_answer_that_crossed_the_owners_renewal_is_verified_with_the_key_of_before() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    bench.join(4, 1, &A);
    bench.frame(2, bench.advert_of(&renewed_owner(), 11, false, &[A]));
    bench.grant(1, 1, &A);
    assert_eq!((bench.told(), bench.dropped.as_slice()), (vec![(4, "answer")], [""; 0].as_slice()));
    // A request that came after it has no such answer.
    bench.join(4, 2, &A);
    bench.grant(1, 2, &A);
    assert!(bench.told().contains(&(4, "route lost")), "{:?}", bench.told());
    assert_eq!(bench.dropped, ["owner_key"]);
}

#[test]
fn a_granted_branch_outlives_an_answer_that_nobody_known_signed_until_its_sink_asked_again() {
    let mut bench = Bench::with_branch();
    let mallory = identity(&Member::new("mallory"));
    bench.grant_by(&mallory, 1, 1, &A);
    assert_eq!(bench.told(), [(1, "query"), (4, "reroute")]);
    assert_eq!(bench.egress(1), [4], "what was granted goes on");
    bench.join(4, 2, &A);
    bench.grant(1, 2, &A);
    assert_eq!(bench.told(), [(4, "answer")]);
    bench.grant_by(&mallory, 1, 1, &A);
    assert!(bench.told().contains(&(4, "route lost")), "there is no third one: {:?}", bench.told());
    assert_eq!((bench.egress(1), bench.router.stats().branches), (vec![4], 1));
}

#[test]
fn an_answer_is_verified_when_its_name_is_not_known_any_more() {
    let mut bench = Bench::with_kind(MappingKind::Flood, Limits::default(), false);
    let names = vec![bench.name(&A)];
    bench.frame(0, Control::Interest { names: names.clone() });
    bench.advert(1, 10, &[A]);
    for sink in [1, 2] {
        bench.join(0, sink, &A);
        assert!(bench.told().contains(&(1, "join")), "{:?}", bench.told());
    }
    bench.frame(0, Control::Uninterest { names });
    assert_eq!(bench.route(&A), None);
    bench.grant_by(&identity(&Member::new("mallory")), 1, 1, &A);
    assert_eq!(
        (bench.told(), bench.dropped.as_slice()),
        (vec![(0, "route lost"), (1, "leave")], ["owner_key"].as_slice())
    );
    bench.grant(1, 2, &A);
    assert_eq!(bench.told(), [(0, "answer")]);
}

#[test]
fn a_newer_run_supersedes_and_an_older_one_that_greets_late_does_not() {
    let mut bench = Bench::new();
    let node = identity(&Member::new("wall"));
    let neighbour = Neighbour::from(node.as_peer());
    for link in [10, 11] {
        bench.router.handle_link_up(bench.clock.now(), LinkId(link), neighbour.clone());
    }
    bench.frame(11, hello(2, false));
    bench.frame(10, hello(1, false));
    let interest = Control::Interest { names: vec![bench.name(&A)] };
    bench.frame(10, interest.clone());
    assert_eq!(bench.dropped, ["no_link"]);
    bench.frame(11, interest);
    assert_eq!(bench.dropped, ["no_link"], "the newer link lives");
}

#[test]
fn names_are_bounded_for_each_owner_and_each_link() {
    for (limits, from) in [
        (Limits { names_per_owner_max: 3, ..Limits::default() }, 1),
        (Limits { names_per_router_max: 3, ..Limits::default() }, 2),
        (Limits { names_max: 3, ..Limits::default() }, 3),
    ] {
        let mut bench = Bench::with(MappingKind::Flood, limits);
        bench.advert(1, 10, &(0..3).map(numbered).collect::<Vec<_>>());
        bench.advert(1, 11, &(0..3).map(numbered).collect::<Vec<_>>());
        assert_eq!(bench.dropped, [""; 0], "known names are renewed ({from})");
        bench.advert(1, 12, &[numbered(3)]);
        assert_eq!((bench.dropped.as_slice(), bench.router.stats().names), (["limit"].as_slice(), 3));
    }
}

fn numbered(n: usize) -> Blind {
    let mut blind = [0; 32];
    blind[..8].copy_from_slice(&(n as u64).to_be_bytes());
    Blind(blind)
}

/// Names that nobody advertises.
fn unknown_names(bench: &Bench, from: usize, count: usize) -> Vec<Name> {
    (from..from + count).map(|n| bench.name(&numbered(1_000_000 + n))).collect()
}

#[test]
fn a_link_state_looks_again_only_at_names_whose_ways_it_may_change() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    let mut names = unknown_names(&bench, 0, 4000);
    names.push(bench.name(&A));
    bench.frame(4, Control::Interest { names });
    bench.pass(ms(200));
    let checked = |bench: &Bench| bench.router.route_stats().names_checked;
    let before = checked(&bench);
    let desk = bench.user.clone();
    for n in 0..20 {
        // A member that repeats its announcements, or raises the cost of its link each time.
        for cost in [1000, 1000 + n * 1000] {
            bench.seq += 1;
            let body = LinkStateBody { transit: false, ..bench.link_state(&desk, bench.seq, &[(0, cost)]) };
            bench.frame(4, Control::LinkState { signed: desk.sign_link_state(&body) });
            bench.pass(ms(100));
        }
    }
    assert_eq!((checked(&bench), bench.dropped.as_slice()), (before, [""; 0].as_slice()));
    let searches = bench.router.route_stats().searches;
    bench.owner_says(1, 0, &[(4, 500)]);
    assert_eq!((checked(&bench), bench.router.route_stats().searches), (before, searches), "a renewal");
    bench.owner_says(1, 0, &[(4, 600)]);
    assert_eq!((checked(&bench), bench.route(&A)), (before + 1, Some((1, 6600))));
    bench.says(2, 2, &[(0, 1000), (4, 2000)], false);
    assert_eq!((checked(&bench), bench.route(&A)), (before + 2, Some((2, 3600))));
    bench.says(2, 4, &[(1, 5000), (2, 2000)], false);
    assert_eq!((checked(&bench), bench.route(&A)), (before + 3, None), "its router has lost it");
    bench.says(2, 4, &[(1, 5000), (2, 2000)], true);
    bench.link_down(2);
    bench.pass(ms(200));
    assert_eq!((checked(&bench), bench.route(&A)), (before + 5, Some((1, 6600))));
}

/// Returns the names that a link was asked for since the last frame.
fn asked_of(bench: &Bench, link: u32) -> Vec<Name> {
    let queries = bench.sent.iter().filter_map(|(to, frame)| match frame {
        Control::Query { names, .. } if *to == link => Some(names.clone()),
        _ => None,
    });
    queries.flatten().collect()
}

#[test]
fn a_router_may_ask_again_for_what_it_asked_for_when_there_is_no_room_for_more() {
    let limits = Limits { interests_per_peer_max: 8, questions_max: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Query, limits);
    let names = unknown_names(&bench, 0, 8);
    bench.frame(1, Control::Query { id: 1, hops: 0, names: names.clone() });
    assert_eq!(asked_of(&bench, 2), names);
    bench.pass(Duration::from_secs(20));
    bench.frame(1, Control::Query { id: 2, hops: 0, names: names.clone() });
    assert_eq!((asked_of(&bench, 2), bench.dropped.as_slice()), (names.clone(), [""; 0].as_slice()));
    bench.pass(Duration::from_secs(20));
    // A neighbour with one question too many does not affect the others.
    let more = [unknown_names(&bench, 8, 1), names.clone()].concat();
    bench.frame(1, Control::Query { id: 3, hops: 0, names: more });
    assert_eq!((asked_of(&bench, 2), bench.dropped.as_slice()), (names, ["limit"].as_slice()));
}

#[test]
fn questions_of_one_router_leave_room_for_those_of_others() {
    let limits = Limits { questions_max: 64, asks_max: 64, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Query, limits);
    let many = unknown_names(&bench, 0, 200);
    let (mut id, mut passed_on) = (0, 0);
    for names in many.chunks(20) {
        id += 1;
        bench.frame(1, Control::Query { id, hops: 0, names: names.to_vec() });
        passed_on += asked_of(&bench, 3).len();
    }
    assert_eq!(
        (passed_on, bench.dropped.last()),
        (64, Some(&"questions_full")),
        "those that are under way stay"
    );
    bench.dropped.clear();
    // Another neighbour has all of its questions asked, and its answers come.
    for (n, blind) in [A, B].into_iter().enumerate() {
        let names = vec![bench.name(&blind)];
        bench.frame(2, Control::Query { id: 1000 + n as u64, hops: 0, names: names.clone() });
        assert_eq!(asked_of(&bench, 3), names);
    }
    let own = unknown_names(&bench, 1000, 20);
    bench.with_proxies();
    bench.frame(4, Control::Interest { names: own.clone() });
    assert_eq!((asked_of(&bench, 3).len(), bench.dropped.as_slice()), (own.len(), [""; 0].as_slice()));
    for names in many.chunks(20) {
        id += 1;
        bench.frame(1, Control::Query { id, hops: 0, names: names.to_vec() });
    }
    bench.up(6, &bench.owner.clone(), false, 1000);
    bench.owner_says(6, 0, &[(0, 1000)]);
    bench.advert(6, 10, &[A, B]);
    assert!(bench.told().contains(&(2, "advert")), "{:?}", bench.told());
    // Later, the first one may replace its own questions.
    bench.dropped.clear();
    bench.pass(Duration::from_secs(5));
    let more = unknown_names(&bench, 2000, 20);
    bench.frame(1, Control::Query { id: 2000, hops: 0, names: more.clone() });
    assert_eq!((asked_of(&bench, 3), bench.dropped.as_slice()), (more, [""; 0].as_slice()));
}

#[test]
fn interests_are_counted_over_all_links_of_a_node() {
    let limits = Limits { interests_per_peer_max: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Flood, limits);
    bench.with_proxies();
    bench.up(7, &bench.owner.clone(), false, 1000);
    let neighbour = Neighbour::from(bench.owner.as_peer());
    bench.router.handle_link_up(bench.clock.now(), LinkId(8), neighbour);
    bench.frame(8, hello(7, false));
    let names = unknown_names(&bench, 0, 12);
    bench.frame(7, Control::Interest { names: names[..6].to_vec() });
    bench.frame(7, Control::Interest { names: names[..6].to_vec() });
    bench.frame(8, Control::Interest { names: names[6..].to_vec() });
    assert_eq!((bench.router.stats().names, bench.dropped.as_slice()), (8, ["limit"].as_slice()));
    bench.frame(8, Control::Interest { names: names[6..8].to_vec() });
    assert_eq!(bench.dropped.len(), 1, "there already");
    bench.frame(5, Control::Interest { names: names[8..].to_vec() });
    assert_eq!((bench.router.stats().names, bench.dropped.len()), (12, 1), "another node has its own");
}

#[test]
fn names_that_nobody_has_are_asked_for_in_turn_and_anothers_at_once() {
    let limits = Limits { unknown_per_peer_max: 8, ..Limits::default() };
    let mut bench = Bench::with(MappingKind::Query, limits);
    bench.with_proxies();
    bench.pass(ms(200));
    let names = unknown_names(&bench, 0, 100);
    bench.frame(4, Control::Interest { names: names.clone() });
    assert_eq!(asked_of(&bench, 1).len(), 8);
    let last = names[99];
    bench.frame(5, Control::Interest { names: vec![last] });
    assert_eq!(asked_of(&bench, 1), [last], "it is not behind what another wants");
    let (mut most, mut all) = (0, std::collections::BTreeSet::new());
    for _ in 0..15 {
        bench.sent.clear();
        bench.pass(Duration::from_secs(20));
        let asked = asked_of(&bench, 1);
        most = most.max(asked.len());
        all.extend(asked);
    }
    // The first and repeated questions of the one, and those of the other.
    assert!(most <= 8 + 8 + 2, "{most}");
    assert_eq!(all.len(), 100, "each has its turn");
    assert_eq!(bench.dropped, [""; 0]);
}

#[test]
fn the_loss_of_a_link_with_many_names_is_told_in_few_frames() {
    let mut bench = Bench::new();
    bench.with_proxies();
    bench.with_owner_behind(5000, 9000);
    let blinds: Vec<_> = (0..5000).map(numbered).collect();
    for some in blinds.chunks(256) {
        bench.advert(1, 10, some);
    }
    let names: Vec<_> = blinds.iter().map(|b| bench.name(b)).collect();
    for some in names.chunks(4096) {
        bench.frame(4, Control::Interest { names: some.to_vec() });
        assert!(bench.sent.iter().all(|(_, f)| matches!(f, Control::Advert { .. })));
        assert_eq!(bench.sent.len(), some.len().div_ceil(256), "one advertisement answers for all its names");
    }
    bench.sent.clear();
    bench.says(1, 4, &[], true);
    let told = bench.sent.iter().filter_map(|(link, frame)| match frame {
        Control::Unreach { names } => Some((*link, names.len())),
        _ => None,
    });
    assert_eq!(told.collect::<Vec<_>>(), [(4, 4096), (4, 904)]);
}

#[test]
fn proxy_moves_to_a_newer_link_to_the_same_neighbour() {
    let mut bench = Bench::with_kind(MappingKind::Flood, Limits::default(), false);
    let name = bench.name(&A);
    bench.frame(0, Control::Interest { names: vec![name] });
    let router = bench.routers[0].clone();
    let advert = bench.advert_frame(1, false, &[A]);
    bench.frame(1, advert.clone());
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(1));
    let neighbour = Neighbour { cost: Some(1000), ..Neighbour::from(router.as_peer()) };
    bench.router.handle_link_up(bench.clock.now(), LinkId(7), neighbour);
    // The same run.
    bench.frame(7, hello(1, true));
    // Not before the name is known there.
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(1));
    bench.frame(7, advert);
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(7));
    bench.link_down(7);
    assert_eq!(bench.route(&A).map(|(link, _)| link), Some(1));
}
