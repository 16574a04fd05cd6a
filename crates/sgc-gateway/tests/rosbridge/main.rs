//! Tests of the rosbridge protocol through real WebSockets, on a network in memory.
#![allow(clippy::unwrap_used)]

#[path = "../support/mod.rs"]
mod support;

mod admission;
mod bad;
mod client;
mod pace;
mod parameters;
mod programs;
mod rosapi;
mod services;
mod topics;
