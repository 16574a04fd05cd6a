//! CDR to values (DDS-XTypes 1.3, 7.4; RTPS 2.5, 10.2).

use bytes::Bytes;

use crate::definition::{Primitive, Shape};
use crate::layout::{Element, Layout, Member};
use crate::value::Value;

/// Most values in one message; a sequence of octets is one.
pub const VALUES_MAX: usize = 4 << 20;
/// Bytes before the body: representation and options.
const ENCAPSULATION_BYTES: usize = 4;
/// Bytes that a payload may be filled up with.
const PADDING_BYTES_MAX: usize = 3;
/// Elements that room is made for before they are there.
const RESERVE_MAX: usize = 1024;

/// Why a payload is no message of the type.
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
        /// As in the header.
        id: u16,
    },
    /// It ends too early.
    #[error("it ends in {member}")]
    End {
        /// The member that is cut.
        member: String,
    },
    /// More elements or units than the definition allows.
    #[error("{member} has {found} elements, and at most {bound} are allowed")]
    Bound {
        /// The member.
        member: String,
        /// Elements it has.
        found: u32,
        /// Elements it may have.
        bound: u32,
    },
    /// A `bool` that is neither 0 nor 1.
    #[error("{member} is a bool of {found}")]
    Bool {
        /// The member.
        member: String,
        /// What it is.
        found: u8,
    },
    /// Too many values.
    #[error("it has more than {VALUES_MAX} values")]
    TooManyValues,
    /// Something is left over.
    #[error("{bytes} bytes are left over: the publisher's definition is another")]
    LeftOver {
        /// How many.
        bytes: usize,
    },
}

/// How a representation differs from others.
#[derive(Clone, Copy)]
struct Encoding {
    little: bool,
    /// Version 2: what has 8 bytes is aligned to 4, and collections of what is no primitive say their size.
    second: bool,
    /// Structures say their size, and may end early or go on.
    delimited: bool,
    /// Bytes of a unit of a `wstring`: vendors disagree.
    wide_bytes: usize,
}

impl Layout {
    /// Decodes a serialised message: encapsulation header and body.
    pub fn decode(&self, payload: &Bytes) -> Result<Value, DecodeError> {
        let short = DecodeError::TooShort { bytes: payload.len() };
        let Some((head, body)) = payload.split_first_chunk::<ENCAPSULATION_BYTES>() else {
            return Err(short);
        };
        let id = u16::from_be_bytes([head[0], head[1]]);
        let (second, delimited) = match id {
            0x0000 | 0x0001 => (false, false),
            0x0006 | 0x0007 => (true, false),
            0x0008 | 0x0009 => (true, true),
            _ => return Err(DecodeError::Representation { id }),
        };
        let body = payload.slice_ref(body);
        let decode = |wide_bytes| {
            let encoding = Encoding { little: id & 1 == 1, second, delimited, wide_bytes };
            Decoder { layout: self, encoding, body: body.clone(), at: 0, end: body.len(), values: 0 }.run()
        };
        // UTF-16 in four bytes a unit was what Fast CDR 1 and RMWs of its time wrote. Only the whole shows which it is.
        match decode(2) {
            Err(first) if self.is_wide() => decode(4).map_err(|_| first),
            result => result,
        }
    }
}

struct Decoder<'a> {
    layout: &'a Layout,
    encoding: Encoding,
    body: Bytes,
    at: usize,
    /// Where what is being read ends.
    end: usize,
    values: usize,
}

/// Where the body ended; what was being read is added on the way up.
enum Stop {
    End,
    Bound { found: u32, bound: u32 },
    Bool(u8),
    TooManyValues,
}

impl Stop {
    fn in_member(self, member: &Member) -> DecodeError {
        let member = member.name.to_string();
        match self {
            Self::End => DecodeError::End { member },
            Self::Bound { found, bound } => DecodeError::Bound { member, found, bound },
            Self::Bool(found) => DecodeError::Bool { member, found },
            Self::TooManyValues => DecodeError::TooManyValues,
        }
    }
}

impl Decoder<'_> {
    fn run(mut self) -> Result<Value, DecodeError> {
        let Some(root) = self.layout.structs.len().checked_sub(1) else {
            return Ok(Value::Record(Vec::new()));
        };
        let value = self.record(root)?;
        match self.body.len() - self.at {
            0..=PADDING_BYTES_MAX => Ok(value),
            bytes => Err(DecodeError::LeftOver { bytes }),
        }
    }

    /// A message. Layouts have no circles and a bounded depth, and so has this.
    fn record(&mut self, place: usize) -> Result<Value, DecodeError> {
        let layout = self.layout;
        let Some(this) = layout.structs.get(place) else { return Ok(Value::Record(Vec::new())) };
        let outer = self.end;
        if self.encoding.delimited {
            let first = this.members.first();
            self.begin_delimited().map_err(|stop| match first {
                Some(member) => stop.in_member(member),
                None => DecodeError::TooManyValues,
            })?;
        }
        let mut members = Vec::with_capacity(this.members.len());
        for member in &this.members {
            // A publisher with an older definition leaves out what was added behind.
            if self.encoding.delimited && self.at == self.end {
                break;
            }
            members.push((member.name.clone(), self.member(member)?));
        }
        if self.encoding.delimited {
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
        let sized = self.encoding.second && !matches!(member.element, Element::Primitive(_));
        let outer = self.end;
        if sized && member.shape != Shape::One {
            self.begin_delimited().map_err(|stop| stop.in_member(member))?;
        }
        let count = match member.shape {
            Shape::One => return self.element(member),
            Shape::Array(count) => count,
            Shape::Sequence { bound } => {
                let found = self.length().map_err(|stop| stop.in_member(member))?;
                if let Some(bound) = bound.filter(|bound| found > *bound) {
                    return Err(Stop::Bound { found, bound }.in_member(member));
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
        if let Element::Primitive(Primitive::Byte | Primitive::Uint8) = member.element {
            return self.octets(count).map(Value::Octets).map_err(|stop| stop.in_member(member));
        }
        // Every element has a byte at least.
        if count > self.end - self.at {
            return Err(Stop::End.in_member(member));
        }
        let mut all = Vec::with_capacity(count.min(RESERVE_MAX));
        for _ in 0..count {
            all.push(self.element(member)?);
        }
        Ok(Value::List(all))
    }

    fn element(&mut self, member: &Member) -> Result<Value, DecodeError> {
        self.values += 1;
        if self.values > VALUES_MAX {
            return Err(DecodeError::TooManyValues);
        }
        let value = match member.element {
            Element::Struct(place) => return self.record(place),
            Element::Primitive(primitive) => self.primitive(primitive),
            Element::String { bound } => self.string(bound),
            Element::WString { bound } => self.wide_string(bound),
        };
        value.map_err(|stop| stop.in_member(member))
    }

    fn primitive(&mut self, primitive: Primitive) -> Result<Value, Stop> {
        Ok(match primitive {
            Primitive::Bool => match self.number::<1>()? {
                [0] => Value::Bool(false),
                [1] => Value::Bool(true),
                [other] => return Err(Stop::Bool(other)),
            },
            Primitive::Byte | Primitive::Uint8 => Value::Uint(u64::from(u8::from_le_bytes(self.number()?))),
            Primitive::Int8 => Value::Int(i64::from(i8::from_le_bytes(self.number()?))),
            Primitive::Int16 => Value::Int(i64::from(i16::from_le_bytes(self.number()?))),
            Primitive::Int32 => Value::Int(i64::from(i32::from_le_bytes(self.number()?))),
            Primitive::Int64 => Value::Int(i64::from_le_bytes(self.number()?)),
            Primitive::Uint16 => Value::Uint(u64::from(u16::from_le_bytes(self.number()?))),
            Primitive::Uint32 => Value::Uint(u64::from(u32::from_le_bytes(self.number()?))),
            Primitive::Uint64 => Value::Uint(u64::from_le_bytes(self.number()?)),
            Primitive::Float32 => Value::Float32(f32::from_le_bytes(self.number()?)),
            Primitive::Float64 => Value::Float64(f64::from_le_bytes(self.number()?)),
        })
    }

    fn string(&mut self, bound: Option<u32>) -> Result<Value, Stop> {
        let bytes = self.length()?;
        let text = self.octets(bytes as usize)?;
        // Its length counts the NUL that ends it; an empty one may come without.
        let text = text.strip_suffix(&[0]).unwrap_or(&text);
        within(text.len(), bound)?;
        Ok(Value::Text(String::from_utf8_lossy(text).into_owned()))
    }

    fn wide_string(&mut self, bound: Option<u32>) -> Result<Value, Stop> {
        let length = self.length()? as usize;
        // Version 2 counts bytes, version 1 units.
        let units = if self.encoding.second { length / 2 } else { length };
        let unit_bytes = if self.encoding.second { 2 } else { self.encoding.wide_bytes };
        let bytes = units.checked_mul(unit_bytes).ok_or(Stop::End)?;
        let raw = self.octets(bytes)?;
        let mut text: Vec<u16> = Vec::with_capacity(units);
        for unit in raw.chunks_exact(unit_bytes) {
            let value = unit.iter().enumerate().fold(0_u32, |value, (index, byte)| {
                let place = if self.encoding.little { index } else { unit_bytes - 1 - index };
                value | u32::from(*byte) << (8 * place)
            });
            text.push(u16::try_from(value).map_err(|_| Stop::End)?);
        }
        if text.last() == Some(&0) {
            text.pop();
        }
        within(text.len(), bound)?;
        Ok(Value::Text(String::from_utf16_lossy(&text)))
    }

    fn length(&mut self) -> Result<u32, Stop> {
        Ok(u32::from_le_bytes(self.number()?))
    }

    /// A number of so many bytes, aligned to them, the least first.
    fn number<const N: usize>(&mut self) -> Result<[u8; N], Stop> {
        let alignment = if self.encoding.second { N.min(4) } else { N };
        let begin = self.at.next_multiple_of(alignment);
        let end = begin.checked_add(N).filter(|end| *end <= self.end).ok_or(Stop::End)?;
        let mut bytes: [u8; N] =
            self.body.get(begin..end).and_then(|bytes| bytes.try_into().ok()).ok_or(Stop::End)?;
        self.at = end;
        if !self.encoding.little {
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

    fn layout(text: &str) -> Layout {
        let mut texts = |file: &crate::TypeName| match file.name() {
            "M" => Some(text.to_owned()),
            "Two" => Some("uint8 a\nuint16 b".to_owned()),
            _ => None,
        };
        Library::empty().layout(&"p/msg/M".parse().unwrap(), &mut texts).unwrap()
    }

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
    fn what_says_its_size_may_be_older_or_newer() {
        // DHEADER 4: `a` and `b` of the struct; then what an older publisher does not have.
        let older = b"\0\x09\0\0\x08\0\0\0\x04\0\0\0\x01\0\x02\0";
        assert_eq!(decode("Two x\nuint8 added", older).unwrap(), r#"{"x":{"a":1,"b":2}}"#);
        let newer = b"\0\x09\0\0\x0c\0\0\0\x05\0\0\0\x01\0\x02\0\x09\0\0\0";
        assert_eq!(decode("Two x", newer).unwrap(), r#"{"x":{"a":1,"b":2}}"#);
        // A sequence of structs says its size in version 2.
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
    fn what_does_not_fit_is_said() {
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
        ] {
            assert_eq!(decode(text, payload), Err(error), "{text}");
        }
        let mut many = b"\0\x01\0\0".to_vec();
        many.extend((VALUES_MAX as u32).to_le_bytes());
        many.resize(many.len() + VALUES_MAX, 0);
        assert_eq!(decode("int8[] a", &many).unwrap().len(), 7 + VALUES_MAX * 2);
        many.extend([0; 8]);
        many[4] = 1;
        assert_eq!(decode("int8[] a", &many), Err(DecodeError::TooManyValues));
    }
}
