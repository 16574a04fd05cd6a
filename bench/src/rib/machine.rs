//! The routing machine under test. Only this file knows its API.

use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Result, bail, ensure};
use sgc_router::{Limits, LinkId, MappingKind, Neighbour, Output, Router, RouterConfig};
use sgc_trust::{Identity, TrustAnchors, VerifiedPeer, verify_advert, verify_answer, verify_join};
use sgc_wire::{Control, Decode, Hello, Now, UnixMillis};

/// A router without sockets, whose clock stands still.
pub(super) struct Machine {
    router: Router,
    anchors: Arc<TrustAnchors>,
    now: Now,
    links: u32,
}

/// The cost of handling a frame.
pub(super) struct FeedCost {
    took: Duration,
    sent_to: Vec<LinkId>,
}

impl FeedCost {
    /// Returns the time of decoding, handling and sending results, in microseconds.
    pub(super) fn micros(&self) -> f64 {
        self.took.as_secs_f64() * 1e6
    }

    /// Returns `true` if a frame was sent over that link.
    pub(super) fn went_to(&self, link: LinkId) -> bool {
        self.sent_to.contains(&link)
    }
}

impl Machine {
    pub(super) fn new(identity: &Arc<Identity>, now: Now) -> Self {
        let anchors = Arc::new(identity.anchors().clone());
        // Limits against greedy neighbours are lifted, because they are not measured.
        let limits = Limits {
            joins_burst: u32::MAX,
            announcements_burst: u32::MAX,
            names_per_owner_max: usize::MAX,
            names_per_router_max: usize::MAX,
            adverts_per_owner_max: usize::MAX,
            advert_bytes_per_owner_max: usize::MAX,
            stale_burst: u32::MAX,
            ..Limits::default()
        };
        let config = RouterConfig {
            node: identity.node_id(),
            identity: identity.clone(),
            transit: true,
            incarnation: 1,
            started: now.unix,
            mapping: MappingKind::Flood,
            anchors: anchors.clone(),
            limits,
        };
        let router = Router::new(config, now);
        Self { router, anchors, now, links: 0 }
    }

    /// A link to this node that has greeted.
    pub(super) fn attach(&mut self, peer: &VerifiedPeer, transit: bool) -> Result<LinkId> {
        self.links += 1;
        let link = LinkId(self.links);
        self.router.handle_link_up(self.now, link, Neighbour::from(peer));
        let hello = Hello { minor: 0, incarnation: 1, transit, yields: false, started: UnixMillis(1) };
        self.router.handle_frame(self.now, link, Control::Hello(hello));
        self.drain()?;
        Ok(link)
    }

    /// Handles a frame as the driver does; an error if the router refuses it.
    pub(super) fn feed(&mut self, link: LinkId, frame: &[u8]) -> Result<FeedCost> {
        let begun = Instant::now();
        let frame = Control::from_slice(frame)?;
        self.router.handle_frame(self.now, link, frame);
        let sent_to = self.drain()?;
        Ok(FeedCost { took: begun.elapsed(), sent_to })
    }

    /// Times the verification of this frame's signature, in microseconds.
    pub(super) fn verify(&self, frame: &[u8]) -> Result<f64> {
        let frame = Control::from_slice(frame)?;
        let begun = Instant::now();
        match &frame {
            Control::Advert { signed, .. } => drop(verify_advert(&self.anchors, signed, self.now.unix)?),
            Control::Join { signed } => drop(verify_join(&self.anchors, signed, self.now.unix)?),
            other => bail!("nothing to verify: {other:?}"),
        }
        Ok(begun.elapsed().as_secs_f64() * 1e6)
    }

    /// Times the verification of an answer of this owner.
    pub(super) fn verify_answer(&self, owner: &VerifiedPeer, frame: &[u8]) -> Result<f64> {
        let Control::Answer { signed } = Control::from_slice(frame)? else { bail!("no answer") };
        let begun = Instant::now();
        drop(verify_answer(owner, &signed)?);
        Ok(begun.elapsed().as_secs_f64() * 1e6)
    }

    pub(super) fn routed_names(&self) -> usize {
        self.router.stats().routed_names
    }

    pub(super) fn unix(&self) -> UnixMillis {
        self.now.unix
    }

    fn drain(&mut self) -> Result<Vec<LinkId>> {
        let mut sent_to = Vec::new();
        loop {
            match self.router.poll_output() {
                Output::Send { link, .. } => sent_to.push(link),
                Output::Flush { link } => self.router.handle_flushed(self.now, link),
                Output::Store(_) => {}
                Output::Dropped(dropped) => bail!("the router refuses a frame: {}", dropped.reason),
                Output::Close { reason, .. } => bail!("the router closes a link: {reason}"),
                Output::Timeout(at) => {
                    ensure!(at.is_none_or(|at| at > self.now.instant), "the clock stands still");
                    return Ok(sent_to);
                }
                _ => {}
            }
        }
    }
}
