//! Trust: revocation lists, expired certificates, and links that bring unverifiable bodies.

use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_trust::{
    CLOCK_SKEW_MAX, CertError, CertId, CrlError, CrlNews, SignedError, TrustAnchors, VerifiedPeer,
};
use sgc_wire::{Control, Now, UnixMillis};

use crate::router::{DropReason, LinkClose, LinkId, Output, Router};

/// Longest time of a frame to a neighbour, plus the usual difference of honest nodes' clocks.
const UNDER_WAY_MAX: Duration = Duration::from_secs(10);

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
        let links: Vec<_> = self
            .links
            .iter()
            .filter(|(l, s)| **l != LinkId::LOCAL && self.is_untrusted(&s.certs))
            .map(|(l, _)| *l)
            .collect();
        for link in links {
            self.outputs.push_back(Output::Close { link, reason: LinkClose::Revoked });
            self.forget_link(link);
        }
        self.distrust_branches();
        self.distrust_nodes(now.instant);
        self.distrust_names();
    }

    pub(crate) fn handle_crl(&mut self, now: Now, link: LinkId, der: &Bytes) {
        let known = self.config.anchors.crls().any(|known| known == der) || self.lists.awaits(der);
        if known || !self.may_bring(link) {
            return;
        }
        let learnt = self.learn_or_wait(now, link, der);
        if !matches!(learnt, Ok(true)) {
            self.charge_stale(link);
        }
        if let Err(why) = learnt {
            if why.is_forgery() {
                self.count_forgery(now, link);
            }
            self.drop_frame(link, DropReason::Crl(why));
        }
    }

    /// Looks again at the lists that waited for the allowance of their CA.
    pub(crate) fn take_waiting_lists(&mut self, now: Now) {
        for waiting in self.lists.due(now.instant) {
            // Verified when it came. By now it may be no news, or its CA may have expired or be no longer trusted.
            if let Err(why) = self.learn_or_wait(now, waiting.from, &waiting.der) {
                self.drop_frame(waiting.from, DropReason::Crl(why));
            }
        }
    }

    /// Takes a neighbour's list, if it is news and its CA has room. Returns `true` if so.
    fn learn_or_wait(&mut self, now: Now, link: LinkId, der: &Bytes) -> Result<bool, CrlError> {
        let Some(CrlNews { ca, number, anchors }) = self.config.anchors.crl_news(der, now.unix)? else {
            return Ok(false);
        };
        let is_own = ca == self.config.identity.as_peer().ca;
        if !is_own && !self.lists.take(now.instant, ca, self.config.limits.lists_burst) {
            self.lists.wait(now.instant, &ca, number, link, der.clone());
            self.drop_frame(link, DropReason::ListFlood { ca });
            return Ok(false);
        }
        self.take_list(now, link, der, anchors);
        Ok(true)
    }

    /// Takes over a list and passes it on.
    fn take_list(&mut self, now: Now, from: LinkId, der: &Bytes, anchors: TrustAnchors) {
        let anchors = Arc::new(anchors);
        self.outputs.push_back(Output::Trust(anchors.clone()));
        self.set_anchors(now, anchors);
        let others: Vec<_> =
            self.links.keys().filter(|l| **l != from && **l != LinkId::LOCAL).copied().collect();
        for link in others {
            self.send(link, Control::Crl { der: der.clone() });
        }
    }

    /// Returns `true` if one of these, from the one below a CA down to a node's, is revoked, or that CA is not trusted.
    pub(crate) fn is_untrusted(&self, certs: &[CertId]) -> bool {
        let anchors = &self.config.anchors;
        let other_ca = certs.first().is_some_and(|c| anchors.ca_spki(&c.ca).is_none());
        other_ca || anchors.is_path_revoked(certs)
    }

    /// Returns `true` if neighbours will still believe a body with this time of signing. A lease counts from an
    /// announcement's arrival, so a late replay outlasts the time in which it verifies.
    pub(crate) fn verifies_elsewhere(&self, issued_at: UnixMillis) -> bool {
        let age = self.now.unix.0.saturating_sub(issued_at.0);
        Duration::from_millis(age) + UNDER_WAY_MAX <= CLOCK_SKEW_MAX
    }

    /// Returns the end of a signed body: its lease, but not beyond its signer's certificate.
    pub(crate) fn lease_end(
        &self,
        now: Now,
        lease_ms: u32,
        signer: &VerifiedPeer,
    ) -> Result<Instant, SignedError> {
        let not_after = signer.not_after;
        // Certificates are judged by the second, so one may verify although no time of it is left.
        let left = not_after.0.checked_sub(now.unix.0).filter(|left| *left > 0);
        let left = left.ok_or(CertError::Expired { not_after, now: now.unix })?;
        let lease = Duration::from_millis(lease_ms.into()).min(self.config.limits.lease_max);
        Ok(now.instant + lease.min(Duration::from_millis(left)))
    }

    /// Closes the links of nodes whose certificates have ended.
    pub(crate) fn close_expired(&mut self, now: Now) {
        let over = |at: Instant| at <= now.instant;
        let links: Vec<_> =
            self.links.iter().filter(|(_, s)| s.expires.is_some_and(over)).map(|(l, _)| *l).collect();
        for link in links {
            self.outputs.push_back(Output::Close { link, reason: LinkClose::Expired });
            self.forget_link(link);
        }
    }

    /// Handles an unverifiable body from `link`. A node that sends many is cut off.
    pub(crate) fn not_verified(&mut self, now: Now, link: LinkId, what: &'static str, why: SignedError) {
        let from_router = self.links.get(&link).is_some_and(|l| l.is_transit());
        let honest = match &why {
            // Clocks differ, certificates expire, and lists spread, without anybody's fault.
            SignedError::Clock { .. } => true,
            SignedError::Cert(
                CertError::Expired { .. }
                | CertError::NotYetValid { .. }
                | CertError::CaExpired { .. }
                | CertError::Revoked { .. },
            ) => true,
            // Another router may trust another CA.
            SignedError::Cert(CertError::UnknownIssuer) => from_router,
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
            self.count_forgery(now, link);
        } else if !is_cheap {
            self.charge_stale(link);
        }
    }

    fn count_forgery(&mut self, now: Now, link: LinkId) {
        let Some(node) = self.links.get(&link).filter(|_| link != LinkId::LOCAL).map(|l| l.node) else {
            return;
        };
        if !self.allowance(&node).may_err(now.instant) {
            self.outputs.push_back(Output::Close { link, reason: LinkClose::Forgeries });
            self.forget_link(link);
        }
    }
}
