//! The protocol between both sides of `sgc bench`, and the measured messages. Pure.
//!
//! All messages have one private ROS 2 type, in plain CDR, and travel over topics that `sgc` carries, so only members
//! of the fleet take part. Questions and answers are JSON inside such a message.

use std::fmt;
use std::str::FromStr;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sgc_trust::Suite;

use crate::machine::Machine;

/// Version of this protocol, on which both programs must agree.
pub(crate) const PROTOCOL: u32 = 1;
/// The type of all messages.
pub(crate) const TYPE: &str = "sgc_bench/msg/Frame";
/// Longest question or answer, bytes.
const WORDS_BYTES_MAX: usize = 16 << 10;
/// Encapsulation of plain CDR, little endian (RTPS 2.5, 10.2), and the three fields and the length in front of the
/// data.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
const FIELDS_BYTES: usize = 20;
/// Largest measured message, in bytes of data.
pub(crate) const SIZE_MAX: usize = 32_000_000;

/// A pair of topics that carries messages there and back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Channel {
    /// Questions and answers.
    Control,
    /// Messages sealed in this suite.
    Sealed(Suite),
    /// DDS between the two machines, without `sgc`.
    Direct,
}

impl Channel {
    /// Returns the channel's name in reports.
    pub(crate) fn name(self) -> String {
        match self {
            Self::Control => "control".to_owned(),
            Self::Sealed(suite) => format!("sgc {}", suite.name()),
            Self::Direct => "direct DDS".to_owned(),
        }
    }

    /// Returns the ROS topic on which the measuring side publishes.
    pub(crate) fn ask(self) -> String {
        format!("/sgc_bench/{}/ask", self.word())
    }

    /// Returns the ROS topic on which the answering side publishes.
    pub(crate) fn answer(self) -> String {
        format!("/sgc_bench/{}/answer", self.word())
    }

    fn word(self) -> String {
        match self {
            Self::Control => "control".to_owned(),
            // Topic names cannot contain hyphens.
            Self::Sealed(suite) => suite.name().replace('-', "_"),
            Self::Direct => "direct".to_owned(),
        }
    }
}

/// The purpose of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// A message to be echoed.
    Ping,
    /// The echo of a ping, or the answer to a marked message.
    Pong,
    /// A message of a stream, to be counted.
    Stream,
    /// A message of a stream that is also answered, without its data, so that the sender knows the progress.
    Marked,
    /// A question or an answer.
    Words,
}

impl Kind {
    const ALL: [Self; 5] = [Self::Ping, Self::Pong, Self::Stream, Self::Marked, Self::Words];
}

/// A message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Frame {
    /// The number of the measurement.
    pub(crate) phase: u32,
    /// The purpose of the message.
    pub(crate) kind: Kind,
    /// The message's number in the measurement, from 0.
    pub(crate) seq: u64,
    /// The content, as long as the measured size.
    pub(crate) data: Bytes,
}

impl Frame {
    /// Serialises the message to a sample.
    pub(crate) fn encode(&self) -> Bytes {
        let mut bytes = Vec::with_capacity(ENCAPSULATION.len() + FIELDS_BYTES + self.data.len());
        bytes.extend(ENCAPSULATION);
        bytes.extend(self.phase.to_le_bytes());
        bytes.extend((self.kind as u32).to_le_bytes());
        bytes.extend(self.seq.to_le_bytes());
        bytes.extend((self.data.len() as u32).to_le_bytes());
        bytes.extend_from_slice(&self.data);
        bytes.into()
    }

    /// Parses a sample without copying its data. Returns `None` if it is no such message.
    pub(crate) fn decode(sample: &Bytes) -> Option<Self> {
        let body = sample.get(ENCAPSULATION.len()..)?;
        let word = |at: usize| Some(u32::from_le_bytes(body.get(at..at + 4)?.try_into().ok()?));
        if sample.get(..2)? != &ENCAPSULATION[..2] {
            return None;
        }
        let kind = word(4)?;
        let kind = Kind::ALL.into_iter().find(|k| *k as u32 == kind)?;
        let seq = u64::from_le_bytes(body.get(8..16)?.try_into().ok()?);
        let length = word(16)? as usize;
        let from = ENCAPSULATION.len() + FIELDS_BYTES;
        // DDS pads a sample with at most three bytes.
        let rest = sample.len().checked_sub(from.checked_add(length)?)?;
        (rest < 4).then_some(Self { phase: word(0)?, kind, seq, data: sample.slice(from..from + length) })
    }

    /// Wraps a question or an answer.
    pub(crate) fn words(words: &impl Serialize) -> Self {
        // Every value of these types has a JSON form.
        let data = serde_json::to_vec(words).unwrap_or_default().into();
        Self { phase: 0, kind: Kind::Words, seq: 0, data }
    }

    /// Parses a question or an answer. Returns `None` if the message is none, or too long.
    pub(crate) fn said<T: for<'a> Deserialize<'a>>(&self) -> Option<T> {
        let is_words = self.kind == Kind::Words && self.data.len() <= WORDS_BYTES_MAX;
        is_words.then(|| serde_json::from_slice(&self.data).ok()).flatten()
    }
}

/// The random id of a run. It also opens the plain echo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct RunId(String);

impl RunId {
    const BYTES: usize = 16;

    /// Returns the id made of these random bytes.
    pub(crate) fn new(bytes: [u8; Self::BYTES]) -> Self {
        Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// Returns the id as sent to the echo, with a fixed length.
    pub(crate) fn token(&self) -> Option<[u8; Self::BYTES * 2]> {
        self.0.as_bytes().try_into().ok()
    }
}

/// A question of the measuring side.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Question {
    /// The run that it belongs to.
    pub(crate) run: RunId,
    /// The question itself.
    pub(crate) ask: Ask,
}

/// The content of a question.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Ask {
    /// Asks to begin a run.
    Hello {
        /// [`PROTOCOL`].
        protocol: u32,
        /// Version of the program.
        version: String,
        /// Suites to measure.
        suites: Vec<String>,
    },
    /// Asks to open the plain echo for the linked peer.
    Echo,
    /// Asks to join a DDS domain in which both sides find each other without `sgc`.
    Direct,
    /// Asks for the count of a measurement.
    Count {
        /// The number of the measurement.
        phase: u32,
    },
    /// Ends the run.
    Bye,
}

/// An answer of the answering side.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Answer {
    /// The run that it belongs to.
    pub(crate) run: RunId,
    /// The answer itself.
    pub(crate) tell: Reply,
}

/// The content of an answer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Reply {
    /// The run may begin.
    Welcome {
        /// Version of the program.
        version: String,
        /// The answering machine.
        machine: Machine,
    },
    /// The request is refused.
    Refused {
        /// The cause, with the remedy.
        reason: String,
    },
    /// The echo is open.
    Echo {
        /// TCP port.
        tcp: u16,
        /// UDP port.
        udp: u16,
    },
    /// The domain is joined.
    Direct {
        /// The domain's number.
        domain: u32,
    },
    /// The echo is not open, or the domain is not joined.
    Without {
        /// The cause, with the remedy.
        reason: String,
    },
    /// The count of a measurement.
    Counted(StreamCount),
}

/// The count of one measurement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct StreamCount {
    /// The number of the measurement.
    pub(crate) phase: u32,
    /// Messages, each counted once.
    pub(crate) received: u64,
    /// Repeated messages.
    pub(crate) repeated: u64,
    /// Time from the first to the last message, in microseconds of that side's clock.
    pub(crate) us: u64,
    /// Processor time that the node there has used so far, in microseconds.
    pub(crate) node_cpu_us: u64,
}

/// A size of messages, as `1000`, `64kB` or `1MB`: powers of ten.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Size(pub usize);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
        let unit = match text[digits.len()..].to_ascii_lowercase().as_str() {
            "" | "b" => 1,
            "k" | "kb" => 1000,
            "m" | "mb" => 1_000_000,
            _ => 0,
        };
        let size = digits.parse::<usize>().ok().and_then(|n| n.checked_mul(unit));
        let size = size.filter(|n| (1..=SIZE_MAX).contains(n));
        size.map(Self).ok_or_else(|| format!("a size is 1 to {SIZE_MAX} bytes, such as 16, 64kB or 1MB"))
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            n if n >= 1_000_000 && n % 100_000 == 0 => write!(f, "{} MB", n as f64 / 1e6),
            n if n >= 1000 && n % 1000 == 0 => write!(f, "{} kB", n / 1000),
            n => write!(f, "{n} B"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_survive_encoding_and_padding() {
        for kind in Kind::ALL {
            for length in [0, 1, 16, 1001] {
                let frame = Frame { phase: 7, kind, seq: 1 << 40, data: vec![5; length].into() };
                let mut sample = frame.encode().to_vec();
                assert_eq!(Frame::decode(&sample.clone().into()), Some(frame.clone()));
                sample.resize(sample.len().next_multiple_of(4), 0);
                assert_eq!(Frame::decode(&sample.into()), Some(frame));
            }
        }
    }

    #[test]
    fn cut_or_foreign_sample_is_no_frame() {
        let frame = Frame { phase: 7, kind: Kind::Ping, seq: 1, data: vec![5; 9].into() };
        let sample = frame.encode();
        for length in 0..sample.len() {
            assert_eq!(Frame::decode(&sample.slice(..length)), None, "{length}");
        }
        let mut long = sample.to_vec();
        long.resize(long.len() + 4, 0);
        assert_eq!(Frame::decode(&long.into()), None);
        let mut huge = sample.to_vec();
        huge[20..24].copy_from_slice(&u32::MAX.to_le_bytes());
        assert_eq!(Frame::decode(&huge.into()), None);
        let mut other = sample.to_vec();
        other[8] = 9;
        assert_eq!(Frame::decode(&other.into()), None);
    }

    #[test]
    fn questions_survive_encoding_and_long_ones_are_ignored() {
        let run = RunId::new([3; 16]);
        assert_eq!(run.token().map(|t| t.len()), Some(32));
        let question = Question { run, ask: Ask::Count { phase: 3 } };
        assert_eq!(Frame::words(&question).said(), Some(question));
        let long = Frame::words(&"x".repeat(WORDS_BYTES_MAX));
        assert_eq!(long.said::<String>(), None);
    }

    #[test]
    fn sizes_are_parsed_and_formatted() {
        let shown = |text: &str| text.parse::<Size>().map(|size| size.to_string());
        for (text, told) in [("16", "16 B"), ("64kB", "64 kB"), ("1MB", "1 MB"), ("1500000", "1.5 MB")] {
            assert_eq!(shown(text).as_deref(), Ok(told));
        }
        for text in ["", "0", "-1", "1GB", "x", "33MB", "99999999999999999999MB", "1 0"] {
            assert!(shown(text).is_err(), "{text}");
        }
    }
}
