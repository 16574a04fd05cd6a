//! [`Requests`]: the requests at the servers of a service that wait for a reply.

use std::collections::VecDeque;
use std::sync::Mutex;

use sgc_ros::RequestId;
use sgc_sync::lock;
use sgc_zenoh::{EndpointRef, Gid};
use zenoh::query::Query;

/// Most requests that wait for a reply. The oldest give way, and their clients get none.
pub(crate) const REQUESTS_MAX: usize = 4096;

/// Requests without a reply, the oldest first. A query that is dropped tells its client that there is none, which may wait
/// for room, so no query is dropped under the lock.
#[derive(Debug, Default)]
pub(crate) struct Requests(Mutex<VecDeque<WaitingRequest>>);

#[derive(Debug)]
struct WaitingRequest {
    client: Gid,
    number: i64,
    asker: Option<EndpointRef>,
    query: Query,
}

impl Requests {
    /// Keeps a request until its reply. Returns `false` if the oldest one had to give way.
    pub(crate) fn keep(&self, client: Gid, number: i64, asker: Option<EndpointRef>, query: Query) -> bool {
        let mut requests = lock(&self.0);
        let oldest = if requests.len() >= REQUESTS_MAX { requests.pop_front() } else { None };
        requests.push_back(WaitingRequest { client, number, asker, query });
        drop(requests);
        oldest.is_none()
    }

    /// Takes a request to reply to.
    pub(crate) fn take(&self, id: &RequestId) -> Option<Query> {
        let mut requests = lock(&self.0);
        let place = requests.iter().position(|one| one.client.0 == id.client && one.number == id.number)?;
        requests.remove(place).map(|one| one.query)
    }

    pub(crate) fn is_empty(&self) -> bool {
        lock(&self.0).is_empty()
    }

    /// Drops the requests of a client that is gone.
    pub(crate) fn forget(&self, client: EndpointRef) {
        let is_its = |one: &WaitingRequest| one.asker == Some(client);
        let mut requests = lock(&self.0);
        if requests.iter().any(is_its) {
            let (gone, there): (VecDeque<_>, _) =
                std::mem::take(&mut *requests).into_iter().partition(is_its);
            *requests = there;
            drop(requests);
            drop(gone);
        }
    }
}
