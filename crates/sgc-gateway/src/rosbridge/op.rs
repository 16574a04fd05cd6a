//! [`Op`]: a client's message as its members, which are validated on access.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, Visitor};
use serde_json::value::RawValue;

use crate::error::GatewayError;

/// Longest echoed id, in bytes.
const ID_BYTES_MAX: usize = 1024;
/// Longest name of a topic, type or other item, in bytes, because names are echoed, too.
const NAME_BYTES_MAX: usize = 1024;
/// Most members of an op; a valid op has at most a dozen.
const MEMBERS_MAX: usize = 64;
/// Longest echoed name of an op, in bytes.
const OP_BYTES_MAX: usize = 64;
/// Longest error text for a client, in bytes. Several names fit.
const TOLD_BYTES_MAX: usize = 4096;
/// Most characters of input that are shown in an error.
const SHOWN_MAX: usize = 80;
/// Longest time that a client can give, in seconds.
const SECONDS_MAX: f64 = 1e9;

/// The id of an op, which its answers repeat.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum OpId {
    Number(i64),
    Text(Arc<str>),
}

impl fmt::Display for OpId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number(number) => number.fmt(f),
            Self::Text(text) => text.fmt(f),
        }
    }
}

/// The reason why an op is refused, in words for the client's user.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(super) enum OpError {
    #[error("not JSON: {0}")]
    NotJson(String),
    #[error("not an object with a member \"op\"")]
    NoOp,
    #[error("an object with more than {MEMBERS_MAX} members")]
    TooManyMembers,
    #[error("there is no op {0:?}")]
    UnknownOp(String),
    #[error("{op}: {member:?} is missing")]
    Missing { op: String, member: &'static str },
    #[error("{op}: {member:?} is no {expected}: {found}")]
    Kind { op: String, member: &'static str, expected: &'static str, found: String },
    #[error("{op}: {member:?} is longer than {NAME_BYTES_MAX} bytes")]
    TooLong { op: String, member: &'static str },
    #[error("{op}: {source}")]
    Gateway { op: String, source: Box<GatewayError> },
    #[error("{op}: {why}")]
    Refused { op: String, why: String },
}

/// A message of a client.
#[derive(Debug)]
pub(super) struct Op<'a> {
    pub(super) name: Cow<'a, str>,
    pub(super) id: Option<OpId>,
    members: BTreeMap<Cow<'a, str>, &'a RawValue>,
}

/// The members of an object, at most [`MEMBERS_MAX`].
struct Members<'a>(BTreeMap<Cow<'a, str>, &'a RawValue>);

impl<'de: 'a, 'a> Deserialize<'de> for Members<'a> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Reader;

        impl<'de> Visitor<'de> for Reader {
            type Value = BTreeMap<Cow<'de, str>, &'de RawValue>;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("an object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Self::Value, A::Error> {
                let mut members = BTreeMap::new();
                // Repeated members count, too.
                let mut count = 0;
                while let Some((key, value)) = map.next_entry::<Cow<'de, str>, &'de RawValue>()? {
                    count += 1;
                    if count > MEMBERS_MAX {
                        return Err(A::Error::custom(OpError::TooManyMembers));
                    }
                    members.insert(key, value);
                }
                Ok(members)
            }
        }

        deserializer.deserialize_map(Reader).map(Members)
    }
}

impl<'a> Op<'a> {
    /// Parses the members, but no values except the op and its id.
    pub(super) fn parse(text: &'a str) -> Result<Self, OpError> {
        let Members(members) = serde_json::from_str(text).map_err(|error| {
            let is_object = text.trim_start().starts_with('{');
            match (error.is_data(), is_object) {
                (true, true) => OpError::TooManyMembers,
                (true, false) => OpError::NoOp,
                (false, _) => OpError::NotJson(error.to_string()),
            }
        })?;
        let name = members.get("op").and_then(|name| text_of(name)).ok_or(OpError::NoOp)?;
        let mut op = Self { name, id: None, members };
        op.id = op.read_id()?;
        Ok(op)
    }

    fn read_id(&self) -> Result<Option<OpId>, OpError> {
        let Some(raw) = self.raw("id") else { return Ok(None) };
        if let Ok(number) = raw.parse() {
            return Ok(Some(OpId::Number(number)));
        }
        let text = serde_json::from_str::<String>(raw).ok().filter(|text| text.len() <= ID_BYTES_MAX);
        let text = text.ok_or_else(|| self.no("id", "text or integer", raw))?;
        Ok(Some(OpId::Text(text.into())))
    }

    /// Returns the name for echoing.
    pub(super) fn shown(&self) -> String {
        clip(&self.name, OP_BYTES_MAX)
    }

    fn no(&self, member: &'static str, expected: &'static str, found: &str) -> OpError {
        OpError::Kind { op: self.shown(), member, expected, found: short(found) }
    }

    pub(super) fn refused(&self, why: impl Into<String>) -> OpError {
        OpError::Refused { op: self.shown(), why: why.into() }
    }

    pub(super) fn gateway(&self, source: GatewayError) -> OpError {
        OpError::Gateway { op: self.shown(), source: Box::new(source) }
    }

    fn missing(&self, member: &'static str) -> OpError {
        OpError::Missing { op: self.shown(), member }
    }

    /// Returns a member as it was sent, or `None` for `null`.
    pub(super) fn raw(&self, member: &str) -> Option<&'a str> {
        self.members.get(member).map(|raw| raw.get()).filter(|raw| *raw != "null")
    }

    pub(super) fn text(&self, member: &'static str) -> Result<Option<String>, OpError> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        let text = serde_json::from_str(raw).map_err(|_| self.no(member, "text", raw))?;
        Ok(Some(text))
    }

    /// Returns a text within the length of a name.
    pub(super) fn name(&self, member: &'static str) -> Result<Option<String>, OpError> {
        match self.text(member)? {
            Some(name) if name.len() > NAME_BYTES_MAX => Err(OpError::TooLong { op: self.shown(), member }),
            name => Ok(name),
        }
    }

    pub(super) fn needed_name(&self, member: &'static str) -> Result<String, OpError> {
        self.name(member)?.ok_or_else(|| self.missing(member))
    }

    pub(super) fn needed_text(&self, member: &'static str) -> Result<String, OpError> {
        self.text(member)?.ok_or_else(|| self.missing(member))
    }

    /// Returns an object as it was sent.
    pub(super) fn object(&self, member: &'static str) -> Result<Option<&'a str>, OpError> {
        match self.raw(member) {
            Some(raw) if !raw.starts_with('{') => Err(self.no(member, "object", raw)),
            raw => Ok(raw),
        }
    }

    pub(super) fn needed_object(&self, member: &'static str) -> Result<&'a str, OpError> {
        self.object(member)?.ok_or_else(|| self.missing(member))
    }

    pub(super) fn bool(&self, member: &'static str) -> Result<Option<bool>, OpError> {
        match self.raw(member) {
            None => Ok(None),
            Some("true") => Ok(Some(true)),
            Some("false") => Ok(Some(false)),
            Some(raw) => Err(self.no(member, "bool", raw)),
        }
    }

    /// Returns a number that is not negative. Integers may be written as floats.
    pub(super) fn count(&self, member: &'static str) -> Result<Option<usize>, OpError> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        if let Ok(count) = raw.parse() {
            return Ok(Some(count));
        }
        match raw.parse::<f64>() {
            Ok(count) if (0.0..=u32::MAX.into()).contains(&count) && count.fract() == 0.0 => {
                Ok(Some(count as usize))
            }
            _ => Err(self.no(member, "number of 0 or more", raw)),
        }
    }

    pub(super) fn integer(&self, member: &'static str) -> Result<Option<i64>, OpError> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        raw.parse().map(Some).map_err(|_| self.no(member, "integer", raw))
    }

    /// Returns a time in seconds, or `None` if it is not positive.
    pub(super) fn seconds(&self, member: &'static str) -> Result<Option<Duration>, OpError> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        let seconds: f64 = raw.parse().map_err(|_| self.no(member, "number of seconds", raw))?;
        Ok((seconds > 0.0).then(|| Duration::from_secs_f64(seconds.min(SECONDS_MAX))))
    }
}

fn text_of<'a>(raw: &'a RawValue) -> Option<Cow<'a, str>> {
    let raw = raw.get();
    match serde_json::from_str::<&'a str>(raw) {
        Ok(text) => Some(Cow::Borrowed(text)),
        Err(_) => serde_json::from_str::<String>(raw).ok().map(Cow::Owned),
    }
}

/// Returns the text of an error for a client.
pub(super) fn told(error: &impl fmt::Display) -> String {
    clip(&error.to_string(), TOLD_BYTES_MAX)
}

/// Returns the beginning of a text.
fn clip(text: &str, bytes_max: usize) -> String {
    if text.len() <= bytes_max {
        return text.to_owned();
    }
    let end = (0..=bytes_max).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
    format!("{}…", text.get(..end).unwrap_or_default())
}

pub(super) fn short(text: &str) -> String {
    let mut shown: String = text.chars().take(SHOWN_MAX).collect();
    if shown.len() < text.len() {
        shown.push('…');
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_are_read_as_what_they_are() {
        let op = Op::parse(
            r#"{"op":"x","id":"a\"b","n":3,"f":2.0,"no":null,"t":true,"o":{"a":[1]},"s":0.25,"m":-1}"#,
        )
        .unwrap();
        assert_eq!((op.name.as_ref(), &op.id), ("x", &Some(OpId::Text("a\"b".into()))));
        assert_eq!((op.count("n").unwrap(), op.count("f").unwrap()), (Some(3), Some(2)));
        assert_eq!((op.text("no").unwrap(), op.bool("t").unwrap()), (None, Some(true)));
        assert_eq!(op.object("o").unwrap(), Some(r#"{"a":[1]}"#));
        assert_eq!(op.seconds("s").unwrap(), Some(Duration::from_millis(250)));
        assert_eq!((op.seconds("m").unwrap(), op.integer("m").unwrap()), (None, Some(-1)));
        let errors = [
            op.count("m").unwrap_err(),
            op.text("n").unwrap_err(),
            op.object("n").unwrap_err(),
            op.needed_name("topic").unwrap_err(),
        ];
        let told: Vec<_> = errors.iter().map(ToString::to_string).collect();
        assert_eq!(
            told,
            [
                r#"x: "m" is no number of 0 or more: -1"#,
                r#"x: "n" is no text: 3"#,
                r#"x: "n" is no object: 3"#,
                r#"x: "topic" is missing"#,
            ]
        );
    }

    #[test]
    fn echoed_text_is_short() {
        let text = format!(r#"{{"op":"{}","n":"{}"}}"#, "ä".repeat(10_000), "x".repeat(10_000));
        let op = Op::parse(&text).unwrap();
        let errors =
            [op.count("n").unwrap_err(), op.needed_name("topic").unwrap_err(), op.name("n").unwrap_err()];
        for error in errors.into_iter().chain([op.refused("no")]) {
            assert!(error.to_string().len() < 500, "{error}");
        }
        assert!(told(&op.refused("ä".repeat(10_000))).len() <= TOLD_BYTES_MAX + "…".len());
    }

    #[test]
    fn invalid_ops_are_reported() {
        for wrong in ["[]", "3", "null", "{}", r#"{"op":3}"#] {
            assert_eq!(Op::parse(wrong).unwrap_err(), OpError::NoOp, "{wrong}");
        }
        for wrong in ["", "{", r#"{"op":"x""#, r#"{"op":"x"} x"#, "{'op':1}", "nonsense"] {
            assert!(matches!(Op::parse(wrong).unwrap_err(), OpError::NotJson(_)), "{wrong}");
        }
        let deep = format!(r#"{{"op":"x","msg":{}{}}}"#, "[".repeat(100_000), "]".repeat(100_000));
        assert!(Op::parse(&deep).is_ok());
        assert!(Op::parse(r#"{"op":"x","id":1.5}"#).is_err());
        let of_members = |count: usize| {
            let more: String = (1..count).map(|n| format!(",\"m{}\":0", n % 50)).collect();
            format!(r#"{{"op":"x"{more}}}"#)
        };
        assert!(Op::parse(&of_members(MEMBERS_MAX)).is_ok());
        assert_eq!(Op::parse(&of_members(MEMBERS_MAX + 1)).unwrap_err(), OpError::TooManyMembers);
        assert_eq!(Op::parse(r#"{"op":"x","id":7}"#).unwrap().id, Some(OpId::Number(7)));
    }
}
