//! A whole network of SGC nodes in one thread: virtual clock, seeded links, real machines, real cryptography.
//!
//! A [`World`] holds nodes (a `Router` and an `Endpoint` each, wired as the driver of `sgc-node` wires them),
//! cables between them, and a queue of frames and packets in flight. Time passes only in [`World::run`] and its
//! relatives, and the same seed gives the same run. Tests read its record: deliveries, events, drops.
//! [`Model`] computes the expected outcome from the configuration. [`mesh`] has thousands of bare routers.
//!
//! There is no socket, no thread and no sleep here, and no ROS: nodes publish numbered messages.
//! Sealing is as in production; the provider's own randomness in signatures decides nothing. Only [`netsim`] is
//! different: it is a bad network for real processes, in real time, and [`unused_port`] is for their listeners.
//! [`CountingAllocator`] is for tests of allocations, and [`conformance`] for implementations of
//! [`RosNetwork`](sgc_ros::RosNetwork).
//!
//! ```
//! use std::time::Duration;
//! use sgc_testkit::{Sharing, World};
//!
//! let mut world = World::new(7);
//! let (arm, cloud, desk) = (world.proxy("arm-1"), world.router("cloud"), world.proxy("desk"));
//! world.link(arm, cloud);
//! world.link(cloud, desk);
//! world.share(arm, "/chatter", Sharing::to_fleet());
//! world.use_topic(desk, arm, "/chatter");
//! world.until_granted(desk, arm, "/chatter");
//! let message = world.publish(arm, "/chatter");
//! world.run(Duration::from_secs(1));
//! assert_eq!(world.received(desk, arm, "/chatter"), [message]);
//! ```
#![deny(unsafe_code)]

mod allocator;
mod cast;
mod clock;
pub mod conformance;
mod datagrams;
mod direct;
mod evil;
mod ids;
pub mod mesh;
mod model;
mod nat;
pub mod netsim;
mod networks;
mod node;
mod ports;
mod record;
pub mod redis;
mod rng;
mod ros;
mod seeds;
mod shared_store;
mod store;
mod trust;
mod wires;
mod world;

pub use allocator::{
    Allocations, CountingAllocator, allocated_here, allocated_since_last, allocations, allocations_of,
    live_bytes,
};
pub use cast::{Member, identity, invited, revocation_list, serial_list};
pub use clock::Clock;
pub use ids::{MessageId, NodeKey};
pub use model::Model;
pub use nat::{Dependence, Nat, NatKind};
pub use networks::{NatKey, Networks};
pub use node::Sharing;
pub use ports::unused_port;
pub use record::{
    CapturedFrame, CapturedPacket, DataDrop, LogEntry, PacketCopies, PublishedMessage, ReceivedMessage,
    SentDatagram, What,
};
pub use rng::Dice;
pub use ros::{FakeClient, FakeDomain, FakeReader, FakeRos, FakeServer, FakeWriter};
pub use seeds::run_seeds;
pub use store::StoreCounts;
pub use world::{World, WorldConfig};
