//! Discovery of endpoints and nodes.

use std::sync::mpsc::{Receiver, RecvTimeoutError, TryRecvError};

use sgc_ros::{
    DiscoveredEndpoint, DiscoveryEvent, EndpointKind, EndpointSpec, GraphNode, Guid, RosNetwork, RosWriter,
};
use sgc_wire::{Durability, History, Reliability, RosNode};

use super::rig::{HASH, PATIENCE, discover, matched, next, quiet, read, spec, with};
use super::{Site, appeared, vanished};

/// Discovery tells everything about writers and readers, and their ends.
pub fn discovery_tells_name_type_hash_and_full_qos_and_the_end<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let events = discover(&sgc);
    let qos = S::told_qos();
    let writer = ros.create_writer(&EndpointSpec { qos: qos.clone(), ..spec("chatter") }).expect("a writer");
    let seen = appeared(&events);
    let told = DiscoveredEndpoint {
        kind: EndpointKind::Writer,
        guid: writer.guid(),
        topic: "rt/chatter".into(),
        type_name: "std_msgs::msg::dds_::String_".into(),
        keyless: true,
        type_hash: Some(HASH.into()),
        qos,
    };
    assert_eq!(seen, told);

    let reader_spec = with(spec("chatter"), |qos| {
        qos.reliability = Reliability::BestEffort;
        qos.history = History::KeepLast(3);
    });
    let (reader, _samples) = read(&ros, &reader_spec);
    let seen = appeared(&events);
    assert_eq!((seen.kind, seen.guid), (EndpointKind::Reader, ros.reader_guid(&reader)));
    let (reliability, durability) = (seen.qos.reliability, seen.qos.durability);
    assert_eq!((reliability, durability), (Reliability::BestEffort, Durability::Volatile));
    assert_eq!((seen.qos.deadline_ns, seen.qos.lease_ns), (None, None));

    let guid = ros.reader_guid(&reader);
    drop(reader);
    assert_eq!(vanished(&events), guid);
    let guid = writer.guid();
    drop(writer);
    assert_eq!(vanished(&events), guid);
}

/// Endpoints that were there before discovery began are told once.
pub fn discovery_tells_what_was_there_before<S: Site>() {
    let site = S::new();
    let ros = site.open(None);
    let writers = ["a", "b"].map(|topic| ros.create_writer(&spec(topic)).expect("a writer"));
    let sgc = site.open(Some("arm-1"));
    let (_reader, _samples) = read(&sgc, &spec("b"));
    matched(&writers[1], 1);

    let events = discover(&sgc);
    let mut seen = [appeared(&events).topic, appeared(&events).topic];
    seen.sort();
    assert_eq!(seen, ["rt/a", "rt/b"]);
    quiet(&events);
}

/// A proxy sees neither its own endpoints nor those of other proxies; programs see them.
pub fn proxies_do_not_see_each_others_endpoints_nor_their_own<S: Site>() {
    let site = S::new();
    let (one, two, ros) = (site.open(Some("arm-1")), site.open(Some("arm-2")), site.open(None));
    let (events_one, events_ros) = (discover(&one), discover(&ros));
    let writers = [&one, &two].map(|proxy| proxy.create_writer(&spec("a")).expect("a writer"));
    let mut tagged = [appeared(&events_ros).guid, appeared(&events_ros).guid];
    tagged.sort();
    let mut expected = writers.each_ref().map(RosWriter::guid);
    expected.sort();
    assert_eq!(tagged, expected, "a network without tag sees them");

    let plain = ros.create_writer(&spec("c")).expect("a writer");
    assert_eq!(appeared(&events_one).guid, plain.guid(), "the first that the tagged network is told");
    quiet(&events_one);
    quiet(&events_ros);
    drop(writers);
    quiet(&events_one);
}

/// Networks at different places do not meet.
pub fn domains_are_apart_even_in_one_process<S: Site>() {
    let sites = [S::new(), S::new()];
    let peers = sites.each_ref().map(|site| site.open(Some("a")));
    let events = peers.each_ref().map(discover);
    let networks = sites.each_ref().map(|site| site.open(None));
    let writers = networks.each_ref().map(|network| network.create_writer(&spec("t")).expect("a writer"));
    for (events, writer) in events.iter().zip(&writers) {
        assert_eq!(appeared(events).guid, writer.guid());
        quiet(events);
    }
}

/// A network that is dropped ends its discovery. Its endpoints live until they are dropped.
pub fn dropped_network_ends_discovery_and_leaves_its_endpoints<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open(None), site.open(Some("arm-1")));
    let events = discover(&sgc);
    let ros_events = discover(&ros);
    let (reader, samples) = read(&ros, &spec("t"));
    let writer = ros.create_writer(&spec("u")).expect("a writer");
    let mut guids = [appeared(&events).guid, appeared(&events).guid];
    guids.sort();

    drop(ros);
    assert_eq!(ros_events.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected));
    quiet(&events);
    drop((reader, writer));
    assert_eq!(samples.recv_timeout(PATIENCE), Err(RecvTimeoutError::Disconnected));
    let mut gone = [vanished(&events), vanished(&events)];
    gone.sort();
    assert_eq!(gone, guids);

    let own = discover(&site.open(Some("arm-2")));
    assert_eq!(own.try_recv(), Err(TryRecvError::Disconnected), "the drop waited");
}

fn graph_node(name: &str, writers: &[Guid]) -> GraphNode {
    let node = RosNode::new("/robot", name, None).expect("a name of a node");
    GraphNode { node, readers: vec![], writers: writers.to_vec() }
}

/// Returns the next event about nodes, and skips those about endpoints.
fn nodes(events: &Receiver<DiscoveryEvent>) -> (Guid, Vec<GraphNode>) {
    loop {
        if let DiscoveryEvent::Nodes { participant, nodes } = next(events) {
            return (participant, nodes);
        }
    }
}

/// The nodes of a participant are told whenever they change, and as gone with it.
pub fn nodes_and_their_endpoints_are_told_and_gone_with_their_participant<S: Site>() {
    let site = S::new();
    let (ros, sgc) = (site.open_with_graph(None), site.open_with_graph(Some("arm-1")));
    let events = discover(&sgc);
    let talker = ros.create_writer(&spec("chatter")).expect("a writer");
    let announced = [graph_node("talker", &[talker.guid()])];
    ros.announce(&announced).expect("an announcement");
    let (participant, told) = nodes(&events);
    assert_eq!((participant.prefix(), told), (talker.guid().prefix(), announced.to_vec()));
    ros.announce(&[]).expect("an announcement");
    assert_eq!(nodes(&events), (participant, vec![]));
    ros.announce(&announced).expect("an announcement");
    assert_eq!(nodes(&events), (participant, announced.to_vec()));
    drop((talker, ros));
    assert_eq!(nodes(&events), (participant, vec![]));

    // A late listener learns of existing nodes.
    let ros = site.open_with_graph(None);
    ros.announce(&[graph_node("talker", &[])]).expect("an announcement");
    let late = site.open_with_graph(Some("late"));
    let (other, told) = nodes(&discover(&late));
    assert_eq!((other == participant, told), (false, vec![graph_node("talker", &[])]));
}

/// Proxies tell programs of the nodes that they announce, and not each other.
pub fn announcements_of_proxies_are_hidden_from_other_proxies<S: Site>() {
    let site = S::new();
    let [ros, sgc, other] = [None, Some("arm-1"), Some("arm-2")].map(|tag| site.open_with_graph(tag));
    let (seen, other_seen) = (discover(&ros), discover(&other));
    let mirrored = sgc.create_writer(&spec("chatter")).expect("a writer");
    sgc.announce(&[graph_node("talker", &[mirrored.guid()])]).expect("an announcement");
    let (participant, told) = nodes(&seen);
    assert_eq!(participant.prefix(), mirrored.guid().prefix());
    assert_eq!(told, [graph_node("talker", &[mirrored.guid()])]);
    // Every proxy reports a node beside it: the first that it is told.
    ros.announce(&[graph_node("local", &[])]).expect("an announcement");
    assert_eq!(nodes(&other_seen).1, [graph_node("local", &[])]);
}
