//! [`Service`]: the methods of `gateway.proto`, each passed to its module.

use std::sync::Arc;
use std::time::Duration;

use tonic::metadata::MetadataMap;
use tonic::{Request, Response, Status, Streaming};

use super::fault::Fault;
use super::guest::{Guest, StreamKind};
use super::proto::gateway_server::Gateway;
use super::proto::{
    CallRequest, CallResponse, GetGraphRequest, GetGraphResponse, GetTypeRequest, GetTypeResponse,
    PublishRequest, PublishResponse, SendGoalRequest, SendGoalResponse, ServeActionRequest,
    ServeActionResponse, ServeRequest, ServeResponse, SubscribeRequest, SubscribeResponse, WatchGraphRequest,
    WatchGraphResponse,
};
use super::slot::{Responses, Slot, with_slot};
use super::{action, get_type, graph, publish, qos, serve, subscribe};
use crate::content::Content;

/// Time to wait for a reply if the client sets no deadline.
const CALL_WAIT_MAX: Duration = Duration::from_secs(3600);
/// A call ends this long before the client's deadline, but at most a tenth of it, so that the client learns which
/// server did not answer.
const CALL_MARGIN_MAX: Duration = Duration::from_millis(100);

/// The methods of the gateway. Each request has its guest among its extensions.
#[derive(Clone, Debug, Default)]
pub(super) struct Service(());

#[tonic::async_trait]
impl Gateway for Service {
    type WatchGraphStream = Responses<WatchGraphResponse>;
    type SubscribeStream = Responses<SubscribeResponse>;
    type ServeStream = Responses<ServeResponse>;
    type SendGoalStream = Responses<SendGoalResponse>;
    type ServeActionStream = Responses<ServeActionResponse>;

    async fn get_graph(
        &self,
        request: Request<GetGraphRequest>,
    ) -> Result<Response<GetGraphResponse>, Status> {
        let guest = Guest::from_request(&request)?;
        Ok(Response::new(graph::graph(&guest, request.get_ref().include_hidden)))
    }

    async fn watch_graph(
        &self,
        request: Request<WatchGraphRequest>,
    ) -> Result<Response<Self::WatchGraphStream>, Status> {
        let guest = Guest::from_request(&request)?;
        let place = guest.take(StreamKind::Watching)?;
        Ok(Response::new(graph::watch(place, request.get_ref().include_hidden)))
    }

    async fn get_type(&self, request: Request<GetTypeRequest>) -> Result<Response<GetTypeResponse>, Status> {
        let guest = Guest::from_request(&request)?;
        let (asked, name) = (Arc::clone(&guest), request.into_inner().r#type);
        let described = guest.session.hub().shared.network.run(move |network| {
            asked.session.check_type(&name)?;
            Ok(get_type::describe(&network.types, &name))
        });
        let described = described.await;
        Ok(Response::new(described.map_err(Fault::from)??))
    }

    async fn publish(
        &self,
        request: Request<Streaming<PublishRequest>>,
    ) -> Result<Response<PublishResponse>, Status> {
        let guest = Guest::from_request(&request)?;
        Ok(Response::new(publish::publish(guest, request.into_inner()).await?))
    }

    async fn subscribe(
        &self,
        request: Request<SubscribeRequest>,
    ) -> Result<Response<Self::SubscribeStream>, Status> {
        let guest = Guest::from_request(&request)?;
        Ok(subscribe::subscribe(guest, request.into_inner()).await?)
    }

    async fn call(&self, request: Request<CallRequest>) -> Result<Response<CallResponse>, Status> {
        let guest = Guest::from_request(&request)?;
        let max = deadline(request.metadata()).unwrap_or(CALL_WAIT_MAX).min(CALL_WAIT_MAX);
        let max = max.saturating_sub(CALL_MARGIN_MAX.min(max / 10));
        let CallRequest { service, r#type, encoding, payload } = request.into_inner();
        let form = qos::form(encoding)?;
        let content = Content { form, bytes: payload };
        let type_name = Some(&*r#type).filter(|name| !name.is_empty());
        // The call counts until there is room for its reply.
        let _place = guest.take(StreamKind::Call)?;
        let called = async {
            let payload = guest.session.call(&service, type_name, &content, form, max).await?;
            let room = guest.unread.take_for_reply(payload.len()).await?;
            Ok((payload, room))
        };
        let (payload, room) = guest.admitted(called).await?;
        let slot = Slot::default();
        slot.put(room);
        Ok(with_slot(CallResponse { payload }, slot))
    }

    async fn serve(
        &self,
        request: Request<Streaming<ServeRequest>>,
    ) -> Result<Response<Self::ServeStream>, Status> {
        let guest = Guest::from_request(&request)?;
        serve::serve(guest, request.into_inner()).await
    }

    async fn send_goal(
        &self,
        request: Request<Streaming<SendGoalRequest>>,
    ) -> Result<Response<Self::SendGoalStream>, Status> {
        let guest = Guest::from_request(&request)?;
        action::send_goal(guest, request.into_inner()).await
    }

    async fn serve_action(
        &self,
        request: Request<Streaming<ServeActionRequest>>,
    ) -> Result<Response<Self::ServeActionStream>, Status> {
        let guest = Guest::from_request(&request)?;
        action::serve(guest, request.into_inner()).await
    }
}

/// Returns the time that a client waits, from its `grpc-timeout` header: at most eight digits and a unit.
fn deadline(metadata: &MetadataMap) -> Option<Duration> {
    let text = metadata.get("grpc-timeout")?.to_str().ok()?;
    let (digits, unit) = text.split_at_checked(text.len().checked_sub(1)?)?;
    let number: u64 = digits.parse().ok().filter(|_| digits.len() <= 8)?;
    Some(match unit {
        "H" => Duration::from_secs(number * 3600),
        "M" => Duration::from_secs(number * 60),
        "S" => Duration::from_secs(number),
        "m" => Duration::from_millis(number),
        "u" => Duration::from_micros(number),
        "n" => Duration::from_nanos(number),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deadlines_are_read_as_grpc_has_them() {
        let read = |text: &str| {
            let mut metadata = MetadataMap::new();
            metadata.insert("grpc-timeout", text.parse().unwrap());
            deadline(&metadata)
        };
        assert_eq!(read("1500m"), Some(Duration::from_millis(1500)));
        assert_eq!(read("99999999H"), Some(Duration::from_secs(99_999_999 * 3600)));
        for wrong in ["", "m", "5", "5x", "100000000S", "-1S"] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
        assert_eq!(deadline(&MetadataMap::new()), None);
    }
}
