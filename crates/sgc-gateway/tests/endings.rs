//! The ends of connections: clients get the reason, whatever they send or have not read.
#![allow(clippy::unwrap_used)]

mod support;

use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::json;
use sgc_gateway::foxglove::FoxgloveError;
use sgc_gateway::rosbridge::RosbridgeOptions;
use sgc_gateway::{
    Access, ListenAt, Protocol, Server, ServerError, ServerOptions, Session, SessionLimits, foxglove,
    rosbridge,
};
use sgc_websocket::WebSocket;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _, DuplexStream};
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::client::IntoClientRequest as _;
use tokio_tungstenite::tungstenite::protocol::Role;

use support::Site;

const PATIENCE: Duration = Duration::from_secs(20);
const FOXGLOVE: &str = "foxglove.sdk.v1";
/// Bytes that a client sends before it reads, more than the buffers of the kernel take.
const SENT_ON_BYTES: usize = 16 << 20;

async fn within<T>(work: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, work).await.expect("it should have been done by now")
}

async fn server(site: &Site, clients_max: usize) -> Server {
    let listen =
        ListenAt { protocol: Protocol::WebSocket, is_encrypted: false, addr: ([127, 0, 0, 1], 0).into() };
    let options = ServerOptions {
        name: "robot".into(),
        listen: vec![listen],
        access: Access::default(),
        keys: None,
        clients_max,
        limits: SessionLimits::default(),
    };
    Server::start(site.hub.clone(), options).await.unwrap()
}

async fn connect(addr: SocketAddr, subprotocol: Option<&str>) -> WebSocketStream<TcpStream> {
    let stream = TcpStream::connect(addr).await.unwrap();
    let mut request = format!("ws://{addr}/").into_client_request().unwrap();
    if let Some(name) = subprotocol {
        request.headers_mut().insert("sec-websocket-protocol", name.parse().unwrap());
    }
    within(tokio_tungstenite::client_async(request, stream)).await.unwrap().0
}

/// Reads up to the close frame, and returns its code and reason.
async fn close<S>(socket: &mut WebSocketStream<S>) -> Option<(u16, String)>
where
    S: tokio::io::AsyncRead + tokio::io::AsyncWrite + Unpin,
{
    // Pings of a connection that stays do not extend the wait.
    within(async {
        loop {
            if let Message::Close(why) = socket.next().await.expect("a close frame comes first").unwrap() {
                return why.map(|why| (why.code.into(), why.reason.to_string()));
            }
        }
    })
    .await
}

/// Lets a client of rosbridge make an error, and expects that it is told.
async fn make_error(socket: &mut WebSocketStream<TcpStream>) {
    socket.send(Message::text(r#"{"op":"dance"}"#)).await.unwrap();
    assert!(within(socket.next()).await.unwrap().unwrap().is_text());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_that_breaks_a_rule_and_sends_on_gets_the_code() {
    let site = Site::new().await;
    let server = server(&site, 64).await;
    let addr = server.local()[0].addr;
    let gigabyte = [&[0x82, 0xff][..], &(1_u64 << 30).to_be_bytes(), &[0; 4]].concat();
    for subprotocol in [None, Some(FOXGLOVE)] {
        for (wrong, code) in [
            // A frame without a mask.
            (vec![0x81, 0x01, b'x'], 1002),
            // A text that is not UTF-8.
            (vec![0x81, 0x81, 0, 0, 0, 0, 0xff], 1007),
            (gigabyte.clone(), 1009),
        ] {
            let mut socket = connect(addr, subprotocol).await;
            let stream = socket.get_mut();
            stream.write_all(&wrong).await.unwrap();
            within(stream.write_all(&vec![0; SENT_ON_BYTES])).await.unwrap();
            assert_eq!(close(&mut socket).await.unwrap().0, code, "{subprotocol:?}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn addresses_change_and_clients_of_those_that_stay_notice_nothing() {
    let at = |port: u16| ListenAt {
        protocol: Protocol::WebSocket,
        is_encrypted: false,
        addr: ([127, 0, 0, 1], port).into(),
    };
    let site = Site::new().await;
    let server = server(&site, 64).await;
    let mut stays = connect(server.local()[0].addr, None).await;
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    server.listen(vec![at(port), at(0)]).await.unwrap();
    let [fault] = &server.not_listening()[..] else { panic!("{:?}", server.not_listening()) };
    assert_eq!(fault.at, at(port));
    assert_eq!(server.status().listen.len(), 1);
    drop(taken);
    within(async {
        while !server.not_listening().is_empty() {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    })
    .await;
    let mut goes = connect(at(port).addr, None).await;
    make_error(&mut goes).await;
    // The port is free at once, also for another protocol.
    server.listen(vec![at(0), ListenAt { protocol: Protocol::Grpc, ..at(port) }]).await.unwrap();
    assert_eq!((server.not_listening(), server.local().len()), (Vec::new(), 2));
    assert!(!matches!(within(goes.next()).await, Some(Ok(_))), "its address is closed");
    make_error(&mut stays).await;
    // Without a certificate nothing changes.
    let encrypted = ListenAt { is_encrypted: true, ..at(0) };
    assert!(matches!(server.listen(vec![encrypted]).await, Err(ServerError::NoKey)));
    make_error(&mut stays).await;
    server.listen(Vec::new()).await.unwrap();
    assert!(!matches!(within(stays.next()).await, Some(Ok(_))));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn client_without_a_free_place_is_told() {
    let site = Site::new().await;
    let server = server(&site, 1).await;
    let addr = server.local()[0].addr;
    let mut first = connect(addr, None).await;
    // The client has its place only after the upgrade is answered.
    make_error(&mut first).await;
    for subprotocol in [None, Some(FOXGLOVE)] {
        let mut second = connect(addr, subprotocol).await;
        let (code, why) = close(&mut second).await.unwrap();
        assert_eq!(code, 1013);
        assert!(why.starts_with("1 clients at most for "), "{why}");
    }
    assert_eq!(server.status().refused["too many clients"], 2);
    make_error(&mut first).await;
}

/// Lets a client ask much through a narrow pipe, close before it reads, and expects the answer to its close.
async fn leave<F>(
    site: &Site,
    question: String,
    serve: impl FnOnce(WebSocket<DuplexStream>, Arc<Session>) -> F,
) where
    F: Future<Output = ()> + Send + 'static,
{
    const PIPE_BYTES: usize = 1 << 15;
    const QUESTIONS: usize = 60;
    let (here, there) = tokio::io::duplex(PIPE_BYTES);
    let socket = WebSocket::new(there, BytesMut::new(), 64 << 20);
    let served = tokio::spawn(serve(socket, Arc::new(site.session("page"))));
    let mut page = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
    for _ in 0..QUESTIONS {
        within(page.send(Message::text(question.clone()))).await.unwrap();
    }
    // Time is virtual, and goes on once the answers fill the pipe.
    tokio::time::sleep(Duration::from_millis(1)).await;
    within(page.send(Message::Close(None))).await.unwrap();
    tokio::time::sleep(Duration::from_millis(1)).await;
    assert_eq!(close(&mut page).await, None);
    within(served).await.unwrap();
}

#[tokio::test]
async fn close_of_a_client_is_answered_while_output_waits() {
    const LONG: usize = 3000;
    let site = Site::new().await;
    tokio::time::pause();
    let asset = json!({"op": "fetchAsset", "uri": "x".repeat(LONG), "requestId": 1}).to_string();
    leave(&site, asset, |socket, session| async move {
        foxglove::serve(socket, session, foxglove::Options::default()).await.unwrap();
    })
    .await;
    let unknown = json!({"op": "subscribe", "topic": "/a", "id": "x".repeat(1000), "type": 3}).to_string();
    leave(&site, unknown, |socket, session| async move {
        rosbridge::serve(socket, session, RosbridgeOptions::default()).await.unwrap();
    })
    .await;
}

/// Passes bytes on, to the client `bytes` each second.
async fn pass_slowly(gateway: DuplexStream, client: DuplexStream, bytes: usize) {
    let (mut from_gateway, mut to_gateway) = tokio::io::split(gateway);
    let (mut from_client, mut to_client) = tokio::io::split(client);
    let back = tokio::io::copy(&mut from_client, &mut to_gateway);
    let forth = async {
        let mut some = vec![0; bytes];
        while let Ok(read @ 1..) = from_gateway.read(&mut some).await {
            to_client.write_all(&some[..read]).await.unwrap();
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
    };
    tokio::select! {
        _ = back => {}
        () = forth => {}
    }
}

#[tokio::test]
async fn slow_viewer_is_not_silent_and_one_that_reads_nothing_is() {
    const PIPE_BYTES: usize = 1 << 16;
    const SLOW_BYTES: usize = 20 << 10;
    const ASSETS: usize = 60;
    const ASSET_BYTES: usize = 60_000;
    let site = Site::new().await;
    tokio::time::pause();
    let serve = |here| {
        let socket = WebSocket::new(here, BytesMut::new(), 64 << 20);
        let served = foxglove::serve(socket, Arc::new(site.session("page")), foxglove::Options::default());
        tokio::spawn(served)
    };
    let ask = async |page: &mut WebSocketStream<DuplexStream>, asset: usize| {
        let question = json!({"op": "fetchAsset", "uri": "x".repeat(ASSET_BYTES), "requestId": asset});
        page.send(Message::text(question.to_string())).await
    };
    // A pipe that never fills stands for the buffers of both systems, which hold a ping back.
    for narrow_bytes in [PIPE_BYTES, 8 << 20] {
        let ((here, there), (near, far)) = (tokio::io::duplex(narrow_bytes), tokio::io::duplex(PIPE_BYTES));
        let served = serve(here);
        let _passing = tokio::spawn(pass_slowly(there, near, SLOW_BYTES));
        let mut page = WebSocketStream::from_raw_socket(far, Role::Client, None).await;
        for asset in 0..ASSETS {
            ask(&mut page, asset).await.unwrap();
        }
        let begun = tokio::time::Instant::now();
        let mut answers = 0;
        while answers < ASSETS {
            let next = within(page.next()).await.expect("it only reads slowly").unwrap();
            answers += usize::from(next.is_binary());
        }
        assert!(begun.elapsed() > 2 * foxglove::Options::default().silence_max);
        assert!(!served.is_finished());
    }
    let (here, far) = tokio::io::duplex(PIPE_BYTES);
    let served = serve(here);
    let mut page = WebSocketStream::from_raw_socket(far, Role::Client, None).await;
    for asset in 0..ASSETS {
        ask(&mut page, asset).await.unwrap();
    }
    let ended = served.await.unwrap();
    assert!(matches!(ended, Err(FoxgloveError::Silent { .. })), "{ended:?}");
}
