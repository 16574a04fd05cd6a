//! Consumers over the wire: a node tells owners which ROS 2 subscribers, publishers and service clients use their
//! interfaces.
//!
//! Owners ask a node at a name of its own if they granted it something. The answer is sealed to the owner, holds only
//! consumers of that owner's interfaces, and is repeated after each change. The owner's driver decides which consumers
//! to show.

use std::collections::BTreeMap;

use sgc_trust::{consumers_blind, name_of};
use sgc_wire::{
    Blind, CONSUMERS_MAX, Consumer, GrantContent, Name, NodeId, Now, RefuseReason, Request, SinkId,
};

use crate::Endpoint;
use crate::endpoint::Event;
use crate::joins::{JoinKind, LostReason};
use crate::owner::{OLDER_REQUEST, is_older, place};
use crate::shares::GrantedSink;

/// An owner that asked for this node's consumers.
#[derive(Debug)]
pub(crate) struct ConsumerAsker {
    asker: GrantedSink,
    /// The last answer.
    told: Option<Vec<Consumer>>,
}

/// Returns the name at which `node` is asked for its consumers.
pub(crate) fn consumers_name(node: &NodeId) -> (Name, Blind) {
    let blind = consumers_blind(node);
    (name_of(node, &blind), blind)
}

/// The user's part.
impl Endpoint {
    /// Sets the consumers of this node, by the owner of the used interface; each owner gets its own when it asks and
    /// when they change. Those beyond [`CONSUMERS_MAX`] of an owner are left out. The name of the question is
    /// advertised from the first consumer on.
    pub fn set_consumers(&mut self, now: Now, mut consumers: BTreeMap<NodeId, Vec<Consumer>>) {
        self.now = now;
        consumers.values_mut().for_each(|all| all.truncate(CONSUMERS_MAX));
        if self.consumers.is_none() {
            if consumers.is_empty() {
                return;
            }
            self.withdrawn.remove(&self.consumers_name.1);
            self.unadvertised.insert(self.consumers_name.1);
        }
        self.consumers = Some(consumers);
        for sink in self.consumer_askers.keys().copied().collect::<Vec<_>>() {
            self.tell_consumers(sink);
        }
    }

    pub(crate) fn is_consumers(&self, name: &Name) -> bool {
        self.consumers_name.0 == *name
    }

    pub(crate) fn handle_consumer_question(&mut self, name: Name, sink: SinkId, asker: GrantedSink) {
        if !matches!(&asker.request, Request::Ask { what } if what.is_empty()) {
            return self.refuse(name, sink, 1, RefuseReason::RoleNotOffered);
        }
        if self.consumers.is_none() {
            return self.refuse(name, sink, 1, RefuseReason::NotShared);
        }
        let serial = match self.consumer_askers.get(&sink).map(|known| &known.asker) {
            Some(known) if is_older(&asker, known) => return self.unexpected(OLDER_REQUEST),
            Some(known) if known.peer.node_id == asker.peer.node_id => known.serial,
            Some(_) => return self.refuse(name, sink, 1, RefuseReason::Limit),
            None => {
                let askers = self.consumer_askers.iter().map(|(sink, asked)| (sink, &asked.asker));
                match place(askers, &asker, &self.config.limits) {
                    Ok(None) => {}
                    Ok(Some(oldest)) => self.end_consumer_question(oldest, RefuseReason::Limit),
                    Err(reason) => return self.refuse(name, sink, 1, reason),
                }
                0
            }
        };
        let asker = GrantedSink { serial, ..asker };
        self.consumer_askers.insert(sink, ConsumerAsker { asker, told: None });
        self.tell_consumers(sink);
    }

    /// Tells an owner its consumers here if they differ from the last answer.
    fn tell_consumers(&mut self, sink: SinkId) {
        let (Some(asked), Some(consumers)) = (self.consumer_askers.get_mut(&sink), &self.consumers) else {
            return;
        };
        let consumers = consumers.get(&asked.asker.peer.node_id).cloned().unwrap_or_default();
        if asked.told.as_ref() == Some(&consumers) {
            return;
        }
        asked.told = Some(consumers.clone());
        asked.asker.serial += 1;
        let (serial, reply_key) = (asked.asker.serial, asked.asker.reply_key.clone());
        let content = GrantContent::Consumers(consumers);
        if !self.grant(self.consumers_name.0, sink, serial, &reply_key, &content) {
            self.consumer_askers.remove(&sink);
        }
    }

    /// Cuts owners that lost their certificate.
    pub(crate) fn enforce_consumers(&mut self) {
        let lost = |(sink, asked): (&SinkId, &ConsumerAsker)| {
            self.standing(&asked.asker.peer).map(|reason| (*sink, reason))
        };
        let lost: Vec<_> = self.consumer_askers.iter().filter_map(lost).collect();
        for (sink, reason) in lost {
            self.end_consumer_question(sink, reason);
        }
    }

    fn end_consumer_question(&mut self, sink: SinkId, reason: RefuseReason) {
        if let Some(asked) = self.consumer_askers.remove(&sink) {
            self.refuse(self.consumers_name.0, sink, asked.asker.serial + 1, reason);
        }
    }

    pub(crate) fn withdraw_consumers(&mut self) {
        if self.consumers.take().is_some() {
            self.unadvertised.remove(&self.consumers_name.1);
            self.withdrawn.insert(self.consumers_name.1);
        }
        self.consumer_askers.clear();
    }
}

/// The owner's part.
impl Endpoint {
    /// Asks a node for its consumers of this node's interfaces, until [`Self::leave_consumers`]. A node that reports
    /// none, or of a version that cannot, does not advertise the name of the question: then nothing happens.
    pub fn ask_consumers(&mut self, now: Now, peer: NodeId) {
        let (name, _) = consumers_name(&peer);
        self.join(now, name, peer, JoinKind::Consumers);
    }

    /// Stops asking a node.
    pub fn leave_consumers(&mut self, now: Now, peer: &NodeId) {
        let (name, _) = consumers_name(peer);
        self.leave(now, &name);
    }

    pub(crate) fn consumers_lost(&mut self, name: Name, reason: LostReason) {
        if let Some(peer) = self.joins.get(&name).map(|join| join.owner) {
            self.event(Event::ConsumersLost { peer, reason });
        }
    }
}
