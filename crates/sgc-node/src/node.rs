//! A node from configuration to clean shutdown: wires machines, sockets and the local network, and takes them
//! apart again.

use std::fs;
use std::io;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng, TryRngCore};
use sgc_dds::{CycloneNetwork, DdsConfig};
use sgc_endpoint::{Endpoint, EndpointConfig};
use sgc_ros::{Direction, RosError, RosNetwork, Routes, UseRule};
use sgc_router::{Router, RouterConfig};
use sgc_transport::{
    CloseReason, CredentialStore, Dialer, Link, LinkOptions, ListenAddr, Listener, TransportMetrics,
};
use sgc_trust::{Identity, IdentityError};
use tokio::io::AsyncWriteExt;
use tokio::net::UnixListener;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tracing::{info, warn};

use crate::config::{Config, DiscoveryRange, RosConfig, UseConfig};
use crate::core::{Core, CoreEvent, CoreParts, INBOX_MAX, now};
use crate::credentials::{Keeper, with_kept_crls};
use crate::links::{keep_accepting, keep_dialled};
use crate::partners::Partners;
use crate::policy;
use crate::state::{create_state_dir, state_dir};

/// How long queues may take to empty at shutdown.
const DRAIN_MAX: Duration = Duration::from_secs(2);
/// From how long before its certificate's end a node warns of it.
const EXPIRY_WARNING: Duration = Duration::from_secs(14 * 86_400);
/// How long peers may take to answer a goodbye.
const GOODBYE_MAX: Duration = Duration::from_secs(1);

/// Why a node does not start.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// The identity file could not be read.
    #[error("identity {}: {source}", path.display())]
    IdentityFile {
        /// The file.
        path: PathBuf,
        /// What the system said.
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
        /// What is wrong with it.
        source: IdentityError,
    },
    /// The configuration names another node than the identity.
    #[error(
        "`name` is {configured:?}, but the identity is of {certified:?}: use that node's identity file or change `name`"
    )]
    OtherName {
        /// Name in the configuration.
        configured: String,
        /// Name in the identity.
        certified: String,
    },
    /// The identity's certificate does not hold.
    #[error("identity {}: {source}", path.display())]
    Certificate {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: sgc_trust::CertError,
    },
    /// A router's identity cannot share or use.
    #[error(
        "this identity is a router's and holds no fleet secret: it can neither share nor use. Enroll the node without --router"
    )]
    RouterIdentity,
    /// A node that uses a topic of its own.
    #[error("[[use]] from {node:?}: that is this node itself")]
    UseOfOwn {
        /// The node.
        node: String,
    },
    /// An address could not be bound.
    #[error("cannot listen on {addr}: {source}")]
    Listen {
        /// The address.
        addr: ListenAddr,
        /// What the system said.
        source: io::Error,
    },
    /// The local network could not be joined.
    #[error(transparent)]
    Ros(#[from] RosError),
    /// The local network's threads did not start.
    #[error("joining the local network ended in a panic; this is a bug")]
    Panicked,
    /// The system gives no randomness.
    #[error("the system gives no randomness: {0}")]
    Randomness(String),
}

/// What else a caller may want of a running node.
#[derive(Default)]
pub struct RunOptions {
    /// Told the addresses that are listened on, once the node is up.
    pub ready: Option<oneshot::Sender<Vec<ListenAddr>>>,
}

/// Reads an identity file, which must be its owner's alone.
pub fn load_identity(path: &Path) -> Result<Identity, NodeError> {
    let file = |source| NodeError::IdentityFile { path: path.to_owned(), source };
    let mode = fs::metadata(path).map_err(file)?.permissions().mode() & 0o7777;
    if mode & 0o077 != 0 {
        return Err(NodeError::IdentityExposed { path: path.to_owned(), mode });
    }
    let text = zeroize::Zeroizing::new(fs::read_to_string(path).map_err(file)?);
    Identity::parse(&text).map_err(|source| NodeError::Identity { path: path.to_owned(), source })
}

/// Checks what [`run`] would need of the identity and binds nothing.
pub fn check_identity(config: &Config) -> Result<Identity, NodeError> {
    let identity = load_identity(&config.identity)?;
    let certified = identity.node_name().as_str();
    if let Some(configured) = config.node_name.as_ref().filter(|n| n.as_str() != certified) {
        return Err(NodeError::OtherName {
            configured: configured.to_string(),
            certified: certified.to_owned(),
        });
    }
    identity
        .anchors()
        .verify(identity.chain(), now().unix)
        .map_err(|source| NodeError::Certificate { path: config.identity.clone(), source })?;
    if identity.fleet_secret().is_none() && !(config.shares.is_empty() && config.uses.is_empty()) {
        return Err(NodeError::RouterIdentity);
    }
    if let Some(own) = config.uses.iter().find(|u| u.from.as_str() == certified) {
        return Err(NodeError::UseOfOwn { node: own.from.to_string() });
    }
    Ok(identity)
}

/// Where a node's status socket is: as configured, or in the user's runtime directory.
pub fn admin_socket_path(config: &Config, node: &str) -> PathBuf {
    config.admin_socket.clone().unwrap_or_else(|| default_socket_path(node))
}

/// Where the status socket of a node with this name is unless its configuration says otherwise.
pub fn default_socket_path(node: &str) -> PathBuf {
    let directory = match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(dir) if !dir.is_empty() => PathBuf::from(dir).join("sgc"),
        _ => std::env::temp_dir().join(format!("sgc-{}", rustix::process::getuid().as_raw())),
    };
    directory.join(format!("{node}.sock"))
}

/// Runs a node until `shutdown` is ready; then withdraws its names, lets its queues empty, and returns.
pub async fn run(
    config: Config,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let identity = Arc::new(check_identity(&config)?);
    let left = Duration::from_millis(identity.not_after().0.saturating_sub(now().unix.0));
    if left < EXPIRY_WARNING {
        warn!(
            "this node's certificate ends in {} days, at {}: enroll it again before then, or nobody will let it in",
            left.as_secs() / 86_400,
            identity.not_after()
        );
    }
    let network = match &config.ros {
        Some(ros) => Some(Arc::new(CycloneNetwork::open(&dds_config(ros, &identity))?)),
        None => None,
    };
    run_on(config, identity, network, options, shutdown).await
}

/// [`run`] with an identity and a local network that are there already.
pub async fn run_on<N: RosNetwork>(
    config: Config,
    identity: Arc<Identity>,
    network: Option<Arc<N>>,
    options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let partners = Partners::default();
    let transport = Arc::new(TransportMetrics::default());
    let state = usable_state_dir(&config, identity.node_name().as_str());
    let anchors = with_kept_crls(state.as_deref(), identity.anchors().clone(), now());
    let credentials = CredentialStore::new(identity.clone());
    credentials.set_anchors(anchors.clone());
    let link_options = LinkOptions { post_quantum: identity.post_quantum(), ..LinkOptions::default() };
    let listeners = config
        .listen
        .iter()
        .map(|addr| {
            Listener::bind(addr, credentials.clone(), link_options.clone(), transport.clone())
                .map_err(|source| NodeError::Listen { addr: addr.clone(), source })
        })
        .collect::<Result<Vec<_>, _>>()?;
    let listening: Vec<_> = listeners.iter().map(|l| l.local().clone()).collect();
    let dialer = Arc::new(Dialer::new(credentials.clone(), link_options, transport.clone()));

    let mut rng = system_rng()?;
    let router = Router::new(RouterConfig {
        node: identity.node_id(),
        transit: !config.listen.is_empty() && identity.as_peer().may_route,
        incarnation: rand_core::RngCore::next_u64(&mut rng),
        anchors: Arc::new(anchors.clone()),
        limits: sgc_router::Limits::default(),
    });
    let endpoint_config = EndpointConfig {
        identity: identity.clone(),
        authority: config.authority.is_some(),
        limits: sgc_endpoint::Limits {
            rotate_every: config.rotation.every,
            ..sgc_endpoint::Limits::default()
        },
    };
    let mut endpoint = Endpoint::new(endpoint_config, ChaCha20Rng::from_rng(&mut rng), now());
    endpoint.set_anchors(now(), Arc::new(anchors));
    let routes = identity.fleet_secret().zip(network.as_ref()).map(|(secret, _)| {
        let shares = config.shares.iter().map(|s| policy::share_rule(s, &identity, &partners)).collect();
        let uses: Vec<_> = config.uses.iter().filter_map(|u| use_rule(u, &identity)).collect();
        let mut followed = std::collections::BTreeSet::new();
        for rule in &uses {
            if followed.insert(rule.owner) {
                endpoint.follow(now(), &rule.owner_name);
            }
        }
        let secret = identity.naming_secrets().first().map_or(secret, |newest| &newest.secret);
        Routes::new(secret.clone(), identity.node_id(), shares, uses, ChaCha20Rng::from_rng(&mut rng))
    });

    let (events, inbox) = mpsc::channel(INBOX_MAX);
    // Every thread and blocking task that uses this runtime holds a clone; it must outlive them all.
    let (alive, mut all_ended) = mpsc::channel(1);
    let (redial, on_redial) = watch::channel(());
    let (core, requested) = Core::new(CoreParts {
        authority: config.authority.clone(),
        epoch_messages_max: config.rotation.messages,
        keeper: Keeper::spawn(state, config.identity.clone(), alive.clone()),
        redial,
        alive,
        identity: identity.clone(),
        credentials,
        router,
        endpoint,
        routes,
        network: network.clone(),
        events: events.downgrade(),
        transport,
    });
    let core = tokio::spawn(core.run(inbox, requested));
    if let Some(network) = network.clone() {
        let events = events.clone();
        let discover = move || {
            network.discover(Box::new(move |event| {
                let _ = events.blocking_send(CoreEvent::Discovery(event));
            }))
        };
        tokio::task::spawn_blocking(discover).await.map_err(|_| NodeError::Panicked)??;
    }
    let mut tasks: Vec<JoinHandle<()>> = Vec::new();
    for url in &config.routers {
        tasks.push(tokio::spawn(keep_dialled(
            url.clone(),
            dialer.clone(),
            events.clone(),
            on_redial.clone(),
        )));
    }
    let mut accepting = Vec::new();
    for listener in listeners {
        info!("listening on {}", listener.local());
        let (stop, stopped) = oneshot::channel();
        accepting.push((tokio::spawn(keep_accepting(listener, events.clone(), stopped)), stop));
    }
    let socket = admin_socket_path(&config, identity.node_name().as_str());
    match bind_socket(&socket) {
        Ok(listener) => tasks.push(tokio::spawn(serve_status(listener, events.clone()))),
        Err(error) => warn!(path = %socket.display(), %error, "no status socket"),
    }
    if let Some(ready) = options.ready {
        let _ = ready.send(listening);
    }

    shutdown.await;
    info!("stopping");
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
        // A peer that got the goodbye closes the link: then it has got everything before it, too.
        let closed = async {
            for link in links {
                link.closed().await;
            }
        };
        let _ = tokio::time::timeout(GOODBYE_MAX, closed).await;
    };
    stop.await;
    for task in tasks {
        task.abort();
    }
    for (task, stop) in accepting {
        let _ = stop.send(());
        let _ = task.await;
    }
    dialer.close(CloseReason::Goodbye).await;
    let _ = core.await;
    if tokio::time::timeout(DRAIN_MAX, all_ended.recv()).await.is_err() {
        warn!("the local network did not take everything in time");
    }
    let _ = fs::remove_file(&socket);
    // Ends discovery, and waits for its threads; the runtime waits for the rest.
    if let Some(network) = network {
        let _ = tokio::task::spawn_blocking(move || drop(network)).await;
    }
    Ok(())
}

/// The state directory, made if need be; `None`, and said, if it cannot be used: then nothing is remembered.
fn usable_state_dir(config: &Config, node: &str) -> Option<PathBuf> {
    let dir = state_dir(config, node);
    let Some(dir) = dir else {
        warn!("no state directory: set `state` in [node]; revocations are forgotten with each restart");
        return None;
    };
    match create_state_dir(&dir) {
        Ok(()) => Some(dir),
        Err(error) => {
            warn!(%error, "the state directory cannot be used; revocations are forgotten with each restart");
            None
        }
    }
}

fn system_rng() -> Result<ChaCha20Rng, NodeError> {
    let mut seed = [0; 32];
    OsRng.try_fill_bytes(&mut seed).map_err(|e| NodeError::Randomness(e.to_string()))?;
    Ok(ChaCha20Rng::from_seed(seed))
}

fn dds_config(ros: &RosConfig, identity: &Identity) -> DdsConfig {
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
        cyclonedds_uri: ros.cyclonedds_uri.clone(),
    }
}

fn use_rule(rule: &UseConfig, identity: &Identity) -> Option<UseRule> {
    Some(UseRule {
        direction: Direction::Bring,
        owner: identity.node_id_of(rule.from.as_str())?,
        owner_name: rule.from.to_string(),
        topic: rule.topic.clone(),
        type_name: rule.type_name.clone(),
        token: None,
    })
}

/// Binds the status socket for this user alone. One that a dead node left is replaced, a live one is not.
fn bind_socket(path: &Path) -> io::Result<UnixListener> {
    if let Some(directory) = path.parent() {
        fs::DirBuilder::new().recursive(true).mode(0o700).create(directory)?;
    }
    if std::os::unix::net::UnixStream::connect(path).is_ok() {
        return Err(io::Error::new(io::ErrorKind::AddrInUse, "another node answers there"));
    }
    match fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let listener = UnixListener::bind(path)?;
    fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
    Ok(listener)
}

async fn serve_status(listener: UnixListener, events: mpsc::Sender<CoreEvent>) {
    while let Ok((mut stream, _)) = listener.accept().await {
        let (reply, status) = oneshot::channel();
        if events.send(CoreEvent::Status(reply)).await.is_err() {
            return;
        }
        if let Ok(status) = status.await
            && let Ok(text) = serde_json::to_vec(&status)
        {
            // One at a time and bounded: a reader that stalls delays the next status, nothing else.
            let write = async {
                stream.write_all(&text).await?;
                stream.shutdown().await
            };
            let _ = tokio::time::timeout(Duration::from_secs(2), write).await;
        }
    }
}
