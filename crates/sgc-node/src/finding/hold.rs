//! One attempt: dial, see who answers, and keep the link until it ends.

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::future::Future;
use std::net::SocketAddr;
use std::sync::Arc;

use sgc_transport::{AnyLink, CloseReason, DialError, Dialer, Link, LinkError, LinkUrl};
use sgc_wire::NodeId;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc, watch};
use tracing::warn;

use super::dns::DnsError;
use super::{Aim, Claim, Claims, Dns, Line, Names as _, Passed, WayBook, ways};
use crate::core::CoreEvent;
use crate::links::keep_renewed;
use crate::roaming::Network;

/// How a link is made and kept; tests put something else in its place.
pub(crate) trait Hold: Clone + Send + Sync + 'static {
    /// Dials and, if the wish is met, keeps the link until it ends. Another aim has a link made there in place of the
    /// one that is up.
    fn hold(
        &self,
        aim: watch::Receiver<Aim>,
        wish: &Wish,
        line: &Line,
    ) -> impl Future<Output = Outcome> + Send;
    /// Waits until there is no link to this node.
    fn released(&self, node: &NodeId) -> impl Future<Output = ()> + Send;
    /// How the network changes from here on.
    fn network(&self) -> Network;
    /// True once the node is stopping.
    fn is_over(&self) -> bool;
}

/// Whom a link is wanted to.
#[derive(Clone, Debug, Default)]
pub(crate) struct Wish {
    /// What was dialled is the word of a stranger: only a router will do, and one that came here by itself goes before.
    pub(crate) hearsay: bool,
    /// Only these; all if there is nothing.
    pub(crate) nodes: Option<Arc<BTreeSet<NodeId>>>,
    /// A link takes one of these places; if none is free there is to be none.
    pub(crate) places: Option<Arc<Semaphore>>,
}

/// What came of an attempt.
#[derive(Debug)]
pub(crate) enum Outcome {
    /// A link was up, and ended.
    Ended {
        /// Where it led.
        remote: SocketAddr,
        /// Why.
        end: LinkError,
    },
    /// There was none.
    Failed(Failure),
}

/// Why an attempt led to no link.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// Nobody is there, or it was refused.
    #[error(transparent)]
    Dial(#[from] DialError),
    /// Its name cannot be looked up.
    #[error(transparent)]
    Dns(#[from] DnsError),
    /// None of several ways works.
    #[error("{}", .0.iter().map(|(_, why)| why.to_string()).collect::<Vec<_>>().join("; "))]
    Ways(Vec<(LinkUrl, Failure)>),
    /// Every place is taken.
    #[error("as many links as are wanted are up")]
    Enough,
    /// It leads here.
    #[error("this node itself answers there")]
    Itself,
    /// It is not a router.
    #[error("node {} answers there, whose certificate does not make it a router", .0.short())]
    NoRouter(NodeId),
    /// It is not the one that is wanted.
    #[error("node {} answers there, which is not the one that is wanted", .0.short())]
    Other(NodeId),
    /// Another link leads there.
    #[error("node {} answers there, to which there is a link already", .0.short())]
    Reached(NodeId),
}

impl Failure {
    /// True if trying again soon is of no use.
    pub(crate) fn stands_back(&self) -> bool {
        !matches!(self, Self::Dial(_) | Self::Dns(_) | Self::Ways(_))
    }
}

/// Makes and keeps links over the network.
#[derive(Clone)]
pub(crate) struct Holder {
    /// This node.
    pub(crate) me: NodeId,
    pub(crate) dialer: Arc<Dialer>,
    /// What connections of single topics are dialled with; mostly the same.
    pub(crate) lane_dialer: Arc<Dialer>,
    pub(crate) dns: Dns,
    pub(crate) core: mpsc::Sender<CoreEvent>,
    /// Each change says that the credentials changed.
    pub(crate) redial: watch::Receiver<()>,
    pub(crate) claims: Claims,
    /// How the network changes.
    pub(crate) network: Network,
    /// Which ways worked.
    pub(crate) ways: WayBook,
}

/// A link that was dialled.
pub(crate) struct Dialled {
    pub(crate) link: AnyLink,
    /// By which way.
    pub(crate) url: LinkUrl,
    /// The ways that were tried before.
    pub(crate) passed: Vec<Passed>,
}

impl Holder {
    /// Dials once, by whichever way works, beginning with the one that did last.
    pub(crate) async fn dial(&self, aim: &Aim) -> Result<Dialled, Failure> {
        if let [] | [_] = &aim.ways[..] {
            let link = self.dial_way(&aim.url, &aim.addresses).await?;
            return Ok(Dialled { link, url: aim.url.clone(), passed: Vec::new() });
        }
        self.dial_first(&self.ways.in_order(&aim.ways)).await
    }

    /// Dials by the first of these ways that works.
    pub(crate) async fn dial_first(&self, ways: &[LinkUrl]) -> Result<Dialled, Failure> {
        let dial = |way: LinkUrl| {
            let holder = self.clone();
            async move { holder.dial_way(&way, &[]).await }
        };
        let (link, url, passed) = ways::first(ways, dial).await.map_err(Failure::Ways)?;
        Ok(Dialled { link, url, passed })
    }

    async fn dial_way(&self, url: &LinkUrl, addresses: &[SocketAddr]) -> Result<AnyLink, Failure> {
        let addresses = match (addresses, self.dns.is_chosen()) {
            ([], false) => return Ok(self.dialer.dial(url).await?),
            ([], true) => self.dns.addresses(&url.host, url.port).await?,
            (known, _) => known.to_vec(),
        };
        Ok(self.dialer.dial_at(url, addresses).await?)
    }

    /// Has the links of all go on from where the node is now, once after each change of the network.
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

    /// Says of a link that it is up, and remembers the way.
    pub(crate) fn linked(&self, aim: &Aim, url: &LinkUrl, passed: &[Passed], node: &NodeId, line: &Line) {
        line.linked(url, node);
        line.passed_over(aim.better_than(url), passed);
        if aim.ways.len() > 1 {
            self.ways.worked_by(&aim.ways, url);
        }
    }

    /// The claim on who answered, unless the one that is held covers it.
    pub(crate) fn claim_again(&self, link: &AnyLink, held: &Claim) -> Result<Option<Claim>, Failure> {
        let node = link.peer().node_id;
        if node == held.node() {
            return Ok(None);
        }
        let claim = self.claims.claim(node).ok_or(Failure::Reached(node));
        if claim.is_err() {
            link.close(CloseReason::Goodbye);
        }
        claim.map(Some)
    }

    /// Judges who answered.
    fn enter(&self, link: &AnyLink, wish: &Wish) -> Result<(Claim, Option<OwnedSemaphorePermit>), Failure> {
        let peer = link.peer();
        let node = peer.node_id;
        if node == self.me {
            return Err(Failure::Itself);
        }
        if wish.nodes.as_ref().is_some_and(|nodes| !nodes.contains(&node)) {
            return Err(Failure::Other(node));
        }
        if wish.hearsay && !peer.may_route {
            return Err(Failure::NoRouter(node));
        }
        if self.gives_way(wish, &node) && self.claims.has_come(&node) {
            return Err(Failure::Reached(node));
        }
        let claim = self.claims.claim(node).ok_or(Failure::Reached(node))?;
        let place = match &wish.places {
            None => None,
            Some(places) => Some(places.clone().try_acquire_owned().map_err(|_| Failure::Enough)?),
        };
        Ok((claim, place))
    }

    /// Where two nodes find each other, the link of the one with the lesser id stays.
    fn gives_way(&self, wish: &Wish, node: &NodeId) -> bool {
        wish.hearsay && self.me > *node
    }
}

impl Hold for Holder {
    async fn hold(&self, mut aim: watch::Receiver<Aim>, wish: &Wish, line: &Line) -> Outcome {
        // What changes from here on may come too late for this attempt.
        let mut redial = self.redial.clone();
        redial.mark_unchanged();
        let first = aim.borrow_and_update().clone();
        line.connecting(&first);
        let Dialled { link, url, passed } = match self.dial(&first).await {
            Ok(dialled) => dialled,
            Err(why) => return Outcome::Failed(why),
        };
        let (node, remote) = (link.peer().node_id, link.remote());
        let (claim, _place) = match self.enter(&link, wish) {
            Ok(entered) => entered,
            Err(why) => {
                link.close(CloseReason::Goodbye);
                return Outcome::Failed(why);
            }
        };
        self.linked(&first, &url, &passed, &node, line);
        let overtaken = async {
            if self.gives_way(wish, &node) {
                self.claims.arrived(&node).await;
                link.close(CloseReason::Replaced);
            }
            std::future::pending::<Infallible>().await
        };
        tokio::select! {
            end = keep_renewed(link.clone(), url, aim, redial, self, claim, line) => Outcome::Ended { remote, end },
            never = overtaken => match never {},
        }
    }

    async fn released(&self, node: &NodeId) {
        self.claims.released(node).await;
    }

    fn network(&self) -> Network {
        self.network.onward()
    }

    fn is_over(&self) -> bool {
        self.core.is_closed()
    }
}
