//! Other rules for a running machine: what differs is begun, ended or told, what does not is left alone.
//!
//! What the user wrote is judged before it comes here.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::{Metadata, Name, NodeId};

use super::{Command, Routes, ShareRule, UseRule};
use crate::names::ros_type;
use crate::network::{DiscoveredEndpoint, EndpointKind, Guid};

impl<R: RngCore> Routes<R> {
    /// The user wants something else from now on. What is as it was is not touched.
    ///
    /// Rules for shares are told apart by topic, those for uses by owner and topic.
    pub fn reconfigure(&mut self, now: Instant, shares: Vec<ShareRule>, uses: Vec<UseRule>) {
        self.reconfigure_shares(now, shares);
        self.reconfigure_uses(uses);
        self.handle_timeout(now);
    }

    fn reconfigure_shares(&mut self, now: Instant, rules: Vec<ShareRule>) {
        let old = std::mem::replace(&mut self.share_rules, rules);
        let place = |topic: &str| self.share_rules.iter().position(|r| r.metadata.ros_name == topic);
        let (mut gone, mut kept) = (Vec::new(), Vec::new());
        for (name, route) in &self.shares {
            let before = &old[route.rule];
            match place(&before.metadata.ros_name) {
                Some(index) if continues(before, &self.share_rules[index], &ros_type(&route.type_name)) => {
                    kept.push((*name, index, before.policy != self.share_rules[index].policy));
                }
                _ => gone.push(*name),
            }
        }
        for name in gone {
            self.drop_share(name);
        }
        for (name, index, is_changed) in kept {
            let Some(route) = self.shares.get_mut(&name) else { continue };
            route.rule = index;
            if route.writers.is_empty() && self.share_rules[index].policy.publish.is_empty() {
                route.writerless_until.get_or_insert(now);
            }
            if is_changed {
                let policy = self.share_rules[index].policy.clone();
                self.commands.push_back(Command::UpdatePolicy { name, policy });
            }
        }
        self.begin_inbound();
        // Publishers that are there already, for what is new; those of a kept share are in it.
        let shared: BTreeSet<Guid> = self.shares.values().flat_map(|s| s.writers.keys().copied()).collect();
        let is_new = |e: &&DiscoveredEndpoint| e.kind == EndpointKind::Writer && !shared.contains(&e.guid);
        for writer in self.endpoints.values().filter(is_new).cloned().collect::<Vec<_>>() {
            self.writer_there(writer);
        }
    }

    fn reconfigure_uses(&mut self, rules: Vec<UseRule>) {
        let old = std::mem::replace(&mut self.use_rules, rules);
        let (mut gone, mut kept) = (Vec::new(), Vec::new());
        let joined = self.uses.iter().map(|(name, route)| (*name, route.rule));
        let tokens = self.tokens.iter().map(|(name, token)| (*name, token.rule));
        let places: BTreeMap<Name, usize> = joined.chain(tokens).collect();
        for (name, index) in places {
            let place = self.use_rules.iter().position(|r| r.is_same_place(&old[index]));
            let found = self.uses.get(&name).map(|route| &route.entry.metadata.type_name);
            let fits = |rule: &UseRule| match (&rule.type_name, found) {
                (Some(wanted), Some(found)) => wanted == found,
                _ => true,
            };
            match place.filter(|place| fits(&self.use_rules[*place])) {
                Some(place) => kept.push((name, place)),
                None => gone.push(name),
            }
        }
        for name in gone {
            self.drop_use(name);
        }
        for (name, place) in kept {
            if let Some(route) = self.uses.get_mut(&name) {
                route.rule = place;
            }
            if let Some(token) = self.tokens.get_mut(&name) {
                token.rule = place;
            }
        }
        let owners = |rules: &[UseRule]| -> BTreeMap<NodeId, String> {
            let followed = rules.iter().filter(|r| r.token.is_none());
            followed.map(|r| (r.owner, r.owner_name.clone())).collect()
        };
        let (before, after) = (owners(&old), owners(&self.use_rules));
        for owner in before.keys().filter(|owner| !after.contains_key(owner)).copied() {
            self.catalogues.remove(&owner);
            self.owners.remove(&owner);
            self.commands.push_back(Command::Unfollow { owner });
        }
        for (owner, owner_name) in after {
            if !before.contains_key(&owner) {
                self.commands.push_back(Command::Follow { owner_name });
            } else if old != self.use_rules
                && let Some(catalogue) = self.catalogues.get(&owner).cloned()
            {
                // What the owner lists already may be what a new rule asks for. Known entries change nothing.
                let out_of_reach = self.owners.remove(&owner);
                self.handle_catalogue(owner, catalogue);
                self.owners.extend(out_of_reach.map(|state| (owner, state)));
            }
        }
        self.join_tokens();
    }
}

/// Whether a share of this type goes on under a changed rule: only its policy may differ.
fn continues(before: &ShareRule, after: &ShareRule, type_name: &str) -> bool {
    let untyped = |rule: &ShareRule| Metadata { type_name: String::new(), ..rule.metadata.clone() };
    let wanted = &after.metadata.type_name;
    (wanted.is_empty() || wanted == type_name)
        && untyped(before) == untyped(after)
        && (before.suite, before.class) == (after.suite, after.class)
}
