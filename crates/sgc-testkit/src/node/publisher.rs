//! A source of a node on a topic of another node.

use sgc_endpoint::{Source, SourceConfig};
use sgc_trust::MessageKey;
use sgc_wire::{Packet, TopicGrant};

use crate::ids::NodeKey;

/// A source of this node on another's topic.
pub(crate) struct Publisher {
    owner: NodeKey,
    config: SourceConfig,
    message_key: MessageKey,
    /// The grant with the key of `source`.
    grant: Option<TopicGrant>,
    pub(crate) source: Option<Source>,
}

impl Publisher {
    pub(crate) fn new(owner: NodeKey, config: SourceConfig, message_key: MessageKey) -> Self {
        Self { owner, config, message_key, grant: None, source: None }
    }

    /// Returns the topic's owner.
    pub(crate) fn owner(&self) -> NodeKey {
        self.owner
    }

    pub(crate) fn take_grant(&mut self, grant: TopicGrant, emit: impl FnMut(Packet)) {
        let of_same_run = |known: &TopicGrant| known.epoch < grant.epoch || known.key == grant.key;
        match &mut self.source {
            Some(source) if self.grant.as_ref().is_some_and(of_same_run) => {
                let _ = source.rekey(&grant, emit);
            }
            // The first grant, or one of a restarted owner, under whose keys no message was sealed yet.
            source => *source = Source::new(self.config.clone(), &grant, self.message_key.clone()),
        }
        self.grant = Some(grant);
    }
}
