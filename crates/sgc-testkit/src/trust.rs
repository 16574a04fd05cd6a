//! Actions on the trust between nodes: changes of rights, certificates, revocations and clocks.

use std::sync::Arc;
use std::time::Duration;

use bytes::Bytes;
use sgc_trust::TrustAnchors;
use sgc_wire::{Now, UnixMillis};

use crate::cast::{identity, with_fleet};
use crate::ids::NodeKey;
use crate::node::{Node, Sharing, policy};
use crate::world::World;

impl World {
    /// Changes the recipients of a shared topic. Its name and sources stay.
    pub fn reshare(&mut self, node: NodeKey, topic: &str, sharing: Sharing) {
        self.note(format!("reshare {node:?} {topic} {sharing:?}"));
        let (now, name) = (self.now_at(node), self.name(node, topic));
        let policy = policy(&self.nodes[node.0].identity, &sharing, &self.directory);
        let Node { shares, running, .. } = &mut self.nodes[node.0];
        shares.insert(topic.to_owned(), sharing);
        if let Some(running) = running {
            running.endpoint.update_policy(now, &name, policy);
        }
        self.settle(node);
    }

    /// Lets a node believe another fleet's CA too.
    pub fn trust_fleet(&mut self, node: NodeKey, fleet: &str) {
        self.note(format!("{node:?} trusts {fleet}"));
        let Node { identity, anchors, .. } = &self.nodes[node.0];
        let both = with_fleet(anchors.as_deref().unwrap_or(identity.anchors()), fleet);
        self.trust(node, both);
    }

    /// Removes all fleets but its own from those that a node trusts.
    pub fn trust_own_fleet_only(&mut self, node: NodeKey) {
        self.note(format!("{node:?} trusts its own fleet only"));
        let own = self.nodes[node.0].identity.anchors().clone();
        self.trust(node, own);
    }

    fn trust(&mut self, node: NodeKey, trusted: TrustAnchors) {
        let now = self.now_at(node);
        let Node { anchors, running, .. } = &mut self.nodes[node.0];
        let trusted = Arc::new(trusted);
        *anchors = Some(trusted.clone());
        if let Some(running) = running {
            running.set_anchors(now, trusted);
        }
        self.settle(node);
    }

    /// Returns the newest epoch in which the owner publishes a topic.
    pub fn epoch(&self, owner: NodeKey, topic: &str) -> Option<u32> {
        let running = self.nodes[owner.0].running.as_ref()?;
        Some(running.sources.get(&self.name(owner, topic))?.source.epoch())
    }

    /// Begins a new epoch of a topic.
    pub fn rotate(&mut self, node: NodeKey, topic: &str) {
        self.note(format!("rotate {node:?} {topic}"));
        let (now, name) = (self.now_at(node), self.name(node, topic));
        if let Some(running) = &mut self.nodes[node.0].running {
            running.endpoint.rotate(now, &name);
        }
        self.settle(node);
    }

    /// Gives a node a new certificate. Its links keep the old one.
    pub fn renew(&mut self, node: NodeKey) {
        self.note(format!("renew {node:?}"));
        let now = self.now_at(node);
        let member = &mut self.members[node.0];
        (member.renewal, member.from, member.valid) = (member.renewal + 1, Some(self.clock.elapsed()), None);
        let renewed = identity(member);
        let Node { identity, running, .. } = &mut self.nodes[node.0];
        *identity = renewed.clone();
        if let Some(running) = running {
            running.renew(now, renewed);
        }
        self.settle(node);
    }

    /// Enrols a revoked node again: it starts with an identity of its next incarnation.
    pub fn enroll_again(&mut self, node: NodeKey) {
        self.note(format!("enroll {node:?} again"));
        let member = &mut self.members[node.0];
        member.incarnation += 1;
        self.nodes[node.0].identity = identity(member);
        self.restart(node);
    }

    /// Gives a node a revocation list, as its user would. Returns `true` if the list is new to it.
    pub fn hand_crl(&mut self, node: NodeKey, der: &Bytes) -> bool {
        self.note(format!("hand a revocation list to {node:?}"));
        let now = self.now_at(node);
        let Some(running) = &mut self.nodes[node.0].running else { return false };
        let news = running.router.add_crl(now, der).expect("a list of a trusted CA");
        self.settle(node);
        news
    }

    /// Returns `true` unless a node knows that the certificate of `other` is revoked.
    pub fn believes(&self, node: NodeKey, other: NodeKey) -> bool {
        let anchors = self.nodes[node.0].anchors.as_deref();
        anchors.is_none_or(|anchors| !anchors.is_peer_revoked(self.identity(other).as_peer()))
    }

    /// Returns the revocation lists that a node has.
    pub fn revocations(&self, node: NodeKey) -> Vec<Bytes> {
        let anchors = self.nodes[node.0].anchors.as_deref();
        anchors.into_iter().flat_map(|anchors| anchors.crls().cloned()).collect()
    }

    /// Deletes the state that a node keeps over restarts, like a new disk.
    pub fn forget_disk(&mut self, node: NodeKey) {
        self.nodes[node.0].anchors = None;
    }

    /// Sets a node's wall clock ahead of the true time.
    pub fn set_ahead(&mut self, node: NodeKey, by: Duration) {
        self.set_clock(node, by.as_millis() as i64);
    }

    /// Sets a node's wall clock behind the true time.
    pub fn set_behind(&mut self, node: NodeKey, by: Duration) {
        self.set_clock(node, -(by.as_millis() as i64));
    }

    /// Sets a node's wall clock.
    fn set_clock(&mut self, node: NodeKey, skew_ms: i64) {
        self.nodes[node.0].skew_ms = skew_ms;
        let now = self.now_at(node);
        let Node { running, frozen: None, .. } = &mut self.nodes[node.0] else { return };
        if let Some(running) = running {
            running.handle_timeout(now);
            self.settle(node);
        }
    }

    /// Returns the present by a node's clocks.
    pub(crate) fn now_at(&self, node: NodeKey) -> Now {
        let Now { instant, unix } = self.clock.now();
        Now { instant, unix: UnixMillis(unix.0.saturating_add_signed(self.nodes[node.0].skew_ms)) }
    }
}
