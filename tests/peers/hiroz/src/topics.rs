//! Roles `pub` and `sub`, with the messages `string` of `../../README.md`.

use std::collections::{HashMap, HashSet};
use std::num::NonZeroUsize;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use hiroz::attachment::Attachment;
use hiroz::msg::ZMessage as _;
use hiroz::qos::{QosDurability, QosHistory, QosProfile, QosReliability};
use hiroz::{Builder as _, Result};
use serde_json::{Value, json};
use tokio::time::{Instant, sleep, sleep_until};

use crate::interfaces::Text;
use crate::options::{Publish, Subscribe, Topic};
use crate::{INCOMPLETE, OK, Run, WRONG, emit, line, open};

/// Zenoh reports no arrival. A session that closes at once may take its last messages with it.
const SETTLE: Duration = Duration::from_millis(500);

fn qos(options: &Topic) -> QosProfile {
    QosProfile {
        reliability: if options.best_effort { QosReliability::BestEffort } else { QosReliability::Reliable },
        durability: if options.transient_local {
            QosDurability::TransientLocal
        } else {
            QosDurability::Volatile
        },
        history: NonZeroUsize::new(options.depth).map_or(QosHistory::KeepAll, QosHistory::KeepLast),
        ..Default::default()
    }
}

fn wall_clock_ns() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |now| now.as_nanos() as u64)
}

/// The first bytes of splitmix64.
fn noise(seed: u64, count: usize) -> Vec<u8> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = state;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    };
    let mut bytes: Vec<u8> = (0..count.div_ceil(8)).flat_map(|_| next().to_le_bytes()).collect();
    bytes.truncate(count);
    bytes
}

impl Text {
    /// The size is the length of the filler; 0 lets it follow from the sequence number.
    fn make(seq: u64, stamp_ns: u64, size: usize) -> Self {
        let length = if size > 0 { size } else { (seq % 23) as usize };
        let mut filler: String = noise(seq, length).iter().map(|byte| format!("{byte:02x}")).collect();
        filler.truncate(length);
        let body = format!("seq={seq} t={stamp_ns} fill={filler}");
        let crc = crc32fast::hash(body.as_bytes());
        Self { data: format!("{body} crc={crc:08x}") }
    }

    /// Returns the sequence number and whether the message is unaltered, or `None` if it has no number.
    fn read(&self) -> Option<(u64, u64, bool)> {
        let mut parts = self.data.split(' ');
        let seq = parts.next()?.strip_prefix("seq=")?.parse().ok()?;
        let stamp_ns = parts.next()?.strip_prefix("t=")?.parse().ok()?;
        let filler = parts.next()?.strip_prefix("fill=")?.chars().count();
        let size = if filler as u64 == seq % 23 { 0 } else { filler };
        Some((seq, stamp_ns, *self == Self::make(seq, stamp_ns, size)))
    }
}

pub async fn publish(options: &Publish, mut run: Run) -> Result<u8> {
    let (_context, node) = open(&options.topic.session, &run).await?;
    let publisher = node.create_pub::<Text>(&options.topic.topic).with_qos(qos(&options.topic)).build()?;
    emit("ready", json!({}));
    let mut matched = options.wait_matched == 0;
    if !matched {
        matched = run.within(publisher.wait_for_subscription(options.wait_matched, Duration::MAX / 4)).await
            == Some(true);
        if matched {
            emit("matched", json!({ "count": options.wait_matched }));
        }
    }
    if matched && options.wait_go {
        matched = run.within(line()).await == Some(true);
    }
    let begun = Instant::now();
    let mut sent = 0;
    while matched && (options.topic.count == 0 || sent < options.topic.count) {
        if options.rate > 0.0 {
            let due = begun + Duration::from_secs_f64(sent as f64 / options.rate);
            if run.within(sleep_until(due)).await.is_none() {
                break;
            }
        } else if run.is_over() {
            break;
        }
        let seq = options.start + sent;
        publisher.async_publish(&Text::make(seq, wall_clock_ns(), options.size)).await?;
        if options.topic.verbose {
            emit("sent", json!({ "seq": seq }));
        }
        sent += 1;
    }
    let seconds = begun.elapsed().as_secs_f64();
    emit("all_sent", json!({ "sent": sent, "acknowledged": null }));
    if options.hold.is_zero() {
        sleep(SETTLE).await;
    } else {
        run.within(sleep(options.hold)).await;
    }
    let last = (sent > 0).then(|| options.start + sent - 1);
    emit(
        "summary",
        json!({ "role": "pub", "sent": sent, "first": last.map(|_| options.start), "last": last, "seconds": seconds,
                "acknowledged": null }),
    );
    let good = run.by_signal || (matched && sent >= options.topic.count);
    Ok(if good { OK } else { INCOMPLETE })
}

pub async fn subscribe(options: &Subscribe, mut run: Run) -> Result<u8> {
    let (_context, node) = open(&options.topic.session, &run).await?;
    let subscription = node.create_sub::<Text>(&options.topic.topic).with_qos(qos(&options.topic)).build()?;
    emit("ready", json!({}));
    let mut tally = Tally::default();
    let mut matched = false;
    let mut until = None;
    loop {
        if until.is_none() && options.topic.count > 0 && tally.seen.len() as u64 >= options.topic.count {
            until = Some(Instant::now() + options.linger);
        }
        let next = run.within(async {
            tokio::select! {
                sample = subscription.async_recv_serialized() => Some(sample),
                _ = subscription.wait_for_publisher(1, Duration::MAX / 4), if !matched => None,
                () = sleep_until(until.unwrap_or_else(Instant::now)), if until.is_some() => Some(Err("enough".into())),
            }
        });
        match next.await {
            None | Some(Some(Err(_))) => break,
            Some(None) => {
                matched = true;
                emit("matched", json!({ "count": 1 }));
            }
            Some(Some(Ok(sample))) => {
                let now = wall_clock_ns();
                let read = Text::deserialize(&sample.payload().to_bytes()).ok().and_then(|text| text.read());
                if let Some(attachment) =
                    sample.attachment().and_then(|bytes| Attachment::try_from(bytes).ok())
                {
                    tally.note_source(&attachment);
                }
                let intact = tally.add(read, now);
                if options.topic.verbose || !intact {
                    emit("received", json!({ "seq": read.map(|(seq, ..)| seq), "ok": intact }));
                }
            }
        }
    }
    emit("summary", tally.summary(matched));
    if tally.altered > 0 || tally.duplicated > 0 {
        return Ok(WRONG);
    }
    let enough = run.by_signal || tally.seen.len() as u64 >= options.topic.count;
    Ok(if enough { OK } else { INCOMPLETE })
}

/// The record of received messages.
#[derive(Default)]
struct Tally {
    seen: HashSet<u64>,
    last_seq: u64,
    altered: u64,
    duplicated: u64,
    reordered: u64,
    latency_us: Vec<i64>,
    /// The last number of each publisher, by its id.
    numbers: HashMap<[u8; 16], i64>,
    skipped: i64,
    repeated: u64,
}

impl Tally {
    /// Returns whether the message is intact.
    fn add(&mut self, read: Option<(u64, u64, bool)>, now_ns: u64) -> bool {
        let Some((seq, stamp_ns, true)) = read else {
            self.altered += 1;
            return false;
        };
        self.latency_us.push((now_ns as i64 - stamp_ns as i64) / 1000);
        if !self.seen.insert(seq) {
            self.duplicated += 1;
        } else {
            self.reordered += u64::from(seq < self.last_seq);
            self.last_seq = self.last_seq.max(seq);
        }
        true
    }

    fn note_source(&mut self, attachment: &Attachment) {
        let number = attachment.sequence_number;
        if let Some(last) = self.numbers.insert(attachment.source_gid, number) {
            self.skipped += (number - last - 1).max(0);
            self.repeated += u64::from(number <= last);
        }
    }

    fn summary(&mut self, matched: bool) -> Value {
        self.latency_us.sort_unstable();
        let count = self.latency_us.len();
        let at =
            |part: f64| self.latency_us.get(((count as f64 * part) as usize).min(count.saturating_sub(1)));
        let (first, last) = (self.seen.iter().min(), self.seen.iter().max());
        let range = first.zip(last).map_or(0, |(first, last)| last - first + 1);
        json!({
            "role": "sub", "matched": u64::from(matched), "received": self.seen.len(), "first": first, "last": last,
            "lost": range - self.seen.len() as u64,
            "duplicated": self.duplicated, "altered": self.altered, "reordered": self.reordered,
            "latency_us": { "p50": at(0.5), "p99": at(0.99), "max": at(1.0) },
            "publishers": self.numbers.len(), "numbers_skipped": self.skipped, "numbers_repeated": self.repeated,
        })
    }
}
