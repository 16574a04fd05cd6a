//! Enrolment and renewal of nodes, with keys of the fleet's making or of theirs.
//!
//! This module enters nodes in the roster. Removal from it, and all else about a fleet, is in `fleet.rs`.

use std::collections::BTreeSet;
use std::time::Duration;

use bytes::Bytes;
use rand_core::CryptoRng;
use rcgen::PublicKeyData;
use rustls_pki_types::CertificateDer;
use sgc_wire::{Credentials, Pseudonym, UnixMillis};

use crate::fleet::{Fleet, LEAF_VALIDITY_DEFAULT};
use crate::fleet_error::FleetError;
use crate::identity::Identity;
use crate::invitation::Invitation;
use crate::invitation_bounds::INVITATION_TIME_MAX;
use crate::issue::{Leaf, RequestedKey};
use crate::key::Key;
use crate::label::{GROUPS_MAX, GroupName, NodeName, OBSERVERS_GROUP};
use crate::member::Membership;
use crate::peer::VerifiedPeer;
use crate::roster::{IssuedCertificate, ROSTER_NODES_MAX, RosterNode};
use crate::x509::{Validity, serial_of};

impl Fleet {
    /// Makes an identity with a new key, and enters its node in the roster.
    pub fn enroll(
        &mut self,
        request: &EnrollRequest,
        rng: &mut impl CryptoRng,
    ) -> Result<Identity, FleetError> {
        let key = Key::generate(rng);
        let member = self.enroll_key(&key, request, rng)?;
        Identity::join(member, key.pkcs8(), rng).map_err(FleetError::making)
    }

    /// Makes an identity for a node that made its key itself: `csr` (PKCS #10, DER) proves its possession. Only the key
    /// is taken from it.
    pub fn enroll_csr(
        &mut self,
        csr: &[u8],
        request: &EnrollRequest,
        rng: &mut impl CryptoRng,
    ) -> Result<Membership, FleetError> {
        self.enroll_key(&RequestedKey::from_request(csr)?, request, rng)
    }

    /// Makes an identity outside of the roster, so that it cannot be revoked or renewed: for fleets that last as long
    /// as a demonstration or a test.
    pub fn issue(&self, request: &EnrollRequest, rng: &mut impl CryptoRng) -> Result<Identity, FleetError> {
        let key = Key::generate(rng);
        let incarnation = self.node(&request.node).map_or(0, |n| n.incarnation);
        let member = self.member(&key, request, incarnation, rng)?;
        Identity::join(member, key.pkcs8(), rng).map_err(FleetError::making)
    }

    /// Makes an identity with a new key for a node of the roster, in its groups and with its role.
    pub fn renew(
        &mut self,
        node: &NodeName,
        valid: Duration,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Identity, FleetError> {
        let request = self.standing_request(node, valid, now)?;
        self.enroll(&request, rng)
    }

    /// Renews a node that keeps the key with which it signed `csr`.
    pub fn renew_member(
        &mut self,
        csr: &[u8],
        node: &NodeName,
        valid: Duration,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Membership, FleetError> {
        let request = self.standing_request(node, valid, now)?;
        self.enroll_csr(csr, &request, rng)
    }

    /// Makes certificates, for the key that signed `csr`, and returns them with the secrets in use. They are for the
    /// node of the roster with this `pseudonym`. The caller checks that the request comes from that node.
    pub fn renew_csr(
        &mut self,
        csr: &[u8],
        pseudonym: &Pseudonym,
        valid: Duration,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Credentials, FleetError> {
        let known = self.node_by_pseudonym(pseudonym).map(|n| n.name.clone());
        let node = known.ok_or_else(|| FleetError::UnknownNode { node: pseudonym.short() })?;
        let member = self.renew_member(csr, &node, valid, now, rng)?;
        let chain = member.chain.iter().map(|c| Bytes::copy_from_slice(c)).collect();
        self.credentials_for(&node, chain)
    }

    /// Enters a node in the roster and invites it: the first holder of the invitation who asks the authority within this
    /// time ([`Fleet::redeem`]) gets the node's identity. Earlier unused invitations of the node end. `routers` are URLs
    /// at which the authority can be reached.
    pub fn invite(
        &mut self,
        request: &EnrollRequest,
        within: Duration,
        routers: Vec<String>,
        rng: &mut impl CryptoRng,
    ) -> Result<Invitation, FleetError> {
        let authority = self.authority().cloned().ok_or(FleetError::NoAuthority)?;
        if within > INVITATION_TIME_MAX || within < Duration::from_secs(1) {
            return Err(FleetError::InvitationTime);
        }
        if !Invitation::fits(&routers) {
            return Err(FleetError::InvitationRouters);
        }
        let incarnation = self.admit(request)?;
        // Certificates end with the CA; the certificate of an invitation holds this number of seconds.
        let left = Duration::from_millis(self.validity.not_after.0.saturating_sub(request.now.0));
        let valid = request.valid.min(left).min(Duration::from_secs(u32::MAX.into()));
        if valid < Duration::from_secs(1) {
            return Err(FleetError::InvitationTime);
        }
        let (key, scalar) = Key::generate_with_scalar(rng);
        let mut pseudonym = Pseudonym([0; 32]);
        rng.fill_bytes(&mut pseudonym.0);
        let leaf = Leaf {
            // That of no node: a used or stolen invitation must not pass for the node.
            pseudonym,
            groups: Vec::new(),
            may_route: false,
            incarnation: 0,
            invitation: Some(valid),
            valid: within,
            now: request.now,
        };
        let certificate = leaf.sign(&key, &self.certificate, &self.key, self.validity, rng)?;
        if let Some(known) = self.roster.nodes.get_mut(&request.node) {
            let open = known.certificates.iter_mut().filter(|c| c.is_invitation() && c.revoked.is_none());
            open.for_each(|c| c.revoked = Some(request.now));
        }
        self.record(request, incarnation, &certificate, false)?;
        Ok(Invitation {
            node: request.node.clone(),
            fleet: self.name.clone(),
            authority_id: self.node_id_of(&authority),
            authority,
            routers,
            ca: self.certificate.clone(),
            certificate,
            scalar,
            post_quantum: self.roster.settings.post_quantum,
        })
    }

    /// Ends all unused invitations: the file comes from a copy, which does not know whether they were used. Returns the
    /// invited nodes.
    pub fn end_invitations(&mut self, now: UnixMillis) -> Result<Vec<NodeName>, FleetError> {
        let mut ended = Vec::new();
        for node in self.roster.nodes.values_mut() {
            let open = node.certificates.iter_mut();
            let open = open.filter(|c| c.is_invitation() && c.revoked.is_none() && c.not_after >= now);
            let count = open.map(|c| c.revoked = Some(now)).count();
            ended.extend((count > 0).then(|| node.name.clone()));
        }
        if !ended.is_empty() {
            self.sign_roster()?;
        }
        Ok(ended)
    }

    /// Makes the identity of an invited node, for the key that signed `csr`, once. `peer` is the holder of the
    /// invitation, as its certificate proves.
    pub fn redeem(
        &mut self,
        csr: &[u8],
        peer: &VerifiedPeer,
        now: UnixMillis,
        rng: &mut impl CryptoRng,
    ) -> Result<Membership, FleetError> {
        let valid = peer.invitation.ok_or(FleetError::NotInvited)?;
        let is_it = |c: &IssuedCertificate| c.serial == peer.cert.serial;
        let node = self.nodes().find(|n| n.certificates.iter().any(is_it)).ok_or(FleetError::NotInvited)?;
        let node = self.active_node(&node.name)?.name.clone();
        let known = self.roster.nodes.get(&node).into_iter().flat_map(|n| &n.certificates).find(|c| is_it(c));
        let known = known.ok_or(FleetError::NotInvited)?;
        if let Some(at) = known.revoked {
            return Err(FleetError::InvitationUsed { node, at });
        }
        if let Some(at) = known.revoked_at(self.revocation_of(&node)) {
            return Err(FleetError::InvitationRevoked { node, at });
        }
        let member = self.renew_member(csr, &node, valid, now, rng)?;
        let entry = self.roster.nodes.get_mut(&node).into_iter().flat_map(|n| &mut n.certificates);
        entry.filter(|c| is_it(c)).for_each(|c| c.revoked = Some(now));
        self.sign_roster()?;
        Ok(member)
    }

    /// Enters a certificate in the roster that was made before there was one, so that it can be revoked.
    pub fn adopt(
        &mut self,
        node: NodeName,
        chain: &[CertificateDer<'_>],
        now: UnixMillis,
    ) -> Result<(), FleetError> {
        let leaf = chain.first().ok_or(FleetError::Adopt("there is no certificate"))?;
        let begin =
            Validity::from_certificate(leaf).ok_or(FleetError::Adopt("it cannot be read"))?.not_before;
        let peer = self
            .anchors
            .verify(chain, begin)
            .map_err(|_| FleetError::Adopt("the CA of this fleet did not make it"))?;
        if peer.pseudonym != self.secret.pseudonym(node.as_str()) {
            return Err(FleetError::Adopt("it is that of a node of another name"));
        }
        self.enter(node, &peer, now).map(drop)
    }

    /// Enters a certificate, and the incarnation, of a node of the roster that another copy of this fleet's file made.
    /// `Ok(false)`: the roster has it, or the certificate is of another fleet.
    pub fn recognize(&mut self, peer: &VerifiedPeer, now: UnixMillis) -> Result<bool, FleetError> {
        let is_ours = self.anchors.fingerprints().next() == Some(peer.cert.ca);
        match self.node_by_pseudonym(&peer.pseudonym).map(|n| n.name.clone()) {
            Some(node) if is_ours && now <= peer.not_after => self.enter(node, peer, now),
            _ => Ok(false),
        }
    }

    /// Enters a verified certificate. Returns `true` if it was new.
    fn enter(&mut self, node: NodeName, peer: &VerifiedPeer, now: UnixMillis) -> Result<bool, FleetError> {
        self.begin_roster_if_none(now)?;
        let known = self.roster.nodes.get(&node).map_or(&[][..], |n| &n.certificates);
        if known.iter().any(|c| c.serial == peer.cert.serial) {
            return Ok(false);
        }
        let entry = self.roster.nodes.entry(node.clone()).or_insert_with(|| RosterNode {
            name: node,
            incarnation: 0,
            changed: UnixMillis(0),
            groups: Vec::new(),
            router: false,
            may_route: peer.may_route,
            generation: 0,
            seen: None,
            certificates: Vec::new(),
        });
        // The CA made the certificate, so the incarnation exists, if only in another copy of the file.
        entry.incarnation = entry.incarnation.max(peer.incarnation);
        entry.add_certificates([IssuedCertificate {
            serial: peer.cert.serial.clone(),
            not_after: peer.not_after,
            incarnation: peer.incarnation,
            revoked: None,
        }]);
        self.sign_roster()?;
        Ok(true)
    }

    fn enroll_key(
        &mut self,
        key: &impl PublicKeyData,
        request: &EnrollRequest,
        rng: &mut impl CryptoRng,
    ) -> Result<Membership, FleetError> {
        let incarnation = self.admit(request)?;
        let member = self.member(key, request, incarnation, rng)?;
        let leaf = member.chain.first().ok_or(FleetError::CaName)?;
        self.record(request, incarnation, leaf, true)?;
        Ok(member)
    }

    /// Returns the incarnation in which a node may be enrolled.
    fn admit(&mut self, request: &EnrollRequest) -> Result<u32, FleetError> {
        self.begin_roster_if_none(request.now)?;
        self.check_ca_holds(request.now)?;
        if request.groups.len() > GROUPS_MAX {
            return Err(FleetError::TooManyGroups { groups: request.groups.len() });
        }
        self.roster.prune(request.now);
        let known = self.roster.nodes.get(&request.node);
        if known.is_none() && self.roster.nodes.len() >= ROSTER_NODES_MAX {
            return Err(FleetError::TooManyNodes);
        }
        let known_incarnation = known.map_or(0, |n| n.incarnation);
        match self.revocation_of(&request.node) {
            Some(revoked) if revoked.covers(known_incarnation) => {
                let next = revoked.incarnation.checked_add(1).filter(|_| request.again);
                next.ok_or(FleetError::NodeRevoked { node: request.node.clone(), at: revoked.at })
            }
            _ => Ok(known_incarnation),
        }
    }

    /// Enters a node with a new certificate in the roster. `is_handed`: the node gets the secrets in use now.
    fn record(
        &mut self,
        request: &EnrollRequest,
        incarnation: u32,
        leaf: &CertificateDer<'_>,
        is_handed: bool,
    ) -> Result<(), FleetError> {
        let made = Validity::from_certificate(leaf).zip(serial_of(leaf)).ok_or(FleetError::CaName)?;
        let (Validity { not_after, .. }, serial) = made;
        let mut node = RosterNode {
            name: request.node.clone(),
            incarnation,
            changed: request.now,
            groups: request.groups.iter().cloned().collect::<BTreeSet<_>>().into_iter().collect(),
            router: request.router,
            may_route: request.router || request.may_route,
            generation: if request.router || !is_handed { 0 } else { self.newest_generation() },
            seen: is_handed.then_some(request.now),
            certificates: Vec::new(),
        };
        if let Some(known) = self.roster.nodes.get(&request.node) {
            let is_same =
                (&known.groups, known.router, known.may_route) == (&node.groups, node.router, node.may_route);
            let later = UnixMillis(known.changed.0.saturating_add(1));
            node.changed = if is_same { known.changed } else { node.changed.max(later) };
            node.certificates = known.certificates.clone();
            if !is_handed {
                (node.generation, node.seen) = (known.generation, known.seen);
            }
        }
        node.add_certificates([IssuedCertificate {
            serial: serial.into(),
            not_after,
            incarnation,
            revoked: None,
        }]);
        self.roster.nodes.insert(request.node.clone(), node);
        self.sign_roster()
    }

    /// Returns everything but the key, for this key.
    fn member(
        &self,
        key: &impl PublicKeyData,
        request: &EnrollRequest,
        incarnation: u32,
        rng: &mut impl CryptoRng,
    ) -> Result<Membership, FleetError> {
        self.check_ca_holds(request.now)?;
        if request.groups.len() > GROUPS_MAX {
            return Err(FleetError::TooManyGroups { groups: request.groups.len() });
        }
        let groups: BTreeSet<_> = request.groups.iter().collect();
        let leaf = Leaf {
            pseudonym: self.secret.pseudonym(request.node.as_str()),
            groups: groups.into_iter().map(|g| self.secret.group_tag(g.as_str())).collect(),
            may_route: request.router || request.may_route,
            incarnation,
            invitation: None,
            valid: request.valid,
            now: request.now,
        };
        let certificate = leaf.sign(key, &self.certificate, &self.key, self.validity, rng)?;
        let is_member = !request.router;
        Ok(Membership {
            node: request.node.clone(),
            fleet: self.name.clone(),
            chain: vec![certificate],
            anchors: self.anchors.clone(),
            secret: is_member.then(|| self.secret.clone()),
            naming: if is_member { self.naming.clone() } else { Vec::new() },
            authority: self.roster.settings.authority.as_ref().map(|a| self.node_id_of(a)),
            post_quantum: self.roster.settings.post_quantum,
            observers: (!is_member).then(|| self.secret.group_tag(OBSERVERS_GROUP)),
        })
    }

    fn standing_request(
        &self,
        node: &NodeName,
        valid: Duration,
        now: UnixMillis,
    ) -> Result<EnrollRequest, FleetError> {
        let node = self.active_node(node)?;
        let (groups, router, may_route) = (node.groups.clone(), node.router, node.may_route);
        Ok(EnrollRequest { groups, router, may_route, valid, ..EnrollRequest::new(node.name.clone(), now) })
    }
}

/// Input of [`Fleet::enroll`].
#[derive(Clone, Debug)]
pub struct EnrollRequest {
    /// The node.
    pub node: NodeName,
    /// Its groups, at most [`GROUPS_MAX`].
    pub groups: Vec<GroupName>,
    /// Whether the node only routes: its identity lacks the fleet secret, so that it can derive no name and open no
    /// payload. Its certificate lets it carry others' names.
    pub router: bool,
    /// Whether a member's certificate lets it carry others' names as well.
    pub may_route: bool,
    /// Whether a revoked node may be enrolled again, in its next incarnation.
    pub again: bool,
    /// Validity of the certificate; never longer than the CA's.
    pub valid: Duration,
    /// The time.
    pub now: UnixMillis,
}

impl EnrollRequest {
    /// Returns a request for a node in no group, for [`LEAF_VALIDITY_DEFAULT`].
    pub fn new(node: NodeName, now: UnixMillis) -> Self {
        let (groups, valid) = (Vec::new(), LEAF_VALIDITY_DEFAULT);
        Self { node, groups, router: false, may_route: false, again: false, valid, now }
    }
}
