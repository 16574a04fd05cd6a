//! [`Connection`]: the state of one client, and the execution of its ops.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use sgc_websocket::WebSocketError;
use tokio::sync::{Notify, oneshot, watch};
use tokio::task::JoinSet;
use tokio::time::Instant;

use super::actions::{GoalRequest, ServedAction, pursue};
use super::calls::{Call, End, answer, refuse};
use super::envelope::Compression;
use super::fragments::Fragments;
use super::input;
use super::op::{Op, OpError, OpId, told};
use super::options::{RosbridgeError, RosbridgeOptions};
use super::outbox::{ConnectionClosed, Level, Outbox};
use super::qos::QosMember;
use super::rosapi::local_name;
use super::services::ServedService;
use super::topics::{SubscriptionRequest, Topic};
use crate::access::Right;
use crate::action::GoalStatus;
use crate::content::Content;
use crate::definitions::InterfaceType;
use crate::error::GatewayError;
use crate::offload::offload_if_long;
use crate::publisher::Publication;
use crate::quota::ByteReservation;
use crate::session::{Advertise, Session, Subscribe, action_of};

/// Time for which a new publisher waits for the readers in the graph, so that these get its first message.
const SETTLE_MAX: Duration = Duration::from_millis(500);
/// Longest wait for a reply, whatever the client asks for.
const TIMEOUT_MAX: Duration = Duration::from_secs(3600);
/// Errors that a client may make in a burst, and per second. A client beyond that is disconnected.
const ERRORS_BURST: u32 = 200;
const ERRORS_PER_SECOND: u32 = 100;
/// The error text for a message whose fragments are late.
const PIECES_LATE: &str = "pieces of the message did not come in time, and it is given up";
/// Most individual reports about interfaces that a client lost by a change of its credential.
const ENDED_SHOWN_MAX: usize = 16;

/// A topic that a client publishes.
struct ClientPublication {
    publication: Publication,
    ids: BTreeSet<Option<OpId>>,
}

/// A call or goal in progress.
struct PendingJob {
    /// The name of the service or action.
    name: String,
    end: End,
}

/// The number of errors that a client may still make.
struct ErrorBudget {
    left: u32,
    since: Instant,
}

impl ErrorBudget {
    fn new() -> Self {
        Self { left: ERRORS_BURST, since: Instant::now() }
    }

    /// Counts an error. Returns `false` if there were too many.
    fn count(&mut self, now: Instant) -> bool {
        let earned =
            now.saturating_duration_since(self.since).as_millis() * u128::from(ERRORS_PER_SECOND) / 1000;
        if earned > 0 {
            self.left =
                u32::try_from(earned).map_or(ERRORS_BURST, |n| self.left.saturating_add(n).min(ERRORS_BURST));
            self.since = now;
        }
        let may = self.left > 0;
        self.left = self.left.saturating_sub(1);
        may
    }
}

/// The state of one client.
pub(super) struct Connection {
    session: Arc<Session>,
    /// The current session of the client.
    sessions: watch::Sender<Arc<Session>>,
    options: Arc<RosbridgeOptions>,
    outbox: Outbox,
    is_admitted: bool,
    topics: BTreeMap<String, Topic>,
    publications: BTreeMap<String, ClientPublication>,
    /// Topics with unsent messages.
    unflushed: Vec<String>,
    services: BTreeMap<String, ServedService>,
    actions: BTreeMap<String, ServedAction>,
    goals: BTreeMap<OpId, Arc<Notify>>,
    /// Calls and goals in progress by number, aborted with the connection.
    tasks: JoinSet<(u64, Option<OpId>)>,
    under_way: BTreeMap<u64, PendingJob>,
    next_number: u64,
    fragments: Fragments,
    patience: ErrorBudget,
}

/// The failure of an op.
enum Failure {
    /// The error is reported to the client.
    Op(OpError),
    /// The connection ends.
    End(RosbridgeError),
}

impl From<OpError> for Failure {
    fn from(error: OpError) -> Self {
        Self::Op(error)
    }
}

impl From<ConnectionClosed> for Failure {
    fn from(_: ConnectionClosed) -> Self {
        Self::End(RosbridgeError::Socket(WebSocketError::Closed))
    }
}

type OpResult = Result<(), Failure>;

impl Connection {
    pub(super) fn new(session: Arc<Session>, options: Arc<RosbridgeOptions>, outbox: Outbox) -> Self {
        let fragments = Fragments::new(options.message_bytes_max);
        Self {
            sessions: watch::Sender::new(Arc::clone(&session)),
            session,
            is_admitted: !options.is_token_needed,
            options,
            outbox,
            topics: BTreeMap::new(),
            publications: BTreeMap::new(),
            unflushed: Vec::new(),
            services: BTreeMap::new(),
            actions: BTreeMap::new(),
            goals: BTreeMap::new(),
            tasks: JoinSet::new(),
            under_way: BTreeMap::new(),
            next_number: 0,
            fragments,
            patience: ErrorBudget::new(),
        }
    }

    pub(super) fn is_admitted(&self) -> bool {
        self.is_admitted
    }

    /// Returns a watch of the client's session, which changes with each `auth`.
    pub(super) fn sessions(&self) -> watch::Receiver<Arc<Session>> {
        self.sessions.subscribe()
    }

    /// Executes an op. Only an error that ends the connection is returned.
    pub(super) async fn take(&mut self, text: &str) -> Result<(), RosbridgeError> {
        let taken = self.take_op(text).await;
        self.session.finish_message_keeping(self.fragments.bytes());
        taken
    }

    async fn take_op(&mut self, text: &str) -> Result<(), RosbridgeError> {
        while let Some(ended) = self.tasks.try_join_next() {
            let Ok((number, goal)) = ended else { continue };
            self.under_way.remove(&number);
            if let Some(id) = goal {
                self.goals.remove(&id);
            }
        }
        let (done, id) = match offload_if_long(text.len(), || Op::parse(text)) {
            Ok(op) if op.name == "fragment" && self.is_admitted => match self.put_together(&op) {
                Ok(None) => (Ok(()), None),
                Ok(Some(whole)) => match offload_if_long(whole.len(), || Op::parse(&whole)) {
                    // An inner message without an id is answered with the id of its fragments.
                    Ok(inner) => (self.run(&inner).await, inner.id.or(op.id)),
                    Err(error) => (Err(error.into()), op.id),
                },
                Err(error) => (Err(error.into()), op.id),
            },
            Ok(op) => (self.run(&op).await, op.id),
            Err(error) => (Err(error.into()), None),
        };
        match done {
            Ok(()) => Ok(()),
            Err(Failure::End(error)) => Err(error),
            Err(Failure::Op(error)) => self.fail(&error, id.as_ref()).await,
        }
    }

    async fn fail(&mut self, error: &OpError, id: Option<&OpId>) -> Result<(), RosbridgeError> {
        if !self.patience.count(Instant::now()) {
            return Err(RosbridgeError::TooManyErrors);
        }
        match self.outbox.status(Level::Error, &told(error), id).await {
            Ok(()) => Ok(()),
            Err(gone) => match gone.into() {
                Failure::End(error) => Err(error),
                Failure::Op(_) => Ok(()),
            },
        }
    }

    /// Sends messages that were published since the last flush.
    pub(super) async fn flush(&mut self) -> Result<(), RosbridgeError> {
        while let Some(topic) = self.unflushed.pop() {
            let Some(published) = self.publications.get(&topic) else { continue };
            let flushed = published.publication.flush().await;
            // Each lost message is reported to the client.
            if published.publication.has_ahead() {
                self.unflushed.push(topic.clone());
            }
            if let Err(error) = flushed {
                self.fail(&unpublished("publish", &topic, &error), None).await?;
            }
        }
        Ok(())
    }

    async fn run(&mut self, op: &Op<'_>) -> OpResult {
        if !self.is_admitted && op.name != "auth" {
            let how = r#"say who you are first: {"op":"auth","token":"…"}"#;
            return Err(op.refused(how).into());
        }
        if op.name != "publish"
            && let Err(error) = self.flush().await
        {
            return Err(Failure::End(error));
        }
        match op.name.as_ref() {
            "auth" => self.auth(op).await,
            "set_level" => self.set_level(op),
            "fragment" => Err(op.refused("a message in pieces is no piece itself").into()),
            "advertise" => self.advertise(op).await,
            "unadvertise" => self.unadvertise(op),
            "publish" => self.publish(op).await,
            "subscribe" => self.subscribe(op).await,
            "unsubscribe" => self.unsubscribe(op),
            "call_service" => self.call_service(op).await,
            "advertise_service" => self.advertise_service(op).await,
            "unadvertise_service" => self.unadvertise_service(op),
            "service_response" => self.service_response(op).await,
            "send_action_goal" => self.send_action_goal(op).await,
            "cancel_action_goal" => self.cancel_action_goal(op),
            "advertise_action" => self.advertise_action(op).await,
            "unadvertise_action" => self.unadvertise_action(op),
            "action_feedback" => self.action_feedback(op).await,
            "action_result" => self.action_result(op).await,
            "action_status" => self.action_status(op),
            "status" => Ok(()),
            "png" => Err(op.refused("png is not taken: send JSON").into()),
            other => Err(OpError::UnknownOp(super::op::short(other)).into()),
        }
    }

    async fn auth(&mut self, op: &Op<'_>) -> OpResult {
        let Some(authenticate) = &self.options.authenticate else {
            return Err(op.refused("this gateway takes no tokens here").into());
        };
        // Some clients know only the fields of ROS 1's `rosauth`, so a token may stand in its code field.
        let token = match op.text("token")? {
            Some(token) => token,
            None => op.text("mac")?.ok_or_else(|| op.refused("\"token\" is missing"))?,
        };
        match authenticate(&token) {
            Ok(client) => {
                let who = format!("you are {}", client.name);
                let is_as_before = client.scope == self.session.client().scope;
                let session = match self.session.again(client) {
                    Ok(session) => session,
                    Err(why) => {
                        let error = op.gateway(why.clone());
                        self.outbox.status(Level::Error, &told(&error), op.id.as_ref()).await?;
                        return Err(Failure::End(RosbridgeError::NoRoom(why)));
                    }
                };
                self.session = Arc::new(session);
                self.sessions.send_replace(Arc::clone(&self.session));
                self.is_admitted = true;
                self.outbox.status(Level::Info, &who, op.id.as_ref()).await?;
                Ok(self.end_what_is_not_permitted(is_as_before).await?)
            }
            Err(why) => {
                // A client that guesses must open a connection for each guess.
                let error = op.refused(why.clone());
                self.outbox.status(Level::Error, &told(&error), op.id.as_ref()).await?;
                Err(Failure::End(RosbridgeError::NotAdmitted(why)))
            }
        }
    }

    /// Ends publications, services and other uses to which the client's new credential has no right, and reports
    /// them. Calls and goals report for themselves.
    async fn end_what_is_not_permitted(&mut self, is_as_before: bool) -> Result<(), ConnectionClosed> {
        let (session, mut ended) = (&self.session, Vec::new());
        let mut may = |right, name: &str| {
            let checked = session.check(right, name);
            checked.map_err(|error| ended.push(error)).is_ok()
        };
        self.topics.retain(|name, _| may(Right::Subscribe, name));
        self.publications.retain(|name, _| may(Right::Publish, name));
        self.services.retain(|name, _| may(Right::Serve, action_of(name)));
        self.actions.retain(|name, _| may(Right::Serve, name));
        let why = |name: &str| match local_name(name) {
            // The new client may see everything that the former one saw.
            Some(_) if is_as_before => None,
            Some(_) => Some(GatewayError::OtherClient { client: session.client().name.to_string() }),
            None => session.check(Right::Call, action_of(name)).err(),
        };
        let over: Vec<_> =
            self.under_way.iter().filter_map(|(number, of)| Some((*number, why(&of.name)?))).collect();
        for (number, why) in over {
            if let Some(under_way) = self.under_way.remove(&number) {
                // A job that has ended no longer listens.
                let _ = under_way.end.send(why);
            }
        }
        for error in ended.iter().take(ENDED_SHOWN_MAX) {
            self.outbox.status(Level::Error, &told(&format!("auth: {error}")), None).await?;
        }
        if let Some(more) = ended.len().checked_sub(ENDED_SHOWN_MAX).filter(|more| *more > 0) {
            let told = format!("auth: {more} more that the client had ended in the same way");
            self.outbox.status(Level::Error, &told, None).await?;
        }
        Ok(())
    }

    /// Registers a call or goal. Returns its number and the receiver that tells it to end.
    fn begin(&mut self, name: &str) -> (u64, oneshot::Receiver<GatewayError>) {
        self.next_number += 1;
        let (end, ended) = oneshot::channel();
        self.under_way.insert(self.next_number, PendingJob { name: name.to_owned(), end });
        (self.next_number, ended)
    }

    fn set_level(&mut self, op: &Op<'_>) -> OpResult {
        let name = op.needed_name("level")?;
        let level = Level::from_name(&name);
        let level = level.ok_or_else(|| op.refused("\"level\" is none, error, warning or info"))?;
        self.outbox.set_level(level);
        Ok(())
    }

    /// Adds a fragment and returns the message if it is complete.
    fn put_together(&mut self, op: &Op<'_>) -> Result<Option<String>, OpError> {
        let id = op.id.as_ref().ok_or_else(|| op.refused("\"id\" is missing"))?;
        let number = op.count("num")?.ok_or_else(|| op.refused("\"num\" is missing"))?;
        let total = op.count("total")?.ok_or_else(|| op.refused("\"total\" is missing"))?;
        let data = op.needed_text("data")?;
        let taken = self.fragments.take(id, number, total, data, Instant::now());
        taken.map_err(|error| op.refused(error.to_string()))
    }

    /// Returns the time at which the next incomplete message is given up.
    pub(super) fn fragments_end(&self) -> Option<Instant> {
        self.fragments.next_end()
    }

    /// Gives up incomplete messages whose fragments are late, and reports them.
    pub(super) async fn give_up_fragments(&mut self) -> Result<(), RosbridgeError> {
        let before = self.fragments.bytes();
        let given_up: Vec<_> = std::iter::from_fn(|| self.fragments.give_up(Instant::now())).collect();
        self.session.forget_kept(before - self.fragments.bytes());
        for id in given_up {
            let late = OpError::Refused { op: "fragment".to_owned(), why: PIECES_LATE.to_owned() };
            self.fail(&late, Some(&id)).await?;
        }
        Ok(())
    }

    async fn advertise(&mut self, op: &Op<'_>) -> OpResult {
        let topic = op.needed_name("topic")?;
        let type_name = op.name("type")?;
        let said = match op.object("qos")? {
            Some(raw) => QosMember::read(raw).map_err(|why| op.refused(why))?,
            None => QosMember::default(),
        };
        let qos = said.offer(op.bool("latch")?.unwrap_or(false), op.count("queue_size")?);
        if let Some(published) = self.publications.get_mut(&topic) {
            let is_other = |full: &String| full != published.publication.type_name();
            let full = match &type_name {
                Some(name) => {
                    Some(InterfaceType::Message.full_name(name).map_err(|error| op.gateway(error))?)
                }
                None => None,
            };
            if let Some(wanted) = full.filter(is_other) {
                let actual = published.publication.type_name().to_owned();
                return Err(op.gateway(GatewayError::OtherType { name: topic, actual, wanted }).into());
            }
            if !published.ids.contains(&op.id) {
                let max = self.session.limits().publications_max;
                let checked = self.session.check_count("advertisements of a topic", published.ids.len(), max);
                checked.map_err(|error| op.gateway(error))?;
                published.ids.insert(op.id.clone());
            }
            return Ok(());
        }
        let wanted = Advertise { topic, type_name, qos };
        self.begin_publishing(op, wanted).await
    }

    async fn begin_publishing(&mut self, op: &Op<'_>, wanted: Advertise) -> OpResult {
        let max = self.session.limits().publications_max;
        let topic = wanted.topic.clone();
        let made = async {
            self.session.check_count("topics that are published", self.publications.len(), max)?;
            self.session.advertise(wanted).await
        };
        let publication = made.await.map_err(|error| op.gateway(error))?;
        publication.settle(SETTLE_MAX).await;
        // A topic published without an advertisement ends with any `unadvertise`.
        let ids = (op.name == "advertise").then(|| op.id.clone()).into_iter().collect();
        self.publications.insert(topic, ClientPublication { publication, ids });
        Ok(())
    }

    fn unadvertise(&mut self, op: &Op<'_>) -> OpResult {
        let topic = op.needed_name("topic")?;
        let Some(published) = self.publications.get_mut(&topic) else {
            let error = GatewayError::NotThere { name: topic, what: "advertised" };
            return Err(op.gateway(error).into());
        };
        match &op.id {
            Some(_) => drop(published.ids.remove(&op.id)),
            None => published.ids.clear(),
        }
        if published.ids.is_empty() {
            self.publications.remove(&topic);
        }
        Ok(())
    }

    async fn publish(&mut self, op: &Op<'_>) -> OpResult {
        let topic = op.needed_name("topic")?;
        let raw = op.needed_object("msg")?;
        if !self.publications.contains_key(&topic) {
            let qos = QosMember::default().offer(op.bool("latch")?.unwrap_or(false), None);
            let wanted = Advertise { topic: topic.clone(), type_name: op.name("type")?, qos };
            self.begin_publishing(op, wanted).await?;
        }
        let Some(published) = self.publications.get(&topic) else { return Ok(()) };
        let publication = &published.publication;
        let done = match input::message(publication.layout(), raw) {
            Ok(value) => publication.publish_value_ahead(&value).await,
            Err(error) => Err(error),
        };
        let failed = |error| unpublished(&op.shown(), &topic, &error);
        let done = done.map_err(failed);
        if !self.unflushed.contains(&topic) {
            self.unflushed.push(topic);
        }
        Ok(done?)
    }

    async fn subscribe(&mut self, op: &Op<'_>) -> OpResult {
        let topic = op.needed_name("topic")?;
        let type_name = op.name("type")?;
        let said = match op.object("qos")? {
            Some(raw) => QosMember::read(raw).map_err(|why| op.refused(why))?,
            None => QosMember::default(),
        };
        let throttle_ms = op.count("throttle_rate")?.unwrap_or(0);
        let queue_length = op.count("queue_length")?.unwrap_or(0);
        let wish = SubscriptionRequest {
            throttle: Duration::from_millis(throttle_ms as u64),
            queue_length: said.depth.map_or(queue_length, |depth| depth as usize),
            fragment_size: fragment_size(op)?,
            compression: compression(op)?,
        };
        self.topics.retain(|_, topic| topic.is_alive());
        let subscriptions: usize = self.topics.values().map(Topic::len).sum();
        let max = self.session.limits().subscriptions_max;
        let checked = self.session.check_count("subscriptions", subscriptions, max);
        checked.map_err(|error| op.gateway(error))?;
        if let Some(heard) = self.topics.get_mut(&topic) {
            let said = type_name.filter(|name| !name.is_empty() && name != "*");
            let full = said.map(|name| InterfaceType::Message.full_name(&name)).transpose();
            let full = full.map_err(|error| op.gateway(error))?;
            if let Some(wanted) = full.filter(|full| full != heard.type_name()) {
                let actual = heard.type_name().to_owned();
                return Err(op.gateway(GatewayError::OtherType { name: topic, actual, wanted }).into());
            }
            self.session.check(Right::Subscribe, &topic).map_err(|error| op.gateway(error))?;
            heard.add(op.id.clone(), wish);
            return Ok(());
        }
        let wanted = Subscribe {
            topic: topic.clone(),
            type_name,
            qos: said.request(),
            depth: Topic::depth(&wish),
            ..Subscribe::default()
        };
        let subscription = self.session.subscribe(wanted).await.map_err(|error| op.gateway(error))?;
        self.topics.insert(topic, Topic::new(subscription, op.id.clone(), wish, self.outbox.clone()));
        Ok(())
    }

    fn unsubscribe(&mut self, op: &Op<'_>) -> OpResult {
        let topic = op.needed_name("topic")?;
        let Some(heard) = self.topics.get_mut(&topic) else {
            let error = GatewayError::NotThere { name: topic, what: "subscribed to" };
            return Err(op.gateway(error).into());
        };
        if !heard.remove(op.id.as_ref()) {
            self.topics.remove(&topic);
        }
        Ok(())
    }

    /// Calls a service. A refusal is also sent as a reply, because the caller waits for one.
    async fn call_service(&mut self, op: &Op<'_>) -> OpResult {
        let begun = self.begin_call(op);
        if let (Err(error), Some(id)) = (&begun, &op.id) {
            let service = op.name("service").ok().flatten().unwrap_or_default();
            refuse(id, &service, &told(error), &self.outbox).await;
        }
        Ok(begun?)
    }

    fn begin_call(&mut self, op: &Op<'_>) -> Result<(), OpError> {
        self.check_tasks(op)?;
        let held = self.hold(op)?;
        let call = Call {
            id: op.id.clone(),
            service: op.needed_name("service")?,
            type_name: op.name("type")?,
            args: op.raw("args").map(str::to_owned),
            max: op.seconds("timeout")?.map_or(self.options.call_max, |said| said.min(TIMEOUT_MAX)),
            fragment_size: fragment_size(op)?,
            compression: match compression(op)? {
                Compression::None => Compression::None,
                // Replies have no raw form.
                Compression::Cbor | Compression::CborRaw => Compression::Cbor,
            },
        };
        let (session, options) = (Arc::clone(&self.session), Arc::clone(&self.options));
        let outbox = self.outbox.clone();
        let (number, end) = self.begin(&call.service);
        self.tasks.spawn(async move {
            answer(session, options, call, end, outbox).await;
            drop(held);
            (number, None)
        });
        Ok(())
    }

    /// Fails at the bound of calls and goals, which are tasks of their own.
    fn check_tasks(&self, op: &Op<'_>) -> Result<(), OpError> {
        let max = self.session.limits().calls_max;
        let checked = self.session.check_count("calls and goals under way", self.tasks.len(), max);
        checked.map_err(|error| op.gateway(error))
    }

    /// Reserves room for arguments, whose bytes are bounded, too.
    fn hold(&self, op: &Op<'_>) -> Result<ByteReservation, OpError> {
        let bytes = op.raw("args").map_or(0, str::len);
        self.session.hold_arguments(bytes).map_err(|error| op.gateway(error))
    }

    async fn advertise_service(&mut self, op: &Op<'_>) -> OpResult {
        let service = op.needed_name("service")?;
        let type_name = op.needed_name("type")?;
        self.check_servings(op)?;
        // A second advertisement replaces the first.
        self.services.remove(&service);
        let serving = self.session.serve(&service, Some(&type_name)).await;
        let serving = serving.map_err(|error| op.gateway(error))?;
        self.services.insert(service, ServedService::new(serving, self.outbox.clone()));
        Ok(())
    }

    fn check_servings(&self, op: &Op<'_>) -> Result<(), OpError> {
        let (now, max) = (self.services.len() + self.actions.len(), self.session.limits().servings_max);
        let checked = self.session.check_count("services and actions that are served", now, max);
        checked.map_err(|error| op.gateway(error))
    }

    fn unadvertise_service(&mut self, op: &Op<'_>) -> OpResult {
        let service = op.needed_name("service")?;
        match self.services.remove(&service) {
            Some(_) => Ok(()),
            None => {
                let error = GatewayError::NotThere { name: service, what: "served" };
                Err(op.gateway(error).into())
            }
        }
    }

    async fn service_response(&mut self, op: &Op<'_>) -> OpResult {
        let service = op.needed_name("service")?;
        let is_done = op.bool("result")?.unwrap_or(true);
        let Some(served) = self.services.get(&service) else {
            let error = GatewayError::NotThere { name: service, what: "served" };
            return Err(op.gateway(error).into());
        };
        let request = served.request(op.id.as_ref());
        let request =
            request.ok_or_else(|| op.refused(format!("{service}: no request waits under that id")))?;
        let values = op.raw("values").filter(|raw| raw.starts_with(['{', '[']));
        if !is_done && values.is_none() {
            // ROS 2 has no reply for failures, so the caller gets none.
            let why = op.raw("values").map_or_else(|| "no reason given".to_owned(), super::op::short);
            tracing::debug!(%service, %why, "a client failed to answer");
            served.answered(op.id.as_ref());
            return Ok(());
        }
        let layout = || Ok(Arc::clone(served.replier().reply_layout()));
        let values = input::arguments(values, layout).map_err(|error| op.gateway(error))?;
        let replier = served.replier();
        let reply = |content: Content| async move { replier.reply(request, &content).await };
        input::tolerate_later(&values, reply).await.map_err(|error| op.gateway(error))?;
        served.answered(op.id.as_ref());
        Ok(())
    }

    /// Sends a goal. A refusal is also sent as a result, because the client waits for one.
    async fn send_action_goal(&mut self, op: &Op<'_>) -> OpResult {
        let is_known = op.id.as_ref().is_some_and(|id| self.goals.contains_key(id));
        if is_known {
            // The result would be taken for that of the other goal.
            return Err(op.refused("a goal of that id is under way").into());
        }
        let begun = self.begin_goal(op);
        if let (Err(error), Some(_)) = (&begun, &op.id) {
            let wanted = GoalRequest {
                id: op.id.clone(),
                action: op.name("action").ok().flatten().unwrap_or_default(),
                type_name: None,
                has_feedback: false,
                fragment_size: None,
                compression: Compression::None,
            };
            wanted.fail(&told(error), &self.outbox).await;
        }
        Ok(begun?)
    }

    fn begin_goal(&mut self, op: &Op<'_>) -> Result<(), OpError> {
        self.check_tasks(op)?;
        let held = self.hold(op)?;
        let action = op.needed_name("action")?;
        let type_name = match op.name("action_type")? {
            Some(name) => Some(name),
            None => op.name("type")?,
        };
        let wanted = GoalRequest {
            id: op.id.clone(),
            action,
            type_name,
            has_feedback: op.bool("feedback")?.unwrap_or(false),
            fragment_size: fragment_size(op)?,
            compression: match compression(op)? {
                Compression::None => Compression::None,
                Compression::Cbor | Compression::CborRaw => Compression::Cbor,
            },
        };
        self.session.check(Right::Call, &wanted.action).map_err(|error| op.gateway(error))?;
        let layout = || {
            let of = self.session.action_type(&wanted.action, wanted.type_name.as_deref())?;
            self.session.hub().types().layout(&format!("{of}_Goal"), None)
        };
        let args = input::arguments(op.raw("args"), layout).map_err(|error| op.gateway(error))?;
        let cancel: Arc<Notify> = Arc::default();
        let id = op.id.clone();
        if let Some(id) = &id {
            self.goals.insert(id.clone(), Arc::clone(&cancel));
        }
        let (session, outbox) = (Arc::clone(&self.session), self.outbox.clone());
        let (number, end) = self.begin(&wanted.action);
        self.tasks.spawn(async move {
            pursue(session, wanted, (args, held), (cancel, end), outbox).await;
            (number, id)
        });
        Ok(())
    }

    fn cancel_action_goal(&mut self, op: &Op<'_>) -> OpResult {
        let goal = op.id.as_ref().and_then(|id| self.goals.get(id));
        let goal = goal.ok_or_else(|| op.refused("no goal of that id is under way"))?;
        goal.notify_one();
        Ok(())
    }

    async fn advertise_action(&mut self, op: &Op<'_>) -> OpResult {
        let action = op.needed_name("action")?;
        let type_name = op.needed_name("type")?;
        self.check_servings(op)?;
        self.session.check(Right::Serve, &action).map_err(|error| op.gateway(error))?;
        self.actions.remove(&action);
        let full = self.session.action_type(&action, Some(&type_name)).map_err(|error| op.gateway(error))?;
        let serving = self.session.serve_action(&action, Some(&full)).await;
        let serving = serving.map_err(|error| op.gateway(error))?;
        self.actions.insert(action, ServedAction::new(serving, full, self.outbox.clone()));
        Ok(())
    }

    fn unadvertise_action(&mut self, op: &Op<'_>) -> OpResult {
        let action = op.needed_name("action")?;
        match self.actions.remove(&action) {
            Some(_) => Ok(()),
            None => Err(op.gateway(GatewayError::NotThere { name: action, what: "served" }).into()),
        }
    }

    /// Returns the action of an op, which the client must serve.
    fn served_action(&self, op: &Op<'_>) -> Result<&ServedAction, OpError> {
        let action = op.needed_name("action")?;
        let served = self.actions.get(&action);
        served.ok_or_else(|| op.gateway(GatewayError::NotThere { name: action, what: "served" }))
    }

    async fn action_feedback(&mut self, op: &Op<'_>) -> OpResult {
        let served = self.served_action(op)?;
        let goal =
            served.goal(op.id.as_ref()).ok_or_else(|| op.refused("no goal of that id is under way"))?;
        let values = op.object("values")?.unwrap_or("{}");
        let (replier, goal) = (served.replier(), &goal);
        let tell = |content: Content| async move { replier.feedback(goal, &content).await };
        input::tolerate_later(values, tell).await.map_err(|error| op.gateway(error).into())
    }

    async fn action_result(&mut self, op: &Op<'_>) -> OpResult {
        let served = self.served_action(op)?;
        let goal =
            served.goal(op.id.as_ref()).ok_or_else(|| op.refused("no goal of that id is under way"))?;
        let is_done = op.bool("result")?.unwrap_or(true);
        let status = match (is_done, op.integer("status")?) {
            (true, None) => GoalStatus::Succeeded,
            (_, Some(status)) if GoalStatus::from_number(status).is_end() => GoalStatus::from_number(status),
            (false, _) => GoalStatus::Aborted,
            (true, Some(status)) => {
                return Err(op.refused(format!("status {status} is no end of a goal")).into());
            }
        };
        let values = op.raw("values").filter(|raw| raw.starts_with('{')).unwrap_or("{}");
        let (replier, goal) = (served.replier(), &goal);
        let finish = |content: Content| async move { replier.finish(goal, status, &content).await };
        input::tolerate_later(values, finish).await.map_err(|error| op.gateway(error))?;
        served.forget(op.id.as_ref());
        Ok(())
    }

    /// Checks the status that a client reports for its goal. The gateway itself reports to ROS 2.
    fn action_status(&mut self, op: &Op<'_>) -> OpResult {
        let served = self.served_action(op)?;
        served.goal(op.id.as_ref()).ok_or_else(|| op.refused("no goal of that id is under way"))?;
        Ok(())
    }
}

fn unpublished(op: &str, topic: &str, error: &GatewayError) -> OpError {
    OpError::Refused { op: op.to_owned(), why: format!("{topic}: {error}") }
}

fn compression(op: &Op<'_>) -> Result<Compression, OpError> {
    let name = op.name("compression")?.unwrap_or_default();
    Compression::from_name(&name).map_err(|why| op.refused(why))
}

/// Reads the fragment size, at least one byte.
fn fragment_size(op: &Op<'_>) -> Result<Option<usize>, OpError> {
    match op.count("fragment_size")? {
        Some(0) => Err(op.refused("\"fragment_size\" is 1 or more")),
        size => Ok(size),
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use bytes::BytesMut;
    use futures_util::{SinkExt as _, StreamExt as _};
    use sgc_testkit::FakeDomain;
    use sgc_websocket::WebSocket;
    use sgc_wire::UnixMillis;
    use tokio_tungstenite::WebSocketStream;
    use tokio_tungstenite::tungstenite::Message;
    use tokio_tungstenite::tungstenite::protocol::Role;

    use super::*;
    use crate::access::{Access, AccessRules, AdmissionRequest, Anonymous, Client};
    use crate::definitions::{ShippedDefinitions, Types};
    use crate::hub::{Hub, HubOptions};
    use crate::inflow::{Inflow, MeteredStream};
    use crate::limits::SessionLimits;
    use crate::quota::UNIT_BYTES;

    /// Returns a client of another host.
    fn remote_client() -> Client {
        let access = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
        let peer: SocketAddr = "10.0.0.1:1".parse().unwrap();
        let now = UnixMillis(1_795_000_000_000);
        let admission =
            AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now };
        access.admit(&admission).unwrap()
    }

    #[tokio::test]
    async fn pieces_that_are_never_whole_stay_within_the_quota_of_their_credential() {
        const CREDENTIAL_BYTES: usize = 512 << 20;
        const LEFT_BYTES: usize = 8 << 20;
        const PIECE_BYTES: usize = 1 << 20;
        let own = Arc::new(FakeDomain::default().join(false));
        let hub = Hub::start(own, Types::new(ShippedDefinitions), HubOptions::default()).await.unwrap();
        let client = remote_client();
        let quota = hub.shared.network.quotas.quota(&client);
        let units = |bytes: usize| u32::try_from(bytes / UNIT_BYTES).unwrap();
        let _other = quota.room_at_once(units(CREDENTIAL_BYTES - LEFT_BYTES)).unwrap();
        let piece = |number: usize| {
            let data = "x".repeat(PIECE_BYTES);
            format!(r#"{{"op":"fragment","id":"a","num":{number},"total":2,"data":"{data}"}}"#)
        };
        let mut begun = Vec::new();
        let refused = loop {
            let inflow: Arc<Inflow> = Arc::default();
            let session = Session::new(&hub, client.clone(), SessionLimits::default());
            let session = Arc::new(session.metered_by(Arc::clone(&inflow)));
            let (outbox, outgoing) = Outbox::new(1 << 20, session.quota().clone());
            let mut connection = Connection::new(session, Arc::default(), outbox);
            let text = piece(0);
            if let Err(refused) = inflow.add(text.len()) {
                break refused;
            }
            connection.take(&text).await.unwrap();
            begun.push((connection, inflow, outgoing));
            assert!(begun.len() < 100, "nothing stops it");
        };
        let is_of_credential =
            matches!(refused, GatewayError::Crowded { pool: crate::pool::Pool::Credential, .. });
        assert!(is_of_credential, "{refused}");
        assert_eq!(begun.len(), LEFT_BYTES / PIECE_BYTES);
        // A complete message returns all its room.
        let before = begun.len();
        begun.truncate(1);
        assert!(quota.room_at_once(units((before - 1) * PIECE_BYTES)).is_ok());
        let (connection, inflow, _outgoing) = begun.first_mut().unwrap();
        let text = piece(1);
        inflow.add(text.len()).unwrap();
        connection.take(&text).await.unwrap();
        assert_eq!(connection.fragments.bytes(), 0);
        assert!(quota.room_at_once(units(LEFT_BYTES)).is_ok());
    }

    #[tokio::test(start_paused = true)]
    async fn pieces_that_do_not_come_in_time_are_given_up_with_their_room() {
        const PIECE_BYTES: usize = 4 << 20;
        let own = Arc::new(FakeDomain::default().join(false));
        let hub = Hub::start(own, Types::new(ShippedDefinitions), HubOptions::default()).await.unwrap();
        let client = remote_client();
        let inflow: Arc<Inflow> = Arc::default();
        let session = Session::new(&hub, client.clone(), SessionLimits::default());
        let session = Arc::new(session.metered_by(Arc::clone(&inflow)));
        let (here, there) = tokio::io::duplex(1 << 20);
        let options = RosbridgeOptions::default();
        let there = MeteredStream::new(there, inflow);
        let there = WebSocket::new(there, BytesMut::new(), options.message_bytes_max);
        let _served = tokio::spawn(super::super::serve(there, session, options));
        let mut page = WebSocketStream::from_raw_socket(here, Role::Client, None).await;
        let piece =
            format!(r#"{{"op":"fragment","id":"a","num":0,"total":2,"data":"{}"}}"#, "x".repeat(PIECE_BYTES));
        let began = Instant::now();
        page.send(Message::text(piece)).await.unwrap();
        let free = |hub: &Hub| {
            let quota = hub.shared.network.quotas.quota(&client);
            let mut held = Vec::new();
            while let Ok(room) = quota.room_at_once(1) {
                held.push(room);
            }
            held.len() * UNIT_BYTES
        };
        // Reading also answers pings.
        let mut kept = 0;
        let told = loop {
            match page.next().await.unwrap().unwrap() {
                Message::Text(text) => break text,
                _ => kept = ((512 << 20) - free(&hub)).max(kept),
            }
        };
        assert_eq!(kept / PIECE_BYTES, 1);
        assert!(told.contains(PIECES_LATE) && told.contains(r#""id":"a""#), "{told}");
        let waited = began.elapsed();
        assert!(waited >= super::super::fragments::PIECE_WAIT_MAX, "{waited:?}");
        assert!(waited < super::super::fragments::PIECE_WAIT_MAX + Duration::from_secs(1), "{waited:?}");
        assert_eq!(free(&hub), 512 << 20);
    }

    #[tokio::test(start_paused = true)]
    async fn occasional_errors_are_forgiven() {
        let mut patience = ErrorBudget::new();
        for _ in 0..10_000 {
            assert!(patience.count(Instant::now()));
            tokio::time::advance(Duration::from_millis(11)).await;
        }
        let mut errors = 0;
        while patience.count(Instant::now()) {
            errors += 1;
        }
        assert_eq!(errors, ERRORS_BURST);
    }
}
