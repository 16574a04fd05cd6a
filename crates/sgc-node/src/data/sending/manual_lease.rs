//! Leases of publishers that assert their liveliness manually.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use std::time::{Duration, Instant};

use sgc_wire::{Liveliness, Qos};

/// Shortest lease of a publisher whose assertions are watched. With a shorter one, only messages count.
pub(crate) const ASSERTED_LEASE_MIN: Duration = Duration::from_millis(100);

/// Looks per lease.
pub(crate) const LOOKS_PER_LEASE: u32 = 4;

/// Longest interval of looks. The loss of a publisher is noticed that much later.
pub(crate) const ASSERTION_LOOK_MAX: Duration = Duration::from_millis(250);

/// Lease of a publisher that asserts its liveliness manually.
#[derive(Debug)]
pub(crate) struct ManualLease {
    lease: Duration,
    began: Instant,
    /// Time at which other networks last heard of it, nanoseconds since its beginning.
    heard_ns: AtomicI64,
}

impl ManualLease {
    /// Returns the lease if its assertions have to be watched.
    pub(crate) fn from_qos(qos: &Qos, now: Instant) -> Option<Arc<Self>> {
        let lease = Duration::from_nanos(qos.lease_ns?);
        let is_manual = qos.liveliness == Liveliness::ManualByTopic && qos.is_reliable();
        (is_manual && lease >= ASSERTED_LEASE_MIN)
            .then(|| Arc::new(Self { lease, began: now, heard_ns: AtomicI64::new(i64::MIN) }))
    }

    /// Returns `true` if it is the lease of this offer.
    pub(crate) fn is_of(&self, qos: &Qos) -> bool {
        Self::from_qos(qos, self.began).is_some_and(|lease| lease.lease == self.lease)
    }

    /// Returns the interval of looks.
    pub(crate) fn look_every(&self) -> Duration {
        (self.lease / LOOKS_PER_LEASE).min(ASSERTION_LOOK_MAX)
    }

    /// Notes that other networks hear of the publisher, by a message or a mark.
    pub(crate) fn note_heard(&self, now: Instant) {
        self.heard_ns.fetch_max(self.since_began_ns(now, Duration::ZERO), Relaxed);
    }

    /// Returns `true` if the lease was renewed `ago`, and other networks have heard nothing since.
    pub(crate) fn is_news(&self, now: Instant, ago: Duration) -> bool {
        ago < self.lease && self.since_began_ns(now, ago) > self.heard_ns.load(Relaxed)
    }

    fn since_began_ns(&self, now: Instant, ago: Duration) -> i64 {
        let ns = |duration: Duration| i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX);
        ns(now.saturating_duration_since(self.began)).saturating_sub(ns(ago))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn manual(lease_ms: u64) -> Qos {
        let lease_ns = Some(lease_ms * 1_000_000);
        Qos { liveliness: Liveliness::ManualByTopic, lease_ns, ..Qos::default() }
    }

    #[test]
    fn renewed_lease_is_news_until_other_networks_have_heard_of_it_or_it_ran_out() {
        let began = Instant::now();
        let at = |ms| began + Duration::from_millis(ms);
        let ago = Duration::from_millis;
        let lease = ManualLease::from_qos(&manual(2000), began).unwrap();
        assert!(lease.is_news(at(100), ago(50)));
        assert!(lease.is_news(at(100), ago(500)), "it was there before it was known here");
        assert!(!lease.is_news(at(100), ago(2000)));
        lease.note_heard(at(100));
        assert!(!lease.is_news(at(300), ago(200)) && lease.is_news(at(300), ago(199)));
        // A message after the look is an example.
        lease.note_heard(at(310));
        lease.note_heard(at(300));
        assert!(!lease.is_news(at(310), ago(5)) && lease.is_news(at(320), ago(5)));
    }

    #[test]
    fn leases_that_are_automatic_short_endless_or_best_effort_are_not_looked_at() {
        let now = Instant::now();
        let is_looked_at = |qos: Qos| ManualLease::from_qos(&qos, now).is_some();
        assert!(is_looked_at(manual(100)) && !is_looked_at(manual(99)));
        assert!(!is_looked_at(Qos { lease_ns: None, ..manual(2000) }));
        assert!(!is_looked_at(Qos { reliability: sgc_wire::Reliability::BestEffort, ..manual(2000) }));
        for liveliness in [Liveliness::Automatic, Liveliness::ManualByParticipant] {
            assert!(!is_looked_at(Qos { liveliness, ..manual(2000) }));
        }
        let every = |lease_ms| ManualLease::from_qos(&manual(lease_ms), now).map(|lease| lease.look_every());
        assert_eq!([100, 60_000].map(every), [25, 250].map(|ms| Some(Duration::from_millis(ms))));
    }
}
