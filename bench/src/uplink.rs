//! Two network namespaces joined by one bad path, the emulator of `sgc_testkit::netsim`.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::{Context, Result};
use sgc_testkit::netsim::{Namespace, Profile, TunEnd, TunLink, TunOptions};
use sgc_transport::LinkUrl;

/// All transports.
pub(crate) const SCHEMES: [&str; 7] = ["quic", "dtls", "udp", "tls", "tcp", "ws", "wss"];
/// The address of the far end.
pub(crate) const FAR: &str = "10.77.0.2";
/// The address of the near end.
pub(crate) const NEAR: &str = "10.77.0.1";
const MTU: u16 = 1500;
const SEED: u64 = 9;

static UPLINKS: AtomicU32 = AtomicU32::new(0);

/// Returns the transports that this build has.
pub(crate) fn known(schemes: &[String]) -> Vec<String> {
    let is_known = |scheme: &&String| format!("{scheme}://router").parse::<LinkUrl>().is_ok();
    let known: Vec<_> = schemes.iter().filter(is_known).cloned().collect();
    for scheme in schemes.iter().filter(|scheme| !known.contains(scheme)) {
        eprintln!("{scheme}:// is not in this build and is left out");
    }
    known
}

/// Two places and the path between them, until it is dropped.
pub(crate) struct Uplink {
    /// Dropped first, because its devices are in the namespaces.
    pub(crate) path: TunLink,
    pub(crate) near: Arc<Namespace>,
    pub(crate) far: Arc<Namespace>,
}

impl Uplink {
    /// Makes a path with these profiles from the near end and from the far one.
    pub(crate) fn new(profiles: [Profile; 2]) -> Result<Self> {
        let number = UPLINKS.fetch_add(1, Ordering::SeqCst);
        let make = |place: &str| {
            let name = format!("sgcbench-{}-{number}-{place}", std::process::id());
            Ok::<_, anyhow::Error>(Arc::new(Namespace::create(name)?))
        };
        let (near, far) = (make("near")?, make("far")?);
        let end = |namespace: &Namespace, address: &str| TunEnd {
            namespace: Some(namespace.name().to_owned()),
            interface: "path0".into(),
            addresses: vec![format!("{address}/24")],
            routes: Vec::new(),
        };
        let options = TunOptions { mtu: MTU, profiles, seed: SEED };
        let path = TunLink::start([end(&near, NEAR), end(&far, FAR)], &options)
            .context("the path between two namespaces")?;
        Ok(Self { path, near, far })
    }
}
