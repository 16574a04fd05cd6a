//! A client of the rosbridge protocol, and a gateway for it.

use std::sync::Arc;
use std::time::Duration;

use bytes::BytesMut;
use futures_util::{SinkExt as _, StreamExt as _};
use serde_json::{Value as Json, json};
use sgc_gateway::rosbridge::{RosbridgeError, RosbridgeOptions, serve};
use sgc_gateway::{Scope, Session, SessionLimits};
use sgc_websocket::WebSocket;
use tokio::io::{AsyncRead, AsyncWrite, DuplexStream};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

use crate::support::Site;

pub(crate) const PATIENCE: Duration = Duration::from_secs(20);

/// A client, and the task that serves it.
pub(crate) struct Client<S = TcpStream> {
    pub(crate) socket: WebSocketStream<S>,
    pub(crate) served: JoinHandle<Result<(), RosbridgeError>>,
}

/// Returns a client with all rights.
pub(crate) async fn client(site: &Site) -> Client {
    connect(site.session("browser"), RosbridgeOptions::default()).await
}

/// Returns a client with this scope.
pub(crate) async fn client_with(site: &Site, scope: Scope) -> Client {
    connect(site.session_with("browser", scope), RosbridgeOptions::default()).await
}

/// Returns a session with these limits.
pub(crate) fn bounded(site: &Site, limits: SessionLimits) -> Arc<Session> {
    let session = site.session("browser");
    Arc::new(Session::new(&site.hub, session.client().clone(), limits))
}

/// Connects over TCP on loopback, with both handshakes.
pub(crate) async fn connect(session: impl Into<Arc<Session>>, options: RosbridgeOptions) -> Client {
    let session = session.into();
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let served = tokio::spawn(async move {
        let (stream, _) = listener.accept().await.unwrap();
        stream.set_nodelay(true).unwrap();
        let accepted = WebSocket::accept(stream, options.message_bytes_max);
        serve(accepted.await.unwrap(), session, options).await
    });
    let stream = TcpStream::connect(address).await.unwrap();
    stream.set_nodelay(true).unwrap();
    let (socket, _) = tokio_tungstenite::client_async(format!("ws://{address}/"), stream).await.unwrap();
    Client { socket, served }
}

/// Connects over a pipe with this capacity, without handshakes and without passing time.
pub(crate) async fn pipe(
    session: impl Into<Arc<Session>>,
    options: RosbridgeOptions,
    pipe_bytes: usize,
) -> Client<DuplexStream> {
    let session = session.into();
    let (here, there) = tokio::io::duplex(pipe_bytes);
    let served = tokio::spawn(async move {
        let socket = WebSocket::new(there, BytesMut::new(), options.message_bytes_max);
        serve(socket, session, options).await
    });
    let socket = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
    Client { socket, served }
}

impl<S: AsyncRead + AsyncWrite + Unpin> Client<S> {
    pub(crate) async fn send(&mut self, op: Json) {
        self.send_text(op.to_string()).await;
    }

    pub(crate) async fn send_text(&mut self, text: String) {
        self.socket.send(Message::Text(text.into())).await.unwrap();
    }

    /// Returns the next message of any kind.
    pub(crate) async fn message(&mut self) -> Message {
        loop {
            let next = tokio::time::timeout(PATIENCE, self.socket.next()).await;
            match next.expect("something should have come by now").expect("it should not have ended").unwrap()
            {
                Message::Ping(_) | Message::Pong(_) => {}
                message => return message,
            }
        }
    }

    pub(crate) async fn next(&mut self) -> Json {
        match self.message().await {
            Message::Text(text) => serde_json::from_str(&text).unwrap(),
            other => panic!("{other:?}"),
        }
    }

    pub(crate) async fn next_binary(&mut self) -> Vec<u8> {
        match self.message().await {
            Message::Binary(bytes) => bytes.to_vec(),
            other => panic!("{other:?}"),
        }
    }

    /// Returns text and id of the next message, which must be an error status.
    pub(crate) async fn status(&mut self) -> (String, Json) {
        let next = self.next().await;
        assert_eq!((&next["op"], &next["level"]), (&json!("status"), &json!("error")), "{next}");
        (next["msg"].as_str().unwrap().to_owned(), next["id"].clone())
    }

    /// Sends an invalid op and returns the error text.
    pub(crate) async fn told(&mut self, op: Json) -> String {
        self.send(op).await;
        self.status().await.0
    }

    /// Calls a service and returns `values` and `result` of the answer.
    pub(crate) async fn call(&mut self, service: &str, args: Json) -> (Json, bool) {
        let id = format!("call_service:{service}:1");
        self.send(json!({ "op": "call_service", "id": id, "service": service, "args": args })).await;
        let answer = self.next().await;
        assert_eq!((&answer["op"], &answer["id"]), (&json!("service_response"), &json!(id)), "{answer}");
        assert_eq!(answer["service"], service);
        (answer["values"].clone(), answer["result"].as_bool().unwrap())
    }

    /// Waits until everything sent so far was handled.
    pub(crate) async fn settle(&mut self) {
        let (_, is_done) = self.call("/rosapi/get_time", json!({})).await;
        assert!(is_done);
    }

    /// Waits until everything sent so far was handled, and skips other messages.
    pub(crate) async fn settle_amid(&mut self) {
        self.send(json!({ "op": "call_service", "id": "settle", "service": "/rosapi/get_time" })).await;
        while self.next().await["id"] != "settle" {}
    }

    pub(crate) async fn subscribe(&mut self, topic: &str) {
        self.send(json!({ "op": "subscribe", "topic": topic, "type": "std_msgs/String" })).await;
        self.settle().await;
    }

    /// Returns the code and reason with which the gateway closed the connection.
    pub(crate) async fn closed(&mut self) -> (u16, String) {
        loop {
            match self.message().await {
                Message::Close(Some(frame)) => return (frame.code.into(), frame.reason.to_string()),
                Message::Text(_) | Message::Binary(_) => {}
                other => panic!("{other:?}"),
            }
        }
    }
}
