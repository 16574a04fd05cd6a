//! Orders and events, one line of JSON each.

use std::io::Write as _;

use anyhow::Result;
use serde::{Deserialize, Serialize};

/// An order to `connect`.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "kebab-case", deny_unknown_fields)]
pub(crate) enum Order {
    /// Round trips.
    Measure {
        /// Bytes of a message.
        size: u32,
        /// Most counted repetitions.
        count: usize,
        /// Time after which no further one begins.
        seconds: f64,
        /// Number of uncounted repetitions before.
        warm_up: usize,
    },
    /// A transfer in one direction.
    Send {
        /// Time that counts, at the receiver.
        seconds: f64,
        /// Time before that, which does not count.
        warm_up_seconds: f64,
    },
}

/// An event.
#[derive(Clone, Debug, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Event {
    /// `relay`: it accepts clients.
    Up,
    /// `serve`: it is connected to its relay and has this id.
    Serving(String),
    /// `connect`: the first message has been to the other end and back.
    Connected {
        /// Time from the call that connects, ms.
        after_ms: f64,
    },
    /// Application data take a direct path.
    Direct {
        /// Time from the call that connects, ms; since the connection was accepted in `serve`.
        after_ms: f64,
    },
    /// The answer to [`Order::Measure`].
    Measured {
        /// Each round trip, in their order, µs.
        round_trips_us: Vec<f64>,
    },
    /// The answer to [`Order::Send`].
    Sent {
        /// Bytes that arrived in the time that counts.
        bytes: u64,
        /// That time.
        seconds: f64,
    },
}

/// Prints an event at once.
pub(crate) fn say(event: &Event) -> Result<()> {
    let mut line = serde_json::to_string(event)?;
    line.push('\n');
    let mut out = std::io::stdout().lock();
    out.write_all(line.as_bytes())?;
    Ok(out.flush()?)
}
