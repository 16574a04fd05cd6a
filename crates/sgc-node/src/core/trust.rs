//! Trust that changes while the node runs: its own credentials, those of members if it is the authority, and
//! revocations.

use std::path::Path;
use std::sync::Arc;

use sgc_ros::RosNetwork;
use sgc_transport::{CloseReason, Link as _};
use sgc_trust::{Identity, TrustAnchors, VerifiedPeer};
use sgc_wire::{Credentials, RefuseReason, SinkId};
use tracing::{info, warn};

use super::{Core, CoreEvent, now};
use crate::audit::{AuditEvent, AuditRecord};
use crate::authority;
use crate::credentials::{renew_at, renewed};

impl<N: RosNetwork> Core<N> {
    /// Asks the authority for what this node needs, if its identity names one or it is the authority itself.
    pub(super) fn ask_renewal(&mut self) {
        let now = now();
        let asked = if self.authority.is_some() {
            self.renew_own();
            true
        } else {
            self.endpoint.renew(now, self.identity.csr().into())
        };
        if asked {
            self.renew_due = Some(renew_at(&self.identity, now));
        }
    }

    /// Looks a member up in the fleet's file.
    pub(super) fn answer_renewal(&self, sink: SinkId, peer: VerifiedPeer, csr: bytes::Bytes) {
        self.look_up(move |file| {
            let answer = authority::answer(file, &peer, &csr, now());
            CoreEvent::RenewalReady { sink, answer }
        });
    }

    /// Looks this authority itself up: no way leads from a node to itself.
    fn renew_own(&self) {
        let identity = self.identity.clone();
        self.look_up(move |file| {
            CoreEvent::OwnRenewal(authority::answer(file, identity.as_peer(), &identity.csr(), now()))
        });
    }

    /// Reads the fleet's file where that may block; nothing if this node is not the authority.
    fn look_up(&self, read: impl FnOnce(&Path) -> CoreEvent + Send + 'static) {
        let (Some(file), Some(events)) = (self.authority.clone(), self.events.upgrade()) else { return };
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let _ = events.blocking_send(read(&file));
        });
    }

    pub(super) fn own_renewal(&mut self, answer: Result<Credentials, RefuseReason>) {
        match answer {
            Ok(credentials) => self.take_credentials(credentials),
            Err(reason) => {
                if self.control_drops.count("renewal_refused") {
                    warn!(%reason, "the fleet's file has no credentials for this node; asking again later");
                }
            }
        }
    }

    /// Gives a member what the fleet's file says.
    pub(super) fn give_credentials(&mut self, sink: SinkId, answer: Result<Credentials, RefuseReason>) {
        let peer = self.endpoint.renewing().find(|(id, ..)| *id == sink).map(|(_, peer, _)| peer.node_id);
        if let Some(peer) = peer {
            let record = |event| AuditRecord::new(event).peer(&peer);
            match &answer {
                Ok(credentials) if credentials.chain.is_empty() => {}
                Ok(_) => self.audit.write(record(AuditEvent::Renewed)),
                Err(reason) => self.audit.write(record(AuditEvent::Refused).reason(reason)),
            }
        }
        self.endpoint.answer_renewal(now(), sink, answer);
    }

    /// Closes the links of nodes that came and may attach no more.
    pub(super) fn close_not_admitted(&mut self) {
        for (link, entry) in &mut self.links {
            let peer = entry.link.peer();
            if entry.url.is_none() && !self.credentials.admits(peer) {
                let why = CloseReason::not_admitted();
                info!(%link, peer = %peer.node_id.short(), "{why}; its link is closed");
                entry.closed_for = Some(why.to_string());
                entry.link.close(why);
            }
        }
    }

    /// Answers every member once more: the fleet's file may have changed.
    pub(super) fn answer_renewals(&self) {
        let asked: Vec<_> = self.endpoint.renewing().map(|(s, p, csr)| (s, p.clone(), csr.clone())).collect();
        for (sink, peer, csr) in asked {
            self.answer_renewal(sink, peer, csr);
        }
        self.renew_own();
    }

    pub(super) fn take_credentials(&mut self, credentials: Credentials) {
        match renewed(&self.identity, credentials) {
            Ok(None) => {}
            Ok(Some(identity)) => {
                let identity = Arc::new(identity);
                info!(until = %identity.not_after(), "the fleet's authority sent new credentials");
                let until = format!("this node's own, until {}", identity.not_after());
                self.audit.write(AuditRecord::new(AuditEvent::Renewed).reason(until));
                self.keeper.identity(identity.clone());
                self.set_identity(identity);
            }
            Err(why) => {
                warn!(%why, "credentials from the fleet's authority are not usable");
                self.control_drops.count("credentials_unusable");
            }
        }
    }

    /// Is this from here on: with another certificate, or other secrets for names made later.
    pub(super) fn set_identity(&mut self, identity: Arc<Identity>) {
        let now = now();
        // A link shows a certificate and no secret: it stays if that is the same.
        let shows_another = self.identity.chain() != identity.chain();
        self.identity = identity.clone();
        self.renew_due = Some(renew_at(&identity, now));
        if let (Some(routes), Some(newest)) = (&mut self.routes, identity.naming_secrets().first()) {
            routes.set_secret(newest.secret.clone());
        }
        self.credentials.set_identity(identity.clone());
        self.router.set_identity(now, identity.clone());
        self.endpoint.set_identity(now, identity);
        if shows_another {
            self.redial.send_replace(());
        }
    }

    /// Trusts these CAs from here on and no others; what they have revoked stays so.
    pub(super) fn trust(&mut self, anchors: TrustAnchors) {
        let anchors = Arc::new(anchors.with_lists_of(&self.credentials.anchors()));
        self.router.set_anchors(now(), anchors.clone());
        self.set_anchors(anchors);
    }

    /// Believes others from here on, everywhere.
    pub(super) fn set_anchors(&mut self, anchors: Arc<TrustAnchors>) {
        self.keeper.anchors(anchors.clone());
        self.credentials.set_anchors(TrustAnchors::clone(&anchors));
        self.gateway.set_anchors(&anchors);
        self.endpoint.set_anchors(now(), anchors);
    }
}
