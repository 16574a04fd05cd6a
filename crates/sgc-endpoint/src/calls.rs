//! Calls of a service by name: [`Caller`] remembers what is not answered yet, [`Answerer`] what was asked.
//!
//! Messages carry the call's number at the source that asks. Whatever breaks between the two, a call is published
//! again until it is answered, and is carried out once, since the answerer knows it again: what is under way is not
//! begun twice, what is done is answered from memory, and of what it remembers no more it says so. Nothing here ends
//! a call by time: it lives as long as its client.
//!
//! Sending, sealing and the local network are the driver's. `L` is how that one tells local calls apart.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_wire::{MessageKind, SourceId};

/// When it is asked first what became of a call; each time later it is twice as long, up to [`ASK_EVERY_MAX`].
pub const ASK_AFTER: Duration = Duration::from_secs(5);
/// How long it is at most between two such questions.
pub const ASK_EVERY_MAX: Duration = Duration::from_secs(300);
/// An answer that is larger is acknowledged, so that it need not be remembered.
pub const ANSWER_KEPT_BYTES_MAX: usize = 64 << 10;

/// Bounds of one service at one node.
#[derive(Clone, Debug)]
pub struct CallLimits {
    /// Calls of one local client that are not answered.
    pub open_per_client_max: usize,
    /// Calls of all.
    pub open_max: usize,
    /// Bytes of their requests.
    pub open_bytes_max: usize,
    /// Calls of one source that are remembered, under way or over.
    pub remembered_per_source_max: usize,
    /// Sources whose calls are remembered.
    pub sources_max: usize,
    /// Bytes of answers that are remembered; the newest is, whatever its size.
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

/// What became of the calls of one service, so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct CallStats {
    /// Calls taken.
    pub calls: u64,
    /// Those that wait for their answer.
    pub open: u64,
    /// Those that were answered.
    pub answered: u64,
    /// Calls that were not taken: too many at once.
    pub refused: u64,
    /// Those that will not be answered: their client, their server or what was remembered of them is gone.
    pub lost: u64,
}

/// Why a local call is not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CallRefused {
    /// Too many of this client wait for their answers.
    #[error("a client has {max} calls without an answer")]
    Client {
        /// The bound.
        max: usize,
    },
    /// Too many of all clients do.
    #[error("{max} calls are without an answer")]
    Calls {
        /// The bound.
        max: usize,
    },
    /// Their requests are too large together.
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
    /// True if it was published: it may have arrived.
    published: bool,
    ask_at: Instant,
    ask_after: Duration,
}

/// What an answer comes to at who called.
#[derive(Debug, PartialEq, Eq)]
pub enum Outcome<L> {
    /// It belongs to nothing here, or is the second one.
    Nothing,
    /// It answers this local call.
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
    /// True while what is published can arrive.
    granted: bool,
    /// Not later than the first question that is due.
    ask_at: Option<Instant>,
    stats: CallStats,
}

impl<L: Copy> Caller<L> {
    /// No calls yet.
    pub fn new(limits: CallLimits) -> Self {
        Self {
            limits,
            next: 1,
            open: BTreeMap::new(),
            bytes: 0,
            granted: false,
            ask_at: None,
            stats: CallStats::default(),
        }
    }

    /// Takes a call of a local client. Its number, if it is to be published at once; otherwise it waits for
    /// [`Self::granted`].
    pub fn call(
        &mut self,
        now: Instant,
        client: [u8; 16],
        local: L,
        payload: Bytes,
    ) -> Result<Option<u64>, CallRefused> {
        let limits = &self.limits;
        let of_client = self.open.values().filter(|open| open.client == client).count();
        let refused = if of_client >= limits.open_per_client_max {
            Some(CallRefused::Client { max: limits.open_per_client_max })
        } else if self.open.len() >= limits.open_max {
            Some(CallRefused::Calls { max: limits.open_max })
        } else if self.bytes + payload.len() > limits.open_bytes_max {
            Some(CallRefused::Bytes { max: limits.open_bytes_max })
        } else {
            None
        };
        if let Some(why) = refused {
            self.stats.refused += 1;
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

    /// There is a way to the owner, another than before: all that is open is to be published, on it. With `anew` the
    /// owner remembers nothing: what may have arrived is not asked again, since it may have been carried out.
    pub fn granted(&mut self, now: Instant, anew: bool) -> Vec<(u64, Bytes)> {
        if anew {
            let published = self.open.iter().filter(|(_, open)| open.published).map(|(number, _)| *number);
            for number in published.collect::<Vec<_>>() {
                self.lose(number);
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

    /// The way to the owner is lost for now.
    pub fn lost(&mut self) {
        self.granted = false;
    }

    /// Takes what the owner says of a call.
    pub fn handle(&mut self, kind: MessageKind, number: u64) -> Outcome<L> {
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
                self.lose(number);
                Outcome::Nothing
            }
            _ => Outcome::Nothing,
        }
    }

    /// A local client is gone: its calls are over. Their numbers, for the owner to forget them too.
    pub fn client_gone(&mut self, is_of: impl Fn(&L) -> bool) -> Vec<u64> {
        let gone: Vec<_> = self.open.iter().filter(|(_, o)| is_of(&o.local)).map(|(n, _)| *n).collect();
        gone.iter().for_each(|number| self.lose(*number));
        gone
    }

    /// The calls that have been quiet for so long that it is to be asked what became of them.
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

    /// When to look for them.
    pub fn deadline(&self) -> Option<Instant> {
        self.ask_at.filter(|_| self.granted)
    }

    /// What became of them.
    pub fn stats(&self) -> CallStats {
        CallStats { open: self.open.len() as u64, ..self.stats }
    }

    fn lose(&mut self, number: u64) {
        self.stats.lost += u64::from(self.remove(number).is_some());
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

/// A call that is remembered.
#[derive(Debug)]
enum Known<L> {
    /// It is on its way to the local server.
    Asking,
    /// The local server was asked under this id.
    Asked(L),
    Answered(Bytes),
    /// Nothing more is known of it than that it was carried out, or may have been.
    Over,
}

impl<L> Known<L> {
    fn is_open(&self) -> bool {
        matches!(self, Self::Asking | Self::Asked(_))
    }
}

/// What is to be done with what came of a call.
#[derive(Debug, PartialEq, Eq)]
pub enum Answering {
    /// Nothing.
    Nothing,
    /// Ask the local server, then say so by [`Answerer::asked`] or [`Answerer::not_asked`].
    Ask,
    /// Tell who asked.
    Tell(MessageKind, Bytes),
}

#[derive(Debug)]
struct Remembered<L> {
    calls: BTreeMap<u64, Known<L>>,
    /// What is lower and not in `calls` is over.
    from: u64,
    /// Larger is later.
    heard: u64,
}

/// The calls that others make of one local service.
#[derive(Debug)]
pub struct Answerer<L> {
    limits: CallLimits,
    sources: BTreeMap<SourceId, Remembered<L>>,
    local: BTreeMap<L, (SourceId, u64)>,
    /// Answers, oldest first, some of which are here no more.
    answers: VecDeque<(SourceId, u64)>,
    answer_bytes: usize,
    heard: u64,
    stats: CallStats,
}

impl<L: Copy + Ord> Answerer<L> {
    /// No calls yet.
    pub fn new(limits: CallLimits) -> Self {
        Self {
            limits,
            sources: BTreeMap::new(),
            local: BTreeMap::new(),
            answers: VecDeque::new(),
            answer_bytes: 0,
            heard: 0,
            stats: CallStats::default(),
        }
    }

    /// Takes what a source says of a call of its own.
    pub fn handle(&mut self, source: SourceId, kind: MessageKind, number: u64) -> Answering {
        match kind {
            MessageKind::Request => self.request(source, number),
            MessageKind::Ask => self.what_became(source, number),
            MessageKind::Forget => {
                self.forget(source, number);
                Answering::Nothing
            }
            _ => Answering::Nothing,
        }
    }

    /// The local server was asked under this id. An answer that came before is given to [`Self::answered`] after this.
    pub fn asked(&mut self, source: SourceId, number: u64, local: L) {
        if let Some(known) = self.known(&source, number).filter(|known| matches!(known, Known::Asking)) {
            *known = Known::Asked(local);
            self.local.insert(local, (source, number));
        }
    }

    /// The local server could not be asked: who called may ask again.
    pub fn not_asked(&mut self, source: SourceId, number: u64) {
        let remembered = self.sources.get_mut(&source);
        if let Some(remembered) = remembered.filter(|r| matches!(r.calls.get(&number), Some(Known::Asking))) {
            remembered.calls.remove(&number);
            self.stats.calls -= 1;
        }
    }

    /// The local server answered: whom to tell, and of which call.
    pub fn answered(&mut self, local: &L, payload: &Bytes) -> Option<(SourceId, u64)> {
        let (source, number) = self.local.remove(local)?;
        self.stats.answered += 1;
        if let Some(known) = self.known(&source, number) {
            *known = Known::Answered(payload.clone());
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

    /// All local servers are gone: nothing that was asked of them will be answered.
    pub fn servers_gone(&mut self) {
        for (source, number) in std::mem::take(&mut self.local).into_values() {
            self.stats.lost += 1;
            if let Some(known) = self.known(&source, number) {
                *known = Known::Over;
            }
        }
    }

    /// What became of them.
    pub fn stats(&self) -> CallStats {
        CallStats { open: self.open() as u64, ..self.stats }
    }

    /// Calls that the local server was asked and has not answered.
    pub fn open(&self) -> usize {
        self.local.len()
    }

    fn request(&mut self, source: SourceId, number: u64) -> Answering {
        let max = self.limits.remembered_per_source_max;
        self.make_room(&source);
        self.heard += 1;
        let remembered = Remembered { calls: BTreeMap::new(), from: 0, heard: 0 };
        let remembered = self.sources.entry(source).or_insert(remembered);
        remembered.heard = self.heard;
        match remembered.calls.get(&number) {
            Some(Known::Asking | Known::Asked(_)) => return Answering::Nothing,
            Some(Known::Answered(payload)) => return Answering::Tell(MessageKind::Reply, payload.clone()),
            Some(Known::Over) => return Answering::Tell(MessageKind::Gone, Bytes::new()),
            None if number < remembered.from => return Answering::Tell(MessageKind::Gone, Bytes::new()),
            None => {}
        }
        if remembered.calls.len() >= max {
            let Some(oldest) = remembered.calls.iter().find(|(_, k)| !k.is_open()).map(|(n, _)| *n) else {
                self.stats.refused += 1;
                return Answering::Tell(MessageKind::Gone, Bytes::new());
            };
            self.drop_answer(&source, oldest);
            if let Some(remembered) = self.sources.get_mut(&source) {
                remembered.calls.remove(&oldest);
                remembered.from = remembered.from.max(oldest + 1);
            }
        }
        if let Some(remembered) = self.sources.get_mut(&source) {
            remembered.calls.insert(number, Known::Asking);
        }
        self.stats.calls += 1;
        Answering::Ask
    }

    fn what_became(&self, source: SourceId, number: u64) -> Answering {
        let remembered = self.sources.get(&source);
        match remembered.and_then(|r| r.calls.get(&number)) {
            Some(Known::Asking | Known::Asked(_)) => Answering::Nothing,
            Some(Known::Answered(payload)) => Answering::Tell(MessageKind::Reply, payload.clone()),
            Some(Known::Over) => Answering::Tell(MessageKind::Gone, Bytes::new()),
            None if remembered.is_some_and(|r| number < r.from) => {
                Answering::Tell(MessageKind::Gone, Bytes::new())
            }
            None => Answering::Tell(MessageKind::Unknown, Bytes::new()),
        }
    }

    /// That it was there stays: it may be on another way here once more.
    fn forget(&mut self, source: SourceId, number: u64) {
        self.drop_answer(&source, number);
        let Some(known) = self.known(&source, number) else { return };
        if let Known::Asked(local) = std::mem::replace(known, Known::Over) {
            self.local.remove(&local);
            self.stats.lost += 1;
        }
    }

    fn known(&mut self, source: &SourceId, number: u64) -> Option<&mut Known<L>> {
        self.sources.get_mut(source)?.calls.get_mut(&number)
    }

    fn drop_answer(&mut self, source: &SourceId, number: u64) {
        if let Some(known) = self.known(source, number)
            && let Known::Answered(payload) = known
        {
            let bytes = payload.len();
            *known = Known::Over;
            self.answer_bytes -= bytes;
        }
        // What is not there any more must not gather.
        if self.answers.len() > 2 * self.limits.remembered_per_source_max {
            let sources = &self.sources;
            let is_there = |(source, number): &(SourceId, u64)| {
                let known = sources.get(source).and_then(|r| r.calls.get(number));
                matches!(known, Some(Known::Answered(_)))
            };
            self.answers.retain(is_there);
        }
    }

    /// Makes room for one more source, if this one is new: of those that wait for nothing the one that was heard of
    /// least lately goes.
    fn make_room(&mut self, source: &SourceId) {
        if self.sources.contains_key(source) || self.sources.len() < self.limits.sources_max {
            return;
        }
        let busy: BTreeSet<_> = self.local.values().map(|(source, _)| *source).collect();
        let idle = self.sources.iter().filter(|(id, _)| !busy.contains(*id));
        let Some(gone) = idle.min_by_key(|(_, r)| r.heard).map(|(id, _)| *id) else { return };
        let numbers: Vec<_> = self.sources[&gone].calls.keys().copied().collect();
        numbers.into_iter().for_each(|number| self.drop_answer(&gone, number));
        self.sources.remove(&gone);
    }
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

    #[test]
    fn a_call_waits_for_a_way_and_goes_again_on_another() {
        let (mut caller, now) = caller();
        assert_eq!(caller.call(now, [1; 16], 10, payload("a")), Ok(None));
        assert_eq!(caller.deadline(), None, "nobody could be asked");
        assert_eq!(caller.granted(now, true), [(1, payload("a"))]);
        assert_eq!(caller.call(now, [1; 16], 11, payload("b")), Ok(Some(2)));
        assert_eq!(caller.handle(MessageKind::Reply, 2), Outcome::Answers(11));
        assert_eq!(caller.handle(MessageKind::Reply, 2), Outcome::Nothing);
        caller.lost();
        assert_eq!(caller.granted(now, false), [(1, payload("a"))]);
        // Another run of the owner remembers nothing: what may have been carried out is not asked again.
        caller.lost();
        assert_eq!(caller.call(now, [1; 16], 12, payload("c")), Ok(None));
        assert_eq!(caller.granted(now, true), [(3, payload("c"))]);
        let stats = CallStats { calls: 3, open: 1, answered: 1, refused: 0, lost: 1 };
        assert_eq!(caller.stats(), stats);
    }

    #[test]
    fn open_calls_are_bounded_for_each_client_and_in_all() {
        let (mut caller, now) = caller();
        for n in 0..2 {
            caller.call(now, [1; 16], n, payload("x")).unwrap();
        }
        assert_eq!(caller.call(now, [1; 16], 2, payload("x")), Err(CallRefused::Client { max: 2 }));
        caller.call(now, [2; 16], 3, payload("x")).unwrap();
        assert_eq!(caller.call(now, [2; 16], 4, payload("x")), Err(CallRefused::Calls { max: 3 }));
        assert_eq!(caller.client_gone(|local| *local == 0), [1]);
        let large = Bytes::from(vec![0; CallLimits::default().open_bytes_max]);
        assert!(matches!(caller.call(now, [3; 16], 5, large), Err(CallRefused::Bytes { .. })));
        assert_eq!(caller.stats(), CallStats { calls: 3, open: 2, answered: 0, refused: 3, lost: 1 });
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
        assert_eq!(caller.handle(MessageKind::Unknown, 1), Outcome::Again(payload("a")));
        assert_eq!(caller.handle(MessageKind::Reply, 1), Outcome::Answers(10));
        assert_eq!(caller.deadline(), None);
        assert_eq!(caller.handle(MessageKind::Unknown, 1), Outcome::Nothing);
    }

    #[test]
    fn what_is_asked_twice_is_carried_out_once() {
        let mut answerer = Answerer::<u32>::new(CallLimits::default());
        let request = MessageKind::Request;
        assert_eq!(answerer.handle(A, request, 1), Answering::Ask);
        assert_eq!(answerer.handle(A, request, 1), Answering::Nothing);
        answerer.asked(A, 1, 70);
        // The same number of another source is another call.
        assert_eq!(answerer.handle(B, request, 1), Answering::Ask);
        answerer.asked(B, 1, 71);
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), Answering::Nothing);
        assert_eq!(answerer.answered(&70, &payload("yes")), Some((A, 1)));
        assert_eq!(answerer.answered(&70, &payload("yes")), None);
        for kind in [request, MessageKind::Ask] {
            assert_eq!(answerer.handle(A, kind, 1), tell(MessageKind::Reply, "yes"));
        }
        assert_eq!(answerer.handle(A, MessageKind::Ask, 2), tell(MessageKind::Unknown, ""));
        answerer.handle(A, MessageKind::Forget, 1);
        for kind in [request, MessageKind::Ask] {
            assert_eq!(answerer.handle(A, kind, 1), tell(MessageKind::Gone, ""));
        }
        assert_eq!(answerer.stats(), CallStats { calls: 2, open: 1, answered: 1, refused: 0, lost: 0 });
    }

    #[test]
    fn what_never_reached_a_server_may_be_asked_again_and_what_died_with_it_may_not() {
        let mut answerer = Answerer::<u32>::new(CallLimits::default());
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.not_asked(A, 1);
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), tell(MessageKind::Unknown, ""));
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), Answering::Ask);
        answerer.asked(A, 1, 5);
        answerer.servers_gone();
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), tell(MessageKind::Gone, ""));
        assert_eq!(answerer.answered(&5, &payload("late")), None);
        assert_eq!(answerer.open(), 0);
        // A client that is gone while the server is at work.
        assert_eq!(answerer.handle(A, MessageKind::Request, 2), Answering::Ask);
        answerer.asked(A, 2, 6);
        answerer.handle(A, MessageKind::Forget, 2);
        assert_eq!((answerer.open(), answerer.answered(&6, &payload("x"))), (0, None));
    }

    #[test]
    fn memory_is_bounded_and_what_is_forgotten_is_never_begun_again() {
        let limits = CallLimits {
            remembered_per_source_max: 3,
            sources_max: 2,
            answer_bytes_max: 10,
            ..CallLimits::default()
        };
        let mut answerer = Answerer::<u32>::new(limits);
        let call = |answerer: &mut Answerer<u32>, source, number: u64, text| {
            assert_eq!(answerer.handle(source, MessageKind::Request, number), Answering::Ask);
            answerer.asked(source, number, number as u32);
            answerer.answered(&(number as u32), &payload(text)).unwrap();
        };
        call(&mut answerer, A, 1, "123456");
        call(&mut answerer, A, 2, "123456");
        // Two answers are too large together.
        assert_eq!(answerer.handle(A, MessageKind::Ask, 1), tell(MessageKind::Gone, ""));
        assert_eq!(answerer.handle(A, MessageKind::Ask, 2), tell(MessageKind::Reply, "123456"));
        call(&mut answerer, A, 3, "1");
        call(&mut answerer, A, 4, "1");
        assert_eq!(answerer.handle(A, MessageKind::Request, 1), tell(MessageKind::Gone, ""));
        assert_eq!(answerer.handle(A, MessageKind::Request, 3), tell(MessageKind::Reply, "1"));
        // All that is remembered is under way.
        for number in 5..8 {
            assert_eq!(answerer.handle(A, MessageKind::Request, number), Answering::Ask);
            answerer.asked(A, number, number as u32);
        }
        assert_eq!(answerer.handle(A, MessageKind::Request, 8), tell(MessageKind::Gone, ""));
        assert_eq!(answerer.stats().refused, 1);
        // Sources give way to newer ones, unless they wait for something.
        call(&mut answerer, B, 100, "b");
        call(&mut answerer, SourceId([3; 16]), 101, "c");
        assert_eq!(answerer.sources.keys().copied().collect::<Vec<_>>(), [A, SourceId([3; 16])]);
        assert_eq!(answerer.answer_bytes, 1);
    }
}
