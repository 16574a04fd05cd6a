//! What a running node shows of itself and whom it believes, both of which change while it runs.
//!
//! One store is shared by everything that makes links. Each handshake reads it afresh, so a renewed certificate is
//! shown by the next link and a list of revoked ones counts from the next certificate that comes. Links that are up
//! are not touched: which of them have to go, and when to ask, is for the node that holds them
//! ([`CredentialStore::objection`]).

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
    /// The CAs whose nodes may attach; all that are believed if there is nothing.
    admitted: ArcSwapOption<BTreeSet<CaFingerprint>>,
}

impl CredentialStore {
    /// With this identity and the CAs that it brings.
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

    /// Shows another certificate from the next handshake on. Whom this node believes stays as it is: an identity file
    /// holds CAs and no revocations, so taking them from there would forget those.
    pub fn set_identity(&self, identity: Arc<Identity>) {
        self.shared.identity.store(identity);
    }

    /// Believes others from the next certificate on, also in handshakes that are under way. A link may have passed the
    /// check just before: ask [`CredentialStore::objection`] of every link afterwards, and of each new one.
    pub fn set_anchors(&self, anchors: TrustAnchors) {
        self.shared.anchors.store(Arc::new(anchors));
    }

    /// Lets only nodes of these CAs attach to listeners from the next certificate on; `None` is every CA that is
    /// believed. Whom this node dials is not restricted by it. For links that are up: [`CredentialStore::admits`].
    pub fn set_admitted(&self, admitted: Option<BTreeSet<CaFingerprint>>) {
        self.shared.admitted.store(admitted.map(Arc::new));
    }

    /// Whether this peer may attach to a listener of this node.
    pub fn admits(&self, peer: &VerifiedPeer) -> bool {
        self.shared.admitted.load().as_ref().is_none_or(|admitted| admitted.contains(&peer.ca))
    }

    /// What is shown now.
    pub fn identity(&self) -> Arc<Identity> {
        self.shared.identity.load_full()
    }

    /// Who is believed now.
    pub fn anchors(&self) -> Arc<TrustAnchors> {
        self.shared.anchors.load_full()
    }

    /// Why a peer that was let in would not be let in again at the time `now`: what its link is to be closed with.
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
