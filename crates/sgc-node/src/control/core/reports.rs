//! Reports: those that observers ask of this node, and those that its users ask of other nodes.

use std::time::Instant;

use bytes::Bytes;
use sgc_endpoint::{JoinStatus, RefusedBy, pack_report, unpack_report};
use sgc_ros::{RosNetwork, RouteState, RouteStatus, Routes};
use sgc_router::PathKind;
use sgc_trust::{Grantees, VerifiedPeer};
use sgc_wire::{Decode as _, Name, NodeId, RefuseReason, Report, ReportQuestion, SinkId};
use tokio::sync::oneshot;
use tracing::warn;

use super::Core;
use crate::admin::report::{
    NodeReport, Pong, REPORT_FAULTS_MAX, REPORT_LINKS_MAX, REPORT_NOT_DIRECT_MAX, REPORT_ROUTERS_MAX,
    REPORT_TOPICS_MAX, ReportEvent, ReportLink, ReportPath, ReportRights, ReportRouter, ReportTopic,
    keep_interface,
};
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::fleet::authority::Authority;
use crate::control::fleet::inquiries::{
    InquiryAnswer, InquiryError, InquiryPath, InquiryReport, InquiryTarget,
};
use crate::control::parts::link_table::LinkEntry;
use crate::drops::NodeDrop;
use crate::state::audit::{AuditEvent, AuditRecord};
use crate::state::credentials::lasts;

/// The path to the owner of an interface.
struct PathToOwner {
    /// The next node.
    via: NodeId,
    is_direct: bool,
    /// Its round-trip time, microseconds.
    cost_us: u64,
}

/// Reports of this node.
impl<N: RosNetwork> Core<N> {
    /// Sets who may ask this node how it is doing.
    pub(super) fn set_observers(&mut self, observers: Grantees) {
        let (is_offered, gone) = self.reports.set_observers(observers);
        for sink in gone {
            self.endpoint.answer_report(now(), sink, Err(RefuseReason::NotPermitted));
        }
        self.endpoint.offer_reports(now(), is_offered);
    }

    /// Answers an observer, or soon, and refuses others.
    pub(super) fn report_asked(&mut self, sink: SinkId, peer: &VerifiedPeer, question: &Bytes) {
        let answer = match ReportQuestion::from_slice(question) {
            _ if !self.reports.may_ask(peer) => {
                let node = self.names.called(&peer.node_id);
                if self.control_drops.count_from(NodeDrop::ReportNotPermitted, peer.node_id) {
                    warn!("refused a report to {node}, which is no observer; counted from here on");
                }
                let record = AuditRecord::new(AuditEvent::Refused).peer(&peer.node_id);
                self.audit.write(record.reason("a report: it is no observer"));
                Err(RefuseReason::NotPermitted)
            }
            // A later version may know further questions.
            Err(_) => Err(RefuseReason::RoleNotOffered),
            // It waits for no document of others.
            Ok(question @ ReportQuestion::Ping) => {
                pack_report(&self.document_job(&question)()).ok_or(RefuseReason::Limit)
            }
            Ok(question) => match self.reports.ask(Instant::now(), peer, sink, question) {
                Some(report) => Ok(report),
                None => return self.make_next_report(),
            },
        };
        self.endpoint.answer_report(now(), sink, answer);
    }

    pub(super) fn reports_due(&mut self, at: Instant) {
        if self.reports.deadline().is_some_and(|due| due <= at) {
            self.make_next_report();
        }
    }

    /// Makes the next report that somebody waits for, on a blocking thread: a document may be long, and an authority
    /// reads its file.
    fn make_next_report(&mut self) {
        let Some(question) = self.reports.next(Instant::now()) else { return };
        let Some(events) = self.events.upgrade() else { return };
        let (alive, document) = (self.alive.clone(), self.document_job(&question));
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            // A stopping node answers nobody.
            let _ = events.blocking_send(CoreEvent::ReportMade(question, pack_report(&document())));
        });
    }

    /// Answers those who wait for a report.
    pub(super) fn report_made(&mut self, question: ReportQuestion, report: Option<Report>) {
        for sink in self.reports.made(Instant::now(), question, report.as_ref()) {
            self.endpoint.answer_report(now(), sink, report.clone().ok_or(RefuseReason::Limit));
        }
        self.make_next_report();
    }

    /// Returns a blocking job that makes the document for a question, of the state as it is now.
    fn document_job(&mut self, question: &ReportQuestion) -> Box<dyn FnOnce() -> Bytes + Send> {
        match question {
            ReportQuestion::Node => {
                self.note_present_members();
                let members = self.authority.as_ref().map(Authority::members_job);
                let mut report = self.node_report();
                let events = self.authority.is_some().then(|| self.audit.recent_of_fleet()).flatten();
                report.events = events.map(|records| records.iter().map(ReportEvent::new).collect());
                Box::new(move || {
                    match members.map(|read| read()) {
                        Some(Ok(members)) => report.set_members(members),
                        Some(Err(_)) => {
                            let problem = "the authority cannot read the fleet's file; its log says why";
                            report.problems.insert(0, problem.to_owned());
                            report.problems.truncate(REPORT_FAULTS_MAX);
                        }
                        None => {}
                    }
                    report.into_json().into()
                })
            }
            ReportQuestion::Interface(interface) => {
                let (mut graph, interface) = (self.graph(None), interface.clone());
                graph.gateway_refused =
                    self.gateway.status().map(|status| status.refused).unwrap_or_default();
                Box::new(move || {
                    keep_interface(&mut graph, &interface);
                    serde_json::to_string(&graph).unwrap_or_default().into()
                })
            }
            ReportQuestion::Ping => {
                let pong = Pong { version: env!("CARGO_PKG_VERSION").to_owned() };
                Box::new(move || serde_json::to_string(&pong).unwrap_or_default().into())
            }
        }
    }

    /// Returns the path to the owner of another node's interface.
    fn path_to_owner(&self, name: &Name) -> Option<PathToOwner> {
        let owner = self.endpoint.owner_of(name)?;
        let (link, cost_us) = self.router.route(name)?;
        let entry = self.links.get(link)?;
        let via = entry.peer().node_id;
        // Routing counts less for a direct link than it takes.
        let cost_us = match self.direct.is_direct(link) {
            true => entry.stats().rtt.as_micros().try_into().unwrap_or(u64::MAX),
            false => cost_us.into(),
        };
        Some(PathToOwner { via, is_direct: via == owner, cost_us })
    }

    fn node_report(&self) -> NodeReport {
        let identity = self.certificates.identity();
        let mut alerts = self.alerts();
        alerts.extend(self.gateway.alerts().into_iter().chain(self.metrics.alerts()));
        alerts.truncate(REPORT_FAULTS_MAX);
        let mut problems = self.problems();
        problems.truncate(REPORT_FAULTS_MAX);
        let topic = |route: RouteStatus| {
            let waiting = route.state == RouteState::AwaitsLocal;
            let stuck = matches!(
                route.state,
                RouteState::Owner(_) | RouteState::NotListed { is_pattern: false } | RouteState::Refused(_)
            );
            let sink = route.name.and_then(|name| self.sinks.get(&name));
            let path = route.name.and_then(|name| self.path_to_owner(&name));
            let age = sink.and_then(|sink| sink.last_age());
            let forwarded = route.name.and_then(|name| self.forwards.get(&name));
            let drops = forwarded.map(|(_, stats)| stats.reasons()).unwrap_or_default();
            let line = self.route_line(route);
            ReportTopic {
                direction: line.direction.to_owned(),
                topic: line.topic,
                type_name: line.type_name,
                owner: line.owner,
                state: line.state,
                stuck,
                waiting,
                messages: line.messages,
                age_us: age.map(|age| age.age_us),
                age_error_us: age.and_then(|age| age.error_us),
                direct: path.as_ref().is_some_and(|path| path.is_direct),
                path_us: path.as_ref().map(|path| path.cost_us),
                via: path.map(|path| path.via.to_string()),
                drops,
            }
        };
        let mut topics = self.routes.iter().flat_map(Routes::status);
        let shown = topics.by_ref().take(REPORT_TOPICS_MAX).map(topic).collect();
        let link = |(id, entry): (_, &LinkEntry)| {
            let (peer, stats) = (entry.peer().node_id, entry.stats());
            ReportLink {
                peer: peer.to_string(),
                name: self.names.get(&peer),
                rtt_us: stats.rtt.as_micros().try_into().unwrap_or(u64::MAX),
                sent_packets: stats.sent_packets,
                lost_packets: stats.lost_packets,
                silent: self.router.link_cost(id).is_some_and(|(_, is_silent)| is_silent),
                dialled: entry.url().is_some(),
                direct: self.direct.is_direct(id),
            }
        };
        let routers = self.board.snapshot().into_iter().take(REPORT_ROUTERS_MAX);
        let mut not_direct = self.not_direct();
        let not_direct_shown = not_direct.by_ref().take(REPORT_NOT_DIRECT_MAX).collect();
        NodeReport {
            node: identity.node_name().to_string(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            uptime_s: self.started.elapsed().as_secs(),
            clock_ms: now().unix.0,
            has_ros: self.routes.is_some(),
            is_router: self.router.is_transit(),
            certificate_until_ms: identity.not_after().0,
            certificate_lasts_ms: lasts(identity.as_peer()),
            secret_generation: identity.naming_secrets().first().map(|secret| secret.generation),
            links: self.links.iter().take(REPORT_LINKS_MAX).map(link).collect(),
            links_omitted: self.links.iter().count().saturating_sub(REPORT_LINKS_MAX),
            not_direct: not_direct_shown,
            not_direct_omitted: not_direct.count(),
            routers: routers
                .map(|search| ReportRouter {
                    router: search.router,
                    state: search.state.to_string(),
                    last_failure: search.last_failure,
                })
                .collect(),
            topics: shown,
            topics_omitted: topics.count(),
            rights: Some(ReportRights::clone(&self.rights)),
            drops: self.drops_by_reason(),
            refused: self.all_refused(),
            alerts,
            problems,
            members: None,
            members_omitted: 0,
            events: None,
        }
    }
}

/// Reports of other nodes.
impl<N: RosNetwork> Core<N> {
    /// Asks a node for a report, on behalf of a user.
    pub(super) fn inquire(
        &mut self,
        at: &InquiryTarget,
        question: ReportQuestion,
        over: Option<PathKind>,
        reply: oneshot::Sender<InquiryAnswer>,
    ) {
        let identity = self.certificates.identity();
        let node = match at {
            InquiryTarget::Node(name) => identity.node_id_of(name.as_str()).ok_or(InquiryError::NoSecret),
            InquiryTarget::Authority => identity.authority().ok_or(InquiryError::NoAuthority),
        };
        let is_own = matches!(at, InquiryTarget::Node(name) if name == identity.node_name())
            || node.as_ref().is_ok_and(|node| *node == identity.node_id());
        let node = match node {
            _ if is_own => {
                let document = self.document_job(&question);
                tokio::task::spawn_blocking(move || {
                    reply.send(Ok(InquiryReport { document: document(), path: None }))
                });
                return;
            }
            Err(why) => {
                let _ = reply.send(Err(why));
                return;
            }
            Ok(node) => node,
        };
        let over = over.or_else(|| match question {
            ReportQuestion::Ping => self.path_of_ping(&node),
            ReportQuestion::Node | ReportQuestion::Interface(_) => None,
        });
        self.inquiries.push(Instant::now(), node, question, over, reply);
        self.next_inquiry();
    }

    /// Takes a report of another node.
    pub(super) fn take_report(&mut self, name: Name, report: &Report) {
        let path = self.inquiry_path(&name);
        let document = unpack_report(report).map_err(|_| InquiryError::Unreadable);
        if self.inquiries.end(name, document.map(|document| InquiryReport { document, path })) {
            self.leave_report(&name);
            self.next_inquiry();
        }
    }

    /// Returns the path to the node of a question, and whether there is another one.
    fn inquiry_path(&self, name: &Name) -> Option<InquiryPath> {
        let owner = self.endpoint.owner_of(name)?;
        let PathToOwner { via, is_direct, cost_us } = self.path_to_owner(name)?;
        let mut dialled = self.links.iter().filter(|(_, link)| link.peer().node_id == via);
        let url = dialled.find_map(|(_, link)| link.url().map(str::to_owned));
        let via = self.names.get(&via).or(url).unwrap_or_else(|| via.short());
        let has_direct = self.direct.links_to(&owner).next().is_some();
        let has_others = self.links.iter().any(|(id, _)| !self.direct.is_direct(id));
        let not_direct = (!is_direct && !has_direct).then(|| self.why_not_direct(&owner));
        Some(InquiryPath {
            path: ReportPath { via, direct: is_direct, path_us: cost_us },
            has_relayed: is_direct && has_direct && has_others && !self.router.is_transit(),
            not_direct,
        })
    }

    /// Returns the kind of path for a ping: it goes over a direct link if one works.
    fn path_of_ping(&self, node: &NodeId) -> Option<PathKind> {
        let works = |link| self.router.link_cost(link).is_some_and(|(_, is_silent)| !is_silent);
        // Only a node that relies on its routers hears of several paths.
        let has_choice = !self.router.is_transit() && self.direct.links_to(node).any(works);
        has_choice.then_some(PathKind::Direct)
    }

    fn leave_report(&mut self, name: &Name) {
        self.endpoint.leave(now(), name);
        self.router.require_path(*name, None);
    }

    pub(super) fn report_refused(&mut self, name: Name, by: RefusedBy) {
        if self.inquiries.refused(name, by) {
            self.leave_report(&name);
            self.next_inquiry();
        }
    }

    pub(super) fn inquiries_due(&mut self, at: Instant) {
        if self.inquiries.deadline().is_none_or(|due| due > at) {
            return;
        }
        let endpoint = &self.endpoint;
        let is_found = |name: &Name| !matches!(endpoint.join_status(name), None | Some(JoinStatus::Waiting));
        for name in self.inquiries.expire(at, is_found) {
            self.leave_report(&name);
        }
        self.next_inquiry();
    }

    fn next_inquiry(&mut self) {
        let (at, endpoint, router) = (Instant::now(), &mut self.endpoint, &mut self.router);
        while self.inquiries.next(at, |node, question, over| {
            let name = endpoint.ask_report(now(), node, question);
            router.require_path(name, over);
            name
        }) {}
    }
}
