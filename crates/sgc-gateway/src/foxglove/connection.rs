//! [`Connection`]: one client's, from what it asks for to what it is told.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use futures_util::future::BoxFuture;
use futures_util::stream::{AbortHandle, Abortable, BoxStream, FuturesUnordered, SelectAll};
use futures_util::{Stream, StreamExt, stream};
use sgc_wire::Qos;
use tokio::time::{Instant, MissedTickBehavior};
use tokio_tungstenite::tungstenite::{Error as SocketError, Message as Frame};

use crate::access::Right;
use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::feed::{Delivery, Subscription};
use crate::graph::{Graph, is_hidden};
use crate::publisher::Publication;
use crate::session::{Advertise, Session, Subscribe, action_of};
use crate::types::Types;

use super::connections::Connections;
use super::listing::{Listing, Offer};
use super::outbox::{LANE_MESSAGES_MAX, Outbox};
use super::parameters::{self, Answer, Parameters, Watched};
use super::protocol::{
    self, Channel, ClientChannel, Command, Half, Metadata, Parameter, Sent, Service, Told, Wanted,
};
use super::refusal::Refusal;
use super::{FoxgloveError, Options};

/// How messages are encoded: as ROS 2 has them, or as `docs/spec/json.md` has them; topics are always the former.
const ENCODINGS: [&str; 2] = [CDR, JSON];
const CDR: &str = "cdr";
const JSON: &str = "json";
/// How definitions are written.
const SCHEMA_ENCODING: &str = "ros2msg";
/// Encapsulation header of a serialised message, bytes (RTPS 2.5, 10.2).
const CDR_HEADER_BYTES: usize = 4;

/// How long changes of the graph are gathered.
const SETTLE: Duration = Duration::from_millis(100);
/// How often definitions are looked for anew that nobody had.
const LOOK_AGAIN: Duration = Duration::from_secs(10);
/// How often it is looked what was left out.
const REPORT: Duration = Duration::from_secs(2);
/// How long readers of what a client begins to publish may take to be matched.
const MATCH_MAX: Duration = Duration::from_millis(200);
/// Topics, and services, that a client is told of at once.
const TOLD_AT_ONCE: usize = 32;
/// Calls and questions for parameters under way; then nothing more is read.
const JOBS_MAX: usize = 512;
/// Questions for parameters under way.
const PARAMETER_JOBS_MAX: usize = 8;
/// Statuses that are remembered, so that none is said twice.
const STATUSES_MAX: usize = 1024;
/// Messages of a topic of events that may wait.
const EVENTS_MAX: usize = 256;

/// How bad a status is, as the protocol numbers it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Level {
    Warning = 1,
    Error = 2,
}

/// What a client subscribes to.
struct Heard {
    channel: u32,
    topic: String,
    end: AbortHandle,
    /// Left out before it came to the outbox.
    dropped_before: u64,
    /// Left out in all when it was looked at last.
    reported: u64,
}

/// What a client publishes.
struct Published {
    publication: Publication,
    form: Form,
}

type Deliveries = SelectAll<BoxStream<'static, (u32, Delivery)>>;

/// What nodes are asked.
enum Question {
    Get(Vec<String>),
    Set(Vec<Parameter>),
}

/// What came of work that was done beside.
enum Done {
    Called { service: u32, call: u32, encoding: String, bytes: usize, reply: Result<Bytes, Refusal> },
    Parameters { id: Option<String>, is_asked: bool, answer: Answer },
}

/// What a connection waits for.
enum Event {
    Frame(Option<Result<Frame, SocketError>>),
    Done(Done),
    Message(u32, Delivery),
    ParameterEvent(Option<Delivery>),
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
    /// How often definitions were looked for.
    attempt: u64,
    looked_at: Instant,
    is_first: bool,
    heard: BTreeMap<u32, Heard>,
    heard_channels: HashSet<u32>,
    deliveries: Deliveries,
    published: BTreeMap<u32, Published>,
    jobs: FuturesUnordered<BoxFuture<'static, Done>>,
    parameter_jobs: usize,
    /// Bytes of requests under way.
    call_bytes: usize,
    connections: Option<Connections>,
    parameters: Arc<Parameters>,
    watched: Watched,
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
            call_bytes: 0,
            connections: None,
            watched: Watched::default(),
            events: None,
            statuses: BTreeMap::new(),
        }
    }

    /// Serves until the client goes, or has to.
    pub(super) async fn run<R>(&mut self, frames: &mut R) -> Result<(), FoxgloveError>
    where
        R: Stream<Item = Result<Frame, SocketError>> + Unpin + Send,
    {
        self.greet();
        let mut graph = self.session.hub().graph_changes();
        let mut tell_at = Some(Instant::now());
        let mut ticks = tokio::time::interval(REPORT.min(self.options.ping_interval));
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut came_at, mut pinged_at) = (Instant::now(), Instant::now());
        loop {
            let has_room = self.outbox.has_room();
            let at = tell_at.unwrap_or_else(Instant::now);
            let event = tokio::select! {
                frame = frames.next(), if has_room && self.jobs.len() < JOBS_MAX => Event::Frame(frame),
                Some(done) = self.jobs.next(), if has_room => Event::Done(done),
                Some((id, delivery)) = self.deliveries.next() => Event::Message(id, delivery),
                event = next_event(&mut self.events), if has_room => Event::ParameterEvent(event),
                _ = graph.changed(), if tell_at.is_none() => Event::GraphChanged,
                () = tokio::time::sleep_until(at), if has_room && tell_at.is_some() => Event::TellGraph,
                () = self.outbox.room(), if !has_room => Event::Nothing,
                _ = ticks.tick() => Event::Tick,
            };
            match event {
                Event::Frame(frame) => {
                    came_at = Instant::now();
                    match frame {
                        None | Some(Ok(Frame::Close(_))) => return Ok(()),
                        Some(Ok(frame)) => self.frame(frame).await,
                        Some(Err(error)) => {
                            self.status(Level::Error, &error.to_string(), None);
                            return Err(error.into());
                        }
                    }
                }
                Event::Done(done) => self.done(done),
                Event::Message(id, delivery) => self.message(id, delivery),
                Event::ParameterEvent(Some(delivery)) => self.parameter_event(&delivery),
                Event::ParameterEvent(None) => self.events = None,
                Event::GraphChanged => tell_at = Some(Instant::now() + SETTLE),
                Event::TellGraph => {
                    graph.mark_unchanged();
                    tell_at = (!self.tell_graph().await).then(Instant::now);
                }
                Event::Tick => {
                    let silence = came_at.elapsed();
                    if silence >= self.options.silence_max {
                        let silence_ms = u64::try_from(silence.as_millis()).unwrap_or(u64::MAX);
                        return Err(FoxgloveError::Silent { silence_ms });
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

    fn tell(&self, told: &Told<'_>) {
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
        self.tell(&Told::ServerInfo {
            name: &self.options.name,
            capabilities: &capabilities,
            supported_encodings: &ENCODINGS,
            metadata: Metadata { ros_distro: &self.options.ros_distro },
            session_id: &self.options.session_id,
        });
    }

    /// Says something to the user. With an id it is said once, until it is another or taken back.
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
        self.tell(&Told::Status { level: level as u8, message, id: id.as_deref() });
    }

    /// Takes back what was said.
    fn remove_status(&mut self, id: &str) {
        if self.statuses.remove(id).is_some() {
            self.tell(&Told::RemoveStatus { status_ids: &[id] });
        }
    }

    async fn frame(&mut self, frame: Frame) {
        match frame {
            Frame::Text(text) => match protocol::read_text(&text) {
                Ok(command) => self.command(command).await,
                Err(error) => self.status(Level::Error, &error.to_string(), None),
            },
            Frame::Binary(bytes) => match protocol::read_binary(bytes) {
                Ok(Sent::Message { channel, payload }) => self.publish(channel, payload).await,
                Ok(Sent::Call { service, call, encoding, payload }) => {
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
                for wanted in subscriptions {
                    if let Err(error) = self.subscribe(wanted).await {
                        self.status(Level::Error, &error.to_string(), None);
                    }
                }
            }
            // A channel that went took its subscription along, and clients end it all the same.
            Command::Unsubscribe { subscription_ids } => {
                subscription_ids.into_iter().for_each(|id| self.unsubscribe(id));
            }
            Command::Advertise { channels } => {
                for channel in channels {
                    if let Err(error) = self.advertise(channel).await {
                        self.status(Level::Error, &error.to_string(), None);
                    }
                }
            }
            Command::Unadvertise { channel_ids } => {
                for id in channel_ids {
                    if self.published.remove(&id).is_none() {
                        let error = Refusal::NotAdvertised(id);
                        self.status(Level::Warning, &error.to_string(), None);
                    }
                }
            }
            Command::GetParameters { parameter_names, id } => {
                self.ask_parameters(id, true, Question::Get(parameter_names));
            }
            Command::SetParameters { parameters: wanted, id } => {
                let is_asked = id.is_some();
                self.ask_parameters(id, is_asked, Question::Set(wanted));
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
            Command::SubscribeConnectionGraph => {
                self.connections = Some(Connections::default());
                self.tell_connections(&self.session.graph());
            }
            Command::UnsubscribeConnectionGraph => self.connections = None,
            Command::FetchAsset { uri, request_id } => {
                let why = format!("{uri} is not sent: this server has no assets");
                self.outbox.answer(Frame::Binary(protocol::asset_refusal(request_id, &why)));
            }
        }
    }

    async fn subscribe(&mut self, wanted: Wanted) -> Result<(), Refusal> {
        let Wanted { id, channel_id } = wanted;
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
        let heard = Heard { channel: channel_id, topic, end, dropped_before: 0, reported: 0 };
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

    /// Tells of topics whose messages were left out lately, and takes it back where none were.
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
        let form = form(&encoding).ok_or(Refusal::Encoding(encoding))?;
        let topic = if topic.starts_with('/') { topic } else { format!("/{topic}") };
        let wanted = Advertise { topic, type_name: Some(schema_name), qos: Qos::default() };
        let publication = self.session.advertise(wanted).await?;
        publication.settle(MATCH_MAX).await;
        self.published.insert(id, Published { publication, form });
        Ok(())
    }

    async fn publish(&mut self, channel: u32, payload: Bytes) {
        let id = format!("publish:{channel}");
        let result = match self.published.get(&channel) {
            None => Err(Refusal::NotAdvertised(channel)),
            Some(Published { form: Form::Cdr, .. }) if payload.len() < CDR_HEADER_BYTES => {
                Err(Refusal::NotSerialised(payload.len()))
            }
            Some(Published { publication, form }) => {
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
        let bytes_max = self.session.limits().waiting_bytes_max;
        let wanted = match (self.services.get(service), form(&encoding)) {
            (None, _) => Err(Refusal::Service(service)),
            (_, None) => Err(Refusal::Encoding(encoding.clone())),
            (_, Some(Form::Cdr)) if bytes < CDR_HEADER_BYTES => Err(Refusal::NotSerialised(bytes)),
            (Some(_), _) if self.call_bytes > 0 && self.call_bytes + bytes > bytes_max => {
                Err(GatewayError::TooMany { what: "bytes of requests under way", max: bytes_max }.into())
            }
            (Some((name, type_name)), Some(form)) => Ok((name.to_owned(), type_name.to_owned(), form)),
        };
        let (name, type_name, form) = match wanted {
            Ok(wanted) => wanted,
            Err(error) => return self.call_failed(service, call, &error),
        };
        self.call_bytes += bytes;
        let (session, max) = (Arc::clone(&self.session), self.options.call_max);
        self.jobs.push(Box::pin(async move {
            let request = Content { form, bytes: payload };
            let reply = session.call(&name, Some(&type_name), &request, form, max).await;
            let reply = reply.map_err(Refusal::Gateway);
            Done::Called { service, call, encoding, bytes, reply }
        }));
    }

    fn call_failed(&self, service_id: u32, call_id: u32, error: &Refusal) {
        self.tell(&Told::ServiceCallFailure { service_id, call_id, message: &error.to_string() });
    }

    fn ask_parameters(&mut self, id: Option<String>, is_asked: bool, question: Question) {
        let under_way = self.parameter_jobs;
        let bounded = self.session.check_count("questions for parameters", under_way, PARAMETER_JOBS_MAX);
        if let Err(error) = bounded {
            return self.status(Level::Error, &error.to_string(), None);
        }
        self.parameter_jobs += 1;
        let parameters = Arc::clone(&self.parameters);
        self.jobs.push(Box::pin(async move {
            let answer = match question {
                Question::Get(names) => parameters.get(&names).await,
                Question::Set(wanted) => parameters.set(wanted).await,
            };
            Done::Parameters { id, is_asked, answer }
        }));
    }

    fn done(&mut self, done: Done) {
        match done {
            Done::Called { service, call, encoding, bytes, reply } => {
                self.call_bytes -= bytes;
                match reply {
                    Ok(reply) => {
                        let response = protocol::service_call_response(service, call, &encoding, &reply);
                        self.outbox.answer(Frame::Binary(response));
                    }
                    Err(error) => self.call_failed(service, call, &error),
                }
            }
            Done::Parameters { id, is_asked, answer } => {
                self.parameter_jobs -= 1;
                for node in &answer.answered {
                    self.remove_status(&parameters_id(node));
                }
                for (what, why) in &answer.failed {
                    let message = format!("parameters of {what}: {why}");
                    self.status(Level::Warning, &message, Some(parameters_id(what)));
                }
                if is_asked {
                    self.tell(&Told::ParameterValues { parameters: &answer.parameters, id: id.as_deref() });
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
            // Who may ask a node may hear of it, whatever topics it has: what others changed is left out.
            self.events = Some(self.session.subscribe_checked(wanted).await?);
        }
        Ok(())
    }

    fn parameter_event(&mut self, delivery: &Delivery) {
        let event = self.events.as_ref().map(|events| events.write(&delivery.message, Form::Json));
        if let Some(Ok(event)) = event {
            let parameters = self.parameters.of_event(&event, &self.watched);
            if !parameters.is_empty() {
                self.tell(&Told::ParameterValues { parameters: &parameters, id: None });
            }
        }
    }

    fn is_shown(&self, name: &str) -> bool {
        self.options.shows_hidden || !is_hidden(name)
    }

    fn tell_connections(&mut self, graph: &Graph) {
        let shows_hidden = self.options.shows_hidden;
        let Some(connections) = &mut self.connections else { return };
        if let Some(update) = connections.update(graph, |name| shows_hidden || !is_hidden(name)) {
            self.outbox.answer(Frame::text(update));
        }
    }

    /// Topics and services that the client may use.
    fn offers(&self, graph: &Graph) -> (BTreeMap<String, Offer>, BTreeMap<String, Offer>) {
        let may = |right, name: &str| self.session.check(right, name).is_ok();
        let mut topics = BTreeMap::new();
        for (name, info) in graph.topics.iter().filter(|(name, _)| self.is_shown(name)) {
            // A reader of the gateway's own is there for those who subscribe, and makes no topic.
            let is_there = !info.publishers.is_empty() || info.subscribers.iter().any(|end| !end.is_own);
            if let Some(type_name) = info.type_name().filter(|_| is_there && may(Right::Subscribe, name)) {
                let hash = info.type_hash(type_name).map(str::to_owned);
                topics.insert(name.clone(), Offer { type_name: type_name.to_owned(), hash });
            }
        }
        let mut services = BTreeMap::new();
        for (name, info) in graph.services.iter().filter(|(name, _)| self.is_shown(name)) {
            if !info.servers.is_empty() && may(Right::Call, action_of(name)) {
                services.insert(name.clone(), Offer { type_name: info.type_name.clone(), hash: None });
            }
        }
        (topics, services)
    }

    /// Tells what has changed of the graph, a part at a time; false while there is more.
    async fn tell_graph(&mut self) -> bool {
        let graph = self.session.graph();
        self.tell_connections(&graph);
        let (topics, services) = self.offers(&graph);
        let gone = self.channels.retain(&topics);
        let heard = self.heard.iter().filter(|(_, heard)| gone.contains(&heard.channel));
        let heard: Vec<u32> = heard.map(|(id, _)| *id).collect();
        heard.into_iter().for_each(|id| self.unsubscribe(id));
        if !gone.is_empty() {
            self.tell(&Told::Unadvertise { channel_ids: &gone });
        }
        let gone = self.services.retain(&services);
        if !gone.is_empty() {
            self.tell(&Told::UnadvertiseServices { service_ids: &gone });
        }
        let topics = self.channels.untold(&topics, self.attempt, TOLD_AT_ONCE);
        let services = self.services.untold(&services, self.attempt, TOLD_AT_ONCE);
        let is_all = topics.len() < TOLD_AT_ONCE && services.len() < TOLD_AT_ONCE;
        if topics.is_empty() && services.is_empty() && !self.is_first {
            return is_all;
        }
        let hub = self.session.hub();
        let described = hub.shared.run(move |shared| {
            let topics = topics.into_iter().map(|(name, offer)| {
                let schema = schema(&shared.types, &offer.type_name, offer.hash.as_deref());
                (name, offer, schema)
            });
            let services = services.into_iter().map(|(name, offer)| {
                let half = |half: &str| schema(&shared.types, &format!("{}_{half}", offer.type_name), None);
                let schemas = half("Request").and_then(|request| Ok((request, half("Response")?)));
                (name, offer, schemas)
            });
            Ok((topics.collect::<Vec<_>>(), services.collect::<Vec<_>>()))
        });
        let Ok((topics, services)) = described.await else { return true };
        self.tell_topics(topics);
        self.tell_services(services);
        is_all
    }

    fn tell_topics(&mut self, topics: Vec<(String, Offer, Result<String, GatewayError>)>) {
        let (mut channels, mut replaced) = (Vec::new(), Vec::new());
        for (topic, offer, schema) in topics {
            let schema_name = offer.type_name.clone();
            let channel = |id, topic, schema_name, schema| Channel {
                id,
                topic,
                encoding: CDR,
                schema_name,
                schema,
                schema_encoding: SCHEMA_ENCODING,
            };
            match schema {
                Ok(schema) => {
                    let (id, old) = self.channels.tell(&topic, offer);
                    replaced.extend(old);
                    self.known(&schema_name);
                    channels.push(channel(id, topic, schema_name, schema));
                }
                Err(error) => {
                    // It is shown as there; that it cannot be subscribed to is said, and why.
                    let id = self.channels.tell_unknown(&topic, offer, self.attempt, true);
                    self.unknown(&schema_name, &error);
                    channels.extend(id.map(|id| channel(id, topic, schema_name, String::new())));
                }
            }
        }
        if !replaced.is_empty() {
            self.tell(&Told::Unadvertise { channel_ids: &replaced });
        }
        if !channels.is_empty() || self.is_first {
            self.is_first = false;
            self.tell(&Told::Advertise { channels: &channels });
        }
    }

    fn tell_services(&mut self, services: Vec<(String, Offer, Result<(String, String), GatewayError>)>) {
        let mut told = Vec::new();
        for (name, offer, schemas) in services {
            let type_name = offer.type_name.clone();
            match schemas {
                Ok((request, response)) => {
                    let half = |half: &str, schema| Half {
                        encoding: CDR,
                        schema_name: format!("{type_name}_{half}"),
                        schema_encoding: SCHEMA_ENCODING,
                        schema,
                    };
                    let (request, response) = (half("Request", request), half("Response", response));
                    let (id, _) = self.services.tell(&name, offer);
                    self.known(&type_name);
                    told.push(Service { id, name, type_name, request, response });
                }
                Err(error) => {
                    self.services.tell_unknown(&name, offer, self.attempt, false);
                    self.unknown(&type_name, &error);
                }
            }
        }
        if !told.is_empty() {
            self.tell(&Told::AdvertiseServices { services: &told });
        }
    }

    fn unknown(&mut self, type_name: &str, error: &GatewayError) {
        let message = format!("{type_name} cannot be shown: {error}");
        self.status(Level::Warning, &message, Some(definition_id(type_name)));
    }

    fn known(&mut self, type_name: &str) {
        if !self.channels.is_unknown(type_name) && !self.services.is_unknown(type_name) {
            self.remove_status(&definition_id(type_name));
        }
    }
}

/// The next event of a subscription, if there is one.
async fn next_event(events: &mut Option<Subscription>) -> Option<Delivery> {
    match events {
        Some(events) => events.next().await,
        None => std::future::pending().await,
    }
}

/// What messages of a type look like, as text. May read files.
fn schema(types: &Types, type_name: &str, hash: Option<&str>) -> Result<String, GatewayError> {
    Ok(types.layout(type_name, hash)?.to_ros2msg())
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

fn definition_id(type_name: &str) -> String {
    format!("definition:{type_name}")
}
