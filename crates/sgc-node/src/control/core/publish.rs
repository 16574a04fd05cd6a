//! Publishing on names of other nodes, and messages of other publishers on our shares.

use std::sync::Arc;
use std::time::Instant;

use sgc_endpoint::{JoinKind, RecoveryLimits, Source, SourceConfig};
use sgc_ros::RosNetwork;
use sgc_trust::{MessageKey, Suite};
use sgc_wire::{Name, Now, SinkId, SourceOffer, TopicGrant};
use tracing::warn;

use super::Core;
use crate::clock::now;
use crate::control::event::CoreEvent;
use crate::control::publishing::{GrantEffect, Offer, Publishing};
use crate::data::sending::message_keys::MessageKeys;
use crate::data::sending::share::LocalShare;
use crate::data::sending::source_map::{SourceMap, SourceSlot};
use crate::data::sinks::LocalSink;

impl<N: RosNetwork> Core<N> {
    /// Asks the owner of `name` for permission to publish, at once or when there is a signing key.
    pub(super) fn publish_under(&mut self, name: Name, wanted: Offer) {
        let Offer { owner, suite, class, reliable, shaping, calls } = wanted;
        let Some(suite) = Suite::from_id(suite) else {
            warn!(suite, "a topic's suite is not in this build; this node cannot publish on it");
            return;
        };
        let Some(message_key) = self.message_keys.get(&suite).cloned() else {
            if self.keyless.values().all(|other| other.suite != wanted.suite) {
                self.make_message_key(suite);
            }
            self.keyless.insert(name, wanted);
            return;
        };
        let id = self.endpoint.new_source_id();
        let (max, over) = (self.epoch_messages_max, self.epoch_over.clone());
        let share = Arc::new(LocalShare::new(name, self.data.clone(), self.alive.clone(), max, over));
        share.set_shaping(shaping);
        self.shares.insert(name, share);
        self.publishing.insert(name, Publishing::new(id, class, reliable));
        let offer = SourceOffer { source: id, key: message_key.public().clone() };
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
        for (suite, key) in keys {
            self.message_keys.entry(suite).or_insert(key);
        }
        for (name, wanted) in std::mem::take(&mut self.keyless) {
            self.publish_under(name, wanted);
        }
    }

    /// Handles a grant to publish, or a new epoch. Returns `None` if this node does not publish under `name`, and
    /// `true` if the owner knows nothing of earlier messages.
    pub(super) fn publishing_granted(&mut self, now: Now, name: Name, grant: &TopicGrant) -> Option<bool> {
        let publishing = self.publishing.get_mut(&name)?;
        if publishing.granted(now.instant, grant) == GrantEffect::Kept {
            return Some(false);
        }
        // Only sources of the owner can be asked for missing messages.
        let (id, class, reliable) = publishing.source();
        let config = SourceConfig {
            name,
            id,
            class,
            reliable,
            history_depth: 0,
            history_bytes_max: 0,
            recovery: RecoveryLimits::NONE,
        };
        let key = self.message_key(grant.suite);
        let source = key.and_then(|key| Source::new(config, grant, key));
        if let (Some(source), Some(share)) = (source, self.shares.get(&name)) {
            let shared = Some(SourceSlot::new(source, false, reliable));
            share.set_map(SourceMap { shared, ..SourceMap::default() });
        }
        Some(true)
    }

    /// Switches to the keys whose epoch begins now.
    pub(super) fn rekey_due(&mut self, now: Now) {
        for (name, publishing) in &mut self.publishing {
            let due = publishing.take_due(now.instant);
            if let (Some(grant), Some(share)) = (due, self.shares.get(name)) {
                share.rekey(grant.clone());
                publishing.rekeyed(grant);
            }
        }
    }

    pub(super) fn rekey_deadline(&self) -> Option<Instant> {
        self.publishing.values().filter_map(Publishing::deadline).min()
    }

    pub(super) fn stop_publishing(&mut self, name: &Name) {
        self.keyless.remove(name);
        if self.publishing.remove(name).is_some()
            && let Some(share) = self.shares.remove(name)
        {
            share.close();
        }
    }

    /// Handles the key and the publishers of our own share on which others may publish.
    pub(super) fn own_grant(&mut self, name: Name, grant: TopicGrant) {
        let own: Vec<_> = self.shares.get(&name).iter().flat_map(|s| s.map().ids()).collect();
        let others = grant.sources.iter().any(|s| !own.contains(&s.source));
        let sink = self
            .sinks
            .entry(name)
            .or_insert_with(|| {
                Arc::new(LocalSink::new(name, false, self.requests.clone(), self.data.holds().clone()))
            })
            .clone();
        self.apply_type(&name);
        // This node's own messages do not come back to it, since its sink receives only others'.
        sink.grant(SinkId([0; 16]), grant, &self.data);
        if let Some(progress) = sink.progress() {
            self.endpoint.set_own_sink(&name, progress);
        }
        self.sink_timers.epoch_ended(name, now().instant);
        if let Some(routes) = &mut self.routes {
            routes.handle_publishers(&name, others);
            self.consumers.show_soon(now().instant);
        }
    }
}
