//! Services: calls of local clients to other nodes, and calls of other nodes to local servers.

use std::collections::BTreeMap;
use std::sync::Arc;

use sgc_endpoint::{CallLoss, CallStats, Event};
use sgc_ros::{RosNetwork, RouteStatus, ServiceSpec, Shaping};
use sgc_wire::{Name, Now, SinkId, TopicGrant};
use tracing::error;

use super::{Core, drop_elsewhere};
use crate::admin::graph::{LostCalls, ServiceCalls};
use crate::control::event::{CoreEvent, ServiceEnd};
use crate::data::call_ledger::{CallLedger, CallerId};
use crate::data::calls::{Answers, Calls, Requests};
use crate::data::writer_queue::{WriterInfo, WriterQueue};
use crate::drops::NodeDrop;

impl<N: RosNetwork> Core<N> {
    /// Starts a shared service. Incoming messages are calls, not messages of publishers.
    pub(super) fn begin_local(&mut self, name: Name) {
        let Some(share) = self.shares.get(&name).cloned() else { return };
        let served = self.services.create_local(name, share);
        let takes = served.clone();
        self.begin_calls(name, Calls::LocalService(served), move |message| takes.take(message));
    }

    /// Starts a used service. Incoming messages are replies.
    pub(super) fn begin_far(&mut self, name: Name) {
        let Some(share) = self.shares.get(&name).cloned() else { return };
        let called = self.services.create_far(name, share);
        let takes = called.clone();
        self.begin_calls(name, Calls::FarService(called), move |message| takes.take(message));
    }

    fn begin_calls(
        &mut self,
        name: Name,
        calls: Calls,
        mut take: impl FnMut(sgc_endpoint::Message) + Send + 'static,
    ) {
        let take = move |message, _| take(message);
        let queue = WriterQueue::new(self.writers.clone(), WriterInfo::default(), Shaping::default(), take);
        self.sinks.add(name, false).set_writer(None, Some(queue), &self.data);
        self.services.add(name, calls);
    }

    /// Ends a service that is no longer shared or used.
    pub(super) fn end_calls(&mut self, name: &Name) {
        if let Some(calls) = self.services.get(name) {
            calls.withdraw();
        }
        self.close_calls(name);
    }

    fn close_calls(&mut self, name: &Name) {
        self.graph.service_gone(name);
        if let Some(old) = self.services.remove(name) {
            drop_elsewhere(old);
        }
    }

    pub(super) fn close_all_calls(&mut self) {
        for name in self.services.names() {
            self.close_calls(&name);
        }
    }

    /// Handles the owner's grant to call a service.
    pub(super) fn call_granted(&mut self, now: Now, name: Name, sink: SinkId, grant: TopicGrant, anew: bool) {
        let Some(called) = self.services.far(&name) else { return };
        self.sinks.grant(now.instant, name, sink, grant);
        called.granted(sink, anew);
    }

    /// Handles endpoint events about services.
    pub(super) fn calls_event(&self, event: &Event) {
        let name = match event {
            Event::SinkJoined { name, .. } | Event::SinkLeft { name, .. } | Event::SinkCut { name, .. } => {
                name
            }
            Event::Lost { name, .. } => {
                if let Some(called) = self.services.far(name) {
                    called.lost();
                }
                return;
            }
            _ => return,
        };
        if let Some(served) = self.services.local(name) {
            served.set_callers(self.endpoint.publishers(name));
        }
    }

    pub(super) fn open_client(&mut self, name: Name, spec: ServiceSpec) {
        let Some(served) = self.services.local(&name).cloned() else { return };
        if served.keep_client() {
            return;
        }
        self.make_service_end(name, spec, move |network, spec| {
            let handler = Box::new(Answers(served));
            network.create_client(spec, handler).map(|client| ServiceEnd::Client(Arc::new(client)))
        });
    }

    pub(super) fn close_client(&mut self, name: &Name) {
        self.services.forget_end(name);
        if let Some(served) = self.services.local(name)
            && let Some(old) = served.end_client()
        {
            self.graph.service_gone(name);
            drop_elsewhere(old);
        }
    }

    pub(super) fn open_server(&mut self, name: Name, spec: ServiceSpec) {
        let Some(called) = self.services.far(&name).cloned() else { return };
        self.make_service_end(name, spec, move |network, spec| {
            let handler = Box::new(Requests(called));
            network.create_server(spec, handler).map(|server| ServiceEnd::Server(Arc::new(server)))
        });
    }

    pub(super) fn close_service_end(&mut self, name: &Name) {
        self.services.forget_end(name);
        self.graph.service_gone(name);
        if let Some(called) = self.services.far(name)
            && let Some(old) = called.set_server(None)
        {
            drop_elsewhere(old);
        }
    }

    fn make_service_end(
        &mut self,
        name: Name,
        spec: ServiceSpec,
        make: impl FnOnce(&N, &ServiceSpec) -> Result<ServiceEnd, sgc_ros::RosError> + Send + 'static,
    ) {
        self.services.want_end(name, spec.clone());
        let (Some(network), Some(events)) = (self.network.get(), self.events.upgrade()) else { return };
        let (alive, failures) = (self.alive.clone(), self.ros_failures.clone());
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            match make(&network, &spec) {
                Ok(end) => drop(events.blocking_send(CoreEvent::ServiceReady { name, spec, end })),
                Err(why) => {
                    failures.count(NodeDrop::CreateService);
                    error!("{why}");
                }
            }
        });
    }

    pub(super) fn service_ready(&mut self, name: Name, spec: &ServiceSpec, end: ServiceEnd) {
        let wanted = !self.reopening.is_closed() && self.services.wants_end(&name, spec);
        if wanted {
            self.graph.service_there(
                name,
                match &end {
                    ServiceEnd::Client(client) => client.guids(),
                    ServiceEnd::Server(server) => server.guids(),
                },
            );
        }
        let old = if wanted { self.services.put_end(&name, end) } else { Some(Box::new(end) as _) };
        if let Some(old) = old {
            drop_elsewhere(old);
        }
    }

    /// Returns the statistics of a route's calls, as an addition to its state.
    pub(super) fn describe_calls(&self, route: &RouteStatus) -> Option<String> {
        let calls = route.name.and_then(|name| self.services.get(&name))?;
        let CallStats { calls: now, open, answered: answered_now } = calls.stats();
        let (_, past, losses) = calls.ledger().read();
        let (calls, answered) = (past.calls + now, past.answered + answered_now);
        let refused = losses.get(&CallLoss::Refused).map_or(0, |losses| losses.count);
        let lost = losses.values().map(|losses| losses.count).sum::<u64>() - refused;
        Some(format!(
            ", {calls} calls, {open} in progress, {answered} answered, {refused} refused, {lost} lost"
        ))
    }

    /// Returns the services with lost calls.
    pub(super) fn lost_calls(&self) -> Vec<ServiceCalls> {
        let of_service = |(name, ledger): (&Name, &CallLedger)| {
            let (topic, _, losses) = ledger.read();
            let lost = losses.into_iter().map(|(loss, losses)| LostCalls {
                reason: loss.key().to_owned(),
                count: losses.count,
                since_answer: losses.since_answer,
                by: self.named_callers(name, losses.by),
                last_s: losses.last.elapsed().as_secs(),
            });
            let lost: Vec<_> = lost.collect();
            (!lost.is_empty()).then_some(ServiceCalls { topic, is_served: ledger.is_served, lost })
        };
        self.services.ledgers().filter_map(of_service).collect()
    }

    fn named_callers(&self, name: &Name, by: BTreeMap<CallerId, u64>) -> BTreeMap<String, u64> {
        let mut named = BTreeMap::new();
        for (of, calls) in by {
            if let Some(caller) = self.caller_name(name, of) {
                *named.entry(caller).or_default() += calls;
            }
        }
        named
    }

    /// Returns the caller's name, if the caller still exists.
    fn caller_name(&self, name: &Name, of: CallerId) -> Option<String> {
        match of {
            CallerId::Client(guid) => {
                let node = self.routes.as_ref()?.node_of(&guid)?;
                Some(format!("{}/{}", node.namespace().trim_end_matches('/'), node.name()))
            }
            CallerId::Source(source) => {
                let sink = *self.endpoint.publishers(name).get(&source)?;
                let granted = self.endpoint.granted(name);
                granted.into_iter().find(|(id, _)| *id == sink).map(|(_, peer)| self.names.called(&peer))
            }
        }
    }
}
