//! [`StateStorage`]: the state directory of a running node, and the reason why nothing can be written there.
//!
//! Writers report their own errors to the log. This module only decides whether the operator is alerted.

use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use sgc_config::Config;
use sgc_sync::lock;
use tracing::{info, warn};

use super::{StateError, create_state_dir, is_storage_fault, state_dir, storage_fault};
use crate::control::faults::alerts::Alert;

/// Interval of attempts while the directory cannot be written.
const RETRY_EVERY: Duration = Duration::from_secs(5);

/// The state directory of a node. Clones share the fault.
#[derive(Clone, Debug, Default)]
pub(crate) struct StateStorage {
    /// The directory; `None` if the node runs without.
    pub(crate) dir: Option<PathBuf>,
    fault: Arc<Mutex<Option<String>>>,
}

impl StateStorage {
    /// Opens the state directory and creates it if needed. A node whose user has no home, or whose disk is full or
    /// read-only, runs with what it can read.
    pub(crate) fn open(config: &Config, node: &str) -> Result<Self, StateError> {
        let Some(dir) = state_dir(config, node) else { return Ok(Self::faulty(None, &StateError::Nowhere)) };
        match create_state_dir(&dir) {
            Ok(()) => Ok(match storage_fault(&dir) {
                None => Self { dir: Some(dir), ..Self::default() },
                Some(error) => Self::faulty(Some(dir), &error),
            }),
            Err(StateError::Directory { path, source })
                if config.state.is_none() || is_storage_fault(&source) =>
            {
                Ok(Self::faulty(None, &StateError::Directory { path, source }))
            }
            Err(error) => Err(error),
        }
    }

    fn faulty(dir: Option<PathBuf>, error: &StateError) -> Self {
        let reason = error.to_string();
        warn!("nothing is kept over a restart: {reason}");
        Self { dir, fault: Arc::new(Mutex::new(Some(reason))) }
    }

    /// Returns an alert while nothing can be written.
    pub(crate) fn alert(&self) -> Option<Alert> {
        lock(&self.fault).clone().map(|reason| Alert::StateNotKept { reason })
    }

    /// Waits until an existing directory can be written, if it could not. Then clears the alert.
    pub(crate) async fn watch(self) {
        let Some(dir) = self.dir.clone() else { return };
        while lock(&self.fault).is_some() {
            tokio::time::sleep(RETRY_EVERY).await;
            let probed = dir.clone();
            if let Ok(None) = tokio::task::spawn_blocking(move || storage_fault(&probed)).await {
                info!(path = %dir.display(), "the state directory can be written again");
                *lock(&self.fault) = None;
            }
        }
    }
}
