//! [`Publishers`]: publishing on names of other nodes, from the offer over the owner's grants to the change of keys,
//! with the signing keys of this node's messages.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use sgc_endpoint::{Receivers, RecoveryLimits, Source, SourceConfig};
use sgc_ros::{Guid, Shaping};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{Class, Name, NodeId, Qos, SourceId, SourceOffer, TopicGrant};

use crate::data::sending::message_keys::MessageKeys;
use crate::data::sending::source_map::SourceSlot;

/// Time for which a publisher keeps the old key of another node's topic. The owner gives the others as long to get the
/// new one.
const REKEY_WAIT: Duration = Duration::from_secs(1);

/// A topic of another node that this node wants to publish on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Offer {
    pub(crate) owner: NodeId,
    /// Suite id on the wire.
    pub(crate) suite: u8,
    pub(crate) class: Class,
    pub(crate) reliable: bool,
    pub(crate) shaping: Shaping,
    /// Whether it is a service.
    pub(crate) calls: bool,
}

/// Effect of an offer.
#[derive(Debug)]
pub(crate) enum OfferStep {
    /// The owner is asked for permission to publish with this source.
    Ask(SourceOffer),
    /// The offer waits for a signing key, which is to be created.
    MakeKey(Suite),
    /// The offer waits for a signing key that is being created.
    Wait,
    /// This build lacks the suite.
    UnknownSuite,
}

/// Effect of a grant to publish.
pub(crate) enum GrantStep {
    /// The key stays, or changes later.
    Kept,
    /// Numbers begin again under another key, because the owner is new or has restarted. Messages leave by this source;
    /// `None` if the grant is unusable.
    Anew(Option<SourceSlot>),
}

/// The names of other nodes on which this node publishes, and its signing keys.
pub(crate) struct Publishers {
    /// Sources that were offered to their owners.
    offered: BTreeMap<Name, OfferedSource>,
    /// Offers that wait for a signing key.
    keyless: BTreeMap<Name, Offer>,
    /// Signing keys of this node's messages, by suite.
    keys: MessageKeys,
}

impl Publishers {
    /// Creates the part without offers.
    pub(crate) fn new(keys: MessageKeys) -> Self {
        Self { offered: BTreeMap::new(), keyless: BTreeMap::new(), keys }
    }

    /// Offers to publish under `name`, at once or when there is a signing key.
    pub(crate) fn offer(
        &mut self,
        name: Name,
        offer: Offer,
        new_source_id: impl FnOnce() -> SourceId,
    ) -> OfferStep {
        let Some(suite) = Suite::from_id(offer.suite) else { return OfferStep::UnknownSuite };
        let Some(key) = self.keys.get(&suite) else {
            let is_first = self.keyless.values().all(|other| other.suite != offer.suite);
            self.keyless.insert(name, offer);
            return if is_first { OfferStep::MakeKey(suite) } else { OfferStep::Wait };
        };
        let id = new_source_id();
        self.offered.insert(name, OfferedSource::new(id, &offer));
        OfferStep::Ask(SourceOffer { source: id, key: key.public().clone() })
    }

    /// Changes the shaping of an offer that waits.
    pub(crate) fn set_shaping(&mut self, name: &Name, shaping: Shaping) {
        if let Some(offer) = self.keyless.get_mut(name) {
            offer.shaping = shaping;
        }
    }

    /// Adds signing keys. Existing keys stay. Returns the waiting offers, which are then made again.
    pub(crate) fn add_keys(&mut self, keys: MessageKeys) -> BTreeMap<Name, Offer> {
        for (suite, key) in keys {
            self.keys.entry(suite).or_insert(key);
        }
        std::mem::take(&mut self.keyless)
    }

    /// Returns the signing key of a suite, one for the whole node. Keys that take long to create exist before they are
    /// needed.
    pub(crate) fn key(&mut self, suite: u8) -> Option<MessageKey> {
        let suite = Suite::from_id(suite)?;
        Some(self.keys.entry(suite).or_insert_with(|| MessageKey::generate(suite)).clone())
    }

    /// Handles a grant to publish, or a new epoch. Returns `None` if this node does not publish under `name`.
    pub(crate) fn granted(&mut self, now: Instant, name: Name, grant: &TopicGrant) -> Option<GrantStep> {
        let publisher = self.offered.get_mut(&name)?;
        if publisher.granted(now, grant) == GrantEffect::Kept {
            return Some(GrantStep::Kept);
        }
        let OfferedSource { id, class, reliable, calls, .. } = *publisher;
        // Only sources of the owner can be asked for missing messages.
        let recovery = RecoveryLimits::NONE;
        let (history_depth, history_bytes_max) = (0, 0);
        // Of a service the owner is the only receiver. Of a topic, nobody but the owner has the keys of receivers.
        let receivers = grant.receiver.clone().map(|key| Arc::new(Receivers::of_caller(key)));
        let config =
            SourceConfig { name, id, class, reliable, history_depth, history_bytes_max, recovery, receivers };
        // Several publishers share the source of a topic, so none of them begins with it.
        let make = if calls { Source::new } else { Source::midway };
        let source = self.key(grant.suite).and_then(|key| make(config, grant, key));
        Some(GrantStep::Anew(source.map(|source| SourceSlot::new(source, false, reliable))))
    }

    /// Sets the local publishers whose assertions of liveliness are passed on under a name.
    pub(crate) fn watch(&mut self, name: &Name, publishers: Vec<(Guid, Qos)>) {
        if let Some(publisher) = self.offered.get_mut(name) {
            publisher.watched = publishers;
        }
    }

    /// Returns the local publishers whose assertions of liveliness are passed on under a name.
    pub(crate) fn watched(&self, name: &Name) -> &[(Guid, Qos)] {
        self.offered.get(name).map_or(&[], |publisher| &publisher.watched)
    }

    /// Returns the names whose next epoch begins now, with their grants.
    pub(crate) fn take_rekeys(&mut self, now: Instant) -> Vec<(Name, TopicGrant)> {
        let due = self.offered.iter_mut().filter_map(|(name, one)| Some((*name, one.take_due(now)?)));
        due.collect()
    }

    /// Returns the time of the next change of keys.
    pub(crate) fn deadline(&self) -> Option<Instant> {
        self.offered.values().filter_map(OfferedSource::deadline).min()
    }

    /// Ends publishing under a name. Returns `true` if its source was offered.
    pub(crate) fn stop(&mut self, name: &Name) -> bool {
        self.keyless.remove(name);
        self.offered.remove(name).is_some()
    }
}

/// State of publishing under another node's name.
struct OfferedSource {
    id: SourceId,
    class: Class,
    reliable: bool,
    /// Whether it calls a service.
    calls: bool,
    /// Grant of the source's current key; `None` until the owner granted it.
    grant: Option<TopicGrant>,
    /// Key of the next epoch, and its beginning.
    next: Option<(Instant, TopicGrant)>,
    /// Local publishers that may assert their liveliness without a message.
    watched: Vec<(Guid, Qos)>,
}

/// Effect of a grant on the key of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum GrantEffect {
    /// The key stays, or changes later.
    Kept,
    /// Numbers begin again under another key.
    Anew,
}

impl OfferedSource {
    /// Creates the state before the first grant.
    fn new(id: SourceId, offer: &Offer) -> Self {
        let Offer { class, reliable, calls, .. } = *offer;
        Self { id, class, reliable, calls, grant: None, next: None, watched: Vec::new() }
    }

    /// Handles a grant to publish, or a new epoch.
    fn granted(&mut self, now: Instant, grant: &TopicGrant) -> GrantEffect {
        match &self.grant {
            Some(known) if (known.epoch, &known.key) == (grant.epoch, &grant.key) => GrantEffect::Kept,
            Some(known) if known.epoch < grant.epoch => {
                self.next = Some((now + REKEY_WAIT, grant.clone()));
                GrantEffect::Kept
            }
            Some(_) | None => {
                self.grant = Some(grant.clone());
                self.next = None;
                GrantEffect::Anew
            }
        }
    }

    /// Returns the key of the next epoch once it has begun. It is the current one from then on.
    fn take_due(&mut self, now: Instant) -> Option<TopicGrant> {
        let (_, grant) = self.next.take_if(|(at, _)| *at <= now)?;
        self.grant = Some(grant.clone());
        Some(grant)
    }

    /// Returns the beginning of the next epoch.
    fn deadline(&self) -> Option<Instant> {
        self.next.as_ref().map(|(at, _)| *at)
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::SecretBytes;

    use super::*;

    const NAME: Name = Name([1; 32]);
    const ID: SourceId = SourceId([2; 16]);

    fn offer(suite: u8) -> Offer {
        let (class, shaping) = (Class::Default, Shaping::default());
        Offer { owner: NodeId([5; 32]), suite, class, reliable: true, shaping, calls: false }
    }

    fn keys() -> MessageKeys {
        [(Suite::Group, MessageKey::generate(Suite::Group))].into()
    }

    #[test]
    fn offers_wait_for_one_signing_key_and_are_made_again_with_it() {
        let mut publishers = Publishers::new(MessageKeys::new());
        let mut step = |name, suite| publishers.offer(name, offer(suite), || panic!("there is no key"));
        assert!(matches!(step(NAME, Suite::Group.id()), OfferStep::MakeKey(Suite::Group)));
        assert!(matches!(step(Name([2; 32]), Suite::Group.id()), OfferStep::Wait));
        assert!(matches!(step(Name([3; 32]), 0xff), OfferStep::UnknownSuite));
        publishers.stop(&Name([2; 32]));
        let shaping = Shaping { max_age: Some(Duration::from_secs(7)), ..Shaping::default() };
        publishers.set_shaping(&NAME, shaping);
        let again = publishers.add_keys(keys());
        assert_eq!(again, [(NAME, Offer { shaping, ..offer(Suite::Group.id()) })].into());
        let step = publishers.offer(NAME, again[&NAME], || ID);
        assert!(matches!(step, OfferStep::Ask(SourceOffer { source: ID, .. })), "{step:?}");
        assert!(publishers.stop(&NAME) && !publishers.stop(&NAME));
    }

    #[test]
    fn key_of_the_next_epoch_is_used_after_a_wait_and_that_of_a_restarted_owner_at_once() {
        let mut publishers = Publishers::new(keys());
        publishers.offer(NAME, offer(Suite::Group.id()), || ID);
        let begin = Instant::now();
        let grant = |epoch, key: u8| {
            let (suite, key) = (Suite::Group.id(), SecretBytes::new([key; 32]));
            TopicGrant { epoch, suite, key, receiver: None, sources: Vec::new(), entry: None }
        };
        assert!(
            publishers.granted(begin, Name([9; 32]), &grant(1, 1)).is_none(),
            "nothing is published there"
        );
        let anew = publishers.granted(begin, NAME, &grant(1, 1));
        assert!(matches!(anew, Some(GrantStep::Anew(Some(slot))) if slot.id == ID && slot.reliable));
        assert!(matches!(publishers.granted(begin, NAME, &grant(1, 1)), Some(GrantStep::Kept)));
        assert_eq!(publishers.deadline(), None);
        assert!(matches!(publishers.granted(begin, NAME, &grant(2, 2)), Some(GrantStep::Kept)));
        assert_eq!(publishers.take_rekeys(begin), []);
        let due = publishers.deadline().unwrap();
        assert_eq!(due, begin + REKEY_WAIT);
        assert_eq!(publishers.take_rekeys(due), [(NAME, grant(2, 2))]);
        assert_eq!((publishers.take_rekeys(due), publishers.deadline()), (vec![], None));
        // The owner counts from 1 again, under another key.
        let anew = publishers.granted(due, NAME, &grant(1, 7));
        assert!(matches!(anew, Some(GrantStep::Anew(Some(_)))));
    }
}
