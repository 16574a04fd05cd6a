//! What a message says.

use std::sync::Arc;

use bytes::Bytes;

/// A value of a message. What it was declared as is in its definition.
#[derive(Clone, Debug, PartialEq)]
pub enum Value {
    /// `bool`.
    Bool(bool),
    /// Signed integers.
    Int(i64),
    /// Unsigned integers, `byte` and `char`.
    Uint(u64),
    /// `float32`.
    Float32(f32),
    /// `float64`.
    Float64(f64),
    /// `string` and `wstring`; what is no Unicode in it is replaced by U+FFFD.
    Text(String),
    /// Arrays and sequences of `byte`, `char` and `uint8`.
    Octets(Bytes),
    /// Other arrays and sequences.
    List(Vec<Value>),
    /// A message: its members in order.
    Record(Vec<(Arc<str>, Value)>),
}

impl Value {
    /// A member by its path: `pose.position.x`, with `[2]` for an element of a sequence: `transforms[0].header`.
    pub fn at(&self, path: &str) -> Option<Value> {
        let mut here = self.clone();
        for part in path.split('.') {
            let (name, mut rest) = match part.find('[') {
                Some(bracket) => part.split_at(bracket),
                None => (part, ""),
            };
            let Self::Record(members) = here else { return None };
            here = members.into_iter().find(|(n, _)| &**n == name)?.1;
            while let Some(inner) = rest.strip_prefix('[') {
                let (index, after) = inner.split_once(']')?;
                let index: usize = index.parse().ok()?;
                here = match here {
                    Self::List(mut all) if index < all.len() => all.swap_remove(index),
                    Self::Octets(all) => Self::Uint(u64::from(*all.get(index)?)),
                    _ => return None,
                };
                rest = after;
            }
            if !rest.is_empty() {
                return None;
            }
        }
        Some(here)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn members_are_found_by_their_path() {
        let record = |members: Vec<(&str, Value)>| {
            Value::Record(members.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
        };
        let stamp = record(vec![("sec", Value::Int(2)), ("nanosec", Value::Uint(5))]);
        let message = record(vec![
            ("header", record(vec![("stamp", stamp)])),
            ("list", Value::List(vec![record(vec![("x", Value::Bool(true))])])),
            ("data", Value::Octets(Bytes::from_static(&[7, 8]))),
        ]);
        assert_eq!(message.at("list[0].x"), Some(Value::Bool(true)));
        assert_eq!(message.at("data[1]"), Some(Value::Uint(8)));
        for none in ["", "x", "list.x", "list[1]", "list[0", "data[1]x", "data[-1]", "header.stamp.sec.x"] {
            assert_eq!(message.at(none), None, "{none}");
        }
    }
}
