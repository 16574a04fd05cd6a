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
