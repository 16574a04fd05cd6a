//! A stream of numbered messages from an application at the robot to one at the desk, and its verdict.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_ros::{EndpointSpec, RosNetwork, RosWriter, Sample, SampleKind, dds_topic, dds_type};
use sgc_testkit::{FakeDomain, FakeReader, FakeRos};
use sgc_wire::{History, Qos, Reliability};

/// A topic of the stream.
#[derive(Clone, Copy)]
pub(crate) struct Topic {
    pub(crate) name: &'static str,
    pub(crate) reliable: bool,
    period: Duration,
    bytes: usize,
}

pub(crate) const TOPICS: [Topic; 2] = [
    Topic { name: "/state", reliable: true, period: Duration::from_millis(20), bytes: 64 },
    Topic { name: "/video", reliable: false, period: Duration::from_millis(50), bytes: 500 },
];

/// A topic whose publisher comes late.
pub(crate) const LATE: Topic = Topic { name: "/late", ..TOPICS[0] };

impl Topic {
    fn spec(&self) -> EndpointSpec {
        let (reliability, history) = if self.reliable {
            (Reliability::Reliable, History::KeepAll)
        } else {
            (Reliability::BestEffort, History::KeepLast(5))
        };
        EndpointSpec {
            topic: dds_topic(self.name),
            type_name: dds_type("std_msgs/msg/ByteMultiArray"),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos { reliability, history, ..Qos::default() },
        }
    }
}

#[derive(Default)]
struct Exchange {
    said: AtomicU64,
    heard: Mutex<Vec<(Instant, u64)>>,
    /// The talker sends no more messages.
    ends: AtomicBool,
    /// The listener needs no more retransmissions.
    is_over: AtomicBool,
}

pub(crate) struct Flow {
    pub(crate) topic: Topic,
    exchange: Arc<Exchange>,
    talker: Option<JoinHandle<()>>,
    _reader: FakeReader,
    _net: FakeRos,
}

/// A subscriber that counts.
pub(crate) struct Ears {
    count: Arc<AtomicU64>,
    _reader: FakeReader,
    _net: FakeRos,
}

impl Ears {
    pub(crate) fn count(&self) -> u64 {
        self.count.load(SeqCst)
    }
}

/// The result of a flow around an event.
pub(crate) struct Verdict {
    /// Longest time without a message, beyond the usual gap.
    pub(crate) outage: Duration,
    pub(crate) lost: u64,
    pub(crate) doubled: u64,
    /// Messages that came after a later one.
    pub(crate) late: u64,
    pub(crate) heard: u64,
}

impl Flow {
    pub(crate) fn start(topic: Topic, robot: &FakeDomain, desk: &FakeDomain) -> Self {
        let exchange = Arc::<Exchange>::default();
        let net = desk.join(false);
        let hears = Arc::clone(&exchange);
        let handler = Box::new(move |sample: Sample| {
            let number = u64::from_le_bytes(sample.payload[4..12].try_into().unwrap());
            hears.heard.lock().unwrap().push((Instant::now(), number));
        });
        let reader = net.create_reader(&topic.spec(), handler).unwrap();
        let near = robot.join(false);
        let writer = near.create_writer(&topic.spec()).unwrap();
        let its = Arc::clone(&exchange);
        let talker = std::thread::spawn(move || {
            let _near = near;
            for number in 1.. {
                if its.ends.load(SeqCst) {
                    break;
                }
                let mut payload = vec![0; topic.bytes];
                payload[1] = 1;
                payload[4..12].copy_from_slice(&u64::to_le_bytes(number));
                its.said.store(number, SeqCst);
                writer.write(SampleKind::Write, 1, Bytes::from(payload)).unwrap();
                std::thread::sleep(topic.period);
            }
            while !its.is_over.load(SeqCst) {
                std::thread::sleep(topic.period);
            }
        });
        Self { topic, exchange, talker: Some(talker), _reader: reader, _net: net }
    }

    /// Returns a further subscriber of the topic, on another local network.
    pub(crate) fn listen(&self, domain: &FakeDomain) -> Ears {
        let net = domain.join(false);
        let count = Arc::<AtomicU64>::default();
        let hears = Arc::clone(&count);
        let handler = Box::new(move |_: Sample| {
            hears.fetch_add(1, SeqCst);
        });
        let reader = net.create_reader(&self.topic.spec(), handler).unwrap();
        Ears { count, _reader: reader, _net: net }
    }

    /// Returns the number of the last sent message.
    pub(crate) fn said(&self) -> u64 {
        self.exchange.said.load(SeqCst)
    }

    /// Returns `true` if this message or a later one was received.
    pub(crate) fn has_heard(&self, number: u64) -> bool {
        self.exchange.heard.lock().unwrap().iter().rev().any(|(_, heard)| *heard >= number)
    }

    /// Ends the sending.
    pub(crate) fn end(&self) {
        self.exchange.ends.store(true, SeqCst);
    }

    /// Judges all messages. The outage is the longest one since `since`.
    pub(crate) fn judge(&self, since: Instant) -> Verdict {
        let heard = self.exchange.heard.lock().unwrap();
        let mut gap = Duration::ZERO;
        for pair in heard.windows(2).filter(|pair| pair[1].0 >= since) {
            gap = gap.max(pair[1].0 - pair[0].0);
        }
        let (mut newest, mut late) = (0, 0);
        let mut numbers: Vec<_> = heard.iter().map(|(_, number)| *number).collect();
        for number in &numbers {
            late += u64::from(*number < newest);
            newest = newest.max(*number);
        }
        numbers.sort_unstable();
        let all = numbers.len() as u64;
        numbers.dedup();
        let different = numbers.len() as u64;
        // Messages before the first received one had no subscriber.
        let span = numbers.last().map_or(0, |last| last - numbers[0] + 1);
        Verdict {
            outage: gap.saturating_sub(self.topic.period),
            lost: span - different,
            doubled: all - different,
            late,
            heard: different,
        }
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.end();
        self.exchange.is_over.store(true, SeqCst);
        let _ = self.talker.take().map(JoinHandle::join);
    }
}
