//! Programs of rmw_zenoh as users run them without anything else: with a Zenoh router at one place, or one at each.
//!
//! Programs and routers are the load program with its feature `zenoh`, which has rmw_zenoh's settings.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};

use super::{Dds, Running, System, Topic};
use crate::compare::lab::{Lab, Side};
use crate::compare::networks::ZENOH_OVERRIDES;
use crate::compare::program::Program;

/// The port of rmw_zenohd.
const PORT: u16 = 7447;

/// The Zenoh routers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Routers {
    /// One, with all programs on its host. They connect to each other.
    OneHost,
    /// One at the right place. Programs at the left are its clients over the path.
    One,
    /// One at each place. The left one connects to the right one over the path.
    Two,
}

/// Every kind.
pub(crate) const ALL: [Routers; 3] = [Routers::OneHost, Routers::One, Routers::Two];

/// Programs of rmw_zenoh with routers.
pub(crate) struct RmwZenoh {
    load: PathBuf,
    routers: Routers,
}

impl RmwZenoh {
    /// With this build of the load program. Whether it is there shows when it starts.
    pub(crate) fn new(load: &Path, routers: Routers) -> Self {
        Self { load: load.to_owned(), routers }
    }
}

impl System for RmwZenoh {
    fn name(&self) -> String {
        match self.routers {
            Routers::OneHost => "rmw-zenoh-one-host",
            Routers::One => "rmw-zenoh-one-router",
            Routers::Two => "rmw-zenoh-two-routers",
        }
        .into()
    }

    fn start(&self, lab: &Lab, _: &[Topic]) -> Result<Running> {
        let load = self.load.canonicalize();
        let load = load.with_context(|| format!("{}: is it built?", self.load.display()))?;
        let mut processes = vec![(Side::Right, start_router(lab, Side::Right, &load, "")?)];
        let far = format!("connect/endpoints=[\"tcp/{}:{PORT}\"]", lab.address(Side::Right));
        let mut dds = Side::BOTH.map(|_| Dds::zenoh(load.clone()));
        match self.routers {
            Routers::OneHost => dds[Side::Left as usize].place = Some(Side::Right),
            Routers::One => dds[Side::Left as usize].zenoh = Some(format!("mode=\"client\";{far}")),
            Routers::Two => processes.push((Side::Left, start_router(lab, Side::Left, &load, &far)?)),
        }
        Ok(Running { processes, dds })
    }
}

/// Starts a Zenoh router with further settings, which is up on return. `load` is an absolute path.
pub(crate) fn start_router(lab: &Lab, side: Side, load: &Path, overrides: &str) -> Result<Program> {
    let mut command = lab.command(side, load);
    command.arg("router").env(ZENOH_OVERRIDES, overrides);
    let name = format!("zenoh-router-{}", side.name());
    let mut router = Program::start(&name, command, &lab.new_dir(&name)?)?;
    router.soon("up")?;
    Ok(router)
}
