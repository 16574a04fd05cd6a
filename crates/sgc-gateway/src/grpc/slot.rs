//! [`Slot`]: the room of a stream's next message, on its way from the stream to the body of the response.

use std::pin::Pin;
use std::sync::{Arc, Mutex};

use sgc_sync::lock;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::{Response, Status};

use crate::budget::Room;

/// A stream of responses to a client.
pub(super) type Responses<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// A slot in which a stream passes the room of its next message to the body.
#[derive(Clone, Debug, Default)]
pub(super) struct Slot(Arc<Mutex<Option<Room>>>);

impl Slot {
    pub(super) fn put(&self, room: Option<Room>) {
        *lock(&self.0) = room;
    }

    /// Takes the room of the message that is sent.
    pub(super) fn take(&self) -> Option<Room> {
        lock(&self.0).take()
    }
}

/// A response of a stream and its room.
pub(super) type TrackedResponse<T> = (Result<T, Status>, Option<Room>);

/// Creates a stream of responses, each with its room.
pub(super) fn respond<T: Send + 'static>(told: mpsc::Receiver<TrackedResponse<T>>) -> Response<Responses<T>> {
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

/// Creates a response whose messages take their room from `slot`.
pub(super) fn with_slot<T>(message: T, slot: Slot) -> Response<T> {
    let mut response = Response::new(message);
    response.extensions_mut().insert(slot);
    response
}
