//! The congestion controllers, and the gate that each keeps for its connection.
//!
//! Nothing here reads a clock, opens a socket or draws random numbers: QUIC reports events with their times.

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

/// The congestion controller of a link.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Congestion {
    /// Keeps the queue short: urgent packets arrive in time on a thin link that other traffic fills.
    #[default]
    Delay,
    /// CUBIC (RFC 9438): fills the queue until packets are lost.
    Cubic,
    /// BBR in quinn's version.
    Bbr,
    /// NewReno (RFC 9002).
    NewReno,
}

impl Congestion {
    /// All controllers.
    pub const ALL: [Self; 4] = [Self::Delay, Self::Cubic, Self::Bbr, Self::NewReno];

    /// Returns the name in configurations.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Delay => "delay",
            Self::Cubic => "cubic",
            Self::Bbr => "bbr",
            Self::NewReno => "newreno",
        }
    }

    /// Returns a factory for one connection, and the gate that its controllers keep.
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

/// A name of no [`Congestion`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is none of delay, cubic, bbr, newreno")]
pub struct UnknownCongestion(pub String);

impl FromStr for Congestion {
    type Err = UnknownCongestion;

    fn from_str(s: &str) -> Result<Self, Self::Err> {
        Self::ALL.into_iter().find(|c| c.as_str() == s).ok_or_else(|| UnknownCongestion(s.to_owned()))
    }
}

/// Makes a controller for each path that one connection uses. They share its gate, and only the present one updates it.
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

/// Bytes sent and neither acknowledged nor lost, from a controller's events.
#[derive(Clone, Copy, Debug, Default)]
struct InFlight(u64);

/// A shorter packet counts as an acknowledgement, which nobody acknowledges.
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
