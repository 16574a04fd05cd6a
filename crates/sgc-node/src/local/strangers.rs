//! Detects programs of the local ROS 2 network that this node cannot join. It reports them and decides nothing.

use std::collections::BTreeSet;
use std::time::Duration;

use sgc_dds::{Barrier, Strangers};
use tracing::warn;

use crate::control::faults::alerts::Alert;

/// Most alerts that are logged.
const LOGGED_MAX: usize = 64;
/// Interval of looks.
const LOOK_EVERY: Duration = Duration::from_secs(2);

/// Returns an alert for each group of programs that cannot be joined for the same reason, and one if this host has no
/// address by which programs of other hosts could be joined.
pub(crate) fn alerts() -> impl Iterator<Item = Alert> {
    let alone = sgc_dds::is_alone().then_some(Alert::LocalNetworkAlone);
    sgc_dds::strangers().into_iter().map(alert).chain(alone)
}

fn alert(strangers: Strangers) -> Alert {
    let Strangers { barrier, enclave, programs } = strangers;
    let enclave = enclave.unwrap_or_else(|| "/".to_owned());
    match barrier {
        Barrier::Protected => Alert::ProtectedPrograms { enclave },
        Barrier::Refused => Alert::RefusedPrograms { enclave },
        Barrier::Silent => Alert::SilentPrograms { enclave },
        Barrier::Unprotected => Alert::UnprotectedPrograms { programs },
    }
}

/// Looks periodically and logs each alert once. Ends with the runtime.
pub(crate) async fn watch() {
    let mut known = BTreeSet::new();
    loop {
        for alert in alerts() {
            let said = alert.to_string();
            if known.len() < LOGGED_MAX && known.insert(said) {
                warn!("{alert}; {}", alert.fix());
            }
        }
        tokio::time::sleep(LOOK_EVERY).await;
    }
}
