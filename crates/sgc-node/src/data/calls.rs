//! Services at this node: calls of local clients to other nodes, and calls of other nodes to local servers.
//!
//! The machines of `sgc-endpoint` remember the state of calls. This module is between them and the local network.
//! Workers do everything that may block, one at a time for each service. No lock is held while the local network is
//! called, since it may answer on the same thread.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{
    ANSWER_KEPT_BYTES_MAX, Answerer, Answering, CallLimits, CallLoss, CallStats, Caller, Message, Outcome,
};
use sgc_ros::{Guid, HandleCalls, RequestId, RosClient, RosError, RosServer, UnhandledCall};
use sgc_sync::lock;
use sgc_wire::{MessageHead, MessageKind, SinkId, SourceId};
use tokio::sync::Notify;
use tracing::{debug, warn};

use crate::data::call_ledger::{CallLedger, CallerId};
use crate::data::sending::share::{IsTooLarge, LocalShare};
use crate::data::stats::{DataDrop, Dropped, Drops};
use crate::data::writer_queue::write_drop;
use crate::drops::NodeDrop;

/// Longest wait of a message about a call for its local endpoint.
const ENDPOINT_WAIT: Duration = Duration::from_secs(10);
/// Most replies that are kept until their request id is known.
const EARLY_MAX: usize = 64;

/// One service at this node.
#[derive(Clone)]
pub(crate) enum Calls {
    /// Its server is on this network.
    LocalService(Arc<LocalService>),
    /// Its server is elsewhere, and local clients call it.
    FarService(Arc<FarService>),
}

impl Calls {
    /// Returns the ledger of lost calls.
    pub(crate) fn ledger(&self) -> &CallLedger {
        match self {
            Self::LocalService(local) => &local.ledger,
            Self::FarService(far) => &far.ledger,
        }
    }

    /// Ends the service: open calls stay without an answer.
    pub(crate) fn withdraw(&self) {
        match self {
            Self::LocalService(local) => {
                local.lock().answerer.withdraw();
                local.count_lost();
            }
            Self::FarService(far) => {
                let mut state = far.lock();
                state.closed = true;
                state.caller.withdraw();
                drop(state);
                far.count_lost();
            }
        }
        self.ledger().add_past(self.stats());
    }

    /// Returns the statistics of its calls.
    pub(crate) fn stats(&self) -> CallStats {
        match self {
            Self::LocalService(local) => local.lock().answerer.stats(),
            Self::FarService(far) => far.lock().caller.stats(),
        }
    }

    /// Closes it. Nothing waits for a local endpoint any more; the present one is returned.
    pub(crate) fn close(&self) -> Option<Box<dyn std::any::Any + Send>> {
        match self {
            Self::LocalService(local) => {
                local.lock().closed = true;
                local.ready.notify_all();
                local.set_client(None)
            }
            Self::FarService(far) => {
                far.lock().closed = true;
                far.ready.notify_all();
                far.set_server(None)
            }
        }
    }
}

/// A value whose drop may block.
type DeferredDrop = Option<Box<dyn std::any::Any + Send>>;

struct LocalServiceState {
    answerer: Answerer<RequestId, Guid>,
    client: Option<Arc<dyn RosClient>>,
    /// Whether the client ends once no call is open.
    ending: bool,
    /// Whether a request is being sent. Its reply may arrive before its id is known.
    asking: bool,
    /// Servers that disappeared meanwhile.
    gone: BTreeSet<Guid>,
    early: Vec<(RequestId, Bytes)>,
    sinks: BTreeMap<SourceId, SinkId>,
    closed: bool,
}

/// A service of the local network that other nodes call.
pub(crate) struct LocalService {
    share: Arc<LocalShare>,
    failures: Arc<Drops>,
    ledger: Arc<CallLedger>,
    state: Mutex<LocalServiceState>,
    /// Notified when there is a client, and on closing.
    ready: Condvar,
}

impl LocalService {
    /// Creates the service without callers. Messages leave through the share.
    pub(crate) fn new(share: Arc<LocalShare>, failures: Arc<Drops>, ledger: Arc<CallLedger>) -> Self {
        let state = LocalServiceState {
            answerer: Answerer::new(CallLimits::default()),
            client: None,
            ending: false,
            asking: false,
            gone: BTreeSet::new(),
            early: Vec::new(),
            sinks: BTreeMap::new(),
            closed: false,
        };
        Self { share, failures, ledger, state: Mutex::new(state), ready: Condvar::new() }
    }

    /// Sets the callers.
    pub(crate) fn set_callers(&self, sinks: BTreeMap<SourceId, SinkId>) {
        self.lock().sinks = sinks;
    }

    /// Sets the client of local servers. Returns the previous one, whose drop may block.
    pub(crate) fn set_client(&self, client: Option<Arc<dyn RosClient>>) -> DeferredDrop {
        let mut state = self.lock();
        state.ending = false;
        let old = std::mem::replace(&mut state.client, client);
        self.ready.notify_all();
        old.map(|old| Box::new(old) as _)
    }

    /// Ends the client once no call is open. Returns it if none is.
    pub(crate) fn end_client(&self) -> DeferredDrop {
        let mut state = self.lock();
        state.ending = true;
        state.take_ended()
    }

    /// Keeps the client, because a caller is back. Returns `true` if there is one.
    pub(crate) fn keep_client(&self) -> bool {
        let mut state = self.lock();
        state.ending = false;
        state.client.is_some()
    }

    /// Handles that no local server is left.
    pub(crate) fn servers_gone(self: &Arc<Self>) {
        let lost = self.lock().answerer.servers_gone();
        self.tell_lost(lost);
    }

    /// Handles the end of a local endpoint, which may be a server's.
    pub(crate) fn endpoint_gone(self: &Arc<Self>, guid: &Guid) {
        let lost = {
            let mut state = self.lock();
            if state.asking {
                state.gone.insert(*guid);
            }
            state.answerer.server_gone(guid)
        };
        self.tell_lost(lost);
    }

    /// Tells callers, on a blocking thread, that these calls get no answer.
    fn tell_lost(self: &Arc<Self>, lost: Vec<(SourceId, u64, Bytes)>) {
        self.count_lost();
        if lost.is_empty() {
            return;
        }
        let this = self.clone();
        self.share.run_blocking(move || {
            lost.into_iter().for_each(|(source, number, why)| {
                this.tell(source, MessageKind::Gone, number, why);
            });
        });
    }

    fn count_lost(&self) {
        let lost = self.lock().answerer.take_lost();
        lost.into_iter().for_each(|lost| self.ledger.count(lost.loss, Some(CallerId::Source(lost.of)), 1));
    }

    /// Handles a message about a call from another node. Runs on a worker.
    pub(crate) fn take(self: &Arc<Self>, message: Message) {
        let (source, number) = (message.source, message.head.call());
        let what = self.lock().answerer.handle(source, message.head.kind, number);
        self.count_lost();
        match what {
            Answering::Nothing => {}
            Answering::Tell(kind, payload) => {
                self.tell(source, kind, number, payload);
            }
            Answering::Ask => self.ask(source, number, message.payload),
        }
    }

    /// Sends a request to the local server.
    fn ask(self: &Arc<Self>, source: SourceId, number: u64, payload: Bytes) {
        let Some(client) = self.client() else { return self.lock().answerer.not_asked(source, number) };
        self.lock().asking = true;
        let asked = client.send(payload);
        let early = {
            let mut state = self.lock();
            state.asking = false;
            let gone = std::mem::take(&mut state.gone);
            match &asked {
                Ok(sent) => {
                    let servers = sent.servers.difference(&gone).copied().collect();
                    state.answerer.asked(source, number, sent.id, servers);
                }
                Err(_) => state.answerer.not_asked(source, number),
            }
            std::mem::take(&mut state.early)
        };
        if let Err(why) = asked {
            self.failed(&why);
        }
        early.into_iter().for_each(|(id, payload)| self.answer(id, payload));
        let lost = self.lock().answerer.lose_unanswerable();
        self.tell_lost(lost);
    }

    /// Waits for the client and returns it.
    fn client(&self) -> Option<Arc<dyn RosClient>> {
        let until = Instant::now() + ENDPOINT_WAIT;
        let mut state = self.lock();
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if state.client.is_some() || state.closed || left.is_zero() {
                return state.client.clone().filter(|_| !state.closed);
            }
            state = self.ready.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Handles a reply of the local server. Runs on a worker of the client.
    pub(crate) fn answer(&self, id: RequestId, payload: Bytes) {
        let (answered, ended) = {
            let mut state = self.lock();
            let answered = state.answerer.answered(&id, &payload);
            if answered.is_none() && state.asking && state.early.len() < EARLY_MAX {
                state.early.push((id, payload));
                return;
            }
            (answered, state.take_ended())
        };
        if let Some((source, number)) = answered {
            self.ledger.answered();
            if self.tell(source, MessageKind::Reply, number, payload) == IsTooLarge::Yes {
                let why = self.lock().answerer.too_large(source, number);
                self.count_lost();
                self.tell(source, MessageKind::Gone, number, why);
            }
        } else {
            self.failures.count(NodeDrop::ReplyToNothing);
        }
        // The client cannot be dropped by its own worker.
        if let Some(ended) = ended {
            self.share.run_blocking(move || drop(ended));
        }
    }

    fn tell(&self, source: SourceId, kind: MessageKind, number: u64, payload: Bytes) -> IsTooLarge {
        // A caller that is gone asks again when it is back.
        let Some(sink) = self.lock().sinks.get(&source).copied() else { return IsTooLarge::No };
        self.share.publish_call(&MessageHead::for_call(kind, number), payload, Some(sink))
    }

    fn failed(&self, why: &RosError) {
        if self.failures.count(write_drop(why)) {
            warn!(%why, "a call could not be given to a local server; counted from here on");
        }
    }

    fn lock(&self) -> MutexGuard<'_, LocalServiceState> {
        lock(&self.state)
    }
}

impl LocalServiceState {
    fn take_ended(&mut self) -> DeferredDrop {
        let ends = self.ending && self.answerer.open() == 0 && !self.asking;
        let client = if ends { self.client.take() } else { None };
        client.map(|client| Box::new(client) as _)
    }
}

/// Takes replies of local servers.
pub(crate) struct Answers(pub(crate) Arc<LocalService>);

impl HandleCalls for Answers {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        self.0.answer(id, payload);
    }

    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        count_unhandled(&self.0.share, &self.0.ledger, why, messages);
    }
}

/// Takes requests of local clients.
pub(crate) struct Requests(pub(crate) Arc<FarService>);

impl HandleCalls for Requests {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        self.0.call(id, payload);
    }

    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        count_unhandled(&self.0.share, &self.0.ledger, why, messages);
    }
}

fn count_unhandled(share: &LocalShare, ledger: &CallLedger, why: UnhandledCall, messages: u64) {
    match why {
        UnhandledCall::Overrun => {
            share.count_here(Dropped { reason: DataDrop::Overrun, messages });
            ledger.count(CallLoss::Overrun, None, messages);
        }
        UnhandledCall::Unreadable => ledger.count(CallLoss::Unreadable, None, messages),
    }
}

struct FarServiceState {
    caller: Caller<RequestId>,
    server: Option<Arc<dyn RosServer>>,
    sink: Option<SinkId>,
    closed: bool,
}

/// A service of another node that local clients call.
pub(crate) struct FarService {
    share: Arc<LocalShare>,
    failures: Arc<Drops>,
    ledger: Arc<CallLedger>,
    state: Mutex<FarServiceState>,
    /// Notified when there is a server, and on closing.
    ready: Condvar,
    /// Wakes the control task, which asks for the state of calls.
    wake: Arc<Notify>,
}

impl FarService {
    /// Creates the service without calls. Requests leave through the share.
    pub(crate) fn new(
        share: Arc<LocalShare>,
        failures: Arc<Drops>,
        ledger: Arc<CallLedger>,
        wake: Arc<Notify>,
    ) -> Self {
        let caller = Caller::new(CallLimits::default());
        let state = FarServiceState { caller, server: None, sink: None, closed: false };
        Self { share, failures, ledger, state: Mutex::new(state), ready: Condvar::new(), wake }
    }

    /// Sets the server for local clients. Returns the previous one, whose drop may block.
    pub(crate) fn set_server(&self, server: Option<Arc<dyn RosServer>>) -> DeferredDrop {
        let old = std::mem::replace(&mut self.lock().server, server);
        self.ready.notify_all();
        old.map(|old| Box::new(old) as _)
    }

    /// Handles a request of a local client. Runs on a worker of the server.
    pub(crate) fn call(&self, id: RequestId, payload: Bytes) {
        let (number, wakes) = {
            let mut state = self.lock();
            let before = state.caller.deadline();
            let number = state.caller.call(Instant::now(), id.client, id, payload.clone());
            if state.closed {
                state.caller.withdraw();
            }
            (number.map(|number| number.filter(|_| !state.closed)), state.caller.deadline() != before)
        };
        self.count_lost();
        if wakes {
            self.wake.notify_one();
        }
        match number {
            Ok(Some(number)) => self.publish(MessageKind::Request, number, payload),
            Ok(None) => {}
            Err(why) => debug!(%why, "refused a call"),
        }
    }

    /// Handles the owner's grant for this sink. `anew` says that the owner knows no earlier call.
    pub(crate) fn granted(self: &Arc<Self>, sink: SinkId, anew: bool) {
        let open = {
            let mut state = self.lock();
            if state.sink.replace(sink) == Some(sink) && !anew {
                return;
            }
            state.caller.granted(Instant::now(), anew)
        };
        self.count_lost();
        self.publish_elsewhere(MessageKind::Request, open);
    }

    /// Handles that the path to the owner is lost for now.
    pub(crate) fn lost(&self) {
        let mut state = self.lock();
        state.sink = None;
        state.caller.lost();
    }

    /// Handles the end of a local endpoint. Its calls end if it was a client.
    pub(crate) fn endpoint_gone(self: &Arc<Self>, guid: &Guid) {
        let over = self.lock().caller.client_gone(|id| id.asker == Some(*guid));
        self.count_lost();
        self.publish_elsewhere(MessageKind::Forget, over.into_iter().map(|n| (n, Bytes::new())).collect());
    }

    /// Asks for the state of calls without news for long.
    pub(crate) fn ask_due(self: &Arc<Self>, now: Instant) {
        let due = self.lock().caller.ask_due(now);
        self.publish_elsewhere(MessageKind::Ask, due.into_iter().map(|n| (n, Bytes::new())).collect());
    }

    /// Returns the time of the next such question.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.lock().caller.deadline()
    }

    /// Handles the owner's message about a call. Runs on a worker.
    pub(crate) fn take(&self, message: Message) {
        let (kind, number) = (message.head.kind, message.head.call());
        // Without a server to deliver it, a reply waits where it is.
        let server = match kind {
            MessageKind::Reply => match self.server() {
                Some(server) => Some(server),
                None => return,
            },
            _ => None,
        };
        let outcome = self.lock().caller.handle(kind, number, &message.payload);
        self.count_lost();
        match (outcome, server) {
            (Outcome::Answers(id), Some(server)) => {
                let bytes = message.payload.len();
                match server.reply(&id, message.payload) {
                    Ok(()) => self.ledger.answered(),
                    Err(why) => {
                        debug!(%why, "an answer could not be given to a local client");
                        self.failures.count(write_drop(&why));
                        self.lock().caller.unheard(id);
                        self.count_lost();
                    }
                }
                if bytes > ANSWER_KEPT_BYTES_MAX {
                    self.publish(MessageKind::Forget, number, Bytes::new());
                }
            }
            (Outcome::Again(payload), _) => self.publish(MessageKind::Request, number, payload),
            _ => {}
        }
    }

    /// Waits for the server and returns it.
    fn server(&self) -> Option<Arc<dyn RosServer>> {
        let until = Instant::now() + ENDPOINT_WAIT;
        let mut state = self.lock();
        loop {
            let left = until.saturating_duration_since(Instant::now());
            if state.server.is_some() || state.closed || left.is_zero() {
                return state.server.clone();
            }
            state = self.ready.wait_timeout(state, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn publish(&self, kind: MessageKind, number: u64, payload: Bytes) {
        let head = MessageHead::for_call(kind, number);
        if self.share.publish_call(&head, payload, None) == IsTooLarge::Yes {
            self.lock().caller.lose(number, CallLoss::TooLarge);
            self.count_lost();
        }
    }

    fn count_lost(&self) {
        let lost = self.lock().caller.take_lost();
        for lost in lost {
            self.ledger.count(lost.loss, lost.of.asker.map(CallerId::Client), 1);
        }
    }

    /// Publishes several messages on a blocking thread.
    fn publish_elsewhere(self: &Arc<Self>, kind: MessageKind, calls: Vec<(u64, Bytes)>) {
        if calls.is_empty() {
            return;
        }
        let this = self.clone();
        self.share.run_blocking(move || {
            calls.into_iter().for_each(|(number, payload)| this.publish(kind, number, payload));
        });
    }

    fn lock(&self) -> MutexGuard<'_, FarServiceState> {
        lock(&self.state)
    }
}
