//! [`Incoming`]: what a client sends on a stream. Each long message takes room of its client's from its head on, before the
//! rest of it is there; a stream that finds none is refused, since streams that wait would fill the window of the connection
//! that those which have room need.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use tonic::Status;

use super::MESSAGE_BYTES_MAX;
use super::client::Guest;
use super::fault::Fault;
use crate::budget::{Budget, Room};
use crate::error::GatewayError;
use crate::hub::lock;

/// Before each message: whether it is compressed, and its length (gRPC over HTTP/2, Length-Prefixed-Message).
const HEAD_BYTES: usize = 5;

/// Room of messages that have come, for as long as they are worked on.
pub(super) type Kept = Arc<Mutex<Vec<Room>>>;

/// The messages of a stream, and their room.
#[derive(Debug, Default)]
struct Messages {
    /// What there is of a head.
    head: VecDeque<u8>,
    /// What is to come of a message.
    left: usize,
    /// Its room.
    room: Option<Room>,
    /// Room of those that have come.
    come: Vec<Room>,
}

impl Messages {
    /// Takes room for what begins in here.
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
                // What is too long is refused by its head.
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

/// The body of a request, within the bounds of who sends it.
pub(super) struct Incoming<B> {
    body: B,
    guest: Arc<Guest>,
    messages: Messages,
    /// Where room stays though all of the stream was read.
    kept: Option<Kept>,
}

impl<B> Incoming<B> {
    pub(super) fn new(body: B, guest: Arc<Guest>, kept: Option<Kept>) -> Self {
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
        // Who reads on has done with what came before.
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
        // A head in two parts, and nothing of its message.
        let long = head(LONG);
        first.take(&long[..3], &budget).unwrap();
        assert!(first.room.is_none());
        first.take(&long[3..], &budget).unwrap();
        let refused = second.take(&long, &budget).unwrap_err();
        assert!(matches!(refused, GatewayError::TooMany { max, .. } if max == 1 << 20), "{refused}");
        // Short ones come all the same, and before another.
        let mut third = Messages::default();
        let mut short = [head(3), b"abc".to_vec(), head(0), head(2)].concat();
        short.push(b'x');
        third.take(&short, &budget).unwrap();
        assert_eq!(third.left, 1);
        first.take(&vec![0; LONG - 1], &budget).unwrap();
        assert!(first.come.is_empty());
        // Its last byte, and the next head: for both there is no room.
        assert!(first.take(&[&[0][..], &long].concat(), &budget).is_err());
        assert_eq!(first.come.len(), 1);
        drop(first);
        let mut fourth = Messages::default();
        fourth.take(&long, &budget).unwrap();
        // What is longer than may come is not waited for.
        let mut fifth = Messages::default();
        fifth.take(&head(MESSAGE_BYTES_MAX + 1), &budget).unwrap();
        assert!(fifth.room.is_none());
    }
}
