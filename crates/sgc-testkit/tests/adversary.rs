//! Random honest networks beside an adversary: a router of another fleet and a member of the same one, which have
//! recorded all signed frames of the network, work together, and draw hostile actions from a grammar.
//!
//! The adversary's links are slower than any honest path, so no path between two honest nodes leads over it while an
//! honest one exists; `docs/explanation/security.md` says how a router can harm nodes behind it. With an honest path,
//! no honest pair loses its route, its allowance or a reliable message. `SGC_SEEDS=100..2000` runs those seeds instead
//! of the committed ones and lists failures.
//!
//! In the second test all members are behind NATs, and the hostile one lies about addresses, forges and replays checks,
//! and dials where others are expected. Honest nodes send to addresses that never answered no more than it spent on it,
//! and make no link with it in the place of another node.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::net::{IpAddr, SocketAddr};
use std::rc::Rc;
use std::time::Duration;

use bytes::Bytes;
use sgc_endpoint::{Event, JoinStatus};
use sgc_router::{DropReason, MappingKind};
use sgc_testkit::{
    CapturedPacket, Dice, Member, MessageId, NatKind, NodeKey, Sharing, What, World, WorldConfig, identity,
    revocation_list, run_seeds, serial_list,
};
use sgc_trust::{CertError, Kem, ReplyKey, SignedError};
use sgc_wire::{
    Adjacency, AdvertBody, Blind, CandidateKind, Control, JoinBody, LinkStateBody, Name, PATH_CANDIDATES_MAX,
    PATH_OFFER_BYTES, PathCandidate, PathOffer, Recover, RejectReason, Request, SignedBody, SinkId, SourceId,
};

/// Seeds that every run of the tests replays.
const COMMITTED: &[u64] = &[1, 2, 3, 4, 5, 6, 7, 8];
/// The same for networks with NATs.
const COMMITTED_NATS: &[u64] = &[
    119, 142, 159, 274, 283, // showed bugs
    1, 2,
];
/// Addresses to which no check may go.
const BAD: [&str; 5] =
    ["127.0.0.1:22", "169.254.169.254:80", "224.0.0.251:5353", "255.255.255.255:9", "10.0.0.7:0"];
/// Longest time until honest pairs have direct links: the longest wait between attempts, and one attempt.
const DIRECT_MAX: Duration = Duration::from_secs(315);
/// One-way latency of the adversary's links, more than that of any honest path.
const SLOW: Duration = Duration::from_millis(450);
/// Interval of the adversary's actions and of looks at the network.
const TICK: Duration = Duration::from_millis(500);
/// Announcements that are replayed in each tick of a siege.
const SIEGE_FRAMES: usize = 60;
/// Longest recovery of a pair after an honest node or link went away: the longest wait of any retry, twice.
const GRACE: Duration = Duration::from_secs(60);
/// Longest time until a new topic is granted to a node that wants it.
const NEW_MAX: Duration = Duration::from_secs(10);
/// Longest time of a reliable message.
const MESSAGE_MAX: Duration = Duration::from_secs(20);

const fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

/// An action of honest nodes.
#[derive(Clone, Copy, Debug)]
enum Honest {
    Nothing(Duration),
    NewTopic,
    Publish,
    Renew(NodeKey),
    RestartMember(NodeKey),
    RestartRouter(NodeKey),
    Revoke,
    Rotate,
}

/// An action of the adversary, over one of its links.
#[derive(Clone, Copy, Debug)]
enum Hostile {
    /// Replays recorded frames, the last ones or any.
    Replay(usize, bool),
    ReplayPackets(usize),
    /// Replays recorded announcements of one owner, to use up its allowance.
    Siege(NodeKey),
    /// Changes a recorded frame a little, or a packet.
    Spoil,
    /// Sends unsigned frames about names and sinks of others.
    Pretend,
    /// Holds back frames of its machines and sends them later in reverse order.
    Withhold,
    Release,
    BeHonest,
    /// Advertises and withdraws names of its own, many or with strange numbers.
    Advertise(usize),
    /// Claims links to all nodes.
    ClaimAll,
    Ask(usize),
    Join(usize),
    /// Distributes older lists, or lists of another CA.
    OldList,
    Restart,
}

/// A lie of the hostile member about direct paths.
#[derive(Clone, Copy, Debug)]
enum Lie {
    /// It offers addresses of victims, addresses to which nothing may go, or those of honest members.
    Victims,
    Bad,
    Members,
    /// Its offers are of another attempt than its questions.
    OtherAttempts(bool),
    /// Its checks come from so many addresses of victims each.
    Forge(usize),
    /// It sends recorded checks again.
    Replay,
    /// It dials where another node is expected.
    Dial,
    Nothing,
}

/// The lies under way.
#[derive(Default)]
struct Lies {
    candidates: Vec<SocketAddr>,
    other_attempts: bool,
    forged: usize,
    victims: u16,
}

/// The hostile member among hosts behind NATs.
struct Liar {
    dice: Dice,
    node: NodeKey,
    lies: Rc<RefCell<Lies>>,
    dials: usize,
}

/// Returns an address that no host has.
fn victim(n: u16) -> SocketAddr {
    SocketAddr::from(([198, 18, (n >> 8) as u8, n as u8], 5353))
}

fn is_victim(address: SocketAddr) -> bool {
    matches!(address.ip(), IpAddr::V4(ip) if ip.octets()[..2] == [198, 18])
}

/// Frames that the adversary keeps back on its links.
#[derive(Default)]
struct Hold {
    is_on: bool,
    frames: Vec<(usize, Control)>,
}

struct Run {
    world: World,
    dice: Dice,
    routers: Vec<NodeKey>,
    members: Vec<NodeKey>,
    thief: NodeKey,
    /// The adversary's nodes, and its links to honest ones.
    rogues: Vec<NodeKey>,
    attached: Vec<(NodeKey, NodeKey)>,
    hold: Rc<RefCell<Hold>>,
    /// Uses: user, owner, topic.
    uses: BTreeSet<(NodeKey, NodeKey, String)>,
    topics: usize,
    /// Members that have to get each message, and the time by which they have to.
    expected: BTreeMap<MessageId, (BTreeSet<NodeKey>, Duration)>,
    /// Announcements of each member, as far as they were looked for, and the siege under way.
    announced: BTreeMap<NodeKey, Vec<Control>>,
    announced_to: usize,
    siege: Option<(NodeKey, NodeKey, NodeKey)>,
    lists: Vec<Bytes>,
    is_revoked: bool,
    seq: u64,
    /// Number of log entries that were looked at.
    looked_at: usize,
    actions: usize,
    /// Networks with NATs: what is drawn for them, so that the others keep their histories.
    liar: Option<Liar>,
}

impl Run {
    /// Returns a run in which members are behind NATs.
    fn with_nats(seed: u64) -> Self {
        let mut run = Self::new(seed);
        let mut dice = Dice::new(seed ^ 0x11a7_5eed);
        let node = run.rogues[1];
        run.world.record_checks();
        for host in run.members.iter().copied().chain([run.thief, node]) {
            let kind = match dice.below(6) {
                0 => None,
                1 => Some(NatKind::FULL_CONE),
                2 => Some(NatKind::ADDRESS_RESTRICTED),
                3 => Some(NatKind::SYMMETRIC),
                _ => Some(NatKind::PORT_RESTRICTED),
            };
            let nat = kind.map(|kind| run.world.nat(kind, None));
            run.world.place(host, nat);
        }
        let lies = Rc::<RefCell<Lies>>::default();
        let of_checks = lies.clone();
        run.world.tamper_checks(node, move |check| {
            let mut lies = of_checks.borrow_mut();
            if lies.forged == 0 {
                return vec![(None, check.to, check.datagram.clone())];
            }
            let (from, count) = (lies.victims, lies.forged);
            lies.victims = from.wrapping_add(count as u16);
            let copy = |n| (Some(victim(from.wrapping_add(n as u16))), check.to, check.datagram.clone());
            (0..count).map(copy).collect()
        });
        run.liar = Some(Liar { dice, node, lies, dials: 0 });
        run
    }

    fn new(seed: u64) -> Self {
        let mut dice = Dice::new(seed ^ 0xad5e_75a2);
        let mut config = WorldConfig::new(dice.number());
        config.jitter = Duration::ZERO..=ms([0, 3][dice.below(2)]);
        let (flood, query) = (MappingKind::Flood, MappingKind::Query);
        config.mappings = [vec![flood], vec![query], vec![flood, query]][dice.below(3)].clone();
        // Small, so that a flood of a few frames is one.
        config.router_limits.announcements_burst = 32;
        config.router_limits.stale_burst = 16;
        let mut world = World::with(config);
        world.capture();
        let routers: Vec<_> = (0..dice.within(2..=4)).map(|n| world.router(&format!("router-{n}"))).collect();
        for router in &routers {
            world.trust_fleet(*router, "umbrella");
        }
        for (n, router) in routers.iter().enumerate().skip(1) {
            world.link(routers[dice.below(n)], *router);
        }
        if routers.len() > 2 {
            world.link(routers[0], routers[routers.len() - 1]);
        }
        let mut members = Vec::new();
        for n in 0..dice.within(2..=4) {
            let member = world.proxy(&format!("member-{n}"));
            let first = dice.below(routers.len());
            world.link(routers[first], member);
            if dice.chance(50) {
                world.link(routers[(first + 1) % routers.len()], member);
            }
            members.push(member);
        }
        let thief = world.proxy("thief");
        world.link(routers[0], thief);
        let stranger = Member { fleet: "umbrella".into(), router: true, ..Member::new("rogue") };
        let rogue = world.node(stranger, true);
        world.trust_fleet(rogue, "acme");
        let insider = world.node(Member::new("mallory"), dice.chance(40));
        let rogues = vec![rogue, insider];
        let hold = Rc::<RefCell<Hold>>::default();
        let mut attached = Vec::new();
        for rogue in &rogues {
            let mut to: Vec<_> = routers.clone();
            while to.len() > 1 && dice.chance(60) {
                to.remove(dice.below(to.len()));
            }
            for router in to {
                world.link_over(*rogue, router, SLOW);
                let (index, hold) = (attached.len(), hold.clone());
                world.tamper(*rogue, router, move |frame| {
                    let mut hold = hold.borrow_mut();
                    if hold.is_on && !matches!(frame, Control::Hello(_)) {
                        hold.frames.push((index, frame.clone()));
                        return vec![];
                    }
                    vec![frame.clone()]
                });
                attached.push((*rogue, router));
            }
        }
        if dice.chance(50) {
            world.link_over(rogues[0], rogues[1], SLOW);
        }
        Self {
            world,
            dice,
            routers,
            members,
            thief,
            rogues,
            attached,
            hold,
            uses: BTreeSet::new(),
            topics: 0,
            expected: BTreeMap::new(),
            announced: BTreeMap::new(),
            announced_to: 0,
            siege: None,
            lists: (0..3).map(|n| revocation_list("acme", &[], n + 1)).collect(),
            is_revoked: false,
            seq: 0,
            looked_at: 0,
            actions: 0,
            liar: None,
        }
    }

    // ---- Honest nodes.

    /// Two different members.
    fn pair(&mut self) -> (NodeKey, NodeKey) {
        let first = self.dice.below(self.members.len());
        let second = (first + 1 + self.dice.below(self.members.len() - 1)) % self.members.len();
        (self.members[first], self.members[second])
    }

    fn draw_honest(&mut self) -> Honest {
        let member = self.members[self.dice.below(self.members.len())];
        let router = self.routers[self.dice.below(self.routers.len())];
        match self.dice.below(100) {
            0..25 => Honest::NewTopic,
            25..55 => Honest::Publish,
            55..60 => Honest::Renew(member),
            60..68 => Honest::RestartMember(member),
            68..76 => Honest::RestartRouter(router),
            76..79 => Honest::Revoke,
            79..84 => Honest::Rotate,
            84..90 => Honest::Nothing(Duration::from_secs(130)),
            _ => Honest::Nothing(Duration::from_secs(10)),
        }
    }

    fn do_honestly(&mut self, what: Honest) {
        self.world.note(format!("honest: {what:?}"));
        match what {
            Honest::Nothing(time) => self.pass(time, true),
            Honest::NewTopic => self.share_new(),
            Honest::Publish => {
                for (owner, topic) in self.shares() {
                    self.publish(owner, &topic);
                }
                self.pass(TICK, true);
            }
            Honest::Renew(node) => {
                self.world.renew(node);
                self.pass(Duration::from_secs(5), true);
            }
            Honest::RestartMember(node) | Honest::RestartRouter(node) => {
                // Messages in flight to a stopping node need not arrive.
                self.pass(MESSAGE_MAX, true);
                self.world.restart(node);
                self.pass(GRACE, false);
                self.check_granted("an honest node was restarted");
            }
            Honest::Revoke => {
                if !std::mem::replace(&mut self.is_revoked, true) {
                    let thief = self.world.member(self.thief).clone();
                    let list = revocation_list("acme", &[thief], 7);
                    self.world.hand_crl(self.members[0], &list);
                    self.lists.push(list);
                    self.pass(Duration::from_secs(5), true);
                }
            }
            Honest::Rotate => {
                for (owner, topic) in self.shares() {
                    self.world.rotate(owner, &topic);
                }
                self.pass(Duration::from_secs(3), true);
            }
        }
    }

    fn shares(&self) -> BTreeSet<(NodeKey, String)> {
        self.uses.iter().map(|(_, owner, topic)| (*owner, topic.clone())).collect()
    }

    /// Shares a new topic of a member and checks that another gets it soon, so the owner's allowance is not used up.
    fn share_new(&mut self) {
        let (owner, user) = self.pair();
        let topic = format!("/t{}", self.topics);
        self.topics += 1;
        self.world.share(owner, &topic, Sharing::to(&[user]));
        self.world.use_topic(user, owner, &topic);
        let begin = self.world.elapsed();
        while self.world.status(user, owner, &topic) != Some(JoinStatus::Granted) {
            let waited = self.world.elapsed() - begin;
            assert!(waited < NEW_MAX, "{user:?} waits for {owner:?}:{topic} since {waited:?}");
            self.pass(TICK, true);
        }
        // The data path follows the grant.
        self.pass(ms(1000), true);
        self.uses.insert((user, owner, topic));
    }

    fn publish(&mut self, owner: NodeKey, topic: &str) {
        let id = self.world.publish(owner, topic);
        let users = self.uses.iter().filter(|(_, o, t)| (*o, t.as_str()) == (owner, topic)).map(|u| u.0);
        self.expected.insert(id, (users.collect(), self.world.elapsed() + MESSAGE_MAX));
    }

    // ---- The adversary.

    fn draw_hostile(&mut self) -> Hostile {
        let many = [1, 5, 40][self.dice.below(3)];
        match self.dice.below(100) {
            0..15 => Hostile::Replay(4 * many, self.dice.chance(50)),
            15..25 => Hostile::Siege(self.members[self.dice.below(self.members.len())]),
            25..32 => Hostile::ReplayPackets(many),
            32..37 => Hostile::Spoil,
            37..55 => Hostile::Pretend,
            55..61 => Hostile::Withhold,
            61..69 => Hostile::Release,
            69..72 => Hostile::BeHonest,
            72..79 => Hostile::Advertise(many),
            79..83 => Hostile::ClaimAll,
            83..88 => Hostile::Ask(many),
            88..93 => Hostile::Join(many),
            93..97 => Hostile::OldList,
            _ => Hostile::Restart,
        }
    }

    /// Tells a lie about direct paths.
    fn lie(&mut self) {
        let Some(liar) = &mut self.liar else { return };
        let (world, dice) = (&mut self.world, &mut liar.dice);
        let lie = match dice.below(10) {
            0..2 => Lie::Victims,
            2 => Lie::Bad,
            3 => Lie::Members,
            4 => Lie::OtherAttempts(dice.chance(50)),
            5..7 => Lie::Forge([0, 1, 10][dice.below(3)]),
            7 => Lie::Replay,
            8 => Lie::Dial,
            _ => Lie::Nothing,
        };
        world.note(format!("lie: {lie:?}"));
        self.actions += 1;
        match lie {
            Lie::Victims => {
                let mut lies = liar.lies.borrow_mut();
                let victims = PATH_CANDIDATES_MAX as u16;
                lies.victims = lies.victims.wrapping_add(victims);
                lies.candidates = (0..victims).map(|n| victim(lies.victims.wrapping_sub(n))).collect();
            }
            Lie::Bad => {
                let bad = BAD.map(|text| text.parse().expect("an address"));
                liar.lies.borrow_mut().candidates = bad.to_vec();
            }
            Lie::Members => {
                let addresses = self.members.iter().filter_map(|member| world.address(*member));
                liar.lies.borrow_mut().candidates = addresses.take(PATH_CANDIDATES_MAX).collect();
            }
            Lie::OtherAttempts(is_on) => liar.lies.borrow_mut().other_attempts = is_on,
            Lie::Forge(count) => liar.lies.borrow_mut().forged = count,
            Lie::Replay => {
                for _ in 0..5 {
                    let recorded = world.recorded_checks();
                    let Some(check) = recorded.get(dice.below(recorded.len().max(1))).cloned() else { break };
                    let from =
                        [None, Some(victim(dice.below(100) as u16)), check.reached.map(|(_, from)| from)];
                    world.inject_check(liar.node, from[dice.below(3)], check.to, check.datagram);
                }
            }
            Lie::Dial => {
                for member in &self.members {
                    for (from, peer) in world.admitted(*member) {
                        if peer != liar.node {
                            let has_link = world.dial_forged(liar.node, from, *member);
                            assert!(!has_link, "{member:?} takes the liar for {peer:?}");
                            liar.dials += 1;
                        }
                    }
                }
            }
            Lie::Nothing => *liar.lies.borrow_mut() = Lies::default(),
        }
        // A restart made it honest.
        let lies = liar.lies.clone();
        world.tamper_offers(liar.node, move |offer| {
            let lies = lies.borrow();
            let candidate =
                |address: &SocketAddr| PathCandidate { kind: CandidateKind::Host, place: (*address).into() };
            let candidates = match lies.candidates.as_slice() {
                [] => offer.candidates,
                named => named.iter().map(candidate).collect(),
            };
            PathOffer { attempt: offer.attempt ^ u64::from(lies.other_attempts), candidates, ..offer }
        });
        world.want_paths(liar.node, &self.members);
    }

    /// Checks the bytes that honest nodes sent to addresses that never answered. Returns those that victims got.
    fn check_bytes(&self) -> usize {
        let Some(liar) = &self.liar else { return 0 };
        let liar_id = self.world.identity(liar.node).node_id();
        let checks = self.world.recorded_checks();
        let mut all_to_victims = 0;
        for node in &self.members {
            let offers = |by_liar: bool| {
                let is_offer = |what: &What| match what {
                    What::Event(Event::PathOffered { peer, .. }) => !by_liar || *peer == liar_id,
                    _ => false,
                };
                let log = self.world.log().iter().filter(|l| l.node == *node && is_offer(&l.what));
                log.count() * PATH_OFFER_BYTES
            };
            let came = checks.iter().filter_map(|check| Some((check, check.reached?)));
            let came: Vec<_> = came.filter(|(_, (there, _))| there == node).collect();
            let bytes = |by_liar: bool| {
                let by = came.iter().filter(|(check, _)| !by_liar || check.from == liar.node);
                by.map(|(check, _)| check.datagram.len()).sum::<usize>()
            };
            let answered: BTreeSet<_> = came.iter().map(|(_, (_, from))| *from).collect();
            let sent = || checks.iter().filter(|check| check.from == *node);
            let sum = |is: &dyn Fn(SocketAddr) -> bool| {
                sent().filter(|check| is(check.to)).map(|check| check.datagram.len()).sum::<usize>()
            };
            let (to_victims, caused) = (sum(&is_victim), offers(true) + bytes(true));
            assert!(to_victims <= caused, "{node:?} sent victims {to_victims} bytes for {caused}");
            let (to_silent, caused) = (sum(&|to| !answered.contains(&to)), offers(false) + bytes(false));
            assert!(to_silent <= caused, "{node:?} sent {to_silent} bytes into silence for {caused}");
            assert!(!sent().any(|check| BAD.contains(&check.to.to_string().as_str())));
            all_to_victims += to_victims;
        }
        all_to_victims
    }

    /// Checks that honest pairs that exchange data have direct links in the end.
    fn check_direct(&mut self) {
        let uses = &self.uses;
        let lacks = |world: &World| {
            let lacks = |(user, owner, _): &&(NodeKey, NodeKey, String)| {
                world.lets_meet(*user, *owner, false) && !world.is_direct(*user, *owner)
            };
            uses.iter().find(lacks).cloned()
        };
        self.world.run_until(DIRECT_MAX, |world| lacks(world).is_none());
        assert_eq!(lacks(&self.world), None, "no direct link");
    }

    /// Returns a link of the adversary that is up. Links that are down are made again now and then.
    fn line(&mut self) -> Option<(NodeKey, NodeKey)> {
        if let Some(liar) = &mut self.liar
            && liar.dice.chance(20)
        {
            let is_linked = |member: &NodeKey| self.world.is_direct(liar.node, *member);
            let linked: Vec<_> = self.members.iter().copied().filter(is_linked).collect();
            if let Some(member) = liar.dice.pick(&linked) {
                return Some((liar.node, member));
            }
        }
        let (rogue, honest) = self.dice.pick(&self.attached)?;
        if self.world.is_linked(rogue, honest) {
            return Some((rogue, honest));
        }
        if self.dice.chance(20) && self.world.is_running(rogue) && self.world.is_running(honest) {
            self.world.rejoin(rogue, honest);
        }
        None
    }

    fn act(&mut self) {
        let Some((rogue, honest)) = self.line() else { return };
        let what = self.draw_hostile();
        self.world.note(format!("hostile: {rogue:?} to {honest:?}: {what:?}"));
        self.actions += 1;
        let frames = match what {
            Hostile::Replay(count, last) => (0..count).filter_map(|_| self.recorded(last)).collect(),
            Hostile::Siege(victim) => {
                self.siege = Some((rogue, honest, victim));
                vec![]
            }
            Hostile::ReplayPackets(count) => {
                self.replay_packets(rogue, honest, count);
                vec![]
            }
            Hostile::Spoil => self.recorded(false).map(spoilt).into_iter().collect(),
            Hostile::Pretend => (0..5).filter_map(|_| self.pretence()).collect(),
            Hostile::Withhold => {
                self.hold.borrow_mut().is_on = true;
                vec![]
            }
            Hostile::Release => {
                let held = std::mem::take(&mut self.hold.borrow_mut().frames);
                for (index, frame) in held.into_iter().rev() {
                    let (rogue, honest) = self.attached[index];
                    if self.world.is_linked(rogue, honest) {
                        self.world.inject(rogue, honest, &frame);
                    }
                }
                vec![]
            }
            Hostile::BeHonest => {
                self.siege = None;
                *self.hold.borrow_mut() = Hold::default();
                vec![]
            }
            Hostile::Advertise(count) => (0..count).map(|_| self.own_advert(rogue)).collect(),
            Hostile::ClaimAll => vec![self.own_link_state(rogue)],
            Hostile::Ask(count) => (0..count).map(|_| self.question()).collect(),
            Hostile::Join(count) => (0..count).filter_map(|_| self.join(rogue)).collect(),
            Hostile::OldList => vec![self.old_list()],
            Hostile::Restart => {
                self.world.restart(rogue);
                vec![]
            }
        };
        for frame in frames {
            if self.world.is_linked(rogue, honest) {
                self.world.inject(rogue, honest, &frame);
            }
        }
    }

    /// Continues a siege.
    fn besiege(&mut self) {
        for captured in &self.world.captured()[self.announced_to..] {
            let is_announcement =
                matches!(captured.frame, Control::Advert { .. } | Control::LinkState { .. });
            if is_announcement && self.members.contains(&captured.from) {
                self.announced.entry(captured.from).or_default().push(captured.frame.clone());
            }
        }
        self.announced_to = self.world.captured().len();
        let Some((rogue, honest, victim)) = self.siege else { return };
        let announced = self.announced.get(&victim).map(Vec::as_slice).unwrap_or_default();
        for _ in 0..SIEGE_FRAMES {
            if let Some(frame) = announced.get(self.dice.below(announced.len().max(1)))
                && self.world.is_linked(rogue, honest)
            {
                self.world.inject(rogue, honest, frame);
            }
        }
    }

    /// Returns a recorded signed frame, one of the last or any.
    fn recorded(&mut self, last: bool) -> Option<Control> {
        let all = self.world.captured();
        let from = if last { all.len().saturating_sub(200) } else { 0 };
        for _ in 0..20 {
            let frame = &all.get(from + self.dice.below((all.len() - from).max(1)))?.frame;
            let is_signed = matches!(
                frame,
                Control::Advert { .. }
                    | Control::LinkState { .. }
                    | Control::Join { .. }
                    | Control::Answer { .. }
                    | Control::Crl { .. }
            );
            if is_signed {
                return Some(frame.clone());
            }
        }
        None
    }

    fn replay_packets(&mut self, rogue: NodeKey, honest: NodeKey, count: usize) {
        for _ in 0..count {
            let all = self.world.captured_packets();
            let Some(CapturedPacket { packet, .. }) = all.get(self.dice.below(all.len().max(1))) else {
                return;
            };
            let mut packet = packet.clone();
            packet.header.hops = 30;
            if self.dice.chance(20) {
                packet.header.seq += 1;
            }
            if self.world.is_linked(rogue, honest) {
                self.world.inject_packet(rogue, honest, packet);
            }
        }
    }

    /// Returns an unsigned frame about names or sinks of others.
    fn pretence(&mut self) -> Option<Control> {
        let uses: Vec<_> = self.uses.iter().cloned().collect();
        let (_, owner, topic) = uses.get(self.dice.below(uses.len().max(1)))?.clone();
        let catalogue = self.dice.chance(30);
        let name = if catalogue { self.world.catalogue_name(owner) } else { self.world.name(owner, &topic) };
        let sinks: Vec<_> =
            self.world.granted_sinks(owner, &topic).into_iter().map(|(sink, _)| sink).collect();
        let sink = self.dice.pick(&sinks)?;
        Some(match self.dice.below(10) {
            0 => Control::Leave { name, sink },
            1 => Control::Reject { name, sink, reason: RejectReason::Revoked },
            2 => Control::Reject { name, sink, reason: RejectReason::RouteLost },
            3 => Control::Reroute { name, sink },
            4 => Control::Unreach { names: vec![name] },
            5 => Control::Ack { name, sink, serial: u64::MAX },
            6 => Control::Recover(Recover { name, sink, source: SourceId([1; 16]), from: 0, to: u64::MAX }),
            7 => Control::Uninterest { names: vec![name] },
            8 => Control::Interest { names: vec![name] },
            _ => Control::Query { id: self.dice.number(), hops: 1, names: vec![name] },
        })
    }

    fn number(&mut self) -> u64 {
        self.seq += 1;
        match self.dice.below(10) {
            0 => u64::MAX,
            1 => 0,
            2 => self.world.now().unix.0 + 86_400_000,
            _ => self.world.now().unix.0 + self.seq,
        }
    }

    fn own_advert(&mut self, rogue: NodeKey) -> Control {
        let seq = self.number();
        let identity = identity(self.world.member(rogue));
        let count = [1, 3, 256][self.dice.below(3)];
        let blinds = (0..count).map(|n| {
            let mut blind = [7; 32];
            blind[..8].copy_from_slice(&(self.seq + n % 40).to_be_bytes());
            Blind(blind)
        });
        let body = AdvertBody {
            chain: identity.chain_bytes(),
            seq,
            issued_at: self.world.now().unix,
            lease_ms: 300_000,
            withdraw: self.dice.chance(30),
            blinds: blinds.collect::<BTreeSet<_>>().into_iter().collect(),
        };
        Control::Advert { cost: 0, signed: identity.sign_advert(&body) }
    }

    fn own_link_state(&mut self, rogue: NodeKey) -> Control {
        let seq = self.number();
        let identity = identity(self.world.member(rogue));
        let id = |node: &NodeKey| self.world.identity(*node).node_id();
        let routers: BTreeSet<_> = self.routers.iter().map(id).collect();
        let attached: BTreeSet<_> = self.members.iter().map(|node| id(node).tag()).collect();
        let body = LinkStateBody {
            chain: identity.chain_bytes(),
            seq,
            issued_at: self.world.now().unix,
            lease_ms: 300_000,
            floor: 0,
            transit: true,
            routers: routers.into_iter().map(|node| Adjacency { node, cost: 0 }).collect(),
            attached: attached.into_iter().collect(),
        };
        Control::LinkState { signed: identity.sign_link_state(&body) }
    }

    fn question(&mut self) -> Control {
        let names = (0..[1, 100][self.dice.below(2)])
            .map(|_| {
                let mut name = [0; 32];
                name[..8].copy_from_slice(&self.dice.number().to_be_bytes());
                Name(name)
            })
            .collect();
        match self.dice.chance(50) {
            true => Control::Query { id: self.dice.number(), hops: 0, names },
            false => Control::Interest { names },
        }
    }

    /// Returns a join of its own for a topic that it may not have.
    fn join(&mut self, rogue: NodeKey) -> Option<Control> {
        let uses: Vec<_> = self.uses.iter().cloned().collect();
        let (_, owner, topic) = uses.get(self.dice.below(uses.len().max(1)))?.clone();
        let identity = identity(self.world.member(rogue));
        let catalogue = self.dice.chance(50);
        let mut sink = [0; 16];
        sink[..8].copy_from_slice(&self.dice.number().to_be_bytes());
        let body = JoinBody {
            name: if catalogue { self.world.catalogue_name(owner) } else { self.world.name(owner, &topic) },
            sink: SinkId(sink),
            request: Request::Subscribe { describe: false },
            issued_at: self.world.now().unix,
            chain: identity.chain_bytes(),
            reply_key: ReplyKey::generate(Kem::default()).public().clone(),
        };
        Some(Control::Join { signed: identity.sign_join(&body) })
    }

    fn old_list(&mut self) -> Control {
        let members: Vec<_> = self.members.iter().map(|node| self.world.member(*node).clone()).collect();
        let der = match self.dice.below(3) {
            0 => serial_list("umbrella", &[Member { fleet: "umbrella".into(), ..Member::new("x") }], 9),
            1 => {
                // Its own CA revokes nodes of the same names.
                let same: Vec<_> =
                    members.into_iter().map(|m| Member { fleet: "umbrella".into(), ..m }).collect();
                revocation_list("umbrella", &same, 9)
            }
            _ => self.lists[self.dice.below(self.lists.len())].clone(),
        };
        Control::Crl { der }
    }

    // ---- Invariants.

    /// Lets time pass while the adversary acts. Checks the invariants, unless an honest node has just gone away.
    fn pass(&mut self, time: Duration, strictly: bool) {
        let end = self.world.elapsed() + time;
        while self.world.elapsed() < end {
            if self.dice.chance(60) {
                self.act();
            }
            if self.liar.as_mut().is_some_and(|liar| liar.dice.chance(30)) {
                self.lie();
            }
            self.besiege();
            self.world.run(TICK.min(end - self.world.elapsed()));
            if strictly {
                self.check_granted("nothing happened to an honest node");
            }
            self.check_log();
            self.check_messages();
        }
    }

    fn check_granted(&self, when: &str) {
        for (user, owner, topic) in &self.uses {
            let status = self.world.status(*user, *owner, topic);
            assert!(
                status == Some(JoinStatus::Granted) && self.world.granted(*owner, topic).contains(user),
                "{when}, and {user:?} stands at {status:?} with {owner:?}:{topic}"
            );
        }
        if self.is_revoked {
            for node in self.members.iter().chain(&self.routers) {
                assert!(!self.world.believes(*node, self.thief), "{node:?} believes the thief again");
            }
        }
        for node in &self.members {
            for other in self.members.iter().chain(&self.routers) {
                assert!(self.world.believes(*node, *other), "{node:?} does not believe {other:?}");
            }
        }
    }

    /// Checks that no honest node refuses another for lack of an allowance or as a liar.
    fn check_log(&mut self) {
        let honest: BTreeSet<_> = self
            .members
            .iter()
            .chain(&self.routers)
            .map(|node| self.world.identity(*node).node_id())
            .collect();
        let log = self.world.log();
        for logged in &log[self.looked_at..] {
            if self.rogues.contains(&logged.node) || logged.node == self.thief {
                continue;
            }
            let What::RouterDrop(dropped) = &logged.what else { continue };
            if !dropped.peer.is_some_and(|peer| honest.contains(&peer)) {
                continue;
            }
            let fine = match &dropped.reason {
                // The frame crossed the news of a revocation, or is of a fleet that this node does not know.
                DropReason::NotVerified {
                    why: SignedError::Cert(CertError::Revoked { .. } | CertError::UnknownIssuer),
                    ..
                } => true,
                DropReason::Crl(why) => !why.is_forgery(),
                reason => !reason.is_suspicious(),
            };
            assert!(fine, "{logged:?}");
        }
        self.looked_at = log.len();
    }

    /// Checks that reliable messages arrive in time and once.
    fn check_messages(&mut self) {
        let now = self.world.elapsed();
        let due: Vec<_> =
            self.expected.iter().filter(|(_, (_, until))| *until <= now).map(|(id, _)| *id).collect();
        for id in due {
            let Some((users, _)) = self.expected.remove(&id) else { continue };
            let received: Vec<_> =
                self.world.all_received().iter().filter(|r| r.id == id).map(|r| r.node).collect();
            let once: BTreeSet<_> = received.iter().copied().collect();
            let published = &self.world.all_published()[id.0 as usize];
            assert!(
                once == users && received.len() == users.len(),
                "{published:?} reached {received:?}, not {users:?}"
            );
        }
    }

    fn all(&mut self) {
        self.pass(Duration::from_secs(5), true);
        for _ in 0..2 {
            self.share_new();
        }
        for _ in 0..self.dice.within(10..=25) {
            let honest = self.draw_honest();
            self.do_honestly(honest);
        }
        self.pass(MESSAGE_MAX + ms(1000), true);
        assert!(self.expected.is_empty());
        assert!(self.actions > 0, "the adversary did nothing");
    }
}

/// Returns the frame with one bit of body or signature changed.
fn spoilt(frame: Control) -> Control {
    let spoil = |signed: SignedBody| {
        let mut body = signed.body.to_vec();
        let at = body.len() / 2;
        body[at] ^= 1;
        SignedBody { body: body.into(), ..signed }
    };
    match frame {
        Control::Advert { cost, signed } => Control::Advert { cost, signed: spoil(signed) },
        Control::LinkState { signed } => Control::LinkState { signed: spoil(signed) },
        Control::Join { signed } => Control::Join { signed: spoil(signed) },
        Control::Answer { signed } => Control::Answer { signed: spoil(signed) },
        frame => frame,
    }
}

#[test]
fn an_adversary_takes_nothing_from_honest_nodes_with_an_honest_way() {
    let actions = run_seeds(
        COMMITTED,
        Run::new,
        |run| {
            run.all();
            run.actions
        },
        |run| run.world.trace(),
    );
    eprintln!("{} hostile actions", actions.iter().sum::<usize>());
}

#[test]
fn a_lying_member_makes_nobody_send_more_than_it_did_and_no_link_in_anothers_place() {
    let results = run_seeds(
        COMMITTED_NATS,
        Run::with_nats,
        |run| {
            run.all();
            let to_victims = run.check_bytes();
            run.check_direct();
            let refusals = run.members.iter().map(|node| run.world.direct_refusals(*node));
            let refused = refusals.map(|(withheld, candidates)| withheld + candidates).sum::<u64>();
            (to_victims, refused, run.liar.as_ref().map_or(0, |liar| liar.dials))
        },
        |run| run.world.trace(),
    );
    let to_victims: usize = results.iter().map(|(bytes, ..)| bytes).sum();
    let refused: u64 = results.iter().map(|(_, refused, _)| refused).sum();
    let dials: usize = results.iter().map(|(.., dials)| dials).sum();
    eprintln!("{to_victims} bytes to victims, {refused} refusals, {dials} dials");
    assert!(to_victims > 0 && refused > 0 && dials > 0, "the adversary did nothing");
}
