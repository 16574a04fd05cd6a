//! The thread that moves packets from one end through a [`Channel`] to the other, on time, and the handle to it.
//!
//! It knows no device and no socket; those are the [`Ports`] of the modules beside it.

use std::io;
use std::num::NonZeroU64;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};

use super::channel::{Channel, Counters, Profile};

/// Packets that are read from one end before the other has its turn.
pub(super) const BATCH_MAX: usize = 64;
/// How late the system may wake the thread, to save power: as little as it takes.
const TIMER_SLACK: NonZeroU64 = NonZeroU64::MIN;
/// Its priority, where it may choose one: others' work should not show as delay.
const NICENESS: i32 = -10;

/// Which way.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the first end to the second; of a relay, from those who connect.
    Forth,
    /// From the second end to the first.
    Back,
}

impl Direction {
    /// Both.
    pub const BOTH: [Self; 2] = [Self::Forth, Self::Back];
}

/// Where packets come from and go to.
pub(super) trait Ports: Send + 'static {
    type Packet: Clone + Send + 'static;

    /// Puts what has come into the channels, [`BATCH_MAX`] of each at most.
    fn receive(&mut self, channels: &mut [Channel<Self::Packet>; 2], now: Duration);

    /// Hands on what has gone through.
    fn deliver(&mut self, direction: Direction, packet: Self::Packet);

    /// What to wait for.
    fn watch(&self) -> Vec<PollFd<'_>>;

    /// Sends from other addresses from now on.
    fn rebind(&mut self) {}
}

struct Shared<P> {
    channels: Mutex<[Channel<P>; 2]>,
    wake: OwnedFd,
    ends: AtomicBool,
    rebinds: AtomicU64,
}

impl<P> Shared<P> {
    fn channels(&self) -> MutexGuard<'_, [Channel<P>; 2]> {
        self.channels.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wake(&self) {
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
    }
}

/// Moves packets until it is dropped.
pub(super) struct Pump<P: Clone> {
    shared: Arc<Shared<P>>,
    thread: Option<JoinHandle<()>>,
}

impl<P: Clone + Send + 'static> Pump<P> {
    pub(super) fn start(
        mut ports: impl Ports<Packet = P>,
        profiles: [Profile; 2],
        seed: u64,
    ) -> io::Result<Self> {
        let [forth, back] = profiles;
        let shared = Arc::new(Shared {
            channels: Mutex::new([Channel::new(forth, seed), Channel::new(back, !seed)]),
            wake: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
            ends: AtomicBool::new(false),
            rebinds: AtomicU64::new(0),
        });
        let its = Arc::clone(&shared);
        let thread =
            std::thread::Builder::new().name("netsim".into()).spawn(move || run(&its, &mut ports))?;
        Ok(Self { shared, thread: Some(thread) })
    }

    pub(super) fn set(&self, direction: Direction, profile: Profile) {
        self.shared.channels()[direction as usize].set(profile);
        self.shared.wake();
    }

    pub(super) fn cut(&self, direction: Direction) {
        self.shared.channels()[direction as usize].cut();
        self.shared.wake();
    }

    pub(super) fn restore(&self, direction: Direction) {
        self.shared.channels()[direction as usize].restore();
        self.shared.wake();
    }

    pub(super) fn rebind(&self) {
        self.shared.rebinds.fetch_add(1, Ordering::SeqCst);
        self.shared.wake();
    }

    pub(super) fn profile(&self, direction: Direction) -> Profile {
        self.shared.channels()[direction as usize].profile()
    }

    pub(super) fn counters(&self, direction: Direction) -> Counters {
        self.shared.channels()[direction as usize].counters()
    }
}

impl<P: Clone> Drop for Pump<P> {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::SeqCst);
        self.shared.wake();
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn run<T: Ports>(shared: &Shared<T::Packet>, ports: &mut T) {
    // Neither is needed to be right, only to be on time.
    let _ = rustix::thread::set_current_timer_slack(Some(TIMER_SLACK));
    let _ = rustix::process::setpriority_process(None, NICENESS);
    let origin = Instant::now();
    let mut rebinds = 0;
    while !shared.ends.load(Ordering::SeqCst) {
        let wanted = shared.rebinds.load(Ordering::SeqCst);
        if wanted != rebinds {
            ports.rebind();
            rebinds = wanted;
        }
        let deadline = {
            let mut channels = shared.channels();
            let now = origin.elapsed();
            ports.receive(&mut channels, now);
            for direction in Direction::BOTH {
                while let Some(packet) = channels[direction as usize].pop(now) {
                    ports.deliver(direction, packet);
                }
            }
            channels.iter().filter_map(Channel::next_deadline).min()
        };
        let timeout = deadline.map(|deadline| timespec(deadline.saturating_sub(origin.elapsed())));
        let mut fds = ports.watch();
        fds.push(PollFd::from_borrowed_fd(shared.wake.as_fd(), PollFlags::IN));
        // An interrupted wait is a short one.
        let _ = poll(&mut fds, timeout.as_ref());
        let _ = rustix::io::read(&shared.wake, &mut [0u8; 8]);
    }
}

fn timespec(time: Duration) -> Timespec {
    Timespec { tv_sec: time.as_secs().try_into().unwrap_or(i64::MAX), tv_nsec: time.subsec_nanos().into() }
}

/// The same methods for every kind of path.
macro_rules! controls {
    ($type:ty) => {
        impl $type {
            /// Changes a direction while it runs.
            pub fn set(&self, direction: Direction, profile: Profile) {
                self.pump.set(direction, profile);
            }

            /// Drops what is under way and all that comes, in both directions, until [`Self::restore`].
            pub fn cut(&self) {
                Direction::BOTH.into_iter().for_each(|direction| self.pump.cut(direction));
            }

            /// Ends [`Self::cut`].
            pub fn restore(&self) {
                Direction::BOTH.into_iter().for_each(|direction| self.pump.restore(direction));
            }

            /// What a direction is like.
            pub fn profile(&self, direction: Direction) -> Profile {
                self.pump.profile(direction)
            }

            /// What became of packets so far.
            pub fn counters(&self, direction: Direction) -> Counters {
                self.pump.counters(direction)
            }
        }
    };
}
pub(super) use controls;
