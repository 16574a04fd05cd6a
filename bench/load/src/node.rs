//! A ROS 2 node: a program on the network that announces its readers and writers.

use std::time::{Duration, Instant};

use anyhow::Result;

use crate::network::{Graph, Message, Network, Reader, Waiter, Writer};
use crate::report::{Event, Orders, say};
use crate::{Common, now_ns};

/// Time-out of waits that only an event ends.
pub(crate) const LONG: Duration = Duration::from_secs(3600);
/// How often an unanswered first message is repeated.
pub(crate) const HELLO_EVERY: Duration = Duration::from_millis(20);

/// A node. Fields are dropped in this order.
pub(crate) struct Node {
    pub(crate) readers: Vec<Reader>,
    pub(crate) writers: Vec<Writer>,
    pub(crate) waiter: Waiter,
    pub(crate) orders: Orders,
    _graph: Graph,
    _network: Network,
}

impl Node {
    /// Starts a node, which is up and announced on return.
    pub(crate) fn start(
        common: &Common,
        read: impl IntoIterator<Item = String>,
        write: impl IntoIterator<Item = String>,
    ) -> Result<Self> {
        let network = Network::join(common.domain, &common.node)?;
        let mut graph = Graph::open(&network)?;
        let quality = common.quality();
        let mut waiter = Waiter::new(&network)?;
        let mut readers = Vec::new();
        for topic in read {
            let reader = Reader::new(&network, &topic, quality)?;
            waiter.attach_reader(&reader, readers.len())?;
            readers.push(reader);
        }
        let mut writers = Vec::new();
        for topic in write {
            let writer = Writer::new(&network, &topic, quality)?;
            waiter.attach_writer(&writer)?;
            writers.push(writer);
        }
        graph.announce(&network, &readers, &writers)?;
        let orders = Orders::listen(waiter.bell());
        say(&Event::Up)?;
        Ok(Self { readers, writers, waiter, orders, _graph: graph, _network: network })
    }

    /// Waits until every reader and writer is matched, and reports it. Returns `false` if the program has to end.
    pub(crate) fn until_matched(&self) -> Result<bool> {
        loop {
            let readers = self.readers.iter().map(Reader::matched);
            let mut matched = readers.chain(self.writers.iter().map(Writer::matched));
            if matched.try_fold(true, |all, one| Ok::<_, anyhow::Error>(all && one? > 0))? {
                say(&Event::Matched)?;
                return Ok(true);
            }
            if self.orders.have_ended()? {
                return Ok(false);
            }
            self.waiter.wait(LONG)?;
        }
    }

    /// Sends hello on the first topic. Returns whether an answer came on the first topic of the other way, also to an
    /// earlier hello, because the path may take longer than the time between two.
    pub(crate) fn is_heard(&self, seq: u64) -> Result<bool> {
        self.writers[0].write(&Message { seq, stamp_ns: now_ns(), data: &[] })?;
        let deadline = Instant::now() + HELLO_EVERY;
        let mut is_heard = false;
        while let Some(left) = deadline.checked_duration_since(Instant::now()).filter(|_| !is_heard) {
            self.waiter.wait(left)?;
            self.readers[0].take(|_| {
                is_heard = true;
                Ok(())
            })?;
        }
        Ok(is_heard)
    }
}
