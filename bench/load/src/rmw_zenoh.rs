//! A program of rmw_zenoh as the roles need it: one session, readers and writers of one type, something to wait for.
//!
//! It has the interface of `dds.rs`, and takes its place with the feature `zenoh`. Keys, tokens and attachments are
//! those of `sgc-zenoh`; settings of sessions, congestion control and the queues of readers are those of rmw_zenoh (Kilted).
//! It does not know what is measured.

use std::collections::VecDeque;
use std::io::Read as _;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, Result, anyhow, ensure};
use sgc_wire::{History, Qos, Reliability as Reliable, RosNode};
use sgc_zenoh::{Attachment, EntityKind, Gid, Graph as Tokens, Token, TokenEndpoint, TopicInfo, ZenohId};
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Reliability};
use zenoh::sample::SampleKind;
use zenoh::{Config, Session, Wait};

/// The type of measured messages, as Cyclone programs have it.
const TYPE: &str = "sgc_bench::msg::dds_::Load_";
/// Its hash. Nobody computes it from a definition, so any will do.
const TYPE_HASH: &str = "RIHS01_00000000000000000000000000000000000000000000000000000000000010ad";
/// The encapsulation of a payload: CDR, little endian.
const CDR: [u8; 4] = [0, 1, 0, 0];
/// Bytes before the data of a message: encapsulation, number, time, length.
const HEAD_BYTES: usize = CDR.len() + 8 + 8 + 4;
/// Further settings, as rmw_zenoh takes them: `path=value`, with `;` between.
const OVERRIDES: &str = "ZENOH_CONFIG_OVERRIDE";

/// Values of rmw_zenoh that differ from Zenoh's, the same for sessions and routers
/// (`DEFAULT_RMW_ZENOH_SESSION_CONFIG.json5`@076f2e71, `DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5`@30f30305).
const VALUES: [(&str, &str); 12] = [
    ("connect/timeout_ms", "{ router: -1, peer: -1, client: 0 }"),
    ("connect/exit_on_failure", "{ router: false, peer: false, client: true }"),
    ("scouting/multicast/enabled", "false"),
    ("scouting/gossip/target", r#"{ router: ["router", "peer"], peer: ["router"] }"#),
    ("timestamping/enabled", "true"),
    ("queries_default_timeout", "600000"),
    ("transport/unicast/open_timeout", "60000"),
    ("transport/unicast/accept_timeout", "60000"),
    ("transport/unicast/accept_pending", "10000"),
    ("transport/unicast/max_sessions", "10000"),
    ("transport/link/tx/lease", "60000"),
    ("transport/link/tx/queue/congestion_control/block/wait_before_close", "60000000"),
];
/// Values of its sessions alone.
const SESSION_VALUES: [(&str, &str); 4] = [
    ("mode", r#""peer""#),
    ("connect/endpoints", r#"["tcp/localhost:7447"]"#),
    ("listen/endpoints", r#"["tcp/localhost:0"]"#),
    ("scouting/gossip/autoconnect_strategy", r#"{ peer: { to_router: "always", to_peer: "greater-zid" } }"#),
];
/// Values of its router alone.
const ROUTER_VALUES: [(&str, &str); 4] = [
    ("mode", r#""router""#),
    ("listen/endpoints", r#"["tcp/[::]:7447"]"#),
    ("routing/router/peers_failover_brokering", "false"),
    ("scouting/gossip/autoconnect_strategy", r#"{ router: { to_router: "always", to_peer: "always" } }"#),
];

/// How a topic is carried.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Quality {
    /// Reliable, or best effort.
    pub(crate) reliable: bool,
    /// Number of newest messages kept; 0 keeps all, so that writing waits.
    pub(crate) depth: u32,
}

impl Quality {
    fn qos(self) -> Qos {
        Qos {
            reliability: if self.reliable { Reliable::Reliable } else { Reliable::BestEffort },
            history: if self.depth == 0 { History::KeepAll } else { History::KeepLast(self.depth) },
            ..Qos::default()
        }
    }
}

/// One message, borrowed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Message<'a> {
    /// Its number.
    pub(crate) seq: u64,
    /// When it was written, by the clock of [`crate::now_ns`].
    pub(crate) stamp_ns: u64,
    /// The rest.
    pub(crate) data: &'a [u8],
}

impl Message<'_> {
    fn encode(&self) -> Result<Vec<u8>> {
        let mut bytes = Vec::with_capacity(HEAD_BYTES + self.data.len());
        bytes.extend_from_slice(&CDR);
        bytes.extend_from_slice(&self.seq.to_le_bytes());
        bytes.extend_from_slice(&self.stamp_ns.to_le_bytes());
        bytes.extend_from_slice(&u32::try_from(self.data.len())?.to_le_bytes());
        bytes.extend_from_slice(self.data);
        Ok(bytes)
    }
}

impl<'a> Message<'a> {
    fn decode(bytes: &'a [u8]) -> Result<Self> {
        let (cdr, rest) = bytes.split_first_chunk::<4>().context("a payload without a head")?;
        // The last byte counts padding, which other writers may set.
        ensure!(cdr[..2] == CDR[..2], "a payload that is not little-endian CDR");
        let (seq, rest) = rest.split_first_chunk().context("a payload without a number")?;
        let (stamp_ns, rest) = rest.split_first_chunk().context("a payload without a time")?;
        let (bytes, rest) = rest.split_first_chunk().context("a payload without a length")?;
        let data = rest.get(..u32::from_le_bytes(*bytes) as usize).context("a payload that is too short")?;
        Ok(Self { seq: u64::from_le_bytes(*seq), stamp_ns: u64::from_le_bytes(*stamp_ns), data })
    }
}

/// A value that all parts of the program share.
#[derive(Debug, Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    /// Something else than a message happened.
    rung: bool,
    /// The messages of each reader.
    queues: Vec<Queue>,
}

#[derive(Debug)]
struct Queue {
    payloads: VecDeque<ZBytes>,
    /// As many are kept; more than that of rmw_zenoh's readers with `KEEP_ALL` has no bound either.
    depth: usize,
}

impl Shared {
    fn ring(&self) {
        lock(&self.state).rung = true;
        self.changed.notify_one();
    }

    fn push(&self, reader: usize, payload: ZBytes) {
        let mut state = lock(&self.state);
        if let Some(queue) = state.queues.get_mut(reader) {
            if queue.payloads.len() >= queue.depth {
                queue.payloads.pop_front();
            }
            queue.payloads.push_back(payload);
        }
        drop(state);
        self.changed.notify_one();
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A session in a domain.
#[derive(Debug)]
pub(crate) struct Network {
    /// Goes before the session.
    _tokens: Subscriber<()>,
    session: Session,
    id: ZenohId,
    domain: u32,
    node: RosNode,
    /// The number of the next endpoint; the node has 0.
    next: AtomicU64,
    graph: Arc<Mutex<Tokens>>,
    shared: Arc<Shared>,
}

impl Network {
    /// Joins a domain as a node of this name.
    pub(crate) fn join(domain: u32, node: &str) -> Result<Self> {
        let node = RosNode::new("/", node, None).with_context(|| format!("{node:?} names no node"))?;
        let session = zenoh::open(config(&SESSION_VALUES)?).wait().map_err(zenoh_error)?;
        let id: ZenohId = session.zid().to_string().parse()?;
        let graph = Arc::new(Mutex::new(Tokens::new(domain, id, false)));
        let shared = Arc::<Shared>::default();
        let (its_graph, its_shared) = (graph.clone(), shared.clone());
        let tokens = session
            .liveliness()
            .declare_subscriber(Token::all_of(domain))
            .history(true)
            .callback(move |sample| {
                let token = sample.key_expr().as_str();
                match sample.kind() {
                    // Others may declare what is no token.
                    SampleKind::Put => _ = lock(&its_graph).declare(token),
                    SampleKind::Delete => _ = lock(&its_graph).undeclare(token),
                }
                its_shared.ring();
            })
            .wait()
            .map_err(zenoh_error)?;
        Ok(Self { _tokens: tokens, session, id, domain, node, next: AtomicU64::new(1), graph, shared })
    }

    fn endpoint(&self, kind: EntityKind, topic: &str, quality: Quality) -> Result<Endpoint> {
        let id = self.next.fetch_add(1, Relaxed);
        let topic = TopicInfo::new(topic, TYPE, TYPE_HASH)?;
        let key = topic.key(self.domain);
        let endpoint = TokenEndpoint { kind, id, topic: topic.clone(), qos: quality.qos(), backends: None };
        let token = self.token(Some(endpoint)).encode()?;
        let counterpart = match kind {
            EntityKind::Publisher => EntityKind::Subscription,
            _ => EntityKind::Publisher,
        };
        Ok(Endpoint { topic, key, token, counterpart, graph: self.graph.clone() })
    }

    fn token(&self, endpoint: Option<TokenEndpoint>) -> Token {
        Token { domain: self.domain, session: self.id, node_id: 0, node: Some(self.node.clone()), endpoint }
    }

    fn declare(&self, token: &str) -> Result<LivelinessToken> {
        self.session.liveliness().declare_token(token.to_owned()).wait().map_err(zenoh_error)
    }
}

/// The common part of readers and writers.
#[derive(Debug)]
struct Endpoint {
    topic: TopicInfo,
    key: String,
    token: String,
    /// The kind of endpoints that match it.
    counterpart: EntityKind,
    graph: Arc<Mutex<Tokens>>,
}

impl Endpoint {
    fn matched(&self) -> u32 {
        lock(&self.graph).matches(&self.topic, self.counterpart).count() as u32
    }
}

/// The tokens of a node and of its endpoints.
#[derive(Debug)]
pub(crate) struct Graph(Vec<LivelinessToken>);

impl Graph {
    /// Announces the node.
    pub(crate) fn open(network: &Network) -> Result<Self> {
        Ok(Self(vec![network.declare(&network.token(None).encode()?)?]))
    }

    /// Announces its endpoints, which are there already.
    pub(crate) fn announce(
        &mut self,
        network: &Network,
        readers: &[Reader],
        writers: &[Writer],
    ) -> Result<()> {
        let readers = readers.iter().map(|reader| &reader.endpoint);
        for endpoint in readers.chain(writers.iter().map(|writer| &writer.endpoint)) {
            self.0.push(network.declare(&endpoint.token)?);
        }
        Ok(())
    }
}

/// A publisher.
#[derive(Debug)]
pub(crate) struct Writer {
    endpoint: Endpoint,
    publisher: Publisher<'static>,
    gid: Gid,
    written: AtomicU64,
}

impl Writer {
    /// Opens an endpoint on the ROS 2 topic `/name`.
    pub(crate) fn new(network: &Network, name: &str, quality: Quality) -> Result<Self> {
        let endpoint = network.endpoint(EntityKind::Publisher, name, quality)?;
        let congestion = match quality {
            Quality { reliable: true, depth: 0 } => CongestionControl::Block,
            _ => CongestionControl::Drop,
        };
        let publisher = network
            .session
            .declare_publisher(endpoint.key.clone())
            .congestion_control(congestion)
            .reliability(if quality.reliable { Reliability::Reliable } else { Reliability::BestEffort })
            .wait()
            .map_err(zenoh_error)?;
        let gid = Gid::of_token(&endpoint.token);
        Ok(Self { endpoint, publisher, gid, written: AtomicU64::new(0) })
    }

    /// Returns the number of matched readers.
    pub(crate) fn matched(&self) -> Result<u32> {
        Ok(self.endpoint.matched())
    }

    /// Writes a message. Zenoh tells nobody if it drops it, so this returns `true` always.
    pub(crate) fn write(&self, message: &Message<'_>) -> Result<bool> {
        let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?;
        let attachment = Attachment {
            sequence: i64::try_from(self.written.fetch_add(1, Relaxed) + 1)?,
            source_timestamp_ns: i64::try_from(now.as_nanos())?,
            gid: self.gid,
        };
        let put = self.publisher.put(message.encode()?).attachment(attachment.encode().to_vec());
        put.wait().map_err(zenoh_error)?;
        Ok(true)
    }

    /// Returns at once, because Zenoh acknowledges nothing.
    pub(crate) fn until_acknowledged(&self, _: Duration) -> Result<bool> {
        Ok(true)
    }
}

/// A subscriber.
#[derive(Debug)]
pub(crate) struct Reader {
    endpoint: Endpoint,
    number: usize,
    shared: Arc<Shared>,
    _subscriber: Subscriber<()>,
}

impl Reader {
    /// Opens an endpoint on the ROS 2 topic `/name`.
    pub(crate) fn new(network: &Network, name: &str, quality: Quality) -> Result<Self> {
        let endpoint = network.endpoint(EntityKind::Subscription, name, quality)?;
        let depth = if quality.depth == 0 { usize::MAX } else { quality.depth as usize };
        let shared = network.shared.clone();
        let number = {
            let mut state = lock(&shared.state);
            state.queues.push(Queue { payloads: VecDeque::new(), depth });
            state.queues.len() - 1
        };
        let its = shared.clone();
        let subscriber = network
            .session
            .declare_subscriber(endpoint.key.clone())
            .callback(move |sample| its.push(number, sample.payload().clone()))
            .wait()
            .map_err(zenoh_error)?;
        Ok(Self { endpoint, number, shared, _subscriber: subscriber })
    }

    /// Returns the number of matched writers.
    pub(crate) fn matched(&self) -> Result<u32> {
        Ok(self.endpoint.matched())
    }

    /// Takes all messages that are there.
    pub(crate) fn take(&self, mut handle: impl FnMut(Message<'_>) -> Result<()>) -> Result<()> {
        let mut taken = VecDeque::new();
        if let Some(queue) = lock(&self.shared.state).queues.get_mut(self.number) {
            std::mem::swap(&mut queue.payloads, &mut taken);
        }
        for payload in taken {
            handle(Message::decode(&payload.to_bytes())?)?;
        }
        Ok(())
    }
}

/// A handle that wakes the waiter from any thread.
#[derive(Clone, Debug)]
pub(crate) struct Bell(Arc<Shared>);

impl Bell {
    /// Wakes the waiter.
    pub(crate) fn ring(&self) {
        self.0.ring();
    }
}

/// Waits for messages, matches and a bell.
#[derive(Debug)]
pub(crate) struct Waiter(Arc<Shared>);

/// The reason why a wait ended.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Woken {
    /// Readers that have messages, by the number under which they were attached.
    pub(crate) readers: Vec<usize>,
}

impl Waiter {
    /// Returns a waiter for everything that happens on a network.
    pub(crate) fn new(network: &Network) -> Result<Self> {
        Ok(Self(network.shared.clone()))
    }

    /// Attaches the messages and matches of a reader. Readers are numbered in the order in which they were opened.
    pub(crate) fn attach_reader(&mut self, reader: &Reader, number: usize) -> Result<()> {
        ensure!(reader.number == number, "readers in another order");
        Ok(())
    }

    /// Attaches the matches of a writer, which wake the waiter in any case.
    pub(crate) fn attach_writer(&mut self, _: &Writer) -> Result<()> {
        Ok(())
    }

    /// Returns the bell that wakes the waiter from other threads.
    pub(crate) fn bell(&self) -> Bell {
        Bell(self.0.clone())
    }

    /// Waits for an event, at most for `timeout`.
    pub(crate) fn wait(&self, timeout: Duration) -> Result<Woken> {
        let deadline = Instant::now() + timeout;
        let mut state = lock(&self.0.state);
        loop {
            let queues = state.queues.iter().enumerate();
            let readers: Vec<_> = queues.filter(|(_, q)| !q.payloads.is_empty()).map(|(n, _)| n).collect();
            let left = deadline.saturating_duration_since(Instant::now());
            if state.rung || !readers.is_empty() || left.is_zero() {
                state.rung = false;
                return Ok(Woken { readers });
            }
            let waited = self.0.changed.wait_timeout(state, left);
            state = waited.map_err(|_| anyhow!("a thread of Zenoh panicked"))?.0;
        }
    }
}

/// Routes until standard input ends. Calls `begun` once it does.
pub(crate) fn route(begun: impl FnOnce() -> Result<()>) -> Result<()> {
    let session = zenoh::open(config(&ROUTER_VALUES)?).wait().map_err(zenoh_error)?;
    begun()?;
    std::io::stdin().lock().read_to_end(&mut Vec::new())?;
    session.close().wait().map_err(zenoh_error)
}

/// Returns Zenoh's settings: rmw_zenoh's, these, then those of the environment.
fn config(values: &[(&str, &str)]) -> Result<Config> {
    let overrides = std::env::var(OVERRIDES).unwrap_or_default();
    let overrides = overrides.split(';').filter(|one| !one.is_empty());
    let overrides = overrides.map(|one| one.split_once('=').with_context(|| format!("{OVERRIDES}: {one}")));
    let overrides = overrides.collect::<Result<Vec<_>>>()?;
    let mut config = Config::default();
    for &(key, value) in VALUES.iter().chain(values).chain(&overrides) {
        config.insert_json5(key, value).map_err(|error| anyhow!("{key} = {value}: {error}"))?;
    }
    Ok(config)
}

fn zenoh_error(error: zenoh::Error) -> anyhow::Error {
    anyhow!("Zenoh: {error}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_are_those_of_cyclone_programs() {
        let message = Message { seq: 7, stamp_ns: 0x0102, data: &[9, 8, 7] };
        let bytes = message.encode().unwrap();
        assert_eq!(bytes, [0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0, 2, 1, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0, 9, 8, 7]);
        let padded = [&[0, 1, 0, 1][..], &bytes[4..], &[0]].concat();
        let read = Message::decode(&padded).unwrap();
        assert_eq!((read.seq, read.stamp_ns, read.data), (7, 0x0102, &[9, 8, 7][..]));
        assert!(Message::decode(&bytes[..bytes.len() - 1]).is_err());
    }

    #[test]
    fn every_setting_is_one_of_zenoh() {
        config(&SESSION_VALUES).unwrap();
        config(&ROUTER_VALUES).unwrap();
    }
}
