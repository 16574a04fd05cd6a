//! Makes everything that a CA signs: certificates of nodes and revocation lists. Reads requests for certificates.
//!
//! This module keeps no state and decides nothing: [`crate::Fleet`] decides who gets which certificate.

use std::collections::BTreeSet;
use std::fmt;
use std::time::Duration;

use aws_lc_rs::digest;
use rand_core::CryptoRng;
use rcgen::string::{BmpString, Ia5String, PrintableString, TeletexString, UniversalString};
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DistinguishedName, DnType, DnValue,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyUsagePurpose, PublicKeyData, RevokedCertParams,
    SanType, SerialNumber, SigningKey as _,
};
use rustls_pki_types::CertificateDer;
use sgc_wire::{CRL_BYTES_MAX, CSR_BYTES_MAX, GroupTag, Pseudonym, UnixMillis};
use zeroize::Zeroizing;

use crate::blocks::KEY_BLOCK;
use crate::cert_id::sha256;
use crate::fleet_error::FleetError;
use crate::invitation_bounds::INVITATION_SERIAL;
use crate::key::Key;
use crate::label::{GroupName, NodeName};
use crate::peer::{GROUP_URI, INCARNATION_URI, INVITATION_URI, NODE_URI, ROUTER_URI};
use crate::pem;
use crate::revocations::{LIST_NODES_MAX, RevokedNodes};
use crate::secret::FleetSecret;
use crate::verify::CHAIN_ALGORITHMS;
use crate::x509::{CaFields, ListFields, RequestFields, RevokedNodeFields, Serial, Validity};

/// Validity of the CA's certificate.
pub const CA_VALIDITY: Duration = Duration::from_secs(10 * 365 * 86_400);
/// Time until a revocation list announces the next one; nodes keep to a list for longer.
pub const CRL_VALIDITY: Duration = Duration::from_secs(30 * 86_400);
/// Time by which a certificate is valid before its making: clocks of machines differ by minutes.
pub const CLOCK_SKEW: Duration = Duration::from_secs(600);

/// The year 9000: the times of certificates end a little later.
pub(crate) const TIME_MAX: UnixMillis = UnixMillis(221_845_392_000_000);

/// A time in whole seconds, as in certificates. A macro, because the type of the result belongs to a crate (`time`)
/// that is not a dependency of this one.
macro_rules! date_time {
    ($millis:expr) => {
        rcgen::date_time_ymd(1970, 1, 1) + Duration::from_secs($millis.secs())
    };
}
pub(crate) use date_time;

/// Most bytes of a revocation list besides its entries: the name of its CA, a signature, and the fixed fields.
const LIST_HEAD_BYTES_MAX: usize = 6500;
/// Most bytes of an entry with a serial number: with its heads, 20 for the number and 15 for the time.
const SERIAL_ENTRY_BYTES_MAX: usize = 2 + 22 + 17;
/// Most bytes of all extensions of a list that path validation reads, and of those among them that are not ours.
const EXTENSIONS_BYTES_MAX: usize = 0xffff;
const OTHER_EXTENSIONS_BYTES_MAX: usize = 256;
const _: () = assert!(
    OTHER_EXTENSIONS_BYTES_MAX + LIST_NODES_MAX * RevokedNodeFields::BYTES_MAX <= EXTENSIONS_BYTES_MAX
);
const _: () = assert!(LIST_HEAD_BYTES_MAX + LIST_NODES_MAX * RevokedNodeFields::BYTES_MAX <= CRL_BYTES_MAX);

/// Content of a node's certificate.
pub(crate) struct Leaf {
    pub(crate) pseudonym: Pseudonym,
    pub(crate) groups: Vec<GroupTag>,
    pub(crate) may_route: bool,
    pub(crate) incarnation: u32,
    /// Validity of the certificate to which this one entitles, if it is an invitation.
    pub(crate) invitation: Option<Duration>,
    pub(crate) valid: Duration,
    pub(crate) now: UnixMillis,
}

impl Leaf {
    fn params(&self) -> Result<CertificateParams, FleetError> {
        let mut params = CertificateParams::default();
        params.distinguished_name = common_name(&self.pseudonym.to_string());
        params.subject_alt_names = sans(&self.pseudonym, &self.groups, self.may_route, self.incarnation)?;
        if let Some(valid) = self.invitation {
            params.subject_alt_names.push(uri(format!("{INVITATION_URI}{}", valid.as_secs()))?);
        }
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        params.use_authority_key_identifier_extension = true;
        Ok(params)
    }

    /// Makes a certificate for `key`, and returns it with its serial number.
    pub(crate) fn sign(
        &self,
        key: &impl PublicKeyData,
        ca: &CertificateDer<'_>,
        ca_key: &Key,
        validity: Validity,
        rng: &mut impl CryptoRng,
    ) -> Result<CertificateDer<'static>, FleetError> {
        let mut params = self.params()?;
        params.serial_number = Some(match self.invitation {
            None => serial(rng),
            Some(_) => {
                let mut bytes = [0; 20];
                rng.fill_bytes(&mut bytes);
                bytes[..INVITATION_SERIAL.len()].copy_from_slice(&INVITATION_SERIAL);
                SerialNumber::from_slice(&bytes)
            }
        });
        // The validity lies within the CA's: a certificate that outlives its CA would fail unexpectedly.
        params.not_before = date_time!(before(self.now, CLOCK_SKEW).max(validity.not_before));
        params.not_after = date_time!(after(self.now, self.valid)?.min(validity.not_after));
        let issuer = issuer_params(ca)?;
        let certificate = params.signed_by(key, &Issuer::from_params(&issuer, ca_key));
        Ok(certificate.map_err(FleetError::making)?.into())
    }
}

/// Makes the CA certificate of a new fleet from `key`. Its subject derives from its key: two CAs never share one, so
/// that a certificate of another fleet is told apart from a forged one, and the subject reveals nothing of the fleet.
pub(crate) fn self_signed_ca(
    key: &Key,
    now: UnixMillis,
    rng: &mut impl CryptoRng,
) -> Result<CertificateDer<'static>, FleetError> {
    let fingerprint = digest::digest(&digest::SHA256, &key.subject_public_key_info());
    let mut params = CertificateParams::default();
    params.distinguished_name = common_name(&format!("sgc fleet CA {}", hex(&fingerprint.as_ref()[..4])));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(1));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    let not_after = after(now, CA_VALIDITY)?;
    params.not_before = date_time!(before(now, CLOCK_SKEW));
    params.not_after = date_time!(not_after);
    params.serial_number = Some(serial(rng));
    Ok(params.self_signed(key).map_err(FleetError::making)?.into())
}

/// Makes a fleet's revocation list, DER. For nodes of SGC it revokes nodes, the last ones first. For everyone else it
/// revokes as many serial numbers as fit, the last ones first.
pub(crate) fn fleet_list(
    ca: &CertificateDer<'_>,
    ca_key: &Key,
    nodes: &RevokedNodes,
    serials: &[(Serial, UnixMillis)],
    number: u64,
    now: UnixMillis,
) -> Result<Vec<u8>, FleetError> {
    let mut nodes: Vec<_> = nodes.iter().collect();
    if nodes.len() > LIST_NODES_MAX {
        nodes.sort_by_key(|(node, revocation)| (revocation.at, **node));
        nodes.drain(..nodes.len() - LIST_NODES_MAX);
        nodes.sort_by_key(|(node, _)| **node);
    }
    let room = CRL_BYTES_MAX - LIST_HEAD_BYTES_MAX - nodes.len() * RevokedNodeFields::BYTES_MAX;
    let first = serials.len().saturating_sub(room / SERIAL_ENTRY_BYTES_MAX);
    let list = revocation_list(ca, ca_key, serials.get(first..).unwrap_or_default(), number, now)?;
    let value = RevokedNodeFields::write_all(nodes.into_iter().map(|(node, revocation)| RevokedNodeFields {
        pseudonym: node.0,
        incarnation: revocation.incarnation,
        revoked_secs: revocation.at.secs(),
    }));
    let unreadable = || FleetError::Making("its own revocation list cannot be read".into());
    let algorithm = ListFields::from_list(&list).ok_or_else(unreadable)?.algorithm;
    let tbs = ListFields::tbs_with_revoked_nodes(&list, &value).ok_or_else(unreadable)?;
    let signature = ca_key.sign(&tbs).map_err(FleetError::making)?;
    Ok(ListFields::signed(&tbs, algorithm, &signature))
}

/// Makes a revocation list of serial numbers, DER.
pub(crate) fn revocation_list(
    ca: &CertificateDer<'_>,
    ca_key: &Key,
    revoked: &[(Serial, UnixMillis)],
    number: u64,
    now: UnixMillis,
) -> Result<Vec<u8>, FleetError> {
    let entry = |(serial, at): &(Serial, UnixMillis)| RevokedCertParams {
        serial_number: SerialNumber::from_slice(serial),
        revocation_time: date_time!(*at),
        reason_code: None,
        invalidity_date: None,
    };
    let next_update = after(now, CRL_VALIDITY)?;
    let issuer = issuer_params(ca)?;
    let params = CertificateRevocationListParams {
        this_update: date_time!(now),
        next_update: date_time!(next_update),
        crl_number: SerialNumber::from(number),
        issuing_distribution_point: None,
        revoked_certs: revoked.iter().map(entry).collect(),
        key_identifier_method: issuer.key_identifier_method.clone(),
    };
    let list = params.signed_by(&Issuer::from_params(&issuer, ca_key)).map_err(FleetError::making)?;
    Ok(list.der().to_vec())
}

/// Makes a request for a certificate that names this node, DER (PKCS #10), signed by its key.
pub(crate) fn signing_request(
    key: &Key,
    pseudonym: Option<&Pseudonym>,
    groups: &[GroupTag],
    may_route: bool,
) -> Option<Vec<u8>> {
    let mut params = CertificateParams::default();
    params.distinguished_name = DistinguishedName::new();
    if let Some(pseudonym) = pseudonym {
        params.distinguished_name = common_name(&pseudonym.to_string());
        params.subject_alt_names = sans(pseudonym, groups, may_route, 0).ok()?;
    }
    Some(params.serialize_request(key).ok()?.der().to_vec())
}

/// A key that its node makes for itself, and the request for a certificate to the fleet or another CA.
pub struct KeyRequest {
    key: Key,
    csr: Vec<u8>,
}

impl KeyRequest {
    /// Makes a new P-256 key. With a pseudonym the request names the node, so that a CA that knows nothing of SGC only
    /// has to copy its subject alternative names.
    pub fn generate(pseudonym: Option<&Pseudonym>, rng: &mut impl CryptoRng) -> Result<Self, FleetError> {
        let key = Key::generate(rng);
        let csr = signing_request(&key, pseudonym, &[], false);
        let csr = csr.ok_or_else(|| FleetError::Making("its key cannot sign it".into()))?;
        Ok(Self { key, csr })
    }

    /// Returns the private key as text, for a file that only its owner may read.
    pub fn key_text(&self) -> Zeroizing<String> {
        let comment = "# Private key of an SGC node. KEEP IT SECRET and where it is.\n";
        pem::write(comment, &[(KEY_BLOCK, self.key.pkcs8())])
    }

    /// Returns the private key, PKCS #8.
    pub fn key(&self) -> &[u8] {
        self.key.pkcs8()
    }

    /// Returns the request (PKCS #10), DER. It is no secret.
    pub fn csr(&self) -> &[u8] {
        &self.csr
    }

    /// Returns the request (PKCS #10) as text. It is no secret.
    pub fn csr_text(&self) -> String {
        String::clone(&pem::write("", &[("CERTIFICATE REQUEST", &self.csr)]))
    }
}

/// The key for which a request wants a certificate. The rest of the request is not read: the CA decides the content of
/// certificates.
pub(crate) struct RequestedKey {
    algorithm: &'static rcgen::SignatureAlgorithm,
    key: Vec<u8>,
}

impl RequestedKey {
    /// Returns the key of a request that this key signed.
    pub(crate) fn from_request(request: &[u8]) -> Result<Self, FleetError> {
        const ECDSA: [&rcgen::SignatureAlgorithm; 2] =
            [&rcgen::PKCS_ECDSA_P256_SHA256, &rcgen::PKCS_ECDSA_P384_SHA384];
        if request.len() > CSR_BYTES_MAX {
            return Err(FleetError::Request("it is too long"));
        }
        let fields =
            RequestFields::from_request(request).ok_or(FleetError::Request("it is not PKCS #10 in DER"))?;
        let (key_algorithm, key) = fields.key;
        let used = CHAIN_ALGORITHMS
            .iter()
            .filter(|a| a.signature_alg_id().as_ref() == fields.algorithm)
            .find(|a| a.public_key_alg_id().as_ref() == key_algorithm)
            .ok_or(FleetError::Request("its key is not P-256, P-384, Ed25519 or RSA"))?;
        used.verify_signature(key, fields.info, fields.signature)
            .map_err(|_| FleetError::Request("its key did not sign it"))?;
        let id = used.public_key_alg_id();
        let algorithm = if id == webpki::aws_lc_rs::ED25519.public_key_alg_id() {
            &rcgen::PKCS_ED25519
        } else if id == webpki::aws_lc_rs::ECDSA_P256_SHA256.public_key_alg_id() {
            ECDSA[0]
        } else if id == webpki::aws_lc_rs::ECDSA_P384_SHA384.public_key_alg_id() {
            ECDSA[1]
        } else {
            &rcgen::PKCS_RSA_SHA256
        };
        Ok(Self { algorithm, key: key.to_vec() })
    }
}

/// Returns a hash of the key of a request (PKCS #10, DER), without checking the key's signature. Unreadable requests
/// differ by all their bytes.
pub fn requested_key_hash(request: &[u8]) -> [u8; 32] {
    match RequestFields::from_request(request) {
        Some(RequestFields { key: (algorithm, key), .. }) => sha256(&[algorithm, key]),
        None => sha256(&[request]),
    }
}

impl PublicKeyData for RequestedKey {
    fn der_bytes(&self) -> &[u8] {
        &self.key
    }

    fn algorithm(&self) -> &'static rcgen::SignatureAlgorithm {
        self.algorithm
    }
}

/// Returns the parameters that certificates and lists take from their CA's certificate.
fn issuer_params(ca: &CertificateDer<'_>) -> Result<CertificateParams, FleetError> {
    let fields = CaFields::from_certificate(ca).ok_or(FleetError::CaName)?;
    let mut params = CertificateParams::default();
    params.distinguished_name = DistinguishedName::new();
    for (id, tag, value) in fields.name {
        let kind = DnType::CustomDnType(id);
        if params.distinguished_name.get(&kind).is_some() {
            return Err(FleetError::CaName);
        }
        params.distinguished_name.push(kind, dn_value(tag, value).ok_or(FleetError::CaName)?);
    }
    params.key_usages = Vec::new();
    params.key_identifier_method =
        fields.key_id.map_or(KeyIdMethod::Sha256, |id| KeyIdMethod::PreSpecified(id.to_vec()));
    Ok(params)
}

fn dn_value(tag: u8, value: &[u8]) -> Option<DnValue> {
    let text = || std::str::from_utf8(value).ok();
    Some(match tag {
        0x0c => DnValue::Utf8String(text()?.to_owned()),
        0x13 => DnValue::PrintableString(PrintableString::try_from(text()?).ok()?),
        0x14 => DnValue::TeletexString(TeletexString::try_from(text()?).ok()?),
        0x16 => DnValue::Ia5String(Ia5String::try_from(text()?).ok()?),
        0x1c => DnValue::UniversalString(UniversalString::from_utf32be(value.to_vec()).ok()?),
        0x1e => DnValue::BmpString(BmpString::from_utf16be(value.to_vec()).ok()?),
        _ => return None,
    })
}

fn sans(
    pseudonym: &Pseudonym,
    groups: &[GroupTag],
    may_route: bool,
    incarnation: u32,
) -> Result<Vec<SanType>, FleetError> {
    uris(pseudonym, groups, may_route, incarnation).into_iter().map(uri).collect()
}

fn uri(text: String) -> Result<SanType, FleetError> {
    Ok(SanType::URI(text.try_into().map_err(FleetError::making)?))
}

fn uris(pseudonym: &Pseudonym, groups: &[GroupTag], may_route: bool, incarnation: u32) -> Vec<String> {
    let mut uris = vec![format!("{NODE_URI}{pseudonym}")];
    uris.extend(groups.iter().map(|group| format!("{GROUP_URI}{group}")));
    uris.extend(may_route.then(|| ROUTER_URI.to_owned()));
    uris.extend((incarnation > 0).then(|| format!("{INCARNATION_URI}{incarnation}")));
    uris
}

/// Returns the subject alternative names, URIs, that the certificate of a node needs from a CA that knows nothing of
/// SGC.
pub fn certificate_uris(
    secret: &FleetSecret,
    node: &NodeName,
    groups: &[GroupName],
    may_route: bool,
) -> Vec<String> {
    let groups: BTreeSet<_> = groups.iter().map(|group| secret.group_tag(group.as_str())).collect();
    let groups: Vec<_> = groups.into_iter().collect();
    uris(&secret.pseudonym(node.as_str()), &groups, may_route, 0)
}

pub(crate) fn common_name(name: &str) -> DistinguishedName {
    let mut out = DistinguishedName::new();
    out.push(DnType::CommonName, name);
    out
}

/// Returns 126 random bits, positive and of a fixed length as RFC 5280, 4.1.2.2 requires.
pub(crate) fn serial(rng: &mut impl CryptoRng) -> SerialNumber {
    let mut bytes = [0; 16];
    rng.fill_bytes(&mut bytes);
    bytes[0] = (bytes[0] & 0x3f) | 0x40;
    SerialNumber::from_slice(&bytes)
}

pub(crate) fn before(now: UnixMillis, by: Duration) -> UnixMillis {
    UnixMillis(now.0.saturating_sub(by.as_millis() as u64))
}

fn after(now: UnixMillis, by: Duration) -> Result<UnixMillis, FleetError> {
    let by = u64::try_from(by.as_millis()).unwrap_or(u64::MAX);
    let then = UnixMillis(now.0.saturating_add(by));
    if then > TIME_MAX { Err(FleetError::Time(then)) } else { Ok(then) }
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    use fmt::Write as _;
    bytes.iter().fold(String::new(), |mut out, byte| {
        let _ = write!(out, "{byte:02x}");
        out
    })
}
