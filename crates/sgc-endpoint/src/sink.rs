//! One subscriber of one name: opens and verifies packets, assembles messages, and delivers each once.
//!
//! If a source can send lost messages again, the sink delivers every number in turn: it asks for missing ones, and
//! drops later ones that come before the answer, because the answer contains them. So order needs no memory.
//!
//! The claims of a header allocate nothing: the packet must open, and be proved, first. A refused packet leaves no
//! state.

mod delivery;
mod open_buffer;
mod parking;
mod partial;
mod source_state;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering::Acquire};
use std::sync::{Arc, Mutex};

use sgc_sync::lock;
use sgc_trust::{OpenError, Suite, opened_bytes};
use sgc_wire::{
    GRANT_SOURCES_MAX, MessageHead, MessageKind, Name, Packet, PacketHeader, SinkId, Slab, SourceAnnounce,
    SourceId, TopicGrant,
};

pub use self::delivery::{AskAgain, Delivery, Message, SinkDrop};
pub use self::parking::{PARKED_BYTES_MAX, PARKED_LOOKS_MAX, PARKED_PACKETS_MAX};

use self::open_buffer::OpenBuffer;
use self::parking::{ParkedPacket, Parking};
use self::source_state::{SourceState, derive, oldest_of_mark};
use crate::receivers::Receivers;
use crate::source::without_lists;

/// Epochs whose keys are held at once. A past epoch is held until [`Sink::retire_epochs`]; beyond this number the
/// oldest goes.
pub const EPOCHS_MAX: usize = 8;

/// Bounds of one sink.
#[derive(Clone, Debug)]
pub struct SinkLimits {
    /// Most sources; further announced ones are ignored.
    pub sources_max: usize,
    /// Messages of one source that may be incomplete at once.
    pub partials_per_source_max: usize,
    /// Bytes of incomplete messages over all sources. Each source that has some is sure of an equal share.
    pub partial_bytes_max: usize,
}

impl Default for SinkLimits {
    fn default() -> Self {
        Self {
            sources_max: GRANT_SOURCES_MAX,
            partials_per_source_max: 4,
            partial_bytes_max: 128 * 1024 * 1024,
        }
    }
}

/// Progress of a sink with each source, readable without its lock.
#[derive(Debug, Default)]
pub struct SinkProgress {
    newest: Mutex<BTreeMap<SourceId, Arc<AtomicU64>>>,
}

impl SinkProgress {
    /// Returns the greatest delivered number of the source; 0 before any, or if the sink does not know the source.
    pub fn newest(&self, source: &SourceId) -> u64 {
        let newest = lock(&self.newest);
        newest.get(source).map_or(0, |n| n.load(Acquire))
    }
}

/// Result of a packet that was not dropped.
enum Handled {
    /// A grant explained the packet.
    Explained(Delivery),
    /// No grant has the packet's epoch yet.
    UnknownEpoch,
    /// No grant has announced the packet's source yet.
    UnknownSource,
}

/// A subscriber.
pub struct Sink {
    name: Name,
    id: SinkId,
    transient_local: bool,
    limits: SinkLimits,
    /// Ascending; never empty.
    epochs: Vec<TopicGrant>,
    sources: BTreeMap<SourceId, SourceState>,
    /// The keys of callers, at the owner of a service.
    callers: Option<Arc<Receivers>>,
    parking: Parking,
    incomplete: u64,
    scratch: Vec<u8>,
    /// Memory for messages of one packet.
    slab: Slab,
    progress: Arc<SinkProgress>,
}

impl Sink {
    /// Returns a sink that was granted as `id`. A transient-local one takes each source's history before anything else.
    pub fn new(name: Name, id: SinkId, grant: TopicGrant, transient_local: bool, limits: SinkLimits) -> Self {
        let mut sink = Self {
            name,
            id,
            transient_local,
            limits,
            epochs: vec![without_lists(&grant)],
            sources: BTreeMap::new(),
            callers: None,
            parking: Parking::default(),
            incomplete: 0,
            scratch: Vec::new(),
            slab: Slab::default(),
            progress: Arc::default(),
        };
        sink.announce(grant.sources, None, false, &mut |_| ());
        sink
    }

    /// Believes the MACs of callers whose keys are in this set; for the owner's own sink of a service.
    pub fn set_callers(&mut self, callers: Arc<Receivers>) {
        self.callers = Some(callers);
    }

    /// Takes a further grant, and returns the results of the packets that waited for it.
    ///
    /// - A later epoch is added to the known ones. Delivered numbers are remembered; packets of the earlier epochs open
    ///   until [`Self::retire_epochs`].
    /// - Another key for a known epoch, or an earlier epoch, is that of a restarted owner: nothing of before counts.
    /// - Under another id (the route to the owner changed, and this sink asked again), newer messages of a source must
    ///   be asked for.
    /// - A source that is no longer announced counts in the epochs until then, and in no later one.
    pub fn regrant(
        &mut self,
        id: SinkId,
        grant: TopicGrant,
        mut deliver: impl FnMut(Result<Delivery, SinkDrop>),
    ) {
        let newest = self.newest_epoch();
        let anew = match self.epochs.iter().find(|known| known.epoch == grant.epoch) {
            Some(known) => (&known.key, known.suite) != (&grant.key, grant.suite),
            None => grant.epoch < newest,
        };
        if anew {
            self.epochs.clear();
            self.sources.clear();
        }
        if self.epochs.last().is_none_or(|known| known.epoch < grant.epoch) {
            self.epochs.push(without_lists(&grant));
            if self.epochs.len() > EPOCHS_MAX {
                self.epochs.remove(0);
                self.drop_old_keys();
            }
        }
        let moved = id != self.id;
        if moved {
            self.id = id;
            for source in self.sources.values_mut() {
                source.moved();
            }
        }
        self.announce(grant.sources, Some(newest), moved, &mut deliver);
        let latest = self.newest_epoch();
        for mut parked in self.parking.take() {
            let result = match self.handle(&parked.packet) {
                Ok(Handled::Explained(delivery)) => Ok(delivery),
                Ok(Handled::UnknownEpoch) if parked.looked_in_vain(latest) => Err(SinkDrop::UnknownEpoch),
                Ok(Handled::UnknownSource) if parked.looked_in_vain(latest) => Err(SinkDrop::UnknownSource),
                Ok(Handled::UnknownEpoch | Handled::UnknownSource) => {
                    // The packet was parked before, so there is room.
                    self.parking.push(parked);
                    continue;
                }
                Err(dropped) => Err(dropped),
            };
            deliver(result);
        }
    }

    /// Drops all epochs but the newest, and the sources that are not announced in it: their packets are refused.
    pub fn retire_epochs(&mut self) {
        let newest = self.newest_epoch();
        self.epochs.retain(|known| known.epoch == newest);
        self.drop_old_keys();
        self.sources.retain(|_, source| source.counts_in(newest));
        self.list_progress();
    }

    /// Iterates over the announced sources with missing messages.
    pub fn unsynced(&self) -> impl Iterator<Item = SourceId> + '_ {
        self.sources.iter().filter(|(_, s)| !s.is_synced() && s.is_announced()).map(|(id, _)| *id)
    }

    /// Returns the number from which on a source must be asked for its messages, which the caller then does; `None` if
    /// nothing is missing. 0 stands for the whole history.
    pub fn ask(&mut self, source: SourceId) -> Option<u64> {
        self.sources.get_mut(&source)?.ask()
    }

    /// Returns the action for a source a while after it was asked.
    pub fn ask_again(&mut self, source: SourceId) -> AskAgain {
        match self.sources.get_mut(&source) {
            Some(state) => state.ask_again(),
            None => AskAgain::No,
        }
    }

    /// Returns `true` if the messages of a source can be asked for again, so that messages without a destination may be
    /// dropped.
    pub fn recovers(&self, source: &SourceId) -> bool {
        self.sources.get(source).is_some_and(SourceState::recovers)
    }

    /// Drops the parked packets of sources whose messages have no destination yet. Returns these sources; each must be
    /// [suspected](Self::suspect) once its messages have one.
    pub fn pass_over(&mut self, can_go_nowhere: impl Fn(&SourceId) -> bool) -> BTreeSet<SourceId> {
        self.parking.drop_of(can_go_nowhere)
    }

    /// Marks a source of which a message was not handed over: it must be asked for it, if it can be.
    pub fn suspect(&mut self, source: &SourceId) {
        if let Some(source) = self.sources.get_mut(source) {
            source.suspect();
        }
    }

    /// Begins anew with a source whose messages had no destination meanwhile: its history will be asked for, and
    /// delivered again. Other earlier messages stay past.
    pub fn forget(&mut self, source: &SourceId) {
        if let Some(state) = self.sources.get_mut(source) {
            state.forget(self.transient_local);
        }
    }

    /// Takes a packet.
    pub fn handle_packet(&mut self, packet: &Packet) -> Result<Delivery, SinkDrop> {
        debug_assert_eq!(packet.header.name, self.name);
        match self.handle(packet)? {
            Handled::Explained(delivery) => Ok(delivery),
            _ if self.parking.push(ParkedPacket::new(packet)) > 0 => Err(SinkDrop::ParkingFull),
            _ => Ok(Delivery::Parked),
        }
    }

    /// Returns the messages given up because a newer one was complete first, or for want of room.
    pub fn incomplete(&self) -> u64 {
        self.incomplete
    }

    /// Returns the progress with each source, to be read while another thread feeds the sink.
    pub fn progress(&self) -> Arc<SinkProgress> {
        self.progress.clone()
    }

    /// Returns the number of packets that wait for a grant.
    pub fn parked(&self) -> usize {
        self.parking.len()
    }

    /// Iterates over the epochs whose packets open, oldest first.
    pub fn epochs(&self) -> impl Iterator<Item = u32> + '_ {
        self.epochs.iter().map(|known| known.epoch)
    }

    /// Returns the number of checked signatures.
    pub fn signatures_checked(&self) -> u64 {
        self.sources.values().map(SourceState::signatures_checked).sum()
    }

    fn newest_epoch(&self) -> u32 {
        self.epochs.last().map_or(0, |known| known.epoch)
    }

    /// Takes over the announced sources; `before` is the newest known epoch, if this grant is not the first, and
    /// `moved` means that packets came on another route until now.
    fn announce(
        &mut self,
        announced: Vec<SourceAnnounce>,
        before: Option<u32>,
        moved: bool,
        deliver: &mut impl FnMut(Result<Delivery, SinkDrop>),
    ) {
        if let Some(before) = before {
            self.sources.values_mut().for_each(|source| source.end_after(before));
        }
        for announce in announced {
            match self.sources.get_mut(&announce.source) {
                Some(known) => {
                    let lost = known.announce_again(&announce);
                    if lost > 0 {
                        deliver(Ok(Delivery::Lost(announce.source, lost)));
                    }
                    if moved {
                        known.miss_below(announce.next, self.transient_local);
                    }
                }
                None => {
                    self.make_room();
                    if self.sources.len() < self.limits.sources_max {
                        let state = SourceState::new(&announce, self.transient_local);
                        self.sources.insert(announce.source, state);
                    }
                }
            }
        }
        self.list_progress();
    }

    /// Lists the sources known by now.
    fn list_progress(&self) {
        let newest = self.sources.iter().map(|(id, s)| (*id, s.progress())).collect();
        *lock(&self.progress.newest) = newest;
    }

    /// Drops a source that is no longer announced, if there are too many.
    fn make_room(&mut self) {
        if self.sources.len() >= self.limits.sources_max
            && let Some(gone) = self.sources.iter().find(|(_, s)| !s.is_announced()).map(|(id, _)| *id)
        {
            self.sources.remove(&gone);
        }
    }

    fn drop_old_keys(&mut self) {
        let oldest = self.epochs.first().map_or(0, |known| known.epoch);
        for source in self.sources.values_mut() {
            source.drop_keys_before(oldest);
        }
    }

    /// Returns the result of a packet, if a grant explained it. Checks in this order: the cheap facts (addressee,
    /// epoch, suite, replay); the seal, which only holders of the topic's key pass; the MAC for this node, or the
    /// signature.
    fn handle(&mut self, packet: &Packet) -> Result<Handled, SinkDrop> {
        let header = &packet.header;
        if header.to.is_some_and(|to| to != self.id) {
            return Err(SinkDrop::NotForUs);
        }
        let Some(grant) = self.epochs.iter().find(|known| known.epoch == header.epoch) else {
            if header.epoch > self.newest_epoch() {
                return Ok(Handled::UnknownEpoch);
            }
            return Err(OpenError::Epoch { found: header.epoch }.into());
        };
        let suite = Suite::from_id(grant.suite).filter(|suite| suite.id() == header.suite);
        let suite = suite.ok_or(OpenError::Suite { found: header.suite })?;
        let joined;
        let payload = match &packet.payload.0[..] {
            [one] => &one[..],
            _ => {
                let mut out = Vec::with_capacity(packet.payload.len());
                packet.payload.copy_into(&mut out);
                joined = out;
                &joined
            }
        };
        let known = self.sources.get_mut(&header.source);
        let Some(source) = known.filter(|s| s.counts_in(header.epoch)) else {
            // Nodes without the topic's key take no room.
            let mut text = vec![0; opened_bytes(header)];
            derive(grant, &self.name, header)?.open(header, payload, &mut text)?;
            return Ok(Handled::UnknownSource);
        };
        source.check_freshness(header)?;
        source.derive_key(grant, &self.name, header)?;
        let text_bytes = opened_bytes(header);
        let mut opened = if header.fragments() == 1 {
            let mut text = self.slab.room(text_bytes);
            text.resize(text_bytes, 0);
            OpenBuffer::Whole(text)
        } else if source.place(header).is_some() {
            OpenBuffer::InPlace
        } else {
            let mut scratch = std::mem::take(&mut self.scratch);
            scratch.clear();
            scratch.resize(text_bytes, 0);
            OpenBuffer::Aside(scratch)
        };
        let callers = self.callers.as_deref();
        let delivery = match source.open(suite, grant, callers, header, payload, &mut opened) {
            Ok(()) => self.accept(header, &mut opened),
            Err(error) => Err(error.into()),
        };
        if let OpenBuffer::Aside(scratch) = opened {
            self.scratch = scratch;
        }
        delivery.map(Handled::Explained)
    }

    /// Makes room for a message that begins. If its source has no more than its share with it, the oldest messages of
    /// the sources with the most give way.
    fn make_partial_room(&mut self, header: &PacketHeader) -> Result<(), SinkDrop> {
        let max = self.limits.partial_bytes_max;
        let held: BTreeMap<SourceId, usize> =
            self.sources.iter().map(|(id, source)| (*id, source.partial_bytes())).collect();
        let mut used: usize = held.values().sum();
        if used.saturating_add(header.total as usize) <= max {
            return Ok(());
        }
        let sharers = held.iter().filter(|(id, bytes)| **bytes > 0 || **id == header.source).count();
        let own = held.get(&header.source).copied().unwrap_or(0).saturating_add(header.total as usize);
        if own > max / sharers.max(1) {
            return Err(SinkDrop::PartialsFull);
        }
        while used.saturating_add(header.total as usize) > max {
            let others = self.sources.iter_mut().filter(|(id, _)| **id != header.source);
            let heaviest = others.max_by_key(|(_, source)| source.partial_bytes());
            let freed = heaviest.map_or(0, |(_, source)| source.give_up_oldest_partial());
            if freed == 0 {
                return Err(SinkDrop::PartialsFull);
            }
            self.incomplete += 1;
            used -= freed;
        }
        Ok(())
    }

    /// Returns the result of an assertion in `by` about a publisher. It counts for publishers of the same node, which
    /// sign with the same key, and for no others. The source of a node that publishes on another's topic asserts its
    /// own publishers.
    fn asserted(&self, by: &SourceId, publisher: [u8; 8]) -> Delivery {
        let Some(asserting) = self.sources.get(by) else { return Delivery::Mark };
        let [first, last] = [0, 0xff].map(|byte| SourceId::from_publisher(publisher, [byte; 8]));
        let is_it =
            |(_, state): &(&SourceId, &SourceState)| state.is_announced() && state.has_key_of(asserting);
        let found = self.sources.range(first..=last).find(is_it);
        found.map_or(Delivery::Mark, |(id, _)| Delivery::Asserted(*id))
    }

    /// Takes the opened text of a packet: fragment, and behind the first one the head.
    fn accept(&mut self, header: &PacketHeader, opened: &mut OpenBuffer) -> Result<Delivery, SinkDrop> {
        let head = opened.take_head(header)?;
        let known = self.sources.get(&header.source);
        let begins = header.fragments() > 1 && known.is_some_and(|s| !s.has_begun(header.seq));
        let Some(source) = self.sources.get_mut(&header.source) else { return Err(SinkDrop::UnknownSource) };
        if header.seq == 0 {
            if head.is_none() || header.total > 0 {
                return Err(SinkDrop::Head);
            }
            source.take_end()?;
            return Ok(Delivery::Synced(header.source));
        }
        if header.to.is_some() {
            source.hear();
        }
        if let Some(head) = head.filter(|head| head.kind == MessageKind::Mark) {
            // A resent assertion is no news of a publisher's liveliness.
            let asserted = head.asserted().filter(|_| header.to.is_none() && !source.recovers());
            let Some(publisher) = asserted else { return source.take_mark(header, &head, opened.text()) };
            oldest_of_mark(header, opened.text())?;
            source.done(header.seq);
            return Ok(self.asserted(&header.source, publisher));
        }
        source.take_number(header)?;
        if !source.is_synced() && header.to.is_none() {
            return source.await_history(header.source);
        }
        self.assemble(header, head, opened, begins)
    }

    /// Delivers a message of one packet, or puts a fragment into its message, which may complete it.
    fn assemble(
        &mut self,
        header: &PacketHeader,
        head: Option<MessageHead>,
        opened: &mut OpenBuffer,
        begins: bool,
    ) -> Result<Delivery, SinkDrop> {
        let complete = match (opened, head) {
            (OpenBuffer::Whole(text), Some(head)) => Some((head, std::mem::take(text).freeze())),
            (opened, head) => {
                if begins {
                    self.make_partial_room(header)?;
                }
                let source = self.sources.get_mut(&header.source).ok_or(SinkDrop::UnknownSource)?;
                let fragment = (!matches!(opened, OpenBuffer::InPlace)).then(|| opened.text());
                let max = self.limits.partials_per_source_max;
                let (complete, given_up) = source.put_fragment(header, head, fragment, max)?;
                self.incomplete += given_up;
                complete
            }
        };
        let Some((head, payload)) = complete else { return Ok(Delivery::Incomplete) };
        let source = self.sources.get_mut(&header.source).ok_or(SinkDrop::UnknownSource)?;
        self.incomplete += source.complete(header);
        let PacketHeader { source, seq, reliable, .. } = *header;
        Ok(Delivery::Message(Message { source, seq, head, reliable, payload }))
    }
}
