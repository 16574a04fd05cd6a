//! A client beside servers that send anything, which checks what holds whatever they do: each operation ends in time,
//! with one result, and memory is bounded.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use bytes::Bytes;
use sgc_router::{StoreAction, StoreEvent, StoreKey, StoreOp, StoreOpId, WriteIf};
use sgc_wire::Name;

use crate::cluster::{Cluster, LinkEvent, LinkId, OP_TIMEOUT, Output};
use crate::config::{StoreConfig, StorePrefix};
use crate::resp::{Decoder, Frame, Limits, RespError};

/// Time by which a result may be late: that between two looks at what is overdue.
const LATE_MAX: Duration = Duration::from_millis(20);
/// Smaller than those of a driver, so that inputs of a fuzzer reach them.
const LIMITS: Limits = Limits { string_bytes_max: 64, frame_bytes_max: 2048 };

/// A client of two servers that are not there.
pub(crate) struct Watched {
    pub(crate) cluster: Cluster,
    pub(crate) now: Instant,
    links: Vec<(LinkId, Decoder)>,
    under_way: BTreeMap<StoreOpId, Instant>,
    next: u64,
}

impl Watched {
    pub(crate) fn new(now: Instant, random: u64) -> Self {
        let servers =
            ["valkey://a:1", "valkey://b:2"].iter().map(|url| url.parse().expect("a URL")).collect();
        let config = StoreConfig::new(servers, StorePrefix::default(), None, None).expect("two servers");
        let cluster = Cluster::new(now, &config, random);
        let mut watched = Self { cluster, now, links: Vec::new(), under_way: BTreeMap::new(), next: 0 };
        watched.check();
        watched
    }

    /// Takes all steps for the driver, and checks them.
    fn check(&mut self) {
        while let Some(output) = self.cluster.poll_output() {
            match output {
                Output::Open { link, .. } => self.links.push((link, Decoder::new(LIMITS))),
                Output::Close { link } => self.links.retain(|(open, _)| *open != link),
                Output::Event(StoreEvent::Reply { id, .. }) => {
                    let begun = self.under_way.remove(&id).expect("one result of each operation");
                    let took = self.now - begun;
                    assert!(took <= OP_TIMEOUT + LATE_MAX, "{took:?}");
                }
                Output::Event(_) | Output::Send { .. } | Output::Warn(_) | Output::Inform(_) => {}
            }
        }
        self.cluster.assert_bounded();
    }

    /// Begins an operation, if there is room for it.
    pub(crate) fn begin(&mut self, action: u8, key: u8) {
        if !self.cluster.has_room() {
            return;
        }
        let key = StoreKey::Name(Name([key; 32]));
        let value = Bytes::from_static(b"value");
        let action = match action % 3 {
            0 => StoreAction::Read,
            1 => StoreAction::Remove { value },
            _ => StoreAction::Write { value, lifetime: None, condition: WriteIf::Always },
        };
        let id = StoreOpId(self.next);
        self.next += 1;
        self.under_way.insert(id, self.now);
        self.cluster.handle_op(self.now, StoreOp { id, key, action });
        self.check();
    }

    /// Lets a link have news. Has no effect without any link.
    pub(crate) fn link(&mut self, which: usize, event: LinkEvent) {
        let Some(place) = which.checked_rem(self.links.len()) else { return };
        let link = self.links[place].0;
        if matches!(event, LinkEvent::Closed(_)) {
            self.links.remove(place);
        }
        self.cluster.handle_link(self.now, link, event);
        self.check();
    }

    /// Lets a server send bytes.
    #[cfg(feature = "fuzzing")]
    fn receive(&mut self, which: usize, bytes: &[u8]) {
        let Some(place) = which.checked_rem(self.links.len()) else { return };
        let link = self.links[place].0;
        self.links[place].1.buffer().extend_from_slice(bytes);
        // The link may be closed by a frame, and another take its place.
        while let Some(place) = self.links.iter().position(|(open, _)| *open == link) {
            match self.links[place].1.next_frame() {
                Ok(Some(frame)) => self.link(place, LinkEvent::Frame(frame)),
                Ok(None) => return,
                Err(error) => return self.link(place, LinkEvent::Closed(error.to_string())),
            }
        }
    }

    /// Lets time go by, until something is due at most.
    pub(crate) fn wait(&mut self, time: Duration) {
        let due = self.cluster.next_timeout(self.now).max(self.now);
        self.now = due.min(self.now + time);
        if self.now >= due {
            self.cluster.handle_timeout(self.now);
            self.check();
        }
    }
}

/// Reads bytes as a server's, whole and in pieces of several lengths, which must make no difference.
pub(crate) fn decode_in_pieces(bytes: &[u8], limits: Limits) -> Result<Vec<Frame>, RespError> {
    let of_pieces = |piece: usize| {
        let mut decoder = Decoder::new(limits);
        let mut frames = Vec::new();
        for piece in bytes.chunks(piece) {
            decoder.buffer().extend_from_slice(piece);
            while let Some(frame) = decoder.next_frame()? {
                frames.push(frame);
            }
        }
        Ok(frames)
    };
    let whole = of_pieces(bytes.len().max(1));
    for piece in [1, 2, 3, 7] {
        assert_eq!(of_pieces(piece), whole, "in pieces of {piece}");
    }
    whole
}

/// Reads bytes as a server's.
#[cfg(feature = "fuzzing")]
pub fn fuzz_replies(bytes: &[u8]) {
    // A rule that is broken is no defect; a difference between pieces is.
    let _ = decode_in_pieces(bytes, LIMITS);
}

/// Lets operations begin, servers send bytes and time go by, as the input says: two bytes of a step, and what it takes.
#[cfg(feature = "fuzzing")]
pub fn fuzz_servers(mut input: &[u8]) {
    let mut watched = Watched::new(Instant::now(), 1);
    while let [step, about, rest @ ..] = input {
        input = rest;
        let which = usize::from(step >> 4);
        match step & 15 {
            0..4 => watched.begin(*step, *about),
            4 => watched.link(which, LinkEvent::Ready),
            5 => watched.link(which, LinkEvent::Closed("gone".to_owned())),
            6..9 => watched.wait(Duration::from_millis(u64::from(*about) * 4)),
            _ => {
                let (bytes, rest) = input.split_at(usize::from(*about).min(input.len()));
                input = rest;
                watched.receive(which, bytes);
            }
        }
    }
    // Everything ends without an answer, too.
    for _ in 0..1000 {
        watched.wait(LATE_MAX);
    }
    assert!(watched.under_way.is_empty(), "operations without end: {:?}", watched.under_way);
}
