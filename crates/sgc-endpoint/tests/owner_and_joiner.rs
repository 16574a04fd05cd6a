//! One endpoint, addressed in frames: its answers, its checks, its bounds.

use std::sync::Arc;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_endpoint::{
    ADVERT_INTERVAL, ADVERTS_BURST, Endpoint, EndpointConfig, EndpointDrop, Event, JoinKind, JoinStatus,
    Limits, LostReason, Output, ShareError, ShareSpec, SignedKind,
};
use sgc_testkit::{Clock, Member, identity, invited};
use sgc_trust::{
    Grantees, Identity, Policy, ReplyKey, Suite, name_of, operations_blind, paths_blind, seal_grant,
};
use sgc_wire::{
    ADVERT_NAMES_MAX, AdvertBody, Answer, AnswerBody, CandidateKind, Class, Control, Decode, Encode as _,
    GrantContent, JoinBody, Metadata, Name, PathCandidate, PathOffer, PathQuestion, Place, Qos, RefuseReason,
    Request, SecretBytes, SinkId, TopicGrant,
};

/// An endpoint, and its outputs since the last call.
struct Bench {
    endpoint: Endpoint,
    clock: Clock,
    identity: Arc<Identity>,
    sent: Vec<Control>,
    events: Vec<Event>,
    dropped: Vec<EndpointDrop>,
    timeout: Option<std::time::Instant>,
}

impl Bench {
    fn new(name: &str, limits: Limits) -> Self {
        Self::with(name, limits, false)
    }

    fn authority(name: &str) -> Self {
        Self::with(name, Limits::default(), true)
    }

    fn with(name: &str, limits: Limits, is_authority: bool) -> Self {
        let (clock, identity) = (Clock::default(), identity(&Member::new(name)));
        let (authority, operations) = (is_authority, is_authority);
        let config = EndpointConfig { identity: identity.clone(), authority, operations, limits };
        let endpoint = Endpoint::new(config, ChaCha20Rng::seed_from_u64(1), clock.now());
        let (sent, events, dropped) = (Vec::new(), Vec::new(), Vec::new());
        let mut bench = Self { endpoint, clock, identity, sent, events, dropped, timeout: None };
        bench.drain();
        bench
    }

    fn drain(&mut self) {
        self.sent.clear();
        self.events.clear();
        self.dropped.clear();
        loop {
            match self.endpoint.poll_output() {
                Output::Send(frame) => self.sent.push(frame),
                Output::Event(event) => self.events.push(event),
                Output::Dropped(dropped) => self.dropped.push(dropped),
                Output::Timeout(at) => {
                    self.timeout = at;
                    return;
                }
            }
        }
    }

    fn frame(&mut self, frame: Control) {
        self.endpoint.handle_frame(self.clock.now(), frame);
        self.drain();
    }

    fn share(&mut self, topic: &str, policy: Policy) -> Result<Name, ShareError> {
        let spec = ShareSpec {
            metadata: Metadata::topic(self.identity.node_name().as_str(), topic, "p/msg/T"),
            policy,
            suite: Suite::Group,
            class: Class::Default,
            keyless: true,
            type_hash: None,
            qos: Qos::default(),
            sources: Vec::new(),
        };
        self.endpoint.share(self.clock.now(), spec)
    }

    fn share_with_fleet(&mut self, topic: &str) -> Name {
        let policy = Policy {
            subscribe: Grantees { fleets: [self.identity.as_peer().ca].into(), ..Grantees::default() },
            ..Policy::default()
        };
        self.share(topic, policy).expect("within the bounds")
    }

    /// Returns the advertisements sent: sequence number, whether a withdrawal, number of names.
    fn adverts(&self) -> Vec<(u64, bool, usize)> {
        self.sent
            .iter()
            .filter_map(|frame| match frame {
                Control::Advert { signed, .. } => AdvertBody::from_slice(&signed.body).ok(),
                _ => None,
            })
            .map(|body| (body.seq, body.withdraw, body.blinds.len()))
            .collect()
    }

    /// The answers sent: sink, and the reason of a refusal.
    fn answers(&self) -> Vec<(SinkId, Option<RefuseReason>)> {
        self.sent
            .iter()
            .filter_map(|frame| match frame {
                Control::Answer { signed } => AnswerBody::from_slice(&signed.body).ok(),
                _ => None,
            })
            .map(|body| match body.answer {
                Answer::Grant { .. } => (body.sink, None),
                Answer::Refuse { reason } => (body.sink, Some(reason)),
            })
            .collect()
    }
}

fn owner() -> Bench {
    Bench::new("arm-1", Limits::default())
}

fn join(bench: &Bench, who: &Identity, name: Name, sink: u8) -> (Control, ReplyKey) {
    let reply_key = ReplyKey::generate(sgc_trust::Kem::default());
    let body = JoinBody {
        name,
        sink: SinkId([sink; 16]),
        request: Request::Subscribe { describe: false },
        issued_at: bench.clock.now().unix,
        chain: who.chain_bytes(),
        reply_key: reply_key.public().clone(),
    };
    (Control::Join { signed: who.sign_join(&body) }, reply_key)
}

#[test]
fn a_node_with_all_places_of_a_topic_takes_those_of_its_oldest_requests() {
    let mut bench = owner();
    let limits = Limits::default();
    let (desk, lap) = (identity(&Member::new("desk")), identity(&Member::new("lap")));
    let topic = bench.share_with_fleet("/a");
    let catalogue = bench.endpoint.catalogue_name().expect("it has one");
    for name in [topic, catalogue] {
        let (frame, _) = join(&bench, &lap, name, 200);
        bench.frame(frame);
        let mut frames = Vec::new();
        for n in 1..=20 {
            bench.clock.advance_to(bench.clock.instant() + std::time::Duration::from_secs(1));
            let (frame, _) = join(&bench, &desk, name, n);
            frames.push(frame.clone());
            bench.frame(frame);
            let mut answers = bench.answers();
            answers.sort_by_key(|(sink, _)| *sink);
            let gone = n.checked_sub(limits.sinks_per_peer_max as u8).filter(|gone| *gone > 0);
            let gone = gone.map(|gone| (SinkId([gone; 16]), Some(RefuseReason::Limit)));
            let expected: Vec<_> = gone.into_iter().chain([(SinkId([n; 16]), None)]).collect();
            assert_eq!(answers, expected, "request {n}");
        }
        // A router replays the refused ones: sinks that lost their places get none from newer ones.
        for n in 1..=4 {
            bench.frame(frames[n - 1].clone());
            assert_eq!(bench.answers(), [(SinkId([n as u8; 16]), Some(RefuseReason::Limit))]);
        }
    }
    let granted = bench.endpoint.granted(&topic);
    let of_desk: Vec<_> =
        granted.iter().filter(|(_, node)| *node == desk.node_id()).map(|(s, _)| s.0[0]).collect();
    assert_eq!((of_desk, granted.len()), ((5..=20).collect(), 17), "and none from another node");
}

#[test]
fn an_older_request_of_a_sink_does_not_bring_its_key_back() {
    let mut bench = owner();
    let desk = identity(&Member::new("desk"));
    let topic = bench.share_with_fleet("/a");
    let catalogue = bench.endpoint.catalogue_name().expect("it has one");
    for name in [topic, catalogue] {
        let (older, _) = join(&bench, &desk, name, 1);
        bench.clock.advance_to(bench.clock.instant() + std::time::Duration::from_secs(1));
        let (newer, key) = join(&bench, &desk, name, 1);
        bench.frame(older.clone());
        bench.frame(newer);
        bench.frame(older);
        assert_eq!((bench.answers().len(), bench.dropped.len()), (0, 1), "{:?}", bench.dropped);
        bench.share_with_fleet(if name == topic { "/b" } else { "/c" });
        bench.endpoint.rotate(bench.clock.now(), &topic);
        bench.clock.advance_to(bench.clock.instant() + std::time::Duration::from_secs(1));
        bench.endpoint.handle_timeout(bench.clock.now());
        bench.drain();
        let of_name = bench.sent.iter().find_map(|frame| match frame {
            Control::Answer { signed } => {
                AnswerBody::from_slice(&signed.body).ok().filter(|body| body.name == name)
            }
            _ => None,
        });
        let Some(AnswerBody { sink, serial, answer: Answer::Grant { enc, sealed }, .. }) = of_name else {
            panic!("what changed is granted again")
        };
        assert!(key.open(&name, &sink, serial, &enc, &sealed).is_ok(), "with the newest key");
    }
}

#[test]
fn names_that_come_one_by_one_do_not_stay_apart() {
    let mut bench = owner();
    // The advertisement that speaks for each name, as routers keep it.
    let mut words = std::collections::BTreeMap::new();
    let mut most = 0;
    for n in 0..500 {
        bench.share_with_fleet(&format!("/a{n}"));
        bench.drain();
        for frame in &bench.sent {
            let Control::Advert { signed, .. } = frame else { continue };
            let body = AdvertBody::from_slice(&signed.body).expect("ours");
            words.extend(body.blinds.iter().map(|blind| (*blind, body.seq)));
        }
        let apart: std::collections::BTreeSet<_> = words.values().collect();
        most = most.max(apart.len());
        bench.clock.advance_to(bench.clock.now().instant + ADVERT_INTERVAL);
    }
    assert!(
        words.len() >= 499 && (60..70).contains(&most),
        "{most} advertisements speak for {} names",
        words.len()
    );
}

#[test]
fn a_joiner_whose_fleet_is_unknown_is_refused_and_told_why() {
    let mut bench = owner();
    let name = bench.share_with_fleet("/a");
    let stranger = identity(&Member { fleet: "umbrella".to_owned(), ..Member::new("desk") });
    let (frame, _) = join(&bench, &stranger, name, 1);
    bench.frame(frame);
    assert_eq!(bench.answers(), [(SinkId([1; 16]), Some(RefuseReason::NotVerified))]);
    assert!(
        matches!(bench.dropped[..], [EndpointDrop::NotVerified { what: SignedKind::Join, .. }]),
        "{:?}",
        bench.dropped
    );
    assert_eq!(bench.endpoint.granted(&name), []);
}

/// A router of an earlier version passes such requests on.
#[test]
fn the_holder_of_an_invitation_is_refused_what_everyone_in_the_fleet_may_have() {
    let mut bench = owner();
    let topic = bench.share_with_fleet("/a");
    let catalogue = bench.endpoint.catalogue_name().expect("it has one");
    let holder = invited("acme", 1);
    for name in [topic, catalogue] {
        let (frame, _) = join(&bench, &holder, name, 1);
        bench.frame(frame);
        assert_eq!(bench.answers(), [(SinkId([1; 16]), Some(RefuseReason::NotPermitted))]);
        assert!(matches!(bench.dropped[..], [EndpointDrop::Invited { .. }]), "{:?}", bench.dropped);
        assert_eq!(bench.endpoint.granted(&name), []);
    }
}

/// It sees names, and holds no secret of the fleet.
#[test]
fn router_is_refused_what_everyone_in_the_fleet_may_have() {
    let mut bench = owner();
    let topic = bench.share_with_fleet("/a");
    let router = identity(&Member { router: true, ..Member::new("cloud") });
    let member = identity(&Member::new("desk"));
    for (who, answer) in [(&router, Some(RefuseReason::NotPermitted)), (&member, None)] {
        let (frame, _) = join(&bench, who, topic, 1);
        bench.frame(frame);
        assert_eq!(bench.answers(), [(SinkId([1; 16]), answer)]);
    }
}

/// Routers read questions, so these name no address. Answers are sealed.
#[test]
fn addresses_for_a_direct_path_travel_in_answers_alone() {
    let mut bench = owner();
    let name = name_of(&bench.identity.node_id(), &paths_blind(&bench.identity.node_id()));
    let asks = |bench: &mut Bench, who: &Identity| {
        let reply_key = ReplyKey::generate(sgc_trust::Kem::default());
        let body = JoinBody {
            name,
            sink: SinkId([1; 16]),
            request: Request::Ask { what: PathQuestion { attempt: 7 }.to_bytes() },
            issued_at: bench.clock.now().unix,
            chain: who.chain_bytes(),
            reply_key: reply_key.public().clone(),
        };
        bench.frame(Control::Join { signed: who.sign_join(&body) });
        reply_key
    };
    let desk = identity(&Member::new("desk"));
    asks(&mut bench, &desk);
    assert_eq!(bench.answers(), [(SinkId([1; 16]), Some(RefuseReason::NotShared))], "nothing is offered");
    bench.endpoint.offer_paths(bench.clock.now(), true);
    let stranger = identity(&Member { fleet: "other".into(), ..Member::new("desk") });
    asks(&mut bench, &stranger);
    assert_eq!(bench.answers().len(), 1);
    assert!(bench.answers()[0].1.is_some(), "another fleet");
    let reply_key = asks(&mut bench, &desk);
    let Some(Event::PathAsked { sink, peer, question }) = bench.events.pop() else {
        panic!("{:?}", bench.events)
    };
    assert_eq!((peer.node_id, question), (desk.node_id(), PathQuestion { attempt: 7 }.to_bytes()));
    let place = Place { ip: [0xa5; 16], port: 40_123 };
    let offer = PathOffer {
        attempt: 9,
        user: [1; 4],
        password: SecretBytes::new([0x5a; 32]),
        candidates: vec![PathCandidate { kind: CandidateKind::Host, place }],
    };
    bench.endpoint.answer_path(bench.clock.now(), sink, Ok(offer.clone()));
    bench.drain();
    let [Control::Answer { signed }] = &bench.sent[..] else { panic!("{:?}", bench.sent) };
    let has = |secret: &[u8]| signed.body.windows(secret.len()).any(|part| part == secret);
    assert!(!has(&[0xa5; 8]) && !has(&[0x5a; 8]), "a router reads it");
    let body = AnswerBody::from_slice(&signed.body).unwrap();
    let Answer::Grant { enc, sealed } = body.answer else { panic!("{:?}", body.answer) };
    let opened = reply_key.open(&name, &sink, body.serial, &enc, &sealed).unwrap();
    assert_eq!(opened, GrantContent::Path(offer));
}

/// Holders displace each other, and take no place that members have.
#[test]
fn holders_of_invitations_have_places_of_their_own() {
    let mut bench = Bench::authority("keeper");
    let name = name_of(&bench.identity.node_id(), &operations_blind(&bench.identity.as_peer().ca));
    let ask = |bench: &mut Bench, who: &Identity, sink: [u8; 16]| {
        let body = JoinBody {
            name,
            sink: SinkId(sink),
            request: Request::Ask { what: Bytes::from_static(b"x") },
            issued_at: bench.clock.now().unix,
            chain: who.chain_bytes(),
            reply_key: ReplyKey::generate(sgc_trust::Kem::default()).public().clone(),
        };
        bench.frame(Control::Join { signed: who.sign_join(&body) });
        bench.answers()
    };
    let sink = |number: u32| {
        let mut id = [0; 16];
        id[..4].copy_from_slice(&number.to_be_bytes());
        id
    };
    let first = invited("acme", 0);
    for number in 0..256 {
        assert_eq!(ask(&mut bench, &invited("acme", number), sink(number)), []);
        bench.clock.advance_to(bench.clock.instant() + std::time::Duration::from_millis(1));
    }
    // One that asks again has its place.
    assert_eq!(ask(&mut bench, &invited("acme", 255), sink(255)), []);
    assert_eq!(ask(&mut bench, &identity(&Member::new("desk")), [0xff; 16]), []);
    let displaced = ask(&mut bench, &invited("acme", 256), sink(256));
    assert_eq!(displaced, [(SinkId(sink(0)), Some(RefuseReason::Limit))]);
    bench.clock.advance_to(bench.clock.instant() + std::time::Duration::from_millis(1));
    let displaced = ask(&mut bench, &first, sink(1000));
    assert_eq!(displaced, [(SinkId(sink(1)), Some(RefuseReason::Limit))]);
}

#[test]
fn an_unusable_reply_key_is_refused_and_no_sink_is_kept() {
    let mut bench = owner();
    let name = bench.share_with_fleet("/a");
    let desk = identity(&Member::new("desk"));
    let body = JoinBody {
        name,
        sink: SinkId([1; 16]),
        request: Request::Subscribe { describe: false },
        issued_at: bench.clock.now().unix,
        chain: desk.chain_bytes(),
        reply_key: (&b"no key"[..]).into(),
    };
    bench.frame(Control::Join { signed: desk.sign_join(&body) });
    assert_eq!(bench.answers(), [(SinkId([1; 16]), Some(RefuseReason::NotVerified))]);
    assert_eq!(bench.endpoint.granted(&name), []);
}

#[test]
fn sinks_of_a_share_are_bounded() {
    let mut bench = Bench::new("arm-1", Limits { sinks_per_name_max: 2, ..Limits::default() });
    let name = bench.share_with_fleet("/a");
    let desk = identity(&Member::new("desk"));
    for (sink, refused) in [(1, None), (2, None), (3, Some(RefuseReason::Limit))] {
        let (frame, _) = join(&bench, &desk, name, sink);
        bench.frame(frame);
        assert_eq!(bench.answers(), [(SinkId([sink; 16]), refused)]);
    }
    bench.frame(Control::Leave { name, sink: SinkId([1; 16]) });
    let (frame, _) = join(&bench, &desk, name, 4);
    bench.frame(frame);
    assert_eq!(bench.answers(), [(SinkId([4; 16]), None)]);
}

#[test]
fn shares_are_bounded_and_each_is_made_once() {
    let mut bench = Bench::new("arm-1", Limits { shares_max: 2, ..Limits::default() });
    bench.share_with_fleet("/a");
    let again = bench.share("/a", Policy::default());
    assert_eq!(again, Err(ShareError::Duplicate { ros_name: "/a".into(), type_name: "p/msg/T".into() }));
    bench.share_with_fleet("/b");
    assert_eq!(bench.share("/c", Policy::default()), Err(ShareError::Limit { max: 2 }));
}

#[test]
fn a_closed_policy_permits_nobody() {
    let mut bench = owner();
    let name = bench.share("/a", Policy::default()).unwrap();
    let (frame, _) = join(&bench, &identity(&Member::new("desk")), name, 1);
    bench.frame(frame);
    assert_eq!(bench.answers(), [(SinkId([1; 16]), Some(RefuseReason::NotPermitted))]);
}

#[test]
fn names_that_come_one_by_one_are_gathered_as_routers_take_no_more() {
    let mut bench = owner();
    let mut adverts = Vec::new();
    let count = 3 * ADVERTS_BURST as usize;
    for n in 0..count {
        bench.share_with_fleet(&format!("/{n}"));
        bench.drain();
        adverts.extend(bench.adverts());
    }
    // The catalogue's was the first.
    assert_eq!(adverts.len() + 1, ADVERTS_BURST as usize);
    bench.clock.advance_to(bench.clock.now().instant + ADVERT_INTERVAL);
    bench.endpoint.handle_timeout(bench.clock.now());
    bench.drain();
    adverts.extend(bench.adverts());
    assert_eq!(adverts.len(), ADVERTS_BURST as usize, "one with all the others");
    assert_eq!(adverts.last().map(|advert| advert.2), Some(count + 1), "and again with those before");
    // The end is announced at once.
    bench.endpoint.withdraw_all(bench.clock.now());
    bench.drain();
    let withdrawn = bench.adverts();
    assert!(withdrawn.iter().all(|advert| advert.1));
    assert_eq!(withdrawn.iter().map(|advert| advert.2).sum::<usize>(), count + 1);
}

#[test]
fn many_names_go_into_few_advertisements_with_growing_numbers() {
    let mut bench = owner();
    for n in 0..600 {
        bench.share_with_fleet(&format!("/{n}"));
    }
    bench.drain();
    let adverts = bench.adverts();
    assert_eq!(adverts.iter().map(|a| a.2).collect::<Vec<_>>(), [ADVERT_NAMES_MAX, ADVERT_NAMES_MAX, 88]);
    assert!(adverts.is_sorted_by(|a, b| a.0 < b.0));
    let before = adverts[2].0;
    let mut renewed = Vec::new();
    while renewed.is_empty() {
        bench.clock.advance_to(bench.timeout.unwrap());
        bench.endpoint.handle_timeout(bench.clock.now());
        bench.drain();
        renewed = bench.adverts();
    }
    // And the catalogue.
    assert_eq!(renewed.iter().map(|a| a.2).sum::<usize>(), 601);
    assert!(renewed.iter().all(|a| a.0 > before && !a.1));
}

#[test]
fn shutdown_withdraws_every_name_and_leaves_no_timer() {
    let mut bench = owner();
    for n in 0..3 {
        bench.share_with_fleet(&format!("/{n}"));
    }
    bench.drain();
    let last = bench.adverts()[0].0;
    bench.endpoint.withdraw_all(bench.clock.now());
    bench.drain();
    let adverts = bench.adverts();
    assert_eq!(adverts.iter().map(|a| (a.1, a.2)).collect::<Vec<_>>(), [(true, 4)]);
    assert!(adverts[0].0 > last, "in the same millisecond, too");
    assert_eq!(bench.timeout, None);
}

#[test]
fn a_topic_shared_again_within_the_same_moment_is_advertised_after_its_withdrawal() {
    let mut bench = owner();
    let name = bench.share_with_fleet("/a");
    bench.drain();
    bench.endpoint.unshare(bench.clock.now(), &name);
    assert_eq!(bench.share_with_fleet("/a"), name);
    bench.drain();
    // Withdrawn and shared again between two drains: the network sees only a renewal.
    let adverts = bench.adverts();
    assert!(adverts.last().is_some_and(|a| !a.1), "{adverts:?}");
}

/// Delivers an owner's advertisement of a name.
fn advertise(bench: &mut Bench, owner: &Identity, blind: sgc_wire::Blind) {
    let body = AdvertBody {
        chain: owner.chain_bytes(),
        seq: 1,
        issued_at: bench.clock.now().unix,
        lease_ms: 60_000,
        withdraw: false,
        blinds: vec![blind],
    };
    bench.frame(Control::Advert { cost: 1, signed: owner.sign_advert(&body) });
}

/// A joiner with a grant of `/a` of the robot, and the keys to answer it further.
fn granted() -> (Bench, Arc<Identity>, Name, SinkId, bytes::Bytes) {
    let mut bench = Bench::new("desk", Limits::default());
    let arm = identity(&Member::new("arm-1"));
    let secret = arm.fleet_secret().expect("no router");
    let metadata = Metadata::topic("arm-1", "/a", "p/msg/T");
    let blind = sgc_trust::TopicSecret::derive(secret, &metadata).blind();
    let name = sgc_trust::name_of(&arm.node_id(), &blind);
    bench.endpoint.join(bench.clock.now(), name, arm.node_id(), JoinKind::Subscribe { describe: false });
    bench.drain();
    assert!(matches!(&bench.sent[..], [Control::Interest { names }] if *names == [name]), "{:?}", bench.sent);
    advertise(&mut bench, &arm, blind);
    let [Control::Join { signed }] = &bench.sent[..] else { panic!("{:?}", bench.sent) };
    let JoinBody { sink, reply_key, .. } = JoinBody::from_slice(&signed.body).expect("as it was signed");
    let frame = grant(&arm, name, sink, &reply_key, 1, 7);
    bench.frame(frame);
    assert!(matches!(bench.events[..], [Event::Granted { .. }]), "{:?}", bench.events);
    (bench, arm, name, sink, reply_key)
}

fn grant(owner: &Identity, name: Name, sink: SinkId, reply_key: &[u8], serial: u64, key: u8) -> Control {
    let content = GrantContent::Topic(TopicGrant {
        epoch: serial as u32,
        suite: 1,
        key: SecretBytes::new([key; 32]),
        receiver: None,
        sources: Vec::new(),
        entry: None,
    });
    let (enc, sealed) = seal_grant(reply_key, &name, &sink, serial, &content).expect("a usable reply key");
    let body = AnswerBody { name, sink, serial, answer: Answer::Grant { enc, sealed } };
    Control::Answer { signed: owner.sign_answer(&body) }
}

#[test]
fn answers_are_taken_in_their_order_and_each_once() {
    let (mut bench, arm, name, sink, reply_key) = granted();
    let (second, third) =
        (grant(&arm, name, sink, &reply_key, 2, 8), grant(&arm, name, sink, &reply_key, 3, 9));
    bench.frame(third.clone());
    assert!(
        matches!(&bench.events[..], [Event::Granted { grant, .. }] if grant.epoch == 3),
        "{:?}",
        bench.events
    );
    for old in [second, third] {
        bench.frame(old);
        assert!(bench.events.is_empty() && matches!(bench.dropped[..], [EndpointDrop::Unexpected { .. }]));
        assert_eq!(bench.endpoint.join_status(&name), Some(JoinStatus::Granted));
    }
}

#[test]
fn an_answer_that_the_owner_did_not_sign_or_seal_changes_nothing() {
    let (mut bench, arm, name, sink, reply_key) = granted();
    let other = identity(&Member::new("mallory"));
    bench.frame(grant(&other, name, sink, &reply_key, 2, 8));
    assert!(
        matches!(bench.dropped[..], [EndpointDrop::NotVerified { what: SignedKind::Answer, .. }]),
        "{:?}",
        bench.dropped
    );
    bench.frame(grant(&arm, name, SinkId([0; 16]), &reply_key, 2, 8));
    assert!(matches!(bench.dropped[..], [EndpointDrop::Unexpected { .. }]), "{:?}", bench.dropped);
    assert_eq!((bench.events.len(), bench.endpoint.join_status(&name)), (0, Some(JoinStatus::Granted)));
}

#[test]
fn a_grant_taken_back_is_lost_with_the_owners_reason() {
    let (mut bench, arm, name, sink, _) = granted();
    let reason = RefuseReason::NotPermitted;
    let body = AnswerBody { name, sink, serial: 2, answer: Answer::Refuse { reason } };
    bench.frame(Control::Answer { signed: arm.sign_answer(&body) });
    let lost = |e: &Event| matches!(e, Event::Lost { reason: LostReason::Refused(r), .. } if *r == reason);
    assert!(bench.events.iter().any(lost), "{:?}", bench.events);
    assert_ne!(bench.endpoint.join_status(&name), Some(JoinStatus::Granted));
}

#[test]
fn a_name_of_another_owner_than_expected_is_not_asked_for() {
    let mut bench = Bench::new("desk", Limits::default());
    let (arm, other) = (identity(&Member::new("arm-1")), identity(&Member::new("mallory")));
    let blind = sgc_wire::Blind([5; 32]);
    let name = sgc_trust::name_of(&arm.node_id(), &blind);
    bench.endpoint.join(bench.clock.now(), name, other.node_id(), JoinKind::Subscribe { describe: false });
    bench.drain();
    advertise(&mut bench, &arm, blind);
    assert!(bench.sent.is_empty());
    assert_eq!(bench.endpoint.join_status(&name), Some(JoinStatus::Waiting));
}
