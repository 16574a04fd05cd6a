//! What leaves for one link under one name: a bounded queue and the task that empties it onto the link.
//!
//! Reliable packets share one flow of the link; a best-effort message goes as a datagram if it fits one, else as a
//! flow of its own. Of best-effort messages in several packets only the newest complete one waits.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use sgc_transport::{AnyLink, FlowEnd, FlowTx, Link, LinkError, prompt};
use sgc_wire::{Label, Name, Packet, SourceId};
use tokio::sync::watch;
use tracing::debug;

use crate::labels::NameLabel;
use crate::lanes::Lanes;
use crate::queue::{PushError, Queue};
use crate::stats::DataDrop;

/// Packets that may wait for one link under one name.
pub(crate) const OUTFLOW_PACKETS_MAX: usize = 1024;
/// Bytes of reliable packets that may wait before the source is pushed back.
pub(crate) const OUTFLOW_RELIABLE_BYTES_MAX: usize = 4 << 20;
/// How long a reliable source is pushed back by a link that takes nothing at all.
pub(crate) const OUTFLOW_PATIENCE: Duration = Duration::from_secs(5);
/// Bytes of best-effort packets that may wait; of larger messages only what fits is kept, and they are lost.
pub(crate) const OUTFLOW_BYTES_MAX: usize = 16 << 20;
/// How long a best-effort packet may wait if nothing else is said; then it is worth nothing.
pub(crate) const OUTFLOW_AGE_MAX: Duration = Duration::from_secs(1);

/// What becomes of best-effort packets that wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct FlowLimits {
    /// How long one may wait; judged at the beginning of a message.
    pub max_age: Duration,
    /// Of messages in one packet, too, only the newest of each source waits.
    pub newest_only: bool,
}

impl Default for FlowLimits {
    fn default() -> Self {
        Self { max_age: OUTFLOW_AGE_MAX, newest_only: false }
    }
}

/// Bytes of reliable packets that are written together if they wait together. That is less than the path has under way where
/// it is fast, and where it is thin the link takes them piece by piece.
const TOGETHER_BYTES_MAX: usize = 16 << 10;

/// A packet, and since when it waits.
type Waiting = (Packet, Instant);

/// Best-effort messages in several packets that are sent beside each other: of several sources, or since they came so.
const MESSAGES_MAX: usize = 4;

/// The queue's end that the data path sees.
pub(crate) struct OutFlow {
    queue: Queue<Waiting>,
    /// Complete best-effort messages of several packets in the queue.
    complete: AtomicUsize,
    ended: watch::Sender<bool>,
}

impl OutFlow {
    /// Starts the task that sends; it ends when the flow is closed and empty, or the link ends.
    pub(crate) fn spawn(
        link: AnyLink,
        name: Name,
        label: Option<NameLabel>,
        lanes: Arc<Lanes>,
        limits: FlowLimits,
    ) -> Arc<Self> {
        let flow = Arc::new(Self {
            queue: Queue::new(OUTFLOW_PACKETS_MAX),
            complete: AtomicUsize::new(0),
            ended: watch::Sender::new(false),
        });
        let task = flow.clone();
        prompt::spawn(async move {
            let mut sender = Sender {
                by: link.clone(),
                lane: None,
                name,
                link,
                lanes,
                label,
                reliable: None,
                messages: VecDeque::new(),
            };
            if let Err(error) = task.empty(&mut sender, limits).await {
                debug!(name = %name.short(), %error, "no more is sent over this link");
            }
            task.close();
            sender.finish().await;
            task.ended.send_replace(true);
        });
        flow
    }

    /// One that nobody empties but [`Self::queued`].
    #[cfg(any(test, feature = "benchmarks"))]
    pub(crate) fn idle() -> Arc<Self> {
        Arc::new(Self {
            queue: Queue::new(OUTFLOW_PACKETS_MAX),
            complete: AtomicUsize::new(0),
            ended: watch::Sender::new(true),
        })
    }

    /// The oldest packet that waits; it must be there.
    #[cfg(any(test, feature = "benchmarks"))]
    pub(crate) async fn queued(&self) -> Packet {
        self.queue.pop().await.expect("it is open").0
    }

    /// Queues a packet; says what was dropped instead, and how many.
    pub(crate) async fn push(&self, packet: Packet) -> Option<(DataDrop, u64)> {
        let bytes = packet.encoded_bytes();
        if packet.header.reliable {
            return match self
                .queue
                .push((packet, Instant::now()), bytes, OUTFLOW_RELIABLE_BYTES_MAX, OUTFLOW_PATIENCE)
                .await
            {
                Ok(()) => None,
                Err(PushError::Stalled) => Some((DataDrop::Stalled, 1)),
                Err(PushError::Closed) => Some((DataDrop::LinkClosed, 1)),
            };
        }
        if self.queue.is_closed() {
            return Some((DataDrop::LinkClosed, 1));
        }
        if ends_large_message(&packet) {
            self.complete.fetch_add(1, Ordering::AcqRel);
        }
        let mut evicted = 0;
        self.queue.push_evicting((packet, Instant::now()), bytes, OUTFLOW_BYTES_MAX, |(old, _)| {
            evicted += 1;
            if ends_large_message(&old) {
                self.complete.fetch_sub(1, Ordering::AcqRel);
            }
        });
        (evicted > 0).then_some((DataDrop::Stale, evicted))
    }

    /// True if it is far from pushing back.
    pub(crate) fn is_at_ease(&self) -> bool {
        self.queue.is_at_ease(OUTFLOW_RELIABLE_BYTES_MAX)
    }

    /// Ends it: what is queued is still sent.
    pub(crate) fn close(&self) {
        self.queue.close();
    }

    /// Waits until it has ended.
    pub(crate) async fn ended(&self) {
        // The sender is this very flow, so it is there.
        let _ = self.ended.subscribe().wait_for(|ended| *ended).await;
    }

    /// Sends what is queued until the flow is closed and empty, or the link ends.
    async fn empty(&self, sender: &mut Sender, limits: FlowLimits) -> Result<(), LinkError> {
        // Of the message that is being sent, and what came between.
        let mut taken = VecDeque::new();
        loop {
            let next = match self.at_hand(&mut taken) {
                Some(next) => Some(next),
                None => {
                    // Nothing comes along.
                    sender.flush().await?;
                    self.queue.pop().await
                }
            };
            let Some((packet, since)) = next else { return Ok(()) };
            // Judged by its beginning: a large message that is under way goes on.
            let begins = !packet.header.reliable && packet.header.index == 0;
            let stale = begins && since.elapsed() > limits.max_age;
            let newer = limits.newest_only && self.has_newer(&packet, &mut taken);
            if self.is_superseded(&packet) || newer || stale {
                sender.abandon(&packet);
                continue;
            }
            if begins && !packet.header.is_last() {
                self.take_rest(&packet, &mut taken);
            }
            sender.send(packet).await?;
        }
    }

    /// What is sent next, if it is there.
    fn at_hand(&self, taken: &mut VecDeque<Waiting>) -> Option<Waiting> {
        taken.pop_front().or_else(|| self.queue.try_pop())
    }

    /// Takes what is queued of a message that begins, so that newer ones do not push out its end while it is sent: on a
    /// link that is slow enough none would ever arrive whole.
    fn take_rest(&self, first: &Packet, taken: &mut VecDeque<Waiting>) {
        let id = |packet: &Packet| (packet.header.source, packet.header.seq);
        let ends = |packet: &Packet| id(packet) == id(first) && packet.header.is_last();
        let mut is_whole = taken.iter().any(|(packet, _)| ends(packet));
        while !is_whole {
            let Some(next) = self.queue.try_pop() else { return };
            is_whole = ends(&next.0);
            taken.push_back(next);
        }
    }

    /// True if a best-effort message in one packet has a newer one of its source behind it. What waits is taken for that.
    fn has_newer(&self, packet: &Packet, taken: &mut VecDeque<Waiting>) -> bool {
        let is_one = |packet: &Packet| !packet.header.reliable && packet.header.fragments() == 1;
        if !is_one(packet) {
            return false;
        }
        while taken.len() < OUTFLOW_PACKETS_MAX
            && let Some(next) = self.queue.try_pop()
        {
            taken.push_back(next);
        }
        taken.iter().any(|(next, _)| is_one(next) && next.header.source == packet.header.source)
    }

    /// True if a packet begins or continues a best-effort message that a complete newer one overtakes.
    fn is_superseded(&self, packet: &Packet) -> bool {
        if packet.header.reliable || packet.header.fragments() == 1 {
            return false;
        }
        let behind = if ends_large_message(packet) {
            self.complete.fetch_sub(1, Ordering::AcqRel) - 1
        } else {
            self.complete.load(Ordering::Acquire).saturating_sub(1)
        };
        packet.header.index == 0 && behind > 0
    }
}

fn ends_large_message(packet: &Packet) -> bool {
    !packet.header.reliable && packet.header.fragments() > 1 && packet.header.is_last()
}

/// A best-effort message in several packets that is being sent.
struct Message {
    id: (SourceId, u64),
    /// The index of the packet that comes next.
    next: u16,
    flow: FlowTx,
}

/// The link's end.
struct Sender {
    /// What is sent by: the link, or a lane of it.
    by: AnyLink,
    /// The number of the lane.
    lane: Option<u64>,
    name: Name,
    link: AnyLink,
    lanes: Arc<Lanes>,
    /// Of the one name that all packets are of.
    label: Option<NameLabel>,
    reliable: Option<FlowTx>,
    /// Best-effort messages in several packets that are being sent, the oldest first.
    messages: VecDeque<Message>,
}

impl Sender {
    /// Sends a packet, or keeps a reliable one for the next [`Self::flush`].
    async fn send(&mut self, packet: Packet) -> Result<(), LinkError> {
        if packet.header.index == 0 {
            self.choose().await?;
        }
        if !packet.header.reliable {
            self.flush().await?;
        }
        let sent = self.send_by(packet).await;
        self.outlive_lane(sent)
    }

    /// Sends what is kept.
    async fn flush(&mut self) -> Result<(), LinkError> {
        let sent = self.flush_by().await;
        self.outlive_lane(sent)
    }

    /// If the lane ended and the link did not, the next message goes over that.
    fn outlive_lane(&mut self, sent: Result<(), LinkError>) -> Result<(), LinkError> {
        match sent {
            Err(error) if self.lane.is_some() && !error.is_link_alive() => {
                debug!(name = %self.name.short(), %error, "a lane ended; its topic shares the link");
                self.take_link();
                Ok(())
            }
            other => other,
        }
    }

    /// Takes the lane if there is one, else the link. What was sent by the other arrives first, or its lane is gone.
    async fn choose(&mut self) -> Result<(), LinkError> {
        let lane = self.lanes.of(&self.name);
        if lane.as_ref().map(|(number, _)| *number) == self.lane {
            return Ok(());
        }
        if let Some(flow) = self.reliable.take() {
            let delivered = async { flow.finish_slowly().await?.done().await };
            match delivered.await {
                Err(error) if self.lane.is_none() && !error.is_link_alive() => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        self.take_link();
        if let Some((number, lane)) = lane {
            (self.by, self.lane) = (lane, Some(number));
        }
        Ok(())
    }

    /// From here on everything is sent over the link.
    fn take_link(&mut self) {
        (self.by, self.lane) = (self.link.clone(), None);
        self.reliable = None;
        self.messages.clear();
    }

    /// Labels are the link's own.
    fn label(&self) -> Option<Label> {
        self.label.as_ref().filter(|_| self.lane.is_none()).and_then(NameLabel::known)
    }

    async fn send_by(&mut self, packet: Packet) -> Result<(), LinkError> {
        let header = &packet.header;
        let label = self.label();
        if header.reliable {
            let flow = match &mut self.reliable {
                Some(flow) => flow,
                none => none.insert(self.by.open_flow(header.class).await?),
            };
            flow.queue_as(&packet, label);
            return if flow.queued_bytes() < TOGETHER_BYTES_MAX { Ok(()) } else { self.flush_by().await };
        }
        if header.fragments() == 1
            && self.by.datagram_max().is_some_and(|max| packet.encoded_bytes_as(label) <= max)
        {
            return match self.by.send_datagram_as(&packet, label).await {
                // The path's limit sank in between.
                Err(LinkError::DatagramTooLong { .. }) => self.send_alone(&packet).await,
                other => other,
            };
        }
        if header.fragments() == 1 {
            return self.send_alone(&packet).await;
        }
        let id = (header.source, header.seq);
        if header.index == 0 {
            if self.messages.len() >= MESSAGES_MAX
                && let Some(oldest) = self.messages.pop_front()
            {
                oldest.flow.reset(FlowEnd::Stale);
            }
            let flow = self.by.open_flow(header.class).await?;
            self.messages.push_back(Message { id, next: 0, flow });
        }
        let at = self.messages.iter().position(|m| (m.id, m.next) == (id, header.index));
        // Without one its beginning was dropped: the rest is of no use to anyone.
        let Some(message) = at.and_then(|at| self.messages.get_mut(at)) else { return Ok(()) };
        match message.flow.send_as(&packet, label).await {
            Ok(()) if !header.is_last() => message.next += 1,
            sent => {
                let ended = at.and_then(|at| self.messages.remove(at));
                match (sent, ended) {
                    // All of it was let in by the link, which has room for the newest then.
                    (Ok(()), Some(message)) => return message.flow.finish().await,
                    // The far side gave up this flow, not the link.
                    (Ok(()) | Err(LinkError::FlowStopped(_)), _) => {}
                    (Err(error), _) => return Err(error),
                }
            }
        }
        Ok(())
    }

    async fn flush_by(&mut self) -> Result<(), LinkError> {
        let Some(flow) = &mut self.reliable else { return Ok(()) };
        match flow.flush().await {
            // The far side gave up this flow, not the link: begin another.
            Err(LinkError::FlowStopped(_)) => {
                self.reliable = None;
                Ok(())
            }
            other => other,
        }
    }

    async fn send_alone(&mut self, packet: &Packet) -> Result<(), LinkError> {
        let mut flow = self.by.open_flow(packet.header.class).await?;
        match flow.send_as(packet, self.label()).await {
            Ok(()) => flow.finish().await,
            // The far side gave up this flow, not the link.
            Err(LinkError::FlowStopped(_)) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// A message that is not to be sent: its packets find no flow and go nowhere.
    fn abandon(&mut self, packet: &Packet) {
        let id = (packet.header.source, packet.header.seq);
        if let Some(at) = self.messages.iter().position(|m| m.id == id)
            && let Some(message) = self.messages.remove(at)
        {
            message.flow.reset(FlowEnd::Stale);
        }
    }

    async fn finish(self) {
        if let Some(flow) = self.reliable {
            let _ = flow.finish().await;
        }
        for message in self.messages {
            message.flow.reset(FlowEnd::Stale);
        }
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use sgc_wire::{Class, HOP_LIMIT, PacketHeader};

    use super::*;

    fn packet(seq: u64, index: u16) -> Packet {
        let header = PacketHeader {
            reliable: false,
            class: Class::Bulk,
            hops: HOP_LIMIT,
            suite: 1,
            epoch: 1,
            name: Name([1; 32]),
            source: SourceId([2; 16]),
            seq,
            total: 3 * 1000,
            index,
            grid: 1000,
            to: None,
        };
        Packet::new(header, Bytes::from(vec![0; 1000]).into()).unwrap()
    }

    #[tokio::test]
    async fn newer_messages_do_not_push_out_the_end_of_one_that_is_being_sent() {
        let flow = OutFlow::idle();
        for index in 0..3 {
            assert!(flow.push(packet(1, index)).await.is_none());
        }
        let mut taken = VecDeque::new();
        let (first, _) = flow.at_hand(&mut taken).unwrap();
        assert!(!flow.is_superseded(&first));
        flow.take_rest(&first, &mut taken);
        for seq in 2..1000 {
            for index in 0..3 {
                flow.push(packet(seq, index)).await;
            }
        }
        for index in 1..3 {
            let (next, _) = flow.at_hand(&mut taken).unwrap();
            assert_eq!((next.header.seq, next.header.index), (1, index));
            assert!(!flow.is_superseded(&next));
        }
        // Of those that wait, only the newest is begun.
        let mut begun = vec![];
        while flow.queue.bytes() > 0 {
            let (next, _) = flow.at_hand(&mut taken).unwrap();
            if !flow.is_superseded(&next) && next.header.index == 0 {
                begun.push(next.header.seq);
            }
        }
        assert_eq!(begun, [999]);
    }

    #[tokio::test]
    async fn of_messages_in_one_packet_the_newest_of_each_source_waits_if_so_wished() {
        let one = |source: u8, seq| {
            let mut packet = packet(seq, 0);
            (packet.header.source, packet.header.total) = (SourceId([source; 16]), 1000);
            packet
        };
        let flow = OutFlow::idle();
        for seq in 1..10 {
            flow.push(one(2, seq)).await;
            flow.push(one(3, seq)).await;
        }
        for index in 0..3 {
            flow.push(packet(10, index)).await;
        }
        let (mut taken, mut sent) = (VecDeque::new(), vec![]);
        while let Some((next, _)) = taken.pop_front().or_else(|| flow.queue.try_pop()) {
            if !flow.has_newer(&next, &mut taken) {
                sent.push((next.header.source.0[0], next.header.seq));
            }
        }
        assert_eq!(sent, [(2, 9), (3, 9), (2, 10), (2, 10), (2, 10)]);
    }
}
