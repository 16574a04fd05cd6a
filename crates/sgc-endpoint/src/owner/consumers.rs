//! Consumers over the wire: a node tells owners which ROS 2 subscribers, publishers and service clients use their
//! interfaces.
//!
//! Owners ask a node at a name of its own if they granted it something. The answer is sealed to the owner, holds only
//! consumers of that owner's interfaces, and is repeated after each change. The owner's driver decides which consumers
//! to show.

use std::collections::BTreeMap;

use sgc_wire::{CONSUMERS_MAX, Consumer, GrantContent, NodeId, RefuseReason, Request, SinkId};

use super::adverts::Adverts;
use super::askers::Askers;
use super::granted::GrantedSink;
use crate::context::Context;
use crate::names::BlindName;

/// The consumers of this node, and the owners that ask for them.
#[derive(Debug)]
pub(crate) struct ConsumerReports {
    /// The consumers, by the owner of the used interface; `None` until there is one.
    consumers: Option<BTreeMap<NodeId, Vec<Consumer>>>,
    /// The owners, each with its last answer.
    askers: Askers<Option<Vec<Consumer>>>,
}

impl ConsumerReports {
    pub(crate) fn new(node: &NodeId) -> Self {
        Self { consumers: None, askers: Askers::new(BlindName::consumers(node)) }
    }

    /// Returns the name of the question.
    pub(crate) fn name(&self) -> BlindName {
        self.askers.name()
    }

    /// Returns `true` once the name of the question is advertised.
    pub(crate) fn is_advertised(&self) -> bool {
        self.consumers.is_some()
    }

    /// Sets the consumers, and tells the owners that ask.
    pub(crate) fn set(
        &mut self,
        cx: &mut Context,
        adverts: &mut Adverts,
        mut consumers: BTreeMap<NodeId, Vec<Consumer>>,
    ) {
        consumers.values_mut().for_each(|all| all.truncate(CONSUMERS_MAX));
        if self.consumers.is_none() {
            if consumers.is_empty() {
                return;
            }
            adverts.add(self.name().blind);
        }
        self.consumers = Some(consumers);
        for sink in self.askers.iter().map(|(sink, _)| sink).collect::<Vec<_>>() {
            self.tell(cx, sink);
        }
    }

    pub(crate) fn handle_question(&mut self, cx: &mut Context, sink: SinkId, asked: GrantedSink) {
        if !matches!(&asked.request, Request::Ask { what } if what.is_empty()) {
            self.askers.refuse(cx, sink, RefuseReason::RoleNotOffered);
        } else if self.consumers.is_none() {
            self.askers.refuse(cx, sink, RefuseReason::NotShared);
        } else if self.askers.admit(cx, sink, asked, None) {
            self.tell(cx, sink);
        }
    }

    pub(crate) fn handle_leave(&mut self, sink: SinkId) {
        self.askers.remove(sink);
    }

    /// Cuts owners that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        self.askers.enforce(cx);
    }

    pub(crate) fn withdraw(&mut self, adverts: &mut Adverts) {
        if self.consumers.take().is_some() {
            adverts.withdraw(self.name().blind);
        }
        self.askers.clear();
    }

    /// Tells an owner its consumers here if they differ from the last answer.
    fn tell(&mut self, cx: &mut Context, sink: SinkId) {
        let (Some((owner, told)), Some(consumers)) = (self.askers.get_mut(sink), &self.consumers) else {
            return;
        };
        let consumers = consumers.get(&owner.node_id).cloned().unwrap_or_default();
        if told.as_ref() == Some(&consumers) {
            return;
        }
        *told = Some(consumers.clone());
        self.askers.answer(cx, sink, &GrantContent::Consumers(consumers));
    }
}
