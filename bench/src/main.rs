//! Benchmarks on real sockets; `README.md` says what each part measures and how to read it.
//!
//! This file knows the command line. The parts are [`compare`], [`direct`], [`first_look_up`], [`first_message`],
//! [`forward`], [`gateway`], [`rib`], [`teleop`] and [`transports`]; [`fleet`], [`node`], [`process`], [`report`] and [`uplink`] are
//! shared.
#![forbid(unsafe_code)]

mod compare;
mod direct;
mod first_look_up;
mod first_message;
mod fleet;
mod forward;
mod gateway;
mod node;
mod process;
mod report;
mod rib;
mod teleop;
mod transports;
mod uplink;

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};

/// Benchmarks of SGC on real sockets.
#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Measure the cost of routing: the first three below, one after the other
    All(RunArgs),
    /// 1 KB through one router, beside a plain TCP relay and a zenoh router
    Forward(RunArgs),
    /// Publishing and subscribing at a router that knows many names
    Rib(RunArgs),
    /// From a publisher's link to the first message at a subscriber
    FirstMessage(RunArgs),
    /// The first look-up of a name by the mappings flood, query and store; needs root and redis-server
    FirstLookUp(RunArgs),
    /// Commands, state and a camera over a thin uplink, by every transport; needs root
    Teleop(RunArgs),
    /// Links by every transport beside TCP and TLS; needs root for the part with losses
    Transports(RunArgs),
    /// Memory of a router with 256 links, by every transport
    RouterMemory(RunArgs),
    /// Programs without ROS: gRPC and the rosbridge protocol
    Gateway(gateway::GatewayArgs),
    /// The pages and plots of a run of `compare`, once more from its figures
    Report(ReportArgs),
    /// SGC beside its alternatives, in one run over emulated paths; needs root
    Compare(compare::CompareArgs),
    /// Direct paths between two NATs, beside WireGuard and iroh; needs root
    Direct(direct::DirectArgs),
    /// The far end of `transports`, in a process of its own
    #[command(hide = true)]
    ServeLinks(transports::ServeArgs),
    /// Memory of links, in a process of its own
    #[command(hide = true)]
    MeasureLinks(transports::MemoryArgs),
    /// The relay of `forward`, in a process of its own
    #[command(hide = true)]
    ServeTcp,
    /// The zenoh router of `forward`, in a process of its own
    #[cfg(feature = "zenoh")]
    #[command(hide = true)]
    ServeZenoh,
    /// One size of `rib`, in a process of its own so that its memory can be measured
    #[command(hide = true)]
    MeasureRib {
        /// Names that the router knows
        names: usize,
        /// Number of single operations timed at that size
        samples: usize,
    },
}

/// The arguments of `report`.
#[derive(Args)]
struct ReportArgs {
    /// The `compare.json` of a run
    #[arg(value_name = "FILE")]
    run: PathBuf,
    /// Directory for `report.md` and its plots
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/results"))]
    out: PathBuf,
}

/// The arguments of every part.
#[derive(Args, Clone)]
struct RunArgs {
    /// The program whose router is measured
    #[arg(long, value_name = "FILE", default_value = "target/release/sgc")]
    sgc: PathBuf,
    /// Directory for the JSON
    #[arg(long, value_name = "DIR", default_value = concat!(env!("CARGO_MANIFEST_DIR"), "/results"))]
    out: PathBuf,
    /// Names in the router, for `rib`
    #[arg(long, value_name = "N,N,…", value_delimiter = ',', default_values_t = [10_000, 1_000_000, 10_000_000])]
    names: Vec<usize>,
    /// Transports, for `teleop`, `transports` and `router-memory`; those that this build lacks are skipped
    #[arg(long, value_name = "SCHEME,…", value_delimiter = ',', default_values = uplink::SCHEMES)]
    schemes: Vec<String>,
    /// Make the state and the commands of `teleop` reliable topics
    #[arg(long)]
    reliable: bool,
    /// Seconds of each run of `teleop`
    #[arg(long, default_value_t = 15)]
    seconds: u64,
    /// A short run that shows that all parts work; its figures mean little
    #[arg(long)]
    quick: bool,
}

fn main() -> Result<()> {
    match Cli::parse().command {
        Command::All(args) => {
            part(&args, "rib", rib::run)?;
            part(&args, "first-message", first_message::run)?;
            part(&args, "forward", forward::run)
        }
        Command::Forward(args) => part(&args, "forward", forward::run),
        Command::Rib(args) => part(&args, "rib", rib::run),
        Command::FirstMessage(args) => part(&args, "first-message", first_message::run),
        Command::FirstLookUp(args) => part(&args, "first-look-up", first_look_up::run),
        Command::Teleop(args) => part(&args, "teleop", teleop::run),
        Command::Transports(args) => part(&args, "transports", transports::run),
        Command::RouterMemory(args) => part(&args, "router-memory", transports::router::run),
        Command::Gateway(args) => gateway::run(&args),
        Command::Report(args) => compare::Run::read(&args.run)?.render(&args.out),
        Command::Compare(args) => compare::run(args),
        Command::Direct(args) => direct::run(&args),
        Command::MeasureLinks(args) => transports::measure_memory_here(&args),
        Command::ServeLinks(args) => transports::serve(&args),
        Command::ServeTcp => forward::tcp::serve(),
        #[cfg(feature = "zenoh")]
        Command::ServeZenoh => forward::zenoh::serve(),
        Command::MeasureRib { names, samples } => rib::measure_here(names, samples),
    }
}

fn part(args: &RunArgs, name: &str, run: fn(&RunArgs) -> Result<report::Report>) -> Result<()> {
    let report = run(args).with_context(|| format!("benchmark {name}"))?;
    report.print();
    if args.quick {
        return Ok(());
    }
    report.write(&args.out, name)
}
