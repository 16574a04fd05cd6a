//! [`Recent`]: the last records of this run, in memory, for the user of the node and for observers of an authority.
//!
//! The log on the disk has all records. These serve readers that may not read it, and look often.

use std::collections::VecDeque;

use super::record::AuditRecord;

/// Most records that are kept.
pub const RECENT_MAX: usize = 256;
/// Most records about the keeping of the fleet that are kept. Others do not displace them.
pub(crate) const RECENT_OF_FLEET_MAX: usize = 64;

/// The last records, oldest first.
#[derive(Debug, Default)]
pub(super) struct Recent {
    all: VecDeque<AuditRecord>,
    of_fleet: VecDeque<AuditRecord>,
}

impl Recent {
    /// Adds a record in place of the oldest.
    pub(super) fn push(&mut self, record: &AuditRecord) {
        if record.is_of_fleet() {
            push(&mut self.of_fleet, RECENT_OF_FLEET_MAX, record);
        }
        push(&mut self.all, RECENT_MAX, record);
    }

    /// Returns the last records.
    pub(super) fn all(&self) -> Vec<AuditRecord> {
        self.all.iter().cloned().collect()
    }

    /// Returns the last records about the keeping of the fleet.
    pub(super) fn of_fleet(&self) -> Vec<AuditRecord> {
        self.of_fleet.iter().cloned().collect()
    }
}

fn push(records: &mut VecDeque<AuditRecord>, most: usize, record: &AuditRecord) {
    if records.len() >= most {
        records.pop_front();
    }
    records.push_back(record.clone());
}

#[cfg(test)]
mod tests {
    use sgc_wire::{Name, NodeId};

    use super::*;
    use crate::audit::AuditEvent;

    #[test]
    fn links_displace_no_record_about_the_fleet() {
        let mut recent = Recent::default();
        let peer = NodeId([7; 32]);
        recent.push(&AuditRecord::new(AuditEvent::Operation).peer(&peer).reason("revoke arm: done"));
        // A share that is refused is no business of observers of an authority.
        recent.push(&AuditRecord::new(AuditEvent::Refused).name(&Name([1; 32])).peer(&peer));
        for n in 0..RECENT_MAX {
            recent.push(&AuditRecord::new(AuditEvent::LinkUp).reason(n));
        }
        assert_eq!(recent.all().len(), RECENT_MAX);
        assert_eq!(recent.all()[0].reason.as_deref(), Some("0"));
        let of_fleet: Vec<_> = recent.of_fleet().into_iter().map(|record| record.event).collect();
        assert_eq!(of_fleet, ["operation"]);
        for n in 0..=RECENT_OF_FLEET_MAX {
            recent.push(&AuditRecord::new(AuditEvent::Refused).peer(&peer).reason(n));
        }
        let of_fleet = recent.of_fleet();
        assert_eq!((of_fleet.len(), of_fleet[0].reason.as_deref()), (RECENT_OF_FLEET_MAX, Some("1")));
    }
}
