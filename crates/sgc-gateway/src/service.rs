//! [`Caller`] calls a service for all clients; [`Serving`] serves a service for one client.

use std::collections::{BTreeMap, VecDeque};
use std::fmt;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use bytes::Bytes;
use sgc_cdr::{Layout, Value};
use sgc_ros::{
    EndpointKind, EndpointSpec, HandleCalls, RequestId, RosClient, RosError, RosServer, ServiceSpec,
    ServiceTopic, service_qos,
};
use sgc_sync::lock;
use tokio::sync::{mpsc, oneshot};

use crate::content::{Content, Form, convert, serialise};
use crate::error::GatewayError;
use crate::feed::own_endpoint;
use crate::network::Network;
use crate::quota::{Charge, Quota};

/// Most replies that arrive before their request number is known.
const EARLY_MAX: usize = 64;
/// Most requests that are queued for a client that serves. Beyond that the callers wait.
const REQUESTS_MAX: usize = 256;

/// The layouts of a service's request and reply.
#[derive(Clone, Debug)]
pub(crate) struct Halves {
    pub(crate) request: Arc<Layout>,
    pub(crate) reply: Arc<Layout>,
}

impl Halves {
    /// Finds the layouts of a service type. May read files.
    pub(crate) fn find(shared: &Network, type_name: &str) -> Result<Self, GatewayError> {
        let layout = |half: &str| shared.types.layout(&format!("{type_name}_{half}"), None);
        Ok(Self { request: layout("Request")?, reply: layout("Response")? })
    }
}

fn spec(service: &str, type_name: &str, halves: &Halves) -> ServiceSpec {
    let half = |half: ServiceTopic, layout: &Layout| EndpointSpec {
        topic: half.dds_topic(service),
        type_name: half.dds_type(type_name),
        keyless: true,
        asks_key_hash: false,
        type_hash: Some(layout.type_hash()),
        qos: service_qos(),
    };
    ServiceSpec {
        request: half(ServiceTopic::Request, &halves.request),
        reply: half(ServiceTopic::Reply, &halves.reply),
    }
}

/// The id of a client on the network and the number of its request. A client that is created again has another id.
type CallId = ([u8; 16], i64);

#[derive(Default)]
struct PendingCalls {
    asked: BTreeMap<CallId, oneshot::Sender<Bytes>>,
    /// Requests that are being sent, whose numbers are not known yet.
    sending: usize,
    /// Replies that may belong to these requests.
    early: VecDeque<(CallId, Bytes)>,
    /// The number of times that the network closed.
    closings: u64,
}

/// A request that is being sent, from [`PendingCalls::begin`] to [`PendingCalls::finish`].
struct Sending {
    /// The number of closings before it.
    closings: u64,
}

impl PendingCalls {
    /// Notes that a request is being sent.
    fn begin(&mut self) -> Sending {
        self.sending += 1;
        Sending { closings: self.closings }
    }

    /// Notes that the request was sent, and returns the receiver of its reply. A call whose network closed meanwhile
    /// gets none, so it fails as closed unless its reply is here.
    fn finish(
        &mut self,
        sending: &Sending,
        sent: Result<RequestId, RosError>,
    ) -> Result<(CallId, oneshot::Receiver<Bytes>), RosError> {
        self.sending -= 1;
        let early = sent.as_ref().ok().and_then(|id| {
            let at = self.early.iter().position(|(of, _)| *of == (id.client, id.number))?;
            self.early.remove(at)
        });
        if self.sending == 0 {
            self.early.clear();
        }
        let sent = sent?;
        let id = (sent.client, sent.number);
        let (send, reply) = oneshot::channel();
        match early {
            Some((_, payload)) => drop(send.send(payload)),
            None if self.closings != sending.closings => return Err(RosError::Closed),
            None => drop(self.asked.insert(id, send)),
        }
        Ok((id, reply))
    }

    /// Ends all calls: without their sender they fail.
    fn network_closed(&mut self) {
        self.closings += 1;
        self.asked.clear();
    }
}

/// The handler of a client's replies.
struct Replies(Arc<Mutex<PendingCalls>>);

impl HandleCalls for Replies {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        let id = (id.client, id.number);
        let mut pending = lock(&self.0);
        match pending.asked.remove(&id) {
            Some(waiting) => drop(waiting.send(payload)),
            // No call waits for this reply.
            None if pending.sending == 0 => {}
            None => {
                pending.early.push_back((id, payload));
                if pending.early.len() > EARLY_MAX {
                    pending.early.pop_front();
                }
            }
        }
    }

    fn network_closed(&mut self) {
        lock(&self.0).network_closed();
    }
}

/// A client of a service, shared by all callers.
pub(crate) struct Caller {
    service: String,
    type_name: String,
    pub(crate) halves: Halves,
    /// The client; `None` only while it is dropped, which may block.
    client: Option<Box<dyn RosClient>>,
    pending: Arc<Mutex<PendingCalls>>,
    shared: Weak<Network>,
}

/// A call in progress. Its reply is discarded after this is dropped.
struct CallGuard {
    caller: Arc<Caller>,
    id: CallId,
}

impl Drop for CallGuard {
    fn drop(&mut self) {
        lock(&self.caller.pending).asked.remove(&self.id);
    }
}

impl Caller {
    /// Creates the client of a service. May block.
    pub(crate) fn new(shared: &Arc<Network>, service: &str, type_name: &str) -> Result<Self, GatewayError> {
        let halves = Halves::find(shared, type_name)?;
        let pending: Arc<Mutex<PendingCalls>> = Arc::default();
        let answered = Arc::clone(&pending);
        let spec = spec(service, type_name, &halves);
        let client = shared.ros.client(&spec, Box::new(Replies(answered)))?;
        let [reader, writer] = client.guids();
        shared.know(own_endpoint(EndpointKind::Reader, reader, &spec.reply));
        shared.know(own_endpoint(EndpointKind::Writer, writer, &spec.request));
        let (service, type_name) = (service.to_owned(), type_name.to_owned());
        let shared = Arc::downgrade(shared);
        Ok(Self { service, type_name, halves, client: Some(client), pending, shared })
    }

    pub(crate) fn is_for(&self, service: &str, type_name: &str) -> bool {
        self.service == service && self.type_name == type_name
    }

    /// Sends a request and returns a guard and a receiver for the reply. May block.
    fn ask(self: &Arc<Self>, payload: Bytes) -> Result<(CallGuard, oneshot::Receiver<Bytes>), RosError> {
        let client = self.client.as_ref().ok_or(RosError::NoPeer { waited_ms: 0 })?;
        let sending = lock(&self.pending).begin();
        let sent = client.request(payload);
        let (id, reply) = lock(&self.pending).finish(&sending, sent)?;
        Ok((CallGuard { caller: Arc::clone(self), id }, reply))
    }

    /// Calls the service and waits for the reply.
    pub(crate) async fn call(
        self: &Arc<Self>,
        payload: Bytes,
        max: Duration,
        quota: &Quota,
    ) -> Result<Bytes, GatewayError> {
        let shared = self.shared.upgrade().ok_or(GatewayError::Stopping)?;
        let caller = Arc::clone(self);
        let asked = {
            let _thread = quota.thread().await?;
            shared.blocking(move |_| caller.ask(payload)).await
        };
        let (_asked, reply) = match asked {
            Err(GatewayError::Ros(RosError::NoPeer { .. })) => {
                return Err(GatewayError::NoServer { name: self.service.clone() });
            }
            Err(GatewayError::Ros(RosError::Closed)) => return Err(self.cut_off(&shared)),
            asked => asked?,
        };
        match tokio::time::timeout(max, reply).await {
            Ok(Ok(payload)) => Ok(payload),
            Ok(Err(_)) => Err(self.cut_off(&shared)),
            Err(_) => Err(GatewayError::Timeout {
                name: self.service.clone(),
                waited_ms: u64::try_from(max.as_millis()).unwrap_or(u64::MAX),
            }),
        }
    }
}

impl Caller {
    /// Counts a call that gets no answer because the network closed. Returns its error.
    fn cut_off(&self, shared: &Network) -> GatewayError {
        shared.quotas.count_call_cut_off();
        GatewayError::CutOff { name: self.service.clone() }
    }
}

impl Drop for Caller {
    fn drop(&mut self) {
        if let Some((shared, client)) = self.shared.upgrade().zip(self.client.take()) {
            shared.forget(&client.guids());
            shared.runtime.spawn_blocking(move || drop(client));
        }
    }
}

/// A request to a client that serves a service.
#[derive(Debug)]
pub struct Request {
    /// The id for the reply.
    pub id: RequestId,
    /// The serialised request.
    pub payload: Bytes,
}

/// A service that a client serves, until dropped.
pub struct Serving {
    shared: Arc<Network>,
    server: Arc<dyn RosServer>,
    halves: Halves,
    requests: mpsc::Receiver<Request>,
    service: String,
    _charge: Option<Charge>,
}

/// A handle that answers requests of a [`Serving`] from any task.
#[derive(Clone)]
pub struct Replier {
    shared: Arc<Network>,
    server: Arc<dyn RosServer>,
    halves: Halves,
}

impl Replier {
    /// Returns the layout of replies.
    pub fn reply_layout(&self) -> &Arc<Layout> {
        &self.halves.reply
    }

    /// Answers a request.
    pub async fn reply(&self, id: RequestId, content: &Content) -> Result<(), GatewayError> {
        let payload = content.to_cdr(&self.halves.reply)?;
        self.send(id, payload).await
    }

    /// Answers a request with a value.
    pub(crate) async fn reply_value(&self, id: RequestId, value: &Value) -> Result<(), GatewayError> {
        let payload = serialise(&self.halves.reply, value)?;
        self.send(id, payload).await
    }

    async fn send(&self, id: RequestId, payload: Bytes) -> Result<(), GatewayError> {
        let server = Arc::clone(&self.server);
        self.shared.blocking(move |_| server.reply(&id, payload)).await
    }
}

impl fmt::Debug for Replier {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Replier").finish_non_exhaustive()
    }
}

impl Serving {
    pub(crate) async fn new(
        shared: &Arc<Network>,
        service: String,
        type_name: String,
        charge: Option<Charge>,
    ) -> Result<Self, GatewayError> {
        shared
            .run(move |shared| {
                let halves = Halves::find(shared, &type_name)?;
                let spec = spec(&service, &type_name, &halves);
                let (send, requests) = mpsc::channel(REQUESTS_MAX);
                // The handler may wait for room.
                let handler = Box::new(move |id: RequestId, payload: Bytes| {
                    drop(send.blocking_send(Request { id, payload }));
                });
                let server: Arc<dyn RosServer> = Arc::from(shared.ros.server(&spec, handler)?);
                let [reader, writer] = server.guids();
                shared.know(own_endpoint(EndpointKind::Reader, reader, &spec.request));
                shared.know(own_endpoint(EndpointKind::Writer, writer, &spec.reply));
                let shared = Arc::clone(shared);
                Ok(Self { shared, server, halves, requests, service, _charge: charge })
            })
            .await
    }

    /// Returns the name of the service.
    pub fn service(&self) -> &str {
        &self.service
    }

    /// Waits for a request. Returns `None` once the gateway stops.
    pub async fn next(&mut self) -> Option<Request> {
        self.requests.recv().await
    }

    /// Converts a request to a form.
    pub fn write(&self, request: &Request, form: Form) -> Result<Bytes, GatewayError> {
        convert(&self.halves.request, &request.payload, form)
    }

    /// Returns the layout of requests.
    pub fn request_layout(&self) -> &Arc<Layout> {
        &self.halves.request
    }

    /// Returns a handle that answers requests.
    pub fn replier(&self) -> Replier {
        let (shared, server) = (Arc::clone(&self.shared), Arc::clone(&self.server));
        Replier { shared, server, halves: self.halves.clone() }
    }
}

impl fmt::Debug for Serving {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Serving").field("service", &self.service).finish_non_exhaustive()
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        // A handler that waits for room continues.
        self.requests.close();
        let (shared, server) = (Arc::clone(&self.shared), Arc::clone(&self.server));
        self.shared.runtime.spawn_blocking(move || {
            shared.forget(&server.guids());
            drop(server);
        });
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    fn sent(number: i64) -> RequestId {
        RequestId { client: [7; 16], number, asker: None }
    }

    #[test]
    fn call_whose_network_closes_while_it_is_sent_is_cut_off() {
        let pending: Arc<Mutex<PendingCalls>> = Arc::default();
        let mut replies = Replies(Arc::clone(&pending));
        let sending = lock(&pending).begin();
        replies.network_closed();
        let finished = lock(&pending).finish(&sending, Ok(sent(1)));
        assert_eq!(finished.unwrap_err(), RosError::Closed);
        // The reply came before the network closed.
        let sending = lock(&pending).begin();
        replies.handle(sent(2), Bytes::from_static(b"reply"));
        replies.network_closed();
        let (_, mut reply) = lock(&pending).finish(&sending, Ok(sent(2))).unwrap();
        assert_eq!(reply.try_recv().unwrap(), Bytes::from_static(b"reply"));
        // A later call is on the next network.
        let sending = lock(&pending).begin();
        let (_, mut reply) = lock(&pending).finish(&sending, Ok(sent(3))).unwrap();
        assert_eq!(reply.try_recv(), Err(oneshot::error::TryRecvError::Empty));
        replies.network_closed();
        assert_eq!(reply.try_recv(), Err(oneshot::error::TryRecvError::Closed));
    }
}
