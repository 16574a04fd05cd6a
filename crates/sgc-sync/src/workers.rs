//! [`Workers`]: threads that queues share, so that an idle queue needs none.
//!
//! A piece of work keeps its thread for as long as it runs. A few pieces get a thread at once. Others wait for the
//! first thread that is done. They get further ones if all may be blocked: if none was done for [`STALL`], or if the
//! oldest piece has waited for [`WAIT_MAX`]; one further thread in each [`STALL`]. So work that blocks holds up
//! others for moments only, and a burst of short work in many queues does not take a thread for each. Threads that
//! have nothing to do wait for the next piece, the latest first, and end after a while.

use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use crate::lock;

/// Time after which a thread without work ends.
const LINGER: Duration = Duration::from_secs(5);
/// Threads without work that do not end, so that work that comes seldom need not wait until one has started.
const KEPT: usize = 1;
/// Work that may run, beside what has run for [`STALL`] and may be blocked, before other work waits for a thread that is
/// done.
const AT_ONCE: usize = 4;
/// Time without progress after which work that waits gets a further thread.
const STALL: Duration = Duration::from_millis(2);
/// Longest wait of work for a thread, whether there is progress or not.
const WAIT_MAX: Duration = Duration::from_millis(50);
/// Time between two attempts of the watch to start a thread when the system has no room for one.
const RETRY: Duration = Duration::from_millis(100);

/// Work for a thread of [`Workers`].
pub trait Work: Send + Sync {
    /// Does what is to be done. May block.
    fn run(self: Arc<Self>);
}

/// Threads that run [`Work`]. Clones share them. Once the last clone is dropped, threads end with the work at hand.
#[derive(Clone, Debug)]
pub struct Workers(Arc<Owner>);

impl Workers {
    /// Starts the first thread. All threads have this name, and call `prepare` first.
    ///
    /// # Errors
    /// The system has no room for a thread.
    pub fn start(name: &'static str, prepare: fn()) -> io::Result<Self> {
        Self::start_with(name, prepare, LINGER)
    }

    fn start_with(name: &'static str, prepare: fn(), linger: Duration) -> io::Result<Self> {
        let pool = Arc::new(Pool { name, prepare, linger, state: Mutex::default(), waits: Condvar::new() });
        lock(&pool.state).threads = 1;
        pool.spawn(None)?;
        Ok(Self(Arc::new(Owner(pool))))
    }

    /// Runs work on a thread that has none, on a new one, or on the first that is done. If the system has no room for a
    /// new thread, the work waits, and the log has a warning.
    pub fn run(&self, work: Arc<dyn Work>) {
        let pool = &self.0.0;
        let (now, mut state) = (Instant::now(), lock(&pool.state));
        state.waiting.push_back((now, work));
        if state.begun_lately(now) < AT_ONCE {
            pool.begin(state, now);
        } else {
            pool.watch_over(state);
        }
    }
}

/// Ends the threads when it is dropped.
#[derive(Debug)]
struct Owner(Arc<Pool>);

impl Drop for Owner {
    fn drop(&mut self) {
        let idle = {
            let mut state = lock(&self.0.state);
            state.is_closed = true;
            std::mem::take(&mut state.idle)
        };
        idle.iter().for_each(|seat| seat.give(Order::End));
        self.0.waits.notify_one();
    }
}

struct Pool {
    name: &'static str,
    prepare: fn(),
    /// Time after which a thread without work ends.
    linger: Duration,
    state: Mutex<State>,
    /// Tells the watch that work waits.
    waits: Condvar,
}

#[derive(Default)]
struct State {
    /// Threads without work, the latest last.
    idle: Vec<Arc<Seat>>,
    /// When the work began that runs now.
    running: Vec<Instant>,
    /// All threads but the watch.
    threads: usize,
    /// Work that waits for a thread, with the time at which it came.
    waiting: VecDeque<(Instant, Arc<dyn Work>)>,
    /// The last time at which waiting work got a thread.
    progress: Option<Instant>,
    /// The last time at which waiting work got a further thread.
    growth: Option<Instant>,
    /// Whether a thread watches over work that waits.
    is_watched: bool,
    is_closed: bool,
}

/// The place at which a thread waits for its next order.
#[derive(Default)]
struct Seat {
    order: Mutex<Option<Order>>,
    given: Condvar,
}

enum Order {
    Run(Begun),
    End,
}

/// Work that a thread has, and since when.
struct Begun {
    at: Instant,
    work: Arc<dyn Work>,
}

impl Seat {
    fn give(&self, order: Order) {
        *lock(&self.order) = Some(order);
        self.given.notify_one();
    }

    /// Waits for an order, and returns `None` if none comes.
    fn wait(&self, at_most: Duration) -> Option<Order> {
        let waited = self.given.wait_timeout_while(lock(&self.order), at_most, |order| order.is_none());
        waited.unwrap_or_else(PoisonError::into_inner).0.take()
    }
}

impl State {
    /// Takes the work that has waited longest, for a thread that begins it now. Returns the time at which it came, too.
    fn take(&mut self, now: Instant) -> Option<(Instant, Begun)> {
        let (came, work) = self.waiting.pop_front()?;
        self.progress = Some(now);
        self.running.push(now);
        Some((came, Begun { at: now, work }))
    }

    /// Returns how much of the work that runs began so lately that it is hardly blocked.
    fn begun_lately(&self, now: Instant) -> usize {
        self.running.iter().filter(|at| now.saturating_duration_since(**at) < STALL).count()
    }

    /// Notes that the work that began at this time is done.
    fn ended(&mut self, at: Instant) {
        if let Some(place) = self.running.iter().position(|begun| *begun == at) {
            self.running.swap_remove(place);
        }
    }

    /// Returns when the work that has waited longest is to get a further thread.
    fn grows_at(&self) -> Option<Instant> {
        let (came, _) = self.waiting.front()?;
        let stalled = self.progress.map_or(*came, |progress| progress.max(*came)) + STALL;
        let spaced = self.growth.map_or(*came, |growth| growth + STALL);
        Some(stalled.min(*came + WAIT_MAX).max(spaced))
    }
}

impl Pool {
    /// Gives the work that has waited longest to a thread without any, or to a new one. Returns `false` if there is no room
    /// for one.
    fn begin(self: &Arc<Self>, mut state: MutexGuard<'_, State>, at: Instant) -> bool {
        let Some((came, begun)) = state.take(at) else { return true };
        if let Some(seat) = state.idle.pop() {
            drop(state);
            seat.give(Order::Run(begun));
            return true;
        }
        state.threads += 1;
        drop(state);
        let work = Arc::clone(&begun.work);
        let Err(error) = self.spawn(Some(begun)) else { return true };
        self.warn(&error);
        let mut state = lock(&self.state);
        state.threads -= 1;
        state.ended(at);
        state.waiting.push_front((came, work));
        self.watch_over(state);
        false
    }

    /// Has a thread watch over work that waits.
    fn watch_over(self: &Arc<Self>, mut state: MutexGuard<'_, State>) {
        if state.is_watched {
            if state.waiting.len() == 1 {
                self.waits.notify_one();
            }
            return;
        }
        let this = Arc::clone(self);
        let watch = thread::Builder::new().name(self.name.into()).spawn(move || this.watch());
        state.is_watched = watch.inspect_err(|error| self.warn(error)).is_ok();
        if !state.is_watched && !state.idle.is_empty() {
            self.begin(state, Instant::now());
        }
    }

    fn warn(&self, error: &io::Error) {
        tracing::warn!(%error, name = self.name, "no thread can start, so work waits for the thread of other work");
    }

    fn spawn(self: &Arc<Self>, first: Option<Begun>) -> io::Result<()> {
        let this = Arc::clone(self);
        thread::Builder::new().name(self.name.into()).spawn(move || this.serve(first)).map(drop)
    }

    /// Runs work until there is none for a while. This is what a thread does.
    fn serve(&self, first: Option<Begun>) {
        (self.prepare)();
        let seat = Arc::new(Seat::default());
        let mut next = first.or_else(|| self.next(&seat, None));
        while let Some(Begun { at, work }) = next {
            work.run();
            next = self.next(&seat, Some(at));
        }
    }

    /// Takes work that waits, or waits for work; what the thread did before began at `ended`. Returns `None` if the thread
    /// is to end.
    fn next(&self, seat: &Arc<Seat>, ended: Option<Instant>) -> Option<Begun> {
        {
            let mut state = lock(&self.state);
            if let Some(at) = ended {
                state.ended(at);
            }
            let next = state.take(Instant::now());
            if next.is_some() || state.is_closed {
                return next.map(|(_, begun)| begun);
            }
            state.idle.push(Arc::clone(seat));
        }
        loop {
            match seat.wait(self.linger) {
                Some(Order::Run(begun)) => return Some(begun),
                Some(Order::End) => return None,
                None if self.leave(seat) => return None,
                None => {}
            }
        }
    }

    /// Takes a thread off the idle ones. Returns `false` if it has to stay, or if an order is on its way to it.
    fn leave(&self, seat: &Arc<Seat>) -> bool {
        let mut state = lock(&self.state);
        let place = state.idle.iter().position(|idle| Arc::ptr_eq(idle, seat));
        let Some(place) = place.filter(|_| state.idle.len() > KEPT) else { return false };
        state.idle.remove(place);
        state.threads -= 1;
        true
    }

    /// Finds threads for work that waits too long, until none has waited for a while.
    fn watch(self: &Arc<Self>) {
        let mut state = lock(&self.state);
        loop {
            let now = Instant::now();
            let at_most = match state.grows_at() {
                None if state.is_closed => break,
                None => self.linger,
                Some(at) if at > now => at - now,
                Some(_) => {
                    state.growth = Some(now);
                    if !self.begin(state, now) {
                        thread::sleep(RETRY);
                    }
                    state = lock(&self.state);
                    continue;
                }
            };
            let waited = self.waits.wait_timeout(state, at_most).unwrap_or_else(PoisonError::into_inner);
            state = waited.0;
            if waited.1.timed_out() && state.waiting.is_empty() && at_most == self.linger {
                break;
            }
        }
        state.is_watched = false;
    }
}

impl std::fmt::Debug for Pool {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Pool").field("name", &self.name).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;
    use std::sync::mpsc::{Receiver, Sender, channel};
    use std::thread::ThreadId;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    /// Work that tells its thread, and then waits until it may end.
    struct Told {
        began: Sender<ThreadId>,
        may_end: Mutex<Receiver<()>>,
    }

    impl Work for Told {
        fn run(self: Arc<Self>) {
            let _ = self.began.send(thread::current().id());
            let _ = lock(&self.may_end).recv();
        }
    }

    /// Gives work to a thread. Returns the thread, and what ends the work when it is dropped.
    fn begin(workers: &Workers) -> (ThreadId, Sender<()>) {
        let ((began, begun), (ends, may_end)) = (channel(), channel());
        workers.run(Arc::new(Told { began, may_end: may_end.into() }));
        (begun.recv_timeout(PATIENCE).expect("the work begins"), ends)
    }

    fn workers() -> Workers {
        Workers::start("test", || ()).unwrap()
    }

    /// Waits until so many threads have no work.
    fn await_idle(workers: &Workers, threads: usize) {
        let began = Instant::now();
        while lock(&workers.0.0.state).idle.len() != threads {
            assert!(began.elapsed() < PATIENCE, "{threads} threads without work");
            thread::sleep(Duration::from_millis(1));
        }
    }

    #[test]
    fn work_that_blocks_holds_up_no_other() {
        let workers = workers();
        let blocked: Vec<_> = (0..50).map(|_| begin(&workers)).collect();
        let threads: HashSet<_> = blocked.iter().map(|(thread, _)| *thread).collect();
        assert_eq!(threads.len(), 50);
        drop(blocked);
        await_idle(&workers, 50);
    }

    #[test]
    fn work_one_after_the_other_shares_a_thread() {
        let workers = workers();
        await_idle(&workers, 1);
        let mut threads = Vec::new();
        for _ in 0..20 {
            let (thread, ends) = begin(&workers);
            drop(ends);
            await_idle(&workers, 1);
            threads.push(thread);
        }
        threads.dedup();
        assert_eq!(threads.len(), 1);
    }

    #[test]
    fn threads_without_work_end_except_for_one() {
        let linger = Duration::from_millis(200);
        let workers = Workers::start_with("test", || (), linger).unwrap();
        await_idle(&workers, 1);
        drop((0..5).map(|_| begin(&workers)).collect::<Vec<_>>());
        await_idle(&workers, 5);
        await_idle(&workers, KEPT);
        thread::sleep(2 * linger);
        assert_eq!(lock(&workers.0.0.state).idle.len(), KEPT);
        drop(begin(&workers));
    }

    /// Work that takes a moment, and tells its thread.
    struct Short(Sender<ThreadId>);

    impl Work for Short {
        fn run(self: Arc<Self>) {
            thread::sleep(Duration::from_micros(200));
            let _ = self.0.send(thread::current().id());
        }
    }

    /// Runs short work a hundred times at once. Returns the threads that did it.
    fn burst(workers: &Workers) -> HashSet<ThreadId> {
        let (done, is_done) = channel();
        (0..100).for_each(|_| workers.run(Arc::new(Short(done.clone()))));
        (0..100).map(|_| is_done.recv_timeout(PATIENCE).unwrap()).collect()
    }

    #[test]
    fn burst_of_short_work_starts_few_threads() {
        let threads = burst(&workers()).len();
        // More are there only if the machine stood still.
        assert!(threads < 50, "{threads} threads");
    }

    #[test]
    fn threads_for_work_that_blocked_end_although_bursts_go_on() {
        let workers = Workers::start_with("test", || (), Duration::from_millis(200)).unwrap();
        drop((0..50).map(|_| begin(&workers)).collect::<Vec<_>>());
        await_idle(&workers, 50);
        let began = Instant::now();
        while lock(&workers.0.0.state).threads > 2 * AT_ONCE {
            assert!(began.elapsed() < PATIENCE, "threads end");
            burst(&workers);
        }
    }

    #[test]
    fn work_without_a_thread_waits_for_one() {
        let workers = workers();
        await_idle(&workers, 1);
        let (_, ends) = begin(&workers);
        let ((began, begun), (_ends, may_end)) = (channel(), channel());
        // As if the system had no thread for it, and none that watches.
        let mut state = lock(&workers.0.0.state);
        state.waiting.push_back((Instant::now(), Arc::new(Told { began, may_end: may_end.into() })));
        drop(state);
        assert!(begun.recv_timeout(Duration::from_millis(20)).is_err(), "no thread is at rest");
        drop(ends);
        begun.recv_timeout(PATIENCE).expect("the thread takes it behind its own");
    }

    #[test]
    fn threads_end_with_the_last_handle_and_finish_work_at_hand() {
        let workers = workers();
        let (_, ends) = begin(&workers);
        let pool = Arc::downgrade(&workers.0.0);
        drop(workers.clone());
        drop(begin(&workers));
        drop(workers);
        assert!(pool.upgrade().is_some(), "work goes on");
        drop(ends);
        let began = Instant::now();
        while pool.strong_count() > 0 {
            assert!(began.elapsed() < PATIENCE, "the threads end");
            thread::sleep(Duration::from_millis(1));
        }
    }
}
