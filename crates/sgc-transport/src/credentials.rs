//! A running node's own certificate and the CAs that it trusts, both of which change while it runs.
//!
//! Everything that makes links shares one store. Each handshake reads it afresh, so the next link shows a renewed
//! certificate, and a new revocation list counts from the next certificate on. The store does not touch links that are
//! up: the node decides which of them to close, and when to ask ([`CredentialStore::objection`]).

use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;

use arc_swap::{ArcSwap, ArcSwapOption};
use sgc_trust::{CaFingerprint, Identity, TrustAnchors, VerifiedPeer};
use sgc_wire::UnixMillis;

use crate::error::CloseReason;

/// The certificate and key of this node and the CAs that it trusts. Clones share.
#[derive(Clone)]
pub struct CredentialStore {
    shared: Arc<CurrentCredentials>,
}

struct CurrentCredentials {
    identity: ArcSwap<Identity>,
    anchors: ArcSwap<TrustAnchors>,
    /// The CAs whose nodes may attach; `None` stands for all trusted ones.
    admitted: ArcSwapOption<BTreeSet<CaFingerprint>>,
}

impl CredentialStore {
    /// Returns a store with this identity and its CAs.
    pub fn new(identity: Arc<Identity>) -> Self {
        let anchors = ArcSwap::from_pointee(identity.anchors().clone());
        Self {
            shared: Arc::new(CurrentCredentials {
                identity: ArcSwap::new(identity),
                anchors,
                admitted: ArcSwapOption::empty(),
            }),
        }
    }

    /// Shows another certificate from the next handshake on. The trust anchors stay: an identity file holds CAs and no
    /// revocations, so anchors from the file would forget the revocations.
    pub fn set_identity(&self, identity: Arc<Identity>) {
        self.shared.identity.store(identity);
    }

    /// Replaces the trust anchors from the next certificate on, also in running handshakes. A link may have passed the
    /// check just before: ask [`CredentialStore::objection`] of every link afterwards, and of each new one.
    pub fn set_anchors(&self, anchors: TrustAnchors) {
        self.shared.anchors.store(Arc::new(anchors));
    }

    /// Lets only nodes of these CAs attach to listeners from the next certificate on; `None` stands for every trusted
    /// CA. It does not restrict dialling. For links that are up: [`CredentialStore::admits`].
    pub fn set_admitted(&self, admitted: Option<BTreeSet<CaFingerprint>>) {
        self.shared.admitted.store(admitted.map(Arc::new));
    }

    /// Returns whether this peer may attach to a listener of this node.
    pub fn admits(&self, peer: &VerifiedPeer) -> bool {
        self.shared.admitted.load().as_ref().is_none_or(|admitted| admitted.contains(&peer.ca))
    }

    /// Returns the present identity.
    pub fn identity(&self) -> Arc<Identity> {
        self.shared.identity.load_full()
    }

    /// Returns the present trust anchors.
    pub fn anchors(&self) -> Arc<TrustAnchors> {
        self.shared.anchors.load_full()
    }

    /// Returns the reason for closing a peer's link, if the peer would not be let in again at the time `now`.
    pub fn objection(&self, peer: &VerifiedPeer, now: UnixMillis) -> Option<CloseReason> {
        let anchors = self.shared.anchors.load();
        if anchors.is_peer_revoked(peer) {
            Some(CloseReason::Revoked)
        } else if now.secs() > peer.not_after.secs() {
            Some(CloseReason::Expired)
        } else if anchors.ca_spki(&peer.ca).is_none() {
            Some(CloseReason::Denied("its CA is no longer trusted here".into()))
        } else {
            None
        }
    }
}

impl From<Arc<Identity>> for CredentialStore {
    fn from(identity: Arc<Identity>) -> Self {
        Self::new(identity)
    }
}

impl fmt::Debug for CredentialStore {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("CredentialStore")
            .field("identity", &self.shared.identity.load())
            .field("anchors", &self.shared.anchors.load())
            .finish()
    }
}
