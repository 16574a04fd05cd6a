//! Links and handshakes while certificates are renewed, revoked and expire; and their keys.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod support;

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

use quinn::ConnectionError;
use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use rcgen::{CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair, SanType};
use rustls::crypto::aws_lc_rs::kx_group;
use sgc_transport::*;
use sgc_trust::{CertError, EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;
use support::*;
use tokio::net::UdpSocket;

/// Schemes whose handshakes differ.
const SCHEMES: [&str; 4] = ["quic", "tls", "tcp", "wss"];

/// The node's next certificate.
fn renew(fleet: &Fleet, node: &str) -> Arc<Identity> {
    let request = EnrollRequest::new(node.parse().unwrap(), now());
    Arc::new(fleet.issue(&request, &mut ChaCha20Rng::seed_from_u64(99)).unwrap())
}

/// Revokes a certificate for all who share this store.
fn revoke(store: &CredentialStore, fleet: &Fleet, whose: &Identity) {
    let serial = Arc::clone(&whose.as_peer().cert.serial);
    let list = fleet.revocation_list_of(&[(serial, now())], 1, now()).unwrap();
    store.set_anchors(store.anchors().with_crl(&list, now()).unwrap().unwrap());
}

#[tokio::test]
async fn a_revoked_dialer_is_refused_and_both_logs_name_it() {
    for scheme in SCHEMES {
        let fleet = fleet(1);
        let arm = enroll(&fleet, "arm-1");
        let store = CredentialStore::new(enroll(&fleet, "router"));
        let mut server = Server::start_on(scheme, store.clone(), LinkOptions::default());
        let before = dial(Arc::clone(&arm), &server.url).await.unwrap();
        let far = server.link().await;
        revoke(&store, &fleet, &arm);
        let error = dial(Arc::clone(&arm), &server.url).await.unwrap_err();
        assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::Revoked)), "{error}");
        assert!(error.to_string().contains("revoked: the keeper of the fleet has to enroll"), "{error}");
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::Certificate(CertError::Revoked { .. })), "{refused}");
        assert!(refused.to_string().contains("revoked by its CA"), "{refused}");
        assert_eq!(server.metrics.refused(RefusalKind::Revoked), 1);
        // Another certificate of the same node is as good as before.
        dial(renew(&fleet, "arm-1"), &server.url).await.unwrap();
        // The existing link reports why it ends.
        let reason = store.objection(far.peer(), now()).unwrap();
        assert_eq!(reason, CloseReason::Revoked);
        far.close(reason);
        let end = soon(before.closed()).await;
        assert!(matches!(end, LinkError::Closed { by_peer: true, reason: CloseReason::Revoked }), "{end}");
        assert!(end.to_string().contains("this node's certificate was revoked"), "{end}");
        let here = soon(far.closed()).await;
        assert!(here.to_string().contains("the peer's certificate was revoked"), "{here}");
    }
}

#[tokio::test]
async fn a_revoked_listener_is_refused_and_both_logs_name_it() {
    for scheme in SCHEMES {
        let fleet = fleet(1);
        let router = enroll(&fleet, "router");
        let mut server = Server::start_on(scheme, Arc::clone(&router), LinkOptions::default());
        let store = CredentialStore::new(enroll(&fleet, "arm-1"));
        let dialer = dialer(store.clone());
        let near = dial_with(&dialer, &server.url).await.unwrap();
        server.link().await;
        assert_eq!(store.objection(near.peer(), now()), None);
        revoke(&store, &fleet, &router);
        assert_eq!(store.objection(near.peer(), now()), Some(CloseReason::Revoked));
        let error = dial_with(&dialer, &server.url).await.unwrap_err();
        assert!(matches!(error, LinkError::RefusedHere(CertError::Revoked { .. })), "{error}");
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::ByPeer(PeerRefusal::Revoked)), "{refused}");
    }
}

#[tokio::test]
async fn a_session_that_was_good_does_not_let_a_revoked_certificate_back_in() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let store = CredentialStore::new(enroll(&fleet, "router"));
    let mut server = Server::start(store.clone(), LinkOptions::default());
    // The client keeps its sessions, and would resume them.
    let tls = bare_tls(Some(&arm), "sgc/1", None);
    let (connection, _control, far) =
        greet(bare_with(server.addr, tls.clone()).await.unwrap(), &mut server).await;
    connection.close(0u32.into(), b"");
    soon(far.closed()).await;
    revoke(&store, &fleet, &arm);
    if let Ok(connection) = bare_with(server.addr, tls).await {
        soon(connection.closed()).await;
    }
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::Revoked { .. })), "{refused}");
}

#[tokio::test]
async fn a_certificate_that_runs_out_ends_its_link_with_that_reason() {
    let fleet = fleet(1);
    let store = CredentialStore::new(enroll(&fleet, "router"));
    let mut server = Server::start(store.clone(), LinkOptions::default());
    let near = dial(enroll(&fleet, "arm-1"), &server.url).await.unwrap();
    let far = server.link().await;
    let end = far.peer().not_after;
    assert_eq!(store.objection(far.peer(), end), None);
    let reason = store.objection(far.peer(), UnixMillis(end.0 + 1000)).unwrap();
    far.close(reason);
    let error = soon(near.closed()).await;
    assert!(matches!(error, LinkError::Closed { by_peer: true, reason: CloseReason::Expired }), "{error}");
    assert!(error.to_string().contains("this node's certificate expired; renew it"), "{error}");
}

#[tokio::test]
async fn a_renewed_certificate_is_what_the_next_link_shows() {
    let fleet = fleet(1);
    let (router, arm) =
        (CredentialStore::new(enroll(&fleet, "router")), CredentialStore::new(enroll(&fleet, "arm-1")));
    let mut server = Server::start(router.clone(), LinkOptions::default());
    let dialer = dialer(arm.clone());
    let old = dial_with(&dialer, &server.url).await.unwrap();
    let far_old = server.link().await;
    let (next_router, next_arm) = (renew(&fleet, "router"), renew(&fleet, "arm-1"));
    router.set_identity(Arc::clone(&next_router));
    arm.set_identity(Arc::clone(&next_arm));
    let near = dial_with(&dialer, &server.url).await.unwrap();
    let far = server.link().await;
    assert_eq!(near.peer().cert, next_router.as_peer().cert);
    assert_eq!(far.peer().cert, next_arm.as_peer().cert);
    assert_eq!(far.peer().node_id, far_old.peer().node_id);
    assert_ne!(far.peer().cert, far_old.peer().cert);
    assert_ne!(near.peer().cert, old.peer().cert);
    // Both links work until one is closed.
    for (near, far) in [(&old, &far_old), (&near, &far)] {
        near.send_control("x".into()).await.unwrap();
        assert_eq!(soon(far.recv_control()).await.unwrap(), "x");
    }
}

#[tokio::test]
async fn a_renewed_identity_does_not_forget_who_was_revoked() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let store = CredentialStore::new(enroll(&fleet, "router"));
    let mut server = Server::start(store.clone(), LinkOptions::default());
    revoke(&store, &fleet, &arm);
    store.set_identity(renew(&fleet, "router"));
    dial(arm, &server.url).await.unwrap_err();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::Revoked { .. })), "{refused}");
}

#[tokio::test]
async fn a_ca_that_is_no_longer_trusted_takes_its_links_along() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let router = enroll(&ours, "router");
    let partner = Arc::new(enroll(&theirs, "arm-1").with_anchors(ours.anchors().clone()));
    let store = CredentialStore::new(router);
    let cas = theirs.anchors().certificates().cloned();
    store.set_anchors(store.anchors().with_anchors(cas).unwrap());
    let mut server = Server::start(store.clone(), LinkOptions::default());
    let near = dial(Arc::clone(&partner), &server.url).await.unwrap();
    let far = server.link().await;
    assert_eq!(store.objection(far.peer(), now()), None);
    store.set_anchors(ours.anchors().clone());
    far.close(store.objection(far.peer(), now()).unwrap());
    let error = soon(near.closed()).await;
    assert!(matches!(&error, LinkError::Closed { reason: CloseReason::Denied(_), .. }), "{error}");
    let error = dial(partner, &server.url).await.unwrap_err();
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::OtherCa)), "{error}");
}

#[tokio::test]
async fn only_nodes_of_admitted_cas_attach_and_both_logs_name_it() {
    for scheme in SCHEMES {
        let (own, first, second) = (fleet(1), fleet(2), fleet(3));
        let router = enroll(&own, "router");
        let both = first.anchors().certificates().chain(second.anchors().certificates());
        let store = CredentialStore::new(router);
        store.set_anchors(store.anchors().with_anchors(both.cloned()).unwrap());
        store.set_admitted(Some(first.anchors().fingerprints().collect()));
        let mut server = Server::start_on(scheme, store.clone(), LinkOptions::default());
        let of = |fleet: &Fleet| Arc::new(enroll(fleet, "arm-1").with_anchors(own.anchors().clone()));

        let _near = dial(of(&first), &server.url).await.unwrap();
        let far = server.link().await;
        assert!(store.admits(far.peer()));
        // Of a CA that is believed, and of the router's own.
        for stranger in [of(&second), enroll(&own, "arm-2")] {
            let error = dial(stranger, &server.url).await.unwrap_err();
            assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::NotAdmitted)), "{error}");
            let refused = server.refusal().await;
            let text = refused.to_string();
            assert!(matches!(refused.reason, Refusal::Certificate(CertError::NotAdmitted { .. })), "{text}");
            assert!(text.contains("`accept` in [router]"), "{text}");
        }
        assert_eq!(server.metrics.refused(RefusalKind::NotAdmitted), 2);

        // Dialling is not restricted, and the next handshake uses the rules of its time.
        let other = Server::start_on(scheme, of(&second), LinkOptions::default());
        dial(store.clone(), &other.url).await.unwrap();
        store.set_admitted(None);
        dial(of(&second), &server.url).await.unwrap();
        store.set_admitted(Some(second.anchors().fingerprints().collect()));
        assert!(!store.admits(far.peer()));
    }
}

// Key exchange.

fn with(post_quantum: bool) -> LinkOptions {
    LinkOptions { post_quantum, ..LinkOptions::default() }
}

#[tokio::test]
async fn post_quantum_keys_are_agreed_on_where_either_end_requires_them() {
    for scheme in SCHEMES {
        let fleet = fleet(1);
        let (router, arm) = (enroll(&fleet, "router"), enroll(&fleet, "arm-1"));
        for (dials, listens) in [(false, false), (false, true), (true, false), (true, true)] {
            let mut server = Server::start_on(scheme, Arc::clone(&router), with(listens));
            let dialer = Dialer::new(Arc::clone(&arm), with(dials), Arc::default());
            let near = soon(dialer.dial(&server.url)).await.unwrap();
            let far = server.link().await;
            let expected = if dials || listens { "X25519MLKEM768" } else { "X25519" };
            for link in [near, far] {
                assert_eq!(link.stats().key_exchange.label(), expected, "{dials} {listens}");
            }
        }
    }
}

#[tokio::test]
async fn a_fleet_is_switched_to_post_quantum_keys_while_its_nodes_run() {
    let mut fleet = fleet(1);
    let (router, arm) =
        (CredentialStore::new(enroll(&fleet, "router")), CredentialStore::new(enroll(&fleet, "arm-1")));
    let mut server = Server::start(router.clone(), LinkOptions::default());
    let dialer = dialer(arm.clone());
    let mut agreed = async || {
        let near = dial_with(&dialer, &server.url).await.unwrap();
        (near.stats().key_exchange.label(), server.link().await.stats().key_exchange.label())
    };
    assert_eq!(agreed().await, ("X25519", "X25519"));
    fleet.set_post_quantum(true, now()).unwrap();
    // Nodes are switched one by one, and nobody is locked out between.
    router.set_identity(renew(&fleet, "router"));
    assert_eq!(agreed().await, ("X25519MLKEM768", "X25519MLKEM768"));
    arm.set_identity(renew(&fleet, "arm-1"));
    assert_eq!(agreed().await, ("X25519MLKEM768", "X25519MLKEM768"));
    let classical = bare_tls(Some(&arm.identity()), "sgc/1", Some(vec![kx_group::X25519]));
    bare_with(server.addr, classical).await.unwrap_err();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::KeyExchange { post_quantum: true }), "{refused}");
}

#[tokio::test]
async fn where_post_quantum_is_required_a_classical_dialer_is_refused() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let mut server = Server::start(enroll(&fleet, "router"), with(true));
    for groups in [vec![kx_group::X25519], vec![kx_group::SECP256R1, kx_group::X25519, kx_group::SECP384R1]] {
        let error = bare_with(server.addr, bare_tls(Some(&arm), "sgc/1", Some(groups))).await.unwrap_err();
        let ConnectionError::ConnectionClosed(closed) = error else { panic!("{error}") };
        assert_eq!(u64::from(closed.error_code), 0x128);
        let refused = server.refusal().await;
        assert!(matches!(refused.reason, Refusal::KeyExchange { post_quantum: true }), "{refused}");
        assert!(refused.to_string().contains("X25519MLKEM768 is required here"), "{refused}");
    }
    assert_eq!(server.metrics.refused(RefusalKind::KeyExchange), 2);
    // A node that supports it but prefers the other gets no choice.
    let groups = vec![kx_group::X25519, kx_group::X25519MLKEM768];
    let connection = bare_with(server.addr, bare_tls(Some(&arm), "sgc/1", Some(groups))).await.unwrap();
    let (_connection, _control, far) = greet(connection, &mut server).await;
    assert_eq!(far.stats().key_exchange, KeyExchange::X25519MlKem768);
}

#[tokio::test]
async fn where_post_quantum_is_required_a_classical_listener_is_refused() {
    let fleet = fleet(1);
    let router = enroll(&fleet, "router");
    let mut provider = rustls::crypto::aws_lc_rs::default_provider();
    provider.kx_groups = vec![kx_group::X25519];
    let tls = rustls::ServerConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .with_no_client_auth()
        .with_cert_resolver(Arc::new(rustls::sign::SingleCertAndKey::from(router.certified_key())));
    let crypto = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
    let config = quinn::ServerConfig::with_crypto(Arc::new(crypto));
    let endpoint = quinn::Endpoint::server(config, "127.0.0.1:0".parse().unwrap()).unwrap();
    let url = format!("quic://{}", endpoint.local_addr().unwrap()).parse().unwrap();
    let accept = async { endpoint.accept().await.unwrap().await.unwrap_err() };
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), with(true), Arc::default());
    let (_, error) = soon(async { tokio::join!(accept, dial_with(&dialer, &url)) }).await;
    let error = error.unwrap_err();
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::KeyExchange)), "{error}");
    assert!(error.to_string().contains("X25519MLKEM768"), "{error}");
}

/// Passes datagrams on between one dialer and a listener, and loses the long ones.
async fn narrow(listener: SocketAddr, bytes_max: usize) -> (SocketAddr, Arc<AtomicUsize>) {
    let front = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let back = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    back.connect(listener).await.unwrap();
    let (addr, longest) = (front.local_addr().unwrap(), Arc::<AtomicUsize>::default());
    let seen = Arc::clone(&longest);
    tokio::spawn(async move {
        let (mut there, mut here) = (vec![0; 65_536], vec![0; 65_536]);
        let mut dialer = None;
        loop {
            tokio::select! {
                Ok((n, from)) = front.recv_from(&mut there) => {
                    dialer = Some(from);
                    if n <= bytes_max {
                        seen.fetch_max(n, Relaxed);
                        back.send(&there[..n]).await.unwrap();
                    }
                }
                Ok(n) = back.recv(&mut here) => if let Some(dialer) = dialer.filter(|_| n <= bytes_max) {
                    seen.fetch_max(n, Relaxed);
                    front.send_to(&here[..n], dialer).await.unwrap();
                },
            }
        }
    });
    (addr, longest)
}

#[tokio::test]
async fn a_path_of_1200_bytes_is_wide_enough_for_post_quantum_keys() {
    let fleet = fleet(1);
    let mut server = Server::start(enroll(&fleet, "router"), with(true));
    let (addr, longest) = narrow(server.addr, 1200).await;
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), with(true), Arc::default());
    let near = dial_with(&dialer, &format!("quic://{addr}").parse().unwrap()).await.unwrap();
    let far = server.link().await;
    assert_eq!(near.stats().key_exchange, KeyExchange::X25519MlKem768);
    near.send_control(vec![7; 5000].into()).await.unwrap();
    assert_eq!(soon(far.recv_control()).await.unwrap().len(), 5000);
    assert_eq!(longest.load(Relaxed), 1200);
}

// Kinds of keys.

/// A node of a PKI that is not a fleet's: any kind of key, no fleet secret.
struct Pki {
    ca: CertificateParams,
    key: KeyPair,
    pem: String,
}

impl Pki {
    fn new() -> Self {
        let key = KeyPair::generate_for(&rcgen::PKCS_ECDSA_P384_SHA384).unwrap();
        let mut ca = CertificateParams::default();
        ca.is_ca = IsCa::Ca(rcgen::BasicConstraints::Unconstrained);
        let pem = ca.self_signed(&key).unwrap().pem().replace("CERTIFICATE", "SGC CA CERTIFICATE");
        Self { ca, key, pem }
    }

    fn node(&self, key: &KeyPair, digit: char) -> Arc<Identity> {
        let mut params = CertificateParams::default();
        let uri = format!("sgc:node:{}", String::from(digit).repeat(64));
        params.subject_alt_names = vec![SanType::URI(uri.as_str().try_into().unwrap())];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        let leaf = params.signed_by(key, &Issuer::from_params(&self.ca, &self.key)).unwrap();
        let about = enroll(&fleet(1), "node").to_text();
        let start = about.find("-----BEGIN SGC IDENTITY-----").unwrap();
        let end = about.find("-----END SGC IDENTITY-----\n").unwrap();
        let about = &about[start..end + "-----END SGC IDENTITY-----\n".len()];
        let text = [about, &leaf.pem(), &key.serialize_pem(), &self.pem].concat().replace("\r\n", "\n");
        Arc::new(Identity::parse(&text).unwrap())
    }
}

#[tokio::test]
async fn keys_of_every_supported_kind_link_with_each_other() {
    let pki = Pki::new();
    let keys = [
        ("P-256", KeyPair::generate_for(&rcgen::PKCS_ECDSA_P256_SHA256).unwrap()),
        ("P-384", KeyPair::generate_for(&rcgen::PKCS_ECDSA_P384_SHA384).unwrap()),
        ("Ed25519", KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap()),
        ("RSA", KeyPair::generate_rsa_for(&rcgen::PKCS_RSA_SHA256, rcgen::RsaKeySize::_2048).unwrap()),
    ];
    let nodes: Vec<_> =
        keys.iter().zip('1'..).map(|((kind, key), digit)| (kind, pki.node(key, digit))).collect();
    for (listens, router) in &nodes {
        let mut server = Server::start(Arc::clone(router), LinkOptions::default());
        for (dials, arm) in &nodes {
            let near = dial(Arc::clone(arm), &server.url).await;
            let near = near.unwrap_or_else(|e| panic!("{dials} to {listens}: {e}"));
            assert_eq!(near.peer().node_id, router.node_id());
            assert_eq!(server.link().await.peer().node_id, arm.node_id());
        }
    }
}

#[tokio::test]
async fn dtls_takes_keys_of_its_two_kinds_and_names_what_it_does_not_take() {
    let pki = Pki::new();
    let p256 = pki.node(&KeyPair::generate_for(&rcgen::PKCS_ECDSA_P256_SHA256).unwrap(), '1');
    let p384 = pki.node(&KeyPair::generate_for(&rcgen::PKCS_ECDSA_P384_SHA384).unwrap(), '2');
    for (listens, dials) in [(&p256, &p384), (&p384, &p256), (&p384, &p384)] {
        let mut server = Server::start_on("dtls", Arc::clone(listens), LinkOptions::default());
        let near = dial(Arc::clone(dials), &server.url).await.unwrap();
        assert_eq!(near.peer().node_id, listens.node_id());
        assert_eq!(server.link().await.peer().node_id, dials.node_id());
    }
    let other = pki.node(&KeyPair::generate_for(&rcgen::PKCS_ED25519).unwrap(), '3');
    let addr = "dtls://127.0.0.1:0".parse().unwrap();
    let bound = Listener::bind(&addr, Arc::clone(&other), LinkOptions::default(), Arc::default());
    let error = bound.err().unwrap();
    assert_eq!(error.kind(), std::io::ErrorKind::InvalidInput);
    assert!(error.to_string().contains("P-256"), "{error}");
    let error = dial(other, &"dtls://127.0.0.1:9".parse().unwrap()).await.unwrap_err();
    assert!(matches!(error, LinkError::KeyUnsupported), "{error}");
}

#[tokio::test]
async fn post_quantum_keys_are_agreed_on_inside_of_dtls() {
    let fleet = fleet(1);
    let mut server = Server::start_on("dtls", enroll(&fleet, "router"), with(true));
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), with(true), Arc::default());
    let near = dial_with(&dialer, &server.url).await.unwrap();
    assert_eq!(near.stats().key_exchange, KeyExchange::X25519MlKem768);
    assert_eq!(server.link().await.stats().key_exchange, KeyExchange::X25519MlKem768);
}

#[tokio::test]
async fn a_key_of_another_kind_is_named() {
    let pki = Pki::new();
    let p521 = KeyPair::generate_for(&rcgen::PKCS_ECDSA_P521_SHA512).unwrap();
    let mut params = CertificateParams::default();
    let uri = format!("sgc:node:{}", "5".repeat(64));
    params.subject_alt_names = vec![SanType::URI(uri.as_str().try_into().unwrap())];
    let leaf = params.signed_by(&p521, &Issuer::from_params(&pki.ca, &pki.key)).unwrap();
    let key = rustls::crypto::aws_lc_rs::sign::any_supported_type(
        &rustls_pki_types::PrivateKeyDer::try_from(p521.serialize_der()).unwrap(),
    );
    let certified = rustls::sign::CertifiedKey::new(vec![leaf.der().clone()], key.unwrap());
    let mut tls = bare_tls(None, "sgc/1", None);
    tls.client_auth_cert_resolver = Arc::new(rustls::sign::SingleCertAndKey::from(certified));
    let router = pki.node(&KeyPair::generate().unwrap(), '1');
    let mut server = Server::start(router, LinkOptions::default());
    if let Ok(connection) = bare_with(server.addr, tls).await {
        soon(connection.closed()).await;
    }
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::KeyUnsupported)), "{refused}");
    assert!(refused.to_string().contains("P-256, P-384, Ed25519 and RSA"), "{refused}");
}

#[tokio::test]
async fn a_revocation_during_a_handshake_counts() {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let store = CredentialStore::new(enroll(&fleet, "router"));
    let mut server = Server::start(store.clone(), LinkOptions::default());
    // A relay that holds everything back until the list is there: the listener's handshake has begun by then.
    let hold = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let back = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    back.connect(server.addr).await.unwrap();
    let url: LinkUrl = format!("quic://{}", hold.local_addr().unwrap()).parse().unwrap();
    let dialer = dialer(Arc::clone(&arm));
    let relay = async {
        let (mut there, mut here) = (vec![0; 65_536], vec![0; 65_536]);
        let (n, from) = hold.recv_from(&mut there).await.unwrap();
        back.send(&there[..n]).await.unwrap();
        // The listener has answered, so it waits for the certificate.
        let n = back.recv(&mut here).await.unwrap();
        revoke(&store, &fleet, &arm);
        hold.send_to(&here[..n], from).await.unwrap();
        loop {
            tokio::select! {
                Ok(n) = hold.recv(&mut there) => drop(back.send(&there[..n]).await),
                Ok(n) = back.recv(&mut here) => drop(hold.send_to(&here[..n], from).await),
            }
        }
    };
    let dialled = async { dial_with(&dialer, &url).await.unwrap_err() };
    let error = tokio::select! { e = dialled => e, () = relay => unreachable!() };
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::Revoked)), "{error}");
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::Revoked { .. })), "{refused}");
}
