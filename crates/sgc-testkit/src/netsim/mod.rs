//! A bad network between real processes: rate, queue, delay, jitter, loss, reordering.
//!
//! [`Channel`] is the model of one direction, without clock or socket. [`TunLink`] joins two network namespaces through
//! two channels, IP packet by IP packet, so that all programs there are affected; it needs root. [`UdpRelay`] and
//! [`TcpRelay`] put the same channels between two addresses, without root. [`Namespace`] makes the namespaces that
//! tests and benchmarks put their processes and threads in.
//!
//! Unlike the rest of this crate it runs in real time; only the draws are seeded. The program `netsim` offers all of it
//! on the command line.

mod channel;
mod namespace;
mod pump;
mod relay;
mod tun;
mod units;

pub use channel::{Channel, Counters, FLYING_BYTES_MAX, Loss, Profile, QueueLimit, Reorder};
pub use namespace::{Namespace, NetsimError, ip};
pub use pump::Direction;
pub use relay::{TcpRelay, UdpRelay};
pub use tun::{TunEnd, TunLink, TunOptions, on_host};
pub use units::{UnitError, parse_bytes, parse_duration, parse_percent, parse_queue, parse_rate};
