//! Whole DTLS handshakes with a hostile peer, in both roles and versions. An input is a script of what the peer's datagrams
//! go through. Shows panics of `dimpl`, strangers who are believed, and dialers that show a stranger their certificate.

use std::sync::{Arc, LazyLock};
use std::time::SystemTime;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_transport::HandshakeExercise;
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::UnixMillis;

static EXERCISE: LazyLock<HandshakeExercise> = LazyLock::new(|| {
    let now = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap();
    let now = UnixMillis(now.as_millis() as u64);
    let mut rng = ChaCha20Rng::seed_from_u64(1);
    let fleet = Fleet::create("acme".parse().unwrap(), now, &mut rng).unwrap();
    let mut member = |name: &str| -> Arc<Identity> {
        let request = EnrollRequest::new(name.parse().unwrap(), now);
        Arc::new(fleet.issue(&request, &mut rng).unwrap())
    };
    HandshakeExercise::new(member("ours"), member("other"))
});

/// Runs one input of the target.
pub fn run(script: &[u8]) {
    EXERCISE.run(script);
}
