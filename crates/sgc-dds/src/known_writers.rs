//! [`KnownWriters`]: the writers of a reader's samples, by the handle that the reader gets. Each is looked up once.

use std::collections::HashMap;

use cyclors::{dds_entity_t, dds_instance_handle_t};

use crate::matched::{self, MatchedEndpoint};

/// Most writers that one reader remembers.
const WRITERS_MAX: usize = 1024;

/// The writers whose samples one reader has received.
#[derive(Debug, Default)]
pub(crate) struct KnownWriters(HashMap<dds_instance_handle_t, MatchedEndpoint>);

impl KnownWriters {
    /// Returns a writer that was looked up before.
    pub(crate) fn known(&self, handle: dds_instance_handle_t) -> Option<MatchedEndpoint> {
        self.0.get(&handle).copied()
    }

    /// Returns a writer of `reader`, or `None` if it is gone and was never looked up.
    pub(crate) fn find(
        &mut self,
        reader: dds_entity_t,
        handle: dds_instance_handle_t,
    ) -> Option<MatchedEndpoint> {
        if let Some(writer) = self.known(handle) {
            return Some(writer);
        }
        let writer = matched::writer_of(reader, handle)?;
        if self.0.len() >= WRITERS_MAX {
            self.0.clear();
        }
        self.0.insert(handle, writer);
        Some(writer)
    }
}
