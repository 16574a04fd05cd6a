//! Revocations by a CA: by node and incarnation, which only grows, and by serial number.
//!
//! This module decides which lists of a CA are kept and what they revoke together. `crl.rs` reads and checks a list,
//! `issue.rs` writes one.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;
use sgc_wire::{CRL_BYTES_MAX, Pseudonym, UnixMillis};

/// Most nodes that one CA has revoked, in all of its lists together. A list that would add more is refused.
pub const REVOKED_NODES_MAX: usize = 8192;
/// Most nodes in one list: those that were revoked last. Nodes keep the lists before it for the others.
pub const LIST_NODES_MAX: usize = 1024;
/// Most lists of one fleet's CA with revocations of their own: those that [`REVOKED_NODES_MAX`] nodes need, and as many
/// for diverged copies of the fleet's file. A further one is refused until the copies are merged.
pub const FLEET_LISTS_MAX: usize = 2 * LISTS_OF_ONE_COPY_MAX;
/// Lists of a growing set that do not cover each other name each node at most twice.
const LISTS_OF_ONE_COPY_MAX: usize = 2 * REVOKED_NODES_MAX / LIST_NODES_MAX;

/// The incarnation up to which a node is revoked. Of two revocations of a node the one that covers more counts; of two
/// that cover the same, the earlier one. So their order does not matter.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Revocation {
    /// The highest incarnation that is revoked, and with it all before it.
    pub incarnation: u32,
    /// Time of the revocation, in whole seconds.
    pub at: UnixMillis,
}

impl Revocation {
    /// Returns a revocation from the second of `at` on.
    pub(crate) fn new(incarnation: u32, at: UnixMillis) -> Self {
        Self { incarnation, at: UnixMillis(at.secs() * 1000) }
    }

    /// Returns `true` if certificates of this incarnation are revoked by it.
    pub fn covers(&self, incarnation: u32) -> bool {
        incarnation <= self.incarnation
    }

    /// Returns `true` if `other` adds nothing to it.
    fn includes(&self, other: &Self) -> bool {
        self.incarnation > other.incarnation || (self.incarnation == other.incarnation && self.at <= other.at)
    }
}

/// Revoked nodes of one CA. Nothing is ever taken out of it.
pub(crate) type RevokedNodes = BTreeMap<Pseudonym, Revocation>;

/// Adds a revocation. Returns `true` if it is news.
pub(crate) fn add_revocation(nodes: &mut RevokedNodes, node: Pseudonym, revocation: Revocation) -> bool {
    match nodes.get_mut(&node) {
        Some(known) if known.includes(&revocation) => false,
        Some(known) => {
            *known = revocation;
            true
        }
        None => {
            nodes.insert(node, revocation);
            true
        }
    }
}

/// A verified list of a CA.
pub(crate) struct RevocationList {
    pub(crate) der: Bytes,
    /// Big-endian, without leading zeros.
    pub(crate) number: Box<[u8]>,
    /// Serial numbers without leading zeros, with the times of revocation.
    pub(crate) serials: BTreeMap<Box<[u8]>, UnixMillis>,
    /// Revoked nodes; `None` for a list that only names serial numbers, as other CAs than a fleet's write them.
    pub(crate) nodes: Option<RevokedNodes>,
}

impl RevocationList {
    fn order(&self) -> (usize, &[u8], &[u8]) {
        (self.number.len(), &self.number, &self.der)
    }
}

/// The lists of one CA that are in force.
#[derive(Clone, Default)]
pub(crate) struct CaLists {
    /// The list with the greatest number, of those that name serial numbers only: such a list is its CA's whole truth,
    /// and the CA may take an entry off again (RFC 5280, 5.3.1, certificateHold).
    plain: Option<Arc<RevocationList>>,
    /// Lists of a fleet, by rising number. They count together, and the others cover none of them.
    fleet: Vec<Arc<RevocationList>>,
    /// The union of their revocations.
    nodes: Arc<RevokedNodes>,
}

impl CaLists {
    /// Returns these lists with one more; `Ok(None)` if it adds nothing.
    pub(crate) fn with(&self, list: Arc<RevocationList>) -> Result<Option<Self>, CrlError> {
        let Some(added) = &list.nodes else {
            let is_newer = |known: &Arc<RevocationList>| is_greater(&list.number, &known.number);
            return Ok(self
                .plain
                .as_ref()
                .is_none_or(is_newer)
                .then(|| Self { plain: Some(list), ..self.clone() }));
        };
        let mut nodes = RevokedNodes::clone(&self.nodes);
        let mut grows = false;
        for (node, revocation) in added {
            grows |= add_revocation(&mut nodes, *node, *revocation);
        }
        if nodes.len() > REVOKED_NODES_MAX {
            return Err(CrlError::TooManyNodes);
        }
        let mut fleet = self.fleet.clone();
        let place = fleet.partition_point(|known| known.order() < list.order());
        fleet.insert(place, list);
        drop_covered(&mut fleet, &nodes);
        if !grows && fleet.len() >= self.fleet.len() {
            return Ok(None);
        }
        if fleet.len() > FLEET_LISTS_MAX {
            return Err(CrlError::TooManyLists);
        }
        Ok(Some(Self { plain: self.plain.clone(), fleet, nodes: Arc::new(nodes) }))
    }

    /// Returns these lists with those of `other` that are news and fit.
    pub(crate) fn with_all_of(&self, other: &Self) -> Self {
        let mut all = self.clone();
        for list in other.lists() {
            if let Ok(Some(more)) = all.with(Arc::clone(list)) {
                all = more;
            }
        }
        all
    }

    /// Returns the lists in force, from which another node learns every revocation.
    pub(crate) fn lists(&self) -> impl Iterator<Item = &Arc<RevocationList>> {
        self.plain.iter().chain(&self.fleet)
    }

    /// Returns the time at which a certificate with this serial number was revoked.
    pub(crate) fn serial_revoked_at(&self, serial: &[u8]) -> Option<UnixMillis> {
        self.lists().filter_map(|list| list.serials.get(serial)).min().copied()
    }

    /// Returns the revoked nodes.
    pub(crate) fn nodes(&self) -> &RevokedNodes {
        &self.nodes
    }

    /// Returns the greatest number of a fleet's list.
    pub(crate) fn fleet_number(&self) -> Option<&[u8]> {
        self.fleet.last().map(|list| &*list.number)
    }
}

/// Removes every list that the others cover, from the oldest on.
fn drop_covered(lists: &mut Vec<Arc<RevocationList>>, all: &RevokedNodes) {
    // Of each node one revocation counts; this counts the lists that have it.
    let decisive = |list: &RevocationList| {
        let nodes: Vec<_> = list.nodes.iter().flatten().filter(|(n, r)| all.get(n) == Some(r)).collect();
        nodes.into_iter().map(|(node, _)| *node).collect::<Vec<_>>()
    };
    let mut holders: BTreeMap<Pseudonym, usize> = BTreeMap::new();
    for node in lists.iter().flat_map(|list| decisive(list)) {
        *holders.entry(node).or_default() += 1;
    }
    lists.retain(|list| {
        let nodes = decisive(list);
        let is_needed = nodes.iter().any(|node| holders.get(node) == Some(&1));
        if !is_needed {
            nodes.iter().filter_map(|node| holders.get_mut(node).map(|n| *n -= 1)).count();
        }
        is_needed
    });
}

fn is_greater(number: &[u8], than: &[u8]) -> bool {
    (number.len(), number) > (than.len(), than)
}

/// The reason why a revocation list is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CrlError {
    /// The list is too long.
    #[error("the revocation list has {bytes} bytes, at most {CRL_BYTES_MAX} are read")]
    TooLong {
        /// Its length.
        bytes: usize,
    },
    /// The list cannot be read as X.509.
    #[error("the revocation list cannot be read: {0}")]
    Malformed(String),
    /// The list covers only some certificates of its CA, or those of other CAs.
    #[error(
        "the revocation list is a partial one (delta, indirect, or with an issuing distribution point): have the CA \
         write a full one"
    )]
    Partial,
    /// The list has no number, so that nobody can tell which of two is newer.
    #[error("the revocation list has no CRL number: have the CA write one with it (RFC 5280, 5.2.3)")]
    NoNumber,
    /// No CA that is trusted here made the list.
    #[error("the revocation list is from a CA that is not trusted here")]
    UnknownIssuer,
    /// The list names a trusted CA, which did not sign it.
    #[error("the revocation list's signature is wrong: it was altered or forged")]
    BadSignature,
    /// Its CA's certificate has a key usage without cRLSign.
    #[error("the CA's certificate does not let it sign revocation lists (key usage cRLSign)")]
    NotAListSigner,
    /// The CA has expired, and with it everything that it could revoke.
    #[error("the revocation list's CA expired at {not_after} and the clock here says {now}")]
    CaExpired {
        /// Its end.
        not_after: UnixMillis,
        /// The time of the check.
        now: UnixMillis,
    },
    /// With this list its CA would have revoked too many nodes.
    #[error(
        "with this revocation list its CA would have revoked more than {REVOKED_NODES_MAX} nodes: it is not taken; \
         make a new fleet"
    )]
    TooManyNodes,
    /// Too many lists of the CA are in force, each with revocations of its own.
    #[error(
        "{FLEET_LISTS_MAX} revocation lists of this CA are in force and none says what another does: it is not taken; \
         `sgc fleet merge` the copies of the fleet's file and hand out the list of the merged one"
    )]
    TooManyLists,
}

impl CrlError {
    /// Returns `true` if an honest node never passes such a list on.
    pub fn is_forgery(&self) -> bool {
        match self {
            // Another node may trust the CA, have another clock or more room.
            Self::UnknownIssuer | Self::CaExpired { .. } | Self::TooManyNodes | Self::TooManyLists => false,
            Self::TooLong { .. }
            | Self::Malformed(_)
            | Self::Partial
            | Self::NoNumber
            | Self::BadSignature
            | Self::NotAListSigner => true,
        }
    }
}
