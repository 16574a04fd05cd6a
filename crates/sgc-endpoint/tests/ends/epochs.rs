//! Epochs, announcements, parking, and the results of replays.

use sgc_endpoint::{EPOCHS_MAX, PARKED_LOOKS_MAX, PARKED_PACKETS_MAX};
use sgc_trust::OpenError;

use super::*;

/// The suite of tests for which the suite makes no difference.
const SUITE: Suite = Suite::Standard;

fn grant_of(epoch: u32, sources: &[&Source]) -> TopicGrant {
    grant(SUITE, epoch, &announced(sources))
}

fn rekeyed(source: &mut Source, epoch: u32) -> Vec<Packet> {
    let mut packets = Vec::new();
    assert!(source.rekey(&grant(SUITE, epoch, &[]), |p| packets.push(p)));
    packets
}

#[test]
fn a_new_epoch_loses_nothing_whichever_comes_first() {
    for grant_first in [true, false] {
        let mut source = source(SUITE, 0);
        let mut sink = sink(SUITE, &[&source]);
        let mut packets = published(&mut source, bytes(1), false);
        published(&mut source, bytes(2), true);
        packets.extend(rekeyed(&mut source, 2));
        assert_eq!(packets.len(), 2, "what waited for its signature left in the old epoch");
        assert_eq!((source.epoch(), source.published_in_epoch()), (2, 0));
        packets.extend(published(&mut source, bytes(3), false));
        packets.extend(published(&mut source, bytes(40_000), false));
        assert_eq!(source.published_in_epoch(), 2);
        let new = grant_of(2, &[&source]);
        let mut got = Vec::new();
        if grant_first {
            assert_eq!(regranted(&mut sink, SINK, new), []);
            got.extend(delivered(&mut sink, &packets));
        } else {
            got.extend(delivered(&mut sink, &packets));
            assert_eq!((got.len(), sink.parked()), (2, 4));
            got.extend(regranted(&mut sink, SINK, new).into_iter().filter_map(payload));
            assert_eq!(sink.parked(), 0);
        }
        assert_eq!(got, [bytes(1), bytes(2), bytes(3), bytes(40_000)]);
        // The replay window survived the change of epoch.
        assert_eq!(delivered(&mut sink, &packets).len(), 0);
        assert_eq!(sink.epochs().collect::<Vec<_>>(), [1, 2]);
    }
}

#[test]
fn epochs_open_in_any_order_until_they_are_retired() {
    let mut source = unrecovered(SUITE, 5);
    let mut sink = sink(SUITE, &[&source]);
    let mut packets = published(&mut source, bytes(1), false);
    for epoch in 2..=4 {
        rekeyed(&mut source, epoch);
        packets.extend(published(&mut source, bytes(epoch as usize), false));
        packets.extend(published(&mut source, bytes(10), false));
        regranted(&mut sink, SINK, grant_of(epoch, &[&source]));
    }
    packets.reverse();
    let late = packets.split_off(4);
    assert_eq!(delivered(&mut sink, &packets).len(), 4);
    assert_eq!(delivered(&mut sink, &late[1..]).len(), 2, "old after new");
    sink.retire_epochs();
    assert_eq!(sink.epochs().collect::<Vec<_>>(), [4]);
    assert_eq!(sink.handle_packet(&late[0]), Err(OpenError::Epoch { found: 2 }.into()));
    let next = published(&mut source, bytes(5), false);
    assert_eq!(delivered(&mut sink, &next), [bytes(5)]);
    // An epoch can be granted again, but not go back.
    regranted(&mut sink, SINK, grant_of(4, &[&source]));
    assert_eq!(delivered(&mut sink, &next).len(), 0);
    let mut emitted = 0;
    assert!(!source.rekey(&grant(SUITE, 4, &[]), |_| emitted += 1));
    assert!(!source.rekey(&grant(Suite::Group, 5, &[]), |_| emitted += 1));
    assert_eq!((source.epoch(), emitted), (4, 0));
}

#[test]
fn epochs_held_are_bounded() {
    let mut source = source(SUITE, 0);
    let mut sink = sink(SUITE, &[&source]);
    let old = published(&mut source, bytes(1), false);
    for epoch in 2..=EPOCHS_MAX as u32 + 1 {
        regranted(&mut sink, SINK, grant_of(epoch, &[&source]));
    }
    assert_eq!(sink.epochs().count(), EPOCHS_MAX);
    assert_eq!(sink.handle_packet(&old[0]), Err(OpenError::Epoch { found: 1 }.into()));
}

#[test]
fn only_announced_sources_are_believed() {
    for suite in Suite::ALL {
        let mut known = source(suite, 0);
        let mut unknown = source_with(suite, config(6, 0));
        let mut sink = sink(suite, &[&known]);
        let packets =
            [published(&mut unknown, bytes(1), false), published(&mut unknown, bytes(40_000), false)];
        for packet in packets.iter().flatten() {
            assert_eq!(sink.handle_packet(packet), Ok(Delivery::Parked));
        }
        assert_eq!(delivered(&mut sink, &published(&mut known, bytes(2), false)).len(), 1);
        // A grant that was in flight lacks the epoch; the next one has it.
        assert_eq!(regranted(&mut sink, SINK, grant(suite, 1, &[known.announce()])), []);
        let unknown_before = SourceAnnounce { oldest: 1, next: 1, ..unknown.announce() };
        let all = grant(suite, 1, &[known.announce(), unknown_before]);
        let released: Vec<_> =
            regranted(&mut sink, SINK, all.clone()).into_iter().filter_map(payload).collect();
        assert_eq!(released, [bytes(1), bytes(40_000)], "{suite}");
        assert_eq!(regranted(&mut sink, SINK, all), []);
        assert_eq!(delivered(&mut sink, &packets.concat()).len(), 0, "released exactly once");
    }
}

#[test]
fn packets_that_no_grant_explains_are_given_up() {
    let mut unknown = source_with(SUITE, config(6, 0));
    let mut later = source(SUITE, 0);
    let known = source_with(SUITE, config(7, 0));
    let mut sink = sink(SUITE, &[&known]);
    sink.handle_packet(&published(&mut unknown, bytes(1), false)[0]).unwrap();
    rekeyed(&mut later, 9);
    sink.handle_packet(&published(&mut later, bytes(1), false)[0]).unwrap();
    for _ in 1..PARKED_LOOKS_MAX {
        assert_eq!(regranted(&mut sink, SINK, grant_of(1, &[&known])), []);
    }
    let released = regranted(&mut sink, SINK, grant_of(1, &[&known]));
    assert_eq!(released, [Err(SinkDrop::UnknownSource), Err(SinkDrop::UnknownEpoch)]);
    assert_eq!(sink.parked(), 0);
}

#[test]
fn a_parked_message_that_is_passed_over_is_asked_for_later() {
    let (mut early, mut other) = (source(SUITE, 0), source_with(SUITE, config(6, 0)));
    let before = [early.announce(), other.announce()];
    let mut sink = sink(SUITE, &[]);
    for source in [&mut early, &mut other] {
        assert_eq!(sink.handle_packet(&published(source, bytes(1), false)[0]), Ok(Delivery::Parked));
    }
    let passed_over = sink.pass_over(|source| *source == early.id());
    assert_eq!(Vec::from_iter(passed_over), [early.id()]);
    let released = regranted(&mut sink, SINK, grant(SUITE, 1, &before));
    assert_eq!(released.into_iter().filter_map(payload).collect::<Vec<_>>(), [bytes(1)], "of the other");
    sink.suspect(&early.id());
    assert_eq!(Vec::from_iter(sink.unsynced()), [early.id()]);
    let from = sink.ask(early.id()).expect("it can be asked");
    assert_eq!(delivered(&mut sink, &replayed_to(&mut early, SINK, from)), [bytes(1)]);
}

#[test]
fn parking_is_bounded_and_takes_only_what_opens() {
    let mut unknown = unrecovered(SUITE, 6);
    let mut sink = sink(SUITE, &[]);
    let mut forged = published(&mut unknown, bytes(1), false).remove(0);
    forged.header.seq = 77;
    assert_eq!(sink.handle_packet(&forged), Err(OpenError::Forged.into()));
    let mut full = 0;
    for _ in 0..PARKED_PACKETS_MAX + 10 {
        let packet = published(&mut unknown, bytes(1), false).remove(0);
        full += usize::from(sink.handle_packet(&packet) == Err(SinkDrop::ParkingFull));
    }
    assert_eq!((sink.parked(), full), (PARKED_PACKETS_MAX, 10));
    let announce = SourceAnnounce { oldest: 1, next: 1, ..unknown.announce() };
    let released = regranted(&mut sink, SINK, grant(SUITE, 1, &[announce]));
    let first = released.first().cloned().and_then(Result::ok);
    assert!(matches!(first, Some(Delivery::Message(Message { seq: 12, .. }))), "the oldest went");
    assert_eq!(released.len(), PARKED_PACKETS_MAX);
    // By bytes too.
    rekeyed(&mut unknown, 2);
    let large = published(&mut unknown, bytes(5 << 20), false);
    let dropped = large.iter().filter(|p| sink.handle_packet(p) == Err(SinkDrop::ParkingFull)).count();
    assert!(sink.parked() < 256 && dropped + sink.parked() == large.len(), "{dropped}");
}

#[test]
fn a_source_that_is_not_announced_any_more_ends_with_the_epoch() {
    let (mut gone, stays) = (source(SUITE, 0), source_with(SUITE, config(6, 0)));
    let mut sink = sink(SUITE, &[&gone, &stays]);
    // Its last messages may be in flight when the owner announces its end.
    regranted(&mut sink, SINK, grant_of(1, &[&stays]));
    assert_eq!(delivered(&mut sink, &published(&mut gone, bytes(1), false)).len(), 1);
    regranted(&mut sink, SINK, grant_of(2, &[&stays]));
    assert_eq!(delivered(&mut sink, &published(&mut gone, bytes(1), false)).len(), 1);
    let old = published(&mut gone, bytes(1), false);
    // A node without the right to publish that knows the new key is not believed in the new epoch.
    rekeyed(&mut gone, 2);
    let new = published(&mut gone, bytes(2), false);
    assert_eq!(sink.handle_packet(&new[0]), Ok(Delivery::Parked));
    sink.retire_epochs();
    assert_eq!(sink.handle_packet(&old[0]), Err(OpenError::Epoch { found: 1 }.into()));
    assert_eq!(sink.handle_packet(&new[0]), Ok(Delivery::Parked));
}

#[test]
fn recorded_packets_are_nothing_to_a_fresh_sink() {
    for suite in Suite::ALL {
        let mut source = source(suite, 10);
        let old = published(&mut source, bytes(1), false);
        let history = replayed(&mut source);
        published(&mut source, bytes(2), false);
        let announced = grant(suite, 1, &[source.announce()]);
        let id = SinkId([4; 16]);
        for transient_local in [true, false] {
            let mut fresh = Sink::new(NAME, id, announced.clone(), transient_local, SinkLimits::default());
            assert_eq!(fresh.handle_packet(&old[0]), Err(SinkDrop::BelowFloor));
            for packet in &history {
                assert_eq!(fresh.handle_packet(packet), Err(SinkDrop::NotForUs));
                // A router that writes another addressee, or none, into the header gains nothing.
                let mut readdressed = packet.clone();
                readdressed.header.to = Some(id);
                let refused = fresh.handle_packet(&readdressed);
                let floor = refused == Err(SinkDrop::BelowFloor) && !transient_local;
                assert!(floor || refused == Err(OpenError::Forged.into()), "{refused:?}");
                readdressed.header.to = None;
                readdressed.header.seq = readdressed.header.seq.max(1) + 10;
                assert_eq!(fresh.handle_packet(&readdressed), Err(OpenError::Forged.into()));
            }
            assert_eq!(fresh.unsynced().count(), usize::from(transient_local));
        }
    }
}

#[test]
fn history_below_the_floor_is_a_replay() {
    let mut source = source(SUITE, 2);
    let early = {
        published(&mut source, bytes(1), false);
        replayed(&mut source)
    };
    for n in 2..=5 {
        published(&mut source, bytes(n), false);
    }
    let mut sink = Sink::new(NAME, SINK, grant_of(1, &[&source]), true, SinkLimits::default());
    assert_eq!(sink.handle_packet(&early[0]), Err(SinkDrop::BelowFloor));
    assert_eq!(delivered(&mut sink, &replayed(&mut source)), [bytes(4), bytes(5)]);
}

#[test]
fn an_owner_that_started_anew_is_another() {
    let mut source = source(SUITE, 0);
    let mut sink = sink(SUITE, &[&source]);
    regranted(&mut sink, SINK, grant_of(2, &[&source]));
    rekeyed(&mut source, 2);
    let old = published(&mut source, bytes(1), false);
    let key = SecretBytes::new([0xee; 32]);
    let anew = TopicGrant { key, ..grant(SUITE, 1, &[]) };
    let mut other = Source::new(config(8, 0), &anew, message_key(SUITE)).unwrap();
    let granted = TopicGrant { sources: vec![other.announce()], ..anew };
    regranted(&mut sink, SinkId([2; 16]), granted);
    assert_eq!(sink.epochs().collect::<Vec<_>>(), [1]);
    assert_eq!(sink.handle_packet(&old[0]), Ok(Delivery::Parked), "nothing of before opens");
    let new = published(&mut other, bytes(2), false);
    assert_eq!(delivered(&mut sink, &new), [bytes(2)]);
}

#[test]
fn a_history_is_sealed_in_the_present_epoch() {
    let mut source = source(SUITE, 5);
    published(&mut source, bytes(1), false);
    rekeyed(&mut source, 2);
    published(&mut source, bytes(2), false);
    let mut sink = Sink::new(NAME, SINK, grant_of(2, &[&source]), true, SinkLimits::default());
    assert_eq!(delivered(&mut sink, &replayed(&mut source)), [bytes(1), bytes(2)]);
    assert_eq!(sink.unsynced().count(), 0);
}
