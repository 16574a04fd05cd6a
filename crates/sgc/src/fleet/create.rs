//! `sgc fleet create`, `import` and `set`: make fleets and change their settings.

use std::path::{Path, PathBuf};

use clap::Args;
use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_diagnosis::check::FLEET_EXTENSION;
use sgc_process::{system_rng, unix_now};
use sgc_trust::{Fleet, FleetName, NodeName, pem_contents};

use super::{WhichFleet, fleet_option};
use crate::error::CliError;
use crate::files::{self, Existing};
use crate::output;

const KEPT: &str = "; a fleet is never overwritten: its nodes would no longer be known";

/// Make a fleet: a certificate authority and a secret, in the file NAME.fleet.
///
/// Anybody who holds the file can make nodes of the fleet. The file is needed to enrol, renew and revoke nodes, not to
/// run them: keep it off the nodes, and keep a copy.
#[derive(Debug, Args)]
pub(super) struct CreateArgs {
    /// Name of the fleet: a-z, 0-9, '-', '_' and '.'
    name: String,
    /// Directory for the file
    #[arg(long, value_name = "DIR", default_value = ".")]
    dir: PathBuf,
    #[command(flatten)]
    traits: Traits,
}

/// Make a fleet around an existing CA.
///
/// The CA does not change. The file NAME.fleet holds its key beside the fleet's secret and roster. If the key must stay
/// where it is, let the CA sign the requests of `sgc fleet request` instead.
#[derive(Debug, Args)]
pub(super) struct ImportArgs {
    /// Name of the fleet: a-z, 0-9, '-', '_' and '.'
    name: String,
    /// Certificate of the CA, PEM
    #[arg(long, value_name = "FILE")]
    ca_cert: PathBuf,
    /// Private key of the CA, PEM (PKCS #8): P-256, P-384, Ed25519 or RSA
    #[arg(long, value_name = "FILE")]
    ca_key: PathBuf,
    /// Directory for the file
    #[arg(long, value_name = "DIR", default_value = ".")]
    dir: PathBuf,
    #[command(flatten)]
    traits: Traits,
}

/// Change the settings of the fleet; each node learns them when it is enrolled or renewed.
#[derive(Debug, Args)]
pub(super) struct SetArgs {
    #[command(flatten)]
    which: WhichFleet,
    /// Node that renews certificates for the others
    #[arg(long, value_name = "NODE", conflicts_with = "no_authority")]
    authority: Option<String>,
    /// Let no node renew certificates for the others
    #[arg(long)]
    no_authority: bool,
    /// Make links and grants resist quantum computers
    #[arg(long, conflicts_with = "no_post_quantum")]
    post_quantum: bool,
    /// Do not make links and grants resist quantum computers
    #[arg(long)]
    no_post_quantum: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Args)]
struct Traits {
    /// Node that renews certificates for the others
    #[arg(long, value_name = "NODE")]
    authority: Option<String>,
    /// Make links and grants resist quantum computers
    #[arg(long)]
    post_quantum: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// A fleet and its settings, as `--json` shows them.
#[derive(Serialize)]
struct FleetJson<'a> {
    file: String,
    fleet: &'a str,
    /// The end of the CA's certificate.
    expires: String,
    authority: Option<&'a str>,
    post_quantum: bool,
}

impl<'a> FleetJson<'a> {
    fn new(fleet: &'a Fleet, path: &Path) -> Self {
        Self {
            file: path.display().to_string(),
            fleet: fleet.name().as_str(),
            expires: fleet.not_after().to_string(),
            authority: fleet.authority().map(NodeName::as_str),
            post_quantum: fleet.post_quantum(),
        }
    }
}

pub(super) fn create(args: &CreateArgs) -> Result<(), CliError> {
    let name: FleetName = args.name.parse()?;
    let path = file_of(&name, &args.dir);
    let fleet = Fleet::create(name, unix_now(), &mut system_rng()?)
        .map_err(|source| CliError::Fleet { path: path.clone(), source })?;
    finish(fleet, &args.traits, &path)
}

pub(super) fn import(args: &ImportArgs) -> Result<(), CliError> {
    let name: FleetName = args.name.parse()?;
    let path = file_of(&name, &args.dir);
    let text = files::read_public(&args.ca_cert)?;
    let pem = |path: &PathBuf| {
        let path = path.clone();
        move |source| CliError::Pem { path, source }
    };
    let certificate = pem_contents(&text, &["CERTIFICATE"]).map_err(pem(&args.ca_cert))?.into_iter().next();
    let certificate = certificate.ok_or_else(|| CliError::NotInFile {
        path: args.ca_cert.clone(),
        what: "certificate in PEM",
        hint: "it begins with -----BEGIN CERTIFICATE-----",
    })?;
    let text = files::read_secret(&args.ca_key, "the CA's private key")?;
    let key = pem_contents(&text, &["PRIVATE KEY"]).map_err(pem(&args.ca_key))?.into_iter().next();
    let key = key.ok_or_else(|| CliError::NotInFile {
        path: args.ca_key.clone(),
        what: "private key in PKCS #8",
        hint: "`openssl pkcs8 -topk8 -nodes -in FILE` writes one",
    })?;
    let certificate = CertificateDer::from(certificate.to_vec());
    let fleet = Fleet::import(name, certificate, &key, unix_now(), &mut system_rng()?)
        .map_err(|source| CliError::Fleet { path: args.ca_cert.clone(), source })?;
    finish(fleet, &args.traits, &path)
}

pub(super) fn set(args: &SetArgs) -> Result<(), CliError> {
    let authority = args.authority.as_ref().map(|a| a.parse::<NodeName>()).transpose()?;
    let mut file = args.which.open()?;
    let now = unix_now();
    if authority.is_some() || args.no_authority {
        let done = file.fleet.set_authority(authority, now);
        done.map_err(|e| file.error(e))?;
    }
    if args.post_quantum || args.no_post_quantum {
        let done = file.fleet.set_post_quantum(args.post_quantum, now);
        done.map_err(|e| file.error(e))?;
    }
    file.save()?;
    let text = format!(
        "{}: authority {}, post-quantum {}\nNodes learn it when they are enrolled or renewed.",
        file.path().display(),
        file.fleet.authority().map_or("none", NodeName::as_str),
        if file.fleet.post_quantum() { "on" } else { "off" },
    );
    output::result(args.json, &FleetJson::new(&file.fleet, file.path()), text)
}

fn file_of(name: &FleetName, dir: &Path) -> PathBuf {
    let file = format!("{name}.{FLEET_EXTENSION}");
    if dir == Path::new(".") { file.into() } else { dir.join(file) }
}

fn finish(mut fleet: Fleet, traits: &Traits, path: &Path) -> Result<(), CliError> {
    let failed = |source| CliError::Fleet { path: path.to_owned(), source };
    let authority = traits.authority.as_ref().map(|a| a.parse::<NodeName>()).transpose()?;
    if authority.is_some() {
        fleet.set_authority(authority, unix_now()).map_err(failed)?;
    }
    if traits.post_quantum {
        fleet.set_post_quantum(true, unix_now()).map_err(failed)?;
    }
    files::write_secret(path, &fleet.to_text(), Existing::Keep(KEPT))?;
    output::result(traits.json, &FleetJson::new(&fleet, path), created_text(&fleet, path))
}

fn created_text(fleet: &Fleet, path: &Path) -> String {
    let option = fleet_option(path);
    format!(
        "{}: fleet {}, its CA holds until {}\n\
         Keep this file secret and keep a copy of it: whoever holds it can make nodes of the fleet.\n\n\
         Next, an identity for each node, and one for the router:\n  \
         sgc fleet enroll arm-1{option}\n  \
         sgc fleet enroll desk --group operators{option}\n  \
         sgc fleet enroll cloud --role router{option}",
        path.display(),
        fleet.name(),
        fleet.not_after(),
    )
}
