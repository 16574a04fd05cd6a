//! [`NetworkEnds`]: the readers and writers that the route machine wants on the local network. They stay wanted while
//! the network is closed.
//!
//! The sinks own the writers that exist. Readers and writers are created by blocking tasks of the control task.

use std::any::Any;
use std::collections::HashMap;
use std::sync::Arc;

use sgc_ros::EndpointSpec;
use sgc_wire::{Name, SourceId};

use crate::data::sending::intake::NewestSamples;

/// Owner of an endpoint of the local network. Dropping it closes the endpoint, which may block.
pub(crate) type OpenEnd = Box<dyn Any + Send>;

/// A writer: the name that it writes, and the source if it is for one alone.
pub(crate) type WriterKey = (Name, Option<SourceId>);

/// A wanted reader.
struct WantedReader {
    spec: EndpointSpec,
    /// Owner of the reader; `None` while it is being created.
    opened: Option<OpenEnd>,
    /// Time stamps of the newest samples that it took.
    newest: Option<Arc<NewestSamples>>,
}

/// Wanted readers and writers.
#[derive(Default)]
pub(crate) struct NetworkEnds {
    readers: HashMap<Name, WantedReader>,
    writers: HashMap<WriterKey, EndpointSpec>,
}

impl NetworkEnds {
    /// Wants a reader, which replaces another one of the name. Returns the time stamps of the newest samples, whose
    /// older ones it skips: it takes over those of the reader that it replaces.
    pub(crate) fn want_reader(&mut self, name: Name, spec: EndpointSpec) -> Option<Arc<NewestSamples>> {
        let newest = self.readers.remove(&name).and_then(|old| old.newest);
        let newest = newest.or_else(|| spec.qos.is_transient_local().then(Arc::default));
        self.readers.insert(name, WantedReader { spec, opened: None, newest: newest.clone() });
        newest
    }

    /// Returns `true` if a reader like this one is wanted.
    pub(crate) fn wants_reader(&self, name: &Name, spec: &EndpointSpec) -> bool {
        self.readers.get(name).is_some_and(|wanted| wanted.spec == *spec)
    }

    /// Takes a new reader into use. Returns it if none is wanted under the name.
    pub(crate) fn put_reader(&mut self, name: &Name, reader: OpenEnd) -> Option<OpenEnd> {
        match self.readers.get_mut(name) {
            Some(wanted) => {
                wanted.opened = Some(reader);
                None
            }
            None => Some(reader),
        }
    }

    /// Wants a reader no longer. Returns it if it exists.
    pub(crate) fn forget_reader(&mut self, name: &Name) -> Option<OpenEnd> {
        self.readers.remove(name)?.opened
    }

    /// Wants no readers any longer, and returns those that exist.
    pub(crate) fn forget_readers(&mut self) -> Vec<OpenEnd> {
        self.readers.drain().filter_map(|(_, reader)| reader.opened).collect()
    }

    /// Returns the readers that exist, which end. They stay wanted.
    pub(crate) fn take_readers(&mut self) -> Vec<OpenEnd> {
        self.readers.values_mut().filter_map(|reader| reader.opened.take()).collect()
    }

    /// Returns all wanted readers.
    pub(crate) fn readers(&self) -> Vec<(Name, EndpointSpec)> {
        self.readers.iter().map(|(name, reader)| (*name, reader.spec.clone())).collect()
    }

    pub(crate) fn want_writer(&mut self, key: WriterKey, spec: EndpointSpec) {
        self.writers.insert(key, spec);
    }

    /// Returns `true` if a writer like this one is wanted.
    pub(crate) fn wants_writer(&self, key: &WriterKey, spec: &EndpointSpec) -> bool {
        self.writers.get(key) == Some(spec)
    }

    /// Wants a writer no longer. Returns its description.
    pub(crate) fn forget_writer(&mut self, key: &WriterKey) -> Option<EndpointSpec> {
        self.writers.remove(key)
    }

    /// Returns all wanted writers.
    pub(crate) fn writers(&self) -> Vec<(WriterKey, EndpointSpec)> {
        self.writers.iter().map(|(key, spec)| (*key, spec.clone())).collect()
    }
}

#[cfg(test)]
mod tests {
    use sgc_wire::{Durability, Qos};

    use super::*;

    const NAME: Name = Name([1; 32]);

    fn spec(durability: Durability) -> EndpointSpec {
        EndpointSpec {
            topic: "rt/map".into(),
            type_name: "std_msgs::msg::dds_::String_".into(),
            keyless: true,
            asks_key_hash: false,
            type_hash: None,
            qos: Qos { durability, ..Qos::default() },
        }
    }

    #[test]
    fn reader_of_a_latched_topic_takes_over_the_newest_samples_of_its_predecessor() {
        let mut ends = NetworkEnds::default();
        assert!(ends.want_reader(NAME, spec(Durability::Volatile)).is_none());
        let first = ends.want_reader(NAME, spec(Durability::TransientLocal)).unwrap();
        let second = ends.want_reader(NAME, spec(Durability::TransientLocal)).unwrap();
        assert!(Arc::ptr_eq(&first, &second));
        ends.forget_reader(&NAME);
        let other = ends.want_reader(NAME, spec(Durability::TransientLocal)).unwrap();
        assert!(!Arc::ptr_eq(&first, &other), "the reader was not replaced but ended");
    }

    #[test]
    fn readers_stay_wanted_while_the_network_is_closed_and_unwanted_ones_come_back() {
        let (mut ends, wanted) = (NetworkEnds::default(), spec(Durability::Volatile));
        ends.want_reader(NAME, wanted.clone());
        assert!(ends.wants_reader(&NAME, &wanted));
        assert!(!ends.wants_reader(&NAME, &spec(Durability::TransientLocal)));
        assert!(ends.put_reader(&NAME, Box::new(1)).is_none());
        assert_eq!(ends.take_readers().len(), 1);
        assert!(ends.take_readers().is_empty());
        assert_eq!(ends.readers(), [(NAME, wanted)]);
        assert!(ends.forget_reader(&NAME).is_none(), "it ended with the network");
        assert!(ends.put_reader(&NAME, Box::new(2)).is_some(), "it is no longer wanted");
    }
}
