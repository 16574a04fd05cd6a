//! Cost of the suites: from a payload to sealed and signed packets, and from those to a message, in one thread.
//!
//! The suites take turns in short rounds, so that other work of the machine affects all of them; of each the median
//! round counts. `cargo bench -p sgc-endpoint` prints the tables of `benchmarks/suites.md`.
#![allow(clippy::print_stdout)]

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{Delivery, Receivers, RecoveryLimits, Sink, SinkLimits, Source, SourceConfig};
use sgc_trust::{MessageKey, RECEIVERS_MAX, Suite};
use sgc_wire::{
    Class, MessageHead, MessageKind, Name, NodeId, Packet, ReceiverKey, SecretBytes, SinkId, SourceId,
    TopicGrant,
};

const NAME: Name = Name([1; 32]);
const HEAD: MessageHead = MessageHead::new(MessageKind::Write, 7);
/// Time for which one configuration is measured, of all suites together.
const MEASURE: Duration = Duration::from_millis(1500);
const ROUNDS_MIN: usize = 5;

struct Ends {
    name: String,
    source: Source,
    sink: Sink,
    /// Times of each round, per message: sealing and opening.
    rounds: Vec<(Duration, Duration)>,
}

impl Ends {
    /// Makes the ends of a topic; of a pairwise suite with this number of known receivers, none for signatures.
    fn new(suite: Suite, key: &MessageKey, receivers: u8) -> Self {
        let name = if receivers > 0 { format!("{suite}, {receivers} MACs") } else { suite.to_string() };
        let known = Arc::<Receivers>::default();
        let receiver = |n: u8| ReceiverKey { id: [n; 4], key: SecretBytes::new([n; 32]) };
        for n in 1..=receivers {
            known.add(SinkId([n; 16]), NodeId([n; 32]), || receiver(n));
        }
        let config = SourceConfig {
            name: NAME,
            id: SourceId([5; 16]),
            class: Class::Default,
            reliable: true,
            history_depth: 0,
            history_bytes_max: 0,
            recovery: RecoveryLimits::default(),
            receivers: (receivers > 0).then_some(known),
        };
        let key_bytes = SecretBytes::new([3; 32]);
        let mut grant = TopicGrant {
            epoch: 1,
            suite: suite.id(),
            key: key_bytes,
            receiver: (receivers > 0).then(|| receiver(1)),
            sources: Vec::new(),
            entry: None,
        };
        let source = Source::new(config, &grant, key.clone()).expect("the key is of the suite");
        grant.sources = vec![source.announce()];
        let sink = Sink::new(NAME, SinkId([9; 16]), grant, false, SinkLimits::default());
        Self { name, source, sink, rounds: Vec::new() }
    }

    /// Messages of one size, `batch` at a time; about as much as fits into a few milliseconds.
    #[expect(clippy::disallowed_methods, reason = "the one thing that a bench is for")]
    fn round(&mut self, payload: &Bytes, batch: usize) {
        let batches = (2_000_000 / (payload.len() * batch + 40_000)).max(1);
        let mut packets: Vec<Packet> = Vec::new();
        let (mut sealing, mut opening, mut delivered) = (Duration::ZERO, Duration::ZERO, 0);
        for _ in 0..batches {
            let start = Instant::now();
            for n in 1..=batch {
                let emit = |packet| packets.push(packet);
                self.source.publish(&HEAD, payload.clone(), n < batch, emit).expect("it is not too large");
            }
            let sealed = Instant::now();
            for packet in &packets {
                delivered += usize::from(matches!(self.sink.handle_packet(packet), Ok(Delivery::Message(_))));
            }
            opening += sealed.elapsed();
            sealing += sealed - start;
            packets.clear();
        }
        assert_eq!(delivered, batches * batch, "{}", self.name);
        let messages = (batches * batch) as u32;
        self.rounds.push((sealing / messages, opening / messages));
    }

    fn medians(&mut self) -> (f64, f64, f64) {
        let median = |of: fn(&(Duration, Duration)) -> Duration| {
            let mut all: Vec<_> = self.rounds.iter().map(of).collect();
            all.sort_unstable();
            all[all.len() / 2].as_secs_f64() * 1e6
        };
        (median(|r| r.0), median(|r| r.1), median(|r| r.0 + r.1))
    }
}

#[expect(clippy::disallowed_methods, reason = "the one thing that a bench is for")]
fn measure(keys: &[(Suite, MessageKey)], bytes: usize, batch: usize) {
    let payload = Bytes::from(vec![0x5a; bytes]);
    let mut all: Vec<_> = keys.iter().map(|(suite, key)| Ends::new(*suite, key, 0)).collect();
    for (suite, key) in keys.iter().filter(|(suite, _)| suite.is_pairwise()) {
        all.extend([1, RECEIVERS_MAX as u8].map(|receivers| Ends::new(*suite, key, receivers)));
    }
    let start = Instant::now();
    while start.elapsed() < MEASURE || all[0].rounds.len() < ROUNDS_MIN {
        all.iter_mut().for_each(|ends| ends.round(&payload, batch));
    }
    println!("\n{bytes} bytes, {batch} at a time");
    println!("{:24} {:>12} {:>12} {:>12} {:>9}", "suite", "seal µs", "open µs", "both µs", "× group");
    let base = all[0].medians().2;
    for ends in &mut all {
        let (seal, open, both) = ends.medians();
        println!("{:24} {seal:12.2} {open:12.2} {both:12.2} {:9.2}", ends.name, both / base);
    }
}

fn main() {
    // `cargo test --benches` runs this too; there is nothing to test in it.
    if std::env::args().any(|arg| arg == "--test") {
        return;
    }
    let only: Option<usize> = std::env::args().find_map(|arg| arg.parse().ok());
    let keys = Suite::ALL.map(|suite| (suite, MessageKey::generate(suite)));
    for (bytes, batch) in [
        (1000, 1),
        (1000, 8),
        (1000, 32),
        (1000, 64),
        (100, 1),
        (100, 32),
        (64_000, 1),
        (1 << 20, 1),
        (13 << 20, 1),
    ] {
        if only.is_none_or(|n| n == bytes) {
            measure(&keys, bytes, batch);
        }
    }
}
