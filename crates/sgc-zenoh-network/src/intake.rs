//! [`Intake`]: the queue between Zenoh's receiving threads and the receiver of a reader, client or server.
//!
//! Zenoh calls back on threads that all endpoints of a process share. Work of a [`Receive`] that needs no waiting is done
//! right there. Other items are queued, within bounds, for a [worker](sgc_sync::Workers), which may block for any time: no
//! other endpoint waits for it, and the order of items stays. If the queue is full, the oldest items give way.

use std::cell::Cell;
use std::collections::VecDeque;
use std::ffi::c_void;
use std::sync::{Arc, Mutex, Weak};

use sgc_sync::{Pace, Work, Workers, lock};

/// Most queued bytes of one endpoint; a single item may be longer.
pub(crate) const WAITING_BYTES_MAX: usize = 64 << 20;

thread_local! {
    /// The intake whose items this thread hands over.
    static SERVED: Cell<*const c_void> = const { Cell::new(std::ptr::null()) };
}

/// An item of a queue.
pub(crate) trait Item: Send + 'static {
    /// Returns the length of the payload in bytes.
    fn bytes(&self) -> usize;
}

/// A receiver of items, one after the other.
pub(crate) trait Receive<T>: Send + 'static {
    /// Receives an item. May block. `more` is `true` if another one follows at once.
    fn receive(&mut self, item: T, more: bool);

    /// Receives an item if that needs no waiting. Returns it otherwise.
    fn receive_at_once(&mut self, item: T) -> Option<T> {
        Some(item)
    }

    /// Reports items that gave way to newer ones.
    fn overrun(&mut self, items: u64);
}

/// The queue of an endpoint.
struct Queue<T> {
    items: VecDeque<T>,
    bytes: usize,
    depth: usize,
    overrun: u64,
    /// A worker is at work or about to begin.
    is_at_work: bool,
    is_stopped: bool,
}

impl<T: Item> Queue<T> {
    fn push(&mut self, item: T) {
        while self.items.len() >= self.depth || self.bytes + item.bytes() > WAITING_BYTES_MAX {
            if self.pop().is_none() {
                break;
            }
            self.overrun += 1;
        }
        self.bytes += item.bytes();
        self.items.push_back(item);
    }

    fn pop(&mut self) -> Option<T> {
        let item = self.items.pop_front()?;
        self.bytes -= item.bytes();
        Some(item)
    }
}

/// The state that Zenoh's callback and the worker share.
pub(crate) struct Shared<T, R> {
    this: Weak<Self>,
    queue: Mutex<Queue<T>>,
    /// The receiver until the intake is dropped. Locked while an item is received, before the queue or by `try_lock`, so
    /// that the order of items stays.
    receiver: Mutex<Option<R>>,
    workers: Workers,
    pace: Arc<Pace>,
}

impl<T: Item, R: Receive<T>> Shared<T, R> {
    /// Hands an item to the receiver, or queues it. Called by Zenoh.
    pub(crate) fn arrive(&self, item: T) {
        let mut queue = lock(&self.queue);
        let mut item = Some(item);
        if queue.items.is_empty()
            && !queue.is_stopped
            && let Some(began) = self.pace.begin()
            && let Ok(mut receiver) = self.receiver.try_lock()
            && let Some(receiver) = receiver.as_mut()
        {
            drop(queue);
            item = item.and_then(|item| receiver.receive_at_once(item));
            self.pace.end(began);
            // Items of one sender arrive one after the other, so none of this one's came in between.
            queue = lock(&self.queue);
        }
        let Some(item) = item.filter(|_| !queue.is_stopped) else { return };
        queue.push(item);
        if !std::mem::replace(&mut queue.is_at_work, true) {
            drop(queue);
            self.work();
        }
    }

    fn work(&self) {
        if let Some(this) = self.this.upgrade() {
            self.workers.run(this);
        }
    }

    /// Hands queued items over until none is left.
    fn serve(&self) {
        let mut receiver = lock(&self.receiver);
        loop {
            let (item, more, overrun) = {
                let mut queue = lock(&self.queue);
                if queue.is_stopped {
                    queue.items.clear();
                    queue.bytes = 0;
                    *receiver = None;
                }
                let item = queue.pop();
                queue.is_at_work = item.is_some();
                (item, !queue.items.is_empty(), std::mem::take(&mut queue.overrun))
            };
            let Some(receiver) = receiver.as_mut() else { return };
            if overrun > 0 {
                receiver.overrun(overrun);
            }
            let Some(item) = item else { return };
            receiver.receive(item, more);
        }
    }
}

impl<T: Item, R: Receive<T>> Work for Shared<T, R> {
    fn run(self: Arc<Self>) {
        SERVED.set(Arc::as_ptr(&self).cast());
        self.serve();
        SERVED.set(std::ptr::null());
    }
}

/// A queue with its receiver. Dropping it waits for a receiver at work, unless that is what drops it.
pub(crate) struct Intake<T: Item, R: Receive<T>>(Arc<Shared<T, R>>);

impl<T: Item, R: Receive<T>> Intake<T, R> {
    /// Creates a queue for at most `depth` items.
    pub(crate) fn new(workers: &Workers, pace: &Arc<Pace>, depth: usize, receiver: R) -> Self {
        let (workers, pace) = (workers.clone(), Arc::clone(pace));
        let queue = Queue {
            items: VecDeque::new(),
            bytes: 0,
            depth: depth.max(1),
            overrun: 0,
            is_at_work: false,
            is_stopped: false,
        };
        Self(Arc::new_cyclic(|this| Shared {
            this: Weak::clone(this),
            queue: Mutex::new(queue),
            receiver: Mutex::new(Some(receiver)),
            workers,
            pace,
        }))
    }

    /// Returns the part for Zenoh's callback.
    pub(crate) fn shared(&self) -> Arc<Shared<T, R>> {
        Arc::clone(&self.0)
    }
}

impl<T: Item, R: Receive<T>> std::fmt::Debug for Intake<T, R> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Intake").finish_non_exhaustive()
    }
}

impl<T: Item, R: Receive<T>> Drop for Intake<T, R> {
    fn drop(&mut self) {
        let is_at_work = {
            let mut queue = lock(&self.0.queue);
            queue.is_stopped = true;
            queue.is_at_work
        };
        if std::ptr::eq(SERVED.get(), Arc::as_ptr(&self.0).cast()) && is_at_work {
            // The receiver itself drops its intake. The worker lets go of it.
            return;
        }
        let receiver = lock(&self.0.receiver).take();
        drop(receiver);
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, Sender, channel};
    use std::time::Duration;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    impl Item for usize {
        fn bytes(&self) -> usize {
            *self
        }
    }

    #[derive(Debug, PartialEq, Eq)]
    enum Seen {
        Item(usize, bool),
        AtOnce(usize),
        Overrun(u64),
    }

    /// Reports what it receives. An item of 1 waits until it may go on; odd items are not received at once.
    struct Reporter {
        seen: Sender<Seen>,
        may_go_on: Receiver<()>,
    }

    impl Receive<usize> for Reporter {
        fn receive(&mut self, item: usize, more: bool) {
            let _ = self.seen.send(Seen::Item(item, more));
            if item == 1 {
                let _ = self.may_go_on.recv();
            }
        }

        fn receive_at_once(&mut self, item: usize) -> Option<usize> {
            if item % 2 == 1 {
                return Some(item);
            }
            let _ = self.seen.send(Seen::AtOnce(item));
            None
        }

        fn overrun(&mut self, items: u64) {
            let _ = self.seen.send(Seen::Overrun(items));
        }
    }

    fn intake(depth: usize) -> (Intake<usize, Reporter>, Receiver<Seen>, Sender<()>) {
        let workers = Workers::start("test", || ()).unwrap();
        let ((seen, seen_here), (go_on, may_go_on)) = (channel(), channel());
        let intake = Intake::new(&workers, &Arc::new(Pace::new()), depth, Reporter { seen, may_go_on });
        (intake, seen_here, go_on)
    }

    #[test]
    fn order_stays_when_items_are_received_at_once_and_queued() {
        let (intake, seen, go_on) = intake(10);
        let shared = intake.shared();
        let next = || seen.recv_timeout(PATIENCE).unwrap();
        shared.arrive(2);
        assert_eq!(next(), Seen::AtOnce(2));
        shared.arrive(1);
        assert_eq!(next(), Seen::Item(1, false));
        // The receiver is at work, so the even ones are queued behind the odd one.
        [3, 4, 6].into_iter().for_each(|item| shared.arrive(item));
        go_on.send(()).unwrap();
        assert_eq!(
            [next(), next(), next()],
            [Seen::Item(3, true), Seen::Item(4, true), Seen::Item(6, false)]
        );
    }

    #[test]
    fn the_oldest_give_way_in_a_full_queue() {
        let (intake, seen, go_on) = intake(2);
        let shared = intake.shared();
        let next = || seen.recv_timeout(PATIENCE).unwrap();
        shared.arrive(1);
        assert_eq!(next(), Seen::Item(1, false));
        [3, 5, 7, 9].into_iter().for_each(|item| shared.arrive(item));
        go_on.send(()).unwrap();
        assert_eq!([next(), next(), next()], [Seen::Overrun(2), Seen::Item(7, true), Seen::Item(9, false)]);
        // One item that is longer than the bound is taken, and all others give way.
        shared.arrive(1);
        assert_eq!(next(), Seen::Item(1, false));
        [3, WAITING_BYTES_MAX + 1].into_iter().for_each(|item| shared.arrive(item));
        go_on.send(()).unwrap();
        assert_eq!([next(), next()], [Seen::Overrun(1), Seen::Item(WAITING_BYTES_MAX + 1, false)]);
    }

    #[test]
    fn a_dropped_intake_waits_for_its_receiver_and_drops_it() {
        let (intake, seen, go_on) = intake(10);
        let shared = intake.shared();
        shared.arrive(1);
        assert_eq!(seen.recv_timeout(PATIENCE).unwrap(), Seen::Item(1, false));
        shared.arrive(3);
        let dropping = std::thread::spawn(move || drop(intake));
        while !lock(&shared.queue).is_stopped {
            std::thread::yield_now();
        }
        go_on.send(()).unwrap();
        dropping.join().unwrap();
        shared.arrive(5);
        assert!(
            seen.recv_timeout(PATIENCE).is_err(),
            "nothing more is handed over, and the receiver is gone"
        );
    }

    /// Drops its own intake at the first item.
    struct SelfDropping {
        intake: Option<Receiver<Intake<usize, SelfDropping>>>,
        _alive: Sender<()>,
    }

    impl Receive<usize> for SelfDropping {
        fn receive(&mut self, _: usize, _: bool) {
            drop(self.intake.take().and_then(|intake| intake.recv().ok()));
        }

        fn overrun(&mut self, _: u64) {}
    }

    #[test]
    fn a_receiver_may_drop_its_own_intake() {
        let workers = Workers::start("test", || ()).unwrap();
        let ((give, given), (alive, gone)) = (channel(), channel());
        let intake = Intake::new(
            &workers,
            &Arc::new(Pace::new()),
            1,
            SelfDropping { intake: Some(given), _alive: alive },
        );
        let shared = intake.shared();
        give.send(intake).unwrap();
        shared.arrive(1);
        assert!(gone.recv_timeout(PATIENCE).is_err());
        drop(shared);
    }
}
