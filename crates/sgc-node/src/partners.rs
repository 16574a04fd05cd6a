//! Other fleets: the CAs that the configuration names, and who holds tokens of this node's topics.
//!
//! It reads and keeps; what follows for a share is the business of `policy`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use rustls_pki_types::CertificateDer;
use rustls_pki_types::pem::PemObject as _;
use serde::{Deserialize, Serialize};
use sgc_trust::{AnchorError, CaFingerprint, FleetName, Identity, TrustAnchors};
use sgc_wire::{NodeId, UnixMillis};

use crate::config::Config;
use crate::records::{self, Records};

/// Largest file of CA certificates, bytes.
const CA_FILE_BYTES_MAX: u64 = 256 * 1024;
/// Largest file of tokens given, bytes.
const RECORDS_BYTES_MAX: u64 = 8 * 1024 * 1024;
/// Most tokens of one node that are in force.
pub const TOKENS_MAX: usize = 1024;
const RECORDS_FILE: &str = "partners.json";
const RECORDS_VERSION: u32 = 1;

/// Reads a file of CA certificates, PEM; what else is in it does not count.
pub fn read_ca_file(path: &Path) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let mut text = Vec::new();
    let file = fs::File::open(path).map_err(CaFileError::Read)?;
    file.take(CA_FILE_BYTES_MAX + 1).read_to_end(&mut text).map_err(CaFileError::Read)?;
    if text.len() as u64 > CA_FILE_BYTES_MAX {
        return Err(CaFileError::TooLarge);
    }
    certificates(&text)
}

/// The certificates of a PEM text, whatever they are for.
pub fn chain(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let certificates = CertificateDer::pem_slice_iter(pem).collect::<Result<Vec<_>, _>>();
    certificates.map_err(|error| CaFileError::Pem(error.to_string()))
}

/// The CA certificates of a PEM text.
pub fn certificates(pem: &[u8]) -> Result<Vec<CertificateDer<'static>>, CaFileError> {
    let certificates = chain(pem)?;
    TrustAnchors::new(certificates.iter().cloned()).map_err(CaFileError::Certificates)?;
    Ok(certificates)
}

/// What is wrong with a file of CA certificates.
#[derive(Debug, thiserror::Error)]
pub enum CaFileError {
    /// It cannot be read.
    #[error("it cannot be read: {0}")]
    Read(io::Error),
    /// It is too large.
    #[error("it has more than {CA_FILE_BYTES_MAX} bytes")]
    TooLarge,
    /// It is not PEM.
    #[error("it is not PEM: {0}")]
    Pem(String),
    /// No CA can be made of it.
    #[error("{0}")]
    Certificates(AnchorError),
}

/// A `[[partner]]`, its CA read.
#[derive(Clone, Debug)]
pub struct Partner {
    /// Its CAs; more than one where it has an old and a new one.
    pub cas: Vec<CaFingerprint>,
    /// The nodes that are meant; all of those CAs if there are none.
    pub nodes: Vec<NodeId>,
}

/// All other fleets that concern a node, as of one moment.
#[derive(Clone, Debug, Default)]
pub struct Partners {
    /// Those of the configuration.
    pub configured: BTreeMap<FleetName, Partner>,
    /// Tokens in force.
    pub tokens: Vec<TokenGrant>,
    /// CAs that are to be trusted besides the fleet's own, each once.
    pub certificates: Vec<CertificateDer<'static>>,
    /// The CAs whose nodes may attach; all that are trusted if there is nothing.
    pub admitted: Option<BTreeSet<CaFingerprint>>,
    /// When the first token ends.
    pub next_expiry: Option<UnixMillis>,
}

/// Who may subscribe to a topic because of a token.
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
    /// The one node that is meant; `None` for all of that CA.
    pub node: Option<NodeId>,
}

impl Partners {
    /// Reads what `config` names and which tokens the state directory knows to be in force at `now`.
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

    /// Trusts more CAs.
    pub fn trust(&mut self, certificates: Vec<CertificateDer<'static>>) {
        for certificate in certificates {
            if !self.certificates.contains(&certificate) {
                self.certificates.push(certificate);
            }
        }
    }

    /// `identity`, with these CAs trusted besides its own.
    pub fn extend(&self, identity: &Identity) -> Result<TrustAnchors, AnchorError> {
        identity.anchors().with_anchors(self.certificates.iter().cloned())
    }
}

/// The tokens that a node gave, `partners.json` in its state directory.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TokenRecords {
    version: u32,
    /// Number of the next token: none is used twice, so that `--withdraw` cannot hit another.
    next_id: u64,
    /// Those that were not withdrawn; expired ones leave when another is added.
    pub tokens: Vec<TokenRecord>,
}

impl Default for TokenRecords {
    fn default() -> Self {
        Self { version: RECORDS_VERSION, next_id: 1, tokens: Vec::new() }
    }
}

/// One token. The token itself is not kept.
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
    /// SHA-256 of the public key of the partner's CA, in hexadecimal digits; for people.
    pub ca: String,
    /// The partner's CA certificate.
    pub ca_pem: String,
    /// The one node that is meant, in hexadecimal digits.
    pub node: Option<String>,
    /// When it was made, milliseconds since 1970.
    pub created: u64,
    /// Last moment at which it holds, milliseconds since 1970.
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
    /// Reads them; none if there is no file.
    pub fn load(state: &Path) -> Result<Self, PartnerError> {
        records::load(state)
    }

    /// Changes them on the disk, as nobody else does at the same time.
    pub fn change<T>(
        state: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, PartnerError>,
    ) -> Result<T, PartnerError> {
        records::change(state, change)
    }

    /// Adds one, and gives it its number; those that ended before `now` leave.
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

    /// Takes one out.
    pub fn withdraw(&mut self, id: u64) -> Result<TokenRecord, PartnerError> {
        let at = self.tokens.iter().position(|known| known.id == id);
        at.map(|at| self.tokens.remove(at)).ok_or(PartnerError::NoSuchToken { id })
    }
}

/// What is wrong with partners and tokens.
#[derive(Debug, thiserror::Error)]
pub enum PartnerError {
    /// A file of CA certificates.
    #[error("CA certificates {}: {source}", path.display())]
    Ca {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: CaFileError,
    },
    /// The file of tokens given.
    #[error("tokens given, {}: {source}", path.display())]
    Records {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: io::Error,
    },
    /// One token of it.
    #[error(
        "token {id} in {RECORDS_FILE} has no usable CA or node; withdraw it: sgc share-token --withdraw {id}"
    )]
    Record {
        /// Its number.
        id: u64,
    },
    /// Too many tokens.
    #[error(
        "{TOKENS_MAX} tokens are in force, which is the limit: withdraw some, or name the partner in a [[partner]]"
    )]
    TooManyTokens,
    /// No token has that number.
    #[error("no token has the number {id}; `sgc share-token --list` shows them")]
    NoSuchToken {
        /// The number.
        id: u64,
    },
}
