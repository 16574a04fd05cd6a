//! `compare`: SGC and its alternatives, side by side in one run over one emulated network.
//!
//! A [`System`](system::System) joins two places of a [`Lab`](lab::Lab) and carries topics of programs that do not know
//! it. A table is a module here and a row of [`TABLES`]. It measures [`figures::Figure`]s, which `report` turns into
//! pages, plots and goals.

mod applications;
mod fan_out;
mod figures;
mod fleet_step;
mod flow;
mod footprint;
mod goals;
mod lab;
mod multi_hop;
mod networks;
mod plan;
mod plot;
mod program;
mod real_ros2;
mod report;
mod rmw_zenoh;
mod roaming;
mod round_trip;
mod sample;
mod start_up;
mod system;
mod tally;
mod tcp;
mod teleop;
mod throughput;
mod turns;

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use clap::Args;
use sgc_testkit::netsim;

use lab::PathKind;
use plan::Breadth;
use system::{Peers, System};

pub(crate) use figures::Figures;
pub(crate) use networks::Side;
pub(crate) use program::Program;
pub(crate) use report::Run;
pub(crate) use system::{Dds, wireguard};

/// Measures a table.
type Table = fn(&Compare, &mut Figures) -> Result<()>;

/// Every table, in the order of the report.
const TABLES: [(&str, Table); 13] = [
    ("round-trip", round_trip::run),
    ("throughput", throughput::run),
    (real_ros2::TABLE, real_ros2::run),
    (rmw_zenoh::TABLE, rmw_zenoh::run),
    (rmw_zenoh::IDLE, rmw_zenoh::run_idle),
    ("start-up", start_up::run),
    ("applications", applications::run),
    ("fleet-step", fleet_step::run),
    ("fan-out", fan_out::run),
    ("multi-hop", multi_hop::run),
    ("teleop", teleop::run),
    ("roaming", roaming::run),
    ("footprint", footprint::run),
];

/// The variants of `sgc` in a short run.
const QUICK: [&str; 4] = ["sgc-quic-group", "sgc-quic-group-router", "sgc-dtls-paper", "sgc-tcp-standard"];

/// The arguments of `compare`.
#[derive(Args, Clone, Debug)]
pub(crate) struct CompareArgs {
    /// The program that is measured
    #[arg(long, value_name = "FILE", default_value = "target/release/sgc")]
    sgc: PathBuf,
    /// The program that talks and listens; without it the `load` beside this one
    #[arg(long, value_name = "FILE")]
    load: Option<PathBuf>,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/results"))]
    out: PathBuf,
    #[command(flatten)]
    peers: Peers,
    /// These tables alone
    #[arg(long, value_name = "TABLE,…", value_delimiter = ',')]
    only: Vec<String>,
    /// These systems alone; a name that ends in * stands for all that begin so
    #[arg(long, value_name = "SYSTEM,…", value_delimiter = ',')]
    systems: Vec<String>,
    /// These paths alone: bare, paper, lossy
    #[arg(long, value_name = "PATH,…", value_delimiter = ',')]
    paths: Vec<String>,
    /// Bytes of the image that each robot sends in a step of `fleet-step`: 640 × 480 pixels, compressed
    #[arg(long, value_name = "BYTES", default_value_t = 60_000, value_parser = clap::value_parser!(u32).range(64..))]
    fleet_image: u32,
    /// A short run that shows that all parts work; its figures mean little
    #[arg(long)]
    quick: bool,
}

/// A run: what is measured, and how.
pub(crate) struct Compare {
    args: CompareArgs,
    load: PathBuf,
    systems: Vec<Box<dyn System>>,
    relays: Vec<Box<dyn System>>,
    begun: Instant,
}

impl Compare {
    fn new(args: CompareArgs) -> Result<Self> {
        netsim::on_host().context("network namespaces are needed, which take root")?;
        let load = match &args.load {
            Some(load) => load.clone(),
            None => std::env::current_exe()?.with_file_name("load"),
        };
        let load = load.canonicalize().with_context(|| format!("{}: is it built?", load.display()))?;
        let mut systems = system::all(&args.sgc, &args.peers)?;
        let mut relays = system::relays();
        let mut names: Vec<_> = systems.iter().chain(&relays).map(|system| system.name()).collect();
        names.extend(system::CONFIGURED.into_iter().chain(system::WITH_RMW_ZENOH).map(str::to_owned));
        names.extend([tcp::NAME, real_ros2::ONE_HOST].map(str::to_owned));
        for pattern in &args.systems {
            ensure!(
                names.iter().any(|name| fits(pattern, name)),
                "no system {pattern:?}: {}",
                names.join(", ")
            );
        }
        for some in [&mut systems, &mut relays] {
            some.retain(|system| is_among(&args.systems, &system.name()));
        }
        if args.quick && args.systems.is_empty() {
            systems.retain(|system| !system.name().starts_with("sgc-") || QUICK.contains(&&*system.name()));
        }
        for only in &args.only {
            let names: Vec<_> = TABLES.iter().map(|(name, _)| *name).collect();
            ensure!(names.contains(&&**only), "no table {only:?}: {}", names.join(", "));
        }
        Ok(Self { args, load, systems, relays, begun: Instant::now() })
    }

    /// Returns the systems of this run.
    pub(crate) fn systems(&self) -> &[Box<dyn System>] {
        &self.systems
    }

    /// The floor of what is compared, for tables of round trips and rates.
    pub(crate) fn relays(&self) -> &[Box<dyn System>] {
        &self.relays
    }

    /// Returns the requested systems that a table has, and reports missing ones. Systems requested by name are always
    /// included.
    pub(crate) fn systems_of(
        &self,
        breadth: Breadth,
        table: &str,
        why: &str,
        figures: &mut Figures,
    ) -> Vec<&dyn System> {
        let has = |system: &&dyn System| !self.args.systems.is_empty() || breadth.has(&system.name());
        let all: Vec<_> = self.systems.iter().map(|system| &**system).collect();
        if !all.iter().all(has) {
            figures.leave_out(&format!("{table}, {}", breadth.lacks()), why);
        }
        all.into_iter().filter(has).collect()
    }

    /// Whether a system is asked for, whatever kind of thing it is.
    pub(crate) fn wants(&self, system: &str) -> bool {
        is_among(&self.args.systems, system)
    }

    /// Whether a path is asked for.
    pub(crate) fn wants_path(&self, kind: &PathKind) -> bool {
        self.args.paths.is_empty() || self.args.paths.iter().any(|path| path == kind.name())
    }

    /// Returns the systems where users configure more than the names of topics; see [`system::configured`].
    pub(crate) fn configured(
        &self,
        priorities: &'static [(&'static str, &'static str)],
        zenoh: serde_json::Value,
    ) -> Result<Vec<Box<dyn System>>> {
        let mut systems = system::configured(&self.args.sgc, &self.args.peers, priorities, zenoh)?;
        systems.retain(|system| self.wants(&system.name()));
        Ok(systems)
    }

    /// Returns the systems with programs of rmw_zenoh; see [`system::with_rmw_zenoh`].
    pub(crate) fn with_rmw_zenoh(
        &self,
        priorities: &'static [(&'static str, &'static str)],
    ) -> Result<Vec<Box<dyn System>>> {
        let mut systems = system::with_rmw_zenoh(&self.args.sgc, &self.args.peers, priorities)?;
        systems.retain(|system| self.wants(&system.name()));
        Ok(systems)
    }

    /// The program that talks and listens.
    pub(crate) fn load(&self) -> &Path {
        &self.load
    }

    /// The program that is measured.
    pub(crate) fn sgc(&self) -> &Path {
        &self.args.sgc
    }

    /// The folder with an environment of each distribution of ROS 2.
    pub(crate) fn ros2(&self) -> &Path {
        &self.args.peers.ros2
    }

    /// Bytes of an image of `fleet-step`.
    pub(crate) fn fleet_image_bytes(&self) -> usize {
        self.args.fleet_image as usize
    }

    /// Whether figures need not mean anything.
    pub(crate) fn is_quick(&self) -> bool {
        self.args.quick
    }

    /// How many rounds there are; who has a turn in which is [`plan::rounds`]'s.
    pub(crate) fn rounds(&self) -> usize {
        if self.is_quick() { 1 } else { plan::ROUNDS_MAX }
    }

    /// Says how far it is, and since when.
    pub(crate) fn note(&self, what: &str) {
        let seconds = self.begun.elapsed().as_secs();
        eprintln!("{:3}:{:02} {what}", seconds / 60, seconds % 60);
    }
}

fn is_among(patterns: &[String], name: &str) -> bool {
    patterns.is_empty() || patterns.iter().any(|pattern| fits(pattern, name))
}

fn fits(pattern: &str, name: &str) -> bool {
    pattern.strip_suffix('*').map_or(pattern == name, |start| name.starts_with(start))
}

/// Runs what is asked for and writes figures, report and plots, anew after each table: what was measured is not lost
/// with what was not.
pub(crate) fn run(args: CompareArgs) -> Result<()> {
    let compare = Compare::new(args)?;
    let mut figures = Figures::default();
    if compare.wants("rosbridge") {
        figures.leave_out("rosbridge", system::why_no_rosbridge());
    }
    for (name, table) in TABLES {
        if is_among(&compare.args.only, name) {
            let begun = Instant::now();
            if let Err(error) = table(&compare, &mut figures) {
                figures.leave_out(&format!("the rest of {name}"), format!("{error:#}"));
            }
            compare.note(&format!("{name} took {} s", begun.elapsed().as_secs()));
            let run = Run::here(figures.clone(), compare.is_quick());
            run.write(&compare.args.out)?;
            run.render(&compare.args.out)?;
        }
    }
    Ok(())
}
