//! [`Context`]: the state that the endpoint's two parts share, and the queue of their effects.

use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Instant;

use rand_chacha::ChaCha20Rng;
use sgc_trust::{Identity, TrustAnchors, VerifiedPeer, seal_grant};
use sgc_wire::{Answer, AnswerBody, Control, GrantContent, Name, Now, RefuseReason, SinkId};

use crate::config::Limits;
use crate::output::{EndpointDrop, Event, Output, UnexpectedFrame};

/// Identity, trust, bounds, time and random numbers of an endpoint; takes the effects of its parts, in their order.
#[derive(Debug)]
pub(crate) struct Context {
    identity: Arc<Identity>,
    anchors: Arc<TrustAnchors>,
    limits: Limits,
    rng: ChaCha20Rng,
    now: Now,
    outputs: VecDeque<Output>,
}

impl Context {
    pub(crate) fn new(identity: Arc<Identity>, limits: Limits, rng: ChaCha20Rng, now: Now) -> Self {
        let anchors = Arc::new(identity.anchors().clone());
        Self { identity, anchors, limits, rng, now, outputs: VecDeque::new() }
    }

    pub(crate) fn identity(&self) -> &Arc<Identity> {
        &self.identity
    }

    pub(crate) fn set_identity(&mut self, identity: Arc<Identity>) {
        self.identity = identity;
    }

    pub(crate) fn anchors(&self) -> &TrustAnchors {
        &self.anchors
    }

    pub(crate) fn set_anchors(&mut self, anchors: Arc<TrustAnchors>) {
        self.anchors = anchors;
    }

    pub(crate) fn limits_mut(&mut self) -> &mut Limits {
        &mut self.limits
    }

    pub(crate) fn limits(&self) -> &Limits {
        &self.limits
    }

    pub(crate) fn rng(&mut self) -> &mut ChaCha20Rng {
        &mut self.rng
    }

    pub(crate) fn now(&self) -> Now {
        self.now
    }

    pub(crate) fn instant(&self) -> Instant {
        self.now.instant
    }

    pub(crate) fn set_now(&mut self, now: Now) {
        self.now = now;
    }

    /// Returns the oldest effect that was not taken yet.
    pub(crate) fn take_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    pub(crate) fn has_output(&self) -> bool {
        !self.outputs.is_empty()
    }

    pub(crate) fn send(&mut self, frame: Control) {
        self.outputs.push_back(Output::Send(frame));
    }

    pub(crate) fn event(&mut self, event: Event) {
        self.outputs.push_back(Output::Event(event));
    }

    pub(crate) fn drop_frame(&mut self, why: EndpointDrop) {
        self.outputs.push_back(Output::Dropped(why));
    }

    pub(crate) fn unexpected(&mut self, what: UnexpectedFrame) {
        self.drop_frame(EndpointDrop::Unexpected { what });
    }

    /// Grants a request. Returns `false` if its reply key is unusable; the request is then refused.
    pub(crate) fn grant(
        &mut self,
        name: Name,
        sink: SinkId,
        serial: u64,
        reply_key: &[u8],
        content: &GrantContent,
    ) -> bool {
        match seal_grant(reply_key, &name, &sink, serial, content) {
            Ok((enc, sealed)) => {
                self.answer(AnswerBody { name, sink, serial, answer: Answer::Grant { enc, sealed } });
                true
            }
            Err(why) => {
                self.drop_frame(why.into());
                self.refuse(name, sink, serial, RefuseReason::NotVerified);
                false
            }
        }
    }

    pub(crate) fn refuse(&mut self, name: Name, sink: SinkId, serial: u64, reason: RefuseReason) {
        self.answer(AnswerBody { name, sink, serial, answer: Answer::Refuse { reason } });
    }

    fn answer(&mut self, body: AnswerBody) {
        let signed = self.identity.sign_answer(&body);
        self.send(Control::Answer { signed });
    }

    /// Returns the reason why a peer with a once valid certificate may not have anything any more.
    pub(crate) fn standing(&self, peer: &VerifiedPeer) -> Option<RefuseReason> {
        if self.anchors.is_peer_revoked(peer) {
            Some(RefuseReason::Revoked)
        } else if !self.anchors.stands(peer) {
            // This node no longer trusts the peer's CA.
            Some(RefuseReason::NotVerified)
        } else if peer.not_after < self.now.unix {
            Some(RefuseReason::Expired)
        } else {
            None
        }
    }

    /// Returns `true` if a peer is of this node's fleet.
    pub(crate) fn is_own_fleet(&self, peer: &VerifiedPeer) -> bool {
        peer.ca == self.identity.as_peer().ca
    }
}
