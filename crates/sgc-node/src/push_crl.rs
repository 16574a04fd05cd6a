//! Tells a router of a revocation list and hears of its own ones, for one who keeps a fleet and runs no node.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_transport::{
    CloseReason, DialError, Dialer, Link, LinkError, LinkOptions, LinkUrl, TransportMetrics,
};
use sgc_trust::Identity;
use sgc_wire::{Control, Decode, Encode, Hello, UnixMillis};

/// How long a router may take to greet and to say goodbye.
const ANSWER_MAX: Duration = Duration::from_secs(5);

/// Why a router was not told.
#[derive(Debug, thiserror::Error)]
pub enum PushCrlError {
    /// No link.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The link ended.
    #[error("the link to {url} ended: {source}")]
    Link {
        /// The router.
        url: LinkUrl,
        /// Why.
        source: LinkError,
    },
    /// It did not answer.
    #[error("{url} did not answer within {} s", ANSWER_MAX.as_secs())]
    Silent {
        /// The router.
        url: LinkUrl,
    },
}

/// Most lists that are heard of a router: all that it can have of as many CAs as can be trusted.
const HEARD_MAX: usize = sgc_trust::ANCHORS_MAX * (sgc_trust::FLEET_LISTS_MAX + 1);

/// Dials a router, greets it, gives it the list, and leaves. It has the list once this returns. Returns the lists that
/// the router has, which it gives every neighbour.
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
    // Another number than any run of a node has; nothing rests on it.
    incarnation.copy_from_slice(&link.peer().node_id.0[..8]);
    let hello = Hello {
        minor: 0,
        incarnation: u64::from_be_bytes(incarnation),
        transit: false,
        yields: true,
        started: UnixMillis::default(),
    };
    link.send_control(Control::Hello(hello).to_bytes()).await?;
    // Its greeting comes first: then it is a node that speaks this protocol.
    while !matches!(Control::from_slice(&link.recv_control().await?), Ok(Control::Hello(_))) {}
    link.send_control(Control::Crl { der: list }.to_bytes()).await?;
    link.send_control(Control::Goodbye.to_bytes()).await?;
    // It gave its lists behind its greeting. It answers a goodbye by closing, and took what came before.
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
