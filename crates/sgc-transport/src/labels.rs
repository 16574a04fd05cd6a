//! Names behind the labels of one link, as the peer defined them. The driver gives labels to names and tells the peer
//! (`docs/spec/wire.md`, labels).

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU32, Ordering};

use sgc_wire::{LABELS_MAX, Label, Name};

use crate::error::LabelError;

const CHUNK: usize = 256;
const CHUNKS: usize = LABELS_MAX as usize / CHUNK;

type Chunk = [OnceLock<Name>; CHUNK];

/// The names under their labels. It only grows, up to [`LABELS_MAX`] names; readers take no lock.
#[derive(Debug)]
pub(crate) struct Labels {
    chunks: Box<[OnceLock<Box<Chunk>>; CHUNKS]>,
    defined: AtomicU32,
}

impl Default for Labels {
    fn default() -> Self {
        let chunks = Box::new(std::array::from_fn(|_| OnceLock::new()));
        Self { chunks, defined: AtomicU32::new(0) }
    }
}

impl Labels {
    /// Defines the next label. Any other label is refused, also one that is defined already: this bounds the memory,
    /// and keeps a packet from meaning two names.
    pub(crate) fn define(&self, label: Label, name: Name) -> Result<(), LabelError> {
        let expected = self.defined.load(Ordering::Acquire);
        let error = LabelError { found: label.index(), expected };
        let (chunk, at) = place(label);
        let chunk = self.chunks.get(chunk).filter(|_| label.index() == expected).ok_or(error)?;
        let chunk = chunk.get_or_init(|| Box::new(std::array::from_fn(|_| OnceLock::new())));
        // Only one of two concurrent callers sets the name.
        chunk.get(at).ok_or(error)?.set(name).map_err(|_| error)?;
        self.defined.store(expected + 1, Ordering::Release);
        Ok(())
    }

    /// Returns the name of a label.
    pub(crate) fn name_of(&self, label: Label) -> Option<Name> {
        let (chunk, at) = place(label);
        self.chunks.get(chunk)?.get()?.get(at)?.get().copied()
    }

    /// Returns the number of defined labels.
    pub(crate) fn count(&self) -> u32 {
        self.defined.load(Ordering::Acquire)
    }
}

fn place(label: Label) -> (usize, usize) {
    let index = label.index() as usize;
    (index / CHUNK, index % CHUNK)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(index: u32) -> Name {
        let mut name = [9; 32];
        name[..4].copy_from_slice(&index.to_be_bytes());
        Name(name)
    }

    #[test]
    fn labels_are_given_in_order_once_and_up_to_the_bound() {
        let labels = Labels::default();
        for index in 0..LABELS_MAX {
            let label = Label::new(index).unwrap();
            assert_eq!(labels.name_of(label), None);
            labels.define(label, name(index)).unwrap();
            assert_eq!(labels.name_of(label), Some(name(index)));
            assert_eq!(labels.define(label, name(7)), Err(LabelError { found: index, expected: index + 1 }));
            if let Some(later) = Label::new(index + 2) {
                assert!(labels.define(later, name(7)).is_err());
            }
        }
        assert_eq!(labels.count(), LABELS_MAX);
        assert!((0..LABELS_MAX).all(|i| labels.name_of(Label::new(i).unwrap()) == Some(name(i))));
    }
}
