//! The share of each peer: its place in the queues, its rate and keep-alive, and the log of those that are refused.

pub(crate) mod control_queue;
pub(crate) mod peer_policies;
pub(crate) mod peer_rate;
pub(crate) mod refusal_log;
