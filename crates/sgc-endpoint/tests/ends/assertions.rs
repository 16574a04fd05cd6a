//! Publishers that assert their liveliness without a message.

use super::*;

/// The first bytes of the publisher's source ids.
const PUBLISHER: [u8; 8] = [5; 8];

fn asserted(source: &mut Source, publisher: [u8; 8]) -> Packet {
    let mut packets = Vec::new();
    source.assert_publisher(publisher, |p| packets.push(p)).expect("it keeps nothing");
    assert_eq!(packets.len(), 1);
    packets.remove(0)
}

#[test]
fn assertion_is_of_a_publisher_at_the_same_node_each_time_and_once() {
    for suite in [Suite::Group, Suite::Standard] {
        let (publisher, mut node) = (source(suite, 0), unrecovered(suite, 6));
        for transient_local in [false, true] {
            let granted = grant(suite, 1, &announced(&[&publisher, &node]));
            let mut sink = Sink::new(NAME, SINK, granted, transient_local, SinkLimits::default());
            for _ in 0..3 {
                let packet = asserted(&mut node, PUBLISHER);
                assert_eq!(sink.handle_packet(&packet), Ok(Delivery::Asserted(publisher.id())));
                assert_eq!(sink.handle_packet(&packet), Err(SinkDrop::Replayed), "a router says it again");
            }
            // Nobody asks for lost ones.
            asserted(&mut node, PUBLISHER);
            let next = asserted(&mut node, PUBLISHER);
            assert_eq!(sink.handle_packet(&next), Ok(Delivery::Asserted(publisher.id())));
            assert!(!sink.unsynced().any(|source| source == node.id() && !transient_local));
            assert_eq!(sink.handle_packet(&asserted(&mut node, [9; 8])), Ok(Delivery::Mark));
        }
    }
}

/// A node that publishes on another's topic has one source for messages and assertions.
#[test]
fn source_without_history_asserts_its_own_publishers() {
    let mut node = unrecovered(Suite::Standard, 6);
    let (id, mut sink) = (node.id(), sink(Suite::Standard, &[&node]));
    assert_eq!(sink.handle_packet(&asserted(&mut node, id.publisher())), Ok(Delivery::Asserted(id)));
    assert_eq!(sink.handle_packet(&asserted(&mut node, PUBLISHER)), Ok(Delivery::Mark));
}

#[test]
fn assertion_of_another_nodes_publisher_is_none() {
    let suite = Suite::Standard;
    let publisher = source(suite, 0);
    let config = SourceConfig { recovery: RecoveryLimits::NONE, ..config(6, 0) };
    let another = MessageKey::generate(suite);
    let mut stranger = Source::new(config, &grant(suite, 1, &[]), another).expect("the key is of the suite");
    let mut sink = sink(suite, &[&publisher, &stranger]);
    assert_eq!(sink.handle_packet(&asserted(&mut stranger, PUBLISHER)), Ok(Delivery::Mark));
}

#[test]
fn source_that_keeps_messages_asserts_nobody() {
    for mut source in [source(Suite::Group, 0), source(Suite::Group, 3)] {
        let said = source.assert_publisher(PUBLISHER, |_| panic!("it says so"));
        assert_eq!(said, Err(sgc_endpoint::PublishError::Keeps));
    }
}
