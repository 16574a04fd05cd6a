//! The route machine: what happens on the local network and at the owners goes in, commands come out.

#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::time::{Duration, Instant};

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sgc_endpoint::{LostReason, RefusedBy};
use sgc_ros::{
    Command, Direction, DiscoveredEndpoint, DiscoveryEvent, EndpointKind, Guid, Problem, Routes,
    SINKLESS_HOLD, ShareRule, UNREACHABLE_HOLD, UseRule, WRITERLESS_HOLD, dds_topic, dds_type,
};
use sgc_trust::{FleetSecret, Policy, Suite, TopicSecret, derive_name};
use sgc_wire::{
    Catalogue, CatalogueEntry, CatalogueSource, Class, Durability, History, Metadata, Name, NodeId, Qos,
    RefuseReason, Reliability, SinkId, SourceId,
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
        metadata: Metadata::topic("me", topic, type_name),
        policy: Policy::default(),
        suite: Suite::Group,
        class: Class::Default,
    }
}

fn use_of(owner: NodeId, topic: &str, type_name: Option<&str>) -> UseRule {
    UseRule {
        direction: Direction::Bring,
        owner,
        owner_name: "owner".into(),
        topic: topic.into(),
        type_name: type_name.map(Into::into),
        token: None,
    }
}

/// A rule for the token of a topic of `OWNER`.
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
    let source = |n: &u8| CatalogueSource { source: SourceId([*n; 16]), qos: qos.clone() };
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

    fn catalogue(&mut self, entries: Vec<CatalogueEntry>) -> Vec<Command> {
        self.routes.handle_catalogue(OWNER, Catalogue { version: 1, entries });
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

fn problems(commands: &[Command]) -> Vec<&Problem> {
    commands.iter().filter_map(|c| if let Command::Report(p) = c { Some(p) } else { None }).collect()
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
    assert_eq!(b.vanishes(1), []);
    let again = [b.appears(writer(2, "/a", Qos::default())), b.passes(WRITERLESS_HOLD)].concat();
    assert!(!has(&again, |c| matches!(c, Command::Unshare { .. } | Command::Share(_))), "{again:?}");
    b.vanishes(2);
    assert_eq!(b.passes(WRITERLESS_HOLD), [Command::Unshare { name: mine("/a") }]);
    assert_eq!(b.routes.poll_timeout(), None);
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
fn what_does_not_agree_is_said_once_with_both_values() {
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
    let wants_more = endpoint(2, EndpointKind::Reader, "/a", STRING, latched());
    assert!(matches!(problems(&b.appears(wants_more))[..], [Problem::LocalQos { .. }]));
    let content = endpoint(3, EndpointKind::Reader, "/a", STRING, Qos::default());
    assert_eq!(b.appears(content), []);
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
    // The way breaks and comes back in time: the local network notices nothing.
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD / 2), []);
    b.routes.handle_granted(&name, None);
    assert_eq!([b.commands(), b.passes(UNREACHABLE_HOLD)].concat(), []);
    // It breaks for longer: the writer goes, and comes back with the grant.
    b.routes.handle_lost(b.now, &name);
    assert_eq!(b.passes(UNREACHABLE_HOLD), [Command::CloseWriter { name, source: None }]);
    b.routes.handle_granted(&name, None);
    assert!(has(&b.commands(), |c| matches!(c, Command::OpenWriter { .. })));
    // The owner no longer shares it: gone at once.
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
    // The topic's own way stands, so nothing will grant it again.
    b.routes.handle_owner_lost(OWNER, LostReason::Unreachable);
    assert_eq!(b.passes(2 * UNREACHABLE_HOLD), []);
    assert_eq!(b.catalogue(entries()), []);
    assert_eq!(b.passes(2 * UNREACHABLE_HOLD), []);
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
fn an_owner_that_stops_takes_its_topics_along() {
    let mut b = bench(&[], &[("/a", None)]);
    let name = theirs("/a", STRING);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]);
    b.routes.handle_granted(&name, None);
    b.commands();
    b.routes.handle_owner_lost(OWNER, LostReason::Withdrawn);
    assert_eq!(b.commands(), [Command::CloseWriter { name, source: None }, Command::Leave { name }]);
    assert!(b.routes.status()[0].state.contains("has gone"), "{:?}", b.routes.status());
}

#[test]
fn status_says_what_each_rule_waits_for() {
    let mut b = bench(&[("/a", "")], &[("/b", None)]);
    let states = |b: &Bench| b.routes.status().into_iter().map(|s| s.state).collect::<Vec<_>>();
    assert_eq!(states(&b), ["waits for a local publisher", "owner does not share it with this node (yet)"]);
    b.appears(writer(1, "/a", Qos::default()));
    b.catalogue(vec![entry("/b", STRING, Qos::default(), &[])]);
    assert_eq!(states(&b)[1], "waits for the owner's grant");
    b.routes.handle_refused(&theirs("/b", STRING), RefusedBy::Owner(RefuseReason::NotPermitted));
    assert_eq!(states(&b)[1], "refused: the owner does not share it with this node");
    assert!(states(&b)[0].contains("1 local publishers, 0 remote subscribers"), "{:?}", states(&b));
}

#[test]
fn what_is_configured_as_before_is_not_touched() {
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
    // Neither does their order matter.
    let (mut shares, mut uses) = rules();
    shares.reverse();
    uses.reverse();
    assert_eq!(b.reconfigured(shares, uses), []);
    let mut after = b.routes.status();
    after.sort_by_key(|s| (s.direction, s.topic.clone()));
    assert_eq!(after, before);
    // Each still belongs to its rule: what leaves, leaves alone.
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
    // A share that begins later begins with it.
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
fn what_cannot_change_in_a_running_share_ends_it_and_begins_it_anew() {
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
    // A type that says what is there already changes nothing; another one ends the share.
    let mut b = bench(&[("/a", "")], &[]);
    b.appears(writer(1, "/a", Qos::default()));
    assert_eq!(b.reconfigured(vec![share("/a", STRING)], vec![]), []);
    let other = b.reconfigured(vec![share("/a", "x_msgs/msg/Other")], vec![]);
    assert_eq!(other[0], Command::Unshare { name: mine("/a") });
    assert!(matches!(problems(&other)[..], [Problem::ShareType { .. }]), "{other:?}");
}

#[test]
fn uses_begin_and_end_with_their_rules() {
    const OTHER: NodeId = NodeId([3; 32]);
    let mut b = bench(&[], &[("/a", None)]);
    b.catalogue(vec![entry("/a", STRING, Qos::default(), &[]), entry("/b", STRING, Qos::default(), &[])]);
    b.granted(theirs("/a", STRING), None);
    // The owner is followed already, so that the new topic is known at once.
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
    assert_eq!(b.routes.status()[0].state, "waits for the owner's grant");
    b.routes.handle_refused(&name, RefusedBy::Owner(RefuseReason::NotPermitted));
    assert!(b.routes.status()[0].state.starts_with("refused"), "{:?}", b.routes.status());
    // A catalogue of the same owner has no say in it.
    assert_eq!(b.catalogue(vec![entry("/a", STRING, Qos::default(), &[])]), []);
    let granted = b.granted(name, Some(entry("/a", STRING, Qos::default(), &[])));
    assert!(matches!(&granted[..], [Command::OpenWriter { source: None, .. }]), "{granted:?}");
    assert_eq!(b.catalogue(vec![]), []);
    b.routes.handle_owner_lost(OWNER, LostReason::Withdrawn);
    assert_eq!(b.passes(UNREACHABLE_HOLD), []);
    // Granted again, as after a new epoch: nothing changes.
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
fn what_is_not_as_the_token_says_is_not_brought_here() {
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
    assert_eq!(b.appears(endpoint(3, EndpointKind::Writer, "/cmd", "p/msg/Other", Qos::default())), []);
    b.vanishes(1);
    assert!(matches!(b.vanishes(2)[..], [Command::CloseReader { .. }]));
    b.appears(writer(4, "/cmd", Qos::default()));
    // Allowed no longer.
    let commands = b.catalogue(vec![CatalogueEntry { subscribe: true, publish: false, ..listed }]);
    assert!(matches!(commands[..], [Command::CloseReader { .. }, Command::Leave { .. }]), "{commands:?}");
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
    let mut publish = Policy::default();
    publish.publish.nodes.insert(OWNER);
    let mut b = bench_of(vec![ShareRule { policy: publish, ..share("/cmd", STRING) }], Vec::new());
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
    // A publisher here comes and goes; the share stays.
    b.appears(writer(1, "/cmd", Qos::default()));
    b.vanishes(1);
    assert!(!has(&b.passes(WRITERLESS_HOLD * 2), |c| matches!(c, Command::Unshare { .. })));
    b.routes.handle_publishers(&name, false);
    assert!(matches!(&b.commands()[..], [Command::CloseWriter { .. }]));
    // Nobody may any more, and nobody here does.
    let commands = b.reconfigured(vec![share("/cmd", STRING)], Vec::new());
    assert!(has(&commands, |c| matches!(c, Command::Unshare { .. })), "{commands:?}");
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
