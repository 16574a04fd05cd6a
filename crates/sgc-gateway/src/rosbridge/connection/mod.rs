//! [`Connection`]: the state of one client, which hands each op to the part that executes it.
//!
//! The parts own what a client has: [`Subscriptions`], [`Publications`], [`Servings`] and [`Jobs`]. JSON is read by
//! `op`.

mod context;
mod error_budget;
mod jobs;
mod publications;
mod servings;
mod subscriptions;

use std::borrow::Cow;
use std::sync::Arc;

use sgc_websocket::WebSocketError;
use tokio::sync::watch;
use tokio::time::Instant;

use super::actions::refuse_goal;
use super::calls::refuse_call;
use super::fragments::Fragments;
use super::op::{
    AwaitedReply, ClientMessage, Fragment, InvalidOp, MessagePlace, Op, OpError, OpId, OpName, Refusal, told,
};
use super::options::{RosbridgeError, RosbridgeOptions};
use super::outbox::{ConnectionClosed, Level, Outbox};
use super::rosapi::local_name;
use crate::access::Right;
use crate::error::GatewayError;
use crate::offload::offload_if_long;
use crate::session::{Session, action_of};
use context::Context;
use error_budget::ErrorBudget;
use jobs::Jobs;
use publications::Publications;
use servings::Servings;
use subscriptions::Subscriptions;

/// The error text for a message whose fragments are late.
const PIECES_LATE: &str = "pieces of the message did not come in time, and it is given up";
/// Most individual reports about interfaces that a client lost by a change of its credential.
const ENDED_SHOWN_MAX: usize = 16;

/// The state of one client.
pub(super) struct Connection {
    context: Context,
    /// The current session of the client.
    sessions: watch::Sender<Arc<Session>>,
    is_admitted: bool,
    subscriptions: Subscriptions,
    publications: Publications,
    servings: Servings,
    jobs: Jobs,
    fragments: Fragments,
    errors: ErrorBudget,
}

/// The failure of an op.
enum Failure<'a> {
    /// The op is refused, and the connection continues.
    Refused(Refusal),
    /// The op is refused, and the client waits for its reply.
    Unanswered(Refusal, AwaitedReply<'a>),
    /// The connection ends.
    End(RosbridgeError),
}

impl From<Refusal> for Failure<'_> {
    fn from(why: Refusal) -> Self {
        Self::Refused(why)
    }
}

impl From<ConnectionClosed> for Failure<'_> {
    fn from(closed: ConnectionClosed) -> Self {
        Self::End(closed.into())
    }
}

impl From<ConnectionClosed> for RosbridgeError {
    fn from(_: ConnectionClosed) -> Self {
        Self::Socket(WebSocketError::Closed)
    }
}

impl Connection {
    pub(super) fn new(session: Arc<Session>, options: Arc<RosbridgeOptions>, outbox: Outbox) -> Self {
        Self {
            sessions: watch::Sender::new(Arc::clone(&session)),
            is_admitted: !options.is_token_needed,
            fragments: Fragments::new(options.message_bytes_max),
            context: Context { session, options, outbox },
            subscriptions: Subscriptions::default(),
            publications: Publications::default(),
            servings: Servings::default(),
            jobs: Jobs::default(),
            errors: ErrorBudget::new(),
        }
    }

    pub(super) fn is_admitted(&self) -> bool {
        self.is_admitted
    }

    /// Returns a watch of the client's session, which changes with each `auth`.
    pub(super) fn sessions(&self) -> watch::Receiver<Arc<Session>> {
        self.sessions.subscribe()
    }

    /// Executes a message. Only an error that ends the connection is returned.
    pub(super) async fn take(&mut self, text: &str) -> Result<(), RosbridgeError> {
        self.jobs.reap();
        let taken = self.take_message(text).await;
        self.context.session.finish_message_keeping(self.fragments.bytes());
        taken
    }

    async fn take_message(&mut self, text: &str) -> Result<(), RosbridgeError> {
        let place = if self.is_admitted { MessagePlace::Whole } else { MessagePlace::BeforeAdmission };
        match parse(text, place) {
            Ok(ClientMessage { op: Ok(Op::Fragment(fragment)), .. }) => self.take_fragment(fragment).await,
            Ok(message) => self.run(message, None).await,
            Err(error) => self.fail(&error, None).await,
        }
    }

    /// Adds a fragment, and executes its message if that is complete.
    async fn take_fragment(&mut self, fragment: Fragment) -> Result<(), RosbridgeError> {
        let Fragment { id, number, total, data } = fragment;
        let whole = match self.fragments.take(&id, number, total, data, Instant::now()) {
            Ok(Some(whole)) => whole,
            Ok(None) => return Ok(()),
            Err(error) => {
                let why = Refusal::rule(error.to_string());
                return self.fail(&OpError::Refused { op: OpName::Fragment, why }, Some(&id)).await;
            }
        };
        match parse(&whole, MessagePlace::Assembled) {
            Ok(message) => self.run(message, Some(id)).await,
            Err(error) => self.fail(&error, Some(&id)).await,
        }
    }

    /// Executes a message. `fragments_id` is the id of its fragments, which errors of a message without an id have.
    async fn run(
        &mut self,
        message: ClientMessage<'_>,
        fragments_id: Option<OpId>,
    ) -> Result<(), RosbridgeError> {
        let ClientMessage { name, id, op } = message;
        if name != OpName::Publish {
            self.flush().await?;
        }
        let (error, reply) = match op {
            Ok(op) => match self.execute(op, id.clone()).await {
                Ok(()) => return Ok(()),
                Err(Failure::End(error)) => return Err(error),
                Err(Failure::Refused(why)) => (OpError::Refused { op: name, why }, None),
                Err(Failure::Unanswered(why, reply)) => (OpError::Refused { op: name, why }, Some(reply)),
            },
            Err(InvalidOp { error, reply }) => (error, reply),
        };
        if let (Some(reply), Some(id)) = (reply, &id) {
            self.refuse(reply, id, &error).await;
        }
        self.fail(&error, id.or(fragments_id).as_ref()).await
    }

    /// Answers a call or goal that is refused, because the client waits for an answer with its id.
    async fn refuse(&self, reply: AwaitedReply<'_>, id: &OpId, error: &OpError) {
        let outbox = &self.context.outbox;
        match reply {
            AwaitedReply::Service(service) => refuse_call(id, &service, &told(error), outbox).await,
            // The result would be taken for that of the other goal.
            AwaitedReply::Action(_) if self.jobs.has_goal(id) => {}
            AwaitedReply::Action(action) => refuse_goal(id, &action, &told(error), outbox).await,
        }
    }

    /// Counts an error and reports it.
    async fn fail(&mut self, error: &OpError, id: Option<&OpId>) -> Result<(), RosbridgeError> {
        if !self.errors.count(Instant::now()) {
            return Err(RosbridgeError::TooManyErrors);
        }
        Ok(self.context.outbox.status(Level::Error, &told(error), id).await?)
    }

    /// Sends messages that were published since the last flush.
    pub(super) async fn flush(&mut self) -> Result<(), RosbridgeError> {
        while let Some(flushed) = self.publications.flush_next().await {
            // Each lost message is reported to the client.
            if let Err(why) = flushed {
                self.fail(&OpError::Refused { op: OpName::Publish, why }, None).await?;
            }
        }
        Ok(())
    }

    async fn execute<'a>(&mut self, op: Op<'a>, id: Option<OpId>) -> Result<(), Failure<'a>> {
        let (context, id_ref) = (&self.context, id.as_ref());
        match op {
            Op::Auth { token } => return self.auth(token, id).await,
            Op::SetLevel(level) => context.outbox.set_level(level),
            Op::Status => {}
            // Unreachable: `take_message` takes fragments, and `MessagePlace` refuses those within fragments.
            Op::Fragment(_) => return Err(Refusal::nested_fragment().into()),
            Op::Advertise(op) => self.publications.advertise(&context.session, id, op).await?,
            Op::Unadvertise { topic } => self.publications.unadvertise(id, &topic)?,
            Op::Publish(op) => self.publications.publish(&context.session, op).await?,
            Op::Subscribe(op) => self.subscriptions.subscribe(context, id, op).await?,
            Op::Unsubscribe { topic } => self.subscriptions.unsubscribe(id_ref, &topic)?,
            Op::AdvertiseService(op) => self.servings.advertise_service(context, op).await?,
            Op::UnadvertiseService { service } => self.servings.unadvertise_service(&service)?,
            Op::ServiceResponse(op) => self.servings.service_response(id_ref, op).await?,
            Op::AdvertiseAction(op) => self.servings.advertise_action(context, op).await?,
            Op::UnadvertiseAction { action } => self.servings.unadvertise_action(&action)?,
            Op::ActionFeedback(op) => self.servings.action_feedback(id_ref, op).await?,
            Op::ActionResult(op) => self.servings.action_result(id_ref, op).await?,
            Op::ActionStatus { action } => self.servings.action_status(id_ref, &action)?,
            Op::CallService(op) => {
                let begun = self.jobs.call(context, id, &op);
                begun.map_err(|why| Failure::Unanswered(why, AwaitedReply::Service(op.service)))?;
            }
            Op::SendActionGoal(op) => {
                let begun = self.jobs.send_goal(context, id, &op);
                begun.map_err(|why| Failure::Unanswered(why, AwaitedReply::Action(op.action)))?;
            }
            Op::CancelActionGoal => self.jobs.cancel_goal(id_ref)?,
        }
        Ok(())
    }

    async fn auth<'a>(
        &mut self,
        token: Result<Cow<'_, str>, Refusal>,
        id: Option<OpId>,
    ) -> Result<(), Failure<'a>> {
        let Context { session, options, outbox } = &mut self.context;
        let Some(authenticate) = &options.authenticate else {
            return Err(Refusal::rule("this gateway takes no tokens here").into());
        };
        let token = token?;
        let refused = |why| told(&OpError::Refused { op: OpName::Auth, why });
        let client = match authenticate(&token) {
            Ok(client) => client,
            Err(why) => {
                // A client that guesses must open a connection for each guess.
                let error = refused(Refusal::rule(why.clone()));
                outbox.status(Level::Error, &error, id.as_ref()).await?;
                return Err(Failure::End(RosbridgeError::NotAdmitted(why)));
            }
        };
        let who = format!("you are {}", client.name);
        let is_as_before = client.scope == session.client().scope;
        match session.again(client) {
            Ok(new) => *session = Arc::new(new),
            Err(why) => {
                let error = refused(why.clone().into());
                outbox.status(Level::Error, &error, id.as_ref()).await?;
                return Err(Failure::End(RosbridgeError::NoRoom(why)));
            }
        }
        self.sessions.send_replace(Arc::clone(session));
        self.is_admitted = true;
        outbox.status(Level::Info, &who, id.as_ref()).await?;
        Ok(self.end_what_is_not_permitted(is_as_before).await?)
    }

    /// Ends publications, services and other uses to which the client's new credential has no right, and reports
    /// them. Calls and goals report for themselves.
    async fn end_what_is_not_permitted(&mut self, is_as_before: bool) -> Result<(), ConnectionClosed> {
        let (Context { session, outbox, .. }, mut ended) = (&self.context, Vec::new());
        let mut may = |right, name: &str| {
            let checked = session.check(right, name);
            checked.map_err(|error| ended.push(error)).is_ok()
        };
        self.subscriptions.retain(|topic| may(Right::Subscribe, topic));
        self.publications.retain(|topic| may(Right::Publish, topic));
        self.servings.retain(|name| may(Right::Serve, name));
        self.jobs.end_where(|name| match local_name(name) {
            // The new client may see everything that the former one saw.
            Some(_) if is_as_before => None,
            Some(_) => Some(GatewayError::OtherClient { client: session.client().name.to_string() }),
            None => session.check(Right::Call, action_of(name)).err(),
        });
        for error in ended.iter().take(ENDED_SHOWN_MAX) {
            outbox.status(Level::Error, &told(&format!("auth: {error}")), None).await?;
        }
        if let Some(more) = ended.len().checked_sub(ENDED_SHOWN_MAX).filter(|more| *more > 0) {
            let told = format!("auth: {more} more that the client had ended in the same way");
            outbox.status(Level::Error, &told, None).await?;
        }
        Ok(())
    }

    /// Returns the time at which the next incomplete message is given up.
    pub(super) fn fragments_end(&self) -> Option<Instant> {
        self.fragments.next_end()
    }

    /// Gives up incomplete messages whose fragments are late, and reports them.
    pub(super) async fn give_up_fragments(&mut self) -> Result<(), RosbridgeError> {
        let before = self.fragments.bytes();
        let given_up: Vec<_> = std::iter::from_fn(|| self.fragments.give_up(Instant::now())).collect();
        self.context.session.forget_kept(before - self.fragments.bytes());
        let late = OpError::Refused { op: OpName::Fragment, why: Refusal::rule(PIECES_LATE) };
        for id in given_up {
            self.fail(&late, Some(&id)).await?;
        }
        Ok(())
    }
}

fn parse(text: &str, place: MessagePlace) -> Result<ClientMessage<'_>, OpError> {
    offload_if_long(text.len(), || ClientMessage::parse(text, place))
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;
    use std::time::Duration;

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
}
