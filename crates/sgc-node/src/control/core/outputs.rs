//! Carries out the outputs of the router and the endpoint, and reports their events.

use rand_chacha::ChaCha20Rng;
use sgc_endpoint::{Event, Output as EndpointOutput};
use sgc_ros::{RosNetwork, Routes, UNREACHABLE_HOLD};
use sgc_router::{DropReason, LinkClose, LinkId, Output as RouterOutput, StoreEvent, StoreFailure};
use sgc_transport::CloseReason;
use sgc_wire::{Name, Now, RefuseReason, Role};
use tracing::{debug, info, warn};

use super::Core;
use crate::clock::now;
use crate::drops::NodeDrop;
use crate::state::audit::{AuditEvent, AuditRecord};

impl<N: RosNetwork> Core<N> {
    pub(super) fn router_output(&mut self, output: RouterOutput) {
        match output {
            RouterOutput::Send { link: LinkId::LOCAL, frame } => self.endpoint.handle_frame(now(), frame),
            RouterOutput::Send { link, frame } => {
                if !self.links.send(link, frame) {
                    self.close_overloaded(link);
                }
            }
            RouterOutput::Flush { link } => {
                if !self.links.flush(link) {
                    self.close_overloaded(link);
                }
            }
            RouterOutput::Forward { name, entry } => self.set_forward(name, entry),
            RouterOutput::Close { link, reason } => self.close_link(link, &reason),
            RouterOutput::Trust(anchors) => {
                let lists = anchors.crls().count();
                let record =
                    AuditRecord::new(AuditEvent::Crl).reason(format!("in force, {lists} lists in all"));
                self.audit.write(record);
                self.set_anchors(anchors);
            }
            RouterOutput::Dropped(dropped) => {
                let first = self.control_drops.count_from(&dropped.reason, dropped.link);
                // Honest neighbours may forward statements of which a partner's CA makes too many.
                let is_told =
                    dropped.reason.is_suspicious() || matches!(dropped.reason, DropReason::ListFlood { .. });
                if first && is_told {
                    let peer = dropped.peer.map(|p| self.names.called(&p)).unwrap_or_default();
                    warn!(link = %dropped.link, peer, reason = %dropped.reason, "control frame refused; counted from here on");
                } else {
                    debug!(link = %dropped.link, reason = %dropped.reason, "control frame refused");
                }
            }
            RouterOutput::Store(operation) => {
                let id = operation.id;
                // There is room for all operations that a router has under way.
                let is_taken = self.store.as_ref().is_some_and(|store| store.try_send(operation).is_ok());
                if !is_taken {
                    let result = Err(StoreFailure::Unreachable);
                    self.router.handle_store(now(), StoreEvent::Reply { id, result });
                }
            }
            RouterOutput::Timeout(_) => {}
        }
    }

    /// Closes a link that the router no longer wants.
    fn close_link(&mut self, link: LinkId, reason: &LinkClose) {
        let Some(entry) = self.links.get(link) else { return };
        let (peer, remote) = (entry.peer(), entry.remote());
        let node = peer.node_id;
        let mut because = reason.to_string();
        let close = match reason {
            LinkClose::Superseded { by, alive } => return self.close_superseded(link, *by, *alive),
            LinkClose::Goodbye => CloseReason::Goodbye,
            LinkClose::Revoked => {
                let record = AuditRecord::new(AuditEvent::Revoked).peer(&node);
                self.audit.write(record.remote(remote).reason("its link is cut"));
                let why = self.certificates.objection(peer, now().unix).unwrap_or(CloseReason::Revoked);
                info!(%link, peer = self.names.called(&node), "{why}; its link is closed");
                because = why.to_string();
                why
            }
            LinkClose::Expired => {
                info!(%link, peer = self.names.called(&node), "the peer's certificate has ended; its link is closed");
                CloseReason::Expired
            }
            LinkClose::TooMany | LinkClose::Forgeries => {
                warn!(%link, %remote, peer = self.names.called(&node), "{reason}; its link is closed");
                CloseReason::Denied(because.clone())
            }
            LinkClose::Greeting | LinkClose::Loop => {
                warn!(%link, %remote, "{reason}");
                CloseReason::Protocol(because.clone())
            }
        };
        self.links.close(link, because, close);
    }

    fn close_overloaded(&mut self, link: LinkId) {
        let Some(entry) = self.links.get(link) else { return };
        warn!(%link, remote = %entry.remote(), "the peer does not take control frames; the link is closed");
        self.control_drops.count_from(NodeDrop::ControlQueueFull, link);
        entry.close_overloaded();
    }

    pub(super) fn endpoint_output(&mut self, output: EndpointOutput) {
        let now = now();
        match output {
            EndpointOutput::Send(frame) => self.router.handle_frame(now, LinkId::LOCAL, frame),
            EndpointOutput::Dropped(dropped) => {
                let is_first = self.control_drops.count(&dropped);
                if is_first && dropped.is_suspicious() {
                    warn!(reason = %dropped, "refused; counted from here on");
                } else {
                    debug!(reason = %dropped, "refused");
                }
            }
            EndpointOutput::Event(event) => self.endpoint_event(now, event),
            EndpointOutput::Timeout(_) => {}
        }
    }

    pub(super) fn endpoint_event(&mut self, now: Now, event: Event) {
        self.audit_event(&event);
        match event {
            Event::RenewAsked { sink, peer, csr } => self.answer_renewal(sink, peer, csr),
            Event::OperationAsked { sink, peer, request } => self.operation_asked(sink, &peer, &request),
            Event::ReportAsked { sink, peer, question } => self.report_asked(sink, &peer, &question),
            Event::Report { name, report } => self.take_report(name, &report),
            Event::ReportRefused { name, by } => self.report_refused(name, by),
            Event::PathAsked { sink, peer, question } => self.path_asked(sink, &peer, &question),
            Event::PathOffered { peer, offer } => self.path_offered(peer, &offer),
            Event::PathRefused { peer, by } => self.path_refused(peer, by),
            Event::Time { peer, asked, time } => self.time_told(peer, asked, time),
            Event::OperationAnswered { name, answer } => self.operation_answered(name, answer),
            Event::OperationDenied { name, by } => self.operation_denied(name, by),
            Event::Renewed { credentials } => self.take_credentials(credentials),
            Event::RenewRefused { by } => {
                if self.control_drops.count(NodeDrop::RenewalRefused) {
                    warn!(reason = %by, "the fleet's authority gives this node no credentials; asking again later");
                }
            }
            Event::Rekeyed { name, grant } => {
                debug!(name = %name.short(), epoch = grant.epoch, "a new epoch begins");
                if let Some(share) = self.shares.get(&name) {
                    share.rekey(grant);
                }
            }
            Event::OwnGrant { name, grant } => self.own_grant(name, grant),
            Event::Consumers { peer, consumers } => self.consumers_told(now, peer, consumers),
            Event::ConsumersLost { peer, reason } => self.consumers_lost(now, peer, reason),
            Event::Wishes { peer, wishes } => self.wishes_told(peer, &wishes),
            Event::WishesLost { peer, reason } => self.wishes_lost(&peer, reason),
            Event::Types { owner, types } => self.types_told(owner, types),
            Event::Recover(recover) => {
                if let Some(share) = self.shares.get(&recover.name)
                    && !self.replays.ask(share.clone(), recover)
                {
                    self.control_drops.count(NodeDrop::ReplaysFull);
                }
            }
            Event::Confirmed { name, source, peer, seq } => {
                self.closings.confirmed(&name, &source, &peer, seq);
                if let Some(share) = self.shares.get(&name) {
                    let mut subscribers = self.endpoint.subscribers(&name);
                    share.ask_in_marks(!subscribers.all(|node| self.closings.confirms(&node)));
                }
            }
            Event::Granted { name, sink, grant } => {
                debug!(name = %name.short(), epoch = grant.epoch, "granted");
                self.is_newly_granted = true;
                let entry = grant.entry.as_deref().cloned();
                if let Some(anew) = self.publishing_granted(now, name, &grant) {
                    debug!(name = %name.short(), "publishing under it");
                    self.call_granted(now, name, sink, grant, anew);
                } else {
                    self.sinks.grant(now.instant, name, sink, grant);
                    self.set_clock(&name);
                }
                if let Some(routes) = &mut self.routes {
                    routes.handle_granted(&name, entry);
                }
                self.need_type_of_used(name);
                self.ask_histories(name);
            }
            Event::Followed { peer } => self.hear_of(&peer),
            event => self.route_event(now, event),
        }
    }

    /// Handles events for the route machine only.
    pub(super) fn route_event(&mut self, now: Now, event: Event) {
        self.calls_event(&event);
        if let Event::Catalogue { owner, .. } = &event {
            self.hear_of_owner(*owner);
        }
        let Some(routes) = &mut self.routes else { return };
        match event {
            Event::SinkJoined { name, sink, peer, role } => {
                info!("granted {} to {}", shown(routes, &name), self.names.called(&peer));
                debug!(name = %name.short(), peer = %peer.short(), "granted a subscriber");
                self.refused.forget(&name, &peer);
                if role == Role::Subscribe || routes.is_service(&name) {
                    routes.handle_sink_joined(&name, sink);
                }
                if let Some(share) = self.shares.get(&name).filter(|_| !self.closings.confirms(&peer)) {
                    share.ask_in_marks(true);
                }
                self.consumers.sink_joined(now.instant, peer, name, sink, role);
                self.wishes.subscribers_changed();
            }
            Event::SinkLeft { name, sink, peer } => {
                debug!(name = %name.short(), peer = %peer.short(), "a subscriber is gone");
                routes.handle_sink_left(now.instant, &name, &sink);
                self.closings.lost_path(now.instant, name, peer);
                self.consumers.sink_left(peer, name, sink, now.instant + UNREACHABLE_HOLD);
                self.wishes.subscribers_changed();
            }
            Event::SinkCut { name, sink, peer, reason } => {
                info!(
                    "{} no longer gets {}: {reason}; the others get a new key",
                    self.names.called(&peer),
                    shown(routes, &name)
                );
                debug!(name = %name.short(), peer = %peer.short(), "took a grant back");
                self.refused.remember(name, peer, &reason);
                routes.handle_sink_left(now.instant, &name, &sink);
                self.closings.cut(&name, &peer);
                self.consumers.sink_left(peer, name, sink, now.instant);
                self.wishes.subscribers_changed();
            }
            Event::SinkRefused { name, peer, reason } => {
                debug!(name = %name.short(), peer = %peer.short(), %reason, "refused a subscriber");
                self.refused.remember(name, peer, &reason);
                if self.control_drops.count_from(NodeDrop::JoinRefused, peer) {
                    warn!(
                        "refused {} to {}: {reason}; counted from here on",
                        shown(routes, &name),
                        self.names.called(&peer)
                    );
                }
            }
            Event::Refused { name, by } => {
                warn!("{} is refused to this node: {by}; asking again later", shown(routes, &name));
                debug!(name = %name.short(), reason = %by, "refused");
                routes.handle_refused(&name, by);
            }
            Event::Lost { name, reason } => {
                debug!(name = %name.short(), ?reason, "interrupted; waiting for the way to come back");
                routes.handle_lost(now.instant, &name);
            }
            Event::Catalogue { owner, catalogue } => {
                debug!(owner = %owner.short(), entries = catalogue.entries.len(), "catalogue");
                routes.handle_catalogue(now.instant, owner, catalogue);
                self.types_listed(owner);
            }
            Event::OwnerLost { owner, reason } => {
                info!("{} is out of reach: its topics and services wait for it", self.names.called(&owner));
                debug!(owner = %owner.short(), ?reason, "owner out of reach");
                routes.handle_owner_lost(owner, reason);
            }
            Event::OwnerRefused { owner, by } => {
                warn!("{} tells this node nothing of what it shares: {by}", self.names.called(&owner));
                routes.handle_owner_refused(owner, by);
            }
            Event::RenewAsked { .. }
            | Event::Renewed { .. }
            | Event::RenewRefused { .. }
            | Event::OperationAsked { .. }
            | Event::OperationAnswered { .. }
            | Event::OperationDenied { .. }
            | Event::ReportAsked { .. }
            | Event::Report { .. }
            | Event::ReportRefused { .. }
            | Event::PathAsked { .. }
            | Event::PathOffered { .. }
            | Event::PathRefused { .. }
            | Event::Time { .. }
            | Event::Rekeyed { .. }
            | Event::OwnGrant { .. }
            | Event::Recover(_)
            | Event::Confirmed { .. }
            | Event::Types { .. }
            | Event::Consumers { .. }
            | Event::ConsumersLost { .. }
            | Event::Wishes { .. }
            | Event::WishesLost { .. }
            | Event::Followed { .. }
            | Event::Granted { .. } => {}
        }
    }

    /// Writes events about access to this node's shares into the audit log.
    pub(super) fn audit_event(&self, event: &Event) {
        let about = |event, name| {
            let topic = self.routes.as_ref().and_then(|routes| routes.topic_of(name));
            AuditRecord::new(event).topic(topic).name(name)
        };
        match event {
            Event::SinkJoined { name, peer, .. } => {
                let epoch = self.endpoint.share_grant(name).map_or(0, |grant| grant.epoch);
                self.audit.write(about(AuditEvent::Granted, name).peer(peer).epoch(epoch));
            }
            Event::SinkLeft { name, peer, .. } => self.audit.write(about(AuditEvent::Left, name).peer(peer)),
            Event::SinkCut { name, peer, reason, .. } => {
                let revoked = *reason == RefuseReason::Revoked;
                let event = if revoked { AuditEvent::Revoked } else { AuditEvent::Cut };
                self.audit.write(about(event, name).peer(peer).reason(reason));
            }
            Event::Rekeyed { name, grant } => {
                self.audit.write(about(AuditEvent::Epoch, name).epoch(grant.epoch));
            }
            Event::SinkRefused { name, peer, reason } => {
                self.audit.write(about(AuditEvent::Refused, name).peer(peer).reason(reason));
            }
            _ => {}
        }
    }
}

/// Returns the topic or service of this node behind a name, for the log.
fn shown(routes: &Routes<ChaCha20Rng>, name: &Name) -> String {
    routes.topic_of(name).map_or_else(|| name.short(), str::to_owned)
}
