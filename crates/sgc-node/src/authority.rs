//! What a fleet's authority does for members: looks them up in the fleet's file, and gives them certificates and
//! the secrets in use.

use std::path::Path;
use std::time::Duration;

use rand_core::{OsRng, TryRngCore};
use sgc_trust::{FleetError, VerifiedPeer};
use sgc_wire::{Credentials, Now, RefuseReason};
use tracing::{error, info, warn};

use crate::credentials::{is_due, lasts};
use crate::fleet_file::{FleetFileError, LockedFleet};

/// Shortest time for which a new certificate holds.
const VALID_MIN: Duration = Duration::from_secs(60);

/// Answers a member that asks for credentials; reads and writes files. A certificate that has time left is not
/// replaced: then the chain of the answer is empty. A new one holds for as long as the old one did.
pub(crate) fn answer(
    file: &Path,
    peer: &VerifiedPeer,
    csr: &[u8],
    now: Now,
) -> Result<Credentials, RefuseReason> {
    match try_answer(file, peer, csr, now) {
        Ok(credentials) => Ok(credentials),
        Err(Refusal::File(why)) => {
            error!(peer = %peer.node_id.short(), "cannot give credentials: {why}");
            Err(RefuseReason::Limit)
        }
        Err(Refusal::Fleet(why)) => {
            warn!(peer = %peer.node_id.short(), %why, "gives no credentials");
            Err(match why {
                FleetError::NodeRevoked { .. } => RefuseReason::Revoked,
                FleetError::UnknownNode { .. } => RefuseReason::NotPermitted,
                _ => RefuseReason::NotVerified,
            })
        }
    }
}

enum Refusal {
    File(FleetFileError),
    Fleet(FleetError),
}

impl From<FleetFileError> for Refusal {
    fn from(why: FleetFileError) -> Self {
        Self::File(why)
    }
}

impl From<FleetError> for Refusal {
    fn from(why: FleetError) -> Self {
        Self::Fleet(why)
    }
}

fn try_answer(file: &Path, peer: &VerifiedPeer, csr: &[u8], now: Now) -> Result<Credentials, Refusal> {
    let mut locked = LockedFleet::open(file)?;
    let unknown = || FleetError::UnknownNode { node: peer.pseudonym.short() };
    let node = locked.fleet.node_by_pseudonym(&peer.pseudonym).ok_or_else(unknown)?.name.clone();
    if !is_due(peer, now) {
        return Ok(locked.fleet.credentials_for(&node, Vec::new())?);
    }
    let valid = Duration::from_millis(lasts(peer)).max(VALID_MIN);
    let mut rng = OsRng.unwrap_err();
    let credentials = locked.fleet.renew_csr(csr, &peer.pseudonym, valid, now.unix, &mut rng)?;
    locked.save()?;
    info!(%node, "renewed its certificate");
    Ok(credentials)
}
