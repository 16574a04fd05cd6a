//! The types of interfaces: the search for them, and the questions to their owners.

pub(crate) mod interface_types;
pub(crate) mod type_jobs;
