//! The control task: owns the three machines, feeds them events, and carries out their outputs.
//!
//! It blocks on nothing but its inbox and its timer. Work that may block, on the local network or on a slow peer, runs
//! in other tasks and threads.

mod alerts;
mod clocks;
mod consumers;
mod direct;
mod graph;
mod links;
mod operations;
mod outputs;
mod publish;
mod reopening;
mod reports;
mod ros;
mod services;
mod status;
mod trust;
mod types;
mod wishes;

use std::sync::Arc;
use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use sgc_endpoint::{Endpoint, Output as EndpointOutput};
use sgc_ros::{RosNetwork, Routes, ShareRule, UseRule};
use sgc_router::{Output as RouterOutput, Router, StoreOp};
use sgc_session::{KeepAlivePolicy, PeerClocks};
use sgc_sync::Workers;
use sgc_transport::{AnyLink, CredentialStore};
use sgc_trust::{Grantees, Identity, TrustAnchors};
use sgc_types::{Definitions, TypeStore};
use sgc_wire::{Control, Now};
use tokio::sync::{mpsc, watch};
use tracing::{info, warn};

use crate::admin::report::ReportRights;
use crate::clock::now;
use crate::control::event::{CoreEvent, INBOX_MAX};
use crate::control::faults::alerts::Alerts;
use crate::control::faults::problem_log::ProblemLog;
use crate::control::faults::refusals::Refusals;
use crate::control::fleet::authority::Authority;
use crate::control::fleet::inquiries::Inquiries;
use crate::control::fleet::members::{MemberNames, Members};
use crate::control::fleet::operations::Operations;
use crate::control::fleet::reports::Reports;
use crate::control::graph::far_consumers::FarConsumers;
use crate::control::graph::local_graph::LocalGraph;
use crate::control::parts::certificates::{Certificates, Validity};
use crate::control::parts::closings::Closings;
use crate::control::parts::direct_links::{DirectEnds, DirectLinks};
use crate::control::parts::forward_table::ForwardTable;
use crate::control::parts::link_table::LinkTable;
use crate::control::parts::network_ends::{NetworkEnds, OpenEnd};
use crate::control::parts::newcomers::Newcomers;
use crate::control::parts::publishers::Publishers;
use crate::control::parts::services::Services;
use crate::control::parts::shares::Shares;
use crate::control::parts::sinks::Sinks;
use crate::control::parts::wishes::Wishes;
use crate::control::peers::control_queue::Inbox;
use crate::control::peers::peer_rate::PeerRates;
use crate::control::types::interface_types::InterfaceTypes;
use crate::data::dataplane::DataPlane;
use crate::data::outflow::OutFlow;
use crate::data::sending::message_keys::MessageKeys;
use crate::data::sending::replays::Replays;
use crate::data::sending::share::DueMark;
use crate::data::sinks::SinkRequest;
use crate::data::stats::Drops;
use crate::data::tap::TapQueue;
use crate::data::writer_queue::WriterContext;
use crate::discovery::Board;
use crate::drops::NodeDrop;
use crate::gateway::Gateway;
use crate::local::network_slot::NetworkSlot;
use crate::local::network_state::NetworkState;
use crate::metrics::Metrics;
use crate::state::audit::{Audit, PeerNames};
use crate::state::credentials::StateWriter;
use crate::state::storage::StateStorage;

/// Events handled before the timers are checked again.
const BATCH_MAX: usize = 256;
/// Bytes of history kept for late joiners of one publisher.
const HISTORY_BYTES_MAX: usize = 64 << 20;
/// Messages of history kept for a publisher that keeps all.
const HISTORY_KEEP_ALL_MAX: usize = 4096;
/// Instances for which a transient-local source of a keyed topic keeps its history, as the writers of `sgc-dds` do.
const KEYED_INSTANCES_KEPT: usize = 256;

/// The control task's state. `N` is the local network; a pure router has none.
pub(crate) struct Core<N: RosNetwork> {
    certificates: Certificates,
    router: Router,
    endpoint: Endpoint,
    routes: Option<Routes<ChaCha20Rng>>,
    network: NetworkSlot<N>,
    data: Arc<DataPlane>,
    inbox: Inbox,
    links: LinkTable,
    direct: DirectLinks,
    /// The clocks of the nodes that messages come from.
    clocks: PeerClocks,
    /// The task of the store of names.
    store: Option<mpsc::Sender<StoreOp>>,
    /// A grant came since the last look at the peers that data is exchanged with.
    is_newly_granted: bool,
    forwards: ForwardTable,
    shares: Shares,
    closings: Closings,
    /// Marks that ask for confirmations.
    questions: Vec<DueMark>,
    /// Wanted readers and writers of the local network.
    ends: NetworkEnds,
    sinks: Sinks,
    services: Services,
    /// Far nodes that the local graph shows.
    graph: LocalGraph,
    reopening: NetworkState,
    /// Local consumers that owners are told, and far consumers that are shown here.
    consumers: FarConsumers,
    publishers: Publishers,
    /// Local publishers that were there before this node.
    newcomers: Newcomers,
    /// The most that nodes want of each other's topics.
    wishes: Wishes,
    /// Set if this node is the authority of its fleet.
    authority: Option<Authority>,
    /// Operations that users of this node request.
    operations: Operations,
    gateway: Arc<Gateway>,
    metrics: Arc<Metrics>,
    /// The rights that the configuration gives, for reports.
    rights: Arc<ReportRights>,
    /// Reports that observers ask for.
    reports: Reports,
    /// Reports that users of this node ask other nodes for.
    inquiries: Inquiries,
    replays: Arc<Replays>,
    control_drops: Drops,
    problem_log: ProblemLog,
    ros_failures: Arc<Drops>,
    writers: WriterContext,
    events: mpsc::WeakSender<CoreEvent>,
    started: Instant,
    alerts: Alerts,
    transport: Arc<sgc_transport::TransportMetrics>,
    alive: mpsc::Sender<()>,
    audit: Audit,
    names: PeerNames,
    storage: StateStorage,
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
    /// Server of metrics, for its alerts.
    pub(crate) metrics: Arc<Metrics>,
    /// Rate limits of peers.
    pub(crate) rates: PeerRates,
    /// Set if this node is the authority of its fleet.
    pub authority: Option<Authority>,
    /// The task of the store, at a router that keeps names in one.
    pub(crate) store: Option<mpsc::Sender<StoreOp>>,
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
    /// The threads that write to the local network.
    pub(crate) workers: Workers,
    /// Transport counters.
    pub transport: Arc<sgc_transport::TransportMetrics>,
    /// Audit log.
    pub audit: Audit,
    /// The names of other nodes.
    pub names: PeerNames,
    pub storage: StateStorage,
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
    /// The peers that may ask this node how it is doing.
    pub(crate) observers: Grantees,
    /// The rights that it tells them.
    pub(crate) rights: Arc<ReportRights>,
    /// The sockets of direct links; `None` at a node that only routes.
    pub(crate) direct: Option<DirectEnds>,
    /// The peers that may have direct links.
    pub(crate) direct_peers: Grantees,
    /// Whether the gateway is asked to map a port for these.
    pub(crate) port_mapping: bool,
    /// Source of the passwords of checks.
    pub(crate) rng: ChaCha20Rng,
}

impl<N: RosNetwork> Core<N> {
    /// Creates the control task and the inbox of its sinks.
    pub(crate) fn new(parts: CoreParts<N>) -> (Self, mpsc::Receiver<SinkRequest>) {
        let (requests, requested) = mpsc::channel(INBOX_MAX);
        let graph = LocalGraph::new(parts.identity.node_name().as_str());
        let members = Members::new(parts.member_names, &parts.identity);
        let data = Arc::new(DataPlane::new(parts.rates));
        let shares = Shares::new(data.clone(), parts.alive.clone(), parts.epoch_messages_max);
        let ros_failures = Arc::<Drops>::default();
        let services = Services::new(ros_failures.clone(), shares.epoch_over().clone());
        let own = parts.identity.node_id();
        let certificates = Certificates::new(
            parts.identity,
            parts.credentials,
            parts.gateway.clone(),
            parts.keeper,
            parts.redial,
            now().unix,
        );
        let mut core = Self {
            certificates,
            router: parts.router,
            endpoint: parts.endpoint,
            routes: parts.routes,
            network: parts.network,
            data: data.clone(),
            inbox: Inbox::default(),
            links: LinkTable::new(parts.keep_alive_policy, parts.names.clone(), data.clone()),
            direct: DirectLinks::new(own, parts.direct, Grantees::default(), parts.rng),
            clocks: PeerClocks::new(Instant::now()),
            store: parts.store,
            is_newly_granted: false,
            forwards: ForwardTable::default(),
            shares,
            closings: Closings::default(),
            questions: Vec::new(),
            ends: NetworkEnds::default(),
            sinks: Sinks::new(requests, data),
            services,
            graph,
            reopening: NetworkState::default(),
            consumers: FarConsumers::default(),
            publishers: Publishers::new(parts.message_keys),
            newcomers: Newcomers::new(Instant::now()),
            wishes: Wishes::default(),
            authority: parts.authority,
            operations: Operations::default(),
            gateway: parts.gateway,
            metrics: parts.metrics,
            reports: Reports::default(),
            rights: parts.rights,
            inquiries: Inquiries::default(),
            replays: Arc::default(),
            control_drops: Drops::default(),
            problem_log: ProblemLog::default(),
            writers: WriterContext::new(parts.workers, ros_failures.clone(), parts.alive.clone()),
            ros_failures,
            events: parts.events,
            started: Instant::now(),
            alerts: Alerts::default(),
            transport: parts.transport,
            alive: parts.alive,
            audit: parts.audit,
            names: parts.names,
            storage: parts.storage,
            board: parts.board,
            refused: Refusals::default(),
            types: InterfaceTypes::new(parts.types, parts.definitions),
            members,
            local_taps: Vec::new(),
        };
        core.set_observers(parts.observers);
        core.set_direct(parts.direct_peers, parts.port_mapping);
        if core.routes.is_some() {
            core.endpoint.offer_clock(now());
        }
        (core, requested)
    }

    /// Runs until it is stopped or all senders are gone.
    pub(crate) async fn run(
        mut self,
        mut inbox: mpsc::Receiver<CoreEvent>,
        mut requested: mpsc::Receiver<SinkRequest>,
    ) {
        let mut batch = Vec::with_capacity(BATCH_MAX);
        let epoch_over = self.shares.epoch_over().clone();
        self.ask_renewal();
        // The fleet file may have been restored from a copy since these lists came.
        self.catch_up_file(self.certificates.anchors());
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
            DueMark::publish_all(std::mem::take(&mut self.questions));
            self.show_graph();
        }
    }

    fn handle(&mut self, event: CoreEvent) {
        match event {
            CoreEvent::LinkUp { link, url, control, reply } => self.link_up(link, url, control, reply),
            CoreEvent::LinkDown { id, in_use, end } => self.link_down(id, in_use, end),
            CoreEvent::Frame { link, frame: Control::IdentityInUse { place }, .. } => {
                self.kept_out(link, place)
            }
            CoreEvent::Frame { link, frame: Control::ObservedAddress { place }, .. } => {
                self.address_observed(link, place);
            }
            CoreEvent::Frame { link, frame, room } => self.handle_frame(link, frame, room),
            CoreEvent::Check(check) => self.check_arrived(&check),
            CoreEvent::HostAddresses(addresses) => self.host_addresses(addresses),
            CoreEvent::PortMapping(report) => self.port_mapped(report),
            CoreEvent::Store(event) => self.router.handle_store(now(), event),
            CoreEvent::NotDialled(peer) => self.direct.not_dialled(Instant::now(), peer),
            CoreEvent::Flushed { link } => self.router.handle_flushed(now(), link),
            CoreEvent::Malformed { link } => {
                self.control_drops.count_from(NodeDrop::MalformedControl, link);
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
            CoreEvent::Inquire { at, question, over, reply } => self.inquire(&at, question, over, reply),
            CoreEvent::ReportMade(question, report) => self.report_made(question, report),
            CoreEvent::NetworkJoined(routes) => self.routes = Some(*routes),
            CoreEvent::Reload {
                identity,
                shares,
                uses,
                anchors,
                message_keys,
                member_names,
                observers,
                direct,
                port_mapping,
                operators,
                rights,
                peer_rate,
                rotation,
                reply,
            } => {
                if let Some(identity) = identity {
                    self.take_identity(identity);
                }
                self.add_message_keys(message_keys);
                self.set_observers(observers);
                self.set_direct(direct, port_mapping);
                if let Some(authority) = &mut self.authority {
                    authority.set_operators(operators);
                }
                self.data.rates().set_limit(peer_rate);
                self.shares.set_epoch_messages_max(rotation.messages);
                self.endpoint.set_rotate_every(now(), rotation.every);
                self.rights = rights;
                self.members.set_names(member_names, self.certificates.identity(), Instant::now());
                self.reconfigure(shares, uses, anchors);
                let _ = reply.send(());
                self.answer_renewals();
            }
            CoreEvent::ConfigurationRead { outcome } => {
                self.alerts.configuration_read(outcome, Instant::now());
            }
            CoreEvent::Crl { der, reply } => {
                let _ = reply.send(self.add_crl(&der));
                // A user who brings a list may have changed the fleet file.
                self.answer_renewals();
            }
            CoreEvent::MessageKeys(keys) => self.add_message_keys(keys),
            CoreEvent::TypeLookedFor(outcome) => self.type_looked_for(outcome),
            CoreEvent::Ping(reply) => {
                let _ = reply.send(());
            }
            CoreEvent::Status(reply) => {
                let _ = reply.send(self.status());
            }
            CoreEvent::Readings(reply) => {
                let _ = reply.send(Box::new(self.readings()));
            }
            CoreEvent::Graph(name, reply) => {
                let _ = reply.send(self.graph(name));
            }
            CoreEvent::Resume(topic, reply) => drop(reply.send(self.resume(&topic))),
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
                self.sinks.history_arrived(name, source);
            }
            SinkRequest::Confirm(name, source, seq) => self.endpoint.confirm(name, source, seq),
            SinkRequest::Writer(name) => {
                if self.reopening.is_closed()
                    && let Some(sink) = self.sinks.get(&name)
                {
                    sink.give_up_held(&*self.data);
                } else if let Some(routes) = &mut self.routes {
                    routes.handle_unwritten(now().instant, &name);
                }
            }
        }
    }

    fn handle_timeouts(&mut self) {
        let now = now();
        match self.certificates.validity_change(now.unix) {
            Some(Validity::Holds) => info!("this node's certificate holds by the clock here"),
            Some(Validity::Lost(alert)) => warn!("{alert}; {}", alert.fix()),
            None => {}
        }
        self.look_at_links(now.instant);
        self.direct.handle_timeout(now.instant);
        self.router.handle_timeout(now);
        self.endpoint.handle_timeout(now);
        self.hold_shares(now.instant);
        if let Some(routes) = &mut self.routes {
            for (name, span) in routes.writers_in_doubt(now.instant) {
                let last = self.sinks.get(&name).and_then(|sink| sink.last_message());
                if let Some(last) = last.filter(|last| *last + span > now.instant) {
                    routes.handle_unwritten(last, &name);
                }
            }
            routes.handle_timeout(now.instant);
        }
        self.sinks_due(now.instant);
        self.shares.look_for_silence(now.instant);
        if self.certificates.take_renewal_due(now.instant) {
            self.ask_renewal();
        }
        self.rotation_due(now);
        self.operations_due(now.instant);
        self.inquiries_due(now.instant);
        self.reports_due(now.instant);
        self.services.handle_timeout(now.instant);
        self.types_due(now.instant);
        self.consumers_due(now);
        self.rediscovery_due(now.instant);
        self.rekey_due(now);
    }

    /// Asks again for histories that make no progress, and drops the keys of past epochs.
    fn sinks_due(&mut self, now: Instant) {
        let requests = self.sinks.handle_timeout(now);
        self.recover(requests);
    }

    /// Starts new epochs of shares that have sent enough under one key.
    fn rotation_due(&mut self, now: Now) {
        for name in self.shares.take_epochs_over() {
            self.endpoint.rotate(now, &name);
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
            let mut progressed = self.drain_direct() | self.drain_clocks() | self.settle_wishes();
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
                let rekey = self.publishers.deadline();
                let own = [
                    self.certificates.deadline(),
                    self.shares.deadline(),
                    self.links.deadline(),
                    self.operations.deadline(),
                    self.inquiries.deadline(),
                    self.reports.deadline(),
                    self.direct.deadline(),
                    self.clocks.deadline(),
                ];
                let own = own.into_iter().chain([self.reopening.deadline()]);
                let all = [router, endpoint, routes, self.sinks.deadline(), rekey, self.services.deadline()];
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
        self.shares.close();
        self.close_all_calls();
        self.ends.forget_readers().into_iter().for_each(drop_elsewhere);
        self.links.close_flows()
    }

    /// Withdraws the shares and says goodbye.
    fn stop(&mut self) -> Vec<AnyLink> {
        self.operations.stop();
        self.inquiries.stop();
        self.endpoint.withdraw_all(now());
        self.drain();
        let links = self.links.say_goodbye();
        self.sinks.close();
        links
    }
}

/// Drops a value on a blocking thread, since the drop may block.
fn drop_elsewhere(thing: OpenEnd) {
    tokio::task::spawn_blocking(move || drop(thing));
}
