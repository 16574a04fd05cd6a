//! [`Searches`]: the searches for routers that run, and how a reload changes them.

use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_config::{RouterUrl, SrvDomain};
use sgc_sync::lock;
use sgc_transport::{LinkUrl, ListenAddr};
use tokio::task::JoinHandle;
use tracing::warn;

use super::{Board, DialTarget, LinkKeeper, LocalNetwork, RouterFilter, keep_at, mdns, srv, urls};
use crate::clock::time_now;

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
    state: Arc<Mutex<State>>,
}

struct State {
    running: Vec<Running>,
    /// Searches that are no longer wanted, and when they end.
    ending: Vec<(Instant, Running)>,
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
    fn is_nearby(&self) -> bool {
        matches!(self.target, SearchTarget::Nearby(_))
    }

    /// Ends the search. Its links end soon after.
    async fn end(mut self) {
        self.task.abort();
        let _ = (&mut self.task).await;
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl State {
    /// Takes a search for this out of those that run, or that are about to end.
    fn take(&mut self, target: &SearchTarget) -> Option<Running> {
        if let Some(at) = self.running.iter().position(|running| running.target == *target) {
            return Some(self.running.swap_remove(at));
        }
        let at = self.ending.iter().position(|(_, ending)| ending.target == *target)?;
        Some(self.ending.swap_remove(at).1)
    }

    /// Takes a search of the local network that is about to end.
    fn take_ending_nearby(&mut self) -> Option<Running> {
        let at = self.ending.iter().position(|(_, ending)| ending.is_nearby())?;
        Some(self.ending.swap_remove(at).1)
    }
}

/// Ends the searches whose time has come.
async fn end_due(state: Arc<Mutex<State>>, due: Instant) {
    tokio::time::sleep_until(due.into()).await;
    let ended: Vec<_> = {
        let mut state = lock(&state);
        let (ended, kept) = std::mem::take(&mut state.ending).into_iter().partition(|(at, _)| *at <= due);
        state.ending = kept;
        ended
    };
    let was_nearby = ended.iter().any(|(_, running)| running.is_nearby());
    for (_, running) in ended {
        running.end().await;
    }
    let state = lock(&state);
    let all = state.running.iter().chain(state.ending.iter().map(|(_, ending)| ending));
    if let Some(local) =
        state.local.as_ref().filter(|_| was_nearby && !all.into_iter().any(Running::is_nearby))
    {
        local.stop_browsing();
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
        let state = State { running: Vec::new(), ending: Vec::new(), local: None, rng, is_stopped: false };
        let searches = Self { keeper, board, mdns_port, announced, state: Arc::new(Mutex::new(state)) };
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
        let mut changes = SearchChanges::default();
        let (mut running, mut new) = (Vec::new(), Vec::new());
        for (target, found_by) in search_targets(wanted) {
            match state.take(&target) {
                Some(known) => running.push(known),
                None => new.push((target, found_by)),
            }
        }
        let ended = std::mem::replace(&mut state.running, running);
        changes.ended = ended.iter().map(|running| running.target.written()).collect();
        let pause = if new.is_empty() { Duration::ZERO } else { HAND_OVER };
        let due = time_now() + pause;
        let is_ending = !ended.is_empty();
        state.ending.extend(ended.into_iter().map(|running| (due, running)));
        for (target, found_by) in new {
            // One search at a time hears what is announced on the local network.
            let before = match &target {
                SearchTarget::Nearby(_) => state.take_ending_nearby(),
                SearchTarget::At(_) | SearchTarget::Domain(_) => None,
            };
            if let Some(task) = self.begin(&target, found_by, before, &mut state) {
                changes.begun.push(target.written());
                state.running.push(Running { target, task });
            }
        }
        if is_ending {
            tokio::spawn(end_due(self.state.clone(), due));
        }
        changes
    }

    /// Ends all searches, and begins none any more.
    pub(crate) fn stop(&self) {
        let mut state = self.lock();
        state.is_stopped = true;
        state.running.clear();
        state.ending.clear();
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
