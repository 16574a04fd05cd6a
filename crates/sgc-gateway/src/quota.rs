//! [`Quota`]: the bounds of a credential over all its sessions, beside the bounds of each session.
//!
//! One credential may hold [`CREDENTIAL_SHARE`] times the bounds of a session, however many connections it has. All
//! clients of other hosts together may hold [`REMOTE_SHARE`] times, and all clients of this gateway [`TOTAL_SHARE`]
//! times. The difference between the last two is reserved for programs on this host.
//!
//! The module `admission` decides whether a connection gets a place at all.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, RwLock, RwLockReadGuard, Weak};

use sgc_sync::{lock, read_lock, write_lock};
use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

use crate::access::{Client, Credential};
use crate::error::GatewayError;
use crate::limits::SessionLimits;
use crate::pool::Pool;

/// Bound of one credential, in sessions.
const CREDENTIAL_SHARE: usize = 4;
/// Bound of all clients of other hosts together, in sessions.
const REMOTE_SHARE: usize = 12;
/// Bound of all clients together, in sessions.
const TOTAL_SHARE: usize = 16;
/// The unit of room for long messages, in bytes. Messages up to one unit need no room, because their number is bounded.
pub(crate) const UNIT_BYTES: usize = 64 << 10;
/// Most threads that wait for local programs: of one credential, of all clients of other hosts, of all clients.
const THREADS: [usize; 3] = [16, 48, 64];
/// Most bytes of long messages in transit between gateway and clients: of one credential, of all clients of other
/// hosts, of all clients.
const LONG_BYTES: [usize; 3] = [512 << 20, 1536 << 20, 2048 << 20];

/// A resource that a quota bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Resource {
    Subscriptions,
    /// Subscriptions for which writers on the local network wait.
    Waits,
    /// Readers on the local network that were created for the client.
    Readers,
    Publications,
    Servings,
    Calls,
}

const RESOURCES: usize = 6;

impl Resource {
    const ALL: [Self; RESOURCES] =
        [Self::Subscriptions, Self::Waits, Self::Readers, Self::Publications, Self::Servings, Self::Calls];

    fn what(self) -> &'static str {
        match self {
            Self::Subscriptions => "subscriptions",
            Self::Waits => "subscriptions that are waited for",
            Self::Readers => "readers on the local network",
            Self::Publications => "topics that are published",
            Self::Servings => "services and actions that are served",
            Self::Calls => "calls under way",
        }
    }

    /// Returns the bound of one session.
    fn session_max(self, limits: &SessionLimits) -> usize {
        match self {
            Self::Subscriptions | Self::Readers => limits.subscriptions_max,
            Self::Waits => limits.waits_max,
            Self::Publications => limits.publications_max,
            Self::Servings => limits.servings_max,
            Self::Calls => limits.calls_max,
        }
    }
}

/// The counts of everything that the clients of a pool hold.
#[derive(Debug)]
struct Counts {
    pool: Pool,
    resources: [AtomicUsize; RESOURCES],
    /// Bytes of queued messages.
    bytes: AtomicUsize,
    permits: [Arc<Semaphore>; PERMITS],
}

/// The bound of a pool that has no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct PoolFull {
    pool: Pool,
    /// The bounded resource.
    what: &'static str,
    max: usize,
}

impl Counts {
    fn new(pool: Pool) -> Arc<Self> {
        let permits = PermitKind::ALL.map(|kind| Arc::new(Semaphore::new(kind.max(pool))));
        Arc::new(Self { pool, resources: Default::default(), bytes: AtomicUsize::new(0), permits })
    }

    fn share(&self) -> usize {
        match self.pool {
            Pool::Credential => CREDENTIAL_SHARE,
            Pool::Remote => REMOTE_SHARE,
            Pool::Total => TOTAL_SHARE,
        }
    }

    /// Takes everything that a session holds, or nothing.
    fn take_all(&self, holdings: &Holdings, limits: &SessionLimits) -> Result<(), PoolFull> {
        let mut taken = Holdings::default();
        let refused = self.take_each(holdings, limits, &mut taken);
        if refused.is_err() {
            self.give_back_all(&taken);
        }
        refused
    }

    /// Takes one resource after the other, and notes in `taken` what it took.
    fn take_each(
        &self,
        holdings: &Holdings,
        limits: &SessionLimits,
        taken: &mut Holdings,
    ) -> Result<(), PoolFull> {
        let full = |what, max| PoolFull { pool: self.pool, what, max };
        for resource in Resource::ALL {
            let (at, max) = (resource as usize, resource.session_max(limits).saturating_mul(self.share()));
            if !add_within(&self.resources[at], holdings.resources[at], max) {
                return Err(full(resource.what(), max));
            }
            taken.resources[at] = holdings.resources[at];
        }
        let max = limits.waiting_bytes_max.saturating_mul(self.share());
        if !add_within(&self.bytes, holdings.bytes, max) {
            return Err(full("bytes of messages that wait or are kept", max));
        }
        taken.bytes = holdings.bytes;
        for kind in PermitKind::ALL {
            let units = holdings.permits[kind as usize];
            let permits =
                self.permits[kind as usize].try_acquire_many(u32::try_from(units).unwrap_or(u32::MAX));
            let permits = permits.map_err(|_| full(kind.what(), kind.max(self.pool) * kind.unit()))?;
            permits.forget();
            taken.permits[kind as usize] = units;
        }
        Ok(())
    }

    fn give_back_all(&self, holdings: &Holdings) {
        for (counted, given) in self.resources.iter().zip(holdings.resources) {
            counted.fetch_sub(given, Ordering::Relaxed);
        }
        self.bytes.fetch_sub(holdings.bytes, Ordering::Relaxed);
        for (semaphore, units) in self.permits.iter().zip(holdings.permits) {
            semaphore.add_permits(units);
        }
    }
}

/// Adds to a count, unless the sum exceeds `max`. Adding zero always succeeds.
fn add_within(count: &AtomicUsize, more: usize, max: usize) -> bool {
    let fits = |now: usize| now.checked_add(more).filter(|sum| more == 0 || *sum <= max);
    count.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).is_ok()
}

/// The counts of everything that the clients of a hub hold.
#[derive(Debug)]
pub(crate) struct Quotas {
    total: Arc<Counts>,
    remote: Arc<Counts>,
    of: Mutex<BTreeMap<Credential, Weak<Counts>>>,
    /// Refusals by the pool whose bound was reached.
    refused: Mutex<BTreeMap<Pool, u64>>,
    /// Messages that were not kept for later subscribers.
    history_dropped: AtomicU64,
    /// Messages that clients published, and calls that were unanswered, while the local network was closed.
    unwritten: AtomicU64,
    calls_cut_off: AtomicU64,
}

impl Default for Quotas {
    fn default() -> Self {
        let (total, remote) = (Counts::new(Pool::Total), Counts::new(Pool::Remote));
        Self {
            total,
            remote,
            of: Mutex::default(),
            refused: Mutex::default(),
            history_dropped: AtomicU64::new(0),
            unwritten: AtomicU64::new(0),
            calls_cut_off: AtomicU64::new(0),
        }
    }
}

impl Quotas {
    /// Returns the quota of a session. It shares its bounds with all sessions of the client's credential.
    pub(crate) fn quota(self: &Arc<Self>, client: &Client) -> Quota {
        Quota(Arc::new(Ledger {
            quotas: Arc::clone(self),
            pools: RwLock::new(self.pools(client)),
            moved: Notify::new(),
            resources: Default::default(),
            bytes: AtomicUsize::new(0),
            permits: Default::default(),
        }))
    }

    /// Returns the pools of a client, the smallest first.
    fn pools(&self, client: &Client) -> Pools {
        let own =
            client.credential().filter(|credential| *credential != Credential::Local).map(|credential| {
                let mut of = lock(&self.of);
                of.retain(|_, counts| counts.strong_count() > 0);
                let known = of.get(&credential).and_then(Weak::upgrade);
                known.unwrap_or_else(|| {
                    let counts = Counts::new(Pool::Credential);
                    of.insert(credential, Arc::downgrade(&counts));
                    counts
                })
            });
        let remote = (!client.is_local()).then(|| Arc::clone(&self.remote));
        [own, remote, Some(Arc::clone(&self.total))].into_iter().flatten().collect()
    }

    /// Returns the number of refusals by pool.
    pub(crate) fn refused(&self) -> BTreeMap<Pool, u64> {
        lock(&self.refused).clone()
    }

    fn count(&self, pool: Pool) {
        *lock(&self.refused).entry(pool).or_default() += 1;
    }

    /// Returns the number of messages that were not kept for later subscribers.
    pub(crate) fn history_dropped(&self) -> u64 {
        self.history_dropped.load(Ordering::Relaxed)
    }

    pub(crate) fn count_history_dropped(&self, messages: u64) {
        self.history_dropped.fetch_add(messages, Ordering::Relaxed);
    }

    /// Returns the number of messages that clients published while the local network was closed.
    pub(crate) fn unwritten(&self) -> u64 {
        self.unwritten.load(Ordering::Relaxed)
    }

    pub(crate) fn count_unwritten(&self) {
        self.unwritten.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the number of calls that had no answer when the local network closed.
    pub(crate) fn calls_cut_off(&self) -> u64 {
        self.calls_cut_off.load(Ordering::Relaxed)
    }

    pub(crate) fn count_call_cut_off(&self) {
        self.calls_cut_off.fetch_add(1, Ordering::Relaxed);
    }
}

/// The pools of a client, the smallest first.
type Pools = Arc<[Arc<Counts>]>;

/// The units of each resource that a session holds.
#[derive(Debug, Default)]
struct Holdings {
    resources: [usize; RESOURCES],
    bytes: usize,
    permits: [usize; PERMITS],
}

/// Everything that one session holds of its pools. It moves as a whole when the session shows another credential.
#[derive(Debug)]
struct Ledger {
    quotas: Arc<Quotas>,
    /// Locked for writing while the holdings move to other pools, and for reading while they change.
    pools: RwLock<Pools>,
    /// Wakes tasks that wait for permits of the former pools.
    moved: Notify,
    resources: [AtomicUsize; RESOURCES],
    bytes: AtomicUsize,
    permits: [AtomicUsize; PERMITS],
}

impl Ledger {
    fn pools(&self) -> RwLockReadGuard<'_, Pools> {
        read_lock(&self.pools)
    }

    fn holdings(&self) -> Holdings {
        let load = |count: &AtomicUsize| count.load(Ordering::Relaxed);
        Holdings {
            resources: self.resources.each_ref().map(load),
            bytes: load(&self.bytes),
            permits: self.permits.each_ref().map(load),
        }
    }
}

/// The quota of one session, which shares the bounds of its credential with other sessions. Clones share the quota.
#[derive(Clone, Debug)]
pub(crate) struct Quota(Arc<Ledger>);

/// One unit of a resource, returned on drop.
#[derive(Debug)]
pub(crate) struct Charge {
    quota: Quota,
    resource: Resource,
}

impl Drop for Charge {
    fn drop(&mut self) {
        let pools = self.quota.0.pools();
        self.quota.0.resources[self.resource as usize].fetch_sub(1, Ordering::Relaxed);
        give_back(self.resource, &pools);
    }
}

fn give_back(resource: Resource, pools: &[Arc<Counts>]) {
    for counts in pools {
        counts.resources[resource as usize].fetch_sub(1, Ordering::Relaxed);
    }
}

impl Quota {
    /// Returns `true` if both are the quota of the same session.
    fn is_same(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.0, &other.0)
    }

    /// Takes one unit of a resource. `limits` holds the bound of one session.
    pub(crate) fn take(&self, resource: Resource, limits: &SessionLimits) -> Result<Charge, GatewayError> {
        self.try_take(resource, limits).map_err(|full| self.refuse(full))
    }

    /// Takes one unit without counting a refusal.
    fn try_take(&self, resource: Resource, limits: &SessionLimits) -> Result<Charge, PoolFull> {
        let pools = self.0.pools();
        for (at, counts) in pools.iter().enumerate() {
            let max = resource.session_max(limits).saturating_mul(counts.share());
            if !add_within(&counts.resources[resource as usize], 1, max) {
                give_back(resource, &pools[..at]);
                return Err(PoolFull { pool: counts.pool, what: resource.what(), max });
            }
        }
        self.0.resources[resource as usize].fetch_add(1, Ordering::Relaxed);
        Ok(Charge { quota: self.clone(), resource })
    }

    /// Takes one unit of a resource even beyond the bounds.
    fn take_anyway(&self, resource: Resource) -> Charge {
        let pools = self.0.pools();
        for count in pools.iter().map(|counts| &counts.resources).chain([&self.0.resources]) {
            count[resource as usize].fetch_add(1, Ordering::Relaxed);
        }
        Charge { quota: self.clone(), resource }
    }

    /// Moves everything that the session holds to the credential of another client. An error changes nothing.
    pub(crate) fn move_to(&self, client: &Client, limits: &SessionLimits) -> Result<(), GatewayError> {
        let mut pools = write_lock(&self.0.pools);
        let wanted = self.0.quotas.pools(client);
        let holdings = self.0.holdings();
        let is_in = |counts: &Arc<Counts>, of: &Pools| of.iter().any(|other| Arc::ptr_eq(counts, other));
        let joined: Vec<_> = wanted.iter().filter(|counts| !is_in(counts, &pools)).collect();
        for (at, counts) in joined.iter().enumerate() {
            if let Err(full) = counts.take_all(&holdings, limits) {
                joined[..at].iter().for_each(|taken| taken.give_back_all(&holdings));
                return Err(self.refuse(full));
            }
        }
        pools.iter().filter(|counts| !is_in(counts, &wanted)).for_each(|left| left.give_back_all(&holdings));
        *pools = wanted;
        drop(pools);
        self.0.moved.notify_waiters();
        Ok(())
    }

    /// Counts a refusal.
    fn refuse(&self, PoolFull { pool, what, max }: PoolFull) -> GatewayError {
        self.0.quotas.count(pool);
        GatewayError::Crowded { what, max, pool }
    }

    /// Waits for a permit to run a thread that waits for local programs.
    pub(crate) async fn thread(&self) -> Result<Permits, GatewayError> {
        self.acquire(PermitKind::Threads, 1).await.ok_or(GatewayError::Stopping)
    }

    /// Waits for room for long messages, in units.
    pub(crate) async fn room(&self, units: u32) -> Option<Permits> {
        self.acquire(PermitKind::LongBytes, units).await
    }

    /// Takes room for long messages, in units, or fails if a pool has less.
    pub(crate) fn room_at_once(&self, units: u32) -> Result<Permits, GatewayError> {
        let (kind, pools) = (PermitKind::LongBytes, self.0.pools());
        let units = kind.limited(units, &pools);
        let mut held = Vec::with_capacity(pools.len());
        for counts in pools.iter() {
            match Arc::clone(&counts.permits[kind as usize]).try_acquire_many_owned(units) {
                Ok(permits) => held.push(permits),
                Err(_) => {
                    let max = kind.max(counts.pool) * kind.unit();
                    return Err(self.refuse(PoolFull { pool: counts.pool, what: kind.what(), max }));
                }
            }
        }
        Ok(self.keep(kind, units, held))
    }

    /// Takes permits of all pools, the smallest first, so that a client that waits for its own pool holds nothing of
    /// a larger one.
    async fn acquire(&self, kind: PermitKind, units: u32) -> Option<Permits> {
        loop {
            let moved = self.0.moved.notified();
            let pools = Arc::clone(&*self.0.pools());
            let units = kind.limited(units, &pools);
            let all = async {
                let mut held = Vec::with_capacity(pools.len());
                for counts in pools.iter() {
                    let semaphore = Arc::clone(&counts.permits[kind as usize]);
                    held.push(semaphore.acquire_many_owned(units).await.ok()?);
                }
                Some(held)
            };
            let held = tokio::select! {
                held = all => held?,
                () = moved => continue,
            };
            let now = self.0.pools();
            if Arc::ptr_eq(&now, &pools) {
                return Some(self.keep(kind, units, held));
            }
        }
    }

    /// Counts permits for the session. The caller holds the lock of its pools.
    fn keep(&self, kind: PermitKind, units: u32, held: Vec<OwnedSemaphorePermit>) -> Permits {
        held.into_iter().for_each(OwnedSemaphorePermit::forget);
        let units = units as usize;
        self.0.permits[kind as usize].fetch_add(units, Ordering::Relaxed);
        Permits { quota: self.clone(), kind, units }
    }
}

/// A resource for which a client waits if none is free.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum PermitKind {
    Threads,
    LongBytes,
}

const PERMITS: usize = 2;

impl PermitKind {
    const ALL: [Self; PERMITS] = [Self::Threads, Self::LongBytes];

    fn what(self) -> &'static str {
        match self {
            Self::Threads => "threads that wait for local programs",
            Self::LongBytes => "bytes of long messages under way",
        }
    }

    /// Returns the quantity that one permit stands for.
    fn unit(self) -> usize {
        match self {
            Self::Threads => 1,
            Self::LongBytes => UNIT_BYTES,
        }
    }

    /// Returns the number of permits of a pool.
    fn max(self, pool: Pool) -> usize {
        match self {
            Self::Threads => THREADS[pool as usize],
            Self::LongBytes => LONG_BYTES[pool as usize] / self.unit(),
        }
    }

    /// Limits permits to those of the smallest pool, so that a longer message takes all of it.
    fn limited(self, wanted: u32, pools: &Pools) -> u32 {
        let all = pools.iter().map(|counts| self.max(counts.pool)).min().unwrap_or(0);
        wanted.min(u32::try_from(all).unwrap_or(u32::MAX))
    }
}

/// Permits of each pool of a session, returned on drop.
#[derive(Debug)]
pub(crate) struct Permits {
    quota: Quota,
    kind: PermitKind,
    units: usize,
}

impl Drop for Permits {
    fn drop(&mut self) {
        let pools = self.quota.0.pools();
        self.quota.0.permits[self.kind as usize].fetch_sub(self.units, Ordering::Relaxed);
        pools.iter().for_each(|counts| counts.permits[self.kind as usize].add_permits(self.units));
    }
}

/// A reservation for queued bytes, returned on drop.
#[derive(Debug)]
pub(crate) struct ByteReservation {
    waiting: Arc<PendingBytes>,
    bytes: usize,
}

impl ByteReservation {
    /// Reserves bytes, unless the client or one of its pools has less room.
    pub(crate) fn new(
        waiting: &Arc<PendingBytes>,
        what: &'static str,
        bytes: usize,
    ) -> Result<Self, GatewayError> {
        waiting.take(what, bytes)?;
        Ok(Self { waiting: Arc::clone(waiting), bytes })
    }
}

impl ByteReservation {
    /// Reserves bytes if there is room. A refusal is not counted.
    pub(crate) fn if_room(waiting: &Arc<PendingBytes>, bytes: usize) -> Option<Self> {
        waiting.try_take(bytes).ok()?;
        Some(Self { waiting: Arc::clone(waiting), bytes })
    }

    pub(crate) fn bytes(&self) -> usize {
        self.bytes
    }
}

impl Drop for ByteReservation {
    fn drop(&mut self) {
        self.waiting.sub(self.bytes);
    }
}

/// A session that can be charged for the shared reader of a subscription and for its kept messages.
#[derive(Clone, Debug)]
pub(crate) struct Payer {
    quota: Quota,
    limits: SessionLimits,
    /// Bytes of messages that are kept for later subscribers.
    history: Arc<PendingBytes>,
}

impl Payer {
    pub(crate) fn new(quota: Quota, limits: SessionLimits, history: Arc<PendingBytes>) -> Self {
        Self { quota, limits, history }
    }

    /// Charges the session for a reader.
    pub(crate) fn take_reader(&self) -> Result<Charge, GatewayError> {
        self.quota.take(Resource::Readers, &self.limits)
    }

    /// Charges the session for a reader if its bounds permit. A refusal is not counted.
    pub(crate) fn take_reader_if_room(&self) -> Option<Charge> {
        self.quota.try_take(Resource::Readers, &self.limits).ok()
    }

    /// Charges the session for an existing reader, even beyond its bounds.
    pub(crate) fn take_reader_anyway(&self) -> Charge {
        self.quota.take_anyway(Resource::Readers)
    }

    /// Reserves room for a kept message. A refusal is not counted.
    pub(crate) fn take_history(&self, bytes: usize) -> Option<ByteReservation> {
        ByteReservation::if_room(&self.history, bytes)
    }

    /// Returns `true` if both are the same session.
    pub(crate) fn is_same(&self, other: &Self) -> bool {
        self.quota.is_same(&other.quota)
    }

    /// Returns `true` if the reservation is this session's.
    pub(crate) fn has_room(&self, held: &ByteReservation) -> bool {
        Arc::ptr_eq(&held.waiting, &self.history)
    }
}

/// The bound of bytes that has no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum BytesFull {
    /// The client's own bound in bytes.
    Client { max: usize },
    /// The bound of a pool in bytes.
    Pool { pool: Pool, max: usize },
}

/// The bytes of messages that are queued for one client, within its own bound and those of its pools.
#[derive(Debug)]
pub(crate) struct PendingBytes {
    bytes: AtomicUsize,
    bytes_max: usize,
    quota: Quota,
}

impl PendingBytes {
    pub(crate) fn new(bytes_max: usize, quota: Quota) -> Self {
        Self { bytes: AtomicUsize::new(0), bytes_max, quota }
    }

    /// Returns the number of queued bytes.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Returns `true` if there is room for this many more bytes.
    pub(crate) fn has_room(&self, bytes: usize) -> bool {
        self.bytes().saturating_add(bytes) <= self.bytes_max && self.pools_have_room(bytes)
    }

    /// Returns `true` if the pools have room for this many more bytes.
    pub(crate) fn pools_have_room(&self, bytes: usize) -> bool {
        self.quota.0.pools().iter().all(|counts| {
            let max = self.bytes_max.saturating_mul(counts.share());
            counts.bytes.load(Ordering::Relaxed).saturating_add(bytes) <= max
        })
    }

    /// Takes room for bytes, unless the client or one of its pools has less.
    pub(crate) fn take(&self, what: &'static str, bytes: usize) -> Result<(), GatewayError> {
        self.try_take(bytes).map_err(|full| match full {
            BytesFull::Client { max } => GatewayError::TooMany { what, max },
            BytesFull::Pool { pool, max } => self.quota.refuse(PoolFull { pool, what, max }),
        })
    }

    /// Takes room without counting a refusal.
    fn try_take(&self, bytes: usize) -> Result<(), BytesFull> {
        if !add_within(&self.bytes, bytes, self.bytes_max) {
            return Err(BytesFull::Client { max: self.bytes_max });
        }
        let ledger = &self.quota.0;
        let pools = ledger.pools();
        for (at, counts) in pools.iter().enumerate() {
            let max = self.bytes_max.saturating_mul(counts.share());
            if !add_within(&counts.bytes, bytes, max) {
                let taken = pools.iter().take(at).map(|counts| &counts.bytes).chain([&self.bytes]);
                taken.for_each(|count| {
                    count.fetch_sub(bytes, Ordering::Relaxed);
                });
                return Err(BytesFull::Pool { pool: counts.pool, max });
            }
        }
        ledger.bytes.fetch_add(bytes, Ordering::Relaxed);
        Ok(())
    }

    pub(crate) fn add(&self, bytes: usize) {
        self.change(|count| count.fetch_add(bytes, Ordering::Relaxed));
    }

    pub(crate) fn sub(&self, bytes: usize) {
        self.change(|count| count.fetch_sub(bytes, Ordering::Relaxed));
    }

    fn change(&self, change: impl Fn(&AtomicUsize) -> usize) {
        let ledger = &self.quota.0;
        let pools = ledger.pools();
        for count in pools.iter().map(|counts| &counts.bytes).chain([&ledger.bytes, &self.bytes]) {
            change(count);
        }
    }
}

#[cfg(test)]
impl PendingBytes {
    /// Creates a count for a client of this program.
    pub(crate) fn for_own_client(bytes_max: usize) -> Arc<Self> {
        let quotas: Arc<Quotas> = Arc::default();
        Arc::new(Self::new(bytes_max, quotas.quota(&Client::own("test"))))
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use sgc_wire::UnixMillis;

    use super::*;
    use crate::access::{Access, AccessRules, AdmissionRequest, Anonymous};

    const LIMITS: SessionLimits = SessionLimits {
        waiting_bytes_max: 100,
        subscriptions_max: 10,
        publications_max: 10,
        servings_max: 10,
        calls_max: 10,
        waits_max: 10,
    };

    fn client(peer: &str) -> Client {
        let access = Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
        let peer: SocketAddr = peer.parse().unwrap();
        let now = UnixMillis(1_795_000_000_000);
        let admission =
            AdmissionRequest { peer, encrypted: true, origin: None, token: None, certificate: None, now };
        access.admit(&admission).unwrap()
    }

    fn take_all(quota: &Quota) -> (Vec<Charge>, GatewayError) {
        let mut charges = Vec::new();
        loop {
            match quota.take(Resource::Subscriptions, &LIMITS) {
                Ok(charge) => charges.push(charge),
                Err(why) => return (charges, why),
            }
            assert!(charges.len() <= 1000, "nothing stops it");
        }
    }

    #[test]
    fn sessions_of_an_address_share_its_bound() {
        let quotas: Arc<Quotas> = Arc::default();
        // All addresses of an IPv6 network are one host.
        let (held, why) = take_all(&quotas.quota(&client("[2001:db8::1]:1")));
        assert_eq!(held.len(), 40);
        let crowded = |pool, max| GatewayError::Crowded { what: "subscriptions", max, pool };
        assert_eq!(why, crowded(Pool::Credential, 40));
        let again = quotas.quota(&client("[2001:db8::ffff]:1")).take(Resource::Subscriptions, &LIMITS);
        assert_eq!(again.unwrap_err(), crowded(Pool::Credential, 40));
        assert_eq!(quotas.refused(), [(Pool::Credential, 2)].into());
        drop(held);
        assert_eq!(take_all(&quotas.quota(&client("[2001:db8::ffff]:1"))).0.len(), 40);
    }

    #[test]
    fn all_other_hosts_together_leave_something_for_programs_of_this_one() {
        let quotas: Arc<Quotas> = Arc::default();
        let mut held: Vec<_> =
            (1..=3).flat_map(|n| take_all(&quotas.quota(&client(&format!("10.0.0.{n}:1")))).0).collect();
        assert_eq!(held.len(), 120);
        let (none, why) = take_all(&quotas.quota(&client("10.0.0.4:1")));
        assert!(none.is_empty() && matches!(why, GatewayError::Crowded { pool: Pool::Remote, .. }), "{why}");
        let (local, why) = take_all(&quotas.quota(&client("127.0.0.1:1")));
        assert_eq!(local.len(), 40);
        assert!(matches!(why, GatewayError::Crowded { pool: Pool::Total, .. }), "{why}");
        // A refused request leaves nothing behind.
        held.pop();
        assert_eq!(take_all(&quotas.quota(&client("10.0.0.4:1"))).0.len(), 1);
    }

    #[test]
    fn bytes_that_wait_are_bounded_in_all_pools() {
        let quotas: Arc<Quotas> = Arc::default();
        let waiting = |peer: &str| PendingBytes::new(100, quotas.quota(&client(peer)));
        let sessions: Vec<_> = (0..4).map(|_| waiting("10.0.0.1:1")).collect();
        sessions.iter().for_each(|session| session.add(100));
        let fifth = waiting("10.0.0.1:1");
        assert!(!fifth.has_room(1) && waiting("10.0.0.2:1").has_room(100));
        drop(sessions);
        // A counted subtraction returns the bytes.
        fifth.sub(0);
        assert_eq!(fifth.bytes(), 0);
    }

    #[test]
    fn bytes_that_are_refused_leave_nothing_behind() {
        let quotas: Arc<Quotas> = Arc::default();
        let waiting = |peer: &str| PendingBytes::new(100, quotas.quota(&client(peer)));
        let first = Arc::new(waiting("10.0.0.1:1"));
        let refused = first.take("bytes", 101).unwrap_err();
        assert_eq!(refused, GatewayError::TooMany { what: "bytes", max: 100 });
        let sessions: Vec<_> = (0..12).map(|n| waiting(&format!("10.0.0.{}:1", 2 + n / 4))).collect();
        sessions.iter().for_each(|session| session.take("bytes", 100).unwrap());
        let crowded = |pool, max| GatewayError::Crowded { what: "bytes", max, pool };
        assert_eq!(waiting("10.0.0.2:1").take("bytes", 1).unwrap_err(), crowded(Pool::Credential, 400));
        assert_eq!(first.take("bytes", 1).unwrap_err(), crowded(Pool::Remote, 1200));
        assert_eq!(first.bytes(), 0);
        sessions.iter().for_each(|session| session.sub(100));
        let held = ByteReservation::new(&first, "bytes", 100).unwrap();
        assert!(ByteReservation::new(&first, "bytes", 1).is_err());
        drop(held);
        assert_eq!(first.bytes(), 0);
    }

    #[tokio::test]
    async fn all_that_a_session_has_moves_to_the_credential_that_it_shows() {
        let quotas: Arc<Quotas> = Arc::default();
        let [before, after] = ["10.0.0.1:1", "10.0.0.2:1"].map(client);
        let moving = quotas.quota(&before);
        let waiting = Arc::new(PendingBytes::new(100, moving.clone()));
        let charge = moving.take(Resource::Subscriptions, &LIMITS).unwrap();
        let held = ByteReservation::new(&waiting, "bytes", 30).unwrap();
        let permits = (moving.thread().await.unwrap(), moving.room(2).await.unwrap());
        moving.move_to(&after, &LIMITS).unwrap();
        let counts = |client: &Client| {
            let pools = quotas.pools(client);
            let free = pools[0].permits.each_ref().map(|semaphore| semaphore.available_permits());
            let load = |count: &AtomicUsize| count.load(Ordering::Relaxed);
            (load(&pools[0].resources[Resource::Subscriptions as usize]), load(&pools[0].bytes), free)
        };
        let all = PermitKind::ALL.map(|kind| kind.max(Pool::Credential));
        assert_eq!(counts(&before), (0, 0, all));
        assert_eq!(counts(&after), (1, 30, [all[0] - 1, all[1] - 2]));
        assert_eq!(counts(&client("10.0.0.1:2")).0, 0);
        // The pool of all other hosts counts it once.
        assert_eq!(quotas.remote.bytes.load(Ordering::Relaxed), 30);
        // Later charges go to the new credential, which gets everything back in the end.
        let more = moving.take(Resource::Subscriptions, &LIMITS).unwrap();
        assert_eq!(counts(&after).0, 2);
        drop((charge, held, permits, more));
        assert_eq!(counts(&after), (0, 0, all));
        assert_eq!((quotas.remote.bytes.load(Ordering::Relaxed), waiting.bytes()), (0, 0));
    }

    #[tokio::test]
    async fn a_credential_without_room_is_refused_and_nothing_moves() {
        let quotas: Arc<Quotas> = Arc::default();
        let [before, after] = ["10.0.0.1:1", "10.0.0.2:1"].map(client);
        let moving = quotas.quota(&before);
        let _charge = moving.take(Resource::Calls, &LIMITS).unwrap();
        let _thread = moving.thread().await.unwrap();
        let other = quotas.quota(&after);
        let calls: Vec<_> = (0..40).map(|_| other.take(Resource::Calls, &LIMITS).unwrap()).collect();
        let crowded = |what, max| GatewayError::Crowded { what, max, pool: Pool::Credential };
        let refused = moving.move_to(&after, &LIMITS).unwrap_err();
        assert_eq!(refused, crowded("calls under way", 40));
        drop(calls);
        let mut threads = Vec::new();
        for _ in 0..THREADS[0] {
            threads.push(other.thread().await.unwrap());
        }
        let refused = moving.move_to(&after, &LIMITS).unwrap_err();
        assert_eq!(refused, crowded("threads that wait for local programs", THREADS[0]));
        assert_eq!(quotas.refused(), [(Pool::Credential, 2)].into());
        let load = |client: &Client| {
            quotas.pools(client)[0].resources[Resource::Calls as usize].load(Ordering::Relaxed)
        };
        assert_eq!((load(&before), load(&after)), (1, 0));
        threads.pop();
        moving.move_to(&after, &LIMITS).unwrap();
        assert_eq!((load(&before), load(&after)), (0, 1));
    }

    #[tokio::test]
    async fn a_session_that_waits_for_a_crowded_credential_goes_on_with_another() {
        let quotas: Arc<Quotas> = Arc::default();
        let [before, after] = ["10.0.0.1:1", "10.0.0.2:1"].map(client);
        let other = quotas.quota(&before);
        let mut threads = Vec::new();
        for _ in 0..THREADS[0] {
            threads.push(other.thread().await.unwrap());
        }
        let moving = quotas.quota(&before);
        let waits = moving.thread();
        tokio::pin!(waits);
        let within = std::time::Duration::from_millis(20);
        assert!(tokio::time::timeout(within, &mut waits).await.is_err());
        moving.move_to(&after, &LIMITS).unwrap();
        let held = tokio::time::timeout(std::time::Duration::from_secs(10), waits).await;
        assert!(held.unwrap().is_ok());
    }

    #[tokio::test]
    async fn a_message_that_is_longer_than_a_pool_takes_all_of_it() {
        let quotas: Arc<Quotas> = Arc::default();
        let quota = quotas.quota(&client("10.0.0.1:1"));
        let all = tokio::time::timeout(std::time::Duration::from_secs(10), quota.room(u32::MAX)).await;
        assert!(all.unwrap().is_some());
        let _held = quota.room_at_once(u32::MAX).unwrap();
        assert!(quota.room_at_once(1).is_err());
    }

    #[tokio::test]
    async fn remote_clients_leave_threads_for_programs_of_this_host() {
        let quotas: Arc<Quotas> = Arc::default();
        let mut held = Vec::new();
        for n in 1..=3 {
            let quota = quotas.quota(&client(&format!("10.0.0.{n}:1")));
            for _ in 0..THREADS[Pool::Credential as usize] {
                held.push(quota.thread().await.unwrap());
            }
        }
        let within = std::time::Duration::from_millis(20);
        let other = quotas.quota(&client("10.0.0.4:1"));
        assert!(tokio::time::timeout(within, other.thread()).await.is_err());
        quotas.quota(&client("127.0.0.1:1")).thread().await.unwrap();
        held.pop();
        other.thread().await.unwrap();
    }
}
