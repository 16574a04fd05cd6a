//! [`Session`]: one client's use of the hub, within its scope and limits.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::Bytes;
use sgc_cdr::{Library, TypeName};
use sgc_ros::{TOPIC_BYTES_MAX, is_topic_name};
use sgc_wire::{History, Qos};

use crate::access::{Client, Denial, Right, Scope};
use crate::access_watch::AccessWatch;
use crate::content::{Content, Form, convert};
use crate::definitions::InterfaceType;
use crate::error::GatewayError;
use crate::feed::{FeedKey, LATCHED_DEPTH_MAX, Subscription, SubscriptionOptions, WaitPlace};
use crate::graph::Graph;
use crate::hub::Hub;
use crate::inflow::Inflow;
use crate::limits::{SessionLimits, WAITING_PARTS};
use crate::publisher::{Account, Publication};
use crate::queue::Overflow;
use crate::quota::{ByteReservation, Payer, PendingBytes, Quota, Resource};
use crate::service::Serving;

/// Most messages that may be queued for one subscription, whatever the client asks for.
const DEPTH_MAX: usize = 10_000;

/// A request to subscribe.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Subscribe {
    /// The ROS topic.
    pub topic: String,
    /// The ROS type, such as `std_msgs/msg/String` or `std_msgs/String`. `None` takes the type of the topic's
    /// publishers.
    pub type_name: Option<String>,
    /// The requested QoS; `None` adapts to what the publishers offer.
    pub qos: Option<Qos>,
    /// Most queued messages; 0 counts as 1.
    pub depth: usize,
    /// Shortest time between two messages.
    pub interval_min: Option<Duration>,
    /// `true` if writers on the local network wait, as far as their QoS permits, so that no message is dropped. Such
    /// a subscription has its own reader.
    pub waits: bool,
}

/// A request to publish.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Advertise {
    /// The ROS topic.
    pub topic: String,
    /// The ROS type; `None` takes the type that the topic already has.
    pub type_name: Option<String>,
    /// The offered QoS.
    pub qos: Qos,
}

/// One client's use of the hub.
#[derive(Debug)]
pub struct Session {
    hub: Hub,
    client: Client,
    /// The rules that may end the client's rights; `None` for a part of this program.
    access: Option<AccessWatch>,
    limits: SessionLimits,
    calls: Arc<AtomicUsize>,
    waiting: Arc<PendingBytes>,
    /// The bytes of messages that the client's transient-local writers keep.
    kept: Arc<PendingBytes>,
    /// The bytes of arguments of calls and goals, until these are done or sent.
    arguments: Arc<PendingBytes>,
    /// The bytes of messages that are kept for later subscribers and charged to the client.
    history: Arc<PendingBytes>,
    waits: Arc<AtomicUsize>,
    /// The quota of the client's credential.
    quota: Quota,
    /// The bytes of incoming messages that are incomplete, if the protocol counts them.
    inflow: Arc<Inflow>,
}

/// A call in progress, counted until dropped.
struct ActiveCall<'s>(&'s AtomicUsize);

impl Drop for ActiveCall<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Session {
    /// Creates the session of a client.
    pub fn new(hub: &Hub, client: Client, limits: SessionLimits) -> Self {
        let quota = hub.shared.network.quotas.quota(&client);
        let waiting = || Arc::new(PendingBytes::new(limits.waiting_bytes_max, quota.clone()));
        Self {
            hub: hub.clone(),
            client,
            access: None,
            limits,
            calls: Arc::default(),
            waiting: waiting(),
            kept: waiting(),
            arguments: waiting(),
            history: waiting(),
            waits: Arc::default(),
            quota,
            inflow: Arc::default(),
        }
    }

    /// Sets the rules that may end the client's rights.
    #[must_use]
    pub fn admitted_by(mut self, access: AccessWatch) -> Self {
        self.access = Some(access);
        self
    }

    /// Charges incoming messages to the client's quota.
    #[must_use]
    pub(crate) fn metered_by(mut self, inflow: Arc<Inflow>) -> Self {
        inflow.admit(&self.quota);
        self.inflow = inflow;
        self
    }

    /// Returns the count of incoming bytes.
    pub(crate) fn inflow(&self) -> Arc<Inflow> {
        Arc::clone(&self.inflow)
    }

    /// Releases the room of a message that was handled.
    pub(crate) fn finish_message(&self) {
        self.finish_message_keeping(0);
    }

    /// Releases the room of a message that was handled, except for `kept` bytes.
    pub(crate) fn finish_message_keeping(&self, kept: usize) {
        self.inflow.finish_keeping(kept);
    }

    /// Waits until the client's rights end and returns the reason. The caller then ends everything that the client
    /// has.
    pub async fn until_denied(&self) -> Denial {
        match &self.access {
            Some(access) => access.until_denied(&self.client).await,
            None => std::future::pending().await,
        }
    }

    /// Releases bytes that were kept after the message that carried them.
    pub(crate) fn forget_kept(&self, bytes: usize) {
        self.inflow.give_back(bytes);
    }

    /// Returns the session of the same program under another client. Everything that the session holds is charged to
    /// the new client's credential.
    ///
    /// # Errors
    /// The bound of the new credential that lacks room. Nothing has changed then.
    pub fn again(&self, client: Client) -> Result<Self, GatewayError> {
        self.quota.move_to(&client, &self.limits)?;
        let (hub, access, limits) = (self.hub.clone(), self.access.clone(), self.limits);
        let [calls, waits] = [&self.calls, &self.waits].map(Arc::clone);
        let [waiting, kept, arguments, history] =
            [&self.waiting, &self.kept, &self.arguments, &self.history].map(Arc::clone);
        let (quota, inflow) = (self.quota.clone(), Arc::clone(&self.inflow));
        Ok(Self {
            hub,
            client,
            access,
            limits,
            calls,
            waiting,
            kept,
            arguments,
            history,
            waits,
            quota,
            inflow,
        })
    }

    /// Returns the client.
    pub fn client(&self) -> &Client {
        &self.client
    }

    /// Returns the hub.
    pub fn hub(&self) -> &Hub {
        &self.hub
    }

    /// Returns the bytes queued in all subscriptions.
    pub fn waiting_bytes(&self) -> usize {
        self.waiting.bytes()
    }

    /// Reserves room for the arguments of a call or goal.
    pub(crate) fn hold_arguments(&self, bytes: usize) -> Result<ByteReservation, GatewayError> {
        ByteReservation::new(&self.arguments, "bytes of arguments that wait", bytes)
    }

    /// Returns the quota of the client's credential.
    pub(crate) fn quota(&self) -> &Quota {
        &self.quota
    }

    /// Returns the limits. Protocols check their own counts by [`Session::check_count`].
    pub fn limits(&self) -> &SessionLimits {
        &self.limits
    }

    /// Returns the part of the graph that the client has any right to.
    pub fn graph(&self) -> Graph {
        let scope = &self.client.scope;
        let any = |rights: [Right; 2], name: &str| rights.iter().any(|right| scope.permits(*right, name));
        self.hub.graph().filtered(
            |topic| {
                let action = action_of(topic);
                any([Right::Subscribe, Right::Publish], topic)
                    || (action != topic && any([Right::Call, Right::Serve], action))
            },
            |service| any([Right::Call, Right::Serve], action_of(service)),
        )
    }

    /// Fails for types outside the client's view, because they would reveal other interfaces on the network. The view
    /// has the types that ship with ROS 2, the types of topics, services and actions in the client's scope that other
    /// nodes have, and the types within these. May read files.
    pub fn check_type(&self, type_name: &str) -> Result<(), GatewayError> {
        if *self.client.scope == Scope::everything() {
            return Ok(());
        }
        let not_seen =
            || GatewayError::TypeNotSeen { name: type_name.chars().take(TOPIC_BYTES_MAX).collect() };
        let file = |name: &str| {
            let name: TypeName = name.parse().ok()?;
            TypeName::new(name.package(), name.kind(), name.file_stem())
        };
        let wanted = file(type_name).ok_or_else(not_seen)?;
        if Library::shipped(&wanted).is_some() {
            return Ok(());
        }
        let graph = self.graph();
        let own = Some(self.hub.node_name());
        let others = |nodes: &[Option<String>]| nodes.iter().any(|node| node.as_deref() != own);
        let ends = graph.topics.values().flat_map(|info| info.publishers.iter().chain(&info.subscribers));
        let of_topics = ends.filter(|end| !end.is_own).map(|end| &end.type_name);
        let services = graph.services.values().filter(|info| others(&info.servers) || others(&info.clients));
        let actions = graph.actions.values().filter(|info| others(&info.servers) || others(&info.clients));
        let seen =
            of_topics.chain(services.map(|info| &info.type_name)).chain(actions.map(|info| &info.type_name));
        let seen: BTreeSet<TypeName> = seen.filter_map(|name| file(name)).collect();
        let contains = |name: &TypeName| {
            Library::shipped(name).is_none() && self.hub.types().files_of(name).contains(&wanted)
        };
        if seen.contains(&wanted) || seen.iter().any(contains) { Ok(()) } else { Err(not_seen()) }
    }

    /// Fails if a count reaches a bound of [`SessionLimits`].
    pub fn check_count(&self, what: &'static str, now: usize, max: usize) -> Result<(), GatewayError> {
        if now >= max { Err(GatewayError::TooMany { what, max }) } else { Ok(()) }
    }

    fn check_name(&self, name: &str) -> Result<(), GatewayError> {
        if is_topic_name(name) {
            return Ok(());
        }
        // An invalid name may have any length, so it is cut.
        Err(GatewayError::Name { name: name.chars().take(TOPIC_BYTES_MAX).collect() })
    }

    /// Fails for invalid names and for interfaces outside the scope.
    pub fn check(&self, right: Right, name: &str) -> Result<(), GatewayError> {
        self.check_name(name)?;
        if !self.client.scope.permits(right, name) {
            let (client, name) = (self.client.name.to_string(), name.to_owned());
            return Err(GatewayError::Denied { client, right, name });
        }
        Ok(())
    }

    /// Returns the type of a topic: the given one if it agrees with the network, else the one on the network.
    fn topic_type(&self, topic: &str, said: Option<&str>) -> Result<String, GatewayError> {
        let graph = self.hub.graph();
        let actual = graph.topics.get(topic).and_then(|info| info.type_name());
        let Some(said) = said.filter(|said| !said.is_empty() && *said != "*") else {
            return actual
                .map(str::to_owned)
                .ok_or_else(|| GatewayError::TypeUnknown { name: topic.to_owned() });
        };
        let said = InterfaceType::Message.full_name(said)?;
        let info = graph.topics.get(topic);
        let has = |info: &crate::graph::TopicInfo| {
            info.publishers.iter().chain(&info.subscribers).any(|end| end.type_name == said)
        };
        match actual {
            Some(actual) if !info.is_some_and(has) => {
                let (name, actual) = (topic.to_owned(), actual.to_owned());
                Err(GatewayError::OtherType { name, actual, wanted: said })
            }
            _ => Ok(said),
        }
    }

    /// Returns the type of a service: the given one if it agrees with the network, else the one on the network.
    pub fn service_type(&self, service: &str, said: Option<&str>) -> Result<String, GatewayError> {
        let graph = self.hub.graph();
        let actual = graph.services.get(service).map(|info| info.type_name.clone());
        match said.filter(|said| !said.is_empty()) {
            None => actual.ok_or_else(|| GatewayError::TypeUnknown { name: service.to_owned() }),
            Some(said) => {
                let wanted = InterfaceType::Service.full_name(said)?;
                match actual {
                    Some(actual) if actual != wanted => {
                        Err(GatewayError::OtherType { name: service.to_owned(), actual, wanted })
                    }
                    _ => Ok(wanted),
                }
            }
        }
    }

    /// Subscribes to a topic.
    pub async fn subscribe(&self, wanted: Subscribe) -> Result<Subscription, GatewayError> {
        self.check(Right::Subscribe, &wanted.topic)?;
        self.subscribe_checked(wanted).await
    }

    /// Subscribes to a topic that belongs to an interface whose use was checked.
    pub(crate) async fn subscribe_checked(&self, wanted: Subscribe) -> Result<Subscription, GatewayError> {
        let type_name = self.topic_type(&wanted.topic, wanted.type_name.as_deref())?;
        let charge = self.quota.take(Resource::Subscriptions, &self.limits)?;
        let waits = if wanted.waits { Some(self.take_wait()?) } else { None };
        let key = FeedKey { topic: wanted.topic, type_name, qos: wanted.qos, waits: wanted.waits };
        let options = SubscriptionOptions {
            depth: wanted.depth.min(DEPTH_MAX),
            bytes_max: self.limits.waiting_bytes_max / WAITING_PARTS,
            waiting: Arc::clone(&self.waiting),
            interval_min: wanted.interval_min,
            overflow: if wanted.waits { Overflow::Wait } else { Overflow::DropOldest },
            waits,
            charge,
            payer: Payer::new(self.quota.clone(), self.limits, Arc::clone(&self.history)),
        };
        self.hub.shared.subscribe(key, options).await
    }

    /// Takes a place for one more subscription that holds up writers.
    fn take_wait(&self) -> Result<WaitPlace, GatewayError> {
        let charge = self.quota.take(Resource::Waits, &self.limits)?;
        let before = self.waits.fetch_add(1, Ordering::Relaxed);
        let place = WaitPlace::new(Arc::clone(&self.waits), charge);
        self.check_count("subscriptions that are waited for", before, self.limits.waits_max)?;
        Ok(place)
    }

    /// Starts to publish on a topic.
    pub async fn advertise(&self, wanted: Advertise) -> Result<Publication, GatewayError> {
        self.check(Right::Publish, &wanted.topic)?;
        self.advertise_checked(wanted).await
    }

    /// Starts to publish on a topic that belongs to an interface whose use was checked.
    pub(crate) async fn advertise_checked(&self, wanted: Advertise) -> Result<Publication, GatewayError> {
        let type_name = self.topic_type(&wanted.topic, wanted.type_name.as_deref())?;
        let charge = self.quota.take(Resource::Publications, &self.limits)?;
        let (quota, kept) = (self.quota.clone(), Some(Arc::clone(&self.kept)));
        let account = Account { quota, charge: Some(charge), kept };
        let qos = kept_within_bounds(wanted.qos);
        Publication::new(&self.hub.shared.network, wanted.topic, type_name, qos, account).await
    }

    /// Calls a service and waits for its reply, which comes in the requested form.
    pub async fn call(
        &self,
        service: &str,
        type_name: Option<&str>,
        request: &Content,
        form: Form,
        max: Duration,
    ) -> Result<Bytes, GatewayError> {
        self.check_name(service)?;
        self.check(Right::Call, action_of(service))?;
        let type_name = self.service_type(service, type_name)?;
        self.check_count("calls under way", self.calls.load(Ordering::Relaxed), self.limits.calls_max)?;
        self.calls.fetch_add(1, Ordering::Relaxed);
        let _counted = ActiveCall(&self.calls);
        let _charge = self.quota.take(Resource::Calls, &self.limits)?;
        let name = service.to_owned();
        let caller = self.hub.shared.run(move |shared| shared.caller(&name, &type_name)).await?;
        let payload = request.to_cdr(&caller.halves.request)?;
        let reply = caller.call(payload, max, &self.quota).await?;
        convert(&caller.halves.reply, &reply, form)
    }

    /// Serves a service.
    pub async fn serve(&self, service: &str, type_name: Option<&str>) -> Result<Serving, GatewayError> {
        self.check_name(service)?;
        self.check(Right::Serve, action_of(service))?;
        let type_name = self.service_type(service, type_name)?;
        let charge = self.quota.take(Resource::Servings, &self.limits)?;
        Serving::new(&self.hub.shared.network, service.to_owned(), type_name, Some(charge)).await
    }
}

/// Bounds the number of messages that a transient-local writer keeps for later readers.
fn kept_within_bounds(qos: Qos) -> Qos {
    if !qos.is_transient_local() {
        return qos;
    }
    let max = u32::try_from(LATCHED_DEPTH_MAX).unwrap_or(u32::MAX);
    let depth = match qos.history {
        History::KeepLast(depth) => depth.clamp(1, max),
        History::KeepAll => max,
    };
    Qos { history: History::KeepLast(depth), ..qos }
}

/// Returns the action that a topic or service belongs to, or the name itself.
pub(crate) fn action_of(name: &str) -> &str {
    name.split_once("/_action/").map_or(name, |(action, _)| action)
}
