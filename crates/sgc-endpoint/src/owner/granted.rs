//! [`GrantedSink`]: a request that was granted, and the bounds of such requests.

use bytes::Bytes;
use sgc_trust::VerifiedPeer;
use sgc_wire::{GrantContent, Name, RefuseReason, Request, SinkId, UnixMillis};

use crate::config::Limits;
use crate::context::Context;

/// A granted sink.
#[derive(Clone, Debug)]
pub(crate) struct GrantedSink {
    pub(crate) peer: VerifiedPeer,
    pub(crate) request: Request,
    pub(crate) reply_key: Bytes,
    /// Time at which the request was signed: a replayed request is never newer than the last of its node.
    pub(crate) issued_at: UnixMillis,
    /// Serial of the last answer.
    pub(crate) serial: u64,
}

impl GrantedSink {
    /// Grants the request, under the next serial. Returns `false` if its reply key is unusable; it is then refused.
    pub(crate) fn grant(
        &mut self,
        cx: &mut Context,
        name: Name,
        sink: SinkId,
        content: &GrantContent,
    ) -> bool {
        self.serial += 1;
        cx.grant(name, sink, self.serial, &self.reply_key, content)
    }

    /// Refuses the request, which thereby ends.
    pub(crate) fn refuse(self, cx: &mut Context, name: Name, sink: SinkId, reason: RefuseReason) {
        cx.refuse(name, sink, self.serial + 1, reason);
    }
}

/// Returns `true` if a request of a node was signed before another one of it, and so is a replay.
pub(crate) fn is_older(asked: &GrantedSink, known: &GrantedSink) -> bool {
    asked.peer.node_id == known.peer.node_id && asked.issued_at < known.issued_at
}

/// Returns the place that a request takes from its own node, if the node is at its limit: that of the request signed
/// first. Routers on the way may withhold leaves and replay requests, but sign none.
pub(crate) fn place<'a, K: Copy + 'a>(
    granted: impl ExactSizeIterator<Item = (&'a K, &'a GrantedSink)>,
    asked: &GrantedSink,
    limits: &Limits,
) -> Result<Option<K>, RefuseReason> {
    let all = granted.len();
    let of_peer: Vec<_> = granted
        .filter(|(_, s)| s.peer.node_id == asked.peer.node_id)
        .map(|(key, s)| (s.issued_at, *key))
        .collect();
    if of_peer.len() >= limits.sinks_per_peer_max {
        let oldest = of_peer.iter().min_by_key(|(issued_at, _)| *issued_at);
        let oldest = oldest.filter(|(issued_at, _)| *issued_at < asked.issued_at);
        return oldest.map(|(_, key)| Some(*key)).ok_or(RefuseReason::Limit);
    }
    if all >= limits.sinks_per_name_max { Err(RefuseReason::Limit) } else { Ok(None) }
}
