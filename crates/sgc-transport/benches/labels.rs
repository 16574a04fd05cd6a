//! Savings of labels, beside packets with their names in the same run: `cargo bench -p sgc-transport --bench labels`.
//!
//! One name over one link, over loopback, both ends in one process on two threads. Bytes are those of UDP payloads:
//! QUIC's own, and acknowledgements, included.
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    clippy::disallowed_methods,
    reason = "a bench measures and prints"
)]

mod support;

use std::sync::Arc;
use std::time::Instant;

use sgc_transport::{AnyLink, CloseReason, Dialer, Link as _, LinkOptions, Listener};
use sgc_wire::{Class, Label, Name};

/// Packets of a round; those of both forms take turns.
const PACKETS: u64 = 100_000;
const ROUNDS: usize = 15;
/// Bytes that the suite `group` adds to the first fragment: message head and tag.
const SEALED: usize = 12 + 16;

fn main() {
    let (router, arm) = support::identities();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    runtime.block_on(async {
        let addr = "quic://127.0.0.1:0".parse().unwrap();
        let mut listener = Listener::bind(&addr, router, LinkOptions::default(), Arc::default()).unwrap();
        let url = listener.local().to_string().parse().unwrap();
        let dialer = Dialer::new(arm, LinkOptions::default(), Arc::default());
        let (near, far) = tokio::join!(dialer.dial(&url), listener.accept());
        let (near, far) = (near.unwrap(), far.unwrap().unwrap());
        let label = Label::new(0);
        far.define_label(label.unwrap(), Name([1; 32])).unwrap();
        println!("{:<26}{:>12}{:>12}{:>8}", "a packet", "name", "label", "ratio");
        for message in [16, 100, 1000] {
            let (mut bytes, mut rates, mut costs) = ([vec![], vec![]], [vec![], vec![]], [vec![], vec![]]);
            for round in 0..2 * ROUNDS {
                let form = (round + round / 2) % 2;
                let (sent, rate, cost) = measure(&near, &far, message, label.filter(|_| form == 1)).await;
                bytes[form].push(sent);
                rates[form].push(rate);
                costs[form].push(cost);
            }
            for (what, all) in [("bytes", bytes), ("packets a second", rates), ("CPU, ns", costs)] {
                let [named, labelled] = all.map(median);
                let what = format!("{message} B: {what}");
                println!("{what:<26}{named:>12.1}{labelled:>12.1}{:>8.2}", labelled / named);
            }
        }
        near.close(CloseReason::Goodbye);
        dialer.close(CloseReason::Goodbye).await;
    });
}

/// Returns the CPU time of the process's threads until now, nanoseconds: other load affects it less than the clock.
fn cpu_ns() -> f64 {
    let tasks = std::fs::read_dir("/proc/self/task").unwrap().flatten();
    let times = tasks.filter_map(|t| std::fs::read_to_string(t.path().join("schedstat")).ok());
    times.filter_map(|t| t.split(' ').next()?.parse::<f64>().ok()).sum()
}

/// Bytes of a packet, packets a second, and CPU time of a packet at both ends, over a flow of its own.
async fn measure(near: &AnyLink, far: &AnyLink, message: usize, label: Option<Label>) -> (f64, f64, f64) {
    let (packet, before, cpu) = (support::packet(1, message, SEALED), near.stats().sent_bytes, cpu_ns());
    let begun = Instant::now();
    let mut flow = near.open_flow(Class::Default).await.unwrap();
    let sender = tokio::spawn(async move {
        for _ in 0..PACKETS {
            flow.send_as(&packet, label).await.unwrap();
        }
        flow.finish().await.unwrap();
    });
    let mut flow = far.accept_flow().await.unwrap();
    let mut received = 0;
    while let Some(packet) = flow.recv().await.unwrap() {
        assert_eq!(packet.header.name, Name([1; 32]));
        received += 1;
    }
    assert_eq!(received, PACKETS);
    let took = begun.elapsed().as_secs_f64();
    sender.await.unwrap();
    let sent = near.stats().sent_bytes - before;
    let all = PACKETS as f64;
    (sent as f64 / all, all / took, (cpu_ns() - cpu) / all)
}

fn median(mut all: Vec<f64>) -> f64 {
    all.sort_unstable_by(f64::total_cmp);
    all[all.len() / 2]
}
