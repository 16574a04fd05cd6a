//! Quotas for the records that peers can cause in the audit log.
//!
//! A peer decides itself how often it joins, leaves and connects, so each cause of records has an hourly quota. Quotas
//! are separate for each event and name: a peer cannot hide one topic behind another, nor a refusal behind joins.
//! Records beyond a quota are counted, and one summary of them is written when their hour ends, so nothing is omitted
//! without a trace.
//!
//! The clock is an argument: the time of the records.

use std::collections::BTreeMap;

use sgc_trust::AddressPrefix;
use sgc_wire::{Name, NodeId};

use super::record::{AuditEvent, AuditRecord, Cause};

/// The period of all quotas, milliseconds.
const HOUR_MS: u64 = 3_600_000;
/// Records an hour of one event of one peer about one name.
const NAME_RECORDS_MAX: u32 = 8;
/// Records an hour of one event of one peer about no name.
const PEER_RECORDS_MAX: u32 = 32;
/// Records an hour of one event of one address with unknown peers.
const ADDRESS_RECORDS_MAX: u32 = 16;
/// Records an hour of one event of all addresses with unknown peers.
const STRANGERS_RECORDS_MAX: u32 = 256;
/// Records an hour of one event that no peer causes, such as a new revocation list.
const FLEET_RECORDS_MAX: u32 = 64;
/// Records an hour of one event of all peers without room for a quota of their own.
const CROWD_RECORDS_MAX: u32 = 4096;
/// Most quotas at one time. Each takes about a hundred bytes per peer, event and name of the last hour.
const QUOTAS_MAX: usize = 16_384;
/// Shortest time between two searches for quotas whose hour has ended, milliseconds.
const SWEEP_MS: u64 = 1000;

/// The holder of a quota.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Holder {
    Peer(NodeId),
    /// A host, identified by its address.
    Host(AddressPrefix),
    Strangers,
    Fleet,
    Crowd,
}

type Key = (Holder, AuditEvent, Option<Name>);

/// The quotas of all causes.
#[derive(Debug, Default)]
pub(super) struct Quotas {
    quotas: BTreeMap<Key, Quota>,
    swept_ms: u64,
    left_out: u64,
}

/// The records of one holder in one hour.
#[derive(Debug, Default)]
struct Quota {
    begun_ms: u64,
    written: u32,
    left_out: u64,
    /// Time of the first omitted record.
    first: Option<String>,
    /// The last omitted record.
    last: Option<Box<AuditRecord>>,
}

impl Quotas {
    /// Adds to `lines` the record, if its quota permits, and the summaries that are due.
    pub(super) fn handle(&mut self, record: AuditRecord, lines: &mut Vec<AuditRecord>) {
        let Some(event) = record.kind else { return lines.push(record) };
        let now_ms = record.unix_ms;
        let key = match record.cause {
            Cause::Local => return lines.push(record),
            Cause::Fleet => (Holder::Fleet, event, None),
            Cause::Peer(peer) => (Holder::Peer(peer), event, record.about),
            Cause::Address(address) => (Holder::Host(address.into()), event, None),
        };
        let strangers = (Holder::Strangers, event, None);
        let is_stranger = matches!(record.cause, Cause::Address(_));
        if is_stranger {
            let all = self.quota(strangers, now_ms, lines);
            if !all.has_room(STRANGERS_RECORDS_MAX) {
                all.leave_out(record);
                self.left_out += 1;
                return;
            }
        }
        let key = self.place(key, now_ms, lines);
        let quota = self.quota(key, now_ms, lines);
        if !quota.has_room(key.0.records_max(key.2.is_some())) {
            quota.leave_out(record);
            self.left_out += 1;
            return;
        }
        quota.written += 1;
        if is_stranger {
            // Only written records count, so that one address does not use up the common quota.
            self.quota(strangers, now_ms, lines).written += 1;
        }
        lines.push(record);
    }

    /// Adds to `lines` the summaries of all quotas whose hour has ended by `now_ms`.
    pub(super) fn sweep(&mut self, now_ms: u64, lines: &mut Vec<AuditRecord>) {
        self.swept_ms = now_ms;
        self.quotas.retain(|(holder, ..), quota| {
            let ends = quota.ends(now_ms);
            if ends {
                lines.extend(quota.summary(*holder));
            }
            !ends
        });
    }

    /// Adds to `lines` the summaries of all quotas.
    pub(super) fn finish(&mut self, lines: &mut Vec<AuditRecord>) {
        let quotas = std::mem::take(&mut self.quotas);
        lines.extend(quotas.into_iter().filter_map(|((holder, ..), mut quota)| quota.summary(holder)));
    }

    /// Returns the number of records that were counted instead of written.
    pub(super) fn left_out(&self) -> u64 {
        self.left_out
    }

    /// Returns the key itself, or that of the crowd if there is no room for another.
    fn place(&mut self, key: Key, now_ms: u64, lines: &mut Vec<AuditRecord>) -> Key {
        let has_room = |quotas: &BTreeMap<Key, Quota>| quotas.len() < QUOTAS_MAX || quotas.contains_key(&key);
        if has_room(&self.quotas) {
            return key;
        }
        if now_ms.abs_diff(self.swept_ms) >= SWEEP_MS {
            self.sweep(now_ms, lines);
        }
        if has_room(&self.quotas) { key } else { (Holder::Crowd, key.1, None) }
    }

    fn quota(&mut self, key: Key, now_ms: u64, lines: &mut Vec<AuditRecord>) -> &mut Quota {
        let quota = self.quotas.entry(key).or_insert_with(|| Quota { begun_ms: now_ms, ..Quota::default() });
        if quota.ends(now_ms) {
            lines.extend(quota.summary(key.0));
            *quota = Quota { begun_ms: now_ms, ..Quota::default() };
        }
        quota
    }
}

impl Holder {
    fn records_max(self, has_name: bool) -> u32 {
        match self {
            Self::Peer(_) if has_name => NAME_RECORDS_MAX,
            Self::Peer(_) => PEER_RECORDS_MAX,
            Self::Host(_) => ADDRESS_RECORDS_MAX,
            Self::Strangers => STRANGERS_RECORDS_MAX,
            Self::Fleet => FLEET_RECORDS_MAX,
            Self::Crowd => CROWD_RECORDS_MAX,
        }
    }
}

impl Quota {
    /// Returns `true` if the hour is over, or lies in the future because the clock was set back.
    fn ends(&self, now_ms: u64) -> bool {
        now_ms.checked_sub(self.begun_ms).is_none_or(|age| age >= HOUR_MS)
    }

    fn has_room(&self, max: u32) -> bool {
        self.written < max
    }

    fn leave_out(&mut self, record: AuditRecord) {
        self.left_out += 1;
        self.first.get_or_insert_with(|| record.time.clone());
        self.last = Some(Box::new(record));
    }

    /// Returns a summary of the omitted records: the last of them, with their number.
    fn summary(&mut self, holder: Holder) -> Option<AuditRecord> {
        let last = *self.last.take()?;
        let mut summary = AuditRecord {
            event: AuditEvent::Summary.label().to_owned(),
            of: Some(last.event.clone()),
            count: Some(std::mem::take(&mut self.left_out)),
            from: self.first.take(),
            ..last
        };
        if matches!(holder, Holder::Strangers | Holder::Crowd) {
            // The records belong to many peers, so the last one's details would mislead.
            (summary.peer, summary.peer_name, summary.remote, summary.reason) = (None, None, None, None);
            (summary.topic, summary.name, summary.epoch) = (None, None, None);
            summary.by = Some("many".to_owned());
        }
        Some(summary)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use sgc_wire::UnixMillis;

    const NOW: u64 = 1_795_000_000_000;

    fn joined(peer: u64, name: u8, unix_ms: u64) -> AuditRecord {
        let mut id = [0; 32];
        id[..8].copy_from_slice(&peer.to_be_bytes());
        AuditRecord::at(AuditEvent::Granted, UnixMillis(unix_ms)).name(&Name([name; 32])).peer(&NodeId(id))
    }

    fn count(lines: &[AuditRecord], event: AuditEvent) -> usize {
        lines.iter().filter(|line| line.kind == Some(event) && line.of.is_none()).count()
    }

    fn summed(lines: &[AuditRecord]) -> u64 {
        lines.iter().filter_map(|line| line.count).sum()
    }

    #[test]
    fn an_hour_has_its_quota_and_its_summary() {
        let (mut quotas, mut lines) = (Quotas::default(), Vec::new());
        for at in 0..100 {
            quotas.handle(joined(1, 1, NOW + at), &mut lines);
        }
        assert_eq!((lines.len(), quotas.left_out()), (8, 92));
        quotas.handle(joined(1, 1, NOW + HOUR_MS), &mut lines);
        let summary = &lines[8];
        assert_eq!((summary.event.as_str(), summary.of.as_deref()), ("summary", Some("granted")));
        assert_eq!((summary.count, summary.unix_ms), (Some(92), NOW + 99));
        assert_eq!(summary.from.as_deref(), Some(&*UnixMillis(NOW + 8).to_string()));
        assert_eq!(
            (summary.peer.as_ref(), summary.name.as_ref()),
            (lines[0].peer.as_ref(), lines[0].name.as_ref())
        );
        assert_eq!(lines.len(), 10, "and the next hour begins");
        // A clock that was set back silences nobody for as long.
        quotas.handle(joined(1, 1, NOW), &mut lines);
        assert_eq!(lines.len(), 11);
        let mut rest = Vec::new();
        quotas.sweep(NOW + HOUR_MS, &mut rest);
        quotas.finish(&mut rest);
        assert!(rest.is_empty() && quotas.quotas.is_empty());
    }

    #[test]
    fn a_flood_hides_neither_another_topic_nor_another_event_nor_another_peer() {
        let (mut quotas, mut lines) = (Quotas::default(), Vec::new());
        (0..10_000).for_each(|_| quotas.handle(joined(1, 1, NOW), &mut lines));
        lines.clear();
        quotas.handle(joined(1, 2, NOW), &mut lines);
        quotas.handle(joined(2, 1, NOW), &mut lines);
        let revoked = AuditRecord::at(AuditEvent::Revoked, UnixMillis(NOW));
        quotas.handle(revoked.peer(&NodeId([1; 32])).name(&Name([1; 32])), &mut lines);
        (0..1000)
            .for_each(|_| quotas.handle(AuditRecord::at(AuditEvent::Reload, UnixMillis(NOW)), &mut lines));
        assert_eq!(lines.len(), 1003);
    }

    #[test]
    fn strangers_are_limited_by_network_and_together() {
        let (mut quotas, mut lines) = (Quotas::default(), Vec::new());
        let mut refused = |address: &str, lines: &mut Vec<AuditRecord>| {
            let record = AuditRecord::at(AuditEvent::LinkRefused, UnixMillis(NOW));
            quotas.handle(record.remote(address.parse().unwrap()), lines);
        };
        (0..100).for_each(|host| refused(&format!("[2001:db8::{host:x}]:1"), &mut lines));
        assert_eq!(count(&lines, AuditEvent::LinkRefused), 16, "all of one /64");
        refused("[2001:db8:0:1::1]:1", &mut lines);
        refused("10.0.0.1:1", &mut lines);
        assert_eq!(count(&lines, AuditEvent::LinkRefused), 18);
        lines.clear();
        (0..10_000).for_each(|n| refused(&format!("10.1.{}.{}:1", n / 256, n % 256), &mut lines));
        assert_eq!(count(&lines, AuditEvent::LinkRefused), 256 - 18);
        quotas.finish(&mut lines);
        assert_eq!(summed(&lines), 84 + 10_000 - 238);
        let together = lines.iter().find(|line| line.by.as_deref() == Some("many")).unwrap();
        assert_eq!((together.remote.as_ref(), together.count), (None, Some(10_000 - 238)));
    }

    #[test]
    fn quotas_are_bounded_and_a_crowd_is_counted() {
        let (mut quotas, mut lines) = (Quotas::default(), Vec::new());
        let peers = QUOTAS_MAX as u64 + 10_000;
        (0..peers).for_each(|peer| quotas.handle(joined(peer, 1, NOW), &mut lines));
        assert!(quotas.quotas.len() <= QUOTAS_MAX + AuditEvent::ALL.len());
        assert_eq!(lines.len() as u64 + quotas.left_out(), peers);
        // Room returns with time.
        lines.clear();
        quotas.handle(joined(peers, 1, NOW + HOUR_MS), &mut lines);
        assert_eq!(summed(&lines), quotas.left_out());
        assert_eq!(quotas.quotas.len(), 1);
    }
}
