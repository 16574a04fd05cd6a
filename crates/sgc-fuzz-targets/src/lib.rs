//! Bodies of the fuzz targets, one module each.
//!
//! `fuzz/` links them to libFuzzer, which needs a nightly compiler. `cargo test` runs the same bodies over the
//! committed inputs in `fuzz/corpus/` and over alterations of these from a fixed seed (`tests/corpus.rs`). A body
//! panics if its input shows a defect. `make fuzz` runs long searches and adds their results to the corpus.
#![forbid(unsafe_code)]
// A target reports a defect by a panic.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;
use std::time::SystemTime;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;

pub mod access;
pub mod bodies;
pub mod cdr;
pub mod certs;
pub mod checks;
pub mod control;
pub mod dtls;
pub mod dtls_handshake;
pub mod front_door;
pub mod gateway;
pub mod grants;
pub mod mux;
pub mod packet;
pub mod sink;
pub mod store;
pub mod values;
pub mod zenoh;

/// Body of a fuzz target.
pub type Target = fn(&[u8]);

/// Fuzz targets, sorted by name. The name is also that of the target's folder in `fuzz/corpus/`.
pub const TARGETS: &[(&str, Target)] = &[
    ("access", access::run),
    ("bodies", bodies::run),
    ("cdr", cdr::run),
    ("certs", certs::run),
    ("checks", checks::run),
    ("control", control::run),
    ("dtls", dtls::run),
    ("dtls_handshake", dtls_handshake::run),
    ("front_door", front_door::run),
    ("gateway", gateway::run),
    ("grants", grants::run),
    ("mux", mux::run),
    ("packet", packet::run),
    ("sink", sink::run),
    ("store", store::run),
    ("values", values::run),
    ("zenoh", zenoh::run),
];

/// Returns identities of one fleet that are valid now.
fn members(names: [&str; 2]) -> [Arc<Identity>; 2] {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let now = UnixMillis(now.as_millis() as u64);
    let mut rng = ChaCha20Rng::seed_from_u64(1);
    let fleet = Fleet::create("acme".parse().unwrap(), now, &mut rng).unwrap();
    names.map(|name| {
        let request = EnrollRequest::new(name.parse().unwrap(), now);
        Arc::new(fleet.issue(&request, &mut rng).unwrap())
    })
}

/// Splits an input into a selecting byte, a text with its length in front (16 bits, big-endian), and the remaining
/// bytes. The text ends early where it is not UTF-8. Returns `None` if the input is shorter than three bytes.
fn choice_text_bytes(input: &[u8]) -> Option<(u8, &str, &[u8])> {
    let [choice, high, low, rest @ ..] = input else { return None };
    let text_bytes = usize::from(u16::from_be_bytes([*high, *low])).min(rest.len());
    let (text, bytes) = rest.split_at(text_bytes);
    let text = match std::str::from_utf8(text) {
        Ok(text) => text,
        Err(error) => std::str::from_utf8(&text[..error.valid_up_to()]).unwrap_or_default(),
    };
    Some((*choice, text, bytes))
}
