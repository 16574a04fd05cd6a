//! A type with all that it contains, resolved.

use std::sync::Arc;

use crate::defaults::MemberDefault;
use crate::definition::{Constant, FieldType, Primitive, Shape, TypeName};

/// How deep types may contain each other.
pub const LAYOUT_DEPTH_MAX: usize = 32;
/// How many types one may contain.
pub const LAYOUT_STRUCTS_MAX: usize = 1024;

/// Bytes of a payload that hold the stamp of the header that it begins with.
pub const HEADER_STAMP_BYTES: usize = 24;

/// What the CDR of a type looks like. Made by [`Library::layout`](crate::Library::layout): complete, and without circles.
#[derive(Clone, Debug)]
pub struct Layout {
    /// The type itself is the last one: what it contains comes before it.
    pub(crate) structs: Vec<Struct>,
}

/// A message within a layout.
#[derive(Clone, Debug)]
pub(crate) struct Struct {
    pub(crate) name: TypeName,
    pub(crate) members: Vec<Member>,
    /// Those of its definition; a description that travels has none.
    pub(crate) constants: Vec<Constant>,
}

/// A member of it.
#[derive(Clone, Debug)]
pub(crate) struct Member {
    pub(crate) name: Arc<str>,
    pub(crate) element: Element,
    pub(crate) shape: Shape,
    /// As the definition has it.
    pub(crate) field_type: FieldType,
    /// What it is if it is left out, if the definition says so.
    pub(crate) default: Option<MemberDefault>,
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
    /// Place in the layout, before that of the struct that contains it.
    Struct(usize),
}

impl Layout {
    /// The type.
    pub fn name(&self) -> Option<&TypeName> {
        self.structs.last().map(|s| &s.name)
    }

    /// Whether its first member is a `std_msgs/msg/Header`, whose stamp [`Layout::header_stamp_ns`] finds.
    pub fn begins_with_header(&self) -> bool {
        let first = self.structs.last().and_then(|this| this.members.first());
        let Some((Element::Struct(place), Shape::One)) = first.map(|m| (m.element, m.shape)) else {
            return false;
        };
        self.structs.get(place).is_some_and(|inner| inner.name.to_string() == "std_msgs/msg/Header")
    }

    /// The stamp of the header that a message begins with, nanoseconds since the Unix epoch; the first
    /// [`HEADER_STAMP_BYTES`] of its payload are enough.
    pub fn header_stamp_ns(&self, payload: &[u8]) -> Option<i64> {
        if !self.begins_with_header() {
            return None;
        }
        let id = u16::from_be_bytes([*payload.first()?, *payload.get(1)?]);
        let at = match id {
            0x0000 | 0x0001 | 0x0006 | 0x0007 => 4,
            // The message, the header and the stamp say their size.
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

    /// Whether there is a `wstring` anywhere in it.
    pub(crate) fn is_wide(&self) -> bool {
        let mut members = self.structs.iter().flat_map(|s| &s.members);
        members.any(|m| matches!(m.element, Element::WString { .. }))
    }
}
