//! Whole QUIC connections over simulated paths, on a simulated clock: the behaviour of each controller on a path.
//! `cargo test -p sgc-transport --lib congestion -- --ignored --nocapture` prints the table of all.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use quinn_proto::{
    ClientConfig, Connection, ConnectionHandle, DatagramEvent, Dir, Endpoint, EndpointConfig, Event,
    ServerConfig, StreamEvent, StreamId, Transmit,
};
use rand_chacha::ChaCha8Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use sgc_wire::Class;

use super::*;
use crate::LinkOptions;
use crate::quic::{Flavor, transport as transport_with};

/// The path from the senders to the receivers, which share it. The way back has the delay alone.
#[derive(Clone, Copy, Debug)]
struct Path {
    bits_per_second: u64,
    queue_bytes: u64,
    one_way: Duration,
    loss: f64,
    jitter: Duration,
}

const THIN: Path = Path {
    bits_per_second: 5_000_000,
    queue_bytes: 125_000,
    one_way: Duration::from_micros(100),
    loss: 0.0,
    jitter: Duration::ZERO,
};

#[derive(Default)]
struct Pipe {
    free: Option<Instant>,
    /// Arrival of the last packet, so that the order stays.
    last: Option<Instant>,
    dropped: u64,
    carried: u64,
    /// Time in the queue of each packet, and its beginning.
    stood: Vec<(Instant, f64)>,
}

impl Pipe {
    /// Returns the arrival of a packet, unless it is lost.
    fn carry(&mut self, now: Instant, bytes: u64, path: &Path, rng: &mut ChaCha8Rng) -> Option<Instant> {
        let bytes = bytes + 28;
        let free = self.free.unwrap_or(now).max(now);
        let waits = free - now;
        let queued = waits.as_secs_f64() * path.bits_per_second as f64 / 8.0;
        if queued + bytes as f64 > path.queue_bytes as f64 {
            self.dropped += 1;
            return None;
        }
        self.carried += 1;
        self.stood.push((now, waits.as_secs_f64()));
        let sent = free + Duration::from_secs_f64(bytes as f64 * 8.0 / path.bits_per_second as f64);
        self.free = Some(sent);
        if chance(rng) < path.loss {
            self.dropped += 1;
            return None;
        }
        let arrives = sent + path.one_way + path.jitter.mul_f64(chance(rng));
        let arrives = self.last.map_or(arrives, |last| last.max(arrives));
        self.last = Some(arrives);
        Some(arrives)
    }
}

fn chance(rng: &mut ChaCha8Rng) -> f64 {
    f64::from(rng.next_u32()) / f64::from(u32::MAX)
}

struct Node {
    endpoint: Endpoint,
    connection: Option<(ConnectionHandle, Connection)>,
    peer: SocketAddr,
    /// Set at a sender.
    gate: Option<Arc<Gate>>,
    stream: Option<StreamId>,
    begins: Instant,
    /// Arrivals at a receiver: time and bytes.
    received: Vec<(Instant, u64)>,
}

/// A packet in flight: arrival, number, node and bytes.
type InFlightPacket = (Instant, u64, usize, Vec<u8>);

/// Pairs of senders and receivers.
struct World {
    epoch: Instant,
    now: Instant,
    nodes: Vec<Node>,
    path: Path,
    pipe: Pipe,
    under_way: BinaryHeap<Reverse<InFlightPacket>>,
    number: u64,
    rng: ChaCha8Rng,
}

impl World {
    /// Returns senders with these controllers, each starting at its second.
    fn new(path: Path, senders: &[(Congestion, f64)]) -> Self {
        let key = rcgen::generate_simple_self_signed(vec!["localhost".into()]).unwrap();
        let epoch = Instant::now();
        let mut nodes = Vec::new();
        for (n, (congestion, begins)) in senders.iter().enumerate() {
            let address = |last: u8| SocketAddr::from(([10, 0, n as u8, last], 7447));
            let options = LinkOptions { congestion: *congestion, ..LinkOptions::default() };
            let mut roots = rustls::RootCertStore::empty();
            roots.add(key.cert.der().clone()).unwrap();
            let lease = options.receive_budget.lease(options.receive_window_bytes);
            let (transport, _) = transport_with(Flavor::Quic, &options, &lease);
            let mut server = ServerConfig::with_single_cert(
                vec![key.cert.der().clone()],
                rustls_pki_types::PrivateKeyDer::Pkcs8(key.signing_key.serialize_der().into()),
            )
            .unwrap();
            server.transport_config(transport);
            let (transport, gate) = transport_with(Flavor::Quic, &options, &lease);
            let mut client = ClientConfig::with_root_certificates(Arc::new(roots)).unwrap();
            client.transport_config(transport);
            let config = |seed: u8| {
                let mut config = EndpointConfig::default();
                config.rng_seed(Some([seed; 32]));
                Arc::new(config)
            };
            let mut endpoint = Endpoint::new(config(2 * n as u8), None, true, None);
            let connection = endpoint.connect(epoch, client, address(2), "localhost").unwrap();
            let node = |endpoint, connection, peer, gate| Node {
                endpoint,
                connection,
                peer,
                gate,
                stream: None,
                begins: epoch + Duration::from_secs_f64(*begins),
                received: Vec::new(),
            };
            nodes.push(node(endpoint, Some(connection), address(2), Some(gate)));
            let endpoint = Endpoint::new(config(2 * n as u8 + 1), Some(Arc::new(server)), true, None);
            nodes.push(node(endpoint, None, address(1), None));
        }
        let rng = ChaCha8Rng::seed_from_u64(7);
        let (pipe, under_way) = (Pipe::default(), BinaryHeap::new());
        let mut world = Self { epoch, now: epoch, nodes, path, pipe, under_way, number: 0, rng };
        (0..world.nodes.len()).for_each(|n| world.pump(n));
        world
    }

    fn run_until(&mut self, seconds: f64) {
        let end = self.epoch + Duration::from_secs_f64(seconds);
        loop {
            let arrival = self.under_way.peek().map(|p| p.0.0);
            let timers = self.nodes.iter_mut().filter_map(|n| {
                let timer = n.connection.as_mut().and_then(|(_, c)| c.poll_timeout());
                let begins = (n.gate.is_some() && n.begins > self.now).then_some(n.begins);
                timer.into_iter().chain(begins).min()
            });
            let next = timers.chain(arrival).min();
            match next {
                Some(next) if next <= end => self.now = self.now.max(next),
                _ => break,
            }
            while self.under_way.peek().is_some_and(|p| p.0.0 <= self.now) {
                let Some(Reverse((_, _, to, bytes))) = self.under_way.pop() else { break };
                self.deliver(to, &bytes);
                self.pump(to);
            }
            for n in 0..self.nodes.len() {
                let now = self.now;
                let Some((_, connection)) = &mut self.nodes[n].connection else { continue };
                if connection.poll_timeout().is_some_and(|t| t <= now) {
                    connection.handle_timeout(now);
                    self.pump(n);
                } else if self.nodes[n].begins == now {
                    self.pump(n);
                }
            }
        }
        self.now = end;
    }

    fn deliver(&mut self, to: usize, bytes: &[u8]) {
        let node = &mut self.nodes[to];
        let mut answer = Vec::new();
        let event = node.endpoint.handle(self.now, node.peer, None, None, BytesMut::from(bytes), &mut answer);
        match event {
            Some(DatagramEvent::NewConnection(incoming)) => {
                node.connection =
                    Some(node.endpoint.accept(incoming, self.now, &mut answer, None).ok().unwrap());
            }
            Some(DatagramEvent::ConnectionEvent(_, event)) => {
                if let Some((_, connection)) = &mut node.connection {
                    connection.handle_event(event);
                }
            }
            Some(DatagramEvent::Response(_)) | None => {}
        }
    }

    fn pump(&mut self, n: usize) {
        loop {
            let Some((handle, mut connection)) = self.nodes[n].connection.take() else { return };
            self.exchange(n, &mut connection);
            let mut buffer = Vec::new();
            let mut has_sent = false;
            while let Some(transmit) = connection.poll_transmit(self.now, 10, &mut buffer) {
                self.send(n, &transmit, &buffer);
                buffer.clear();
                has_sent = true;
            }
            while let Some(event) = connection.poll_endpoint_events() {
                if let Some(event) = self.nodes[n].endpoint.handle_event(handle, event) {
                    connection.handle_event(event);
                }
            }
            self.nodes[n].connection = Some((handle, connection));
            if !has_sent {
                return;
            }
        }
    }

    fn send(&mut self, n: usize, transmit: &Transmit, buffer: &[u8]) {
        for packet in buffer[..transmit.size].chunks(transmit.segment_size.unwrap_or(transmit.size)) {
            let arrives = match n % 2 {
                0 => self.pipe.carry(self.now, packet.len() as u64, &self.path, &mut self.rng),
                _ => Some(self.now + self.path.one_way),
            };
            if let Some(arrives) = arrives {
                self.number += 1;
                self.under_way.push(Reverse((arrives, self.number, n ^ 1, packet.to_vec())));
            }
        }
    }

    /// Runs the two applications: one writes as much as it may, the other reads everything.
    fn exchange(&mut self, n: usize, connection: &mut Connection) {
        let (now, node) = (self.now, &mut self.nodes[n]);
        let mut readable = Vec::new();
        while let Some(event) = connection.poll() {
            match event {
                Event::Stream(StreamEvent::Opened { dir: Dir::Uni }) => {
                    while let Some(id) = connection.streams().accept(Dir::Uni) {
                        node.stream = Some(id);
                        readable.push(id);
                    }
                }
                Event::Stream(StreamEvent::Readable { id }) => readable.push(id),
                Event::ConnectionLost { reason } => panic!("{reason}"),
                _ => {}
            }
        }
        for id in readable {
            let mut bytes = 0;
            let mut stream = connection.recv_stream(id);
            if let Ok(mut chunks) = stream.read(true) {
                while let Ok(Some(chunk)) = chunks.next(usize::MAX) {
                    bytes += chunk.bytes.len() as u64;
                }
                let _ = chunks.finalize();
            }
            node.received.push((now, bytes));
        }
        let Some(gate) = &node.gate else { return };
        if connection.is_handshaking() || now < node.begins {
            return;
        }
        if node.stream.is_none() {
            node.stream = connection.streams().open(Dir::Uni);
        }
        let Some(id) = node.stream else { return };
        while let Some(permit) = gate.try_admit(Class::Bulk, 64 << 10) {
            let piece = Bytes::from(vec![0; permit.bytes()]);
            match connection.send_stream(id).write_chunks(&mut [piece]) {
                Ok(written) => permit.written(written.bytes),
                Err(_) => break,
            }
        }
    }

    /// Returns the bits a second that a sender's receiver got between two times.
    fn rate(&self, sender: usize, from: f64, to: f64) -> f64 {
        let span = self.epoch + Duration::from_secs_f64(from)..self.epoch + Duration::from_secs_f64(to);
        let got = &self.nodes[2 * sender + 1].received;
        let bytes: u64 = got.iter().filter(|(at, _)| span.contains(at)).map(|(_, n)| n).sum();
        bytes as f64 * 8.0 / (to - from)
    }

    /// Returns the part of the path that the sender used between two times.
    fn used(&self, sender: usize, from: f64, to: f64) -> f64 {
        self.rate(sender, from, to) / self.path.bits_per_second as f64
    }

    /// Returns the median and 99th percentile of the time in the queue between two times, ms.
    fn queue(&self, from: f64, to: f64) -> (f64, f64) {
        let span = self.epoch + Duration::from_secs_f64(from)..self.epoch + Duration::from_secs_f64(to);
        let mut stood: Vec<_> =
            self.pipe.stood.iter().filter(|(at, _)| span.contains(at)).map(|(_, s)| s * 1e3).collect();
        stood.sort_by(f64::total_cmp);
        let at = |part: f64| stood.get((stood.len() as f64 * part) as usize).copied().unwrap_or_default();
        (at(0.5), at(0.99))
    }

    /// Returns the part of all packets that was lost.
    fn lost(&self) -> f64 {
        self.pipe.dropped as f64 / (self.pipe.carried + self.pipe.dropped).max(1) as f64
    }

    /// Returns the time from this second until half a second uses this part of the path.
    fn recovery(&self, sender: usize, from: f64, part: f64) -> Option<f64> {
        let steps = (0..400).map(|n| f64::from(n) * 0.05);
        steps.into_iter().find(|t| self.used(sender, from + t, from + t + 0.5) >= part)
    }
}

fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn mbit(bits_per_second: f64, queue: Duration, one_way: u64) -> Path {
    let queue_bytes = (bits_per_second * 1e6 / 8.0 * queue.as_secs_f64()) as u64;
    Path { bits_per_second: (bits_per_second * 1e6) as u64, queue_bytes, one_way: ms(one_way), ..THIN }
}

/// Returns the paths of the table, by name.
fn paths() -> Vec<(&'static str, Path)> {
    let lossy = |loss| Path { loss, ..mbit(20.0, ms(200), 20) };
    vec![
        ("5 Mbit/s, 200 ms queue", THIN),
        ("the same, 40 ms one way", Path { one_way: ms(40), ..THIN }),
        ("20 Mbit/s, 20 ms one way, 1 % loss", lossy(0.01)),
        ("the same, 2 %", lossy(0.02)),
        ("the same, 5 %", lossy(0.05)),
        ("the same, 10 %", lossy(0.1)),
        (
            "20 Mbit/s, 20 ms one way, queue of 5 packets",
            Path { queue_bytes: 7500, ..mbit(20.0, ms(200), 20) },
        ),
        ("the same, 10 packets", Path { queue_bytes: 15_000, ..mbit(20.0, ms(200), 20) }),
        ("20 Mbit/s, 150 ms one way", mbit(20.0, ms(200), 150)),
        ("5 Mbit/s, 40 ms one way, 30 ms of jitter", Path { one_way: ms(40), jitter: ms(30), ..THIN }),
        ("100 Mbit/s, 10 ms one way", mbit(100.0, ms(100), 10)),
    ]
}

#[test]
#[ignore = "prints the tables of benchmarks/congestion.md"]
fn table() {
    println!("| path | controller | used | queue p50, ms | p99 | lost |\n|---|---|---|---|---|---|");
    for (name, path) in paths() {
        for congestion in [Congestion::Delay, Congestion::Cubic, Congestion::Bbr] {
            let mut world = World::new(path, &[(congestion, 0.0)]);
            world.run_until(30.0);
            let (p50, p99) = world.queue(2.0, 30.0);
            let (used, lost) = (100.0 * world.used(0, 2.0, 30.0), 100.0 * world.lost());
            println!("| {name} | {congestion} | {used:.0} % | {p50:.1} | {p99:.1} | {lost:.1} % |");
        }
    }
    println!(
        "\n| what changes | controller | used before | after | reached after s | queue p99, ms |\n|---|---|---|---|---|---|"
    );
    type PathChange = fn(&mut Path);
    let changes: [(&str, Path, PathChange); 4] = [
        ("5 to 1 Mbit/s", Path { one_way: ms(20), ..THIN }, |p| p.bits_per_second = 1_000_000),
        ("1 to 20 Mbit/s", Path { bits_per_second: 1_000_000, one_way: ms(20), ..THIN }, |p| {
            p.bits_per_second = 20_000_000
        }),
        ("20 to 80 ms one way", Path { one_way: ms(20), ..THIN }, |p| p.one_way = ms(80)),
        ("80 to 20 ms one way", Path { one_way: ms(80), ..THIN }, |p| p.one_way = ms(20)),
    ];
    for (name, path, change) in changes {
        for congestion in [Congestion::Delay, Congestion::Cubic, Congestion::Bbr] {
            let mut world = World::new(path, &[(congestion, 0.0)]);
            world.run_until(10.0);
            let before = 100.0 * world.used(0, 2.0, 10.0);
            change(&mut world.path);
            world.run_until(35.0);
            let (_, p99) = world.queue(15.0, 35.0);
            let after = 100.0 * world.used(0, 15.0, 35.0);
            let reached = world.recovery(0, 10.0, 0.8).map_or("never".into(), |s| format!("{s:.1}"));
            println!("| {name} | {congestion} | {before:.0} % | {after:.0} % | {reached} | {p99:.0} |");
        }
    }
    println!("\n| two flows | first, second: used, 20 to 60 s | queue p50, ms | p99 |\n|---|---|---|---|");
    let pairs = [
        (Congestion::Delay, Congestion::Delay),
        (Congestion::Delay, Congestion::Cubic),
        (Congestion::Cubic, Congestion::Delay),
        (Congestion::Cubic, Congestion::Cubic),
        (Congestion::Bbr, Congestion::Cubic),
    ];
    for path in [
        Path { one_way: ms(20), ..THIN },
        mbit(20.0, ms(100), 20),
        Path { queue_bytes: 25_000, ..mbit(20.0, ms(100), 20) },
    ] {
        for (first, second) in pairs {
            let mut world = World::new(path, &[(first, 0.0), (second, 5.0)]);
            world.run_until(60.0);
            let (p50, p99) = world.queue(20.0, 60.0);
            let [a, b] = [0, 1].map(|n| 100.0 * world.used(n, 20.0, 60.0));
            println!(
                "| {} Mbit/s: {first}, {second} | {a:.0} %, {b:.0} % | {p50:.0} | {p99:.0} |",
                path.bits_per_second / 1_000_000
            );
        }
    }
}

/// Runs one flow for this many seconds.
fn alone(path: Path, congestion: Congestion, seconds: f64) -> World {
    let mut world = World::new(path, &[(congestion, 0.0)]);
    world.run_until(seconds);
    world
}

#[test]
fn a_thin_link_is_used_and_its_queue_stays_short() {
    for one_way in [0, 40] {
        let path = Path { one_way: ms(one_way), ..THIN };
        let world = alone(path, Congestion::Delay, 15.0);
        let (p50, p99) = world.queue(2.0, 15.0);
        assert!(world.used(0, 2.0, 15.0) > 0.9, "{:.2}", world.used(0, 2.0, 15.0));
        assert!(p50 < 22.0 && p99 < 40.0, "{p50:.1} {p99:.1}");
        // The reference fills the queue.
        assert!(alone(path, Congestion::Cubic, 15.0).queue(2.0, 15.0).0 > 4.0 * p50);
    }
}

#[test]
fn loss_at_random_costs_little_more_than_what_is_lost() {
    for loss in [0.01, 0.02, 0.05, 0.1] {
        let world = alone(Path { loss, ..mbit(20.0, ms(200), 20) }, Congestion::Delay, 15.0);
        let least = 0.9 - 3.0 * loss;
        assert!(world.used(0, 2.0, 15.0) > least, "{loss}: {:.2}", world.used(0, 2.0, 15.0));
    }
}

#[test]
fn a_path_that_changes_is_used_again_soon() {
    let start = Path { one_way: ms(20), ..THIN };
    let thin = Path { bits_per_second: 1_000_000, ..start };
    let changes = [(start, thin), (thin, Path { bits_per_second: 20_000_000, ..start })];
    let longer = (start, Path { one_way: ms(80), ..start });
    for (before, after) in changes.into_iter().chain([longer, (longer.1, longer.0)]) {
        let mut world = World::new(before, &[(Congestion::Delay, 0.0)]);
        world.run_until(10.0);
        world.path = after;
        world.run_until(25.0);
        let reached = world.recovery(0, 10.0, 0.8);
        assert!(reached.is_some_and(|s| s < 5.0), "{after:?}: {reached:?}");
        assert!(world.queue(16.0, 25.0).0 < 60.0, "{after:?}: {:?}", world.queue(16.0, 25.0));
    }
}

/// Wherever a cut of the window is when it happens.
#[test]
fn queue_of_a_path_that_becomes_narrower_is_short_again_soon() {
    for one_way in [10, 16, 22, 28, 34] {
        let before = Path { one_way: ms(one_way), ..THIN };
        let mut world = World::new(before, &[(Congestion::Delay, 0.0)]);
        world.run_until(10.0);
        world.path.bits_per_second = 1_000_000;
        world.run_until(25.0);
        let (p50, _) = world.queue(16.0, 25.0);
        assert!(p50 < 40.0, "{one_way} ms: {p50:.0} ms");
        assert!(world.used(0, 16.0, 25.0) > 0.85, "{one_way} ms: {:.2}", world.used(0, 16.0, 25.0));
    }
}

#[test]
fn two_share_a_path_and_none_starves() {
    for (first, second, least) in [
        (Congestion::Delay, Congestion::Delay, 0.15),
        (Congestion::Delay, Congestion::Cubic, 0.05),
        (Congestion::Cubic, Congestion::Delay, 0.05),
    ] {
        let path = Path { one_way: ms(20), ..THIN };
        let mut world = World::new(path, &[(first, 0.0), (second, 5.0)]);
        world.run_until(45.0);
        let shares = [0, 1].map(|n| world.used(n, 15.0, 45.0));
        assert!(shares.iter().all(|s| *s > least), "{first}, {second}: {shares:?}");
        assert!(shares.iter().sum::<f64>() > 0.85, "{first}, {second}: {shares:?}");
    }
}

#[test]
fn jitter_is_not_taken_for_a_queue() {
    let world = alone(Path { one_way: ms(40), jitter: ms(30), ..THIN }, Congestion::Delay, 20.0);
    assert!(world.used(0, 3.0, 20.0) > 0.6, "{:.2}", world.used(0, 3.0, 20.0));
}
