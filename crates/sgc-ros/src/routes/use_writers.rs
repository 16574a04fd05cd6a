//! [`UseWriters`]: the local writers of a used topic, one for each far publisher.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use sgc_wire::{History, Name, Qos, RosNode, SourceId};

use super::command::Command;
use crate::network::EndpointSpec;

/// A local writer.
#[derive(Debug)]
struct OpenWriter {
    spec: EndpointSpec,
    /// The far node that the writer was announced as part of.
    node: Option<RosNode>,
}

/// The open writers by the source that they write for. The writer without a source writes for all publishers that have
/// none of their own.
#[derive(Debug, Default)]
pub(super) struct UseWriters(BTreeMap<Option<SourceId>, OpenWriter>);

impl UseWriters {
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Iterates over the sources that have a writer of their own.
    pub(super) fn sources(&self) -> impl Iterator<Item = SourceId> {
        self.0.keys().copied().flatten()
    }

    /// Makes the writers those that are wanted, and returns the commands for that. With `keeps_unlisted`, a writer
    /// whose source is not wanted stays open.
    pub(super) fn update(
        &mut self,
        name: Name,
        mut wanted: BTreeMap<Option<SourceId>, EndpointSpec>,
        keeps_unlisted: bool,
    ) -> Vec<Command> {
        let mut commands = self.move_to_new_sources(name, &wanted);
        commands.extend(self.resize(name, &mut wanted));
        if keeps_unlisted {
            for (source, open) in self.0.iter().filter(|(source, _)| source.is_some()) {
                wanted.entry(*source).or_insert_with(|| open.spec.clone());
            }
        }
        self.0.retain(|source, open| {
            let stays = wanted.get(source) == Some(&open.spec);
            if !stays {
                commands.push(Command::CloseWriter { name, source: *source });
            }
            stays
        });
        for (source, spec) in wanted {
            if let Entry::Vacant(place) = self.0.entry(source) {
                commands.push(Command::OpenWriter { name, source, spec: spec.clone() });
                place.insert(OpenWriter { spec, node: None });
            }
        }
        commands
    }

    /// Passes writers to the new sources of their publishers. A publisher whose node restarted has a new source;
    /// locally it keeps its writer.
    fn move_to_new_sources(
        &mut self,
        name: Name,
        wanted: &BTreeMap<Option<SourceId>, EndpointSpec>,
    ) -> Vec<Command> {
        let mut commands = Vec::new();
        for (to, spec) in wanted.iter().filter_map(|(to, spec)| Some(((*to)?, spec))) {
            if self.0.contains_key(&Some(to)) {
                continue;
            }
            let fits = |from: &SourceId, open: &OpenWriter| {
                from.publisher() == to.publisher()
                    && !wanted.contains_key(&Some(*from))
                    && can_serve(&open.spec, spec)
            };
            let mut fitting = self.0.iter().filter_map(|(from, open)| from.filter(|from| fits(from, open)));
            let Some(from) = fitting.next() else { continue };
            if let Some(OpenWriter { spec, .. }) = self.0.remove(&Some(from)) {
                self.0.insert(Some(to), OpenWriter { spec, node: None });
                commands.push(Command::MoveWriter { name, from, to });
            }
        }
        commands
    }

    /// Adopts the depths that have become known. Where only the open writer's depth is known, it becomes the wanted
    /// one: a publisher's depth is constant and was known before its node restarted.
    fn resize(&mut self, name: Name, wanted: &mut BTreeMap<Option<SourceId>, EndpointSpec>) -> Vec<Command> {
        let mut commands = Vec::new();
        for (source, spec) in wanted {
            let Some(open) = self.0.get_mut(source) else { continue };
            if open.spec == *spec || !can_serve(&open.spec, spec) {
                continue;
            }
            if spec.qos.history.is_unsaid() {
                spec.qos.history = open.spec.qos.history;
            } else {
                open.spec = spec.clone();
                commands.push(Command::ResizeWriter { name, source: *source, spec: spec.clone() });
            }
        }
        commands
    }

    /// Notes the far node that a writer represents. Returns `true` if it has to be announced: the writer is open and
    /// was announced as part of another node, or of none.
    pub(super) fn set_node(&mut self, source: Option<SourceId>, node: Option<&RosNode>) -> bool {
        let Some(open) = self.0.get_mut(&source).filter(|open| open.node.as_ref() != node) else {
            return false;
        };
        open.node = node.cloned();
        true
    }

    /// Closes all writers.
    pub(super) fn close(&mut self, name: Name) -> impl Iterator<Item = Command> {
        let open = std::mem::take(&mut self.0);
        open.into_keys().map(move |source| Command::CloseWriter { name, source })
    }
}

/// Returns `true` if an open writer can serve as the wanted one: both are the same, or one of them has an unknown
/// depth.
fn can_serve(open: &EndpointSpec, wanted: &EndpointSpec) -> bool {
    let differ_in_depth = open.qos.history.is_unsaid() && matches!(wanted.qos.history, History::KeepLast(_))
        || wanted.qos.history.is_unsaid() && matches!(open.qos.history, History::KeepLast(_));
    let as_open = || {
        let qos = Qos { history: open.qos.history, ..wanted.qos.clone() };
        EndpointSpec { qos, ..wanted.clone() }
    };
    open == wanted || (wanted.qos.is_transient_local() && differ_in_depth && *open == as_open())
}

#[cfg(test)]
mod tests {
    use sgc_wire::Durability;

    use super::*;

    const NAME: Name = Name([7; 32]);

    /// A source of a publisher; `run` differs with each start of its node.
    fn source(publisher: u8, run: u8) -> SourceId {
        SourceId::from_publisher([publisher; 8], [run; 8])
    }

    fn spec(history: History) -> EndpointSpec {
        EndpointSpec {
            topic: "rt/map".into(),
            type_name: "std_msgs::msg::dds_::String_".into(),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos { durability: Durability::TransientLocal, history, ..Qos::default() },
        }
    }

    fn wanted(all: &[(Option<SourceId>, History)]) -> BTreeMap<Option<SourceId>, EndpointSpec> {
        all.iter().map(|(source, history)| (*source, spec(*history))).collect()
    }

    fn opened(source: Option<SourceId>, history: History) -> Command {
        Command::OpenWriter { name: NAME, source, spec: spec(history) }
    }

    fn closed(source: Option<SourceId>) -> Command {
        Command::CloseWriter { name: NAME, source }
    }

    const FIVE: History = History::KeepLast(5);
    const NINE: History = History::KeepLast(9);

    #[test]
    fn writers_follow_the_sources() {
        let (a, b) = (Some(source(1, 1)), Some(source(2, 1)));
        let mut writers = UseWriters::default();
        assert_eq!(
            writers.update(NAME, wanted(&[(a, FIVE), (None, FIVE)]), false),
            [opened(None, FIVE), opened(a, FIVE)]
        );
        assert_eq!(writers.update(NAME, wanted(&[(a, FIVE), (None, FIVE)]), false), []);
        assert_eq!(
            writers.update(NAME, wanted(&[(b, FIVE)]), false),
            [closed(None), closed(a), opened(b, FIVE)]
        );
        assert_eq!((writers.len(), writers.sources().collect::<Vec<_>>()), (1, vec![source(2, 1)]));
        assert_eq!(writers.close(NAME).collect::<Vec<_>>(), [closed(b)]);
        assert!(writers.is_empty());
    }

    #[test]
    fn writer_passes_to_the_new_source_of_its_publisher_only() {
        let (old, new, other) = (source(1, 1), source(1, 2), source(2, 1));
        let mut writers = UseWriters::default();
        writers.update(NAME, wanted(&[(Some(old), FIVE)]), false);
        let commands = writers.update(NAME, wanted(&[(Some(new), FIVE), (Some(other), FIVE)]), false);
        let moved = Command::MoveWriter { name: NAME, from: old, to: new };
        assert_eq!(commands, [moved, opened(Some(other), FIVE)]);
    }

    #[test]
    fn source_that_is_still_listed_keeps_its_writer() {
        let (old, new) = (source(1, 1), source(1, 2));
        let mut writers = UseWriters::default();
        writers.update(NAME, wanted(&[(Some(old), FIVE)]), false);
        let commands = writers.update(NAME, wanted(&[(Some(old), FIVE), (Some(new), FIVE)]), false);
        assert_eq!(commands, [opened(Some(new), FIVE)]);
    }

    #[test]
    fn depth_is_adopted_once_known_and_never_forgotten() {
        let a = Some(source(1, 1));
        let mut writers = UseWriters::default();
        writers.update(NAME, wanted(&[(a, History::UNSAID)]), false);
        let commands = writers.update(NAME, wanted(&[(a, FIVE)]), false);
        assert_eq!(commands, [Command::ResizeWriter { name: NAME, source: a, spec: spec(FIVE) }]);
        assert_eq!(writers.update(NAME, wanted(&[(a, History::UNSAID)]), false), []);
        // Another known depth is another offer.
        assert_eq!(writers.update(NAME, wanted(&[(a, NINE)]), false), [closed(a), opened(a, NINE)]);
    }

    #[test]
    fn unlisted_sources_keep_their_writers_while_the_owner_settles() {
        let a = Some(source(1, 1));
        let mut writers = UseWriters::default();
        writers.update(NAME, wanted(&[(a, FIVE), (None, FIVE)]), false);
        // The writer for all others belongs to no publisher that could be rediscovered.
        assert_eq!(writers.update(NAME, wanted(&[]), true), [closed(None)]);
        assert_eq!(writers.update(NAME, wanted(&[]), false), [closed(a)]);
    }

    #[test]
    fn node_is_announced_again_only_for_a_new_writer() {
        let (old, new) = (source(1, 1), source(1, 2));
        let node = RosNode::new("/", "camera", None).unwrap();
        let mut writers = UseWriters::default();
        assert!(!writers.set_node(Some(old), Some(&node)), "no such writer");
        writers.update(NAME, wanted(&[(Some(old), FIVE)]), false);
        assert!(writers.set_node(Some(old), Some(&node)) && !writers.set_node(Some(old), Some(&node)));
        writers.update(NAME, wanted(&[(Some(new), FIVE)]), false);
        assert!(writers.set_node(Some(new), Some(&node)), "the local network knows sources, not publishers");
        assert!(writers.set_node(Some(new), None));
    }
}
