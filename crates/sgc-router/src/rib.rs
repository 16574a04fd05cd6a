//! What is known of one name: the routes to its owner, the branches of its tree, and who asks for it.
//!
//! Route selection is loop-free hop by hop: a route is taken only if the neighbour is nearer to the owner
//! than this node ever told that it is itself, for the same sequence number of the owner (the feasibility
//! condition of RFC 8966, 3.5.1). A newer sequence number starts afresh.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Instant;

use sgc_trust::{CertId, VerifiedPeer};
use sgc_wire::{Name, NodeId, Role, Signed, SinkId};
use smallvec::SmallVec;

use crate::{FibEntry, LinkId};

/// A verified advertisement, shared by all names in it.
#[derive(Debug)]
pub(crate) struct AdvertRecord {
    pub(crate) owner: VerifiedPeer,
    pub(crate) seq: u64,
    /// Every name in it, in use over this link or not.
    pub(crate) names: Vec<Name>,
    pub(crate) signed: Signed,
}

/// One way to the owner.
#[derive(Clone, Debug)]
pub(crate) struct Route {
    pub(crate) link: LinkId,
    /// Links between the neighbour and the owner.
    pub(crate) hops: u8,
    pub(crate) advert: Arc<AdvertRecord>,
    pub(crate) expires: Instant,
}

impl Route {
    /// Links between this node and the owner, which neighbours are told; the owner's own node is at 0.
    pub(crate) fn distance(&self) -> u8 {
        if self.link == LinkId::LOCAL { 0 } else { self.hops.saturating_add(1) }
    }
}

/// A sink's place in the tree.
#[derive(Clone, Debug)]
pub(crate) struct Branch {
    pub(crate) link: LinkId,
    pub(crate) peer: NodeId,
    /// The certificates of its request.
    pub(crate) certs: Arc<[CertId]>,
    pub(crate) role: Role,
    /// Until when the owner must answer; `None` once it granted.
    pub(crate) pending: Option<Instant>,
}

/// State of one name.
#[derive(Debug, Default)]
pub(crate) struct NameState {
    routes: SmallVec<[Route; 2]>,
    selected: Option<LinkId>,
    /// Sequence number and own distance of the best route ever told for it.
    feasible: Option<(u64, u8)>,
    /// Link, sequence number and hops of the route that neighbours were told last.
    told: Option<(LinkId, u64, u8)>,
    /// Without a route: until when `feasible` is remembered, or what is still under way elsewhere would make
    /// routes go in a circle.
    remembered: Option<Instant>,
    pub(crate) branches: BTreeMap<SinkId, Branch>,
    pub(crate) interested: BTreeSet<LinkId>,
}

impl NameState {
    /// The route in use.
    pub(crate) fn route(&self) -> Option<&Route> {
        self.selected.and_then(|link| self.route_over(link))
    }

    /// The route over `link`, in use or not.
    pub(crate) fn route_over(&self, link: LinkId) -> Option<&Route> {
        self.routes.iter().find(|r| r.link == link)
    }

    /// The newest sequence number of any route.
    pub(crate) fn newest_seq(&self) -> Option<u64> {
        self.routes.iter().map(|r| r.advert.seq).max()
    }

    /// Adds or replaces the route over its link; true if there was none.
    pub(crate) fn put_route(&mut self, route: Route) -> bool {
        match self.routes.iter_mut().find(|r| r.link == route.link) {
            Some(old) => {
                *old = route;
                false
            }
            None => {
                self.routes.push(route);
                true
            }
        }
    }

    /// Removes the route over `link`.
    pub(crate) fn remove_route(&mut self, link: LinkId) -> Option<Route> {
        let at = self.routes.iter().position(|r| r.link == link)?;
        Some(self.routes.swap_remove(at))
    }

    /// All routes, in use or not.
    pub(crate) fn routes(&self) -> impl Iterator<Item = &Route> {
        self.routes.iter()
    }

    /// All routes' links.
    pub(crate) fn route_links(&self) -> SmallVec<[LinkId; 4]> {
        self.routes.iter().map(|r| r.link).collect()
    }

    /// Chooses the route to use. A route in use stays while it is feasible and carries branches, so that equal
    /// or slightly better paths do not make flows flap; but a feasible one over `must` overrides that. Returns the
    /// link used before if it changed.
    pub(crate) fn select(&mut self, must: Option<LinkId>) -> Option<Option<LinkId>> {
        let before = self.selected;
        let feasible = self.feasible;
        let usable = |r: &&Route| match feasible {
            Some((seq, distance)) => {
                r.advert.seq > seq || r.advert.seq == seq && (r.hops < distance || r.link == LinkId::LOCAL)
            }
            None => true,
        };
        let must = must.and_then(|link| self.route_over(link)).filter(usable);
        let keep = must
            .or_else(|| self.route().filter(|_| !self.branches.is_empty()).filter(usable))
            .map(|r| (r.link, r.distance(), r.advert.seq));
        let best = keep.or_else(|| {
            self.routes
                .iter()
                .filter(usable)
                .min_by_key(|r| (r.hops, Some(r.link) != before, r.link))
                .map(|r| (r.link, r.distance(), r.advert.seq))
        });
        self.selected = best.map(|(link, ..)| link);
        if let Some((_, distance, seq)) = best {
            self.feasible = match self.feasible {
                Some((s, d)) if s == seq => Some((s, d.min(distance))),
                _ => Some((seq, distance)),
            };
        }
        (self.selected != before).then_some(before)
    }

    /// Neighbours are about to be told `distance` for `seq`. True if they were never told as much: then nothing
    /// that is farther may be used from here on, and the caller selects anew.
    pub(crate) fn promise(&mut self, seq: u64, distance: u8) -> bool {
        let news = self.feasible.is_none_or(|(s, d)| s < seq || s == seq && d > distance);
        if news {
            self.feasible = Some((seq, distance));
        }
        news
    }

    /// True, once, if the route in use is not what neighbours were told last.
    pub(crate) fn take_news(&mut self) -> bool {
        let key = self.route().map(|r| (r.link, r.advert.seq, r.hops));
        let news = key.is_some() && key != self.told;
        self.told = key;
        news
    }

    /// Keeps what was told until then although there is no route any more; false if there is one.
    pub(crate) fn remember(&mut self, until: Instant) -> bool {
        if self.routes.is_empty() {
            self.remembered = Some(until);
        }
        self.routes.is_empty()
    }

    /// Ends [`Self::remember`] because there is a route again; until when it was.
    pub(crate) fn resume(&mut self) -> Option<Instant> {
        self.remembered.take()
    }

    /// Forgets what was told: nobody can have an old route any more. Until when it was remembered.
    pub(crate) fn forget(&mut self) -> Option<Instant> {
        self.feasible = None;
        self.remembered.take()
    }

    /// True if nothing is known and nobody asks.
    pub(crate) fn is_idle(&self) -> bool {
        self.routes.is_empty()
            && self.branches.is_empty()
            && self.interested.is_empty()
            && self.remembered.is_none()
    }

    /// The entry for the data path; `None` while nobody behind an active branch would receive or send.
    pub(crate) fn compile(&self) -> Option<FibEntry> {
        let up = self.selected?;
        let mut entry =
            FibEntry { up, down: SmallVec::new(), publishers: SmallVec::new(), sinks: Vec::new() };
        for (sink, branch) in self.branches.iter().filter(|(_, b)| b.pending.is_none()) {
            let links = match branch.role {
                Role::Subscribe => &mut entry.down,
                Role::Publish => {
                    if !entry.publishers.contains(&branch.link) {
                        entry.publishers.push(branch.link);
                    }
                    continue;
                }
            };
            if !links.contains(&branch.link) {
                links.push(branch.link);
            }
            entry.sinks.push((*sink, branch.link));
        }
        entry.down.sort_unstable();
        (!entry.down.is_empty() || !entry.publishers.is_empty()).then_some(entry)
    }
}
