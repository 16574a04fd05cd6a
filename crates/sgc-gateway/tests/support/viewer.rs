//! A client of Foxglove's protocol on loopback, and the gateway's end of its connection.

#![allow(dead_code, reason = "each test program uses a part")]

use std::future::poll_fn;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::{SinkExt, StreamExt};
use serde_json::Value;
use sgc_gateway::Session;
use sgc_gateway::foxglove::{self, FoxgloveError, Options, SUBPROTOCOLS};
use sgc_websocket::{Request, WebSocket};
use tokio::net::{TcpListener, TcpStream};
use tokio::task::JoinHandle;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message as Frame;

const PATIENCE: Duration = Duration::from_secs(10);

pub(crate) type Ended = JoinHandle<Result<(), FoxgloveError>>;

/// Serves the next client.
pub(crate) async fn serve_one(session: Session, options: Options) -> (SocketAddr, Ended) {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap();
    let ended = tokio::spawn(async move {
        let (mut stream, _) = listener.accept().await.unwrap();
        let request = Request::read(&mut stream, 8 << 10).await.unwrap();
        let asked: Vec<_> = request
            .fields("sec-websocket-protocol")
            .flat_map(|list| list.split(','))
            .map(str::trim)
            .collect();
        let chosen = SUBPROTOCOLS.into_iter().find(|known| asked.contains(known));
        let input = request.accept(&mut stream, chosen).await.unwrap();
        let socket = WebSocket::new(stream, input, 64 << 20);
        foxglove::serve(socket, Arc::new(session), options).await
    });
    (address, ended)
}

/// A Foxglove client.
pub(crate) struct Viewer {
    socket: WebSocketStream<TcpStream>,
    /// Frames that came and were not asked for yet.
    kept: Vec<Frame>,
    pub(crate) ended: Ended,
}

impl Viewer {
    /// Connects, and returns the client with the server's description.
    pub(crate) async fn new(session: Session) -> (Self, Value) {
        Self::with(session, Options::default()).await
    }

    pub(crate) async fn with(session: Session, options: Options) -> (Self, Value) {
        let (address, ended) = serve_one(session, options).await;
        let stream = TcpStream::connect(address).await.unwrap();
        let (socket, _) = tokio_tungstenite::client_async(format!("ws://{address}/"), stream).await.unwrap();
        let mut viewer = Self { socket, kept: Vec::new(), ended };
        let info = viewer.text("serverInfo").await;
        (viewer, info)
    }

    pub(crate) async fn say(&mut self, value: Value) {
        self.send(Frame::text(value.to_string())).await;
    }

    pub(crate) async fn send(&mut self, frame: Frame) {
        self.socket.send(frame).await.unwrap();
    }

    /// Sends a frame, at most for `max`. An unsent frame is sent later, while receiving.
    pub(crate) async fn try_send(&mut self, frame: Frame, max: Duration) -> bool {
        tokio::time::timeout(max, self.socket.send(frame)).await.is_ok_and(|sent| sent.is_ok())
    }

    /// Sends an opcode, numbers and a payload.
    pub(crate) async fn binary(&mut self, opcode: u8, numbers: &[u32], payload: &[u8]) {
        let mut bytes = vec![opcode];
        numbers.iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes.extend(payload);
        self.send(Frame::Binary(bytes.into())).await;
    }

    /// Returns the next frame that matches.
    async fn next(&mut self, what: &str, is: impl Fn(&Frame) -> bool) -> Frame {
        if let Some(at) = self.kept.iter().position(&is) {
            return self.kept.remove(at);
        }
        loop {
            let socket = &mut self.socket;
            // Unsent frames are sent meanwhile.
            let next = poll_fn(|cx| {
                let _ = socket.poll_flush_unpin(cx);
                socket.poll_next_unpin(cx)
            });
            let next = tokio::time::timeout(PATIENCE, next).await;
            let frame = next.unwrap_or_else(|_| panic!("no {what}, but {:?}", self.kept));
            let frame = frame.unwrap_or_else(|| panic!("the end, and no {what}")).unwrap();
            if is(&frame) {
                return frame;
            }
            self.kept.push(frame);
        }
    }

    /// Returns the next text with this op that matches.
    pub(crate) async fn text_that(&mut self, op: &str, is: impl Fn(&Value) -> bool) -> Value {
        let read =
            |frame: &Frame| frame.to_text().ok().and_then(|text| serde_json::from_str::<Value>(text).ok());
        let fits = |frame: &Frame| read(frame).is_some_and(|value| value["op"] == op && is(&value));
        let frame = self.next(op, |frame| frame.is_text() && fits(frame)).await;
        read(&frame).unwrap()
    }

    pub(crate) async fn text(&mut self, op: &str) -> Value {
        self.text_that(op, |_| true).await
    }

    /// Returns the channel of a topic, once it exists.
    pub(crate) async fn channel(&mut self, topic: &str) -> Value {
        self.listed("advertise", "channels", "topic", topic).await
    }

    /// Returns a service, once it exists.
    pub(crate) async fn service(&mut self, name: &str) -> Value {
        self.listed("advertiseServices", "services", "name", name).await
    }

    async fn listed(&mut self, op: &str, list: &str, by: &str, name: &str) -> Value {
        let find = |value: &Value| value[list].as_array()?.iter().find(|one| one[by] == name).cloned();
        // The text may list others that are looked for later, so it stays.
        loop {
            let value = self.text_that(op, |value| find(value).is_some()).await;
            self.kept.push(Frame::text(value.to_string()));
            if let Some(found) = find(&value) {
                return found;
            }
        }
    }

    /// Drops all kept frames.
    pub(crate) fn forget(&mut self) {
        self.kept.clear();
    }

    /// Returns the next binary message with this opcode, without the opcode.
    pub(crate) async fn binary_of(&mut self, opcode: u8) -> Bytes {
        let is = |frame: &Frame| matches!(frame, Frame::Binary(bytes) if bytes.first() == Some(&opcode));
        self.next(&format!("binary message {opcode}"), is).await.into_data().slice(1..)
    }

    /// Returns subscription and payload of the next message of a topic.
    pub(crate) async fn message(&mut self) -> (u32, Bytes) {
        let bytes = self.binary_of(1).await;
        (u32::from_le_bytes(bytes[..4].try_into().unwrap()), bytes.slice(12..))
    }

    pub(crate) async fn subscribe(&mut self, id: u32, channel: &Value) {
        let wanted = serde_json::json!({"id": id, "channelId": channel["id"]});
        self.say(serde_json::json!({"op": "subscribe", "subscriptions": [wanted]})).await;
    }

    /// Returns the next status that contains these words.
    pub(crate) async fn status(&mut self, words: &str) -> Value {
        self.text_that("status", |value| value["message"].as_str().is_some_and(|said| said.contains(words)))
            .await
    }

    /// Disconnects, and waits until the gateway's end has ended.
    pub(crate) async fn leave(mut self) -> Result<(), FoxgloveError> {
        self.socket.close(None).await.unwrap();
        tokio::time::timeout(PATIENCE, self.ended).await.expect("it should have ended").unwrap()
    }
}
