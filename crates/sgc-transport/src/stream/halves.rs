//! The state that users of a link over a stream share with its task, and the halves of the flows.

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
use sgc_wire::LaneToken;
use tokio::sync::{Notify, futures::Notified};

use super::mux::{Event, Limits, Mux, Read, RxId, TxId};
use super::wire::Counters;
use crate::budget::WindowLease;
use crate::error::{CloseReason, FlowEnd, FlowError, LinkError};
use crate::framing::{Chunks, Pieces};
use crate::labels::Labels;
use crate::options::LinkOptions;
use crate::stats::KeyExchange;

/// State that the users of a link and its flows share. The link lives as long as one of them does.
pub(super) struct Handle {
    pub(super) shared: Arc<LinkInner>,
    pub(super) peer: VerifiedPeer,
    pub(super) about: LinkInfo,
    pub(super) labels: Arc<Labels>,
    /// Frames begun and not yet written, so that a frame goes out whole also when a sender is cancelled.
    pub(super) control_tx: tokio::sync::Mutex<Chunks>,
    pub(super) control_rx: tokio::sync::Mutex<Pieces>,
}

/// The constant facts of a link.
#[derive(Debug)]
pub(super) struct LinkInfo {
    pub(super) remote: SocketAddr,
    pub(super) is_dialer: bool,
    pub(super) lane: Option<LaneToken>,
    pub(super) key_exchange: KeyExchange,
    pub(super) mtu_bytes: u16,
}

/// State that a link's users and its task share.
pub(super) struct LinkInner {
    _lease: WindowLease,
    pub(super) state: Mutex<State>,
    pub(super) counters: Arc<Counters>,
    pub(super) incoming: Notify,
    pub(super) flows: Notify,
    pub(super) datagrams_rx: Notify,
    pub(super) datagrams_tx: Notify,
    pub(super) control_rx: Notify,
    pub(super) control_tx: Notify,
    pub(super) ended: Notify,
}

pub(super) struct State {
    pub(super) mux: Mux,
    pub(super) driver: Option<Waker>,
    pub(super) readers: BTreeMap<RxId, Waker>,
    pub(super) writers: BTreeMap<TxId, Waker>,
    pub(super) deliveries: BTreeMap<TxId, Waker>,
    /// The cause of the end, once the link is over.
    pub(super) end: Option<LinkError>,
    /// The task has ended, too.
    pub(super) is_drained: bool,
}

impl LinkInner {
    pub(super) fn new(options: &LinkOptions, counters: Arc<Counters>) -> Arc<Self> {
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

    pub(super) fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }

    /// Runs an action that may give the task bytes to write.
    pub(super) fn prompt<T>(&self, act: impl FnOnce(&mut State) -> T) -> T {
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
    pub(super) async fn until<T>(
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
    pub(super) fn end(&self, state: &mut State, error: LinkError) {
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
    pub(super) fn close(&self, reason: &CloseReason, error: LinkError) {
        self.prompt(|state| {
            if state.end.is_none() {
                let (code, text) = reason.to_wire();
                state.mux.close(code.into(), Bytes::from(text));
                self.end(state, error);
            }
        });
    }

    /// Notifies waiting users of the machine's events.
    pub(super) fn drain_events(&self, state: &mut State) {
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
    pub(super) async fn drained(&self) {
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
    pub(super) handle: Arc<Handle>,
    pub(super) id: TxId,
    pub(super) pending: Chunks,
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
    pub(super) handle: Arc<Handle>,
    pub(super) id: RxId,
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
