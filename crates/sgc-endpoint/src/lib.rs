//! Publish and subscribe by name: a node's own traffic, as opposed to the traffic that it carries for others.
//!
//! [`Endpoint`] is a pure machine: frames of its own router, the user's requests and the time go in; frames and events
//! come out. After each call the driver drains [`Endpoint::poll_output`] until [`Output::Timeout`]. [`Source`] and
//! [`Sink`] are the two ends of the data path: they seal and open on the thread that calls them, and never call the
//! machine.
//!
//! The crate knows nothing of ROS (that is `sgc-ros`) and nothing of routes (that is `sgc-router`); it meets routers in
//! frames only. The normative text is `docs/spec/trust.md` and `docs/spec/routing.md`.
#![forbid(unsafe_code)]

mod calls;
mod compression;
mod config;
mod context;
mod endpoint;
mod history;
mod joiner;
mod joins;
mod marks;
mod names;
mod output;
mod owner;
mod packed_report;
mod packed_type;
mod receivers;
mod sink;
mod source;

pub use calls::{
    ANSWER_KEPT_BYTES_MAX, ASK_AFTER, ASK_EVERY_MAX, Answerer, Answering, CallLimits, CallLoss, CallRefusal,
    CallStats, Caller, LostCall, Outcome,
};
pub use compression::{COMPRESS_BYTES_MIN, CompressionError, Compressor, Decompressor};
pub use config::{EndpointConfig, Limits};
pub use endpoint::Endpoint;
pub use history::{RECOVERY_BYTES_MAX, RECOVERY_MESSAGES_MAX, RecoveryLimits};
pub use joins::{JoinKind, JoinStatus, LostReason, RefusedBy};
pub use marks::{MARK_AFTER, Marks};
pub use output::{EndpointDrop, Event, Output, SignedKind, UnexpectedFrame};
pub use owner::{ADVERT_INTERVAL, ADVERTS_BURST, ShareError, ShareSpec};
pub use packed_report::{pack_report, unpack_report};
pub use packed_type::{PackedType, unpack_type};
pub use receivers::Receivers;
pub use sink::{
    AskAgain, Delivery, EPOCHS_MAX, Message, PARKED_BYTES_MAX, PARKED_LOOKS_MAX, PARKED_PACKETS_MAX, Sink,
    SinkDrop, SinkLimits, SinkProgress,
};
pub use source::{FRAGMENT_BYTES, PublishError, SOURCE_MESSAGES_MAX, Source, SourceConfig, SourceProgress};
