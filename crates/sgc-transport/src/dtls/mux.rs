//! All associations of one UDP socket, and the socket that quinn sees.
//!
//! Quinn sees the peers' real addresses and validates them when they change, as in any QUIC. This module only finds the
//! association of a datagram and checks that it is authentic. A dialer has a socket for each association, or the
//! datagrams from its listener at a socket that it shares, so these need no id. A listener finds established
//! associations by the id that it gave them, and the others by address.

use std::collections::{HashMap, VecDeque};
use std::fmt;
use std::future::{Future, poll_fn};
use std::io::{self, IoSliceMut};
use std::net::{IpAddr, SocketAddr};
use std::ops::Range;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll, ready};
use std::time::{Duration, Instant};

use aws_lc_rs::{constant_time, hmac, rand};
use quinn::udp::{EcnCodepoint, RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use sgc_sync::lock;
use sgc_trust::{AddressPrefix, VerifiedPeer};
use tokio::sync::{Notify, mpsc, watch};

use super::association::{Association, End, Setup, Sink, Stage};
use super::front::{self, DatagramKind, Echo, Token};
use super::paths::Paths;
use crate::credentials::CredentialStore;
use crate::error::{CloseReason, LinkError, PeerRefusal, Refusal};
use crate::handshakes::{Entry, Handshakes, Holder};
use crate::metrics::{Pending, TransportMetrics};
use crate::options::LinkOptions;

/// Most unproven handshakes from one [`AddressPrefix`] before the next has to answer a challenge.
const UNPROVEN_PER_ADDRESS_MAX: usize = 8;
/// Longest silence of a handshake that has not proven its address.
const UNPROVEN_PATIENCE: Duration = Duration::from_secs(3);
/// Shortest validity of a ticket; the longest is twice that.
const TICKET_PERIOD: Duration = Duration::from_secs(30);
/// Shortest datagram that is answered with a reset, which is shorter.
const RESET_FOR_BYTES_MIN: usize = 40;
/// Most resets a second.
const RESETS_PER_SECOND: u32 = 200;
/// Refusals that wait to be reported; more are counted and not reported.
const REPORTS_MAX: usize = 64;
/// Time that an association outlives its link, so that QUIC can repeat its last packet.
const LINGER: Duration = Duration::from_secs(1);
/// Longest and shortest time between two looks at the timers.
const TICK_MAX: Duration = Duration::from_secs(1);
const TICK_MIN: Duration = Duration::from_millis(10);

/// Number of buffers for one receive call, and the length of each: the most that the kernel joins.
const RECV_BUFFERS: usize = 4;
const RECV_BUFFER_BYTES: usize = 1 << 16;
/// Most reads of the socket before other tasks have a turn.
const RECV_ROUNDS_MAX: usize = 16;
/// Most packets of one association in one buffer for quinn.
const JOINED_MAX: usize = 8;

const RESET_DOMAIN: &[u8] = b"sgc dtls reset v1";
const TICKET_DOMAIN: &[u8] = b"sgc dtls ticket v1";

/// All associations of one socket.
pub(crate) struct Mux {
    credentials: CredentialStore,
    options: LinkOptions,
    metrics: Arc<TransportMetrics>,
    is_dialer: bool,
    born: Instant,
    ticket_key: hmac::Key,
    reset_key: hmac::Key,
    io: Mutex<Arc<dyn AsyncUdpSocket>>,
    tables: Mutex<Tables>,
    /// The places of a listener's handshakes. Locked before the state of a peer, which is locked before `tables`.
    places: Mutex<Handshakes<Slot>>,
    wake: Arc<Notify>,
    reports: mpsc::Sender<(SocketAddr, Refusal)>,
}

/// Receiver of refusals that the listener reports.
pub(crate) type RefusalReceiver = mpsc::Receiver<(SocketAddr, Refusal)>;

#[derive(Default)]
struct Tables {
    by_id: HashMap<u64, Arc<Peer>>,
    /// Associations whose handshake is not over.
    pending: HashMap<SocketAddr, Arc<Peer>>,
    /// Established associations by their peers' addresses.
    routes: HashMap<SocketAddr, Arc<Peer>>,
    resets_since: Option<Instant>,
    resets: u32,
}

/// One association and its peer's address.
pub(crate) struct Peer {
    id: u64,
    /// Set once the peer has proven that it receives at its address.
    is_proven: AtomicBool,
    state: Mutex<PeerState>,
    progress: watch::Sender<Progress>,
}

/// A handshake at a listener.
struct Slot {
    remote: SocketAddr,
    peer: Arc<Peer>,
}

impl Holder for Slot {
    fn remote(&self) -> SocketAddr {
        self.remote
    }

    fn is_pending(&self) -> bool {
        matches!(*self.peer.progress.borrow(), Progress::Connecting)
    }

    fn is_engaged(&self) -> bool {
        self.peer.is_proven.load(Relaxed)
    }
}

struct PeerState {
    association: Association,
    paths: Paths,
    src_ip: Option<IpAddr>,
    pending: Option<Pending>,
    datagrams: u32,
    touched: Instant,
    released: Option<Instant>,
}

/// Progress of an association, for its users.
#[derive(Clone)]
pub(super) enum Progress {
    Connecting,
    Up(Box<VerifiedPeer>),
    Ended(LinkError),
}

fn random<const N: usize>() -> [u8; N] {
    let mut bytes = [0; N];
    rand::fill(&mut bytes).expect("the system has random numbers, or TLS had not started either");
    bytes
}

impl Mux {
    /// Starts the associations of a listener's socket, or of a dialer's.
    pub(super) fn start(
        is_dialer: bool,
        io: Arc<dyn AsyncUdpSocket>,
        credentials: CredentialStore,
        options: LinkOptions,
        metrics: Arc<TransportMetrics>,
    ) -> io::Result<(Arc<Self>, RefusalReceiver)> {
        let port = io.local_addr()?.port();
        let (reports, receiver) = mpsc::channel(REPORTS_MAX);
        // Without a key in the identity, the next run cannot reset associations of this one and stays silent.
        let reset_key = credentials.identity().reset_key().copied().unwrap_or_else(random);
        let reset_key = hmac::Key::new(hmac::HMAC_SHA256, &reset_key);
        let derived = hmac::sign(&reset_key, &[RESET_DOMAIN, &port.to_be_bytes()].concat());
        let wake = Arc::new(Notify::new());
        let places = Mutex::new(Handshakes::new(&options));
        let mux = Arc::new(Self {
            credentials,
            options,
            metrics,
            is_dialer,
            born: Instant::now(),
            ticket_key: hmac::Key::new(hmac::HMAC_SHA256, &random::<32>()),
            reset_key: hmac::Key::new(hmac::HMAC_SHA256, derived.as_ref()),
            io: Mutex::new(io),
            tables: Mutex::default(),
            places,
            wake: Arc::clone(&wake),
            reports,
        });
        tokio::spawn(keep_time(Arc::downgrade(&mux), wake));
        Ok((mux, receiver))
    }

    /// Returns the socket for quinn.
    pub(super) fn socket(self: &Arc<Self>) -> Arc<DtlsSocket> {
        let io = Arc::clone(&lock(&self.io));
        Arc::new(DtlsSocket { mux: Arc::clone(self), io, recv: Mutex::default(), send: Arc::default() })
    }

    /// Moves to another socket and returns the one for quinn.
    pub(super) fn move_to(self: &Arc<Self>, io: Arc<dyn AsyncUdpSocket>) -> Arc<DtlsSocket> {
        *lock(&self.io) = io;
        self.socket()
    }

    /// Begins an association with this address. Returns `None` if DTLS cannot use the identity's key.
    pub(super) fn dial(&self, remote: SocketAddr) -> Option<watch::Receiver<Progress>> {
        let peer = self.open(remote, None, None, true)?;
        let mut sink = Sink::default();
        lock(&peer.state).association.start(Instant::now(), &mut sink);
        self.transmit(&sink, remote, None);
        self.wake.notify_one();
        Some(peer.progress.subscribe())
    }

    /// Takes the association at this address for a link with this node. Returns `None` if it is another node's, or
    /// taken.
    pub(crate) fn claim(self: &Arc<Self>, remote: SocketAddr, node: &VerifiedPeer) -> Option<Claim> {
        let peer = lock(&self.tables).routes.get(&remote).cloned()?;
        let is_free = {
            let mut state = lock(&peer.state);
            let is_same = state.association.peer().is_some_and(|peer| peer.node_id == node.node_id);
            is_same && state.association.claim()
        };
        is_free.then(|| Claim { mux: Arc::clone(self), peer })
    }

    /// Says goodbye to everyone.
    pub(super) fn close(&self) {
        let peers: Vec<_> = lock(&self.tables).by_id.values().cloned().collect();
        let (mut sink, now) = (Sink::default(), Instant::now());
        for peer in peers {
            sink.clear();
            let mut state = lock(&peer.state);
            state.association.close(End::Released, now, &mut sink);
            self.transmit(&sink, state.paths.present(), state.src_ip);
            self.settle(&peer, &mut state);
        }
    }

    fn open(
        &self,
        remote: SocketAddr,
        src_ip: Option<IpAddr>,
        echo: Option<Echo>,
        is_proven: bool,
    ) -> Option<Arc<Peer>> {
        let (id, now) = (u64::from_be_bytes(random()), Instant::now());
        let reset = self.reset_token(id);
        let setup = Setup {
            credentials: &self.credentials,
            options: &self.options,
            is_dialer: self.is_dialer,
            echo,
            id,
            reset,
        };
        let association = Association::new(&setup, now)?;
        let state = PeerState {
            association,
            paths: Paths::new(remote),
            src_ip,
            pending: (!self.is_dialer).then(|| self.metrics.pending()),
            datagrams: 0,
            touched: now,
            released: None,
        };
        let peer = Arc::new(Peer {
            id,
            is_proven: AtomicBool::new(is_proven),
            state: Mutex::new(state),
            progress: watch::Sender::new(Progress::Connecting),
        });
        let mut tables = lock(&self.tables);
        tables.by_id.insert(id, Arc::clone(&peer));
        tables.pending.insert(remote, Arc::clone(&peer));
        Some(peer)
    }

    fn reset_token(&self, id: u64) -> Token {
        truncated(&hmac::sign(&self.reset_key, &id.to_be_bytes()))
    }

    /// Returns the token that proves that a peer receives at this address.
    fn ticket(&self, remote: SocketAddr, now: Instant, age: u64) -> Option<Token> {
        let period = now.saturating_duration_since(self.born).as_secs() / TICKET_PERIOD.as_secs();
        let period = period.checked_sub(age)?;
        let text = [TICKET_DOMAIN, &period.to_be_bytes(), remote.to_string().as_bytes()].concat();
        Some(truncated(&hmac::sign(&self.ticket_key, &text)))
    }

    fn is_ticket(&self, token: &Token, remote: SocketAddr, now: Instant) -> bool {
        let holds = |age| {
            let ticket = self.ticket(remote, now, age);
            ticket.is_some_and(|t| constant_time::verify_slices_are_equal(&t, token).is_ok())
        };
        holds(0) || holds(1)
    }

    /// Takes one datagram and adds the packets for QUIC to `data`.
    fn receive(&self, datagram: &[u8], meta: &RecvMeta, now: Instant, sink: &mut Sink, data: &mut Ready) {
        let remote = meta.addr;
        match (front::sort(datagram), self.is_dialer) {
            (Some(DatagramKind::Plain(records)), _) => {
                self.receive_plain(records, None, meta, now, sink, data)
            }
            (Some(DatagramKind::Ticket(token, records)), false) => {
                self.receive_plain(records, Some(&token), meta, now, sink, data);
            }
            (Some(DatagramKind::Id(id, records)), false) => {
                let peer = lock(&self.tables).by_id.get(&id).cloned();
                match peer {
                    Some(peer) => {
                        self.feed(&peer, records, meta, now, sink, data);
                    }
                    None if datagram.len() >= RESET_FOR_BYTES_MIN => self.reset(id, meta, now),
                    None => {}
                }
            }
            (Some(DatagramKind::Challenge(token, echo)), true) => {
                let Some(peer) = self.pending_at(remote) else { return };
                let mut state = lock(&peer.state);
                if state.association.echo() == Some(echo) {
                    sink.clear();
                    state.association.answer_challenge(&token, sink);
                    self.transmit(sink, remote, None);
                }
            }
            (Some(DatagramKind::Busy(echo)), true) => {
                let Some(peer) = self.pending_at(remote) else { return };
                let mut state = lock(&peer.state);
                if state.association.echo() == Some(echo) {
                    state.association.end(End::ByPeer(PeerRefusal::Overloaded));
                    self.settle(&peer, &mut state);
                }
            }
            (Some(DatagramKind::Refusal(alert, echo)), _) => {
                let Some(peer) = self.pending_at(remote) else { return };
                let mut state = lock(&peer.state);
                state.association.refused_by_peer(alert, &echo);
                self.settle(&peer, &mut state);
            }
            (Some(DatagramKind::Reset(token)), true) => {
                let Some(peer) = lock(&self.tables).routes.get(&remote).cloned() else { return };
                let mut state = lock(&peer.state);
                if state.association.is_reset_by(&token) {
                    state.association.end(End::Restarted);
                    self.settle(&peer, &mut state);
                }
            }
            _ => tracing::trace!(%remote, bytes = datagram.len(), "a datagram that is none of ours"),
        }
    }

    fn pending_at(&self, remote: SocketAddr) -> Option<Arc<Peer>> {
        lock(&self.tables).pending.get(&remote).cloned()
    }

    /// Takes records without an id: from handshakes, and from peers that know no ids.
    fn receive_plain(
        &self,
        records: &[u8],
        token: Option<&Token>,
        meta: &RecvMeta,
        now: Instant,
        sink: &mut Sink,
        data: &mut Ready,
    ) {
        let remote = meta.addr;
        let is_proven = token.is_some_and(|token| self.is_ticket(token, remote, now));
        let (pending, route) = {
            let tables = lock(&self.tables);
            (tables.pending.get(&remote).cloned(), tables.routes.get(&remote).cloned())
        };
        // Anybody can send a hello in a peer's name, so it does not disturb an established association. Nor do records
        // of that association disturb a handshake from the same address.
        let peer = match (pending, route) {
            (Some(pending), Some(route)) if !front::has_plaintext(records) => {
                if self.feed(&route, records, meta, now, sink, data) {
                    return;
                }
                Some(pending)
            }
            (Some(pending), _) => Some(pending),
            (None, Some(route)) if self.is_dialer || front::client_hello(records).is_none() => Some(route),
            _ => None,
        };
        if let Some(peer) = peer {
            peer.is_proven.fetch_or(is_proven, Relaxed);
            self.feed(&peer, records, meta, now, sink, data);
            return;
        }
        let Some(echo) = front::client_hello(records).filter(|_| !self.is_dialer) else { return };
        let remote = canonical(remote);
        let (unproven, from_address) = {
            let places = lock(&self.places);
            let (mut count, mut from_address) = (0, 0);
            for (prefix, _) in places.iter().filter(|(_, slot)| !slot.is_engaged()) {
                count += 1;
                from_address += usize::from(prefix == AddressPrefix::from(remote.ip()));
            }
            (count, from_address)
        };
        if !is_proven
            && (unproven >= self.options.handshakes_unvalidated_max
                || from_address >= UNPROVEN_PER_ADDRESS_MAX)
        {
            if let Some(ticket) = self.ticket(meta.addr, now, 0) {
                self.say(&front::challenge(&ticket, &echo), meta);
            }
            return;
        }
        let Entry { is_admitted, evicted, refused } =
            lock(&self.places).make_room(remote, now, &self.metrics);
        if let Some(refused) = refused {
            // If the listener does not keep up, the counters still show the refusal.
            let _ = self.reports.try_send(refused);
        }
        if let Some(Slot { peer, .. }) = evicted {
            let mut state = lock(&peer.state);
            state.association.end(End::Released);
            self.settle(&peer, &mut state);
        }
        if !is_admitted {
            self.say(&front::busy(&echo), meta);
            return;
        }
        match self.open(meta.addr, meta.dst_ip, Some(echo), is_proven) {
            Some(peer) => {
                lock(&self.places).take(now, Slot { remote, peer: Arc::clone(&peer) });
                self.wake.notify_one();
                self.feed(&peer, records, meta, now, sink, data);
            }
            None => tracing::error!("{}", LinkError::KeyUnsupported),
        }
    }

    /// Gives an association its records. Returns whether one of them was authentic and new.
    fn feed(
        &self,
        peer: &Arc<Peer>,
        records: &[u8],
        meta: &RecvMeta,
        now: Instant,
        sink: &mut Sink,
        data: &mut Ready,
    ) -> bool {
        sink.clear();
        let mut guard = lock(&peer.state);
        let state = &mut *guard;
        state.datagrams = state.datagrams.saturating_add(1);
        state.touched = now;
        let is_authentic = state.association.receive(records, now, sink);
        if state.association.has_shown() {
            peer.is_proven.store(true, Relaxed);
        }
        let mut claim = self.settle(peer, state);
        // Quinn learns of an address once it is proven.
        let mut from = *meta;
        if is_authentic && (self.is_dialer || !matches!(state.association.stage(), Stage::Up { .. })) {
            state.src_ip = meta.dst_ip;
        } else if is_authentic {
            if state.paths.heard(meta.addr, meta.dst_ip, random, now) {
                state.src_ip = meta.dst_ip;
            } else {
                (from.addr, from.dst_ip) = (state.paths.present(), state.src_ip);
            }
            let proved = sink.proof.take().and_then(|token| state.paths.proved(&token));
            if let Some(address) = proved {
                claim = Some(address);
                if address == meta.addr {
                    state.src_ip = meta.dst_ip;
                }
            }
        }
        // Replies to handshakes and to records from a new address go to the address that they came from.
        self.transmit(sink, meta.addr, meta.dst_ip);
        data.take(sink, &from);
        self.probe(state, now, sink);
        drop(guard);
        if let Some(address) = claim {
            self.claim_address(address, peer, now, sink);
        }
        is_authentic
    }

    /// Sends the tokens that are due.
    fn probe(&self, state: &mut PeerState, now: Instant, sink: &mut Sink) {
        while let Some(sending) = state.paths.poll(now) {
            sink.clear();
            state.association.probe(sending.token, now, sink);
            self.transmit(sink, sending.address, sending.src_ip);
            self.wake.notify_one();
        }
    }

    /// Gives the address to an association whose peer has proven it, unless another association holds the address and
    /// proves it again.
    fn claim_address(&self, address: SocketAddr, peer: &Arc<Peer>, now: Instant, sink: &mut Sink) {
        let owner = {
            let mut state = lock(&peer.state);
            if !matches!(state.association.stage(), Stage::Up { .. }) {
                return;
            }
            let mut tables = lock(&self.tables);
            match tables.routes.get(&address) {
                Some(owner) if !Arc::ptr_eq(owner, peer) => {
                    state.paths.refused(address);
                    Arc::clone(owner)
                }
                _ => {
                    tables.routes.insert(address, Arc::clone(peer));
                    if tables.pending.get(&address).is_some_and(|p| Arc::ptr_eq(p, peer)) {
                        tables.pending.remove(&address);
                    }
                    if let Some(left) = state.paths.moved_to(address) {
                        tables.forget(left, peer);
                    }
                    return;
                }
            }
        };
        let mut state = lock(&owner.state);
        let src_ip = state.src_ip;
        state.paths.contested(address, src_ip, peer.id, random, now);
        self.probe(&mut state, now, sink);
    }

    /// Acts on the state of an association. Returns the address that its handshake has proven.
    fn settle(&self, peer: &Arc<Peer>, state: &mut PeerState) -> Option<SocketAddr> {
        match state.association.stage() {
            Stage::Up { peer: node, .. } if matches!(*peer.progress.borrow(), Progress::Connecting) => {
                state.pending = None;
                let node = node.clone();
                let address = state.paths.present();
                if self.is_dialer {
                    let mut tables = lock(&self.tables);
                    tables.forget(address, peer);
                    tables.routes.insert(address, Arc::clone(peer));
                }
                peer.progress.send_replace(Progress::Up(node));
                return (!self.is_dialer).then_some(address);
            }
            Stage::Ended(end) if !matches!(*peer.progress.borrow(), Progress::Ended(_)) => {
                let was_up = matches!(*peer.progress.borrow(), Progress::Up(_));
                let after = self.options.handshake_timeout;
                state.pending = None;
                {
                    let mut tables = lock(&self.tables);
                    tables.by_id.remove(&peer.id);
                    for address in state.paths.all() {
                        tables.forget(*address, peer);
                    }
                }
                // An end after no more than a hello may be nobody's. A link that existed reports its end itself.
                let is_news = match end {
                    End::TimedOut => state.datagrams > 1,
                    End::Refused(_) | End::ByPeer(_) | End::TooLong => true,
                    End::Broken(_) => !was_up,
                    End::Goodbye => state.association.is_unused(),
                    _ => false,
                };
                if !self.is_dialer && is_news {
                    let refusal = end.to_listener(after);
                    self.metrics.count_refused(refusal.kind());
                    let _ = self.reports.try_send((canonical(state.paths.present()), refusal));
                }
                let error = match end {
                    End::Goodbye | End::Released if was_up => LinkError::Closed {
                        by_peer: matches!(end, End::Goodbye),
                        reason: CloseReason::Goodbye,
                    },
                    end => end.to_dialer(after),
                };
                peer.progress.send_replace(Progress::Ended(error));
            }
            _ => {}
        }
        None
    }

    /// Runs due timers and returns the time of the next call.
    fn tick(&self, now: Instant, sink: &mut Sink) -> Instant {
        let peers: Vec<_> = lock(&self.tables).by_id.values().cloned().collect();
        let mut next = now + TICK_MAX;
        for peer in peers {
            sink.clear();
            let mut guard = lock(&peer.state);
            let state = &mut *guard;
            if state.released.is_some_and(|at| at <= now) {
                state.association.close(End::Released, now, sink);
            } else if !peer.is_proven.load(Relaxed) && now >= state.touched + UNPROVEN_PATIENCE {
                state.association.end(End::TimedOut);
            } else {
                state.association.tick(now, sink);
            }
            self.transmit(sink, state.paths.present(), state.src_ip);
            next = next.min(state.association.due());
            let claim = self.settle(&peer, state);
            let loss = state.paths.expire(now);
            self.probe(state, now, sink);
            next = next.min(state.paths.due().unwrap_or(next));
            drop(guard);
            if let Some(address) = claim {
                self.claim_address(address, &peer, now, sink);
            }
            if let Some(loss) = loss {
                let claimant = {
                    let mut tables = lock(&self.tables);
                    tables.forget(loss.address, &peer);
                    tables.by_id.get(&loss.claimant).cloned()
                };
                if let Some(claimant) = claimant {
                    self.claim_address(loss.address, &claimant, now, sink);
                }
            }
        }
        next.max(now + TICK_MIN)
    }

    /// Tells a peer that its id is unknown here, so that it does not have to wait for a time-out.
    fn reset(&self, id: u64, meta: &RecvMeta, now: Instant) {
        {
            let mut tables = lock(&self.tables);
            if tables.resets_since.is_none_or(|at| now >= at + Duration::from_secs(1)) {
                (tables.resets_since, tables.resets) = (Some(now), 0);
            }
            tables.resets += 1;
            if tables.resets > RESETS_PER_SECOND {
                return;
            }
        }
        self.say(&front::reset(&self.reset_token(id)), meta);
    }

    fn say(&self, datagram: &[u8], to: &RecvMeta) {
        let io = Arc::clone(&lock(&self.io));
        // The peer asks again for anything that was not sent.
        let _ = io.try_send(&single(datagram, to.addr, to.dst_ip));
    }

    /// Sends records that do not come from quinn. The association repeats lost ones.
    fn transmit(&self, sink: &Sink, to: SocketAddr, src_ip: Option<IpAddr>) {
        if sink.packet_lens.is_empty() {
            return;
        }
        let io = Arc::clone(&lock(&self.io));
        let mut at = 0;
        for len in &sink.packet_lens {
            let _ = io.try_send(&single(&sink.packets[at..at + len], to, src_ip));
            at += len;
        }
    }
}

impl Tables {
    /// Forgets an address, unless another association has it now.
    fn forget(&mut self, address: SocketAddr, peer: &Arc<Peer>) {
        for table in [&mut self.pending, &mut self.routes] {
            if table.get(&address).is_some_and(|p| Arc::ptr_eq(p, peer)) {
                table.remove(&address);
            }
        }
    }
}

impl fmt::Debug for Mux {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Mux").field("is_dialer", &self.is_dialer).finish_non_exhaustive()
    }
}

/// A link's hold on its association, which ends soon after the link.
pub(crate) struct Claim {
    mux: Arc<Mux>,
    peer: Arc<Peer>,
}

impl Claim {
    /// Waits for the end of the association, in case it comes before that of the link.
    pub(crate) fn ended(&self) -> impl Future<Output = LinkError> + Send + 'static {
        let mut progress = self.peer.progress.subscribe();
        async move { wait_for_end(&mut progress).await }
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        lock(&self.peer.state).released = Some(Instant::now() + LINGER);
        self.mux.wake.notify_one();
    }
}

/// Waits for the end of an association.
pub(super) async fn wait_for_end(progress: &mut watch::Receiver<Progress>) -> LinkError {
    match progress.wait_for(|p| matches!(p, Progress::Ended(_))).await.as_deref() {
        Ok(Progress::Ended(error)) => error.clone(),
        _ => LinkError::Transport("the socket is closed".into()),
    }
}

/// Waits until an association is up.
pub(super) async fn wait_until_up(
    progress: &mut watch::Receiver<Progress>,
) -> Result<Box<VerifiedPeer>, LinkError> {
    match progress.wait_for(|p| !matches!(p, Progress::Connecting)).await.as_deref() {
        Ok(Progress::Up(peer)) => Ok(peer.clone()),
        Ok(Progress::Ended(error)) => Err(error.clone()),
        _ => Err(LinkError::Transport("the socket is closed".into())),
    }
}

/// Drives the timers of a socket for as long as it is used.
async fn keep_time(mux: Weak<Mux>, wake: Arc<Notify>) {
    let mut sink = Sink::default();
    while let Some(next) = mux.upgrade().map(|mux| mux.tick(Instant::now(), &mut sink)) {
        tokio::select! {
            () = tokio::time::sleep_until(next.into()) => {}
            () = wake.notified() => {}
        }
    }
}

/// The socket that quinn uses as its UDP socket.
pub(super) struct DtlsSocket {
    mux: Arc<Mux>,
    io: Arc<dyn AsyncUdpSocket>,
    recv: Mutex<Recv>,
    send: Arc<Mutex<SendQueue>>,
}

#[derive(Default)]
struct Recv {
    storage: Vec<Vec<u8>>,
    sink: Sink,
    ready: Ready,
}

/// Packets for quinn that do not fit into what it offered.
#[derive(Default)]
struct Ready {
    bytes: Vec<u8>,
    packets: VecDeque<(RecvMeta, Range<usize>)>,
}

impl Ready {
    fn take(&mut self, sink: &Sink, meta: &RecvMeta) {
        let mut at = 0;
        for len in &sink.data_lens {
            let from = self.bytes.len();
            self.bytes.extend_from_slice(&sink.data[at..at + len]);
            self.packets.push_back((*meta, from..from + len));
            at += len;
        }
    }

    /// Fills quinn's buffers, packets of one kind together.
    fn give(&mut self, bufs: &mut [IoSliceMut<'_>], meta: &mut [RecvMeta]) -> usize {
        let mut count = 0;
        for (buf, meta) in bufs.iter_mut().zip(meta.iter_mut()) {
            // A packet longer than quinn's buffers does not belong to QUIC.
            while self.packets.front().is_some_and(|(_, range)| range.len() > buf.len()) {
                self.packets.pop_front();
            }
            let Some((first, range)) = self.packets.pop_front() else { break };
            let stride = range.len();
            buf[..stride].copy_from_slice(&self.bytes[range]);
            let mut len = stride;
            let mut joined = 1;
            while let Some((next, range)) = self.packets.front() {
                let is_alike =
                    next.addr == first.addr && next.ecn == first.ecn && next.dst_ip == first.dst_ip;
                // Only the last packet may be shorter.
                if !is_alike || range.len() > stride || len + range.len() > buf.len() || joined == JOINED_MAX
                {
                    break;
                }
                buf[len..len + range.len()].copy_from_slice(&self.bytes[range.clone()]);
                len += range.len();
                joined += 1;
                let is_last = range.len() < stride;
                self.packets.pop_front();
                if is_last {
                    break;
                }
            }
            *meta = RecvMeta { len, stride, ..first };
            count += 1;
        }
        if self.packets.is_empty() {
            self.bytes.clear();
        }
        count
    }
}

/// Sealed packets that the socket did not take yet.
#[derive(Default)]
struct SendQueue {
    sink: Sink,
    /// Number of packets that have left, and the offset of the next.
    sent: (usize, usize),
    to: Option<Heading>,
}

/// Destination and marks of packets.
#[derive(Clone, Copy)]
struct Heading {
    destination: SocketAddr,
    src_ip: Option<IpAddr>,
    ecn: Option<EcnCodepoint>,
}

impl SendQueue {
    /// Sends as many packets together as the socket can.
    fn flush(&mut self, io: &dyn AsyncUdpSocket) -> io::Result<()> {
        let Some(Heading { destination, src_ip, ecn }) = self.to else { return Ok(()) };
        let (mut index, mut at) = self.sent;
        while let Some(&size) = self.sink.packet_lens.get(index) {
            let (mut count, mut bytes) = (1, size);
            while let Some(&next) = self.sink.packet_lens.get(index + count)
                && next <= size
                && count < io.max_transmit_segments()
            {
                (count, bytes) = (count + 1, bytes + next);
                if next < size {
                    break;
                }
            }
            let segment_size = (count > 1).then_some(size);
            let contents = &self.sink.packets[at..at + bytes];
            io.try_send(&Transmit { destination, ecn, contents, segment_size, src_ip })?;
            (index, at) = (index + count, at + bytes);
            self.sent = (index, at);
        }
        self.to = None;
        Ok(())
    }
}

impl AsyncUdpSocket for DtlsSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        Arc::clone(&self.io).create_io_poller()
    }

    /// Sealed packets cannot be taken back: those that the socket does not take wait here and go before the next.
    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        let mut send = lock(&self.send);
        send.flush(&*self.io)?;
        let peer = lock(&self.mux.tables).routes.get(&transmit.destination).cloned();
        // A packet for an unknown address is lost, as if on the way.
        let Some(peer) = peer else { return Ok(()) };
        send.sink.clear();
        send.sent = (0, 0);
        // Quinn learns that its peer has moved only when a packet comes from there; the association knows it before.
        let (destination, src_ip);
        {
            let now = Instant::now();
            let mut state = lock(&peer.state);
            let size = transmit.segment_size.unwrap_or(transmit.contents.len()).max(1);
            for packet in transmit.contents.chunks(size) {
                state.association.seal(packet, now, &mut send.sink);
            }
            self.mux.settle(&peer, &mut state);
            destination = state.paths.forward(transmit.destination);
            src_ip = if destination == transmit.destination { transmit.src_ip } else { state.src_ip };
        }
        send.to = Some(Heading { destination, src_ip, ecn: transmit.ecn });
        match send.flush(&*self.io) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {
                // Quinn may have nothing more to send, and the rest would stay here.
                tokio::spawn(flush_later(Arc::clone(&self.io), Arc::clone(&self.send)));
                Ok(())
            }
            result => result,
        }
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut recv = lock(&self.recv);
        let Recv { storage, sink, ready } = &mut *recv;
        storage.resize_with(RECV_BUFFERS, || vec![0; RECV_BUFFER_BYTES]);
        for _ in 0..RECV_ROUNDS_MAX {
            let given = ready.give(bufs, meta);
            if given > 0 {
                return Poll::Ready(Ok(given));
            }
            let mut metas = [RecvMeta::default(); RECV_BUFFERS];
            let received = {
                let mut storage = storage.iter_mut();
                let mut into: [_; RECV_BUFFERS] =
                    std::array::from_fn(|_| IoSliceMut::new(storage.next().map_or(&mut [], |s| s)));
                ready!(self.io.poll_recv(cx, &mut into, &mut metas))?
            };
            let now = Instant::now();
            for (meta, buffer) in metas.iter().zip(storage.iter()).take(received) {
                for datagram in buffer[..meta.len].chunks(meta.stride.max(1)) {
                    self.mux.receive(datagram, meta, now, sink, ready);
                }
            }
        }
        // Other tasks run before the rest of a flood.
        cx.waker().wake_by_ref();
        Poll::Pending
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.io.local_addr()
    }

    fn max_transmit_segments(&self) -> usize {
        self.io.max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        JOINED_MAX
    }

    fn may_fragment(&self) -> bool {
        self.io.may_fragment()
    }
}

impl fmt::Debug for DtlsSocket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("DtlsSocket").field(&self.io).finish()
    }
}

/// Sends the rest once the socket takes more.
async fn flush_later(io: Arc<dyn AsyncUdpSocket>, send: Arc<Mutex<SendQueue>>) {
    let mut poller = Arc::clone(&io).create_io_poller();
    loop {
        if poll_fn(|cx| poller.as_mut().poll_writable(cx)).await.is_err() {
            return;
        }
        match lock(&send).flush(&*io) {
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            _ => return,
        }
    }
}

fn single(contents: &[u8], destination: SocketAddr, src_ip: Option<IpAddr>) -> Transmit<'_> {
    Transmit { destination, ecn: None, contents, segment_size: None, src_ip }
}

fn truncated(tag: &hmac::Tag) -> Token {
    let mut token = Token::default();
    token.iter_mut().zip(tag.as_ref()).for_each(|(to, from)| *to = *from);
    token
}

/// IPv4 peers of a socket for both families appear as IPv6 addresses otherwise.
fn canonical(address: SocketAddr) -> SocketAddr {
    SocketAddr::new(address.ip().to_canonical(), address.port())
}
