//! Conversations with a gateway, by the rosbridge protocol or Foxglove's. An input holds a client's messages, one a
//! line. No input panics, and the conversation ends when its client is gone.
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use bytes::BytesMut;
use futures_util::{SinkExt, StreamExt};
use sgc_gateway::rosbridge::RosbridgeOptions;
use sgc_gateway::{
    Client, Hub, HubOptions, Scope, Session, SessionLimits, ShippedDefinitions, Types, foxglove, rosbridge,
};
use sgc_testkit::{FakeDomain, FakeRos};
use sgc_websocket::WebSocket;
use tokio::runtime::{Builder, Runtime};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;

const PIPE_BYTES: usize = 1 << 20;
const MESSAGE_BYTES_MAX: usize = 64 << 20;
const MESSAGES_MAX: usize = 64;
const ENDS_WITHIN: Duration = Duration::from_secs(5);

struct Place {
    runtime: Runtime,
    hub: Hub,
    _domain: FakeDomain,
    _other: FakeRos,
}

fn place() -> &'static Place {
    static PLACE: OnceLock<Place> = OnceLock::new();
    PLACE.get_or_init(|| {
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        let domain = FakeDomain::default();
        let (own, other) = (Arc::new(domain.join(false)), domain.join(false));
        let hub =
            runtime.block_on(Hub::start(own, Types::new(ShippedDefinitions), HubOptions::default())).unwrap();
        Place { runtime, hub, _domain: domain, _other: other }
    })
}

/// Runs one input of the target.
pub fn run(input: &[u8]) {
    let [which, input @ ..] = input else { return };
    let Place { runtime, hub, .. } = place();
    let client = Client::own("stranger").with_scope(Scope::everything());
    let session = Arc::new(Session::new(hub, client, SessionLimits::default()));
    runtime.block_on(async {
        let (here, there) = tokio::io::duplex(PIPE_BYTES);
        let socket = WebSocket::new(there, BytesMut::new(), MESSAGE_BYTES_MAX);
        let served = async {
            match which % 2 {
                0 => drop(rosbridge::serve(socket, session, RosbridgeOptions::default()).await),
                _ => drop(foxglove::serve(socket, session, foxglove::Options::default()).await),
            }
        };
        let (mut say, mut hear) = WebSocketStream::from_raw_socket(here, Role::Client, None).await.split();
        let saying = async {
            for message in input.split(|byte| *byte == b'\n').take(MESSAGES_MAX) {
                let message = match std::str::from_utf8(message) {
                    Ok(text) if text.starts_with('{') => Message::text(text),
                    _ => Message::binary(message.to_vec()),
                };
                if say.send(message).await.is_err() {
                    return;
                }
            }
            let _ = say.close().await;
        };
        let hearing = async { while let Some(Ok(_)) = hear.next().await {} };
        let all = async { tokio::join!(served, saying, hearing) };
        tokio::time::timeout(ENDS_WITHIN, all).await.expect("the conversation does not end");
    });
}
