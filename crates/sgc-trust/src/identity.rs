//! What one node holds to be itself: certificate chain, private key, the CAs it trusts, and (not for routers) the
//! fleet secret; and the one text file in which they are kept.
//!
//! It does not read the file (that, and its permissions, is the node's) and knows no clock: whether the
//! certificate still holds is for its user to ask. No output of this module but [`Identity::to_text`] holds a
//! secret.

use std::fmt;
use std::sync::Arc;

use rustls::SignatureScheme;
use rustls::sign::{CertifiedKey, SigningKey};
use rustls_pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use sgc_wire::{DecodeError, GroupTag, NodeId, Pseudonym, Reader, UnixMillis, Writer};
use zeroize::Zeroizing;

use crate::fleet::{FleetSecret, SECRET_BLOCK, read_secret};
use crate::label::{FleetName, LABEL_BYTES_MAX, LabelError, NodeName};
use crate::pem::{self, Block, PemError};
use crate::verify::{AnchorError, CertError, TrustAnchors, VerifiedPeer, node_id, signature_input};
use crate::x509::Validity;

const FILE_VERSION: u8 = 1;
const ABOUT_BLOCK: &str = "SGC IDENTITY";
const CHAIN_BLOCK: &str = "CERTIFICATE";
const KEY_BLOCK: &str = "PRIVATE KEY";
const CA_BLOCK: &str = "SGC CA CERTIFICATE";
const RESET_BLOCK: &str = "SGC RESET KEY";

/// What an identity signs with, by the kind of its key; [`VerifiedPeer::verify_signature`] has the same list.
const SCHEMES: [SignatureScheme; 4] = [
    SignatureScheme::ECDSA_NISTP256_SHA256,
    SignatureScheme::ECDSA_NISTP384_SHA384,
    SignatureScheme::ED25519,
    SignatureScheme::RSA_PSS_SHA256,
];

/// A node's identity. Debug shows nothing secret.
pub struct Identity {
    parts: IdentityParts,
    certified: Arc<CertifiedKey>,
    own: VerifiedPeer,
}

/// What an identity consists of.
#[derive(Clone)]
pub(crate) struct IdentityParts {
    pub(crate) node: NodeName,
    pub(crate) fleet: FleetName,
    pub(crate) chain: Vec<CertificateDer<'static>>,
    pub(crate) key: Zeroizing<Vec<u8>>,
    pub(crate) anchors: TrustAnchors,
    pub(crate) secret: Option<FleetSecret>,
    pub(crate) reset_key: Option<Zeroizing<[u8; 32]>>,
}

impl Identity {
    /// Reads what [`Identity::to_text`] wrote. The parts have to fit together; whether the certificate holds
    /// now is not asked.
    pub fn parse(text: &str) -> Result<Self, IdentityError> {
        let mut about: Option<Block> = None;
        let mut key: Option<Block> = None;
        let mut secret: Option<Block> = None;
        let mut reset_key: Option<Block> = None;
        let mut chain = Vec::new();
        let mut cas = Vec::new();
        for block in pem::parse(text).map_err(IdentityError::File)? {
            let (name, slot) = match block.label.as_str() {
                CHAIN_BLOCK => {
                    chain.push(CertificateDer::from(block.content.to_vec()));
                    continue;
                }
                CA_BLOCK => {
                    cas.push(CertificateDer::from(block.content.to_vec()));
                    continue;
                }
                ABOUT_BLOCK => (ABOUT_BLOCK, &mut about),
                KEY_BLOCK => (KEY_BLOCK, &mut key),
                SECRET_BLOCK => (SECRET_BLOCK, &mut secret),
                RESET_BLOCK => (RESET_BLOCK, &mut reset_key),
                _ => return Err(IdentityError::UnknownBlock(block.label)),
            };
            if slot.replace(block).is_some() {
                return Err(IdentityError::Repeated(name));
            }
        }
        let about = about.ok_or(IdentityError::Missing(ABOUT_BLOCK))?;
        let key = key.ok_or(IdentityError::Missing(KEY_BLOCK))?;
        if chain.is_empty() {
            return Err(IdentityError::Missing(CHAIN_BLOCK));
        }
        if cas.is_empty() {
            return Err(IdentityError::Missing(CA_BLOCK));
        }
        let (node, fleet) = read_about(&about.content)?;
        let length = |name| move || IdentityError::SecretLength(name);
        let secret = secret.map(|b| read_secret(&b.content).ok_or_else(length(SECRET_BLOCK))).transpose()?;
        let reset_key = reset_key
            .map(|b| b.content.as_slice().try_into().map_err(|_| length(RESET_BLOCK)()).map(Zeroizing::new))
            .transpose()?;
        let anchors = TrustAnchors::new(cas).map_err(IdentityError::Ca)?;
        Self::assemble(IdentityParts { node, fleet, chain, key: key.content, anchors, secret, reset_key })
    }

    /// Everything in one text, for a file that only its owner may read.
    pub fn to_text(&self) -> Zeroizing<String> {
        let parts = &self.parts;
        let mut about = Writer::default();
        about.u8(FILE_VERSION);
        about.str(parts.node.as_str());
        about.str(parts.fleet.as_str());
        let about = about.into_vec();
        let comment = format!(
            "# SGC identity. KEEP IT SECRET: whoever holds this file is this node.\n\
             # node:    {}{}\n# fleet:   {}\n# expires: {}\n# id:      {}\n",
            parts.node,
            if parts.secret.is_none() { " (router: it can read no payload)" } else { "" },
            parts.fleet,
            self.not_after(),
            self.node_id(),
        );
        let mut blocks: Vec<(&str, &[u8])> = vec![(ABOUT_BLOCK, &about)];
        blocks.extend(parts.chain.iter().map(|c| (CHAIN_BLOCK, c.as_ref())));
        blocks.push((KEY_BLOCK, &parts.key));
        blocks.extend(parts.anchors.certificates().map(|c| (CA_BLOCK, c.as_ref())));
        blocks.extend(parts.secret.as_ref().map(|s| (SECRET_BLOCK, &s.expose()[..])));
        blocks.extend(parts.reset_key.as_ref().map(|k| (RESET_BLOCK, &k[..])));
        pem::write(&comment, &blocks)
    }

    /// The node's name in its fleet.
    pub fn node_name(&self) -> &NodeName {
        &self.parts.node
    }

    /// The fleet's name, for people.
    pub fn fleet_name(&self) -> &FleetName {
        &self.parts.fleet
    }

    /// The certificate chain, leaf first.
    pub fn chain(&self) -> &[CertificateDer<'static>] {
        &self.parts.chain
    }

    /// The CAs that this node trusts.
    pub fn anchors(&self) -> &TrustAnchors {
        &self.parts.anchors
    }

    /// The same identity, believing these CAs.
    pub fn with_anchors(&self, anchors: TrustAnchors) -> Self {
        let parts = IdentityParts { anchors, ..self.parts.clone() };
        Self { parts, certified: Arc::clone(&self.certified), own: self.own.clone() }
    }

    /// The fleet secret; a router has none.
    pub fn fleet_secret(&self) -> Option<&FleetSecret> {
        self.parts.secret.as_ref()
    }

    /// Chain and private key for TLS. The key can sign and cannot be read.
    pub fn certified_key(&self) -> Arc<CertifiedKey> {
        Arc::clone(&self.certified)
    }

    /// A random key of this node by which peers learn at once that it restarted (`sgc-transport` derives stateless
    /// resets from it). It protects nothing else.
    pub fn reset_key(&self) -> Option<&[u8; 32]> {
        self.parts.reset_key.as_deref()
    }

    /// What others see of this node once they have verified it.
    pub fn as_peer(&self) -> &VerifiedPeer {
        &self.own
    }

    /// Who this node is.
    pub fn node_id(&self) -> NodeId {
        self.own.node_id
    }

    /// What its certificate calls it.
    pub fn pseudonym(&self) -> Pseudonym {
        self.own.pseudonym
    }

    /// Its groups.
    pub fn groups(&self) -> &[GroupTag] {
        &self.own.groups
    }

    /// Last moment at which its certificate holds.
    pub fn not_after(&self) -> UnixMillis {
        self.own.not_after
    }

    /// Who the member of this fleet with that name is; `None` without the fleet secret.
    pub fn node_id_of(&self, node_name: &str) -> Option<NodeId> {
        let spki = self.parts.anchors.ca_spki(&self.own.ca)?;
        Some(node_id(spki, &self.fleet_secret()?.pseudonym(node_name)))
    }

    /// Signs `context ‖ 0x00 ‖ message` with the node's private key: ECDSA P-256 with SHA-256 in ASN.1, or what
    /// another kind of key has in its place. A context is a constant of its purpose and has no zero byte.
    pub fn sign(&self, context: &str, message: &[u8]) -> Vec<u8> {
        let signer = self.certified.key.choose_scheme(&SCHEMES);
        signer
            .and_then(|s| s.sign(&signature_input(context, message)).ok())
            .expect("`assemble` made a signature with this key already")
    }

    /// Checks that the parts fit together.
    pub(crate) fn assemble(parts: IdentityParts) -> Result<Self, IdentityError> {
        let pkcs8 = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(parts.key.as_slice()));
        let key =
            rustls::crypto::aws_lc_rs::sign::any_supported_type(&pkcs8).map_err(|_| IdentityError::Key)?;
        check_signs(&*key)?;
        let leaf = parts.chain.first().ok_or(IdentityError::Missing(CHAIN_BLOCK))?;
        // At the chain's own beginning: whether it holds now is another question.
        let validity = Validity::of(leaf).ok_or_else(|| {
            IdentityError::Chain(CertError::Malformed("its validity cannot be read".into()))
        })?;
        let own = parts.anchors.verify(&parts.chain, validity.not_before).map_err(IdentityError::Chain)?;
        let certified = CertifiedKey::new(parts.chain.clone(), key);
        certified.keys_match().map_err(|_| IdentityError::KeyMismatch)?;
        let is_named = |s: &FleetSecret| s.pseudonym(parts.node.as_str()) == own.pseudonym;
        if !parts.secret.as_ref().is_none_or(is_named) {
            return Err(IdentityError::NameMismatch { node: parts.node });
        }
        Ok(Self { parts, certified: Arc::new(certified), own })
    }
}

impl fmt::Debug for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Identity")
            .field("node", &self.parts.node)
            .field("fleet", &self.parts.fleet)
            .field("id", &self.own.node_id)
            .field("ca", &self.own.ca)
            .finish_non_exhaustive()
    }
}

/// Why a text is no identity.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IdentityError {
    /// The file is not a sequence of blocks.
    #[error("this is not an identity file")]
    File(#[source] PemError),
    /// A block that this version does not know.
    #[error("block \"{0}\" does not belong into an identity file")]
    UnknownBlock(String),
    /// A block occurs twice.
    #[error("block \"{0}\" occurs twice in the identity file")]
    Repeated(&'static str),
    /// A block is missing.
    #[error("block \"{0}\" is missing from the identity file")]
    Missing(&'static str),
    /// The block that names the node is broken.
    #[error("block \"{ABOUT_BLOCK}\" is broken")]
    About(#[source] DecodeError),
    /// A name in it is none.
    #[error("block \"{ABOUT_BLOCK}\" holds an illegal name")]
    Name(#[source] LabelError),
    /// A CA certificate is broken.
    #[error("block \"{CA_BLOCK}\" is broken")]
    Ca(#[source] AnchorError),
    /// The chain is broken or not from the CA in the same file.
    #[error("block \"{CHAIN_BLOCK}\" is broken or not from the CA in this file")]
    Chain(#[source] CertError),
    /// The private key is broken or of a kind that is not supported.
    #[error("block \"{KEY_BLOCK}\" is no private key of a supported kind in PKCS #8")]
    Key,
    /// The key is not that of the certificate.
    #[error("the private key and the certificate in the identity file do not belong together")]
    KeyMismatch,
    /// A secret has a wrong length.
    #[error("block \"{0}\" does not hold 32 bytes")]
    SecretLength(&'static str),
    /// The certificate is for a node of another name, or the secret is another fleet's.
    #[error("the certificate is not that of node \"{node}\" under the fleet secret in this file")]
    NameMismatch {
        /// The name in the file.
        node: NodeName,
    },
}

fn check_signs(key: &dyn SigningKey) -> Result<(), IdentityError> {
    let signer = key.choose_scheme(&SCHEMES).ok_or(IdentityError::Key)?;
    signer.sign(b"").map(drop).map_err(|_| IdentityError::Key)
}

fn read_about(about: &[u8]) -> Result<(NodeName, FleetName), IdentityError> {
    let decode = |r: &mut Reader<'_>| {
        let found = r.u8()?;
        if found != FILE_VERSION {
            let (what, known) = ("identity file", FILE_VERSION.into());
            return Err(DecodeError::Version { what, found: found.into(), known });
        }
        Ok((r.str("node name", LABEL_BYTES_MAX)?, r.str("fleet name", LABEL_BYTES_MAX)?))
    };
    let mut r = Reader::new(about);
    let (node, fleet) = decode(&mut r).map_err(IdentityError::About)?;
    r.finish().map_err(IdentityError::About)?;
    Ok((node.parse().map_err(IdentityError::Name)?, fleet.parse().map_err(IdentityError::Name)?))
}
