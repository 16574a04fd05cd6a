//! Fair shares for peers that nobody knows yet, by the address they come from: places for their handshakes and lines
//! in the log.
//!
//! Everything here is pure: callers pass the time. It refuses, evicts and summarises nothing by itself; listeners act
//! on its decisions. Peers with a verified certificate are limited by their node id elsewhere (`sgc-router`
//! `limits.rs`).

mod places;
mod prefix;
mod repeats;

pub use places::{PLACE_HELD_MIN, PlaceDecision, PlaceLimits, PlaceRefusal, Places};
pub use prefix::AddressPrefix;
pub use repeats::{REPEAT_SOURCES_MAX, REPEAT_WINDOW, RepeatCount, Repeats};
