//! A type with everything that it contains, resolved.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::definition::{Constant, FieldType, Primitive, Shape, TypeName};
use crate::value::Value;

/// Greatest depth of types within types.
pub const LAYOUT_DEPTH_MAX: usize = 32;
/// Most types that one may contain.
pub const LAYOUT_STRUCTS_MAX: usize = 1024;

/// Bytes of a payload that hold the stamp of its header.
pub const HEADER_STAMP_BYTES: usize = 24;

/// The layout of a type's CDR, made by [`Library::layout`](crate::Library::layout): complete, and without circles.
#[derive(Clone, Debug)]
pub struct Layout {
    /// The type itself is the last one: its parts come before it.
    pub(crate) structs: Vec<Struct>,
}

/// A message within a layout.
#[derive(Clone, Debug)]
pub(crate) struct Struct {
    pub(crate) name: TypeName,
    pub(crate) members: Vec<Member>,
    /// Constants of its definition; a transmitted description has none.
    pub(crate) constants: Vec<Constant>,
}

/// A member of it.
#[derive(Clone, Debug)]
pub(crate) struct Member {
    pub(crate) name: Arc<str>,
    pub(crate) element: Element,
    pub(crate) shape: Shape,
    /// Its type in the definition.
    pub(crate) field_type: FieldType,
    /// The default of the definition, if there is one.
    pub(crate) default: Option<MemberDefault>,
}

/// A default of a definition.
#[derive(Clone, Debug)]
pub(crate) struct MemberDefault {
    /// The definition's spelling.
    pub(crate) text: String,
    /// Its value; `None` if the text is invalid.
    pub(crate) value: Option<Value>,
}

/// One element of a member.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Element {
    Primitive(Primitive),
    String {
        bound: Option<u32>,
    },
    WString {
        bound: Option<u32>,
    },
    /// Index in the layout, before that of the containing struct.
    Struct(usize),
}

impl Layout {
    /// Returns the name of the type.
    pub fn name(&self) -> Option<&TypeName> {
        self.structs.last().map(|s| &s.name)
    }

    /// Returns the layout of a contained type, such as a service's request; for the type itself that is all of it.
    pub fn part(&self, name: &TypeName) -> Option<Self> {
        let place = self.structs.iter().position(|inner| inner.name == *name)?;
        let mut structs = Vec::new();
        self.copy(place, &mut structs, &mut BTreeMap::new());
        Some(Self { structs })
    }

    /// Copies a struct behind copies of its parts, and returns its index there.
    fn copy(&self, place: usize, into: &mut Vec<Struct>, places: &mut BTreeMap<usize, usize>) -> usize {
        if let Some(there) = places.get(&place) {
            return *there;
        }
        let Some(inner) = self.structs.get(place) else { return 0 };
        let mut copy = inner.clone();
        for member in &mut copy.members {
            if let Element::Struct(contained) = &mut member.element {
                *contained = self.copy(*contained, into, places);
            }
        }
        into.push(copy);
        places.insert(place, into.len() - 1);
        into.len() - 1
    }

    /// Returns whether its first member is a `std_msgs/msg/Header`, whose stamp [`Layout::header_stamp_ns`] finds.
    pub fn begins_with_header(&self) -> bool {
        let first = self.structs.last().and_then(|this| this.members.first());
        let Some((Element::Struct(place), Shape::One)) = first.map(|m| (m.element, m.shape)) else {
            return false;
        };
        self.structs.get(place).is_some_and(|inner| inner.name.to_string() == "std_msgs/msg/Header")
    }

    /// Returns the stamp of the header at the beginning of a message, nanoseconds since the Unix epoch; the first
    /// [`HEADER_STAMP_BYTES`] of its payload are enough.
    pub fn header_stamp_ns(&self, payload: &[u8]) -> Option<i64> {
        if !self.begins_with_header() {
            return None;
        }
        let id = u16::from_be_bytes([*payload.first()?, *payload.get(1)?]);
        let at = match id {
            0x0000 | 0x0001 | 0x0006 | 0x0007 => 4,
            // The message, the header and the stamp carry their sizes.
            0x0008 | 0x0009 => 16,
            _ => return None,
        };
        let word = |at: usize| {
            let word: [u8; 4] = payload.get(at..at + 4)?.try_into().ok()?;
            Some(if id & 1 == 1 { u32::from_le_bytes(word) } else { u32::from_be_bytes(word) })
        };
        let seconds = i64::from(word(at)?.cast_signed());
        seconds.checked_mul(1_000_000_000)?.checked_add(i64::from(word(at + 4)?))
    }

    /// Returns whether it contains a `wstring` anywhere.
    pub(crate) fn is_wide(&self) -> bool {
        let mut members = self.structs.iter().flat_map(|s| &s.members);
        members.any(|m| matches!(m.element, Element::WString { .. }))
    }
}
