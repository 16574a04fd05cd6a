//! The common part of [`crate::ping`] and [`crate::ask`]: sends one message at a time and waits for the answer. They
//! decide on content and rate.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use crate::network::Message;
use crate::node::Node;
use crate::report::{Event, Next, say};
use crate::{Common, now_ns};

/// A node that publishes on one topic and receives the answers on another.
pub(crate) struct Caller {
    pub(crate) node: Node,
    seq: u64,
}

impl Caller {
    /// Starts a node and waits until the answering program hears it. Returns `None` if the program has to end.
    pub(crate) fn connect(common: &Common, back: &str) -> Result<Option<Self>> {
        let node = Node::start(common, [back.to_owned()], [common.topic.clone()])?;
        if !node.until_matched()? {
            return Ok(None);
        }
        let mut seq = 0;
        // A local match does not mean that the whole path is up, so early messages may be lost.
        while !node.is_heard(seq)? {
            seq += 1;
            if matches!(node.orders.next()?, Next::End) {
                return Ok(None);
            }
        }
        say(&Event::Connected)?;
        Ok(Some(Self { node, seq }))
    }

    /// Returns the time until an answer with so many bytes of data came, or `None` if it took too long.
    pub(crate) fn round_trip(
        &mut self,
        data: &[u8],
        answer_bytes: usize,
        patience: Duration,
    ) -> Result<Option<Duration>> {
        self.seq += 1;
        let seq = self.seq;
        let begun = Instant::now();
        let message = Message { seq, stamp_ns: now_ns(), data };
        while !self.node.writers[0].write(&message)? {
            if begun.elapsed() > patience {
                return Ok(None);
            }
        }
        let mut came = None;
        loop {
            self.node.readers[0].take(|message| {
                // Other numbers are late answers.
                if message.seq == seq {
                    ensure!(message.data.len() == answer_bytes, "an answer of another length");
                    came = Some(begun.elapsed());
                }
                Ok(())
            })?;
            if came.is_some() {
                return Ok(came);
            }
            let Some(left) = patience.checked_sub(begun.elapsed()) else { return Ok(None) };
            self.node.waiter.wait(left)?;
        }
    }
}
