//! `sgc gateway certificate`: the certificate by which programs verify a node's gateway, and its pin.
//!
//! It makes the gateway's own certificate if the node has not yet, so that clients can be set up before the node runs.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use serde::Serialize;
use sgc_gateway::ShownCertificate;
use sgc_node::config::Config;
use sgc_node::{GatewayCertificate, gateway_urls};
use sgc_process::unix_now;
use sgc_trust::{Identity, pem_text};
use sgc_wire::UnixMillis;

use crate::error::CliError;
use crate::{files, output, policy};

/// Show how programs verify a node's gateway.
#[derive(Debug, Args)]
pub(crate) struct GatewayArgs {
    #[command(subcommand)]
    command: GatewayCommand,
}

#[derive(Debug, Subcommand)]
enum GatewayCommand {
    Certificate(CertificateArgs),
}

/// Show the certificate of a node's gateway: its pin, names and end, and the URLs to connect to.
///
/// The command reads the configuration and the state directory; the node need not run. If the gateway is to make its
/// certificate itself and has not yet, the command makes it.
#[derive(Debug, Args)]
#[command(after_help = "A file for programs and browsers that are to trust this gateway:
  sgc gateway certificate -c arm-1.toml --pem > gateway.pem
The pin, for programs that pin the key:
  sgc gateway certificate -c arm-1.toml")]
struct CertificateArgs {
    /// Configuration of the node; without it, the only *.toml of this directory
    #[arg(short, long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Print the certificate that clients trust, PEM
    #[arg(long, conflicts_with = "json")]
    pem: bool,
    /// Print JSON
    #[arg(long)]
    json: bool,
}

/// The answer as JSON.
#[derive(Serialize)]
struct Answer {
    /// The URLs at which clients connect.
    urls: Vec<String>,
    /// The pin of the certificate's key.
    pin: String,
    /// The names for which the certificate holds.
    names: Vec<String>,
    expires: String,
    /// Whether the gateway made the certificate itself.
    own: bool,
    /// The certificates that clients trust.
    pem: String,
}

/// Runs `sgc gateway`.
pub(crate) fn gateway(args: &GatewayArgs) -> Result<(), CliError> {
    match &args.command {
        GatewayCommand::Certificate(args) => certificate(args),
    }
}

fn certificate(args: &CertificateArgs) -> Result<(), CliError> {
    let path = files::config_here(args.config.as_deref())?;
    let (config, identity, _) = policy::load(&path)?;
    let missing = || CliError::NoGatewayTls { path: path.clone() };
    let (reach, certificate) = reach(&config, &identity)?.ok_or_else(missing)?;
    let (Some(shown), Some(certificate)) = (reach.shown, certificate) else { return Err(missing()) };
    let pem: String = certificate.trusted().iter().map(|trusted| pem_text("CERTIFICATE", trusted)).collect();
    if args.pem {
        return Ok(output::raw(&pem)?);
    }
    if args.json {
        let ShownCertificate { pin, names, until } = shown;
        let (urls, expires, own) = (reach.urls, UnixMillis(until).to_string(), certificate.is_own);
        let answer = Answer { urls, pin, names, expires, own, pem };
        return output::json(&answer);
    }
    let mut rows: Vec<_> = reach.urls.iter().map(|url| vec!["url".to_owned(), url.clone()]).collect();
    rows.push(vec!["pin".to_owned(), shown.pin]);
    rows.push(vec!["names".to_owned(), shown.names.join(", ")]);
    rows.push(vec!["until".to_owned(), UnixMillis(shown.until).to_string()]);
    output::columns(&rows).into_iter().try_for_each(output::line)
}

/// The way to a gateway for programs.
pub(crate) struct Reach {
    /// The URLs at which they connect.
    pub(crate) urls: Vec<String>,
    /// The certificate that they are shown; `None` without TLS.
    pub(crate) shown: Option<ShownCertificate>,
}

/// Returns how programs reach the gateway of a configuration, and its certificate if it listens with TLS; `None` if
/// there is no gateway. Makes or renews the gateway's own certificate if needed.
pub(crate) fn reach(
    config: &Config,
    identity: &Identity,
) -> Result<Option<(Reach, Option<GatewayCertificate>)>, CliError> {
    let Some(gateway) = &config.gateway else { return Ok(None) };
    let state = sgc_node::state_dir(config, identity.node_name().as_str());
    let state = state.ok_or(sgc_node::StateError::Nowhere)?;
    sgc_node::create_state_dir(&state)?;
    let certificate = GatewayCertificate::load(gateway, &state, unix_now())?;
    let chain = certificate.as_ref().map_or(&[][..], |certificate| &certificate.chain);
    let shown = chain.first().and_then(|leaf| ShownCertificate::of(leaf));
    Ok(Some((Reach { urls: gateway_urls(gateway, chain), shown }, certificate)))
}
