//! A program without ROS that sends and receives messages, by protocol and encoding. It reads only the number of a
//! message, so that the gateway is measured and not this program.

use anyhow::{Context, Result, bail, ensure};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use bytes::Bytes;
use futures_util::{SinkExt as _, StreamExt as _, stream};
use serde_json::json;
use sgc_gateway::grpc::{MESSAGE_BYTES_MAX, proto};
use tokio::net::TcpStream;
use tokio::sync::mpsc;
use tokio::task::JoinHandle;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tonic::transport::{Channel, Endpoint};

use super::scene::{Scene, TYPE, data_bytes, now_ns};
use proto::gateway_client::GatewayClient;
use proto::{publish_request, subscribe_response};

/// Bytes of a CDR message in front of its number: the encapsulation header.
const HEADER_BYTES: usize = 4;
/// And of its data: number, time and length.
const BEFORE_DATA_BYTES: usize = HEADER_BYTES + 20;
/// A number is among the first bytes of JSON.
const NUMBER_WITHIN_BYTES: usize = 160;
/// Messages that a subscriber lets wait.
const DEPTH: u32 = 1000;
/// Messages that are handed to gRPC ahead.
const AHEAD: usize = 64;
/// Bytes passed to the socket before it is flushed.
const FLUSH_BYTES: usize = 64 << 10;
/// Most bytes in flight to a client of gRPC, as many as TCP permits.
const WINDOW_BYTES: u32 = 16 << 20;

/// A protocol and an encoding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    RosbridgeJson,
    /// Received messages are CBOR with CDR inside. Sent ones are JSON, because clients can send nothing else.
    RosbridgeCborRaw,
    GrpcCdr,
    GrpcJson,
}

impl Way {
    pub(super) const ALL: [Self; 4] =
        [Self::RosbridgeJson, Self::RosbridgeCborRaw, Self::GrpcCdr, Self::GrpcJson];

    pub(super) fn name(self) -> &'static str {
        ["rosbridge-json", "rosbridge-cbor-raw", "grpc-cdr", "grpc-json"][self as usize]
    }

    /// Whether it is measured with messages of that size: who takes CBOR does so for large ones.
    pub(super) fn has(self, size: usize) -> bool {
        self != Self::RosbridgeCborRaw || size > 1000
    }

    fn is_rosbridge(self) -> bool {
        matches!(self, Self::RosbridgeJson | Self::RosbridgeCborRaw)
    }

    fn encoding(self) -> proto::Encoding {
        if self == Self::GrpcCdr { proto::Encoding::Cdr } else { proto::Encoding::Json }
    }
}

type Socket = WebSocketStream<TcpStream>;

async fn socket(scene: &Scene) -> Result<Socket> {
    let stream = TcpStream::connect(scene.rosbridge).await?;
    stream.set_nodelay(true)?;
    let (socket, _) = tokio_tungstenite::client_async(format!("ws://{}/", scene.rosbridge), stream).await?;
    Ok(socket)
}

async fn tell(socket: &mut Socket, op: serde_json::Value) -> Result<()> {
    Ok(socket.send(Message::text(op.to_string())).await?)
}

async fn grpc(scene: &Scene) -> Result<GatewayClient<Channel>> {
    let endpoint = Endpoint::from_shared(format!("http://{}", scene.grpc))?
        .initial_stream_window_size(WINDOW_BYTES)
        .initial_connection_window_size(WINDOW_BYTES);
    let client = GatewayClient::new(endpoint.connect().await?);
    Ok(client.max_decoding_message_size(MESSAGE_BYTES_MAX).max_encoding_message_size(MESSAGE_BYTES_MAX))
}

/// Hears a topic.
pub(super) enum Hearer {
    Rosbridge { socket: Socket, size: usize },
    Grpc { stream: tonic::Streaming<proto::SubscribeResponse>, is_cdr: bool },
}

impl Hearer {
    /// With gRPC and `waits`, the gateway keeps for this client what it does not take at once, as far as it does.
    pub(super) async fn new(scene: &Scene, way: Way, topic: &str, size: usize, waits: bool) -> Result<Self> {
        if way.is_rosbridge() {
            let mut socket = socket(scene).await?;
            let compression = if way == Way::RosbridgeJson { "none" } else { "cbor-raw" };
            let op = json!({
                "op": "subscribe", "topic": topic, "type": TYPE, "compression": compression, "queue_length": DEPTH,
            });
            tell(&mut socket, op).await?;
            return Ok(Self::Rosbridge { socket, size });
        }
        let request = proto::SubscribeRequest {
            topic: topic.into(),
            r#type: TYPE.into(),
            encoding: way.encoding().into(),
            depth: DEPTH,
            waits,
            ..Default::default()
        };
        let stream = grpc(scene).await?.subscribe(request).await?.into_inner();
        Ok(Self::Grpc { stream, is_cdr: way == Way::GrpcCdr })
    }

    /// The number of the next message.
    pub(super) async fn next(&mut self) -> Result<u64> {
        match self {
            Self::Rosbridge { socket, size } => loop {
                match socket.next().await.context("the gateway has closed")?? {
                    Message::Text(text) => return number_in(text.as_bytes()),
                    Message::Binary(bytes) => {
                        let cdr = bytes.len().checked_sub(*size + 8).context("a short message")?;
                        return number_at(&bytes, cdr + HEADER_BYTES);
                    }
                    _ => {}
                }
            },
            Self::Grpc { stream, is_cdr } => loop {
                match stream.message().await?.context("the stream has ended")?.kind {
                    Some(subscribe_response::Kind::Message(message)) if *is_cdr => {
                        return number_at(&message.payload, HEADER_BYTES);
                    }
                    Some(subscribe_response::Kind::Message(message)) => return number_in(&message.payload),
                    Some(subscribe_response::Kind::Unreadable(why)) => bail!("{}", why.reason),
                    _ => {}
                }
            },
        }
    }
}

fn number_at(bytes: &[u8], at: usize) -> Result<u64> {
    let number = bytes.get(at..at + 8).context("a short message")?;
    Ok(u64::from_le_bytes(number.try_into()?))
}

fn number_in(json: &[u8]) -> Result<u64> {
    let begin = json.get(..NUMBER_WITHIN_BYTES).unwrap_or(json);
    const KEY: &[u8] = b"\"seq\":";
    let at = begin.windows(KEY.len()).position(|window| window == KEY);
    let Some(at) = at else { bail!("no message: {}", String::from_utf8_lossy(begin)) };
    let digits = begin[at + KEY.len()..].iter().take_while(|byte| byte.is_ascii_digit());
    let number = digits.fold(None, |n: Option<u64>, digit| {
        n.unwrap_or_default().checked_mul(10)?.checked_add(u64::from(digit - b'0'))
    });
    number.context("a message without a number")
}

/// Says something on a topic.
pub(super) enum Sayer {
    Rosbridge {
        socket: Box<Socket>,
        begin: String,
        end: String,
        unflushed: usize,
    },
    Grpc {
        out: mpsc::Sender<proto::PublishRequest>,
        call: JoinHandle<Result<u64>>,
        json_end: Option<String>,
        data_bytes: usize,
    },
}

impl Sayer {
    /// With `keeps_all` DDS keeps what its readers have not acknowledged, and the gateway waits for it.
    pub(super) async fn new(
        scene: &Scene,
        way: Way,
        topic: &str,
        size: usize,
        keeps_all: bool,
    ) -> Result<Self> {
        let data = data_bytes(size)?;
        let json_end = format!(",\"data\":\"{}\"}}", BASE64_STANDARD.encode(vec![0x5a; data]));
        if way.is_rosbridge() {
            let mut socket = socket(scene).await?;
            let qos = match keeps_all {
                true => json!({"reliability": "reliable", "history": "keep_all"}),
                false => json!({"reliability": "reliable", "depth": 10}),
            };
            tell(&mut socket, json!({"op": "advertise", "topic": topic, "type": TYPE, "qos": qos})).await?;
            let begin = format!("{{\"op\":\"publish\",\"topic\":\"{topic}\",\"msg\":");
            return Ok(Self::Rosbridge {
                socket: Box::new(socket),
                begin,
                end: json_end + "}",
                unflushed: 0,
            });
        }
        let publisher = publish_request::Publisher {
            topic: topic.into(),
            r#type: TYPE.into(),
            encoding: way.encoding().into(),
            qos: Some(proto::Qos { keep_all: keeps_all, ..Default::default() }),
        };
        let (out, requests) = mpsc::channel(AHEAD);
        let publisher = publish_request::Kind::Publisher(publisher);
        out.send(proto::PublishRequest { kind: Some(publisher) }).await?;
        let requests = stream::unfold(requests, |mut requests| async {
            let next = requests.recv().await?;
            Some((next, requests))
        });
        let mut client = grpc(scene).await?;
        let call = tokio::spawn(async move { Ok(client.publish(requests).await?.into_inner().published) });
        let json_end = (way == Way::GrpcJson).then_some(json_end);
        Ok(Self::Grpc { out, call, json_end, data_bytes: data })
    }

    /// Queues a message, which may leave with later ones.
    pub(super) async fn say(&mut self, number: u64) -> Result<()> {
        let stamp = now_ns();
        match self {
            Self::Rosbridge { socket, begin, end, unflushed } => {
                let text = format!("{begin}{{\"seq\":{number},\"stamp_ns\":{stamp}{end}");
                *unflushed += text.len();
                socket.feed(Message::text(text)).await?;
                if *unflushed >= FLUSH_BYTES {
                    *unflushed = 0;
                    socket.flush().await?;
                }
            }
            Self::Grpc { out, json_end, data_bytes, .. } => {
                let payload = match json_end {
                    Some(end) => Bytes::from(format!("{{\"seq\":{number},\"stamp_ns\":{stamp}{end}")),
                    None => {
                        let mut cdr = Vec::with_capacity(BEFORE_DATA_BYTES + *data_bytes);
                        cdr.extend_from_slice(&[0, 1, 0, 0]);
                        cdr.extend_from_slice(&number.to_le_bytes());
                        cdr.extend_from_slice(&stamp.to_le_bytes());
                        cdr.extend_from_slice(&u32::try_from(*data_bytes)?.to_le_bytes());
                        cdr.resize(BEFORE_DATA_BYTES + *data_bytes, 0x5a);
                        cdr.into()
                    }
                };
                let kind = Some(publish_request::Kind::Payload(payload));
                if out.send(proto::PublishRequest { kind }).await.is_err() {
                    bail!("publishing has ended");
                }
            }
        }
        Ok(())
    }

    /// Flushes queued messages.
    pub(super) async fn flush(&mut self) -> Result<()> {
        if let Self::Rosbridge { socket, unflushed, .. } = self {
            *unflushed = 0;
            socket.flush().await?;
        }
        Ok(())
    }

    /// The end of it, at which the gateway has taken all.
    pub(super) async fn end(mut self, said: u32) -> Result<()> {
        self.flush().await?;
        match self {
            Self::Rosbridge { mut socket, .. } => {
                // The answer follows all sent messages; anything before it is an error.
                tell(&mut socket, json!({"op": "call_service", "service": "/rosapi/get_time", "id": "end"}))
                    .await?;
                while let Some(message) = socket.next().await {
                    if let Message::Text(text) = message? {
                        ensure!(text.contains("service_response"), "{text}");
                        return Ok(());
                    }
                }
                bail!("the gateway has closed")
            }
            Self::Grpc { out, call, .. } => {
                drop(out);
                let published = call.await??;
                ensure!(published == u64::from(said), "{published} of {said} were published");
                Ok(())
            }
        }
    }
}
