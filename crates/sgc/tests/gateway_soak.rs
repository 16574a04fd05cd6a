//! Tests the gateway's memory while a client does not read, with many clients, and after very many have come and gone:
//! a real `sgc run`, Cyclone's programs on its ROS network, and clients of both protocols over sockets.
//!
//! The suite has a short run. `make gateway-soak` has many more clients, and as many visits as one every two minutes
//! makes in 26 days. It prints figures.

#![allow(clippy::unwrap_used)]

mod support;

use std::fs;
use std::net::SocketAddr;
use std::time::Duration;

use futures_util::stream::{self, StreamExt as _};
use futures_util::{FutureExt as _, SinkExt as _};
use serde_json::{Value, json};
use sgc_gateway::grpc::proto;
use sgc_testkit::netsim::Namespace;
use tempfile::TempDir;
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tonic::transport::Channel;

use proto::gateway_client::GatewayClient;
use proto::{publish_request, subscribe_response};
use support::{PATIENCE, Peer, Running, environment, say};

/// Number of permanent clients and of visiting clients in the suite's short run.
const CLIENTS: usize = 100;
const CONNECTS: usize = 300;
/// Number of rounds of visits. The first round allocates what is allocated only once.
const ROUNDS: usize = 4;
/// Number of clients that visit at the same time.
const AT_ONCE: usize = 8;
/// ROS domain where the network is shared with other programs.
const DOMAIN: &str = "94";
/// Longest life of a peer in seconds.
const PEER_LIFE: &str = "7200";
/// Bytes of an image, and images a second.
const IMAGE: &str = "1000000";
const RATE: &str = "40";
/// Bound of the queue for a client that does not read.
const CLIENT_MIB: usize = 8;
/// Number of images that exceeds the queue and the socket buffers of a client that does not read.
const UNREAD: usize = 30;

/// Bound of memory for such a client: its queue, the base64 of a message being written, and the allocator's overhead.
const UNREAD_KB_MAX: u64 = 4 * 1024 * CLIENT_MIB as u64;
/// Bound of memory per client, for buffers of its socket and its protocol.
const CLIENT_KB_MAX: u64 = 256;
/// Bound of memory that all rounds after the first may add.
const ROUNDS_KB_MAX: u64 = 16 << 10;
/// Bound of additional open files, which are connections of the process that asks for the status.
const FDS_MAX: usize = 4;

type Socket = WebSocketStream<TcpStream>;

#[test]
fn gateway_memory_is_bounded_with_many_visits_and_a_client_that_does_not_read() {
    let (scene, _talkers) = Scene::new();
    let run = || {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(scene.soak());
    };
    match &scene.network {
        Some(network) => network.within(run).unwrap(),
        None => run(),
    }
}

/// Waits for a future within the test's patience.
async fn soon<T>(what: &str, future: impl Future<Output = T>) -> T {
    let came = tokio::time::timeout(PATIENCE, future).await;
    came.unwrap_or_else(|_| panic!("never: {what}"))
}

/// A node with a gateway, and its addresses. Fields are dropped in this order.
struct Scene {
    node: Running,
    rosbridge: SocketAddr,
    grpc: String,
    clients: usize,
    connects: usize,
    dir: TempDir,
    network: Option<Namespace>,
}

impl Scene {
    /// Returns a scene and the talkers on its ROS network.
    fn new() -> (Self, [Peer; 2]) {
        let network = support::own_network(format!("sgcsoak-{}", std::process::id()));
        let domain = if network.is_some() { "0" } else { DOMAIN };
        let (clients, connects) =
            (environment("SGC_SOAK_CLIENTS", CLIENTS), environment("SGC_SOAK_CONNECTS", CONNECTS));
        let dir = tempfile::tempdir().unwrap();
        support::enroll(dir.path(), ["desk"]);
        let text = format!(
            "identity = \"desk.identity\"\n[node]\nstate = \"desk.state\"\n[admin]\nsocket = \"desk.sock\"\n\
             [router]\nlisten = [\"quic://127.0.0.1:0\"]\n\
             [ros]\ndomain_id = {domain}\ndiscovery_range = \"localhost\"\nstatic_peers = []\n\
             [gateway]\nlisten = [\"ws://127.0.0.1:0\", \"grpc://127.0.0.1:0\"]\n\
             clients_max = {}\nclient_bytes_max = \"{CLIENT_MIB}MiB\"\n",
            clients + 2 * AT_ONCE + 8
        );
        fs::write(dir.path().join("desk.toml"), text).unwrap();
        let mut command = support::sgc(network.as_ref(), dir.path());
        command.args(["run", "-c", "desk.toml"]);
        let node = Running::start(command, &dir.path().join("desk.log"));
        let talk = |args: &[&str]| {
            let mut command = support::command(network.as_ref(), dir.path(), &Peer::program("cyclone"));
            command.args(["pub", "--domain", domain, "--localhost", "--timeout", PEER_LIFE]).args(args);
            Peer::start(command)
        };
        let images = talk(&["--topic", "/image", "--type", "image", "--size", IMAGE, "--rate", RATE]);
        // Latched, so that a new client need not wait for the next message.
        let chatter = talk(&["--topic", "/chatter", "--rate", "10", "--transient-local", "--depth", "1"]);
        let mut output = support::sgc(None, dir.path());
        let output = output.args(["status", "--json", "--socket", "desk.sock"]).output().unwrap();
        let status: Value = serde_json::from_slice(&output.stdout).unwrap();
        let listens = status["gateway"]["listen"].as_array().unwrap().iter();
        let mut at = listens.map(|url| url.as_str().unwrap().split_once("//").unwrap().1.to_owned());
        let rosbridge = at.next().unwrap().parse().unwrap();
        let grpc = format!("http://{}", at.next().unwrap());
        (Self { node, rosbridge, grpc, clients, connects, dir, network }, [images, chatter])
    }

    async fn soak(&self) {
        self.until_talked_of().await;
        self.until("nobody is there", |gateway| count(gateway) == 0).await;
        let empty = self.node.held();
        say(&format!("soak: nobody is there: {empty:?}"));

        let mut watcher = self.hear_images().await;
        images(&mut watcher, UNREAD).await;
        let before = self.node.held();
        let mut unread = self.leave_unread().await;
        images(&mut watcher, UNREAD).await;
        let mut most = 0;
        for _ in 0..UNREAD {
            images(&mut watcher, 1).await;
            most = most.max(self.node.held().resident_kb);
        }
        say(&format!("soak: one reads images, and one does not: {before:?}, then {most} kB at most"));
        self.holds(most, before.resident_kb + UNREAD_KB_MAX);

        let before = self.node.held();
        let crowd = self.crowd().await;
        let there = self.node.held();
        let each = there.resident_kb.saturating_sub(before.resident_kb) / self.clients as u64;
        say(&format!("soak: and {} who listen: {there:?}, each {each} kB", self.clients));
        self.holds(there.resident_kb, before.resident_kb + CLIENT_KB_MAX * self.clients as u64);

        let mut rounds = Vec::new();
        for round in 0..ROUNDS {
            // A client that does not read for a minute is disconnected.
            drop(std::mem::replace(&mut unread, self.leave_unread().await));
            self.come_and_go(round).await;
            images(&mut watcher, UNREAD).await;
            self.until("who came has gone", |gateway| count(gateway) == self.clients + 2).await;
            self.until_unpublished(watcher.client.clone()).await;
            let held = self.node.held();
            say(&format!("soak: round {}, {} have come and gone: {held:?}", round, self.visits_per_round()));
            rounds.push(held);
        }
        let most = rounds.iter().map(|held| held.resident_kb).max().unwrap_or_default();
        self.holds(most, rounds[0].resident_kb + ROUNDS_KB_MAX);

        drop((crowd, unread, watcher));
        self.until("all have gone", |gateway| count(gateway) == 0 && gateway["readers"] == 0).await;
        let left = self.node.held();
        say(&format!("soak: nobody is there any more: {left:?}"));
        assert!(left.fds <= empty.fds + FDS_MAX, "{left:?} instead of {empty:?}");
        self.holds(left.resident_kb, rounds[0].resident_kb + ROUNDS_KB_MAX);
    }

    fn holds(&self, kb: u64, max: u64) {
        if kb > max {
            support::say_log("desk", &fs::read_to_string(self.dir.path().join("desk.log")).unwrap());
        }
        assert!(kb <= max, "it holds {kb} kB; {max} kB at most were to be");
    }

    fn visits_per_round(&self) -> usize {
        self.connects / ROUNDS
    }

    /// Waits until the gateway's status meets the condition.
    async fn until(&self, what: &str, is_so: impl Fn(&Value) -> bool) {
        let mut last = Value::Null;
        let becomes_so = async {
            loop {
                let mut command = support::sgc(None, self.dir.path());
                command.args(["status", "--json", "--socket", "desk.sock"]);
                let output = tokio::process::Command::from(command).output().await.unwrap();
                let status: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
                last = status["gateway"].clone();
                if is_so(&last) {
                    return;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        };
        let became_so = tokio::time::timeout(PATIENCE, becomes_so).await;
        assert!(became_so.is_ok(), "never: {what}: {last}");
    }

    async fn grpc(&self) -> GatewayClient<Channel> {
        soon("gRPC connects", GatewayClient::connect(self.grpc.clone())).await.unwrap()
    }

    /// Waits until the gateway knows both topics.
    async fn until_talked_of(&self) {
        let mut client = self.grpc().await;
        soon("both talkers are known", async {
            while topics(&mut client).await.iter().filter(|topic| !topic.publishers.is_empty()).count() < 2 {
                tokio::time::sleep(Duration::from_millis(20)).await;
            }
        })
        .await;
    }

    /// Waits until clients publish nothing any more.
    async fn until_unpublished(&self, mut client: GatewayClient<Channel>) {
        soon("what who came published has gone", async {
            let is_theirs = |topic: &proto::Topic| topic.name.starts_with("/soak");
            while topics(&mut client).await.iter().any(is_theirs) {
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        })
        .await;
    }

    async fn hear_images(&self) -> Watcher {
        let mut client = self.grpc().await.max_decoding_message_size(64 << 20);
        let request = proto::SubscribeRequest { topic: "/image".into(), ..Default::default() };
        let stream = soon("it subscribes", client.subscribe(request)).await.unwrap().into_inner();
        Watcher { client, stream }
    }

    async fn rosbridge(&self) -> Socket {
        let stream = soon("TCP connects", TcpStream::connect(self.rosbridge)).await.unwrap();
        let url = format!("ws://{}/", self.rosbridge);
        let (socket, _) = soon("the upgrade", tokio_tungstenite::client_async(url, stream)).await.unwrap();
        socket
    }

    /// Connects a client that subscribes to images and reads nothing.
    async fn leave_unread(&self) -> Socket {
        let mut socket = self.rosbridge().await;
        tell(&mut socket, json!({"op": "subscribe", "topic": "/image"})).await;
        socket
    }

    /// Connects clients of both protocols that listen until the set is dropped. Each has received a message on return.
    async fn crowd(&self) -> JoinSet<()> {
        let mut crowd = JoinSet::new();
        let (heard, mut hears) = tokio::sync::mpsc::unbounded_channel();
        for number in 0..self.clients {
            let heard = heard.clone();
            if number % 2 == 0 {
                let mut socket = self.rosbridge().await;
                tell(&mut socket, json!({"op": "subscribe", "topic": "/chatter"})).await;
                crowd.spawn(async move {
                    loop {
                        text(&mut socket).await;
                        let _ = heard.send(number);
                    }
                });
            } else {
                let mut client = self.grpc().await;
                let mut stream = client.subscribe(chatter()).await.unwrap().into_inner();
                crowd.spawn(async move {
                    while stream.message().await.unwrap().is_some() {
                        let _ = heard.send(number);
                    }
                });
            }
        }
        let mut silent: std::collections::BTreeSet<_> = (0..self.clients).collect();
        soon("everybody hears something", async {
            while !silent.is_empty() {
                silent.remove(&hears.recv().await.unwrap());
            }
        })
        .await;
        crowd
    }

    /// Runs a round of clients that receive a message, publish one, and leave.
    async fn come_and_go(&self, round: usize) {
        let first = round * self.visits_per_round();
        let visits = (first..first + self.visits_per_round()).map(|number| async move {
            match number % 2 {
                0 => self.visit_by_rosbridge(number).await,
                _ => self.visit_by_grpc(number).await,
            }
        });
        stream::iter(visits).buffer_unordered(AT_ONCE).for_each(|()| async {}).await;
    }

    async fn visit_by_rosbridge(&self, number: usize) {
        let topic = format!("/soak_{number}");
        let mut socket = self.rosbridge().await;
        tell(&mut socket, json!({"op": "subscribe", "topic": "/chatter"})).await;
        tell(&mut socket, json!({"op": "advertise", "topic": topic, "type": "std_msgs/String"})).await;
        tell(&mut socket, json!({"op": "publish", "topic": topic, "msg": {"data": "here"}})).await;
        let said = soon("it hears something", text(&mut socket)).await;
        assert_eq!(said["topic"], "/chatter", "{said}");
        // Some clients close their connection properly.
        if number.is_multiple_of(4) {
            let _ = socket.close(None).await;
        }
    }

    async fn visit_by_grpc(&self, number: usize) {
        let mut client = self.grpc().await;
        let publisher = publish_request::Publisher {
            topic: format!("/soak_{number}"),
            r#type: "std_msgs/String".into(),
            encoding: proto::Encoding::Json.into(),
            ..Default::default()
        };
        let said = [
            publish_request::Kind::Publisher(publisher),
            publish_request::Kind::Payload(br#"{"data":"here"}"#.to_vec().into()),
        ];
        let said = said.map(|kind| proto::PublishRequest { kind: Some(kind) });
        let mut publisher = client.clone();
        let publishing = publisher.publish(stream::iter(said).chain(stream::pending())).fuse();
        let mut stream = client.subscribe(chatter()).await.unwrap().into_inner();
        let heard = async {
            loop {
                let kind = stream.message().await.unwrap().unwrap().kind;
                if let Some(subscribe_response::Kind::Message(_)) = kind {
                    return;
                }
            }
        };
        // The others drop it.
        tokio::select! {
            ended = publishing => panic!("{ended:?}"),
            () = soon("it hears something", heard) => {}
        }
    }
}

/// Returns the number of clients.
fn count(gateway: &Value) -> usize {
    gateway["clients"].as_array().map_or(0, Vec::len)
}

/// A client that reads images as they come.
struct Watcher {
    client: GatewayClient<Channel>,
    stream: tonic::Streaming<proto::SubscribeResponse>,
}

/// Waits for images.
async fn images(watcher: &mut Watcher, mut count: usize) {
    soon("images", async {
        while count > 0 {
            let kind = watcher.stream.message().await.unwrap().unwrap().kind;
            count -= usize::from(matches!(kind, Some(subscribe_response::Kind::Message(_))));
        }
    })
    .await;
}

async fn topics(client: &mut GatewayClient<Channel>) -> Vec<proto::Topic> {
    let graph = soon("the graph", client.get_graph(proto::GetGraphRequest::default())).await;
    graph.unwrap().into_inner().graph.unwrap().topics
}

fn chatter() -> proto::SubscribeRequest {
    let (topic, encoding) = ("/chatter".into(), proto::Encoding::Json.into());
    proto::SubscribeRequest { topic, encoding, ..Default::default() }
}

async fn tell(socket: &mut Socket, op: Value) {
    soon("it is taken", socket.send(Message::text(op.to_string()))).await.unwrap();
}

/// Returns the next text message.
async fn text(socket: &mut Socket) -> Value {
    loop {
        if let Message::Text(text) = socket.next().await.unwrap().unwrap() {
            return serde_json::from_str(&text).unwrap();
        }
    }
}
