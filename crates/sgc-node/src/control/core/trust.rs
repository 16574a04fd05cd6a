//! Trust that changes while the node runs: its own credentials, revocations, and as an authority the credentials of
//! members.

use std::sync::Arc;

use bytes::Bytes;
use sgc_ros::RosNetwork;
use sgc_transport::CloseReason;
use sgc_trust::{CrlError, Identity, TrustAnchors, VerifiedPeer};
use sgc_wire::{Credentials, Now, RefuseReason, SinkId};
use tracing::{info, warn};

use super::Core;
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::fleet::authority::{Asker, DeskAnswers, RenewalAnswer, RenewalRefusal, RenewalRequest};
use crate::control::parts::link_table::LinkEntry;
use crate::drops::NodeDrop;
use crate::state::audit::{AuditEvent, AuditRecord};

impl<N: RosNetwork> Core<N> {
    /// Adds a revocation list of a user. Returns whether it is new, and the lists that were in force before.
    pub(super) fn add_crl(&mut self, der: &bytes::Bytes) -> Result<(bool, Vec<bytes::Bytes>), CrlError> {
        let taken = self.router.add_crl(now(), der);
        let record = AuditRecord::new(AuditEvent::Crl).by_user();
        match &taken {
            // The list is logged where it comes into force.
            Ok(true) => {}
            Ok(false) => self.audit.write(record.reason("known already")),
            Err(why) => self.audit.write(record.reason(format!("refused: {why}"))),
        }
        let lists = self.certificates.anchors().crls().cloned().collect();
        taken.map(|is_news| (is_news, lists))
    }

    /// Asks the authority for credentials, if the identity names one or this node is the authority.
    pub(super) fn ask_renewal(&mut self) {
        let now = now();
        // An invitation is not renewed.
        if self.certificates.identity().as_peer().invitation.is_some() {
            return;
        }
        let asked = if self.authority.is_some() {
            self.renew_own();
            true
        } else {
            self.endpoint.renew(now, self.certificates.identity().csr().into())
        };
        if asked {
            self.certificates.renewal_asked(now);
        }
    }

    /// Queues a member's request for the fleet file.
    pub(super) fn answer_renewal(&mut self, sink: SinkId, peer: VerifiedPeer, csr: Bytes) {
        self.queue_renewal(RenewalRequest { asker: Asker::Member(sink), peer, csr });
        self.answer_next_batch();
    }

    /// Queues this authority's own request, since no route leads from a node to itself.
    fn renew_own(&mut self) {
        let (peer, csr) =
            (self.certificates.identity().as_peer().clone(), self.certificates.identity().csr().into());
        self.queue_renewal(RenewalRequest { asker: Asker::Own, peer, csr });
        self.answer_next_batch();
    }

    fn queue_renewal(&mut self, request: RenewalRequest) {
        let (asker, node) = (request.asker, request.peer.node_id);
        let queued = self.authority.as_mut().map_or(Ok(()), |authority| authority.push_renewal(request));
        if let Err(why) = queued {
            self.renewal_ready(RenewalAnswer { asker, node, answer: Err(why) });
        }
    }

    /// Answers the waiting requests on a blocking thread, unless a batch is under way.
    pub(super) fn answer_next_batch(&mut self) {
        let (Some(authority), Some(events)) = (&mut self.authority, self.events.upgrade()) else { return };
        let Some(job) = authority.next_job() else { return };
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let _ = events.blocking_send(CoreEvent::DeskAnswered(job(now())));
        });
    }

    /// Records the revocations of these lists in the fleet file, if this node is the authority.
    pub(super) fn catch_up_file(&self, anchors: Arc<TrustAnchors>) {
        let Some(job) = self.authority.as_ref().map(|authority| authority.catch_up_job(anchors)) else {
            return;
        };
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            job(now());
        });
    }

    /// Sends the answers of a batch.
    pub(super) fn desk_answered(&mut self, answers: DeskAnswers) {
        let DeskAnswers { renewals, operations } = answers;
        operations.into_iter().for_each(|done| self.operation_done(done));
        renewals.into_iter().for_each(|answer| self.renewal_ready(answer));
        if let Some(authority) = &mut self.authority {
            authority.end_batch();
        }
        self.answer_next_batch();
    }

    fn renewal_ready(&mut self, RenewalAnswer { asker, node, answer }: RenewalAnswer) {
        if let Err(why) = &answer
            && self.control_drops.count_from(why.counter(), node)
        {
            warn!(peer = self.names.called(&node), %why, "refused credentials; counted from here on");
        }
        if answer.is_ok()
            && let Some(authority) = &mut self.authority
        {
            authority.note_seen([node], now().unix);
        }
        let answer = answer.map_err(RenewalRefusal::refuse_reason);
        match asker {
            Asker::Own => self.own_renewal(answer),
            Asker::Member(sink) => self.give_credentials(sink, answer),
        }
    }

    fn own_renewal(&mut self, answer: Result<Credentials, RefuseReason>) {
        match answer {
            Ok(credentials) => self.take_credentials(credentials),
            Err(reason) => {
                if self.control_drops.count(NodeDrop::RenewalRefused) {
                    warn!(%reason, "the fleet's file has no credentials for this node; asking again later");
                }
            }
        }
    }

    /// Sends a member its credentials, or a refusal.
    fn give_credentials(&mut self, sink: SinkId, answer: Result<Credentials, RefuseReason>) {
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

    /// Closes incoming links of nodes that may no longer attach.
    pub(super) fn close_not_admitted(&mut self) {
        let is_refused = |entry: &LinkEntry| entry.url().is_none() && !self.certificates.admits(entry.peer());
        let refused = self.links.iter().filter(|(_, entry)| is_refused(entry));
        let refused: Vec<_> = refused.map(|(link, entry)| (link, entry.peer().node_id)).collect();
        for (link, node) in refused {
            let why = CloseReason::not_admitted();
            info!(%link, peer = self.names.called(&node), "{why}; its link is closed");
            self.links.close(link, why.to_string(), why);
        }
    }

    /// Answers every member again, since the fleet file may have changed.
    pub(super) fn answer_renewals(&mut self) {
        if self.authority.is_none() {
            return;
        }
        let request = |(sink, peer, csr): (SinkId, &VerifiedPeer, &Bytes)| RenewalRequest {
            asker: Asker::Member(sink),
            peer: peer.clone(),
            csr: csr.clone(),
        };
        let asked: Vec<_> = self.endpoint.renewing().map(request).collect();
        asked.into_iter().for_each(|request| self.queue_renewal(request));
        self.renew_own();
    }

    pub(super) fn take_credentials(&mut self, credentials: Credentials) {
        let now = now();
        match self.certificates.renew(now, credentials) {
            Ok(None) => {}
            Ok(Some(identity)) => {
                info!(until = %identity.not_after(), "the fleet's authority sent new credentials");
                let until = format!("this node's own, until {}", identity.not_after());
                self.audit.write(AuditRecord::new(AuditEvent::Renewed).reason(until));
                self.identity_renewed(now, identity);
            }
            Err(why) => {
                warn!(%why, "credentials from the fleet's authority are not usable");
                self.control_drops.count(NodeDrop::CredentialsUnusable);
            }
        }
    }

    /// Switches to the identity in the replaced file.
    pub(super) fn take_identity(&mut self, identity: Arc<Identity>) {
        let now = now();
        if !self.certificates.adopt(now, &identity) {
            return;
        }
        let until = format!("this node's own, by a replaced file, until {}", identity.not_after());
        self.audit.write(AuditRecord::new(AuditEvent::Renewed).reason(until));
        self.identity_renewed(now, identity);
        // It may name another authority, and have another key.
        self.ask_renewal();
    }

    /// Passes a renewed identity to the machines.
    fn identity_renewed(&mut self, now: Now, identity: Arc<Identity>) {
        if let (Some(routes), Some(newest)) = (&mut self.routes, identity.naming_secrets().first()) {
            routes.set_secret(newest.secret.clone());
        }
        self.router.set_identity(now, identity.clone());
        self.endpoint.set_identity(now, identity);
    }

    /// Trusts these CAs and no others. Their revocations stay in force.
    pub(super) fn trust(&mut self, anchors: TrustAnchors) {
        let anchors = Arc::new(anchors.with_lists_of(&self.certificates.anchors()));
        self.router.set_anchors(now(), anchors.clone());
        self.set_anchors(anchors);
    }

    /// Replaces the trust anchors everywhere.
    pub(super) fn set_anchors(&mut self, anchors: Arc<TrustAnchors>) {
        self.certificates.set_anchors(&anchors);
        self.catch_up_file(anchors.clone());
        self.endpoint.set_anchors(now(), anchors);
    }
}
