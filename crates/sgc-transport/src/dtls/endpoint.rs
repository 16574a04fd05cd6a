//! Making links over DTLS: an association first, then QUIC in it, with certificates in both.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, Mutex};

use quinn::{Connection, Endpoint};
use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use tokio::sync::watch;
use tokio::time::timeout;

use super::keys;
use super::mux::{Mux, Progress, RefusalReceiver, wait_for_end, wait_until_up};
use crate::credentials::CredentialStore;
use crate::error::{CloseReason, DialError, LinkError, ProtocolError, Refusal};
use crate::framing::Greeting;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;
use crate::quic::{self, Flavor, Parts, QuicLink, QuicListener};
use crate::quinn_runtime::PromptRuntime;
use crate::url::LinkUrl;
use crate::{race, socket};

/// Awaits links over DTLS on one socket.
pub(crate) struct DtlsListener {
    mux: Arc<Mux>,
    quic: QuicListener,
    reports: RefusalReceiver,
}

impl DtlsListener {
    pub(crate) fn bind(
        addr: SocketAddr,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        if keys::scheme(&credentials.identity().certified_key()).is_none() {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, LinkError::KeyUnsupported));
        }
        let (io, _) = socket::bind(addr, &options)?;
        let (mux, reports) =
            Mux::start(false, io, credentials.clone(), options.clone(), Arc::clone(&metrics))?;
        let lower = Some(Arc::clone(&mux));
        let quic = QuicListener::on(Flavor::Dtls, mux.socket(), lower, credentials, options, metrics)?;
        Ok(Self { mux, quic, reports })
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        self.quic.local_addr()
    }

    pub(crate) async fn accept(&mut self) -> Option<Result<QuicLink, (SocketAddr, Refusal)>> {
        tokio::select! {
            result = self.quic.accept() => result,
            Some(report) = self.reports.recv() => Some(Err(report)),
        }
    }

    pub(crate) async fn close(&mut self, reason: &CloseReason) {
        self.quic.close(reason).await;
        self.mux.close();
    }
}

/// Dials links over DTLS, each from a socket of its own: every datagram there belongs to one association, and dials to
/// one address do not disturb each other.
pub(crate) struct DtlsDialer {
    shared: Arc<DialContext>,
    metrics: Arc<TransportMetrics>,
    links: Mutex<Vec<DialSocket>>,
}

/// Settings that every dial needs.
struct DialContext {
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
}

/// The socket of one link, twice: as the associations see it and as quinn does.
#[derive(Clone)]
struct DialSocket {
    remote: SocketAddr,
    mux: Arc<Mux>,
    endpoint: Endpoint,
}

/// A dial that has not led to a link yet. Dropping it says goodbye.
struct Attempt(DialSocket);

impl Drop for Attempt {
    fn drop(&mut self) {
        let DialSocket { mux, endpoint, .. } = self.0.clone();
        // Without the runtime nothing can be sent any more.
        if let Ok(runtime) = tokio::runtime::Handle::try_current() {
            // QUIC sends its close before, if there is a connection.
            runtime.spawn(async move {
                endpoint.wait_idle().await;
                mux.close();
            });
        }
    }
}

/// A connection that has not greeted.
struct UngreetedConnection {
    attempt: Attempt,
    connection: Connection,
    parts: Parts,
    peer: Box<VerifiedPeer>,
    progress: watch::Receiver<Progress>,
}

impl DtlsDialer {
    pub(crate) fn new(
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        let shared = DialContext { credentials, options, metrics: Arc::clone(&metrics) };
        Self { shared: Arc::new(shared), metrics, links: Mutex::default() }
    }

    /// Dials these addresses in this order; errors name `url`.
    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        addresses: Vec<SocketAddr>,
        greeting: Greeting,
    ) -> Result<QuicLink, DialError> {
        let failed = |attempts| DialError::Failed { url: url.clone(), attempts };
        let connect = |address| {
            let shared = Arc::clone(&self.shared);
            async move { shared.connect(address).await }
        };
        let (remote, connected) = race::first(addresses, connect).await.map_err(failed)?;
        let link = self.greet(connected, greeting).await.map_err(|e| failed(vec![(remote, e)]))?;
        self.metrics.count_dialed();
        Ok(link)
    }

    async fn greet(&self, connected: UngreetedConnection, greeting: Greeting) -> Result<QuicLink, LinkError> {
        let UngreetedConnection { attempt, connection, parts, peer, mut progress } = connected;
        let inner = parts.findings.verdict().and_then(|verdict| verdict.as_ref().ok());
        if inner.is_none_or(|inner| inner.node_id != peer.node_id) {
            let (code, text) = CloseReason::Protocol(ProtocolError::OtherNode.to_string()).to_wire();
            connection.close(quinn::VarInt::from_u32(code), text.as_bytes());
            return Err(ProtocolError::OtherNode.into());
        }
        let link = quic::greet(connection, parts, greeting, &self.shared.options).await?;
        link.end_with(async move { wait_for_end(&mut progress).await });
        let mut links = lock(&self.links);
        links.retain(|link| link.endpoint.open_connections() > 0);
        links.push(attempt.0.clone());
        // Dropping the attempt cleans up at the end of the link.
        Ok(link)
    }

    /// Moves every link to a fresh socket.
    pub(crate) fn rebind(&self) -> io::Result<()> {
        let mut links = lock(&self.links);
        links.retain(|link| link.endpoint.open_connections() > 0);
        for link in links.iter() {
            let (io, _) = socket::bind(socket::any_like(link.remote), &self.shared.options)?;
            link.endpoint.rebind_abstract(link.mux.move_to(io))?;
        }
        Ok(())
    }

    pub(crate) async fn close(&self, reason: &CloseReason) {
        let links = std::mem::take(&mut *lock(&self.links));
        let (code, text) = reason.to_wire();
        for link in &links {
            link.endpoint.close(quinn::VarInt::from_u32(code), text.as_bytes());
        }
        // The other peers notice the end by their own time-outs.
        let _ = timeout(quic::DRAIN_TIMEOUT, async {
            for link in &links {
                link.endpoint.wait_idle().await;
            }
        })
        .await;
    }
}

impl DialContext {
    async fn connect(&self, remote: SocketAddr) -> Result<UngreetedConnection, LinkError> {
        let (io, _) = socket::bind(socket::any_like(remote), &self.options)?;
        let (credentials, options) = (self.credentials.clone(), self.options.clone());
        let (mux, _) = Mux::start(true, io, credentials, options, Arc::clone(&self.metrics))?;
        let config = quic::endpoint_config(Flavor::Dtls, None, 0);
        let endpoint =
            Endpoint::new_with_abstract_socket(config, None, mux.socket(), Arc::new(PromptRuntime))?;
        let attempt = Attempt(DialSocket { remote, mux, endpoint });
        let dialed = &attempt.0;
        let mut progress = dialed.mux.dial(remote).ok_or(LinkError::KeyUnsupported)?;
        let peer = wait_until_up(&mut progress).await?;
        let (client, parts) = quic::client(Flavor::Dtls, &self.credentials, &self.options);
        let connecting = dialed
            .endpoint
            .connect_with(client, remote, quic::SERVER_NAME)
            .map_err(|e| LinkError::Transport(e.to_string()))?;
        let connecting = quic::finish(connecting, &parts.findings, &self.options);
        let connection = tokio::select! {
            connection = connecting => connection?,
            error = wait_for_end(&mut progress) => return Err(error),
        };
        Ok(UngreetedConnection { attempt, connection, parts, peer, progress })
    }
}
