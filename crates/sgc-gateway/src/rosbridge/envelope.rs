//! [`Envelope`]: a message to a client in JSON or CBOR; [`Frame`]: its form in the WebSocket.

use std::fmt::Write as _;
use std::num::NonZeroUsize;
use std::time::Duration;

use bytes::Bytes;
use serde_json::Value;
use sgc_websocket::{Message, Text};

use super::op::OpId;
use crate::content::Form;

/// The encoding that a client requests for its messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Compression {
    /// JSON text.
    #[default]
    None,
    /// Binary CBOR.
    Cbor,
    /// CBOR around the serialised message.
    CborRaw,
}

impl Compression {
    /// Parses the name of a compression. The error explains why one is not offered.
    pub(super) fn from_name(name: &str) -> Result<Self, &'static str> {
        Ok(match name {
            "none" | "" => Self::None,
            "cbor" => Self::Cbor,
            "cbor-raw" => Self::CborRaw,
            "png" => return Err("compression \"png\" is not offered: take \"cbor\", or \"none\""),
            _ => return Err("compression is \"none\", \"cbor\" or \"cbor-raw\""),
        })
    }

    /// Returns the form of the content.
    pub(super) fn form(self) -> Form {
        match self {
            Self::None => Form::Json,
            Self::Cbor => Form::Cbor,
            Self::CborRaw => Form::Cdr,
        }
    }
}

/// A message for the WebSocket.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Frame {
    Text(Text),
    Binary(Bytes),
    /// A text in fragments of `size` bytes, made one after the other.
    Fragments {
        id: String,
        text: Text,
        size: usize,
    },
}

impl Frame {
    pub(super) fn bytes(&self) -> usize {
        match self {
            Self::Text(text) | Self::Fragments { text, .. } => text.len(),
            Self::Binary(bytes) => bytes.len(),
        }
    }

    /// Returns the WebSocket messages.
    pub(super) fn messages(self) -> impl Iterator<Item = Message> {
        let (whole, pieces) = match self {
            Self::Text(text) => (Some(Message::Text(text)), None),
            Self::Binary(bytes) => (Some(Message::Binary(bytes)), None),
            Self::Fragments { id, text, size } => (None, Some(pieces(id, text, size))),
        };
        whole.into_iter().chain(pieces.into_iter().flatten())
    }
}

/// Splits a text into ops `fragment`, between characters.
fn pieces(id: String, text: Text, size: usize) -> impl Iterator<Item = Message> {
    let total = cuts(&text, size).count();
    let mut at = 0;
    (0..total).map(move |number| {
        let end = cut(&text, at, size);
        let data = Value::from(text.get(at..end).unwrap_or_default());
        at = end;
        let piece =
            format!(r#"{{"op":"fragment","id":"{id}","data":{data},"num":{number},"total":{total}}}"#);
        Message::Text(piece.into())
    })
}

fn cuts(text: &str, size: usize) -> impl Iterator<Item = usize> {
    let mut at = 0;
    std::iter::from_fn(move || {
        (at < text.len()).then(|| {
            at = cut(text, at, size);
            at
        })
    })
}

/// Returns the end of the fragment that begins at `at`. A fragment has at least one character.
fn cut(text: &str, at: usize, size: usize) -> usize {
    let mut end = at.saturating_add(size).min(text.len());
    while end > at && !text.is_char_boundary(end) {
        end -= 1;
    }
    if end == at {
        end = text.get(at..).and_then(|rest| rest.chars().next()).map_or(text.len(), |c| at + c.len_utf8());
    }
    end
}

/// An op that is being written.
#[derive(Debug)]
pub(super) enum Envelope {
    Json(String),
    Cbor { members: u8, out: Vec<u8> },
}

impl Envelope {
    /// Begins an op in JSON.
    pub(super) fn json(op: &str) -> Self {
        Self::Json(format!(r#"{{"op":"{op}""#))
    }

    pub(super) fn new(op: &str, compression: Compression, content_bytes: usize) -> Self {
        match compression {
            Compression::None => {
                let mut out = String::with_capacity(content_bytes + 256);
                let _ = write!(out, r#"{{"op":"{op}""#);
                Self::Json(out)
            }
            _ => {
                let mut out = Vec::with_capacity(content_bytes + 256);
                // The head gets the number of members at the end.
                out.push(0);
                Self::Cbor { members: 0, out }.text("op", op)
            }
        }
    }

    /// Returns a copy of the envelope with room for content.
    pub(super) fn again(&self, content_bytes: usize) -> Self {
        match self {
            Self::Json(begin) => {
                let mut out = String::with_capacity(begin.len() + content_bytes + 16);
                out.push_str(begin);
                Self::Json(out)
            }
            Self::Cbor { members, out: begin } => {
                let mut out = Vec::with_capacity(begin.len() + content_bytes + 64);
                out.extend_from_slice(begin);
                Self::Cbor { members: *members, out }
            }
        }
    }

    fn key(&mut self, key: &str) {
        match self {
            Self::Json(out) => drop(write!(out, r#","{key}":"#)),
            Self::Cbor { members, out } => {
                *members += 1;
                cbor_text(out, key);
            }
        }
    }

    pub(super) fn value(mut self, key: &str, value: &Value) -> Self {
        self.key(key);
        match &mut self {
            Self::Json(out) => drop(write!(out, "{value}")),
            Self::Cbor { out, .. } => cbor_value(out, value),
        }
        self
    }

    pub(super) fn text(self, key: &str, text: &str) -> Self {
        self.value(key, &Value::from(text))
    }

    pub(super) fn id(self, id: Option<&OpId>) -> Self {
        match id {
            None => self,
            Some(OpId::Number(number)) => self.value("id", &Value::from(*number)),
            Some(OpId::Text(text)) => self.text("id", text),
        }
    }

    /// Adds content that has the envelope's encoding already.
    pub(super) fn content(mut self, key: &str, content: &[u8]) -> Self {
        self.key(key);
        match &mut self {
            Self::Json(out) => out.push_str(&String::from_utf8_lossy(content)),
            Self::Cbor { out, .. } => out.extend_from_slice(content),
        }
        self
    }

    /// Adds a serialised message with its time of reception, as `cbor-raw` demands.
    pub(super) fn raw_message(mut self, key: &str, payload: &[u8], received: Duration) -> Self {
        self.key(key);
        if let Self::Cbor { out, .. } = &mut self {
            out.push(0xa3);
            cbor_text(out, "secs");
            cbor_head(out, 0, received.as_secs());
            cbor_text(out, "nsecs");
            cbor_head(out, 0, received.subsec_nanos().into());
            cbor_text(out, "bytes");
            cbor_head(out, 2, payload.len() as u64);
            out.extend_from_slice(payload);
        }
        self
    }

    pub(super) fn finish(self) -> Frame {
        match self {
            Self::Json(mut out) => {
                out.push('}');
                Frame::Text(out.into())
            }
            Self::Cbor { members, mut out } => {
                // The head has room for the number of fewer than 24 members.
                if let Some(head) = out.first_mut() {
                    *head = 0xa0 | members.min(23);
                }
                Frame::Binary(out.into())
            }
        }
    }

    /// Finishes the message, in fragments if it exceeds `size`. CBOR is never split.
    pub(super) fn finish_in_pieces(self, size: Option<NonZeroUsize>, id: impl FnOnce() -> String) -> Frame {
        match (self.finish(), size.map(NonZeroUsize::get)) {
            (Frame::Text(text), Some(size)) if text.len() > size => Frame::Fragments { id: id(), text, size },
            (frame, _) => frame,
        }
    }
}

fn cbor_head(out: &mut Vec<u8>, major: u8, number: u64) {
    let major = major << 5;
    match number {
        0..=23 => out.push(major | number as u8),
        24..=0xff => out.extend_from_slice(&[major | 24, number as u8]),
        0x100..=0xffff => {
            out.push(major | 25);
            out.extend_from_slice(&(number as u16).to_be_bytes());
        }
        0x1_0000..=0xffff_ffff => {
            out.push(major | 26);
            out.extend_from_slice(&(number as u32).to_be_bytes());
        }
        _ => {
            out.push(major | 27);
            out.extend_from_slice(&number.to_be_bytes());
        }
    }
}

fn cbor_text(out: &mut Vec<u8>, text: &str) {
    cbor_head(out, 3, text.len() as u64);
    out.extend_from_slice(text.as_bytes());
}

/// Writes JSON as CBOR (RFC 8949, 6.2). The recursion is shallow, because the values are the gateway's own.
fn cbor_value(out: &mut Vec<u8>, value: &Value) {
    match value {
        Value::Null => out.push(0xf6),
        Value::Bool(value) => out.push(if *value { 0xf5 } else { 0xf4 }),
        Value::Number(number) => match (number.as_u64(), number.as_i64()) {
            (Some(number), _) => cbor_head(out, 0, number),
            (None, Some(number)) => cbor_head(out, 1, number.unsigned_abs() - 1),
            (None, None) => {
                out.push(0xfb);
                out.extend_from_slice(&number.as_f64().unwrap_or(f64::NAN).to_be_bytes());
            }
        },
        Value::String(text) => cbor_text(out, text),
        Value::Array(all) => {
            cbor_head(out, 4, all.len() as u64);
            all.iter().for_each(|value| cbor_value(out, value));
        }
        Value::Object(members) => {
            cbor_head(out, 5, members.len() as u64);
            for (name, value) in members {
                cbor_text(out, name);
                cbor_value(out, value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pieces_make_the_text_again_and_end_between_characters() {
        let text = r#"{"op":"publish","msg":"aöü€𝄞"}"#;
        for size in [1, 2, 3, 7, 1000] {
            let all: Vec<_> = pieces("1".into(), text.into(), size).collect();
            let mut whole = String::new();
            for (number, piece) in all.iter().enumerate() {
                let Message::Text(piece) = piece else { panic!() };
                let piece: Value = serde_json::from_str(piece).unwrap();
                assert_eq!((&piece["num"], &piece["total"]), (&number.into(), &all.len().into()));
                whole.push_str(piece["data"].as_str().unwrap());
            }
            assert_eq!(whole, text, "{size}");
        }
    }

    #[test]
    fn envelopes_say_the_same_in_json_and_cbor() {
        let made = |compression| {
            Envelope::new("x", compression, 0)
                .id(Some(&OpId::Number(-300)))
                .value("v", &serde_json::json!([true, null, 1.5]))
        };
        let Frame::Text(text) = made(Compression::None).content("msg", b"{}").finish() else { panic!() };
        assert_eq!(&*text, r#"{"op":"x","id":-300,"v":[true,null,1.5],"msg":{}}"#);
        let Frame::Binary(bytes) = made(Compression::Cbor).content("msg", &[0xa0]).finish() else { panic!() };
        let mut wanted = vec![0xa4, 0x62, b'o', b'p', 0x61, b'x', 0x62, b'i', b'd', 0x39, 0x01, 0x2b];
        wanted.extend([0x61, b'v', 0x83, 0xf5, 0xf6, 0xfb, 0x3f, 0xf8, 0, 0, 0, 0, 0, 0]);
        wanted.extend([0x63, b'm', b's', b'g', 0xa0]);
        assert_eq!(bytes, wanted);
    }
}
