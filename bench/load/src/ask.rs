//! Requests and answers of different sizes: `ask` sends requests at its rate, and `answer` answers them.
//!
//! A request names the length of its answer in its data. One without a length is hello, and answered at once. An
//! `answer` of several topics answers all once it has a request on each, like a fleet that goes step by step.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use clap::Args;

use crate::caller::Caller;
use crate::network::Message;
use crate::node::{LONG, Node};
use crate::ping::HEAD_BYTES;
use crate::report::{Event, Next, Order, say};
use crate::{Common, now_ns};

/// Bytes of the answer's length at the beginning of a request's data, little endian.
const ANSWER_BYTES: usize = 4;
/// The longest answer, bytes.
const ANSWER_MAX: usize = 64 << 20;

#[derive(Args)]
pub(crate) struct AskArgs {
    #[command(flatten)]
    common: Common,
    /// The topic that answers come on
    #[arg(long, value_name = "/TOPIC")]
    back: String,
}

#[derive(Args)]
pub(crate) struct AnswerArgs {
    #[command(flatten)]
    common: Common,
    /// The topic of answers
    #[arg(long, value_name = "/TOPIC")]
    back: String,
    /// Number of topics, `/TOPIC_0` and so on, answered together; without it, one topic with its plain name
    #[arg(long)]
    together: Option<usize>,
}

/// The content of one order.
struct Questions {
    size: usize,
    answer: usize,
    count: usize,
    seconds: f64,
    warm_up: usize,
    patience: Duration,
    rate: Option<f64>,
}

/// Takes [`Order::Ask`].
pub(crate) fn ask(args: &AskArgs) -> Result<()> {
    let Some(mut asker) = Caller::connect(&args.common, &args.back)? else { return Ok(()) };
    loop {
        match asker.node.orders.next()? {
            Next::End => return Ok(()),
            Next::Wait => drop(asker.node.waiter.wait(LONG)?),
            Next::Do(Order::Ask { size, answer, count, seconds, warm_up, patience_seconds, rate }) => {
                let patience = Duration::try_from_secs_f64(patience_seconds)?;
                say(&questions(
                    &mut asker,
                    &Questions { size, answer, count, seconds, warm_up, patience, rate },
                )?)?;
            }
            Next::Do(order) => bail!("{order:?} is not for ask"),
        }
    }
}

fn questions(asker: &mut Caller, plan: &Questions) -> Result<Event> {
    let &Questions { size, answer, count, seconds, warm_up, patience, rate } = plan;
    ensure!(size >= HEAD_BYTES + ANSWER_BYTES, "a request has {} bytes at least", HEAD_BYTES + ANSWER_BYTES);
    ensure!((HEAD_BYTES..=ANSWER_MAX).contains(&answer), "no answer has {answer} bytes");
    ensure!(rate.is_none_or(|rate| rate > 0.0), "no rate");
    let mut data = vec![0x5a; size - HEAD_BYTES];
    data[..ANSWER_BYTES].copy_from_slice(&u32::try_from(answer)?.to_le_bytes());
    for _ in 0..warm_up {
        asker.round_trip(&data, answer - HEAD_BYTES, patience)?;
    }
    let (mut round_trips_us, mut lost) = (Vec::new(), 0);
    let (begun, begun_ns) = (Instant::now(), now_ns());
    let mut tick = 0;
    while round_trips_us.len() + lost < count && begun.elapsed().as_secs_f64() < seconds {
        if let Some(rate) = rate {
            // Requests that fall due during a wait are skipped, like frames of a camera; the next one is fresh.
            tick = tick.max((begun.elapsed().as_secs_f64() * rate).ceil() as u64);
            let due = Duration::from_secs_f64(tick as f64 / rate);
            std::thread::sleep(due.saturating_sub(begun.elapsed()));
            tick += 1;
        }
        match asker.round_trip(&data, answer - HEAD_BYTES, patience)? {
            Some(took) => round_trips_us.push(took.as_secs_f64() * 1e6),
            None => lost += 1,
        }
    }
    Ok(Event::Answered { size, round_trips_us, lost, begun_ns, ended_ns: now_ns() })
}

/// Takes no orders.
pub(crate) fn answer(args: &AnswerArgs) -> Result<()> {
    let names = |topic: &str| match args.together {
        None => vec![topic.to_owned()],
        Some(count) => (0..count).map(|number| format!("{topic}_{number}")).collect(),
    };
    let node = Node::start(&args.common, names(&args.common.topic), names(&args.back))?;
    let mut requests: Vec<Option<Request>> = node.readers.iter().map(|_| None).collect();
    let mut filler = Vec::new();
    loop {
        for (number, pending) in requests.iter_mut().enumerate() {
            let mut hellos = Vec::new();
            node.readers[number].take(|message| {
                match message.data.first_chunk::<ANSWER_BYTES>() {
                    None => hellos.push(message.seq),
                    Some(bytes) => {
                        let bytes = u32::from_le_bytes(*bytes) as usize;
                        ensure!((HEAD_BYTES..=ANSWER_MAX).contains(&bytes), "no answer has {bytes} bytes");
                        *pending = Some(Request { seq: message.seq, answer: bytes });
                    }
                }
                Ok(())
            })?;
            for seq in hellos {
                reply(&node, number, seq, &[])?;
            }
        }
        if requests.iter().all(Option::is_some) {
            for (number, request) in requests.iter_mut().enumerate() {
                let Request { seq, answer } = request.take().context("a request that was there")?;
                filler.resize(filler.len().max(answer), 0x5a);
                reply(&node, number, seq, &filler[..answer - HEAD_BYTES])?;
            }
        }
        match node.orders.next()? {
            Next::Wait => drop(node.waiter.wait(LONG)?),
            Next::End => return Ok(()),
            Next::Do(order) => bail!("{order:?} is not for answer"),
        }
    }
}

/// A request that waits for an answer.
struct Request {
    seq: u64,
    answer: usize,
}

fn reply(node: &Node, number: usize, seq: u64, data: &[u8]) -> Result<()> {
    let message = Message { seq, stamp_ns: now_ns(), data };
    while !node.writers[number].write(&message)? {
        if matches!(node.orders.next()?, Next::End) {
            bail!("ended while an answer waits for room");
        }
    }
    Ok(())
}
