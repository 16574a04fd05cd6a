//! Allocations of a link for each packet that it sends and receives, besides those of QUIC in its own tasks.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]
#![allow(clippy::print_stderr, reason = "what was counted is of use")]

mod support;

use bytes::Bytes;
use sgc_testkit::{Allocations, CountingAllocator, allocated_here, allocations_of};
use sgc_transport::*;
use sgc_wire::{Label, Packet};
use support::*;

#[global_allocator]
static COUNTING: CountingAllocator = CountingAllocator;

/// Containers grow to their size first.
const WARM_UP: u64 = 500;
const PACKETS: u64 = 1000;

/// An allocation in so many packets may be that of a container that grows: acknowledgements come when they come, so
/// more may be under way than ever before.
const SOME: f64 = 0.1;

/// Both ends in one thread, so that one counter sees all.
async fn linked() -> (Dialer, Server, AnyLink, AnyLink) {
    let fleet = fleet(1);
    let mut server = Server::start_on("quic", enroll(&fleet, "router"), LinkOptions::default());
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), LinkOptions::default(), Default::default());
    let near = soon(dialer.dial(&server.url)).await.unwrap();
    let far = server.link().await;
    (dialer, server, near, far)
}

/// Allocations for each packet: in sending, in receiving, and in all.
struct AllocationCounts {
    sent: f64,
    received: f64,
    all: f64,
}

impl AllocationCounts {
    fn report(what: &str, [sent, received]: [usize; 2], before: Allocations) -> Self {
        let each = |count: usize| count as f64 / PACKETS as f64;
        let all = allocated_here().count - before.count;
        let counted = Self { sent: each(sent), received: each(received), all: each(all) };
        let Self { sent, received, all } = counted;
        eprintln!("{what}: {sent} to send, {received} to receive, {} by QUIC", all - sent - received);
        counted
    }
}

/// As routers pass packets on: the memory is the transport's, or at least shared already.
fn shared(bytes: usize) -> impl Fn(u64) -> Packet {
    let payload = Bytes::from(vec![7; bytes]);
    let first = payload.clone();
    move |seq| packet(seq, first.slice(..payload.len()))
}

async fn by_flow(bytes: usize) -> AllocationCounts {
    let (_dialer, _server, near, far) = linked().await;
    let packet = shared(bytes);
    let mut out = near.open_flow(sgc_wire::Class::Default).await.unwrap();
    out.send(&packet(0)).await.unwrap();
    let mut into = soon(far.accept_flow()).await.unwrap();
    into.recv().await.unwrap().unwrap();
    let (mut counts, mut before) = ([0, 0], Allocations::default());
    for seq in 1..=WARM_UP + PACKETS {
        if seq == WARM_UP + 1 {
            (counts, before) = ([0, 0], allocated_here());
        }
        let packet = packet(seq);
        let (sent, result) = allocations_of(out.send_as(&packet, None::<Label>)).await;
        result.unwrap();
        let (received, result) = allocations_of(into.recv()).await;
        assert_eq!(result.unwrap().unwrap().header.seq, seq);
        counts = [counts[0] + sent.count, counts[1] + received.count];
    }
    AllocationCounts::report(&format!("{bytes} bytes in a flow"), counts, before)
}

async fn by_datagram(bytes: usize) -> AllocationCounts {
    let (_dialer, _server, near, far) = linked().await;
    let packet = shared(bytes);
    let (mut counts, mut before) = ([0, 0], Allocations::default());
    for seq in 1..=WARM_UP + PACKETS {
        if seq == WARM_UP + 1 {
            (counts, before) = ([0, 0], allocated_here());
        }
        let packet = packet(seq);
        let (sent, result) = allocations_of(near.send_datagram_as(&packet, None)).await;
        result.unwrap();
        let (received, result) = allocations_of(soon(far.recv_datagram())).await;
        assert_eq!(result.unwrap().packet().unwrap().header.seq, seq);
        counts = [counts[0] + sent.count, counts[1] + received.count];
    }
    AllocationCounts::report(&format!("{bytes} bytes in a datagram"), counts, before)
}

#[tokio::test]
async fn a_packet_of_a_flow_is_no_allocation() {
    for bytes in [16, 100, 1000] {
        let counted = by_flow(bytes).await;
        assert!(counted.all > 0.0, "the allocator counts");
        assert!(counted.sent <= SOME && counted.received <= SOME, "{bytes} bytes");
    }
}

#[tokio::test]
async fn a_large_packet_is_at_most_one_list_of_its_pieces() {
    for bytes in [3000, 16_384] {
        let counted = by_flow(bytes).await;
        assert!(counted.sent <= SOME && counted.received <= 1.0 + SOME, "{bytes} bytes");
    }
}

#[tokio::test]
async fn a_datagram_is_no_allocation() {
    for bytes in [16, 100, 1000] {
        let counted = by_datagram(bytes).await;
        assert!(counted.all > 0.0, "the allocator counts");
        assert!(counted.sent <= SOME && counted.received <= SOME, "{bytes} bytes");
    }
}
