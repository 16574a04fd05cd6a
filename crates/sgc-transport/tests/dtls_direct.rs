//! DTLS links that share a socket with QUIC links and checks of direct paths.
#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod support;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_transport::*;
use sgc_wire::LaneToken;
use support::*;

/// Says something both ways.
async fn talk(near: &AnyLink, far: &AnyLink) {
    for _ in 0..5 {
        near.send_control(Bytes::from_static(b"there")).await.unwrap();
        assert_eq!(soon(far.recv_control()).await.unwrap(), "there");
        far.send_control(Bytes::from_static(b"back")).await.unwrap();
        assert_eq!(soon(near.recv_control()).await.unwrap(), "back");
    }
}

/// Talks until the far node sees the near one at this port.
async fn talk_until_at(port: u16, near: &AnyLink, far: &AnyLink) {
    soon(async {
        while far.remote().port() != port {
            talk(near, far).await;
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    talk(near, far).await;
}

fn port(sockets: &DirectSockets) -> u16 {
    sockets.handle.ports().0.expect("there is IPv4")
}

fn member(fleet: &sgc_trust::Fleet, options: LinkOptions) -> (Dialer, DirectSockets) {
    let dialer = Dialer::new(enroll(fleet, "arm-1"), options, Arc::default());
    let sockets = dialer.open_direct();
    (dialer, sockets)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dtls_link_shares_its_socket_with_quic_and_checks() {
    let fleet = fleet(1);
    let mut dtls = dtls_router(&fleet);
    let mut quic = Server::start(enroll(&fleet, "router-2"), LinkOptions::default());
    let options = LinkOptions { handshake_timeout: Duration::from_millis(700), ..LinkOptions::default() };
    let (arm, mut sockets) = member(&fleet, options);
    sockets.handle.take_checks(true);
    let (near, near_quic) = (arm.dial(&dtls.url).await.unwrap(), arm.dial(&quic.url).await.unwrap());
    let (far, far_quic) = (dtls.link().await, quic.link().await);
    for link in [&far, &far_quic] {
        assert_eq!(link.remote().port(), port(&sockets));
    }
    assert!(near.uses_direct_socket() && near_quic.uses_direct_socket() && !far.uses_direct_socket());
    // A wrong URL at the address of another link: nothing of that link goes to the dial.
    let wrong = format!("dtls://{}", quic.addr).parse().unwrap();
    let mut dialing = tokio::spawn(async move { (dial_with(&arm, &wrong).await, arm) });
    let stranger = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let mut check = [0; 20];
    check[1] = 1;
    check[4..8].copy_from_slice(&[0x21, 0x12, 0xa4, 0x42]);
    let to = SocketAddr::from(([127, 0, 0, 1], port(&sockets)));
    let (failed, _arm) = loop {
        stranger.send_to(&check, to).await.unwrap();
        let arrived = soon(sockets.checks.recv()).await.unwrap();
        assert_eq!((arrived.from, &arrived.datagram[..]), (stranger.local_addr().unwrap(), &check[..]));
        talk(&near, &far).await;
        talk(&near_quic, &far_quic).await;
        if let Ok(ended) = tokio::time::timeout(Duration::from_millis(20), &mut dialing).await {
            break ended.unwrap();
        }
    };
    failed.unwrap_err();
    talk(&near, &far).await;
    talk(&near_quic, &far_quic).await;
    assert_eq!((sockets.handle.overflowed(), sockets.handle.dtls_overflowed()), (0, 0));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn second_dtls_link_to_a_router_moves_when_the_first_ends() {
    let fleet = fleet(1);
    let mut router = dtls_router(&fleet);
    let (arm, sockets) = member(&fleet, LinkOptions::default());
    // A lane does not take the place of a link.
    let lane = soon(arm.dial_lane(&router.url, router.addr, LaneToken([7; 16]))).await.unwrap();
    let far_lane = router.link().await;
    assert!(!lane.uses_direct_socket() && far_lane.remote().port() != port(&sockets));
    let first = arm.dial(&router.url).await.unwrap();
    let far_first = router.link().await;
    assert!(first.uses_direct_socket() && far_first.remote().port() == port(&sockets));
    let second = arm.dial(&router.url).await.unwrap();
    let far_second = router.link().await;
    assert!(!second.uses_direct_socket() && far_second.remote().port() != port(&sockets));
    talk(&second, &far_second).await;
    talk(&first, &far_first).await;
    // Without a word on the second link: it moves by itself, and its peer sees that.
    first.close(CloseReason::Goodbye);
    soon(async {
        while far_second.remote().port() != port(&sockets) {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    })
    .await;
    assert!(second.uses_direct_socket());
    talk(&second, &far_second).await;
    // It has the place now, until it ends, though somebody still holds it.
    let third = arm.dial(&router.url).await.unwrap();
    let far_third = router.link().await;
    assert!(!third.uses_direct_socket());
    third.close(CloseReason::Goodbye);
    soon(far_third.closed()).await;
    second.close(CloseReason::Goodbye);
    soon(far_second.closed()).await;
    let fourth = arm.dial(&router.url).await.unwrap();
    let far_fourth = router.link().await;
    talk_until_at(port(&sockets), &fourth, &far_fourth).await;
    assert!(fourth.uses_direct_socket());
    talk(&lane, &far_lane).await;
    assert!(!lane.uses_direct_socket() && far_lane.remote().port() != port(&sockets));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dtls_links_follow_a_rebind() {
    let fleet = fleet(1);
    let mut router = dtls_router(&fleet);
    let mut quic = Server::start(enroll(&fleet, "router-2"), LinkOptions::default());
    let (arm, sockets) = member(&fleet, LinkOptions::default());
    let (near_quic, near) = (arm.dial(&quic.url).await.unwrap(), arm.dial(&router.url).await.unwrap());
    let (far_quic, far) = (quic.link().await, router.link().await);
    let apart = arm.dial(&router.url).await.unwrap();
    let far_apart = router.link().await;
    for _ in 0..3 {
        let (before, before_apart) = (port(&sockets), far_apart.remote().port());
        talk_until_at(before, &near, &far).await;
        arm.rebind().unwrap();
        assert_ne!(port(&sockets), before);
        talk_until_at(port(&sockets), &near, &far).await;
        talk_until_at(port(&sockets), &near_quic, &far_quic).await;
        soon(async {
            while far_apart.remote().port() == before_apart {
                talk(&apart, &far_apart).await;
            }
        })
        .await;
        assert!(near.uses_direct_socket() && !apart.uses_direct_socket());
    }
    // The place is still that of the first.
    near.close(CloseReason::Goodbye);
    talk_until_at(port(&sockets), &apart, &far_apart).await;
    assert!(apart.uses_direct_socket());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn dialer_without_direct_links_shares_nothing() {
    let fleet = fleet(1);
    let mut router = dtls_router(&fleet);
    let arm = dialer(enroll(&fleet, "arm-1"));
    let (one, two) = (arm.dial(&router.url).await.unwrap(), arm.dial(&router.url).await.unwrap());
    let (far_one, far_two) = (router.link().await, router.link().await);
    assert_ne!(far_one.remote(), far_two.remote());
    assert!(!one.uses_direct_socket() && !two.uses_direct_socket());
}
