//! Trust: revocation lists, expired certificates, and links that bring unverifiable bodies.

use std::sync::Arc;

use bytes::Bytes;
use sgc_trust::{CertError, CertId, CrlError, CrlNews, SignedError, TrustAnchors};
use sgc_wire::{Control, Now};

use super::Router;
use crate::drops::DropReason;
use crate::link_id::LinkId;
use crate::names::RecordEnd;
use crate::output::{LinkClose, Output};

/// The use of a neighbour's revocation list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Learnt {
    /// It is in force, and passed on.
    News,
    /// It is known, or waits for the allowance of its CA.
    Nothing,
}

impl Router {
    /// Takes a revocation list from this node's user. Returns `true` if it is news, which is then passed on everywhere.
    pub fn add_crl(&mut self, now: Now, der: &Bytes) -> Result<bool, CrlError> {
        let Some(anchors) = self.config.anchors.with_crl(der, now.unix)? else { return Ok(false) };
        self.take_list(now, LinkId::LOCAL, der, anchors);
        Ok(true)
    }

    /// Replaces the trust anchors, with their revocation lists. Everything under a certificate that is no longer valid
    /// ends: links, routes, branches.
    pub fn set_anchors(&mut self, now: Now, anchors: Arc<TrustAnchors>) {
        self.now = now;
        self.lists.retain(|ca| anchors.ca_spki(ca).is_some());
        self.config.anchors = anchors;
        for link in self.links.untrusted(|certs| self.is_untrusted(certs)) {
            self.close(link, LinkClose::Revoked);
        }
        let anchors = self.config.anchors.clone();
        let is_untrusted = |certs: &[CertId]| is_untrusted(&anchors, certs);
        let effects = self.trees.distrust(is_untrusted);
        self.perform(effects);
        self.topology.distrust(now.instant, is_untrusted);
        for id in self.names.untrusted(is_untrusted) {
            // It counts again if its certificate does.
            let names = self.names.forget(now.instant, id, RecordEnd::Unwanted);
            self.routes_changed(&names);
        }
    }

    pub(super) fn handle_crl(&mut self, link: LinkId, der: &Bytes) {
        let known = self.config.anchors.crls().any(|known| known == der) || self.lists.awaits(der);
        if known || !self.may_bring(link) {
            return;
        }
        let learnt = self.learn_or_wait(link, der);
        if learnt != Ok(Learnt::News) {
            self.charge_stale(link);
        }
        if let Err(why) = learnt {
            if why.is_forgery() {
                self.count_forgery(link);
            }
            self.drop_frame(link, DropReason::Crl(why));
        }
    }

    /// Looks again at the lists that waited for the allowance of their CA.
    pub(super) fn take_waiting_lists(&mut self) {
        for waiting in self.lists.due(self.now.instant) {
            // Verified when it came. By now it may be no news, or its CA may have expired or be no longer trusted.
            if let Err(why) = self.learn_or_wait(waiting.from, &waiting.der) {
                self.drop_frame(waiting.from, DropReason::Crl(why));
            }
        }
    }

    /// Takes a neighbour's list, if it is news and its CA has room.
    fn learn_or_wait(&mut self, link: LinkId, der: &Bytes) -> Result<Learnt, CrlError> {
        let now = self.now;
        let Some(CrlNews { ca, number, anchors }) = self.config.anchors.crl_news(der, now.unix)? else {
            return Ok(Learnt::Nothing);
        };
        let is_own = ca == self.config.identity.as_peer().ca;
        if !is_own && !self.lists.take(now.instant, ca, self.config.limits.lists_burst) {
            self.lists.wait(now.instant, &ca, number, link, der.clone());
            self.drop_frame(link, DropReason::ListFlood { ca });
            return Ok(Learnt::Nothing);
        }
        self.take_list(now, link, der, anchors);
        Ok(Learnt::News)
    }

    /// Takes over a list and passes it on.
    fn take_list(&mut self, now: Now, from: LinkId, der: &Bytes, anchors: TrustAnchors) {
        let anchors = Arc::new(anchors);
        self.outputs.push(Output::Trust(anchors.clone()));
        self.set_anchors(now, anchors);
        let others: Vec<_> = self.links.remote().filter(|link| *link != from).collect();
        for link in others {
            self.send(link, Control::Crl { der: der.clone() });
        }
    }

    /// Returns `true` if one of these, from the one below a CA down to a node's, is revoked, or that CA is not trusted.
    pub(super) fn is_untrusted(&self, certs: &[CertId]) -> bool {
        is_untrusted(&self.config.anchors, certs)
    }

    /// Closes the links of nodes whose certificates have ended.
    pub(super) fn close_expired(&mut self) {
        for link in self.links.expired(self.now.instant) {
            self.close(link, LinkClose::Expired);
        }
    }

    /// Handles an unverifiable body from `link`. A node that sends many is cut off.
    pub(super) fn not_verified(&mut self, link: LinkId, what: &'static str, why: SignedError) {
        let from_router = self.links.is_router(link);
        let honest = match &why {
            // Clocks differ, certificates expire, and lists spread, without anybody's fault.
            SignedError::Clock { .. } => true,
            SignedError::Cert(
                CertError::Expired { .. }
                | CertError::NotYetValid { .. }
                | CertError::CaExpired { .. }
                | CertError::Revoked { .. },
            ) => true,
            // Another router may trust another CA, or be of a version before there were invitations.
            SignedError::Cert(CertError::UnknownIssuer) | SignedError::Invited => from_router,
            SignedError::Cert(_)
            | SignedError::Signature(_)
            | SignedError::Decode(_)
            | SignedError::Sequence { .. } => false,
        };
        // These two cost no verification, and a router may well bring many of them.
        let is_cheap = matches!(why, SignedError::Clock { .. } | SignedError::Cert(CertError::UnknownIssuer));
        self.drop_frame(
            link,
            match why {
                SignedError::Clock { signed, now } => DropReason::Clock { what, signed, now },
                why => DropReason::NotVerified { what, why },
            },
        );
        if !honest {
            self.count_forgery(link);
        } else if !is_cheap {
            self.charge_stale(link);
        }
    }

    fn count_forgery(&mut self, link: LinkId) {
        let Some(peer) = self.links.remote_peer(link) else { return };
        let now = self.now.instant;
        if !self.allowances.node(now, &peer.node).may_err(now) {
            self.close(link, LinkClose::Forgeries);
        }
    }
}

fn is_untrusted(anchors: &TrustAnchors, certs: &[CertId]) -> bool {
    let other_ca = certs.first().is_some_and(|c| anchors.ca_spki(&c.ca).is_none());
    other_ca || anchors.is_path_revoked(certs)
}
