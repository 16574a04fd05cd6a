//! Log entries for events that strangers cause: the first of each kind and address, then a count.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use super::prefix::AddressPrefix;

/// Time over which repeated events are counted into one line.
pub const REPEAT_WINDOW: Duration = Duration::from_secs(10);
/// Most pairs of an address and a kind that are told apart. Events of others are counted together.
pub const REPEAT_SOURCES_MAX: usize = 64;

/// Events within the last [`REPEAT_WINDOW`], by address and kind `K`.
///
/// The caller logs the first event of a pair. Later ones within the window are counted, and so are those in the next
/// windows, until one passes without any. So a flood writes at most [`REPEAT_SOURCES_MAX`] lines, a line for each of
/// their windows, and one for all other addresses.
#[derive(Debug)]
pub struct Repeats<K> {
    sources: BTreeMap<(AddressPrefix, K), Window>,
    others: Option<Window>,
}

#[derive(Clone, Copy, Debug)]
struct Window {
    since: Instant,
    count: u64,
}

/// Events that were counted instead of logged.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RepeatCount<K> {
    /// The address and the kind; `None` stands for all addresses that were not told apart.
    pub source: Option<(AddressPrefix, K)>,
    /// Number of events.
    pub count: u64,
    /// The time in which they came.
    pub within: Duration,
}

impl<K> Default for Repeats<K> {
    fn default() -> Self {
        Self { sources: BTreeMap::new(), others: None }
    }
}

impl<K: Ord + Copy> Repeats<K> {
    /// Counts an event. Returns `true` if the caller has to log it by itself.
    pub fn note(&mut self, prefix: AddressPrefix, kind: K, now: Instant) -> bool {
        if let Some(window) = self.sources.get_mut(&(prefix, kind)) {
            window.count += 1;
            return false;
        }
        if self.sources.len() < REPEAT_SOURCES_MAX {
            self.sources.insert((prefix, kind), Window { since: now, count: 0 });
            return true;
        }
        self.others.get_or_insert(Window { since: now, count: 0 }).count += 1;
        false
    }

    /// Returns the time of the next [`Self::take_due`].
    pub fn due(&self) -> Option<Instant> {
        self.sources.values().chain(&self.others).map(|window| window.since + REPEAT_WINDOW).min()
    }

    /// Returns the counts of the windows that have ended, and forgets quiet addresses.
    pub fn take_due(&mut self, now: Instant) -> Vec<RepeatCount<K>> {
        let mut all = Vec::new();
        let mut end = |window: &mut Window, source| {
            let within = now.saturating_duration_since(window.since);
            if within < REPEAT_WINDOW {
                return true;
            }
            let count = std::mem::take(&mut window.count);
            window.since = now;
            if count > 0 {
                all.push(RepeatCount { source, count, within });
            }
            count > 0
        };
        self.sources.retain(|source, window| end(window, Some(*source)));
        if let Some(window) = &mut self.others
            && !end(window, None)
        {
            self.others = None;
        }
        all
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};

    use super::*;

    fn host(number: u32) -> AddressPrefix {
        IpAddr::V4(Ipv4Addr::from_bits(0x0a00_0000 + number)).into()
    }

    fn start() -> Instant {
        #[allow(clippy::disallowed_methods)]
        Instant::now()
    }

    #[test]
    fn a_flood_of_one_address_is_one_line_and_a_count_for_each_window() {
        let (mut repeats, start) = (Repeats::default(), start());
        let said = (0..1000).filter(|_| repeats.note(host(1), 'x', start)).count();
        assert_eq!(said, 1);
        assert!(repeats.note(host(1), 'y', start), "another kind is news");
        assert!(repeats.note(host(2), 'x', start), "so is another address");
        assert_eq!(repeats.due(), Some(start + REPEAT_WINDOW));
        assert_eq!(repeats.take_due(start + REPEAT_WINDOW / 2), []);
        let end = start + REPEAT_WINDOW;
        let counted = RepeatCount { source: Some((host(1), 'x')), count: 999, within: REPEAT_WINDOW };
        assert_eq!(repeats.take_due(end), [counted]);
        assert!(!repeats.note(host(1), 'x', end), "it goes on, and is still counted");
        assert!(repeats.note(host(2), 'x', end), "what had ended is news again");
        let counted = RepeatCount { count: 1, ..counted };
        assert_eq!(repeats.take_due(end + REPEAT_WINDOW), [counted]);
        assert_eq!(repeats.take_due(end + 2 * REPEAT_WINDOW), []);
        assert_eq!(repeats.due(), None, "nothing is kept of it");
    }

    #[test]
    fn a_flood_from_many_addresses_is_bounded_in_lines_and_memory() {
        let (mut repeats, start) = (Repeats::default(), start());
        let said = (0..100_000).filter(|n| repeats.note(host(*n), 'x', start)).count();
        assert_eq!(said, REPEAT_SOURCES_MAX);
        assert_eq!(repeats.sources.len(), REPEAT_SOURCES_MAX);
        let count = 100_000 - REPEAT_SOURCES_MAX as u64;
        let counted = RepeatCount { source: None, count, within: REPEAT_WINDOW };
        assert_eq!(repeats.take_due(start + REPEAT_WINDOW), [counted]);
        assert!(repeats.note(host(1), 'x', start + REPEAT_WINDOW), "and then there is room again");
    }
}
