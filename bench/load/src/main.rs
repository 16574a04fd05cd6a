//! `load`: talkers and listeners for benchmarks. They are plain Cyclone DDS programs with a ROS 2 node's names, and do
//! not know what carries their topics. With the feature `zenoh`, the same roles are programs of rmw_zenoh.
//!
//! This file knows the command line. Each role prints events on standard output in lines of JSON ([`report::Event`]),
//! takes orders from standard input ([`report::Order`]), and ends when that does. It measures and judges nothing.
#![deny(unsafe_code)]

mod ask;
mod caller;
#[cfg(not(feature = "zenoh"))]
#[allow(unsafe_code)]
mod dds;
mod flow;
mod forwarder;
mod node;
mod ping;
#[cfg(not(feature = "zenoh"))]
mod relay;
mod report;
#[cfg(feature = "zenoh")]
mod rmw_zenoh;
#[cfg(not(feature = "zenoh"))]
mod types;

use anyhow::Result;
use clap::{Args, Parser, Subcommand};

/// The middleware of the roles.
#[cfg(not(feature = "zenoh"))]
use dds as network;
#[cfg(feature = "zenoh")]
use rmw_zenoh as network;

use network::Quality;

/// Talkers and listeners for benchmarks, on Cyclone DDS, which `CYCLONEDDS_URI` configures, or on Zenoh
/// (`ZENOH_CONFIG_OVERRIDE`).
#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    role: Role,
}

#[derive(Subcommand)]
enum Role {
    /// Sends messages and waits for each to come back
    Ping(ping::PingArgs),
    /// Sends messages back
    Pong(ping::PingArgs),
    /// Sends requests and waits for the answer to each
    Ask(ask::AskArgs),
    /// Answers requests
    Answer(ask::AnswerArgs),
    /// Sends messages
    Source(flow::SourceArgs),
    /// Counts messages and their ages
    Sink(flow::SinkArgs),
    /// Carries topics to another relay over TCP, as they are
    #[cfg(not(feature = "zenoh"))]
    Relay(relay::RelayArgs),
    /// Forwards the bytes of a TCP connection
    Forwarder(forwarder::ForwarderArgs),
    /// A Zenoh router with the settings of rmw_zenohd
    #[cfg(feature = "zenoh")]
    Router,
}

/// The arguments of every role.
#[derive(Args, Clone, Debug)]
struct Common {
    /// The domain
    #[arg(long, default_value_t = 0)]
    domain: u32,
    /// The name of the ROS 2 node
    #[arg(long, default_value = "load")]
    node: String,
    /// The topic, as ROS 2 calls it
    #[arg(long, value_name = "/TOPIC")]
    topic: String,
    /// Reliable, instead of best effort
    #[arg(long)]
    reliable: bool,
    /// Number of messages kept; 0 keeps all unacknowledged ones, and writing waits for room
    #[arg(long, default_value_t = 10)]
    depth: u32,
}

impl Common {
    fn quality(&self) -> Quality {
        Quality { reliable: self.reliable, depth: self.depth }
    }
}

fn main() -> Result<()> {
    match Cli::parse().role {
        Role::Ping(args) => ping::ping(&args),
        Role::Pong(args) => ping::pong(&args),
        Role::Ask(args) => ask::ask(&args),
        Role::Answer(args) => ask::answer(&args),
        Role::Source(args) => flow::source(&args),
        Role::Sink(args) => flow::sink(&args),
        #[cfg(not(feature = "zenoh"))]
        Role::Relay(args) => relay::relay(&args),
        Role::Forwarder(args) => forwarder::forward(&args),
        #[cfg(feature = "zenoh")]
        Role::Router => rmw_zenoh::route(|| report::say(&report::Event::Up)),
    }
}

/// Reads the clock that all processes of a host share, in nanoseconds.
fn now_ns() -> u64 {
    let now = rustix::time::clock_gettime(rustix::time::ClockId::Monotonic);
    now.tv_sec as u64 * 1_000_000_000 + now.tv_nsec as u64
}
