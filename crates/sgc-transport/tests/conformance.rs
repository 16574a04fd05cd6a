//! The promises of every transport to its users, over loopback: one suite, run for each scheme.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[macro_use]
mod support;

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_testkit::unused_port;
use sgc_transport::*;
use sgc_trust::{CertError, Identity};
use sgc_wire::{Class, DecodeError, Label, Name, UnixMillis};
use support::*;

each_transport! {
    [
        both_ends_know_each_other
        a_listener_on_every_interface_takes_both_families
        every_address_of_a_host_is_tried
        a_dialer_of_another_fleet_is_refused
        a_dialer_of_another_fleet_that_trusts_ours_is_refused
        expired_and_early_certificates_are_refused
        a_listener_with_an_expired_certificate_gets_no_link
        nobody_at_the_address_is_said
        control_frames_go_both_ways_in_order
        thirteen_megabytes_arrive_intact_and_in_order
        flows_do_not_wait_for_each_other
        queued_packets_leave_together_and_in_order
        a_flow_given_up_inside_of_a_packet_does_not_pass_for_finished
        either_end_can_end_a_flow
        datagrams_carry_small_packets
        packets_under_labels_arrive_under_their_names
        an_unknown_label_ends_its_flow_or_datagram_alone
        the_peer_learns_why_a_link_is_closed
        a_link_without_users_closes
        closing_a_listener_or_dialer_says_goodbye_on_its_links
        a_dead_peer_is_noticed_and_a_restarted_one_at_once
    ]: quic udp dtls tls tcp ws wss
}

/// The kernel ends the connections of a killed program, and refuses connections where nobody listens.
fn is_tcp(scheme: &str) -> bool {
    matches!(scheme, "tls" | "tcp" | "ws" | "wss")
}

async fn both_ends_know_each_other(scheme: &str) {
    let fleet = fleet(1);
    let (router, arm) = (enroll(&fleet, "router"), enroll(&fleet, "arm-1"));
    let mut server = Server::start_on(scheme, Arc::clone(&router), LinkOptions::default());
    let metrics = Arc::new(TransportMetrics::default());
    let dialer = Dialer::new(Arc::clone(&arm), LinkOptions::default(), Arc::clone(&metrics));
    let near = soon(dialer.dial(&server.url)).await.unwrap();
    let far = server.link().await;
    assert_eq!(near.peer().node_id, router.node_id());
    assert_eq!(far.peer().node_id, arm.node_id());
    assert_eq!(near.remote(), server.addr);
    assert!(near.is_dialer() && !far.is_dialer());
    assert!(near.stats().mtu_bytes >= 1200 && far.stats().received_bytes > 0);
    // Known at once: routing weighs the link as soon as it exists.
    assert!([&near, &far].iter().all(|link| !link.stats().rtt.is_zero()));
    assert_eq!((metrics.dialed(), server.metrics.accepted()), (1, 1));
    assert_eq!(server.metrics.handshakes_pending(), 0);
    assert!(RefusalKind::ALL.into_iter().all(|k| server.metrics.refused(k) == 0));
}

async fn a_listener_on_every_interface_takes_both_families(scheme: &str) {
    let fleet = fleet(1);
    let mut server =
        Server::start_at(&format!("{scheme}://[::]:0"), enroll(&fleet, "router"), LinkOptions::default());
    let dialer = dialer(enroll(&fleet, "arm-1"));
    for host in ["127.0.0.1", "[::1]"] {
        let url = format!("{scheme}://{host}:{}", server.addr.port()).parse().unwrap();
        let _near = soon(dialer.dial(&url)).await.unwrap();
        let far = server.link().await;
        assert_eq!(far.remote().is_ipv4(), host.contains('.'), "{:?}", far.remote());
    }
}

async fn every_address_of_a_host_is_tried(scheme: &str) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
    // Where localhost is ::1 as well, nothing answers there.
    let url = format!("{scheme}://localhost:{}", server.addr.port()).parse().unwrap();
    let _near = soon(dialer(enroll(&fleet, "arm-1")).dial(&url)).await.unwrap();
    server.link().await;
}

async fn a_dialer_of_another_fleet_is_refused(scheme: &str) {
    let ours = fleet(1);
    let theirs = fleet(2);
    let mut server = Server::start_on(scheme, enroll(&ours, "router"), LinkOptions::default());
    let error = dial(enroll(&theirs, "arm-1"), &server.url).await.unwrap_err();
    assert!(matches!(error, LinkError::RefusedHere(CertError::UnknownIssuer)), "{error}");
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::ByPeer(PeerRefusal::OtherCa)), "{refused}");
    assert_eq!(server.metrics.refused(RefusalKind::OtherCa), 1);
    assert_eq!(server.metrics.accepted(), 0);
}

async fn a_dialer_of_another_fleet_that_trusts_ours_is_refused(scheme: &str) {
    let (ours, theirs) = (fleet(1), fleet(2));
    let mut server = Server::start_on(scheme, enroll(&ours, "router"), LinkOptions::default());
    let text = enroll(&ours, "x").to_text();
    let start = text.find("-----BEGIN SGC CA CERTIFICATE-----").unwrap();
    let end = "-----END SGC CA CERTIFICATE-----\n";
    let ca = &text[start..text.find(end).unwrap() + end.len()];
    let both = format!("{}{ca}", enroll(&theirs, "arm-1").to_text().as_str());
    let error = dial(Arc::new(Identity::parse(&both).unwrap()), &server.url).await.unwrap_err();
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::OtherCa)), "{error}");
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::UnknownIssuer)), "{refused}");
    assert!(refused.to_string().contains("127.0.0.1"), "{refused}");
    assert_eq!(server.metrics.refused(RefusalKind::OtherCa), 1);
}

async fn expired_and_early_certificates_are_refused(scheme: &str) {
    let fleet = fleet(1);
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
    let past = enroll_at(&fleet, "arm-1", UnixMillis(now().0 - 120 * MINUTE));
    let error = dial(past, &server.url).await.unwrap_err();
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::Expired)), "{error}");
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::Expired { .. })), "{refused}");
    let future = enroll_at(&fleet, "arm-1", UnixMillis(now().0 + 120 * MINUTE));
    dial(future, &server.url).await.unwrap_err();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::NotYetValid { .. })), "{refused}");
    let kinds = [RefusalKind::Expired, RefusalKind::NotYetValid];
    assert_eq!(kinds.map(|k| server.metrics.refused(k)), [1, 1]);
}

async fn a_listener_with_an_expired_certificate_gets_no_link(scheme: &str) {
    let fleet = fleet(1);
    let past = enroll_at(&fleet, "router", UnixMillis(now().0 - 120 * MINUTE));
    let mut server = Server::start_on(scheme, past, LinkOptions::default());
    let error = dial(enroll(&fleet, "arm-1"), &server.url).await.unwrap_err();
    assert!(matches!(error, LinkError::RefusedHere(CertError::Expired { .. })), "{error}");
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::ByPeer(PeerRefusal::Expired)), "{refused}");
}

async fn nobody_at_the_address_is_said(scheme: &str) {
    let url = format!("{scheme}://127.0.0.1:{}", unused_port()).parse().unwrap();
    let options = LinkOptions { handshake_timeout: Duration::from_millis(200), ..LinkOptions::default() };
    let dialer = Dialer::new(enroll(&fleet(1), "arm-1"), options, Arc::default());
    let error = soon(dialer.dial(&url)).await.unwrap_err();
    let DialError::Failed { attempts, .. } = &error else { panic!("{error}") };
    if is_tcp(scheme) {
        assert!(matches!(attempts[..], [(_, LinkError::NobodyListens)]), "{error}");
        assert!(error.to_string().contains("nobody listens for TCP"), "{error}");
    } else {
        assert!(matches!(attempts[..], [(_, LinkError::HandshakeTimedOut { .. })]), "{error}");
        assert!(error.to_string().contains("UDP"), "{error}");
    }
    let url: LinkUrl = format!("{scheme}://no-such-host.invalid").parse().unwrap();
    assert!(matches!(soon(dialer.dial(&url)).await, Err(DialError::Resolve { .. })));
}

// Bare peers.

async fn control_frames_go_both_ways_in_order(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let frames = [
        Bytes::new(),
        Bytes::from_static(b"hello"),
        Bytes::from(vec![7; CONTROL_FRAME_BYTES_MAX]),
        Bytes::from_static(b"end"),
    ];
    for (from, to) in [(&near, &far), (&far, &near)] {
        let send = async {
            for frame in &frames {
                from.send_control(frame.clone()).await.unwrap();
            }
        };
        let receive = async {
            for frame in &frames {
                assert_eq!(to.recv_control().await.unwrap(), frame);
            }
        };
        soon(async { tokio::join!(send, receive) }).await;
    }
    let too_long = near.send_control(Bytes::from(vec![0; CONTROL_FRAME_BYTES_MAX + 1])).await.unwrap_err();
    assert!(matches!(too_long, LinkError::FrameTooLong { .. }) && too_long.is_link_alive());
    near.send_control(Bytes::from_static(b"still here")).await.unwrap();
    assert_eq!(soon(far.recv_control()).await.unwrap(), "still here");
}

async fn thirteen_megabytes_arrive_intact_and_in_order(scheme: &str) {
    const GRID: usize = 16 * 1024;
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let image: Bytes = (0..13_000_000u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let sent = image.clone();
    let send = tokio::spawn(async move {
        let mut flow = near.open_flow(Class::Bulk).await.unwrap();
        for (seq, start) in (0..sent.len()).step_by(GRID).enumerate() {
            let piece = sent.slice(start..sent.len().min(start + GRID));
            flow.send(&packet(seq as u64, piece)).await.unwrap();
        }
        flow.finish().await.unwrap();
        near
    });
    let mut flow = soon(far.accept_flow()).await.unwrap();
    let (mut at, mut seq) = (0, 0);
    while let Some(got) = soon(flow.recv()).await.unwrap() {
        assert_eq!(got.header.seq, seq);
        for piece in &got.payload.0 {
            assert_eq!(image[at..at + piece.len()], piece[..]);
            at += piece.len();
        }
        seq += 1;
    }
    assert_eq!(at, image.len());
    assert!(soon(flow.recv()).await.unwrap().is_none());
    send.await.unwrap();
}

async fn flows_do_not_wait_for_each_other(scheme: &str) {
    let options = LinkOptions { flow_window_bytes: 64 << 10, ..LinkOptions::default() };
    let (near, far) = pair_on(scheme, options).await;
    let mut stuck = near.open_flow(Class::Bulk).await.unwrap();
    let full = packet(1, Bytes::from(vec![0; 16 << 10]));
    // Fills the window of a flow that no one reads.
    while tokio::time::timeout(Duration::from_millis(100), stuck.send(&full)).await.is_ok() {}
    let mut free = near.open_flow(Class::Realtime).await.unwrap();
    free.send(&packet(7, Bytes::from_static(b"go"))).await.unwrap();
    let mut first = soon(far.accept_flow()).await.unwrap();
    let mut second = soon(far.accept_flow()).await.unwrap();
    assert_eq!(soon(second.recv()).await.unwrap().unwrap().header.seq, 7);
    // The cancelled send left the flow whole: its packet comes first.
    let last = packet(2, Bytes::from_static(b"last"));
    let finish = async {
        stuck.send(&last).await.unwrap();
        stuck.finish().await.unwrap();
    };
    let drain = async {
        let mut count = 0;
        while let Some(got) = first.recv().await.unwrap() {
            assert_eq!(joined(&got.payload).len(), got.header.total as usize);
            count += 1;
            if got.header.seq == 2 {
                assert_eq!(joined(&got.payload), "last");
            }
        }
        count
    };
    let ((), count) = soon(async { tokio::join!(finish, drain) }).await;
    assert!(count >= 2, "{count}");
}

async fn queued_packets_leave_together_and_in_order(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let sizes = [0, 1, 100, 2048, 2049, 3, 16 << 10, 5];
    let of = |seq: usize| packet(seq as u64, Bytes::from(vec![seq as u8; sizes[seq % sizes.len()]]));
    let mut tx = near.open_flow(Class::Default).await.unwrap();
    for seq in 0..100 {
        let before = tx.queued_bytes();
        tx.queue_as(&of(seq), None);
        assert!(tx.queued_bytes() >= before + of(seq).encoded_bytes());
        match seq % 30 {
            20 => tx.flush().await.unwrap(),
            29 => tx.send(&of(1000)).await.unwrap(),
            _ => continue,
        }
        assert_eq!(tx.queued_bytes(), 0);
    }
    // Queued packets at the end belong to the flow.
    tx.finish().await.unwrap();
    let mut rx = soon(far.accept_flow()).await.unwrap();
    let mut seqs = Vec::new();
    while let Some(got) = soon(rx.recv()).await.unwrap() {
        let seq = got.header.seq as usize;
        assert_eq!(joined(&got.payload), joined(&of(seq).payload));
        seqs.push(seq);
    }
    let sent = (0..100).flat_map(|seq| std::iter::once(seq).chain((seq % 30 == 29).then_some(1000)));
    assert_eq!(seqs, sent.collect::<Vec<_>>());

    let mut tx = near.open_flow(Class::Default).await.unwrap();
    tx.send(&of(1)).await.unwrap();
    tx.queue_as(&of(2), None);
    drop(tx);
    let mut rx = soon(far.accept_flow()).await.unwrap();
    assert_eq!(soon(rx.recv()).await.unwrap().unwrap().header.seq, 1);
    assert!(soon(rx.recv()).await.unwrap().is_none(), "it was never sent");
}

async fn a_flow_given_up_inside_of_a_packet_does_not_pass_for_finished(scheme: &str) {
    let options = LinkOptions { flow_window_bytes: 40 << 10, ..LinkOptions::default() };
    let (near, far) = pair_on(scheme, options).await;
    let mut tx = near.open_flow(Class::Bulk).await.unwrap();
    let full = packet(1, Bytes::from(vec![0; 16 << 10]));
    tx.send(&full).await.unwrap();
    tx.send(&full).await.unwrap();
    // The window holds two and a half, and no one reads: the third cannot end.
    let third = tokio::time::timeout(Duration::from_millis(200), tx.send(&full)).await;
    assert!(third.is_err());
    drop(tx);
    let mut rx = soon(far.accept_flow()).await.unwrap();
    let error = loop {
        match soon(rx.recv()).await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("half a packet passed for the end"),
            Err(error) => break error,
        }
    };
    assert!(matches!(error, FlowError::Ended(FlowEnd::Unwanted)), "{error}");
}

async fn either_end_can_end_a_flow(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let one = packet(1, Bytes::from_static(b"x"));
    let mut tx = near.open_flow(Class::Default).await.unwrap();
    tx.send(&one).await.unwrap();
    let mut rx = soon(far.accept_flow()).await.unwrap();
    soon(rx.recv()).await.unwrap().unwrap();
    tx.reset(FlowEnd::Stale);
    assert!(matches!(soon(rx.recv()).await, Err(FlowError::Ended(FlowEnd::Stale))));

    let mut tx = near.open_flow(Class::Default).await.unwrap();
    tx.send(&one).await.unwrap();
    soon(far.accept_flow()).await.unwrap().stop(FlowEnd::Unwanted);
    let error = loop {
        if let Err(error) = soon(tx.send(&one)).await {
            break error;
        }
        tokio::task::yield_now().await;
    };
    assert!(matches!(error, LinkError::FlowStopped(FlowEnd::Unwanted)), "{error}");
    assert!(error.is_link_alive());
}

// Datagrams.

async fn datagrams_carry_small_packets(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let small = packet(5, Bytes::from(vec![3; 700]));
    near.send_datagram(&small).await.unwrap();
    let got = soon(far.recv_datagram()).await.unwrap().packet().unwrap();
    assert_eq!((got.header, joined(&got.payload)), (small.header, joined(&small.payload)));
    let max = near.datagram_max().unwrap();
    let big = packet(6, Bytes::from(vec![0; max]));
    let error = near.send_datagram(&big).await.unwrap_err();
    assert!(matches!(error, LinkError::DatagramTooLong { bytes, .. } if bytes == big.encoded_bytes()));
    assert!(error.is_link_alive());
}

async fn packets_under_labels_arrive_under_their_names(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let [first, second] = [0, 1].map(|index| Label::new(index).unwrap());
    far.define_label(first, Name([9; 32])).unwrap();
    far.define_label(second, Name([1; 32])).unwrap();
    assert_eq!(far.define_label(second, Name([2; 32])), Err(LabelError { found: 1, expected: 2 }));
    assert_eq!((near.labels_defined(), far.labels_defined()), (0, 2));
    let sent = packet(5, Bytes::from(vec![3; 700]));
    let mut flow = near.open_flow(Class::Default).await.unwrap();
    for label in [None, Some(second), None, Some(second)] {
        near.send_datagram_as(&sent, label).await.unwrap();
        let got = soon(far.recv_datagram()).await.unwrap().packet().unwrap();
        assert_eq!((got.header, joined(&got.payload)), (sent.header.clone(), joined(&sent.payload)));
        flow.send_as(&sent, label).await.unwrap();
    }
    flow.finish().await.unwrap();
    let mut flow = soon(far.accept_flow()).await.unwrap();
    for _ in 0..4 {
        let got = soon(flow.recv()).await.unwrap().unwrap();
        assert_eq!((got.header, joined(&got.payload)), (sent.header.clone(), joined(&sent.payload)));
    }
    assert!(soon(flow.recv()).await.unwrap().is_none());
}

async fn an_unknown_label_ends_its_flow_or_datagram_alone(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let (label, sent) = (Label::new(3), packet(5, Bytes::from_static(b"lost")));
    near.send_datagram_as(&sent, label).await.unwrap();
    let unknown = DecodeError::UnknownLabel { label: 3 };
    let received = soon(far.recv_datagram()).await.unwrap();
    assert!(matches!(received, ReceivedDatagram::Malformed(e) if e == unknown));
    let mut flow = near.open_flow(Class::Default).await.unwrap();
    flow.send_as(&sent, label).await.unwrap();
    let mut received = soon(far.accept_flow()).await.unwrap();
    assert!(matches!(soon(received.recv()).await, Err(FlowError::Packet(e)) if e == unknown));
    loop {
        if let Err(error) = soon(flow.send(&sent)).await {
            assert!(matches!(error, LinkError::FlowStopped(FlowEnd::Malformed)), "{error}");
            break;
        }
    }
    near.send_datagram(&sent).await.unwrap();
    assert!(soon(far.recv_datagram()).await.unwrap().packet().is_some());
}

// Ends.

async fn the_peer_learns_why_a_link_is_closed(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    let waiting = {
        let far = far.clone();
        tokio::spawn(async move { far.recv_control().await.unwrap_err() })
    };
    let reason = CloseReason::Denied("not in this fleet's roster".into());
    near.close(reason.clone());
    for error in [soon(far.closed()).await, soon(waiting).await.unwrap()] {
        assert!(matches!(error, LinkError::Closed { by_peer: true, reason: r } if r == reason));
    }
    let here = soon(near.closed()).await;
    assert!(matches!(here, LinkError::Closed { by_peer: false, reason: r } if r == reason));
    assert!(soon(far.open_flow(Class::Bulk)).await.is_err());
}

async fn a_link_without_users_closes(scheme: &str) {
    let (near, far) = pair_on(scheme, LinkOptions::default()).await;
    drop(near);
    let error = soon(far.closed()).await;
    assert!(matches!(error, LinkError::Closed { by_peer: true, reason: CloseReason::Goodbye }), "{error}");
}

async fn closing_a_listener_or_dialer_says_goodbye_on_its_links(scheme: &str) {
    let fleet = fleet(1);
    let metrics = Arc::new(TransportMetrics::default());
    let addr = format!("{scheme}://127.0.0.1:0").parse().unwrap();
    let router = enroll(&fleet, "router");
    let mut listener = Listener::bind(&addr, router, LinkOptions::default(), metrics).unwrap();
    let url = listener.local().to_string().parse().unwrap();
    let dialer = dialer(enroll(&fleet, "arm-1"));
    let (near, far) = soon(async { tokio::join!(dialer.dial(&url), listener.accept()) }).await;
    let (near, far) = (near.unwrap(), far.unwrap().unwrap());
    soon(dialer.close(CloseReason::Goodbye)).await;
    let error = soon(far.closed()).await;
    assert!(matches!(error, LinkError::Closed { by_peer: true, reason: CloseReason::Goodbye }), "{error}");
    drop((near, far));
    let (near, far) = soon(async { tokio::join!(dialer.dial(&url), listener.accept()) }).await;
    let (near, _far) = (near.unwrap(), far.unwrap().unwrap());
    soon(listener.close(CloseReason::Overloaded)).await;
    let error = soon(near.closed()).await;
    assert!(matches!(error, LinkError::Closed { by_peer: true, reason: CloseReason::Overloaded }), "{error}");
}

async fn a_dead_peer_is_noticed_and_a_restarted_one_at_once(scheme: &str) {
    let fleet = fleet(1);
    let router = enroll(&fleet, "router");
    let options = LinkOptions {
        keep_alive: Duration::from_millis(100),
        idle_timeout: Duration::from_secs(20),
        ..LinkOptions::default()
    };
    let listen = |runtime: &tokio::runtime::Runtime, addr: &str| {
        let _inside = runtime.enter();
        Server::start_at(addr, Arc::clone(&router), options.clone())
    };
    let runtime =
        || tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    let first = runtime();
    let server = listen(&first, &format!("{scheme}://127.0.0.1:0"));
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options.clone(), Arc::default());
    let link = soon(dialer.dial(&server.url)).await.unwrap();
    // Ends all its tasks between two polls, as a kill would: no one says goodbye.
    let killed = tokio::task::spawn_blocking(move || first.shutdown_timeout(Duration::from_secs(5)));
    soon(killed).await.unwrap();
    let url = server.url.to_string();
    drop(server); // and with it the last hold on the socket
    let second = runtime();
    let _restarted = listen(&second, &url);
    let error = soon(link.closed()).await;
    // The kernel's error for a connection whose program is gone does not tell whether another took its place.
    if is_tcp(scheme) {
        assert!(matches!(error, LinkError::Cut), "{error}");
        return second.shutdown_background();
    }
    assert!(matches!(error, LinkError::PeerRestarted), "{error}");
    second.shutdown_background();

    let quick = LinkOptions { idle_timeout: Duration::from_millis(500), ..options.clone() };
    let third = runtime();
    let server = listen(&third, &format!("{scheme}://127.0.0.1:0"));
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), quick, Arc::default());
    let link = soon(dialer.dial(&server.url)).await.unwrap();
    let killed = tokio::task::spawn_blocking(move || third.shutdown_timeout(Duration::from_secs(5)));
    soon(killed).await.unwrap();
    let error = soon(link.closed()).await;
    assert!(matches!(error, LinkError::TimedOut { .. }), "{error}");
}
