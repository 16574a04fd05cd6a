//! Values as CBOR (RFC 8949) with typed arrays (RFC 8746), both ways, as in the rosbridge protocol: docs/spec/json.md.
//!
//! `ciborium` reads the heads of items; the layout directs the reading of their content and bounds the depth.

use std::sync::Arc;

use bytes::Bytes;
use ciborium_ll::{Decoder, Encoder, Header, simple};

use crate::definition::{DUMMY_MEMBER, Primitive, Shape};
use crate::fault::{Budget, ValueError, ValueProblem, fits, fits_bound, fits_one_more, short};
use crate::layout::{Element, Layout, Member};
use crate::number::{Number, fit, little};
use crate::value::{PackedArray, Value, scalar};

/// `uint8`, as a typed array.
const TAG_OCTETS: u64 = 64;
/// `uint16`, little endian.
const TAG_UNITS: u64 = 69;
/// "This is CBOR", which may stand in front (RFC 8949, 3.4.6).
const TAG_SELF_DESCRIBED: u64 = 55799;
/// Most elements for which memory is reserved before they are read.
const RESERVE_MAX: usize = 1024;

impl Value {
    /// Returns CBOR. [`Layout::from_cbor`] reads it.
    pub fn to_cbor(&self) -> Vec<u8> {
        let mut out = Vec::new();
        self.write_cbor(&mut out);
        out
    }

    /// Appends the value as CBOR. The depth is bounded as that of layouts.
    pub fn write_cbor(&self, out: &mut Vec<u8>) {
        match self {
            Self::Bool(value) => head(out, Header::Simple(if *value { simple::TRUE } else { simple::FALSE })),
            Self::Int(value) => head(
                out,
                match u64::try_from(*value) {
                    Ok(value) => Header::Positive(value),
                    Err(_) => Header::Negative(!value.cast_unsigned()),
                },
            ),
            Self::Uint(value) => head(out, Header::Positive(*value)),
            Self::Float32(value) => head(out, Header::Float(f64::from(*value))),
            Self::Float64(value) => head(out, Header::Float(*value)),
            Self::Text(text) => write_text(out, text),
            Self::Raw(bytes) | Self::Octets(bytes) => write_bytes(out, bytes),
            Self::Wide(units) => {
                head(out, Header::Tag(TAG_UNITS));
                let bytes: Vec<u8> = units.iter().flat_map(|unit| unit.to_le_bytes()).collect();
                write_bytes(out, &bytes);
            }
            Self::PackedArray(packed) => match tag_of(packed.primitive()) {
                Some(tag) => {
                    head(out, Header::Tag(tag));
                    write_bytes(out, packed.octets());
                }
                None => {
                    head(out, Header::Array(Some(packed.len())));
                    packed.iter().for_each(|value| value.write_cbor(out));
                }
            },
            Self::List(all) => {
                head(out, Header::Array(Some(all.len())));
                all.iter().for_each(|value| value.write_cbor(out));
            }
            Self::Record(members) => {
                let shown = || members.iter().filter(|(name, _)| &**name != DUMMY_MEMBER);
                head(out, Header::Map(Some(shown().count())));
                for (name, value) in shown() {
                    write_text(out, name);
                    value.write_cbor(out);
                }
            }
        }
    }
}

fn head(out: &mut Vec<u8>, header: Header) {
    // Writing to a vector never fails.
    let _ = Encoder::from(out).push(header);
}

fn write_text(out: &mut Vec<u8>, text: &str) {
    head(out, Header::Text(Some(text.len())));
    out.extend_from_slice(text.as_bytes());
}

fn write_bytes(out: &mut Vec<u8>, bytes: &[u8]) {
    head(out, Header::Bytes(Some(bytes.len())));
    out.extend_from_slice(bytes);
}

/// Returns the tag of a typed array; `bool` has none, and octets need none.
fn tag_of(primitive: Primitive) -> Option<u64> {
    Some(match primitive {
        Primitive::Uint16 => TAG_UNITS,
        Primitive::Uint32 => 70,
        Primitive::Uint64 => 71,
        Primitive::Int8 => 72,
        Primitive::Int16 => 77,
        Primitive::Int32 => 78,
        Primitive::Int64 => 79,
        Primitive::Float32 => 85,
        Primitive::Float64 => 86,
        Primitive::Bool | Primitive::Byte | Primitive::Uint8 => return None,
    })
}

/// Returns the element type of a typed array's tag, and whether it is little endian.
fn from_tag(tag: u64) -> Option<(Primitive, bool)> {
    Some(match tag {
        // Tag 68 is clamped arithmetic for graphics; as data it is the same.
        TAG_OCTETS | 68 => (Primitive::Uint8, true),
        65 => (Primitive::Uint16, false),
        66 => (Primitive::Uint32, false),
        67 => (Primitive::Uint64, false),
        TAG_UNITS => (Primitive::Uint16, true),
        70 => (Primitive::Uint32, true),
        71 => (Primitive::Uint64, true),
        72 => (Primitive::Int8, true),
        73 => (Primitive::Int16, false),
        74 => (Primitive::Int32, false),
        75 => (Primitive::Int64, false),
        77 => (Primitive::Int16, true),
        78 => (Primitive::Int32, true),
        79 => (Primitive::Int64, true),
        81 => (Primitive::Float32, false),
        82 => (Primitive::Float64, false),
        85 => (Primitive::Float32, true),
        86 => (Primitive::Float64, true),
        _ => return None,
    })
}

impl Layout {
    /// Reads a message of the type from CBOR. Missing members take their default; octets and typed arrays share the
    /// memory of the input.
    pub fn from_cbor(&self, cbor: &Bytes) -> Result<Value, ValueError> {
        let mut reader = Reader { layout: self, body: cbor.clone(), at: 0, budget: Budget::default() };
        let mut first = reader.header()?;
        if first == Header::Tag(TAG_SELF_DESCRIBED) {
            first = reader.header()?;
        }
        let value = match self.structs.len().checked_sub(1) {
            Some(place) => reader.record(place, first)?,
            None => Value::Record(Vec::new()),
        };
        match cbor.len() - reader.at {
            0 => Ok(value),
            more => Err(ValueProblem::Syntax(format!("{more} bytes are left over")).into()),
        }
    }
}

struct Reader<'a> {
    layout: &'a Layout,
    body: Bytes,
    at: usize,
    budget: Budget,
}

impl Reader<'_> {
    fn header(&mut self) -> Result<Header, ValueProblem> {
        let mut decoder = Decoder::from(self.body.get(self.at..).unwrap_or_default());
        let header = decoder.pull();
        let at = self.at;
        self.at += decoder.offset();
        header.map_err(|error| match error {
            ciborium_ll::Error::Io(_) => ended(),
            ciborium_ll::Error::Syntax(_) => ValueProblem::Syntax(format!("there is no CBOR at byte {at}")),
        })
    }

    fn take(&mut self, bytes: usize) -> Result<Bytes, ValueProblem> {
        let end = self.at.checked_add(bytes).filter(|end| *end <= self.body.len()).ok_or_else(ended)?;
        let taken = self.body.slice(self.at..end);
        self.at = end;
        Ok(taken)
    }

    /// Reads the content of a head of bytes or text. Content of unknown length comes in pieces.
    fn content(&mut self, length: Option<usize>, text: bool) -> Result<Bytes, ValueProblem> {
        if let Some(bytes) = length {
            self.budget.bytes(bytes)?;
            return self.take(bytes);
        }
        let mut whole = Vec::new();
        loop {
            match self.header()? {
                Header::Break => return Ok(whole.into()),
                Header::Bytes(Some(bytes)) if !text => {
                    self.budget.bytes(bytes)?;
                    whole.extend_from_slice(&self.take(bytes)?);
                }
                Header::Text(Some(bytes)) if text => {
                    self.budget.bytes(bytes)?;
                    whole.extend_from_slice(&self.take(bytes)?);
                }
                other => return Err(is_no(other, "a piece of a text")),
            }
        }
    }

    fn record(&mut self, place: usize, first: Header) -> Result<Value, ValueError> {
        let Header::Map(count) = first else { return Err(is_no(first, "a map of members").into()) };
        self.budget.value()?;
        let layout = self.layout;
        let Some(this) = layout.structs.get(place) else { return Ok(Value::Record(Vec::new())) };
        let mut given: Vec<Option<Value>> = Vec::new();
        given.resize_with(this.members.len(), || None);
        let mut next = 0;
        let mut left = count;
        while let Some(key) = self.next(&mut left)? {
            let Header::Text(length) = key else { return Err(is_no(key, "the name of a member").into()) };
            let name = self.content(length, true)?;
            let is = |member: &Member| member.name.as_bytes() == name;
            let index = match this.members.get(next).is_some_and(is) {
                true => Some(next),
                false => this.members.iter().position(is),
            };
            let slot = index.and_then(|index| Some((index, this.members.get(index)?, given.get_mut(index)?)));
            let Some((index, member, slot)) = slot else {
                return Err(ValueProblem::Unknown(short(&String::from_utf8_lossy(&name))).into());
            };
            if slot.is_some() {
                return Err(ValueProblem::Twice(member.name.to_string()).into());
            }
            *slot = Some(self.member(member).map_err(|error| error.under(&member.name))?);
            next = index + 1;
        }
        let mut members: Vec<(Arc<str>, Value)> = Vec::with_capacity(given.len());
        for (member, value) in this.members.iter().zip(given) {
            let value = match value {
                Some(value) => value,
                None => {
                    layout.default_of(member, &mut self.budget).map_err(|error| error.under(&member.name))?
                }
            };
            members.push((member.name.clone(), value));
        }
        Ok(Value::Record(members))
    }

    /// Reads the head of the next item of a collection with this many left; a collection of unknown length marks its
    /// end.
    fn next(&mut self, left: &mut Option<usize>) -> Result<Option<Header>, ValueProblem> {
        match left {
            Some(0) => return Ok(None),
            Some(left) => *left -= 1,
            None => {}
        }
        let header = self.header()?;
        if left.is_none() && header == Header::Break { Ok(None) } else { Ok(Some(header)) }
    }

    fn member(&mut self, member: &Member) -> Result<Value, ValueError> {
        let first = self.header()?;
        if member.shape == Shape::One {
            return self.element(member, first);
        }
        self.budget.value()?;
        let primitive = match member.element {
            Element::Primitive(primitive) => Some(primitive),
            _ => None,
        };
        match (first, primitive) {
            (Header::Array(count), _) => self.elements(member, count),
            (Header::Bytes(length), Some(primitive)) => {
                let bytes = self.content(length, false)?;
                self.typed_array(member, primitive, (Primitive::Uint8, true), bytes)
            }
            (Header::Tag(tag), Some(primitive)) => {
                let no_tag = || is_no(Header::Tag(tag), "an array");
                let source = from_tag(tag).ok_or_else(no_tag)?;
                let length = match self.header()? {
                    Header::Bytes(length) => length,
                    other => return Err(is_no(other, "the bytes of a typed array").into()),
                };
                let bytes = self.content(length, false)?;
                self.typed_array(member, primitive, source, bytes)
            }
            (other, _) => Err(is_no(other, "an array").into()),
        }
    }

    fn elements(&mut self, member: &Member, count: Option<usize>) -> Result<Value, ValueError> {
        if let Some(count) = count {
            fits(member.shape, count)?;
        }
        let mut left = count;
        let mut found = 0;
        let mut octets = Vec::new();
        let mut values = Vec::with_capacity(match member.element {
            Element::Primitive(_) => 0,
            _ => count.unwrap_or(0).min(RESERVE_MAX),
        });
        while let Some(first) = self.next(&mut left).map_err(|problem| ValueError::from(problem).at(found))? {
            fits_one_more(member.shape, found)?;
            let at = |error: ValueError| error.at(found);
            match member.element {
                Element::Primitive(primitive) => {
                    let value = self.primitive(primitive, first).map_err(|problem| at(problem.into()))?;
                    self.budget.bytes(primitive.bytes())?;
                    octets.extend(little(&value).into_iter().take(primitive.bytes()));
                }
                _ => values.push(self.element(member, first).map_err(at)?),
            }
            found += 1;
        }
        fits(member.shape, found)?;
        Ok(match member.element {
            Element::Primitive(primitive) => packed(primitive, octets.into()),
            _ => Value::List(values),
        })
    }

    fn typed_array(
        &mut self,
        member: &Member,
        target: Primitive,
        (source, is_little): (Primitive, bool),
        bytes: Bytes,
    ) -> Result<Value, ValueError> {
        let size = source.bytes();
        if !bytes.len().is_multiple_of(size) {
            return Err(
                ValueProblem::Syntax("the last element of a typed array is not whole".to_owned()).into()
            );
        }
        fits(member.shape, bytes.len() / size)?;
        // Some clients send the octets of a `byte[]` as signed ones.
        let octets = |primitive| matches!(primitive, Primitive::Byte | Primitive::Uint8);
        let same = source == target || octets(target) && size == 1;
        if same && (is_little || size == 1) {
            return Ok(packed(target, bytes));
        }
        self.budget.bytes(bytes.len() / size * target.bytes())?;
        let mut out = Vec::with_capacity(bytes.len() / size * target.bytes());
        for (index, element) in bytes.chunks_exact(size).enumerate() {
            let mut turned = [0; 8];
            for (place, byte) in element.iter().enumerate() {
                turned[if is_little { place } else { size - 1 - place }] = *byte;
            }
            let value = fit(&scalar(source, &turned), target);
            let value = value.map_err(|problem| ValueError::from(problem).at(index))?;
            out.extend(little(&value).into_iter().take(target.bytes()));
        }
        Ok(packed(target, out.into()))
    }

    fn element(&mut self, member: &Member, first: Header) -> Result<Value, ValueError> {
        if let Element::Struct(place) = member.element {
            return self.record(place, first);
        }
        self.budget.value()?;
        Ok(match member.element {
            Element::Primitive(primitive) => self.primitive(primitive, first)?,
            Element::String { bound } => {
                let bytes = match first {
                    Header::Text(length) => self.content(length, true)?,
                    Header::Bytes(length) => self.content(length, false)?,
                    other => return Err(is_no(other, "string").into()),
                };
                fits_bound(bound, bytes.len())?;
                match (first, Value::from_bytes(bytes)) {
                    (Header::Text(_), Value::Raw(_)) => return Err(no_utf8().into()),
                    (_, value) => value,
                }
            }
            Element::WString { bound } => {
                let units: Vec<u16> = match first {
                    Header::Text(length) => match Value::from_bytes(self.content(length, true)?) {
                        Value::Text(text) => {
                            fits_bound(bound, text.encode_utf16().count())?;
                            return Ok(Value::Text(text));
                        }
                        _ => return Err(no_utf8().into()),
                    },
                    Header::Tag(TAG_UNITS) => match self.header()? {
                        Header::Bytes(length) => {
                            let bytes = self.content(length, false)?;
                            bytes.chunks_exact(2).map(|unit| u16::from_le_bytes([unit[0], unit[1]])).collect()
                        }
                        other => return Err(is_no(other, "wstring").into()),
                    },
                    other => return Err(is_no(other, "wstring").into()),
                };
                fits_bound(bound, units.len())?;
                Value::from_units(units)
            }
            Element::Struct(_) => Value::Record(Vec::new()),
        })
    }

    fn primitive(&mut self, primitive: Primitive, header: Header) -> Result<Value, ValueProblem> {
        let number = match header {
            Header::Positive(value) => Number::Integer(i128::from(value)),
            Header::Negative(value) => Number::Integer(-1 - i128::from(value)),
            Header::Float(value) => Number::Float64(value),
            Header::Simple(simple::TRUE | simple::FALSE) if primitive == Primitive::Bool => {
                return Ok(Value::Bool(header == Header::Simple(simple::TRUE)));
            }
            Header::Simple(simple::NULL | simple::UNDEFINED)
                if matches!(primitive, Primitive::Float32 | Primitive::Float64) =>
            {
                Number::Float64(f64::NAN)
            }
            other => return Err(is_no(other, primitive.name())),
        };
        number.fit(primitive)
    }
}

/// Returns the elements of an array or a sequence of primitives, whose values were checked before.
fn packed(primitive: Primitive, octets: Bytes) -> Value {
    PackedArray::new(primitive, octets.clone()).map_or(Value::Octets(octets), Value::PackedArray)
}

fn ended() -> ValueProblem {
    ValueProblem::Syntax("the CBOR ends too early".to_owned())
}

fn no_utf8() -> ValueProblem {
    ValueProblem::Syntax("a text is not UTF-8".to_owned())
}

fn is_no(header: Header, expected: &'static str) -> ValueProblem {
    let found = match header {
        Header::Positive(_) | Header::Negative(_) => "an integer",
        Header::Float(_) => "a float",
        Header::Simple(simple::TRUE | simple::FALSE) => "a bool",
        Header::Simple(_) => "null",
        Header::Tag(tag) => return ValueProblem::Kind { found: format!("tag {tag}"), expected },
        Header::Break => "an end",
        Header::Bytes(_) => "bytes",
        Header::Text(_) => "a text",
        Header::Array(_) => "an array",
        Header::Map(_) => "a map",
    };
    ValueProblem::Kind { found: found.to_owned(), expected }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::layout;

    fn read(text: &str, cbor: &[u8]) -> Result<String, String> {
        let layout = layout(text);
        let value = layout.from_cbor(&Bytes::copy_from_slice(cbor)).map_err(|error| error.to_string())?;
        layout.encode(&value).unwrap();
        Ok(value.to_json())
    }

    /// Returns a map of one member `a`.
    fn with(item: &[u8]) -> Vec<u8> {
        [b"\xa1\x61a", item].concat()
    }

    #[test]
    fn cbor_is_written_as_rosbridge_writes_it() {
        let json = r#"{"o": "AQI=", "f": [1.5], "i": [-2], "b": [true], "t": {"a": 1}, "s": "x", "n": -1, "d": 0.1}"#;
        let layout =
            layout("uint8[] o\nfloat32[] f\nint16[] i\nbool[] b\nTwo t\nstring s\nint64 n\nfloat64 d");
        let value = layout.from_json(json.as_bytes()).unwrap();
        let cbor = value.to_cbor();
        let expected = [
            &b"\xa8\x61o\x42\x01\x02"[..],
            b"\x61f\xd8\x55\x44\0\0\xc0\x3f",
            b"\x61i\xd8\x4d\x42\xfe\xff",
            b"\x61b\x81\xf5",
            b"\x61t\xa2\x61a\x01\x61b\x07",
            b"\x61s\x61x\x61n\x20",
            b"\x61d\xfb\x3f\xb9\x99\x99\x99\x99\x99\x9a",
        ];
        assert_eq!(cbor, expected.concat());
        assert_eq!(layout.from_cbor(&cbor.into()), Ok(value));
    }

    #[test]
    fn cbor_of_clients_is_understood() {
        for (text, item, found) in [
            ("int64 a", &b"\x3b\x7f\xff\xff\xff\xff\xff\xff\xff"[..], r#"{"a":-9223372036854775808}"#),
            ("uint64 a", b"\x1b\xff\xff\xff\xff\xff\xff\xff\xff", r#"{"a":18446744073709551615}"#),
            ("int8 a", b"\xf9\x3c\x00", r#"{"a":1}"#),
            ("float64[] a", b"\x83\xf6\xf9\x7c\x00\x01", r#"{"a":["NaN","Infinity",1.0]}"#),
            // Big endian, and of another type.
            ("float64[] a", b"\xd8\x41\x44\x01\x02\x00\x03", r#"{"a":[258.0,3.0]}"#),
            ("int16[] a", b"\xd8\x49\x42\xff\xfe", r#"{"a":[-2]}"#),
            ("byte[] a", b"\xd8\x48\x42\xff\x01", r#"{"a":"/wE="}"#),
            ("int8[] a", b"\x41\x07", r#"{"a":[7]}"#),
            // Of unknown length.
            ("string a", b"\x7f\x61h\x61i\xff", r#"{"a":"hi"}"#),
            ("uint8[] a", b"\x5f\x41\x01\x41\x02\xff", r#"{"a":"AQI="}"#),
            ("string[] a", b"\x9f\x61x\x60\xff", r#"{"a":["x",""]}"#),
            ("Two a", b"\xbf\x61b\x01\xff", r#"{"a":{"a":0,"b":1}}"#),
            ("string a", b"\x41\xff", r#"{"a":"\udcff"}"#),
            ("wstring a", b"\xd8\x45\x42\x00\xd8", r#"{"a":"\ud800"}"#),
        ] {
            assert_eq!(read(text, &with(item)).as_deref(), Ok(found), "{text}");
        }
        assert_eq!(read("Two a", b"\xd9\xd9\xf7\xa0").as_deref(), Ok(r#"{"a":{"a":0,"b":7}}"#));
    }

    #[test]
    fn mistakes_have_their_path() {
        for (text, item, error) in [
            ("int8 a", &b"\x18\x80"[..], "a: 128 is not within the range of int8"),
            ("int8 a", b"\xf5", "a: a bool, not int8"),
            ("int8 a", b"\xf6", "a: null, not int8"),
            ("int8 a", b"\xc2\x41\x01", "a: tag 2, not int8"),
            ("bool a", b"\x01", "a: 1, not bool"),
            ("string a", b"\x61\xff", "a: a text is not UTF-8"),
            ("wstring a", b"\x61\xff", "a: a text is not UTF-8"),
            ("string a", b"\x7f\x41x\xff", "a: bytes, not a piece of a text"),
            ("string a", b"\x7b\xff\xff\xff\xff\xff\xff\xff\xff", "a: it takes more than 67108864 bytes"),
            ("string a", b"\x7a\x02\x00\x00\x00", "a: the CBOR ends too early"),
            ("int16[] a", b"\xd8\x4d\x41\x00", "a: the last element of a typed array is not whole"),
            ("int8[] a", b"\xd8\x40\x42\x00\xff", "a[1]: 255 is not within the range of int8"),
            ("float32[] a", b"\xd8\x54\x42\x00\xff", "a: tag 84, not an array"),
            ("string[] a", b"\x41\x00", "a: bytes, not an array"),
            ("string[] a", b"\x9b\x00\x00\x00\x00\xff\xff\xff\xff", "a[0]: the CBOR ends too early"),
            ("string[] a", b"\x81\x1e", "a[0]: there is no CBOR at byte 4"),
            ("int8[2] a", b"\x9f\x01\x01\x01\xff", "a: 3 elements, not 2"),
            ("int8[<=1] a", b"\x42\x01\x01", "a: 2 elements, and at most 1 are allowed"),
            ("Two a", b"\xa1\x61x\x00", "a: there is no member \"x\""),
            ("Two a", b"\xa2\x61a\x00\x61a\x00", "a: \"a\" is there twice"),
            ("Two a", b"\xa1\x00\x00", "a: an integer, not the name of a member"),
            ("Two a", b"\xa1\x61b\x20", "a.b: -1 is not within the range of uint16"),
            ("Two a", b"\x80", "a: an array, not a map of members"),
            ("int8 a", b"\x00\x00", "1 bytes are left over"),
        ] {
            assert_eq!(read(text, &with(item)).unwrap_err(), error, "{text}");
        }
        assert_eq!(read("int8 a", b"").unwrap_err(), "the CBOR ends too early");
    }
}
