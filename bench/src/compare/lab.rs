//! Two places and the path between them: network namespaces in which systems and programs are started. Knows no system.

use std::ffi::OsStr;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, Result};
use sgc_testkit::netsim::{Loss, Namespace, Profile, TunLink};
use tempfile::TempDir;

pub(crate) use super::networks::Side;

use super::networks::{Dds, Networks, Running};
use super::program::Program;
use crate::uplink::{FAR, NEAR, Uplink};

/// The interface at each end of the path.
pub(crate) const INTERFACE: &str = "path0";
const BITS_PREFIX: u8 = 24;

static LABS: AtomicU32 = AtomicU32::new(0);

/// The path between the two places.
#[derive(Clone, Copy, Debug)]
#[expect(clippy::large_enum_variant, reason = "there are a few in a run")]
pub(crate) enum PathKind {
    /// A pair of virtual Ethernet interfaces, and nothing else.
    Bare,
    /// As in the paper: 76 ms round trip, 5 Mbit/s each way.
    Paper,
    /// 40 ms round trip, 50 Mbit/s each way, one packet in 50 lost.
    Lossy,
    /// Anything else: a name for the report, and the emulator's profiles from left to right and back.
    Other(&'static str, [Profile; 2]),
}

impl PathKind {
    /// As figures call it.
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Bare => "bare",
            Self::Paper => "paper",
            Self::Lossy => "lossy",
            Self::Other(name, _) => name,
        }
    }

    /// None where no emulator is needed.
    fn profiles(&self) -> Option<[Profile; 2]> {
        let thin = |one_way_ms, rate, lost| Profile {
            rate: Some(rate),
            delay: Duration::from_millis(one_way_ms),
            loss: Loss::Random(lost),
            ..Profile::default()
        };
        match self {
            Self::Bare => None,
            Self::Paper => Some([thin(38, 5_000_000, 0.0); 2]),
            Self::Lossy => Some([thin(20, 50_000_000, 0.02); 2]),
            Self::Other(_, profiles) => Some(*profiles),
        }
    }
}

/// The two places. Programs in them have to end before it is dropped.
pub(crate) struct Lab {
    /// Goes first, as its devices are in the namespaces. None on [`PathKind::Bare`].
    pub(crate) path: Option<TunLink>,
    /// The kind of path.
    pub(crate) kind: PathKind,
    /// The ROS networks that systems connect.
    pub(crate) networks: Networks,
    places: [Arc<Namespace>; 2],
    /// For all that is written while it is there.
    pub(crate) dir: TempDir,
    load: PathBuf,
    started: AtomicU32,
}

impl Lab {
    /// Makes them; `load` is the program that talks and listens. Needs root.
    pub(crate) fn new(kind: PathKind, load: &Path) -> Result<Self> {
        Self::with_networks(Networks::Loopback, kind, load)
    }

    /// Makes places for programs of ROS 2 as it is by default.
    pub(crate) fn stock(kind: PathKind, load: &Path) -> Result<Self> {
        let lab = Self::with_networks(Networks::Stock, kind, load)?;
        for place in &lab.places {
            // Multicast leaves by the interface that this route names.
            place.ip(&["route", "add", "default", "dev", INTERFACE])?;
        }
        Ok(lab)
    }

    fn with_networks(networks: Networks, kind: PathKind, load: &Path) -> Result<Self> {
        let (path, places) = match kind.profiles() {
            Some(profiles) => {
                let Uplink { path, near, far } = Uplink::new(profiles)?;
                (Some(path), [near, far])
            }
            None => (None, wired()?),
        };
        for place in &places {
            // So that programs and nodes of a place find each other as on any host.
            place.ip(&["link", "set", "lo", "multicast", "on"])?;
        }
        let dir = tempfile::tempdir()?;
        Ok(Self { path, kind, networks, places, dir, load: load.to_owned(), started: AtomicU32::new(0) })
    }

    /// The namespace of a place.
    pub(crate) fn place(&self, side: Side) -> &Arc<Namespace> {
        &self.places[side as usize]
    }

    /// A program at a place.
    pub(crate) fn command(&self, side: Side, program: impl AsRef<OsStr>) -> Command {
        self.place(side).command(program)
    }

    /// The address of its end of the path.
    pub(crate) fn address(&self, side: Side) -> IpAddr {
        let address = [NEAR, FAR][side as usize];
        address.parse().expect("a constant that is an address")
    }

    /// A new directory for somebody's files, with a short path.
    pub(crate) fn new_dir(&self, name: &str) -> Result<PathBuf> {
        let number = self.started.fetch_add(1, Ordering::Relaxed);
        let dir = self.dir.path().join(format!("{number}-{name}"));
        std::fs::create_dir(&dir).with_context(|| dir.display().to_string())?;
        Ok(dir)
    }

    /// A program of `load` at a place, in the local network that a system brings there: `args` are its role and what
    /// that is given, domain left out.
    pub(crate) fn load(&self, running: &Running, side: Side, args: &[&str]) -> Result<Program> {
        self.load_in(&running.dds[side as usize], side, args)
    }

    /// Starts a load program in any local network of a place.
    pub(crate) fn load_in(&self, dds: &Dds, side: Side, args: &[&str]) -> Result<Program> {
        let side = dds.place.unwrap_or(side);
        let mut command = self.command(side, dds.load.as_deref().unwrap_or(&self.load));
        command.args(args).args(["--domain", &dds.domain.to_string()]);
        dds.configure(&mut command);
        self.start_load(side, command, args)
    }

    /// Starts a load program that is in no local network.
    pub(crate) fn load_alone(&self, side: Side, args: &[&str]) -> Result<Program> {
        let mut command = self.command(side, &self.load);
        command.args(args);
        self.start_load(side, command, args)
    }

    fn start_load(&self, side: Side, command: Command, args: &[&str]) -> Result<Program> {
        let name = format!("load-{}-{}", side.name(), args.first().copied().unwrap_or_default());
        Program::start(&name, command, &self.new_dir(&name)?)
    }
}

/// Two namespaces and a pair of interfaces.
fn wired() -> Result<[Arc<Namespace>; 2]> {
    let number = LABS.fetch_add(1, Ordering::SeqCst);
    let make = |place: Side| {
        let name = format!("sgclab-{}-{number}-{}", std::process::id(), place.name());
        Ok::<_, anyhow::Error>(Arc::new(Namespace::create(name)?))
    };
    let (left, right) = (make(Side::Left)?, make(Side::Right)?);
    let address = |address: &str| format!("{address}/{BITS_PREFIX}");
    left.veth((INTERFACE, &[&address(NEAR)]), &right, (INTERFACE, &[&address(FAR)]))?;
    Ok([left, right])
}
