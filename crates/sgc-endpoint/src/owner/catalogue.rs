//! [`CatalogueFeed`]: the names of this node's catalogue, its followers, and the times at which they get changes.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use sgc_wire::{
    Blind, CATALOGUE_ENTRIES_MAX, Catalogue, CatalogueEntry, Encode, GrantContent, Name, RefuseReason,
    Request, SEALED_BYTES_MAX, SinkId,
};

use super::granted::{GrantedSink, is_older, place};
use super::shares::Shares;
use crate::context::Context;
use crate::names::BlindName;
use crate::output::{EndpointDrop, Event, UnexpectedFrame};

/// Time for which changes of the catalogue are collected after it was sent.
const CATALOGUE_REST: Duration = Duration::from_millis(100);

/// A follower.
#[derive(Debug)]
struct Follower {
    granted: GrantedSink,
    /// The last catalogue sent to it, so that it is not sent again.
    told: Option<Catalogue>,
}

/// The catalogue's names and followers.
#[derive(Debug)]
pub(crate) struct CatalogueFeed {
    /// One for each naming secret, the newest first.
    names: Vec<BlindName>,
    followers: BTreeMap<(Name, SinkId), Follower>,
    version: u64,
    dirty: bool,
    /// End of the time in which changes are collected.
    rests_until: Option<Instant>,
}

impl CatalogueFeed {
    pub(crate) fn new(names: Vec<BlindName>) -> Self {
        Self { names, followers: BTreeMap::new(), version: 0, dirty: false, rests_until: None }
    }

    /// Returns the name under the newest secret.
    pub(crate) fn name(&self) -> Option<Name> {
        self.names.first().map(|own| own.name)
    }

    /// Returns `true` if `name` is one of the catalogue's.
    pub(crate) fn is_at(&self, name: &Name) -> bool {
        self.names.iter().any(|own| own.name == *name)
    }

    /// Iterates over the blinds of the names.
    pub(crate) fn blinds(&self) -> impl Iterator<Item = Blind> {
        self.names.iter().map(|own| own.blind)
    }

    /// Replaces the names, and refuses the followers of those that are gone. Returns the blinds to withdraw.
    pub(crate) fn set_names(&mut self, cx: &mut Context, names: Vec<BlindName>) -> Vec<Blind> {
        let gone: Vec<_> = self.names.iter().filter(|own| !names.contains(own)).copied().collect();
        for BlindName { name, .. } in &gone {
            let sinks = self.followers.keys().filter(|(n, _)| n == name).copied();
            for key in sinks.collect::<Vec<_>>() {
                self.cut(cx, key, RefuseReason::NotShared);
            }
        }
        self.names = names;
        gone.into_iter().map(|own| own.blind).collect()
    }

    /// Notes that the catalogue may have changed.
    pub(crate) fn changed(&mut self) {
        self.dirty = true;
    }

    /// Collects no changes any more.
    pub(crate) fn end_rest(&mut self) {
        self.rests_until = None;
    }

    /// Returns the time at which followers get the collected changes.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.rests_until.filter(|_| self.dirty)
    }

    /// Sends each follower its catalogue if its visible part changed, at once the first time and then after a while: a
    /// network that starts makes hundreds of changes.
    pub(crate) fn tell_followers(&mut self, cx: &mut Context, shares: &Shares) {
        if self.rests_until.is_some_and(|until| cx.instant() < until) || !std::mem::take(&mut self.dirty) {
            return;
        }
        self.rests_until = Some(cx.instant() + CATALOGUE_REST);
        self.version += 1;
        for key in self.followers.keys().copied().collect::<Vec<_>>() {
            self.tell_follower(cx, shares, key);
        }
    }

    pub(crate) fn handle_follow(
        &mut self,
        cx: &mut Context,
        shares: &Shares,
        key: (Name, SinkId),
        asked: GrantedSink,
    ) {
        let (name, sink) = key;
        let place = if !matches!(asked.request, Request::Subscribe { .. }) {
            Err(RefuseReason::RoleNotOffered)
        } else if !cx.is_own_fleet(&asked.peer) {
            Err(RefuseReason::NotPermitted)
        } else if let Some(Follower { granted: known, .. }) = self.followers.get(&key) {
            if is_older(&asked, known) {
                return cx.unexpected(UnexpectedFrame::OlderRequest);
            }
            if known.peer.node_id == asked.peer.node_id { Ok(None) } else { Err(RefuseReason::Limit) }
        } else {
            place(self.followers.iter().map(|(key, f)| (key, &f.granted)), &asked, cx.limits())
        };
        match place {
            Err(reason) => return cx.refuse(name, sink, 1, reason),
            Ok(None) => {}
            Ok(Some(oldest)) => self.cut(cx, oldest, RefuseReason::Limit),
        }
        cx.event(Event::Followed { peer: Box::new(asked.peer.clone()) });
        let serial = self.followers.get(&key).map_or(0, |f| f.granted.serial);
        self.followers.insert(key, Follower { granted: GrantedSink { serial, ..asked }, told: None });
        self.tell_follower(cx, shares, key);
    }

    pub(crate) fn handle_leave(&mut self, name: Name, sink: SinkId) {
        self.followers.remove(&(name, sink));
    }

    /// Cuts followers that lost their certificate.
    pub(crate) fn enforce(&mut self, cx: &mut Context) {
        let lost = |(key, follower): (&(Name, SinkId), &Follower)| {
            Some((*key, cx.standing(&follower.granted.peer)?))
        };
        for (key, reason) in self.followers.iter().filter_map(lost).collect::<Vec<_>>() {
            self.cut(cx, key, reason);
        }
    }

    fn tell_follower(&mut self, cx: &mut Context, shares: &Shares, key: (Name, SinkId)) {
        let Some(follower) = self.followers.get_mut(&key) else { return };
        let mut catalogue =
            Catalogue { version: self.version, entries: shares.entries_for(&follower.granted.peer) };
        let left_out = fit(&mut catalogue);
        if follower.told.as_ref().is_some_and(|t| t.entries == catalogue.entries) {
            return;
        }
        if left_out > 0 {
            cx.drop_frame(EndpointDrop::CatalogueTooLarge { left_out });
        }
        follower.told = Some(catalogue.clone());
        if !follower.granted.grant(cx, key.0, key.1, &GrantContent::Catalogue(catalogue)) {
            self.followers.remove(&key);
        }
    }

    fn cut(&mut self, cx: &mut Context, key: (Name, SinkId), reason: RefuseReason) {
        if let Some(follower) = self.followers.remove(&key) {
            follower.granted.refuse(cx, key.0, key.1, reason);
        }
    }
}

/// Makes a catalogue small enough to be sent: first without the nodes of its publishers, then without telling volatile
/// publishers apart, and last by leaving out entries. Returns the number of those.
fn fit(catalogue: &mut Catalogue) -> usize {
    let all = catalogue.entries.len();
    let room = SEALED_BYTES_MAX - 1024;
    catalogue.entries.truncate(CATALOGUE_ENTRIES_MAX);
    let fits = |entries: &[CatalogueEntry]| entries.iter().map(|e| e.to_vec().len()).sum::<usize>() <= room;
    if !fits(&catalogue.entries) {
        catalogue.entries.iter_mut().flat_map(|e| &mut e.sources).for_each(|s| s.node = None);
    }
    if !fits(&catalogue.entries) {
        let volatile = catalogue.entries.iter_mut().filter(|e| !e.qos.is_transient_local());
        volatile.for_each(|e| e.sources.clear());
    }
    let mut bytes = 0;
    catalogue.entries.retain(|e| {
        bytes += e.to_vec().len();
        bytes <= room
    });
    all - catalogue.entries.len()
}
