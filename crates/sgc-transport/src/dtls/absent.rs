//! Stands in for DTLS in builds without the feature `dtls`: the same types, none of which can exist except for a
//! dialer that refuses.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;

use sgc_trust::VerifiedPeer;

use crate::credentials::CredentialStore;
use crate::direct::DirectHandle;
use crate::error::{CloseReason, DialError, LinkError, Refusal};
use crate::framing::Greeting;
use crate::metrics::TransportMetrics;
use crate::options::LinkOptions;
use crate::quic::QuicLink;
use crate::url::{LinkUrl, Scheme, UrlError};

/// Associations, of which there are none.
pub(crate) enum Mux {}

impl Mux {
    pub(crate) fn claim(&self, _: SocketAddr, _: &VerifiedPeer) -> Option<Claim> {
        match *self {}
    }
}

/// A claim to an association, of which there are none.
pub(crate) enum Claim {}

impl Claim {
    pub(crate) fn ended(&self) -> std::future::Ready<LinkError> {
        match *self {}
    }
}

/// A listener that cannot be bound.
pub(crate) enum DtlsListener {}

impl DtlsListener {
    pub(crate) fn bind(
        _: SocketAddr,
        _: CredentialStore,
        _: LinkOptions,
        _: Arc<TransportMetrics>,
    ) -> io::Result<Self> {
        Err(io::Error::new(io::ErrorKind::Unsupported, refusal()))
    }

    pub(crate) fn local_addr(&self) -> SocketAddr {
        match *self {}
    }

    #[expect(clippy::unused_async, reason = "the listener of the feature is asynchronous")]
    pub(crate) async fn accept(&mut self) -> Option<Result<QuicLink, (SocketAddr, Refusal)>> {
        match *self {}
    }

    #[expect(clippy::unused_async, reason = "the listener of the feature is asynchronous")]
    pub(crate) async fn close(&mut self, _: &CloseReason) {
        match *self {}
    }
}

/// A dialer that refuses every URL.
pub(crate) struct DtlsDialer;

impl DtlsDialer {
    pub(crate) fn new(_: CredentialStore, _: LinkOptions, _: Arc<TransportMetrics>) -> Self {
        Self
    }

    pub(crate) fn open_direct(&self, _: &DirectHandle) {}

    pub(crate) async fn dial_at(
        &self,
        url: &LinkUrl,
        _: Vec<SocketAddr>,
        _: Greeting,
    ) -> Result<QuicLink, DialError> {
        Err(DialError::NotBuilt { url: url.clone(), source: refusal() })
    }

    pub(crate) fn rebind(&self) -> io::Result<()> {
        Ok(())
    }

    pub(crate) async fn close(&self, _: &CloseReason) {}
}

fn refusal() -> UrlError {
    UrlError::NotBuilt { scheme: Scheme::Dtls, feature: "dtls" }
}
