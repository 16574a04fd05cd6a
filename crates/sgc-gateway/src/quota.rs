//! [`Quota`]: the bounds of a credential over all its sessions, beside the bounds of each session.
//!
//! One credential, with however many connections, has [`CREDENTIAL_SHARE`] times what one session may have; all clients of
//! other hosts together have [`REMOTE_SHARE`] times as much, and all clients of this gateway [`TOTAL_SHARE`] times. The
//! difference of the last two is for programs of this host: no client of another host takes that.
//!
//! `door` decides whether a connection has a place at all.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, Weak};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::access::{Client, Credential};
use crate::error::GatewayError;
use crate::hub::lock;
use crate::session::SessionLimits;

/// Sessions' worth that one credential has.
const CREDENTIAL_SHARE: usize = 4;
/// Sessions' worth that all clients of other hosts have together.
const REMOTE_SHARE: usize = 12;
/// Sessions' worth that all clients have together.
const TOTAL_SHARE: usize = 16;
/// Threads that wait for local programs at a time: of one credential, of all clients of other hosts, in all.
const THREADS: [usize; 3] = [16, 48, 64];
/// Bytes of long messages that are under way between the gateway and clients: of one credential, of all clients of other
/// hosts, in all.
const LONG_BYTES: [usize; 3] = [512 << 20, 1536 << 20, 2048 << 20];

/// Something that a quota bounds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Resource {
    Subscriptions,
    /// Subscriptions that the local network waits for.
    Waits,
    /// Readers on the local network that were made for the client.
    Readers,
    Publications,
    Servings,
    Calls,
}

const RESOURCES: usize = 6;

impl Resource {
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

    /// Returns how many one session may have.
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

/// Clients that share a bound.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Pool {
    /// All clients that show the same token or certificate, or come without one from the same address.
    Credential,
    /// All clients of other hosts.
    Remote,
    /// All clients.
    Total,
}

impl fmt::Display for Pool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Credential => "all clients with this token, certificate or address",
            Self::Remote => "all clients of other hosts",
            Self::Total => "all clients",
        })
    }
}

/// Counts of all that the clients of a pool have.
#[derive(Debug)]
struct Counts {
    pool: Pool,
    resources: [AtomicUsize; RESOURCES],
    /// Bytes of messages that wait.
    bytes: AtomicUsize,
    threads: Arc<Semaphore>,
    long_bytes: Arc<Semaphore>,
}

impl Counts {
    fn new(pool: Pool) -> Arc<Self> {
        let at = pool as usize;
        Arc::new(Self {
            pool,
            resources: Default::default(),
            bytes: AtomicUsize::new(0),
            threads: Arc::new(Semaphore::new(THREADS[at])),
            long_bytes: Arc::new(Semaphore::new(LONG_BYTES[at] / crate::budget::UNIT_BYTES)),
        })
    }

    /// Limits units of room for long messages to those that there are: a longer message takes all.
    fn units(&self, wanted: u32) -> u32 {
        let all = LONG_BYTES[self.pool as usize] / crate::budget::UNIT_BYTES;
        wanted.min(u32::try_from(all).unwrap_or(u32::MAX))
    }

    fn share(&self) -> usize {
        match self.pool {
            Pool::Credential => CREDENTIAL_SHARE,
            Pool::Remote => REMOTE_SHARE,
            Pool::Total => TOTAL_SHARE,
        }
    }
}

/// Counts of all that the clients of a hub have.
#[derive(Debug)]
pub(crate) struct Quotas {
    total: Arc<Counts>,
    remote: Arc<Counts>,
    of: Mutex<BTreeMap<Credential, Weak<Counts>>>,
    /// Refusals, by the pool whose bound it was.
    refused: Mutex<BTreeMap<Pool, u64>>,
}

impl Default for Quotas {
    fn default() -> Self {
        let (total, remote) = (Counts::new(Pool::Total), Counts::new(Pool::Remote));
        Self { total, remote, of: Mutex::default(), refused: Mutex::default() }
    }
}

impl Quotas {
    /// Returns the quota that a client shares with all that have its credential.
    pub(crate) fn quota(self: &Arc<Self>, client: &Client) -> Quota {
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
        let pools = [own, remote, Some(Arc::clone(&self.total))].into_iter().flatten().collect();
        Quota { quotas: Arc::clone(self), pools }
    }

    /// Returns the number of refusals for the bound of each pool.
    pub(crate) fn refused(&self) -> BTreeMap<Pool, u64> {
        lock(&self.refused).clone()
    }

    fn count(&self, pool: Pool) {
        *lock(&self.refused).entry(pool).or_default() += 1;
    }
}

/// The quota of a client's credential. Clones are the same one.
#[derive(Clone, Debug)]
pub(crate) struct Quota {
    quotas: Arc<Quotas>,
    /// The pools of the client, the smallest first.
    pools: Arc<[Arc<Counts>]>,
}

/// One unit of a resource, until dropped.
#[derive(Debug)]
pub(crate) struct Charge {
    quota: Quota,
    resource: Resource,
}

impl Drop for Charge {
    fn drop(&mut self) {
        self.quota.give_back(self.resource, self.quota.pools.len());
    }
}

impl Quota {
    /// Takes one unit of a resource, of which one session may have as many as `limits` say.
    pub(crate) fn take(&self, resource: Resource, limits: &SessionLimits) -> Result<Charge, GatewayError> {
        for (at, counts) in self.pools.iter().enumerate() {
            let max = resource.session_max(limits).saturating_mul(counts.share());
            if counts.resources[resource as usize].fetch_add(1, Ordering::Relaxed) >= max {
                self.give_back(resource, at + 1);
                return Err(self.refuse(resource.what(), counts.pool, max));
            }
        }
        Ok(Charge { quota: self.clone(), resource })
    }

    fn give_back(&self, resource: Resource, pools: usize) {
        for counts in self.pools.iter().take(pools) {
            counts.resources[resource as usize].fetch_sub(1, Ordering::Relaxed);
        }
    }

    fn refuse(&self, what: &'static str, pool: Pool, max: usize) -> GatewayError {
        self.quotas.count(pool);
        GatewayError::Crowded { what, max, pool }
    }

    /// Waits for a thread that may wait for local programs.
    pub(crate) async fn thread(&self) -> Result<Permits, GatewayError> {
        let semaphores = self.pools.iter().map(|counts| (&counts.threads, 1));
        acquire(semaphores).await.ok_or(GatewayError::Stopping)
    }

    /// Waits for so many units of room for long messages.
    pub(crate) async fn room(&self, units: u32) -> Option<Permits> {
        acquire(self.pools.iter().map(|counts| (&counts.long_bytes, counts.units(units)))).await
    }

    /// Takes so many units of room for long messages, unless a pool has less.
    pub(crate) fn room_at_once(&self, units: u32) -> Result<Permits, GatewayError> {
        let mut permits = Vec::with_capacity(self.pools.len());
        for counts in &*self.pools {
            match Arc::clone(&counts.long_bytes).try_acquire_many_owned(counts.units(units)) {
                Ok(permit) => permits.push(permit),
                Err(_) => {
                    let max = LONG_BYTES[counts.pool as usize];
                    return Err(self.refuse("bytes of long messages under way", counts.pool, max));
                }
            }
        }
        Ok(Permits(permits))
    }
}

/// Places in each pool of a client, until dropped.
#[derive(Debug)]
pub(crate) struct Permits(#[expect(dead_code, reason = "they are for their end")] Vec<OwnedSemaphorePermit>);

/// Takes permits of all pools, the smallest first: a client that waits for its own pool holds nothing of a larger one.
async fn acquire<'a>(pools: impl Iterator<Item = (&'a Arc<Semaphore>, u32)>) -> Option<Permits> {
    let mut held = Vec::new();
    for (semaphore, permits) in pools {
        held.push(Arc::clone(semaphore).acquire_many_owned(permits).await.ok()?);
    }
    Some(Permits(held))
}

/// Bytes that wait, until dropped.
#[derive(Debug)]
pub(crate) struct Held {
    waiting: Arc<Waiting>,
    bytes: usize,
}

impl Held {
    /// Takes room for so many bytes, unless the client or one of its pools has less.
    pub(crate) fn new(
        waiting: &Arc<Waiting>,
        what: &'static str,
        bytes: usize,
    ) -> Result<Self, GatewayError> {
        waiting.take(what, bytes)?;
        Ok(Self { waiting: Arc::clone(waiting), bytes })
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.waiting.sub(self.bytes);
    }
}

/// Bytes of messages that wait for one client, within its own bound and those of its pools.
#[derive(Debug)]
pub(crate) struct Waiting {
    bytes: AtomicUsize,
    bytes_max: usize,
    quota: Quota,
}

impl Waiting {
    pub(crate) fn new(bytes_max: usize, quota: Quota) -> Self {
        Self { bytes: AtomicUsize::new(0), bytes_max, quota }
    }

    /// Returns the number of bytes that wait.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Returns `true` if there is room for so many more.
    pub(crate) fn has_room(&self, bytes: usize) -> bool {
        let fits = |now: &AtomicUsize, max| now.load(Ordering::Relaxed).saturating_add(bytes) <= max;
        fits(&self.bytes, self.bytes_max) && self.pools_have_room(bytes)
    }

    /// Returns `true` if the pools have room for so many more.
    pub(crate) fn pools_have_room(&self, bytes: usize) -> bool {
        self.quota.pools.iter().all(|counts| {
            let max = self.bytes_max.saturating_mul(counts.share());
            counts.bytes.load(Ordering::Relaxed).saturating_add(bytes) <= max
        })
    }

    /// Takes room for so many bytes, unless the client or one of its pools has less.
    pub(crate) fn take(&self, what: &'static str, bytes: usize) -> Result<(), GatewayError> {
        let add = |to: &AtomicUsize, max: usize| {
            let fits = |now: usize| now.checked_add(bytes).filter(|sum| *sum <= max);
            to.fetch_update(Ordering::Relaxed, Ordering::Relaxed, fits).is_ok()
        };
        if !add(&self.bytes, self.bytes_max) {
            return Err(GatewayError::TooMany { what, max: self.bytes_max });
        }
        for (at, counts) in self.quota.pools.iter().enumerate() {
            let max = self.bytes_max.saturating_mul(counts.share());
            if !add(&counts.bytes, max) {
                self.bytes.fetch_sub(bytes, Ordering::Relaxed);
                for taken in self.quota.pools.iter().take(at) {
                    taken.bytes.fetch_sub(bytes, Ordering::Relaxed);
                }
                return Err(self.quota.refuse(what, counts.pool, max));
            }
        }
        Ok(())
    }

    pub(crate) fn add(&self, bytes: usize) {
        self.bytes.fetch_add(bytes, Ordering::Relaxed);
        for counts in &*self.quota.pools {
            counts.bytes.fetch_add(bytes, Ordering::Relaxed);
        }
    }

    pub(crate) fn sub(&self, bytes: usize) {
        self.bytes.fetch_sub(bytes, Ordering::Relaxed);
        for counts in &*self.quota.pools {
            counts.bytes.fetch_sub(bytes, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
impl Waiting {
    /// Of a client of this program.
    pub(crate) fn of_own(bytes_max: usize) -> Arc<Self> {
        let quotas: Arc<Quotas> = Arc::default();
        Arc::new(Self::new(bytes_max, quotas.quota(&Client::own("test"))))
    }
}

#[cfg(test)]
mod tests {
    use std::net::SocketAddr;

    use sgc_wire::UnixMillis;

    use super::*;
    use crate::access::{Access, AccessRules, Admission, Anonymous};

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
            Admission { peer, encrypted: true, origin: None, token: None, certificate: None, now };
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
    fn one_address_has_its_share_over_all_its_sessions() {
        let quotas: Arc<Quotas> = Arc::default();
        // One host of IPv6, whatever address of its network it takes.
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
        let waiting = |peer: &str| Waiting::new(100, quotas.quota(&client(peer)));
        let sessions: Vec<_> = (0..4).map(|_| waiting("10.0.0.1:1")).collect();
        sessions.iter().for_each(|session| session.add(100));
        let fifth = waiting("10.0.0.1:1");
        assert!(!fifth.has_room(1) && waiting("10.0.0.2:1").has_room(100));
        drop(sessions);
        // Whoever counts gives back.
        fifth.sub(0);
        assert_eq!(fifth.bytes(), 0);
    }

    #[test]
    fn bytes_that_are_refused_leave_nothing_behind() {
        let quotas: Arc<Quotas> = Arc::default();
        let waiting = |peer: &str| Waiting::new(100, quotas.quota(&client(peer)));
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
        let held = Held::new(&first, "bytes", 100).unwrap();
        assert!(Held::new(&first, "bytes", 1).is_err());
        drop(held);
        assert_eq!(first.bytes(), 0);
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
