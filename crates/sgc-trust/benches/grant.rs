//! Cost of a grant, by kind of reply key: `cargo bench -p sgc-trust --bench grant`.
//!
//! Median and 99th percentile of single operations; it compares machines and versions, not implementations.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    reason = "a bench measures and prints"
)]

use std::hint::black_box;
use std::time::{Duration, Instant};

use sgc_trust::{Kem, ReplyKey, seal_grant};
use sgc_wire::{GrantContent, Name, SecretBytes, SinkId, TopicGrant};

const ROUNDS: usize = 5_000;

fn main() {
    let (name, sink) = (Name([1; 32]), SinkId([2; 16]));
    let content = GrantContent::Topic(TopicGrant {
        epoch: 1,
        suite: 1,
        key: SecretBytes::new([9; 32]),
        receiver: None,
        sources: Vec::new(),
        entry: None,
    });
    println!("{:<28}{:>10}{:>10}", "µs", "median", "p99");
    for kem in [Kem::X25519, Kem::XWing] {
        let key = ReplyKey::generate(kem);
        let (enc, sealed) = seal_grant(key.public(), &name, &sink, 1, &content).unwrap();
        row(&format!("{kem:?} reply key"), || drop(black_box(ReplyKey::generate(kem))));
        row(&format!("{kem:?} seal"), || {
            black_box(seal_grant(key.public(), &name, &sink, 1, &content)).unwrap();
        });
        row(&format!("{kem:?} open"), || {
            black_box(key.open(&name, &sink, 1, &enc, &sealed)).unwrap();
        });
        println!("  reply key {} bytes, answer {} bytes", key.public().len(), enc.len() + sealed.len());
    }
}

fn row(what: &str, mut operation: impl FnMut()) {
    let mut times: Vec<Duration> = (0..ROUNDS)
        .map(|_| {
            let start = Instant::now();
            operation();
            start.elapsed()
        })
        .collect();
    times.sort_unstable();
    let micros = |i: usize| times[i].as_secs_f64() * 1e6;
    println!("{what:<28}{:>10.1}{:>10.1}", micros(ROUNDS / 2), micros(ROUNDS * 99 / 100));
}
