//! The runtime of quinn's endpoints: tokio, with tasks of [`sgc_executor`] and timers that cost nothing to postpone.

use std::future::Future;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Instant;

use quinn::{AsyncTimer, AsyncUdpSocket, Runtime, TokioRuntime};
use tokio::time::{Sleep, sleep_until};

/// Tokio for quinn, with tasks that the waking thread may run.
#[derive(Debug)]
pub(crate) struct PromptRuntime;

impl Runtime for PromptRuntime {
    fn new_timer(&self, at: Instant) -> Pin<Box<dyn AsyncTimer>> {
        Box::pin(Timer { at, sleep: Box::pin(sleep_until(at.into())) })
    }

    fn spawn(&self, future: Pin<Box<dyn Future<Output = ()> + Send>>) {
        sgc_executor::spawn(future);
    }

    fn wrap_udp_socket(
        &self,
        socket: std::net::UdpSocket,
    ) -> std::io::Result<std::sync::Arc<dyn AsyncUdpSocket>> {
        TokioRuntime.wrap_udp_socket(socket)
    }

    fn now(&self) -> Instant {
        TokioRuntime.now()
    }
}

/// A timer that is postponed without telling the runtime: a connection postpones it with each packet, and an earlier
/// time would wake a thread of the runtime.
#[derive(Debug)]
struct Timer {
    at: Instant,
    sleep: Pin<Box<Sleep>>,
}

impl AsyncTimer for Timer {
    fn reset(mut self: Pin<&mut Self>, at: Instant) {
        self.at = at;
        if self.sleep.deadline() > at.into() {
            self.sleep.as_mut().reset(at.into());
        }
    }

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<()> {
        loop {
            ready!(Future::poll(self.sleep.as_mut(), cx));
            let at = self.at.into();
            if self.sleep.deadline() >= at {
                return Poll::Ready(());
            }
            self.sleep.as_mut().reset(at);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    #[tokio::test]
    async fn a_timer_rings_when_it_was_last_set_to() {
        let begun = Instant::now();
        let after = |ms| begun + Duration::from_millis(ms);
        let mut late = PromptRuntime.new_timer(after(10));
        late.as_mut().reset(after(60));
        let mut early = PromptRuntime.new_timer(after(600_000));
        early.as_mut().reset(after(30));
        for (timer, ms) in [(&mut early, 30), (&mut late, 60)] {
            timeout(PATIENCE, poll_fn(|cx| timer.as_mut().poll(cx))).await.unwrap();
            assert!(begun.elapsed() >= Duration::from_millis(ms));
        }
    }
}
