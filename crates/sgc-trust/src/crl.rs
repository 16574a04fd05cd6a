//! X.509 revocation lists (RFC 5280, 5): the certificates that CAs have revoked.
//!
//! A list counts if a trusted CA signed it, no matter how it came. The lists of a fleet add up: they name nodes and
//! incarnations, and a revocation in one of them stays (`revocations.rs`). Of a CA that names serial numbers only, the
//! list with the greatest number counts. An outdated list still counts. An attacker who keeps newer lists from a node
//! can so delay a revocation, and not undo one; refusing everybody instead would stop a fleet whose keeper is away.
//! This module reads no clock and stores no file.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use sgc_wire::{CRL_BYTES_MAX, NodeId, Pseudonym, UnixMillis};
use webpki::BorrowedCertRevocationList;

use crate::cert_id::{CaFingerprint, CertId, sha256};
use crate::peer::{VerifiedPeer, node_id};
use crate::revocations::{CaLists, CrlError, LIST_NODES_MAX, Revocation, RevocationList, RevokedNodes};
use crate::verify::{Anchor, CHAIN_ALGORITHMS, TrustAnchors};
use crate::x509::{ListFields, RevokedNodeFields, may_sign_lists, split_spki, without_zeros};

impl TrustAnchors {
    /// Returns these anchors with one more list, if it verifies and adds something; `Ok(None)` if it adds nothing.
    pub fn with_crl(&self, der: &[u8], now: UnixMillis) -> Result<Option<Self>, CrlError> {
        Ok(self.crl_news(der, now)?.map(|news| news.anchors))
    }

    /// Verifies a list and returns what it adds, with its CA and number; `Ok(None)` if it adds nothing.
    pub fn crl_news(&self, der: &[u8], now: UnixMillis) -> Result<Option<CrlNews>, CrlError> {
        if self.crls().any(|known| known == der) {
            return Ok(None);
        }
        let (ca, list) = self.verify_list(der, now)?;
        let number = CrlNumber::from_bytes(&list.number);
        let known = self.lists.get(&ca).cloned().unwrap_or_default();
        let Some(more) = known.with(Arc::new(list))? else { return Ok(None) };
        let mut lists = BTreeMap::clone(&self.lists);
        lists.insert(ca, more);
        Ok(Some(CrlNews { ca, number, anchors: self.with_lists(Arc::new(lists)) }))
    }

    /// Returns the same CAs, with the revocations that they have here or in `known`.
    pub fn with_lists_of(&self, known: &Self) -> Self {
        let mut lists = BTreeMap::clone(&self.lists);
        let here = |ca: &CaFingerprint| self.ca_spki(ca).is_some();
        for (ca, theirs) in known.lists.iter().filter(|(ca, _)| here(ca)) {
            let own = lists.entry(*ca).or_default();
            *own = own.with_all_of(theirs);
        }
        self.with_lists(Arc::new(lists))
    }

    /// Returns the lists in force, DER, to be passed on: they tell another node every revocation. Of each CA there is
    /// at most one that names serial numbers only, and [`crate::FLEET_LISTS_MAX`] of a fleet.
    pub fn crls(&self) -> impl Iterator<Item = &Bytes> {
        self.lists.values().flat_map(CaLists::lists).map(|list| &list.der)
    }

    /// Returns the lists in force, each with its CA and its SHA-256.
    pub fn crls_by_ca(&self) -> impl Iterator<Item = (&CaFingerprint, [u8; 32], &Bytes)> {
        let all = self.lists.iter().flat_map(|(ca, lists)| lists.lists().map(move |list| (ca, list)));
        all.map(|(ca, list)| (ca, sha256(&[&list.der]), &list.der))
    }

    /// Returns the nodes that a CA has revoked by name, in all of its lists.
    pub fn revoked_nodes(&self, ca: &CaFingerprint) -> impl Iterator<Item = (Pseudonym, Revocation)> {
        self.lists.get(ca).into_iter().flat_map(|lists| lists.nodes()).map(|(node, r)| (*node, *r))
    }

    /// Returns `true` if a trusted CA has revoked a node by name. A later incarnation of the node may be valid.
    pub fn is_node_revoked(&self, node: &NodeId) -> bool {
        let spki_of = |ca| self.ca_spki(ca).map(|spki| (ca, spki));
        let mut by_ca = self.lists.keys().filter_map(spki_of);
        by_ca.any(|(ca, spki)| self.revoked_nodes(ca).any(|(revoked, _)| node_id(spki, &revoked) == *node))
    }

    /// Returns the greatest number of a CA's lists that revoke nodes by name.
    pub fn fleet_list_number(&self, ca: &CaFingerprint) -> Option<u64> {
        let number = self.lists.get(ca)?.fleet_number()?;
        (number.len() <= 8).then(|| number.iter().fold(0, |n, byte| (n << 8) | u64::from(*byte)))
    }

    /// Returns `true` if a path from the certificate below a CA down to a node's is broken: one of its certificates is
    /// revoked, or that incarnation of the node.
    pub fn is_path_revoked(&self, path: &[CertId]) -> bool {
        self.path_revoked_at(path).is_some()
    }

    /// Returns `true` if a certificate on the path to this peer is revoked, or the peer itself.
    pub fn is_peer_revoked(&self, peer: &VerifiedPeer) -> bool {
        self.is_path_revoked(&peer.path)
    }

    /// Returns whether a verified peer would still be believed, apart from the time: its CA is trusted, and nothing on
    /// its path is revoked.
    pub fn stands(&self, peer: &VerifiedPeer) -> bool {
        self.ca_spki(&peer.ca).is_some() && !self.is_peer_revoked(peer)
    }

    /// Returns `true` if the key of the first CA made this signature, with any of its algorithms.
    pub(crate) fn signed_by_first(&self, message: &[u8], signature: &[u8]) -> bool {
        let Some((key_algorithm, key)) = self.anchors.first().and_then(|a| split_spki(&a.spki)) else {
            return false;
        };
        let mut fitting = CHAIN_ALGORITHMS.iter().filter(|a| a.public_key_alg_id().as_ref() == key_algorithm);
        fitting.any(|a| a.verify_signature(key, message, signature).is_ok())
    }

    /// Returns the time at which a path was broken. Serial numbers count for the CA that gave them. A node belongs to
    /// the trusted CA, whatever is between the two.
    pub(crate) fn path_revoked_at(&self, path: &[CertId]) -> Option<UnixMillis> {
        let of_serial = |cert: &CertId| self.lists.get(&cert.ca)?.serial_revoked_at(&cert.serial);
        let of_node = || {
            let node = path.last()?.node.as_ref()?;
            let known = self.lists.get(&path.first()?.ca)?.nodes().get(&node.pseudonym)?;
            known.covers(node.incarnation).then_some(known.at)
        };
        path.iter().find_map(of_serial).or_else(of_node)
    }

    fn verify_list(&self, der: &[u8], now: UnixMillis) -> Result<(CaFingerprint, RevocationList), CrlError> {
        if der.len() > CRL_BYTES_MAX {
            return Err(CrlError::TooLong { bytes: der.len() });
        }
        // Webpki checks the form as a whole: versions, critical extensions, and that both algorithms are the same.
        let list = BorrowedCertRevocationList::from_der(der).map_err(unreadable)?;
        let fields = ListFields::from_list(der)
            .ok_or_else(|| CrlError::Malformed("its fields cannot be read".into()))?;
        if fields.is_scoped {
            return Err(CrlError::Partial);
        }
        let number = fields.number.ok_or(CrlError::NoNumber)?;
        let nodes = fields.revoked_nodes.map(read_revoked_nodes).transpose()?;
        let named = self.anchors.iter().zip(self.paths.iter());
        let mut named = named.filter(|(_, path)| *path.subject == *fields.issuer).peekable();
        if named.peek().is_none() {
            return Err(CrlError::UnknownIssuer);
        }
        // Several CAs may have one name; the signature tells the right one.
        let (anchor, _) = named.find(|(anchor, _)| anchor.signed(&fields)).ok_or(CrlError::BadSignature)?;
        if may_sign_lists(&anchor.der) != Some(true) {
            return Err(CrlError::NotAListSigner);
        }
        if now.secs() > anchor.validity.not_after.secs() {
            return Err(CrlError::CaExpired { not_after: anchor.validity.not_after, now });
        }
        let mut serials = BTreeMap::new();
        for entry in &list {
            let entry = entry.map_err(unreadable)?;
            let at = UnixMillis(entry.revocation_date.as_secs().saturating_mul(1000));
            serials.insert(without_zeros(entry.serial_number).into(), at);
        }
        let list = RevocationList { der: Bytes::copy_from_slice(der), number: number.into(), serials, nodes };
        Ok((anchor.fingerprint, list))
    }
}

/// A verified list with news.
pub struct CrlNews {
    /// The trusted CA that signed it.
    pub ca: CaFingerprint,
    /// Its number among the lists of that CA.
    pub number: CrlNumber,
    /// The trust anchors with it.
    pub anchors: TrustAnchors,
}

/// The CRL number of a list (RFC 5280, 5.2.3). The greater of two numbers of one CA is the newer list's.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct CrlNumber {
    // Compared first, so that the bytes, which have no leading zeros, compare as a number.
    len: usize,
    bytes: Box<[u8]>,
}

impl CrlNumber {
    fn from_bytes(number: &[u8]) -> Self {
        Self { len: number.len(), bytes: number.into() }
    }
}

impl Anchor {
    /// Returns `true` if this CA's key made the signature of the list.
    fn signed(&self, list: &ListFields<'_>) -> bool {
        let Some((key_algorithm, key)) = split_spki(&self.spki) else { return false };
        CHAIN_ALGORITHMS
            .iter()
            .filter(|a| a.signature_alg_id().as_ref() == list.algorithm)
            .filter(|a| a.public_key_alg_id().as_ref() == key_algorithm)
            .any(|a| a.verify_signature(key, list.tbs, list.signature).is_ok())
    }
}

/// Reads the extension by which a fleet's list revokes nodes (`docs/spec/trust.md`).
fn read_revoked_nodes(extension: &[u8]) -> Result<RevokedNodes, CrlError> {
    let broken = || CrlError::Malformed("its revoked nodes cannot be read".into());
    let entries = RevokedNodeFields::all(extension).ok_or_else(broken)?;
    if entries.len() > LIST_NODES_MAX {
        return Err(broken());
    }
    let mut nodes = RevokedNodes::new();
    for entry in entries {
        let node = Pseudonym(entry.pseudonym);
        if nodes.last_key_value().is_some_and(|(last, _)| *last >= node) {
            return Err(broken());
        }
        let at = UnixMillis(entry.revoked_secs.checked_mul(1000).ok_or_else(broken)?);
        nodes.insert(node, Revocation { incarnation: entry.incarnation, at });
    }
    Ok(nodes)
}

/// Returns the reason why webpki does not read a list.
fn unreadable(error: webpki::Error) -> CrlError {
    use webpki::Error as E;
    match error {
        E::UnsupportedDeltaCrl
        | E::UnsupportedIndirectCrl
        | E::UnsupportedCrlIssuingDistributionPoint
        | E::UnsupportedRevocationReasonsPartitioning => CrlError::Partial,
        other => CrlError::Malformed(other.to_string()),
    }
}
