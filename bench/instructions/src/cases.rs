//! The hot functions, each repeated often enough that one repetition more or less does not show.
//!
//! A case prepares, does its work once as a warm-up, and counts. Its input is the same each time but for keys, whose
//! content does not change the path of any Rust code.

use std::future::Future;
use std::hint::black_box;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll, Waker};

use anyhow::{Context as _, Result, bail, ensure};
use bytes::{Bytes, BytesMut};
use rand_chacha::ChaCha8Rng;
use rand_core::SeedableRng as _;
use sgc_dds::payload::Frame;
use sgc_endpoint::{Delivery, Receivers, RecoveryLimits, Sink, SinkLimits, Source, SourceConfig};
use sgc_node::benchmarks::Forwarding;
use sgc_transport::benchmarks::Conversation;
use sgc_trust::{Freshness, MessageKey, ReplayWindow, Suite};
use sgc_wire::{
    Class, HOP_LIMIT, Label, MessageHead, MessageKind, Name, NodeId, Packet, PacketHeader, ReceiverKey,
    SecretBytes, SinkId, SourceId, TopicGrant,
};

use crate::Counter;
use crate::fleet::{BenchFleet, now};
use crate::frames::{BATCH, Member};
use crate::machine::Machine;

/// A counted function.
pub(crate) struct Case {
    /// The case's name, also in the file.
    pub(crate) name: &'static str,
    /// Runs the case, under callgrind.
    pub(crate) run: fn(&mut Counter) -> Result<()>,
}

/// All cases, by name.
pub(crate) const CASES: &[Case] = &[
    Case { name: "dds: frame of a sample", run: frame },
    Case { name: "endpoint: open group 100 B", run: |c| open(c, Suite::Group, 100) },
    Case { name: "endpoint: open group 1000 B", run: |c| open(c, Suite::Group, 1000) },
    Case { name: "endpoint: open group 64 KB", run: |c| open(c, Suite::Group, 64 << 10) },
    Case { name: "endpoint: open pairwise 100 B", run: |c| open(c, Suite::Pairwise, 100) },
    Case { name: "endpoint: open pairwise 1000 B", run: |c| open(c, Suite::Pairwise, 1000) },
    Case { name: "endpoint: open pairwise 64 KB", run: |c| open(c, Suite::Pairwise, 64 << 10) },
    Case { name: "endpoint: open standard 100 B", run: |c| open(c, Suite::Standard, 100) },
    Case { name: "endpoint: open standard 1000 B", run: |c| open(c, Suite::Standard, 1000) },
    Case { name: "endpoint: open standard 64 KB", run: |c| open(c, Suite::Standard, 64 << 10) },
    Case { name: "endpoint: seal group 100 B", run: |c| seal(c, Suite::Group, 100) },
    Case { name: "endpoint: seal group 1000 B", run: |c| seal(c, Suite::Group, 1000) },
    Case { name: "endpoint: seal group 64 KB", run: |c| seal(c, Suite::Group, 64 << 10) },
    Case { name: "endpoint: seal pairwise 100 B", run: |c| seal(c, Suite::Pairwise, 100) },
    Case { name: "endpoint: seal pairwise 1000 B", run: |c| seal(c, Suite::Pairwise, 1000) },
    Case { name: "endpoint: seal pairwise 64 KB", run: |c| seal(c, Suite::Pairwise, 64 << 10) },
    Case { name: "endpoint: seal standard 100 B", run: |c| seal(c, Suite::Standard, 100) },
    Case { name: "endpoint: seal standard 1000 B", run: |c| seal(c, Suite::Standard, 1000) },
    Case { name: "endpoint: seal standard 64 KB", run: |c| seal(c, Suite::Standard, 64 << 10) },
    Case { name: "node: forward to 1 of 10000 names", run: |c| forward(c, 1) },
    Case { name: "node: forward to 10 links", run: |c| forward(c, 10) },
    Case { name: "node: take from a queue", run: take },
    Case { name: "router: advertisement of 256", run: |c| advertisement(c, BATCH) },
    Case { name: "router: advertisement of one", run: |c| advertisement(c, 1) },
    Case { name: "router: request to join", run: join },
    Case { name: "transport: 1000 B in a stream", run: |c| carry(c, 1000) },
    Case { name: "transport: 64 KB in a stream", run: |c| carry(c, 64 << 10) },
    Case { name: "trust: replay window", run: replay },
    Case { name: "wire: decode by label", run: |c| decode(c, Label::new(7)) },
    Case { name: "wire: decode by name", run: |c| decode(c, None) },
    Case { name: "wire: encode by label", run: |c| encode(c, Label::new(7)) },
    Case { name: "wire: encode by name", run: |c| encode(c, None) },
];

const NAME: Name = Name([1; 32]);
const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 7);
/// Names in the tables of the data path.
const NAMES: u32 = 10_000;
/// Packets that wait in a queue, fewer than its bound.
const QUEUED: u32 = 500;

fn packet(name: Name, payload: usize) -> Packet {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: HOP_LIMIT,
        suite: Suite::Group.id(),
        epoch: 1,
        name,
        source: SourceId([2; 16]),
        seq: 1,
        total: payload as u32,
        index: 0,
        grid: 16 << 10,
        to: None,
    };
    Packet { header, payload: Bytes::from(vec![7; payload]).into() }
}

fn encode(counter: &mut Counter, label: Option<Label>) -> Result<()> {
    const TIMES: u64 = 1000;
    let packet = packet(NAME, 1000);
    let mut out = BytesMut::with_capacity(2000);
    let mut work = || {
        for _ in 0..TIMES {
            out.clear();
            black_box(&packet).header.put_as(label, &mut out);
            packet.payload.copy_into(&mut out);
            black_box(&out);
        }
    };
    work();
    counter.count(TIMES, work);
    Ok(())
}

fn decode(counter: &mut Counter, label: Option<Label>) -> Result<()> {
    const TIMES: u64 = 1000;
    let packet = packet(NAME, 1000);
    let mut bytes = BytesMut::new();
    packet.header.put_as(label, &mut bytes);
    packet.payload.copy_into(&mut bytes);
    let bytes = bytes.freeze();
    let mut decoded = 0;
    let mut work = || {
        for _ in 0..TIMES {
            let read = Packet::from_datagram_as(black_box(&bytes).clone(), |_| Some(NAME));
            decoded += u64::from(black_box(read).is_ok_and(|packet| packet.header.name == NAME));
        }
    };
    work();
    counter.count(TIMES, work);
    ensure!(decoded == 2 * TIMES, "a packet was not decoded");
    Ok(())
}

fn replay(counter: &mut Counter) -> Result<()> {
    const TIMES: u64 = 10_000;
    let mut window = ReplayWindow::default();
    let (mut seq, mut fresh) = (0, 0);
    let mut work = || {
        for _ in 0..TIMES / 2 {
            // Two packets that the network reordered.
            for next in [seq + 2, seq + 1] {
                fresh += u64::from(window.accept(black_box(next)) == Freshness::Fresh);
            }
            seq += 2;
        }
    };
    work();
    counter.count(TIMES, work);
    ensure!(fresh == 2 * TIMES, "a number was taken for one that was there before");
    Ok(())
}

fn frame(counter: &mut Counter) -> Result<()> {
    const TIMES: u64 = 1000;
    let payload = [&[0, 1, 0, 0][..], &[7; 1001]].concat();
    let mut bytes = 0;
    let mut work = || {
        for _ in 0..TIMES {
            bytes += Frame::new(black_box(&payload)).map_or(0, |frame| frame.bytes());
        }
    };
    work();
    counter.count(TIMES, work);
    ensure!(bytes == 2 * TIMES as usize * 1008, "a payload was refused");
    Ok(())
}

/// Both ends of one name.
struct Ends {
    source: Source,
    sink: Sink,
}

impl Ends {
    /// Makes the ends; in a pairwise suite with one receiver.
    fn new(suite: Suite) -> Result<Self> {
        let receiver =
            suite.is_pairwise().then(|| ReceiverKey { id: [1; 4], key: SecretBytes::new([1; 32]) });
        let receivers = Arc::<Receivers>::default();
        if let Some(receiver) = receiver.clone() {
            receivers.add(SinkId([9; 16]), NodeId([1; 32]), || receiver);
        }
        let config = SourceConfig {
            name: NAME,
            id: SourceId([5; 16]),
            class: Class::Default,
            reliable: true,
            history_depth: 0,
            history_bytes_max: 0,
            recovery: RecoveryLimits::default(),
            receivers: Some(receivers),
        };
        let key = SecretBytes::new([3; 32]);
        let mut grant =
            TopicGrant { epoch: 1, suite: suite.id(), key, receiver, sources: Vec::new(), entry: None };
        let source = Source::new(config, &grant, MessageKey::generate(suite)).context("no such suite")?;
        grant.sources = vec![source.announce()];
        let sink = Sink::new(NAME, SinkId([9; 16]), grant, false, SinkLimits::default());
        Ok(Self { source, sink })
    }

    fn seal(&mut self, payload: &Bytes, times: u64, mut emit: impl FnMut(Packet)) -> bool {
        let mut publish = || self.source.publish(&HEAD, payload.clone(), false, &mut emit);
        (0..times).all(|_| publish().is_ok())
    }
}

/// Returns the number of repetitions, which is low for signatures and many bytes, because callgrind is slow.
fn times(suite: Suite, bytes: usize) -> u64 {
    let signs = suite.is_signed() && !suite.is_pairwise();
    if signs || bytes > 10_000 { 32 } else { 500 }
}

fn seal(counter: &mut Counter, suite: Suite, bytes: usize) -> Result<()> {
    let times = times(suite, bytes);
    let mut ends = Ends::new(suite)?;
    let payload = Bytes::from(vec![0x5a; bytes]);
    let mut is_sealed = ends.seal(&payload, times, drop);
    counter.count(times, || is_sealed &= ends.seal(&payload, times, |packet| drop(black_box(packet))));
    ensure!(is_sealed, "a message was refused");
    Ok(())
}

fn open(counter: &mut Counter, suite: Suite, bytes: usize) -> Result<()> {
    let times = times(suite, bytes);
    let mut ends = Ends::new(suite)?;
    let payload = Bytes::from(vec![0x5a; bytes]);
    let mut packets = Vec::new();
    ensure!(ends.seal(&payload, 2 * times, |packet| packets.push(packet)), "a message was refused");
    let (first, second) = packets.split_at(packets.len() / 2);
    let mut delivered = 0;
    let mut open = |packets: &[Packet]| {
        for packet in packets {
            delivered += u64::from(matches!(ends.sink.handle_packet(packet), Ok(Delivery::Message(_))));
        }
    };
    open(first);
    counter.count(times, || open(black_box(second)));
    ensure!(delivered == 2 * times, "a message was not opened");
    Ok(())
}

fn name(index: u32) -> Name {
    let mut name = [0; 32];
    // Names are hashes, so their first byte is uniform.
    name[..4].copy_from_slice(&index.wrapping_mul(0x9e37_79b1).to_be_bytes());
    Name(name)
}

/// Returns the output of a future that is ready at once, or an error if it waits.
fn at_once<T>(future: impl Future<Output = T>) -> Result<T> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(value) => Ok(value),
        Poll::Pending => bail!("it waits for something"),
    }
}

fn forward(counter: &mut Counter, ways: u32) -> Result<()> {
    let forwarding = Forwarding::new((0..NAMES).map(name), ways);
    let fill = |begin: u32| -> Vec<_> { (begin..begin + QUEUED).map(|i| packet(name(i), 1000)).collect() };
    let (first, second) = (fill(0), fill(QUEUED));
    let (mut taken, mut is_well) = (0, true);
    for packet in first {
        at_once(forwarding.forward(packet))?;
    }
    for _ in 0..QUEUED {
        at_once(forwarding.take(|_| taken += 1))?;
    }
    let mut second = second.into_iter();
    counter.count(QUEUED.into(), || {
        for packet in second.by_ref() {
            is_well &= at_once(forwarding.forward(black_box(packet))).is_ok();
        }
    });
    for _ in 0..QUEUED {
        at_once(forwarding.take(|_| taken += 1))?;
    }
    ensure!(is_well && taken == 2 * QUEUED * ways, "a packet was not forwarded");
    Ok(())
}

fn take(counter: &mut Counter) -> Result<()> {
    let forwarding = Forwarding::new([NAME], 1);
    let mut taken = 0;
    for round in 0..2 {
        for _ in 0..QUEUED {
            at_once(forwarding.forward(packet(NAME, 1000)))?;
        }
        let mut work = || {
            for _ in 0..QUEUED {
                // A future that waits takes no packet, which the sum below shows.
                let _ =
                    at_once(forwarding.take(|packet| taken += u32::from(black_box(packet).header.seq == 1)));
            }
        };
        if round == 0 { work() } else { counter.count(QUEUED.into(), work) }
    }
    ensure!(taken == 2 * QUEUED, "a packet was not taken");
    Ok(())
}

fn carry(counter: &mut Counter, bytes: usize) -> Result<()> {
    const TIMES: u64 = 200;
    let mut conversation = Conversation::new(now().instant).context("no flow")?;
    let (head, payload) = (Bytes::from(vec![1; 87]), Bytes::from(vec![7; bytes]));
    let mut received = 0;
    let mut work = || {
        for _ in 0..TIMES {
            received += conversation.carry(vec![head.clone(), payload.clone()]).unwrap_or(0);
        }
    };
    work();
    counter.count(TIMES, work);
    ensure!(received == 2 * TIMES * (87 + bytes as u64), "a message did not arrive");
    Ok(())
}

/// A router, an owner and a subscriber, each on a link of its own.
struct Routing {
    machine: Machine,
    owner: Member<sgc_router::LinkId>,
    subscriber: Member<sgc_router::LinkId>,
    rng: ChaCha8Rng,
}

impl Routing {
    fn new() -> Result<Self> {
        let fleet = BenchFleet::new()?;
        let mut machine = Machine::new(&fleet.issue("router", true)?, now());
        let mut member = |node| -> Result<_> {
            let identity = fleet.issue(node, false)?;
            let link = machine.attach(identity.as_peer(), false)?;
            Ok(Member::new(identity, link))
        };
        let (owner, subscriber) = (member("owner")?, member("subscriber")?);
        Ok(Self { machine, owner, subscriber, rng: ChaCha8Rng::seed_from_u64(7) })
    }

    fn adverts(&mut self, count: usize, names: usize) -> Vec<crate::frames::Advert> {
        let now = self.machine.unix();
        (0..count).map(|_| self.owner.advert(names, now, &mut self.rng)).collect()
    }
}

fn advertisement(counter: &mut Counter, names: usize) -> Result<()> {
    const TIMES: usize = 8;
    let mut routing = Routing::new()?;
    let adverts = routing.adverts(2 * TIMES, names);
    let mut is_well = true;
    let mut feed = |adverts: &[crate::frames::Advert]| {
        for advert in adverts {
            is_well &= routing.machine.feed(routing.owner.link, &advert.bytes).is_ok();
        }
    };
    feed(&adverts[..TIMES]);
    counter.count(TIMES as u64, || feed(&adverts[TIMES..]));
    ensure!(is_well, "the router refused an advertisement");
    Ok(())
}

fn join(counter: &mut Counter) -> Result<()> {
    const TIMES: usize = 16;
    let mut routing = Routing::new()?;
    let adverts = routing.adverts(1, BATCH);
    for advert in &adverts {
        routing.machine.feed(routing.owner.link, &advert.bytes)?;
    }
    let now = routing.machine.unix();
    let names = adverts.iter().flat_map(|advert| &advert.names).take(2 * TIMES);
    let joins: Vec<_> = names.map(|name| routing.subscriber.join(*name, now, &mut routing.rng).1).collect();
    let mut passed_on = 0;
    let mut feed = |joins: &[Bytes]| {
        for join in joins {
            let fed = routing.machine.feed(routing.subscriber.link, join);
            passed_on += usize::from(fed.is_ok_and(|timed| timed.went_to(routing.owner.link)));
        }
    };
    feed(&joins[..TIMES]);
    counter.count(TIMES as u64, || feed(&joins[TIMES..]));
    ensure!(passed_on == 2 * TIMES, "a request did not get to the owner");
    Ok(())
}
