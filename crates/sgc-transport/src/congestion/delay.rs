//! The controller that keeps the queue short. It aims at a standing queue of [`QUEUE_AIM`], judged once a round trip by
//! the delay of acknowledgements beyond the shortest round trip.
//!
//! Loss says little here: radio loses at random, so only heavy loss, beyond the path's usual loss, slows the controller
//! down. It shares a queue with others of its kind; beside one that fills every queue it asks for its share.

use std::any::Any;
use std::sync::Arc;
use std::time::{Duration, Instant};

use quinn::congestion::{Controller, ControllerMetrics};
use quinn_proto::RttEstimator;

use super::gate::Limits;
use super::{Gate, InFlight, into_any};

/// Time that a packet should stand in queues.
const QUEUE_AIM: Duration = Duration::from_millis(10);
/// Smallest window, packets.
const WINDOW_PACKETS_MIN: u64 = 2;
/// First window, packets (RFC 9002, 7.2).
const WINDOW_PACKETS_INITIAL: u64 = 10;
/// Largest window: it has to fit into the connection's buffers.
const WINDOW_BYTES_MAX: u64 = 32 << 20;
/// Part of the window, and least number of packets, that urgent data may have beyond the window.
const URGENT_PART: u64 = 4;
const URGENT_PACKETS_MIN: u64 = 4;
/// Time on the wire of data that is let in together: urgent data may come just behind it.
const PIECE_SPAN: Duration = Duration::from_millis(2);
/// Time for which a round trip counts as the shortest.
const BASE_AGE_MAX: Duration = Duration::from_secs(10);
/// Time between two drains of the queue, which show the shortest round trip. A late sender took others' queue for the
/// path.
const DRAIN_INTERVAL: Duration = Duration::from_secs(5);
/// Part of the path's own capacity that stays in flight during a drain.
const DRAIN_PART: f64 = 0.75;
/// Jitter between rounds that still lets the queue be seen. The aim grows by a multiple of further jitter, up to a
/// bound.
const JITTER_FREE: Duration = Duration::from_millis(5);
const JITTER_TIMES: u32 = 4;
const JITTER_AIM_MAX: Duration = Duration::from_millis(24);
/// The shortest time over which the standing queue is judged.
const STANDING_SPAN_MIN: Duration = Duration::from_millis(4);
/// Part of the excess over the aim that a round takes away, and of the shortfall that it adds.
const CUT_GAIN: f64 = 0.7;
const GROW_GAIN: f64 = 0.5;
/// Largest growth in a round.
const GROW_MAX: f64 = 0.5;
/// After so many rounds without a queue, each round adds this part: the path has become wider.
const QUIET_ROUNDS: u32 = 3;
const QUIET_GROW: f64 = 0.25;
/// The smallest part of the window that a cut leaves.
const CUT_MAX: f64 = 0.5;
/// After so many cuts in a row, a half together, the queue must have become shorter.
const CUTS_IN_VAIN: u32 = 4;
/// A queue that grew this many times during cuts is another one, and counting begins anew.
const NEW_QUEUE_TIMES: u32 = 4;
/// Loss that shows congestion: this part of the packets of two rounds, beyond the usual loss.
const LOSS_HEAVY: f64 = 0.03;
/// Fewest lost packets of which a part is computed.
const LOST_PACKETS_MIN: u64 = 3;
/// Bounds of the part of the window that a cut for loss leaves. Between them it leaves the bytes that arrive in a round
/// trip without queue.
const LOSS_CUT_MIN: f64 = 0.4;
const LOSS_CUT_MAX: f64 = 0.85;
/// If this part of the loss remains after a cut, the window did not cause it.
const LOSS_STAYS: f64 = 0.75;
/// Rounds after a cut that are not judged, because they show the time before it, and rounds that are.
const TRIAL_ROUNDS: u32 = 4;
/// Highest loss that counts as usual.
const LOSS_FLOOR_MAX: f64 = 0.12;

/// Shortest round trip of a sliding span of time.
#[derive(Clone, Copy, Debug)]
struct Floor {
    span: Duration,
    began: Instant,
    now: Option<Duration>,
    before: Option<Duration>,
}

impl Floor {
    fn new(span: Duration, now: Instant) -> Self {
        Self { span, began: now, now: None, before: None }
    }

    fn add(&mut self, now: Instant, rtt: Duration) {
        let age = now.saturating_duration_since(self.began);
        if age >= self.span {
            self.before = if age < 2 * self.span { self.now } else { None };
            self.now = None;
            self.began = now;
        }
        self.now = Some(self.now.map_or(rtt, |r| r.min(rtt)));
    }

    fn get(&self) -> Option<Duration> {
        self.now.into_iter().chain(self.before).min()
    }
}

/// Counters since a packet left whose acknowledgement ends the round.
#[derive(Clone, Copy, Debug)]
struct Round {
    began: Instant,
    acked: u64,
    lost: u64,
    /// Most bytes in flight.
    peak: u64,
}

impl Round {
    fn new(now: Instant) -> Self {
        Self { began: now, acked: 0, lost: 0, peak: 0 }
    }
}

/// Test whether a smaller window loses less.
#[derive(Clone, Copy, Debug)]
struct Trial {
    /// Part lost before the cut.
    part: f64,
    rounds: u32,
    lost: u64,
    acked: u64,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Mode {
    /// The window doubles each round.
    StartUp,
    /// The window stays at the aim.
    Steady,
    /// The window shrinks for a round, so that the queue empties and the path shows its round trip.
    Drain,
}

/// State of the controller.
#[derive(Clone, Debug)]
pub(super) struct Delay {
    gate: Arc<Gate>,
    mtu: u64,
    /// Window, bytes.
    window: f64,
    /// Target of the window, which grows towards it a little with each acknowledgement: one step would be a burst,
    /// which a short queue does not hold.
    goal: f64,
    in_flight: InFlight,
    mode: Mode,
    base: Floor,
    /// Time of the last drain.
    drained: Instant,
    /// Variation of the standing round trip from round to round, seconds.
    jitter: f64,
    last_standing: Duration,
    standing: Floor,
    round: Round,
    before: Round,
    /// Rounds that used the window and saw no queue, in a row.
    quiet: u32,
    /// Cuts in a row, and the standing round trip and the window before the first.
    cuts: u32,
    uncut: (Duration, f64),
    /// Loss that is independent of the window.
    loss_floor: f64,
    /// Test of the last cut for loss.
    trial: Option<Trial>,
    /// Window at which much was lost; the window passes it slowly.
    ceiling: Option<f64>,
    /// Rounds above the ceiling.
    above: i32,
    loss_cut: Instant,
}

impl Delay {
    pub(super) fn new(gate: Arc<Gate>, now: Instant, mtu: u16) -> Self {
        let mtu = u64::from(mtu);
        let delay = Self {
            gate,
            mtu,
            window: (WINDOW_PACKETS_INITIAL * mtu) as f64,
            goal: 0.0,
            in_flight: InFlight::default(),
            mode: Mode::StartUp,
            base: Floor::new(BASE_AGE_MAX / 2, now),
            drained: now,
            jitter: 0.0,
            last_standing: Duration::ZERO,
            standing: Floor::new(STANDING_SPAN_MIN, now),
            round: Round::new(now),
            before: Round::new(now),
            quiet: 0,
            cuts: 0,
            uncut: (Duration::ZERO, 0.0),
            loss_floor: 0.0,
            trial: None,
            ceiling: None,
            above: 0,
            loss_cut: now,
        };
        delay.gate.open(delay.limits());
        delay
    }

    /// Returns the bytes that should be in flight.
    fn target(&self) -> u64 {
        let window = match self.mode {
            Mode::Drain => {
                let (base, standing) = (self.base(), self.standing());
                let empty = base.as_secs_f64() / standing.max(base).as_secs_f64().max(1e-6);
                self.window * empty * DRAIN_PART
            }
            Mode::StartUp | Mode::Steady => self.window,
        };
        (window as u64).max(WINDOW_PACKETS_MIN * self.mtu)
    }

    /// Returns the bytes that may be in flight if the next are urgent.
    fn cap(&self) -> u64 {
        let target = self.target();
        target + (target / URGENT_PART).max(URGENT_PACKETS_MIN * self.mtu)
    }

    fn limits(&self) -> Limits {
        let (target, cap) = (self.target(), self.cap());
        let rtt = self.standing().max(PIECE_SPAN);
        let piece = target as f64 * PIECE_SPAN.as_secs_f64() / rtt.as_secs_f64();
        Limits { target, cap, piece: piece as u64 }
    }

    fn base(&self) -> Duration {
        self.base.get().unwrap_or_default()
    }

    fn standing(&self) -> Duration {
        self.standing.get().unwrap_or_default()
    }

    /// Returns the aim for the queue, widened as far as jitter hides the queue.
    fn aim(&self) -> Duration {
        let beyond = Duration::from_secs_f64(self.jitter).saturating_sub(JITTER_FREE);
        QUEUE_AIM + (JITTER_TIMES * beyond).min(JITTER_AIM_MAX)
    }

    /// Returns the time that packets stand in queues.
    fn queue(&self) -> Duration {
        self.standing().saturating_sub(self.base())
    }

    /// Lets the window grow to this goal within a round.
    fn grow_to(&mut self, goal: f64) {
        self.goal = goal.min(WINDOW_BYTES_MAX as f64);
    }

    /// Sets the window at once.
    fn set_window(&mut self, window: f64) {
        self.goal = 0.0;
        self.window = window.clamp((WINDOW_PACKETS_MIN * self.mtu) as f64, WINDOW_BYTES_MAX as f64);
    }

    /// Returns the bytes that arrive in a second.
    fn rate(&self, now: Instant) -> f64 {
        let acked = self.round.acked + self.before.acked;
        let span = now.saturating_duration_since(self.before.began).as_secs_f64();
        acked as f64 / span.max(1e-6)
    }

    /// Returns the bytes that arrive in a round trip with the queue at the aim.
    fn window_by_rate(&self, now: Instant) -> f64 {
        self.rate(now) * (self.base() + self.aim()).as_secs_f64()
    }

    fn end_round(&mut self, now: Instant) {
        let round = std::mem::replace(&mut self.round, Round::new(now));
        let before = std::mem::replace(&mut self.before, round);
        let uses_window = round.peak as f64 >= self.window * 0.75 - self.mtu as f64;
        let queue = self.queue();
        if let Some(part) = self.heavy_loss(&round, &before) {
            return self.cut_for_loss(now, part);
        }
        match self.mode {
            Mode::StartUp => {
                if !uses_window {
                    // Unused window proves nothing.
                    self.set_window(
                        self.window.min((2 * round.peak).max(WINDOW_PACKETS_INITIAL * self.mtu) as f64),
                    );
                }
            }
            Mode::Drain => {
                let (drained, window) = (self.target() as f64, self.window);
                self.mode = Mode::Steady;
                self.drained = now;
                self.set_window(drained);
                self.grow_to(window);
            }
            Mode::Steady => self.steer(now, queue, uses_window),
        }
        if self.mode == Mode::Steady
            && uses_window
            && now.saturating_duration_since(self.drained) > DRAIN_INTERVAL
        {
            self.mode = Mode::Drain;
        }
    }

    /// Steers the window towards the aim, as far as a round allows.
    fn steer(&mut self, now: Instant, queue: Duration, uses_window: bool) {
        let differs = self.standing().abs_diff(self.last_standing).as_secs_f64();
        if !self.last_standing.is_zero() {
            self.jitter += (differs.min(JITTER_AIM_MAX.as_secs_f64()) - self.jitter) / 8.0;
        }
        self.last_standing = self.standing();
        let (rtt, aim) = (self.standing().as_secs_f64().max(1e-6), self.aim().as_secs_f64());
        let over = queue.as_secs_f64() - aim;
        if over > 0.0 {
            self.quiet = 0;
            // The path has become narrower or longer meanwhile: the cuts until now say nothing about its queue.
            if self.cuts == 0 || queue > self.uncut.0 * NEW_QUEUE_TIMES {
                self.uncut = (queue, self.window);
                self.cuts = 0;
            }
            self.cuts += 1;
            let part = (over / rtt * CUT_GAIN).min(CUT_MAX);
            self.set_window(self.window * (1.0 - part));
            let (was, window) = self.uncut;
            let has_shrunk =
                self.window <= window * 0.6 || self.window <= (WINDOW_PACKETS_MIN * self.mtu) as f64;
            if self.cuts >= CUTS_IN_VAIN && has_shrunk {
                if queue.as_secs_f64() > was.as_secs_f64() * 0.8 {
                    self.set_window(window);
                    self.rebase(now);
                } else {
                    self.cuts = 0;
                }
            }
            return;
        }
        self.cuts = 0;
        if !uses_window || self.trial.is_some() {
            return;
        }
        let is_quiet = queue < self.aim() / 3 && self.before.lost == 0;
        self.quiet = if is_quiet { self.quiet + 1 } else { 0 };
        let under = -over / aim * self.mtu as f64;
        let part = (-over / rtt * GROW_GAIN).min(GROW_MAX);
        let part = if self.quiet >= QUIET_ROUNDS { part.max(QUIET_GROW) } else { part };
        let grown = self.window + under.max(self.window * part);
        match self.ceiling {
            Some(ceiling) if grown > ceiling => {
                // The window passes the ceiling in growing steps.
                self.above += 1;
                let step = under * 1.4f64.powi(self.above);
                self.grow_to(grown.min(self.window.max(ceiling) + step));
            }
            _ => self.grow_to(grown),
        }
    }

    /// Takes the present round trip as the shortest: the queue is not ours, or the path has become longer.
    fn rebase(&mut self, now: Instant) {
        let standing = self.standing();
        self.base = Floor::new(BASE_AGE_MAX / 2, now);
        self.base.add(now, standing);
        self.cuts = 0;
        self.quiet = 0;
    }

    /// Returns the part that was lost in these rounds, if it is too much.
    fn heavy_loss(&mut self, round: &Round, before: &Round) -> Option<f64> {
        if let Some(mut trial) = self.trial.take() {
            trial.rounds += 1;
            if trial.rounds > TRIAL_ROUNDS / 2 {
                trial.lost += round.lost;
                trial.acked += round.acked;
            }
            if trial.rounds < TRIAL_ROUNDS {
                self.trial = Some(trial);
                return None;
            }
            let part = trial.lost as f64 / (trial.lost + trial.acked).max(1) as f64;
            if part > trial.part * LOSS_STAYS {
                self.loss_floor = self.loss_floor.max(part).min(LOSS_FLOOR_MAX);
                self.ceiling = None;
            }
        }
        let (lost, acked) = (round.lost + before.lost, round.acked + before.acked);
        let part = lost as f64 / (lost + acked).max(1) as f64;
        if part < self.loss_floor {
            self.loss_floor += (part - self.loss_floor) * 0.05;
        }
        // Random loss varies more where there is more of it.
        let heavy = LOSS_HEAVY + self.loss_floor * 1.5;
        (lost >= LOST_PACKETS_MIN * self.mtu && part > heavy).then_some(part)
    }

    fn cut_for_loss(&mut self, now: Instant, part: f64) {
        self.ceiling = Some(self.window * LOSS_CUT_MAX);
        self.above = 0;
        self.quiet = 0;
        self.cuts = 0;
        let arrives = self.rate(now) * self.base().as_secs_f64();
        self.set_window(arrives.clamp(self.window * LOSS_CUT_MIN, self.window * LOSS_CUT_MAX));
        self.mode = Mode::Steady;
        self.loss_cut = now;
        self.trial = Some(Trial { part, rounds: 0, lost: 0, acked: 0 });
    }

    fn tell(&self, all_sent: bool) {
        self.gate.set(self.in_flight.0, self.limits(), all_sent);
    }
}

impl Controller for Delay {
    fn on_sent(&mut self, _now: Instant, bytes: u64, _last_packet_number: u64) {
        self.in_flight.sent(bytes);
        self.round.peak = self.round.peak.max(self.in_flight.0);
        self.gate.on_sent(bytes, self.in_flight.0);
    }

    fn on_ack(&mut self, now: Instant, sent: Instant, bytes: u64, _app_limited: bool, rtt: &RttEstimator) {
        let sample = now.saturating_duration_since(sent);
        self.standing.span = (rtt.get() / 4).max(STANDING_SPAN_MIN);
        self.standing.add(now, sample);
        self.base.add(now, sample);
        self.round.acked += bytes;
        if self.mode == Mode::StartUp {
            if self.queue() > self.aim() {
                let by_rate = self.window_by_rate(now);
                self.set_window(by_rate.clamp(self.window * 0.5, self.window));
                self.mode = Mode::Steady;
                // Packets sent until now may be lost; the controller has reacted to that already.
                self.loss_cut = now;
            } else {
                self.set_window(self.window + bytes as f64);
            }
        } else if self.window < self.goal {
            // A round is all acknowledgements of a window.
            let step = (self.goal - self.window).max(0.0) * (2.0 * bytes as f64 / self.window).min(1.0);
            self.window += step;
        }
        if sent >= self.round.began {
            self.end_round(now);
        }
    }

    fn on_end_acks(&mut self, _now: Instant, in_flight: u64, app_limited: bool, _largest: Option<u64>) {
        self.in_flight = InFlight(in_flight);
        self.tell(app_limited);
    }

    fn on_congestion_event(&mut self, now: Instant, sent: Instant, is_persistent: bool, lost_bytes: u64) {
        self.in_flight.lost(lost_bytes);
        if sent > self.loss_cut {
            self.round.lost += lost_bytes;
        }
        let rtt = self.standing().max(self.base());
        if is_persistent {
            self.set_window(0.0);
            self.rebase(now);
            self.mode = Mode::StartUp;
        } else if lost_bytes == 0 && now.saturating_duration_since(self.loss_cut) > rtt {
            // A router marked packets (RFC 3168): otherwise it would have dropped them.
            self.cut_for_loss(now, 0.0);
        } else {
            // The freed room is not filled at once either.
            let (goal, rest) = (self.goal.max(self.window), self.window - lost_bytes as f64);
            self.set_window(rest.max(self.window * 0.5));
            self.grow_to(goal);
        }
        self.tell(false);
    }

    fn on_mtu_update(&mut self, new_mtu: u16) {
        self.mtu = new_mtu.into();
        self.set_window(self.window);
    }

    fn window(&self) -> u64 {
        self.cap()
    }

    fn metrics(&self) -> ControllerMetrics {
        let mut metrics = ControllerMetrics::default();
        metrics.congestion_window = self.target();
        metrics
    }

    fn clone_box(&self) -> Box<dyn Controller> {
        let clone = Self { in_flight: InFlight::default(), ..self.clone() };
        clone.gate.open(clone.limits());
        Box::new(clone)
    }

    fn initial_window(&self) -> u64 {
        self.cap()
    }

    fn into_any(self: Box<Self>) -> Box<dyn Any> {
        into_any(self)
    }
}
