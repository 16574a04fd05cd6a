//! The status socket: questions of users and programs to a running node.
//!
//! Each connection asks one question. A silent client gets the status as one JSON document, as in the first version.
//! Otherwise one line, `sgc/1 WORD [ARGUMENT]`, is answered with `{"ok": …}` or `{"error": "…"}`. Exceptions are
//! `status`, whose answer is the document itself, and `tap`: a stream of [`TapHead`]s and messages follows its answer,
//! which has the description of the type, if the node knows it. Other modules carry out the requests.

pub mod graph;
pub mod not_direct;
pub mod report;
pub(crate) mod route_words;
pub mod shell;
mod socket;
pub(crate) mod status;

use std::collections::BTreeSet;
use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::{Deserialize, Serialize};
use sgc_router::PathKind;
use sgc_trust::NodeName;
use sgc_wire::{
    CRL_BYTES_MAX, Decode as _, Encode as _, Name, Operation, REPORT_INTERFACE_BYTES_MAX, ReportQuestion,
};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::UnixStream;
use tokio::sync::{Semaphore, mpsc, oneshot};
use tokio::task::{JoinHandle, JoinSet};
use tracing::{debug, info, warn};
use zeroize::Zeroizing;

use self::not_direct::NotDirectReason;
use self::socket::StatusSocket;
pub use self::socket::{
    SocketError, connect, default_socket_path, find_socket, has_hidden_services, usual_sockets,
};

use crate::admin::graph::Side;
use crate::admin::report::{NodeReport, Pong, ReportPath};
use crate::admin::shell::{CallRequest, PublishRequest};
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::fleet::inquiries::{
    InquiryAnswer, InquiryError, InquiryPath, InquiryReport, InquiryTarget,
};
use crate::control::settings::reload::Reloader;
use crate::data::tap::{Tap, TapMessage, TapRequest};
use crate::gateway::Gateway;
use crate::metrics::Metrics;
use crate::state::audit::{Audit, AuditRecord};
use crate::state::{ROOT, own_uid};

/// Prefix of a request line. The number is the version of the protocol.
pub const ADMIN_PREFIX: &str = "sgc/1 ";
/// Longest request, bytes: a revocation list in base64 fits.
pub const ADMIN_LINE_BYTES_MAX: usize = CRL_BYTES_MAX * 4 / 3 + 64;

/// Most requests that are answered at one time. Later ones wait.
const CONNECTIONS_MAX: usize = 16;
/// Time after which a silent client gets the status.
const SILENCE: Duration = Duration::from_millis(250);
/// Most taps at one time. They last, so places remain for other requests.
const TAPS_MAX: usize = 8;
/// Longest time for which the reader of a tap may stall.
const TAP_STALL_MAX: Duration = Duration::from_secs(30);
/// Longest ROS name in a request, bytes. DDS topics have at most 256 with a prefix.
const TOPIC_BYTES_MAX: usize = 254;
/// First and longest time between two attempts to have the socket.
const BIND_AGAIN_MIN: Duration = Duration::from_millis(100);
const BIND_AGAIN_MAX: Duration = Duration::from_secs(5);
/// Interval of checks that the socket's path still exists, since programs that tidy `/tmp` may remove it.
const LOOK_EVERY: Duration = Duration::from_secs(5);
/// Longest time for an answer over routers that comes after a direct one.
const RELAYED_MAX: Duration = Duration::from_secs(4);
/// Longest time for the rest of a request, and for reading an answer.
const TRANSFER_MAX: Duration = Duration::from_secs(5);

/// A request to a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AdminRequest {
    /// Return the status.
    Status,
    /// Reload the configuration.
    Reload,
    /// Apply this revocation list, DER.
    Crl(Vec<u8>),
    /// Return the [`Graph`](crate::admin::graph::Graph), also for this name if it is not in use here.
    Graph(Option<Name>),
    /// Send the messages of a topic until the connection ends.
    Tap {
        /// ROS topic on the local network.
        topic: String,
        /// Side of the topic. The default is far if the topic is used here, else local.
        side: Option<Side>,
        /// Most bytes of a payload that are sent. The rest is cut off.
        bytes: u32,
    },
    /// Publish the following lines, one JSON message each. Each line is answered.
    Publish(PublishRequest),
    /// Call a service.
    Call(CallRequest),
    /// Have an authority carry out an operation on the fleet. Answered with an encoded [`sgc_wire::OperationAnswer`].
    Operate {
        /// The authority's node name.
        at: NodeName,
        /// The operation.
        operation: Operation,
    },
    /// Ask nodes of the fleet how they are doing.
    Report(ReportRequest),
    /// Return the [`AuditAnswer`].
    Audit,
    /// Let commands pass the dead-man switches of this topic, by its name on the local network.
    Resume(String),
}

/// The last records of a node's audit log.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct AuditAnswer {
    /// The node's name.
    pub node: String,
    /// The last records since the node started, at most [`RECENT_MAX`](crate::audit::RECENT_MAX), oldest first; null if it keeps no log.
    pub records: Option<Vec<AuditRecord>>,
}

/// Most nodes in one [`ReportRequest`].
pub const REPORT_NODES_MAX: usize = 256;

/// Nodes to ask, and about what.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportRequest {
    /// Names of the nodes, at most [`REPORT_NODES_MAX`]; if there are none, the fleet's authority is asked.
    pub nodes: Vec<String>,
    /// A topic, service or action by its name at these nodes, for their graphs of it; without one, they are asked
    /// for a [`NodeReport`].
    pub interface: Option<String>,
    /// Whether they are asked for nothing but an answer ([`Pong`]), to measure its round trip.
    #[serde(default)]
    pub ping: bool,
}

/// The answer of a node of a [`ReportRequest`]: a report, a graph, or an error.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct ReportAnswer {
    /// The name by which it was asked; empty for the fleet's authority.
    pub node: String,
    /// The time of the answer by the clock of the node that asked, milliseconds since 1970.
    pub at_ms: u64,
    /// How it is doing.
    pub report: Option<NodeReport>,
    /// Its [`Graph`](crate::admin::graph::Graph) of the interface, as JSON that is not verified.
    pub graph: Option<String>,
    /// Its answer to a ping.
    pub pong: Option<Pong>,
    /// The time from the question to the answer, microseconds. The first question to a node takes longer, because its
    /// name is looked up.
    pub answered_us: u64,
    /// The path over which it answered; null if there is no answer, or the node is this one.
    pub path: Option<ReportPath>,
    /// Its answer to the same ping over routers, if it answered over a direct link; null without one.
    pub relayed: Option<RelayedAnswer>,
    /// Why it did not answer over a direct link; null if it did, or one is up.
    pub not_direct: Option<NotDirectReason>,
    /// The reason why there is no answer.
    pub error: Option<String>,
    /// The remedy; empty if there is none to name.
    pub fix: String,
}

/// An answer over routers.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub struct RelayedAnswer {
    /// The time from the question to the answer, microseconds.
    pub answered_us: u64,
    /// The path.
    pub path: ReportPath,
}

/// Header of each message of a tap: [`TapHead::BYTES`] bytes, big endian, in this order. `carried` bytes of payload
/// follow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TapHead {
    /// 0: data; 1: disposed; 2: unregistered.
    pub kind: u8,
    /// The publisher's time stamp, nanoseconds since the Unix epoch.
    pub source_timestamp_ns: i64,
    /// Wall-clock time at which the message passed, nanoseconds since the Unix epoch.
    pub seen_unix_ns: i64,
    /// Time since the tap began by a monotonic clock, nanoseconds.
    pub seen_ns: u64,
    /// Messages dropped so far because they were not read in time.
    pub dropped: u64,
    /// Bytes of the payload.
    pub bytes: u32,
    /// Bytes of the payload that follow.
    pub carried: u32,
}

impl TapHead {
    /// Length of the encoded header.
    pub const BYTES: usize = 41;

    /// Encodes the header.
    pub fn to_bytes(&self) -> [u8; Self::BYTES] {
        let mut bytes = [0; Self::BYTES];
        bytes[0] = self.kind;
        bytes[1..9].copy_from_slice(&self.source_timestamp_ns.to_be_bytes());
        bytes[9..17].copy_from_slice(&self.seen_unix_ns.to_be_bytes());
        bytes[17..25].copy_from_slice(&self.seen_ns.to_be_bytes());
        bytes[25..33].copy_from_slice(&self.dropped.to_be_bytes());
        bytes[33..37].copy_from_slice(&self.bytes.to_be_bytes());
        bytes[37..].copy_from_slice(&self.carried.to_be_bytes());
        bytes
    }

    /// Decodes the header.
    pub fn from_bytes(bytes: &[u8; Self::BYTES]) -> Self {
        let long = |at: usize| {
            let part: [u8; 8] = std::array::from_fn(|i| bytes[at + i]);
            part
        };
        let short = |at: usize| u32::from_be_bytes(std::array::from_fn(|i| bytes[at + i]));
        Self {
            kind: bytes[0],
            source_timestamp_ns: i64::from_be_bytes(long(1)),
            seen_unix_ns: i64::from_be_bytes(long(9)),
            seen_ns: u64::from_be_bytes(long(17)),
            dropped: u64::from_be_bytes(long(25)),
            bytes: short(33),
            carried: short(37),
        }
    }

    fn from_message(message: &TapMessage, begun: Instant, dropped: u64, most: u32) -> Self {
        let bytes = message.payload.len().try_into().unwrap_or(u32::MAX);
        Self {
            kind: match message.kind {
                sgc_ros::SampleKind::Write => 0,
                sgc_ros::SampleKind::Dispose => 1,
                sgc_ros::SampleKind::Unregister => 2,
            },
            source_timestamp_ns: message.source_timestamp_ns,
            seen_unix_ns: message.seen_unix_ns,
            seen_ns: message.seen.saturating_duration_since(begun).as_nanos().try_into().unwrap_or(u64::MAX),
            dropped,
            bytes,
            carried: bytes.min(most),
        }
    }
}

impl AdminRequest {
    /// Parses a request line without its end.
    pub fn parse(line: &[u8]) -> Result<Self, AdminError> {
        let text = std::str::from_utf8(line).map_err(|_| AdminError::NotText)?;
        let text = text.trim_end_matches(['\r', '\n']);
        let Some(question) = text.strip_prefix(ADMIN_PREFIX) else {
            // Bare words without the prefix serve people at a terminal.
            return match text {
                "" | "status" => Ok(Self::Status),
                _ => Err(AdminError::Version),
            };
        };
        match question.split_once(' ').unwrap_or((question, "")) {
            ("status", "") => Ok(Self::Status),
            ("reload", "") => Ok(Self::Reload),
            ("audit", "") => Ok(Self::Audit),
            ("resume", topic) if topic.starts_with('/') && topic.len() <= TOPIC_BYTES_MAX => {
                Ok(Self::Resume(topic.to_owned()))
            }
            ("resume", _) => Err(AdminError::Argument { word: "resume" }),
            ("crl", list) => match STANDARD.decode(list) {
                Ok(list) if !list.is_empty() && list.len() <= CRL_BYTES_MAX => Ok(Self::Crl(list)),
                _ => Err(AdminError::Argument { word: "crl" }),
            },
            ("graph", "") => Ok(Self::Graph(None)),
            ("graph", name) => match parse_name(name) {
                Some(name) => Ok(Self::Graph(Some(name))),
                None => Err(AdminError::Argument { word: "graph" }),
            },
            ("publish", wish) => match serde_json::from_str(wish) {
                Ok(wish) => Ok(Self::Publish(wish)),
                Err(_) => Err(AdminError::Argument { word: "publish" }),
            },
            ("call", wish) => match serde_json::from_str(wish) {
                Ok(wish) => Ok(Self::Call(wish)),
                Err(_) => Err(AdminError::Argument { word: "call" }),
            },
            ("operate", rest) => Self::parse_operate(rest).ok_or(AdminError::Argument { word: "operate" }),
            ("report", wish) => match serde_json::from_str(wish) {
                Ok(wish) => Ok(Self::Report(wish)),
                Err(_) => Err(AdminError::Argument { word: "report" }),
            },
            ("tap", rest) => Self::parse_tap(rest).ok_or(AdminError::Argument { word: "tap" }),
            (word, _) => Err(AdminError::Unknown { word: word.chars().take(32).collect() }),
        }
    }

    fn parse_operate(rest: &str) -> Option<Self> {
        let (at, operation) = rest.split_once(' ')?;
        let operation = Operation::from_slice(&STANDARD.decode(operation).ok()?).ok()?;
        Some(Self::Operate { at: at.parse().ok()?, operation })
    }

    fn parse_tap(rest: &str) -> Option<Self> {
        let mut words = rest.split(' ');
        let (side, bytes, topic) = (words.next()?, words.next()?, words.next()?);
        let side = match side {
            "any" => None,
            label => Some(Side::from_label(label)?),
        };
        let fits = topic.starts_with('/') && topic.len() <= TOPIC_BYTES_MAX && words.next().is_none();
        let bytes = bytes.parse().ok()?;
        fits.then(|| Self::Tap { topic: topic.to_owned(), side, bytes })
    }

    /// Returns the request line with its end.
    pub fn to_line(&self) -> String {
        match self {
            Self::Status => format!("{ADMIN_PREFIX}status\n"),
            Self::Reload => format!("{ADMIN_PREFIX}reload\n"),
            Self::Audit => format!("{ADMIN_PREFIX}audit\n"),
            Self::Resume(topic) => format!("{ADMIN_PREFIX}resume {topic}\n"),
            Self::Crl(list) => format!("{ADMIN_PREFIX}crl {}\n", STANDARD.encode(list)),
            Self::Graph(None) => format!("{ADMIN_PREFIX}graph\n"),
            Self::Graph(Some(name)) => format!("{ADMIN_PREFIX}graph {name}\n"),
            Self::Tap { topic, side, bytes } => {
                format!("{ADMIN_PREFIX}tap {} {bytes} {topic}\n", side.map_or("any", Side::label))
            }
            Self::Publish(wish) => format!("{ADMIN_PREFIX}publish {}\n", json(wish)),
            Self::Report(wish) => format!("{ADMIN_PREFIX}report {}\n", json(wish)),
            Self::Call(wish) => format!("{ADMIN_PREFIX}call {}\n", json(wish)),
            Self::Operate { at, operation } => {
                format!("{ADMIN_PREFIX}operate {at} {}\n", STANDARD.encode(operation.to_vec()))
            }
        }
    }
}

/// Encodes a request as one line of JSON.
fn json(wish: &impl Serialize) -> String {
    serde_json::to_string(wish).expect("texts and numbers have a JSON form")
}

/// Reasons why a request is malformed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AdminError {
    /// It is not UTF-8.
    #[error("the question is not text")]
    NotText,
    /// It is too long.
    #[error("the question has more than {ADMIN_LINE_BYTES_MAX} bytes")]
    TooLong,
    /// It ended before the end of the line.
    #[error("the question was not ended with a new line in time")]
    Unfinished,
    /// It has another version.
    #[error("the question does not begin with {ADMIN_PREFIX:?}: this node speaks version 1")]
    Version,
    /// An argument is invalid.
    #[error("{word:?} lacks a usable argument")]
    Argument {
        /// The word of the request.
        word: &'static str,
    },
    /// The word is unknown.
    #[error(
        "{word:?} is nothing that this node can be asked: status, reload, crl, graph, report, audit, tap, publish, call and operate are"
    )]
    Unknown {
        /// The word.
        word: String,
    },
}

/// Everything that answers need.
#[derive(Clone)]
pub(crate) struct Desk {
    pub(crate) events: mpsc::Sender<CoreEvent>,
    pub(crate) reloader: Arc<Reloader>,
    pub(crate) gateway: Arc<Gateway>,
    pub(crate) metrics: Arc<Metrics>,
    pub(crate) audit: Audit,
    /// The node's name.
    pub(crate) node: String,
}

/// Binds the socket at `path` and answers there until the returned task is aborted. It retries while another process
/// has the socket, for example a predecessor that is still stopping.
pub(crate) fn begin(path: PathBuf, desk: Desk) -> JoinHandle<()> {
    let first = StatusSocket::bind(&path);
    tokio::spawn(keep_socket(path, first, desk))
}

async fn keep_socket(path: PathBuf, first: Result<StatusSocket, SocketError>, desk: Desk) {
    let (mut attempt, mut wait) = (first, BIND_AGAIN_MIN);
    let mut said: Option<String> = None;
    loop {
        let why = match attempt {
            Ok(socket) => {
                if said.take().is_some() {
                    info!(path = %path.display(), "the status socket is there now");
                }
                wait = BIND_AGAIN_MIN;
                tokio::select! {
                    () = serve(&socket, &desk) => return,
                    () = removed(&socket) => "its path was removed".to_owned(),
                }
            }
            Err(error) => error.to_string(),
        };
        if said.as_ref() != Some(&why) {
            warn!(path = %path.display(), "no status socket: {why}; trying again");
            said = Some(why);
        }
        tokio::time::sleep(wait).await;
        wait = (wait * 2).min(BIND_AGAIN_MAX);
        attempt = StatusSocket::bind(&path);
    }
}

/// Waits until the path no longer leads to the socket.
async fn removed(socket: &StatusSocket) {
    while socket.is_in_place() {
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

/// Answers requests until the node ends.
async fn serve(socket: &StatusSocket, desk: &Desk) {
    let places = Arc::new(Semaphore::new(CONNECTIONS_MAX));
    let taps = Arc::new(Semaphore::new(TAPS_MAX));
    let refused = Arc::new(AtomicBool::new(false));
    while let Ok(place) = places.clone().acquire_owned().await {
        let accepted = socket.listener().accept().await;
        if desk.events.is_closed() {
            return;
        }
        let mut stream = match accepted {
            Ok((stream, _)) => stream,
            Err(error) => {
                // The process may have too many open files, for example.
                debug!(%error, "the status socket takes no connection");
                tokio::time::sleep(BIND_AGAIN_MIN).await;
                continue;
            }
        };
        let (desk, taps, refused) = (desk.clone(), taps.clone(), refused.clone());
        let asks = stream.peer_cred().map(|peer| (peer.uid(), socket.may_ask(peer.uid())));
        tokio::spawn(async move {
            match asks {
                Ok((uid, true)) => {
                    let is_own = uid == own_uid() || uid == ROOT;
                    answer(stream, is_own, &desk, &taps).await;
                }
                // The socket's mode keeps others out already, unless somebody changed it.
                Ok((uid, false)) => refuse(&mut stream, uid, &refused).await,
                Err(error) => debug!(%error, "the user of a client of the status socket is unknown"),
            }
            drop(place);
        });
    }
}

/// Refuses a client of another user.
async fn refuse(stream: &mut UnixStream, uid: u32, was_said: &AtomicBool) {
    if !was_said.swap(true, Relaxed) {
        warn!(uid, "refused another user at the status socket; logged once");
    }
    let own = own_uid();
    let text =
        envelope(Err(format!("this node answers uid {own}, whose it is, and root alone: you are uid {uid}")));
    let _ = tokio::time::timeout(TRANSFER_MAX, stream.write_all(text.as_bytes())).await;
}

/// Answers a request. Only the node's own user and root may change the fleet.
async fn answer(mut stream: UnixStream, is_own: bool, desk: &Desk, taps: &Semaphore) {
    let Desk { events, gateway, .. } = desk;
    let request = read_line(&mut stream).await.and_then(|line| AdminRequest::parse(&line));
    let text = match request {
        Ok(AdminRequest::Status) => match status(desk).await {
            Some(text) => text,
            None => return,
        },
        Ok(AdminRequest::Tap { topic, side, bytes }) => {
            let Ok(_place) = taps.try_acquire() else {
                let many = envelope(Err(format!("{TAPS_MAX} topics are looked at already")));
                let _ = tokio::time::timeout(TRANSFER_MAX, stream.write_all(many.as_bytes())).await;
                return;
            };
            match begin_tap(TapRequest { topic, side }, events).await {
                Ok(tap) => return show(stream, tap, bytes).await,
                Err(why) => envelope(Err(why)),
            }
        }
        Ok(AdminRequest::Publish(wish)) => {
            let Ok(_place) = taps.try_acquire() else {
                let many = envelope(Err(format!("{TAPS_MAX} topics are looked at or published on already")));
                let _ = tokio::time::timeout(TRANSFER_MAX, stream.write_all(many.as_bytes())).await;
                return;
            };
            if let Err(error) = shell::publish(gateway, wish, stream, envelope).await {
                debug!(%error, "a publishing client of the status socket disconnected");
            }
            return;
        }
        Ok(AdminRequest::Operate { .. }) if !is_own => {
            envelope(Err("only the user of this node and root may change the fleet through it".to_owned()))
        }
        Ok(AdminRequest::Resume(_)) if !is_own => {
            envelope(Err("only the user of this node and root may let commands pass".to_owned()))
        }
        Ok(request) => envelope(carry_out(request, desk).await),
        Err(error) => envelope(Err(error.to_string())),
    };
    let write = async {
        stream.write_all(text.as_bytes()).await?;
        stream.shutdown().await
    };
    if !matches!(tokio::time::timeout(TRANSFER_MAX, write).await, Ok(Ok(()))) {
        debug!("a client of the status socket did not read the answer");
    }
}

async fn read_line(stream: &mut UnixStream) -> Result<Vec<u8>, AdminError> {
    let mut line = Vec::new();
    let deadline = tokio::time::Instant::now() + TRANSFER_MAX;
    loop {
        let mut buffer = [0; 4096];
        let wait = if line.is_empty() { tokio::time::Instant::now() + SILENCE } else { deadline };
        let read = match tokio::time::timeout_at(wait, stream.read(&mut buffer)).await {
            Ok(Ok(n)) => n,
            Err(_) if line.is_empty() => return Ok(line),
            Ok(Err(_)) | Err(_) => return Err(AdminError::Unfinished),
        };
        let new = buffer.get(..read).unwrap_or_default();
        if let Some(end) = new.iter().position(|byte| *byte == b'\n') {
            line.extend(new.iter().take(end));
            return Ok(line);
        }
        line.extend(new);
        if line.len() > ADMIN_LINE_BYTES_MAX {
            return Err(AdminError::TooLong);
        }
        if read == 0 {
            return Ok(line);
        }
    }
}

async fn status(desk: &Desk) -> Option<String> {
    let (reply, status) = oneshot::channel();
    desk.events.send(CoreEvent::Status(reply)).await.ok()?;
    let mut status = status.await.ok()?;
    status.gateway = desk.gateway.status();
    status.metrics = desk.metrics.url();
    status.otlp = desk.metrics.push_status();
    status.alerts.extend(desk.gateway.alerts());
    status.alerts.extend(desk.metrics.alerts());
    serde_json::to_string(&status).ok()
}

async fn begin_tap(wish: TapRequest, events: &mpsc::Sender<CoreEvent>) -> Result<Tap, String> {
    let (reply, tap) = oneshot::channel();
    let stopping = || "the node is stopping".to_owned();
    events.send(CoreEvent::Tap(wish, reply)).await.map_err(|_| stopping())?;
    tap.await.map_err(|_| stopping())?.map_err(|why| why.to_string())
}

/// Sends the messages of a tap until the reader leaves or the topic ends.
async fn show(mut stream: UnixStream, mut tap: Tap, most: u32) {
    let begun = Instant::now();
    let described = tap.described.as_ref().map(|described| {
        let description = STANDARD.encode(described.description());
        serde_json::json!({ "type_hash": described.type_hash(), "description": description })
    });
    let what = serde_json::json!({
        "ok": {
            "side": tap.side.label(),
            "type": tap.type_name,
            "type_hash": tap.type_hash,
            "described": described,
        }
    });
    let (mut gone, mut into) = stream.split();
    let write = async {
        into.write_all(format!("{what}\n").as_bytes()).await?;
        while let Some((message, dropped)) = tap.queue.pop().await {
            let message = match message.is_raw() {
                true => tokio::task::spawn_blocking(|| message.read()).await.map_err(io::Error::other)?,
                false => message,
            };
            let head = TapHead::from_message(&message, begun, dropped, most);
            let carried = message.payload.get(..head.carried as usize).unwrap_or_default();
            let write = async {
                into.write_all(&head.to_bytes()).await?;
                into.write_all(carried).await
            };
            tokio::time::timeout(TAP_STALL_MAX, write).await.map_err(|_| io::ErrorKind::TimedOut)??;
        }
        Ok::<(), io::Error>(())
    };
    let mut nothing = [0; 64];
    let looks_away = async { while matches!(gone.read(&mut nothing).await, Ok(1..)) {} };
    tokio::select! {
        _ = write => {}
        () = looks_away => {}
    }
    tap.queue.close();
    if let Some(reader) = tap.reader.take() {
        // Dropping the reader waits for its handler.
        tokio::task::spawn_blocking(move || drop(reader));
    }
}

/// Carries out a request. Returns JSON or an error message.
async fn carry_out(request: AdminRequest, desk: &Desk) -> Result<String, String> {
    let Desk { events, reloader, gateway, .. } = desk;
    let stopping = || "the node is stopping".to_owned();
    match request {
        AdminRequest::Status => status(desk).await.ok_or_else(stopping),
        AdminRequest::Graph(name) => {
            let (reply, graph) = oneshot::channel();
            events.send(CoreEvent::Graph(name, reply)).await.map_err(|_| stopping())?;
            let mut graph = graph.await.map_err(|_| stopping())?;
            graph.gateway_refused = gateway.status().map(|status| status.refused).unwrap_or_default();
            serde_json::to_string(&graph).map_err(|error| error.to_string())
        }
        // These requests have more than one line of answer.
        AdminRequest::Tap { .. } => Err(AdminError::Argument { word: "tap" }.to_string()),
        AdminRequest::Publish(_) => Err(AdminError::Argument { word: "publish" }.to_string()),
        AdminRequest::Call(wish) => shell::call(gateway, &wish).await,
        AdminRequest::Report(request) => {
            let answers = report(request, events).await?;
            serde_json::to_string(&answers).map_err(|error| error.to_string())
        }
        AdminRequest::Operate { at, operation } => {
            let (reply, done) = oneshot::channel();
            let asked = CoreEvent::Operate { at, operation, reply };
            events.send(asked).await.map_err(|_| stopping())?;
            let answer = done.await.map_err(|_| stopping())?.map_err(|error| error.to_string())?;
            let answer = Zeroizing::new(STANDARD.encode(Zeroizing::new(answer.to_vec())));
            Ok(serde_json::json!({ "answer": *answer }).to_string())
        }
        AdminRequest::Resume(topic) => {
            let (reply, done) = oneshot::channel();
            events.send(CoreEvent::Resume(topic, reply)).await.map_err(|_| stopping())?;
            done.await.map_err(|_| stopping())?.map_err(|error| error.to_string())?;
            Ok("null".to_owned())
        }
        AdminRequest::Audit => {
            let answer = AuditAnswer { node: desk.node.clone(), records: desk.audit.recent() };
            serde_json::to_string(&answer).map_err(|error| error.to_string())
        }
        AdminRequest::Reload => {
            let report = reloader.reload("sgc reload").await?;
            serde_json::to_string(&report).map_err(|error| error.to_string())
        }
        AdminRequest::Crl(der) => {
            let (reply, done) = oneshot::channel();
            events.send(CoreEvent::Crl { der: der.into(), reply }).await.map_err(|_| stopping())?;
            let (is_news, lists) = done.await.map_err(|_| stopping())?.map_err(|error| error.to_string())?;
            let lists: Vec<_> = lists.iter().map(|list| STANDARD.encode(list)).collect();
            Ok(serde_json::json!({ "news": is_news, "lists": lists }).to_string())
        }
    }
}

/// Asks nodes for reports, all at one time.
async fn report(
    request: ReportRequest,
    events: &mpsc::Sender<CoreEvent>,
) -> Result<Vec<ReportAnswer>, String> {
    let stopping = || "the node is stopping".to_owned();
    if request.nodes.len() > REPORT_NODES_MAX {
        return Err(format!("at most {REPORT_NODES_MAX} nodes are asked at one time"));
    }
    let question = match request.interface {
        _ if request.ping => ReportQuestion::Ping,
        None => ReportQuestion::Node,
        Some(name) if name.len() > REPORT_INTERFACE_BYTES_MAX => {
            return Err(format!("a name has at most {REPORT_INTERFACE_BYTES_MAX} bytes"));
        }
        Some(name) => ReportQuestion::Interface(name),
    };
    let names: BTreeSet<String> = request.nodes.into_iter().collect();
    let target = |node: String| match node.parse() {
        Ok(name) => Ok((node, InquiryTarget::Node(name))),
        Err(error) => Err(format!("{node:?}: {error}")),
    };
    let mut targets = names.into_iter().map(target).collect::<Result<Vec<_>, _>>()?;
    if targets.is_empty() {
        targets.push((String::new(), InquiryTarget::Authority));
    }
    let mut asked = JoinSet::new();
    for (node, at) in targets {
        let (question, events) = (question.clone(), events.clone());
        asked.spawn(async move { ask_node(node, at, &question, &events).await });
    }
    let mut answers = Vec::new();
    while let Some(Ok(answer)) = asked.join_next().await {
        answers.push(answer.ok_or_else(stopping)?);
    }
    answers.sort_by(|a, b| a.node.cmp(&b.node));
    Ok(answers)
}

/// Asks one node, for a ping directly and over routers if a direct link leads to it. Returns `None` if the node here is stopping.
async fn ask_node(
    node: String,
    at: InquiryTarget,
    question: &ReportQuestion,
    events: &mpsc::Sender<CoreEvent>,
) -> Option<ReportAnswer> {
    let inquire = async |over| {
        let (reply, answer) = oneshot::channel();
        let event = CoreEvent::Inquire { at: at.clone(), question: question.clone(), over, reply };
        let begun = Instant::now();
        events.send(event).await.ok()?;
        let answer = answer.await.ok()?;
        Some((answer, begun.elapsed().as_micros().try_into().unwrap_or(u64::MAX)))
    };
    let (answer, answered_us) = inquire(None).await?;
    let path = answer.as_ref().ok().and_then(|report| report.path.as_ref());
    let has_relayed = *question == ReportQuestion::Ping && path.is_some_and(|path| path.has_relayed);
    let mut shown = ReportAnswer { answered_us, ..report_answer(node, question, answer) };
    let over = Some(PathKind::Relayed);
    if has_relayed
        && let Ok(Some((Ok(report), answered_us))) = tokio::time::timeout(RELAYED_MAX, inquire(over)).await
    {
        shown.relayed = report.path.map(|InquiryPath { path, .. }| RelayedAnswer { answered_us, path });
    }
    Some(shown)
}

fn report_answer(node: String, question: &ReportQuestion, answer: InquiryAnswer) -> ReportAnswer {
    let mut shown = ReportAnswer { node, at_ms: now().unix.0, ..ReportAnswer::default() };
    let read = answer.and_then(|InquiryReport { document, path }| {
        if let Some(InquiryPath { path, not_direct, .. }) = path {
            (shown.path, shown.not_direct) = (Some(path), not_direct);
        }
        let is_read = match question {
            ReportQuestion::Node => {
                shown.report = NodeReport::from_json(&document).ok();
                shown.report.is_some()
            }
            ReportQuestion::Interface(_) => {
                shown.graph = String::from_utf8(document.into()).ok();
                shown.graph.is_some()
            }
            ReportQuestion::Ping => {
                shown.pong = Pong::from_json(&document).ok();
                shown.pong.is_some()
            }
        };
        if is_read { Ok(()) } else { Err(InquiryError::Unreadable) }
    });
    match read {
        Ok(()) => shown,
        Err(error) => ReportAnswer { error: Some(error.to_string()), fix: error.fix().to_owned(), ..shown },
    }
}

fn parse_name(text: &str) -> Option<Name> {
    if text.len() != 64 || !text.bytes().all(|b| b.is_ascii_hexdigit()) {
        return None;
    }
    let mut name = [0; 32];
    for (byte, digits) in name.iter_mut().zip(text.as_bytes().chunks_exact(2)) {
        *byte = u8::from_str_radix(std::str::from_utf8(digits).ok()?, 16).ok()?;
    }
    Some(Name(name))
}

fn envelope(result: Result<String, String>) -> String {
    match result {
        Ok(json) => format!("{{\"ok\":{json}}}"),
        Err(error) => serde_json::json!({ "error": error }).to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn questions_round_trip() {
        let tap = |side| AdminRequest::Tap { topic: "/a/b".into(), side, bytes: 64 };
        for request in [
            AdminRequest::Status,
            AdminRequest::Reload,
            AdminRequest::Audit,
            AdminRequest::Resume("/cmd_vel".into()),
            AdminRequest::Crl(vec![0x30, 0, 255]),
            AdminRequest::Graph(None),
            AdminRequest::Graph(Some(Name([0xab; 32]))),
            tap(None),
            tap(Some(Side::Sent)),
            AdminRequest::Publish(PublishRequest {
                topic: "/a".into(),
                wait_for: 1,
                depth: Some(3),
                ..Default::default()
            }),
            AdminRequest::Report(ReportRequest {
                nodes: vec!["arm-1".into()],
                interface: Some("/a b".into()),
                ping: false,
            }),
            AdminRequest::Report(ReportRequest {
                nodes: vec!["arm-1".into()],
                ping: true,
                ..Default::default()
            }),
            AdminRequest::Call(CallRequest { request: "{\"a\":\n1}".into(), ..Default::default() }),
            AdminRequest::Operate {
                at: "keeper".parse().unwrap(),
                operation: Operation::Revoke { nodes: vec!["arm-1".into(), "desk".into()] },
            },
        ] {
            let line = request.to_line();
            assert!(line.ends_with('\n') && line.len() <= ADMIN_LINE_BYTES_MAX);
            assert_eq!(AdminRequest::parse(line.as_bytes()), Ok(request));
        }
        assert!(AdminRequest::Crl(vec![1; CRL_BYTES_MAX]).to_line().len() <= ADMIN_LINE_BYTES_MAX);
        assert_eq!(AdminRequest::parse(b""), Ok(AdminRequest::Status));
        assert_eq!(AdminRequest::parse(b"status\r\n"), Ok(AdminRequest::Status));
    }

    #[test]
    fn heads_of_taps_round_trip() {
        let head = TapHead {
            kind: 2,
            source_timestamp_ns: -1,
            seen_unix_ns: 1 << 60,
            seen_ns: 77,
            dropped: 5,
            bytes: 1 << 20,
            carried: 64,
        };
        assert_eq!(TapHead::from_bytes(&head.to_bytes()), head);
    }

    #[test]
    fn malformed_request_is_refused_with_its_reason() {
        for (line, error) in [
            (&b"reload"[..], AdminError::Version),
            (b"sgc/2 reload", AdminError::Version),
            (b"\xff", AdminError::NotText),
            (b"sgc/1 crl", AdminError::Argument { word: "crl" }),
            (b"sgc/1 crl !", AdminError::Argument { word: "crl" }),
            (b"sgc/1 stop", AdminError::Unknown { word: "stop".into() }),
            (b"sgc/1 graph 12", AdminError::Argument { word: "graph" }),
            (b"sgc/1 tap any 64", AdminError::Argument { word: "tap" }),
            (b"sgc/1 tap any 64 a", AdminError::Argument { word: "tap" }),
            (b"sgc/1 tap any -1 /a", AdminError::Argument { word: "tap" }),
            (b"sgc/1 tap both 1 /a", AdminError::Argument { word: "tap" }),
            (b"sgc/1 tap any 1 /a b", AdminError::Argument { word: "tap" }),
            (b"sgc/1 operate keeper", AdminError::Argument { word: "operate" }),
            (b"sgc/1 operate keeper AA", AdminError::Argument { word: "operate" }),
            (b"sgc/1 publish /a", AdminError::Argument { word: "publish" }),
            (b"sgc/1 report arm-1", AdminError::Argument { word: "report" }),
            (b"sgc/1 resume", AdminError::Argument { word: "resume" }),
            (b"sgc/1 resume cmd_vel", AdminError::Argument { word: "resume" }),
            (b"sgc/1 audit now", AdminError::Unknown { word: "audit".into() }),
            (b"sgc/1 reload now", AdminError::Unknown { word: "reload".into() }),
        ] {
            assert_eq!(AdminRequest::parse(line), Err(error), "{}", line.escape_ascii());
        }
    }
}
