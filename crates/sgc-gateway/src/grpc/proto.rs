//! Code generated from `proto/sgc/gateway/v1/gateway.proto`, which documents it.
#![allow(missing_docs, unreachable_pub, rustdoc::all, reason = "generated")]
#![allow(clippy::all, clippy::disallowed_types, reason = "generated")]

include!("generated/sgc.gateway.v1.rs");

/// The descriptor that reflection serves.
pub const DESCRIPTOR: &[u8] = include_bytes!("generated/descriptor.bin");
