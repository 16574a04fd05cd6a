//! Peers of QUIC links that misbehave, played by bare quinn. `conformance` tests the links' promises to their users.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod support;

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use quinn::{ConnectionError, VarInt};
use sgc_transport::*;
use sgc_trust::CertError;
use sgc_wire::{DecodeError, Encode, LaneToken};
use support::*;

// Destinations of links.

#[tokio::test]
async fn a_link_moves_to_a_fresh_socket_and_loses_nothing() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    let dialer = dialer(enroll(&fleet, "arm-1"));
    // Nothing to move yet.
    dialer.rebind().unwrap();
    let near = dial_with(&dialer, &server.url).await.unwrap();
    let far = server.link().await;
    let before = far.remote();
    for seq in 0..3u8 {
        dialer.rebind().unwrap();
        near.send_control(Bytes::from(vec![seq])).await.unwrap();
        assert_eq!(soon(far.recv_control()).await.unwrap(), [seq].as_slice());
        far.send_control(Bytes::from(vec![seq])).await.unwrap();
        assert_eq!(soon(near.recv_control()).await.unwrap(), [seq].as_slice());
    }
    assert_ne!(far.remote(), before);
}

// Admission.

#[tokio::test]
async fn a_dialer_without_a_certificate_is_refused() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    if let Ok(connection) = bare(server.addr, None, "sgc/1").await {
        soon(connection.closed()).await;
    }
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::NoCertificate)), "{refused}");
    assert_eq!(server.metrics.refused(RefusalKind::NoCertificate), 1);
}

#[tokio::test]
async fn other_versions_are_refused() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    bare(server.addr, Some(&arm), "sgc/2").await.unwrap_err();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Version(_)), "{refused}");
    let greet = async |greeting: &[u8]| {
        let connection = bare(server.addr, Some(&arm), "sgc/1").await.unwrap();
        let (mut tx, _rx) = connection.open_bi().await.unwrap();
        tx.write_all(greeting).await.unwrap();
        soon(connection.closed()).await
    };
    let ConnectionError::ApplicationClosed(closed) = greet(&frame(&[0, 2])).await else { panic!() };
    assert_eq!(closed.error_code, VarInt::from_u32(2));
    assert!(String::from_utf8_lossy(&closed.reason).contains("version 2"), "{closed}");
    greet(&frame(b"GET / HTTP/1.1")).await;
    greet(&[0xff; 8]).await;
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Version(_)), "{refused}");
    let refused = server.refusal().await;
    // "GE" is a version, too.
    assert!(matches!(refused.reason, Refusal::Version(_)), "{refused}");
    let refused = server.refusal().await;
    let Refusal::Greeting(ProtocolError::ControlFrameTooLong { bytes }) = refused.reason else { panic!() };
    assert_eq!(bytes, u64::from(u32::MAX));
    assert_eq!(server.metrics.refused(RefusalKind::Version), 3);
    assert_eq!(server.metrics.refused(RefusalKind::BadGreeting), 1);
}

#[tokio::test]
async fn a_handshake_that_never_ends_holds_up_no_one() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let after = Duration::from_millis(1500);
    let options = LinkOptions { handshake_timeout: after, ..LinkOptions::default() };
    let mut server = Server::start(enroll(&fleet, "router"), options);
    let started = Instant::now();
    let mut silent = Vec::new();
    for _ in 0..10 {
        silent.push(bare(server.addr, Some(&arm), "sgc/1").await.unwrap());
    }
    assert_eq!(server.metrics.handshakes_pending(), 10);
    let _near = dial(Arc::clone(&arm), &server.url).await.unwrap();
    server.link().await;
    assert!(started.elapsed() < after, "the others were waited for");
    for _ in 0..10 {
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::TimedOut { .. }), "{refused}");
    }
    assert_eq!(server.metrics.refused(RefusalKind::TimedOut), 10);
    assert_eq!(server.metrics.handshakes_pending(), 0);
}

#[tokio::test]
async fn too_many_handshakes_are_refused_and_reported() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let options = LinkOptions { handshakes_max: 2, handshakes_unvalidated_max: 1, ..LinkOptions::default() };
    let mut server = Server::start(enroll(&fleet, "router"), options);
    // Two hold the places for a second at least; on a machine that takes longer, two others do.
    let held = loop {
        let first = bare(server.addr, Some(&arm), "sgc/1").await.unwrap();
        // This one has to prove its address first.
        let second = bare(server.addr, Some(&arm), "sgc/1").await.unwrap();
        match dial(Arc::clone(&arm), &server.url).await {
            Err(LinkError::RefusedByPeer(PeerRefusal::Overloaded)) => break (first, second),
            Err(error) => panic!("{error}"),
            Ok(_) => drop((first, second)),
        }
    };
    let refused = loop {
        if let Err(refused) = soon(server.results.recv()).await.unwrap()
            && !matches!(refused.reason, Refusal::ByPeer(_))
        {
            break refused;
        }
    };
    assert!(matches!(refused.reason, Refusal::TooMany { pending: 2, .. }), "{refused}");
    assert!(server.metrics.refused(RefusalKind::TooMany) >= 1);
    drop(held);
    soon(async {
        while server.metrics.handshakes_pending() > 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
    let accepted = server.metrics.accepted();
    let _near = dial(arm, &server.url).await.unwrap();
    assert!(server.metrics.accepted() > accepted);
}

// Control.

#[tokio::test]
async fn an_oversized_control_frame_ends_the_link_and_says_so() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    let (connection, mut tx, link) = greeted(&mut server, &enroll(&fleet, "arm-1")).await;
    tx.write_all(&(CONTROL_FRAME_BYTES_MAX as u32 + 1).to_be_bytes()).await.unwrap();
    let expected = ProtocolError::ControlFrameTooLong { bytes: CONTROL_FRAME_BYTES_MAX as u64 + 1 };
    for error in [soon(link.recv_control()).await.unwrap_err(), soon(link.closed()).await] {
        assert!(matches!(error, LinkError::Protocol(e) if e == expected));
    }
    let ConnectionError::ApplicationClosed(closed) = soon(connection.closed()).await else { panic!() };
    assert!(String::from_utf8_lossy(&closed.reason).contains("1048577"), "{closed}");
}

#[tokio::test]
async fn a_control_stream_that_ends_ends_the_link() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    let (connection, mut tx, link) = greeted(&mut server, &enroll(&fleet, "arm-1")).await;
    tx.finish().unwrap();
    let error = soon(link.recv_control()).await.unwrap_err();
    assert!(matches!(error, LinkError::Protocol(ProtocolError::ControlEnded)), "{error}");
    soon(connection.closed()).await;
}

// Flows.

#[tokio::test]
async fn malformed_flows_end_alone() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    let (connection, mut control, link) = greeted(&mut server, &enroll(&fleet, "arm-1")).await;
    let good = packet(1, Bytes::from_static(b"x"));
    let mut header = good.header.to_vec();
    header[0] = 0xf0;
    let oversized = (FLOW_PACKET_BYTES_MAX as u32 + 1).to_be_bytes();
    let cases: [(Vec<u8>, u32); 4] = [
        (vec![9], 2),
        ([&[1][..], &oversized].concat(), 1),
        ([&[1][..], &frame(&header)].concat(), 2),
        ([&[1][..], &frame(&[0x10])].concat(), 1),
    ];
    for (index, (bytes, code)) in cases.into_iter().enumerate() {
        let mut tx = connection.open_uni().await.unwrap();
        tx.write_all(&bytes).await.unwrap();
        let mut flow = soon(link.accept_flow()).await.unwrap();
        let error = soon(flow.recv()).await.unwrap_err();
        match index {
            0 => assert!(matches!(error, FlowError::Version { found: 9 })),
            1 => assert!(matches!(error, FlowError::PacketTooLong { .. })),
            2 => assert!(matches!(error, FlowError::Packet(DecodeError::Version { found: 0xf0, .. }))),
            _ => assert!(matches!(error, FlowError::Packet(DecodeError::Truncated { .. }))),
        }
        assert!(soon(flow.recv()).await.unwrap().is_none());
        assert_eq!(soon(tx.stopped()).await.unwrap(), Some(VarInt::from_u32(code)));
    }
    let mut cut = connection.open_uni().await.unwrap();
    cut.write_all(&[1, 0, 0, 0, 99, 1]).await.unwrap();
    cut.finish().unwrap();
    let mut flow = soon(link.accept_flow()).await.unwrap();
    assert!(matches!(soon(flow.recv()).await, Err(FlowError::Truncated)));
    control.write_all(&frame(b"alive")).await.unwrap();
    assert_eq!(soon(link.recv_control()).await.unwrap(), "alive");
}

#[tokio::test]
async fn a_malformed_datagram_is_dropped_alone() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), LinkOptions::default());
    let (connection, _control, link) = greeted(&mut server, &enroll(&fleet, "arm-1")).await;
    let mut bytes = packet(1, Bytes::new()).header.to_vec();
    for (first, cut) in [(0x20, 0), (0x10, 5)] {
        bytes[0] = first;
        connection.send_datagram(Bytes::copy_from_slice(&bytes[..bytes.len() - cut])).unwrap();
    }
    connection.send_datagram(Bytes::copy_from_slice(&bytes)).unwrap();
    let mut results = Vec::new();
    for _ in 0..3 {
        results.push(soon(link.recv_datagram()).await.unwrap());
    }
    assert!(matches!(results[0], ReceivedDatagram::Malformed(DecodeError::Version { found: 0x20, .. })));
    assert!(matches!(results[1], ReceivedDatagram::Malformed(DecodeError::Truncated { .. })));
    assert!(matches!(results[2], ReceivedDatagram::Packet(_)));
}

#[tokio::test]
async fn only_lanes_are_taken_at_the_tcp_port_of_a_quic_listener() {
    let fleet = fleet(1);
    let options = LinkOptions { bulk_lanes: BulkLanes::Own, ..LinkOptions::default() };
    let mut server = Server::start_on("quic", enroll(&fleet, "router"), options.clone());
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    let near = soon(dialer.dial(&server.url)).await.unwrap();
    let far = server.link().await;
    assert!(near.has_bulk_lanes() && far.has_bulk_lanes());
    let token = LaneToken([7; 16]);
    let lane = soon(dialer.dial_bulk_lane(server.addr, token)).await.unwrap();
    let taken = server.link().await;
    assert_eq!((taken.lane(), taken.peer().node_id), (Some(token), far.peer().node_id));
    assert!(!lane.has_bulk_lanes(), "a lane has no lanes");
    let by_tls = format!("tls://{}", server.addr).parse().unwrap();
    let link = soon(dialer.dial(&by_tls)).await;
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::NoLane), "{refused}");
    if let Ok(link) = link {
        let end = soon(link.closed()).await;
        assert!(matches!(end, LinkError::Closed { reason: CloseReason::Denied(_), .. }), "{end}");
    }
    assert_eq!(server.metrics.refused(RefusalKind::NoLane), 1);
}

#[tokio::test]
async fn nodes_without_bulk_lanes_announce_none() {
    let fleet = fleet(1);
    let with = LinkOptions { bulk_lanes: BulkLanes::Own, ..LinkOptions::default() };
    for (at_listener, at_dialer) in [(LinkOptions::default(), with.clone()), (with, LinkOptions::default())] {
        let is_on = |options: &LinkOptions| options.bulk_lanes != BulkLanes::Off;
        let expected = (is_on(&at_listener), is_on(&at_dialer));
        let mut server = Server::start_on("quic", enroll(&fleet, "router"), at_listener);
        let dialer = Dialer::new(enroll(&fleet, "arm-1"), at_dialer, Arc::default());
        let near = soon(dialer.dial(&server.url)).await.unwrap();
        let far = server.link().await;
        assert_eq!((near.has_bulk_lanes(), far.has_bulk_lanes()), expected);
    }
}
