//! Tests of the store machine: bounds, repetitions, and changes that cross reads.

use sgc_testkit::Clock;

use super::*;

fn name(number: u16) -> Name {
    let mut name = [0; 32];
    name[..2].copy_from_slice(&number.to_be_bytes());
    Name(name)
}

fn entry(owner: u8) -> NameEntry {
    NameEntry { owner: NodeId([owner; 32]), tag: BatchTag([owner; BATCH_TAG_LEN]) }
}

/// A store that answers, with a machine that took this news.
fn up(now: Instant) -> Store {
    let mut store = Store::new(now, 1 << 20);
    store.handle(now, StoreEvent::Up);
    assert_eq!(store.take_finding(), Some(Finding::Up));
    store
}

fn operations(store: &mut Store, now: Instant) -> Vec<StoreOp> {
    std::iter::from_fn(|| store.take_operation(now)).collect()
}

fn findings(store: &mut Store) -> Vec<Finding> {
    std::iter::from_fn(|| store.take_finding()).collect()
}

fn answer(store: &mut Store, now: Instant, op: &StoreOp, result: Result<StoreReply, StoreFailure>) {
    store.handle(now, StoreEvent::Reply { id: op.id, result });
}

fn value(bytes: &[u8]) -> Result<StoreReply, StoreFailure> {
    Ok(StoreReply::Value(Some(Bytes::copy_from_slice(bytes))))
}

fn looked_up(name: Name, end: LookUpEnd) -> Finding {
    Finding::LookedUp { name, end, others_asked: false }
}

#[test]
fn look_up_reads_the_name_and_then_batch_and_place_together() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    assert_eq!(store.look_up(now, name(1)), LookUpStart::UnderWay);
    assert_eq!(store.look_up(now, name(1)), LookUpStart::UnderWay);
    let first = operations(&mut store, now);
    assert_eq!(first.iter().map(|op| op.key).collect::<Vec<_>>(), [StoreKey::Name(name(1))]);
    answer(&mut store, now, &first[0], value(&entry(7).to_vec()));
    let second = operations(&mut store, now);
    let keys: Vec<_> = second.iter().map(|op| op.key).collect();
    assert_eq!(keys, [entry(7).batch(), StoreKey::Node(NodeId([7; 32]))]);
    answer(&mut store, now, &second[0], value(b"advertisement"));
    assert_eq!(findings(&mut store), []);
    answer(&mut store, now, &second[1], value(b"link state"));
    let found = [
        Finding::Signed { key: keys[1], value: Bytes::from_static(b"link state") },
        Finding::Signed { key: keys[0], value: Bytes::from_static(b"advertisement") },
        looked_up(name(1), LookUpEnd::Found(entry(7))),
    ];
    assert_eq!(findings(&mut store), found);
    // The values are at hand now.
    store.look_up(now, name(1));
    assert_eq!((operations(&mut store, now), findings(&mut store)), (vec![], found.to_vec()));
}

#[test]
fn key_that_changes_while_it_is_read_is_read_again() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    store.look_up(now, name(1));
    let old = operations(&mut store, now).remove(0);
    store.handle(now, StoreEvent::Changed(old.key));
    assert_eq!(findings(&mut store), [Finding::Changed(old.key)]);
    answer(&mut store, now, &old, Ok(StoreReply::Value(None)));
    let new = operations(&mut store, now).remove(0);
    assert_eq!((new.key, findings(&mut store)), (old.key, vec![]));
    answer(&mut store, now, &new, Ok(StoreReply::Value(None)));
    assert_eq!(findings(&mut store), [looked_up(name(1), LookUpEnd::Absent)]);
}

#[test]
fn operations_under_way_are_bounded() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    for number in 0..2000 {
        store.look_up(now, name(number));
    }
    let begun = operations(&mut store, now);
    assert_eq!(begun.len(), OPS_MAX);
    answer(&mut store, now, &begun[0], Ok(StoreReply::Value(None)));
    assert_eq!(operations(&mut store, now).len(), 1);
}

#[test]
fn look_ups_are_bounded() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    let begun = (0..u16::MAX).filter(|n| store.look_up(now, name(*n)) == LookUpStart::UnderWay).count();
    assert_eq!(begun, LOOK_UPS_MAX);
}

#[test]
fn operation_without_a_result_fails_in_time() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    store.look_up(now, name(1));
    let op = operations(&mut store, now).remove(0);
    assert_eq!(store.deadlines().min(), Some(now + OP_TIMEOUT));
    store.handle_timeout(now + OP_TIMEOUT);
    assert_eq!(findings(&mut store), [looked_up(name(1), LookUpEnd::Unavailable)]);
    // The late result has no effect.
    answer(&mut store, now + OP_TIMEOUT, &op, value(&entry(7).to_vec()));
    assert_eq!((operations(&mut store, now), findings(&mut store)), (vec![], vec![]));
    assert_eq!(store.stats().failures, 1);
}

#[test]
fn look_up_while_the_store_is_down_is_no_reason_to_wait() {
    let now = Clock::default().now().instant;
    let mut store = Store::new(now, 1 << 20);
    assert_eq!(store.look_up(now, name(1)), LookUpStart::Unavailable);
    let op = operations(&mut store, now).remove(0);
    answer(&mut store, now, &op, Err(StoreFailure::Unreachable));
    let ended = Finding::LookedUp { name: name(1), end: LookUpEnd::Unavailable, others_asked: true };
    assert_eq!(findings(&mut store), [ended]);
}

#[test]
fn names_of_a_batch_are_written_if_it_had_no_value() {
    let now = Clock::default().now().instant;
    for (existed, next) in [(true, None), (false, Some(Work::NamesOf(3)))] {
        let mut store = up(now);
        let then = Some(Work::NamesOf(3));
        store.write(entry(7).batch(), Bytes::new(), None, Work::Record(3), then);
        let op = operations(&mut store, now).remove(0);
        answer(&mut store, now, &op, Ok(StoreReply::Written { existed }));
        assert_eq!(store.take_work(), next);
    }
}

#[test]
fn names_follow_a_first_write_that_may_have_arrived() {
    let mut now = Clock::default().now().instant;
    for (work, next) in [(Work::NewRecord(3), Some(Work::NamesOf(3))), (Work::Record(3), None)] {
        let mut store = up(now);
        let write = |store: &mut Store, work, result| {
            store.write(entry(7).batch(), Bytes::new(), None, work, Some(Work::NamesOf(3)));
            let op = operations(store, now).remove(0);
            answer(store, now, &op, result);
        };
        write(&mut store, work, Err(StoreFailure::Unreachable));
        assert_eq!(store.take_work(), None);
        // The first write arrived, or so it seems. A renewal can be the next.
        write(&mut store, Work::Record(3), Ok(StoreReply::Written { existed: true }));
        assert_eq!(store.take_work(), next);
        write(&mut store, work, Ok(StoreReply::Written { existed: true }));
        assert_eq!(store.take_work(), None);
        now += RETRY_MAX;
    }
}

#[test]
fn work_whose_writes_fail_is_repeated_once_and_later_each_time() {
    let mut now = Clock::default().now().instant;
    let mut store = up(now);
    for seconds in [1, 2, 4, 8, 16, 32, 32] {
        for number in 0..3 {
            let key = StoreKey::Name(name(number));
            store.write(key, Bytes::new(), None, Work::NamesOf(3), None);
        }
        for op in operations(&mut store, now) {
            answer(&mut store, now, &op, Err(StoreFailure::Refused));
        }
        assert_eq!(store.take_work(), None);
        now += Duration::from_secs(seconds);
        store.handle_timeout(now - Duration::from_millis(1));
        assert_eq!(store.take_work(), None);
        store.handle_timeout(now);
        assert_eq!((store.take_work(), store.take_work()), (Some(Work::NamesOf(3)), None));
    }
}

#[test]
fn refusals_are_told_until_a_write_succeeds() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    let write = |store: &mut Store, result| {
        store.write(StoreKey::Name(name(1)), Bytes::new(), None, Work::NamesOf(3), None);
        let op = operations(store, now).remove(0);
        answer(store, now, &op, result);
        store.stats().refused_at
    };
    assert_eq!(write(&mut store, Err(StoreFailure::Unreachable)), None);
    assert_eq!(write(&mut store, Err(StoreFailure::Refused)), Some(now));
    store.look_up(now, name(2));
    let read = operations(&mut store, now).remove(0);
    answer(&mut store, now, &read, Ok(StoreReply::Value(None)));
    assert_eq!(store.stats().refused_at, Some(now));
    assert_eq!(write(&mut store, Ok(StoreReply::Written { existed: true })), None);
}

#[test]
fn writes_bound_the_work_that_begins() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    store.add_work(Work::Record(1));
    for number in 0..WRITES_MAX as u16 {
        store.write(StoreKey::Name(name(number)), Bytes::new(), None, Work::Record(0), None);
    }
    assert_eq!(store.take_work(), None);
    let op = operations(&mut store, now).remove(0);
    answer(&mut store, now, &op, Ok(StoreReply::Written { existed: true }));
    assert_eq!(store.take_work(), Some(Work::Record(1)));
}

#[test]
fn orphan_whose_owner_renewed_meanwhile_is_written_again() {
    let now = Clock::default().now().instant;
    for renewed in [false, true] {
        let mut store = up(now);
        store.look_up(now, name(1));
        let read = operations(&mut store, now).remove(0);
        answer(&mut store, now, &read, value(&entry(7).to_vec()));
        for op in operations(&mut store, now) {
            answer(&mut store, now, &op, Ok(StoreReply::Value(None)));
        }
        assert_eq!(findings(&mut store), [looked_up(name(1), LookUpEnd::Absent)]);
        let removal = operations(&mut store, now).remove(0);
        assert_eq!(removal.action, StoreAction::Remove { value: entry(7).to_bytes() });
        answer(&mut store, now, &removal, Ok(StoreReply::Removed));
        let check = operations(&mut store, now).remove(0);
        assert_eq!(check.key, entry(7).batch());
        let found = if renewed { value(b"advertisement") } else { Ok(StoreReply::Value(None)) };
        answer(&mut store, now, &check, found);
        let restored: Vec<_> = operations(&mut store, now).into_iter().map(|op| op.action).collect();
        let write =
            StoreAction::Write { value: entry(7).to_bytes(), lifetime: None, condition: WriteIf::Absent };
        assert_eq!(restored, if renewed { vec![write] } else { vec![] });
    }
}

#[test]
fn value_of_a_name_with_another_length_is_refused() {
    let now = Clock::default().now().instant;
    for length in [0, 43, 45, 1000] {
        let mut store = up(now);
        store.look_up(now, name(1));
        let op = operations(&mut store, now).remove(0);
        answer(&mut store, now, &op, value(&vec![7; length]));
        assert_eq!(findings(&mut store), [looked_up(name(1), LookUpEnd::Absent)]);
        assert_eq!(store.stats().refused, 1);
    }
}

#[test]
fn news_that_the_store_answers_again_voids_all_that_was_read() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    store.look_up(now, name(1));
    let op = operations(&mut store, now).remove(0);
    answer(&mut store, now, &op, Ok(StoreReply::Value(None)));
    findings(&mut store);
    store.handle(now, StoreEvent::Up);
    store.look_up(now, name(1));
    assert_eq!(operations(&mut store, now).len(), 1);
}

#[test]
fn work_at_the_return_of_the_store_is_spread() {
    let now = Clock::default().now().instant;
    let mut store = up(now);
    store.add_paced(now, (0..1000).map(Work::Record));
    let mut begun = 0;
    for tenth in 0..10 {
        store.handle_timeout(now + Duration::from_millis(50 * tenth));
        while store.take_work().is_some() {
            begun += 1;
        }
        assert_eq!(begun, 1 + 100 * tenth as usize);
    }
}

#[test]
fn names_are_written_again_one_record_after_another() {
    let mut now = Clock::default().now().instant;
    let mut store = up(now);
    store.refill([(1, 100), (2, 1), (3, 5), (4, 1)]);
    store.need_not_refill(4);
    for (id, wait) in [(1, 100 * NAME_PACE), (2, NAME_PACE)] {
        assert_eq!(store.deadlines().min(), Some(now));
        store.handle_timeout(now);
        assert_eq!(store.take_work(), Some(Work::Refill(id)));
        now += wait;
        store.handle_timeout(now - Duration::from_micros(1));
        assert_eq!(store.take_work(), None);
    }
    // The store failed once more: what was left is part of the new work.
    store.refill([(3, 5)]);
    store.handle_timeout(now);
    assert_eq!((store.take_work(), store.deadlines().min()), (Some(Work::Refill(3)), None));
    store.write(StoreKey::Name(name(1)), Bytes::new(), None, Work::Refill(3), None);
    let op = operations(&mut store, now).remove(0);
    assert!(matches!(op.action, StoreAction::Write { condition: WriteIf::Absent, .. }));
}

#[test]
fn tag_does_not_depend_on_the_order_of_names() {
    assert_eq!(batch_tag(&[name(1), name(2)]), batch_tag(&[name(2), name(1)]));
    assert_ne!(batch_tag(&[name(1), name(2)]), batch_tag(&[name(1)]));
}
