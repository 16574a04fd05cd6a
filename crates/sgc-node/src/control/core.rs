//! The control task: owns the three machines, feeds them events, and carries out their outputs.
//!
//! It blocks on nothing but its inbox and its timer. Work that may block, on the local network or on a slow peer, runs
//! in other tasks and threads.

mod alerts;
mod consumers;
mod graph;
mod links;
mod operations;
mod outputs;
mod publish;
mod quality;
mod reopening;
mod ros;
mod services;
mod status;
mod trust;
mod types;

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use sgc_endpoint::{Endpoint, Output as EndpointOutput};
use sgc_ros::{EndpointSpec, RosNetwork, Routes, ServiceSpec, ShareRule, UseRule};
use sgc_router::{FibEntry, LinkId, Output as RouterOutput, Router};
use sgc_session::{KeepAlive, KeepAlivePolicy};
use sgc_transport::{AnyLink, CredentialStore};
use sgc_trust::{Identity, TrustAnchors};
use sgc_types::{Definitions, TypeStore};
use sgc_wire::{Control, Name, Now, SourceId};
use tokio::sync::{Notify, mpsc, watch};

use crate::clock::now;
use crate::control::alerts::{Alerts, clock_alert};
use crate::control::authority::Authority;
use crate::control::control_queue::Inbox;
use crate::control::event::{CoreEvent, INBOX_MAX};
use crate::control::far_consumers::FarConsumers;
use crate::control::interface_types::InterfaceTypes;
use crate::control::local_graph::LocalGraph;
use crate::control::members::{MemberNames, Members};
use crate::control::operations::Operations;
use crate::control::peer_policies::PeerPolicies;
use crate::control::peer_rate::PeerRates;
use crate::control::problem_log::ProblemLog;
use crate::control::publishing::{Offer, Publishing};
use crate::control::refusals::Refusals;
use crate::control::sink_timers::SinkTimers;
use crate::data::call_ledger::CallLedger;
use crate::data::calls::Calls;
use crate::data::dataplane::DataPlane;
use crate::data::outflow::OutFlow;
use crate::data::sending::intake::NewestSamples;
use crate::data::sending::message_keys::MessageKeys;
use crate::data::sending::replays::Replays;
use crate::data::sending::share::LocalShare;
use crate::data::sinks::{LocalSink, SinkRequest};
use crate::data::stats::{Drops, NameStats};
use crate::data::tap::TapQueue;
use crate::discovery::Board;
use crate::gateway::Gateway;
use crate::link::control_tx::ControlTx;
use crate::local::network_slot::NetworkSlot;
use crate::local::network_state::NetworkState;
use crate::state::audit::Audit;
use crate::state::credentials::StateWriter;

/// Events handled before the timers are checked again.
const BATCH_MAX: usize = 256;
/// Interval of checks for sources that may have fallen silent.
const SILENCE_LOOK: Duration = Duration::from_secs(1);
/// Bytes of history kept for late joiners of one publisher.
const HISTORY_BYTES_MAX: usize = 64 << 20;
/// Messages of history kept for a publisher that keeps all.
const HISTORY_KEEP_ALL_MAX: usize = 4096;
/// Instances for which a transient-local source of a keyed topic keeps its history, as the writers of `sgc-dds` do.
const KEYED_INSTANCES_KEPT: usize = 256;

/// A local reader for a name.
struct LocalReader {
    /// The requested endpoint.
    spec: EndpointSpec,
    /// Owner of the reader; `None` while it is being created. Dropping it closes the reader.
    opened: Option<Box<dyn std::any::Any + Send>>,
    /// Time stamps of the newest samples that it took.
    newest: Option<Arc<NewestSamples>>,
}

struct LinkEntry {
    link: AnyLink,
    url: Option<String>,
    control: ControlTx,
    flows: HashMap<Name, Arc<OutFlow>>,
    /// Reason, if this node closed it.
    closed_for: Option<String>,
    keep_alive: KeepAlive,
}

/// The control task's state. `N` is the local network; a pure router has none.
pub(crate) struct Core<N: RosNetwork> {
    identity: Arc<Identity>,
    router: Router,
    endpoint: Endpoint,
    routes: Option<Routes<ChaCha20Rng>>,
    network: NetworkSlot<N>,
    data: Arc<DataPlane>,
    inbox: Inbox,
    links: BTreeMap<LinkId, LinkEntry>,
    /// Time of the next look at the links.
    look_due: Option<Instant>,
    keep_alive_policies: PeerPolicies,
    next_link: u32,
    entries: HashMap<Name, (FibEntry, Arc<NameStats>)>,
    shares: HashMap<Name, Arc<LocalShare>>,
    readers: HashMap<Name, LocalReader>,
    sinks: HashMap<Name, Arc<LocalSink>>,
    /// Shared and joined services.
    calls: BTreeMap<Name, Calls>,
    /// Lost calls by service. They outlive the services.
    call_ledgers: BTreeMap<Name, Arc<CallLedger>>,
    /// Requested local clients and servers of the services.
    service_ends: HashMap<Name, ServiceSpec>,
    writers: HashMap<(Name, Option<SourceId>), EndpointSpec>,
    /// Far nodes that the local graph shows.
    graph: LocalGraph,
    reopening: NetworkState,
    /// Local consumers that owners are told, and far consumers that are shown here.
    consumers: FarConsumers,
    sink_timers: SinkTimers,
    /// Signing keys of this node's messages, by suite.
    message_keys: MessageKeys,
    publishing: BTreeMap<Name, Publishing>,
    /// Offers to publish on, which wait for a signing key.
    keyless: BTreeMap<Name, Offer>,
    /// Messages of one source under one key.
    epoch_messages_max: u64,
    /// Notified when a source reaches that number.
    epoch_over: Arc<Notify>,
    credentials: CredentialStore,
    gateway: Arc<Gateway>,
    /// Set if this node is the authority of its fleet.
    authority: Option<Authority>,
    /// Operations that users of this node request.
    operations: Operations,
    keeper: StateWriter,
    /// Time of the next request for renewal.
    renew_due: Option<Instant>,
    redial: watch::Sender<()>,
    replays: Arc<Replays>,
    /// Time of the next check for silent sources; `None` until one publishes.
    silence_due: Option<Instant>,
    requests: mpsc::Sender<SinkRequest>,
    control_drops: Drops,
    problem_log: ProblemLog,
    ros_failures: Arc<Drops>,
    events: mpsc::WeakSender<CoreEvent>,
    started: Instant,
    alerts: Alerts,
    /// Whether the clock is still before the start of this node's certificate.
    awaits_clock: bool,
    transport: Arc<sgc_transport::TransportMetrics>,
    alive: mpsc::Sender<()>,
    audit: Audit,
    board: Board,
    refused: Refusals,
    /// Taps of the local network.
    local_taps: Vec<Arc<TapQueue>>,
    types: InterfaceTypes,
    members: Members,
}

/// Parts from which a [`Core`] is built.
pub(crate) struct CoreParts<N> {
    /// Identity of this node.
    pub identity: Arc<Identity>,
    /// Credentials of links.
    pub credentials: CredentialStore,
    /// Gateway, whose client certificates follow this node's trust anchors.
    pub gateway: Arc<Gateway>,
    /// Rate limits of peers.
    pub(crate) rates: PeerRates,
    /// Set if this node is the authority of its fleet.
    pub authority: Option<Authority>,
    /// Messages of one source under one key.
    pub epoch_messages_max: u64,
    /// Signing keys for the suites of its shares.
    pub(crate) message_keys: MessageKeys,
    /// Writes state that outlives the process.
    pub(crate) keeper: StateWriter,
    /// Notifies the dialling tasks of a new certificate.
    pub redial: watch::Sender<()>,
    /// The routing machine.
    pub router: Router,
    /// The endpoint machine.
    pub endpoint: Endpoint,
    /// The route machine, if there is a local network.
    pub routes: Option<Routes<ChaCha20Rng>>,
    /// The local network.
    pub(crate) network: NetworkSlot<N>,
    /// Sender to its own inbox.
    pub events: mpsc::WeakSender<CoreEvent>,
    /// Clone held by every thread and blocking task while it uses the runtime.
    pub(crate) alive: mpsc::Sender<()>,
    /// Transport counters.
    pub transport: Arc<sgc_transport::TransportMetrics>,
    /// Audit log.
    pub audit: Audit,
    /// State of the searches for routers.
    pub(crate) board: Board,
    /// Keep-alive policy of new links.
    pub(crate) keep_alive_policy: KeepAlivePolicy,
    /// Store of known types.
    pub types: Arc<TypeStore>,
    /// Search paths of type definitions.
    pub definitions: Definitions,
    /// The names of members in rules.
    pub(crate) member_names: MemberNames,
}

impl<N: RosNetwork> Core<N> {
    /// Creates the control task and the inbox of its sinks.
    pub(crate) fn new(parts: CoreParts<N>) -> (Self, mpsc::Receiver<SinkRequest>) {
        let (requests, requested) = mpsc::channel(INBOX_MAX);
        let graph = LocalGraph::new(parts.identity.node_name().as_str());
        let members = Members::new(parts.member_names, &parts.identity);
        let awaits_clock = clock_alert(&parts.identity, now().unix).is_some();
        let core = Self {
            identity: parts.identity,
            router: parts.router,
            endpoint: parts.endpoint,
            routes: parts.routes,
            network: parts.network,
            data: Arc::new(DataPlane::new(parts.rates)),
            inbox: Inbox::default(),
            links: BTreeMap::new(),
            look_due: None,
            keep_alive_policies: PeerPolicies::new(parts.keep_alive_policy),
            next_link: 1,
            entries: HashMap::new(),
            shares: HashMap::new(),
            readers: HashMap::new(),
            sinks: HashMap::new(),
            calls: BTreeMap::new(),
            service_ends: HashMap::new(),
            writers: HashMap::new(),
            graph,
            reopening: NetworkState::default(),
            consumers: FarConsumers::default(),
            sink_timers: SinkTimers::default(),
            message_keys: parts.message_keys,
            publishing: BTreeMap::new(),
            keyless: BTreeMap::new(),
            epoch_messages_max: parts.epoch_messages_max,
            epoch_over: Arc::default(),
            credentials: parts.credentials,
            gateway: parts.gateway,
            authority: parts.authority,
            operations: Operations::default(),
            keeper: parts.keeper,
            renew_due: None,
            redial: parts.redial,
            replays: Arc::default(),
            silence_due: None,
            requests,
            control_drops: Drops::default(),
            call_ledgers: BTreeMap::new(),
            problem_log: ProblemLog::default(),
            ros_failures: Arc::default(),
            events: parts.events,
            started: Instant::now(),
            alerts: Alerts::default(),
            awaits_clock,
            transport: parts.transport,
            alive: parts.alive,
            audit: parts.audit,
            board: parts.board,
            refused: Refusals::default(),
            types: InterfaceTypes::new(parts.types, parts.definitions),
            members,
            local_taps: Vec::new(),
        };
        (core, requested)
    }

    /// Runs until it is stopped or all senders are gone.
    pub(crate) async fn run(
        mut self,
        mut inbox: mpsc::Receiver<CoreEvent>,
        mut requested: mpsc::Receiver<SinkRequest>,
    ) {
        let mut batch = Vec::with_capacity(BATCH_MAX);
        let epoch_over = self.epoch_over.clone();
        self.ask_renewal();
        let mut deadline = self.drain();
        loop {
            let timer = async {
                match deadline {
                    Some(at) => tokio::time::sleep_until(at.into()).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                n = inbox.recv_many(&mut batch, BATCH_MAX) => {
                    if n == 0 {
                        return;
                    }
                    for event in batch.drain(..) {
                        if let CoreEvent::Stop(done) = event {
                            let _ = done.send(self.stop());
                            return;
                        }
                        self.handle(event);
                        self.drain();
                    }
                }
                Some(request) = requested.recv() => self.handle_sink(request),
                () = epoch_over.notified() => {}
                () = timer => {}
            }
            self.handle_timeouts();
            deadline = self.drain();
            self.show_graph();
        }
    }

    fn handle(&mut self, event: CoreEvent) {
        match event {
            CoreEvent::LinkUp { link, url, control, reply } => self.link_up(link, url, control, reply),
            CoreEvent::LinkDown { id, in_use } => self.link_down(id, in_use),
            CoreEvent::Frame { link, frame: Control::IdentityInUse { place }, .. } => {
                self.kept_out(link, place)
            }
            CoreEvent::Frame { link, frame, room } => self.handle_frame(link, frame, room),
            CoreEvent::Flushed { link } => self.router.handle_flushed(now(), link),
            CoreEvent::Malformed { link } => {
                self.control_drops.count_from("malformed_control", link);
            }
            CoreEvent::Discovery(event) => self.discovered(event),
            CoreEvent::CloseNetwork(reply) => {
                self.close_network();
                let _ = reply.send(());
            }
            CoreEvent::NetworkReopened => self.network_reopened(),
            CoreEvent::NetworkStaysClosed(reason) => self.reopening.stays_closed(reason),
            CoreEvent::ReaderReady { name, spec, guid, reader } => {
                self.reader_ready(name, &spec, guid, reader)
            }
            CoreEvent::WriterReady { name, source, spec, writer } => {
                self.writer_ready(name, source, &spec, writer)
            }
            CoreEvent::ConsumerShown { key, ends } => self.consumer_shown(key, ends),
            CoreEvent::ServiceReady { name, spec, end } => self.service_ready(name, &spec, end),
            CoreEvent::DeskAnswered(answers) => self.desk_answered(answers),
            CoreEvent::Operate { at, operation, reply } => self.operate(&at, operation, reply),
            CoreEvent::NetworkJoined(routes) => self.routes = Some(*routes),
            CoreEvent::Reload { shares, uses, anchors, message_keys, member_names, reply } => {
                self.add_message_keys(message_keys);
                self.members.set_names(member_names, &self.identity);
                self.reconfigure(shares, uses, anchors);
                let _ = reply.send(());
                self.answer_renewals();
            }
            CoreEvent::ConfigurationRead { mistakes } => {
                self.alerts.configuration_read(mistakes.as_deref(), Instant::now());
            }
            CoreEvent::Crl { der, reply } => {
                let _ = reply.send(self.add_crl(&der));
                // A user who brings a list may have changed the fleet file.
                self.answer_renewals();
            }
            CoreEvent::MessageKeys(keys) => self.add_message_keys(keys),
            CoreEvent::TypeLookedFor(outcome) => self.type_looked_for(outcome),
            CoreEvent::Status(reply) => {
                let _ = reply.send(self.status());
            }
            CoreEvent::Graph(name, reply) => {
                let _ = reply.send(self.graph(name));
            }
            CoreEvent::Tap(wish, reply) => self.tap(wish, reply),
            CoreEvent::Quiesce(reply) => {
                let _ = reply.send(self.quiesce());
            }
            CoreEvent::Stop(_) => {}
        }
    }

    fn handle_sink(&mut self, request: SinkRequest) {
        match request {
            SinkRequest::History(name, source) => {
                self.ask_history(name, source);
            }
            SinkRequest::Synced(name, source) => {
                self.sink_timers.history_ended(name, source);
            }
        }
    }

    fn handle_timeouts(&mut self) {
        let now = now();
        if self.awaits_clock {
            self.await_clock(now.unix);
        }
        self.look_at_links(now.instant);
        self.router.handle_timeout(now);
        self.endpoint.handle_timeout(now);
        if let Some(routes) = &mut self.routes {
            routes.handle_timeout(now.instant);
        }
        self.histories_due(now.instant);
        self.look_for_silence(now.instant);
        if self.renew_due.take_if(|at| *at <= now.instant).is_some() {
            self.ask_renewal();
        }
        self.rotation_due(now);
        self.operations_due(now.instant);
        self.calls_due(now.instant);
        self.types_due(now.instant);
        self.consumers_due(now);
        self.rediscovery_due(now.instant);
        self.rekey_due(now);
        self.epochs_due(now.instant);
    }

    /// Asks again for histories that make no progress.
    fn histories_due(&mut self, now: Instant) {
        for (name, source) in self.sink_timers.take_histories(now) {
            self.ask_history_again(name, source);
        }
    }

    /// Looks for sources that have fallen silent.
    fn look_for_silence(&mut self, now: Instant) {
        if self.silence_due.is_none_or(|at| at <= now) {
            let looks = self.shares.values().map(|share| share.look_for_silence(now));
            // `fold` looks at all of them, where `any` would stop at the first.
            let busy = looks.fold(false, |any, busy| any | busy);
            self.silence_due = busy.then(|| now + SILENCE_LOOK);
        }
    }

    /// Starts new epochs of shares that have sent enough under one key.
    fn rotation_due(&mut self, now: Now) {
        let long: Vec<_> = self.shares.iter().filter(|(_, s)| s.is_epoch_over()).map(|(n, _)| *n).collect();
        for name in long {
            self.endpoint.rotate(now, &name);
        }
    }

    /// Drops the keys of past epochs.
    fn epochs_due(&mut self, now: Instant) {
        for name in self.sink_timers.take_epochs(now) {
            if let Some(sink) = self.sinks.get(&name) {
                sink.retire_epochs();
            }
        }
    }

    /// Carries out the outputs of the machines until there are none. Returns the time of the next timer.
    fn drain(&mut self) -> Option<Instant> {
        loop {
            let router = loop {
                match self.router.poll_output() {
                    RouterOutput::Timeout(at) => break at,
                    output => self.router_output(output),
                }
            };
            let mut progressed = false;
            let endpoint = loop {
                match self.endpoint.poll_output() {
                    EndpointOutput::Timeout(at) => break at,
                    output => {
                        progressed = true;
                        self.endpoint_output(output);
                    }
                }
            };
            while let Some(command) = self.routes.as_mut().and_then(Routes::poll_command) {
                progressed = true;
                self.carry_out(command);
            }
            if !progressed {
                self.note_consumers();
                let routes = self.routes.as_ref().and_then(Routes::poll_timeout);
                let rekey = self.rekey_deadline();
                let own = [self.renew_due, self.silence_due, self.look_due, self.operations.deadline()];
                let own = own.into_iter().chain([self.reopening.deadline()]);
                let all =
                    [router, endpoint, routes, self.sink_timers.deadline(), rekey, self.calls_deadline()];
                let all =
                    all.into_iter().chain(own).chain([self.types.deadline(), self.consumers.deadline()]);
                return all.flatten().min();
            }
        }
    }

    /// Shows changes in the local graph.
    fn show_graph(&mut self) {
        if let Some(network) = self.network.get() {
            self.graph.show(network, &self.alive, &self.ros_failures);
        }
    }

    /// Applies new rules, and new trust anchors if they changed.
    fn reconfigure(&mut self, shares: Vec<ShareRule>, uses: Vec<UseRule>, anchors: Option<TrustAnchors>) {
        if let Some(routes) = &mut self.routes {
            routes.reconfigure(Instant::now(), shares, uses);
        }
        // Revoked nodes are told before their links close.
        self.drain();
        if let Some(anchors) = anchors {
            self.trust(anchors);
            self.drain();
        }
        self.close_not_admitted();
        self.want_all_lanes();
    }

    /// Stops receiving. Queued packets still leave.
    fn quiesce(&mut self) -> Vec<Arc<OutFlow>> {
        self.routes = None;
        self.end_consumers();
        self.local_taps.drain(..).for_each(|tap| tap.close());
        for share in self.shares.values() {
            share.close();
        }
        self.close_all_calls();
        for (_, reader) in self.readers.drain() {
            if let Some(reader) = reader.opened {
                drop_elsewhere(reader);
            }
        }
        let flows: Vec<_> = self.links.values().flat_map(|l| l.flows.values().cloned()).collect();
        flows.iter().for_each(|f| f.close());
        flows
    }

    /// Withdraws the shares and says goodbye.
    fn stop(&mut self) -> Vec<AnyLink> {
        self.operations.stop();
        self.endpoint.withdraw_all(now());
        self.drain();
        for entry in self.links.values() {
            entry.control.send(Control::Goodbye);
        }
        for sink in self.sinks.values() {
            sink.close();
        }
        self.links.values().map(|l| l.link.clone()).collect()
    }
}

/// Drops a value on a blocking thread, since the drop may block.
fn drop_elsewhere(thing: Box<dyn std::any::Any + Send>) {
    tokio::task::spawn_blocking(move || drop(thing));
}
