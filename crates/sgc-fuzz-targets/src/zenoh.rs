//! The protocol of rmw_zenoh: any text and bytes are read or refused, and what was read has the same meaning when it is
//! written and read again. Tokens that come and go are a graph. The first byte selects the part.

use std::collections::BTreeSet;

use sgc_ros::{DiscoveryEvent, ServiceTopic};
use sgc_zenoh::{
    Attachment, CodecError, Field, Gid, Graph, TOKEN_BYTES_MAX, Token, TopicInfo, ZenohId, decode_qos,
    encode_qos,
};

/// The least first byte that selects the graph.
const GRAPH: u8 = 0xf0;

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let Some((choice, bytes)) = input.split_first() else { return };
    if choice % 5 == 0 {
        return attachment(bytes);
    }
    let Ok(text) = std::str::from_utf8(bytes) else { return };
    if *choice >= GRAPH {
        return graph(text);
    }
    match choice % 5 {
        1 => token(text),
        2 => key(text),
        3 => qos(text),
        _ => id(text),
    }
}

/// An attachment has one encoding.
fn attachment(bytes: &[u8]) {
    if let Ok(attachment) = Attachment::decode(bytes) {
        assert_eq!(attachment.encode().as_slice(), bytes);
    }
}

/// A token may have several spellings, of which one is written, unless ROS accepts no such node.
fn token(text: &str) {
    let Ok(token) = Token::decode(text) else { return };
    match token.encode() {
        Ok(written) => {
            assert!(written.len() <= TOKEN_BYTES_MAX);
            assert_eq!(Token::decode(&written).as_ref(), Ok(&token));
            let _ = Gid::of_token(text);
        }
        Err(refusal) => {
            assert_eq!((refusal, &token.node), (CodecError::RosName { field: Field::NodeName }, &None))
        }
    }
    if let Some(endpoint) = &token.endpoint {
        let key = endpoint.topic.key(token.domain);
        assert_eq!(TopicInfo::parse(&key), Ok((token.domain, endpoint.topic.clone())));
    }
}

/// A key that is read is the key of its parts. Endpoints of DDS that are made of it lead to it again, if ROS accepts the
/// name and the type.
fn key(text: &str) {
    let Ok((domain, topic)) = TopicInfo::parse(text) else { return };
    assert!(!text.contains(['*', '$', '?', '#']));
    assert_eq!(TopicInfo::parse(&topic.key(domain)), Ok((domain, topic.clone())));
    let halves = [ServiceTopic::Request, ServiceTopic::Reply].map(|half| topic.dds_service(half));
    for (dds_topic, dds_type) in [topic.dds_topic()].into_iter().chain(halves) {
        if let Ok(read) = TopicInfo::from_dds(&dds_topic, &dds_type, Some(topic.type_hash())) {
            assert_eq!(read.name(), topic.name());
        }
    }
}

/// QoS that is read can be written.
fn qos(text: &str) {
    if let Ok(qos) = decode_qos(text) {
        assert_eq!(decode_qos(&encode_qos(&qos).unwrap()), Ok(qos));
    }
}

/// An id has one spelling.
fn id(text: &str) {
    if let Ok(id) = text.parse::<ZenohId>() {
        assert_eq!(id.to_string(), text);
        assert_eq!(id.is_of_sgc(), text.len() == 32 && text.starts_with("534743a75e1d"));
    }
}

/// The events of a graph add up: an endpoint appears once and vanishes once, and nothing is left of tokens that ended. Each
/// line is a token that ends if it begins with `-`.
fn graph(text: &str) {
    let own = ZenohId::of_sgc([0; 10]);
    let mut graph = Graph::new(0, own, true);
    graph.watch();
    let (mut declared, mut known) = (BTreeSet::new(), BTreeSet::new());
    let mut take = |graph: &mut Graph| {
        for event in graph.endpoint_events().into_iter().chain(graph.node_events()) {
            match event {
                DiscoveryEvent::Appeared(endpoint) => assert!(known.insert(endpoint.guid)),
                DiscoveryEvent::Vanished { guid } => assert!(known.remove(&guid)),
                _ => {}
            }
        }
        known.len()
    };
    for line in text.lines() {
        if let Some(token) = line.strip_prefix('-') {
            graph.undeclare(token);
            declared.remove(token);
        } else if graph.declare(line).is_ok() {
            declared.insert(line);
        }
        take(&mut graph);
    }
    declared.iter().for_each(|token| _ = graph.undeclare(token));
    assert_eq!((take(&mut graph), graph.tokens()), (0, 0));
}
