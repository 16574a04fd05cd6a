//! [`Incoming`]: the messages that a client sends on a stream. Each long message reserves room from its head on,
//! before the rest has arrived. A stream without room fails, because waiting streams would fill the connection's
//! window, which the streams with room need.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use sgc_sync::lock;
use tonic::Status;

use super::fault::Fault;
use super::guest::Guest;
use super::options::MESSAGE_BYTES_MAX;
use crate::budget::{Budget, Room};
use crate::error::GatewayError;

/// Length of the head of each message: the compression flag and the length (gRPC over HTTP/2,
/// Length-Prefixed-Message).
const HEAD_BYTES: usize = 5;

/// The room of received messages until they are handled.
pub(super) type KeptRooms = Arc<Mutex<Vec<Room>>>;

/// The messages of a stream and their room.
#[derive(Debug, Default)]
struct Messages {
    /// The received part of a head.
    head: VecDeque<u8>,
    /// The missing bytes of the current message.
    left: usize,
    /// The room of the current message.
    room: Option<Room>,
    /// The room of complete messages.
    come: Vec<Room>,
}

impl Messages {
    /// Reserves room for messages that begin in `data`.
    fn take(&mut self, mut data: &[u8], budget: &Budget) -> Result<(), GatewayError> {
        while !data.is_empty() {
            if self.left == 0 {
                let missing = HEAD_BYTES - self.head.len();
                let (head, rest) = data.split_at(missing.min(data.len()));
                self.head.extend(head);
                data = rest;
                if self.head.len() < HEAD_BYTES {
                    return Ok(());
                }
                self.left =
                    self.head.drain(..).skip(1).fold(0, |length, byte| length << 8 | usize::from(byte));
                // The server refuses a message beyond the bound by its head.
                if self.left <= MESSAGE_BYTES_MAX {
                    self.room = budget.take_at_once(self.left)?;
                }
            }
            let here = self.left.min(data.len());
            self.left -= here;
            data = data.get(here..).unwrap_or_default();
            if self.left == 0 {
                self.come.extend(self.room.take());
            }
        }
        Ok(())
    }
}

/// The body of a request, within the bounds of its guest.
pub(super) struct Incoming<B> {
    body: B,
    guest: Arc<Guest>,
    messages: Messages,
    /// Keeps room for longer than the stream is read.
    kept: Option<KeptRooms>,
}

impl<B> Incoming<B> {
    pub(super) fn new(body: B, guest: Arc<Guest>, kept: Option<KeptRooms>) -> Self {
        Self { body, guest, messages: Messages::default(), kept }
    }
}

impl<B: http_body::Body<Data = Bytes, Error = Status> + Unpin> http_body::Body for Incoming<B> {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        // The reader has handled earlier messages when it reads on.
        let come = std::mem::take(&mut self.messages.come);
        if let Some(kept) = &self.kept {
            lock(kept).extend(come);
        }
        let this = &mut *self;
        let frame = ready!(Pin::new(&mut this.body).poll_frame(cx));
        if let Some(Ok(frame)) = &frame
            && let Some(data) = frame.data_ref()
            && let Err(error) = this.messages.take(data, &this.guest.incoming)
        {
            tracing::debug!(client = %this.guest.session.client().name, %error, "a gRPC client sends too much at a time");
            return Poll::Ready(Some(Err(Fault::from(error).into())));
        }
        Poll::Ready(frame)
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
    use super::*;

    fn head(bytes: usize) -> Vec<u8> {
        let mut head = vec![0];
        head.extend((bytes as u32).to_be_bytes());
        head
    }

    #[test]
    fn room_is_taken_by_the_head_and_given_back_with_the_message() {
        const LONG: usize = 600 << 10;
        let quotas: Arc<crate::quota::Quotas> = Arc::default();
        let budget = Budget::new(1 << 20, quotas.quota(&crate::access::Client::own("test")));
        let (mut first, mut second) = (Messages::default(), Messages::default());
        // The head comes in two parts, without its message.
        let long = head(LONG);
        first.take(&long[..3], &budget).unwrap();
        assert!(first.room.is_none());
        first.take(&long[3..], &budget).unwrap();
        let refused = second.take(&long, &budget).unwrap_err();
        assert!(matches!(refused, GatewayError::TooMany { max, .. } if max == 1 << 20), "{refused}");
        // Short messages pass without room.
        let mut third = Messages::default();
        let mut short = [head(3), b"abc".to_vec(), head(0), head(2)].concat();
        short.push(b'x');
        third.take(&short, &budget).unwrap();
        assert_eq!(third.left, 1);
        first.take(&vec![0; LONG - 1], &budget).unwrap();
        assert!(first.come.is_empty());
        // The last byte and the next head, for which there is no room.
        assert!(first.take(&[&[0][..], &long].concat(), &budget).is_err());
        assert_eq!(first.come.len(), 1);
        drop(first);
        let mut fourth = Messages::default();
        fourth.take(&long, &budget).unwrap();
        // A message beyond the bound takes no room.
        let mut fifth = Messages::default();
        fifth.take(&head(MESSAGE_BYTES_MAX + 1), &budget).unwrap();
        assert!(fifth.room.is_none());
    }
}
