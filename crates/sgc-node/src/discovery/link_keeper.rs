//! One attempt at a router: dial, and judge the peer. `kept_link.rs` keeps the link until it ends.

use std::collections::BTreeSet;
use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;

use sgc_transport::{AnyLink, CloseReason, DialError, Dialer, Link, LinkError, LinkUrl};
use sgc_wire::NodeId;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tracing::warn;

use super::dns::DnsError;
use super::{Claim, Claims, DialTarget, Dns, Names as _, SkippedUrl, StatusRow, WorkingUrls, urls};
use crate::control::event::CoreEvent;
use crate::link::roaming::Network;

/// Makes and keeps links. Tests replace it.
pub(crate) trait KeepLink: Clone + Send + Sync + 'static {
    /// Dials and, if the request is met, keeps the link until it ends. A new target replaces the link by one to that
    /// target.
    fn keep_link(
        &self,
        target: watch::Receiver<DialTarget>,
        request: &LinkRequest,
        row: &StatusRow,
    ) -> impl Future<Output = Outcome> + Send;
    /// Waits until there is no link to this node.
    fn released(&self, node: &NodeId) -> impl Future<Output = ()> + Send;
    /// Returns a receiver of changes of the network.
    fn network(&self) -> Network;
    /// Returns `true` once the node is stopping.
    fn is_over(&self) -> bool;
}

/// Conditions that a link has to meet.
#[derive(Clone, Debug, Default)]
pub(crate) struct LinkRequest {
    /// The target comes from an unauthenticated announcement. Only a router is accepted, and an incoming link of the
    /// node has precedence.
    pub(crate) hearsay: bool,
    /// The only nodes that are accepted; `None` accepts all.
    pub(crate) nodes: Option<Arc<BTreeSet<NodeId>>>,
    /// Places that links take. Without a free place no link is made.
    pub(crate) places: Option<Arc<Semaphore>>,
}

/// Result of an attempt.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// A link was up, and ended.
    Ended {
        /// Address of the peer.
        remote: SocketAddr,
        /// Reason of the end.
        end: LinkError,
    },
    /// No link was made.
    Failed(Failure),
}

/// Reasons why an attempt made no link.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// The target did not answer, or refused.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// The host's name could not be resolved.
    #[error(transparent)]
    Dns(#[from] DnsError),
    /// None of several URLs works.
    #[error("{}", .0.iter().map(|(_, why)| why.to_string()).collect::<Vec<_>>().join("; "))]
    Ways(Vec<(LinkUrl, Failure)>),
    /// Every place is taken.
    #[error("as many links as are wanted are up")]
    Enough,
    /// The target is this node.
    #[error("this node itself answers there")]
    Itself,
    /// The peer is not a router.
    #[error("node {} answers there, whose certificate does not make it a router", .0.short())]
    NoRouter(NodeId),
    /// The peer is not one of the accepted nodes.
    #[error("node {} answers there, which is not the one that is wanted", .0.short())]
    Other(NodeId),
    /// Another link leads to the peer.
    #[error("node {} answers there, to which there is a link already", .0.short())]
    Reached(NodeId),
}

impl Failure {
    /// Returns `true` if an early attempt cannot succeed.
    pub(crate) fn stands_back(&self) -> bool {
        !matches!(self, Self::Dial(_) | Self::Dns(_) | Self::Ways(_))
    }
}

/// Makes and keeps links over the network.
#[derive(Clone)]
pub(crate) struct LinkKeeper {
    /// Node id of this node.
    pub(crate) me: NodeId,
    pub(crate) dialer: Arc<Dialer>,
    /// Dialer of lanes, usually the same as `dialer`.
    pub(crate) lane_dialer: Arc<Dialer>,
    pub(crate) dns: Dns,
    pub(crate) core: mpsc::Sender<CoreEvent>,
    /// Changes when the credentials change.
    pub(crate) redial: watch::Receiver<()>,
    pub(crate) claims: Claims,
    /// Changes of the network.
    pub(crate) network: Network,
    /// The URLs that worked last.
    pub(crate) urls: WorkingUrls,
}

/// A link that was dialled.
pub(crate) struct DialledLink {
    pub(crate) link: AnyLink,
    /// The URL that worked.
    pub(crate) url: LinkUrl,
    /// The URLs that were tried before.
    pub(crate) passed: Vec<SkippedUrl>,
}

impl LinkKeeper {
    /// Dials once and returns the first link that succeeds, beginning with the URL that worked last.
    pub(crate) async fn dial(&self, target: &DialTarget) -> Result<DialledLink, Failure> {
        if let [] | [_] = &target.urls[..] {
            let link = self.dial_url(&target.url, &target.addresses).await?;
            return Ok(DialledLink { link, url: target.url.clone(), passed: Vec::new() });
        }
        self.dial_first(&self.urls.in_order(&target.urls)).await
    }

    /// Dials these URLs and returns the first link that succeeds.
    pub(crate) async fn dial_first(&self, urls: &[LinkUrl]) -> Result<DialledLink, Failure> {
        let dial = |url: LinkUrl| {
            let keeper = self.clone();
            async move { keeper.dial_url(&url, &[]).await }
        };
        let (link, url, passed) = urls::first(urls, dial).await.map_err(Failure::Ways)?;
        Ok(DialledLink { link, url, passed })
    }

    async fn dial_url(&self, url: &LinkUrl, addresses: &[SocketAddr]) -> Result<AnyLink, Failure> {
        let addresses = match (addresses, self.dns.is_chosen()) {
            ([], false) => return Ok(self.dialer.dial(url).await?),
            ([], true) => self.dns.addresses(&url.host, url.port).await?,
            (known, _) => known.to_vec(),
        };
        Ok(self.dialer.dial_at(url, addresses).await?)
    }

    /// Moves the dialers' sockets to the current network, once after each change.
    pub(crate) fn rebind(&self) {
        if !self.network.is_first() {
            return;
        }
        let lanes = Some(&self.lane_dialer).filter(|lanes| !Arc::ptr_eq(lanes, &self.dialer));
        let renewed = [Some(&self.dialer), lanes].into_iter().flatten().map(|dialer| dialer.rebind());
        if let Err(error) = renewed.collect::<Vec<_>>().into_iter().collect::<Result<(), _>>() {
            warn!(%error, "the network changed and no new socket could be opened; links keep the old one");
        }
    }

    /// Shows that a link is up, and remembers its URL.
    pub(crate) fn linked(
        &self,
        target: &DialTarget,
        url: &LinkUrl,
        passed: &[SkippedUrl],
        node: &NodeId,
        row: &StatusRow,
    ) {
        row.linked(url, node);
        row.passed_over(target.better_than(url), passed);
        if target.urls.len() > 1 {
            self.urls.worked_by(&target.urls, url);
        }
    }

    /// Judges the peer of a successor link like that of a first one, and claims it unless the claim that is held covers
    /// it. The successor keeps the place of the link that it replaces.
    pub(crate) fn enter_again(
        &self,
        link: &AnyLink,
        request: &LinkRequest,
        held: &Claim,
    ) -> Result<Option<Claim>, Failure> {
        let node = link.peer().node_id;
        let entered = self.judge(link, request).and_then(|()| {
            let claim = || self.claims.claim(node).ok_or(Failure::Reached(node));
            (node != held.node()).then(claim).transpose()
        });
        if entered.is_err() {
            link.close(CloseReason::Goodbye);
        }
        entered
    }

    /// Judges the peer of a first link, and takes its claim and its place.
    pub(crate) fn enter(
        &self,
        link: &AnyLink,
        request: &LinkRequest,
    ) -> Result<(Claim, Option<OwnedSemaphorePermit>), Failure> {
        self.judge(link, request)?;
        let node = link.peer().node_id;
        let claim = self.claims.claim(node).ok_or(Failure::Reached(node))?;
        let place = match &request.places {
            None => None,
            Some(places) => Some(places.clone().try_acquire_owned().map_err(|_| Failure::Enough)?),
        };
        Ok((claim, place))
    }

    /// Judges the peer of a link.
    fn judge(&self, link: &AnyLink, request: &LinkRequest) -> Result<(), Failure> {
        let peer = link.peer();
        let node = peer.node_id;
        if node == self.me {
            return Err(Failure::Itself);
        }
        if request.nodes.as_ref().is_some_and(|nodes| !nodes.contains(&node)) {
            return Err(Failure::Other(node));
        }
        if request.hearsay && !peer.may_route {
            return Err(Failure::NoRouter(node));
        }
        if self.gives_way(request, &node) && self.claims.has_come(&node) {
            return Err(Failure::Reached(node));
        }
        Ok(())
    }

    /// Decides which of two crossing links stays: that of the node with the lesser id.
    pub(crate) fn gives_way(&self, request: &LinkRequest, node: &NodeId) -> bool {
        request.hearsay && self.me > *node
    }
}
