//! Topics on which other nodes than the owner publish: a node's sources on topics of others, and the sink of its own
//! topic.

use std::collections::BTreeMap;

use sgc_endpoint::{JoinKind, RecoveryLimits, Sink, SinkLimits, SourceConfig};
use sgc_trust::{MessageKey, Suite, name_of};
use sgc_wire::{Name, NodeId, Now, Reliability, SinkId, SourceId, SourceOffer, TopicGrant};

use super::publisher::Publisher;
use super::{Directory, EPOCH_GRACE, LocalSink, Running, sealed};
use crate::ids::{MessageId, NodeKey};

impl Running {
    /// Publishes on another's topic whenever its catalogue permits it.
    pub(crate) fn publish_on(&mut self, now: Now, owner: NodeKey, topic: &str, directory: &Directory) {
        self.publishing.insert((owner, topic.to_owned()));
        self.follow(now, owner, directory);
    }

    /// Publishes on another's topic. Returns `None` while that is not granted.
    pub(crate) fn publish_as(
        &mut self,
        now: Now,
        name: &Name,
        id: MessageId,
        bytes: usize,
    ) -> Option<SourceId> {
        let source = self.publishers.get_mut(name)?.source.as_mut()?;
        let (packets, source) = (sealed(source, id, bytes), source.id());
        self.send_packets(now, packets);
        Some(source)
    }

    /// Joins topics on which the node wants to publish, and leaves all others.
    pub(crate) fn reconcile_publishers(&mut self, now: Now, owner: NodeKey, owner_id: NodeId) {
        let mut wanted = BTreeMap::new();
        for entry in self.catalogues.get(&owner).iter().flat_map(|c| &c.entries).filter(|e| e.publish) {
            if self.publishing.contains(&(owner, entry.metadata.ros_name.clone())) {
                wanted.insert(name_of(&owner_id, &entry.blind), entry.clone());
            }
        }
        let gone = |(name, p): (&Name, &Publisher)| {
            (p.owner() == owner && !wanted.contains_key(name)).then_some(*name)
        };
        for name in self.publishers.iter().filter_map(gone).collect::<Vec<_>>() {
            self.publishers.remove(&name);
            self.endpoint.leave(now, &name);
        }
        for (name, entry) in wanted {
            if self.publishers.contains_key(&name) {
                continue;
            }
            let suite = Suite::from_id(entry.suite).expect("a suite of this build");
            let config = SourceConfig {
                name,
                id: self.endpoint.new_source_id(),
                class: entry.class,
                reliable: entry.qos.reliability == Reliability::Reliable,
                history_depth: 0,
                history_bytes_max: 0,
                recovery: RecoveryLimits::NONE,
                receivers: None,
            };
            let message_key = MessageKey::generate(suite);
            let offer = SourceOffer { source: config.id, key: message_key.public().clone() };
            self.publishers.insert(name, Publisher::new(owner, config, message_key));
            self.endpoint.join(now, name, owner_id, JoinKind::Publish(offer));
        }
    }

    /// Feeds this node's own sink of a topic that others publish on.
    pub(crate) fn handle_own_grant(&mut self, now: Now, name: Name, grant: TopicGrant) {
        let Some(share) = self.sources.get(&name) else {
            // The share is still being made. The grant comes again with its source.
            return;
        };
        let mut released = Vec::new();
        let own = SinkId([0; 16]);
        let local = self.sinks.entry(name).or_insert_with(|| LocalSink {
            owner: self.key,
            topic: share.topic.clone(),
            use_number: 0,
            transient_local: false,
            sources: Vec::new(),
            sink: None,
            retry_at: None,
            retire_at: None,
        });
        match &mut local.sink {
            Some(sink) => sink.regrant(own, grant, |delivery| released.push(delivery)),
            None => local.sink = Some(Sink::new(name, own, grant, false, SinkLimits::default())),
        }
        if let Some(sink) = &local.sink {
            self.endpoint.set_own_sink(&name, sink.progress());
        }
        local.retire_at = Some(now.instant + EPOCH_GRACE);
        for delivery in released {
            self.delivered(now, name, delivery);
        }
    }
}
