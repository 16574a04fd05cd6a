//! Holders of invitations at a fleet's authority: bounds that keep them from taking what operators need.
//!
//! A holder is anybody with a code, also one that was used, for as long as its certificate is valid.

use std::collections::BTreeMap;

use sgc_wire::NodeId;

/// Most challenges of holders that are valid at a time. A further one replaces the oldest.
pub(crate) const HOLDER_CHALLENGES_MAX: usize = 64;
/// Most requests of holders that wait for the fleet file.
pub(crate) const HOLDERS_WAITING_MAX: usize = 4;
/// Most requests of holders whose answers are remembered: as many as may be under way and wait together.
pub(crate) const HOLDERS_EXECUTED_MAX: usize = 2 * HOLDERS_WAITING_MAX;
/// Most requests of one holder that are carried out, in a run of the authority.
const ATTEMPTS_MAX: u8 = 8;
/// Most holders that are remembered. The fleet's CA makes them, so nobody else can exceed it.
const HOLDERS_KNOWN_MAX: usize = 4096;

/// Requests of holders that were carried out.
#[derive(Debug, Default)]
pub(crate) struct Attempts(BTreeMap<NodeId, u8>);

impl Attempts {
    /// Counts a request of a holder. Returns `false` if it has made too many.
    pub(crate) fn count(&mut self, holder: NodeId) -> bool {
        if self.0.len() >= HOLDERS_KNOWN_MAX && !self.0.contains_key(&holder) {
            self.0.clear();
        }
        let made = self.0.entry(holder).or_default();
        if *made >= ATTEMPTS_MAX {
            return false;
        }
        *made += 1;
        true
    }

    /// Takes a counted request back.
    pub(crate) fn forgive(&mut self, holder: &NodeId) {
        if let Some(made) = self.0.get_mut(holder) {
            *made = made.saturating_sub(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn holder(n: usize) -> NodeId {
        let mut id = [0; 32];
        id[..8].copy_from_slice(&n.to_be_bytes());
        NodeId(id)
    }

    #[test]
    fn each_holder_has_a_few_attempts() {
        let mut attempts = Attempts::default();
        for _ in 0..ATTEMPTS_MAX {
            assert!(attempts.count(holder(1)));
        }
        assert!(!attempts.count(holder(1)) && attempts.count(holder(2)));
        attempts.forgive(&holder(1));
        assert!(attempts.count(holder(1)) && !attempts.count(holder(1)));
        for n in 0..2 * HOLDERS_KNOWN_MAX {
            attempts.count(holder(n));
            assert!(attempts.0.len() <= HOLDERS_KNOWN_MAX);
        }
    }
}
