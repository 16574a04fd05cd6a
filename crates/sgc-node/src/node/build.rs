//! Builds a node: loads its rules, binds its sockets and creates its machines. No task of the node runs yet, except
//! those of the gateway's sockets.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_config::{Config, MetricsConfig};
use sgc_endpoint::{Endpoint, EndpointConfig};
use sgc_ros::{RosNetwork, Routes};
use sgc_router::{Router, RouterConfig, StoreOp};
use sgc_session::KeepAlivePolicy;
use sgc_store::StoreConfig;
use sgc_transport::{
    BulkLanes, CredentialStore, Dialer, DirectSockets, LinkOptions, ListenAddr, Listener, Scheme,
    TransportMetrics,
};
use sgc_trust::{Identity, Suite, TrustAnchors};
use sgc_types::{Definitions, TypeStore};
use tokio::sync::{mpsc, watch};
use tracing::warn;

use crate::clock::now;
use crate::control::core::{Core, CoreParts};
use crate::control::event::{CoreEvent, INBOX_MAX};
use crate::control::fleet::authority::Authority;
use crate::control::parts::direct_links::DirectEnds;
use crate::control::peers::peer_rate::PeerRates;
use crate::control::settings::rules::Rules;
use crate::data::sending::message_keys;
use crate::data::sinks::SinkRequest;
use crate::data::writer_queue::start_workers;
use crate::discovery::{Board, is_over_udp};
use crate::gateway::access::{access_with, refused_tokens};
use crate::gateway::certificate::gateway_expiry_warning;
use crate::gateway::{Gateway, GatewayStartError, NodeDefinitions, OpenLocalRos, Sockets, listen_at};
use crate::link::direct_address::{DIRECT_DIALS_MAX, DirectDial};
use crate::link::mapping_report::{MappingOff, MappingWish};
use crate::link::store::{OPERATIONS_MAX, load_store};
use crate::local::network_slot::NetworkSlot;
use crate::metrics::Metrics;
use crate::node::error::NodeError;
use crate::node::local::{OpenNetwork, local_routes, open_again};
use crate::node::random::system_rng;
use crate::state::audit::{self, Audit, AuditPlace, AuditWriter, PeerNames};
use crate::state::credentials::{StateWriter, with_kept_crls};
use crate::state::run_lock::RunLock;
use crate::state::storage::StateStorage;

/// Delay of the transport's own keep-alive behind ours.
const KEEP_ALIVE_SLACK: Duration = Duration::from_secs(5);
/// Lower bound of the transport's idle timeout: two and a half of the longest probe intervals.
const IDLE_TIMEOUT_MIN: Duration = Duration::from_secs(40);

/// Parts from which a node is built.
pub(super) struct NodeParts<N> {
    pub(super) config: Config,
    pub(super) identity: Arc<Identity>,
    pub(super) network: Option<Arc<N>>,
    pub(super) open: Option<OpenNetwork<N>>,
    pub(super) storage: StateStorage,
    pub(super) run_lock: RunLock,
}

/// A node whose tasks are not started.
pub(super) struct BuiltNode<N: RosNetwork> {
    pub(super) config: Config,
    pub(super) identity: Arc<Identity>,
    pub(super) rules: Rules,
    pub(super) state: Option<PathBuf>,
    pub(super) run_lock: RunLock,
    pub(super) audit: Audit,
    pub(super) names: PeerNames,
    pub(super) audit_writer: AuditWriter,
    pub(super) sockets: LinkSockets,
    pub(super) network: NetworkSlot<N>,
    pub(super) open: Option<OpenNetwork<N>>,
    pub(super) gateway: Arc<Gateway>,
    pub(super) metrics: Arc<Metrics>,
    pub(super) core: Core<N>,
    pub(super) channels: CoreChannels,
    pub(super) board: Board,
    /// Suites with a signing key.
    pub(super) suites: BTreeSet<Suite>,
    pub(super) rng: ChaCha20Rng,
}

/// Channels between the control task and the other tasks.
pub(super) struct CoreChannels {
    pub(super) events: mpsc::Sender<CoreEvent>,
    pub(super) inbox: mpsc::Receiver<CoreEvent>,
    /// Peers to dial without a router.
    pub(super) direct_dials: mpsc::Receiver<DirectDial>,
    /// Whether a port is to be mapped.
    pub(super) mapping_wishes: watch::Receiver<MappingWish>,
    /// The store of names, and the operations for it.
    pub(super) store: Option<(StoreConfig, mpsc::Receiver<StoreOp>)>,
    /// Requests of the control task's sinks.
    pub(super) requested: mpsc::Receiver<SinkRequest>,
    /// Notified when links have to be made again.
    pub(super) on_redial: watch::Receiver<()>,
    /// Ends when every thread and blocking task that uses this runtime has ended.
    pub(super) all_ended: mpsc::Receiver<()>,
}

/// Builds a node. `open_gateway` opens the gateway's part of the local network.
pub(super) async fn build<N: RosNetwork>(
    parts: NodeParts<N>,
    open_gateway: Option<OpenLocalRos>,
    types: Option<Arc<TypeStore>>,
) -> Result<BuiltNode<N>, NodeError> {
    let NodeParts { config, identity, network, open, storage, run_lock } = parts;
    let state = storage.dir.clone();
    let rules = Rules::load(&config, &identity, state.as_deref(), now().unix)?;
    let of_metrics = config.metrics.as_ref().map(MetricsConfig::warnings).unwrap_or_default();
    let warnings = config.warnings();
    warnings.iter().chain(&of_metrics).chain(&rules.warnings).for_each(|warning| warn!("{warning}"));
    let names = PeerNames::from(rules.names.clone());
    let (audit, audit_writer) = open_audit(&config, state.as_deref(), names.clone())?;
    let anchors = with_kept_crls(state.as_deref(), rules.partners.extend(&identity)?, now());
    let sockets = LinkSockets::bind(&config, &identity, &rules, &anchors)?;
    let (dials, direct_dials) = mpsc::channel(DIRECT_DIALS_MAX);
    let (mapping, mapping_wishes) = watch::channel(MappingWish::Off(MappingOff::NoDirectLinks));
    let direct = sockets.direct.as_ref();
    let direct = direct.map(|direct| DirectEnds { handle: direct.handle.clone(), dials, mapping });
    let store = open_store(&config, &identity).await?;
    let (store, store_operations) = store
        .map(|config| {
            let (operations, waiting) = mpsc::channel(OPERATIONS_MAX);
            ((config, waiting), operations)
        })
        .unzip();
    let mut rng = system_rng()?;
    let machines = Machines::new(&config, &identity, &rules, anchors, network.is_some(), &mut rng);
    let again = open.as_ref().zip(config.ros.as_ref()).map(|(open, ros)| open_again(open, ros));
    let network = NetworkSlot::new(network, again);
    let definitions = Definitions::from_env(config.ros.as_ref().map_or(&[], |ros| &ros.definitions));
    let types = types.unwrap_or_default();
    let found = NodeDefinitions { files: definitions.clone(), described: types.clone() };
    let gateway = Gateway::new(open_gateway, identity.node_name().as_str(), found);
    listen_for_clients(&gateway, &config, &identity, &rules, state.as_deref(), &audit).await?;
    let metrics = Arc::new(Metrics::new(config.metrics.as_ref()));
    let (events, inbox) = mpsc::channel(INBOX_MAX);
    // Every thread and blocking task that uses this runtime holds a clone of `alive`, since the runtime must outlive
    // them.
    let (alive, all_ended) = mpsc::channel(1);
    let (redial, on_redial) = watch::channel(());
    let wanted = rules.shares.clone();
    let made = tokio::task::spawn_blocking(move || message_keys::make_for(&wanted, |_| false)).await;
    let message_keys = made.map_err(|_| NodeError::Panicked)?;
    let suites = message_keys.keys().copied().collect();
    let board = Board::default();
    let (core, requested) = Core::new(CoreParts {
        types,
        definitions,
        member_names: rules.members.clone(),
        observers: rules.observers.clone(),
        direct,
        store: store_operations,
        direct_peers: rules.direct.clone(),
        port_mapping: rules.port_mapping,
        rng: ChaCha20Rng::from_rng(&mut rng),
        rights: rules.rights.clone(),
        board: board.clone(),
        keep_alive_policy: keep_alive_policy(&config),
        message_keys,
        authority: config
            .authority
            .as_ref()
            .map(|wanted| Authority::new(wanted.fleet.clone(), rules.operators.clone(), identity.node_id())),
        epoch_messages_max: config.rotation.messages,
        rates: PeerRates::new(config.peer_rate, names.clone()),
        keeper: StateWriter::spawn(state.clone(), config.identity.clone(), run_lock.clone(), alive.clone()),
        redial,
        alive,
        workers: start_workers().map_err(NodeError::Thread)?,
        identity: identity.clone(),
        credentials: sockets.credentials.clone(),
        gateway: gateway.clone(),
        metrics: metrics.clone(),
        router: machines.router,
        endpoint: machines.endpoint,
        routes: machines.routes,
        network: network.clone(),
        events: events.downgrade(),
        transport: sockets.metrics.clone(),
        audit: audit.clone(),
        names: names.clone(),
        storage,
    });
    let channels =
        CoreChannels { events, inbox, direct_dials, mapping_wishes, store, requested, on_redial, all_ended };
    Ok(BuiltNode {
        config,
        identity,
        rules,
        state,
        run_lock,
        audit,
        names,
        audit_writer,
        sockets,
        network,
        open,
        gateway,
        metrics,
        core,
        channels,
        board,
        suites,
        rng,
    })
}

/// Sockets of links: listeners that are bound, and dialers.
pub(super) struct LinkSockets {
    pub(super) credentials: CredentialStore,
    pub(super) listeners: Vec<Listener>,
    pub(super) dialer: Arc<Dialer>,
    /// Dials lanes. DSCP marks belong to sockets, so lanes with another mark need their own.
    pub(super) lane_dialer: Arc<Dialer>,
    /// Of a node that has the fleet's secret, and so topics of its own.
    pub(super) direct: Option<DirectSockets>,
    metrics: Arc<TransportMetrics>,
}

impl LinkSockets {
    fn bind(
        config: &Config,
        identity: &Arc<Identity>,
        rules: &Rules,
        anchors: &TrustAnchors,
    ) -> Result<Self, NodeError> {
        let metrics = Arc::new(TransportMetrics::default());
        let credentials = CredentialStore::new(identity.clone());
        credentials.set_anchors(anchors.clone());
        credentials.set_admitted(rules.partners.admitted.clone());
        let options = link_options(config, identity);
        let bind = |addr: &ListenAddr| {
            let options = LinkOptions { bulk_lanes: bulk_lanes(config, addr), ..options.clone() };
            Listener::bind(addr, credentials.clone(), options, metrics.clone())
                .map_err(|source| NodeError::Listen { addr: addr.clone(), source })
        };
        let listeners = config.listen.iter().map(bind).collect::<Result<Vec<_>, _>>()?;
        let dialer = |options| Arc::new(Dialer::new(credentials.clone(), options, metrics.clone()));
        let shared = dialer(options.clone());
        let is_member = !identity.naming_secrets().is_empty();
        let direct = is_member.then(|| shared.open_direct());
        let lane_dialer = match config.transport.lane_dscp {
            None => shared.clone(),
            marked => dialer(LinkOptions { dscp: marked, ..options }),
        };
        Ok(Self { listeners, dialer: shared, lane_dialer, direct, credentials, metrics })
    }
}

fn keep_alive_policy(config: &Config) -> KeepAlivePolicy {
    config.keep_alive.map_or_else(KeepAlivePolicy::default, KeepAlivePolicy::fixed)
}

fn link_options(config: &Config, identity: &Identity) -> LinkOptions {
    let keep_alive_policy = keep_alive_policy(config);
    LinkOptions {
        post_quantum: identity.post_quantum(),
        // The transport's keep-alive matters only for peers that our keep-alive no longer probes.
        keep_alive: keep_alive_policy.max + KEEP_ALIVE_SLACK,
        idle_timeout: IDLE_TIMEOUT_MIN.max(keep_alive_policy.max * 5 / 2),
        congestion: config.transport.congestion,
        offload: config.transport.offload,
        mtu_discovery: config.transport.mtu_discovery,
        bulk_lanes: if config.transport.bulk_lanes { BulkLanes::Own } else { BulkLanes::Off },
        dtls12: config.transport.dtls12,
        dscp: config.transport.dscp,
        ..LinkOptions::default()
    }
}

/// Returns which socket takes the bulk lanes of a listener. A TCP port that the configuration gives to another listener is
/// that one's.
fn bulk_lanes(config: &Config, addr: &ListenAddr) -> BulkLanes {
    if !config.transport.bulk_lanes {
        return BulkLanes::Off;
    }
    let has_port = |other: &&ListenAddr| other.addr.port() == addr.addr.port() && addr.addr.port() != 0;
    let mut beside = config.listen.iter().filter(has_port).map(|other| other.scheme);
    match beside.find(|scheme| !is_over_udp(*scheme)) {
        None => BulkLanes::Own,
        Some(Scheme::Tls) => BulkLanes::ByTlsListener,
        Some(_) => BulkLanes::Off,
    }
}

/// Returns `true` for a node that carries names of others.
fn is_router(config: &Config, identity: &Identity) -> bool {
    !config.listen.is_empty() && identity.as_peer().may_route
}

/// Reads the settings of the store of names, at a router that has one.
async fn open_store(config: &Config, identity: &Identity) -> Result<Option<StoreConfig>, NodeError> {
    let Some(settings) = config.store.clone().filter(|_| is_router(config, identity)) else {
        return Ok(None);
    };
    let loaded = tokio::task::spawn_blocking(move || load_store(&settings)).await;
    Ok(Some(loaded.map_err(|_| NodeError::Panicked)??))
}

/// The machines that the control task owns.
struct Machines {
    router: Router,
    endpoint: Endpoint,
    routes: Option<Routes<ChaCha20Rng>>,
}

impl Machines {
    /// Creates the machines. The route machine needs a local network.
    fn new(
        config: &Config,
        identity: &Arc<Identity>,
        rules: &Rules,
        anchors: TrustAnchors,
        has_network: bool,
        rng: &mut ChaCha20Rng,
    ) -> Self {
        let started = now();
        let router_config = RouterConfig {
            node: identity.node_id(),
            identity: identity.clone(),
            transit: is_router(config, identity),
            incarnation: rand_core::RngCore::next_u64(rng),
            started: started.unix,
            mapping: config.mapping,
            anchors: Arc::new(anchors.clone()),
            limits: sgc_router::Limits::default(),
        };
        let router = Router::new(router_config, started);
        let endpoint_config = EndpointConfig {
            identity: identity.clone(),
            authority: config.authority.is_some(),
            operations: config.authority.is_some(),
            limits: sgc_endpoint::Limits {
                rotate_every: config.rotation.every,
                ..sgc_endpoint::Limits::default()
            },
        };
        let mut endpoint = Endpoint::new(endpoint_config, ChaCha20Rng::from_rng(rng), now());
        endpoint.set_anchors(now(), Arc::new(anchors));
        let routes = has_network.then(|| {
            let mut followed = BTreeSet::new();
            for rule in rules.uses.iter().filter(|rule| rule.token.is_none()) {
                if followed.insert(rule.owner) {
                    endpoint.follow(now(), &rule.owner_name);
                }
            }
            local_routes(identity, rules.shares.clone(), rules.uses.clone(), rng)
        });
        Self { router, endpoint, routes: routes.flatten() }
    }
}

/// Opens the sockets of the gateway, if the configuration has one.
pub(crate) async fn listen_for_clients(
    gateway: &Arc<Gateway>,
    config: &Config,
    identity: &Arc<Identity>,
    rules: &Rules,
    state: Option<&Path>,
    audit: &Audit,
) -> Result<(), NodeError> {
    let Some(wanted) = &config.gateway else { return Ok(()) };
    wanted.warnings().iter().for_each(|warning| warn!("{warning}"));
    let (maker, of_key, dir) = (Arc::clone(gateway), wanted.clone(), state.map(Path::to_owned));
    let make = move || {
        if let Some(warning) = gateway_expiry_warning(&of_key, now().unix) {
            warn!("{warning}");
        }
        maker.shown_key(&of_key, dir.as_deref(), now().unix)
    };
    let key = tokio::task::spawn_blocking(make).await.map_err(|_| NodeError::Panicked)?;
    let key = key.map_err(GatewayStartError::from)?;
    let access = access_with(config, identity, &rules.partners, state, now())?;
    gateway
        .listen(Sockets {
            listen: listen_at(wanted),
            access: access.unwrap_or_default().with_refusal_listener(refused_tokens(audit.clone())),
            key,
            identity: identity.clone(),
            clients_max: wanted.clients_max,
            client_bytes_max: wanted.client_bytes_max.try_into().unwrap_or(usize::MAX),
        })
        .await?;
    Ok(())
}

fn open_audit(
    config: &Config,
    state: Option<&Path>,
    names: PeerNames,
) -> Result<(Audit, AuditWriter), NodeError> {
    let place = audit_place(config, state);
    let path = place.as_ref().map(|(path, _)| path.clone()).unwrap_or_default();
    Audit::start(place, names).map_err(|source| NodeError::Audit { path, source })
}

/// Returns the place of the audit log; `None` if it is off or there is no state directory.
pub(crate) fn audit_place(config: &Config, state: Option<&Path>) -> Option<AuditPlace> {
    let path = audit::audit_path(config.audit.file.as_deref(), state)?;
    (!config.audit.off).then_some((path, config.audit.room))
}
