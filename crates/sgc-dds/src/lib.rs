//! The Cyclone DDS backend of SGC: [`CycloneNetwork`] implements [`sgc_ros::RosNetwork`] on `cyclors`.
//!
//! It joins one DDS domain, reports its endpoints, and moves serialised samples in and out for types that are unknown
//! at compile time. It decides nothing about sharing, knows no ROS name mangling, never looks inside a payload beyond
//! its encapsulation header, and uses no tokio. Its threads are plain threads, which block until Cyclone or its
//! listeners have something for them.
//!
//! This is the only crate with `unsafe`. Everything that Cyclone hands out is owned by a type of `entity` or
//! `sample`, whose `Drop` returns it, and no raw pointer leaves the crate.
//!
//! # Keyed topics
//! SGC's sample type knows no keys, so all samples of a keyed topic are one instance to Cyclone. Data of keyed topics
//! flows both ways with its key hash, which publishers are asked for. Disposals and unregistrations flow with their
//! serialised key, but not a disposal with nothing but a key hash, which Fast DDS may send. A sample whose key hash
//! is unknown is not written. Samples for late joiners are kept for each of up to [`qos::KEYED_INSTANCES_KEPT`] keys.
//! Other history is kept per topic rather than per instance, so it is that many times as deep.

#![allow(unsafe_code)]
#![warn(clippy::undocumented_unsafe_blocks)]

mod acknack;
mod announced;
mod announcement;
mod arrivals;
mod backpressure;
mod bursts;
pub mod config;
mod discovery;
mod domain;
mod entity;
mod events;
mod files;
mod first_messages;
mod fragments;
mod graph;
mod host_addresses;
pub mod identity;
mod inline_qos;
mod intake;
mod known_writers;
mod late;
mod late_readers;
mod local_nodes;
mod log;
mod manual_leases;
mod matched;
mod network;
mod participant;
pub mod payload;
mod plugin_domain;
mod proxies;
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
mod writer_inside;

pub use arrivals::WAITING_BYTES_MAX;
pub use config::{DdsConfig, DiscoveryRange};
pub use host_addresses::{has_outward_address, is_alone};
pub use log::{Unsent, unsent};
pub use network::CycloneNetwork;
pub use reader::CycloneReader;
pub use sample::unidentified_messages;
pub use security::{Security, SecurityError};
pub use service::{CycloneClient, CycloneServer};
pub use strangers::{Barrier, Strangers, strangers};
pub use writer::CycloneWriter;
