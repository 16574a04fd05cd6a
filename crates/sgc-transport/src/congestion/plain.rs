//! Quinn's own controllers, with a gate.

use std::any::Any;
use std::sync::Arc;
use std::time::Instant;

use quinn::congestion::{Controller, ControllerMetrics};
use quinn_proto::RttEstimator;

use super::gate::Limits;
use super::{Gate, InFlight, into_any};

/// Part of the window that may wait inside the connection, and the least. These controllers grow only while data waits.
const SLACK_BYTES_MIN: u64 = 16 << 10;
const SLACK_PART: u64 = 4;
/// Part of the window in one permit.
const PIECES_PER_WINDOW: u64 = 8;

/// A controller of quinn, and the gate of its connection.
pub(super) struct Plain {
    gate: Arc<Gate>,
    inner: Box<dyn Controller>,
    in_flight: InFlight,
}

impl Plain {
    pub(super) fn new(gate: Arc<Gate>, inner: Box<dyn Controller>) -> Self {
        let plain = Self { gate, inner, in_flight: InFlight::default() };
        plain.gate.open(plain.limits());
        plain
    }

    fn limits(&self) -> Limits {
        let window = self.inner.window();
        let slack = (window / SLACK_PART).max(SLACK_BYTES_MIN);
        let (target, cap) = (window.saturating_add(slack), window.saturating_add(2 * slack));
        Limits { target, cap, piece: window / PIECES_PER_WINDOW }
    }

    fn tell(&self, all_sent: bool) {
        self.gate.set(self.in_flight.0, self.limits(), all_sent);
    }
}

impl Controller for Plain {
    fn on_sent(&mut self, now: Instant, bytes: u64, last_packet_number: u64) {
        self.in_flight.sent(bytes);
        self.gate.on_sent(bytes, self.in_flight.0);
        self.inner.on_sent(now, bytes, last_packet_number);
    }

    fn on_ack(&mut self, now: Instant, sent: Instant, bytes: u64, app_limited: bool, rtt: &RttEstimator) {
        self.inner.on_ack(now, sent, bytes, app_limited, rtt);
    }

    fn on_end_acks(&mut self, now: Instant, in_flight: u64, app_limited: bool, largest: Option<u64>) {
        self.in_flight = InFlight(in_flight);
        self.inner.on_end_acks(now, in_flight, app_limited, largest);
        self.tell(app_limited);
    }

    fn on_congestion_event(&mut self, now: Instant, sent: Instant, is_persistent: bool, lost_bytes: u64) {
        self.in_flight.lost(lost_bytes);
        self.inner.on_congestion_event(now, sent, is_persistent, lost_bytes);
        // Lost bytes are sent again.
        self.gate.note_written(usize::try_from(lost_bytes).unwrap_or(usize::MAX));
        self.tell(false);
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.inner.on_mtu_update(new_mtu);
    }

    fn window(&self) -> u64 {
        self.inner.window()
    }

    fn metrics(&self) -> ControllerMetrics {
        self.inner.metrics()
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        Box::new(Self::new(Arc::clone(&self.gate), self.inner.clone_box()))
    }

    fn initial_window(&self) -> u64 {
        self.inner.initial_window()
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        into_any(self)
    }
}
