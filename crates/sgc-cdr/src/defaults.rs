//! Values of missing members: the default that the definition names, or zero, empty, nothing.

use std::sync::Arc;

use bytes::Bytes;

use crate::definition::{Base, FieldType, Primitive, Shape};
use crate::fault::{Budget, ValueError, ValueProblem, fits, fits_bound};
use crate::layout::{Element, Layout, Member, MemberDefault};
use crate::number::{Number, little};
use crate::value::{PackedArray, Value, scalar};

impl MemberDefault {
    pub(crate) fn new(field_type: &FieldType, text: String) -> Self {
        let value = literal(field_type, &text);
        Self { text, value }
    }
}

impl Layout {
    /// Returns the value of a missing member.
    pub(crate) fn default_of(&self, member: &Member, budget: &mut Budget) -> Result<Value, ValueError> {
        match &member.default {
            Some(MemberDefault { value: Some(value), .. }) => {
                budget.value()?;
                budget.bytes(content_bytes(value))?;
                Ok(value.clone())
            }
            Some(MemberDefault { value: None, .. }) => Err(ValueProblem::Default.into()),
            None => self.zero(member, budget),
        }
    }

    /// Returns a message with nothing in it but defaults.
    pub(crate) fn default_record(&self, place: usize, budget: &mut Budget) -> Result<Value, ValueError> {
        left_out(budget)?;
        let members = self.structs.get(place).map_or(&[][..], |this| &this.members);
        let default = |member: &Member| {
            let value = self.default_of(member, budget).map_err(|error| error.under(&member.name))?;
            Ok((member.name.clone(), value))
        };
        members.iter().map(default).collect::<Result<Vec<(Arc<str>, Value)>, _>>().map(Value::Record)
    }

    fn zero(&self, member: &Member, budget: &mut Budget) -> Result<Value, ValueError> {
        let count = match member.shape {
            Shape::One => return self.zero_element(member, budget),
            Shape::Array(count) => count as usize,
            Shape::Sequence { .. } => 0,
        };
        budget.value()?;
        if let Element::Primitive(primitive) = member.element {
            let bytes = count.checked_mul(primitive.bytes()).ok_or(ValueProblem::TooLarge)?;
            budget.bytes(bytes)?;
            let octets = Bytes::from(vec![0; bytes]);
            return Ok(
                PackedArray::new(primitive, octets.clone()).map_or(Value::Octets(octets), Value::PackedArray)
            );
        }
        (0..count).map(|_| self.zero_element(member, budget)).collect::<Result<_, _>>().map(Value::List)
    }

    fn zero_element(&self, member: &Member, budget: &mut Budget) -> Result<Value, ValueError> {
        match member.element {
            Element::Struct(place) => self.default_record(place, budget),
            Element::Primitive(primitive) => {
                left_out(budget)?;
                Ok(scalar(primitive, &[]))
            }
            Element::String { .. } | Element::WString { .. } => {
                left_out(budget)?;
                Ok(Value::Text(String::new()))
            }
        }
    }
}

/// Charges a missing member, which has no bytes that bound it, but takes memory.
fn left_out(budget: &mut Budget) -> Result<(), ValueProblem> {
    budget.value()?;
    budget.bytes(size_of::<Value>())
}

fn content_bytes(value: &Value) -> usize {
    match value {
        Value::Text(text) => text.len(),
        Value::Octets(octets) => octets.len(),
        Value::PackedArray(packed) => packed.octets().len(),
        Value::List(all) => all.iter().map(|value| size_of::<Value>() + content_bytes(value)).sum(),
        _ => 0,
    }
}

/// Parses the text of a default (`rosidl_adapter`, `parse_value_string`); `None` if it is no value of the type.
fn literal(field_type: &FieldType, text: &str) -> Option<Value> {
    let text = text.trim();
    if field_type.shape == Shape::One {
        return one(&field_type.base, text);
    }
    let inner = text.strip_prefix('[').and_then(|text| text.strip_suffix(']'));
    // In IDL.
    let inner = inner.or_else(|| text.strip_prefix('(').and_then(|text| text.strip_suffix(')')))?;
    let all: Vec<Value> =
        parts(inner)?.into_iter().map(|part| one(&field_type.base, part)).collect::<Option<_>>()?;
    fits(field_type.shape, all.len()).ok()?;
    let Base::Primitive(primitive) = field_type.base else { return Some(Value::List(all)) };
    let octets: Bytes =
        all.iter().flat_map(|value| little(value).into_iter().take(primitive.bytes())).collect();
    Some(PackedArray::new(primitive, octets.clone()).map_or(Value::Octets(octets), Value::PackedArray))
}

/// Splits a text at commas outside of quotes.
fn parts(text: &str) -> Option<Vec<&str>> {
    let mut all = Vec::new();
    let mut rest = text.trim();
    while !rest.is_empty() {
        let end = match rest.chars().next() {
            Some(quote @ ('"' | '\'')) => quoted_end(rest, quote)?,
            _ => rest.find(',').unwrap_or(rest.len()),
        };
        let (part, after) = rest.split_at_checked(end)?;
        all.push(part.trim());
        let after = after.trim_start();
        rest = match after.strip_prefix(',') {
            Some(more) => more.trim_start(),
            None if after.is_empty() => after,
            None => return None,
        };
    }
    Some(all)
}

/// Returns the end of a text in quotes: behind them.
fn quoted_end(text: &str, quote: char) -> Option<usize> {
    let mut escaped = false;
    let end = text.char_indices().skip(1).find(|(_, c)| {
        let ends = *c == quote && !escaped;
        escaped = *c == '\\' && !escaped;
        ends
    });
    end.map(|(at, _)| at + quote.len_utf8())
}

fn one(base: &Base, text: &str) -> Option<Value> {
    match base {
        Base::Message(_) => None,
        Base::String { bound } => {
            let text = unquoted(text);
            fits_bound(*bound, text.len()).ok()?;
            Some(Value::Text(text))
        }
        Base::WString { bound } => {
            let text = unquoted(text);
            fits_bound(*bound, text.encode_utf16().count()).ok()?;
            Some(Value::Text(text))
        }
        Base::Primitive(Primitive::Bool) => match text {
            "1" => Some(Value::Bool(true)),
            "0" => Some(Value::Bool(false)),
            _ if text.eq_ignore_ascii_case("true") => Some(Value::Bool(true)),
            _ if text.eq_ignore_ascii_case("false") => Some(Value::Bool(false)),
            _ => None,
        },
        Base::Primitive(Primitive::Float32) => text.parse().ok().map(Value::Float32),
        Base::Primitive(Primitive::Float64) => text.parse().ok().map(Value::Float64),
        Base::Primitive(primitive) => Number::Integer(integer(text)?).fit(*primitive).ok(),
    }
}

fn integer(text: &str) -> Option<i128> {
    let (sign, digits) = match text.strip_prefix('-') {
        Some(digits) => (-1, digits),
        None => (1, text.strip_prefix('+').unwrap_or(text)),
    };
    let lower = digits.to_ascii_lowercase();
    let (digits, radix) = [("0x", 16), ("0o", 8), ("0b", 2)]
        .into_iter()
        .find_map(|(prefix, radix)| Some((lower.strip_prefix(prefix)?, radix)))
        .unwrap_or((&lower, 10));
    // A sign was removed before.
    let plain = digits.bytes().all(|byte| byte.is_ascii_alphanumeric());
    i128::from_str_radix(digits, radix).ok().filter(|_| plain).map(|value| sign * value)
}

fn unquoted(text: &str) -> String {
    for quote in ['"', '\''] {
        let inner = text.strip_prefix(quote).and_then(|text| text.strip_suffix(quote));
        if let Some(inner) = inner {
            return inner.replace(&format!("\\{quote}"), &quote.to_string());
        }
    }
    text.to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::Library;

    fn defaults(text: &str) -> Result<String, ValueError> {
        let mut texts = |file: &crate::TypeName| match file.name() {
            "M" => Some(text.to_owned()),
            "Two" => Some("uint8 a 7\nuint16[2] b".to_owned()),
            "Deep" => Some("Deeper[1000] d".to_owned()),
            "Deeper" => Some("string[10000] s".to_owned()),
            "Large" => Some("float64[100000000] x".to_owned()),
            _ => None,
        };
        let layout = Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut texts).unwrap();
        let place = layout.structs.len() - 1;
        layout.default_record(place, &mut Budget::default()).map(|value| value.to_json())
    }

    #[test]
    fn defaults_mean_what_the_definition_says() {
        for (text, json) in [
            ("int32 a -3 # why", r#"{"a":-3}"#),
            ("uint8 a 0xff", r#"{"a":255}"#),
            ("bool a True", r#"{"a":true}"#),
            ("float32 a 0.1", r#"{"a":0.1}"#),
            ("float64 a", r#"{"a":0.0}"#),
            (r#"string a "it is \"so\"" "#, r#"{"a":"it is \"so\""}"#),
            ("string a plain", r#"{"a":"plain"}"#),
            ("int16[] a [1, -2]", r#"{"a":[1,-2]}"#),
            ("bool[2] a [true, 0]", r#"{"a":[true,false]}"#),
            ("int16[2] a", r#"{"a":[0,0]}"#),
            ("string[2] a ['x, y', z]", r#"{"a":["x, y","z"]}"#),
            ("string[2] a", r#"{"a":["",""]}"#),
            ("Two[1] a\nTwo b", r#"{"a":[{"a":7,"b":[0,0]}],"b":{"a":7,"b":[0,0]}}"#),
        ] {
            assert_eq!(defaults(text).unwrap(), json, "{text}");
        }
    }

    #[test]
    fn defaults_that_mean_nothing_are_said_when_they_are_needed() {
        for text in [
            "int8 a 300",
            "int8 a x",
            "int8[2] a [1]",
            "bool a 2",
            "string<=1 a xy",
            "int8[] a 1",
            "int8 a --1",
        ] {
            let error = defaults(text).unwrap_err();
            assert_eq!(error, ValueError { path: "a".into(), problem: ValueProblem::Default }, "{text}");
        }
    }

    #[test]
    fn defaults_are_bounded() {
        assert_eq!(defaults("Large a").unwrap_err().problem, ValueProblem::TooLarge);
        assert_eq!(defaults("Deep a").unwrap_err().problem, ValueProblem::TooLarge);
    }
}
