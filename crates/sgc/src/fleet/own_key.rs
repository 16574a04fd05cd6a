//! `sgc fleet request`, `extensions` and `accept`: identities whose private key never leaves the node's machine.

use std::path::{Path, PathBuf};

use clap::Args;
use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_process::system_rng;
use sgc_trust::{
    FleetName, FleetSecret, GroupName, Identity, Import, KeyRequest, Membership, NodeName, certificate_uris,
    pem_contents,
};
use zeroize::Zeroizing;

use super::role::{NodeRole, RoleArgs};
use crate::error::CliError;
use crate::files::{self, Existing};
use crate::output;

const KEY_KEPT: &str = "; a key is never overwritten: an identity may need it";

/// On a node's machine: make its private key and a request for a certificate.
///
/// The command writes the key to NODE.key, where it stays, and the request to NODE.csr. The keeper of the fleet answers
/// the request with `sgc fleet enroll NODE --csr NODE.csr`.
#[derive(Debug, Args)]
pub(super) struct RequestArgs {
    /// Name of the node: a-z, 0-9, '-', '_' and '.'
    node: String,
    /// File with the fleet's secret (a fleet file), for a CA that takes names from requests: the request then names the
    /// node as its certificate must
    #[arg(long, value_name = "FILE")]
    secret: Option<PathBuf>,
    /// Directory for the two files
    #[arg(long, value_name = "DIR", default_value = ".")]
    dir: PathBuf,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// On a node's machine: make its identity from its key and the answer to its request.
#[derive(Debug, Args)]
pub(super) struct AcceptArgs {
    /// Answer of `sgc fleet enroll --csr`; with --ca, certificates from an existing CA, PEM
    answer: PathBuf,
    /// Private key of the node [default: NODE.key]
    #[arg(long, value_name = "FILE")]
    key: Option<PathBuf>,
    /// Certificates of the CAs to trust, PEM; the answer is then a certificate that an existing CA made for the request
    #[arg(long, value_name = "FILE", requires = "node_name", requires = "fleet_name")]
    ca: Option<PathBuf>,
    /// With --ca: name of the node
    #[arg(long, value_name = "NAME", requires = "ca")]
    node_name: Option<String>,
    /// With --ca: name of the fleet, for people
    #[arg(long, value_name = "NAME", requires = "ca")]
    fleet_name: Option<String>,
    /// With --ca: file with the fleet's secret; without it, the identity is that of a router
    #[arg(long, value_name = "FILE", requires = "ca")]
    secret: Option<PathBuf>,
    /// With --ca: group that the certificate has to name; it may name no others; may be repeated
    #[arg(long = "group", value_name = "GROUP", requires = "secret")]
    groups: Vec<String>,
    /// With --ca: require that the certificate lets the member route for others
    #[arg(long, requires = "secret")]
    may_route: bool,
    /// File for the identity [default: NODE.identity]
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Replace an existing identity
    #[arg(long)]
    force: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// For a CA that does not know SGC: write the extensions of a node's certificate.
///
/// The file has OpenSSL's format (`openssl x509 -req -extfile`) and holds no secret. The CA takes the extensions from
/// this file and none from the request, so its keeper decides on name, groups and role.
#[derive(Debug, Args)]
pub(super) struct ExtensionsArgs {
    /// Name of the node: a-z, 0-9, '-', '_' and '.'
    node: String,
    /// File with the fleet's secret (a fleet file)
    #[arg(long, value_name = "FILE")]
    secret: PathBuf,
    /// Group of the node; may be repeated
    #[arg(long = "group", value_name = "GROUP")]
    groups: Vec<String>,
    #[command(flatten)]
    role: RoleArgs,
    /// File for the extensions [default: NODE.ext]
    #[arg(short, long, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct RequestJson<'a> {
    node: &'a str,
    key_file: String,
    request_file: String,
}

#[derive(Serialize)]
struct ExtensionsJson<'a> {
    node: &'a str,
    file: String,
}

/// The identity that `sgc fleet accept` wrote, as `--json` shows it.
#[derive(Serialize)]
struct AcceptedJson<'a> {
    file: String,
    node: &'a str,
    fleet: &'a str,
    /// The end of the certificate.
    expires: String,
    /// Limits of the certificate on some transports.
    notes: Vec<&'static str>,
}

pub(super) fn extensions(args: &ExtensionsArgs) -> Result<(), CliError> {
    let node: NodeName = args.node.parse()?;
    let groups = args.groups.iter().map(|g| g.parse()).collect::<Result<Vec<GroupName>, _>>()?;
    let secret = read_fleet_secret(&args.secret)?;
    let NodeRole { is_router, may_route } = args.role.role()?;
    if is_router && !groups.is_empty() {
        return Err(CliError::Cannot { reason: "a router is in no group: leave --group out".to_owned() });
    }
    let routes = is_router || may_route;
    let path = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("{node}.ext")));
    let uris = certificate_uris(&secret, &node, &groups, routes);
    files::write_public(&path, extensions_text(&node, &groups, routes, &uris).as_bytes())?;
    let file = path.display();
    let mut accept = format!("sgc fleet accept {node}.pem --ca CA.pem --node-name {node} --fleet-name NAME");
    if !is_router {
        accept.push_str(" --secret FILE");
        groups.iter().for_each(|group| accept.push_str(&format!(" --group {group}")));
        accept.push_str(if may_route { " --may-route" } else { "" });
    }
    let json = ExtensionsJson { node: node.as_str(), file: file.to_string() };
    let text = format!(
        "{file}: extensions for the certificate of {node}, no secret. Where the CA is:\n  \
         openssl x509 -req -in {node}.csr -CA CA.pem -CAkey CA.key -extfile {file} -days 90 -out {node}.pem\n\
         Then, on the node's machine:\n  {accept}"
    );
    output::result(args.json, &json, text)
}

fn extensions_text(node: &NodeName, groups: &[GroupName], may_route: bool, uris: &[String]) -> String {
    let groups: Vec<_> = groups.iter().map(GroupName::as_str).collect();
    let mut text = format!(
        "# Extensions of the certificate of SGC node {node}\n# groups: {}; routes for others: {}\n\
         # Sign with these alone: a request may ask for more (-copy_extensions none, as is the default).\n\
         basicConstraints = critical, CA:FALSE\n\
         keyUsage = critical, digitalSignature\n\
         extendedKeyUsage = clientAuth, serverAuth\n\
         subjectAltName = @sgc\n\n[sgc]\n",
        if groups.is_empty() { "none".to_owned() } else { groups.join(", ") },
        if may_route { "yes" } else { "no" },
    );
    for (place, uri) in (1..).zip(uris) {
        text.push_str(&format!("URI.{place} = {uri}\n"));
    }
    text
}

pub(super) fn request(args: &RequestArgs) -> Result<(), CliError> {
    let node: NodeName = args.node.parse()?;
    let file = |extension: &str| {
        let name = format!("{node}.{extension}");
        if args.dir == Path::new(".") { PathBuf::from(name) } else { args.dir.join(name) }
    };
    let (key_path, csr_path) = (file("key"), file("csr"));
    let pseudonym = match &args.secret {
        Some(path) => Some(read_fleet_secret(path)?.pseudonym(node.as_str())),
        None => None,
    };
    let made = KeyRequest::generate(pseudonym.as_ref(), &mut system_rng()?)
        .map_err(|source| CliError::Fleet { path: key_path.clone(), source })?;
    files::write_secret(&key_path, &made.key_text(), Existing::Keep(KEY_KEPT))?;
    files::write_public(&csr_path, made.csr_text().as_bytes())?;
    let (key, csr) = (key_path.display(), csr_path.display());
    let json = RequestJson { node: node.as_str(), key_file: key.to_string(), request_file: csr.to_string() };
    let text = match pseudonym {
        None => format!(
            "{key}: the private key of {node}; it stays here\n\
             {csr}: the request, no secret; where the fleet is kept:\n  \
             sgc fleet enroll {node} --csr {csr}"
        ),
        Some(_) => format!(
            "{key}: the private key of {node}; it stays here\n\
             {csr}: the request, no secret. Have the CA sign it with the extensions that `sgc fleet extensions \
             {node}` writes. Then, here:\n  \
             sgc fleet accept CERTIFICATE --ca CA --node-name {node} --fleet-name NAME --secret FILE"
        ),
    };
    output::result(args.json, &json, text)
}

pub(super) fn accept(args: &AcceptArgs) -> Result<(), CliError> {
    let rng = &mut system_rng()?;
    let broken = |source| CliError::Identity { path: args.answer.clone(), source };
    let identity = match (&args.ca, &args.node_name, &args.fleet_name) {
        (Some(ca), Some(node), Some(fleet)) => {
            let (node, fleet): (NodeName, FleetName) = (node.parse()?, fleet.parse()?);
            let import = Import {
                key: read_key(&args.key_path(&node))?,
                chain: read_certificates(&args.answer)?,
                cas: read_certificates(ca)?,
                secret: args.secret.as_deref().map(read_fleet_secret).transpose()?,
                groups: args.groups.iter().map(|g| g.parse()).collect::<Result<_, _>>()?,
                may_route: args.may_route,
                node,
                fleet,
            };
            Identity::import(import, rng).map_err(broken)?
        }
        _ => {
            let text = files::read_secret(&args.answer, "secrets of the fleet")?;
            let member = Membership::parse(&text).map_err(broken)?;
            let key = read_key(&args.key_path(member.node_name()))?;
            Identity::join(member, &key, rng).map_err(broken)?
        }
    };
    let node = identity.node_name();
    let path = args.out.clone().unwrap_or_else(|| PathBuf::from(format!("{node}.identity")));
    let existing = match args.force {
        true => Existing::Replace,
        false => Existing::Keep("; --force replaces it"),
    };
    files::write_secret(&path, &identity.to_text(), existing)?;
    let mut text = format!(
        "{}: node {node} of fleet {}, holds until {}",
        path.display(),
        identity.fleet_name(),
        identity.not_after()
    );
    for note in identity.transport_notes() {
        text.push_str("\nNote: ");
        text.push_str(note);
    }
    let json = AcceptedJson {
        file: path.display().to_string(),
        node: node.as_str(),
        fleet: identity.fleet_name().as_str(),
        expires: identity.not_after().to_string(),
        notes: identity.transport_notes(),
    };
    output::result(args.json, &json, text)
}

impl AcceptArgs {
    fn key_path(&self, node: &NodeName) -> PathBuf {
        self.key.clone().unwrap_or_else(|| PathBuf::from(format!("{node}.key")))
    }
}

fn contents(path: &Path, text: &str, label: &str) -> Result<Vec<Zeroizing<Vec<u8>>>, CliError> {
    pem_contents(text, &[label]).map_err(|source| CliError::Pem { path: path.to_owned(), source })
}

fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, CliError> {
    let found = contents(path, &files::read_public(path)?, "CERTIFICATE")?;
    match found.is_empty() {
        false => Ok(found.iter().map(|c| CertificateDer::from(c.to_vec())).collect()),
        true => Err(CliError::NotInFile {
            path: path.to_owned(),
            what: "certificate in PEM",
            hint: "it begins with -----BEGIN CERTIFICATE-----",
        }),
    }
}

fn read_key(path: &Path) -> Result<Zeroizing<Vec<u8>>, CliError> {
    let text = files::read_secret(path, "the node's private key")?;
    contents(path, &text, "PRIVATE KEY")?.into_iter().next().ok_or_else(|| CliError::NotInFile {
        path: path.to_owned(),
        what: "private key in PKCS #8",
        hint: "`openssl pkcs8 -topk8 -nodes -in FILE` writes one",
    })
}

fn read_fleet_secret(path: &Path) -> Result<FleetSecret, CliError> {
    let text = files::read_secret(path, "the fleet's secret")?;
    let found = contents(path, &text, "SGC FLEET SECRET")?.into_iter().next();
    let bytes = found.and_then(|b| <[u8; 32]>::try_from(&b[..]).ok().map(Zeroizing::new));
    bytes.map(|b| FleetSecret::from_bytes(*b)).ok_or_else(|| CliError::NotInFile {
        path: path.to_owned(),
        what: "fleet secret",
        hint: "a fleet file holds one (`sgc fleet create NAME`)",
    })
}
