//! [`offload`]: slow work, such as reading files or converting images, that must not delay clients whose tasks share
//! the runtime's thread.

use tokio::runtime::{Handle, RuntimeFlavor};

/// Longest message that is converted in place. That takes a millisecond or two; moving other tasks away takes tens of
/// microseconds.
const SHORT_BYTES_MAX: usize = 256 << 10;

/// Runs work that may block or take long. Other tasks of this thread move to another thread, unless the runtime has
/// only one.
pub(crate) fn offload<T>(work: impl FnOnce() -> T) -> T {
    let has_others =
        Handle::try_current().is_ok_and(|runtime| runtime.runtime_flavor() == RuntimeFlavor::MultiThread);
    if has_others { tokio::task::block_in_place(work) } else { work() }
}

/// Runs work whose duration depends on a message of this length.
pub(crate) fn offload_if_long<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    if bytes > SHORT_BYTES_MAX { offload(work) } else { work() }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::time::Duration;

    use super::*;

    /// Blocks on another task of the same thread.
    async fn waits_for_another(work: impl FnOnce(mpsc::Receiver<()>) -> bool + Send + 'static) -> bool {
        let (send, receive) = mpsc::channel();
        let (begun, begins) = tokio::sync::oneshot::channel();
        let waiting = tokio::spawn(async move {
            let _ = begun.send(());
            work(receive)
        });
        begins.await.unwrap();
        tokio::spawn(async move { send.send(()) });
        waiting.await.unwrap()
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 1)]
    async fn others_go_on_beside_what_takes_long() {
        let comes = |receive: mpsc::Receiver<()>| receive.recv_timeout(Duration::from_secs(10)).is_ok();
        assert!(waits_for_another(move |receive| offload(|| comes(receive))).await);
        assert!(waits_for_another(move |receive| offload_if_long(1 << 20, || comes(receive))).await);
    }

    #[tokio::test]
    async fn where_there_is_one_thread_it_is_done_there() {
        assert_eq!(offload(|| 7), 7);
    }
}
