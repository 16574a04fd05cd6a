//! [`Conversation`]: an exchange by one stream in each direction.

use std::sync::Arc;

use tokio::sync::mpsc;
use tonic::{Response, Status, Streaming};

use super::guest::{Guest, Place};
use super::slot::{self, Responses, respond};

/// Most queued responses. At the bound the source of further responses waits.
const RESPONSES_MAX: usize = 16;

/// The sender of responses, each with its room.
pub(super) type Responder<T> = mpsc::Sender<slot::TrackedResponse<T>>;

/// An exchange between a client and the hub.
pub(super) trait Conversation: Send + Sized + 'static {
    /// A message of the client.
    type Request: Send + 'static;
    /// A message to the client.
    type Response: Send + 'static;

    /// Returns the stream's place among those of the client.
    fn place(&self) -> &Place;

    /// Runs until either side ends.
    fn work(
        &mut self,
        requests: Streaming<Self::Request>,
        told: &Responder<Self::Response>,
    ) -> impl Future<Output = Result<(), Status>> + Send;
}

/// Reads the first request while the client is admitted.
pub(super) async fn first<T>(guest: &Guest, requests: &mut Streaming<T>) -> Result<Option<T>, Status> {
    let first = async { Ok(requests.message().await) };
    guest.admitted(first).await?
}

/// Runs the conversation in a task of its own. `taken` is the first response.
pub(super) fn begin<C: Conversation>(
    conversation: C,
    requests: Streaming<C::Request>,
    taken: C::Response,
) -> Response<Responses<C::Response>> {
    let (told, responses) = mpsc::channel(RESPONSES_MAX);
    let _ = told.try_send((Ok(taken), None));
    tokio::spawn(run(conversation, requests, told));
    respond(responses)
}

async fn run<C: Conversation>(
    mut conversation: C,
    requests: Streaming<C::Request>,
    told: Responder<C::Response>,
) {
    let guest = Arc::clone(&conversation.place().guest);
    let why = tokio::select! {
        biased;
        why = guest.ended() => Err(Status::from(why)),
        // The client has left.
        () = told.closed() => return,
        done = conversation.work(requests, &told) => done,
    };
    // The conversation is dropped before its client learns of the end, because a client that does not read may delay
    // that forever.
    drop(conversation);
    if let Err(why) = why {
        let _ = told.send((Err(why), None)).await;
    }
}
