//! [`LinkSupervisor`]: when a dialled link is replaced, by what, and when the old one goes.
//!
//! The supervisor of a peer keeps one link in use until that link ends, makes at most one successor at a time while the
//! old link still serves, and retires the old link only after the successor carries both sides' state.
//!
//! A pure machine. The driver passes events to [`LinkSupervisor::handle`] and then drains
//! [`LinkSupervisor::poll_output`] until it returns [`Output::Timeout`]. It dials, measures and closes; the machine
//! knows links by number and routers by rank only. The first dial, and the next one after the link ended, belong to the
//! searches for routers, which wait by [`crate::Backoff`].

use std::collections::VecDeque;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;

use crate::origin::{Move, Origin};
use crate::{BACKOFF_MAX, BACKOFF_MIN, Failback, wait};

/// Silence on a new socket after which another link is tried beside it, since the new network may block the transport.
pub const DOUBT_AFTER: Duration = Duration::from_millis(1500);

/// Number of [`DOUBT_AFTER`] by which further changes postpone that at most.
const DOUBTS_MAX: u32 = 4;
/// Longest time between a change of the network and [`Event::NetworkChanged`].
pub const NETWORK_NEWS_MAX: Duration = Duration::from_millis(300);
/// Longest time for which a dial goes on although the network changed.
pub const UNDISTURBED_MAX: Duration = Duration::from_secs(32);

/// Number of a link, given by the driver. No number is used twice by one supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct LinkKey(pub u32);

/// A link that is up, as the supervisor sees it.
#[derive(Clone, Copy, Debug)]
pub struct LinkFacts {
    /// Number of the link.
    pub key: LinkKey,
    /// Number of URLs of the router that are better than the link's.
    pub rank: usize,
    /// Whether the transport uses UDP, and so can continue on another socket.
    pub over_udp: bool,
    /// Source address of packets to the peer when the dial began; `None` if no route existed.
    pub source: Option<IpAddr>,
}

/// Something that happened.
#[derive(Clone, Copy, Debug)]
pub enum Event {
    /// The dial succeeded.
    Dialled(LinkFacts),
    /// The dial failed.
    DialFailed,
    /// Both sides have sent each other their state on the successor.
    Settled(LinkKey),
    /// A link ended.
    Closed(LinkKey),
    /// The addresses or routes of this host changed.
    NetworkChanged,
    /// Answer to [`Output::LookUpSource`].
    Source {
        /// Source address of packets to the peer of the link in use; `None` if no route exists.
        source: Option<IpAddr>,
        /// Bytes received over the link in use so far.
        received_bytes: u64,
    },
    /// The credentials of this node changed, so a link has to show them.
    CredentialsRenewed,
    /// Another target is wanted.
    TargetChanged,
    /// The peer has made a link of its own, which has precedence.
    PeerLinked,
    /// The node stops.
    Shutdown,
    /// The time of [`Output::Timeout`] has come.
    Timeout {
        /// Bytes received over the link in use so far.
        received_bytes: u64,
    },
}

/// Reason of a dial.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DialCause {
    /// A better URL may work. The only cause that dials nothing but better URLs.
    Failback,
    /// The credentials or the target changed.
    Renewal,
    /// The last attempt failed, and its back-off is over.
    Retry,
    /// The network changed, and the transport cannot follow.
    Network,
    /// Nothing arrives since the network changed.
    Silence,
}

/// Work for the driver.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Output {
    /// Dial. The result is [`Event::Dialled`] or [`Event::DialFailed`].
    Dial(DialCause),
    /// Abandon the dial under way.
    AbortDial,
    /// Move the sockets to the current network.
    Rebind,
    /// Look up the source address towards the peer of the link in use, and pass it in as [`Event::Source`].
    LookUpSource,
    /// This link is the one in use from here on.
    Adopt(LinkKey),
    /// Say goodbye on this link, which a newer one replaced.
    Retire(LinkKey),
    /// Close this link, because the peer's own link has precedence.
    Close(LinkKey),
    /// The last link ended.
    Ended,
    /// Nothing more to do until an event, or until this time.
    Timeout(Option<Instant>),
}

/// The work on a successor. Each attempt carries the number of failures since the link in use was adopted; `None`
/// without one.
#[derive(Debug)]
enum State {
    /// No successor is wanted.
    Content,
    /// The last attempt failed.
    BackingOff { failures: u32, due: Instant },
    /// A dial is under way.
    Dialling { cause: DialCause, failures: Option<u32>, restarts: Restarts },
    /// The successor is up and does not carry both sides' state yet.
    Settling { successor: LinkFacts, failures: Option<u32> },
    /// No successor will be made: the node stops, or the peer's own link has precedence.
    Stopping,
    /// No link is left.
    Ended,
}

/// Restarts of a dial, each because the network changed. The first change restarts it at once, so that roaming is fast.
/// Later ones wait, twice as long each time, so that a stream of changes lets a dial succeed or fail.
#[derive(Clone, Copy, Debug)]
struct Restarts {
    count: u32,
    /// When the next restart is permitted.
    permitted: Instant,
    /// Whether the network changed and the dial was not restarted.
    is_wanted: bool,
}

impl Restarts {
    fn new(now: Instant) -> Self {
        Self { count: 0, permitted: now, is_wanted: false }
    }

    fn next(self, now: Instant) -> Self {
        let undisturbed = BACKOFF_MIN.saturating_mul(2u32.saturating_pow(self.count.min(16)));
        let permitted = now + undisturbed.min(UNDISTURBED_MAX);
        Self { count: self.count.saturating_add(1), permitted, is_wanted: false }
    }
}

/// Suspicion that a link fell silent with its old socket.
#[derive(Clone, Copy, Debug)]
struct Doubt {
    due: Instant,
    /// Latest time to which further changes postpone it.
    latest: Instant,
    received_bytes: u64,
}

/// Keeps the link to one router, and its successors.
#[derive(Debug)]
pub struct LinkSupervisor {
    link: LinkKey,
    over_udp: bool,
    origin: Origin,
    failback: Failback,
    state: State,
    doubt: Option<Doubt>,
    /// Whether credentials or target changed since the last dial to the whole target began.
    is_outdated: bool,
    /// Whether the network changed while a successor was dialled or settled.
    has_network_changed: bool,
    /// Until when a reported change may have happened while the first link was dialled.
    uncertain_until: Instant,
    outputs: VecDeque<Output>,
    /// Serves jitter only.
    rng: ChaCha20Rng,
}

impl LinkSupervisor {
    /// Starts with a link that is up.
    pub fn new(now: Instant, link: LinkFacts, mut rng: ChaCha20Rng) -> Self {
        Self {
            link: link.key,
            over_udp: link.over_udp,
            origin: Origin::new(link.source),
            failback: Failback::new(link.rank, now, &mut rng),
            state: State::Content,
            doubt: None,
            is_outdated: false,
            has_network_changed: false,
            uncertain_until: now + NETWORK_NEWS_MAX,
            outputs: VecDeque::new(),
            rng,
        }
    }

    /// Returns the link in use.
    pub fn link(&self) -> LinkKey {
        self.link
    }

    /// Returns `true` if the attempt under way follows a failed one, so that its failure is no news.
    pub fn is_retrying(&self) -> bool {
        match &self.state {
            State::BackingOff { .. } => true,
            State::Dialling { failures, .. } | State::Settling { failures, .. } => failures.is_some(),
            State::Content | State::Stopping | State::Ended => false,
        }
    }

    /// Handles an event. Events of links and dials that the supervisor does not know any more are ignored.
    pub fn handle(&mut self, now: Instant, event: Event) {
        match event {
            Event::Dialled(successor) => {
                if let State::Dialling { failures, restarts, .. } = self.state {
                    self.doubt = None;
                    self.has_network_changed = restarts.is_wanted;
                    self.state = State::Settling { successor, failures };
                }
            }
            Event::DialFailed => self.dial_failed(now),
            Event::Settled(key) => {
                if let Some(successor) = self.settling(key) {
                    self.outputs.push_back(Output::Retire(self.link));
                    self.adopt(now, successor);
                }
            }
            Event::Closed(key) => self.closed(now, key),
            Event::NetworkChanged => self.network_changed(now),
            Event::Source { source, received_bytes } => self.follow_network(now, source, received_bytes),
            Event::CredentialsRenewed | Event::TargetChanged => {
                self.is_outdated = true;
                self.dial_if_outdated(now);
            }
            Event::PeerLinked => self.give_way(),
            Event::Shutdown => self.stop(),
            Event::Timeout { received_bytes } => self.timeout(now, received_bytes),
        }
    }

    /// Returns the next piece of work; [`Output::Timeout`] if there is none.
    pub fn poll_output(&mut self) -> Output {
        self.outputs.pop_front().unwrap_or_else(|| Output::Timeout(self.deadline()))
    }

    fn deadline(&self) -> Option<Instant> {
        let attempt = match &self.state {
            State::Content => self.failback.due(),
            State::BackingOff { due, .. } => Some(*due),
            State::Dialling { restarts, .. } => restarts.is_wanted.then_some(restarts.permitted),
            State::Settling { .. } | State::Stopping | State::Ended => None,
        };
        let doubt = self.doubt.map(|doubt| doubt.due);
        attempt.into_iter().chain(doubt).min()
    }

    fn settling(&self, key: LinkKey) -> Option<LinkFacts> {
        match &self.state {
            State::Settling { successor, .. } if successor.key == key => Some(*successor),
            _ => None,
        }
    }

    fn dial_failed(&mut self, now: Instant) {
        match self.state {
            State::Dialling { cause: DialCause::Failback, restarts, .. } => {
                self.failback.failed(now, &mut self.rng);
                if restarts.is_wanted {
                    self.failback.network_changed(now);
                }
                self.state = State::Content;
                self.dial_if_outdated(now);
            }
            // The attempt says nothing about the present network.
            State::Dialling { restarts, .. } if restarts.is_wanted => self.back_off(now, 1),
            State::Dialling { failures, .. } => self.back_off(now, failures.unwrap_or(0).saturating_add(1)),
            _ => {}
        }
    }

    fn closed(&mut self, now: Instant, key: LinkKey) {
        match self.state {
            State::Settling { successor, failures } if successor.key == key => {
                self.back_off(now, failures.unwrap_or(0).saturating_add(1));
                self.look_again();
            }
            State::Settling { successor, .. } if self.link == key => self.adopt(now, successor),
            _ if self.link == key => {
                self.stop();
                self.state = State::Ended;
                self.outputs.push_back(Output::Ended);
            }
            _ => {}
        }
    }

    /// Puts the successor in the place of the link in use.
    fn adopt(&mut self, now: Instant, successor: LinkFacts) {
        self.link = successor.key;
        self.over_udp = successor.over_udp;
        self.origin = Origin::new(successor.source);
        self.failback = Failback::new(successor.rank, now, &mut self.rng);
        self.state = State::Content;
        self.outputs.push_back(Output::Adopt(successor.key));
        self.look_again();
        self.dial_if_outdated(now);
    }

    /// Handles a change of the network that came while a successor was dialled or settled.
    fn look_again(&mut self) {
        if std::mem::take(&mut self.has_network_changed) {
            self.outputs.push_back(Output::LookUpSource);
        }
    }

    fn network_changed(&mut self, now: Instant) {
        if now <= self.uncertain_until {
            self.origin.distrust();
        }
        match self.state {
            State::Settling { .. } => self.has_network_changed = true,
            State::Stopping | State::Ended => {}
            State::Content | State::BackingOff { .. } | State::Dialling { .. } => {
                self.outputs.push_back(Output::LookUpSource);
            }
        }
    }

    fn follow_network(&mut self, now: Instant, source: Option<IpAddr>, received_bytes: u64) {
        match self.state {
            // The dial ended between the question and its answer, which is about the old link.
            State::Settling { .. } => return self.has_network_changed = true,
            State::Stopping | State::Ended => return,
            State::Content | State::BackingOff { .. } | State::Dialling { .. } => {}
        }
        let moves = self.origin.moves(source, self.over_udp);
        if moves == Move::Rebind {
            self.outputs.push_back(Output::Rebind);
            let latest = self.doubt.map_or(now + DOUBTS_MAX * DOUBT_AFTER, |doubt| doubt.latest);
            self.doubt = Some(Doubt { due: latest.min(now + DOUBT_AFTER), latest, received_bytes });
        }
        // Another network may not block the better URL.
        self.failback.network_changed(now);
        match self.state {
            // The dial began on the old network.
            State::Dialling { .. } => self.want_restart(now, moves),
            _ if moves == Move::Redial => self.dial(now, DialCause::Network),
            // An earlier change made the wait short already.
            State::BackingOff { failures: 0, .. } => {}
            State::BackingOff { .. } => self.back_off(now, 0),
            State::Content | State::Settling { .. } | State::Stopping | State::Ended => {}
        }
        if let State::Dialling { failures, .. } = &mut self.state {
            *failures = failures.map(|_| 0);
        }
    }

    /// Begins the dial under way anew, now or once that is permitted. A failback goes on as one unless the link has to
    /// be replaced.
    fn want_restart(&mut self, now: Instant, moves: Move) {
        if let State::Dialling { cause, restarts, .. } = &mut self.state {
            restarts.is_wanted = true;
            if *cause != DialCause::Failback || moves == Move::Redial {
                *cause = DialCause::Network;
            }
        }
        self.restart_if_permitted(now);
    }

    fn restart_if_permitted(&mut self, now: Instant) {
        if let State::Dialling { cause, restarts, .. } = self.state
            && restarts.is_wanted
            && restarts.permitted <= now
        {
            self.dial(now, cause);
            if let State::Dialling { restarts: next, .. } = &mut self.state {
                *next = restarts.next(now);
            }
        }
    }

    fn timeout(&mut self, now: Instant, received_bytes: u64) {
        if let Some(doubt) = self.doubt.filter(|doubt| doubt.due <= now) {
            self.doubt = None;
            let is_tried =
                matches!(&self.state, State::Dialling { cause, .. } if *cause != DialCause::Failback);
            if received_bytes == doubt.received_bytes && !is_tried {
                self.dial(now, DialCause::Silence);
            }
        }
        self.restart_if_permitted(now);
        match self.state {
            State::BackingOff { due, .. } if due <= now => self.dial(now, DialCause::Retry),
            State::Content if self.failback.due().is_some_and(|due| due <= now) => {
                self.dial(now, DialCause::Failback)
            }
            _ => {}
        }
    }

    /// Dials if the link in use has outdated credentials or target. A failed attempt is not hastened by it.
    fn dial_if_outdated(&mut self, now: Instant) {
        if self.is_outdated && matches!(self.state, State::Content) {
            self.dial(now, DialCause::Renewal);
        }
    }

    /// Begins to dial, in place of a dial under way.
    fn dial(&mut self, now: Instant, cause: DialCause) {
        let (failures, restarts) = match self.state {
            State::Content => (None, Restarts::new(now)),
            State::BackingOff { failures, .. } => (Some(failures), Restarts::new(now)),
            State::Dialling { failures, restarts, .. } => {
                self.outputs.push_back(Output::AbortDial);
                (failures, Restarts { is_wanted: false, ..restarts })
            }
            State::Settling { .. } | State::Stopping | State::Ended => return,
        };
        if cause != DialCause::Failback {
            self.is_outdated = false;
        }
        self.state = State::Dialling { cause, failures, restarts };
        self.outputs.push_back(Output::Dial(cause));
    }

    fn back_off(&mut self, now: Instant, failures: u32) {
        let due = now + wait(failures, BACKOFF_MAX, &mut self.rng);
        self.state = State::BackingOff { failures, due };
    }

    /// Ends all links in favour of the peer's own.
    fn give_way(&mut self) {
        if let State::Stopping | State::Ended = self.state {
            return;
        }
        self.stop();
        self.outputs.push_back(Output::Close(self.link));
    }

    /// Makes no successor any more.
    fn stop(&mut self) {
        match self.state {
            State::Dialling { .. } => self.outputs.push_back(Output::AbortDial),
            State::Settling { successor, .. } => self.outputs.push_back(Output::Close(successor.key)),
            State::Ended => return,
            State::Content | State::BackingOff { .. } | State::Stopping => {}
        }
        self.doubt = None;
        self.state = State::Stopping;
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::disallowed_methods)]

    use rand_core::SeedableRng as _;

    use super::*;

    const FIRST: LinkKey = LinkKey(1);
    const SECOND: LinkKey = LinkKey(2);

    fn ms(n: u64) -> Duration {
        Duration::from_millis(n)
    }

    fn ip(n: u8) -> Option<IpAddr> {
        Some(IpAddr::from([10, 0, 0, n]))
    }

    fn facts(key: LinkKey, rank: usize, over_udp: bool) -> LinkFacts {
        LinkFacts { key, rank, over_udp, source: ip(1) }
    }

    struct Bench {
        now: Instant,
        machine: LinkSupervisor,
        received_bytes: u64,
    }

    impl Bench {
        fn new(rank: usize, over_udp: bool) -> Self {
            let mut bench = Self::just_dialled(rank, over_udp);
            bench.now += 2 * NETWORK_NEWS_MAX;
            bench
        }

        fn just_dialled(rank: usize, over_udp: bool) -> Self {
            let (now, rng) = (Instant::now(), ChaCha20Rng::seed_from_u64(1));
            Self {
                now,
                machine: LinkSupervisor::new(now, facts(FIRST, rank, over_udp), rng),
                received_bytes: 0,
            }
        }

        fn drain(&mut self) -> Vec<Output> {
            let next = std::iter::repeat_with(|| self.machine.poll_output());
            next.take_while(|output| !matches!(output, Output::Timeout(_))).collect()
        }

        fn on(&mut self, event: Event) -> Vec<Output> {
            self.machine.handle(self.now, event);
            self.drain()
        }

        fn deadline(&mut self) -> Option<Duration> {
            let Output::Timeout(at) = self.machine.poll_output() else { panic!("not drained") };
            at.map(|at| at.saturating_duration_since(self.now))
        }

        fn after(&mut self, time: Duration) -> Vec<Output> {
            self.now += time;
            self.on(Event::Timeout { received_bytes: self.received_bytes })
        }

        /// Reports a change of the network, after which `source` is the address towards the peer.
        fn network(&mut self, source: Option<IpAddr>) -> Vec<Output> {
            assert_eq!(self.on(Event::NetworkChanged), [Output::LookUpSource]);
            self.on(Event::Source { source, received_bytes: self.received_bytes })
        }
    }

    #[test]
    fn renewed_credentials_replace_the_link_after_the_successor_settled() {
        let mut bench = Bench::new(0, true);
        assert_eq!(bench.deadline(), None);
        assert_eq!(bench.on(Event::CredentialsRenewed), [Output::Dial(DialCause::Renewal)]);
        assert_eq!(bench.on(Event::Dialled(facts(SECOND, 0, true))), []);
        assert_eq!(bench.machine.link(), FIRST);
        assert_eq!(bench.on(Event::Settled(SECOND)), [Output::Retire(FIRST), Output::Adopt(SECOND)]);
        assert_eq!((bench.machine.link(), bench.on(Event::Closed(FIRST))), (SECOND, vec![]));
        assert_eq!(bench.on(Event::Closed(SECOND)), [Output::Ended]);
    }

    #[test]
    fn renewal_during_an_attempt_is_followed_by_another() {
        for event in [Event::CredentialsRenewed, Event::TargetChanged] {
            let mut bench = Bench::new(0, true);
            bench.on(event);
            assert_eq!(bench.on(event), []);
            bench.on(Event::Dialled(facts(SECOND, 0, true)));
            let outputs = bench.on(Event::Settled(SECOND));
            assert_eq!(outputs.last(), Some(&Output::Dial(DialCause::Renewal)), "{outputs:?}");
        }
    }

    #[test]
    fn failed_attempts_back_off_and_keep_the_old_link() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        for most in [250, 500, 1000, 2000, 4000, 8000, 10_000, 10_000] {
            assert_eq!(bench.on(Event::DialFailed), []);
            assert!(bench.machine.is_retrying());
            // Another renewal does not hasten the attempt, which shows the newest credentials.
            assert_eq!(bench.on(Event::CredentialsRenewed), []);
            let wait = bench.deadline().unwrap();
            assert!(wait >= ms(most / 2) && wait <= ms(most), "{wait:?} of {most}");
            assert_eq!(bench.after(wait - ms(1)), []);
            assert_eq!(bench.after(ms(1)), [Output::Dial(DialCause::Retry)]);
        }
        // A successor that ends before it settled is a failed attempt as well.
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::Closed(SECOND)), []);
        assert!(bench.deadline().unwrap() >= ms(5000));
        // Another network makes the wait short.
        assert_eq!(bench.network(None), []);
        assert!(bench.deadline().unwrap() <= ms(250));
        assert_eq!(bench.machine.link(), FIRST);
    }

    #[test]
    fn successor_takes_over_at_once_if_the_old_link_ends_meanwhile() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::Closed(FIRST)), [Output::Adopt(SECOND)]);
        assert_eq!(
            (bench.on(Event::Settled(SECOND)), bench.on(Event::Closed(SECOND))),
            (vec![], vec![Output::Ended])
        );
    }

    #[test]
    fn link_that_ends_takes_its_dial_with_it() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        assert_eq!(bench.on(Event::Closed(FIRST)), [Output::AbortDial, Output::Ended]);
        assert_eq!(bench.on(Event::Dialled(facts(SECOND, 0, true))), []);
        assert_eq!(bench.on(Event::CredentialsRenewed), []);
        assert_eq!(bench.deadline(), None);
    }

    #[test]
    fn better_url_is_tried_with_growing_patience() {
        let mut bench = Bench::new(1, true);
        for most_s in [30, 60, 120, 240, 480, 600, 600] {
            let wait = bench.deadline().unwrap();
            let most = Duration::from_secs(most_s);
            assert!(wait >= most / 2 && wait <= most, "{wait:?} of {most:?}");
            assert_eq!(bench.after(wait), [Output::Dial(DialCause::Failback)]);
            assert_eq!(bench.on(Event::DialFailed), []);
            assert!(!bench.machine.is_retrying());
        }
        // Another network may let it pass.
        assert_eq!(bench.network(ip(1)), []);
        assert_eq!(bench.after(Duration::ZERO), [Output::Dial(DialCause::Failback)]);
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::Settled(SECOND)), [Output::Retire(FIRST), Output::Adopt(SECOND)]);
        assert_eq!(bench.deadline(), None);
    }

    #[test]
    fn renewal_during_failback_waits_for_its_end() {
        let mut bench = Bench::new(1, true);
        let wait = bench.deadline().unwrap();
        bench.after(wait);
        assert_eq!(bench.on(Event::CredentialsRenewed), []);
        assert_eq!(bench.on(Event::DialFailed), [Output::Dial(DialCause::Renewal)]);
    }

    #[test]
    fn link_over_udp_moves_and_is_doubted_only_if_nothing_arrives() {
        for (arrives, outputs) in [(1, vec![]), (0, vec![Output::Dial(DialCause::Silence)])] {
            let mut bench = Bench::new(0, true);
            assert_eq!(bench.network(ip(1)), []);
            assert_eq!(bench.network(ip(2)), [Output::Rebind]);
            assert_eq!(bench.deadline(), Some(DOUBT_AFTER));
            bench.received_bytes += arrives;
            assert_eq!((bench.after(DOUBT_AFTER), bench.deadline()), (outputs, None));
        }
    }

    #[test]
    fn link_over_tcp_is_dialled_again_from_the_new_address() {
        let mut bench = Bench::new(0, false);
        assert_eq!(bench.network(None), []);
        // The address came back, but connections over it may be gone.
        assert_eq!(bench.network(ip(1)), [Output::Dial(DialCause::Network)]);
        // The attempt began on the old network.
        assert_eq!(bench.network(ip(2)), [Output::AbortDial, Output::Dial(DialCause::Network)]);
    }

    #[test]
    fn change_of_the_network_while_a_successor_settles_is_handled_afterwards() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::NetworkChanged), []);
        let outputs = bench.on(Event::Settled(SECOND));
        assert_eq!(outputs, [Output::Retire(FIRST), Output::Adopt(SECOND), Output::LookUpSource]);
        assert_eq!(bench.on(Event::Source { source: ip(2), received_bytes: 0 }), [Output::Rebind]);
    }

    #[test]
    fn source_that_arrives_after_the_dial_ended_is_looked_up_again() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        assert_eq!(bench.on(Event::NetworkChanged), [Output::LookUpSource]);
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::Source { source: ip(2), received_bytes: 0 }), []);
        let outputs = bench.on(Event::Settled(SECOND));
        assert_eq!(outputs, [Output::Retire(FIRST), Output::Adopt(SECOND), Output::LookUpSource]);
    }

    #[test]
    fn change_reported_right_after_the_first_dial_moves_the_link() {
        for (over_udp, output) in [(true, Output::Rebind), (false, Output::Dial(DialCause::Network))] {
            let mut bench = Bench::just_dialled(0, over_udp);
            bench.now += NETWORK_NEWS_MAX;
            // The lookup after the dial already yielded the new address.
            assert_eq!(bench.network(ip(1)), [output]);
        }
    }

    #[test]
    fn stream_of_network_changes_lets_a_dial_end() {
        let mut bench = Bench::new(0, false);
        assert_eq!(bench.network(ip(2)), [Output::Dial(DialCause::Network)]);
        // A dial takes three seconds, and the network changes five times a second.
        let (mut began, mut dials) = (bench.now, 1);
        while bench.now - began < ms(3000) {
            let outputs = [bench.after(ms(200)), bench.network(ip(1 + dials % 2))].concat();
            if outputs.contains(&Output::Dial(DialCause::Network)) {
                (began, dials) = (bench.now, dials + 1);
            }
            assert!(dials <= 6, "no dial goes on for three seconds");
        }
        // The changes since then make the next dial due soon.
        assert_eq!(bench.on(Event::DialFailed), []);
        assert!(bench.deadline().unwrap() <= BACKOFF_MIN);
    }

    #[test]
    fn stream_of_network_changes_does_not_postpone_a_retry() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        bench.on(Event::DialFailed);
        bench.network(ip(1));
        let due = bench.now + bench.deadline().unwrap();
        bench.now += ms(100);
        assert_eq!(bench.network(ip(1)), []);
        assert_eq!(bench.now + bench.deadline().unwrap(), due);
    }

    #[test]
    fn stream_of_network_changes_does_not_postpone_a_doubt_for_ever() {
        let mut bench = Bench::new(0, true);
        let moves = (0..100).find(|n| {
            let outputs = [bench.after(ms(200)), bench.network(ip(1 + n % 2))].concat();
            outputs.contains(&Output::Dial(DialCause::Silence))
        });
        assert!(moves.is_some());
    }

    #[test]
    fn all_links_give_way_to_that_of_the_peer() {
        let mut bench = Bench::new(0, true);
        bench.on(Event::CredentialsRenewed);
        bench.on(Event::Dialled(facts(SECOND, 0, true)));
        assert_eq!(bench.on(Event::PeerLinked), [Output::Close(SECOND), Output::Close(FIRST)]);
        assert_eq!((bench.on(Event::PeerLinked), bench.on(Event::Closed(SECOND))), (vec![], vec![]));
        assert_eq!(bench.on(Event::Closed(FIRST)), [Output::Ended]);
    }

    #[test]
    fn nothing_is_dialled_after_shutdown() {
        let mut bench = Bench::new(1, false);
        assert_eq!(bench.on(Event::CredentialsRenewed), [Output::Dial(DialCause::Renewal)]);
        assert_eq!(bench.on(Event::Shutdown), [Output::AbortDial]);
        assert_eq!(bench.on(Event::CredentialsRenewed), []);
        assert_eq!(bench.on(Event::NetworkChanged), []);
        assert_eq!((bench.after(Duration::from_secs(3600)), bench.deadline()), (vec![], None));
        assert_eq!(bench.on(Event::Closed(FIRST)), [Output::Ended]);
    }
}
