//! Listening and dialling, whatever the transport.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use crate::credentials::CredentialStore;
use crate::error::{CloseReason, DialError, Refusal};
use crate::link::AnyLink;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;
use crate::quic::{QuicDialer, QuicListener};
use crate::url::{LinkUrl, ListenAddr, Scheme};

/// Awaits links at one address.
pub struct Listener {
    addr: ListenAddr,
    kind: Kind,
}

enum Kind {
    Quic(QuicListener),
}

impl Listener {
    /// Binds the address. Needs a tokio runtime around it. Each handshake uses what the store holds then.
    pub fn bind(
        addr: &ListenAddr,
        credentials: impl Into<CredentialStore>,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        match addr.scheme {
            Scheme::Quic => {
                let listener = QuicListener::bind(addr.addr, credentials.into(), options, metrics)?;
                let addr = ListenAddr { addr: listener.local_addr(), ..addr.clone() };
                Ok(Self { addr, kind: Kind::Quic(listener) })
            }
        }
    }

    /// The next link, or the next peer that was refused and why; `None` once closed.
    ///
    /// Handshakes run beside each other, as long as this is being awaited often enough to start them; at most
    /// [`LinkOptions::handshakes_max`] at once, each for at most [`LinkOptions::handshake_timeout`]. Refusals are
    /// counted already; logging them is the caller's. Dropping the future loses nothing.
    pub async fn accept(&mut self) -> Option<Result<AnyLink, RefusedPeer>> {
        match &mut self.kind {
            Kind::Quic(listener) => Some(match listener.accept().await? {
                Ok(link) => Ok(AnyLink::Quic(link)),
                Err((remote, reason)) => Err(RefusedPeer { remote, reason }),
            }),
        }
    }

    /// Where it listens, with the port that the system chose if it was to.
    pub fn local(&self) -> &ListenAddr {
        &self.addr
    }

    /// Closes the listener and every link that came by it, and gives their peers up to a second to hear of it.
    pub async fn close(mut self, reason: CloseReason) {
        match &mut self.kind {
            Kind::Quic(listener) => listener.close(&reason).await,
        }
    }
}

/// A peer that came to a [`Listener`] and has no link.
#[derive(Clone, Debug, thiserror::Error)]
#[error("{remote} is refused: {reason}")]
pub struct RefusedPeer {
    /// Where it came from.
    pub remote: SocketAddr,
    /// Why.
    pub reason: Refusal,
}

/// Dials links.
pub struct Dialer {
    quic: QuicDialer,
}

impl Dialer {
    /// A dialer with these credentials; each dial uses what the store holds then. Sockets are opened with the first
    /// dial and then shared by all.
    pub fn new(
        credentials: impl Into<CredentialStore>,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> Self {
        Self { quic: QuicDialer::new(credentials.into(), options, metrics) }
    }

    /// Makes a link: looks the host up, tries its addresses, and returns once the far node has accepted. It tries
    /// once; trying again is the caller's. Needs a tokio runtime around it.
    pub async fn dial(&self, url: &LinkUrl) -> Result<AnyLink, DialError> {
        match url.scheme {
            Scheme::Quic => self.quic.dial(url).await.map(AnyLink::Quic),
        }
    }

    /// Makes a link to these addresses, at most 8 of them, which the caller knows to be those of `url`.
    pub async fn dial_at(&self, url: &LinkUrl, addresses: Vec<SocketAddr>) -> Result<AnyLink, DialError> {
        match url.scheme {
            Scheme::Quic => self.quic.dial_at(url, addresses).await.map(AnyLink::Quic),
        }
    }

    /// Closes every link that it dialled, and gives their peers up to a second to hear of it.
    pub async fn close(&self, reason: CloseReason) {
        self.quic.close(&reason).await;
    }
}
