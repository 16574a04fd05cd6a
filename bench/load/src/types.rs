//! The two types on the wire, as the instructions that Cyclone's IDL compiler would make of them.
//!
//! ```idl
//! module sgc_bench { module msg { module dds_ {
//!   struct Load_ { uint64 seq; uint64 stamp_ns; sequence<octet> data; };
//! }; }; };
//! module rmw_dds_common { module msg { module dds_ {
//!   struct Gid_ { octet data[16]; };
//!   struct NodeEntitiesInfo_ { string ns; string name; sequence<Gid_> readers; sequence<Gid_> writers; };
//!   struct ParticipantEntitiesInfo_ { Gid_ gid; sequence<NodeEntitiesInfo_> nodes; };
//! }; }; };
//! ```
//!
//! Layout only; [`crate::dds`] reads and writes.

use std::ffi::{CStr, c_char};
use std::mem::{align_of, size_of};
use std::ptr::null;

use cyclors::*;

const ADR: u32 = dds_stream_opcode_DDS_OP_ADR;
const RTS: u32 = dds_stream_opcode_DDS_OP_RTS;
const EIGHT_BYTES: u32 = dds_stream_typecode_primary_DDS_OP_TYPE_8BY;
const STRING: u32 = dds_stream_typecode_primary_DDS_OP_TYPE_STR;
const ARRAY: u32 = dds_stream_typecode_primary_DDS_OP_TYPE_ARR;
const SEQUENCE: u32 = dds_stream_typecode_primary_DDS_OP_TYPE_SEQ;
const OF_BYTES: u32 = dds_stream_typecode_subtype_DDS_OP_SUBTYPE_1BY;
const OF_STRUCTS: u32 = dds_stream_typecode_subtype_DDS_OP_SUBTYPE_STU;

const GID_BYTES: usize = 16;
const SEQUENCE_BYTES: u32 = size_of::<dds_sequence_t>() as u32;
/// Bytes of a measured message in memory: its number, its time and its content.
const MESSAGE_BYTES: u32 = 16 + SEQUENCE_BYTES;
const NODE_BYTES: u32 = size_of::<NodeEntities>() as u32;

/// The description of a type for Cyclone.
#[derive(Debug)]
pub(crate) struct Descriptor {
    type_name: &'static CStr,
    bytes: u32,
    align: u32,
    fields: u32,
    instructions: &'static [u32],
}

/// The type of measured messages.
pub(crate) static MESSAGE: Descriptor = Descriptor {
    type_name: c"sgc_bench::msg::dds_::Load_",
    bytes: MESSAGE_BYTES,
    align: 8,
    fields: 4,
    instructions: &[ADR | EIGHT_BYTES, 0, ADR | EIGHT_BYTES, 8, ADR | SEQUENCE | OF_BYTES, 16, RTS],
};

/// `std_msgs/msg/UInt8MultiArray` without dimensions and offset, whose counts are the zeros of the number: the type of
/// the load generator on `rcl`.
pub(crate) static BYTES: Descriptor = Descriptor {
    type_name: c"std_msgs::msg::dds_::UInt8MultiArray_",
    bytes: MESSAGE_BYTES,
    align: 8,
    fields: 3,
    instructions: &[ADR | EIGHT_BYTES, 0, ADR | SEQUENCE | OF_BYTES, 16, RTS],
};

/// The type of `ros_discovery_info`.
pub(crate) static GRAPH: Descriptor = Descriptor {
    type_name: c"rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
    bytes: size_of::<ParticipantEntities>() as u32,
    align: align_of::<ParticipantEntities>() as u32,
    fields: 10,
    instructions: &[
        // ParticipantEntitiesInfo. The second half of a sequence's last word says where its element is, from
        // its own start; the first how long it is itself.
        ADR | ARRAY | OF_BYTES,
        0,
        GID_BYTES as u32,
        ADR | SEQUENCE | OF_STRUCTS,
        16,
        NODE_BYTES,
        (4 << 16) + 5,
        RTS,
        // NodeEntitiesInfo
        ADR | STRING,
        0,
        ADR | STRING,
        8,
        ADR | SEQUENCE | OF_STRUCTS,
        16,
        GID_BYTES as u32,
        (4 << 16) + 9,
        ADR | SEQUENCE | OF_STRUCTS,
        16 + SEQUENCE_BYTES,
        GID_BYTES as u32,
        (4 << 16) + 5,
        RTS,
        // Gid
        ADR | ARRAY | OF_BYTES,
        0,
        GID_BYTES as u32,
        RTS,
    ],
};

/// `NodeEntitiesInfo` in memory.
#[repr(C)]
pub(crate) struct NodeEntities {
    pub(crate) namespace: *const c_char,
    pub(crate) name: *const c_char,
    pub(crate) readers: dds_sequence_t,
    pub(crate) writers: dds_sequence_t,
}

/// `ParticipantEntitiesInfo` in memory, with ids of 16 bytes as from Iron on.
#[repr(C)]
pub(crate) struct ParticipantEntities {
    pub(crate) gid: [u8; GID_BYTES],
    pub(crate) nodes: dds_sequence_t,
}

impl Descriptor {
    /// As Cyclone wants it. Points to static memory only.
    pub(crate) fn native(&self) -> dds_topic_descriptor_t {
        let none = || dds_type_meta_ser { data: null(), sz: 0 };
        dds_topic_descriptor_t {
            m_size: self.bytes,
            m_align: self.align,
            m_flagset: DDS_TOPIC_RESTRICT_DATA_REPRESENTATION,
            m_nkeys: 0,
            m_typename: self.type_name.as_ptr(),
            m_keys: null(),
            m_nops: self.fields,
            m_ops: self.instructions.as_ptr(),
            m_meta: c"".as_ptr(),
            type_information: none(),
            type_mapping: none(),
            restrict_data_representation: DDS_DATA_REPRESENTATION_FLAG_XCDR1,
        }
    }
}

/// A sequence that Cyclone only reads, of memory that is not its own.
pub(crate) fn sequence<T>(items: &[T]) -> dds_sequence_t {
    let length = items.len() as u32;
    dds_sequence_t {
        _maximum: length,
        _length: length,
        _buffer: items.as_ptr().cast_mut().cast(),
        _release: false,
    }
}

/// Returns the DDS name of the ROS 2 topic `/name`.
pub(crate) fn dds_name(ros_name: &str) -> String {
    format!("rt{ros_name}")
}
