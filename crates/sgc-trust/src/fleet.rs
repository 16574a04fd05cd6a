//! A fleet: the CA that says who belongs to it, and the secret from which its names are derived.
//!
//! It makes identities and nothing else: it keeps no list of them and writes no file. Certificates name nodes
//! and groups by keyed hashes, so that whoever sees one (a router, the network) learns no name.

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use aws_lc_rs::{digest, hmac};
use rand_core::CryptoRng;
use rcgen::{
    BasicConstraints, CertificateParams, CertificateRevocationListParams, DistinguishedName, DnType,
    ExtendedKeyUsagePurpose, IsCa, Issuer, KeyIdMethod, KeyUsagePurpose, PublicKeyData as _,
    RevokedCertParams, SanType, SerialNumber,
};
use rustls_pki_types::CertificateDer;
use sgc_wire::{DecodeError, GroupTag, Pseudonym, Reader, UnixMillis, Writer};
use zeroize::{Zeroize, ZeroizeOnDrop, Zeroizing};

use crate::identity::{Identity, IdentityParts};
use crate::key::P256Key;
use crate::label::{FleetName, GroupName, LABEL_BYTES_MAX, LabelError, NodeName};
use crate::pem::{self, Block, PemError};
use crate::verify::{AnchorError, GROUP_URI, GROUPS_MAX, NODE_URI, TrustAnchors};
use crate::x509::Validity;

/// How long a node's certificate holds unless the request says otherwise.
pub const LEAF_VALIDITY_DEFAULT: Duration = Duration::from_secs(90 * 86_400);
/// How long the CA's certificate holds.
pub const CA_VALIDITY: Duration = Duration::from_secs(10 * 365 * 86_400);
/// When a revocation list says that the next one is to be expected; nodes keep to it for longer.
pub const CRL_VALIDITY: Duration = Duration::from_secs(30 * 86_400);
/// How long before its making a certificate begins to hold: clocks of machines differ by minutes.
pub const CLOCK_SKEW: Duration = Duration::from_secs(600);

const PSEUDONYM_DOMAIN: &str = "sgc pseudonym v1";
const GROUP_DOMAIN: &str = "sgc group v1";
const FILE_VERSION: u8 = 1;
const FLEET_BLOCK: &str = "SGC FLEET";
const CERTIFICATE_BLOCK: &str = "CERTIFICATE";
const KEY_BLOCK: &str = "PRIVATE KEY";
pub(crate) const SECRET_BLOCK: &str = "SGC FLEET SECRET";
const SECRET_BYTES: usize = 32;
/// The year 9000: what certificates can say ends a little later.
const TIME_MAX: UnixMillis = UnixMillis(221_845_392_000_000);

/// In whole seconds, as certificates count. A macro since the type of the result belongs to a crate (`time`) that
/// is not a dependency of this one.
macro_rules! date_time {
    ($millis:expr) => {
        rcgen::date_time_ymd(1970, 1, 1) + Duration::from_secs($millis.secs())
    };
}

/// What the members of a fleet share, and routers do not: the root of all its names. Never printed.
#[derive(Clone, Zeroize, ZeroizeOnDrop)]
pub struct FleetSecret([u8; SECRET_BYTES]);

impl FleetSecret {
    /// Takes the bytes of a secret.
    pub fn from_bytes(bytes: [u8; SECRET_BYTES]) -> Self {
        Self(bytes)
    }

    /// The bytes, for deriving from them. They belong in no log and in no packet.
    pub fn expose(&self) -> &[u8; SECRET_BYTES] {
        &self.0
    }

    /// What certificates call the node of this name.
    pub fn pseudonym(&self, node_name: &str) -> Pseudonym {
        Pseudonym(self.tag(PSEUDONYM_DOMAIN, node_name))
    }

    /// What certificates call the group of this name.
    pub fn group_tag(&self, group: &str) -> GroupTag {
        GroupTag(self.tag(GROUP_DOMAIN, group))
    }

    fn tag(&self, domain: &str, name: &str) -> [u8; 32] {
        let mut mac = hmac::Context::with_key(&hmac::Key::new(hmac::HMAC_SHA256, &self.0));
        mac.update(domain.as_bytes());
        mac.update(&[0]);
        mac.update(name.as_bytes());
        let mut out = [0; 32];
        out.copy_from_slice(mac.sign().as_ref());
        out
    }
}

impl fmt::Debug for FleetSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("FleetSecret(..)")
    }
}

/// A certificate authority, a fleet secret and a name.
pub struct Fleet {
    name: FleetName,
    secret: FleetSecret,
    key: P256Key,
    certificate: CertificateDer<'static>,
    anchors: TrustAnchors,
    validity: Validity,
}

impl Fleet {
    /// A new fleet. Its CA holds for [`CA_VALIDITY`]; its certificate does not tell the fleet's name.
    pub fn create(name: FleetName, now: UnixMillis, rng: &mut impl CryptoRng) -> Result<Self, FleetError> {
        let key = P256Key::generate(rng);
        let mut secret = FleetSecret([0; SECRET_BYTES]);
        rng.fill_bytes(&mut secret.0);
        let mut params = ca_params(&key);
        let not_after = after(now, CA_VALIDITY)?;
        params.not_before = date_time!(before(now, CLOCK_SKEW));
        params.not_after = date_time!(not_after);
        params.serial_number = Some(serial(rng));
        let certificate = params.self_signed(&key).map_err(FleetError::making)?;
        Self::assemble(name, secret, key, certificate.into())
    }

    /// Reads what [`Fleet::to_text`] wrote.
    pub fn parse(text: &str) -> Result<Self, FleetError> {
        let mut about: Option<Block> = None;
        let mut certificate: Option<Block> = None;
        let mut key: Option<Block> = None;
        let mut secret: Option<Block> = None;
        for block in pem::parse(text).map_err(FleetError::File)? {
            let (name, slot) = match block.label.as_str() {
                FLEET_BLOCK => (FLEET_BLOCK, &mut about),
                CERTIFICATE_BLOCK => (CERTIFICATE_BLOCK, &mut certificate),
                KEY_BLOCK => (KEY_BLOCK, &mut key),
                SECRET_BLOCK => (SECRET_BLOCK, &mut secret),
                _ => return Err(FleetError::UnknownBlock(block.label)),
            };
            if slot.replace(block).is_some() {
                return Err(FleetError::Repeated(name));
            }
        }
        let need = |slot: Option<Block>, name| slot.map(|b| b.content).ok_or(FleetError::Missing(name));
        let about = need(about, FLEET_BLOCK)?;
        let certificate = need(certificate, CERTIFICATE_BLOCK)?;
        let key = P256Key::from_pkcs8(&need(key, KEY_BLOCK)?).ok_or(FleetError::Key)?;
        let secret = read_secret(&need(secret, SECRET_BLOCK)?).ok_or(FleetError::Secret)?;
        Self::assemble(read_name(&about)?, secret, key, CertificateDer::from(certificate.to_vec()))
    }

    /// Everything in one text, for a file that only its owner may read.
    pub fn to_text(&self) -> Zeroizing<String> {
        let mut about = Writer::default();
        about.u8(FILE_VERSION);
        about.str(self.name.as_str());
        let comment = format!(
            "# SGC fleet. KEEP IT SECRET: whoever holds this file can make nodes of this fleet and derive its names.\n\
             # Back it up; nodes need it only to be enrolled.\n\
             # fleet:   {}\n# CA:      {}\n# expires: {}\n",
            self.name,
            self.ca_fingerprint(),
            self.validity.not_after,
        );
        let blocks: [(&str, &[u8]); 4] = [
            (FLEET_BLOCK, &about.into_vec()),
            (CERTIFICATE_BLOCK, &self.certificate),
            (KEY_BLOCK, self.key.pkcs8()),
            (SECRET_BLOCK, self.secret.expose()),
        ];
        pem::write(&comment, &blocks)
    }

    /// Makes an identity: a key pair, a certificate for it, and unless it is for a router the fleet secret.
    pub fn enroll(&self, request: &EnrollRequest, rng: &mut impl CryptoRng) -> Result<Identity, FleetError> {
        let now = request.now;
        if now.secs() > self.validity.not_after.secs() {
            return Err(FleetError::CaExpired { not_after: self.validity.not_after, now });
        }
        if request.groups.len() > GROUPS_MAX {
            return Err(FleetError::TooManyGroups { groups: request.groups.len() });
        }
        let pseudonym = self.secret.pseudonym(request.node.as_str());
        let mut params = CertificateParams::default();
        params.distinguished_name = common_name(&pseudonym.to_string());
        params.subject_alt_names = vec![uri(NODE_URI, &pseudonym)?];
        let mut groups: Vec<_> = request.groups.iter().collect();
        groups.sort_unstable();
        groups.dedup();
        for group in groups {
            params.subject_alt_names.push(uri(GROUP_URI, &self.secret.group_tag(group.as_str()))?);
        }
        if request.router || request.may_route {
            params.subject_alt_names.push(SanType::URI(
                crate::verify::ROUTER_URI.to_owned().try_into().map_err(FleetError::making)?,
            ));
        }
        params.is_ca = IsCa::ExplicitNoCa;
        params.key_usages = vec![KeyUsagePurpose::DigitalSignature];
        params.extended_key_usages =
            vec![ExtendedKeyUsagePurpose::ClientAuth, ExtendedKeyUsagePurpose::ServerAuth];
        params.use_authority_key_identifier_extension = true;
        params.serial_number = Some(serial(rng));
        // Not before the CA and not past it: a certificate that outlives its CA is a surprise for later.
        params.not_before = date_time!(before(now, CLOCK_SKEW).max(self.validity.not_before));
        params.not_after = date_time!(after(now, request.valid)?.min(self.validity.not_after));
        let key = P256Key::generate(rng);
        let ca_params = ca_params(&self.key);
        let issuer = Issuer::from_params(&ca_params, &self.key);
        let certificate = params.signed_by(&key, &issuer).map_err(FleetError::making)?;
        let mut reset_key = Zeroizing::new([0; 32]);
        rng.fill_bytes(&mut *reset_key);
        let parts = IdentityParts {
            node: request.node.clone(),
            fleet: self.name.clone(),
            chain: vec![certificate.into()],
            key: Zeroizing::new(key.pkcs8().to_vec()),
            anchors: self.anchors.clone(),
            secret: (!request.router).then(|| self.secret.clone()),
            reset_key: Some(reset_key),
        };
        Identity::assemble(parts).map_err(FleetError::making)
    }

    /// Signs a list of certificates that no longer hold, by serial number, and since when: DER, to be handed to every
    /// node. It replaces lists with a smaller number.
    pub fn revocation_list_of(
        &self,
        revoked: &[(Arc<[u8]>, UnixMillis)],
        number: u64,
        now: UnixMillis,
    ) -> Result<Vec<u8>, FleetError> {
        let entry = |(serial, at): &(Arc<[u8]>, UnixMillis)| RevokedCertParams {
            serial_number: SerialNumber::from_slice(serial),
            revocation_time: date_time!(*at),
            reason_code: None,
            invalidity_date: None,
        };
        let next_update = after(now, CRL_VALIDITY)?;
        let params = CertificateRevocationListParams {
            this_update: date_time!(now),
            next_update: date_time!(next_update),
            crl_number: SerialNumber::from(number),
            issuing_distribution_point: None,
            revoked_certs: revoked.iter().map(entry).collect(),
            key_identifier_method: KeyIdMethod::Sha256,
        };
        let ca_params = ca_params(&self.key);
        let issuer = Issuer::from_params(&ca_params, &self.key);
        Ok(params.signed_by(&issuer).map_err(FleetError::making)?.der().to_vec())
    }

    /// Its name, for people.
    pub fn name(&self) -> &FleetName {
        &self.name
    }

    /// Its secret.
    pub fn secret(&self) -> &FleetSecret {
        &self.secret
    }

    /// Its CA, as the one to trust.
    pub fn anchors(&self) -> &TrustAnchors {
        &self.anchors
    }

    /// Its CA certificate, DER.
    pub fn ca_certificate(&self) -> &CertificateDer<'static> {
        &self.certificate
    }

    /// Last moment at which its CA holds.
    pub fn not_after(&self) -> UnixMillis {
        self.validity.not_after
    }

    fn ca_fingerprint(&self) -> String {
        hex(digest::digest(&digest::SHA256, &self.key.subject_public_key_info()).as_ref())
    }

    fn assemble(
        name: FleetName,
        secret: FleetSecret,
        key: P256Key,
        certificate: CertificateDer<'static>,
    ) -> Result<Self, FleetError> {
        let anchors = TrustAnchors::new([certificate.clone()]).map_err(FleetError::Certificate)?;
        let validity = Validity::of(&certificate).ok_or(FleetError::KeyMismatch)?;
        let is_of_key = webpki::EndEntityCert::try_from(&certificate)
            .is_ok_and(|c| c.subject_public_key_info().as_ref() == key.subject_public_key_info());
        if !is_of_key {
            return Err(FleetError::KeyMismatch);
        }
        Ok(Self { name, secret, key, certificate, anchors, validity })
    }
}

impl fmt::Debug for Fleet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Fleet").field("name", &self.name).field("ca", &self.anchors).finish_non_exhaustive()
    }
}

/// What is asked of [`Fleet::enroll`].
#[derive(Clone, Debug)]
pub struct EnrollRequest {
    /// For which node.
    pub node: NodeName,
    /// The groups it is to be in, at most [`GROUPS_MAX`].
    pub groups: Vec<GroupName>,
    /// For a node that only routes: its identity lacks the fleet secret, so that it can derive no name and open
    /// no payload.
    pub router: bool,
    /// For a member that also carries others' names.
    pub may_route: bool,
    /// How long the certificate is to hold; never longer than the CA.
    pub valid: Duration,
    /// The time.
    pub now: UnixMillis,
}

impl EnrollRequest {
    /// A node in no group, for [`LEAF_VALIDITY_DEFAULT`].
    pub fn new(node: NodeName, now: UnixMillis) -> Self {
        Self { node, groups: Vec::new(), router: false, may_route: false, valid: LEAF_VALIDITY_DEFAULT, now }
    }
}

/// Why a fleet cannot be made, read, or enrol a node.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// The file is not a sequence of blocks.
    #[error("this is not a fleet file")]
    File(#[source] PemError),
    /// A block that this version does not know.
    #[error("block \"{0}\" does not belong into a fleet file")]
    UnknownBlock(String),
    /// A block occurs twice.
    #[error("block \"{0}\" occurs twice in the fleet file")]
    Repeated(&'static str),
    /// A block is missing.
    #[error("block \"{0}\" is missing from the fleet file")]
    Missing(&'static str),
    /// The block that names the fleet is broken.
    #[error("block \"{FLEET_BLOCK}\" is broken")]
    About(#[source] DecodeError),
    /// The fleet's name is none.
    #[error("block \"{FLEET_BLOCK}\" holds an illegal name")]
    Name(#[source] LabelError),
    /// The CA certificate is broken.
    #[error("block \"{CERTIFICATE_BLOCK}\" is broken")]
    Certificate(#[source] AnchorError),
    /// The CA key is broken.
    #[error("block \"{KEY_BLOCK}\" is no P-256 key in PKCS #8")]
    Key,
    /// The key is not that of the certificate.
    #[error("the key and the certificate in the fleet file do not belong together")]
    KeyMismatch,
    /// The secret has a wrong length.
    #[error("block \"{SECRET_BLOCK}\" does not hold {SECRET_BYTES} bytes")]
    Secret,
    /// The CA is over.
    #[error(
        "the fleet's CA expired at {not_after} and the clock here says {now}: create a new fleet, or set the clock"
    )]
    CaExpired {
        /// Its end.
        not_after: UnixMillis,
        /// The time of the request.
        now: UnixMillis,
    },
    /// Too many groups are asked for.
    #[error("a node is in at most {GROUPS_MAX} groups, {groups} are asked for")]
    TooManyGroups {
        /// How many.
        groups: usize,
    },
    /// The time, or the time plus the validity, is no date that certificates can hold.
    #[error("a certificate cannot be valid until {0}: is the clock right?")]
    Time(UnixMillis),
    /// The certificate could not be made.
    #[error("the certificate could not be made: {0}")]
    Making(String),
}

impl FleetError {
    fn making(error: impl fmt::Display) -> Self {
        Self::Making(error.to_string())
    }
}

pub(crate) fn read_secret(bytes: &[u8]) -> Option<FleetSecret> {
    bytes.try_into().ok().map(FleetSecret::from_bytes)
}

fn read_name(about: &[u8]) -> Result<FleetName, FleetError> {
    let mut r = Reader::new(about);
    let decode = |r: &mut Reader<'_>| {
        let found = r.u8()?;
        if found != FILE_VERSION {
            let (what, known) = ("fleet file", FILE_VERSION.into());
            return Err(DecodeError::Version { what, found: found.into(), known });
        }
        r.str("fleet name", LABEL_BYTES_MAX)
    };
    let name = decode(&mut r).map_err(FleetError::About)?;
    r.finish().map_err(FleetError::About)?;
    name.parse().map_err(FleetError::Name)
}

/// The CA's subject is made from its key: two CAs never share one, so that a certificate of another fleet is
/// told apart from a forged one, and nothing is said of the fleet.
fn ca_params(key: &P256Key) -> CertificateParams {
    let fingerprint = digest::digest(&digest::SHA256, &key.subject_public_key_info());
    let mut params = CertificateParams::default();
    params.distinguished_name = common_name(&format!("sgc fleet CA {}", hex(&fingerprint.as_ref()[..4])));
    params.is_ca = IsCa::Ca(BasicConstraints::Constrained(1));
    params.key_usages = vec![KeyUsagePurpose::KeyCertSign, KeyUsagePurpose::CrlSign];
    params
}

fn common_name(name: &str) -> DistinguishedName {
    let mut out = DistinguishedName::new();
    out.push(DnType::CommonName, name);
    out
}

fn uri(prefix: &str, id: &impl fmt::Display) -> Result<SanType, FleetError> {
    Ok(SanType::URI(format!("{prefix}{id}").try_into().map_err(FleetError::making)?))
}

/// 126 random bits, positive and of a fixed length as RFC 5280, 4.1.2.2 wants it.
fn serial(rng: &mut impl CryptoRng) -> SerialNumber {
    let mut bytes = [0; 16];
    rng.fill_bytes(&mut bytes);
    bytes[0] = (bytes[0] & 0x3f) | 0x40;
    SerialNumber::from_slice(&bytes)
}

fn before(now: UnixMillis, by: Duration) -> UnixMillis {
    UnixMillis(now.0.saturating_sub(by.as_millis() as u64))
}

fn after(now: UnixMillis, by: Duration) -> Result<UnixMillis, FleetError> {
    let by = u64::try_from(by.as_millis()).unwrap_or(u64::MAX);
    let then = UnixMillis(now.0.saturating_add(by));
    if then > TIME_MAX { Err(FleetError::Time(then)) } else { Ok(then) }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}
