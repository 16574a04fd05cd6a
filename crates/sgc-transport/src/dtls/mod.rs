//! Links over DTLS 1.2 and 1.3: QUIC, whose datagrams travel as application data of DTLS associations.
//!
//! Recovery, streams and priorities are QUIC's. What is made here: associations, whose they are, and how they are found
//! again when a peer's address changes. `front`: bytes; `association`: one of them, without IO; `paths`: where its peer is;
//! `mux`: all of one socket; `endpoint`: listening and dialling.

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
