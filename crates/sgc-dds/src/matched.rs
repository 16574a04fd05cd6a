//! The endpoints that an endpoint of this participant is matched with.

use cyclors::{
    dds_builtintopic_endpoint_t, dds_builtintopic_free_endpoint, dds_entity_t,
    dds_get_matched_publication_data, dds_get_matched_publications, dds_get_matched_subscription_data,
    dds_get_matched_subscriptions, dds_instance_handle_t,
};
use sgc_ros::Guid;

use crate::{qos, user_data};

/// Most matched endpoints that are examined.
const MATCHES_MAX: usize = 1024;

/// Most matched readers that are examined while a message waits to be written.
const EXAMINED_MAX: usize = 64;

/// A matched endpoint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct MatchedEndpoint {
    pub(crate) guid: Guid,
    /// `true` if it carries a tag, so that an SGC proxy created it, this one or another.
    pub(crate) tagged: bool,
}

type List = unsafe extern "C" fn(dds_entity_t, *mut dds_instance_handle_t, usize) -> i32;
type Describe = unsafe extern "C" fn(dds_entity_t, dds_instance_handle_t) -> *mut dds_builtintopic_endpoint_t;

/// Returns `true` if `is_so` holds for all matched readers of a writer. Returns `false` if one cannot be examined, or if
/// there are more than [`EXAMINED_MAX`], because Cyclone searches all of them for each.
pub(crate) fn all_readers_are(writer: dds_entity_t, is_so: impl Fn(&MatchedEndpoint) -> bool) -> bool {
    let mut matches: [dds_instance_handle_t; EXAMINED_MAX] = [0; EXAMINED_MAX];
    // SAFETY: the handle is checked by Cyclone, and there is room for as many as is said.
    let found = unsafe { dds_get_matched_subscriptions(writer, matches.as_mut_ptr(), EXAMINED_MAX) };
    let found = usize::try_from(found).ok().and_then(|found| matches.get(..found));
    let describe = |handle: &_| one_of(writer, *handle, dds_get_matched_subscription_data);
    found.is_some_and(|handles| {
        handles.iter().all(|handle| describe(handle).is_some_and(|reader| is_so(&reader)))
    })
}

/// Returns the matched readers of a writer, at most [`MATCHES_MAX`].
pub(crate) fn readers_of(writer: dds_entity_t) -> Vec<MatchedEndpoint> {
    all_of(writer, dds_get_matched_subscriptions, dds_get_matched_subscription_data)
}

/// Returns the matched writers of a reader, at most [`MATCHES_MAX`].
pub(crate) fn writers_of(reader: dds_entity_t) -> Vec<MatchedEndpoint> {
    all_of(reader, dds_get_matched_publications, dds_get_matched_publication_data)
}

/// Returns a matched writer of a reader, or `None` if it is gone.
pub(crate) fn writer_of(reader: dds_entity_t, handle: dds_instance_handle_t) -> Option<MatchedEndpoint> {
    one_of(reader, handle, dds_get_matched_publication_data)
}

fn all_of(endpoint: dds_entity_t, list: List, describe: Describe) -> Vec<MatchedEndpoint> {
    let mut matches: [dds_instance_handle_t; MATCHES_MAX] = [0; MATCHES_MAX];
    // SAFETY: the handle is checked by Cyclone, and there is room for as many as is said.
    let found = unsafe { list(endpoint, matches.as_mut_ptr(), MATCHES_MAX) };
    let found = usize::try_from(found).unwrap_or(0).min(MATCHES_MAX);
    matches[..found].iter().filter_map(|handle| one_of(endpoint, *handle, describe)).collect()
}

fn one_of(
    endpoint: dds_entity_t,
    handle: dds_instance_handle_t,
    describe: Describe,
) -> Option<MatchedEndpoint> {
    // SAFETY: takes numbers, checked by Cyclone; returns null or an object that is ours to free.
    let data = unsafe { describe(endpoint, handle) };
    // SAFETY: null or valid, see above.
    let found = unsafe { data.as_ref() }?;
    let guid = Guid(found.key.v);
    // SAFETY: not null, and valid as long as the endpoint is.
    let tagged = !found.qos.is_null() && user_data::is_tagged(&unsafe { qos::user_data(found.qos) });
    // SAFETY: not null, not used any more, freed once.
    unsafe { dds_builtintopic_free_endpoint(data) };
    Some(MatchedEndpoint { guid, tagged })
}
