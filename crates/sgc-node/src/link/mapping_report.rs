//! Port mappings between the control task, which wishes for one, and the task that keeps it.

use std::collections::{BTreeMap, BTreeSet};
use std::net::{Ipv4Addr, SocketAddr};
use std::num::NonZeroU16;
use std::time::Instant;

use sgc_session::{GrantedMapping, MappingFailure, MappingProtocol};

/// Whether a mapping is wanted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum MappingWish {
    Off(MappingOff),
    For {
        port: NonZeroU16,
        /// The addresses that routers see. Others mean that the gateway forgot something.
        seen: BTreeSet<SocketAddr>,
    },
}

/// Reasons why no mapping is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum MappingOff {
    #[error("`port_mapping` of [node] is false")]
    Configured,
    #[error("this node makes no direct links")]
    NoDirectLinks,
    #[error("no router over QUIC or DTLS sees a NAT")]
    NoNat,
    #[error("this host has no IPv4 gateway")]
    NoGateway,
}

/// The state of the mapping.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct MappingReport {
    /// Why none is wanted.
    pub(crate) off: Option<MappingOff>,
    /// The gateway that is asked.
    pub(crate) gateway: Option<Ipv4Addr>,
    /// The mapping in force, and its end.
    pub(crate) mapping: Option<(GrantedMapping, Instant)>,
    /// The first answer is awaited.
    pub(crate) is_looking: bool,
    /// Failures of the last round.
    pub(crate) failures: BTreeMap<MappingProtocol, MappingFailure>,
}

impl MappingReport {
    /// Returns the state of a node that wants no mapping.
    pub(crate) fn off(why: MappingOff) -> Self {
        Self { off: Some(why), gateway: None, mapping: None, is_looking: false, failures: BTreeMap::new() }
    }
}
