//! [`TokenJoin`]: the joined name that a token gives.

use sgc_endpoint::RefusedBy;

use super::rules::UseRuleId;

/// A joined name from a token. From the first grant on a use route exists, too.
#[derive(Debug)]
pub(super) struct TokenJoin {
    rule: UseRuleId,
    transient_local: bool,
    refused: Option<RefusedBy>,
}

impl TokenJoin {
    /// Creates a join as a volatile sink. Only the grant tells the durability.
    pub(super) fn new(rule: UseRuleId) -> Self {
        Self { rule, transient_local: false, refused: None }
    }

    pub(super) fn rule(&self) -> UseRuleId {
        self.rule
    }

    pub(super) fn refused(&self) -> Option<RefusedBy> {
        self.refused
    }

    /// Handles the grant.
    pub(super) fn grant(&mut self) {
        self.refused = None;
    }

    /// Handles a refusal.
    pub(super) fn refuse(&mut self, by: RefusedBy) {
        self.refused = Some(by);
    }

    /// Continues under another rule.
    pub(super) fn move_to(&mut self, rule: UseRuleId) {
        self.rule = rule;
    }

    /// Sets the durability. Returns `true` if it is another one, which needs another kind of sink.
    pub(super) fn set_durability(&mut self, transient_local: bool) -> bool {
        std::mem::replace(&mut self.transient_local, transient_local) != transient_local
    }
}
