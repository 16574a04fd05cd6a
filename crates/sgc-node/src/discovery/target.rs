//! Routers to dial.

use std::net::SocketAddr;

use sgc_transport::LinkUrl;

/// A router to dial.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct DialTarget {
    /// The preferred URL.
    pub(crate) url: LinkUrl,
    /// Addresses of the host, if known; otherwise the host is looked up.
    pub(crate) addresses: Vec<SocketAddr>,
    /// All URLs of the router, the best first, if it has several. `url` is the first.
    pub(crate) urls: Vec<LinkUrl>,
}

impl DialTarget {
    /// Returns the target with these URLs, the best first; `None` without any.
    pub(crate) fn by(urls: Vec<LinkUrl>) -> Option<Self> {
        let url = urls.first()?.clone();
        Some(Self { urls, ..Self::from(url) })
    }

    /// Returns all URLs, the best first.
    pub(crate) fn urls(&self) -> &[LinkUrl] {
        if self.urls.is_empty() { std::slice::from_ref(&self.url) } else { &self.urls }
    }

    /// Returns the URLs that are better than this one; none if the target lacks it.
    pub(crate) fn better_than(&self, url: &LinkUrl) -> &[LinkUrl] {
        let rank = self.urls().iter().position(|other| other == url);
        &self.urls()[..rank.unwrap_or(0)]
    }
}

impl From<LinkUrl> for DialTarget {
    fn from(url: LinkUrl) -> Self {
        Self { url, addresses: Vec::new(), urls: Vec::new() }
    }
}
