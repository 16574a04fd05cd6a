//! Round trips: `ping` sends a message and waits until `pong` has sent it back.

use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use clap::Args;

use crate::dds::Message;
use crate::node::{LONG, Node};
use crate::report::{Event, Next, Order, say};
use crate::{Common, now_ns};

/// What `seq` and `stamp_ns` take of a message's size, bytes.
pub(crate) const HEAD_BYTES: usize = 16;

#[derive(Args)]
pub(crate) struct PingArgs {
    #[command(flatten)]
    common: Common,
    /// The topic that messages come back on
    #[arg(long, value_name = "/TOPIC")]
    back: String,
}

/// Takes [`Order::Measure`].
pub(crate) fn ping(args: &PingArgs) -> Result<()> {
    let node = Node::start(&args.common, [args.back.clone()], [args.common.topic.clone()])?;
    if !node.until_matched()? {
        return Ok(());
    }
    let mut ping = Ping { node, seq: 0 };
    // Matched is what is near; whatever is in between may not be through yet, and forgets what nobody hears.
    while !ping.node.is_heard(ping.seq)? {
        ping.seq += 1;
        if matches!(ping.node.orders.next()?, Next::End) {
            return Ok(());
        }
    }
    say(&Event::Connected)?;
    loop {
        match ping.node.orders.next()? {
            Next::End => return Ok(()),
            Next::Wait => drop(ping.node.waiter.wait(LONG)?),
            Next::Do(Order::Measure { size, count, seconds, warm_up, patience_seconds }) => {
                let patience = Duration::try_from_secs_f64(patience_seconds)?;
                let (mut round_trips_us, mut lost) = (Vec::new(), 0);
                ensure!(size >= HEAD_BYTES, "a message has at least {HEAD_BYTES} bytes");
                let data = vec![0x5a; size - HEAD_BYTES];
                for _ in 0..warm_up {
                    ping.round_trip(&data, patience)?;
                }
                let begun = Instant::now();
                while round_trips_us.len() + lost < count && begun.elapsed().as_secs_f64() < seconds {
                    match ping.round_trip(&data, patience)? {
                        Some(took) => round_trips_us.push(took.as_secs_f64() * 1e6),
                        None => lost += 1,
                    }
                }
                say(&Event::Measured { size, round_trips_us, lost })?;
            }
            Next::Do(order) => bail!("{order:?} is not for ping"),
        }
    }
}

struct Ping {
    node: Node,
    seq: u64,
}

impl Ping {
    /// How long it took, unless it took longer than that.
    fn round_trip(&mut self, data: &[u8], patience: Duration) -> Result<Option<Duration>> {
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
                    ensure!(message.data.len() == data.len(), "an answer of another length");
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

/// Takes no orders.
pub(crate) fn pong(args: &PingArgs) -> Result<()> {
    let node = Node::start(&args.common, [args.common.topic.clone()], [args.back.clone()])?;
    loop {
        node.waiter.wait(LONG)?;
        node.readers[0].take(|message| {
            while !node.writers[0].write(&message)? {
                if matches!(node.orders.next()?, Next::End) {
                    bail!("ended while an answer waits for room");
                }
            }
            Ok(())
        })?;
        match node.orders.next()? {
            Next::Wait => {}
            Next::End => return Ok(()),
            Next::Do(order) => bail!("{order:?} is not for pong"),
        }
    }
}
