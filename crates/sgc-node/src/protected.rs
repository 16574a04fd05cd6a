//! Programs of the local ROS 2 network that DDS Security (SROS2) protects against this node. Decides nothing: what is found is said.

use std::collections::BTreeSet;
use std::time::Duration;

use tracing::warn;

use crate::alerts::Alert;

/// Bound on enclaves that are logged.
const LOGGED_MAX: usize = 64;
/// Time between two looks of a node.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// Returns an alert for each enclave of programs that announce themselves and none of their topics.
pub(crate) fn alerts() -> impl Iterator<Item = Alert> {
    sgc_dds::silent_enclaves().into_iter().map(|enclave| Alert::ProtectedPrograms { enclave })
}

/// Looks again and again, and logs each enclave once. Ends with the runtime.
pub(crate) async fn watch() {
    let mut known = BTreeSet::new();
    loop {
        for alert in alerts() {
            if let Alert::ProtectedPrograms { enclave } = &alert
                && known.len() < LOGGED_MAX
                && known.insert(enclave.clone())
            {
                warn!("{alert}; {}", alert.fix());
            }
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
