//! The sockets of dialled QUIC links in further roles: connectivity checks (ICE, RFC 8445) leave and arrive there,
//! peers whose checks were authentic may make links, and dialled DTLS links borrow them. A NAT gives each socket a
//! mapping of its own, so the checks have to use the socket of the links.
//!
//! Datagrams are told apart by their first bytes (RFC 9443), since peers do not clear the bit of QUIC here. Those of
//! DTLS go to the borrower of their source address.

#[cfg_attr(not(feature = "dtls"), expect(dead_code, reason = "only DTLS links borrow"))]
mod borrowed;

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};

use bytes::Bytes;
use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use sgc_sync::lock;
use sgc_wire::NodeId;
use tokio::sync::mpsc;

use self::borrowed::Borrowers;

/// Most checks that wait for their receiver; further ones are dropped, as the network does.
const CHECKS_WAITING_MAX: usize = 64;
/// Most addresses from which links are accepted.
const EXPECTED_MAX: usize = 2048;
/// A message of STUN begins with two zero bits (RFC 8489, 5), and has this at offset 4.
const STUN_COOKIE: [u8; 4] = [0x21, 0x12, 0xa4, 0x42];
const STUN_HEADER_BYTES: usize = 20;

/// A datagram that looks like a check. It is not verified.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CheckDatagram {
    /// The port at which it arrived.
    pub port: u16,
    /// The address at which it arrived, if the system told.
    pub to: Option<IpAddr>,
    /// The address from which it came.
    pub from: SocketAddr,
    /// Its content.
    pub datagram: Bytes,
}

/// The sockets of dialled QUIC links. Clones share them.
#[derive(Clone)]
pub struct DirectHandle {
    shared: Arc<DirectShared>,
}

struct DirectShared {
    /// The nodes whose links are accepted, by the addresses from which they may come.
    expected: Mutex<BTreeMap<SocketAddr, NodeId>>,
    takes_checks: AtomicBool,
    checks: mpsc::Sender<CheckDatagram>,
    /// Checks for which there was no room.
    overflowed: AtomicU64,
    sockets: Mutex<Sockets>,
    borrowers: Borrowers,
}

/// The socket of one address family. A rebind replaces it.
type FamilySocket = Arc<Mutex<Arc<dyn AsyncUdpSocket>>>;

#[derive(Default)]
struct Sockets {
    v4: Option<FamilySocket>,
    v6: Option<FamilySocket>,
}

impl Sockets {
    fn like(&mut self, address: &SocketAddr) -> &mut Option<FamilySocket> {
        match address {
            SocketAddr::V4(_) => &mut self.v4,
            SocketAddr::V6(_) => &mut self.v6,
        }
    }
}

impl DirectHandle {
    /// Returns a handle without sockets, and the checks that will arrive.
    pub(crate) fn new() -> (Self, mpsc::Receiver<CheckDatagram>) {
        let (checks, arriving) = mpsc::channel(CHECKS_WAITING_MAX);
        let shared = DirectShared {
            expected: Mutex::default(),
            takes_checks: AtomicBool::new(false),
            checks,
            overflowed: AtomicU64::new(0),
            sockets: Mutex::default(),
            borrowers: Borrowers::default(),
        };
        (Self { shared: Arc::new(shared) }, arriving)
    }

    /// Returns a socket that hands checks over, and uses it for checks from here on, in place of an earlier one.
    pub(crate) fn wrap(&self, inner: Arc<dyn AsyncUdpSocket>) -> io::Result<Arc<dyn AsyncUdpSocket>> {
        let local = inner.local_addr()?;
        match lock(&self.shared.sockets).like(&local) {
            Some(socket) => *lock(socket) = Arc::clone(&inner),
            none => *none = Some(Arc::new(Mutex::new(Arc::clone(&inner)))),
        }
        Ok(Arc::new(CheckSocket { inner, port: local.port(), shared: Arc::clone(&self.shared) }))
    }

    /// Returns the ports of the sockets for IPv4 and IPv6.
    pub fn ports(&self) -> (Option<u16>, Option<u16>) {
        let sockets = lock(&self.shared.sockets);
        let port = |socket: &Option<FamilySocket>| Some(lock(socket.as_ref()?).local_addr().ok()?.port());
        (port(&sockets.v4), port(&sockets.v6))
    }

    /// Sends a datagram, from the address that the system chooses. One that finds no room or no route is lost, like any
    /// other.
    pub fn send(&self, to: SocketAddr, datagram: &[u8]) {
        let socket = self.shared.socket_like(&to).map(|socket| Arc::clone(&lock(&socket)));
        let transmit =
            Transmit { destination: to, ecn: None, contents: datagram, segment_size: None, src_ip: None };
        if let Some(Err(error)) = socket.map(|socket| socket.try_send(&transmit)) {
            tracing::trace!(%error, %to, "check not sent");
        }
    }

    /// Hands checks over from here on, or no more of them.
    pub fn take_checks(&self, takes_checks: bool) {
        self.shared.takes_checks.store(takes_checks, Relaxed);
    }

    /// Accepts links of this node from this address.
    pub fn expect(&self, address: SocketAddr, node: NodeId) {
        let mut expected = lock(&self.shared.expected);
        if expected.len() < EXPECTED_MAX {
            expected.insert(address, node);
        }
    }

    /// Accepts no more links of this node.
    pub fn shut(&self, node: &NodeId) {
        lock(&self.shared.expected).retain(|_, expected| expected != node);
    }

    /// Returns the node whose links are accepted from this address.
    pub(crate) fn expected(&self, address: &SocketAddr) -> Option<NodeId> {
        lock(&self.shared.expected).get(address).copied()
    }

    /// Returns the number of checks that were dropped because too many waited.
    pub fn overflowed(&self) -> u64 {
        self.shared.overflowed.load(Relaxed)
    }

    /// Returns the number of datagrams of DTLS links that were dropped because too many waited.
    pub fn dtls_overflowed(&self) -> u64 {
        self.shared.borrowers.overflowed()
    }
}

impl DirectShared {
    fn socket_like(&self, address: &SocketAddr) -> Option<FamilySocket> {
        lock(&self.sockets).like(address).clone()
    }
}

impl fmt::Debug for DirectHandle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DirectHandle").field("ports", &self.ports()).finish_non_exhaustive()
    }
}

/// A socket that QUIC shares with others.
struct CheckSocket {
    inner: Arc<dyn AsyncUdpSocket>,
    port: u16,
    shared: Arc<DirectShared>,
}

impl CheckSocket {
    /// Hands over the checks among received datagrams, and leaves the others.
    fn take_checks(&self, buf: &mut [u8], meta: &mut RecvMeta) {
        let Some(checks) = take_out(buf, meta, is_check) else { return };
        for datagram in checks.chunks(meta.stride.max(1)) {
            let datagram = checks.slice_ref(datagram);
            let check = CheckDatagram { port: self.port, to: meta.dst_ip, from: meta.addr, datagram };
            if self.shared.checks.try_send(check).is_err() {
                self.shared.overflowed.fetch_add(1, Relaxed);
            }
        }
    }
}

/// Takes the datagrams of one kind out of a batch, and leaves the others in it.
fn take_out(buf: &mut [u8], meta: &mut RecvMeta, is_wanted: fn(&[u8]) -> bool) -> Option<Bytes> {
    let (len, stride) = (meta.len.min(buf.len()), meta.stride.max(1));
    if !buf[..len].chunks(stride).any(is_wanted) {
        return None;
    }
    let mut taken = Vec::with_capacity(len);
    let (mut at, mut left) = (0, 0);
    while at < len {
        let end = (at + stride).min(len);
        if is_wanted(&buf[at..end]) {
            taken.extend_from_slice(&buf[at..end]);
        } else {
            buf.copy_within(at..end, left);
            left += end - at;
        }
        at = end;
    }
    // Quinn reads nothing of an empty batch.
    meta.len = left;
    Some(taken.into())
}

impl fmt::Debug for CheckSocket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("CheckSocket").field(&self.inner).finish()
    }
}

impl AsyncUdpSocket for CheckSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Arc::clone(&self.inner).create_io_poller()
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.inner.try_send(transmit)
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let count = ready!(self.inner.poll_recv(cx, bufs, meta))?;
        let takes_checks = self.shared.takes_checks.load(Relaxed);
        let has_borrowers = self.shared.borrowers.are_some();
        if takes_checks || has_borrowers {
            for (buf, meta) in bufs.iter_mut().zip(meta).take(count) {
                if takes_checks {
                    self.take_checks(buf, meta);
                }
                if has_borrowers {
                    self.shared.borrowers.take_theirs(buf, meta);
                }
            }
        }
        Poll::Ready(Ok(count))
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner.local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.inner.may_fragment()
    }

    fn max_transmit_segments(&self) -> usize {
        self.inner.max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.inner.max_receive_segments()
    }
}

/// Returns `true` for a datagram with the header of STUN.
fn is_check(datagram: &[u8]) -> bool {
    let Some((header, rest)) = datagram.split_at_checked(STUN_HEADER_BYTES) else { return false };
    header[0] < 4
        && header[4..8] == STUN_COOKIE
        && u16::from_be_bytes([header[2], header[3]]) as usize == rest.len()
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::time::{Duration, SystemTime, UNIX_EPOCH};

    use rand_core::{OsRng, TryRngCore as _};
    use sgc_trust::{EnrollRequest, Fleet};
    use sgc_wire::UnixMillis;
    use tokio::time::timeout;

    use super::*;
    use crate::options::LinkOptions;
    use crate::{CloseReason, CredentialStore, Dialer, DirectSockets, Link as _, LinkError, LinkUrl, socket};

    const PATIENCE: Duration = Duration::from_secs(20);

    fn check(bytes: usize) -> Vec<u8> {
        let mut check = vec![0; bytes];
        check[1] = 1;
        check[2..4].copy_from_slice(&((bytes - STUN_HEADER_BYTES) as u16).to_be_bytes());
        check[4..8].copy_from_slice(&STUN_COOKIE);
        check
    }

    /// Receives until there is a batch that is not empty.
    async fn receive(socket: &Arc<dyn AsyncUdpSocket>) -> Vec<u8> {
        let mut buffer = vec![0; 64 << 10];
        loop {
            let mut meta = [RecvMeta::default()];
            let mut bufs = [IoSliceMut::new(&mut buffer)];
            let received = poll_fn(|cx| socket.poll_recv(cx, &mut bufs, &mut meta));
            assert_eq!(timeout(PATIENCE, received).await.unwrap().unwrap(), 1);
            if meta[0].len > 0 {
                return buffer[..meta[0].len].to_vec();
            }
        }
    }

    #[tokio::test]
    async fn checks_go_to_their_receiver_and_other_datagrams_to_quic() {
        let (handle, mut checks) = DirectHandle::new();
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let (inner, local) = socket::bind(any, &LinkOptions::default()).unwrap();
        let socket = handle.wrap(inner).unwrap();
        assert_eq!(handle.ports(), (Some(local.port()), None));
        let (peer, peer_addr) = socket::bind(any, &LinkOptions::default()).unwrap();
        let send = |contents: &[u8], segment_size| {
            let transmit = Transmit { destination: local, ecn: None, contents, segment_size, src_ip: None };
            peer.try_send(&transmit).unwrap();
        };
        // As long as nobody wants checks, QUIC gets them.
        send(&check(40), None);
        assert_eq!(receive(&socket).await, check(40));
        handle.take_checks(true);
        // The kernel joins datagrams of one length.
        let mixed = [vec![0x40; 40], check(40), vec![0x41; 40], check(40)].concat();
        if peer.max_transmit_segments() >= 4 {
            send(&mixed, Some(40));
        } else {
            mixed.chunks(40).for_each(|datagram| send(datagram, None));
        }
        send(&[0x42; 40], None);
        let mut quic = Vec::new();
        while quic.len() < 120 {
            quic.extend(receive(&socket).await);
        }
        assert_eq!(quic, [vec![0x40; 40], vec![0x41; 40], vec![0x42; 40]].concat());
        for _ in 0..2 {
            let arrived = checks.try_recv().unwrap();
            assert_eq!((arrived.port, arrived.from), (local.port(), peer_addr));
            assert_eq!(arrived.datagram, check(40));
        }
        assert!(checks.try_recv().is_err());
        // Their receiver is slow.
        for _ in 0..2 * CHECKS_WAITING_MAX {
            send(&check(20), None);
            send(&[0x43; 20], None);
            receive(&socket).await;
        }
        assert_eq!(handle.overflowed(), CHECKS_WAITING_MAX as u64);
    }

    #[cfg(feature = "dtls")]
    #[tokio::test]
    async fn datagrams_go_to_the_borrower_at_their_source() {
        let (handle, _checks) = DirectHandle::new();
        let any = SocketAddr::from(([127, 0, 0, 1], 0));
        let bind = || socket::bind(any, &LinkOptions::default()).unwrap();
        let (inner, local) = bind();
        let socket = handle.wrap(inner).unwrap();
        let ((peer, peer_addr), (other, _)) = (bind(), bind());
        let is_theirs = |datagram: &[u8]| datagram[0] == 0x17;
        let borrowed = handle.borrow(peer_addr, is_theirs).unwrap();
        assert_eq!(borrowed.local_addr().unwrap(), local);
        assert!(handle.borrow(peer_addr, is_theirs).is_none(), "it is taken");
        assert!(handle.borrow("[::1]:9".parse().unwrap(), is_theirs).is_none(), "there is no IPv6");
        let send = |from: &Arc<dyn AsyncUdpSocket>, contents: &[u8]| {
            let transmit =
                Transmit { destination: local, ecn: None, contents, segment_size: None, src_ip: None };
            from.try_send(&transmit).unwrap();
        };
        send(&other, &[0x17; 40]);
        assert_eq!(receive(&socket).await, [0x17; 40], "of somebody else");
        for byte in [0x17, 0x40, 0x17, 0x41] {
            send(&peer, &[byte; 40]);
        }
        let mut quic = Vec::new();
        while quic.len() < 80 {
            quic.extend(receive(&socket).await);
        }
        assert_eq!(quic, [[0x40; 40], [0x41; 40]].concat());
        let mut theirs = receive(&borrowed).await;
        if theirs.len() < 80 {
            theirs.extend(receive(&borrowed).await);
        }
        assert_eq!(theirs, [0x17; 80]);
        // The borrower is slow.
        for _ in 0..borrowed::BATCHES_WAITING_MAX + 3 {
            send(&peer, &[0x17; 40]);
            send(&other, &[0x43; 40]);
            receive(&socket).await;
        }
        assert_eq!(handle.dtls_overflowed(), 3);
        // A rebind, after which the earlier socket keeps what it has.
        let (inner, local) = bind();
        let _socket = handle.wrap(inner).unwrap();
        let again = handle.borrow_again(peer_addr, is_theirs).unwrap();
        assert_eq!((borrowed.local_addr().unwrap(), again.local_addr().unwrap()), (local, local));
        receive(&borrowed).await;
        drop(borrowed);
        assert!(handle.borrow(peer_addr, is_theirs).is_none(), "the earlier socket freed the place");
        let mut freed = handle.freed();
        drop(again);
        assert!(freed.has_changed().unwrap());
        freed.mark_unchanged();
        let last = handle.borrow(peer_addr, is_theirs).unwrap();
        handle.give_back(peer_addr);
        assert!(freed.has_changed().unwrap() && handle.borrow(peer_addr, is_theirs).is_some());
        drop(last);
    }

    #[tokio::test]
    async fn links_of_expected_peers_come_to_the_sockets_from_which_this_node_dials() {
        let rng = &mut OsRng.unwrap_err();
        let now = UnixMillis(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis() as u64);
        let fleet = Fleet::create("lab".parse().unwrap(), now, rng).unwrap();
        let mut dialer = |name: &str| {
            let request = EnrollRequest::new(name.parse().unwrap(), now);
            let identity = Arc::new(fleet.issue(&request, rng).unwrap());
            let options =
                LinkOptions { handshake_timeout: Duration::from_millis(700), ..LinkOptions::default() };
            (identity.node_id(), Dialer::new(CredentialStore::new(identity), options, Arc::default()))
        };
        let ((arm_id, arm), (desk_id, desk), (_, other)) = (dialer("arm"), dialer("desk"), dialer("other"));
        let (mut of_arm, of_desk, of_other) = (arm.open_direct(), desk.open_direct(), other.open_direct());
        let address = |sockets: &DirectSockets| {
            SocketAddr::from(([127, 0, 0, 1], sockets.handle.ports().0.expect("there is IPv4")))
        };
        let arm_at = address(&of_arm);
        let url: LinkUrl = format!("quic://{arm_at}").parse().unwrap();
        let mut listener = of_arm.listeners.remove(0);
        // Not expected: the socket stays silent.
        tokio::select! {
            dialled = desk.dial_at(&url, vec![arm_at]) => assert!(dialled.is_err()),
            _ = listener.accept() => panic!("nobody is expected"),
        }
        of_arm.handle.expect(address(&of_desk), desk_id);
        of_arm.handle.expect(address(&of_other), desk_id);
        // A late packet of the first attempt may come before the link.
        let accepted = async {
            loop {
                if let Ok(link) = listener.accept().await.unwrap() {
                    return link;
                }
            }
        };
        let (near, far) = tokio::join!(desk.dial_at(&url, vec![arm_at]), accepted);
        let near = near.unwrap();
        assert_eq!((near.peer().node_id, far.peer().node_id), (arm_id, desk_id));
        assert_eq!((near.remote(), far.remote()), (arm_at, address(&of_desk)));
        // Another node at an address of which a peer's checks came.
        let impostor = async {
            let link = other.dial_at(&url, vec![arm_at]).await?;
            Ok::<_, crate::DialError>(link.closed().await)
        };
        let ended = tokio::select! {
            ended = impostor => ended,
            _ = listener.accept() => panic!("another node has a link"),
        };
        assert!(ended.is_ok_and(|end| matches!(end, LinkError::Closed { by_peer: true, .. })));
        // The end of the listener does not end links that this node dialled.
        listener.close(CloseReason::Goodbye).await;
        assert!(timeout(Duration::from_millis(100), far.closed()).await.is_err());
        of_arm.handle.shut(&desk_id);
        assert!(desk.dial_at(&url, vec![arm_at]).await.is_err());
    }

    #[test]
    fn only_a_whole_header_of_stun_is_a_check() {
        assert!(is_check(&check(20)) && is_check(&check(100)));
        let mut other = check(40);
        other[3] += 1;
        assert!(!is_check(&other), "of another length");
        let mut other = check(40);
        other[0] = 4;
        assert!(!is_check(&other) && !is_check(&check(20)[..19]) && !is_check(&[]));
        let mut other = check(40);
        other[7] = 0;
        assert!(!is_check(&other));
    }
}
