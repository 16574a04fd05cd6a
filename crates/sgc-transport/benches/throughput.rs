//! Throughput of one link over loopback, by each congestion controller in turn: `cargo bench -p sgc-transport --bench
//! throughput`. Both ends are in one process on two threads.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    reason = "a bench measures and prints"
)]

mod support;

use std::sync::Arc;
use std::time::Instant;

use sgc_transport::{AnyLink, CloseReason, Congestion, Dialer, Link as _, LinkOptions, Listener};
use sgc_wire::Class;

const ROUNDS: usize = 15;
/// Bytes of a fragment of a large message, and how many make 13 MB.
const FRAGMENT: usize = 16_384;
const FRAGMENTS: usize = 800;
/// Messages of 1 KB of a round.
const MESSAGES: usize = 40_000;
/// Bytes that are queued before they are sent, where packets leave together.
const TOGETHER: usize = 16 << 10;

fn main() {
    let (router, arm) = support::identities();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(async {
        let mut links = Vec::new();
        for congestion in Congestion::ALL {
            let options = LinkOptions { congestion, ..LinkOptions::default() };
            let addr = "quic://127.0.0.1:0".parse().unwrap();
            let mut listener =
                Listener::bind(&addr, router.clone(), options.clone(), Arc::default()).unwrap();
            let url = listener.local().to_string().parse().unwrap();
            let dialer = Dialer::new(arm.clone(), options, Arc::default());
            let (near, far) = tokio::join!(dialer.dial(&url), listener.accept());
            links.push((congestion, near.unwrap(), far.unwrap().unwrap(), dialer, listener));
        }
        println!("{:<10}{:>14}{:>14}{:>20}", "", "13 MB, MB/s", "1 KB, MB/s", "1 KB together, MB/s");
        let mut rates = vec![[vec![], vec![], vec![]]; links.len()];
        for _ in 0..ROUNDS {
            for (n, (_, near, far, ..)) in links.iter().enumerate() {
                rates[n][0].push(measure(near, far, FRAGMENT, FRAGMENTS, 0).await);
                rates[n][1].push(measure(near, far, 1000, MESSAGES, 0).await);
                rates[n][2].push(measure(near, far, 1000, MESSAGES, TOGETHER).await);
            }
        }
        for ((congestion, near, ..), rates) in links.iter().zip(rates) {
            let [large, small, together] = rates.map(median);
            println!("{:<10}{large:>14.0}{small:>14.0}{together:>20.0}", congestion.to_string());
            near.close(CloseReason::Goodbye);
        }
    });
}

/// Megabytes a second of so many packets, over a flow of their own, until the last has arrived. Up to `together` bytes
/// of them are sent at once.
async fn measure(near: &AnyLink, far: &AnyLink, bytes: usize, packets: usize, together: usize) -> f64 {
    let packet = support::packet(1, bytes, 0);
    let begun = Instant::now();
    let mut flow = near.open_flow(Class::Default).await.unwrap();
    let sender = tokio::spawn(async move {
        for _ in 0..packets {
            flow.queue_as(&packet, None);
            if flow.queued_bytes() > together {
                flow.flush().await.unwrap();
            }
        }
        flow.finish().await.unwrap();
    });
    let mut flow = far.accept_flow().await.unwrap();
    let mut received = 0;
    while flow.recv().await.unwrap().is_some() {
        received += 1;
    }
    assert_eq!(received, packets);
    let took = begun.elapsed().as_secs_f64();
    sender.await.unwrap();
    (bytes * packets) as f64 / took / 1e6
}

fn median(mut all: Vec<f64>) -> f64 {
    all.sort_unstable_by(f64::total_cmp);
    all[all.len() / 2]
}
