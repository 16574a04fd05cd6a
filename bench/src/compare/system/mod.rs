//! What is compared: ways to join the DDS networks of two places. A system is a file here and a row of [`all`].

mod direct;
mod sgc;

use std::net::IpAddr;
use std::path::{Path, PathBuf};

use anyhow::Result;

pub(crate) use sgc::Sgc;

use super::lab::{Lab, Side};
use super::program::Program;

/// A way to join two places.
pub(crate) trait System {
    /// As figures call it.
    fn name(&self) -> String;

    /// Starts its processes in a lab. Topics may take their time to be joined: who uses them waits for the first message.
    fn start(&self, lab: &Lab, topics: &[Topic]) -> Result<Running>;
}

/// A topic that is to be joined.
#[derive(Clone, Debug)]
pub(crate) struct Topic {
    /// Its name, as ROS 2 has it.
    pub(crate) name: &'static str,
    /// Where its subscribers are.
    pub(crate) towards: Side,
    /// Whether its messages must not be lost.
    pub(crate) reliable: bool,
}

/// How programs at a place join the network there.
#[derive(Clone, Debug)]
pub(crate) struct Dds {
    /// The domain.
    pub(crate) domain: u32,
    /// For `CYCLONEDDS_URI`.
    pub(crate) uri: String,
    /// Another build of the program that talks and listens, if it takes one.
    pub(crate) load: Option<PathBuf>,
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
        Self { domain: 0, uri, load: None }
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

/// Every system, in the order of the report. `sgc` is the program under test.
pub(crate) fn all(sgc: &Path) -> Result<Vec<Box<dyn System>>> {
    let mut systems: Vec<Box<dyn System>> = vec![Box::new(direct::Direct)];
    systems.extend(sgc::all(sgc)?.into_iter().map(|system| Box::new(system) as Box<dyn System>));
    Ok(systems)
}
