//! Checks the tree protocol in every interleaving of joins, answers, leaves, rejects and reroutes with changes of
//! next hops and links, within bounds.
//!
//! This is a model of the protocol of `docs/spec/routing.md`, not the router machine: it proves properties of the
//! protocol and not of the code. `docs/spec/tree-model.md` describes the model, its properties and its omissions. `make
//! model-check` runs the larger bounds.

#![allow(clippy::print_stdout, reason = "how much was looked at is for who runs it with --nocapture")]

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Debug, Formatter};

use stateright::{Checker, Expectation, HasDiscoveries, Model, Property};

type Node = u8;
type Wire = u8;
type Id = u8;

/// The node of the owner, to which all trees lead.
const OWNER: Node = 0;
/// Additional requests of each sink after the state settles. They are more than it needs, so a sink that uses them up
/// makes no progress.
const SETTLED_REQUESTS: u8 = 4;

const NO_GRANTED_CIRCLE: &str = "granted branches, whatever is fed to whom, are no circle";
const NO_CIRCLE: &str = "data does not circulate";
const FROM_OWNER: &str = "a branch is granted from the owner down";
const NO_GAP: &str = "a sink that is granted hears the owner";
const ONCE: &str = "an id is granted once, and a sink over one id";
const NOT_DOWN: &str = "no branch leads over a wire that its router saw go down";
const IN_THE_END: &str = "in the end each sink hears the owner, and nothing else is left";
const NOT_WAITING: &str = "no branch waits for what will not come";

/// Where a branch leads from a router.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Port {
    /// To the owner, at its node; to a sink, at others.
    Local,
    Over(Wire),
}

impl Debug for Port {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Port::Local => f.write_str("local"),
            Port::Over(wire) => write!(f, "w{wire}"),
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Stage {
    Pending,
    Granted,
    Draining,
}

#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
struct Branch {
    at: Node,
    id: Id,
    down: Port,
    up: Port,
    stage: Stage,
}

impl Debug for Branch {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "n{}: #{} {:?}←{:?} {:?}", self.at, self.id, self.down, self.up, self.stage)
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
enum Kind {
    Join,
    Answer,
    Leave,
    Reject,
    Reroute,
}

/// A control frame in flight. Frames over one wire to one node stay in order.
#[derive(Clone, PartialEq, Eq, Hash)]
struct Frame {
    wire: Wire,
    to: Node,
    kind: Kind,
    id: Id,
}

impl Debug for Frame {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        write!(f, "{:?}#{} over w{} to n{}", self.kind, self.id, self.wire, self.to)
    }
}

/// The state of a wire, which comes up once and goes down once. Two nodes that link again use another wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
enum WireState {
    Fresh,
    Up,
    /// The wire is down. The flags say which ends have seen that.
    Down([bool; 2]),
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
struct Sink {
    /// The present request, and its grant.
    now: Option<(Id, bool)>,
    /// The previous request, on which the sink stays until the present one is granted.
    before: Option<Id>,
    /// The sink has left.
    stopped: bool,
}

impl Sink {
    fn granted(&self) -> bool {
        matches!(self.now, Some((_, true)))
    }
}

/// The events that may still happen before the state settles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
struct Budget {
    hops: u8,
    cuts: u8,
    timeouts: u8,
    requests: u8,
    stops: u8,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
struct State {
    /// In the order of node and id.
    branches: Vec<Branch>,
    /// In the order of wire and direction, then of sending.
    frames: Vec<Frame>,
    wires: Vec<WireState>,
    /// Each router's next hop towards the owner.
    hops: Vec<Option<Port>>,
    sinks: Vec<Sink>,
    /// The sink for which each id was made.
    ids: Vec<u8>,
    /// The feeding wire of each port at each node.
    fed: BTreeMap<(Node, Port), Port>,
    left: Budget,
    /// No more changes, but next hops become right.
    settled: bool,
    /// An id was granted for a second time.
    granted_again: bool,
}

/// The rule by which a router passes on data.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum FeedRule {
    /// Data from any granted or draining branch.
    EveryBranch,
    /// Data from any granted or draining branch, except over a wire that is itself the upstream of a branch.
    NeverUp,
    /// Each port gets data from the upstream of its branch that was granted last.
    LastGranted,
    /// Each port gets data from the upstream of its branch granted last. When that branch ends, it falls back to a
    /// remaining one.
    FallBack,
}

/// A rule of the protocol that is broken on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Broken {
    /// A change of the next hop leaves branches as they are.
    NoCutOnHopChange,
    /// A join is accepted although the sink has a branch.
    JoinTwice,
    /// An answer is accepted from any wire.
    AnswerFromAnywhere,
    /// An answer without a branch is dropped without a leave.
    NoLeaveBack,
    /// An answer for a branch with another upstream is dropped without a leave.
    NoLeaveBackFromBranch,
    /// A leave is accepted from any wire.
    LeaveFromAnywhere,
    /// A reject is accepted from any wire.
    RejectFromAnywhere,
    /// Nodes behind a wire get no notice when it goes down.
    NoRejectOnDown,
    /// The owner gets no notice when a wire goes down.
    NoLeaveOnDown,
    /// Branches stay on a wire that is down.
    KeepOnDown,
    /// A pending branch outlives its next hop.
    PendingOutlivesHop,
    /// A change of the next hop removes granted branches at once.
    NoDraining,
    /// Nothing ends a branch that drains: it has no deadline, and the sink does not leave it.
    NoEnd,
    /// A branch that is removed at its deadline sends no leave upwards.
    NoLeaveOnDeadline,
    /// The sink asks again with its old id.
    SameIdAgain,
    /// Frames over one wire overtake each other.
    FramesOvertake,
}

#[derive(Clone, Debug)]
struct Tree {
    nodes: Node,
    /// Ends, and whether it is up at the beginning.
    wires: Vec<(Node, Node, bool)>,
    sinks: Vec<Node>,
    /// Next hops at the beginning, by wire; those of shortest paths where it is empty.
    hops: Vec<Wire>,
    /// Number of sinks that are granted at the beginning.
    warm: usize,
    /// Nodes whose next hops change; all but the owner's, if empty.
    movers: Vec<Node>,
    budget: Budget,
    /// The events are so few that no sink may miss data.
    gapless: bool,
    /// Changes may end, so that the settled state can be checked.
    settles: bool,
    feed: FeedRule,
    broken: Option<Broken>,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Action {
    Ask(u8),
    Deliver(Frame),
    Hop(Node, Option<Port>),
    Cut(Wire),
    SeeDown(Wire, Node),
    Raise(Wire),
    /// A pending or draining branch has waited long enough.
    Expire(Node, Id),
    /// The sink leaves.
    Stop(u8),
    Settle,
    /// The router's view becomes right.
    Correct(Node),
}

impl State {
    fn branch(&self, at: Node, id: Id) -> Option<usize> {
        self.branches.iter().position(|b| b.at == at && b.id == id)
    }
}

impl Tree {
    fn is_broken(&self, rule: Broken) -> bool {
        self.broken == Some(rule)
    }

    fn far_end(&self, wire: Wire, node: Node) -> Node {
        let (a, b, _) = self.wires[usize::from(wire)];
        if a == node { b } else { a }
    }

    fn end(&self, wire: Wire, node: Node) -> usize {
        usize::from(self.wires[usize::from(wire)].0 != node)
    }

    /// Whether the node takes the wire for up.
    fn seems_up(&self, s: &State, wire: Wire, node: Node) -> bool {
        let (a, b, _) = self.wires[usize::from(wire)];
        (a == node || b == node)
            && match s.wires[usize::from(wire)] {
                WireState::Fresh => false,
                WireState::Up => true,
                WireState::Down(seen) => !seen[self.end(wire, node)],
            }
    }

    fn send(&self, s: &mut State, from: Node, port: Port, kind: Kind, id: Id) {
        match port {
            Port::Over(wire) => {
                if s.wires[usize::from(wire)] == WireState::Up {
                    let frame = Frame { wire, to: self.far_end(wire, from), kind, id };
                    let behind = s.frames.partition_point(|f| (f.wire, f.to) <= (frame.wire, frame.to));
                    s.frames.insert(behind, frame);
                }
            }
            Port::Local if from == OWNER => {
                // The owner has no state beside the branches of its own router.
                if kind == Kind::Join {
                    self.receive(s, OWNER, Port::Local, Kind::Answer, id);
                }
            }
            Port::Local => self.sink_receive(s, from, kind, id),
        }
    }

    fn receive(&self, s: &mut State, at: Node, from: Port, kind: Kind, id: Id) {
        let found = s.branch(at, id);
        match kind {
            Kind::Join => match s.hops[usize::from(at)] {
                Some(up) if up != from && (found.is_none() || self.is_broken(Broken::JoinTwice)) => {
                    if let Some(old) = found {
                        s.branches.remove(old);
                    }
                    let branch = Branch { at, id, down: from, up, stage: Stage::Pending };
                    let place = s.branches.partition_point(|b| (b.at, b.id) < (at, id));
                    s.branches.insert(place, branch);
                    self.send(s, at, up, Kind::Join, id);
                }
                _ => self.send(s, at, from, Kind::Reject, id),
            },
            Kind::Answer => match found {
                Some(i) if s.branches[i].up == from || self.is_broken(Broken::AnswerFromAnywhere) => {
                    let branch = &mut s.branches[i];
                    let (down, up) = (branch.down, branch.up);
                    s.granted_again |= branch.stage != Stage::Pending;
                    if branch.stage == Stage::Pending {
                        branch.stage = Stage::Granted;
                        s.fed.insert((at, down), up);
                    }
                    self.send(s, at, down, Kind::Answer, id);
                }
                Some(_) if self.is_broken(Broken::NoLeaveBackFromBranch) => {}
                None if self.is_broken(Broken::NoLeaveBack) => {}
                _ => self.send(s, at, from, Kind::Leave, id),
            },
            Kind::Leave => {
                if let Some(i) = found
                    && (s.branches[i].down == from || self.is_broken(Broken::LeaveFromAnywhere))
                {
                    self.remove(s, i, false, true);
                }
            }
            Kind::Reject => {
                if let Some(i) = found
                    && (s.branches[i].up == from || self.is_broken(Broken::RejectFromAnywhere))
                {
                    self.remove(s, i, true, false);
                }
            }
            Kind::Reroute => {
                if let Some(i) = found
                    && s.branches[i].up == from
                {
                    let down = s.branches[i].down;
                    self.send(s, at, down, Kind::Reroute, id);
                }
            }
        }
    }

    fn remove(&self, s: &mut State, index: usize, reject: bool, leave: bool) {
        let Branch { at, id, down, up, .. } = s.branches.remove(index);
        self.settle_feed(s, at, down);
        if reject {
            self.send(s, at, down, Kind::Reject, id);
        }
        if leave {
            self.send(s, at, up, Kind::Leave, id);
        }
    }

    fn settle_feed(&self, s: &mut State, at: Node, down: Port) {
        let Some(&up) = s.fed.get(&(at, down)) else { return };
        let feeding = |b: &&Branch| b.at == at && b.down == down && b.stage != Stage::Pending;
        if !s.branches.iter().any(|b| feeding(&b)) {
            s.fed.remove(&(at, down));
        } else if self.feed == FeedRule::FallBack
            && !s.branches.iter().filter(feeding).any(|b| b.up == up)
            && let Some(other) = s.branches.iter().rfind(feeding)
        {
            s.fed.insert((at, down), other.up);
        }
    }

    fn sink_receive(&self, s: &mut State, at: Node, kind: Kind, id: Id) {
        let n = usize::from(s.ids[usize::from(id)]);
        match kind {
            Kind::Answer => match s.sinks[n].now {
                Some((now, granted)) if now == id => {
                    s.granted_again |= granted;
                    s.sinks[n].now = Some((id, true));
                    if let Some(before) = s.sinks[n].before.take()
                        && !self.is_broken(Broken::NoEnd)
                    {
                        self.receive(s, at, Port::Local, Kind::Leave, before);
                    }
                }
                _ => self.receive(s, at, Port::Local, Kind::Leave, id),
            },
            Kind::Reject => {
                let sink = &mut s.sinks[n];
                if sink.before == Some(id) {
                    sink.before = None;
                }
                if matches!(sink.now, Some((now, _)) if now == id) {
                    sink.now = None;
                }
            }
            Kind::Reroute => {
                if s.sinks[n].now == Some((id, true)) {
                    s.sinks[n].now = None;
                    s.sinks[n].before = Some(id);
                    self.ask(s, n);
                }
            }
            Kind::Join | Kind::Leave => unreachable!("a sink is sent no {kind:?}"),
        }
    }

    fn ask(&self, s: &mut State, sink: usize) {
        let Some(left) = s.left.requests.checked_sub(1) else { return };
        s.left.requests = left;
        let again = s.ids.iter().rposition(|&of| usize::from(of) == sink);
        let id = match again {
            Some(id) if self.is_broken(Broken::SameIdAgain) => id,
            _ => {
                s.ids.push(sink as u8);
                s.ids.len() - 1
            }
        } as Id;
        s.sinks[sink].now = Some((id, false));
        self.receive(s, self.sinks[sink], Port::Local, Kind::Join, id);
    }

    fn change_hop(&self, s: &mut State, at: Node, hop: Option<Port>) {
        s.hops[usize::from(at)] = hop;
        if self.is_broken(Broken::NoCutOnHopChange) {
            return;
        }
        let moved: Vec<(Id, Stage)> =
            s.branches.iter().filter(|b| b.at == at && Some(b.up) != hop).map(|b| (b.id, b.stage)).collect();
        for (id, stage) in moved {
            // The removal of another branch may have removed this one too.
            let Some(i) = s.branch(at, id) else { continue };
            match stage {
                Stage::Pending if self.is_broken(Broken::PendingOutlivesHop) => {}
                Stage::Pending => self.remove(s, i, true, true),
                Stage::Granted if self.is_broken(Broken::NoDraining) => self.remove(s, i, true, true),
                Stage::Granted => {
                    s.branches[i].stage = Stage::Draining;
                    let down = s.branches[i].down;
                    self.send(s, at, down, Kind::Reroute, id);
                }
                Stage::Draining => {}
            }
        }
    }

    fn see_down(&self, s: &mut State, wire: Wire, at: Node) {
        if let WireState::Down(seen) = &mut s.wires[usize::from(wire)] {
            seen[self.end(wire, at)] = true;
        }
        let gone = Port::Over(wire);
        if !self.is_broken(Broken::KeepOnDown) {
            let on_it = |b: &Branch| b.at == at && (b.up == gone || b.down == gone);
            while let Some(i) = s.branches.iter().position(on_it) {
                let up_gone = s.branches[i].up == gone;
                let reject = up_gone && !self.is_broken(Broken::NoRejectOnDown);
                let leave = !up_gone && !self.is_broken(Broken::NoLeaveOnDown);
                self.remove(s, i, reject, leave);
            }
        }
        if s.hops[usize::from(at)] == Some(gone) {
            self.change_hop(s, at, None);
        }
    }

    /// Returns the next hops of the tree of shortest paths, with the lowest wire among equals.
    fn right_hops(&self, s: &State) -> Vec<Option<Port>> {
        let mut hops = vec![None; usize::from(self.nodes)];
        hops[usize::from(OWNER)] = Some(Port::Local);
        let mut reached = vec![OWNER];
        let mut next = 0;
        while let Some(&node) = reached.get(next) {
            next += 1;
            for (wire, &(a, b, _)) in self.wires.iter().enumerate() {
                if (a == node || b == node) && s.wires[wire] == WireState::Up {
                    let far = self.far_end(wire as Wire, node);
                    if hops[usize::from(far)].is_none() {
                        hops[usize::from(far)] = Some(Port::Over(wire as Wire));
                        reached.push(far);
                    }
                }
            }
        }
        hops
    }

    /// Returns `true` if no frame is in flight and all routers know the present topology.
    fn silent(&self, s: &State) -> bool {
        s.frames.is_empty()
            && s.hops == self.right_hops(s)
            && s.wires.iter().all(|w| !matches!(w, WireState::Down(seen) if seen.contains(&false)))
    }

    /// Returns `true` if data goes over the branch.
    fn flows(&self, s: &State, b: &Branch) -> bool {
        b.stage != Stage::Pending
            && match self.feed {
                _ if b.down == Port::Local => true,
                FeedRule::EveryBranch => true,
                FeedRule::NeverUp => !s.branches.iter().any(|other| other.at == b.at && other.up == b.down),
                FeedRule::LastGranted | FeedRule::FallBack => s.fed.get(&(b.at, b.down)) == Some(&b.up),
            }
    }

    /// Returns `true` if data comes from the owner to the port in at most so many steps.
    fn reaches(&self, s: &State, at: Node, down: Port, steps: Node) -> bool {
        steps > 0
            && s.branches.iter().any(|b| {
                b.at == at
                    && b.down == down
                    && self.flows(s, b)
                    && match b.up {
                        Port::Local => true,
                        Port::Over(wire) => self.reaches(s, self.far_end(wire, at), b.up, steps - 1),
                    }
            })
    }

    /// Returns `true` if the branch agrees with its other end, or a frame that corrects it is in flight.
    fn continues(&self, s: &State, b: &Branch) -> bool {
        let Port::Over(wire) = b.up else { return true };
        let far = self.far_end(wire, b.at);
        s.wires[usize::from(wire)] != WireState::Up
            || s.branches.iter().any(|above| {
                above.at == far && above.id == b.id && above.down == b.up && above.stage != Stage::Pending
            })
            || s.frames.contains(&Frame { wire, to: b.at, kind: Kind::Reject, id: b.id })
    }

    /// Returns `true` if data can loop over the branches that count.
    fn circle(&self, s: &State, counts: impl Fn(&Branch) -> bool) -> bool {
        // From a wire and the node that it ends at, to those that the node sends on to.
        let mut onward: BTreeMap<(Wire, Node), BTreeSet<(Wire, Node)>> = BTreeMap::new();
        for b in s.branches.iter().filter(|b| counts(b)) {
            let (Port::Over(up), Port::Over(down)) = (b.up, b.down) else { continue };
            let alive = |wire: Wire| s.wires[usize::from(wire)] == WireState::Up;
            if alive(up) && alive(down) {
                onward.entry((up, b.at)).or_default().insert((down, self.far_end(down, b.at)));
            }
        }
        // A node without a next hop is on no circle.
        loop {
            let before = onward.len();
            let begins: BTreeSet<(Wire, Node)> = onward.keys().copied().collect();
            onward.retain(|_, to| to.iter().any(|t| begins.contains(t)));
            if onward.len() == before {
                return before > 0;
            }
        }
    }

    /// Returns `true` if the sink hears the owner: it is granted, with granted branches on the whole path.
    fn hears(&self, s: &State, sink: usize) -> bool {
        let Some((id, true)) = s.sinks[sink].now else { return false };
        let mut at = self.sinks[sink];
        let mut down = Port::Local;
        for _ in 0..self.nodes {
            let Some(i) = s.branch(at, id) else { return false };
            let b = &s.branches[i];
            if b.stage != Stage::Granted || b.down != down || s.fed.get(&(at, down)) != Some(&b.up) {
                return false;
            }
            match b.up {
                Port::Local => return at == OWNER,
                Port::Over(wire) => {
                    at = self.far_end(wire, at);
                    down = b.up;
                }
            }
        }
        false
    }

    /// Checks a state in which no event is left.
    fn complete(&self, s: &State) -> bool {
        let hops = self.right_hops(s);
        let mut wanted = 0;
        for (n, &at) in self.sinks.iter().enumerate() {
            if s.sinks[n].stopped || hops[usize::from(at)].is_none() {
                if s.sinks[n].now.is_some() || s.sinks[n].before.is_some() {
                    return false;
                }
                continue;
            }
            if !self.hears(s, n) || s.sinks[n].before.is_some() {
                return false;
            }
            let mut node = at;
            wanted += 1;
            while let Some(Port::Over(wire)) = hops[usize::from(node)] {
                node = self.far_end(wire, node);
                wanted += 1;
            }
        }
        // Each of the sinks' branches is as it should be; so if there are no more, there are no others.
        s.branches.len() == wanted
    }

    fn actions_of(&self, s: &State) -> Vec<Action> {
        let mut actions = Vec::new();
        self.actions(s, &mut actions);
        actions
    }
}

impl Model for Tree {
    type State = State;
    type Action = Action;

    fn init_states(&self) -> Vec<State> {
        let up = |&(_, _, up): &(Node, Node, bool)| if up { WireState::Up } else { WireState::Fresh };
        let mut s = State {
            branches: Vec::new(),
            frames: Vec::new(),
            wires: self.wires.iter().map(up).collect(),
            hops: Vec::new(),
            sinks: vec![Sink::default(); self.sinks.len()],
            ids: Vec::new(),
            fed: BTreeMap::new(),
            left: self.budget,
            settled: false,
            granted_again: false,
        };
        s.hops = self.right_hops(&s);
        for (hop, &wire) in s.hops.iter_mut().skip(1).zip(&self.hops) {
            *hop = Some(Port::Over(wire));
        }
        s.left.requests = self.warm as u8;
        for sink in 0..self.warm {
            self.ask(&mut s, sink);
            while let Some(Frame { wire, to, kind, id }) = s.frames.first().cloned() {
                s.frames.remove(0);
                self.receive(&mut s, to, Port::Over(wire), kind, id);
            }
            assert!(self.hears(&s, sink), "it begins warm");
        }
        s.left.requests = self.budget.requests;
        vec![s]
    }

    fn actions(&self, s: &State, actions: &mut Vec<Action>) {
        let silent = s.settled && self.silent(s);
        for (i, f) in s.frames.iter().enumerate() {
            let first = i == 0 || (s.frames[i - 1].wire, s.frames[i - 1].to) != (f.wire, f.to);
            if first || self.is_broken(Broken::FramesOvertake) {
                actions.push(Action::Deliver(f.clone()));
            }
        }
        for (n, sink) in s.sinks.iter().enumerate() {
            let way = s.hops[usize::from(self.sinks[n])].is_some();
            if !sink.stopped && s.left.stops > 0 && !s.settled {
                actions.push(Action::Stop(n as u8));
            }
            if !sink.stopped && sink.now.is_none() && way && s.left.requests > 0 && (silent || !s.settled) {
                actions.push(Action::Ask(n as u8));
            }
        }
        for (wire, &(a, b, _)) in self.wires.iter().enumerate() {
            match s.wires[wire] {
                WireState::Fresh if !s.settled => actions.push(Action::Raise(wire as Wire)),
                WireState::Up if !s.settled && s.left.cuts > 0 => actions.push(Action::Cut(wire as Wire)),
                WireState::Fresh | WireState::Up => {}
                WireState::Down(seen) => {
                    for (end, node) in [a, b].into_iter().enumerate() {
                        if !seen[end] {
                            actions.push(Action::SeeDown(wire as Wire, node));
                        }
                    }
                }
            }
        }
        if silent || (!s.settled && s.left.timeouts > 0) {
            for b in &s.branches {
                let ends = match b.stage {
                    Stage::Pending => true,
                    Stage::Granted => false,
                    Stage::Draining => !self.is_broken(Broken::NoEnd),
                };
                if ends {
                    actions.push(Action::Expire(b.at, b.id));
                }
            }
        }
        if s.settled {
            for (node, hop) in (0..self.nodes).zip(self.right_hops(s)) {
                if s.hops[usize::from(node)] != hop {
                    actions.push(Action::Correct(node));
                }
            }
            return;
        }
        if s.left.hops > 0 {
            for node in 1..self.nodes {
                if !self.movers.is_empty() && !self.movers.contains(&node) {
                    continue;
                }
                let wires = (0..self.wires.len() as Wire).filter(|&w| self.seems_up(s, w, node));
                for hop in std::iter::once(None).chain(wires.map(|w| Some(Port::Over(w)))) {
                    if s.hops[usize::from(node)] != hop {
                        actions.push(Action::Hop(node, hop));
                    }
                }
            }
        }
        if self.settles {
            actions.push(Action::Settle);
        }
    }

    fn next_state(&self, last: &State, action: Action) -> Option<State> {
        let mut s = last.clone();
        match action {
            Action::Ask(sink) => self.ask(&mut s, usize::from(sink)),
            Action::Deliver(frame) => {
                let first = s.frames.iter().position(|f| *f == frame)?;
                let Frame { wire, to, kind, id } = s.frames.remove(first);
                if self.seems_up(&s, wire, to) {
                    self.receive(&mut s, to, Port::Over(wire), kind, id);
                }
            }
            Action::Hop(node, hop) => {
                s.left.hops -= 1;
                self.change_hop(&mut s, node, hop);
            }
            Action::Cut(wire) => {
                s.left.cuts -= 1;
                s.wires[usize::from(wire)] = WireState::Down([false; 2]);
                s.frames.retain(|f| f.wire != wire);
            }
            Action::SeeDown(wire, node) => self.see_down(&mut s, wire, node),
            Action::Raise(wire) => s.wires[usize::from(wire)] = WireState::Up,
            Action::Expire(at, id) => {
                if !s.settled {
                    s.left.timeouts -= 1;
                }
                let i = s.branch(at, id)?;
                self.remove(&mut s, i, true, !self.is_broken(Broken::NoLeaveOnDeadline));
            }
            Action::Stop(n) => {
                s.left.stops -= 1;
                let Sink { now, before, .. } = s.sinks[usize::from(n)];
                s.sinks[usize::from(n)] = Sink { stopped: true, ..Sink::default() };
                for id in now.map(|(id, _)| id).into_iter().chain(before) {
                    self.receive(&mut s, self.sinks[usize::from(n)], Port::Local, Kind::Leave, id);
                }
            }
            Action::Settle => {
                s.settled = true;
                s.left = Budget {
                    requests: s.left.requests + SETTLED_REQUESTS * self.sinks.len() as u8,
                    ..Budget::default()
                };
            }
            Action::Correct(node) => {
                let hop = self.right_hops(&s)[usize::from(node)];
                self.change_hop(&mut s, node, hop);
            }
        }
        Some(s)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        let mut properties = vec![
            Property::always(NO_GRANTED_CIRCLE, |model: &Tree, s: &State| {
                !model.circle(s, |b| b.stage == Stage::Granted)
            }),
            Property::always(NO_CIRCLE, |model: &Tree, s: &State| !model.circle(s, |b| model.flows(s, b))),
            Property::always(FROM_OWNER, |model: &Tree, s: &State| {
                s.branches.iter().all(|b| b.stage == Stage::Pending || model.continues(s, b))
            }),
            Property::always(NO_GAP, |model: &Tree, s: &State| {
                !model.gapless
                    || s.sinks.iter().enumerate().all(|(n, sink)| {
                        (!sink.granted() && sink.before.is_none())
                            || model.reaches(s, model.sinks[n], Port::Local, model.nodes)
                    })
            }),
            Property::always(ONCE, |_: &Tree, s: &State| {
                !s.granted_again && s.sinks.iter().all(|sink| !(sink.granted() && sink.before.is_some()))
            }),
            Property::always(NOT_DOWN, |model: &Tree, s: &State| {
                s.branches.iter().all(|b| {
                    [b.down, b.up].into_iter().all(|port| match port {
                        Port::Local => true,
                        Port::Over(wire) => model.seems_up(s, wire, b.at),
                    })
                })
            }),
            Property::always(IN_THE_END, |model: &Tree, s: &State| {
                !s.settled || !s.frames.is_empty() || !model.actions_of(s).is_empty() || model.complete(s)
            }),
            Property::always(NOT_WAITING, |model: &Tree, s: &State| {
                s.branches.iter().all(|b| b.stage != Stage::Pending) || !s.settled || !model.silent(s)
            }),
        ];
        // The events that must occur, or the checks would hold trivially.
        if self.settles {
            properties.push(Property::sometimes("it comes to an end", |model: &Tree, s: &State| {
                s.settled && model.actions_of(s).is_empty()
            }));
        }
        if self.budget.hops > 0 {
            properties.push(Property::sometimes("a branch drains", |_: &Tree, s: &State| {
                s.branches.iter().any(|b| b.stage == Stage::Draining)
            }));
        }
        properties
    }
}

impl Tree {
    fn new(nodes: Node, wires: &[(Node, Node, bool)], sinks: &[Node]) -> Self {
        Tree {
            nodes,
            wires: wires.to_vec(),
            sinks: sinks.to_vec(),
            hops: Vec::new(),
            warm: sinks.len(),
            movers: Vec::new(),
            budget: Budget::default(),
            gapless: false,
            settles: true,
            feed: FeedRule::LastGranted,
            broken: None,
        }
    }

    /// The owner and two routers, each linked to each.
    fn triangle(sinks: &[Node]) -> Self {
        Tree::new(3, &[(0, 1, true), (0, 2, true), (1, 2, true)], sinks)
    }

    /// Two wires between each two neighbours.
    fn doubled() -> Self {
        Tree::new(3, &[(0, 1, true), (0, 1, true), (1, 2, true), (1, 2, true)], &[2])
    }

    /// A second wire comes up between two neighbours.
    fn again() -> Self {
        Tree::new(3, &[(0, 1, true), (1, 2, true), (1, 2, false), (0, 2, true)], &[2])
    }

    /// The owner and three routers, the first two linked to it, to the third and to each other.
    fn diamond(sinks: &[Node]) -> Self {
        Tree::new(4, &[(0, 1, true), (0, 2, true), (1, 3, true), (2, 3, true), (1, 2, true)], sinks)
    }

    /// Three routers in a ring; the owner finds a wire to the last, and loses that to the first.
    fn roaming() -> Self {
        Tree::new(4, &[(0, 1, true), (1, 2, true), (2, 3, true), (0, 3, false), (1, 3, true)], &[2])
    }

    /// Four routers in a ring; the owner moves from the first to the third. One sink is granted over the long way; the
    /// other comes while that changes.
    fn ring() -> Self {
        let wires = [(0, 1, true), (0, 3, true), (1, 2, true), (2, 3, true), (3, 4, true), (4, 1, true)];
        Tree {
            hops: vec![0, 2, 3, 4],
            warm: 1,
            movers: vec![1, 3],
            settles: false,
            budget: Budget { hops: 2, requests: 2, ..Budget::default() },
            ..Tree::new(5, &wires, &[4, 2])
        }
    }

    fn cold(self) -> Self {
        Tree { warm: 0, ..self }
    }

    fn gapless(self) -> Self {
        Tree { gapless: true, settles: false, ..self }
    }

    fn with(mut self, hops: u8, cuts: u8, timeouts: u8, requests: u8) -> Self {
        self.budget = Budget { hops, cuts, timeouts, requests, ..self.budget };
        self
    }

    fn stops(mut self, stops: u8) -> Self {
        self.budget.stops = stops;
        self
    }

    fn fed(self, feed: FeedRule) -> Self {
        Tree { feed, ..self }
    }

    fn without(self, rule: Broken) -> Self {
        Tree { broken: Some(rule), ..self }
    }

    /// Visits every state.
    fn check(self, name: &str, threads: usize) {
        let started = std::time::Instant::now();
        let checker = self.checker().threads(threads).spawn_bfs().join();
        for property in checker.model().properties() {
            let found = checker.discovery(property.name);
            match property.expectation {
                Expectation::Sometimes => assert!(found.is_some(), "{name}: never so: {}", property.name),
                _ => {
                    if let Some(path) = found {
                        panic!("{name}: not so: {}\n{}", property.name, told(&path.into_vec()));
                    }
                }
            }
        }
        println!("{name}: {} states in {:.1?}", checker.unique_state_count(), started.elapsed());
    }

    /// Searches for a path to a state that violates the property.
    fn refutes(self, property: &'static str) {
        let broken = self.broken.map_or_else(|| format!("{:?}", self.feed), |rule| format!("{rule:?}"));
        let until = HasDiscoveries::AnyOf([property].into());
        let checker = self.checker().finish_when(until).spawn_bfs().join();
        let states = checker.unique_state_count();
        let Some(path) = checker.discovery(property) else {
            panic!("{broken}: still so in all {states} states: {property}");
        };
        println!("{broken}: {} steps, {states} states: not so: {property}", path.into_actions().len());
    }
}

fn told(path: &[(State, Option<Action>)]) -> String {
    path.iter().map(|(state, action)| format!("{:?}\n    {action:?}\n", state.branches)).collect()
}

#[test]
fn the_protocol_keeps_its_promises() {
    Tree::triangle(&[2]).with(3, 1, 0, 2).check("triangle", 1);
    Tree::triangle(&[2]).cold().with(2, 1, 1, 1).check("triangle, cold", 1);
    Tree::triangle(&[1, 2]).with(2, 1, 0, 2).check("triangle, two sinks", 1);
    Tree::triangle(&[2]).with(2, 1, 0, 1).stops(1).check("triangle, sink stops", 1);
    Tree::triangle(&[1, 2]).with(2, 0, 0, 1).stops(1).check("triangle, one of two sinks stops", 1);
    Tree::doubled().with(1, 1, 0, 1).check("doubled", 1);
    Tree::doubled().with(4, 0, 0, 1).check("doubled, no cut", 1);
    Tree::again().with(2, 1, 0, 1).check("again", 1);
    Tree::diamond(&[3]).cold().with(3, 0, 0, 1).check("diamond, cold", 1);
    Tree::diamond(&[3]).with(2, 0, 0, 2).check("diamond", 1);
    Tree::diamond(&[3]).with(1, 1, 0, 1).check("diamond, cut", 1);
    Tree::roaming().with(1, 1, 0, 1).check("roaming", 1);
    Tree::ring().with(2, 0, 0, 1).check("ring", 1);
}

#[test]
fn a_change_of_the_way_alone_leaves_no_gap() {
    Tree::triangle(&[1, 2]).with(1, 0, 0, 2).gapless().check("triangle", 1);
    Tree::diamond(&[1, 3]).with(1, 0, 0, 3).gapless().check("diamond", 1);
    Tree::diamond(&[3, 3]).with(1, 0, 0, 3).gapless().check("diamond, two sinks", 1);
    Tree::diamond(&[1, 3]).with(1, 0, 0, 3).gapless().without(Broken::NoDraining).refutes(NO_GAP);
}

#[test]
fn other_ways_to_feed_let_data_circulate() {
    Tree::ring().fed(FeedRule::EveryBranch).refutes(NO_CIRCLE);
    Tree::ring().fed(FeedRule::NeverUp).refutes(NO_CIRCLE);
    Tree::ring().with(2, 1, 0, 1).fed(FeedRule::FallBack).refutes(NO_CIRCLE);
}

#[test]
fn each_rule_is_needed() {
    let triangle = || Tree::triangle(&[2]).with(2, 1, 0, 1);
    let diamond = || Tree::diamond(&[3]).cold().with(3, 0, 0, 1);
    let doubled = || Tree::doubled().with(1, 1, 0, 1);
    Tree::ring().without(Broken::NoCutOnHopChange).refutes(NO_GRANTED_CIRCLE);
    doubled().without(Broken::JoinTwice).refutes(IN_THE_END);
    Tree::again().with(2, 0, 0, 1).without(Broken::AnswerFromAnywhere).refutes(ONCE);
    diamond().without(Broken::NoLeaveBack).refutes(IN_THE_END);
    Tree::doubled().with(4, 0, 0, 1).without(Broken::NoLeaveBackFromBranch).refutes(IN_THE_END);
    doubled().without(Broken::LeaveFromAnywhere).refutes(IN_THE_END);
    Tree::again().with(2, 0, 0, 1).without(Broken::RejectFromAnywhere).refutes(IN_THE_END);
    triangle().without(Broken::NoRejectOnDown).refutes(IN_THE_END);
    triangle().without(Broken::NoLeaveOnDown).refutes(IN_THE_END);
    triangle().without(Broken::KeepOnDown).refutes(NOT_DOWN);
    triangle().without(Broken::PendingOutlivesHop).refutes(IN_THE_END);
    triangle().without(Broken::NoEnd).refutes(IN_THE_END);
    triangle().without(Broken::NoLeaveOnDeadline).refutes(IN_THE_END);
    Tree::ring().without(Broken::SameIdAgain).refutes(ONCE);
    Tree::ring().without(Broken::SameIdAgain).refutes(FROM_OWNER);
    diamond().without(Broken::FramesOvertake).refutes(IN_THE_END);
    diamond().without(Broken::FramesOvertake).refutes(NOT_WAITING);
}

/// `make model-check`
#[test]
#[ignore = "takes minutes"]
fn the_protocol_keeps_its_promises_within_larger_bounds() {
    Tree::triangle(&[2]).cold().with(3, 2, 1, 2).check("triangle, cold", 2);
    Tree::triangle(&[1, 2]).with(3, 1, 1, 2).check("triangle, two sinks", 2);
    Tree::triangle(&[2]).with(3, 1, 1, 2).stops(1).check("triangle, sink stops", 2);
    Tree::doubled().with(3, 0, 1, 1).check("doubled", 2);
    Tree::again().with(3, 1, 1, 2).check("again", 2);
    Tree::diamond(&[3]).with(2, 0, 1, 2).check("diamond", 2);
    Tree::diamond(&[3]).with(2, 1, 0, 2).check("diamond, cut", 2);
    Tree::roaming().with(2, 1, 0, 2).check("roaming", 2);
    Tree::ring().with(2, 1, 0, 2).check("ring, cut", 2);
    Tree::ring().with(3, 0, 0, 2).check("ring", 2);
}
