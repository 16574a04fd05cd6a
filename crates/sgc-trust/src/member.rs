//! Everything of an identity but its private key: a fleet hands it to a node that keeps its key to itself.
//!
//! Also the file format of both: text blocks, some of them secret. [`crate::Identity`] checks with the key whether the
//! parts fit together.

use rustls_pki_types::CertificateDer;
use sgc_wire::{DecodeError, GroupTag, NodeId, Reader, SECRET_GENERATIONS_MAX, Writer};
use zeroize::Zeroizing;

use crate::blocks::{
    ABOUT_BLOCK, AUTHORITY_BLOCK, CA_BLOCK, CERTIFICATE_BLOCK, KEY_BLOCK, OBSERVERS_BLOCK, RESET_BLOCK,
};
use crate::identity_error::IdentityError;
use crate::label::{FleetName, LABEL_BYTES_MAX, NodeName};
use crate::pem::{self, Block, FILE_BYTES_MAX};
use crate::secret::{FleetSecret, NAMING_BLOCK, NamingSecret, SECRET_BLOCK};
use crate::verify::TrustAnchors;
use crate::x509::Validity;

const FILE_VERSION: u8 = 2;
/// The version before there were generations of secrets.
const FILE_VERSION_1: u8 = 1;

/// A node's certificates, the CAs it trusts and the secrets of its fleet: an identity without its private key.
#[derive(Clone)]
pub struct Membership {
    pub(crate) node: NodeName,
    pub(crate) fleet: FleetName,
    pub(crate) chain: Vec<CertificateDer<'static>>,
    pub(crate) anchors: TrustAnchors,
    pub(crate) secret: Option<FleetSecret>,
    /// Naming secrets in use, newest first.
    pub(crate) naming: Vec<NamingSecret>,
    pub(crate) authority: Option<NodeId>,
    pub(crate) post_quantum: bool,
    /// The tag of the group of observers, for a router, which has no secret to derive it.
    pub(crate) observers: Option<GroupTag>,
}

/// Content of a file.
pub(crate) struct FileParts {
    pub(crate) member: Membership,
    pub(crate) key: Option<Zeroizing<Vec<u8>>>,
    pub(crate) reset_key: Option<Zeroizing<[u8; 32]>>,
}

impl Membership {
    /// Parses the text of [`Membership::to_text`].
    pub fn parse(text: &str) -> Result<Self, IdentityError> {
        let parts = read(text)?;
        if parts.key.is_some() {
            return Err(IdentityError::HasKey);
        }
        Ok(parts.member)
    }

    /// Returns all of it in one text. It holds the fleet's secrets unless it is a router's: only its node may read it.
    pub fn to_text(&self) -> Zeroizing<String> {
        let comment = self.comment(
            "# SGC answer to a request for an identity. KEEP IT SECRET: it holds secrets of the fleet.\n\
             # On the node's machine: sgc fleet accept FILE\n",
        );
        write(self, &comment, None, None)
    }

    /// Returns the node's name.
    pub fn node_name(&self) -> &NodeName {
        &self.node
    }

    /// Returns the fleet's name, for people.
    pub fn fleet_name(&self) -> &FleetName {
        &self.fleet
    }

    /// Returns `true` if it is for a node that only routes: it holds no secret.
    pub fn is_router(&self) -> bool {
        self.secret.is_none()
    }

    pub(crate) fn comment(&self, head: &str) -> String {
        let not_after = self.chain.first().and_then(|c| Validity::from_certificate(c));
        let expires = not_after.map_or_else(|| "?".to_owned(), |v| v.not_after.to_string());
        format!(
            "{head}# node:    {}{}\n# fleet:   {}\n# expires: {expires}\n",
            self.node,
            if self.is_router() { " (router: it can read no payload)" } else { "" },
            self.fleet,
        )
    }

    /// Checks the secrets, which needs no key.
    pub(crate) fn check_secrets(&self) -> Result<(), IdentityError> {
        check_generations(self.secret.as_ref(), &self.naming)
    }
}

impl std::fmt::Debug for Membership {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let mut out = f.debug_struct("Membership");
        out.field("node", &self.node).field("fleet", &self.fleet).finish_non_exhaustive()
    }
}

/// Checks that a member has one generation or more, newest first, generation 1 the fleet secret, and a router none.
pub(crate) fn check_generations(
    root: Option<&FleetSecret>,
    naming: &[NamingSecret],
) -> Result<(), IdentityError> {
    let falling = naming.windows(2).all(|pair| pair[0].generation > pair[1].generation);
    let number = if root.is_some() { 1..=SECRET_GENERATIONS_MAX } else { 0..=0 };
    let first = naming.iter().find(|n| n.generation < NamingSecret::STORED_FROM);
    let is_root = |n: &NamingSecret| {
        let same =
            root.map(|r| aws_lc_rs::constant_time::verify_slices_are_equal(r.expose(), n.secret.expose()));
        n.generation == 1 && same == Some(Ok(()))
    };
    if falling && number.contains(&naming.len()) && first.is_none_or(is_root) {
        Ok(())
    } else {
        Err(IdentityError::Generations)
    }
}

/// Writes all blocks in their order.
pub(crate) fn write(
    member: &Membership,
    comment: &str,
    key: Option<&[u8]>,
    reset_key: Option<&[u8]>,
) -> Zeroizing<String> {
    let mut about = Writer::default();
    about.u8(FILE_VERSION);
    about.str(member.node.as_str());
    about.str(member.fleet.as_str());
    about.bool(member.post_quantum);
    about.bool(member.naming.iter().any(|n| n.generation < NamingSecret::STORED_FROM));
    let about = about.into_vec();
    let stored: Vec<_> = member.naming.iter().filter(|n| n.generation >= NamingSecret::STORED_FROM).collect();
    let naming: Vec<_> = stored.iter().map(|n| n.to_block()).collect();
    let mut blocks: Vec<(&str, &[u8])> = vec![(ABOUT_BLOCK, &about)];
    blocks.extend(member.chain.iter().map(|c| (CERTIFICATE_BLOCK, c.as_ref())));
    blocks.extend(key.map(|k| (KEY_BLOCK, k)));
    blocks.extend(member.anchors.certificates().map(|c| (CA_BLOCK, c.as_ref())));
    blocks.extend(member.secret.as_ref().map(|s| (SECRET_BLOCK, &s.expose()[..])));
    blocks.extend(naming.iter().map(|n| (NAMING_BLOCK, &n[..])));
    blocks.extend(member.authority.as_ref().map(|a| (AUTHORITY_BLOCK, &a.0[..])));
    blocks.extend(member.observers.as_ref().map(|tag| (OBSERVERS_BLOCK, &tag.0[..])));
    blocks.extend(reset_key.map(|k| (RESET_BLOCK, k)));
    pem::write(comment, &blocks)
}

/// Reads the blocks of an identity, or of one without its key.
pub(crate) fn read(text: &str) -> Result<FileParts, IdentityError> {
    let mut about: Option<Block> = None;
    let mut key: Option<Block> = None;
    let mut secret: Option<Block> = None;
    let mut reset_key: Option<Block> = None;
    let mut authority: Option<Block> = None;
    let mut observers: Option<Block> = None;
    let mut chain = Vec::new();
    let mut cas = Vec::new();
    let mut naming = Vec::new();
    for block in pem::parse(text, FILE_BYTES_MAX).map_err(IdentityError::File)? {
        let (name, slot) = match block.label.as_str() {
            CERTIFICATE_BLOCK => {
                chain.push(CertificateDer::from(block.content.to_vec()));
                continue;
            }
            CA_BLOCK => {
                cas.push(CertificateDer::from(block.content.to_vec()));
                continue;
            }
            NAMING_BLOCK => {
                let secret = NamingSecret::from_block(&block.content);
                naming.push(secret.ok_or(IdentityError::NamingSecret)?);
                continue;
            }
            ABOUT_BLOCK => (ABOUT_BLOCK, &mut about),
            KEY_BLOCK => (KEY_BLOCK, &mut key),
            SECRET_BLOCK => (SECRET_BLOCK, &mut secret),
            RESET_BLOCK => (RESET_BLOCK, &mut reset_key),
            AUTHORITY_BLOCK => (AUTHORITY_BLOCK, &mut authority),
            OBSERVERS_BLOCK => (OBSERVERS_BLOCK, &mut observers),
            _ => return Err(IdentityError::UnknownBlock(block.label)),
        };
        if slot.replace(block).is_some() {
            return Err(IdentityError::Repeated(name));
        }
    }
    let about = read_about(&about.ok_or(IdentityError::Missing(ABOUT_BLOCK))?.content)?;
    if chain.is_empty() {
        return Err(IdentityError::Missing(CERTIFICATE_BLOCK));
    }
    if cas.is_empty() {
        return Err(IdentityError::Missing(CA_BLOCK));
    }
    let length = |name| move || IdentityError::SecretLength(name);
    let bytes = |block: Block, name| <[u8; 32]>::try_from(&block.content[..]).map_err(|_| length(name)());
    let secret =
        secret.map(|b| FleetSecret::read(&b.content).ok_or_else(length(SECRET_BLOCK))).transpose()?;
    let reset_key = reset_key.map(|b| bytes(b, RESET_BLOCK).map(Zeroizing::new)).transpose()?;
    let authority = authority.map(|b| bytes(b, AUTHORITY_BLOCK).map(NodeId)).transpose()?;
    let observers = observers.map(|b| bytes(b, OBSERVERS_BLOCK).map(GroupTag)).transpose()?;
    if let Some(root) = secret.as_ref().filter(|_| about.names_from_root) {
        naming.push(NamingSecret { generation: 1, secret: root.clone() });
    }
    naming.sort_unstable_by_key(|n| std::cmp::Reverse(n.generation));
    let anchors = TrustAnchors::new(cas).map_err(IdentityError::Ca)?;
    let NodeSummary { node, fleet, post_quantum, .. } = about;
    let member =
        Membership { node, fleet, chain, anchors, secret, naming, authority, post_quantum, observers };
    member.check_secrets()?;
    Ok(FileParts { member, key: key.map(|b| b.content), reset_key })
}

struct NodeSummary {
    node: NodeName,
    fleet: FleetName,
    post_quantum: bool,
    names_from_root: bool,
}

fn read_about(about: &[u8]) -> Result<NodeSummary, IdentityError> {
    let decode = |r: &mut Reader<'_>| {
        let version = r.u8()?;
        if !(FILE_VERSION_1..=FILE_VERSION).contains(&version) {
            let (what, known) = ("identity file", FILE_VERSION.into());
            return Err(DecodeError::Version { what, found: version.into(), known });
        }
        let names = (r.str("node name", LABEL_BYTES_MAX)?, r.str("fleet name", LABEL_BYTES_MAX)?);
        if version == FILE_VERSION_1 {
            return Ok((names, false, true));
        }
        Ok((names, r.bool("post-quantum")?, r.bool("names from the fleet secret")?))
    };
    let mut r = Reader::new(about);
    let ((node, fleet), post_quantum, names_from_root) = decode(&mut r).map_err(IdentityError::About)?;
    r.finish().map_err(IdentityError::About)?;
    let node = node.parse().map_err(IdentityError::Name)?;
    let fleet = fleet.parse().map_err(IdentityError::Name)?;
    Ok(NodeSummary { node, fleet, post_quantum, names_from_root })
}
