//! One-way flows: `source` sends messages, `sink` counts them and their ages.
//!
//! A message's number consists of the number of its run, above [`RUN_SHIFT`], and its own. Run 0 is hello, which is
//! sent until the first run begins and is not counted.

use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use clap::Args;

use crate::network::Message;
use crate::node::{HELLO_EVERY, LONG, Node};
use crate::ping::HEAD_BYTES;
use crate::report::{Event, Next, Order, say};
use crate::{Common, now_ns};

const RUN_SHIFT: u32 = 32;
/// Most ages that a sink keeps for all its readers. Beyond it, the sink keeps every n-th.
const AGES_MAX: usize = 1 << 20;
/// Longest wait of a source for acknowledgements at its end.
const ACKNOWLEDGE_MAX: Duration = Duration::from_secs(1);

#[derive(Args)]
pub(crate) struct SourceArgs {
    #[command(flatten)]
    common: Common,
}

#[derive(Args)]
pub(crate) struct SinkArgs {
    #[command(flatten)]
    common: Common,
    /// Number of readers in this process
    #[arg(long, default_value_t = 1)]
    readers: usize,
}

/// Takes [`Order::Send`].
pub(crate) fn source(args: &SourceArgs) -> Result<()> {
    let node = Node::start(&args.common, [], [args.common.topic.clone()])?;
    if !node.until_matched()? {
        return Ok(());
    }
    let mut greets = true;
    loop {
        match node.orders.next()? {
            Next::End => return Ok(()),
            Next::Wait if greets => {
                node.writers[0].write(&Message { seq: 0, stamp_ns: now_ns(), data: &[] })?;
                node.waiter.wait(HELLO_EVERY)?;
            }
            Next::Wait => drop(node.waiter.wait(LONG)?),
            Next::Do(Order::Send { run, size, count, seconds, rate }) => {
                greets = false;
                ensure!(run > 0, "run 0 is hello");
                ensure!(size >= HEAD_BYTES, "a message has at least {HEAD_BYTES} bytes");
                say(&send(&node, run, &vec![0x5a; size - HEAD_BYTES], count, seconds, rate)?)?;
            }
            Next::Do(order) => bail!("{order:?} is not for source"),
        }
    }
}

fn send(node: &Node, run: u32, data: &[u8], count: u32, seconds: f64, rate: Option<f64>) -> Result<Event> {
    let first = u64::from(run) << RUN_SHIFT;
    let begun_ns = now_ns();
    let begun = Instant::now();
    let deadline = Duration::try_from_secs_f64(seconds)?;
    let mut sent = 0;
    while sent < count && begun.elapsed() < deadline {
        if let Some(rate) = rate {
            // After a delay the source keeps its schedule; ages count from the time of writing.
            let due = Duration::from_secs_f64(f64::from(sent) / rate);
            if let Some(left) = due.checked_sub(begun.elapsed()) {
                std::thread::sleep(left);
            }
        }
        let message = Message { seq: first | u64::from(sent + 1), stamp_ns: now_ns(), data };
        if node.writers[0].write(&message)? {
            sent += 1;
        }
    }
    let ended_ns = now_ns();
    node.writers[0].until_acknowledged(ACKNOWLEDGE_MAX)?;
    Ok(Event::Sent { run, count: sent, begun_ns, ended_ns })
}

/// Takes [`Order::Count`].
pub(crate) fn sink(args: &SinkArgs) -> Result<()> {
    ensure!(args.readers > 0, "no reader");
    let topics = std::iter::repeat_n(args.common.topic.clone(), args.readers);
    let node = Node::start(&args.common, topics, [])?;
    if !node.until_matched()? {
        return Ok(());
    }
    let mut tally = Tally::new(args.readers, 0);
    let mut greeted = vec![false; args.readers];
    let mut connected = false;
    let mut last_came = Instant::now();
    let mut asked: Option<(u32, u32, Duration)> = None;
    loop {
        let (timeout, is_over) = match asked {
            None => (LONG, false),
            Some((run, last, quiet)) => {
                let left = quiet.saturating_sub(last_came.elapsed());
                let is_whole = tally.run == run && tally.received.iter().all(|&n| n >= last);
                (left, is_whole || left.is_zero())
            }
        };
        if let Some((run, ..)) = asked.filter(|_| is_over) {
            if tally.run != run {
                tally = Tally::new(args.readers, run);
            }
            say(&tally.event())?;
            asked = None;
            continue;
        }
        let woken = node.waiter.wait(timeout)?;
        for reader in woken.readers {
            node.readers[reader].take(|message| {
                last_came = Instant::now();
                greeted[reader] = true;
                let run = (message.seq >> RUN_SHIFT) as u32;
                if run > tally.run {
                    tally = Tally::new(args.readers, run);
                }
                if run == tally.run && run > 0 {
                    tally.count(reader, message.stamp_ns);
                }
                Ok(())
            })?;
        }
        if !connected && greeted.iter().all(|&g| g) {
            connected = true;
            say(&Event::Connected)?;
        }
        match node.orders.next()? {
            Next::Wait => {}
            Next::End => return Ok(()),
            Next::Do(Order::Count { run, last, quiet_seconds }) => {
                asked = Some((run, last, Duration::try_from_secs_f64(quiet_seconds)?));
                last_came = Instant::now();
            }
            Next::Do(order) => bail!("{order:?} is not for sink"),
        }
    }
}

/// The count of one run.
struct Tally {
    run: u32,
    received: Vec<u32>,
    /// Arrival of each reader's last message; 0 if none came.
    last_ns: Vec<u64>,
    silence_ns: u64,
    ended_ns: u64,
    ages_us: Vec<f32>,
    /// Every n-th age is kept.
    stride: u64,
    seen: u64,
}

impl Tally {
    fn new(readers: usize, run: u32) -> Self {
        let (received, last_ns) = (vec![0; readers], vec![0; readers]);
        Self { run, received, last_ns, silence_ns: 0, ended_ns: 0, ages_us: Vec::new(), stride: 1, seen: 0 }
    }

    fn count(&mut self, reader: usize, stamp_ns: u64) {
        let now = now_ns();
        self.received[reader] += 1;
        let last = std::mem::replace(&mut self.last_ns[reader], now);
        if last > 0 {
            self.silence_ns = self.silence_ns.max(now.saturating_sub(last));
        }
        self.ended_ns = now;
        self.seen += 1;
        if !self.seen.is_multiple_of(self.stride) {
            return;
        }
        if self.ages_us.len() == AGES_MAX {
            let mut keep = false;
            self.ages_us.retain(|_| {
                keep = !keep;
                keep
            });
            self.stride *= 2;
        }
        self.ages_us.push(now.saturating_sub(stamp_ns) as f32 / 1e3);
    }

    fn event(&mut self) -> Event {
        self.ages_us.sort_unstable_by(f32::total_cmp);
        let last = self.ages_us.len().saturating_sub(1);
        let at =
            |part: f64| self.ages_us.get((last as f64 * part) as usize).map_or(0.0, |&age| f64::from(age));
        Event::Counted {
            run: self.run,
            received: self.received.clone(),
            ended_ns: self.ended_ns,
            silence_us: self.silence_ns as f64 / 1e3,
            age_us: [at(0.5), at(0.99), at(1.0)],
        }
    }
}
