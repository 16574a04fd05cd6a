//! The gRPC front end: `sgc.gateway.v1`, with reflection and health.
//!
//! [`Grpc`] serves byte streams that others have accepted, each with its [`Connection`]. [`AccessWatch`] decides on
//! admission before a request is read, and ends all streams of a client when its rights end. Each credential on a
//! connection has one [`Session`](crate::Session), so the bounds hold for a program with any number of streams.
//! Reflection and health reveal nothing about the network and serve every client that can connect.
//!
//! This module opens no socket, does no TLS handshake and counts no connections: `server` does. Sessions deal with
//! the network.

mod action;
mod client;
mod connection;
mod conversation;
mod fault;
mod get_type;
mod graph;
mod guest;
mod incoming;
mod options;
pub mod proto;
mod publish;
mod qos;
mod serve;
mod service;
mod serving_task;
mod slot;
mod subscribe;
mod tracking;

use std::fmt;
use std::sync::Arc;
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio_stream::{Stream, StreamExt as _};
use tonic::service::Routes;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Server;

pub use connection::{AcceptedStream, Connection};
pub use fault::Fault;
pub use options::{GrpcOptions, MESSAGE_BYTES_MAX};

use crate::access_watch::AccessWatch;
use crate::hub::Hub;
use client::Clients;
use proto::gateway_server::GatewayServer;
use service::Service;
use tracking::Tracking;

/// Most streams of a connection. It exceeds the sum of a session's bounds, so that a client at a bound gets an error
/// instead of a stream that waits silently.
pub const STREAMS_MAX: u32 = 2048;
/// Most bytes of all headers of a request. A token takes at most a quarter.
const HEADER_BYTES_MAX: u32 = 32 << 10;
/// Bytes that a client may send on a stream before they are read.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;
/// Bytes that a client may send on all streams of a connection before they are read. A single stalled stream does not
/// use them up.
const CONNECTION_WINDOW_BYTES: u32 = 16 << 20;
/// Longest health request, in bytes, because every client that can connect may send one.
const HEALTH_BYTES_MAX: usize = 4 << 10;
/// Longest reflection request, in bytes.
const REFLECTION_BYTES_MAX: usize = 64 << 10;
/// Silence after which a client is pinged.
const PING_INTERVAL: Duration = Duration::from_secs(20);
/// Time within which a ping must be answered.
const PING_WAIT: Duration = Duration::from_secs(20);
/// Most streams that a client may open and reset before they are served. More are an attack (CVE-2023-44487).
const RESETS_MAX: usize = 64;

/// The front end. Clones share it. [`Grpc::stop`] or dropping the last clone ends all streams.
#[derive(Clone)]
pub struct Grpc {
    clients: Arc<Clients>,
    stopping: Arc<watch::Sender<bool>>,
}

impl Grpc {
    /// Serves a hub to clients that `access` admits. A client's streams end when its rights end.
    pub fn new(hub: Hub, access: AccessWatch, options: GrpcOptions) -> Self {
        let stopping = Arc::new(watch::Sender::new(false));
        let clients = Arc::new(Clients::new(hub, access, options, stopping.subscribe()));
        Self { clients, stopping }
    }

    /// Returns all services for an HTTP/2 server. Requests need a [`Connection`] among their extensions.
    ///
    /// # Errors
    /// The embedded descriptor is invalid.
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
        // The status is set before the first request, which would otherwise be answered with NOT_FOUND.
        reporter.set_serving::<GatewayServer<Service>>().await;
        let mut stopping = self.stopping.subscribe();
        self.clients.hub().shared.network.runtime.spawn(async move {
            let _ = stopping.wait_for(|is_stopping| *is_stopping).await;
            reporter.set_not_serving::<GatewayServer<Service>>().await;
        });
        Ok(Routes::new(admitted)
            .add_service(health.max_decoding_message_size(HEALTH_BYTES_MAX))
            .add_service(v1.max_decoding_message_size(REFLECTION_BYTES_MAX))
            .add_service(v1alpha.max_decoding_message_size(REFLECTION_BYTES_MAX))
            .prepare())
    }

    /// Serves connections until no more arrive and the existing ones have ended. [`Grpc::stop`] ends both.
    ///
    /// # Errors
    /// The errors of [`Grpc::routes`]. An error on a connection ends only that connection.
    pub async fn serve<IO>(&self, incoming: impl Stream<Item = AcceptedStream<IO>>) -> Result<(), Fault>
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

    /// Ends all streams, closes idle connections and accepts nothing new.
    pub fn stop(&self) {
        self.stopping.send_replace(true);
    }
}

/// Returns an HTTP/2 server within the bounds.
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
