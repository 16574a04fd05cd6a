//! JSON to values, straight by the layout: octets become bytes and numbers elements of their type, with nothing in
//! between.
//!
//! docs/spec/json.md defines the accepted JSON. The depth is that of the layout, because unknown members are errors.

use std::cell::{Cell, RefCell};
use std::fmt;

use base64::Engine as _;
use base64::alphabet::STANDARD;
use base64::engine::{DecodePaddingMode, GeneralPurpose, GeneralPurposeConfig};
use bytes::Bytes;
use serde::de::{Deserialize as _, DeserializeSeed, Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde_json::value::RawValue;

use crate::definition::{Primitive, Shape};
use crate::fault::{Budget, ValueError, ValueProblem, fits, fits_bound, fits_one_more, short};
use crate::json::ESCAPED_BYTE;
use crate::layout::{Element, Layout, Member, Struct};
use crate::number::{Number, little};
use crate::path;
use crate::value::{PackedArray, Value};

/// Base64 with or without padding.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(DecodePaddingMode::Indifferent),
);
/// Most elements for which memory is reserved before they are read.
const RESERVE_MAX: usize = 1024;

impl Layout {
    /// Reads a message of the type from JSON in UTF-8. Missing members take their default.
    pub fn from_json(&self, json: &[u8]) -> Result<Value, ValueError> {
        let no_text = |why: std::str::Utf8Error| {
            ValueProblem::Syntax(format!("the JSON is not UTF-8 at byte {}", why.valid_up_to()))
        };
        let json = std::str::from_utf8(json).map_err(no_text)?;
        let reader = Reader::new(self);
        let mut deserializer = serde_json::Deserializer::from_str(json);
        let read = match self.structs.len().checked_sub(1) {
            Some(place) => Record { reader: &reader, place }.deserialize(&mut deserializer),
            None => Ok(Value::Record(Vec::new())),
        };
        let read = read.and_then(|value| deserializer.end().map(|()| value));
        read.map_err(|error| {
            let problem = reader.problem.take();
            let problem = problem.unwrap_or_else(|| ValueProblem::Syntax(error.to_string()));
            ValueError { path: reader.path.take(), problem }
        })
    }
}

/// State that all parts of a message share. `serde_json` carries only its own errors: ours are kept here meanwhile.
struct Reader<'a> {
    layout: &'a Layout,
    budget: RefCell<Budget>,
    path: RefCell<String>,
    problem: Cell<Option<ValueProblem>>,
}

impl<'a> Reader<'a> {
    fn new(layout: &'a Layout) -> Self {
        Self { layout, budget: RefCell::default(), path: RefCell::default(), problem: Cell::default() }
    }

    fn fail<E: Error>(&self, problem: ValueProblem) -> E {
        self.problem.set(Some(problem));
        E::custom("")
    }

    fn check<T, E: Error>(&self, result: Result<T, ValueProblem>) -> Result<T, E> {
        result.map_err(|problem| self.fail(problem))
    }

    fn value<E: Error>(&self) -> Result<(), E> {
        self.check(self.budget.borrow_mut().value())
    }

    fn bytes<E: Error>(&self, bytes: usize) -> Result<(), E> {
        self.check(self.budget.borrow_mut().bytes(bytes))
    }

    fn under<T, E>(&self, member: &str, result: Result<T, E>) -> Result<T, E> {
        result.inspect_err(|_| path::under(&mut self.path.borrow_mut(), member))
    }

    fn at<T, E>(&self, index: usize, result: Result<T, E>) -> Result<T, E> {
        result.inspect_err(|_| path::at(&mut self.path.borrow_mut(), index))
    }
}

/// A message.
#[derive(Clone, Copy)]
struct Record<'r, 'a> {
    reader: &'r Reader<'a>,
    place: usize,
}

impl<'de> DeserializeSeed<'de> for Record<'_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        self.reader.value()?;
        deserializer.deserialize_map(self)
    }
}

impl<'de> Visitor<'de> for Record<'_, '_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.reader.layout.structs.get(self.place) {
            Some(this) => write!(f, "an object with members of {}", this.name),
            None => f.write_str("an object"),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Value, A::Error> {
        let Self { reader, place } = self;
        let Some(this) = reader.layout.structs.get(place) else { return Ok(Value::Record(Vec::new())) };
        let mut given: Vec<Option<Value>> = Vec::new();
        given.resize_with(this.members.len(), || None);
        let mut next = 0;
        while let Some(index) = map.next_key_seed(Key { reader, this, next })? {
            let (Some(member), Some(given)) = (this.members.get(index), given.get_mut(index)) else { break };
            if given.is_some() {
                return Err(reader.fail(ValueProblem::Twice(member.name.to_string())));
            }
            let value = map.next_value_seed(MemberSeed { reader, member });
            *given = Some(reader.under(&member.name, value)?);
            next = index + 1;
        }
        let mut members = Vec::with_capacity(given.len());
        for (member, value) in this.members.iter().zip(given) {
            let value = match value {
                Some(value) => value,
                None => {
                    let default = reader.layout.default_of(member, &mut reader.budget.borrow_mut());
                    default.map_err(|error| {
                        let ValueError { path, problem } = error.under(&member.name);
                        *reader.path.borrow_mut() = path;
                        reader.fail(problem)
                    })?
                }
            };
            members.push((member.name.clone(), value));
        }
        Ok(Value::Record(members))
    }
}

/// Reads the name of a member into its index.
struct Key<'r, 'a> {
    reader: &'r Reader<'a>,
    this: &'a Struct,
    /// The next member, if they come in order.
    next: usize,
}

impl<'de> DeserializeSeed<'de> for Key<'_, '_> {
    type Value = usize;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<usize, D::Error> {
        deserializer.deserialize_str(self)
    }
}

impl Visitor<'_> for Key<'_, '_> {
    type Value = usize;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the name of a member")
    }

    fn visit_str<E: Error>(self, name: &str) -> Result<usize, E> {
        let is = |member: &Member| &*member.name == name;
        if self.this.members.get(self.next).is_some_and(is) {
            return Ok(self.next);
        }
        let place = self.this.members.iter().position(is);
        place.ok_or_else(|| self.reader.fail(ValueProblem::Unknown(short(name))))
    }
}

/// A member: one element, or all of them.
#[derive(Clone, Copy)]
struct MemberSeed<'r, 'a> {
    reader: &'r Reader<'a>,
    member: &'a Member,
}

impl<'de> DeserializeSeed<'de> for MemberSeed<'_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        let Self { reader, member } = self;
        if member.shape == Shape::One {
            return ElementSeed { reader, member }.deserialize(deserializer);
        }
        reader.value()?;
        match member.element {
            Element::Primitive(Primitive::Byte | Primitive::Uint8) => deserializer.deserialize_any(self),
            _ => deserializer.deserialize_seq(self),
        }
    }
}

impl<'de> Visitor<'de> for MemberSeed<'_, '_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self.member.element {
            Element::Primitive(Primitive::Byte | Primitive::Uint8) => {
                "octets in base64, or an array of numbers"
            }
            _ => "an array",
        })
    }

    fn visit_str<E: Error>(self, text: &str) -> Result<Value, E> {
        let Self { reader, member } = self;
        reader.bytes(text.len() / 4 * 3)?;
        let octets = BASE64.decode(text).map_err(|_| reader.fail(ValueProblem::Base64))?;
        reader.check(fits(member.shape, octets.len()))?;
        Ok(Value::Octets(octets.into()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut all: A) -> Result<Value, A::Error> {
        let Self { reader, member } = self;
        let element = ElementSeed { reader, member };
        let mut count = 0;
        if let Element::Primitive(primitive) = member.element {
            let size = primitive.bytes();
            let mut octets = Vec::new();
            while let Some(value) =
                reader.at(count, all.next_element_seed(PrimitiveSeed { reader, primitive }))?
            {
                reader.check(fits_one_more(member.shape, count))?;
                reader.bytes(size)?;
                octets.extend(little(&value).into_iter().take(size));
                count += 1;
            }
            reader.check(fits(member.shape, count))?;
            let octets = Bytes::from(octets);
            return Ok(
                PackedArray::new(primitive, octets.clone()).map_or(Value::Octets(octets), Value::PackedArray)
            );
        }
        let mut values = Vec::with_capacity(all.size_hint().unwrap_or(0).min(RESERVE_MAX));
        while let Some(value) = reader.at(count, all.next_element_seed(element))? {
            reader.check(fits_one_more(member.shape, count))?;
            values.push(value);
            count += 1;
        }
        reader.check(fits(member.shape, count))?;
        Ok(Value::List(values))
    }
}

/// One element.
#[derive(Clone, Copy)]
struct ElementSeed<'r, 'a> {
    reader: &'r Reader<'a>,
    member: &'a Member,
}

impl<'de> DeserializeSeed<'de> for ElementSeed<'_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        let Self { reader, member } = self;
        match member.element {
            Element::Struct(place) => Record { reader, place }.deserialize(deserializer),
            Element::Primitive(primitive) => {
                reader.value()?;
                PrimitiveSeed { reader, primitive }.deserialize(deserializer)
            }
            Element::String { bound } => Text { reader, bound, wide: false }.deserialize(deserializer),
            Element::WString { bound } => Text { reader, bound, wide: true }.deserialize(deserializer),
        }
    }
}

/// A primitive, as a value that fits it.
#[derive(Clone, Copy)]
struct PrimitiveSeed<'r, 'a> {
    reader: &'r Reader<'a>,
    primitive: Primitive,
}

impl PrimitiveSeed<'_, '_> {
    fn number<E: Error>(self, number: Number) -> Result<Value, E> {
        self.reader.check(number.fit(self.primitive))
    }
}

impl<'de> DeserializeSeed<'de> for PrimitiveSeed<'_, '_> {
    type Value = Value;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        if !matches!(self.primitive, Primitive::Float32 | Primitive::Float64) {
            return deserializer.deserialize_any(self);
        }
        // From its digits: by way of a `float64`, a `float32` could be rounded twice.
        let text = <&RawValue>::deserialize(deserializer)?.get();
        self.reader.check(float(text, self.primitive))
    }
}

impl Visitor<'_> for PrimitiveSeed<'_, '_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.primitive.name())
    }

    fn visit_bool<E: Error>(self, value: bool) -> Result<Value, E> {
        match self.primitive {
            Primitive::Bool => Ok(Value::Bool(value)),
            primitive => {
                let problem = ValueProblem::Kind { found: value.to_string(), expected: primitive.name() };
                Err(self.reader.fail(problem))
            }
        }
    }

    fn visit_i64<E: Error>(self, value: i64) -> Result<Value, E> {
        self.number(Number::Integer(i128::from(value)))
    }

    fn visit_u64<E: Error>(self, value: u64) -> Result<Value, E> {
        self.number(Number::Integer(i128::from(value)))
    }

    fn visit_f64<E: Error>(self, value: f64) -> Result<Value, E> {
        self.number(Number::Float64(value))
    }

    /// Programs whose numbers are all floats write large integers as text.
    fn visit_str<E: Error>(self, text: &str) -> Result<Value, E> {
        match text.parse() {
            Ok(value) => self.number(Number::Integer(value)),
            Err(_) => {
                let found = format!("{:?}", short(text));
                Err(self.reader.fail(ValueProblem::Kind { found, expected: self.primitive.name() }))
            }
        }
    }
}

/// Parses a float, or the JSON that stands for one.
fn float(text: &str, primitive: Primitive) -> Result<Value, ValueProblem> {
    let of = |value: f64| Number::Float64(value).fit(primitive);
    let wrong = || ValueProblem::Kind { found: short(text), expected: primitive.name() };
    match text {
        // `rosbridge_suite` writes null for values that are no numbers.
        "null" | "\"NaN\"" => of(f64::NAN),
        "\"Infinity\"" => of(f64::INFINITY),
        "\"-Infinity\"" => of(f64::NEG_INFINITY),
        _ if !text.starts_with(|c: char| c == '-' || c.is_ascii_digit()) => Err(wrong()),
        _ => {
            let (value, finite) = match primitive {
                Primitive::Float32 => {
                    let value: f32 = text.parse().map_err(|_| wrong())?;
                    (Value::Float32(value), value.is_finite())
                }
                _ => {
                    let value: f64 = text.parse().map_err(|_| wrong())?;
                    (Value::Float64(value), value.is_finite())
                }
            };
            let range = || ValueProblem::Range { found: short(text), expected: primitive.name() };
            if finite { Ok(value) } else { Err(range()) }
        }
    }
}

/// A `string` or a `wstring`.
#[derive(Clone, Copy)]
struct Text<'r, 'a> {
    reader: &'r Reader<'a>,
    bound: Option<u32>,
    wide: bool,
}

impl<'de> DeserializeSeed<'de> for Text<'_, '_> {
    type Value = Value;

    /// Reads bytes, where half of a surrogate pair is no error.
    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Value, D::Error> {
        self.reader.value()?;
        deserializer.deserialize_bytes(self)
    }
}

impl Visitor<'_> for Text<'_, '_> {
    type Value = Value;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.wide { "wstring" } else { "string" })
    }

    fn visit_bytes<E: Error>(self, text: &[u8]) -> Result<Value, E> {
        let Self { reader, bound, wide } = self;
        reader.bytes(text.len())?;
        if let Ok(text) = std::str::from_utf8(text) {
            let count = if wide { text.encode_utf16().count() } else { text.len() };
            reader.check(fits_bound(bound, count))?;
            return Ok(Value::Text(text.to_owned()));
        }
        let units = units(text);
        if wide {
            reader.check(fits_bound(bound, units.len()))?;
            return Ok(Value::from_units(units));
        }
        let mut bytes = Vec::with_capacity(text.len());
        for c in char::decode_utf16(units) {
            match c.map_err(|half| half.unpaired_surrogate()) {
                Ok(c) => bytes.extend_from_slice(c.encode_utf8(&mut [0; 4]).as_bytes()),
                Err(half) => {
                    let byte = half.checked_sub(ESCAPED_BYTE).and_then(|byte| u8::try_from(byte).ok());
                    let byte = byte.filter(|byte| *byte >= 0x80);
                    bytes.push(byte.ok_or_else(|| reader.fail(ValueProblem::Surrogate))?);
                }
            }
        }
        reader.check(fits_bound(bound, bytes.len()))?;
        Ok(Value::from_bytes(bytes.into()))
    }
}

/// Returns the UTF-16 units of a text with half surrogate pairs in UTF-8 form.
fn units(text: &[u8]) -> Vec<u16> {
    let mut units = Vec::with_capacity(text.len());
    for chunk in text.chunk_by(|_, next| next & 0xc0 == 0x80) {
        match (std::str::from_utf8(chunk), chunk) {
            (Ok(text), _) => units.extend(text.encode_utf16()),
            (Err(_), [0xed, second, third]) => {
                units.push(0xd000 | u16::from(second & 0x3f) << 6 | u16::from(third & 0x3f));
            }
            // `serde_json` accepted everything else as text.
            (Err(_), _) => {}
        }
    }
    units
}

#[cfg(test)]
mod tests {
    use crate::testing::layout;

    fn read(text: &str, json: &str) -> Result<String, String> {
        let layout = layout(text);
        let value = layout.from_json(json.as_bytes()).map_err(|error| error.to_string())?;
        // Every value that was read fits the type.
        layout.encode(&value).unwrap();
        Ok(value.to_json())
    }

    #[test]
    fn json_of_clients_is_understood() {
        for (text, json, found) in [
            ("int64 a", r#"{"a": -9223372036854775808}"#, r#"{"a":-9223372036854775808}"#),
            ("uint64 a", r#"{"a": "18446744073709551615"}"#, r#"{"a":18446744073709551615}"#),
            ("int32 a", r#"{"a": 2.0}"#, r#"{"a":2}"#),
            ("float32 a", r#"{"a": 0.1}"#, r#"{"a":0.1}"#),
            ("float64 a", r#"{"a": 1}"#, r#"{"a":1.0}"#),
            (
                "float64[] a",
                r#"{"a": [null, "NaN", "Infinity", "-Infinity", -0.0, 5e-324]}"#,
                r#"{"a":["NaN","NaN","Infinity","-Infinity",-0.0,5e-324]}"#,
            ),
            ("uint8[] a", r#"{"a": "AQI="}"#, r#"{"a":"AQI="}"#),
            ("uint8[] a", r#"{"a": "AQI"}"#, r#"{"a":"AQI="}"#),
            ("byte[2] a", r#"{"a": [1, 2]}"#, r#"{"a":"AQI="}"#),
            ("char[] a", r#"{"a": []}"#, r#"{"a":""}"#),
            ("bool[] a", r#"{"a": [true, false]}"#, r#"{"a":[true,false]}"#),
            ("string a", r#"{"a": "\ud83d\ude00 \u0000 \udcff"}"#, "{\"a\":\"\u{1f600} \\u0000 \\udcff\"}"),
            ("wstring a", r#"{"a": "\ud800x\udc00"}"#, r#"{"a":"\ud800x\udc00"}"#),
            ("Two[] a", r#"{"a": [{"b": 1, "a": 2}, {}]}"#, r#"{"a":[{"a":2,"b":1},{"a":0,"b":7}]}"#),
            ("Empty a", r#"{"a": {}}"#, r#"{"a":{}}"#),
            ("Empty a", r#"{"a": {"structure_needs_at_least_one_member": 0}}"#, r#"{"a":{}}"#),
        ] {
            assert_eq!(read(text, json).as_deref(), Ok(found), "{text} {json}");
        }
    }

    #[test]
    fn mistakes_have_their_path() {
        for (text, json, error) in [
            ("int8 a", r#"{"a": 128}"#, "a: 128 is not within the range of int8"),
            ("int8 a", r#"{"a": 1.5}"#, "a: 1.5, not int8"),
            ("int8 a", r#"{"a": true}"#, "a: true, not int8"),
            ("int8 a", r#"{"a": "x"}"#, "a: \"x\", not int8"),
            (
                "int64 a",
                r#"{"a": -9223372036854775809}"#,
                "a: -9223372036854776000 is not within the range of int64",
            ),
            ("bool a", r#"{"a": 1}"#, "a: 1, not bool"),
            ("float32 a", r#"{"a": 1e39}"#, "a: 1e39 is not within the range of float32"),
            ("float64 a", r#"{"a": "1"}"#, "a: \"1\", not float64"),
            ("float64[] a", r#"{"a": [0, [1]]}"#, "a[1]: [1], not float64"),
            ("uint8[] a", r#"{"a": "?"}"#, "a: the text is not base64"),
            ("uint8[4] a", r#"{"a": "AQI="}"#, "a: 2 elements, not 4"),
            ("uint8[<=1] a", r#"{"a": "AQI="}"#, "a: 2 elements, and at most 1 are allowed"),
            ("uint8[] a", r#"{"a": [256]}"#, "a[0]: 256 is not within the range of uint8"),
            ("int16[2] a", r#"{"a": [1, 2, 3]}"#, "a: 3 elements, not 2"),
            ("string<=1[] a", r#"{"a": ["", "xy"]}"#, "a[1]: 2 elements, and at most 1 are allowed"),
            ("string a", r#"{"a": "\ud800"}"#, "a: the text has half of a surrogate pair in it"),
            ("Two[] a", r#"{"a": [{}, {"c": 1}]}"#, "a[1]: there is no member \"c\""),
            ("Two a", r#"{"a": {"a": 1, "a": 2}}"#, "a: \"a\" is there twice"),
            ("Two a", r#"{"a": {"a": 300}}"#, "a.a: 300 is not within the range of uint8"),
            ("int8 a 300", "{}", "a: it is left out, and its default cannot be read"),
        ] {
            assert_eq!(read(text, json).unwrap_err(), error, "{text} {json}");
        }
        for (text, json, begin) in [
            (
                "Two a",
                r#"{"a": 5}"#,
                "a: invalid type: integer `5`, expected an object with members of p/msg/Two",
            ),
            ("string a", r#"{"a": 5}"#, "a: invalid type: integer `5`, expected string"),
            ("int8[] a", r#"{"a": 5}"#, "a: invalid type: integer `5`, expected an array"),
            ("int8 a", "", "EOF while parsing"),
            ("int8 a", "{} x", "trailing characters"),
            ("int8 a", "[1]", "invalid type: sequence"),
            ("float64 a", r#"{"a": 1.}"#, "a: invalid number"),
        ] {
            let error = read(text, json).unwrap_err();
            assert!(error.starts_with(begin), "{text} {json}: {error}");
        }
        let error = layout("string a").from_json(b"{\"a\": \"\xff\"}").unwrap_err();
        assert_eq!(error.to_string(), "the JSON is not UTF-8 at byte 7");
    }
}
