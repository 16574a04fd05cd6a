//! The local network of rmw_zenoh: its settings, and the watch over its router.

use std::sync::{Arc, Weak};
use std::time::Duration;

use sgc_config::{RosConfig, RouterCheck};
use sgc_ros::RosNetwork;
use sgc_types::TypeStore;
use tracing::{info, warn};

use crate::control::faults::alerts::Alert;

#[cfg(feature = "zenoh")]
pub(crate) use sgc_zenoh_network::ZenohConfig;

/// Stands in for the settings of a network that this build does not have.
#[cfg(not(feature = "zenoh"))]
#[derive(Clone)]
pub(crate) enum ZenohConfig {}

/// Interval of looks for the router.
const LOOK_EVERY: Duration = Duration::from_secs(1);
/// Interval of repeated reports that the router is missing.
const REPORT_EVERY: Duration = Duration::from_secs(60);

/// Returns the settings of the proxy's session, if the configuration wants one.
#[cfg(feature = "zenoh")]
pub(crate) fn config(ros: &RosConfig, types: &Arc<TypeStore>) -> Option<ZenohConfig> {
    let definitions = sgc_types::Definitions::from_env(&ros.definitions);
    let types = Arc::clone(types);
    ros.middleware.has_zenoh().then(|| ZenohConfig {
        domain: ros.domain_id,
        file: ros.zenoh.config.clone(),
        overrides: ros.zenoh.overrides.clone(),
        router: ros.zenoh.router.clone(),
        without_router: ros.zenoh.router_check == RouterCheck::Off,
        is_proxy: true,
        graph: ros.graph,
        service_hash: Some(Arc::new(move |name, announced| {
            service_hash(name, announced, &types, &definitions)
        })),
    })
}

/// Returns nothing: this build has no such network.
#[cfg(not(feature = "zenoh"))]
pub(crate) fn config(_ros: &RosConfig, _types: &Arc<TypeStore>) -> Option<ZenohConfig> {
    None
}

/// Returns the settings of an ordinary program's session.
pub(crate) fn of_program(config: ZenohConfig) -> ZenohConfig {
    #[cfg(feature = "zenoh")]
    let config = ZenohConfig { is_proxy: false, ..config };
    config
}

/// Returns the hash of a service as a whole, from the hash that an endpoint announced for it or for one of its messages.
/// Reads files.
#[cfg(feature = "zenoh")]
fn service_hash(
    name: &str,
    announced: &str,
    types: &TypeStore,
    definitions: &sgc_types::Definitions,
) -> Option<String> {
    let name = name.parse().ok()?;
    let described = types.described(&name, Some(announced));
    if let Some(known) = described {
        return Some(known.type_hash().to_owned());
    }
    let found = sgc_types::ResolvedType::from_layout(definitions.layout(&name).ok()?).ok()?;
    found.is_announced_as(announced).then(|| found.type_hash().to_owned())
}

/// Reports that the router is missing, and that it is there. Ends with the network.
pub(crate) async fn watch<N: RosNetwork>(network: Weak<N>, check: RouterCheck) {
    let patience = match check {
        RouterCheck::Off => return,
        RouterCheck::After(patience) => patience,
        RouterCheck::Repeated => LOOK_EVERY,
    };
    let (mut missing, mut reported) = (Duration::ZERO, None);
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let Some(router) = network.upgrade().map(|network| network.missing_router()) else { return };
        let Some(router) = router else {
            if reported.take().is_some() {
                info!("the Zenoh router is connected");
            }
            missing = Duration::ZERO;
            continue;
        };
        missing += LOOK_EVERY;
        let is_due = match reported {
            None => missing >= patience,
            Some(at) => check == RouterCheck::Repeated && missing - at >= REPORT_EVERY,
        };
        if is_due {
            reported = Some(missing);
            let alert = Alert::ZenohRouterMissing { router };
            warn!("{alert}; {}", alert.fix());
        }
    }
}
