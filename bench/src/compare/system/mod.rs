//! The compared systems, which join the DDS networks of two places. A system is a file here and a row of [`all`].

mod direct;
mod relay;
pub(crate) mod rmw_zenoh;
mod security;
mod sgc;
pub(crate) mod wireguard;
mod zenoh;

use std::path::{Path, PathBuf};

use anyhow::Result;
use clap::Args;
use serde_json::Value;

pub(crate) use sgc::{Middleware, Sgc};

pub(crate) use super::networks::{Dds, Networks, Running};

use super::lab::{Lab, Side};

/// A way to join two places.
pub(crate) trait System: Sync {
    /// As figures call it.
    fn name(&self) -> String;

    /// Starts its processes in a lab. Topics may take their time to be joined: who uses them waits for the first
    /// message.
    fn start(&self, lab: &Lab, topics: &[Topic]) -> Result<Running>;
}

/// A topic that is to be joined.
#[derive(Clone, Debug)]
pub(crate) struct Topic {
    /// Its name, as ROS 2 has it.
    pub(crate) name: &'static str,
    /// The place of its subscribers.
    pub(crate) towards: Side,
    /// Whether its messages must not be lost.
    pub(crate) reliable: bool,
}

/// Programs of others, which `make bench` builds. Whether they are there shows when they are started.
#[derive(Args, Clone, Debug)]
pub(crate) struct Peers {
    /// The Zenoh bridge, of bench/zenoh-bridge
    #[arg(long, value_name = "FILE", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/zenoh-bridge/target/release/zenoh-bridge"))]
    zenoh_bridge: PathBuf,
    /// The program that talks and listens, built with its feature `dds-security`
    #[arg(long, value_name = "FILE", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/target/dds-security/release/load"))]
    secure_load: PathBuf,
    /// The program that talks and listens, built with its feature `zenoh`
    #[arg(long, value_name = "FILE", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/target/zenoh/release/load"))]
    zenoh_load: PathBuf,
    /// The environments of ROS 2, of scripts/build-ros2.sh
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/../.peers"))]
    pub(super) ros2: PathBuf,
}

/// Every system, in the order of the report. `sgc` is the program under test.
pub(crate) fn all(sgc: &Path, peers: &Peers) -> Result<Vec<Box<dyn System>>> {
    let mut systems: Vec<Box<dyn System>> = vec![
        Box::new(direct::Direct),
        Box::new(wireguard::WireGuard),
        Box::new(security::DdsSecurity::new(&peers.secure_load)),
    ];
    systems.extend(zenoh::all(&peers.zenoh_bridge).map(|system| Box::new(system) as Box<dyn System>));
    systems.extend(sgc::all(sgc)?.into_iter().map(|system| Box::new(system) as Box<dyn System>));
    Ok(systems)
}

/// Returns minimal relays between two networks, which are no systems for users, for tables of round trips and rates.
pub(crate) fn relays() -> Vec<Box<dyn System>> {
    relay::ALL.map(|relay| Box::new(relay) as Box<dyn System>).into()
}

/// Systems that [`configured`] has beside those of [`all`].
pub(crate) const CONFIGURED: [&str; 1] = ["zenoh-tcp-tuned"];

/// Those that tables compare for which users configure more than names of topics: priorities for the topics of SGC, and
/// a Zenoh bridge with `zenoh` beside the one with its defaults.
pub(crate) fn configured(
    sgc: &Path,
    peers: &Peers,
    priorities: &'static [(&'static str, &'static str)],
    zenoh: Value,
) -> Result<Vec<Box<dyn System>>> {
    let [zenoh_tcp, _] = zenoh::all(&peers.zenoh_bridge);
    let mut systems: Vec<Box<dyn System>> = vec![
        Box::new(direct::Direct),
        Box::new(wireguard::WireGuard),
        Box::new(zenoh_tcp),
        Box::new(zenoh::Zenoh::tuned(&peers.zenoh_bridge, zenoh)),
    ];
    for scheme in ["quic", "dtls", "tls"] {
        systems.push(Box::new(sgc::Sgc::new(sgc, scheme, "standard", 0)?.with_priorities(priorities)));
    }
    Ok(systems)
}

/// Returns the systems with programs of rmw_zenoh, and `sgc` with the same settings between DDS networks. `sgc` has one
/// router, as between sites, and these priorities.
pub(crate) fn with_rmw_zenoh(
    sgc: &Path,
    peers: &Peers,
    priorities: &'static [(&'static str, &'static str)],
) -> Result<Vec<Box<dyn System>>> {
    use Middleware::{Dds, Zenoh};
    let load = &peers.zenoh_load;
    let mut systems: Vec<Box<dyn System>> =
        rmw_zenoh::ALL.map(|routers| Box::new(rmw_zenoh::RmwZenoh::new(load, routers)) as _).into();
    for middleware in [[Zenoh, Zenoh], [Dds, Zenoh], [Dds, Dds]] {
        let one = Sgc::new(sgc, "quic", "pairwise", 1)?.with_priorities(priorities);
        systems.push(Box::new(one.between(middleware, load)));
    }
    Ok(systems)
}

/// The names of [`with_rmw_zenoh`].
pub(crate) const WITH_RMW_ZENOH: [&str; 6] = [
    "rmw-zenoh-one-host",
    "rmw-zenoh-one-router",
    "rmw-zenoh-two-routers",
    "sgc-zenoh-zenoh",
    "sgc-dds-zenoh",
    "sgc-dds-dds",
];

/// The reason why rosbridge is not compared: it carries only types that are installed as ROS 2 packages beside it, and
/// the programs here have a type of their own.
pub(crate) fn why_no_rosbridge() -> String {
    let installed = std::fs::read_dir("/opt/ros").into_iter().flatten().flatten();
    let installed: Vec<_> =
        installed.map(|distro| distro.file_name().to_string_lossy().into_owned()).collect();
    if installed.is_empty() {
        return "it needs an installation of ROS 2, and there is none in /opt/ros".into();
    }
    format!(
        "ROS 2 {} is here, but rosbridge carries types of installed packages only, and that of the load generator is none",
        installed.join(", ")
    )
}
