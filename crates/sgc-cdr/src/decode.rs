//! CDR to values (DDS-XTypes 1.3, 7.4; RTPS 2.5, 10.2).

use bytes::Bytes;

use crate::definition::{Primitive, Shape};
use crate::encoding::{ENCAPSULATION_BYTES, Encoding, PADDING_BYTES_MAX, Padding, WideUnit};
use crate::fault::VALUES_MAX;
use crate::layout::{Element, Layout, Member};
use crate::path;
use crate::value::{PackedArray, Value, scalar};

/// Most elements for which memory is reserved before they are read.
const RESERVE_MAX: usize = 1024;

/// The reason why a payload is no message of the type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Too short for its encapsulation header.
    #[error("a payload of {bytes} bytes is not a serialised message")]
    TooShort {
        /// Its bytes.
        bytes: usize,
    },
    /// A representation that ROS 2 does not use.
    #[error("representation {id:#06x} is neither CDR nor CDR2")]
    Representation {
        /// The id in the header.
        id: u16,
    },
    /// The payload ends too early.
    #[error("it ends in {member}")]
    End {
        /// The path of the member that is cut: `pose.position.x`.
        member: String,
    },
    /// More elements or units than the definition allows.
    #[error("{member} has {found} elements, and at most {bound} are allowed")]
    Bound {
        /// The path of the member.
        member: String,
        /// Elements it has.
        found: u32,
        /// Elements it may have.
        bound: u32,
    },
    /// A `bool` that is neither 0 nor 1.
    #[error("{member} is a bool of {found}")]
    Bool {
        /// The path of the member.
        member: String,
        /// The value.
        found: u8,
    },
    /// Too many values.
    #[error("it has more than {VALUES_MAX} values")]
    TooManyValues,
    /// Bytes are left over.
    #[error("{bytes} bytes are left over: the publisher's definition is another")]
    LeftOver {
        /// Their number.
        bytes: usize,
    },
}

impl DecodeError {
    fn path(&mut self) -> Option<&mut String> {
        match self {
            Self::End { member } | Self::Bound { member, .. } | Self::Bool { member, .. } => Some(member),
            _ => None,
        }
    }

    fn under(mut self, member: &Member) -> Self {
        if let Some(path) = self.path() {
            path::under(path, &member.name);
        }
        self
    }

    fn at(mut self, index: usize) -> Self {
        if let Some(path) = self.path() {
            path::at(path, index);
        }
        self
    }
}

impl Layout {
    /// Decodes a serialised message: encapsulation header and body. Arrays and sequences of primitives share the
    /// payload's memory.
    pub fn decode(&self, payload: &Bytes) -> Result<Value, DecodeError> {
        self.decode_as(payload).map(|(value, _)| value)
    }

    /// Decodes a serialised message, and returns its encoding: [`Layout::encode_as`] writes it again as it was, except
    /// for non-zero alignment bytes, texts without the NUL at their end, and members that this definition lacks.
    pub fn decode_as(&self, payload: &Bytes) -> Result<(Value, Encoding), DecodeError> {
        let short = DecodeError::TooShort { bytes: payload.len() };
        let Some((head, body)) = payload.split_first_chunk::<ENCAPSULATION_BYTES>() else {
            return Err(short);
        };
        let id = u16::from_be_bytes([head[0], head[1]]);
        let plain = Encoding::from_id(id).ok_or(DecodeError::Representation { id })?;
        let said = head[3] & PADDING_BYTES_MAX as u8 != 0;
        let body = payload.slice_ref(body);
        let decode = |wide| -> Result<_, DecodeError> {
            let encoding = Encoding { wide, ..plain };
            let decoder =
                Decoder { layout: self, encoding, body: body.clone(), at: 0, end: body.len(), values: 0 };
            let (value, left) = decoder.run()?;
            let padding = match left {
                0 => Padding::None,
                _ if said => Padding::Said,
                _ => Padding::Silent,
            };
            Ok((value, Encoding { padding, ..encoding }))
        };
        // Only the whole message shows the width of a `wstring`.
        match decode(WideUnit::Two) {
            Err(first) if self.is_wide() && !plain.is_second() => decode(WideUnit::Four).map_err(|_| first),
            result => result,
        }
    }
}

struct Decoder<'a> {
    layout: &'a Layout,
    encoding: Encoding,
    body: Bytes,
    at: usize,
    /// End of the structure that is being read.
    end: usize,
    values: usize,
}

/// The end of the body; the path is assembled on the way up.
enum Stop {
    End,
    Bound { found: u32, bound: u32 },
    Bool(u8),
    TooManyValues,
}

impl From<Stop> for DecodeError {
    fn from(stop: Stop) -> Self {
        let member = String::new();
        match stop {
            Stop::End => Self::End { member },
            Stop::Bound { found, bound } => Self::Bound { member, found, bound },
            Stop::Bool(found) => Self::Bool { member, found },
            Stop::TooManyValues => Self::TooManyValues,
        }
    }
}

impl Decoder<'_> {
    /// Returns the value, and the number of bytes behind it.
    fn run(mut self) -> Result<(Value, usize), DecodeError> {
        let Some(root) = self.layout.structs.len().checked_sub(1) else {
            return Ok((Value::Record(Vec::new()), 0));
        };
        let value = self.record(root)?;
        match self.body.len() - self.at {
            left @ 0..=PADDING_BYTES_MAX => Ok((value, left)),
            bytes => Err(DecodeError::LeftOver { bytes }),
        }
    }

    /// Reads a message. Layouts have no circles and a bounded depth, so the recursion is bounded.
    fn record(&mut self, place: usize) -> Result<Value, DecodeError> {
        let layout = self.layout;
        let Some(this) = layout.structs.get(place) else { return Ok(Value::Record(Vec::new())) };
        let outer = self.end;
        if self.encoding.is_delimited() {
            let first = this.members.first();
            self.begin_delimited().map_err(|stop| match first {
                Some(member) => DecodeError::from(stop).under(member),
                None => DecodeError::TooManyValues,
            })?;
        }
        let mut members = Vec::with_capacity(this.members.len());
        for member in &this.members {
            // A publisher with an older definition leaves out the members added later.
            if self.encoding.is_delimited() && self.at == self.end {
                break;
            }
            let value = self.member(member).map_err(|error| error.under(member))?;
            members.push((member.name.clone(), value));
        }
        if self.encoding.is_delimited() {
            self.at = self.end;
            self.end = outer;
        }
        Ok(Value::Record(members))
    }

    fn begin_delimited(&mut self) -> Result<(), Stop> {
        let bytes = self.length()?;
        let end = self.at.checked_add(bytes as usize).filter(|end| *end <= self.end).ok_or(Stop::End)?;
        self.end = end;
        Ok(())
    }

    fn member(&mut self, member: &Member) -> Result<Value, DecodeError> {
        let sized = self.encoding.is_second() && !matches!(member.element, Element::Primitive(_));
        let outer = self.end;
        if sized && member.shape != Shape::One {
            self.begin_delimited()?;
        }
        let count = match member.shape {
            Shape::One => return self.element(member),
            Shape::Array(count) => count,
            Shape::Sequence { bound } => {
                let found = self.length()?;
                if let Some(bound) = bound.filter(|bound| found > *bound) {
                    return Err(Stop::Bound { found, bound }.into());
                }
                found
            }
        };
        let value = self.elements(member, count)?;
        self.end = outer;
        Ok(value)
    }

    fn elements(&mut self, member: &Member, count: u32) -> Result<Value, DecodeError> {
        let count = count as usize;
        if let Element::Primitive(primitive) = member.element {
            return self.packed(primitive, count);
        }
        // Every element has at least one byte.
        if count > self.end - self.at {
            return Err(Stop::End.into());
        }
        let mut all = Vec::with_capacity(count.min(RESERVE_MAX));
        for index in 0..count {
            all.push(self.element(member).map_err(|error| error.at(index))?);
        }
        Ok(Value::List(all))
    }

    fn packed(&mut self, primitive: Primitive, count: usize) -> Result<Value, DecodeError> {
        let size = primitive.bytes();
        let bytes = count.checked_mul(size).ok_or(Stop::End)?;
        if count > 0 {
            self.at = self.at.next_multiple_of(self.encoding.alignment(size)).min(self.end);
        }
        let mut octets = self.octets(bytes)?;
        if matches!(primitive, Primitive::Byte | Primitive::Uint8) {
            return Ok(Value::Octets(octets));
        }
        if size > 1 && !self.encoding.is_little() {
            let mut turned = octets.to_vec();
            turned.chunks_exact_mut(size).for_each(<[u8]>::reverse);
            octets = turned.into();
        }
        if let Some(packed) = PackedArray::new(primitive, octets.clone()) {
            return Ok(Value::PackedArray(packed));
        }
        // The elements are complete, so a `bool` is wrong.
        let wrong = octets.iter().enumerate().find(|(_, octet)| **octet > 1);
        let (index, found) = wrong.map_or((0, 0), |(index, octet)| (index, *octet));
        Err(DecodeError::from(Stop::Bool(found)).at(index))
    }

    fn element(&mut self, member: &Member) -> Result<Value, DecodeError> {
        self.values += 1;
        if self.values > VALUES_MAX {
            return Err(DecodeError::TooManyValues);
        }
        match member.element {
            Element::Struct(place) => self.record(place),
            Element::Primitive(primitive) => Ok(self.primitive(primitive)?),
            Element::String { bound } => Ok(self.string(bound)?),
            Element::WString { bound } => Ok(self.wide_string(bound)?),
        }
    }

    fn primitive(&mut self, primitive: Primitive) -> Result<Value, Stop> {
        Ok(match primitive.bytes() {
            1 => match (primitive, self.number::<1>()?) {
                (Primitive::Bool, [found]) if found > 1 => return Err(Stop::Bool(found)),
                (_, octet) => scalar(primitive, &octet),
            },
            2 => scalar(primitive, &self.number::<2>()?),
            4 => scalar(primitive, &self.number::<4>()?),
            _ => scalar(primitive, &self.number::<8>()?),
        })
    }

    fn string(&mut self, bound: Option<u32>) -> Result<Value, Stop> {
        let bytes = self.length()?;
        let mut text = self.octets(bytes as usize)?;
        // Its length counts the NUL that ends it; an empty one may come without.
        if text.last() == Some(&0) {
            text.truncate(text.len() - 1);
        }
        within(text.len(), bound)?;
        Ok(Value::from_bytes(text))
    }

    fn wide_string(&mut self, bound: Option<u32>) -> Result<Value, Stop> {
        let length = self.length()? as usize;
        // Version 2 counts bytes, version 1 units.
        let units = if self.encoding.is_second() { length / 2 } else { length };
        let unit_bytes = self.encoding.wide_bytes();
        let bytes = units.checked_mul(unit_bytes).ok_or(Stop::End)?;
        let raw = self.octets(bytes)?;
        let mut text: Vec<u16> = Vec::with_capacity(units);
        for unit in raw.chunks_exact(unit_bytes) {
            let value = unit.iter().enumerate().fold(0_u32, |value, (index, byte)| {
                let place = if self.encoding.is_little() { index } else { unit_bytes - 1 - index };
                value | u32::from(*byte) << (8 * place)
            });
            text.push(u16::try_from(value).map_err(|_| Stop::End)?);
        }
        if text.last() == Some(&0) {
            text.pop();
        }
        within(text.len(), bound)?;
        Ok(Value::from_units(text))
    }

    fn length(&mut self) -> Result<u32, Stop> {
        Ok(u32::from_le_bytes(self.number()?))
    }

    /// Reads a number of this many bytes, aligned to its size, little endian.
    fn number<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let begin = self.at.next_multiple_of(self.encoding.alignment(N));
        let end = begin.checked_add(N).filter(|end| *end <= self.end).ok_or(Stop::End)?;
        let mut bytes: [u8; N] =
            self.body.get(begin..end).and_then(|bytes| bytes.try_into().ok()).ok_or(Stop::End)?;
        self.at = end;
        if !self.encoding.is_little() {
            bytes.reverse();
        }
        Ok(bytes)
    }

    fn octets(&mut self, count: usize) -> Result<Bytes, Stop> {
        self.values += 1;
        if self.values > VALUES_MAX {
            return Err(Stop::TooManyValues);
        }
        let end = self.at.checked_add(count).filter(|end| *end <= self.end).ok_or(Stop::End)?;
        let octets = self.body.slice(self.at..end);
        self.at = end;
        Ok(octets)
    }
}

fn within(found: usize, bound: Option<u32>) -> Result<(), Stop> {
    match bound {
        Some(bound) if found > bound as usize => {
            Err(Stop::Bound { found: found.try_into().unwrap_or(u32::MAX), bound })
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::library::Library;
    use crate::testing::layout;

    fn decode(text: &str, payload: &[u8]) -> Result<String, DecodeError> {
        layout(text).decode(&Bytes::copy_from_slice(payload)).map(|value| value.to_json())
    }

    #[test]
    fn both_byte_orders_and_all_alignments() {
        let text = "uint8 a\nuint64 b\nstring c\nuint16[] d";
        let little = b"\0\x01\0\0\x01\0\0\0\0\0\0\0\x02\0\0\0\0\0\0\0\x03\0\0\0hi\0\0\x01\0\0\0\x05\0\0\0";
        let big = b"\0\0\0\0\x01\0\0\0\0\0\0\0\0\0\0\0\0\0\0\x02\0\0\0\x03hi\0\0\0\0\0\x01\0\x05\0\0";
        let second = b"\0\x07\0\0\x01\0\0\0\x02\0\0\0\0\0\0\0\x03\0\0\0hi\0\0\x01\0\0\0\x05\0\0\0";
        for payload in [&little[..], big, second] {
            assert_eq!(decode(text, payload).unwrap(), r#"{"a":1,"b":2,"c":"hi","d":[5]}"#);
        }
    }

    #[test]
    fn sized_structures_may_be_older_or_newer() {
        // DHEADER 4: `a` and `b` of the struct; then the members that an older publisher does not have.
        let older = b"\0\x09\0\0\x08\0\0\0\x04\0\0\0\x01\0\x02\0";
        assert_eq!(decode("Two x\nuint8 added", older).unwrap(), r#"{"x":{"a":1,"b":2}}"#);
        let newer = b"\0\x09\0\0\x0c\0\0\0\x05\0\0\0\x01\0\x02\0\x09\0\0\0";
        assert_eq!(decode("Two x", newer).unwrap(), r#"{"x":{"a":1,"b":2}}"#);
        // A sequence of structs carries its size in version 2.
        let sequence = b"\0\x07\0\0\x08\0\0\0\x01\0\0\0\x01\0\x02\0";
        assert_eq!(decode("Two[] x", sequence).unwrap(), r#"{"x":[{"a":1,"b":2}]}"#);
    }

    #[test]
    fn the_stamp_is_found_without_the_rest() {
        let name = "sensor_msgs/msg/Image".parse().unwrap();
        let image = Library::empty().layout(&name, &mut |_| None).unwrap();
        let little = b"\0\x01\0\0\x02\0\0\0\x05\0\0\0\xff";
        let big = b"\0\0\0\0\0\0\0\x02\0\0\0\x05";
        let sized = b"\0\x09\0\0\xff\0\0\0\x10\0\0\0\x08\0\0\0\x02\0\0\0\x05\0\0\0";
        for payload in [&little[..], big, sized] {
            assert_eq!(image.header_stamp_ns(payload), Some(2_000_000_005));
            assert_eq!(image.header_stamp_ns(&payload[..11]), None);
        }
        assert_eq!(layout("uint64 a").header_stamp_ns(little), None);
    }

    #[test]
    fn wide_strings_of_either_width() {
        for payload in [&b"\0\x01\0\0\x02\0\0\0h\0i\0"[..], b"\0\x01\0\0\x02\0\0\0h\0\0\0i\0\0\0"] {
            assert_eq!(decode("wstring a", payload).unwrap(), r#"{"a":"hi"}"#);
        }
        assert_eq!(decode("wstring a", b"\0\x07\0\0\x04\0\0\0h\0i\0").unwrap(), r#"{"a":"hi"}"#);
    }

    #[test]
    fn values_that_do_not_fit_are_reported() {
        let member = || "a".to_owned();
        for (text, payload, error) in [
            ("uint8 a", &b"\0\x01"[..], DecodeError::TooShort { bytes: 2 }),
            ("uint8 a", b"\0\x03\0\0\0", DecodeError::Representation { id: 3 }),
            ("uint8 a", b"\0\x01\0\0", DecodeError::End { member: member() }),
            ("bool a", b"\0\x01\0\0\x02", DecodeError::Bool { member: member(), found: 2 }),
            ("uint8 a", b"\0\x01\0\0\x01\0\0\0\0", DecodeError::LeftOver { bytes: 4 }),
            ("uint16[] a", b"\0\x01\0\0\xff\xff\xff\xff", DecodeError::End { member: member() }),
            (
                "string<=1 a",
                b"\0\x01\0\0\x03\0\0\0hi\0",
                DecodeError::Bound { member: member(), found: 2, bound: 1 },
            ),
            (
                "uint8[<=1] a",
                b"\0\x01\0\0\x02\0\0\0\0\0",
                DecodeError::Bound { member: member(), found: 2, bound: 1 },
            ),
            ("uint8 a", b"\0\x09\0\0\xff\0\0\0", DecodeError::End { member: member() }),
            ("Two a", b"\0\x01\0\0\x01", DecodeError::End { member: "a.b".to_owned() }),
            ("Two[] a", b"\0\x01\0\0\x01\0\0\0\x01", DecodeError::End { member: "a[0].b".to_owned() }),
            ("bool[2] a", b"\0\x01\0\0\x01\x02", DecodeError::Bool { member: "a[1]".to_owned(), found: 2 }),
        ] {
            assert_eq!(decode(text, payload), Err(error), "{text}");
        }
        let mut many = b"\0\x01\0\0".to_vec();
        many.extend((VALUES_MAX as u32).to_le_bytes());
        many.resize(many.len() + VALUES_MAX, 0);
        // Elements of primitives are one value together.
        assert!(decode("int8[] a", &many).is_ok());
        many.extend(vec![0; 3 * VALUES_MAX]);
        assert_eq!(decode("string[] a", &many), Err(DecodeError::TooManyValues));
    }
}
