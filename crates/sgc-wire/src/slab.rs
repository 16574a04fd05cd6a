//! [`Slab`]: memory that several small packets share, so that not each of them is an allocation. It does not look at
//! the content.

use bytes::BytesMut;

/// Packets that share a piece of memory. It is held until the last of them is gone, so they are few.
const SHARERS: usize = 8;
/// Longest packet in shared memory, bytes; a longer one has memory of its own.
const SHARED_BYTES_MAX: usize = 4096;

/// Hands out memory. An earlier piece is used again once all of it has come back, so that a few packets in flight at a
/// time allocate nothing.
#[derive(Debug, Default)]
pub struct Slab {
    free: BytesMut,
    spent: BytesMut,
}

impl Slab {
    /// Returns an empty buffer with room for exactly this many bytes.
    pub fn room(&mut self, bytes: usize) -> BytesMut {
        if bytes > SHARED_BYTES_MAX {
            return BytesMut::with_capacity(bytes);
        }
        if self.free.capacity() < bytes {
            std::mem::swap(&mut self.free, &mut self.spent);
            if !self.free.try_reclaim(bytes) {
                self.free = BytesMut::with_capacity(bytes * SHARERS);
            }
        }
        let rest = self.free.split_off(bytes);
        std::mem::replace(&mut self.free, rest)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_has_its_own_part() {
        let mut slab = Slab::default();
        let rooms: Vec<_> = [5, 0, 5, 100, 4096, 4097, 3]
            .into_iter()
            .enumerate()
            .map(|(n, bytes)| {
                let mut room = slab.room(bytes);
                assert!(room.is_empty() && room.capacity() >= bytes);
                room.resize(bytes, n as u8);
                room.freeze()
            })
            .collect();
        for (n, room) in rooms.iter().enumerate() {
            assert!(room.iter().all(|byte| usize::from(*byte) == n), "{n}");
        }
    }

    #[test]
    fn returned_memory_is_used_again() {
        let mut slab = Slab::default();
        let mut places = std::collections::BTreeSet::new();
        for n in 0..100 * SHARERS {
            let mut room = slab.room(100);
            room.resize(100, n as u8);
            places.insert(room.freeze().as_ptr());
        }
        assert_eq!(places.len(), 2 * SHARERS);
        // Memory that is still held is not handed out.
        let held: Vec<_> = (0..10 * SHARERS).map(|_| slab.room(100)).collect();
        let places: std::collections::BTreeSet<_> = held.iter().map(|room| room.as_ptr()).collect();
        assert_eq!(places.len(), held.len());
    }

    #[test]
    fn short_pieces_share_memory_and_long_ones_do_not() {
        let place = |room: &BytesMut| room.as_ptr() as usize;
        let mut slab = Slab::default();
        let rooms: Vec<_> = (0..SHARERS).map(|_| slab.room(100)).collect();
        assert!(rooms.windows(2).all(|two| place(&two[1]) - place(&two[0]) == 100));
        assert_eq!(slab.free.capacity(), 0);
        drop(slab.room(SHARED_BYTES_MAX + 1));
        assert_eq!(slab.free.capacity(), 0);
    }
}
