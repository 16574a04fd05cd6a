//! [`KnownWriters`]: the writers of a reader's samples, by the handle that the reader gets. Each is looked up once.

use std::collections::HashMap;

use cyclors::{
    dds_builtintopic_free_endpoint, dds_entity_t, dds_get_matched_publication_data, dds_instance_handle_t,
};
use sgc_ros::Guid;

use crate::{qos, user_data};

/// Most writers that one reader remembers.
const WRITERS_MAX: usize = 1024;

/// The writer of a sample.
#[derive(Clone, Copy, Debug)]
pub(crate) struct KnownWriter {
    pub(crate) guid: Guid,
    /// `true` if it carries a tag, so that an SGC proxy created it, this one or another.
    pub(crate) tagged: bool,
}

/// The writers whose samples one reader has received.
#[derive(Debug, Default)]
pub(crate) struct KnownWriters(HashMap<dds_instance_handle_t, KnownWriter>);

impl KnownWriters {
    /// Returns a writer that was looked up before.
    pub(crate) fn known(&self, handle: dds_instance_handle_t) -> Option<KnownWriter> {
        self.0.get(&handle).copied()
    }

    /// Returns a writer of `reader`, or `None` if it is gone and was never looked up.
    pub(crate) fn find(
        &mut self,
        reader: dds_entity_t,
        handle: dds_instance_handle_t,
    ) -> Option<KnownWriter> {
        if let Some(writer) = self.known(handle) {
            return Some(writer);
        }
        // SAFETY: takes numbers, checked by Cyclone; returns null or an object that is ours to free.
        let data = unsafe { dds_get_matched_publication_data(reader, handle) };
        // SAFETY: null or valid, see above.
        let endpoint = unsafe { data.as_ref() }?;
        let guid = Guid(endpoint.key.v);
        // SAFETY: not null, and valid as long as the endpoint is.
        let tagged =
            !endpoint.qos.is_null() && user_data::is_tagged(&unsafe { qos::user_data(endpoint.qos) });
        // SAFETY: not null, not used any more, freed once.
        unsafe { dds_builtintopic_free_endpoint(data) };
        if self.0.len() >= WRITERS_MAX {
            self.0.clear();
        }
        let writer = KnownWriter { guid, tagged };
        self.0.insert(handle, writer);
        Some(writer)
    }
}
