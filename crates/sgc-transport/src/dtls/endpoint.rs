//! Making links over DTLS: an association first, then QUIC in it, with certificates in both.

use std::io;
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, OnceLock};

use quinn::{AsyncUdpSocket, Connection, Endpoint};
use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use tokio::sync::watch;
use tokio::time::timeout;

use super::mux::{Mux, Progress, RefusalReceiver, wait_for_end, wait_until_up};
use super::{front, keys};
use crate::credentials::CredentialStore;
use crate::direct::DirectHandle;
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

/// Dials links over DTLS. On each socket, every datagram from one address belongs to one association, so dials to one
/// address do not disturb each other. The first link to an address borrows the socket of QUIC if that is open for
/// direct links; any other has a socket of its own, and moves when the place is free.
pub(crate) struct DtlsDialer {
    shared: Arc<DialContext>,
}

/// Everything that dials and links need.
struct DialContext {
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    /// Set if links may borrow the sockets of QUIC.
    direct: OnceLock<DirectHandle>,
    /// Locked while a link changes its socket or ends.
    links: Mutex<Vec<DialSocket>>,
}

/// The socket of one link, twice: as the associations see it and as quinn does.
#[derive(Clone)]
struct DialSocket {
    remote: SocketAddr,
    mux: Arc<Mux>,
    endpoint: Endpoint,
    /// Whether it is borrowed.
    is_borrowed: Arc<AtomicBool>,
}

impl DialSocket {
    fn is(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.mux, &other.mux)
    }

    fn move_to(&self, io: Arc<dyn AsyncUdpSocket>) -> io::Result<()> {
        self.endpoint.rebind_abstract(self.mux.move_to(io))
    }
}

/// A dial that has not led to a link yet. Dropping it says goodbye.
struct Attempt {
    dialed: DialSocket,
    shared: Arc<DialContext>,
}

impl Drop for Attempt {
    fn drop(&mut self) {
        let (dialed, shared) = (self.dialed.clone(), Arc::clone(&self.shared));
        // Without the runtime nothing can be sent any more.
        if let Ok(runtime) = tokio::runtime::Handle::try_current() {
            // QUIC sends its close before, if there is a connection.
            runtime.spawn(async move {
                dialed.endpoint.wait_idle().await;
                dialed.mux.close();
                shared.end(&dialed);
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
        let (direct, links) = (OnceLock::new(), Mutex::default());
        Self { shared: Arc::new(DialContext { credentials, options, metrics, direct, links }) }
    }

    /// Lets links borrow these sockets. Call it before the first dial.
    pub(crate) fn open_direct(&self, direct: &DirectHandle) {
        let _ = self.shared.direct.set(direct.clone());
    }

    /// Dials these addresses in this order; errors name `url`.
    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        addresses: Vec<SocketAddr>,
        greeting: Greeting,
    ) -> Result<QuicLink, DialError> {
        let failed = |attempts| DialError::Failed { url: url.clone(), attempts };
        // A lane leaves the place to the link.
        let may_borrow = greeting.lane.is_none();
        let connect = |address| {
            let shared = Arc::clone(&self.shared);
            async move { shared.connect(address, may_borrow).await }
        };
        let (remote, connected) = race::first(addresses, connect).await.map_err(failed)?;
        let greeted = self.shared.greet(connected, greeting).await;
        let link = greeted.map_err(|e| failed(vec![(remote, e)]))?;
        self.shared.metrics.count_dialed();
        Ok(link)
    }

    /// Moves every link to a fresh socket. QUIC has done so with the borrowed ones.
    pub(crate) fn rebind(&self) -> io::Result<()> {
        let links = lock(&self.shared.links);
        for link in links.iter() {
            let is_borrowed = link.is_borrowed.load(Relaxed);
            let direct = self.shared.direct.get().filter(|_| is_borrowed);
            match direct.and_then(|direct| direct.borrow_again(link.remote, front::is_from_listener)) {
                Some(io) => link.move_to(io)?,
                None => link.move_to(self.shared.bind(link.remote)?)?,
            }
        }
        Ok(())
    }

    pub(crate) async fn close(&self, reason: &CloseReason) {
        let links = std::mem::take(&mut *lock(&self.shared.links));
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
    fn bind(&self, remote: SocketAddr) -> io::Result<Arc<dyn AsyncUdpSocket>> {
        Ok(socket::bind(socket::any_like(remote), &self.options)?.0)
    }

    async fn connect(
        self: Arc<Self>,
        remote: SocketAddr,
        may_borrow: bool,
    ) -> Result<UngreetedConnection, LinkError> {
        let direct = self.direct.get().filter(|_| may_borrow);
        let borrowed = direct.and_then(|direct| direct.borrow(remote, front::is_from_listener));
        let is_borrowed = Arc::new(AtomicBool::new(borrowed.is_some()));
        let io = borrowed.map_or_else(|| self.bind(remote), Ok)?;
        let (credentials, options) = (self.credentials.clone(), self.options.clone());
        let (mux, _) = Mux::start(true, io, credentials, options, Arc::clone(&self.metrics))?;
        let config = quic::endpoint_config(Flavor::Dtls, None, 0);
        let endpoint =
            Endpoint::new_with_abstract_socket(config, None, mux.socket(), Arc::new(PromptRuntime))?;
        let dialed = DialSocket { remote, mux, endpoint, is_borrowed };
        let attempt = Attempt { dialed, shared: Arc::clone(&self) };
        let dialed = &attempt.dialed;
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

    async fn greet(
        self: &Arc<Self>,
        connected: UngreetedConnection,
        greeting: Greeting,
    ) -> Result<QuicLink, LinkError> {
        let UngreetedConnection { attempt, connection, parts, peer, mut progress } = connected;
        let inner = parts.findings.verdict().and_then(|verdict| verdict.as_ref().ok());
        if inner.is_none_or(|inner| inner.node_id != peer.node_id) {
            let (code, text) = CloseReason::Protocol(ProtocolError::OtherNode.to_string()).to_wire();
            connection.close(quinn::VarInt::from_u32(code), text.as_bytes());
            return Err(ProtocolError::OtherNode.into());
        }
        let dialed = &attempt.dialed;
        let is_lane = greeting.lane.is_some();
        let is_borrowed = Arc::clone(&dialed.is_borrowed);
        let link = quic::greet(connection, parts, greeting, &self.options, is_borrowed).await?;
        lock(&self.links).push(dialed.clone());
        if let Some(direct) = self.direct.get().filter(|_| !is_lane && !dialed.is_borrowed.load(Relaxed)) {
            let shared = Arc::clone(self);
            tokio::spawn(shared.move_when_free(direct.clone(), dialed.clone(), progress.clone()));
        }
        link.end_with(async move { wait_for_end(&mut progress).await });
        // Dropping the attempt cleans up at the end of the link.
        Ok(link)
    }

    /// Moves a link to the socket of QUIC once no other link to its remote address is there, unless it ends before.
    async fn move_when_free(
        self: Arc<Self>,
        direct: DirectHandle,
        link: DialSocket,
        mut progress: watch::Receiver<Progress>,
    ) {
        let mut freed = direct.freed();
        let moved = async { while !self.try_move(&direct, &link) && freed.changed().await.is_ok() {} };
        tokio::select! {
            () = moved => {}
            _ = wait_for_end(&mut progress) => {}
        }
    }

    /// Moves a link to the socket of QUIC. Returns `false` if there is another one.
    fn try_move(&self, direct: &DirectHandle, link: &DialSocket) -> bool {
        // A rebind must not come in between.
        let links = lock(&self.links);
        if !links.iter().any(|other| other.is(link)) {
            return true;
        }
        let Some(io) = direct.borrow(link.remote, front::is_from_listener) else { return false };
        // The peer may tell the new address at once.
        link.is_borrowed.store(true, Relaxed);
        if let Err(error) = link.move_to(io) {
            tracing::debug!(%error, remote = %link.remote, "the link stays at a socket of its own");
        }
        true
    }

    /// Forgets a link, or a dial, and gives back the borrowed socket.
    fn end(&self, dialed: &DialSocket) {
        let mut links = lock(&self.links);
        links.retain(|link| !link.is(dialed));
        if dialed.is_borrowed.load(Relaxed)
            && let Some(direct) = self.direct.get()
        {
            direct.give_back(dialed.remote);
        }
    }
}
