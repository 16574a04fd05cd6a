//! Whole conversations with the front door of stream links (TLS, TCP, WebSocket). The first byte of an input chooses scheme and
//! role: what a stranger says, what a member says inside of its TLS, or what becomes of the bytes between two honest ends. Shows
//! panics of `rustls` and of the upgrade, strangers who get a link, and frames that were altered and are believed.

use std::sync::{Arc, LazyLock};
use std::time::SystemTime;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_transport::DoorExercise;
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;

static EXERCISE: LazyLock<DoorExercise> = LazyLock::new(|| {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let now = UnixMillis(now.as_millis() as u64);
    let mut rng = ChaCha20Rng::seed_from_u64(1);
    let fleet = Fleet::create("acme".parse().unwrap(), now, &mut rng).unwrap();
    let mut member = |name: &str| -> Arc<Identity> {
        let request = EnrollRequest::new(name.parse().unwrap(), now);
        Arc::new(fleet.issue(&request, &mut rng).unwrap())
    };
    DoorExercise::new(member("router"), member("arm"))
});

/// Runs one input of the target.
pub fn run(script: &[u8]) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().unwrap();
    runtime.block_on(EXERCISE.run(script));
}
