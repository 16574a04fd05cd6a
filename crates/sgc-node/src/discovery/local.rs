//! mDNS on the local network (RFC 6762, 6763): announces a router here and hears of others.
//!
//! An announcement holds a random name, which is another at each start, the port, and its version. It holds nothing of
//! fleet, node, topics or host name. Announcements of others are passed on unjudged; `candidates` judges them.

use std::collections::BTreeSet;
use std::net::{IpAddr, SocketAddr, SocketAddrV6};
use std::time::Duration;

use mdns_sd::{
    DaemonEvent, Error, MDNS_PORT, Receiver, ResolvedService, ScopedIp, ServiceDaemon, ServiceEvent,
    ServiceInfo,
};
use rand_chacha::ChaCha20Rng;
use rand_core::RngCore;
use sgc_transport::ListenAddr;
use tokio::time::timeout;
use tracing::{debug, warn};

/// Service type of routers.
pub(crate) const SERVICE: &str = "_sgc._udp.local.";
/// Key and value of the announcement's version.
const VERSION_KEY: &str = "v";
const VERSION: &str = "1";
/// Time for withdrawing an announcement.
const GOODBYE_MAX: Duration = Duration::from_millis(500);

/// News about a router on the local network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Sighting {
    /// A router announces itself.
    Announced {
        /// Its name in mDNS.
        instance: String,
        /// Its announced addresses.
        addresses: Vec<SocketAddr>,
    },
    /// The announcement is not understood.
    Unknown,
    /// A router withdraws its announcement, or did not repeat it in time.
    Vanished {
        /// Its name in mDNS.
        instance: String,
    },
}

/// This node's mDNS daemon. Dropping it ends the announcement.
pub(crate) struct LocalNetwork {
    daemon: ServiceDaemon,
    /// Names that this node announced, so that it ignores itself.
    own: BTreeSet<String>,
}

impl LocalNetwork {
    /// Starts the daemon and announces a router at these addresses, if there are any. `port` overrides mDNS's own in
    /// tests.
    pub(crate) fn open(
        port: Option<u16>,
        announce: &[ListenAddr],
        rng: &mut ChaCha20Rng,
    ) -> Result<Self, Error> {
        let daemon = ServiceDaemon::new_with_port(port.unwrap_or(MDNS_PORT))?;
        let mut local = Self { daemon, own: BTreeSet::new() };
        if let Ok(events) = local.daemon.monitor() {
            tokio::spawn(log_errors(events));
        }
        for addr in announce {
            let info = announcement(addr, rng)?;
            local.own.insert(info.get_fullname().to_owned());
            local.daemon.register(info)?;
        }
        Ok(local)
    }

    /// Starts to listen for announcements.
    pub(crate) fn browse(&self) -> Result<Receiver<ServiceEvent>, Error> {
        self.daemon.browse(SERVICE)
    }

    /// Stops to listen for announcements.
    pub(crate) fn stop_browsing(&self) {
        if let Err(error) = self.daemon.stop_browse(SERVICE) {
            debug!(%error, "mDNS goes on to listen");
        }
    }

    /// Returns the news in an event, if it is about another router.
    pub(crate) fn heard(&self, event: ServiceEvent) -> Option<Sighting> {
        match event {
            ServiceEvent::ServiceResolved(service) => {
                let is_own = self.own.contains(service.get_fullname());
                (!is_own).then(|| announced(&service))
            }
            ServiceEvent::ServiceRemoved(_, instance) => Some(Sighting::Vanished { instance }),
            _ => None,
        }
    }

    /// Withdraws the announcement, so that nobody dials any more.
    pub(crate) async fn say_goodbye(&self) {
        let told: Vec<_> = self.own.iter().filter_map(|name| self.daemon.unregister(name).ok()).collect();
        for done in told {
            let _ = timeout(GOODBYE_MAX, done.recv_async()).await;
        }
    }
}

impl Drop for LocalNetwork {
    fn drop(&mut self) {
        // The daemon's thread lives until it is shut down.
        let _ = self.daemon.shutdown();
    }
}

async fn log_errors(events: Receiver<DaemonEvent>) {
    let mut is_said = false;
    while let Ok(event) = events.recv_async().await {
        if let DaemonEvent::Error(error) = event {
            if !std::mem::replace(&mut is_said, true) {
                warn!("mDNS on the local network: {error}");
            } else {
                debug!("mDNS on the local network: {error}");
            }
        }
    }
}

fn announcement(addr: &ListenAddr, rng: &mut ChaCha20Rng) -> Result<ServiceInfo, Error> {
    let name = format!("{:016x}{:016x}", rng.next_u64(), rng.next_u64());
    let host = format!("{name}.local.");
    let properties = [(VERSION_KEY, VERSION)];
    let (ip, port) = (addr.addr.ip(), addr.addr.port());
    if ip.is_unspecified() {
        // The library fills in the machine's addresses and keeps them current.
        let info = ServiceInfo::new(SERVICE, &name, &host, "", port, &properties[..])?;
        return Ok(info.enable_addr_auto());
    }
    ServiceInfo::new(SERVICE, &name, &host, ip, port, &properties[..])
}

fn announced(service: &ResolvedService) -> Sighting {
    if service.get_property_val_str(VERSION_KEY) != Some(VERSION) {
        return Sighting::Unknown;
    }
    let port = service.get_port();
    let address = |ip: &ScopedIp| match ip {
        ScopedIp::V6(v6) if v6.addr().is_unicast_link_local() => {
            SocketAddrV6::new(*v6.addr(), port, 0, v6.scope_id().index).into()
        }
        ip => SocketAddr::new(IpAddr::to_canonical(&ip.to_ip_addr()), port),
    };
    let addresses = service.get_addresses().iter().map(address).collect();
    Sighting::Announced { instance: service.get_fullname().to_owned(), addresses }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use rand_core::SeedableRng as _;

    use super::*;

    #[test]
    fn an_announcement_tells_port_and_version_under_a_name_that_is_never_the_same() {
        let mut rng = ChaCha20Rng::seed_from_u64(1);
        let addr: ListenAddr = "quic://0.0.0.0:7000".parse().unwrap();
        let (one, two) = (announcement(&addr, &mut rng).unwrap(), announcement(&addr, &mut rng).unwrap());
        assert!(one.is_addr_auto() && one.get_port() == 7000);
        let told: Vec<_> = one.get_properties().iter().map(|p| (p.key(), p.val_str())).collect();
        assert_eq!(told, [("v", "1")]);
        assert_ne!(one.get_fullname(), two.get_fullname());
        let label = one.get_fullname().strip_suffix("._sgc._udp.local.").unwrap();
        assert!(label.len() == 32 && label.bytes().all(|b| b.is_ascii_hexdigit()), "{label}");
        assert_eq!(one.get_hostname(), format!("{label}.local."));
        let fixed = announcement(&"quic://10.0.0.7:7000".parse().unwrap(), &mut rng).unwrap();
        assert!(!fixed.is_addr_auto());
        assert_eq!(fixed.get_addresses().iter().copied().collect::<Vec<_>>(), [IpAddr::from([10, 0, 0, 7])]);
    }
}
