//! The turns of labs: most run beside each other, and those that measure run alone.

use std::sync::{Condvar, Mutex};
use std::thread::available_parallelism;

use sgc_sync::lock;

/// The turns that are taken now.
static TAKEN: Mutex<Taken> = Mutex::new(Taken { shared: 0, exclusive: 0 });
static ENDED: Condvar = Condvar::new();

struct Taken {
    shared: usize,
    exclusive: usize,
}

/// Whether other labs may run at the same time.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(crate) enum TurnKind {
    /// Twice as many labs as there are processors, since two thirds of a lab's time is waiting. A test may wait for events,
    /// and must not measure time or loss.
    Shared,
    /// No other lab.
    Exclusive,
}

/// The right to run a lab, until dropped.
#[derive(Debug)]
pub(crate) struct Turn(TurnKind);

impl Turn {
    /// Waits for a turn. One that waits for an exclusive turn lets shared ones pass, so that these overlap for longer.
    pub(crate) fn take(kind: TurnKind) -> Self {
        let shared_max = 2 * available_parallelism().map_or(1, usize::from);
        let must_wait = |taken: &mut Taken| match kind {
            TurnKind::Shared => taken.exclusive > 0 || taken.shared >= shared_max,
            TurnKind::Exclusive => taken.exclusive > 0 || taken.shared > 0,
        };
        let mut taken = ENDED.wait_while(lock(&TAKEN), must_wait).unwrap();
        match kind {
            TurnKind::Shared => taken.shared += 1,
            TurnKind::Exclusive => taken.exclusive += 1,
        }
        Self(kind)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut taken = lock(&TAKEN);
        match self.0 {
            TurnKind::Shared => taken.shared -= 1,
            TurnKind::Exclusive => taken.exclusive -= 1,
        }
        ENDED.notify_all();
    }
}
