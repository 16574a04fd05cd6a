//! Links: authenticated connections between two nodes, the same to their users over every transport.
//!
//! A [`Link`] carries control frames (reliable, ordered), flows (reliable packets of one topic each, none waiting for
//! another) and datagrams (best effort). It exists only after both ends have proven their identities with the
//! certificates of their [`sgc_trust::Identity`]. [`Listener`] and [`Dialer`] make links.
//!
//! This crate has no routing, queues, reconnecting or policy. A link tells its peer and the cause of its end; the node
//! draws the consequences. Below a link is QUIC (by itself, inside of DTLS, or with packets that are authenticated
//! only) or a stream of bytes: TLS, TCP, WebSocket. Builds without the feature `dtls` refuse `dtls://`.
#![forbid(unsafe_code)]

mod any_link;
mod budget;
mod congestion;
mod credentials;
mod direct;
#[cfg(feature = "dtls")]
mod dtls;
#[cfg(not(feature = "dtls"))]
#[path = "dtls/absent.rs"]
mod dtls;
mod endpoint;
mod error;
mod flow;
mod framing;
mod handshakes;
mod labels;
mod limits;
mod link;
mod metrics;
mod options;
mod quic;
mod quinn_runtime;
mod race;
mod socket;
mod stats;
mod stream;
mod tls;
mod url;

/// Entry points for fuzzing: each panics if its input shows a defect.
#[cfg(feature = "fuzzing")]
pub mod fuzzing {
    pub use crate::stream::{fuzz_bytes, fuzz_operations};
}

/// Internals that benchmarks measure by themselves.
#[cfg(feature = "benchmarks")]
#[doc(hidden)]
pub mod benchmarks {
    pub use crate::stream::Conversation;
}

pub use any_link::AnyLink;
pub use budget::{RECEIVE_BUDGET_BYTES, RECEIVE_WINDOW_BYTES_MIN, ReceiveBudget};
pub use congestion::{Congestion, UnknownCongestion};
pub use credentials::CredentialStore;
pub use direct::{CheckDatagram, DirectHandle};
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub use dtls::HandshakeExercise;
#[cfg(feature = "dtls")]
#[doc(hidden)]
pub use dtls::exercise_front;
pub use endpoint::{Dialer, DirectSockets, Listener, RefusedPeer};
pub use error::{
    CloseReason, DialError, FlowEnd, FlowError, LabelError, LinkError, PeerRefusal, ProtocolError, Refusal,
};
pub use flow::{Delivery, FlowRx, FlowTx};
pub use limits::{CONTROL_FRAME_BYTES_MAX, FLOW_PACKET_BYTES_MAX, FLOW_VERSION, LINK_VERSION};
pub use link::{Link, ReceivedDatagram};
pub use metrics::{RefusalKind, TransportMetrics};
pub use options::{BulkLanes, LinkOptions};
pub use quic::QuicLink;
pub use stats::{KeyExchange, LinkStats};
#[cfg(feature = "fuzzing")]
#[doc(hidden)]
pub use stream::DoorExercise;
pub use stream::{StreamLink, StreamViolation};
pub use url::{COST_MS_MAX, DEFAULT_PATH, DEFAULT_PORT, LinkUrl, ListenAddr, Scheme, UrlError};
