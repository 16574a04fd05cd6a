//! Tests of the route machine with services: servers and catalogues go in, clients and servers come out.

#![allow(clippy::unwrap_used, clippy::disallowed_methods)]

use std::time::Instant;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sgc_endpoint::LostReason;
use sgc_ros::{
    Command, Direction, DiscoveredEndpoint, DiscoveryEvent, EndpointKind, Guid, Naming, QosOverride,
    REDISCOVERY_HOLD, Routes, SINKLESS_HOLD, ServiceTopic, Shaping, ShareRule, UNREACHABLE_HOLD, UseRule,
    WRITERLESS_HOLD, service_qos,
};
use sgc_trust::{FleetSecret, Policy, Suite, TopicSecret, derive_name};
use sgc_wire::{Catalogue, CatalogueEntry, Class, Kind, Metadata, Name, NodeId, SinkId};

const ME: NodeId = NodeId([1; 32]);
const OWNER: NodeId = NodeId([2; 32]);
const TYPE: &str = "example_interfaces/srv/AddTwoInts";

fn secret() -> FleetSecret {
    FleetSecret::from_bytes([9; 32])
}

fn metadata(owner: &str, kind: Kind) -> Metadata {
    Metadata { kind, ..Metadata::topic(owner, "/add", TYPE) }
}

fn routes(shares: Vec<ShareRule>, uses: Vec<UseRule>) -> Routes<ChaCha8Rng> {
    Routes::new(secret(), ME, shares, uses, ChaCha8Rng::seed_from_u64(1))
}

fn served() -> (Routes<ChaCha8Rng>, Name) {
    let mut policy = Policy::default();
    policy.publish.nodes.insert(OWNER);
    let rule = ShareRule {
        dead_man: None,
        metadata: Metadata { type_name: String::new(), ..metadata("me", Kind::Service) },
        naming: Naming::default(),
        policy,
        suite: Suite::Group,
        class: Class::Default,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
        dedicated: false,
    };
    (routes(vec![rule], vec![]), derive_name(&secret(), &ME, &metadata("me", Kind::Service)))
}

/// Returns one end of a server or a client, `entity` being its number in the participant.
fn end(participant: u8, entity: u8, kind: EndpointKind, half: ServiceTopic) -> DiscoveredEndpoint {
    let mut guid = [participant; 16];
    guid[12..].copy_from_slice(&[0, 0, entity, 3]);
    DiscoveredEndpoint {
        kind,
        guid: Guid(guid),
        topic: half.dds_topic("/add"),
        type_name: half.dds_type(TYPE),
        keyless: true,
        type_hash: None,
        qos: service_qos(),
    }
}

fn commands(routes: &mut Routes<ChaCha8Rng>) -> Vec<Command> {
    std::iter::from_fn(|| routes.poll_command()).collect()
}

/// Returns the names of commands, without those that follow each change.
fn words(routes: &mut Routes<ChaCha8Rng>) -> Vec<String> {
    let word = |command: Command| format!("{command:?}").split([' ', '(']).next().unwrap().to_owned();
    let all = commands(routes).into_iter().map(word);
    all.filter(|word| !["UpdateShare", "MapSources"].contains(&&word[..])).collect()
}

#[test]
fn a_server_is_a_request_reader_and_a_reply_writer_of_one_participant() {
    use EndpointKind::{Reader, Writer};
    use ServiceTopic::{Reply, Request};
    let now = Instant::now();
    let (mut routes, name) = served();
    let appears = |routes: &mut Routes<_>, e| routes.handle_discovery(now, DiscoveryEvent::Appeared(e));
    appears(&mut routes, end(1, 1, Reader, Request));
    appears(&mut routes, end(2, 1, Writer, Reply));
    // A client, and an endpoint that imitates a whole server.
    appears(&mut routes, end(3, 1, Writer, Request));
    appears(&mut routes, end(3, 2, Reader, Reply));
    let mut whole = end(4, 1, Writer, Reply);
    (whole.topic, whole.type_name) = ("rs/add".into(), "example_interfaces::srv::dds_::AddTwoInts_".into());
    appears(&mut routes, whole);
    assert_eq!(words(&mut routes), [""; 0]);
    appears(&mut routes, end(1, 2, Writer, Reply));
    let begun = commands(&mut routes);
    let Some(Command::Share(spec)) = begun.first() else { panic!("{begun:?}") };
    assert_eq!(spec.metadata, metadata("me", Kind::Service));
    // A second server keeps the service available without the first.
    appears(&mut routes, end(2, 2, Reader, Request));
    let gone = |routes: &mut Routes<_>, e: DiscoveredEndpoint| {
        routes.handle_discovery(now, DiscoveryEvent::Vanished { guid: e.guid });
    };
    gone(&mut routes, end(1, 2, Writer, Reply));
    assert_eq!(words(&mut routes), [""; 0]);
    gone(&mut routes, end(2, 2, Reader, Request));
    assert_eq!(words(&mut routes), ["ServersGone"]);
    // A server that returns at once keeps its callers.
    appears(&mut routes, end(1, 2, Writer, Reply));
    routes.handle_timeout(now + WRITERLESS_HOLD);
    assert_eq!(words(&mut routes), [""; 0]);
    gone(&mut routes, end(1, 1, Reader, Request));
    routes.handle_timeout(now + WRITERLESS_HOLD);
    assert_eq!(words(&mut routes), ["ServersGone", "Unshare"]);
    assert!(!routes.is_service(&name));
}

#[test]
fn local_servers_are_called_while_somebody_may_call() {
    let now = Instant::now();
    let (mut routes, name) = served();
    for (entity, kind, half) in
        [(1, EndpointKind::Reader, ServiceTopic::Request), (2, EndpointKind::Writer, ServiceTopic::Reply)]
    {
        routes.handle_discovery(now, DiscoveryEvent::Appeared(end(1, entity, kind, half)));
    }
    assert_eq!(words(&mut routes), ["Share"]);
    assert!(routes.is_service(&name));
    routes.handle_sink_joined(&name, SinkId([1; 16]));
    let opened = commands(&mut routes);
    let Some(Command::OpenClient { spec, .. }) = opened.last() else { panic!("{opened:?}") };
    assert_eq!((&spec.request.topic[..], &spec.reply.topic[..]), ("rq/addRequest", "rr/addReply"));
    routes.handle_publishers(&name, true);
    routes.handle_sink_left(now, &name, &SinkId([1; 16]));
    routes.handle_sink_joined(&name, SinkId([2; 16]));
    routes.handle_timeout(now + SINKLESS_HOLD);
    assert_eq!(words(&mut routes), [""; 0]);
    routes.handle_sink_left(now, &name, &SinkId([2; 16]));
    routes.handle_timeout(now + SINKLESS_HOLD);
    assert_eq!(words(&mut routes), ["CloseClient"]);
}

#[test]
fn a_remote_service_is_here_while_it_is_granted_and_a_topic_of_its_name_is_not() {
    let now = Instant::now();
    let rule = UseRule {
        direction: Direction::Publish,
        owner: OWNER,
        owner_name: "owner".into(),
        kind: Kind::Service,
        topic: "/add".into(),
        naming: Naming::default(),
        frame_prefix: None,
        dead_man: None,
        type_name: None,
        dedicated: false,
        token: None,
        class: None,
        shaping: Shaping::default(),
        qos: QosOverride::default(),
    };
    let mut routes = routes(vec![], vec![rule]);
    let entry = |kind| CatalogueEntry {
        metadata: metadata("owner", kind),
        blind: TopicSecret::derive(&secret(), &metadata("owner", kind)).blind(),
        subscribe: true,
        publish: true,
        suite: 1,
        keyless: true,
        type_hash: None,
        class: Class::Default,
        qos: service_qos(),
        sources: vec![],
    };
    routes.handle_catalogue(now, OWNER, Catalogue { version: 1, entries: vec![entry(Kind::Topic)] });
    assert_eq!(words(&mut routes), [""; 0]);
    let both = vec![entry(Kind::Topic), entry(Kind::Service)];
    routes.handle_catalogue(now, OWNER, Catalogue { version: 2, entries: both.clone() });
    assert_eq!(words(&mut routes), ["Call"]);
    let name = derive_name(&secret(), &OWNER, &metadata("owner", Kind::Service));
    routes.handle_granted(&name, None);
    assert_eq!(words(&mut routes), ["OpenServer"]);
    // A short absence of the owner is not noticed here.
    routes.handle_lost(now, &name);
    routes.handle_granted(&name, None);
    routes.handle_timeout(now + UNREACHABLE_HOLD);
    routes.handle_catalogue(now, OWNER, Catalogue { version: 3, entries: both.clone() });
    assert_eq!(words(&mut routes), [""; 0]);
    routes.handle_lost(now, &name);
    routes.handle_timeout(now + UNREACHABLE_HOLD);
    assert_eq!(words(&mut routes), ["CloseServer"]);
    routes.handle_granted(&name, None);
    assert_eq!(words(&mut routes), ["OpenServer"]);
    // A service of a restarted owner gets no writer once the owner's time to rediscover its network has ended.
    routes.handle_owner_lost(OWNER, LostReason::Unreachable);
    routes.handle_catalogue(now, OWNER, Catalogue { version: 4, entries: both.clone() });
    routes.handle_timeout(now + REDISCOVERY_HOLD);
    assert_eq!(words(&mut routes), [""; 0]);
    routes.handle_catalogue(now, OWNER, Catalogue { version: 5, entries: vec![] });
    assert_eq!(words(&mut routes), ["CloseServer", "Leave"]);
    routes.handle_catalogue(now, OWNER, Catalogue { version: 6, entries: both });
    routes.handle_owner_lost(OWNER, LostReason::Withdrawn);
    assert_eq!(words(&mut routes), ["Call", "Leave"]);
}
