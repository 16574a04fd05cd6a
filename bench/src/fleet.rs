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
    pub(crate) fn write_router(&self, dir: &Path) -> Result<NodeId> {
        self.write(dir, "router", true)
    }

    /// Writes `NODE.identity`, as `sgc fleet enroll` does. Returns the node's id.
    pub(crate) fn write(&self, dir: &Path, node: &str, router: bool) -> Result<NodeId> {
        let mut options = fs::OpenOptions::new();
        let path = dir.join(format!("{node}.identity"));
        let mut file = options.write(true).create_new(true).mode(0o600).open(path)?;
        let identity = self.issue(node, router)?;
        file.write_all(identity.to_text().as_bytes())?;
        Ok(identity.node_id())
    }
}

/// The present, by both clocks.
pub(crate) fn now() -> Now {
    let unix = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    Now { instant: Instant::now(), unix: UnixMillis(unix.as_millis() as u64) }
}
