//! DTLS with other implementations: `openssl`, floods of hellos, keys that DTLS cannot use.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[path = "support/openssl.rs"]
mod openssl;
#[path = "support/relay.rs"]
mod relay;
mod support;

use std::net::UdpSocket;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use openssl::{openssl, pem};
use relay::Relay;
use sgc_testkit::unused_port;
use sgc_transport::*;
use sgc_trust::{CertError, Identity};
use support::*;
use tokio::io::{AsyncBufReadExt as _, AsyncRead, AsyncWriteExt as _, BufReader};

/// The identity's parts in the form that `openssl` reads, in a directory that is removed with it.
struct Files {
    dir: PathBuf,
}

impl Files {
    fn write(identity: &Identity, name: &str) -> Self {
        let dir = std::env::temp_dir().join(format!("sgc-dtls-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&dir).unwrap();
        std::fs::write(
            dir.join("ca.pem"),
            pem(identity, "SGC CA CERTIFICATE").replace("SGC CA CERTIFICATE", "CERTIFICATE"),
        )
        .unwrap();
        std::fs::write(dir.join("leaf.der"), &identity.chain()[0]).unwrap();
        std::fs::write(dir.join("key.pem"), pem(identity, "PRIVATE KEY")).unwrap();
        Self { dir }
    }

    fn path(&self, name: &str) -> String {
        self.dir.join(name).to_str().unwrap().to_owned()
    }
}

impl Drop for Files {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.dir);
    }
}

/// Reads lines until one contains this text, and returns them.
async fn until(lines: &mut tokio::io::Lines<BufReader<impl AsyncRead + Unpin>>, wanted: &str) -> String {
    let mut seen = String::new();
    let patience = Duration::from_secs(10);
    while let Ok(Ok(Some(line))) = tokio::time::timeout(patience, lines.next_line()).await {
        seen += &line;
        seen.push('\n');
        if line.contains(wanted) {
            return seen;
        }
    }
    panic!("{wanted:?} never came in\n{seen}")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn openssl_connects_with_certificates_of_both_sides() {
    let fleet = fleet(1);
    let options = LinkOptions { handshake_timeout: Duration::from_millis(1500), ..LinkOptions::default() };
    let mut server = Server::start_on("dtls", enroll(&fleet, "router"), options);
    let files = Files::write(&enroll(&fleet, "arm-1"), "client");
    let (ca, leaf, key) = (files.path("ca.pem"), files.path("leaf.der"), files.path("key.pem"));
    let to = server.addr.to_string();
    let mut child = openssl(
        "s_client",
        &[
            "-dtls1_2",
            "-connect",
            &to,
            "-CAfile",
            &ca,
            "-cert",
            &leaf,
            "-certform",
            "DER",
            "-key",
            &key,
            "-verify_return_error",
            "-brief",
        ],
    );
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    let seen = until(&mut lines, "Verification").await;
    assert!(seen.contains("Verification: OK"), "{seen}");
    assert!(seen.contains("DTLSv1.2"), "{seen}");
    assert!(seen.contains("ECDHE-ECDSA-AES"), "{seen}");
    // The peer speaks no known protocol inside, and gets no link.
    let mut stdin = child.stdin.take().unwrap();
    stdin.write_all(b"hello\n").await.unwrap();
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::TimedOut { .. }), "{refused}");
    assert_eq!(server.metrics.accepted(), 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn openssl_without_a_certificate_or_with_one_of_another_fleet_is_refused() {
    let (ours, theirs) = (fleet(1), fleet(2));
    let mut server = dtls_router(&ours);
    let to = server.addr.to_string();
    let _nobody = openssl("s_client", &["-dtls1_2", "-connect", &to]);
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::NoCertificate)), "{refused}");
    let files = Files::write(&enroll(&theirs, "arm-1"), "foreign");
    let (leaf, key) = (files.path("leaf.der"), files.path("key.pem"));
    let args = ["-dtls1_2", "-connect", &to, "-cert", &leaf, "-certform", "DER", "-key", &key];
    let _foreign = openssl("s_client", &args);
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Certificate(CertError::UnknownIssuer)), "{refused}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_dialer_connects_to_openssl_with_certificates_of_both_sides() {
    let fleet = fleet(1);
    let files = Files::write(&enroll(&fleet, "router"), "server");
    let (ca, leaf, key) = (files.path("ca.pem"), files.path("leaf.der"), files.path("key.pem"));
    let port = unused_port();
    let accept = format!("127.0.0.1:{port}");
    let mut child = openssl(
        "s_server",
        &[
            "-dtls1_2",
            "-accept",
            &accept,
            "-CAfile",
            &ca,
            "-cert",
            &leaf,
            "-certform",
            "DER",
            "-key",
            &key,
            "-Verify",
            "1",
            "-verify_return_error",
            "-listen",
        ],
    );
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    until(&mut lines, "ACCEPT").await;
    let options = LinkOptions {
        handshake_timeout: Duration::from_millis(1500),
        dtls12: true,
        ..LinkOptions::default()
    };
    let dialer = Dialer::new(enroll(&fleet, "arm-1"), options, Arc::default());
    let url = format!("dtls://{accept}").parse().unwrap();
    let error = dial_with(&dialer, &url).await.unwrap_err();
    // The peer is of the fleet but no node: nothing inside is known.
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::Version)), "{error}");
    let seen = until(&mut lines, "CIPHER is").await;
    assert!(seen.contains("Client certificate") || seen.contains("BEGIN CERTIFICATE"), "{seen}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_flood_of_hellos_keeps_no_one_out_and_takes_no_room() {
    let fleet = fleet(1);
    let options = LinkOptions::default();
    let unproven_max = options.handshakes_unvalidated_max as u64;
    let mut server = Server::start_on("dtls", enroll(&fleet, "router"), options);
    let before = resident_kib();
    let addr = server.addr;
    let (sent, mut waves) = tokio::sync::mpsc::channel(1);
    let flood = tokio::task::spawn_blocking(move || {
        let (mut answered, mut challenged, mut answer) = (0_usize, 0, [0; 2048]);
        for number in 0..20_000_u32 {
            let [a, b, c, d] = number.to_be_bytes();
            let source = UdpSocket::bind((std::net::Ipv4Addr::new(127, 1 + b + a, c, d), 0)).unwrap();
            let hello = hello(number);
            source.send_to(&hello, addr).unwrap();
            source.set_nonblocking(true).unwrap();
            if number % 64 == 0 {
                source.set_nonblocking(false).unwrap();
                source.set_read_timeout(Some(Duration::from_millis(500))).unwrap();
                if let Ok(len) = source.recv(&mut answer) {
                    assert!(len <= hello.len() * 3, "{len} bytes for {}", hello.len());
                    answered += 1;
                    challenged += usize::from(answer[0] == 0xc2);
                }
            }
            if number % 2000 == 1999 {
                let _ = sent.blocking_send(());
            }
        }
        (answered, challenged)
    });
    let dialer = dialer(enroll(&fleet, "arm-1"));
    let mut links = Vec::new();
    while soon(waves.recv()).await.is_some() {
        assert!(server.metrics.handshakes_pending() <= unproven_max + 1);
        links.push(soon(dialer.dial(&server.url)).await.unwrap());
        server.link().await;
    }
    let (answered, challenged) = soon(flood).await.unwrap();
    assert!(answered > 0 && challenged * 2 > answered, "{challenged} of {answered} answers are challenges");
    assert_eq!(links.len(), 10);
    // 20 000 associations would take more than 100 MiB; ten links and the buffers of their sockets take far less.
    let grown = resident_kib().saturating_sub(before);
    assert!(grown < 80 << 10, "{grown} KiB more");
}

fn resident_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_hello_in_the_name_of_a_peer_does_not_disturb_its_link() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let listener = server.addr;
    // Interleaved, so that somebody else can use its address as well.
    let middle = Arc::new(tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap());
    let front = Arc::new(tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap());
    let url = format!("dtls://{}", front.local_addr().unwrap()).parse().unwrap();
    let forward = {
        let middle = Arc::clone(&middle);
        tokio::spawn(async move {
            let (mut up, mut down, mut dialer) = (vec![0; 65_536], vec![0; 65_536], listener);
            loop {
                tokio::select! {
                    Ok((len, from)) = front.recv_from(&mut up) => {
                        dialer = from;
                        let _ = middle.send_to(&up[..len], listener).await;
                    }
                    Ok(len) = middle.recv(&mut down) => {
                        let _ = front.send_to(&down[..len], dialer).await;
                    }
                }
            }
        })
    };
    let near = dial(enroll(&fleet, "arm-1"), &url).await.unwrap();
    let far = server.link().await;
    for number in 0..50 {
        let forged = match number % 5 {
            0 => hello(number),
            // A fatal alert, a change of cipher, a finished and garbage, all in the clear.
            1 => vec![21, 0xfe, 0xfd, 0, 0, 0, 0, 0, 0, 0, 9, 0, 2, 2, 40],
            2 => vec![20, 0xfe, 0xfd, 0, 0, 0, 0, 0, 0, 0, 9, 0, 1, 1],
            3 => vec![22, 0xfe, 0xfd, 0, 0, 0, 0, 0, 0, 0, 9, 0, 12, 20, 0, 0, 0, 0, 9, 0, 0, 0, 0, 0, 0],
            _ => vec![0x2f, 1, 2, 0, 40, 7, 7, 7],
        };
        middle.send_to(&forged, listener).await.unwrap();
        near.send_control(bytes::Bytes::from_static(b"still")).await.unwrap();
        assert_eq!(soon(far.recv_control()).await.unwrap(), "still");
        far.send_control(bytes::Bytes::from_static(b"here")).await.unwrap();
        assert_eq!(soon(near.recv_control()).await.unwrap(), "here");
    }
    forward.abort();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_listener_with_too_much_to_do_says_so() {
    let fleet = fleet(1);
    let options = LinkOptions { handshakes_max: 1, handshakes_unvalidated_max: 0, ..LinkOptions::default() };
    let mut server = Server::start_on("dtls", enroll(&fleet, "router"), options);
    let mut number = 0;
    let (error, _holder) = loop {
        // One that has proven its address holds the place, for a second at least.
        let holder = UdpSocket::bind("127.0.0.1:0").unwrap();
        number += 1;
        prove_and_stall(&holder, server.addr, number);
        until_true(|| server.metrics.handshakes_pending() == 1).await;
        if let Err(error) = dial(enroll(&fleet, "arm-1"), &server.url).await {
            break (error, holder);
        }
    };
    assert!(matches!(error, LinkError::RefusedByPeer(PeerRefusal::Overloaded)), "{error}");
    let refused = loop {
        if let Err(refused) = soon(server.results.recv()).await.unwrap() {
            break refused;
        }
    };
    assert!(matches!(refused.reason, Refusal::TooMany { pending: 1, .. }), "{refused}");
    // A peer that says no more makes room.
    soon(async {
        while server.metrics.handshakes_pending() > 0 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    })
    .await;
    let accepted = server.metrics.accepted();
    dial(enroll(&fleet, "arm-1"), &server.url).await.unwrap();
    until_true(|| server.metrics.accepted() > accepted).await;
}

/// Waits until something has happened.
async fn until_true(mut is_so: impl FnMut() -> bool) {
    soon(async {
        while !is_so() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn datagrams_that_were_overheard_move_no_link() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let relay = Relay::start(server.addr, 3).await;
    let url = format!("dtls://{}", relay.addr).parse().unwrap();
    let near = dial(enroll(&fleet, "arm-1"), &url).await.unwrap();
    let far = server.link().await;
    relay.impairment.tap.store(true, Relaxed);
    near.send_control(bytes::Bytes::from(vec![5; 3000])).await.unwrap();
    soon(far.recv_control()).await.unwrap();
    let overheard = |relay: &Relay| -> Vec<Vec<u8>> {
        relay
            .impairment
            .seen
            .lock()
            .unwrap()
            .iter()
            .filter(|d| d[0] == 0xc1 && d.len() > 60)
            .cloned()
            .collect()
    };
    until_true(|| overheard(&relay).len() >= 2).await;
    let here = far.remote();
    let thief = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
    for datagram in overheard(&relay) {
        // The original, and copies with altered record number, length and content.
        thief.send_to(&datagram, server.addr).await.unwrap();
        for at in [9, 10, 11, 12, 13, 30] {
            let mut altered = datagram.clone();
            altered[at] ^= 0x15;
            thief.send_to(&altered, server.addr).await.unwrap();
        }
    }
    // An unknown id is answered, which also shows that all earlier datagrams were looked at.
    let mut unknown = overheard(&relay)[0].clone();
    unknown[1..9].fill(0xee);
    thief.send_to(&unknown, server.addr).await.unwrap();
    let mut answer = [0; 2048];
    let (len, _) = soon(thief.recv_from(&mut answer)).await.unwrap();
    assert_eq!((answer[0], len), (0xc4, 17), "the thief was told something else");
    assert_eq!(far.remote(), here);
    near.send_control(bytes::Bytes::from_static(b"alive")).await.unwrap();
    assert_eq!(soon(far.recv_control()).await.unwrap(), "alive");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_node_that_is_another_inside_gets_no_link() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let relay = Relay::start(server.addr, 3).await;
    relay.impairment.tap.store(true, Relaxed);
    relay.impairment.loss.store(1000, Relaxed);
    let store = CredentialStore::new(enroll(&fleet, "arm-1"));
    let dialing = {
        let (dialer, url) = (dialer(store.clone()), format!("dtls://{}", relay.addr).parse().unwrap());
        tokio::spawn(async move { dial_with(&dialer, &url).await })
    };
    // DTLS began as one node; QUIC continues as another.
    until_true(|| !relay.impairment.seen.lock().unwrap().is_empty()).await;
    store.set_identity(enroll(&fleet, "arm-12"));
    relay.impairment.loss.store(0, Relaxed);
    let refused = server.refusal().await;
    assert!(matches!(refused.reason, Refusal::Greeting(ProtocolError::OtherNode)), "{refused}");
    let error = soon(dialing).await.unwrap().unwrap_err();
    assert!(
        matches!(&error, LinkError::Closed { by_peer: true, reason: CloseReason::Protocol(_) }),
        "{error}"
    );
    assert_eq!(server.metrics.accepted(), 0);
}

/// A NAT with one address towards the listener, which several dialers may share.
struct SharedAddress {
    url: LinkUrl,
    /// The socket at which the listener sees all of them.
    outside: Arc<tokio::net::UdpSocket>,
    /// Dialers that get the listener's datagrams, latest first.
    dialers: Arc<std::sync::Mutex<Vec<std::net::SocketAddr>>>,
    /// Number of them that get each datagram.
    copies: Arc<std::sync::atomic::AtomicUsize>,
    task: tokio::task::JoinHandle<()>,
}

impl SharedAddress {
    async fn before(listener: std::net::SocketAddr) -> Self {
        let inside = Arc::new(tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap());
        let outside = Arc::new(tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap());
        let url = format!("dtls://{}", inside.local_addr().unwrap()).parse().unwrap();
        let dialers = Arc::new(std::sync::Mutex::new(Vec::<std::net::SocketAddr>::new()));
        let copies = Arc::new(std::sync::atomic::AtomicUsize::new(1));
        let task = {
            let (outside, dialers, copies) =
                (Arc::clone(&outside), Arc::clone(&dialers), Arc::clone(&copies));
            tokio::spawn(async move {
                let (mut up, mut down) = (vec![0; 65_536], vec![0; 65_536]);
                let mut seen = std::collections::HashSet::new();
                loop {
                    tokio::select! {
                        Ok((len, from)) = inside.recv_from(&mut up) => {
                            if seen.insert(from) {
                                dialers.lock().unwrap().insert(0, from);
                            }
                            // A dialer that was removed is no longer heard.
                            if dialers.lock().unwrap().contains(&from) {
                                let _ = outside.send_to(&up[..len], listener).await;
                            }
                        }
                        Ok(len) = outside.recv(&mut down) => {
                            let to: Vec<_> =
                                dialers.lock().unwrap().iter().take(copies.load(Relaxed)).copied().collect();
                            for dialer in to {
                                let _ = inside.send_to(&down[..len], dialer).await;
                            }
                        }
                    }
                }
            })
        };
        Self { url, outside, dialers, copies, task }
    }
}

impl Drop for SharedAddress {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn talk(near: &AnyLink, far: &AnyLink) {
    for _ in 0..5 {
        near.send_control(bytes::Bytes::from_static(b"there")).await.unwrap();
        assert_eq!(soon(far.recv_control()).await.unwrap(), "there");
        far.send_control(bytes::Bytes::from_static(b"back")).await.unwrap();
        assert_eq!(soon(near.recv_control()).await.unwrap(), "back");
    }
}

/// Sends a member's records to the listener from an address that is not the member's, and waits until they were heard.
async fn spoof(
    server: &mut Server,
    fleet: &sgc_trust::Fleet,
    from: &tokio::net::UdpSocket,
) -> (AnyLink, AnyLink, Relay) {
    let relay = Relay::start(server.addr, 3).await;
    let url = format!("dtls://{}", relay.addr).parse().unwrap();
    let near = dial(enroll(fleet, "thief"), &url).await.unwrap();
    let far = server.link().await;
    talk(&near, &far).await;
    relay.impairment.seen.lock().unwrap().clear();
    relay.impairment.tap.store(true, Relaxed);
    relay.impairment.loss.store(1000, Relaxed);
    near.send_control(bytes::Bytes::from_static(b"spoofed")).await.unwrap();
    let held = |relay: &Relay| -> Vec<Vec<u8>> {
        relay.impairment.seen.lock().unwrap().iter().filter(|d| d[0] == 0xc1).cloned().collect()
    };
    until_true(|| !held(&relay).is_empty()).await;
    soon(async {
        let mut sent = 0;
        loop {
            for datagram in held(&relay).split_off(sent) {
                from.send_to(&datagram, server.addr).await.unwrap();
                sent += 1;
            }
            if let Ok(word) = tokio::time::timeout(Duration::from_millis(50), far.recv_control()).await {
                assert_eq!(word.unwrap(), "spoofed");
                break;
            }
        }
    })
    .await;
    (near, far, relay)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn member_that_spoofs_an_address_takes_no_route() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let nat = SharedAddress::before(server.addr).await;
    let near = dial(enroll(&fleet, "arm-1"), &nat.url).await.unwrap();
    let far = server.link().await;
    talk(&near, &far).await;
    let thief = spoof(&mut server, &fleet, &nat.outside).await;
    // The listener speaks first: nothing of the owner has come that could have corrected it.
    far.send_control(bytes::Bytes::from_static(b"first")).await.unwrap();
    let heard = tokio::time::timeout(Duration::from_millis(800), near.recv_control()).await;
    assert_eq!(heard.expect("the route is the thief's").unwrap(), "first");
    talk(&near, &far).await;
    assert_ne!(thief.1.remote(), far.remote());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn member_that_spoofs_an_address_keeps_nobody_out_there() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let nat = SharedAddress::before(server.addr).await;
    let _thief = spoof(&mut server, &fleet, &nat.outside).await;
    let near = dial(enroll(&fleet, "arm-1"), &nat.url).await.unwrap();
    let far = server.link().await;
    talk(&near, &far).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn address_of_a_peer_that_is_gone_is_given_to_the_next() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let nat = SharedAddress::before(server.addr).await;
    let gone = dial(enroll(&fleet, "arm-1"), &nat.url).await.unwrap();
    let _far = server.link().await;
    // It says nothing more and hears nothing more; the listener has not noticed.
    nat.dialers.lock().unwrap().clear();
    let near = dial(enroll(&fleet, "arm-2"), &nat.url).await.unwrap();
    let far = server.link().await;
    talk(&near, &far).await;
    drop(gone);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn peer_that_answers_keeps_its_address_from_one_that_listens_in() {
    let fleet = fleet(1);
    let mut server = dtls_router(&fleet);
    let nat = SharedAddress::before(server.addr).await;
    let near = dial(enroll(&fleet, "arm-1"), &nat.url).await.unwrap();
    let far = server.link().await;
    talk(&near, &far).await;
    // A member on the way sees everything to the address, and connects from there.
    nat.copies.store(2, Relaxed);
    let options = LinkOptions { handshake_timeout: Duration::from_secs(3), ..LinkOptions::default() };
    let thief = Dialer::new(enroll(&fleet, "thief"), options, Arc::default());
    let dialing = {
        let url = nat.url.clone();
        tokio::spawn(async move { dial_with(&thief, &url).await })
    };
    while !dialing.is_finished() {
        talk(&near, &far).await;
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    soon(dialing).await.unwrap().unwrap_err();
    talk(&near, &far).await;
}
