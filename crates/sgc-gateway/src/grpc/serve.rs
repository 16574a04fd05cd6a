//! `Serve`: a service that a client serves. The client gets calls as they arrive and answers them in any order.

use std::collections::BTreeMap;
use std::sync::Arc;

use sgc_ros::RequestId;
use tonic::{Response, Status, Streaming};

use super::conversation::{Conversation, Responder, begin, first};
use super::fault::Fault;
use super::guest::{Guest, Place, StreamKind};
use super::proto::serve_request::{Kind as Said, Reply, Server};
use super::proto::serve_response::{Kind, Refused, Request, Served};
use super::proto::{ServeRequest, ServeResponse};
use super::qos;
use super::slot::Responses;
use crate::content::{Content, Form};
use crate::error::GatewayError;
use crate::service::{Replier, Serving};

/// Most unanswered calls. Beyond that the oldest can no longer be answered.
const OPEN_MAX: usize = 4096;
/// The required first request.
const ORDER: Fault = Fault::Order { what: "the service" };

/// A service that a client serves.
struct Work {
    place: Place,
    serving: Serving,
    replier: Replier,
    form: Form,
    open: BTreeMap<u64, RequestId>,
    last: u64,
}

/// Serves a service until its client closes the stream.
pub(super) async fn serve(
    guest: Arc<Guest>,
    mut requests: Streaming<ServeRequest>,
) -> Result<Response<Responses<ServeResponse>>, Status> {
    let place = guest.take(StreamKind::Serving)?;
    let Some(ServeRequest { kind: Some(Said::Server(server)) }) = first(&guest, &mut requests).await? else {
        return Err(ORDER.into());
    };
    let Server { service, r#type, encoding } = server;
    let form = qos::form(encoding)?;
    let said = Some(&*r#type).filter(|name| !name.is_empty());
    let type_name = guest.session.service_type(&service, said).map_err(Fault::from);
    let served = async { Ok(guest.session.serve(&service, said).await?) };
    let serving = guest.admitted(served).await?;
    let replier = serving.replier();
    let served = ServeResponse { kind: Some(Kind::Served(Served { r#type: type_name? })) };
    let work = Work { place, serving, replier, form, open: BTreeMap::new(), last: 0 };
    Ok(begin(work, requests, served))
}

impl Conversation for Work {
    type Request = ServeRequest;
    type Response = ServeResponse;

    fn place(&self) -> &Place {
        &self.place
    }

    async fn work(
        &mut self,
        mut requests: Streaming<ServeRequest>,
        told: &Responder<ServeResponse>,
    ) -> Result<(), Status> {
        loop {
            // The place for a response is reserved first, so that cancellation loses nothing.
            tokio::select! {
                said = requests.message() => {
                    let Some(said) = said? else { return Ok(()) };
                    let Some(Said::Reply(reply)) = said.kind else { return Err(ORDER.into()) };
                    let id = reply.id;
                    if let Err(why) = self.answer(reply).await {
                        let refused = Kind::Refused(Refused { id, reason: why.to_string() });
                        let _ = told.send((Ok(ServeResponse { kind: Some(refused) }), None)).await;
                    }
                }
                request = async {
                    let permit = told.reserve().await.ok()?;
                    Some((permit, self.serving.next().await))
                } => {
                    let Some((permit, request)) = request else { return Ok(()) };
                    let request = request.ok_or(Fault::from(GatewayError::Stopping))?;
                    match self.serving.write(&request, self.form) {
                        Ok(payload) => {
                            self.last += 1;
                            self.open.insert(self.last, request.id);
                            if self.open.len() > OPEN_MAX {
                                self.open.pop_first();
                            }
                            let room = self.place.guest.unread.take(payload.len()).await;
                            let kind = Kind::Request(Request { id: self.last, payload });
                            permit.send((Ok(ServeResponse { kind: Some(kind) }), room));
                        }
                        Err(error) => {
                            let service = self.serving.service();
                            tracing::debug!(%error, service, "a request that cannot be read is left out");
                        }
                    }
                }
            }
        }
    }
}

impl Work {
    async fn answer(&mut self, Reply { id, payload }: Reply) -> Result<(), Fault> {
        let open = *self.open.get(&id).ok_or(Fault::NotOpen { id })?;
        self.replier.reply(open, &Content { form: self.form, bytes: payload }).await?;
        self.open.remove(&id);
        Ok(())
    }
}
