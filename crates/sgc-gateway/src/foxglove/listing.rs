//! [`Listing`]: the channels or services that were sent to a client, and how they differ from those that exist now. A
//! number is never reused.

use std::collections::BTreeMap;

/// The type of a topic or service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Offer {
    pub(super) type_name: String,
    /// The hash of the type, if the network announces it.
    pub(super) hash: Option<String>,
}

impl Offer {
    /// Returns `true` if both have the same type, as far as is known.
    fn agrees(&self, other: &Self) -> bool {
        let hashes = self.hash.as_ref().zip(other.hash.as_ref());
        self.type_name == other.type_name && hashes.is_none_or(|(one, other)| one == other)
    }
}

#[derive(Clone, Debug)]
struct Entry {
    offer: Offer,
    /// The number, if the client knows the entry.
    id: Option<u32>,
    /// The attempt at which no definition was found.
    unknown_at: Option<u64>,
}

/// The topics or services that a client knows.
#[derive(Debug, Default)]
pub(super) struct Listing {
    next: u32,
    entries: BTreeMap<String, Entry>,
    names: BTreeMap<u32, String>,
}

impl Listing {
    /// Removes entries that are gone or have changed their type. Returns their numbers.
    pub(super) fn retain(&mut self, there: &BTreeMap<String, Offer>) -> Vec<u32> {
        let mut gone = Vec::new();
        self.entries.retain(|name, entry| {
            let stays = there.get(name).is_some_and(|offer| offer.agrees(&entry.offer));
            if !stays {
                gone.extend(entry.id);
            }
            stays
        });
        gone.iter().for_each(|id| drop(self.names.remove(id)));
        gone
    }

    /// Returns up to `max` entries to send: new ones, and ones without a definition at an earlier attempt.
    pub(super) fn untold(
        &self,
        there: &BTreeMap<String, Offer>,
        attempt: u64,
        max: usize,
    ) -> Vec<(String, Offer)> {
        let is_told = |name: &String| {
            let entry = self.entries.get(name);
            entry.is_some_and(|entry| entry.unknown_at.is_none_or(|at| at >= attempt))
        };
        let untold = there.iter().filter(|(name, _)| !is_told(name)).take(max);
        untold.map(|(name, offer)| (name.clone(), offer.clone())).collect()
    }

    /// Adds an entry whose definition is known. Returns its number and the number it had without a definition.
    pub(super) fn tell(&mut self, name: &str, offer: Offer) -> (u32, Option<u32>) {
        let old = self.entries.get(name).and_then(|entry| entry.id);
        if let Some(old) = old {
            self.names.remove(&old);
        }
        let id = self.number(name);
        self.entries.insert(name.to_owned(), Entry { offer, id: Some(id), unknown_at: None });
        (id, old)
    }

    /// Adds an entry whose definition is unknown. If `numbered`, it gets a number. Returns the number if it is new.
    pub(super) fn tell_unknown(
        &mut self,
        name: &str,
        offer: Offer,
        attempt: u64,
        numbered: bool,
    ) -> Option<u32> {
        if let Some(entry) = self.entries.get_mut(name) {
            entry.unknown_at = Some(attempt);
            return None;
        }
        let id = numbered.then(|| self.number(name));
        self.entries.insert(name.to_owned(), Entry { offer, id, unknown_at: Some(attempt) });
        id
    }

    fn number(&mut self, name: &str) -> u32 {
        self.next = self.next.wrapping_add(1);
        self.names.insert(self.next, name.to_owned());
        self.next
    }

    /// Returns name and type of an entry by its number.
    pub(super) fn get(&self, id: u32) -> Option<(&str, &str)> {
        let name = self.names.get(&id)?;
        Some((name, &self.entries.get(name)?.offer.type_name))
    }

    /// Returns `true` if an entry lacks its definition.
    pub(super) fn has_unknown(&self) -> bool {
        self.entries.values().any(|entry| entry.unknown_at.is_some())
    }

    /// Returns `true` if an entry with this type lacks its definition.
    pub(super) fn is_unknown(&self, type_name: &str) -> bool {
        self.entries.values().any(|entry| entry.unknown_at.is_some() && entry.offer.type_name == type_name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn offer(type_name: &str, hash: Option<&str>) -> Offer {
        Offer { type_name: type_name.into(), hash: hash.map(str::to_owned) }
    }

    fn there(all: &[(&str, &str)]) -> BTreeMap<String, Offer> {
        all.iter().map(|(name, of)| ((*name).to_owned(), offer(of, None))).collect()
    }

    #[test]
    fn changed_offers_get_new_numbers() {
        let mut listing = Listing::default();
        let now = there(&[("/a", "T"), ("/b", "T")]);
        assert!(listing.retain(&now).is_empty());
        assert_eq!(listing.untold(&now, 0, 1), [("/a".to_owned(), offer("T", None))]);
        let (a, _) = listing.tell("/a", offer("T", None));
        let (b, _) = listing.tell("/b", offer("T", None));
        assert!(listing.untold(&now, 9, 10).is_empty() && listing.retain(&now).is_empty());
        assert_eq!(listing.get(a), Some(("/a", "T")));
        let now = there(&[("/a", "U")]);
        assert_eq!(listing.retain(&now), [a, b]);
        assert_eq!(listing.get(a), None);
        assert_ne!(listing.tell("/a", offer("U", None)).0, a);
    }

    #[test]
    fn a_hash_that_comes_later_changes_nothing_and_another_one_does() {
        let mut listing = Listing::default();
        let (id, _) = listing.tell("/a", offer("T", Some("1")));
        let with = |hash| BTreeMap::from([("/a".to_owned(), offer("T", hash))]);
        assert!(listing.retain(&with(None)).is_empty() && listing.retain(&with(Some("1"))).is_empty());
        assert_eq!(listing.retain(&with(Some("2"))), [id]);
    }

    #[test]
    fn unknown_definitions_are_looked_up_again() {
        let mut listing = Listing::default();
        let now = there(&[("/a", "T")]);
        let id = listing.tell_unknown("/a", offer("T", None), 1, true).unwrap();
        assert!(listing.untold(&now, 1, 9).is_empty() && listing.has_unknown() && listing.is_unknown("T"));
        assert_eq!(listing.untold(&now, 2, 9).len(), 1);
        assert_eq!(listing.tell_unknown("/a", offer("T", None), 2, true), None);
        let (found, old) = listing.tell("/a", offer("T", None));
        assert!(old == Some(id) && found != id && !listing.has_unknown());
        assert_eq!(listing.tell_unknown("/s", offer("S", None), 2, false), None);
    }
}
