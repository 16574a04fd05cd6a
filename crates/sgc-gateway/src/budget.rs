//! [`Budget`]: room for one client's long messages, so that unread ones take bounded memory.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::error::GatewayError;
use crate::quota::{Permits, Quota, UNIT_BYTES};

/// Room for long messages.
#[derive(Debug)]
pub(crate) struct Budget {
    room: Arc<Semaphore>,
    units: usize,
    /// The bounds that the client shares with others.
    quota: Quota,
    /// The units of replies that wait for room.
    waiting_units: AtomicUsize,
}

/// A reply that waits for room.
struct WaitingReply<'a>(&'a AtomicUsize, usize);

impl Drop for WaitingReply<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(self.1, Ordering::Relaxed);
    }
}

/// The room of one message, returned on drop.
#[derive(Debug)]
pub(crate) struct Room(
    #[expect(dead_code, reason = "they are for their end")] (OwnedSemaphorePermit, Permits),
);

impl Budget {
    /// Creates room for `bytes_max` bytes of one client, within its quota.
    pub(crate) fn new(bytes_max: usize, quota: Quota) -> Self {
        let units = (bytes_max / UNIT_BYTES).clamp(1, Semaphore::MAX_PERMITS);
        Self { room: Arc::new(Semaphore::new(units)), units, quota, waiting_units: AtomicUsize::new(0) }
    }

    /// Waits for room for a message. A message longer than the budget waits for all of it. Short messages need none.
    pub(crate) async fn take(&self, bytes: usize) -> Option<Room> {
        if bytes <= UNIT_BYTES {
            return None;
        }
        let units = u32::try_from(self.units_of(bytes)).unwrap_or(u32::MAX);
        let own = Arc::clone(&self.room).acquire_many_owned(units).await.ok()?;
        Some(Room((own, self.quota.room(units).await?)))
    }

    /// Waits for room for a reply, whose memory is taken already. Fails if waiting replies exceed the budget.
    pub(crate) async fn take_for_reply(&self, bytes: usize) -> Result<Option<Room>, GatewayError> {
        if bytes <= UNIT_BYTES {
            return Ok(None);
        }
        let units = self.units_of(bytes);
        let before = self.waiting_units.fetch_add(units, Ordering::Relaxed);
        let _waits = WaitingReply(&self.waiting_units, units);
        if before + units > self.units {
            let max = self.units * UNIT_BYTES;
            return Err(GatewayError::TooMany { what: "bytes of replies that it does not read", max });
        }
        Ok(self.take(bytes).await)
    }

    /// Takes room for a message without waiting.
    pub(crate) fn take_at_once(&self, bytes: usize) -> Result<Option<Room>, GatewayError> {
        if bytes <= UNIT_BYTES {
            return Ok(None);
        }
        let units = u32::try_from(self.units_of(bytes)).unwrap_or(u32::MAX);
        let taken = Arc::clone(&self.room).try_acquire_many_owned(units);
        let max = self.units * UNIT_BYTES;
        let own = taken.map_err(|_| GatewayError::TooMany {
            what: "bytes of requests that come or are worked on",
            max,
        })?;
        Ok(Some(Room((own, self.quota.room_at_once(units)?))))
    }

    fn units_of(&self, bytes: usize) -> usize {
        bytes.div_ceil(UNIT_BYTES).min(self.units)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn long_messages_wait_for_room_and_short_ones_do_not() {
        let quotas: Arc<crate::quota::Quotas> = Arc::default();
        let budget = Budget::new(1 << 20, quotas.quota(&crate::access::Client::own("test")));
        let first = budget.take(900 << 10).await.unwrap();
        assert!(budget.take(1000).await.is_none());
        let waits = tokio::time::timeout(Duration::from_millis(20), budget.take(200 << 10)).await;
        assert!(waits.is_err());
        drop(first);
        // Replies wait too, up to the whole budget.
        let all = budget.take(1 << 20).await;
        let waits = budget.take_for_reply(900 << 10);
        tokio::pin!(waits);
        assert!(tokio::time::timeout(Duration::from_millis(20), &mut waits).await.is_err());
        assert!(budget.take_for_reply(200 << 10).await.is_err());
        assert!(budget.take_for_reply(1000).await.unwrap().is_none());
        drop(all);
        assert!(waits.await.unwrap().is_some());
        // A message longer than the budget takes all of it.
        assert!(budget.take(50 << 20).await.is_some());
    }
}
