//! Trust that a node keeps over restarts: revocation lists, and its renewed credentials.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW, CaFingerprint, Identity, TrustAnchors, VerifiedPeer};
use sgc_wire::{CRL_BYTES_MAX, Credentials, Now};
use tokio::sync::{mpsc, watch};
use tracing::{debug, warn};

use crate::state;
use crate::state::run_lock::RunLock;

/// Folder of revocation lists in the state directory.
const CRL_DIR: &str = "crl";
/// Most files that are read: all lists of all CAs that can be trusted.
const CRL_FILES_MAX: usize = sgc_trust::ANCHORS_MAX * (sgc_trust::FLEET_LISTS_MAX + 1);
/// Bytes of a list's digest in the name of its file, to distinguish the lists of one CA.
const CRL_NAME_BYTES: usize = 8;
/// Divisor of a certificate's validity: it is renewed when a third is left.
const RENEW_PART: u64 = 3;
/// Shortest time between two requests for a certificate.
const RENEW_MIN: Duration = Duration::from_secs(60);

/// Adds the kept lists to `anchors`. An unreadable list is reported and skipped, since neighbours have it too.
pub(crate) fn with_kept_crls(dir: Option<&Path>, anchors: TrustAnchors, now: Now) -> TrustAnchors {
    let Some(dir) = dir.map(|d| d.join(CRL_DIR)) else { return anchors };
    let entries = match std::fs::read_dir(&dir) {
        Ok(entries) => entries,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return anchors,
        Err(error) => {
            warn!(path = %dir.display(), %error, "the revocation lists kept here cannot be read");
            return anchors;
        }
    };
    let mut anchors = anchors;
    for path in entries.filter_map(|e| Some(e.ok()?.path())).take(CRL_FILES_MAX) {
        let read = state::read(&path, CRL_BYTES_MAX as u64);
        match read.map(|der| der.map(|der| anchors.with_crl(&der, now.unix))) {
            Ok(Some(Ok(Some(more)))) => anchors = more,
            Ok(Some(Ok(None)) | None) => {}
            Ok(Some(Err(why))) => {
                warn!(path = %path.display(), %why, "a revocation list kept here is not believed")
            }
            Err(error) => warn!(path = %path.display(), %error, "a revocation list kept here cannot be read"),
        }
    }
    anchors
}

/// Writes state that outlives the process, always the newest version, off the control task.
pub(crate) struct StateWriter {
    anchors: watch::Sender<Option<Arc<TrustAnchors>>>,
    identity: watch::Sender<Option<Arc<Identity>>>,
    run_lock: RunLock,
}

impl StateWriter {
    /// Starts the tasks that write the state directory and the identity file. They end with this handle.
    pub(crate) fn spawn(
        dir: Option<PathBuf>,
        identity_file: PathBuf,
        run_lock: RunLock,
        alive: mpsc::Sender<()>,
    ) -> Self {
        let anchors = keep_newest(alive.clone(), move |anchors: &TrustAnchors| {
            if let Some(dir) = &dir {
                keep_crls(dir, anchors);
            }
        });
        let lock = run_lock.clone();
        let identity = keep_newest(alive, move |identity: &Identity| {
            keep_identity(&identity_file, identity);
            lock.follow();
        });
        Self { anchors, identity, run_lock }
    }

    /// Saves the revocation lists of these anchors.
    pub(crate) fn anchors(&self, anchors: Arc<TrustAnchors>) {
        self.anchors.send_replace(Some(anchors));
    }

    /// Saves this identity over the one that was read at start.
    pub(crate) fn identity(&self, identity: Arc<Identity>) {
        self.identity.send_replace(Some(identity));
    }
}

impl StateWriter {
    /// Locks the identity file that somebody put in the place of the one that was read at start.
    pub(crate) fn identity_file_replaced(&self) {
        self.run_lock.follow();
    }
}

/// Starts a task that writes the newest value on a blocking thread.
fn keep_newest<T: Send + Sync + 'static>(
    alive: mpsc::Sender<()>,
    write: impl Fn(&T) + Send + Sync + 'static,
) -> watch::Sender<Option<Arc<T>>> {
    let (give, mut given) = watch::channel(None::<Arc<T>>);
    let write = Arc::new(write);
    tokio::spawn(async move {
        let _alive = alive;
        while given.changed().await.is_ok() {
            let (write, newest) = (write.clone(), given.borrow_and_update().clone());
            let _ = tokio::task::spawn_blocking(move || newest.iter().for_each(|newest| write(newest))).await;
        }
    });
    give
}

/// Writes new lists first, and then removes outdated ones of the same CAs, so that the files never lose a revocation,
/// whenever the process ends.
fn keep_crls(dir: &Path, anchors: &TrustAnchors) {
    let dir = dir.join(CRL_DIR);
    let made = state::create_state_dir(&dir).map_err(|e| e.to_string());
    let mut kept = BTreeSet::new();
    let mut cas = BTreeSet::new();
    for (ca, digest, der) in anchors.crls_by_ca() {
        let file = crl_file_name(ca, &digest);
        let path = dir.join(&file);
        cas.insert(ca.to_string());
        kept.insert(file);
        if state::read(&path, CRL_BYTES_MAX as u64).is_ok_and(|there| there.as_deref() == Some(der)) {
            continue;
        }
        let written = made.clone().and_then(|()| state::replace(&path, der).map_err(|e| e.to_string()));
        if let Err(error) = written {
            warn!(path = %path.display(), %error, "a revocation list could not be kept for the next start");
            return;
        }
        debug!(path = %path.display(), "revocation list kept");
    }
    for entry in std::fs::read_dir(&dir).into_iter().flatten().flatten() {
        let file = entry.file_name().to_string_lossy().into_owned();
        let is_of_ca = file.split(['-', '.']).next().is_some_and(|ca| cas.contains(ca));
        if is_of_ca && file.ends_with(".crl") && !kept.contains(&file) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
}

/// Returns a stable file name that is unique to a CA and the content of a list.
fn crl_file_name(ca: &CaFingerprint, digest: &[u8; 32]) -> String {
    let digits: String = digest.iter().take(CRL_NAME_BYTES).map(|byte| format!("{byte:02x}")).collect();
    format!("{ca}-{digits}.crl")
}

fn keep_identity(file: &Path, identity: &Identity) {
    match state::replace(file, identity.to_text().as_bytes()) {
        Ok(()) => debug!(path = %file.display(), "renewed identity kept"),
        Err(error) => {
            warn!(path = %file.display(), %error, "the renewed identity could not be kept; it will be asked for again at the next start");
        }
    }
}

/// Returns the validity of a certificate in milliseconds. It excludes [`CLOCK_SKEW`], by which fleets start
/// certificates early: with it, short ones would be due at once.
pub(crate) fn lasts(peer: &VerifiedPeer) -> u64 {
    let whole = peer.not_after.0.saturating_sub(peer.not_before.0);
    let early = CLOCK_SKEW.as_millis() as u64;
    if whole > early { whole - early } else { whole }
}

/// Returns the time to ask for the next certificate: when a third of the validity is left.
pub(crate) fn renew_at(identity: &Identity, now: Now) -> Instant {
    let own = identity.as_peer();
    let due = own.not_after.0.saturating_sub(lasts(own) / RENEW_PART);
    now.instant + Duration::from_millis(due.saturating_sub(now.unix.0)).max(renewal_interval(own))
}

/// Returns the least time between two requests of a node: at most half of the validity that is left when a certificate
/// is due.
pub(crate) fn renewal_interval(peer: &VerifiedPeer) -> Duration {
    RENEW_MIN.min(Duration::from_millis(lasts(peer) / (2 * RENEW_PART)))
}

/// Returns `true` if less than a third of the certificate's validity is left.
pub(crate) fn is_due(peer: &VerifiedPeer, now: Now) -> bool {
    peer.not_after.0.saturating_sub(now.unix.0) < lasts(peer) / RENEW_PART
}

/// Returns the identity with the authority's answer; `None` if it has that already. An empty chain stands for the
/// node's present certificates.
pub(crate) fn renewed(
    identity: &Identity,
    mut credentials: Credentials,
) -> Result<Option<Identity>, sgc_trust::IdentityError> {
    if credentials.chain.is_empty() {
        credentials.chain = identity.chain_bytes();
    }
    let new = identity.with_credentials(&credentials)?;
    let generations = |i: &Identity| i.naming_secrets().iter().map(|s| s.generation).collect::<Vec<_>>();
    let same = new.chain() == identity.chain() && generations(&new) == generations(identity);
    Ok((!same).then_some(new))
}
