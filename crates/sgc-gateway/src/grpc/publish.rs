//! `Publish`: a stream of messages on a topic. Flow control of HTTP/2 slows the client down when publishing waits for
//! readers.

use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt as _;
use tonic::{Status, Streaming};

use super::fault::Fault;
use super::guest::{Guest, StreamKind};
use super::proto::publish_request::{Kind, Publisher};
use super::proto::{PublishRequest, PublishResponse};
use super::qos;
use crate::content::Content;
use crate::error::GatewayError;
use crate::session::Advertise;

/// Time to wait for existing readers, which lose messages published before they are matched.
const SETTLE_MAX: Duration = Duration::from_secs(1);
/// The required first request.
const ORDER: Fault = Fault::Order { what: "the topic" };

/// Publishes a client's messages and returns their number.
pub(super) async fn publish(
    guest: Arc<Guest>,
    mut requests: Streaming<PublishRequest>,
) -> Result<PublishResponse, Status> {
    let _place = guest.take(StreamKind::Publication)?;
    let next = async |requests: &mut Streaming<PublishRequest>| {
        tokio::select! {
            biased;
            why = guest.ended() => Err(Status::from(why)),
            next = requests.message() => next,
        }
    };
    let Some(PublishRequest { kind: Some(Kind::Publisher(publisher)) }) = next(&mut requests).await? else {
        return Err(ORDER.into());
    };
    let form = qos::form(publisher.encoding)?;
    let wanted = wanted(publisher)?;
    let advertised = async {
        let publication = guest.session.advertise(wanted).await?;
        publication.settle(SETTLE_MAX).await;
        Ok(publication)
    };
    let publication = guest.admitted(advertised).await?;
    // Messages that have already arrived are sent together.
    let mut taken = 0;
    let failed = |taken: u64, error: GatewayError| {
        let number = match error {
            // The failed message may be an earlier one than the last one read.
            GatewayError::Ros(_) => publication.published() + 1,
            _ => taken,
        };
        Fault::Message { number, error: Box::new(error) }
    };
    let flush = async |taken: u64| {
        guest.admitted(async { publication.flush().await.map_err(|error| failed(taken, error)) }).await
    };
    loop {
        let request = match next(&mut requests).now_or_never() {
            Some(request) => request?,
            None => {
                flush(taken).await?;
                next(&mut requests).await?
            }
        };
        let Some(request) = request else { break };
        let Some(Kind::Payload(bytes)) = request.kind else { return Err(ORDER.into()) };
        let content = Content { form, bytes };
        taken += 1;
        let publishing = publication.publish_ahead(&content);
        guest.admitted(async { publishing.await.map_err(|error| failed(taken, error)) }).await?;
    }
    flush(taken).await?;
    Ok(PublishResponse { published: publication.published() })
}

fn wanted(publisher: Publisher) -> Result<Advertise, Fault> {
    Ok(Advertise {
        topic: publisher.topic,
        type_name: Some(publisher.r#type).filter(|name| !name.is_empty()),
        qos: publisher.qos.as_ref().map(qos::from_proto).transpose()?.unwrap_or_default(),
    })
}
