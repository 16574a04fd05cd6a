//! [`Guest`]: one credential on one connection. Its streams share the bounds of one session, and all of them end when
//! its rights end.

use std::future::Future;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use sgc_sync::lock;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tonic::Request;

use super::fault::Fault;
use super::serving_task::ServingTask;
use crate::access::{Client, Denial};
use crate::budget::Budget;
use crate::error::GatewayError;
use crate::feed::{Subscription, SubscriptionEnd};
use crate::session::Session;

/// Most graph watches of one client at a time, because each computes its view anew with every change.
const WATCHES_MAX: usize = 16;

/// The credential of a request. A token is kept as a hash only. With a token the origin does not matter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Proof {
    pub(super) token: Option<[u8; 32]>,
    pub(super) origin: Option<Box<str>>,
}

/// A guest and the credential that admitted it.
pub(super) struct GuestEntry {
    pub(super) shown: Proof,
    pub(super) guest: Arc<Guest>,
}

impl GuestEntry {
    pub(super) fn client(&self) -> &Client {
        self.guest.session.client()
    }

    pub(super) fn is_admitted(&self) -> bool {
        !self.guest.has_ended()
    }
}

/// The numbers of a guest's streams.
#[derive(Debug, Default)]
struct Counts {
    subscriptions: AtomicUsize,
    publications: AtomicUsize,
    servings: AtomicUsize,
    goals: AtomicUsize,
    calls: AtomicUsize,
    watches: AtomicUsize,
}

/// The kind of a stream, which decides the bound that it counts against.
#[derive(Clone, Copy, Debug)]
pub(super) enum StreamKind {
    Subscription,
    Publication,
    Serving,
    Goal,
    Call,
    Watching,
}

/// One credential on one connection.
pub(super) struct Guest {
    pub(super) session: Session,
    serving: ServingTask,
    /// The task that ends the guest with its rights.
    watcher: AbortHandle,
    counts: Counts,
    ended: watch::Sender<Option<Fault>>,
    /// The guest's subscriptions. Their streams are not polled while the client does not read, so they are ended
    /// here.
    heard: Mutex<Vec<SubscriptionEnd>>,
    /// Room for long messages that are sent to the guest and unread.
    pub(super) unread: Budget,
    /// Room for long messages that the guest sends.
    pub(super) incoming: Budget,
}

/// A stream of a guest, counted until dropped.
pub(super) struct Place {
    pub(super) guest: Arc<Guest>,
    taken: StreamKind,
}

impl Drop for Place {
    fn drop(&mut self) {
        self.guest.count(self.taken).0.fetch_sub(1, Ordering::Relaxed);
    }
}

impl Drop for Guest {
    fn drop(&mut self) {
        self.watcher.abort();
    }
}

impl Guest {
    /// Creates a guest. `watcher` is the task that ends it with its rights; the bytes are those of messages that are
    /// unread, and of messages that come.
    pub(super) fn new(
        session: Session,
        serving: ServingTask,
        watcher: AbortHandle,
        [unread_bytes_max, incoming_bytes_max]: [usize; 2],
    ) -> Self {
        Self {
            serving,
            watcher,
            counts: Counts::default(),
            ended: watch::Sender::new(None),
            heard: Mutex::default(),
            unread: Budget::new(unread_bytes_max, session.quota().clone()),
            incoming: Budget::new(incoming_bytes_max, session.quota().clone()),
            session,
        }
    }

    /// Returns the guest of an admitted request.
    pub(super) fn from_request<T>(request: &Request<T>) -> Result<Arc<Self>, Fault> {
        request.extensions().get::<Arc<Self>>().cloned().ok_or(Fault::NoConnection)
    }

    fn count(&self, taken: StreamKind) -> (&AtomicUsize, &'static str, usize) {
        let limits = self.session.limits();
        match taken {
            StreamKind::Subscription => {
                (&self.counts.subscriptions, "subscriptions", limits.subscriptions_max)
            }
            StreamKind::Publication => (&self.counts.publications, "publishers", limits.publications_max),
            StreamKind::Watching => (&self.counts.watches, "watches of the graph", WATCHES_MAX),
            StreamKind::Call => (&self.counts.calls, "calls under way", limits.calls_max),
            StreamKind::Goal => (&self.counts.goals, "goals", limits.calls_max),
            StreamKind::Serving => (&self.counts.servings, "services and actions", limits.servings_max),
        }
    }

    /// Counts a stream, or fails at the bound.
    pub(super) fn take(self: &Arc<Self>, taken: StreamKind) -> Result<Place, Fault> {
        let (count, what, max) = self.count(taken);
        let place = Place { guest: Arc::clone(self), taken };
        let before = count.fetch_add(1, Ordering::Relaxed);
        self.session.check_count(what, before, max)?;
        Ok(place)
    }

    pub(super) fn end(&self, why: Denial) {
        tracing::debug!(client = %self.session.client().name, %why, "a gRPC client is not admitted any more");
        self.end_with(Fault::Denied(why));
    }

    pub(super) fn end_with(&self, why: Fault) {
        self.ended.send_replace(Some(why));
        std::mem::take(&mut *lock(&self.heard)).iter().for_each(SubscriptionEnd::end);
        self.serving.wake();
    }

    pub(super) fn has_ended(&self) -> bool {
        self.ended.borrow().is_some()
    }

    /// Makes a subscription end with the guest, even if its client does not read.
    pub(super) fn holds(&self, subscription: &Subscription) {
        let mut heard = lock(&self.heard);
        heard.retain(|other| !other.has_ended());
        heard.push(subscription.ender());
        drop(heard);
        if self.has_ended() {
            subscription.ender().end();
        }
    }

    /// Waits until the guest is no longer admitted and returns the reason.
    pub(super) async fn ended(&self) -> Fault {
        let mut ended = self.ended.subscribe();
        match ended.wait_for(Option::is_some).await.map(|why| why.clone()) {
            Ok(Some(why)) => why,
            _ => GatewayError::Stopping.into(),
        }
    }

    /// Runs work while the guest is admitted.
    pub(super) async fn admitted<T>(&self, work: impl Future<Output = Result<T, Fault>>) -> Result<T, Fault> {
        tokio::select! {
            biased;
            why = self.ended() => Err(why),
            done = work => done,
        }
    }
}
