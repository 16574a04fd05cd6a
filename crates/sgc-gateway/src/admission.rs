//! [`Admission`]: admits clients of every protocol, bounds their number and disconnects those whose rights end.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Instant;

use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_sync::lock;
use sgc_trust::{
    AddressPrefix, PlaceDecision, PlaceLimits, Places, TrustAnchors, VerifiedPeer, certificate_end,
    certificate_names, certificate_pin,
};
use sgc_wire::UnixMillis;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};

use crate::access::{Access, AdmissionRequest, Client, Credential, Denial};
use crate::access_watch::AccessWatch;
use crate::clock::WallClock;
use crate::error::GatewayError;
use crate::pool::Pool;
use crate::refusal::ClientRefusal;

/// Most connections of other hosts in their handshake at a time.
const HANDSHAKES_MAX: usize = 128;
/// Most handshakes of one source, an IPv4 address or an IPv6 network.
const HANDSHAKES_OF_HOST_MAX: usize = 16;
/// Most handshakes of programs on this host. Other hosts cannot use these.
const HANDSHAKES_LOCAL_MAX: usize = 128;
/// Divisor: one part in this many of all places is reserved for programs on this host.
const LOCAL_PART: usize = 8;
/// Divisor: one credential may hold one part in this many of the places for other hosts.
const CREDENTIAL_PART: usize = 4;
/// Longest token that is examined, in bytes.
const TOKEN_BYTES_MAX: usize = 32 << 10;

/// A connected client, for status.
#[derive(Clone, Debug, Serialize, PartialEq, Eq)]
pub struct ClientStatus {
    /// The name of the client.
    pub name: String,
    /// The protocol: `"rosbridge"`, `"foxglove"` or `"grpc"`.
    pub protocol: String,
    /// The address of the client.
    pub address: String,
    /// The time of admission, in milliseconds since the Unix epoch.
    pub since: u64,
}

/// The status of the gateway.
#[derive(Clone, Debug, Default, Serialize, PartialEq, Eq)]
pub struct GatewayStatus {
    /// The listening addresses.
    pub listen: Vec<String>,
    /// The connected clients.
    pub clients: Vec<ClientStatus>,
    /// The number of refused connections by reason, and of messages and calls that the gateway gave up.
    pub refused: BTreeMap<String, u64>,
    /// The number of readers on the local network, shared by all clients.
    pub readers: usize,
    /// The certificate that clients are shown within TLS; null without TLS.
    pub certificate: Option<ShownCertificate>,
}

/// The certificate that clients of a gateway are shown.
#[derive(Clone, Debug, Serialize, PartialEq, Eq)]
pub struct ShownCertificate {
    /// The pin of its key, `sha256/BASE64`.
    pub pin: String,
    /// Its DNS names and addresses.
    pub names: Vec<String>,
    /// The last moment at which it is valid, in milliseconds since the Unix epoch.
    pub until: u64,
}

impl ShownCertificate {
    /// Returns the properties of a certificate; `None` if it cannot be read.
    pub fn of(certificate: &CertificateDer<'_>) -> Option<Self> {
        Some(Self {
            pin: certificate_pin(certificate)?,
            names: certificate_names(certificate).iter().map(ToString::to_string).collect(),
            until: certificate_end(certificate)?.0,
        })
    }
}

/// The properties of a connection before its client has sent anything.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    pub(crate) peer: SocketAddr,
    pub(crate) is_encrypted: bool,
    /// The identity that the certificate proves.
    pub(crate) certificate: Option<VerifiedPeer>,
}

/// The admission of clients.
#[derive(Debug)]
pub(crate) struct Admission {
    access: AccessWatch,
    clients: Mutex<BTreeMap<u64, ClientEntry>>,
    refused: Mutex<BTreeMap<ClientRefusal, u64>>,
    next: AtomicU64,
    clients_max: AtomicUsize,
}

/// A client that has a place.
#[derive(Debug)]
struct ClientEntry {
    status: ClientStatus,
    credential: Option<Credential>,
    is_local: bool,
}

/// A client's place at the gateway, freed on drop.
#[derive(Debug)]
pub(crate) struct Place {
    admission: Arc<Admission>,
    number: u64,
}

impl Place {
    /// Gives the place to another client, unless all places of that client's credential are taken.
    pub(crate) fn rename(&self, client: &Client) -> Result<(), GatewayError> {
        let mut clients = lock(&self.admission.clients);
        if let Some(pool) = self.admission.full_pool(&clients, client, Some(self.number)) {
            drop(clients);
            return Err(self.admission.crowded(pool));
        }
        if let Some(entered) = clients.get_mut(&self.number) {
            entered.status.name = client.name.to_string();
            (entered.credential, entered.is_local) = (client.credential(), client.is_local());
        }
        Ok(())
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        lock(&self.admission.clients).remove(&self.number);
    }
}

impl Admission {
    pub(crate) fn new(access: Access, clients_max: usize) -> Arc<Self> {
        let access = AccessWatch::new(access, WallClock::system());
        let (clients, refused, next) = (Mutex::default(), Mutex::default(), AtomicU64::new(0));
        Arc::new(Self { access, clients, refused, next, clients_max: AtomicUsize::new(clients_max) })
    }

    /// Changes the number of places for clients. Clients that have one keep it.
    pub(crate) fn set_clients_max(&self, clients_max: usize) {
        self.clients_max.store(clients_max, Ordering::Relaxed);
    }

    /// Returns the rules in force.
    pub(crate) fn rules(&self) -> &AccessWatch {
        &self.access
    }

    pub(crate) fn access(&self) -> Access {
        self.access.current()
    }

    /// Verifies a certificate chain. Returns `None` if there is no chain or no trust anchor.
    pub(crate) fn judge_certificate(
        anchors: Option<&TrustAnchors>,
        chain: &[CertificateDer<'_>],
    ) -> Result<Option<VerifiedPeer>, sgc_trust::CertError> {
        match anchors {
            Some(anchors) if !chain.is_empty() => anchors.verify(chain, now()).map(Some),
            _ => Ok(None),
        }
    }

    /// Admits a client.
    pub(crate) fn admit(
        &self,
        arrival: &Arrival,
        origin: Option<&str>,
        token: Option<&str>,
    ) -> Result<Client, Denial> {
        let token = token.map(|token| token.get(..TOKEN_BYTES_MAX).unwrap_or(token));
        let admission = AdmissionRequest {
            peer: arrival.peer,
            encrypted: arrival.is_encrypted,
            origin,
            token,
            certificate: arrival.certificate.as_ref(),
            now: now(),
        };
        let access = self.access();
        access.admit(&admission).inspect_err(|denied| {
            tracing::debug!(peer = %arrival.peer, %denied, "a client is not admitted");
        })
    }

    pub(crate) fn count(&self, why: ClientRefusal) {
        *lock(&self.refused).entry(why).or_default() += 1;
    }

    /// Takes a place for a client.
    ///
    /// # Errors
    /// The bound whose places are taken. The refusal has been counted.
    pub(crate) fn enter(
        self: &Arc<Self>,
        client: &Client,
        protocol: &str,
        peer: SocketAddr,
    ) -> Result<Place, GatewayError> {
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let mut clients = lock(&self.clients);
        if let Some(pool) = self.full_pool(&clients, client, None) {
            drop(clients);
            return Err(self.crowded(pool));
        }
        let status = ClientStatus {
            name: client.name.to_string(),
            protocol: protocol.to_owned(),
            address: peer.to_string(),
            since: now().0,
        };
        clients.insert(
            number,
            ClientEntry { status, credential: client.credential(), is_local: client.is_local() },
        );
        drop(clients);
        Ok(Place { admission: Arc::clone(self), number })
    }

    /// Counts a refusal for lack of a place, and returns it.
    fn crowded(&self, pool: Pool) -> GatewayError {
        self.count(ClientRefusal::TooManyClients(pool));
        GatewayError::Crowded { what: "clients", max: self.places_max(pool), pool }
    }

    /// Returns the number of places for the clients of a pool.
    fn places_max(&self, pool: Pool) -> usize {
        let all = self.clients_max.load(Ordering::Relaxed);
        let remote = (all - all / LOCAL_PART).max(1);
        match pool {
            Pool::Total => all,
            Pool::Remote => remote,
            Pool::Credential => (remote / CREDENTIAL_PART).max(1),
        }
    }

    /// Returns the pool that has no place for the client: its credential, other hosts or all clients. `except` is the
    /// place that the client already has.
    fn full_pool(
        &self,
        clients: &BTreeMap<u64, ClientEntry>,
        client: &Client,
        except: Option<u64>,
    ) -> Option<Pool> {
        let count = |is_counted: &dyn Fn(&ClientEntry) -> bool| {
            let others = clients.iter().filter(|(number, _)| Some(**number) != except);
            others.filter(|(_, entered)| is_counted(entered)).count()
        };
        if count(&|_| true) >= self.places_max(Pool::Total) {
            return Some(Pool::Total);
        }
        if !client.is_local() && count(&|entered| !entered.is_local) >= self.places_max(Pool::Remote) {
            return Some(Pool::Remote);
        }
        let own = client.credential().filter(|credential| *credential != Credential::Local);
        if own.is_some() && count(&|entered| entered.credential == own) >= self.places_max(Pool::Credential) {
            return Some(Pool::Credential);
        }
        None
    }

    pub(crate) fn clients(&self) -> Vec<ClientStatus> {
        lock(&self.clients).values().map(|entered| entered.status.clone()).collect()
    }

    pub(crate) fn refused(&self) -> BTreeMap<String, u64> {
        let counted = lock(&self.refused);
        // The count covers all protocols, because gRPC admits each call.
        let denied = Some((ClientRefusal::NotAdmitted, self.access.current().denied()));
        let denied = denied.filter(|(_, count)| *count > 0);
        let all = counted.iter().map(|(why, count)| (*why, *count)).chain(denied);
        all.map(|(why, count)| (why.key().to_owned(), count)).collect()
    }
}

/// Connections whose clients are not admitted yet. Those of this host have their own places; among other hosts the
/// source with the most handshakes gives way.
#[derive(Debug)]
pub(crate) struct Handshakes {
    local: Arc<Semaphore>,
    others: Mutex<Places<Holder>>,
    next: AtomicU64,
}

/// A handle that ends a handshake of another host.
#[derive(Debug)]
struct Holder {
    number: u64,
    /// `true` once bytes have arrived.
    is_engaged: Arc<AtomicBool>,
    /// Dropping the sender tells the handshake that it lost its place.
    _evict: oneshot::Sender<()>,
}

/// A connection during its handshake, counted until dropped.
#[derive(Debug)]
pub(crate) struct Handshake {
    handshakes: Arc<Handshakes>,
    place: HandshakePlace,
}

/// A flag for the arrival of the first bytes of a handshake.
#[derive(Debug)]
pub(crate) struct Engagement(Arc<AtomicBool>);

impl Engagement {
    /// Sets the flag, after which the handshake keeps its place for a moment longer.
    pub(crate) fn begin(&self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[derive(Debug)]
enum HandshakePlace {
    /// A place of this host.
    Local(#[expect(dead_code, reason = "it is for its end")] OwnedSemaphorePermit),
    /// A place of another host.
    Other { number: u64, is_engaged: Arc<AtomicBool>, evicted: oneshot::Receiver<()> },
}

impl Default for Handshakes {
    fn default() -> Self {
        let limits = PlaceLimits { all: HANDSHAKES_MAX, per_prefix: HANDSHAKES_OF_HOST_MAX };
        let local = Arc::new(Semaphore::new(HANDSHAKES_LOCAL_MAX));
        Self { local, others: Mutex::new(Places::new(limits)), next: AtomicU64::new(0) }
    }
}

impl Handshakes {
    /// Counts a handshake, unless all places are taken and none gives way.
    pub(crate) fn begin(this: &Arc<Self>, from: IpAddr) -> Option<Handshake> {
        let handshakes = Arc::clone(this);
        if from.to_canonical().is_loopback() {
            let permit = Arc::clone(&this.local).try_acquire_owned().ok()?;
            return Some(Handshake { handshakes, place: HandshakePlace::Local(permit) });
        }
        let (prefix, now) = (AddressPrefix::from(from), Instant::now());
        let mut others = lock(&this.others);
        let room = others.make_room(prefix, now, |holder| holder.is_engaged.load(Ordering::Relaxed));
        // A handshake that gives way has ended with its holder.
        if matches!(room, PlaceDecision::Refuse(_)) {
            return None;
        }
        let (evict, evicted) = oneshot::channel();
        let (number, is_engaged) = (this.next.fetch_add(1, Ordering::Relaxed), Arc::<AtomicBool>::default());
        let holder = Holder { number, is_engaged: Arc::clone(&is_engaged), _evict: evict };
        others.take(prefix, now, holder);
        drop(others);
        let place = HandshakePlace::Other { number, is_engaged, evicted };
        Some(Handshake { handshakes, place })
    }
}

impl Handshake {
    /// Returns the flag that the reader sets when bytes arrive.
    pub(crate) fn engagement(&self) -> Engagement {
        Engagement(match &self.place {
            HandshakePlace::Local(_) => Arc::default(),
            HandshakePlace::Other { is_engaged, .. } => Arc::clone(is_engaged),
        })
    }

    /// Is ready once another handshake has taken the place.
    pub(crate) fn poll_evicted(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        match &mut self.place {
            HandshakePlace::Local(_) => Poll::Pending,
            HandshakePlace::Other { evicted, .. } => Pin::new(evicted).poll(cx).map(drop),
        }
    }

    /// Waits until another handshake has taken the place.
    pub(crate) async fn evicted(&mut self) {
        std::future::poll_fn(|cx| self.poll_evicted(cx)).await;
    }
}

impl Drop for Handshake {
    fn drop(&mut self) {
        if let HandshakePlace::Other { number, .. } = &self.place {
            lock(&self.handshakes.others).retain(|holder| holder.number != *number);
        }
    }
}

pub(crate) fn now() -> UnixMillis {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    UnixMillis(since.map_or(0, |since| since.as_millis().try_into().unwrap_or(u64::MAX)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::access::{AccessRules, Anonymous};

    fn client(access: &Access, peer: SocketAddr) -> Client {
        let admission = AdmissionRequest {
            peer,
            encrypted: true,
            origin: None,
            token: None,
            certificate: None,
            now: now(),
        };
        access.admit(&admission).unwrap()
    }

    #[test]
    fn silent_hosts_lock_out_neither_others_nor_programs_of_this_one() {
        let handshakes: Arc<Handshakes> = Arc::default();
        let begin = |from: IpAddr| Handshakes::begin(&handshakes, from);
        // An IPv6 host with many addresses is one source and displaces only itself.
        let host = |n: u128| IpAddr::from(std::net::Ipv6Addr::from_bits(0x2001_0db8 << 96 | n));
        let silent: Vec<_> = (0..1000).map(|n| begin(host(n)).unwrap()).collect();
        assert_eq!(lock(&handshakes.others).len(), HANDSHAKES_OF_HOST_MAX);
        // A handshake that has sent bytes is not displaced at once, not even by the same address.
        silent.iter().for_each(|handshake| handshake.engagement().begin());
        assert!(begin(host(1001)).is_none());
        let mut honest = begin([192, 0, 2, 7].into()).unwrap();
        honest.engagement().begin();
        // Among many networks at their limit the heaviest gives way, not a network with one handshake.
        let mut held = Vec::new();
        for network in 1..=20u128 {
            for n in 0..HANDSHAKES_OF_HOST_MAX as u128 {
                held.extend(begin(host(network << 64 | n)));
            }
        }
        assert_eq!(lock(&handshakes.others).len(), HANDSHAKES_MAX);
        let _late = begin([192, 0, 2, 8].into()).unwrap();
        assert_eq!(lock(&handshakes.others).len(), HANDSHAKES_MAX);
        let waker = futures_util::task::noop_waker();
        assert!(honest.poll_evicted(&mut Context::from_waker(&waker)).is_pending());
        assert!(begin([127, 0, 0, 1].into()).is_some() && begin("::1".parse().unwrap()).is_some());
        drop((silent, held, honest, _late));
        assert!(lock(&handshakes.others).is_empty());
    }

    #[tokio::test]
    async fn credentials_and_other_hosts_leave_places() {
        let all = || Access::new(AccessRules { anonymous: Anonymous::All, ..AccessRules::default() });
        let (access, admission) = (all(), Admission::new(all(), 64));
        let enter = |peer: &str| {
            let peer = peer.parse().unwrap();
            admission.enter(&client(&access, peer), "rosbridge", peer).ok()
        };
        // Of 64 places 8 are reserved for this host, and one credential may hold a quarter of the rest.
        let mut held: Vec<_> = std::iter::from_fn(|| enter("[2001:db8::1]:1")).collect();
        assert_eq!(held.len(), 14);
        assert!(enter("[2001:db8::2]:1").is_none(), "it is the same host");
        for n in 1..=4 {
            held.extend(std::iter::from_fn(|| enter(&format!("10.0.0.{n}:1"))));
        }
        assert_eq!(held.len(), 56);
        let local: Vec<_> = std::iter::from_fn(|| enter("127.0.0.1:1")).collect();
        assert_eq!(local.len(), 8);
        let counted = admission.refused();
        assert!(counted["too many clients of one credential"] >= 2, "{counted:?}");
        assert!(counted["too many clients of other hosts"] >= 1, "{counted:?}");
        assert_eq!(counted["too many clients"], 1);
        drop(local);
        assert!(enter("10.0.0.9:1").is_none() && enter("127.0.0.1:1").is_some());
        held.pop();
        assert!(enter("10.0.0.9:1").is_some());
        // Fewer places take none away from those that have one, and more count at once.
        admission.set_clients_max(8);
        assert!(enter("127.0.0.1:1").is_none());
        assert_eq!(admission.clients().len(), 55);
        admission.set_clients_max(72);
        assert!(enter("10.0.0.9:1").is_some());
    }
}
