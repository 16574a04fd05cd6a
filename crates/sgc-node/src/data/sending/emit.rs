//! The last stage of the sending side: hands packets to the data plane, which carries them to the links.
//!
//! The data plane has the counters of drops, so this stage counts the drops of all stages. It decides nothing about
//! messages.

use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

use sgc_executor::WakeBatch;
use sgc_router::LinkId;
use sgc_wire::{Name, Packet};
use tokio::runtime::Handle;

use crate::data::dataplane::DataPlane;
use crate::data::stats::{CountDrops, Dropped};

/// Hands the packets of one name to the data plane.
pub(crate) struct EmitStage {
    name: Name,
    data: Arc<DataPlane>,
    runtime: Handle,
    is_closed: AtomicBool,
}

impl EmitStage {
    /// Creates the stage of a name.
    pub(crate) fn new(name: Name, data: Arc<DataPlane>, runtime: Handle) -> Self {
        Self { name, data, runtime, is_closed: AtomicBool::new(false) }
    }

    /// Returns `true` if packets have a destination.
    pub(crate) fn is_wanted(&self) -> bool {
        self.data.is_wanted(&self.name)
    }

    /// Returns `true` if all destinations have headroom for a short message.
    pub(crate) fn has_headroom(&self) -> bool {
        self.data.has_headroom(&self.name)
    }

    /// Returns `true` if packets wait for a link.
    pub(crate) fn has_waiting(&self) -> bool {
        self.data.has_waiting(&self.name)
    }

    /// Returns a function that forwards packets of new messages, and waits where a link is full. Packets of a history
    /// without a sink stay here.
    pub(crate) fn packets(&self) -> impl FnMut(Packet) {
        let wanted = self.is_wanted();
        move |packet| {
            if wanted && !self.is_closed() {
                // The future is passed by reference, since tokio boxes large futures.
                sgc_executor::block_on(&self.runtime, pin!(self.data.forward(LinkId::LOCAL, packet)));
            }
        }
    }

    /// Returns a function that forwards packets for one sink that asked for them, and waits where a link is full.
    pub(crate) fn requested_packets(&self) -> impl FnMut(Packet) {
        |packet| {
            if !self.is_closed() {
                self.runtime.block_on(self.data.forward(LinkId::LOCAL, packet));
            }
        }
    }

    /// Begins a batch at whose end this thread runs the tasks of links that it woke.
    pub(crate) fn begin_batch(&self) -> WakeBatch<'_> {
        WakeBatch::begin(&self.runtime)
    }

    /// Counts the drop of a message of a local publisher.
    pub(crate) fn count(&self, dropped: Dropped) {
        for _ in 0..dropped.messages {
            self.data.count(LinkId::LOCAL, &self.name, dropped.reason);
        }
    }

    /// Counts drops of this node as a whole.
    pub(crate) fn count_here(&self, dropped: Dropped) {
        self.data.count_here(&self.name, dropped.reason, dropped.messages);
    }

    /// Stops forwarding. A thread that sends stops at its next packet.
    pub(crate) fn close(&self) {
        self.is_closed.store(true, Relaxed);
    }

    /// Returns `true` if nothing is forwarded any more.
    pub(crate) fn is_closed(&self) -> bool {
        self.is_closed.load(Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::data::sending::fixtures::{NAME, add_link, packet, queued};
    use crate::data::stats::DataDrop;

    #[test]
    fn packets_leave_while_somebody_wants_them_and_the_share_is_open() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let data = Arc::<DataPlane>::default();
        let stage = EmitStage::new(NAME, data.clone(), runtime.handle().clone());
        // Packets without a sink never come to the data plane, which would count them.
        assert!(!stage.is_wanted());
        stage.packets()(packet(1));
        assert!(data.drops().snapshot().is_empty());
        let flow = add_link(&data);
        assert!(stage.is_wanted() && stage.has_headroom());
        let mut emit = stage.packets();
        emit(packet(2));
        stage.requested_packets()(packet(3));
        assert_eq!([(); 3].map(|()| queued(&flow).map(|packet| packet.header.seq)), [Some(2), Some(3), None]);
        stage.close();
        emit(packet(4));
        stage.requested_packets()(packet(5));
        assert!(stage.is_closed() && queued(&flow).is_none());
    }

    #[test]
    fn drops_of_publishers_have_a_row_of_their_own() {
        let runtime = tokio::runtime::Runtime::new().unwrap();
        let data = Arc::<DataPlane>::default();
        let stage = EmitStage::new(NAME, data.clone(), runtime.handle().clone());
        stage.count(Dropped::one(DataDrop::TooLarge));
        stage.count_here(Dropped { reason: DataDrop::Overrun, messages: 3 });
        let local = format!("too_large from {}", LinkId::LOCAL);
        let counted: Vec<_> = data.drops().snapshot().into_iter().collect();
        assert_eq!(counted, [("overrun".to_owned(), 3), ("too_large".to_owned(), 1), (local, 1)]);
    }
}
