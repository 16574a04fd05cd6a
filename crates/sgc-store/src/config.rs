//! [`StoreConfig`]: the servers of a store, the prefix of the keys, the user and TLS.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use rustls::{ClientConfig, RootCertStore};
use rustls_pki_types::pem::PemObject as _;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use thiserror::Error;
use zeroize::Zeroizing;

/// The port of a server whose URL names none.
pub const PORT_DEFAULT: u16 = 6379;
/// Most servers that a configuration names. The servers name the others of a cluster themselves.
pub const SERVERS_MAX: usize = 16;
/// Most bytes of a host name (RFC 1035).
pub(crate) const HOST_BYTES_MAX: usize = 253;
/// Most bytes of a prefix. Each key has it.
pub const PREFIX_BYTES_MAX: usize = 32;
/// Most bytes of a user's name, and of its password.
const USER_BYTES_MAX: usize = 255;
const PASSWORD_BYTES_MAX: usize = 1024;
/// The prefix of a configuration that names none.
const PREFIX_DEFAULT: &str = "sgc";

/// The host and port of a server.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) struct ServerAddress {
    /// A name, an IPv4 address, or an IPv6 address without brackets.
    pub(crate) host: Arc<str>,
    pub(crate) port: u16,
}

impl ServerAddress {
    /// Returns the address if the host is the name of a host or an address.
    pub(crate) fn new(host: &str, port: u16) -> Option<Self> {
        let is_valid = !host.is_empty()
            && host.len() <= HOST_BYTES_MAX
            && port != 0
            && ServerName::try_from(host).is_ok();
        is_valid.then(|| Self { host: host.into(), port })
    }
}

impl fmt::Display for ServerAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.host.contains(':') {
            true => write!(f, "[{}]:{}", self.host, self.port),
            false => write!(f, "{}:{}", self.host, self.port),
        }
    }
}

/// A server that the configuration names.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoreServer {
    pub(crate) address: ServerAddress,
    is_encrypted: bool,
}

/// The reason why the URL of a server is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StoreServerError {
    /// The scheme is none of a store.
    #[error("\"{url}\" is no server of a store: write valkey://HOST:PORT, or valkeys://HOST:PORT with TLS")]
    Scheme {
        /// The URL.
        url: String,
    },
    /// The URL has a user or password.
    #[error(
        "a URL with a user or password ends up in logs: give the user and the file of its password apart"
    )]
    UserInfo,
    /// The URL has a path: the number of a database, which a cluster does not have.
    #[error("\"{path}\" behind the server: a cluster has one database; tell fleets apart by prefixes")]
    Path {
        /// The path.
        path: String,
    },
    /// The host is neither a name nor an address.
    #[error("\"{host}\" is neither the name of a host nor an address")]
    Host {
        /// The host.
        host: String,
    },
    /// The port is none.
    #[error("\"{port}\" is no port: a number from 1 to 65535")]
    Port {
        /// The port.
        port: String,
    },
}

impl StoreServer {
    /// Parses `valkey://HOST[:PORT]` or, with TLS, `valkeys://HOST[:PORT]`. `redis://` and `rediss://` mean the same.
    pub fn parse(url: &str) -> Result<Self, StoreServerError> {
        let (scheme, rest) = url.split_once("://").unwrap_or_default();
        let is_encrypted = match scheme {
            "valkey" | "redis" => false,
            "valkeys" | "rediss" => true,
            _ => return Err(StoreServerError::Scheme { url: url.into() }),
        };
        if rest.contains('@') {
            return Err(StoreServerError::UserInfo);
        }
        let place = match rest.find(['/', '?', '#']) {
            None => rest,
            Some(end) if &rest[end..] == "/" => &rest[..end],
            Some(end) => return Err(StoreServerError::Path { path: rest[end..].into() }),
        };
        let (host, port) = match place.strip_prefix('[') {
            Some(bracketed) => match bracketed.split_once(']') {
                Some((host, "")) => (host, None),
                Some((host, port)) => match port.strip_prefix(':') {
                    Some(port) => (host, Some(port)),
                    None => return Err(StoreServerError::Host { host: place.into() }),
                },
                None => return Err(StoreServerError::Host { host: place.into() }),
            },
            None => match place.rsplit_once(':') {
                Some((host, port)) => (host, Some(port)),
                None => (place, None),
            },
        };
        let port = match port {
            None => PORT_DEFAULT,
            Some(text) => match u16::from_str(text) {
                Ok(port) if port != 0 => port,
                _ => return Err(StoreServerError::Port { port: text.into() }),
            },
        };
        let address =
            ServerAddress::new(host, port).ok_or_else(|| StoreServerError::Host { host: host.into() })?;
        Ok(Self { address, is_encrypted })
    }

    /// Returns whether connections have TLS.
    pub fn is_encrypted(&self) -> bool {
        self.is_encrypted
    }
}

impl FromStr for StoreServer {
    type Err = StoreServerError;

    fn from_str(url: &str) -> Result<Self, Self::Err> {
        Self::parse(url)
    }
}

impl fmt::Display for StoreServer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scheme = if self.is_encrypted { "valkeys" } else { "valkey" };
        write!(f, "{scheme}://{}", self.address)
    }
}

/// The beginning of all keys of a fleet, without the colon behind it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StorePrefix(String);

/// The reason why a prefix is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StorePrefixError {
    /// The prefix is empty or too long.
    #[error("a prefix has 1 to {PREFIX_BYTES_MAX} characters")]
    Length,
    /// A character that ACL patterns or hash tags of the store would read as their own.
    #[error("'{0}' in a prefix: use letters, digits, '-', '_' and '.'")]
    Character(char),
}

impl StorePrefix {
    /// Checks a prefix.
    pub fn new(prefix: &str) -> Result<Self, StorePrefixError> {
        // `*`, `?`, `[` and `\` are patterns of ACLs. `{` would put all keys into one slot.
        match prefix.chars().find(|c| !c.is_ascii_alphanumeric() && !matches!(c, '-' | '_' | '.')) {
            Some(c) => Err(StorePrefixError::Character(c)),
            None if prefix.is_empty() || prefix.len() > PREFIX_BYTES_MAX => Err(StorePrefixError::Length),
            None => Ok(Self(prefix.into())),
        }
    }

    /// Returns the prefix.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl Default for StorePrefix {
    fn default() -> Self {
        Self(PREFIX_DEFAULT.into())
    }
}

impl FromStr for StorePrefix {
    type Err = StorePrefixError;

    fn from_str(prefix: &str) -> Result<Self, Self::Err> {
        Self::new(prefix)
    }
}

impl fmt::Display for StorePrefix {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A user of the store's ACL, with the password.
#[derive(Clone)]
pub struct StoreUser {
    pub(crate) name: String,
    pub(crate) password: Zeroizing<Vec<u8>>,
}

/// The reason why a user is wrong.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StoreUserError {
    /// The name is empty, too long, or has a space or control character.
    #[error("the name of a store's user has 1 to {USER_BYTES_MAX} characters without spaces")]
    Name,
    /// The password is empty or too long.
    #[error("the password of a store's user has 1 to {PASSWORD_BYTES_MAX} bytes")]
    Password,
}

impl StoreUser {
    /// Takes a name and the content of the file with the password. A line break at its end is no part of the password.
    pub fn new(name: &str, password_file: Vec<u8>) -> Result<Self, StoreUserError> {
        let password = Self::read_password(password_file)?;
        Self::check_name(name)?;
        Ok(Self { name: name.into(), password })
    }

    /// Returns the password in the content of its file.
    pub fn read_password(file: Vec<u8>) -> Result<Zeroizing<Vec<u8>>, StoreUserError> {
        let mut password = Zeroizing::new(file);
        while matches!(password.last(), Some(b'\n' | b'\r')) {
            password.pop();
        }
        let is_password = !password.is_empty() && password.len() <= PASSWORD_BYTES_MAX;
        if is_password { Ok(password) } else { Err(StoreUserError::Password) }
    }

    /// Checks a name.
    pub fn check_name(name: &str) -> Result<(), StoreUserError> {
        let is_odd = |c: char| c.is_whitespace() || c.is_control();
        let is_name = !name.is_empty() && name.len() <= USER_BYTES_MAX && !name.contains(is_odd);
        if is_name { Ok(()) } else { Err(StoreUserError::Name) }
    }

    /// Returns the name.
    pub fn name(&self) -> &str {
        &self.name
    }
}

impl fmt::Debug for StoreUser {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StoreUser").field("name", &self.name).finish_non_exhaustive()
    }
}

/// TLS of the connections: the CAs that vouch for the servers, and the own certificate.
#[derive(Clone)]
pub struct StoreTls(pub(crate) Arc<ClientConfig>);

/// The reason why TLS cannot be set up.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StoreTlsError {
    /// The PEM text has no CA certificate.
    #[error("the CAs of the store: no certificate in PEM format")]
    NoCa,
    /// A CA certificate is broken.
    #[error("the CAs of the store: {reason}")]
    Ca {
        /// The reason.
        reason: String,
    },
    /// The system has no CA certificates.
    #[error(
        "this system has no CA certificates: install them (`ca-certificates`), or name the file of the store's CAs"
    )]
    NoSystemCa,
    /// The certificate or its key is broken, or they do not belong together.
    #[error("the certificate for the store: {reason}")]
    Certificate {
        /// The reason.
        reason: String,
    },
}

impl StoreTls {
    /// Takes PEM texts: the CAs that vouch for the servers (`None`: those of the system, which are read and block), and
    /// the own certificate chain with its key, if the servers want one.
    pub fn new(
        ca: Option<&[u8]>,
        certificate_and_key: Option<(&[u8], &[u8])>,
    ) -> Result<Self, StoreTlsError> {
        let mut roots = RootCertStore::empty();
        match ca {
            Some(pem) => {
                let broken = |reason: String| StoreTlsError::Ca { reason };
                for certificate in CertificateDer::pem_slice_iter(pem) {
                    let certificate = certificate.map_err(|error| broken(error.to_string()))?;
                    roots.add(certificate).map_err(|error| broken(error.to_string()))?;
                }
                if roots.is_empty() {
                    return Err(StoreTlsError::NoCa);
                }
            }
            None => {
                // One bad file among hundreds must not hide the others.
                roots.add_parsable_certificates(rustls_native_certs::load_native_certs().certs);
                if roots.is_empty() {
                    return Err(StoreTlsError::NoSystemCa);
                }
            }
        }
        let broken = |reason: String| StoreTlsError::Certificate { reason };
        let provider = Arc::new(rustls::crypto::aws_lc_rs::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(|error| broken(error.to_string()))?
            .with_root_certificates(roots);
        let config = match certificate_and_key {
            None => builder.with_no_client_auth(),
            Some((certificate, key)) => {
                let chain: Vec<_> = CertificateDer::pem_slice_iter(certificate)
                    .collect::<Result<_, _>>()
                    .map_err(|error| broken(error.to_string()))?;
                if chain.is_empty() {
                    return Err(broken("no certificate in PEM format".into()));
                }
                let key = PrivateKeyDer::from_pem_slice(key).map_err(|error| broken(error.to_string()))?;
                builder.with_client_auth_cert(chain, key).map_err(|error| broken(error.to_string()))?
            }
        };
        Ok(Self(Arc::new(config)))
    }
}

impl fmt::Debug for StoreTls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StoreTls").finish_non_exhaustive()
    }
}

/// A store, and how to use it.
#[derive(Clone, Debug)]
pub struct StoreConfig {
    pub(crate) servers: Vec<StoreServer>,
    pub(crate) prefix: StorePrefix,
    pub(crate) user: Option<StoreUser>,
    pub(crate) tls: Option<StoreTls>,
}

/// The reason why the parts of a [`StoreConfig`] do not fit together.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum StoreConfigError {
    /// There is no server, or there are too many.
    #[error("a store has 1 to {SERVERS_MAX} servers here; a cluster names its others itself")]
    ServerCount,
    /// Some servers have TLS, some not.
    #[error(
        "some servers of the store have TLS (valkeys://) and some do not: the password would go unencrypted"
    )]
    MixedSchemes,
    /// The servers have TLS, and the configuration of TLS is missing.
    #[error("servers with TLS (valkeys://) need the CAs that vouch for them")]
    TlsMissing,
    /// TLS is configured for servers without it.
    #[error("certificates for a store without TLS: write valkeys:// instead of valkey://")]
    TlsUnused,
}

impl StoreConfig {
    /// Puts the parts together. All servers have TLS, together with `tls`, or none has.
    pub fn new(
        servers: Vec<StoreServer>,
        prefix: StorePrefix,
        user: Option<StoreUser>,
        tls: Option<StoreTls>,
    ) -> Result<Self, StoreConfigError> {
        if servers.is_empty() || servers.len() > SERVERS_MAX {
            return Err(StoreConfigError::ServerCount);
        }
        match (servers.iter().filter(|server| server.is_encrypted).count(), &tls) {
            (0, Some(_)) => Err(StoreConfigError::TlsUnused),
            (0, None) => Ok(()),
            (encrypted, _) if encrypted < servers.len() => Err(StoreConfigError::MixedSchemes),
            (_, None) => Err(StoreConfigError::TlsMissing),
            (_, Some(_)) => Ok(()),
        }?;
        Ok(Self { servers, prefix, user, tls })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn urls_of_servers_are_parsed() {
        for (url, shown) in [
            ("valkey://store-1.example:7000", "valkey://store-1.example:7000"),
            ("redis://10.0.0.1", "valkey://10.0.0.1:6379"),
            ("rediss://store:1/", "valkeys://store:1"),
            ("valkeys://[2001:db8::1]:6380", "valkeys://[2001:db8::1]:6380"),
            ("valkey://[::1]", "valkey://[::1]:6379"),
        ] {
            assert_eq!(StoreServer::parse(url).unwrap().to_string(), shown);
        }
    }

    #[test]
    fn wrong_urls_are_refused_with_the_reason() {
        let refused = |url: &str| StoreServer::parse(url).unwrap_err();
        for url in ["store-1:6379", "http://store-1", "", "valkey:store"] {
            assert!(matches!(refused(url), StoreServerError::Scheme { .. }), "{url}");
        }
        assert_eq!(refused("valkey://me:secret@store"), StoreServerError::UserInfo);
        assert_eq!(refused("valkey://store/3"), StoreServerError::Path { path: "/3".into() });
        for url in [
            "valkey://",
            "valkey://:6379",
            "valkey://a b",
            "valkey://[::1",
            "valkey://[::1]x",
            "valkey://::1",
        ] {
            assert!(matches!(refused(url), StoreServerError::Host { .. }), "{url}");
        }
        for url in ["valkey://store:", "valkey://store:0", "valkey://store:65536", "valkey://store:six"] {
            assert!(matches!(refused(url), StoreServerError::Port { .. }), "{url}");
        }
    }

    #[test]
    fn prefixes_have_no_characters_with_a_meaning() {
        assert_eq!(StorePrefix::new("fleet-a.1_x").unwrap().as_str(), "fleet-a.1_x");
        for (prefix, odd) in [("a*", '*'), ("{a}", '{'), ("a:b", ':'), ("a b", ' '), ("ä", 'ä')] {
            assert_eq!(StorePrefix::new(prefix), Err(StorePrefixError::Character(odd)));
        }
        assert_eq!(StorePrefix::new(""), Err(StorePrefixError::Length));
        assert_eq!(StorePrefix::new(&"a".repeat(33)), Err(StorePrefixError::Length));
    }

    #[test]
    fn passwords_lose_the_line_break_and_stay_out_of_debug_output() {
        let user = StoreUser::new("router", b"hunter2\n".to_vec()).unwrap();
        assert_eq!(user.password.as_slice(), b"hunter2");
        assert!(!format!("{user:?}").contains("hunter2"));
        assert_eq!(StoreUser::new("router", b"\n".to_vec()).unwrap_err(), StoreUserError::Password);
        assert_eq!(StoreUser::new("a b", b"x".to_vec()).unwrap_err(), StoreUserError::Name);
    }

    #[test]
    fn parts_that_do_not_fit_together_are_refused() {
        let server = |url| StoreServer::parse(url).unwrap();
        let new = |servers: Vec<StoreServer>| StoreConfig::new(servers, StorePrefix::default(), None, None);
        assert!(new(vec![server("valkey://a")]).is_ok());
        assert_eq!(new(vec![]).unwrap_err(), StoreConfigError::ServerCount);
        assert_eq!(new(vec![server("valkey://a"); 17]).unwrap_err(), StoreConfigError::ServerCount);
        let mixed = vec![server("valkey://a"), server("valkeys://b")];
        assert_eq!(new(mixed).unwrap_err(), StoreConfigError::MixedSchemes);
        assert_eq!(new(vec![server("valkeys://a")]).unwrap_err(), StoreConfigError::TlsMissing);
        assert_eq!(StoreTls::new(Some(b"nothing"), None).unwrap_err(), StoreTlsError::NoCa);
    }
}
