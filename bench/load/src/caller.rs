//! Who sends one message at a time and waits for what comes back: what [`crate::ping`] and [`crate::ask`] have in common. What is
//! sent, and how often, they decide.

use std::time::{Duration, Instant};

use anyhow::{Result, ensure};

use crate::dds::Message;
use crate::node::Node;
use crate::report::{Event, Next, say};
use crate::{Common, now_ns};

/// A node that speaks on one topic and hears the answers on another.
pub(crate) struct Caller {
    pub(crate) node: Node,
    seq: u64,
}

impl Caller {
    /// Up and heard by who answers, and says so; or none, if the program is to end.
    pub(crate) fn connect(common: &Common, back: &str) -> Result<Option<Self>> {
        let node = Node::start(common, [back.to_owned()], [common.topic.clone()])?;
        if !node.until_matched()? {
            return Ok(None);
        }
        let mut seq = 0;
        // Matched is what is near; whatever is in between may not be through yet, and forgets what nobody hears.
        while !node.is_heard(seq)? {
            seq += 1;
            if matches!(node.orders.next()?, Next::End) {
                return Ok(None);
            }
        }
        say(&Event::Connected)?;
        Ok(Some(Self { node, seq }))
    }

    /// How long an answer with so many bytes of data took, unless it took longer than that.
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
                // Others are answers to those that were given up.
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
