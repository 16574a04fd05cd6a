//! Links over DTLS that borrow the sockets of QUIC, so that routers see them come from the address that direct links
//! have. There is one borrower for each remote address: it gets the datagrams of its protocol that come from there.

use std::collections::BTreeMap;
use std::fmt;
use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};

use bytes::Bytes;
use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};
use sgc_sync::lock;
use tokio::sync::{mpsc, watch};

use super::{DirectHandle, DirectShared, FamilySocket, take_out};

/// Most borrowers.
const BORROWERS_MAX: usize = 64;
/// Most batches, each of at most 64 KiB, that wait for a borrower.
pub(super) const BATCHES_WAITING_MAX: usize = 64;

/// Returns `true` for a datagram of the borrower's protocol.
pub(crate) type IsTheirs = fn(&[u8]) -> bool;

/// The borrowers of the sockets.
#[derive(Default)]
pub(super) struct Borrowers {
    table: Mutex<Table>,
    /// Whether there is one.
    are_some: AtomicBool,
    /// Datagrams for which there was no room.
    overflowed: AtomicU64,
    /// Changes when a place becomes free.
    freed: watch::Sender<()>,
}

#[derive(Default)]
struct Table {
    places: BTreeMap<SocketAddr, Place>,
    entered: u64,
}

/// The place of a borrower.
struct Place {
    number: u64,
    is_theirs: IsTheirs,
    queue: mpsc::Sender<Batch>,
}

/// Datagrams that arrived together.
struct Batch {
    meta: RecvMeta,
    datagrams: Bytes,
}

impl Borrowers {
    pub(super) fn are_some(&self) -> bool {
        self.are_some.load(Relaxed)
    }

    pub(super) fn overflowed(&self) -> u64 {
        self.overflowed.load(Relaxed)
    }

    /// Hands over the datagrams of the borrower at their source address, and leaves the others.
    pub(super) fn take_theirs(&self, buf: &mut [u8], meta: &mut RecvMeta) {
        let (queue, is_theirs) = match lock(&self.table).places.get(&meta.addr) {
            Some(place) => (place.queue.clone(), place.is_theirs),
            None => return,
        };
        let Some(datagrams) = take_out(buf, meta, is_theirs) else { return };
        let count = datagrams.len().div_ceil(meta.stride.max(1));
        let batch = Batch { meta: RecvMeta { len: datagrams.len(), ..*meta }, datagrams };
        if queue.try_send(batch).is_err() {
            self.overflowed.fetch_add(count as u64, Relaxed);
        }
    }

    /// Takes away the place of this address, if its number is the one that is meant.
    fn leave(&self, remote: SocketAddr, is_meant: impl Fn(u64) -> bool) {
        let mut table = lock(&self.table);
        if table.places.get(&remote).is_none_or(|place| !is_meant(place.number)) {
            return;
        }
        table.places.remove(&remote);
        self.are_some.store(!table.places.is_empty(), Relaxed);
        drop(table);
        self.freed.send_replace(());
    }
}

impl DirectHandle {
    /// Borrows the socket for this remote address. Returns `None` if it has a borrower, or there is no such socket.
    pub(crate) fn borrow(&self, remote: SocketAddr, is_theirs: IsTheirs) -> Option<Arc<dyn AsyncUdpSocket>> {
        let is_free =
            |table: &Table| !table.places.contains_key(&remote) && table.places.len() < BORROWERS_MAX;
        self.enter(remote, is_theirs, is_free)
    }

    /// Returns another socket for the borrower at this remote address, after a rebind. The earlier one receives nothing
    /// more.
    pub(crate) fn borrow_again(
        &self,
        remote: SocketAddr,
        is_theirs: IsTheirs,
    ) -> Option<Arc<dyn AsyncUdpSocket>> {
        self.enter(remote, is_theirs, |table| table.places.contains_key(&remote))
    }

    fn enter(
        &self,
        remote: SocketAddr,
        is_theirs: IsTheirs,
        may_enter: impl Fn(&Table) -> bool,
    ) -> Option<Arc<dyn AsyncUdpSocket>> {
        let inner = self.shared.socket_like(&remote)?;
        let borrowers = &self.shared.borrowers;
        let mut table = lock(&borrowers.table);
        if !may_enter(&table) {
            return None;
        }
        table.entered += 1;
        let number = table.entered;
        let (queue, arriving) = mpsc::channel(BATCHES_WAITING_MAX);
        table.places.insert(remote, Place { number, is_theirs, queue });
        borrowers.are_some.store(true, Relaxed);
        let (shared, arriving) = (Arc::clone(&self.shared), Mutex::new(arriving));
        Some(Arc::new(BorrowedSocket { remote, number, inner, arriving, shared }))
    }

    /// Ends the borrowing for this remote address, though its socket may still be held.
    pub(crate) fn give_back(&self, remote: SocketAddr) {
        self.shared.borrowers.leave(remote, |_| true);
    }

    /// Tells when borrowers leave.
    pub(crate) fn freed(&self) -> watch::Receiver<()> {
        self.shared.borrowers.freed.subscribe()
    }
}

/// The socket as a borrower sees it: it sends to anybody, and receives from one address.
struct BorrowedSocket {
    remote: SocketAddr,
    number: u64,
    inner: FamilySocket,
    arriving: Mutex<mpsc::Receiver<Batch>>,
    shared: Arc<DirectShared>,
}

impl BorrowedSocket {
    fn inner(&self) -> Arc<dyn AsyncUdpSocket> {
        Arc::clone(&lock(&self.inner))
    }
}

impl Drop for BorrowedSocket {
    fn drop(&mut self) {
        self.shared.borrowers.leave(self.remote, |number| number == self.number);
    }
}

impl fmt::Debug for BorrowedSocket {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("BorrowedSocket").field("remote", &self.remote).finish_non_exhaustive()
    }
}

impl AsyncUdpSocket for BorrowedSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        self.inner().create_io_poller()
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.inner().try_send(transmit)
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let mut arriving = lock(&self.arriving);
        let mut count = 0;
        for (buf, meta) in bufs.iter_mut().zip(meta.iter_mut()) {
            // Quinn goes on to read the socket before a rebind. Its queue has an end, which quinn is not told.
            let Poll::Ready(Some(batch)) = arriving.poll_recv(cx) else { break };
            let len = batch.datagrams.len().min(buf.len());
            buf[..len].copy_from_slice(&batch.datagrams[..len]);
            *meta = RecvMeta { len, ..batch.meta };
            count += 1;
        }
        if count > 0 { Poll::Ready(Ok(count)) } else { Poll::Pending }
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner().local_addr()
    }

    fn may_fragment(&self) -> bool {
        self.inner().may_fragment()
    }

    fn max_transmit_segments(&self) -> usize {
        self.inner().max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.inner().max_receive_segments()
    }
}
