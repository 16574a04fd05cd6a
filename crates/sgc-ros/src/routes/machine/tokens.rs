//! Token routes: names that are joined at once and described by the grant.
//!
//! From the first grant on they are use routes like others.

use std::collections::BTreeSet;

use rand_core::RngCore;
use sgc_trust::name_of;
use sgc_wire::{CatalogueEntry, Name};

use super::Routes;
use crate::routes::command::Command;
use crate::routes::problem::{Cause, Problem};
use crate::routes::rules::Shaping;
use crate::routes::token_join::TokenJoin;
use crate::routes::use_route::UseRoute;

impl<R: RngCore> Routes<R> {
    /// Handles the owner's description of a token's name, a catalogue of one entry.
    pub(super) fn handle_described(&mut self, name: Name, entry: CatalogueEntry) {
        let Some(token) = self.tokens.get_mut(&name) else { return };
        token.grant();
        let index = token.rule();
        let rule = &self.use_rules[index];
        let expected = rule.token.as_ref().map(|(_, metadata)| metadata);
        if name_of(&rule.owner, &entry.blind) != name || expected != Some(&entry.metadata) {
            let problem = Problem::TokenEntry { topic: rule.topic.clone(), owner: rule.owner_name.clone() };
            self.report(Cause::Token(name), problem);
            return self.close_use(name);
        }
        let (owner, shaping) = (rule.owner, rule.shaping);
        let (prefix, dead_man) = (rule.frame_prefix.clone(), rule.dead_man.clone());
        self.settle(Cause::Token(name), BTreeSet::new());
        let Some(token) = self.tokens.get_mut(&name) else { return };
        let transient_local = entry.qos.is_transient_local();
        if token.set_durability(transient_local) {
            // The join starts over with the other kind of sink.
            self.close_use(name);
            self.commands.push_back(Command::Leave { name });
            self.commands.push_back(Command::Join { name, owner, transient_local, describe: true });
            self.shape(name, shaping);
            self.frames(name, prefix);
            self.dead_man(name, dead_man);
            return;
        }
        if let Some(route) = self.uses.get_mut(&name) {
            route.set_entry(entry);
        } else {
            let local_name = self.use_rules[index].local_name(&entry.metadata);
            self.uses.insert(name, UseRoute::new(name, index, local_name, entry));
        }
        self.check_later();
    }

    /// Joins the names of tokens that are not joined yet.
    pub(super) fn join_tokens(&mut self) {
        for (index, rule) in self.use_rules.with_ids() {
            let Some((name, _)) = &rule.token else { continue };
            if self.tokens.contains_key(name) {
                continue;
            }
            self.tokens.insert(*name, TokenJoin::new(index));
            let (name, owner, shaping) = (*name, rule.owner, rule.shaping);
            self.commands.push_back(Command::Join { name, owner, transient_local: false, describe: true });
            if shaping != Shaping::default() {
                self.commands.push_back(Command::Shape { name, shaping });
            }
            if let Some(prefix) = &rule.frame_prefix {
                self.commands.push_back(Command::Frames { name, prefix: Some(prefix.clone()) });
            }
            if rule.dead_man.is_some() {
                self.commands.push_back(Command::DeadMan { name, rule: rule.dead_man.clone() });
            }
        }
    }
}
