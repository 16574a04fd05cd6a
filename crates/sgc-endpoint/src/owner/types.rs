//! Types over the wire: an owner describes the types of its interfaces, once, to nodes that ask and may have them.
//!
//! An owner is asked at a name of its own; it answers for a type once it knows that type.

use std::collections::BTreeSet;

use sgc_wire::{
    Decode, Encode, GrantContent, Name, NodeId, RefuseReason, Request, Role, SEALED_BYTES_MAX, SinkId,
    TypeQuestion,
};

use super::adverts::Adverts;
use super::askers::Askers;
use super::granted::GrantedSink;
use super::shares::Shares;
use crate::context::Context;
use crate::names::BlindName;

/// Room for descriptions in one answer, bytes.
const ANSWER_BYTES_MAX: usize = SEALED_BYTES_MAX - 1024;

/// The nodes that ask for this owner's types. The shares have the descriptions.
#[derive(Debug)]
pub(crate) struct TypeAnswers {
    /// Set once this owner describes any type: the name of the question is advertised.
    describes: bool,
    /// The askers, each with the types that it was not told yet.
    askers: Askers<BTreeSet<Name>>,
    /// Described shares that were not yet reported to the askers.
    untold: BTreeSet<Name>,
}

impl TypeAnswers {
    pub(crate) fn new(owner: &NodeId) -> Self {
        let askers = Askers::new(BlindName::types(owner));
        Self { describes: false, askers, untold: BTreeSet::new() }
    }

    /// Returns the name of the question.
    pub(crate) fn name(&self) -> BlindName {
        self.askers.name()
    }

    /// Returns `true` once the name of the question is advertised.
    pub(crate) fn is_advertised(&self) -> bool {
        self.describes
    }

    /// Notes that a share has a description now.
    pub(crate) fn described(&mut self, adverts: &mut Adverts, share: Name) {
        if !std::mem::replace(&mut self.describes, true) {
            adverts.add(self.name().blind);
        }
        self.untold.insert(share);
    }

    /// Notes the end of a share.
    pub(crate) fn unshared(&mut self, share: &Name) {
        self.untold.remove(share);
    }

    /// Tells the askers the types described since the last call.
    pub(crate) fn tell(&mut self, cx: &mut Context, shares: &Shares) {
        let untold = std::mem::take(&mut self.untold);
        let waiting = self.askers.iter().filter(|(_, names)| !names.is_disjoint(&untold));
        for sink in waiting.map(|(sink, _)| sink).collect::<Vec<_>>() {
            self.answer(cx, shares, sink, false);
        }
    }

    /// Takes a question: every node that may know the owner may ask, and gets the types that it may have.
    pub(crate) fn handle_question(
        &mut self,
        cx: &mut Context,
        shares: &Shares,
        sink: SinkId,
        asked: GrantedSink,
    ) {
        let Request::Ask { what } = &asked.request else {
            return self.askers.refuse(cx, sink, RefuseReason::RoleNotOffered);
        };
        let Ok(question) = TypeQuestion::from_slice(what) else {
            return self.askers.refuse(cx, sink, RefuseReason::NotVerified);
        };
        if self.askers.admit(cx, sink, asked, question.names.into_iter().collect()) {
            self.answer(cx, shares, sink, true);
        }
    }

    pub(crate) fn handle_leave(&mut self, sink: SinkId) {
        self.askers.remove(sink);
    }

    /// Cuts askers that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        self.askers.enforce(cx);
    }

    pub(crate) fn withdraw(&mut self, adverts: &mut Adverts) {
        if std::mem::take(&mut self.describes) {
            adverts.withdraw(self.name().blind);
        }
        self.askers.clear();
        self.untold.clear();
    }

    /// Tells an asker the known types that it was not told yet; with `at_least`, also that there are none. Types
    /// without room in one answer are asked for again.
    fn answer(&mut self, cx: &mut Context, shares: &Shares, sink: SinkId, at_least: bool) {
        let Some((peer, names)) = self.askers.get_mut(sink) else { return };
        let (mut types, mut bytes) = (Vec::new(), 0);
        for name in names.iter() {
            let Some(share) = shares.get(name) else { continue };
            let may = |role| share.policy().permits(peer, role).is_ok();
            let Some(described) = share.described().filter(|_| may(Role::Subscribe) || may(Role::Publish))
            else {
                continue;
            };
            let described = described.describe(*name);
            let more = described.to_vec().len();
            if bytes + more <= ANSWER_BYTES_MAX {
                bytes += more;
                types.push(described);
            }
        }
        if types.is_empty() && !at_least {
            return;
        }
        names.retain(|name| types.iter().all(|told| told.name != *name));
        self.askers.answer(cx, sink, &GrantContent::Types(types));
    }
}
