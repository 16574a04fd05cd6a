//! [`aside`]: work that takes a while, such as reading files and converting images, without holding up the other clients whose
//! tasks are on the same thread of the runtime.

use tokio::runtime::{Handle, RuntimeFlavor};

/// Messages up to that length are converted at once: that takes a millisecond or two, and going aside tens of microseconds.
const SHORT_BYTES_MAX: usize = 256 << 10;

/// Does something that may block or take long. What else waits for this thread is done on another; where there is no other,
/// it waits.
pub(crate) fn aside<T>(work: impl FnOnce() -> T) -> T {
    let has_others =
        Handle::try_current().is_ok_and(|runtime| runtime.runtime_flavor() == RuntimeFlavor::MultiThread);
    if has_others { tokio::task::block_in_place(work) } else { work() }
}

/// The same for what takes long if a message of so many bytes is.
pub(crate) fn aside_if_long<T>(bytes: usize, work: impl FnOnce() -> T) -> T {
    if bytes > SHORT_BYTES_MAX { aside(work) } else { work() }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;
    use std::time::Duration;

    use super::*;

    /// Has something wait for another task of the same thread.
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
        assert!(waits_for_another(move |receive| aside(|| comes(receive))).await);
        assert!(waits_for_another(move |receive| aside_if_long(1 << 20, || comes(receive))).await);
    }

    #[tokio::test]
    async fn where_there_is_one_thread_it_is_done_there() {
        assert_eq!(aside(|| 7), 7);
    }
}
