//! Tasks that the waking thread may run.
//!
//! A thread outside of the runtime that hands a packet to a task has to wake a thread of the runtime. On an idle
//! machine that takes longer than all the work. Within a [`WakeBatch`] the thread itself runs the tasks that it woke,
//! at the end. Any other waker has the runtime run the task as usual. A task never runs twice at once; a wake-up while
//! it runs makes it run again. This module decides nothing about the tasks' work and makes no threads.
#![forbid(unsafe_code)]

use std::cell::RefCell;
use std::collections::VecDeque;
use std::fmt;
use std::future::{Future, poll_fn};
use std::marker::PhantomData;
use std::pin::{Pin, pin};
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock};
use std::task::{Context, Poll, Wake, Waker};

use sgc_sync::lock;
use tokio::runtime::{EnterGuard, Handle};

/// Most runs of tasks in one batch; the runtime runs the rest. A task that wakes itself must not keep the thread for
/// ever.
const RUNS_MAX: usize = 16;

thread_local! {
    /// Tasks that this thread woke and will run; `None` outside of a batch.
    static AT_HAND: RefCell<Option<VecDeque<Arc<Task>>>> = const { RefCell::new(None) };
}

type Work = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The task waits for a wake-up.
const IDLE: u8 = 0;
/// The task was woken, and the waking side has arranged its run.
const DUE: u8 = 1;
/// A thread runs the task.
const RUNS: u8 = 2;
/// A thread runs the task, and it was woken meanwhile.
const RUNS_AGAIN: u8 = 3;
/// The task has ended.
const DONE: u8 = 4;

struct Task {
    state: AtomicU8,
    work: Mutex<Option<Work>>,
    /// Wakes the runtime's own task, which runs this one.
    runtime: OnceLock<Waker>,
}

/// Starts a task, in the runtime around it.
pub fn spawn(work: impl Future<Output = ()> + Send + 'static) {
    let work: Work = Box::pin(work);
    let task = Task { state: AtomicU8::new(DUE), work: Mutex::new(Some(work)), runtime: OnceLock::new() };
    tokio::spawn(Runner(Arc::new(task)));
}

impl Task {
    fn work(&self) -> MutexGuard<'_, Option<Work>> {
        lock(&self.work)
    }

    /// Returns `true` if the caller has to arrange the run.
    fn is_due_now(&self) -> bool {
        let woken = |state| match state {
            IDLE => Some(DUE),
            RUNS => Some(RUNS_AGAIN),
            _ => None,
        };
        self.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, woken) == Ok(IDLE)
    }

    /// Arranges the run: on this thread if it collects a batch, or else on the runtime.
    fn schedule(self: &Arc<Self>) {
        let collect = |at_hand: &RefCell<Option<VecDeque<_>>>| match &mut *at_hand.borrow_mut() {
            Some(tasks) => {
                tasks.push_back(Arc::clone(self));
                true
            }
            None => false,
        };
        // A thread that ends has no such list any more.
        if !AT_HAND.try_with(collect).unwrap_or(false) {
            self.hand_over();
        }
    }

    fn hand_over(&self) {
        // There is no waker before the runtime ran the task first, which it is about to do.
        if let Some(runtime) = self.runtime.get() {
            runtime.wake_by_ref();
        }
    }

    /// Runs the task if it is due; otherwise another thread ran it or runs it.
    fn run(self: &Arc<Self>) {
        if self.state.compare_exchange(DUE, RUNS, Ordering::AcqRel, Ordering::Acquire).is_err() {
            return;
        }
        let waker = Waker::from(Arc::clone(self));
        {
            let mut work = self.work();
            let is_over =
                work.as_mut().is_none_or(|w| w.as_mut().poll(&mut Context::from_waker(&waker)).is_ready());
            if is_over {
                *work = None;
                self.state.store(DONE, Ordering::Release);
                return self.hand_over();
            }
        }
        let rests = |state| match state {
            RUNS => Some(IDLE),
            RUNS_AGAIN => Some(DUE),
            _ => None,
        };
        if self.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, rests) == Ok(RUNS_AGAIN) {
            self.schedule();
        }
    }
}

impl Wake for Task {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if self.is_due_now() {
            self.schedule();
        }
    }
}

/// The runtime's own task, for one of ours.
struct Runner(Arc<Task>);

impl Future for Runner {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        // A task of the runtime has one waker for all its life.
        self.0.runtime.get_or_init(|| cx.waker().clone());
        self.0.run();
        match self.0.state.load(Ordering::Acquire) {
            DONE => Poll::Ready(()),
            _ => Poll::Pending,
        }
    }
}

impl Drop for Runner {
    fn drop(&mut self) {
        // The runtime ends: drop the work, because it may hold its own task.
        let work = self.0.work().take();
        self.0.state.store(DONE, Ordering::Release);
        drop(work);
    }
}

/// A batch of wake-ups: while it lives, tasks that this thread wakes wait, and its end runs them on this thread.
/// Threads of the runtime use [`poll_at_hand`].
pub struct WakeBatch<'a> {
    /// Whether this thread collects already: then the outer batch runs the tasks.
    is_inner: bool,
    /// `None` inside of the runtime.
    _runtime: Option<EnterGuard<'a>>,
    /// Bound to one thread.
    _thread: PhantomData<*const ()>,
}

impl<'a> WakeBatch<'a> {
    /// Begins a batch, in this runtime.
    pub fn begin(runtime: &'a Handle) -> Self {
        Self::collect(Some(runtime.enter()))
    }

    fn collect(runtime: Option<EnterGuard<'a>>) -> Self {
        let is_inner = AT_HAND.with_borrow_mut(|at_hand| {
            let is_inner = at_hand.is_some();
            at_hand.get_or_insert_default();
            is_inner
        });
        Self { is_inner, _runtime: runtime, _thread: PhantomData }
    }
}

impl fmt::Debug for WakeBatch<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WakeBatch").finish_non_exhaustive()
    }
}

impl Drop for WakeBatch<'_> {
    fn drop(&mut self) {
        if self.is_inner {
            return;
        }
        for _ in 0..RUNS_MAX {
            let next = AT_HAND.with_borrow_mut(|at_hand| at_hand.as_mut().and_then(VecDeque::pop_front));
            let Some(task) = next else { break };
            task.run();
        }
        hand_over(AT_HAND.take());
    }
}

/// Awaits a future in a task of the runtime, whose thread runs the tasks that it wakes at once instead of in their
/// turn.
pub async fn poll_at_hand<T>(future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    poll_fn(|cx| {
        let _at_hand = WakeBatch::collect(None);
        future.as_mut().poll(cx)
    })
    .await
}

/// Awaits a future on a thread outside of the runtime. Tasks of its batch go to the runtime before it blocks.
pub fn block_on<T>(runtime: &Handle, future: impl Future<Output = T>) -> T {
    let mut future = pin!(future);
    {
        let _runtime = runtime.enter();
        if let Poll::Ready(done) = future.as_mut().poll(&mut Context::from_waker(Waker::noop())) {
            return done;
        }
    }
    hand_over(AT_HAND.with_borrow_mut(|at_hand| at_hand.as_mut().map(std::mem::take)));
    runtime.block_on(future)
}

fn hand_over(tasks: Option<VecDeque<Arc<Task>>>) {
    for task in tasks.into_iter().flatten() {
        task.hand_over();
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::sync::Weak;
    use std::sync::atomic::AtomicUsize;
    use std::thread;
    use std::time::{Duration, Instant};

    use tokio::sync::{Notify, oneshot};
    use tokio::time::timeout;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap()
    }

    /// Spawns a task that notes its thread after each ring of its bell, and has been run once.
    fn listening(runtime: &tokio::runtime::Runtime) -> (Arc<Notify>, Arc<Mutex<Vec<thread::ThreadId>>>) {
        let (bell, heard) = (Arc::new(Notify::new()), Arc::new(Mutex::new(Vec::new())));
        let (ring, note) = (bell.clone(), heard.clone());
        runtime.block_on(async {
            spawn(async move {
                loop {
                    ring.notified().await;
                    note.lock().unwrap().push(thread::current().id());
                }
            });
            tokio::task::yield_now().await;
        });
        (bell, heard)
    }

    #[test]
    fn the_waking_thread_runs_the_task() {
        // Nobody drives the runtime meanwhile.
        let runtime = runtime();
        let (bell, heard) = listening(&runtime);
        {
            let _outer = WakeBatch::begin(runtime.handle());
            let inner = WakeBatch::begin(runtime.handle());
            bell.notify_one();
            drop(inner);
            assert!(heard.lock().unwrap().is_empty(), "not before the end");
        }
        assert_eq!(*heard.lock().unwrap(), [thread::current().id()]);
        bell.notify_one();
        assert_eq!(heard.lock().unwrap().len(), 1, "otherwise the runtime does");
        runtime.block_on(tokio::task::yield_now());
        assert_eq!(heard.lock().unwrap().len(), 2);
    }

    #[test]
    fn a_task_of_the_runtime_runs_at_once_what_it_wakes() {
        let runtime = runtime();
        let (bell, heard) = listening(&runtime);
        runtime.block_on(async {
            bell.notify_one();
            assert!(heard.lock().unwrap().is_empty(), "otherwise it is the runtime's turn");
            tokio::task::yield_now().await;
            poll_at_hand(async { bell.notify_one() }).await;
            assert_eq!(heard.lock().unwrap().len(), 2);
        });
    }

    #[test]
    fn ready_tasks_do_not_wait_for_a_blocked_thread() {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
        let (bell, (answer, answered)) = (Arc::new(Notify::new()), oneshot::channel());
        let (begun, has_begun) = std::sync::mpsc::channel();
        let ring = bell.clone();
        runtime.block_on(async move {
            spawn(async move {
                let _ = begun.send(());
                ring.notified().await;
                let _ = answer.send(());
            });
        });
        has_begun.recv_timeout(PATIENCE).unwrap();
        let _at_hand = WakeBatch::begin(runtime.handle());
        bell.notify_one();
        block_on(runtime.handle(), async { timeout(PATIENCE, answered).await }).unwrap().unwrap();
    }

    #[test]
    fn no_wake_is_lost_between_threads() {
        const RINGS: usize = 20_000;
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let (asked, seen) = (Arc::new(AtomicUsize::new(0)), Arc::new(AtomicUsize::new(0)));
        let waker = Arc::new(Mutex::new(None::<Waker>));
        let (count, note, slot) = (asked.clone(), seen.clone(), waker.clone());
        runtime.block_on(async move {
            spawn(poll_fn(move |cx| {
                *slot.lock().unwrap() = Some(cx.waker().clone());
                let asked = count.load(Ordering::SeqCst);
                note.store(asked, Ordering::SeqCst);
                if asked == 3 * RINGS { Poll::Ready(()) } else { Poll::Pending }
            }));
        });
        thread::scope(|scope| {
            for by_hand in [true, true, false] {
                let (asked, waker, runtime) = (&asked, &waker, &runtime);
                scope.spawn(move || {
                    for _ in 0..RINGS {
                        let _at_hand = by_hand.then(|| WakeBatch::begin(runtime.handle()));
                        asked.fetch_add(1, Ordering::SeqCst);
                        let waker = waker.lock().unwrap().clone();
                        waker.into_iter().for_each(Waker::wake);
                    }
                });
            }
        });
        let begun = Instant::now();
        while seen.load(Ordering::SeqCst) < 3 * RINGS {
            assert!(begun.elapsed() < PATIENCE, "{} of {} seen", seen.load(Ordering::SeqCst), 3 * RINGS);
            thread::yield_now();
        }
    }

    #[test]
    fn a_runtime_that_ends_takes_its_tasks_along() {
        struct WakerHolder(Mutex<Option<Waker>>);
        let runtime = runtime();
        let held = Arc::new(WakerHolder(Mutex::new(None)));
        let weak: Weak<WakerHolder> = Arc::downgrade(&held);
        runtime.block_on(async {
            // The task holds its own waker.
            spawn(poll_fn(move |cx| {
                *held.0.lock().unwrap() = Some(cx.waker().clone());
                Poll::Pending
            }));
            tokio::task::yield_now().await;
        });
        assert!(weak.upgrade().is_some_and(|held| held.0.lock().unwrap().is_some()));
        drop(runtime);
        assert!(weak.upgrade().is_none());
    }
}
