//! Transports over UDP, through relays that behave like bad networks and forgetful NATs.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[path = "support/relay.rs"]
mod relay;
#[macro_use]
mod support;

use std::net::SocketAddr;
use std::sync::atomic::Ordering::Relaxed;

use bytes::Bytes;
use relay::Relay;
use sgc_transport::*;
use sgc_wire::Class;
use support::*;

each_transport! {
    [
        a_nat_that_changes_its_port_costs_nothing
        a_dialer_that_moves_keeps_its_links
        large_messages_survive_loss_and_reordering
        links_are_made_through_loss
        a_path_of_1280_bytes_is_wide_enough
        altered_datagrams_are_dropped
        links_without_offloads_and_with_marks_work
    ]: quic udp dtls
}

const GRID: usize = 16 * 1024;

fn image(bytes: u32) -> Bytes {
    (0..bytes).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

/// Makes a link through a relay, which is fair at first.
async fn relayed(scheme: &str, options: LinkOptions) -> (Dialer, AnyLink, AnyLink, Relay) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options.clone());
    let relay = Relay::start(server.addr, 7).await;
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Default::default());
    let url = format!("{scheme}://{}", relay.addr).parse().unwrap();
    let near = soon(dialer.dial(&url)).await.unwrap();
    let far = server.link().await;
    (dialer, near, far, relay)
}

/// Sends one flow and does something once a third of it has arrived.
async fn flow_with(near: &AnyLink, far: &AnyLink, sent: Bytes, midway: impl AsyncFnOnce()) {
    let near = near.clone();
    let pieces = sent.clone();
    let send = tokio::spawn(async move {
        let mut flow = near.open_flow(Class::Bulk).await.unwrap();
        for (seq, start) in (0..pieces.len()).step_by(GRID).enumerate() {
            let piece = pieces.slice(start..pieces.len().min(start + GRID));
            flow.send(&packet(seq as u64, piece)).await.unwrap();
        }
        flow.finish().await.unwrap();
    });
    let mut flow = soon(far.accept_flow()).await.unwrap();
    let (mut at, mut midway) = (0, Some(midway));
    while let Some(got) = soon(flow.recv()).await.unwrap() {
        let piece = joined(&got.payload);
        assert!(sent[at..at + piece.len()] == piece, "at {at}");
        at += piece.len();
        if at > sent.len() / 3
            && let Some(midway) = midway.take()
        {
            midway().await;
        }
    }
    assert_eq!(at, sent.len());
    soon(send).await.unwrap();
}

async fn says(from: &AnyLink, to: &AnyLink, word: &'static str) {
    from.send_control(Bytes::from_static(word.as_bytes())).await.unwrap();
    assert_eq!(soon(to.recv_control()).await.unwrap(), word);
}

async fn a_nat_that_changes_its_port_costs_nothing(scheme: &str) {
    let (_dialer, near, far, relay) = relayed(scheme, LinkOptions::default()).await;
    let before = far.remote();
    flow_with(&near, &far, image(6_000_000), async || relay.change_port()).await;
    says(&near, &far, "there").await;
    says(&far, &near, "and back").await;
    moved(&far, before).await;
    // In the other direction: the listener sends, and only the dialer's acknowledgements show its address.
    let before = far.remote();
    flow_with(&far, &near, image(3_000_000), async || relay.change_port()).await;
    moved(&far, before).await;
}

async fn a_dialer_that_moves_keeps_its_links(scheme: &str) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
    let dialer = dialer(enroll(&fleet, "arm-1"));
    let near = soon(dialer.dial(&server.url)).await.unwrap();
    let far = server.link().await;
    for _ in 0..3 {
        let before = far.remote();
        flow_with(&near, &far, image(4_000_000), async || dialer.rebind().unwrap()).await;
        moved(&far, before).await;
        says(&far, &near, "control").await;
        says(&near, &far, "control").await;
    }
    assert_eq!(server.metrics.accepted(), 1);
    // An idle link moves, too, and at once: not only with its next packet.
    let before = far.remote();
    dialer.rebind().unwrap();
    moved(&far, before).await;
}

/// Waits until the peer has another address.
async fn moved(link: &AnyLink, before: SocketAddr) {
    soon(async {
        while link.remote() == before {
            tokio::time::sleep(std::time::Duration::from_millis(5)).await;
        }
    })
    .await;
}

async fn large_messages_survive_loss_and_reordering(scheme: &str) {
    let (_dialer, near, far, relay) = relayed(scheme, LinkOptions::default()).await;
    for (loss, reorder) in [(0, 0), (10, 20), (50, 50)] {
        relay.impairment.loss.store(loss, Relaxed);
        relay.impairment.reorder.store(reorder, Relaxed);
        flow_with(&near, &far, image(13_000_000), async || {}).await;
    }
}

async fn links_are_made_through_loss(scheme: &str) {
    let fleet = fleet(1);
    let options =
        LinkOptions { handshake_timeout: std::time::Duration::from_secs(25), ..LinkOptions::default() };
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options.clone());
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Default::default());
    for seed in 0..4 {
        let relay = Relay::start(server.addr, seed).await;
        relay.impairment.loss.store(150, Relaxed);
        relay.impairment.reorder.store(100, Relaxed);
        let url = format!("{scheme}://{}", relay.addr).parse().unwrap();
        let near = soon(dialer.dial(&url)).await.unwrap();
        let far = server.link().await;
        says(&near, &far, "through").await;
        says(&far, &near, "all of it").await;
    }
}

async fn a_path_of_1280_bytes_is_wide_enough(scheme: &str) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
    let relay = Relay::start(server.addr, 5).await;
    // The path's MTU less the headers of IPv6 and UDP.
    relay.impairment.longest.store(1232, Relaxed);
    let dialer = dialer(enroll(&fleet, "arm-1"));
    let url = format!("{scheme}://{}", relay.addr).parse().unwrap();
    let near = soon(dialer.dial(&url)).await.unwrap();
    let far = server.link().await;
    flow_with(&near, &far, image(300_000), async || {}).await;
    flow_with(&far, &near, image(300_000), async || {}).await;
    assert!(near.stats().mtu_bytes <= 1232 && far.stats().mtu_bytes <= 1232);
}

async fn altered_datagrams_are_dropped(scheme: &str) {
    // No other packet of this length should be on the way.
    let options = LinkOptions { mtu_discovery: false, ..LinkOptions::default() };
    let (_dialer, near, far, relay) = relayed(scheme, options).await;
    relay.impairment.tap.store(true, Relaxed);
    relay.impairment.flip.store(true, Relaxed);
    let payload = Bytes::from("visible on the wire ".repeat(40));
    let sent = packet(5, payload.clone());
    far.send_datagram(&sent).await.unwrap();
    soon(async {
        while relay.impairment.flipped.load(Relaxed) == 0 {
            tokio::time::sleep(std::time::Duration::from_millis(1)).await;
        }
    })
    .await;
    // The second arrives, so the first was dropped.
    let second = packet(6, payload.clone());
    far.send_datagram(&second).await.unwrap();
    assert_eq!(soon(near.recv_datagram()).await.unwrap().packet().unwrap().header.seq, 6);
    let seen = relay.impairment.seen.lock().unwrap();
    let is_visible = seen.iter().any(|d| d.windows(40).any(|w| w == &payload[..40]));
    assert_eq!(is_visible, scheme == "udp");
}

async fn links_without_offloads_and_with_marks_work(scheme: &str) {
    for options in [
        LinkOptions { offload: false, ..LinkOptions::default() },
        LinkOptions { dscp: Some(46), ..LinkOptions::default() },
        LinkOptions { mtu_discovery: false, ..LinkOptions::default() },
    ] {
        let fleet = fleet(1);
        for addr in ["[::1]:0", "127.0.0.1:0", "[::]:0"] {
            let mut server =
                Server::start_at(&format!("{scheme}://{addr}"), enroll(&fleet, "router"), options.clone());
            let host = if addr.starts_with("[::1]") { "[::1]" } else { "127.0.0.1" };
            let dialer = Dialer::new(enroll(&fleet, "arm-1"), options.clone(), Default::default());
            let url = format!("{scheme}://{host}:{}", server.addr.port()).parse().unwrap();
            let near = soon(dialer.dial(&url)).await.unwrap();
            let far = server.link().await;
            flow_with(&near, &far, image(300_000), async || {}).await;
            if !options.mtu_discovery {
                assert_eq!(near.stats().mtu_bytes, 1200);
            }
        }
    }
    let options = LinkOptions { dscp: Some(64), ..LinkOptions::default() };
    let addr = format!("{scheme}://127.0.0.1:0").parse().unwrap();
    let bound = Listener::bind(&addr, enroll(&fleet(1), "router"), options, Default::default());
    assert_eq!(bound.err().map(|e| e.kind()), Some(std::io::ErrorKind::InvalidInput));
}
