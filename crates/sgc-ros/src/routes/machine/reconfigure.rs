//! Reconfiguration of a running machine. Routes that differ begin, end or are updated; others are left alone.
//!
//! The rules are validated before they come here.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use rand_core::RngCore;
use sgc_wire::{Name, NodeId};

use super::Routes;
use crate::network::{DiscoveredEndpoint, EndpointKind, Guid};
use crate::routes::command::Command;
use crate::routes::problem::Cause;
use crate::routes::rules::{Direction, Rules, ShareRule, ShareRules, UseRule, UseRuleId, UseRules};
use crate::routes::share_route::ShareRoute;

impl<R: RngCore> Routes<R> {
    /// Replaces the rules.
    ///
    /// A route continues under the rule that now covers its interface, unless that rule demands a different route.
    pub fn reconfigure(&mut self, now: Instant, shares: Vec<ShareRule>, uses: Vec<UseRule>) {
        // Uses are judged by the new shares, and shares then by the new uses.
        let old = std::mem::replace(&mut self.share_rules, Rules::new(shares));
        self.reconfigure_uses(uses);
        self.reconfigure_shares(now, &old);
        self.check_later();
        self.handle_timeout(now);
    }

    fn reconfigure_shares(&mut self, now: Instant, old: &ShareRules) {
        let (mut gone, mut kept) = (Vec::new(), Vec::new());
        for (name, route) in &self.shares {
            let before = &old[route.rule()];
            let (local_name, type_name) = (route.local_name(), route.type_name());
            let kind = before.metadata.kind;
            match self.share_rule(kind, local_name, Some(&type_name)) {
                Some(index) if continues(before, &self.share_rules[index], local_name, &type_name) => {
                    kept.push((*name, index, before.clone()));
                }
                _ => gone.push(*name),
            }
        }
        for name in gone {
            self.drop_share(name);
        }
        for (name, index, before) in kept {
            let Some(route) = self.shares.get_mut(&name) else { continue };
            route.move_to(now, index, &self.share_rules[index]);
            let ShareRule { policy, shaping, dead_man, qos, .. } = &self.share_rules[index];
            let has_other_qos = *qos != before.qos;
            if *policy != before.policy {
                self.commands.push_back(Command::UpdatePolicy { name, policy: policy.clone() });
            }
            if *shaping != before.shaping {
                self.commands.push_back(Command::Shape { name, shaping: *shaping });
            }
            if *dead_man != before.dead_man {
                self.commands.push_back(Command::DeadMan { name, rule: dead_man.clone() });
                self.change_writer(&name, ShareRoute::refresh_writer);
            }
            if has_other_qos {
                self.refresh_share(name);
            }
        }
        self.begin_inbound();
        // Existing publishers are offered to new shares. Those of a kept share are in it already.
        let shared: BTreeSet<Guid> = self.shares.values().flat_map(|s| s.writers().copied()).collect();
        let is_new = |e: &&DiscoveredEndpoint| e.kind == EndpointKind::Writer && !shared.contains(&e.guid);
        for writer in self.local.endpoints().filter(is_new).cloned().collect::<Vec<_>>() {
            if !self.service_end_there(&writer) {
                self.writer_there(writer);
            }
        }
    }

    fn reconfigure_uses(&mut self, rules: Vec<UseRule>) {
        let old = std::mem::replace(&mut self.use_rules, Rules::new(rules));
        let joined = self.uses.iter().map(|(name, route)| (*name, route.rule()));
        let tokens = self.tokens.iter().map(|(name, token)| (*name, token.rule()));
        let places: BTreeMap<Name, UseRuleId> = joined.chain(tokens).collect();
        let places =
            places.into_iter().map(|(name, before)| (name, before, self.place_of(&name, &old[before])));
        let (kept, gone): (Vec<_>, Vec<_>) = places.partition(|(_, _, place)| place.is_some());
        for (name, _, _) in gone {
            self.drop_use(name);
        }
        for (name, before, place) in kept {
            if let Some(place) = place {
                self.move_use(name, &old[before], place);
            }
        }
        self.follow_owners(&old);
        self.join_tokens();
    }

    /// Returns the rule under which a joined name continues; `None` if its route has to end.
    fn place_of(&self, name: &Name, before: &UseRule) -> Option<UseRuleId> {
        let route = self.uses.get(name);
        let place = match route.filter(|_| before.token.is_none()) {
            Some(route) => self
                .use_rule(&before.owner, route.entry())
                .filter(|place| self.why_not_used(*place, &route.entry().metadata).is_none()),
            None => self.use_rules.position(|r| r.is_same_place(before)),
        };
        let fits = |rule: &UseRule| {
            let (same_way, wanted) = (rule.direction == before.direction, rule.type_name.as_ref());
            same_way
                && route.is_none_or(|route| {
                    let metadata = &route.entry().metadata;
                    wanted.is_none_or(|wanted| *wanted == metadata.type_name)
                        && rule.local_name(metadata) == route.local_name()
                })
        };
        // Publishing in another class begins anew.
        let same_class = |rule: &UseRule| rule.direction == Direction::Bring || rule.class == before.class;
        let stays = |place: &UseRuleId| fits(&self.use_rules[*place]) && same_class(&self.use_rules[*place]);
        place.filter(stays)
    }

    /// Continues a joined name under another rule.
    fn move_use(&mut self, name: Name, before: &UseRule, place: UseRuleId) {
        let UseRule { shaping, frame_prefix, dead_man, qos, .. } = &self.use_rules[place];
        let has_other_qos = *qos != before.qos;
        if *shaping != before.shaping {
            self.commands.push_back(Command::Shape { name, shaping: *shaping });
        }
        if *frame_prefix != before.frame_prefix {
            self.commands.push_back(Command::Frames { name, prefix: frame_prefix.clone() });
        }
        if *dead_man != before.dead_man {
            self.commands.push_back(Command::DeadMan { name, rule: dead_man.clone() });
        }
        if let Some(route) = self.uses.get_mut(&name) {
            route.move_to(place);
        }
        if has_other_qos {
            self.refresh_use(name);
        }
        if let Some(token) = self.tokens.get_mut(&name) {
            token.move_to(place);
        }
    }

    /// Follows the owners of the rules, and no others.
    fn follow_owners(&mut self, old: &UseRules) {
        let owners = |rules: &UseRules| -> BTreeMap<NodeId, String> {
            let followed = rules.iter().filter(|r| r.token.is_none());
            followed.map(|r| (r.owner, r.owner_name.clone())).collect()
        };
        let (before, after) = (owners(old), owners(&self.use_rules));
        for owner in before.keys().filter(|owner| !after.contains_key(owner)).copied() {
            self.settle(Cause::Catalogue(owner), BTreeSet::new());
            self.owners.forget(&owner);
            self.commands.push_back(Command::Unfollow { owner });
        }
        for (owner, owner_name) in after {
            if !before.contains_key(&owner) {
                self.commands.push_back(Command::Follow { owner_name });
            } else if let Some(catalogue) = self.owners.catalogue(&owner).cloned() {
                // The catalogue is applied again for new rules. Known entries change nothing.
                self.list(owner, catalogue);
            }
        }
    }
}

/// Returns `true` if a share of this type continues under a changed rule: only policy, shaping and QoS may differ.
fn continues(before: &ShareRule, after: &ShareRule, local_name: &str, type_name: &str) -> bool {
    let wanted = &after.metadata.type_name;
    (wanted.is_empty() || wanted == type_name)
        && before.metadata_of(local_name, type_name) == after.metadata_of(local_name, type_name)
        && (before.suite, before.class) == (after.suite, after.class)
}
