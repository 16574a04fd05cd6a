//! One node's identity: certificate chain, private key, the CAs it trusts, and (not for routers) the secrets of its
//! fleet; and the one text file in which they are kept.
//!
//! This module does not read the file (the node does, and checks its permissions) and knows no clock: its user checks
//! whether the certificate is still valid. Only the output of [`Identity::to_text`] holds a secret.

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use rand_core::CryptoRng;
use rcgen::PublicKeyData as _;
use rustls::SignatureScheme;
use rustls::sign::{CertifiedKey, SigningKey};
use rustls_pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use sgc_wire::{Credentials, GroupTag, NodeId, Pseudonym, UnixMillis};
use zeroize::Zeroizing;

use crate::blocks::{CERTIFICATE_BLOCK, KEY_BLOCK};
use crate::cert_error::CertError;
use crate::identity_error::IdentityError;
use crate::issue;
use crate::key::Key;
use crate::label::{FleetName, GroupName, NodeName, OBSERVERS_GROUP};
use crate::member::{self, FileParts, Membership, check_generations};
use crate::peer::{VerifiedPeer, node_id, signature_input};
use crate::secret::{FleetSecret, NamingSecret};
use crate::verify::TrustAnchors;
use crate::x509::Validity;

/// Signature schemes of an identity, by the kind of its key; [`VerifiedPeer::verify_signature`] has the same list.
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

/// The parts of an identity.
#[derive(Clone)]
struct IdentityParts {
    member: Membership,
    key: Zeroizing<Vec<u8>>,
    reset_key: Option<Zeroizing<[u8; 32]>>,
}

impl Identity {
    /// Parses the text of [`Identity::to_text`]. The parts have to fit together; it does not check whether the
    /// certificate is valid now.
    pub fn parse(text: &str) -> Result<Self, IdentityError> {
        let FileParts { member, key, reset_key } = member::read(text)?;
        let key = key.ok_or(IdentityError::Missing(KEY_BLOCK))?;
        Self::assemble(IdentityParts { member, key, reset_key })
    }

    /// Makes the identity of a node from its own key (PKCS #8) and the fleet's answer.
    pub fn join(member: Membership, key: &[u8], rng: &mut impl CryptoRng) -> Result<Self, IdentityError> {
        let mut reset_key = Zeroizing::new([0; 32]);
        rng.fill_bytes(&mut *reset_key);
        let key = Zeroizing::new(key.to_vec());
        Self::assemble(IdentityParts { member, key, reset_key: Some(reset_key) })
    }

    /// Makes an identity from a certificate of an existing PKI, made for a request of [`Identity::csr`] or `sgc fleet
    /// request`. Without a secret it is a router's. The certificate has to name exactly the requested names and role:
    /// its signer may not know their meaning.
    pub fn import(import: Import, rng: &mut impl CryptoRng) -> Result<Self, IdentityError> {
        let Import { node, fleet, chain, key, cas, secret, groups, may_route } = import;
        let tag = |secret: &FleetSecret, group: &GroupName| secret.group_tag(group.as_str());
        let asked: BTreeSet<_> =
            secret.iter().flat_map(|s| groups.iter().map(|group| tag(s, group))).collect();
        let is_router = secret.is_none();
        let naming = secret.iter().map(|s| NamingSecret { generation: 1, secret: s.clone() }).collect();
        let anchors = TrustAnchors::new(cas).map_err(IdentityError::Ca)?;
        let (authority, post_quantum, observers) = (None, false, None);
        let member =
            Membership { node, fleet, chain, anchors, secret, naming, authority, post_quantum, observers };
        let identity = Self::join(member, &key, rng)?;
        let own = &identity.own;
        if own.may_route && !may_route && !is_router {
            return Err(IdentityError::UnaskedRole);
        }
        if may_route && !own.may_route {
            return Err(IdentityError::MissingRole);
        }
        if own.incarnation > 0 {
            return Err(IdentityError::UnaskedIncarnation);
        }
        let unasked = own.groups.iter().filter(|group| !asked.contains(group)).count();
        let missing = asked.iter().filter(|group| !own.is_in(group)).count();
        if unasked > 0 || missing > 0 {
            return Err(IdentityError::OtherGroups { unasked, missing });
        }
        Ok(identity)
    }

    /// Returns everything in one text, for a file that only its owner may read.
    pub fn to_text(&self) -> Zeroizing<String> {
        let parts = &self.parts;
        let head = "# SGC identity. KEEP IT SECRET: whoever holds this file is this node.\n";
        let comment = format!("{}# id:      {}\n", parts.member.comment(head), self.node_id());
        let reset_key = parts.reset_key.as_ref().map(|k| &k[..]);
        member::write(&parts.member, &comment, Some(&parts.key), reset_key)
    }

    /// Returns the node's name in its fleet.
    pub fn node_name(&self) -> &NodeName {
        &self.parts.member.node
    }

    /// Returns the fleet's name, for people.
    pub fn fleet_name(&self) -> &FleetName {
        &self.parts.member.fleet
    }

    /// Returns the certificate chain, leaf first.
    pub fn chain(&self) -> &[CertificateDer<'static>] {
        &self.parts.member.chain
    }

    /// Returns the CAs that this node trusts.
    pub fn anchors(&self) -> &TrustAnchors {
        &self.parts.member.anchors
    }

    /// Returns the same node with other CAs or newer revocation lists. It is not checked against them: this way a node
    /// may learn that it is revoked.
    pub fn with_anchors(&self, anchors: TrustAnchors) -> Self {
        let mut parts = self.parts.clone();
        parts.member.anchors = anchors;
        Self { parts, certified: Arc::clone(&self.certified), own: self.own.clone() }
    }

    /// Returns the same node with the certificates and secrets that its fleet's authority sent for [`Identity::csr`].
    /// Key, CAs and name stay; everything else has to fit them.
    pub fn with_credentials(&self, credentials: &Credentials) -> Result<Self, IdentityError> {
        let mut parts = self.parts.clone();
        let chain = credentials.chain.iter().map(|c| CertificateDer::from(c.to_vec()));
        parts.member.chain = chain.collect();
        let secret = |bytes: &[u8; 32]| FleetSecret::from_bytes(*bytes);
        let naming = credentials
            .secrets
            .iter()
            .map(|s| NamingSecret { generation: s.generation, secret: secret(s.secret.expose()) });
        parts.member.naming = naming.collect();
        check_generations(parts.member.secret.as_ref(), &parts.member.naming)?;
        let newest = |naming: &[NamingSecret]| naming.first().map(|n| n.generation);
        if newest(&parts.member.naming) < newest(self.naming_secrets()) {
            return Err(IdentityError::OldSecrets);
        }
        let new = Self::assemble(parts)?;
        if new.node_id() != self.node_id() {
            return Err(IdentityError::NameMismatch { node: new.parts.member.node });
        }
        // Another copy of the fleet's file is behind; its certificates may be revoked already.
        if new.own.incarnation < self.own.incarnation {
            return Err(IdentityError::OldIncarnation);
        }
        Ok(new)
    }

    /// Returns the same node and key with everything else new, as a fleet answered [`Identity::csr`]. Further CAs stay
    /// trusted.
    pub fn with_membership(&self, member: Membership) -> Result<Self, IdentityError> {
        let more = member.anchors.certificates().cloned().collect::<Vec<_>>();
        let anchors = self.anchors().with_anchors(more).map_err(IdentityError::Ca)?;
        let parts = IdentityParts { member: Membership { anchors, ..member }, ..self.parts.clone() };
        let new = Self::assemble(parts)?;
        if new.node_id() != self.node_id() {
            return Err(IdentityError::NameMismatch { node: new.parts.member.node });
        }
        // Another copy of the fleet's file is behind; its certificates may be revoked already.
        if new.own.incarnation < self.own.incarnation {
            return Err(IdentityError::OldIncarnation);
        }
        Ok(new)
    }

    /// Returns a request for another certificate of the same node and key, DER (PKCS #10).
    pub fn csr(&self) -> Vec<u8> {
        let own = &self.own;
        Key::from_pkcs8(&self.parts.key)
            .and_then(|key| issue::signing_request(&key, Some(&own.pseudonym), &own.groups, own.may_route))
            .expect("`assemble` made a signature with this key already")
    }

    /// Returns the secrets that names are derived from, newest first; none for a router. New shares use the first.
    pub fn naming_secrets(&self) -> &[NamingSecret] {
        &self.parts.member.naming
    }

    /// Returns the node that renews certificates for the fleet, if there is one.
    pub fn authority(&self) -> Option<NodeId> {
        self.parts.member.authority
    }

    /// Returns `true` if the fleet wants links and grants that a quantum computer does not open later.
    pub fn post_quantum(&self) -> bool {
        self.parts.member.post_quantum
    }

    /// Returns the transports that the key rules out, for people: one sentence each.
    pub fn transport_notes(&self) -> Vec<&'static str> {
        let is_ecdsa = matches!(
            self.certified.key.choose_scheme(&SCHEMES).map(|s| s.scheme()),
            Some(SignatureScheme::ECDSA_NISTP256_SHA256 | SignatureScheme::ECDSA_NISTP384_SHA384)
        );
        match is_ecdsa {
            true => Vec::new(),
            false => vec!["DTLS cannot use this identity: it needs a P-256 or P-384 key; QUIC and TLS can"],
        }
    }

    /// Returns the fleet secret; a router has none.
    pub fn fleet_secret(&self) -> Option<&FleetSecret> {
        self.parts.member.secret.as_ref()
    }

    /// Returns the tag of a group of this fleet. A router knows that of the observers, if its fleet told it, and no other.
    pub fn group_tag(&self, group: &str) -> Option<GroupTag> {
        let told = self.parts.member.observers.filter(|_| group == OBSERVERS_GROUP);
        self.fleet_secret().map(|secret| secret.group_tag(group)).or(told)
    }

    /// Returns chain and private key for TLS. The key can sign and cannot be read.
    pub fn certified_key(&self) -> Arc<CertifiedKey> {
        Arc::clone(&self.certified)
    }

    /// Returns a random key by which peers learn at once that this node restarted (`sgc-transport` derives stateless
    /// resets from it). It protects nothing else.
    pub fn reset_key(&self) -> Option<&[u8; 32]> {
        self.parts.reset_key.as_deref()
    }

    /// Returns this node as others see it after verification.
    pub fn as_peer(&self) -> &VerifiedPeer {
        &self.own
    }

    /// Returns the node id.
    pub fn node_id(&self) -> NodeId {
        self.own.node_id
    }

    /// Returns the pseudonym in the certificate.
    pub fn pseudonym(&self) -> Pseudonym {
        self.own.pseudonym
    }

    /// Returns the groups.
    pub fn groups(&self) -> &[GroupTag] {
        &self.own.groups
    }

    /// Returns the last moment at which the certificate is valid.
    pub fn not_after(&self) -> UnixMillis {
        self.own.not_after
    }

    /// Returns the id of the member of this fleet with that name; `None` without the fleet secret.
    pub fn node_id_of(&self, node_name: &str) -> Option<NodeId> {
        let spki = self.parts.member.anchors.ca_spki(&self.own.ca)?;
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
    fn assemble(parts: IdentityParts) -> Result<Self, IdentityError> {
        let member = &parts.member;
        // A key that cannot sign requests could not be renewed later.
        let stored = Key::from_pkcs8(&parts.key).ok_or(IdentityError::Key)?;
        let pkcs8 = PrivateKeyDer::Pkcs8(PrivatePkcs8KeyDer::from(parts.key.as_slice()));
        let key =
            rustls::crypto::aws_lc_rs::sign::any_supported_type(&pkcs8).map_err(|_| IdentityError::Key)?;
        check_signs(&*key)?;
        let leaf = member.chain.first().ok_or(IdentityError::Missing(CERTIFICATE_BLOCK))?;
        // Checked at the chain's own beginning: its validity now is another question.
        let validity = Validity::from_certificate(leaf).ok_or_else(|| {
            IdentityError::Chain(CertError::Malformed("its validity cannot be read".into()))
        })?;
        let own = member.anchors.verify(&member.chain, validity.not_before).map_err(IdentityError::Chain)?;
        let certified = CertifiedKey::new(member.chain.clone(), key);
        let same = webpki::EndEntityCert::try_from(leaf)
            .is_ok_and(|c| c.subject_public_key_info().as_ref() == stored.subject_public_key_info());
        if !same || certified.keys_match().is_err() {
            return Err(IdentityError::KeyMismatch);
        }
        member.check_secrets()?;
        let is_named = |s: &FleetSecret| s.pseudonym(member.node.as_str()) == own.pseudonym;
        if !member.secret.as_ref().is_none_or(is_named) {
            return Err(IdentityError::NameMismatch { node: member.node.clone() });
        }
        Ok(Self { parts, certified: Arc::new(certified), own })
    }
}

impl fmt::Debug for Identity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Identity")
            .field("node", &self.parts.member.node)
            .field("fleet", &self.parts.member.fleet)
            .field("id", &self.own.node_id)
            .field("ca", &self.own.ca)
            .finish_non_exhaustive()
    }
}

/// Input of [`Identity::import`].
pub struct Import {
    /// The node's name.
    pub node: NodeName,
    /// The fleet's name, for people.
    pub fleet: FleetName,
    /// Its certificates, leaf first.
    pub chain: Vec<CertificateDer<'static>>,
    /// Its private key, PKCS #8: P-256, P-384, Ed25519 or RSA.
    pub key: Zeroizing<Vec<u8>>,
    /// The CAs that the node has to trust, its own among them.
    pub cas: Vec<CertificateDer<'static>>,
    /// The fleet's secret; the certificate's pseudonym has to be the node's under it.
    pub secret: Option<FleetSecret>,
    /// The node's groups; none without the secret.
    pub groups: Vec<GroupName>,
    /// Whether a member routes for others as well. A router may in any case.
    pub may_route: bool,
}

fn check_signs(key: &dyn SigningKey) -> Result<(), IdentityError> {
    let signer = key.choose_scheme(&SCHEMES).ok_or(IdentityError::Key)?;
    signer.sign(b"").map(drop).map_err(|_| IdentityError::Key)
}
