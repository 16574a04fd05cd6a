//! [`WallClock`]: the time of day, by which rights end. It waits for a time and notices when the clock is set.

use std::fmt;
use std::io;
use std::os::fd::AsFd;
use std::sync::Arc;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use rustix::io::Errno;
use rustix::time::{
    Itimerspec, TimerfdClockId, TimerfdFlags, TimerfdTimerFlags, Timespec, timerfd_create, timerfd_settime,
};
use sgc_wire::UnixMillis;
use tokio::net::unix::pipe::Receiver;
use tokio::sync::watch;
use tokio::task::AbortHandle;

/// Longest sleep if the system reports changes of the clock. A longer wait takes several sleeps.
const SLEEP_MAX: Duration = Duration::from_secs(86_400);
/// Longest sleep otherwise, and so the delay with which a change of the clock is noticed.
const SLEEP_BLIND_MAX: Duration = Duration::from_secs(60);
/// Expiry of the timer that reports changes of the clock, in seconds since the epoch: about the year 5138.
const NEVER_SECS: i64 = 100_000_000_000;

type Now = Arc<dyn Fn() -> UnixMillis + Send + Sync>;

/// The time of day. Clones share.
#[derive(Clone)]
pub struct WallClock {
    now: Now,
    /// Changes whenever the clock is set; `None` if the system does not report that.
    sets: Option<watch::Receiver<u64>>,
    _listener: Option<Arc<Listener>>,
}

/// The task that receives reports of clock changes.
struct Listener(AbortHandle);

impl Drop for Listener {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl fmt::Debug for WallClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WallClock").field("now", &self.now()).finish_non_exhaustive()
    }
}

impl WallClock {
    /// Returns the system's clock. Needs a runtime.
    pub fn system() -> Self {
        let (set, sets) = watch::channel(0);
        let heard = sets_of_the_system();
        let listener = heard.map(|heard| {
            let listening = tokio::spawn(async move {
                while next_set(&heard).await.is_ok() && set.receiver_count() > 0 {
                    set.send_modify(|number| *number += 1);
                }
            });
            Arc::new(Listener(listening.abort_handle()))
        });
        let (sets, _listener) = match listener {
            Ok(listener) => (Some(sets), Some(listener)),
            Err(error) => {
                tracing::warn!(%error, "the gateway does not hear when the clock is set: rights may end a minute late");
                (None, None)
            }
        };
        Self { now: Arc::new(now), sets, _listener }
    }

    /// Creates a clock that shows `now`. `sets` must change whenever the clock is set.
    pub fn new(
        now: impl Fn() -> UnixMillis + Send + Sync + 'static,
        sets: Option<watch::Receiver<u64>>,
    ) -> Self {
        Self { now: Arc::new(now), sets, _listener: None }
    }

    /// Returns the current time.
    pub fn now(&self) -> UnixMillis {
        (self.now)()
    }

    /// Waits until the time is later than `end`.
    pub async fn passes(&self, end: UnixMillis) {
        let mut sets = self.sets.clone();
        let max = if sets.is_some() { SLEEP_MAX } else { SLEEP_BLIND_MAX };
        loop {
            if let Some(sets) = &mut sets {
                sets.mark_unchanged();
            }
            let Some(left) = end.0.checked_sub(self.now().0) else { return };
            let left = Duration::from_millis(left.saturating_add(1));
            let set = async {
                let heard = match &mut sets {
                    Some(sets) => sets.changed().await.is_ok(),
                    None => false,
                };
                if !heard {
                    std::future::pending::<()>().await;
                }
            };
            tokio::select! {
                () = tokio::time::sleep(left.min(max)) => {}
                () = set => {}
            }
        }
    }
}

/// Creates a timer that never expires, and becomes readable when the clock is set or the machine wakes
/// (timerfd_create(2), `TFD_TIMER_CANCEL_ON_SET`).
fn sets_of_the_system() -> io::Result<Receiver> {
    let timer = timerfd_create(TimerfdClockId::Realtime, TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC)?;
    arm(&timer)?;
    // A `Receiver` reads any descriptor that becomes readable by itself.
    Receiver::from_owned_fd_unchecked(timer)
}

fn arm(timer: impl AsFd) -> io::Result<()> {
    let zero = Timespec { tv_sec: 0, tv_nsec: 0 };
    let never = Itimerspec { it_interval: zero, it_value: Timespec { tv_sec: NEVER_SECS, tv_nsec: 0 } };
    let flags = TimerfdTimerFlags::ABSTIME | TimerfdTimerFlags::CANCEL_ON_SET;
    Ok(timerfd_settime(timer, flags, &never).map(drop)?)
}

/// Waits until the clock is set.
async fn next_set(timer: &Receiver) -> io::Result<()> {
    loop {
        timer.readable().await?;
        match timer.try_read(&mut [0; 8]) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(error) if error.raw_os_error() != Some(Errno::CANCELED.raw_os_error()) => return Err(error),
            _ => return arm(timer),
        }
    }
}

/// Returns the time of the system's clock.
fn now() -> UnixMillis {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    UnixMillis(since.map_or(0, |since| since.as_millis().try_into().unwrap_or(u64::MAX)))
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use super::*;

    /// Returns a clock that follows the runtime's time and can be set.
    fn clock() -> (WallClock, Arc<AtomicU64>, watch::Sender<u64>) {
        let (set, sets) = watch::channel(0);
        let (began, ahead) = (tokio::time::Instant::now(), Arc::new(AtomicU64::new(1_000_000)));
        let shown = Arc::clone(&ahead);
        let now = move || UnixMillis(shown.load(Ordering::SeqCst) + began.elapsed().as_millis() as u64);
        (WallClock::new(now, Some(sets)), ahead, set)
    }

    #[tokio::test(start_paused = true)]
    async fn a_wait_ends_one_millisecond_after_its_end() {
        let (clock, ..) = clock();
        for wait_ms in [0, 1, 250, 10 * 86_400_000] {
            let end = UnixMillis(clock.now().0 + wait_ms);
            clock.passes(end).await;
            assert_eq!(clock.now(), UnixMillis(end.0 + 1));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn a_clock_that_is_set_forward_ends_a_wait_at_once() {
        let (clock, ahead, set) = clock();
        let began = tokio::time::Instant::now();
        let waits = tokio::spawn({
            let (clock, end) = (clock.clone(), UnixMillis(clock.now().0 + 3_600_000));
            async move { clock.passes(end).await }
        });
        tokio::task::yield_now().await;
        ahead.fetch_add(3_600_001, Ordering::SeqCst);
        set.send_modify(|number| *number += 1);
        waits.await.unwrap();
        assert!(began.elapsed() < Duration::from_millis(10));
    }

    #[tokio::test]
    async fn the_system_says_when_its_clock_is_set() {
        let timer = sets_of_the_system().unwrap();
        // Nothing sets the clock here.
        let quiet = tokio::time::timeout(Duration::from_millis(20), next_set(&timer)).await;
        assert!(quiet.is_err());
        assert!(WallClock::system().sets.is_some());
    }
}
