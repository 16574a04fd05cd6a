//! Tests of the route machine: events of the local network and of owners go in, commands come out.

#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::time::{Duration, Instant};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sgc_endpoint::{LostReason, RefusedBy};
use sgc_ros::{
    ANNOUNCED_EVERY, AnnouncedPublishers, Command, DeadManRule, Direction, DiscoveredEndpoint,
    DiscoveryEvent, EndpointKind, GraphNode, Guid, HEARD_MIN, LocalEnd, Naming, OwnerState, Problem,
    QosOverride, REDISCOVERY_HOLD, ROUTES_PER_WILDCARD_MAX, Rename, Resume, RouteState, Routes,
    SINKLESS_HOLD, Shaping, ShareRule, StopMessage, UNREACHABLE_HOLD, UseRule, WRITERLESS_HOLD, dds_topic,
    dds_type,
};
use sgc_trust::{FleetSecret, Policy, Suite, TopicSecret, derive_name};
use sgc_wire::{
    Catalogue, CatalogueEntry, CatalogueSource, Class, Durability, History, Kind, Liveliness, Metadata, Name,
    NodeId, Qos, RefuseReason, Reliability, RosNode, SinkId, SourceId,
};

const ME: NodeId = NodeId([1; 32]);
const OWNER: NodeId = NodeId([2; 32]);
const STRING: &str = "std_msgs/msg/String";

struct Bench {
    routes: Routes<ChaCha8Rng>,
    now: Instant,
}

fn secret() -> FleetSecret {
    FleetSecret::from_bytes([9; 32])
}

fn bench(shares: &[(&str, &str)], uses: &[(&str, Option<&str>)]) -> Bench {
    let shares = shares.iter().map(|(topic, type_name)| share(topic, type_name));
    let uses = uses.iter().map(|(topic, type_name)| use_of(OWNER, topic, *type_name));
    bench_of(shares.collect(), uses.collect())
}

fn bench_of(shares: Vec<ShareRule>, uses: Vec<UseRule>) -> Bench {
    let rng = ChaCha8Rng::seed_from_u64(1);
    Bench { routes: Routes::new(secret(), ME, shares, uses, rng), now: Instant::now() }
}

fn share(topic: &str, type_name: &str) -> ShareRule {
    ShareRule {
        dead_man: None,
        metadata: Metadata::topic("me", topic, type_name),
        naming: Naming::default(),
        policy: Policy::default(),
        suite: Suite::Group,
        class: Class::Default,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
    }
}

/// Returns a share on which `OWNER` may publish.
fn inbound(topic: &str) -> ShareRule {
    let mut policy = Policy::default();
    policy.publish.nodes.insert(OWNER);
    ShareRule { policy, ..share(topic, STRING) }
}

fn use_of(owner: NodeId, topic: &str, type_name: Option<&str>) -> UseRule {
    UseRule {
        direction: Direction::Bring,
        owner,
        owner_name: "owner".into(),
        kind: Kind::Topic,
        topic: topic.into(),
        naming: Naming::default(),
        frame_prefix: None,
        dead_man: None,
        type_name: type_name.map(Into::into),
        dedicated: false,
        token: None,
        class: None,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
    }
}

/// Returns a rule for the token of a topic of `OWNER`.
fn token(topic: &str) -> UseRule {
    let token = Some((theirs(topic, STRING), Metadata::topic("owner", topic, STRING)));
    UseRule { token, ..use_of(OWNER, topic, Some(STRING)) }
}

fn admits(node: u8) -> Policy {
    let mut policy = Policy::default();
    policy.subscribe.nodes.insert(NodeId([node; 32]));
    policy
}

fn endpoint(n: u8, kind: EndpointKind, topic: &str, type_name: &str, qos: Qos) -> DiscoveredEndpoint {
    DiscoveredEndpoint {
        kind,
        guid: Guid([n; 16]),
        topic: dds_topic(topic),
        type_name: dds_type(type_name),
        keyless: true,
        type_hash: None,
        qos,
    }
}

fn writer(n: u8, topic: &str, qos: Qos) -> DiscoveredEndpoint {
    endpoint(n, EndpointKind::Writer, topic, STRING, qos)
}

fn latched() -> Qos {
    Qos { durability: Durability::TransientLocal, history: History::KeepLast(1), ..Qos::default() }
}

fn mine(topic: &str) -> Name {
    derive_name(&secret(), &ME, &Metadata::topic("me", topic, STRING))
}

fn theirs(topic: &str, type_name: &str) -> Name {
    derive_name(&secret(), &OWNER, &Metadata::topic("owner", topic, type_name))
}

fn entry(topic: &str, type_name: &str, qos: Qos, sources: &[u8]) -> CatalogueEntry {
    let source = |n: &u8| CatalogueSource { source: SourceId([*n; 16]), qos: qos.clone(), node: None };
    CatalogueEntry {
        metadata: Metadata::topic("owner", topic, type_name),
        blind: TopicSecret::derive(&secret(), &Metadata::topic("owner", topic, type_name)).blind(),
        subscribe: true,
        publish: false,
        suite: 1,
        keyless: true,
        type_hash: None,
        class: Class::Default,
        sources: sources.iter().map(source).collect(),
        qos,
    }
}

impl Bench {
    fn appears(&mut self, endpoint: DiscoveredEndpoint) -> Vec<Command> {
        self.routes.handle_discovery(self.now, DiscoveryEvent::Appeared(endpoint));
        self.commands()
    }

    fn vanishes(&mut self, n: u8) -> Vec<Command> {
        self.routes.handle_discovery(self.now, DiscoveryEvent::Vanished { guid: Guid([n; 16]) });
        self.commands()
    }

    fn told_of_liveliness(&mut self, n: u8, is_alive: bool) -> Vec<Command> {
        let event = DiscoveryEvent::Liveliness { guid: Guid([n; 16]), is_alive };
        self.routes.handle_discovery(self.now, event);
        self.commands()
    }

    fn keeps(&mut self, n: u8, depth: u32) -> Vec<Command> {
        let event = DiscoveryEvent::HistoryDepth { guid: Guid([n; 16]), depth };
        self.routes.handle_discovery(self.now, event);
        self.commands()
    }

    fn catalogue(&mut self, entries: Vec<CatalogueEntry>) -> Vec<Command> {
        self.routes.handle_catalogue(self.now, OWNER, Catalogue { version: 1, entries });
        self.commands()
    }

    fn reconfigured(&mut self, shares: Vec<ShareRule>, uses: Vec<UseRule>) -> Vec<Command> {
        self.routes.reconfigure(self.now, shares, uses);
        self.commands()
    }

    fn granted(&mut self, name: Name, entry: Option<CatalogueEntry>) -> Vec<Command> {
        self.routes.handle_granted(&name, entry);
        self.commands()
    }

    fn passes(&mut self, time: Duration) -> Vec<Command> {
        self.now += time;
        self.routes.handle_timeout(self.now);
        self.commands()
    }

    fn commands(&mut self) -> Vec<Command> {
        std::iter::from_fn(|| self.routes.poll_command()).collect()
    }
}

fn has(commands: &[Command], what: impl Fn(&Command) -> bool) -> bool {
    commands.iter().any(what)
}

fn opens_reader(commands: &[Command]) -> bool {
    has(commands, |c| matches!(c, Command::OpenReader { .. }))
}

fn problems(commands: &[Command]) -> Vec<Problem> {
    commands.iter().filter_map(|c| if let Command::Report(p) = c { Some(p.clone()) } else { None }).collect()
}

#[test]
fn a_share_begins_with_its_first_publisher_and_is_read_while_someone_subscribes() {
    let mut b = bench(&[("/a", "")], &[]);
    assert!(b.appears(writer(1, "/other", Qos::default())).is_empty());
    let begun = b.appears(writer(2, "/a", Qos::default()));
    assert!(has(&begun, |c| matches!(c, Command::Share(s) if s.metadata.type_name == STRING)));
    assert!(!opens_reader(&begun));
    b.routes.handle_sink_joined(&mine("/a"), SinkId([7; 16]));
    assert!(opens_reader(&b.commands()));
    b.routes.handle_sink_left(b.now, &mine("/a"), &SinkId([7; 16]));
    assert_eq!(b.commands(), []);
    let idle = b.passes(SINKLESS_HOLD);
    assert!(has(&idle, |c| *c == Command::CloseReader { name: mine("/a") }), "{idle:?}");
}

#[test]
fn a_sink_that_comes_back_in_time_finds_the_reader_open() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    b.routes.handle_sink_joined(&mine("/a"), SinkId([7; 16]));
    b.commands();
    b.routes.handle_sink_left(b.now, &mine("/a"), &SinkId([7; 16]));
    b.passes(SINKLESS_HOLD / 2);
    b.routes.handle_sink_joined(&mine("/a"), SinkId([8; 16]));
    let later = [b.commands(), b.passes(SINKLESS_HOLD)].concat();
    let touches = |c: &Command| matches!(c, Command::OpenReader { .. } | Command::CloseReader { .. });
    assert!(!has(&later, touches), "{later:?}");
}

#[test]
fn a_restarted_publisher_keeps_its_share_and_a_gone_one_loses_it() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    assert!(matches!(b.vanishes(1)[..], [Command::CloseSource { .. }]));
    let again = [b.appears(writer(2, "/a", Qos::default())), b.passes(WRITERLESS_HOLD)].concat();
    assert!(!has(&again, |c| matches!(c, Command::Unshare { .. } | Command::Share(_))), "{again:?}");
    b.vanishes(2);
    assert_eq!(b.passes(WRITERLESS_HOLD), [Command::Unshare { name: mine("/a") }]);
    assert_eq!(b.routes.poll_timeout(), None);
}

#[test]
fn share_outlives_its_last_publisher_while_messages_of_that_wait() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    b.vanishes(1);
    let began = b.now;
    // The caller knows whether messages wait. It is asked each time when the hold ends.
    let ends = loop {
        let at = b.routes.poll_timeout().expect("a hold");
        assert_eq!(b.routes.shares_without_writers(at - Duration::from_millis(1)), []);
        assert_eq!(b.routes.shares_without_writers(at), [mine("/a")]);
        b.routes.hold_share(at, &mine("/a"));
        let commands = b.passes(at - b.now);
        if !commands.is_empty() {
            break commands;
        }
        assert!(b.now - began < Duration::from_secs(700), "it has a bound");
    };
    assert_eq!(ends, [Command::Unshare { name: mine("/a") }]);
    assert!(b.now - began >= Duration::from_secs(600));
    // With another publisher, the source of one that is gone stays while messages wait, and no longer.
    b.appears(writer(2, "/a", Qos::default()));
    b.appears(writer(3, "/a", Qos::default()));
    b.vanishes(3);
    b.routes.hold_share(b.now + WRITERLESS_HOLD, &mine("/a"));
    assert_eq!(b.passes(WRITERLESS_HOLD), []);
    assert_eq!(published(&b.passes(WRITERLESS_HOLD)).0.len(), 1);
}

#[test]
fn last_messages_of_a_publisher_that_is_gone_are_to_be_confirmed() {
    let mut b = bench(&[("/a", ""), ("/latched", "")], &[]);
    let closed = |commands: Vec<Command>| {
        let sources = commands.into_iter().filter_map(|c| match c {
            Command::CloseSource { source, .. } => Some(source),
            _ => None,
        });
        sources.collect::<Vec<_>>()
    };
    let source = published(&b.appears(writer(1, "/a", Qos::default()))).1[0].1;
    assert_eq!(closed(b.vanishes(1)), [source]);
    // Another publisher takes the source over; when that is gone, it is closed again.
    b.appears(writer(2, "/a", Qos::default()));
    assert_eq!(closed(b.vanishes(2)), [source]);
    let latched_source = published(&b.appears(writer(3, "/latched", latched()))).1[0].1;
    assert_eq!(closed(b.vanishes(3)), [latched_source]);
}

#[test]
fn publisher_that_is_discovered_again_keeps_its_source_unless_another_has_it() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    let source = |commands: &[Command], n: u8| {
        published(commands).1.iter().find(|(guid, _)| *guid == Guid([n; 16])).unwrap().1
    };
    let before = source(&b.appears(writer(2, "/a", Qos::default())), 2);
    b.vanishes(2);
    let deeper = Qos { history: History::KeepLast(3), ..Qos::default() };
    let again = b.appears(writer(2, "/a", deeper));
    assert_eq!((source(&again, 2), published(&again).0.len()), (before, 2));
    b.vanishes(2);
    b.passes(WRITERLESS_HOLD / 2);
    b.appears(writer(2, "/a", Qos::default()));
    let later = [b.passes(WRITERLESS_HOLD), b.appears(writer(3, "/a", Qos::default()))].concat();
    assert_eq!(source(&later, 2), before, "it is there again");
    b.vanishes(2);
    assert_eq!(source(&b.appears(writer(4, "/a", Qos::default())), 4), before);
    assert_ne!(source(&b.appears(writer(2, "/a", Qos::default())), 2), before);
}

#[test]
fn each_latched_publisher_has_a_source_of_its_own_and_keeps_it() {
    let mut b = bench(&[("/tf_static", "")], &[]);
    let sources = |commands: Vec<Command>| match commands.into_iter().rev().find_map(|c| match c {
        Command::MapSources { own, .. } => Some(own),
        _ => None,
    }) {
        Some(own) => own.into_iter().map(|(guid, source, _)| (guid, source)).collect::<Vec<_>>(),
        None => panic!("no sources"),
    };
    let first = b.appears(writer(1, "/tf_static", latched()));
    assert!(opens_reader(&first), "history has to be there before anyone asks for it");
    let one = sources(first);
    let two = sources(b.appears(writer(2, "/tf_static", latched())));
    assert_eq!((one.len(), two.len()), (1, 2));
    assert!(two.contains(&one[0]) && two[0].1 != two[1].1);
    let left = sources(b.vanishes(1));
    assert_eq!(left, two.into_iter().filter(|(g, _)| *g == Guid([2; 16])).collect::<Vec<_>>());
}

#[test]
fn more_latched_publishers_than_can_be_told_apart_share_the_last_source() {
    let mut b = bench(&[("/tf_static", "")], &[]);
    let mut last = Vec::new();
    for n in 1..=200 {
        last = b.appears(writer(n, "/tf_static", latched()));
    }
    let listed = last.iter().find_map(|c| match c {
        Command::UpdateShare { sources, .. } => Some(sources.len()),
        _ => None,
    });
    assert_eq!(listed, Some(sgc_wire::ENTRY_SOURCES_MAX));
    let own = last
        .iter()
        .find_map(|c| if let Command::MapSources { own, .. } = c { Some(own.len()) } else { None });
    assert_eq!(own, Some(200), "every publisher has a source");
}

#[test]
fn type_mismatch_is_reported_once_with_both_values() {
    let mut b = bench(&[("/a", "x_msgs/msg/Other"), ("/b", "")], &[("/c", Some("x_msgs/msg/Other"))]);
    let wrong = b.appears(writer(1, "/a", Qos::default()));
    let text = problems(&wrong)[0].to_string();
    assert!(text.contains("x_msgs/msg/Other") && text.contains(STRING), "{text}");
    assert!(!has(&wrong, |c| matches!(c, Command::Share(_))));
    assert!(problems(&b.appears(writer(1, "/a", Qos::default()))).is_empty(), "said twice");
    b.appears(writer(2, "/b", Qos::default()));
    let best_effort = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
    let mixed = b.appears(writer(3, "/b", best_effort));
    assert!(matches!(problems(&mixed)[..], [Problem::MixedQos { .. }]), "{mixed:?}");
    let other = b.catalogue(vec![entry("/c", STRING, Qos::default(), &[])]);
    assert!(matches!(problems(&other)[..], [Problem::UseType { .. }]), "{other:?}");
    assert!(!has(&other, |c| matches!(c, Command::Join { .. })));
}

#[test]
fn a_local_subscriber_that_cannot_hear_the_far_publisher_is_named() {
    let mut b = bench(&[], &[("/a", None)]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    let wrong_type = endpoint(1, EndpointKind::Reader, "/a", "x_msgs/msg/Other", Qos::default());
    assert!(matches!(problems(&b.appears(wrong_type))[..], [Problem::LocalType { .. }]));
    let wants_more = |n| endpoint(n, EndpointKind::Reader, "/a", STRING, latched());
    let told = problems(&b.appears(wants_more(2)));
    assert_eq!(
        told[0].to_string(),
        "/a: owner offers durability volatile, but a local subscriber asks for transient local; it receives nothing \
         from there. Give the subscriber volatile or the publisher at owner transient local"
    );
    // A second subscriber has the same problem, which is not reported again until it has ended.
    assert_eq!(b.appears(wants_more(3)), []);
    b.vanishes(2);
    assert_eq!(b.routes.problems().filter(|p| **p == told[0]).count(), 1);
    b.vanishes(3);
    assert!(b.routes.problems().all(|p| *p != told[0]));
    assert_eq!(problems(&b.appears(wants_more(2))), told);
    let content = endpoint(4, EndpointKind::Reader, "/a", STRING, Qos::default());
    assert_eq!(b.appears(content), []);
    // The owner's publisher offers more, so only the type still differs.
    b.catalogue(vec![entry("/a", STRING, latched(), &[7])]);
    assert!(matches!(b.routes.problems().collect::<Vec<_>>()[..], [Problem::LocalType { .. }]));
    b.catalogue(vec![]);
    assert_eq!(b.routes.problems().count(), 0);
}

#[test]
fn each_policy_and_each_publisher_is_compared() {
    let mut b = bench(&[], &[("/a", None)]);
    let mut listed = entry("/a", STRING, Qos::default(), &[1, 2]);
    listed.sources[0].qos = Qos { deadline_ns: Some(1_000_000), ..Qos::default() };
    listed.sources[1].qos = Qos { partitions: vec!["robot".into()], ..Qos::default() };
    b.catalogue(vec![listed]);
    let request = Qos { deadline_ns: Some(5_000_000), partitions: vec!["desk".into()], ..Qos::default() };
    let told = problems(&b.appears(endpoint(1, EndpointKind::Reader, "/a", STRING, request)));
    let told: Vec<_> = told.iter().map(ToString::to_string).collect();
    assert_eq!(told.len(), 3, "{told:?}");
    assert!(told.iter().any(|t| t.contains("deadline none") && t.contains("asks for 5ms")), "{told:?}");
    assert!(told.iter().any(|t| t.contains("partition [\"robot\"]") && t.contains("[\"desk\"]")), "{told:?}");
    assert!(told.iter().any(|t| t.contains("partition \"\"")), "{told:?}");
}

#[test]
fn definitions_that_differ_are_named_by_their_hashes() {
    let mut b = bench(&[("/mine", "")], &[("/a", None)]);
    let with_hash = |hash: &str, e: DiscoveredEndpoint| DiscoveredEndpoint {
        type_hash: (!hash.is_empty()).then(|| hash.to_owned()),
        ..e
    };
    b.catalogue(vec![CatalogueEntry {
        type_hash: Some("RIHS01_aa".into()),
        ..entry("/a", STRING, Qos::default(), &[])
    }]);
    for (n, kind, end) in
        [(1, EndpointKind::Reader, LocalEnd::Subscriber), (2, EndpointKind::Writer, LocalEnd::Publisher)]
    {
        for hash in ["", "RIHS01_aa"] {
            let same = with_hash(hash, endpoint(n, kind, "/a", STRING, Qos::default()));
            assert_eq!(problems(&b.appears(same)), []);
        }
        let told =
            problems(&b.appears(with_hash("RIHS01_bb", endpoint(n, kind, "/a", STRING, Qos::default()))));
        assert!(
            matches!(&told[..], [Problem::LocalHash { remote, end: e, local, .. }]
            if (remote.as_str(), *e, local.as_str()) == ("RIHS01_aa", end, "RIHS01_bb")),
            "{told:?}"
        );
        b.vanishes(n);
        assert_eq!(b.routes.problems().count(), 0);
    }
    // Two publishers of one share have different definitions.
    b.appears(with_hash("RIHS01_bb", writer(3, "/mine", Qos::default())));
    let told = problems(&b.appears(with_hash("RIHS01_aa", writer(4, "/mine", Qos::default()))));
    assert!(
        matches!(&told[..], [Problem::ShareHash { first, second, .. }]
        if (first.as_str(), second.as_str()) == ("RIHS01_aa", "RIHS01_bb")),
        "{told:?}"
    );
    b.vanishes(3);
    assert_eq!(b.routes.problems().count(), 0);
}

#[test]
fn problems_end_with_their_rules() {
    let mut b = bench(&[("/t", "p/msg/Wanted")], &[("/a", Some("p/msg/Wanted"))]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    let told = problems(&b.appears(writer(1, "/t", Qos::default())));
    assert!(matches!(&told[..], [Problem::ShareType { .. }]), "{told:?}");
    assert_eq!(b.routes.problems().count(), 2, "that, and the type of the use");
    b.reconfigured(vec![share("/t", "")], vec![use_of(OWNER, "/a", None)]);
    assert_eq!(b.routes.problems().count(), 0);
}

#[test]
fn a_used_topic_is_joined_written_held_and_dropped() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    let joined =
        b.catalogue(vec![entry("/a", STRING, Qos::default(), &[]), entry("/b", STRING, Qos::default(), &[])]);
    assert_eq!(joined, [Command::Join { name, owner: OWNER, transient_local: false, describe: false }]);
    b.routes.handle_granted(&name, None);
    assert!(matches!(&b.commands()[..], [Command::OpenWriter { source: None, spec, .. }]
        if spec.topic == "rt/a" && spec.type_name == dds_type(STRING)));
    // The path breaks and returns in time, and the local network notices nothing.
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD / 2), []);
    b.routes.handle_granted(&name, None);
    assert_eq!([b.commands(), b.passes(UNREACHABLE_HOLD)].concat(), []);
    // The path breaks for longer: the writer closes, and opens again with the grant.
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD), [Command::CloseWriter { name, source: None }]);
    b.routes.handle_granted(&name, None);
    assert!(has(&b.commands(), |c| matches!(c, Command::OpenWriter { .. })));
    // The owner no longer shares the topic, which ends at once.
    let gone = b.catalogue(vec![]);
    assert_eq!(gone, [Command::CloseWriter { name, source: None }, Command::Leave { name }]);
}

#[test]
fn a_lost_catalogue_takes_no_topic_along() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    let entries = || vec![entry("/a", STRING, Qos::default(), &[])];
    b.catalogue(entries());
    b.routes.handle_granted(&name, None);
    b.commands();
    // The topic's own path stands, so no new grant will come.
    b.routes.handle_owner_lost(OWNER, LostReason::Unreachable);
    assert_eq!(b.passes(2 * UNREACHABLE_HOLD), []);
    assert_eq!(b.catalogue(entries()), []);
    assert_eq!(b.passes(2 * UNREACHABLE_HOLD), []);
}

#[test]
fn a_catalogue_that_lists_one_name_many_times_changes_no_route() {
    let mut b = bench(&[], &[("/chatter", None)]);
    let name = theirs("/chatter", STRING);
    let plain = entry("/chatter", STRING, Qos::default(), &[]);
    let kept = entry("/chatter", STRING, latched(), &[]);
    let first = b.catalogue(vec![plain.clone(), kept.clone(), plain.clone()]);
    let [Command::Join { name: joined, transient_local, .. }] = &first[..] else { panic!("{first:?}") };
    assert_eq!((*joined, *transient_local), (name, false), "the first entry counts");
    b.routes.handle_granted(&name, None);
    b.commands();
    for _ in 0..3 {
        assert_eq!(b.catalogue(vec![plain.clone(), kept.clone(), kept.clone()]), []);
    }
}

#[test]
fn each_far_latched_publisher_gets_a_writer_of_its_own() {
    let mut b = bench(&[], &[("/tf_static", None)]);
    let name = theirs("/tf_static", STRING);
    b.catalogue(vec![entry("/tf_static", STRING, latched(), &[1, 2, 3])]);
    b.routes.handle_granted(&name, None);
    let opened = b.commands();
    assert_eq!(opened.iter().filter(|c| matches!(c, Command::OpenWriter { source: Some(_), .. })).count(), 3);
    assert_eq!(opened.len(), 3);
    let fewer = b.catalogue(vec![entry("/tf_static", STRING, latched(), &[1, 3])]);
    assert_eq!(fewer, [Command::CloseWriter { name, source: Some(SourceId([2; 16])) }]);
}

#[test]
fn a_publisher_whose_node_started_anew_keeps_its_writer() {
    let mut b = bench(&[], &[("/tf_static", None)]);
    let name = theirs("/tf_static", STRING);
    let source = |tag, run| SourceId::from_publisher([tag; 8], [run; 8]);
    let list = |sources: &[SourceId]| {
        let mut entry = entry("/tf_static", STRING, latched(), &vec![1; sources.len()]);
        entry.sources.iter_mut().zip(sources).for_each(|(listed, source)| listed.source = *source);
        vec![entry]
    };
    b.catalogue(list(&[source(1, 1), source(2, 1)]));
    b.routes.handle_granted(&name, None);
    assert_eq!(b.commands().len(), 2);
    // The second publisher ended while the node was away, and a third began.
    let after = b.catalogue(list(&[source(1, 2), source(3, 2)]));
    assert_eq!(after[0], Command::MoveWriter { name, from: source(1, 1), to: source(1, 2) });
    assert_eq!(after[1], Command::CloseWriter { name, source: Some(source(2, 1)) });
    assert!(
        matches!(after[2..], [Command::OpenWriter { source: Some(s), .. }] if s == source(3, 2)),
        "{after:?}"
    );
    // A publisher with another offer gets another writer. Of two that claim one predecessor, one gets its writer.
    let mut other = list(&[source(1, 3)]);
    other[0].sources[0].qos.deadline_ns = Some(7);
    assert!(b.catalogue(other).iter().all(|c| !matches!(c, Command::MoveWriter { .. })));
    let twice = b.catalogue(list(&[source(1, 4), source(1, 5)]));
    assert!(twice.iter().all(|c| !matches!(c, Command::MoveWriter { .. })));
    let thrice = b.catalogue(list(&[source(1, 6), source(1, 7), source(1, 8)]));
    assert_eq!(thrice.iter().filter(|c| matches!(c, Command::MoveWriter { .. })).count(), 2, "{thrice:?}");
}

#[test]
fn a_depth_that_becomes_known_is_listed_and_replaces_no_source() {
    let unsaid = Qos { history: History::UNSAID, ..latched() };
    let mut b = bench(&[("/map", "")], &[]);
    let begun = b.appears(writer(1, "/map", unsaid.clone()));
    let mapped = |commands: &[Command]| {
        let own = commands.iter().find_map(|c| match c {
            Command::MapSources { own, .. } => Some(own.clone()),
            _ => None,
        });
        own.unwrap().into_iter().map(|(_, source, qos)| (source, qos.history)).collect::<Vec<_>>()
    };
    let source = mapped(&begun)[0].0;
    assert_eq!(mapped(&begun), [(source, History::UNSAID)]);
    let learned = b.keeps(1, 5);
    assert_eq!(mapped(&learned), [(source, History::KeepLast(5))]);
    let lists = |command: &Command| matches!(command, Command::UpdateShare { sources, .. } if sources[0].qos.history == History::KeepLast(5));
    assert!(has(&learned, lists) && !opens_reader(&learned), "{learned:?}");
    // The depth does not change, and an announced depth stays.
    assert_eq!(b.keeps(1, 6), []);
    // Expired messages look like dropped ones.
    let mut b = bench(&[("/map", "")], &[]);
    b.appears(writer(1, "/map", Qos { lifespan_ns: Some(1), ..unsaid }));
    assert_eq!(b.keeps(1, 5), []);
}

#[test]
fn policies_of_a_rule_are_offered_in_the_place_of_those_that_are_found() {
    let latches = QosOverride {
        durability: Some(Durability::TransientLocal),
        history: Some(History::KeepLast(3)),
        ..QosOverride::default()
    };
    let mut b = bench_of(vec![ShareRule { qos: latches, ..share("/a", "") }], vec![]);
    let begun = b.appears(writer(1, "/a", Qos::default()));
    let is_latched = |qos: &Qos| qos.is_transient_local() && qos.history == History::KeepLast(3);
    assert!(has(
        &begun,
        |c| matches!(c, Command::UpdateShare { qos, sources, .. } if is_latched(qos) && is_latched(&sources[0].qos))
    ));
    // The topic is read from the start, with the QoS of its publisher.
    let reads = |c: &Command| matches!(c, Command::OpenReader { spec, .. } if !spec.qos.is_transient_local());
    assert!(has(&begun, reads), "{begun:?}");
    let careless = QosOverride { reliability: Some(Reliability::BestEffort), ..QosOverride::default() };
    let changed = b.reconfigured(vec![ShareRule { qos: careless, ..share("/a", "") }], vec![]);
    let best_effort = |qos: &Qos| !qos.is_reliable() && !qos.is_transient_local();
    assert!(
        has(&changed, |c| matches!(c, Command::UpdateShare { qos, .. } if best_effort(qos))),
        "{changed:?}"
    );
    // The policies of a use apply to the writers here.
    let rule = UseRule { qos: careless, ..use_of(OWNER, "/map", None) };
    let mut b = bench_of(vec![], vec![rule]);
    let name = theirs("/map", STRING);
    b.catalogue(vec![entry("/map", STRING, latched(), &[1])]);
    let opened = b.granted(name, None);
    let writes = |c: &Command| matches!(c, Command::OpenWriter { spec, .. } if !spec.qos.is_reliable());
    assert!(has(&opened, writes), "{opened:?}");
    let changed = b.reconfigured(vec![], vec![use_of(OWNER, "/map", None)]);
    let writes = |c: &Command| matches!(c, Command::OpenWriter { spec, .. } if spec.qos == latched());
    assert!(has(&changed, writes), "{changed:?}");
}

#[test]
fn a_depth_that_becomes_known_or_unknown_leaves_the_writer_open() {
    let mut b = bench(&[], &[("/map", None)]);
    let name = theirs("/map", STRING);
    let source = |run| SourceId::from_publisher([1; 8], [run; 8]);
    let list = |run, history| {
        let mut entry = entry("/map", STRING, latched(), &[1]);
        (entry.sources[0].source, entry.sources[0].qos.history) = (source(run), history);
        vec![entry]
    };
    b.catalogue(list(1, History::UNSAID));
    b.routes.handle_granted(&name, None);
    assert_eq!(b.commands().len(), 1);
    let [Command::ResizeWriter { source: of, spec, .. }] = &b.catalogue(list(1, History::KeepLast(5)))[..]
    else {
        panic!("it is not resized")
    };
    assert_eq!((*of, spec.qos.history), (Some(source(1)), History::KeepLast(5)));
    // The publisher's node restarts, and learns the depth again.
    let moved = b.catalogue(list(2, History::UNSAID));
    assert_eq!(moved, [Command::MoveWriter { name, from: source(1), to: source(2) }]);
    assert_eq!(b.catalogue(list(2, History::KeepLast(5))), []);
    // The node restarts before and after the depth is known.
    let mut b = bench(&[], &[("/map", None)]);
    b.catalogue(list(1, History::UNSAID));
    b.routes.handle_granted(&name, None);
    b.commands();
    let [Command::MoveWriter { .. }, Command::ResizeWriter { source: of, .. }] =
        &b.catalogue(list(2, History::KeepLast(5)))[..]
    else {
        panic!("it is not moved and resized")
    };
    assert_eq!(*of, Some(source(2)));
    // Another depth needs another writer.
    let other = b.catalogue(list(2, History::KeepLast(6)));
    assert!(has(&other, |c| matches!(c, Command::OpenWriter { .. })), "{other:?}");
}

#[test]
fn an_owner_that_started_anew_may_find_its_publishers_one_by_one() {
    let (name, name_b) = (theirs("/tf_static", STRING), theirs("/b", STRING));
    let source = |tag, run| SourceId::from_publisher([tag; 8], [run; 8]);
    let list = |topic: &str, sources: &[SourceId]| {
        let mut entry = entry(topic, STRING, latched(), &vec![1; sources.len()]);
        entry.sources.iter_mut().zip(sources).for_each(|(listed, source)| listed.source = *source);
        entry
    };
    let flowing = || {
        let mut b = bench(&[], &[("/tf_static", None), ("/b", None)]);
        b.catalogue(vec![
            list("/tf_static", &[source(1, 1), source(2, 1), source(3, 1)]),
            list("/b", &[source(4, 1)]),
        ]);
        [name, name_b].iter().for_each(|name| b.routes.handle_granted(name, None));
        assert_eq!(b.commands().iter().filter(|c| matches!(c, Command::OpenWriter { .. })).count(), 4);
        b
    };
    let away = |b: &mut Bench| {
        b.routes.handle_owner_lost(OWNER, LostReason::Unreachable);
        [name, name_b].iter().for_each(|name| b.routes.handle_lost(b.now, name));
        assert_eq!(b.passes(UNREACHABLE_HOLD / 2), []);
    };
    let moved = |name, tag| Command::MoveWriter { name, from: source(tag, 1), to: source(tag, 2) };
    let mut b = flowing();
    away(&mut b);
    b.routes.handle_granted(&name, None);
    b.commands();
    assert_eq!(b.catalogue(vec![list("/tf_static", &[source(1, 2)])]), [moved(name, 1)]);
    // A topic that was missing in the catalogue is joined again.
    let found =
        b.catalogue(vec![list("/tf_static", &[source(1, 2), source(2, 2)]), list("/b", &[source(4, 2)])]);
    let again = Command::JoinAgain { name: name_b, owner: OWNER };
    assert_eq!(found, [moved(name, 2), again]);
    assert_eq!(b.granted(name_b, None), [moved(name_b, 4)]);
    // Publishers that were not rediscovered in time have ended.
    assert_eq!(b.passes(REDISCOVERY_HOLD), [Command::CloseWriter { name, source: Some(source(3, 1)) }]);
    // After rediscovery a publisher that ends is gone at once.
    let ended = b.catalogue(vec![list("/tf_static", &[source(1, 2)])]);
    assert_eq!(ended[0], Command::CloseWriter { name, source: Some(source(2, 2)) });
    // The catalogue of an owner that was only unreachable is final.
    let mut b = flowing();
    away(&mut b);
    let lists = vec![list("/tf_static", &[source(1, 1)])];
    let commands = b.catalogue(lists);
    assert!(has(&commands, |c| *c == Command::Leave { name: name_b }), "{commands:?}");
    assert_eq!(b.granted(name, None).len(), 2, "two writers closed");
    // A topic that is never rediscovered is no longer shared.
    let mut b = flowing();
    away(&mut b);
    assert_eq!(b.catalogue(vec![]), []);
    let ended = b.passes(REDISCOVERY_HOLD);
    assert_eq!(ended.iter().filter(|c| matches!(c, Command::CloseWriter { .. })).count(), 4, "{ended:?}");
    assert_eq!(ended.iter().filter(|c| matches!(c, Command::Leave { .. })).count(), 2, "{ended:?}");
}

#[test]
fn an_owner_that_stops_takes_its_topics_along() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    b.routes.handle_granted(&name, None);
    b.commands();
    b.routes.handle_owner_lost(OWNER, LostReason::Withdrawn);
    assert_eq!(b.commands(), [Command::CloseWriter { name, source: None }, Command::Leave { name }]);
    assert_eq!(b.routes.status()[0].state, RouteState::Owner(OwnerState::Gone));
}

#[test]
fn status_says_what_each_rule_waits_for() {
    let mut b = bench(&[("/a", "")], &[("/b", None)]);
    let states = |b: &Bench| b.routes.status().into_iter().map(|s| s.state).collect::<Vec<_>>();
    assert_eq!(states(&b), [RouteState::AwaitsLocal, RouteState::NotListed { is_pattern: false }]);
    b.appears(writer(1, "/a", Qos::default()));
    b.catalogue(vec![entry("/b", STRING, Qos::default(), &[])]);
    assert_eq!(states(&b)[1], RouteState::AwaitsGrant);
    let by = RefusedBy::Owner(RefuseReason::NotPermitted);
    b.routes.handle_refused(&theirs("/b", STRING), by);
    assert_eq!(states(&b)[1], RouteState::Refused(by));
    assert_eq!(states(&b)[0], RouteState::Shared { publishers: 1, subscribers: 0, is_read: false });
}

#[test]
fn unchanged_rules_change_no_route() {
    let rules = || (vec![share("/a", ""), share("/b", STRING)], vec![use_of(OWNER, "/c", None), token("/d")]);
    let mut b = bench_of(rules().0, rules().1);
    b.appears(writer(1, "/a", latched()));
    b.appears(writer(2, "/other", Qos::default()));
    b.routes.handle_sink_joined(&mine("/a"), SinkId([7; 16]));
    b.catalogue(vec![entry("/c", STRING, Qos::default(), &[]), entry("/e", STRING, Qos::default(), &[])]);
    b.granted(theirs("/c", STRING), None);
    b.granted(theirs("/d", STRING), Some(entry("/d", STRING, Qos::default(), &[])));
    let before = b.routes.status();
    assert_eq!(b.reconfigured(rules().0, rules().1), []);
    // The order of rules does not matter.
    let (mut shares, mut uses) = rules();
    shares.reverse();
    uses.reverse();
    assert_eq!(b.reconfigured(shares, uses), []);
    let mut after = b.routes.status();
    after.sort_by_key(|s| (s.kind.key(), s.topic.clone()));
    assert_eq!(after, before);
    // Each route still belongs to its rule, so removing one rule ends only its routes.
    let gone = b.reconfigured(vec![share("/b", STRING)], vec![token("/d")]);
    let ends = |c: &Command, name| matches!(c, Command::Unshare { name: n } | Command::Leave { name: n } if *n == name);
    assert!(has(&gone, |c| ends(c, mine("/a"))) && has(&gone, |c| ends(c, theirs("/c", STRING))), "{gone:?}");
    assert!(!has(&gone, |c| ends(c, theirs("/d", STRING))), "{gone:?}");
}

#[test]
fn a_changed_policy_changes_the_policy_and_nothing_else() {
    let mut b = bench(&[("/a", ""), ("/b", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    b.appears(writer(2, "/b", Qos::default()));
    let changed = ShareRule { policy: admits(5), ..share("/a", "") };
    let policy = admits(5);
    let commands = b.reconfigured(vec![changed.clone(), share("/b", "")], vec![]);
    assert_eq!(commands, [Command::UpdatePolicy { name: mine("/a"), policy }]);
    // A share that begins later begins with the new policy.
    b.vanishes(1);
    b.passes(WRITERLESS_HOLD);
    let begun = b.appears(writer(1, "/a", Qos::default()));
    assert!(has(&begun, |c| matches!(c, Command::Share(s) if s.policy == changed.policy)), "{begun:?}");
}

#[test]
fn shares_begin_and_end_with_their_rules() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", latched()));
    b.appears(writer(2, "/b", Qos::default()));
    let swapped = b.reconfigured(vec![share("/b", "")], vec![]);
    assert_eq!(
        swapped[..2],
        [Command::CloseReader { name: mine("/a") }, Command::Unshare { name: mine("/a") }]
    );
    assert!(has(&swapped, |c| matches!(c, Command::Share(s) if s.metadata.ros_name == "/b")), "{swapped:?}");
    assert_eq!(b.routes.status().len(), 1);
    assert_eq!(b.reconfigured(vec![], vec![]), [Command::Unshare { name: mine("/b") }]);
    assert_eq!(b.passes(WRITERLESS_HOLD), []);
}

#[test]
fn incompatible_change_restarts_a_share() {
    let other_metadata = |topic: &str| {
        let mut rule = share(topic, "");
        rule.metadata.unique = "left".into();
        rule
    };
    for (what, rule) in
        [("class", ShareRule { class: Class::Bulk, ..share("/a", "") }), ("metadata", other_metadata("/a"))]
    {
        let mut b = bench(&[("/a", "")], &[]);
        b.appears(writer(1, "/a", Qos::default()));
        let commands = b.reconfigured(vec![rule.clone()], vec![]);
        assert_eq!(commands[0], Command::Unshare { name: mine("/a") }, "{what}");
        let expected = Metadata { type_name: STRING.into(), ..rule.metadata.clone() };
        let begins =
            |c: &Command| matches!(c, Command::Share(s) if s.metadata == expected && s.class == rule.class);
        assert!(begins(&commands[1]), "{what}: {commands:?}");
    }
    // A rule that now gives the present type changes nothing; another type ends the share.
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    assert_eq!(b.reconfigured(vec![share("/a", STRING)], vec![]), []);
    let other = b.reconfigured(vec![share("/a", "x_msgs/msg/Other")], vec![]);
    assert_eq!(other[0], Command::Unshare { name: mine("/a") });
    assert!(matches!(problems(&other)[..], [Problem::ShareType { .. }]), "{other:?}");
}

#[test]
fn how_much_goes_on_changes_in_a_running_route() {
    let slow = Shaping { interval: Some(Duration::from_secs(1)), ..Shaping::default() };
    let shaped = |name, shaping| Command::Shape { name, shaping };
    let mut b = bench_of(vec![ShareRule { shaping: slow, ..share("/a", "") }], vec![]);
    let begun = b.appears(writer(1, "/a", Qos::default()));
    assert_eq!(begun[1], shaped(mine("/a"), slow), "{begun:?}");
    assert_eq!(b.reconfigured(vec![share("/a", "")], vec![]), [shaped(mine("/a"), Shaping::default())]);
    assert_eq!(b.reconfigured(vec![share("/a", "")], vec![]), []);

    let mut b = bench_of(vec![], vec![use_of(OWNER, "/a", None)]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    let rule = UseRule { shaping: slow, ..use_of(OWNER, "/a", None) };
    assert_eq!(b.reconfigured(vec![], vec![rule]), [shaped(theirs("/a", STRING), slow)]);

    // Publishing in another class begins anew.
    let publish = |class| UseRule { class, shaping: slow, ..publish_rule("/cmd") };
    let mut b = bench_of(vec![], vec![publish(None)]);
    let listed =
        CatalogueEntry { subscribe: false, publish: true, ..entry("/cmd", STRING, Qos::default(), &[]) };
    let name = theirs("/cmd", STRING);
    assert_eq!(b.catalogue(vec![listed])[1], shaped(name, slow));
    let again = b.reconfigured(vec![], vec![publish(Some(Class::Realtime))]);
    let begins = |c: &Command| matches!(c, Command::Publish { class: Class::Realtime, .. });
    assert!(again[0] == Command::Leave { name } && begins(&again[1]), "{again:?}");
}

#[test]
fn uses_begin_and_end_with_their_rules() {
    const OTHER: NodeId = NodeId([3; 32]);
    let mut b = bench(&[], &[("/a", None)]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[]), entry("/b", STRING, Qos::default(), &[])]);
    b.granted(theirs("/a", STRING), None);
    // The owner is followed already, so the new topic is joined at once.
    let name = theirs("/b", STRING);
    let added = b.reconfigured(vec![], vec![use_of(OWNER, "/a", None), use_of(OWNER, "/b", None)]);
    assert_eq!(added, [Command::Join { name, owner: OWNER, transient_local: false, describe: false }]);
    let gone = theirs("/a", STRING);
    let swapped = b.reconfigured(vec![], vec![use_of(OTHER, "/a", None), use_of(OWNER, "/b", None)]);
    let follow = Command::Follow { owner_name: "owner".into() };
    let ended = [Command::CloseWriter { name: gone, source: None }, Command::Leave { name: gone }];
    assert_eq!(swapped, [&ended[..], &[follow]].concat());
    let left = b.reconfigured(vec![], vec![use_of(OTHER, "/a", None)]);
    assert_eq!(left, [Command::Leave { name }, Command::Unfollow { owner: OWNER }]);
}

#[test]
fn a_token_is_joined_without_a_catalogue_and_written_once_it_is_described() {
    let name = theirs("/a", STRING);
    let mut b = bench_of(vec![], vec![token("/a")]);
    assert_eq!(b.commands(), [Command::Join { name, owner: OWNER, transient_local: false, describe: true }]);
    assert_eq!(b.routes.status()[0].state, RouteState::AwaitsGrant);
    b.routes.handle_refused(&name, RefusedBy::Owner(RefuseReason::NotPermitted));
    assert!(matches!(b.routes.status()[0].state, RouteState::Refused(_)), "{:?}", b.routes.status());
    // A catalogue of the same owner does not affect the token.
    assert_eq!(b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]), []);
    let granted = b.granted(name, Some(entry("/a", STRING, Qos::default(), &[])));
    assert!(matches!(&granted[..], [Command::OpenWriter { source: None, .. }]), "{granted:?}");
    assert_eq!(b.catalogue(vec![]), []);
    b.routes.handle_owner_lost(OWNER, LostReason::Withdrawn);
    assert_eq!(b.passes(UNREACHABLE_HOLD), []);
    // A second grant, as after a new epoch, changes nothing.
    assert_eq!(b.granted(name, Some(entry("/a", STRING, Qos::default(), &[]))), []);
    assert_eq!(b.granted(name, None), []);
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD), [Command::CloseWriter { name, source: None }]);
    assert_eq!(b.reconfigured(vec![], vec![]), [Command::Leave { name }]);
    assert_eq!(b.granted(name, Some(entry("/a", STRING, Qos::default(), &[]))), []);
}

#[test]
fn a_latched_topic_of_a_token_is_joined_anew_with_its_history() {
    let name = theirs("/a", STRING);
    let mut b = bench_of(vec![], vec![token("/a")]);
    b.commands();
    let again = b.granted(name, Some(entry("/a", STRING, latched(), &[1])));
    let join = Command::Join { name, owner: OWNER, transient_local: true, describe: true };
    assert_eq!(again, [Command::Leave { name }, join]);
    let opened = b.granted(name, Some(entry("/a", STRING, latched(), &[1])));
    assert!(matches!(&opened[..], [Command::OpenWriter { source: Some(_), .. }]), "{opened:?}");
}

#[test]
fn grant_that_differs_from_the_token_is_not_brought() {
    let name = theirs("/a", STRING);
    let other_blind = entry("/b", STRING, Qos::default(), &[]).blind;
    let right = || entry("/a", STRING, Qos::default(), &[]);
    for wrong in [
        CatalogueEntry { metadata: Metadata::topic("owner", "/cmd_vel", STRING), ..right() },
        CatalogueEntry { metadata: Metadata::topic("owner", "/a", "x_msgs/msg/Other"), ..right() },
        CatalogueEntry { blind: other_blind, ..right() },
    ] {
        let mut b = bench_of(vec![], vec![token("/a")]);
        b.commands();
        let said = b.granted(name, Some(wrong));
        assert!(matches!(said[..], [Command::Report(Problem::TokenEntry { .. })]), "{said:?}");
        assert!(matches!(b.granted(name, Some(right()))[..], [Command::OpenWriter { .. }]));
    }
}

fn publish_rule(topic: &str) -> UseRule {
    UseRule { direction: Direction::Publish, ..use_of(OWNER, topic, None) }
}

#[test]
fn a_topic_that_its_owner_lets_us_publish_on_is_read_while_someone_here_writes_it() {
    let mut b = bench_of(Vec::new(), vec![publish_rule("/cmd")]);
    let name = theirs("/cmd", STRING);
    let listed =
        CatalogueEntry { subscribe: false, publish: true, ..entry("/cmd", STRING, Qos::default(), &[]) };
    let commands = b.catalogue(vec![listed.clone()]);
    assert!(
        matches!(commands[..], [Command::Publish { name: n, owner: OWNER, reliable: true, .. }] if n == name)
    );
    assert_eq!(b.granted(name, None), [], "nobody here publishes yet");
    assert!(opens_reader(&b.appears(writer(1, "/cmd", Qos::default()))));
    assert_eq!(b.appears(writer(2, "/cmd", Qos::default())), []);
    let other = b.appears(endpoint(3, EndpointKind::Writer, "/cmd", "p/msg/Other", Qos::default()));
    assert!(matches!(&other[..], [Command::Report(Problem::LocalType { .. })]), "{other:?}");
    b.vanishes(1);
    assert!(matches!(b.vanishes(2)[..], [Command::CloseReader { .. }]));
    b.appears(writer(4, "/cmd", Qos::default()));
    // The owner no longer permits publishing.
    let commands = b.catalogue(vec![CatalogueEntry { subscribe: true, publish: false, ..listed }]);
    assert!(matches!(commands[..], [Command::CloseReader { .. }, Command::Leave { .. }]), "{commands:?}");
}

#[test]
fn reader_of_local_publishers_follows_the_owner_s_type() {
    let mut b = bench_of(Vec::new(), vec![publish_rule("/cmd")]);
    let listed =
        CatalogueEntry { subscribe: false, publish: true, ..entry("/cmd", STRING, Qos::default(), &[]) };
    b.catalogue(vec![listed.clone()]);
    b.granted(theirs("/cmd", STRING), None);
    b.appears(writer(1, "/cmd", Qos::default()));
    // The owner's first publisher shows that the type has a key.
    let commands = b.catalogue(vec![CatalogueEntry { keyless: false, ..listed.clone() }]);
    assert!(
        matches!(&commands[..], [Command::CloseReader { .. }, Command::OpenReader { spec, .. }] if !spec.keyless),
        "{commands:?}"
    );
    assert_eq!(b.catalogue(vec![CatalogueEntry { keyless: false, ..listed }]), []);
}

#[test]
fn a_topic_that_may_only_be_published_on_is_not_brought_here() {
    let mut b = bench(&[], &[("/cmd", None)]);
    let listed =
        CatalogueEntry { subscribe: false, publish: true, ..entry("/cmd", STRING, Qos::default(), &[]) };
    assert_eq!(b.catalogue(vec![listed]), []);
}

#[test]
fn a_share_that_others_publish_on_is_there_without_a_local_publisher() {
    let mut b = bench_of(vec![inbound("/cmd")], Vec::new());
    let name = mine("/cmd");
    let commands = b.commands();
    assert!(
        matches!(&commands[0], Command::Share(spec) if spec.metadata.type_name == STRING),
        "{commands:?}"
    );
    assert!(!opens_reader(&commands));
    b.routes.handle_publishers(&name, true);
    let commands = b.commands();
    assert!(matches!(&commands[..], [Command::OpenWriter { source: None, .. }]), "{commands:?}");
    b.routes.handle_publishers(&name, true);
    assert_eq!(b.commands(), []);
    // A local publisher appears and vanishes, and the share stays.
    b.appears(writer(1, "/cmd", Qos::default()));
    b.vanishes(1);
    assert!(!has(&b.passes(WRITERLESS_HOLD * 2), |c| matches!(c, Command::Unshare { .. })));
    b.routes.handle_publishers(&name, false);
    assert!(matches!(&b.commands()[..], [Command::CloseWriter { .. }]));
    // No node may publish any more, and no local program does.
    let commands = b.reconfigured(vec![share("/cmd", STRING)], Vec::new());
    assert!(has(&commands, |c| matches!(c, Command::Unshare { .. })), "{commands:?}");
}

fn writer_commands(commands: Vec<Command>) -> Vec<Command> {
    let is_it = |c: &Command| matches!(c, Command::OpenWriter { .. } | Command::CloseWriter { .. });
    commands.into_iter().filter(is_it).collect()
}

#[test]
fn writer_for_messages_of_others_offers_what_they_announced() {
    let mut b = bench_of(vec![inbound("/cmd")], Vec::new());
    let name = mine("/cmd");
    b.commands();
    let second = Some(1_000_000_000);
    let teleop = Qos {
        reliability: Reliability::BestEffort,
        durability: Durability::TransientLocal,
        lease_ns: second,
        liveliness: Liveliness::ManualByTopic,
        ..Qos::default()
    };
    let announce = |b: &mut Bench, offer: Option<&Qos>, may_live| {
        let publishers = AnnouncedPublishers { offer: offer.cloned(), may_live };
        b.routes.handle_announced(b.now, [(name, publishers)].into());
        let at_once = b.commands();
        writer_commands([at_once, b.passes(ANNOUNCED_EVERY)].concat())
    };
    let closes = [Command::CloseWriter { name, source: None }];
    assert_eq!(announce(&mut b, Some(&teleop), true), [], "nobody may publish yet");
    b.routes.handle_publishers(&name, true);
    let [Command::OpenWriter { source: None, spec, .. }] = &b.commands()[..] else { panic!("no writer") };
    assert_eq!((spec.qos.liveliness, spec.qos.lease_ns), (Liveliness::ManualByTopic, second));
    assert!(spec.qos.is_reliable() && !spec.qos.is_transient_local(), "subscribers of both kinds match");
    let opens = [Command::OpenWriter { name, source: None, spec: spec.clone() }];
    assert_eq!(announce(&mut b, Some(&teleop), true), []);
    // All are known to be gone, and subscribers may watch for that.
    assert_eq!(announce(&mut b, Some(&teleop), false), closes);
    assert_eq!(announce(&mut b, None, false), []);
    // A publisher that nobody announces is heard, and then no more.
    b.routes.handle_unwritten(b.now, &name);
    assert_eq!(b.commands(), opens);
    assert_eq!(announce(&mut b, None, false), [], "that is no news");
    b.now += HEARD_MIN;
    let doubted: Vec<_> = b.routes.writers_in_doubt(b.now).into_iter().map(|(name, _)| name).collect();
    assert_eq!(doubted, [name]);
    b.routes.handle_unwritten(b.now, &name);
    assert_eq!((b.routes.writers_in_doubt(b.now), b.commands()), (vec![], vec![]));
    assert_eq!(writer_commands(b.passes(HEARD_MIN)), closes);
    assert_eq!(announce(&mut b, Some(&teleop), true), opens);
    // Another offer takes the place of the writer, which stays though all are gone: nobody can tell.
    let lasting = Qos { lifespan_ns: second, ..Qos::default() };
    let other = announce(&mut b, Some(&lasting), true);
    assert!(
        matches!(&other[..], [Command::OpenWriter { spec, .. }] if spec.qos.lifespan_ns == second),
        "{other:?}"
    );
    assert_eq!(announce(&mut b, None, false), []);
    // All leave and join again: nothing was said of these yet.
    assert_eq!(announce(&mut b, Some(&teleop), false), closes);
    b.routes.handle_publishers(&name, false);
    b.routes.handle_publishers(&name, true);
    assert_eq!(writer_commands(b.commands()), opens);
}

#[test]
fn a_share_with_a_dead_man_switch_has_a_writer_whether_others_publish_or_not() {
    let (after, stop, resume) = (Duration::from_secs(1), StopMessage::Zero, Resume::Auto);
    let switch = DeadManRule { after, stop, repeat: None, resume };
    let rule = ShareRule { dead_man: Some(switch.clone()), ..inbound("/cmd") };
    let mut b = bench_of(vec![rule.clone()], Vec::new());
    let name = mine("/cmd");
    let commands = b.commands();
    let sets = Command::DeadMan { name, rule: Some(switch) };
    let place = |of: &Command| commands.iter().position(|command| command == of);
    let [Command::OpenWriter { spec, .. }] = &writer_commands(commands.clone())[..] else {
        panic!("{commands:?}")
    };
    let opens = Command::OpenWriter { name, source: None, spec: spec.clone() };
    assert!(place(&sets).is_some() && place(&sets) < place(&opens), "{commands:?}");
    for any in [true, false] {
        b.routes.handle_publishers(&name, any);
        assert_eq!(writer_commands(b.commands()), []);
    }
    // Without a switch, the writer goes with the last publisher.
    let commands = b.reconfigured(vec![inbound("/cmd")], Vec::new());
    let closes = Command::CloseWriter { name, source: None };
    assert_eq!(commands, [Command::DeadMan { name, rule: None }, closes]);
    assert_eq!(writer_commands(b.reconfigured(vec![rule], Vec::new())), [opens]);
}

#[test]
fn announcements_that_change_all_the_time_replace_writers_at_a_bounded_pace() {
    let mut b = bench_of(vec![inbound("/cmd")], Vec::new());
    let name = mine("/cmd");
    b.routes.handle_publishers(&name, true);
    b.commands();
    let (mut opened, step, steps) = (Vec::new(), ANNOUNCED_EVERY / 10, 100);
    for n in 0..steps {
        let offer = Some(Qos { deadline_ns: Some(n + 1), ..Qos::default() });
        let publishers = AnnouncedPublishers { offer, may_live: true };
        b.routes.handle_announced(b.now, [(name, publishers)].into());
        opened.extend(b.commands());
        opened.extend(b.passes(step));
    }
    opened.extend(b.passes(ANNOUNCED_EVERY));
    let opened = writer_commands(opened);
    assert_eq!(opened.len(), 1 + usize::try_from(steps).unwrap() / 10, "{opened:?}");
    // The last one counts.
    let last = Some(steps);
    assert!(matches!(opened.last(), Some(Command::OpenWriter { spec, .. }) if spec.qos.deadline_ns == last));
}

#[test]
fn reloaded_qos_of_a_share_is_that_of_the_writer_for_messages_of_others() {
    let rule = inbound("/cmd");
    let mut b = bench_of(vec![rule.clone()], Vec::new());
    b.routes.handle_publishers(&mine("/cmd"), true);
    b.commands();
    let qos = QosOverride { deadline_ns: Some(5), ..QosOverride::default() };
    let commands = b.reconfigured(vec![ShareRule { qos, ..rule }], Vec::new());
    let opens =
        |c: &Command| matches!(c, Command::OpenWriter { spec, .. } if spec.qos.deadline_ns == Some(5));
    assert!(has(&commands, opens), "{commands:?}");
}

#[test]
fn publishers_on_the_topic_of_another_node_are_announced_with_their_liveliness() {
    let mut b =
        bench_of(Vec::new(), vec![UseRule { direction: Direction::Publish, ..use_of(OWNER, "/cmd", None) }]);
    let listed = CatalogueEntry { publish: true, ..entry("/cmd", STRING, Qos::default(), &[]) };
    b.catalogue(vec![listed]);
    let name = theirs("/cmd", STRING);
    b.granted(name, None);
    let lease_ns = Some(1_000_000_000);
    let manual = Qos { liveliness: Liveliness::ManualByTopic, lease_ns, ..Qos::default() };
    let commands = b.appears(writer(1, "/cmd", manual.clone()));
    let watched = |commands: &[Command]| {
        commands.iter().find_map(|c| match c {
            Command::WatchPublishers { publishers, .. } => Some(publishers.clone()),
            _ => None,
        })
    };
    assert_eq!(watched(&commands), Some(vec![(Guid([1; 16]), manual)]));
    let automatic = Qos { lease_ns, ..Qos::default() };
    assert_eq!(watched(&b.appears(writer(2, "/cmd", automatic))), None, "it asserts nothing by itself");
    for participant in [1, 2].map(|n| Guid([n; 16])) {
        let node = RosNode::new("/", "teleop", None).unwrap();
        let nodes = vec![GraphNode { node, readers: Vec::new(), writers: vec![participant] }];
        b.routes.handle_discovery(b.now, DiscoveryEvent::Nodes { participant, nodes });
    }
    let alive = |b: &mut Bench, is_alive| {
        for n in [1, 2] {
            b.routes.handle_discovery(b.now, DiscoveryEvent::Liveliness { guid: Guid([n; 16]), is_alive });
        }
        let told = b.routes.consumers().by_owner.remove(&OWNER).unwrap();
        told.iter().map(|one| (one.qos.liveliness, one.is_alive)).collect::<Vec<_>>()
    };
    let of = |is_alive| [Liveliness::ManualByTopic, Liveliness::Automatic].map(|kind| (kind, is_alive));
    assert_eq!(alive(&mut b, false), of(false));
    assert_eq!(alive(&mut b, true), of(true));
    assert_eq!(watched(&b.vanishes(1)), Some(vec![]));
}

#[test]
fn a_running_share_keeps_its_name_when_the_secret_of_names_is_replaced() {
    let mut b = bench(&[("/a", STRING), ("/b", STRING)], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    b.routes.set_secret(FleetSecret::from_bytes([8; 32]));
    assert!(!has(&b.appears(writer(2, "/a", Qos::default())), |c| matches!(c, Command::Share(_))));
    assert!(has(&b.appears(writer(3, "/b", Qos::default())), |c| matches!(c, Command::Share(_))));
    assert!(b.routes.status().iter().any(|s| s.name == Some(mine("/a"))));
    assert!(b.routes.status().iter().all(|s| s.name != Some(mine("/b"))));
}

#[test]
fn history_of_a_keyed_topic_covers_its_instances() {
    let mut b = bench(&[("/a", ""), ("/b", "")], &[]);
    let depth_of = |commands: &[Command]| {
        let own = commands
            .iter()
            .find_map(|c| if let Command::MapSources { own, .. } = c { Some(own) } else { None });
        own.unwrap()[0].2.history
    };
    let commands = b.appears(DiscoveredEndpoint { keyless: false, ..writer(1, "/a", latched()) });
    assert_eq!(depth_of(&commands), History::KeepLast(sgc_ros::KEYED_INSTANCES_KEPT));
    // The catalogue lists the depth of the writer itself; the far side applies the factor again.
    let offers =
        |c: &Command| matches!(c, Command::UpdateShare { sources, .. } if sources[0].qos == latched());
    assert!(has(&commands, offers), "{commands:?}");
    assert_eq!(depth_of(&b.appears(writer(2, "/b", latched()))), History::KeepLast(1));
}

#[test]
fn readers_ask_for_hashes_of_keys_where_no_writer_is_of_cyclone() {
    let mut b = bench(&[("/a", ""), ("/b", "")], &[]);
    let asks = |commands: &[Command]| {
        commands.iter().find_map(|c| {
            if let Command::OpenReader { spec, .. } = c { Some(spec.asks_key_hash) } else { None }
        })
    };
    let keyed = DiscoveredEndpoint { keyless: false, ..writer(1, "/a", latched()) };
    assert_eq!(asks(&b.appears(keyed.clone())), Some(true));
    let mut guid = Guid([2; 16]);
    guid.0[..2].copy_from_slice(&[0x01, 0x10]);
    assert_eq!(
        asks(&b.appears(DiscoveredEndpoint { guid, ..keyed })),
        Some(false),
        "the reader is made anew"
    );
    assert_eq!(asks(&b.appears(writer(3, "/b", latched()))), Some(false), "there is no key");
}

#[test]
fn catalogue_starts_only_requested_uses() {
    // This node may publish `/a`, uses `/used`, and shares `/own`.
    let uses = vec![publish_rule("/a"), use_of(OWNER, "/used", Some(STRING))];
    let mut b = bench_of(vec![share("/own", "")], uses);
    for topic in ["/a", "/b", "/own", "/used"] {
        b.appears(writer(topic.as_bytes()[1], topic, Qos::default()));
    }
    let as_service = |e: CatalogueEntry| CatalogueEntry {
        metadata: Metadata { kind: Kind::Service, ..e.metadata.clone() },
        ..e
    };
    let both = |topic: &str| CatalogueEntry { publish: true, ..entry(topic, STRING, Qos::default(), &[1]) };
    let mut listed: Vec<_> = ["/b", "/own", "/", "", "/used/more", "a"].map(both).into();
    listed.push(CatalogueEntry { publish: false, ..both("/a") });
    listed.push(as_service(both("/a")));
    listed.push(entry("/used", "p/msg/Other", Qos::default(), &[1]));
    let commands = b.catalogue(listed);
    assert!(commands.iter().all(|c| matches!(c, Command::Report(_))), "{commands:?}");
    // The catalogue of an owner that is not followed changes nothing.
    b.routes.handle_catalogue(b.now, NodeId([7; 32]), Catalogue { version: 1, entries: vec![both("/used")] });
    assert_eq!(b.commands(), []);
    // The interfaces of the rules are joined, in their direction.
    let commands = b.catalogue(vec![both("/a"), both("/used")]);
    assert_eq!(commands.iter().filter(|c| matches!(c, Command::Publish { .. })).count(), 1);
    assert_eq!(commands.iter().filter(|c| matches!(c, Command::Join { .. })).count(), 1);
    // A grant without a join opens nothing.
    assert_eq!(b.granted(theirs("/b", STRING), Some(both("/b"))), []);
}

fn naming(except: &[&str], rename: Rename) -> Naming {
    Naming { except: except.iter().map(|name| (*name).into()).collect(), rename }
}

fn in_namespace(namespace: &str) -> Naming {
    naming(&[], Rename::Namespace(namespace.into()))
}

fn shared(commands: &[Command]) -> Vec<String> {
    let topic =
        |c: &Command| if let Command::Share(s) = c { Some(s.metadata.ros_name.clone()) } else { None };
    let mut topics: Vec<_> = commands.iter().filter_map(topic).collect();
    topics.sort();
    topics
}

/// Returns the joined topics by their owner's names.
fn joined(commands: &[Command], topics: &[&'static str]) -> Vec<&'static str> {
    let is_joined = |topic: &str| {
        has(commands, |c| matches!(c, Command::Join { name, .. } if *name == theirs(topic, STRING)))
    };
    topics.iter().copied().filter(|topic| is_joined(topic)).collect()
}

fn written_as(commands: &[Command]) -> Vec<String> {
    let topic = |c: &Command| match c {
        Command::OpenWriter { spec, .. } => spec.topic.strip_prefix("rt").map(str::to_owned),
        _ => None,
    };
    commands.iter().filter_map(topic).collect()
}

#[test]
fn a_wildcard_shares_what_matches_while_it_is_there() {
    let rule = ShareRule { naming: naming(&["/camera/debug/**"], Rename::Keep), ..share("/camera/**", "") };
    let mut b = bench_of(vec![rule], vec![]);
    assert_eq!(b.routes.status()[0].topic, "/camera/**");
    for (n, topic) in ["/camera", "/camera/debug/x", "/camera/_action/status", "/other"].iter().enumerate() {
        assert_eq!(b.appears(writer(n as u8 + 1, topic, Qos::default())), [], "{topic}");
    }
    assert_eq!(shared(&b.appears(writer(11, "/camera/image", Qos::default()))), ["/camera/image"]);
    let typed = endpoint(12, EndpointKind::Writer, "/camera/info", "p/msg/Info", Qos::default());
    assert_eq!(shared(&b.appears(typed)), ["/camera/info"], "of whatever type");
    let topics: Vec<_> = b.routes.status().into_iter().map(|s| s.topic).collect();
    assert_eq!(topics.len(), 2, "{topics:?}");
    b.vanishes(11);
    assert_eq!(b.passes(WRITERLESS_HOLD), [Command::Unshare { name: mine("/camera/image") }]);
}

#[test]
fn the_rule_that_names_a_topic_counts_before_wildcards_and_those_in_their_order() {
    let bulk = ShareRule { class: Class::Bulk, ..share("/a/**", "") };
    let images = ShareRule { class: Class::Realtime, ..share("/**", "p/msg/Image") };
    let mut b = bench_of(vec![images, bulk, share("/**", ""), share("/rosout", "")], vec![]);
    let mut class = |endpoint| {
        b.appears(endpoint)
            .into_iter()
            .find_map(|c| if let Command::Share(s) = c { Some(s.class) } else { None })
    };
    assert_eq!(class(writer(1, "/a/b", Qos::default())), Some(Class::Bulk));
    let image = endpoint(2, EndpointKind::Writer, "/a/image", "p/msg/Image", Qos::default());
    assert_eq!(class(image), Some(Class::Realtime), "wildcards may be for one type");
    assert_eq!(class(writer(3, "/b", Qos::default())), Some(Class::Default));
    assert_eq!(class(writer(4, "/rosout", Qos::default())), Some(Class::Default), "it is named");
    assert_eq!(class(writer(5, "/parameter_events", Qos::default())), None);
}

#[test]
fn a_share_may_have_another_name_for_others() {
    let named = ShareRule { naming: naming(&[], Rename::As("/r/cam".into())), ..share("/cam", "") };
    let spaced = ShareRule { naming: in_namespace("/r"), ..share("/b/*", "") };
    let mut b = bench_of(vec![named, spaced, share("/r/**", "")], vec![]);
    assert_eq!(shared(&b.appears(writer(1, "/cam", latched()))), ["/r/cam"]);
    b.routes.handle_sink_joined(&mine("/r/b/c"), SinkId([7; 16]));
    let begun = b.appears(writer(2, "/b/c", latched()));
    assert_eq!(shared(&begun), ["/r/b/c"]);
    let read = |c: &Command| matches!(c, Command::OpenReader { name, spec } if *name == mine("/r/b/c") && spec.topic == "rt/b/c");
    assert!(has(&begun, read), "{begun:?}");
    // Two topics cannot have one name.
    let twice = b.appears(writer(3, "/r/cam", Qos::default()));
    assert!(matches!(problems(&twice)[..], [Problem::SharedAsOne { .. }]) && twice.len() == 1, "{twice:?}");
    // Once the first topic is gone, the second may have the name.
    b.vanishes(1);
    assert_eq!(shared(&b.passes(WRITERLESS_HOLD)), ["/r/cam"]);
}

#[test]
fn a_wildcard_brings_what_is_listed_and_namespaces_it() {
    let rule = UseRule {
        naming: Naming { except: vec!["/x/**".into()], ..in_namespace("/r1") },
        ..use_of(OWNER, "/**", None)
    };
    let mut b = bench_of(vec![], vec![rule]);
    const TOPICS: [&str; 5] = ["/tf", "/a/b", "/clock", "/x/y", "/parameter_events"];
    let list =
        |topics: &[&str]| topics.iter().map(|t| entry(t, STRING, Qos::default(), &[])).collect::<Vec<_>>();
    let begun = b.catalogue(list(&TOPICS));
    assert_eq!(joined(&begun, &TOPICS), ["/tf", "/a/b", "/clock", "/parameter_events"]);
    let here = |b: &mut Bench, topic| written_as(&b.granted(theirs(topic, STRING), None));
    assert_eq!(here(&mut b, "/tf"), ["/tf"]);
    assert_eq!(here(&mut b, "/a/b"), ["/r1/a/b"]);
    assert_eq!(here(&mut b, "/clock"), ["/r1/clock"]);
    assert_eq!(b.routes.topic_of(&theirs("/a/b", STRING)), Some("/r1/a/b"));
    // The route follows the catalogue.
    let fewer = b.catalogue(list(&TOPICS[..1]));
    assert!(has(&fewer, |c| *c == Command::Leave { name: theirs("/a/b", STRING) }), "{fewer:?}");
    assert_eq!(joined(&b.catalogue(list(&TOPICS)), &TOPICS), ["/a/b", "/clock", "/parameter_events"]);
    // A local subscriber is checked under the local name.
    let wrong = endpoint(1, EndpointKind::Reader, "/r1/a/b", "x_msgs/msg/Other", Qos::default());
    assert!(matches!(problems(&b.appears(wrong))[..], [Problem::LocalType { .. }]));
}

#[test]
fn names_that_are_none_are_not_brought() {
    let mut b = bench(&[], &[("/**", None)]);
    let long = format!("/{}", "a".repeat(300));
    for topic in ["no_slash", "/a b", "/a//b", "/1", &long, "/a/*"] {
        let said = b.catalogue(vec![entry(topic, STRING, Qos::default(), &[])]);
        let is_refused = matches!(&said[..], [Command::Report(Problem::NoName { .. })] | []);
        assert!(is_refused && b.routes.status()[0].name.is_none(), "{topic}: {said:?}");
    }
    // A namespace may make the name too long.
    let rule = UseRule { naming: in_namespace("/robot"), ..use_of(OWNER, "/**", None) };
    let mut b = bench_of(vec![], vec![rule]);
    let said = b.catalogue(vec![entry(&long[..245], STRING, Qos::default(), &[])]);
    assert!(matches!(problems(&said)[..], [Problem::NoName { .. }]) && said.len() == 1, "{said:?}");
}

#[test]
fn wildcards_do_not_share_used_topics() {
    // A rule that names the topic applies from the beginning.
    let mut b = bench_of(vec![share("/**", "")], vec![use_of(OWNER, "/a", None)]);
    let said = b.appears(writer(1, "/a", Qos::default()));
    assert!(matches!(problems(&said)[..], [Problem::UsedNotShared { .. }]) && said.len() == 1, "{said:?}");
    // A wildcard applies while its topic is brought.
    let mut b = bench_of(vec![share("/**", "")], vec![use_of(OWNER, "/**", None)]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    let said = b.appears(writer(1, "/a", Qos::default()));
    assert!(matches!(problems(&said)[..], [Problem::UsedNotShared { .. }]) && said.len() == 1, "{said:?}");
    let text = problems(&said)[0].to_string();
    assert!(text.contains("except") && text.contains("owner"), "{text}");
    assert_eq!(shared(&b.catalogue(vec![])), ["/a"], "it is brought no longer");
    // A shared topic is not brought until the share ends.
    let listed = || vec![entry("/a", STRING, Qos::default(), &[]), entry("/b", STRING, Qos::default(), &[])];
    let said = b.catalogue(listed());
    assert!(matches!(problems(&said)[..], [Problem::SharedNotUsed { .. }]), "{said:?}");
    assert_eq!(joined(&said, &["/a", "/b"]), ["/b"]);
    b.vanishes(1);
    assert_eq!(joined(&b.passes(WRITERLESS_HOLD), &["/a", "/b"]), ["/a"]);
    // A topic with another name does not conflict.
    let rule = UseRule { naming: in_namespace("/r"), ..use_of(OWNER, "/**", None) };
    let mut b = bench_of(vec![share("/**", "")], vec![rule]);
    assert_eq!(shared(&b.appears(writer(1, "/a", Qos::default()))), ["/a"]);
    assert_eq!(joined(&b.catalogue(listed()), &["/a", "/b"]), ["/a", "/b"]);
}

#[test]
fn topics_of_two_owners_become_one_and_of_two_types_are_named() {
    const OTHER: NodeId = NodeId([3; 32]);
    let mut b = bench_of(
        vec![],
        vec![
            use_of(OWNER, "/tf", None),
            UseRule { owner_name: "other".into(), ..use_of(OTHER, "/tf", None) },
        ],
    );
    b.catalogue(vec![entry("/tf", STRING, latched(), &[1, 2])]);
    let other_type = |type_name: &str| {
        let metadata = Metadata::topic("other", "/tf", type_name);
        let blind = TopicSecret::derive(&secret(), &metadata).blind();
        CatalogueEntry { metadata, blind, ..entry("/tf", type_name, latched(), &[3]) }
    };
    let mut from_other = |entry: CatalogueEntry| {
        let name = sgc_trust::name_of(&OTHER, &entry.blind);
        b.routes.handle_catalogue(b.now, OTHER, Catalogue { version: 1, entries: vec![entry] });
        (name, b.commands())
    };
    let (name, commands) = from_other(other_type(STRING));
    assert_eq!(problems(&commands), [] as [Problem; 0]);
    let (_, commands) = from_other(other_type("p/msg/Other"));
    let text = problems(&commands)[0].to_string();
    assert!(text.contains(STRING) && text.contains("p/msg/Other") && text.contains("namespace"), "{text}");
    from_other(other_type(STRING));
    let both = [b.granted(theirs("/tf", STRING), None), b.granted(name, None)].concat();
    assert_eq!(written_as(&both), ["/tf", "/tf", "/tf"], "each latched publisher has a writer of its own");
}

#[test]
fn a_wildcard_carries_so_many_and_says_so_once() {
    let topic = |n: usize| format!("/t{n}");
    let entries = |topics: std::ops::Range<usize>| -> Vec<_> {
        topics.map(|n| entry(&topic(n), STRING, Qos::default(), &[])).collect()
    };
    let mut b = bench(&[], &[("/**", None)]);
    let all = b.catalogue(entries(0..ROUTES_PER_WILDCARD_MAX + 5));
    let joins = |commands: &[Command]| commands.iter().filter(|c| matches!(c, Command::Join { .. })).count();
    assert_eq!(joins(&all), ROUTES_PER_WILDCARD_MAX);
    assert!(matches!(problems(&all)[..], [Problem::TooManyMatches { .. }]));
    // Later topics find the room of former ones.
    let later = b.catalogue(entries(3..ROUTES_PER_WILDCARD_MAX + 5));
    let again = b.catalogue(entries(3..ROUTES_PER_WILDCARD_MAX + 5));
    assert_eq!((joins(&later) + joins(&again), problems(&later).len()), (3, 0));

    let mut b = bench(&[("/**", "")], &[]);
    let mut begun = Vec::new();
    for n in 0..ROUTES_PER_WILDCARD_MAX + 2 {
        let mut local = writer(0, &topic(n), Qos::default());
        local.guid.0[..8].copy_from_slice(&(n as u64).to_be_bytes());
        begun.extend(b.appears(local));
    }
    assert_eq!(shared(&begun).len(), ROUTES_PER_WILDCARD_MAX);
    assert!(matches!(problems(&begun)[..], [Problem::TooManyMatches { .. }]));
}

#[test]
fn a_route_goes_on_under_whichever_rule_covers_it_now() {
    let mut b = bench_of(vec![share("/a", ""), share("/**", "")], vec![use_of(OWNER, "/c", None)]);
    b.appears(writer(1, "/a", Qos::default()));
    b.appears(writer(2, "/b", Qos::default()));
    b.catalogue(vec![entry("/c", STRING, Qos::default(), &[]), entry("/d", STRING, Qos::default(), &[])]);
    b.granted(theirs("/c", STRING), None);
    let uses = || vec![use_of(OWNER, "/**", None)];
    let wider = b.reconfigured(vec![share("/*", "")], uses());
    assert_eq!(joined(&wider, &["/c", "/d"]), ["/d"], "{wider:?}");
    assert_eq!(wider.len(), 1, "{wider:?}");
    // An exception ends only its own topic.
    let fewer = ShareRule { naming: naming(&["/b"], Rename::Keep), ..share("/*", "") };
    assert_eq!(b.reconfigured(vec![fewer.clone()], uses()), [Command::Unshare { name: mine("/b") }]);
    // Another name needs another writer.
    let name = theirs("/c", STRING);
    let spaced = vec![UseRule { naming: in_namespace("/r"), ..use_of(OWNER, "/**", None) }];
    let moved = b.reconfigured(vec![fewer.clone()], spaced.clone());
    let ends = [Command::CloseWriter { name, source: None }, Command::Leave { name }];
    assert!(ends.iter().all(|end| moved.contains(end)), "{moved:?}");
    assert_eq!(joined(&moved, &["/c", "/d"]), ["/c", "/d"]);
    // The frame prefix changes in a running route.
    let framed = vec![UseRule { frame_prefix: Some("r/".into()), ..spaced[0].clone() }];
    let told = b.reconfigured(vec![fewer.clone()], framed);
    let tells = |c: &Command| matches!(c, Command::Frames { prefix: Some(prefix), .. } if prefix == "r/");
    assert!(told.len() == 2 && told.iter().all(tells), "{told:?}");
    // A rule that names a topic takes it over from a wildcard.
    b.reconfigured(vec![fewer.clone()], uses());
    let claimed = b.reconfigured(vec![fewer, share("/c", "")], uses());
    assert!(has(&claimed, |c| *c == Command::Leave { name }), "{claimed:?}");
    assert!(matches!(problems(&claimed)[..], [Problem::SharedNotUsed { .. }]), "{claimed:?}");
}

/// Returns a share's publishers by the last commands: in the catalogue, and by local writer.
fn published(commands: &[Command]) -> (Vec<CatalogueSource>, Vec<(Guid, SourceId)>) {
    let listed = commands.iter().rev().find_map(|c| match c {
        Command::UpdateShare { sources, .. } => Some(sources.clone()),
        _ => None,
    });
    let own = commands.iter().rev().find_map(|c| match c {
        Command::MapSources { own, .. } => {
            Some(own.iter().map(|(guid, source, _)| (*guid, *source)).collect())
        }
        _ => None,
    });
    (listed.unwrap(), own.unwrap())
}

fn node(name: &str) -> RosNode {
    RosNode::new("/robot", name, None).unwrap()
}

fn participant(n: u8) -> Guid {
    Guid([n; 16])
}

#[test]
fn each_publisher_is_listed_with_what_it_offers_and_its_node() {
    let mut b = bench(&[("/a", "")], &[]);
    let fast = Qos { deadline_ns: Some(5), history: History::KeepLast(3), ..Qos::default() };
    let first = published(&b.appears(writer(1, "/a", fast.clone())));
    assert_eq!(first.0.len(), 1);
    assert_eq!((&first.0[0].qos, &first.0[0].node), (&fast, &None));
    let second = published(&b.appears(writer(2, "/a", Qos::default())));
    assert_eq!((second.0.len(), second.1.len()), (2, 2));
    assert!(second.1.contains(&first.1[0]), "the first keeps its source");
    let named = |b: &mut Bench, nodes| {
        let event = DiscoveryEvent::Nodes { participant: participant(2), nodes };
        b.routes.handle_discovery(b.now, event);
        b.commands()
    };
    let talker = |name| GraphNode { node: node(name), readers: vec![], writers: vec![Guid([2; 16])] };
    let told = published(&named(&mut b, vec![talker("talker")]));
    let of = |told: &(Vec<CatalogueSource>, Vec<(Guid, SourceId)>), n: u8| {
        let source = told.1.iter().find(|(guid, _)| *guid == Guid([n; 16])).unwrap().1;
        told.0.iter().find(|s| s.source == source).unwrap().clone()
    };
    assert_eq!((of(&told, 1).node, of(&told, 2).node), (None, Some(node("talker"))));
    assert_eq!((of(&told, 1).qos, of(&told, 2).qos), (fast, Qos::default()));
    // Endpoints outside of shares have no effect.
    assert_eq!(
        named(&mut b, vec![talker("talker"), GraphNode { writers: vec![Guid([9; 16])], ..talker("x") }]),
        []
    );
    // Nodes may be known before their endpoints.
    let third = published(&b.appears(writer(9, "/a", Qos::default())));
    assert_eq!(of(&third, 9).node, None, "another participant's word counts for nothing");
    let gone = published(&named(&mut b, vec![]));
    assert_eq!(of(&gone, 2).node, None);
}

#[test]
fn a_restarted_volatile_publisher_takes_its_source_over_and_a_gone_one_is_listed_no_more() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    let before = published(&b.appears(writer(2, "/a", Qos::default())));
    // The last messages of the vanished publisher still go out under its source.
    let left = published(&b.vanishes(2));
    assert_eq!(left, before);
    let back = published(&b.appears(writer(3, "/a", Qos::default())));
    assert_eq!(back.0, before.0, "the far side notices nothing");
    let source = |told: &[(Guid, SourceId)], n: u8| told.iter().find(|(g, _)| *g == Guid([n; 16])).unwrap().1;
    assert_eq!(source(&back.1, 3), source(&before.1, 2));
    // A publisher with another offer gets another source.
    b.vanishes(3);
    let other =
        published(&b.appears(writer(4, "/a", Qos { history: History::KeepLast(1), ..Qos::default() })));
    assert_eq!(other.0.len(), 3);
    let later = published(&b.passes(WRITERLESS_HOLD));
    assert_eq!((later.0.len(), later.1.len()), (2, 2));
    assert_eq!(b.routes.poll_timeout(), None);
    // A single publisher keeps its source until the share ends.
    let mut b = bench(&[("/a", "")], &[]);
    let alone = published(&b.appears(writer(1, "/a", Qos::default())));
    assert_eq!(b.vanishes(1), [Command::CloseSource { name: mine("/a"), source: alone.1[0].1 }]);
    assert_eq!(published(&b.appears(writer(2, "/a", Qos::default()))).0, alone.0);
    assert!(!has(&b.passes(WRITERLESS_HOLD), |c| matches!(c, Command::Unshare { .. })));
}

fn leased(liveliness: Liveliness) -> Qos {
    Qos { liveliness, lease_ns: Some(2_000_000_000), ..Qos::default() }
}

#[test]
fn a_lapsed_publisher_is_listed_as_such_until_it_lives_again() {
    let mut b = bench(&[("/a", "")], &[]);
    let alive = published(&b.appears(writer(1, "/a", leased(Liveliness::Automatic))));
    assert!(!alive.0[0].source.is_lapsed());
    let lapsed = published(&b.told_of_liveliness(1, false));
    assert!(lapsed.0.len() == 1 && lapsed.0[0].source.is_lapsed());
    assert_eq!((lapsed.0[0].source, &lapsed.1), (alive.0[0].source.lapsed(), &alive.1), "the same source");
    assert_eq!(b.told_of_liveliness(1, false), [], "it is known");
    assert_eq!(published(&b.told_of_liveliness(1, true)).0, alive.0);
    // A vanished publisher is still lapsed.
    b.told_of_liveliness(1, false);
    let other = published(&b.appears(writer(2, "/a", Qos::default())));
    assert_eq!(other.0.iter().filter(|s| s.source.is_lapsed()).count(), 1);
    let gone = published(&b.vanishes(1));
    assert_eq!(gone.0, other.0);
    // A restarted program takes over the source and is alive.
    let back = published(&b.appears(writer(3, "/a", leased(Liveliness::Automatic))));
    assert!(back.0.len() == 2 && !back.0.iter().any(|s| s.source.is_lapsed()), "{back:?}");
    // A publisher with liveliness manual by topic is renewed by its messages alone, on both networks.
    b.appears(writer(4, "/a", leased(Liveliness::ManualByTopic)));
    assert_eq!(b.told_of_liveliness(4, false), []);
    assert_eq!(b.told_of_liveliness(9, false), [], "nobody's");
}

#[test]
fn a_lapsed_far_publisher_has_no_writer_here() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    let listed = |lapsed: [bool; 2]| {
        let mut listed = entry("/a", STRING, leased(Liveliness::Automatic), &[1, 2]);
        for (source, lapsed) in listed.sources.iter_mut().zip(lapsed) {
            if lapsed {
                source.source = source.source.lapsed();
            }
        }
        vec![listed]
    };
    b.catalogue(listed([false, false]));
    assert_eq!(b.granted(name, None).len(), 2);
    let close = |n: u8| Command::CloseWriter { name, source: Some(SourceId([n; 16])) };
    assert_eq!(b.catalogue(listed([true, false])), [close(1)]);
    assert_eq!(b.catalogue(listed([true, true])), [close(2)], "and none for all others");
    let back = b.catalogue(listed([true, false]));
    let source = SourceId([2; 16]);
    assert!(
        matches!(&back[..], [Command::OpenWriter { source: Some(s), spec, .. }]
            if *s == source && spec.qos == leased(Liveliness::Automatic)),
        "{back:?}"
    );
}

#[test]
fn publishers_are_listed_with_the_qos_that_is_read() {
    let mut b = bench(&[("/a", "")], &[]);
    let reliable = published(&b.appears(writer(1, "/a", Qos::default())));
    let best_effort = Qos { reliability: Reliability::BestEffort, ..Qos::default() };
    let mixed = published(&b.appears(writer(2, "/a", best_effort.clone())));
    assert!(mixed.0.iter().all(|s| s.qos.reliability == Reliability::BestEffort), "{mixed:?}");
    assert!(!mixed.0.iter().any(|s| s.source == reliable.0[0].source), "another kind of source");
    let mixed = published(&b.appears(writer(3, "/a", latched())));
    assert!(mixed.0.iter().all(|s| !s.qos.is_transient_local()));
}

#[test]
fn many_short_lived_publishers_never_take_more_sources_than_can_be_listed() {
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(255, "/a", Qos::default()));
    for n in 0..250 {
        let qos = Qos { history: History::KeepLast(u32::from(n) + 100), ..Qos::default() };
        let told = published(&b.appears(writer(n, "/a", qos)));
        assert!(told.0.len() <= sgc_wire::ENTRY_SOURCES_MAX);
        assert!(told.0.iter().any(|s| s.qos.history == History::KeepLast(u32::from(n) + 100)), "{n}");
        b.vanishes(n);
    }
}

#[test]
fn the_far_node_of_a_writer_is_told_when_it_is_known_and_changes_no_writer() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    let listed = |node: Option<RosNode>| {
        let mut listed = entry("/a", STRING, Qos::default(), &[1]);
        listed.sources[0].node = node;
        vec![listed]
    };
    b.catalogue(listed(None));
    assert!(matches!(&b.granted(name, None)[..], [Command::OpenWriter { source: Some(_), .. }]));
    let (source, owner) = (Some(SourceId([1; 16])), OWNER);
    let set = |node: Option<RosNode>| Command::SetNode { name, source, owner, node };
    assert_eq!(b.catalogue(listed(Some(node("talker")))), [set(Some(node("talker")))]);
    assert_eq!(b.catalogue(listed(Some(node("talker")))), []);
    assert_eq!(b.catalogue(listed(Some(node("other")))), [set(Some(node("other")))]);
    assert_eq!(b.catalogue(listed(None)), [set(None)]);
    b.catalogue(listed(Some(node("talker"))));
    // The node is forgotten with the writer.
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD), [Command::CloseWriter { name, source }]);
    let again = b.granted(name, None);
    assert!(matches!(&again[..], [Command::OpenWriter { .. }, Command::SetNode { .. }]), "{again:?}");
    let mut other = listed(Some(node("talker")));
    other[0].sources[0].qos.history = History::KeepLast(2);
    let changed = b.catalogue(other);
    assert!(
        matches!(
            &changed[..],
            [Command::CloseWriter { .. }, Command::OpenWriter { .. }, Command::SetNode { .. }]
        ),
        "{changed:?}"
    );
}
