//! [`Tracking`]: outgoing messages of streams hold room in their client's [`Budget`](crate::budget::Budget) until
//! they are sent, incoming ones until they are handled.

use std::convert::Infallible;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use tonic::Status;
use tonic::body::Body;
use tonic::codegen::BoxFuture;
use tonic::server::NamedService;

use super::guest::Guest;
use super::incoming::{Incoming, KeptRooms};
use super::proto::gateway_server::GatewayServer;
use super::service::Service;
use super::slot::Slot;
use crate::budget::Room;

/// A service whose messages hold their room: incoming ones from their heads until they are handled, outgoing ones
/// until the connection has written and dropped them.
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
        // The only message of a call keeps its room until the reply is ready.
        let kept: Option<KeptRooms> = request.uri().path().ends_with("/Call").then(KeptRooms::default);
        let guest = request.extensions().get::<Arc<Guest>>().cloned();
        let request = match guest {
            Some(guest) => request.map(|body| Body::new(Incoming::new(body, guest, kept.clone()))),
            None => request,
        };
        let answered = self.0.call(request);
        Box::pin(async move {
            let mut response = answered.await?;
            drop(kept);
            let slot = response.extensions_mut().remove::<Slot>();
            Ok(match slot {
                Some(slot) => response.map(|body| Body::new(TrackedBody { body, slot })),
                None => response,
            })
        })
    }
}

/// The body of a response, with the room of its messages.
struct TrackedBody {
    body: Body,
    slot: Slot,
}

/// Bytes and their room.
struct BytesWithRoom {
    bytes: Bytes,
    _room: Room,
}

impl AsRef<[u8]> for BytesWithRoom {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl http_body::Body for TrackedBody {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(cx));
        let with_room = |bytes| match self.slot.take() {
            Some(_room) => Bytes::from_owner(BytesWithRoom { bytes, _room }),
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
