//! [`DirectLinkTable`]: the direct links that are up, and those that are no longer needed.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::{Duration, Instant};

use sgc_wire::NodeId;

use super::DirectPaths;

/// Time after which a direct link is closed over which neither node wants data.
const UNUSED_MAX: Duration = Duration::from_secs(120);
/// Time after which one is closed that has a better one beside it.
const SUPERSEDED_MAX: Duration = Duration::from_secs(10);

/// A direct link that is up.
#[derive(Debug)]
struct DirectLink {
    peer: NodeId,
    /// Whether nothing arrives over it.
    is_silent: bool,
    /// Time since which neither node wants data of the other, or a better link has the data.
    unused: Option<Instant>,
}

/// The direct links that are up, by the driver's key of each. It tells [`DirectPaths`] of their changes.
#[derive(Debug)]
pub struct DirectLinkTable<L> {
    links: BTreeMap<L, DirectLink>,
}

impl<L> Default for DirectLinkTable<L> {
    fn default() -> Self {
        Self { links: BTreeMap::new() }
    }
}

impl<L: Copy + Ord> DirectLinkTable<L> {
    /// Notes a link that is up. Returns `true` if it is a direct one.
    pub fn link_up(
        &mut self,
        now: Instant,
        paths: &mut DirectPaths,
        link: L,
        peer: NodeId,
        remote: SocketAddr,
    ) -> bool {
        // Otherwise it may be the successor of a direct link, under another certificate.
        let is_direct = paths.is_expected(&peer, remote) || self.links_to(&peer).next().is_some();
        if is_direct {
            self.links.insert(link, DirectLink { peer, is_silent: false, unused: None });
            paths.linked(now, peer);
        }
        is_direct
    }

    /// Notes that a link ended.
    pub fn link_down(&mut self, now: Instant, paths: &mut DirectPaths, link: L) {
        let Some(DirectLink { peer, .. }) = self.links.remove(&link) else { return };
        if self.links_to(&peer).next().is_none() {
            paths.ended(now, peer);
        } else {
            self.silence_changed(now, paths, peer);
        }
    }

    /// Notes whether nothing arrives over a link.
    pub fn link_looked_at(&mut self, now: Instant, paths: &mut DirectPaths, link: L, is_silent: bool) {
        let Some(direct) = self.links.get_mut(&link) else { return };
        if std::mem::replace(&mut direct.is_silent, is_silent) != is_silent {
            let peer = direct.peer;
            self.silence_changed(now, paths, peer);
        }
    }

    fn silence_changed(&self, now: Instant, paths: &mut DirectPaths, peer: NodeId) {
        let is_silent = self.links.values().filter(|link| link.peer == peer).all(|link| link.is_silent);
        paths.silent(now, peer, is_silent);
    }

    /// Returns `true` for a direct link.
    pub fn is_direct(&self, link: L) -> bool {
        self.links.contains_key(&link)
    }

    /// Iterates over the direct links.
    pub fn iter(&self) -> impl Iterator<Item = L> {
        self.links.keys().copied()
    }

    /// Iterates over the direct links to a peer.
    pub fn links_to(&self, peer: &NodeId) -> impl Iterator<Item = L> {
        self.links.iter().filter(|(_, link)| link.peer == *peer).map(|(key, _)| *key)
    }

    /// Returns the direct links that nothing has used for a while. The router knows those that have a better one beside
    /// them, and those that something uses.
    pub fn unused(
        &mut self,
        now: Instant,
        paths: &DirectPaths,
        is_superseded: impl Fn(L) -> bool,
        is_used: impl Fn(L) -> bool,
    ) -> Vec<L> {
        let mut over = Vec::new();
        for (link, direct) in &mut self.links {
            let is_superseded = is_superseded(*link);
            // Data that goes over a router to spare the uplink may come back.
            let is_used = !is_superseded && (paths.is_wanted(&direct.peer) || is_used(*link));
            let unused_max = if is_superseded { SUPERSEDED_MAX } else { UNUSED_MAX };
            direct.unused = if is_used { None } else { direct.unused.or(Some(now)) };
            if direct.unused.is_some_and(|since| now.saturating_duration_since(since) >= unused_max) {
                over.push(*link);
            }
        }
        over
    }
}
