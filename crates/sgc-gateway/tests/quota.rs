//! The bounds of one credential over all its connections, of all other hosts together, and the reserve for programs
//! on this host.
#![allow(clippy::unwrap_used)]

mod support;
#[path = "support/viewer.rs"]
mod viewer;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::BytesMut;
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::{self, RosbridgeOptions};
use sgc_gateway::{
    Access, AccessRules, AdmissionRequest, Advertise, Anonymous, Content, Form, GatewayError, Pool, Server,
    ServerOptions, Session, SessionLimits, Subscribe,
};
use sgc_ros::{RosWriter as _, SampleKind};
use sgc_wire::{Durability, History, Qos, UnixMillis};

use sgc_websocket::WebSocket;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use support::{STRING, Site, eventually, string};
use viewer::Viewer;

const LIMITS: SessionLimits = SessionLimits {
    waiting_bytes_max: 1 << 20,
    subscriptions_max: 2,
    publications_max: 2,
    servings_max: 2,
    calls_max: 2,
    waits_max: 2,
};
/// Bounds in sessions: of one credential, of all other hosts, in total.
const SHARES: [usize; 3] = [4, 12, 16];

/// Returns a session on its own connection from `peer`.
fn session(site: &Site, peer: &str) -> Session {
    let access = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
    let peer: SocketAddr = peer.parse().unwrap();
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64;
    let admission = AdmissionRequest {
        peer,
        encrypted: true,
        origin: None,
        token: None,
        certificate: None,
        now: UnixMillis(now),
    };
    Session::new(&site.hub, access.admit(&admission).unwrap(), LIMITS)
}

/// Creates readers with a different QoS each, on a new connection each time.
async fn flood(site: &Site, peer: &str) -> (Vec<sgc_gateway::Subscription>, GatewayError) {
    let mut held = Vec::new();
    loop {
        let depth = held.len() as u32 + 1;
        let qos = Some(Qos { history: History::KeepLast(depth), ..Qos::default() });
        let topic = format!("/of/h{}", peer.split(':').next().unwrap().replace(['.', '['], "_"));
        let wanted =
            Subscribe { topic, type_name: Some(STRING.into()), qos, depth: 1, ..Subscribe::default() };
        match session(site, peer).subscribe(wanted).await {
            Ok(subscription) => held.push(subscription),
            Err(why) => return (held, why),
        }
        assert!(held.len() <= 1000, "nothing stops it");
    }
}

fn is_of(why: &GatewayError, wanted: Pool) -> bool {
    matches!(why, GatewayError::Crowded { pool, .. } if *pool == wanted)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn many_connections_of_one_host_have_no_more_readers_than_a_few() {
    let site = Site::new().await;
    let (held, why) = flood(&site, "10.0.0.1:1").await;
    assert_eq!(held.len(), SHARES[0] * LIMITS.subscriptions_max);
    assert!(is_of(&why, Pool::Credential), "{why}");
    assert_eq!(site.hub.readers(), held.len());
    // Lingering readers still count, so leaving and returning creates no more of them.
    drop(held);
    let (again, why) = flood(&site, "10.0.0.1:1").await;
    assert!(is_of(&why, Pool::Credential), "{why}");
    assert!(site.hub.readers() <= SHARES[0] * LIMITS.subscriptions_max, "{}", site.hub.readers());
    drop(again);
    eventually(|| site.hub.readers() == 0).await;
    // Other hosts have their own bounds, and all of them leave a reserve for this one.
    let mut all = Vec::new();
    for n in 2..=9 {
        let (held, why) = flood(&site, &format!("10.0.0.{n}:1")).await;
        all.push(held);
        if is_of(&why, Pool::Remote) {
            break;
        }
    }
    let (held, why) = flood(&site, "10.0.0.77:1").await;
    assert!(held.is_empty() && is_of(&why, Pool::Remote), "{why}");
    let (held, why) = flood(&site, "127.0.0.1:1").await;
    assert!(held.len() >= (SHARES[2] - SHARES[1]) * LIMITS.subscriptions_max, "{}", held.len());
    assert!(is_of(&why, Pool::Total), "{why}");
    let told = "readers on the local network at most for all clients";
    assert!(
        why.to_string().ends_with(told) || why.to_string().ends_with("subscriptions at most for all clients")
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn topics_services_and_calls_of_one_host_are_bounded_over_its_connections() {
    let site = Site::new().await;
    let at = |n: usize| format!("[2001:db8::{n:x}]:1");
    let share = SHARES[0] * LIMITS.publications_max;
    let (mut topics, mut services, mut calls) = (Vec::new(), Vec::new(), Vec::new());
    let of = Some("std_srvs/srv/SetBool");
    let mut silent = site.session("program").serve("/silent", of).await.unwrap();
    for n in 0..share {
        let host = session(&site, &at(n));
        let wanted =
            Advertise { topic: format!("/t{n}"), type_name: Some(STRING.into()), qos: Qos::default() };
        topics.push(host.advertise(wanted).await.unwrap());
        services.push(host.serve(&format!("/s{n}"), of).await.unwrap());
        calls.push(tokio::spawn(async move {
            let request = Content::json(r#"{"data": true}"#);
            host.call("/silent", of, &request, Form::Json, Duration::from_secs(60)).await
        }));
        silent.next().await.unwrap();
    }
    let host = session(&site, &at(share));
    let wanted = Advertise { topic: "/more".into(), type_name: Some(STRING.into()), qos: Qos::default() };
    let request = Content::json(r#"{"data": true}"#);
    let refused = [
        host.advertise(wanted.clone()).await.unwrap_err(),
        host.serve("/more", of).await.unwrap_err(),
        host.call("/silent", of, &request, Form::Json, Duration::from_secs(1)).await.unwrap_err(),
    ];
    assert!(refused.iter().all(|why| is_of(why, Pool::Credential)), "{refused:?}");
    // Another host has its own bounds, and an ended publication makes room.
    let other = session(&site, "[2001:db8:0:1::1]:1");
    other.advertise(wanted.clone()).await.unwrap();
    topics.pop();
    host.advertise(wanted).await.unwrap();
    calls.iter().for_each(tokio::task::JoinHandle::abort);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn messages_that_are_kept_for_later_readers_are_bounded_in_bytes() {
    const MESSAGE_BYTES: usize = 100 << 10;
    let site = Site::new().await;
    let content = Content::json(format!(r#"{{"data":"{}"}}"#, "x".repeat(MESSAGE_BYTES)));
    let latched = |history| Qos { durability: Durability::TransientLocal, history, ..Qos::default() };
    let wanted = |topic: &str, history| Advertise {
        topic: topic.to_owned(),
        type_name: Some(STRING.into()),
        qos: latched(history),
    };
    // One session is bounded, whatever its depth.
    let one = session(&site, "10.0.0.1:1");
    let publication = one.advertise(wanted("/all", History::KeepAll)).await.unwrap();
    let offered = || {
        let graph = site.hub.graph();
        Some(graph.topics.get("/all")?.publishers.first()?.qos.history)
    };
    eventually(|| offered() == Some(History::KeepLast(100))).await;
    let mut published = 0;
    let refused = loop {
        match publication.publish(&content).await {
            Ok(()) => published += 1,
            Err(refused) => break refused,
        }
        assert!(published < 1000, "nothing stops it");
    };
    assert_eq!(published, LIMITS.waiting_bytes_max / MESSAGE_BYTES);
    assert!(matches!(refused, GatewayError::TooMany { .. }), "{refused}");
    drop(publication);
    // A writer keeps its last messages only, and many connections together are bounded, too.
    let mut held = Vec::new();
    let refused = loop {
        let host = session(&site, "10.0.0.2:1");
        let publication = host.advertise(wanted("/one", History::KeepLast(10))).await.unwrap();
        let mut refused = None;
        for _ in 0..30 {
            if let Err(why) = publication.publish(&content).await {
                refused = Some(why);
                break;
            }
        }
        held.push((host, publication));
        if let Some(refused) = refused {
            break refused;
        }
        assert!(held.len() < 100, "nothing stops it");
    };
    assert!(is_of(&refused, Pool::Credential), "{refused}");
    assert_eq!(held.len(), SHARES[0] + 1);
    // A publisher that leaves makes room once its writer has ended.
    held.remove(0);
    let (_, last) = held.last().unwrap();
    let until_room = async {
        while last.publish(&content).await.is_err() {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(20), until_room).await.unwrap();
}

/// Returns the error of a credential without room for more arguments of calls.
fn arguments_crowded() -> String {
    let max = SHARES[0] * LIMITS.waiting_bytes_max;
    format!("{max} bytes of arguments that wait at most for {}", Pool::Credential)
}

/// Returns arguments of which one session has room for one copy, but not for two.
fn long_arguments() -> String {
    let pad = " ".repeat(LIMITS.waiting_bytes_max - (64 << 10));
    format!(r#"{{"data": true{pad}}}"#)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn arguments_of_calls_that_wait_are_bounded_over_connections() {
    let site = Site::new().await;
    let of = "std_srvs/srv/SetBool";
    let mut silent = site.session("program").serve("/silent", Some(of)).await.unwrap();
    let arguments = long_arguments();
    let call = |id: usize| {
        format!(
            r#"{{"op": "call_service", "id": "{id}", "service": "/silent", "timeout": 60, "args": {arguments}}}"#
        )
    };
    let mut pages = Vec::new();
    let refused: Json = loop {
        let (here, there) = tokio::io::duplex(1 << 20);
        let options = RosbridgeOptions::default();
        let there = WebSocket::new(there, BytesMut::new(), options.message_bytes_max);
        let host = Arc::new(session(&site, "10.0.0.1:1"));
        let served = tokio::spawn(rosbridge::serve(there, host, options));
        let mut page = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
        page.send(Message::text(call(pages.len()))).await.unwrap();
        let asked = tokio::select! {
            answer = page.next() => Err(answer.unwrap().unwrap().into_text().unwrap()),
            request = silent.next() => Ok(request.unwrap()),
        };
        pages.push((page, served));
        match asked {
            Ok(_) => assert!(pages.len() < 100, "nothing stops it"),
            Err(told) => break serde_json::from_str(&told).unwrap(),
        }
    };
    assert_eq!(pages.len(), SHARES[0] + 1);
    assert!(refused["values"].as_str().unwrap().ends_with(&arguments_crowded()), "{refused}");
    // A session has its own bound, and a client that leaves makes room.
    let (page, _) = &mut pages[0];
    page.send(Message::text(call(200))).await.unwrap();
    let told = page.next().await.unwrap().unwrap().into_text().unwrap();
    let own = format!("{} bytes of arguments that wait at most for a client", LIMITS.waiting_bytes_max);
    assert!(told.contains(&own), "{told}");
    drop(pages.remove(0).0);
    let (last, _) = pages.last_mut().unwrap();
    let until_room = async {
        loop {
            last.send(Message::text(call(201))).await.unwrap();
            tokio::select! {
                refused = last.next() => drop(refused.unwrap().unwrap()),
                request = silent.next() => break drop(request),
            }
        }
    };
    tokio::time::timeout(Duration::from_secs(20), until_room).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_of_viewers_that_wait_are_bounded_over_connections() {
    let site = Site::new().await;
    let of = Some("std_srvs/srv/SetBool");
    let mut silent = site.session("program").serve("/silent", of).await.unwrap();
    let mut payload = b"json".to_vec();
    payload.extend(long_arguments().as_bytes());
    let mut viewers = Vec::new();
    let refused = loop {
        let (mut viewer, _) = Viewer::new(session(&site, "10.0.0.1:1")).await;
        let id = loop {
            let listed = viewer.text("advertiseServices").await;
            let listed = listed["services"].as_array().unwrap();
            if let Some(known) = listed.iter().find(|known| known["name"] == json!("/silent")) {
                break u32::try_from(known["id"].as_u64().unwrap()).unwrap();
            }
        };
        viewer.binary(2, &[id, 1, 4], &payload).await;
        let asked = tokio::select! {
            failure = viewer.text("serviceCallFailure") => Err(failure),
            request = silent.next() => Ok(request.unwrap()),
        };
        viewers.push(viewer);
        match asked {
            Ok(_) => assert!(viewers.len() < 100, "nothing stops it"),
            Err(told) => break told,
        }
    };
    assert_eq!(viewers.len(), SHARES[0] + 1);
    assert_eq!(refused["message"], arguments_crowded());
}

/// Connects a page from one host that can change to another: its token is the address.
async fn page_that_changes(site: &Site, peer: &str) -> WebSocketStream<tokio::io::DuplexStream> {
    let (here, there) = tokio::io::duplex(1 << 20);
    let hub = site.hub.clone();
    let admit = move |peer: &str| {
        let access = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
        let (peer, now) = (peer.parse().unwrap(), UnixMillis(1_795_000_000_000));
        let admission =
            AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now };
        access.admit(&admission).unwrap()
    };
    let session = Session::new(&hub, admit(peer), LIMITS);
    let authenticate: rosbridge::Authenticate = Arc::new(move |token| Ok(admit(token)));
    let options = RosbridgeOptions { authenticate: Some(authenticate), ..RosbridgeOptions::default() };
    let there = WebSocket::new(there, BytesMut::new(), options.message_bytes_max);
    tokio::spawn(rosbridge::serve(there, Arc::new(session), options));
    let mut page = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
    page.send(Message::text(r#"{"op": "set_level", "level": "info"}"#)).await.unwrap();
    page
}

/// Shows a token within the session, and returns the answer.
async fn auth(page: &mut WebSocketStream<tokio::io::DuplexStream>, token: &str) -> String {
    page.send(Message::text(format!(r#"{{"op": "auth", "token": "{token}"}}"#))).await.unwrap();
    page.next().await.unwrap().unwrap().into_text().unwrap().to_string()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn session_counts_for_its_latest_credential() {
    let site = Site::new().await;
    let subscribe = |n: usize| format!(r#"{{"op": "subscribe", "topic": "/p{n}", "type": "{STRING}"}}"#);
    let share = SHARES[0] * LIMITS.subscriptions_max;
    let mut first = page_that_changes(&site, "10.0.0.1:1").await;
    for n in 0..LIMITS.subscriptions_max {
        first.send(Message::text(subscribe(n))).await.unwrap();
    }
    eventually(|| site.hub.readers() == LIMITS.subscriptions_max).await;
    let told = auth(&mut first, "10.0.0.2:1").await;
    assert!(told.contains("you are"), "{told}");
    // The first host has its whole bound again, and the session counts for the second one.
    let (own, why) = flood(&site, "10.0.0.1:1").await;
    assert_eq!(own.len(), share);
    assert!(is_of(&why, Pool::Credential), "{why}");
    let (others, why) = flood(&site, "10.0.0.2:1").await;
    assert_eq!(others.len(), share - LIMITS.subscriptions_max);
    assert!(is_of(&why, Pool::Credential), "{why}");
    // A session cannot change to a credential without room.
    let told = auth(&mut first, "10.0.0.1:1").await;
    let max = format!("{share} subscriptions at most for {}", Pool::Credential);
    assert!(told.contains(&max), "{told}");
    let end = first.next().await.unwrap().unwrap();
    assert!(matches!(&end, Message::Close(Some(why)) if u16::from(why.code) == 1013), "{end:?}");
    drop((own, first));
    // The session's readers ended with it.
    let until_room = async {
        while flood(&site, "10.0.0.2:1").await.0.len() < LIMITS.subscriptions_max {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(20), until_room).await.unwrap();
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_without_room_for_history_does_not_cut_that_of_others() {
    const MESSAGES: usize = 3;
    const MESSAGE_BYTES: usize = 300 << 10;
    let site = Site::new().await;
    let latched = Qos {
        durability: Durability::TransientLocal,
        history: History::KeepLast(MESSAGES as u32),
        ..Qos::default()
    };
    let writers: Vec<_> = (0..2).map(|n| site.writer(&format!("/kept{n}"), latched.clone())).collect();
    for (n, writer) in writers.iter().enumerate() {
        site.knows(&format!("/kept{n}")).await;
        for number in 0..MESSAGES {
            let text = format!("{number}{}", "x".repeat(MESSAGE_BYTES));
            writer.write(SampleKind::Write, number as i64, string(&text)).unwrap();
        }
    }
    let options = ServerOptions {
        name: "robot".into(),
        listen: Vec::new(),
        access: Access::new(AccessRules::default()),
        keys: None,
        clients_max: 64,
        limits: LIMITS,
    };
    let server = Server::start(site.hub.clone(), options).await.unwrap();
    let wanted = |n: usize| Subscribe { topic: format!("/kept{n}"), depth: 10, ..Subscribe::default() };
    // The history of the first topic takes all of the client's room.
    let poor = session(&site, "10.0.0.1:1");
    let mut held = Vec::new();
    for n in 0..writers.len() {
        let mut subscription = poor.subscribe(wanted(n)).await.unwrap();
        for _ in 0..MESSAGES {
            tokio::time::timeout(Duration::from_secs(20), subscription.next()).await.unwrap().unwrap();
        }
        held.push(subscription);
    }
    let not_kept = server.status().refused["messages not kept for later subscribers"];
    assert_eq!(not_kept, MESSAGES as u64);
    assert_eq!(site.hub.readers(), 2);
    let mut later = session(&site, "10.0.0.2:1").subscribe(wanted(1)).await.unwrap();
    for number in 0..MESSAGES {
        let delivery = tokio::time::timeout(Duration::from_secs(20), later.next()).await.unwrap().unwrap();
        assert_eq!(delivery.message.source_timestamp_ns, number as i64);
    }
    assert_eq!(site.hub.readers(), 3);
    // The next client shares the reader with the complete history.
    let mut next = session(&site, "10.0.0.3:1").subscribe(wanted(1)).await.unwrap();
    tokio::time::timeout(Duration::from_secs(20), next.next()).await.unwrap().unwrap();
    assert_eq!(site.hub.readers(), 3);
}
