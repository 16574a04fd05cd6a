//! [`LocalNodes`]: the other SGC nodes on a local network, by the tags of their participants.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;

use sgc_ros::Guid;
use sgc_sync::lock;

/// Most participants that are remembered.
const NODES_MAX: usize = 64;

/// The tagged participants of other processes.
#[derive(Debug, Default)]
pub(crate) struct LocalNodes {
    tags: Mutex<BTreeMap<[u8; 12], String>>,
}

impl LocalNodes {
    /// Records a participant and its tag, or forgets one that is gone or has none.
    pub(crate) fn note(&self, guid: &Guid, tag: Option<&str>) {
        let mut tags = lock(&self.tags);
        match tag {
            Some(tag) if tags.len() < NODES_MAX || tags.contains_key(&guid.prefix()) => {
                tags.insert(guid.prefix(), tag.to_owned());
            }
            Some(tag) => tracing::debug!(tag, "too many SGC nodes on the network: one is ignored"),
            None => {
                tags.remove(&guid.prefix());
            }
        }
    }

    /// Returns the tags.
    pub(crate) fn tags(&self) -> BTreeSet<String> {
        lock(&self.tags).values().cloned().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn participants_are_remembered_within_a_bound() {
        let nodes = LocalNodes::default();
        let guid = |n: usize| {
            let mut guid = [0; 16];
            guid[..8].copy_from_slice(&n.to_be_bytes());
            Guid(guid)
        };
        for n in 0..2 * NODES_MAX {
            nodes.note(&guid(n), Some(&format!("arm-{n}")));
        }
        assert_eq!(nodes.tags().len(), NODES_MAX);
        nodes.note(&guid(0), None);
        nodes.note(&guid(1), Some("desk"));
        let tags = nodes.tags();
        assert_eq!(tags.len(), NODES_MAX - 1);
        assert!(tags.contains("desk") && !tags.contains("arm-0") && !tags.contains("arm-1"), "{tags:?}");
    }
}
