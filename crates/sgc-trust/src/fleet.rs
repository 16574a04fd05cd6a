//! A fleet: its CA, the secrets from which its names are derived, and the roster of its nodes.
//!
//! This module makes identities, renews and revokes them, and writes no file. Certificates name nodes and groups by
//! keyed hashes, so that routers and the network learn no name.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use aws_lc_rs::digest;
use bytes::Bytes;
use rand_core::CryptoRng;
use rcgen::{PublicKeyData as _, SigningKey as _};
use rustls_pki_types::CertificateDer;
use sgc_wire::{
    Credentials, DecodeError, NodeId, Pseudonym, Reader, SECRET_GENERATIONS_MAX, SecretBytes,
    SecretGeneration, UnixMillis, Writer,
};
use zeroize::Zeroizing;

use crate::blocks::{CERTIFICATE_BLOCK, FLEET_BLOCK, KEY_BLOCK, ROSTER_BLOCK};
use crate::fleet_error::FleetError;
use crate::issue::{self, hex};
use crate::key::Key;
use crate::label::{FleetName, LABEL_BYTES_MAX, NodeName};
use crate::peer::{node_id, signature_input};
use crate::pem::{self, Block, FLEET_FILE_BYTES_MAX};
use crate::revocations::{REVOKED_NODES_MAX, Revocation, RevokedNodes, add_revocation};
use crate::roster::{Generation, ROSTER_BYTES_MAX, ROSTER_NODES_MAX, Roster, RosterNode};
use crate::secret::{FleetSecret, NAMING_BLOCK, NamingSecret, SECRET_BLOCK};
use crate::verify::TrustAnchors;
use crate::x509::{CaFields, Serial, Validity, may_sign_lists};

/// Validity of a node's certificate unless the request says otherwise.
pub const LEAF_VALIDITY_DEFAULT: Duration = Duration::from_secs(90 * 86_400);
/// Least time between two sightings of a node that a roster notes: the roster is written as a whole.
pub const SEEN_STEP: Duration = Duration::from_secs(86_400);
/// A node seen within this time may come back.
pub const SEEN_RECENTLY: Duration = Duration::from_secs(30 * 86_400);

const FILE_VERSION: u8 = 2;
/// The version before there was a roster.
const FILE_VERSION_1: u8 = 1;
const ROSTER_CONTEXT: &str = "sgc roster v1";
const SIGNATURE_BYTES_MAX: usize = 1024;

/// A certificate authority, the secrets of a fleet, its roster and a name.
pub struct Fleet {
    pub(crate) name: FleetName,
    pub(crate) secret: FleetSecret,
    /// Secrets in use, newest first.
    pub(crate) naming: Vec<NamingSecret>,
    pub(crate) key: Key,
    pub(crate) certificate: CertificateDer<'static>,
    pub(crate) anchors: TrustAnchors,
    pub(crate) validity: Validity,
    pub(crate) roster: Roster,
    /// The roster with its signature; `None` while the file is from before rosters.
    signed_roster: Option<Vec<u8>>,
}

impl Fleet {
    /// Creates a fleet. Its CA is valid for [`crate::CA_VALIDITY`]; the CA's certificate does not tell the fleet's
    /// name.
    pub fn create(name: FleetName, now: UnixMillis, rng: &mut impl CryptoRng) -> Result<Self, FleetError> {
        let key = Key::generate(rng);
        let secret = FleetSecret::generate(rng);
        let certificate = issue::self_signed_ca(&key, now, rng)?;
        let mut fleet = Self::assemble(name, secret, key, certificate)?;
        fleet.begin_roster(now)?;
        Ok(fleet)
    }

    /// Makes a fleet around an existing CA: its certificate, DER, and its private key, PKCS #8. The CA keeps its other
    /// purposes; the fleet's nodes are those that `sgc fleet` makes with it.
    pub fn import(
        name: FleetName,
        certificate: CertificateDer<'static>,
        key: &[u8],
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Self, FleetError> {
        let key = Key::from_pkcs8(key).ok_or(FleetError::Key)?;
        let fields =
            CaFields::from_certificate(&certificate).ok_or(FleetError::NotACa("it cannot be read"))?;
        if !fields.is_ca {
            return Err(FleetError::NotACa("its basic constraints do not say CA"));
        }
        if !fields.may_sign_certificates {
            return Err(FleetError::NotACa("its key usage lacks keyCertSign"));
        }
        if may_sign_lists(&certificate) != Some(true) {
            return Err(FleetError::NotACa("its key usage lacks cRLSign"));
        }
        let mut fleet = Self::assemble(name, FleetSecret::generate(rng), key, certificate)?;
        fleet.check_ca_holds(now)?;
        // A list signed in the CA's name shows whether that name survives re-encoding.
        let list = fleet.revocation_list(now)?;
        fleet.anchors.with_crl(&list, now).map_err(|_| FleetError::CaName)?;
        fleet.begin_roster(now)?;
        Ok(fleet)
    }

    /// Parses the text of [`Fleet::to_text`], and that of versions before rosters.
    pub fn parse(text: &str) -> Result<Self, FleetError> {
        let mut about: Option<Block> = None;
        let mut certificate: Option<Block> = None;
        let mut key: Option<Block> = None;
        let mut secret: Option<Block> = None;
        let mut roster: Option<Block> = None;
        let mut naming = Vec::new();
        for block in pem::parse(text, FLEET_FILE_BYTES_MAX).map_err(FleetError::File)? {
            let (name, slot) = match block.label.as_str() {
                FLEET_BLOCK => (FLEET_BLOCK, &mut about),
                CERTIFICATE_BLOCK => (CERTIFICATE_BLOCK, &mut certificate),
                KEY_BLOCK => (KEY_BLOCK, &mut key),
                SECRET_BLOCK => (SECRET_BLOCK, &mut secret),
                ROSTER_BLOCK => (ROSTER_BLOCK, &mut roster),
                NAMING_BLOCK => {
                    let secret = NamingSecret::from_block(&block.content);
                    naming.push(secret.ok_or(FleetError::NamingSecret)?);
                    continue;
                }
                _ => return Err(FleetError::UnknownBlock(block.label)),
            };
            if slot.replace(block).is_some() {
                return Err(FleetError::Repeated(name));
            }
        }
        let need = |slot: Option<Block>, name| slot.map(|b| b.content).ok_or(FleetError::Missing(name));
        let (version, name) = read_about(&need(about, FLEET_BLOCK)?)?;
        let certificate = need(certificate, CERTIFICATE_BLOCK)?;
        let key = Key::from_pkcs8(&need(key, KEY_BLOCK)?).ok_or(FleetError::Key)?;
        let secret = FleetSecret::read(&need(secret, SECRET_BLOCK)?).ok_or(FleetError::Secret)?;
        let mut fleet = Self::assemble(name, secret, key, CertificateDer::from(certificate.to_vec()))?;
        match roster {
            Some(block) => fleet.read_roster(&block.content, naming)?,
            None if version == FILE_VERSION_1 && naming.is_empty() => {}
            None => return Err(FleetError::Missing(ROSTER_BLOCK)),
        }
        Ok(fleet)
    }

    /// Returns everything in one text, for a file that only its owner may read.
    pub fn to_text(&self) -> Zeroizing<String> {
        let mut about = Writer::default();
        about.u8(if self.signed_roster.is_some() { FILE_VERSION } else { FILE_VERSION_1 });
        about.str(self.name.as_str());
        let about = about.into_vec();
        let comment = format!(
            "# SGC fleet. KEEP IT SECRET: whoever holds this file can make nodes of this fleet and derive its names.\n\
             # Back it up whenever it changes; nodes need it only to be enrolled, renewed and revoked.\n\
             # fleet:   {}\n# CA:      {}\n# expires: {}\n",
            self.name,
            self.ca_fingerprint(),
            self.validity.not_after,
        );
        let stored = self.naming.iter().filter(|n| n.generation >= NamingSecret::STORED_FROM);
        let naming: Vec<_> = stored.map(NamingSecret::to_block).collect();
        let mut blocks: Vec<(&str, &[u8])> = vec![
            (FLEET_BLOCK, &about),
            (CERTIFICATE_BLOCK, &self.certificate),
            (KEY_BLOCK, self.key.pkcs8()),
            (SECRET_BLOCK, self.secret.expose()),
        ];
        blocks.extend(naming.iter().map(|n| (NAMING_BLOCK, &n[..])));
        blocks.extend(self.signed_roster.as_ref().map(|r| (ROSTER_BLOCK, &r[..])));
        pem::write(&comment, &blocks)
    }

    /// Returns a node's credentials besides its key: these certificates, and the secrets in use.
    pub fn credentials_for(&self, node: &NodeName, chain: Vec<Bytes>) -> Result<Credentials, FleetError> {
        let node = self.active_node(node)?;
        let naming: &[NamingSecret] = if node.router { &[] } else { &self.naming };
        let secrets = naming.iter().map(|n| SecretGeneration {
            generation: n.generation,
            secret: SecretBytes::new(*n.secret.expose()),
        });
        Ok(Credentials { chain, secrets: secrets.collect() })
    }

    /// Revokes every certificate of these nodes; [`Fleet::revocation_list`] includes them from then on. Either all are
    /// revoked or none.
    pub fn revoke(&mut self, nodes: &[NodeName], now: UnixMillis) -> Result<(), FleetError> {
        if let Some(unknown) = nodes.iter().find(|n| !self.roster.nodes.contains_key(*n)) {
            return Err(FleetError::UnknownNode { node: unknown.to_string() });
        }
        self.roster.prune(now);
        let mut revoked = self.roster.revoked.clone();
        for node in nodes.iter().filter_map(|n| self.roster.nodes.get(n)) {
            let revocation = Revocation::new(node.incarnation, now);
            add_revocation(&mut revoked, self.secret.pseudonym(node.name.as_str()), revocation);
        }
        if revoked.len() > REVOKED_NODES_MAX {
            return Err(FleetError::TooManyRevoked);
        }
        self.roster.revoked = revoked;
        self.begin_list(now);
        self.sign_roster()
    }

    /// Gives the next list its number. It follows the clock, so that another copy of the fleet's file makes no list
    /// that passes for a newer one.
    fn begin_list(&mut self, now: UnixMillis) {
        self.roster.crl_number = now.secs().max(self.roster.crl_number.saturating_add(1));
    }

    /// Merges `other`, another copy of this fleet's file: no revocation, enrolment or incarnation of either is lost.
    /// The order in which copies are merged does not matter.
    pub fn merge(&mut self, other: &Self, now: UnixMillis) -> Result<MergeReport, FleetError> {
        if self.key.subject_public_key_info() != other.key.subject_public_key_info()
            || self.secret.expose() != other.secret.expose()
        {
            return Err(FleetError::OtherFleet { name: other.name.clone() });
        }
        if !other.has_roster() {
            return Ok(MergeReport::default());
        }
        self.begin_roster_if_none(now)?;
        let mut roster = self.roster.clone();
        roster.join(&other.roster);
        if roster.nodes.len() > ROSTER_NODES_MAX {
            return Err(FleetError::TooManyNodes);
        }
        if roster.revoked.len() > REVOKED_NODES_MAX {
            return Err(FleetError::TooManyRevoked);
        }
        let merged = MergeReport::between(&self.roster, &roster, &self.secret);
        let known: Vec<_> = self.naming.iter().chain(&other.naming).cloned().collect();
        let named = |g: &Generation| known.iter().find(|n| n.generation == g.number && hash(n) == g.hash);
        let naming: Option<Vec<_>> = roster.generations.iter().rev().map(|g| named(g).cloned()).collect();
        self.naming = naming.ok_or(FleetError::NamingSecret)?;
        let is_news = roster.revoked != self.roster.revoked || roster.revoked != other.roster.revoked;
        self.roster = roster;
        if is_news {
            self.begin_list(now);
        }
        self.sign_roster()?;
        Ok(merged)
    }

    /// Takes over the nodes that this fleet's CA has revoked by name in the lists of `anchors`: another copy of the
    /// fleet's file made a longer list.
    pub fn absorb(&mut self, anchors: &TrustAnchors, now: UnixMillis) -> Result<CrlReport, FleetError> {
        let Some(ca) = self.anchors.fingerprints().next() else { return Ok(CrlReport::default()) };
        let mut absorbed = CrlReport::default();
        let mut revoked = self.roster.revoked.clone();
        for (node, revocation) in anchors.revoked_nodes(&ca) {
            if add_revocation(&mut revoked, node, revocation) {
                absorbed.revoked.push(self.name_of(&node));
            }
        }
        if revoked.len() > REVOKED_NODES_MAX {
            return Err(FleetError::TooManyRevoked);
        }
        let number = anchors.fleet_list_number(&ca).unwrap_or(0);
        absorbed.is_behind = number > self.roster.crl_number;
        if !absorbed.revoked.is_empty() || absorbed.is_behind {
            self.begin_roster_if_none(now)?;
            self.roster.revoked = revoked;
            self.roster.crl_number = self.roster.crl_number.max(number);
            self.sign_roster()?;
        }
        Ok(absorbed)
    }

    /// Returns the name of the node with this pseudonym if this copy has it, or else the beginning of the pseudonym.
    fn name_of(&self, pseudonym: &Pseudonym) -> String {
        self.node_by_pseudonym(pseudonym).map_or_else(|| pseudonym.short(), |n| n.name.to_string())
    }

    /// Returns the list of all revoked nodes, and of their unexpired certificates: DER, for every node.
    pub fn revocation_list(&self, now: UnixMillis) -> Result<Vec<u8>, FleetError> {
        let serials = self.roster.revoked_serials(&self.secret);
        self.fleet_list(&self.roster.revoked, &serials, self.roster.crl_number, now)
    }

    /// Signs a list of any nodes, each with the incarnation up to which it is revoked, whatever the roster says.
    pub fn revocation_list_of_nodes(
        &self,
        revoked: &[(Pseudonym, Revocation)],
        number: u64,
        now: UnixMillis,
    ) -> Result<Vec<u8>, FleetError> {
        self.fleet_list(&revoked.iter().copied().collect(), &[], number, now)
    }

    fn fleet_list(
        &self,
        nodes: &RevokedNodes,
        serials: &[(Serial, UnixMillis)],
        number: u64,
        now: UnixMillis,
    ) -> Result<Vec<u8>, FleetError> {
        issue::fleet_list(&self.certificate, &self.key, nodes, serials, number, now)
    }

    /// Signs a list of any serial numbers, each with the time of its revocation, as a CA without a fleet does.
    pub fn revocation_list_of(
        &self,
        revoked: &[(Serial, UnixMillis)],
        number: u64,
        now: UnixMillis,
    ) -> Result<Vec<u8>, FleetError> {
        issue::revocation_list(&self.certificate, &self.key, revoked, number, now)
    }

    /// Makes the next generation of the naming secret, and returns its number. Nodes that have it use it to name their
    /// shares; older generations stay in use until they are retired.
    pub fn rotate_secret(&mut self, now: UnixMillis, rng: &mut impl CryptoRng) -> Result<u32, FleetError> {
        self.begin_roster_if_none(now)?;
        if self.naming.len() >= SECRET_GENERATIONS_MAX {
            return Err(FleetError::TooManyGenerations);
        }
        let generation = self.newest_generation().saturating_add(1);
        let secret = NamingSecret { generation, secret: FleetSecret::generate(rng) };
        self.roster.generations.push(recorded(&secret, now));
        self.naming.insert(0, secret);
        self.sign_roster()?;
        Ok(generation)
    }

    /// Takes the generations before this one out of use: names derived from them are no longer found. Node ids and
    /// groups stay with generation 1.
    pub fn retire_secrets(&mut self, before: u32) -> Result<(), FleetError> {
        let newest = self.newest_generation();
        if before > newest {
            return Err(FleetError::NewestGeneration { newest });
        }
        self.naming.retain(|n| n.generation >= before);
        self.roster.generations.retain(|g| g.number >= before);
        self.roster.oldest_generation = self.roster.oldest_generation.max(before);
        self.sign_roster()
    }

    /// Sets the node that renews certificates for the fleet. Nodes learn it when they are enrolled or renewed by file.
    pub fn set_authority(&mut self, node: Option<NodeName>, now: UnixMillis) -> Result<(), FleetError> {
        self.begin_roster_if_none(now)?;
        self.roster.settings.authority = node;
        self.settings_changed(now)
    }

    /// Sets whether links and grants of the fleet resist quantum computers. Nodes learn it as they do the authority.
    pub fn set_post_quantum(&mut self, on: bool, now: UnixMillis) -> Result<(), FleetError> {
        self.begin_roster_if_none(now)?;
        self.roster.settings.post_quantum = on;
        self.settings_changed(now)
    }

    fn settings_changed(&mut self, now: UnixMillis) -> Result<(), FleetError> {
        let changed = &mut self.roster.settings.changed;
        *changed = now.max(UnixMillis(changed.0.saturating_add(1)));
        self.sign_roster()
    }

    /// Returns the fleet's name, for people.
    pub fn name(&self) -> &FleetName {
        &self.name
    }

    /// Returns the fleet secret.
    pub fn secret(&self) -> &FleetSecret {
        &self.secret
    }

    /// Returns the secrets that names are derived from, newest first.
    pub fn naming_secrets(&self) -> &[NamingSecret] {
        &self.naming
    }

    /// Returns the generations of the naming secret in use with their times, oldest first; empty without a roster.
    pub fn generations(&self) -> &[Generation] {
        &self.roster.generations
    }

    /// Returns the fleet's CA as trust anchor.
    pub fn anchors(&self) -> &TrustAnchors {
        &self.anchors
    }

    /// Returns the CA certificate, DER.
    pub fn ca_certificate(&self) -> &CertificateDer<'static> {
        &self.certificate
    }

    /// Returns the last moment at which the CA is valid.
    pub fn not_after(&self) -> UnixMillis {
        self.validity.not_after
    }

    /// Returns the nodes, by name. A fleet file from before rosters has none until it changes.
    pub fn nodes(&self) -> impl ExactSizeIterator<Item = &RosterNode> {
        self.roster.nodes.values()
    }

    /// Returns one node.
    pub fn node(&self, name: &NodeName) -> Option<&RosterNode> {
        self.roster.nodes.get(name)
    }

    /// Returns the incarnation up to which the node is revoked; it need not be in the roster.
    pub fn revocation_of(&self, node: &NodeName) -> Option<Revocation> {
        self.roster.revocation_of(node, &self.secret)
    }

    /// Returns the time at which a node of the roster was revoked in its present incarnation.
    pub fn revoked_at(&self, node: &RosterNode) -> Option<UnixMillis> {
        self.revocation_of(&node.name).filter(|r| r.covers(node.incarnation)).map(|r| r.at)
    }

    /// Returns the revoked nodes, by their pseudonyms.
    pub fn revoked_nodes(&self) -> impl ExactSizeIterator<Item = (&Pseudonym, &Revocation)> {
        self.roster.revoked.iter()
    }

    /// Returns the node of this pseudonym.
    pub fn node_by_pseudonym(&self, pseudonym: &Pseudonym) -> Option<&RosterNode> {
        self.nodes().find(|n| self.secret.pseudonym(n.name.as_str()) == *pseudonym)
    }

    /// Returns `false` for a file from before rosters: nodes enrolled with it are not known.
    pub fn has_roster(&self) -> bool {
        self.signed_roster.is_some()
    }

    /// Returns the number of the last revocation list; 0 if nothing was ever revoked.
    pub fn crl_number(&self) -> u64 {
        self.roster.crl_number
    }

    /// Returns the name of the node that renews certificates.
    pub fn authority(&self) -> Option<&NodeName> {
        self.roster.settings.authority.as_ref()
    }

    /// Returns `true` if links and grants of the fleet resist quantum computers.
    pub fn post_quantum(&self) -> bool {
        self.roster.settings.post_quantum
    }

    /// Returns the id of the node of that name.
    pub fn node_id_of(&self, node: &NodeName) -> NodeId {
        node_id(&self.key.subject_public_key_info(), &self.secret.pseudonym(node.as_str()))
    }

    pub(crate) fn active_node(&self, name: &NodeName) -> Result<&RosterNode, FleetError> {
        let node = self.roster.nodes.get(name);
        let node = node.ok_or_else(|| FleetError::UnknownNode { node: name.to_string() })?;
        match self.revoked_at(node) {
            Some(at) => Err(FleetError::NodeRevoked { node: name.clone(), at }),
            None => Ok(node),
        }
    }

    pub(crate) fn check_ca_holds(&self, now: UnixMillis) -> Result<(), FleetError> {
        let not_after = self.validity.not_after;
        if now.secs() > not_after.secs() { Err(FleetError::CaExpired { not_after, now }) } else { Ok(()) }
    }

    /// Notes that a node of the roster gets the secrets in use. Returns `true` if the file has to be saved: the secrets
    /// are new to the node, or it has not been seen for [`SEEN_STEP`].
    pub fn note_handed(&mut self, node: &NodeName, now: UnixMillis) -> Result<bool, FleetError> {
        let newest = self.newest_generation();
        let Some(node) = self.roster.nodes.get_mut(node) else { return Ok(false) };
        let generation = if node.router { 0 } else { newest };
        let step = SEEN_STEP.as_millis() as u64;
        let is_old = node.seen.is_none_or(|seen| seen.0.saturating_add(step) <= now.0);
        if generation == node.generation && !is_old {
            return Ok(false);
        }
        node.generation = generation;
        node.seen = node.seen.max(Some(now));
        self.sign_roster()?;
        Ok(true)
    }

    /// Returns members that would be lost if the generations before this one were retired: they have a valid
    /// certificate, were seen recently ([`SEEN_RECENTLY`]) or at an unknown time, and were handed no newer generation.
    pub fn lacking(&self, before: u32, now: UnixMillis) -> impl Iterator<Item = &RosterNode> {
        let recently = UnixMillis(now.0.saturating_sub(SEEN_RECENTLY.as_millis() as u64));
        self.nodes().filter(move |node| {
            let holds = node.expires(self.revocation_of(&node.name)).is_some_and(|until| until >= now);
            let is_member = !node.router && self.revoked_at(node).is_none();
            let is_here = node.seen.is_none_or(|seen| seen >= recently);
            is_member && holds && is_here && node.generation < before
        })
    }

    pub(crate) fn newest_generation(&self) -> u32 {
        self.naming.first().map_or(1, |n| n.generation)
    }

    pub(crate) fn begin_roster_if_none(&mut self, now: UnixMillis) -> Result<(), FleetError> {
        if self.has_roster() { Ok(()) } else { self.begin_roster(now) }
    }

    fn begin_roster(&mut self, now: UnixMillis) -> Result<(), FleetError> {
        self.roster.generations = self.naming.iter().map(|n| recorded(n, now)).collect();
        self.sign_roster()
    }

    pub(crate) fn sign_roster(&mut self) -> Result<(), FleetError> {
        let body = self.roster.encode();
        if body.len() > ROSTER_BYTES_MAX {
            return Err(FleetError::RosterFull { bytes: body.len() });
        }
        let signature = self.key.sign(&signature_input(ROSTER_CONTEXT, &body)).map_err(FleetError::making)?;
        let mut w = Writer::default();
        w.bytes(&body);
        w.bytes(&signature);
        self.signed_roster = Some(w.into_vec());
        Ok(())
    }

    fn read_roster(&mut self, signed: &[u8], mut naming: Vec<NamingSecret>) -> Result<(), FleetError> {
        let mut r = Reader::new(signed);
        let mut read = || {
            let body = r.bytes("roster", ROSTER_BYTES_MAX)?;
            Ok((body, r.bytes("signature", SIGNATURE_BYTES_MAX)?))
        };
        let (body, signature) = read().map_err(FleetError::Roster)?;
        r.finish().map_err(FleetError::Roster)?;
        if !self.anchors.signed_by_first(&signature_input(ROSTER_CONTEXT, body), signature) {
            return Err(FleetError::RosterSignature);
        }
        let roster = Roster::decode(body, &self.secret).map_err(FleetError::Roster)?;
        if roster.generations.iter().any(|g| g.number < NamingSecret::STORED_FROM) {
            naming.push(NamingSecret { generation: 1, secret: self.secret.clone() });
        }
        naming.sort_unstable_by_key(|n| n.generation);
        let found = naming.iter().map(|n| (n.generation, hash(n)));
        if !found.eq(roster.generations.iter().map(|g| (g.number, g.hash))) {
            return Err(FleetError::NamingSecret);
        }
        naming.reverse();
        (self.roster, self.naming, self.signed_roster) = (roster, naming, Some(signed.to_vec()));
        Ok(())
    }

    fn ca_fingerprint(&self) -> String {
        hex(digest::digest(&digest::SHA256, &self.key.subject_public_key_info()).as_ref())
    }

    fn assemble(
        name: FleetName,
        secret: FleetSecret,
        key: Key,
        certificate: CertificateDer<'static>,
    ) -> Result<Self, FleetError> {
        let anchors = TrustAnchors::new([certificate.clone()]).map_err(FleetError::Certificate)?;
        let validity = Validity::from_certificate(&certificate).ok_or(FleetError::KeyMismatch)?;
        let is_of_key = webpki::EndEntityCert::try_from(&certificate)
            .is_ok_and(|c| c.subject_public_key_info().as_ref() == key.subject_public_key_info());
        if !is_of_key {
            return Err(FleetError::KeyMismatch);
        }
        let naming = vec![NamingSecret { generation: 1, secret: secret.clone() }];
        let (roster, signed_roster) = (Roster::default(), None);
        Ok(Self { name, secret, naming, key, certificate, anchors, validity, roster, signed_roster })
    }
}

/// Changes of a copy of a fleet's file by a merge.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MergeReport {
    /// Nodes with further revocations: their names, or the beginnings of their pseudonyms.
    pub revoked: Vec<String>,
    /// Nodes that are new to the copy.
    pub enrolled: Vec<NodeName>,
    /// Nodes that have other groups, another role or incarnation, or more certificates now.
    pub changed: Vec<NodeName>,
    /// Generations of the secret that are new to the copy.
    pub generations: Vec<u32>,
    /// Generations that both copies made, each with its own secret, where the other copy's secret replaces this one's:
    /// nodes with the replaced secret have to be renewed.
    pub replaced: Vec<u32>,
    /// Whether nodes get other settings now when they are enrolled or renewed.
    pub settings: bool,
}

impl MergeReport {
    fn between(before: &Roster, after: &Roster, secret: &FleetSecret) -> Self {
        let named: BTreeMap<_, _> = after.nodes.keys().map(|n| (secret.pseudonym(n.as_str()), n)).collect();
        let name = |node: &Pseudonym| named.get(node).map_or_else(|| node.short(), |n| n.to_string());
        let nodes = |is_meant: &dyn Fn(Option<&RosterNode>, &RosterNode) -> bool| {
            let meant = after.nodes.values().filter(|n| is_meant(before.nodes.get(&n.name), n));
            meant.map(|n| n.name.clone()).collect()
        };
        let generations = |is_meant: &dyn Fn(Option<&Generation>, &Generation) -> bool| {
            let known = |g: &Generation| before.generations.iter().find(|b| b.number == g.number);
            let meant = after.generations.iter().filter(|g| is_meant(known(g), g));
            meant.map(|g| g.number).collect()
        };
        let revoked = after.revoked.iter().filter(|(node, r)| before.revoked.get(node) != Some(r));
        Self {
            revoked: revoked.map(|(node, _)| name(node)).collect(),
            enrolled: nodes(&|before, _| before.is_none()),
            changed: nodes(&|before, after| before.is_some_and(|b| !b.is_as(after))),
            generations: generations(&|before, _| before.is_none()),
            replaced: generations(&|before, after| before.is_some_and(|b| b.hash != after.hash)),
            settings: before.settings != after.settings,
        }
    }
}

/// News of revocation lists for a copy of a fleet's file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CrlReport {
    /// Nodes with further revocations: their names, or the beginnings of their pseudonyms.
    pub revoked: Vec<String>,
    /// Whether another copy made a list later than this one: its other changes are unknown here.
    pub is_behind: bool,
}

impl fmt::Debug for Fleet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Fleet").field("name", &self.name).field("ca", &self.anchors).finish_non_exhaustive()
    }
}

fn recorded(naming: &NamingSecret, now: UnixMillis) -> Generation {
    Generation { number: naming.generation, created: now, hash: hash(naming) }
}

fn hash(naming: &NamingSecret) -> [u8; 32] {
    let mut out = [0; 32];
    out.copy_from_slice(digest::digest(&digest::SHA256, naming.secret.expose()).as_ref());
    out
}

fn read_about(about: &[u8]) -> Result<(u8, FleetName), FleetError> {
    let mut r = Reader::new(about);
    let decode = |r: &mut Reader<'_>| {
        let version = r.u8()?;
        if !(FILE_VERSION_1..=FILE_VERSION).contains(&version) {
            let (what, known) = ("fleet file", FILE_VERSION.into());
            return Err(DecodeError::Version { what, found: version.into(), known });
        }
        Ok((version, r.str("fleet name", LABEL_BYTES_MAX)?))
    };
    let (version, name) = decode(&mut r).map_err(FleetError::About)?;
    r.finish().map_err(FleetError::About)?;
    Ok((version, name.parse().map_err(FleetError::Name)?))
}
