//! Refusals on which an operator has to act, whatever topic is asked about.

use std::collections::BTreeMap;

use sgc_node::graph::{Graph, Link};

use crate::finding::{Hop, Refused, RefusedSide};
use crate::refusals::{CONTROL, DOOR, GATEWAY, Refusal};

/// Most refusals that `sgc why` reports before its walk, by descending count.
const NAMED_MAX: usize = 8;

/// Returns the refusals on which an operator has to act, with the current links that cause them.
pub(super) fn refused(graph: &Graph) -> Vec<Refused> {
    let counts = [
        (RefusedSide::Frames, CONTROL, &graph.drops),
        (RefusedSide::Peers, DOOR, &graph.refused),
        (RefusedSide::Programs, GATEWAY, &graph.gateway_refused),
    ];
    let of = |(side, table, counts): (RefusedSide, &'static [Refusal], &BTreeMap<String, u64>)| {
        let counted = |counter: &'static Refusal| {
            let count = counts.get(counter.key).copied().filter(|count| *count > 0)?;
            Some(Refused { side, counter, count, by: culprits(graph, counter.key) })
        };
        table.iter().filter(|refusal| refusal.is_named).filter_map(counted).collect::<Vec<_>>()
    };
    let mut all: Vec<_> = counts.into_iter().flat_map(of).collect();
    all.sort_by_key(|refused| std::cmp::Reverse(refused.count));
    all.truncate(NAMED_MAX);
    all
}

/// Returns the current links that cause a refusal, with their counts.
fn culprits(graph: &Graph, key: &str) -> Vec<(u64, Hop)> {
    let of_link = |link: &Link| {
        let count = graph.drops.get(&format!("{key} from link {}", link.id))?;
        Some((*count, Hop::over(graph, link.id)))
    };
    graph.links.iter().filter_map(of_link).collect()
}
