//! Whole conversations with the front door of stream links (TLS, TCP, WebSocket). The first byte of an input chooses scheme and
//! role: what a stranger says, what a member says inside of its TLS, or what becomes of the bytes between two honest ends. Shows
//! panics of `rustls` and of the upgrade, strangers who get a link, and frames that were altered and are believed.

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
