//! The certificate that clients of the gateway are shown: one that the configuration names, or one that the gateway
//! makes itself, keeps in the state directory and renews.
//!
//! `sgc-trust` makes certificates. This module knows the names of this host.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use rustls::sign::CertifiedKey;
use rustls_pki_types::CertificateDer;
use sgc_config::{GatewayConfig, GatewayTls};
use sgc_gateway::{TlsError, certified_key};
use sgc_trust::{
    CertificateName, SERVER_FILE_BYTES_MAX, ServerCertificate, ServerCertificateError, certificate_end,
    certificate_names,
};
use sgc_wire::UnixMillis;
use tracing::warn;
use zeroize::Zeroizing;

use crate::node::random::system_rng;
use crate::state::{self, StateLock};

/// File in the state directory with the gateway's own certificate and its key.
const FILE: &str = "gateway-certificate.pem";
/// Most addresses of network interfaces in the certificate.
const INTERFACE_ADDRESSES_MAX: usize = 64;
/// Time before the end of the configured certificate at which a node starts to warn.
const EXPIRY_WARNING: Duration = Duration::from_secs(14 * 86_400);
const LOCALHOST: &str = "localhost";
/// The domain of names by mDNS.
const MDNS_DOMAIN: &str = "local";

/// Reasons why there is no certificate for the gateway.
#[derive(Debug, thiserror::Error)]
pub enum GatewayCertificateError {
    /// A file cannot be read or written.
    #[error("the gateway's {}: {source}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The error of the operating system.
        source: io::Error,
    },
    /// TLS cannot use the certificate or key of the configuration.
    #[error("the gateway's {}: {source}", path.display())]
    Configured {
        /// The certificate.
        path: PathBuf,
        /// The fault.
        source: TlsError,
    },
    /// The kept certificate is broken.
    #[error(
        "the gateway's own certificate {}: {source}; restore the file, or remove it: the gateway then makes another, and \
         its clients need the new pin",
        path.display()
    )]
    Kept {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: ServerCertificateError,
    },
    /// No certificate could be made.
    #[error("the gateway's own certificate: {0}")]
    Making(#[from] ServerCertificateError),
    /// The system provides no random numbers.
    #[error("the gateway's own certificate: {0}")]
    Randomness(String),
}

/// The certificate that the gateway shows within TLS to programs.
#[derive(Clone)]
pub(crate) enum ShownKey {
    /// The certificate that the configuration names.
    Files(Arc<CertifiedKey>),
    /// The certificate that the gateway made itself.
    Own(Arc<CertifiedKey>),
}

impl ShownKey {
    pub(crate) fn certified(&self) -> &Arc<CertifiedKey> {
        match self {
            Self::Files(key) | Self::Own(key) => key,
        }
    }
}

/// The certificate that clients of a gateway are shown, for people who set up such clients.
#[derive(Clone, Debug)]
pub struct GatewayCertificate {
    /// The certificates, that of the gateway first.
    pub chain: Vec<CertificateDer<'static>>,
    /// Whether the gateway made it itself.
    pub is_own: bool,
}

impl GatewayCertificate {
    /// Returns the certificate of this configuration. Makes or renews the gateway's own in the state directory if
    /// needed; `None` if the gateway does not listen with TLS. Blocks.
    pub fn load(
        config: &GatewayConfig,
        state: &Path,
        now: UnixMillis,
    ) -> Result<Option<Self>, GatewayCertificateError> {
        if !uses_tls(config) {
            return Ok(None);
        }
        Ok(Some(match &config.tls {
            Some(tls) => Self { chain: key_of_files(tls)?.cert.clone(), is_own: false },
            None => {
                let own = kept(&wanted_names(config), state, now)?;
                Self { chain: vec![own.server().clone(), own.authority().clone()], is_own: true }
            }
        }))
    }

    /// Returns the certificates that a client trusts to verify the gateway: the CA of a gateway with a certificate of
    /// its own, and the whole chain of another.
    pub fn trusted(&self) -> &[CertificateDer<'static>] {
        match (self.is_own, &self.chain[..]) {
            (true, [_, authority @ ..]) => authority,
            (_, chain) => chain,
        }
    }
}

/// Returns `true` if the gateway listens with TLS anywhere.
pub(crate) fn uses_tls(config: &GatewayConfig) -> bool {
    config.listen.iter().any(|url| url.scheme.is_encrypted())
}

/// Reads the certificate and key that the configuration names.
pub(crate) fn key_of_files(tls: &GatewayTls) -> Result<Arc<CertifiedKey>, GatewayCertificateError> {
    let read = |path: &Path| {
        fs::read(path).map_err(|source| GatewayCertificateError::File { path: path.to_owned(), source })
    };
    let (certificate, key) = (read(&tls.certificate)?, Zeroizing::new(read(&tls.key)?));
    certified_key(&certificate, &key)
        .map_err(|source| GatewayCertificateError::Configured { path: tls.certificate.clone(), source })
}

/// Returns the gateway's own certificate for these names from the state directory. Makes or renews it if needed.
pub(crate) fn kept(
    names: &BTreeSet<CertificateName>,
    state: &Path,
    now: UnixMillis,
) -> Result<ServerCertificate, GatewayCertificateError> {
    let path = state.join(FILE);
    let failed = |source| GatewayCertificateError::File { path: path.clone(), source };
    let _lock = StateLock::take(state).map_err(failed)?;
    let (certificate, is_new) = current(read(state)?, names, now)?;
    if is_new {
        state::replace(&path, certificate.to_text().as_bytes()).map_err(failed)?;
    }
    Ok(certificate)
}

/// Reads the gateway's own certificate in the state directory; `None` if there is none yet.
pub(crate) fn read(state: &Path) -> Result<Option<ServerCertificate>, GatewayCertificateError> {
    let path = state.join(FILE);
    let failed = |source| GatewayCertificateError::File { path: path.clone(), source };
    let Some(bytes) = state::read(&path, SERVER_FILE_BYTES_MAX as u64).map_err(failed)? else {
        return Ok(None);
    };
    let bytes = Zeroizing::new(bytes);
    let broken = |source| GatewayCertificateError::Kept { path: path.clone(), source };
    ServerCertificate::parse(&String::from_utf8_lossy(&bytes)).map(Some).map_err(broken)
}

/// Returns the certificate for these names, and whether it is another than the one before.
pub(crate) fn current(
    before: Option<ServerCertificate>,
    names: &BTreeSet<CertificateName>,
    now: UnixMillis,
) -> Result<(ServerCertificate, bool), GatewayCertificateError> {
    let mut rng = system_rng().map_err(|error| GatewayCertificateError::Randomness(error.to_string()))?;
    let Some(before) = before else {
        return Ok((ServerCertificate::generate(names, now, &mut rng)?, true));
    };
    Ok(match before.renewed(names, now, &mut rng)? {
        Some(renewed) => (renewed, true),
        None => (before, false),
    })
}

/// Returns the names by which clients reach a gateway on this host: those of the configuration and of the host, and the
/// addresses at which it listens with TLS.
pub(crate) fn wanted_names(config: &GatewayConfig) -> BTreeSet<CertificateName> {
    names_of(config, &host_names(), &interface_addresses())
}

fn names_of(config: &GatewayConfig, host: &[String], interfaces: &[IpAddr]) -> BTreeSet<CertificateName> {
    let encrypted = config.listen.iter().filter(|url| url.scheme.is_encrypted());
    let addresses = encrypted.flat_map(|url| match url.address.ip().to_canonical() {
        // A socket of every IPv6 address takes IPv4, too.
        IpAddr::V6(Ipv6Addr::UNSPECIFIED) => interfaces.to_vec(),
        IpAddr::V4(Ipv4Addr::UNSPECIFIED) => interfaces.iter().copied().filter(IpAddr::is_ipv4).collect(),
        ip => vec![ip],
    });
    let loopback = [Ipv4Addr::LOCALHOST.into(), Ipv6Addr::LOCALHOST.into()];
    let names = host.iter().map(String::as_str).chain([LOCALHOST]);
    let names = names.map(|name| CertificateName::Dns(name.to_owned()));
    names
        .chain(addresses.chain(loopback).map(CertificateName::Ip))
        .chain(config.names.iter().cloned())
        .collect()
}

/// Returns the names of this host, with that of mDNS last. Empty if its name is no DNS name.
fn host_names() -> Vec<String> {
    let name = rustix::system::uname().nodename().to_string_lossy().into_owned();
    names_of_host(&name)
}

fn names_of_host(name: &str) -> Vec<String> {
    let Ok(CertificateName::Dns(name)) = name.parse() else { return Vec::new() };
    let label = name.split('.').next().unwrap_or_default().to_owned();
    if label == LOCALHOST {
        return Vec::new();
    }
    let by_mdns = format!("{label}.{MDNS_DOMAIN}");
    let mut names = vec![name, label, by_mdns];
    names.dedup();
    names
}

/// Returns the addresses of this host's network interfaces, without those that are valid on one link only.
fn interface_addresses() -> Vec<IpAddr> {
    let found = if_addrs::get_if_addrs().unwrap_or_else(|error| {
        warn!(%error, "the addresses of this host cannot be read; the gateway's certificate lacks them");
        Vec::new()
    });
    let is_usable = |ip: &IpAddr| match ip {
        IpAddr::V4(ip) => !ip.is_loopback(),
        IpAddr::V6(ip) => !ip.is_loopback() && !ip.is_unicast_link_local(),
    };
    let usable: BTreeSet<IpAddr> = found.iter().map(|interface| interface.ip()).filter(is_usable).collect();
    usable.into_iter().take(INTERFACE_ADDRESSES_MAX).collect()
}

/// Returns the URLs at which clients reach a gateway, for its user to copy. `chain` is its certificate, if it has one.
pub fn gateway_urls(config: &GatewayConfig, chain: &[CertificateDer<'_>]) -> Vec<String> {
    urls_of(config, chain, &host_names())
}

fn urls_of(config: &GatewayConfig, chain: &[CertificateDer<'_>], host: &[String]) -> Vec<String> {
    let certified = chain.first().map(|leaf| certificate_names(leaf)).unwrap_or_default();
    let of_files = certified.iter().filter(|_| config.tls.is_some());
    let listed = config.names.iter().chain(of_files).map(ToString::to_string).next();
    let everywhere = listed.or_else(|| host.last().cloned()).unwrap_or_else(|| LOCALHOST.to_owned());
    let url = |url: &sgc_config::GatewayUrl| {
        let at = match url.address.ip() {
            ip if ip.is_unspecified() => everywhere.clone(),
            IpAddr::V6(ip) => format!("[{ip}]"),
            IpAddr::V4(ip) => ip.to_string(),
        };
        format!("{}://{at}:{}", url.scheme.as_str(), url.address.port())
    };
    config.listen.iter().map(url).collect()
}

/// Returns a warning if the certificate that the configuration names for the gateway ends soon.
pub fn gateway_expiry_warning(config: &GatewayConfig, now: UnixMillis) -> Option<String> {
    let tls = config.tls.as_ref()?;
    // A file that cannot be read is a mistake, which is reported elsewhere.
    let end = certificate_end(key_of_files(tls).ok()?.cert.first()?)?;
    let left = Duration::from_millis(end.0.saturating_sub(now.0));
    (left < EXPIRY_WARNING).then(|| {
        format!(
            "gateway: the certificate in {} ends in {} days, at {end}: replace it before then, or no client connects with TLS",
            tls.certificate.display(),
            left.as_secs() / 86_400,
        )
    })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use sgc_trust::certificate_pin;

    use super::*;

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

    fn config(text: &str) -> GatewayConfig {
        let text = format!("identity = 'x'\n[node]\nrouters = ['quic://r']\n[gateway]\n{text}");
        sgc_config::parse(&text, "node.toml", Path::new("/etc/sgc"), &|_| None).unwrap().gateway.unwrap()
    }

    fn texts(names: &BTreeSet<CertificateName>) -> Vec<String> {
        names.iter().map(ToString::to_string).collect()
    }

    #[test]
    fn names_are_those_of_the_host_the_configuration_and_the_addresses_with_tls() {
        let host = names_of_host("Arm-1");
        assert_eq!(host, ["arm-1", "arm-1.local"]);
        assert_eq!(names_of_host("arm-1.lab.example"), ["arm-1.lab.example", "arm-1", "arm-1.local"]);
        for none in ["localhost", "localhost.localdomain", "", "arm 1", "10.0.0.7"] {
            assert_eq!(names_of_host(none), [""; 0], "{none}");
        }
        let interfaces = ["10.0.0.7", "192.168.1.7", "2001:db8::7"].map(|ip| ip.parse().unwrap());
        let names = |text: &str| texts(&names_of(&config(text), &host, &interfaces));
        let always = ["arm-1", "arm-1.local", "localhost"];
        let with = |more: &[&'static str]| [&always[..], more].concat();
        assert_eq!(names("listen = ['wss://127.0.0.1']"), with(&["127.0.0.1", "::1"]));
        // Only addresses with TLS count.
        assert_eq!(
            names("listen = ['wss://10.0.0.7', 'ws://127.0.0.1']"),
            with(&["10.0.0.7", "127.0.0.1", "::1"])
        );
        let v4 = ["10.0.0.7", "127.0.0.1", "192.168.1.7", "::1"];
        assert_eq!(names("listen = ['grpcs://0.0.0.0']"), with(&v4));
        let both = ["10.0.0.7", "127.0.0.1", "192.168.1.7", "::1", "2001:db8::7"];
        assert_eq!(names("listen = ['grpcs://[::]']"), with(&both));
        let listed = names("listen = ['wss://127.0.0.1']\nnames = ['robot.example', '203.0.113.9']");
        assert!(
            listed.iter().any(|name| name == "robot.example")
                && listed.iter().any(|name| name == "203.0.113.9")
        );
    }

    #[test]
    fn certificate_is_kept_for_its_user_alone_and_its_pin_outlives_other_names() {
        let dir = tempfile::tempdir().unwrap();
        let first = config("listen = ['wss://127.0.0.1']");
        let load = |config: &GatewayConfig, now| GatewayCertificate::load(config, dir.path(), now).unwrap();
        assert!(load(&config(""), NOW).is_none(), "nothing is encrypted");
        assert!(!dir.path().join(FILE).exists());
        let one = load(&first, NOW).unwrap();
        let mode = fs::metadata(dir.path().join(FILE)).unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        assert_eq!(load(&first, NOW).unwrap().chain, one.chain);
        let another = load(&config("listen = ['wss://127.0.0.1']\nnames = ['robot.example']"), NOW).unwrap();
        assert_ne!(another.chain, one.chain);
        assert!(texts(&certificate_names(&another.chain[0])).contains(&"robot.example".to_owned()));
        let later = load(&first, UnixMillis(NOW.0 + 300 * 86_400_000)).unwrap();
        let pin = |of: &GatewayCertificate| certificate_pin(&of.chain[0]).unwrap();
        assert_eq!((pin(&another), pin(&later)), (pin(&one), pin(&one)));
        assert_eq!(later.trusted(), &later.chain[1..]);
    }

    #[test]
    fn broken_file_is_not_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let gateway = config("listen = ['wss://127.0.0.1']");
        fs::write(dir.path().join(FILE), "?").unwrap();
        let error = GatewayCertificate::load(&gateway, dir.path(), NOW).unwrap_err();
        assert!(matches!(error, GatewayCertificateError::Kept { .. }));
        assert!(error.to_string().contains("remove it"), "{error}");
        assert_eq!(fs::read(dir.path().join(FILE)).unwrap(), b"?");
    }

    #[test]
    fn urls_have_a_name_that_the_certificate_has() {
        let host = names_of_host("arm-1");
        let urls = |text: &str| urls_of(&config(text), &[], &host);
        let listen = "listen = ['wss://0.0.0.0:9443', 'grpcs://[::1]:1', 'ws://127.0.0.1']";
        assert_eq!(urls(listen), ["wss://arm-1.local:9443", "grpcs://[::1]:1", "ws://127.0.0.1:9090"]);
        let named = urls(&format!("{listen}\nnames = ['robot.example', '10.0.0.7']"));
        assert_eq!(named[0], "wss://robot.example:9443");
    }

    #[test]
    fn configured_certificate_that_ends_soon_is_warned_about() {
        let dir = tempfile::tempdir().unwrap();
        let names = ["robot".parse().unwrap()].into();
        let made = current(None, &names, NOW).unwrap().0.to_text();
        for file in ["robot.pem", "robot.key"] {
            fs::write(dir.path().join(file), made.as_bytes()).unwrap();
        }
        let file = |name: &str| dir.path().join(name).display().to_string();
        let gateway = config(&format!(
            "listen = ['wss://127.0.0.1']\ncertificate = '{}'\nkey = '{}'",
            file("robot.pem"),
            file("robot.key")
        ));
        let after = |days: u64| gateway_expiry_warning(&gateway, UnixMillis(NOW.0 + days * 86_400_000));
        assert_eq!(after(381), None);
        let warning = after(390).unwrap();
        assert!(warning.contains("robot.pem ends in 6 days"), "{warning}");
        assert_eq!(gateway_expiry_warning(&config(""), NOW), None);
    }
}
