//! Selection of the rule for an interface.
//!
//! This module also resolves conflicts: an interface that wildcards would both share and bring is carried one way only,
//! and nothing is brought under a name that ROS 2 does not allow.

use sgc_wire::{CatalogueEntry, Kind, Metadata, NodeId};

use super::Routes;
use crate::names::is_topic_name;
use crate::routes::problem::Problem;
use crate::routes::rules::{ShareRule, ShareRuleId, UseRule, UseRuleId};

impl<R> Routes<R> {
    /// Returns the rule that shares a local interface: the first that names it, else the first wildcard that covers
    /// it. Where the type is known, wildcard rules for other types are skipped.
    pub(super) fn share_rule(
        &self,
        kind: Kind,
        local_name: &str,
        type_name: Option<&str>,
    ) -> Option<ShareRuleId> {
        let literal = |rule: &ShareRule| !rule.is_pattern() && rule.covers(kind, local_name);
        let named = self.share_rules.position(literal);
        named.or_else(|| {
            let index = self.wildcard_share(kind, local_name, type_name)?;
            self.used_as(kind, local_name).is_none().then_some(index)
        })
    }

    fn wildcard_share(&self, kind: Kind, local_name: &str, type_name: Option<&str>) -> Option<ShareRuleId> {
        let is_of_type = |rule: &ShareRule| {
            let wanted = rule.metadata.type_name.as_str();
            wanted.is_empty() || type_name.is_none_or(|found| found == wanted)
        };
        let covers =
            |rule: &ShareRule| rule.is_pattern() && rule.covers(kind, local_name) && is_of_type(rule);
        self.share_rules.position(covers)
    }

    /// Returns the rule for an owner's entry: the first that names it, else the first wildcard that covers it.
    pub(super) fn use_rule(&self, owner: &NodeId, entry: &CatalogueEntry) -> Option<UseRuleId> {
        let find = |pattern| {
            let asks = |rule: &UseRule| rule.is_pattern() == pattern && rule.covers(owner, entry);
            self.use_rules.position(asks)
        };
        find(false).or_else(|| find(true))
    }

    /// Returns the owner whose interface has this local name, by a rule that names it or a running route.
    fn used_as(&self, kind: Kind, local_name: &str) -> Option<&str> {
        let named = self.use_rules.iter().find(|rule| rule.claims(kind, local_name));
        let running = || {
            let has = |metadata: &Metadata, name: &str| metadata.kind == kind && name == local_name;
            let route = self.uses.values().find(|u| has(&u.entry().metadata, u.local_name()))?;
            Some(&self.use_rules[route.rule()])
        };
        named.or_else(running).map(|rule| rule.owner_name.as_str())
    }

    /// Returns `true` if this local name is shared by a rule that names it or by a running route.
    fn is_shared_as(&self, kind: Kind, local_name: &str) -> bool {
        let literal = |rule: &ShareRule| !rule.is_pattern() && rule.covers(kind, local_name);
        let running = || kind == Kind::Topic && self.shares.values().any(|s| s.local_name() == local_name);
        self.share_rules.iter().any(literal) || running()
    }

    /// Returns the problem if a local interface that a wildcard covers is not shared because the name is used.
    pub(super) fn why_not_shared(&self, kind: Kind, local_name: &str, type_name: &str) -> Option<Problem> {
        self.wildcard_share(kind, local_name, Some(type_name))?;
        let owner = self.used_as(kind, local_name)?.to_owned();
        Some(Problem::UsedNotShared { topic: local_name.to_owned(), owner })
    }

    /// Returns the problem that keeps an owner's entry from having its local name. Rules that name it were checked
    /// before.
    pub(super) fn why_not_used(&self, rule: UseRuleId, metadata: &Metadata) -> Option<Problem> {
        let rule = &self.use_rules[rule];
        if !rule.is_pattern() {
            return None;
        }
        let (topic, owner) = (rule.local_name(metadata), rule.owner_name.clone());
        if !is_topic_name(&metadata.ros_name) || !is_topic_name(&topic) {
            return Some(Problem::NoName { topic, owner });
        }
        self.is_shared_as(metadata.kind, &topic).then_some(Problem::SharedNotUsed { topic, owner })
    }
}
