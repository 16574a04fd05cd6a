//! Types of interfaces, as the control task carries out their searches: it starts jobs, asks owners, answers nodes that
//! ask, and passes known types to the ends that convert messages.

use std::time::Instant;

use sgc_cdr::TypeName;
use sgc_ros::RosNetwork;
use sgc_wire::{DescribedType, Metadata, Name, NodeId};
use tracing::{debug, warn};

use super::Core;
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::types::interface_types::SettledType;
use crate::control::types::type_jobs::{TypeMiss, TypeOutcome};
use crate::data::conversion::KnownType;
use crate::drops::NodeDrop;

impl<N: RosNetwork> Core<N> {
    /// Starts the search for the type of an interface, of this node or of another.
    pub(super) fn need_type(
        &mut self,
        name: Name,
        metadata: &Metadata,
        type_hash: Option<String>,
        owner: Option<NodeId>,
    ) {
        let type_name = metadata.type_name.parse::<TypeName>();
        let hash = type_hash.as_deref();
        if type_name.as_ref().is_ok_and(|type_name| self.types.is_needed(&name, type_name, hash, owner)) {
            return self.apply_type(&name);
        }
        self.forget_type(&name);
        let Ok(type_name) = type_name else {
            // Plain DDS programs use type names that are not of ROS.
            return self.set_type(&name, &KnownType::Lacking);
        };
        self.types.need(name, type_name, type_hash, owner);
        self.apply_type(&name);
        self.next_type_job();
    }

    /// Starts the search for the type of a granted interface of another node.
    pub(super) fn need_type_of_used(&mut self, name: Name) {
        let Some((owner, entry)) = self.routes.as_ref().and_then(|routes| routes.used_entry(&name)) else {
            return;
        };
        let (metadata, type_hash) = (entry.metadata.clone(), entry.type_hash.clone());
        self.need_type(name, &metadata, type_hash, Some(owner));
    }

    /// Handles a changed catalogue, which may list other types.
    pub(super) fn types_listed(&mut self, owner: NodeId) {
        let Some(routes) = &self.routes else { return };
        let listed = |name: &Name| routes.used_entry(name).map(|(_, entry)| entry);
        for name in self.types.listed_otherwise(&owner, listed) {
            self.need_type_of_used(name);
        }
    }

    /// Ends the search, because the interface is gone.
    pub(super) fn forget_type(&mut self, name: &Name) {
        if let Some(owner) = self.types.forget(name) {
            self.ask_types(owner);
        }
        self.next_type_job();
    }

    /// Handles type descriptions from an owner.
    pub(super) fn types_told(&mut self, owner: NodeId, types: Vec<DescribedType>) {
        for _ in 0..self.types.told(owner, types) {
            self.control_drops.count(NodeDrop::TypesBusy);
        }
        self.ask_types(owner);
        self.next_type_job();
    }

    fn next_type_job(&mut self) {
        let Some(events) = self.events.upgrade() else { return };
        let Some(job) = self.types.next_job() else { return };
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let _ = events.blocking_send(CoreEvent::TypeLookedFor(job.run()));
        });
    }

    /// Handles the result of a job.
    pub(super) fn type_looked_for(&mut self, outcome: TypeOutcome) {
        let owner = outcome.of.owner;
        if let Some(settled) = self.types.looked_for(outcome) {
            self.type_settled(settled);
        }
        match owner {
            Some(owner) => self.ask_types(owner),
            // Types that become known together are sent together.
            None if !self.types.has_own_jobs() => self.endpoint.tell_types(now()),
            None => {}
        }
        for owner in self.types.have_room() {
            self.ask_types(owner);
        }
        self.next_type_job();
    }

    fn type_settled(&mut self, settled: SettledType) {
        let SettledType { name, owner, was_told, found } = settled;
        match found {
            Ok((described, packed)) => {
                debug!(name = %name.short(), type_name = %described.name(), hash = described.type_hash(), "type known");
                if let (None, Some(packed)) = (owner, packed) {
                    self.endpoint.describe(now(), &name, packed);
                }
            }
            Err(why) => {
                debug!(name = %name.short(), %why, "type not known");
                if let Some(counter) = why.counter()
                    && self.control_drops.count(counter)
                    && (was_told || why == TypeMiss::Failed)
                {
                    warn!(%why, "a description of a type is refused; counted from here on");
                }
            }
        }
        self.apply_type(&name);
    }

    /// Asks for further types, because their turn has come.
    pub(super) fn types_due(&mut self, now: Instant) {
        for owner in self.types.due(now) {
            self.ask_types(owner);
        }
    }

    /// Asks an owner for its unknown types, unless it was asked already.
    fn ask_types(&mut self, owner: NodeId) {
        let now = now();
        if let Some(names) = self.types.next_question(owner, now.instant) {
            self.endpoint.ask_types(now, owner, names);
        }
    }

    /// Passes the state of a type to both ends of its interface.
    pub(super) fn apply_type(&self, name: &Name) {
        self.set_type(name, &self.types.known(name));
    }

    fn set_type(&self, name: &Name, known: &KnownType) {
        if let Some(share) = self.shares.get(name) {
            share.set_type(known.clone());
        }
        if let Some(sink) = self.sinks.get(name) {
            sink.set_type(known.clone(), &self.data);
        }
    }
}
