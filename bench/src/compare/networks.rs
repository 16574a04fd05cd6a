//! The ROS networks of the two places, of DDS or of rmw_zenoh, and a started system that connects them.

use std::net::IpAddr;
use std::path::PathBuf;
use std::process::Command;

use super::program::Program;

/// The variable with settings of Zenoh, as rmw_zenoh reads it.
pub(crate) const ZENOH_OVERRIDES: &str = "ZENOH_CONFIG_OVERRIDE";

/// One of the two places.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Side {
    /// The robot's.
    Left,
    /// The desk's, or the cloud's.
    Right,
}

impl Side {
    /// Both.
    pub(crate) const BOTH: [Self; 2] = [Self::Left, Self::Right];

    /// `left`, `right`.
    pub(crate) fn name(self) -> &'static str {
        ["left", "right"][self as usize]
    }

    /// The other one.
    pub(crate) fn other(self) -> Self {
        match self {
            Self::Left => Self::Right,
            Self::Right => Self::Left,
        }
    }
}

/// How programs at a place join the network there.
#[derive(Clone, Debug)]
pub(crate) struct Dds {
    /// The domain.
    pub(crate) domain: u32,
    /// For `CYCLONEDDS_URI`; none where everything is as the middleware has it by itself.
    pub(crate) uri: Option<String>,
    /// Another build of the program that talks and listens, if it takes one.
    pub(crate) load: Option<PathBuf>,
    /// For `ZENOH_CONFIG_OVERRIDE`, where the programs are those of rmw_zenoh.
    pub(crate) zenoh: Option<String>,
    /// The place of all programs, if it is one for both sides.
    pub(crate) place: Option<Side>,
}

impl Dds {
    /// A network of this host alone, over its loopback interface.
    pub(crate) fn loopback() -> Self {
        Self::on("127.0.0.1", "spdp", &["127.0.0.1"])
    }

    /// One network from here to there, by unicast.
    pub(crate) fn between(here: IpAddr, there: IpAddr) -> Self {
        let (here, there) = (here.to_string(), there.to_string());
        Self::on(&here, "false", &[&here, &there])
    }

    /// All else is as Cyclone has it by itself, in every system.
    fn on(interface: &str, multicast: &str, peers: &[&str]) -> Self {
        let peers: String = peers.iter().map(|peer| format!("<Peer Address=\"{peer}\"/>")).collect();
        let uri = format!(
            "<CycloneDDS><Domain Id=\"any\"><General>\
             <Interfaces><NetworkInterface address=\"{interface}\"/></Interfaces>\
             <AllowMulticast>{multicast}</AllowMulticast></General>\
             <Discovery><ParticipantIndex>auto</ParticipantIndex><Peers>{peers}</Peers></Discovery>\
             </Domain></CycloneDDS>"
        );
        Self { uri: Some(uri), ..Self::stock(0) }
    }

    /// A network on every interface with multicast, as ROS 2 has it by default.
    pub(crate) fn stock(domain: u32) -> Self {
        Self { domain, uri: None, load: None, zenoh: None, place: None }
    }

    /// A network of rmw_zenoh with the router of a place, for this build of the load program.
    pub(crate) fn zenoh(load: PathBuf) -> Self {
        Self { load: Some(load), ..Self::stock(0) }
    }

    /// Gives a program its configuration, and no other.
    pub(crate) fn configure(&self, command: &mut Command) {
        match &self.uri {
            Some(uri) => command.env("CYCLONEDDS_URI", uri),
            None => command.env_remove("CYCLONEDDS_URI"),
        };
        match &self.zenoh {
            Some(overrides) => command.env(ZENOH_OVERRIDES, overrides),
            None => command.env_remove(ZENOH_OVERRIDES),
        };
    }
}

/// The DDS networks of the two places.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Networks {
    /// Each keeps to the loopback interface of its place.
    Loopback,
    /// Each is on every interface, as ROS 2 has it by default. Domains keep them apart.
    Stock,
}

impl Networks {
    /// Returns the network of a place, where a system connects the two.
    pub(crate) fn local(self, side: Side) -> Dds {
        match self {
            Self::Loopback => Dds::loopback(),
            Self::Stock => Dds::stock(1 + side as u32),
        }
    }
}

/// A system that has been started, until it is dropped.
#[derive(Debug)]
pub(crate) struct Running {
    /// Its processes, by where they are; not those of its users. The last is ended first.
    pub(crate) processes: Vec<(Side, Program)>,
    /// How its users join, left and right.
    pub(crate) dds: [Dds; 2],
}

impl Running {
    /// CPU time that its processes have taken, seconds.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        self.processes.iter().map(|(_, program)| program.cpu_seconds()).sum()
    }

    /// Resident memory of its processes: now, and the most that each ever had, bytes.
    pub(crate) fn rss_bytes(&self) -> (u64, u64) {
        let each = self.processes.iter().map(|(_, program)| program.resident_bytes());
        each.fold((0, 0), |(now, most), (its, its_most)| (now + its, most + its_most))
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        while self.processes.pop().is_some() {}
    }
}
