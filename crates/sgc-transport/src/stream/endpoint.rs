//! Making links over TCP: listening and dialling.
//!
//! A link is handed out only after both certificates were verified and the greetings were exchanged, as over QUIC.

use std::io::{self, Write as _};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, Weak};
use std::time::{Duration, Instant};

use sgc_sync::lock;
use tokio::net::{TcpListener, TcpStream};
use tokio::task::{AbortHandle, JoinSet};
use tokio::time::{sleep, timeout};

use super::StreamLink;
use super::driver::{DRAIN_TIMEOUT, run};
use super::halves::{LinkInfo, LinkInner};
use super::handshake::{self, EstablishedStream};
use crate::credentials::CredentialStore;
use crate::error::{CloseReason, DialError, LinkError, Refusal};
use crate::framing::Greeting;
use crate::handshakes::{Entry, Handshakes, Holder};
use crate::link::Link as _;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;
use crate::race;
use crate::url::{LinkUrl, ListenAddr, Scheme};

/// Connections that the kernel keeps until they are accepted.
const BACKLOG: i32 = 1024;
/// Pause when no connection can be accepted, for want of file descriptors for instance.
const ACCEPT_PAUSE: Duration = Duration::from_millis(100);
/// A TLS alert, `internal_error`, before any keys: tells a dialer that there is no time for it.
const ALERT_OVERLOADED: [u8; 7] = [21, 3, 3, 0, 2, 2, 80];
const HTTP_OVERLOADED: &[u8] =
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 0\r\nConnection: close\r\n\r\n";

/// Awaits links on one TCP socket.
pub(crate) struct StreamListener {
    tcp: TcpListener,
    local: SocketAddr,
    acceptor: Arc<Acceptor>,
    handshakes: JoinSet<(SocketAddr, Result<StreamLink, Refusal>)>,
    places: Handshakes<Slot>,
}

/// State that every incoming handshake needs.
struct Acceptor {
    scheme: Scheme,
    path: String,
    /// Whether only lanes are taken, no links.
    only_lanes: bool,
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    links: Links,
}

/// A handshake under way.
struct Slot {
    remote: SocketAddr,
    task: AbortHandle,
    /// Set once the peer has sent something.
    has_spoken: Arc<AtomicBool>,
}

impl Holder for Slot {
    fn remote(&self) -> SocketAddr {
        self.remote
    }

    fn is_pending(&self) -> bool {
        !self.task.is_finished()
    }

    fn is_engaged(&self) -> bool {
        self.has_spoken.load(Relaxed)
    }
}

impl StreamListener {
    pub(crate) fn bind(
        addr: &ListenAddr,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        Self::bind_as(addr, false, credentials, options, metrics)
    }

    /// Listens for lanes only.
    pub(crate) fn bind_for_lanes(
        addr: &ListenAddr,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        Self::bind_as(addr, true, credentials, options, metrics)
    }

    fn bind_as(
        addr: &ListenAddr,
        only_lanes: bool,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        let tcp = listen(addr.addr)?;
        let local = tcp.local_addr()?;
        let (scheme, path) = (addr.scheme, addr.path().to_owned());
        let places = Handshakes::new(&options);
        let acceptor = Arc::new(Acceptor {
            scheme,
            path,
            only_lanes,
            credentials,
            options,
            metrics,
            links: Links::default(),
        });
        Ok(Self { tcp, local, acceptor, handshakes: JoinSet::new(), places })
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        self.local
    }

    pub(crate) async fn accept(&mut self) -> Result<StreamLink, (SocketAddr, Refusal)> {
        loop {
            tokio::select! {
                Some(done) = self.handshakes.join_next() => match done {
                    Ok((_, Ok(link))) => return Ok(link),
                    Ok((remote, Err(refusal))) => return Err((remote, refusal)),
                    Err(error) if error.is_cancelled() => {}
                    Err(error) => tracing::error!(%error, "a handshake ended abnormally"),
                },
                incoming = self.tcp.accept() => match incoming {
                    Ok((tcp, remote)) => {
                        let remote = canonical(remote);
                        if let Some(refused) = self.admit(tcp, remote) {
                            return Err(refused);
                        }
                    }
                    Err(error) => {
                        tracing::debug!(%error, "no connection can be accepted");
                        sleep(ACCEPT_PAUSE).await;
                    }
                },
            }
        }
    }

    pub(crate) async fn close(&mut self, reason: &CloseReason) {
        self.handshakes.abort_all();
        self.acceptor.links.close(reason).await;
    }

    /// Starts the handshake of a peer that has a place, and returns its refusal. Connections that are opened and left
    /// alone keep nobody out: they are not engaged, and give way.
    fn admit(&mut self, tcp: TcpStream, remote: SocketAddr) -> Option<(SocketAddr, Refusal)> {
        let now = Instant::now();
        let Entry { is_admitted, evicted, refused } =
            self.places.make_room(remote, now, &self.acceptor.metrics);
        if let Some(slot) = evicted {
            slot.task.abort();
        }
        if !is_admitted {
            self.acceptor.turn_away(tcp);
            return refused;
        }
        let acceptor = Arc::clone(&self.acceptor);
        let has_spoken = Arc::<AtomicBool>::default();
        let (pending, spoken) = (acceptor.metrics.pending(), Arc::clone(&has_spoken));
        let task = self.handshakes.spawn(async move {
            let _pending = pending;
            (remote, acceptor.handshake(tcp, remote, &spoken).await)
        });
        self.places.take(now, Slot { remote, task, has_spoken });
        refused
    }
}

impl Acceptor {
    async fn handshake(
        &self,
        tcp: TcpStream,
        remote: SocketAddr,
        spoken: &AtomicBool,
    ) -> Result<StreamLink, Refusal> {
        let after = self.options.handshake_timeout;
        let made = async {
            // In every scheme the dialer speaks first.
            if matches!(tcp.peek(&mut [0]).await, Ok(1..)) {
                spoken.store(true, Relaxed);
            }
            handshake::accept(tcp, self.scheme, &self.path, &self.credentials, &self.options).await
        };
        match timeout(after, made).await.unwrap_or(Err(Refusal::TimedOut { after })) {
            Ok(made) if self.only_lanes && made.lane.is_none() => {
                let link = self.links.start(made, remote, false, &self.options);
                link.close(CloseReason::Denied(Refusal::NoLane.to_string()));
                self.metrics.count_refused(Refusal::NoLane.kind());
                Err(Refusal::NoLane)
            }
            Ok(made) => {
                self.metrics.count_accepted();
                Ok(self.links.start(made, remote, false, &self.options))
            }
            Err(refusal) => {
                self.metrics.count_refused(refusal.kind());
                Err(refusal)
            }
        }
    }

    /// Tells a dialer that there is no time for it now, if that costs nothing.
    fn turn_away(&self, tcp: TcpStream) {
        let text = if self.scheme == Scheme::Ws { HTTP_OVERLOADED } else { &ALERT_OVERLOADED };
        if let Ok(mut tcp) = tcp.into_std() {
            let _ = tcp.write(text);
        }
    }
}

/// Dials links over TCP.
pub(crate) struct StreamDialer {
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    links: Links,
}

impl StreamDialer {
    pub(crate) fn new(
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        Self { credentials, options, metrics, links: Links::default() }
    }

    /// Dials these addresses in this order; errors name `url`.
    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        addresses: Vec<SocketAddr>,
        greeting: Greeting,
    ) -> Result<StreamLink, DialError> {
        let failed = |attempts| DialError::Failed { url: url.clone(), attempts };
        let after = self.options.handshake_timeout;
        let late = LinkError::HandshakeTimedOut { after };
        let connect = |address| {
            let (url, credentials, options) = (url.clone(), self.credentials.clone(), self.options.clone());
            let late = late.clone();
            async move {
                let dialled = async {
                    let tcp = TcpStream::connect(address).await.map_err(unconnected)?;
                    handshake::dial(tcp, &url, &credentials, &options).await
                };
                timeout(after, dialled).await.unwrap_or(Err(late))
            }
        };
        let (remote, secured) = race::first(addresses, connect).await.map_err(failed)?;
        let made = timeout(after, secured.greet(greeting)).await.unwrap_or(Err(late));
        let made = made.map_err(|e| failed(vec![(remote, e)]))?;
        self.metrics.count_dialed();
        Ok(self.links.start(made, canonical(remote), true, &self.options))
    }

    pub(crate) async fn close(&self, reason: &CloseReason) {
        self.links.close(reason).await;
    }
}

/// Makes a link of a stream, and starts its task.
pub(super) fn start(
    made: EstablishedStream,
    remote: SocketAddr,
    is_dialer: bool,
    options: &LinkOptions,
) -> (StreamLink, Arc<LinkInner>) {
    let EstablishedStream { wire, counters, peer, lane, rtt, key_exchange, mtu_bytes } = made;
    let shared = LinkInner::new(options, counters);
    shared.lock().mux.note_handshake(rtt);
    sgc_executor::spawn(run(wire, Arc::clone(&shared), options.idle_timeout));
    let about = LinkInfo { remote, is_dialer, lane, key_exchange, mtu_bytes };
    (StreamLink::new(Arc::clone(&shared), peer, about), shared)
}

/// The links of one endpoint, to be closed with it.
#[derive(Default)]
struct Links {
    all: Mutex<Vec<Weak<LinkInner>>>,
}

impl Links {
    fn start(
        &self,
        made: EstablishedStream,
        remote: SocketAddr,
        is_dialer: bool,
        options: &LinkOptions,
    ) -> StreamLink {
        let (link, shared) = start(made, remote, is_dialer, options);
        let mut all = lock(&self.all);
        if all.len() == all.capacity() {
            all.retain(|link| link.strong_count() > 0);
        }
        all.push(Arc::downgrade(&shared));
        link
    }

    /// Closes all links, and gives their peers a while to hear of it.
    async fn close(&self, reason: &CloseReason) {
        let all = std::mem::take(&mut *lock(&self.all));
        let all: Vec<_> = all.iter().filter_map(Weak::upgrade).collect();
        for link in &all {
            link.close(reason, LinkError::Closed { by_peer: false, reason: reason.clone() });
        }
        let drained = async {
            for link in &all {
                link.drained().await;
            }
        };
        let _ = timeout(DRAIN_TIMEOUT, drained).await;
    }
}

/// Opens a socket, for both families if its address is that of every interface.
fn listen(addr: SocketAddr) -> io::Result<TcpListener> {
    use socket2::{Domain, Protocol, Socket, Type};
    let socket = Socket::new(Domain::for_address(addr), Type::STREAM, Some(Protocol::TCP))?;
    if addr.is_ipv6() {
        socket.set_only_v6(false)?;
    }
    // Connections that have ended do not keep the next run from listening.
    socket.set_reuse_address(true)?;
    socket.set_nonblocking(true)?;
    socket.bind(&addr.into())?;
    socket.listen(BACKLOG)?;
    TcpListener::from_std(socket.into())
}

fn unconnected(error: io::Error) -> LinkError {
    match error.kind() {
        io::ErrorKind::ConnectionRefused => LinkError::NobodyListens,
        _ => error.into(),
    }
}

/// IPv4 peers of a socket for both families appear as IPv6 addresses otherwise.
fn canonical(address: SocketAddr) -> SocketAddr {
    SocketAddr::new(address.ip().to_canonical(), address.port())
}
