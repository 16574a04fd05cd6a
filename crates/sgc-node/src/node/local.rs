//! The local ROS 2 network of a node: opens it at the start or at a reload.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng;
use sgc_config::{DiscoveryRange, RosConfig, SecurityConfig};
use sgc_dds::{DdsConfig, Security};
use sgc_gateway::LocalRos;
use sgc_ros::{RosError, RosNetwork, Routes, ShareRule, UseRule};
use sgc_trust::Identity;
use sgc_types::TypeStore;
use tokio::sync::mpsc;
use tracing::warn;

use crate::control::event::CoreEvent;
use crate::gateway::{Gateway, OpenLocalRos};
use crate::local::dds_discovery::discover;
use crate::local::middleware::{LocalNetwork, open_both};
use crate::local::network_slot::{JoinNetwork, NetworkSlot, OpenAgain};
use crate::local::{discovery_server, strangers, zenoh};
use crate::node::error::NodeError;
use crate::node::random::system_rng;

/// Opens the local network of a configuration, and the gateway's part of it. May block.
pub type OpenNetwork<N> =
    Arc<dyn Fn(&RosConfig) -> Result<(Arc<N>, Option<OpenLocalRos>), RosError> + Send + Sync>;

/// Returns a function that opens the networks of a configuration, under the name of this identity. `types` has the types
/// that the node knows.
pub(super) fn open_local(identity: Arc<Identity>, types: Arc<TypeStore>) -> OpenNetwork<LocalNetwork> {
    let runtime = tokio::runtime::Handle::current();
    let is_watched = AtomicBool::new(false);
    Arc::new(move |ros| {
        let dds = ros.middleware.has_dds().then(|| dds_config(ros, &identity));
        let zenoh = zenoh::config(ros, &types);
        // The gateway is an ordinary program. The node's own participant sees its topics like any program's.
        let of_gateway =
            (dds.clone().map(|dds| DdsConfig { tag: None, ..dds }), zenoh.clone().map(zenoh::of_program));
        let gateway: OpenLocalRos = Arc::new(move || {
            let (dds, zenoh) = &of_gateway;
            open_both(dds.as_ref(), zenoh.as_ref()).map(|network| Arc::new(network) as Arc<dyn LocalRos>)
        });
        let network = Arc::new(open_both(dds.as_ref(), zenoh.as_ref())?);
        if dds.is_some() && !is_watched.swap(true, Ordering::Relaxed) {
            runtime.spawn(discovery_server::watch());
            runtime.spawn(strangers::watch());
        }
        if ros.middleware.has_zenoh() {
            runtime.spawn(zenoh::watch(Arc::downgrade(&network), ros.zenoh.router_check));
        }
        Ok((network, Some(gateway)))
    })
}

/// Returns the route machine of a member. A router's identity has none.
pub(super) fn local_routes(
    identity: &Identity,
    shares: Vec<ShareRule>,
    uses: Vec<UseRule>,
    rng: &mut ChaCha20Rng,
) -> Option<Routes<ChaCha20Rng>> {
    let oldest = identity.fleet_secret()?;
    let secret = identity.naming_secrets().first().map_or(oldest, |newest| &newest.secret);
    Some(Routes::new(secret.clone(), identity.node_id(), shares, uses, ChaCha20Rng::from_rng(rng)))
}

/// Returns a function that opens the network of this configuration again. The gateway opens its part itself.
pub(super) fn open_again<N: RosNetwork>(open: &OpenNetwork<N>, ros: &RosConfig) -> OpenAgain<N> {
    let (open, ros) = (open.clone(), ros.clone());
    Arc::new(move || open(&ros).map(|(network, _)| network))
}

/// Returns a function that joins the local network later, for a node that began without one.
pub(super) fn join_late<N: RosNetwork>(
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
