//! What a fleet knows of itself: its nodes, their certificates, who is revoked, which secrets are in use.
//!
//! It holds no secret (those have blocks of their own, named here by their hashes) and no file. The CA's key signs
//! its encoding, so that a roster that was changed by hand, or damaged, is not taken for the fleet's word. Whoever
//! holds the fleet file can sign another; an old copy of the file is a valid one.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use sgc_wire::{DecodeError, Encode as _, Reader, SECRET_GENERATIONS_MAX, UnixMillis, Writer};

use crate::issue::Serial;
use crate::label::{GroupName, LABEL_BYTES_MAX, NodeName};
use crate::verify::GROUPS_MAX;

/// Most nodes of one fleet.
pub const ROSTER_NODES_MAX: usize = 10_000;
/// Most certificates of one node that hold at one time.
pub const NODE_CERTIFICATES_MAX: usize = 256;
/// Longest serial number, bytes (RFC 5280, 4.1.2.2).
const SERIAL_BYTES_MAX: usize = 20;
/// How long after its end a certificate is remembered: clocks of verifiers may be behind.
const REMEMBERED: Duration = Duration::from_secs(86_400);
const VERSION: u8 = 1;

/// One node of a fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosterNode {
    /// Its name.
    pub name: NodeName,
    /// Its groups, sorted.
    pub groups: Vec<GroupName>,
    /// True if it only routes: it has no secret.
    pub router: bool,
    /// True if its certificates let it carry others' names.
    pub may_route: bool,
    /// Since when it is revoked, if it is.
    pub revoked: Option<UnixMillis>,
    /// Its certificates, in the order of making; those that are over are forgotten after a day.
    pub certificates: Vec<IssuedCertificate>,
}

impl RosterNode {
    /// Last moment at which a certificate of it holds that is not revoked.
    pub fn expires(&self) -> Option<UnixMillis> {
        self.certificates.iter().filter(|c| c.revoked.is_none()).map(|c| c.not_after).max()
    }
}

/// A certificate that a fleet made.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IssuedCertificate {
    /// Its serial number, big-endian, without leading zeros.
    pub serial: Serial,
    /// Last moment at which it holds.
    pub not_after: UnixMillis,
    /// Since when it is revoked, if it is.
    pub revoked: Option<UnixMillis>,
}

/// A generation of the naming secret, without the secret.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Generation {
    /// Its number; 1 is the fleet secret itself.
    pub number: u32,
    /// When it was made.
    pub created: UnixMillis,
    /// SHA-256 of the secret.
    pub(crate) hash: [u8; 32],
}

#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Roster {
    /// Number of the last revocation list; 0 if there was none.
    pub(crate) crl_number: u64,
    pub(crate) authority: Option<NodeName>,
    pub(crate) post_quantum: bool,
    /// In use, oldest first; never empty in a fleet.
    pub(crate) generations: Vec<Generation>,
    pub(crate) nodes: BTreeMap<NodeName, RosterNode>,
}

impl Roster {
    /// Forgets certificates that are over.
    pub(crate) fn prune(&mut self, now: UnixMillis) {
        let remembered = REMEMBERED.as_millis() as u64;
        for node in self.nodes.values_mut() {
            node.certificates.retain(|c| c.not_after.0.saturating_add(remembered) >= now.0);
        }
    }

    /// Every revoked certificate that is not over.
    pub(crate) fn revoked(&self) -> Vec<(Serial, UnixMillis)> {
        let certificates = self.nodes.values().flat_map(|n| &n.certificates);
        certificates.filter_map(|c| Some((c.serial.clone(), c.revoked?))).collect()
    }

    pub(crate) fn encode(&self) -> Vec<u8> {
        let mut w = Writer::default();
        w.u8(VERSION);
        w.u64(self.crl_number);
        w.option(self.authority.as_ref(), |w, a| w.str(a.as_str()));
        w.bool(self.post_quantum);
        w.list(&self.generations, |w, g| {
            w.u32(g.number);
            g.created.encode(w);
            w.raw(&g.hash);
        });
        let nodes: Vec<_> = self.nodes.values().collect();
        w.list(&nodes, |w, node| {
            w.str(node.name.as_str());
            w.list(&node.groups, |w, g| w.str(g.as_str()));
            w.bool(node.router);
            w.bool(node.may_route);
            w.option(node.revoked.as_ref(), |w, at| at.encode(w));
            w.list(&node.certificates, |w, c| {
                w.bytes(&c.serial);
                c.not_after.encode(w);
                w.option(c.revoked.as_ref(), |w, at| at.encode(w));
            });
        });
        w.into_vec()
    }

    pub(crate) fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let mut r = Reader::new(bytes);
        let found = r.u8()?;
        if found != VERSION {
            return Err(DecodeError::Version { what: "roster", found: found.into(), known: VERSION.into() });
        }
        let crl_number = r.u64()?;
        let authority = r.option("authority", |r| label(r, "authority"))?;
        let post_quantum = r.bool("post-quantum")?;
        let generations = r.list("generations", SECRET_GENERATIONS_MAX, |r| {
            Ok(Generation { number: r.u32()?, created: time(r)?, hash: r.array("hash")? })
        })?;
        let rising = generations.windows(2).all(|pair| pair[0].number < pair[1].number);
        if !rising || generations.is_empty() {
            return Err(DecodeError::value("generations", generations.len() as u64));
        }
        let list = r.list("nodes", ROSTER_NODES_MAX, read_node)?;
        r.finish()?;
        let mut nodes = BTreeMap::new();
        for node in list {
            if nodes.last_key_value().is_some_and(|(last, _)| *last >= node.name) {
                return Err(DecodeError::value("order of nodes", nodes.len() as u64));
            }
            nodes.insert(node.name.clone(), node);
        }
        Ok(Self { crl_number, authority, post_quantum, generations, nodes })
    }
}

fn read_node(r: &mut Reader<'_>) -> Result<RosterNode, DecodeError> {
    let name = label(r, "node name")?;
    let groups: Vec<GroupName> = r.list("groups", GROUPS_MAX, |r| label(r, "group"))?;
    let sorted: BTreeSet<_> = groups.iter().cloned().collect();
    if !groups.iter().eq(&sorted) {
        return Err(DecodeError::value("order of groups", groups.len() as u64));
    }
    Ok(RosterNode {
        name,
        groups,
        router: r.bool("router")?,
        may_route: r.bool("may route")?,
        revoked: r.option("revoked", time)?,
        certificates: r.list("certificates", NODE_CERTIFICATES_MAX, |r| {
            Ok(IssuedCertificate {
                serial: r.bytes("serial", SERIAL_BYTES_MAX)?.into(),
                not_after: time(r)?,
                revoked: r.option("revoked", time)?,
            })
        })?,
    })
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

    fn roster() -> Roster {
        let certificate = |serial: &[u8], not_after, revoked| IssuedCertificate {
            serial: serial.into(),
            not_after: UnixMillis(not_after),
            revoked,
        };
        let node = |name: &str, groups: &[&str], revoked| RosterNode {
            name: name.parse().unwrap(),
            groups: groups.iter().map(|g| g.parse().unwrap()).collect(),
            router: false,
            may_route: true,
            revoked,
            certificates: vec![certificate(&[1; 16], 5, revoked), certificate(&[2], 500_000_000, revoked)],
        };
        let nodes = [node("arm-1", &["a", "b"], Some(UnixMillis(4))), node("desk", &[], None)];
        Roster {
            crl_number: 9,
            authority: Some("desk".parse().unwrap()),
            post_quantum: true,
            generations: vec![
                Generation { number: 1, created: UnixMillis(1), hash: [1; 32] },
                Generation { number: 3, created: UnixMillis(2), hash: [2; 32] },
            ],
            nodes: nodes.map(|n| (n.name.clone(), n)).into(),
        }
    }

    #[test]
    fn rosters_round_trip_and_no_shorter_one_is_read() {
        let bytes = roster().encode();
        assert_eq!(Roster::decode(&bytes), Ok(roster()));
        for length in 0..bytes.len() {
            assert!(Roster::decode(&bytes[..length]).is_err());
        }
        assert!(Roster::decode(&[&bytes[..], &[0]].concat()).is_err());
        let mut unsorted = roster();
        unsorted.generations.reverse();
        assert!(Roster::decode(&unsorted.encode()).is_err());
        let mut unsorted = roster();
        unsorted.nodes.values_mut().for_each(|n| n.groups.reverse());
        assert!(Roster::decode(&unsorted.encode()).is_err());
    }

    #[test]
    fn certificates_that_are_over_are_forgotten_a_day_later() {
        let mut roster = roster();
        assert_eq!(roster.revoked().len(), 2);
        roster.prune(UnixMillis(5 + 86_400_000));
        assert_eq!(roster.revoked().len(), 2);
        roster.prune(UnixMillis(6 + 86_400_000));
        assert_eq!(roster.revoked(), [([2][..].into(), UnixMillis(4))]);
    }
}
