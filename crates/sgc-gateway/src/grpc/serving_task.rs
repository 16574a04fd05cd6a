//! [`ServingTask`]: the task that serves a connection, woken when the rights of a client on it end.

use std::sync::Arc;
use std::task::Context;

use futures_util::task::AtomicWaker;

/// The task that serves a connection. Clones share it.
#[derive(Clone, Debug, Default)]
pub(super) struct ServingTask(Arc<AtomicWaker>);

impl ServingTask {
    /// Makes the task of `cx` the one that is woken.
    pub(super) fn register(&self, cx: &Context<'_>) {
        self.0.register(cx.waker());
    }

    /// Wakes the task.
    pub(super) fn wake(&self) {
        self.0.wake();
    }
}
