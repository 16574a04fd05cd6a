//! [`PingState`] and [`write_paced`]: whether a WebSocket client is still there. A client is taken for gone if it
//! leaves a ping unanswered, or does not take what is written. A slow client is neither.

use std::sync::Mutex;
use std::time::Duration;

use sgc_sync::lock;
use tokio::time::Instant;

/// Lowest rate at which a client must read in the long run, in bytes per second.
const PACE_BYTES_MIN: u64 = 16 << 10;
/// Most bytes before a ping that the buffers of both systems are assumed to hold: the greatest that Linux gives a
/// connection by itself, 4 MiB at the sender and 6 MiB at the receiver.
const BUFFERED_BYTES_MAX: usize = 10 << 20;

/// The ping that has not been answered.
#[derive(Debug, Default)]
pub(crate) struct PingState(Mutex<Ping>);

#[derive(Clone, Copy, Debug, Default)]
struct Ping {
    /// The time since which the ping has not been answered.
    since: Option<Instant>,
    /// Bytes written since the last ping.
    written_bytes: usize,
    /// Bytes that the client must read before the ping, at most.
    ahead_bytes: usize,
}

impl PingState {
    /// Records that a ping was written.
    pub(crate) fn asked(&self) {
        let mut ping = lock(&self.0);
        let written_bytes = std::mem::take(&mut ping.written_bytes);
        if ping.since.is_none() {
            ping.ahead_bytes = written_bytes.min(BUFFERED_BYTES_MAX);
            ping.since = Some(Instant::now());
        }
    }

    /// Records that a message arrived.
    pub(crate) fn heard(&self) {
        lock(&self.0).since = None;
    }

    /// Records written bytes, which give a ping behind them more time. The protocol rosbridge records none.
    pub(crate) fn wrote(&self, bytes: usize) {
        let mut ping = lock(&self.0);
        ping.written_bytes = ping.written_bytes.saturating_add(bytes);
    }

    /// Returns the silence of a client that has left a ping unanswered for too long. A ping that waits behind other
    /// bytes has their time as well. `read_since` is the time since which messages of the client are read.
    pub(crate) fn silence(&self, silence_max: Duration, read_since: Instant) -> Option<Duration> {
        let ping = *lock(&self.0);
        let silence = ping.since?.max(read_since).elapsed();
        (silence >= pace(silence_max, ping.ahead_bytes)).then_some(silence)
    }
}

/// A write took longer than this.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct TooSlow(pub(crate) Duration);

/// Returns the time for bytes that a client must read.
fn pace(silence_max: Duration, bytes: usize) -> Duration {
    silence_max + Duration::from_secs(bytes as u64 / PACE_BYTES_MIN)
}

/// Limits the duration of a write. `bytes` is the bytes that the client must take for it.
pub(crate) async fn write_paced<T>(
    silence_max: Duration,
    bytes: usize,
    write: impl Future<Output = T>,
) -> Result<T, TooSlow> {
    let max = pace(silence_max, bytes);
    tokio::time::timeout(max, write).await.map_err(|_| TooSlow(max))
}
