//! Two ends of the multiplexing machine (`mux.rs`) with a function call as their wire, for benchmarks. No socket and no
//! clock; it checks only the number of bytes that arrive.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_wire::Class;

use super::mux::{Limits, Mux, Read, RxId, TxId};

/// Limits of links by default, or less: none is reached.
const LIMITS: Limits = Limits {
    flow_window: 8 << 20,
    link_window: 32 << 20,
    flows_max: 1024,
    send_bytes: 4 << 20,
    datagram_send_bytes: 1 << 20,
    datagram_receive_bytes: 1 << 20,
    keep_alive: Duration::from_secs(1),
    idle_timeout: Duration::from_secs(10),
};
/// Bytes of one write to a socket.
const BUDGET_BYTES: u64 = 64 << 10;
/// Delay of the wire in one direction.
const DELAY: Duration = Duration::from_micros(50);
/// Passes over the wire after which a missing message never comes.
const PASSES_MAX: usize = 1000;

/// Two machines and one flow from the first to the second.
pub struct Conversation {
    ends: [Mux; 2],
    flow: TxId,
    read: Option<RxId>,
    now: Instant,
    wire: VecDeque<Bytes>,
}

impl Conversation {
    /// Returns both ends, greeted, and an open flow; `None` if it cannot be opened, which is a defect.
    pub fn new(now: Instant) -> Option<Self> {
        let mut ends = [Mux::new(LIMITS, now), Mux::new(LIMITS, now)];
        let mut wire = VecDeque::new();
        pass(&mut ends, now, &mut wire)?;
        let flow = ends[0].open(Class::Default)?;
        Some(Self { ends, flow, read: None, now, wire })
    }

    /// Carries these chunks over and returns the number of bytes that the far end read; `None` if the machines do not
    /// take each other's input, or the chunks.
    pub fn carry(&mut self, mut chunks: Vec<Bytes>) -> Option<u64> {
        let expected: u64 = chunks.iter().map(|chunk| chunk.len() as u64).sum();
        let mut received = 0;
        for _ in 0..PASSES_MAX {
            if !chunks.is_empty() {
                self.ends[0].write(self.flow, &mut chunks).ok()?;
            }
            self.now += DELAY;
            pass(&mut self.ends, self.now, &mut self.wire)?;
            if self.read.is_none() {
                self.read = self.ends[1].accept();
            }
            let Some(flow) = self.read else { continue };
            while let Read::Some = self.ends[1].read(flow, |piece| received += piece.len() as u64) {}
            if received >= expected {
                return Some(received);
            }
        }
        None
    }
}

/// Hands over the output of both ends at this time.
fn pass([near, far]: &mut [Mux; 2], now: Instant, wire: &mut VecDeque<Bytes>) -> Option<()> {
    hand_over(near, far, now, wire)?;
    hand_over(far, near, now, wire)
}

fn hand_over(from: &mut Mux, to: &mut Mux, now: Instant, wire: &mut VecDeque<Bytes>) -> Option<()> {
    from.poll_transmit(now, BUDGET_BYTES, wire);
    while let Some(piece) = wire.pop_front() {
        to.handle_input(now, &piece).ok()?;
    }
    while from.poll_event().or_else(|| to.poll_event()).is_some() {}
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_any_size_arrive_whole() {
        let mut conversation = Conversation::new(Instant::now()).unwrap();
        for bytes in [1, 100, 1000, 64 << 10, 1 << 20] {
            let chunks = vec![Bytes::from(vec![7; 80]), Bytes::from(vec![7; bytes])];
            assert_eq!(conversation.carry(chunks), Some(80 + bytes as u64));
        }
    }
}
