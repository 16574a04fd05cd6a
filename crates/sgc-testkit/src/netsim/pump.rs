//! The thread that moves packets from one end through a [`Channel`] to the other on time, and its handle.
//!
//! It knows no device and no socket; the modules beside it implement [`Ports`].

use std::io;
use std::num::NonZeroU64;
use std::os::fd::{AsFd, OwnedFd};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{EventfdFlags, PollFd, PollFlags, Timespec, eventfd, poll};
use sgc_sync::lock;

use super::channel::{Channel, Counters, Profile};

/// Most packets read from one end before the other has its turn.
pub(super) const BATCH_MAX: usize = 64;
/// Timer slack of the thread: the least, so that the system wakes it on time.
const TIMER_SLACK: NonZeroU64 = NonZeroU64::MIN;
/// Priority of the thread, where it may set one, so that other work does not add delay.
const NICENESS: i32 = -10;

/// A direction of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Direction {
    /// From the first end to the second. In a relay: from the clients.
    Forth,
    /// From the second end to the first.
    Back,
}

impl Direction {
    /// Both directions.
    pub const BOTH: [Self; 2] = [Self::Forth, Self::Back];
}

/// The ends of a path.
pub(super) trait Ports: Send + 'static {
    type Packet: Clone + Send + 'static;

    /// Moves arrived packets into the channels, at most [`BATCH_MAX`] each.
    fn receive(&mut self, channels: &mut [Channel<Self::Packet>; 2], now: Duration);

    /// Sends on a packet that has passed its channel.
    fn deliver(&mut self, direction: Direction, packet: Self::Packet);

    /// Returns the descriptors to wait for.
    fn watch(&self) -> Vec<PollFd<'_>>;

    /// Sends from other addresses from now on.
    fn rebind(&mut self) {}
}

struct PumpState<P> {
    channels: Mutex<[Channel<P>; 2]>,
    wake: OwnedFd,
    ends: AtomicBool,
    rebinds: AtomicU64,
}

impl<P> PumpState<P> {
    fn channels(&self) -> MutexGuard<'_, [Channel<P>; 2]> {
        lock(&self.channels)
    }

    fn wake(&self) {
        let _ = rustix::io::write(&self.wake, &1u64.to_ne_bytes());
    }
}

/// Moves packets until it is dropped.
pub(super) struct Pump<P: Clone> {
    state: Arc<PumpState<P>>,
    thread: Option<JoinHandle<()>>,
}

impl<P: Clone + Send + 'static> Pump<P> {
    pub(super) fn start(
        mut ports: impl Ports<Packet = P>,
        profiles: [Profile; 2],
        seed: u64,
    ) -> io::Result<Self> {
        let [forth, back] = profiles;
        let state = Arc::new(PumpState {
            channels: Mutex::new([Channel::new(forth, seed), Channel::new(back, !seed)]),
            wake: eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?,
            ends: AtomicBool::new(false),
            rebinds: AtomicU64::new(0),
        });
        let its = Arc::clone(&state);
        let thread =
            std::thread::Builder::new().name("netsim".into()).spawn(move || run(&its, &mut ports))?;
        Ok(Self { state, thread: Some(thread) })
    }

    pub(super) fn set(&self, direction: Direction, profile: Profile) {
        self.state.channels()[direction as usize].set(profile);
        self.state.wake();
    }

    pub(super) fn cut(&self, direction: Direction) {
        self.state.channels()[direction as usize].cut();
        self.state.wake();
    }

    pub(super) fn restore(&self, direction: Direction) {
        self.state.channels()[direction as usize].restore();
        self.state.wake();
    }

    pub(super) fn rebind(&self) {
        self.state.rebinds.fetch_add(1, Ordering::SeqCst);
        self.state.wake();
    }

    pub(super) fn profile(&self, direction: Direction) -> Profile {
        self.state.channels()[direction as usize].profile()
    }

    pub(super) fn counters(&self, direction: Direction) -> Counters {
        self.state.channels()[direction as usize].counters()
    }
}

impl<P: Clone> Drop for Pump<P> {
    fn drop(&mut self) {
        self.state.ends.store(true, Ordering::SeqCst);
        self.state.wake();
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

fn run<T: Ports>(state: &PumpState<T::Packet>, ports: &mut T) {
    // Both calls only improve timing, so their failure is ignored.
    let _ = rustix::thread::set_current_timer_slack(Some(TIMER_SLACK));
    let _ = rustix::process::setpriority_process(None, NICENESS);
    let origin = Instant::now();
    let mut rebinds = 0;
    while !state.ends.load(Ordering::SeqCst) {
        let wanted = state.rebinds.load(Ordering::SeqCst);
        if wanted != rebinds {
            ports.rebind();
            rebinds = wanted;
        }
        let deadline = {
            let mut channels = state.channels();
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
        fds.push(PollFd::from_borrowed_fd(state.wake.as_fd(), PollFlags::IN));
        // An interrupted wait counts as a short one.
        let _ = poll(&mut fds, timeout.as_ref());
        let _ = rustix::io::read(&state.wake, &mut [0u8; 8]);
    }
}

fn timespec(time: Duration) -> Timespec {
    Timespec { tv_sec: time.as_secs().try_into().unwrap_or(i64::MAX), tv_nsec: time.subsec_nanos().into() }
}

/// Defines the methods that every kind of path has.
macro_rules! controls {
    ($type:ty) => {
        impl $type {
            /// Changes a direction while it runs.
            pub fn set(&self, direction: Direction, profile: Profile) {
                self.pump.set(direction, profile);
            }

            /// Drops packets in flight and all that come, in both directions, until [`Self::restore`].
            pub fn cut(&self) {
                Direction::BOTH.into_iter().for_each(|direction| self.pump.cut(direction));
            }

            /// Ends [`Self::cut`].
            pub fn restore(&self) {
                Direction::BOTH.into_iter().for_each(|direction| self.pump.restore(direction));
            }

            /// Returns the profile of a direction.
            pub fn profile(&self, direction: Direction) -> Profile {
                self.pump.profile(direction)
            }

            /// Returns the counters of a direction.
            pub fn counters(&self, direction: Direction) -> Counters {
                self.pump.counters(direction)
            }
        }
    };
}
pub(super) use controls;
