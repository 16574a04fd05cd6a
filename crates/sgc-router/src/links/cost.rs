//! The cost of a link, and how much costs have to differ before neighbours learn of it.

use std::time::{Duration, Instant};

use super::loss::Loss;
use super::quality::LinkQuality;

/// Cost of every link besides its round trip: of equally quick routes, the one with fewer links is better.
const COST_OF_LINK: u32 = 1000;
/// Cost of a link whose round trip is not known.
const COST_UNKNOWN: u32 = 10_000;
/// Further cost of a link that seems dead: it serves only where there is no other route.
pub(crate) const COST_SUSPECT: u32 = 1 << 28;
/// A measured round trip counts once it has differed by a quarter and by this from the present one.
const COST_CHANGE_MIN: u32 = 2000;
/// Time for which it must have differed.
const COST_CHANGE_AFTER: Duration = Duration::from_secs(5);
/// A cost that differs by less than a quarter is not announced anew, and a direct link costs a quarter less.
const COST_PART: u32 = 4;

/// Returns `true` if a neighbour that was told `old` has to be told `new`.
pub(crate) fn cost_differs(old: u32, new: u32) -> bool {
    old.abs_diff(new) > old.min(new) / COST_PART
}

/// The cost of a link: a configured figure, or its round trip, damped so that jitter does not change it.
#[derive(Debug)]
pub(crate) struct Cost {
    set: Option<u32>,
    /// Smoothed round trip, microseconds.
    smoothed: Option<u32>,
    /// The round trip that counts.
    counts: Option<u32>,
    /// Time since which the smoothed one differs much.
    differs_since: Option<Instant>,
    /// Set while nothing at all arrives over the link.
    suspect: bool,
    /// Set for a direct link, which is taken unless it is clearly worse than a path over routers.
    direct: Option<Loss>,
}

impl Cost {
    pub(crate) fn new(set: Option<u32>) -> Self {
        Self { set, smoothed: None, counts: None, differs_since: None, suspect: false, direct: None }
    }

    /// Returns the cost of a direct link.
    pub(crate) fn of_direct_link() -> Self {
        Self { direct: Some(Loss::default()), ..Self::new(None) }
    }

    /// Returns the present cost.
    pub(crate) fn now(&self) -> u32 {
        let measured = || self.counts.map_or(COST_UNKNOWN, |rtt| rtt.saturating_add(COST_OF_LINK));
        let cost = self.set.unwrap_or_else(measured);
        let cost = if self.direct.is_some() { cost - cost / COST_PART } else { cost };
        let cost = cost.saturating_add(self.of_loss());
        if self.suspect { cost.saturating_add(COST_SUSPECT) } else { cost }
    }

    /// Returns the part of the cost that is due to lost packets; 0 unless it is a direct link.
    pub(crate) fn of_loss(&self) -> u32 {
        let round_trip = self.counts.unwrap_or(COST_UNKNOWN).saturating_add(COST_OF_LINK);
        self.direct.as_ref().map_or(0, |loss| loss.cost(round_trip)).min(COST_SUSPECT / 2)
    }

    /// Returns `true` while nothing at all arrives over the link.
    pub(crate) fn is_suspect(&self) -> bool {
        self.suspect
    }

    /// Takes a measurement. Returns `true` if it changes the cost.
    pub(crate) fn measure(&mut self, now: Instant, quality: LinkQuality) -> bool {
        let LinkQuality { round_trip, is_silent, sent_packets, lost_packets } = quality;
        let before = self.now();
        self.suspect = is_silent;
        if let Some(loss) = &mut self.direct {
            loss.measure(now, sent_packets, lost_packets);
        }
        let rtt = u32::try_from(round_trip.as_micros()).unwrap_or(u32::MAX).min(COST_SUSPECT / 2);
        let smoothed = self.smoothed.map_or(rtt, |old| old - old / 8 + rtt / 8);
        self.smoothed = Some(smoothed);
        let counts = *self.counts.get_or_insert(smoothed);
        if smoothed.abs_diff(counts) <= (counts / 4).max(COST_CHANGE_MIN) {
            self.differs_since = None;
        } else if now.saturating_duration_since(*self.differs_since.get_or_insert(now)) >= COST_CHANGE_AFTER {
            self.counts = Some(smoothed);
            self.differs_since = None;
        }
        self.now() != before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    impl Cost {
        fn measure_rtt(&mut self, now: Instant, round_trip: Duration, is_silent: bool) -> bool {
            self.measure(now, LinkQuality { round_trip, is_silent, ..LinkQuality::default() })
        }
    }

    #[test]
    fn jitter_does_not_move_a_cost_and_a_lasting_change_does() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut cost = Cost::new(None);
        assert_eq!(cost.now(), COST_UNKNOWN);
        assert!(cost.measure_rtt(start, ms(20), false));
        let first = cost.now();
        assert_eq!(first, 20_000 + COST_OF_LINK);
        for n in 0..600 {
            let rtt = ms([12, 30, 21, 19, 25, 14][n as usize % 6]);
            assert!(!cost.measure_rtt(start + ms(100 * n), rtt, false), "moved by jitter");
        }
        let later = start + ms(60_000);
        let moved = (0..600).find(|n| cost.measure_rtt(later + ms(100 * n), ms(60), false)).unwrap();
        assert!(moved * 100 >= 5000, "moved after {moved} tenths of a second");
        assert!(cost.now() > 2 * first && (0..600).all(|n| !cost.measure_rtt(later + ms(n), ms(60), false)));
    }

    #[test]
    fn direct_link_takes_over_from_a_path_of_the_same_round_trip_and_gives_way_to_a_clearly_better_one() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        for rtt in [1, 20, 300] {
            let mut direct = Cost::of_direct_link();
            direct.measure_rtt(start, ms(rtt), false);
            let mut relayed = Cost::new(None);
            relayed.measure_rtt(start, ms(rtt), false);
            assert!(direct.now() < relayed.now() && cost_differs(relayed.now(), direct.now()), "{rtt} ms");
        }
        let mut direct = Cost::of_direct_link();
        direct.measure_rtt(start, ms(100), false);
        let mut relayed = Cost::new(None);
        relayed.measure_rtt(start, ms(40), false);
        assert!(relayed.now() < direct.now() && cost_differs(direct.now(), relayed.now()));
        assert!(direct.measure_rtt(start, ms(100), true) && direct.now() > COST_SUSPECT);
    }

    #[test]
    fn direct_link_that_loses_a_fifth_gives_way_to_a_path_of_twice_its_round_trip() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut direct = Cost::of_direct_link();
        let mut relayed = Cost::new(None);
        for second in 0..10 {
            let lossy = LinkQuality {
                round_trip: ms(20),
                sent_packets: 100 * second,
                lost_packets: 20 * second,
                ..LinkQuality::default()
            };
            direct.measure(start + ms(1000 * second), lossy);
            relayed.measure(start + ms(1000 * second), LinkQuality { round_trip: ms(40), ..lossy });
        }
        assert_eq!(relayed.of_loss(), 0);
        assert!(relayed.now() < direct.now() && cost_differs(direct.now(), relayed.now()));
    }

    #[test]
    fn a_link_that_seems_dead_is_the_last_choice_and_a_set_cost_is_not_measured() {
        #[allow(clippy::disallowed_methods)]
        let start = Instant::now();
        let mut cost = Cost::new(Some(7));
        assert!(!cost.measure_rtt(start, ms(900), false));
        assert_eq!(cost.now(), 7);
        assert!(cost.measure_rtt(start, ms(900), true) && cost.now() == 7 + COST_SUSPECT);
        assert!(cost.measure_rtt(start, ms(900), false) && cost.now() == 7);
    }
}
