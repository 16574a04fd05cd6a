//! [`Door`]: who comes in, whatever protocol it speaks; and whether those who are in may stay.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

use rustls_pki_types::CertificateDer;
use serde::Serialize;
use sgc_trust::{TrustAnchors, VerifiedPeer};
use sgc_wire::UnixMillis;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::access::{Access, Admission, Client, Denied};
use crate::access_watch::AccessWatch;
use crate::clock::WallClock;
use crate::hub::lock;

/// Connections of other hosts that may be in their handshake at a time.
const HANDSHAKES_MAX: usize = 128;
/// The same of one of them.
const HANDSHAKES_OF_HOST_MAX: usize = 16;
/// The same of programs of this host: nobody else takes these.
const HANDSHAKES_LOCAL_MAX: usize = 128;
/// Longest token that is looked at, bytes.
const TOKEN_BYTES_MAX: usize = 32 << 10;

/// Who is connected, for status.
#[derive(Clone, Debug, Serialize, PartialEq, Eq)]
pub struct ClientStatus {
    /// What it is called.
    pub name: String,
    /// `"rosbridge"`, `"foxglove"` or `"grpc"`.
    pub protocol: String,
    /// Where it is.
    pub address: String,
    /// Since when, milliseconds since the Unix epoch.
    pub since: u64,
}

/// What goes on at the gateway, for status.
#[derive(Clone, Debug, Default, Serialize, PartialEq, Eq)]
pub struct GatewayStatus {
    /// Where it listens.
    pub listen: Vec<String>,
    /// Who is connected.
    pub clients: Vec<ClientStatus>,
    /// How many connections were refused, and why.
    pub refused: BTreeMap<String, u64>,
    /// Readers on the local network, shared by all clients.
    pub readers: usize,
}

/// What is known of a connection before its client has said anything.
#[derive(Clone, Debug)]
pub(crate) struct Arrival {
    pub(crate) peer: SocketAddr,
    pub(crate) is_encrypted: bool,
    /// What its certificate proves.
    pub(crate) certificate: Option<VerifiedPeer>,
}

/// Who comes in.
#[derive(Debug)]
pub(crate) struct Door {
    access: AccessWatch,
    clients: Mutex<BTreeMap<u64, ClientStatus>>,
    refused: Mutex<BTreeMap<&'static str, u64>>,
    next: AtomicU64,
    clients_max: usize,
}

/// A place at the gateway; free again when dropped.
#[derive(Debug)]
pub(crate) struct Place {
    door: Arc<Door>,
    number: u64,
}

impl Drop for Place {
    fn drop(&mut self) {
        lock(&self.door.clients).remove(&self.number);
    }
}

impl Door {
    pub(crate) fn new(access: Access, clients_max: usize) -> Arc<Self> {
        let access = AccessWatch::new(access, WallClock::system());
        let (clients, refused, next) = (Mutex::default(), Mutex::default(), AtomicU64::new(0));
        Arc::new(Self { access, clients, refused, next, clients_max })
    }

    /// The rules in force.
    pub(crate) fn rules(&self) -> &AccessWatch {
        &self.access
    }

    pub(crate) fn access(&self) -> Access {
        self.access.current()
    }

    /// What a certificate proves; an error says why it proves nothing.
    pub(crate) fn judge_certificate(
        anchors: Option<&TrustAnchors>,
        chain: &[CertificateDer<'_>],
    ) -> Result<Option<VerifiedPeer>, sgc_trust::CertError> {
        match anchors {
            Some(anchors) if !chain.is_empty() => anchors.verify(chain, now()).map(Some),
            _ => Ok(None),
        }
    }

    /// Who this is, if it may come in.
    pub(crate) fn admit(
        &self,
        arrival: &Arrival,
        origin: Option<&str>,
        token: Option<&str>,
    ) -> Result<Client, Denied> {
        let token = token.map(|token| token.get(..TOKEN_BYTES_MAX).unwrap_or(token));
        let admission = Admission {
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

    pub(crate) fn count(&self, why: &'static str) {
        *lock(&self.refused).entry(why).or_default() += 1;
    }

    /// A place for a client, if there is one.
    pub(crate) fn enter(self: &Arc<Self>, name: &str, protocol: &str, peer: SocketAddr) -> Option<Place> {
        let mut clients = lock(&self.clients);
        if clients.len() >= self.clients_max {
            drop(clients);
            self.count("too many clients");
            return None;
        }
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let (name, protocol) = (name.to_owned(), protocol.to_owned());
        let status = ClientStatus { name, protocol, address: peer.to_string(), since: now().0 };
        clients.insert(number, status);
        Some(Place { door: Arc::clone(self), number })
    }

    pub(crate) fn clients(&self) -> Vec<ClientStatus> {
        lock(&self.clients).values().cloned().collect()
    }

    pub(crate) fn refused(&self) -> BTreeMap<String, u64> {
        let counted = lock(&self.refused);
        // Whatever the protocol: of gRPC each call is admitted.
        let denied = Some(("not admitted", self.access.current().denied())).filter(|(_, count)| *count > 0);
        let all = counted.iter().map(|(why, count)| (*why, *count)).chain(denied);
        all.map(|(why, count)| (why.to_owned(), count)).collect()
    }
}

/// How many connections have not shown yet who they are: of this host, of others, and of each of those.
#[derive(Debug)]
pub(crate) struct Handshakes {
    local: Arc<Semaphore>,
    others: Arc<Semaphore>,
    of_host: Mutex<BTreeMap<IpAddr, usize>>,
}

/// One connection of these, until dropped.
#[derive(Debug)]
pub(crate) struct Handshake {
    handshakes: Arc<Handshakes>,
    /// Whose, if not this host's.
    host: Option<IpAddr>,
    _permit: OwnedSemaphorePermit,
}

impl Default for Handshakes {
    fn default() -> Self {
        let [local, others] = [HANDSHAKES_LOCAL_MAX, HANDSHAKES_MAX].map(|max| Arc::new(Semaphore::new(max)));
        Self { local, others, of_host: Mutex::default() }
    }
}

impl Handshakes {
    /// Counts one from there, unless there are too many.
    pub(crate) fn begin(this: &Arc<Self>, from: IpAddr) -> Option<Handshake> {
        let from = from.to_canonical();
        let handshakes = Arc::clone(this);
        if from.is_loopback() {
            let _permit = Arc::clone(&this.local).try_acquire_owned().ok()?;
            return Some(Handshake { handshakes, host: None, _permit });
        }
        let mut of_host = lock(&this.of_host);
        if of_host.get(&from).is_some_and(|count| *count >= HANDSHAKES_OF_HOST_MAX) {
            return None;
        }
        let _permit = Arc::clone(&this.others).try_acquire_owned().ok()?;
        *of_host.entry(from).or_default() += 1;
        Some(Handshake { handshakes, host: Some(from), _permit })
    }
}

impl Drop for Handshake {
    fn drop(&mut self) {
        let Some(host) = self.host else { return };
        let mut of_host = lock(&self.handshakes.of_host);
        let left = of_host.get(&host).map_or(0, |count| count.saturating_sub(1));
        if left == 0 {
            of_host.remove(&host);
        } else {
            of_host.insert(host, left);
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

    #[test]
    fn silent_hosts_lock_out_neither_others_nor_programs_of_this_one() {
        let handshakes: Arc<Handshakes> = Arc::default();
        let host = |n: u8| IpAddr::from([192, 0, 2, n]);
        let begin = |from| Handshakes::begin(&handshakes, from);
        let mut held: Vec<_> = std::iter::from_fn(|| begin(host(1))).collect();
        assert_eq!(held.len(), HANDSHAKES_OF_HOST_MAX);
        held.pop();
        held.push(begin("::ffff:192.0.2.1".parse().unwrap()).unwrap());
        assert!(begin(host(1)).is_none());
        for n in 2.. {
            let of_host: Vec<_> = std::iter::from_fn(|| begin(host(n))).collect();
            if of_host.is_empty() {
                break;
            }
            held.extend(of_host);
        }
        assert_eq!(held.len(), HANDSHAKES_MAX);
        assert!(begin([127, 0, 0, 1].into()).is_some() && begin("::1".parse().unwrap()).is_some());
        held.clear();
        assert!(begin(host(200)).is_some() && lock(&handshakes.of_host).is_empty());
    }
}
