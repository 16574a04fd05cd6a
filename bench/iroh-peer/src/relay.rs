//! The relay: iroh's own server with a certificate made for the run, for an address instead of a name.

use std::fs;
use std::net::IpAddr;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;
use clap::Args;
use iroh_relay::server::{
    CertConfig, QuicConfig, RelayConfig as RelayServerConfig, Server, ServerConfig, TlsConfig,
};
use rcgen::{CertificateParams, KeyPair};
use rustls::pki_types::{PrivateKeyDer, PrivatePkcs8KeyDer};

use crate::report::{Event, say};
use crate::until_stdin_closes;

/// The arguments of `relay`.
#[derive(Args)]
pub(crate) struct RelayArgs {
    /// Its address
    #[arg(long, value_name = "ADDRESS")]
    address: IpAddr,
    /// The TCP port of HTTPS, which relays
    #[arg(long, value_name = "PORT")]
    port: u16,
    /// The TCP port of HTTP, for probes
    #[arg(long, value_name = "PORT")]
    http_port: u16,
    /// The UDP port on which it tells clients their addresses
    #[arg(long, value_name = "PORT")]
    address_port: u16,
    /// Where its certificate is written, DER
    #[arg(long, value_name = "FILE")]
    certificate: PathBuf,
}

pub(crate) async fn run(args: &RelayArgs) -> Result<()> {
    let key = KeyPair::generate()?;
    let certificate = CertificateParams::new([args.address.to_string()])?.self_signed(&key)?;
    fs::write(&args.certificate, certificate.der())?;
    let key = PrivateKeyDer::from(PrivatePkcs8KeyDer::from(key.serialize_der()));
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let server_config = rustls::ServerConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()?
        .with_no_client_auth()
        .with_single_cert(vec![certificate.der().clone()], key)?;
    let mut relay = RelayServerConfig::new((args.address, args.http_port));
    relay.tls = Some(TlsConfig::new(
        (args.address, args.port),
        CertConfig::Manual { server_config: server_config.clone() },
    ));
    let mut quic = QuicConfig::new((args.address, args.address_port));
    quic.server_config = Some(server_config);
    let mut config = ServerConfig::default();
    config.relay = Some(relay);
    config.quic = Some(quic);
    let server = Server::spawn(config).await?;
    say(&Event::Up)?;
    until_stdin_closes().await?;
    server.shutdown().await?;
    Ok(())
}
