//! Admission of writers into a connection: packets should wait where newer data can still replace them and urgent
//! packets overtake them, not inside the connection.
//!
//! The congestion controller of a connection reports the bytes in flight and their limit; writers ask for a permit
//! piece by piece. The gate knows no clock and no socket.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, MutexGuard};

use sgc_sync::lock;
use sgc_wire::Class;
use tokio::sync::oneshot;

/// Smallest permit, a packet. A larger one would stand in the way of urgent flows on a thin link.
const PIECE_BYTES_MIN: u64 = 1200;
/// Largest permit.
const PIECE_BYTES_MAX: u64 = 64 << 10;
/// Estimated part of headers in sent bytes: an estimate that is too high only shuts the gate early.
const OVERHEAD_PART: u64 = 16;
const CLASSES: usize = Class::Realtime as usize + 1;

/// A controller's limits.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Limits {
    /// Most bytes in flight, for all but urgent data.
    pub target: u64,
    /// Most bytes in flight, for urgent data.
    pub cap: u64,
    /// Bytes of a permit, within bounds: fast links take much, so that their packets leave in batches.
    pub piece: u64,
}

/// The gate of one connection.
#[derive(Debug, Default)]
pub(crate) struct Gate(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    /// Bytes sent and neither acknowledged nor lost, at the controller's last event.
    in_flight: u64,
    /// Bytes admitted and not sent, an estimate.
    unsent: u64,
    limits: Limits,
    waiting: [VecDeque<Waiter>; CLASSES],
}

#[derive(Debug)]
struct Waiter {
    want: u64,
    leave: oneshot::Sender<Permit>,
}

/// Permission to write this many bytes. Dropping it returns the bytes.
#[derive(Debug)]
pub(crate) struct Permit {
    gate: Arc<Gate>,
    bytes: u64,
}

impl Gate {
    /// Permits up to `want` bytes, if there is room now and nobody waits who comes first.
    pub(crate) fn try_admit(self: &Arc<Self>, class: Class, want: usize) -> Option<Permit> {
        let bytes = self.lock().take(class, want as u64)?;
        Some(Permit { gate: Arc::clone(self), bytes })
    }

    /// Waits for a permit of up to `want` bytes: higher classes go first, equal ones in turn.
    pub(crate) async fn admit(self: &Arc<Self>, class: Class, want: usize) -> Permit {
        let want = want as u64;
        loop {
            let granted = {
                let mut state = self.lock();
                if let Some(bytes) = state.take(class, want) {
                    return Permit { gate: Arc::clone(self), bytes };
                }
                let (leave, granted) = oneshot::channel();
                state.waiting[class as usize].push_back(Waiter { want, leave });
                granted
            };
            // The sender goes only with the gate itself, which is held here.
            if let Ok(permit) = granted.await {
                return permit;
            }
        }
    }

    /// Notes bytes that were written without a permit, because they could not be withheld.
    pub(crate) fn note_written(&self, bytes: usize) {
        self.lock().unsent += bytes as u64;
    }

    /// Forgets bytes that were written, not sent and given up.
    pub(crate) fn forget_unsent(self: &Arc<Self>) {
        self.update(|state| state.unsent = 0);
    }

    /// Starts with the limits of a new controller.
    pub(super) fn open(self: &Arc<Self>, limits: Limits) {
        self.update(|state| {
            (state.in_flight, state.unsent, state.limits) = (0, 0, limits);
        });
    }

    /// Notes packets that left.
    pub(super) fn on_sent(&self, bytes: u64, in_flight: u64) {
        let mut state = self.lock();
        state.in_flight = in_flight;
        state.unsent = state.unsent.saturating_sub(bytes - bytes / OVERHEAD_PART);
    }

    /// Takes news of the controller. `all_sent`: the connection had nothing left to send.
    pub(super) fn set(self: &Arc<Self>, in_flight: u64, limits: Limits, all_sent: bool) {
        self.update(|state| {
            (state.in_flight, state.limits) = (in_flight, limits);
            if all_sent {
                state.unsent = 0;
            }
        });
    }

    fn update(self: &Arc<Self>, change: impl FnOnce(&mut State)) {
        let mut state = self.lock();
        change(&mut state);
        state.serve(self);
    }

    fn give_back(self: &Arc<Self>, bytes: u64) {
        self.update(|state| state.unsent = state.unsent.saturating_sub(bytes));
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.0)
    }
}

impl State {
    /// Takes a piece, if there is room and nobody waits who comes first.
    fn take(&mut self, class: Class, want: u64) -> Option<u64> {
        let first = self.waiting[class as usize..].iter().all(VecDeque::is_empty);
        first.then(|| self.grant(class as usize, want)).flatten()
    }

    fn grant(&mut self, class: usize, want: u64) -> Option<u64> {
        let limit = if class == Class::Realtime as usize { self.limits.cap } else { self.limits.target };
        if self.in_flight + self.unsent >= limit {
            return None;
        }
        let piece = self.limits.piece.clamp(PIECE_BYTES_MIN, PIECE_BYTES_MAX);
        let bytes = want.min(piece);
        self.unsent += bytes;
        Some(bytes)
    }

    fn serve(&mut self, gate: &Arc<Gate>) {
        for class in (0..CLASSES).rev() {
            while let Some(want) = self.waiting[class].front().map(|w| w.want) {
                let Some(bytes) = self.grant(class, want) else { break };
                let Some(waiter) = self.waiting[class].pop_front() else { break };
                let permit = Permit { gate: Arc::clone(gate), bytes };
                if let Err(unwanted) = waiter.leave.send(permit) {
                    // Dropping the permit would take the lock that is held here.
                    self.unsent -= unwanted.spend(0);
                }
            }
        }
    }
}

impl Permit {
    /// Returns the bytes that may be written.
    pub(crate) fn bytes(&self) -> usize {
        usize::try_from(self.bytes).unwrap_or(usize::MAX)
    }

    /// Notes that this many bytes were written; the rest is returned.
    pub(crate) fn written(mut self, bytes: usize) {
        self.bytes = self.bytes.saturating_sub(bytes as u64);
    }

    /// Ends the permit after `bytes` and returns the rest.
    fn spend(mut self, bytes: u64) -> u64 {
        let left = self.bytes.saturating_sub(bytes);
        self.bytes = 0;
        left
    }
}

impl Drop for Permit {
    fn drop(&mut self) {
        if self.bytes > 0 {
            self.gate.give_back(self.bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::Future;
    use std::pin::pin;
    use std::task::{Context, Poll, Waker};

    use super::*;

    fn limits(target: u64, cap: u64) -> Limits {
        Limits { target, cap, piece: 3072 }
    }

    fn poll<T>(future: std::pin::Pin<&mut impl Future<Output = T>>) -> Poll<T> {
        future.poll(&mut Context::from_waker(Waker::noop()))
    }

    #[test]
    fn urgent_frames_go_first_and_the_rest_take_turns() {
        let gate = Arc::new(Gate::default());
        gate.open(limits(10_000, 20_000));
        gate.set(20_000, limits(10_000, 20_000), false);
        let mut bulk = pin!(gate.admit(Class::Bulk, 5000));
        let mut late = pin!(gate.admit(Class::Bulk, 5000));
        let mut urgent = pin!(gate.admit(Class::Realtime, 100));
        assert!(poll(bulk.as_mut()).is_pending() && poll(late.as_mut()).is_pending());
        assert!(poll(urgent.as_mut()).is_pending());
        gate.set(15_000, limits(10_000, 20_000), false);
        assert!(poll(bulk.as_mut()).is_pending());
        let Poll::Ready(permit) = poll(urgent.as_mut()) else { panic!("there is room") };
        assert_eq!(permit.bytes(), 100);
        permit.written(100);
        gate.set(9_000, limits(10_000, 20_000), false);
        let Poll::Ready(permit) = poll(bulk.as_mut()) else { panic!("there is room") };
        assert_eq!(permit.bytes(), 3072);
        assert!(poll(late.as_mut()).is_pending());
        // The next waiter gets unused bytes.
        drop(permit);
        assert!(poll(late.as_mut()).is_ready());
    }

    #[test]
    fn a_writer_that_gave_up_takes_nothing() {
        let gate = Arc::new(Gate::default());
        gate.open(limits(10_000, 20_000));
        gate.set(10_000, limits(10_000, 20_000), false);
        {
            let mut gone = pin!(gate.admit(Class::Bulk, 5000));
            assert!(poll(gone.as_mut()).is_pending());
        }
        let mut next = pin!(gate.admit(Class::Bulk, 5000));
        assert!(poll(next.as_mut()).is_pending());
        gate.set(9_999, limits(10_000, 20_000), false);
        let Poll::Ready(permit) = poll(next.as_mut()) else { panic!("it is its turn") };
        permit.written(3072);
        assert_eq!(gate.lock().unsent, 3072);
        gate.on_sent(3300, 3300);
        assert_eq!(gate.lock().unsent, 0);
    }

    #[test]
    fn nobody_waits_where_nothing_is_under_way() {
        let gate = Arc::new(Gate::default());
        gate.open(limits(3000, 6000));
        let mut first = pin!(gate.admit(Class::Default, 5000));
        let Poll::Ready(permit) = poll(first.as_mut()) else { panic!("nothing is under way") };
        permit.written(3072);
        let mut second = pin!(gate.admit(Class::Default, 5000));
        assert!(poll(second.as_mut()).is_pending());
        gate.forget_unsent();
        assert!(poll(second.as_mut()).is_ready());
    }
}
