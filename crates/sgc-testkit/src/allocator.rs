//! An allocator that counts allocations and passes every call on to the system's, for tests of allocations. It has no
//! limits.
//!
//! A test binary installs it with `#[global_allocator]`. Without that, all counts are 0.
#![allow(unsafe_code, reason = "an allocator is unsafe by its nature; this one counts and hands on")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::pin::pin;
use std::sync::atomic::{AtomicI64, Ordering::Relaxed};
use std::task::Poll;

/// The allocator.
pub struct CountingAllocator;

/// A count of allocations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Allocations {
    /// Number of allocations. Growing one counts as another.
    pub count: usize,
    /// Bytes of all allocations, including freed ones.
    pub bytes: usize,
}

impl Allocations {
    fn since(self, before: Self) -> Self {
        Self { count: self.count - before.count, bytes: self.bytes - before.bytes }
    }

    fn and(self, more: Self) -> Self {
        Self { count: self.count + more.count, bytes: self.bytes + more.bytes }
    }
}

thread_local! {
    static HERE: Cell<Allocations> = const { Cell::new(Allocations { count: 0, bytes: 0 }) };
    static REPORTED: Cell<Option<Allocations>> = const { Cell::new(None) };
}

static LIVE: AtomicI64 = AtomicI64::new(0);

/// Returns the allocations of the calling thread so far.
pub fn allocated_here() -> Allocations {
    HERE.get()
}

/// Returns the allocations of the calling thread since it last called this; none at its first call.
pub fn allocated_since_last() -> Allocations {
    let now = allocated_here();
    now.since(REPORTED.replace(Some(now)).unwrap_or(now))
}

/// Returns the bytes that the process has allocated and not freed.
pub fn live_bytes() -> i64 {
    LIVE.load(Relaxed)
}

/// Counts the allocations of the calling thread while it does `work`.
pub fn allocations<T>(work: impl FnOnce() -> T) -> (Allocations, T) {
    let before = allocated_here();
    let result = work();
    (allocated_here().since(before), result)
}

/// Counts the allocations of this future, without those of other tasks of the thread while it waits.
pub async fn allocations_of<T>(work: impl Future<Output = T>) -> (Allocations, T) {
    let mut work = pin!(work);
    let mut taken = Allocations::default();
    std::future::poll_fn(|cx| {
        let (more, polled) = allocations(|| work.as_mut().poll(cx));
        taken = taken.and(more);
        match polled {
            Poll::Ready(result) => Poll::Ready((taken, result)),
            Poll::Pending => Poll::Pending,
        }
    })
    .await
}

fn take(bytes: usize) {
    LIVE.fetch_add(bytes as i64, Relaxed);
    // Allocations after the thread's end are not counted.
    let _ = HERE.try_with(|here| here.set(here.get().and(Allocations { count: 1, bytes })));
}

fn give_back(bytes: usize) {
    LIVE.fetch_sub(bytes as i64, Relaxed);
}

// SAFETY: every call is handed on to the system's allocator as it is.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        take(layout.size());
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        take(layout.size());
        // SAFETY: the caller's promise.
        unsafe { System.alloc_zeroed(layout) }
    }

    // A growing allocation may move, so its whole size counts again.
    unsafe fn realloc(&self, ptr: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        take(new_size);
        give_back(layout.size());
        // SAFETY: the caller's promise.
        unsafe { System.realloc(ptr, layout, new_size) }
    }

    unsafe fn dealloc(&self, ptr: *mut u8, layout: Layout) {
        give_back(layout.size());
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(ptr, layout) }
    }
}
