//! Random histories of links that [`LinkSupervisor`] keeps, on a virtual clock.
//!
//! A node roams: its address changes, networks block transports or everything, the router restarts or refuses,
//! credentials are renewed, successors die young. The driver here does without sockets what `sgc-node` does with them.
//! A few lines of reference state know what happened, and every step is checked against the [rules](Run::check).
//! `SGC_SEEDS=100..2000` runs those seeds instead of the committed ones and lists failures.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::IpAddr;
use std::time::{Duration, Instant};

use rand_chacha::ChaCha20Rng;
use rand_core::SeedableRng as _;
use sgc_session::{
    Activity, BACKOFF_MAX, BACKOFF_MIN, Backoff, DialCause, Event, KeepAlive, KeepAlivePolicy, LinkFacts,
    LinkKey, LinkObservation, LinkSupervisor, Output,
};
use sgc_testkit::{Clock, Dice, run_seeds};

const STEP: Duration = ms(10);
/// Interval of looks at the links, as in `sgc-node`.
const LOOK_EVERY: Duration = ms(500);
/// Time with transitions, and the longest time to recover after them.
const RESTLESS: Duration = Duration::from_secs(300);
const RECOVERY_MAX: Duration = Duration::from_secs(30);
/// Longest time until the best URL serves again: the longest wait of a failback.
const FAILBACK_MAX: Duration = Duration::from_secs(610);
/// Changes that a flapping interface causes.
const FLAPS: u32 = 100;
const FLAP_EVERY: Duration = ms(200);
/// Most dials in a row that are abandoned, since each lasts longer than the one before.
const ABORTS_MAX: u32 = 8;
/// URLs of the router, the best first. The last one is over TCP.
const RANKS: usize = 3;

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// Everything that can happen.
#[derive(Clone, Debug)]
enum Transition {
    /// The host has this address, or none.
    Address(Option<u8>),
    /// Nothing passes, or everything does again.
    Partition(bool),
    /// The network blocks a URL, or lets it pass again.
    Block(usize, bool),
    /// All links end at once.
    RouterRestarts,
    /// The router refuses this node, or admits it again.
    Refuse(bool),
    CredentialsRenewed,
    TargetChanged,
    /// The peer makes a link of its own.
    PeerLinked,
    /// The next successor ends before it settles.
    FrailSuccessor,
    /// An interface flaps: the kernel reports a stream of changes.
    Flap,
}

struct SimLink {
    facts: LinkFacts,
    /// Local address. Over UDP it follows the host after a rebinding.
    address: Option<u8>,
    /// Version of the credentials that were shown.
    version: u64,
    keep_alive: KeepAlive,
    activity: Activity,
    received_bytes: u64,
    /// When a successor settles (`true`) or dies.
    settles: Option<(Instant, bool)>,
    has_settled: bool,
    /// When a retired link is gone.
    gone: Option<Instant>,
}

struct SimDial {
    ends: Instant,
    /// The rank of the URL that answers; `None` if the dial fails.
    rank: Option<usize>,
    cause: Option<DialCause>,
    version: u64,
    /// Address of the host when the dial began.
    address: Option<u8>,
}

struct Run {
    dice: Dice,
    clock: Clock,
    trace: String,
    // The world.
    address: Option<u8>,
    is_partitioned: bool,
    blocked: [bool; RANKS],
    refuses: bool,
    is_frail: bool,
    version: u64,
    target: u64,
    // The node.
    supervisor: Option<LinkSupervisor>,
    links: BTreeMap<LinkKey, SimLink>,
    dial: Option<SimDial>,
    next_key: u32,
    search: Backoff,
    rng: ChaCha20Rng,
    deadline: Option<Instant>,
    look_due: Instant,
    /// When the kernel's news of a change reaches the node.
    network_due: Option<Instant>,
    /// Changes that a flapping interface will still cause.
    flaps: u32,
    // The reference.
    failures: u32,
    failed_at: Option<Instant>,
    changed_at: Option<Instant>,
    /// Dials that were abandoned since one ended.
    aborts: u32,
    last_failback: Instant,
    /// Whether a dial because of the network, and one because of silence, may come.
    may_move: bool,
    may_doubt: bool,
    dialled_version: (u64, u64),
    counts: BTreeMap<String, u64>,
}

impl Run {
    fn new(seed: u64) -> Self {
        let clock = Clock::default();
        let now = clock.instant();
        Self {
            dice: Dice::new(seed),
            clock,
            trace: String::new(),
            address: Some(1),
            is_partitioned: false,
            blocked: [false; RANKS],
            refuses: false,
            is_frail: false,
            version: 0,
            target: 0,
            supervisor: None,
            links: BTreeMap::new(),
            dial: None,
            next_key: 0,
            search: Backoff::new(BACKOFF_MAX),
            rng: ChaCha20Rng::seed_from_u64(seed),
            deadline: None,
            look_due: now,
            network_due: None,
            flaps: 0,
            failures: 0,
            failed_at: None,
            changed_at: None,
            aborts: 0,
            last_failback: now,
            may_move: false,
            may_doubt: false,
            dialled_version: (0, 0),
            counts: BTreeMap::new(),
        }
    }

    fn now(&self) -> Instant {
        self.clock.instant()
    }

    fn note(&mut self, what: &str) {
        let _ = writeln!(self.trace, "{:>9.3} {what}", self.clock.elapsed().as_secs_f64());
    }

    fn source(&self) -> Option<IpAddr> {
        self.address.map(|n| IpAddr::from([10, 0, 0, n]))
    }

    fn in_use(&self) -> Option<LinkKey> {
        self.supervisor.as_ref().map(LinkSupervisor::link)
    }

    fn carries(&self, link: &SimLink) -> bool {
        let is_reached = !self.is_partitioned && !self.blocked[link.facts.rank];
        is_reached && self.address.is_some() && link.address == self.address
    }

    /// Draws a transition.
    fn draw(&mut self) -> Transition {
        match self.dice.below(20) {
            0..=4 => {
                let n = self.dice.within(1..=3) as u8;
                Transition::Address(self.dice.chance(80).then_some(n))
            }
            5..=6 => Transition::Partition(!self.is_partitioned),
            7..=9 => {
                let rank = self.dice.below(RANKS);
                Transition::Block(rank, !self.blocked[rank])
            }
            10..=11 => Transition::RouterRestarts,
            12..=13 => Transition::Refuse(!self.refuses),
            14..=15 => Transition::CredentialsRenewed,
            16 => Transition::TargetChanged,
            17 => Transition::PeerLinked,
            18 => Transition::Flap,
            _ => Transition::FrailSuccessor,
        }
    }

    fn transition(&mut self, transition: &Transition) {
        self.note(&format!("{transition:?}"));
        match *transition {
            Transition::Address(address) => {
                self.address = address;
                self.network_due = Some(self.now() + ms(50));
            }
            Transition::Partition(is_partitioned) => self.is_partitioned = is_partitioned,
            Transition::Block(rank, is_blocked) => self.blocked[rank] = is_blocked,
            Transition::RouterRestarts => {
                let mut ended: Vec<_> = self.links.keys().copied().collect();
                if self.dice.chance(50) {
                    ended.reverse();
                }
                ended.into_iter().for_each(|key| self.close(key));
            }
            Transition::Refuse(refuses) => self.refuses = refuses,
            Transition::CredentialsRenewed => {
                self.version += 1;
                self.tell(Event::CredentialsRenewed);
            }
            Transition::TargetChanged => {
                self.target += 1;
                self.tell(Event::TargetChanged);
            }
            Transition::PeerLinked => self.tell(Event::PeerLinked),
            Transition::FrailSuccessor => self.is_frail = true,
            Transition::Flap => {
                self.flaps = FLAPS;
                self.network_due = Some(self.now() + ms(50));
            }
        }
    }

    /// Passes an event to the supervisor, if there is one, and carries out its decisions.
    fn tell(&mut self, event: Event) {
        let now = self.now();
        let Some(supervisor) = &mut self.supervisor else { return };
        supervisor.handle(now, event);
        while let Some(supervisor) = &mut self.supervisor {
            let output = supervisor.poll_output();
            if let Output::Timeout(deadline) = output {
                self.deadline = deadline;
                break;
            }
            self.note(&format!("{output:?}"));
            if let Output::Dial(_) = output {
                *self.counts.entry(format!("{output:?}")).or_default() += 1;
            }
            match output {
                Output::Dial(cause) => self.begin_dial(Some(cause)),
                Output::AbortDial => {
                    assert!(self.dial.take().is_some(), "no dial to abort");
                    self.aborts += 1;
                    assert!(self.aborts <= ABORTS_MAX, "no dial ends");
                }
                Output::Rebind => {
                    let address = self.address;
                    self.may_doubt = true;
                    let over_udp = self.links.values_mut().filter(|link| link.facts.over_udp);
                    over_udp.for_each(|link| link.address = address);
                }
                Output::LookUpSource => {
                    let Some(key) = self.in_use() else { continue };
                    // Failures on another network say nothing about this one.
                    self.failures = 0;
                    let (source, received_bytes) = (self.source(), self.links[&key].received_bytes);
                    if let Some(supervisor) = &mut self.supervisor {
                        supervisor.handle(now, Event::Source { source, received_bytes });
                    }
                }
                Output::Retire(key) => self.retire(key),
                Output::Adopt(key) => {
                    assert!(self.links.contains_key(&key), "a link that is gone is adopted");
                    (self.failures, self.failed_at) = (0, None);
                    self.last_failback = now;
                }
                Output::Close(key) => {
                    self.links.get_mut(&key).into_iter().for_each(|link| link.gone = Some(now))
                }
                Output::Ended => {
                    assert!(self.dial.is_none(), "a dial outlives its supervisor");
                    self.supervisor = None;
                    self.deadline = None;
                    self.search.ended(now, &mut self.rng);
                    (self.failures, self.failed_at) = (0, Some(now));
                }
                Output::Timeout(_) => {}
            }
        }
    }

    /// A link is retired only once its successor carries both sides' state.
    fn retire(&mut self, key: LinkKey) {
        let successor = self.links.values().find(|link| link.facts.key > key && link.gone.is_none());
        assert!(successor.is_some_and(|link| link.has_settled), "retired before the successor settled");
        *self.counts.entry("Retire".to_owned()).or_default() += 1;
        let gone = self.now() + ms(50);
        self.links.get_mut(&key).into_iter().for_each(|link| link.gone = Some(gone));
    }

    /// Begins a dial. `cause` is `None` for that of the search.
    fn begin_dial(&mut self, cause: Option<DialCause>) {
        assert!(self.dial.is_none(), "two dials at once");
        self.check_pace(cause);
        let rank_of_link = self.in_use().map(|key| self.links[&key].facts.rank);
        let ranks = match cause {
            Some(DialCause::Failback) => 0..rank_of_link.unwrap_or(0),
            _ => 0..RANKS,
        };
        if cause != Some(DialCause::Failback) {
            self.dialled_version = (self.version, self.target);
        }
        let open = ranks.clone().find(|rank| !self.blocked[*rank]);
        let (took, rank) = match open {
            _ if self.address.is_none() => (ms(10), None),
            _ if self.is_partitioned => (ms(3200), None),
            Some(_) if self.refuses => (ms(30), None),
            // Each silent URL costs some time.
            Some(rank) => (ms(700 * (rank - ranks.start) as u64 + 50), Some(rank)),
            None => (ms(3200), None),
        };
        self.dial = Some(SimDial {
            ends: self.now() + took,
            rank,
            cause,
            version: self.version,
            address: self.address,
        });
    }

    /// No dial comes faster than its back-off permits.
    fn check_pace(&mut self, cause: Option<DialCause>) {
        let now = self.now();
        let since = |at: Option<Instant>| at.map_or(Duration::MAX, |at| now - at);
        let is_forgiven = self.changed_at >= self.failed_at && self.changed_at.is_some();
        match cause {
            None | Some(DialCause::Retry) => {
                let doubled = BACKOFF_MIN * 2u32.pow(self.failures.saturating_sub(1).min(16));
                let least = if is_forgiven { BACKOFF_MIN / 2 } else { doubled.min(BACKOFF_MAX) / 2 };
                // A stream of changes does not postpone the dial, so the wait counts from the failure.
                let begun = self.failed_at;
                assert!(since(begun) >= least, "dialled {:?} after failure {}", since(begun), self.failures);
            }
            Some(DialCause::Failback) => {
                let waited = since(Some(self.last_failback));
                assert!(
                    waited >= Duration::from_secs(15) || is_forgiven || self.may_move,
                    "failback after {waited:?}"
                );
            }
            Some(DialCause::Renewal) => {
                assert_eq!(self.failures, 0, "a renewal hastens a failed attempt");
                assert_ne!(self.dialled_version, (self.version, self.target), "nothing was renewed");
            }
            Some(DialCause::Network) => {
                assert!(std::mem::take(&mut self.may_move), "the network did not change");
            }
            Some(DialCause::Silence) => {
                assert!(std::mem::take(&mut self.may_doubt), "no link moved");
            }
        }
    }

    fn failed(&mut self) {
        self.failures += 1;
        self.failed_at = Some(self.now());
    }

    fn end_dial(&mut self, dial: SimDial) {
        let now = self.now();
        self.aborts = 0;
        // The world may have changed since the dial began.
        let rank =
            dial.rank.filter(|rank| !self.is_partitioned && !self.blocked[*rank] && self.address.is_some());
        let Some(rank) = rank else {
            match dial.cause {
                None => {
                    self.failed();
                    self.search.failed(now, &mut self.rng);
                }
                Some(DialCause::Failback) => {
                    self.last_failback = now;
                    self.tell(Event::DialFailed);
                }
                Some(_) => {
                    self.failed();
                    self.tell(Event::DialFailed);
                }
            }
            return;
        };
        let key = LinkKey(self.next_key);
        self.next_key += 1;
        let source = dial.address.map(|n| IpAddr::from([10, 0, 0, n]));
        let facts = LinkFacts { key, rank, over_udp: rank + 1 < RANKS, source };
        let remote = ([10, 9, 9, 9], 7447).into();
        let settles = dial.cause.map(|_| (now + ms(self.dice.within(100..=400) as u64), !self.is_frail));
        self.is_frail &= dial.cause.is_none();
        let link = SimLink {
            facts,
            address: dial.address,
            version: dial.version,
            keep_alive: KeepAlive::new(now, KeepAlivePolicy::default(), 0, remote),
            activity: Activity::default(),
            received_bytes: 0,
            settles,
            has_settled: false,
            gone: None,
        };
        self.note(&format!("link {} is up by URL {rank}", key.0));
        self.links.insert(key, link);
        match dial.cause {
            Some(_) => self.tell(Event::Dialled(facts)),
            None => {
                (self.failures, self.failed_at) = (0, None);
                self.last_failback = now;
                self.supervisor = Some(LinkSupervisor::new(now, facts, self.rng.clone()));
                if self.version > dial.version {
                    self.tell(Event::CredentialsRenewed);
                } else {
                    // Drains.
                    self.tell(Event::Timeout { received_bytes: 0 });
                }
            }
        }
    }

    fn close(&mut self, key: LinkKey) {
        self.note(&format!("link {} ends", key.0));
        let is_successor = self.links.get(&key).is_some_and(|link| link.settles.is_some());
        if is_successor && self.in_use().is_some_and(|used| used < key) && self.links[&key].gone.is_none() {
            self.failed();
        }
        self.tell(Event::Closed(key));
        self.links.remove(&key);
    }

    fn step(&mut self) {
        let now = self.now() + STEP;
        self.clock.advance_to(now);
        if self.network_due.is_some_and(|due| due <= now) {
            self.network_due = (self.flaps > 0).then_some(now + FLAP_EVERY);
            self.flaps = self.flaps.saturating_sub(1);
            self.changed_at = Some(now);
            self.may_move = true;
            if self.supervisor.is_none() && self.dial.is_none() {
                // As `sgc-node` does in `another_network`.
                self.search = Backoff::new(BACKOFF_MAX);
                self.search.ended(now, &mut self.rng);
                self.failures = 0;
            }
            self.tell(Event::NetworkChanged);
        }
        if let Some(dial) = self.dial.take_if(|dial| dial.ends <= now) {
            self.end_dial(dial);
        }
        let due: Vec<_> = self.links.keys().copied().collect();
        for key in due {
            let Some(link) = self.links.get_mut(&key) else { continue };
            if link.gone.is_some_and(|at| at <= now) {
                self.close(key);
            } else if let Some((_, settles)) = link.settles.take_if(|(at, _)| *at <= now) {
                if settles {
                    link.has_settled = true;
                    self.tell(Event::Settled(key));
                } else {
                    link.settles = Some((now, false));
                    self.close(key);
                }
            }
        }
        if self.look_due <= now {
            self.look_due = now + LOOK_EVERY;
            self.look();
        }
        if self.deadline.is_some_and(|due| due <= now) {
            let received_bytes = self.in_use().map_or(0, |key| self.links[&key].received_bytes);
            self.tell(Event::Timeout { received_bytes });
        }
        if self.supervisor.is_none() && self.dial.is_none() && self.search.is_due(now) {
            self.begin_dial(None);
        }
        self.check();
    }

    /// Keep-alive: links that carry hear something, the others die.
    fn look(&mut self) {
        let now = self.now();
        let alive: Vec<_> = self.links.iter().map(|(key, link)| (*key, self.carries(link))).collect();
        for (key, carries) in alive {
            let Some(link) = self.links.get_mut(&key) else { continue };
            link.received_bytes += u64::from(carries);
            link.activity.note();
            let seen = LinkObservation {
                received_bytes: link.received_bytes,
                activity: &link.activity,
                remote: ([10, 9, 9, 9], 7447).into(),
                rtt: ms(40),
            };
            if link.keep_alive.look(now, seen).is_dead() {
                self.close(key);
            }
        }
    }

    /// The rules that hold after each step.
    fn check(&self) {
        let now = self.now();
        let serving = self.links.values().filter(|link| link.gone.is_none()).count();
        let making = serving.saturating_sub(1) + usize::from(self.dial.is_some());
        match self.in_use() {
            Some(key) => {
                assert!(self.links.contains_key(&key), "the link in use is gone");
                assert!(making <= 1, "{serving} links and a dial: {}", self.dial.is_some());
                // A link with old credentials or target has a successor on the way.
                let is_outdated = self.links[&key].version != self.version && self.links[&key].gone.is_none();
                let is_awaited = self.deadline.is_some_and(|at| at <= now + BACKOFF_MAX);
                assert!(!is_outdated || making == 1 || is_awaited, "no attempt to show the new credentials");
            }
            None => {
                let is_awaited = self.search.due().is_none_or(|at| at <= now + BACKOFF_MAX);
                assert!(self.dial.is_some() || is_awaited, "no dial within the back-off");
            }
        }
    }

    fn run_for(&mut self, time: Duration) {
        let end = self.now() + time;
        while self.now() < end {
            self.step();
        }
    }

    /// Steps until this holds, for at most `time`.
    fn until(&mut self, time: Duration, what: &str, is_so: impl Fn(&Self) -> bool) {
        let end = self.now() + time;
        while !is_so(self) {
            assert!(self.now() < end, "not within {time:?}: {what}");
            self.step();
        }
    }

    fn execute(&mut self) -> BTreeMap<String, u64> {
        let end = self.now() + RESTLESS;
        while self.now() < end {
            let transition = self.draw();
            self.transition(&transition);
            let pause = if self.dice.chance(30) { 20_000 } else { 1500 };
            let pause = self.dice.within(10..=pause) as u64;
            self.run_for(ms(pause));
        }
        // Everything works again.
        for rank in 0..RANKS {
            self.transition(&Transition::Block(rank, false));
        }
        self.transition(&Transition::Partition(false));
        self.transition(&Transition::Refuse(false));
        self.is_frail = false;
        if self.address.is_none() {
            self.transition(&Transition::Address(Some(1)));
        }
        self.until(RECOVERY_MAX, "a link that carries and shows the newest credentials", |run| {
            let link = run.in_use().and_then(|key| run.links.get(&key));
            link.is_some_and(|link| run.carries(link) && link.version == run.version)
        });
        self.until(FAILBACK_MAX, "the best URL serves", |run| {
            run.in_use().and_then(|key| run.links.get(&key)).is_some_and(|link| link.facts.rank == 0)
        });
        self.run_for(Duration::from_secs(10));
        assert!(self.links.len() == 1 && self.dial.is_none(), "{} links at rest", self.links.len());
        std::mem::take(&mut self.counts)
    }
}

#[test]
fn roaming_node_keeps_one_link_and_replaces_it_in_order() {
    let committed: Vec<_> = (1..=200).collect();
    let counts = run_seeds(&committed, Run::new, Run::execute, |run| run.trace.clone());
    // The histories are worth something only if each kind of decision is frequent in them.
    let mut sum = BTreeMap::<_, u64>::new();
    for (what, count) in counts.into_iter().flatten() {
        *sum.entry(what).or_default() += count;
    }
    assert!(sum.len() == 6 && sum.values().all(|count| *count >= 20), "{sum:?}");
}
