//! Services: what local clients call elsewhere, and local servers for others.

use std::sync::Arc;
use std::time::Instant;

use sgc_endpoint::{CallStats, Event};
use sgc_ros::{DiscoveryEvent, RosNetwork, RouteStatus, ServiceSpec, Shaping};
use sgc_wire::{Name, Now, SinkId, TopicGrant};
use tracing::error;

use super::{Core, CoreEvent, EPOCH_GRACE, ServiceEnd, drop_elsewhere};
use crate::calls::{Called, Calls, Served};
use crate::sinks::{Behind, LocalSink, WriterQueue};

impl<N: RosNetwork> Core<N> {
    /// A share is a service: what comes is calls, not what others publish.
    pub(super) fn begin_served(&mut self, name: Name) {
        let Some(share) = self.shares.get(&name) else { return };
        let served = Arc::new(Served::new(share.clone(), self.ros_failures.clone()));
        let takes = served.clone();
        self.begin_calls(name, Calls::Served(served), move |message| takes.take(message));
    }

    /// A name that this node publishes under is a service: what comes is answers.
    pub(super) fn begin_called(&mut self, name: Name) {
        let Some(share) = self.shares.get(&name) else { return };
        let called = Called::new(share.clone(), self.ros_failures.clone(), self.epoch_over.clone());
        let called = Arc::new(called);
        let takes = called.clone();
        self.begin_calls(name, Calls::Called(called), move |message| takes.take(message));
    }

    fn begin_calls(
        &mut self,
        name: Name,
        calls: Calls,
        mut take: impl FnMut(sgc_endpoint::Message) + Send + 'static,
    ) {
        let (alive, failures) = (self.alive.clone(), self.ros_failures.clone());
        let queue = match WriterQueue::spawn_with(
            "sgc-calls",
            Behind::default(),
            Shaping::default(),
            failures,
            alive,
            move |message, _| take(message),
        ) {
            Ok(queue) => queue,
            Err(why) => return error!(%why, "a service has no thread and cannot be used"),
        };
        let sink = LocalSink::new(name, false, self.requests.clone(), self.data.holds().clone());
        let sink = Arc::new(sink);
        sink.set_writer(None, Some(queue));
        self.sinks.insert(name, sink);
        self.calls.insert(name, calls);
    }

    pub(super) fn end_calls(&mut self, name: &Name) {
        self.service_ends.remove(name);
        self.graph.service_gone(name);
        if let Some(old) = self.calls.remove(name).and_then(|calls| calls.close()) {
            drop_elsewhere(old);
        }
    }

    pub(super) fn close_all_calls(&mut self) {
        for name in self.calls.keys().copied().collect::<Vec<_>>() {
            self.end_calls(&name);
        }
    }

    /// The owner of a service granted that this node calls it.
    pub(super) fn call_granted(&mut self, now: Now, name: Name, sink: SinkId, grant: TopicGrant, anew: bool) {
        let (Some(Calls::Called(called)), Some(local)) = (self.calls.get(&name), self.sinks.get(&name))
        else {
            return;
        };
        local.grant(sink, grant, &self.data);
        self.retire_due.insert(name, now.instant + EPOCH_GRACE);
        called.granted(sink, anew);
    }

    /// What happened to services.
    pub(super) fn calls_event(&self, event: &Event) {
        let name = match event {
            Event::SinkJoined { name, .. } | Event::SinkLeft { name, .. } | Event::SinkCut { name, .. } => {
                name
            }
            Event::Lost { name, .. } => {
                if let Some(Calls::Called(called)) = self.calls.get(name) {
                    called.lost();
                }
                return;
            }
            _ => return,
        };
        if let Some(Calls::Served(served)) = self.calls.get(name) {
            served.set_callers(self.endpoint.publishers(name));
        }
    }

    /// A local client that is gone waits for nothing.
    pub(super) fn calls_discovery(&self, event: &DiscoveryEvent) {
        let DiscoveryEvent::Vanished { guid } = event else { return };
        for calls in self.calls.values() {
            if let Calls::Called(called) = calls {
                called.endpoint_gone(guid);
            }
        }
    }

    /// Asks what became of calls that have been quiet for long.
    pub(super) fn calls_due(&self, now: Instant) {
        for calls in self.calls.values() {
            if let Calls::Called(called) = calls {
                called.ask_due(now);
            }
        }
    }

    pub(super) fn calls_deadline(&self) -> Option<Instant> {
        let deadline = |calls: &Calls| match calls {
            Calls::Called(called) => called.deadline(),
            Calls::Served(_) => None,
        };
        self.calls.values().filter_map(deadline).min()
    }

    pub(super) fn servers_gone(&self, name: &Name) {
        if let Some(Calls::Served(served)) = self.calls.get(name) {
            served.servers_gone();
        }
    }

    pub(super) fn open_client(&mut self, name: Name, spec: ServiceSpec) {
        let Some(Calls::Served(served)) = self.calls.get(&name).cloned() else { return };
        if served.keep_client() {
            return;
        }
        self.make_service_end(name, spec, move |network, spec| {
            let answers = served.clone();
            let handler = Box::new(move |id, payload| answers.answer(id, payload));
            network.create_client(spec, handler).map(|client| ServiceEnd::Client(Arc::new(client)))
        });
    }

    pub(super) fn close_client(&mut self, name: &Name) {
        self.service_ends.remove(name);
        if let Some(Calls::Served(served)) = self.calls.get(name)
            && let Some(old) = served.end_client()
        {
            self.graph.service_gone(name);
            drop_elsewhere(old);
        }
    }

    pub(super) fn open_server(&mut self, name: Name, spec: ServiceSpec) {
        let Some(Calls::Called(called)) = self.calls.get(&name).cloned() else { return };
        self.make_service_end(name, spec, move |network, spec| {
            let calls = called.clone();
            let handler = Box::new(move |id, payload| calls.call(id, payload));
            network.create_server(spec, handler).map(|server| ServiceEnd::Server(Arc::new(server)))
        });
    }

    pub(super) fn close_service_end(&mut self, name: &Name) {
        self.service_ends.remove(name);
        self.graph.service_gone(name);
        if let Some(Calls::Called(called)) = self.calls.get(name)
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
        let (Some(network), Some(events)) = (self.network.get(), self.events.upgrade()) else { return };
        self.service_ends.insert(name, spec.clone());
        let (alive, failures) = (self.alive.clone(), self.ros_failures.clone());
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            match make(&network, &spec) {
                Ok(end) => drop(events.blocking_send(CoreEvent::ServiceReady { name, spec, end })),
                Err(why) => {
                    failures.count("create_service");
                    error!("{why}");
                }
            }
        });
    }

    pub(super) fn service_ready(&mut self, name: Name, spec: &ServiceSpec, end: ServiceEnd) {
        let wanted = self.service_ends.get(&name) == Some(spec);
        if wanted {
            self.graph.service_there(
                name,
                match &end {
                    ServiceEnd::Client(client) => client.guids(),
                    ServiceEnd::Server(server) => server.guids(),
                },
            );
        }
        let old = match (self.calls.get(&name).filter(|_| wanted), end) {
            (Some(Calls::Served(served)), ServiceEnd::Client(client)) => served.set_client(Some(client)),
            (Some(Calls::Called(called)), ServiceEnd::Server(server)) => called.set_server(Some(server)),
            (_, ServiceEnd::Client(client)) => Some(Box::new(client) as _),
            (_, ServiceEnd::Server(server)) => Some(Box::new(server) as _),
        };
        if let Some(old) = old {
            drop_elsewhere(old);
        }
    }

    /// Adds to a route's state what became of its calls.
    pub(super) fn describe_calls(&self, route: &mut RouteStatus) {
        if let Some(calls) = route.name.and_then(|name| self.calls.get(&name)) {
            let CallStats { calls, open, answered, refused, lost } = calls.stats();
            let counts = format!(
                ", {calls} calls, {open} in progress, {answered} answered, {refused} refused, {lost} lost"
            );
            route.state.push_str(&counts);
        }
    }
}
