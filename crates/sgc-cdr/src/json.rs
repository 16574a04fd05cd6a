//! Values as JSON.

use std::fmt::Write as _;

use serde_json::Value as Json;

use crate::value::Value;

impl Value {
    /// As JSON, in one line: members in their order, 64-bit integers as numbers, and what JSON has no number for as one
    /// of the texts `"NaN"`, `"Infinity"`, `"-Infinity"`.
    pub fn to_json(&self) -> String {
        let mut out = String::new();
        self.write(&mut out);
        out
    }

    /// Depth is bounded: layouts are.
    fn write(&self, out: &mut String) {
        let _ = match self {
            Self::Bool(value) => write!(out, "{value}"),
            Self::Int(value) => write!(out, "{value}"),
            Self::Uint(value) => write!(out, "{value}"),
            // The shortest number that is this one as `float32`.
            Self::Float32(value) if value.is_finite() => write!(out, "{value:?}"),
            Self::Float64(value) if value.is_finite() => write!(out, "{value:?}"),
            Self::Float32(value) => write!(out, "\"{}\"", no_number(f64::from(*value))),
            Self::Float64(value) => write!(out, "\"{}\"", no_number(*value)),
            Self::Text(text) => write!(out, "{}", Json::from(text.as_str())),
            Self::Octets(octets) => {
                out.push('[');
                for (index, octet) in octets.iter().enumerate() {
                    let _ = write!(out, "{}{octet}", comma(index));
                }
                write!(out, "]")
            }
            Self::List(all) => {
                out.push('[');
                for (index, value) in all.iter().enumerate() {
                    out.push_str(comma(index));
                    value.write(out);
                }
                write!(out, "]")
            }
            Self::Record(members) => {
                out.push('{');
                for (index, (name, value)) in members.iter().enumerate() {
                    let _ = write!(out, "{}\"{name}\":", comma(index));
                    value.write(out);
                }
                write!(out, "}}")
            }
        };
    }
}

fn comma(index: usize) -> &'static str {
    if index == 0 { "" } else { "," }
}

fn no_number(value: f64) -> &'static str {
    match value {
        _ if value.is_nan() => "NaN",
        _ if value > 0.0 => "Infinity",
        _ => "-Infinity",
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bytes::Bytes;

    use super::*;

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
        let members = vec![
            (Arc::from("z"), Value::Text("\"\n".into())),
            (Arc::from("a"), Value::Octets(Bytes::from_static(&[1, 2]))),
            (Arc::from("m"), Value::List(vec![Value::Bool(true), Value::Record(Vec::new())])),
        ];
        assert_eq!(Value::Record(members).to_json(), r#"{"z":"\"\n","a":[1,2],"m":[true,{}]}"#);
    }
}
