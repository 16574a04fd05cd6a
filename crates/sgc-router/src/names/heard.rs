//! [`Heard`]: the routes to names at a node that relies on its routers.

use std::collections::BTreeMap;

use sgc_wire::Name;
use smallvec::SmallVec;

use crate::link_id::LinkId;
use crate::links::cost::cost_differs;
use crate::links::{Link, Links, PathKind};

/// The routes to a name.
#[derive(Debug, Default)]
struct NameRoutes {
    /// Cost from the neighbour to the owner.
    over: SmallVec<[(LinkId, u32); 2]>,
    selected: Option<LinkId>,
}

/// The routes to names that routers told.
#[derive(Debug, Default)]
pub(super) struct Heard {
    names: BTreeMap<Name, NameRoutes>,
    /// The only kind of path that counts for a name.
    required: BTreeMap<Name, PathKind>,
}

impl Heard {
    /// Notes the cost of the owner over a link.
    pub(super) fn hear(&mut self, name: &Name, link: LinkId, cost: u32) {
        let heard = self.names.entry(*name).or_default();
        match heard.over.iter_mut().find(|(l, _)| *l == link) {
            Some(known) => known.1 = cost,
            None => heard.over.push((link, cost)),
        }
    }

    /// Forgets the route over a link. Returns `true` if the name is known.
    pub(super) fn lose(&mut self, name: &Name, link: LinkId) -> bool {
        let heard = self.names.get_mut(name);
        heard.map(|heard| heard.over.retain(|(l, _)| *l != link)).is_some()
    }

    /// Forgets every route over a link. Returns their names.
    pub(super) fn lose_link(&mut self, link: LinkId) -> Vec<Name> {
        let mut lost = Vec::new();
        for (name, heard) in &mut self.names {
            if heard.over.iter().any(|(l, _)| *l == link) {
                heard.over.retain(|(l, _)| *l != link);
                lost.push(*name);
            }
        }
        lost
    }

    /// Forgets a name.
    pub(super) fn remove(&mut self, name: &Name) {
        self.names.remove(name);
    }

    /// Lets only one kind of path count for a name, or any.
    pub(super) fn require(&mut self, name: Name, kind: Option<PathKind>) {
        match kind {
            Some(kind) => self.required.insert(name, kind),
            None => self.required.remove(&name),
        };
    }

    /// Returns the link towards the owner of a name, and the cost of the route.
    pub(super) fn next_hop(&self, links: &Links, name: &Name) -> Option<(LinkId, u32)> {
        let heard = self.names.get(name)?;
        let required = self.required.get(name);
        let counts =
            |link| required.is_none_or(|kind| links.get(link).map(Link::path_kind).as_ref() == Some(kind));
        // Of several links to one neighbour, data moves to the best, even if that is no cheaper.
        let is_passed_over = |link: LinkId| {
            let best = links.get(link).and_then(|state| links.best_to(state.node()));
            best.is_some_and(|(best, _)| {
                best != link && counts(best) && heard.over.iter().any(|(l, _)| *l == best)
            })
        };
        let over = |(link, cost): &(LinkId, u32)| {
            let cost = cost.saturating_add(links.cost(*link)?);
            (counts(*link) && !is_passed_over(*link)).then_some((cost, *link))
        };
        let best = heard.over.iter().filter_map(over).min()?;
        // Another link is taken only if that is clearly better.
        let kept = heard.over.iter().filter(|(l, _)| Some(*l) == heard.selected).find_map(over);
        let (cost, link) = kept.filter(|(cost, _)| !cost_differs(best.0, *cost)).unwrap_or(best);
        Some((link, cost))
    }

    /// Notes the link of the route that is taken.
    pub(super) fn select(&mut self, name: &Name, link: Option<LinkId>) {
        if let Some(heard) = self.names.get_mut(name) {
            heard.selected = link;
        }
    }

    /// Iterates over the names.
    pub(super) fn names(&self) -> impl Iterator<Item = &Name> {
        self.names.keys()
    }
}
