//! [`Interests`]: the names that links want to know of, and the records that they were told.

use std::collections::{BTreeMap, BTreeSet};

use sgc_wire::Name;

use super::record::RecordId;
use crate::link_id::LinkId;

/// The last record of a requested name that a link was told, by its number, and the cost.
pub(super) type RecordCost = Option<(RecordId, u32)>;

/// The interests of proxies and of this node's own endpoint.
#[derive(Debug, Default)]
pub(super) struct Interests {
    of_link: BTreeMap<LinkId, BTreeMap<Name, RecordCost>>,
    watchers: BTreeMap<Name, BTreeSet<LinkId>>,
}

impl Interests {
    /// Returns `true` if no link wants to know of any name.
    pub(super) fn is_empty(&self) -> bool {
        self.watchers.is_empty()
    }

    /// Returns `true` if the link wants to know of the name.
    pub(super) fn contains(&self, link: LinkId, name: &Name) -> bool {
        self.of_link.get(&link).is_some_and(|names| names.contains_key(name))
    }

    /// Returns the number of interests of a link.
    pub(super) fn len(&self, link: LinkId) -> usize {
        self.of_link.get(&link).map_or(0, BTreeMap::len)
    }

    /// Returns the names that a link wants to know of.
    pub(super) fn names(&self, link: LinkId) -> Vec<Name> {
        self.of_link.get(&link).into_iter().flat_map(BTreeMap::keys).copied().collect()
    }

    /// Iterates over the names that some link wants to know of.
    pub(super) fn watched(&self) -> impl Iterator<Item = &Name> {
        self.watchers.keys()
    }

    /// Returns the number of names that some link wants to know of.
    pub(super) fn watched_len(&self) -> usize {
        self.watchers.len()
    }

    /// Returns `true` if some link wants to know of the name.
    pub(super) fn is_watched(&self, name: &Name) -> bool {
        self.watchers.contains_key(name)
    }

    /// Iterates over the links that want to know of a name, ascending.
    pub(super) fn watchers(&self, name: &Name) -> impl Iterator<Item = LinkId> {
        self.watchers.get(name).into_iter().flatten().copied()
    }

    /// Adds an interest.
    pub(super) fn add(&mut self, link: LinkId, name: Name) {
        self.of_link.entry(link).or_default().insert(name, None);
        self.watchers.entry(name).or_default().insert(link);
    }

    /// Removes an interest. Returns `true` if no other link wants to know of the name.
    pub(super) fn remove(&mut self, link: LinkId, name: &Name) -> bool {
        let Some(names) = self.of_link.get_mut(&link) else { return false };
        if names.remove(name).is_none() {
            return false;
        }
        if names.is_empty() {
            self.of_link.remove(&link);
        }
        let Some(watchers) = self.watchers.get_mut(name) else { return false };
        watchers.remove(&link);
        let is_last = watchers.is_empty();
        if is_last {
            self.watchers.remove(name);
        }
        is_last
    }

    /// Returns the last record that a link was told, and its cost; `None` without interest.
    pub(super) fn told(&self, link: LinkId, name: &Name) -> Option<RecordCost> {
        self.of_link.get(&link)?.get(name).copied()
    }

    /// Notes the record that a link is told.
    pub(super) fn tell(&mut self, link: LinkId, name: &Name, record: RecordCost) {
        if let Some(told) = self.of_link.get_mut(&link).and_then(|names| names.get_mut(name)) {
            *told = record;
        }
    }

    /// Forgets the records that a link was told.
    pub(super) fn forget_told(&mut self, link: LinkId) {
        let names = self.of_link.get_mut(&link).into_iter().flat_map(BTreeMap::values_mut);
        names.for_each(|told| *told = None);
    }

    /// Returns the links but one that were told a record of one of these names, and forgets those records.
    pub(super) fn take_told(&mut self, except: LinkId, names: &[Name]) -> Vec<LinkId> {
        let mut links = Vec::new();
        for (link, interests) in self.of_link.iter_mut().filter(|(link, _)| **link != except) {
            if names.iter().any(|name| matches!(interests.get(name), Some(Some(_)))) {
                links.push(*link);
                for name in names {
                    if let Some(told) = interests.get_mut(name) {
                        *told = None;
                    }
                }
            }
        }
        links
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn withdrawal_goes_once_to_links_that_know_of_the_name() {
        let (name, other) = (Name([1; 32]), Name([2; 32]));
        let mut interests = Interests::default();
        interests.add(LinkId(1), name);
        interests.add(LinkId(2), name);
        interests.add(LinkId(3), other);
        interests.tell(LinkId(1), &name, Some((7, 10)));
        interests.tell(LinkId(3), &other, Some((8, 10)));
        assert_eq!(interests.take_told(LinkId(1), &[name]), []);
        assert_eq!(interests.take_told(LinkId(9), &[name]), [LinkId(1)]);
        assert_eq!(interests.take_told(LinkId(9), &[name]), []);
        assert_eq!(interests.told(LinkId(3), &other), Some(Some((8, 10))));
    }

    #[test]
    fn nothing_is_left_of_removed_interests() {
        let name = Name([1; 32]);
        let mut interests = Interests::default();
        interests.add(LinkId(1), name);
        interests.add(LinkId(2), name);
        assert!(!interests.remove(LinkId(3), &name));
        assert!(!interests.remove(LinkId(1), &name) && interests.is_watched(&name));
        assert!(interests.remove(LinkId(2), &name));
        assert!(interests.of_link.is_empty() && interests.watchers.is_empty());
    }
}
