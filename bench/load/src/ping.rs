//! Round trips: `ping` sends a message and waits until `pong` has sent it back.

use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use clap::Args;

use crate::Common;
use crate::caller::Caller;
use crate::node::{LONG, Node};
use crate::report::{Event, Next, Order, say};

/// Bytes of `seq` and `stamp_ns` in a message's size.
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
    let Some(mut ping) = Caller::connect(&args.common, &args.back)? else { return Ok(()) };
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
                    ping.round_trip(&data, data.len(), patience)?;
                }
                let begun = Instant::now();
                while round_trips_us.len() + lost < count && begun.elapsed().as_secs_f64() < seconds {
                    match ping.round_trip(&data, data.len(), patience)? {
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
