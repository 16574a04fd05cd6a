//! Allocations of the data path in steady state: none in a router, less than one per message in a proxy, and one more
//! per signature. `sgc-transport` and `sgc-dds` count the allocations of transports and DDS.

use std::collections::HashMap;
use std::pin::pin;
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::task::{Context, Poll, Waker};

use bytes::Bytes;
use sgc_endpoint::{Receivers, RecoveryLimits, Source, SourceConfig};
use sgc_ros::{Guid, Sample, SampleKind, Shaping};
use sgc_router::{FibEntry, LinkId, Tree};
use sgc_testkit::{CountingAllocator, allocated_since_last, allocations};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{
    Class, HOP_LIMIT, MessageHead, MessageKind, Name, NodeId, Packet, PacketHeader, Payload, ReceiverKey,
    SecretBytes, SinkId, SourceId, TopicGrant,
};
use tokio::runtime::{Builder, Runtime};
use tokio::sync::mpsc;

use crate::data::dataplane::{DataPlane, Forward, Out};
use crate::data::outflow::OutFlow;
use crate::data::sending::share::LocalShare;
use crate::data::sending::source_map::{SourceMap, SourceSlot};
use crate::data::sinks::LocalSink;
use crate::data::writer_queue::{WriterContext, WriterInfo, WriterQueue, start_workers};

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

const NAME: Name = Name([1; 32]);
const WRITER: Guid = Guid([3; 16]);
const MESSAGES: usize = 1000;
const MESSAGE_BYTES: usize = 1000;
/// Messages during which containers grow to their size.
const WARM_UP: usize = 2 * MESSAGES;

/// Polls a future that is ready at once, since a runtime would allocate too.
fn now<T>(future: impl Future<Output = T>) -> T {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(result) => result,
        Poll::Pending => panic!("it waits"),
    }
}

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().expect("a runtime")
}

/// Adds a name that is forwarded from one link to others.
fn forwards(data: &DataPlane, up: LinkId, outs: Vec<(LinkId, Out)>) {
    let down: Vec<_> = outs.iter().map(|(link, _)| *link).collect();
    let tree = Tree { up, down: down.into(), publishers: [].as_slice().into() };
    let entry = FibEntry { trees: [tree].into(), sinks: vec![] };
    data.set(NAME, Some(Forward::new(entry, outs, Arc::default())));
}

/// Returns a source and its announcement; in a pairwise suite with the grant of its one receiver.
fn source(suite: Suite) -> (Source, TopicGrant) {
    let key = SecretBytes::new([7; 32]);
    let receiver = suite.is_pairwise().then(|| ReceiverKey { id: [1; 4], key: SecretBytes::new([1; 32]) });
    let receivers = Arc::<Receivers>::default();
    if let Some(receiver) = receiver.clone() {
        receivers.add(SinkId([1; 16]), NodeId([1; 32]), || receiver);
    }
    let mut grant =
        TopicGrant { epoch: 1, suite: suite.id(), key, receiver, sources: Vec::new(), entry: None };
    let config = SourceConfig {
        name: NAME,
        id: SourceId([1; 16]),
        class: Class::Default,
        reliable: true,
        history_depth: 0,
        history_bytes_max: 0,
        // The limit is reached before counting begins, so that the history has grown to its size.
        recovery: RecoveryLimits { messages_max: MESSAGES, ..RecoveryLimits::default() },
        receivers: Some(receivers),
    };
    let source = Source::new(config, &grant, MessageKey::generate(suite)).expect("a key of the suite");
    grant.sources.push(source.announce());
    (source, grant)
}

#[test]
fn a_router_allocates_nothing_for_a_packet() {
    let [up, near, far] = [1, 2, 3].map(LinkId);
    for reliable in [true, false] {
        let outs = [near, far].map(|link| (link, OutFlow::idle()));
        let data = DataPlane::default();
        let ways = outs.iter().map(|(link, flow)| (*link, Out::Link(flow.clone(), Arc::default())));
        forwards(&data, up, ways.collect());
        // A transport hands out parts of its receive buffers, such as this one in two pieces.
        let received = Bytes::from(vec![7; 2 * MESSAGE_BYTES]);
        let packet = |seq| {
            let header = PacketHeader {
                reliable,
                class: Class::Default,
                hops: HOP_LIMIT,
                suite: 1,
                epoch: 1,
                name: NAME,
                source: SourceId([2; 16]),
                seq,
                total: MESSAGE_BYTES as u32,
                index: 0,
                grid: 16_384,
                to: None,
            };
            let pieces = [received.slice(..600), received.slice(600..MESSAGE_BYTES)];
            Packet { header, payload: Payload(pieces.into()) }
        };
        let pass_on = |seqs: std::ops::Range<u64>| {
            for seq in seqs {
                now(data.forward(up, packet(seq)));
                for (_, flow) in &outs {
                    assert_eq!(now(flow.queued()).header.seq, seq);
                }
            }
        };
        pass_on(1..10);
        let (taken, ()) = allocations(|| pass_on(10..10 + MESSAGES as u64));
        assert_eq!(taken.count, 0, "reliable: {reliable}");
    }
}

#[test]
fn a_proxy_allocates_less_than_once_for_a_sample_that_it_shares() {
    let runtime = runtime();
    let _inside = runtime.enter();
    // Number of messages that are ready together. A single one needs a signature of its own, for which the provider
    // allocates.
    for (suite, at_once, most) in [
        (Suite::Group, 1, 0.5),
        (Suite::Pairwise, 1, 0.5),
        (Suite::Standard, 1, 1.0),
        (Suite::Standard, 20, 0.5),
    ] {
        let (data, flow) = (Arc::<DataPlane>::default(), OutFlow::idle());
        forwards(&data, LinkId::LOCAL, vec![(LinkId(1), Out::Link(flow.clone(), Arc::default()))]);
        let (alive, _) = mpsc::channel(1);
        let share = Arc::new(LocalShare::new(NAME, data, alive, Arc::new(u64::MAX.into()), Arc::default()));
        let slot = SourceSlot::new(source(suite).0, false, true);
        let own = HashMap::from([(WRITER, slot)]);
        share.set_map(SourceMap { per_writer: true, own, ..SourceMap::default() });
        let payload = Bytes::from(vec![7; MESSAGE_BYTES]);
        // The payload is shared from the beginning, as samples of a DDS reader are.
        let _other = payload.clone();
        let publish = |messages: usize| {
            for n in 1..=messages {
                let (payload, more) = (payload.clone(), n % at_once != 0);
                let kind = SampleKind::Write;
                let (writer, source_timestamp_ns, key_hash) = (Some(WRITER), 0, None);
                share.publish(Sample { kind, writer, source_timestamp_ns, key_hash, payload, more });
                if !more {
                    for _ in 0..at_once {
                        now(flow.queued());
                    }
                }
            }
        };
        publish(WARM_UP);
        let (taken, ()) = allocations(|| publish(MESSAGES));
        let each = taken.count as f64 / MESSAGES as f64;
        assert!(each <= most, "{suite}, {at_once} at once: {each} allocations a message");
    }
}

#[test]
fn a_proxy_allocates_less_than_once_for_a_message_that_it_brings() {
    let runtime = runtime();
    let _inside = runtime.enter();
    for (suite, at_once, most) in [
        (Suite::Group, 1, 0.5),
        (Suite::Pairwise, 1, 0.5),
        (Suite::Standard, 1, 0.5),
        (Suite::Standard, 20, 0.5),
    ] {
        let (mut source, grant) = source(suite);
        let (requests, _requested) = mpsc::channel(1);
        let sink = Arc::new(LocalSink::new(NAME, false, requests, Arc::default()));
        let data = Arc::<DataPlane>::default();
        sink.grant(SinkId([9; 16]), grant, &data);
        let (alive, _) = mpsc::channel(1);
        let (tell, told) = channel();
        let take = move |message: sgc_endpoint::Message, _| {
            drop(message);
            // More than one thread may write.
            let _ = tell.send(allocated_since_last().count);
        };
        let context = WriterContext::new(start_workers().expect("a thread"), Arc::default(), alive);
        let queue = WriterQueue::new(context, WriterInfo::default(), Shaping::default(), take);
        sink.set_writer(None, Some(queue), &data);
        forwards(&data, LinkId(1), vec![(LinkId::LOCAL, Out::Local(sink.clone()))]);
        let head = MessageHead::new(MessageKind::Write, 0);
        let payload = Bytes::from(vec![7; MESSAGE_BYTES]);
        let mut packets = Vec::new();
        for n in 1..=WARM_UP + MESSAGES {
            source
                .publish(&head, payload.clone(), n % at_once != 0, |packet| packets.push(packet))
                .expect("it can be published");
        }
        let counted = packets.split_off(WARM_UP);
        // Messages are written one by one, so that queueing plays no part.
        let mut by_writer = Vec::with_capacity(MESSAGES);
        let bring = |packets: Vec<Packet>, by_writer: &mut Vec<usize>| {
            for packet in packets {
                now(data.forward(LinkId(1), packet));
                by_writer.push(told.recv().expect("its writer has it"));
            }
        };
        bring(packets, &mut Vec::with_capacity(WARM_UP));
        let (taken, ()) = allocations(|| bring(counted, &mut by_writer));
        let each = taken.count as f64 / MESSAGES as f64;
        assert!(each <= most, "{suite}, {at_once} at once: {each} allocations a message");
        let writers: usize = by_writer.iter().skip(1).sum();
        // These allocations belong to this test's channel.
        assert!(writers <= MESSAGES / 16, "{suite}: {writers} at the writer");
        assert_eq!(sink.delivered() as usize, WARM_UP + MESSAGES);
        sink.close();
    }
}
