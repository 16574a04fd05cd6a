//! A node from configuration to clean shutdown, in three steps: `build` makes machines and binds sockets, `spawn`
//! starts the tasks, `drain` empties and ends them.

pub(crate) mod build;
mod drain;
pub(crate) mod error;
pub(crate) mod identity;
mod local;
mod options;
pub(crate) mod random;
mod spawn;

use std::sync::Arc;
use std::time::Duration;

use sgc_config::Config;
use sgc_ros::RosNetwork;
use sgc_trust::Identity;
use sgc_wire::UnixMillis;
use tracing::{info, warn};

pub use self::error::NodeError;
use self::identity::check_startable;
pub use self::identity::{check_identity, load_identity};
pub use self::local::{OpenNetwork, enclave_of};
pub use self::options::{RunOptions, Watchdog, admin_socket_path};
use crate::clock::now;
use crate::control::faults::alerts::clock_alert;
use crate::control::settings::file_watch::FileWatch;
use crate::state::run_lock::RunLock;
use crate::state::storage::StateStorage;

/// Time before its certificate's end at which a node starts to warn.
const EXPIRY_WARNING: Duration = Duration::from_secs(14 * 86_400);

/// Returns a warning if the certificate of an identity ends soon.
pub fn expiry_warning(identity: &Identity, at: UnixMillis) -> Option<String> {
    let left = Duration::from_millis(identity.not_after().0.saturating_sub(at.0));
    (left < EXPIRY_WARNING).then(|| {
        format!(
            "this node's certificate ends in {} days, at {}: enroll it again before then, or nobody will let it in",
            left.as_secs() / 86_400,
            identity.not_after()
        )
    })
}

/// Runs a node until `shutdown` is ready. Then it withdraws its names, drains its queues and returns.
pub async fn run(
    config: Config,
    mut options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let identity = Arc::new(check_startable(&config)?);
    if let Some(alert) = clock_alert(&identity, now().unix) {
        warn!("{alert}; this node starts all the same and waits: {}", alert.fix());
    } else if let Some(warning) = expiry_warning(&identity, now().unix) {
        warn!("{warning}");
    }
    let types = options.types.get_or_insert_default().clone();
    let open = local::open_local(identity.clone(), types);
    run_opening(config, identity, open, options, shutdown).await
}

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
    mut options: RunOptions,
    shutdown: impl Future<Output = ()> + Send,
) -> Result<(), NodeError> {
    let watched = options.file.clone().filter(|_| config.watch);
    let file_watch = watched.map(|file| FileWatch::begin(file, &config));
    let storage = StateStorage::open(&config, identity.node_name().as_str())?;
    let mut shutdown = std::pin::pin!(shutdown);
    let run_lock = tokio::select! {
        taken = RunLock::take(&config.identity, storage.dir.as_deref(), identity.node_id()) => {
            taken.map_err(|source| NodeError::IdentityInUse { path: config.identity.clone(), source })?
        }
        () = &mut shutdown => return Ok(()),
    };
    let parts = build::NodeParts { config, identity, network, open, storage: storage.clone(), run_lock };
    let node = build::build(parts, options.gateway.take(), options.types.take()).await?;
    let watching = tokio::spawn(storage.watch());
    let running = spawn::spawn(node, options, file_watch).await?;
    shutdown.await;
    watching.abort();
    info!("stopping");
    running.drain().await;
    Ok(())
}
