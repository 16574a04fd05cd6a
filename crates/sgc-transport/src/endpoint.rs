//! Listening and dialling, whatever the transport.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use sgc_wire::LaneToken;
use tokio::sync::mpsc;

use crate::any_link::AnyLink;
use crate::credentials::CredentialStore;
use crate::direct::{CheckDatagram, DirectHandle};
use crate::dtls::{DtlsDialer, DtlsListener};
use crate::error::{CloseReason, DialError, Refusal};
use crate::framing::Greeting;
use crate::metrics::TransportMetrics;
use crate::options::{BulkLanes, LinkOptions};
use crate::quic::{Flavor, QuicDialer, QuicListener};
use crate::race;
use crate::stream::{StreamDialer, StreamListener};
use crate::url::{LinkUrl, ListenAddr, Scheme};

/// Awaits links at one address.
pub struct Listener {
    addr: ListenAddr,
    kind: Kind,
}

enum Kind {
    Quic(QuicListener),
    /// The second takes bulk lanes of the first.
    QuicWithLanes(QuicListener, StreamListener),
    Stream(StreamListener),
    Dtls(DtlsListener),
}

impl Listener {
    /// Binds the address. Needs a tokio runtime around it. Each handshake uses what the store holds then.
    pub fn bind(
        addr: &ListenAddr,
        credentials: impl Into<CredentialStore>,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        let credentials = credentials.into();
        let (local, kind) = match addr.scheme {
            Scheme::Quic | Scheme::Udp => {
                let flavor = if addr.scheme == Scheme::Udp { Flavor::Udp } else { Flavor::Quic };
                let bind = |credentials, options, metrics| {
                    QuicListener::bind(flavor, addr.addr, credentials, options, metrics)
                };
                let listener = bind(credentials.clone(), options.clone(), Arc::clone(&metrics))?;
                let local = listener.local_addr();
                let announced_by_tls = options.bulk_lanes == BulkLanes::ByTlsListener;
                let lanes = if options.bulk_lanes == BulkLanes::Own && addr.scheme == Scheme::Quic {
                    let addr = ListenAddr::new(Scheme::Tls, local);
                    let lanes = StreamListener::bind_for_lanes(&addr, credentials, options, metrics);
                    lanes.inspect_err(|error| note_taken(local, error)).ok()
                } else {
                    None
                };
                if announced_by_tls || lanes.is_some() {
                    listener.announce_bulk_lanes();
                }
                match lanes {
                    Some(lanes) => (local, Kind::QuicWithLanes(listener, lanes)),
                    None => (local, Kind::Quic(listener)),
                }
            }
            Scheme::Dtls => {
                let listener = DtlsListener::bind(addr.addr, credentials, options, metrics)?;
                (listener.local_addr(), Kind::Dtls(listener))
            }
            Scheme::Tls | Scheme::Tcp | Scheme::Ws | Scheme::Wss => {
                let listener = StreamListener::bind(addr, credentials, options, metrics)?;
                (listener.local_addr(), Kind::Stream(listener))
            }
        };
        Ok(Self { addr: ListenAddr { addr: local, ..addr.clone() }, kind })
    }

    /// Returns the next link, or the next refused peer with the reason; `None` once closed.
    ///
    /// Handshakes run concurrently, as long as this is awaited often enough to start them: at most
    /// [`LinkOptions::handshakes_max`] at once, each for at most [`LinkOptions::handshake_timeout`]. Refusals are
    /// counted already; the caller logs them. Dropping the future loses nothing.
    pub async fn accept(&mut self) -> Option<Result<AnyLink, RefusedPeer>> {
        let result = match &mut self.kind {
            Kind::Quic(listener) => listener.accept().await?.map(AnyLink::Quic),
            Kind::QuicWithLanes(listener, lanes) => tokio::select! {
                link = listener.accept() => link?.map(AnyLink::Quic),
                lane = lanes.accept() => lane.map(AnyLink::Stream),
            },
            Kind::Dtls(listener) => listener.accept().await?.map(AnyLink::Quic),
            Kind::Stream(listener) => listener.accept().await.map(AnyLink::Stream),
        };
        Some(result.map_err(|(remote, reason)| RefusedPeer { remote, reason }))
    }

    /// Returns the local address, with the real port if the system chose it.
    pub fn local(&self) -> &ListenAddr {
        &self.addr
    }

    /// Closes the listener and every link that came by it, and gives their peers up to a second to hear of it.
    pub async fn close(mut self, reason: CloseReason) {
        match &mut self.kind {
            Kind::Quic(listener) => listener.close(&reason).await,
            Kind::QuicWithLanes(listener, lanes) => {
                tokio::join!(listener.close(&reason), lanes.close(&reason));
            }
            Kind::Stream(listener) => listener.close(&reason).await,
            Kind::Dtls(listener) => listener.close(&reason).await,
        }
    }
}

fn note_taken(local: SocketAddr, error: &io::Error) {
    tracing::info!("TCP port {} is not to be had ({error}); large topics stay on QUIC", local.port());
}

/// A peer that came to a [`Listener`] and got no link.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{remote} is refused: {reason}")]
pub struct RefusedPeer {
    /// The peer's address.
    pub remote: SocketAddr,
    /// The reason.
    pub reason: Refusal,
}

/// Everything that comes of [`Dialer::open_direct`].
pub struct DirectSockets {
    /// Accept the links of expected peers, one for each address family.
    pub listeners: Vec<Listener>,
    /// Checks that arrive.
    pub checks: mpsc::Receiver<CheckDatagram>,
    /// The sockets.
    pub handle: DirectHandle,
}

/// Dials links.
pub struct Dialer {
    resolve_timeout: Duration,
    quic: QuicDialer,
    udp: QuicDialer,
    stream: StreamDialer,
    dtls: DtlsDialer,
}

impl Dialer {
    /// Returns a dialer with these credentials; each dial uses the store's content at that time. Sockets are opened
    /// with the first dial and then shared by all.
    pub fn new(
        credentials: impl Into<CredentialStore>,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        let (credentials, resolve_timeout) = (credentials.into(), options.resolve_timeout);
        let quic =
            |flavor| QuicDialer::new(flavor, credentials.clone(), options.clone(), Arc::clone(&metrics));
        let (quic, udp) = (quic(Flavor::Quic), quic(Flavor::Udp));
        let dtls = DtlsDialer::new(credentials.clone(), options.clone(), Arc::clone(&metrics));
        let stream = StreamDialer::new(credentials, options, metrics);
        Self { resolve_timeout, quic, udp, dtls, stream }
    }

    /// Opens the sockets from which QUIC links are dialled for connectivity checks, and for links of peers that are
    /// expected after them. DTLS links are dialled from them as well, one at a time to each remote address. Call it
    /// before the first dial. Needs a tokio runtime around it.
    pub fn open_direct(&self) -> DirectSockets {
        let (handle, checks) = DirectHandle::new();
        let listen = |listener: QuicListener| Listener {
            addr: ListenAddr::new(Scheme::Quic, listener.local_addr()),
            kind: Kind::Quic(listener),
        };
        let listeners = self.quic.open_direct(&handle).into_iter().map(listen).collect();
        self.dtls.open_direct(&handle);
        DirectSockets { listeners, checks, handle }
    }

    /// Makes a link: looks the host up, tries its addresses, and returns once the far node has accepted. It tries once;
    /// the caller tries again. Needs a tokio runtime around it.
    pub async fn dial(&self, url: &LinkUrl) -> Result<AnyLink, DialError> {
        let addresses = race::resolve(url, self.resolve_timeout).await?;
        self.dial_at(url, addresses).await
    }

    /// Makes a link to these addresses, at most 8, which the caller knows to be those of `url`.
    pub async fn dial_at(&self, url: &LinkUrl, addresses: Vec<SocketAddr>) -> Result<AnyLink, DialError> {
        self.connect(url, addresses, None).await
    }

    /// Dials a lane of a link that leads to this address, with the token that was agreed on there.
    pub async fn dial_lane(
        &self,
        url: &LinkUrl,
        address: SocketAddr,
        token: LaneToken,
    ) -> Result<AnyLink, DialError> {
        self.connect(url, vec![address], Some(token)).await
    }

    /// Dials a bulk lane of a QUIC link that leads to this address, at the TCP port of the same number.
    pub async fn dial_bulk_lane(&self, address: SocketAddr, token: LaneToken) -> Result<AnyLink, DialError> {
        let (host, port) = (address.ip().to_string(), address.port());
        let url = LinkUrl { scheme: Scheme::Tls, host, port, path: None, cost_ms: None };
        self.connect(&url, vec![address], Some(token)).await
    }

    async fn connect(
        &self,
        url: &LinkUrl,
        addresses: Vec<SocketAddr>,
        lane: Option<LaneToken>,
    ) -> Result<AnyLink, DialError> {
        if addresses.is_empty() {
            return Err(DialError::NoAddress(url.clone()));
        }
        let greeting = Greeting { lane, bulk_lanes: false };
        match url.scheme {
            Scheme::Quic => self.quic.dial_at(url, addresses, lane).await.map(AnyLink::Quic),
            Scheme::Udp => self.udp.dial_at(url, addresses, lane).await.map(AnyLink::Quic),
            Scheme::Dtls => self.dtls.dial_at(url, addresses, greeting).await.map(AnyLink::Quic),
            Scheme::Tls | Scheme::Tcp | Scheme::Ws | Scheme::Wss => {
                self.stream.dial_at(url, addresses, greeting).await.map(AnyLink::Stream)
            }
        }
    }

    /// Closes every link that it dialled, and gives their peers up to a second to hear of it.
    pub async fn close(&self, reason: CloseReason) {
        tokio::join!(
            self.quic.close(&reason),
            self.udp.close(&reason),
            self.dtls.close(&reason),
            self.stream.close(&reason)
        );
    }

    /// Moves every link over datagrams to a fresh socket, so that it leaves by the interface that the system would
    /// choose now. Callers do this when addresses or routes have changed. Links live on, and lost packets are sent
    /// again. Every socket is tried; the first error is returned, and its links stay where they are.
    pub fn rebind(&self) -> io::Result<()> {
        // QUIC comes first: DTLS links may borrow its sockets.
        let results = [self.quic.rebind(), self.udp.rebind(), self.dtls.rebind()];
        results.into_iter().collect()
    }
}
