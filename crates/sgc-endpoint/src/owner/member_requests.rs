//! [`MemberRequests`]: requests of nodes that the driver answers later: for credentials, for an operation, for a report,
//! or for addresses. Each node has one place.

use std::collections::BTreeMap;

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Blind, GrantContent, Name, RefuseReason, Request, SinkId};

use super::granted::{GrantedSink, is_older};
use crate::context::Context;
use crate::names::BlindName;
use crate::output::UnexpectedFrame;

/// Most holders of invitations that have a place. A further one takes that of the first: what members need must not
/// depend on how many codes are about.
const HOLDER_PLACES_MAX: usize = 256;

/// The requests at one name of this node.
#[derive(Debug)]
pub(crate) struct MemberRequests {
    /// `None` if this node does not take such requests, or takes no more.
    name: Option<BlindName>,
    asked: BTreeMap<SinkId, GrantedSink>,
    /// Most nodes that have a place.
    max: usize,
    /// Whether nodes of other fleets may ask, too.
    takes_partners: bool,
}

/// A new request.
pub(crate) struct MemberRequest {
    pub(crate) peer: VerifiedPeer,
    /// The signing request, the operation or the question, not verified.
    pub(crate) what: Bytes,
}

impl MemberRequests {
    pub(crate) fn new(name: Option<BlindName>, max: usize) -> Self {
        Self { name, asked: BTreeMap::new(), max, takes_partners: false }
    }

    /// Takes requests of trusted nodes of other fleets as well. The driver decides about each.
    pub(crate) fn with_partners(self) -> Self {
        Self { takes_partners: true, ..self }
    }

    /// Takes requests at this name. Returns the blind to advertise, unless it is advertised already.
    pub(crate) fn begin(&mut self, name: BlindName) -> Option<Blind> {
        self.name.replace(name).is_none().then_some(name.blind)
    }

    /// Returns the blind of the name.
    pub(crate) fn blind(&self) -> Option<Blind> {
        self.name.map(|name| name.blind)
    }

    /// Returns `true` if `name` is that of these requests.
    pub(crate) fn is_at(&self, name: &Name) -> bool {
        self.name.is_some_and(|own| own.name == *name)
    }

    /// Takes no more requests, and forgets those that it has. Returns the blind to withdraw.
    pub(crate) fn end(&mut self) -> Option<Blind> {
        self.asked.clear();
        self.name.take().map(|name| name.blind)
    }

    /// Iterates over the nodes that ask: sink, node, and request.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (SinkId, &VerifiedPeer, &Bytes)> {
        self.asked.iter().filter_map(|(sink, asked)| match &asked.request {
            Request::Ask { what } => Some((*sink, &asked.peer, what)),
            Request::Subscribe { .. } | Request::Publish { .. } => None,
        })
    }

    /// Takes a request. Returns it if it has a place.
    pub(crate) fn handle_request(
        &mut self,
        cx: &mut Context,
        name: Name,
        sink: SinkId,
        asked: GrantedSink,
    ) -> Option<MemberRequest> {
        let Request::Ask { what } = asked.request.clone() else {
            cx.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
            return None;
        };
        let peer = asked.peer.clone();
        let is_of_another = self.asked.get(&sink).is_some_and(|known| known.peer.node_id != peer.node_id);
        if !(self.takes_partners || cx.is_own_fleet(&peer)) || is_of_another {
            cx.refuse(name, sink, 1, RefuseReason::NotPermitted);
            return None;
        }
        let Ok(older) = self.take_older(sink, &asked) else {
            cx.unexpected(UnexpectedFrame::OlderRequest);
            return None;
        };
        if let Some((older, granted)) = older {
            granted.refuse(cx, name, older, RefuseReason::Limit);
        }
        let is_holder = |asked: &GrantedSink| asked.peer.invitation.is_some();
        let holders = self.asked.iter().filter(|(id, asked)| is_holder(asked) && **id != sink).count();
        if is_holder(&asked) {
            let first = self.asked.iter().filter(|(id, asked)| is_holder(asked) && **id != sink);
            let first = first.min_by_key(|(_, asked)| asked.issued_at).map(|(id, _)| *id);
            if let Some(first) = first.filter(|_| holders >= HOLDER_PLACES_MAX)
                && let Some((id, first)) = self.asked.remove_entry(&first)
            {
                first.refuse(cx, name, id, RefuseReason::Limit);
            }
        } else if self.asked.len() - holders >= self.max {
            cx.refuse(name, sink, 1, RefuseReason::Limit);
            return None;
        }
        let serial = self.asked.get(&sink).map_or(0, |s| s.serial);
        self.asked.insert(sink, GrantedSink { serial, ..asked });
        Some(MemberRequest { peer, what })
    }

    pub(crate) fn handle_leave(&mut self, sink: SinkId) {
        self.asked.remove(&sink);
    }

    /// Answers a request, once or again after a change.
    pub(crate) fn answer(
        &mut self,
        cx: &mut Context,
        sink: SinkId,
        answer: Result<GrantContent, RefuseReason>,
    ) {
        let Some(BlindName { name, .. }) = self.name else { return };
        let Some(mut asked) = self.asked.remove(&sink) else { return };
        match answer {
            Ok(content) => {
                if asked.grant(cx, name, sink, &content) {
                    self.asked.insert(sink, asked);
                }
            }
            Err(reason) => asked.refuse(cx, name, sink, reason),
        }
    }

    /// Refuses nodes that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        let lost = |(sink, asked): (&SinkId, &GrantedSink)| Some((*sink, cx.standing(&asked.peer)?));
        for (sink, reason) in self.asked.iter().filter_map(lost).collect::<Vec<_>>() {
            self.answer(cx, sink, Err(reason));
        }
    }

    /// Gives the one place of a node to a request: the newer one is of the newer run, or of a newer certificate.
    /// Removes and returns the request that had the place; an error if that one was signed later, so that this one is
    /// a replay.
    fn take_older(
        &mut self,
        sink: SinkId,
        asked: &GrantedSink,
    ) -> Result<Option<(SinkId, GrantedSink)>, OlderRequest> {
        let other = self.asked.iter().find(|(id, s)| **id != sink && s.peer.node_id == asked.peer.node_id);
        let known = other.map(|(_, other)| other).or_else(|| self.asked.get(&sink));
        if known.is_some_and(|known| is_older(asked, known)) {
            return Err(OlderRequest);
        }
        let other = other.map(|(id, _)| *id);
        Ok(other.and_then(|id| self.asked.remove_entry(&id)))
    }
}

/// A request that was signed before the known one of its node.
struct OlderRequest;
