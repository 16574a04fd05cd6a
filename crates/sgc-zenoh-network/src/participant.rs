//! [`Participant`]: a session of Zenoh with the graph of its domain, which readers, writers and discovery keep alive.

use std::collections::BTreeMap;
use std::sync::atomic::Ordering::{AcqRel, Relaxed};
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::mpsc::Sender;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Duration, Instant};

use rand_core::{OsRng, TryRngCore as _};
use sgc_ros::{EndpointSpec, GraphNode, RosError, ServiceTopic};
use sgc_sync::{Pace, Work, Workers, lock};
use sgc_wire::{History, Qos};
use sgc_zenoh::{
    Attachment, CodecError, EndpointRef, EntityKind, Gid, Graph, GraphError, Token, TokenEndpoint, TopicInfo,
    ZenohId,
};
use tokio::runtime::{Handle, RuntimeFlavor};
use zenoh::pubsub::Subscriber;
use zenoh::query::Query;
use zenoh::sample::{Locality, Sample, SampleKind};
use zenoh::{Session, Wait as _};

use crate::config::{FindServiceHash, ZenohConfig, routers, shown, zenoh_config};
use crate::requests::{REQUESTS_MAX, Requests};
use crate::tokens::OwnTokens;

/// Time within which a session that is asked to close has to.
const CLOSE_MAX: Duration = Duration::from_secs(5);

/// A session and what everything created on it shares.
pub(crate) struct Participant {
    session: Session,
    domain: u32,
    id: ZenohId,
    is_proxy: bool,
    /// The endpoints of the routers that the network needs, without their configurations.
    routers: Vec<String>,
    graph: Mutex<WatchedGraph>,
    /// Signals a change of the graph.
    changed: Condvar,
    tokens: Mutex<OwnTokens>,
    /// The requests at the servers of each service, by its name.
    requests: Mutex<BTreeMap<String, Arc<Requests>>>,
    liveliness: Mutex<Option<Subscriber<()>>>,
    /// Endpoints that wait for the hashes of their types.
    waiting: Mutex<Vec<Weak<dyn Waits>>>,
    /// A look at them is due that has not begun.
    is_look_due: AtomicBool,
    service_hash: Option<FindServiceHash>,
    workers: Workers,
    pace: Arc<Pace>,
    refusals: Refusals,
    /// Dropped last, once the session is closed.
    alive: Option<Sender<()>>,
}

/// A graph, and the time of its last change.
pub(crate) struct WatchedGraph {
    pub(crate) graph: Graph,
    pub(crate) changed_at: Instant,
}

/// A refusal of something that came from the local network.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Refusal {
    /// A liveliness token.
    Token(GraphError),
    /// A message by its attachment.
    Attachment(CodecError),
    /// A message of so many bytes that is no serialised sample.
    Payload(usize),
    /// A request, or a query for history, with parameters of so many bytes.
    Parameters(usize),
    /// The oldest request without a reply of a service that has [`REQUESTS_MAX`].
    Request,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Token(error) => {
                write!(f, "a liveliness token is skipped, so an endpoint is not seen: {error}")
            }
            Self::Attachment(error) => write!(f, "a message is dropped: {error}"),
            Self::Payload(bytes) => write!(f, "a message is dropped: {bytes} bytes are no serialised sample"),
            Self::Parameters(bytes) => write!(f, "a query is dropped: it has parameters of {bytes} bytes"),
            Self::Request => {
                write!(f, "a request gets no reply: more than {REQUESTS_MAX} of its service wait for one")
            }
        }
    }
}

/// Numbers of what was refused, by kind.
#[derive(Debug, Default)]
struct Refusals {
    tokens: AtomicU64,
    attachments: AtomicU64,
    old_attachments: AtomicU64,
    payloads: AtomicU64,
    requests: AtomicU64,
}

/// The origin of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Origin {
    /// A program, and its endpoint if that is known.
    Program(Option<EndpointRef>),
    /// A proxy, whose messages came through SGC already.
    Proxy,
}

/// The key of an endpoint.
pub(crate) enum Key {
    /// The key is known.
    Known(TopicInfo),
    /// The hash may be that of a message of the service. If programs here have another one, theirs is right.
    Announced(TopicInfo),
    /// The hash is that of a program with this name and type. Until there is one, nobody would hear the endpoint.
    OfOthers(TopicInfo),
}

/// An endpoint that may open whenever the graph changes.
pub(crate) trait Waits: Send + Sync {
    /// Opens the endpoint if its key is known now, or has changed. Returns `false` if that may happen later.
    fn try_open(&self, participant: &Arc<Participant>) -> bool;
}

impl Participant {
    /// Opens a session and starts to follow the domain's tokens. `alive` is dropped once the session is closed.
    pub(crate) fn open(config: &ZenohConfig, alive: Sender<()>) -> Result<Arc<Self>, RosError> {
        let refused = |reason| RosError::Domain { domain: config.domain, reason };
        let mut random = [0; 10];
        OsRng.try_fill_bytes(&mut random).map_err(|error| refused(error.to_string()))?;
        let marked = ZenohId::of_sgc(random);
        let id = if config.is_proxy { marked } else { marked.without_mark() };
        let zenoh = zenoh_config(config, id).map_err(refused)?;
        let routers = if config.without_router { Vec::new() } else { routers(&zenoh) };
        let routers = routers.iter().map(|endpoint| shown(endpoint)).collect();
        let workers = Workers::start("sgc-zenoh-read", || ()).map_err(|error| refused(error.to_string()))?;
        let session =
            off_runtime(|| zenoh::open(zenoh).wait()).map_err(|error| refused(shown(&error.to_string())))?;
        let graph = Graph::new(config.domain, id, config.is_proxy);
        let participant = Arc::new(Self {
            domain: config.domain,
            id,
            is_proxy: config.is_proxy,
            routers,
            graph: Mutex::new(WatchedGraph { graph, changed_at: Instant::now() }),
            changed: Condvar::new(),
            tokens: Mutex::new(OwnTokens::new(session.clone(), config.domain, id)),
            requests: Mutex::default(),
            liveliness: Mutex::default(),
            waiting: Mutex::default(),
            is_look_due: AtomicBool::new(false),
            service_hash: config.service_hash.clone(),
            workers,
            pace: Arc::default(),
            refusals: Refusals::default(),
            alive: Some(alive),
            session,
        });
        let weak = Arc::downgrade(&participant);
        let subscriber = participant
            .session
            .liveliness()
            .declare_subscriber(Token::all_of(config.domain))
            .history(true)
            .callback(move |sample| follow(&weak, &sample))
            .wait()
            .map_err(|error| refused(error.to_string()))?;
        *lock(&participant.liveliness) = Some(subscriber);
        Ok(participant)
    }

    pub(crate) fn session(&self) -> &Session {
        &self.session
    }

    pub(crate) fn domain(&self) -> u32 {
        self.domain
    }

    /// Returns the endpoints of the routers if none of them is connected.
    pub(crate) fn missing_routers(&self) -> Option<String> {
        let is_connected = self.session.info().routers_zid().wait().next().is_some();
        (!is_connected && !self.routers.is_empty()).then(|| self.routers.join(", "))
    }

    pub(crate) fn workers(&self) -> &Workers {
        &self.workers
    }

    pub(crate) fn pace(&self) -> &Arc<Pace> {
        &self.pace
    }

    /// Counts a refusal, and reports the first and then each tenfold number of its kind.
    pub(crate) fn refuse(&self, refusal: Refusal) {
        let counter = match refusal {
            Refusal::Token(_) => &self.refusals.tokens,
            // Users need to hear of these whatever came before.
            Refusal::Attachment(CodecError::OldAttachment) => &self.refusals.old_attachments,
            Refusal::Attachment(_) => &self.refusals.attachments,
            Refusal::Payload(_) => &self.refusals.payloads,
            Refusal::Parameters(_) | Refusal::Request => &self.refusals.requests,
        };
        let number = counter.fetch_add(1, Relaxed) + 1;
        if number.ilog10() > (number - 1).checked_ilog10().unwrap_or(0) || number == 1 {
            tracing::warn!(number, "on the Zenoh network, {refusal}");
        } else {
            tracing::debug!("on the Zenoh network, {refusal}");
        }
    }

    /// Returns the sessions whose messages count: a proxy does not hear itself.
    pub(crate) fn locality(&self) -> Locality {
        if self.is_proxy { Locality::Remote } else { Locality::Any }
    }

    pub(crate) fn graph(&self) -> MutexGuard<'_, WatchedGraph> {
        lock(&self.graph)
    }

    /// Returns the signal of changes of the graph.
    pub(crate) fn changed(&self) -> &Condvar {
        &self.changed
    }

    /// Has those look again who wait for the graph.
    pub(crate) fn wake(&self) {
        // A thread that looked before is waiting once the lock is free.
        drop(self.graph());
        self.changed.notify_all();
    }

    /// Waits until a condition of the graph holds, at most for `max`. Returns the last answer.
    pub(crate) fn wait<T>(&self, max: Duration, mut look: impl FnMut(&Graph) -> (bool, T)) -> T {
        let until = Instant::now() + max;
        let mut graph = self.graph();
        loop {
            let (is_so, answer) = look(&graph.graph);
            let left = until.saturating_duration_since(Instant::now());
            if is_so || left.is_zero() {
                return answer;
            }
            graph = self.changed.wait_timeout(graph, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Returns the key of an endpoint of a topic.
    pub(crate) fn topic_of(&self, spec: &EndpointSpec) -> Result<Key, String> {
        let EndpointSpec { topic, type_name, type_hash, .. } = spec;
        match TopicInfo::from_dds(topic, type_name, type_hash.as_deref()) {
            Err(CodecError::NoTypeHash) => self.named(spec).map(Key::OfOthers),
            known => known.map(Key::Known).map_err(describe),
        }
    }

    /// Returns the key of a service by its request, which may have the hash of the service or of a message, or none.
    pub(crate) fn service_of(&self, request: &EndpointSpec) -> Result<Key, String> {
        let EndpointSpec { topic, type_name, type_hash, .. } = request;
        let named = self.named(request)?;
        let Some(announced) = type_hash else { return Ok(Key::OfOthers(named)) };
        let ros_type = ServiceTopic::parse(topic, type_name).map(|(_, _, ros_type)| ros_type);
        let found = self.service_hash.as_ref().zip(ros_type).and_then(|(find, of)| find(&of, announced));
        if let Some(hash) = found {
            return TopicInfo::new(named.name(), named.type_name(), &hash).map(Key::Known).map_err(describe);
        }
        TopicInfo::new(named.name(), named.type_name(), announced).map(Key::Announced).map_err(describe)
    }

    /// Returns name and type of an endpoint, with a hash that stands for any.
    fn named(&self, spec: &EndpointSpec) -> Result<TopicInfo, String> {
        TopicInfo::from_dds(&spec.topic, &spec.type_name, Some(ANY_HASH)).map_err(describe)
    }

    /// Returns a topic with the hash that programs of this network have for its name and type.
    pub(crate) fn as_others_have(&self, named: &TopicInfo) -> Option<TopicInfo> {
        let graph = self.graph();
        let hash = graph.graph.hash_of(named.name(), named.type_name())?;
        TopicInfo::new(named.name(), named.type_name(), hash).ok()
    }

    /// Returns a topic with the hash that programs of this network have, or `None` if there are none.
    pub(crate) fn as_programs_have(&self, topic: &TopicInfo) -> Option<TopicInfo> {
        self.graph().graph.as_programs_have(topic).cloned()
    }

    /// Lets an endpoint open once its key is known.
    pub(crate) fn wait_for_key(self: &Arc<Self>, late: Weak<dyn Waits>) {
        let mut waiting = lock(&self.waiting);
        // Endpoints that were dropped need no place.
        waiting.retain(|one| one.strong_count() > 0);
        waiting.push(late);
        drop(waiting);
        self.open_waiting();
    }

    fn open_waiting(self: &Arc<Self>) {
        // Zenoh's threads are not to declare anything.
        if !lock(&self.waiting).is_empty() && !self.is_look_due.swap(true, AcqRel) {
            self.workers.run(Arc::new(OpenWaiting(Arc::downgrade(self))));
        }
    }

    /// Returns the number of a new endpoint. The endpoint has no token yet.
    pub(crate) fn reserve(&self) -> EndpointRef {
        EndpointRef { session: self.id, id: lock(&self.tokens).number() }
    }

    /// Declares the token of an endpoint, once the endpoint is ready.
    pub(crate) fn enter(
        self: &Arc<Self>,
        at: EndpointRef,
        kind: EntityKind,
        topic: &TopicInfo,
        qos: &Qos,
        backends: Option<&str>,
    ) -> Result<Entered, String> {
        let history = if qos.history.is_unsaid() { History::KeepLast(1) } else { qos.history };
        let qos = Qos { history, ..qos.clone() };
        let (topic, backends) = (topic.clone(), backends.map(str::to_owned));
        let gid = lock(&self.tokens).add(TokenEndpoint { kind, id: at.id, topic, qos, backends })?;
        Ok(Entered { at, gid, participant: Arc::clone(self) })
    }

    /// Assigns endpoints to nodes.
    pub(crate) fn announce(&self, nodes: &[GraphNode]) -> Result<(), String> {
        lock(&self.tokens).announce(nodes)
    }

    /// Returns the origin of a message on a topic.
    pub(crate) fn origin(&self, topic: &TopicInfo, gid: &Gid, stamped_by: Option<ZenohId>) -> Origin {
        let graph = self.graph();
        let known = graph.graph.endpoint_with(gid);
        // A session also stamps what arrives without a time, so the own id tells nothing.
        let stamped_by = stamped_by.filter(|id| *id != self.id);
        if self.is_proxy && known.map(|at| at.session).into_iter().chain(stamped_by).any(ZenohId::is_of_sgc) {
            return Origin::Proxy;
        }
        Origin::Program(known.or_else(|| graph.graph.only_publisher(topic, stamped_by?)))
    }

    /// Reads an attachment, and counts a refusal.
    pub(crate) fn attachment(&self, bytes: Option<&zenoh::bytes::ZBytes>) -> Option<Attachment> {
        let read = bytes.map_or(Err(CodecError::AttachmentLength { bytes: 0 }), |bytes| {
            // A longer one is no attachment of rmw_zenoh, and need not be put together.
            if bytes.len() > ATTACHMENT_READ_MAX {
                return Err(CodecError::AttachmentLength { bytes: bytes.len() });
            }
            Attachment::decode(&bytes.to_bytes())
        });
        read.inspect_err(|error| self.refuse(Refusal::Attachment(*error))).ok()
    }

    /// Returns the requests at the servers of a service, of which a new server answers those of the one before.
    pub(crate) fn requests(&self, service: &str) -> Arc<Requests> {
        let mut all = lock(&self.requests);
        all.retain(|_, requests| Arc::strong_count(requests) > 1 || !requests.is_empty());
        Arc::clone(all.entry(service.to_owned()).or_default())
    }

    /// Reads the parameters of a query, and counts a refusal. Parameters stay with their query until its end.
    pub(crate) fn accepts_parameters(&self, query: &Query) -> bool {
        let bytes = query.parameters().as_str().len();
        if bytes > PARAMETERS_BYTES_MAX {
            self.refuse(Refusal::Parameters(bytes));
        }
        bytes <= PARAMETERS_BYTES_MAX
    }

    /// Takes in a token that was declared or undeclared.
    fn follow(self: &Arc<Self>, text: &str, is_declared: bool) {
        let mut graph = self.graph();
        let mut gone = None;
        if is_declared {
            if let Err(error) = graph.graph.declare(text) {
                drop(graph);
                self.refuse(Refusal::Token(error));
                return;
            }
        } else {
            gone = graph.graph.undeclare(text);
        }
        graph.changed_at = Instant::now();
        drop(graph);
        self.changed.notify_all();
        if let Some(client) = gone {
            // A client that is gone gets no reply.
            let services: Vec<_> = lock(&self.requests).values().cloned().collect();
            services.iter().for_each(|requests| requests.forget(client));
        }
        if is_declared {
            self.open_waiting();
        }
    }
}

/// Opens endpoints whose keys are known now.
struct OpenWaiting(Weak<Participant>);

impl Work for OpenWaiting {
    fn run(self: Arc<Self>) {
        let Some(participant) = self.0.upgrade() else { return };
        // A token that comes from now on needs another look, so the endpoints stay in the list.
        participant.is_look_due.swap(false, AcqRel);
        let waiting = lock(&participant.waiting).clone();
        let is_done = |late: &Weak<dyn Waits>| late.upgrade().is_none_or(|late| late.try_open(&participant));
        let done: Vec<_> = waiting.into_iter().filter(is_done).collect();
        lock(&participant.waiting).retain(|late| !done.iter().any(|one| one.ptr_eq(late)));
    }
}

/// A hash that stands in for one while only name and type matter.
const ANY_HASH: &str = "RIHS01_";
/// Longest parameters of a query, bytes. Requests of ROS have none.
const PARAMETERS_BYTES_MAX: usize = 1024;
/// Longest attachment that is read at all, bytes: that of old versions, rounded up.
const ATTACHMENT_READ_MAX: usize = 128;

fn describe(error: CodecError) -> String {
    error.to_string()
}

fn follow(participant: &Weak<Participant>, sample: &Sample) {
    if let Some(participant) = participant.upgrade() {
        participant.follow(sample.key_expr().as_str(), sample.kind() == SampleKind::Put);
    }
}

impl Drop for Participant {
    fn drop(&mut self) {
        let (session, alive) = (self.session.clone(), self.alive.take());
        let subscriber = lock(&self.liveliness).take();
        // The last owner may be a thread of Zenoh's, on which closing would wait for itself.
        let close = move || {
            drop(subscriber);
            if let Err(error) = session.close().timeout(CLOSE_MAX).wait() {
                tracing::debug!(%error, "a Zenoh session did not close");
            }
            drop(alive);
        };
        if let Err(error) = std::thread::Builder::new().name("sgc-zenoh-close".into()).spawn(close) {
            tracing::warn!(%error, "a Zenoh session stays open: no thread can start");
        }
    }
}

impl std::fmt::Debug for Participant {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Participant")
            .field("domain", &self.domain)
            .field("id", &self.id)
            .finish_non_exhaustive()
    }
}

/// An endpoint with a token, until dropped.
#[derive(Debug)]
pub(crate) struct Entered {
    at: EndpointRef,
    gid: Arc<Mutex<Gid>>,
    participant: Arc<Participant>,
}

impl Entered {
    /// Returns the current id, which messages carry.
    pub(crate) fn gid(&self) -> Gid {
        *lock(&self.gid)
    }
}

impl Drop for Entered {
    fn drop(&mut self) {
        lock(&self.participant.tokens).remove(self.at, &self.gid);
    }
}

/// Runs work of Zenoh that blocks. Zenoh panics if it blocks on a runtime with one thread.
pub(crate) fn off_runtime<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    let is_single = Handle::try_current().is_ok_and(|h| h.runtime_flavor() == RuntimeFlavor::CurrentThread);
    if !is_single {
        return work();
    }
    std::thread::scope(|scope| match scope.spawn(work).join() {
        Ok(done) => done,
        Err(panic) => std::panic::resume_unwind(panic),
    })
}
