//! Strangers that begin handshakes and never finish them, from few addresses and over every transport.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

#[macro_use]
mod support;

use std::net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket};
use std::time::Duration;

use quinn::Endpoint;
use quinn::crypto::rustls::QuicClientConfig;
use sgc_transport::*;
use sgc_trust::Identity;
use support::*;
use tokio::io::AsyncWriteExt as _;
use tokio::net::{TcpSocket, TcpStream};

/// Places of the listeners below.
const PLACES: usize = 12;
/// Places for one address.
const PLACES_PER_ADDRESS: usize = 4;
/// More handshakes than there are places.
const FLOOD: usize = 20;

/// A handshake that its peer keeps open.
#[allow(dead_code, reason = "they are held, not used")]
enum StalledHandshake {
    Tcp(TcpStream),
    Udp(UdpSocket),
    Quic(Endpoint, Option<quinn::Connection>),
}

/// The loopback address of a host that attacks. Honest peers come from 127.0.0.1.
fn attacker(host: u8) -> SocketAddr {
    SocketAddr::new(IpAddr::V4(Ipv4Addr::new(127, 0, 0, 1 + host)), 0)
}

/// Begins a handshake from this address until it counts as engaged, and leaves it there.
async fn stall(
    scheme: &str,
    server: &Server,
    member: &Identity,
    from: SocketAddr,
    number: u32,
) -> StalledHandshake {
    match scheme {
        "quic" | "udp" => {
            let alpn = if scheme == "udp" { "sgc-udp/1" } else { "sgc/1" };
            let tls = QuicClientConfig::try_from(bare_tls(Some(member), alpn, None)).unwrap();
            let config = quinn::ClientConfig::new(std::sync::Arc::new(tls));
            let endpoint = Endpoint::client(from).unwrap();
            let connecting = endpoint.connect_with(config, server.addr, "x.invalid").unwrap();
            // A refusal is an answer, too.
            let connection = soon(connecting).await.ok();
            StalledHandshake::Quic(endpoint, connection)
        }
        "dtls" => {
            let socket = UdpSocket::bind(from).unwrap();
            prove_and_stall(&socket, server.addr, number);
            StalledHandshake::Udp(socket)
        }
        _ => {
            let socket = TcpSocket::new_v4().unwrap();
            socket.bind(from).unwrap();
            let mut tcp = soon(socket.connect(server.addr)).await.unwrap();
            let start: &[u8] = if scheme == "ws" { b"GET /sgc" } else { &[22, 3, 1] };
            // The peer may have been turned away already.
            let _ = tcp.write_all(start).await;
            StalledHandshake::Tcp(tcp)
        }
    }
}

fn crowded_listener(scheme: &str, fleet: &sgc_trust::Fleet) -> Server {
    let options = LinkOptions {
        handshakes_max: PLACES,
        handshakes_per_address_max: PLACES_PER_ADDRESS,
        // DTLS gives tickets from here on.
        handshakes_unvalidated_max: if scheme == "dtls" { 0 } else { 32 },
        handshake_timeout: Duration::from_secs(20),
        ..LinkOptions::default()
    };
    let mut server = Server::start_on(scheme, enroll(fleet, "router"), options);
    // Only the counters of refusals matter here.
    let mut results = std::mem::replace(&mut server.results, tokio::sync::mpsc::channel(1).1);
    tokio::spawn(async move {
        // A link that is dropped says goodbye, perhaps before its dialer has returned.
        let mut kept = Vec::new();
        while let Some(result) = results.recv().await {
            kept.extend(result);
        }
    });
    server
}

async fn wait_for_pending(server: &Server, least: u64) {
    soon(async {
        while server.metrics.handshakes_pending() < least {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
}

/// One host holds at most its share of the places, and others connect.
async fn a_stalling_address_keeps_nobody_else_out(scheme: &str) {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let server = crowded_listener(scheme, &fleet);
    let mut held = Vec::new();
    for number in 0..FLOOD as u32 {
        held.push(stall(scheme, &server, &arm, attacker(1), number).await);
    }
    wait_for_pending(&server, PLACES_PER_ADDRESS as u64).await;
    let turned_away = (FLOOD - PLACES_PER_ADDRESS) as u64;
    soon(async {
        while server.metrics.refused(RefusalKind::TooManyFromAddress) < turned_away {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
    assert_eq!(server.metrics.refused(RefusalKind::TooMany), 0);
    // A handshake that gave way is counted until its task has ended.
    soon(async {
        while server.metrics.handshakes_pending() > PLACES_PER_ADDRESS as u64 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
    dial(arm, &server.url).await.unwrap();
}

/// Some hosts that take every place make room, since each of them holds more than the newcomer would.
async fn a_few_addresses_that_take_all_places_make_room_for_another(scheme: &str) {
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let server = crowded_listener(scheme, &fleet);
    let mut held = Vec::new();
    for host in 1..=3 {
        for number in 0..PLACES_PER_ADDRESS as u32 {
            held.push(stall(scheme, &server, &arm, attacker(host), number + 100 * u32::from(host)).await);
        }
    }
    wait_for_pending(&server, PLACES as u64).await;
    dial(arm, &server.url).await.unwrap();
    assert!(server.metrics.refused(RefusalKind::TooMany) >= 1, "one of theirs gave way");
}

/// Time without progress after which the far end is full.
const STUCK: Duration = Duration::from_millis(500);

/// However many peers send without being read, the node holds no more than its budget.
async fn links_that_nobody_reads_share_one_budget(scheme: &str) {
    const LINKS: u64 = 12;
    const BUDGET_BYTES: u64 = 8 << 20;
    let fleet = fleet(1);
    let arm = enroll(&fleet, "arm-1");
    let receive_budget = ReceiveBudget::new(BUDGET_BYTES);
    let options = LinkOptions { receive_budget: receive_budget.clone(), ..LinkOptions::default() };
    let mut server = Server::start_on(scheme, enroll(&fleet, "router"), options);
    // Bytes in flight count as received here, so there are few.
    let sends = LinkOptions { send_window_bytes: 64 << 10, ..LinkOptions::default() };
    let dialer = Dialer::new(arm, sends, Default::default());
    let (mut links, mut senders) = (Vec::new(), tokio::task::JoinSet::new());
    for _ in 0..LINKS {
        let near = soon(dialer.dial(&server.url)).await.unwrap();
        let far = server.link().await;
        let sender = near.clone();
        senders.spawn(async move {
            // Two flows fill the window of a link, because one may have half.
            let mut taken = 0;
            for _ in 0..2 {
                let mut flow = sender.open_flow(sgc_wire::Class::Default).await.unwrap();
                let packet = packet(1, vec![7; 16 << 10].into());
                while let Ok(sent) = tokio::time::timeout(STUCK, flow.send(&packet)).await {
                    sent.unwrap();
                    taken += packet.payload.len() as u64;
                }
                std::mem::forget(flow);
            }
            taken
        });
        links.push((near, far));
    }
    let mut taken = 0;
    while let Some(bytes) = soon(senders.join_next()).await {
        taken += bytes.unwrap();
    }
    let granted = receive_budget.granted_bytes();
    // 8 + 4 + 2.7 + 2 + 1.6 + 1.3 + 1.1 + 5 · 1 MiB.
    assert!(granted < 27 << 20, "{granted} bytes granted");
    // Bytes that wait at the senders count for them: those in flight, and the queue of each flow.
    let waiting = LINKS * (1 << 20);
    assert!(taken <= granted + waiting, "{taken} bytes taken of {granted} granted");
    drop((links, dialer));
    soon(async {
        while receive_budget.granted_bytes() > 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    })
    .await;
}

each_transport! {
    [
        links_that_nobody_reads_share_one_budget
        a_stalling_address_keeps_nobody_else_out
        a_few_addresses_that_take_all_places_make_room_for_another
    ]: quic dtls udp tls tcp ws wss
}
