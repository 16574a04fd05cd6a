//! How much is sent when: the congestion controllers, and the gate that each keeps for its connection.
//!
//! Nothing here reads a clock, opens a socket or draws random numbers: QUIC says what happened, and when.

mod delay;
mod gate;
mod plain;
#[cfg(test)]
mod tests;

use std::any::Any;
use std::fmt;
use std::str::FromStr;
use std::sync::Arc;
use std::time::Instant;

use quinn::congestion::{BbrConfig, Controller, ControllerFactory, CubicConfig, NewRenoConfig};

use delay::Delay;
pub(crate) use gate::Gate;
use plain::Plain;

/// What decides how much may be under way on a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Congestion {
    /// Keeps the queue short: what is urgent arrives in time on a thin link that something else fills.
    #[default]
    Delay,
    /// CUBIC (RFC 9438): fills the queue until something is lost.
    Cubic,
    /// BBR, as quinn has it.
    Bbr,
    /// NewReno (RFC 9002).
    NewReno,
}

impl Congestion {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Delay, Self::Cubic, Self::Bbr, Self::NewReno];

    /// What it is called in configurations.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Delay => "delay",
            Self::Cubic => "cubic",
            Self::Bbr => "bbr",
            Self::NewReno => "newreno",
        }
    }

    /// For one connection: its factory, and the gate that its controllers keep.
    pub(crate) fn for_connection(self) -> (Arc<dyn ControllerFactory + Send + Sync>, Arc<Gate>) {
        let gate = Arc::new(Gate::default());
        (Arc::new(Factory { kind: self, gate: Arc::clone(&gate) }), gate)
    }
}

impl fmt::Display for Congestion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A name that is not that of a [`Congestion`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is none of delay, cubic, bbr, newreno")]
pub struct UnknownCongestion(pub String);

impl FromStr for Congestion {
    type Err = UnknownCongestion;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|c| c.as_str() == s).ok_or_else(|| UnknownCongestion(s.to_owned()))
    }
}

/// Makes a controller for each path that one connection comes to use. They share its gate, of which only the present
/// one is told anything.
struct Factory {
    kind: Congestion,
    gate: Arc<Gate>,
}

impl ControllerFactory for Factory {
    fn build(self: Arc<Self>, now: Instant, mtu: u16) -> Box<dyn Controller> {
        let gate = Arc::clone(&self.gate);
        match self.kind {
            Congestion::Delay => Box::new(Delay::new(gate, now, mtu)),
            Congestion::Cubic => Box::new(Plain::new(gate, Arc::new(CubicConfig::default()).build(now, mtu))),
            Congestion::Bbr => Box::new(Plain::new(gate, Arc::new(BbrConfig::default()).build(now, mtu))),
            Congestion::NewReno => {
                Box::new(Plain::new(gate, Arc::new(NewRenoConfig::default()).build(now, mtu)))
            }
        }
    }
}

/// What has been sent and neither acknowledged nor lost, kept from what a controller is told.
#[derive(Clone, Copy, Debug, Default)]
struct InFlight(u64);

/// Less than this in one go is taken for an acknowledgement, which nobody acknowledges.
const ACK_ONLY_BYTES: u64 = 200;

impl InFlight {
    fn sent(&mut self, bytes: u64) {
        if bytes >= ACK_ONLY_BYTES {
            self.0 += bytes;
        }
    }

    fn lost(&mut self, bytes: u64) {
        self.0 = self.0.saturating_sub(bytes);
    }
}

fn into_any(controller: Box<impl Controller + 'static>) -> Box<dyn Any> {
    controller
}
