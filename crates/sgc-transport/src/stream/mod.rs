//! Links over one ordered stream of bytes: TLS, TCP, WebSocket.
//!
//! A task per link moves bytes between the socket and the machine that multiplexes them (`mux.rs`). Users of the link
//! call that machine and its events wake them. `endpoint.rs` and `handshake.rs` make and authenticate the stream below.

#[cfg(feature = "benchmarks")]
mod conversation;
mod driver;
mod endpoint;
#[cfg(feature = "fuzzing")]
mod exercise;
mod frame;
mod handshake;
mod mux;
mod record;
mod window;
mod wire;
mod ws;

#[cfg(feature = "benchmarks")]
pub use conversation::Conversation;
pub(crate) use endpoint::{StreamDialer, StreamListener};
#[cfg(feature = "fuzzing")]
pub use exercise::DoorExercise;
pub use frame::StreamViolation;

/// Runs two machines with arbitrary operations of their users.
#[cfg(feature = "fuzzing")]
pub fn fuzz_operations(input: &[u8]) {
    mux::model::converse(input);
}

/// Runs a machine with arbitrary input of its peer.
#[cfg(feature = "fuzzing")]
pub fn fuzz_bytes(input: &[u8]) {
    mux::model::listen(input);
}

use std::collections::BTreeMap;
use std::fmt;
use std::future::poll_fn;
use std::net::SocketAddr;
use std::pin::pin;
use std::sync::{Arc, Mutex, MutexGuard};
use std::task::{Poll, Waker};
use std::time::Instant;

use bytes::Bytes;
use sgc_sync::lock;
use sgc_trust::VerifiedPeer;
use sgc_wire::{Class, DecodeError, Label, LaneToken, Name, Packet, Slab};
use tokio::sync::{Notify, futures::Notified};

use self::frame::DATAGRAM_BYTES_MAX;
use self::mux::{Event, Limits, Mux, Read, RxId, TxId};
use self::wire::Counters;
use crate::budget::WindowLease;
use crate::error::{CloseReason, FlowEnd, FlowError, LabelError, LinkError, ProtocolError};
use crate::flow::{self, Chunks, FlowRx, FlowTx};
use crate::framing::{CONTROL_FRAME_BYTES_MAX, Pieces, control_head, datagram};
use crate::labels::Labels;
use crate::link::{KeyExchange, Link, LinkStats};
use crate::options::LinkOptions;

/// A link over one stream of bytes.
#[derive(Clone)]
pub struct StreamLink {
    handle: Arc<Handle>,
}

/// State that the users of a link and its flows share. The link lives as long as one of them does.
struct Handle {
    shared: Arc<LinkInner>,
    peer: VerifiedPeer,
    about: LinkInfo,
    labels: Arc<Labels>,
    /// Frames begun and not yet written, so that a frame goes out whole also when a sender is cancelled.
    control_tx: tokio::sync::Mutex<Chunks>,
    control_rx: tokio::sync::Mutex<Pieces>,
}

/// The constant facts of a link.
#[derive(Debug)]
struct LinkInfo {
    remote: SocketAddr,
    is_dialer: bool,
    lane: Option<LaneToken>,
    key_exchange: KeyExchange,
    mtu_bytes: u16,
}

/// State that a link's users and its task share.
struct LinkInner {
    _lease: WindowLease,
    state: Mutex<State>,
    counters: Arc<Counters>,
    incoming: Notify,
    flows: Notify,
    datagrams_rx: Notify,
    datagrams_tx: Notify,
    control_rx: Notify,
    control_tx: Notify,
    ended: Notify,
}

struct State {
    mux: Mux,
    driver: Option<Waker>,
    readers: BTreeMap<RxId, Waker>,
    writers: BTreeMap<TxId, Waker>,
    deliveries: BTreeMap<TxId, Waker>,
    /// The cause of the end, once the link is over.
    end: Option<LinkError>,
    /// The task has ended, too.
    is_drained: bool,
}

impl LinkInner {
    fn new(options: &LinkOptions, counters: Arc<Counters>) -> Arc<Self> {
        let lease = options.receive_budget.lease(options.receive_window_bytes);
        let limits = Limits {
            flow_window: lease.flow_bytes(options.flow_window_bytes).into(),
            link_window: lease.link_bytes().into(),
            flows_max: options.flows_max.into(),
            send_bytes: options.send_window_bytes.into(),
            datagram_send_bytes: options.datagram_send_bytes,
            datagram_receive_bytes: options.datagram_receive_bytes,
            keep_alive: options.keep_alive,
            idle_timeout: options.idle_timeout,
        };
        let state = State {
            mux: Mux::new(limits, Instant::now()),
            driver: None,
            readers: BTreeMap::new(),
            writers: BTreeMap::new(),
            deliveries: BTreeMap::new(),
            end: None,
            is_drained: false,
        };
        Arc::new(Self {
            _lease: lease,
            state: Mutex::new(state),
            counters,
            incoming: Notify::new(),
            flows: Notify::new(),
            datagrams_rx: Notify::new(),
            datagrams_tx: Notify::new(),
            control_rx: Notify::new(),
            control_tx: Notify::new(),
            ended: Notify::new(),
        })
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Runs an action that may give the task bytes to write.
    fn prompt<T>(&self, act: impl FnOnce(&mut State) -> T) -> T {
        let mut state = self.lock();
        let done = act(&mut state);
        let driver = state.driver.take();
        drop(state);
        if let Some(driver) = driver {
            driver.wake();
        }
        done
    }

    /// Tries again at each notification until it succeeds or the link is over.
    async fn until<T>(
        &self,
        notify: &Notify,
        mut attempt: impl FnMut(&mut State) -> Option<Result<T, LinkError>>,
    ) -> Result<T, LinkError> {
        loop {
            let mut notified = pin!(notify.notified());
            enable(notified.as_mut());
            {
                let mut state = self.lock();
                if let Some(result) = attempt(&mut state) {
                    return result;
                }
                if let Some(end) = &state.end {
                    return Err(end.clone());
                }
            }
            notified.await;
        }
    }

    /// Ends the link for its users; the first reason stays.
    fn end(&self, state: &mut State, error: LinkError) {
        if state.end.is_some() {
            return;
        }
        state.end = Some(error);
        let wakers = [&mut state.writers, &mut state.deliveries].map(std::mem::take);
        let wakers = wakers.into_iter().flat_map(BTreeMap::into_values);
        for waker in wakers.chain(std::mem::take(&mut state.readers).into_values()) {
            waker.wake();
        }
        for notify in [
            &self.incoming,
            &self.flows,
            &self.datagrams_rx,
            &self.datagrams_tx,
            &self.control_rx,
            &self.control_tx,
            &self.ended,
        ] {
            notify.notify_waiters();
        }
    }

    /// Ends the link and lets the task tell the peer why.
    fn close(&self, reason: &CloseReason, error: LinkError) {
        self.prompt(|state| {
            if state.end.is_none() {
                let (code, text) = reason.to_wire();
                state.mux.close(code.into(), Bytes::from(text));
                self.end(state, error);
            }
        });
    }

    /// Notifies waiting users of the machine's events.
    fn drain_events(&self, state: &mut State) {
        while let Some(event) = state.mux.poll_event() {
            let waker = match event {
                Event::Readable(id) => state.readers.remove(&id),
                Event::Writable(id) => state.writers.remove(&id),
                Event::Delivered(id) => state.deliveries.remove(&id),
                Event::Incoming => notify(&self.incoming),
                Event::FlowsAvailable => notify(&self.flows),
                Event::ControlReadable => notify(&self.control_rx),
                Event::ControlWritable => notify(&self.control_tx),
                Event::DatagramReadable => notify(&self.datagrams_rx),
                Event::DatagramWritable => notify(&self.datagrams_tx),
                Event::Closed { code, text } => {
                    let reason = CloseReason::from_wire(code, &text);
                    self.end(state, LinkError::Closed { by_peer: true, reason });
                    None
                }
            };
            if let Some(waker) = waker {
                waker.wake();
            }
        }
    }

    /// Waits until the link's task has ended.
    async fn drained(&self) {
        loop {
            let mut notified = pin!(self.ended.notified());
            enable(notified.as_mut());
            if self.lock().is_drained {
                return;
            }
            notified.await;
        }
    }
}

/// Registers for notifications, so that none is missed from here on.
fn enable(notified: std::pin::Pin<&mut Notified<'_>>) {
    notified.enable();
}

fn notify(notify: &Notify) -> Option<Waker> {
    notify.notify_waiters();
    None
}

impl Drop for Handle {
    fn drop(&mut self) {
        let reason = CloseReason::Goodbye;
        self.shared.close(&reason, LinkError::Closed { by_peer: false, reason: reason.clone() });
    }
}

/// The sending half of a flow. Its bytes go out whole and in order, also when a writer is cancelled.
pub(crate) struct Outlet {
    handle: Arc<Handle>,
    id: TxId,
    pending: Chunks,
}

impl Outlet {
    pub(crate) fn queue(&mut self, chunks: impl Iterator<Item = Bytes>) {
        self.pending.extend(chunks);
    }

    pub(crate) async fn flush(&mut self) -> Result<(), LinkError> {
        if self.pending.is_empty() {
            return Ok(());
        }
        let Self { handle, id, pending } = self;
        let result = poll_fn(|cx| {
            handle.shared.prompt(|state| {
                if let Some(end) = &state.end {
                    return Poll::Ready(Err(end.clone()));
                }
                match state.mux.write(*id, pending) {
                    Ok(true) => Poll::Ready(Ok(())),
                    Ok(false) => {
                        state.writers.insert(*id, cx.waker().clone());
                        Poll::Pending
                    }
                    Err(code) => Poll::Ready(Err(LinkError::FlowStopped(FlowEnd::from_wire(code)))),
                }
            })
        });
        let result = result.await;
        if result.is_err() {
            self.pending.clear();
        }
        result
    }

    pub(crate) async fn finish(&mut self) -> Result<(), LinkError> {
        self.flush().await?;
        self.handle.shared.prompt(|state| state.mux.finish(self.id));
        Ok(())
    }

    pub(crate) async fn delivered(&mut self) -> Result<(), LinkError> {
        poll_fn(|cx| {
            let mut state = self.handle.shared.lock();
            if state.mux.is_delivered(self.id) {
                return Poll::Ready(Ok(()));
            }
            if let Some(end) = &state.end {
                return Poll::Ready(Err(end.clone()));
            }
            state.deliveries.insert(self.id, cx.waker().clone());
            Poll::Pending
        })
        .await
    }

    pub(crate) fn reset(&mut self, end: FlowEnd) {
        self.pending.clear();
        self.handle.shared.prompt(|state| {
            state.mux.reset(self.id, end.to_wire().into());
            self.handle.shared.drain_events(state);
        });
    }
}

impl Drop for Outlet {
    fn drop(&mut self) {
        let is_whole = self.pending.is_empty();
        self.handle.shared.prompt(|state| {
            if is_whole {
                state.mux.finish(self.id);
            } else {
                // A regular end would make half a frame look whole.
                state.mux.reset(self.id, FlowEnd::Unwanted.to_wire().into());
            }
            state.mux.release(self.id);
            state.writers.remove(&self.id);
            state.deliveries.remove(&self.id);
            self.handle.shared.drain_events(state);
        });
    }
}

impl fmt::Debug for Outlet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Outlet").field(&self.id).finish()
    }
}

/// The receiving half of a flow.
pub(crate) struct Inlet {
    handle: Arc<Handle>,
    id: RxId,
}

impl Inlet {
    /// Waits for more of the flow and appends it. Returns `false` at the end.
    pub(crate) async fn fill(&mut self, pieces: &mut Pieces) -> Result<bool, FlowError> {
        poll_fn(|cx| {
            let mut state = self.handle.shared.lock();
            let read = state.mux.read(self.id, |piece| pieces.push(piece));
            if state.mux.has_news()
                && let Some(driver) = state.driver.take()
            {
                driver.wake();
            }
            match read {
                Read::Some => Poll::Ready(Ok(true)),
                Read::Finished => Poll::Ready(Ok(false)),
                Read::Reset(code) => Poll::Ready(Err(FlowError::Ended(FlowEnd::from_wire(code)))),
                Read::Blocked => {
                    if let Some(end) = &state.end {
                        return Poll::Ready(Err(end.clone().into()));
                    }
                    state.readers.insert(self.id, cx.waker().clone());
                    Poll::Pending
                }
            }
        })
        .await
    }

    pub(crate) fn stop(&mut self, end: FlowEnd) {
        self.handle.shared.prompt(|state| {
            state.mux.stop(self.id, end.to_wire().into());
            state.readers.remove(&self.id);
        });
    }
}

impl Drop for Inlet {
    fn drop(&mut self) {
        self.stop(FlowEnd::Unwanted);
    }
}

impl fmt::Debug for Inlet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Inlet").field(&self.id).finish()
    }
}

impl StreamLink {
    fn new(shared: Arc<LinkInner>, peer: VerifiedPeer, about: LinkInfo) -> Self {
        let handle = Handle {
            shared,
            peer,
            about,
            labels: Arc::default(),
            control_tx: tokio::sync::Mutex::default(),
            control_rx: tokio::sync::Mutex::default(),
        };
        Self { handle: Arc::new(handle) }
    }

    /// Ends the link because of the peer's mistake, unless it has ended already.
    fn fail(&self, why: ProtocolError) -> LinkError {
        let reason = CloseReason::Protocol(why.to_string());
        self.handle.shared.close(&reason, why.clone().into());
        why.into()
    }

    async fn write_control(&self, chunks: &mut Chunks) -> Result<(), LinkError> {
        if chunks.is_empty() {
            return Ok(());
        }
        let shared = &self.handle.shared;
        shared
            .until(&shared.control_tx, |state| {
                if let Some(end) = &state.end {
                    return Some(Err(end.clone()));
                }
                let is_all = state.mux.write_control(chunks);
                if let Some(driver) = state.driver.take() {
                    driver.wake();
                }
                is_all.then_some(Ok(()))
            })
            .await
    }
}

impl Link for StreamLink {
    fn peer(&self) -> &VerifiedPeer {
        &self.handle.peer
    }

    fn remote(&self) -> SocketAddr {
        self.handle.about.remote
    }

    fn is_dialer(&self) -> bool {
        self.handle.about.is_dialer
    }

    fn lane(&self) -> Option<LaneToken> {
        self.handle.about.lane
    }

    async fn send_control(&self, frame: Bytes) -> Result<(), LinkError> {
        if frame.len() > CONTROL_FRAME_BYTES_MAX {
            return Err(LinkError::FrameTooLong { bytes: frame.len() });
        }
        let mut pending = self.handle.control_tx.lock().await;
        self.write_control(&mut pending).await?;
        pending.push(control_head(frame.len()));
        pending.extend((!frame.is_empty()).then_some(frame));
        self.write_control(&mut pending).await
    }

    async fn recv_control(&self) -> Result<Bytes, LinkError> {
        let mut pieces = self.handle.control_rx.lock().await;
        let shared = &self.handle.shared;
        loop {
            if let Some(frame) = pieces.next_control().map_err(|why| self.fail(why))? {
                return Ok(frame);
            }
            shared
                .until(&shared.control_rx, |state| {
                    let is_some = state.mux.read_control(|piece| pieces.push(piece));
                    if state.mux.has_news()
                        && let Some(driver) = state.driver.take()
                    {
                        driver.wake();
                    }
                    is_some.then_some(Ok(()))
                })
                .await?;
        }
    }

    async fn open_flow(&self, class: Class) -> Result<FlowTx, LinkError> {
        let shared = &self.handle.shared;
        let opened = shared.until(&shared.flows, |state| match &state.end {
            Some(end) => Some(Err(end.clone())),
            None => state.mux.open(class).map(Ok),
        });
        let id = opened.await?;
        let handle = Arc::clone(&self.handle);
        Ok(FlowTx::new(flow::Outlet::Stream(Outlet { handle, id, pending: Vec::new() })))
    }

    async fn accept_flow(&self) -> Result<FlowRx, LinkError> {
        let Handle { shared, labels, .. } = &*self.handle;
        let id = shared.until(&shared.incoming, |state| state.mux.accept().map(Ok)).await?;
        let handle = Arc::clone(&self.handle);
        Ok(FlowRx::new(flow::Inlet::Stream(Inlet { handle, id }), Arc::clone(labels)))
    }

    fn datagram_max(&self) -> Option<usize> {
        Some(DATAGRAM_BYTES_MAX)
    }

    async fn send_datagram_as(&self, packet: &Packet, label: Option<Label>) -> Result<(), LinkError> {
        let (bytes, max) = (packet.encoded_bytes_as(label), DATAGRAM_BYTES_MAX);
        if bytes > max {
            return Err(LinkError::DatagramTooLong { bytes, max });
        }
        let (shared, datagram) = (&self.handle.shared, datagram(packet, label, &mut Slab::default()));
        shared
            .until(&shared.datagrams_tx, |state| {
                if let Some(end) = &state.end {
                    return Some(Err(end.clone()));
                }
                let is_sent = state.mux.send_datagram(&datagram);
                if let Some(driver) = state.driver.take() {
                    driver.wake();
                }
                is_sent.then_some(Ok(()))
            })
            .await
    }

    async fn recv_datagram(&self) -> Result<Result<Packet, DecodeError>, LinkError> {
        let Handle { shared, labels, .. } = &*self.handle;
        let datagram =
            shared.until(&shared.datagrams_rx, |state| state.mux.receive_datagram().map(Ok)).await?;
        Ok(Packet::from_datagram_as(datagram, |label| labels.name_of(label)))
    }

    fn define_label(&self, label: Label, name: Name) -> Result<(), LabelError> {
        self.handle.labels.define(label, name)
    }

    fn labels_defined(&self) -> u32 {
        self.handle.labels.count()
    }

    fn stats(&self) -> LinkStats {
        let Handle { shared, about, .. } = &*self.handle;
        let (sent_bytes, received_bytes) = shared.counters.read();
        let state = shared.lock();
        let (rtt, rtt_min) = state.mux.rtt();
        LinkStats {
            rtt,
            rtt_min,
            sent_bytes,
            received_bytes,
            // The kernel resends lost packets and reports none.
            sent_packets: 0,
            lost_packets: 0,
            lost_bytes: 0,
            congestion_window_bytes: state.mux.window_bytes(),
            mtu_bytes: about.mtu_bytes,
            key_exchange: about.key_exchange,
        }
    }

    fn close(&self, reason: CloseReason) {
        let error = LinkError::Closed { by_peer: false, reason: reason.clone() };
        self.handle.shared.close(&reason, error);
    }

    async fn closed(&self) -> LinkError {
        let shared = &self.handle.shared;
        match shared.until(&shared.ended, |state| state.end.clone().map(Ok)).await {
            Ok(error) | Err(error) => error,
        }
    }
}

impl fmt::Debug for StreamLink {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("StreamLink")
            .field("peer", &self.handle.peer.node_id)
            .field("about", &self.handle.about)
            .finish_non_exhaustive()
    }
}
