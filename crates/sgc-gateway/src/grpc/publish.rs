//! `Publish`: a stream of messages on a topic. What is not read yet holds up its client: by HTTP/2, and so by what
//! publishing waits for.

use std::sync::Arc;
use std::time::Duration;

use futures_util::FutureExt as _;
use tonic::{Status, Streaming};

use super::client::{Guest, Taken};
use super::fault::Fault;
use super::proto::publish_request::{Kind, Publisher};
use super::proto::{PublishRequest, PublishResponse};
use super::qos;
use crate::content::Content;
use crate::error::GatewayError;
use crate::session::Advertise;

/// How long those readers are waited for that are there already: what is published before they are matched is lost to them.
const SETTLE_MAX: Duration = Duration::from_secs(1);
/// What is to come first.
const ORDER: Fault = Fault::Order { what: "the topic" };

/// Publishes what a client sends; says how much it was.
pub(super) async fn publish(
    guest: Arc<Guest>,
    mut requests: Streaming<PublishRequest>,
) -> Result<PublishResponse, Status> {
    let _place = guest.take(Taken::Publication)?;
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
    // Those that are there already leave together.
    let mut taken = 0;
    let failed = |taken: u64, error: GatewayError| {
        let number = match error {
            // Which may be one before that which was taken last.
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
