//! Whole conversations with the front door of stream links (TLS, TCP, WebSocket). The first byte of an input selects
//! scheme and role: bytes of a stranger, bytes of a member inside its TLS, or alterations between two honest ends.
//! Finds panics of `rustls` and of the upgrade, strangers that get a link, and altered frames that are accepted.

use std::sync::LazyLock;

use sgc_transport::DoorExercise;

static EXERCISE: LazyLock<DoorExercise> = LazyLock::new(|| {
    let [one, other] = crate::members(["router", "arm"]);
    DoorExercise::new(one, other)
});

/// Runs one input of the target.
pub fn run(script: &[u8]) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    runtime.block_on(EXERCISE.run(script));
}
