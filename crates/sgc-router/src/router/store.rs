//! The store: the records and link states that this router keeps there, and those that it finds.

use std::time::Duration;

use sgc_wire::{Encode, Name, NodeId, Now};

use super::Router;
use crate::link_id::LinkId;
use crate::links::Peer;
use crate::names::{NamesBefore, RecordId, RecordKind};
use crate::output::Output;
use crate::store::{
    Finding, LookUpEnd, StoreEvent, StoreKey, StoreStats, Work, decode_signed, encode_signed,
};

/// Least lifetime of a value that is worth a write.
const LIFETIME_MIN: Duration = Duration::from_millis(1);

impl Router {
    /// Takes news from the store. Has no effect at a router without one.
    pub fn handle_store(&mut self, now: Now, event: StoreEvent) {
        self.now = now;
        if let Some(store) = &mut self.store {
            store.handle(now.instant, event);
        }
    }

    /// Returns the state of the store, at a router that has one.
    pub fn store_stats(&self) -> Option<StoreStats> {
        self.store.as_ref().map(|store| store.stats())
    }

    /// Returns the node that brings announcements over a link. Those of the store count like a router's.
    pub(super) fn bringer(&self, link: LinkId) -> Option<Peer> {
        if link == LinkId::STORE {
            return self.store.as_ref().map(|_| Peer { node: self.config.node, is_router: true });
        }
        self.links.peer(link)
    }

    /// Acts on news from the store, and begins its operations.
    pub(super) fn follow_store(&mut self) {
        let mut unanswered = Vec::new();
        loop {
            if let Some(finding) = self.store.as_mut().and_then(|store| store.take_finding()) {
                unanswered.extend(self.take_finding(finding));
            } else if let Some(work) = self.store.as_mut().and_then(|store| store.take_work()) {
                self.work_for_store(work);
            } else {
                break;
            }
        }
        if !unanswered.is_empty() {
            self.names_part(|names, cx| names.ask_others(cx, &unanswered));
        }
        let now = self.now.instant;
        while let Some(operation) = self.store.as_mut().and_then(|store| store.take_operation(now)) {
            self.outputs.push(Output::Store(operation));
        }
    }

    // ---- News.

    /// Acts on news. Returns a name for which other routers may have to be asked.
    fn take_finding(&mut self, finding: Finding) -> Option<Name> {
        match finding {
            Finding::Up => self.fill_store(),
            Finding::Changed(key) => self.store_changed(key),
            Finding::Signed { key, value } => self.take_signed(key, &value),
            Finding::LookedUp { name, end, others_asked } => {
                let is_found = self.check_found(&name, end);
                let asks = !is_found || self.names_part(|names, cx| names.found_in_store(cx, name));
                return (asks && !others_asked).then_some(name);
            }
        }
        None
    }

    /// Writes everything that the store should have from this router, and looks up again the names that are wanted
    /// here: it may have lost everything, and changes went unreported.
    fn fill_store(&mut self) {
        let nodes = self.links.attached().filter(|node| self.topology.node(node).is_some()).map(Work::Node);
        let attached = |owner: &NodeId| self.links.is_attached(owner);
        let records = self.names.records_of(attached).map(Work::Record);
        let wanted = self.names.watched().filter(|name| !self.names.is_own(name)).copied().map(Work::LookUp);
        let work: Vec<_> = nodes.chain(wanted).chain(records).collect();
        let names =
            self.names.records_of(attached).filter_map(|id| Some((id, self.names.record(id)?.live())));
        if let Some(store) = &mut self.store {
            store.add_paced(self.now.instant, work);
            store.refill(names);
        }
    }

    fn store_changed(&mut self, key: StoreKey) {
        let Some(store) = &mut self.store else { return };
        match key {
            StoreKey::Name(name) => {
                if self.names.is_awaited(&name) && !self.names.is_own(&name) {
                    store.add_work(Work::LookUp(name));
                }
            }
            StoreKey::Batch { owner: node, .. } | StoreKey::Node(node) => {
                if self.names.names_of(&node).any(|name| self.names.is_awaited(name)) {
                    store.refresh(key);
                }
            }
        }
    }

    fn take_signed(&mut self, key: StoreKey, value: &[u8]) {
        let Ok(signed) = decode_signed(value) else { return self.refuse_stored(&[key]) };
        match key {
            StoreKey::Batch { .. } => self.handle_advert(LinkId::STORE, 0, signed),
            StoreKey::Node(_) => self.handle_link_state(LinkId::STORE, signed),
            StoreKey::Name(_) => {}
        }
    }

    /// Returns `true` if a name was found. Refuses the values that led to it if no announcement of its owner has the name.
    fn check_found(&mut self, name: &Name, end: LookUpEnd) -> bool {
        let LookUpEnd::Found(entry) = end else { return false };
        let is_found = self.names.is_announced_by(name, &entry.owner);
        if !is_found {
            self.refuse_stored(&[StoreKey::Name(*name), entry.batch(), StoreKey::Node(entry.owner)]);
        }
        is_found
    }

    fn refuse_stored(&mut self, keys: &[StoreKey]) {
        if let Some(store) = &mut self.store {
            store.refuse(keys);
        }
    }

    // ---- Work.

    /// Has a record written that a node attached here brought.
    pub(super) fn store_record(&mut self, owner: &NodeId, id: RecordId, before: NamesBefore) {
        if let Some(store) = &mut self.store
            && self.links.is_attached(owner)
        {
            match before {
                NamesBefore::None => store.add_work(Work::NewRecord(id)),
                NamesBefore::Same => store.add_work(Work::Record(id)),
                NamesBefore::Other => {
                    store.add_work(Work::Record(id));
                    store.add_work(Work::NamesOf(id));
                }
            }
        }
    }

    /// Has the link state of a node written, if it is attached here.
    pub(super) fn store_link_state(&mut self, node: &NodeId) {
        if let Some(store) = &mut self.store
            && self.links.is_attached(node)
        {
            store.add_work(Work::Node(*node));
        }
    }

    fn work_for_store(&mut self, work: Work) {
        let now = self.now.instant;
        let Some(store) = &mut self.store else { return };
        match work {
            Work::LookUp(name) => {
                store.look_up(now, name);
            }
            Work::Node(node) => {
                let Some(record) = self.topology.node(&node).filter(|record| !record.is_transit()) else {
                    return;
                };
                let lifetime = record.expires().saturating_duration_since(now);
                if self.links.is_attached(&node) && lifetime >= LIFETIME_MIN {
                    let value = encode_signed(record.signed());
                    store.write(StoreKey::Node(node), value, Some(lifetime), work, None);
                }
            }
            Work::NewRecord(id) | Work::Record(id) | Work::NamesOf(id) | Work::Refill(id) => {
                let Some(record) = self.names.record(id) else { return };
                let lifetime = record.expires().saturating_duration_since(now);
                let entry = record.store_entry();
                if !self.links.is_attached(&entry.owner) || lifetime < LIFETIME_MIN {
                    return;
                }
                if matches!(work, Work::NewRecord(_) | Work::Record(_)) {
                    let value = encode_signed(record.signed());
                    return store.write(entry.batch(), value, Some(lifetime), work, Some(Work::NamesOf(id)));
                }
                store.need_not_refill(id);
                // A withdrawn name ends with its withdrawal.
                let lifetime = (record.kind() == RecordKind::Withdrawal).then_some(lifetime);
                let value = entry.to_bytes();
                for name in self.names.live_names(id) {
                    store.write(StoreKey::Name(name), value.clone(), lifetime, work, None);
                }
            }
            Work::Check(name) => {
                let Some(record) = self.names.record_of(&name) else { return };
                if self.links.is_attached(&record.owner_id()) {
                    store.check(now, name, record.store_entry());
                }
            }
        }
    }
}
