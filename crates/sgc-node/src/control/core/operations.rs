//! Operations on the fleet: requests of this node's users to an authority, and requests of operators to this authority.

use std::time::Instant;

use bytes::Bytes;
use rand_core::{OsRng, TryRngCore as _};
use sgc_endpoint::{JoinStatus, RefusedBy};
use sgc_ros::RosNetwork;
use sgc_trust::{NodeName, VerifiedPeer};
use sgc_wire::{Name, NodeId, Operation, OperationAnswer, RefuseReason, SinkId};
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::Core;
use crate::clock::now;
use crate::control::fleet::operations::{OperationError, Step, UserOperation};
use crate::control::fleet::operators::{OperationOutcome, RequestStep};
use crate::drops::NodeDrop;
use crate::state::audit::{AuditEvent, AuditRecord};

/// Requests of this node's users.
impl<N: RosNetwork> Core<N> {
    pub(super) fn operate(
        &mut self,
        at: &NodeName,
        operation: Operation,
        reply: oneshot::Sender<Result<OperationAnswer, OperationError>>,
    ) {
        let own = self.certificates.identity();
        // The holder of an invitation has no secret, and knows the authority by its id.
        let invited = own.authority().filter(|_| own.as_peer().invitation.is_some());
        let Some(authority) = own.node_id_of(at.as_str()).or(invited) else {
            let _ = reply.send(Err(OperationError::NoSecret));
            return;
        };
        if authority == own.node_id() {
            let _ = reply.send(Err(OperationError::OwnName { at: at.to_string() }));
            return;
        }
        let is_named = own.authority() == Some(authority);
        let is_invited = invited.is_some();
        let wish = UserOperation { at: at.to_string(), authority, is_named, is_invited, operation, reply };
        self.operations.push(Instant::now(), wish);
        self.next_operation();
    }

    pub(super) fn operation_answered(&mut self, name: Name, answer: OperationAnswer) {
        let step = self.operations.answered(name, answer);
        self.operation_step(step);
    }

    pub(super) fn operation_denied(&mut self, name: Name, by: RefusedBy) {
        let step = self.operations.denied(name, by);
        self.operation_step(step);
    }

    pub(super) fn operations_due(&mut self, at: Instant) {
        if self.operations.deadline().is_some_and(|due| due <= at) {
            let asked = self.operations.name().and_then(|name| self.endpoint.join_status(&name));
            let is_found = !matches!(asked, None | Some(JoinStatus::Waiting));
            let step = self.operations.look(at, is_found);
            self.operation_step(step);
        }
    }

    fn operation_step(&mut self, step: Option<Step>) {
        match step {
            Some(Step::Ask(authority, request)) => {
                let name = self.endpoint.operate(now(), authority, &request);
                self.operations.asked(name);
            }
            Some(Step::Leave(name)) => {
                self.endpoint.leave(now(), &name);
                self.next_operation();
            }
            None => {}
        }
    }

    fn next_operation(&mut self) {
        let step = self.operations.next(Instant::now());
        self.operation_step(step);
    }
}

/// Requests to this authority.
impl<N: RosNetwork> Core<N> {
    /// Judges an operator's request and queues its operation.
    pub(super) fn operation_asked(&mut self, sink: SinkId, peer: &VerifiedPeer, request: &Bytes) {
        let Some(authority) = &mut self.authority else { return };
        let now = now();
        let asked = authority.ask_operation(now.instant, peer, sink, request, &mut OsRng.unwrap_err());
        let node = peer.node_id;
        match asked {
            RequestStep::Answer(answer) => self.answer_operator(&node, sink, answer),
            RequestStep::Again(answer) => {
                self.control_drops.count_from(NodeDrop::OperationRepeated, node);
                self.answer_operator(&node, sink, answer);
            }
            RequestStep::UnderWay => {
                self.control_drops.count_from(NodeDrop::OperationRepeated, node);
            }
            RequestStep::Job(job) => {
                self.note_present_members();
                match self.authority.as_mut().and_then(|authority| authority.push_or_return(job)) {
                    None => self.answer_next_batch(),
                    Some(job) => self.operation_done(job.busy()),
                }
            }
            RequestStep::NotPermitted => {
                let (what, reason) = match peer.invitation {
                    None => ("which is no operator", "an operation: it is no operator"),
                    Some(_) => {
                        ("which only holds an invitation", "an operation: it only holds an invitation")
                    }
                };
                if self.control_drops.count_from(NodeDrop::OperationNotPermitted, node) {
                    let node = self.names.called(&node);
                    warn!("refused an operation of {node}, {what}; counted from here on");
                }
                self.audit.write(AuditRecord::new(AuditEvent::Refused).peer(&node).reason(reason));
                self.endpoint.answer_operation(now, sink, Err(RefuseReason::NotPermitted));
            }
        }
    }

    /// Notes at this authority that the nodes which ask for credentials now are present.
    pub(super) fn note_present_members(&mut self) {
        if let Some(authority) = &mut self.authority {
            let here = self.endpoint.renewing().map(|(_, peer, _)| peer.node_id);
            authority.note_seen(here, now().unix);
        }
    }

    /// Answers an operation that was carried out or refused, and announces a revocation to everyone.
    pub(super) fn operation_done(&mut self, done: OperationOutcome) {
        info!("{} asked for an operation: {}", self.names.called(&done.node), done.said);
        // Where a node joined, the record is its own: the holder of an invitation may have used up its share.
        let peer = done.joined.as_ref().unwrap_or(&done.node);
        self.audit.write(AuditRecord::new(AuditEvent::Operation).peer(peer).reason(&done.said));
        let waits = self.authority.as_mut().and_then(|authority| authority.operation_done(&done));
        if let Some(sink) = waits {
            self.answer_operator(&done.node, sink, done.answer);
        }
        if let Some(list) = done.list.map(Bytes::from)
            && let Err(why) = self.router.add_crl(now(), &list)
        {
            warn!(%why, "this authority cannot use its own new revocation list");
        }
    }

    fn answer_operator(&mut self, node: &NodeId, sink: SinkId, answer: OperationAnswer) {
        if let OperationAnswer::Refused { why, .. } = &answer {
            self.control_drops.count_from(*why, *node);
        }
        self.endpoint.answer_operation(now(), sink, Ok(answer));
    }
}
