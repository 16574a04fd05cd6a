//! [`Budget`]: room for long messages of one client, so that many streams that are not read take no more than a few.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::body::Body;
use tonic::codegen::BoxFuture;
use tonic::server::NamedService;
use tonic::{Response, Status};

use super::proto::gateway_server::GatewayServer;
use super::service::{Responses, Service};
use crate::error::GatewayError;
use crate::hub::lock;

/// Messages up to that length need no room, since streams are counted; that of longer ones is in multiples of it.
const UNIT_BYTES: usize = 64 << 10;

/// Room for long messages.
pub(super) struct Budget {
    room: Arc<Semaphore>,
    units: usize,
    /// Of replies that are there, and wait for room.
    waiting_units: AtomicUsize,
}

/// A reply that waits for room.
struct Waits<'a>(&'a AtomicUsize, usize);

impl Drop for Waits<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(self.1, Ordering::Relaxed);
    }
}

/// What a message takes of it, until it is dropped.
#[derive(Debug)]
pub(super) struct Room(#[expect(dead_code, reason = "it is for its end")] OwnedSemaphorePermit);

impl Budget {
    pub(super) fn new(bytes_max: usize) -> Self {
        let units = (bytes_max / UNIT_BYTES).clamp(1, Semaphore::MAX_PERMITS);
        Self { room: Arc::new(Semaphore::new(units)), units, waiting_units: AtomicUsize::new(0) }
    }

    /// Waits for room for a message; one that is longer than all there is waits for all. Short ones need none.
    pub(super) async fn take(&self, bytes: usize) -> Option<Room> {
        if bytes <= UNIT_BYTES {
            return None;
        }
        let units = u32::try_from(self.units_of(bytes)).unwrap_or(u32::MAX);
        Arc::clone(&self.room).acquire_many_owned(units).await.ok().map(Room)
    }

    /// The same for a reply, which nobody holds back while it waits: of those no more wait than there is room in all.
    pub(super) async fn take_for_reply(&self, bytes: usize) -> Result<Option<Room>, GatewayError> {
        if bytes <= UNIT_BYTES {
            return Ok(None);
        }
        let units = self.units_of(bytes);
        let before = self.waiting_units.fetch_add(units, Ordering::Relaxed);
        let _waits = Waits(&self.waiting_units, units);
        if before + units > self.units {
            let max = self.units * UNIT_BYTES;
            return Err(GatewayError::TooMany { what: "bytes of replies that it does not read", max });
        }
        Ok(self.take(bytes).await)
    }

    fn units_of(&self, bytes: usize) -> usize {
        bytes.div_ceil(UNIT_BYTES).min(self.units)
    }
}

/// Where a stream puts the room of the message that it gives next, for the body to take along.
#[derive(Clone, Debug, Default)]
pub(super) struct Slot(Arc<Mutex<Option<Room>>>);

impl Slot {
    pub(super) fn put(&self, room: Option<Room>) {
        *lock(&self.0) = room;
    }
}

/// A response of a stream, and the room that it takes.
pub(super) type Told<T> = (Result<T, Status>, Option<Room>);

/// A stream of what is told, each with its room.
pub(super) fn respond<T: Send + 'static>(told: mpsc::Receiver<Told<T>>) -> Response<Responses<T>> {
    let slot = Slot::default();
    let next = slot.clone();
    let responses: Responses<T> = Box::pin(ReceiverStream::new(told).map(move |(response, room)| {
        if room.is_some() {
            next.put(room);
        }
        response
    }));
    with_slot(responses, slot)
}

/// A response whose messages have their room from there.
pub(super) fn with_slot<T>(message: T, slot: Slot) -> Response<T> {
    let mut response = Response::new(message);
    response.extensions_mut().insert(slot);
    response
}

/// Has messages hold their room until they have left: the connection drops what it has written.
#[derive(Clone, Debug)]
pub(super) struct Tracking(GatewayServer<Service>);

impl Tracking {
    pub(super) fn new(gateway: GatewayServer<Service>) -> Self {
        Self(gateway)
    }
}

impl NamedService for Tracking {
    const NAME: &'static str = GatewayServer::<Service>::NAME;
}

impl tonic::codegen::Service<http::Request<Body>> for Tracking {
    type Response = http::Response<Body>;
    type Error = Infallible;
    type Future = BoxFuture<Self::Response, Infallible>;

    fn poll_ready(&mut self, cx: &mut Context<'_>) -> Poll<Result<(), Infallible>> {
        tonic::codegen::Service::<http::Request<Body>>::poll_ready(&mut self.0, cx)
    }

    fn call(&mut self, request: http::Request<Body>) -> Self::Future {
        let answered = self.0.call(request);
        Box::pin(async move {
            let mut response = answered.await?;
            let slot = response.extensions_mut().remove::<Slot>();
            Ok(match slot {
                Some(slot) => response.map(|body| Body::new(Tracked { body, slot })),
                None => response,
            })
        })
    }
}

/// What is written of a stream, with the room that it takes.
struct Tracked {
    body: Body,
    slot: Slot,
}

/// Bytes, and their room.
struct Held {
    bytes: Bytes,
    _room: Room,
}

impl AsRef<[u8]> for Held {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl http_body::Body for Tracked {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(cx));
        let with_room = |bytes| match lock(&self.slot.0).take() {
            Some(_room) => Bytes::from_owner(Held { bytes, _room }),
            None => bytes,
        };
        Poll::Ready(frame.map(|frame| frame.map(|frame| frame.map_data(with_room))))
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn long_messages_wait_for_room_and_short_ones_do_not() {
        let budget = Budget::new(1 << 20);
        let first = budget.take(900 << 10).await.unwrap();
        assert!(budget.take(1000).await.is_none());
        let waits = tokio::time::timeout(Duration::from_millis(20), budget.take(200 << 10)).await;
        assert!(waits.is_err());
        drop(first);
        // Replies wait for it as well, as many as there is room in all.
        let all = budget.take(1 << 20).await;
        let waits = budget.take_for_reply(900 << 10);
        tokio::pin!(waits);
        assert!(tokio::time::timeout(Duration::from_millis(20), &mut waits).await.is_err());
        assert!(budget.take_for_reply(200 << 10).await.is_err());
        assert!(budget.take_for_reply(1000).await.unwrap().is_none());
        drop(all);
        assert!(waits.await.unwrap().is_some());
        // What is longer than all takes all.
        assert!(budget.take(50 << 20).await.is_some());
    }
}
