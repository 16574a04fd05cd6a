//! [`Call`]: a client's call of a service, on the network or of the gateway's own `rosapi`.

use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value as Json;
use tokio::sync::oneshot;

use super::envelope::{Compression, Envelope};
use super::input;
use super::op::{OpId, told};
use super::options::RosbridgeOptions;
use super::outbox::Outbox;
use super::rosapi::{RosApi, local_name};
use super::topics::fragment_id;
use crate::access::Right;
use crate::content::Content;
use crate::error::GatewayError;
use crate::session::{Session, action_of};

/// A client's call of a service.
#[derive(Clone, Debug)]
pub(super) struct Call {
    pub(super) id: Option<OpId>,
    pub(super) service: String,
    pub(super) type_name: Option<String>,
    pub(super) args: Option<String>,
    pub(super) max: Duration,
    pub(super) fragment_size: Option<NonZeroUsize>,
    pub(super) compression: Compression,
}

/// Answers a call that is refused before it begins.
pub(super) async fn refuse_call(id: &OpId, service: &str, why: &str, outbox: &Outbox) {
    let refused = Envelope::json("service_response").id(Some(id)).text("service", service);
    let refused = refused.text("values", why).value("result", &Json::Bool(false));
    let _ = outbox.say(refused.finish()).await;
}

/// A handle that ends a call or goal to which the client has lost its right.
pub(super) type End = oneshot::Sender<GatewayError>;

/// Waits for the end of a call or goal and returns the reason.
pub(super) async fn ended(end: &mut oneshot::Receiver<GatewayError>) -> GatewayError {
    match end.await {
        Ok(why) => why,
        // The sender is gone, so no end will come.
        Err(_) => std::future::pending().await,
    }
}

/// Calls the service and sends the reply, or the reason for which the call ended.
pub(super) async fn answer(
    session: Arc<Session>,
    options: Arc<RosbridgeOptions>,
    call: Call,
    mut end: oneshot::Receiver<GatewayError>,
    outbox: Outbox,
) {
    let why = tokio::select! {
        biased;
        why = ended(&mut end) => why,
        () = ask(&session, &options, &call, &outbox) => return,
    };
    let ended = Envelope::new("service_response", call.compression, 0).id(call.id.as_ref());
    let ended = ended.text("service", &call.service).text("values", &told(&why));
    let _ = outbox.say(ended.value("result", &Json::Bool(false)).finish()).await;
}

async fn ask(session: &Session, options: &RosbridgeOptions, call: &Call, outbox: &Outbox) {
    let envelope = |bytes: usize| {
        Envelope::new("service_response", call.compression, bytes)
            .id(call.id.as_ref())
            .text("service", &call.service)
    };
    let own = match local_name(&call.service) {
        Some(name) => {
            let api = RosApi { session, options };
            api.answer(name, call.args.as_deref().unwrap_or("{}")).await
        }
        None => None,
    };
    let (answered, is_done) = match own {
        Some(Ok(values)) => (envelope(0).value("values", &values), true),
        Some(Err(why)) => (envelope(0).text("values", &told(&why)), false),
        None => match on_network(session, call).await {
            Ok(values) => (envelope(values.len()).content("values", &values), true),
            Err(error) => (envelope(0).text("values", &told(&error)), false),
        },
    };
    let answered = answered.value("result", &Json::Bool(is_done));
    if let Err(error) = outbox.say_reply(answered.finish_in_pieces(call.fragment_size, fragment_id)).await {
        let refused = envelope(0).text("values", &told(&error)).value("result", &Json::Bool(false));
        let _ = outbox.say(refused.finish()).await;
    }
}

async fn on_network(session: &Session, call: &Call) -> Result<bytes::Bytes, GatewayError> {
    session.check(Right::Call, action_of(&call.service))?;
    let layout = || {
        let of = session.service_type(&call.service, call.type_name.as_deref())?;
        session.hub().types().layout(&format!("{of}_Request"), None)
    };
    let args = input::arguments(call.args.as_deref(), layout)?;
    let (service, type_name, form) = (&call.service, call.type_name.as_deref(), call.compression.form());
    let ask =
        |request: Content| async move { session.call(service, type_name, &request, form, call.max).await };
    input::tolerate_later(&args, ask).await
}
