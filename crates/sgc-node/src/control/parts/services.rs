//! [`Services`]: the services that this node shares and uses, their wanted clients and servers on the local network,
//! and the ledgers of lost calls.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;
use std::time::Instant;

use sgc_ros::{Guid, ServiceSpec, ServiceTopic};
use sgc_wire::Name;
use tokio::sync::Notify;

use crate::control::event::ServiceEnd;
use crate::control::parts::network_ends::OpenEnd;
use crate::data::call_ledger::{CallLedger, LEDGERS_MAX};
use crate::data::calls::{Calls, FarService, LocalService};
use crate::data::sending::share::LocalShare;
use crate::data::stats::Drops;

/// Shared and used services.
pub(crate) struct Services {
    calls: BTreeMap<Name, Calls>,
    /// Lost calls by service. They outlive the services.
    ledgers: BTreeMap<Name, Arc<CallLedger>>,
    /// Wanted local clients and servers of the services.
    ends: HashMap<Name, ServiceSpec>,
    failures: Arc<Drops>,
    /// Wakes the control task, which asks for the state of calls.
    wake: Arc<Notify>,
}

impl Services {
    /// Creates the part without services.
    pub(crate) fn new(failures: Arc<Drops>, wake: Arc<Notify>) -> Self {
        Self { calls: BTreeMap::new(), ledgers: BTreeMap::new(), ends: HashMap::new(), failures, wake }
    }

    /// Creates a shared service, which [`Self::add`] adds once its messages can be taken.
    pub(crate) fn create_local(&mut self, name: Name, share: Arc<LocalShare>) -> Arc<LocalService> {
        let ledger = self.ledger(name, true);
        Arc::new(LocalService::new(share, self.failures.clone(), ledger))
    }

    /// Creates a used service, which [`Self::add`] adds once its messages can be taken.
    pub(crate) fn create_far(&mut self, name: Name, share: Arc<LocalShare>) -> Arc<FarService> {
        let ledger = self.ledger(name, false);
        Arc::new(FarService::new(share, self.failures.clone(), ledger, self.wake.clone()))
    }

    /// Returns the ledger of a service's lost calls, over all its routes so far.
    fn ledger(&mut self, name: Name, is_served: bool) -> Arc<CallLedger> {
        if self.ledgers.len() >= LEDGERS_MAX && !self.ledgers.contains_key(&name) {
            let ended = self.ledgers.keys().find(|name| !self.calls.contains_key(*name)).copied();
            if let Some(name) = ended {
                self.ledgers.remove(&name);
            }
        }
        let failures = self.failures.clone();
        let new = || Arc::new(CallLedger::new(is_served, failures));
        self.ledgers.entry(name).or_insert_with(new).clone()
    }

    pub(crate) fn add(&mut self, name: Name, calls: Calls) {
        self.calls.insert(name, calls);
    }

    /// Removes a service. Returns its local endpoint.
    pub(crate) fn remove(&mut self, name: &Name) -> Option<OpenEnd> {
        self.ends.remove(name);
        self.calls.remove(name).and_then(|calls| calls.close())
    }

    pub(crate) fn get(&self, name: &Name) -> Option<&Calls> {
        self.calls.get(name)
    }

    pub(crate) fn names(&self) -> Vec<Name> {
        self.calls.keys().copied().collect()
    }

    /// Returns a shared service.
    pub(crate) fn local(&self, name: &Name) -> Option<&Arc<LocalService>> {
        match self.calls.get(name)? {
            Calls::LocalService(served) => Some(served),
            Calls::FarService(_) => None,
        }
    }

    /// Returns a used service.
    pub(crate) fn far(&self, name: &Name) -> Option<&Arc<FarService>> {
        match self.calls.get(name)? {
            Calls::FarService(called) => Some(called),
            Calls::LocalService(_) => None,
        }
    }

    /// Returns the ledgers of all services, also of past ones.
    pub(crate) fn ledgers(&self) -> impl Iterator<Item = (&Name, &CallLedger)> {
        self.ledgers.iter().map(|(name, ledger)| (name, &**ledger))
    }

    /// Ends the calls of a local client or server that disappeared.
    pub(crate) fn endpoint_gone(&self, guid: &Guid) {
        for calls in self.calls.values() {
            match calls {
                Calls::FarService(called) => called.endpoint_gone(guid),
                Calls::LocalService(served) => served.endpoint_gone(guid),
            }
        }
    }

    /// Asks for the state of calls without news for long.
    pub(crate) fn handle_timeout(&self, now: Instant) {
        for calls in self.calls.values() {
            if let Calls::FarService(called) = calls {
                called.ask_due(now);
            }
        }
    }

    /// Returns the time at which the state of a call is asked for next.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        let deadline = |calls: &Calls| match calls {
            Calls::FarService(called) => called.deadline(),
            Calls::LocalService(_) => None,
        };
        self.calls.values().filter_map(deadline).min()
    }

    /// Wants a local client or server.
    pub(crate) fn want_end(&mut self, name: Name, spec: ServiceSpec) {
        if let (Some(calls), Some((_, service, _))) =
            (self.calls.get(&name), ServiceTopic::parse(&spec.request.topic, &spec.request.type_name))
        {
            calls.ledger().set_topic(service);
        }
        self.ends.insert(name, spec);
    }

    /// Returns `true` if a client or server like this one is wanted.
    pub(crate) fn wants_end(&self, name: &Name, spec: &ServiceSpec) -> bool {
        self.ends.get(name) == Some(spec)
    }

    /// Wants no local client or server any longer.
    pub(crate) fn forget_end(&mut self, name: &Name) {
        self.ends.remove(name);
    }

    /// Takes a new client or server into use. Returns the previous one, or this one if the service is of the other
    /// kind.
    pub(crate) fn put_end(&self, name: &Name, end: ServiceEnd) -> Option<OpenEnd> {
        match (self.calls.get(name), end) {
            (Some(Calls::LocalService(served)), ServiceEnd::Client(client)) => {
                served.set_client(Some(client))
            }
            (Some(Calls::FarService(called)), ServiceEnd::Server(server)) => called.set_server(Some(server)),
            (_, end) => Some(Box::new(end)),
        }
    }

    /// Returns all wanted clients and servers.
    pub(crate) fn ends(&self) -> Vec<(Name, ServiceSpec)> {
        self.ends.iter().map(|(name, spec)| (*name, spec.clone())).collect()
    }

    /// Returns the clients and servers that exist, which end with the local network. They stay wanted.
    pub(crate) fn take_ends(&self) -> Vec<OpenEnd> {
        let ending = self.calls.values().filter_map(|calls| match calls {
            Calls::LocalService(served) => {
                // Replies of servers reach nobody from here on.
                served.servers_gone();
                served.set_client(None)
            }
            Calls::FarService(called) => called.set_server(None),
        });
        ending.collect()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use bytes::Bytes;
    use sgc_endpoint::CallLoss;
    use sgc_ros::{EndpointSpec, RequestId, RosClient, RosError, RosServer, SentRequest};
    use sgc_wire::{Qos, SinkId};

    use super::*;
    use crate::data::sending::fixtures::share;

    const LOCAL: Name = Name([1; 32]);
    const FAR: Name = Name([2; 32]);

    /// A client without servers, and a server without clients.
    struct Alone;

    impl RosClient for Alone {
        fn send(&self, _: Bytes) -> Result<SentRequest, RosError> {
            Err(RosError::Closed)
        }

        fn servers(&self) -> BTreeSet<Guid> {
            BTreeSet::new()
        }

        fn guids(&self) -> [Guid; 2] {
            [Guid([1; 16]), Guid([2; 16])]
        }
    }

    impl RosServer for Alone {
        fn reply(&self, _: &RequestId, _: Bytes) -> Result<(), RosError> {
            Err(RosError::Closed)
        }

        fn guids(&self) -> [Guid; 2] {
            [Guid([3; 16]), Guid([4; 16])]
        }
    }

    /// Returns a shared service and a used one.
    fn services() -> Services {
        let mut services = Services::new(Arc::default(), Arc::default());
        let (_, share, _) = share();
        let local = services.create_local(LOCAL, share.clone());
        let far = services.create_far(FAR, share);
        services.add(LOCAL, Calls::LocalService(local));
        services.add(FAR, Calls::FarService(far));
        services
    }

    fn spec(service: &str) -> ServiceSpec {
        let end = |prefix: &str, part: &str| EndpointSpec {
            topic: format!("{prefix}/{service}{part}"),
            type_name: format!("x::srv::dds_::S_{part}_"),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos::default(),
        };
        ServiceSpec { request: end("rq", "Request"), reply: end("rr", "Reply") }
    }

    fn client() -> ServiceEnd {
        ServiceEnd::Client(Arc::new(Alone))
    }

    fn server() -> ServiceEnd {
        ServiceEnd::Server(Arc::new(Alone))
    }

    #[tokio::test]
    async fn shared_service_takes_a_client_and_used_one_a_server() {
        let services = services();
        assert!(services.local(&LOCAL).is_some() && services.far(&LOCAL).is_none());
        assert!(services.far(&FAR).is_some() && services.local(&FAR).is_none());
        assert!(services.put_end(&LOCAL, client()).is_none() && services.put_end(&FAR, server()).is_none());
        assert!(services.put_end(&LOCAL, client()).is_some(), "the previous one comes back");
        for (name, end) in [(LOCAL, server()), (FAR, client()), (Name([9; 32]), client())] {
            let back = services.put_end(&name, end).unwrap();
            assert!(back.is::<ServiceEnd>(), "it is of no use there");
        }
        assert_eq!(services.take_ends().len(), 2);
        assert!(services.take_ends().is_empty(), "they ended with the network");
    }

    #[tokio::test]
    async fn wanted_ends_outlive_the_network_and_end_with_their_service() {
        let mut services = services();
        services.want_end(LOCAL, spec("a"));
        assert!(services.wants_end(&LOCAL, &spec("a")) && !services.wants_end(&LOCAL, &spec("b")));
        services.want_end(LOCAL, spec("b"));
        assert!(services.wants_end(&LOCAL, &spec("b")) && !services.wants_end(&LOCAL, &spec("a")));
        services.put_end(&LOCAL, client());
        assert_eq!(services.take_ends().len(), 1);
        assert_eq!(services.ends(), [(LOCAL, spec("b"))]);
        services.put_end(&LOCAL, client());
        assert!(services.remove(&LOCAL).is_some(), "its client is returned");
        assert_eq!((services.ends(), services.names()), (vec![], vec![FAR]));
        services.want_end(FAR, spec("a"));
        services.forget_end(&FAR);
        assert!(
            services.ends().is_empty() && services.remove(&FAR).is_none() && services.remove(&FAR).is_none()
        );
    }

    #[tokio::test]
    async fn ledger_outlives_its_service_and_knows_the_name_of_its_topic() {
        let mut services = services();
        services.want_end(LOCAL, spec("a"));
        services.get(&LOCAL).unwrap().ledger().count(CallLoss::ServerGone, None, 3);
        services.remove(&LOCAL);
        let (_, share, _) = share();
        let again = services.create_local(LOCAL, share);
        services.add(LOCAL, Calls::LocalService(again));
        let (topic, _, losses) = services.get(&LOCAL).unwrap().ledger().read();
        assert_eq!((topic.as_str(), losses[&CallLoss::ServerGone].count), ("/a", 3));
        assert_eq!(
            services.ledgers().map(|(name, ledger)| (*name, ledger.is_served)).collect::<Vec<_>>(),
            [(LOCAL, true), (FAR, false)]
        );
    }

    #[tokio::test]
    async fn ledgers_of_ended_services_make_room_and_those_of_running_ones_stay() {
        let mut services = services();
        let (_, share, _) = share();
        let name = |n: usize| {
            let mut name = [0xff; 32];
            name[..8].copy_from_slice(&n.to_be_bytes());
            Name(name)
        };
        for n in 0..2 * LEDGERS_MAX {
            services.create_local(name(n), share.clone());
        }
        assert_eq!(services.ledgers().count(), LEDGERS_MAX);
        let is_known = |services: &Services, name: Name| services.ledgers().any(|(known, _)| *known == name);
        assert!(is_known(&services, LOCAL) && is_known(&services, FAR));
        assert!(is_known(&services, name(2 * LEDGERS_MAX - 1)), "the newest has one");
        // With a ledger for each of them, running services exceed the number of ended ones that are remembered.
        for n in 0..LEDGERS_MAX {
            let local = services.create_local(name(n), share.clone());
            services.add(name(n), Calls::LocalService(local));
        }
        assert!((0..LEDGERS_MAX).all(|n| is_known(&services, name(n))) && is_known(&services, LOCAL));
    }

    #[tokio::test]
    async fn state_of_a_call_without_news_is_asked_for() {
        let services = services();
        assert_eq!(services.deadline(), None);
        let far = services.far(&FAR).unwrap();
        far.granted(SinkId([5; 16]), true);
        let asker = Some(Guid([7; 16]));
        far.call(RequestId { client: [7; 16], number: 1, asker }, Bytes::from_static(b"request"));
        let due = services.deadline().unwrap();
        services.handle_timeout(due);
        let later = services.deadline().unwrap();
        assert!(later > due, "the next question comes later");
        services.endpoint_gone(&Guid([8; 16]));
        assert_eq!(services.deadline(), Some(later), "another endpoint went");
        services.endpoint_gone(&Guid([7; 16]));
        assert_eq!(services.deadline(), None, "its client went");
    }
}
