//! Owners that come back: one whose node started anew finds its local network again publisher by publisher, so what its first
//! catalogues do not list may be there all the same.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use rand_core::RngCore;
use sgc_wire::{Catalogue, Name, NodeId, SourceId};

use super::{Command, Routes};

/// How long an owner whose node started anew may take to find its local network. Until then what it listed before stands:
/// Cyclone and Fast DDS take up to 3 s to tell a participant that is new of what was there before it.
pub const REDISCOVERY_HOLD: Duration = Duration::from_secs(10);

/// An owner that was out of reach.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Settling {
    /// It still is.
    Away,
    /// It is back, and was started anew.
    Until(Instant),
}

impl<R: RngCore> Routes<R> {
    /// Judges the first catalogue of an owner that was out of reach.
    pub(super) fn owner_is_back(&mut self, now: Instant, owner: NodeId, catalogue: &Catalogue) {
        if self.settling.get(&owner) != Some(&Settling::Away) {
            return;
        }
        let rules = &self.use_rules;
        let of_owner = self.uses.values().filter(|u| rules[u.rule].is_of_catalogue(&owner));
        let known: BTreeSet<SourceId> = of_owner.flat_map(|u| u.writers.keys().copied().flatten()).collect();
        // Ids of sources end with the run: one that is still there says that it is the same.
        let same_run = catalogue.entries.iter().flat_map(|e| &e.sources).any(|s| known.contains(&s.source));
        if same_run {
            self.settling.remove(&owner);
        } else {
            self.settling.insert(owner, Settling::Until(now + REDISCOVERY_HOLD));
        }
    }

    /// Until when what an owner does not list stands all the same.
    pub(super) fn settles_at(&self, owner: &NodeId) -> Option<Instant> {
        match self.settling.get(owner) {
            Some(Settling::Until(at)) => Some(*at),
            _ => None,
        }
    }

    /// A used topic is not listed: it ends, unless its owner has to find it first.
    pub(super) fn not_listed(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name) else { return };
        let owner = self.use_rules[route.rule].owner;
        if route.writers.is_empty() || !matches!(self.settling.get(&owner), Some(Settling::Until(_))) {
            return self.drop_use(name);
        }
        route.granted = false;
        route.is_listed = false;
    }

    /// A used topic is listed. One that was not for a while is asked for at once, and not when a refusal of meanwhile says.
    pub(super) fn listed_again(&mut self, name: Name) {
        if let Some(route) = self.uses.get_mut(&name)
            && !std::mem::replace(&mut route.is_listed, true)
        {
            let owner = self.use_rules[route.rule].owner;
            self.commands.push_back(Command::JoinAgain { name, owner });
        }
    }

    /// Ends what owners have not found by now.
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
