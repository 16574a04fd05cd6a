//! A fleet for the time of a run.

use std::fs;
use std::io::Write as _;
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::Path;
use std::sync::Arc;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use anyhow::Result;
use rand_core::{OsRng, TryRngCore as _};
use sgc_trust::{EnrollRequest, Fleet, Identity};
use sgc_wire::{NodeId, Now, UnixMillis};

/// A fleet and what it needs to enrol.
pub(crate) struct BenchFleet(Fleet);

impl BenchFleet {
    pub(crate) fn new() -> Result<Self> {
        Ok(Self(Fleet::create("bench".parse()?, now().unix, &mut OsRng.unwrap_err())?))
    }

    /// An identity, with the default P-256 key.
    pub(crate) fn issue(&self, node: &str, router: bool) -> Result<Arc<Identity>> {
        let mut request = EnrollRequest::new(node.parse()?, now().unix);
        request.router = router;
        Ok(Arc::new(self.0.issue(&request, &mut OsRng.unwrap_err())?))
    }

    /// Writes the identity of a router where [`crate::process::SgcRouter`] looks for it.
    pub(crate) fn write_router(&self, dir: &Path) -> Result<()> {
        self.write(dir, "router", true)
    }

    /// Writes that of a router with another name to the same place. Returns its id.
    pub(crate) fn write_router_of(&self, dir: &Path, node: &str) -> Result<NodeId> {
        let identity = self.issue(node, true)?;
        write(&dir.join("router.identity"), &identity)?;
        Ok(identity.node_id())
    }

    /// Writes `NODE.identity`, as `sgc fleet enroll` does.
    pub(crate) fn write(&self, dir: &Path, node: &str, router: bool) -> Result<()> {
        write(&dir.join(format!("{node}.identity")), &*self.issue(node, router)?)
    }
}

fn write(path: &Path, identity: &Identity) -> Result<()> {
    let mut file = fs::OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    Ok(file.write_all(identity.to_text().as_bytes())?)
}

/// The present, by both clocks.
pub(crate) fn now() -> Now {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Now { instant: Instant::now(), unix: UnixMillis(unix.as_millis() as u64) }
}
