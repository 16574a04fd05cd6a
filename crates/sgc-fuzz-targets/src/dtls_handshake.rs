//! Whole DTLS handshakes with a hostile peer, in both roles and versions. An input is a script of alterations to the
//! peer's datagrams. Finds panics of `dimpl`, accepted strangers, and dialers that show a stranger their certificate.

use std::sync::LazyLock;

use sgc_transport::HandshakeExercise;

static EXERCISE: LazyLock<HandshakeExercise> = LazyLock::new(|| {
    let [one, other] = crate::members(["ours", "other"]);
    HandshakeExercise::new(one, other)
});

/// Runs one input of the target.
pub fn run(script: &[u8]) {
    EXERCISE.run(script);
}
