//! Cost of making a link, by key exchange: `cargo bench -p sgc-transport --bench handshake`.
//!
//! Over loopback, both ends in one process: from the call until the greetings are exchanged, both certificates (P-256)
//! verified. Bytes are those of UDP payloads, padding included.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    reason = "a bench measures and prints"
)]

mod support;

use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_transport::{CloseReason, Dialer, Link as _, LinkOptions, Listener};
use sgc_trust::Identity;

const ROUNDS: usize = 500;

fn main() {
    let (router, arm) = support::identities();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    println!("{:<36}{:>10}{:>10}{:>10}{:>10}", "", "median ms", "p99 ms", "sent B", "received B");
    for (what, dials, listens) in [
        ("X25519", false, false),
        ("X25519MLKEM768, both require it", true, true),
        ("X25519MLKEM768, the listener does", false, true),
    ] {
        let (times, sent, received) = runtime.block_on(measure(&router, &arm, dials, listens));
        let ms = |i: usize| times[i].as_secs_f64() * 1e3;
        println!("{what:<36}{:>10.2}{:>10.2}{sent:>10}{received:>10}", ms(ROUNDS / 2), ms(ROUNDS * 99 / 100));
    }
}

async fn measure(
    router: &Arc<Identity>,
    arm: &Arc<Identity>,
    dials: bool,
    listens: bool,
) -> (Vec<Duration>, u64, u64) {
    let options = |post_quantum| LinkOptions { post_quantum, ..LinkOptions::default() };
    let addr = "quic://127.0.0.1:0".parse().unwrap();
    let mut listener = Listener::bind(&addr, Arc::clone(router), options(listens), Arc::default()).unwrap();
    let url = listener.local().to_string().parse().unwrap();
    let dialer = Dialer::new(Arc::clone(arm), options(dials), Arc::default());
    tokio::spawn(async move {
        while let Some(link) = listener.accept().await {
            let link = link.unwrap();
            tokio::spawn(async move { link.closed().await });
        }
    });
    let (mut times, mut bytes) = (Vec::with_capacity(ROUNDS), Vec::with_capacity(ROUNDS));
    for _ in 0..ROUNDS {
        let start = Instant::now();
        let link = dialer.dial(&url).await.unwrap();
        times.push(start.elapsed());
        let stats = link.stats();
        bytes.push((stats.sent_bytes, stats.received_bytes));
        link.close(CloseReason::Goodbye);
    }
    times.sort_unstable();
    bytes.sort_unstable();
    let (sent, received) = bytes[ROUNDS / 2];
    (times, sent, received)
}
