//! A node from configuration to clean shutdown: connects machines, sockets and the local network, and disconnects them
//! again.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng, TryRngCore};
use sgc_config::{Config, DiscoveryRange, RosConfig, RouterUrl, SecurityConfig};
use sgc_dds::{CycloneNetwork, DdsConfig, Security};
use sgc_endpoint::{Endpoint, EndpointConfig};
use sgc_gateway::LocalRos;
use sgc_ros::{RosError, RosNetwork, Routes, ShareRule, UseRule};
use sgc_router::{Router, RouterConfig};
use sgc_transport::{
    CloseReason, CredentialStore, Dialer, Link, LinkOptions, ListenAddr, Listener, TransportMetrics,
};
use sgc_trust::{AnchorError, CertError, Identity, IdentityError};
use sgc_types::{Definitions, TypeStore};
use tokio::sync::{Mutex, Notify, mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tracing::{info, warn};

use crate::admin::{self, Desk};
use crate::control::alerts::clock_alert;
use crate::control::authority::Authority;
use crate::control::core::{Core, CoreEvent, CoreParts, INBOX_MAX, now};
use crate::control::file_watch::FileWatch;
use crate::control::peer_rate::PeerRates;
use crate::control::policy::grantees;
use crate::control::reload::{ConfigSource, JoinNetwork, Reloader, Running};
use crate::control::rules::{Rules, RulesError};
use crate::data::message_keys;
use crate::discovery::{self, Board, Claims, Dns, LinkKeeper, LocalNetwork, RouterFilter, WorkingUrls};
use crate::gateway::access::{AccessError, access_with, refused_tokens};
use crate::gateway::{
    Gateway, GatewayStartError, NodeDefinitions, OpenLocalRos, ShownKey, Sockets, key_of_files, listen_at,
};
use crate::link::keep_alive::KeepAlivePolicy;
use crate::link::lanes::LaneAdmission;
use crate::link::links::{Admission, keep_accepting};
use crate::link::roaming::Network;
use crate::local::discovery_server;
use crate::local::network_slot::{NetworkSlot, OpenAgain};
use crate::local::reopening;
use crate::local::strangers;
use crate::state::audit::{self, Audit, AuditEvent, AuditRecord, AuditWriter};
use crate::state::credentials::{StateWriter, with_kept_crls};
use crate::state::run_lock::{IdentityInUse, RunLock};
use crate::state::{self, StateError};

/// Delay of the transport's own keep-alive behind ours.
const KEEP_ALIVE_SLACK: Duration = Duration::from_secs(5);
/// Lower bound of the transport's idle timeout: two and a half of the longest probe intervals.
const IDLE_TIMEOUT_MIN: Duration = Duration::from_secs(40);
/// Time for queues to drain at shutdown.
const DRAIN_MAX: Duration = Duration::from_secs(2);
/// Time before its certificate's end at which a node starts to warn.
const EXPIRY_WARNING: Duration = Duration::from_secs(14 * 86_400);
/// Time for peers to answer a goodbye.
const GOODBYE_MAX: Duration = Duration::from_secs(1);

/// Reasons why a node does not start.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The identity file could not be read.
    #[error("identity {}: {source}", path.display())]
    IdentityFile {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The identity file may be read by others.
    #[error("identity {}: others can read it (mode {mode:o}); it holds a private key: chmod 600 it", path.display())]
    IdentityExposed {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The identity file holds no identity.
    #[error("identity {}: {source}", path.display())]
    Identity {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: IdentityError,
    },
    /// The name in the configuration is not that of the identity.
    #[error(
        "`name` is {configured:?}, but the identity is of {certified:?}: use that node's identity file or change `name`"
    )]
    OtherName {
        /// Name in the configuration.
        configured: String,
        /// Name in the identity.
        certified: String,
    },
    /// Another process of this machine uses the identity.
    #[error(
        "identity {}: {source}. One identity is for one process: stop that one, or enroll this node under a name of its own",
        path.display()
    )]
    IdentityInUse {
        /// The identity file.
        path: PathBuf,
        /// The other process and its lock.
        source: IdentityInUse,
    },
    /// The identity's certificate is invalid.
    #[error("identity {}: {source}", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: sgc_trust::CertError,
    },
    /// A router's identity cannot share or use.
    #[error(
        "this identity is a router's and holds no fleet secret: it can neither share nor use. Enroll the node without --router"
    )]
    RouterIdentity,
    /// `mdns://NODE` with a router's identity, which cannot recognise names.
    #[error(
        "`routers` names \"mdns://{node}\", but this identity is a router's and cannot tell nodes by their names: write \"mdns://\""
    )]
    NamelessIdentity {
        /// The router that is wanted.
        node: String,
    },
    /// A use of the node's own topic.
    #[error("[[use]] from {node:?}: that is this node itself")]
    UseOfOwn {
        /// The node.
        node: String,
    },
    /// The state directory cannot be used.
    #[error(transparent)]
    State(#[from] StateError),
    /// Partners or tokens cannot be used.
    #[error(transparent)]
    Rules(#[from] RulesError),
    /// The CAs of the identity, of partners and of tokens are invalid, or too many.
    #[error("trusted CAs: {0}")]
    Anchors(#[from] AnchorError),
    /// The audit log cannot be written.
    #[error("audit log {}: {source}; name another with `file` in [audit], or set `off`", path.display())]
    Audit {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// An address could not be bound.
    #[error("cannot listen on {addr}: {source}")]
    Listen {
        /// The address.
        addr: ListenAddr,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The local network could not be joined.
    #[error(transparent)]
    Ros(#[from] RosError),
    /// The access records of the gateway cannot be used.
    #[error(transparent)]
    Access(#[from] AccessError),
    /// The gateway does not start.
    #[error(transparent)]
    Gateway(Box<GatewayStartError>),
    /// A thread of the local network did not start, or no key could be made.
    #[error("starting ended in a panic; this is a bug")]
    Panicked,
    /// The system provides no random numbers.
    #[error("the system gives no randomness: {0}")]
    Randomness(String),
}

impl From<GatewayStartError> for NodeError {
    fn from(error: GatewayStartError) -> Self {
        Self::Gateway(Box::new(error))
    }
}

/// Options of a running node.
#[derive(Default)]
pub struct RunOptions {
    /// Receives the listen addresses once the node is up.
    pub ready: Option<oneshot::Sender<Vec<ListenAddr>>>,
    /// Reads the configuration again for `sgc reload`.
    pub source: Option<ConfigSource>,
    /// Triggers of a reload, as SIGHUP is.
    pub reload: Option<mpsc::Receiver<()>>,
    /// The file that `source` reads. It is watched, unless its configuration says otherwise.
    pub file: Option<PathBuf>,
    /// Store of types, for other readers of messages in this process.
    pub types: Option<Arc<TypeStore>>,
    /// Port of mDNS, if not the standard one, so that each test has its own local network.
    pub mdns_port: Option<u16>,
    /// Opens the gateway's part of the local network. [`run`] sets it by itself.
    pub gateway: Option<OpenLocalRos>,
}

/// Reads an identity file, which only its owner may read.
pub fn load_identity(path: &Path) -> Result<Identity, NodeError> {
    let file = |source| NodeError::IdentityFile { path: path.to_owned(), source };
    if let Some(mode) = state::exposed(&fs::metadata(path).map_err(file)?) {
        return Err(NodeError::IdentityExposed { path: path.to_owned(), mode });
    }
    let text = zeroize::Zeroizing::new(fs::read_to_string(path).map_err(file)?);
    Identity::parse(&text).map_err(|source| NodeError::Identity { path: path.to_owned(), source })
}

/// Checks the identity as [`run`] does, and binds nothing. A certificate that is not valid yet passes, see
/// [`clock_alert`](crate::control::alerts::clock_alert).
pub fn check_identity(config: &Config) -> Result<Identity, NodeError> {
    let identity = load_identity(&config.identity)?;
    let certified = identity.node_name().as_str();
    if let Some(configured) = config.node_name.as_ref().filter(|n| n.as_str() != certified) {
        return Err(NodeError::OtherName {
            configured: configured.to_string(),
            certified: certified.to_owned(),
        });
    }
    match identity.anchors().verify(identity.chain(), now().unix) {
        // The clock may be behind and be set later, as NTP does after the start of a machine without a battery.
        Ok(_) | Err(CertError::NotYetValid { .. }) => {}
        Err(source) => return Err(NodeError::Certificate { path: config.identity.clone(), source }),
    }
    let touches_topics = !(config.shares.is_empty() && config.uses.is_empty() && config.tokens.is_empty());
    if identity.fleet_secret().is_none() && touches_topics {
        return Err(NodeError::RouterIdentity);
    }
    if let Some(own) = config.uses.iter().find(|u| u.from.as_str() == certified) {
        return Err(NodeError::UseOfOwn { node: own.from.to_string() });
    }
    wanted_nearby(&config.routers, &identity)?;
    Ok(identity)
}

/// Returns the routers wanted on the local network, if any are.
fn wanted_nearby(routers: &[RouterUrl], identity: &Identity) -> Result<Option<RouterFilter>, NodeError> {
    let mut any = false;
    let (mut written, mut nodes) = (Vec::new(), BTreeSet::new());
    for url in routers {
        let RouterUrl::Mdns(node) = url else { continue };
        written.push(url.to_string());
        match node {
            None => any = true,
            Some(node) => {
                let id = identity.node_id_of(node.as_str());
                nodes.insert(id.ok_or_else(|| NodeError::NamelessIdentity { node: node.to_string() })?);
            }
        }
    }
    let nodes = (!any).then(|| Arc::new(nodes));
    Ok((!written.is_empty()).then(|| RouterFilter { written: written.join(", "), nodes }))
}

/// Returns the path of the status socket: as configured, or in the user's runtime directory.
pub fn admin_socket_path(config: &Config, node: &str) -> PathBuf {
    config.admin_socket.clone().unwrap_or_else(|| admin::default_socket_path(node))
}

/// Runs a node until `shutdown` is ready. Then it withdraws its names, drains its queues and returns.
pub async fn run(
    config: Config,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let identity = Arc::new(check_identity(&config)?);
    if let Some(alert) = clock_alert(&identity, now().unix) {
        warn!("{alert}; this node starts all the same and waits: {}", alert.fix());
    }
    let left = Duration::from_millis(identity.not_after().0.saturating_sub(now().unix.0));
    if left < EXPIRY_WARNING {
        warn!(
            "this node's certificate ends in {} days, at {}: enroll it again before then, or nobody will let it in",
            left.as_secs() / 86_400,
            identity.not_after()
        );
    }
    let (opener, runtime) = (identity.clone(), tokio::runtime::Handle::current());
    let is_watched = AtomicBool::new(false);
    let open: OpenNetwork<CycloneNetwork> = Arc::new(move |ros| {
        let config = dds_config(ros, &opener);
        // The gateway is an ordinary participant. The node's own participant sees its topics like any program's.
        let of_gateway = DdsConfig { tag: None, ..config.clone() };
        let gateway: OpenLocalRos = Arc::new(move || {
            CycloneNetwork::open(&of_gateway).map(|network| Arc::new(network) as Arc<dyn LocalRos>)
        });
        let network = Arc::new(CycloneNetwork::open(&config)?);
        if !is_watched.swap(true, Ordering::Relaxed) {
            runtime.spawn(discovery_server::watch());
            runtime.spawn(strangers::watch());
        }
        Ok((network, Some(gateway)))
    });
    run_opening(config, identity, open, options, shutdown).await
}

/// Opens the local network of a configuration, and the gateway's part of it. May block.
pub type OpenNetwork<N> =
    Arc<dyn Fn(&RosConfig) -> Result<(Arc<N>, Option<OpenLocalRos>), RosError> + Send + Sync>;

/// Runs a node with a given identity. `open` is called at start if the configuration wants a local network, else at the
/// first reload that does.
pub async fn run_opening<N: RosNetwork>(
    config: Config,
    identity: Arc<Identity>,
    open: OpenNetwork<N>,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let (network, gateway) = config.ros.as_ref().map(|ros| open(ros)).transpose()?.unzip();
    let options = RunOptions { gateway: gateway.flatten().or(options.gateway), ..options };
    run_with(config, identity, network, Some(open), options, shutdown).await
}

/// Runs a node with a given identity and local network.
pub async fn run_on<N: RosNetwork>(
    config: Config,
    identity: Arc<Identity>,
    network: Option<Arc<N>>,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    run_with(config, identity, network, None, options, shutdown).await
}

async fn run_with<N: RosNetwork>(
    config: Config,
    identity: Arc<Identity>,
    network: Option<Arc<N>>,
    open: Option<OpenNetwork<N>>,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let file_watch = options.file.filter(|_| config.watch).map(|file| FileWatch::begin(file, &config));
    let state = state_dir(&config, identity.node_name().as_str())?;
    let mut shutdown = std::pin::pin!(shutdown);
    let run_lock = tokio::select! {
        taken = RunLock::take(&config.identity, state.as_deref(), identity.node_id()) => {
            taken.map_err(|source| NodeError::IdentityInUse { path: config.identity.clone(), source })?
        }
        () = &mut shutdown => return Ok(()),
    };
    let rules = Rules::load(&config, &identity, state.as_deref(), now().unix)?;
    config.warnings().iter().chain(&rules.warnings).for_each(|warning| warn!("{warning}"));
    let (audit, audit_writer) = open_audit(&config, state.as_deref(), &rules)?;
    let transport = Arc::new(TransportMetrics::default());
    let anchors = with_kept_crls(state.as_deref(), rules.partners.extend(&identity)?, now());
    let credentials = CredentialStore::new(identity.clone());
    credentials.set_anchors(anchors.clone());
    credentials.set_admitted(rules.partners.admitted.clone());
    let keep_alive_policy = config.keep_alive.map_or_else(KeepAlivePolicy::default, KeepAlivePolicy::fixed);
    let link_options = LinkOptions {
        post_quantum: identity.post_quantum(),
        // The transport's keep-alive matters only for peers that our keep-alive no longer probes.
        keep_alive: keep_alive_policy.max + KEEP_ALIVE_SLACK,
        idle_timeout: IDLE_TIMEOUT_MIN.max(keep_alive_policy.max * 5 / 2),
        congestion: config.transport.congestion,
        offload: config.transport.offload,
        mtu_discovery: config.transport.mtu_discovery,
        dtls12: config.transport.dtls12,
        dscp: config.transport.dscp,
        ..LinkOptions::default()
    };
    let listeners = config
        .listen
        .iter()
        .map(|addr| {
            Listener::bind(addr, credentials.clone(), link_options.clone(), transport.clone())
                .map_err(|source| NodeError::Listen { addr: addr.clone(), source })
        })
        .collect::<Result<Vec<_>, _>>()?;
    let listening: Vec<_> = listeners.iter().map(|l| l.local().clone()).collect();
    let dialer = Arc::new(Dialer::new(credentials.clone(), link_options.clone(), transport.clone()));
    // DSCP marks belong to sockets, so lanes with another mark need their own.
    let lane_dialer = match config.transport.lane_dscp {
        None => dialer.clone(),
        marked => {
            let options = LinkOptions { dscp: marked, ..link_options };
            Arc::new(Dialer::new(credentials.clone(), options, transport.clone()))
        }
    };

    let mut rng = system_rng()?;
    let started = now();
    let router_config = RouterConfig {
        node: identity.node_id(),
        identity: identity.clone(),
        transit: !config.listen.is_empty() && identity.as_peer().may_route,
        incarnation: rand_core::RngCore::next_u64(&mut rng),
        started: started.unix,
        mapping: config.mapping,
        anchors: Arc::new(anchors.clone()),
        limits: sgc_router::Limits::default(),
    };
    let router = Router::new(router_config, started);
    let endpoint_config = EndpointConfig {
        identity: identity.clone(),
        authority: config.authority.is_some(),
        operations: config.authority.as_ref().is_some_and(|a| !a.operators.is_empty()),
        limits: sgc_endpoint::Limits {
            rotate_every: config.rotation.every,
            ..sgc_endpoint::Limits::default()
        },
    };
    let mut endpoint = Endpoint::new(endpoint_config, ChaCha20Rng::from_rng(&mut rng), now());
    endpoint.set_anchors(now(), Arc::new(anchors));
    let routes = network.as_ref().and_then(|_| {
        let (shares, uses) = (rules.shares.clone(), rules.uses.clone());
        let mut followed = std::collections::BTreeSet::new();
        for rule in uses.iter().filter(|rule| rule.token.is_none()) {
            if followed.insert(rule.owner) {
                endpoint.follow(now(), &rule.owner_name);
            }
        }
        local_routes(&identity, shares, uses, &mut rng)
    });
    let again = open.as_ref().zip(config.ros.as_ref()).map(|(open, ros)| open_again(open, ros));
    let network = NetworkSlot::new(network, again);

    let definitions = Definitions::from_env(config.ros.as_ref().map_or(&[], |ros| &ros.definitions));
    let types = options.types.unwrap_or_default();
    let found = NodeDefinitions { files: definitions.clone(), described: types.clone() };
    let gateway = Gateway::new(options.gateway, identity.node_name().as_str(), found);
    if let Some(wanted) = &config.gateway {
        wanted.warnings().iter().for_each(|warning| warn!("{warning}"));
        let access = access_with(&config, &identity, &rules.partners, state.as_deref(), now())?;
        gateway
            .listen(Sockets {
                listen: listen_at(wanted),
                access: access.unwrap_or_default().with_refusal_listener(refused_tokens(audit.clone())),
                key: match key_of_files(wanted)? {
                    Some(key) => ShownKey::Files(key),
                    None => ShownKey::Own(identity.clone()),
                },
                clients_max: wanted.clients_max,
                client_bytes_max: wanted.client_bytes_max.try_into().unwrap_or(usize::MAX),
            })
            .await?;
    }

    let (events, inbox) = mpsc::channel(INBOX_MAX);
    // Every thread and blocking task that uses this runtime holds a clone of `alive`, since the runtime must outlive
    // them.
    let (alive, mut all_ended) = mpsc::channel(1);
    let (redial, on_redial) = watch::channel(());
    let wanted = rules.shares.clone();
    let made = tokio::task::spawn_blocking(move || message_keys::make_for(&wanted, |_| false)).await;
    let message_keys = made.map_err(|_| NodeError::Panicked)?;
    let suites = message_keys.keys().copied().collect();
    let board = Board::default();
    let claims = Claims::default();
    let (core, requested) = Core::new(CoreParts {
        types,
        definitions,
        member_names: rules.members.clone(),
        board: board.clone(),
        keep_alive_policy,
        message_keys,
        authority: config.authority.as_ref().map(|wanted| {
            let operators = grantees(&wanted.operators, &identity, &rules.partners);
            Authority::new(wanted.fleet.clone(), operators, identity.node_id())
        }),
        epoch_messages_max: config.rotation.messages,
        rates: PeerRates::new(config.peer_rate),
        keeper: StateWriter::spawn(state.clone(), config.identity.clone(), run_lock.clone(), alive.clone()),
        redial,
        alive,
        identity: identity.clone(),
        credentials: credentials.clone(),
        gateway: gateway.clone(),
        router,
        endpoint,
        routes,
        network: network.clone(),
        events: events.downgrade(),
        transport,
        audit: audit.clone(),
    });
    let core = tokio::spawn(core.run(inbox, requested));
    if let Some(network) = network.get() {
        let events = events.clone();
        let discover = move || discover(&*network, events);
        tokio::task::spawn_blocking(discover).await.map_err(|_| NodeError::Panicked)??;
    }
    let mut tasks: Vec<JoinHandle<()>> = Vec::new();
    let nearby = wanted_nearby(&config.routers, &identity)?;
    let announced = if config.announce { &listening[..] } else { &[] };
    let local = (nearby.is_some() || config.announce)
        .then(|| LocalNetwork::open(options.mdns_port, announced, &mut rng))
        .and_then(|opened| {
            let failed = |why| warn!("mDNS on the local network cannot be used: {why}");
            opened.map(Arc::new).map_err(failed).ok()
        });
    let keeper = LinkKeeper {
        me: identity.node_id(),
        dialer: dialer.clone(),
        lane_dialer: lane_dialer.clone(),
        dns: Dns::new(config.resolver),
        core: events.clone(),
        redial: on_redial,
        claims: claims.clone(),
        network: Network::watch(),
        urls: WorkingUrls::open(state.as_deref()),
    };
    let heard = local.clone().zip(nearby);
    tasks.extend(discovery::start(&config.routers, &rules.routers, &keeper, &board, heard, &mut rng));
    let lanes = LaneAdmission::default();
    let mut accepting = Vec::new();
    for listener in listeners {
        info!("listening on {}", listener.local());
        let (stop, stopped) = oneshot::channel();
        let admission = Admission {
            core: events.clone(),
            credentials: credentials.clone(),
            claims: claims.clone(),
            audit: audit.clone(),
            lanes: lanes.clone(),
        };
        accepting.push((tokio::spawn(keep_accepting(listener, admission, stopped)), stop));
    }
    let socket = admin_socket_path(&config, identity.node_name().as_str());
    tasks.push(tokio::spawn(reopening::watch(keeper.network.clone(), network.clone(), events.clone())));
    let join = open.map(|open| join_late(open, network.clone(), events.clone(), gateway.clone()));
    let reloader = Arc::new(Reloader {
        source: options.source,
        join,
        keeper,
        board,
        dialling: std::sync::Mutex::default(),
        identity: identity.clone(),
        credentials,
        state,
        audit: audit.clone(),
        events: events.clone(),
        has_ros: AtomicBool::new(network.get().is_some()),
        gateway: gateway.clone(),
        running: Mutex::new(Running { config, dialled: rules.routers.clone(), rules, suites }),
        changed: Notify::new(),
    });
    let expiring = reloader.clone();
    tasks.push(tokio::spawn(async move { expiring.watch_expiry().await }));
    if let Some(mut asked) = options.reload {
        let reloader = reloader.clone();
        tasks.push(tokio::spawn(async move {
            while asked.recv().await.is_some() {
                // The log has the error; nobody waits for the result.
                let _ = reloader.reload("SIGHUP").await;
            }
        }));
    }
    if let Some(watch) = file_watch {
        tasks.push(tokio::spawn(watch.run(reloader.clone())));
    }
    let desk = Desk { events: events.clone(), reloader: reloader.clone(), gateway: gateway.clone() };
    let socket = admin::begin(socket, desk);
    audit.write(AuditRecord::new(AuditEvent::Started).by(concat!("sgc ", env!("CARGO_PKG_VERSION"))));
    if let Some(ready) = options.ready {
        let _ = ready.send(listening);
    }

    shutdown.await;
    info!("stopping");
    if let Some(local) = &local {
        local.say_goodbye().await;
    }
    gateway.stop().await;
    let stop = async {
        let (reply, flows) = oneshot::channel();
        let _ = events.send(CoreEvent::Quiesce(reply)).await;
        let flows = flows.await.unwrap_or_default();
        let emptied = async {
            for flow in flows {
                flow.ended().await;
            }
        };
        if tokio::time::timeout(DRAIN_MAX, emptied).await.is_err() {
            warn!("some peers did not take everything in time");
        }
        let (reply, links) = oneshot::channel();
        let _ = events.send(CoreEvent::Stop(reply)).await;
        let links = links.await.unwrap_or_default();
        // A peer closes the link after the goodbye, which shows that it has received everything before.
        let closed = async {
            for link in links {
                link.closed().await;
            }
        };
        let _ = tokio::time::timeout(GOODBYE_MAX, closed).await;
    };
    stop.await;
    for task in tasks.into_iter().chain(reloader.take_dialling()) {
        task.abort();
    }
    // A successor may own the socket by the time it is removed.
    socket.abort();
    let _ = socket.await;
    for (task, stop) in accepting {
        let _ = stop.send(());
        let _ = task.await;
    }
    // If both are the same dialer, the second call does nothing.
    tokio::join!(dialer.close(CloseReason::Goodbye), lane_dialer.close(CloseReason::Goodbye));
    let _ = core.await;
    drop(reloader);
    if tokio::time::timeout(DRAIN_MAX, all_ended.recv()).await.is_err() {
        warn!("the local network did not take everything in time");
    }
    audit.write(AuditRecord::new(AuditEvent::Stopped));
    if let Some(writer) = audit_writer {
        let _ = tokio::task::spawn_blocking(move || writer.finish()).await;
    }
    // Closing ends discovery and waits for its threads. The runtime waits for the rest.
    if let Some(network) = network.take() {
        let _ = tokio::task::spawn_blocking(move || drop(network)).await;
    }
    drop(run_lock);
    Ok(())
}

/// Returns the route machine of a member. A router's identity has none.
fn local_routes(
    identity: &Identity,
    shares: Vec<ShareRule>,
    uses: Vec<UseRule>,
    rng: &mut ChaCha20Rng,
) -> Option<Routes<ChaCha20Rng>> {
    let oldest = identity.fleet_secret()?;
    let secret = identity.naming_secrets().first().map_or(oldest, |newest| &newest.secret);
    Some(Routes::new(secret.clone(), identity.node_id(), shares, uses, ChaCha20Rng::from_rng(rng)))
}

/// Starts discovery, whose events go to the control task.
pub(crate) fn discover<N: RosNetwork>(network: &N, events: mpsc::Sender<CoreEvent>) -> Result<(), RosError> {
    network.discover(Box::new(move |event| {
        let _ = events.blocking_send(CoreEvent::Discovery(event));
    }))
}

/// Returns a function that opens the network of this configuration again. The gateway's part stays open.
fn open_again<N: RosNetwork>(open: &OpenNetwork<N>, ros: &RosConfig) -> OpenAgain<N> {
    let (open, ros) = (open.clone(), ros.clone());
    Arc::new(move || open(&ros).map(|(network, _)| network))
}

/// Returns a function that joins the local network later, for a node that began without one.
fn join_late<N: RosNetwork>(
    open: OpenNetwork<N>,
    network: NetworkSlot<N>,
    events: mpsc::Sender<CoreEvent>,
    gateway: Arc<Gateway>,
) -> JoinNetwork {
    Arc::new(move |ros, identity| {
        let mut rng = system_rng().map_err(|error| error.to_string())?;
        let routes = local_routes(identity, Vec::new(), Vec::new(), &mut rng);
        let routes = routes.ok_or_else(|| NodeError::RouterIdentity.to_string())?;
        let (opened, of_gateway) = open(ros).map_err(|error| error.to_string())?;
        network.set_again(open_again(&open, ros));
        network.put(opened.clone());
        gateway.set_local_network(of_gateway);
        // The event has to precede the discovered endpoints.
        let stopping = |_| "the node is stopping".to_owned();
        events.blocking_send(CoreEvent::NetworkJoined(Box::new(routes))).map_err(stopping)?;
        discover(&*opened, events.clone()).map_err(|error| error.to_string())
    })
}

/// Returns the state directory and creates it if needed. A node whose user has no home runs without.
fn state_dir(config: &Config, node: &str) -> Result<Option<PathBuf>, NodeError> {
    let Some(dir) = state::state_dir(config, node) else {
        warn!("{}; until then nothing is kept, and there is no audit log", StateError::Nowhere);
        return Ok(None);
    };
    match state::create_state_dir(&dir) {
        Ok(()) => Ok(Some(dir)),
        Err(error @ StateError::Directory { .. }) if config.state.is_none() => {
            warn!("{error}; nothing is kept, and there is no audit log: set `state` in [node]");
            Ok(None)
        }
        Err(error) => Err(error.into()),
    }
}

fn open_audit(
    config: &Config,
    state: Option<&Path>,
    rules: &Rules,
) -> Result<(Audit, Option<AuditWriter>), NodeError> {
    let path = audit::audit_path(config.audit.file.as_deref(), state);
    let Some(path) = path.filter(|_| !config.audit.off) else { return Ok((Audit::default(), None)) };
    let (audit, writer) = Audit::open(&path, config.audit.room, rules.names.clone())
        .map_err(|source| NodeError::Audit { path, source })?;
    Ok((audit, Some(writer)))
}

fn system_rng() -> Result<ChaCha20Rng, NodeError> {
    let mut seed = [0; 32];
    OsRng.try_fill_bytes(&mut seed).map_err(|e| NodeError::Randomness(e.to_string()))?;
    Ok(ChaCha20Rng::from_seed(seed))
}

/// Returns the enclave that a configuration names.
pub fn enclave_of(config: &SecurityConfig) -> Security {
    Security { keystore: config.keystore.clone(), enclave: config.enclave.clone() }
}

fn dds_config(ros: &RosConfig, identity: &Identity) -> DdsConfig {
    let security = ros.security.as_ref().map(|security| (enclave_of(security), security.enforced));
    let security = security.filter(|(enclave, enforced)| match enclave.check() {
        Err(error) if !enforced && error.is_absence() => {
            warn!(
                "ROS_SECURITY_ENABLE is set and ROS_SECURITY_STRATEGY is not Enforce, so this node goes without DDS Security: {error}"
            );
            false
        }
        _ => true,
    });
    let security = security.map(|(enclave, _)| enclave);
    if let Some(key) = security.as_ref().and_then(Security::exposed_key) {
        warn!("{}: others can read it, and it is the private key of an enclave: chmod 600 it", key.display());
    }
    DdsConfig {
        domain: ros.domain_id,
        discovery: match ros.discovery {
            DiscoveryRange::Off => sgc_dds::DiscoveryRange::Off,
            DiscoveryRange::Localhost => sgc_dds::DiscoveryRange::LocalHost,
            DiscoveryRange::Subnet => sgc_dds::DiscoveryRange::Subnet,
            DiscoveryRange::SystemDefault => sgc_dds::DiscoveryRange::SystemDefault,
        },
        static_peers: ros.static_peers.clone(),
        tag: Some(identity.node_name().to_string()),
        graph: ros.graph,
        cyclonedds_uri: ros.cyclonedds_uri.clone(),
        security,
    }
}
