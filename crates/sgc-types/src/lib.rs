//! The types known here: found in files, or received from other nodes.
//!
//! [`Definitions`] looks for definitions in directories, [`ResolvedType`] is a type with its description, whose hash
//! proves it, and [`TypeStore`] keeps the types in use, for every part of the process that reads or writes their
//! messages. `sgc-cdr` parses definitions, `sgc-endpoint` transports descriptions, and `sgc-node` decides which node
//! asks which owner for them.
#![forbid(unsafe_code)]

mod definitions;
mod resolved;
mod store;

pub use definitions::Definitions;
pub use resolved::{ResolveError, ResolvedType};
pub use store::{
    StoreFull, TYPES_BYTES_MAX, TYPES_MAX, TYPES_PER_OWNER_BYTES_MAX, TYPES_PER_OWNER_MAX, TypeStore,
};
