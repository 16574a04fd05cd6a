//! Samples, sources and shares that the tests of several stages use.

use std::collections::HashMap;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_cdr::{Layout, Library, TypeName};
use sgc_endpoint::{RecoveryLimits, Source, SourceConfig};
use sgc_ros::{Guid, Sample, SampleKind};
use sgc_router::{FibEntry, LinkId, Tree};
use sgc_sync::lock;
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{Class, HOP_LIMIT, Name, Packet, PacketHeader, SecretBytes, SinkId, SourceId, TopicGrant};
use tokio::sync::mpsc;

use crate::data::dataplane::{DataPlane, Forward, Out};
use crate::data::outflow::OutFlow;
use crate::data::sending::share::LocalShare;
use crate::data::sending::source_map::{SourceMap, SourceSlot};

/// The name of every topic here.
pub(crate) const NAME: Name = Name([1; 32]);
/// A writer with a source.
pub(crate) const KNOWN: Guid = Guid([1; 16]);
/// A writer without a source.
pub(crate) const STRANGER: Guid = Guid([2; 16]);

/// A sink behind the link of [`add_link`].
pub(crate) const SINK: SinkId = SinkId([5; 16]);

/// Creates a sample of eight bytes.
pub(crate) fn sample(writer: Guid, more: bool) -> Sample {
    let payload = Bytes::from_static(b"\0\x01\0\0data");
    let (kind, writer) = (SampleKind::Write, Some(writer));
    Sample { kind, writer, source_timestamp_ns: 0, key_hash: None, payload, more }
}

/// Creates the grant of an epoch.
pub(crate) fn grant(epoch: u32) -> TopicGrant {
    let key = SecretBytes::new([epoch as u8; 32]);
    TopicGrant { epoch, suite: Suite::Standard.id(), key, receiver: None, sources: Vec::new(), entry: None }
}

fn new_source(id: u8, history_depth: usize, recovery: RecoveryLimits) -> Source {
    let config = SourceConfig {
        name: NAME,
        id: SourceId([id; 16]),
        class: Class::Default,
        reliable: true,
        history_depth,
        history_bytes_max: 1000,
        recovery,
        receivers: None,
    };
    Source::new(config, &grant(1), MessageKey::generate(Suite::Standard)).unwrap()
}

/// Creates a reliable source that keeps a history.
pub(crate) fn slot_with_id(id: u8) -> SourceSlot {
    SourceSlot::new(new_source(id, 10, RecoveryLimits::default()), true, true)
}

/// Creates a reliable source that keeps nothing, and therefore may address single sinks.
pub(crate) fn addressed_slot() -> SourceSlot {
    SourceSlot::new(new_source(9, 0, RecoveryLimits::NONE), false, true)
}

/// Creates a map with a source for [`KNOWN`]. Samples of other writers wait until their writer is listed.
pub(crate) fn map_of(slot: SourceSlot) -> SourceMap {
    SourceMap { per_writer: true, own: HashMap::from([(KNOWN, slot)]), ..SourceMap::default() }
}

/// Creates a share with the map [`map_of`] a new source. An epoch has two messages.
pub(crate) fn share() -> (Arc<DataPlane>, Arc<LocalShare>, SourceSlot) {
    let (alive, _) = mpsc::channel(1);
    let data = Arc::<DataPlane>::default();
    let share = Arc::new(LocalShare::new(NAME, data.clone(), alive, Arc::new(2.into()), Arc::default()));
    let slot = slot_with_id(1);
    share.set_map(map_of(slot.clone()));
    (data, share, slot)
}

/// Gives the name a tree without a link, so that messages are sealed.
pub(crate) fn add_tree(data: &DataPlane) {
    let nowhere = FibEntry { trees: [].as_slice().into(), sinks: vec![] };
    data.set(NAME, Some(Forward::new(nowhere, vec![], Arc::default())));
}

/// Adds a link that wants the packets of the name. Only [`queued`] empties its queue.
pub(crate) fn add_link(data: &DataPlane) -> Arc<OutFlow> {
    let (link, flow) = (LinkId(1), OutFlow::idle());
    let down = [link].as_slice().into();
    let tree = Tree { up: LinkId::LOCAL, down, publishers: [].as_slice().into() };
    let entry = FibEntry { trees: [tree].into(), sinks: vec![(SINK, link)] };
    let outs = vec![(link, Out::Link(flow.clone(), Arc::default()))];
    data.set(NAME, Some(Forward::new(entry, outs, Arc::default())));
    flow
}

/// Removes the oldest packet of a link's queue, if there is one.
pub(crate) fn queued(flow: &OutFlow) -> Option<Packet> {
    match pin!(flow.queued()).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(packet) => Some(packet),
        Poll::Pending => None,
    }
}

/// Creates a packet of one message.
pub(crate) fn packet(seq: u64) -> Packet {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: HOP_LIMIT,
        suite: Suite::Standard.id(),
        epoch: 1,
        name: NAME,
        source: SourceId([1; 16]),
        seq,
        total: 4,
        index: 0,
        grid: 16_384,
        to: None,
    };
    Packet { header, payload: Bytes::from_static(b"data").into() }
}

/// Returns the number of packets that waited for a signature.
pub(crate) fn unflushed(slot: &SourceSlot) -> usize {
    let mut packets = 0;
    lock(&slot.source).flush(|_| packets += 1);
    packets
}

/// Waits until `is_so`, with a bound.
pub(crate) fn wait_until(is_so: impl Fn() -> bool) {
    let end = Instant::now() + Duration::from_secs(30);
    while !is_so() {
        assert!(Instant::now() < end, "it does not come");
        std::thread::yield_now();
    }
}

/// Returns a type with one string, and a message of it.
pub(crate) fn text_type() -> (Arc<Layout>, Bytes) {
    let mut text = |_: &TypeName| Some("string a".to_owned());
    let layout = Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut text).unwrap();
    let message = layout.encode(&layout.from_json(br#"{"a":"text"}"#).unwrap()).unwrap();
    (Arc::new(layout), message.into())
}
