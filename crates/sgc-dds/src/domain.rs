//! [`Domain`]: a domain of Cyclone for a ROS domain.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::sync::atomic::{AtomicU32, Ordering};

use cyclors::{DDS_RETCODE_PRECONDITION_NOT_MET, dds_create_domain};
use sgc_ros::RosError;

use crate::config::{
    DdsConfig, DiscoveryRange, HOST_ADDRESSES_MAX, Instance, PEERS_MAX, chooses_interfaces, cyclone_config,
    far_hosts, local_addresses,
};
use crate::entity::{Entity, c_string, reason};
use crate::files::read_file;
use crate::log;

/// First of Cyclone's domain ids for networks that share a ROS domain with another of this process; far
/// above every ROS domain id.
const ALIAS_FIRST: u32 = 0x5347_0000;

/// A port for route lookups, for which any would do: the first that a participant of domain 0 listens on (RTPS 2.5,
/// 9.6.2.3).
const DISCOVERY_PORT: u16 = 7410;

/// A Cyclone domain.
#[derive(Debug)]
pub(crate) struct Domain {
    pub(crate) entity: Entity,
    /// Cyclone's id of the domain.
    pub(crate) id: u32,
}

impl Domain {
    /// Creates the domain under the ROS domain's own id, so that `<Domain Id="…">` in the user's configuration
    /// applies. Uses another id if this process has that one already.
    pub(crate) fn create(config: &DdsConfig) -> Result<Self, RosError> {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let interfaces_chosen =
            config.cyclonedds_uri.as_deref().is_some_and(|uri| chooses_interfaces(uri, read_file));
        let host_addresses =
            local_addresses(&read_file("/proc/net/fib_trie").unwrap_or_default(), HOST_ADDRESSES_MAX);
        // With a single address there is no choice.
        let towards_peers =
            if host_addresses.len() > 1 { addresses_towards(&config.static_peers) } else { Vec::new() };
        let process = std::process::id();
        let mut instance =
            Instance { process, number, aliased: false, interfaces_chosen, host_addresses, towards_peers };
        let refused = |reason| RosError::Domain { domain: config.domain, reason };

        for (id, aliased) in [(config.domain, false), (ALIAS_FIRST.wrapping_add(number & 0x00ff_ffff), true)]
        {
            instance.aliased = aliased;
            let create = |instance: &Instance| {
                let xml = c_string(&cyclone_config(config, instance)?).map_err(refused)?;
                // SAFETY: the configuration is a NUL-terminated string, copied by the call.
                Ok::<_, RosError>(log::listen(|| unsafe { dds_create_domain(id, xml.as_ptr()) }))
            };
            let (mut handle, errors) = create(&instance)?;
            if handle == DDS_RETCODE_PRECONDITION_NOT_MET && !aliased {
                continue;
            }
            if handle < 0 && config.discovery == DiscoveryRange::Subnet && !instance.interfaces_chosen {
                // The interface may be down, for instance. Cyclone's own choice is better than none.
                instance.interfaces_chosen = true;
                (handle, _) = create(&instance)?;
            }
            if handle < 0 && !errors.is_empty() {
                return Err(refused(format!("{}: {errors}", reason(handle))));
            }
            let entity = Entity::new(handle).map_err(refused)?;
            return Ok(Self { entity, id });
        }
        Err(refused("the domain could not be created".into()))
    }

    /// Returns `true` if the id is not that of a ROS domain.
    pub(crate) fn is_alias(&self) -> bool {
        self.id >= ALIAS_FIRST
    }
}

/// Returns the addresses from which this host would reach the peers, by looking up routes without sending a packet.
fn addresses_towards(peers: &[String]) -> Vec<Ipv4Addr> {
    let mut found = Vec::new();
    for host in far_hosts(peers).take(PEERS_MAX) {
        let route = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0))
            .and_then(|socket| socket.connect((host, DISCOVERY_PORT)).and_then(|()| socket.local_addr()));
        if let Ok(SocketAddr::V4(address)) = route
            && !found.contains(address.ip())
        {
            found.push(*address.ip());
        }
    }
    found.retain(|address| !address.is_loopback());
    found
}
