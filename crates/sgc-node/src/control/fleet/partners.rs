//! Partners: the CAs of other fleets in the configuration, and the tokens of this node's topics.
//!
//! It reads and keeps them. `policy` derives the rights at a share.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use rustls_pki_types::CertificateDer;
use rustls_pki_types::pem::PemObject as _;
use serde::{Deserialize, Serialize};
use sgc_config::Config;
use sgc_trust::{AnchorError, CaFingerprint, FleetName, Identity, TrustAnchors};
use sgc_wire::{NodeId, UnixMillis};

use crate::state::records::{self, Records};

/// Largest file of CA certificates, bytes.
const CA_FILE_BYTES_MAX: u64 = 256 * 1024;
/// Largest file of token records, bytes.
const RECORDS_BYTES_MAX: u64 = 8 * 1024 * 1024;
/// Most valid tokens of one node.
pub const TOKENS_MAX: usize = 1024;
const RECORDS_FILE: &str = "partners.json";
const RECORDS_VERSION: u32 = 1;

/// Reads the CA certificates of a PEM file. Other content is ignored.
pub fn read_ca_file(path: &Path) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let mut text = Vec::new();
    let file = fs::File::open(path).map_err(CaFileError::Read)?;
    file.take(CA_FILE_BYTES_MAX + 1).read_to_end(&mut text).map_err(CaFileError::Read)?;
    if text.len() as u64 > CA_FILE_BYTES_MAX {
        return Err(CaFileError::TooLarge);
    }
    certificates(&text)
}

/// Parses the certificates of a PEM text, whatever their purpose.
pub fn chain(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let certificates = CertificateDer::pem_slice_iter(pem).collect::<Result<Vec<_>, _>>();
    certificates.map_err(|error| CaFileError::Pem(error.to_string()))
}

/// Parses the CA certificates of a PEM text.
pub fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let certificates = chain(pem)?;
    TrustAnchors::new(certificates.iter().cloned()).map_err(CaFileError::Certificates)?;
    Ok(certificates)
}

/// Reasons why a file of CA certificates cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CaFileError {
    /// The file cannot be read.
    #[error("it cannot be read: {0}")]
    Read(io::Error),
    /// The file is too large.
    #[error("it has more than {CA_FILE_BYTES_MAX} bytes")]
    TooLarge,
    /// The file is not PEM.
    #[error("it is not PEM: {0}")]
    Pem(String),
    /// A certificate is no CA certificate.
    #[error("{0}")]
    Certificates(AnchorError),
}

/// A `[[partner]]` with its CAs.
#[derive(Clone, Debug)]
pub struct Partner {
    /// Its CAs; more than one during a change of CA.
    pub cas: Vec<CaFingerprint>,
    /// The partner's nodes; all nodes of those CAs if empty.
    pub nodes: Vec<NodeId>,
}

/// All other fleets that concern a node, at one moment.
#[derive(Clone, Debug, Default)]
pub struct Partners {
    /// Partners of the configuration.
    pub configured: BTreeMap<FleetName, Partner>,
    /// Valid tokens.
    pub tokens: Vec<TokenGrant>,
    /// Trusted CAs besides the fleet's own, without duplicates.
    pub certificates: Vec<CertificateDer<'static>>,
    /// CAs whose nodes may attach; `None` means all trusted ones.
    pub admitted: Option<BTreeSet<CaFingerprint>>,
    /// Expiry of the first token.
    pub next_expiry: Option<UnixMillis>,
}

/// Right to subscribe to a topic by a token.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TokenGrant {
    /// Number of the token.
    pub id: u64,
    /// The topic.
    pub topic: String,
    /// Its type.
    pub type_name: String,
    /// The partner's CA.
    pub ca: CaFingerprint,
    /// The partner's node; `None` means all nodes of the CA.
    pub node: Option<NodeId>,
}

impl Partners {
    /// Loads the partners of `config` and the tokens of the state directory that are valid at `now`.
    pub fn load(config: &Config, state: Option<&Path>, now: UnixMillis) -> Result<Self, PartnerError> {
        let mut partners = Self::default();
        let read = |path: &Path| {
            read_ca_file(path).map_err(|source| PartnerError::Ca { path: path.to_owned(), source })
        };
        for partner in &config.partners {
            let certificates = read(&partner.ca)?;
            let anchors = TrustAnchors::new(certificates.iter().cloned()).map_err(|e| PartnerError::Ca {
                path: partner.ca.clone(),
                source: CaFileError::Certificates(e),
            })?;
            let resolved = Partner { cas: anchors.fingerprints().collect(), nodes: partner.nodes.clone() };
            partners.configured.insert(partner.name.clone(), resolved);
            partners.trust(certificates);
        }
        for path in &config.trust {
            partners.trust(read(path)?);
        }
        for path in &config.accept {
            let certificates = read(path)?;
            let anchors = TrustAnchors::new(certificates.iter().cloned())
                .map_err(|e| PartnerError::Ca { path: path.clone(), source: CaFileError::Certificates(e) })?;
            partners.admitted.get_or_insert_default().extend(anchors.fingerprints());
            partners.trust(certificates);
        }
        let records = state.map(TokenRecords::load).transpose()?.unwrap_or_default();
        for record in &records.tokens {
            if record.expires <= now.0 {
                continue;
            }
            let malformed = || PartnerError::Record { id: record.id };
            let certificates = certificates(record.ca_pem.as_bytes()).map_err(|_| malformed())?;
            let [certificate] = &certificates[..] else { return Err(malformed()) };
            let anchors = TrustAnchors::new([certificate.clone()]).map_err(|_| malformed())?;
            let node = record.node.as_deref().map(str::parse).transpose().map_err(|_| malformed())?;
            partners.tokens.push(TokenGrant {
                id: record.id,
                topic: record.topic.clone(),
                type_name: record.type_name.clone(),
                ca: anchors.fingerprints().next().ok_or_else(malformed)?,
                node,
            });
            partners.trust(certificates);
            let ends = UnixMillis(record.expires);
            partners.next_expiry = Some(partners.next_expiry.map_or(ends, |next| next.min(ends)));
        }
        Ok(partners)
    }

    /// Adds trusted CAs.
    pub fn trust(&mut self, certificates: Vec<CertificateDer<'static>>) {
        for certificate in certificates {
            if !self.certificates.contains(&certificate) {
                self.certificates.push(certificate);
            }
        }
    }

    /// Returns the trust anchors: those of `identity` and these CAs.
    pub fn extend(&self, identity: &Identity) -> Result<TrustAnchors, AnchorError> {
        identity.anchors().with_anchors(self.certificates.iter().cloned())
    }
}

/// Records of the tokens that a node issued, `partners.json` in its state directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenRecords {
    version: u32,
    /// Number of the next token. Numbers are never reused, so that `sgc token share revoke` cannot hit another.
    next_id: u64,
    /// Tokens that were not withdrawn. Expired ones are removed when another is added.
    pub tokens: Vec<TokenRecord>,
}

impl Default for TokenRecords {
    fn default() -> Self {
        Self { version: RECORDS_VERSION, next_id: 1, tokens: Vec::new() }
    }
}

/// Record of one token, without the token itself.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenRecord {
    /// Its number.
    pub id: u64,
    /// The topic.
    pub topic: String,
    /// Its type.
    #[serde(rename = "type")]
    pub type_name: String,
    /// The name that the token leads to, in hexadecimal digits.
    pub name: String,
    /// SHA-256 of the public key of the partner's CA, hexadecimal digits, for people.
    pub ca: String,
    /// The partner's CA certificate.
    pub ca_pem: String,
    /// The partner's node, hexadecimal digits, if there is one.
    pub node: Option<String>,
    /// Time of creation, milliseconds since 1970.
    pub created: u64,
    /// Last moment of validity, milliseconds since 1970.
    pub expires: u64,
}

impl Records for TokenRecords {
    type Error = PartnerError;
    const FILE: &str = RECORDS_FILE;
    const BYTES_MAX: u64 = RECORDS_BYTES_MAX;
    const VERSION: u32 = RECORDS_VERSION;

    fn version(&self) -> u32 {
        self.version
    }

    fn failed(path: PathBuf, source: io::Error) -> PartnerError {
        PartnerError::Records { path, source }
    }
}

impl TokenRecords {
    /// Loads the records; none if there is no file.
    pub fn load(state: &Path) -> Result<Self, PartnerError> {
        records::load(state)
    }

    /// Changes the file under its lock.
    pub fn change<T>(
        state: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, PartnerError>,
    ) -> Result<T, PartnerError> {
        records::change(state, change)
    }

    /// Adds a record under a new number and removes those that expired before `now`.
    pub fn add(&mut self, mut record: TokenRecord, now: UnixMillis) -> Result<u64, PartnerError> {
        self.tokens.retain(|known| known.expires > now.0);
        if self.tokens.len() >= TOKENS_MAX {
            return Err(PartnerError::TooManyTokens);
        }
        record.id = self.next_id;
        self.next_id += 1;
        self.tokens.push(record);
        Ok(self.next_id - 1)
    }

    /// Removes a record.
    pub fn withdraw(&mut self, id: u64) -> Result<TokenRecord, PartnerError> {
        let at = self.tokens.iter().position(|known| known.id == id);
        at.map(|at| self.tokens.remove(at)).ok_or(PartnerError::NoSuchToken { id })
    }
}

/// Reasons why partners or tokens cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum PartnerError {
    /// A file of CA certificates cannot be used.
    #[error("CA certificates {}: {source}", path.display())]
    Ca {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: CaFileError,
    },
    /// The file of records cannot be used.
    #[error("tokens given, {}: {source}", path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// The fault.
        source: io::Error,
    },
    /// A record is invalid.
    #[error("token {id} in {RECORDS_FILE} has no usable CA or node; revoke it: sgc token share revoke {id}")]
    Record {
        /// Its number.
        id: u64,
    },
    /// There are too many tokens.
    #[error(
        "{TOKENS_MAX} tokens are in force, which is the limit: revoke some, or name the partner in a [[partner]]"
    )]
    TooManyTokens,
    /// No token has that number.
    #[error("no token has the number {id}; `sgc token share list` shows them")]
    NoSuchToken {
        /// The number.
        id: u64,
    },
}
