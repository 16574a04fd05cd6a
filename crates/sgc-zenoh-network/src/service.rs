//! [`ZenohClient`] and [`ZenohServer`]: services as queries.
//!
//! A server is a queryable, a request a query to all servers that say they are complete. The first reply counts.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering::Relaxed};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use sgc_ros::{
    EndpointKind, Guid, RequestHandler, RequestId, RosClient, RosError, RosServer, SentRequest, ServiceSpec,
    UnhandledCall,
};
use sgc_zenoh::{Attachment, EndpointRef, EntityKind, Gid, Graph, TopicInfo};
use zenoh::Wait as _;
use zenoh::query::{ConsolidationMode, Querier, Query, QueryTarget, Queryable, Reply};

use crate::check_length;
use crate::intake::{Intake, Item, Receive, Shared};
use crate::late::{Late, Opened};
use crate::participant::{Entered, Origin, Participant, Refusal};
use crate::requests::Requests;

/// Longest wait of a request for a server, in milliseconds.
const SERVER_WAIT_MAX_MS: u64 = 1000;
/// Longest wait for a reply. Zenoh keeps a timer for each request for so long, also once it has the reply.
const REPLY_WAIT_MAX: Duration = Duration::from_secs(600);
/// Longest wait for the result of an action, which may take hours.
const RESULT_WAIT_MAX: Duration = Duration::from_secs(24 * 3600);
/// The end of the name of a service by which the client of an action asks for its result.
const RESULT_OF_ACTION: &str = "/_action/get_result";
/// Most requests of one client without a reply.
const OPEN_MAX: usize = 4096;
/// Most requests or replies that wait for a handler.
const WAITING_MAX: usize = 4096;

/// A request at a server, or a reply at a client.
struct Call {
    id: RequestId,
    payload: Bytes,
}

impl Item for Call {
    fn bytes(&self) -> usize {
        self.payload.len()
    }
}

/// The receiver that passes requests or replies to the handler.
struct Calls(RequestHandler);

impl Receive<Call> for Calls {
    fn receive(&mut self, call: Call, _more: bool) {
        self.0.handle(call.id, call.payload);
    }

    fn overrun(&mut self, calls: u64) {
        self.0.unhandled(UnhandledCall::Overrun, calls);
    }
}

/// A client. Dropping it waits for a handler of a reply at work.
#[derive(Debug)]
pub struct ZenohClient {
    at: EndpointRef,
    participant: Arc<Participant>,
    late: Arc<Late<OpenClient>>,
    intake: Intake<Call, Calls>,
    next: AtomicI64,
    /// The number of requests without a reply.
    open: Arc<AtomicUsize>,
}

/// The parts of a client on the network.
#[derive(Debug)]
struct OpenClient {
    entered: Entered,
    querier: Querier<'static>,
    topic: TopicInfo,
}

impl ZenohClient {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &ServiceSpec,
        handler: RequestHandler,
    ) -> Result<Self, String> {
        let (key, at) = (participant.service_of(&spec.request)?, participant.reserve());
        let intake = Intake::new(participant.workers(), participant.pace(), WAITING_MAX, Calls(handler));
        let qos = spec.request.qos.clone();
        let late = Late::new(participant, key, move |participant, topic| {
            let is_result = topic.name().ends_with(RESULT_OF_ACTION);
            let querier = participant
                .session()
                .declare_querier(topic.key(participant.domain()))
                .target(QueryTarget::AllComplete)
                .consolidation(ConsolidationMode::None)
                .allowed_destination(participant.locality())
                .timeout(if is_result { RESULT_WAIT_MAX } else { REPLY_WAIT_MAX })
                .wait()
                .map_err(|error| error.to_string())?;
            let entered = participant.enter(at, EntityKind::Client, topic, &qos, None)?;
            Ok(OpenClient { entered, querier, topic: topic.clone() })
        })?;
        let (participant, open) = (Arc::clone(participant), Arc::default());
        Ok(Self { at, participant, late, intake, next: AtomicI64::new(1), open })
    }

    /// Returns the servers by their request readers.
    fn servers_in(&self, graph: &Graph) -> BTreeSet<Guid> {
        let servers = self.late.look(|open| {
            let servers = graph.matches(&open.topic, EntityKind::Server);
            servers.map(|at| at.guid(EndpointKind::Reader)).collect()
        });
        servers.unwrap_or_default()
    }
}

impl Opened for OpenClient {}

/// A request, which counts as open until its reply or until it is dropped.
struct OpenRequest {
    id: RequestId,
    is_answered: AtomicBool,
    open: Arc<AtomicUsize>,
}

impl OpenRequest {
    /// Returns `true` for the first reply. The request is kept until the last server has replied.
    fn answer(&self) -> bool {
        let is_first = !self.is_answered.swap(true, Relaxed);
        if is_first {
            self.open.fetch_sub(1, Relaxed);
        }
        is_first
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        self.answer();
    }
}

impl RosClient for ZenohClient {
    fn send(&self, payload: Bytes) -> Result<SentRequest, RosError> {
        check_length(payload.len())?;
        let max = Duration::from_millis(SERVER_WAIT_MAX_MS);
        let servers = self.participant.wait(max, |graph| {
            let servers = self.servers_in(graph);
            (!servers.is_empty(), servers)
        });
        let Some(open) = self.late.get().filter(|_| !servers.is_empty()) else {
            return Err(RosError::NoPeer { waited_ms: SERVER_WAIT_MAX_MS });
        };
        let gid = open.entered.gid();
        let id = RequestId { client: gid.0, number: self.next.fetch_add(1, Relaxed), asker: None };
        if self.open.fetch_add(1, Relaxed) >= OPEN_MAX {
            self.open.fetch_sub(1, Relaxed);
            return Err(RosError::Write {
                reason: format!("{OPEN_MAX} requests of this client have no reply"),
            });
        }
        let request = OpenRequest { id, is_answered: AtomicBool::new(false), open: Arc::clone(&self.open) };
        let attachment = Attachment { sequence: id.number, source_timestamp_ns: now_ns(), gid };
        let (participant, shared) = (Arc::downgrade(&self.participant), self.intake.shared());
        let callback = move |reply: Reply| {
            if let Some(participant) = participant.upgrade() {
                take_reply(&participant, &shared, &request, &reply);
            }
        };
        let asked =
            open.querier.get().payload(payload).attachment(attachment.encode()).callback(callback).wait();
        asked.map_err(|error| RosError::Write { reason: error.to_string() })?;
        Ok(SentRequest { id, servers })
    }

    fn servers(&self) -> BTreeSet<Guid> {
        self.servers_in(&self.participant.graph().graph)
    }

    fn guids(&self) -> [Guid; 2] {
        [EndpointKind::Reader, EndpointKind::Writer].map(|kind| self.at.guid(kind))
    }
}

fn take_reply(participant: &Participant, shared: &Shared<Call, Calls>, request: &OpenRequest, reply: &Reply) {
    let sample = match reply.result() {
        Ok(sample) => sample,
        Err(error) => {
            tracing::debug!(error = %String::from_utf8_lossy(&error.payload().to_bytes()), "a request failed");
            return;
        }
    };
    // Zenoh pairs replies with requests. A reply without an attachment is not one of a server of ROS.
    let Some(attachment) = participant.attachment(sample.attachment()) else { return };
    let Some(payload) = participant.payload(sample.payload()) else { return };
    if attachment.sequence == request.id.number && request.answer() {
        shared.arrive(Call { id: request.id, payload });
    }
}

/// A server. Dropping it waits for a handler of a request at work.
#[derive(Debug)]
pub struct ZenohServer {
    at: EndpointRef,
    late: Arc<Late<OpenServer>>,
    requests: Arc<Requests>,
    _intake: Intake<Call, Calls>,
}

/// The parts of a server on the network.
#[derive(Debug)]
struct OpenServer {
    /// Ends first: clients recognise a server by its token.
    _entered: Entered,
    _queryable: Queryable<()>,
    key: String,
}

impl Opened for OpenServer {}

impl ZenohServer {
    pub(crate) fn new(
        participant: &Arc<Participant>,
        spec: &ServiceSpec,
        handler: RequestHandler,
    ) -> Result<Self, String> {
        let (key, at) = (participant.service_of(&spec.request)?, participant.reserve());
        let intake = Intake::new(participant.workers(), participant.pace(), WAITING_MAX, Calls(handler));
        let (shared, qos, requests) =
            (intake.shared(), spec.request.qos.clone(), participant.requests(&spec.request.topic));
        let kept = Arc::clone(&requests);
        let late = Late::new(participant, key, move |participant, topic| {
            let key = topic.key(participant.domain());
            let (weak, of) = (Arc::downgrade(participant), topic.clone());
            let (shared, requests) = (Arc::clone(&shared), Arc::clone(&kept));
            let callback = move |query: Query| {
                if let Some(participant) = weak.upgrade() {
                    take_request(&participant, &of, &requests, &shared, query);
                }
            };
            let queryable = participant
                .session()
                .declare_queryable(key.clone())
                .complete(true)
                .allowed_origin(participant.locality())
                .callback(callback)
                .wait()
                .map_err(|error| error.to_string())?;
            let entered = participant.enter(at, EntityKind::Server, topic, &qos, None)?;
            Ok(OpenServer { _entered: entered, _queryable: queryable, key })
        })?;
        Ok(Self { at, late, requests, _intake: intake })
    }
}

fn take_request(
    participant: &Participant,
    topic: &TopicInfo,
    requests: &Requests,
    shared: &Shared<Call, Calls>,
    mut query: Query,
) {
    let Some(attachment) = participant.attachment(query.attachment()) else { return };
    // Dropping the query tells its client that this server does not reply.
    if participant.origin(topic, &attachment.gid, None) == Origin::Proxy {
        return;
    }
    if !participant.accepts_parameters(&query) {
        return;
    }
    // It need not stay with the query until the reply.
    let payload = query.payload_mut().map(std::mem::take).unwrap_or_default();
    let Some(payload) = participant.payload(&payload) else { return };
    let Attachment { sequence: number, gid: client, .. } = attachment;
    let asker = participant.graph().graph.endpoint_with(&client);
    if !requests.keep(client, number, asker, query) {
        participant.refuse(Refusal::Request);
    }
    let asker = asker.map(|at| at.guid(EndpointKind::Writer));
    shared.arrive(Call { id: RequestId { client: client.0, number, asker }, payload });
}

impl RosServer for ZenohServer {
    fn reply(&self, request: &RequestId, payload: Bytes) -> Result<(), RosError> {
        check_length(payload.len())?;
        let query = self.requests.take(request);
        let (query, open) = query.zip(self.late.get()).ok_or(RosError::NoPeer { waited_ms: 0 })?;
        let attachment =
            Attachment { sequence: request.number, source_timestamp_ns: now_ns(), gid: Gid(request.client) };
        let replied = query.reply(open.key.as_str(), payload).attachment(attachment.encode()).wait();
        replied.map_err(|error| RosError::Write { reason: error.to_string() })
    }

    fn guids(&self) -> [Guid; 2] {
        [EndpointKind::Reader, EndpointKind::Writer].map(|kind| self.at.guid(kind))
    }
}

fn now_ns() -> i64 {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(now.as_nanos()).unwrap_or(i64::MAX)
}
