//! [`Clients`]: the admission of gRPC clients. A [`Guest`] is one credential on one connection. Its streams share the
//! bounds of one session, and all of them end when its rights end.

use std::future::Future;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};

use aws_lc_rs::digest::{SHA256, digest};
use sgc_sync::lock;
use tokio::sync::watch;
use tokio::task::AbortHandle;
use tonic::{Request, Status};

use super::GrpcOptions;
use super::connection::{Connection, WeakConnection};
use super::fault::Fault;
use crate::access::{AdmissionRequest, Client, Denial, ORIGIN_BYTES_MAX};
use crate::access_watch::AccessWatch;
use crate::budget::Budget;
use crate::error::GatewayError;
use crate::feed::{Subscription, SubscriptionEnd};
use crate::hub::Hub;
use crate::session::Session;

/// Most credentials in use on one connection at a time.
const CREDENTIALS_MAX: usize = 16;
/// Most graph watches of one client at a time, because each computes its view anew with every change.
const WATCHES_MAX: usize = 16;

/// The admission of clients.
pub(super) struct Clients {
    hub: Hub,
    access: AccessWatch,
    options: GrpcOptions,
    stopping: watch::Receiver<bool>,
}

/// The credential of a request. A token is kept as a hash only. With a token the origin does not matter.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Proof {
    token: Option<[u8; 32]>,
    origin: Option<Box<str>>,
}

/// A guest and the credential that admitted it.
pub(super) struct GuestEntry {
    shown: Proof,
    guest: Arc<Guest>,
}

impl GuestEntry {
    pub(super) fn client(&self) -> &Client {
        self.guest.session.client()
    }

    pub(super) fn is_admitted(&self) -> bool {
        !self.guest.has_ended()
    }
}

impl Clients {
    pub(super) fn new(
        hub: Hub,
        access: AccessWatch,
        options: GrpcOptions,
        stopping: watch::Receiver<bool>,
    ) -> Self {
        Self { hub, access, options, stopping }
    }

    pub(super) fn hub(&self) -> &Hub {
        &self.hub
    }

    /// Returns the guest that makes a request.
    pub(super) fn admit(&self, request: &Request<()>) -> Result<Arc<Guest>, Status> {
        Ok(self.find(request)?)
    }

    fn find(&self, request: &Request<()>) -> Result<Arc<Guest>, Fault> {
        // A dropped sender means that the front end is gone.
        if *self.stopping.borrow() || self.stopping.has_changed().is_err() {
            return Err(GatewayError::Stopping.into());
        }
        let connection = request.extensions().get::<Connection>().ok_or(Fault::NoConnection)?;
        let text = |name: &str| request.metadata().get(name).map(|value| value.to_str());
        let token = match text("authorization").transpose().map_err(|_| Fault::Authorization)? {
            Some(header) => Some(bearer(header).ok_or(Fault::Authorization)?),
            None => None,
        };
        // An origin that is not text counts as an unknown origin.
        let origin = text("origin").map(|origin| origin.unwrap_or("?"));
        if token.is_none() && origin.is_some_and(|origin| origin.len() > ORIGIN_BYTES_MAX) {
            return Err(Fault::Origin { max: ORIGIN_BYTES_MAX });
        }
        let shown = Proof {
            origin: origin.filter(|_| token.is_none()).map(Box::from),
            token: token.map(|token| {
                let mut hash = [0; 32];
                hash.copy_from_slice(digest(&SHA256, token.as_bytes()).as_ref());
                hash
            }),
        };
        let access = self.access.current();
        let mut known = lock(connection.known());
        if let Some(at) = known.iter().position(|known| known.shown == shown) {
            let guest = &known[at].guest;
            match access.still_admits(guest.session.client(), self.access.now()) {
                Ok(()) if !guest.has_ended() => return Ok(Arc::clone(guest)),
                Ok(()) => drop(known.remove(at)),
                // The current rules may admit the client anew.
                Err(why) => known.remove(at).guest.end(why),
            }
        }
        let client = access.admit(&AdmissionRequest {
            peer: connection.peer(),
            encrypted: connection.is_encrypted(),
            origin,
            token,
            certificate: connection.certificate(),
            now: self.access.now(),
        });
        let client = client.map_err(|why| {
            tracing::debug!(%why, peer = %connection.peer(), "a gRPC client is not admitted");
            Fault::Denied(why)
        })?;
        tracing::debug!(client = %client.name, peer = %connection.peer(), "a gRPC client is admitted");
        if known.len() >= CREDENTIALS_MAX {
            let idle = known.iter().position(|known| Arc::strong_count(&known.guest) == 1);
            known.remove(idle.ok_or(Fault::Credentials { max: CREDENTIALS_MAX })?);
        }
        let session = Session::new(&self.hub, client.clone(), self.options.session);
        let guest = Arc::new_cyclic(|guest| {
            let watched = watch_over(guest.clone(), self.access.clone(), client, self.stopping.clone());
            Guest {
                connection: connection.waker(),
                counts: Counts::default(),
                ended: watch::Sender::new(None),
                heard: Mutex::default(),
                unread: Budget::new(self.options.unread_bytes_max, session.quota().clone()),
                incoming: Budget::new(self.options.incoming_bytes_max, session.quota().clone()),
                watcher: tokio::spawn(watched).abort_handle(),
                session: session.admitted_by(self.access.clone()),
            }
        });
        known.push(GuestEntry { shown, guest: Arc::clone(&guest) });
        Ok(guest)
    }
}

/// Returns the token in an `authorization` header.
fn bearer(header: &str) -> Option<&str> {
    let (scheme, token) = header.split_once(' ')?;
    let token = token.trim();
    (scheme.eq_ignore_ascii_case("bearer") && !token.is_empty()).then_some(token)
}

/// Ends a guest when its rights end or the front end stops. Dropping the guest aborts this task.
async fn watch_over(
    guest: Weak<Guest>,
    access: AccessWatch,
    client: Client,
    mut stopping: watch::Receiver<bool>,
) {
    let denied = tokio::select! {
        denied = access.until_denied(&client) => Some(denied),
        _ = stopping.wait_for(|is_stopping| *is_stopping) => None,
    };
    // A guest under construction appears shortly, and a dropped guest aborts this task.
    let guest = loop {
        match guest.upgrade() {
            Some(guest) => break guest,
            None => tokio::task::yield_now().await,
        }
    };
    match denied {
        Some(why) => guest.end(why),
        None => guest.end_with(GatewayError::Stopping.into()),
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
    connection: WeakConnection,
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

    fn end(&self, why: Denial) {
        tracing::debug!(client = %self.session.client().name, %why, "a gRPC client is not admitted any more");
        self.end_with(Fault::Denied(why));
    }

    fn end_with(&self, why: Fault) {
        self.ended.send_replace(Some(why));
        std::mem::take(&mut *lock(&self.heard)).iter().for_each(SubscriptionEnd::end);
        self.connection.wake();
    }

    fn has_ended(&self) -> bool {
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
