//! ROS 2 message definitions, and messages by them: serialised, as values, as JSON and CBOR.
//!
//! [`Library`] holds definitions: those that come with ROS 2 ship inside, others are parsed from the text of `.msg`,
//! `.srv`, `.action` and `.idl` files, which the caller finds, or come as a description ([`Layout::from_description`]).
//! [`Library::layout`] resolves a type to the layout of its CDR. [`Layout::decode`] turns a payload into a [`Value`],
//! which is shown as YAML, JSON or CBOR; [`Layout::from_json`], [`Layout::from_cbor`] and [`Layout::encode`] go the
//! other way. Callers find definitions and payloads.
//!
//! Payloads, definitions, JSON and CBOR are untrusted: sizes, depths and counts are bounded, and input that does not
//! fit is a typed error.
#![forbid(unsafe_code)]

mod cbor;
mod decode;
mod defaults;
mod definition;
mod describe;
mod encode;
mod encoding;
mod fault;
mod from_json;
mod hash;
mod idl;
mod json;
mod layout;
mod library;
mod number;
mod parse;
mod path;
mod ros2msg;
#[cfg(test)]
mod testing;
mod value;
mod yaml;

pub use decode::DecodeError;
pub use definition::{
    Base, Constant, DUMMY_MEMBER, Definition, Field, FieldType, Primitive, Shape, TypeName, TypeNameError,
};
pub use describe::{DESCRIPTION_BYTES_MAX, DescriptionError};
pub use encoding::{ByteOrder, CdrVersion, Encoding, Padding, WideUnit};
pub use fault::{CONTENT_BYTES_MAX, VALUES_MAX, ValueError, ValueProblem};
pub use idl::parse_idl;
pub use layout::{HEADER_STAMP_BYTES, LAYOUT_DEPTH_MAX, LAYOUT_STRUCTS_MAX, Layout};
pub use library::{Library, LookUp, TypeError};
pub use parse::{DEFINITION_BYTES_MAX, ParseError, ParseProblem, parse};
pub use value::{PackedArray, Value};
pub use yaml::YamlStyle;
