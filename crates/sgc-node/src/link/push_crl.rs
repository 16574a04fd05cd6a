//! Pushes a revocation list to a router and receives the router's lists, for a fleet keeper who runs no node.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_transport::{
    CloseReason, DialError, Dialer, Link, LinkError, LinkOptions, LinkUrl, TransportMetrics,
};
use sgc_trust::Identity;
use sgc_wire::{Control, Decode, Encode, Hello, MINOR_VERSION, UnixMillis};

/// Time for a router to greet and to answer a goodbye.
const ANSWER_MAX: Duration = Duration::from_secs(5);

/// Reasons why a list was not pushed.
#[derive(Debug, thiserror::Error)]
pub enum PushCrlError {
    /// The router could not be dialled.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The link ended.
    #[error("the link to {url} ended: {source}")]
    Link {
        /// The router.
        url: LinkUrl,
        /// The reason.
        source: LinkError,
    },
    /// The router did not answer.
    #[error("{url} did not answer within {} s", ANSWER_MAX.as_secs())]
    Silent {
        /// The router.
        url: LinkUrl,
    },
}

/// Most lists that are received of a router: all lists of as many CAs as can be trusted.
const HEARD_MAX: usize = sgc_trust::ANCHORS_MAX * (sgc_trust::FLEET_LISTS_MAX + 1);

/// Dials a router, greets it, sends the list and leaves. The router has the list once this returns. Returns the
/// router's lists, which it sends every neighbour.
pub async fn push_crl(
    url: &LinkUrl,
    identity: Arc<Identity>,
    list: Bytes,
) -> Result<Vec<Bytes>, PushCrlError> {
    let dialer = Dialer::new(identity, LinkOptions::default(), Arc::new(TransportMetrics::default()));
    let link = dialer.dial(url).await?;
    let told = tokio::time::timeout(ANSWER_MAX, tell(&link, list)).await;
    dialer.close(CloseReason::Goodbye).await;
    match told {
        Ok(Ok(heard)) => Ok(heard),
        Ok(Err(source)) => Err(PushCrlError::Link { url: url.clone(), source }),
        Err(_) => Err(PushCrlError::Silent { url: url.clone() }),
    }
}

async fn tell(link: &impl Link, list: Bytes) -> Result<Vec<Bytes>, LinkError> {
    let mut incarnation = [0; 8];
    // The incarnation differs from that of any run of a node. No decision depends on it.
    incarnation.copy_from_slice(&link.peer().node_id.0[..8]);
    let hello = Hello {
        minor: MINOR_VERSION,
        incarnation: u64::from_be_bytes(incarnation),
        transit: false,
        yields: true,
        started: UnixMillis::default(),
    };
    link.send_control(Control::Hello(hello).to_bytes()).await?;
    // The greeting comes first and shows that the peer is a node of this protocol version.
    while !matches!(Control::from_slice(&link.recv_control().await?), Ok(Control::Hello(_))) {}
    link.send_control(Control::Crl { der: list }.to_bytes()).await?;
    link.send_control(Control::Goodbye.to_bytes()).await?;
    // The router sends its lists after its greeting. It answers the goodbye by closing, after it has handled everything
    // before.
    let mut heard = Vec::new();
    while let Ok(frame) = link.recv_control().await {
        if let Ok(Control::Crl { der }) = Control::from_slice(&frame)
            && heard.len() < HEARD_MAX
        {
            heard.push(der);
        }
    }
    link.closed().await;
    Ok(heard)
}
