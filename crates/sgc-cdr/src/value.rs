//! Values of messages.

use std::sync::Arc;

use bytes::Bytes;

use crate::definition::Primitive;

/// A value of a message. Its definition has its declared type.
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
    /// `string` and `wstring`.
    Text(String),
    /// A `string` that is not UTF-8: its bytes.
    Raw(Bytes),
    /// A `wstring` that is not UTF-16, because half of a surrogate pair is missing: its units.
    Wide(Vec<u16>),
    /// Arrays and sequences of `byte`, `char` and `uint8`.
    Octets(Bytes),
    /// Arrays and sequences of other primitives.
    PackedArray(PackedArray),
    /// Other arrays and sequences.
    List(Vec<Value>),
    /// A message: its members in order.
    Record(Vec<(Arc<str>, Value)>),
}

impl Value {
    /// Returns a member by its path: `pose.position.x`, with `[2]` for an element of a sequence:
    /// `transforms[0].header`.
    pub fn at(&self, path: &str) -> Option<Value> {
        enum Cursor<'a> {
            Within(&'a Value),
            /// An element of a packed sequence, which has no values in it.
            Made(Value),
        }
        let mut here = Cursor::Within(self);
        for part in path.split('.') {
            let (name, mut rest) = match part.find('[') {
                Some(bracket) => part.split_at(bracket),
                None => (part, ""),
            };
            let Cursor::Within(Self::Record(members)) = here else { return None };
            here = Cursor::Within(&members.iter().find(|(n, _)| &**n == name)?.1);
            while let Some(inner) = rest.strip_prefix('[') {
                let (index, after) = inner.split_once(']')?;
                let index: usize = index.parse().ok()?;
                here = match here {
                    Cursor::Within(Self::List(all)) => Cursor::Within(all.get(index)?),
                    Cursor::Within(Self::Octets(all)) => {
                        Cursor::Made(Self::Uint(u64::from(*all.get(index)?)))
                    }
                    Cursor::Within(Self::PackedArray(all)) => Cursor::Made(all.at(index)?),
                    _ => return None,
                };
                rest = after;
            }
            if !rest.is_empty() {
                return None;
            }
        }
        Some(match here {
            Cursor::Within(value) => value.clone(),
            Cursor::Made(value) => value,
        })
    }

    /// Returns the kind of value, for errors.
    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::Bool(_) => "a bool",
            Self::Int(_) | Self::Uint(_) => "an integer",
            Self::Float32(_) | Self::Float64(_) => "a float",
            Self::Text(_) => "a text",
            Self::Raw(_) => "a text that is not UTF-8",
            Self::Wide(_) => "a text that is not UTF-16",
            Self::Octets(_) | Self::PackedArray(_) | Self::List(_) => "a sequence",
            Self::Record(_) => "a message",
        }
    }

    /// Returns a text of UTF-8, or the raw bytes.
    pub(crate) fn from_bytes(bytes: Bytes) -> Self {
        match std::str::from_utf8(&bytes) {
            Ok(text) => Self::Text(text.to_owned()),
            Err(_) => Self::Raw(bytes),
        }
    }

    /// Returns a text of UTF-16, or the raw units.
    pub(crate) fn from_units(units: Vec<u16>) -> Self {
        match String::from_utf16(&units) {
            Ok(text) => Self::Text(text),
            Err(_) => Self::Wide(units),
        }
    }
}

/// Elements of an array or a sequence of primitives, as in little endian CDR: an element takes no more than its bytes,
/// and those of a payload share its memory. Two are equal if all bits are: NaN is equal to itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PackedArray {
    primitive: Primitive,
    octets: Bytes,
}

impl PackedArray {
    /// Returns elements of these bytes, little endian. `None` if the last one is incomplete, if a `bool` is neither 0
    /// nor 1, and for `byte` and `uint8`, which are [`Value::Octets`].
    pub fn new(primitive: Primitive, octets: Bytes) -> Option<Self> {
        let fits = match primitive {
            Primitive::Byte | Primitive::Uint8 => false,
            Primitive::Bool => octets.iter().all(|octet| *octet <= 1),
            _ => octets.len().is_multiple_of(primitive.bytes()),
        };
        fits.then_some(Self { primitive, octets })
    }

    /// Returns the type of its elements.
    pub fn primitive(&self) -> Primitive {
        self.primitive
    }

    /// Returns the bytes of its elements, little endian.
    pub fn octets(&self) -> &Bytes {
        &self.octets
    }

    /// Returns the number of elements.
    pub fn len(&self) -> usize {
        self.octets.len() / self.primitive.bytes()
    }

    /// Returns whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.octets.is_empty()
    }

    /// Returns an element.
    pub fn at(&self, index: usize) -> Option<Value> {
        let size = self.primitive.bytes();
        let begin = index.checked_mul(size)?;
        self.octets.get(begin..begin.checked_add(size)?).map(|bytes| scalar(self.primitive, bytes))
    }

    /// Iterates over all elements.
    pub fn iter(&self) -> impl Iterator<Item = Value> {
        self.octets.chunks_exact(self.primitive.bytes()).map(|bytes| scalar(self.primitive, bytes))
    }
}

/// Returns a primitive of its bytes, little endian; missing bytes are zero.
pub(crate) fn scalar(primitive: Primitive, bytes: &[u8]) -> Value {
    let mut eight = [0; 8];
    for (to, from) in eight.iter_mut().zip(bytes) {
        *to = *from;
    }
    let [a, b, c, d, ..] = eight;
    match primitive {
        Primitive::Bool => Value::Bool(a != 0),
        Primitive::Byte | Primitive::Uint8 => Value::Uint(u64::from(a)),
        Primitive::Int8 => Value::Int(i64::from(a.cast_signed())),
        Primitive::Int16 => Value::Int(i64::from(i16::from_le_bytes([a, b]))),
        Primitive::Int32 => Value::Int(i64::from(i32::from_le_bytes([a, b, c, d]))),
        Primitive::Int64 => Value::Int(i64::from_le_bytes(eight)),
        Primitive::Uint16 => Value::Uint(u64::from(u16::from_le_bytes([a, b]))),
        Primitive::Uint32 => Value::Uint(u64::from(u32::from_le_bytes([a, b, c, d]))),
        Primitive::Uint64 => Value::Uint(u64::from_le_bytes(eight)),
        Primitive::Float32 => Value::Float32(f32::from_le_bytes([a, b, c, d])),
        Primitive::Float64 => Value::Float64(f64::from_le_bytes(eight)),
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
        let ranges = PackedArray::new(Primitive::Int16, Bytes::from_static(&[1, 0, 0xff, 0xff])).unwrap();
        let message = record(vec![
            ("header", record(vec![("stamp", stamp)])),
            ("list", Value::List(vec![record(vec![("x", Value::Bool(true))])])),
            ("data", Value::Octets(Bytes::from_static(&[7, 8]))),
            ("ranges", Value::PackedArray(ranges)),
        ]);
        assert_eq!(message.at("list[0].x"), Some(Value::Bool(true)));
        assert_eq!(message.at("data[1]"), Some(Value::Uint(8)));
        assert_eq!(message.at("ranges[1]"), Some(Value::Int(-1)));
        for none in [
            "",
            "x",
            "list.x",
            "list[1]",
            "list[0",
            "data[1]x",
            "data[-1]",
            "ranges[2]",
            "header.stamp.sec.x",
        ] {
            assert_eq!(message.at(none), None, "{none}");
        }
    }

    #[test]
    fn packed_elements_are_whole() {
        let packed =
            |primitive, octets: &'static [u8]| PackedArray::new(primitive, Bytes::from_static(octets));
        assert_eq!(packed(Primitive::Int16, &[1]), None);
        assert_eq!(packed(Primitive::Bool, &[2]), None);
        assert_eq!(packed(Primitive::Uint8, &[2]), None);
        let two = packed(Primitive::Float32, &[0, 0, 0x80, 0x3f, 0, 0, 0, 0]).unwrap();
        assert_eq!((two.len(), two.is_empty()), (2, false));
        assert_eq!(two.iter().collect::<Vec<_>>(), [Value::Float32(1.0), Value::Float32(0.0)]);
    }
}
