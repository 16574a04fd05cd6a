//! Many flows, datagrams and control frames in one ordered stream of bytes. Pure: no socket, no clock. The driver
//! brings bytes in ([`Mux::handle_input`]), fetches the bytes to write ([`Mux::poll_transmit`]) and then drains
//! [`Mux::poll_event`].
//!
//! [`Mux::poll_transmit`] hands bytes out only when the driver can write, the most urgent first and in small pieces, so
//! that an urgent packet can still overtake waiting ones. Each side buffers no more for the other than it permitted:
//! every flow, all flows together and the control stream have credits of their own, so a flow that nobody reads stops
//! itself alone. `frame.rs` defines the frames and `window.rs` the bytes in flight. This module does not look into
//! flows.

#[cfg(any(test, feature = "fuzzing"))]
pub(crate) mod model;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use sgc_wire::Class;

use super::frame::{DATAGRAM_BYTES_MAX, HEAD_BYTES_MAX, Head, StreamViolation, read_head};
use super::window::Window;

/// Longest piece of a flow in one frame. An urgent packet waits for at most one.
pub(crate) const PIECE_BYTES: usize = 4 << 10;
/// Bytes of control frames that a peer may have sent before we read them. A constant, because it is needed before any
/// setting arrives.
pub(crate) const CONTROL_WINDOW_BYTES: u64 = 2 << 20;
/// Bytes of control frames that wait to be written.
const CONTROL_PENDING_BYTES: u64 = 64 << 10;
/// Bytes of one flow that wait to be written, at least and at most; between, half a window.
const FLOW_PENDING_BYTES: (u64, u64) = (16 << 10, 256 << 10);
/// Further bytes that each class may have waiting, beyond those of the class below it.
const CLASS_BYTES: u64 = 1 << 20;
/// Memory that one datagram takes besides its bytes.
const DATAGRAM_COST_BYTES: usize = 64;
/// Shorter pieces are copied together into blocks of [`BLOCK_BYTES`]; alone, each would take more memory than it holds.
const JOINED_BYTES_MAX: usize = 1 << 10;
const BLOCK_BYTES: usize = 4 << 10;
/// Most pieces that one read takes.
const READ_PIECES: usize = 32;

/// Number of the control stream, in the place of a flow's.
const CONTROL: u64 = 0;

/// Limits of both ends of a link.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Limits {
    /// Bytes of one flow that the peer may have sent before they are read here.
    pub(crate) flow_window: u64,
    /// Bytes of all flows that the peer may have sent before they are read here.
    pub(crate) link_window: u64,
    /// Flows that the peer may have open.
    pub(crate) flows_max: u64,
    /// Bytes of all flows that wait to be written, and the most that are under way.
    pub(crate) send_bytes: u64,
    /// Bytes of datagrams that wait to be written.
    pub(crate) datagram_send_bytes: usize,
    /// Bytes of datagrams that wait to be read.
    pub(crate) datagram_receive_bytes: usize,
    /// Longest time between two pings.
    pub(crate) keep_alive: Duration,
    /// Time without input after which the link is over.
    pub(crate) idle_timeout: Duration,
}

/// A flow that this side opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct TxId(u64);

/// A flow that the peer opened.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct RxId(u64);

/// A notice that something became possible. It goes once to a caller that met the contrary before.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Event {
    /// [`Mux::read`] has bytes or an end.
    Readable(RxId),
    /// [`Mux::write`] takes more, or returns the reason why not.
    Writable(TxId),
    /// [`Mux::is_delivered`] became true.
    Delivered(TxId),
    /// The peer opened a flow.
    Incoming,
    /// The peer permits more flows.
    FlowsAvailable,
    /// Control frames came.
    ControlReadable,
    /// Control frames may be written.
    ControlWritable,
    /// Datagrams came.
    DatagramReadable,
    /// Datagrams may be written.
    DatagramWritable,
    /// The peer ended the link.
    Closed {
        /// The peer's code.
        code: u64,
        /// The peer's explanation.
        text: Bytes,
    },
}

/// Result of reading a flow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Read {
    /// Bytes were read.
    Some,
    /// No bytes yet; [`Event::Readable`] announces them.
    Blocked,
    /// The flow ended in good order.
    Finished,
    /// The sender reset the flow.
    Reset(u64),
}

/// The state machine of one end.
#[derive(Debug)]
pub(crate) struct Mux {
    limits: Limits,
    events: VecDeque<Event>,
    // Receiving.
    expect: Expect,
    /// The beginning of a frame head whose rest has not come.
    carry: Vec<u8>,
    has_settings: bool,
    rx: BTreeMap<RxId, RxFlow>,
    rx_next: u64,
    incoming: VecDeque<RxId>,
    control_rx: ControlRx,
    link_received: u64,
    link_consumed: u64,
    link_announced: u64,
    flows_permitted: u64,
    flows_announced: u64,
    datagrams_rx: VecDeque<Bytes>,
    datagrams_rx_bytes: usize,
    is_datagram_awaited: bool,
    last_received: Instant,
    // Sending.
    tx: BTreeMap<TxId, TxFlow>,
    tx_next: u64,
    by_wire: BTreeMap<u64, TxId>,
    wire_next: u64,
    /// Flows that this side opened and that have no number yet.
    unnumbered: u64,
    /// First credit of each new flow.
    flow_credit: u64,
    flows_credit: u64,
    is_flow_awaited: bool,
    ready: [VecDeque<TxId>; 3],
    starved: BTreeSet<TxId>,
    queued: u64,
    link_sent: u64,
    link_credit: u64,
    control_tx: ControlTx,
    datagrams_tx: VecDeque<Bytes>,
    datagrams_tx_bytes: usize,
    is_datagram_blocked: bool,
    is_settings_due: bool,
    pong: Option<u64>,
    resets: VecDeque<(u64, u64)>,
    news: VecDeque<RxId>,
    /// `None` at first: the first ping leaves at once, because routing asks for the link's round trip as soon as it is
    /// up.
    last_ping: Option<Instant>,
    born: Instant,
    closing: Option<(u64, Bytes)>,
    is_over: bool,
    scratch: BytesMut,
    window: Window,
}

#[derive(Debug)]
enum Expect {
    Head,
    Data { flow: u64, left: usize },
    Datagram { bytes: BytesMut, left: usize },
    Close { code: u64, bytes: BytesMut, left: usize },
}

#[derive(Debug)]
struct TxFlow {
    class: Class,
    wire: Option<u64>,
    queue: VecDeque<Bytes>,
    queued: u64,
    sent: u64,
    credit: u64,
    end: TxEnd,
    stopped: Option<u64>,
    is_done: bool,
    /// A handle to the flow exists.
    is_held: bool,
    is_ready: bool,
    is_blocked: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum TxEnd {
    Open,
    Finishing,
    Finished,
    Reset,
}

#[derive(Debug, Default)]
struct ControlTx {
    queue: VecDeque<Bytes>,
    queued: u64,
    sent: u64,
    credit: u64,
    is_blocked: bool,
}

#[derive(Debug, Default)]
struct ControlRx {
    store: Store,
    received: u64,
    consumed: u64,
    announced: u64,
    is_awaited: bool,
}

#[derive(Debug)]
struct RxFlow {
    store: Store,
    received: u64,
    consumed: u64,
    announced: u64,
    end: Option<RxEnd>,
    /// A handle to the flow exists.
    is_held: bool,
    is_awaited: bool,
    /// News for the peer; the flow stands in `Mux::news` as long as there is any.
    stop: Option<u64>,
    is_credit_due: bool,
    is_done_due: bool,
    has_news: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RxEnd {
    Finished,
    Reset(u64),
}

/// Received bytes that were not read yet.
#[derive(Debug, Default)]
struct Store {
    pieces: VecDeque<Bytes>,
    block: BytesMut,
    bytes: u64,
}

impl Store {
    /// Copies the piece: a slice would keep the whole buffer that it was read with.
    fn push(&mut self, piece: &[u8]) {
        self.bytes += piece.len() as u64;
        if piece.len() > JOINED_BYTES_MAX {
            self.cut();
            self.pieces.push_back(Bytes::copy_from_slice(piece));
            return;
        }
        self.block.extend_from_slice(piece);
        if self.block.len() >= BLOCK_BYTES {
            self.cut();
        }
    }

    fn cut(&mut self) {
        if !self.block.is_empty() {
            self.pieces.push_back(std::mem::take(&mut self.block).freeze());
        }
    }

    /// Hands some pieces to the sink and returns the number of bytes.
    fn take(&mut self, mut sink: impl FnMut(Bytes)) -> u64 {
        if self.pieces.is_empty() {
            self.cut();
        }
        let mut taken = 0;
        for _ in 0..READ_PIECES {
            let Some(piece) = self.pieces.pop_front() else { break };
            taken += piece.len() as u64;
            sink(piece);
        }
        self.bytes -= taken;
        taken
    }

    fn clear(&mut self) -> u64 {
        std::mem::take(self).bytes
    }
}

impl Mux {
    /// Returns one end of a link that begins now.
    pub(crate) fn new(limits: Limits, now: Instant) -> Self {
        Self {
            limits,
            events: VecDeque::new(),
            expect: Expect::Head,
            carry: Vec::with_capacity(HEAD_BYTES_MAX),
            has_settings: false,
            rx: BTreeMap::new(),
            rx_next: CONTROL + 1,
            incoming: VecDeque::new(),
            control_rx: ControlRx { announced: CONTROL_WINDOW_BYTES, ..ControlRx::default() },
            link_received: 0,
            link_consumed: 0,
            link_announced: limits.link_window,
            flows_permitted: limits.flows_max,
            flows_announced: limits.flows_max,
            datagrams_rx: VecDeque::new(),
            datagrams_rx_bytes: 0,
            is_datagram_awaited: false,
            last_received: now,
            tx: BTreeMap::new(),
            tx_next: 1,
            by_wire: BTreeMap::new(),
            wire_next: CONTROL + 1,
            unnumbered: 0,
            flow_credit: 0,
            flows_credit: 0,
            is_flow_awaited: false,
            ready: Default::default(),
            starved: BTreeSet::new(),
            queued: 0,
            link_sent: 0,
            link_credit: 0,
            control_tx: ControlTx { credit: CONTROL_WINDOW_BYTES, ..ControlTx::default() },
            datagrams_tx: VecDeque::new(),
            datagrams_tx_bytes: 0,
            is_datagram_blocked: false,
            is_settings_due: true,
            pong: None,
            resets: VecDeque::new(),
            news: VecDeque::new(),
            last_ping: None,
            born: now,
            closing: None,
            is_over: false,
            scratch: BytesMut::new(),
            window: Window::new(limits.send_bytes),
        }
    }

    /// Takes received bytes. After an error the caller must not call it again.
    pub(crate) fn handle_input(&mut self, now: Instant, mut bytes: &[u8]) -> Result<(), StreamViolation> {
        if !bytes.is_empty() {
            self.last_received = now;
        }
        while !bytes.is_empty() && !self.is_over {
            match &mut self.expect {
                Expect::Head => {
                    let Some(head) = self.next_head(&mut bytes)? else { return Ok(()) };
                    self.handle_head(head, now)?;
                }
                Expect::Data { flow, left } => {
                    let (piece, rest) = bytes.split_at((*left).min(bytes.len()));
                    bytes = rest;
                    *left -= piece.len();
                    let flow = *flow;
                    if *left == 0 {
                        self.expect = Expect::Head;
                    }
                    self.handle_piece(flow, piece);
                }
                Expect::Datagram { bytes: datagram, left } => {
                    let (piece, rest) = bytes.split_at((*left).min(bytes.len()));
                    bytes = rest;
                    datagram.extend_from_slice(piece);
                    *left -= piece.len();
                    if *left == 0 {
                        let datagram = std::mem::take(datagram).freeze();
                        self.expect = Expect::Head;
                        self.keep_datagram(datagram);
                    }
                }
                Expect::Close { code, bytes: text, left } => {
                    let (piece, rest) = bytes.split_at((*left).min(bytes.len()));
                    bytes = rest;
                    text.extend_from_slice(piece);
                    *left -= piece.len();
                    if *left == 0 {
                        let (code, text) = (*code, std::mem::take(text).freeze());
                        self.be_closed(code, text);
                    }
                }
            }
        }
        Ok(())
    }

    /// Returns `false` if nothing came for too long.
    pub(crate) fn handle_timeout(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.last_received) < self.limits.idle_timeout
    }

    /// Returns the time by which the caller has to call [`Mux::handle_timeout`], and [`Mux::poll_transmit`] if the wire
    /// takes bytes.
    pub(crate) fn poll_timeout(&self, can_write: bool) -> Instant {
        let idle = self.last_received + self.limits.idle_timeout;
        if !can_write {
            return idle;
        }
        idle.min(self.last_ping.map_or(self.born, |last| last + self.limits.keep_alive))
    }

    /// Returns the next event.
    pub(crate) fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// Appends up to about `budget` bytes to write now, the most urgent first, and returns their number.
    pub(crate) fn poll_transmit(&mut self, now: Instant, budget: u64, out: &mut VecDeque<Bytes>) -> u64 {
        let before = self.window.written();
        if self.is_over {
            return 0;
        }
        self.put_settings();
        if let Some((code, text)) = self.closing.take() {
            self.head(Head::Close { code, length: text.len() as u64 });
            self.body(text, out);
            self.is_over = true;
            return self.window.written() - before;
        }
        self.put_small();
        if self.last_ping.is_none_or(|last| now.saturating_duration_since(last) >= self.limits.keep_alive) {
            self.ping(now);
        }
        self.ping_if_due(now);
        let end = before + budget;
        while self.window.written() < end && self.put_control(out) {
            self.ping_if_due(now);
        }
        while self.window.written() < end && self.put_datagram(out) {
            self.ping_if_due(now);
        }
        for class in [Class::Realtime, Class::Default, Class::Bulk] {
            // Urgent bytes need not wait for the acknowledgement of less urgent ones.
            let more = class as u64 * 2 * PIECE_BYTES as u64;
            while self.window.written() < end && self.window.has_room(more) && self.put_piece(class, out) {
                self.ping_if_due(now);
            }
        }
        self.cut(out);
        self.feed_starved();
        self.window.written() - before
    }

    // Flows that this side opens.

    /// Opens a flow if the peer permits one more; otherwise [`Event::FlowsAvailable`] announces the permission.
    pub(crate) fn open(&mut self, class: Class) -> Option<TxId> {
        if self.wire_next - 1 + self.unnumbered >= self.flows_credit {
            self.is_flow_awaited = true;
            return None;
        }
        let id = TxId(self.tx_next);
        self.tx_next += 1;
        self.unnumbered += 1;
        let flow = TxFlow {
            class,
            wire: None,
            queue: VecDeque::new(),
            queued: 0,
            sent: 0,
            credit: self.flow_credit,
            end: TxEnd::Open,
            stopped: None,
            is_done: false,
            is_held: true,
            is_ready: false,
            is_blocked: false,
        };
        self.tx.insert(id, flow);
        Some(id)
    }

    /// Takes as many of these chunks as fit. Returns `true` if it took all; otherwise [`Event::Writable`] announces
    /// room. The error is the code with which the peer stopped the flow.
    pub(crate) fn write(&mut self, id: TxId, chunks: &mut Vec<Bytes>) -> Result<bool, u64> {
        let (least, most) = FLOW_PENDING_BYTES;
        let pending = (self.window.bytes() / 2).clamp(least, most);
        let Some(flow) = self.tx.get_mut(&id) else { return Ok(true) };
        if let Some(code) = flow.stopped {
            return Err(code);
        }
        if flow.end != TxEnd::Open {
            return Ok(true);
        }
        let total = self.limits.send_bytes + CLASS_BYTES * flow.class as u64;
        let room = (flow.credit - flow.sent).min(pending).saturating_sub(flow.queued);
        let shared = total.saturating_sub(self.queued);
        let taken = move_front(chunks, &mut flow.queue, room.min(shared));
        flow.queued += taken;
        self.queued += taken;
        flow.is_blocked = !chunks.is_empty();
        let is_all = chunks.is_empty();
        if !is_all && taken == shared {
            self.starved.insert(id);
        }
        if taken > 0 {
            self.schedule(id);
        }
        Ok(is_all)
    }

    /// Ends the flow after the bytes written so far.
    pub(crate) fn finish(&mut self, id: TxId) {
        if let Some(flow) = self.tx.get_mut(&id)
            && flow.end == TxEnd::Open
            && flow.stopped.is_none()
        {
            flow.end = TxEnd::Finishing;
            self.schedule(id);
        }
    }

    /// Ends the flow at once.
    pub(crate) fn reset(&mut self, id: TxId, code: u64) {
        let Some(flow) = self.tx.get_mut(&id) else { return };
        if matches!(flow.end, TxEnd::Finished | TxEnd::Reset) {
            return;
        }
        self.queued -= flow.queued;
        flow.queued = 0;
        flow.queue.clear();
        flow.end = TxEnd::Reset;
        match flow.wire {
            Some(wire) => self.resets.push_back((wire, code)),
            // The peer never heard of the flow.
            None => {
                self.unnumbered -= 1;
                self.tell_flows();
            }
        }
        self.retire_tx(id);
    }

    /// Returns `true` once the peer has all of the flow or stopped it.
    pub(crate) fn is_delivered(&self, id: TxId) -> bool {
        self.tx.get(&id).is_none_or(|f| f.is_done || f.stopped.is_some() || f.end == TxEnd::Reset)
    }

    /// Releases the flow: nobody holds it any more.
    pub(crate) fn release(&mut self, id: TxId) {
        if let Some(flow) = self.tx.get_mut(&id) {
            flow.is_held = false;
            self.retire_tx(id);
        }
    }

    // Flows that the peer opens.

    /// Returns the next flow that the peer opened.
    pub(crate) fn accept(&mut self) -> Option<RxId> {
        self.incoming.pop_front()
    }

    /// Reads some of a flow.
    pub(crate) fn read(&mut self, id: RxId, sink: impl FnMut(Bytes)) -> Read {
        let Some(flow) = self.rx.get_mut(&id) else { return Read::Finished };
        let taken = flow.store.take(sink);
        if taken > 0 {
            flow.consumed += taken;
            self.link_consumed += taken;
            let window = self.limits.flow_window;
            if flow.end.is_none() && is_credit_due(flow.consumed, flow.announced, window) {
                flow.is_credit_due = true;
                self.tell(id);
            }
            return Read::Some;
        }
        match flow.end {
            None => {
                flow.is_awaited = true;
                Read::Blocked
            }
            Some(end) => {
                flow.is_held = false;
                self.retire_rx(id);
                match end {
                    RxEnd::Finished => Read::Finished,
                    RxEnd::Reset(code) => Read::Reset(code),
                }
            }
        }
    }

    /// Gives up reading the flow. The sender learns the code unless it has ended the flow already.
    pub(crate) fn stop(&mut self, id: RxId, code: u64) {
        let Some(flow) = self.rx.get_mut(&id) else { return };
        if !flow.is_held {
            return;
        }
        flow.is_held = false;
        self.link_consumed += flow.store.clear();
        if flow.end.is_none() {
            flow.stop = Some(code);
            flow.is_credit_due = false;
            self.tell(id);
        }
        self.retire_rx(id);
    }

    // Control frames and datagrams.

    /// Takes as many control bytes as fit. Returns `true` if it took all; otherwise [`Event::ControlWritable`]
    /// announces room.
    pub(crate) fn write_control(&mut self, chunks: &mut Vec<Bytes>) -> bool {
        let control = &mut self.control_tx;
        let room = (control.credit - control.sent).min(CONTROL_PENDING_BYTES).saturating_sub(control.queued);
        control.queued += move_front(chunks, &mut control.queue, room);
        control.is_blocked = !chunks.is_empty();
        chunks.is_empty()
    }

    /// Reads some of the control stream. Returns `false` if there is nothing; [`Event::ControlReadable`] announces
    /// more.
    pub(crate) fn read_control(&mut self, sink: impl FnMut(Bytes)) -> bool {
        let taken = self.control_rx.store.take(sink);
        self.control_rx.consumed += taken;
        self.control_rx.is_awaited = taken == 0;
        taken > 0
    }

    /// Takes a datagram of at most [`DATAGRAM_BYTES_MAX`]. Returns `false` if too many wait;
    /// [`Event::DatagramWritable`] announces room.
    pub(crate) fn send_datagram(&mut self, datagram: &Bytes) -> bool {
        let cost = datagram.len() + DATAGRAM_COST_BYTES;
        let fits = self.datagrams_tx_bytes + cost <= self.limits.datagram_send_bytes;
        if !fits && !self.datagrams_tx.is_empty() {
            self.is_datagram_blocked = true;
            return false;
        }
        debug_assert!((1..=DATAGRAM_BYTES_MAX).contains(&datagram.len()), "callers check the length first");
        self.datagrams_tx_bytes += cost;
        self.datagrams_tx.push_back(datagram.clone());
        true
    }

    /// Returns the next datagram; if there is none, [`Event::DatagramReadable`] announces one.
    pub(crate) fn receive_datagram(&mut self) -> Option<Bytes> {
        let datagram = self.datagrams_rx.pop_front();
        self.is_datagram_awaited = datagram.is_none();
        self.datagrams_rx_bytes -= datagram.as_ref().map_or(0, |d| d.len() + DATAGRAM_COST_BYTES);
        datagram
    }

    /// Ends the link and drops everything that waits. The next transmission tells the peer; none follows it.
    pub(crate) fn close(&mut self, code: u64, text: Bytes) {
        if self.closing.is_none() && !self.is_over {
            self.closing = Some((code, text));
            self.drop_queues();
        }
    }

    /// Returns `true` if a transmission would carry news of read data: credit, ended flows, or room for flows.
    pub(crate) fn has_news(&self) -> bool {
        let Limits { link_window, flows_max, .. } = self.limits;
        !self.news.is_empty()
            || is_credit_due(self.control_rx.consumed, self.control_rx.announced, CONTROL_WINDOW_BYTES)
            || is_credit_due(self.link_consumed, self.link_announced, link_window)
            || self.flows_permitted - self.flows_announced >= (flows_max / 4).max(1)
    }

    /// Returns `true` once nothing is left to send.
    pub(crate) fn is_over(&self) -> bool {
        self.is_over
    }

    /// Returns the smoothed and the shortest round trip.
    pub(crate) fn rtt(&self) -> (Duration, Duration) {
        self.window.rtt()
    }

    /// Returns the time of the oldest ping without an answer.
    pub(crate) fn waits_since(&self) -> Option<Instant> {
        self.window.waits_since()
    }

    /// Notes the handshake's round trip, which counts until one is measured.
    pub(crate) fn note_handshake(&mut self, rtt: Duration) {
        self.window.note_handshake(rtt);
    }

    /// Returns the number of bytes that may be in flight.
    pub(crate) fn window_bytes(&self) -> u64 {
        self.window.bytes()
    }

    /// Returns the number of bytes to write together.
    pub(crate) fn bytes_together(&self) -> u64 {
        self.window.together()
    }

    // Receiving.

    fn next_head(&mut self, bytes: &mut &[u8]) -> Result<Option<Head>, StreamViolation> {
        if self.carry.is_empty() {
            if let Some((head, used)) = read_head(bytes)? {
                *bytes = &bytes[used..];
                return Ok(Some(head));
            }
            self.carry.extend_from_slice(bytes);
            *bytes = &[];
            return Ok(None);
        }
        while let Some((first, rest)) = bytes.split_first() {
            self.carry.push(*first);
            *bytes = rest;
            if let Some((head, _)) = read_head(&self.carry)? {
                self.carry.clear();
                return Ok(Some(head));
            }
        }
        Ok(None)
    }

    fn handle_head(&mut self, head: Head, now: Instant) -> Result<(), StreamViolation> {
        if self.has_settings == matches!(head, Head::Settings { .. }) {
            return Err(StreamViolation::Settings);
        }
        match head {
            Head::Settings { flow_credit, link_credit, flows } => {
                self.has_settings = true;
                self.flow_credit = flow_credit;
                self.link_credit = link_credit;
                self.flows_credit = flows;
                self.tell_flows();
            }
            Head::Data { flow, length } => {
                self.permit(flow, length)?;
                self.expect = Expect::Data { flow, left: length as usize };
            }
            Head::Finish { flow } => self.end_rx(flow, RxEnd::Finished)?,
            Head::Reset { flow, code } => self.end_rx(flow, RxEnd::Reset(code))?,
            Head::Stop { flow, code } => self.be_stopped(flow, code)?,
            Head::Credit { flow: CONTROL, bytes } => {
                let control = &mut self.control_tx;
                control.credit = control.credit.max(bytes);
                if std::mem::take(&mut control.is_blocked) {
                    self.events.push_back(Event::ControlWritable);
                }
            }
            Head::Credit { flow, bytes } => {
                if let Some(id) = self.own(flow)?
                    && let Some(flow) = self.tx.get_mut(&id)
                {
                    flow.credit = flow.credit.max(bytes);
                    self.unblock(id);
                }
            }
            Head::LinkCredit { bytes } => self.link_credit = self.link_credit.max(bytes),
            Head::Flows { count } => {
                self.flows_credit = self.flows_credit.max(count);
                self.tell_flows();
            }
            Head::Done { flow } => {
                if let Some(id) = self.own(flow)?
                    && let Some(tx) = self.tx.get_mut(&id)
                {
                    if tx.end != TxEnd::Finished {
                        return Err(StreamViolation::Flow(flow));
                    }
                    tx.is_done = true;
                    self.events.push_back(Event::Delivered(id));
                    self.retire_tx(id);
                }
            }
            Head::Datagram { length } => {
                let (bytes, left) = (BytesMut::with_capacity(length as usize), length as usize);
                self.expect = Expect::Datagram { bytes, left };
            }
            // One answer stands for all questions before it, so a flood of pings costs one answer.
            Head::Ping { number } => self.pong = Some(number),
            Head::Pong { number } => {
                if !self.window.on_pong(number, now) {
                    return Err(StreamViolation::Pong);
                }
            }
            Head::Close { code, length: 0 } => self.be_closed(code, Bytes::new()),
            Head::Close { code, length } => {
                self.expect = Expect::Close { code, bytes: BytesMut::new(), left: length as usize };
            }
        }
        Ok(())
    }

    /// Judges whether the peer may send these bytes, before they come, and opens the flow if they are its first.
    fn permit(&mut self, wire: u64, length: u64) -> Result<(), StreamViolation> {
        if wire == CONTROL {
            let control = &mut self.control_rx;
            control.received += length;
            return if control.received > control.announced {
                Err(StreamViolation::Credit(wire))
            } else {
                Ok(())
            };
        }
        let flow = self.theirs(wire)?;
        flow.received += length;
        let is_over = flow.received > flow.announced;
        self.link_received += length;
        if is_over || self.link_received > self.link_announced {
            return Err(StreamViolation::Credit(wire));
        }
        Ok(())
    }

    fn handle_piece(&mut self, wire: u64, piece: &[u8]) {
        if wire == CONTROL {
            self.control_rx.store.push(piece);
            if std::mem::take(&mut self.control_rx.is_awaited) {
                self.events.push_back(Event::ControlReadable);
            }
            return;
        }
        let id = RxId(wire);
        let Some(flow) = self.rx.get_mut(&id) else { return };
        if !flow.is_held {
            self.link_consumed += piece.len() as u64;
            return;
        }
        flow.store.push(piece);
        if std::mem::take(&mut flow.is_awaited) {
            self.events.push_back(Event::Readable(id));
        }
    }

    /// Returns a flow of the peer that is open, or opens the next one.
    fn theirs(&mut self, wire: u64) -> Result<&mut RxFlow, StreamViolation> {
        let id = RxId(wire);
        if wire == self.rx_next {
            if wire > self.flows_announced {
                return Err(StreamViolation::TooManyFlows(wire));
            }
            self.rx_next += 1;
            let flow = RxFlow {
                store: Store::default(),
                received: 0,
                consumed: 0,
                announced: self.limits.flow_window,
                end: None,
                is_held: true,
                is_awaited: false,
                stop: None,
                is_credit_due: false,
                is_done_due: false,
                has_news: false,
            };
            self.rx.insert(id, flow);
            self.incoming.push_back(id);
            self.events.push_back(Event::Incoming);
        }
        match self.rx.get_mut(&id) {
            Some(flow) if flow.end.is_none() => Ok(flow),
            _ => Err(StreamViolation::Flow(wire)),
        }
    }

    /// Returns a flow of ours, or nothing if it is over.
    fn own(&self, wire: u64) -> Result<Option<TxId>, StreamViolation> {
        if wire == CONTROL || wire >= self.wire_next {
            return Err(StreamViolation::Flow(wire));
        }
        Ok(self.by_wire.get(&wire).copied())
    }

    fn end_rx(&mut self, wire: u64, end: RxEnd) -> Result<(), StreamViolation> {
        if wire == CONTROL {
            return Err(StreamViolation::Flow(wire));
        }
        let flow = self.theirs(wire)?;
        flow.end = Some(end);
        flow.is_credit_due = false;
        flow.is_done_due = end == RxEnd::Finished;
        let is_awaited = std::mem::take(&mut flow.is_awaited);
        let dropped = if end == RxEnd::Finished { 0 } else { flow.store.clear() };
        self.link_consumed += dropped;
        let id = RxId(wire);
        if is_awaited {
            self.events.push_back(Event::Readable(id));
        }
        if end == RxEnd::Finished {
            self.tell(id);
        }
        self.retire_rx(id);
        Ok(())
    }

    fn be_stopped(&mut self, wire: u64, code: u64) -> Result<(), StreamViolation> {
        let Some(id) = self.own(wire)? else { return Ok(()) };
        let Some(flow) = self.tx.get_mut(&id) else { return Ok(()) };
        if flow.stopped.is_some() || flow.end == TxEnd::Reset {
            return Ok(());
        }
        flow.stopped = Some(code);
        self.queued -= flow.queued;
        flow.queued = 0;
        flow.queue.clear();
        if flow.end != TxEnd::Finished {
            flow.end = TxEnd::Reset;
            self.resets.push_back((wire, code));
        }
        self.events.push_back(Event::Delivered(id));
        self.unblock(id);
        self.retire_tx(id);
        Ok(())
    }

    fn keep_datagram(&mut self, datagram: Bytes) {
        self.datagrams_rx_bytes += datagram.len() + DATAGRAM_COST_BYTES;
        self.datagrams_rx.push_back(datagram);
        while self.datagrams_rx_bytes > self.limits.datagram_receive_bytes && self.datagrams_rx.len() > 1 {
            let Some(oldest) = self.datagrams_rx.pop_front() else { break };
            self.datagrams_rx_bytes -= oldest.len() + DATAGRAM_COST_BYTES;
        }
        if std::mem::take(&mut self.is_datagram_awaited) {
            self.events.push_back(Event::DatagramReadable);
        }
    }

    fn be_closed(&mut self, code: u64, text: Bytes) {
        self.is_over = true;
        self.drop_queues();
        self.events.push_back(Event::Closed { code, text });
    }

    /// Queues a flow that has news for the peer.
    fn tell(&mut self, id: RxId) {
        if let Some(flow) = self.rx.get_mut(&id)
            && !std::mem::replace(&mut flow.has_news, true)
        {
            self.news.push_back(id);
        }
    }

    /// Forgets a flow of the peer that is over, read and acknowledged; the peer may open another.
    fn retire_rx(&mut self, id: RxId) {
        if self.rx.get(&id).is_some_and(|f| f.end.is_some() && !f.is_held && !f.has_news) {
            self.rx.remove(&id);
            self.flows_permitted += 1;
        }
    }

    // Sending.

    fn retire_tx(&mut self, id: TxId) {
        let Some(flow) = self.tx.get(&id) else { return };
        let is_over = flow.end == TxEnd::Reset
            || (flow.end == TxEnd::Finished && (flow.is_done || flow.stopped.is_some()));
        if !is_over {
            return;
        }
        if let Some(wire) = flow.wire {
            self.by_wire.remove(&wire);
        }
        if !flow.is_held {
            self.tx.remove(&id);
            self.starved.remove(&id);
        }
    }

    fn unblock(&mut self, id: TxId) {
        if let Some(flow) = self.tx.get_mut(&id)
            && std::mem::take(&mut flow.is_blocked)
        {
            self.starved.remove(&id);
            self.events.push_back(Event::Writable(id));
        }
    }

    /// Wakes flows that found no room among all flows, as far as there is room now.
    fn feed_starved(&mut self) {
        if self.starved.is_empty() || self.queued + PIECE_BYTES as u64 > self.limits.send_bytes {
            return;
        }
        for id in std::mem::take(&mut self.starved) {
            self.unblock(id);
        }
    }

    fn tell_flows(&mut self) {
        if self.wire_next - 1 + self.unnumbered < self.flows_credit
            && std::mem::take(&mut self.is_flow_awaited)
        {
            self.events.push_back(Event::FlowsAvailable);
        }
    }

    fn schedule(&mut self, id: TxId) {
        if let Some(flow) = self.tx.get_mut(&id)
            && !std::mem::replace(&mut flow.is_ready, true)
        {
            self.ready[flow.class as usize].push_back(id);
        }
    }

    fn put_settings(&mut self) {
        if std::mem::take(&mut self.is_settings_due) {
            let Limits { flow_window, link_window, flows_max, .. } = self.limits;
            self.head(Head::Settings {
                flow_credit: flow_window,
                link_credit: link_window,
                flows: flows_max,
            });
        }
    }

    /// Writes everything else that fits one head: answers, and news of flows.
    fn put_small(&mut self) {
        if let Some(number) = self.pong.take() {
            self.head(Head::Pong { number });
        }
        while let Some((flow, code)) = self.resets.pop_front() {
            self.head(Head::Reset { flow, code });
        }
        while let Some(id) = self.news.pop_front() {
            self.put_news(id);
        }
        let control = &mut self.control_rx;
        if is_credit_due(control.consumed, control.announced, CONTROL_WINDOW_BYTES) {
            control.announced = control.consumed + CONTROL_WINDOW_BYTES;
            let bytes = control.announced;
            self.head(Head::Credit { flow: CONTROL, bytes });
        }
        let window = self.limits.link_window;
        if is_credit_due(self.link_consumed, self.link_announced, window) {
            self.link_announced = self.link_consumed + window;
            self.head(Head::LinkCredit { bytes: self.link_announced });
        }
        if self.flows_permitted - self.flows_announced >= (self.limits.flows_max / 4).max(1) {
            self.flows_announced = self.flows_permitted;
            self.head(Head::Flows { count: self.flows_announced });
        }
    }

    fn put_news(&mut self, id: RxId) {
        let Some(flow) = self.rx.get_mut(&id) else { return };
        flow.has_news = false;
        let (done, stop) = (std::mem::take(&mut flow.is_done_due), flow.stop.take());
        let credit = std::mem::take(&mut flow.is_credit_due).then(|| {
            flow.announced = flow.consumed + self.limits.flow_window;
            flow.announced
        });
        let is_open = flow.end.is_none();
        if done {
            self.head(Head::Done { flow: id.0 });
        }
        if let Some(code) = stop.filter(|_| is_open) {
            self.head(Head::Stop { flow: id.0, code });
        }
        if let Some(bytes) = credit {
            self.head(Head::Credit { flow: id.0, bytes });
        }
        self.retire_rx(id);
    }

    fn put_control(&mut self, out: &mut VecDeque<Bytes>) -> bool {
        let length = self.control_tx.queued.min(PIECE_BYTES as u64);
        if length == 0 {
            return false;
        }
        self.head(Head::Data { flow: CONTROL, length });
        self.cut(out);
        let control = &mut self.control_tx;
        pop_front(&mut control.queue, length, out);
        control.queued -= length;
        control.sent += length;
        self.window.on_written(length);
        if control.queued * 2 <= CONTROL_PENDING_BYTES && std::mem::take(&mut control.is_blocked) {
            self.events.push_back(Event::ControlWritable);
        }
        true
    }

    fn put_datagram(&mut self, out: &mut VecDeque<Bytes>) -> bool {
        let Some(datagram) = self.datagrams_tx.pop_front() else { return false };
        self.datagrams_tx_bytes -= datagram.len() + DATAGRAM_COST_BYTES;
        self.head(Head::Datagram { length: datagram.len() as u64 });
        self.body(datagram, out);
        if std::mem::take(&mut self.is_datagram_blocked) {
            self.events.push_back(Event::DatagramWritable);
        }
        true
    }

    /// Writes one piece of the next flow of this class and moves that flow behind the others of its class.
    fn put_piece(&mut self, class: Class, out: &mut VecDeque<Bytes>) -> bool {
        let link = self.link_credit.saturating_sub(self.link_sent);
        let Some(id) = self.ready[class as usize].pop_front() else { return false };
        let Some(flow) = self.tx.get_mut(&id) else { return true };
        let length = flow.queued.min(PIECE_BYTES as u64).min(link);
        if length == 0 && flow.queued > 0 {
            self.ready[class as usize].push_front(id);
            return false;
        }
        flow.is_ready = false;
        let is_finish = flow.end == TxEnd::Finishing && length == flow.queued;
        if length == 0 && !is_finish {
            return true;
        }
        let wire = match flow.wire {
            Some(wire) => wire,
            None => {
                let wire = self.wire_next;
                self.wire_next += 1;
                self.unnumbered -= 1;
                flow.wire = Some(wire);
                self.by_wire.insert(wire, id);
                wire
            }
        };
        flow.queued -= length;
        flow.sent += length;
        self.queued -= length;
        self.link_sent += length;
        if is_finish {
            flow.end = TxEnd::Finished;
        }
        let (least, _) = FLOW_PENDING_BYTES;
        let is_low = flow.queued * 2 <= least.max(self.window.bytes() / 2);
        let has_more = flow.queued > 0;
        if length > 0 {
            self.head(Head::Data { flow: wire, length });
            self.cut(out);
            if let Some(flow) = self.tx.get_mut(&id) {
                pop_front(&mut flow.queue, length, out);
            }
            self.window.on_written(length);
        }
        if is_finish {
            self.head(Head::Finish { flow: wire });
        }
        if has_more {
            self.schedule(id);
        }
        if is_low && !self.starved.contains(&id) {
            self.unblock(id);
        }
        true
    }

    fn ping_if_due(&mut self, now: Instant) {
        if self.window.is_ping_due() {
            self.ping(now);
        }
    }

    fn ping(&mut self, now: Instant) {
        self.last_ping = Some(now);
        if let Some(number) = self.window.ping(now) {
            self.head(Head::Ping { number });
        }
    }

    fn head(&mut self, head: Head) {
        let before = self.scratch.len();
        self.scratch.reserve(HEAD_BYTES_MAX);
        head.write(&mut self.scratch);
        self.window.on_written((self.scratch.len() - before) as u64);
    }

    fn body(&mut self, body: Bytes, out: &mut VecDeque<Bytes>) {
        self.cut(out);
        self.window.on_written(body.len() as u64);
        if !body.is_empty() {
            out.push_back(body);
        }
    }

    fn cut(&mut self, out: &mut VecDeque<Bytes>) {
        if !self.scratch.is_empty() {
            out.push_back(self.scratch.split().freeze());
        }
    }

    fn drop_queues(&mut self) {
        for flow in self.tx.values_mut() {
            flow.queue.clear();
            flow.queued = 0;
        }
        self.queued = 0;
        self.control_tx = ControlTx::default();
        self.datagrams_tx.clear();
        self.datagrams_tx_bytes = 0;
    }
}

/// Returns `true` once a quarter of a window was read since the last announcement.
fn is_credit_due(consumed: u64, announced: u64, window: u64) -> bool {
    consumed + window - announced >= (window / 4).max(1)
}

/// Moves up to `most` bytes from the front of one to the back of the other and returns their number.
fn move_front(from: &mut Vec<Bytes>, to: &mut VecDeque<Bytes>, most: u64) -> u64 {
    let (mut left, mut whole) = (most, 0);
    for chunk in from.iter_mut() {
        let length = chunk.len() as u64;
        if length > left {
            if left > 0 {
                to.push_back(chunk.split_to(left as usize));
                left = 0;
            }
            break;
        }
        whole += 1;
        left -= length;
        if length > 0 {
            to.push_back(std::mem::take(chunk));
        }
    }
    from.drain(..whole);
    most - left
}

/// Moves exactly `length` bytes, which must be there, from the front of one to the back of the other.
fn pop_front(from: &mut VecDeque<Bytes>, mut length: u64, to: &mut VecDeque<Bytes>) {
    while length > 0 {
        let Some(mut chunk) = from.pop_front() else { break };
        if chunk.len() as u64 > length {
            let rest = chunk.split_off(length as usize);
            from.push_front(rest);
        }
        length -= chunk.len() as u64;
        to.push_back(chunk);
    }
}
