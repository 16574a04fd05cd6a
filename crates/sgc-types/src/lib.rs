//! Types that are known here: found in files, or told by who has them.
//!
//! [`Definitions`] looks for definitions in directories, [`ResolvedType`] is a type with its description, which vouches for
//! itself by its hash, and [`TypeStore`] keeps those that are in use, for whoever in the process reads or writes messages
//! of them. What definitions mean is for `sgc-cdr`; how descriptions travel is for `sgc-endpoint`, and who asks whom for
//! which for `sgc-node`.
#![forbid(unsafe_code)]

mod definitions;
mod resolved;
mod store;

pub use definitions::Definitions;
pub use resolved::{ResolveError, ResolvedType};
pub use store::{
    StoreFull, TYPES_BYTES_MAX, TYPES_MAX, TYPES_PER_OWNER_BYTES_MAX, TYPES_PER_OWNER_MAX, TypeStore,
};
