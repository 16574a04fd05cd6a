//! Labels that this node gives to names on one link, for the packets that it sends (`docs/spec/wire.md`, labels). What
//! the peer's labels stand for is with the link itself.

use std::collections::HashMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

use sgc_wire::{Label, Name};

/// How far both sides are: given by this node, and known to the peer.
#[derive(Debug, Default)]
pub(crate) struct Progress {
    given: AtomicU32,
    known: AtomicU32,
}

impl Progress {
    /// The peer knows this label and all before it; false if it was never given.
    pub(crate) fn acknowledge(&self, label: Label) -> bool {
        let is_given = label.index() < self.given.load(Relaxed);
        if is_given {
            self.known.fetch_max(label.index() + 1, Relaxed);
        }
        is_given
    }

    /// How many labels the peer knows.
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
    /// The label, once the peer knows it.
    pub(crate) fn known(&self) -> Option<Label> {
        (self.label.index() < self.progress.known()).then_some(self.label)
    }
}

/// Gives the labels of one link: in order, one to a name for as long as the link lives, so that none ever means two
/// names to packets that are under way.
#[derive(Debug, Default)]
pub(crate) struct LabelBook {
    names: HashMap<Name, Label>,
    progress: Arc<Progress>,
}

impl LabelBook {
    /// The book of a link on which the peer's acknowledgements are taken down in `progress`.
    pub(crate) fn new(progress: Arc<Progress>) -> Self {
        Self { names: HashMap::new(), progress }
    }

    /// How many the peer knows.
    pub(crate) fn known(&self) -> u32 {
        self.progress.known()
    }

    /// The label of a name. A new one has to be told to the peer by `tell`, which may fail; without one, also where
    /// there are no more, packets carry the name.
    pub(crate) fn label(&mut self, name: Name, tell: impl FnOnce(Label) -> bool) -> Option<NameLabel> {
        let label = match self.names.get(&name) {
            Some(label) => *label,
            None => {
                let next = self.progress.given.load(Relaxed);
                let label = Label::new(next)?;
                // Before it is told: the answer may be here at once.
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
        // The name goes and comes back.
        assert_eq!(book.label(name(1), |_| panic!("told already")).unwrap().known(), Label::new(1));
        for index in 3..LABELS_MAX {
            assert!(book.label(name(index), |_| true).is_some());
        }
        assert!(book.label(name(LABELS_MAX), |_| true).is_none());
        assert!(book.label(name(0), |_| false).is_some());
    }
}
