//! Direct paths between two sites behind a NAT each: SGC beside plain sockets, WireGuard and iroh, in one run.
//!
//! [`lab`] is the network. A system is a module that starts a [`Pair`] in it. [`figures`] collects and prints.

mod dds;
mod figures;
mod iroh;
mod lab;
mod pair;
mod sgc;
mod sockets;
mod wireguard;

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use clap::Args;
use sgc_testkit::netsim;

use figures::Figures;
use lab::Lab;
use pair::{Pair, Plan, Start};

use crate::report::Report;

/// Delays between each NAT and the cloud, ms. Without delay, the round trip is the cost of the programs.
const DELAYS_MS: [u64; 2] = [0, 10];
/// Bytes of a message of the round trips.
const SIZES: [usize; 2] = [100, 1000];
/// Starts of a system in each round, beside the measured one.
const STARTS: usize = 3;
/// Time for which nothing is sent while the router's bytes are counted.
const REST: Duration = Duration::from_secs(10);
/// Time between the first message over the asked path and the first measurement, in which what is slow to settle does.
const SETTLE: Duration = Duration::from_secs(1);

/// The systems, in the order of the report.
const SYSTEMS: [System; 8] = [
    System::Plain,
    System::SgcRelayed,
    System::SgcDirect,
    System::WireGuard,
    System::WireGuardDds,
    System::IrohRelayed,
    System::IrohDirect,
    System::IrohOnline,
];

/// The arguments of `direct`.
#[derive(Args, Clone, Debug)]
pub(crate) struct DirectArgs {
    /// The program that is measured
    #[arg(long, value_name = "FILE", default_value = "target/release/sgc")]
    sgc: PathBuf,
    /// The program that talks and listens; without it the `load` beside this one
    #[arg(long, value_name = "FILE")]
    load: Option<PathBuf>,
    /// The program that hosts iroh, of bench/iroh-peer
    #[arg(long, value_name = "FILE", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/iroh-peer/target/release/iroh-peer"))]
    iroh_peer: PathBuf,
    /// Directory for the results
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/results"))]
    out: PathBuf,
    /// These systems alone
    #[arg(long, value_name = "SYSTEM,…", value_delimiter = ',')]
    systems: Vec<String>,
    /// Rounds, in each of which every system has its turns
    #[arg(long, value_name = "N", default_value_t = 5)]
    rounds: usize,
    /// A short run of one round that shows that all parts work; its figures mean little
    #[arg(long)]
    quick: bool,
}

/// What is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum System {
    /// UDP and TCP between the sites, with the NATs opened beforehand.
    Plain,
    /// Two nodes that permit no direct link.
    SgcRelayed,
    /// Two nodes as they are by default.
    SgcDirect,
    /// A tunnel between the two NATs, with plain sockets in it.
    WireGuard,
    /// The same tunnel, with one DDS network in it.
    WireGuardDds,
    /// Two iroh endpoints without UDP of their own.
    IrohRelayed,
    /// Two iroh endpoints.
    IrohDirect,
    /// The same, with a dialer that knows its address before it connects. Only started.
    IrohOnline,
}

impl System {
    /// As figures call it.
    fn name(self) -> &'static str {
        match self {
            Self::Plain => "plain",
            Self::SgcRelayed => "sgc-relayed",
            Self::SgcDirect => "sgc-direct",
            Self::WireGuard => "wireguard",
            Self::WireGuardDds => "wireguard-dds",
            Self::IrohRelayed => "iroh-relayed",
            Self::IrohDirect => "iroh-direct",
            Self::IrohOnline => "iroh-online",
        }
    }

    /// Returns whether a start takes time on the way to a direct path.
    fn becomes_direct(self) -> bool {
        matches!(self, Self::SgcDirect | Self::WireGuard | Self::IrohDirect | Self::IrohOnline)
    }

    /// Returns whether there is a router or relay.
    fn has_router(self) -> bool {
        !matches!(self, Self::Plain | Self::WireGuard | Self::WireGuardDds)
    }

    fn start(self, lab: &Lab, programs: &Programs) -> Result<(Box<dyn Pair>, Start)> {
        match self {
            Self::Plain => Ok((Box::new(sockets::Sockets::between_sites(lab)?), Start::default())),
            Self::SgcRelayed => sgc::start(lab, &programs.sgc, false),
            Self::SgcDirect => sgc::start(lab, &programs.sgc, true),
            Self::WireGuard => wireguard::start(lab, false),
            Self::WireGuardDds => wireguard::start(lab, true),
            Self::IrohRelayed => iroh::start(lab, &programs.iroh_peer, iroh::Kind::Relayed),
            Self::IrohDirect => iroh::start(lab, &programs.iroh_peer, iroh::Kind::Direct),
            Self::IrohOnline => iroh::start(lab, &programs.iroh_peer, iroh::Kind::Online),
        }
    }
}

/// The programs of a run.
struct Programs {
    sgc: PathBuf,
    load: PathBuf,
    iroh_peer: PathBuf,
}

impl Programs {
    fn find(args: &DirectArgs) -> Result<Self> {
        let load = match &args.load {
            Some(load) => load.clone(),
            None => std::env::current_exe()?.with_file_name("load"),
        };
        let find =
            |file: &PathBuf| file.canonicalize().with_context(|| format!("{}: is it built?", file.display()));
        Ok(Self { sgc: find(&args.sgc)?, load: find(&load)?, iroh_peer: find(&args.iroh_peer)? })
    }
}

/// Measures all systems in turns, prints tables, and writes `direct.json`.
pub(crate) fn run(args: &DirectArgs) -> Result<()> {
    netsim::on_host().context("network namespaces are needed, which take root")?;
    for name in &args.systems {
        let names = SYSTEMS.map(System::name);
        ensure!(names.contains(&&**name), "no system {name:?}: {}", names.join(", "));
    }
    let programs = Programs::find(args)?;
    let is_asked =
        |system: &System| args.systems.is_empty() || args.systems.iter().any(|n| n == system.name());
    let systems: Vec<_> = SYSTEMS.into_iter().filter(is_asked).collect();
    let begun = Instant::now();
    let mut figures = Figures::default();
    for round in 0..if args.quick { 1 } else { args.rounds } {
        figures.begin_round();
        for delay_ms in DELAYS_MS {
            for &system in &systems {
                let seconds = begun.elapsed().as_secs();
                let name = system.name();
                eprintln!("{:3}:{:02} round {round}, {delay_ms} ms, {name}", seconds / 60, seconds % 60);
                if let Err(error) = turn(system, delay_ms, &programs, args.quick, &mut figures) {
                    figures.leave_out((name, delay_ms), round, &error);
                }
            }
        }
    }
    let rows = figures.rows();
    let report = Report::new(&rows, rows.tables())?;
    report.print();
    if args.quick {
        return Ok(());
    }
    report.write(&args.out, "direct")
}

/// One turn: a lab of its own, the start, and what comes after it.
fn turn(
    system: System,
    delay_ms: u64,
    programs: &Programs,
    is_quick: bool,
    figures: &mut Figures,
) -> Result<()> {
    let (setting, is_near) = ((system.name(), delay_ms), delay_ms == 0);
    let lab = Lab::new(Duration::from_millis(delay_ms), programs.load.clone())?;
    if system.becomes_direct() && !is_near {
        for _ in 0..if is_quick { 1 } else { STARTS } {
            let (_, start) = system.start(&lab, programs)?;
            figures.add_start(setting, start);
        }
    }
    if system == System::IrohOnline {
        return Ok(());
    }
    let (mut pair, start) = system.start(&lab, programs)?;
    figures.add_start(setting, start);
    std::thread::sleep(SETTLE);
    let plan = plan(is_near, is_quick);
    let has_router = system.has_router() && !is_near;
    for size in SIZES {
        let count = RouterBytes::begin(&lab)?;
        figures.add_round_trips(setting, size, pair.round_trips(size, &plan)?);
        if has_router {
            figures.add_router(setting.0, &format!("round trips of {size} B"), count.per_second()?);
        }
    }
    let count = RouterBytes::begin(&lab)?;
    figures.add_throughput(setting, pair.throughput(&plan)?);
    if has_router {
        figures.add_router(setting.0, "transfer", count.per_second()?);
        let count = RouterBytes::begin(&lab)?;
        std::thread::sleep(if is_quick { REST / 10 } else { REST });
        figures.add_router(setting.0, "rest", count.per_second()?);
    }
    Ok(())
}

/// What the router carries from a moment on.
struct RouterBytes<'a> {
    lab: &'a Lab,
    before: u64,
    begun: Instant,
}

impl<'a> RouterBytes<'a> {
    fn begin(lab: &'a Lab) -> Result<Self> {
        Ok(Self { lab, before: lab.router_bytes()?, begun: Instant::now() })
    }

    fn per_second(&self) -> Result<f64> {
        let bytes = self.lab.router_bytes()?.saturating_sub(self.before);
        Ok(bytes as f64 / self.begun.elapsed().as_secs_f64())
    }
}

fn plan(is_near: bool, is_quick: bool) -> Plan {
    let (count, seconds) = match (is_quick, is_near) {
        (true, _) => (20, 1.0),
        (false, true) => (1000, 2.0),
        (false, false) => (150, 8.0),
    };
    let (flow_seconds, flow_warm_up_seconds) = if is_quick { (1.0, 0.5) } else { (6.0, 2.0) };
    Plan { count, seconds, warm_up: 10, flow_seconds, flow_warm_up_seconds }
}
