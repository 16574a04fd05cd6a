//! The audit log on the disk: its content, and its behaviour when it is full, torn or replaced.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::fs;
use std::io::Write;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use sgc_node::audit::{self, Audit, AuditEvent, AuditRecord, AuditRoom, PeerNames, Unread};
use sgc_wire::{Name, NodeId, UnixMillis};

const ROOM: AuditRoom = AuditRoom { max_bytes: 1 << 30, files: 1 };

struct Place {
    dir: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        Self { dir: tempfile::tempdir().unwrap() }
    }

    fn path(&self) -> PathBuf {
        self.dir.path().join("audit.jsonl")
    }

    /// Writes records through a log that is opened and finished.
    fn write(&self, room: AuditRoom, records: impl IntoIterator<Item = AuditRecord>) {
        let names = PeerNames::from(BTreeMap::from([(NodeId([7; 32]), "desk".to_owned())]));
        let (audit, writer) = Audit::open(&self.path(), room, names).unwrap();
        records.into_iter().for_each(|record| audit.write(record));
        writer.finish();
    }

    fn read(&self) -> (Vec<AuditRecord>, u64) {
        let mut records = Vec::new();
        let unread = audit::read(&self.path(), |record| records.push(record)).unwrap();
        assert!(unread.files.is_empty(), "{unread:?}");
        (records, unread.lines)
    }

    fn files(&self) -> usize {
        fs::read_dir(self.dir.path()).unwrap().count()
    }
}

fn granted(peer: u8) -> AuditRecord {
    AuditRecord::at(AuditEvent::Granted, UnixMillis(1_795_391_999_123))
        .topic(Some("/camera/image"))
        .name(&Name([1; 32]))
        .peer(&NodeId([peer; 32]))
        .epoch(3)
}

#[test]
fn a_record_is_one_line_for_its_owner_alone() {
    let place = Place::new();
    place.write(ROOM, [granted(7), granted(8)]);
    let text = fs::read_to_string(place.path()).unwrap();
    let (name, peer) = ("01".repeat(32), "07".repeat(32));
    let first = format!(
        "{{\"time\":\"2026-11-22T23:59:59Z\",\"unix_ms\":1795391999123,\"event\":\"granted\",\
         \"topic\":\"/camera/image\",\"name\":\"{name}\",\"peer\":\"{peer}\",\"peer_name\":\"desk\",\"epoch\":3}}"
    );
    assert_eq!(text.lines().next(), Some(first.as_str()));
    assert_eq!(text.lines().count(), 2);
    assert_eq!(fs::metadata(place.path()).unwrap().permissions().mode() & 0o7777, 0o600);
    let (records, malformed) = place.read();
    assert_eq!((records[1].peer_name.as_deref(), malformed), (None, 0));
}

#[test]
fn each_event_has_a_word_of_its_own_and_no_text_breaks_a_line() {
    let place = Place::new();
    let hostile = "a\nb\u{1b}[2J\"}".to_owned() + &"ü".repeat(4000);
    place.write(ROOM, AuditEvent::ALL.map(|event| AuditRecord::new(event).reason(&hostile).by(&hostile)));
    let (records, malformed) = place.read();
    assert_eq!((records.len(), malformed), (AuditEvent::ALL.len(), 0));
    let words: std::collections::BTreeSet<_> = records.iter().map(|r| r.event.as_str()).collect();
    assert_eq!(words.len(), AuditEvent::ALL.len());
    assert!(records.iter().all(|r| r.reason.as_ref().unwrap().len() <= 512));
}

#[test]
fn a_record_from_beside_comes_between_those_of_the_node_that_runs() {
    let place = Place::new();
    let made = AuditRecord::new(AuditEvent::TokenMade).by("uid 1000");
    audit::append(&place.path(), &made).unwrap();
    let (log, writer) = Audit::open(&place.path(), ROOM, PeerNames::default()).unwrap();
    audit::append(&place.path(), &AuditRecord::new(AuditEvent::TokenRevoked)).unwrap();
    log.write(granted(7));
    writer.finish();
    let (records, malformed) = place.read();
    let events: Vec<_> = records.iter().map(|record| record.event.as_str()).collect();
    assert_eq!((events, malformed), (vec!["token_made", "token_revoked", "granted"], 0));
    assert_eq!(fs::metadata(place.path()).unwrap().permissions().mode() & 0o7777, 0o600);
}

/// Returns records of peers that come and go, beginning in their first second.
fn crowd(peers: u8, events: &[AuditEvent], times: u64) -> impl Iterator<Item = AuditRecord> {
    let one = move |at: u64, peer: u8, event: AuditEvent| {
        let record = AuditRecord::at(event, UnixMillis(1_795_000_000_000 + at));
        record.topic(Some("/camera/image")).name(&Name([1; 32])).peer(&NodeId([peer; 32]))
    };
    let events = events.to_vec();
    (0..times).flat_map(move |at| {
        let events = events.clone();
        (1..=peers).flat_map(move |peer| events.clone().into_iter().map(move |event| one(at, peer, event)))
    })
}

#[test]
fn a_member_that_joins_and_leaves_for_ever_pushes_out_nothing() {
    const ROOM: AuditRoom = AuditRoom { max_bytes: 16 << 10, files: 1 };
    let place = Place::new();
    place.write(ROOM, [AuditRecord::new(AuditEvent::Started), granted(9)]);
    place.write(ROOM, crowd(1, &[AuditEvent::Granted, AuditEvent::Left], 50_000));
    let (records, malformed) = place.read();
    let count = |event: &str| records.iter().filter(|r| r.event == event).count();
    assert_eq!((count("started"), count("granted"), count("left"), malformed), (1, 1 + 8, 8, 0));
    // Every omitted record is counted with its peer, topic and time.
    let summaries: Vec<_> = records.iter().filter(|r| r.event == "summary").collect();
    let of = |event: &str| summaries.iter().find(|r| r.of.as_deref() == Some(event)).unwrap().count;
    assert_eq!((summaries.len(), of("granted"), of("left")), (2, Some(49_992), Some(49_992)));
    for summary in summaries {
        assert_eq!(summary.topic.as_deref(), Some("/camera/image"));
        assert_eq!(summary.peer.as_deref(), Some(&*"01".repeat(32)));
        let time = |ms: u64| UnixMillis(1_795_000_000_000 + ms).to_string();
        assert_eq!((summary.from.as_deref(), &*summary.time), (Some(&*time(8)), &*time(49_999)));
    }
    assert_eq!(
        records.iter().filter_map(|r| r.lost).sum::<u64>(),
        0,
        "nor did it push anything out of the queue"
    );
}

#[test]
fn summarised_audit_records_are_counted_in_the_status() {
    let place = Place::new();
    let (log, writer) = Audit::open(&place.path(), ROOM, PeerNames::default()).unwrap();
    crowd(2, &[AuditEvent::Left], 100).for_each(|record| log.write(record));
    assert_eq!((log.summed_up_total(), log.lost_total()), (184, 0));
    writer.finish();
}

#[test]
fn refusals_without_end_do_not_push_out_what_is_older() {
    let place = Place::new();
    let at = UnixMillis(1_795_000_000_000);
    let addresses = (0..100_u32).flat_map(|host| std::iter::repeat_n(host, 100));
    let flood = addresses.flat_map(|host| {
        let remote = std::net::SocketAddr::from((std::net::Ipv4Addr::from_bits(0x0a00_0000 + host), 7447));
        [AuditEvent::TokenRefused, AuditEvent::LinkRefused]
            .map(|event| AuditRecord::at(event, at).remote(remote))
    });
    place.write(ROOM, flood.chain([granted(1)]));
    let (records, _) = place.read();
    let count = |event: &str| records.iter().filter(|r| r.event == event).count();
    assert_eq!((count("token_refused"), count("link_refused"), count("granted")), (256, 256, 1));
    let summed: u64 = records.iter().filter_map(|r| r.count).sum();
    assert_eq!(summed, 2 * (10_000 - 256));
}

#[test]
fn a_full_log_is_put_aside_and_as_many_kept_as_are_asked_for() {
    const MAX: u64 = 2048;
    let place = Place::new();
    let len = |path: &Path| fs::metadata(path).unwrap().len();
    let write = |files, peers: std::ops::Range<u8>| {
        for peer in peers {
            place.write(AuditRoom { max_bytes: MAX, files }, [granted(peer)]);
        }
    };
    write(3, 0..100);
    assert_eq!(place.files(), 4);
    for path in (1..=3).map(|n| audit::rotated_path(&place.path(), n)).chain([place.path()]) {
        assert!(len(&path) <= MAX);
    }
    let peers = || -> Vec<_> { place.read().0.iter().map(|r| r.peer.clone().unwrap()).collect() };
    let expected = |n: usize, to: u8| -> Vec<_> {
        (to - n as u8..to).map(|peer| NodeId([peer; 32]).to_string()).collect()
    };
    let kept = peers();
    assert!(kept.len() > 15);
    assert_eq!(kept, expected(kept.len(), 100), "the newest, in order");
    // A smaller number of files removes the excess ones.
    write(1, 100..120);
    assert_eq!(place.files(), 2);
    assert_eq!(peers(), expected(peers().len(), 120));
}

#[test]
fn a_log_that_another_program_renames_cuts_or_removes_goes_on_at_its_place() {
    let place = Place::new();
    let (log, writer) = Audit::open(&place.path(), ROOM, PeerNames::default()).unwrap();
    let peers = |path: &Path| fs::read_to_string(path).unwrap_or_default().matches("\"peer\"").count();
    let write = |peer| {
        log.write(granted(peer));
        let end = std::time::Instant::now() + std::time::Duration::from_secs(20);
        while peers(&place.path()) != 1 {
            assert!(std::time::Instant::now() < end, "record {peer} is not in the file");
            std::thread::yield_now();
        }
    };
    write(1);
    let dated = place.dir.path().join("audit.jsonl-20261123");
    fs::rename(place.path(), &dated).unwrap();
    write(2);
    fs::rename(place.path(), audit::rotated_path(&place.path(), 1)).unwrap();
    write(3);
    fs::remove_file(place.path()).unwrap();
    write(4);
    fs::File::create(place.path()).unwrap();
    write(5);
    writer.finish();
    assert_eq!((peers(&dated), fs::metadata(place.path()).unwrap().permissions().mode() & 0o777), (1, 0o600));
    let read: Vec<_> = place.read().0.iter().map(|r| r.peer.clone().unwrap()).collect();
    assert_eq!(read, [1, 2, 5].map(|peer| NodeId([peer; 32]).to_string()), "the oldest first");
}

#[test]
fn files_put_aside_are_read_in_order_and_others_named_or_left_alone() {
    let place = Place::new();
    let line = |peer| serde_json::to_string(&granted(peer)).unwrap() + "\n";
    let put = |name: &str, text: &str| fs::write(place.dir.path().join(name), text).unwrap();
    for (name, peer) in [("-20261101", 1), ("-20261102", 2), (".10", 3), (".2", 4), (".1", 5), ("", 6)] {
        put(&format!("audit.jsonl{name}"), &line(peer));
    }
    for other in ["audit.jsonl.bak", "audit.jsonl.01", "audit.jsonl-x", "audit.json.1", "other"] {
        put(other, &line(99));
    }
    assert_eq!(place.read().0.len(), 6);
    put("audit.jsonl.11.gz", "?");
    let mut peers = Vec::new();
    let unread = audit::read(&place.path(), |record| peers.push(record.peer.unwrap())).unwrap();
    assert_eq!(peers, [1, 2, 3, 4, 5, 6].map(|peer| NodeId([peer; 32]).to_string()));
    assert_eq!(unread, Unread { lines: 0, files: vec![place.dir.path().join("audit.jsonl.11.gz")] });
}

#[test]
fn a_line_that_a_killed_run_left_is_ended_and_counted() {
    let place = Place::new();
    place.write(ROOM, [granted(1)]);
    let mut file = fs::OpenOptions::new().append(true).open(place.path()).unwrap();
    file.write_all(b"{\"time\":\"2026").unwrap();
    place.write(ROOM, [granted(2)]);
    let (records, malformed) = place.read();
    assert_eq!((records.len(), malformed), (2, 1));
    assert_eq!(records[1].peer, Some("02".repeat(32)));
    // A line of any length is one line.
    let mut file = fs::OpenOptions::new().append(true).open(place.path()).unwrap();
    file.write_all(&[vec![b'x'; 100_000], b"\n\n".to_vec()].concat()).unwrap();
    assert_eq!(place.read().1, 2);
}

#[test]
fn lost_audit_records_are_reported() {
    let place = Place::new();
    let (audit, writer) = Audit::open(&place.path(), ROOM, PeerNames::default()).unwrap();
    // More records than the queue holds, faster than a disk. All that do not fit must be accounted for.
    const N: u64 = 50_000;
    (0..N).for_each(|_| audit.write(AuditRecord::new(AuditEvent::Reload)));
    writer.finish();
    let said = audit.lost();
    audit.write(granted(2));
    assert_eq!(audit.lost(), said + 1, "nobody writes any more");
    let (records, malformed) = place.read();
    let written = records.iter().filter(|r| r.event == "reload").count() as u64;
    let lost: u64 = records.iter().filter_map(|r| r.lost).sum();
    assert_eq!((written + lost + said, malformed), (N, 0));
}

#[test]
fn a_log_is_not_written_through_a_link_nor_into_what_is_no_file() {
    let place = Place::new();
    let target = place.dir.path().join("target");
    fs::write(&target, "kept").unwrap();
    symlink(&target, place.path()).unwrap();
    assert!(Audit::open(&place.path(), ROOM, PeerNames::default()).is_err());
    assert_eq!(fs::read_to_string(&target).unwrap(), "kept");
    assert!(Audit::open(place.dir.path(), ROOM, PeerNames::default()).is_err());
    fs::remove_file(place.path()).unwrap();
    assert!(audit::read(&place.path(), |_| {}).is_err(), "there is none");
    // A log that is switched off accepts everything and keeps nothing.
    Audit::default().write(granted(1));
}
