//! The gRPC front end: `sgc.gateway.v1`, with reflection and health beside it.
//!
//! [`Grpc`] serves streams of bytes that others have accepted, each with what is known of its other end ([`Connection`]).
//! [`AccessWatch`] decides whom it admits, before anything of a request is read, and ends all that a client has when its right
//! ends. Each connection has one
//! [`Session`](crate::Session) for each credential that is shown on it, so bounds are those of a program, however many
//! streams it has. Reflection and health tell nothing of the network and are for everybody who can connect.
//!
//! It opens no socket, makes no TLS handshake and counts no connections: `server` does. What comes and goes on the network is
//! the business of sessions.

mod action;
mod client;
mod connection;
mod conversation;
mod fault;
mod graph;
mod incoming;
mod publish;
mod qos;
mod serve;
mod service;
mod subscribe;
mod tracking;
mod types;

/// What is generated from `proto/sgc/gateway/v1/gateway.proto`, whose words explain it.
pub mod proto {
    #![allow(missing_docs, unreachable_pub, rustdoc::all, reason = "generated")]
    #![allow(clippy::all, clippy::disallowed_types, reason = "generated")]

    include!("generated/sgc.gateway.v1.rs");

    /// The file itself, as reflection tells it.
    pub const DESCRIPTOR: &[u8] = include_bytes!("generated/descriptor.bin");
}

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio_stream::{Stream, StreamExt as _};
use tonic::service::Routes;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Server;

pub use connection::{Accepted, Connection};
pub use fault::Fault;

use crate::access_watch::AccessWatch;
use crate::hub::Hub;
use crate::session::SessionLimits;
use client::Clients;
use proto::gateway_server::GatewayServer;
use service::Service;
use tracking::Tracking;

/// Longest message of gRPC, either way, bytes: images take 13 MB.
pub const MESSAGE_BYTES_MAX: usize = 64 << 20;
/// Streams of a connection. More than a session may have of everything, so that who has too much is told so; what waits for
/// a stream is told nothing.
pub const STREAMS_MAX: u32 = 2048;
/// All headers of a request, bytes; a token is at most a quarter of it.
const HEADER_BYTES_MAX: u32 = 32 << 10;
/// What a client may send on a stream before it is read, bytes.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;
/// The same of all streams of a connection: so many may stand still before others do.
const CONNECTION_WINDOW_BYTES: u32 = 16 << 20;
/// Longest request for health, bytes: whoever can connect may send it.
const HEALTH_BYTES_MAX: usize = 4 << 10;
/// The same of reflection.
const REFLECTION_BYTES_MAX: usize = 64 << 10;
/// After so long without a sign of life a client is asked for one.
const PING_INTERVAL: Duration = Duration::from_secs(20);
/// So long it may take to give it.
const PING_WAIT: Duration = Duration::from_secs(20);
/// Streams that a client opened and reset before they were served: more are an attack (CVE-2023-44487).
const RESETS_MAX: usize = 64;

/// What a front end is to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GrpcOptions {
    /// What a client may have at a time: one credential on one connection.
    pub session: SessionLimits,
    /// Bytes of long messages that a client has not read yet though they were sent, of all its streams: further ones wait.
    pub unread_bytes_max: usize,
    /// Bytes of long messages that a client may send at a time, on all its streams: from the head of each until it is worked
    /// on. Streams that would send more are refused.
    pub incoming_bytes_max: usize,
}

impl Default for GrpcOptions {
    fn default() -> Self {
        Self {
            session: SessionLimits::default(),
            unread_bytes_max: 4 * MESSAGE_BYTES_MAX,
            incoming_bytes_max: 4 * MESSAGE_BYTES_MAX,
        }
    }
}

/// The front end. Clones are the same one; when the last is dropped, as with [`Grpc::stop`], streams end.
#[derive(Clone)]
pub struct Grpc {
    clients: Arc<Clients>,
    stopping: Arc<watch::Sender<bool>>,
}

impl Grpc {
    /// Serves a hub to those whom `access` admits. A client loses its streams the moment its right ends.
    pub fn new(hub: Hub, access: AccessWatch, options: GrpcOptions) -> Self {
        let stopping = Arc::new(watch::Sender::new(false));
        let clients = Arc::new(Clients::new(hub, access, options, stopping.subscribe()));
        Self { clients, stopping }
    }

    /// All services, for whoever has an HTTP/2 server: requests must have a [`Connection`] among their extensions.
    ///
    /// # Errors
    /// None but that the descriptor which this was built with is broken.
    pub async fn routes(&self) -> Result<Routes, Fault> {
        let gateway = GatewayServer::new(Service::default())
            .max_decoding_message_size(MESSAGE_BYTES_MAX)
            .max_encoding_message_size(MESSAGE_BYTES_MAX);
        let clients = Arc::clone(&self.clients);
        let admit = move |mut request: tonic::Request<()>| {
            let client = clients.admit(&request)?;
            request.extensions_mut().insert(client);
            Ok(request)
        };
        let admitted = InterceptedService::new(Tracking::new(gateway), admit);
        let described = || {
            tonic_reflection::server::Builder::configure()
                .register_encoded_file_descriptor_set(proto::DESCRIPTOR)
        };
        let broken = |error: tonic_reflection::server::Error| Fault::Descriptor(error.to_string());
        let v1 = described().build_v1().map_err(broken)?;
        let v1alpha = described().build_v1alpha().map_err(broken)?;
        let (reporter, health) = tonic_health::server::health_reporter();
        // Before the first request, which a client would otherwise see answered with NOT_FOUND.
        reporter.set_serving::<GatewayServer<Service>>().await;
        let mut stopping = self.stopping.subscribe();
        self.clients.hub().shared.runtime.spawn(async move {
            let _ = stopping.wait_for(|is_stopping| *is_stopping).await;
            reporter.set_not_serving::<GatewayServer<Service>>().await;
        });
        Ok(Routes::new(admitted)
            .add_service(health.max_decoding_message_size(HEALTH_BYTES_MAX))
            .add_service(v1.max_decoding_message_size(REFLECTION_BYTES_MAX))
            .add_service(v1alpha.max_decoding_message_size(REFLECTION_BYTES_MAX))
            .prepare())
    }

    /// Serves connections for as long as there are new ones, and until those that are there have ended: [`Grpc::stop`] ends
    /// both.
    ///
    /// # Errors
    /// As [`Grpc::routes`]; what fails on one connection ends that one.
    pub async fn serve<IO>(&self, incoming: impl Stream<Item = Accepted<IO>>) -> Result<(), Fault>
    where
        IO: AsyncRead + AsyncWrite + Unpin + Send + 'static,
    {
        let mut stopping = self.stopping.subscribe();
        let stopped = async move {
            let _ = stopping.wait_for(|is_stopping| *is_stopping).await;
        };
        let incoming = incoming.map(Ok::<_, std::convert::Infallible>);
        let served =
            builder().add_routes(self.routes().await?).serve_with_incoming_shutdown(incoming, stopped).await;
        served.map_err(|error| Fault::Transport(error.to_string()))
    }

    /// Ends all streams, and connections once they are empty; takes in nothing new.
    pub fn stop(&self) {
        self.stopping.send_replace(true);
    }
}

/// HTTP/2 within bounds.
fn builder() -> Server {
    Server::builder()
        .max_concurrent_streams(STREAMS_MAX)
        .http2_max_header_list_size(HEADER_BYTES_MAX)
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size(CONNECTION_WINDOW_BYTES)
        .http2_max_pending_accept_reset_streams(Some(RESETS_MAX))
        .http2_keepalive_interval(Some(PING_INTERVAL))
        .http2_keepalive_timeout(Some(PING_WAIT))
}

impl fmt::Debug for Grpc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Grpc").field("hub", self.clients.hub()).finish_non_exhaustive()
    }
}
