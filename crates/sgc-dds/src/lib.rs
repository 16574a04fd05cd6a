//! The Cyclone DDS backend of SGC: [`CycloneNetwork`] implements [`sgc_ros::RosNetwork`] on `cyclors`.
//!
//! It joins one DDS domain, tells which endpoints are there, and moves serialised samples in and out
//! for types that are unknown at compile time. It decides nothing about what is shared with whom, knows
//! no ROS name mangling, never looks inside a payload beyond its encapsulation header, and uses no
//! tokio: threads here are plain threads, which block until Cyclone or its listener has something for
//! them.
//!
//! This is the only crate with `unsafe`: everything that Cyclone hands out is owned by a type of
//! `entity` or `sample`, whose `Drop` gives it back, and no raw pointer leaves the crate.
//!
//! # Keyed topics
//! The type of samples here knows no keys: all samples of a keyed topic are one instance to Cyclone. Data of keyed topics
//! flows both ways with the hash of its key, for which publishers are asked, and so do disposals and unregistrations, with their serialised key; a disposal that comes with nothing but a
//! hash of its key (Fast DDS may send one) does not. A sample whose key has no known hash is not written. What is kept for late joiners is kept for
//! each of up to [`qos::KEYED_INSTANCES_KEPT`] keys; other history is kept per topic rather than per instance, so it is made so many times as deep.

#![allow(unsafe_code)]
#![warn(clippy::undocumented_unsafe_blocks)]

mod announced;
mod announcement;
pub mod config;
mod discovery;
mod entity;
mod first_messages;
mod fragments;
mod graph;
mod host_addresses;
pub mod identity;
mod inline_qos;
mod intake;
mod known_writers;
mod late;
mod log;
mod manual_leases;
mod network;
pub mod payload;
mod plugin_domain;
pub mod qos;
mod reader;
mod rpc;
mod same_host;
mod sample;
mod security;
mod service;
mod shown;
mod strangers;
pub mod user_data;
mod wait;
mod writer;

pub use config::{DdsConfig, DiscoveryRange};
pub use intake::WAITING_BYTES_MAX;
pub use log::{Unsent, unsent};
pub use network::CycloneNetwork;
pub use reader::CycloneReader;
pub use sample::unidentified_messages;
pub use security::{Security, SecurityError, is_enclave};
pub use service::{CycloneClient, CycloneServer};
pub use strangers::{Barrier, Strangers, strangers};
pub use writer::CycloneWriter;
