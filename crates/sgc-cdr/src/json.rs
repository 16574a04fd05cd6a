//! Values as JSON (RFC 8259), in the form of docs/spec/json.md. Reading it is in `from_json`.

use std::fmt::Write as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::definition::DUMMY_MEMBER;
use crate::value::Value;

/// Base of the code that stands for a byte of a `string` that is no UTF-8 (Python's `surrogateescape`, PEP 383).
pub(crate) const ESCAPED_BYTE: u16 = 0xdc00;

impl Value {
    /// Returns JSON in one line: members in their order, 64-bit integers as numbers, octets in base64, and numbers that
    /// JSON lacks as one of the texts `"NaN"`, `"Infinity"`, `"-Infinity"`.
    /// [`Layout::from_json`](crate::Layout::from_json) reads it.
    pub fn to_json(&self) -> String {
        let mut out = String::new();
        self.write_json(&mut out);
        out
    }

    /// Appends the value as JSON. The depth is bounded as that of layouts.
    pub fn write_json(&self, out: &mut String) {
        match self {
            Self::Bool(value) => write(out, value),
            Self::Int(value) => write(out, value),
            Self::Uint(value) => write(out, value),
            Self::Float32(value) => float(out, value, f64::from(*value)),
            Self::Float64(value) => float(out, value, *value),
            Self::Text(text) => quoted(out, |out| escaped(out, text)),
            Self::Raw(bytes) => quoted(out, |out| {
                for chunk in bytes.utf8_chunks() {
                    escaped(out, chunk.valid());
                    chunk.invalid().iter().for_each(|byte| unit(out, ESCAPED_BYTE + u16::from(*byte)));
                }
            }),
            Self::Wide(units) => quoted(out, |out| {
                for c in char::decode_utf16(units.iter().copied()) {
                    match c {
                        Ok(c) => escaped(out, c.encode_utf8(&mut [0; 4])),
                        Err(half) => unit(out, half.unpaired_surrogate()),
                    }
                }
            }),
            Self::Octets(octets) => quoted(out, |out| STANDARD.encode_string(octets, out)),
            Self::PackedArray(packed) => list(out, packed.iter(), |out, value| value.write_json(out)),
            Self::List(all) => list(out, all, |out, value| value.write_json(out)),
            Self::Record(members) => {
                out.push('{');
                let shown = members.iter().filter(|(name, _)| &**name != DUMMY_MEMBER);
                for (index, (name, value)) in shown.enumerate() {
                    out.push_str(if index == 0 { "\"" } else { ",\"" });
                    out.push_str(name);
                    out.push_str("\":");
                    value.write_json(out);
                }
                out.push('}');
            }
        }
    }
}

fn write(out: &mut String, value: &impl std::fmt::Display) {
    let _ = write!(out, "{value}");
}

/// Writes the shortest number that is this one in its own type.
fn float(out: &mut String, value: &impl std::fmt::Debug, wide: f64) {
    let _ = match wide {
        _ if wide.is_finite() => write!(out, "{value:?}"),
        _ if wide.is_nan() => write!(out, "\"NaN\""),
        _ if wide > 0.0 => write!(out, "\"Infinity\""),
        _ => write!(out, "\"-Infinity\""),
    };
}

fn list<T>(out: &mut String, all: impl IntoIterator<Item = T>, write: impl Fn(&mut String, T)) {
    out.push('[');
    for (index, value) in all.into_iter().enumerate() {
        if index > 0 {
            out.push(',');
        }
        write(out, value);
    }
    out.push(']');
}

fn quoted(out: &mut String, write: impl FnOnce(&mut String)) {
    out.push('"');
    write(out);
    out.push('"');
}

fn escaped(out: &mut String, text: &str) {
    let mut rest = text;
    while let Some(at) = rest.find(|c| c < ' ' || c == '"' || c == '\\') {
        let (plain, after) = rest.split_at(at);
        out.push_str(plain);
        let mut after = after.chars();
        match after.next() {
            Some('"') => out.push_str("\\\""),
            Some('\\') => out.push_str("\\\\"),
            Some('\n') => out.push_str("\\n"),
            Some('\r') => out.push_str("\\r"),
            Some('\t') => out.push_str("\\t"),
            Some(control) => {
                let _ = write!(out, "\\u{:04x}", u32::from(control));
            }
            None => {}
        }
        rest = after.as_str();
    }
    out.push_str(rest);
}

/// Writes a unit of UTF-16 by its number.
fn unit(out: &mut String, unit: u16) {
    let _ = write!(out, "\\u{unit:04x}");
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bytes::Bytes;

    use super::*;
    use crate::definition::Primitive;
    use crate::value::PackedArray;

    #[test]
    fn numbers_are_exact_and_short() {
        let cases = [
            (Value::Uint(u64::MAX), "18446744073709551615"),
            (Value::Int(i64::MIN), "-9223372036854775808"),
            (Value::Float32(0.1), "0.1"),
            (Value::Float32(f32::MAX), "3.4028235e38"),
            (Value::Float64(-0.0), "-0.0"),
            (Value::Float64(f64::NAN), "\"NaN\""),
            (Value::Float32(f32::NEG_INFINITY), "\"-Infinity\""),
        ];
        for (value, text) in cases {
            assert_eq!(value.to_json(), text);
        }
    }

    #[test]
    fn members_keep_their_order() {
        let packed = PackedArray::new(Primitive::Int16, Bytes::from_static(&[1, 0, 2, 0])).unwrap();
        let members = vec![
            (Arc::from("z"), Value::Text("\"\n".into())),
            (Arc::from("a"), Value::Octets(Bytes::from_static(&[1, 2]))),
            (Arc::from("m"), Value::List(vec![Value::Bool(true), Value::Record(Vec::new())])),
            (Arc::from("p"), Value::PackedArray(packed)),
            (Arc::from(DUMMY_MEMBER), Value::Uint(0)),
        ];
        assert_eq!(Value::Record(members).to_json(), r#"{"z":"\"\n","a":"AQI=","m":[true,{}],"p":[1,2]}"#);
    }

    #[test]
    fn text_that_is_no_unicode_is_kept() {
        let raw = Value::Raw(Bytes::from_static(b"a\xff\x01\xc3\xbc\xc3"));
        assert_eq!(raw.to_json(), "\"a\\udcff\\u0001\u{fc}\\udcc3\"");
        let wide = Value::Wide(vec![0x61, 0xd83d, 0xde00, 0xd800, 0xdc]);
        assert_eq!(wide.to_json(), "\"a\u{1f600}\\ud800\u{dc}\"");
    }
}
