//! `iroh-peer`: an iroh relay, and two programs that connect through it and then directly.
//!
//! This file knows the command line. Each role prints events on standard output, one line of JSON each
//! ([`report::Event`]), and ends when its standard input does. `connect` takes orders from there ([`report::Order`]).
//! Endpoints have iroh's defaults, except that they know this relay alone and no address lookup: the dialer gets the
//! other's id from its command line and finds it by the relay, as with iroh's own lookup services.
#![forbid(unsafe_code)]

mod connect;
mod relay;
mod report;
mod serve;

use std::fs;
use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::{Args, Parser, Subcommand};
use iroh::endpoint::presets;
use iroh::{Endpoint, RelayConfig, RelayMap, RelayMode, RelayUrl};
use iroh_relay::RelayQuicConfig;
use iroh_relay::tls::CaTlsConfig;
use tokio::io::AsyncReadExt as _;
use tracing_subscriber::EnvFilter;

/// The protocol of these programs.
const ALPN: &[u8] = b"sgc-bench/1";
/// Bytes of a write of a bulk transfer.
const CHUNK_BYTES: usize = 64 << 10;

/// Two ends of an iroh connection and its relay.
#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    role: Role,
}

#[derive(Subcommand)]
enum Role {
    /// The relay, which also tells endpoints their addresses
    Relay(relay::RelayArgs),
    /// Accepts connections, echoes and counts
    Serve(EndpointArgs),
    /// Connects, and measures
    Connect(connect::ConnectArgs),
}

/// The arguments of both ends.
#[derive(Args)]
struct EndpointArgs {
    /// The relay
    #[arg(long, value_name = "URL")]
    relay: RelayUrl,
    /// The UDP port on which the relay tells addresses
    #[arg(long, value_name = "PORT")]
    address_port: u16,
    /// The relay's certificate, DER
    #[arg(long, value_name = "FILE")]
    certificate: PathBuf,
    /// Stay with the relay
    #[arg(long)]
    relayed: bool,
}

impl EndpointArgs {
    async fn bind(&self) -> Result<Endpoint> {
        let certificate = fs::read(&self.certificate).context("the relay's certificate")?;
        let relay = RelayConfig::new(self.relay.clone(), Some(RelayQuicConfig::new(self.address_port)));
        let mut builder = Endpoint::builder(presets::Minimal)
            .alpns(vec![ALPN.to_vec()])
            .relay_mode(RelayMode::Custom(RelayMap::from(relay)))
            .ca_tls_config(CaTlsConfig::custom_roots([certificate.into()]));
        if self.relayed {
            builder = builder.clear_ip_transports();
        }
        Ok(builder.bind().await?)
    }
}

#[tokio::main]
async fn main() -> Result<()> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).init();
    match Cli::parse().role {
        Role::Relay(args) => relay::run(&args).await,
        Role::Serve(args) => serve::run(&args).await,
        Role::Connect(args) => connect::run(&args).await,
    }
}

/// Waits until standard input ends.
async fn until_stdin_closes() -> Result<()> {
    let mut rest = Vec::new();
    tokio::io::stdin().read_to_end(&mut rest).await?;
    Ok(())
}
