//! [`Certificates`]: the identity of this node and its trust anchors, where links and gateway take them from, and the
//! time at which the identity is renewed.
//!
//! The machines have copies, which the control task replaces. [`crate::control::authority`] issues certificates.

use std::sync::Arc;
use std::time::Instant;

use sgc_transport::{CloseReason, CredentialStore};
use sgc_trust::{Identity, IdentityError, TrustAnchors, VerifiedPeer};
use sgc_wire::{Credentials, Now, UnixMillis};
use tokio::sync::watch;

use crate::control::alerts::clock_alert;
use crate::gateway::Gateway;
use crate::state::credentials::{StateWriter, renew_at, renewed};

/// This node's certificates, and those that it trusts.
pub(crate) struct Certificates {
    identity: Arc<Identity>,
    /// Credentials of links.
    store: CredentialStore,
    /// Its client certificates follow the trust anchors.
    gateway: Arc<Gateway>,
    keeper: StateWriter,
    /// Notifies the dialling tasks of a new certificate.
    redial: watch::Sender<()>,
    /// Time of the next request for renewal.
    renew_due: Option<Instant>,
    /// Whether the clock is still before the start of this node's certificate.
    awaits_clock: bool,
}

impl Certificates {
    /// Creates the part at the time `now`.
    pub(crate) fn new(
        identity: Arc<Identity>,
        store: CredentialStore,
        gateway: Arc<Gateway>,
        keeper: StateWriter,
        redial: watch::Sender<()>,
        now: UnixMillis,
    ) -> Self {
        let awaits_clock = clock_alert(&identity, now).is_some();
        Self { identity, store, gateway, keeper, redial, renew_due: None, awaits_clock }
    }

    pub(crate) fn identity(&self) -> &Arc<Identity> {
        &self.identity
    }

    pub(crate) fn anchors(&self) -> Arc<TrustAnchors> {
        self.store.anchors()
    }

    /// Returns `true` if the peer may attach to this node.
    pub(crate) fn admits(&self, peer: &VerifiedPeer) -> bool {
        self.store.admits(peer)
    }

    /// Returns the reason not to have a link with the peer, if there is one.
    pub(crate) fn objection(&self, peer: &VerifiedPeer, now: UnixMillis) -> Option<CloseReason> {
        self.store.objection(peer, now)
    }

    /// Returns `true` once, when the clock has reached the beginning of this node's certificate.
    pub(crate) fn clock_has_come(&mut self, now: UnixMillis) -> bool {
        let has_come = self.awaits_clock && clock_alert(&self.identity, now).is_none();
        self.awaits_clock &= !has_come;
        has_come
    }

    /// Notes that new credentials were asked for. They are asked for again when the certificate is due.
    pub(crate) fn renewal_asked(&mut self, now: Now) {
        self.renew_due = Some(renew_at(&self.identity, now));
    }

    /// Returns `true` once, when new credentials are to be asked for.
    pub(crate) fn take_renewal_due(&mut self, now: Instant) -> bool {
        self.renew_due.take_if(|at| *at <= now).is_some()
    }

    /// Returns the time of the next request for renewal.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.renew_due
    }

    /// Switches to the identity that follows from credentials, with another certificate or with secrets for later
    /// names, and saves it. Returns it; `None` if the credentials bring nothing new.
    pub(crate) fn renew(
        &mut self,
        now: Now,
        credentials: Credentials,
    ) -> Result<Option<Arc<Identity>>, IdentityError> {
        let Some(identity) = renewed(&self.identity, credentials)?.map(Arc::new) else { return Ok(None) };
        self.keeper.identity(identity.clone());
        // A link shows the certificate only, so it stays if the certificate is the same.
        let shows_another = self.identity.chain() != identity.chain();
        self.identity = identity.clone();
        self.renewal_asked(now);
        self.store.set_identity(identity.clone());
        // The gateway reads the current identity itself at a reload.
        self.gateway.set_identity(&identity);
        if shows_another {
            self.redial.send_replace(());
        }
        Ok(Some(identity))
    }

    /// Replaces the trust anchors, and saves their revocation lists.
    pub(crate) fn set_anchors(&self, anchors: &Arc<TrustAnchors>) {
        self.keeper.anchors(anchors.clone());
        self.store.set_anchors(TrustAnchors::clone(anchors));
        self.gateway.set_anchors(anchors);
    }
}
