//! [`Askers`]: the nodes that ask this one a question at a name of its own, and get an answer after each change.

use std::collections::BTreeMap;

use sgc_trust::VerifiedPeer;
use sgc_wire::{GrantContent, RefuseReason, SinkId};

use super::granted::{GrantedSink, is_older, place};
use crate::context::Context;
use crate::names::BlindName;
use crate::output::UnexpectedFrame;

/// An asker, with the part of the question that is still to be answered, or the last answer.
#[derive(Debug)]
struct Asker<T> {
    granted: GrantedSink,
    state: T,
}

/// The askers of one question. A node that loses its certificate is cut.
#[derive(Debug)]
pub(crate) struct Askers<T> {
    name: BlindName,
    askers: BTreeMap<SinkId, Asker<T>>,
}

impl<T> Askers<T> {
    /// Returns a question that nobody asks yet.
    pub(crate) fn new(name: BlindName) -> Self {
        Self { name, askers: BTreeMap::new() }
    }

    /// Returns the name of the question.
    pub(crate) fn name(&self) -> BlindName {
        self.name
    }

    /// Iterates over the askers, with their states.
    pub(crate) fn iter(&self) -> impl Iterator<Item = (SinkId, &T)> {
        self.askers.iter().map(|(sink, asker)| (*sink, &asker.state))
    }

    /// Returns an asker's node, with its state.
    pub(crate) fn get_mut(&mut self, sink: SinkId) -> Option<(&VerifiedPeer, &mut T)> {
        let Asker { granted, state } = self.askers.get_mut(&sink)?;
        Some((&granted.peer, state))
    }

    /// Takes a question, which may be a repeated one. Returns `true` if the asker has a place and is to be answered.
    pub(crate) fn admit(&mut self, cx: &mut Context, sink: SinkId, asked: GrantedSink, state: T) -> bool {
        let serial = match self.askers.get(&sink).map(|known| &known.granted) {
            Some(known) if is_older(&asked, known) => {
                cx.unexpected(UnexpectedFrame::OlderRequest);
                return false;
            }
            Some(known) if known.peer.node_id == asked.peer.node_id => known.serial,
            Some(_) => {
                self.refuse(cx, sink, RefuseReason::Limit);
                return false;
            }
            None => {
                let askers = self.askers.iter().map(|(sink, asker)| (sink, &asker.granted));
                match place(askers, &asked, cx.limits()) {
                    Ok(None) => {}
                    Ok(Some(oldest)) => self.cut(cx, oldest, RefuseReason::Limit),
                    Err(reason) => {
                        self.refuse(cx, sink, reason);
                        return false;
                    }
                }
                0
            }
        };
        self.askers.insert(sink, Asker { granted: GrantedSink { serial, ..asked }, state });
        true
    }

    /// Refuses a question that has no place.
    pub(crate) fn refuse(&self, cx: &mut Context, sink: SinkId, reason: RefuseReason) {
        cx.refuse(self.name.name, sink, 1, reason);
    }

    /// Answers an asker; one with an unusable reply key is removed.
    pub(crate) fn answer(&mut self, cx: &mut Context, sink: SinkId, content: &GrantContent) {
        let Some(asker) = self.askers.get_mut(&sink) else { return };
        if !asker.granted.grant(cx, self.name.name, sink, content) {
            self.askers.remove(&sink);
        }
    }

    /// Forgets an asker that left.
    pub(crate) fn remove(&mut self, sink: SinkId) {
        self.askers.remove(&sink);
    }

    /// Cuts the askers that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        let lost = |(sink, asker): (&SinkId, &Asker<T>)| Some((*sink, cx.standing(&asker.granted.peer)?));
        for (sink, reason) in self.askers.iter().filter_map(lost).collect::<Vec<_>>() {
            self.cut(cx, sink, reason);
        }
    }

    /// Forgets all askers, without an answer.
    pub(crate) fn clear(&mut self) {
        self.askers.clear();
    }

    fn cut(&mut self, cx: &mut Context, sink: SinkId, reason: RefuseReason) {
        if let Some(asker) = self.askers.remove(&sink) {
            asker.granted.refuse(cx, self.name.name, sink, reason);
        }
    }
}
