//! Options of a running node beside its configuration.

use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use sgc_config::Config;
use sgc_transport::ListenAddr;
use sgc_types::TypeStore;
use tokio::sync::{mpsc, oneshot};

use crate::admin;
use crate::control::settings::reload::ConfigSource;
use crate::gateway::OpenLocalRos;

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
    /// Watchdog that the control task feeds.
    pub watchdog: Option<Watchdog>,
    /// The program and its version, as the log and the audit log name it; without it, `sgc` and the version of this
    /// crate.
    pub program: Option<String>,
    /// Opens the gateway's part of the local network. [`run`](crate::run) sets it by itself.
    pub gateway: Option<OpenLocalRos>,
}

/// A watchdog: it has to be fed from time to time, or it ends the process.
pub struct Watchdog {
    /// Interval of feeding.
    pub every: Duration,
    /// Feeds it. Called only after the control task has answered, so a node that hangs does not feed it.
    pub feed: Box<dyn Fn() + Send + Sync>,
}

/// Returns the path of the status socket: as configured, or in the user's runtime directory.
pub fn admin_socket_path(config: &Config, node: &str) -> PathBuf {
    config.admin_socket.clone().unwrap_or_else(|| admin::default_socket_path(node))
}
