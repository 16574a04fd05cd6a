//! Common parts of the benches of links: the identities of their ends, and their packets.
#![allow(dead_code, unreachable_pub, reason = "shared by benches of which each uses a part")]

use std::sync::Arc;
use std::time::{SystemTime, UNIX_EPOCH};

use bytes::Bytes;
use rand_core::{OsRng, TryRngCore as _};
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::{Class, HOP_LIMIT, Name, Packet, PacketHeader, SourceId, UnixMillis};

/// A router and a robot of one fleet.
pub fn identities() -> (Arc<Identity>, Arc<Identity>) {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    let now = UnixMillis(now.as_millis().try_into().unwrap());
    let mut rng = OsRng.unwrap_err();
    let fleet = Fleet::create("bench".parse().unwrap(), now, &mut rng).unwrap();
    let mut enroll = |node: &str| {
        let request = EnrollRequest::new(node.parse().unwrap(), now);
        Arc::new(fleet.issue(&request, &mut rng).unwrap())
    };
    (enroll("router"), enroll("arm-1"))
}

/// A reliable packet of a message of this many bytes, with so many more in its payload as its seal takes.
pub fn packet(seq: u64, message: usize, sealed: usize) -> Packet {
    let header = PacketHeader {
        reliable: true,
        class: Class::Default,
        hops: HOP_LIMIT,
        suite: 1,
        epoch: 1,
        name: Name([1; 32]),
        source: SourceId([2; 16]),
        seq,
        total: message as u32,
        index: 0,
        grid: 16_384,
        to: None,
    };
    Packet::new(header, Bytes::from(vec![7; message + sealed]).into()).unwrap()
}
