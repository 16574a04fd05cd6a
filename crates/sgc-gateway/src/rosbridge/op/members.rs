//! [`Members`]: the members of a client's message, which an op reads as their types.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, Visitor};
use serde_json::value::RawValue;

use super::error::{MEMBERS_MAX, NAME_BYTES_MAX, OpError, Refusal};
use super::name::OpId;
use super::text::short;

/// Longest echoed id, in bytes.
const ID_BYTES_MAX: usize = 1024;
/// Longest time that a client can give, in seconds.
const SECONDS_MAX: f64 = 1e9;

/// The members of an object, at most [`MEMBERS_MAX`].
#[derive(Debug)]
pub(super) struct Members<'a>(BTreeMap<Cow<'a, str>, &'a RawValue>);

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

impl<'a> Members<'a> {
    /// Parses the members, but no values.
    pub(super) fn parse(text: &'a str) -> Result<Self, OpError> {
        serde_json::from_str(text).map_err(|error| {
            let is_object = text.trim_start().starts_with('{');
            match (error.is_data(), is_object) {
                (true, true) => OpError::TooManyMembers,
                (true, false) => OpError::NoOp,
                (false, _) => OpError::NotJson(error.to_string()),
            }
        })
    }

    /// Returns the name of the op.
    pub(super) fn op(&self) -> Result<Cow<'a, str>, OpError> {
        self.raw("op").and_then(text_of).ok_or(OpError::NoOp)
    }

    pub(super) fn id(&self) -> Result<Option<OpId>, Refusal> {
        let Some(raw) = self.raw("id") else { return Ok(None) };
        if let Ok(number) = raw.parse() {
            return Ok(Some(OpId::Number(number)));
        }
        let text = text_of(raw).filter(|text| text.len() <= ID_BYTES_MAX);
        let text = text.ok_or_else(|| kind("id", "text or integer", raw))?;
        Ok(Some(OpId::Text(text.into())))
    }

    /// Returns a member as it was sent, or `None` for `null`.
    pub(super) fn raw(&self, member: &str) -> Option<&'a str> {
        self.0.get(member).map(|raw| raw.get()).filter(|raw| *raw != "null")
    }

    pub(super) fn text(&self, member: &'static str) -> Result<Option<Cow<'a, str>>, Refusal> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        text_of(raw).map(Some).ok_or_else(|| kind(member, "text", raw))
    }

    /// Returns a text within the length of a name.
    pub(super) fn name(&self, member: &'static str) -> Result<Option<Cow<'a, str>>, Refusal> {
        match self.text(member)? {
            Some(name) if name.len() > NAME_BYTES_MAX => Err(Refusal::TooLong(member)),
            name => Ok(name),
        }
    }

    pub(super) fn needed_name(&self, member: &'static str) -> Result<Cow<'a, str>, Refusal> {
        needed(member, self.name(member)?)
    }

    pub(super) fn needed_text(&self, member: &'static str) -> Result<Cow<'a, str>, Refusal> {
        needed(member, self.text(member)?)
    }

    /// Returns an object as it was sent.
    pub(super) fn object(&self, member: &'static str) -> Result<Option<&'a str>, Refusal> {
        match self.raw(member) {
            Some(raw) if !raw.starts_with('{') => Err(kind(member, "object", raw)),
            raw => Ok(raw),
        }
    }

    pub(super) fn needed_object(&self, member: &'static str) -> Result<&'a str, Refusal> {
        needed(member, self.object(member)?)
    }

    pub(super) fn bool(&self, member: &'static str) -> Result<Option<bool>, Refusal> {
        match self.raw(member) {
            None => Ok(None),
            Some("true") => Ok(Some(true)),
            Some("false") => Ok(Some(false)),
            Some(raw) => Err(kind(member, "bool", raw)),
        }
    }

    /// Returns a number that is not negative. Integers may be written as floats.
    pub(super) fn count(&self, member: &'static str) -> Result<Option<usize>, Refusal> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        if let Ok(count) = raw.parse() {
            return Ok(Some(count));
        }
        match raw.parse::<f64>() {
            Ok(count) if (0.0..=u32::MAX.into()).contains(&count) && count.fract() == 0.0 => {
                Ok(Some(count as usize))
            }
            _ => Err(kind(member, "number of 0 or more", raw)),
        }
    }

    pub(super) fn needed_count(&self, member: &'static str) -> Result<usize, Refusal> {
        needed(member, self.count(member)?)
    }

    pub(super) fn integer(&self, member: &'static str) -> Result<Option<i64>, Refusal> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        raw.parse().map(Some).map_err(|_| kind(member, "integer", raw))
    }

    /// Returns a time in seconds, or `None` if it is not positive.
    pub(super) fn seconds(&self, member: &'static str) -> Result<Option<Duration>, Refusal> {
        let Some(raw) = self.raw(member) else { return Ok(None) };
        let seconds: f64 = raw.parse().map_err(|_| kind(member, "number of seconds", raw))?;
        Ok((seconds > 0.0).then(|| Duration::from_secs_f64(seconds.min(SECONDS_MAX))))
    }
}

fn needed<T>(member: &'static str, value: Option<T>) -> Result<T, Refusal> {
    value.ok_or(Refusal::Missing(member))
}

fn kind(member: &'static str, expected: &'static str, found: &str) -> Refusal {
    Refusal::Kind { member, expected, found: short(found) }
}

/// Returns the text of a JSON string, which is copied only if it has escapes.
fn text_of(raw: &str) -> Option<Cow<'_, str>> {
    match serde_json::from_str::<&str>(raw) {
        Ok(text) => Some(Cow::Borrowed(text)),
        Err(_) => serde_json::from_str::<String>(raw).ok().map(Cow::Owned),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_are_read_as_what_they_are() {
        let members = Members::parse(
            r#"{"op":"x","id":"a\"b","n":3,"f":2.0,"no":null,"t":true,"o":{"a":[1]},"s":0.25,"m":-1}"#,
        )
        .unwrap();
        assert_eq!(members.op().unwrap(), "x");
        assert_eq!(members.id().unwrap(), Some(OpId::Text("a\"b".into())));
        assert_eq!((members.count("n").unwrap(), members.count("f").unwrap()), (Some(3), Some(2)));
        assert_eq!((members.text("no").unwrap(), members.bool("t").unwrap()), (None, Some(true)));
        assert_eq!(members.object("o").unwrap(), Some(r#"{"a":[1]}"#));
        assert_eq!(members.seconds("s").unwrap(), Some(Duration::from_millis(250)));
        assert_eq!((members.seconds("m").unwrap(), members.integer("m").unwrap()), (None, Some(-1)));
        let errors = [
            members.count("m").unwrap_err(),
            members.text("n").unwrap_err(),
            members.object("n").unwrap_err(),
            members.needed_name("topic").unwrap_err(),
        ];
        let told: Vec<_> = errors.iter().map(ToString::to_string).collect();
        assert_eq!(
            told,
            [
                r#""m" is no number of 0 or more: -1"#,
                r#""n" is no text: 3"#,
                r#""n" is no object: 3"#,
                r#""topic" is missing"#,
            ]
        );
    }

    #[test]
    fn echoed_text_is_short() {
        let text = format!(r#"{{"n":"{}"}}"#, "ä".repeat(10_000));
        let members = Members::parse(&text).unwrap();
        for error in [members.count("n").unwrap_err(), members.name("n").unwrap_err()] {
            assert!(error.to_string().len() < 400, "{error}");
        }
    }

    #[test]
    fn number_of_members_is_bounded() {
        let of_members = |count: usize| {
            let members: Vec<_> = (0..count).map(|n| format!("\"m{}\":0", n % 50)).collect();
            format!("{{{}}}", members.join(","))
        };
        assert!(Members::parse(&of_members(MEMBERS_MAX)).is_ok());
        assert_eq!(Members::parse(&of_members(MEMBERS_MAX + 1)).unwrap_err(), OpError::TooManyMembers);
    }
}
