//! What a node keeps of trust over restarts: the revocation lists that it knows, and its own renewed credentials.

use std::collections::BTreeSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_trust::{CLOCK_SKEW, CaFingerprint, Identity, TrustAnchors, VerifiedPeer};
use sgc_wire::{CRL_BYTES_MAX, Credentials, Now};
use tokio::sync::{mpsc, watch};
use tracing::{debug, warn};

use crate::run_lock::RunLock;
use crate::state;

/// Where revocation lists are kept, below the state directory.
const CRL_DIR: &str = "crl";
/// Most files that are looked at: all lists of all CAs that can be trusted.
const CRL_FILES_MAX: usize = sgc_trust::ANCHORS_MAX * (sgc_trust::FLEET_LISTS_MAX + 1);
/// Bytes of a list's digest that are in the name of its file, to tell the lists of one CA apart.
const CRL_NAME_BYTES: usize = 8;
/// Part of a certificate's time that is left when it is renewed: a third.
const RENEW_PART: u64 = 3;
/// Shortest time between two requests for a certificate.
const RENEW_MIN: Duration = Duration::from_secs(60);

/// `anchors` with the lists that were kept. One that cannot be read is said and left out: neighbours have it too.
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

/// Writes what has to outlive the process, the newest only, off the control task.
pub(crate) struct StateWriter {
    anchors: watch::Sender<Option<Arc<TrustAnchors>>>,
    identity: watch::Sender<Option<Arc<Identity>>>,
}

impl StateWriter {
    /// Tasks that write into the state directory and over the identity file; they end with this handle.
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
        let identity = keep_newest(alive, move |identity: &Identity| {
            keep_identity(&identity_file, identity);
            run_lock.follow();
        });
        Self { anchors, identity }
    }

    /// Keeps the lists of these.
    pub(crate) fn anchors(&self, anchors: Arc<TrustAnchors>) {
        self.anchors.send_replace(Some(anchors));
    }

    /// Keeps this in place of the identity that was read at start.
    pub(crate) fn identity(&self, identity: Arc<Identity>) {
        self.identity.send_replace(Some(identity));
    }
}

/// A task that writes whatever it was given last, where that may block.
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

/// Writes the lists in force that are not on the disk yet, then removes those of the same CAs that are in force no more:
/// whenever the process ends, what is there says at least as much as before.
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

/// By CA and content, so that each of several lists has a name of its own, and always the same.
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

/// How long a certificate was made to hold, milliseconds. Fleets let theirs begin [`CLOCK_SKEW`] early, which is not of
/// that time: counted in, short ones would be due from their first moment on.
pub(crate) fn lasts(peer: &VerifiedPeer) -> u64 {
    let whole = peer.not_after.0.saturating_sub(peer.not_before.0);
    let early = CLOCK_SKEW.as_millis() as u64;
    if whole > early { whole - early } else { whole }
}

/// When to ask for the next certificate: when a third of the time of this one is left.
pub(crate) fn renew_at(identity: &Identity, now: Now) -> Instant {
    let own = identity.as_peer();
    let due = own.not_after.0.saturating_sub(lasts(own) / RENEW_PART);
    now.instant + Duration::from_millis(due.saturating_sub(now.unix.0)).max(renewal_interval(own))
}

/// Shortest time between two requests of a node for a certificate: at most half of the time that is left when one is
/// due.
pub(crate) fn renewal_interval(peer: &VerifiedPeer) -> Duration {
    RENEW_MIN.min(Duration::from_millis(lasts(peer) / (2 * RENEW_PART)))
}

/// True if a certificate that holds from and until then has less than a third of its time left.
pub(crate) fn is_due(peer: &VerifiedPeer, now: Now) -> bool {
    peer.not_after.0.saturating_sub(now.unix.0) < lasts(peer) / RENEW_PART
}

/// The identity with what its authority sent; `None` if that is what it has already. An empty chain stands for the
/// certificates that the node has.
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
