//! The programs of other nodes in the graph of the local network.

pub(crate) mod far_consumers;
pub(crate) mod local_graph;
