//! [`Searches`]: the searches for routers that run, and how a reload changes them.

use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_config::{RouterUrl, SrvDomain};
use sgc_sync::lock;
use sgc_transport::{LinkUrl, ListenAddr};
use tokio::task::JoinHandle;
use tracing::warn;

use super::{Board, DialTarget, LinkKeeper, LocalNetwork, RouterFilter, keep_at, mdns, srv, urls};

/// Time for which links to routers that are no longer wanted stay while others are dialled, so that topics move over.
const HAND_OVER: Duration = Duration::from_secs(2);

/// Routers that a node looks for.
#[derive(Clone, Debug, Default)]
pub(crate) struct WantedRouters {
    /// Those of the configuration.
    pub(crate) configured: Vec<RouterUrl>,
    /// Those that only tokens name.
    pub(crate) of_tokens: Vec<RouterUrl>,
    /// Those on the local network, if any are wanted there.
    pub(crate) nearby: Option<RouterFilter>,
}

/// A router, or a place where routers are looked for.
#[derive(Clone, Debug, PartialEq, Eq)]
enum SearchTarget {
    /// One router, at any of these URLs, the best first.
    At(Vec<LinkUrl>),
    /// One of the routers of a domain.
    Domain(SrvDomain),
    /// Routers on the local network.
    Nearby(RouterFilter),
}

impl SearchTarget {
    /// Returns it as the user writes it.
    fn written(&self) -> String {
        match self {
            Self::At(urls) => RouterUrl::by(urls).to_string(),
            Self::Domain(domain) => RouterUrl::Srv(domain.clone()).to_string(),
            Self::Nearby(wanted) => wanted.written.clone(),
        }
    }
}

/// Changes of searches, as the user writes routers.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct SearchChanges {
    pub(crate) begun: Vec<String>,
    pub(crate) ended: Vec<String>,
}

/// The searches for routers of a node.
pub(crate) struct Searches {
    keeper: LinkKeeper,
    board: Board,
    mdns_port: Option<u16>,
    /// Addresses that this node announces on the local network.
    announced: Vec<ListenAddr>,
    state: Mutex<State>,
}

struct State {
    running: Vec<Running>,
    /// The local network, once it is used.
    local: Option<Arc<LocalNetwork>>,
    rng: ChaCha20Rng,
    /// Nothing begins any more.
    is_stopped: bool,
}

struct Running {
    target: SearchTarget,
    task: JoinHandle<()>,
}

impl Running {
    /// Ends the search. Its links end soon after.
    async fn end(self) {
        self.task.abort();
        let _ = self.task.await;
    }
}

impl Searches {
    /// Creates the searches, of which none runs. Announces this node at these addresses on the local network, if there
    /// are any; `mdns_port` overrides the port of mDNS in tests.
    pub(crate) fn new(
        keeper: LinkKeeper,
        board: Board,
        mdns_port: Option<u16>,
        announced: Vec<ListenAddr>,
        rng: ChaCha20Rng,
    ) -> Self {
        let state = State { running: Vec::new(), local: None, rng, is_stopped: false };
        let searches = Self { keeper, board, mdns_port, announced, state: Mutex::new(state) };
        if !searches.announced.is_empty() {
            searches.use_local(&mut searches.lock());
        }
        searches
    }

    /// Searches for these routers from here on, and for no others. Links to others end, a moment later if new ones are
    /// dialled.
    pub(crate) fn search(&self, wanted: WantedRouters) -> SearchChanges {
        let mut state = self.lock();
        if state.is_stopped {
            return SearchChanges::default();
        }
        let wanted = search_targets(wanted);
        let (kept, mut ended): (Vec<_>, Vec<_>) = std::mem::take(&mut state.running)
            .into_iter()
            .partition(|running| wanted.iter().any(|(target, _)| *target == running.target));
        state.running = kept;
        let mut changes = SearchChanges::default();
        for (target, found_by) in wanted {
            if state.running.iter().any(|running| running.target == target) {
                continue;
            }
            // One search at a time hears what is announced on the local network.
            let is_nearby = |running: &Running| matches!(running.target, SearchTarget::Nearby(_));
            let before = match &target {
                SearchTarget::Nearby(_) => ended.iter().position(is_nearby).map(|at| ended.swap_remove(at)),
                SearchTarget::At(_) | SearchTarget::Domain(_) => None,
            };
            if let Some(before) = &before {
                changes.ended.push(before.target.written());
            }
            if let Some(task) = self.begin(&target, found_by, before, &mut state) {
                changes.begun.push(target.written());
                state.running.push(Running { target, task });
            }
        }
        changes.ended.extend(ended.iter().map(|running| running.target.written()));
        let pause = if changes.begun.is_empty() { Duration::ZERO } else { HAND_OVER };
        if !ended.is_empty() {
            let local = state.local.clone();
            tokio::spawn(async move {
                tokio::time::sleep(pause).await;
                for running in ended {
                    let is_nearby = matches!(running.target, SearchTarget::Nearby(_));
                    running.end().await;
                    if let Some(local) = local.as_ref().filter(|_| is_nearby) {
                        local.stop_browsing();
                    }
                }
            });
        }
        changes
    }

    /// Ends all searches. Their links stay.
    pub(crate) fn stop(&self) {
        let mut state = self.lock();
        state.is_stopped = true;
        state.running.drain(..).for_each(|running| running.task.abort());
    }

    /// Returns the local network, if it is used.
    pub(crate) fn local(&self) -> Option<Arc<LocalNetwork>> {
        self.lock().local.clone()
    }

    /// Begins a search, once the one `before` has ended.
    fn begin(
        &self,
        target: &SearchTarget,
        found_by: &'static str,
        before: Option<Running>,
        state: &mut State,
    ) -> Option<JoinHandle<()>> {
        let (keeper, rng) = (self.keeper.clone(), ChaCha20Rng::from_rng(&mut state.rng));
        Some(match target {
            SearchTarget::At(urls) => {
                let dialled = DialTarget::by(urls.clone())?;
                tokio::spawn(keep_at(dialled, keeper, self.board.row(target.written(), found_by), rng))
            }
            SearchTarget::Domain(domain) => {
                let (row, dns) = (self.board.row(target.written(), found_by), keeper.dns.clone());
                tokio::spawn(srv::keep_one_of(domain.clone(), dns, keeper, row, rng))
            }
            SearchTarget::Nearby(wanted) => {
                let local = self.use_local(state)?;
                let (wanted, board) = (wanted.clone(), self.board.clone());
                tokio::spawn(async move {
                    if let Some(before) = before {
                        before.end().await;
                    }
                    mdns::keep_some(local, wanted, keeper, board, rng).await;
                })
            }
        })
    }

    /// Joins mDNS on the local network, unless that has happened. Without it, the node runs all the same.
    fn use_local(&self, state: &mut State) -> Option<Arc<LocalNetwork>> {
        if state.local.is_none() {
            let opened = LocalNetwork::open(self.mdns_port, &self.announced, &mut state.rng);
            let failed = |why| warn!("mDNS on the local network cannot be used: {why}");
            state.local = opened.map(Arc::new).map_err(failed).ok();
        }
        state.local.clone()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

/// Returns everything to search for, each once, with its origin for the status.
fn search_targets(wanted: WantedRouters) -> Vec<(SearchTarget, &'static str)> {
    let WantedRouters { configured, of_tokens, nearby } = wanted;
    let mut all: Vec<(SearchTarget, &'static str)> = Vec::new();
    let mut add = |target, found_by| {
        if !all.iter().any(|(known, _)| *known == target) {
            all.push((target, found_by));
        }
    };
    for (routers, found_by) in [(&configured, "static"), (&of_tokens, "token")] {
        urls::routers(routers).into_iter().for_each(|urls| add(SearchTarget::At(urls), found_by));
    }
    for url in configured.iter().chain(&of_tokens) {
        // One search serves all entries of the local network.
        if let RouterUrl::Srv(domain) = url {
            add(SearchTarget::Domain(domain.clone()), "srv");
        }
    }
    if let Some(wanted) = nearby {
        add(SearchTarget::Nearby(wanted), "mdns");
    }
    all
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]

    use super::*;

    #[test]
    fn each_router_is_one_target_whoever_names_it() {
        let urls =
            |texts: &[&str]| texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<RouterUrl>>();
        let wanted = WantedRouters {
            configured: urls(&["quic://a:1", "tls://a:2", "srv://lab.example", "quic://a:3", "mdns://"]),
            of_tokens: urls(&["quic://b:1", "quic://a:3", "srv://lab.example"]),
            nearby: Some(RouterFilter { written: "mdns://".into(), nodes: None }),
        };
        let found: Vec<_> =
            search_targets(wanted).iter().map(|(target, by)| format!("{} {by}", target.written())).collect();
        assert_eq!(
            found,
            [
                "quic://a:1,tls://a:2 static",
                "quic://a:3 static",
                "quic://b:1 token",
                "srv://lab.example srv",
                "mdns:// mdns"
            ]
        );
    }
}
