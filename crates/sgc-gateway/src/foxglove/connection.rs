//! [`Connection`]: one client's connection, with its subscriptions, publications and jobs.

mod catalogue;

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use futures_util::stream::{AbortHandle, Abortable, BoxStream, FuturesUnordered, SelectAll};
use futures_util::{Stream, StreamExt, stream};
use sgc_websocket::{Message as Frame, WebSocketError as SocketError};
use sgc_wire::Qos;
use tokio::time::{Instant, MissedTickBehavior};

use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::feed::{Delivery, Subscription};
use crate::keep_alive::PingState;
use crate::publisher::Publication;
use crate::session::{Advertise, Session, Subscribe};

use super::connections::Connections;
use super::listing::Listing;
use super::options::{FoxgloveError, Options};
use super::outbox::{LANE_MESSAGES_MAX, Outbox};
use super::parameters::{self, ASKED_MAX, Answer, Parameters, WatchList};
use super::protocol::{
    self, BinaryMessage, ClientChannel, Command, Metadata, Parameter, ServerMessage, SubscribeRequest,
};
use super::refusal::{Refusal, Refusals};

/// Encodings of messages and calls: that of ROS 2, and that of `docs/spec/json.md`. Topics are always sent as CDR.
const ENCODINGS: [&str; 2] = [CDR, JSON];
const CDR: &str = "cdr";
const JSON: &str = "json";
/// Length of the encapsulation header of a serialised message, in bytes (RTPS 2.5, 10.2).
const CDR_HEADER_BYTES: usize = 4;

/// Time for which graph changes are gathered.
const SETTLE: Duration = Duration::from_millis(100);
/// Pause between searches for missing type definitions.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// Pause between reports of dropped messages.
const REPORT: Duration = Duration::from_secs(2);
/// Time within which the readers of a client's new topic should be matched.
const MATCH_MAX: Duration = Duration::from_millis(200);
/// Most calls and parameter requests in progress. At the bound the connection is not read.
const JOBS_MAX: usize = 512;
/// Most parameter requests in progress.
const PARAMETER_JOBS_MAX: usize = 8;
/// Most statuses that are remembered to avoid repetition.
const STATUSES_MAX: usize = 1024;
/// Most queued parameter events.
const EVENTS_MAX: usize = 256;

/// The severity of a status, as the protocol numbers it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Level {
    Warning = 1,
    Error = 2,
}

/// A subscription of the client.
struct TopicSubscription {
    channel: u32,
    topic: String,
    end: AbortHandle,
    /// Messages dropped before they reached the outbox.
    dropped_before: u64,
    /// The number of dropped messages at the last report.
    reported: u64,
}

/// A topic that the client publishes.
struct ClientPublication {
    publication: Publication,
    form: Form,
}

type Deliveries = SelectAll<BoxStream<'static, (u32, Delivery)>>;

/// A request to nodes about their parameters.
enum ParameterRequest {
    Get(Vec<String>),
    Set(Vec<Parameter>),
}

impl ParameterRequest {
    fn names(&self) -> usize {
        match self {
            Self::Get(names) => names.len(),
            Self::Set(wanted) => wanted.len(),
        }
    }
}

/// The result of a job that ran beside the connection.
enum JobResult {
    Called { service: u32, call: u32, encoding: String, reply: Result<Bytes, Refusal> },
    Parameters { id: Option<String>, is_asked: bool, answer: Answer },
}

/// An event that the connection waits for.
enum Event {
    Frame(Option<Result<Frame, SocketError>>),
    JobDone(JobResult),
    Message(u32, Delivery),
    ParametersChanged(Option<Delivery>),
    GraphChanged,
    TellGraph,
    Tick,
    Nothing,
}

/// One client's connection.
pub(super) struct Connection<'o> {
    session: Arc<Session>,
    options: Options,
    outbox: &'o Outbox,
    channels: Listing,
    services: Listing,
    /// The number of searches for missing type definitions.
    attempt: u64,
    looked_at: Instant,
    is_first: bool,
    heard: BTreeMap<u32, TopicSubscription>,
    heard_channels: HashSet<u32>,
    deliveries: Deliveries,
    published: BTreeMap<u32, ClientPublication>,
    jobs: FuturesUnordered<BoxFuture<'static, JobResult>>,
    parameter_jobs: usize,
    connections: Option<Connections>,
    parameters: Arc<Parameters>,
    watched: WatchList,
    events: Option<Subscription>,
    statuses: BTreeMap<String, String>,
}

impl<'o> Connection<'o> {
    pub(super) fn new(session: Arc<Session>, options: Options, outbox: &'o Outbox) -> Self {
        Self {
            parameters: Arc::new(Parameters::new(Arc::clone(&session))),
            session,
            options,
            outbox,
            channels: Listing::default(),
            services: Listing::default(),
            attempt: 0,
            looked_at: Instant::now(),
            is_first: true,
            heard: BTreeMap::new(),
            heard_channels: HashSet::new(),
            deliveries: SelectAll::new(),
            published: BTreeMap::new(),
            jobs: FuturesUnordered::new(),
            parameter_jobs: 0,
            connections: None,
            watched: WatchList::default(),
            events: None,
            statuses: BTreeMap::new(),
        }
    }

    /// Serves the client until it leaves or must leave.
    pub(super) async fn run<R>(&mut self, frames: &mut R, pings: &PingState) -> Result<(), FoxgloveError>
    where
        R: Stream<Item = Result<Frame, SocketError>> + Unpin + Send,
    {
        self.greet();
        let mut graph = self.session.hub().graph_changes();
        let mut tell_at = Some(Instant::now());
        let mut ticks = tokio::time::interval(REPORT.min(self.options.ping_interval));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut pinged_at = Instant::now();
        // The time since which frames are read, while they are.
        let mut read_since = None;
        loop {
            let has_room = self.outbox.has_room();
            let is_read = has_room && self.jobs.len() < JOBS_MAX;
            read_since = is_read.then(|| read_since.unwrap_or_else(Instant::now));
            let at = tell_at.unwrap_or_else(Instant::now);
            let event = tokio::select! {
                frame = frames.next(), if is_read => Event::Frame(frame),
                Some(done) = self.jobs.next(), if has_room => Event::JobDone(done),
                Some((id, delivery)) = self.deliveries.next() => Event::Message(id, delivery),
                event = next_event(&mut self.events), if has_room => Event::ParametersChanged(event),
                _ = graph.changed(), if tell_at.is_none() => Event::GraphChanged,
                () = tokio::time::sleep_until(at), if has_room && tell_at.is_some() => Event::TellGraph,
                () = self.outbox.room(), if !has_room => Event::Nothing,
                _ = ticks.tick() => Event::Tick,
            };
            match event {
                Event::Frame(frame) => {
                    pings.heard();
                    match frame {
                        None | Some(Ok(Frame::Close(_))) => return Ok(()),
                        Some(Ok(frame)) => {
                            self.frame(frame).await;
                            self.session.finish_message();
                        }
                        Some(Err(error)) => {
                            self.status(Level::Error, &error.to_string(), None);
                            return Err(error.into());
                        }
                    }
                }
                Event::JobDone(done) => self.done(done),
                Event::Message(id, delivery) => self.message(id, delivery),
                Event::ParametersChanged(Some(delivery)) => self.parameter_event(&delivery),
                Event::ParametersChanged(None) => self.events = None,
                Event::GraphChanged => tell_at = Some(Instant::now() + SETTLE),
                Event::TellGraph => {
                    graph.mark_unchanged();
                    tell_at = (!self.tell_graph().await).then(Instant::now);
                }
                Event::Tick => {
                    // An answer that is not read is no silence. Writes have a bound of their own.
                    let silence = read_since.and_then(|since| pings.silence(self.options.silence_max, since));
                    if let Some(silence) = silence {
                        return Err(FoxgloveError::silent(silence));
                    }
                    if pinged_at.elapsed() >= self.options.ping_interval && has_room {
                        pinged_at = Instant::now();
                        self.outbox.answer(Frame::Ping(Bytes::new()));
                    }
                    self.report();
                    let has_unknown = self.channels.has_unknown() || self.services.has_unknown();
                    if has_unknown && tell_at.is_none() && self.looked_at.elapsed() >= LOOK_AGAIN {
                        tell_at = Some(Instant::now());
                    }
                }
                Event::Nothing => {}
            }
            if tell_at.is_some() && self.looked_at.elapsed() >= LOOK_AGAIN {
                self.looked_at = Instant::now();
                self.attempt += 1;
            }
        }
    }

    fn tell(&self, told: &ServerMessage<'_>) {
        self.outbox.answer(Frame::text(told.to_json()));
    }

    fn greet(&self) {
        let scope = &self.session.client().scope;
        let mut capabilities = vec!["connectionGraph"];
        if !scope.publish.is_empty() {
            capabilities.push("clientPublish");
        }
        if !scope.call.is_empty() {
            capabilities.extend(["services", "parameters", "parametersSubscribe"]);
        }
        self.tell(&ServerMessage::ServerInfo {
            name: &self.options.name,
            capabilities: &capabilities,
            supported_encodings: &ENCODINGS,
            metadata: Metadata { ros_distro: &self.options.ros_distro },
            session_id: &self.options.session_id,
        });
    }

    /// Sends a status to the user. A status with an id is sent once, until its text changes or it is removed.
    fn status(&mut self, level: Level, message: &str, id: Option<String>) {
        if let Some(id) = &id {
            if self.statuses.get(id).is_some_and(|said| said == message) {
                return;
            }
            if self.statuses.len() >= STATUSES_MAX {
                self.statuses.clear();
            }
            self.statuses.insert(id.clone(), message.to_owned());
        }
        self.tell(&ServerMessage::Status { level: level as u8, message, id: id.as_deref() });
    }

    /// Removes a status.
    fn remove_status(&mut self, id: &str) {
        if self.statuses.remove(id).is_some() {
            self.tell(&ServerMessage::RemoveStatus { status_ids: &[id] });
        }
    }

    async fn frame(&mut self, frame: Frame) {
        match frame {
            Frame::Text(text) => match protocol::read_text(&text) {
                Ok(command) => self.command(command).await,
                Err(error) => self.status(Level::Error, &error.to_string(), None),
            },
            Frame::Binary(bytes) => match protocol::read_binary(bytes) {
                Ok(BinaryMessage::Message { channel, payload }) => self.publish(channel, payload).await,
                Ok(BinaryMessage::Call { service, call, encoding, payload }) => {
                    self.call(service, call, encoding, payload);
                }
                Err(error) => self.status(Level::Error, &error.to_string(), None),
            },
            _ => {}
        }
    }

    async fn command(&mut self, command: Command) {
        match command {
            Command::Subscribe { subscriptions } => {
                let mut refused = Refusals::default();
                for wanted in subscriptions {
                    refused.note(self.subscribe(wanted).await);
                }
                self.refused(&refused);
            }
            // Clients also end subscriptions whose channel is gone, so a missing subscription is no error.
            Command::Unsubscribe { subscription_ids } => {
                subscription_ids.into_iter().for_each(|id| self.unsubscribe(id));
            }
            Command::Advertise { channels } => {
                let mut refused = Refusals::default();
                for channel in channels {
                    refused.note(self.advertise(channel).await);
                }
                self.refused(&refused);
            }
            Command::Unadvertise { channel_ids } => {
                let mut refused = Refusals::default();
                for id in channel_ids {
                    let removed = self.published.remove(&id).map(drop);
                    refused.note(removed.ok_or(Refusal::NotAdvertised(id)));
                }
                self.refused(&refused);
            }
            Command::GetParameters { parameter_names, id } => {
                self.ask_parameters(id, true, ParameterRequest::Get(parameter_names));
            }
            Command::SetParameters { parameters: wanted, id } => {
                let is_asked = id.is_some();
                self.ask_parameters(id, is_asked, ParameterRequest::Set(wanted));
            }
            Command::SubscribeParameterUpdates { parameter_names } => {
                if let Err(error) = self.watch(parameter_names).await {
                    self.status(Level::Error, &error.to_string(), None);
                }
            }
            Command::UnsubscribeParameterUpdates { parameter_names } => {
                self.watched.remove(&parameter_names);
                if self.watched.is_empty() {
                    self.events = None;
                }
            }
            Command::SubscribeConnectionGraph => self.begin_connections(),
            Command::UnsubscribeConnectionGraph => self.connections = None,
            Command::FetchAsset { uri, request_id } => {
                let why = format!("{uri} is not sent: this server has no assets");
                self.outbox.answer(Frame::Binary(protocol::asset_refusal(request_id, &why)));
            }
        }
    }

    /// Reports the refusals of a command.
    fn refused(&mut self, refused: &Refusals) {
        for refusal in &refused.shown {
            self.status(Level::Error, &refusal.to_string(), None);
        }
        if refused.more > 0 {
            self.status(Level::Error, &format!("so were {} more of the same command", refused.more), None);
        }
    }

    async fn subscribe(&mut self, wanted: SubscribeRequest) -> Result<(), Refusal> {
        let SubscribeRequest { id, channel_id } = wanted;
        if self.heard.contains_key(&id) {
            return Err(Refusal::SubscriptionTwice(id));
        }
        let Some((topic, type_name)) = self.channels.get(channel_id) else {
            return Err(Refusal::Channel(channel_id));
        };
        if self.heard_channels.contains(&channel_id) {
            return Err(GatewayError::Twice { name: topic.to_owned(), what: "subscribed to" }.into());
        }
        self.session.check_count(
            "subscriptions",
            self.heard.len(),
            self.session.limits().subscriptions_max,
        )?;
        let topic = topic.to_owned();
        let wanted = Subscribe {
            topic: topic.clone(),
            type_name: Some(type_name.to_owned()),
            depth: LANE_MESSAGES_MAX,
            ..Subscribe::default()
        };
        let subscription = self.session.subscribe(wanted).await?;
        let messages = stream::unfold(subscription, move |mut subscription| async move {
            let delivery = subscription.next().await?;
            Some(((id, delivery), subscription))
        });
        let (end, registration) = AbortHandle::new_pair();
        self.deliveries.push(Abortable::new(messages, registration).boxed());
        self.heard_channels.insert(channel_id);
        let heard = TopicSubscription { channel: channel_id, topic, end, dropped_before: 0, reported: 0 };
        self.heard.insert(id, heard);
        Ok(())
    }

    fn unsubscribe(&mut self, id: u32) {
        if let Some(heard) = self.heard.remove(&id) {
            heard.end.abort();
            self.heard_channels.remove(&heard.channel);
            self.outbox.forget(id);
            self.remove_status(&dropped_id(&heard.topic));
        }
    }

    fn message(&mut self, id: u32, delivery: Delivery) {
        if let Some(heard) = self.heard.get_mut(&id) {
            heard.dropped_before = delivery.dropped;
            self.outbox.message(id, delivery.message);
        }
    }

    /// Reports topics that lost messages lately, and removes the report for others.
    fn report(&mut self) {
        let mut said = Vec::new();
        for (id, heard) in &mut self.heard {
            let dropped = heard.dropped_before + self.outbox.dropped(*id);
            let lately = dropped - heard.reported;
            heard.reported = dropped;
            if lately > 0 {
                let client = &self.session.client().name;
                tracing::debug!(%client, topic = %heard.topic, lately, "messages were left out for a slow client");
            }
            said.push((heard.topic.clone(), lately > 0));
        }
        for (topic, is_slow) in said {
            let id = dropped_id(&topic);
            if is_slow {
                let message =
                    format!("{topic}: messages are left out, since more come than this client takes");
                self.status(Level::Warning, &message, Some(id));
            } else {
                self.remove_status(&id);
            }
        }
    }

    async fn advertise(&mut self, channel: ClientChannel) -> Result<(), Refusal> {
        let ClientChannel { id, topic, encoding, schema_name } = channel;
        if self.published.contains_key(&id) {
            return Err(Refusal::AdvertisedTwice(id));
        }
        let publications_max = self.session.limits().publications_max;
        self.session.check_count("publications", self.published.len(), publications_max)?;
        let form = form(&encoding).ok_or_else(|| Refusal::encoding(&encoding))?;
        let topic = if topic.starts_with('/') { topic } else { format!("/{topic}") };
        let wanted = Advertise { topic, type_name: Some(schema_name), qos: Qos::default() };
        let publication = self.session.advertise(wanted).await?;
        publication.settle(MATCH_MAX).await;
        self.published.insert(id, ClientPublication { publication, form });
        Ok(())
    }

    async fn publish(&mut self, channel: u32, payload: Bytes) {
        let id = format!("publish:{channel}");
        let result = match self.published.get(&channel) {
            None => Err(Refusal::NotAdvertised(channel)),
            Some(ClientPublication { form: Form::Cdr, .. }) if payload.len() < CDR_HEADER_BYTES => {
                Err(Refusal::NotSerialised(payload.len()))
            }
            Some(ClientPublication { publication, form }) => {
                let content = Content { form: *form, bytes: payload };
                publication.publish(&content).await.map_err(Refusal::Gateway)
            }
        };
        match result {
            Ok(()) => self.remove_status(&id),
            Err(error) => self.status(Level::Error, &error.to_string(), Some(id)),
        }
    }

    fn call(&mut self, service: u32, call: u32, encoding: String, payload: Bytes) {
        let bytes = payload.len();
        let wanted = match (self.services.get(service), form(&encoding)) {
            (None, _) => Err(Refusal::Service(service)),
            (_, None) => Err(Refusal::encoding(&encoding)),
            (_, Some(Form::Cdr)) if bytes < CDR_HEADER_BYTES => Err(Refusal::NotSerialised(bytes)),
            (Some((name, type_name)), Some(form)) => {
                let held = self.session.hold_arguments(bytes).map_err(Refusal::Gateway);
                held.map(|held| (name.to_owned(), type_name.to_owned(), form, held))
            }
        };
        let (name, type_name, form, held) = match wanted {
            Ok(wanted) => wanted,
            Err(error) => return self.call_failed(service, call, &error),
        };
        let (session, max) = (Arc::clone(&self.session), self.options.call_max);
        self.jobs.push(Box::pin(async move {
            let request = Content { form, bytes: payload };
            let reply = session.call(&name, Some(&type_name), &request, form, max).await;
            let reply = reply.map_err(Refusal::Gateway);
            drop(held);
            JobResult::Called { service, call, encoding, reply }
        }));
    }

    fn call_failed(&self, service_id: u32, call_id: u32, error: &Refusal) {
        self.tell(&ServerMessage::ServiceCallFailure { service_id, call_id, message: &error.to_string() });
    }

    fn ask_parameters(&mut self, id: Option<String>, is_asked: bool, question: ParameterRequest) {
        let (under_way, names) = (self.parameter_jobs, question.names());
        let session = &self.session;
        let bounded = session
            .check_count("questions for parameters", under_way, PARAMETER_JOBS_MAX)
            .and_then(|()| session.check_count("parameters in a question", names, ASKED_MAX));
        if let Err(error) = bounded {
            return self.status(Level::Error, &error.to_string(), None);
        }
        self.parameter_jobs += 1;
        let parameters = Arc::clone(&self.parameters);
        self.jobs.push(Box::pin(async move {
            let answer = match question {
                ParameterRequest::Get(names) => parameters.get(&names).await,
                ParameterRequest::Set(wanted) => parameters.set(wanted).await,
            };
            JobResult::Parameters { id, is_asked, answer }
        }));
    }

    fn done(&mut self, done: JobResult) {
        match done {
            JobResult::Called { service, call, encoding, reply } => match reply {
                Ok(reply) => {
                    let response = protocol::service_call_response(service, call, &encoding, &reply);
                    self.outbox.answer(Frame::Binary(response));
                }
                Err(error) => self.call_failed(service, call, &error),
            },
            JobResult::Parameters { id, is_asked, answer } => {
                self.parameter_jobs -= 1;
                for node in &answer.answered {
                    self.remove_status(&parameters_id(node));
                }
                for (what, why) in &answer.failed.shown {
                    let message = format!("parameters of {what}: {why}");
                    self.status(Level::Warning, &message, Some(parameters_id(what)));
                }
                if answer.failed.more > 0 {
                    let message = format!("{} more of the same question failed", answer.failed.more);
                    self.status(Level::Warning, &message, None);
                }
                if is_asked {
                    self.tell(&ServerMessage::ParameterValues {
                        parameters: &answer.parameters,
                        id: id.as_deref(),
                    });
                }
            }
        }
    }

    async fn watch(&mut self, names: Vec<String>) -> Result<(), GatewayError> {
        self.watched.add(names)?;
        if self.events.is_none() {
            let (topic, type_name) = parameters::EVENTS;
            let wanted = Subscribe {
                topic: topic.to_owned(),
                type_name: Some(type_name.to_owned()),
                depth: EVENTS_MAX,
                ..Subscribe::default()
            };
            // A client that may ask a node may get its events from any topic. Events of other nodes are filtered out.
            self.events = Some(self.session.subscribe_checked(wanted).await?);
        }
        Ok(())
    }

    fn parameter_event(&mut self, delivery: &Delivery) {
        let event = self.events.as_ref().map(|events| events.write(&delivery.message, Form::Json));
        if let Some(Ok(event)) = event {
            let parameters = self.parameters.changes_in_event(&event, &self.watched);
            if !parameters.is_empty() {
                self.tell(&ServerMessage::ParameterValues { parameters: &parameters, id: None });
            }
        }
    }
}

/// Waits for the next event of a subscription, or forever without one.
async fn next_event(events: &mut Option<Subscription>) -> Option<Delivery> {
    match events {
        Some(events) => events.next().await,
        None => std::future::pending().await,
    }
}

fn form(encoding: &str) -> Option<Form> {
    match encoding {
        CDR => Some(Form::Cdr),
        JSON => Some(Form::Json),
        _ => None,
    }
}

fn dropped_id(topic: &str) -> String {
    format!("dropped:{topic}")
}

fn parameters_id(node: &str) -> String {
    format!("parameters:{node}")
}
