//! [`Conversation`]: what goes on for as long as a client listens and speaks, by a stream each way.

use std::sync::Arc;

use tokio::sync::mpsc;
use tonic::{Response, Status, Streaming};

use super::client::{Guest, Place};
use super::service::Responses;
use super::tracking::{self, respond};

/// Responses that wait for a client: what comes beyond them waits where it comes from.
const RESPONSES_MAX: usize = 16;

/// Where responses go, each with the room that it takes.
pub(super) type Told<T> = mpsc::Sender<tracking::Told<T>>;

/// What goes on between a client and the hub.
pub(super) trait Conversation: Send + Sized + 'static {
    /// What the client says.
    type Request: Send + 'static;
    /// What it hears.
    type Response: Send + 'static;

    /// Its place among what the client has.
    fn place(&self) -> &Place;

    /// Goes on until either has no more to say.
    fn work(
        &mut self,
        requests: Streaming<Self::Request>,
        told: &Told<Self::Response>,
    ) -> impl Future<Output = Result<(), Status>> + Send;
}

/// The first that a client says, while it is admitted.
pub(super) async fn first<T>(guest: &Guest, requests: &mut Streaming<T>) -> Result<Option<T>, Status> {
    let first = async { Ok(requests.message().await) };
    guest.admitted(first).await?
}

/// Goes on by itself from now on; `taken` is heard first.
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

async fn run<C: Conversation>(mut conversation: C, requests: Streaming<C::Request>, told: Told<C::Response>) {
    let guest = Arc::clone(&conversation.place().guest);
    let why = tokio::select! {
        biased;
        why = guest.ended() => Err(Status::from(why)),
        // Its client has gone.
        () = told.closed() => return,
        done = conversation.work(requests, &told) => done,
    };
    // It ends before its client hears so: who does not read may take as long as it likes.
    drop(conversation);
    if let Err(why) = why {
        let _ = told.send((Err(why), None)).await;
    }
}
