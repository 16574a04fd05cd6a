//! Peers of stream links that misbehave, played by bare TLS, and bad paths. `conformance` tests the links' promises to
//! their users.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod support;

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};
use std::time::Duration;

use bytes::Bytes;
use rustls::sign::SingleCertAndKey;
use sgc_transport::*;
use sgc_trust::{CertError, Identity};
use sgc_wire::Class;
use support::*;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpListener, TcpStream};
use tokio_rustls::client::TlsStream;
use tokio_rustls::{TlsAcceptor, TlsConnector};

/// A bare TLS connection, as yet without greeting.
async fn bare_stream(
    addr: SocketAddr,
    identity: Option<&Identity>,
    alpn: &str,
) -> io::Result<TlsStream<TcpStream>> {
    let mut config = bare_tls(identity, alpn, None);
    config.alpn_protocols.retain(|alpn| !alpn.is_empty());
    let tcp = TcpStream::connect(addr).await?;
    TlsConnector::from(Arc::new(config)).connect("x.invalid".try_into().unwrap(), tcp).await
}

const SETTINGS: [u8; 13] = [0, 0x80, 1, 0, 0, 0x80, 1, 0, 0, 0x80, 0, 1, 0];

/// A bare connection that has sent greeting and settings, and the link at the listener. The listener's settings are
/// read; its later bytes come next.
async fn greeted_stream(server: &mut Server, identity: &Identity) -> (TlsStream<TcpStream>, AnyLink) {
    let mut tls = bare_stream(server.addr, Some(identity), "sgc-tls/1").await.unwrap();
    tls.write_all(&frame(&GREETING)).await.unwrap();
    let mut answer = [0; 10];
    soon(tls.read_exact(&mut answer)).await.unwrap();
    assert_eq!(answer[..], frame(&GREETING));
    tls.write_all(&SETTINGS).await.unwrap();
    (tls, server.link().await)
}

/// Reads everything until the far side ends the connection.
async fn rest(tls: &mut TlsStream<TcpStream>) -> Vec<u8> {
    let mut all = Vec::new();
    // It ends in one way or another.
    let _ = soon(tls.read_to_end(&mut all)).await;
    all
}

fn contains(haystack: &[u8], needle: &[u8]) -> bool {
    haystack.windows(needle.len()).any(|w| w == needle)
}

// Admission.

#[tokio::test]
async fn a_dialer_without_a_certificate_is_refused() {
    let fleet = fleet(1);
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), LinkOptions::default());
    if let Ok(mut tls) = bare_stream(server.addr, None, "sgc-tls/1").await {
        rest(&mut tls).await;
    }
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::NoCertificate)), "{refused}");
    assert_eq!(server.metrics.refused(RefusalKind::NoCertificate), 1);
}

#[tokio::test]
async fn other_versions_and_protocols_are_refused() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), LinkOptions::default());
    for alpn in ["sgc-tls/2", "sgc-tcp/1", "http/1.1", ""] {
        if let Ok(mut tls) = bare_stream(server.addr, Some(&arm), alpn).await {
            rest(&mut tls).await;
        }
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::Version(_)), "{alpn:?}: {refused}");
    }
    let mut web = TcpStream::connect(server.addr).await.unwrap();
    web.write_all(b"GET / HTTP/1.1\r\n\r\n").await.unwrap();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Version(_)), "{refused}");
    for (greeting, is_version) in
        [(frame(&[0, 2]), true), (frame(b"GET / HTTP/1.1"), true), (vec![0xff; 8], false)]
    {
        let mut tls = bare_stream(server.addr, Some(&arm), "sgc-tls/1").await.unwrap();
        tls.write_all(&greeting).await.unwrap();
        let said = rest(&mut tls).await;
        let refused = server.refusal().await;
        if is_version {
            assert_eq!(said, frame(&GREETING), "it says what it speaks");
            assert!(matches!(refused.reason, Refusal::Version(_)), "{refused}");
        } else {
            let Refusal::Greeting(ProtocolError::ControlFrameTooLong { bytes }) = refused.reason else {
                panic!()
            };
            assert_eq!(bytes, u64::from(u32::MAX));
        }
    }
    assert_eq!(server.metrics.refused(RefusalKind::Version), 7);
    assert_eq!(server.metrics.refused(RefusalKind::BadGreeting), 1);
}

#[tokio::test]
async fn packets_can_be_marked_in_both_families() {
    let fleet = fleet(1);
    let marked = |dscp| LinkOptions { dscp: Some(dscp), ..LinkOptions::default() };
    for host in ["127.0.0.1", "[::1]"] {
        let addr = format!("tls://{host}:0");
        let mut server = Server::start_at(&addr, enroll(&fleet, "router"), marked(46));
        let dialer = Dialer::new(enroll(&fleet, "arm-1"), marked(46), Arc::default());
        let _near = soon(dialer.dial(&server.url)).await.unwrap();
        server.link().await;
        let wrong = Dialer::new(enroll(&fleet, "arm-1"), marked(64), Arc::default());
        assert!(soon(wrong.dial(&server.url)).await.is_err());
    }
}

#[tokio::test]
async fn nobody_can_be_talked_into_another_scheme() {
    let fleet = fleet(1);
    for (listens, dials) in [("tls", "tcp"), ("tcp", "tls"), ("ws", "tls"), ("tls", "ws"), ("wss", "tls")] {
        let mut server = Server::start_on(listens, enroll(&fleet, "router"), LinkOptions::default());
        let url = server.url.to_string().replacen(listens, dials, 1).parse().unwrap();
        let error = dial(enroll(&fleet, "arm-1"), &url).await.unwrap_err();
        assert!(matches!(error, LinkError::RefusedByPeer(_)), "{dials} to {listens}: {error}");
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::Version(_)), "{dials} to {listens}: {refused}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_thousand_silent_connections_keep_nobody_out() {
    const PLACES: usize = 64;
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let options = LinkOptions { handshakes_max: PLACES, ..LinkOptions::default() };
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), options);
    let mut silent = Vec::new();
    for count in 0..1000 {
        silent.push(soon(TcpStream::connect(server.addr)).await.unwrap());
        if count % 500 == 499 {
            // Each refusal is reported, and has to be taken.
            let (arm, url) = (Arc::clone(&arm), server.url.clone());
            let near = tokio::spawn(async move { dial(arm, &url).await.unwrap() });
            loop {
                match soon(server.results.recv()).await.unwrap() {
                    Ok(_link) => break,
                    Err(refused) => {
                        assert!(matches!(refused.reason, Refusal::TooManyFromAddress { .. }), "{refused}");
                    }
                }
            }
            drop(near.await.unwrap());
        }
    }
    // Each refusal is reported or counted, and none is kept beyond the number of places.
    assert!(server.metrics.handshakes_pending() <= PLACES as u64 + 1);
    assert!(server.metrics.refused(RefusalKind::TooManyFromAddress) >= 1000 - 2 * PLACES as u64);
    let mut ended = 0;
    for tcp in &mut silent[..1000 - 2 * PLACES] {
        // The kernel decides which error ends it.
        let _ = soon(tcp.read(&mut [0])).await;
        ended += 1;
    }
    assert_eq!(ended, 1000 - 2 * PLACES);
}

#[tokio::test]
async fn a_listener_that_is_full_says_so() {
    for scheme in ["tls", "ws"] {
        let fleet = fleet(1);
        let arm = enroll(&fleet, "arm-1");
        let options = LinkOptions { handshakes_max: 2, ..LinkOptions::default() };
        let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options);
        let mut begun = Vec::new();
        let begin = async || {
            let mut tcp = TcpStream::connect(server.addr).await.unwrap();
            let start: &[u8] = if scheme == "ws" { b"GET /sgc" } else { &[22, 3, 1] };
            tcp.write_all(start).await.unwrap();
            tcp
        };
        for _ in 0..2 {
            begun.push(begin().await);
        }
        let error = loop {
            // The two may not have been heard yet, or are old, and the first of them gives way.
            match dial(Arc::clone(&arm), &server.url).await {
                Err(error) => break error,
                Ok(_) => begun.push(begin().await),
            }
        };
        let LinkError::RefusedByPeer(why) = &error else { panic!("{error}") };
        assert!(matches!(why, PeerRefusal::Overloaded | PeerRefusal::GaveUp), "{error}");
        assert!(server.metrics.refused(RefusalKind::TooMany) >= 1);
        while let Ok(result) = server.results.try_recv() {
            drop(result);
        }
    }
}

#[tokio::test]
async fn a_handshake_that_is_dragged_out_ends() {
    let fleet = fleet(1);
    let after = Duration::from_millis(300);
    let options = LinkOptions { handshake_timeout: after, ..LinkOptions::default() };
    for (scheme, start) in
        [("tls", &[22u8, 3, 1, 2][..]), ("ws", b"GET /sgc HTTP/1.1\r\nX: "), ("wss", &[22])]
    {
        let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options.clone());
        let mut tcp = TcpStream::connect(server.addr).await.unwrap();
        tcp.write_all(start).await.unwrap();
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::TimedOut { .. }), "{scheme}: {refused}");
        assert_eq!(server.metrics.handshakes_pending(), 0);
    }
}

#[tokio::test]
async fn a_request_for_something_else_gets_404_and_is_named() {
    let fleet = fleet(1);
    let mut server =
        Server::start_at("ws://127.0.0.1:0/robots", enroll(&fleet, "router"), LinkOptions::default());
    let mut tcp = TcpStream::connect(server.addr).await.unwrap();
    tcp.write_all(b"GET /index.html HTTP/1.1\r\nHost: x\r\n\r\n").await.unwrap();
    let mut said = String::new();
    soon(tcp.read_to_string(&mut said)).await.unwrap();
    assert!(said.starts_with("HTTP/1.1 404 "), "{said}");
    drop(tcp);
    let refused = server.refusal().await;
    assert!(
        refused.to_string().contains("/index.html") && refused.to_string().contains("/robots"),
        "{refused}"
    );
    let url = format!("ws://{}/sgc", server.addr).parse().unwrap();
    let error = dial(enroll(&fleet, "arm-1"), &url).await.unwrap_err();
    assert!(error.to_string().contains("404"), "{error}");
    server.refusal().await;
    let _near = dial(enroll(&fleet, "arm-1"), &server.url).await.unwrap();
    server.link().await;
}

// Frames.

#[tokio::test]
async fn breaking_the_rules_of_frames_ends_the_link_and_says_so() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let options = LinkOptions { flow_window_bytes: 4, flows_max: 2, ..LinkOptions::default() };
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), options);
    let cases: [(&[u8], StreamViolation); 15] = [
        (&[99], StreamViolation::FrameType(99)),
        (&SETTINGS, StreamViolation::Settings),
        (&[1, 2, 1, 0], StreamViolation::Flow(2)),
        (&[1, 1, 1, 0, 2, 1, 1, 1, 1, 0], StreamViolation::Flow(1)),
        (&[3, 1, 0, 2, 1], StreamViolation::Flow(1)),
        (&[1, 1, 5], StreamViolation::Credit(1)),
        (&[1, 1, 4, 0, 0, 0, 0, 1, 1, 1, 0], StreamViolation::Credit(1)),
        (&[2, 1, 2, 2, 2, 3], StreamViolation::TooManyFlows(3)),
        (&[11, 0x7f, 0xff], StreamViolation::Pong),
        (&[8, 1], StreamViolation::Flow(1)),
        (&[4, 1, 0], StreamViolation::Flow(1)),
        (&[5, 1, 9], StreamViolation::Flow(1)),
        (&[2, 0], StreamViolation::Flow(0)),
        (&[1, 1, 0], StreamViolation::Length { what: "piece", bytes: 0, max: 16 << 10 }),
        (&[9, 0x80, 0, 0x40, 1], StreamViolation::Length { what: "datagram", bytes: 16_385, max: 16 << 10 }),
    ];
    for (bytes, violation) in cases {
        let (mut tls, link) = greeted_stream(&mut server, &arm).await;
        tls.write_all(bytes).await.unwrap();
        let error = soon(link.closed()).await;
        let expected = ProtocolError::Stream(violation);
        assert!(matches!(&error, LinkError::Protocol(e) if *e == expected), "{bytes:?}: {error}");
        let said = rest(&mut tls).await;
        assert!(contains(&said, &[12, 2]) && contains(&said, expected.to_string().as_bytes()), "{bytes:?}");
    }
    let mut tls = bare_stream(server.addr, Some(&arm), "sgc-tls/1").await.unwrap();
    tls.write_all(&[&frame(&GREETING)[..], &[10, 1]].concat()).await.unwrap();
    let error = soon(server.link().await.closed()).await;
    let expected = ProtocolError::Stream(StreamViolation::Settings);
    assert!(matches!(&error, LinkError::Protocol(e) if *e == expected), "{error}");
}

#[tokio::test]
async fn an_oversized_control_frame_ends_the_link() {
    let fleet = fleet(1);
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), LinkOptions::default());
    let (mut tls, link) = greeted_stream(&mut server, &enroll(&fleet, "arm-1")).await;
    let length = (CONTROL_FRAME_BYTES_MAX as u32 + 1).to_be_bytes();
    tls.write_all(&[&[1, 0, 4], &length[..]].concat()).await.unwrap();
    let error = soon(link.recv_control()).await.unwrap_err();
    let expected = ProtocolError::ControlFrameTooLong { bytes: CONTROL_FRAME_BYTES_MAX as u64 + 1 };
    assert!(matches!(&error, LinkError::Protocol(e) if *e == expected), "{error}");
    assert!(contains(&rest(&mut tls).await, b"1048577"));
}

#[tokio::test]
async fn malformed_flows_and_datagrams_end_alone() {
    let fleet = fleet(1);
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), LinkOptions::default());
    let (mut tls, link) = greeted_stream(&mut server, &enroll(&fleet, "arm-1")).await;
    tls.write_all(&[1, 1, 1, 9]).await.unwrap();
    let mut flow = soon(link.accept_flow()).await.unwrap();
    assert!(matches!(soon(flow.recv()).await, Err(FlowError::Version { found: 9 })));
    tls.write_all(&[&[1, 2, 6, 1, 0, 0, 0, 99, 7, 2, 2][..], &[9, 1, 0x20]].concat()).await.unwrap();
    let mut flow = soon(link.accept_flow()).await.unwrap();
    assert!(matches!(soon(flow.recv()).await, Err(FlowError::Truncated)));
    assert!(soon(link.recv_datagram()).await.unwrap().packet().is_none());
    tls.write_all(&[&[1, 0, 9], &frame(b"alive")[..]].concat()).await.unwrap();
    assert_eq!(soon(link.recv_control()).await.unwrap(), "alive");
    // The first flow was stopped with the code for its version, the second had arrived.
    link.close(CloseReason::Goodbye);
    let said = rest(&mut tls).await;
    assert!(contains(&said, &[4, 1, 2]) && contains(&said, &[8, 2]), "{said:?}");
}

// Peers and paths that stall.

#[tokio::test]
async fn a_peer_that_reads_nothing_is_left_and_harms_nobody() {
    let fleet = fleet(1);
    let options = LinkOptions {
        keep_alive: Duration::from_millis(100),
        idle_timeout: Duration::from_millis(1500),
        send_window_bytes: 256 << 10,
        ..LinkOptions::default()
    };
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), options);
    let (_tls, stalled) = greeted_stream(&mut server, &enroll(&fleet, "arm-1")).await;
    let near = dial(enroll(&fleet, "arm-2"), &server.url).await.unwrap();
    let far = server.link().await;
    let mut flow = stalled.open_flow(Class::Bulk).await.unwrap();
    let full = packet_of(Class::Bulk, 1, Bytes::from(vec![0; 16 << 10]));
    let mut sent = 0;
    let error = loop {
        match soon(flow.send(&full)).await {
            Ok(()) => sent += 16 << 10,
            Err(error) => break error,
        }
    };
    assert!(matches!(error, LinkError::TimedOut { .. }), "{error}");
    // A peer that reads nothing blocks only the bytes in flight and those that may wait.
    assert!(sent <= 1 << 20, "{sent}");
    far.send_control("x".into()).await.unwrap();
    assert_eq!(soon(near.recv_control()).await.unwrap(), "x");
}

/// A TCP relay: so many bytes a millisecond, and none while it is cut.
struct Relay {
    addr: SocketAddr,
    seen: Arc<std::sync::Mutex<Vec<u8>>>,
    is_cut: Arc<AtomicBool>,
}

async fn relay(to: SocketAddr, bytes_per_ms: usize) -> Relay {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let addr = listener.local_addr().unwrap();
    let (seen, is_cut) = (Arc::<std::sync::Mutex<Vec<u8>>>::default(), Arc::<AtomicBool>::default());
    let (all, cut) = (Arc::clone(&seen), Arc::clone(&is_cut));
    tokio::spawn(async move {
        while let Ok((near, _)) = listener.accept().await {
            let far = TcpStream::connect(to).await.unwrap();
            near.set_nodelay(true).unwrap();
            far.set_nodelay(true).unwrap();
            let ((near_rx, near_tx), (far_rx, far_tx)) = (near.into_split(), far.into_split());
            for (mut rx, mut tx) in [(near_rx, far_tx), (far_rx, near_tx)] {
                let (all, cut) = (Arc::clone(&all), Arc::clone(&cut));
                tokio::spawn(async move {
                    let mut buffer = vec![0; bytes_per_ms];
                    let mut pace = tokio::time::interval(Duration::from_millis(1));
                    loop {
                        pace.tick().await;
                        let Ok(n @ 1..) = rx.read(&mut buffer).await else { return };
                        while cut.load(SeqCst) {
                            pace.tick().await;
                        }
                        all.lock().unwrap().extend_from_slice(&buffer[..n]);
                        if tx.write_all(&buffer[..n]).await.is_err() {
                            return;
                        }
                    }
                });
            }
        }
    });
    Relay { addr, seen, is_cut }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_urgent_packet_overtakes_an_image_on_a_slow_path() {
    for scheme in ["tls", "tcp", "ws"] {
        let fleet = fleet(1);
        let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
        let relay = relay(server.addr, 8 << 10).await;
        let url = format!("{scheme}://{}", relay.addr).parse().unwrap();
        let near = dial(enroll(&fleet, "arm-1"), &url).await.unwrap();
        let far = server.link().await;
        let sender = near.clone();
        let image = tokio::spawn(async move {
            let mut flow = sender.open_flow(Class::Bulk).await.unwrap();
            for seq in 0..320 {
                flow.send(&packet_of(Class::Bulk, seq, Bytes::from(vec![7; 16 << 10]))).await.unwrap();
            }
            flow.finish().await.unwrap();
        });
        let mut bulk = soon(far.accept_flow()).await.unwrap();
        let received = Arc::<AtomicUsize>::default();
        let count = Arc::clone(&received);
        let reader = tokio::spawn(async move {
            while let Some(got) = bulk.recv().await.unwrap() {
                count.fetch_add(got.payload.len(), SeqCst);
            }
        });
        // The image is well under way.
        soon(async {
            while received.load(SeqCst) < 1 << 20 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let before = received.load(SeqCst);
        let mut urgent = near.open_flow(Class::Realtime).await.unwrap();
        urgent.send(&packet_of(Class::Realtime, 1, Bytes::from_static(b"stop"))).await.unwrap();
        near.send_datagram(&packet_of(Class::Realtime, 2, Bytes::from_static(b"now"))).await.unwrap();
        soon(far.recv_datagram()).await.unwrap().packet().unwrap();
        let mut flow = soon(far.accept_flow()).await.unwrap();
        soon(flow.recv()).await.unwrap().unwrap();
        let between = received.load(SeqCst) - before;
        assert!(between < 1 << 20, "{scheme}: {between} bytes of the image came first");
        soon(image).await.unwrap();
        soon(reader).await.unwrap();
        assert_eq!(received.load(SeqCst), 320 * (16 << 10));
    }
}

#[tokio::test]
async fn a_path_that_falls_silent_ends_the_link_in_time() {
    let fleet = fleet(1);
    let mut server = Server::start_on("tls", enroll(&fleet, "router"), LinkOptions::default());
    let relay = relay(server.addr, 64 << 10).await;
    let options = LinkOptions {
        keep_alive: Duration::from_millis(100),
        idle_timeout: Duration::from_millis(600),
        ..LinkOptions::default()
    };
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    let near = soon(dialer.dial(&format!("tls://{}", relay.addr).parse().unwrap())).await.unwrap();
    let _far = server.link().await;
    relay.is_cut.store(true, SeqCst);
    let error = soon(near.closed()).await;
    assert!(matches!(error, LinkError::TimedOut { .. }), "{error}");
}

#[tokio::test]
async fn only_requested_links_are_in_the_clear() {
    for (scheme, is_clear) in [("tcp", true), ("tls", false), ("ws", false), ("wss", false)] {
        let fleet = fleet(1);
        let mut server = Server::start_on(scheme, enroll(&fleet, "router"), LinkOptions::default());
        let relay = relay(server.addr, 64 << 10).await;
        let url = format!("{scheme}://{}", relay.addr).parse().unwrap();
        let near = dial(enroll(&fleet, "arm-1"), &url).await.unwrap();
        let far = server.link().await;
        for (from, to, text) in [(&near, &far, "from the dialer"), (&far, &near, "from the listener")] {
            from.send_control(text.into()).await.unwrap();
            assert_eq!(soon(to.recv_control()).await.unwrap(), text);
            let seen = relay.seen.lock().unwrap().clone();
            assert_eq!(contains(&seen, text.as_bytes()), is_clear, "{scheme}");
        }
    }
}

#[tokio::test]
async fn a_web_proxy_that_ends_the_tls_outside_passes_links_on_and_nothing_else() {
    let (ours, other) = (fleet(1), fleet(2));
    let mut server = Server::start_on("ws", enroll(&ours, "router"), LinkOptions::default());
    // Its certificate is of no known CA.
    let proxy = enroll(&other, "proxy");
    let tls =
        rustls::ServerConfig::builder_with_provider(Arc::new(rustls::crypto::aws_lc_rs::default_provider()))
            .with_safe_default_protocol_versions()
            .unwrap()
            .with_no_client_auth()
            .with_cert_resolver(Arc::new(SingleCertAndKey::from(proxy.certified_key())));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let (url, to) = (format!("wss://localhost:{}", listener.local_addr().unwrap().port()), server.addr);
    let (names_tx, mut names) = tokio::sync::mpsc::channel(4);
    tokio::spawn(async move {
        let acceptor = TlsAcceptor::from(Arc::new(tls));
        while let Ok((tcp, _)) = listener.accept().await {
            let mut outer = acceptor.accept(tcp).await.unwrap();
            names_tx.send(outer.get_ref().1.server_name().map(str::to_owned)).await.unwrap();
            let mut inner = TcpStream::connect(to).await.unwrap();
            tokio::spawn(async move { tokio::io::copy_bidirectional(&mut outer, &mut inner).await });
        }
    });
    let near = dial(enroll(&ours, "arm-1"), &url.parse().unwrap()).await.unwrap();
    let far = server.link().await;
    assert_eq!(soon(names.recv()).await.unwrap().as_deref(), Some("localhost"));
    assert_eq!(near.peer().node_id, enroll(&ours, "router").node_id());
    near.send_control("through".into()).await.unwrap();
    assert_eq!(soon(far.recv_control()).await.unwrap(), "through");
}

/// A relay between two ends of TCP whose owner decides, piece by piece, which bytes reach the listener.
struct Interceptor {
    /// The bytes that the dialer sent.
    sent: tokio::sync::mpsc::Receiver<Vec<u8>>,
    /// The way to the listener.
    to_listener: tokio::net::tcp::OwnedWriteHalf,
}

impl Interceptor {
    /// Lets one dialer through until `made`, and then passes its bytes to the owner.
    async fn dial(scheme: &str, server: &mut Server, identity: Arc<Identity>) -> (Self, AnyLink, AnyLink) {
        let front = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let addr = front.local_addr().unwrap();
        let (pass, passes) = tokio::sync::watch::channel(true);
        let (tx, sent) = tokio::sync::mpsc::channel(64);
        let listener = server.addr;
        let relay = tokio::spawn(async move {
            let (dialer, _) = front.accept().await.unwrap();
            let (mut from_dialer, mut to_dialer) = dialer.into_split();
            let (mut from_listener, mut to_listener) =
                TcpStream::connect(listener).await.unwrap().into_split();
            tokio::spawn(async move { tokio::io::copy(&mut from_listener, &mut to_dialer).await });
            let mut passes = passes;
            let mut buffer = vec![0; 64 << 10];
            while *passes.borrow() {
                tokio::select! {
                    n = from_dialer.read(&mut buffer) => to_listener.write_all(&buffer[..n.unwrap()]).await.unwrap(),
                    _ = passes.changed() => {}
                }
            }
            tokio::spawn(async move {
                while let Ok(n @ 1..) = from_dialer.read(&mut buffer).await {
                    if tx.send(buffer[..n].to_vec()).await.is_err() {
                        return;
                    }
                }
            });
            to_listener
        });
        let url = format!("{scheme}://{addr}").parse().unwrap();
        let near = dial(identity, &url).await.unwrap();
        let far = server.link().await;
        // The greetings of both are through.
        for (from, to) in [(&near, &far), (&far, &near)] {
            from.send_control("ready".into()).await.unwrap();
            assert_eq!(soon(to.recv_control()).await.unwrap(), "ready");
        }
        pass.send_replace(false);
        let to_listener = soon(relay).await.unwrap();
        (Self { sent, to_listener }, near, far)
    }

    /// Returns the dialer's bytes up to and with this text.
    async fn wait_for(&mut self, text: &[u8]) -> Vec<u8> {
        let mut all = Vec::new();
        while !contains(&all, text) {
            all.extend(soon(self.sent.recv()).await.unwrap());
        }
        all
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nobody_between_two_ends_of_tcp_alters_injects_or_repeats_anything() {
    /// Alters the dialer's bytes as an attacker does, given the position of a control frame in them.
    type Attack = fn(&[u8], usize) -> Vec<u8>;
    let attacks: [(&str, Attack); 5] = [
        ("alters a control frame", |sent, at| {
            let mut altered = sent.to_vec();
            altered[at] ^= 1;
            altered
        }),
        ("closes the link in the name of the peer", |_, _| [&[12, 0, 0][..], &[0; 4096]].concat()),
        ("leaves bytes out", |sent, at| [&sent[..at], &sent[at + 1..], sent].concat()),
        ("repeats what was sent", |sent, _| [sent, sent].concat()),
        ("sends a control frame of its own", |sent, _| {
            [sent, &[1, 0, 9], &frame(b"leave"), &[0; 4096]].concat()
        }),
    ];
    let fleet = fleet(1);
    for (name, attack) in attacks {
        let mut server = Server::start_on("tcp", enroll(&fleet, "router"), LinkOptions::default());
        let (mut between, near, far) = Interceptor::dial("tcp", &mut server, enroll(&fleet, "arm-1")).await;
        near.send_control("join".into()).await.unwrap();
        let sent = between.wait_for(b"join").await;
        let at = sent.windows(4).position(|w| w == b"join").unwrap();
        between.to_listener.write_all(&attack(&sent, at)).await.unwrap();
        loop {
            match soon(far.recv_control()).await {
                Ok(frame) => assert_eq!(frame, "join", "who {name}: the listener believes it"),
                Err(error) => {
                    assert!(matches!(error, LinkError::Altered), "who {name}: {error}");
                    break;
                }
            }
        }
    }
}
