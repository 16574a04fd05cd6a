//! Decisions about the links of a node, and about the traffic that it starts by itself: keep-alive, back-off, bulk lanes,
//! claims, candidates, port mappings, questions for types, shaping, the clocks of peers, dead-man switches.
//! [`LinkSupervisor`] decides when a link is replaced.
//!
//! Pure machines: time and randomness are arguments, and nothing here opens a socket, spawns a task or waits.
//! `sgc-node` observes, passes events in, and carries the results out.
#![forbid(unsafe_code)]

mod backoff;
mod bulk;
mod candidates;
mod claims;
mod clocks;
mod dead_man;
mod direct;
mod failback;
mod keep_alive;
mod origin;
mod port_mapping;
mod shaper;
mod supervisor;
mod type_questions;

pub use backoff::{BACKOFF_MAX, BACKOFF_MIN, Backoff, DISPLACED_MAX, STAND_BACK, doubled, jittered, wait};
pub use bulk::{
    BULK_MESSAGE_BYTES_MIN, BulkEnd, BulkLaneObservation, BulkLaneUse, BulkMeter, BulkPath,
    BulkPathObservation,
};
pub use candidates::{ADDRESSES_MAX, AttemptResult, CANDIDATES_MAX, Candidates, is_of_host};
pub use claims::ClaimTable;
pub use clocks::{ClockBounds, ClockOutput, PEER_CLOCKS_MAX, PeerClocks};
pub use dead_man::{Command, CommandRefusal, DeadMan, StopCause};
pub use direct::{
    DIRECT_ATTEMPT_MAX, DIRECT_ATTEMPTS_MAX, DIRECT_PEERS_MAX, DirectLinkTable, DirectOutput, DirectPaths,
    LocalAddress, NoDirectPath, REFLEXIVE_MAX, is_checkable, local_addresses,
};
pub use failback::Failback;
pub use keep_alive::{ASK_MAX, Activity, KeepAlive, KeepAlivePolicy, LinkObservation, PeerState, Verdict};
pub use origin::{Move, Origin};
pub use port_mapping::{
    GrantedMapping, MAPPING_LIFETIME, MapperOutput, MappingFailure, MappingProtocol, MappingTarget,
    PortMapper,
};
pub use shaper::{Shaper, Wished};
pub use supervisor::{
    DOUBT_AFTER, DialCause, Event, LinkFacts, LinkKey, LinkSupervisor, NETWORK_NEWS_MAX, Output,
    UNDISTURBED_MAX,
};
pub use type_questions::TypeQuestions;
