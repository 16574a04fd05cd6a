//! Cost and savings of compression, in one thread: compressing and sealing against sealing alone, and the same at the
//! other end.
//!
//! The variants take turns, so that other work of the machine affects all of them; of each the median counts. `cargo
//! bench -p sgc-endpoint --bench compression` prints the table of `benchmarks/large-messages.md`.
#![allow(clippy::print_stdout)]

use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{
    Compressor, Decompressor, Delivery, RecoveryLimits, Sink, SinkLimits, Source, SourceConfig,
};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{
    Class, MessageHead, MessageKind, Name, Packet, PayloadEncoding, SecretBytes, SinkId, SourceId, TopicGrant,
};

const NAME: Name = Name([1; 32]);
const ROUNDS: usize = 41;

/// Returns numbers that look random and are the same each time.
struct Dice(u64);

impl Dice {
    fn roll(&mut self, below: u64) -> u64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % below
    }
}

/// An `rgb8` picture of a smooth scene with a few edges; `noise` is what a sensor adds to each byte.
fn image(noise: u64) -> Vec<u8> {
    let (width, height, mut dice) = (640, 546, Dice(1));
    let mut out = vec![0, 1, 0, 0];
    for y in 0..height {
        for x in 0..width {
            let edge = if (x / 90 + y / 70) % 2 == 0 { 40 } else { 0 };
            out.extend(
                [x / 4 + edge, y / 3 + edge, (x + y) / 8].map(|c| (c as u64 + dice.roll(noise)) as u8),
            );
        }
    }
    out
}

/// A scan of 65 536 points: x, y, z and intensity as `f32`, ranges to a millimetre.
fn points() -> Vec<u8> {
    let (mut out, mut dice) = (vec![0, 1, 0, 0], Dice(2));
    for ring in 0..64 {
        for step in 0..1024 {
            let (turn, tilt) = (step as f32 * 0.006_136, (ring as f32 - 32.0) * 0.0065);
            let wall = 4.0 + 3.0 * (turn * 2.0).sin().abs() + dice.roll(20) as f32 / 1000.0;
            let range = (wall * 1000.0).round() / 1000.0;
            let point = [range * turn.cos(), range * turn.sin(), range * tilt, (100 + dice.roll(30)) as f32];
            out.extend(point.iter().flat_map(|value| value.to_le_bytes()));
        }
    }
    out
}

/// A `std_msgs/msg/String` as programs often send it: names and numbers, again and again.
fn json(bytes: usize) -> Vec<u8> {
    let (mut out, mut dice) = (vec![0, 1, 0, 0, 0, 0, 0, 0], Dice(3));
    while out.len() < bytes {
        let (id, at) = (dice.roll(100), dice.roll(1_000_000));
        out.extend(
            format!("{{\"id\":{id},\"state\":\"moving\",\"position\":0.{at},\"battery\":{}}},", at % 97)
                .bytes(),
        );
    }
    out
}

struct Variant {
    encoding: PayloadEncoding,
    source: Source,
    sink: Sink,
    compressor: Compressor,
    decompressor: Decompressor,
    /// Bytes on the wire, and the time at each end.
    rounds: Vec<(usize, Duration, Duration)>,
}

impl Variant {
    fn new(encoding: PayloadEncoding) -> Self {
        let config = SourceConfig {
            name: NAME,
            id: SourceId([5; 16]),
            class: Class::Default,
            reliable: true,
            history_depth: 0,
            history_bytes_max: 0,
            recovery: RecoveryLimits::default(),
            receivers: None,
        };
        let (suite, key) = (Suite::Group, SecretBytes::new([3; 32]));
        let mut grant =
            TopicGrant { epoch: 1, suite: suite.id(), key, receiver: None, sources: Vec::new(), entry: None };
        let source =
            Source::new(config, &grant, MessageKey::generate(suite)).expect("the key is of the suite");
        grant.sources = vec![source.announce()];
        let sink = Sink::new(NAME, SinkId([9; 16]), grant, false, SinkLimits::default());
        let (compressor, decompressor) = (Compressor::default(), Decompressor::default());
        Self { encoding, source, sink, compressor, decompressor, rounds: Vec::new() }
    }

    #[expect(clippy::disallowed_methods, reason = "the one thing that a bench is for")]
    fn round(&mut self, payload: &Bytes) {
        let mut packets: Vec<Packet> = Vec::new();
        let begin = Instant::now();
        let packed = self.compressor.compress(self.encoding, payload);
        let encoding = if packed.is_some() { self.encoding } else { PayloadEncoding::Plain };
        let head = MessageHead { encoding, ..MessageHead::new(MessageKind::Write, 7) };
        let left = packed.unwrap_or_else(|| payload.clone());
        let bytes = left.len();
        self.source.publish(&head, left, false, |packet| packets.push(packet)).expect("it is not too large");
        let sealed = Instant::now();
        let mut whole = None;
        for packet in &packets {
            if let Ok(Delivery::Message(message)) = self.sink.handle_packet(packet) {
                whole = self.decompressor.decompress(message.head.encoding, message.payload).ok();
            }
        }
        let opened = sealed.elapsed();
        assert!(whole.as_ref() == Some(payload), "it comes back as it was");
        self.rounds.push((bytes, sealed - begin, opened));
    }

    fn line(&mut self, name: &str, payload: &Bytes) {
        let median = |mut all: Vec<Duration>| {
            all.sort_unstable();
            all[all.len() / 2].as_secs_f64() * 1e6
        };
        let bytes = self.rounds.first().map_or(0, |round| round.0);
        let there = median(self.rounds.iter().map(|round| round.1).collect());
        let back = median(self.rounds.iter().map(|round| round.2).collect());
        let share = 100.0 * bytes as f64 / payload.len() as f64;
        println!("| {name} | {:?} | {bytes} | {share:.0} % | {there:.0} | {back:.0} |", self.encoding);
        self.rounds.clear();
    }
}

fn main() {
    println!("| payload | | bytes | of plain | compress and seal, us | open and decompress, us |");
    println!("|---|---|---|---|---|---|");
    for (name, payload) in [
        ("Image 1 MB, drawn", image(1)),
        ("Image 1 MB, with noise", image(6)),
        ("PointCloud2 1 MB", points()),
        ("JSON in a String, 64 KB", json(64 << 10)),
        ("JSON in a String, 1 KB", json(1 << 10)),
    ] {
        let payload = Bytes::from(payload);
        let kinds = [PayloadEncoding::Plain, PayloadEncoding::Lz4, PayloadEncoding::Zstd];
        let mut ways = kinds.map(Variant::new);
        for _ in 0..ROUNDS {
            ways.iter_mut().for_each(|way| way.round(&payload));
        }
        ways.iter_mut().for_each(|way| way.line(name, &payload));
    }
}
