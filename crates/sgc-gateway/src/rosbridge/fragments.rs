//! [`Fragments`]: messages that clients send in fragments (op `fragment`), assembled within bounds.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use tokio::time::Instant;

use super::op::OpId;

/// Most incomplete messages. Beyond that the oldest is given up.
const MESSAGES_MAX: usize = 16;
/// Most fragments of one message.
const PIECES_MAX: usize = 65_536;
/// Longest wait after the last new fragment (`fragment_timeout` of `rosbridge_suite`).
pub(super) const PIECE_WAIT_MAX: Duration = Duration::from_secs(600);
/// Longest wait after the first fragment.
pub(super) const MESSAGE_WAIT_MAX: Duration = Duration::from_secs(3600);
/// Cost of a fragment in bytes beside its text.
const PIECE_OVERHEAD_BYTES: usize = 64;

/// The reason why a fragment is refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(super) enum FragmentError {
    #[error("a message of {0} pieces: 1 to {PIECES_MAX}")]
    Total(usize),
    #[error("piece {number} of {total}: they count from 0")]
    Number { number: usize, total: usize },
    #[error("the pieces of one message say different totals")]
    Differ,
    #[error("the pieces are more than {0} bytes")]
    TooLong(usize),
}

/// The incomplete messages.
#[derive(Debug)]
pub(super) struct Fragments {
    bytes_max: usize,
    bytes: usize,
    /// The oldest message first.
    messages: VecDeque<Partial>,
}

#[derive(Debug)]
struct Partial {
    id: OpId,
    total: usize,
    bytes: usize,
    pieces: BTreeMap<usize, String>,
    began: Instant,
    /// The time of the last new fragment.
    grew: Instant,
}

impl Partial {
    /// Returns the time at which the message is given up.
    fn ends(&self) -> Instant {
        (self.grew + PIECE_WAIT_MAX).min(self.began + MESSAGE_WAIT_MAX)
    }
}

impl Fragments {
    pub(super) fn new(bytes_max: usize) -> Self {
        Self { bytes_max, bytes: 0, messages: VecDeque::new() }
    }

    /// Returns the number of kept bytes.
    pub(super) fn bytes(&self) -> usize {
        self.bytes
    }

    /// Adds a fragment and returns the message if it is complete. A repeated fragment is ignored. An error drops the
    /// whole message.
    pub(super) fn take(
        &mut self,
        id: &OpId,
        number: usize,
        total: usize,
        data: String,
        now: Instant,
    ) -> Result<Option<String>, FragmentError> {
        if total == 0 || total > PIECES_MAX {
            return Err(FragmentError::Total(total));
        }
        if number >= total {
            return Err(FragmentError::Number { number, total });
        }
        let mut partial = match self.messages.iter().position(|partial| partial.id == *id) {
            Some(at) => self.remove(at),
            None => None,
        }
        .unwrap_or_else(|| Partial {
            id: id.clone(),
            total,
            bytes: 0,
            pieces: BTreeMap::new(),
            began: now,
            grew: now,
        });
        if partial.total != total {
            return Err(FragmentError::Differ);
        }
        if let std::collections::btree_map::Entry::Vacant(place) = partial.pieces.entry(number) {
            partial.bytes += data.len() + PIECE_OVERHEAD_BYTES;
            place.insert(data);
            partial.grew = now;
        }
        if partial.pieces.len() == total {
            let texts = partial.pieces.into_values();
            return Ok(Some(texts.collect()));
        }
        if partial.bytes > self.bytes_max {
            return Err(FragmentError::TooLong(self.bytes_max));
        }
        while self.messages.len() >= MESSAGES_MAX || self.bytes + partial.bytes > self.bytes_max {
            if self.remove(0).is_none() {
                break;
            }
        }
        self.bytes += partial.bytes;
        self.messages.push_back(partial);
        Ok(None)
    }

    /// Returns the time at which the next message is given up.
    pub(super) fn next_end(&self) -> Option<Instant> {
        self.messages.iter().map(Partial::ends).min()
    }

    /// Gives up a message whose fragments are late, and returns its id.
    pub(super) fn give_up(&mut self, now: Instant) -> Option<OpId> {
        let at = self.messages.iter().position(|partial| partial.ends() <= now)?;
        self.remove(at).map(|partial| partial.id)
    }

    fn remove(&mut self, at: usize) -> Option<Partial> {
        let partial = self.messages.remove(at)?;
        self.bytes -= partial.bytes;
        Some(partial)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(number: i64) -> OpId {
        OpId::Number(number)
    }

    #[test]
    fn pieces_in_any_order_are_put_together_once() {
        let mut fragments = Fragments::new(1000);
        let now = Instant::now();
        let mut take = |number, data: &str| fragments.take(&id(1), number, 3, data.into(), now).unwrap();
        assert_eq!(take(2, "c"), None);
        assert_eq!(take(0, "a"), None);
        assert_eq!(take(0, "other"), None);
        assert_eq!(take(1, "b"), Some("abc".into()));
        assert_eq!((fragments.bytes, fragments.messages.len()), (0, 0));
    }

    #[test]
    fn kept_fragments_are_bounded() {
        let (mut fragments, now) = (Fragments::new(1000), Instant::now());
        for number in 0..100 {
            assert_eq!(fragments.take(&id(number), 0, 2, "x".repeat(200), now), Ok(None));
            assert!(fragments.bytes <= 1000 && fragments.messages.len() <= MESSAGES_MAX);
        }
        let long = "x".repeat(1000);
        assert_eq!(fragments.take(&id(7), 0, 2, long, now), Err(FragmentError::TooLong(1000)));
        assert_eq!(fragments.take(&id(7), 2, 2, String::new(), now).unwrap_err().to_string(), {
            "piece 2 of 2: they count from 0"
        });
        assert!(fragments.take(&id(7), 0, 1 << 40, String::new(), now).is_err());
        fragments.take(&id(8), 0, 2, String::new(), now).unwrap();
        assert_eq!(fragments.take(&id(8), 1, 3, String::new(), now), Err(FragmentError::Differ));
        assert_eq!(fragments.take(&id(8), 1, 2, String::new(), now), Ok(None));
    }
    #[test]
    fn a_message_whose_pieces_do_not_come_in_time_is_given_up() {
        let (mut fragments, began) = (Fragments::new(1000), Instant::now());
        let second = Duration::from_secs(1);
        let data = || "x".repeat(10);
        assert_eq!(fragments.next_end(), None);
        fragments.take(&id(1), 0, 100, data(), began).unwrap();
        // A repeated fragment does not extend the wait; a new one does.
        fragments.take(&id(1), 0, 100, data(), began + 500 * second).unwrap();
        assert_eq!(fragments.next_end(), Some(began + PIECE_WAIT_MAX));
        fragments.take(&id(2), 0, 2, data(), began + 500 * second).unwrap();
        assert_eq!(fragments.give_up(began + PIECE_WAIT_MAX - second), None);
        assert_eq!(fragments.give_up(began + PIECE_WAIT_MAX), Some(id(1)));
        assert_eq!(fragments.give_up(began + PIECE_WAIT_MAX), None);
        assert_eq!(fragments.bytes(), data().len() + PIECE_OVERHEAD_BYTES);
        assert_eq!(fragments.give_up(began + 500 * second + PIECE_WAIT_MAX), Some(id(2)));
        assert_eq!((fragments.bytes(), fragments.next_end()), (0, None));
        // Fragments that trickle in do not keep a message forever.
        let mut now = began;
        let pieces = (0..100).take_while(|number| {
            fragments.take(&id(3), *number, 100, data(), now).unwrap();
            now += 500 * second;
            fragments.give_up(now).is_none()
        });
        assert_eq!(pieces.count(), 7);
        assert_eq!(fragments.bytes(), 0);
    }
}
