//! Randomness and time of the system.

use std::time::{SystemTime, UNIX_EPOCH};

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng, TryRngCore};
use sgc_wire::UnixMillis;
use zeroize::Zeroize;

use crate::error::ProcessError;

/// Returns a random generator, seeded by the system.
pub fn system_rng() -> Result<ChaCha20Rng, ProcessError> {
    let mut seed = [0; 32];
    OsRng.try_fill_bytes(&mut seed).map_err(|e| ProcessError::System {
        what: "the system gives no randomness",
        source: std::io::Error::other(e.to_string()),
    })?;
    let rng = ChaCha20Rng::from_seed(seed);
    seed.zeroize();
    Ok(rng)
}

/// Returns the time, for certificates.
pub fn unix_now() -> UnixMillis {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    UnixMillis(u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}
