//! Publishing and service calls through the status socket, for users without ROS.
//!
//! Messages are JSON (`docs/spec/json.md`). Everyone who may open the socket may do all of this. Clients of the gateway
//! have scopes; the node's user has none.

use std::io;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sgc_gateway::{Advertise, Content, Form, GatewayError, Graph, Session};
use sgc_wire::{Durability, History, Qos, Reliability};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::UnixStream;
use tokio::time::{Instant, timeout};

use crate::gateway::Gateway;

/// Longest message in JSON, bytes.
const MESSAGE_BYTES_MAX: u64 = 256 << 20;
/// Longest wait for subscribers or a reply.
const WAIT_MAX: Duration = Duration::from_secs(3600);
/// Time to discover the subscribers that the graph shows, and the endpoints that have a type.
const SETTLE_MAX: Duration = Duration::from_secs(2);

/// Request to publish.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishRequest {
    /// ROS topic.
    pub topic: String,
    /// ROS type; `None` takes the type of the topic.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// Whether to publish best effort.
    pub best_effort: bool,
    /// Whether late joiners get the messages.
    pub transient_local: bool,
    /// History depth; `None` is rclcpp's 10.
    pub depth: Option<u32>,
    /// Number of subscribers to wait for before the first message.
    pub wait_for: u32,
    /// Longest wait for them, milliseconds.
    pub wait_ms: u64,
}

/// Request to call a service.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CallRequest {
    /// ROS service.
    pub service: String,
    /// ROS type; `None` takes the type of the service.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// The request, JSON.
    pub request: String,
    /// Longest wait for the reply, milliseconds.
    pub timeout_ms: u64,
}

/// Answer to a request to publish, once messages are accepted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishReport {
    /// The topic's type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// Number of local subscribers, including the node's own for the far side.
    pub subscribers: u32,
}

fn wait(ms: u64) -> Duration {
    Duration::from_millis(ms).min(WAIT_MAX)
}

/// Waits until an interface with a type is discovered, at most for a moment. The first request opens the gateway's
/// network, on which nothing is discovered yet.
async fn wait_for_type(session: &Session, longest: Duration, has_type: impl Fn(&Graph) -> bool) {
    let mut graph = session.hub().graph_changes();
    let discovered = async { while !has_type(&session.hub().graph()) && graph.changed().await.is_ok() {} };
    // Without a type the request is refused with the reason.
    let _ = timeout(SETTLE_MAX.min(longest), discovered).await;
}

/// Calls a service and returns its reply as JSON.
pub(crate) async fn call(gateway: &Gateway, wish: &CallRequest) -> Result<String, String> {
    let reply = async {
        let session = gateway.own_session().await?;
        let request = Content::json(wish.request.clone());
        let (type_name, longest) = (wish.type_name.as_deref(), wait(wish.timeout_ms));
        let begun = Instant::now();
        if type_name.is_none() {
            let has_type = |graph: &Graph| graph.services.contains_key(&wish.service);
            wait_for_type(&session, longest, has_type).await;
        }
        session
            .call(&wish.service, type_name, &request, Form::Json, longest.saturating_sub(begun.elapsed()))
            .await
    };
    let reply = reply.await.map_err(|error| error.to_string())?;
    Ok(String::from_utf8_lossy(&reply).into_owned())
}

/// Publishes each received line and answers it, until the connection ends.
pub(crate) async fn publish(
    gateway: &Gateway,
    wish: PublishRequest,
    mut stream: UnixStream,
    envelope: impl Fn(Result<String, String>) -> String,
) -> io::Result<()> {
    let (from, mut into) = stream.split();
    let mut from = BufReader::new(from);
    let begun = async {
        let session = gateway.own_session().await?;
        let (wait_for, longest) = (wish.wait_for, wait(wish.wait_ms));
        if wish.type_name.is_none() {
            let info = |graph: &Graph| graph.topics.get(&wish.topic)?.type_name().map(drop);
            wait_for_type(&session, longest, |graph| info(graph).is_some()).await;
        }
        let publication = session.advertise(advertise(wish)).await?;
        publication.settle(SETTLE_MAX.min(longest)).await;
        let subscribers = publication.wait_for_readers(wait_for, longest).await;
        Ok::<_, GatewayError>((publication, subscribers))
    };
    let (publication, subscribers) = match begun.await {
        Ok(begun) => begun,
        Err(error) => return into.write_all(envelope(Err(error.to_string())).as_bytes()).await,
    };
    let published = PublishReport { type_name: publication.type_name().to_owned(), subscribers };
    let published = serde_json::to_string(&published)?;
    into.write_all(format!("{}\n", envelope(Ok(published))).as_bytes()).await?;
    let mut line = Vec::new();
    loop {
        line.clear();
        if (&mut from).take(MESSAGE_BYTES_MAX).read_until(b'\n', &mut line).await? == 0 {
            return Ok(());
        }
        let content = Content::json(std::mem::take(&mut line));
        let done = publication.publish(&content).await;
        let done = done.map(|()| publication.matched_readers().to_string()).map_err(|e| e.to_string());
        into.write_all(format!("{}\n", envelope(done)).as_bytes()).await?;
    }
}

fn advertise(wish: PublishRequest) -> Advertise {
    let defaults = Qos::default();
    let durability = if wish.transient_local { Durability::TransientLocal } else { defaults.durability };
    let qos = Qos {
        reliability: if wish.best_effort { Reliability::BestEffort } else { defaults.reliability },
        durability,
        history: wish.depth.map_or(defaults.history, |depth| History::KeepLast(depth.max(1))),
        ..defaults
    };
    Advertise { topic: wish.topic, type_name: wish.type_name, qos }
}
