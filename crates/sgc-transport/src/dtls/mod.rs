//! Links over DTLS 1.2 and 1.3: QUIC, whose datagrams travel as application data of DTLS associations.
//!
//! QUIC does recovery, streams and priorities. This module makes associations, authenticates their peers, and finds
//! associations again when a peer's address changes. `front`: bytes; `association`: one association, without IO;
//! `paths`: its peer's addresses; `mux`: all associations of one socket; `endpoint`: listening and dialling.

mod association;
mod endpoint;
#[cfg(any(test, feature = "fuzzing"))]
mod exercise;
mod front;
mod keys;
mod mux;
mod paths;

pub(crate) use endpoint::{DtlsDialer, DtlsListener};
#[cfg(feature = "fuzzing")]
pub use exercise::HandshakeExercise;
pub use front::exercise as exercise_front;
pub(crate) use mux::{Claim, Mux};
