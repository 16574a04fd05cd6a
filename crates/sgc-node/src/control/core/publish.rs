//! Publishing on names of other nodes, and messages of other publishers on our shares.

use sgc_endpoint::JoinKind;
use sgc_ros::{Guid, RosNetwork};
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{Name, Now, Qos, SinkId, TopicGrant};
use tracing::warn;

use super::Core;
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::parts::publishers::{GrantStep, Offer, OfferStep};
use crate::data::sending::message_keys::MessageKeys;
use crate::data::sending::source_map::SourceMap;

impl<N: RosNetwork> Core<N> {
    /// Asks the owner of `name` for permission to publish, at once or when there is a signing key.
    pub(super) fn publish_under(&mut self, name: Name, wanted: Offer) {
        let Offer { owner, suite, shaping, calls, .. } = wanted;
        let offer = match self.publishers.offer(name, wanted, || self.endpoint.new_source_id()) {
            OfferStep::Ask(offer) => offer,
            OfferStep::MakeKey(suite) => return self.make_message_key(suite),
            OfferStep::Wait => return,
            OfferStep::UnknownSuite => {
                warn!(suite, "a topic's suite is not in this build; this node cannot publish on it");
                return;
            }
        };
        self.shares.add(name).set_shaping(shaping);
        self.endpoint.join(now(), name, owner, JoinKind::Publish(offer));
        if calls {
            self.begin_far(name);
        }
    }

    fn make_message_key(&self, suite: Suite) {
        let Some(events) = self.events.upgrade() else { return };
        let alive = self.alive.clone();
        tokio::task::spawn_blocking(move || {
            let _alive = alive;
            let keys = MessageKeys::from([(suite, MessageKey::generate(suite))]);
            let _ = events.blocking_send(CoreEvent::MessageKeys(keys));
        });
    }

    /// Adds signing keys. Existing keys stay.
    pub(super) fn add_message_keys(&mut self, keys: MessageKeys) {
        for (name, wanted) in self.publishers.add_keys(keys) {
            self.publish_under(name, wanted);
        }
    }

    /// Handles a grant to publish, or a new epoch. Returns `None` if this node does not publish under `name`, and
    /// `true` if the owner knows nothing of earlier messages.
    pub(super) fn publishing_granted(&mut self, now: Now, name: Name, grant: &TopicGrant) -> Option<bool> {
        let GrantStep::Anew(slot) = self.publishers.granted(now.instant, name, grant)? else {
            return Some(false);
        };
        if let (Some(slot), Some(share)) = (slot, self.shares.get(&name).cloned()) {
            let map = SourceMap::of_one(slot, self.publishers.watched(&name), &share.map(), now.instant);
            self.set_map(&share, map);
        }
        Some(true)
    }

    /// Passes on the assertions of these local publishers under a name of another node, and of no others.
    pub(super) fn watch_publishers(&mut self, name: Name, publishers: Vec<(Guid, Qos)>) {
        let Some(share) = self.shares.get(&name).cloned() else { return };
        let before = share.map();
        if let Some(slot) = before.shared.clone() {
            self.set_map(&share, SourceMap::of_one(slot, &publishers, &before, now().instant));
        }
        self.publishers.watch(&name, publishers);
    }

    /// Switches to the keys whose epoch begins now.
    pub(super) fn rekey_due(&mut self, now: Now) {
        for (name, grant) in self.publishers.take_rekeys(now.instant) {
            if let Some(share) = self.shares.get(&name) {
                share.rekey(grant);
            }
        }
    }

    pub(super) fn stop_publishing(&mut self, name: &Name) {
        if self.publishers.stop(name) {
            self.shares.remove(name);
        }
    }

    /// Handles the key and the publishers of our own share on which others may publish.
    pub(super) fn own_grant(&mut self, name: Name, grant: TopicGrant) {
        let own: Vec<_> = self.shares.get(&name).iter().flat_map(|s| s.map().ids()).collect();
        let others = grant.sources.iter().any(|s| !own.contains(&s.source));
        let sink = self.sinks.get_or_add_own(name);
        if let Some(callers) = self.endpoint.receivers(&name) {
            sink.set_callers(callers);
        }
        if self.services.get(&name).is_none() {
            sink.ask_for_writers();
        }
        self.apply_type(&name);
        // This node's own messages do not come back to it, since its sink receives only others'.
        self.sinks.grant(now().instant, name, SinkId([0; 16]), grant);
        self.set_clock(&name);
        if let Some(progress) = sink.progress() {
            self.endpoint.set_own_sink(&name, progress);
        }
        if let Some(routes) = &mut self.routes {
            routes.handle_publishers(&name, others);
            self.consumers.show_soon(now().instant);
        }
    }
}
