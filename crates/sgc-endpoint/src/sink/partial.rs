//! Incomplete messages of several fragments. Fragments are authenticated before they come here.

use std::collections::VecDeque;

use bytes::Bytes;
use sgc_wire::{MessageHead, PacketHeader};

use super::delivery::SinkDrop;

/// A message that lacks fragments.
pub(crate) struct Partial {
    seq: u64,
    total: u32,
    grid: u16,
    head: Option<MessageHead>,
    message: Vec<u8>,
    have: Vec<u64>,
    missing: u32,
}

/// The incomplete messages of one source, oldest first.
#[derive(Default)]
pub(crate) struct Partials(VecDeque<Partial>);

impl Partials {
    /// Returns the place of a fragment in a message that was begun and lacks it, to be opened into directly. The first
    /// fragment has no such place, because the message's head stands behind it. The bytes count for nothing until
    /// [`Self::put`].
    pub(crate) fn place(&mut self, header: &PacketHeader) -> Option<&mut [u8]> {
        let partial = self.0.iter_mut().find(|p| p.seq == header.seq)?;
        if header.index == 0 || !partial.matches(header) || partial.has(header.index) {
            return None;
        }
        let start = usize::from(header.index) * usize::from(header.grid);
        partial.message.get_mut(start..start + header.fragment_bytes())
    }

    /// Returns `true` if a fragment of the message is here.
    pub(crate) fn has_begun(&self, seq: u64) -> bool {
        self.0.iter().any(|p| p.seq == seq)
    }

    /// Takes a fragment, which begins its message or belongs to one that has begun; `fragment` is `None` if it was
    /// opened in its place. Returns the number of messages given up to stay below `max`.
    pub(crate) fn put(
        &mut self,
        header: &PacketHeader,
        head: Option<MessageHead>,
        fragment: Option<&[u8]>,
        max: usize,
    ) -> Result<(Option<(MessageHead, Bytes)>, u64), SinkDrop> {
        let mut given_up = 0;
        let at = match self.0.iter().position(|p| p.seq == header.seq) {
            Some(at) => at,
            None => {
                if self.0.len() >= max {
                    self.0.pop_front();
                    given_up += 1;
                }
                self.0.push_back(Partial::new(header));
                self.0.len() - 1
            }
        };
        let partial = &mut self.0[at];
        partial.put(header, head, fragment)?;
        match (partial.missing, partial.head) {
            (0, Some(head)) => {
                let message = self.0.remove(at).map(|p| (head, Bytes::from(p.message)));
                Ok((message, given_up))
            }
            _ => Ok((None, given_up)),
        }
    }

    /// Gives up the messages up to `seq`, and returns their number.
    pub(crate) fn give_up(&mut self, seq: u64) -> u64 {
        let before = self.0.len();
        self.0.retain(|p| p.seq > seq);
        (before - self.0.len()) as u64
    }

    /// Gives up the oldest message, and returns its memory, 0 if there is none.
    pub(crate) fn give_up_oldest(&mut self) -> usize {
        self.0.pop_front().map_or(0, |partial| partial.message.len())
    }

    /// Gives up all.
    pub(crate) fn clear(&mut self) {
        self.0.clear();
    }

    /// Returns the memory of the messages.
    pub(crate) fn bytes(&self) -> usize {
        self.0.iter().map(|p| p.message.len()).sum()
    }
}

impl Partial {
    fn new(header: &PacketHeader) -> Self {
        let fragments = header.fragments();
        Self {
            seq: header.seq,
            total: header.total,
            grid: header.grid,
            head: None,
            message: vec![0; header.total as usize],
            have: vec![0; fragments.div_ceil(64) as usize],
            missing: fragments,
        }
    }

    fn matches(&self, header: &PacketHeader) -> bool {
        (header.total, header.grid) == (self.total, self.grid)
    }

    fn has(&self, index: u16) -> bool {
        self.have[usize::from(index / 64)] & (1 << (index % 64)) != 0
    }

    fn put(
        &mut self,
        header: &PacketHeader,
        head: Option<MessageHead>,
        fragment: Option<&[u8]>,
    ) -> Result<(), SinkDrop> {
        if !self.matches(header) {
            return Err(SinkDrop::Inconsistent);
        }
        if self.has(header.index) {
            return Err(SinkDrop::DuplicateFragment);
        }
        self.have[usize::from(header.index / 64)] |= 1 << (header.index % 64);
        self.missing -= 1;
        if let Some(fragment) = fragment {
            let start = usize::from(header.index) * usize::from(header.grid);
            self.message[start..start + fragment.len()].copy_from_slice(fragment);
        }
        self.head = self.head.or(head);
        Ok(())
    }
}
