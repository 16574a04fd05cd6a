//! The hash of a type (REP 2016), which tells apart two definitions of one name.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use aws_lc_rs::digest::{SHA256, digest};

use crate::definition::{Base, FieldType, Primitive, Shape};
use crate::layout::{Element, Layout, Struct};

/// Ids of `type_description_interfaces/msg/FieldType`.
pub(crate) const NESTED: u8 = 1;
pub(crate) const ARRAY: u8 = 48;
pub(crate) const BOUNDED_SEQUENCE: u8 = 96;
pub(crate) const SEQUENCE: u8 = 144;
const PRIMITIVES: [(u8, Primitive); 12] = [
    (2, Primitive::Int8),
    (3, Primitive::Uint8),
    (4, Primitive::Int16),
    (5, Primitive::Uint16),
    (6, Primitive::Int32),
    (7, Primitive::Uint32),
    (8, Primitive::Int64),
    (9, Primitive::Uint64),
    (10, Primitive::Float32),
    (11, Primitive::Float64),
    (15, Primitive::Bool),
    (16, Primitive::Byte),
];

impl Layout {
    /// Returns the hash that rmw announces for a message, or a service, of this definition: `RIHS01_` and 64
    /// hexadecimal digits.
    pub fn type_hash(&self) -> String {
        let mut text = String::from("{\"type_description\": ");
        if let Some(this) = self.structs.last() {
            describe(&mut text, this);
        }
        text.push_str(", \"referenced_type_descriptions\": [");
        for (index, inner) in self.referenced().into_values().enumerate() {
            text.push_str(if index == 0 { "" } else { ", " });
            describe(&mut text, inner);
        }
        text.push_str("]}");
        digest(&SHA256, text.as_bytes()).as_ref().iter().fold("RIHS01_".to_owned(), |mut hash, byte| {
            let _ = write!(hash, "{byte:02x}");
            hash
        })
    }

    /// Returns everything that the type contains, in the order of names.
    pub(crate) fn referenced(&self) -> BTreeMap<String, &Struct> {
        let inner = self.structs.split_last().map_or(&[][..], |(_, inner)| inner);
        inner.iter().map(|inner| (inner.name.to_string(), inner)).collect()
    }
}

fn describe(text: &mut String, this: &Struct) {
    let _ = write!(text, "{{\"type_name\": \"{}\", \"fields\": [", this.name);
    for (index, member) in this.members.iter().enumerate() {
        let (id, capacity, string_capacity) = ids(&member.field_type);
        let nested = match (&member.field_type.base, member.element) {
            (Base::Message(name), Element::Struct(_)) => name.to_string(),
            _ => String::new(),
        };
        let separator = if index == 0 { "" } else { ", " };
        let _ = write!(
            text,
            "{separator}{{\"name\": \"{}\", \"type\": {{\"type_id\": {}, \"capacity\": {capacity}, \
             \"string_capacity\": {string_capacity}, \"nested_type_name\": \"{nested}\"}}}}",
            member.name, id,
        );
    }
    text.push_str("]}");
}

/// Returns id, capacity and string capacity of a type.
pub(crate) fn ids(field_type: &FieldType) -> (u8, u32, u32) {
    let (id, string_capacity) = match &field_type.base {
        Base::Primitive(primitive) => (primitive.id(), 0),
        Base::String { bound } => bound.map_or((17, 0), |bound| (21, bound)),
        Base::WString { bound } => bound.map_or((18, 0), |bound| (22, bound)),
        Base::Message(_) => (NESTED, 0),
    };
    let (more, capacity) = match field_type.shape {
        Shape::One => (0, 0),
        Shape::Array(count) => (ARRAY, count),
        Shape::Sequence { bound: Some(bound) } => (BOUNDED_SEQUENCE, bound),
        Shape::Sequence { bound: None } => (SEQUENCE, 0),
    };
    (id + more, capacity, string_capacity)
}

impl Primitive {
    fn id(self) -> u8 {
        PRIMITIVES.iter().find(|(_, primitive)| *primitive == self).map_or(0, |(id, _)| *id)
    }

    pub(crate) fn from_id(id: u8) -> Option<Self> {
        PRIMITIVES.iter().find(|(known, _)| *known == id).map(|(_, primitive)| *primitive)
    }
}

#[cfg(test)]
mod tests {
    use crate::library::Library;

    #[test]
    fn hashes_are_those_that_ros_announces() {
        for (name, hash) in [
            ("std_msgs/msg/String", "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"),
            ("std_msgs/msg/Empty", "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312"),
            (
                "rmw_dds_common/msg/ParticipantEntitiesInfo",
                "91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e",
            ),
            // A service.
            (
                "example_interfaces/srv/AddTwoInts",
                "e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
            ),
        ] {
            let layout = Library::empty().layout(&name.parse().unwrap(), &mut |_| None).unwrap();
            assert_eq!(layout.type_hash(), format!("RIHS01_{hash}"), "{name}");
        }
    }
}
