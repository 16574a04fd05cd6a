//! [`Owners`]: the catalogues of followed owners, and owners that are away or return.
//!
//! A restarted owner rediscovers its local network step by step, so its first catalogues may omit interfaces that still
//! exist.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use sgc_endpoint::RefusedBy;
use sgc_wire::{Catalogue, NodeId, SourceId};

/// Time for which a restarted owner's former catalogue stands while it rediscovers its local network. Cyclone and
/// Fast DDS take up to 3 s to announce existing endpoints to a new participant.
pub const REDISCOVERY_HOLD: Duration = Duration::from_secs(10);

/// The reason why an owner's catalogue does not come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OwnerState {
    /// There is no path to the owner.
    OutOfReach,
    /// The owner left, or ended its catalogue.
    Gone,
    /// The owner or a router refuses the catalogue.
    Refuses(RefusedBy),
}

/// The state of an owner that was unreachable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Settling {
    /// The owner is unreachable.
    Away,
    /// The owner has returned after a restart.
    Until(Instant),
}

/// The followed owners.
#[derive(Debug, Default)]
pub(super) struct Owners {
    /// The last catalogues, kept for later rules.
    catalogues: BTreeMap<NodeId, Catalogue>,
    /// Owners that are unreachable or refuse, for status.
    states: BTreeMap<NodeId, OwnerState>,
    /// Owners that were unreachable, or have just returned.
    settling: BTreeMap<NodeId, Settling>,
}

impl Owners {
    /// Takes an owner's catalogue. `known` are the sources that local writers represent: source ids change with a
    /// restart, so a known one proves that the owner's node did not restart.
    pub(super) fn list(
        &mut self,
        now: Instant,
        owner: NodeId,
        catalogue: Catalogue,
        known: &BTreeSet<SourceId>,
    ) {
        self.states.remove(&owner);
        if self.settling.get(&owner) == Some(&Settling::Away) {
            if catalogue.entries.iter().flat_map(|e| &e.sources).any(|s| known.contains(&s.source)) {
                self.settling.remove(&owner);
            } else {
                self.settling.insert(owner, Settling::Until(now + REDISCOVERY_HOLD));
            }
        }
        self.catalogues.insert(owner, catalogue);
    }

    /// Notes that an owner is out of reach. Its catalogue stands.
    pub(super) fn lose(&mut self, owner: NodeId) {
        self.states.insert(owner, OwnerState::OutOfReach);
        self.settling.insert(owner, Settling::Away);
    }

    /// Notes that an owner has gone, with its catalogue.
    pub(super) fn end(&mut self, owner: NodeId) {
        self.forget(&owner);
        self.states.insert(owner, OwnerState::Gone);
    }

    /// Notes that an owner refuses its catalogue.
    pub(super) fn refuse(&mut self, owner: NodeId, by: RefusedBy) {
        self.states.insert(owner, OwnerState::Refuses(by));
    }

    /// Forgets an owner that is no longer followed.
    pub(super) fn forget(&mut self, owner: &NodeId) {
        self.catalogues.remove(owner);
        self.states.remove(owner);
        self.settling.remove(owner);
    }

    /// Returns the reason why an owner's catalogue does not come.
    pub(super) fn state(&self, owner: &NodeId) -> Option<OwnerState> {
        self.states.get(owner).copied()
    }

    /// Returns the last catalogue of an owner.
    pub(super) fn catalogue(&self, owner: &NodeId) -> Option<&Catalogue> {
        self.catalogues.get(owner)
    }

    /// Iterates over the last catalogues.
    pub(super) fn catalogues(&self) -> impl Iterator<Item = (&NodeId, &Catalogue)> {
        self.catalogues.iter()
    }

    /// Returns `true` if a restarted owner may still rediscover interfaces that it does not list.
    pub(super) fn is_settling(&self, owner: &NodeId) -> bool {
        matches!(self.settling.get(owner), Some(Settling::Until(_)))
    }

    /// Returns the time of the next [`Self::take_settled`].
    pub(super) fn deadline(&self) -> Option<Instant> {
        let until = |state: &Settling| match state {
            Settling::Until(at) => Some(*at),
            Settling::Away => None,
        };
        self.settling.values().filter_map(until).min()
    }

    /// Returns the owners whose time to rediscover their network has ended.
    pub(super) fn take_settled(&mut self, now: Instant) -> BTreeSet<NodeId> {
        let settled = |s: &Settling| matches!(s, Settling::Until(at) if *at <= now);
        let owners: BTreeSet<NodeId> =
            self.settling.iter().filter(|(_, s)| settled(s)).map(|(owner, _)| *owner).collect();
        self.settling.retain(|owner, _| !owners.contains(owner));
        owners
    }
}
