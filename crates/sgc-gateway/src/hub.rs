//! [`Hub`]: the gateway's ROS 2 node on the local network, which all clients share.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, Weak};
use std::time::Duration;

use sgc_sync::lock;
use tokio::sync::watch;
use tokio::task::JoinHandle;

use crate::definitions::Types;
use crate::error::GatewayError;
use crate::feed::{Feed, FeedKey, Subscription, SubscriptionOptions};
use crate::graph::Graph;
use crate::network::Network;
use crate::ros::LocalRos;
use crate::service::Caller;

/// Time for which graph changes are gathered before readers are adapted.
const SETTLE: Duration = Duration::from_millis(20);
/// Time for which an unused reader is kept, so that a reloaded page finds it.
const LINGER: Duration = Duration::from_secs(2);
/// Most service clients that are kept for further calls.
const CALLERS_MAX: usize = 256;

/// The options of a hub.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HubOptions {
    /// The name of the ROS 2 node, of letters, digits and `_`.
    pub node: String,
}

impl Default for HubOptions {
    fn default() -> Self {
        Self { node: "sgc_gateway".to_owned() }
    }
}

/// The gateway's node. Clones share it; [`Hub::stop`] ends it.
#[derive(Clone)]
pub struct Hub {
    pub(crate) shared: Arc<HubState>,
    keeper: Arc<Keeper>,
}

struct Keeper([JoinHandle<()>; 2]);

impl Keeper {
    fn end(&self) {
        self.0.iter().for_each(JoinHandle::abort);
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        self.end();
    }
}

impl Feeds {
    fn stopped() -> Self {
        Self { all: Vec::new(), is_stopped: true }
    }
}

/// All feeds.
#[derive(Default)]
struct Feeds {
    all: Vec<Arc<Feed>>,
    /// `true` once no further feed is created.
    is_stopped: bool,
}

/// The state that all clients share.
pub(crate) struct HubState {
    pub(crate) network: Arc<Network>,
    feeds: Mutex<Feeds>,
    callers: Mutex<VecDeque<Arc<Caller>>>,
}

impl fmt::Debug for Hub {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Hub").field(&self.shared.network.node_name()).finish()
    }
}

impl Hub {
    /// Joins the network, which must be the hub's own.
    ///
    /// # Errors
    /// The error of discovery.
    pub async fn start(
        ros: Arc<dyn LocalRos>,
        types: Types,
        options: HubOptions,
    ) -> Result<Self, GatewayError> {
        let network = Arc::new(Network::new(ros, types, &options.node));
        let shared = Arc::new(HubState { network, feeds: Mutex::default(), callers: Mutex::default() });
        shared.network.join().await?;
        let adapting = tokio::spawn(adapt(Arc::downgrade(&shared), shared.network.changes()));
        let sweeping = tokio::spawn(sweep(Arc::downgrade(&shared)));
        Ok(Self { shared, keeper: Arc::new(Keeper([adapting, sweeping])) })
    }

    /// Returns the graph of the local network.
    pub fn graph(&self) -> Arc<Graph> {
        self.shared.network.graph()
    }

    /// Returns a receiver that is marked as changed whenever the graph changes.
    pub fn graph_changes(&self) -> watch::Receiver<u64> {
        self.shared.network.changes()
    }

    /// Returns the message types.
    pub fn types(&self) -> &Types {
        &self.shared.network.types
    }

    /// Returns the full name of the gateway's node.
    pub fn node_name(&self) -> &str {
        self.shared.network.node_name()
    }

    /// Returns the number of readers, shared by all subscribers.
    pub fn readers(&self) -> usize {
        lock(&self.shared.feeds).all.len()
    }

    /// Leaves the network. Subscriptions end, and calls get no answer any more.
    pub async fn stop(&self) {
        self.keeper.end();
        let _ = self
            .shared
            .run(|shared| {
                let feeds = std::mem::replace(&mut *lock(&shared.feeds), Feeds::stopped());
                feeds.all.iter().for_each(|feed| feed.end());
                let callers = std::mem::take(&mut *lock(&shared.callers));
                drop(callers);
                let _ = shared.network.ros.announce(&[]);
                Ok(())
            })
            .await;
    }
}

/// Adapts readers to the graph.
async fn adapt(shared: Weak<HubState>, mut changed: watch::Receiver<u64>) {
    while changed.changed().await.is_ok() {
        let Some(shared) = shared.upgrade() else { return };
        tokio::time::sleep(SETTLE).await;
        // Later changes trigger another round. That round covers the readers created here and finds nothing to do for
        // them.
        changed.mark_unchanged();
        let done = shared.run(|shared| {
            let feeds = lock(&shared.feeds).all.clone();
            for feed in feeds {
                if let Err(error) = feed.adapt() {
                    tracing::warn!(%error, "a reader could not be made anew");
                }
            }
            shared.network.announce();
            Ok(())
        });
        let _ = done.await;
    }
}

/// Drops unused readers.
async fn sweep(shared: Weak<HubState>) {
    loop {
        let Some(shared) = shared.upgrade() else { return };
        shared.network.unused().await;
        tokio::time::sleep(LINGER).await;
        let done = shared.run(|shared| {
            let mut gone = Vec::new();
            lock(&shared.feeds).all.retain(|feed| {
                let is_used = !feed.is_unused();
                if !is_used {
                    gone.push(Arc::clone(feed));
                }
                is_used
            });
            gone.iter().for_each(|feed| feed.end());
            Ok(())
        });
        let _ = done.await;
    }
}

impl HubState {
    /// Runs work on a thread where it may block.
    pub(crate) async fn run<T: Send + 'static>(
        self: &Arc<Self>,
        work: impl FnOnce(&Arc<Self>) -> Result<T, GatewayError> + Send + 'static,
    ) -> Result<T, GatewayError> {
        let shared = Arc::clone(self);
        self.network.run(move |_| work(&shared)).await
    }

    /// Subscribes, by an existing reader if one suits. A reader whose history is incomplete for lack of its
    /// subscribers' room is not shared with a client that has room for its own reader.
    pub(crate) async fn subscribe(
        self: &Arc<Self>,
        key: FeedKey,
        options: SubscriptionOptions,
    ) -> Result<Subscription, GatewayError> {
        self.run(move |shared| {
            let layout = shared.layout_of(&key)?;
            let (feed, subscription) = {
                let mut feeds = lock(&shared.feeds);
                if feeds.is_stopped {
                    return Err(GatewayError::Stopping);
                }
                // A subscriber that holds up writers gets its own reader.
                let payer = &options.payer;
                let known = || feeds.all.iter().filter(|feed| !key.waits && feed.key == key);
                let whole = known().find(|feed| feed.has_history_for(payer)).map(Arc::clone);
                let feed = match (whole, known().next().map(Arc::clone)) {
                    (Some(feed), _) => feed,
                    (None, short) => {
                        let charge = match short {
                            Some(feed) => payer.take_reader_if_room().ok_or(feed),
                            None => Ok(payer.take_reader()?),
                        };
                        match charge {
                            Ok(charge) => {
                                let feed = Feed::new(key, &shared.network, charge, payer.clone());
                                feeds.all.push(Arc::clone(&feed));
                                feed
                            }
                            Err(short) => short,
                        }
                    }
                };
                // The subscription exists before a sweep finds the feed unused, and before a new reader delivers the
                // first messages.
                (Arc::clone(&feed), Subscription::new(feed, layout, options))
            };
            feed.adapt()?;
            Ok(subscription)
        })
        .await
    }

    fn layout_of(&self, key: &FeedKey) -> Result<Arc<sgc_cdr::Layout>, GatewayError> {
        let graph = self.network.graph();
        let hash = graph.topics.get(&key.topic).and_then(|info| info.type_hash(&key.type_name));
        self.network.types.layout(&key.type_name, hash)
    }

    /// Returns the client of a service, created unless a recent call left one. May block.
    pub(crate) fn caller(
        self: &Arc<Self>,
        service: &str,
        type_name: &str,
    ) -> Result<Arc<Caller>, GatewayError> {
        let known = |callers: &mut VecDeque<Arc<Caller>>| {
            let at = callers.iter().position(|caller| caller.is_for(service, type_name))?;
            let caller = callers.remove(at)?;
            callers.push_front(Arc::clone(&caller));
            Some(caller)
        };
        if let Some(caller) = known(&mut lock(&self.callers)) {
            return Ok(caller);
        }
        // The lock is not held while a client is created. If two are created at once, the second is dropped.
        let made = Arc::new(Caller::new(&self.network, service, type_name)?);
        let mut callers = lock(&self.callers);
        if let Some(caller) = known(&mut callers) {
            return Ok(caller);
        }
        callers.push_front(Arc::clone(&made));
        let before = callers.len().min(CALLERS_MAX);
        let old = callers.split_off(before);
        drop(callers);
        drop(old);
        Ok(made)
    }
}
