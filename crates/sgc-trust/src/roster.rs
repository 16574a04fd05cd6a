//! A fleet's record of itself: its nodes, their certificates, revoked nodes, and secrets in use.
//!
//! A roster holds no secret (they have blocks of their own, named here by their hashes) and no file. The CA's key signs
//! its encoding, so that a roster that was changed by hand, or damaged, does not pass for the fleet's. Everyone with
//! the fleet file can sign another; an old copy of the file is a valid one. Two diverged copies merge: the order of
//! merges does not matter, and no revocation, enrolment or incarnation is lost by one.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use sgc_wire::{DecodeError, Encode as _, Pseudonym, Reader, SECRET_GENERATIONS_MAX, UnixMillis, Writer};

use crate::invitation_bounds::INVITATION_SERIAL;
use crate::label::{GROUPS_MAX, GroupName, LABEL_BYTES_MAX, NodeName};
use crate::revocations::{REVOKED_NODES_MAX, Revocation, RevokedNodes, add_revocation};
use crate::secret::FleetSecret;
use crate::x509::Serial;

/// Longest roster that is kept, bytes.
pub const ROSTER_BYTES_MAX: usize = 8 * 1024 * 1024;
/// Most nodes of one fleet.
pub const ROSTER_NODES_MAX: usize = 10_000;
/// Most certificates of one node that are remembered: those that hold longest.
pub const NODE_CERTIFICATES_MAX: usize = 256;
/// Longest serial number, bytes (RFC 5280, 4.1.2.2).
const SERIAL_BYTES_MAX: usize = 20;
/// Time that a certificate is remembered after its end: clocks of verifiers may be behind.
const REMEMBERED: Duration = Duration::from_secs(86_400);
const VERSION: u8 = 2;
/// The version before there were incarnations: a node was revoked or not.
const VERSION_1: u8 = 1;

/// One node of a fleet. [`crate::Fleet::revocation_of`] returns the incarnation up to which it is revoked.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct RosterNode {
    /// Its name.
    pub name: NodeName,
    /// Number of times that it was enrolled again after a revocation.
    pub incarnation: u32,
    /// Time at which its groups and role were last set.
    pub changed: UnixMillis,
    /// Its groups, sorted.
    pub groups: Vec<GroupName>,
    /// Whether the node only routes: it has no secret.
    pub router: bool,
    /// Whether its certificates let it carry others' names.
    pub may_route: bool,
    /// The newest generation of the naming secret that the node was handed; 0 if that is unknown, or if it has none.
    pub generation: u32,
    /// Time at which the fleet last handed the node a certificate or secrets.
    pub seen: Option<UnixMillis>,
    /// Its certificates, those with the longest validity last; expired ones are forgotten after a day.
    pub certificates: Vec<IssuedCertificate>,
}

impl RosterNode {
    /// Returns the last moment at which an unrevoked certificate of the node is valid. Invitations do not count.
    pub fn expires(&self, revocation: Option<Revocation>) -> Option<UnixMillis> {
        let good =
            self.certificates.iter().filter(|c| !c.is_invitation() && c.revoked_at(revocation).is_none());
        good.map(|c| c.not_after).max()
    }

    /// Returns `true` if the entry of another copy is the same, apart from the time of the last handover.
    pub(crate) fn is_as(&self, other: &Self) -> bool {
        let Self { generation, seen, .. } = *self;
        *self == Self { generation, seen, ..other.clone() }
    }

    /// Enters certificates; an entry that exists already keeps the earlier revocation.
    pub(crate) fn add_certificates(&mut self, certificates: impl IntoIterator<Item = IssuedCertificate>) {
        let mut all: BTreeMap<Serial, IssuedCertificate> = BTreeMap::new();
        for certificate in std::mem::take(&mut self.certificates).into_iter().chain(certificates) {
            match all.get_mut(&certificate.serial) {
                Some(known) => known.join(&certificate),
                None => drop(all.insert(certificate.serial.clone(), certificate)),
            }
        }
        self.certificates = all.into_values().collect();
        self.certificates.sort_by(|a, b| (a.not_after, &a.serial).cmp(&(b.not_after, &b.serial)));
        let over = self.certificates.len().saturating_sub(NODE_CERTIFICATES_MAX);
        self.certificates.drain(..over);
    }

    /// Merges the entry of the same node in another copy.
    fn join(&mut self, other: &Self) {
        let newest =
            |node: &Self| (node.incarnation, node.changed, node.groups.clone(), node.router, node.may_route);
        let (generation, seen) = (self.generation.max(other.generation), self.seen.max(other.seen));
        if newest(self) < newest(other) {
            let certificates = std::mem::take(&mut self.certificates);
            *self = Self { certificates, ..other.clone() };
        }
        (self.generation, self.seen) = (generation, seen);
        self.add_certificates(other.certificates.iter().cloned());
    }
}

/// A certificate that a fleet made.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct IssuedCertificate {
    /// Its serial number, big-endian, without leading zeros.
    pub serial: Serial,
    /// Last moment at which it is valid.
    pub not_after: UnixMillis,
    /// The incarnation of its node.
    pub incarnation: u32,
    /// Time of its revocation by serial number alone: of an invitation that was used or replaced, or from before there
    /// were incarnations.
    pub(crate) revoked: Option<UnixMillis>,
}

impl IssuedCertificate {
    /// Returns `true` if it is the certificate of an invitation, which entitles to one of the node.
    pub fn is_invitation(&self) -> bool {
        is_invitation(&self.serial)
    }

    /// Returns the time of its revocation, given that of its node.
    pub fn revoked_at(&self, revocation: Option<Revocation>) -> Option<UnixMillis> {
        self.revoked.or_else(|| revocation.filter(|r| r.covers(self.incarnation)).map(|r| r.at))
    }

    fn join(&mut self, other: &Self) {
        self.revoked = self.revoked.into_iter().chain(other.revoked).min();
        self.not_after = self.not_after.max(other.not_after);
        self.incarnation = self.incarnation.max(other.incarnation);
    }
}

/// Returns `true` for the serial number of an invitation.
pub fn is_invitation(serial: &[u8]) -> bool {
    serial.len() == SERIAL_BYTES_MAX && serial.starts_with(&INVITATION_SERIAL)
}

/// A generation of the naming secret, without the secret.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Generation {
    /// Its number; 1 is the fleet secret itself.
    pub number: u32,
    /// Time of its making.
    pub created: UnixMillis,
    /// SHA-256 of the secret.
    pub(crate) hash: [u8; 32],
}

/// Settings that nodes get when they are enrolled or renewed.
#[derive(Clone, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct Settings {
    /// Time of their last change.
    pub(crate) changed: UnixMillis,
    pub(crate) authority: Option<NodeName>,
    pub(crate) post_quantum: bool,
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Roster {
    /// Number of the last revocation list; 0 if there was none.
    pub(crate) crl_number: u64,
    pub(crate) settings: Settings,
    /// Generations of the naming secret before this one are out of use.
    pub(crate) oldest_generation: u32,
    /// Generations in use, oldest first; never empty in a fleet.
    pub(crate) generations: Vec<Generation>,
    /// Nodes that are or were revoked, also those whose names only another copy of the roster knows.
    pub(crate) revoked: RevokedNodes,
    pub(crate) nodes: BTreeMap<NodeName, RosterNode>,
}

impl Roster {
    /// Forgets expired certificates.
    pub(crate) fn prune(&mut self, now: UnixMillis) {
        let remembered = REMEMBERED.as_millis() as u64;
        for node in self.nodes.values_mut() {
            node.certificates.retain(|c| c.not_after.0.saturating_add(remembered) >= now.0);
        }
    }

    /// Returns every revoked certificate that has not expired, those with the longest validity last.
    pub(crate) fn revoked_serials(&self, secret: &FleetSecret) -> Vec<(Serial, UnixMillis)> {
        let of_node = |node: &RosterNode| {
            let revocation = self.revocation_of(&node.name, secret);
            let certificates = node.certificates.clone().into_iter();
            certificates.filter_map(move |c| Some((c.not_after, c.revoked_at(revocation)?, c.serial)))
        };
        let mut revoked: Vec<_> = self.nodes.values().flat_map(of_node).collect();
        revoked.sort();
        revoked.into_iter().map(|(_, at, serial)| (serial, at)).collect()
    }

    /// Returns the incarnation up to which the node of that name is revoked.
    pub(crate) fn revocation_of(&self, node: &NodeName, secret: &FleetSecret) -> Option<Revocation> {
        self.revoked.get(&secret.pseudonym(node.as_str())).copied()
    }

    /// Merges another copy.
    pub(crate) fn join(&mut self, other: &Self) {
        self.crl_number = self.crl_number.max(other.crl_number);
        if self.settings < other.settings {
            self.settings = other.settings.clone();
        }
        for (node, revocation) in &other.revoked {
            add_revocation(&mut self.revoked, *node, *revocation);
        }
        for (name, theirs) in &other.nodes {
            match self.nodes.get_mut(name) {
                Some(node) => node.join(theirs),
                None => drop(self.nodes.insert(name.clone(), theirs.clone())),
            }
        }
        let mut generations: BTreeMap<u32, Generation> = BTreeMap::new();
        for generation in self.generations.iter().chain(&other.generations) {
            // Of two secrets under one number the later one stays.
            match generations.get_mut(&generation.number) {
                Some(known) => *known = known.clone().max(generation.clone()),
                None => drop(generations.insert(generation.number, generation.clone())),
            }
        }
        self.oldest_generation = self.oldest_generation.max(other.oldest_generation);
        generations.retain(|number, _| *number >= self.oldest_generation);
        while generations.len() > SECRET_GENERATIONS_MAX {
            generations.pop_first();
            self.oldest_generation = generations.keys().next().copied().unwrap_or(self.oldest_generation);
        }
        self.generations = generations.into_values().collect();
    }

    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut w = Writer::default();
        w.u8(VERSION);
        w.u64(self.crl_number);
        self.settings.changed.encode(&mut w);
        w.option(self.settings.authority.as_ref(), |w, a| w.str(a.as_str()));
        w.bool(self.settings.post_quantum);
        w.u32(self.oldest_generation);
        w.list(&self.generations, |w, g| {
            w.u32(g.number);
            g.created.encode(w);
            w.raw(&g.hash);
        });
        let revoked: Vec<_> = self.revoked.iter().collect();
        w.list(&revoked, |w, (node, revocation)| {
            w.raw(node.as_bytes());
            w.u32(revocation.incarnation);
            revocation.at.encode(w);
        });
        let nodes: Vec<_> = self.nodes.values().collect();
        w.list(&nodes, |w, node| {
            w.str(node.name.as_str());
            w.u32(node.incarnation);
            node.changed.encode(w);
            w.list(&node.groups, |w, g| w.str(g.as_str()));
            w.bool(node.router);
            w.bool(node.may_route);
            w.u32(node.generation);
            w.option(node.seen.as_ref(), |w, at| at.encode(w));
            w.list(&node.certificates, |w, c| {
                w.bytes(&c.serial);
                c.not_after.encode(w);
                w.u32(c.incarnation);
                w.option(c.revoked.as_ref(), |w, at| at.encode(w));
            });
        });
        w.into_vec()
    }

    /// Reads a roster; one of version 1 revokes nodes by name, whose pseudonyms are those under `secret`.
    pub(crate) fn decode(bytes: &[u8], secret: &FleetSecret) -> Result<Self, DecodeError> {
        let mut r = Reader::new(bytes);
        let version = r.u8()?;
        if !(VERSION_1..=VERSION).contains(&version) {
            return Err(DecodeError::Version {
                what: "roster",
                found: version.into(),
                known: VERSION.into(),
            });
        }
        let is_old = version == VERSION_1;
        let crl_number = r.u64()?;
        let settings = Settings {
            changed: if is_old { UnixMillis(0) } else { time(&mut r)? },
            authority: r.option("authority", |r| label(r, "authority"))?,
            post_quantum: r.bool("post-quantum")?,
        };
        let oldest_generation = if is_old { 0 } else { r.u32()? };
        let generations = r.list("generations", SECRET_GENERATIONS_MAX, |r| {
            Ok(Generation { number: r.u32()?, created: time(r)?, hash: r.array("hash")? })
        })?;
        let rising = generations.windows(2).all(|pair| pair[0].number < pair[1].number);
        if !rising || generations.is_empty() {
            return Err(DecodeError::value("generations", generations.len() as u64));
        }
        let mut revoked = RevokedNodes::new();
        if !is_old {
            for (node, revocation) in r.list("revoked nodes", REVOKED_NODES_MAX, read_revocation)? {
                if revoked.last_key_value().is_some_and(|(last, _)| *last >= node) {
                    return Err(DecodeError::value("order of revoked nodes", revoked.len() as u64));
                }
                revoked.insert(node, revocation);
            }
        }
        let read = if is_old { read_node_1 } else { read_node };
        let list = r.list("nodes", ROSTER_NODES_MAX, read)?;
        r.finish()?;
        let mut nodes = BTreeMap::new();
        for (node, revoked_at) in list {
            if nodes.last_key_value().is_some_and(|(last, _)| *last >= node.name) {
                return Err(DecodeError::value("order of nodes", nodes.len() as u64));
            }
            if let Some(at) = revoked_at {
                revoked.insert(secret.pseudonym(node.name.as_str()), Revocation::new(0, at));
            }
            nodes.insert(node.name.clone(), node);
        }
        if revoked.len() > REVOKED_NODES_MAX {
            return Err(DecodeError::value("revoked nodes", revoked.len() as u64));
        }
        Ok(Self { crl_number, settings, oldest_generation, generations, revoked, nodes })
    }
}

fn read_revocation(r: &mut Reader<'_>) -> Result<(Pseudonym, Revocation), DecodeError> {
    let node = Pseudonym(r.array("revoked node")?);
    let revocation = Revocation { incarnation: r.u32()?, at: time(r)? };
    if !revocation.at.0.is_multiple_of(1000) {
        return Err(DecodeError::value("revoked", revocation.at.0));
    }
    Ok((node, revocation))
}

/// A node, and for a roster of version 1 the time of its revocation.
type ReadNode = (RosterNode, Option<UnixMillis>);

fn read_node(r: &mut Reader<'_>) -> Result<ReadNode, DecodeError> {
    let name = label(r, "node name")?;
    let (incarnation, changed) = (r.u32()?, time(r)?);
    let groups = read_groups(r)?;
    let (router, may_route) = (r.bool("router")?, r.bool("may route")?);
    let (generation, seen) = (r.u32()?, r.option("seen", time)?);
    let certificates = r.list("certificates", NODE_CERTIFICATES_MAX, |r| {
        Ok(IssuedCertificate {
            serial: r.bytes("serial", SERIAL_BYTES_MAX)?.into(),
            not_after: time(r)?,
            incarnation: r.u32()?,
            revoked: r.option("revoked", time)?,
        })
    })?;
    let node =
        RosterNode { name, incarnation, changed, groups, router, may_route, generation, seen, certificates };
    Ok((node, None))
}

fn read_node_1(r: &mut Reader<'_>) -> Result<ReadNode, DecodeError> {
    let name = label(r, "node name")?;
    let groups = read_groups(r)?;
    let (router, may_route) = (r.bool("router")?, r.bool("may route")?);
    let revoked_at = r.option("revoked", time)?;
    let certificates = r.list("certificates", NODE_CERTIFICATES_MAX, |r| {
        Ok(IssuedCertificate {
            serial: r.bytes("serial", SERIAL_BYTES_MAX)?.into(),
            not_after: time(r)?,
            incarnation: 0,
            revoked: r.option("revoked", time)?,
        })
    })?;
    let mut node = RosterNode {
        name,
        incarnation: 0,
        changed: UnixMillis(0),
        groups,
        router,
        may_route,
        generation: 0,
        seen: None,
        certificates: Vec::new(),
    };
    node.add_certificates(certificates);
    Ok((node, revoked_at))
}

fn read_groups(r: &mut Reader<'_>) -> Result<Vec<GroupName>, DecodeError> {
    let groups: Vec<GroupName> = r.list("groups", GROUPS_MAX, |r| label(r, "group"))?;
    let sorted: BTreeSet<_> = groups.iter().cloned().collect();
    if !groups.iter().eq(&sorted) {
        return Err(DecodeError::value("order of groups", groups.len() as u64));
    }
    Ok(groups)
}

fn time(r: &mut Reader<'_>) -> Result<UnixMillis, DecodeError> {
    r.u64().map(UnixMillis)
}

fn label<T: std::str::FromStr>(r: &mut Reader<'_>, field: &'static str) -> Result<T, DecodeError> {
    let text = r.str(field, LABEL_BYTES_MAX)?;
    text.parse().map_err(|_| DecodeError::value(field, text.len() as u64))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn secret() -> FleetSecret {
        FleetSecret::from_bytes([3; 32])
    }

    fn certificate(serial: &[u8], not_after: u64, incarnation: u32, at: Option<u64>) -> IssuedCertificate {
        let (not_after, revoked) = (UnixMillis(not_after), at.map(UnixMillis));
        IssuedCertificate { serial: serial.into(), not_after, incarnation, revoked }
    }

    fn roster() -> Roster {
        let node = |name: &str, groups: &[&str]| RosterNode {
            name: name.parse().unwrap(),
            incarnation: 1,
            changed: UnixMillis(3),
            groups: groups.iter().map(|g| g.parse().unwrap()).collect(),
            router: false,
            may_route: true,
            generation: 3,
            seen: Some(UnixMillis(2)),
            certificates: vec![certificate(&[1; 16], 5, 0, Some(4)), certificate(&[2], 500_000_000, 1, None)],
        };
        let nodes = [node("arm-1", &["a", "b"]), node("desk", &[])];
        let revocation = Revocation::new(1, UnixMillis(4000));
        Roster {
            crl_number: 9,
            settings: Settings {
                changed: UnixMillis(7),
                authority: Some("desk".parse().unwrap()),
                post_quantum: true,
            },
            oldest_generation: 1,
            generations: vec![
                Generation { number: 1, created: UnixMillis(1), hash: [1; 32] },
                Generation { number: 3, created: UnixMillis(2), hash: [2; 32] },
            ],
            revoked: [(secret().pseudonym("arm-1"), revocation), (Pseudonym([7; 32]), revocation)].into(),
            nodes: nodes.map(|n| (n.name.clone(), n)).into(),
        }
    }

    #[test]
    fn rosters_round_trip_and_no_shorter_one_is_read() {
        let decode = |bytes: &[u8]| Roster::decode(bytes, &secret());
        let bytes = roster().encode();
        assert_eq!(decode(&bytes), Ok(roster()));
        for length in 0..bytes.len() {
            assert!(decode(&bytes[..length]).is_err());
        }
        assert!(decode(&[&bytes[..], &[0]].concat()).is_err());
        let mut unsorted = roster();
        unsorted.generations.reverse();
        assert!(decode(&unsorted.encode()).is_err());
        let mut unsorted = roster();
        unsorted.nodes.values_mut().for_each(|n| n.groups.reverse());
        assert!(decode(&unsorted.encode()).is_err());
    }

    #[test]
    fn certificates_that_are_over_are_forgotten_a_day_later() {
        let mut roster = roster();
        let revoked = |roster: &Roster| roster.revoked_serials(&secret());
        let (old, new): (Serial, Serial) = ([1; 16][..].into(), [2][..].into());
        // One certificate by its serial number alone at each node, and one by the incarnation.
        let (at, of_node) = (UnixMillis(4), UnixMillis(4000));
        assert_eq!(revoked(&roster), [(old.clone(), at), (old.clone(), at), (new.clone(), of_node)]);
        roster.prune(UnixMillis(5 + 86_400_000));
        assert_eq!(revoked(&roster).len(), 3);
        roster.prune(UnixMillis(6 + 86_400_000));
        assert_eq!(revoked(&roster), [(new, of_node)]);
    }

    #[test]
    fn a_roster_from_before_incarnations_is_read() {
        let mut w = Writer::default();
        w.u8(VERSION_1);
        w.u64(9);
        w.option(Some(&"desk"), |w, a| w.str(a));
        w.bool(false);
        w.list(&[()], |w, ()| {
            w.u32(1);
            w.u64(5);
            w.raw(&[1; 32]);
        });
        w.list(&[("arm-1", Some(4999_u64)), ("desk", None)], |w, (name, at)| {
            w.str(name);
            w.list::<()>(&[], |_, ()| ());
            w.bool(false);
            w.bool(true);
            w.option(at.as_ref(), |w, at| w.u64(*at));
            w.list(&[([2], 8_u64), ([1], 7)], |w, (serial, not_after)| {
                w.bytes(serial);
                w.u64(*not_after);
                w.option(at.as_ref(), |w, at| w.u64(*at));
            });
        });
        let read = Roster::decode(&w.into_vec(), &secret()).unwrap();
        let revocation = Revocation { incarnation: 0, at: UnixMillis(4000) };
        assert_eq!(read.revoked, [(secret().pseudonym("arm-1"), revocation)].into());
        let nodes: Vec<_> = read.nodes.values().collect();
        assert_eq!(nodes.iter().map(|n| n.incarnation).collect::<Vec<_>>(), [0, 0]);
        let expected = [certificate(&[1], 7, 0, Some(4999)), certificate(&[2], 8, 0, Some(4999))];
        assert_eq!(nodes[0].certificates, expected);
        assert_eq!(Roster::decode(&read.encode(), &secret()), Ok(read));
    }
}
