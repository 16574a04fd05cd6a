//! The SRV records of a domain, within their bounds (RFC 2782).

use std::time::Duration;

use sgc_transport::{LinkUrl, Scheme};

/// Most targets of a domain that are kept, the best of them.
pub(crate) const TARGETS_MAX: usize = 16;
/// Bounds of the validity of an answer.
pub(crate) const TTL_MIN: Duration = Duration::from_secs(10);
pub(crate) const TTL_MAX: Duration = Duration::from_secs(3600);
const HOST_BYTES_MAX: usize = 253;

/// An SRV record: a router of a domain.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct SrvTarget {
    /// Priority. The least is tried first.
    pub(crate) priority: u16,
    /// Weight among targets of the same priority.
    pub(crate) weight: u16,
    /// Host name without its final dot.
    pub(crate) host: String,
    pub(crate) port: u16,
}

impl SrvTarget {
    /// Returns `true` if the target can be dialled.
    pub(crate) fn is_usable(&self) -> bool {
        let is_name = |c: u8| c.is_ascii_alphanumeric() || matches!(c, b'-' | b'.' | b'_');
        self.port != 0 && (1..=HOST_BYTES_MAX).contains(&self.host.len()) && self.host.bytes().all(is_name)
    }

    pub(crate) fn url(&self) -> LinkUrl {
        LinkUrl { scheme: Scheme::Quic, host: self.host.clone(), port: self.port, path: None, cost_ms: None }
    }
}

/// The SRV records of a domain.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct SrvAnswer {
    /// Targets, 1 to [`TARGETS_MAX`].
    pub(crate) targets: Vec<SrvTarget>,
    /// Validity, [`TTL_MIN`] to [`TTL_MAX`].
    pub(crate) ttl: Duration,
}
