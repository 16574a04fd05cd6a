//! Calls of a service by name: [`Caller`] remembers unanswered calls, [`Answerer`] received ones.
//!
//! Messages carry the call's number at the source that asks. A call is published again until it is answered, through
//! any failure between the two, and is carried out once, because the answerer recognises it: a running call is not
//! begun twice, a finished one is answered from memory, and a forgotten one is reported as gone. No call ends by time
//! here: it lives as long as its client. A call that ends without an answer is a [`LostCall`], which the driver takes,
//! counts and explains.
//!
//! The driver sends, seals and serves the local network. `L` identifies its local calls, `S` its local servers.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_wire::{MessageKind, SourceId};

/// Time after which a caller first asks about a call; each later time is twice as long, up to [`ASK_EVERY_MAX`].
pub const ASK_AFTER: Duration = Duration::from_secs(5);
/// Longest time between two such questions.
pub const ASK_EVERY_MAX: Duration = Duration::from_secs(300);
/// A larger answer is acknowledged, so that it need not be remembered.
pub const ANSWER_KEPT_BYTES_MAX: usize = 64 << 10;

/// Bounds of one service at one node.
#[derive(Clone, Debug)]
pub struct CallLimits {
    /// Unanswered calls of one local client.
    pub open_per_client_max: usize,
    /// Unanswered calls of all clients.
    pub open_max: usize,
    /// Bytes of their requests.
    pub open_bytes_max: usize,
    /// Remembered calls of one source, running or over.
    pub remembered_per_source_max: usize,
    /// Sources whose calls are remembered.
    pub sources_max: usize,
    /// Bytes of remembered answers; the newest answer is remembered whatever its size.
    pub answer_bytes_max: usize,
}

impl Default for CallLimits {
    fn default() -> Self {
        Self {
            open_per_client_max: 1024,
            open_max: 8192,
            open_bytes_max: 128 << 20,
            remembered_per_source_max: 4096,
            sources_max: 1024,
            answer_bytes_max: 16 << 20,
        }
    }
}

/// Counts of the calls of one service, so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CallStats {
    /// Calls taken.
    pub calls: u64,
    /// Calls that wait for their answer.
    pub open: u64,
    /// Calls that were answered.
    pub answered: u64,
}

/// The reason for which a call is not answered.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum CallLoss {
    /// Too many calls were open at the caller ([`CallRefusal`]): the call was not taken.
    Refused,
    /// Too many calls of the caller's node were running at the owner: the call was not taken.
    OwnerFull,
    /// The servers that got the request are gone.
    ServerGone,
    /// The owner's node started anew and remembers nothing: the call may have been carried out.
    OwnerRestarted,
    /// The service ended while the call waited: its servers stayed away, its owner left, or a rule changed.
    Withdrawn,
    /// The client is gone.
    ClientGone,
    /// The answer was lost and requested again after the owner had forgotten it.
    Forgotten,
    /// The request or the answer is larger than any message.
    TooLarge,
    /// The answer came after the client had gone.
    Unheard,
    /// Messages of the local network, requests or answers, came faster than they were taken.
    Overrun,
    /// A message of the local network does not say to which call it belongs.
    Unreadable,
    /// The owner gave no reason.
    Unsaid,
}

impl CallLoss {
    /// All reasons.
    pub const ALL: [Self; 12] = [
        Self::Refused,
        Self::OwnerFull,
        Self::ServerGone,
        Self::OwnerRestarted,
        Self::Withdrawn,
        Self::ClientGone,
        Self::Forgotten,
        Self::TooLarge,
        Self::Unheard,
        Self::Overrun,
        Self::Unreadable,
        Self::Unsaid,
    ];

    /// Returns the counter's name.
    pub const fn key(self) -> &'static str {
        match self {
            Self::Refused => "call_refused",
            Self::OwnerFull => "call_owner_full",
            Self::ServerGone => "call_server_gone",
            Self::OwnerRestarted => "call_owner_restarted",
            Self::Withdrawn => "call_withdrawn",
            Self::ClientGone => "call_client_gone",
            Self::Forgotten => "call_forgotten",
            Self::TooLarge => "call_too_large",
            Self::Unheard => "call_unheard",
            Self::Overrun => "overrun",
            Self::Unreadable => "call_unreadable",
            Self::Unsaid => "call_unsaid",
        }
    }

    /// Returns the payload of a `gone` with this reason.
    fn payload(self) -> Bytes {
        Bytes::from_static(match self {
            Self::ServerGone => &[1],
            Self::Forgotten => &[2],
            Self::OwnerFull => &[3],
            Self::TooLarge => &[4],
            Self::ClientGone => &[5],
            Self::Withdrawn => &[6],
            _ => &[],
        })
    }

    /// Returns the reason that a `gone` names; bytes behind it are of later versions.
    fn from_payload(payload: &[u8]) -> Self {
        match payload.first() {
            Some(1) => Self::ServerGone,
            Some(2) => Self::Forgotten,
            Some(3) => Self::OwnerFull,
            Some(4) => Self::TooLarge,
            Some(5) => Self::ClientGone,
            Some(6) => Self::Withdrawn,
            _ => Self::Unsaid,
        }
    }
}

/// A call that is not answered, with its caller: a local call at the calling node, a source at the owner.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LostCall<W> {
    /// The reason.
    pub loss: CallLoss,
    /// The caller.
    pub of: W,
}

/// The reason why a local call is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallRefusal {
    /// Too many of this client wait for their answers.
    #[error("a client has {max} calls without an answer")]
    Client {
        /// The bound.
        max: usize,
    },
    /// Too many of all clients wait for their answers.
    #[error("{max} calls are without an answer")]
    Calls {
        /// The bound.
        max: usize,
    },
    /// Requests without an answer are too large together.
    #[error("requests of more than {max} bytes are without an answer")]
    Bytes {
        /// The bound.
        max: usize,
    },
}

/// A local call that is not answered.
#[derive(Debug)]
struct Open<L> {
    client: [u8; 16],
    local: L,
    payload: Bytes,
    /// Whether it was published: it may have arrived.
    published: bool,
    ask_at: Instant,
    ask_after: Duration,
}

/// Effect of a message at the caller.
#[derive(Debug, PartialEq, Eq)]
pub enum Outcome<L> {
    /// The message belongs to no open call, or is its second answer.
    Nothing,
    /// The answer of this local call.
    Answers(L),
    /// The call has to be published again.
    Again(Bytes),
}

/// The calls that local clients make of one service of another node.
#[derive(Debug)]
pub struct Caller<L> {
    limits: CallLimits,
    next: u64,
    open: BTreeMap<u64, Open<L>>,
    bytes: usize,
    /// Set while published messages can arrive.
    granted: bool,
    /// Not later than the first question that is due.
    ask_at: Option<Instant>,
    stats: CallStats,
    /// Lost calls that the driver has not taken yet.
    lost: Vec<LostCall<L>>,
}

impl<L: Copy> Caller<L> {
    /// Returns a caller without calls.
    pub fn new(limits: CallLimits) -> Self {
        Self {
            limits,
            next: 1,
            open: BTreeMap::new(),
            bytes: 0,
            granted: false,
            ask_at: None,
            stats: CallStats::default(),
            lost: Vec::new(),
        }
    }

    /// Takes a call of a local client. Returns its number if the driver has to publish it at once; otherwise it waits
    /// for [`Self::granted`].
    pub fn call(
        &mut self,
        now: Instant,
        client: [u8; 16],
        local: L,
        payload: Bytes,
    ) -> Result<Option<u64>, CallRefusal> {
        let limits = &self.limits;
        let of_client = self.open.values().filter(|open| open.client == client).count();
        let refused = if of_client >= limits.open_per_client_max {
            Some(CallRefusal::Client { max: limits.open_per_client_max })
        } else if self.open.len() >= limits.open_max {
            Some(CallRefusal::Calls { max: limits.open_max })
        } else if self.bytes + payload.len() > limits.open_bytes_max {
            Some(CallRefusal::Bytes { max: limits.open_bytes_max })
        } else {
            None
        };
        if let Some(why) = refused {
            self.lost.push(LostCall { loss: CallLoss::Refused, of: local });
            return Err(why);
        }
        let number = self.next;
        self.next += 1;
        self.stats.calls += 1;
        self.bytes += payload.len();
        let (published, ask_at) = (self.granted, now + ASK_AFTER);
        let open = Open { client, local, payload, published, ask_at, ask_after: ASK_AFTER };
        self.open.insert(number, open);
        self.ask_at = Some(self.ask_at.map_or(ask_at, |at| at.min(ask_at)));
        Ok(published.then_some(number))
    }

    /// Notes a new route to the owner. Returns all open calls, to be published on it. With `anew` the owner has
    /// restarted and remembers nothing: a call that may have arrived is not sent again, because it may have been
    /// carried out.
    pub fn granted(&mut self, now: Instant, anew: bool) -> Vec<(u64, Bytes)> {
        if anew {
            let published = self.open.iter().filter(|(_, open)| open.published).map(|(number, _)| *number);
            for number in published.collect::<Vec<_>>() {
                self.lose(number, CallLoss::OwnerRestarted);
            }
        }
        self.granted = true;
        self.ask_at = (!self.open.is_empty()).then_some(now + ASK_AFTER);
        let publish = |(number, open): (&u64, &mut Open<L>)| {
            open.published = true;
            (open.ask_at, open.ask_after) = (now + ASK_AFTER, ASK_AFTER);
            (*number, open.payload.clone())
        };
        self.open.iter_mut().map(publish).collect()
    }

    /// Notes that the route to the owner is lost for now.
    pub fn lost(&mut self) {
        self.granted = false;
    }

    /// Takes the owner's message about a call, with its payload.
    pub fn handle(&mut self, kind: MessageKind, number: u64, payload: &[u8]) -> Outcome<L> {
        match kind {
            MessageKind::Reply => match self.remove(number) {
                Some(open) => {
                    self.stats.answered += 1;
                    Outcome::Answers(open.local)
                }
                None => Outcome::Nothing,
            },
            MessageKind::Unknown => match self.open.get(&number) {
                Some(open) => Outcome::Again(open.payload.clone()),
                None => Outcome::Nothing,
            },
            MessageKind::Gone => {
                self.lose(number, CallLoss::from_payload(payload));
                Outcome::Nothing
            }
            _ => Outcome::Nothing,
        }
    }

    /// Notes that an answer of [`Outcome::Answers`] could not be given to its client.
    pub fn unheard(&mut self, local: L) {
        self.stats.answered -= 1;
        self.lost.push(LostCall { loss: CallLoss::Unheard, of: local });
    }

    /// Ends the calls of a local client that is gone. Returns their numbers, for the owner to forget them too.
    pub fn client_gone(&mut self, is_of: impl Fn(&L) -> bool) -> Vec<u64> {
        let gone: Vec<_> = self.open.iter().filter(|(_, o)| is_of(&o.local)).map(|(n, _)| *n).collect();
        gone.iter().for_each(|number| self.lose(*number, CallLoss::ClientGone));
        gone
    }

    /// Ends the service: no open call will be answered.
    pub fn withdraw(&mut self) {
        for number in self.open.keys().copied().collect::<Vec<_>>() {
            self.lose(number, CallLoss::Withdrawn);
        }
    }

    /// Gives up a call that is open.
    pub fn lose(&mut self, number: u64, loss: CallLoss) {
        if let Some(open) = self.remove(number) {
            self.lost.push(LostCall { loss, of: open.local });
        }
    }

    /// Takes the calls that were lost since the last time.
    pub fn take_lost(&mut self) -> Vec<LostCall<L>> {
        std::mem::take(&mut self.lost)
    }

    /// Returns the calls that have been quiet for so long that the caller has to ask about them.
    pub fn ask_due(&mut self, now: Instant) -> Vec<u64> {
        if !self.granted || self.ask_at.is_none_or(|at| at > now) {
            return Vec::new();
        }
        let mut due = Vec::new();
        for (number, open) in self.open.iter_mut().filter(|(_, open)| open.ask_at <= now) {
            open.ask_after = (open.ask_after * 2).min(ASK_EVERY_MAX);
            open.ask_at = now + open.ask_after;
            due.push(*number);
        }
        self.ask_at = self.open.values().map(|open| open.ask_at).min();
        due
    }

    /// Returns the time of the next [`Self::ask_due`].
    pub fn deadline(&self) -> Option<Instant> {
        self.ask_at.filter(|_| self.granted)
    }

    /// Returns the counts.
    pub fn stats(&self) -> CallStats {
        CallStats { open: self.open.len() as u64, ..self.stats }
    }

    fn remove(&mut self, number: u64) -> Option<Open<L>> {
        let open = self.open.remove(&number)?;
        self.bytes -= open.payload.len();
        if self.open.is_empty() {
            self.ask_at = None;
        }
        Some(open)
    }
}

/// State of a remembered call.
#[derive(Debug)]
enum CallState<L> {
    /// The request is on its way to the local server.
    Asking,
    /// The local server was asked under this id.
    Asked(L),
    Answered(Bytes),
    /// The call was or may have been carried out, and its answer is not here for this reason.
    Over(CallLoss),
}

impl<L> CallState<L> {
    fn is_open(&self) -> bool {
        matches!(self, Self::Asking | Self::Asked(_))
    }
}

/// Action of the answerer's driver.
#[derive(Debug, PartialEq, Eq)]
pub enum Answering {
    /// Nothing.
    Nothing,
    /// Ask the local server, then call [`Answerer::asked`] or [`Answerer::not_asked`].
    Ask,
    /// Tell the caller.
    Tell(MessageKind, Bytes),
}

#[derive(Debug)]
struct SourceCalls<L> {
    calls: BTreeMap<u64, CallState<L>>,
    /// Lower numbers that are not in `calls` are over.
    from: u64,
    /// Larger is later.
    heard: u64,
}

/// A call that was given to local servers.
#[derive(Debug)]
struct ForwardedCall<S> {
    source: SourceId,
    number: u64,
    /// Servers that are still there; calls with the same servers share one set.
    servers: Arc<BTreeSet<S>>,
}

/// The calls of others to one local service.
#[derive(Debug)]
pub struct Answerer<L, S> {
    limits: CallLimits,
    sources: BTreeMap<SourceId, SourceCalls<L>>,
    local: BTreeMap<L, ForwardedCall<S>>,
    /// The servers of the last call.
    servers: Arc<BTreeSet<S>>,
    /// Answers, oldest first; some are forgotten already.
    answers: VecDeque<(SourceId, u64)>,
    answer_bytes: usize,
    heard: u64,
    stats: CallStats,
    /// Lost calls that the driver has not taken yet.
    lost: Vec<LostCall<SourceId>>,
}

impl<L: Copy + Ord, S: Clone + Ord> Answerer<L, S> {
    /// Returns an answerer without calls.
    pub fn new(limits: CallLimits) -> Self {
        Self {
            limits,
            sources: BTreeMap::new(),
            local: BTreeMap::new(),
            servers: Arc::default(),
            answers: VecDeque::new(),
            answer_bytes: 0,
            heard: 0,
            stats: CallStats::default(),
            lost: Vec::new(),
        }
    }

    /// Takes a source's message about a call of its own.
    pub fn handle(&mut self, source: SourceId, kind: MessageKind, number: u64) -> Answering {
        match kind {
            MessageKind::Request => self.request(source, number),
            MessageKind::Ask => self.answer_question(source, number),
            MessageKind::Forget => {
                self.forget(source, number);
                Answering::Nothing
            }
            _ => Answering::Nothing,
        }
    }

    /// Notes that these local servers got the call under this id. An earlier answer goes to [`Self::answered`] after
    /// this.
    pub fn asked(&mut self, source: SourceId, number: u64, local: L, servers: BTreeSet<S>) {
        if let Some(known) = self.known(&source, number).filter(|known| matches!(known, CallState::Asking)) {
            *known = CallState::Asked(local);
            if *self.servers != servers {
                self.servers = Arc::new(servers);
            }
            self.local.insert(local, ForwardedCall { source, number, servers: self.servers.clone() });
        }
    }

    /// Notes that the local server could not be asked: the caller may ask again.
    pub fn not_asked(&mut self, source: SourceId, number: u64) {
        let remembered = self.sources.get_mut(&source);
        if let Some(remembered) =
            remembered.filter(|r| matches!(r.calls.get(&number), Some(CallState::Asking)))
        {
            remembered.calls.remove(&number);
            self.stats.calls -= 1;
        }
    }

    /// Takes the local server's answer. Returns the caller's source and the call's number.
    pub fn answered(&mut self, local: &L, payload: &Bytes) -> Option<(SourceId, u64)> {
        let ForwardedCall { source, number, .. } = self.local.remove(local)?;
        self.stats.answered += 1;
        if let Some(known) = self.known(&source, number) {
            *known = CallState::Answered(payload.clone());
            self.answers.push_back((source, number));
            self.answer_bytes += payload.len();
        }
        while self.answer_bytes > self.limits.answer_bytes_max
            && self.answers.len() > 1
            && let Some((source, number)) = self.answers.pop_front()
        {
            self.drop_answer(&source, number);
        }
        Some((source, number))
    }

    /// Notes that a local server is gone: calls that only it got will not be answered. Returns the sources and numbers
    /// to tell, with the payload.
    pub fn server_gone(&mut self, server: &S) -> Vec<(SourceId, u64, Bytes)> {
        let mut last: Option<[Arc<BTreeSet<S>>; 2]> = None;
        for asked in self.local.values_mut().filter(|asked| asked.servers.contains(server)) {
            let left = match &last {
                Some([before, left]) if Arc::ptr_eq(before, &asked.servers) => left.clone(),
                _ => Arc::new(asked.servers.iter().filter(|other| *other != server).cloned().collect()),
            };
            last = Some([std::mem::replace(&mut asked.servers, left.clone()), left]);
        }
        self.lose_unanswerable()
    }

    /// Gives up calls without a remaining server. Returns the same as [`Self::server_gone`].
    pub fn lose_unanswerable(&mut self) -> Vec<(SourceId, u64, Bytes)> {
        self.lose_asked(CallLoss::ServerGone, |asked| asked.servers.is_empty())
    }

    /// Notes that all local servers are gone: their calls will not be answered.
    pub fn servers_gone(&mut self) -> Vec<(SourceId, u64, Bytes)> {
        self.lose_asked(CallLoss::ServerGone, |_| true)
    }

    /// Ends the service: no call will be answered.
    pub fn withdraw(&mut self) {
        self.lose_asked(CallLoss::Withdrawn, |_| true);
    }

    /// Gives up a call whose answer is larger than any message. Returns the payload of its `gone` message.
    pub fn too_large(&mut self, source: SourceId, number: u64) -> Bytes {
        self.drop_answer(&source, number);
        if let Some(known) = self.known(&source, number) {
            *known = CallState::Over(CallLoss::TooLarge);
            self.stats.answered -= 1;
            self.lost.push(LostCall { loss: CallLoss::TooLarge, of: source });
        }
        CallLoss::TooLarge.payload()
    }

    /// Takes the calls that were lost since the last time.
    pub fn take_lost(&mut self) -> Vec<LostCall<SourceId>> {
        std::mem::take(&mut self.lost)
    }

    fn lose_asked(
        &mut self,
        loss: CallLoss,
        is_lost: impl Fn(&ForwardedCall<S>) -> bool,
    ) -> Vec<(SourceId, u64, Bytes)> {
        let lost: Vec<_> = self.local.iter().filter(|(_, asked)| is_lost(asked)).map(|(id, _)| *id).collect();
        let lost: Vec<_> = lost.iter().filter_map(|id| self.local.remove(id)).collect();
        for asked in &lost {
            self.lost.push(LostCall { loss, of: asked.source });
            if let Some(known) = self.known(&asked.source, asked.number) {
                *known = CallState::Over(loss);
            }
        }
        lost.into_iter().map(|asked| (asked.source, asked.number, loss.payload())).collect()
    }

    /// Returns the counts.
    pub fn stats(&self) -> CallStats {
        CallStats { open: self.open() as u64, ..self.stats }
    }

    /// Returns the number of calls that the local server has not answered.
    pub fn open(&self) -> usize {
        self.local.len()
    }

    fn request(&mut self, source: SourceId, number: u64) -> Answering {
        let max = self.limits.remembered_per_source_max;
        self.make_room(&source);
        self.heard += 1;
        let remembered = SourceCalls { calls: BTreeMap::new(), from: 0, heard: 0 };
        let remembered = self.sources.entry(source).or_insert(remembered);
        remembered.heard = self.heard;
        match remembered.calls.get(&number) {
            Some(CallState::Asking | CallState::Asked(_)) => return Answering::Nothing,
            Some(CallState::Answered(payload)) => {
                return Answering::Tell(MessageKind::Reply, payload.clone());
            }
            Some(CallState::Over(why)) => return gone(*why),
            None if number < remembered.from => return gone(CallLoss::Forgotten),
            None => {}
        }
        if remembered.calls.len() >= max {
            let Some(oldest) = remembered.calls.iter().find(|(_, k)| !k.is_open()).map(|(n, _)| *n) else {
                self.lost.push(LostCall { loss: CallLoss::OwnerFull, of: source });
                return gone(CallLoss::OwnerFull);
            };
            self.drop_answer(&source, oldest);
            if let Some(remembered) = self.sources.get_mut(&source) {
                remembered.calls.remove(&oldest);
                remembered.from = remembered.from.max(oldest + 1);
            }
        }
        if let Some(remembered) = self.sources.get_mut(&source) {
            remembered.calls.insert(number, CallState::Asking);
        }
        self.stats.calls += 1;
        Answering::Ask
    }

    fn answer_question(&self, source: SourceId, number: u64) -> Answering {
        let remembered = self.sources.get(&source);
        match remembered.and_then(|r| r.calls.get(&number)) {
            Some(CallState::Asking | CallState::Asked(_)) => Answering::Nothing,
            Some(CallState::Answered(payload)) => Answering::Tell(MessageKind::Reply, payload.clone()),
            Some(CallState::Over(why)) => gone(*why),
            None if remembered.is_some_and(|r| number < r.from) => gone(CallLoss::Forgotten),
            None => Answering::Tell(MessageKind::Unknown, Bytes::new()),
        }
    }

    /// Forgets the answer, but not the call: a copy of it may still be on the way.
    fn forget(&mut self, source: SourceId, number: u64) {
        self.drop_answer(&source, number);
        let Some(known) = self.known(&source, number) else { return };
        if !known.is_open() {
            return;
        }
        if let CallState::Asked(local) = std::mem::replace(known, CallState::Over(CallLoss::ClientGone)) {
            self.local.remove(&local);
        }
        self.lost.push(LostCall { loss: CallLoss::ClientGone, of: source });
    }

    fn known(&mut self, source: &SourceId, number: u64) -> Option<&mut CallState<L>> {
        self.sources.get_mut(source)?.calls.get_mut(&number)
    }

    fn drop_answer(&mut self, source: &SourceId, number: u64) {
        if let Some(known) = self.known(source, number)
            && let CallState::Answered(payload) = known
        {
            let bytes = payload.len();
            *known = CallState::Over(CallLoss::Forgotten);
            self.answer_bytes -= bytes;
        }
        // Forgotten answers must not accumulate.
        if self.answers.len() > 2 * self.limits.remembered_per_source_max {
            let sources = &self.sources;
            let is_there = |(source, number): &(SourceId, u64)| {
                let known = sources.get(source).and_then(|r| r.calls.get(number));
                matches!(known, Some(CallState::Answered(_)))
            };
            self.answers.retain(is_there);
        }
    }

    /// Makes room for a new source: of those without open calls the one that was silent for longest goes.
    fn make_room(&mut self, source: &SourceId) {
        if self.sources.contains_key(source) || self.sources.len() < self.limits.sources_max {
            return;
        }
        let busy: BTreeSet<_> = self.local.values().map(|asked| asked.source).collect();
        let idle = self.sources.iter().filter(|(id, _)| !busy.contains(*id));
        let Some(gone) = idle.min_by_key(|(_, r)| r.heard).map(|(id, _)| *id) else { return };
        let numbers: Vec<_> = self.sources[&gone].calls.keys().copied().collect();
        numbers.into_iter().for_each(|number| self.drop_answer(&gone, number));
        self.sources.remove(&gone);
    }
}

/// Returns the message for a call that will not be answered.
fn gone(why: CallLoss) -> Answering {
    Answering::Tell(MessageKind::Gone, why.payload())
}

#[cfg(test)]
mod tests {
    use super::*;

    const A: SourceId = SourceId([1; 16]);
    const B: SourceId = SourceId([2; 16]);

    fn payload(text: &'static str) -> Bytes {
        Bytes::from_static(text.as_bytes())
    }

    #[expect(clippy::disallowed_methods, reason = "somewhere to count from")]
    fn caller() -> (Caller<u32>, Instant) {
        (
            Caller::new(CallLimits { open_per_client_max: 2, open_max: 3, ..CallLimits::default() }),
            Instant::now(),
        )
    }

    fn tell(kind: MessageKind, text: &'static str) -> Answering {
        Answering::Tell(kind, payload(text))
    }

    fn lost<W>(loss: CallLoss, of: W) -> LostCall<W> {
        LostCall { loss, of }
    }

    fn answerer() -> Answerer<u32, u8> {
        Answerer::new(CallLimits::default())
    }

    /// Returns the only server.
    fn one() -> BTreeSet<u8> {
        BTreeSet::from([0])
    }

    #[test]
    fn a_call_waits_for_a_way_and_goes_again_on_another() {
        let (mut caller, now) = caller();
        assert_eq!(caller.call(now, [1; 16], 10, payload("a")), Ok(None));
        assert_eq!(caller.deadline(), None, "nobody could be asked");
        assert_eq!(caller.granted(now, true), [(1, payload("a"))]);
        assert_eq!(caller.call(now, [1; 16], 11, payload("b")), Ok(Some(2)));
        assert_eq!(caller.handle(MessageKind::Reply, 2, b""), Outcome::Answers(11));
        assert_eq!(caller.handle(MessageKind::Reply, 2, b""), Outcome::Nothing);
        caller.lost();
        assert_eq!(caller.granted(now, false), [(1, payload("a"))]);
        // Another run of the owner remembers nothing: a call that may have been carried out is not sent again.
        caller.lost();
        assert_eq!(caller.call(now, [1; 16], 12, payload("c")), Ok(None));
        assert_eq!(caller.granted(now, true), [(3, payload("c"))]);
        assert_eq!(caller.stats(), CallStats { calls: 3, open: 1, answered: 1 });
        assert_eq!(caller.take_lost(), [lost(CallLoss::OwnerRestarted, 10)]);
        assert_eq!(caller.take_lost(), []);
    }

    #[test]
    fn open_calls_are_bounded_for_each_client_and_in_all() {
        let (mut caller, now) = caller();
        for n in 0..2 {
            caller.call(now, [1; 16], n, payload("x")).unwrap();
        }
        assert_eq!(caller.call(now, [1; 16], 2, payload("x")), Err(CallRefusal::Client { max: 2 }));
        caller.call(now, [2; 16], 3, payload("x")).unwrap();
        assert_eq!(caller.call(now, [2; 16], 4, payload("x")), Err(CallRefusal::Calls { max: 3 }));
        assert_eq!(caller.client_gone(|local| *local == 0), [1]);
        let large = Bytes::from(vec![0; CallLimits::default().open_bytes_max]);
        assert!(matches!(caller.call(now, [3; 16], 5, large), Err(CallRefusal::Bytes { .. })));
        assert_eq!(caller.stats(), CallStats { calls: 3, open: 2, answered: 0 });
        let [refused, gone] = [CallLoss::Refused, CallLoss::ClientGone];
        let all = [(refused, 2), (refused, 4), (gone, 0), (refused, 5)].map(|(loss, of)| lost(loss, of));
        assert_eq!(caller.take_lost(), all);
    }

    #[test]
    fn it_is_asked_ever_less_often_what_became_of_a_call_and_never_given_up() {
        let (mut caller, now) = caller();
        caller.granted(now, true);
        caller.call(now, [1; 16], 10, payload("a")).unwrap();
        let mut at = now;
        let mut waits = Vec::new();
        for _ in 0..10 {
            let due = caller.deadline().unwrap();
            assert_eq!(caller.ask_due(due - Duration::from_millis(1)), [0; 0]);
            assert_eq!(caller.ask_due(due), [1]);
            waits.push((due - at).as_secs());
            at = due;
        }
        assert_eq!(waits, [5, 10, 20, 40, 80, 160, 300, 300, 300, 300]);
        assert_eq!(caller.handle(MessageKind::Unknown, 1, b""), Outcome::Again(payload("a")));
        assert_eq!(caller.handle(MessageKind::Reply, 1, b""), Outcome::Answers(10));
        assert_eq!(caller.deadline(), None);
        assert_eq!(caller.handle(MessageKind::Unknown, 1, b""), Outcome::Nothing);
    }

    #[test]
    fn a_call_asked_twice_is_carried_out_once() {
        let mut answerer = answerer();
        let request = MessageKind::Request;
        assert_eq!(answerer.handle(A, request, 1), Answering::Ask);
        assert_eq!(answerer.handle(A, request, 1), Answering::Nothing);
        answerer.asked(A, 1, 70, one());
        // The same number of another source is another call.
        assert_eq!(answerer.handle(B, request, 1), Answering::Ask);
        answerer.asked(B, 1, 71, one());
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), Answering::Nothing);
        assert_eq!(answerer.answered(&70, &payload("yes")), Some((A, 1)));
        assert_eq!(answerer.answered(&70, &payload("yes")), None);
        for kind in [request, MessageKind::Ask] {
            assert_eq!(answerer.handle(A, kind, 1), tell(MessageKind::Reply, "yes"));
        }
        assert_eq!(answerer.handle(A, MessageKind::Ask, 2), tell(MessageKind::Unknown, ""));
        answerer.handle(A, MessageKind::Forget, 1);
        for kind in [request, MessageKind::Ask] {
            assert_eq!(answerer.handle(A, kind, 1), gone(CallLoss::Forgotten));
        }
        assert_eq!(answerer.stats(), CallStats { calls: 2, open: 1, answered: 1 });
        assert_eq!(answerer.take_lost(), []);
    }

    #[test]
    fn a_call_may_be_asked_again_only_if_no_server_got_it() {
        let mut answerer = answerer();
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.not_asked(A, 1);
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), tell(MessageKind::Unknown, ""));
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.asked(A, 1, 5, one());
        assert_eq!(answerer.servers_gone(), [(A, 1, CallLoss::ServerGone.payload())]);
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), gone(CallLoss::ServerGone));
        assert_eq!(answerer.answered(&5, &payload("late")), None);
        assert_eq!(answerer.open(), 0);
        // A client that is gone while the server is at work.
        assert_eq!(answerer.handle(A, MessageKind::Request, 2), Answering::Ask);
        answerer.asked(A, 2, 6, one());
        answerer.handle(A, MessageKind::Forget, 2);
        assert_eq!((answerer.open(), answerer.answered(&6, &payload("x"))), (0, None));
        // And one that is gone before the server is asked.
        assert_eq!(answerer.handle(A, MessageKind::Request, 3), Answering::Ask);
        answerer.handle(A, MessageKind::Forget, 3);
        answerer.asked(A, 3, 7, one());
        let losses = [CallLoss::ServerGone, CallLoss::ClientGone, CallLoss::ClientGone];
        assert_eq!(answerer.take_lost(), losses.map(|loss| lost(loss, A)));
        assert_eq!((answerer.open(), answerer.stats().calls), (0, 3));
    }

    #[test]
    fn call_is_lost_with_the_last_server_that_was_asked() {
        let mut answerer = answerer();
        let ask = |answerer: &mut Answerer<u32, u8>, number: u64, servers: &[u8]| {
            assert_eq!(answerer.handle(A, MessageKind::Request, number), Answering::Ask);
            answerer.asked(A, number, number as u32, servers.iter().copied().collect());
        };
        ask(&mut answerer, 1, &[0]);
        ask(&mut answerer, 2, &[0]);
        // Another server is started before the end of the first is noticed.
        ask(&mut answerer, 3, &[0, 1]);
        assert_eq!(answerer.server_gone(&2), []);
        let gone = |number| (A, number, CallLoss::ServerGone.payload());
        assert_eq!(answerer.server_gone(&0), [gone(1), gone(2)]);
        assert_eq!(answerer.answered(&3, &payload("3")), Some((A, 3)));
        ask(&mut answerer, 4, &[1, 2]);
        assert_eq!(answerer.server_gone(&1), []);
        assert_eq!(answerer.server_gone(&2), [gone(4)]);
        // Its server went before it could be said who it was.
        ask(&mut answerer, 5, &[]);
        assert_eq!(answerer.lose_unanswerable(), [gone(5)]);
        assert_eq!(answerer.take_lost(), [lost(CallLoss::ServerGone, A); 4]);
    }

    #[test]
    fn every_reason_reaches_the_node_that_called() {
        let (mut caller, now) = caller();
        caller.granted(now, true);
        let mut call = |payload: Bytes| {
            let number = caller.call(now, [1; 16], 7, Bytes::from_static(b"a")).unwrap().unwrap();
            assert_eq!(caller.handle(MessageKind::Gone, number, &payload), Outcome::Nothing);
            assert_eq!(caller.handle(MessageKind::Gone, number, &payload), Outcome::Nothing, "once");
            caller.take_lost()
        };
        let said = [
            CallLoss::ServerGone,
            CallLoss::Forgotten,
            CallLoss::OwnerFull,
            CallLoss::TooLarge,
            CallLoss::ClientGone,
            CallLoss::Withdrawn,
        ];
        for loss in said {
            assert_eq!(call(loss.payload()), [lost(loss, 7)]);
        }
        // Of an earlier version, and of a later one.
        for bytes in [&b""[..], &[99], &[0, 1]] {
            assert_eq!(call(Bytes::from_static(bytes)), [lost(CallLoss::Unsaid, 7)]);
        }
        assert_eq!(call(Bytes::from_static(&[1, 99])), [lost(CallLoss::ServerGone, 7)]);
    }

    #[test]
    fn calls_of_a_service_that_ends_are_lost_at_both_ends() {
        let (mut caller, now) = caller();
        caller.call(now, [1; 16], 10, payload("a")).unwrap();
        caller.granted(now, true);
        caller.call(now, [1; 16], 11, payload("b")).unwrap();
        caller.withdraw();
        assert_eq!(caller.take_lost(), [10, 11].map(|of| lost(CallLoss::Withdrawn, of)));
        assert_eq!((caller.stats().open, caller.deadline()), (0, None));
        let mut answerer = answerer();
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.asked(A, 1, 5, one());
        answerer.withdraw();
        assert_eq!(answerer.take_lost(), [lost(CallLoss::Withdrawn, A)]);
    }

    #[test]
    fn answer_that_arrives_nowhere_is_no_answer() {
        let (mut caller, now) = caller();
        caller.granted(now, true);
        caller.call(now, [1; 16], 10, payload("a")).unwrap();
        assert_eq!(caller.handle(MessageKind::Reply, 1, b"b"), Outcome::Answers(10));
        caller.unheard(10);
        caller.call(now, [1; 16], 11, payload("a")).unwrap();
        caller.lose(2, CallLoss::TooLarge);
        let losses = [lost(CallLoss::Unheard, 10), lost(CallLoss::TooLarge, 11)];
        assert_eq!(caller.take_lost(), losses);
        assert_eq!(caller.stats(), CallStats { calls: 2, open: 0, answered: 0 });
        let mut answerer = answerer();
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.asked(A, 1, 5, one());
        answerer.answered(&5, &payload("large"));
        assert_eq!(answerer.too_large(A, 1), CallLoss::TooLarge.payload());
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), gone(CallLoss::TooLarge));
        assert_eq!(answerer.take_lost(), [lost(CallLoss::TooLarge, A)]);
        assert_eq!((answerer.stats().answered, answerer.answer_bytes), (0, 0));
    }

    #[test]
    fn every_loss_has_a_counter_of_its_own() {
        let keys: BTreeSet<_> = CallLoss::ALL.into_iter().map(CallLoss::key).collect();
        assert_eq!(keys.len(), CallLoss::ALL.len());
    }

    #[test]
    fn memory_is_bounded_and_what_is_forgotten_is_never_begun_again() {
        let limits = CallLimits {
            remembered_per_source_max: 3,
            sources_max: 2,
            answer_bytes_max: 10,
            ..CallLimits::default()
        };
        let mut answerer = Answerer::<u32, u8>::new(limits);
        let call = |answerer: &mut Answerer<u32, u8>, source, number: u64, text| {
            assert_eq!(answerer.handle(source, MessageKind::Request, number), Answering::Ask);
            answerer.asked(source, number, number as u32, one());
            answerer.answered(&(number as u32), &payload(text)).unwrap();
        };
        call(&mut answerer, A, 1, "123456");
        call(&mut answerer, A, 2, "123456");
        // Two answers are too large together.
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), gone(CallLoss::Forgotten));
        assert_eq!(answerer.handle(A, MessageKind::Ask, 2), tell(MessageKind::Reply, "123456"));
        call(&mut answerer, A, 3, "1");
        call(&mut answerer, A, 4, "1");
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), gone(CallLoss::Forgotten));
        assert_eq!(answerer.handle(A, MessageKind::Request, 3), tell(MessageKind::Reply, "1"));
        // All that is remembered is under way.
        for number in 5..8 {
            assert_eq!(answerer.handle(A, MessageKind::Request, number), Answering::Ask);
            answerer.asked(A, number, number as u32, one());
        }
        assert_eq!(answerer.handle(A, MessageKind::Request, 8), gone(CallLoss::OwnerFull));
        assert_eq!(answerer.take_lost(), [lost(CallLoss::OwnerFull, A)]);
        // Sources give way to newer ones, unless they wait for something.
        call(&mut answerer, B, 100, "b");
        call(&mut answerer, SourceId([3; 16]), 101, "c");
        assert_eq!(answerer.sources.keys().copied().collect::<Vec<_>>(), [A, SourceId([3; 16])]);
        assert_eq!(answerer.answer_bytes, 1);
    }
}
