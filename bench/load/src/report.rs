//! Orders and events, one line of JSON each.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::io::BufRead as _;
use std::sync::mpsc::{Receiver, TryRecvError, channel};

use anyhow::{Context, Result};
use serde::{Deserialize, Serialize};

use crate::network::Bell;

/// An order to a role.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub(crate) enum Order {
    /// `ping`: round trips.
    Measure {
        /// Bytes of a message, at least 16.
        size: usize,
        /// Most counted repetitions.
        count: usize,
        /// Time after which no further one begins.
        seconds: f64,
        /// Number of uncounted repetitions before.
        warm_up: usize,
        /// Longest wait for each.
        patience_seconds: f64,
    },
    /// `ask`: requests.
    Ask {
        /// Bytes of a request, at least 20.
        size: usize,
        /// Bytes of an answer, at least 16.
        answer: usize,
        /// Most counted repetitions.
        count: usize,
        /// Time after which no further one begins.
        seconds: f64,
        /// Number of uncounted repetitions before.
        warm_up: usize,
        /// Longest wait for each answer.
        patience_seconds: f64,
        /// Requests a second, of which those that fall due while an answer is awaited are left out; without it the next
        /// follows upon the answer.
        rate: Option<f64>,
    },
    /// `source`: messages.
    Send {
        /// The number of this run, more than that of the one before; at least 1.
        run: u32,
        /// Bytes of a message, at least 16.
        size: usize,
        /// At most so many.
        count: u32,
        /// Time after which no further one begins.
        seconds: f64,
        /// Messages a second; without it as fast as writing goes.
        rate: Option<f64>,
    },
    /// `sink`: what came of a run.
    Count {
        /// The run.
        run: u32,
        /// Its last message.
        last: u32,
        /// Time without a message after which the run is over.
        quiet_seconds: f64,
    },
}

/// An event of a role.
#[derive(Clone, Debug, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Event {
    /// It is up.
    Up,
    /// `relay`: the other end may connect.
    Listening,
    /// Every topic is matched on the local network.
    Matched,
    /// The first message has passed the whole path.
    Connected,
    /// The answer to [`Order::Measure`].
    Measured {
        /// Bytes of a message.
        size: usize,
        /// Each round trip, in their order, µs.
        round_trips_us: Vec<f64>,
        /// Number of messages that did not come back in time.
        lost: usize,
    },
    /// The answer to [`Order::Ask`].
    Answered {
        /// Bytes of a request.
        size: usize,
        /// From each request to its answer, in their order, µs.
        round_trips_us: Vec<f64>,
        /// Number of requests without an answer in time.
        lost: usize,
        /// Before the first that counts, by the monotonic clock, ns.
        begun_ns: u64,
        /// After the last.
        ended_ns: u64,
    },
    /// The answer to [`Order::Send`].
    Sent {
        /// The run.
        run: u32,
        /// How many; they are numbered from 1.
        count: u32,
        /// When the first was written, by the monotonic clock, ns.
        begun_ns: u64,
        /// When the last had been written.
        ended_ns: u64,
    },
    /// The answer to [`Order::Count`].
    Counted {
        /// The run.
        run: u32,
        /// Messages, by reader.
        received: Vec<u32>,
        /// When the last came that any reader got, by the monotonic clock, ns; 0 if none did.
        ended_ns: u64,
        /// The longest time between two messages of one reader, µs.
        silence_us: f64,
        /// From before it was written until it was taken: middle, 99 of 100, most, of all readers, µs.
        age_us: [f64; 3],
    },
}

/// Prints an event at once.
pub(crate) fn say(event: &Event) -> Result<()> {
    use std::io::Write as _;
    let mut line = serde_json::to_string(event)?;
    line.push('\n');
    let mut out = std::io::stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}

/// Orders, as they come; a thread reads them and rings.
#[derive(Debug)]
pub(crate) struct Orders {
    come: Receiver<Result<Order>>,
    /// Those that came while it was only looked whether there is an end.
    kept: RefCell<VecDeque<Order>>,
}

/// The next action of a role.
#[derive(Debug)]
pub(crate) enum Next {
    /// Carry out an order.
    Do(Order),
    /// Wait for an order.
    Wait,
    /// End the program.
    End,
}

impl Orders {
    pub(crate) fn listen(bell: Bell) -> Self {
        let (orders, receiver) = channel();
        std::thread::spawn(move || {
            for line in std::io::stdin().lock().lines() {
                let order = line.context("standard input").and_then(|line| {
                    serde_json::from_str(&line)
                        .with_context(|| format!("an order that cannot be read: {line}"))
                });
                if orders.send(order).is_err() {
                    return;
                }
                bell.ring();
            }
            drop(orders);
            bell.ring();
        });
        Self { come: receiver, kept: RefCell::default() }
    }

    /// Returns whether the program has to end. Keeps orders that come meanwhile for later.
    pub(crate) fn have_ended(&self) -> Result<bool> {
        loop {
            match self.come.try_recv() {
                Ok(order) => self.kept.borrow_mut().push_back(order?),
                Err(TryRecvError::Empty) => return Ok(false),
                Err(TryRecvError::Disconnected) => return Ok(true),
            }
        }
    }

    pub(crate) fn next(&self) -> Result<Next> {
        if let Some(order) = self.kept.borrow_mut().pop_front() {
            return Ok(Next::Do(order));
        }
        match self.come.try_recv() {
            Ok(order) => Ok(Next::Do(order?)),
            Err(TryRecvError::Empty) => Ok(Next::Wait),
            Err(TryRecvError::Disconnected) => Ok(Next::End),
        }
    }
}
