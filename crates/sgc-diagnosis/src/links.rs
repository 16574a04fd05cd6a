//! Links in the words of an operator.

use sgc_node::graph::Graph;
use sgc_process::output;

/// Names a link by its number, its peer and its round trip.
pub(crate) fn link_of(graph: &Graph, link: u32) -> String {
    match graph.links.iter().find(|l| l.id == link) {
        _ if link == 0 => "this node".to_owned(),
        Some(l) => {
            let peer = l.name.clone().unwrap_or_else(|| l.peer.chars().take(8).collect());
            format!("link {link} to {peer} at {} ({})", l.remote, output::millis(l.rtt_us))
        }
        None => format!("link {link}"),
    }
}

/// Formats microseconds as milliseconds.
pub(crate) fn millis(us: u32) -> String {
    output::millis(us.into())
}
