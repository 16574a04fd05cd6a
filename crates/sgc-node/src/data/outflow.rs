//! [`OutFlow`]: the packets of one name for one link, in a bounded queue with the task that sends them.
//!
//! Reliable packets share one flow of the link. A best-effort message leaves as a datagram if it fits one, else on a
//! flow of its own. Of best-effort messages in several packets, only the newest complete one waits.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use sgc_session::{BULK_MESSAGE_BYTES_MIN, BulkMeter};
use sgc_transport::{AnyLink, FlowEnd, FlowTx, Link, LinkError};
use sgc_wire::{Label, Name, Packet, SourceId};
use tokio::sync::watch;
use tracing::debug;

use crate::data::labels::NameLabel;
use crate::data::queue::{PushError, Queue};
use crate::data::stats::{CountDrops, DataDrop, Dropped};
use crate::link::lanes::Lanes;

/// Most packets that wait for one link under one name.
pub(crate) const OUTFLOW_PACKETS_MAX: usize = 1024;
/// Bytes of reliable packets that may wait before the source is blocked.
pub(crate) const OUTFLOW_RELIABLE_BYTES_MAX: usize = 4 << 20;
/// Longest time that a link without progress blocks a reliable source.
pub(crate) const OUTFLOW_PATIENCE: Duration = Duration::from_secs(5);
/// Most bytes of best-effort packets that wait. Larger messages are cut there and lost.
pub(crate) const OUTFLOW_BYTES_MAX: usize = 16 << 20;
/// Longest wait of a best-effort packet by default. Later it is useless.
pub(crate) const OUTFLOW_AGE_MAX: Duration = Duration::from_secs(1);

/// Bytes of waiting reliable packets that are written together. A fast path has more under way; a thin link takes them
/// in parts.
const TOGETHER_BYTES_MAX: usize = 16 << 10;

/// A packet and the time since which it waits.
type Waiting = (Packet, Instant);

/// Most best-effort messages of several packets that are sent in parallel. Several sources, or interleaved arrival,
/// lead to that.
const MESSAGES_MAX: usize = 4;

/// The data path's end of the queue.
pub(crate) struct OutFlow {
    queue: Queue<Waiting>,
    /// Number of complete best-effort messages of several packets in the queue.
    complete: AtomicUsize,
    ended: watch::Sender<bool>,
}

impl OutFlow {
    /// Starts the sending task. It ends when the queue is closed and empty, or the link ends. A best-effort message
    /// whose beginning has waited for longer than `max_age` is left out.
    pub(crate) fn spawn(
        link: AnyLink,
        name: Name,
        label: Option<NameLabel>,
        lanes: Arc<Lanes>,
        max_age: Duration,
        drops: Arc<dyn CountDrops>,
    ) -> Arc<Self> {
        let flow = Arc::new(Self {
            queue: Queue::new(OUTFLOW_PACKETS_MAX),
            complete: AtomicUsize::new(0),
            ended: watch::Sender::new(false),
        });
        let task = flow.clone();
        sgc_executor::spawn(async move {
            let mut sender = Sender {
                by: link.clone(),
                lane: None,
                name,
                link,
                lanes,
                label,
                meter: BulkMeter::default(),
                reliable: None,
                messages: VecDeque::new(),
                left_out: None,
                drops,
            };
            if let Err(error) = task.empty(&mut sender, max_age).await {
                debug!(name = %name.short(), %error, "stopped sending over this link");
            }
            task.close();
            sender.finish().await;
            task.ended.send_replace(true);
        });
        flow
    }

    /// Creates a queue that only [`Self::queued`] empties.
    #[cfg(any(test, feature = "benchmarks"))]
    pub(crate) fn idle() -> Arc<Self> {
        Arc::new(Self {
            queue: Queue::new(OUTFLOW_PACKETS_MAX),
            complete: AtomicUsize::new(0),
            ended: watch::Sender::new(true),
        })
    }

    /// Waits for the oldest packet and returns it. The queue must not be closed.
    #[cfg(any(test, feature = "benchmarks"))]
    pub(crate) async fn queued(&self) -> Packet {
        self.queue.pop().await.expect("it is open").0
    }

    /// Queues a packet. Fails if it, or others for it, were dropped.
    pub(crate) async fn push(&self, packet: Packet) -> Result<(), Dropped> {
        let bytes = packet.encoded_bytes();
        if packet.header.reliable {
            return match self
                .queue
                .push((packet, Instant::now()), bytes, OUTFLOW_RELIABLE_BYTES_MAX, OUTFLOW_PATIENCE)
                .await
            {
                Ok(()) => Ok(()),
                Err(PushError::Stalled) => Err(Dropped::one(DataDrop::Stalled)),
                Err(PushError::Closed) => Err(Dropped::one(DataDrop::LinkClosed)),
            };
        }
        if self.queue.is_closed() {
            return Err(Dropped::one(DataDrop::LinkClosed));
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
        Dropped::check(DataDrop::Stale, evicted)
    }

    /// Returns `true` if the queue is far from blocking.
    pub(crate) fn has_headroom(&self) -> bool {
        self.queue.has_headroom(OUTFLOW_RELIABLE_BYTES_MAX)
    }

    /// Returns `true` if no packet waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// Closes the queue. Queued packets are still sent.
    pub(crate) fn close(&self) {
        self.queue.close();
    }

    /// Waits until the task has ended.
    pub(crate) async fn ended(&self) {
        // This cannot fail, since `self` holds the sender.
        let _ = self.ended.subscribe().wait_for(|ended| *ended).await;
    }

    /// Sends packets until the queue is closed and empty, or the link ends.
    async fn empty(&self, sender: &mut Sender, max_age: Duration) -> Result<(), LinkError> {
        // Where no age is configured, an old message is one that the link had no room for.
        let too_old = if max_age < OUTFLOW_AGE_MAX { DataDrop::TooOld } else { DataDrop::Stale };
        // The rest of the current message, and packets that came between.
        let mut taken = VecDeque::new();
        loop {
            let next = match self.at_hand(&mut taken) {
                Some(next) => Some(next),
                None => {
                    // No further packet is ready, so the kept ones leave.
                    sender.flush().await?;
                    self.queue.pop().await
                }
            };
            let Some((packet, since)) = next else { return Ok(()) };
            // Limits apply at the beginning: a large message that is under way continues.
            let begins = !packet.header.reliable && packet.header.index == 0;
            let is_old = begins && since.elapsed() > max_age;
            if self.is_superseded(&packet) {
                sender.leave_out(&packet, DataDrop::Stale);
                continue;
            }
            if is_old {
                sender.leave_out(&packet, too_old);
                continue;
            }
            if begins && !packet.header.is_last() {
                self.take_rest(&packet, &mut taken);
            }
            sender.send(packet).await?;
        }
    }

    /// Returns the next packet, if one is ready.
    fn at_hand(&self, taken: &mut VecDeque<Waiting>) -> Option<Waiting> {
        taken.pop_front().or_else(|| self.queue.try_pop())
    }

    /// Takes the queued rest of a message that begins. Otherwise newer messages could displace its end while it is
    /// sent, and on a slow link none would ever arrive whole.
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

    /// Returns `true` if the packet belongs to a best-effort message that a complete newer one supersedes.
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

/// A best-effort message of several packets that is being sent.
struct Message {
    id: (SourceId, u64),
    /// Index of the next packet.
    next: u16,
    flow: FlowTx,
}

/// The link's end of the queue.
struct Sender {
    /// The link, or a lane of it.
    by: AnyLink,
    /// Number of the lane.
    lane: Option<u64>,
    name: Name,
    link: AnyLink,
    lanes: Arc<Lanes>,
    /// Label of the name of all packets.
    label: Option<NameLabel>,
    /// Measures whether the name is worth a bulk lane.
    meter: BulkMeter,
    reliable: Option<FlowTx>,
    /// Best-effort messages of several packets that are being sent, the oldest first.
    messages: VecDeque<Message>,
    /// The last message that was left out, and the reason for its later packets.
    left_out: Option<((SourceId, u64), DataDrop)>,
    drops: Arc<dyn CountDrops>,
}

impl Sender {
    /// Sends a packet, or keeps a reliable one for [`Self::flush`].
    async fn send(&mut self, packet: Packet) -> Result<(), LinkError> {
        if packet.header.index == 0 {
            let bytes = u64::from(packet.header.total);
            if packet.header.reliable
                && bytes >= BULK_MESSAGE_BYTES_MIN
                && self.meter.note(Instant::now(), bytes)
            {
                self.lanes.ask_for_bulk(self.name);
            }
            self.choose().await?;
        }
        if !packet.header.reliable {
            self.flush().await?;
        }
        let sent = self.send_by(packet).await;
        self.outlive_lane(sent)
    }

    /// Sends the kept packets.
    async fn flush(&mut self) -> Result<(), LinkError> {
        let sent = self.flush_by().await;
        self.outlive_lane(sent)
    }

    /// Continues on the link if only the lane ended.
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

    /// Chooses the lane if there is one, else the link. Earlier packets on the other connection arrive first, or their
    /// lane is gone.
    async fn choose(&mut self) -> Result<(), LinkError> {
        let lane = self.lanes.for_name(&self.name);
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

    /// Sends everything over the link from here on.
    fn take_link(&mut self) {
        (self.by, self.lane) = (self.link.clone(), None);
        self.reliable = None;
        self.messages.clear();
    }

    /// Returns the label. Lanes have none, since labels belong to the link.
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
                // The path's MTU shrank in between.
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
        // Without a flow, the beginning was dropped, and the rest is useless.
        let Some(message) = at.and_then(|at| self.messages.get_mut(at)) else {
            let reason =
                self.left_out.filter(|(left, _)| *left == id).map_or(DataDrop::Stale, |(_, reason)| reason);
            self.drops.count_left_out(&self.name, Dropped::one(reason));
            return Ok(());
        };
        match message.flow.send_as(&packet, label).await {
            Ok(()) if !header.is_last() => message.next += 1,
            sent => {
                let ended = at.and_then(|at| self.messages.remove(at));
                match (sent, ended) {
                    // The link has admitted the whole message, so it has room for the newest.
                    (Ok(()), Some(message)) => return message.flow.finish().await,
                    // The far side stopped this flow, not the link.
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
            // The far side stopped this flow, not the link, so another begins.
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
            // The far side stopped this flow, not the link.
            Err(LinkError::FlowStopped(_)) => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Drops and counts the first packet of a message. Its later packets find no flow and are dropped as well.
    fn leave_out(&mut self, packet: &Packet, reason: DataDrop) {
        self.left_out = Some(((packet.header.source, packet.header.seq), reason));
        self.drops.count_left_out(&self.name, Dropped::one(reason));
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
            assert!(flow.push(packet(1, index)).await.is_ok());
        }
        let mut taken = VecDeque::new();
        let (first, _) = flow.at_hand(&mut taken).unwrap();
        assert!(!flow.is_superseded(&first));
        flow.take_rest(&first, &mut taken);
        for seq in 2..1000 {
            for index in 0..3 {
                let _ = flow.push(packet(seq, index)).await;
            }
        }
        for index in 1..3 {
            let (next, _) = flow.at_hand(&mut taken).unwrap();
            assert_eq!((next.header.seq, next.header.index), (1, index));
            assert!(!flow.is_superseded(&next));
        }
        // Of the waiting messages, only the newest begins.
        let mut begun = vec![];
        while flow.queue.bytes() > 0 {
            let (next, _) = flow.at_hand(&mut taken).unwrap();
            if !flow.is_superseded(&next) && next.header.index == 0 {
                begun.push(next.header.seq);
            }
        }
        assert_eq!(begun, [999]);
    }
}
