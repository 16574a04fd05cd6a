//! A type with everything that it contains as bytes, for nodes that have no definition of it (REP 2016).
//!
//! The form is the message `type_description_interfaces/msg/TypeDescription`, serialised as any other: the answer of
//! ROS 2 nodes to a request for a type description. Callers send it.

use std::collections::BTreeMap;
use std::sync::Arc;

use bytes::Bytes;

use crate::decode::DecodeError;
use crate::definition::{Base, Definition, Field, FieldType, Primitive, Shape, TypeName, is_identifier};
use crate::fault::ValueError;
use crate::hash::{ARRAY, BOUNDED_SEQUENCE, NESTED, SEQUENCE, ids};
use crate::layout::{Layout, Struct};
use crate::library::{Library, TypeError};
use crate::value::Value;

/// The type of a description.
const DESCRIPTION: &str = "type_description_interfaces/msg/TypeDescription";
/// Longest description, bytes.
pub const DESCRIPTION_BYTES_MAX: usize = 256 * 1024;

/// The reason why there is no description, or why one is not believed.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DescriptionError {
    /// The description is too long.
    #[error("the description has {bytes} bytes, more than {DESCRIPTION_BYTES_MAX}")]
    TooLong {
        /// Its bytes.
        bytes: usize,
    },
    /// The description cannot be decoded.
    #[error("the description cannot be read: {0}")]
    Decode(#[from] DecodeError),
    /// The description cannot be written.
    #[error("the description cannot be written: {0}")]
    Encode(#[from] ValueError),
    /// A member of the description has a value that ROS 2 does not know.
    #[error("the description has {found:?} as {what}")]
    Content {
        /// The meaning of the member.
        what: &'static str,
        /// The value.
        found: String,
    },
    /// The described type is invalid.
    #[error(transparent)]
    Type(#[from] TypeError),
    /// The description is of another type than that of the hash.
    #[error("the description is one of {found}, not of {expected}")]
    Hash {
        /// The hash of the description.
        found: String,
        /// The expected hash.
        expected: String,
    },
}

impl Layout {
    /// Describes the type with everything that it contains: defaults included, constants left out; at most
    /// [`DESCRIPTION_BYTES_MAX`] bytes.
    pub fn describe(&self) -> Result<Vec<u8>, DescriptionError> {
        let this = self.structs.last().map(individual);
        let inner = self.referenced().into_values().map(individual).collect();
        let value = record([
            ("type_description", this.unwrap_or(Value::Record(Vec::new()))),
            ("referenced_type_descriptions", Value::List(inner)),
        ]);
        let bytes = description()?.encode(&value)?;
        if bytes.len() > DESCRIPTION_BYTES_MAX {
            return Err(DescriptionError::TooLong { bytes: bytes.len() });
        }
        Ok(bytes)
    }

    /// Returns the type of a description. Its hash, `RIHS01_` and 64 hexadecimal digits, has to be the expected one; it
    /// does not cover defaults (REP 2016), so those are not taken over.
    pub fn from_description(bytes: &Bytes, expected_hash: &str) -> Result<Self, DescriptionError> {
        if bytes.len() > DESCRIPTION_BYTES_MAX {
            return Err(DescriptionError::TooLong { bytes: bytes.len() });
        }
        let value = description()?.decode(bytes)?;
        let this = member(&value, "type_description");
        let name = definition_name(this)?;
        let mut library = Library::empty();
        library.define(definition(this)?);
        for inner in list(member(&value, "referenced_type_descriptions")) {
            library.define(definition(inner)?);
        }
        let layout = library.layout(&name, &mut |_| None)?;
        let found = layout.type_hash();
        if found != expected_hash {
            let expected = expected_hash.chars().take(found.len()).collect();
            return Err(DescriptionError::Hash { found, expected });
        }
        Ok(layout)
    }
}

fn description() -> Result<Layout, DescriptionError> {
    let content = |_| DescriptionError::Content { what: "its own type", found: DESCRIPTION.to_owned() };
    Ok(Library::empty().layout(&DESCRIPTION.parse().map_err(content)?, &mut |_| None)?)
}

fn record<const N: usize>(members: [(&str, Value); N]) -> Value {
    Value::Record(members.into_iter().map(|(name, value)| (Arc::from(name), value)).collect())
}

fn individual(this: &Struct) -> Value {
    let field = |member: &crate::layout::Member| {
        let (id, capacity, string_capacity) = ids(&member.field_type);
        let nested = match &member.field_type.base {
            Base::Message(name) => name.to_string(),
            _ => String::new(),
        };
        let field_type = record([
            ("type_id", Value::Uint(u64::from(id))),
            ("capacity", Value::Uint(u64::from(capacity))),
            ("string_capacity", Value::Uint(u64::from(string_capacity))),
            ("nested_type_name", Value::Text(nested)),
        ]);
        let default = member.default.as_ref().map(|default| default.text.clone()).unwrap_or_default();
        record([
            ("name", Value::Text(member.name.to_string())),
            ("type", field_type),
            ("default_value", Value::Text(default)),
        ])
    };
    record([
        ("type_name", Value::Text(this.name.to_string())),
        ("fields", Value::List(this.members.iter().map(field).collect())),
    ])
}

/// Returns a member of a description, which has all of its members, because its layout decoded it.
fn member<'a>(value: &'a Value, name: &str) -> &'a Value {
    const NONE: &Value = &Value::Bool(false);
    let Value::Record(members) = value else { return NONE };
    members.iter().find(|(n, _)| &**n == name).map_or(NONE, |(_, value)| value)
}

fn list(value: &Value) -> &[Value] {
    if let Value::List(all) = value { all } else { &[] }
}

fn text(value: &Value) -> &str {
    if let Value::Text(text) = value { text } else { "" }
}

fn number(value: &Value) -> u64 {
    if let Value::Uint(number) = value { *number } else { 0 }
}

fn wrong(what: &'static str, found: &str) -> DescriptionError {
    DescriptionError::Content { what, found: crate::fault::short(found) }
}

fn type_name(text: &str) -> Result<TypeName, DescriptionError> {
    let name: TypeName = text.parse().map_err(|_| wrong("name of a type", text))?;
    // Tools accept `std_msgs/String`, but it is no name in a hash.
    if name.to_string() == text { Ok(name) } else { Err(wrong("name of a type", text)) }
}

fn definition_name(individual: &Value) -> Result<TypeName, DescriptionError> {
    type_name(text(member(individual, "type_name")))
}

fn definition(individual: &Value) -> Result<Definition, DescriptionError> {
    let mut fields: BTreeMap<&str, ()> = BTreeMap::new();
    let mut all = Vec::new();
    for field in list(member(individual, "fields")) {
        let name = text(member(field, "name"));
        if !is_identifier(name) || fields.insert(name, ()).is_some() {
            return Err(wrong("name of a member", name));
        }
        all.push(Field {
            name: name.to_owned(),
            field_type: field_type(member(field, "type"))?,
            // No hash covers it.
            default: None,
        });
    }
    if all.is_empty() {
        return Err(wrong("members of a type", "nothing"));
    }
    Ok(Definition { name: definition_name(individual)?, fields: all, constants: Vec::new() })
}

fn field_type(value: &Value) -> Result<FieldType, DescriptionError> {
    let id = number(member(value, "type_id"));
    let capacity = |name, what| {
        let found = number(member(value, name));
        u32::try_from(found).map_err(|_| wrong(what, &found.to_string()))
    };
    let count = capacity("capacity", "number of elements")?;
    let string_capacity = capacity("string_capacity", "length of texts")?;
    let no_id = || wrong("id of a type", &id.to_string());
    let id = u8::try_from(id).map_err(|_| no_id())?;
    let (id, shape) = match id {
        145.. => (id - SEQUENCE, Shape::Sequence { bound: None }),
        97.. if count > 0 => (id - BOUNDED_SEQUENCE, Shape::Sequence { bound: Some(count) }),
        49..97 if count > 0 => (id - ARRAY, Shape::Array(count)),
        49..145 => return Err(no_id()),
        _ => (id, Shape::One),
    };
    let base = match id {
        NESTED => Base::Message(type_name(text(member(value, "nested_type_name")))?),
        17 => Base::String { bound: None },
        18 => Base::WString { bound: None },
        21 if string_capacity > 0 => Base::String { bound: Some(string_capacity) },
        22 if string_capacity > 0 => Base::WString { bound: Some(string_capacity) },
        _ => Base::Primitive(Primitive::from_id(id).ok_or_else(no_id)?),
    };
    Ok(FieldType { base, shape })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parse::parse;

    fn layout(name: &str, text: &str) -> Layout {
        Library::empty().layout(&name.parse().unwrap(), &mut |_| Some(text.to_owned())).unwrap()
    }

    #[test]
    fn all_that_ships_is_described() {
        let (mut library, mut longest) = (Library::empty(), 0);
        for file in Library::shipped_files() {
            for shipped in parse(&file, &Library::shipped(&file).unwrap()).unwrap() {
                let layout = library.layout(&shipped.name, &mut |_| None).unwrap();
                let bytes = layout.describe().unwrap();
                longest = longest.max(bytes.len());
                let read = Layout::from_description(&bytes.into(), &layout.type_hash()).unwrap();
                assert_eq!(read.name(), layout.name());
                assert_eq!(read.type_hash(), layout.type_hash(), "{}", shipped.name);
            }
        }
        assert!((1_000..32 * 1024).contains(&longest), "{longest}");
    }

    #[test]
    fn nothing_is_believed_but_what_has_the_hash() {
        let text = "string<=3[<=2] a ['x']\nwstring<=4 b\nint8[7] c\nbool d\nbyte[] e";
        let ours = layout("p/msg/M", text);
        let bytes = Bytes::from(ours.describe().unwrap());
        let read = Layout::from_description(&bytes, &ours.type_hash()).unwrap();
        // No hash covers defaults.
        assert_eq!(read.from_json(b"{}").unwrap().at("a"), Some(Value::List(Vec::new())));
        let other = layout("p/msg/M", "int8[8] c").type_hash();
        let error = Layout::from_description(&bytes, &other).unwrap_err();
        assert_eq!(error, DescriptionError::Hash { found: ours.type_hash(), expected: other });
    }

    #[test]
    fn malformed_descriptions_are_reported() {
        let hash = layout("p/msg/M", "int8 a").type_hash();
        let of = |json: &str| {
            let bytes = description().unwrap().from_json(json.as_bytes()).unwrap();
            let bytes = description().unwrap().encode(&bytes).unwrap();
            Layout::from_description(&bytes.into(), &hash).map(|_| ()).unwrap_err().to_string()
        };
        let field = |name: &str, field_type: &str| {
            format!(
                r#"{{"type_description": {{"type_name": "p/msg/M", "fields": [{{"name": "{name}", "type": {{{field_type}}}}}]}}}}"#
            )
        };
        assert_eq!(of("{}"), r#"the description has "" as name of a type"#);
        let none = r#"{"type_description": {"type_name": "p/msg/M"}}"#;
        assert_eq!(of(none), r#"the description has "nothing" as members of a type"#);
        assert_eq!(of(&field("9", r#""type_id": 2"#)), r#"the description has "9" as name of a member"#);
        for id in [0, 12, 13, 19, 23, 49, 60, 97, 144, 145 + 12, 200, 255] {
            let error = of(&field("a", &format!(r#""type_id": {id}, "capacity": {}"#, id % 2)));
            let begin = "the description has \"";
            assert!(error.starts_with(begin) && (error.ends_with("type")), "{id}: {error}");
        }
        let large = r#""type_id": 50, "capacity": 4294967296"#;
        assert_eq!(of(&field("a", large)), r#"the description has "4294967296" as number of elements"#);
        let unknown = r#""type_id": 1, "nested_type_name": "p/msg/N""#;
        assert_eq!(of(&field("a", unknown)), "no definition of p/msg/N, which p/msg/M contains");
        let itself = r#""type_id": 1, "nested_type_name": "p/msg/M""#;
        assert_eq!(of(&field("a", itself)), "p/msg/M contains itself");
        let bytes = Bytes::from(vec![0; DESCRIPTION_BYTES_MAX + 1]);
        let error = Layout::from_description(&bytes, &hash).unwrap_err();
        assert_eq!(error, DescriptionError::TooLong { bytes: DESCRIPTION_BYTES_MAX + 1 });
        let error = Layout::from_description(&Bytes::from_static(b"\0\x01\0\0\xff"), &hash).unwrap_err();
        assert!(matches!(error, DescriptionError::Decode(_)), "{error}");
    }
}
