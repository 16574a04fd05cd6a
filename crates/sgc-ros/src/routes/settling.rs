//! Owners that return. A restarted owner rediscovers its local network step by step, so its first catalogues may omit
//! interfaces that still exist.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_wire::{Catalogue, Name, NodeId, SourceId};

use super::{Command, Routes};

/// Time for which a restarted owner's former catalogue stands while it rediscovers its local network. Cyclone and
/// Fast DDS take up to 3 s to announce existing endpoints to a new participant.
pub const REDISCOVERY_HOLD: Duration = Duration::from_secs(10);

/// The state of an owner that was unreachable.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Settling {
    /// The owner is unreachable.
    Away,
    /// The owner has returned after a restart.
    Until(Instant),
}

impl<R: RngCore> Routes<R> {
    /// Judges the first catalogue of an owner that was unreachable.
    pub(super) fn owner_is_back(&mut self, now: Instant, owner: NodeId, catalogue: &Catalogue) {
        if self.settling.get(&owner) != Some(&Settling::Away) {
            return;
        }
        let rules = &self.use_rules;
        let of_owner = self.uses.values().filter(|u| rules[u.rule].is_of_catalogue(&owner));
        let known: BTreeSet<SourceId> = of_owner.flat_map(|u| u.writers.keys().copied().flatten()).collect();
        // Source ids change with a restart, so a known one proves that the owner's node did not restart.
        let same_run = catalogue.entries.iter().flat_map(|e| &e.sources).any(|s| known.contains(&s.source));
        if same_run {
            self.settling.remove(&owner);
        } else {
            self.settling.insert(owner, Settling::Until(now + REDISCOVERY_HOLD));
        }
    }

    /// Returns the time until which entries that an owner no longer lists are kept.
    pub(super) fn settles_at(&self, owner: &NodeId) -> Option<Instant> {
        match self.settling.get(owner) {
            Some(Settling::Until(at)) => Some(*at),
            _ => None,
        }
    }

    /// Ends a use that is no longer listed, unless its restarted owner may still rediscover it.
    pub(super) fn not_listed(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name) else { return };
        let owner = self.use_rules[route.rule].owner;
        if route.writers.is_empty() || !matches!(self.settling.get(&owner), Some(Settling::Until(_))) {
            return self.drop_use(name);
        }
        route.granted = false;
        route.is_listed = false;
    }

    /// Handles an entry that is listed. If it was missing for a while, it is joined at once, without the pause after
    /// a refusal.
    pub(super) fn listed_again(&mut self, name: Name) {
        if let Some(route) = self.uses.get_mut(&name)
            && !std::mem::replace(&mut route.is_listed, true)
        {
            let owner = self.use_rules[route.rule].owner;
            self.commands.push_back(Command::JoinAgain { name, owner });
        }
    }

    /// Ends the uses that restarted owners have not rediscovered in time.
    pub(super) fn owners_have_settled(&mut self, now: Instant) {
        let settled = |s: &Settling| matches!(s, Settling::Until(at) if *at <= now);
        let owners: BTreeSet<NodeId> =
            self.settling.iter().filter(|(_, s)| settled(s)).map(|(owner, _)| *owner).collect();
        self.settling.retain(|owner, _| !owners.contains(owner));
        let of_owner = self.uses.iter().filter(|(_, u)| owners.contains(&self.use_rules[u.rule].owner));
        for (name, is_listed) in of_owner.map(|(name, u)| (*name, u.is_listed)).collect::<Vec<_>>() {
            if is_listed {
                self.refresh_use(name);
            } else {
                self.drop_use(name);
            }
        }
    }
}
