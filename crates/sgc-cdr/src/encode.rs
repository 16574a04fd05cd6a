//! Values to CDR (DDS-XTypes 1.3, 7.4; RTPS 2.5, 10.2).

use std::sync::Arc;

use crate::definition::{Primitive, Shape};
use crate::encoding::{ENCAPSULATION_BYTES, Encoding, Padding};
use crate::fault::{Budget, ValueError, ValueProblem, fits, fits_bound};
use crate::layout::{Element, Layout, Member};
use crate::number::{fit, little};
use crate::value::{PackedArray, Value};

impl Layout {
    /// Serialises a message as ROS 2 does today: CDR of version 1, little endian, with its encapsulation header.
    ///
    /// Members may come in any order, and missing ones take their default. Integers may be of either kind, and
    /// sequences of primitives lists, as long as each number fits its member.
    pub fn encode(&self, value: &Value) -> Result<Vec<u8>, ValueError> {
        self.encode_as(value, Encoding::default())
    }

    /// Serialises a message in a given encoding, such as that of another payload from [`Layout::decode_as`].
    pub fn encode_as(&self, value: &Value, encoding: Encoding) -> Result<Vec<u8>, ValueError> {
        let mut out = Vec::with_capacity(ENCAPSULATION_BYTES);
        out.extend(encoding.id().to_be_bytes());
        out.extend([0, 0]);
        let mut encoder = Encoder { layout: self, encoding, out, budget: Budget::default() };
        if let Some(root) = self.structs.len().checked_sub(1) {
            encoder.record(root, value)?;
        }
        let mut out = encoder.out;
        if encoding.padding != Padding::None {
            let body = out.len();
            out.resize(body.next_multiple_of(4), 0);
            if let (Padding::Said, Some(options)) = (encoding.padding, out.get_mut(3)) {
                *options = (body.next_multiple_of(4) - body) as u8;
            }
        }
        Ok(out)
    }
}

struct Encoder<'a> {
    layout: &'a Layout,
    encoding: Encoding,
    /// The output, with the encapsulation header, which alignment does not count.
    out: Vec<u8>,
    /// Bound on missing members.
    budget: Budget,
}

impl Encoder<'_> {
    /// Writes a message. Layouts have no circles and a bounded depth, so the recursion is bounded.
    fn record(&mut self, place: usize, value: &Value) -> Result<(), ValueError> {
        let Value::Record(given) = value else { return Err(is_no(value, "a message").into()) };
        let layout = self.layout;
        let Some(this) = layout.structs.get(place) else { return Ok(()) };
        let size = self.encoding.is_delimited().then(|| self.begin_sized());
        // Members usually come in order.
        let mut next = 0;
        let mut taken = 0;
        for member in &this.members {
            let here = given.get(next).filter(|(name, _)| *name == member.name);
            let found = match here {
                Some(found) => {
                    next += 1;
                    Some(found)
                }
                None => given.iter().find(|(name, _)| *name == member.name),
            };
            let written = match found {
                Some((_, value)) => {
                    taken += 1;
                    self.member(member, value)
                }
                None => {
                    layout.default_of(member, &mut self.budget).and_then(|value| self.member(member, &value))
                }
            };
            written.map_err(|error| error.under(&member.name))?;
        }
        if taken < given.len() {
            return Err(left_over(&this.members, given).into());
        }
        self.end_sized(size)
    }

    fn member(&mut self, member: &Member, value: &Value) -> Result<(), ValueError> {
        if member.shape == Shape::One {
            return self.element(member, value);
        }
        let count = match value {
            Value::List(all) => all.len(),
            Value::Octets(octets) => octets.len(),
            Value::PackedArray(packed) => packed.len(),
            _ => return Err(is_no(value, "a sequence").into()),
        };
        fits(member.shape, count)?;
        let sized = self.encoding.is_second() && !matches!(member.element, Element::Primitive(_));
        let size = sized.then(|| self.begin_sized());
        if matches!(member.shape, Shape::Sequence { .. }) {
            self.length(count)?;
        }
        match (member.element, value) {
            (Element::Primitive(Primitive::Byte | Primitive::Uint8), Value::Octets(octets)) => {
                self.out.extend_from_slice(octets);
            }
            (Element::Primitive(primitive), Value::PackedArray(packed))
                if packed.primitive() == primitive =>
            {
                self.packed(packed);
            }
            (_, Value::List(all)) => {
                for (index, value) in all.iter().enumerate() {
                    self.element(member, value).map_err(|error| error.at(index))?;
                }
            }
            (_, Value::PackedArray(packed)) => {
                for (index, value) in packed.iter().enumerate() {
                    self.element(member, &value).map_err(|error| error.at(index))?;
                }
            }
            (_, Value::Octets(octets)) => {
                for (index, octet) in octets.iter().enumerate() {
                    let value = Value::Uint(u64::from(*octet));
                    self.element(member, &value).map_err(|error| error.at(index))?;
                }
            }
            // Only sequences are left, as their count shows.
            _ => {}
        }
        self.end_sized(size)
    }

    fn packed(&mut self, packed: &PackedArray) {
        if packed.is_empty() {
            return;
        }
        let size = packed.primitive().bytes();
        self.align(size);
        let begin = self.out.len();
        self.out.extend_from_slice(packed.octets());
        if size > 1 && !self.encoding.is_little() {
            self.out[begin..].chunks_exact_mut(size).for_each(<[u8]>::reverse);
        }
    }

    fn element(&mut self, member: &Member, value: &Value) -> Result<(), ValueError> {
        match member.element {
            Element::Struct(place) => return self.record(place, value),
            Element::Primitive(primitive) => {
                let bytes = little(&fit(value, primitive)?);
                self.number(&bytes[..primitive.bytes()]);
            }
            Element::String { bound } => {
                let text = match value {
                    Value::Text(text) => text.as_bytes(),
                    Value::Raw(bytes) => bytes,
                    _ => return Err(is_no(value, "string").into()),
                };
                fits_bound(bound, text.len())?;
                self.length(text.len().saturating_add(1))?;
                self.out.extend_from_slice(text);
                self.out.push(0);
            }
            Element::WString { bound } => match value {
                Value::Text(text) => self.wide_string(bound, text.encode_utf16())?,
                Value::Wide(units) => self.wide_string(bound, units.iter().copied())?,
                _ => return Err(is_no(value, "wstring").into()),
            },
        }
        Ok(())
    }

    /// Writes a `wstring` without a NUL at the end: no vendor writes one.
    fn wide_string(
        &mut self,
        bound: Option<u32>,
        units: impl Iterator<Item = u16> + Clone,
    ) -> Result<(), ValueError> {
        let count = units.clone().count();
        fits_bound(bound, count)?;
        // Version 2 counts bytes, version 1 units.
        self.length(if self.encoding.is_second() { count.saturating_mul(2) } else { count })?;
        for unit in units {
            // Units that follow a length are aligned already.
            match (self.encoding.wide_bytes(), self.encoding.is_little()) {
                (4, true) => self.out.extend(u32::from(unit).to_le_bytes()),
                (4, false) => self.out.extend(u32::from(unit).to_be_bytes()),
                (_, true) => self.out.extend(unit.to_le_bytes()),
                (_, false) => self.out.extend(unit.to_be_bytes()),
            }
        }
        Ok(())
    }

    fn length(&mut self, length: usize) -> Result<(), ValueError> {
        let length = u32::try_from(length).map_err(|_| ValueProblem::TooLarge)?;
        self.number(&length.to_le_bytes());
        Ok(())
    }

    /// Writes a number of these bytes, little endian, aligned to its size.
    fn number(&mut self, little: &[u8]) {
        self.align(little.len());
        if self.encoding.is_little() {
            self.out.extend_from_slice(little);
        } else {
            self.out.extend(little.iter().rev());
        }
    }

    fn align(&mut self, bytes: usize) {
        let body = self.out.len() - ENCAPSULATION_BYTES;
        let aligned = body.next_multiple_of(self.encoding.alignment(bytes));
        self.out.resize(ENCAPSULATION_BYTES + aligned, 0);
    }

    /// Leaves room for the size of the following data, and returns the offset of its end.
    fn begin_sized(&mut self) -> usize {
        self.number(&[0; 4]);
        self.out.len()
    }

    fn end_sized(&mut self, begin: Option<usize>) -> Result<(), ValueError> {
        let Some(begin) = begin else { return Ok(()) };
        let size = u32::try_from(self.out.len() - begin).map_err(|_| ValueProblem::TooLarge)?;
        let size = if self.encoding.is_little() { size.to_le_bytes() } else { size.to_be_bytes() };
        self.out[begin - 4..begin].copy_from_slice(&size);
        Ok(())
    }
}

fn is_no(value: &Value, expected: &'static str) -> ValueProblem {
    ValueProblem::Kind { found: value.kind().to_owned(), expected }
}

fn left_over(members: &[Member], given: &[(Arc<str>, Value)]) -> ValueProblem {
    let unknown = given.iter().find(|(name, _)| members.iter().all(|member| member.name != *name));
    match unknown {
        Some((name, _)) => ValueProblem::Unknown(name.to_string()),
        None => {
            let twice = given
                .iter()
                .enumerate()
                .find(|(index, (name, _))| given.iter().take(*index).any(|(before, _)| before == name));
            ValueProblem::Twice(twice.map(|(_, (name, _))| name.to_string()).unwrap_or_default())
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::encoding::{ByteOrder, CdrVersion, WideUnit};
    use crate::testing::layout;

    fn record(members: Vec<(&str, Value)>) -> Value {
        Value::Record(members.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
    }

    #[test]
    fn decoded_messages_encode_to_the_same_bytes() {
        let text = "uint8 a\nuint64 b\nstring c\nuint16[] d";
        let nested = "Two[] x\nstring[] y\nwstring z";
        for (text, payload) in [
            (text, &b"\0\x01\0\0\x01\0\0\0\0\0\0\0\x02\0\0\0\0\0\0\0\x03\0\0\0hi\0\0\x01\0\0\0\x05\0"[..]),
            (text, b"\0\0\0\0\x01\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x02\0\0\0\x03hi\0\0\0\0\0\x01\0\x05"),
            (text, b"\0\x07\0\0\x01\0\0\0\x02\0\0\0\0\0\0\0\x03\0\0\0hi\0\0\x01\0\0\0\x05\0\0\0"),
            // Padded, and marked so.
            (text, b"\0\x01\0\x02\x01\0\0\0\0\0\0\0\x02\0\0\0\0\0\0\0\x03\0\0\0hi\0\0\x01\0\0\0\x05\0\0\0"),
            (
                nested,
                b"\0\x09\0\0\x26\0\0\0\x0c\0\0\0\x01\0\0\0\x04\0\0\0\x01\0\x02\0\x0a\0\0\0\x01\0\0\0\x02\0\0\0h\0\0\0\x02\0\0\0h\0",
            ),
            ("wstring a", b"\0\x01\0\0\x02\0\0\0h\0\0\0i\0\0\0"),
            ("wstring a", b"\0\0\0\0\0\0\0\x02\0\0\0h\0\0\0i"),
            ("wstring a", b"\0\x01\0\0\x01\0\0\0\0\xd8"),
            ("string a", b"\0\x01\0\0\x03\0\0\0\xff\xc3\0"),
            ("float64[] a\nint8 b", b"\0\x01\0\0\0\0\0\0\x01"),
        ] {
            let layout = layout(text);
            let (value, encoding) = layout.decode_as(&Bytes::from_static(payload)).unwrap();
            assert_eq!(layout.encode_as(&value, encoding).unwrap(), payload, "{text} {encoding:?} {value:?}");
            // JSON keeps all of it.
            assert_eq!(layout.from_json(value.to_json().as_bytes()).unwrap(), value);
        }
    }

    #[test]
    fn the_default_is_what_ros_writes() {
        assert_eq!(Encoding::default().id(), 1);
        let big =
            Encoding { order: ByteOrder::Big, version: CdrVersion::TwoDelimited, ..Encoding::default() };
        assert_eq!(big.id(), 8);
        let wide = Encoding { wide: WideUnit::Four, ..Encoding::default() };
        assert_eq!((wide.wide_bytes(), Encoding { version: CdrVersion::Two, ..wide }.wide_bytes()), (4, 2));
    }

    #[test]
    fn members_come_in_any_order_or_not_at_all() {
        let layout = layout("Two t\nint16[] s\nuint8[] o");
        let list = |all: &[i64]| Value::List(all.iter().map(|n| Value::Int(*n)).collect());
        let value = record(vec![
            ("o", list(&[1, 255])),
            ("t", record(vec![("a", Value::Int(3))])),
            ("s", list(&[-1])),
        ]);
        let payload = layout.encode(&value).unwrap();
        let read = layout.decode(&payload.into()).unwrap();
        assert_eq!(read.to_json(), r#"{"t":{"a":3,"b":7},"s":[-1],"o":"Af8="}"#);
    }

    #[test]
    fn mistakes_have_their_path() {
        let list = |all: Vec<Value>| Value::List(all);
        let float = Value::Float64(1.5);
        for (text, members, error) in [
            ("int8 a", vec![("a", Value::Int(128))], "a: 128 is not within the range of int8"),
            ("int8 a", vec![("a", Value::Text("1".into()))], "a: a text, not int8"),
            ("int8 a", vec![("b", Value::Int(1))], "there is no member \"b\""),
            ("int8 a", vec![("a", Value::Int(1)), ("a", Value::Int(1))], "\"a\" is there twice"),
            ("int8 a", vec![("a", list(vec![]))], "a: a sequence, not int8"),
            ("int8[] a", vec![("a", Value::Int(1))], "a: an integer, not a sequence"),
            ("int8[] a", vec![("a", list(vec![Value::Int(1), float.clone()]))], "a[1]: 1.5, not int8"),
            ("int8[2] a", vec![("a", list(vec![]))], "a: 0 elements, not 2"),
            (
                "int8[<=1] a",
                vec![("a", Value::Octets(Bytes::from_static(b"xy")))],
                "a: 2 elements, and at most 1 are allowed",
            ),
            (
                "string<=1 a",
                vec![("a", Value::Text("xy".into()))],
                "a: 2 elements, and at most 1 are allowed",
            ),
            (
                "wstring<=1 a",
                vec![("a", Value::Text("\u{1f600}".into()))],
                "a: 2 elements, and at most 1 are allowed",
            ),
            ("string a", vec![("a", Value::Wide(vec![0xd800]))], "a: a text that is not UTF-16, not string"),
            ("Two[] a", vec![("a", list(vec![record(vec![("b", float)])]))], "a[0].b: 1.5, not uint16"),
            ("Two a", vec![("a", Value::Bool(true))], "a: a bool, not a message"),
        ] {
            let found = layout(text).encode(&record(members)).unwrap_err();
            assert_eq!(found.to_string(), error, "{text}");
        }
    }
}
