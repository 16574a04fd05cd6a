//! The certificate by which a gateway proves itself to programs that know no CA of its fleet: browsers, Python.
//!
//! Every gateway is its own CA: clients import one certificate, and later certificates of the gateway need no second
//! import. Both certificates have the same key, so that one pin fits both. The CA certificate permits the gateway's own
//! DNS names only. This module keeps no files; the node does.

use std::collections::BTreeSet;
use std::fmt;
use std::net::IpAddr;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use rand_core::CryptoRng;
use rcgen::{
    BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, GeneralSubtree, IsCa, Issuer,
    KeyUsagePurpose, NameConstraints, PublicKeyData as _, SanType,
};
use rustls::sign::CertifiedKey;
use rustls_pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer, UnixTime};
use sgc_wire::UnixMillis;
use webpki::{EndEntityCert, ExtendedKeyUsageValidator, KeyPurposeIdIter, anchor_from_trusted_cert};
use zeroize::Zeroizing;

use crate::blocks::{CERTIFICATE_BLOCK, KEY_BLOCK};
use crate::cert_id::sha256;
use crate::issue::{CA_VALIDITY, TIME_MAX, before, common_name, date_time, hex, serial};
use crate::key::Key;
use crate::pem::{self, PemError};
use crate::verify::CHAIN_ALGORITHMS;
use crate::x509::{AlternativeName, Validity, alternative_names};

/// Validity of a server certificate from its making on. With [`SERVER_SKEW`] it is 397 days, within the bounds that
/// browsers set.
pub const SERVER_VALIDITY: Duration = Duration::from_secs(396 * 86_400);
/// Time by which a server certificate is valid before its making. Clients have no clock from SGC, so this is more than
/// fleets allow.
pub const SERVER_SKEW: Duration = Duration::from_secs(86_400);
/// Most names of one server certificate.
pub const SERVER_NAMES_MAX: usize = 128;
/// Longest file of a server certificate that is read, bytes.
pub const SERVER_FILE_BYTES_MAX: usize = 64 * 1024;

/// Divisor of the validity: a certificate is renewed when a third is left.
const RENEW_PART: u64 = 3;
/// Longest DNS name and longest label, characters (RFC 1035, 2.3.4).
const DNS_NAME_MAX: usize = 253;
const DNS_LABEL_MAX: usize = 63;
const COMMENT: &str =
    "# The gateway's own certificate, its CA, and their private key. KEEP IT SECRET and where it is.\n";

/// A name by which clients reach a server: in its certificate, a subject alternative name.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CertificateName {
    /// A DNS name in lower case, without a dot at its end.
    Dns(String),
    /// An IP address.
    Ip(IpAddr),
}

/// The reason why a text is no [`CertificateName`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CertificateNameError {
    /// The text is neither a DNS name nor an IP address.
    #[error("it takes a DNS name or an IP address, such as \"arm-1.lab.example\" or \"10.0.0.7\"")]
    Neither,
    /// The text is a URL or has a port.
    #[error("it takes a bare name, without a scheme, a port or a path: \"arm-1.lab.example\"")]
    NotBare,
    /// The name has a wildcard.
    #[error("it has a wildcard, and the certificate is for this gateway alone: list each name")]
    Wildcard,
    /// The address stands for all addresses.
    #[error("no client connects to that address: list the addresses that clients use")]
    Unspecified,
}

impl FromStr for CertificateName {
    type Err = CertificateNameError;

    fn from_str(text: &str) -> Result<Self, CertificateNameError> {
        if let Ok(ip) = text.parse::<IpAddr>() {
            let ip = ip.to_canonical();
            return if ip.is_unspecified() {
                Err(CertificateNameError::Unspecified)
            } else {
                Ok(Self::Ip(ip))
            };
        }
        if text.contains('*') {
            return Err(CertificateNameError::Wildcard);
        }
        if text.contains([':', '/']) {
            return Err(CertificateNameError::NotBare);
        }
        let name = text.strip_suffix('.').unwrap_or(text).to_ascii_lowercase();
        let is_label = |label: &str| {
            (1..=DNS_LABEL_MAX).contains(&label.len())
                && label.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
                && !label.starts_with('-')
                && !label.ends_with('-')
        };
        // A last label of digits would be read as a part of an address.
        let is_number = |label: &str| label.bytes().all(|b| b.is_ascii_digit());
        let fits = name.len() <= DNS_NAME_MAX && name.split('.').all(is_label);
        match fits && !name.rsplit('.').next().is_some_and(is_number) {
            true => Ok(Self::Dns(name)),
            false => Err(CertificateNameError::Neither),
        }
    }
}

impl fmt::Display for CertificateName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Dns(name) => f.write_str(name),
            Self::Ip(ip) => ip.fmt(f),
        }
    }
}

/// The reason why a server certificate cannot be made or read.
#[derive(Debug, thiserror::Error)]
pub enum ServerCertificateError {
    /// The file is not a sequence of blocks.
    #[error("it is not PEM")]
    File(#[source] PemError),
    /// The file does not have one key and two certificates.
    #[error("it does not hold one private key and two certificates, the gateway's and that of its CA")]
    Blocks,
    /// The key is broken.
    #[error("its private key is broken")]
    Key,
    /// A certificate is broken.
    #[error("a certificate in it cannot be read")]
    Certificate,
    /// A certificate is for another key.
    #[error("its key and its certificates do not belong together")]
    KeyMismatch,
    /// Too many names.
    #[error("a certificate has at most {SERVER_NAMES_MAX} names, and {count} are wanted")]
    TooManyNames {
        /// Their number.
        count: usize,
    },
    /// There is no name.
    #[error("a certificate needs a name")]
    NoName,
    /// A certificate could not be made.
    #[error("the certificate could not be made: {0}")]
    Making(String),
}

fn making(error: impl fmt::Display) -> ServerCertificateError {
    ServerCertificateError::Making(error.to_string())
}

/// The certificate of a gateway, that of its CA, and their common key.
pub struct ServerCertificate {
    key: Key,
    server: CertificateDer<'static>,
    authority: CertificateDer<'static>,
}

impl ServerCertificate {
    /// Makes a new key with its certificates for these names.
    pub fn generate(
        names: &BTreeSet<CertificateName>,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Self, ServerCertificateError> {
        let key = Key::generate(rng);
        let authority = make_authority(&key, names, now, rng)?;
        let server = make_server(&key, names, now, rng)?;
        Ok(Self { key, server, authority })
    }

    /// Returns the certificate for these names at this time, if it is another. It has the same key. The CA certificate
    /// is replaced only if it does not permit a name or ends soon.
    pub fn renewed(
        &self,
        names: &BTreeSet<CertificateName>,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Option<Self>, ServerCertificateError> {
        if self.names() == *names && !self.is_due(now) && self.authority_fits(&self.server, now) {
            return Ok(None);
        }
        let key = Key::from_pkcs8(self.key.pkcs8()).ok_or(ServerCertificateError::Key)?;
        let server = make_server(&key, names, now, rng)?;
        let authority = match self.authority_fits(&server, now) {
            true => self.authority.clone(),
            false => make_authority(&key, names, now, rng)?,
        };
        Ok(Some(Self { key, server, authority }))
    }

    /// Returns `true` if a third of the validity or less is left, or if the certificate is not valid yet. A clock that
    /// was wrong when the certificate was made causes the latter.
    fn is_due(&self, now: UnixMillis) -> bool {
        let third = SERVER_VALIDITY.as_millis() as u64 / RENEW_PART;
        Validity::from_certificate(&self.server).is_none_or(|validity| {
            now < validity.not_before || now.0.saturating_add(third) > validity.not_after.0
        })
    }

    /// Returns `true` if clients that trust the CA certificate accept this server certificate, for as long as it is
    /// valid.
    fn authority_fits(&self, server: &CertificateDer<'_>, now: UnixMillis) -> bool {
        let lasts = |server: Validity, ca: Validity| ca.not_before <= now && server.not_after <= ca.not_after;
        Validity::from_certificate(server)
            .zip(Validity::from_certificate(&self.authority))
            .is_some_and(|(server, ca)| lasts(server, ca))
            && verifies(server, &self.authority, now)
    }

    /// Reads the text of [`Self::to_text`].
    pub fn parse(text: &str) -> Result<Self, ServerCertificateError> {
        let blocks = pem::parse(text, SERVER_FILE_BYTES_MAX).map_err(ServerCertificateError::File)?;
        let [key, server, authority] = &blocks[..] else { return Err(ServerCertificateError::Blocks) };
        if [&key.label, &server.label, &authority.label] != [KEY_BLOCK, CERTIFICATE_BLOCK, CERTIFICATE_BLOCK]
        {
            return Err(ServerCertificateError::Blocks);
        }
        let key = Key::from_pkcs8(&key.content).ok_or(ServerCertificateError::Key)?;
        let certificate = |content: &[u8]| CertificateDer::from(content.to_vec());
        let (server, authority) = (certificate(&server.content), certificate(&authority.content));
        let spki = key.subject_public_key_info();
        for certificate in [&server, &authority] {
            let end =
                EndEntityCert::try_from(certificate).map_err(|_| ServerCertificateError::Certificate)?;
            let has_fields =
                Validity::from_certificate(certificate).is_some() && alternative_names(certificate).is_some();
            if !has_fields {
                return Err(ServerCertificateError::Certificate);
            }
            if end.subject_public_key_info().as_ref() != spki {
                return Err(ServerCertificateError::KeyMismatch);
            }
        }
        Ok(Self { key, server, authority })
    }

    /// Returns key and certificates as text, for a file that only its owner may read.
    pub fn to_text(&self) -> Zeroizing<String> {
        let certificates =
            [(CERTIFICATE_BLOCK, self.server.as_ref()), (CERTIFICATE_BLOCK, self.authority.as_ref())];
        pem::write(COMMENT, &[&[(KEY_BLOCK, self.key.pkcs8())][..], &certificates].concat())
    }

    /// Returns chain and private key for TLS.
    pub fn certified_key(&self) -> Result<Arc<CertifiedKey>, ServerCertificateError> {
        let pkcs8 = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(self.key.pkcs8()));
        let key = rustls::crypto::aws_lc_rs::sign::any_supported_type(&pkcs8)
            .map_err(|_| ServerCertificateError::Key)?;
        Ok(Arc::new(CertifiedKey::new(vec![self.server.clone(), self.authority.clone()], key)))
    }

    /// Returns the CA certificate: trusting it means trusting this gateway.
    pub fn authority(&self) -> &CertificateDer<'static> {
        &self.authority
    }

    /// Returns the server certificate.
    pub fn server(&self) -> &CertificateDer<'static> {
        &self.server
    }

    /// Returns the names of the server certificate.
    pub fn names(&self) -> BTreeSet<CertificateName> {
        certificate_names(&self.server)
    }
}

impl fmt::Debug for ServerCertificate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ServerCertificate").field("names", &self.names()).finish_non_exhaustive()
    }
}

/// Returns the pin of a certificate, `sha256/BASE64`: the hash of its public key (SubjectPublicKeyInfo; RFC 7469, 2.4).
/// `None` if the certificate cannot be read.
pub fn certificate_pin(certificate: &[u8]) -> Option<String> {
    let der = CertificateDer::from(certificate);
    let spki = EndEntityCert::try_from(&der).ok()?.subject_public_key_info();
    Some(format!("sha256/{}", STANDARD.encode(sha256(&[&spki]))))
}

/// Returns the DNS names and addresses in a certificate; none if it cannot be read.
pub fn certificate_names(certificate: &[u8]) -> BTreeSet<CertificateName> {
    let names = alternative_names(certificate).unwrap_or_default().into_iter();
    let known = names.filter_map(|name| match name {
        AlternativeName::Dns(name) => Some(CertificateName::Dns(name.to_owned())),
        AlternativeName::Ip(ip) => Some(CertificateName::Ip(ip)),
        AlternativeName::Other => None,
    });
    known.collect()
}

/// Returns the last moment at which a certificate is valid; `None` if it cannot be read.
pub fn certificate_end(certificate: &[u8]) -> Option<UnixMillis> {
    Validity::from_certificate(certificate).map(|validity| validity.not_after)
}

/// Returns the name of the gateway in its certificates. It derives from the key, so that two gateways never share one.
fn subject(key: &Key) -> String {
    format!("sgc gateway {}", hex(&sha256(&[&key.subject_public_key_info()])[..4]))
}

fn make_authority(
    key: &Key,
    names: &BTreeSet<CertificateName>,
    now: UnixMillis,
    rng: &mut impl CryptoRng,
) -> Result<CertificateDer<'static>, ServerCertificateError> {
    check_names(names)?;
    let mut params = authority_params(key);
    // Some verifiers, such as that of gRPC, refuse every certificate below a CA with constraints of addresses.
    let permitted = names.iter().filter_map(|name| match name {
        CertificateName::Dns(name) => Some(GeneralSubtree::DnsName(name.clone())),
        CertificateName::Ip(_) => None,
    });
    let permitted_subtrees: Vec<_> = permitted.collect();
    if !permitted_subtrees.is_empty() {
        params.name_constraints = Some(NameConstraints { permitted_subtrees, excluded_subtrees: Vec::new() });
    }
    params.not_before = date_time!(before(now, SERVER_SKEW));
    params.not_after = date_time!(after(now, CA_VALIDITY));
    params.serial_number = Some(serial(rng));
    Ok(params.self_signed(key).map_err(making)?.into())
}

/// Returns the parameters of the CA certificate that decide about certificates below it.
fn authority_params(key: &Key) -> CertificateParams {
    let mut params = CertificateParams::default();
    params.distinguished_name = common_name(&subject(key));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(0));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    params
}

fn make_server(
    key: &Key,
    names: &BTreeSet<CertificateName>,
    now: UnixMillis,
    rng: &mut impl CryptoRng,
) -> Result<CertificateDer<'static>, ServerCertificateError> {
    check_names(names)?;
    let san = |name: &CertificateName| match name {
        CertificateName::Dns(name) => Ok(SanType::DnsName(name.clone().try_into().map_err(making)?)),
        CertificateName::Ip(ip) => Ok(SanType::IpAddress(*ip)),
    };
    let mut params = CertificateParams::default();
    // Issuer and subject have to differ, or the certificate would count as self-signed.
    params.distinguished_name = common_name(&format!("{} server", subject(key)));
    params.subject_alt_names = names.iter().map(san).collect::<Result<_, _>>()?;
    params.is_ca = IsCa::ExplicitNoCa;
    params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    params.use_authority_key_identifier_extension = true;
    params.not_before = date_time!(before(now, SERVER_SKEW));
    params.not_after = date_time!(after(now, SERVER_VALIDITY));
    params.serial_number = Some(serial(rng));
    let authority = authority_params(key);
    Ok(params.signed_by(key, &Issuer::from_params(&authority, key)).map_err(making)?.into())
}

fn check_names(names: &BTreeSet<CertificateName>) -> Result<(), ServerCertificateError> {
    match names.len() {
        0 => Err(ServerCertificateError::NoName),
        1..=SERVER_NAMES_MAX => Ok(()),
        count => Err(ServerCertificateError::TooManyNames { count }),
    }
}

fn after(now: UnixMillis, by: Duration) -> UnixMillis {
    let by = u64::try_from(by.as_millis()).unwrap_or(u64::MAX);
    UnixMillis(now.0.saturating_add(by)).min(TIME_MAX)
}

/// Returns `true` if a client that trusts `authority` accepts `server`.
fn verifies(server: &CertificateDer<'_>, authority: &CertificateDer<'_>, now: UnixMillis) -> bool {
    let Ok(anchor) = anchor_from_trusted_cert(authority) else { return false };
    let Ok(end) = EndEntityCert::try_from(server) else { return false };
    let time = UnixTime::since_unix_epoch(Duration::from_millis(now.0));
    end.verify_for_usage(CHAIN_ALGORITHMS, &[anchor], &[], time, AnyUsage, None, None).is_ok()
}

/// No requirement on the usage: both certificates come from this module.
struct AnyUsage;

impl ExtendedKeyUsageValidator for AnyUsage {
    fn validate(&self, _: KeyPurposeIdIter<'_, '_>) -> Result<(), webpki::Error> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use rand_chacha::ChaCha20Rng;
    use rand_core::SeedableRng as _;

    use super::*;

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);
    const DAY: u64 = 86_400_000;

    fn names(names: &[&str]) -> BTreeSet<CertificateName> {
        names.iter().map(|name| name.parse().unwrap()).collect()
    }

    fn rng() -> ChaCha20Rng {
        ChaCha20Rng::seed_from_u64(9)
    }

    fn later(days: u64) -> UnixMillis {
        UnixMillis(NOW.0 + days * DAY)
    }

    #[test]
    fn names_are_dns_names_and_addresses_and_nothing_else() {
        for (text, name) in [
            ("Arm-1.Lab.example.", "arm-1.lab.example"),
            ("robot", "robot"),
            ("my_robot.local", "my_robot.local"),
            ("10.0.0.7", "10.0.0.7"),
            ("fd00::7", "fd00::7"),
            ("::ffff:10.0.0.7", "10.0.0.7"),
        ] {
            assert_eq!(text.parse::<CertificateName>().unwrap().to_string(), name);
        }
        let refused = |text: &str| text.parse::<CertificateName>().unwrap_err();
        for text in ["", ".", "a..b", "-a", "a-", "a b", "10.0.0", "10.0.0.256", "ä.example", &"a".repeat(64)]
        {
            assert_eq!(refused(text), CertificateNameError::Neither, "{text}");
        }
        assert_eq!(refused(&vec!["abcdefg"; 40].join(".")), CertificateNameError::Neither);
        for text in ["wss://robot", "robot:9090", "robot/x", "[::1]", "10.0.0.7:1"] {
            assert_eq!(refused(text), CertificateNameError::NotBare, "{text}");
        }
        assert_eq!(refused("*.lab.example"), CertificateNameError::Wildcard);
        for text in ["0.0.0.0", "::"] {
            assert_eq!(refused(text), CertificateNameError::Unspecified, "{text}");
        }
    }

    #[test]
    fn certificate_has_its_names_and_both_have_one_pin() {
        let wanted = names(&["robot", "robot.local", "10.0.0.7", "::1"]);
        let made = ServerCertificate::generate(&wanted, NOW, &mut rng()).unwrap();
        assert_eq!(made.names(), wanted);
        let pin = certificate_pin(made.server()).unwrap();
        assert_eq!(Some(&pin), certificate_pin(made.authority()).as_ref());
        assert_eq!(pin.strip_prefix("sha256/").map(str::len), Some(44));
        let validity = Validity::from_certificate(made.server()).unwrap();
        let days = (validity.not_after.0 - validity.not_before.0) / DAY;
        assert_eq!(days, 397, "browsers take no more");
        assert!(verifies(made.server(), made.authority(), NOW));
        assert_eq!(made.certified_key().unwrap().cert, [made.server().clone(), made.authority().clone()]);
    }

    #[test]
    fn clients_of_another_gateway_refuse_the_certificate() {
        let wanted = names(&["robot"]);
        let mut rng = rng();
        let made = ServerCertificate::generate(&wanted, NOW, &mut rng).unwrap();
        let another = ServerCertificate::generate(&wanted, NOW, &mut rng).unwrap();
        assert!(!verifies(made.server(), another.authority(), NOW));
        assert_ne!(certificate_pin(made.server()), certificate_pin(another.server()));
    }

    #[test]
    fn renewal_keeps_the_key_and_the_imported_certificate() {
        let wanted = names(&["robot", "10.0.0.7"]);
        let first = ServerCertificate::generate(&wanted, NOW, &mut rng()).unwrap();
        let renewed = |now, names| first.renewed(&names, now, &mut rng()).unwrap();
        assert!(renewed(later(0), wanted.clone()).is_none());
        assert!(renewed(later(263), wanted.clone()).is_none());
        let second = renewed(later(265), wanted.clone()).unwrap();
        assert_eq!(second.authority(), first.authority());
        assert_eq!(certificate_pin(second.server()), certificate_pin(first.server()));
        assert!(verifies(second.server(), first.authority(), later(400)), "the first has ended by now");
        assert!(!verifies(first.server(), first.authority(), later(400)));
        // The clock was wrong, and is set back.
        assert!(renewed(UnixMillis(NOW.0 - 2 * DAY), wanted).is_some());
        // Addresses come and go, and a name may go.
        for names in [names(&["robot", "10.0.0.8", "2001:db8::1"]), names(&["10.0.0.7", "robot", "a.robot"])]
        {
            let moved = renewed(NOW, names.clone()).unwrap();
            assert_eq!((moved.names(), moved.authority()), (names, first.authority()));
        }
    }

    #[test]
    fn imported_certificate_permits_no_other_name() {
        let first = ServerCertificate::generate(&names(&["robot"]), NOW, &mut rng()).unwrap();
        let wanted = names(&["robot", "bank.example"]);
        let second = first.renewed(&wanted, NOW, &mut rng()).unwrap().unwrap();
        assert!(!verifies(second.server(), first.authority(), NOW));
        assert_ne!(second.authority(), first.authority());
        assert!(verifies(second.server(), second.authority(), NOW));
        assert_eq!(certificate_pin(second.server()), certificate_pin(first.server()));
    }

    #[test]
    fn ca_certificate_is_replaced_before_it_would_end_before_the_server_certificate() {
        let wanted = names(&["robot"]);
        let first = ServerCertificate::generate(&wanted, NOW, &mut rng()).unwrap();
        let at = later(10 * 365 - 300);
        let second = first.renewed(&wanted, at, &mut rng()).unwrap().unwrap();
        assert_ne!(second.authority(), first.authority());
        assert!(verifies(second.server(), first.authority(), at), "clients have time to import the next");
    }

    #[test]
    fn file_round_trips_and_a_broken_one_names_its_fault() {
        let wanted = names(&["robot", "::1"]);
        let made = ServerCertificate::generate(&wanted, NOW, &mut rng()).unwrap();
        let another = ServerCertificate::generate(&wanted, NOW, &mut ChaCha20Rng::seed_from_u64(1)).unwrap();
        let text = made.to_text();
        let read = ServerCertificate::parse(&text).unwrap();
        assert_eq!((read.server(), read.authority()), (made.server(), made.authority()));
        assert!(!format!("{read:?}").contains("PRIVATE"));
        let refused = |text: &str| ServerCertificate::parse(text).unwrap_err();
        assert!(matches!(refused(""), ServerCertificateError::Blocks));
        assert!(matches!(refused(&text[..text.len() - 40]), ServerCertificateError::File(_)));
        let mixed = |key: &ServerCertificate, chain: &ServerCertificate| {
            let certificates =
                [(CERTIFICATE_BLOCK, chain.server.as_ref()), (CERTIFICATE_BLOCK, &chain.authority)];
            pem::write("", &[&[(KEY_BLOCK, key.key.pkcs8())][..], &certificates].concat())
        };
        assert!(matches!(refused(&mixed(&another, &made)), ServerCertificateError::KeyMismatch));
        let text = text.replace("PRIVATE KEY", "CERTIFICATE");
        assert!(matches!(refused(&text), ServerCertificateError::Blocks));
        let broken = pem::write(
            "",
            &[(KEY_BLOCK, made.key.pkcs8()), (CERTIFICATE_BLOCK, &[1]), (CERTIFICATE_BLOCK, &[2])],
        );
        assert!(matches!(refused(&broken), ServerCertificateError::Certificate));
    }

    #[test]
    fn number_of_names_is_bounded() {
        let many: BTreeSet<_> =
            (0..=SERVER_NAMES_MAX).map(|n| CertificateName::Dns(format!("robot-{n}"))).collect();
        let made = |names: &BTreeSet<_>| ServerCertificate::generate(names, NOW, &mut rng()).map(|_| ());
        assert!(matches!(made(&many), Err(ServerCertificateError::TooManyNames { count: 129 })));
        assert!(matches!(made(&BTreeSet::new()), Err(ServerCertificateError::NoName)));
        assert!(made(&many.into_iter().take(SERVER_NAMES_MAX).collect()).is_ok());
    }
}
