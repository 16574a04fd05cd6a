//! Random types with random values: every conversion of a message gives the same message back.
#![allow(clippy::unwrap_used)]

use std::fmt::Write as _;
use std::sync::Arc;

use bytes::Bytes;
use rand_chacha::ChaCha20Rng;
use rand_core::{RngCore as _, SeedableRng as _};
use sgc_cdr::{
    Base, ByteOrder, CdrVersion, DUMMY_MEMBER, Encoding, Layout, Library, PackedArray, Padding, Primitive,
    Shape, TypeName, VALUES_MAX, Value, ValueProblem,
};

const PRIMITIVES: [Primitive; 12] = [
    Primitive::Bool,
    Primitive::Byte,
    Primitive::Float32,
    Primitive::Float64,
    Primitive::Int8,
    Primitive::Int16,
    Primitive::Int32,
    Primitive::Int64,
    Primitive::Uint8,
    Primitive::Uint16,
    Primitive::Uint32,
    Primitive::Uint64,
];

struct Random(ChaCha20Rng);

impl Random {
    fn below(&mut self, bound: u32) -> u32 {
        self.0.next_u32() % bound
    }

    fn pick<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u32) as usize]
    }

    /// The text of a definition whose messages are those of higher numbers.
    fn definition(&mut self, number: u32, last: u32) -> String {
        let mut text = String::new();
        for member in 0..self.below(5) {
            let bound = if self.below(4) == 0 { format!("<={}", 1 + self.below(20)) } else { String::new() };
            let base = match self.below(6) {
                0 => format!("string{bound}"),
                1 => format!("wstring{bound}"),
                2 if number < last => format!("T{}", number + 1 + self.below(last - number)),
                _ => self.pick(&PRIMITIVES).name().to_owned(),
            };
            let shape = match self.below(6) {
                0 => "[]".to_owned(),
                1 => format!("[<={}]", 1 + self.below(5)),
                2 => format!("[{}]", 1 + self.below(4)),
                _ => String::new(),
            };
            let _ = writeln!(text, "{base}{shape} m{member}");
        }
        text
    }

    fn message(&mut self, library: &Library, name: &TypeName) -> Value {
        let definition = library.definition(name).unwrap();
        let members = definition.fields.iter().map(|field| {
            let value = if field.name == DUMMY_MEMBER {
                Value::Uint(0)
            } else {
                self.member(library, &field.field_type.base, field.field_type.shape)
            };
            (Arc::from(field.name.as_str()), value)
        });
        Value::Record(members.collect())
    }

    fn member(&mut self, library: &Library, base: &Base, shape: Shape) -> Value {
        let count = match shape {
            Shape::One => return self.element(library, base),
            Shape::Array(count) => count,
            Shape::Sequence { bound } => self.below(4).min(bound.unwrap_or(4)),
        };
        let Base::Primitive(primitive) = base else {
            return Value::List((0..count).map(|_| self.element(library, base)).collect());
        };
        let bytes: Bytes = (0..count).flat_map(|_| self.bits(*primitive)).collect();
        PackedArray::new(*primitive, bytes.clone()).map_or(Value::Octets(bytes), Value::PackedArray)
    }

    /// The bytes of a primitive. There is one NaN: formats of text have no more.
    fn bits(&mut self, primitive: Primitive) -> Vec<u8> {
        let bits = match self.below(4) {
            0 => 0,
            1 => u64::MAX,
            2 => 1 << 63 | 1 << 31 | 1 << 15 | 1 << 7,
            _ => self.0.next_u64(),
        };
        match primitive {
            Primitive::Bool => vec![(bits & 1) as u8],
            Primitive::Float32 => {
                let value = f32::from_bits(bits as u32);
                if value.is_nan() { f32::NAN } else { value }.to_le_bytes().to_vec()
            }
            Primitive::Float64 => {
                let value = f64::from_bits(bits);
                if value.is_nan() { f64::NAN } else { value }.to_le_bytes().to_vec()
            }
            _ => bits.to_le_bytes()[..primitive.bytes()].to_vec(),
        }
    }

    fn element(&mut self, library: &Library, base: &Base) -> Value {
        match base {
            Base::Message(name) => self.message(library, name),
            Base::Primitive(primitive) => {
                let bytes = Bytes::from(self.bits(*primitive));
                match PackedArray::new(*primitive, bytes.clone()) {
                    Some(one) => one.at(0).unwrap(),
                    None => Value::Uint(u64::from(bytes[0])),
                }
            }
            Base::String { bound } => {
                let bytes: Bytes = (0..self.below(bound.unwrap_or(12).min(12) + 1))
                    .map(|_| {
                        self.pick(&[b'a', b'"', b'\\', b'\n', 0, 1, 0x7f, 0x80, 0xc3, 0xbc, 0xed, 0xa0, 0xff])
                    })
                    .collect();
                match std::str::from_utf8(&bytes) {
                    Ok(text) => Value::Text(text.to_owned()),
                    Err(_) => Value::Raw(bytes),
                }
            }
            Base::WString { bound } => {
                let mut units: Vec<u16> = (0..self.below(bound.unwrap_or(8).min(8) + 1))
                    .map(|_| self.pick(&[0x61, 0, 0xfc, 0xd83d, 0xde00, 0xdc80, 0xffff]))
                    .collect();
                // A NUL at the end would be taken for the terminator.
                while units.last() == Some(&0) {
                    units.pop();
                }
                match String::from_utf16(&units) {
                    Ok(text) => Value::Text(text),
                    Err(_) => Value::Wide(units),
                }
            }
        }
    }
}

/// Equal in every bit, unlike `==` of floats.
fn same(a: &Value, b: &Value) -> bool {
    match (a, b) {
        (Value::Float32(a), Value::Float32(b)) => a.to_bits() == b.to_bits(),
        (Value::Float64(a), Value::Float64(b)) => a.to_bits() == b.to_bits(),
        (Value::List(a), Value::List(b)) => a.len() == b.len() && a.iter().zip(b).all(|(a, b)| same(a, b)),
        (Value::Record(a), Value::Record(b)) => {
            a.len() == b.len() && a.iter().zip(b).all(|(a, b)| a.0 == b.0 && same(&a.1, &b.1))
        }
        _ => a == b,
    }
}

fn check(layout: &Layout, value: &Value, why: &str) {
    let encodings = [ByteOrder::Little, ByteOrder::Big].into_iter().flat_map(|order| {
        let versions = [CdrVersion::One, CdrVersion::Two, CdrVersion::TwoDelimited];
        versions.map(|version| Encoding { order, version, ..Encoding::default() })
    });
    for encoding in encodings {
        let payload = Bytes::from(layout.encode_as(value, encoding).unwrap());
        let (read, found) =
            layout.decode_as(&payload).unwrap_or_else(|error| panic!("{why} {encoding:?}: {error}"));
        assert!(same(&read, value), "{why} {encoding:?}: {read:?} is not {value:?}");
        assert_eq!(found, encoding, "{why}");
        for padding in [Padding::Silent, Padding::Said] {
            let padded = Bytes::from(layout.encode_as(value, Encoding { padding, ..encoding }).unwrap());
            assert_eq!(padded.len(), payload.len().next_multiple_of(4));
            let (read, found) = layout.decode_as(&padded).unwrap();
            assert_eq!(layout.encode_as(&read, found).unwrap(), padded, "{why} {padding:?}");
        }
        // A truncated message never equals the whole.
        for end in 0..payload.len() {
            let _ = layout.decode(&payload.slice(..end));
        }
    }
    let json = value.to_json();
    let read = layout.from_json(json.as_bytes()).unwrap_or_else(|error| panic!("{why}: {error}: {json}"));
    assert!(same(&read, value), "{why}: {read:?} is not {value:?}: {json}");
    let cbor = Bytes::from(value.to_cbor());
    let read = layout.from_cbor(&cbor).unwrap_or_else(|error| panic!("{why}: {error}: {cbor:02x?}"));
    assert!(same(&read, value), "{why}: {read:?} is not {value:?}: {cbor:02x?}");
}

#[test]
fn random_types_and_values_are_the_same_again() {
    let seeds: u64 = 400;
    for seed in 0..seeds {
        let mut random = Random(ChaCha20Rng::seed_from_u64(seed));
        let texts: Vec<String> = (0..4).map(|number| random.definition(number, 3)).collect();
        let mut library = Library::empty();
        for (number, text) in texts.iter().enumerate() {
            library.add(&format!("p/msg/T{number}").parse().unwrap(), text).unwrap();
        }
        let name = "p/msg/T0".parse().unwrap();
        let layout = library.layout(&name, &mut |_| None).unwrap();
        for _ in 0..3 {
            let value = random.message(&library, &name);
            check(&layout, &value, &format!("seed {seed}, {texts:?}"));
        }
        let description = layout.describe().unwrap().into();
        let described = Layout::from_description(&description, &layout.type_hash()).unwrap();
        assert_eq!(described.describe().unwrap(), description, "seed {seed}");
    }
}

#[test]
fn every_type_that_ships_is_the_same_again() {
    let mut random = Random(ChaCha20Rng::seed_from_u64(7));
    for file in Library::shipped_files() {
        let mut library = Library::empty();
        for shipped in sgc_cdr::parse(&file, &Library::shipped(&file).unwrap()).unwrap() {
            let layout = library.layout(&shipped.name, &mut |_| None).unwrap();
            let value = random.message(&library, &shipped.name);
            check(&layout, &value, &shipped.name.to_string());
        }
    }
}

fn shipped(name: &str) -> Layout {
    Library::empty().layout(&name.parse().unwrap(), &mut |_| None).unwrap()
}

#[test]
fn large_messages_take_no_more_than_their_bytes() {
    let image = shipped("sensor_msgs/msg/Image");
    let data: Bytes = (0..13_000_000_u32).map(|n| ((n * 31) >> 3) as u8).collect();
    let mut value = image.from_json(b"{}").unwrap();
    let Value::Record(members) = &mut value else { panic!("a message") };
    members.last_mut().unwrap().1 = Value::Octets(data.clone());
    let payload = Bytes::from(image.encode(&value).unwrap());
    let Some(Value::Octets(found)) = image.decode(&payload).unwrap().at("data") else { panic!("octets") };
    assert_eq!(found, data);
    // The value shares the payload's memory.
    assert!(payload.as_ptr_range().contains(&found.as_ptr()));
    let cbor = Bytes::from(value.to_cbor());
    assert_eq!(image.from_cbor(&cbor).unwrap(), value);
    assert_eq!(image.from_json(value.to_json().as_bytes()).unwrap(), value);
}

#[test]
fn a_false_size_takes_no_memory() {
    let array = shipped("std_msgs/msg/Float64MultiArray");
    let strings = shipped("rcl_interfaces/msg/ListParametersResult");
    // A gigabyte is claimed, in CDR and CBOR.
    for layout in [&array, &strings] {
        for claim in [0x4000_0000_u32, u32::MAX] {
            let mut payload = b"\0\x01\0\0".to_vec();
            for _ in 0..8 {
                payload.extend(claim.to_le_bytes());
            }
            assert!(layout.decode(&payload.into()).is_err());
            for major in [0x5a, 0x7a, 0x9a, 0xba] {
                let head = [[major].as_slice(), &claim.to_be_bytes()].concat();
                for before in [&b""[..], b"\xa1\x64data", b"\xa1\x65names", b"\xa1\x64data\xd8\x56", b"\xa1"]
                {
                    assert!(layout.from_cbor(&[before, &head].concat().into()).is_err());
                }
            }
        }
    }
    let problem = |json: String| array.from_json(json.as_bytes()).unwrap_err().problem;
    assert!(matches!(problem("[".repeat(1 << 20)), ValueProblem::Syntax(_)));
    assert!(matches!(problem(format!("{{\"data\":{}", "[".repeat(1 << 20))), ValueProblem::Syntax(_)));
    assert!(matches!(problem("{\"layout\":".repeat(1 << 18)), ValueProblem::Unknown(_)));
    // A few bytes with missing members become many values.
    let objects = format!("{{\"layout\":{{\"dim\":[{}{{}}]}}}}", "{},".repeat(VALUES_MAX / 3));
    assert!(matches!(problem(objects), ValueProblem::TooManyValues | ValueProblem::TooLarge));
    // Deep CBOR ends where the type does.
    assert!(array.from_cbor(&vec![0x81; 1 << 20].into()).is_err());
    assert!(array.from_cbor(&[&b"\xa1\x64data"[..], &[0x81; 1 << 20]].concat().into()).is_err());
    assert!(array.from_cbor(&[&b"\xa1\x64data"[..], &[0xd8; 1 << 20]].concat().into()).is_err());
}

#[test]
fn random_bytes_are_no_trouble() {
    let mut random = Random(ChaCha20Rng::seed_from_u64(3));
    let layout = shipped("visualization_msgs/msg/Marker");
    let valid = layout.from_json(b"{}").unwrap();
    let (json, cbor) = (valid.to_json().into_bytes(), valid.to_cbor());
    let cdr = layout.encode(&valid).unwrap();
    for _ in 0..20_000 {
        let mut changed = |bytes: &[u8]| {
            let mut bytes = bytes.to_vec();
            for _ in 0..1 + random.below(3) {
                let at = random.below(bytes.len() as u32) as usize;
                bytes[at] = random.0.next_u32() as u8;
            }
            bytes
        };
        let values = [
            layout.from_json(&changed(&json)).ok(),
            layout.from_cbor(&changed(&cbor).into()).ok(),
            layout.decode(&changed(&cdr).into()).ok(),
        ];
        for value in values.into_iter().flatten() {
            // Every value that was read can be written, and read again.
            let payload = layout.encode(&value).unwrap();
            assert!(layout.decode(&payload.into()).is_ok());
        }
    }
}
