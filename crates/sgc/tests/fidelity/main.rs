//! What an unmodified program must not be able to tell, in the large: latched topics many to many, programs and nodes
//! that come and go, a subscriber that stalls, and what is not shared.

#![allow(clippy::unwrap_used)]

mod busy;
mod churn;
mod isolation;
mod lab;
mod latched;
mod policies;
mod stall;
#[path = "../support/mod.rs"]
mod support;
