//! Connects to the first of a host's addresses that answers, the same for every transport.

use std::future::Future;
use std::net::SocketAddr;
use std::time::Duration;

use tokio::task::JoinSet;
use tokio::time::{sleep, timeout};

use crate::error::{DialError, LinkError};
use crate::url::LinkUrl;

/// Most addresses of one host that are tried.
pub(crate) const ADDRESSES_MAX: usize = 8;
/// Silence of one address after which the next is tried beside it (as in RFC 8305).
const STAGGER: Duration = Duration::from_millis(300);

/// Looks up the host of a URL. Returns at least one address.
pub(crate) async fn resolve(url: &LinkUrl, patience: Duration) -> Result<Vec<SocketAddr>, DialError> {
    let lookup = tokio::net::lookup_host((url.host.as_str(), url.port));
    let late = || std::io::Error::new(std::io::ErrorKind::TimedOut, "the resolver does not answer");
    let found = timeout(patience, lookup).await.unwrap_or_else(|_| Err(late()));
    let found = found.map_err(|source| DialError::Resolve { url: url.clone(), source })?;
    let mut addresses: Vec<SocketAddr> = Vec::new();
    for address in found.take(ADDRESSES_MAX) {
        if !addresses.contains(&address) {
            addresses.push(address);
        }
    }
    if addresses.is_empty() { Err(DialError::NoAddress(url.clone())) } else { Ok(addresses) }
}

/// Connects to the first address that answers. A later one is tried when an earlier fails or is silent.
pub(crate) async fn first<T, F>(
    addresses: Vec<SocketAddr>,
    mut connect: impl FnMut(SocketAddr) -> F,
) -> Result<(SocketAddr, T), Vec<(SocketAddr, LinkError)>>
where
    T: Send + 'static,
    F: Future<Output = Result<T, LinkError>> + Send + 'static,
{
    let mut rest = addresses.into_iter().take(ADDRESSES_MAX);
    let mut racing = JoinSet::new();
    let mut failed = Vec::new();
    loop {
        match rest.next() {
            Some(address) => {
                let attempt = connect(address);
                racing.spawn(async move { (address, attempt.await) });
            }
            None if racing.is_empty() => return Err(failed),
            None => {}
        }
        let has_more = rest.len() > 0;
        tokio::select! {
            Some(done) = racing.join_next() => match done {
                // The others are dropped with the set, before any of them has become a link at the far end.
                Ok((address, Ok(connected))) => return Ok((address, connected)),
                Ok((address, Err(error))) => failed.push((address, error)),
                Err(error) => tracing::error!(%error, "an attempt to connect ended abnormally"),
            },
            () = sleep(STAGGER), if has_more => {}
        }
    }
}
