//! Strangers that meet a node over DTLS: certificates of any length, and listeners without an identity.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[path = "support/openssl.rs"]
mod openssl;
#[path = "support/stranger.rs"]
mod stranger;
mod support;

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use dimpl::{DtlsCertificate, ProtocolVersion};
use openssl::{openssl, pem};
use sgc_testkit::unused_port;
use sgc_transport::*;
use sgc_trust::{CertError, EnrollRequest, GROUPS_MAX, Identity};
use sgc_wire::CERT_BYTES_MAX;
use stranger::{FakeListener, HandshakeLog, LongCertificate, VERSIONS, visit};
use support::*;

/// Lengths of strangers' certificates, bytes, and of the datagrams that carry them. In DTLS 1.3 dimpl itself cannot
/// send longer ones.
fn long(version: ProtocolVersion) -> &'static [(usize, usize)] {
    match version {
        ProtocolVersion::DTLS1_2 => &[(2100, 1150), (5000, 1150), (20_000, 2000), (50_000, 2000)],
        _ => &[(2100, 1150), (5000, 1150), (8000, 2000)],
    }
}

/// A certificate that is read is judged by its CA; a longer one by its length.
fn is_judged(reason: &CertError, bytes: usize) -> bool {
    match reason {
        CertError::UnknownIssuer => bytes < CERT_BYTES_MAX,
        CertError::CertificateTooLong { bytes: found } => *found >= bytes && bytes >= CERT_BYTES_MAX,
        _ => false,
    }
}

/// An honest node still gets a link, so nothing panicked.
async fn still_serves(server: &mut Server, fleet: &sgc_trust::Fleet) {
    dial(enroll(fleet, "arm-1"), &server.url).await.unwrap();
    server.link().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listener_survives_long_certificates_of_openssl() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let dir: PathBuf = std::env::temp_dir().join(format!("sgc-long-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    for bytes in [2100, 8000, 16_000, 100_000] {
        let long = LongCertificate::new(bytes);
        let (leaf, key) = (dir.join("leaf.pem"), dir.join("key.pem"));
        std::fs::write(&leaf, long.certificate.pem()).unwrap();
        std::fs::write(&key, long.key.serialize_pem()).unwrap();
        for mtu in ["1200", "16000"] {
            let to = server.addr.to_string();
            let (leaf, key) = (leaf.to_str().unwrap(), key.to_str().unwrap());
            let args = ["-dtls1_2", "-mtu", mtu, "-connect", &to, "-cert", leaf, "-key", key];
            let mut child = openssl("s_client", &args);
            let refused = server.refusal().await;
            let is_expected = match &refused.reason {
                Refusal::Certificate(reason) => is_judged(reason, bytes),
                Refusal::HandshakeTooLong => bytes == 100_000 || mtu == "16000",
                _ => false,
            };
            assert!(is_expected, "{bytes} bytes in datagrams of {mtu}: {refused}");
            let _ = child.start_kill();
            let _ = child.wait().await;
        }
    }
    let _ = std::fs::remove_dir_all(&dir);
    still_serves(&mut server, &fleet).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listener_survives_long_certificates_in_both_versions() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    for version in VERSIONS {
        for &(bytes, datagram_bytes) in long(version) {
            let certificate = LongCertificate::new(bytes).for_dtls();
            let addr = server.addr;
            let visiting = tokio::task::spawn_blocking(move || {
                visit(addr, version, &certificate, datagram_bytes, Duration::from_secs(2))
            });
            let refused = server.refusal().await;
            let Refusal::Certificate(reason) = &refused.reason else {
                panic!("{version:?} {bytes}: {refused}")
            };
            assert!(is_judged(reason, bytes), "{version:?} {bytes}: {refused}");
            visiting.await.unwrap();
        }
    }
    let counted: u64 =
        [RefusalKind::OtherCa, RefusalKind::BadCertificate].map(|k| server.metrics.refused(k)).iter().sum();
    assert_eq!(counted, VERSIONS.iter().map(|version| long(*version).len() as u64).sum::<u64>());
    still_serves(&mut server, &fleet).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dialer_survives_long_certificates_in_both_versions() {
    let fleet = fleet(1);
    let options = LinkOptions { dtls12: true, ..LinkOptions::default() };
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    for version in VERSIONS {
        for &(bytes, datagram_bytes) in long(version) {
            let certificate = LongCertificate::new(bytes).for_dtls();
            let fake = FakeListener::start(version, certificate, datagram_bytes);
            let url = format!("dtls://{}", fake.addr).parse().unwrap();
            let error = dial_with(&dialer, &url).await.unwrap_err();
            let LinkError::RefusedHere(reason) = &error else { panic!("{version:?} {bytes}: {error}") };
            assert!(is_judged(reason, bytes), "{version:?} {bytes}: {error}");
            fake.stop();
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn members_with_as_many_groups_as_there_may_be_link() {
    let fleet = fleet(1);
    let identity = |name: &str| {
        let groups = (0..GROUPS_MAX).map(|n| format!("{n:02}{}", "g".repeat(62)).parse().unwrap()).collect();
        let request = EnrollRequest { groups, ..EnrollRequest::new(name.parse().unwrap(), now()) };
        Arc::new(fleet.issue(&request, &mut rng()).unwrap())
    };
    let (near, far) = (identity(&"a".repeat(64)), identity(&"b".repeat(64)));
    assert!(near.chain()[0].len() > 2048, "{}", near.chain()[0].len());
    let mut server = Server::start_on("dtls", far, LinkOptions::default());
    let link = dial(near, &server.url).await.unwrap();
    let far = server.link().await;
    link.send_control(bytes::Bytes::from_static(b"long")).await.unwrap();
    assert_eq!(soon(far.recv_control()).await.unwrap(), "long");
}

fn rng() -> rand_chacha::ChaCha20Rng {
    use rand_core::SeedableRng as _;
    rand_chacha::ChaCha20Rng::seed_from_u64(7)
}

/// A member's certificate and key, for a DTLS that is not ours.
fn for_dtls(identity: &Identity) -> DtlsCertificate {
    let key = rcgen::KeyPair::from_pem(&pem(identity, "PRIVATE KEY")).unwrap();
    DtlsCertificate { certificate: identity.chain()[0].to_vec(), private_key: key.serialize_der() }
}

/// Checks that no stranger was shown a certificate, and that none was on the wire in the clear.
fn saw_nothing(met: &[HandshakeLog], leaf: &[u8]) {
    // The key and the bytes behind it, which no other certificate has.
    let secret = &leaf[leaf.len() / 2..leaf.len() / 2 + 24];
    assert!(!met.is_empty());
    for met in met {
        assert_eq!(met.certificate, None);
        assert!(!met.is_connected);
        let is_in = |datagram: &Vec<u8>| datagram.windows(secret.len()).any(|bytes| bytes == secret);
        assert!(!met.received.iter().any(is_in), "the certificate was sent in the clear");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dialer_shows_its_certificate_to_members_only() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let options = LinkOptions { dtls12: true, ..LinkOptions::default() };
    let dialer = Dialer::new(Arc::clone(&arm), options, Arc::default());
    for version in VERSIONS {
        let fake = FakeListener::start(version, LongCertificate::new(10).for_dtls(), 1150);
        let url = format!("dtls://{}", fake.addr).parse().unwrap();
        let error = dial_with(&dialer, &url).await.unwrap_err();
        assert!(matches!(error, LinkError::RefusedHere(CertError::UnknownIssuer)), "{version:?}: {error}");
        saw_nothing(&fake.stop(), &arm.chain()[0]);
    }
    // A member is shown the certificate, in the clear in DTLS 1.2: so it would have been seen.
    for version in VERSIONS {
        let fake = FakeListener::start(version, for_dtls(&enroll(&fleet, "router")), 1150);
        let url = format!("dtls://{}", fake.addr).parse().unwrap();
        dial_with(&dialer, &url).await.unwrap_err();
        let met = fake.stop();
        assert!(met.iter().any(|met| met.certificate.as_deref() == Some(&arm.chain()[0])), "{version:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dialer_is_not_talked_out_of_dtls13() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let options = LinkOptions { handshake_timeout: Duration::from_secs(1), ..LinkOptions::default() };
    let dialer = Dialer::new(Arc::clone(&arm), options, Arc::default());
    // The stranger answers as a listener without DTLS 1.3 does, although the hello offers nothing else.
    let fake = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let url = format!("dtls://{}", fake.local_addr().unwrap()).parse().unwrap();
    let dialing = tokio::spawn(async move { dial_with(&dialer, &url).await });
    let retry = [
        &[22, 0xfe, 0xff, 0, 0, 0, 0, 0, 0, 0, 0, 0, 19, 3, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 7][..],
        &[0xfe, 0xff, 4, 1, 2, 3, 4],
    ]
    .concat();
    let (mut datagram, mut hellos) = (vec![0; 2048], 0);
    while !dialing.is_finished() {
        let received = tokio::time::timeout(Duration::from_millis(50), fake.recv_from(&mut datagram)).await;
        let Ok(Ok((len, from))) = received else { continue };
        let hello = &datagram[..len];
        // supported_versions: DTLS 1.3 and no other. An empty cookie: the answer was not followed.
        assert!(hello.windows(7).any(|bytes| bytes == [0, 43, 0, 3, 2, 0xfe, 0xfc]), "{hello:?}");
        assert_eq!(hello[60], 0, "{hello:?}");
        hellos += 1;
        fake.send_to(&retry, from).await.unwrap();
    }
    assert!(hellos > 0);
    let error = dialing.await.unwrap().unwrap_err();
    assert!(matches!(error, LinkError::DtlsVersion), "{error}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listener_without_dtls13_is_named() {
    let fleet = fleet(1);
    let dir = std::env::temp_dir().join(format!("sgc-old-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    let stranger = LongCertificate::new(10);
    let (leaf, key) = (dir.join("leaf.pem"), dir.join("key.pem"));
    std::fs::write(&leaf, stranger.certificate.pem()).unwrap();
    std::fs::write(&key, stranger.key.serialize_pem()).unwrap();
    let port = unused_port();
    let accept = format!("127.0.0.1:{port}");
    let (leaf, key) = (leaf.to_str().unwrap(), key.to_str().unwrap());
    let _server = openssl("s_server", &["-dtls1_2", "-accept", &accept, "-cert", leaf, "-key", key]);
    let dialer = dialer(enroll(&fleet, "arm-1"));
    let url = format!("dtls://{accept}").parse().unwrap();
    let error = dial_with(&dialer, &url).await.unwrap_err();
    assert!(matches!(error, LinkError::DtlsVersion), "{error}");
    let _ = std::fs::remove_dir_all(&dir);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn listener_is_told_why_a_dialer_does_not_go_on() {
    let (ours, theirs) = (fleet(1), fleet(2));
    for dtls12 in [false, true] {
        let mut server = dtls_router(&ours);
        let options = LinkOptions { dtls12, ..LinkOptions::default() };
        let dialer = Dialer::new(enroll(&theirs, "arm-1"), options, Arc::default());
        let error = dial_with(&dialer, &server.url).await.unwrap_err();
        assert!(matches!(error, LinkError::RefusedHere(CertError::UnknownIssuer)), "{error}");
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::ByPeer(PeerRefusal::OtherCa)), "{refused}");
        assert_eq!(server.metrics.refused(RefusalKind::OtherCa), 1);
    }
}

/// A HelloRetryRequest (RFC 8446, 4.1.4) whose cookie has this length, in datagrams that are not too long.
fn retry_with_cookie(bytes: usize) -> Vec<Vec<u8>> {
    let random = "cf21ad74e59a6111be1d8c021e65b891c2a211167abb8c5e079e09e2c8a8339c";
    let random = (0..32).map(|at| u8::from_str_radix(&random[at * 2..at * 2 + 2], 16).unwrap());
    let mut extensions = vec![0, 43, 0, 2, 0xfe, 0xfc, 0, 44];
    extensions.extend((bytes as u16 + 2).to_be_bytes());
    extensions.extend((bytes as u16).to_be_bytes());
    extensions.resize(extensions.len() + bytes, 7);
    let mut body = vec![0xfe, 0xfd];
    body.extend(random);
    body.extend([0, 0x13, 0x01, 0]);
    body.extend((extensions.len() as u16).to_be_bytes());
    body.extend(extensions);
    let length = &(body.len() as u32).to_be_bytes()[1..];
    let pieces = body.chunks(2000).enumerate().map(|(number, piece)| {
        let mut datagram = vec![22, 0xfe, 0xfd, 0, 0, 0, 0, 0, 0, 0, number as u8];
        datagram.extend((piece.len() as u16 + 12).to_be_bytes());
        datagram.push(2);
        datagram.extend(length);
        datagram.extend([0, 0]);
        datagram.extend(&((number * 2000) as u32).to_be_bytes()[1..]);
        datagram.extend(&(piece.len() as u32).to_be_bytes()[1..]);
        datagram.extend(piece);
        datagram
    });
    pieces.collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dialer_survives_long_cookies() {
    let fleet = fleet(1);
    let options = LinkOptions { handshake_timeout: Duration::from_secs(1), ..LinkOptions::default() };
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    for bytes in [500, 9000, 13_000, 20_000, 50_000] {
        let fake = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
        let url = format!("dtls://{}", fake.local_addr().unwrap()).parse().unwrap();
        let answering = tokio::spawn(async move {
            let mut hello = vec![0; 2048];
            let (_, from) = fake.recv_from(&mut hello).await.unwrap();
            for datagram in retry_with_cookie(bytes) {
                fake.send_to(&datagram, from).await.unwrap();
            }
            let (len, _) = fake.recv_from(&mut hello).await.unwrap();
            hello.truncate(len);
            // The next would repeat it.
            (hello, fake)
        });
        let error = dial_with(&dialer, &url).await.unwrap_err();
        if bytes == 500 {
            assert!(matches!(error, LinkError::HandshakeTimedOut { .. }), "{error}");
            let (hello, _fake) = soon(answering).await.unwrap();
            assert!(hello.windows(bytes).any(|window| window.iter().all(|byte| *byte == 7)), "no cookie");
        } else if bytes > 10_000 {
            // After a panic the dialer would report that nobody answered.
            assert!(matches!(error, LinkError::Transport(_)), "{bytes}: {error}");
        }
    }
}
