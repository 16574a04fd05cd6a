//! What both sides of `sgc bench` say to each other, and the messages that are measured. Pure.
//!
//! All of it travels as ROS 2 messages of one made-up type, in plain CDR, over topics that `sgc` carries: so nobody is heard
//! who is not of the fleet. Questions and answers are JSON inside of such a message.

use std::fmt;
use std::str::FromStr;

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sgc_trust::Suite;

use super::machine::Machine;

/// What both programs must agree on; another number is another version of this file.
pub(crate) const PROTOCOL: u32 = 1;
/// The type of all messages.
pub(crate) const TYPE: &str = "sgc_bench/msg/Frame";
/// Longest question or answer, bytes.
const WORDS_BYTES_MAX: usize = 16 << 10;
/// Encapsulation of plain CDR, little endian (RTPS 2.5, 10.2), and the three fields and the length in front of the data.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];
const FIELDS_BYTES: usize = 20;
/// The largest message that is measured, bytes of data.
pub(crate) const SIZE_MAX: usize = 32_000_000;

/// A way of messages there and back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Lane {
    /// Questions and answers.
    Control,
    /// Sealed in this suite.
    Sealed(Suite),
    /// DDS between the two machines, without `sgc`.
    Direct,
}

impl Lane {
    /// What a report calls it.
    pub(crate) fn name(self) -> String {
        match self {
            Self::Control => "control".to_owned(),
            Self::Sealed(suite) => format!("sgc {}", suite.name()),
            Self::Direct => "direct DDS".to_owned(),
        }
    }

    /// The ROS topic by which the measuring side is heard.
    pub(crate) fn ask(self) -> String {
        format!("/sgc_bench/{}/ask", self.word())
    }

    /// The ROS topic by which it is answered.
    pub(crate) fn answer(self) -> String {
        format!("/sgc_bench/{}/answer", self.word())
    }

    fn word(self) -> String {
        match self {
            Self::Control => "control".to_owned(),
            // No hyphen may stand in a topic's name.
            Self::Sealed(suite) => suite.name().replace('-', "_"),
            Self::Direct => "direct".to_owned(),
        }
    }
}

/// What a message is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// To be sent back.
    Ping,
    /// What was sent back.
    Pong,
    /// One of many that are counted.
    Stream,
    /// One of those that is also answered, without its data, so that whoever sends them knows how far they are.
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
    /// Which measurement it belongs to.
    pub(crate) phase: u32,
    /// What it is for.
    pub(crate) kind: Kind,
    /// Its number there, from 0.
    pub(crate) seq: u64,
    /// As long as the size that is measured.
    pub(crate) data: Bytes,
}

impl Frame {
    /// The serialised sample.
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

    /// Reads a sample, whose data it shares; `None` if it is none of ours.
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
        // What follows is padding on the way, three bytes at most.
        let rest = sample.len().checked_sub(from.checked_add(length)?)?;
        (rest < 4).then_some(Self { phase: word(0)?, kind, seq, data: sample.slice(from..from + length) })
    }

    /// A question or an answer.
    pub(crate) fn words(words: &impl Serialize) -> Self {
        // Of these types every value has a JSON form.
        let data = serde_json::to_vec(words).unwrap_or_default().into();
        Self { phase: 0, kind: Kind::Words, seq: 0, data }
    }

    /// What it says; `None` if it is no such thing, or too long.
    pub(crate) fn said<T: for<'a> Deserialize<'a>>(&self) -> Option<T> {
        let is_words = self.kind == Kind::Words && self.data.len() <= WORDS_BYTES_MAX;
        is_words.then(|| serde_json::from_slice(&self.data).ok()).flatten()
    }
}

/// The number of a run, which nobody can guess: also what opens the plain echo.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct RunId(String);

impl RunId {
    const BYTES: usize = 16;

    /// One of random bytes.
    pub(crate) fn new(bytes: [u8; Self::BYTES]) -> Self {
        Self(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// As it is said to the echo: always so many bytes.
    pub(crate) fn token(&self) -> Option<[u8; Self::BYTES * 2]> {
        self.0.as_bytes().try_into().ok()
    }
}

/// From the side that measures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Question {
    /// Of which run.
    pub(crate) run: RunId,
    /// What.
    pub(crate) ask: Ask,
}

/// What is asked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Ask {
    /// May we begin?
    Hello {
        /// [`PROTOCOL`].
        protocol: u32,
        /// Version of the program.
        version: String,
        /// Suites that are to be measured.
        suites: Vec<String>,
    },
    /// Open the plain echo for whoever is linked to you.
    Echo,
    /// Join a DDS domain in which we find each other without `sgc`.
    Direct,
    /// What did you count?
    Count {
        /// Of which measurement.
        phase: u32,
    },
    /// That was all.
    Bye,
}

/// From the side that answers.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct Answer {
    /// Whom it answers.
    pub(crate) run: RunId,
    /// What.
    pub(crate) tell: Tell,
}

/// What is answered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Tell {
    /// Begin.
    Welcome {
        /// Version of the program.
        version: String,
        /// What it runs on.
        machine: Machine,
    },
    /// Not now, or not so.
    Refused {
        /// Why, and what to do.
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
        /// Its number.
        domain: u32,
    },
    /// The echo or the domain is not.
    Without {
        /// Why, and what to do.
        reason: String,
    },
    /// So many came.
    Counted(Counted),
}

/// What came of one measurement.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Counted {
    /// Which.
    pub(crate) phase: u32,
    /// Messages, each counted once.
    pub(crate) received: u64,
    /// Messages that had come before.
    pub(crate) repeated: u64,
    /// From the first to the last of them, microseconds of that side's clock.
    pub(crate) us: u64,
    /// What the node there has used of its processors so far, microseconds.
    pub(crate) node_cpu_us: u64,
}

/// A size of messages, as `1000`, `64kB` or `1MB`: powers of ten.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub(crate) struct Size(pub(crate) usize);

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
    fn frames_are_read_as_they_were_made_also_with_padding() {
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
    fn what_is_cut_or_foreign_is_no_frame() {
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
    fn words_survive_and_long_ones_are_not_read() {
        let run = RunId::new([3; 16]);
        assert_eq!(run.token().map(|t| t.len()), Some(32));
        let question = Question { run, ask: Ask::Count { phase: 3 } };
        assert_eq!(Frame::words(&question).said(), Some(question));
        let long = Frame::words(&"x".repeat(WORDS_BYTES_MAX));
        assert_eq!(long.said::<String>(), None);
    }

    #[test]
    fn sizes_are_read_and_shown() {
        let shown = |text: &str| text.parse::<Size>().map(|size| size.to_string());
        for (text, told) in [("16", "16 B"), ("64kB", "64 kB"), ("1MB", "1 MB"), ("1500000", "1.5 MB")] {
            assert_eq!(shown(text).as_deref(), Ok(told));
        }
        for text in ["", "0", "-1", "1GB", "x", "33MB", "99999999999999999999MB", "1 0"] {
            assert!(shown(text).is_err(), "{text}");
        }
    }
}
