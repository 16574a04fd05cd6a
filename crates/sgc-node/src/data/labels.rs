//! Labels that this node gives to names on one link, for packets that it sends (`docs/spec/wire.md`, labels). The link
//! itself keeps the peer's labels.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use sgc_wire::{Label, Name};

/// Numbers of labels given by this node, and known to the peer.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    given: AtomicU32,
    known: AtomicU32,
}

impl Progress {
    /// Notes that the peer knows this label and all before it. Returns `false` if it was never given.
    pub(crate) fn acknowledge(&self, label: Label) -> bool {
        let is_given = label.index() < self.given.load(Relaxed);
        if is_given {
            self.known.fetch_max(label.index() + 1, Relaxed);
        }
        is_given
    }

    /// Returns the number of labels that the peer knows.
    pub(crate) fn known(&self) -> u32 {
        self.known.load(Relaxed)
    }
}

/// The label of one name on one link.
#[derive(Clone, Debug)]
pub(crate) struct NameLabel {
    label: Label,
    progress: Arc<Progress>,
}

impl NameLabel {
    /// Returns the label, once the peer knows it.
    pub(crate) fn known(&self) -> Option<Label> {
        (self.label.index() < self.progress.known()).then_some(self.label)
    }
}

/// Gives the labels of one link in order. A label belongs to one name for the life of the link, so it stays unambiguous
/// for packets under way.
#[derive(Debug, Default)]
pub(crate) struct LabelBook {
    names: HashMap<Name, Label>,
    progress: Arc<Progress>,
}

impl LabelBook {
    /// Creates the book of a link. Acknowledgements of the peer are recorded in `progress`.
    pub(crate) fn new(progress: Arc<Progress>) -> Self {
        Self { names: HashMap::new(), progress }
    }

    /// Returns the number of labels that the peer knows.
    pub(crate) fn known(&self) -> u32 {
        self.progress.known()
    }

    /// Returns the label of a name. `tell` announces a new label to the peer and may fail. Without a label, as when all
    /// are used, packets carry the name.
    pub(crate) fn label(&mut self, name: Name, tell: impl FnOnce(Label) -> bool) -> Option<NameLabel> {
        let label = match self.names.get(&name) {
            Some(label) => *label,
            None => {
                let next = self.progress.given.load(Relaxed);
                let label = Label::new(next)?;
                // The count is raised before the announcement, since the answer may arrive at once.
                self.progress.given.store(next + 1, Relaxed);
                if !tell(label) {
                    self.progress.given.store(next, Relaxed);
                    return None;
                }
                self.names.insert(name, label);
                label
            }
        };
        Some(NameLabel { label, progress: self.progress.clone() })
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::LABELS_MAX;

    use super::*;

    fn name(index: u32) -> Name {
        let mut name = [0; 32];
        name[..4].copy_from_slice(&index.to_be_bytes());
        Name(name)
    }

    #[test]
    fn labels_are_used_once_the_peer_knows_them_and_never_for_two_names() {
        let progress = Arc::<Progress>::default();
        let mut book = LabelBook::new(progress.clone());
        assert!(book.label(name(9), |_| false).is_none());
        let labels: Vec<_> = (0..3).map(|i| book.label(name(i), |l| l.index() == i).unwrap()).collect();
        assert!(!progress.acknowledge(Label::new(3).unwrap()));
        assert!(labels.iter().all(|l| l.known().is_none()));
        assert!(progress.acknowledge(Label::new(1).unwrap()));
        assert_eq!(labels.iter().filter_map(NameLabel::known).map(Label::index).collect::<Vec<_>>(), [0, 1]);
        // The name is released and requested again.
        assert_eq!(book.label(name(1), |_| panic!("told already")).unwrap().known(), Label::new(1));
        for index in 3..LABELS_MAX {
            assert!(book.label(name(index), |_| true).is_some());
        }
        assert!(book.label(name(LABELS_MAX), |_| true).is_none());
        assert!(book.label(name(0), |_| false).is_some());
    }
}
