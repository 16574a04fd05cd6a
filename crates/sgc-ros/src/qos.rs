//! QoS of several local writers as one offer, and the reader that matches them all.

use std::collections::BTreeSet;

use sgc_wire::{History, Liveliness, Qos, Reliability};

/// Fewest samples that a reliable reader of ours keeps: a moment without the processor must not lose what
/// the network would have carried.
pub const RELIABLE_READER_DEPTH_MIN: u32 = 32;

/// What a set of writers offers together: of each policy the weakest, so that every reader that matches the
/// result would have matched each of them; of depth and lifespan the longest, of partitions all.
pub fn weakest<'a>(offers: impl IntoIterator<Item = &'a Qos>) -> Option<Qos> {
    let mut offers = offers.into_iter();
    let mut all = offers.next()?.clone();
    let mut partitions: BTreeSet<String> = all.partitions.drain(..).collect();
    for q in offers {
        all.reliability = all.reliability.min(q.reliability);
        all.durability = all.durability.min(q.durability);
        all.history = match (all.history, q.history) {
            (History::KeepLast(a), History::KeepLast(b)) => History::KeepLast(a.max(b)),
            _ => History::KeepAll,
        };
        all.deadline_ns = longest(all.deadline_ns, q.deadline_ns);
        all.lifespan_ns = longest(all.lifespan_ns, q.lifespan_ns);
        all.lease_ns = longest(all.lease_ns, q.lease_ns);
        all.liveliness = match (all.liveliness, q.liveliness) {
            (Liveliness::Automatic, _) | (_, Liveliness::Automatic) => Liveliness::Automatic,
            (Liveliness::ManualByTopic, other) | (other, Liveliness::ManualByTopic) => other,
            (same, _) => same,
        };
        partitions.extend(q.partitions.iter().cloned());
    }
    all.partitions = partitions.into_iter().take(Qos::PARTITIONS_MAX).collect();
    Some(all)
}

/// What a reader must request to match every writer behind `offer` and to lose nothing they keep.
/// `writers` is how many there are: each one's history has to fit.
pub fn reader_for(offer: &Qos, writers: usize) -> Qos {
    let several = if offer.is_transient_local() { writers.clamp(1, 1000) as u32 } else { 1 };
    let history = match offer.history {
        History::KeepAll => History::KeepAll,
        History::KeepLast(n) if offer.reliability == Reliability::Reliable => {
            History::KeepLast(n.saturating_mul(several).max(RELIABLE_READER_DEPTH_MIN))
        }
        History::KeepLast(n) => History::KeepLast(n.saturating_mul(several)),
    };
    Qos {
        reliability: offer.reliability,
        durability: offer.durability,
        history,
        partitions: offer.partitions.clone(),
        ..Qos::default()
    }
}

fn longest(a: Option<u64>, b: Option<u64>) -> Option<u64> {
    a.zip(b).map(|(a, b)| a.max(b))
}

#[cfg(test)]
mod tests {
    use sgc_wire::Durability;

    use super::*;

    #[test]
    fn a_reader_of_the_weakest_offer_matches_every_writer() {
        let strong = Qos {
            durability: Durability::TransientLocal,
            history: History::KeepLast(1),
            deadline_ns: Some(5),
            lifespan_ns: Some(9),
            liveliness: Liveliness::ManualByTopic,
            partitions: vec!["b".into()],
            ..Qos::default()
        };
        let weak = Qos {
            reliability: Reliability::BestEffort,
            history: History::KeepLast(7),
            partitions: vec!["a".into()],
            ..Qos::default()
        };
        assert_eq!(weakest([&strong]), Some(strong.clone()));
        let both = weakest([&strong, &weak]).unwrap();
        assert_eq!(both, Qos { partitions: vec!["a".into(), "b".into()], ..weak });
        assert_eq!(weakest([]), None);
    }

    #[test]
    fn readers_have_room_for_every_writers_history() {
        let latched =
            Qos { durability: Durability::TransientLocal, history: History::KeepLast(40), ..Qos::default() };
        assert_eq!(reader_for(&latched, 5).history, History::KeepLast(200));
        assert_eq!(reader_for(&Qos::default(), 5).history, History::KeepLast(RELIABLE_READER_DEPTH_MIN));
        let sensor = Qos {
            reliability: Reliability::BestEffort,
            history: History::KeepLast(5),
            deadline_ns: Some(1),
            ..Qos::default()
        };
        let reader = reader_for(&sensor, 1);
        assert_eq!((reader.history, reader.deadline_ns), (History::KeepLast(5), None));
    }
}
