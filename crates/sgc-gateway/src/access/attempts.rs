//! Counts failed tokens by address, so that an address cannot guess tokens or keep this node busy with signature
//! checks.
//!
//! The table is bounded. An attacker with many addresses can only make it forget other addresses.

use std::collections::BTreeMap;
use std::net::IpAddr;
use std::time::Duration;

use sgc_trust::AddressPrefix;
use sgc_wire::UnixMillis;

/// Most tokens of one address that may fail within [`WINDOW_MS`].
pub(super) const FAILURES_MAX: u32 = 10;
/// Time for which failures count, in milliseconds.
pub(super) const WINDOW_MS: u64 = 60_000;
/// Most addresses in the table.
pub(super) const ADDRESSES_MAX: usize = 1024;

/// Failures by address. IPv6 failures count by /64 network, because one host owns all addresses of such a network.
#[derive(Debug, Default)]
pub(super) struct Attempts {
    of: BTreeMap<AddressPrefix, Failures>,
}

#[derive(Debug)]
struct Failures {
    count: u32,
    since: UnixMillis,
}

impl Attempts {
    /// Returns the time until a token of this address may be checked; `None` if it may be now.
    pub(super) fn wait(&mut self, address: IpAddr, now: UnixMillis) -> Option<Duration> {
        let key = AddressPrefix::from(address);
        let Failures { count, since } = self.of.get(&key)?;
        // A clock that was set back must not lock an address out.
        let left = match now.0.checked_sub(since.0) {
            Some(age) if age < WINDOW_MS => WINDOW_MS - age,
            _ => {
                self.of.remove(&key);
                return None;
            }
        };
        (*count >= FAILURES_MAX).then(|| Duration::from_millis(left))
    }

    /// Counts a failed token of this address.
    pub(super) fn fail(&mut self, address: IpAddr, now: UnixMillis) {
        let key = AddressPrefix::from(address);
        if !self.of.contains_key(&key) && self.of.len() >= ADDRESSES_MAX {
            let oldest = self.of.iter().min_by_key(|(_, failures)| failures.since).map(|(key, _)| *key);
            oldest.map(|oldest| self.of.remove(&oldest));
        }
        let failures = self.of.entry(key).or_insert(Failures { count: 0, since: now });
        failures.count = failures.count.saturating_add(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NOW: UnixMillis = UnixMillis(1_795_000_000_000);

    fn address(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    #[test]
    fn an_address_that_fails_often_waits_and_others_do_not() {
        let mut attempts = Attempts::default();
        let (bad, other) = (address("10.0.0.66"), address("10.0.0.7"));
        for _ in 0..FAILURES_MAX {
            assert_eq!(attempts.wait(bad, NOW), None);
            attempts.fail(bad, NOW);
        }
        let later = UnixMillis(NOW.0 + 20_000);
        assert_eq!(attempts.wait(bad, later), Some(Duration::from_secs(40)));
        assert_eq!(attempts.wait(address("::ffff:10.0.0.66"), later), Some(Duration::from_secs(40)));
        assert_eq!(attempts.wait(other, later), None);
        assert_eq!(attempts.wait(bad, UnixMillis(NOW.0 + WINDOW_MS)), None);
        assert_eq!(attempts.wait(bad, NOW), None, "what is over is forgotten");
    }

    #[test]
    fn a_host_with_many_addresses_is_one() {
        let mut attempts = Attempts::default();
        (0..FAILURES_MAX).for_each(|n| attempts.fail(address(&format!("2001:db8::{n}")), NOW));
        assert!(attempts.wait(address("2001:db8::ffff"), NOW).is_some());
        assert_eq!(attempts.wait(address("2001:db8:0:1::1"), NOW), None);
    }

    #[test]
    fn remembered_addresses_are_bounded() {
        let mut attempts = Attempts::default();
        for n in 0..2 * ADDRESSES_MAX as u32 {
            attempts.fail(IpAddr::V4(n.into()), UnixMillis(NOW.0 + u64::from(n)));
        }
        assert_eq!(attempts.of.len(), ADDRESSES_MAX);
        assert!(!attempts.of.contains_key(&address("0.0.0.0").into()));
    }
}
