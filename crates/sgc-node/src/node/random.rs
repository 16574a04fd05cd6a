//! The generator from which all others of a node are seeded.

use rand_chacha::ChaCha20Rng;
use rand_core::{OsRng, SeedableRng, TryRngCore};

use crate::node::error::NodeError;

/// Returns a generator that the system seeds.
pub(crate) fn system_rng() -> Result<ChaCha20Rng, NodeError> {
    let mut seed = [0; 32];
    OsRng.try_fill_bytes(&mut seed).map_err(|e| NodeError::Randomness(e.to_string()))?;
    Ok(ChaCha20Rng::from_seed(seed))
}
