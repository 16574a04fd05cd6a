//! A window over a source's sequence numbers, which accepts each message once.

/// Messages that may arrive behind the newest and still be told from replays.
pub const REPLAY_WINDOW: u64 = 1024;

const WORDS: usize = (REPLAY_WINDOW / 64) as usize;

/// State of a sequence number in the window.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Freshness {
    /// Not seen yet.
    Fresh,
    /// Seen.
    Duplicate,
    /// Too far behind the newest to tell.
    TooOld,
}

/// The seen sequence numbers of one source (the idea of RFC 4303, 3.4.3). Numbers start at 1.
#[derive(Clone, Debug, Default)]
pub struct ReplayWindow {
    newest: u64,
    seen: [u64; WORDS],
}

impl ReplayWindow {
    /// Returns the state of `seq`, without marking it.
    pub fn check(&self, seq: u64) -> Freshness {
        if seq > self.newest {
            Freshness::Fresh
        } else if seq == 0 || self.newest - seq >= REPLAY_WINDOW {
            Freshness::TooOld
        } else if self.seen[word(seq)] & bit(seq) != 0 {
            Freshness::Duplicate
        } else {
            Freshness::Fresh
        }
    }

    /// Marks `seq` as seen and returns its state before.
    pub fn accept(&mut self, seq: u64) -> Freshness {
        let freshness = self.check(seq);
        if freshness == Freshness::Fresh {
            if seq > self.newest {
                self.advance(seq);
            }
            self.seen[word(seq)] |= bit(seq);
        }
        freshness
    }

    /// Returns the newest number seen; 0 before any.
    pub fn newest(&self) -> u64 {
        self.newest
    }

    /// Forgets the numbers whose places `newest + 1 ..= seq` take over.
    fn advance(&mut self, seq: u64) {
        if seq - self.newest >= REPLAY_WINDOW {
            self.seen = [0; WORDS];
        } else {
            for n in self.newest + 1..=seq {
                self.seen[word(n)] &= !bit(n);
            }
        }
        self.newest = seq;
    }
}

fn word(seq: u64) -> usize {
    (seq / 64) as usize % WORDS
}

fn bit(seq: u64) -> u64 {
    1 << (seq % 64)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{RngCore, SeedableRng};

    use super::*;

    #[test]
    fn agrees_with_a_set_on_random_orders() {
        for seed in 0..50 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (mut window, mut set, mut base) = (ReplayWindow::default(), BTreeSet::new(), 1u64);
            for _ in 0..3000 {
                base += u64::from(rng.next_u32() % 3 == 0) * (1 + u64::from(rng.next_u32() % 40));
                let seq = base.saturating_sub(u64::from(rng.next_u32() % 1500)).max(1);
                let newest = set.last().copied().unwrap_or(0);
                let expected = match (set.contains(&seq), newest.saturating_sub(seq) >= REPLAY_WINDOW) {
                    (_, true) => Freshness::TooOld,
                    (true, false) => Freshness::Duplicate,
                    (false, false) => Freshness::Fresh,
                };
                assert_eq!(window.accept(seq), expected, "seed {seed}, {seq} behind {newest}");
                if expected == Freshness::Fresh {
                    set.insert(seq);
                }
            }
        }
    }

    #[test]
    fn the_greatest_number_is_no_trap() {
        let mut window = ReplayWindow::default();
        assert_eq!(window.accept(0), Freshness::TooOld);
        assert_eq!(window.accept(u64::MAX), Freshness::Fresh);
        assert_eq!(window.accept(u64::MAX), Freshness::Duplicate);
        assert_eq!(window.accept(5), Freshness::TooOld);
    }
}
