//! What a user's shell does through the status socket: publish messages, and call services, without ROS.
//!
//! Messages come and go as JSON (`docs/spec/json.md`). Who may open the socket may do all this; the node's clients have
//! scopes, its user has not.

use std::io;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sgc_gateway::{Advertise, Content, Form, GatewayError};
use sgc_wire::{Durability, History, Qos, Reliability};
use tokio::io::{AsyncBufReadExt as _, AsyncReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::net::UnixStream;

use crate::gateway::Gateway;

/// Longest message in JSON, bytes.
const MESSAGE_BYTES_MAX: u64 = 256 << 20;
/// Longest time for which subscribers, or a reply, are waited for.
const WAIT_MAX: Duration = Duration::from_secs(3600);
/// How long those subscribers may take to be found that the graph shows.
const SETTLE_MAX: Duration = Duration::from_secs(2);

/// What to publish, and how.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishRequest {
    /// ROS topic.
    pub topic: String,
    /// ROS type; none takes that which the topic has.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// Not reliable.
    pub best_effort: bool,
    /// Also for who comes later.
    pub transient_local: bool,
    /// Messages that are kept; none is rclcpp's 10.
    pub depth: Option<u32>,
    /// Subscribers that are waited for before the first message is taken.
    pub wait_for: u32,
    /// For so long at most, milliseconds.
    pub wait_ms: u64,
}

/// What to ask a service.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct CallRequest {
    /// ROS service.
    pub service: String,
    /// ROS type; none takes that which the service has.
    #[serde(rename = "type")]
    pub type_name: Option<String>,
    /// The request, JSON.
    pub request: String,
    /// How long its reply is waited for, milliseconds.
    pub timeout_ms: u64,
}

/// What is said once messages are taken.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PublishReport {
    /// The topic's type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// How many subscribers there are on the local network, the node's own for the far side among them.
    pub subscribers: u32,
}

fn wait(ms: u64) -> Duration {
    Duration::from_millis(ms).min(WAIT_MAX)
}

/// Calls a service; gives its reply in JSON.
pub(crate) async fn call(gateway: &Gateway, wish: &CallRequest) -> Result<String, String> {
    let reply = async {
        let session = gateway.own_session().await?;
        let request = Content::json(wish.request.clone());
        let type_name = wish.type_name.as_deref();
        session.call(&wish.service, type_name, &request, Form::Json, wait(wish.timeout_ms)).await
    };
    let reply = reply.await.map_err(|error| error.to_string())?;
    Ok(String::from_utf8_lossy(&reply).into_owned())
}

/// Publishes each line that comes, and says of each how it went, until no more come.
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
