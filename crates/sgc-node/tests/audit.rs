//! The audit log on the disk: what is in it, what becomes of it when it is full, torn or in the way.

#![allow(clippy::unwrap_used)]

use std::fs;
use std::io::Write;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};

use sgc_node::audit::{self, Audit, AuditEvent, AuditRecord, PeerNames};
use sgc_wire::{Name, NodeId, UnixMillis};

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

    /// Writes through a log that is opened and finished.
    fn write(&self, max_bytes: u64, records: impl IntoIterator<Item = AuditRecord>) {
        let names = PeerNames::from([(NodeId([7; 32]), "desk".to_owned())]);
        let (audit, writer) = Audit::open(&self.path(), max_bytes, names).unwrap();
        records.into_iter().for_each(|record| audit.write(record));
        writer.finish();
    }

    fn read(&self) -> (Vec<AuditRecord>, u64) {
        let mut records = Vec::new();
        let malformed = audit::read(&self.path(), |record| records.push(record)).unwrap();
        (records, malformed)
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
    place.write(1 << 20, [granted(7), granted(8)]);
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
    place.write(1 << 20, AuditEvent::ALL.map(|event| AuditRecord::new(event).reason(&hostile).by(&hostile)));
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
    let (log, writer) = Audit::open(&place.path(), 1 << 20, PeerNames::new()).unwrap();
    audit::append(&place.path(), &AuditRecord::new(AuditEvent::TokenRevoked)).unwrap();
    log.write(granted(7));
    writer.finish();
    let (records, malformed) = place.read();
    let events: Vec<_> = records.iter().map(|record| record.event.as_str()).collect();
    assert_eq!((events, malformed), (vec!["token_made", "token_revoked", "granted"], 0));
    assert_eq!(fs::metadata(place.path()).unwrap().permissions().mode() & 0o7777, 0o600);
}

#[test]
fn tokens_that_are_refused_for_ever_are_counted_and_push_out_nothing() {
    let place = Place::new();
    let refused = (0..1000).map(|_| AuditRecord::at(AuditEvent::TokenRefused, UnixMillis(1)));
    place.write(1 << 20, refused);
    let (records, _) = place.read();
    assert_eq!(records.iter().filter(|record| record.event == "token_refused").count(), 120);
    assert_eq!(records.iter().filter_map(|record| record.lost).sum::<u64>(), 880);
}

#[test]
fn a_full_log_is_put_aside_and_one_old_one_kept() {
    const MAX: u64 = 2048;
    let place = Place::new();
    for peer in 0..50 {
        place.write(MAX, [granted(peer)]);
    }
    let old = audit::old_path(&place.path());
    let len = |path: &Path| fs::metadata(path).unwrap().len();
    assert!(len(&old) <= MAX && len(&place.path()) <= MAX);
    assert_eq!(fs::read_dir(place.dir.path()).unwrap().count(), 2);
    let (records, _) = place.read();
    let peers: Vec<_> = records.iter().map(|r| r.peer.clone().unwrap()).collect();
    let last = peers.len();
    let expected: Vec<_> = (50 - last as u8..50).map(|peer| NodeId([peer; 32]).to_string()).collect();
    assert_eq!(peers, expected, "the newest, in order");
}

#[test]
fn a_line_that_a_killed_run_left_is_ended_and_counted() {
    let place = Place::new();
    place.write(1 << 20, [granted(1)]);
    let mut file = fs::OpenOptions::new().append(true).open(place.path()).unwrap();
    file.write_all(b"{\"time\":\"2026").unwrap();
    place.write(1 << 20, [granted(2)]);
    let (records, malformed) = place.read();
    assert_eq!((records.len(), malformed), (2, 1));
    assert_eq!(records[1].peer, Some("02".repeat(32)));
    // A line of any length is one line.
    let mut file = fs::OpenOptions::new().append(true).open(place.path()).unwrap();
    file.write_all(&[vec![b'x'; 100_000], b"\n\n".to_vec()].concat()).unwrap();
    assert_eq!(place.read().1, 2);
}

#[test]
fn what_is_lost_is_said() {
    let place = Place::new();
    let (audit, writer) = Audit::open(&place.path(), 1 << 30, PeerNames::new()).unwrap();
    // More than can wait, faster than a disk: whatever does not fit has to be accounted for.
    const N: u64 = 50_000;
    (0..N).for_each(|_| audit.write(granted(1)));
    writer.finish();
    let said = audit.lost();
    audit.write(granted(2));
    assert_eq!(audit.lost(), said + 1, "nobody writes any more");
    let (records, malformed) = place.read();
    let written = records.iter().filter(|r| r.event == "granted").count() as u64;
    let lost: u64 = records.iter().filter_map(|r| r.lost).sum();
    assert_eq!((written + lost + said, malformed), (N, 0));
}

#[test]
fn refusals_without_end_do_not_push_out_what_is_older() {
    let place = Place::new();
    let refused = |unix_ms| AuditRecord::at(AuditEvent::Refused, UnixMillis(unix_ms)).peer(&NodeId([9; 32]));
    let flood = (0..10_000).map(|n| refused(60_000 + n % 60_000));
    place.write(1 << 30, flood.chain([refused(120_000), granted(1)]));
    let (records, _) = place.read();
    let count = |event: &str| records.iter().filter(|r| r.event == event).count();
    let lost: u64 = records.iter().filter_map(|r| r.lost).sum();
    assert_eq!((count("refused"), count("granted"), lost), (121, 1, 9_880));
}

#[test]
fn a_log_is_not_written_through_a_link_nor_into_what_is_no_file() {
    let place = Place::new();
    let target = place.dir.path().join("target");
    fs::write(&target, "kept").unwrap();
    symlink(&target, place.path()).unwrap();
    assert!(Audit::open(&place.path(), 1 << 20, PeerNames::new()).is_err());
    assert_eq!(fs::read_to_string(&target).unwrap(), "kept");
    assert!(Audit::open(place.dir.path(), 1 << 20, PeerNames::new()).is_err());
    fs::remove_file(place.path()).unwrap();
    assert!(audit::read(&place.path(), |_| {}).is_err(), "there is none");
    // One that is off takes everything and keeps nothing.
    Audit::default().write(granted(1));
}
