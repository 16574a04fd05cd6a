//! Uses of owners that return: kept for a while although a restarted owner does not list them yet.

use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::Name;

use super::Routes;
use crate::routes::command::Command;

impl<R: RngCore> Routes<R> {
    /// Ends a use that is no longer listed, unless its restarted owner may still rediscover it.
    pub(super) fn not_listed(&mut self, name: Name) {
        let Some(route) = self.uses.get_mut(&name) else { return };
        let owner = self.use_rules[route.rule()].owner;
        if route.writer_count() == 0 || !self.owners.is_settling(&owner) {
            return self.drop_use(name);
        }
        route.unlist();
    }

    /// Handles an entry that is listed. If it was missing for a while, it is joined at once, without the pause after
    /// a refusal.
    pub(super) fn listed_again(&mut self, name: Name) {
        if let Some(route) = self.uses.get_mut(&name)
            && route.list()
        {
            let owner = self.use_rules[route.rule()].owner;
            self.commands.push_back(Command::JoinAgain { name, owner });
        }
    }

    /// Ends the uses that restarted owners have not rediscovered in time.
    pub(super) fn owners_have_settled(&mut self, now: Instant) {
        let owners = self.owners.take_settled(now);
        let of_owner = self.uses.iter().filter(|(_, u)| owners.contains(&self.use_rules[u.rule()].owner));
        for (name, is_listed) in of_owner.map(|(name, u)| (*name, u.is_listed())).collect::<Vec<_>>() {
            if is_listed {
                self.refresh_use(name);
            } else {
                self.drop_use(name);
            }
        }
    }
}
