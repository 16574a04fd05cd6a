//! The fleet as this node sees it: its members and partners, and operations on it, also those at its authority.

pub(crate) mod authority;
pub(crate) mod holders;
pub(crate) mod inquiries;
pub(crate) mod members;
pub(crate) mod operations;
pub(crate) mod operators;
pub mod partners;
pub(crate) mod reports;
