//! The DDS programs of `sgc bench`: plain participants that do not know `sgc`, like ROS 2 programs.
//!
//! One end of a channel writes on one topic and reads on the other. The answering end echoes pings and counts streams
//! on the reading thread. Everything else goes to the measurement as an [`Event`].

use std::sync::mpsc::SyncSender;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use sgc_dds::{CycloneNetwork, CycloneReader, CycloneWriter};
use sgc_ros::{EndpointSpec, RosError, RosNetwork, RosWriter, Sample, SampleKind, dds_topic, dds_type};
use sgc_sync::lock;
use sgc_wire::{History, Qos};

use crate::event::Event;
use crate::words::{Channel, Frame, Kind, StreamCount, TYPE};

/// Depth of a reader, which exceeds the number of messages in flight.
const READER_DEPTH: u32 = 4096;
/// Longest time a message may wait until the local network takes it.
const WRITE_MAX: Duration = Duration::from_secs(10);

/// The progress of a stream.
#[derive(Debug, Default)]
pub(crate) struct Tally {
    phase: u32,
    received: u64,
    repeated: u64,
    last_seq: Option<u64>,
    span: Option<(Instant, Instant)>,
}

impl Tally {
    /// Counts a message. A message of another measurement begins a new count.
    fn count(&mut self, frame: &Frame, now: Instant) {
        if frame.phase != self.phase {
            *self = Self { phase: frame.phase, ..Self::default() };
        }
        // Messages of a stream arrive in order or not at all, so a lower number is a repetition.
        if self.last_seq.is_some_and(|last| frame.seq <= last) {
            self.repeated += 1;
            return;
        }
        self.received += 1;
        self.last_seq = Some(frame.seq);
        self.span = Some((self.span.map_or(now, |(first, _)| first), now));
    }

    /// Returns the count of a measurement, which is empty unless the measurement is the latest.
    pub(crate) fn stream_count(&self, phase: u32) -> StreamCount {
        if phase != self.phase {
            return StreamCount { phase, ..StreamCount::default() };
        }
        let us = self.span.map_or(0, |(first, last)| last.duration_since(first).as_micros() as u64);
        StreamCount { phase, received: self.received, repeated: self.repeated, us, node_cpu_us: 0 }
    }
}

/// One end of a channel.
pub(crate) struct End {
    writer: Arc<CycloneWriter>,
    _reader: CycloneReader,
}

impl End {
    /// Opens the end that asks and measures.
    pub(crate) fn asking(
        network: &CycloneNetwork,
        channel: Channel,
        events: SyncSender<Event>,
    ) -> Result<Self, RosError> {
        let writer = Arc::new(network.create_writer(&spec(&channel.ask(), History::KeepAll))?);
        let reader = network.create_reader(
            &spec(&channel.answer(), History::KeepLast(READER_DEPTH)),
            Box::new(move |sample: Sample| {
                let now = Instant::now();
                if let Some(frame) = Frame::decode(&sample.payload) {
                    // A failure means that the measurement is over; this reader ends soon as well.
                    let _ = events.send(Event::Frame(channel, frame, now));
                }
            }),
        )?;
        Ok(Self { writer, _reader: reader })
    }

    /// Opens the end that answers and counts.
    pub(crate) fn answering(
        network: &CycloneNetwork,
        channel: Channel,
        tally: Arc<Mutex<Tally>>,
        events: SyncSender<Event>,
    ) -> Result<Self, RosError> {
        let writer = Arc::new(network.create_writer(&spec(&channel.answer(), History::KeepAll))?);
        let back = Arc::clone(&writer);
        let reader = network.create_reader(
            &spec(&channel.ask(), History::KeepLast(READER_DEPTH)),
            Box::new(move |sample: Sample| {
                let now = Instant::now();
                let Some(frame) = Frame::decode(&sample.payload) else { return };
                let answer = match frame.kind {
                    Kind::Ping => Frame { kind: Kind::Pong, ..frame },
                    Kind::Stream | Kind::Marked => {
                        lock(&tally).count(&frame, now);
                        if frame.kind == Kind::Stream {
                            return;
                        }
                        Frame { kind: Kind::Pong, data: Default::default(), ..frame }
                    }
                    Kind::Pong => return,
                    Kind::Words => {
                        let _ = events.send(Event::Frame(channel, frame, now));
                        return;
                    }
                };
                if let Err(error) = write(&back, &answer) {
                    tracing::warn!(%error, "an answer was not sent");
                }
            }),
        )?;
        Ok(Self { writer, _reader: reader })
    }

    /// Sends a message. Waits while the local network does not take it.
    pub(crate) fn send(&self, frame: &Frame) -> Result<(), RosError> {
        write(&self.writer, frame)
    }

    /// Returns `true` if a reader on the local network matches.
    pub(crate) fn is_heard(&self) -> bool {
        self.writer.matched_readers() > 0
    }
}

fn write(writer: &CycloneWriter, frame: &Frame) -> Result<(), RosError> {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let stamp = i64::try_from(since_epoch.as_nanos()).unwrap_or(0);
    let payload = frame.encode();
    let begun = Instant::now();
    loop {
        match writer.write(SampleKind::Write, stamp, payload.clone()) {
            Err(RosError::WriteTimeout { .. }) if begun.elapsed() < WRITE_MAX => {}
            other => return other,
        }
    }
}

fn spec(topic: &str, history: History) -> EndpointSpec {
    let qos = Qos { history, ..Qos::default() };
    EndpointSpec {
        topic: dds_topic(topic),
        type_name: dds_type(TYPE),
        keyless: true,
        asks_key_hash: false,
        type_hash: None,
        qos,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(phase: u32, seq: u64) -> Frame {
        Frame { phase, kind: Kind::Stream, seq, data: Default::default() }
    }

    #[test]
    fn repeated_messages_are_counted_once_and_each_measurement_separately() {
        let (begun, mut tally) = (Instant::now(), Tally::default());
        for (n, seq) in [0, 1, 1, 3, 2].into_iter().enumerate() {
            tally.count(&frame(4, seq), begun + Duration::from_millis(n as u64));
        }
        let counted = StreamCount { phase: 4, received: 3, repeated: 2, us: 3000, node_cpu_us: 0 };
        assert_eq!(tally.stream_count(4), counted);
        assert_eq!(tally.stream_count(5), StreamCount { phase: 5, ..StreamCount::default() });
        tally.count(&frame(5, 0), begun);
        assert_eq!((tally.stream_count(5).received, tally.stream_count(4).received), (1, 0));
    }
}
