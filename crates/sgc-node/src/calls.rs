//! Services at this node: local calls that go elsewhere, and calls from elsewhere of a local server.
//!
//! What is remembered of a call is with the machines of `sgc-endpoint`; here are the threads between them and the local
//! network. Whatever may block does so on the thread of one service, and nobody calls the local network under a lock:
//! it may answer on the thread that asks.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_endpoint::{
    ANSWER_KEPT_BYTES_MAX, Answerer, Answering, CallLimits, CallLoss, CallStats, Caller, Message, Outcome,
};
use sgc_ros::{Guid, HandleCalls, RequestId, RosClient, RosError, RosServer, UnhandledCall};
use sgc_wire::{MessageHead, MessageKind, SinkId, SourceId};
use tokio::sync::Notify;
use tracing::{debug, warn};

use crate::call_ledger::{CallLedger, CallerId};
use crate::sinks::failure_key;
use crate::sources::{IsTooLarge, LocalShare};
use crate::stats::Drops;

/// How long a message about a call waits for the local endpoint that is being made.
const ENDPOINT_WAIT: Duration = Duration::from_secs(10);
/// Answers kept that come before it is known what they answer.
const EARLY_MAX: usize = 64;

/// One service at this node.
#[derive(Clone)]
pub(crate) enum Calls {
    /// Others call it here.
    Served(Arc<Served>),
    /// It is called from here.
    Called(Arc<Called>),
}

impl Calls {
    /// The calls that were lost.
    pub(crate) fn ledger(&self) -> &CallLedger {
        match self {
            Self::Served(served) => &served.ledger,
            Self::Called(called) => &called.ledger,
        }
    }

    /// The service ended: what is open will not be answered.
    pub(crate) fn withdraw(&self) {
        match self {
            Self::Served(served) => {
                served.lock().answerer.withdraw();
                served.count_lost();
            }
            Self::Called(called) => {
                let mut state = called.lock();
                state.closed = true;
                state.caller.withdraw();
                drop(state);
                called.count_lost();
            }
        }
        self.ledger().add_past(self.stats());
    }

    /// What became of its calls.
    pub(crate) fn stats(&self) -> CallStats {
        match self {
            Self::Served(served) => served.lock().answerer.stats(),
            Self::Called(called) => called.lock().caller.stats(),
        }
    }

    /// Ends it: nothing waits for a local endpoint any more, and the one that is there goes.
    pub(crate) fn close(&self) -> Option<Box<dyn std::any::Any + Send>> {
        match self {
            Self::Served(served) => {
                served.lock().closed = true;
                served.ready.notify_all();
                served.set_client(None)
            }
            Self::Called(called) => {
                called.lock().closed = true;
                called.ready.notify_all();
                called.set_server(None)
            }
        }
    }
}

/// Somebody who may block when dropped.
type Old = Option<Box<dyn std::any::Any + Send>>;

struct ServedState {
    answerer: Answerer<RequestId, Guid>,
    client: Option<Arc<dyn RosClient>>,
    /// True if the client is to go once nothing is open.
    ending: bool,
    /// True while the local network is being asked: an answer may come before its id is known.
    asking: bool,
    /// Servers that went meanwhile.
    gone: BTreeSet<Guid>,
    early: Vec<(RequestId, Bytes)>,
    sinks: BTreeMap<SourceId, SinkId>,
    closed: bool,
}

/// A service of the local network that others call.
pub(crate) struct Served {
    share: Arc<LocalShare>,
    failures: Arc<Drops>,
    ledger: Arc<CallLedger>,
    state: Mutex<ServedState>,
    /// Told when there is a client, or it is closed.
    ready: Condvar,
}

impl Served {
    /// Nobody calls it yet. What is said goes out as the share's.
    pub(crate) fn new(share: Arc<LocalShare>, failures: Arc<Drops>, ledger: Arc<CallLedger>) -> Self {
        let state = ServedState {
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

    /// Who may call now.
    pub(crate) fn set_callers(&self, sinks: BTreeMap<SourceId, SinkId>) {
        self.lock().sinks = sinks;
    }

    /// What local servers are called with; the one before may block when it is dropped.
    pub(crate) fn set_client(&self, client: Option<Arc<dyn RosClient>>) -> Old {
        let mut state = self.lock();
        state.ending = false;
        let old = std::mem::replace(&mut state.client, client);
        self.ready.notify_all();
        old.map(|old| Box::new(old) as _)
    }

    /// Ends the client once nothing is open; what it is now, if nothing is.
    pub(crate) fn end_client(&self) -> Old {
        let mut state = self.lock();
        state.ending = true;
        state.take_ended()
    }

    /// True if there is a client, which goes on then: somebody calls again.
    pub(crate) fn keep_client(&self) -> bool {
        let mut state = self.lock();
        state.ending = false;
        state.client.is_some()
    }

    /// All local servers are gone.
    pub(crate) fn servers_gone(self: &Arc<Self>) {
        let lost = self.lock().answerer.servers_gone();
        self.tell_lost(lost);
    }

    /// An endpoint of the local network is gone, which may be a server's.
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

    /// Tells who called that these calls will not be answered; on a thread that may block.
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

    /// Takes what somebody elsewhere says of a call; on the thread of the service.
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

    /// Asks the local server.
    fn ask(self: &Arc<Self>, source: SourceId, number: u64, payload: Bytes) {
        let Some(client) = self.client() else { return self.lock().answerer.not_asked(source, number) };
        self.lock().asking = true;
        let asked = client.request(payload).map(|id| (id, client.servers()));
        let early = {
            let mut state = self.lock();
            state.asking = false;
            let gone = std::mem::take(&mut state.gone);
            match &asked {
                Ok((id, servers)) => {
                    let servers = servers.difference(&gone).copied().collect();
                    state.answerer.asked(source, number, *id, servers);
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

    /// The client, once it is there.
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

    /// Takes an answer of the local server; on the thread of the client.
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
            self.failures.count("reply_to_nothing");
        }
        // It cannot end on its own thread.
        if let Some(ended) = ended {
            self.share.run_blocking(move || drop(ended));
        }
    }

    fn tell(&self, source: SourceId, kind: MessageKind, number: u64, payload: Bytes) -> IsTooLarge {
        // Who is gone asks again when it is back.
        let Some(sink) = self.lock().sinks.get(&source).copied() else { return IsTooLarge::No };
        self.share.publish_call(&MessageHead::for_call(kind, number), payload, Some(sink))
    }

    fn failed(&self, why: &RosError) {
        if self.failures.count(failure_key(why)) {
            warn!(%why, "a call could not be given to a local server; counted from here on");
        }
    }

    fn lock(&self) -> MutexGuard<'_, ServedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl ServedState {
    fn take_ended(&mut self) -> Old {
        let ends = self.ending && self.answerer.open() == 0 && !self.asking;
        let client = if ends { self.client.take() } else { None };
        client.map(|client| Box::new(client) as _)
    }
}

/// Takes the replies of local servers.
pub(crate) struct Answers(pub(crate) Arc<Served>);

impl HandleCalls for Answers {
    fn handle(&mut self, id: RequestId, payload: Bytes) {
        self.0.answer(id, payload);
    }

    fn unhandled(&mut self, why: UnhandledCall, messages: u64) {
        count_unhandled(&self.0.share, &self.0.ledger, why, messages);
    }
}

/// Takes the requests of local clients.
pub(crate) struct Requests(pub(crate) Arc<Called>);

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
            share.count_overrun(messages);
            ledger.count(CallLoss::Overrun, None, messages);
        }
        UnhandledCall::Unreadable => ledger.count(CallLoss::Unreadable, None, messages),
    }
}

struct CalledState {
    caller: Caller<RequestId>,
    server: Option<Arc<dyn RosServer>>,
    sink: Option<SinkId>,
    closed: bool,
}

/// A service of another node that local clients call.
pub(crate) struct Called {
    share: Arc<LocalShare>,
    failures: Arc<Drops>,
    ledger: Arc<CallLedger>,
    state: Mutex<CalledState>,
    /// Told when there is a server, or it is closed.
    ready: Condvar,
    /// Wakes the control task, which asks what became of calls.
    wake: Arc<Notify>,
}

impl Called {
    /// No call yet. What is asked goes out as the share's.
    pub(crate) fn new(
        share: Arc<LocalShare>,
        failures: Arc<Drops>,
        ledger: Arc<CallLedger>,
        wake: Arc<Notify>,
    ) -> Self {
        let caller = Caller::new(CallLimits::default());
        let state = CalledState { caller, server: None, sink: None, closed: false };
        Self { share, failures, ledger, state: Mutex::new(state), ready: Condvar::new(), wake }
    }

    /// What local clients call; the one before may block when it is dropped.
    pub(crate) fn set_server(&self, server: Option<Arc<dyn RosServer>>) -> Old {
        let old = std::mem::replace(&mut self.lock().server, server);
        self.ready.notify_all();
        old.map(|old| Box::new(old) as _)
    }

    /// Takes a call of a local client; on the thread of the server.
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
            Err(why) => debug!(%why, "a call is not taken"),
        }
    }

    /// The owner granted it, as this sink; `anew` if it knows nothing of what was before.
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

    /// The way to the owner is lost for now.
    pub(crate) fn lost(&self) {
        let mut state = self.lock();
        state.sink = None;
        state.caller.lost();
    }

    /// A local endpoint is gone: its calls are over if it was a client.
    pub(crate) fn endpoint_gone(self: &Arc<Self>, guid: &Guid) {
        let over = self.lock().caller.client_gone(|id| id.asker == Some(*guid));
        self.count_lost();
        self.publish_elsewhere(MessageKind::Forget, over.into_iter().map(|n| (n, Bytes::new())).collect());
    }

    /// Asks what became of the calls that have been quiet for long.
    pub(crate) fn ask_due(self: &Arc<Self>, now: Instant) {
        let due = self.lock().caller.ask_due(now);
        self.publish_elsewhere(MessageKind::Ask, due.into_iter().map(|n| (n, Bytes::new())).collect());
    }

    /// When to do so.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.lock().caller.deadline()
    }

    /// Takes what the owner says of a call; on the thread of the service.
    pub(crate) fn take(&self, message: Message) {
        let (kind, number) = (message.head.kind, message.head.call());
        // Without anybody to give it to an answer waits where it is.
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
                        self.failures.count(failure_key(&why));
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

    /// The server, once it is there.
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

    /// The same for several, on a thread that may block.
    fn publish_elsewhere(self: &Arc<Self>, kind: MessageKind, calls: Vec<(u64, Bytes)>) {
        if calls.is_empty() {
            return;
        }
        let this = self.clone();
        self.share.run_blocking(move || {
            calls.into_iter().for_each(|(number, payload)| this.publish(kind, number, payload));
        });
    }

    fn lock(&self) -> MutexGuard<'_, CalledState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
