//! [`Certificates`]: the identity of this node and its trust anchors, where links and gateway take them from, and the
//! time at which the identity is renewed.
//!
//! The machines have copies, which the control task replaces. [`crate::control::fleet::authority`] issues certificates.

use std::sync::Arc;
use std::time::Instant;

use sgc_transport::{CloseReason, CredentialStore};
use sgc_trust::{Identity, IdentityError, TrustAnchors, VerifiedPeer};
use sgc_wire::{Credentials, Now, UnixMillis};
use tokio::sync::watch;

use crate::control::faults::alerts::{Alert, clock_alert};
use crate::gateway::Gateway;
use crate::node::identity::is_older;
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
    /// Whether the certificate is not valid by the clock.
    is_out_of_time: bool,
}

/// A change of the clock, or of the certificate, that matters to this node's links.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Validity {
    /// The certificate holds again.
    Holds,
    /// It does so no longer.
    Lost(Alert),
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
        let is_out_of_time = clock_alert(&identity, now).is_some();
        Self { identity, store, gateway, keeper, redial, renew_due: None, is_out_of_time }
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

    /// Returns a change of the certificate's validity by the clock, once.
    pub(crate) fn validity_change(&mut self, now: UnixMillis) -> Option<Validity> {
        let alert = clock_alert(&self.identity, now);
        if alert.is_some() == self.is_out_of_time {
            return None;
        }
        self.is_out_of_time = alert.is_some();
        Some(alert.map_or(Validity::Holds, Validity::Lost))
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
        self.switch(now, identity.clone());
        Ok(Some(identity))
    }

    /// Switches to the identity that the replaced file of this node holds. Returns `false` if the authority has sent a
    /// newer one meanwhile.
    pub(crate) fn adopt(&mut self, now: Now, identity: &Arc<Identity>) -> bool {
        if is_older(identity, &self.identity) {
            return false;
        }
        self.keeper.identity_file_replaced();
        self.switch(now, identity.clone());
        true
    }

    fn switch(&mut self, now: Now, identity: Arc<Identity>) {
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
    }

    /// Replaces the trust anchors, and saves their revocation lists.
    pub(crate) fn set_anchors(&self, anchors: &Arc<TrustAnchors>) {
        self.keeper.anchors(anchors.clone());
        self.store.set_anchors(TrustAnchors::clone(anchors));
        self.gateway.set_anchors(anchors);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use rand_chacha::ChaCha20Rng;
    use rand_chacha::rand_core::SeedableRng as _;
    use sgc_gateway::ShippedDefinitions;
    use sgc_trust::{EnrollRequest, Fleet};
    use tokio::sync::mpsc;

    use super::*;
    use crate::state::run_lock::RunLock;

    const BEGIN: UnixMillis = UnixMillis(1_795_000_000_000);
    const DAY: Duration = Duration::from_secs(86_400);

    /// The certificates of a node of this fleet, beside what takes them over.
    struct Bench {
        fleet: Fleet,
        rng: ChaCha20Rng,
        first: Arc<Identity>,
        certificates: Certificates,
        store: CredentialStore,
        redialled: watch::Receiver<()>,
        start: Instant,
        _dir: tempfile::TempDir,
    }

    impl Bench {
        /// Creates a node whose certificate begins at [`BEGIN`] and that starts as much later or earlier.
        async fn new(now: UnixMillis) -> Self {
            let mut rng = ChaCha20Rng::seed_from_u64(8);
            let mut fleet = Fleet::create("lab".parse().unwrap(), BEGIN, &mut rng).unwrap();
            let first = fleet.enroll(&EnrollRequest::new("arm".parse().unwrap(), BEGIN), &mut rng).unwrap();
            let (first, dir) = (Arc::new(first), tempfile::tempdir().unwrap());
            let file = dir.path().join("arm.identity");
            std::fs::write(&file, first.to_text().as_bytes()).unwrap();
            let run_lock = RunLock::take(&file, None, first.node_id()).await.unwrap();
            let keeper = StateWriter::spawn(None, file, run_lock, mpsc::channel(1).0);
            let store = CredentialStore::new(first.clone());
            let gateway = Gateway::new(None, "arm", ShippedDefinitions);
            let (redial, redialled) = watch::channel(());
            let certificates = Certificates::new(first.clone(), store.clone(), gateway, keeper, redial, now);
            Self { fleet, rng, first, certificates, store, redialled, start: Instant::now(), _dir: dir }
        }

        fn at(&self, since: Duration) -> Now {
            let unix = UnixMillis(BEGIN.0 + since.as_millis() as u64);
            Now { unix, instant: self.start + since }
        }

        /// Returns credentials with another certificate for the node's key.
        fn another(&mut self, since: Duration) -> Credentials {
            let now = self.at(since).unix;
            let (csr, pseudonym) = (self.first.csr(), self.first.pseudonym());
            self.fleet.renew_csr(&csr, &pseudonym, 30 * DAY, now, &mut self.rng).unwrap()
        }
    }

    #[tokio::test]
    async fn certificate_that_holds_or_not_by_the_clock_is_reported_at_each_change() {
        let identity = Bench::new(BEGIN).await.first;
        let (begin, end) = (identity.as_peer().not_before, identity.not_after());
        let (early, late) = (UnixMillis(begin.0 - 1), UnixMillis(end.0 + 1));
        let mut certificates = Bench::new(early).await.certificates;
        assert_eq!(certificates.validity_change(early), None, "it was so at the start");
        assert_eq!(certificates.validity_change(begin), Some(Validity::Holds));
        assert_eq!(certificates.validity_change(end), None);
        let lost = certificates.validity_change(late);
        assert!(matches!(lost, Some(Validity::Lost(Alert::CertificateOver { .. }))), "{lost:?}");
        assert_eq!(certificates.validity_change(late), None);
        let lost = Bench::new(begin).await.certificates.validity_change(early);
        assert!(matches!(lost, Some(Validity::Lost(Alert::ClockBeforeCertificate { .. }))), "{lost:?}");
    }

    #[tokio::test]
    async fn renewal_is_due_once_and_only_after_credentials_were_asked_for() {
        let mut bench = Bench::new(BEGIN).await;
        let certificates = &mut bench.certificates;
        assert_eq!(certificates.deadline(), None);
        assert!(!certificates.take_renewal_due(bench.start + 10_000 * DAY));
        let now = Now { unix: BEGIN, instant: bench.start };
        certificates.renewal_asked(now);
        let due = certificates.deadline().unwrap();
        assert_eq!(due, renew_at(&bench.first, now));
        assert!(!certificates.take_renewal_due(due - Duration::from_millis(1)));
        assert!(certificates.take_renewal_due(due) && !certificates.take_renewal_due(due));
        assert_eq!(certificates.deadline(), None);
    }

    #[tokio::test]
    async fn another_certificate_is_shown_by_new_links_and_the_same_one_changes_nothing() {
        let mut bench = Bench::new(BEGIN).await;
        let credentials = bench.another(DAY);
        let now = bench.at(DAY);
        let renewed = bench.certificates.renew(now, credentials.clone()).unwrap().unwrap();
        assert_ne!(renewed.chain(), bench.first.chain());
        for shown in [bench.certificates.identity(), &bench.store.identity()] {
            assert_eq!(shown.chain(), renewed.chain());
        }
        assert!(bench.redialled.has_changed().unwrap());
        assert_eq!(bench.certificates.deadline(), Some(renew_at(&renewed, now)));
        bench.redialled.mark_unchanged();
        assert!(bench.certificates.renew(bench.at(2 * DAY), credentials).unwrap().is_none());
        assert!(!bench.redialled.has_changed().unwrap());
        assert_eq!(bench.certificates.deadline(), Some(renew_at(&renewed, now)), "nothing was renewed");
    }

    #[tokio::test]
    async fn secret_for_later_names_is_taken_over_without_another_link() {
        let mut bench = Bench::new(BEGIN).await;
        let now = bench.at(DAY);
        bench.fleet.rotate_secret(now.unix, &mut bench.rng).unwrap();
        let node = bench.first.node_name().clone();
        let credentials = bench.fleet.credentials_for(&node, Vec::new()).unwrap();
        let renewed = bench.certificates.renew(now, credentials).unwrap().unwrap();
        assert_eq!(renewed.chain(), bench.first.chain());
        assert_eq!(renewed.naming_secrets().len(), bench.first.naming_secrets().len() + 1);
        assert!(!bench.redialled.has_changed().unwrap(), "links show the certificate only");
    }

    #[tokio::test]
    async fn credentials_of_another_node_are_refused() {
        let mut bench = Bench::new(BEGIN).await;
        let request = EnrollRequest::new("desk".parse().unwrap(), BEGIN);
        let desk = bench.fleet.enroll(&request, &mut bench.rng).unwrap();
        let (chain, secrets) = (desk.chain_bytes(), bench.another(DAY).secrets);
        assert!(bench.certificates.renew(bench.at(DAY), Credentials { chain, secrets }).is_err());
        assert!(Arc::ptr_eq(bench.certificates.identity(), &bench.first));
        assert!(!bench.redialled.has_changed().unwrap());
    }

    #[tokio::test]
    async fn peer_of_a_ca_that_is_no_longer_trusted_is_objected_to() {
        let mut bench = Bench::new(BEGIN).await;
        let partner = Fleet::create("partner".parse().unwrap(), BEGIN, &mut bench.rng).unwrap();
        let peer = bench.first.as_peer().clone();
        let objection = |bench: &Bench, at| bench.certificates.objection(&peer, at);
        assert_eq!(objection(&bench, BEGIN), None);
        let over = UnixMillis(peer.not_after.0 + 1000);
        assert_eq!(objection(&bench, over), Some(CloseReason::Expired));
        bench.certificates.set_anchors(&Arc::new(partner.anchors().clone()));
        assert!(matches!(objection(&bench, BEGIN), Some(CloseReason::Denied(_))));
        assert_eq!(bench.certificates.anchors().crls().count(), 0);
    }
}
